/* test_sdtree.c: guide_sdtree.h against independent references in double precision.

   gcc -std=c11 -O2 -I. tests/test_sdtree.c -lcmocka -lm -lpthread
   GUIDE_TEST_LONG=1 takes ten times as many samples in the statistical tests. */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "chi_square.h"
#include "counter.h"
#include "crowd.h"
#include "rng.h"

#define PI 3.14159265358979323846

/* ---- helpers */

static long scaled(long n) { return getenv("GUIDE_TEST_LONG") ? 10 * n : n; }

#define OK(call) assert_int_equal((call), GSD_OK)

static gsd_desc unit_cube(gsd_target target)
{
    gsd_desc d;
    memset(&d, 0, sizeof d);
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    d.target = target;
    return d;
}

/* A random quadtree as plain arrays: grows `inner` nodes, preferring deep ones, to max_depth. */
static gsd_tree random_tree(uint32_t cell, uint32_t inner, uint32_t max_depth)
{
    gsd_tree t = {cell, 1, calloc(inner * 4, sizeof(uint32_t)), calloc(inner * 4, sizeof(float))};
    uint32_t *depth = calloc(inner, sizeof *depth);
    for (uint32_t i = 0; i < inner * 4; ++i)
        t.value[i] = rnd() < 0.15 ? 0 : (float)exp(6 * rnd());
    for (uint32_t tries = 0; t.count < inner && tries < inner * 100; ++tries) {
        uint32_t parent = rnd() < 0.5 ? t.count - 1 : (uint32_t)(rnd() * t.count), k = (uint32_t)(rnd() * 4);
        if (depth[parent] + 2 > max_depth || t.child[parent * 4 + k])
            continue;
        t.child[parent * 4 + k] = t.count;
        depth[t.count++] = depth[parent] + 1;
    }
    free(depth);
    return t;
}

static void free_tree(gsd_tree *t)
{
    free(t->child);
    free(t->value);
}

/* A forest with one imported tree per cell; frees the trees. */
static gsd_field *forest_of_trees(gsd_tree *trees, uint32_t cells, gsd_desc d)
{
    gsd_field *field;
    d.forest_cells = cells;
    d.max_bytes = (uint64_t)1 << 32;
    OK(gsd_create(&d, &field));
    OK(gsd_import_trees(field, trees, cells));
    for (uint32_t c = 0; c < cells; ++c)
        free_tree(&trees[c]);
    OK(gsd_validate(field));
    return field;
}

static gsd_field *forest_of(uint32_t cells, uint32_t inner, uint32_t max_depth, bool alias, gsd_simd simd)
{
    gsd_desc d = {.max_depth = max_depth, .alias = alias, .simd = simd};
    gsd_tree *trees = calloc(cells, sizeof *trees);
    for (uint32_t c = 0; c < cells; ++c)
        trees[c] = random_tree(c, inner, max_depth);
    gsd_field *field = forest_of_trees(trees, cells, d);
    free(trees);
    return field;
}

/* Naive double-precision lookup in an exported tree: probability and solid angle of the leaf of (x, y) in [0,1)^2. */
static void naive_leaf(const gsd_tree *t, double x, double y, double *probability, double *area, uint32_t *id)
{
    uint32_t node = 0;
    *area = 4 * PI;
    for (;;) {
        int bx = x >= 0.5, by = y >= 0.5;
        x = 2 * x - bx;
        y = 2 * y - by;
        *area /= 4;
        uint32_t k = node * 4 + (uint32_t)(bx + 2 * by);
        if (t->child[k] == 0) {
            *probability = (double)t->value[k];
            *id = k;
            return;
        }
        node = t->child[k];
    }
}

static void naive_coordinates(const float d[3], double *x, double *y)
{
    double phi = atan2((double)d[1], (double)d[0]) / (2 * PI);
    *x = phi < 0 ? phi + 1 : phi;
    *x = *x >= 1 ? 0 : *x;
    *y = ((double)d[2] + 1) / 2;
    *y = *y < 0 ? 0 : *y > 1 - 1e-12 ? 1 - 1e-12 : *y;
}

static gsd_tree export(const gsd_field *f, gsd_part part, uint32_t cell)
{
    gsd_tree t = {cell, gsd_export_bound(f, part, cell), NULL, NULL};
    t.child = calloc(t.count * 4, sizeof *t.child);
    t.value = calloc(t.count * 4, sizeof *t.value);
    OK(gsd_export_tree(f, part, &t));
    return t;
}

static double naive_pdf(const gsd_tree *t, double e, const float d[3])
{
    double x, y, p, area;
    uint32_t id;
    naive_coordinates(d, &x, &y);
    naive_leaf(t, x, y, &p, &area, &id);
    return (1 - e) * p / area + e / (4 * PI);
}

/* ---- options */

/* Every "default N" in the comments of gsd_desc is what gsd_resolve gives. */
static void test_documented_defaults_are_the_defaults(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_DEFAULT);
    OK(gsd_resolve(&d, &d));
    const struct {
        const char *name;
        double value;
    } fields[] = {{"switch_after", (double)d.switch_after},
                  {"split_samples", (double)d.split_samples},
                  {"rho", (double)d.rho},
                  {"smoothing", (double)d.smoothing},
                  {"gaussian_sigma", (double)d.gaussian_sigma},
                  {"denoise_budget", (double)d.denoise_budget},
                  {"max_depth", d.max_depth},
                  {"max_levels", d.max_levels},
                  {"min_samples", d.min_samples},
                  {"max_bytes", (double)d.max_bytes},
                  {"alpha", (double)d.alpha},
                  {"uniform", (double)d.uniform},
                  {"gate_margin", (double)d.gate_margin},
                  {"gate_gain", (double)d.gate_gain},
                  {"gate_probe", d.gate_probe}};
    FILE *f = fopen("guide_sdtree.h", "r");
    f = f ? f : fopen("../guide_sdtree.h", "r");
    assert_non_null(f);
    char line[512];
    unsigned seen = 0;
    bool inside = false;
    while (fgets(line, sizeof line, f)) {
        inside = inside || strstr(line, "typedef struct gsd_desc");
        if (strstr(line, "} gsd_desc;"))
            break;
        for (unsigned i = 0; inside && i < sizeof fields / sizeof *fields; ++i) {
            char key[64];
            snprintf(key, sizeof key, " %s;", fields[i].name);
            const char *at = strstr(line, key), *text = at ? strstr(at, "default ") : NULL;
            if (!text)
                continue;
            double value, exponent;
            int n = sscanf(text, "default %lf^%lf", &value, &exponent);
            assert_true(n >= 1);
            value = n == 2 ? pow(value, exponent) : value;
            assert_true(fabs(value - fields[i].value) <= 1e-6 * value);
            seen++;
        }
    }
    fclose(f);
    assert_int_equal(seen, sizeof fields / sizeof *fields);
    assert_int_equal(d.target, GSD_TARGET_SWITCHING);
    assert_int_equal(d.spatial_filter, GSD_SPATIAL_NEAREST);
    assert_int_equal(d.directional_filter, GSD_DIRECTIONAL_BOX);
    assert_int_equal(d.alpha_mode, GSD_ALPHA_GRID);
}

static void test_bad_descriptors_are_refused_by_name(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE), r;
    gsd_field *field = (gsd_field *)&d;
    memset(&d, 0, sizeof d);
    assert_int_equal(gsd_create(&d, &field), GSD_BAD_BOUNDS);
    assert_null(field);
    d = unit_cube(GSD_TARGET_RADIANCE);
    d.bounds_max[1] = NAN;
    assert_int_equal(gsd_resolve(&d, &r), GSD_BAD_BOUNDS);
    d = unit_cube((gsd_target)17);
    assert_int_equal(gsd_resolve(&d, &r), GSD_BAD_OPTION);
    d = unit_cube(GSD_TARGET_RADIANCE);
    d.rho = NAN;
    assert_int_equal(gsd_resolve(&d, &r), GSD_BAD_RANGE);
    d = unit_cube(GSD_TARGET_RADIANCE);
    d.max_depth = 21;
    assert_int_equal(gsd_resolve(&d, &r), GSD_BAD_RANGE);
    d = unit_cube(GSD_TARGET_RADIANCE);
    d.allocate = count_allocate;
    assert_int_equal(gsd_resolve(&d, &r), GSD_BAD_ALLOCATOR);
    for (int i = 0; i <= GSD_RESULT_COUNT; ++i)
        assert_true(strlen(gsd_result_string((gsd_result)i)) > 1);
    assert_non_null(strstr(gsd_result_string(GSD_BAD_BOUNDS), "bounds_min"));
}

static void test_sizes_are_as_documented(void **state)
{
    (void)state;
    assert_int_equal(sizeof(gsd_node), 16);
    assert_int_equal(sizeof(gsd_alias), 12);
    assert_int_equal(sizeof(gsd_cell), 64);
    assert_int_equal(sizeof(gsd_handle), 56);
    assert_int_equal(sizeof(gsd_training_sample), 48);
    assert_int_equal(sizeof(gsdi_tree), 32);
    assert_true(sizeof(gsdi_state) < 600);
    assert_int_equal(sizeof(gsd_stats), 15 * 8 + 22 * 4);
    assert_int_equal(sizeof(gsdi_sum) + sizeof(uint32_t), 20);
    /* bytes of a field: 16 a node in the sampling part, 20 in the building part */
    gsd_field *few = forest_of(1, 40, 16, false, GSD_SIMD_AUTO), *many = forest_of(1, 1040, 16, false, GSD_SIMD_AUTO);
    gsd_stats a, b;
    gsd_get_stats(few, &a);
    gsd_get_stats(many, &b);
    assert_int_equal(b.nodes - a.nodes, 4000);
    assert_int_equal(b.bytes - a.bytes, 16 * 4000);
    gsd_destroy(few);
    gsd_destroy(many);
}

/* ---- distributions */

static void test_pdf_integrates_to_one(void **state)
{
    (void)state;
    const uint32_t depths[] = {1, 2, 5, 9, 16, 20};
    for (unsigned i = 0; i < 6; ++i)
        for (unsigned round = 0; round < 8; ++round) {
            seed(100 * i + round);
            uint32_t inner = depths[i] < 3 ? 1 + depths[i] : 20 + 300 * round;
            gsd_field *f = forest_of(1, inner, depths[i], false, GSD_SIMD_AUTO);
            gsd_view v = gsd_get_view(f);
            gsd_handle h = gsd_find_cell(&v, 0);
            double total = 0, low = 1, quadrature = 0;
            const gsdi_tree *t = &gsdi_trees(f->block)[gsdi_cells(f->block)[0].tree];
            for (uint32_t k = 0; k < t->groups * 4; ++k) {
                const gsd_node *n = &v.nodes[t->first + k];
                if (n->leaf.child == 0) {
                    total += (double)n->leaf.pdf * 4 * PI * pow(0.25, n->leaf.x >> 24);
                    low = fmin(low, (double)n->leaf.pdf);
                }
            }
            assert_true(fabs(total - 1) < 1e-5);
            assert_true(low >= 0.0099 / (4 * PI));
            for (int y = 0; depths[i] <= 9 && y < 512; ++y)
                for (int x = 0; x < 512; ++x) { /* midpoints of depth 9: exact for these trees */
                    double z = (y + 0.5) / 256 - 1, phi = 2 * PI * (x + 0.5) / 512, r = sqrt(1 - z * z);
                    float d[3] = {(float)(r * cos(phi)), (float)(r * sin(phi)), (float)z};
                    quadrature += (double)gsd_pdf(&v, &h, d) * 4 * PI / (512 * 512);
                }
            assert_true(depths[i] > 9 || fabs(quadrature - 1) < 1e-5);
            gsd_destroy(f);
        }
}

/* Chi-square of counts and its degrees of freedom; slots that expect fewer than 20 are counted as one. What expects
   nothing must be empty. */
static double chi_square(const double *expected, const long *seen, uint32_t slots, double *df)
{
    double rest = 0, rest_seen = 0, chi2 = 0;
    *df = -1;
    for (uint32_t i = 0; i < slots; ++i) {
        assert_true(expected[i] > 0 || seen[i] == 0);
        if (expected[i] < 20) {
            rest += expected[i];
            rest_seen += (double)seen[i];
            continue;
        }
        chi2 += ((double)seen[i] - expected[i]) * ((double)seen[i] - expected[i]) / expected[i];
        *df += 1;
    }
    if (rest > 5) {
        chi2 += (rest_seen - rest) * (rest_seen - rest) / rest;
        *df += 1;
    }
    return chi2;
}

static void chi_square_of(bool alias, uint32_t depth, uint64_t s)
{
    seed(s);
    gsd_field *f = forest_of(1, 60, depth, alias, GSD_SIMD_AUTO);
    gsd_view v = gsd_get_view(f);
    gsd_handle h = gsd_find_cell(&v, 0);
    gsd_tree t = export(f, GSD_PART_SAMPLING, 0);
    double *expected = calloc(t.count * 4, sizeof *expected), chi2, df;
    long *seen = calloc(t.count * 4, sizeof *seen), n = scaled(1000000);
    uint32_t *depths = calloc(t.count, sizeof *depths);
    for (uint32_t i = 0; i < t.count; ++i)
        for (uint32_t k = 0; k < 4; ++k) {
            uint32_t c = t.child[i * 4 + k];
            if (c)
                depths[c] = depths[i] + 1;
            else
                expected[i * 4 + k] = (double)n * (0.99 * (double)t.value[i * 4 + k] + 0.01 * pow(0.25, depths[i] + 1));
        }
    for (long i = 0; i < n; ++i) {
        float u[2] = {rndf(), rndf()}, d[3];
        double x, y, p, area;
        uint32_t id;
        gsd_sample(&v, &h, u, d);
        naive_coordinates(d, &x, &y);
        naive_leaf(&t, x, y, &p, &area, &id);
        seen[id]++;
    }
    chi2 = chi_square(expected, seen, t.count * 4, &df);
    if (chi_square_deviate(chi2, df) > 4)
        fail_msg("chi-square %g at %g degrees of freedom (alias %d)", chi2, df, alias);
    free(expected);
    free(seen);
    free(depths);
    free_tree(&t);
    gsd_destroy(f);
}

static void test_samples_follow_the_density(void **state)
{
    (void)state;
    for (uint64_t s = 0; s < 3; ++s)
        chi_square_of(false, 12, 7 + s);
}

static void test_alias_samples_follow_the_density(void **state)
{
    (void)state;
    for (uint64_t s = 0; s < 3; ++s)
        chi_square_of(true, 12, 7 + s);
}

/* One leaf holds nearly all; tens of thousands of others fill their slots of the alias table from it, one by one. */
static void test_alias_table_of_a_hot_leaf_adds_up(void **state)
{
    (void)state;
    enum { INNER = 20000 };
    seed(31);
    gsd_tree t = random_tree(0, INNER, 16);
    for (uint32_t i = 0; i < t.count * 4; ++i)
        t.value[i] = 1e-4f * t.value[i];
    t.value[3] = t.child[3] ? 0 : 3e4f;
    t.value[t.count * 4 - 1] = 3e4f;
    gsd_field *f = forest_of_trees(&t, 1, (gsd_desc){.alias = true});
    gsd_view v = gsd_get_view(f);
    gsd_handle h = gsd_find_cell(&v, 0);
    uint32_t nodes = f->block->nodes;
    double *share = calloc(nodes, sizeof *share), worst = 0, e = (double)v.uniform;
    assert_true(h.alias_count > INNER);
    for (uint32_t i = 0; i < h.alias_count; ++i) {
        const gsd_alias *a = &v.aliases[h.alias + i];
        share[a->node] += (double)a->threshold / h.alias_count;
        share[a->other] += (1 - (double)a->threshold) / h.alias_count;
    }
    for (uint32_t i = 0; i < nodes; ++i) {
        const gsd_node *n = &v.nodes[i];
        double area = 4 * PI * pow(0.25, n->leaf.x >> 24);
        if (n->leaf.child == 0 && i >= f->block->roots)
            worst = fmax(worst, fabs(share[i] - ((double)n->leaf.pdf - e / (4 * PI)) / (1 - e) * area));
    }
    assert_true(worst < 1e-6);
    free(share);
    gsd_destroy(f);
}

/* Within one leaf samples are uniform: chi-square on 16 x 16 of the one leaf that holds everything. */
static void test_samples_are_uniform_within_a_leaf(void **state)
{
    (void)state;
    for (int alias = 0; alias < 2; ++alias) {
        uint32_t child[8] = {0, 1, 0, 0, 0, 0, 0, 0};
        float value[8] = {0, 0, 0, 0, 0, 0, 1, 0};
        gsd_tree t = {0, 2, child, value};
        gsd_desc d = {.forest_cells = 1, .alias = alias, .uniform = 1e-4f};
        gsd_field *f;
        OK(gsd_create(&d, &f));
        OK(gsd_import_trees(f, &t, 1));
        gsd_view v = gsd_get_view(f);
        gsd_handle h = gsd_find_cell(&v, 0);
        static long seen[256];
        memset(seen, 0, sizeof seen);
        long n = 0;
        double chi2 = 0;
        for (int i = 0; i < 400000; ++i) {
            float u[2] = {rndf(), rndf()}, dir[3];
            double x, y;
            gsd_sample(&v, &h, u, dir);
            naive_coordinates(dir, &x, &y);
            x = (x - 0.5) * 4;
            y = (y - 0.25) * 4;
            if (x < 0 || x >= 1 || y < 0 || y >= 1)
                continue;
            seen[(int)(x * 16) + 16 * (int)(y * 16)]++;
            n++;
        }
        assert_true(n > 399000);
        for (int i = 0; i < 256; ++i)
            chi2 += pow((double)seen[i] - n / 256.0, 2) / (n / 256.0);
        assert_true(chi_square_deviate(chi2, 255) < 4);
        gsd_destroy(f);
    }
}

