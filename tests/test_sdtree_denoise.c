/* test_sdtree_denoise.c: how guide_sdtree.h denoises quadtrees, against plain references in double precision.

   gcc -std=c11 -O2 -I. tests/test_sdtree_denoise.c -lcmocka -lm -lpthread */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "building.h"
#include "counter.h"
#include "crowd.h"
#include "denoise_naive.h"
#include "rng.h"
#include "scale.h"

#define PI 3.14159265358979323846
#define OK(call) assert_int_equal((call), GSD_OK)

/* ---- helpers */

#define MOST 6000 /* nodes of a test's tree */

typedef struct tree {
    uint32_t child[MOST], count;
    gsdi_sum sum[MOST];
    double mass[MOST];
    unsigned char depth[MOST];
    float work[GSDI_BLUR_FLOATS * MOST];
    gsdi_blur blur;
} tree;

/* Divide node at random, or only towards the corner (0, 0) where chance < 0. */
static void grow(tree *t, uint32_t node, uint32_t depth, uint32_t deepest, double chance, bool corner)
{
    if (depth == deepest || t->count + 4 > MOST || !(depth == 0 || (chance < 0 ? corner : rnd() < chance)))
        return;
    uint32_t c = t->child[node] = t->count;
    t->count += 4;
    for (uint32_t k = 0; k < 4; ++k)
        grow(t, c + k, depth + 1, deepest, chance, corner && k == 0);
}

static void measure(tree *t, bool second_moment)
{
    gsdi_tree_masses(t->child, t->sum, t->count, second_moment, t->mass, t->depth);
    t->blur = gsdi_blur_make(t->work, t->count, t->mass);
}

static tree *make_tree(uint64_t seed, uint32_t deepest, double chance)
{
    tree *t = calloc(1, sizeof *t);
    assert_non_null(t);
    rng_state = seed;
    t->count = 1;
    grow(t, 0, 0, deepest, chance, true);
    for (uint32_t i = 0; i < t->count; ++i)
        for (int k = 0; k < 2 && !t->child[i]; ++k)
            t->sum[i].half[k] = rnd() < 0.2 ? 0 : pow(10, 4 * rnd());
    return t;
}

/* Masses of `mass` (leaves count) as a matrix 2^layer wide: leaves above by area, subtrees below as their sum. */
static void flatten(const tree *t, const double *mass, uint32_t node, uint32_t depth, uint32_t x, uint32_t y,
                    dn_matrix *m, uint32_t layer)
{
    if (t->child[node] && depth < layer) {
        for (uint32_t k = 0; k < 4; ++k)
            flatten(t, mass, t->child[node] + k, depth + 1, 2 * x + (k & 1), 2 * y + (k >> 1), m, layer);
        return;
    }
    uint32_t n = 1u << (layer - depth);
    for (uint32_t j = y * n; j < (y + 1) * n; ++j)
        for (uint32_t i = x * n; i < (x + 1) * n; ++i)
            m->v[(size_t)j * m->width + i] = mass[node] / ((double)n * n);
}

/* Mean around the square (x, y) of a layer. */
static double around(const dn_matrix *m, long x, long y)
{
    double sum = 0;
    for (long j = -1; j <= 1; ++j)
        for (long i = -1; i <= 1; ++i) {
            long at = dn_index((long)m->width, y + j, x + i, DN_SPHERE);
            sum += i || j ? (i && j ? 1 : 2) / 12.0 * m->v[at] : 0;
        }
    return sum;
}

/* Compare what the blur found around every leaf with the matrix of that leaf's layer. */
static void compare(const tree *t, const double *mass, const float *near, double scale, uint32_t node, uint32_t depth,
                    uint32_t x, uint32_t y)
{
    if (t->child[node]) {
        for (uint32_t k = 0; k < 4; ++k)
            compare(t, mass, near, scale, t->child[node] + k, depth + 1, 2 * x + (k & 1), 2 * y + (k >> 1));
        return;
    }
    dn_matrix m = dn_new_matrix(1u << depth);
    flatten(t, mass, 0, 0, 0, 0, &m, depth);
    double expected = around(&m, x, y) * scale, got = (double)near[node];
    if (fabs(got - expected) > 2e-6 * expected + 1e-30)
        fail_msg("around (%u, %u) at depth %u: %g, expected %g", x, y, depth, got, expected);
    dn_free_matrix(&m);
}

/* ---- the blur of one tree */

/* Squared differences of the halves' shares, summed over the leaves, times their number. */
static double halves_noise(const tree *t, bool second)
{
    double sum[2] = {0, 0}, square = 0, leaves = 0;
    for (int pass = 0; pass < 2; ++pass)
        for (uint32_t i = 0; i < t->count; ++i) {
            double m[2];
            for (int k = 0; k < 2; ++k)
                m[k] = second ? sqrt(t->sum[i].half[k] * pow(0.25, t->depth[i])) : t->sum[i].half[k];
            if (t->child[i])
                continue;
            if (pass == 0) {
                sum[0] += m[0];
                sum[1] += m[1];
                leaves += 1;
            } else {
                square += pow(m[0] / sum[0] - m[1] / sum[1], 2);
            }
        }
    return square * leaves;
}

static void test_surroundings_match_matrices(void **state)
{
    (void)state;
    for (uint64_t seed = 1; seed <= 60; ++seed) {
        bool second = seed & 1;
        tree *t = make_tree(seed, 1 + seed % 6, seed % 5 == 0 ? -1 : 0.7);
        double own[MOST], sum[2] = {0, 0}, total[3];
        measure(t, second);
        assert_true(gsdi_blur_masses(t->child, t->sum, t->depth, t->count, second, &t->blur));
        gsdi_blur_near(t->child, &t->blur, total);
        compare(t, t->mass, t->blur.near[2], 1 / t->mass[0], 0, 0, 0, 0);
        for (uint32_t h = 0; h < 2; ++h) { /* masses of the halves, bottom up */
            for (uint32_t i = t->count; i-- > 0;) {
                uint32_t c = t->child[i];
                own[i] = c ? own[c] + own[c + 1] + own[c + 2] + own[c + 3]
                           : gsdi_leaf_mass(t->sum[i].half[h], second, t->depth[i]);
                sum[h] += c ? 0 : own[i];
            }
            for (uint32_t i = 0; i < t->count; ++i)
                assert_true(fabs((double)t->blur.half[h][i] - own[i] / sum[h]) <= 2e-6 * own[i] / sum[h]);
            compare(t, own, t->blur.near[h], 1 / sum[h], 0, 0, 0, 0);
        }
        free(t);
    }
}

/* What either half says of the other at t, straight from the definition; moves are known. */
static double score(const tree *t, double move)
{
    double sum = 0;
    for (uint32_t i = 0; i < t->count; ++i)
        for (int h = 0; h < 2 && !t->child[i]; ++h) {
            double own = (double)t->blur.half[h][i], near = own + (double)t->blur.near[h][i];
            double density =
                (1 - GSDI_BLUR_EVEN) * ((1 - move) * own + move * near) + GSDI_BLUR_EVEN * pow(0.25, t->depth[i]);
            sum += (double)t->blur.half[1 - h][i] * log(density);
        }
    return sum;
}

