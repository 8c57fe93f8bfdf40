#!/usr/bin/env bash
# Does the measuring rig see what it is for? One renderer against itself must pass; against one that takes twice the time,
# and against one whose light is 3 % too bright, flags must go up; a renderer that crashes must not stop the rest; an
# interrupted run must go on. Speaks TAP.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
build=${BUILD:-build}
rig=$build/bench_error render=$build/render reference=$build/make_reference
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
log=$tmp/log
. tests/tap.sh

# Half the budget, and twice the time said to be spent: what a renderer of half the speed would do.
cat >"$tmp/slow" <<SH
#!/usr/bin/env bash
arguments=() json=
while [ \$# -gt 0 ]; do
    case \$1 in
    --seconds) arguments+=("\$1" "\$(awk "BEGIN { print \$2 / 2 }")") && shift ;;
    --json) json=\$2 && arguments+=("\$1" "\$2") && shift ;;
    *) arguments+=("\$1") ;;
    esac
    shift
done
"$render" "\${arguments[@]}" || exit 1
awk '/"cpu_seconds": [0-9.]+,\$/ && !done { sub(/[0-9.]+,\$/, 2 * \$2 ","); done = 1 } { print }' "\$json" >"\$json.new" &&
    mv "\$json.new" "\$json"
SH
cat >"$tmp/bright" <<SH
#!/usr/bin/env bash
sed 's/"12, 10.5, 8"/"12.36, 10.815, 8.24"/' examples/scenes/cornell.xml >"$tmp/bright\$\$.xml"
shift
exec "$render" "$tmp/bright\$\$.xml" "\$@"
SH
cat >"$tmp/crash" <<SH
#!/usr/bin/env bash
case " \$* " in *" sdtree "*) kill -SEGV \$\$ ;; esac
exec "$render" "\$@"
SH
chmod +x "$tmp/slow" "$tmp/bright" "$tmp/crash"
"$render" examples/scenes/cornell.xml --spp 64 --size 160x90 --quiet -o "$tmp/cornell.exr" || exit 1

# rig NAME BUILD ARGUMENTS...: status in $status, words in $tmp/log. One render at a time: two builds at once run on
# processors that may differ in speed by a fifth.
measure() {
    local out=$tmp/out-$1 other=$2
    shift 2
    "$rig" --jobs 1 --scenes cornell --size 160x90 --references "$tmp" --builds "a=$render,b=$other" --out "$out" "$@" \
        >"$tmp/log" 2>&1
    status=$?
}

measure same "$render" --seconds 2 --seeds 3 --methods pt
[ $status -eq 0 ] && ! grep -qE 'SLOWER|BIASED|WORSE' "$tmp/log"
report $? 'a renderer against itself: no flag'
measure slow "$tmp/slow" --seconds 2 --seeds 3 --methods pt
[ $status -eq 2 ] && grep -q SLOWER "$tmp/log" && ! grep -q BIASED "$tmp/log"
report $? 'half the speed: called slower, not biased'
measure bright "$tmp/bright" --seconds 2 --seeds 3 --methods pt,sdtree
[ $status -eq 2 ] && [ "$(grep -c BIASED "$tmp/log")" -eq 2 ] && ! grep -q SLOWER "$tmp/log"
report $? 'light 3 % too bright: called biased for both methods, not slower'
cp "$tmp/log" "$tmp/log-bright"
measure crash "$tmp/crash" --spp 4 --seeds 1 --methods pt,sdtree
[ "$(grep -c ',ok,' "$tmp/out-crash/rows.csv")" -eq 3 ] && grep -q ',b,sdtree,4spp,1,signal 11,' "$tmp/out-crash/rows.csv"
report $? 'a crash marks its row and the rest goes on'
grep -q 'sdtree against pt: .* tiles used, untested' "$tmp/log" && ! grep -q trusted "$tmp/log" &&
    grep -q 'sdtree against pt: .* tiles trusted' "$tmp/log-bright"
report $? 'variances of one picture are called untested, those of three are tested'

# Cut a row in half, as a lost machine would: it is rendered again, the others are not.
csv=$tmp/out-same/rows.csv
cp "$csv" "$tmp/whole.csv"
head -c -20 "$tmp/whole.csv" >"$csv"
measure same "$render" --seconds 2 --seeds 3 --methods pt
grep -q '^1 renders to do' "$tmp/log" && [ "$(wc -l <"$csv")" -eq "$(wc -l <"$tmp/whole.csv")" ] &&
    [ "$(head -n -1 "$csv")" = "$(head -n -1 "$tmp/whole.csv")" ]
report $? 'an interrupted run goes on where it stopped'
measure same "$render" --seconds 2 --seeds 3 --methods pt --max-depth 5
[ $status -eq 1 ] && grep -q 'made with other settings' "$tmp/log"
report $? 'rows of other settings are not mixed'
"$rig" --scenes nowhere --out "$tmp/out-none" >"$tmp/log" 2>&1
[ $? -eq 1 ] && grep -q 'no such scene.*nowhere' "$tmp/log"
report $? 'a scene that is not there is named'
for picture in error-seconds-cornell error-spp-cornell cost; do
    grep -q '</svg>' "$tmp/out-same/$picture.svg" || status=9
done
[ $status -ne 9 ] && grep -q '"relmse": ' "$tmp/out-same/rows.json" && grep -q '^| cornell | 2s | pt (b) |' "$tmp/out-same/table.md"
report $? 'plots, JSON and a table are written'