/* The pdf that sample returns is that of the rounded direction, exactly; it agrees with a double-precision lookup
   except where rounding moved the direction across a leaf's edge, which is rare. */
static void test_sample_and_pdf_agree(void **state)
{
    (void)state;
    for (int alias = 0; alias < 2; ++alias)
        for (uint32_t depth = 12; depth <= 20; depth += 8) {
            seed(depth);
            gsd_field *f = forest_of(1, 400, depth, alias, GSD_SIMD_AUTO);
            gsd_view v = gsd_get_view(f);
            gsd_handle h = gsd_find_cell(&v, 0);
            gsd_tree t = export(f, GSD_PART_SAMPLING, 0);
            long n = scaled(400000), other = 0;
            for (long i = 0; i < n; ++i) {
                float u[2] = {rndf(), rndf()}, d[3];
                float pdf = gsd_sample(&v, &h, u, d);
                assert_true(pdf == gsd_pdf(&v, &h, d));
                assert_true(fabs((double)d[0] * (double)d[0] + (double)d[1] * (double)d[1] +
                                 (double)d[2] * (double)d[2] - 1) < 1e-6);
                double naive = naive_pdf(&t, 0.01, d);
                other += fabs((double)pdf - naive) > 1e-4 * naive + 1e-5;
            }
            assert_true((double)other / (double)n < (depth == 20 ? 0.05 : 0.001));
            free_tree(&t);
            gsd_destroy(f);
        }
}

/* Estimating a known integral by sampling is unbiased, whatever the tree. */
static void test_estimates_with_the_density_are_unbiased(void **state)
{
    (void)state;
    seed(5);
    gsd_field *f = forest_of(1, 100, 10, false, GSD_SIMD_AUTO);
    gsd_view v = gsd_get_view(f);
    gsd_handle h = gsd_find_cell(&v, 0);
    double sum = 0, square = 0;
    long n = scaled(400000);
    for (long i = 0; i < n; ++i) {
        float u[2] = {rndf(), rndf()}, d[3];
        float pdf = gsd_sample(&v, &h, u, d);
        double x = (1 + 0.5 * (double)d[0] + (double)(d[1] * d[2])) / (double)pdf; /* integral 4 pi */
        sum += x;
        square += x * x;
    }
    double mean = sum / (double)n, error = sqrt((square / (double)n - mean * mean) / (double)n);
    assert_true(fabs(mean - 4 * PI) < 4.5 * error);
    gsd_destroy(f);
}

static void test_seam_poles_and_odd_directions(void **state)
{
    (void)state;
    const float d[][3] = {{1, 0, 0},         {1, -0.0f, 0},   {-1, 0, 0},     {-1, -0.0f, 0},
                          {0, 1, 0},         {0, -1, 0},      {0, 0, 1},      {0, 0, -1},
                          {-0.0f, -0.0f, 1}, {1, -1e-30f, 0}, {1, 1e-30f, 0}, {0, 0, 1.0001f}};
    const double x[] = {0, 0, 0.5, 0.5, 0.25, 0.75, 0, 0, 0, 1, 0, 0};
    for (unsigned i = 0; i < sizeof d / sizeof *d; ++i) {
        uint32_t cx, cy;
        gsd_coordinates(d[i], &cx, &cy);
        assert_true(fabs(cx / 16777216.0 - x[i]) < 2e-7);
        assert_true(cx < 16777216 && cy < 16777216);
    }
    float odd[4][3] = {{NAN, 0, 0}, {0, NAN, NAN}, {INFINITY, INFINITY, 0}, {0, 0, 0}};
    for (unsigned i = 0; i < 4; ++i) {
        uint32_t cx, cy;
        gsd_coordinates(odd[i], &cx, &cy);
        assert_true(cx < 16777216 && cy < 16777216);
    }
    double worst = 0;
    for (int i = 0; i < 1000000; ++i) {
        float dir[3];
        uint32_t cx, cy;
        double nx, ny;
        random_direction(dir);
        gsd_coordinates(dir, &cx, &cy);
        naive_coordinates(dir, &nx, &ny);
        double e = fabs((cx + 0.5) / 16777216.0 - nx);
        e = fmin(e, 1 - e);
        worst = fmax(worst, fmax(e, fabs((cy + 0.5) / 16777216.0 - ny)));
    }
    assert_true(worst < 1.5 / 16777216.0);
}

/* ---- the cosine: gsd_orient */

/* A leaf of an exported tree: lowest corner in 24-bit coordinates; id as naive_leaf gives it. */
typedef struct leaf {
    uint32_t x, y, depth, id;
    double probability;
} leaf;

static leaf *leaves_of(const gsd_tree *t, uint32_t *count)
{
    leaf *inner = calloc(t->count, sizeof *inner), *out = calloc(3 * t->count + 1, sizeof *out);
    *count = 0;
    for (uint32_t i = 0; i < t->count; ++i)
        for (uint32_t k = 0; k < 4; ++k) {
            uint32_t half = 8388608u >> inner[i].depth, c = t->child[i * 4 + k];
            leaf l = {inner[i].x + (k & 1) * half, inner[i].y + (k >> 1) * half, inner[i].depth + 1, i * 4 + k,
                      (double)t->value[i * 4 + k]};
            if (c)
                inner[c] = l;
            else
                out[(*count)++] = l;
        }
    free(inner);
    return out;
}

/* Where the density is constant: a leaf, or the part of a large leaf in one of the 8 x 8 bins. d: a direction in its
   middle, at (x, y) in [0, 1)^2. */
typedef struct part {
    uint32_t id, bin;
    double x, y, size, probability;
    float d[3];
} part;

static part *parts_of(const gsd_tree *t, uint32_t *count)
{
    uint32_t leaves;
    leaf *l = leaves_of(t, &leaves);
    part *out = calloc(leaves + 64, sizeof *out);
    *count = 0;
    for (uint32_t i = 0; i < leaves; ++i) {
        uint32_t n = l[i].depth < 3 ? 8u >> l[i].depth : 1;
        for (uint32_t k = 0; k < n * n; ++k) {
            part *p = &out[(*count)++];
            p->size = pow(0.5, l[i].depth) / n;
            p->x = l[i].x / 16777216.0 + p->size * (k % n + 0.5);
            p->y = l[i].y / 16777216.0 + p->size * (k / n + 0.5);
            p->id = l[i].id;
            p->bin = (uint32_t)(p->y * 8) * 8 + (uint32_t)(p->x * 8);
            p->probability = l[i].probability / (n * n);
            double z = 2 * p->y - 1, r = sqrt((1 - z) * (1 + z));
            p->d[0] = (float)(r * cos(2 * PI * p->x));
            p->d[1] = (float)(r * sin(2 * PI * p->x));
            p->d[2] = (float)z;
        }
    }
    free(l);
    return out;
}

/* The cosine that a bin counts with, from its definition: the mean of the bin's directions as a sum over many. */
static double naive_cosine(const double n[3], uint32_t bin)
{
    static double mean[64][3];
    const double h = (double)GSD_HORIZON, below = (double)GSD_BELOW;
    if (mean[0][2] == 0)
        for (uint32_t b = 0; b < 64; ++b) {
            double r = 0, c = 0, s = 0;
            enum { POINTS = 1 << 16 };
            for (int i = 0; i < POINTS; ++i) {
                double z = (b / 8 + (i + 0.5) / POINTS) / 4 - 1, phi = (b % 8 + (i + 0.5) / POINTS) * PI / 4;
                r += sqrt(1 - z * z) / POINTS;
                c += cos(phi) / POINTS;
                s += sin(phi) / POINTS;
            }
            mean[b][0] = r * c;
            mean[b][1] = r * s;
            mean[b][2] = (b / 8 + 0.5) / 4 - 1;
        }
    double t = n[0] * mean[bin][0] + n[1] * mean[bin][1] + n[2] * mean[bin][2];
    return below + (t < -h ? 0 : t > h ? t : (t + h) * (t + h) / (4 * h));
}

/* A cell's learned density in double precision, to be multiplied by the cosine to any normal. */
typedef struct reference {
    gsd_tree tree;
    double e, mass[64];
} reference;

static reference reference_of(const gsd_field *f, uint32_t cell)
{
    reference r = {export(f, GSD_PART_SAMPLING, cell), (double)gsd_get_desc(f)->uniform, {0}};
    uint32_t count;
    part *p = parts_of(&r.tree, &count);
    for (uint32_t i = 0; i < count; ++i)
        r.mass[p[i].bin] += p[i].probability;
    free(p);
    return r;
}

static double reference_mean_cosine(const reference *r, const double n[3])
{
    double mean = 0;
    for (uint32_t k = 0; k < 64; ++k)
        mean += r->mass[k] * naive_cosine(n, k);
    return mean;
}

/* At (x, y) in [0, 1)^2. */
static double reference_pdf(const reference *r, const double n[3], double x, double y)
{
    double p, area;
    uint32_t id, bin = (uint32_t)(y * 8) * 8 + (uint32_t)(x * 8);
    naive_leaf(&r->tree, x, y, &p, &area, &id);
    return (1 - r->e) * p / area * naive_cosine(n, bin) / reference_mean_cosine(r, n) + r->e / (4 * PI);
}

/* Axes first: poles, seam and bins' edges; then any. */
static void some_normal(unsigned k, float n[3])
{
    random_direction(n);
    if (k < 6)
        for (unsigned i = 0; i < 3; ++i)
            n[i] = i != k / 2 ? 0 : k % 2 ? -1.0f : 1.0f;
}

/* Trees of all kinds: leaves as large as a quarter of the sphere, all of them or beside small ones. */
static gsd_field *oriented_forest(unsigned kind, uint64_t s, gsd_desc d)
{
    const uint32_t depth[] = {1, 2, 2, 3, 4, 20, 20, 9, 12, 16, 20, 20};
    const uint32_t inner[] = {1, 3, 5, 12, 30, 2, 19, 200, 60, 300, 300, 900};
    seed(100 * kind + s);
    gsd_tree t = random_tree(0, inner[kind], depth[kind]);
    d.max_depth = depth[kind];
    return forest_of_trees(&t, 1, d);
}
enum { TREE_KINDS = 12 };

static void test_oriented_density_integrates_to_one(void **state)
{
    (void)state;
    for (unsigned kind = 0; kind < TREE_KINDS; ++kind)
        for (unsigned round = 0; round < 4; ++round) {
            gsd_field *f = oriented_forest(kind, round, (gsd_desc){.uniform = round % 2 ? 0 : 1e-4f});
            gsd_view v = gsd_get_view(f);
            gsd_tree t = export(f, GSD_PART_SAMPLING, 0);
            uint32_t count;
            part *p = parts_of(&t, &count);
            for (unsigned k = 0; k < 14; ++k) {
                gsd_handle h = gsd_find_cell(&v, 0);
                float n[3];
                double total = 0, low = 1;
                some_normal(k, n);
                gsd_orient(&v, &h, n);
                assert_true(h.product > 0 && h.alpha == 0.5f);
                for (uint32_t i = 0; i < count; ++i) {
                    double pdf = (double)gsd_pdf(&v, &h, p[i].d);
                    total += pdf * 4 * PI * p[i].size * p[i].size;
                    low = fmin(low, pdf);
                }
                if (fabs(total - 1) > 1e-5)
                    fail_msg("integral 1 %+g, kind %u round %u normal %u", total - 1, kind, round, k);
                assert_true(low > 0.99 * (double)v.uniform / (4 * PI));
            }
            free(p);
            free_tree(&t);
            gsd_destroy(f);
        }
}

static void test_oriented_density_matches_a_naive_reference(void **state)
{
    (void)state;
    for (unsigned kind = 0; kind < TREE_KINDS; ++kind)
        for (unsigned round = 0; round < 4; ++round) {
            const float uniform[] = {0.01f, 1e-4f, 0.5f, 1};
            gsd_field *f = oriented_forest(kind, 50 + round, (gsd_desc){.uniform = uniform[round]});
            gsd_view v = gsd_get_view(f);
            reference r = reference_of(f, 0);
            uint32_t count;
            part *p = parts_of(&r.tree, &count);
            for (unsigned k = 0; k < 10; ++k) {
                gsd_handle h = gsd_find_cell(&v, 0);
                float n[3];
                some_normal(k, n);
                gsd_orient(&v, &h, n);
                const double wide[3] = {(double)n[0], (double)n[1], (double)n[2]};
                for (uint32_t i = 0; i < count; i += 1 + count / 300) {
                    double pdf = (double)gsd_pdf(&v, &h, p[i].d);
                    double naive = reference_pdf(&r, wide, p[i].x, p[i].y);
                    if (fabs(pdf - naive) > 2e-5 * naive)
                        fail_msg("%g, expected %g: kind %u round %u normal %u", pdf, naive, kind, round, k);
                }
            }
            free(p);
            free_tree(&r.tree);
            gsd_destroy(f);
        }
}

/* Chi-square of draws against the reference, on quarters of all parts. */
static void oriented_chi_square(unsigned kind, unsigned normal, bool alias, bool batch)
{
    enum { BLOCK = 1000 };
    gsd_field *f = oriented_forest(kind, 9, (gsd_desc){.alias = alias});
    gsd_view v = gsd_get_view(f);
    gsd_handle handles[BLOCK];
    reference r = reference_of(f, 0);
    uint32_t count;
    part *p = parts_of(&r.tree, &count);
    uint32_t slots = r.tree.count * 4 * 64 * 4;
    double *expected = calloc(slots, sizeof *expected), chi2, df;
    long *seen = calloc(slots, sizeof *seen), n = scaled(200000);
    static float u[BLOCK][2], d[BLOCK][3], pdf[BLOCK], axis[3];
    some_normal(normal, axis);
    const double wide[3] = {(double)axis[0], (double)axis[1], (double)axis[2]};
    for (int i = 0; i < BLOCK; ++i) {
        handles[i] = gsd_find_cell(&v, 0);
        gsd_orient(&v, &handles[i], axis);
    }
    for (uint32_t i = 0; i < count; ++i)
        for (uint32_t k = 0; k < 4; ++k)
            expected[(p[i].id * 64 + p[i].bin) * 4 + k] =
                (double)n * reference_pdf(&r, wide, p[i].x, p[i].y) * PI * p[i].size * p[i].size;
    for (long at = 0; at < n; at += BLOCK) {
        for (int i = 0; i < BLOCK; ++i) {
            u[i][0] = rndf();
            u[i][1] = rndf();
        }
        if (batch)
            gsd_sample_batch(&v, BLOCK, NULL, handles, u[0], sizeof u[0], d[0], sizeof d[0], pdf);
        for (int i = 0; i < BLOCK; ++i) {
            double x, y, probability, area;
            uint32_t id;
            if (!batch)
                gsd_sample(&v, &handles[i], u[i], d[i]);
            naive_coordinates(d[i], &x, &y);
            naive_leaf(&r.tree, x, y, &probability, &area, &id);
            double side = fmin(sqrt(area / (4 * PI)), 0.125);
            uint32_t quarter = (uint32_t)(x / side * 2) % 2 + (uint32_t)(y / side * 2) % 2 * 2;
            seen[(id * 64 + (uint32_t)(y * 8) * 8 + (uint32_t)(x * 8)) * 4 + quarter]++;
        }
    }
    chi2 = chi_square(expected, seen, slots, &df);
    assert_true(df >= 15);
    if (chi_square_deviate(chi2, df) > 4)
        fail_msg("chi-square %g at %g degrees of freedom (kind %u, normal %u, alias %d, batch %d)", chi2, df, kind,
                 normal, alias, batch);
    free(expected);
    free(seen);
    free(p);
    free_tree(&r.tree);
    gsd_destroy(f);
}

static void test_oriented_samples_follow_the_density(void **state)
{
    (void)state;
    for (unsigned kind = 0; kind < 9; ++kind)
        oriented_chi_square(kind, kind % 2 ? 20 : kind % 6, kind % 3 == 1, false);
}

static void test_oriented_batches_follow_the_density(void **state)
{
    (void)state;
    for (unsigned kind = 0; kind < 9; ++kind)
        oriented_chi_square(kind, kind % 2 ? kind % 6 : 20, kind % 3 == 1, true);
}