static void test_strength_is_where_the_halves_agree_best(void **state)
{
    (void)state;
    int moved = 0, still = 0, alike = 0;
    for (uint64_t seed = 1; seed <= 30; ++seed) {
        bool second = seed & 1;
        tree *t = make_tree(seed, 3 + seed % 4, 0.8);
        for (uint32_t i = 0; i < t->count; ++i) /* from equal halves to independent ones */
            for (int k = 0; k < 2; ++k)
                t->sum[i].half[k] = pow(t->sum[i].half[0], 1 - (double)(seed % 7) / 6) *
                                    pow(1 + t->sum[i].half[1], (double)(seed % 7) / 6 * (k ? 1 : rnd()));
        measure(t, second);
        double noise = halves_noise(t, second);
        double best = 0, got = gsdi_blur_tree(t->child, t->sum, t->depth, t->count, second, &t->blur);
        if (second && noise <= 4) {
            assert_true(got == 0);
            ++alike;
            free(t);
            continue;
        }
        for (double at = 0.05; at < 0.6; at += 0.1) { /* the slope by finite differences */
            double slope = gsdi_blur_slope(t->count, &t->blur, (float)at);
            double finite = (score(t, at + 1e-4) - score(t, at - 1e-4)) / 2e-4;
            assert_true(fabs(slope - finite) < 1e-5 + 1e-4 * fabs(finite));
        }
        for (double at = 0; at <= GSDI_BLUR_MOST; at += 0.006)
            best = score(t, at) > score(t, best) ? at : best;
        double step = GSDI_BLUR_MOST / (1 << GSDI_BLUR_STEPS), half = 2 * got / (1 + got);
        if (!(half <= best + 0.006 && best <= half + step + 0.006))
            fail_msg("seed %d: moved %g, best %g", (int)seed, half, best);
        moved += got > 0;
        still += got == 0;
        free(t);
    }
    assert_true(moved > 5 && still > 3 && alike > 1);
}

static void assert_sane(const tree *t, double total, double strength)
{
    double sum = 0;
    assert_true(strength >= 0 && strength <= GSDI_BLUR_MOST / (2 - GSDI_BLUR_MOST));
    for (uint32_t i = 0; i < t->count; ++i) {
        assert_true(t->mass[i] >= 0 && t->mass[i] <= 1.0001 * total);
        sum += t->child[i] ? 0 : t->mass[i];
    }
    assert_true(fabs(sum - total) <= 1e-6 * total);
    assert_true(fabs(t->mass[0] - total) <= 1e-6 * total);
}

static void test_hostile_trees_keep_their_mass(void **state)
{
    (void)state;
    int moved = 0;
    for (uint32_t deepest = 1; deepest <= 20; ++deepest)
        for (int kind = 0; kind < 6; ++kind)
            for (int second = 0; second < 2; ++second) {
                tree *t = make_tree(deepest * 10 + (uint32_t)kind, deepest, kind == 0 || deepest > 7 ? -1 : 0.6);
                uint32_t hot = t->count - 1;
                for (uint32_t i = 0; i < t->count; ++i)
                    for (int k = 0; k < 2; ++k) {
                        double *x = &t->sum[i].half[k];
                        if (kind == 1) /* one hot leaf */
                            *x = i == hot ? 1e30 : 0;
                        else if (kind == 2) /* contrast 1e60, halves unlike each other */
                            *x = pow(10, 60 * rnd() - 30);
                        else if (kind == 3) /* one half empty */
                            *x = k ? 0 : *x;
                        else if (kind == 4) /* one leaf of a half, another of the other */
                            *x = i == (k ? hot : hot - 1) ? 1e-30 : 0;
                        else if (kind == 5) /* as large as sums can be */
                            *x *= 1e290;
                    }
                measure(t, second);
                double total = t->mass[0];
                double strength = gsdi_blur_tree(t->child, t->sum, t->depth, t->count, second, &t->blur);
                assert_sane(t, total, strength);
                if (kind == 3)
                    assert_true(strength == 0);
                moved += strength > 0;
                free(t);
            }
    assert_true(moved > 20);
}

static void test_even_trees_stay_even(void **state)
{
    (void)state;
    for (uint64_t seed = 1; seed < 20; ++seed) {
        tree *t = make_tree(seed, 6, 0.7);
        for (int pass = 0; pass < 2; ++pass) {
            measure(t, false);
            for (uint32_t i = 0; i < t->count; ++i)
                for (int k = 0; k < 2; ++k)
                    t->sum[i].half[k] = pow(0.25, t->depth[i]);
        }
        double strength = gsdi_blur_tree(t->child, t->sum, t->depth, t->count, false, &t->blur);
        assert_sane(t, 2, strength);
        for (uint32_t i = 0; i < t->count; ++i)
            assert_true(fabs(t->mass[i] - 2 * pow(0.25, t->depth[i])) <= 1e-6 * t->mass[i]);
        free(t);
    }
}

/* ---- in a field */

/* Radiance of a test field: 0 broad lobe, 1 two small lamps, 2 a grating, 3 even. */
static double light(int kind, const float d[3])
{
    double z = (double)d[2], x = (double)d[0], y = (double)d[1];
    switch (kind) {
    case 0:
        return 0.05 + exp(6 * (0.6 * x + 0.8 * z - 1));
    case 1:
        return 0.01 + 300 * (z > 0.995) + 100 * (0.8 * y + 0.6 * x > 0.99);
    case 2:
        return 1 + 0.99 * sin(12 * atan2(y, x)) * sin(9 * z);
    default:
        return 1;
    }
}

/* Learn from 8 passes of n samples each, directions from the field itself. Returns the chi-square distance of the
   learned density p to the light L: integral of L^2 / p over (integral of L)^2 (1 is perfect). */