# A reference that tells its own error, at twice the picture's size: a quarter of it is in the rows.
mkdir "$tmp/known"
"$reference" examples/scenes/cornell.xml --size 64x36 --round-spp 2 --check-spp 2 --rounds 16 --measured 1 --quiet \
    --state "$tmp/state" -o "$tmp/known/cornell.exr" >"$tmp/log" 2>&1
"$rig" --jobs 1 --scenes cornell --size 32x18 --references "$tmp/known" --builds "a=$render" --out "$tmp/out-known" --spp 2 --seeds 1 \
    --methods pt,sdtree >"$tmp/log" 2>&1
own=$(tr -c '[:print:]' '\n' <"$tmp/known/cornell.exr" | sed -n 's/.*\(0\.[0-9]*\) (untrimmed.*/\1/p')
awk -F, -v own="$own" 'NR == 2 { for (i = 1; i <= NF; ++i) if ($i == "reference_relmse") at = i }
    NR == 3 { good = own > 0 && $at > 0.249 * own && $at < 0.251 * own } END { exit !good }' "$tmp/out-known/rows.csv" &&
    grep -qE '^\| cornell \| 2spp \| sdtree .* \| [0-9.]+ \| [0-9.]+ \| [0-9.]+x \|$' "$tmp/out-known/table.md"
report $? "the reference's own error, at the size of the picture"

# A training is a budget's first number, and the axis of the plots; what does not learn goes without.
measure trained "$render" --train 2,4 --spp 4 --seeds 2 --methods pt,sdtree:denoise=off,sdtree
table=$tmp/out-trained/table.md
cp "$table" "$tmp/log"
[ $status -eq 0 ] && [ "$(grep -c ',ok,' "$tmp/out-trained/rows.csv")" -eq 24 ] && [ -s "$tmp/out-trained/error-train-cornell.svg" ] &&
    grep -qE '^\| cornell \| 2\+4spp \| pt \(a\) \| 4 \|' "$table" &&
    grep -qE '^\| cornell \| 4\+4spp \| sdtree:denoise=off \(a\) \| 4 \| [0-9.]+ \| [0-9.]+ \| 0\.00 % \|' "$table" &&
    grep -qE '^\| cornell \| 4\+4spp \| sdtree \(a\) \| 4 \| [0-9.]+ \| [0-9.]+ \| [0-9.]*[1-9][0-9]* % \|' "$table"
report $? '--train: rows, plots, and the share of the denoise step'
# Geometric mean over scenes: that of one scene, value and interval, is that scene's.
[ "$(grep -c '| 4+4spp |' "$table")" -eq 11 ] &&
    [ "$(grep '^| cornell | 4+4spp | sdtree (a) ' "$table" | cut -d '|' -f 10)" = "$(grep '^| 4+4spp | sdtree (a) ' "$table" | cut -d '|' -f 5)" ]
report $? 'the geometric mean over one scene is that of the scene, and so is its interval'

# The study of splits: its means are those of the rows, smaller thresholds make more cells, the field that only takes the
# time has the same cells, and what was rendered is not rendered again.
study() {
    "$build/study_kd" --preset tiny --out "$tmp/study" --only thresholds,resolution "$@" >"$tmp/log" 2>&1
    status=$?
}
study
csv=$tmp/study/study_kd.csv
awk -F, '
    function close_to(a, b) { return a > b * 0.9999 && a < b * 1.0001 }
    FNR == 1 || /^#/ { next }
    FILENAME ~ /rows.csv/ { if ($1 == "scene") next; key = $1 "," $3; sum[key] += log($15); n[key]++; next }
    $1 == "thresholds" { lines++; key = $2 "," $7; ok += n[key] == 2 && $8 == 2 && close_to($9, exp(sum[key] / 2))
        if ($6 != "signatures") { more += $15 > cells[$2]; cells[$2] = $15 }
        ahead += ($6 == "signatures") == ($18 > 0) }
    END { print lines, ok, more, ahead; exit !(lines == 12 && ok == 12 && more == 10 && ahead == 12) }
' "$tmp/study/80x45-nee-on/rows.csv" "$csv" >>"$tmp/log" && [ $status -eq 0 ] &&
    awk '/"cells": / { cells = $2 + 0 } /"structure_cells": / { sub(/.*"structure_cells": /, ""); exit $0 + 0 != cells || !cells }' \
        "$tmp"/study/80x45-nee-on/pictures/cornell-render-kd_time_structure_on-8+4spp-1.json
report $? 'study_kd: means of the rows, cells by thresholds, the same cells without mixtures'
grep -q '^| pool | .* % |$' "$tmp/study/study_kd.md" && grep -q '^MRAE at most 1.02 .* of 2 lines' "$tmp/study/study_kd.md" &&
    [ -s "$tmp/study/cells-pool.png" ] && grep -q '</svg>' "$tmp/study/mrae-cells-pool.svg" &&
    grep -q '"nee": "on".*"mrae_95": \[' "$tmp/study/study_kd.json"
report $? 'study_kd: tables, plots and pictures of cells are written'
cp "$csv" "$tmp/first.csv"
study
[ $status -eq 0 ] && [ "$(grep -c ': 0 renders to do' "$tmp/log")" -eq 3 ] && cmp "$csv" "$tmp/first.csv" >>"$tmp/log"
report $? 'study_kd: a second run renders nothing and says the same'

finish
