/* test_photon.c: guide_photon.h: what it learns, what it refuses, what it survives.

   gcc -std=c11 -O2 -I. tests/test_photon.c -lcmocka -lm -lpthread */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#include "chi_square.h"
#include "counter.h"
#include "crowd.h"
#include "rng.h"

#define PI 3.14159265358979323846
#define OK(call) assert_int_equal((call), GPH_OK)

/* ---- helpers */

static gph_desc unit_cube(void)
{
    gph_desc d;
    memset(&d, 0, sizeof d);
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    d.grid_cells = 4;
    return d;
}

static double dot(const float a[3], const float b[3])
{
    return (double)a[0] * (double)b[0] + (double)a[1] * (double)b[1] + (double)a[2] * (double)b[2];
}

/* A direction with density proportional to exp(kappa mean . w): drawn in closed form, turned to the mean. */
static void draw_lobe(const float mean[3], double kappa, float d[3])
{
    double u = rnd(), w = 1 + log(u + (1 - u) * exp(-2 * kappa)) / kappa, phi = 2 * PI * rnd(),
           r = sqrt(fmax(0, 1 - w * w));
    float a[3] = {0, 0, 0}, s[3], t[3], l;
    a[fabsf(mean[0]) < 0.5f ? 0 : 1] = 1;
    s[0] = mean[1] * a[2] - mean[2] * a[1];
    s[1] = mean[2] * a[0] - mean[0] * a[2];
    s[2] = mean[0] * a[1] - mean[1] * a[0];
    l = 1 / sqrtf(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    for (int k = 0; k < 3; ++k)
        s[k] *= l;
    t[0] = mean[1] * s[2] - mean[2] * s[1];
    t[1] = mean[2] * s[0] - mean[0] * s[2];
    t[2] = mean[0] * s[1] - mean[1] * s[0];
    for (int k = 0; k < 3; ++k)
        d[k] = (float)(w * (double)mean[k] + r * (cos(phi) * (double)s[k] + sin(phi) * (double)t[k]));
}

static double lobe(const float mean[3], double kappa, const float d[3])
{
    return kappa / (2 * PI * (1 - exp(-2 * kappa))) * exp(kappa * (dot(mean, d) - 1));
}

/* The light of the tests: 60 % a lobe of kappa 40, 30 % one of kappa 8, 10 % even. */
static const float mean_a[3] = {0.6f, 0, 0.8f}, mean_b[3] = {-0.8f, -0.6f, 0};
static double light(const float d[3]) { return 0.6 * lobe(mean_a, 40, d) + 0.3 * lobe(mean_b, 8, d) + 0.1 / (4 * PI); }
static void draw_light(float d[3])
{
    double u = rnd();
    if (u < 0.6)
        draw_lobe(mean_a, 40, d);
    else if (u < 0.9)
        draw_lobe(mean_b, 8, d);
    else
        random_direction(d);
}

static void random_position(float p[3])
{
    p[0] = rndf();
    p[1] = rndf();
    p[2] = 0.5f * rndf();
}

static gph_vertex touch(const float p[3]) { return gph_make_vertex(p, 0, 0, 0, 0, GPH_TOUCH_ONLY); }

/* A pass of so many vertices and photons all over the lower half of the cube; two streams. */
static void record_pass(gph_stream *s[2], uint32_t vertices, uint32_t photons)
{
    for (uint32_t i = 0; i < vertices; ++i) {
        float p[3];
        random_position(p);
        gph_vertex v = touch(p);
        if (i & 1)
            v = gph_make_vertex(p, rndf() * rndf(), 0.1f + rndf(), 0.2f + rndf(), 0.1f + rndf(),
                                i & 2 ? GPH_FROM_GUIDE : GPH_FROM_BSDF);
        OK(gph_record_vertices(s[i % 3 == 0], &v, 1));
    }
    for (uint32_t i = 0; i < photons; ++i) {
        float p[3], d[3];
        random_position(p);
        draw_light(d);
        gph_photon q = gph_make_photon(p, d, i % 5 ? 1 : INFINITY, 0.5f + rndf());
        OK(gph_record_photons(s[i % 3 == 0], &q, 1));
    }
}

static void teach(gph_field *f, int passes, uint32_t vertices, uint32_t photons, gph_parallel_fn parallel, void *user)
{
    gph_stream *s[2];
    OK(gph_stream_create(f, &s[0]));
    OK(gph_stream_create(f, &s[1]));
    for (int i = 0; i < passes; ++i) {
        record_pass(s, vertices, photons << i);
        OK(gph_accumulate(f, s, 2, parallel, user));
        OK(gph_validate(f));
        OK(gph_refine(f, parallel, user));
        OK(gph_validate(f));
        gph_stream_clear(s[0]);
        gph_stream_clear(s[1]);
    }
    gph_stream_destroy(s[0]);
    gph_stream_destroy(s[1]);
}

static gph_field *train(const gph_desc *d, int passes, uint32_t vertices, uint32_t photons)
{
    gph_field *f;
    OK(gph_create(d, &f));
    teach(f, passes, vertices, photons, NULL, NULL);
    return f;
}

/* One pass of given samples. */
static void learn(gph_field *f, const gph_vertex *v, uint32_t vertices, const gph_photon *p, uint32_t photons)
{
    gph_stream *s;
    OK(gph_stream_create(f, &s));
    OK(gph_record_vertices(s, v, vertices));
    OK(gph_record_photons(s, p, photons));
    OK(gph_accumulate(f, &s, 1, NULL, NULL));
    gph_stream_destroy(s);
}

/* Photons of the test light at one place, after one touch. */
static void learn_at(gph_field *f, const float p[3], uint32_t photons)
{
    gph_vertex v = touch(p);
    gph_photon *q = malloc(photons * sizeof *q);
    for (uint32_t i = 0; i < photons; ++i) {
        float d[3];
        draw_light(d);
        q[i] = gph_make_photon(p, d, INFINITY, 1);
    }
    learn(f, &v, 1, q, photons);
    OK(gph_refine(f, NULL, NULL));
    free(q);
}

static gph_stats stats_of(const gph_field *f)
{
    gph_stats s;
    gph_get_stats(f, &s);
    return s;
}

static void *save(const gph_field *f, size_t *size)
{
    size_t bound = gph_save_bound(f);
    void *p = malloc(bound);
    OK(gph_save(f, p, bound, size));
    assert_true(*size <= bound);
    return p;
}

static bool same_fields(const gph_field *a, const gph_field *b)
{
    size_t na, nb;
    void *pa = save(a, &na), *pb = save(b, &nb);
    bool same = na == nb && memcmp(pa, pb, na) == 0;
    free(pa);
    free(pb);
    return same;
}

static void direction_at(double z, double phi, float d[3])
{
    double r = sqrt(1 - z * z);
    d[0] = (float)(r * cos(phi));
    d[1] = (float)(r * sin(phi));
    d[2] = (float)z;
}

/* Integral of the density over a grid of n x 2 n equal areas whose lines are also the bins'. */
static double integral_over(const gph_handle *h, int n)
{
    double sum = 0;
    for (int y = 0; y < n; ++y)
        for (int x = 0; x < 2 * n; ++x) {
            float d[3];
            direction_at((y + 0.5) * 2 / n - 1, PI * (x + 0.5) / n, d);
            sum += (double)gph_pdf(h, d);
        }
    return sum * 4 * PI / (2.0 * n * n);
}

static double integral(const gph_handle *h) { return integral_over(h, 128); }

/* integral(h^2 / p) / (integral h)^2 of the test light: 1 is perfect. */
static double score(const gph_handle *h)
{
    const int n = 192;
    double square = 0, sum = 0;
    for (int y = 0; y < n; ++y)
        for (int x = 0; x < 2 * n; ++x) {
            float d[3];
            direction_at((y + 0.5) * 2 / n - 1, PI * (x + 0.5) / n, d);
            double l = light(d);
            square += l * l / (double)gph_pdf(h, d);
            sum += l;
        }
    return square / (sum * sum) * (2.0 * n * n) / (4 * PI);
}

static gph_handle find(const gph_field *f, const float p[3])
{
    gph_view v = gph_get_view(f);
    gph_handle h;
    gph_find(&v, p, NULL, NULL, &h);
    return h;
}

/* ---- queries */

static void test_an_empty_field_is_uniform(void **state)
{
    (void)state;
    gph_desc zero;
    gph_field *f;
    float p[3] = {0.1f, 0.2f, 0.3f}, d[3], u[2] = {0.25f, 0.5f};
    memset(&zero, 0, sizeof zero);
    OK(gph_create(&zero, &f));
    OK(gph_validate(f));
    gph_handle h = find(f, p);
    assert_true(h.alpha == 1 && h.voxel == GPH_NONE);
    assert_true(fabs(integral(&h) - 1) < 1e-5);
    assert_true(fabsf(gph_sample(&h, u, d) - GPH_UNIFORM_PDF) < 1e-9f);
    assert_true(gph_all_closed(f));
    gph_destroy(f);
}

static void test_density_integrates_to_one_and_is_finite(void **state)
{
    (void)state;
    for (uint32_t rows = 16; rows <= 64; rows *= 2)
        for (int repair = GPH_REPAIR_NONE; repair < GPH_REPAIR_COUNT_; ++repair)
            for (uint32_t photons = 1; photons < 5000; photons *= 40) {
                gph_desc d = unit_cube();
                float p[3] = {0.1f, 0.1f, 0.1f};
                gph_field *f;
                d.rows = rows;
                d.repair = (gph_repair)repair;
                d.split_photons = 1e9f;
                seed(rows + photons);
                OK(gph_create(&d, &f));
                learn_at(f, p, photons);
                gph_handle h = find(f, p);
                assert_true(h.weights != NULL && h.alpha < 1);
                assert_true(fabs(integral(&h) - 1) < 1e-5);
                OK(gph_validate(f));
                gph_destroy(f);
            }
}

static void test_with_a_normal_it_integrates_to_one_over_the_upper_side(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f}, n[3] = {0.36f, 0.48f, 0.8f};
    gph_field *f;
    seed(3);
    OK(gph_create(&d, &f));
    learn_at(f, p, 400);
    gph_view v = gph_get_view(f);
    gph_handle h;
    gph_find(&v, p, n, NULL, &h);
    assert_true(fabs(integral_over(&h, 640) - 1) < 3e-3); /* the horizon cuts through the grid's squares */
    for (int i = 0; i < 20000; ++i) {
        float u[2] = {rndf(), rndf()}, w[3], pdf = gph_sample(&h, u, w);
        assert_true(dot(w, n) > -2e-6 && pdf > 0 && pdf == gph_pdf(&h, w));
    }
    gph_destroy(f);
}