static double trained(int kind, int n, gsd_target target, bool denoise, uint64_t seed, gsd_stats *stats)
{
    gsd_desc d;
    gsd_field *f;
    gsd_stream *s;
    memset(&d, 0, sizeof d);
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    d.target = target;
    d.split_samples = 1e9f;
    d.denoise = denoise ? GSD_DENOISE_BLUR : GSD_DENOISE_OFF;
    d.no_gate = true;
    OK(gsd_create(&d, &f));
    OK(gsd_stream_create(f, &s));
    rng_state = seed;
    float at[3] = {0.5f, 0.5f, 0.5f}, w[3];
    for (int pass = 0; pass < 8; ++pass) {
        gsd_view v = gsd_get_view(f);
        gsd_handle h = gsd_find(&v, at, NULL, NULL);
        for (int i = 0; i < n; ++i) {
            float u[2] = {(float)rnd() * 0.999999f, (float)rnd() * 0.999999f}, p = gsd_sample(&v, &h, u, w), mix;
            if (rnd() < 0.5) { /* half of them anywhere */
                gsd_direction(rnd() * 16777216, rnd() * 16777216, w);
                p = gsd_pdf(&v, &h, w);
            }
            mix = 0.5f * (p + GSD_INV_4PI);
            float L = (float)(light(kind, w) * -log(1 - rnd()));
            gsd_training_sample sample = gsd_make_scalar_sample(at, w, NULL, INFINITY, L, L, L, mix, GSD_INV_4PI, p);
            OK(gsd_record(s, &sample, 1));
        }
        OK(gsd_accumulate(f, &s, 1, NULL, NULL));
        gsd_stream_clear(s);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
    }
    gsd_view v = gsd_get_view(f);
    gsd_handle h = gsd_find(&v, at, NULL, NULL);
    double sum = 0, square = 0;
    for (int j = 0; j < 400; ++j)
        for (int i = 0; i < 400; ++i) {
            gsd_direction((i + 0.5) / 400 * 16777216, (j + 0.5) / 400 * 16777216, w);
            double L = light(kind, w), p = (double)gsd_pdf(&v, &h, w);
            sum += L / 160000;
            square += L * L / (p * 4 * PI) / 160000;
        }
    gsd_get_stats(f, stats);
    gsd_stream_destroy(s);
    gsd_destroy(f);
    return square / (sum * sum);
}

/* The gain where samples are few, and no loss where light has edges, is even or well known. */
static void test_denoising_pays(void **state)
{
    (void)state;
    static const struct {
        int kind, n;
        gsd_target target;
        double most; /* of (V - 1) on over off, mean of the seeds */
    } cases[] = {{0, 200, GSD_TARGET_RADIANCE, 0.9},    {0, 200, GSD_TARGET_SIMPLE, 0.9},
                 {0, 20000, GSD_TARGET_RADIANCE, 1.02}, {1, 400, GSD_TARGET_RADIANCE, 1.05},
                 {1, 20000, GSD_TARGET_RADIANCE, 1.02}, {1, 20000, GSD_TARGET_SIMPLE, 1.02},
                 {2, 300, GSD_TARGET_RADIANCE, 1.02},   {2, 20000, GSD_TARGET_RADIANCE, 1.02},
                 {3, 300, GSD_TARGET_RADIANCE, 0.8}};
    for (size_t c = 0; c < sizeof cases / sizeof *cases; ++c) {
        double on = 0, off = 0;
        int seeds = cases[c].n > 1000 ? 3 : 12;
        gsd_stats stats;
        for (int seed = 1; seed <= seeds; ++seed) {
            off += trained(cases[c].kind, cases[c].n, cases[c].target, false, (uint64_t)seed, &stats) - 1;
            assert_true(stats.denoised_trees == 0 && stats.mean_blur == 0);
            on += trained(cases[c].kind, cases[c].n, cases[c].target, true, (uint64_t)seed, &stats) - 1;
            assert_true(stats.denoised_trees <= stats.rebuilt_trees && stats.mean_blur >= 0);
        }
        print_message("light %d, %d samples, target %d: V - 1 %.4f with, %.4f without: %.3f\n", cases[c].kind,
                      cases[c].n, cases[c].target, on / seeds, off / seeds, on / off);
        assert_true(on <= cases[c].most * off);
    }
}

/* n samples in a box, light of two kinds. */
static void record_box(gsd_stream *s, int n)
{
    for (int i = 0; i < n; ++i) {
        float at[3] = {(float)rnd(), (float)rnd(), (float)rnd()}, w[3];
        gsd_direction(rnd() * 16777216, rnd() * 16777216, w);
        float L = (float)(light(i % 2, w) * rnd());
        gsd_training_sample sample =
            gsd_make_scalar_sample(at, w, NULL, INFINITY, L, L, L, GSD_INV_4PI, GSD_INV_4PI, 0);
        OK(gsd_record(s, &sample, 1));
    }
}

/* 5 passes of n of them each. */
static void learn_box(const gsd_desc *options, int n, gsd_parallel_fn parallel, crowd *user, gsd_field **field)
{
    gsd_desc d = *options;
    gsd_field *f;
    gsd_stream *s;
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    OK(gsd_create(&d, &f));
    OK(gsd_stream_create(f, &s));
    rng_state = 5;
    for (int pass = 0; pass < 5; ++pass) {
        record_box(s, n);
        OK(gsd_accumulate(f, &s, 1, parallel, user));
        gsd_stream_clear(s);
        OK(gsd_refine(f, NULL, parallel, user));
    }
    gsd_stream_destroy(s);
    *field = f;
}

static size_t saved_box(gsd_denoise_mode mode, gsd_parallel_fn parallel, crowd *user, unsigned char **data)
{
    gsd_desc d;
    gsd_field *f;
    gsd_stats stats;
    memset(&d, 0, sizeof d);
    d.denoise = mode;
    d.rho = mode == GSD_DENOISE_GAUSSIAN ? 0.001f : 0;
    d.denoise_budget = 1000;
    learn_box(&d, 6000, parallel, user, &f);
    gsd_get_stats(f, &stats);
    assert_true(stats.cells > 20 && stats.denoised_trees > stats.cells / 4);
    assert_true(mode == GSD_DENOISE_BLUR ? stats.mean_blur > 0.02f : stats.mean_blur == 0);
    assert_true(stats.over_budget_trees == 0);
    assert_int_equal(stats.denoised_trees + stats.smooth_trees + stats.shallow_trees + stats.deep_trees,
                     stats.rebuilt_trees);
    size_t size = gsd_save_bound(f);
    *data = malloc(size);
    OK(gsd_save(f, *data, size, &size));
    gsd_destroy(f);
    return size;
}

static void test_any_threads_give_the_same_field(void **state)
{
    (void)state;
    for (int mode = GSD_DENOISE_BLUR; mode <= GSD_DENOISE_GAUSSIAN; ++mode) {
        unsigned char *serial, *other;
        size_t size = saved_box((gsd_denoise_mode)mode, NULL, NULL, &serial);
        for (int threads = 1; threads <= 4; ++threads) {
            crowd team = {threads, (uint32_t)(5 - threads)};
            assert_int_equal(saved_box((gsd_denoise_mode)mode, crowd_for, &team, &other), size);
            assert_memory_equal(serial, other, size);
            free(other);
        }
        free(serial);
    }
}

/* Depths of the building tree's leaves at the middles of 64 x 64 squares; the field has one cell. */
static void leaf_depths(const gsd_field *f, unsigned char depth[64 * 64])
{
    for (uint32_t i = 0; i < 64 * 64; ++i) {
        const uint32_t *child = f->child + f->states[0].first;
        uint32_t x = (2 * (i % 64) + 1) << 17, y = (2 * (i / 64) + 1) << 17, node = 0, d = 0;
        for (; child[node]; ++d)
            node = child[node] + (x >> (23 - d) & 1u) + 2 * (y >> (23 - d) & 1u);
        depth[i] = (unsigned char)d;
    }
}

