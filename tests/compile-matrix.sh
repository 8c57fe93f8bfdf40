#!/usr/bin/env bash
# The headers as users compile them: each guide_*.h alone, declarations and implementation, as C99, C11, C++11 and C++17,
# by gcc and clang, without a warning; the example in its opening comment compiled and run as it stands; the lines on top
# of examples/*.c that compile and run them; nothing but prefixed symbols and macros; NEON code in an emulator. Speaks TAP.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
log=$tmp/log
. tests/tap.sh
warn="-Wall -Wextra -Wpedantic -Wshadow -Wsign-conversion -Werror"

attempt() { # attempt NAME COMMAND...
    local name=$1
    shift
    "$@" >"$tmp/log" 2>&1
    report $? "$name"
}
compilers() { # compilers gcc c99 -> the command, empty where it is not installed
    local c=$1
    case $1$2 in gccc++*) c=g++ ;; clangc++*) c=clang++ ;; esac
    command -v "$c"
}

# What to write between #include lines so that the file has a function, and main where wanted.
headers=$(ls guide_*.h 2>/dev/null)
[ -n "$headers" ] || { echo "no guide_*.h here" && exit 1; }
present=
for c in gcc clang; do command -v $c >/dev/null && present="$present $c"; done
[ -n "$present" ] || { echo "neither gcc nor clang here" && exit 1; }

prefix_of() {
    case $1 in guide_sdtree.h) echo gsd ;; guide_kd.h) echo gkd ;; guide_photon.h) echo gph ;; guide_nn.h) echo gnn ;; esac
}

