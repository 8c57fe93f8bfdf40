/* test_kd.c: guide_kd.h, the field: what it learns, what it refuses, what it survives.

   gcc -std=c11 -O2 -I. tests/test_kd.c -lcmocka -lm -lpthread */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GKD_IMPLEMENTATION
#include "guide_kd.h"
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "chi_square.h"
#include "counter.h"
#include "crowd.h"
#include "kd_field.h"
#include "rng.h"

/* ---- helpers */

/* The levels that this machine has, from the plainest up. */
static uint32_t levels_here(gkd_simd out[5])
{
    uint32_t n = 0;
    for (int k = GKD_SIMD_SCALAR; k <= GKD_SIMD_NEON; ++k) {
        gkd_desc d = unit_cube();
        d.simd = (gkd_simd)k;
        if (gkd_resolve(&d, &d) == GKD_OK)
            out[n++] = (gkd_simd)k;
    }
    assert_true(n >= 1 && out[0] == GKD_SIMD_SCALAR);
    return n;
}

/* The scene: a ball of radius 0.05 and radiance 400 at (0.5, 0.5, 0.8), a dim sky above, a wall at x = 0 (radiance 2)
   that only shines on the half y > 0.5. */
static const float lamp[3] = {0.5f, 0.5f, 0.8f};
static float scene(const float p[3], const float d[3], float *distance)
{
    float v[3], b = 0, c = -0.05f * 0.05f, q;
    for (int k = 0; k < 3; ++k) {
        v[k] = lamp[k] - p[k];
        b += v[k] * d[k];
        c += v[k] * v[k];
    }
    q = b * b - c;
    if (c > 0 && b > 0 && q > 0) {
        *distance = b - sqrtf(q);
        *distance = *distance > 1e-4f ? *distance : 1e-4f;
        return 400;
    }
    if (d[0] < -0.1f) {
        *distance = (p[0] + 0.01f) / -d[0];
        return p[1] > 0.5f ? 2 : 0.1f;
    }
    *distance = INFINITY;
    return d[2] > 0 ? 0.2f : 0;
}

/* n samples drawn as a renderer would from the view (NULL: uniformly); every 7th is black. */
static void make_samples(const gkd_view *v, gkd_training_sample *s, uint32_t n)
{
    for (uint32_t i = 0; i < n; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, d[3], u[2] = {rndf(), rndf()}, distance, pb = (float)UNIFORM, pg = 0;
        float mix = pb, L;
        random_direction(d);
        if (v) {
            gkd_handle h;
            gkd_find(v, p, NULL, NULL, &h);
            if (rnd() < (double)h.alpha)
                pg = gkd_pdf(&h, d);
            else
                pg = gkd_sample(&h, u, d);
            mix = h.alpha * pb + (1 - h.alpha) * pg;
        }
        L = scene(p, d, &distance);
        L = i % 7 ? L : 0;
        s[i] = gkd_make_scalar_sample(p, d, NULL, distance, L, L * 0.3f, L * 0.3f * (0.5f + p[0]), mix, pb, pg);
    }
}

/* Passes of `first`, twice `first`, ... samples. */
static void teach(gkd_field *f, int passes, uint32_t first)
{
    for (int p = 0; p < passes; ++p) {
        uint32_t n = first << p;
        gkd_training_sample *s = malloc(n * sizeof *s);
        gkd_view v = gkd_get_view(f);
        make_samples(&v, s, n);
        learn(f, s, n);
        OK(gkd_refine(f, NULL, NULL, NULL));
        OK(gkd_validate(f));
        free(s);
    }
}

static gkd_field *train(const gkd_desc *d, int passes, uint32_t first)
{
    gkd_field *f;
    OK(gkd_create(d, &f));
    teach(f, passes, first);
    return f;
}

static void *save(const gkd_field *f, size_t *size)
{
    size_t bound = gkd_save_bound(f);
    void *p = malloc(bound);
    OK(gkd_save(f, p, bound, size));
    assert_true(*size <= bound);
    return p;
}

static bool same_fields(const gkd_field *a, const gkd_field *b)
{
    size_t na, nb;
    void *pa = save(a, &na), *pb = save(b, &nb);
    bool same = na == nb && memcmp(pa, pb, na) == 0;
    free(pa);
    free(pb);
    return same;
}

static double dot(const float a[3], const float b[3])
{
    return (double)a[0] * (double)b[0] + (double)a[1] * (double)b[1] + (double)a[2] * (double)b[2];
}

/* Integral of the density over a grid of equal areas: exact enough where lobes are not sharper than its squares. */
static double integral(const gkd_handle *h)
{
    const int n = 700;
    double sum = 0;
    for (int y = 0; y < n; ++y)
        for (int x = 0; x < 2 * n; ++x) {
            double z = (y + 0.5) * 2 / n - 1, phi = PI * (x + 0.5) / n, r = sqrt(1 - z * z);
            float d[3] = {(float)(r * cos(phi)), (float)(r * sin(phi)), (float)z};
            sum += (double)gkd_pdf(h, d);
        }
    return sum * 4 * PI / (2.0 * n * n);
}

static void check_numbers(const gkd_field *f)
{
    gkd_view v = gkd_get_view(f);
    OK(gkd_validate(f));
    for (int i = 0; i < 300; ++i) {
        float p[3], d[3], u[2] = {rndf(), rndf()}, n[3];
        gkd_handle h;
        for (int k = 0; k < 3; ++k)
            p[k] = v.bounds_min[k] + rndf() * (v.bounds_max[k] - v.bounds_min[k]);
        random_direction(n);
        gkd_find(&v, p, i & 1 ? n : NULL, NULL, &h);
        float pdf = gkd_sample(&h, u, d);
        assert_true(pdf > 0 && pdf < 1e9f);
        assert_true(fabs(dot(d, d) - 1) < 1e-4);
        assert_true(h.alpha > 0 && h.alpha <= 1 && h.reflected >= 0 && h.reflected < INFINITY);
    }
}

/* ---- options */

