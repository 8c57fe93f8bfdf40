#!/usr/bin/env bash
# What denoising the quadtrees of guide_sdtree.h is worth at the end of a training: second moment of the samples under
# the field denoised in its last update, over that under the same field not denoised. Both fields are compared by the
# same samples, once by those that each of them drew; the table has the geometric mean of both and over seeds, of all
# samples and of image tiles ("typical": single bright samples do not decide it), and the step's share of the
# training's CPU seconds.
#   RENDER=build/render SCENES="ajar torus" TRAIN="4 8 32" SEEDS="1 2 3" SPP=8 SIZE=160x90 JOBS=2 bench/denoise.sh
# Names are those of examples/scenes, of folders in $GUIDE_SCENES (kitchen living-room veach-ajar veach-bidir), or files.
export LC_ALL=C
cd "$(dirname "$0")/.." || exit 1
: "${RENDER:=build/render}" "${SCENES:=ajar cornell egg gloss hall hole lamps maze pool spot torus}" "${TRAIN:=4 8 32}"
: "${SEEDS:=1 2 3}" "${SPP:=8}" "${SIZE:=160x90}" "${JOBS:=$(nproc 2>/dev/null || echo 2)}"
tmp=$(mktemp -d) || exit 1
trap 'rm -rf "$tmp"' EXIT

number() { sed -n "s/.*\"$2\": \[*\([-0-9.e+]*\).*/\1/p" "$1"; }

# The file of a scene; nothing, and a message, where there is none.
scene_file() {
    local file
    for file in "$1" "examples/scenes/$1.xml" "${GUIDE_SCENES:-/nowhere}/$1/scene.xml" "${GUIDE_SCENES:-/nowhere}/$1/$1.xml"; do
        [ -f "$file" ] && echo "$file" && return
    done
    echo "denoise.sh: skipping $1: not in examples/scenes, and no folder of that name in GUIDE_SCENES" >&2
    return 1
}

# compare FILE SCENE TRAIN SEED: a line "train scene", then the ratios by the samples of either field, of all samples and
# typical, and the CPU seconds of the step and of the training.
compare() {
    local at=$tmp/$3-$4-$2
    local common=("$1" --method sdtree --size "$SIZE" --train "$3" --seed "$4" --threads 1 --quiet -o "$at.exr")
    "$RENDER" "${common[@]}" --spp 1 --set denoise_when=last --set save="$at.on" --json "$at.json" &&
        "$RENDER" "${common[@]}" --spp "$SPP" --set denoise=off --set save="$at.off" --set compare="$at.on" --json "$at.1" &&
        "$RENDER" "${common[@]}" --spp "$SPP" --set denoise_when=last --set compare="$at.off" --json "$at.2" || return
    echo "$3 $2 $(number "$at.1" compared) $(number "$at.2" compared) $(number "$at.1" compared_typical)" \
        "$(number "$at.2" compared_typical) $(number "$at.json" denoise_seconds) $(number "$at.json" train_seconds)"
    rm -f "$at".*
}

export RENDER SPP SIZE tmp
export -f compare number
for scene in $SCENES; do
    file=$(scene_file "$scene") || continue
    for train in $TRAIN; do
        for seed in $SEEDS; do printf '"%s" %s %s %s\n' "$file" "$(basename "$scene" .xml)" "$train" "$seed"; done
    done
done | xargs -P "$JOBS" -L 1 bash -c 'compare "$@" 2>>"$tmp/errors"' compare >"$tmp/rows"
[ -s "$tmp/rows" ] || { cat "$tmp/errors" >&2; exit 1; }
sort -s -k 1,1n -k 2,2 "$tmp/rows" | awk '
    function geometric(sum, n) { return sprintf("%.3f", exp(sum / n)) }
    function flush() {
        if (n) printf "| %s | %s | %s | %s | %.1f %% |\n", train, scene, geometric(all, n), geometric(typical, n), 100 * step / learning
        over += all / n; over_typical += typical / n; scenes++
        all = typical = step = learning = n = 0
    }
    function mean() {
        if (scenes) printf "| %s | geometric mean | %s | %s | |\n", train, geometric(over, scenes), geometric(over_typical, scenes)
        over = over_typical = scenes = 0
    }
    BEGIN { print "| training | scene | all samples | typical | step |\n|---|---|---|---|---|" }
    NR > 1 && ($1 != train || $2 != scene) { flush() }
    NR > 1 && $1 != train { mean() }
    {
        train = $1; scene = $2; n++
        all += (log($3) - log($4)) / 2; typical += (log($5) - log($6)) / 2; step += $7; learning += $8
    }
    END { flush(); mean() }'