/* Refined once with and once without, from the same samples, the tree has new leaves beside bright ones: what the
   samples left out by chance is looked at in the next pass (Fig. 3.4 of the thesis). Where it has fewer, light was
   moved away. */
static void test_blur_adds_leaves(void **state)
{
    (void)state;
    unsigned char depth[2][64 * 64];
    for (int on = 0; on < 2; ++on) {
        gsd_desc d;
        gsd_field *f;
        gsd_stream *s;
        gsd_pass pass = {.denoise = on ? GSD_DENOISE_BLUR : GSD_DENOISE_OFF};
        float at[3] = {0.5f, 0.5f, 0.5f}, w[3];
        memset(&d, 0, sizeof d);
        d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
        d.split_samples = 1e9f;
        d.target = GSD_TARGET_RADIANCE;
        OK(gsd_create(&d, &f));
        OK(gsd_stream_create(f, &s));
        rng_state = 3;
        for (int i = 0; i < 2000; ++i) {
            gsd_direction(rnd() * 16777216, rnd() * 16777216, w);
            float L = (float)(light(0, w) * -log(1 - rnd()));
            gsd_training_sample sample =
                gsd_make_scalar_sample(at, w, NULL, INFINITY, L, L, L, GSD_INV_4PI, GSD_INV_4PI, 0);
            OK(gsd_record(s, &sample, 1));
        }
        OK(gsd_accumulate(f, &s, 1, NULL, NULL));
        OK(gsd_refine(f, &pass, NULL, NULL));
        leaf_depths(f, depth[on]);
        gsd_stream_destroy(s);
        gsd_destroy(f);
    }
    int more = 0, fewer = 0;
    for (int i = 0; i < 64 * 64; ++i) {
        more += depth[1][i] > depth[0][i];
        fewer += depth[1][i] < depth[0][i];
    }
    print_message("of 4096 squares %d have deeper leaves, %d less deep ones\n", more, fewer);
    assert_true(more >= 40);
}

/* What is blurred comes within 10 % of the budget where that binds, and never goes beyond. */
static void test_budget_is_kept(void **state)
{
    (void)state;
    for (int k = 0; k < 4; ++k) {
        static const float budgets[4] = {0.05f, 0.1f, 0.5f, 1000};
        gsd_desc d;
        gsd_field *f;
        gsd_stats stats;
        memset(&d, 0, sizeof d);
        d.denoise_budget = budgets[k];
        d.split_samples = 200;
        d.rho = 0.0005f;
        learn_box(&d, k < 3 ? 60000 : LESS(60000), NULL, NULL, &f); /* few leaves would bind no budget */
        gsd_get_stats(f, &stats);
        double allowed = GSDI_BLUR_FREE + (double)d.denoise_budget * (double)stats.samples;
        print_message("budget %g: %.0f leaves of %.0f, last pass %u trees over it\n", (double)d.denoise_budget,
                      (double)stats.denoised_leaves, allowed, stats.over_budget_trees);
        assert_true((double)stats.denoised_leaves <= allowed);
        if (k < 3)
            assert_true(stats.over_budget_trees > 0 && (double)stats.denoised_leaves >= 0.9 * allowed);
        else
            assert_true(stats.over_budget_trees == 0);
        assert_int_equal(stats.denoised_trees + stats.smooth_trees + stats.over_budget_trees, stats.rebuilt_trees);
        gsd_destroy(f);
    }
}

static void note_step(void *user, const char *step)
{
    char *steps = user;
    size_t n = strlen(steps);
    snprintf(steps + n, 64 - n, "%s ", step ? step : "end");
}

/* Refine tells its steps in order, and the end once. */
static void test_steps_are_told(void **state)
{
    (void)state;
    gsd_desc d;
    gsd_field *f;
    char steps[64] = "";
    gsd_pass pass = {.on_step = note_step, .on_step_user = steps};
    memset(&d, 0, sizeof d);
    learn_box(&d, 1000, NULL, NULL, &f);
    OK(gsd_refine(f, &pass, NULL, NULL));
    assert_string_equal(steps, "measure denoise split build end ");
    gsd_destroy(f);
}

/* One pass may be denoised in another way than the descriptor says. */
static void test_pass_says_otherwise(void **state)
{
    (void)state;
    for (int on = 0; on < 2; ++on) {
        gsd_desc d;
        gsd_field *f;
        gsd_stats stats;
        gsd_pass pass = {.denoise = on ? GSD_DENOISE_BLUR : GSD_DENOISE_OFF};
        gsd_training_sample sample;
        gsd_stream *s;
        float at[3] = {0.4f, 0.5f, 0.6f}, up[3] = {0, 0, 1};
        memset(&d, 0, sizeof d);
        d.denoise = on ? GSD_DENOISE_OFF : GSD_DENOISE_BLUR;
        learn_box(&d, 20000, NULL, NULL, &f);
        gsd_get_stats(f, &stats);
        assert_true(on ? stats.denoised_trees == 0 : stats.denoised_trees > 0);
        OK(gsd_stream_create(f, &s));
        for (int i = 0; i < 5000; ++i) {
            at[0] = (float)rnd();
            sample = gsd_make_scalar_sample(at, up, NULL, INFINITY, 1, 1, 1, GSD_INV_4PI, GSD_INV_4PI, 0);
            OK(gsd_record(s, &sample, 1));
        }
        OK(gsd_accumulate(f, &s, 1, NULL, NULL));
        gsd_stream_clear(s);
        pass.denoise = (gsd_denoise_mode)99;
        assert_int_equal(gsd_refine(f, &pass, NULL, NULL), GSD_BAD_OPTION);
        pass.denoise = on ? GSD_DENOISE_BLUR : GSD_DENOISE_OFF;
        OK(gsd_refine(f, &pass, NULL, NULL));
        gsd_get_stats(f, &stats);
        assert_true(stats.rebuilt_trees > 0);
        assert_true(on ? stats.denoised_trees + stats.smooth_trees == stats.rebuilt_trees
                       : stats.denoised_trees + stats.smooth_trees == 0);
        gsd_stream_destroy(s);
        gsd_destroy(f);
    }
}

/* ---- the Gaussian mode */

/* A building tree in the twin's form. */
static dn_tree to_twin(const uint32_t *child, const double *mass, uint32_t count)
{
    dn_tree t = {0, dn_allocate(4 * (size_t)count, sizeof *t.child), dn_allocate(4 * (size_t)count, sizeof *t.value)};
    uint32_t *number = dn_allocate(count, sizeof *number);
    for (uint32_t i = 0; i < count; ++i)
        number[i] = child[i] ? t.count++ : 0;
    for (uint32_t i = 0; i < count; ++i)
        for (uint32_t k = 0; child[i] && k < 4; ++k) {
            t.child[4 * number[i] + k] = number[child[i] + k];
            t.value[4 * number[i] + k] = mass[child[i] + k];
        }
    free(number);
    return t;
}

