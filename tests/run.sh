#!/usr/bin/env bash
# Run test programs (cmocka, TAP), the compile matrix and the command-line tests, several at a time; say what starts
# (".. NAME"), then how long each test took and how many CPU seconds each program; end with the slowest tests and
#   N passed, N failed
# Exit status 1 where a test failed, a program crashed, or fewer tests ran than tests/expected-count says.
# Environment: BUILD folder, CONFIG, CC, TESTS = names to run (empty = all; "matrix", "uninitialised", "rig" and "cli"
# are names too), TEST_FILTER = pattern of the names of cmocka's tests (scripts run then only where TESTS names them),
# TEST_JOBS = programs at a time (the processors, at most 8; the rig times programs and is always alone), RECORD=1
# rewrites tests/expected-count.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
processors=$(nproc 2>/dev/null || echo 2) # which does not know what share of them a container may use
: "${BUILD:=build}" "${CONFIG:=release}" "${CC:=cc}" "${TEST_JOBS:=$((processors < 8 ? processors : 8))}"
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

tmp=$(mktemp -d) || exit 1
# Each worker leads a process group, so that an interrupt ends what it runs too.
set -m
trap 'exec 2>/dev/null; for job in $(jobs -p); do kill -- "-$job"; done; rm -rf "$tmp"' EXIT
microseconds() { # bash 5 has a fine clock; others count in seconds
    local t=${EPOCHREALTIME:-$(date +%s).000000}
    echo "${t/./}"
}
# complain TEXT: a failure of the program that runs now.
complain() { printf '  %s: %s\n' "$name" "$1" >>"$tmp/$name.failures"; }

# run NAME COMMAND...: stream its TAP, time each test by when its line arrives. $tmp/NAME.* get the counts, the failures,
# the plan and the times.
run() {
    local name=$1 line last now p=0 f=0 s=0 status start plan=-1 text want cpu=0
    shift
    : >"$tmp/$name.failures"
    printf '%s\n' "== $name"
    start=$(microseconds) last=$start
    while IFS= read -r line; do
        case $line in
        "exit status "*) status=${line#exit status } ;;
        "cpu seconds "*) cpu=${line#cpu seconds } ;;
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
            *) f=$((f + 1)) ; text="FAIL  $text" ; complain "${text#FAIL  }" ;;
            esac
            printf '%8d ms  %s\n' $(((now - last) / 1000)) "$text"
            printf '%8d ms  %s: %s\n' $(((now - last) / 1000)) "$name" "${text#ok    }" >>"$tmp/$name.times"
            last=$now
            ;;
        "") ;;
        *) printf '             %s\n' "$line" ;;
        esac
    done < <(
        "$@" 2>&1
        printf '\nexit status %d\n' $?
        times >"$tmp/$name.cpu"
        awk -F '[ms ]+' 'NR == 2 { printf "cpu seconds %.1f\n", 60 * ($1 + $3) + $2 + $4 }' "$tmp/$name.cpu"
    )
    now=$(microseconds)
    # A program that stops early, or fails without a failed test (a sanitizer's report at exit), is a failure.
    if [ "${status:-1}" -ne 0 ] && [ "$f" -eq 0 ]; then
        f=1
        complain "exit status ${status:-unknown}"
        echo "       FAIL  exit status ${status:-unknown}"
    elif [ "$plan" -ge 0 ] && [ $((p + f + s)) -lt "$plan" ]; then
        f=$((f + 1))
        complain "stopped after $((p + f + s - 1)) of $plan tests"
        echo "       FAIL  stopped early"
    fi
    want=0 # a filter need not match in every program; at the end some test must have run
    [ -n "${TEST_FILTER-}" ] || want=$(sed -n "s/^$name //p" tests/expected-count 2>/dev/null)
    if [ -z "${RECORD-}" ] && [ $((p + f + s)) -lt "${want:-1}" ]; then
        f=$((f + 1))
        complain "only $((p + s)) tests ran, ${want:-1} expected"
        echo "       FAIL  only $((p + s)) tests ran, ${want:-1} expected"
    fi
    [ "$plan" -ge 0 ] || plan=$((p + f + s))
    printf '   %d passed, %d failed, %d skipped in %d.%02d s, %s CPU seconds\n' $p $f $s \
        $(((now - start) / 1000000)) $(((now - start) / 10000 % 100)) "$cpu"
    echo "$p $f $s $plan $cpu" >"$tmp/$name.counts"
}

