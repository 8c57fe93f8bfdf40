/* blur_levels.c: the Gaussian blur of guide_sdtree.h at every SIMD level of the machine it runs on, against the twin in
   double precision. Needs the header and libm only, so that compile-matrix.sh can cross-compile it and run it in an
   emulator: that is how NEON is tested on other machines.

   aarch64-linux-gnu-gcc -std=c99 -O2 -static -I. tests/blur_levels.c -lm -o blur_levels && qemu-aarch64 blur_levels */
#include <stdio.h>

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "denoise_naive.h"
#include "rng.h"

#define LAYER 7u
#define WIDTH (1u << LAYER)
#define MOST 9000

static uint32_t child[MOST], count = 1;
static gsdi_sum sum[MOST];
static double mass[MOST];
static unsigned char depth[MOST], height[MOST];

static void grow(uint32_t node, uint32_t level)
{
    if (level == LAYER || count + 4 > MOST || (level > 1 && rnd() > 0.6))
        return;
    uint32_t c = child[node] = count;
    count += 4;
    for (uint32_t k = 0; k < 4; ++k)
        grow(c + k, level + 1);
}

static double worst(const float *m, size_t stride, const dn_matrix *truth)
{
    double most = 0;
    for (uint32_t i = 0; i < WIDTH * WIDTH; ++i) {
        double got = (double)m[i / WIDTH * stride + i % WIDTH];
        double error = fabs(got - truth->v[i]) / (truth->v[i] > 0 ? truth->v[i] : 1);
        most = error <= most ? most : error; /* NaN stays */
    }
    return most;
}

/* Whole matrix and runs of blocks of one level; the largest relative error. */
static double check(gsd_simd level, gsdi_gauss_slot *slot, dn_border border)
{
    size_t stride = gsdi_gauss_stride(WIDTH), runs;
    float w[4], *m = slot->matrix[0];
    dn_matrix flat = dn_new_matrix(WIDTH), truth;
    double error;
    gsdi_gauss_weights(0.8, w);
    gsdi_gauss_flatten(child, mass, height, LAYER, m, stride);
    for (uint32_t i = 0; i < WIDTH * WIDTH; ++i)
        flat.v[i] = (double)m[i / WIDTH * stride + i % WIDTH];
    truth = dn_blur(&flat, 0.8, border, NULL);
    gsdi_gauss_pad(m, stride, WIDTH, border == DN_SPHERE);
    gsdi_gauss_full(level, m, slot->packed, WIDTH, w);
    error = worst(slot->packed, WIDTH, &truth);
    gsdi_gauss_map(child, LAYER, slot->map);
    runs = gsdi_gauss_runs(slot->map, WIDTH, slot->run);
    gsdi_gauss_packed(level, m, slot->packed, WIDTH, slot->run, runs, w);
    gsdi_gauss_unpack(slot->packed, slot->run, runs, m, stride);
    error = fmax(error, worst(m, stride, &truth));
    dn_free_matrix(&flat);
    dn_free_matrix(&truth);
    return error;
}

int main(void)
{
    static const char *const names[] = {"auto", "scalar", "AVX2", "AVX-512", "NEON"};
    gsdi_gauss_slot slot;
    uint64_t bytes[5];
    bool ok = true;
    memset(&slot, 0, sizeof slot);
    slot.depth = LAYER;
    slot.memory = malloc((size_t)gsdi_gauss_parts(LAYER, bytes));
    if (!slot.memory)
        return 1;
    gsdi_gauss_slot_cut(&slot, LAYER);
    seed(3);
    grow(0, 0);
    for (uint32_t i = 0; i < count; ++i)
        sum[i].half[0] = sum[i].half[1] = child[i] ? 0 : rnd();
    gsdi_tree_masses(child, sum, count, false, mass, depth);
    gsdi_gauss_heights(child, count, height);
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level)
        for (int border = DN_ZERO; border <= DN_SPHERE && gsdi_simd((gsd_simd)level) == (gsd_simd)level; ++border) {
            double error = check((gsd_simd)level, &slot, (dn_border)border);
            printf("%s, %s: largest relative error %.1e\n", names[level], border ? "sphere" : "zeros around", error);
            ok = ok && error <= 1e-6;
        }
    free(slot.memory);
    return !ok;
}