static tree *make_deep_tree(uint64_t seed, uint32_t deepest)
{
    for (;; seed += 1000) {
        tree *t = make_tree(seed, deepest, 0.6);
        unsigned char height[MOST];
        measure(t, seed & 1);
        gsdi_gauss_heights(t->child, t->count, height);
        if (height[0] == deepest)
            return t;
        free(t);
    }
}

static gsdi_gauss_slot make_slot(uint32_t depth)
{
    gsdi_gauss_slot slot;
    uint64_t bytes[5];
    memset(&slot, 0, sizeof slot);
    slot.memory = malloc((size_t)gsdi_gauss_parts(depth, bytes));
    assert_non_null(slot.memory);
    slot.depth = depth;
    gsdi_gauss_slot_cut(&slot, depth);
    return slot;
}

static void assert_near_matrix(const float *m, size_t stride, const dn_matrix *truth, double total, const char *what)
{
    for (uint32_t row = 0; row < truth->width; ++row)
        for (uint32_t column = 0; column < truth->width; ++column) {
            double got = (double)m[row * stride + column], want = truth->v[(size_t)row * truth->width + column] / total;
            if (!(fabs(got - want) <= 1e-5 * want + 1e-29))
                fail_msg("%s: (%u, %u) of %u: %g, expected %g", what, row, column, truth->width, got, want);
        }
}

/* One layer of one tree by all levels, full and by blocks, against the twin. */
static void check_layer(const tree *t, const dn_tree *twin, const unsigned char *height, gsdi_gauss_slot *slot,
                        uint32_t layer, double sigma, dn_border border)
{
    uint32_t width = 1u << layer;
    size_t stride = gsdi_gauss_stride(width), runs;
    float w[4], *m = slot->matrix[0];
    dn_matrix flat = dn_flatten(twin, layer);
    unsigned char *mask = dn_mask(twin, layer, border);
    dn_matrix truth = dn_blur(&flat, sigma, border, mask);
    gsdi_gauss_weights(sigma, w);
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
        double sum = 0;
        if (gsdi_simd((gsd_simd)level) != (gsd_simd)level)
            continue;
        gsdi_gauss_flatten(t->child, t->mass, height, layer, m, stride);
        assert_near_matrix(m, stride, &flat, t->mass[0], "flat");
        gsdi_gauss_pad(m, stride, width, border == DN_SPHERE);
        gsdi_gauss_full((gsd_simd)level, m, slot->packed, width, w);
        assert_near_matrix(slot->packed, width, &truth, t->mass[0], "whole");
        for (size_t i = 0; i < (size_t)width * width; ++i)
            sum += (double)slot->packed[i];
        if (border == DN_SPHERE)
            assert_true(fabs(sum * t->mass[0] - dn_sum(&flat)) <= 1e-6 * dn_sum(&flat));
        gsdi_gauss_map(t->child, layer, slot->map);
        runs = gsdi_gauss_runs(slot->map, width, slot->run);
        gsdi_gauss_packed((gsd_simd)level, m, slot->packed, width, slot->run, runs, w);
        gsdi_gauss_unpack(slot->packed, slot->run, runs, m, stride);
        assert_near_matrix(m, stride, &truth, t->mass[0], "blocks");
    }
    dn_free_matrix(&flat);
    dn_free_matrix(&truth);
    free(mask);
}

static void test_gaussian_layers_match_the_twin(void **state)
{
    (void)state;
    static const double sigmas[] = {0.8, 0.3, 2.5};
    for (uint32_t deepest = 6; deepest <= 9; ++deepest)
        for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
            tree *t = make_deep_tree(deepest, deepest);
            unsigned char height[MOST];
            dn_tree twin = to_twin(t->child, t->mass, t->count);
            gsdi_gauss_slot slot = make_slot(deepest);
            gsdi_gauss_heights(t->child, t->count, height);
            assert_int_equal(dn_depth(&twin, 0), deepest);
            for (uint32_t layer = 6; layer <= deepest; ++layer)
                check_layer(t, &twin, height, &slot, layer, sigmas[(deepest + layer) % 3], (dn_border)border);
            free(slot.memory);
            dn_free_tree(&twin);
            free(t);
        }
}

/* The two trees divide alike but within rounding of the threshold, and have the same masses. node of got is inner. */
static void compare_trees(const tree *got, uint32_t node, const dn_tree *want, uint32_t twin, double limit,
                          double total)
{
    for (uint32_t k = 0; k < 4; ++k) {
        uint32_t c = got->child[node] + k, d = want->child[4 * twin + k];
        double mass = want->value[4 * twin + k];
        if (fabs(got->mass[c] - mass) > 2e-5 * mass + 1e-28 * total)
            fail_msg("mass %g, expected %g of %g", got->mass[c], mass, total);
        if (!got->child[c] != !d)
            assert_true(fabs(mass - limit) <= 1e-5 * limit);
        else if (d)
            compare_trees(got, c, want, d, limit, total);
    }
}

static void test_gaussian_trees_match_the_twin(void **state)
{
    (void)state;
    for (uint32_t i = 0; i < 12; ++i) {
        uint32_t deepest = 6 + i % 4;
        double rho = i % 3 ? 0.003 : 0.02;
        dn_options o = {
            .first_layer = 6, .sigma = 0.8, .border = i & 1 ? DN_SPHERE : DN_ZERO, .mask = true, .rho = rho};
        tree *t = make_deep_tree(100 + i, deepest), *made = calloc(1, sizeof *made);
        unsigned char height[MOST];
        float w[4];
        dn_tree twin = to_twin(t->child, t->mass, t->count), expected;
        gsdi_gauss_slot slot = make_slot(deepest + (i & 1));
        slot.depth = deepest;
        o.max_depth = deepest;
        expected = dn_denoise(&twin, &o);
        double sum = dn_mass(&expected, 0), old[2] = {t->sum[0].half[0], t->sum[0].half[1]}, now[2] = {0, 0};
        for (uint32_t k = 0; k < 4 * expected.count; ++k) /* to the mass before */
            expected.value[k] *= t->mass[0] / sum;
        gsdi_gauss_weights(o.sigma, w);
        gsdi_gauss_heights(t->child, t->count, height);
        for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
            if (gsdi_simd((gsd_simd)level) != (gsd_simd)level)
                continue;
            gsdi_gauss_blur(&slot, t->child, t->mass, height, (gsd_simd)level, o.border == DN_SPHERE, w);
            made->count = gsdi_gauss_rebuild(&slot, rho, t->child, t->sum, NULL, NULL, NULL);
            assert_true(made->count > 4 && made->count < MOST);
            assert_int_equal(gsdi_gauss_rebuild(&slot, rho, t->child, t->sum, made->child, made->sum, made->mass),
                             made->count);
            gsdi_gauss_normalise(made->child, made->mass, made->count, t->mass[0]);
            assert_true(fabs(made->mass[0] - t->mass[0]) <= 1e-12 * t->mass[0]);
            compare_trees(made, 0, &expected, 0, rho * t->mass[0], t->mass[0]);
        }
        for (uint32_t n = 0; n < made->count; ++n)
            for (int h = 0; h < 2 && !made->child[n]; ++h)
                now[h] += made->sum[n].half[h];
        assert_true(fabs(now[0] - old[0]) <= 1e-9 * old[0] && fabs(now[1] - old[1]) <= 1e-9 * old[1]);
        dn_free_tree(&expected);
        dn_free_tree(&twin);
        free(slot.memory);
        free(made);
        free(t);
    }
}