/* Chi-square of samples against the density, on bins of the map cut in two each way. */
static void test_samples_follow_the_density(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f};
    gph_field *f;
    enum { ROWS = 64, COLUMNS = 128, N = 2000000 };
    static uint32_t seen[ROWS][COLUMNS];
    seed(5);
    d.repair = GPH_REPAIR_NONE;
    OK(gph_create(&d, &f));
    learn_at(f, p, 450);
    gph_handle h = find(f, p);
    for (int i = 0; i < N; ++i) {
        float u[2] = {rndf(), rndf()}, w[3], pdf = gph_sample(&h, u, w);
        assert_true(pdf > 0 && pdf < 1e6f && fabs(dot(w, w) - 1) < 1e-5);
        int r = (int)((w[2] + 1) * ROWS / 2), c;
        double phi = atan2((double)w[1], (double)w[0]);
        c = (int)((phi < 0 ? phi + 2 * PI : phi) * COLUMNS / (2 * PI));
        seen[r < ROWS ? r : ROWS - 1][c < COLUMNS ? c : COLUMNS - 1]++;
    }
    double chi2 = 0, df = -1;
    for (int r = 0; r < ROWS; ++r)
        for (int c = 0; c < COLUMNS; ++c) {
            float w[3];
            direction_at((r + 0.5) * 2 / ROWS - 1, 2 * PI * (c + 0.5) / COLUMNS, w);
            double expected = N * (double)gph_pdf(&h, w) * 4 * PI / (ROWS * COLUMNS);
            chi2 += (seen[r][c] - expected) * (seen[r][c] - expected) / expected;
            df += 1;
        }
    assert_true(fabs(chi_square_deviate(chi2, df)) < 4.5);
    gph_destroy(f);
}

/* Every second bin of a map is black, with no share of uniform sampling: numbers at the edges of the others must not
   be carried there by rounding. */
static void test_samples_at_the_edges_of_bins_stay_inside(void **state)
{
    (void)state;
    for (uint32_t rows = 16; rows <= 64; rows *= 2) {
        gph_desc d = unit_cube();
        float p[3] = {0.1f, 0.1f, 0.1f}, *map;
        uint32_t bins = 2 * rows * rows, voxel = 0;
        gph_field *f;
        d.rows = rows;
        seed(7);
        OK(gph_create(&d, &f));
        learn_at(f, p, 100);
        map = malloc(bins * sizeof *map);
        for (uint32_t i = 0; i < bins; ++i)
            map[i] = (float)((i + i / (2 * rows)) & 1);
        assert_int_equal(gph_import_maps(f, &voxel, 1, map, NULL, NULL), 1);
        gph_handle h = find(f, p);
        h.uniform = 0;
        h.share = 1 / (double)h.sums[rows];
        h.scale = (float)(h.share * bins / (4 * PI));
        for (uint32_t y = 0; y < rows; ++y)
            for (uint32_t x = 0; x < rows; ++x)
                for (int k = 0; k < 9; ++k) { /* each row, and each lit bin in it, has 1 / rows */
                    float u[2] = {(float)y / (float)rows, (float)x / (float)rows}, w[3];
                    u[0] = k / 3 == 1 ? nextafterf(u[0], 1) : k / 3 == 2 ? nextafterf(u[0] + 1 / (float)rows, 0) : u[0];
                    u[1] = k % 3 == 1 ? nextafterf(u[1], 1) : k % 3 == 2 ? nextafterf(u[1] + 1 / (float)rows, 0) : u[1];
                    assert_true(gph_sample(&h, u, w) > 0);
                }
        for (int i = 0; i < 300000; ++i) {
            float u[2] = {rndf(), rndf()}, w[3];
            assert_true(gph_sample(&h, u, w) > 0);
        }
        free(map);
        gph_destroy(f);
    }
}

static void test_turns_and_weights_are_exact(void **state)
{
    (void)state;
    seed(60);
    for (int i = 0; i < 200000; ++i) {
        double size = ldexp(1, (int)(rnd() * 60) - 50), phi = (rnd() - 0.5) * 2 * PI;
        float x = (float)(size * cos(phi)), y = (float)(size * sin(phi));
        double exact = atan2((double)y, (double)x) / (2 * PI);
        assert_true(fabs(gph_turn(x, y) - (exact < 0 ? exact + 1 : exact)) < 3e-11);
    }
    const float axes[8][2] = {{1, 0}, {1, 1}, {0, 1}, {-1, 1}, {-1, 0}, {-1, -1}, {0, -1}, {1, -1}};
    for (int i = 0; i < 8; ++i)
        assert_true(fabs(gph_turn(axes[i][0], axes[i][1]) - i / 8.0) < 3e-11);
    assert_true(gph_turn(0, 0) == 0);
    const float nowhere[3] = {NAN, NAN, NAN};
    assert_true(gph_bin(32, 64, nowhere) < 32 * 64);
    for (int h = 0; h < 0x7c00; ++h) { /* half-floats in units of 2^-24 */
        double exact = h < 1024 ? h : ldexp(1024 + (h & 1023), (h >> 10) - 1);
        assert_true((double)gph_weight((uint16_t)h) == exact);
    }
}

static void test_sampling_is_monotone_in_u(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f};
    gph_field *f;
    seed(6);
    d.repair = GPH_REPAIR_NONE;
    OK(gph_create(&d, &f));
    learn_at(f, p, 300);
    gph_handle h = find(f, p);
    float last = -2;
    for (int i = 0; i < 200000; ++i) {
        float u[2] = {(float)i / 200000, 0.3f}, w[3];
        gph_sample(&h, u, w);
        assert_true(w[2] >= last);
        last = w[2];
    }
    for (int k = 0; k < 40; ++k) {
        double before = -1;
        float u0 = rndf();
        for (int i = 0; i < 20000; ++i) {
            float u[2] = {u0, (float)i / 20000}, w[3];
            gph_sample(&h, u, w);
            double phi = atan2((double)w[1], (double)w[0]);
            phi = phi < -1e-6 ? phi + 2 * PI : phi;
            assert_true(phi >= before - 1e-6);
            before = phi;
        }
    }
    const float corner[4][2] = {{0, 0}, {0x1.fffffep-1f, 0x1.fffffep-1f}, {0, 0x1.fffffep-1f}, {0x1.fffffep-1f, 0}};
    for (int i = 0; i < 4; ++i) {
        float w[3], pdf = gph_sample(&h, corner[i], w);
        assert_true(pdf > 0 && pdf < 1e6f && fabs(dot(w, w) - 1) < 1e-5);
    }
    gph_destroy(f);
}

/* Photons on the other side of a thin wall, which no camera path meets, are not asked for. */
static void test_sides_that_nobody_sees_take_no_photons(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    const float p[3] = {0.1f, 0.1f, 0.1f}, up[3] = {0, 0, 1}, down[3] = {0, 0, -1}, slanted[3] = {0.6f, 0, 0.8f};
    const float zero[3] = {0, 0, 0}, side[3] = {-1, 0, 0};
    gph_field *f;
    gph_vertex v = touch(p);
    assert_true(gph_sides(NULL) == GPH_ALL_SIDES && gph_sides(zero) == GPH_ALL_SIDES);
    seed(12);
    for (int i = 0; i < 1000; ++i) {
        float n[3], m[3];
        random_direction(n);
        for (int k = 0; k < 3; ++k)
            m[k] = -n[k];
        assert_true(gph_sides(n) != 0 && gph_sides(n) < GPH_ALL_SIDES && (gph_sides(n) & gph_sides(m)) == 0);
    }
    OK(gph_create(&d, &f));
    v.sides = GPH_ALL_SIDES + 1;
    learn(f, &v, 1, NULL, 0);
    assert_true(stats_of(f).refused == 1 && !gph_takes_photons(f, p, NULL));
    v.sides = (uint16_t)gph_sides(up);
    learn(f, &v, 1, NULL, 0);
    assert_true(gph_takes_photons(f, p, up) && gph_takes_photons(f, p, slanted) && gph_takes_photons(f, p, NULL));
    assert_true(!gph_takes_photons(f, p, down) && gph_photons_at(f, p, down) < 0 && !gph_takes_photons(f, p, side));
    OK(gph_validate(f));
    assert_int_equal(gphi_find(f, p), 0);
    v.sides = 0;
    learn(f, &v, 1, NULL, 0);
    OK(gph_refine(f, NULL, NULL));
    assert_true(gph_takes_photons(f, p, down) && gph_takes_photons(f, p, side) && stats_of(f).valid == 1);
    v = gph_make_vertex(p, 1, 1, 1, 1, GPH_FROM_BSDF);
    for (int pass = 0; pass < 2; ++pass) {
        learn(f, &v, 1, NULL, 0);
        assert_true(gph_vertices_at(f, p) == (pass ? 2 : 1) && gph_vertices_at(f, up) == 0);
        OK(gph_refine(f, NULL, NULL));
    }
    assert_true(gph_vertices_at(f, p) == 1.5);
    gph_destroy(f);
}

static void test_a_known_distribution_is_recovered(void **state)
{
    (void)state;
    float p[3] = {0.1f, 0.1f, 0.1f};
    double last = INFINITY;
    for (uint32_t photons = 1000; photons <= 1000000; photons *= 10) {
        gph_desc d = unit_cube();
        gph_field *f;
        seed(7);
        d.repair = GPH_REPAIR_NONE;
        d.split_photons = 1e9f;
        OK(gph_create(&d, &f));
        learn_at(f, p, photons);
        gph_handle h = find(f, p);
        double v = score(&h);
        print_message("raw, %u photons: %.3f\n", photons, v);
        assert_true(v < last);
        last = v;
        gph_destroy(f);
    }
    assert_true(last < 1.05); /* bins of constant density cannot do better than 1.03 */
}

static void test_every_repair_helps_where_photons_are_few(void **state)
{
    (void)state;
    float p[3] = {0.1f, 0.1f, 0.1f};
    for (uint32_t photons = 100; photons <= 100000; photons *= 10) {
        double v[GPH_REPAIR_COUNT_];
        for (int repair = GPH_REPAIR_NONE; repair < GPH_REPAIR_COUNT_; ++repair) {
            gph_desc d = unit_cube();
            gph_field *f;
            seed(8);
            d.repair = (gph_repair)repair;
            d.split_photons = 1e9f;
            OK(gph_create(&d, &f));
            learn_at(f, p, photons);
            gph_handle h = find(f, p);
            v[repair] = score(&h);
            gph_destroy(f);
        }
        print_message("%u photons: raw %.3f, Gaussian %.3f, pyramid %.3f, pull-push %.3f\n", photons, v[1], v[2], v[3],
                      v[4]);
        if (photons <= 1000)
            assert_true(v[GPH_REPAIR_GAUSSIAN] < 0.5 * v[GPH_REPAIR_NONE]);
        assert_true(v[GPH_REPAIR_GAUSSIAN] < 1.01 * v[GPH_REPAIR_NONE]);
    }
}

/* Photons of an even light, of the test light, and of a narrow one: the chosen width is nearly as good as the best
   fixed one, which no single width is. */