/* As without a normal: the pdf that sample returns is that of the rounded direction. */
static void test_oriented_sample_and_pdf_agree(void **state)
{
    (void)state;
    for (unsigned kind = 0; kind < TREE_KINDS; ++kind) {
        gsd_field *f = oriented_forest(kind, 3, (gsd_desc){.alias = kind % 2});
        gsd_view v = gsd_get_view(f);
        reference r = reference_of(f, 0);
        long n = scaled(10000), other = 0, batch_other = 0;
        for (long i = 0; i < n; ++i) {
            gsd_handle h = gsd_find_cell(&v, 0);
            float axis[3], u[2] = {rndf(), rndf()}, d[3], again[3], pdf, batch_pdf;
            double x, y;
            some_normal((unsigned)i % 20, axis);
            gsd_orient(&v, &h, axis);
            const double wide[3] = {(double)axis[0], (double)axis[1], (double)axis[2]};
            pdf = gsd_sample(&v, &h, u, d);
            assert_true(pdf == gsd_pdf(&v, &h, d));
            gsd_sample_batch(&v, 1, NULL, &h, u, sizeof u, again, sizeof again, &batch_pdf);
            batch_other += batch_pdf != gsd_pdf(&v, &h, again);
            naive_coordinates(d, &x, &y);
            double naive = reference_pdf(&r, wide, x, y);
            other += fabs((double)pdf - naive) > 1e-4 * naive;
        }
        assert_true((double)other / (double)n < (kind == 10 || kind == 11 ? 0.05 : 0.001));
        assert_true(batch_other <= 1);
        free_tree(&r.tree);
        gsd_destroy(f);
    }
}

/* Cells of a forest are oriented one by one; what does not guide, or is no cell, stays as it is. */
static void test_cells_of_a_forest_are_oriented(void **state)
{
    (void)state;
    enum { CELLS = 12 };
    gsd_tree trees[CELLS];
    seed(21);
    for (uint32_t c = 0; c < CELLS; ++c)
        trees[c] = random_tree(c, 1 + 7 * c, c % 3 ? 9 : 2);
    memset(trees[4].value, 0, trees[4].count * 16); /* uniform */
    gsd_field *f = forest_of_trees(trees, CELLS, (gsd_desc){.max_depth = 9});
    gsd_view v = gsd_get_view(f);
    for (uint32_t c = 0; c < CELLS + 2; ++c)
        for (unsigned k = 0; k < 8; ++k) {
            gsd_handle plain = gsd_find_cell(&v, c), h = plain;
            float n[3];
            some_normal(k, n);
            gsd_orient(&v, &h, n);
            if (c == 4 || c >= CELLS) {
                assert_memory_equal(&h, &plain, sizeof h);
                continue;
            }
            assert_memory_equal(h.normal, n, sizeof n);
            memset(h.normal, 0, sizeof n);
            h.product = 0;
            assert_memory_equal(&h, &plain, sizeof h); /* nothing else has changed */
            gsd_orient(&v, &h, n);
            reference r = reference_of(f, c);
            const double wide[3] = {(double)n[0], (double)n[1], (double)n[2]};
            uint32_t count;
            part *p = parts_of(&r.tree, &count);
            for (uint32_t i = 0; i < count; i += 7) {
                double naive = reference_pdf(&r, wide, p[i].x, p[i].y);
                assert_true(fabs((double)gsd_pdf(&v, &h, p[i].d) - naive) <= 2e-5 * naive);
            }
            free(p);
            free_tree(&r.tree);
        }
    gsd_destroy(f);
    /* alpha = 1: nobody draws from the guide */
    seed(22);
    trees[0] = random_tree(0, 20, 9);
    f = forest_of_trees(trees, 1, (gsd_desc){.alpha = 1});
    v = gsd_get_view(f);
    gsd_handle plain = gsd_find_cell(&v, 0), h = plain;
    gsd_orient(&v, &h, (const float[3]){0, 0, 1});
    assert_memory_equal(&h, &plain, sizeof h);
    gsd_destroy(f);
}

/* Whether this machine has the level. */
static bool have_level(int level)
{
    gsd_desc probe = unit_cube(GSD_TARGET_RADIANCE), resolved;
    probe.simd = (gsd_simd)level;
    return gsd_resolve(&probe, &resolved) == GSD_OK;
}

/* Draws that end within rounding of a bin's edge in a leaf of many bins: still the density of the rounded direction. */
static void test_oriented_samples_at_edges_of_bins(void **state)
{
    (void)state;
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
        if (!have_level(level))
            continue;
        gsd_field *f = oriented_forest(0, 4, (gsd_desc){.simd = (gsd_simd)level});
        gsd_view v = gsd_get_view(f);
        long crossed = 0;
        for (int round = 0; round < 6000; ++round) {
            gsd_handle h = gsd_find_cell(&v, 0), handles[5];
            float n[3], u[5][2], d[5][3], pdf[5];
            uint32_t low = 1 << 20, high = (1 << 24) - 1, axis = (uint32_t)round % 2, x[2];
            float other = 0.1f + 0.9f * rndf();
            random_direction(n);
            gsd_orient(&v, &h, n);
            uint32_t wanted = 1 + (uint32_t)(rng_next() % 7);
            while (high - low > 1) { /* the first number that leads beyond the edge */
                uint32_t middle = (low + high) / 2;
                u[0][axis] = (float)middle * 0x1p-24f;
                u[0][1 - axis] = other;
                gsd_sample(&v, &h, u[0], d[0]);
                gsd_coordinates(d[0], &x[0], &x[1]);
                if (x[axis] >> 21 < wanted)
                    low = middle;
                else
                    high = middle;
            }
            for (uint32_t i = 0; i < 5; ++i) {
                u[i][axis] = (float)(low - 2 + i) * 0x1p-24f;
                u[i][1 - axis] = other;
                handles[i] = h;
                pdf[i] = gsd_sample(&v, &h, u[i], d[i]);
                assert_true(pdf[i] == gsd_pdf(&v, &h, d[i]));
                gsd_coordinates(d[i], &x[0], &x[1]);
                crossed += x[axis] + 1 - wanted * 2097152 < 2; /* the cell of numbers on either side */
            }
            gsd_sample_batch(&v, 5, NULL, handles, u[0], sizeof u[0], d[0], sizeof d[0], pdf);
            for (uint32_t i = 0; i < 5; ++i)
                assert_true(pdf[i] == gsd_pdf(&v, &h, d[i]));
        }
        assert_true(crossed > 3000); /* the edges were met */
        gsd_destroy(f);
    }
}

/* Normals that are none leave the density as it is; those far from unit length spoil nothing. */
static void test_odd_normals_do_no_harm(void **state)
{
    (void)state;
    const float i = INFINITY;
    const float plain_normals[][3] = {{0, 0, 0},       {NAN, 0, 0},    {0, NAN, 1},       {0.6f, 0.8f, NAN},
                                      {NAN, NAN, NAN}, {1e-20f, 0, 0}, {-0.0f, 0, 0},     {i, 0, 0},
                                      {0, -i, 0},      {0, 0, i},      {i, -i, 0},        {i, i, i},
                                      {-i, -i, -i},    {i, NAN, 0.5f}, {0.3f, 0.3f, 0.3f}};
    const float long_normals[][3] = {{2, 0, 0},          {0, -1e5f, 1e5f}, {1e18f, 0, 0},
                                     {1e30f, -1e30f, 0}, {0, 0, 3e38f},    {3e38f, 3e38f, 3e38f}};
    enum { PLAIN = sizeof plain_normals / sizeof *plain_normals, LONG = sizeof long_normals / sizeof *long_normals };
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level)
        for (unsigned kind = 0; have_level(level) && kind < TREE_KINDS; kind += 2) {
            gsd_field *f = oriented_forest(kind, 1, (gsd_desc){.simd = (gsd_simd)level, .alias = kind % 4 == 0});
            gsd_view v = gsd_get_view(f);
            gsd_handle found[PLAIN + LONG];
            float normals[PLAIN + LONG][3], positions[PLAIN + LONG][3] = {{0}};
            memcpy(normals, plain_normals, sizeof plain_normals);
            memcpy(normals + PLAIN, long_normals, sizeof long_normals);
            gsd_find_batch(&v, PLAIN + LONG, NULL, positions[0], 12, normals[0], 12, NULL, 0, found, NULL);
            for (unsigned k = 0; k < PLAIN + LONG; ++k) {
                gsd_handle plain = gsd_find_cell(&v, 0), h = gsd_find(&v, positions[k], normals[k], NULL);
                assert_true((h.product > 0) == (found[k].product > 0));
                for (int draw = 0; draw < 40; ++draw) {
                    float u[2] = {rndf(), rndf()}, d[3], e[3], pdf = gsd_sample(&v, &h, u, d), batch;
                    assert_true(isfinite(pdf) && pdf > 0 && pdf == gsd_pdf(&v, &h, d));
                    assert_true(fabsf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - 1) < 1e-6f);
                    gsd_sample_batch(&v, 1, NULL, &found[k], u, 8, e, 12, &batch);
                    assert_true(fabsf(batch - pdf) <= 2e-6f * pdf);
                    assert_true(k >= PLAIN || (pdf == gsd_sample(&v, &plain, u, e) && !memcmp(d, e, sizeof d)));
                }
            }
            gsd_destroy(f);
        }
}

/* Huge normals overflowed where all light is on the other side. */
static void test_normals_far_from_unit_are_none(void **state)
{
    (void)state;
    const float normals[][3] = {{3e38f, 0, 0}, {-3e38f, 0, 0}, {1e20f, 0, 0}, {1e4f, 0, 0}, {1.5f, 0, 0}, {0.6f, 0, 0}};
    gsd_tree t = {0, 1, calloc(4, sizeof(uint32_t)), calloc(4, sizeof(float))};
    t.value[0] = 1;
    gsd_field *f = forest_of_trees(&t, 1, (gsd_desc){.uniform = 0});
    gsd_view v = gsd_get_view(f);
    for (unsigned k = 0; k < sizeof normals / sizeof *normals; ++k) {
        gsd_handle plain = gsd_find_cell(&v, 0), h = plain, found;
        float position[3] = {0, 0, 0};
        gsd_orient(&v, &h, normals[k]);
        assert_true(h.product == 0);
        gsd_find_batch(&v, 1, NULL, position, 12, normals[k], 12, NULL, 0, &found, NULL);
        assert_true(found.product == 0);
        for (int draw = 0; draw < 40; ++draw) {
            float u[2] = {rndf(), rndf()}, d[3];
            assert_true(gsd_sample(&v, &h, u, d) == gsd_pdf(&v, &plain, d));
        }
    }
    gsd_destroy(f);
}

/* ---- the normal in a sample */

/* A packed normal in double precision: 8 + 8 bits of an octahedral map. False: none. */
static bool naive_normal(const uint32_t packed[2], double n[3])
{
    double a = ((double)(packed[0] >> 24) - 128) / 127, b = ((double)(packed[1] >> 24) - 128) / 127;
    double c = 1 - fabs(a) - fabs(b), x = a, y = b;
    if (packed[0] >> 24 == 0)
        return false;
    if (c < 0) { /* the lower half, folded outwards */
        x = copysign(1 - fabs(b), a);
        y = copysign(1 - fabs(a), b);
    }
    double l = sqrt(x * x + y * y + c * c);
    n[0] = x / l;
    n[1] = y / l;
    n[2] = c / l;
    return true;
}

static void test_normals_survive_packing(void **state)
{
    (void)state;
    seed(31);
    double worst = 0;
    for (unsigned i = 0; i < 200000; ++i) {
        float n[3], d[3], back[3];
        double wide[3];
        uint32_t packed[2], plain[2];
        random_direction(d);
        some_normal(i, n);
        if (i % 4 == 3) { /* on the folds of the map, and its corners */
            n[i / 4 % 3] = 0;
            float l = sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
            for (int k = 0; k < 3; ++k)
                n[k] /= l;
        }
        assert_true(gsd_pack_direction(d, n, packed));
        assert_true(gsd_pack_direction(d, NULL, plain));
        assert_true(plain[0] >> 24 == 0 && plain[1] >> 24 == 0);
        assert_true((packed[0] & 0xffffff) == plain[0] && (packed[1] & 0xffffff) == plain[1]);
        gsd_unpack_normal(packed, back);
        assert_true(naive_normal(packed, wide));
        double x = 0, cross;
        for (int k = 0; k < 3; ++k) {
            assert_true(fabs((double)back[k] - wide[k]) < 1e-6);
            x += (double)(n[k] - back[k]) * (double)(n[k] - back[k]);
        }
        cross = 2 * asin(sqrt(x) / 2);
        worst = cross > worst ? cross : worst;
    }
    assert_true(worst < PI / 180);
    assert_true(worst > 0.2 * PI / 180); /* 16 bits cannot do better: the test looks at all of them */
    /* no normal, or none that can be: zero comes back, and the direction is not harmed */
    const float none[][3] = {{0, 0, 0}, {NAN, 0, 0}, {0, 1, NAN}, {INFINITY, 0, 0}, {0, -INFINITY, 1}, {1e30f, 0, 0}};
    for (unsigned i = 0; i < sizeof none / sizeof *none; ++i) {
        const float d[3] = {0.6f, 0, -0.8f};
        float back[3] = {1, 1, 1};
        uint32_t packed[2], plain[2];
        assert_true(gsd_pack_direction(d, none[i], packed) && gsd_pack_direction(d, NULL, plain));
        assert_memory_equal(packed, plain, sizeof plain);
        gsd_unpack_normal(packed, back);
        assert_true(back[0] == 0 && back[1] == 0 && back[2] == 0);
    }
}

/* ---- batches */

static void test_batches_equal_single_queries_at_every_level(void **state)
{
    (void)state;
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level)
        for (int alias = 0; alias < 2; ++alias) {
            enum { N = 1003 };
            gsd_desc probe = unit_cube(GSD_TARGET_RADIANCE), resolved;
            probe.simd = (gsd_simd)level;
            if (gsd_resolve(&probe, &resolved) != GSD_OK)
                continue; /* this machine lacks it */
            seed((uint64_t)level);
            gsd_field *f = forest_of(40, 75, 16, alias, (gsd_simd)level);
            gsd_view v = gsd_get_view(f);
            static gsd_handle handles[N];
            static float u[N][2], dir[N][4], pdf[N], in[N][3];
            static uint32_t index[N];
            uint32_t n = 0;
            long apart = 0;
            for (uint32_t i = 0; i < N; ++i) {
                handles[i] = gsd_find_cell(&v, i % 43); /* 40 .. 42: no such cell: uniform */
                if (i % 5 < 2)                          /* seen from beside the pivot */
                    for (int k = 0; k < 3; ++k)
                        handles[i].offset[k] = 0.9f * rndf() - 0.45f;
                u[i][0] = i == 5 ? 0 : i == 6 ? 0x1.fffffep-1f : rndf();
                u[i][1] = i == 7 ? 0 : i == 6 ? 0x1.fffffep-1f : rndf();
                random_direction(in[i]);
                pdf[i] = -1;
                if (i % 3)
                    index[n++] = N - 1 - i;
            }
            gsd_sample_batch(&v, n, index, handles, u[0], sizeof u[0], dir[0], sizeof dir[0], pdf);
            for (uint32_t k = 0; k < n; ++k) {
                uint32_t i = index[k];
                float d[3], p = gsd_sample(&v, &handles[i], u[i], d);
                double away = fabs((double)(d[0] - dir[i][0])) + fabs((double)(d[1] - dir[i][1])) +
                              fabs((double)(d[2] - dir[i][2]));
                apart += fabsf(p - pdf[i]) > 2e-6f * p || away > 2e-6;
            }
            assert_true(apart <= 1);
            for (uint32_t i = 0; i < N; i += 3) /* not in the list: untouched */
                assert_true(pdf[N - 1 - i] == -1);
            gsd_pdf_batch(&v, N, NULL, handles, in[0], sizeof in[0], pdf);
            apart = 0;
            for (uint32_t i = 0; i < N; ++i)
                apart += fabsf(gsd_pdf(&v, &handles[i], in[i]) - pdf[i]) > 2e-6f * pdf[i];
            assert_true(apart <= 1);
            gsd_destroy(f);
        }
}

/* Oriented handles, such without a normal, with alias tables, of large leaves and of no cell, all in one batch. */
static void test_batches_of_oriented_handles_equal_single_queries(void **state)
{
    (void)state;
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level)
        for (int alias = 0; have_level(level) && alias < 2; ++alias) {
            enum { N = 5003, CELLS = 40 };
            gsd_tree trees[CELLS];
            seed((uint64_t)level + 60);
            for (uint32_t c = 0; c < CELLS; ++c)
                trees[c] = random_tree(c, 1 + 3 * c, c % 4 ? 16 : 2);
            gsd_field *f = forest_of_trees(trees, CELLS, (gsd_desc){.alias = alias, .simd = (gsd_simd)level});
            gsd_view v = gsd_get_view(f);
            assert_int_equal(v.simd, level);
            static gsd_handle handles[N];
            static float u[N][2], dir[N][4], pdf[N], in[N][3];
            static uint32_t index[N];
            uint32_t n = 0, oriented = 0;
            long apart = 0, rounded = 0;
            for (uint32_t i = 0; i < N; ++i) {
                float normal[3];
                handles[i] = gsd_find_cell(&v, i % (CELLS + 3));
                for (int k = 0; k < 3 && i % 5 < 2; ++k)
                    handles[i].offset[k] = 0.9f * rndf() - 0.45f;
                some_normal((unsigned)(rng_next() % 30), normal);
                if (rng_next() % 8 < (i / 500 % 2 ? 7 : 3)) /* now most are oriented, now few */
                    gsd_orient(&v, &handles[i], normal);
                else if (i % 2)
                    gsd_orient(&v, &handles[i], (const float[3]){0, 0, 0});
                oriented += handles[i].product > 0;
                u[i][0] = i == 5 ? 0 : i == 6 ? 0x1.fffffep-1f : rndf();
                u[i][1] = i == 7 ? 0 : i == 6 ? 0x1.fffffep-1f : rndf();
                random_direction(in[i]);
                pdf[i] = -1;
                if (i % 3)
                    index[n++] = N - 1 - i;
            }
            assert_true(oriented > N / 3 && oriented < 2 * N / 3);
            gsd_sample_batch(&v, n, index, handles, u[0], sizeof u[0], dir[0], sizeof dir[0], pdf);
            for (uint32_t k = 0; k < n; ++k) {
                uint32_t i = index[k];
                float d[3], p = gsd_sample(&v, &handles[i], u[i], d);
                double away = fabs((double)(d[0] - dir[i][0])) + fabs((double)(d[1] - dir[i][1])) +
                              fabs((double)(d[2] - dir[i][2]));
                apart += fabsf(p - pdf[i]) > 2e-6f * p || away > 2e-6;
                rounded += pdf[i] != gsd_pdf(&v, &handles[i], dir[i]);
            }
            assert_true(apart <= 1 && rounded <= 1);
            for (uint32_t i = 0; i < N; i += 3) /* not in the list: untouched */
                assert_true(pdf[N - 1 - i] == -1);
            gsd_pdf_batch(&v, n, index, handles, in[0], sizeof in[0], pdf);
            for (uint32_t i = 0; i < N; ++i)
                if (i % 3)
                    assert_true(pdf[N - 1 - i] == gsd_pdf(&v, &handles[N - 1 - i], in[N - 1 - i]));
                else
                    assert_true(pdf[N - 1 - i] == -1);
            gsd_pdf_batch(&v, N, NULL, handles, in[0], sizeof in[0], pdf);
            for (uint32_t i = 0; i < N; ++i)
                assert_true(pdf[i] == gsd_pdf(&v, &handles[i], in[i]));
            gsd_destroy(f);
        }
}

