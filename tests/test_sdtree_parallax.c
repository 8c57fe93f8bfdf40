/* test_sdtree_parallax.c: quadtrees of guide_sdtree.h on spheres around their pivots, seen from anywhere within.

   gcc -std=c11 -O2 -I. tests/test_sdtree_parallax.c -lcmocka -lm -lpthread */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "chi_square.h"
#include "rng.h"

#define PI 3.14159265358979323846
#define OK(call) assert_int_equal((call), GSD_OK)

/* ---- helpers */

/* Length up to 0.8; sometimes exactly that, or 0. */
static void random_offset(float o[3])
{
    float l = rng_next() % 4 == 0 ? GSD_MOST_OFFSET : rng_next() % 4 == 0 ? 0 : GSD_MOST_OFFSET * rndf();
    random_direction(o);
    for (int k = 0; k < 3; ++k)
        o[k] *= l * 0.9999999f;
}

/* The unit cube's field as one cell; `lamp` is a ball of radius 0.05 that shines with 100 in front of an even 0.05. */
static gsd_field *one_cell(gsd_target target)
{
    gsd_desc d = {.bounds_max = {1, 1, 1}, .target = target, .split_samples = 1e9f, .no_gate = true};
    gsd_field *f;
    OK(gsd_create(&d, &f));
    return f;
}

/* Radiance from a lamp (centre, radius), and how far away it or the rest is. */
static float lamp_radiance(const float p[3], const float d[3], const float lamp[4], float *distance)
{
    float to[3] = {lamp[0] - p[0], lamp[1] - p[1], lamp[2] - p[2]};
    float along = to[0] * d[0] + to[1] * d[1] + to[2] * d[2];
    float apart = to[0] * to[0] + to[1] * to[1] + to[2] * to[2] - along * along;
    *distance = along > 0 && apart < lamp[3] * lamp[3] ? along : 2;
    return along > 0 && apart < lamp[3] * lamp[3] ? 100 : 0.05f;
}

/* One pass of n samples from anywhere in the cube; far: distances are not told. */
static void pass(gsd_field *f, const float lamp[4], uint32_t n, bool far)
{
    gsd_stream *stream;
    gsd_view v = gsd_get_view(f);
    OK(gsd_stream_create(f, &stream));
    for (uint32_t i = 0; i < n; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, u[2] = {rndf(), rndf()}, d[3], even = (float)(0.25 / PI), distance;
        gsd_handle h = gsd_find(&v, p, NULL, NULL);
        if (i & 1)
            random_direction(d);
        else
            gsd_sample(&v, &h, u, d);
        float L = lamp_radiance(p, d, lamp, &distance), guide = gsd_pdf(&v, &h, d), mix = 0.5f * (guide + even);
        gsd_training_sample s =
            gsd_make_scalar_sample(p, d, NULL, far ? INFINITY : distance, L, L, L, mix, even, guide);
        OK(gsd_record(stream, &s, 1));
    }
    OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
    gsd_stream_destroy(stream);
    OK(gsd_refine(f, NULL, NULL, NULL));
}

static const float a_lamp[4] = {0.5f, 0.4f, 1.9f, 0.05f};

/* A learned field of one cell, whose quadtree has small leaves. */
static gsd_field *learned(gsd_target target, bool far)
{
    gsd_field *f = one_cell(target);
    for (int k = 0; k < 6; ++k)
        pass(f, a_lamp, 20000, far);
    return f;
}

/* ---- the map */