static void test_the_blur_is_as_wide_as_the_light_allows(void **state)
{
    (void)state;
    const float sigmas[] = {0, 0.5f, 1, 2, 4};
    double worst = 0, worst_fixed = INFINITY, v[3][5];
    for (int kind = 0; kind < 3; ++kind)
        for (int k = 0; k < 5; ++k) {
            gph_desc d = unit_cube();
            float p[3] = {0.1f, 0.1f, 0.1f};
            gph_vertex at = touch(p);
            gph_field *f;
            static gph_photon q[300];
            seed(9);
            for (int i = 0; i < 300; ++i) {
                float w[3];
                draw_lobe(mean_a, kind == 0 ? 0.5 : kind == 1 ? 20 : 200, w);
                q[i] = gph_make_photon(p, w, INFINITY, 1);
            }
            d.sigma = sigmas[k];
            OK(gph_create(&d, &f));
            learn(f, &at, 1, q, 300);
            OK(gph_refine(f, NULL, NULL));
            gph_handle h = find(f, p);
            const int n = 256;
            double square = 0;
            for (int y = 0; y < n; ++y)
                for (int x = 0; x < 2 * n; ++x) {
                    float w[3];
                    direction_at((y + 0.5) * 2 / n - 1, PI * (x + 0.5) / n, w);
                    double l = lobe(mean_a, kind == 0 ? 0.5 : kind == 1 ? 20 : 200, w);
                    square += l * l / (double)gph_pdf(&h, w) * 4 * PI / (2.0 * n * n);
                }
            v[kind][k] = square;
            gph_destroy(f);
        }
    for (int k = 0; k < 5; ++k) {
        double ratio = 0;
        for (int kind = 0; kind < 3; ++kind) {
            double best = INFINITY;
            for (int j = 1; j < 5; ++j)
                best = fmin(best, v[kind][j]);
            ratio = fmax(ratio, v[kind][k] / best);
        }
        *(k ? &worst_fixed : &worst) = k ? fmin(worst_fixed, ratio) : ratio;
    }
    print_message("over the best of four widths, worst of three lights: chosen %.3f, one width for all %.3f\n", worst,
                  worst_fixed);
    assert_true(worst < 1.1 && worst_fixed > 1.3);
}

/* The blur goes on over the seam of phi and over the poles: what a single bright bin loses is found there. */
static void test_blur_wraps_and_crosses_the_poles(void **state)
{
    (void)state;
    const struct {
        double z, phi;
        double other_z[3], other_phi[3]; /* centres of the bins around it, in different directions */
    } cases[] = {{0.01, 0.01, {0.01, 0.01, -0.01}, {2 * PI - 0.01, 0.15, 0.01}},
                 {0.99, 1.01, {0.99, 0.99, 0.9}, {1.01 + PI, 1.1, 1.01}},
                 {-0.99, 4.01, {-0.99, -0.99, -0.9}, {4.01 - PI, 4.1, 4.01}}};
    for (unsigned i = 0; i < sizeof cases / sizeof *cases; ++i) {
        gph_desc d = unit_cube();
        float p[3] = {0.1f, 0.1f, 0.1f}, w[3];
        gph_field *f;
        gph_vertex v = touch(p);
        d.sigma = 1;
        OK(gph_create(&d, &f));
        direction_at(cases[i].z, cases[i].phi, w);
        gph_photon q = gph_make_photon(p, w, INFINITY, 3);
        learn(f, &v, 1, &q, 1);
        OK(gph_refine(f, NULL, NULL));
        gph_handle h = find(f, p);
        float middle = gph_pdf(&h, w), at[3];
        for (int k = 0; k < 3; ++k) {
            direction_at(cases[i].other_z[k], cases[i].other_phi[k], w);
            at[k] = gph_pdf(&h, w);
        }
        for (int k = 0; k < 3;
             ++k) /* every neighbour gets exp(-1/2) of it, but for half-floats and the uniform share */
            assert_true(fabsf(at[k] / middle - 0.6065f) < 0.01f);
        gph_destroy(f);
    }
}

static void test_batches_equal_single_queries(void **state)
{
    (void)state;
    enum { N = 301 };
    static float p[N][4], n[N][3], u[N][5], d[N][3], pdf[N], alpha[N], one[N];
    static gph_handle h[N];
    static uint32_t index[N];
    gph_desc desc = unit_cube();
    seed(11);
    gph_field *f = train(&desc, 2, 2000, 20000);
    gph_view v = gph_get_view(f);
    for (uint32_t i = 0; i < N; ++i) {
        random_position(p[i]);
        p[i][2] *= 2; /* half of them where nothing is */
        random_direction(n[i]);
        for (int k = 0; k < 5; ++k)
            u[i][k] = rndf();
        index[i] = N - 1 - i;
    }
    for (int with = 0; with < 4; ++with) {
        gph_find_batch(&v, N, with & 1 ? index : NULL, p[0], sizeof p[0], with & 2 ? n[0] : NULL, sizeof n[0],
                       with & 1 ? u[0] : NULL, sizeof u[0], h, alpha);
        gph_sample_batch(&v, N, with & 1 ? index : NULL, h, u[0] + 3, sizeof u[0], d[0], sizeof d[0], pdf);
        gph_pdf_batch(&v, N, NULL, h, d[0], sizeof d[0], one);
        for (int i = 0; i < N; ++i) {
            gph_handle g;
            float w[3];
            gph_find(&v, p[i], with & 2 ? n[i] : NULL, with & 1 ? u[i] : NULL, &g);
            assert_memory_equal(&g, &h[i], sizeof g);
            assert_true(alpha[i] == g.alpha && gph_sample(&g, u[i] + 3, w) == pdf[i] && one[i] == pdf[i]);
            assert_memory_equal(w, d[i], sizeof w);
        }
    }
    gph_destroy(f);
}

/* ---- options and limits */

static void test_documented_defaults_are_the_defaults(void **state)
{
    (void)state;
    gph_desc d;
    memset(&d, 0, sizeof d);
    OK(gph_resolve(&d, &d));
    const struct {
        const char *name;
        double value;
    } fields[] = {{"grid_cells", d.grid_cells},
                  {"rows", d.rows},
                  {"split_photons", (double)d.split_photons},
                  {"max_levels", d.max_levels},
                  {"keep_passes", d.keep_passes},
                  {"cloud_photons", d.cloud_photons},
                  {"max_bytes", (double)d.max_bytes},
                  {"sigma", (double)d.sigma},
                  {"pyramid_levels", d.pyramid_levels},
                  {"alpha", (double)d.alpha},
                  {"ratio_samples", d.ratio_samples},
                  {"uniform", (double)d.uniform},
                  {"gate_margin", (double)d.gate_margin},
                  {"gate_probe", d.gate_probe}};
    FILE *f = fopen("guide_photon.h", "r");
    f = f ? f : fopen("../guide_photon.h", "r");
    assert_non_null(f);
    char line[512];
    unsigned seen = 0;
    bool inside = false;
    while (fgets(line, sizeof line, f)) {
        inside = inside || strstr(line, "typedef struct gph_desc");
        if (strstr(line, "} gph_desc;"))
            break;
        for (unsigned i = 0; inside && i < sizeof fields / sizeof *fields; ++i) {
            char key[64];
            snprintf(key, sizeof key, " %s;", fields[i].name);
            const char *at = strstr(line, key), *text = at ? strstr(at, "default ") : NULL;
            if (!text)
                continue;
            double value, exponent;
            if (sscanf(text, "default 2^%lf", &exponent) == 1)
                value = exp2(exponent);
            else
                assert_int_equal(sscanf(text, "default %lf", &value), 1);
            if (fabs(value - fields[i].value) > 1e-6 * fabs(value))
                fail_msg("%s: documented %g, is %g", fields[i].name, value, fields[i].value);
            ++seen;
        }
    }
    fclose(f);
    assert_int_equal(seen, sizeof fields / sizeof *fields);
    assert_int_equal(d.repair, GPH_REPAIR_GAUSSIAN);
    assert_int_equal(d.alpha_mode, GPH_ALPHA_VARIANCE);
}

static void test_bad_descriptors_are_refused_by_name(void **state)
{
    (void)state;
    gph_desc d;
    gph_field *f = (gph_field *)&d;
#define REFUSED(result, change)                                                                                        \
    do {                                                                                                               \
        d = unit_cube();                                                                                               \
        change;                                                                                                        \
        assert_int_equal(gph_create(&d, &f), result);                                                                  \
        assert_null(f);                                                                                                \
    } while (0)
    REFUSED(GPH_BAD_BOUNDS, d.bounds_max[1] = -1);
    REFUSED(GPH_BAD_BOUNDS, d.bounds_max[1] = NAN);
    REFUSED(GPH_BAD_BOUNDS, d.bounds_min[2] = -INFINITY);
    REFUSED(GPH_BAD_OPTION, d.repair = GPH_REPAIR_COUNT_);
    REFUSED(GPH_BAD_OPTION, d.alpha_mode = (gph_alpha_mode)9);
    REFUSED(GPH_BAD_RANGE, d.rows = 33);
    REFUSED(GPH_BAD_RANGE, d.rows = 128);
    REFUSED(GPH_BAD_RANGE, d.grid_cells = 1025);
    REFUSED(GPH_BAD_RANGE, d.split_photons = NAN);
    REFUSED(GPH_BAD_RANGE, d.max_levels = 25);
    REFUSED(GPH_BAD_RANGE, d.keep_passes = 1001);
    REFUSED(GPH_BAD_RANGE, d.cloud_photons = 1000);
    REFUSED(GPH_BAD_RANGE, d.max_bytes = 1000);
    REFUSED(GPH_BAD_RANGE, d.sigma = -1);
    REFUSED(GPH_BAD_RANGE, d.pyramid_levels = 6);
    REFUSED(GPH_BAD_RANGE, d.alpha = 0.01f);
    REFUSED(GPH_BAD_RANGE, d.uniform = 2);
    REFUSED(GPH_BAD_RANGE, d.gate_margin = -1);
    REFUSED(GPH_BAD_RANGE, d.gate_probe = 1001);
    REFUSED(GPH_BAD_ALLOCATOR, d.allocate = count_allocate);
#undef REFUSED
    for (int i = 0; i < GPH_RESULT_COUNT; ++i)
        assert_true(strlen(gph_result_string((gph_result)i)) > 1);
    assert_string_equal(gph_result_string((gph_result)99), "unknown result");
}

static void test_sizes_are_as_documented(void **state)
{
    (void)state;
    assert_int_equal(sizeof(gph_vertex), 32);
    assert_int_equal(sizeof(gph_photon), 32);
    assert_int_equal(sizeof(gph_voxel), 20);
    assert_int_equal(sizeof(gph_node), 8);
    assert_int_equal(sizeof(gphi_voxel), 408);
    assert_int_equal(sizeof(gphi_entry), 16);
    assert_int_equal(sizeof(gphi_cloud_photon), 36);
    assert_true(sizeof(gph_handle) <= 88);
    assert_int_equal(sizeof(gph_stats) % 8, 0);
    for (uint32_t rows = 16; rows <= 64; rows *= 2) { /* the sampling side is within twice the half-floats */
        gph_desc d = unit_cube();
        gph_field *f;
        d.rows = rows;
        OK(gph_create(&d, &f));
        gph_view v = gph_get_view(f);
        assert_int_equal(v.map_bytes, 3 * f->bins + 8 * rows + 64);
        assert_true(v.map_bytes <= 2 * 2 * f->bins);
        gph_destroy(f);
    }
}