/* Make t the building tree of a cell of a forest, all of whose cells have one node so far or were planted before. */
static void plant(gsd_field *f, uint32_t cell, const tree *t, double samples)
{
    gsdi_state *s = &f->states[cell];
    uint32_t first = more_building_nodes(f, t->count);
    memcpy(f->child + first, t->child, t->count * sizeof *f->child);
    for (uint32_t i = 0; i < t->count; ++i) /* inner sums are scratch */
        if (!t->child[i])
            f->sum[first + i] = t->sum[i];
    s->first = first;
    s->count = t->count;
    s->held = s->lit = s->fresh = samples;
    gsdi_field_changed(f);
}

/* A tree blurred by t is smoothed with (1 - t) K, one that is not with K. */
static void test_blur_takes_over_from_smoothing(void **state)
{
    (void)state;
    int moved = 0, still = 0;
    for (uint64_t seed = 1; seed <= 12; ++seed) {
        gsd_desc d = {.forest_cells = 1, .target = GSD_TARGET_RADIANCE, .smoothing = 5};
        const double samples = 40;
        gsd_field *f;
        tree *t = make_tree(seed, 5, 0.7);
        for (uint32_t i = 0; i < t->count && seed % 3 == 0; ++i) /* halves that agree */
            t->sum[i].half[1] = t->sum[i].half[0];
        OK(gsd_create(&d, &f));
        plant(f, 0, t, samples);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        measure(t, false);
        double blur = gsdi_blur_tree(t->child, t->sum, t->depth, t->count, false, &t->blur), K = 5 * (1 - blur);
        const gsd_node *root = &gsdi_nodes(f->block)[gsdi_trees(f->block)[gsdi_cells(f->block)[0].tree].root];
        const double *m = t->mass + t->child[0];
        double left = samples * (m[0] + m[2]) / t->mass[0] + K / 2;
        assert_true(fabs((double)root->inner.split[0] - left / (samples + K)) < 1e-6);
        for (int k = 0; k < 2; ++k) {
            double low = samples * m[k] / t->mass[0] + K / 4, high = samples * m[k + 2] / t->mass[0] + K / 4;
            assert_true(fabs((double)root->inner.split[1 + k] - low / (low + high)) < 1e-6);
        }
        moved += blur > 0.1;
        still += blur == 0;
        gsd_destroy(f);
        free(t);
    }
    assert_true(moved > 3 && still > 2);
}

static gsd_field *gaussian_forest(gsd_desc d, uint32_t cells)
{
    gsd_field *f;
    d.forest_cells = cells;
    d.denoise = GSD_DENOISE_GAUSSIAN;
    d.max_depth = d.max_depth ? d.max_depth : 20;
    d.smoothing = 0.001f;
    OK(gsd_create(&d, &f));
    return f;
}

static gsd_tree exported(const gsd_field *f, gsd_part part, uint32_t cell)
{
    gsd_tree t = {cell, gsd_export_bound(f, part, cell), NULL, NULL};
    t.child = calloc(4 * (size_t)t.count, sizeof *t.child);
    t.value = calloc(4 * (size_t)t.count, sizeof *t.value);
    OK(gsd_export_tree(f, part, &t));
    return t;
}

static void free_exported(gsd_tree *t)
{
    free(t->child);
    free(t->value);
}

static bool same_trees(const gsd_tree *a, const gsd_tree *b)
{
    return a->count == b->count && !memcmp(a->child, b->child, 4 * (size_t)a->count * sizeof *a->child) &&
           !memcmp(a->value, b->value, 4 * (size_t)a->count * sizeof *a->value);
}

/* Shares of a sampling tree against the twin's masses, smoothed as desc.smoothing says: `even` is added to each child's
   samples. */
static void compare_shares(const gsd_tree *got, uint32_t node, const dn_tree *want, uint32_t twin, double share,
                           double limit, double scale, double even)
{
    double m[4], total = 0;
    for (int k = 0; k < 4; ++k)
        total += m[k] = scale * want->value[4 * twin + (uint32_t)k] + even;
    for (uint32_t k = 0; k < 4; ++k) {
        uint32_t c = got->child[4 * node + k], d = want->child[4 * twin + k];
        double s = share * m[k] / total, g = (double)got->value[4 * node + k];
        if (fabs(g - s) > 1e-4 * s + 1e-9)
            fail_msg("share %g, expected %g", g, s);
        if (!c != !d)
            assert_true(fabs(want->value[4 * twin + k] - limit) <= 1e-5 * limit);
        else if (d)
            compare_shares(got, c, want, d, s, limit, scale, even);
    }
}

/* Fields that learn, then one pass denoised: what queries see is what the twin makes of the building trees. */
static void test_gaussian_refine_matches_the_twin(void **state)
{
    (void)state;
    static const gsd_target targets[] = {GSD_TARGET_RADIANCE, GSD_TARGET_SIMPLE};
    for (int i = 0; i < 2; ++i) {
        gsd_desc d = {.denoise = GSD_DENOISE_OFF,
                      .target = targets[i],
                      .rho = 0.002f,
                      .split_samples = 10000,
                      .smoothing = 0.001f,
                      .gaussian_sphere = i == 1,
                      .gaussian_rho = 0.005f,
                      .no_gate = true,
                      .max_depth = 9};
        gsd_pass pass = {.denoise = GSD_DENOISE_GAUSSIAN};
        dn_options o = {.first_layer = 6, .sigma = 0.8, .border = i ? DN_SPHERE : DN_ZERO, .mask = true, .rho = 0.005};
        gsd_field *f;
        gsd_stream *s;
        gsd_stats stats;
        gsd_tree old[64];
        double lit[64];
        o.rho = (double)0.005f;
        learn_box(&d, 20000, NULL, NULL, &f);
        OK(gsd_stream_create(f, &s));
        record_box(s, 20000);
        OK(gsd_accumulate(f, &s, 1, NULL, NULL));
        uint32_t cells = gsd_cell_count(f), deep = 0;
        assert_true(cells >= 4 && cells <= 64);
        for (uint32_t c = 0; c < cells; ++c) {
            old[c] = exported(f, GSD_PART_BUILDING, c);
            lit[c] = f->states[c].lit;
        }
        OK(gsd_refine(f, &pass, NULL, NULL));
        OK(gsd_validate(f));
        gsd_get_stats(f, &stats);
        for (uint32_t c = 0; c < cells; ++c) {
            gsd_tree now = exported(f, GSD_PART_SAMPLING, c);
            dn_tree twin = dn_make_tree(old[c].count, old[c].child, old[c].value);
            o.max_depth = dn_depth(&twin, 0);
            assert_true(o.max_depth <= 10);
            deep += o.max_depth >= 6;
            dn_tree expected = dn_denoise(&twin, &o);
            double sum = dn_mass(&expected, 0);
            compare_shares(&now, 0, &expected, 0, 1, o.rho * sum, lit[c] / sum, 0.00025);
            dn_free_tree(&twin);
            dn_free_tree(&expected);
            free_exported(&now);
            free_exported(&old[c]);
        }
        assert_true(deep >= 4);
        assert_int_equal(stats.denoised_trees, deep);
        assert_int_equal(stats.shallow_trees, cells - deep);
        assert_int_equal(stats.smooth_trees + stats.over_budget_trees + stats.deep_trees, 0);
        gsd_stream_destroy(s);
        gsd_destroy(f);
    }
}