static void test_map_and_its_solid_angle(void **state)
{
    (void)state;
    double worst = 0, worst_back = 0, worst_unit = 0;
    seed(1);
    for (int i = 0; i < 20000; ++i) {
        float o[3], d[3], seen[3], back[3], side[3];
        random_offset(o);
        random_direction(d);
        random_direction(side);
        float scale = gsd_to_pivot(o, d, seen);
        /* in double: the point of the unit sphere, and the cross product of two small steps there and here */
        double b = 0, l = 0, point[4][3], here[3][3], h = 1e-5;
        double e1[3], e2[3], n = 0, w = 0;
        for (int k = 0; k < 3; ++k)
            w += (double)side[k] * (double)d[k];
        for (int k = 0; k < 3; ++k) {
            e1[k] = (double)side[k] - w * (double)d[k];
            n += e1[k] * e1[k];
        }
        for (int k = 0; k < 3; ++k)
            e1[k] /= sqrt(n);
        for (int k = 0; k < 3; ++k)
            e2[k] = (double)d[(k + 1) % 3] * e1[(k + 2) % 3] - (double)d[(k + 2) % 3] * e1[(k + 1) % 3];
        for (int j = 0; j < 3; ++j) {
            double length = 0;
            for (int k = 0; k < 3; ++k) {
                here[j][k] = (double)d[k] + (j == 1 ? h * e1[k] : j == 2 ? h * e2[k] : 0);
                length += here[j][k] * here[j][k];
            }
            b = l = 0;
            for (int k = 0; k < 3; ++k) {
                here[j][k] /= sqrt(length);
                b += (double)o[k] * here[j][k];
                l += (double)o[k] * (double)o[k];
            }
            double t = sqrt(1 - l + b * b) - b;
            for (int k = 0; k < 3; ++k)
                point[j][k] = (double)o[k] + t * here[j][k];
        }
        double area = 0;
        for (int k = 0; k < 3; ++k) {
            int p = (k + 1) % 3, q = (k + 2) % 3;
            double c = (point[1][p] - point[0][p]) * (point[2][q] - point[0][q]) -
                       (point[1][q] - point[0][q]) * (point[2][p] - point[0][p]);
            area += c * c;
            worst = fmax(worst, fabs(point[0][k] - (double)seen[k]));
        }
        worst_unit = fmax(worst_unit, fabs(sqrt(area) / (h * h) / (double)scale - 1));
        memcpy(back, seen, sizeof back);
        gsd_from_pivot(o, back);
        for (int k = 0; k < 3; ++k)
            worst_back = fmax(worst_back, fabs((double)(back[k] - d[k])));
    }
    print_message("point %.1e, solid angle %.1e, and back %.1e\n", worst, worst_unit, worst_back);
    assert_true(worst < 4e-7 && worst_unit < 2e-4 && worst_back < 2e-6);
}

static void test_without_offset_nothing_changes(void **state)
{
    (void)state;
    const float none[3] = {0, 0, 0}, odd[4][3] = {{NAN, 0, 0}, {INFINITY, 1, 0}, {1e30f, 1e30f, 0}, {0, 0, 0}};
    float seen[3], offset[3];
    seed(2);
    for (int i = 0; i < 1000; ++i) {
        float d[3];
        random_direction(d);
        assert_true(gsd_to_pivot(none, d, seen) == 1);
        assert_memory_equal(seen, d, sizeof seen);
    }
    for (int i = 0; i < 4; ++i) { /* no more than wrong: finite, and of some leaf */
        random_offset(offset);
        float scale = gsd_to_pivot(offset, odd[i], seen);
        assert_true(scale >= 0 && scale < 8);
        const float p[3] = {odd[i][0], odd[i][1], 3e38f};
        gsd_offset(none, 1e3f, p, offset);
        assert_true(offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2] <= 0.6401f);
    }
}

/* ---- densities */

/* Integral over all directions, by a grid of equal areas. */
static double integral(const gsd_view *v, const gsd_handle *h, int side)
{
    double sum = 0;
    for (int y = 0; y < side; ++y)
        for (int x = 0; x < side; ++x) {
            float d[3];
            gsd_direction((x + rnd()) / side * 16777216, (y + rnd()) / side * 16777216, d);
            sum += (double)gsd_pdf(v, h, d);
        }
    return sum * 4 * PI / side / side;
}

