#!/usr/bin/env bash
# The programs' command lines: what they refuse, what they say, what they write. Speaks TAP.
# Each case runs $program of $BUILD, the renderer at first, on tiny scenes written here; exit 1 with a message is asked
# for, never a signal.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
render=$PWD/${BUILD:-build}/render
imgerr=$PWD/${BUILD:-build}/imgerr
field=$PWD/${BUILD:-build}/bench_field
fields=$PWD/bench/fields
make_reference=$PWD/${BUILD:-build}/make_reference
train_histogram=$PWD/${BUILD:-build}/train_histogram
program=$render
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT
log=$tmp/log
. tests/tap.sh
cd "$tmp" || exit 1

# refuses NAME PATTERN ARGUMENTS...: exit status 1 and a message on stderr that matches PATTERN (extended, any case).
refuses() {
    local name=$1 pattern=$2 status
    shift 2
    "$program" "$@" >out 2>log
    status=$?
    if [ $status -ne 1 ]; then
        why="exit status $status, wanted 1" && report 1 "$name"
    else
        grep -qiE -- "$pattern" log
        status=$? why="no message matching: $pattern"
        report $status "$name"
    fi
}
# completes NAME ARGUMENTS...: exit status 0.
completes() {
    local name=$1 status
    shift
    "$program" "$@" >out 2>log
    status=$? why="exit status $status, wanted 0"
    [ $status -eq 0 ]
    report $? "$name"
}

# scene FILE [BODY] [FILM]: a lit quad before the camera, with BODY added on line 3.
scene() {
    cat >"$1" <<XML
<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  ${2-}
  <sensor type="perspective"><float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="${3-32}"/><integer name="height" value="18"/></film></sensor>
  <shape type="rectangle"><bsdf type="diffuse"/></shape>
  <shape type="sphere"><point name="center" x="0" y="2" z="2"/><float name="radius" value="0.5"/>
    <emitter type="area"><rgb name="radiance" value="4,4,4"/></emitter></shape>
</scene>
XML
}
scene good.xml
quick="--spp 2 --quiet"

# ---- options
refuses 'no arguments: says how to get help' 'scene.*help|usage'
refuses 'no scene' 'scene|usage' --method pt --spp 1
refuses 'missing scene file names it' 'absent\.xml' absent.xml $quick
refuses 'unknown option names it' 'frobnicate' good.xml --frobnicate $quick
refuses 'option without its value' 'method' good.xml --method
refuses 'unknown method names it' 'nosuch' good.xml --method nosuch $quick
if "$render" --help | grep -q '^ *openpgl .*not built'; then
    refuses 'openpgl where it is not built: says how' 'openpgl.*not built.*make OPENPGL_DIR=' good.xml --method openpgl $quick
else
    completes 'openpgl where it is built: renders' good.xml --method openpgl $quick -o openpgl.exr
fi
refuses 'unknown --set key names it' 'nokey' good.xml --method sdtree --set nokey=1 $quick
refuses '--set on a method without options' 'nokey' good.xml --method pt --set nokey=1 $quick
refuses '--set without =' 'set' good.xml --method sdtree --set nokey $quick
refuses 'bad number: spp' 'spp' good.xml --spp ten --quiet
refuses 'bad number: trailing text' 'spp' good.xml --spp 10x --quiet
refuses 'bad number: zero spp' 'spp' good.xml --spp 0 --quiet
refuses 'bad number: negative spp' 'spp' good.xml --spp -3 --quiet
refuses 'bad number: too large' 'spp' good.xml --spp 99999999999999999999 --quiet
refuses 'bad number: seconds' 'seconds' good.xml --seconds soon --quiet
refuses 'bad number: seconds nan' 'seconds' good.xml --seconds nan --quiet
refuses 'bad number: threads' 'threads' good.xml --threads two $quick
refuses 'bad number: seed' 'seed' good.xml --seed x $quick
refuses 'bad number: max depth' 'depth' good.xml --max-depth deep $quick
refuses 'bad size: words' 'size' good.xml --size large $quick
refuses 'bad size: one number' 'size' good.xml --size 32 $quick
refuses 'bad size: 0x0' 'size' good.xml --size 0x0 $quick
refuses 'bad size: too large' 'size|large|memory' good.xml --size 2000000000x2000000000 $quick
refuses 'bad switch: nee' 'nee' good.xml --nee perhaps $quick
refuses 'bad switch: roulette' 'rr' good.xml --rr perhaps $quick
refuses 'spp and seconds together' 'spp|seconds' good.xml --spp 1 --seconds 1 --quiet
refuses 'two scenes' 'good\.xml.*other\.xml' good.xml other.xml $quick
refuses 'bad number: zero training' 'train.*0' good.xml --method sdtree --train 0 $quick
refuses '--train on a method that does not learn' 'train.*pt' good.xml --train 4 $quick
refuses '--train that takes all of the seconds' 'training.*seconds' good.xml --method sdtree --train 64 --seconds 0.001 --quiet
refuses 'denoise_when=last without a training' 'denoise_when.*--train' good.xml --method sdtree --set denoise_when=last $quick
refuses 'denoise_when=last without denoising' 'denoise_when.*denoise=on' good.xml --method sdtree --train 4 --set denoise=off \
    --set denoise_when=last $quick