/* ---- learning */

static float scene_radiance(const float p[3], const float d[3])
{
    return d[0] > 0.9f ? 40 * (0.2f + p[1]) : d[2] > 0.5f ? 0.5f : 0.1f;
}

/* Component k of a sample's direction. */
static float direction_of(const gsd_training_sample *s, int k)
{
    float d[3];
    gsd_direction((s->direction[0] & 0xffffff) + 0.5, (s->direction[1] & 0xffffff) + 0.5, d);
    return d[k];
}

/* n samples drawn from the field, as a renderer would; every 7th is black. */
static void make_samples(const gsd_view *v, gsd_training_sample *s, uint32_t n)
{
    for (uint32_t i = 0; i < n; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, d[3], u[2] = {rndf(), rndf()};
        gsd_handle h = gsd_find(v, p, NULL, NULL);
        float pg = gsd_sample(v, &h, u, d), pb = (float)(0.25 / PI);
        if (rnd() < (double)h.alpha) {
            random_direction(d);
            pg = gsd_pdf(v, &h, d);
        }
        float mix = h.alpha * pb + (1 - h.alpha) * pg;
        float L = i % 7 ? scene_radiance(p, d) : 0;
        s[i] = gsd_make_scalar_sample(p, d, NULL, i % 5 ? 20 + p[1] : INFINITY, L, L * 0.3f, L * 0.3f * (0.5f + p[0]),
                                      mix, pb, pg);
    }
}

static void learn(gsd_field *f, const gsd_training_sample *s, uint32_t n)
{
    gsd_stream *stream;
    OK(gsd_stream_create(f, &stream));
    OK(gsd_record(stream, s, n));
    OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
    gsd_stream_destroy(stream);
}

static gsd_field *train(const gsd_desc *d, int passes, uint32_t first)
{
    gsd_field *f;
    OK(gsd_create(d, &f));
    for (int p = 0; p < passes; ++p) {
        uint32_t n = first << p;
        gsd_training_sample *s = malloc(n * sizeof *s);
        gsd_view v = gsd_get_view(f);
        make_samples(&v, s, n);
        learn(f, s, n);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        free(s);
    }
    return f;
}

static void *save(const gsd_field *f, size_t *size)
{
    size_t bound = gsd_save_bound(f);
    void *p = malloc(bound);
    OK(gsd_save(f, p, bound, size));
    assert_true(*size <= bound);
    return p;
}

static bool same_fields(const gsd_field *a, const gsd_field *b)
{
    size_t na, nb;
    void *pa = save(a, &na), *pb = save(b, &nb);
    bool same = na == nb && memcmp(pa, pb, na) == 0;
    free(pa);
    free(pb);
    return same;
}

/* The same samples, whatever the threads and the cuts into streams and calls, give the same bits. */
static void test_results_do_not_depend_on_threads_or_cuts(void **state)
{
    (void)state;
    enum { N = 60000 };
    gsd_training_sample *s = malloc(N * sizeof *s);
    for (int variant = 0; variant < 3; ++variant) {
        gsd_field *fields[5];
        gsd_desc d = unit_cube(variant == 0 ? GSD_TARGET_RADIANCE : GSD_TARGET_SIMPLE);
        d.split_samples = 500;
        d.spatial_filter = variant == 2 ? GSD_SPATIAL_STOCHASTIC : GSD_SPATIAL_NEAREST;
        d.alpha_mode = variant == 0 ? GSD_ALPHA_ADAM : GSD_ALPHA_GRID;
        for (int k = 0; k < 5; ++k)
            OK(gsd_create(&d, &fields[k]));
        for (int pass = 0; pass < 3; ++pass) {
            seed((uint64_t)pass);
            gsd_view v = gsd_get_view(fields[0]);
            make_samples(&v, s, N);
            for (int k = 0; k < 5; ++k) { /* 1, 2, 3, 4, 7 threads; k + 1 streams; k + 1 calls */
                crowd team = {k == 4 ? 7 : k + 1, 1};
                gsd_stream *streams[5];
                uint32_t at = 0;
                for (int i = 0; i <= k; ++i)
                    OK(gsd_stream_create(fields[k], &streams[i]));
                for (int call = 0; call <= k; ++call) {
                    for (int i = 0; i <= k; ++i) {
                        uint32_t end = (uint32_t)((uint64_t)N * (uint64_t)(call * (k + 1) + i + 1) /
                                                  (uint64_t)((k + 1) * (k + 1)));
                        gsd_stream_clear(streams[i]);
                        OK(gsd_record(streams[i], s + at, end - at));
                        assert_int_equal(gsd_stream_size(streams[i]), end - at);
                        at = end;
                    }
                    OK(gsd_accumulate(fields[k], streams, (uint32_t)k + 1, k ? crowd_for : NULL, &team));
                }
                assert_int_equal(at, N);
                for (int i = 0; i <= k; ++i)
                    gsd_stream_destroy(streams[i]);
                OK(gsd_refine(fields[k], NULL, k ? crowd_for : NULL, &team));
            }
            for (int k = 1; k < 5; ++k)
                assert_true(same_fields(fields[0], fields[k]));
        }
        assert_true(gsd_cell_count(fields[0]) > 8);
        for (int k = 0; k < 5; ++k)
            gsd_destroy(fields[k]);
    }
    free(s);
}

/* Leaf densities of every target against sums made in double precision by the formulas of the papers. */
static void test_targets_match_a_naive_reference(void **state)
{
    (void)state;
    enum { N = 20000 };
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_SWITCHING; ++target) {
        seed((uint64_t)target);
        gsd_desc d = unit_cube((gsd_target)target);
        gsd_field *f;
        static gsd_training_sample s[N];
        static double sum[2048];
        d.directional_filter = GSD_DIRECTIONAL_NEAREST;
        d.split_samples = 1e9f;
        d.switch_after = 2;
        d.smoothing = 0.001f;
        d.no_history = true;
        d.alpha_mode = GSD_ALPHA_FIXED;
        d.no_gate = true;
        d.denoise = GSD_DENOISE_OFF; /* test_sdtree_denoise.c */
        OK(gsd_create(&d, &f));
        for (int pass = 0; pass < 4; ++pass) {
            gsd_view v = gsd_get_view(f);
            gsd_tree t = export(f, GSD_PART_BUILDING, 0), now;
            uint32_t depth[512] = {0};
            double total = 0, area, p, x, y, e = 0.01;
            uint32_t id;
            assert_true(t.count <= 512);
            memset(sum, 0, sizeof sum);
            make_samples(&v, s, N);
            for (int i = 0; i < N; ++i)
                s[i].nearness = 0; /* the naive one knows no distances */
            for (int i = 0; i < N; ++i) {
                double alpha = 0.5, pb = (double)s[i].pdf_bsdf, pg = (double)s[i].pdf_guide;
                double w = (1 - alpha) * pg / (alpha * pb + (1 - alpha) * pg), value;
                bool variance = target == GSD_TARGET_VARIANCE || (target == GSD_TARGET_SWITCHING && pass >= 2);
                value = (double)(variance ? s[i].pixel_contribution : s[i].contribution) * w;
                value = target == GSD_TARGET_RADIANCE ? (double)s[i].radiance : value * value;
                x = ((s[i].direction[0] & 0xffffff) + 0.5) / 16777216;
                y = ((s[i].direction[1] & 0xffffff) + 0.5) / 16777216;
                naive_leaf(&t, x, y, &p, &area, &id);
                sum[id] += value / (double)s[i].pdf_mix;
            }
            learn(f, s, N);
            OK(gsd_refine(f, NULL, NULL, NULL));
            now = export(f, GSD_PART_SAMPLING, 0);
            assert_int_equal(now.count, t.count);
            for (uint32_t i = 0; i < t.count; ++i) /* the two may number their nodes differently */
                for (uint32_t k = 0; k < 4; ++k) {
                    uint32_t c = t.child[i * 4 + k];
                    if (c)
                        depth[c] = depth[i] + 1;
                    else if (target != GSD_TARGET_RADIANCE)
                        sum[i * 4 + k] = sqrt(sum[i * 4 + k] * pow(0.25, depth[i] + 1));
                    total += c ? 0 : sum[i * 4 + k];
                }
            v = gsd_get_view(f);
            gsd_handle h = gsd_find_cell(&v, 0);
            long far = 0;
            for (int i = 0; i < 2000; ++i) { /* by direction */
                x = ((s[i].direction[0] & 0xffffff) + 0.5) / 16777216;
                y = ((s[i].direction[1] & 0xffffff) + 0.5) / 16777216;
                naive_leaf(&now, x, y, &p, &area, &id);
                double naive = (1 - e) * p / area + e / (4 * PI);
                far += fabs((double)gsd_pdf(&v, &h,
                                            (const float[]){direction_of(&s[i], 0), direction_of(&s[i], 1),
                                                            direction_of(&s[i], 2)}) -
                            naive) > 2e-5 * naive;
                /* p itself, from the naive sums in the structure of the building tree */
                double q;
                naive_leaf(&t, x, y, &q, &area, &id);
                far += fabs(p - sum[id] / total) > 3e-5 * p + 1e-7;
            }
            assert_true(far <= 4);
            free_tree(&t);
            free_tree(&now);
        }
        gsd_destroy(f);
    }
}

/* The same with normals: the value is divided by the cosine of its bin, which queries multiply in again, where the
   target is a second moment; what the field evaluates of its own density has the normal in it, too. */
static void test_targets_with_normals_match_a_naive_reference(void **state)
{
    (void)state;
    enum { N = 20000 };
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_VARIANCE; ++target) {
        seed((uint64_t)target + 40);
        gsd_desc d = unit_cube((gsd_target)target);
        gsd_field *f;
        static gsd_training_sample s[N];
        static double sum[2048];
        d.directional_filter = GSD_DIRECTIONAL_NEAREST;
        d.split_samples = 1e9f;
        d.smoothing = 0.001f;
        d.no_history = true;
        d.alpha_mode = GSD_ALPHA_FIXED;
        d.alpha = 0.3f;
        d.no_gate = true;
        d.denoise = GSD_DENOISE_OFF; /* test_sdtree_denoise.c */
        OK(gsd_create(&d, &f));
        for (int pass = 0; pass < 4; ++pass) {
            gsd_view v = gsd_get_view(f);
            gsd_tree t = export(f, GSD_PART_BUILDING, 0), now;
            reference before = reference_of(f, 0);
            uint32_t depth[512] = {0}, id;
            double total = 0, area, p, x, y;
            long far = 0;
            assert_true(t.count <= 512);
            memset(sum, 0, sizeof sum);
            make_samples(&v, s, N);
            for (int i = 0; i < N; ++i) {
                float n[3], u[2] = {rndf(), rndf()}, dir[3];
                some_normal((unsigned)i % 50, n);
                gsd_handle h = gsd_find(&v, s[i].position, i % 5 ? n : NULL, NULL);
                float pb = (float)(0.25 / PI), pg = gsd_sample(&v, &h, u, dir);
                if (i % 2) {
                    random_direction(dir);
                    pg = gsd_pdf(&v, &h, dir);
                }
                /* every third: the renderer did not ask for the guide's density */
                s[i] = gsd_make_scalar_sample(s[i].position, dir, i % 5 ? n : NULL, INFINITY, s[i].radiance,
                                              s[i].contribution, s[i].pixel_contribution, 0.5f * (pb + pg), pb,
                                              i % 3 ? pg : 0);
                double wide[3], alpha = pass ? (double)d.alpha : 0.5; /* pass 0 did not guide */
                bool has = naive_normal(s[i].direction, wide);
                assert_true(has == (i % 5 != 0));
                x = ((s[i].direction[0] & 0xffffff) + 0.5) / 16777216;
                y = ((s[i].direction[1] & 0xffffff) + 0.5) / 16777216;
                double value = (double)(target == GSD_TARGET_VARIANCE ? s[i].pixel_contribution : s[i].contribution);
                double guide = (double)s[i].pdf_guide;
                naive_leaf(&before.tree, x, y, &p, &area, &id);
                if (i % 3 == 0)
                    guide = pass && has ? reference_pdf(&before, wide, x, y) : 0.99 * p / area + 0.01 / (4 * PI);
                value *= (1 - alpha) * guide / (alpha * (double)pb + (1 - alpha) * guide);
                value /= has ? naive_cosine(wide, (uint32_t)(y * 8) * 8 + (uint32_t)(x * 8)) : 1;
                value = target == GSD_TARGET_RADIANCE ? (double)s[i].radiance : value * value;
                naive_leaf(&t, x, y, &p, &area, &id);
                sum[id] += value / (double)s[i].pdf_mix;
            }
            learn(f, s, N);
            OK(gsd_refine(f, NULL, NULL, NULL));
            now = export(f, GSD_PART_SAMPLING, 0);
            assert_int_equal(now.count, t.count);
            for (uint32_t i = 0; i < t.count; ++i)
                for (uint32_t k = 0; k < 4; ++k) {
                    uint32_t c = t.child[i * 4 + k];
                    if (c)
                        depth[c] = depth[i] + 1;
                    else if (target != GSD_TARGET_RADIANCE)
                        sum[i * 4 + k] = sqrt(sum[i * 4 + k] * pow(0.25, depth[i] + 1));
                    total += c ? 0 : sum[i * 4 + k];
                }
            for (int i = 0; i < 2000; ++i) {
                double q;
                x = ((s[i].direction[0] & 0xffffff) + 0.5) / 16777216;
                y = ((s[i].direction[1] & 0xffffff) + 0.5) / 16777216;
                naive_leaf(&now, x, y, &p, &area, &id);
                naive_leaf(&t, x, y, &q, &area, &id);
                far += fabs(p - sum[id] / total) > 3e-5 * p + 1e-7;
            }
            assert_int_equal(far, 0);
            free_tree(&t);
            free_tree(&now);
            free_tree(&before.tree);
        }
        gsd_destroy(f);
    }
}

/* Share of a node's children are pulled towards evenness, as if `smoothing` more samples had been spread over it. The
   sums and their samples live on through passes of equal size, see test_history_keeps_half_of_all_samples. */
static void smooth_naively(const gsd_tree *t, const double *mass, uint32_t node, double probability, double lit,
                           double smoothing, double *out)
{
    double children[4], all = 0;
    for (uint32_t k = 0; k < 4; ++k) {
        /* mass of the subtree: of all leaves whose path goes through this child */
        uint32_t stack[64], top = 0;
        children[k] = 0;
        stack[top++] = node * 4 + k;
        while (top) {
            uint32_t at = stack[--top], c = t->child[at];
            for (uint32_t j = 0; c && j < 4; ++j)
                stack[top++] = c * 4 + j;
            children[k] += c ? 0 : mass[at];
        }
        all += children[k];
    }
    for (uint32_t k = 0; k < 4; ++k) {
        double n = lit * all, share = all > 0 ? children[k] / all : 0.25;
        double pulled = (n * share + smoothing / 4) / (n + smoothing);
        uint32_t c = t->child[node * 4 + k];
        if (c)
            smooth_naively(t, mass, c, probability * pulled, lit, smoothing, out);
        else
            out[node * 4 + k] = probability * pulled;
    }
}