/* ---- places */

static void test_keys_cannot_overflow(void **state)
{
    (void)state;
    const float far[] = {0,     1,      -1,    0.5f,   1e3f,    -1e3f,    1e6f,     -1e6f,     1e9f,
                         1e12f, -1e12f, 1e30f, -1e30f, FLT_MAX, -FLT_MAX, INFINITY, -INFINITY, NAN};
    const double sides[] = {1e-30, 1e-3, 1, 1e3, 1e12, 1e30}, origin[3] = {-1e6, 1e6, 0};
    enum { N = sizeof far / sizeof *far };
    for (unsigned s = 0; s < sizeof sides / sizeof *sides; ++s)
        for (int i = 0; i < N; ++i)
            for (int k = 0; k < 3; ++k) {
                float p[3] = {0.25f, 0.25f, 0.25f};
                uint64_t before = gph_cube_key(origin, 1 / sides[s], p), key;
                p[k] = far[i];
                key = gph_cube_key(origin, 1 / sides[s], p);
                assert_true(key >> 63 == 0);
                for (int j = 0; j < 3; ++j) /* only its own bits change */
                    assert_true(j == k || ((key ^ before) >> (21 * j) & 0x1fffff) == 0);
            }
    /* within the range of cubes: one key each, in order */
    for (int i = -1048576; i < 1048576; i += 1 + (i & 1023)) {
        double zero[3] = {0, 0, 0};
        float p[3] = {(float)i + 0.5f, (float)-i, 0.5f};
        uint64_t key = gph_cube_key(zero, 1, p);
        assert_int_equal(key & 0x1fffff, i + 1048576);
        assert_int_equal(key >> 42, 1048576);
    }
}

/* The same field at other places and scales: it splits, learns, and answers alike. */
static void test_far_and_small_and_large_scenes_work(void **state)
{
    (void)state;
    const double place[] = {0, 1e6, -1e6, 0, 0, 1e12}, scale[] = {1, 100, 1, 1e-3, 1e12, 1e9};
    for (int i = 0; i < 6; ++i) {
        gph_desc d;
        gph_field *f;
        gph_stream *s;
        memset(&d, 0, sizeof d);
        d.grid_cells = 8;
        seed(21);
        OK(gph_create(&d, &f));
        OK(gph_stream_create(f, &s));
        for (int pass = 0; pass < 3; ++pass) {
            for (int k = 0; k < 40000; ++k) {
                float p[3], w[3];
                for (int a = 0; a < 3; ++a)
                    p[a] = (float)(place[i] + scale[i] * rnd());
                draw_light(w);
                gph_photon q = gph_make_photon(p, w, INFINITY, 1);
                gph_vertex v = touch(p);
                OK(gph_record_photons(s, &q, 1));
                if (k % 8 == 0)
                    OK(gph_record_vertices(s, &v, 1));
            }
            OK(gph_accumulate(f, &s, 1, NULL, NULL));
            gph_stream_clear(s);
            OK(gph_refine(f, NULL, NULL));
            OK(gph_validate(f));
        }
        gph_stats st = stats_of(f);
        assert_int_equal(st.photons + st.unread, 120000);
        assert_true(st.photons > 100000 && st.refused == 0 && st.maps > (fabs(place[i]) > 1e5 * scale[i] ? 1 : 500));
        for (int k = 0; k < 50; ++k) {
            float p[3], w[3], u[3] = {rndf(), rndf(), rndf()};
            for (int a = 0; a < 3; ++a)
                p[a] = (float)(place[i] + scale[i] * rnd());
            gph_view v = gph_get_view(f);
            gph_handle h;
            gph_find(&v, p, NULL, u, &h);
            assert_true(h.weights != NULL);
            float pdf = gph_sample(&h, u, w);
            assert_true(pdf > 0 && pdf < 1e6f && gph_pdf(&h, w) == pdf);
        }
        const float odd[] = {NAN, INFINITY, -INFINITY, 1e30f, -1e30f, FLT_MAX};
        for (int k = 0; k < 6; ++k) {
            float p[3] = {odd[k], odd[(k + 1) % 6], odd[(k + 2) % 6]};
            gph_handle h = find(f, p);
            assert_true(h.voxel == GPH_NONE && h.alpha == 1);
        }
        gph_stream_destroy(s);
        gph_destroy(f);
    }
}

static void test_only_places_of_camera_paths_take_photons(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f;
    float here[3] = {0.1f, 0.1f, 0.1f}, there[3] = {0.9f, 0.9f, 0.9f}, w[3] = {0, 0, 1};
    gph_vertex v = touch(here);
    gph_photon q[2] = {gph_make_photon(here, w, INFINITY, 1), gph_make_photon(there, w, 1, 1)};
    OK(gph_create(&d, &f));
    learn(f, NULL, 0, q, 2); /* before any camera path: nobody reads them */
    assert_int_equal(stats_of(f).unread, 2);
    assert_true(gph_photons_at(f, here, NULL) < 0 && gph_photons_at(f, there, NULL) < 0);
    learn(f, &v, 1, q, 2);
    assert_true(gph_photons_at(f, here, NULL) == 0 &&
                gph_photons_at(f, there, NULL) < 0); /* they wait for the refine */
    OK(gph_refine(f, NULL, NULL));
    assert_true(gph_photons_at(f, here, NULL) == 1 && gph_photons_at(f, there, NULL) < 0);
    gph_stats s = stats_of(f);
    assert_int_equal(s.photons, 1);
    assert_int_equal(s.unread, 3);
    assert_int_equal(s.voxels, 1);
    assert_int_equal(s.maps, 1);
    assert_int_equal(s.sparse, 1);
    assert_true(gph_takes_photons(f, here, NULL) && !gph_takes_photons(f, there, NULL));
    learn(f, NULL, 0, q, 1);
    assert_true(gph_photons_at(f, here, NULL) == 2); /* later passes count at once */
    gph_destroy(f);
}

static void test_first_vertices_give_the_box(void **state)
{
    (void)state;
    gph_desc d;
    gph_field *f;
    gph_vertex v[3];
    memset(&d, 0, sizeof d);
    d.grid_cells = 10;
    OK(gph_create(&d, &f));
    float a[3] = {5, -1, 2}, b[3] = {25, 1, 3}, bad[3] = {NAN, 0, 1e20f};
    v[0] = touch(a);
    v[1] = touch(bad);
    v[2] = touch(b);
    learn(f, v, 3, NULL, 0);
    assert_true(f->side == 2 && f->origin[0] == 5 && f->origin[1] == -1 && f->origin[2] == 2);
    assert_int_equal(stats_of(f).refused, 1);
    gph_destroy(f);
    OK(gph_create(&d, &f)); /* a single point */
    learn(f, v, 1, NULL, 0);
    OK(gph_refine(f, NULL, NULL));
    OK(gph_validate(f));
    assert_int_equal(stats_of(f).voxels, 1);
    gph_destroy(f);
}

/* ---- splits and recycling */

/* Photons so dense in one half of a voxel that the median lies there. */
static void test_first_pass_is_cut_at_the_median(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f;
    enum { N = 1000 };
    static gph_photon q[N];
    float w[3] = {0, 0, 1}, p[3] = {0.5f, 0.5f, 0.5f};
    gph_vertex v = touch(p);
    d.grid_cells = 1;
    d.split_photons = 600;
    seed(31);
    for (int i = 0; i < N; ++i) {
        float at[3] = {0.1f * rndf(), rndf(), rndf()};
        q[i] = gph_make_photon(at, w, INFINITY, 1);
    }
    OK(gph_create(&d, &f));
    learn(f, &v, 1, q, N);
    OK(gph_refine(f, NULL, NULL));
    assert_int_equal(stats_of(f).splits, 1);
    gph_view view = gph_get_view(f);
    uint32_t below = 0;
    for (int i = 0; i < N; ++i)
        below += q[i].position[0] < view.nodes[0].split;
    assert_int_equal(below, N / 2);
    for (int k = 0; k < 2; ++k)
        assert_true(view.voxels[k].photons == N / 2);
    gph_destroy(f);
    d.split_photons = 16; /* three levels at most: eight leaves */
    OK(gph_create(&d, &f));
    learn(f, &v, 1, q, N);
    OK(gph_refine(f, NULL, NULL));
    assert_int_equal(stats_of(f).voxels, 8);
    assert_int_equal(stats_of(f).levels, 3);
    gph_destroy(f);
    for (int i = 0; i < N; ++i) /* all in one point: nothing to cut */
        memcpy(q[i].position, p, sizeof p);
    OK(gph_create(&d, &f));
    learn(f, &v, 1, q, N);
    OK(gph_refine(f, NULL, NULL));
    assert_int_equal(stats_of(f).voxels, 1);
    assert_int_equal(stats_of(f).denied_splits, 1);
    gph_destroy(f);
}

/* Against sorting, with many that are equal. */
static void test_selection_finds_what_sorting_finds(void **state)
{
    (void)state;
    seed(43);
    for (int i = 0; i < 3000; ++i) {
        enum { MOST = 70 };
        float x[MOST], sorted[MOST];
        uint32_t n = 1 + (uint32_t)(rnd() * MOST) % MOST, k = (uint32_t)(rnd() * n) % n, values = 1 + (uint32_t)i % 9;
        for (uint32_t j = 0; j < n; ++j) {
            uint32_t at = j;
            x[j] = i % 3 ? (float)((uint32_t)(rnd() * 9) % values) : rndf();
            for (; at > 0 && sorted[at - 1] > x[j]; --at)
                sorted[at] = sorted[at - 1];
            sorted[at] = x[j];
        }
        assert_true(gphi_select(x, n, k) == sorted[k]);
    }
}

static void test_later_passes_are_cut_in_the_middle_and_halves_inherit(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f;
    enum { N = 900 };
    static gph_photon q[N];
    float p[3] = {0.1f, 0.2f, 0.3f}, other[3] = {0.9f, 0.2f, 0.3f}, w[3] = {0.6f, 0, 0.8f};
    gph_vertex v = touch(p);
    d.grid_cells = 1;
    d.split_photons = 1000;
    for (int i = 0; i < N; ++i)
        q[i] = gph_make_photon(p, w, INFINITY, 1);
    OK(gph_create(&d, &f));
    learn(f, &v, 1, q, N);
    OK(gph_refine(f, NULL, NULL));
    assert_int_equal(stats_of(f).splits, 0);
    learn(f, &v, 1, q, N); /* 1800 > 1000 sqrt(1800 / 900) */
    assert_true(gph_photons_at(f, p, NULL) == 2 * N && gph_photons_at(f, other, NULL) == 2 * N);
    gph_handle before = find(f, p);
    float density = gph_pdf(&before, w);
    OK(gph_refine(f, NULL, NULL));
    OK(gph_validate(f));
    assert_int_equal(stats_of(f).splits, 1);
    gph_view view = gph_get_view(f);
    assert_true(view.nodes[0].split == 0.5f && view.voxels[0].photons == N && view.voxels[1].photons == N);
    gph_handle low = find(f, p), high = find(f, other);
    assert_true(low.voxel != high.voxel);
    assert_true(gph_pdf(&low, w) == density && gph_pdf(&high, w) == density);
    assert_false(gph_takes_photons(f, p, NULL)); /* until it is touched again */
    assert_true(gph_photons_at(f, p, NULL) < 0 && gph_photons_at(f, other, NULL) < 0);
    learn(f, &v, 1, NULL, 0);
    assert_true(gph_takes_photons(f, p, NULL) && !gph_takes_photons(f, other, NULL));
    assert_true(gph_photons_at(f, p, NULL) == N && gph_photons_at(f, other, NULL) < 0); /* half of them */
    gph_destroy(f);
}