refuses 'save without a training' 'save.*--train' good.xml --method sdtree --set save=never.gsd $quick
refuses 'compare without a training' 'compare.*--train' good.xml --method sdtree --set compare=good.xml $quick
refuses 'compare with what is no field' 'compare.*save=FILE' good.xml --method sdtree --train 4 --set compare=good.xml $quick
completes '--help' --help
grep -q -- '--method' out && grep -q -- '--seconds' out
report $? '--help lists the options'

# ---- scene files: error or warning with file and line
printf '<scene version="3.0.0">\n  <shape type="sphere">\n</scene>\n' >broken.xml
refuses 'broken XML: file and line' 'broken\.xml:3' broken.xml $quick
: >empty.xml
refuses 'empty file' 'empty\.xml' empty.xml $quick
printf '<other/>\n' >other.xml
refuses 'not a scene' 'other\.xml:1' other.xml $quick
scene number.xml '<shape type="sphere"><float name="radius" value="wide"/></shape>'
refuses 'bad number in a scene: file and line' 'number\.xml:3' number.xml $quick
scene unknown.xml '<gizmo name="x" value="1"/>'
completes 'unknown element: renders' unknown.xml $quick -o unknown.exr
grep -qE 'unknown\.xml:3.*warning.*gizmo|warning.*unknown\.xml:3.*gizmo' log
report $? 'unknown element: warning with file and line'
scene plugin.xml '<shape type="blob"/>'
completes 'unknown shape: renders' plugin.xml $quick
grep -qE 'plugin\.xml:3.*blob' log
report $? 'unknown shape: warning with file and line'
scene mesh.xml '<shape type="ply"><string name="filename" value="absent.ply"/></shape>'
"$render" mesh.xml $quick >out 2>log
status=$? why="exit status $status"
[ $status -le 1 ] && grep -qE 'mesh\.xml:3' log && grep -q 'absent\.ply' log
report $? 'missing mesh: message with file and line'
scene zero.xml '' 0
"$render" zero.xml $quick >out 2>log
status=$? why="exit status $status"
[ $status -eq 1 ] && grep -qiE 'zero\.xml:6|zero\.xml.*(width|size)' log
report $? 'film of 0 pixels: error with file'
scene undefined.xml '<shape type="sphere"><float name="radius" value="$nothing"/></shape>'
refuses 'undefined $variable: file and line' 'undefined\.xml:3.*nothing' undefined.xml $quick
scene define.xml '<default name="r" value="0.1"/><shape type="sphere"><point name="center" x="0" y="0" z="1"/><float name="radius" value="$r"/><bsdf type="diffuse"/></shape>'
completes '-D: renders' define.xml $quick -D r=0.9 -o define1.exr
completes '-D: default' define.xml $quick -o define2.exr
! cmp -s define1.exr define2.exr
report $? '-D changes the picture'

# ---- outputs
completes 'writes an image' good.xml --spp 4 --quiet --threads 1 -o one.exr --png one.png --json one.json
[ "$(head -c 4 one.exr | od -An -tx1 | tr -d ' ')" = 762f3101 ]
report $? 'EXR begins with its magic number'
[ "$(head -c 4 one.png | od -An -tx1 | tr -d ' ')" = 89504e47 ]
report $? 'PNG begins with its magic number'
cp one.json log 2>/dev/null
for key in method spp cpu_seconds wall_seconds cells bytes samples; do
    grep -q "^[[:space:]]*\"$key\"[[:space:]]*:" one.json
    report $? "JSON has \"$key\", on a line of its own"