static void test_smoothing_matches_a_naive_reference(void **state)
{
    (void)state;
    enum { N = 150, PASSES = 4, LEAVES = 4096 };
    const double kept[PASSES] = {0, 0, 0.5, 2.0 / 3}; /* of the passes before, in passes of equal size */
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_SIMPLE; ++target)
        for (int strength = 0; strength < 4; ++strength) {
            const float smoothing[] = {0.001f, 0, 40, 1000};
            gsd_desc d = unit_cube((gsd_target)target);
            gsd_field *f;
            static double sum[LEAVES], mass[LEAVES], expected[LEAVES];
            double lit = 0;
            d.directional_filter = GSD_DIRECTIONAL_NEAREST;
            d.split_samples = 1e9f;
            d.smoothing = smoothing[strength];
            d.max_depth = 2;
            d.rho = 1e-5f; /* every node that has something is divided: the tree keeps its shape */
            d.alpha_mode = GSD_ALPHA_FIXED;
            d.no_gate = true;
            d.no_guide_weight = true;
            d.denoise = GSD_DENOISE_OFF; /* test_sdtree_denoise.c */
            OK(gsd_create(&d, &f));
            double pull = smoothing[strength] > 0 ? (double)smoothing[strength] : (double)gsd_get_desc(f)->smoothing;
            memset(sum, 0, sizeof sum);
            seed((uint64_t)target * 10 + (uint64_t)strength);
            for (int pass = 0; pass < PASSES; ++pass) {
                gsd_training_sample s[N];
                gsd_tree t = export(f, GSD_PART_BUILDING, 0), now;
                double p, area, total = 0;
                uint32_t id;
                assert_int_equal(t.count, 5);
                for (int i = 0; i < LEAVES; ++i)
                    sum[i] *= kept[pass];
                lit *= kept[pass];
                for (int i = 0; i < N; ++i) {
                    float at[3] = {0.5f, 0.5f, 0.5f}, dir[3], L = (float)exp(2 * rnd());
                    random_direction(dir);
                    L *= dir[2] > 0.3f ? 5 : 1;
                    L = i % 3 == 0 ? 0 : i % 31 == 1 ? GSD_REJECTED : L; /* zeros are no evidence for a shape */
                    s[i] = gsd_make_scalar_sample(at, dir, NULL, INFINITY, L, L, L, 0.1f, 0.1f, 0.1f);
                    naive_leaf(&t, ((s[i].direction[0] & 0xffffff) + 0.5) / 16777216,
                               ((s[i].direction[1] & 0xffffff) + 0.5) / 16777216, &p, &area, &id);
                    sum[id] += (double)L * (target == GSD_TARGET_RADIANCE ? 1 : (double)L) / (double)0.1f;
                    lit += L > 0;
                }
                learn(f, s, N);
                OK(gsd_refine(f, NULL, NULL, NULL));
                for (uint32_t i = 0; i < t.count * 4; ++i) {
                    mass[i] = target == GSD_TARGET_RADIANCE ? sum[i] : sqrt(sum[i]);
                    total += mass[i];
                }
                for (uint32_t i = 0; i < t.count * 4; ++i)
                    mass[i] /= total;
                smooth_naively(&t, mass, 0, 1, lit, pull, expected);
                now = export(f, GSD_PART_SAMPLING, 0);
                double apart = 0;
                for (int i = 0; i < 200; ++i) { /* the two may number their nodes differently */
                    double x = rnd(), y = rnd();
                    naive_leaf(&t, x, y, &p, &area, &id);
                    double want = expected[id], raw = mass[id];
                    naive_leaf(&now, x, y, &p, &area, &id);
                    if (fabs(p - want) > 1e-5 * want)
                        fail_msg("share %g, expected %g, raw %g: target %d smoothing %g pass %d", p, want, raw, target,
                                 pull, pass);
                    apart = fmax(apart, fabs(want - raw));
                }
                assert_true(strength == 0 ? apart < 1e-4 : apart > 2e-4); /* and it matters */
                free_tree(&t);
                free_tree(&now);
            }
            gsd_destroy(f);
        }
}

/* The box filter against a brute-force one: overlap of a box of the leaf's size, unfolded over seam and poles. */
static void test_box_filter_matches_brute_force(void **state)
{
    (void)state;
    for (int round = 0; round < 40; ++round) {
        seed((uint64_t)round + 50);
        gsd_tree t = random_tree(0, 30, 6);
        uint32_t child[400], x = (uint32_t)(rng_next() & 0xffffff), y = (uint32_t)(rng_next() & 0xffffff), depth;
        double mass[400], sum[400] = {0}, expected[64][64] = {{0}};
        gsdi_sum halves[400] = {{{0, 0}}};
        unsigned char scratch[100];
        x = round % 5 == 0 ? (uint32_t)round : round % 5 == 1 ? 16777215u - (uint32_t)round : x;
        y = round % 3 == 0 ? (uint32_t)round * 3 : round % 3 == 1 ? 16777215u - (uint32_t)round * 7 : y;
        assert_true(gsdi_import_convert(&t, 16, child, mass, scratch) >= 0);
        gsdi_map map;
        gsdi_map_make(&map, child, halves, (uint32_t)round * 8); /* more samples: more levels unfolded */
        depth = 24;
        gsdi_map_node(&map, x, y, &depth);
        gsdi_splat_box(&map, round & 1, x, y, 3.0);
        for (int i = 0; i < 400; ++i) {
            sum[i] = halves[i].half[round & 1];
            assert_true(halves[i].half[!(round & 1)] == 0);
        }
        /* expected mass of a 64 x 64 grid: integrate the box with 512 x 512 points at odd sub-steps */
        double size = pow(0.5, depth);
        for (int j = 0; j < 512; ++j)
            for (int i = 0; i < 512; ++i) {
                double bx = x / 16777216.0 + ((i + 0.5) / 512 - 0.5) * size;
                double by = y / 16777216.0 + ((j + 0.5) / 512 - 0.5) * size;
                if (by < 0 || by >= 1) {
                    by = by < 0 ? -by : 2 - by;
                    bx += 0.5;
                }
                bx -= floor(bx);
                by = by >= 1 ? 1 - 1e-9 : by;
                expected[(int)(by * 64)][(int)(bx * 64)] += 3.0 / (512 * 512);
            }
        double total = 0;
        struct {
            uint32_t node;
            int x, y, n;
        } stack[64] = {{0, 0, 0, 64}};
        for (int top = 0; top >= 0;) {
            uint32_t node = stack[top].node;
            int x0 = stack[top].x, y0 = stack[top].y, n = stack[top].n;
            --top;
            if (child[node]) {
                for (int k = 0; k < 4; ++k) {
                    ++top;
                    stack[top].node = child[node] + (uint32_t)k;
                    stack[top].x = x0 + (k & 1) * n / 2;
                    stack[top].y = y0 + (k >> 1) * n / 2;
                    stack[top].n = n / 2;
                }
                continue;
            }
            double brute = 0;
            for (int j = y0; j < y0 + n; ++j)
                for (int i = x0; i < x0 + n; ++i)
                    brute += expected[j][i];
            assert_true(fabs(brute - sum[node]) < 0.02);
            total += sum[node];
        }
        assert_true(fabs(total - 3) < 1e-9);
        free_tree(&t);
    }
}

static void test_trees_refine_where_the_mass_is(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.split_samples = 1000;
    seed(3);
    gsd_field *f = train(&d, 5, 4000);
    gsd_tree t = export(f, GSD_PART_SAMPLING, 0);
    for (uint32_t i = 0; i < t.count; ++i) /* building structure of a pass: no leaf far above rho, no node far below */
        for (uint32_t k = 0; k < 4; ++k)
            assert_true(t.child[i * 4 + k] || (double)t.value[i * 4 + k] < 0.04);
    free_tree(&t);
    /* light from +x is found: most samples go there */
    gsd_view v = gsd_get_view(f);
    long hits = 0;
    for (int i = 0; i < 20000; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, u[2] = {rndf(), rndf()}, dir[3];
        gsd_handle h = gsd_find(&v, p, NULL, NULL);
        gsd_sample(&v, &h, u, dir);
        hits += dir[0] > 0.9f;
    }
    assert_true(hits > 14000); /* 5 % of the sphere, 86 % of the light */
    gsd_destroy(f);
}

/* ---- space */

/* Naive lookup: walk the spatial tree with positions in double precision. */
static uint32_t naive_cell(const gsd_view *v, const float p[3])
{
    double t[3];
    uint32_t link = v->spatial[0];
    for (int i = 0; i < 3; ++i)
        t[i] = ((double)p[i] - (double)v->origin[i]) * (double)v->scale / 16777216.0;
    for (int level = 0; !(link & GSD_CELL_BIT); ++level) {
        double *x = &t[level % 3];
        *x *= 2;
        link = v->spatial[link + (*x >= 1 ? 1 : 0)];
        *x -= *x >= 1 ? 1 : 0;
    }
    return link & ~GSD_CELL_BIT;
}

static void test_cells_split_where_samples_are(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.split_samples = 100;
    gsd_field *f;
    OK(gsd_create(&d, &f));
    static gsd_training_sample s[20000];
    for (int pass = 0; pass < 4; ++pass) {
        gsd_view v = gsd_get_view(f);
        seed((uint64_t)pass);
        make_samples(&v, s, 20000);
        for (int i = 0; i < 20000; ++i) /* all in a slab near x = 0.3, half of them in one corner of it */
            for (int k = 0; k < 3; ++k)
                s[i].position[k] = k == 0 ? 0.3f : i & 1 ? 0.05f * s[i].position[k] : s[i].position[k];
        learn(f, s, 20000);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
    }
    gsd_view v = gsd_get_view(f);
    static uint32_t counts[100000];
    long far = 0;
    assert_true(v.cell_count > 200 && v.cell_count < 2000);
    for (int i = 0; i < 20000; ++i) {
        gsd_handle h = gsd_find(&v, s[i].position, NULL, NULL);
        far += h.cell != naive_cell(&v, s[i].position);
        counts[h.cell]++;
    }
    assert_true(far < 20);
    for (uint32_t c = 0; c < v.cell_count; ++c)
        assert_true(counts[c] < 400);
    /* outside positions are clamped into the box, with u too */
    float outside[3] = {-1e30f, 1e30f, NAN}, u[3] = {0, 0.99f, 0.5f};
    assert_true(gsd_find(&v, outside, NULL, NULL).cell < v.cell_count);
    assert_true(gsd_find(&v, outside, NULL, u).cell < v.cell_count);
    /* batch */
    static gsd_handle handles[20000];
    static float alpha[20000];
    gsd_find_batch(&v, 20000, NULL, s[0].position, sizeof s[0], NULL, 0, NULL, 0, handles, alpha);
    for (int i = 0; i < 20000; ++i) {
        gsd_handle h = gsd_find(&v, s[i].position, NULL, NULL);
        assert_memory_equal(&h, &handles[i], sizeof h);
        assert_true(alpha[i] == h.alpha);
    }
    gsd_destroy(f);
}

/* By default a cell splits when it holds more than max(32, 2 sqrt(all samples held)): no cell is left with more, and no
   two halves were split that have no more together. */
static void test_split_threshold_follows_the_samples(void **state)
{
    (void)state;
    enum { N = 12000, CELLS = 4096 };
    static gsd_training_sample s[N];
    static uint32_t counts[CELLS];
    for (uint32_t n = 100; n <= N; n = n < 1000 ? n * 4 : n * 3) { /* 100, 400, 1600, 4800 */
        gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
        gsd_field *f;
        double limit = fmax(32, 2 * sqrt(n));
        long split = 0;
        OK(gsd_create(&d, &f));
        gsd_view v = gsd_get_view(f);
        seed(n);
        make_samples(&v, s, n);
        learn(f, s, n);
        OK(gsd_refine(f, NULL, NULL, NULL));
        v = gsd_get_view(f);
        assert_true(v.cell_count < CELLS);
        memset(counts, 0, sizeof counts);
        for (uint32_t i = 0; i < n; ++i)
            counts[gsd_find(&v, s[i].position, NULL, NULL).cell]++;
        for (uint32_t c = 0; c < v.cell_count; ++c)
            assert_true(counts[c] <= limit);
        for (uint32_t i = 0; i < f->block->spatial; ++i) {
            uint32_t first = v.spatial[i];
            if (first & GSD_CELL_BIT || !(v.spatial[first] & v.spatial[first + 1] & GSD_CELL_BIT))
                continue;
            assert_true(counts[v.spatial[first] & ~GSD_CELL_BIT] + counts[v.spatial[first + 1] & ~GSD_CELL_BIT] >
                        limit);
            split++;
        }
        assert_true(split > 0);
        gsd_destroy(f);
    }
}

/* find orients what it finds, alone and in batches: what gsd_find_cell and gsd_orient give. */
static void test_find_with_normals_equals_its_batch(void **state)
{
    (void)state;
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
        enum { N = 2003 };
        if (!have_level(level))
            continue;
        gsd_desc d = unit_cube(GSD_TARGET_SIMPLE);
        d.split_samples = 300;
        d.simd = (gsd_simd)level;
        seed(17);
        gsd_field *f = train(&d, 4, 3000);
        gsd_view v = gsd_get_view(f);
        static float position[N][3], normal[N][5], u[N][4], alpha[N];
        static gsd_handle handles[N];
        static uint32_t index[N];
        uint32_t n = 0, oriented = 0, moved = 0;
        for (uint32_t i = 0; i < N; ++i) {
            for (int k = 0; k < 3; ++k) {
                position[i][k] = rndf();
                u[i][k] = rndf();
            }
            some_normal(i % 9, normal[i]);
            if (i % 7 == 0)
                memset(normal[i], 0, sizeof normal[i]);
            if (i % 4)
                index[n++] = N - 1 - i;
        }
        for (int jitter = 0; jitter < 2; ++jitter) {
            memset(handles, 0x55, sizeof handles);
            memset(alpha, 0, sizeof alpha);
            gsd_find_batch(&v, n, index, position[0], sizeof position[0], normal[0], sizeof normal[0],
                           jitter ? u[0] : NULL, sizeof u[0], handles, alpha);
            for (uint32_t k = 0; k < n; ++k) {
                uint32_t i = index[k];
                gsd_handle h = gsd_find(&v, position[i], normal[i], jitter ? u[i] : NULL);
                gsd_handle plain = gsd_find(&v, position[i], NULL, jitter ? u[i] : NULL), by_hand;
                by_hand = gsd_find_cell(&v, plain.cell);
                gsd_see_from(&v, &by_hand, position[i]);
                assert_memory_equal(&by_hand, &plain, sizeof plain);
                gsd_orient(&v, &by_hand, normal[i]);
                assert_memory_equal(&by_hand, &h, sizeof h);
                assert_true(fabsf(handles[i].product - h.product) <= 2e-6f * h.product);
                h.product = handles[i].product;
                assert_memory_equal(&handles[i], &h, sizeof h);
                assert_true(alpha[i] == h.alpha);
                assert_true((h.product > 0) == (h.alpha < 1 && h.jump && i % 7 != 0));
                oriented += h.product > 0;
                moved += jitter && h.cell != gsd_find(&v, position[i], normal[i], NULL).cell;
            }
            gsd_handle untouched;
            memset(&untouched, 0x55, sizeof untouched);
            for (uint32_t i = 0; i < N; i += 4)
                assert_memory_equal(&handles[N - 1 - i], &untouched, sizeof untouched);
        }
        assert_true(oriented > N / 2 && moved > N / 4);
        gsd_destroy(f);
    }
}

/* A wall of no thickness, lit from one side: directions towards the lamp are preferred, those through it are not lost.
 */
static void test_thin_wall_lit_from_one_side(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    gsd_field *f;
    OK(gsd_create(&d, &f));
    static gsd_training_sample s[30000];
    for (int pass = 0; pass < 3; ++pass) {
        gsd_view v = gsd_get_view(f);
        seed((uint64_t)pass);
        make_samples(&v, s, 30000);
        for (int i = 0; i < 30000; ++i) { /* points on z = 0.5, both sides; light only from above */
            s[i].position[2] = 0.5f;
            s[i].nearness = 0;
            s[i].radiance = direction_of(&s[i], 2) > 0 ? 1 : 0;
        }
        learn(f, s, 30000);
        OK(gsd_refine(f, NULL, NULL, NULL));
    }
    gsd_view v = gsd_get_view(f);
    float p[3] = {0.4f, 0.6f, 0.5f}, down[3] = {0.1f, 0.1f, -0.9899495f}, up = 0;
    gsd_handle h = gsd_find(&v, p, NULL, NULL);
    for (int i = 0; i < 10000; ++i) {
        float dir[3];
        random_direction(dir);
        dir[2] = fabsf(dir[2]);
        up += gsd_pdf(&v, &h, dir) * (float)(2 * PI) / 10000;
    }
    assert_true(up > 0.9f && up < 0.996f);
    assert_true(gsd_pdf(&v, &h, down) > 0 && gsd_pdf(&v, &h, down) < 0.02f);
    gsd_destroy(f);
}

/* Both sides of such a wall in one cell, a bright lamp above, a dim one below: with normals each side samples its own.
 */