static void test_unread_voxels_are_recycled(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f;
    counter c = {0};
    count_with(&d, &c);
    d.keep_passes = 3;
    d.split_photons = 200;
    seed(33);
    f = train(&d, 3, 4000, 40000);
    gph_stats full = stats_of(f);
    size_t bytes = c.bytes;
    assert_true(full.cubes == 32 && full.levels > 3 && full.recycled == 0);
    assert_true(full.bytes > 0.95 * (double)bytes && full.bytes < 1.05 * (double)bytes);
    float p[3] = {0.1f, 0.1f, 0.1f}, away[3] = {0.9f, 0.9f, 0.1f}, w[3] = {0, 0, 1};
    for (int pass = 0; pass < 3; ++pass) { /* a pass without any vertex ages nothing */
        OK(gph_refine(f, NULL, NULL));
        assert_int_equal(stats_of(f).cubes, 32);
    }
    for (int pass = 0; pass < 4; ++pass) {
        gph_vertex v = touch(p);
        gph_photon q = gph_make_photon(p, w, INFINITY, 1);
        learn(f, &v, 1, &q, 1);
        OK(gph_refine(f, NULL, NULL));
        OK(gph_validate(f));
    }
    gph_stats less = stats_of(f);
    assert_int_equal(less.cubes, 1);
    assert_int_equal(less.maps, 1);
    assert_true(less.recycled > 31 && c.bytes < bytes / 20);
    assert_true(find(f, p).weights != NULL && find(f, away).voxel == GPH_NONE);
    teach(f, 2, 4000, 40000, NULL, NULL); /* and all of it grows again */
    assert_int_equal(stats_of(f).cubes, 32);
    gph_destroy(f);
    assert_int_equal(c.live, 0);
}

/* ---- memory */

static void test_memory_of_a_voxel_is_bounded(void **state)
{
    (void)state;
    for (uint32_t rows = 32; rows <= 64; rows *= 2) {
        const uint32_t counts[] = {0, 1, 20, 255, 256, 4000};
        size_t half = 2 * 2 * rows * rows;
        for (unsigned i = 0; i < sizeof counts / sizeof *counts; ++i) {
            gph_desc d = unit_cube();
            gph_field *f;
            counter c = {0};
            float p[3] = {0.1f, 0.1f, 0.1f};
            enum { VOXELS = 64 };
            count_with(&d, &c);
            d.rows = rows;
            d.split_photons = 1e9f;
            d.grid_cells = 64;
            seed(41);
            OK(gph_create(&d, &f));
            size_t empty = c.bytes;
            for (int k = 0; k < VOXELS; ++k) {
                p[0] = ((float)k + 0.5f) / VOXELS;
                gph_vertex v = touch(p);
                gph_photon *q = malloc((counts[i] + 1) * sizeof *q);
                for (uint32_t m = 0; m < counts[i]; ++m) {
                    float w[3];
                    random_direction(w);
                    q[m] = gph_make_photon(p, w, INFINITY, 1);
                }
                learn(f, &v, 1, q, counts[i]);
                free(q);
            }
            OK(gph_refine(f, NULL, NULL));
            gph_stats s = stats_of(f);
            double each = (double)(c.bytes - empty) / VOXELS, building, sampling;
            sampling = (double)(f->block->size) / VOXELS;
            building = (double)f->data_bytes / VOXELS;
            assert_int_equal(s.voxels, VOXELS);
            assert_int_equal(s.maps, counts[i] ? VOXELS : 0);
            assert_true(sampling <= 2 * (double)half);
            assert_true(each <= 8 * (double)half);
            if (!counts[i])
                assert_true(building == 0 && sampling < 200 && each < 1500);
            else if (counts[i] < 256)
                assert_true(s.sparse == VOXELS && building <= 2 * 16 * counts[i] + 128);
            else
                assert_true(s.sparse == 0 && building == 12.0 * f->bins);
            for (int pass = 1; pass < 5; ++pass) { /* what refine keeps for the next time is within that too */
                for (int k = 0; k < VOXELS; ++k) {
                    p[0] = ((float)k + 0.5f) / VOXELS;
                    gph_vertex v = touch(p);
                    gph_photon q = gph_make_photon(p, mean_a, INFINITY, 1);
                    learn(f, &v, 1, &q, counts[i] > 0);
                }
                OK(gph_refine(f, NULL, NULL));
                assert_true((double)(c.bytes - empty) / VOXELS <= 8 * (double)half);
            }
            gph_destroy(f);
            assert_int_equal(c.live, 0);
        }
    }
}

static void test_memory_cap_holds_and_the_field_still_learns(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    counter c = {0};
    count_with(&d, &c);
    d.grid_cells = 32;
    d.max_bytes = 8 << 20;
    seed(43);
    gph_field *f;
    gph_stream *s[2];
    OK(gph_create(&d, &f));
    OK(gph_stream_create(f, &s[0]));
    OK(gph_stream_create(f, &s[1]));
    for (int pass = 0; pass < 5; ++pass) {
        size_t before = c.bytes;
        record_pass(s, 20000, 20000u << pass);
        size_t streams = c.bytes - before;
        c.peak = c.bytes;
        OK(gph_accumulate(f, s, 2, NULL, NULL));
        OK(gph_refine(f, NULL, NULL));
        assert_true(c.peak <= (8 << 20) + (2 << 20) + streams); /* 2 MB to sort samples */
        gph_stream_destroy(s[0]);
        gph_stream_destroy(s[1]);
        assert_true(c.bytes <= 8 << 20 && stats_of(f).bytes <= 8 << 20);
        OK(gph_stream_create(f, &s[0]));
        OK(gph_stream_create(f, &s[1]));
    }
    gph_stream_destroy(s[0]);
    gph_stream_destroy(s[1]);
    gph_stats stats = stats_of(f);
    assert_true(stats.denied + stats.denied_splits > 0 && stats.lost == 0);
    assert_true(stats.maps > 100);
    gph_destroy(f);
    assert_int_equal(c.live, 0);
}

/* ---- bad input */

static void test_bad_samples_are_refused_and_leave_no_trace(void **state)
{
    (void)state;
    const float bad[] = {NAN, INFINITY, -INFINITY, -1, 1e30f, FLT_MAX};
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f}, w[3] = {0, 0, 1};
    gph_photon q[64];
    gph_vertex v[64];
    uint32_t n = 0, m = 0;
    for (int i = 0; i < 6; ++i) {
        q[n++] = gph_make_photon(p, w, INFINITY, bad[i]);
        if (i != 3) {
            for (int k = 0; k < 3; ++k) {
                float o[3] = {0.1f, 0.1f, 0.1f};
                o[k] = bad[i];
                q[n++] = gph_make_photon(o, w, 1, 1);
                v[m++] = touch(o);
            }
            float o[3] = {bad[i], 0, 0.5f};
            q[n++] = gph_make_photon(p, o, 1, 1);
        }
        if (i == 0 || i == 2 || i == 3)
            q[n++] = gph_make_photon(p, w, bad[i], 1);
        v[m++] = gph_make_vertex(p, bad[i], 1, 1, 1, GPH_FROM_BSDF);
        if (i < 4) {
            v[m++] = gph_make_vertex(p, 1, bad[i], 1, 1, GPH_FROM_BSDF);
            v[m++] = gph_make_vertex(p, 1, 1, bad[i], 1, GPH_FROM_GUIDE);
            v[m++] = gph_make_vertex(p, 1, 1, 1, bad[i], GPH_FROM_GUIDE);
        }
    }
    float zero[3] = {0, 0, 0};
    q[n++] = gph_make_photon(p, zero, 1, 1);
    q[n++] = gph_make_photon(p, w, 0, 1);
    v[m++] = gph_make_vertex(p, 1, 0, 1, 1, GPH_FROM_BSDF);
    v[m++] = gph_make_vertex(p, 1, 1, 1, 1, 7);
    assert_true(n <= 64 && m <= 64);
    gph_field *f, *g;
    seed(51);
    f = train(&d, 2, 3000, 20000);
    seed(51);
    g = train(&d, 2, 3000, 20000);
    learn(f, v, m, q, n);
    gph_stats s = stats_of(f);
    assert_int_equal(s.refused, n + m);
    gph_photon dark = gph_make_photon(p, w, INFINITY, 0);
    learn(f, NULL, 0, &dark, 1);
    assert_int_equal(stats_of(f).dark, 1);
    OK(gph_refine(f, NULL, NULL));
    OK(gph_refine(g, NULL, NULL));
    f->stats.refused = f->stats.dark = 0;
    assert_true(same_fields(f, g));
    gph_destroy(f);
    gph_destroy(g);
}

/* One bin, in many strengths, and enormous ones beside tiny ones: finite densities that integrate to one. */
static void test_extreme_histograms_stay_finite(void **state)
{
    (void)state;
    const float fluxes[][2] = {{1e-38f, 1e-38f}, {2e-45f, 2e-45f}, {1e-32f, 1e-32f},
                               {9e29f, 9e29f},   {1e-38f, 9e29f},  {1, 1e-6f}};
    for (unsigned i = 0; i < sizeof fluxes / sizeof *fluxes; ++i)
        for (int bins = 1; bins <= 2; ++bins) {
            gph_desc d = unit_cube();
            float p[3] = {0.1f, 0.1f, 0.1f}, w[2][3] = {{0, 0, 1}, {1, 0, 0.01f}};
            static gph_photon q[600];
            gph_field *f;
            gph_vertex v = touch(p);
            d.repair = GPH_REPAIR_NONE;
            for (int k = 0; k < 600; ++k)
                q[k] = gph_make_photon(p, w[k % bins], INFINITY, fluxes[i][k & 1]);
            OK(gph_create(&d, &f));
            for (int pass = 0; pass < 2; ++pass) {
                learn(f, &v, 1, q, 600);
                OK(gph_refine(f, NULL, NULL));
                OK(gph_validate(f));
            }
            gph_handle h = find(f, p);
            assert_true((h.weights != NULL) == (i > 1) && fabs(integral(&h) - 1) < 1e-5);
            if (bins == 1 && i > 1)
                assert_true(gph_pdf(&h, w[0]) > 0.98f * 2048 / (float)(4 * PI));
            for (int k = 0; k < 1000; ++k) {
                float u[2] = {rndf(), rndf()}, o[3], pdf = gph_sample(&h, u, o);
                assert_true(pdf > 0 && pdf < 200 && fabs(dot(o, o) - 1) < 1e-5);
            }
            gph_destroy(f);
        }
}