static void test_density_integrates_to_one(void **state)
{
    (void)state;
    gsd_field *f = learned(GSD_TARGET_RADIANCE, false);
    gsd_view v = gsd_get_view(f);
    assert_true(v.cells[0].nearness > 0.3f);
    double worst = 0;
    seed(3);
    for (int i = 0; i < 24; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, n[3];
        random_direction(n);
        gsd_handle h = gsd_find(&v, p, i % 2 ? n : NULL, NULL);
        assert_true((h.product > 0) == (i % 2));
        worst = fmax(worst, fabs(integral(&v, &h, 1000) - 1));
    }
    print_message("integral - 1: %.1e\n", worst); /* the grid's own error: 1e-3 */
    assert_true(worst < 6e-3);
    gsd_destroy(f);
}

/* Sampled directions against the density's integrals over 16 x 32 squares, and against gsd_pdf. */
static void samples_follow(const gsd_view *v, const gsd_handle *h, uint32_t n, long *apart)
{
    enum { X = 32, Y = 16, SUB = 64 };
    static double expected[X * Y], seen[X * Y];
    memset(seen, 0, sizeof seen);
    for (int k = 0; k < X * Y; ++k) {
        expected[k] = 0;
        for (int s = 0; s < SUB * SUB; ++s) {
            float d[3];
            gsd_direction((k % X + (s % SUB + rnd()) / SUB) / X * 16777216,
                          (k / X + (s / SUB + rnd()) / SUB) / Y * 16777216, d);
            expected[k] += (double)gsd_pdf(v, h, d) * 4 * PI / (X * Y) / (SUB * SUB) * n;
        }
    }
    for (uint32_t i = 0; i < n; ++i) {
        float u[2] = {rndf(), rndf()}, d[3];
        uint32_t x, y;
        float pdf = gsd_sample(v, h, u, d);
        *apart += pdf != gsd_pdf(v, h, d);
        gsd_coordinates(d, &x, &y);
        seen[(y >> 20) * X + (x >> 19)] += 1;
    }
    double off = counts_deviate(expected, seen, X * Y, 1e-3); /* of the integral */
    if (off > 4.5)
        fail_msg("counts are %g standard deviations off", off);
}

static void test_samples_follow_the_density(void **state)
{
    (void)state;
    long apart = 0;
    for (int kind = 0; kind < 4; ++kind) {
        gsd_field *f = learned(kind < 2 ? GSD_TARGET_RADIANCE : GSD_TARGET_SIMPLE, false);
        gsd_view v = gsd_get_view(f);
        seed((uint64_t)kind + 10);
        for (int i = 0; i < 5; ++i) {
            float p[3] = {rndf(), rndf(), rndf()}, n[3];
            random_direction(n);
            gsd_handle h = gsd_find(&v, p, kind % 2 ? n : NULL, NULL);
            samples_follow(&v, &h, 60000, &apart);
        }
        gsd_destroy(f);
    }
    print_message("%ld of 1200000 samples with another density than gsd_pdf's\n", apart);
    assert_true(apart <= 3); /* near the poles rounding is larger */
}