static void test_two_sided_cell_samples_the_side_that_is_asked_for(void **state)
{
    (void)state;
    enum { N = 20000 };
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_VARIANCE; ++target)
        for (int with = 0; with < 2; ++with) {
            gsd_desc d = unit_cube((gsd_target)target);
            gsd_field *f;
            static gsd_training_sample s[N];
            double above[2] = {0, 0};
            d.split_samples = 1e9f;
            d.no_gate = true;
            OK(gsd_create(&d, &f));
            seed((uint64_t)target);
            for (int pass = 0; pass < 4; ++pass) {
                gsd_view v = gsd_get_view(f);
                for (int i = 0; i < N; ++i) {
                    float side = i & 1 ? -1.0f : 1.0f, p[3] = {rndf(), rndf(), 0.5f}, n[3] = {0, 0, side};
                    float u[2] = {rndf(), rndf()}, dir[3], pb = (float)(0.25 / PI);
                    gsd_handle h = gsd_find(&v, p, with ? n : NULL, NULL);
                    float pg = gsd_sample(&v, &h, u, dir);
                    if (rnd() < (double)h.alpha) {
                        random_direction(dir);
                        pg = gsd_pdf(&v, &h, dir);
                    }
                    float cosine = dir[2] * side, mix = h.alpha * pb + (1 - h.alpha) * pg;
                    float L = cosine > 0.7f ? (side > 0 ? 10 : 4) : 0.05f, g = cosine > 0 ? L * cosine : 0;
                    s[i] = gsd_make_scalar_sample(p, dir, with ? n : NULL, INFINITY, cosine > 0 ? L : GSD_REJECTED, g,
                                                  g, mix, pb, pg);
                }
                learn(f, s, N);
                OK(gsd_refine(f, NULL, NULL, NULL));
            }
            assert_int_equal(gsd_cell_count(f), 1);
            gsd_view v = gsd_get_view(f);
            for (int i = 0; i < 20000; ++i) {
                float side = i & 1 ? -1.0f : 1.0f, p[3] = {0.4f, 0.6f, 0.5f}, n[3] = {0, 0, side}, dir[3];
                float u[2] = {rndf(), rndf()};
                gsd_handle h = gsd_find(&v, p, with ? n : NULL, NULL);
                gsd_sample(&v, &h, u, dir);
                above[i & 1] += dir[2] * side > 0 ? 1 / 10000.0 : 0;
            }
            if (with ? above[0] < 0.9 || above[1] < 0.9 : above[0] < 0.6 || above[1] > 0.4)
                fail_msg("above the horizon: %g and %g, target %d, normals %d", above[0], above[1], target, with);
            gsd_destroy(f);
        }
}

/* ---- bad input */

static void test_bad_samples_are_refused_and_leave_no_trace(void **state)
{
    (void)state;
    enum { N = 40000 };
    static gsd_training_sample clean[N], dirty[N + N / 100];
    const float bad[] = {NAN, INFINITY, -INFINITY, -1, 1e30f, 3e38f};
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_VARIANCE; ++target) {
        gsd_field *a, *b;
        uint32_t total = 0;
        d.target = (gsd_target)target;
        d.split_samples = 2000;
        OK(gsd_create(&d, &a));
        OK(gsd_create(&d, &b));
        for (int pass = 0; pass < 3; ++pass) {
            gsd_view v = gsd_get_view(a);
            uint32_t m = 0;
            seed((uint64_t)pass + 9);
            make_samples(&v, clean, N);
            for (int i = 0; i < N; ++i) {
                dirty[m++] = clean[i];
                if (i % 100)
                    continue;
                gsd_training_sample s = clean[(i + 77) % N];
                float x = bad[(i / 100) % 6], dir[3] = {0, 0, 1};
                switch ((i / 100) % 11) {
                case 0:
                    s.radiance = x;
                    break;
                case 1:
                    s.contribution = x;
                    break;
                case 2:
                    s.pixel_contribution = x;
                    break;
                case 3:
                    s.pdf_mix = isfinite(x) && x > 0 ? 0 : x;
                    break;
                case 4:
                    s.pdf_bsdf = isfinite(x) ? -1 : x;
                    break;
                case 5:
                    s.pdf_guide = isfinite(x) ? -1 : x;
                    break;
                case 6:
                    dir[i / 100 % 3] = isfinite(x) ? NAN : x;
                    s = gsd_make_scalar_sample(s.position, dir, NULL, INFINITY, 1, 1, 1, 1, 1, 0);
                    break;
                case 7:
                    memset(dir, 0, sizeof dir);
                    s = gsd_make_scalar_sample(s.position, dir, NULL, INFINITY, 1, 1, 1, 1, 1, 0);
                    break;
                case 8:
                    s.position[i / 100 % 3] = isfinite(x) ? NAN : x;
                    break;
                case 9:
                    s.pdf_mix = 0;
                    break;
                default:
                    s.radiance = 1e15f;
                    s.pdf_mix = 1e-20f;
                    break; /* a quotient beyond the limit */
                }
                dirty[m++] = s;
            }
            total += m - N;
            learn(a, clean, N);
            learn(b, dirty, m);
            OK(gsd_refine(a, NULL, NULL, NULL));
            OK(gsd_refine(b, NULL, NULL, NULL));
        }
        gsd_stats sa, sb;
        gsd_get_stats(a, &sa);
        gsd_get_stats(b, &sb);
        assert_int_equal(sa.refused, 0);
        assert_int_equal(sb.refused, total);
        b->stats.refused = 0;
        assert_true(same_fields(a, b));
        gsd_destroy(a);
        gsd_destroy(b);
    }
}

static void test_samples_without_direction_are_refused_with_a_normal_too(void **state)
{
    (void)state;
    const float bad[][3] = {{0, 0, 0},        {NAN, 0, 1},       {0, NAN, 0},         {1, 0, NAN},
                            {INFINITY, 0, 0}, {0, 0, -INFINITY}, {-INFINITY, NAN, 1}, {1e-9f, 0, 0}};
    const float p[3] = {0.5f, 0.5f, 0.5f}, n[3] = {0, 1, 0}, one[3] = {1, 1, 1}, good[3] = {3, 0, 4};
    enum { BAD = sizeof bad / sizeof *bad };
    gsd_training_sample s[2 * BAD + 1];
    for (unsigned i = 0; i < BAD; ++i) {
        s[2 * i] = gsd_make_scalar_sample(p, bad[i], i % 2 ? n : NULL, INFINITY, 1, 1, 1, 1, 1, 0);
        s[2 * i + 1] = gsd_make_sample(p, bad[i], n, INFINITY, one, one, 1, NULL, 1, 1, 0);
    }
    s[2 * BAD] = gsd_make_sample(p, good, n, INFINITY, one, one, 1, NULL, 1, 1, 0); /* any length will do */
    float x[3] = {0.6f, 0, 0.8f};
    uint32_t packed[2];
    assert_true(gsd_pack_direction(x, n, packed));
    assert_true(abs((int)(packed[0] - s[2 * BAD].direction[0])) <= 1);
    assert_true(abs((int)(packed[1] - s[2 * BAD].direction[1])) <= 1);
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_SIMPLE; ++target) {
        gsd_desc d = unit_cube((gsd_target)target);
        gsd_field *f;
        gsd_stats stats;
        OK(gsd_create(&d, &f));
        learn(f, s, 2 * BAD + 1);
        gsd_get_stats(f, &stats);
        assert_int_equal(stats.refused, 2 * BAD);
        assert_int_equal(stats.samples, 1);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        gsd_destroy(f);
    }
}

static void test_positions_outside_are_clamped_and_counted(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    gsd_field *f;
    float out[3] = {2, 0.5f, 0.5f}, dir[3] = {0, 0, 2};
    OK(gsd_create(&d, &f));
    gsd_training_sample s = gsd_make_scalar_sample(out, dir, NULL, INFINITY, 1, 1, 1, 1, 1, 0);
    learn(f, &s, 1);
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    assert_int_equal(stats.clamped, 1);
    assert_int_equal(stats.refused, 0);
    assert_int_equal(stats.samples, 1);
    gsd_destroy(f);
}

static void test_rejected_and_zero_samples_count(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_SIMPLE);
    gsd_field *f;
    float p[3] = {0.5f, 0.5f, 0.5f}, dir[3] = {0, 0, 1};
    gsd_training_sample s[3];
    OK(gsd_create(&d, &f));
    s[0] = gsd_make_scalar_sample(p, dir, NULL, INFINITY, GSD_REJECTED, 5, 5, 1, 1, 0);
    s[1] = gsd_make_scalar_sample(p, dir, NULL, INFINITY, 0, 0, 0, 1, 1, 0);
    s[2] = gsd_make_scalar_sample(p, dir, NULL, INFINITY, 1, 1, 1, 1, 1, 0);
    learn(f, s, 3);
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    assert_int_equal(stats.samples, 3);
    assert_int_equal(stats.rejected, 1);
    assert_int_equal(stats.zeros, 2);
    gsd_tree t = export(f, GSD_PART_BUILDING, 0);
    double total = 0;
    for (int i = 0; i < 4; ++i)
        total += (double)t.value[i];
    assert_true(total > 0 && total < 1);
    free_tree(&t);
    gsd_destroy(f);
    /* nothing at all, and only zeros: still uniform, still valid */
    OK(gsd_create(&d, &f));
    OK(gsd_accumulate(f, NULL, 0, NULL, NULL));
    OK(gsd_refine(f, NULL, NULL, NULL));
    for (int i = 0; i < 200; ++i)
        learn(f, &s[1], 1);
    OK(gsd_refine(f, NULL, NULL, NULL));
    OK(gsd_validate(f));
    gsd_view v = gsd_get_view(f);
    gsd_handle h = gsd_find(&v, p, NULL, NULL);
    assert_true(fabsf(gsd_pdf(&v, &h, dir) - 0.0795775f) < 1e-6f && h.alpha == 1);
    gsd_destroy(f);
}

/* One scenario with every kind of call; returns how many failed for want of memory. */
static int scenario(counter *c)
{
    gsd_desc d = {0};
    gsd_field *f = NULL;
    gsd_stream *stream = NULL;
    static gsd_training_sample s[3000];
    static uint32_t cells[3000];
    int failed = 0;
    d.forest_cells = 3;
    d.alias = true;
    d.target = GSD_TARGET_SIMPLE;
    count_with(&d, c);
    seed(1);
    if (gsd_create(&d, &f)) {
        assert_null(f);
        return 1;
    }
    for (int i = 0; i < 3000; ++i) {
        float p[3] = {0.5f, 0.5f, 0.5f}, dir[3];
        random_direction(dir);
        s[i] =
            gsd_make_scalar_sample(p, dir, NULL, INFINITY, 1, dir[0] > 0.8f ? 1 : 0.1f, 1, 0.0795775f, 0.0795775f, 0);
        cells[i] = (uint32_t)i % 3;
    }
    failed += gsd_stream_create(f, &stream) != GSD_OK;
    for (int pass = 0; pass < 2; ++pass) {
        uint32_t child[4] = {0}, bad;
        float value[4] = {1, 2, 3, 4};
        gsd_tree t = {1, 1, child, value};
        failed += stream && gsd_record_cells(stream, cells, s, 3000) != GSD_OK;
        failed += stream && gsd_accumulate(f, &stream, 1, NULL, NULL) != GSD_OK;
        if (stream)
            gsd_stream_clear(stream);
        failed += gsd_refine(f, NULL, NULL, NULL) != GSD_OK;
        OK(gsd_validate(f));
        failed += gsd_forest_split(f, 0, 0, gsd_cell_count(f) + 5) != GSD_OK;
        OK(gsd_validate(f));
        failed += gsd_import_trees(f, &t, 1) != GSD_OK;
        OK(gsd_validate(f));
        gsd_view v = gsd_get_view(f); /* still answers */
        gsd_handle h = gsd_find_cell(&v, 0);
        float u[2] = {0.5f, 0.5f}, dir[3];
        assert_true(gsd_sample(&v, &h, u, dir) > 0);
        bad = gsd_export_bound(f, GSD_PART_SAMPLING, 1000000);
        assert_int_equal(bad, 0);
        size_t size, bound = gsd_save_bound(f);
        void *data = malloc(bound);
        gsd_field *g;
        OK(gsd_save(f, data, bound, &size));
        gsd_result r = gsd_load(&d, data, size, &g);
        assert_true(r == GSD_OK || (r == GSD_OUT_OF_MEMORY && !g));
        failed += r != GSD_OK;
        gsd_destroy(g);
        free(data);
    }
    gsd_stream_destroy(stream);
    gsd_destroy(f);
    return failed;
}

static void test_every_failed_allocation_is_survived(void **state)
{
    (void)state;
    counter c = {0};
    assert_int_equal(scenario(&c), 0);
    assert_int_equal(c.live, 0);
    long requests = c.requests;
    assert_true(requests > 40);
    for (int all = 0; all < 2; ++all)
        for (long k = 1; k <= requests; ++k) {
            c = (counter){.fail_at = k, .fail_all = all};
            assert_true(scenario(&c) >= 1);
            assert_int_equal(c.live, 0);
        }
}

static void test_lost_samples_are_counted(void **state)
{
    (void)state;
    counter c = {0};
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    gsd_field *f;
    gsd_stream *stream;
    static gsd_training_sample s[1000];
    gsd_stats stats;
    count_with(&d, &c);
    OK(gsd_create(&d, &f));
    OK(gsd_stream_create(f, &stream));
    gsd_view v = gsd_get_view(f);
    make_samples(&v, s, 1000);
    c.fail_at = c.requests + 2; /* the second chunk */
    assert_int_equal(gsd_record(stream, s, 1000), GSD_OUT_OF_MEMORY);
    assert_int_equal(gsd_stream_size(stream), 256);
    c.fail_at = 0;
    OK(gsd_record(stream, s, 10));
    OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
    gsd_get_stats(f, &stats);
    assert_int_equal(stats.samples, 266);
    assert_int_equal(stats.lost, 744);
    gsd_stream_destroy(stream);
    gsd_destroy(f);
    assert_int_equal(c.live, 0);
}

static void test_queries_do_not_allocate(void **state)
{
    (void)state;
    counter c = {0};
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    count_with(&d, &c);
    gsd_field *f = train(&d, 2, 2000);
    long before = c.requests;
    gsd_view v = gsd_get_view(f);
    float p[3] = {0.1f, 0.2f, 0.3f}, u[2] = {0.3f, 0.4f}, dir[3], pdf;
    gsd_handle h;
    gsd_find_batch(&v, 1, NULL, p, 12, NULL, 0, NULL, 0, &h, NULL);
    gsd_sample_batch(&v, 1, NULL, &h, u, 8, dir, 12, &pdf);
    gsd_pdf_batch(&v, 1, NULL, &h, dir, 12, &pdf);
    OK(gsd_validate(f));
    assert_int_equal(c.requests, before);
    gsd_destroy(f);
    assert_int_equal(c.live, 0);
}

/* ---- memory */

static void test_memory_cap_holds_and_the_field_still_learns(void **state)
{
    (void)state;
    for (int alias = 0; alias < 2; ++alias) {
        counter c = {0};
        gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
        d.max_bytes = 1 << 20;
        d.split_samples = 16;
        d.rho = 0.0005f;
        d.min_samples = 1;
        d.alias = alias;
        count_with(&d, &c);
        gsd_field *f;
        OK(gsd_create(&d, &f));
        size_t peak = 0;
        for (int pass = 0; pass < 5; ++pass) {
            static gsd_training_sample s[30000];
            gsd_view v = gsd_get_view(f);
            make_samples(&v, s, 30000);
            learn(f, s, 30000);
            gsdi_release(&f->desc, f->scratch); /* accumulate's scratch is outside the cap */
            f->scratch = NULL;
            f->scratch_size = 0;
            c.peak = c.bytes;
            OK(gsd_refine(f, NULL, NULL, NULL));
            OK(gsd_validate(f));
            peak = c.peak > peak ? c.peak : peak;
        }
        gsd_stats stats;
        gsd_get_stats(f, &stats);
        assert_true(peak <= d.max_bytes);
        assert_true(stats.peak_bytes <= d.max_bytes);
        assert_true((double)peak <= 1.02 * (double)stats.peak_bytes && (double)peak >= 0.9 * (double)stats.peak_bytes);
        assert_true(stats.effective_rho > d.rho);
        assert_true(stats.cells > 50 && stats.nodes > 1000);
        gsd_destroy(f);
        assert_int_equal(c.live, 0);
    }
}

/* Cells that come all at once, then rebuild few at a time: the large tree that the others share stays beside the small
   ones, and the cap leaves less room for nodes than the building trees were given. */
static void test_memory_cap_holds_while_cells_keep_an_old_tree(void **state)
{
    (void)state;
    for (uint32_t i = 0; i < 24; ++i) {
        static gsd_training_sample s[20000];
        gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
        gsd_field *f;
        gsd_stats stats;
        d.max_bytes = (1u << 20) + 65536 * (4 + i / 2);
        d.alias = i % 2;
        d.split_samples = 16;
        d.rho = 1e-5f;
        d.min_samples = 1;
        d.no_gate = true;
        OK(gsd_create(&d, &f));
        seed(1);
        for (int pass = 0; pass < 4; ++pass) { /* a point, everywhere, two thin bars */
            for (int k = 0; k < 20000; ++k) {
                float p[3], direction[3], L = (float)-log(1 - rnd());
                for (int axis = 0; axis < 3; ++axis)
                    p[axis] = pass == 0 ? 0.3f : rndf() * ((pass == 2 && axis < 2) || (pass == 3 && axis) ? 0.1f : 1);
                random_direction(direction);
                s[k] = gsd_make_scalar_sample(p, direction, NULL, INFINITY, L, L, L, 0.08f, 0.08f, 0);
            }
            learn(f, s, 20000);
            OK(gsd_refine(f, NULL, NULL, NULL));
            OK(gsd_validate(f));
        }
        gsd_get_stats(f, &stats);
        assert_true(stats.cells > 50 && stats.nodes > 1000);
        assert_true(stats.peak_bytes <= d.max_bytes);
        gsd_destroy(f);
    }
}