/* Photon numbers of a bin outgrow 16 bits: they keep their ratio, and powers their sums. */
static void test_many_photons_in_one_bin(void **state)
{
    (void)state;
    enum { N = 100000 };
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f}, w[2][3] = {{0, 0, 1}, {1, 0, 0.01f}};
    gph_photon *q = malloc(N * sizeof *q);
    gph_field *f;
    gph_vertex v = touch(p);
    d.repair = GPH_REPAIR_NONE;
    d.split_photons = 1e9f;
    for (int k = 0; k < N; ++k)
        q[k] = gph_make_photon(p, w[k % 4 == 0], INFINITY, 1);
    OK(gph_create(&d, &f));
    for (int pass = 0; pass < 3; ++pass) {
        learn(f, &v, 1, q, 60000);
        OK(gph_refine(f, NULL, NULL));
    }
    gph_handle h = find(f, p);
    assert_true(fabsf(gph_pdf(&h, w[0]) / gph_pdf(&h, w[1]) - 3) < 0.01f);
    float *x = malloc(5 * f->bins * sizeof *x), photons;
    uint32_t voxel = 0;
    gph_export_maps(f, &voxel, 1, x, &photons);
    assert_true(photons == 180000);
    for (int c = 0; c < 4; ++c) {
        float a = x[(uint32_t)c * f->bins + gph_bin(32, 64, w[0])],
              b = x[(uint32_t)c * f->bins + gph_bin(32, 64, w[1])];
        assert_true(fabsf(a / b - 3) < 0.02f && fabsf(a + b - 2048) < 0.01f);
    }
    free(x);
    free(q);
    gph_destroy(f);
}

/* ---- threads, files */

static void test_results_do_not_depend_on_threads(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    d.split_photons = 200;
    seed(61);
    gph_field *one = train(&d, 3, 8000, 40000);
    assert_true(stats_of(one).voxels > 200);
    for (int threads = 2; threads <= 8; threads += 3) {
        crowd c = {threads, 1};
        gph_field *f;
        seed(61);
        OK(gph_create(&d, &f));
        teach(f, 3, 8000, 40000, crowd_for, &c);
        assert_true(same_fields(one, f));
        gph_destroy(f);
    }
    gph_destroy(one);
}

/* Where the first pass has more photons than are kept, the rest goes straight to histograms. */
static void test_a_small_cloud_closes_early(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    d.cloud_photons = 5000;
    d.split_photons = 200;
    seed(62);
    gph_field *f = train(&d, 1, 4000, 40000);
    gph_stats s = stats_of(f);
    double photons = 0;
    gph_view v = gph_get_view(f);
    for (uint32_t i = 0; i < v.voxel_count; ++i)
        photons += (double)v.voxels[i].photons;
    assert_true(s.photons == 40000 && fabs(photons - 40000) < 1 && s.lost == 0);
    gph_destroy(f);
}

static void test_save_and_load_go_on_training_the_same(void **state)
{
    (void)state;
    for (int when = 0; when < 3; ++when) { /* with a cloud, with samples since refine, right after refine */
        gph_desc d = unit_cube();
        gph_stream *s[2];
        gph_field *f, *g;
        size_t size, small;
        d.split_photons = 200;
        d.repair = GPH_REPAIR_PULL_PUSH;
        d.no_gate = when == 1;
        seed(63);
        f = train(&d, when ? 2 : 0, 4000, 20000);
        if (when < 2) {
            OK(gph_stream_create(f, &s[0]));
            OK(gph_stream_create(f, &s[1]));
            record_pass(s, 3000, 20000);
            OK(gph_accumulate(f, s, 2, NULL, NULL));
            gph_stream_destroy(s[0]);
            gph_stream_destroy(s[1]);
        }
        void *p = save(f, &size);
        assert_int_equal(gph_save(f, p, size - 1, &small), GPH_BUFFER_TOO_SMALL);
        OK(gph_load(NULL, p, size, &g));
        OK(gph_validate(g));
        assert_true(same_fields(f, g));
        uint64_t rng = rng_state;
        teach(f, 2, 3000, 20000, NULL, NULL);
        rng_state = rng;
        teach(g, 2, 3000, 20000, NULL, NULL);
        assert_true(same_fields(f, g) && gph_structure_id(f) == gph_structure_id(g));
        free(p);
        gph_destroy(f);
        gph_destroy(g);
    }
}

/* The checksum of a forged save is made right, so that the checks behind it are met. */
static void set_checksum(void *p, size_t size)
{
    uint64_t sum = gphi_hash_bytes(1, (char *)p + GPHI_CHECKED_FROM, size - GPHI_CHECKED_FROM);
    memcpy((char *)p + offsetof(gphi_header, checksum), &sum, sizeof sum);
}

/* Whatever loads must hold together and answer with finite densities. */
static void use(gph_field *f)
{
    gph_view v = gph_get_view(f);
    for (int i = 0; i < 20; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, u[2] = {rndf(), rndf()}, w[3];
        gph_handle h;
        gph_find(&v, p, NULL, NULL, &h);
        float pdf = gph_sample(&h, u, w);
        assert_true(pdf > 0 && pdf < INFINITY && h.alpha > 0 && h.alpha <= 1);
    }
    teach(f, 1, 200, 500, NULL, NULL);
}

static void test_truncated_flipped_and_forged_saves_never_harm(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f, *g;
    size_t size;
    d.grid_cells = 2;
    d.rows = 16;
    seed(64);
    f = train(&d, 2, 300, 1500);
    gph_stream *s[2];
    OK(gph_stream_create(f, &s[0]));
    OK(gph_stream_create(f, &s[1]));
    record_pass(s, 100, 400);
    OK(gph_accumulate(f, s, 2, NULL, NULL));
    gph_stream_destroy(s[0]);
    gph_stream_destroy(s[1]);
    unsigned char *p = save(f, &size), *q = malloc(size + 1);
    for (size_t n = 0; n < size; n += n < 1000 ? 1 : 997) {
        unsigned char *cut = malloc(n + 1); /* sanitizers see the end */
        memcpy(cut, p, n);
        assert_true(gph_load(NULL, cut, n, &g) != GPH_OK && g == NULL);
        free(cut);
    }
    for (size_t bit = 0; bit < size * 8; bit += bit < 8000 ? 7 : 10007) {
        memcpy(q + 1, p, size); /* not aligned */
        q[1 + bit / 8] ^= (unsigned char)(1u << (bit % 8));
        assert_true(gph_load(NULL, q + 1, size, &g) != GPH_OK && g == NULL);
    }
    for (uint32_t version = 0; version < 4; ++version) { /* its checksum holds: only its number tells of what it is */
        memcpy(q, p, size);
        memcpy(q + offsetof(gphi_header, version), &version, sizeof version);
        assert_int_equal(gph_load(NULL, q, size, &g), version == GPH_VERSION ? GPH_OK : GPH_BAD_VERSION);
        assert_true((g != NULL) == (version == GPH_VERSION));
        gph_destroy(g);
    }
    int loaded = 0, refused = 0;
    for (int i = 0; i < 3000; ++i) {
        size_t at = i < 1500 ? rng_next() % 1500 : rng_next() % size;
        memcpy(q, p, size);
        for (int k = 0; k < 1 + i % 3; ++k)
            q[at < size - 4 ? at + (size_t)k : at] = (unsigned char)(i % 2 ? rng_next() : 255u * (rng_next() & 1));
        set_checksum(q, size);
        if (gph_load(NULL, q, size, &g) == GPH_OK) {
            ++loaded;
            OK(gph_validate(g));
            use(g);
            gph_destroy(g);
        } else
            ++refused;
    }
    assert_true(loaded > 100 && refused > 300);
    free(p);
    free(q);
    gph_destroy(f);
}

static void test_validate_notices_damage(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    seed(65);
    d.split_photons = 200;
    gph_field *f = train(&d, 2, 2000, 20000);
    OK(gph_validate(f));
#define NOTICED(what, wrong)                                                                                           \
    do {                                                                                                               \
        __typeof__(what) old = what;                                                                                   \
        what = wrong;                                                                                                  \
        assert_int_equal(gph_validate(f), GPH_CORRUPT);                                                                \
        what = old;                                                                                                    \
        OK(gph_validate(f));                                                                                           \
    } while (0)
    NOTICED(f->nodes[f->cubes[0].root].link, 0x1fffffffu);
    NOTICED(f->cubes[1].key, f->cubes[0].key);
    NOTICED(f->voxels[3].s.alpha, NAN);
    NOTICED(f->voxels[3].s.photons, -1);
    NOTICED(f->voxels[3].s.now.count, NAN);
    NOTICED(f->voxels[3].s.pivot[1], NAN);
    NOTICED(f->voxels[3].s.nearness, -1);
    NOTICED(gphi_map_pivot(gphi_block_map(f->block, 0), 32)[2], INFINITY);
    NOTICED(gphi_map_pivot(gphi_block_map(f->block, 0), 32)[3], NAN);
    NOTICED(f->block->maps, f->block->maps + 1);
    NOTICED(gphi_block_voxels(f->block)[0].map, f->block->maps);
    NOTICED(gphi_map_weights(gphi_block_map(f->block, 0), 32)[5], 0x7c00);
    NOTICED(((uint64_t *)(void *)gphi_block_map(f->block, 0))[32], 1);
    NOTICED(gphi_map_blocks(gphi_block_map(f->block, 0), 32)[77], 1u << 30);
#undef NOTICED
    gph_destroy(f);
}

/* Two machines share a field, trace different samples, and one takes over what the other learned. */
static void test_merge_equals_training_together(void **state)
{
    (void)state;
    for (int first = 0; first < 2; ++first) {
        gph_desc d = unit_cube();
        gph_field *together, *a, *b;
        gph_stream *s[2], *t[2];
        size_t size;
        d.repair = GPH_REPAIR_NONE;
        d.split_photons = 300;
        seed(66);
        together = train(&d, first ? 0 : 2, 500, 10000);
        void *p = save(together, &size);
        OK(gph_load(NULL, p, size, &a));
        OK(gph_load(NULL, p, size, &b));
        for (int k = 0; k < 2; ++k) {
            OK(gph_stream_create(a, &s[k]));
            OK(gph_stream_create(a, &t[k]));
        }
        record_pass(s, 2000, 20000);
        record_pass(t, 2000, 20000);
        /* both see all vertices, so that the photons find the same valid voxels */
        for (int k = 0; k < 2; ++k) {
            OK(gph_accumulate(together, s, 2, NULL, NULL));
            if (k == 0)
                OK(gph_accumulate(together, t, 2, NULL, NULL));
            OK(gph_accumulate(a, s, 2, NULL, NULL));
            OK(gph_accumulate(b, t, 2, NULL, NULL));
            break;
        }
        OK(gph_merge(a, b, NULL, NULL));
        OK(gph_validate(a));
        assert_int_equal(stats_of(a).photons, stats_of(together).photons);
        OK(gph_refine(a, NULL, NULL));
        OK(gph_refine(together, NULL, NULL));
        assert_int_equal(stats_of(a).voxels, stats_of(together).voxels);
        assert_int_equal(gph_structure_id(a), gph_structure_id(together));
        gph_view v = gph_get_view(a), w = gph_get_view(together);
        for (int i = 0; i < 2000; ++i) {
            float at[3], dir[3];
            gph_handle h, g;
            random_position(at);
            random_direction(dir);
            gph_find(&v, at, NULL, NULL, &h);
            gph_find(&w, at, NULL, NULL, &g);
            assert_true(fabsf(gph_pdf(&h, dir) / gph_pdf(&g, dir) - 1) < 2e-3f); /* half-floats */
        }
        assert_int_equal(gph_merge(a, b, NULL, NULL), GPH_MISMATCH); /* a has refined since */
        for (int k = 0; k < 2; ++k) {
            gph_stream_destroy(s[k]);
            gph_stream_destroy(t[k]);
        }
        free(p);
        gph_destroy(a);
        gph_destroy(b);
        gph_destroy(together);
    }
}