static void test_gaussian_work_is_limited(void **state)
{
    (void)state;
    enum { CELLS = 40 };
    for (int k = 0; k < 4; ++k) {
        uint32_t depth[CELLS], deep = 0, shallow = 0, count = 0, over = 0;
        bool admitted[CELLS], no_limit = k == 3;
        gsd_field *f = gaussian_forest((gsd_desc){.gaussian_no_limit = no_limit, .rho = 1e-5f}, CELLS), *off;
        gsd_pass pass = {.denoise = GSD_DENOISE_OFF};
        gsd_stats stats;
        for (uint32_t c = 0; c < CELLS; ++c) {
            depth[c] = c % 7 == 3 ? 4 + c % 3 : c % 7 == 5 ? 11 + c % 5 : no_limit ? 6 + c % 3 : 8 + c % 3;
            tree *t = make_tree(c + 1, depth[c], -1);
            plant(f, c, t, 1000);
            free(t);
        }
        f->passes = k == 2 ? 1 : 0;
        dn_admit(CELLS, depth, 6, f->passes, admitted);
        size_t size = gsd_save_bound(f);
        void *data = malloc(size);
        OK(gsd_save(f, data, size, &size));
        OK(gsd_load(NULL, data, size, &off));
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_refine(off, &pass, NULL, NULL));
        OK(gsd_validate(f));
        for (uint32_t c = 0; c < CELLS; ++c) {
            gsd_tree a = exported(f, GSD_PART_SAMPLING, c), b = exported(off, GSD_PART_SAMPLING, c);
            bool wanted = no_limit ? depth[c] >= 6 && depth[c] <= 12 : admitted[c];
            assert_int_equal(!same_trees(&a, &b), wanted);
            deep += depth[c] > (no_limit ? 12 : 10);
            shallow += depth[c] < 6;
            over += depth[c] >= 6 && depth[c] <= (no_limit ? 12 : 10) && !wanted;
            count += wanted;
            free_exported(&a);
            free_exported(&b);
        }
        gsd_get_stats(f, &stats);
        assert_true(stats.denoised_trees == count && stats.deep_trees == deep && stats.shallow_trees == shallow &&
                    stats.over_budget_trees == over);
        assert_true(k < 2 ? over > 0 : over == 0);
        assert_int_equal(count + deep + shallow + over, stats.rebuilt_trees);
        free(data);
        gsd_destroy(f);
        gsd_destroy(off);
    }
}

static void test_gaussian_survives_hostile_trees(void **state)
{
    (void)state;
    int denoised = 0;
    for (uint32_t deepest = 1; deepest <= 20; ++deepest)
        for (int kind = 0; kind < 6; ++kind) {
            gsd_desc d = {.target = kind & 1 ? GSD_TARGET_SIMPLE : GSD_TARGET_RADIANCE,
                          .gaussian_no_limit = true,
                          .gaussian_sphere = deepest & 1,
                          .gaussian_sigma = kind == 2   ? 0.1f
                                            : kind == 4 ? 100
                                                        : 0,
                          .gaussian_rho = kind == 5 ? 1 : 0};
            gsd_field *f = gaussian_forest(d, 1);
            tree *t = make_tree(deepest * 10 + (uint32_t)kind, deepest, deepest > 9 || kind == 0 ? -1 : 0.6);
            gsd_stats stats;
            for (uint32_t i = 0; i < t->count; ++i)
                for (int k = 0; k < 2; ++k) {
                    double *x = &t->sum[i].half[k];
                    if (kind == 1) /* one hot leaf */
                        *x = i == t->count - 1 ? 1e30 : 0;
                    else if (kind == 2) /* contrast 1e60 */
                        *x = pow(10, 60 * rnd() - 30);
                    else if (kind == 3) /* all equal */
                        *x = 1;
                    else if (kind == 4) /* nothing at all, or as much as a loaded sum may hold */
                        *x = deepest & 2 ? 0 : 1e296;
                }
            plant(f, 0, t, 1000);
            OK(gsd_refine(f, NULL, NULL, NULL));
            OK(gsd_validate(f));
            gsd_get_stats(f, &stats);
            assert_int_equal(stats.denoised_trees + stats.shallow_trees + stats.deep_trees + stats.over_budget_trees,
                             stats.rebuilt_trees);
            denoised += (int)stats.denoised_trees;
            gsd_tree out = exported(f, GSD_PART_SAMPLING, 0);
            double sum = 0;
            for (uint32_t k = 0; k < 4 * out.count; ++k) {
                assert_true(out.value[k] >= 0 && out.value[k] <= 1.0001f);
                sum += out.child[k] ? 0 : (double)out.value[k];
            }
            assert_true(fabs(sum - 1) < 1e-4);
            free_exported(&out);
            free(t);
            gsd_destroy(f);
        }
    assert_true(denoised >= 30);
}

static gsd_field *loaded(counter *c, const void *data, size_t size)
{
    gsd_desc d;
    memset(&d, 0, sizeof d);
    count_with(&d, c);
    gsd_field *f;
    OK(gsd_load(&d, data, size, &f));
    return f;
}

static void assert_saves_as(const gsd_field *f, const void *data, size_t size)
{
    void *now = malloc(gsd_save_bound(f));
    size_t bytes;
    OK(gsd_save(f, now, gsd_save_bound(f), &bytes));
    assert_int_equal(bytes, size);
    assert_memory_equal(now, data, size);
    free(now);
}