done
[ "$(grep -c '{' one.json)" -ge 1 ] && [ "$(tr -cd '{' <one.json | wc -c)" = "$(tr -cd '}' <one.json | wc -c)" ] &&
    ! grep -qE '\b(nan|inf)\b' one.json
report $? 'JSON: braces match, no nan or inf'
completes 'writes what photons bring' good.xml --spp 1 --quiet --size 32x18 --photon-png photons.png
[ "$(head -c 4 photons.png | od -An -tx1 | tr -d ' ')" = 89504e47 ] && ! cmp -s photons.png one.png
report $? 'PNG of photons begins with its magic number'
completes '--reference: measures' good.xml --spp 4 --quiet --seed 7 --reference one.exr --json ref.json
cp ref.json log 2>/dev/null
grep -qE '"relmse"[[:space:]]*:[[:space:]]*[0-9]' ref.json && grep -qE '"mrae"[[:space:]]*:[[:space:]]*[0-9]' ref.json
report $? 'JSON has relmse and mrae with a reference'
completes '--reference larger than the picture' good.xml --spp 2 --quiet --size 16x9 --reference one.exr
refuses '--reference of another shape' 'one\.exr|size' good.xml $quick --size 20x20 --reference one.exr
refuses '--reference missing' 'absent\.exr' good.xml $quick --reference absent.exr
printf 'not an image' >bad.exr
refuses '--reference unreadable' 'bad\.exr' good.xml $quick --reference bad.exr
refuses 'unwritable output names it' 'absent/x\.exr' good.xml $quick -o absent/x.exr
refuses 'unwritable PNG names it' 'absent/x\.png' good.xml $quick --png absent/x.png
refuses 'unwritable PNG of photons names it' 'absent/y\.png' good.xml $quick --photon-png absent/y.png
refuses 'unwritable JSON names it' 'absent/x\.json' good.xml $quick --json absent/x.json

# ---- the same picture for any number of threads
for method in pt sdtree; do
    for threads in 1 2 3; do
        "$render" good.xml --method $method --spp 15 --size 80x45 --threads $threads --quiet -o $method$threads.exr >out 2>log ||
            : >$method$threads.exr
    done
    [ -s ${method}1.exr ] && cmp ${method}1.exr ${method}2.exr >>log 2>&1 && cmp ${method}1.exr ${method}3.exr >>log 2>&1
    report $? "$method: identical for 1, 2 and 3 threads"
    rm -f seed.exr
    "$render" good.xml --method $method --spp 15 --size 80x45 --seed 99 --quiet -o seed.exr >out 2>log
    [ -s seed.exr ] && ! cmp -s ${method}1.exr seed.exr
    report $? "$method: another seed, another picture"
done
# A trained field: the same picture for any number of threads; denoised after the training, it has learned from the same
# samples as one that never is, and is another.
train="good.xml --method sdtree --size 80x45 --train 12 --spp 8 --quiet"
for threads in 1 2 3; do
    "$render" $train --threads $threads --set denoise_when=last -o last$threads.exr --json last.json >out 2>log || : >last$threads.exr
done
[ -s last1.exr ] && cmp last1.exr last2.exr >>log 2>&1 && cmp last1.exr last3.exr >>log 2>&1
report $? '--train: identical for 1, 2 and 3 threads'
"$render" $train --set denoise=off -o never.exr --json never.json >out 2>log
learned() { grep -o '"zeros": [0-9]*, "rejected": [0-9]*' "$1"; }
cat last.json never.json >log
[ -n "$(learned never.json)" ] && [ "$(learned last.json)" = "$(learned never.json)" ] && ! cmp -s last1.exr never.exr
report $? 'denoise_when=last: the training of denoise=off, another field'
grep -q '"spp": 8,' last.json && grep -q '"train_spp": 12,' last.json && grep -q '"denoise_seconds": [0-9]' last.json &&
    awk '/"cpu_seconds"/ && !all { all = $2 + 0 } /"train_seconds"/ { sum += $2 } /"render_seconds"/ { sum += $2 }
        END { exit !(all > 0 && sum > 0.999 * all && sum < 1.001 * all) }' last.json
report $? '--train: JSON tells the training and the picture apart, their seconds add up'
# Fields compared by the same samples: one is as good as itself, and what another gains over it is lost the other way.
for when in last never; do
    [ $when = last ] && set=denoise_when=last || set=denoise=off
    "$render" $train --set $set --set save=$when.gsd -o x.exr >out 2>log
