#!/bin/sh
# readme.sh README.md FILE...: put the rows of microbenchmarks (NAME.json) between the README's lines <!-- NAME.json -->
# and <!-- end -->, as a table; of a file NAME.md, the whole text. Rows of kernels without a goal are left out, as are
# fields other than sf1: the benchmarks print them.
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
            match(rest, /^[-+0-9.a-z]+/)
            return substr(rest, 1, RLENGTH)
        }
        FNR == NR && name ~ /\.md$/ { text = text $0 "\n"; next }
        FNR == NR {
            if (index($0, "\"machine\"")) {
                machine = value($0, "cpu") ", " value($0, "compiler") ", commit " value($0, "commit") "; FMA " \
                    value($0, "fma_gflops") " GFLOP/s, copy of 2048² floats " value($0, "copy_ms") " ms, memory read " \
                    value($0, "read_gb_s") " GB/s"
            } else if (value($0, "built") == "false" || value($0, "field") == "sf1") {
                method = value($0, "method")
                size = value($0, "log2_samples")
                if (!(method in scores)) { order[++methods] = method; scores[method] = "" }
                if (size == "") { scores[method] = " not built |"; next }
                if (!(size in seen)) { seen[size] = 1; sizes = sizes sprintf(" A; C, 2^%d |", size) }
                scores[method] = scores[method] sprintf(" %.2f; %.2f |", value($0, "a"), value($0, "c"))
                bytes = value($0, "bytes")
                costs[method] = sprintf(" %.0f | %.0f | %d | %s |", value($0, "ns_per_sample"),
                    value($0, "ns_per_query"), value($0, "cells"),
                    bytes == "" ? "not told" : bytes + 0 > 0 ? sprintf("%.0f", bytes / 1024) : "-")
            } else if (value($0, "target_ns") + 0 > 0) {
                ns = value($0, "ns")
                goal = value($0, "target_ns")
                digits = ns + 0 < 20 ? 1 : 0
                rows = rows sprintf("| %s | %.*f | %.*f | %.0f %% | %s | %.2fx | %s%s |\n", value($0, "name"), digits, ns,
                    digits, value($0, "median_ns"), 100 * value($0, "spread"),
                    value($0, "naive_ns") + 0 > 0 ? sprintf("%.1fx", value($0, "naive_ns") / ns) : "-",
                    ns / value($0, "limit_ns"), goal + 0, ns + 0 <= goal + 0 ? "" : ", missed")
            }
            next
        }
        $0 == "<!-- " name " -->" {
            print
            if (text) {
                printf "%s\n", text
                skip = 1
                next
            }
            if (methods) {
                printf "\n%s.\n\n| method |%s ns/sample | ns/query | cells | KiB |\n|---|", machine, sizes
                for (i = gsub(/\|/, "|", sizes) + 4; i > 0; --i) printf "---|"
                for (i = 1; i <= methods; ++i) printf "\n| `%s` |%s%s", order[i], scores[order[i]], costs[order[i]]
                printf "\n\n"
                skip = 1
                next
            }
            printf "\n%s.\n\n| kernel | min ns | median | spread | faster than naive | over the limit | goal |\n", machine
            printf "|---|---|---|---|---|---|---|\n%s\n", rows
            skip = 1
            next
        }
        $0 == "<!-- end -->" { skip = 0 }
        !skip { print }' "$json" "$readme" >"$readme.new" && mv "$readme.new" "$readme" || exit 1
    echo "$readme: what is in $name rewritten"
done
