#!/usr/bin/env bash
# Run test programs (cmocka, TAP), the compile matrix and the command-line tests; say how long each test took; end with
#   N passed, N failed
# Exit status 1 where a test failed, a program crashed, or fewer tests ran than tests/expected-count says.
# Environment: BUILD folder, CONFIG, CC, TESTS = names to run (empty = all; "matrix", "uninitialised", "rig" and "cli"
# are names too),
# RECORD=1 rewrites tests/expected-count.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
: "${BUILD:=build}" "${CONFIG:=release}" "${CC:=cc}"
export BUILD CONFIG CC
export CMOCKA_MESSAGE_OUTPUT=TAP
export ASAN_OPTIONS="detect_leaks=1:allocator_may_return_null=1:${ASAN_OPTIONS-}"
export LSAN_OPTIONS="suppressions=$PWD/tests/lsan.supp:print_suppressions=0:${LSAN_OPTIONS-}"
export UBSAN_OPTIONS="print_stacktrace=1:${UBSAN_OPTIONS-}"
export TSAN_OPTIONS="suppressions=$PWD/tests/tsan.supp:ignore_noninstrumented_modules=1:${TSAN_OPTIONS-}"

# ThreadSanitizer of older compilers cannot cope with much address randomisation: without it where that is allowed.
if [ "$CONFIG" = tsan ] && [ -z "${UNRANDOMISED-}" ] && setarch -R true 2>/dev/null; then
    UNRANDOMISED=1 exec setarch -R bash "$PWD/tests/run.sh" "$@"
fi

passed=0 failed=0 skipped=0 recorded=
failures=
microseconds() { # bash 5 has a fine clock; others count in seconds
    local t=${EPOCHREALTIME:-$(date +%s).000000}
    echo "${t/./}"
}

# run NAME COMMAND...: stream its TAP, time each test by when its line arrives.
run() {
    local name=$1 line last now p=0 f=0 s=0 status start plan=-1 text
    shift
    printf '%s\n' "== $name"
    start=$(microseconds) last=$start
    while IFS= read -r line; do
        case $line in
        "exit status "*) status=${line#exit status } ;;
        1..[0-9]*)
            [ "$plan" -lt 0 ] && plan=0
            plan=$((plan + ${line#1..}))
            ;;
        "ok "* | "not ok "[0-9]*)
            now=$(microseconds)
            text=${line#not }
            text=${text#ok }
            text=${text#[0-9]* }
            text=${text#- }
            case $line in
            *"# SKIP"*) s=$((s + 1)) ; text="skip  ${text#\# SKIP }" ;;
            "ok "*) p=$((p + 1)) ; text="ok    $text" ;;
            *) f=$((f + 1)) ; text="FAIL  $text" ; failures="$failures  $name: ${text#FAIL  }"$'\n' ;;
            esac
            printf '%8d ms  %s\n' $(((now - last) / 1000)) "$text"
            last=$now
            ;;
        "") ;;
        *) printf '             %s\n' "$line" ;;
        esac
    done < <("$@" 2>&1; printf "\nexit status %d\n" $?)
    now=$(microseconds)
    # A program that stops early, or fails without a failed test (a sanitizer's report at exit), is a failure.
    if [ "${status:-1}" -ne 0 ] && [ "$f" -eq 0 ]; then
        f=1 failures="$failures  $name: exit status ${status:-unknown}"$'\n'
        echo "       FAIL  exit status ${status:-unknown}"
    elif [ "$plan" -ge 0 ] && [ $((p + f + s)) -lt "$plan" ]; then
        f=$((f + 1)) failures="$failures  $name: stopped after $((p + f + s - 1)) of $plan tests"$'\n'
        echo "       FAIL  stopped early"
    fi
    local want
    want=$(sed -n "s/^$name //p" tests/expected-count 2>/dev/null)
    if [ -z "${RECORD-}" ] && [ $((p + f + s)) -lt "${want:-1}" ]; then
        f=$((f + 1)) failures="$failures  $name: only $((p + s)) tests ran, ${want:-1} expected"$'\n'
        echo "       FAIL  only $((p + s)) tests ran, ${want:-1} expected"
    fi
    [ "$plan" -ge 0 ] || plan=$((p + f + s))
    recorded="$recorded$name $plan"$'\n'
    printf '   %d passed, %d failed, %d skipped in %d.%02d s\n' $p $f $s \
        $(((now - start) / 1000000)) $(((now - start) / 10000 % 100))
    passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))
}

wanted() { [ -z "${TESTS-}" ] || case " $TESTS " in *" $1 "*) true ;; *) false ;; esac; }

for program in "$@"; do run "$(basename "$program")" "$program"; done
# The matrix compiles the headers by itself: once is enough, not once per configuration.
if [ "$CONFIG" = release ] && wanted matrix; then run matrix bash tests/compile-matrix.sh; fi
if [ "$CONFIG" = release ] && wanted uninitialised; then run uninitialised bash tests/uninitialised.sh; fi
if [ "$CONFIG" = release ] && wanted rig; then run rig bash tests/rig.sh; fi # times: only the fast build's say anything
if [ -x "$BUILD/render" ] && wanted cli; then run cli bash tests/run-cli.sh; fi

if [ -n "${RECORD-}" ]; then
    {
        echo "# How many tests each program has at least; rewritten by: make expected-count"
        printf '%s' "$recorded"
    } >tests/expected-count
elif [ -z "${TESTS-}" ] && [ -e tests/expected-count ]; then
    # Whatever is listed must have run.
    while read -r name count; do
        case $name in '#' | '') continue ;; esac
        case $name in matrix | rig | uninitialised) [ "$CONFIG" != release ] && continue ;; esac
        case $'\n'"$recorded" in *$'\n'"$name "*) ;; *)
            failed=$((failed + 1)) failures="$failures  $name: did not run ($count tests expected)"$'\n' ;;
        esac
    done <tests/expected-count
fi
if [ $((passed + failed)) -eq 0 ]; then
    failed=1 failures="$failures  no test ran"$'\n'
fi
[ -n "$failures" ] && printf '\nfailed:\n%s' "$failures"
[ "$skipped" -gt 0 ] && printf '\n%d skipped' "$skipped"
printf '\n%d passed, %d failed\n' "$passed" "$failed"
[ "$failed" -eq 0 ]