done
for when in last never; do
    [ $when = last ] && set=denoise_when=last || set=denoise=off
    "$render" $train --set $set --set compare=last.gsd,never.gsd -o x.exr --json $when.json >out 2>log
done
compared() { sed -n 's/.*"compared": \[\([^,]*\), \([^]]*\)\].*/\1 \2/p' $1.json; }
{ compared last && compared never; } | tee log |
    awk '{ a[NR] = $1; b[NR] = $2 }
        END { exit !(NR == 2 && a[1] > 0.9999 && a[1] < 1.0001 && b[2] > 0.9999 && b[2] < 1.0001 && b[1] != 1 && b[1] * a[2] > 0.98 && b[1] * a[2] < 1.02) }'
report $? 'compare: ratios of fields by the same samples'
completes '--train with a budget in seconds' good.xml --method sdtree --train 2 --seconds 0.5 --quiet
completes '--quiet says nothing' good.xml $quick -o quiet.exr
[ ! -s out ] && [ ! -s log ]
report $? '--quiet leaves stdout and stderr empty'
completes 'a budget in seconds ends' good.xml --method sdtree --seconds 0.5 --quiet -o seconds.exr

# ---- imgerr
"$imgerr" one.exr one.exr >out 2>log
status=$?
cp out log
[ $status -eq 0 ] && grep -qiE 'relmse[^0-9]*0(\.0*)?([^.0-9]|$)' out
report $? 'imgerr: an image has no error against itself'
"$imgerr" one.exr absent.exr >out 2>log
[ $? -eq 1 ] && grep -q 'absent\.exr' log
report $? 'imgerr: missing file is named'
"$imgerr" bad.exr one.exr >out 2>log
[ $? -eq 1 ] && grep -q 'bad\.exr' log
report $? 'imgerr: unreadable file is named'
"$imgerr" --regions one.exr one.exr 5 >out 2>log
[ $? -eq 0 ] && grep -qx 'all 1\.0000  lowest 1\.0000  highest 1\.0000' out
report $? 'imgerr: regions of an image have the means of themselves'
"$imgerr" --regions one.exr one.exr -5 >out 2>log
[ $? -eq 1 ] && grep -q 'bad clamp "-5"' log
report $? 'imgerr: a bad clamp is named'
for n in 64 1000000; do # many cells, and one
    "$render" good.xml --method kd --set split=count --set count=$n --spp 8 --quiet -o kd$n.exr &&
        "$imgerr" --cells kd$n.png kd$n.exr cells || break
done >out 2>log
"$imgerr" --cells again.png kd64.exr cells >>out 2>>log && cmp kd64.png again.png && ! cmp -s kd64.png kd1000000.png
report $? 'imgerr: cells in false colours'
"$imgerr" --cells cells.png kd64.png none >out 2>log
[ $? -eq 1 ] && [ ! -e cells.png ] && [ -s log ]
report $? 'imgerr: no picture of cells where there is no such layer'
"$imgerr" >out 2>log
[ $? -eq 1 ] && grep -qi usage log
report $? 'imgerr: usage'

# ---- bench_field
# field_refuses NAME PATTERN ARGUMENTS...: as refuses, for bench_field.
field_refuses() { program=$field refuses "$@"; }
field_refuses 'bench_field: missing file is named' 'absent\.txt: .*--fields' --fields absent.txt
printf '# one\ncentre .5 .5 .5 radius .1 strength 2\ncentre .5 .5 radius .1 strength 2\n' >bad.txt
field_refuses 'bench_field: missing number: file, line and form' 'bad\.txt:3: "centre" wants 1 more.*a line is: centre' --fields bad.txt
printf 'centre .5 .5 .5 radius 0 strength 2\n' >bad.txt
field_refuses 'bench_field: radius out of range' 'bad\.txt:1: "radius" wants' --fields bad.txt
printf 'centre .5 .5 .5 radius .1 strength nan\n' >bad.txt
field_refuses 'bench_field: not a number' 'bad\.txt:1: "strength" wants.*"nan"' --fields bad.txt
printf 'centre .5 .5 .5 radius .1 strength 2 visible 1 0 0 -.5 1\n' >bad.txt
field_refuses 'bench_field: text after the last number' 'bad\.txt:1: nothing may follow' --fields bad.txt
printf '# nothing\n' >bad.txt
field_refuses 'bench_field: no source' 'bad\.txt:1: no source' --fields bad.txt
field_refuses 'bench_field: unknown method is named' 'nosuch.*--help' --methods nosuch
field_refuses 'bench_field: bad number of samples' '--samples wants.*"ten"' --samples ten
field_refuses 'bench_field: --fields without a file' '--fields wants' --fields --exact
field_refuses 'bench_field: unwritable JSON is named' 'absent/x\.json' --json absent/x.json
# A and C of each row.
scores() { sed -n 's/.*"a": \([^,]*\), "c": \([^,]*\),.*/\1 \2/p' "$1"; }
"$field" --methods sdtree --seeds 1 --samples 10 --fields sf1 "$fields/sf1.txt" "$fields/small.txt" --json field.json >out 2>log
status=$?
scores field.json >log
[ $status -eq 0 ] && [ "$(wc -l <log)" -eq 3 ] && [ "$(sed -n 1p log)" = "$(sed -n 2p log)" ] &&
    [ "$(sed -n 1p log)" != "$(sed -n 3p log)" ]