/* ---- failing memory */

/* Everything that allocates, twice; returns the number of calls that failed. */
static int scenario(counter *c)
{
    gph_desc d = unit_cube();
    gph_field *f = NULL, *g = NULL;
    gph_stream *s[2] = {NULL, NULL};
    int failed = 0;
    count_with(&d, c);
    d.rows = 16;
    d.split_photons = 60;
    d.keep_passes = 1;
    d.cloud_photons = 1024;
    seed(71);
#define TRY(call)                                                                                                      \
    do {                                                                                                               \
        gph_result r = call;                                                                                           \
        assert_true(r == GPH_OK || (r == GPH_OUT_OF_MEMORY && c->fail_at));                                            \
        failed += r != GPH_OK;                                                                                         \
    } while (0)
    TRY(gph_create(&d, &f));
    if (!f)
        return failed;
    TRY(gph_stream_create(f, &s[0]));
    TRY(gph_stream_create(f, &s[1]));
    for (int pass = 0; s[0] && s[1] && pass < 4; ++pass) {
        for (int i = 0; i < 900; ++i) {
            float p[3], w[3];
            random_position(p);
            p[0] *= pass == 3 ? 0.3f : 1; /* the rest is recycled */
            draw_light(w);
            gph_vertex v = touch(p);
            gph_photon q = gph_make_photon(p, w, INFINITY, 1);
            if (i < 300)
                TRY(gph_record_vertices(s[0], &v, 1));
            TRY(gph_record_photons(s[1], &q, 1));
        }
        TRY(gph_accumulate(f, s, 2, NULL, NULL));
        gph_stream_clear(s[0]);
        gph_stream_clear(s[1]);
        gph_result valid = gph_validate(f);
        assert_true(valid != GPH_CORRUPT);
        TRY(gph_refine(f, NULL, NULL));
        valid = gph_validate(f);
        assert_true(valid != GPH_CORRUPT);
    }
    size_t size, bound = gph_save_bound(f);
    void *p = malloc(bound);
    OK(gph_save(f, p, bound, &size));
    TRY(gph_load(&d, p, size, &g));
    if (g)
        TRY(gph_merge(f, g, NULL, NULL));
    free(p);
    c->fail_at = 0; /* memory is back: it learns again */
    if (s[0] && s[1]) {
        record_pass(s, 100, 2000);
        OK(gph_accumulate(f, s, 2, NULL, NULL));
        OK(gph_refine(f, NULL, NULL));
        OK(gph_validate(f));
        assert_true(stats_of(f).maps > 0);
    }
    gph_stream_destroy(s[0]);
    gph_stream_destroy(s[1]);
    gph_destroy(f);
    gph_destroy(g);
    return failed;
#undef TRY
}

static void test_every_failed_allocation_is_survived(void **state)
{
    (void)state;
    counter c = {0};
    assert_int_equal(scenario(&c), 0);
    assert_int_equal(c.live, 0);
    long requests = c.requests;
    assert_true(requests > 200);
    for (int all = 0; all < 2; ++all)
        for (long k = 1; k <= requests; k += k < 80 ? 1 : 1 + requests / 250) {
            c = (counter){.fail_at = k, .fail_all = all};
            scenario(&c);
            assert_int_equal(c.live, 0);
        }
}

/* A refine whose last request fails, done again, is as one that went well: nothing is judged or split twice. */
static void test_a_failed_refine_can_be_repeated(void **state)
{
    (void)state;
    gph_field *f[2];
    counter c[2] = {{0}, {0}};
    for (int k = 0; k < 2; ++k) {
        gph_desc d = unit_cube();
        gph_stream *s[2];
        count_with(&d, &c[k]);
        d.split_photons = 100;
        seed(73);
        f[k] = train(&d, 2, 1000, 10000);
        OK(gph_stream_create(f[k], &s[0]));
        OK(gph_stream_create(f[k], &s[1]));
        record_pass(s, 1000, 60000);
        OK(gph_accumulate(f[k], s, 2, NULL, NULL));
        gph_stream_destroy(s[0]);
        gph_stream_destroy(s[1]);
    }
    uint64_t splits = stats_of(f[0]).splits;
    long before = c[0].requests;
    OK(gph_refine(f[0], NULL, NULL));
    assert_true(stats_of(f[0]).splits > splits + 10);
    c[1].fail_at = c[1].requests + (c[0].requests - before); /* the sampling part */
    assert_int_equal(gph_refine(f[1], NULL, NULL), GPH_OUT_OF_MEMORY);
    OK(gph_validate(f[1]));
    c[1].fail_at = 0;
    OK(gph_refine(f[1], NULL, NULL));
    assert_true(same_fields(f[0], f[1]));
    for (int k = 0; k < 2; ++k) {
        gph_destroy(f[k]);
        assert_int_equal(c[k].live, 0);
    }
}

static void test_queries_do_not_allocate_and_lost_samples_are_counted(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    counter c = {0};
    gph_stream *s;
    static gph_photon q[1000];
    count_with(&d, &c);
    seed(72);
    gph_field *f = train(&d, 2, 1000, 10000);
    long before = c.requests;
    gph_view v = gph_get_view(f);
    float p[3] = {0.1f, 0.2f, 0.3f}, u[3] = {0.3f, 0.4f, 0.5f}, w[3] = {0, 0, 1}, pdf;
    gph_handle h;
    static float x[5 * 2048];
    uint32_t voxel[4];
    gph_find(&v, p, w, u, &h);
    gph_find_batch(&v, 1, NULL, p, 12, NULL, 0, u, 12, &h, NULL);
    gph_sample_batch(&v, 1, NULL, &h, u, 8, w, 12, &pdf);
    gph_pdf_batch(&v, 1, NULL, &h, w, 12, &pdf);
    (void)stats_of(f);
    (void)gph_structure_id(f);
    (void)gph_save_bound(f);
    (void)gph_takes_photons(f, p, NULL);
    (void)gph_changed_voxels(f, voxel, 4);
    voxel[0] = 0;
    gph_export_maps(f, voxel, 1, x, NULL);
    assert_int_equal(gph_import_maps(f, voxel, 1, x, NULL, NULL), 1);
    assert_int_equal(c.requests, before);
    OK(gph_stream_create(f, &s));
    for (int i = 0; i < 1000; ++i)
        q[i] = gph_make_photon(p, w, INFINITY, 1);
    c.fail_at = c.requests + 2; /* the second chunk */
    assert_int_equal(gph_record_photons(s, q, 1000), GPH_OUT_OF_MEMORY);
    assert_int_equal(gph_stream_size(s), 256);
    c.fail_at = 0;
    uint64_t photons = stats_of(f).photons;
    gph_vertex t = touch(p);
    OK(gph_record_vertices(s, &t, 1));
    OK(gph_accumulate(f, &s, 1, NULL, NULL));
    assert_int_equal(stats_of(f).lost, 744);
    assert_int_equal(stats_of(f).photons - photons, 256);
    gph_stream_destroy(s);
    gph_destroy(f);
    assert_int_equal(c.live, 0);
}

/* ---- alpha and gate */

/* Vertices at one place whose light is the test light of strength 1 within a cosine-free BSDF: BSDF sampling is even
   over the sphere. guided: the field knows the light; else it learned another one. */
static void vertices_of(gph_field *f, const float p[3], bool even, int passes)
{
    for (int pass = 0; pass < passes; ++pass) {
        static gph_vertex v[4000];
        for (int i = 0; i < 4000; ++i) {
            gph_handle h = find(f, p);
            float w[3], u[2] = {rndf(), rndf()}, pg;
            bool guide = rnd() > (double)h.alpha;
            if (guide)
                gph_sample(&h, u, w);
            else
                random_direction(w);
            pg = gph_pdf(&h, w);
            v[i] = gph_make_vertex(p, even ? 1 : (float)light(w), h.alpha * GPH_UNIFORM_PDF + (1 - h.alpha) * pg,
                                   GPH_UNIFORM_PDF, pg, guide ? GPH_FROM_GUIDE : GPH_FROM_BSDF);
        }
        learn(f, v, 4000, NULL, 0);
        OK(gph_refine(f, NULL, NULL));
        OK(gph_validate(f));
    }
}

static void test_gate_closes_where_guiding_does_not_pay_and_opens_where_it_does(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f};
    d.split_photons = 1e9f;
    for (int even = 0; even < 2; ++even) {
        gph_field *f;
        seed(81);
        OK(gph_create(&d, &f));
        learn_at(f, p, 4000);
        vertices_of(f, p, even, 3);
        gph_stats s = stats_of(f);
        assert_int_equal(even ? s.closed_voxels : s.open_voxels, 1);
        assert_int_equal(gph_all_closed(f), even);
        gph_handle h = find(f, p);
        assert_true(even ? h.alpha == 1 : h.alpha < 0.4f);
        assert_true(even ? s.closed_share >= 0 : s.mean_alpha < 0.5f);
        if (even) { /* tried again, and closed again */
            vertices_of(f, p, even, 12);
            s = stats_of(f);
            assert_true(s.probed >= 1 && s.closed >= 2);
        }
        gph_destroy(f);
    }
    d.no_gate = true;
    gph_field *f;
    OK(gph_create(&d, &f));
    learn_at(f, p, 4000);
    vertices_of(f, p, true, 3);
    assert_false(gph_all_closed(f));
    gph_destroy(f);
}

/* Contribution / p is 2 g where p is a half, 0.5 g where it is two: its mean is known. With and without a map; too few
   vertices say nothing, also those of several passes together, and passes without any forget nothing. */