/* Batches at every level against single queries, with offsets of all kinds. */
static void test_batches_equal_single_queries(void **state)
{
    (void)state;
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
        enum { N = 5003 };
        static gsd_handle handles[N];
        static float u[N][2], dir[N][4], pdf[N], in[N][3], p[N][3], normal[N][3];
        gsd_field *f = learned(GSD_TARGET_RADIANCE, false);
        gsd_view v = gsd_get_view(f);
        gsd_desc probe = {.bounds_max = {1, 1, 1}, .simd = (gsd_simd)level}, resolved;
        long apart = 0, rounded = 0, away = 0;
        if (gsd_resolve(&probe, &resolved) == GSD_OK) {
            v.simd = (uint32_t)level;
            seed(4);
            for (uint32_t i = 0; i < N; ++i) {
                for (int k = 0; k < 3; ++k)
                    p[i][k] = 3 * rndf() - 1; /* outside of the field too */
                random_direction(normal[i]);
                if (i % 2)
                    memset(normal[i], 0, sizeof normal[i]);
                random_direction(in[i]);
                u[i][0] = rndf();
                u[i][1] = rndf();
            }
            gsd_find_batch(&v, N, NULL, p[0], sizeof p[0], normal[0], sizeof normal[0], NULL, 0, handles, NULL);
            gsd_sample_batch(&v, N, NULL, handles, u[0], sizeof u[0], dir[0], sizeof dir[0], pdf);
            for (uint32_t i = 0; i < N; ++i) {
                gsd_handle h = gsd_find(&v, p[i], normal[i], NULL);
                float d[3];
                assert_memory_equal(h.offset, handles[i].offset, sizeof h.offset);
                float q = gsd_sample(&v, &handles[i], u[i], d), by = 0;
                for (int k = 0; k < 3; ++k)
                    by += fabsf(d[k] - dir[i][k]);
                away += by > 4e-6f;
                apart += fabsf(q - pdf[i]) > 4e-6f * q;
                rounded += fabsf(pdf[i] - gsd_pdf(&v, &handles[i], dir[i])) > 4e-6f * pdf[i];
            }
            assert_true(apart <= 2 && rounded <= 2 && away <= 2);
            gsd_pdf_batch(&v, N, NULL, handles, in[0], sizeof in[0], pdf);
            for (uint32_t i = 0; i < N; ++i)
                assert_true(fabsf(gsd_pdf(&v, &handles[i], in[i]) - pdf[i]) <= 2e-6f * pdf[i]);
        }
        gsd_destroy(f);
    }
}

/* What a batch says of a query does not depend on what else is in it, to the bit, even where a direction is none. */
static void test_neighbours_change_no_bit(void **state)
{
    enum { N = 1001 };
    static const float strange[] = {NAN, INFINITY, -INFINITY};
    static gsd_handle handles[N];
    static float u[N][2], in[N][3], out[N][3], p[N][3], normal[N][3], drawn[N], asked[N];
    gsd_field *f;
    (void)state;
    seed(7);
    f = learned(GSD_TARGET_RADIANCE, false);
    gsd_view v = gsd_get_view(f);
    for (int i = 0; i < N; ++i) {
        random_direction(in[i]);
        if (rng_next() % 16 == 0)
            in[i][rng_next() % 3] = strange[rng_next() % 3];
        if (rng_next() % 2)
            random_direction(normal[i]);
        for (int k = 0; k < 3; ++k)
            p[i][k] = rndf();
        u[i][0] = rndf();
        u[i][1] = rndf();
    }
    gsd_find_batch(&v, N, NULL, p[0], sizeof p[0], normal[0], sizeof normal[0], NULL, 0, handles, NULL);
    for (int i = 0; i < N; i += 3) /* as in cells without parallax */
        memset(handles[i].offset, 0, sizeof handles[i].offset);
    for (uint32_t level = GSD_SIMD_SCALAR; level <= gsd_get_view(f).simd; ++level) {
        v.simd = level;
        gsd_sample_batch(&v, N, NULL, handles, u[0], sizeof u[0], out[0], sizeof out[0], drawn);
        gsd_pdf_batch(&v, N, NULL, handles, in[0], sizeof in[0], asked);
        for (uint32_t i = 0; i < N; ++i) {
            const uint32_t same[8] = {0};
            for (uint32_t n = 1; n <= 8; n += 7) { /* alone, and eight times */
                float d[3], alone;
                gsd_sample_batch(&v, n, same, &handles[i], u[i], sizeof u[i], d, sizeof d, &alone);
                assert_memory_equal(d, out[i], sizeof d);
                assert_memory_equal(&alone, &drawn[i], sizeof alone);
                gsd_pdf_batch(&v, n, same, &handles[i], in[i], sizeof in[i], &alone);
                assert_memory_equal(&alone, &asked[i], sizeof alone);
            }
        }
    }
    gsd_destroy(f);
}

/* ---- learning */