wanted() { # a script; filters are for the programs
    if [ -n "${TESTS-}" ]; then case " $TESTS " in *" $1 "*) true ;; *) false ;; esac; else [ -z "${TEST_FILTER-}" ]; fi
}

# What runs. The matrix compiles the headers by itself: once is enough, not once per configuration.
names=() commands=()
plan() { names+=("$1") commands+=("$2"); }
if [ "$CONFIG" = release ] && wanted matrix; then plan matrix 'bash tests/compile-matrix.sh'; fi
if [ -x "$BUILD/render" ] && wanted cli; then plan cli 'bash tests/run-cli.sh'; fi
for program in "$@"; do plan "$(basename "$program")" "$program"; done
if [ "$CONFIG" = release ] && wanted uninitialised; then plan uninitialised 'bash tests/uninitialised.sh'; fi
# Longest first, as tests/expected-count lists them, so that none is left alone at the end; before them what is new there.
order=$(for i in "${!names[@]}"; do echo "$(sed -n "/^${names[i]} /=" tests/expected-count) $i"; done | sort -t ' ' -k 1,1n | sed 's/.* //')
by_name=() by_command=()
for i in $order; do by_name+=("${names[i]}") by_command+=("${commands[i]}"); done
names=("${by_name[@]}") commands=("${by_command[@]}")

# say COMMAND...: when no other worker prints.
say() {
    until mkdir "$tmp/saying" 2>/dev/null; do
        [ -d "$tmp" ] || exit 1
        sleep 0.05
    done
    "$@"
    rmdir "$tmp/saying"
}

# worker: run what no other worker has taken; where there are others, say all of a program at once.
worker() {
    local i
    for i in "${!names[@]}"; do
        mkdir "$tmp/$i" 2>/dev/null || continue
        if [ "$TEST_JOBS" -eq 1 ] || [ ${#names[@]} -eq 1 ]; then
            run "${names[i]}" ${commands[i]}
        else
            say echo ".. ${names[i]}"
            run "${names[i]}" ${commands[i]} >"$tmp/${names[i]}.log"
            say cat "$tmp/${names[i]}.log"
        fi
    done
}
for ((job = 0; job < TEST_JOBS; ++job)); do worker </dev/null & done
wait
# Times: only the fast build's say anything, and only alone.
if [ "$CONFIG" = release ] && wanted rig; then
    plan rig ''
    run rig bash tests/rig.sh </dev/null &
    wait
fi

passed=0 failed=0 skipped=0 recorded=
for name in "${names[@]}"; do
    read -r p f s planned cpu <"$tmp/$name.counts" || { complain 'did not end' && p=0 f=1 s=0 planned=0; }
    recorded="$recorded$name $planned"$'\n'
    passed=$((passed + p)) failed=$((failed + f)) skipped=$((skipped + s))
done

if [ -n "${RECORD-}" ]; then
    {
        echo "# How many tests each program has at least, in the order they are run; rewritten by: make expected-count"
        printf '%s' "$recorded"
    } >tests/expected-count
elif [ -z "${TESTS-}${TEST_FILTER-}" ] && [ -e tests/expected-count ]; then
    # Whatever is listed must have run.
    while read -r name count; do
        case $name in '#' | '') continue ;; esac
        case $name in matrix | rig | uninitialised) [ "$CONFIG" != release ] && continue ;; esac
        case $'\n'"$recorded" in *$'\n'"$name "*) ;; *)
            failed=$((failed + 1))
            complain "did not run ($count tests expected)" ;;
        esac
    done <tests/expected-count
fi
if [ $((passed + failed)) -eq 0 ]; then
    failed=1 name=tests
    complain 'none ran'
fi
printf '\nslowest:\n'
cat "$tmp"/*.times 2>/dev/null | sort -rn | head -n 8
cat "$tmp"/*.counts 2>/dev/null | awk '{ sum += $5 } END { printf "%.0f CPU seconds in all\n", sum }'
if [ "$failed" -gt 0 ]; then printf '\nfailed:\n' && cat "$tmp"/*.failures; fi
[ "$skipped" -gt 0 ] && printf '\n%d skipped' "$skipped"
printf '\n%d passed, %d failed\n' "$passed" "$failed"
[ "$failed" -eq 0 ]