report $? 'bench_field: sf1.txt is the field that is built in, small.txt another'
# ---- make_reference: 12 rounds of the method and 4 of the check are the least that can be checked
program=$make_reference
mkdir whole parts killed biased same
refuses 'make_reference: no output' '-o|--cache' good.xml
refuses 'make_reference: a method cannot check itself' 'check.*pt' good.xml -o r.exr --method pt
refuses 'make_reference: unknown check' 'nosuch' good.xml -o r.exr --check nosuch
refuses 'make_reference: bad ratio' 'ratio.*-2' good.xml -o r.exr --ratio -2
refuses 'make_reference: bad size' 'size' good.xml -o r.exr --size 64
refuses 'make_reference: missing scene' 'absent\.xml' absent.xml -o r.exr
refuses 'make_reference: unwritable output, before any round' 'absent/r\.exr' good.xml -o absent/r.exr --state parts
refuses 'make_reference: broken scene' 'broken\.xml:3' broken.xml -o r.exr --state parts --round-spp 1
make_options="--size 64x36 --round-spp 8 --check-spp 8 --quiet --measured 0.5"
make="good.xml $make_options"
completes 'make_reference: as good as asked for' $make --state whole -o whole/r.exr --rounds 16 --ratio 2
grep -aq 'make_reference good.xml --size 64x36.*--rounds 16.*-o r.exr' whole/r.exr && grep -aq '96 spp = 12 rounds of 8' whole/r.exr
report $? 'make_reference: the header tells the command and the samples'
"$imgerr" whole/r.exr whole/r.exr >out 2>log
report $? 'make_reference: the picture can be read'
"$program" $make --state parts -o parts/r.exr --rounds 5 --ratio 2 --threads 1 >out 2>log
[ $? -eq 2 ] && grep -q 'not checked' log
report $? 'make_reference: too few rounds are told by exit status 2'
completes 'make_reference: goes on' $make --state parts -o parts/r.exr --rounds 16 --ratio 2 --threads 2
cmp whole/r.exr parts/r.exr >log 2>&1
report $? 'make_reference: interrupted, the same picture'
"$program" $make --state killed -o killed/r.exr --rounds 16 --ratio 2 >out 2>log &
sleep 0.1
kill -9 $! 2>/dev/null
wait $! 2>/dev/null
completes 'make_reference: goes on after being killed' $make --state killed -o killed/r.exr --rounds 16 --ratio 2
cmp whole/r.exr killed/r.exr >log 2>&1
report $? 'make_reference: killed, the same picture'
"$program" $make --state whole -o whole/far.exr --rounds 16 --ratio 1e6 >out 2>log
[ $? -eq 2 ] && grep -q 'not good enough' log && grep -aq 'not reached' whole/far.exr
report $? 'make_reference: a reference that is not good enough says so'
completes 'make_reference: --add takes an earlier picture in' $make --state parts -o parts/sum.exr --rounds 16 --ratio 2 \
    --seed 2 --add whole/r.exr
"$imgerr" parts/sum.exr whole/r.exr >out 2>log && grep -aq 'weight 0\.[345].*--seed 1000000 ' parts/sum.exr
report $? 'make_reference: the header tells what was added'
refuses 'make_reference: the same rounds are not added twice' 'seed 1000000.*choose another' $make --state parts -o parts/no.exr \
    --add parts/sum.exr
