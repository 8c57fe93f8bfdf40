#!/usr/bin/env bash
# Does a field or network depend on what its memory held before? The same learning with stack and heap filled with zeros
# and with other bytes must give the same bits. (Address sanitizers do not look for that.) Speaks TAP.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
log=$tmp/log
. tests/tap.sh

# build NAME FLAGS...
build() {
    local name=$1
    shift
    ${CC:-cc} -std=c11 -O0 -ffp-contract=off -w "$@" -I. tests/uninitialised.c -o "$tmp/$name" -lm >"$log" 2>&1
}

name='fields and networks do not depend on what memory held before'
zero=-ftrivial-auto-var-init=zero pattern=-ftrivial-auto-var-init=pattern
# clang before 16 wants to be asked twice for zeros.
asked='-Xclang -enable-trivial-auto-var-init-zero-knowing-it-will-be-removed-from-clang'
if ! { build zero $zero -DFILL=0 || build zero $zero $asked -DFILL=0; } || ! build pattern $pattern -DFILL=0xc3; then
    skip "$name: the compiler cannot fill the stack"
else
    { "$tmp/zero" && "$tmp/pattern"; } >"$log" 2>&1
    status=$?
    [ "$status" -eq 0 ] && [ "$(sort -u "$log" | wc -l)" -eq 1 ] && [ "$(wc -l <"$log")" -eq 2 ]
    report $? "$name"
fi
finish