/* ---- gate */

static gsd_stats gate_after(bool peaked, double light_probability, int passes, gsd_field **keep)
{
    gsd_desc d = unit_cube(GSD_TARGET_SIMPLE);
    gsd_field *f;
    gsd_stats stats;
    d.split_samples = 4000;
    OK(gsd_create(&d, &f));
    for (int pass = 0; pass < passes; ++pass) {
        uint32_t n = 4000u << (pass < 5 ? pass : 5);
        gsd_training_sample *s = malloc(n * sizeof *s);
        gsd_view v = gsd_get_view(f);
        make_samples(&v, s, n);
        for (uint32_t i = 0; i < n; ++i) {
            float L = peaked ? (direction_of(&s[i], 0) > 0.97f ? 100 : 0.01f) : 1 + 0.1f * direction_of(&s[i], 2);
            L = rnd() < light_probability ? L : 0;
            s[i].radiance = s[i].contribution = s[i].pixel_contribution = L;
        }
        learn(f, s, n);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        free(s);
    }
    gsd_get_stats(f, &stats);
    if (keep)
        *keep = f;
    else
        gsd_destroy(f);
    return stats;
}

static void test_gate_closes_where_light_is_even(void **state)
{
    (void)state;
    gsd_field *f;
    seed(1);
    gsd_stats s = gate_after(false, 1, 6, &f);
    assert_int_equal(s.open_cells, 0);
    assert_true(s.closed_share > 0.95f);
    assert_true(gsd_record_fraction(f) < 0.15f);
    gsd_view v = gsd_get_view(f);
    float p[3] = {0.2f, 0.3f, 0.4f};
    gsd_handle h = gsd_find(&v, p, NULL, NULL);
    assert_true(h.alpha == 1);
    gsd_destroy(f);
}

static void test_gate_stays_open_where_light_is_peaked(void **state)
{
    (void)state;
    gsd_field *f;
    seed(2);
    gsd_stats s = gate_after(true, 1, 6, &f);
    assert_int_equal(s.closed_cells, 0);
    assert_true(s.open_cells > 0 && s.mean_alpha < 0.5f);
    assert_true(gsd_record_fraction(f) == 1);
    assert_false(gsd_all_closed(f));
    gsd_destroy(f);
}

static void test_gate_leaves_rarely_lit_cells_open(void **state)
{
    (void)state;
    seed(3);
    gsd_stats s = gate_after(true, 0.002, 5, NULL);
    assert_int_equal(s.closed_cells, 0);
}

static void test_gate_off_never_closes(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.no_gate = true;
    d.alpha_mode = GSD_ALPHA_FIXED;
    gsd_field *f = train(&d, 5, 4000);
    gsd_view v = gsd_get_view(f);
    for (uint32_t c = 0; c < v.cell_count; ++c)
        assert_true(v.cells[c].alpha == 0.5f);
    gsd_destroy(f);
}

/* Even light closes cells, but not before they have had the time to find light that is rare. */
static void test_gate_does_not_close_even_cells_at_once(void **state)
{
    (void)state;
    for (int passes = 2; passes <= 10; passes += 8) {
        gsd_field *f;
        seed(5);
        gsd_stats s = gate_after(false, 1, passes, &f);
        assert_int_equal(s.closed_cells, passes > 8 ? s.cells : 0);
        assert_int_equal(gsd_all_closed(f), passes > 8);
        assert_true((s.closed_share == 1) == (passes > 8));
        gsd_destroy(f);
    }
}

/* The same samples: worth guiding or not by what they contribute to their pixels. */
static void test_gate_weighs_by_pixels(void **state)
{
    (void)state;
    for (int dark = 0; dark < 2; ++dark) {
        gsd_desc d = unit_cube(GSD_TARGET_SIMPLE);
        gsd_field *f;
        gsd_pass info = {.pixel_estimate = true};
        gsd_stats stats;
        static gsd_training_sample s[40000];
        seed(6);
        OK(gsd_create(&d, &f));
        for (int pass = 0; pass < 7; ++pass) {
            gsd_view v = gsd_get_view(f);
            make_samples(&v, s, 40000);
            for (int i = 0; i < 40000; ++i) {
                s[i].radiance = s[i].contribution = direction_of(&s[i], 0) > 0.97f ? 100 : 0.01f;
                s[i].pixel_contribution = s[i].contribution * (dark ? 1 : 1e-4f);
                s[i].nearness = 0;
            }
            learn(f, s, 40000);
            OK(gsd_refine(f, &info, NULL, NULL));
        }
        gsd_get_stats(f, &stats);
        if (dark)
            assert_true(stats.closed_cells == 0 && stats.open_cells > 0);
        else
            assert_int_equal(stats.closed_cells, stats.cells);
        gsd_destroy(f);
    }
}

/* A closed cell opens again when the light changes. */
static void test_closed_cells_are_tried_again(void **state)
{
    (void)state;
    gsd_field *f;
    seed(4);
    gate_after(false, 1, 6, &f);
    static gsd_training_sample s[60000];
    for (int pass = 0; pass < 4; ++pass) {
        gsd_view v = gsd_get_view(f);
        make_samples(&v, s, 60000);
        for (int i = 0; i < 60000; ++i) {
            float L = direction_of(&s[i], 0) > 0.97f ? 100 : 0.01f;
            s[i].radiance = s[i].contribution = s[i].pixel_contribution = L;
        }
        learn(f, s, 60000);
        OK(gsd_refine(f, NULL, NULL, NULL));
    }
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    assert_true(stats.probed > 0);
    assert_true(stats.open_cells > stats.closed_cells);
    gsd_destroy(f);
}

/* alpha goes where the second moment is least: low with a good guide, both ways of learning it. */
static void test_alpha_is_learned(void **state)
{
    (void)state;
    for (int mode = GSD_ALPHA_ADAM; mode <= GSD_ALPHA_GRID; ++mode)
        for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_SIMPLE; ++target) {
            gsd_desc d = unit_cube((gsd_target)target);
            d.alpha_mode = (gsd_alpha_mode)mode;
            d.no_gate = true;
            seed(9);
            gsd_field *f = train(&d, 5, 4000);
            gsd_view v = gsd_get_view(f);
            for (uint32_t c = 0; c < v.cell_count; ++c)
                assert_true(v.cells[c].alpha >= 0.0499f && v.cells[c].alpha < 0.45f);
            gsd_destroy(f);
        }
}

/* ---- history */

/* Passes of these many samples, each worth 1 in the building tree's sums; expected: what the sums hold after refine. */
static void check_history(const gsd_desc *d, const uint32_t *sizes, int passes, const double *expected)
{
    gsd_field *f;
    OK(gsd_create(d, &f));
    seed(1);
    for (int pass = 0; pass < passes; ++pass) {
        gsd_training_sample *s = malloc(sizes[pass] * sizeof *s);
        double held = 0, sum = 0;
        for (uint32_t i = 0; i < sizes[pass]; ++i) {
            float p[3] = {rndf(), rndf(), rndf()}, dir[3];
            random_direction(dir);
            s[i] = gsd_make_scalar_sample(p, dir, NULL, INFINITY, 1, 1, 1, 1, 1, 1);
        }
        learn(f, s, sizes[pass]);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        gsd_stats stats;
        gsd_get_stats(f, &stats);
        assert_int_equal(stats.waiting_cells, 0);
        for (uint32_t c = 0; c < gsd_cell_count(f); ++c) {
            gsd_tree t = export(f, GSD_PART_BUILDING, c);
            for (uint32_t i = 0; i < 4; ++i)
                sum += (double)t.value[i];
            held += f->states[c].held;
            assert_true(fabs(f->states[c].lit - f->states[c].held) <= 1e-9 * held);
            free_tree(&t);
        }
        if (fabs(held - expected[pass]) > 1e-9 * held)
            fail_msg("%g samples held after pass %d, expected %g", held, pass, expected[pass]);
        if (d->target == GSD_TARGET_RADIANCE)
            assert_true(fabs(sum - held) <= 1e-4 * held);
        free(s);
    }
    gsd_destroy(f);
}

/* The rule in the words of its comment, step by step. */
static void expect_history(const uint32_t *sizes, int passes, double *expected)
{
    double all = 0, held = 0;
    for (int pass = 0; pass < passes; ++pass) {
        double n = sizes[pass], next = n;
        if (pass > 0)
            next = n * fmin(2, fmax(1, n / sizes[pass - 1])); /* the next pass will be as large */
        all += n;
        held += n;
        held = fmin(held, fmax(0, (all + next) / 2 - next)); /* with it, half of all shall count */
        expected[pass] = held;
    }
}

static void test_history_keeps_half_of_all_samples(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.split_samples = 1e9f;
    d.no_gate = true;
    d.alpha_mode = GSD_ALPHA_FIXED;
    d.min_samples = 1;
    double expected[8];
    const uint32_t equal[] = {600, 600, 600, 600, 600, 600}, doubling[] = {200, 400, 800, 1600, 3200};
    const uint32_t growing[] = {500, 700, 1000, 1100, 1500, 2100}, odd[] = {500, 500, 2500, 20, 30, 500, 500, 90};
    expect_history(equal, 6, expected);
    for (int pass = 0; pass < 6; ++pass) /* half of pass + 1 passes, when the next has come */
        assert_true(fabs(expected[pass] - 300 * pass) < 1e-9);
    check_history(&d, equal, 6, expected);
    expect_history(doubling, 5, expected);
    for (int pass = 0; pass < 5; ++pass)
        assert_true(expected[pass] == 0);
    check_history(&d, doubling, 5, expected);
    expect_history(growing, 6, expected);
    assert_true(expected[5] > 1000);
    check_history(&d, growing, 6, expected);
    expect_history(odd, 8, expected);
    assert_true(expected[3] == 20); /* no more than there is */
    check_history(&d, odd, 8, expected);
    const uint32_t jump[] = {600, 600, 600, 600, 600, 2100, 600}, fall[] = {600, 600, 600, 600, 600, 500, 400};
    expect_history(jump, 7, expected); /* 3.5 times as many now are no reason to expect more than twice as many next */
    assert_true(expected[5] == 450);
    check_history(&d, jump, 7, expected);
    expect_history(fall, 7, expected); /* nor fewer than now */
    assert_true(expected[5] == 1500);
    check_history(&d, fall, 7, expected);
    /* the cells of a split share what is kept */
    const uint32_t split[] = {600, 600, 600, 600, 1100};
    d.split_samples = 100;
    expect_history(split, 5, expected);
    assert_true(expected[4] > 700);
    check_history(&d, split, 5, expected);
}

static void test_no_history_keeps_nothing(void **state)
{
    (void)state;
    const uint32_t equal[] = {300, 300, 300, 300}, shrinking[] = {3000, 300, 200, 100};
    const double nothing[4] = {0, 0, 0, 0};
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_VARIANCE; ++target) {
        gsd_desc d = unit_cube((gsd_target)target);
        d.no_history = true;
        d.min_samples = 1;
        d.split_samples = 1e9f;
        check_history(&d, equal, 4, nothing);
        check_history(&d, shrinking, 4, nothing);
    }
}

/* What was learned for one target is of no use for the next; the count of all samples begins anew, too. */
static void test_switching_the_target_clears_the_history(void **state)
{
    (void)state;
    const uint32_t equal[] = {400, 400, 400, 400, 400, 400}, uneven[] = {400, 900, 100, 100, 100, 100, 100};
    const double expected[] = {0, 200, 0, 0, 200, 400}, early[] = {0, 0, 0, 50, 100, 150, 200};
    const double late[] = {0, 0, 100, 0, 0, 50, 100};
    gsd_desc d = unit_cube(GSD_TARGET_SWITCHING);
    d.split_samples = 1e9f;
    d.no_gate = true;
    d.min_samples = 1;
    d.switch_after = 3;
    check_history(&d, equal, 6, expected);
    check_history(&d, uneven, 7, early); /* after 1300 samples: 3.25 first passes' worth */
    d.switch_after = 3.6f;
    check_history(&d, uneven, 7, late); /* after 1500 */
    /* cells that wait for more samples lose them as well */
    gsd_field *f;
    static gsd_training_sample s[20000];
    d.split_samples = 200;
    d.min_samples = 64;
    d.switch_after = 3;
    d.no_history = true;
    OK(gsd_create(&d, &f));
    seed(3);
    for (int pass = 0; pass < 3; ++pass) {
        gsd_view v = gsd_get_view(f);
        make_samples(&v, s, 20000);
        for (int i = 0; pass == 2 && i < 20000; ++i) /* but for a few, all near a corner */
            for (int k = 0; k < 3; ++k)
                s[i].position[k] *= i < 300 ? 1 : 0.1f;
        learn(f, s, 20000);
        OK(gsd_refine(f, NULL, NULL, NULL));
        OK(gsd_validate(f));
        gsd_stats stats;
        gsd_get_stats(f, &stats);
        assert_true(pass < 2 || stats.waiting_cells > 10);
        assert_int_equal(f->target, pass < 2 ? GSD_TARGET_SIMPLE : GSD_TARGET_VARIANCE);
    }
    for (uint32_t c = 0; c < gsd_cell_count(f); ++c)
        assert_true(f->states[c].held == 0 && f->states[c].lit == 0);
    for (uint32_t i = 0; i < f->building_nodes; ++i)
        assert_true(f->sum[i].half[0] == 0 && f->sum[i].half[1] == 0);
    gsd_destroy(f);
}

/* ---- structure */

static void test_unread_and_waiting_cells_are_left_alone(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.split_samples = 300;
    seed(1);
    gsd_field *f = train(&d, 3, 8000);
    gsd_stats before, after;
    gsd_get_stats(f, &before);
    static gsd_training_sample s[4000];
    gsd_view v = gsd_get_view(f);
    gsd_tree far_before = {0}, far_after;
    float far[3] = {0.9f, 0.9f, 0.9f}, near[3] = {0.01f, 0.01f, 0.01f};
    uint32_t cell = gsd_find(&v, far, NULL, NULL).cell;
    assert_true(cell != gsd_find(&v, near, NULL, NULL).cell);
    far_before = export(f, GSD_PART_SAMPLING, cell);
    make_samples(&v, s, 4000);
    for (int i = 0; i < 4000; ++i)
        memcpy(s[i].position, i < 10 ? far : near, sizeof far);
    learn(f, s, 4000);
    OK(gsd_refine(f, NULL, NULL, NULL));
    OK(gsd_validate(f));
    gsd_get_stats(f, &after);
    assert_int_equal(after.rebuilt_trees, 1);
    assert_int_equal(after.waiting_cells, 1);
    assert_int_equal(after.unread_cells, before.cells - 2);
    far_after = export(f, GSD_PART_SAMPLING, cell);
    assert_int_equal(far_before.count, far_after.count);
    assert_memory_equal(far_before.value, far_after.value, far_after.count * 16);
    assert_memory_equal(far_before.child, far_after.child, far_after.count * 16);
    free_tree(&far_before);
    free_tree(&far_after);
    gsd_destroy(f);
}

static void test_forest_split_export_and_import(void **state)
{
    (void)state;
    seed(77);
    gsd_field *f = forest_of(4, 50, 12, false, GSD_SIMD_AUTO);
    gsd_tree before = export(f, GSD_PART_SAMPLING, 2);
    assert_int_equal(gsd_forest_split(f, 9, 1, 2), GSD_BAD_CELL);
    assert_int_equal(gsd_forest_split(f, 1, 2, 2), GSD_BAD_CELL);
    OK(gsd_forest_split(f, 2, 2, 7));
    assert_int_equal(gsd_cell_count(f), 8);
    OK(gsd_validate(f));
    for (uint32_t c = 2; c <= 7; c += 5) {
        gsd_tree t = export(f, GSD_PART_SAMPLING, c);
        assert_int_equal(t.count, before.count);
        assert_memory_equal(t.value, before.value, t.count * 16);
        free_tree(&t);
    }
    /* round trip: masses survive to the precision of a float density over the uniform share */
    before.cell = 5;
    OK(gsd_import_trees(f, &before, 1));
    gsd_tree again = export(f, GSD_PART_SAMPLING, 5);
    for (uint32_t i = 0; i < before.count * 4; ++i)
        assert_true(fabsf(again.value[i] - before.value[i]) <= 2e-6f * before.value[i] + 1e-7f);
    /* the split cells train apart */
    gsd_stream *stream;
    static gsd_training_sample s[500];
    static uint32_t cells[500];
    OK(gsd_stream_create(f, &stream));
    for (int i = 0; i < 500; ++i) {
        float p[3] = {0, 0, 0}, d[3];
        random_direction(d);
        s[i] = gsd_make_scalar_sample(p, d, NULL, INFINITY, 1 + 10 * (d[0] > 0.5f), 1, 1, 0.0795775f, 0.0795775f, 0);
        cells[i] = 7;
    }
    cells[0] = 8; /* no such cell: refused */
    OK(gsd_record_cells(stream, cells, s, 500));
    OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
    OK(gsd_refine(f, NULL, NULL, NULL));
    OK(gsd_validate(f));
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    assert_int_equal(stats.refused, 1);
    assert_int_equal(stats.rebuilt_trees, 1);
    gsd_tree two = export(f, GSD_PART_SAMPLING, 2);
    assert_memory_equal(two.value, before.value, two.count * 16);
    /* trees that are none are refused and change nothing */
    uint32_t child[8] = {1, 0, 0, 0, 1, 0, 0, 0};
    float value[8] = {1, 1, 1, 1, 1, 1, 1, 1};
    gsd_tree bad = {0, 2, child, value};
    assert_int_equal(gsd_import_trees(f, &bad, 1), GSD_BAD_TREE); /* refers to itself */
    child[4] = 0;
    value[6] = NAN;
    assert_int_equal(gsd_import_trees(f, &bad, 1), GSD_BAD_TREE);
    value[6] = 0;
    child[0] = 0;
    assert_int_equal(gsd_import_trees(f, &bad, 1), GSD_BAD_TREE); /* a node that nothing refers to */
    bad.cell = 100;
    assert_int_equal(gsd_import_trees(f, &bad, 1), GSD_BAD_CELL);
    OK(gsd_validate(f));
    gsd_stream_destroy(stream);
    free_tree(&before);
    free_tree(&again);
    free_tree(&two);
    gsd_destroy(f);
}