refuses 'make_reference: a picture of other settings is not added' "is of 'good.xml --size 64x36', not of" $make --seed 2 \
    --max-depth 3 --state parts -o parts/no.exr --add whole/r.exr
mkdir bright
sed 's/4,4,4/9,9,9/' good.xml >bright/good.xml
refuses 'make_reference: a picture of another scene is not added' 'differs from the rounds' bright/good.xml $make_options --seed 2 \
    --state parts -o parts/no.exr --rounds 16 --add whole/r.exr
"$render" good.xml --size 64x36 --spp 1 -o plain.exr >out 2>log
refuses 'make_reference: only a reference is added' 'does not tell its own error' $make --state parts -o parts/no.exr --seed 2 \
    --add plain.exr
sed 's/4,4,4/4,4,4.2/' good.xml >brighter.xml
refuses 'make_reference: a check with more blue light refuses' 'not written.*differ' $make --state biased -o biased/r.exr \
    --check-scene brighter.xml --rounds 16 --ratio 2
[ -s biased/r-check.png ] && [ ! -e biased/r.exr ] && grep -q 'tile at pixel' log
report $? 'make_reference: where they differ is shown, and no picture written'
completes 'make_reference: the same scene in another file agrees' $make --state same -o same/r.exr --ratio 2 \
    --check-scene ./good.xml --rounds 16
refuses 'make_reference: other samples per round than the state' 'state: has rounds of 8.*--round-spp' \
    good.xml --size 64x36 --round-spp 9 --state whole -o whole/r.exr
