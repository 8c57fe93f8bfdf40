#!/bin/sh
# readme.sh README.md JSON...: put the rows of microbenchmarks between the README's lines <!-- NAME.json --> and
# <!-- end -->, as a table. Rows without a goal are left out: the benchmark prints them.
readme=$1
shift
for json in "$@"; do
    name=$(basename "$json")
    grep -q "^<!-- $name -->\$" "$readme" || continue
    awk -v name="$name" '
        # "key": value of a line; values hold no quotes and, where they are numbers, no commas
        function value(line, key,    at, rest) {
            at = index(line, "\"" key "\": ")
            rest = substr(line, at + length(key) + 4)
            if (!at) return ""
            if (substr(rest, 1, 1) == "\"") { rest = substr(rest, 2); return substr(rest, 1, index(rest, "\"") - 1) }
            match(rest, /^[-+0-9.e]+/)
            return substr(rest, 1, RLENGTH)
        }
        FNR == NR {
            if (index($0, "\"machine\"")) {
                machine = value($0, "cpu") ", " value($0, "compiler") ", commit " value($0, "commit") "; FMA " \
                    value($0, "fma_gflops") " GFLOP/s, copy of 2048² floats " value($0, "copy_ms") " ms, memory read " \
                    value($0, "read_gb_s") " GB/s"
            } else if (value($0, "target_ns") + 0 > 0) {
                ns = value($0, "ns")
                goal = value($0, "target_ns")
                rows = rows sprintf("| %s | %.0f | %.0f | %.0f %% | %.1fx | %.2fx | %s%s |\n", value($0, "name"), ns,
                    value($0, "median_ns"), 100 * value($0, "spread"), value($0, "naive_ns") / ns,
                    ns / value($0, "limit_ns"), goal, ns + 0 <= goal + 0 ? "" : ", missed")
            }
            next
        }
        $0 == "<!-- " name " -->" {
            print
            printf "\n%s.\n\n| kernel | min ns | median | spread | faster than naive | over the limit | goal |\n", machine
            printf "|---|---|---|---|---|---|---|\n%s\n", rows
            skip = 1
            next
        }
        $0 == "<!-- end -->" { skip = 0 }
        !skip { print }' "$json" "$readme" >"$readme.new" && mv "$readme.new" "$readme" || exit 1
    echo "$readme: table of $name rewritten"
done