for header in $headers; do
    prefix=$(prefix_of "$header")
    [ -n "$prefix" ] || { : >"$tmp/log" && report 1 "$header: no prefix known for it" && continue; }
    macro=$(echo "$prefix" | tr a-z A-Z)
    for language in c c++; do
        extension=$language
        [ $language = c++ ] && extension=cc
        # Declarations twice (the guard), then, in the other file, the implementation after them: any order works.
        printf '#include "%s"\n#include "%s"\nint main(void) { return 0; }\n' "$header" "$header" >"$tmp/decl.$extension"
        printf '#include "%s"\n#define %s_IMPLEMENTATION\n#include "%s"\nint main(void) { return 0; }\n' \
            "$header" "$macro" "$header" >"$tmp/impl.$extension"
    done
    for compiler in gcc clang; do
        for std in c99 c11 c++11 c++17; do
            command=$(compilers $compiler $std)
            case $std in c++*) extension=cc more= ;; *) extension=c more=-Wstrict-prototypes ;; esac
            for part in decl impl; do
                name="$header $compiler -std=$std $part"
                if [ -z "$command" ]; then
                    skip "$name (not installed)"
                    continue
                fi
                # The optimiser warns of the same whatever the standard's year (and clang's hardly of anything): once a
                # header, as C++ here, as C by the fast build of the tests. Object files: the example and the symbols below.
                case $compiler$std$part in
                gccc++11impl) attempt "$name" "$command" -std=$std -O2 $warn -I. "$tmp/impl.cc" -lm -o "$tmp/a.out" ;;
                *) attempt "$name" "$command" -std=$std -fsyntax-only $warn $more -I. "$tmp/$part.$extension" ;;
                esac
            done
        done
    done
    compiler=${present# }
    compiler=${compiler%% *}

    # Scalar build, 32-bit char signedness and no asserts: the variants that users' flags bring.
    attempt "$header scalar (${macro}_NO_SIMD)" $compiler -std=c99 -O0 $warn -D${macro}_NO_SIMD -DNDEBUG -funsigned-char -I. \
        "$tmp/impl.c" -lm -o "$tmp/a.out"
    # Everything private to one file.
    attempt "$header static" $compiler -std=c99 -O0 -Wall -Wextra -Wno-unused-function -Werror -D${macro}_API=static -I. \
        "$tmp/impl.c" -lm -o "$tmp/a.out"

    # Symbols: everything defined outside starts with the prefix, or with the private one.
    printf '#define %s_IMPLEMENTATION\n#include "%s"\n' "$macro" "$header" >"$tmp/only.c"
    $compiler -std=c99 -O0 -fno-pic -I. -c "$tmp/only.c" -o "$tmp/only.o" 2>"$tmp/log"
    nm -g --defined-only "$tmp/only.o" | awk '{ print $NF }' | sed 's/^_//' | sort -u >"$tmp/symbols"
    grep -v "^$prefix[i]*_" "$tmp/symbols" >"$tmp/log"
    [ -s "$tmp/symbols" ] && [ ! -s "$tmp/log" ]
    report $? "$header: external symbols start with ${prefix}_"
    # The implementation has no writable globals (b, d: zeroed and initialised data).
    nm "$tmp/only.o" | awk '$2 ~ /^[bBdDC]$/' >"$tmp/log"
    [ ! -s "$tmp/log" ]
    report $? "$header: no mutable globals"

    # Macros: what the header adds to what the standard headers it includes define.
    grep -hoE '^ *# *include *<[a-z_0-9/]+\.h>' "$header" | tr -d ' ' | sort -u >"$tmp/std.h"
    for part in DECLARATIONS IMPLEMENTATION; do
        # System headers may be included in either half; a missing one (another machine's) is left out.
        : >"$tmp/base.c"
        while read -r line; do
            echo "$line" | $compiler -E -x c - >/dev/null 2>&1 && echo "$line" >>"$tmp/base.c"
        done <"$tmp/std.h"
        cp "$tmp/base.c" "$tmp/with.c"
        [ $part = IMPLEMENTATION ] && echo "#define ${macro}_IMPLEMENTATION" >>"$tmp/with.c"
        echo "#include \"$header\"" >>"$tmp/with.c"
        $compiler -std=c99 -dM -E -I. "$tmp/base.c" | sort >"$tmp/base.m"
        $compiler -std=c99 -dM -E -I. "$tmp/with.c" | sort >"$tmp/with.m"
        comm -13 "$tmp/base.m" "$tmp/with.m" | awk '{ print $2 }' | sed 's/(.*//' >"$tmp/macros"
        grep -vE "^(${macro}I?_|GUIDE_)" "$tmp/macros" >"$tmp/log"
        [ -s "$tmp/macros" ] && [ ! -s "$tmp/log" ]
        report $? "$header: macros start with ${macro}_ ($(echo $part | tr A-Z a-z))"
    done

    # The example of the opening comment, as it stands: from the indented line that is nothing but the #define of the
    # implementation up to the first blank line.
    awk -v first="^ +#define ${macro}_IMPLEMENTATION$" '
        !n && $0 ~ first { n = match($0, /#/) }
        n && /^ *$/ { exit }
        n { print substr($0, n) }' "$header" >"$tmp/example.c"
    if [ -s "$tmp/example.c" ]; then
        attempt "$header: example compiles as C99" $compiler -std=c99 $warn -I. "$tmp/example.c" -lm -o "$tmp/example"
        attempt "$header: example runs" "$tmp/example"
        cp "$tmp/example.c" "$tmp/example.cc"
        command=$(compilers $compiler c++11)
        if [ -n "$command" ]; then
            attempt "$header: example compiles as C++11" "$command" -std=c++11 $warn -I. "$tmp/example.cc" -lm -o "$tmp/example"
        else
            skip "$header: example compiles as C++11 (not installed)"
        fi
        lines=$(grep -c . "$tmp/example.c")
        echo "$lines lines" >"$tmp/log"
        [ "$lines" -le 30 ]
        report $? "$header: example is at most 30 lines"
    else
        echo "no example in its opening comment" >"$tmp/log"
        report 1 "$header: has an example"
    fi
    # Each function's comment tags and the greppable section names: what the contents list exists.
    grep -oE '>>[a-z_]+' "$header" | sort | uniq -c | awk '$1 < 2 { print $2, "appears once: contents and sections disagree" }' >"$tmp/log"
    [ ! -s "$tmp/log" ]
    report $? "$header: contents and section tags agree"
done

# All headers in one file.
for header in $headers; do
    macro=$(prefix_of "$header" | tr a-z A-Z)
    printf '#define %s_IMPLEMENTATION\n#include "%s"\n' "$macro" "$header"
done >"$tmp/all.c"
echo 'int main(void) { return 0; }' >>"$tmp/all.c"
attempt "all headers in one file" ${compiler:-cc} -std=c99 $warn -I. "$tmp/all.c" -lm -o "$tmp/a.out"

# Where the compiler may contract a * b + c, as it does for users who do not forbid it, the levels of SIMD still agree to
# the bit. clang contracts at -O1 already.
for c in gcc clang; do
    name="guide_sdtree.h $c -mfma: same bits at all levels and places of a batch"
    if command -v $c >/dev/null && grep -qsw avx2 /proc/cpuinfo && grep -qsw fma /proc/cpuinfo; then
        level=-O2
        [ $c = clang ] && level=-O1
        $c -std=gnu11 $level -mavx2 -mfma -I. tests/test_sdtree_parallax.c -lcmocka -lm -lpthread -o "$tmp/fma" >"$log" 2>&1 &&
            CMOCKA_MESSAGE_OUTPUT=TAP TEST_FILTER='*_no_bit*' "$tmp/fma" >"$log" 2>&1 && [ "$(grep -c '^ok' "$log")" -eq 2 ]
        report $? "$name"
    else
        skip "$name (not installed, or no such CPU)"
    fi
done

# NEON's blur in an emulator, where there is one; on AArch64 itself test_sdtree_denoise runs it.
name="guide_sdtree.h: NEON blur agrees with double precision (AArch64, emulated)"
if command -v aarch64-linux-gnu-gcc >/dev/null && command -v qemu-aarch64 >/dev/null; then
    aarch64-linux-gnu-gcc -std=c99 -O2 $warn -static -I. tests/blur_levels.c -lm -o "$tmp/blur_levels" >"$tmp/log" 2>&1 &&
        qemu-aarch64 "$tmp/blur_levels" >"$tmp/log" 2>&1 && grep -q NEON "$tmp/log"
    report $? "$name"
else
    skip "$name (no cross compiler or no qemu-aarch64)"
fi

# NEON of guide_nn.h likewise, by some of its tests, without cmocka; on AArch64 itself all of them run it.
emulated() { # emulated PROGRAM TESTS
    local name="guide_nn.h: NEON passes $1 (AArch64, emulated)"
    if command -v aarch64-linux-gnu-gcc >/dev/null && command -v qemu-aarch64 >/dev/null; then
        aarch64-linux-gnu-gcc -std=c11 -O1 -Wall -Wextra -Wno-sign-compare -Werror -static -DTEST_WITHOUT_CMOCKA \
            "-DTEST_ONLY=\"$2\"" -I. "tests/$1.c" -lm -lpthread -o "$tmp/$1" >"$tmp/log" 2>&1 &&
            qemu-aarch64 "$tmp/$1" >"$tmp/log" 2>&1 && [ "$(grep -c ^ok "$tmp/log")" -eq "$(echo "$2" | wc -w)" ]
        report $? "$name"
    else
        skip "$name (no cross compiler or no qemu-aarch64)"
    fi
}
emulated test_nn_conv 'convolution_is_its_definition_on_every_level not_a_number_reaches_its_neighbours_only'
emulated test_nn_histogram 'levels_of_simd_agree bad_values_stay_in_their_map'

# The lines on top of the examples, run in a copy of the tree's root: where they take a number of passes, two, without the
# optimiser, which the fast build runs on the same files.
mkdir -p "$tmp/root/examples/tracer"
cp guide_*.h "$tmp/root"
cp examples/*.c "$tmp/root/examples" 2>/dev/null
cp examples/tracer/*.h "$tmp/root/examples/tracer" 2>/dev/null
for example in examples/*.c; do
    [ -e "$example" ] || continue
    line=$(head -n 12 "$example" | grep -m 1 -oE '\b(cc|gcc|clang) -.*' | sed "s, *\\*/ *\$,,; s,   *(.*)\$,,")
    if [ -z "$line" ]; then
        echo "no compile line within its first 12 lines" >"$tmp/log"
        report 1 "$example: compile line"
        continue
    fi
    # Embree's name differs between versions 3 and 4: the line names one of them.
    case $line in
    *embree3*) printf '#include <embree3/rtcore.h>\n' | ${compiler:-cc} -E -x c - >/dev/null 2>&1 || line=${line//embree3/embree4} ;;
    *embree4*) printf '#include <embree4/rtcore.h>\n' | ${compiler:-cc} -E -x c - >/dev/null 2>&1 || line=${line//embree4/embree3} ;;
    esac
    if grep -q 'argv\[1\]' "$example"; then line="${line/ -O2 / } 2"; fi
    (cd "$tmp/root" && eval "$line") >"$tmp/log" 2>&1
    report $? "$example: $line"
done

finish
