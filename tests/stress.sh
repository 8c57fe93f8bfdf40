#!/usr/bin/env bash
# Run the stress programs given; one table of their groups. Exit status 1 where something was lost.
# Environment: CONFIG, SECONDS_ALL (for all programs together), CASES (so many a group instead), SEED, ONLY (name of one
# group).
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
: "${CONFIG:=release}" "${SECONDS_ALL:=30}" "${SEED:=1}"
export ASAN_OPTIONS="detect_leaks=1:allocator_may_return_null=1:${ASAN_OPTIONS-}"
export UBSAN_OPTIONS="print_stacktrace=1:${UBSAN_OPTIONS-}"
export TSAN_OPTIONS="suppressions=$PWD/tests/tsan.supp:${TSAN_OPTIONS-}"

# ThreadSanitizer of older compilers cannot cope with much address randomisation: without it where that is allowed.
if [ "$CONFIG" = tsan ] && [ -z "${UNRANDOMISED-}" ] && setarch -R true 2>/dev/null; then
    UNRANDOMISED=1 exec setarch -R bash "$PWD/tests/stress.sh" "$@"
fi

[ $# -gt 0 ] || { echo 'stress: no program' >&2; exit 1; }
rows=$(mktemp) || exit 1
trap 'rm -f "$rows"' EXIT
each=$SECONDS_ALL
[ -n "${ONLY-}" ] || each=$(awk "BEGIN { print $SECONDS_ALL / $# }")
amount="$SECONDS_ALL seconds"
[ -z "${CASES-}" ] || amount="$CASES cases a group"
printf 'config %s, seed %s, %s\n' "$CONFIG" "$SEED" "$amount"
printf '%-8s %-20s %9s %9s %9s %6s %9s %7s %6s\n' header group tried refused survived lost faults seconds MB
failed=0
# Numbers of cases do not depend on what else runs: several programs at a time. Each row is written at once.
jobs=1
[ -z "${CASES-}" ] || jobs=$(nproc 2>/dev/null || echo 2)
printf '%s\0' "$@" | xargs -0 -P "$jobs" -I '{}' bash -c '"$@"; status=$?; [ $status = 0 ] || [ $status = 3 ]' stress \
    '{}' --rows --seconds "$each" --seed "$SEED" ${CASES:+--cases "$CASES"} ${ONLY:+--only "$ONLY"} | tee "$rows"
[ "${PIPESTATUS[1]}" = 0 ] || failed=1 # 3: has no group ONLY
awk '{ t += $3; r += $4; s += $5; l += $6 } END {
    printf "%-8s %-20s %9d %9d %9d %6d\n", "all", NR " groups", t, r, s, l; exit NR == 0 || l > 0 }' "$rows" || failed=1
exit $failed