/* Mean density of the directions to the lamp's middle, over the cell. */
static double density_to_lamp(const gsd_field *f)
{
    gsd_view v = gsd_get_view(f);
    double sum = 0;
    for (int i = 0; i < 2000; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, d[3], l = 0;
        for (int k = 0; k < 3; ++k) {
            d[k] = a_lamp[k] - p[k];
            l += d[k] * d[k];
        }
        for (int k = 0; k < 3; ++k)
            d[k] /= sqrtf(l);
        gsd_handle h = gsd_find(&v, p, NULL, NULL);
        sum += (double)gsd_pdf(&v, &h, d) / 2000;
    }
    return sum;
}

/* A lamp nearby and one large cell: told how far it is, the quadtree is a sharp one. */
static void test_near_lamp_stays_sharp(void **state)
{
    (void)state;
    for (int target = GSD_TARGET_RADIANCE; target <= GSD_TARGET_SIMPLE; ++target) {
        seed(5);
        gsd_field *near = learned((gsd_target)target, false), *far = learned((gsd_target)target, true);
        double with = density_to_lamp(near), without = density_to_lamp(far);
        print_message("density to the lamp %g, %g without distances\n", with, without);
        assert_true(gsd_get_view(far).cells[0].nearness == 0);
        assert_true(with > 3 * without);
        gsd_destroy(near);
        gsd_destroy(far);
    }
}

/* What is learned is light as it is: estimates by samples of the guide alone are those of uniform sampling. */
static void test_estimates_are_unbiased(void **state)
{
    (void)state;
    gsd_field *f = learned(GSD_TARGET_SIMPLE, false);
    gsd_view v = gsd_get_view(f);
    double sum = 0, square = 0, distance2, l2 = 0;
    const float p[3] = {0.9f, 0.1f, 0.8f};
    enum { N = 400000 };
    seed(6);
    for (int i = 0; i < N; ++i) {
        float u[2] = {rndf(), rndf()}, d[3], distance;
        gsd_handle h = gsd_find(&v, p, NULL, NULL);
        float pdf = gsd_sample(&v, &h, u, d);
        double x = (double)lamp_radiance(p, d, a_lamp, &distance) / (double)pdf;
        sum += x / N;
        square += x * x / N;
    }
    for (int k = 0; k < 3; ++k)
        l2 += (double)((a_lamp[k] - p[k]) * (a_lamp[k] - p[k]));
    distance2 = l2;
    double cap = 2 * PI * (1 - sqrt(1 - 0.05 * 0.05 / distance2)), truth = 0.05 * 4 * PI + 99.95 * cap;
    assert_true(fabs(sum - truth) < 4.5 * sqrt((square - sum * sum) / N) + 1e-4 * truth);
    gsd_destroy(f);
}

