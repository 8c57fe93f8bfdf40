#!/bin/sh
# Render the ajar scene without and with guiding at equal CPU seconds, and print what each reached.
# Environment: BUILD folder, SECONDS_EACH (CPU seconds a method), SIZE (WxH), OUT folder.
BUILD=${BUILD:-build} SECONDS_EACH=${SECONDS_EACH:-40} SIZE=${SIZE:-320x180} OUT=${OUT:-out/demo}
cd "$(dirname "$0")/.." || exit 1
scene=examples/scenes/ajar.xml
reference=examples/scenes/references/ajar.exr
mkdir -p "$OUT" || exit 1

# A reference helps only where the wanted size divides its own.
width=${SIZE%x*} height=${SIZE#*x}
if [ -e $reference ] && [ $((320 % width)) -eq 0 ] && [ $((180 % height)) -eq 0 ] &&
    [ $((320 / width)) -eq $((180 / height)) ]; then
    measure="--reference $reference"
else
    measure=
fi

for method in pt sdtree; do
    echo "ajar, $method, $SECONDS_EACH CPU seconds, $SIZE"
    # $measure is two words or none.
    "$BUILD/render" $scene --method $method --seconds "$SECONDS_EACH" --size "$SIZE" $measure \
        -o "$OUT/$method.exr" --png "$OUT/$method.png" --json "$OUT/$method.json" || exit 1
done

# value FILE KEY: the first "key": value of a JSON file that holds one key per line.
value() {
    v=$(sed -n "s/^[[:space:]{]*\"$2\"[[:space:]]*:[[:space:]]*\"\{0,1\}\([^\",}]*\).*/\1/p" "$1" | head -n 1)
    case $v in '' | null) echo - ;; *) echo "$v" ;; esac
}

printf '\n%-8s %8s %8s %10s %10s %8s %8s\n' method spp 'CPU s' relMSE MRAE cells MB
for method in pt sdtree; do
    f=$OUT/$method.json
    echo "$(value "$f" method) $(value "$f" spp) $(value "$f" cpu_seconds) $(value "$f" relmse) $(value "$f" mrae)" \
        "$(value "$f" cells) $(value "$f" bytes)"
done | awk '
    function number(x, format) { return x == "-" ? "-" : sprintf(format, x) }
    { printf "%-8s %8s %8s %10s %10s %8s %8s\n", $1, $2, number($3, "%.1f"), number($4, "%.4g"), number($5, "%.4g"),
        $6 == 0 ? "-" : $6, $7 == 0 ? "-" : number($7 == "-" ? "-" : $7 / 1e6, "%.1f") }'

if [ -n "$measure" ]; then
    "$BUILD/imgerr" --compare "$OUT/compare.png" "$OUT/pt.exr" pt "$OUT/sdtree.exr" sdtree $reference reference ||
        exit 1
else
    "$BUILD/imgerr" --compare "$OUT/compare.png" "$OUT/pt.exr" pt "$OUT/sdtree.exr" sdtree || exit 1
fi
printf '\npictures: %s\n' "$OUT/compare.png, $OUT/*.png, $OUT/*.exr"