static void test_documented_defaults_are_the_defaults(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    OK(gkd_resolve(&d, &d));
    const struct {
        const char *name;
        double value;
    } fields[] = {{"split_samples", d.split_samples},
                  {"lookahead", d.lookahead},
                  {"min_samples", d.min_samples},
                  {"radiance_step", (double)d.radiance_step},
                  {"direction_step", (double)d.direction_step * 180 / PI},
                  {"confidence", (double)d.confidence},
                  {"keep_signatures", (double)d.keep_signatures},
                  {"max_levels", d.max_levels},
                  {"max_lobes", d.max_lobes},
                  {"update_samples", d.update_samples},
                  {"max_bytes", (double)d.max_bytes},
                  {"alpha", (double)d.alpha},
                  {"uniform", (double)d.uniform},
                  {"gate_margin", (double)d.gate_margin},
                  {"gate_gain", (double)d.gate_gain},
                  {"gate_probe", d.gate_probe}};
    FILE *f = fopen("guide_kd.h", "r");
    f = f ? f : fopen("../guide_kd.h", "r");
    assert_non_null(f);
    char line[512];
    unsigned seen = 0;
    bool inside = false;
    while (fgets(line, sizeof line, f)) {
        inside = inside || strstr(line, "typedef struct gkd_desc");
        if (strstr(line, "} gkd_desc;"))
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
    assert_int_equal(d.split, GKD_SPLIT_SIGNATURE);
    assert_int_equal(d.alpha_mode, GKD_ALPHA_GRID);
    assert_int_not_equal(d.simd, GKD_SIMD_AUTO);
    assert_true(d.allocate && d.release);
}

static void test_bad_descriptors_are_refused_by_name(void **state)
{
    (void)state;
    gkd_desc d = unit_cube(), r;
    gkd_field *field = (gkd_field *)&d;
    d.bounds_min[1] = 2;
    assert_int_equal(gkd_create(&d, &field), GKD_BAD_BOUNDS);
    assert_null(field);
#define REFUSED(change, code)                                                                                          \
    do {                                                                                                               \
        d = unit_cube();                                                                                               \
        change;                                                                                                        \
        assert_int_equal(gkd_resolve(&d, &r), code);                                                                   \
    } while (0)
    REFUSED(d.bounds_max[1] = NAN, GKD_BAD_BOUNDS);
    REFUSED(d.bounds_max[2] = INFINITY, GKD_BAD_BOUNDS);
    REFUSED(d.bounds_min[0] = -INFINITY, GKD_BAD_BOUNDS);
    REFUSED(d.split = (gkd_split)17, GKD_BAD_OPTION);
    REFUSED(d.alpha_mode = (gkd_alpha_mode)17, GKD_BAD_OPTION);
    REFUSED(d.simd = (gkd_simd)17, GKD_BAD_OPTION);
    REFUSED(d.split_samples = 63, GKD_BAD_RANGE);
    REFUSED(d.lookahead = 8, GKD_BAD_RANGE);
    REFUSED(d.min_samples = 15, GKD_BAD_RANGE);
    REFUSED(d.radiance_step = NAN, GKD_BAD_RANGE);
    REFUSED(d.radiance_step = -1, GKD_BAD_RANGE);
    REFUSED(d.direction_step = 3.2f, GKD_BAD_RANGE);
    REFUSED(d.confidence = 0.5f, GKD_BAD_RANGE);
    REFUSED(d.keep_signatures = 1.5f, GKD_BAD_RANGE);
    REFUSED(d.keep_signatures = NAN, GKD_BAD_RANGE);
    REFUSED(d.max_levels = 61, GKD_BAD_RANGE);
    REFUSED(d.max_lobes = 33, GKD_BAD_RANGE);
    REFUSED(d.update_samples = 1023, GKD_BAD_RANGE);
    REFUSED(d.max_bytes = 1000, GKD_BAD_RANGE);
    REFUSED(d.alpha = 1.5f, GKD_BAD_RANGE);
    REFUSED(d.uniform = 2, GKD_BAD_RANGE);
    REFUSED(d.gate_margin = 11, GKD_BAD_RANGE);
    REFUSED(d.gate_gain = -1, GKD_BAD_RANGE);
    REFUSED(d.gate_probe = 1001, GKD_BAD_RANGE);
    REFUSED(d.allocate = count_allocate, GKD_BAD_ALLOCATOR);
    REFUSED(d.release = count_release, GKD_BAD_ALLOCATOR);
    REFUSED(memset(&d, 0, sizeof d), GKD_OK); /* a point is a box */
#undef REFUSED
    for (int i = 0; i <= GKD_RESULT_COUNT; ++i)
        assert_true(strlen(gkd_result_string((gkd_result)i)) > 1);
    assert_non_null(strstr(gkd_result_string(GKD_BAD_BOUNDS), "bounds_min"));
}

static void test_documented_limits_are_accepted(void **state)
{
    (void)state;
    gkd_desc d, r;
    gkd_field *f, *g;
    size_t size;
#define ACCEPTED(name, low, high)                                                                                      \
    do {                                                                                                               \
        for (int i = 0; i < 2; ++i) {                                                                                  \
            d = unit_cube();                                                                                           \
            d.name = i ? high : low;                                                                                   \
            OK(gkd_resolve(&d, &r));                                                                                   \
            assert_true(r.name == d.name);                                                                             \
        }                                                                                                              \
    } while (0)
    ACCEPTED(split_samples, 64, 1000000000);
    ACCEPTED(lookahead, 1, 7);
    ACCEPTED(min_samples, 16, 1000000000);
    ACCEPTED(radiance_step, 0.001f, 100);
    ACCEPTED(direction_step, 0.001f, 3.1f);
    ACCEPTED(confidence, 1e-12f, 0.4f);
    ACCEPTED(max_levels, 1, 60);
    ACCEPTED(max_lobes, 1, 32);
    ACCEPTED(update_samples, 1024, 1 << 26);
    ACCEPTED(alpha, 0.05f, 1);
    ACCEPTED(uniform, 1e-4f, 1);
    ACCEPTED(gate_margin, 0.001f, 10);
    ACCEPTED(gate_gain, 0.0001f, 1000);
    ACCEPTED(gate_probe, 1, 1000);
#undef ACCEPTED
    d = unit_cube();
    d.uniform = 1e-4f; /* and in a save */
    OK(gkd_create(&d, &f));
    void *data = save(f, &size);
    OK(gkd_load(NULL, data, size, &g));
    free(data);
    gkd_destroy(f);
    gkd_destroy(g);
}

static void test_sizes_are_as_documented(void **state)
{
    (void)state;
    assert_int_equal(sizeof(gkd_training_sample), 48);
    assert_true(sizeof(gkd_signature) <= 96);
    assert_int_equal(sizeof(gkd_lobe), 24);
    assert_int_equal(sizeof(gkd_cell), 32);
    assert_int_equal(sizeof(gkd_node), 8);
    assert_int_equal(sizeof(gkd_lobe_block), 224);
    assert_int_equal(offsetof(gkd_handle, block), 64);
    assert_int_equal(sizeof(gkd_stats) % 8, 0);
}

/* ---- densities */

static void test_an_untrained_field_is_uniform(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    gkd_field *f;
    seed(1);
    OK(gkd_create(&d, &f));
    assert_int_equal(gkd_cell_count(f), 1);
    gkd_view v = gkd_get_view(f);
    for (int i = 0; i < 1000; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, w[3], u[2] = {rndf(), rndf()};
        gkd_handle h;
        gkd_find(&v, p, NULL, NULL, &h);
        random_direction(w);
        assert_true(fabs((double)gkd_pdf(&h, w) / UNIFORM - 1) < 1e-5);
        assert_true(fabs((double)gkd_sample(&h, u, w) / UNIFORM - 1) < 1e-5);
    }
    /* refining nothing, and zeros only, changes nothing */
    OK(gkd_refine(f, NULL, NULL, NULL));
    float p[3] = {0.5f, 0.5f, 0.5f}, w[3] = {0, 0, 1};
    gkd_training_sample s = gkd_make_scalar_sample(p, w, NULL, 1, 0, 0, 0, 1, 1, 0);
    for (int i = 0; i < 100; ++i)
        learn(f, &s, 1);
    s.radiance = GKD_REJECTED;
    learn(f, &s, 1);
    OK(gkd_refine(f, NULL, NULL, NULL));
    OK(gkd_validate(f));
    gkd_stats stats;
    gkd_get_stats(f, &stats);
    assert_int_equal(stats.samples, 101);
    assert_int_equal(stats.zeros, 101);
    assert_int_equal(stats.rejected, 1);
    v = gkd_get_view(f);
    gkd_handle h;
    gkd_find(&v, p, NULL, NULL, &h);
    assert_true(fabs((double)gkd_pdf(&h, w) / UNIFORM - 1) < 1e-5);
    gkd_destroy(f);
}

/* Bins of equal area, each integrated by many points; samples of the handle must fill them as its density says. */
static void check_samples(const gkd_handle *h, int samples)
{
    enum { Y = 16, X = 32, FINE = 24 };
    static double expected[Y * X];
    static long seen[Y * X];
    double total = 0, chi2 = 0, rest = 0, rest_seen = 0;
    int df = -1;
    memset(expected, 0, sizeof expected);
    memset(seen, 0, sizeof seen);
    for (int y = 0; y < Y * FINE; ++y)
        for (int x = 0; x < X * FINE; ++x) {
            double z = (y + 0.5) * 2 / (Y * FINE) - 1, phi = 2 * PI * (x + 0.5) / (X * FINE), r = sqrt(1 - z * z);
            float w[3] = {(float)(r * cos(phi)), (float)(r * sin(phi)), (float)z};
            double p = (double)gkd_pdf(h, w) * 4 * PI / (Y * FINE * X * FINE);
            expected[y / FINE * X + x / FINE] += p;
            total += p;
        }
    assert_true(fabs(total - 1) < 5e-3);
    for (int i = 0; i < samples; ++i) {
        float u[2] = {rndf(), rndf()}, w[3];
        float pdf = gkd_sample(h, u, w);
        assert_true(pdf > 0 && fabsf(pdf - gkd_pdf(h, w)) <= 1e-6f * pdf);
        double phi = atan2((double)w[1], (double)w[0]);
        int x = (int)((phi < 0 ? phi + 2 * PI : phi) / (2 * PI) * X), y = (int)(((double)w[2] + 1) / 2 * Y);
        seen[(y < Y ? y : Y - 1) * X + (x < X ? x : X - 1)]++;
    }
    for (int i = 0; i < Y * X; ++i) {
        double e = expected[i] / total * samples;
        if (e < 20) {
            rest += e;
            rest_seen += (double)seen[i];
            continue;
        }
        chi2 += ((double)seen[i] - e) * ((double)seen[i] - e) / e;
        df++;
    }
    if (rest > 5) {
        chi2 += (rest_seen - rest) * (rest_seen - rest) / rest;
        df++;
    }
    /* the quadrature's own error, up to a percent in the sharpest bins, is allowed for by few samples */
    assert_true(chi_square_deviate(chi2, df) < 5);
}

static void test_density_of_a_trained_field_integrates_to_one_and_is_sampled(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    d.update_samples = 16384;
    seed(2);
    gkd_field *f = train(&d, 4, 16384);
    gkd_view v = gkd_get_view(f);
    for (int i = 0; i < 12; ++i) {
        float p[3] = {rndf(), rndf(), 0.6f * rndf()}, n[3];
        gkd_handle h;
        random_direction(n);
        gkd_find(&v, p, i & 1 ? n : NULL, NULL, &h);
        assert_true(h.count > 1 || (i & 1));
        assert_true(fabs(integral(&h) - 1) < 2e-3);
        check_samples(&h, 30000);
    }
    gkd_destroy(f);
}

/* At each level single queries and batches say the same as single ones of the scalar level. */
static void test_batches_equal_single_queries_at_every_level(void **state)
{
    (void)state;
    enum { N = 257 };
    static gkd_handle one[N], many[N];
    gkd_handle single;
    static float p[N][3], n[N][3], u[N][2], w[N][3], x[N][3], pdf[N], alpha[N], w1[N][3], pdf1[N];
    gkd_simd levels[5];
    uint32_t level_count = levels_here(levels);
    gkd_desc d = unit_cube();
    d.update_samples = 8192;
    seed(3);
    gkd_field *f = train(&d, 4, 8192);
    for (uint32_t l = 0; l < level_count; ++l)
        for (int surface = 0; surface < 2; ++surface) {
            gkd_view v = gkd_get_view(f), scalar = v;
            v.simd = levels[l];
            scalar.simd = GKD_SIMD_SCALAR;
            for (int i = 0; i < N; ++i) {
                for (int k = 0; k < 3; ++k)
                    p[i][k] = rndf();
                random_direction(n[i]);
                random_direction(x[i]);
                u[i][0] = rndf();
                u[i][1] = rndf();
                gkd_find(&scalar, p[i], surface ? n[i] : NULL, NULL, &one[i]);
                pdf1[i] = gkd_sample(&one[i], u[i], w1[i]);
            }
            gkd_find_batch(&v, N, NULL, p[0], sizeof p[0], surface ? n[0] : NULL, sizeof n[0], NULL, 0, many, alpha);
            gkd_sample_batch(&v, N, NULL, one, u[0], sizeof u[0], w[0], sizeof w[0], pdf);
            for (int i = 0; i < N; ++i) {
                assert_int_equal(many[i].cell, one[i].cell);
                assert_int_equal(many[i].count, one[i].count);
                assert_true(alpha[i] == one[i].alpha && many[i].reflected == one[i].reflected);
                float a = gkd_pdf(&one[i], x[i]), b = gkd_pdf(&many[i], x[i]);
                assert_true(fabsf(a - b) <= 1e-4f * a);
                assert_true(fabs(dot(w[i], w1[i]) - 1) < 1e-5);
                assert_true(fabsf(pdf[i] - gkd_pdf(&one[i], w[i])) <= 3e-5f * pdf[i]);
                gkd_find(&v, p[i], surface ? n[i] : NULL, NULL, &single);
                assert_int_equal(single.simd, levels[l]);
                assert_int_equal(single.cell, one[i].cell);
                pdf1[i] = gkd_sample(&single, u[i], w1[i]);
                assert_true(fabs(dot(w[i], w1[i]) - 1) < 1e-5);
                assert_true(fabsf(pdf1[i] - gkd_pdf(&one[i], w1[i])) <= 1e-4f * pdf1[i]);
                assert_true(fabsf(gkd_pdf(&single, x[i]) - a) <= 1e-4f * a);
            }
            gkd_pdf_batch(&v, N, NULL, one, x[0], sizeof x[0], pdf);
            for (int i = 0; i < N; ++i)
                assert_true(fabsf(pdf[i] - gkd_pdf(&one[i], x[i])) <= 3e-5f * pdf[i]);
            gkd_pdf_directions(&v, &one[5], N, x[0], sizeof x[0], pdf);
            for (int i = 0; i < N; ++i)
                assert_true(fabsf(pdf[i] - gkd_pdf(&one[5], x[i])) <= 3e-5f * pdf[i]);
        }
    gkd_destroy(f);
}

/* ---- learning */

/* One cell that saw a lamp from everywhere in the box knows where it is from any of its positions. */
static void test_the_lamp_is_found_from_everywhere_in_a_cell(void **state)
{
    (void)state;
    enum { N = 60000 };
    gkd_desc d = unit_cube();
    gkd_training_sample *s = malloc(N * sizeof *s);
    gkd_field *f;
    d.max_levels = 1;
    d.bounds_max[2] = 0.4f;
    d.no_gate = true;
    seed(4);
    OK(gkd_create(&d, &f));
    for (int pass = 0; pass < 4; ++pass) {
        gkd_view v = gkd_get_view(f);
        for (int i = 0; i < N; ++i) {
            float p[3] = {rndf(), rndf(), 0.4f * rndf()}, w[3], u[2] = {rndf(), rndf()}, distance;
            gkd_handle h;
            gkd_find(&v, p, NULL, NULL, &h);
            float pdf = gkd_sample(&h, u, w), L = scene(p, w, &distance);
            L = L > 100 ? L : 0;
            s[i] = gkd_make_scalar_sample(p, w, NULL, distance, L, L, L, pdf, (float)UNIFORM, pdf);
        }
        learn(f, s, N);
        OK(gkd_refine(f, NULL, NULL, NULL));
    }
    assert_true(gkd_cell_count(f) <= 2);
    gkd_view v = gkd_get_view(f);
    for (int i = 0; i < 64; ++i) { /* corners of the box included */
        float p[3] = {(float)(i & 3) / 3, (float)(i >> 2 & 3) / 3, 0.4f * (float)(i >> 4 & 3) / 3}, to[3], away[3];
        double l = 0;
        gkd_handle h;
        for (int k = 0; k < 3; ++k) {
            to[k] = lamp[k] - p[k];
            l += (double)to[k] * (double)to[k];
        }
        for (int k = 0; k < 3; ++k) {
            to[k] /= (float)sqrt(l);
            away[k] = -to[k];
        }
        gkd_find(&v, p, NULL, NULL, &h);
        assert_true((double)gkd_pdf(&h, to) > 10 * UNIFORM);
        assert_true((double)gkd_pdf(&h, away) < 0.2 * UNIFORM);
        const gkd_lobe_block *b = &h.block[0]; /* the heaviest lobe points there */
        uint32_t best = 0;
        float most = 0, upper = 0;
        for (uint32_t k = 0; k < h.count; ++k) {
            float now = h.block[k / 8].upper[k % 8];
            if (now - upper > most) {
                most = now - upper;
                best = k;
            }
            upper = now;
        }
        b = &h.block[best / 8];
        float mean[3] = {b->x[best % 8], b->y[best % 8], b->z[best % 8]};
        assert_true(dot(mean, to) > cos(0.2));
    }
    free(s);
    gkd_destroy(f);
}

static void test_bad_samples_are_refused_and_leave_no_trace(void **state)
{
    (void)state;
    enum { N = 30000 };
    static gkd_training_sample clean[N], dirty[N + N / 100];
    const float bad[] = {NAN, INFINITY, -INFINITY, -1, 1e30f, 3e38f};
    gkd_desc d = unit_cube();
    gkd_field *a, *b;
    uint32_t total = 0;
    OK(gkd_create(&d, &a));
    OK(gkd_create(&d, &b));
    for (int pass = 0; pass < 3; ++pass) {
        gkd_view v = gkd_get_view(a);
        uint32_t m = 0;
        seed((uint64_t)pass + 9);
        make_samples(&v, clean, N);
        for (int i = 0; i < N; ++i) {
            dirty[m++] = clean[i];
            if (i % 100)
                continue;
            gkd_training_sample s = clean[(i + 77) % N];
            float x = bad[(i / 100) % 6], dir[3] = {0, 0, 1};
            switch ((i / 100) % 12) {
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
                s = gkd_make_scalar_sample(s.position, dir, NULL, 1, 1, 1, 1, 1, 1, 0);
                break;
            case 7:
                memset(dir, 0, sizeof dir);
                s = gkd_make_scalar_sample(s.position, dir, NULL, 1, 1, 1, 1, 1, 1, 0);
                break;
            case 8:
                s.position[i / 100 % 3] = isfinite(x) ? NAN : x;
                break;
            case 9:
                s = gkd_make_scalar_sample(s.position, dir, dir, i / 200 & 1 ? 0 : -1, 1, 1, 1, 1, 1, 0);
                break;
            case 10:
                s = gkd_make_scalar_sample(s.position, dir, NULL, NAN, 1, 1, 1, 1, 1, 0);
                break;
            default:
                s.nearness = x < 1e30f ? x : NAN;
                s.nearness = s.nearness > 0 ? -s.nearness : s.nearness;
                break;
            }
            dirty[m++] = s;
        }
        total += m - N;
        learn(a, clean, N);
        learn(b, dirty, m);
        OK(gkd_refine(a, NULL, NULL, NULL));
        OK(gkd_refine(b, NULL, NULL, NULL));
    }
    gkd_stats sa, sb;
    gkd_get_stats(a, &sa);
    gkd_get_stats(b, &sb);
    assert_int_equal(sa.refused, 0);
    assert_int_equal(sb.refused, total);
    b->stats.refused = 0;
    b->stats.bytes = a->stats.bytes;
    assert_true(same_fields(a, b));
    gkd_destroy(a);
    gkd_destroy(b);
}

/* A sample that nearly overflows is not refused, and does no harm that validate or a query would see. */
static void test_enormous_quotients_do_no_harm(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    gkd_field *f;
    seed(30);
    OK(gkd_create(&d, &f));
    for (int pass = 0; pass < 3; ++pass) {
        static gkd_training_sample s[5000];
        make_samples(NULL, s, 5000);
        for (int i = 0; i < 5000; i += 100) {
            s[i].radiance = s[i].contribution = s[i].pixel_contribution = i % 200 ? 9e29f : 1e-30f;
            s[i].pdf_mix = i % 200 ? 1e-30f : 1e30f;
            s[i].nearness = i % 200 ? 3e38f : 1e-38f;
        }
        learn(f, s, 5000);
        OK(gkd_refine(f, NULL, NULL, NULL));
        check_numbers(f);
    }
    gkd_destroy(f);
}

static void test_positions_outside_are_clamped_and_counted(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    gkd_field *f;
    float out[3] = {2, 0.5f, -3e30f}, dir[3] = {0, 0, 2};
    OK(gkd_create(&d, &f));
    gkd_training_sample s = gkd_make_scalar_sample(out, dir, NULL, 1, 1, 1, 1, 1, 1, 0);
    learn(f, &s, 1);
    OK(gkd_refine(f, NULL, NULL, NULL));
    gkd_stats stats;
    gkd_get_stats(f, &stats);
    assert_int_equal(stats.clamped, 1);
    assert_int_equal(stats.refused, 0);
    assert_int_equal(stats.samples, 1);
    gkd_view v = gkd_get_view(f);
    assert_true(v.cells[0].pivot[0] == 1 && v.cells[0].pivot[1] == 0.5f && v.cells[0].pivot[2] == 0);
    gkd_destroy(f);
}

/* Boxes and samples that leave something out: flat, one point, one direction, far from the origin, huge contrast. */
static void test_degenerate_input_stays_finite(void **state)
{
    (void)state;
    enum { N = 20000 };
    static gkd_training_sample s[N];
    for (int kind = 0; kind < 7; ++kind)
        for (int split = GKD_SPLIT_SIGNATURE; split <= GKD_SPLIT_COUNT; ++split) {
            gkd_desc d = unit_cube();
            gkd_field *f;
            d.split = (gkd_split)split;
            d.split_samples = 500;
            d.min_samples = 100;
            d.update_samples = 4096;
            if (kind == 0)
                d.bounds_max[1] = 0;
            if (kind == 1)
                memset(d.bounds_max, 0, sizeof d.bounds_max);
            for (int k = 0; kind == 4 && k < 3; ++k) {
                d.bounds_min[k] = 1e6f;
                d.bounds_max[k] = 1e6f + 1;
            }
            for (int k = 0; kind == 6 && k < 3; ++k) {
                d.bounds_min[k] = -4e29f;
                d.bounds_max[k] = 4e29f;
            }
            seed((uint64_t)kind);
            OK(gkd_create(&d, &f));
            for (int pass = 0; pass < 3; ++pass) {
                for (int i = 0; i < N; ++i) {
                    float p[3], w[3] = {0, 0, 1}, L = 1, distance = kind == 3 ? INFINITY : 0.5f + rndf();
                    for (int k = 0; k < 3; ++k)
                        p[k] = d.bounds_min[k] + rndf() * (d.bounds_max[k] - d.bounds_min[k]);
                    if (kind == 2)
                        p[0] = p[1] = p[2] = 0.3f;
                    if (kind != 3)
                        random_direction(w);
                    if (kind == 5)
                        L = i % 1000 ? 1e-10f : 1e20f;
                    else
                        L = w[0] > 0.5f || p[0] > 0.5f ? 1 : 0.1f;
                    s[i] = gkd_make_scalar_sample(p, w, NULL, distance, L, L, L, (float)UNIFORM, (float)UNIFORM, 0);
                }
                learn(f, s, N);
                OK(gkd_refine(f, NULL, NULL, NULL));
                check_numbers(f);
            }
            if (kind == 1 || kind == 2)
                assert_int_equal(gkd_cell_count(f), 1);
            if (kind == 3) {
                gkd_view v = gkd_get_view(f);
                float p[3] = {0.1f, 0.1f, 0.1f}, up[3] = {0, 0, 1};
                gkd_handle h;
                gkd_find(&v, p, NULL, NULL, &h);
                assert_true((double)gkd_pdf(&h, up) > 100 * UNIFORM);
            }
            gkd_destroy(f);
        }
}

/* ---- the same bits */

static void test_results_do_not_depend_on_threads_or_cuts(void **state)
{
    (void)state;
    enum { N = 40000 };
    gkd_training_sample *s = malloc(N * sizeof *s);
    for (int variant = 0; variant < 3; ++variant) {
        gkd_field *fields[5];
        gkd_desc d = unit_cube();
        d.split = variant == 1 ? GKD_SPLIT_COUNT : GKD_SPLIT_SIGNATURE;
        d.split_samples = 500;
        d.min_samples = 200;
        d.update_samples = variant == 2 ? 5000 : 1u << 16;
        d.keep_signatures = variant == 2 ? 0.5f : 0;
        for (int k = 0; k < 5; ++k)
            OK(gkd_create(&d, &fields[k]));
        for (int pass = 0; pass < 3; ++pass) {
            seed((uint64_t)pass);
            gkd_view v = gkd_get_view(fields[0]);
            make_samples(&v, s, N);
            for (int k = 0; k < 5; ++k) { /* 1, 2, 3, 4, 7 threads; k + 1 streams; k + 1 calls */
                crowd team = {k == 4 ? 7 : k + 1, 1};
                gkd_stream *streams[5];
                uint32_t at = 0;
                for (int i = 0; i <= k; ++i)
                    OK(gkd_stream_create(fields[k], &streams[i]));
                for (int call = 0; call <= k; ++call) {
                    for (int i = 0; i <= k; ++i) {
                        uint32_t end = (uint32_t)((uint64_t)N * (uint64_t)(call * (k + 1) + i + 1) /
                                                  (uint64_t)((k + 1) * (k + 1)));
                        gkd_stream_clear(streams[i]);
                        OK(gkd_record(streams[i], s + at, end - at));
                        assert_int_equal(gkd_stream_size(streams[i]), end - at);
                        at = end;
                    }
                    OK(gkd_accumulate(fields[k], streams, (uint32_t)k + 1, k ? crowd_for : NULL, &team));
                }
                assert_int_equal(at, N);
                for (int i = 0; i <= k; ++i)
                    gkd_stream_destroy(streams[i]);
                OK(gkd_refine(fields[k], NULL, k ? crowd_for : NULL, &team));
            }
            for (int k = 1; k < 5; ++k)
                assert_true(same_fields(fields[0], fields[k]));
        }
        assert_true(gkd_cell_count(fields[0]) > 8);
        for (int k = 0; k < 5; ++k)
            gkd_destroy(fields[k]);
    }
    free(s);
}

/* A lopsided tree, positions on its planes, far outside, or no numbers: groups of any size find the cells that single
   queries find. */
static void test_cells_are_found_alike_at_every_level(void **state)
{
    (void)state;
    enum { LEVELS = 40, GROUP = 16 };
    static gkd_node nodes[2 * LEVELS + 1];
    float p[GROUP][3];
    const float *positions[GROUP];
    gkd_simd levels[5];
    uint32_t n = levels_here(levels), cells[GROUP];
    gkd_view v;
    memset(&v, 0, sizeof v);
    v.nodes = nodes;
    seed(50);
    for (uint32_t i = 0, at = 0; i < LEVELS; ++i) { /* one child is a leaf, the other goes on */
        uint32_t pair = 2 * i + 1, side = (uint32_t)(rndf() * 2);
        nodes[at].link = (uint32_t)(rndf() * 3) << 29 | pair;
        nodes[at].split = rndf();
        nodes[pair].link = GKD_LEAF | (2 * i);
        nodes[pair + 1].link = GKD_LEAF | (2 * i + 1);
        at = pair + side;
    }
    for (int round = 0; round < 2000; ++round) {
        uint32_t count = 1 + (uint32_t)(rndf() * GROUP);
        for (uint32_t i = 0; i < count; ++i) {
            static const float odd[3] = {NAN, INFINITY, -1e30f};
            for (int k = 0; k < 3; ++k)
                p[i][k] = rndf() < 0.1f   ? odd[(int)(rndf() * 3)]
                          : rndf() < 0.5f ? rndf()
                                          : nodes[(int)(rndf() * 2 * LEVELS)].split;
            positions[i] = p[i];
        }
        for (uint32_t l = 0; l < n; ++l) {
            gkdi_find_cells((uint32_t)levels[l], nodes, count, positions, cells);
            for (uint32_t i = 0; i < count; ++i)
                assert_int_equal(cells[i], gkd_find_cell(&v, p[i]));
        }
    }
}

static void test_training_is_the_same_at_every_level(void **state)
{
    (void)state;
    enum { N = 30000 };
    static gkd_training_sample s[N];
    gkd_simd levels[5];
    uint32_t n = levels_here(levels);
    gkd_field *f[5];
    for (uint32_t l = 0; l < n; ++l) {
        gkd_desc d = unit_cube();
        d.min_samples = 300;
        d.simd = levels[l];
        OK(gkd_create(&d, &f[l]));
    }
    for (int pass = 0; pass < 3; ++pass) {
        gkd_view v = gkd_get_view(f[0]);
        seed((uint64_t)pass + 40);
        make_samples(&v, s, N);
        for (uint32_t l = 0; l < n; ++l) {
            learn(f[l], s, N);
            OK(gkd_refine(f[l], NULL, NULL, NULL));
            assert_true(same_fields(f[0], f[l]));
        }
    }
    assert_true(gkd_cell_count(f[0]) > 1);
    for (uint32_t l = 0; l < n; ++l)
        gkd_destroy(f[l]);
}

/* ---- splits */

/* n samples at uniform positions of radiance 1 in all directions; `edge`: ten times that where x > 0.3. */
static void plain_samples(gkd_training_sample *s, uint32_t n, bool edge)
{
    for (uint32_t i = 0; i < n; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, w[3], L;
        random_direction(w);
        L = edge && p[0] > 0.3f ? 10 : 1;
        s[i] = gkd_make_scalar_sample(p, w, NULL, INFINITY, L, L, L, (float)UNIFORM, (float)UNIFORM, 0);
    }
}

/* A cell with more than split_samples non-zero samples splits; each half starts with half of them. So all 2^k cells of
   a level split together: after n samples in one update there are 2^k of them, n / 2^k at most split_samples. */
static void test_count_rule_splits_at_the_documented_number(void **state)
{
    (void)state;
    enum { N = 40000 };
    static gkd_training_sample s[N];
    const struct {
        uint32_t samples, least, most;
    } cases[] = {{4000, 1, 1}, {4001, 2, 2}, {7000, 2, 2}, {14000, 4, 4}, {28000, 8, 8}, {40000, 16, 16}};
    seed(50);
    plain_samples(s, N, false);
    for (unsigned i = 0; i < sizeof cases / sizeof *cases; ++i) {
        gkd_desc d = unit_cube();
        gkd_field *f;
        d.split = GKD_SPLIT_COUNT;
        OK(gkd_create(&d, &f));
        learn(f, s, cases[i].samples);
        OK(gkd_refine(f, NULL, NULL, NULL));
        OK(gkd_validate(f));
        assert_in_range(gkd_cell_count(f), cases[i].least, cases[i].most);
        gkd_destroy(f);
    }
    /* zeros do not count */
    gkd_desc d = unit_cube();
    gkd_field *f;
    d.split = GKD_SPLIT_COUNT;
    for (int i = 0; i < N; ++i)
        s[i].radiance = i % 20 ? 0 : 1;
    OK(gkd_create(&d, &f));
    learn(f, s, N);
    OK(gkd_refine(f, NULL, NULL, NULL));
    assert_int_equal(gkd_cell_count(f), 1);
    gkd_destroy(f);
}

static void test_signature_rule_splits_at_an_edge_of_light_only(void **state)
{
    (void)state;
    enum { N = 60000 };
    static gkd_training_sample s[N];
    for (int edge = 0; edge < 2; ++edge) {
        gkd_desc d = unit_cube();
        gkd_field *f;
        seed(51);
        OK(gkd_create(&d, &f));
        for (int pass = 0; pass < 4; ++pass) {
            plain_samples(s, N, edge);
            learn(f, s, N);
            OK(gkd_refine(f, NULL, NULL, NULL));
        }
        OK(gkd_validate(f));
        gkd_stats stats;
        gkd_get_stats(f, &stats);
        if (!edge) {
            assert_int_equal(stats.cells, 1);
        } else {
            gkd_view v = gkd_get_view(f);
            double near = 0, far = 0;
            uint32_t n_near = 0, n_far = 0;
            assert_true(stats.cells > 1 && stats.radiance_splits > 0);
            for (int i = 0; i < 4000; ++i) { /* cells at the edge are smaller along x */
                float p[3] = {rndf(), rndf(), rndf()}, low[3], high[3];
                gkd_find_box(&v, p, low, high);
                assert_int_equal(gkd_find_box(&v, p, low, high), gkd_find_cell(&v, p));
                if (low[0] < 0.3f && high[0] > 0.3f) {
                    near += (double)(high[0] - low[0]);
                    n_near++;
                } else {
                    far += (double)(high[0] - low[0]);
                    n_far++;
                }
            }
            assert_true(n_far > 1000);
            assert_true(n_near == 0 || near / n_near < 0.6 * (far / n_far));
        }
        gkd_destroy(f);
    }
}

/* With keep_signatures a half goes on with what its lookahead cell saw, which tells where its samples lie: all of them,
   also those that came after that cell was divided, and lay elsewhere. What came before it was made it does not know.
 */
static void test_kept_signatures_know_where_their_samples_lie(void **state)
{
    (void)state;
    enum { N = 30000, PASSES = 3 };
    static gkd_training_sample s[PASSES * N];
    gkd_desc d = unit_cube();
    gkd_field *f;
    d.keep_signatures = 0.5f;
    seed(53);
    OK(gkd_create(&d, &f));
    for (int pass = 0; pass < PASSES; ++pass) {
        plain_samples(s + pass * N, N, pass == 2);
        for (int i = pass * N; i < pass * N + N; ++i)
            s[i].position[1] = 0.2f * s[i].position[1] + 0.4f * (float)pass;
        assert_int_equal(gkd_cell_count(f), 1);
        learn(f, s + pass * N, N);
        OK(gkd_refine(f, NULL, NULL, NULL));
    }
    OK(gkd_validate(f));
    gkd_view v = gkd_get_view(f);
    assert_in_range(v.cell_count, 2, 1000);
    double *sum = test_calloc(v.cell_count, 4 * sizeof *sum);
    for (int i = 0; i < PASSES * N; ++i) {
        double *c = sum + 4 * gkd_find_cell(&v, s[i].position);
        for (int k = 0; k < 3; ++k)
            c[k] += (double)s[i].position[k];
        c[3]++;
    }
    for (uint32_t i = 0; i < v.cell_count; ++i)
        for (int k = 0; k < 3 && sum[4 * i + 3] > 0; ++k)
            assert_true(fabs((double)v.cells[i].pivot[k] - sum[4 * i + (uint32_t)k] / sum[4 * i + 3]) < 0.05);
    test_free(sum);
    gkd_destroy(f);
}

/* n samples of light from a cap around +z, half of it 0.5 and half 1.5 bright; none in the corner where all coordinates
   are below `shadow`. */
static void cap_samples(gkd_training_sample *s, uint32_t n, float shadow)
{
    for (uint32_t i = 0; i < n; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, z = 1 - 0.2f * rndf(), a = (float)(2 * PI) * rndf(), L;
        float w[3] = {sqrtf(1 - z * z) * cosf(a), sqrtf(1 - z * z) * sinf(a), z};
        L = p[0] < shadow && p[1] < shadow && p[2] < shadow ? 0.0f : rnd() < 0.5 ? 0.5f : 1.5f;
        s[i] = gkd_make_scalar_sample(p, w, NULL, INFINITY, L, L, L, (float)UNIFORM, (float)UNIFORM, 0);
    }
}

/* Passes without and then with a shadow. */
static gkd_field *look_at_caps(bool no_prune, int bright, int passes, gkd_stats *before)
{
    enum { N = 100000 };
    static gkd_training_sample s[N];
    gkd_desc d = unit_cube();
    gkd_field *f;
    d.no_mixtures = true;
    d.no_prune = no_prune;
    seed(54);
    OK(gkd_create(&d, &f));
    for (int pass = 0; pass < passes; ++pass) {
        if (pass == bright)
            gkd_get_stats(f, before);
        cap_samples(s, N, pass < bright ? 0 : 0.25f);
        learn(f, s, N);
        OK(gkd_refine(f, NULL, NULL, NULL));
        OK(gkd_validate(f));
    }
    return f;
}

/* Light that is the same everywhere: the lookahead cells go, and nothing splits. A shadow of a sixty-fourth of the cell
   is found whether it was there from the start or comes later. */
static void test_lookahead_cells_go_where_light_is_even_and_come_back(void **state)
{
    (void)state;
    gkd_stats even, kept, s;
    gkd_field *f = look_at_caps(false, 12, 30, &even), *g = look_at_caps(true, 12, 30, &kept);
    assert_int_equal(even.cells, 1);
    assert_int_equal(kept.cells, 1);
    assert_int_equal(kept.lookahead, 126);
    assert_int_equal(kept.alike, 0);
    assert_in_range(even.lookahead, 2, 60);
    assert_true(even.alike > 60 && even.bytes + 40 * sizeof(gkd_signature) < kept.bytes);
    gkd_get_stats(f, &s);
    assert_in_range(s.cells, 2, 1000);
    gkd_destroy(f);
    gkd_destroy(g);
    f = look_at_caps(false, 0, 4, &even);
    g = look_at_caps(true, 0, 4, &kept);
    assert_in_range(gkd_cell_count(g), 2, 1000);
    assert_true(gkd_structure_id(f) == gkd_structure_id(g));
    gkd_destroy(f);
    gkd_destroy(g);
}

/* Passes of samples from a lamp that, from pass `moved` on, hangs on the other side; one cell. */
static gkd_field *watch_lamp(bool no_rest, int passes, int moved, gkd_stats *stats)
{
    enum { N = 4000 };
    static gkd_training_sample s[N];
    gkd_desc d = unit_cube();
    gkd_field *f;
    d.no_radiance_test = d.no_direction_test = d.no_gate = true;
    d.no_rest = no_rest;
    seed(55);
    OK(gkd_create(&d, &f));
    for (int pass = 0; pass < passes; ++pass) {
        for (int i = 0; i < N; ++i) {
            float p[3] = {rndf(), rndf(), rndf()}, w[3], side = pass < moved ? 1.0f : -1.0f, L;
            random_direction(w);
            L = side * w[2] > 0.8f ? 10 : 1;
            s[i] = gkd_make_scalar_sample(p, w, NULL, INFINITY, L, L, L, (float)UNIFORM, (float)UNIFORM, 0);
        }
        learn(f, s, N);
        OK(gkd_refine(f, NULL, NULL, NULL));
    }
    OK(gkd_validate(f));
    gkd_get_stats(f, stats);
    return f;
}

/* Mean log density, weighted by the light of the lamp at +z (or -z): what expectation maximisation maximises. */
static double quality(const gkd_field *f, float side)
{
    const float p[3] = {0.5f, 0.5f, 0.5f};
    gkd_view v = gkd_get_view(f);
    gkd_handle h;
    double sum = 0, weight = 0;
    gkd_find(&v, p, NULL, NULL, &h);
    seed(56);
    for (int i = 0; i < 100000; ++i) {
        float w[3];
        random_direction(w);
        double L = side * w[2] > 0.8f ? 10 : 1;
        sum += L * log((double)gkd_pdf(&h, w));
        weight += L;
    }
    return sum / weight;
}

/* A mixture that no longer changes rests, at next to no loss; light that changes later wakes it. */
static void test_converged_mixtures_rest_and_wake(void **state)
{
    (void)state;
    gkd_stats rested, never;
    gkd_field *f = watch_lamp(false, 80, 1000, &rested), *g = watch_lamp(true, 80, 1000, &never);
    assert_int_equal(never.rests, 0);
    assert_int_equal(never.fits, 80);
    assert_int_equal(rested.fits + rested.rests, 80);
    assert_true(rested.rests > 30);
    assert_true(quality(f, 1) > quality(g, 1) - 0.01);
    gkd_destroy(f);
    gkd_destroy(g);
    f = watch_lamp(false, 40, 1000, &rested);
    assert_true(rested.rests > 20 && quality(f, -1) < -3); /* asleep when the lamp moves */
    gkd_destroy(f);
    f = watch_lamp(false, 240, 40, &rested);
    g = watch_lamp(true, 240, 40, &never);
    assert_true(rested.rests > 30);
    assert_true(quality(f, -1) > quality(g, -1) - 0.05);
    gkd_destroy(f);
    gkd_destroy(g);
}

/* ---- split reports */

typedef struct replay {
    uint32_t of_position[4096]; /* cell of each position, as the reports let one know */
    float position[4096][3];
    const gkd_view *after;
    gsd_field *forest;
    uint32_t cells, reports;
    uint32_t parent_of[65536];
} replay;

static void on_split(void *user, uint32_t parent, uint32_t a, uint32_t b)
{
    replay *r = user;
    assert_int_equal(a, parent);
    assert_int_equal(b, r->cells); /* each new cell is the next: an array can be grown by one */
    assert_true(parent < r->cells);
    r->parent_of[b] = parent;
    r->cells++;
    r->reports++;
    assert_int_equal(gsd_forest_split(r->forest, parent, a, b), GSD_OK);
}

/* Ancestor of a cell among the first `cells`. */
static uint32_t ancestor(const replay *r, uint32_t cell, uint32_t cells)
{
    while (cell >= cells)
        cell = r->parent_of[cell];
    return cell;
}

static void test_split_reports_let_another_model_follow(void **state)
{
    (void)state;
    enum { N = 30000, P = 4096 };
    static gkd_training_sample s[N];
    static gsd_training_sample g[N];
    static uint32_t cell[N];
    static replay r;
    gkd_desc d = unit_cube();
    gsd_desc gd;
    gkd_field *f;
    gsd_stream *stream;
    memset(&r, 0, sizeof r);
    memset(&gd, 0, sizeof gd);
    gd.forest_cells = 1;
    assert_int_equal(gsd_create(&gd, &r.forest), GSD_OK);
    assert_int_equal(gsd_stream_create(r.forest, &stream), GSD_OK);
    d.no_mixtures = true;
    d.min_samples = 200;
    d.confidence = 0.1f;
    d.update_samples = 8192; /* several updates, and splits of splits, between two refines */
    seed(60);
    OK(gkd_create(&d, &f));
    r.cells = 1;
    for (int i = 0; i < P; ++i)
        for (int k = 0; k < 3; ++k)
            r.position[i][k] = rndf();
    for (int pass = 0; pass < 4; ++pass) {
        uint32_t before = r.cells;
        gkd_pass facts;
        memset(&facts, 0, sizeof facts);
        facts.on_split = on_split;
        facts.on_split_user = &r;
        gkd_view v = gkd_get_view(f);
        make_samples(NULL, s, N);
        for (int i = 0; i < N; ++i) {
            float w[3];
            cell[i] = gkd_find_cell(&v, s[i].position);
            gkd_unpack_direction(s[i].direction, w);
            g[i] = gsd_make_scalar_sample(s[i].position, w, NULL, INFINITY, s[i].radiance, s[i].contribution,
                                          s[i].contribution, s[i].pdf_mix, s[i].pdf_bsdf, 0);
        }
        assert_int_equal(gsd_record_cells(stream, cell, g, N), GSD_OK);
        assert_int_equal(gsd_accumulate(r.forest, &stream, 1, NULL, NULL), GSD_OK);
        gsd_stream_clear(stream);
        learn(f, s, N);
        OK(gkd_refine(f, &facts, NULL, NULL));
        assert_int_equal(gsd_refine(r.forest, NULL, NULL, NULL), GSD_OK);
        assert_int_equal(r.cells, gkd_cell_count(f));
        assert_int_equal(gsd_cell_count(r.forest), r.cells);
        assert_int_equal(gsd_validate(r.forest), GSD_OK);
        v = gkd_get_view(f);
        for (int i = 0; i < P; ++i) { /* a cell's positions come from the cell that it was made of */
            uint32_t now = gkd_find_cell(&v, r.position[i]);
            assert_true(now < r.cells);
            assert_int_equal(ancestor(&r, now, before), r.of_position[i]);
            r.of_position[i] = now;
        }
    }
    assert_true(r.reports > 10 && r.reports == r.cells - 1);
    gkd_stats stats;
    gkd_get_stats(f, &stats);
    assert_int_equal(stats.lobes, 0);
    gkd_destroy(f);
    gsd_stream_destroy(stream);
    gsd_destroy(r.forest);
}

/* ---- save, load, merge */

static void test_save_and_load_go_on_training_the_same(void **state)
{
    (void)state;
    enum { N = 20000 };
    static gkd_training_sample s[N];
    gkd_desc d = unit_cube();
    gkd_field *f, *g;
    size_t size;
    d.min_samples = 200;
    d.update_samples = 6000;
    seed(70);
    f = train(&d, 3, 8000);
    gkd_view v = gkd_get_view(f);
    make_samples(&v, s, N);
    learn(f, s, N / 3); /* some wait, some splits are not told of yet */
    unsigned char *data = save(f, &size), *odd = malloc(size + 1);
    memcpy(odd + 1, data, size);
    OK(gkd_load(NULL, odd + 1, size, &g));
    OK(gkd_validate(g));
    assert_int_equal(f->stats.samples, g->stats.samples);
    g->stats = f->stats; /* load counts anew what refine counts, and room to grow is not saved */
    assert_true(same_fields(f, g));
    assert_int_equal(gkd_structure_id(f), gkd_structure_id(g));
    learn(f, s + N / 3, N - N / 3);
    learn(g, s + N / 3, N - N / 3);
    OK(gkd_refine(f, NULL, NULL, NULL));
    OK(gkd_refine(g, NULL, NULL, NULL));
    f->stats.bytes = g->stats.bytes = 0; /* what growing left over differs */
    assert_true(same_fields(f, g));
    size_t written;
    assert_int_equal(gkd_save(f, data, 100, &written), GKD_BUFFER_TOO_SMALL);
    assert_true(written > 100);
    free(data);
    free(odd);
    gkd_destroy(f);
    gkd_destroy(g);
}

static unsigned char *small_save(size_t *size)
{
    gkd_desc d = unit_cube();
    gkd_training_sample s[50];
    d.min_samples = 100;
    d.update_samples = 2048;
    d.max_lobes = 6;
    d.lookahead = 2;
    seed(71);
    gkd_field *f = train(&d, 3, 1500);
    make_samples(NULL, s, 50);
    learn(f, s, 50);
    unsigned char *data = save(f, size);
    gkd_destroy(f);
    return data;
}

static void test_truncated_and_flipped_saves_are_refused(void **state)
{
    (void)state;
    size_t size;
    unsigned char *data = small_save(&size);
    gkd_field *g;
    for (size_t n = 0; n < size; n += n < 1000 ? 1 : 331) {
        unsigned char *exact = malloc(n ? n : 1);
        memcpy(exact, data, n);
        assert_int_not_equal(gkd_load(NULL, exact, n, &g), GKD_OK);
        assert_null(g);
        free(exact);
    }
    for (size_t bit = 0; bit < size * 8; bit += bit < 4000 ? 1 : 997) {
        data[bit / 8] ^= (unsigned char)(1u << (bit % 8));
        assert_int_not_equal(gkd_load(NULL, data, size, &g), GKD_OK);
        assert_null(g);
        data[bit / 8] ^= (unsigned char)(1u << (bit % 8));
    }
    data[8] ^= 1;
    assert_int_equal(gkd_load(NULL, data, size, &g), GKD_BAD_VERSION);
    data[8] ^= 1;
    OK(gkd_load(NULL, data, size, &g));
    gkd_destroy(g);
    free(data);
}

/* The same with the checksum made right again: what loads must be whole and usable, everything else is refused. */
static void test_forged_saves_never_harm(void **state)
{
    (void)state;
    size_t size, loaded = 0, refused = 0;
    unsigned char *data = small_save(&size);
    static gkd_training_sample s[300];
    seed(72);
    make_samples(NULL, s, 300);
    for (int i = 0; i < 1500; ++i) {
        gkd_field *g;
        gkdi_header h;
        counter c = {0};
        gkd_desc d;
        unsigned char *forged = malloc(size);
        memcpy(forged, data, size);
        for (int k = 0; k <= i % 3; ++k) {
            size_t range = i & 1 ? size : sizeof h < size ? sizeof h : size;
            size_t at = GKDI_CHECKED_FROM + (size_t)(rnd() * (double)(range - GKDI_CHECKED_FROM));
            forged[at] = i % 5 ? (unsigned char)(forged[at] ^ (1u << (rng_next() & 7))) : (unsigned char)rng_next();
        }
        memcpy(&h, forged, sizeof h);
        h.checksum = gkdi_hash_bytes(1, forged + GKDI_CHECKED_FROM, size - GKDI_CHECKED_FROM);
        memcpy(forged, &h, sizeof h);
        memset(&d, 0, sizeof d);
        count_with(&d, &c);
        gkd_result result = gkd_load(&d, forged, size, &g);
        free(forged);
        if (result) {
            assert_null(g);
            assert_int_equal(c.live, 0);
            refused++;
            continue;
        }
        loaded++;
        OK(gkd_validate(g));
        check_numbers(g);
        learn(g, s, 300);
        OK(gkd_refine(g, NULL, NULL, NULL));
        gkd_destroy(g);
        assert_int_equal(c.live, 0);
    }
    assert_true(loaded > 100 && refused > 100);
    free(data);
}

/* Of what a save counts, shares steer callers: gkd_record_fraction. */
static void test_saves_with_impossible_shares_are_refused(void **state)
{
    (void)state;
    static const float bad[] = {NAN, INFINITY, -1, 1.5f, -INFINITY};
    size_t size;
    unsigned char *data = small_save(&size);
    for (int i = 0; i < 11; ++i) {
        gkdi_header h;
        gkd_field *f;
        memcpy(&h, data, sizeof h);
        gkd_stats keep = h.stats;
        if (i < 10)
            *(i & 1 ? &h.stats.closed_share : &h.stats.mean_alpha) = bad[i / 2];
        memcpy(data, &h, sizeof h);
        h.checksum = gkdi_hash_bytes(1, data + GKDI_CHECKED_FROM, size - GKDI_CHECKED_FROM);
        memcpy(data, &h, sizeof h);
        assert_int_equal(gkd_load(NULL, data, size, &f), i < 10 ? GKD_BAD_FILE : GKD_OK);
        gkd_destroy(f);
        h.stats.levels = 77; /* counted anew */
        h.stats.closed_share = h.stats.mean_alpha = 0;
        memcpy(data, &h, sizeof h);
        h.checksum = gkdi_hash_bytes(1, data + GKDI_CHECKED_FROM, size - GKDI_CHECKED_FROM);
        memcpy(data, &h, sizeof h);
        OK(gkd_load(NULL, data, size, &f));
        assert_int_equal(f->stats.levels, keep.levels);
        gkd_destroy(f);
        h.stats = keep;
        memcpy(data, &h, sizeof h);
    }
    free(data);
}

static void test_merge_equals_training_together(void **state)
{
    (void)state;
    enum { N = 20000 };
    static gkd_training_sample s[N];
    gkd_desc d = unit_cube();
    gkd_field *a, *b, *both, *other;
    size_t size;
    seed(80);
    d.min_samples = 300;
    a = train(&d, 2, 10000);
    void *data = save(a, &size);
    OK(gkd_load(NULL, data, size, &b));
    OK(gkd_load(NULL, data, size, &both));
    gkd_view v = gkd_get_view(a);
    make_samples(&v, s, N);
    learn(a, s, N / 2);
    learn(b, s + N / 2, N / 2);
    learn(both, s, N);
    OK(gkd_merge(a, b, NULL, NULL));
    OK(gkd_refine(a, NULL, NULL, NULL));
    OK(gkd_refine(both, NULL, NULL, NULL));
    OK(gkd_validate(a));
    a->stats.bytes = both->stats.bytes = 0;
    assert_true(same_fields(a, both));
    assert_int_equal(gkd_merge(a, b, NULL, NULL), GKD_MISMATCH);
    OK(gkd_create(&d, &other));
    assert_int_equal(gkd_merge(b, other, NULL, NULL), GKD_MISMATCH);
    OK(gkd_validate(b));
    gkd_destroy(a);
    gkd_destroy(b);
    gkd_destroy(both);
    gkd_destroy(other);
    free(data);
}

/* ---- memory */

/* One scenario with every kind of call; returns how many failed for want of memory. */
static int scenario(counter *c)
{
    enum { N = 3000 };
    gkd_desc d = unit_cube();
    gkd_field *f = NULL, *g;
    gkd_stream *stream = NULL;
    static gkd_training_sample s[N];
    int failed = 0;
    count_with(&d, c);
    d.min_samples = 100;
    d.confidence = 0.3f;
    d.update_samples = 1024;
    d.lookahead = 3;
    d.max_lobes = 8;
    seed(1);
    make_samples(NULL, s, N);
    gkd_result r = gkd_create(&d, &f);
    if (r) {
        assert_int_equal(r, GKD_OUT_OF_MEMORY);
        assert_null(f);
        return 1;
    }
    r = gkd_stream_create(f, &stream);
    assert_true(r == GKD_OK ? stream != NULL : r == GKD_OUT_OF_MEMORY && !stream);
    failed += r != GKD_OK;
    for (int pass = 0; pass < 2; ++pass) {
        if (stream) {
            r = gkd_record(stream, s, N);
            assert_true(r == GKD_OK || r == GKD_OUT_OF_MEMORY);
            failed += r != GKD_OK;
            r = gkd_accumulate(f, &stream, 1, NULL, NULL);
            assert_true(r == GKD_OK || r == GKD_OUT_OF_MEMORY);
            failed += r != GKD_OK;
            gkd_stream_clear(stream);
        }
        r = gkd_refine(f, NULL, NULL, NULL);
        assert_true(r == GKD_OK || r == GKD_OUT_OF_MEMORY);
        failed += r != GKD_OK;
        r = gkd_validate(f);
        assert_true(r == GKD_OK || (r == GKD_OUT_OF_MEMORY && c->fail_at));
        failed += r != GKD_OK;
        gkd_view v = gkd_get_view(f); /* still answers */
        gkd_handle h;
        float u[2] = {0.5f, 0.5f}, w[3];
        gkd_find(&v, s[pass].position, NULL, NULL, &h);
        assert_true(gkd_sample(&h, u, w) > 0);
        size_t size;
        void *data = save(f, &size);
        r = gkd_load(&d, data, size, &g);
        assert_true(r == GKD_OK || (r == GKD_OUT_OF_MEMORY && !g));
        failed += r != GKD_OK;
        gkd_destroy(g);
        free(data);
    }
    gkd_stats stats;
    gkd_get_stats(f, &stats);
    if (stream)
        assert_int_equal(stats.samples + stats.lost, 2 * N);
    gkd_stream_destroy(stream);
    c->fail_at = 0; /* memory is back: it learns again */
    OK(gkd_validate(f));
    learn(f, s, N);
    OK(gkd_refine(f, NULL, NULL, NULL));
    OK(gkd_validate(f));
    assert_true(gkd_cell_count(f) > 1);
    gkd_destroy(f);
    return failed + (stats.denied_splits > 0);
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
        for (long k = 1; k <= requests; k += requests > 300 ? 1 + (k > 60) * requests / 120 : 1) {
            c = (counter){.fail_at = k, .fail_all = all};
            scenario(&c);
            assert_int_equal(c.live, 0);
        }
}

static void test_lost_samples_are_counted(void **state)
{
    (void)state;
    counter c = {0};
    gkd_desc d = unit_cube();
    gkd_field *f;
    gkd_stream *stream;
    static gkd_training_sample s[1000];
    gkd_stats stats;
    count_with(&d, &c);
    seed(90);
    OK(gkd_create(&d, &f));
    OK(gkd_stream_create(f, &stream));
    make_samples(NULL, s, 1000);
    c.fail_at = c.requests + 2; /* the second chunk */
    assert_int_equal(gkd_record(stream, s, 1000), GKD_OUT_OF_MEMORY);
    assert_int_equal(gkd_stream_size(stream), 256);
    c.fail_at = 0;
    OK(gkd_record(stream, s, 10));
    OK(gkd_accumulate(f, &stream, 1, NULL, NULL));
    OK(gkd_refine(f, NULL, NULL, NULL));
    gkd_get_stats(f, &stats);
    assert_int_equal(stats.samples, 266);
    assert_int_equal(stats.lost, 744);
    gkd_stream_destroy(stream);
    gkd_destroy(f);
    assert_int_equal(c.live, 0);
}

static void test_queries_do_not_allocate(void **state)
{
    (void)state;
    counter c = {0};
    gkd_desc d = unit_cube();
    count_with(&d, &c);
    d.update_samples = 4096;
    seed(91);
    gkd_field *f = train(&d, 2, 4000);
    long before = c.requests;
    gkd_view v = gkd_get_view(f);
    float p[3] = {0.1f, 0.2f, 0.3f}, u[3] = {0.3f, 0.4f, 0.5f}, dir[3], pdf;
    gkd_handle h;
    gkd_stats stats;
    gkd_find(&v, p, NULL, u, &h);
    gkd_find_batch(&v, 1, NULL, p, 12, NULL, 0, u, 12, &h, NULL);
    gkd_sample_batch(&v, 1, NULL, &h, u, 8, dir, 12, &pdf);
    gkd_pdf_batch(&v, 1, NULL, &h, dir, 12, &pdf);
    gkd_pdf_directions(&v, &h, 1, dir, 12, &pdf);
    gkd_get_stats(f, &stats);
    (void)gkd_structure_id(f);
    (void)gkd_save_bound(f);
    (void)gkd_record_fraction(f);
    (void)gkd_all_closed(f);
    assert_int_equal(c.requests, before);
    gkd_destroy(f);
    assert_int_equal(c.live, 0);
}

/* Both parts stay within a tenth of max_bytes, whatever comes; what waits and an update's scratch are outside. */
static void test_memory_cap_holds_and_the_field_still_learns(void **state)
{
    (void)state;
    enum { N = 100000 };
    static gkd_training_sample s[N];
    for (int split = GKD_SPLIT_SIGNATURE; split <= GKD_SPLIT_COUNT; ++split) {
        counter c = {0};
        gkd_desc d = unit_cube();
        gkd_field *f;
        gkd_stats stats;
        d.max_bytes = 1 << 21;
        d.split = (gkd_split)split;
        d.split_samples = 64;
        d.min_samples = 16;
        d.confidence = 0.3f;
        d.update_samples = 16384;
        count_with(&d, &c);
        seed(92);
        OK(gkd_create(&d, &f));
        for (int pass = 0; pass < 5; ++pass) {
            gkd_view v = gkd_get_view(f);
            make_samples(&v, s, N);
            learn(f, s, N);
            OK(gkd_refine(f, NULL, NULL, NULL));
            OK(gkd_validate(f));
            gkd_get_stats(f, &stats);
            double held = (double)c.bytes - f->pending_capacity * (double)sizeof *f->pending;
            assert_true(fabs(held - (double)stats.bytes) <= 0.01 * held); /* bytes tells the truth */
            assert_true(held <= 1.1 * (double)d.max_bytes);
        }
        assert_true(stats.denied_splits > 0);
        assert_true(stats.cells > 50);
        gkd_destroy(f);
        assert_int_equal(c.live, 0);
    }
}

/* ---- gate */

/* Light that guiding cannot improve on: the same from everywhere, drawn uniformly or by the guide. */
static void test_gate_closes_where_light_is_even_and_stays_open_where_it_is_peaked(void **state)
{
    (void)state;
    enum { N = 20000 };
    static gkd_training_sample s[N];
    for (int peaked = 0; peaked < 2; ++peaked) {
        gkd_desc d = unit_cube();
        gkd_field *f;
        seed(93);
        OK(gkd_create(&d, &f));
        for (int pass = 0; pass < 6; ++pass) {
            gkd_view v = gkd_get_view(f);
            for (int i = 0; i < N; ++i) {
                float p[3] = {rndf(), rndf(), rndf()}, w[3], u[2] = {rndf(), rndf()}, pg, L, mix;
                gkd_handle h;
                gkd_find(&v, p, NULL, NULL, &h);
                random_direction(w);
                if (rnd() < (double)h.alpha)
                    pg = gkd_pdf(&h, w);
                else
                    pg = gkd_sample(&h, u, w);
                mix = h.alpha * (float)UNIFORM + (1 - h.alpha) * pg;
                L = peaked ? w[0] > 0.95f ? 100 : 0.1f : 1;
                s[i] = gkd_make_scalar_sample(p, w, NULL, INFINITY, L, L, L, mix, (float)UNIFORM, pg);
            }
            learn(f, s, N);
            OK(gkd_refine(f, NULL, NULL, NULL));
            OK(gkd_validate(f));
        }
        gkd_stats stats;
        gkd_get_stats(f, &stats);
        gkd_view v = gkd_get_view(f);
        if (peaked) {
            assert_int_equal(stats.closed_cells, 0);
            assert_true(stats.open_cells > 0 && stats.mean_alpha < 0.9f && !gkd_all_closed(f));
            assert_true(gkd_record_fraction(f) == 1);
        } else {
            assert_int_equal(stats.closed_cells, stats.cells);
            assert_true(gkd_all_closed(f) && v.cells[0].alpha == 1);
            assert_true(gkd_record_fraction(f) < 0.1f);
        }
        gkd_destroy(f);
        /* without a gate nothing closes */
        d.no_gate = true;
        OK(gkd_create(&d, &f));
        learn(f, s, N);
        OK(gkd_refine(f, NULL, NULL, NULL));
        gkd_get_stats(f, &stats);
        assert_int_equal(stats.closed_cells, 0);
        gkd_destroy(f);
    }
}

static void test_validate_notices_damage(void **state)
{
    (void)state;
    gkd_desc d = unit_cube();
    d.min_samples = 100;
    d.update_samples = 4096;
    seed(94);
    gkd_field *f = train(&d, 3, 4000);
    assert_true(gkd_cell_count(f) > 1);
    gkd_node keep = f->nodes[0];
    f->nodes[0].link = 0x1ffffff0;
    assert_int_equal(gkd_validate(f), GKD_CORRUPT);
    f->nodes[0] = keep;
    OK(gkd_validate(f));
    gkd_lobe *l = gkdi_block_lobes(f->block);
    float kappa = l->kappa;
    l->kappa = NAN;
    assert_int_equal(gkd_validate(f), GKD_CORRUPT);
    l->kappa = kappa;
    double sum = f->cells[0].look[0].sum;
    f->cells[0].look[0].sum = -1;
    assert_int_equal(gkd_validate(f), GKD_CORRUPT);
    f->cells[0].look[0].sum = sum;
    for (int k = 0; k < 3; ++k) {
        double mean = f->cells[0].look[0].mean[k];
        f->cells[0].look[0].mean[k] = NAN;
        assert_int_equal(gkd_validate(f), GKD_CORRUPT);
        f->cells[0].look[0].mean[k] = mean;
        OK(gkd_validate(f));
    }
    gkdi_block_nodes(f->block)[0].link = GKD_LEAF | 1000000;
    assert_int_equal(gkd_validate(f), GKD_CORRUPT);
    gkd_destroy(f);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_documented_defaults_are_the_defaults),
        cmocka_unit_test(test_bad_descriptors_are_refused_by_name),
        cmocka_unit_test(test_documented_limits_are_accepted),
        cmocka_unit_test(test_sizes_are_as_documented),
        cmocka_unit_test(test_an_untrained_field_is_uniform),
        cmocka_unit_test(test_density_of_a_trained_field_integrates_to_one_and_is_sampled),
        cmocka_unit_test(test_batches_equal_single_queries_at_every_level),
        cmocka_unit_test(test_the_lamp_is_found_from_everywhere_in_a_cell),
        cmocka_unit_test(test_bad_samples_are_refused_and_leave_no_trace),
        cmocka_unit_test(test_enormous_quotients_do_no_harm),
        cmocka_unit_test(test_positions_outside_are_clamped_and_counted),
        cmocka_unit_test(test_degenerate_input_stays_finite),
        cmocka_unit_test(test_results_do_not_depend_on_threads_or_cuts),
        cmocka_unit_test(test_cells_are_found_alike_at_every_level),
        cmocka_unit_test(test_training_is_the_same_at_every_level),
        cmocka_unit_test(test_count_rule_splits_at_the_documented_number),
        cmocka_unit_test(test_signature_rule_splits_at_an_edge_of_light_only),
        cmocka_unit_test(test_kept_signatures_know_where_their_samples_lie),
        cmocka_unit_test(test_lookahead_cells_go_where_light_is_even_and_come_back),
        cmocka_unit_test(test_converged_mixtures_rest_and_wake),
        cmocka_unit_test(test_split_reports_let_another_model_follow),
        cmocka_unit_test(test_save_and_load_go_on_training_the_same),
        cmocka_unit_test(test_truncated_and_flipped_saves_are_refused),
        cmocka_unit_test(test_forged_saves_never_harm),
        cmocka_unit_test(test_saves_with_impossible_shares_are_refused),
        cmocka_unit_test(test_merge_equals_training_together),
        cmocka_unit_test(test_every_failed_allocation_is_survived),
        cmocka_unit_test(test_lost_samples_are_counted),
        cmocka_unit_test(test_queries_do_not_allocate),
        cmocka_unit_test(test_memory_cap_holds_and_the_field_still_learns),
        cmocka_unit_test(test_gate_closes_where_light_is_even_and_stays_open_where_it_is_peaked),
        cmocka_unit_test(test_validate_notices_damage),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