/* The nearness is the light's, and a pivot lies where it may. */
static void test_pivots(void **state)
{
    (void)state;
    gsd_desc d = {.bounds_max = {1, 1, 1}, .target = GSD_TARGET_SIMPLE, .no_gate = true};
    gsd_field *f, *again;
    gsd_stats stats;
    uint32_t kept = 0, own = 0;
    const float within[4] = {0.7f, 0.3f, 0.9f, 0.05f};
    OK(gsd_create(&d, &f));
    seed(7);
    for (int k = 0; k < 8; ++k)
        pass(f, within, 20000, false);
    for (uint32_t c = 0; c < gsd_cell_count(f); ++c)
        for (uint32_t e = 0; e < c; ++e)
            own += memcmp(f->states[c].pivot, f->states[e].pivot, sizeof f->states[c].pivot) != 0;
    assert_true(own > 0);
    own = 0;
    gsd_destroy(f);
    OK(gsd_create(&d, &f));
    for (int k = 0; k < 8; ++k)
        pass(f, a_lamp, 20000, false);
    gsd_get_stats(f, &stats);
    assert_true(stats.cells > 16);
    gsd_view v = gsd_get_view(f);
    for (uint32_t c = 0; c < stats.cells; ++c) {
        const gsd_cell *cell = &v.cells[c];
        const gsdi_state *s = &f->states[c];
        double l = 0, middle = 0, size = 1 / (double)v.scale;
        for (int k = 0; k < 3; ++k) {
            double extent = gsd_cell_extent(s->level, (uint32_t)k) * size, m;
            m = (double)v.origin[k] + s->origin[k] * size + 0.5 * extent;
            l += pow(fabs(m - (double)s->pivot[k]) + 0.5 * extent, 2);
            middle += fabs(m - (double)s->pivot[k]);
        }
        assert_true(sqrt(l) * (double)s->nearness < 0.7001);
        middle > 1e-6 ? kept++ : own++;
        l = 0;
        for (int k = 0; k < 3; ++k)
            l += pow((double)(a_lamp[k] - cell->pivot[k]), 2);
        assert_true((double)cell->nearness * sqrt(l) > 0.4 && (double)cell->nearness * sqrt(l) < 2.5);
    }
    print_message("%u of %u pivots are those of larger cells\n", kept, kept + own);
    assert_true(kept > 0);
    OK(gsd_validate(f));

    /* kept by save and load; sums that are seen from elsewhere are not merged */
    size_t size = gsd_save_bound(f);
    void *data = malloc(size);
    OK(gsd_save(f, data, size, &size));
    OK(gsd_load(NULL, data, size, &again));
    free(data);
    assert_memory_equal(again->states, f->states, stats.cells * sizeof *f->states);
    assert_memory_equal(gsd_get_view(again).cells, v.cells, stats.cells * sizeof *v.cells);
    OK(gsd_merge(f, again));
    again->states[3].nearness *= 1.01f;
    gsdi_field_changed(again);
    assert_int_equal(gsd_merge(f, again), GSD_MISMATCH);
    again->states[3].nearness = NAN;
    assert_int_equal(gsd_validate(again), GSD_CORRUPT);
    gsd_destroy(f);
    gsd_destroy(again);
}

/* Known from the second refine on, also where no sums are kept: passes that double, cleared sums, a new target. */
static void test_nearness_is_there_at_once(void **state)
{
    (void)state;
    for (int kind = 0; kind < 3; ++kind) {
        gsd_desc d = {.bounds_max = {1, 1, 1}, .split_samples = 1e9f, .no_gate = true, .no_history = kind == 1};
        gsd_field *f;
        d.target = kind == 2 ? GSD_TARGET_SWITCHING : GSD_TARGET_SIMPLE;
        OK(gsd_create(&d, &f));
        seed(9);
        for (uint32_t k = 0; k < 6; ++k) {
            pass(f, a_lamp, kind == 0 ? 4000u << k : 8000, false);
            assert_true(k ? f->states[0].nearness > 0.3f : f->states[0].nearness == 0);
        }
        assert_true(gsd_get_view(f).cells[0].nearness > 0.3f);
        gsd_destroy(f);
    }
}