/* The learned shares come out whatever part of the density is uniform: all of it, too. */
static void test_exported_shares_do_not_depend_on_the_uniform_part(void **state)
{
    (void)state;
    const float uniform[] = {0, 0.999f, 1};
    for (int i = 0; i < 3; ++i) {
        gsd_desc d = {.forest_cells = 1, .uniform = uniform[i]};
        gsd_field *f;
        seed(78);
        gsd_tree in = random_tree(0, 50, 9);
        double total = 0, back = 0;
        OK(gsd_create(&d, &f));
        OK(gsd_import_trees(f, &in, 1));
        gsd_tree out = export(f, GSD_PART_SAMPLING, 0);
        assert_int_equal(out.count, in.count);
        for (uint32_t k = 0; k < in.count * 4; ++k) {
            total += in.child[k] ? 0 : (double)in.value[k];
            back += out.child[k] ? 0 : (double)out.value[k];
        }
        assert_true(fabs(back - 1) < 1e-5);
        for (double x = 0.001; x < 1; x += 0.01)
            for (double y = 0.001; y < 1; y += 0.01) { /* nodes may be numbered anew */
                double a, b, area_a, area_b;
                uint32_t id;
                naive_leaf(&in, x, y, &a, &area_a, &id);
                naive_leaf(&out, x, y, &b, &area_b, &id);
                assert_true(area_a == area_b && fabs(a / total - b) <= 2e-4 * a / total + 1e-7);
            }
        free_tree(&in);
        free_tree(&out);
        gsd_destroy(f);
    }
}

/* ---- files */

static void test_save_and_load_give_the_same_field(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_SWITCHING);
    d.alias = true;
    d.split_samples = 500;
    seed(5);
    gsd_field *f = train(&d, 4, 2000), *g;
    static gsd_training_sample s[3000];
    gsd_view v = gsd_get_view(f);
    make_samples(&v, s, 3000);
    learn(f, s, 3000); /* in the middle of a pass */
    size_t size;
    unsigned char *data = save(f, &size), *odd = malloc(size + 1);
    memcpy(odd + 1, data, size); /* unaligned */
    OK(gsd_load(NULL, odd + 1, size, &g));
    assert_true(same_fields(f, g));
    assert_int_equal(gsd_structure_id(f), gsd_structure_id(g));
    make_samples(&v, s, 3000);
    learn(f, s, 3000);
    learn(g, s, 3000);
    OK(gsd_refine(f, NULL, NULL, NULL));
    OK(gsd_refine(g, NULL, NULL, NULL));
    assert_true(same_fields(f, g));
    assert_int_equal(gsd_save(f, data, 10, &size), GSD_BUFFER_TOO_SMALL);
    gsd_destroy(f);
    gsd_destroy(g);
    free(odd);
    free(data);
}

/* A short save of a field that has everything. */
static unsigned char *small_save(size_t *size)
{
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.alias = true;
    d.split_samples = 1000;
    d.rho = 0.05f;
    seed(6);
    gsd_field *f = train(&d, 3, 1500);
    unsigned char *data = save(f, size);
    gsd_destroy(f);
    return data;
}

static void test_truncated_and_flipped_saves_are_refused(void **state)
{
    (void)state;
    size_t size;
    unsigned char *data = small_save(&size);
    gsd_field *g;
    for (size_t n = 0; n < size; n += n < 2000 ? 1 : 331) {
        unsigned char *exact = malloc(n ? n : 1);
        memcpy(exact, data, n);
        assert_int_not_equal(gsd_load(NULL, exact, n, &g), GSD_OK);
        assert_null(g);
        free(exact);
    }
    for (size_t bit = 0; bit < size * 8; bit += bit < 8000 ? 1 : 997) {
        data[bit / 8] ^= (unsigned char)(1u << (bit % 8));
        assert_int_not_equal(gsd_load(NULL, data, size, &g), GSD_OK);
        assert_null(g);
        data[bit / 8] ^= (unsigned char)(1u << (bit % 8));
    }
    OK(gsd_load(NULL, data, size, &g));
    gsd_destroy(g);
    free(data);
}

/* The same with the checksum made right again: what loads must be whole, everything else is refused. */
static void test_forged_saves_never_harm(void **state)
{
    (void)state;
    size_t size;
    unsigned char *data = small_save(&size), *forged = malloc(size);
    long loaded = 0, refused = 0;
    seed(12);
    for (long i = 0; i < scaled(3000); ++i) {
        gsdi_file f;
        gsd_field *g;
        memcpy(forged, data, size);
        for (int k = 0; k <= i % 3; ++k) {
            size_t at = i % 2 ? (size_t)(rnd() * 700) : (size_t)(rnd() * (double)size);
            uint32_t word = i % 5 ? (uint32_t)rng_next() >> (rng_next() & 31) : 0xffffffffu;
            at = at / 4 * 4 < size - 4 ? at / 4 * 4 : size - 4;
            memcpy(forged + at, &word, 4);
        }
        memcpy(&f, forged, sizeof f);
        f.checksum = gsdi_file_checksum(&f, forged + sizeof f, size - sizeof f);
        memcpy(forged, &f, sizeof f);
        if (gsd_load(NULL, forged, size, &g) != GSD_OK) {
            refused++;
            continue;
        }
        loaded++;
        OK(gsd_validate(g)); /* and it can be used and trained */
        gsd_view v = gsd_get_view(g);
        static gsd_training_sample s[64];
        make_samples(&v, s, 64);
        learn(g, s, 64);
        assert_int_not_equal(gsd_refine(g, NULL, NULL, NULL), GSD_CORRUPT);
        gsd_destroy(g);
    }
    assert_true(refused > 100 && loaded > 10);
    free(data);
    free(forged);
}

/* gsd_record_fraction is 1/64 .. 1 for whatever loads. */
static void test_forged_shares_of_the_gate_are_refused(void **state)
{
    (void)state;
    const float bad[] = {NAN, INFINITY, -INFINITY, -0.5f, 1.5f, 3e38f};
    size_t size;
    unsigned char *data = small_save(&size);
    for (unsigned k = 0; k < 2 * sizeof bad / sizeof *bad; ++k) {
        gsdi_file f;
        gsd_field *g;
        memcpy(&f, data, sizeof f);
        *(k % 2 ? &f.stats.closed_share : &f.stats.mean_alpha) = bad[k / 2];
        f.checksum = gsdi_file_checksum(&f, data + sizeof f, size - sizeof f);
        unsigned char *forged = malloc(size);
        memcpy(forged, data, size);
        memcpy(forged, &f, sizeof f);
        assert_int_equal(gsd_load(NULL, forged, size, &g), GSD_BAD_FILE);
        assert_null(g);
        free(forged);
    }
    free(data);
}

/* The uniform leaf lies at 0, 0, depth 0: a query shifts by its depth. */
static void test_a_forged_uniform_leaf_is_refused(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    gsd_field *f;
    OK(gsd_create(&d, &f));
    for (uint32_t i = 0; i < 4; ++i) {
        gsd_node *n = &gsdi_nodes(f->block)[i];
        n->leaf.x = 200u << 24;
        assert_int_equal(gsd_validate(f), GSD_CORRUPT);
        n->leaf.x = 0;
        n->leaf.y = 1;
        assert_int_equal(gsd_validate(f), GSD_CORRUPT);
        n->leaf.y = 0;
        OK(gsd_validate(f));
    }
    gsd_destroy(f);
}

/* A save may claim that a cell reflects 1e49 a sample: it is whole, and still is after refine. */
static void test_a_huge_flow_leaves_the_field_valid(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    gsd_field *f;
    static gsd_training_sample s[100];
    seed(3);
    OK(gsd_create(&d, &f));
    const float bad[] = {NAN, -1, 2e30f, INFINITY};
    for (unsigned k = 0; k < 4; ++k) { /* refine copies it into the cell */
        f->states[0].reflected = bad[k];
        assert_int_equal(gsd_validate(f), GSD_CORRUPT);
    }
    f->states[0].reflected = 0;
    f->states[0].flow = 1e49;
    OK(gsd_validate(f));
    gsd_view v = gsd_get_view(f);
    make_samples(&v, s, 100);
    learn(f, s, 100);
    OK(gsd_refine(f, NULL, NULL, NULL));
    OK(gsd_validate(f));
    gsd_destroy(f);
}

static void test_merge_equals_training_together(void **state)
{
    (void)state;
    enum { N = 20000 };
    gsd_desc d = unit_cube(GSD_TARGET_SIMPLE);
    d.split_samples = 1000;
    seed(8);
    gsd_field *a = train(&d, 3, 4000), *b, *both, *other;
    size_t size;
    void *data = save(a, &size);
    OK(gsd_load(NULL, data, size, &b));
    OK(gsd_load(NULL, data, size, &both));
    static gsd_training_sample s[N];
    gsd_view v = gsd_get_view(a);
    make_samples(&v, s, N);
    for (uint32_t i = 0; i < gsd_cell_count(a); ++i) { /* what is kept from earlier passes would count twice */
        gsdi_state *t = &b->states[i];
        memset(t->bins, 0, sizeof t->bins);
        memset(t->v, 0, sizeof t->v);
        memset(t->vv, 0, sizeof t->vv);
        memset(t->cross, 0, sizeof t->cross);
        t->gate_count = t->held = 0;
    }
    memset(b->sum, 0, b->building_nodes * sizeof *b->sum);
    learn(a, s, N / 2);
    learn(b, s + N / 2, N / 2);
    learn(both, s, N);
    OK(gsd_merge(a, b));
    OK(gsd_refine(a, NULL, NULL, NULL));
    OK(gsd_refine(both, NULL, NULL, NULL));
    OK(gsd_validate(a));
    assert_int_equal(gsd_cell_count(a), gsd_cell_count(both));
    gsd_view va = gsd_get_view(a), vb = gsd_get_view(both);
    for (int i = 0; i < 5000; ++i) {
        float dir[3], p[3] = {rndf(), rndf(), rndf()};
        random_direction(dir);
        gsd_handle ha = gsd_find(&va, p, NULL, NULL), hb = gsd_find(&vb, p, NULL, NULL);
        float pa = gsd_pdf(&va, &ha, dir), pb = gsd_pdf(&vb, &hb, dir);
        assert_true(fabsf(pa - pb) <= 1e-5f * pb);
    }
    gsd_stats sa, sb;
    gsd_get_stats(a, &sa);
    gsd_get_stats(both, &sb);
    assert_int_equal(sa.samples - sb.samples, sb.samples - N); /* b's history counts twice */
    /* another structure: refused */
    assert_int_equal(gsd_merge(a, b), GSD_MISMATCH);
    OK(gsd_create(&d, &other));
    assert_int_equal(gsd_merge(b, other), GSD_MISMATCH);
    gsd_destroy(a);
    gsd_destroy(b);
    gsd_destroy(both);
    gsd_destroy(other);
    free(data);
}

static void test_validate_notices_damage(void **state)
{
    (void)state;
    gsd_desc d = unit_cube(GSD_TARGET_RADIANCE);
    d.split_samples = 300;
    seed(5);
    gsd_field *f = train(&d, 3, 3000);
    uint32_t *child = f->child, save_child = child[0];
    child[0] = 0x7fffffff;
    assert_int_equal(gsd_validate(f), GSD_CORRUPT);
    child[0] = save_child;
    OK(gsd_validate(f));
    gsd_node *n = &gsdi_nodes(f->block)[f->block->nodes - 1];
    gsd_node keep = *n;
    n->leaf.pdf = NAN;
    assert_int_equal(gsd_validate(f), GSD_CORRUPT);
    *n = keep;
    gsdi_words(f->block, f->block->spatial_at)[0] = GSD_CELL_BIT | 1000000;
    assert_int_equal(gsd_validate(f), GSD_CORRUPT);
    gsd_destroy(f);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_documented_defaults_are_the_defaults),
        cmocka_unit_test(test_bad_descriptors_are_refused_by_name),
        cmocka_unit_test(test_sizes_are_as_documented),
        cmocka_unit_test(test_pdf_integrates_to_one),
        cmocka_unit_test(test_samples_follow_the_density),
        cmocka_unit_test(test_alias_samples_follow_the_density),
        cmocka_unit_test(test_alias_table_of_a_hot_leaf_adds_up),
        cmocka_unit_test(test_samples_are_uniform_within_a_leaf),
        cmocka_unit_test(test_sample_and_pdf_agree),
        cmocka_unit_test(test_estimates_with_the_density_are_unbiased),
        cmocka_unit_test(test_seam_poles_and_odd_directions),
        cmocka_unit_test(test_oriented_density_integrates_to_one),
        cmocka_unit_test(test_oriented_density_matches_a_naive_reference),
        cmocka_unit_test(test_oriented_samples_follow_the_density),
        cmocka_unit_test(test_oriented_batches_follow_the_density),
        cmocka_unit_test(test_oriented_sample_and_pdf_agree),
        cmocka_unit_test(test_oriented_samples_at_edges_of_bins),
        cmocka_unit_test(test_cells_of_a_forest_are_oriented),
        cmocka_unit_test(test_odd_normals_do_no_harm),
        cmocka_unit_test(test_normals_far_from_unit_are_none),
        cmocka_unit_test(test_normals_survive_packing),
        cmocka_unit_test(test_batches_equal_single_queries_at_every_level),
        cmocka_unit_test(test_batches_of_oriented_handles_equal_single_queries),
        cmocka_unit_test(test_results_do_not_depend_on_threads_or_cuts),
        cmocka_unit_test(test_targets_match_a_naive_reference),
        cmocka_unit_test(test_targets_with_normals_match_a_naive_reference),
        cmocka_unit_test(test_smoothing_matches_a_naive_reference),
        cmocka_unit_test(test_box_filter_matches_brute_force),
        cmocka_unit_test(test_trees_refine_where_the_mass_is),
        cmocka_unit_test(test_cells_split_where_samples_are),
        cmocka_unit_test(test_split_threshold_follows_the_samples),
        cmocka_unit_test(test_find_with_normals_equals_its_batch),
        cmocka_unit_test(test_thin_wall_lit_from_one_side),
        cmocka_unit_test(test_two_sided_cell_samples_the_side_that_is_asked_for),
        cmocka_unit_test(test_bad_samples_are_refused_and_leave_no_trace),
        cmocka_unit_test(test_samples_without_direction_are_refused_with_a_normal_too),
        cmocka_unit_test(test_positions_outside_are_clamped_and_counted),
        cmocka_unit_test(test_rejected_and_zero_samples_count),
        cmocka_unit_test(test_every_failed_allocation_is_survived),
        cmocka_unit_test(test_lost_samples_are_counted),
        cmocka_unit_test(test_queries_do_not_allocate),
        cmocka_unit_test(test_memory_cap_holds_and_the_field_still_learns),
        cmocka_unit_test(test_memory_cap_holds_while_cells_keep_an_old_tree),
        cmocka_unit_test(test_gate_closes_where_light_is_even),
        cmocka_unit_test(test_gate_stays_open_where_light_is_peaked),
        cmocka_unit_test(test_gate_leaves_rarely_lit_cells_open),
        cmocka_unit_test(test_gate_off_never_closes),
        cmocka_unit_test(test_gate_does_not_close_even_cells_at_once),
        cmocka_unit_test(test_gate_weighs_by_pixels),
        cmocka_unit_test(test_closed_cells_are_tried_again),
        cmocka_unit_test(test_alpha_is_learned),
        cmocka_unit_test(test_history_keeps_half_of_all_samples),
        cmocka_unit_test(test_no_history_keeps_nothing),
        cmocka_unit_test(test_switching_the_target_clears_the_history),
        cmocka_unit_test(test_unread_and_waiting_cells_are_left_alone),
        cmocka_unit_test(test_forest_split_export_and_import),
        cmocka_unit_test(test_exported_shares_do_not_depend_on_the_uniform_part),
        cmocka_unit_test(test_save_and_load_give_the_same_field),
        cmocka_unit_test(test_truncated_and_flipped_saves_are_refused),
        cmocka_unit_test(test_forged_saves_never_harm),
        cmocka_unit_test(test_forged_shares_of_the_gate_are_refused),
        cmocka_unit_test(test_a_forged_uniform_leaf_is_refused),
        cmocka_unit_test(test_a_huge_flow_leaves_the_field_valid),
        cmocka_unit_test(test_merge_equals_training_together),
        cmocka_unit_test(test_validate_notices_damage),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