/* Five trees, serially and by two threads: each allocation fails once. */
static void test_gaussian_survives_failed_allocations(void **state)
{
    (void)state;
    for (int threads = 0; threads < 2; ++threads) {
        crowd team = {2, 1};
        gsd_parallel_fn parallel = threads ? crowd_for : NULL;
        gsd_field *f = gaussian_forest((gsd_desc){.rho = 0.001f}, 5);
        for (uint32_t c = 0; c < 5; ++c) {
            tree *t = make_deep_tree(c + 1, 6 + c % 2);
            plant(f, c, t, 1000);
            free(t);
        }
        size_t before, after, size = gsd_save_bound(f);
        void *data = malloc(size), *good;
        OK(gsd_save(f, data, size, &before));
        gsd_destroy(f);
        counter c = {0};
        f = loaded(&c, data, before);
        assert_saves_as(f, data, before);
        long start = c.requests;
        OK(gsd_refine(f, NULL, parallel, &team));
        long requests = c.requests - start;
        good = malloc(gsd_save_bound(f));
        OK(gsd_save(f, good, gsd_save_bound(f), &after));
        gsd_destroy(f);
        assert_int_equal(c.live, 0);
        assert_true(requests > 15);
        for (long k = 1; k <= requests; ++k) {
            memset(&c, 0, sizeof c);
            f = loaded(&c, data, before);
            c.fail_at = c.requests + k;
            assert_int_equal(gsd_refine(f, NULL, parallel, &team), GSD_OUT_OF_MEMORY);
            OK(gsd_validate(f));
            for (uint32_t i = 0; i < f->building_nodes; ++i) /* inner sums are scratch */
                if (f->child[i])
                    memset(&f->sum[i], 0, sizeof f->sum[i]);
            assert_saves_as(f, data, before);
            OK(gsd_refine(f, NULL, parallel, &team));
            assert_saves_as(f, good, after);
            gsd_destroy(f);
            assert_int_equal(c.live, 0);
        }
        free(data);
        free(good);
    }
}

static void test_gaussian_stays_under_max_bytes(void **state)
{
    (void)state;
    uint32_t over = 0, denoised = 0;
    for (int k = 0; k < 12; ++k) {
        counter c = {0};
        gsd_desc d = {.bounds_max = {1, 1, 1},
                      .max_bytes = (uint64_t)(1 << 20) << k / 3,
                      .rho = 0.0005f,
                      .denoise = GSD_DENOISE_GAUSSIAN,
                      .gaussian_rho = k % 3 == 0 ? 1e-5f : 0.001f,
                      .min_samples = 1,
                      .split_samples = 100,
                      .gaussian_no_limit = true,
                      .alias = k & 1,
                      .allocate = count_allocate,
                      .release = count_release,
                      .user = &c};
        crowd team = {2, 1};
        gsd_field *f;
        gsd_stream *s;
        OK(gsd_create(&d, &f));
        OK(gsd_stream_create(f, &s));
        rng_state = 9;
        for (int pass = 0; pass < 5; ++pass) {
            gsd_stats stats;
            record_box(s, 20000);
            OK(gsd_accumulate(f, &s, 1, NULL, NULL));
            size_t others = c.bytes; /* stream and scratch are outside the cap */
            gsd_get_stats(f, &stats);
            others -= (size_t)stats.bytes;
            gsd_stream_clear(s);
            c.peak = c.bytes;
            OK(gsd_refine(f, NULL, k % 2 ? crowd_for : NULL, &team));
            OK(gsd_validate(f));
            gsd_get_stats(f, &stats);
            if (c.peak - others > d.max_bytes || stats.peak_bytes > d.max_bytes)
                fail_msg("cap %llu: %llu held", (unsigned long long)d.max_bytes, (unsigned long long)(c.peak - others));
            assert_true((double)(c.peak - others) <= 1.02 * (double)stats.peak_bytes);
            over += stats.over_budget_trees;
            denoised += stats.denoised_trees;
        }
        gsd_stream_destroy(s);
        gsd_destroy(f);
        assert_int_equal(c.live, 0);
    }
    print_message("%u trees denoised, %u not for want of memory\n", denoised, over);
    assert_true(over > 0 && denoised > 100);
}

/* Fields that fill the cap: trees whose results would not leave room for the new part are left alone, so that a refine
   that fits without denoising fits with it too. */
static void test_gaussian_gives_back_what_does_not_fit(void **state)
{
    (void)state;
    uint32_t back = 0, fitted = 0;
    for (uint32_t cells = 100; cells <= 180; cells += 4) {
        gsd_desc d = {.max_bytes = 1 << 20, .gaussian_rho = 0.004f, .gaussian_sigma = 3, .gaussian_no_limit = true};
        gsd_field *f = gaussian_forest(d, cells), *off;
        gsd_pass pass = {.denoise = GSD_DENOISE_OFF};
        gsd_stats stats, plain;
        tree *t = make_tree(7, 6, -1);
        for (uint32_t c = 0; c < cells; ++c)
            plant(f, c, t, 1000);
        free(t);
        size_t size = gsd_save_bound(f);
        void *data = malloc(size);
        OK(gsd_save(f, data, size, &size));
        OK(gsd_load(NULL, data, size, &off));
        OK(gsd_refine(off, &pass, NULL, NULL));
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        gsd_get_stats(f, &stats);
        gsd_get_stats(off, &plain);
        assert_int_equal(stats.denoised_trees + stats.over_budget_trees, cells);
        if (plain.peak_bytes <= d.max_bytes) {
            fitted++;
            back += stats.denoised_trees > 0 && stats.over_budget_trees > 0;
            assert_true(stats.peak_bytes <= d.max_bytes);
        }
        free(data);
        gsd_destroy(f);
        gsd_destroy(off);
    }
    print_message("%u fields fit, %u of them denoised in part\n", fitted, back);
    assert_true(fitted > 10 && back > 3);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_surroundings_match_matrices),
        cmocka_unit_test(test_strength_is_where_the_halves_agree_best),
        cmocka_unit_test(test_hostile_trees_keep_their_mass),
        cmocka_unit_test(test_even_trees_stay_even),
        cmocka_unit_test(test_denoising_pays),
        cmocka_unit_test(test_blur_adds_leaves),
        cmocka_unit_test(test_budget_is_kept),
        cmocka_unit_test(test_blur_takes_over_from_smoothing),
        cmocka_unit_test(test_steps_are_told),
        cmocka_unit_test(test_pass_says_otherwise),
        cmocka_unit_test(test_any_threads_give_the_same_field),
        cmocka_unit_test(test_gaussian_layers_match_the_twin),
        cmocka_unit_test(test_gaussian_trees_match_the_twin),
        cmocka_unit_test(test_gaussian_refine_matches_the_twin),
        cmocka_unit_test(test_gaussian_work_is_limited),
        cmocka_unit_test(test_gaussian_survives_hostile_trees),
        cmocka_unit_test(test_gaussian_survives_failed_allocations),
        cmocka_unit_test(test_gaussian_stays_under_max_bytes),
        cmocka_unit_test(test_gaussian_gives_back_what_does_not_fit),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