/* One sample beside the pivot, with a normal: what its leaf gathers is what the map says, in double precision. */
static void test_sums_are_those_of_the_sphere(void **state)
{
    (void)state;
    double worst = 0;
    for (int i = 0; i < 200; ++i) {
        gsd_desc d = {.bounds_max = {1, 1, 1}, .target = GSD_TARGET_SIMPLE, .no_guide_weight = true, .no_gate = true};
        d.directional_filter = GSD_DIRECTIONAL_NEAREST;
        gsd_field *f;
        gsd_stream *stream;
        OK(gsd_create(&d, &f));
        OK(gsd_stream_create(f, &stream));
        gsdi_state *s = &f->states[0];
        seed((uint64_t)i + 100);
        for (int k = 0; k < 3; ++k)
            s->pivot[k] = 0.4f + 0.2f * rndf();
        s->nearness = 0.8f;
        float p[3] = {rndf(), rndf(), rndf()}, w[3], n[3], packed_n[3], c = 0.5f + rndf();
        random_direction(w);
        random_direction(n);
        gsd_training_sample sample = gsd_make_scalar_sample(p, w, n, 2, 1, c, c, 0.3f, 0.3f, 0.2f);
        gsd_unpack_normal(sample.direction, packed_n);
        double o[3], b = 0, l = 0, lift = 0, gathered = 0;
        for (int k = 0; k < 3; ++k) {
            o[k] = ((double)p[k] - (double)s->pivot[k]) * 0.8;
            b += o[k] * (double)w[k];
            l += o[k] * o[k];
        }
        assert_true(l < 0.64);
        double root = sqrt(1 - l + b * b), t = root - b;
        float seen[3];
        uint32_t x, y;
        for (int k = 0; k < 3; ++k) {
            seen[k] = (float)(o[k] + t * (double)w[k]);
            lift += o[k] * (double)packed_n[k];
        }
        gsd_coordinates(seen, &x, &y);
        gsd_view v = gsd_get_view(f);
        double cosine = (double)gsd_bin_cosine(&v, packed_n, (float)lift, (y >> 21) * 8 + (x >> 21));
        double truth = pow((double)c / cosine, 2) / (t * t / root) / 0.3;
        OK(gsd_record(stream, &sample, 1));
        OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
        for (uint32_t k = 0; k < f->building_nodes; ++k) {
            double both = f->sum[k].half[0] + f->sum[k].half[1];
            gathered = both > 0 ? both : gathered;
        }
        worst = fmax(worst, fabs(gathered / truth - 1));
        gsd_stream_destroy(stream);
        gsd_destroy(f);
    }
    print_message("sums apart by %.1e\n", worst);
    assert_true(worst < 2e-5);
}

/* Distances that are no distances are refused, any others are fine. */
static void test_distances(void **state)
{
    (void)state;
    const float bad[] = {0, -1, NAN, -INFINITY, -0.0f}, good[] = {1e-30f, 1e-3f, 1, 1e30f, INFINITY};
    const float p[3] = {0.5f, 0.5f, 0.5f}, d[3] = {0, 0, 1};
    gsd_field *f = one_cell(GSD_TARGET_SIMPLE);
    gsd_stream *stream;
    gsd_stats stats;
    OK(gsd_stream_create(f, &stream));
    for (int k = 0; k < 100; ++k) {
        gsd_training_sample s = gsd_make_scalar_sample(p, d, NULL, bad[k % 5], 1, 1, 1, 1, 1, 0);
        OK(gsd_record(stream, &s, 1));
        s = gsd_make_scalar_sample(p, d, NULL, good[k % 5], 1, 1, 1, 1, 1, 0);
        OK(gsd_record(stream, &s, 1));
    }
    OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
    gsd_stream_destroy(stream);
    OK(gsd_refine(f, NULL, NULL, NULL));
    gsd_get_stats(f, &stats);
    assert_int_equal(stats.samples, 100);
    assert_int_equal(stats.refused, 100);
    OK(gsd_validate(f));
    gsd_destroy(f);
}

/* Anything: near and far, with and without a normal, zero, rejected, outside, bad, straight along an axis. */
static gsd_training_sample any_sample(const gsd_view *v)
{
    static const float strange[] = {NAN, INFINITY, -INFINITY, 3e38f, -1, 1e-30f, 1e20f, 0};
    float p[3], d[3], n[3], even = (float)(0.25 / PI), distance, L;
    for (int k = 0; k < 3; ++k)
        p[k] = rng_next() % 16 ? rndf() : rng_next() % 2 ? 3 * rndf() - 1 : (float)(rng_next() % 5) * 0.25f;
    random_direction(n);
    random_direction(d);
    if (rng_next() % 32 == 0)
        for (uint32_t k = 0, axis = rng_next() % 3; k < 3; ++k)
            d[k] = k == axis ? rng_next() % 2 ? 1.0f : -1.0f : 0;
    L = lamp_radiance(p, d, a_lamp, &distance) * (rng_next() % 8 ? 1 + rndf() : 0);
    L = rng_next() % 16 ? L : GSD_REJECTED;
    distance = rng_next() % 8 ? distance : rng_next() % 2 ? INFINITY : rndf() * 1e-3f;
    gsd_handle h = gsd_find(v, p, n, NULL);
    float guide = rng_next() % 4 ? gsd_pdf(v, &h, d) : 0, c = L * (0.1f + rndf());
    gsd_training_sample s = gsd_make_scalar_sample(p, d, rng_next() % 3 ? n : NULL, distance, L, c, c * rndf() * 3,
                                                   0.5f * (guide + even), even, guide);
    float *const word[] = {&s.position[0],  &s.position[1],        &s.position[2], &s.nearness, &s.radiance,
                           &s.contribution, &s.pixel_contribution, &s.pdf_mix,     &s.pdf_bsdf, &s.pdf_guide};
    if (rng_next() % 16 == 0)
        *word[rng_next() % 10] = strange[rng_next() % 8];
    return s;
}