static void test_handles_tell_what_surfaces_reflect(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    gph_field *f;
    float p[3] = {0.1f, 0.1f, 0.1f}, far[3] = {0.9f, 0.1f, 0.1f}, rare[3] = {0.1f, 0.9f, 0.1f};
    gph_stream *s;
    OK(gph_create(&d, &f));
    OK(gph_stream_create(f, &s));
    for (int pass = 0; pass < 5; ++pass) {
        for (int i = 0; i < 20; ++i) {
            gph_vertex v = gph_make_vertex(rare, (float)(i % 2 ? 4 : 3), i % 4 < 2 ? 0.5f : 2, 1, 0, GPH_FROM_BSDF);
            OK(gph_record_vertices(s, &v, 1));
        }
        for (int i = 0; i < (pass == 0 ? 28 : pass < 4 ? 40 : 0); ++i) {
            gph_vertex v = gph_make_vertex(p, (float)(i % 2 ? 4 : 3), i % 4 < 2 ? 0.5f : 2, 1, 0, GPH_FROM_BSDF);
            OK(gph_record_vertices(s, &v, 1));
            v = touch(p);
            OK(gph_record_vertices(s, &v, 1));
            v = touch(far);
            OK(gph_record_vertices(s, &v, 1));
        }
        if (pass == 2)
            learn_at(f, p, 100);
        OK(gph_accumulate(f, &s, 1, NULL, NULL));
        gph_stream_clear(s);
        OK(gph_refine(f, NULL, NULL));
        OK(gph_validate(f));
        gph_handle h = find(f, p);
        assert_float_equal(h.reflected, pass ? 3.5 * 1.25 : 0, 1e-5);
        assert_true((h.weights != NULL) == (pass >= 2));
        assert_float_equal(find(f, far).reflected, 0, 0); /* nobody has looked on from there */
        gph_handle seldom = find(f, rare);                /* 20, 30, 30 / 4 + 20, 33.75 vertices: now they are enough */
        assert_true(seldom.weights == NULL);
        assert_float_equal(seldom.reflected, pass < 3 ? 0 : 3.5 * 1.25, 1e-5);
    }
    gph_stream_destroy(s);
    gph_destroy(f);
}

static void test_ratio_alpha_is_equation_14(void **state)
{
    (void)state;
    const float strength[][2] = {{1, 3}, {3, 1}, {1, 100}, {100, 1}};
    const double wanted[] = {0.25, 0.75, 0.2, 0.8};
    for (int i = 0; i < 4; ++i) {
        gph_desc d = unit_cube();
        float p[3] = {0.1f, 0.1f, 0.1f};
        gph_vertex v[400];
        gph_field *f;
        d.alpha_mode = GPH_ALPHA_RATIO;
        d.ratio_samples = 100;
        d.no_gate = true;
        seed(82);
        OK(gph_create(&d, &f));
        learn_at(f, p, 1000);
        for (int k = 0; k < 400; ++k)
            v[k] = gph_make_vertex(p, strength[i][k < 300], 1, 1, 1, k < 300 ? GPH_FROM_GUIDE : GPH_FROM_BSDF);
        learn(f, v, 350, NULL, 0); /* 50 of the BSDF: too few */
        OK(gph_refine(f, NULL, NULL));
        assert_true(find(f, p).alpha == 0.5f);
        learn(f, v, 400, NULL, 0);
        OK(gph_refine(f, NULL, NULL));
        assert_true(fabs((double)find(f, p).alpha - wanted[i]) < 1e-6);
        gph_destroy(f);
    }
}

/* ---- networks */

static void test_maps_go_out_and_come_back(void **state)
{
    (void)state;
    gph_desc d = unit_cube();
    float p[3] = {0.1f, 0.1f, 0.1f}, q[3] = {0.9f, 0.1f, 0.1f}, w[2][3] = {{0, 0.1f, 1}, {1, 0.1f, 0.01f}};
    gph_field *f;
    gph_vertex v[2] = {touch(p), touch(q)};
    gph_photon a[4] = {gph_make_photon(p, w[0], INFINITY, 1), gph_make_photon(p, w[1], INFINITY, 3),
                       gph_make_photon(p, w[1], INFINITY, 3), gph_make_photon(q, w[0], INFINITY, 1)};
    OK(gph_create(&d, &f));
    learn(f, v, 2, a, 2); /* pass 0: one photon in each bin, of flux 1 and 3 */
    learn(f, NULL, 0, a + 3, 1);
    OK(gph_refine(f, NULL, NULL));
    assert_int_equal(gph_changed_voxels(f, NULL, 0), 2);
    learn(f, v, 1, a + 2, 1); /* pass 1: another of 3, at p only */
    OK(gph_refine(f, NULL, NULL));
    uint32_t changed[4], n = f->bins, b0 = gph_bin(32, 64, w[0]), b1 = gph_bin(32, 64, w[1]);
    assert_int_equal(gph_changed_voxels(f, changed, 4), 1);
    uint32_t ask[3] = {find(f, p).voxel, find(f, q).voxel, 1000};
    assert_int_equal(changed[0], ask[0]);
    float *x = malloc(3 * 5 * n * sizeof *x), photons[3];
    gph_export_maps(f, ask, 3, x, photons);
    assert_true(photons[0] == 3 && photons[1] == 1 && photons[2] == 0);
    const float expected[5][2] = {
        {n * 1.0f / 7, n * 6.0f / 7}, {n / 4.0f, n * 3 / 4.0f}, {n / 3.0f, n * 2 / 3.0f}, {n / 2.0f, n / 2.0f}, {1, 1}};
    for (uint32_t c = 0; c < 5; ++c) {
        double sum = 0;
        for (uint32_t i = 0; i < n; ++i)
            sum += (double)x[c * n + i];
        assert_true(fabsf(x[c * n + b0] - expected[c][0]) < 1e-3f && fabsf(x[c * n + b1] - expected[c][1]) < 1e-3f);
        assert_true(fabs(sum - (double)(expected[c][0] + expected[c][1])) < 1e-2);
    }
    for (uint32_t c = 0; c < 4; ++c) /* at q nothing came in pass 1: both passes look alike */
        assert_true(x[(5 + c) * n + b0] == (float)n);
    for (uint32_t i = 0; i < 5 * n; ++i)
        assert_true(x[10 * n + i] == 0);
    /* what a network says: all light from bin 7, some from bin 8; rubbish counts as nothing */
    for (uint32_t i = 0; i < n; ++i)
        x[i] = i == 7 ? 6 : i == 8 ? 2 : i % 3 ? -1 : NAN;
    memset(x + n, 0, n * sizeof *x);
    assert_int_equal(gph_import_maps(f, ask, 3, x, NULL, NULL), 1);
    OK(gph_validate(f));
    gph_handle h = find(f, p);
    float d7[3], d8[3];
    direction_at(0.5 * 2 / 32 - 1, 2 * PI * 7.5 / 64, d7);
    direction_at(0.5 * 2 / 32 - 1, 2 * PI * 8.5 / 64, d8);
    float other = gph_pdf(&h, w[0]);
    assert_true(fabsf((gph_pdf(&h, d7) - other) / (gph_pdf(&h, d8) - other) - 3) < 0.01f);
    assert_true(fabsf(other - 0.01f * GPH_UNIFORM_PDF) < 1e-6f && fabs(integral(&h) - 1) < 1e-5);
    learn(f, v + 1, 1, a + 3, 1); /* p gets nothing new: its map stays; another place's is made anew */
    OK(gph_refine(f, NULL, NULL));
    h = find(f, p);
    assert_true(fabsf((gph_pdf(&h, d7) - other) / (gph_pdf(&h, d8) - other) - 3) < 0.01f);
    learn(f, v, 1, a, 1); /* one of 4 is new to it: it stays; two of 5: it is made anew */
    OK(gph_refine(f, NULL, NULL));
    h = find(f, p);
    assert_true(gph_pdf(&h, d7) > 0.1f && gph_changed_voxels(f, NULL, 0) == 0);
    learn(f, v, 1, a, 1);
    OK(gph_refine(f, NULL, NULL));
    h = find(f, p);
    assert_true(gph_pdf(&h, d7) < 0.1f && gph_changed_voxels(f, NULL, 0) == 1);
    free(x);
    gph_destroy(f);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_an_empty_field_is_uniform),
        cmocka_unit_test(test_density_integrates_to_one_and_is_finite),
        cmocka_unit_test(test_with_a_normal_it_integrates_to_one_over_the_upper_side),
        cmocka_unit_test(test_samples_follow_the_density),
        cmocka_unit_test(test_samples_at_the_edges_of_bins_stay_inside),
        cmocka_unit_test(test_turns_and_weights_are_exact),
        cmocka_unit_test(test_sampling_is_monotone_in_u),
        cmocka_unit_test(test_sides_that_nobody_sees_take_no_photons),
        cmocka_unit_test(test_a_known_distribution_is_recovered),
        cmocka_unit_test(test_every_repair_helps_where_photons_are_few),
        cmocka_unit_test(test_the_blur_is_as_wide_as_the_light_allows),
        cmocka_unit_test(test_blur_wraps_and_crosses_the_poles),
        cmocka_unit_test(test_batches_equal_single_queries),
        cmocka_unit_test(test_documented_defaults_are_the_defaults),
        cmocka_unit_test(test_bad_descriptors_are_refused_by_name),
        cmocka_unit_test(test_sizes_are_as_documented),
        cmocka_unit_test(test_keys_cannot_overflow),
        cmocka_unit_test(test_far_and_small_and_large_scenes_work),
        cmocka_unit_test(test_only_places_of_camera_paths_take_photons),
        cmocka_unit_test(test_first_vertices_give_the_box),
        cmocka_unit_test(test_first_pass_is_cut_at_the_median),
        cmocka_unit_test(test_selection_finds_what_sorting_finds),
        cmocka_unit_test(test_later_passes_are_cut_in_the_middle_and_halves_inherit),
        cmocka_unit_test(test_unread_voxels_are_recycled),
        cmocka_unit_test(test_memory_of_a_voxel_is_bounded),
        cmocka_unit_test(test_memory_cap_holds_and_the_field_still_learns),
        cmocka_unit_test(test_bad_samples_are_refused_and_leave_no_trace),
        cmocka_unit_test(test_extreme_histograms_stay_finite),
        cmocka_unit_test(test_many_photons_in_one_bin),
        cmocka_unit_test(test_results_do_not_depend_on_threads),
        cmocka_unit_test(test_a_small_cloud_closes_early),
        cmocka_unit_test(test_save_and_load_go_on_training_the_same),
        cmocka_unit_test(test_truncated_flipped_and_forged_saves_never_harm),
        cmocka_unit_test(test_validate_notices_damage),
        cmocka_unit_test(test_merge_equals_training_together),
        cmocka_unit_test(test_every_failed_allocation_is_survived),
        cmocka_unit_test(test_a_failed_refine_can_be_repeated),
        cmocka_unit_test(test_queries_do_not_allocate_and_lost_samples_are_counted),
        cmocka_unit_test(test_gate_closes_where_guiding_does_not_pay_and_opens_where_it_does),
        cmocka_unit_test(test_handles_tell_what_surfaces_reflect),
        cmocka_unit_test(test_ratio_alpha_is_equation_14),
        cmocka_unit_test(test_maps_go_out_and_come_back),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