cp whole/*.state whole.bin
cp same/*.state "$(echo whole/*.state)"
refuses 'make_reference: a state of other settings' 'state: belongs to another' $make --state whole -o whole/r.exr
head -c 5000 whole.bin >"$(echo whole/*.state)"
refuses 'make_reference: a damaged state' 'state: damaged' $make --state whole -o whole/r.exr
completes 'make_reference: --cache' $make --state parts --cache --rounds 16 --ratio 2
[ -s "$(echo parts/????????????????.exr)" ]
report $? 'make_reference: --cache names the picture by its settings'
[ -e parts/fafce9b887b3aa38.state ]
report $? 'make_reference: the state of a scene without other files keeps its name'
# Rounds of a scene must not be added to those of the scene before one of its files changed.
scene files.xml '<include filename="inner.xml"/>'
echo '<scene><shape type="obj"><string name="filename" value="t.obj"/></shape></scene>' >inner.xml
printf 'v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n' >t.obj
made=0
for change in none s/1/2/ s/0/3/; do
    [ $change = none ] || sed -i.bak "1,2$change" t.obj
    "$program" files.xml --size 8x8 --round-spp 1 --check-spp 1 --rounds 1 --quiet --measured 1 --state files -o f.exr >out 2>log
    ls files >>log
    [ "$(ls files/*.state | wc -l)" -eq $((made += 1)) ] || made=-9
done
echo '<scene/>' >inner.xml
"$program" files.xml --size 8x8 --round-spp 1 --check-spp 1 --rounds 1 --quiet --measured 1 --state files -o f.exr >out 2>>log
[ "$(ls files/*.state | wc -l)" -eq 4 ] && [ $made -eq 3 ]
report $? 'make_reference: another mesh or included file is another state'

# ---- train_histogram
program=$train_histogram
# said NAME PATTERN: the last run's output has it.
said() {
    cat out >>log
    grep -qE -- "$2" log
    status=$? why="nothing matches: $2"
    report $status "$1"
}
# untouched NAME FILE WAS: the file is what it was.
untouched() {
    cmp "$2" "$3" >log 2>&1
    report $? "$1"
}
for value in '--batch 0' '--batch 1.5' '--batch 1e9' '--threads 0' '--rooms -1' '--seed nan' '--steps 1x'; do
    refuses "train_histogram: $value" "${value%% *} .* is needed" $value
done
for value in abc 8,,16 8, 0 8,1000 1,1,1,1,1,1,1; do
    refuses "train_histogram: --channels $value" 'channels: one to six whole numbers' --channels $value
done
refuses 'train_histogram: unknown option' 'frobnicate: unknown' --frobnicate 1
refuses 'train_histogram: option without its value' 'seed: .*without its value' --seed
refuses 'train_histogram: --scene with --data' 'scene: .*leave out --data' --scene good.xml --data absent
refuses 'train_histogram: weights of a network without inputs' 'features 0: .*leave out --weights' --features 0 --weights half

# A data set by hand: one map to train, one held out, all values alike. safetensors are a length, JSON, numbers.
data_set() { # data_set FILE RUN
    local train=$((7 * 2048 * 2)) held=$((12 * 2048 * 2)) json length
    json="{\"__metadata__\":{\"rooms\":\"1\",\"run\":\"$2\"}
,\"train.maps\":{\"dtype\":\"F16\",\"shape\":[1,7,32,64],\"data_offsets\":[0,$train]}
,\"train.photons\":{\"dtype\":\"F32\",\"shape\":[1,2],\"data_offsets\":[$train,$((train + 8))]}
,\"held.maps\":{\"dtype\":\"F16\",\"shape\":[1,12,32,64],\"data_offsets\":[$((train + 8)),$((train + held + 8))]}
,\"held.photons\":{\"dtype\":\"F32\",\"shape\":[1,2],\"data_offsets\":[$((train + held + 8)),$((train + held + 16))]}}"
    length=${#json}
    printf "\\$(printf %o $((length % 256)))\\$(printf %o $((length / 256)))\0\0\0\0\0\0%s" "$json" >"$1"
    head -c $((train + held + 16)) /dev/zero | tr '\0' '<' >>"$1"
}
data_set maps 'seed 1, 0 CPU seconds a room'
net="--channels 4,4 --data maps --checkpoint net"
completes 'train_histogram: trains' $net --steps 3 --weights half --curve curve.svg
said 'train_histogram: says that it begins' 'net is not there: begun anew'
[ -s net ] && [ -s half ] && [ -s net.curve ] && grep -q '</svg>' curve.svg
report $? 'train_histogram: writes checkpoint, weights, curve'
completes 'train_histogram: goes on from its checkpoint' $net --steps 5
said 'train_histogram: says from where' '^net: step 3,'
cp net net.was
cp net.curve curve.was
completes 'train_histogram: judges without a step' $net --seconds 0
untouched 'train_histogram: judging leaves the checkpoint' net net.was
untouched 'train_histogram: judging leaves the curve' net.curve curve.was
head -c 2000 net.was >net
cp net broken
refuses 'train_histogram: a broken checkpoint' '^train_histogram: net: ' $net --steps 9
untouched 'train_histogram: a broken checkpoint stays' net broken
sed 's/"cpu_seconds":"[0-9.]*/"cpu_seconds":"nan/' net.was >net
refuses 'train_histogram: a checkpoint whose time is no number' '^train_histogram: net: ' $net --steps 9
mkdir folder
refuses 'train_histogram: a checkpoint that cannot be read' 'folder: is a directory' --channels 4,4 --data maps --checkpoint folder --steps 9
refuses 'train_histogram: data that cannot be read' 'folder: is a directory' --channels 4,4 --data folder --steps 9
# What an interrupted run has made of its rooms is gone on with, not taken for all.
mv maps rooms.part
room="--channels 4,4 --data rooms --checkpoint third --steps 1 --rooms 1 --room-seconds 0"
refuses 'train_histogram: rooms of another seed are not gone on with' 'rooms.part: .*another --seed' $room --seed 2
[ ! -e rooms ] && [ -e rooms.part ]
report $? 'train_histogram: rooms of another seed stay'
completes 'train_histogram: goes on with rooms' $room
said 'train_histogram: says after how many' 'rooms.part: going on after 1 rooms'
[ -e rooms ] && [ ! -e rooms.part ]
report $? 'train_histogram: all rooms become the data'
refuses 'train_histogram: makes a room, too dark to train on' 'too few rooms' --data fourth --rooms 1 --room-seconds 0 --seed 3
[ -s fourth ] && [ ! -e fourth.part ]
report $? 'train_histogram: writes its data'
program=$render

# ---- the network's weights: beside the program, whatever the working directory
if [ -e /proc/self/exe ]; then
    completes 'net=on finds its weights from another folder' good.xml --method photon --set net=on $quick
    mkdir elsewhere
    cp "$render" elsewhere/render
    program=elsewhere/render
    refuses 'net=on without weights: where, and what to do' \
        'weights examples/weights/histogram.safetensors: No such file.*elsewhere/\.\./examples/weights/.*--set net=FILE' \
        good.xml --method photon --set net=on $quick
    program=$render
fi

finish