/* A save of what such samples teach at this level; *size = 0 where the machine does not have it. */
static void *taught(int kind, int level, size_t *size)
{
    gsd_desc d = {.bounds_max = {1, 1, 1}, .simd = (gsd_simd)level, .split_samples = kind & 1 ? 0 : 200};
    gsd_field *f;
    gsd_stream *stream;
    d.target = (gsd_target)(GSD_TARGET_RADIANCE + kind % 4);
    d.spatial_filter = kind & 4 ? GSD_SPATIAL_STOCHASTIC : GSD_SPATIAL_NEAREST;
    *size = 0;
    if (gsd_resolve(&d, &d) != GSD_OK)
        return NULL;
    OK(gsd_create(&d, &f));
    OK(gsd_stream_create(f, &stream));
    seed((uint64_t)kind + 1);
    for (int k = 0; k < 5; ++k) {
        gsd_view v = gsd_get_view(f);
        for (int i = 0; i < 3001; ++i) {
            gsd_training_sample s = any_sample(&v);
            OK(gsd_record(stream, &s, 1));
        }
        OK(gsd_accumulate(f, &stream, 1, NULL, NULL));
        gsd_stream_clear(stream);
        OK(gsd_refine(f, NULL, NULL, NULL));
    }
    OK(gsd_validate(f));
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    assert_true(stats.refused > 100 && stats.clamped > 100 && stats.rejected > 100 && stats.cells > 8);
    void *data = malloc(gsd_save_bound(f));
    assert_non_null(data);
    OK(gsd_save(f, data, gsd_save_bound(f), size));
    gsd_stream_destroy(stream);
    gsd_destroy(f);
    return data;
}

/* Whatever the level, samples teach the same, to the bit. */
static void test_learning_changes_no_bit_between_levels(void **state)
{
    (void)state;
    for (int kind = 0; kind < 8; ++kind) {
        size_t size, other;
        void *scalar = taught(kind, GSD_SIMD_SCALAR, &size);
        for (int level = GSD_SIMD_AVX2; level <= GSD_SIMD_NEON; ++level) {
            void *data = taught(kind, level, &other);
            if (other > 0) {
                assert_int_equal(other, size);
                assert_memory_equal(data, scalar, size);
            }
            free(data);
        }
        free(scalar);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_map_and_its_solid_angle),
        cmocka_unit_test(test_without_offset_nothing_changes),
        cmocka_unit_test(test_density_integrates_to_one),
        cmocka_unit_test(test_samples_follow_the_density),
        cmocka_unit_test(test_batches_equal_single_queries),
        cmocka_unit_test(test_neighbours_change_no_bit),
        cmocka_unit_test(test_near_lamp_stays_sharp),
        cmocka_unit_test(test_estimates_are_unbiased),
        cmocka_unit_test(test_pivots),
        cmocka_unit_test(test_nearness_is_there_at_once),
        cmocka_unit_test(test_sums_are_those_of_the_sphere),
        cmocka_unit_test(test_distances),
        cmocka_unit_test(test_learning_changes_no_bit_between_levels),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
