/* test_photon_parallax.c: maps of guide_photon.h on spheres around their pivots, seen from anywhere within.

   gcc -std=c11 -O2 -I. tests/test_photon_parallax.c -lcmocka -lm -lpthread */
#define _POSIX_C_SOURCE 200809L
#include "cmocka_prelude.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#include "chi_square.h"
#include "rng.h"

#define PI 3.14159265358979323846
#define OK(call) assert_int_equal((call), GPH_OK)

/* ---- helpers */

static float dot(const float a[3], const float b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void normalise(float d[3])
{
    float r = 1 / sqrtf(dot(d, d));
    for (int k = 0; k < 3; ++k)
        d[k] *= r;
}

/* The unit cube as one cube of the grid; c: photons before a voxel is cut. */
static gph_field *one_cube(float c)
{
    gph_desc d = {.bounds_max = {1, 1, 1}, .grid_cells = 1, .split_photons = c, .no_gate = true};
    gph_field *f;
    OK(gph_create(&d, &f));
    return f;
}

/* A ball above the cube that shines, and a glow from everywhere. */
static const float lamp[4] = {0.5f, 0.4f, 1.9f, 0.05f};
#define SHARE 0.8f /* of the photons, that come from the lamp */

static void position(float p[3])
{
    for (int k = 0; k < 3; ++k)
        p[k] = rndf();
}

/* Where a photon comes from that arrives at p, and how far it flew. */
static float arrival(const float p[3], float from[3])
{
    float away = 0;
    random_direction(from);
    if (rndf() >= SHARE)
        return 3;
    for (int k = 0; k < 3; ++k) {
        from[k] = lamp[k] + lamp[3] * from[k] - p[k];
        away += from[k] * from[k];
    }
    normalise(from);
    return sqrtf(away);
}

/* n photons anywhere in the cube, and as many touches; far: distances are not told. */
static void record(gph_stream *stream, uint32_t n, bool far)
{
    for (uint32_t i = 0; i < n; ++i) {
        float p[3], from[3], away;
        position(p);
        away = arrival(p, from);
        gph_vertex v = gph_make_vertex(p, 0, 0, 0, 0, GPH_TOUCH_ONLY);
        gph_photon q = gph_make_photon(p, from, far ? INFINITY : away, 1);
        OK(gph_record_vertices(stream, &v, 1));
        OK(gph_record_photons(stream, &q, 1));
    }
}

static void pass(gph_field *f, uint32_t n, bool far)
{
    gph_stream *stream;
    OK(gph_stream_create(f, &stream));
    record(stream, n, far);
    OK(gph_accumulate(f, &stream, 1, NULL, NULL));
    gph_stream_destroy(stream);
    OK(gph_validate(f));
    OK(gph_refine(f, NULL, NULL));
    OK(gph_validate(f));
}

static gph_field *learned(float c, uint32_t n, int passes, bool far)
{
    gph_field *f = one_cube(c);
    for (int k = 0; k < passes; ++k)
        pass(f, n, far);
    return f;
}

static gph_handle find(const gph_field *f, const float p[3], const float *normal)
{
    gph_view v = gph_get_view(f);
    gph_handle h;
    gph_find(&v, p, normal, NULL, &h);
    return h;
}

static void at_place(double z, double phi, float d[3])
{
    double r = sqrt(1 - z * z);
    d[0] = (float)(r * cos(phi));
    d[1] = (float)(r * sin(phi));
    d[2] = (float)z;
}

/* integral of h^2 / p over (integral of h)^2 for what arrives from the lamp, mean over places: 1 is perfect. */
static double score(const gph_field *f)
{
    double sum = 0;
    enum { PLACES = 300, RAYS = 64 };
    for (int i = 0; i < PLACES; ++i) {
        float p[3], d[3], middle[3], s[3], t[3], away;
        position(p);
        for (int k = 0; k < 3; ++k)
            middle[k] = lamp[k] - p[k];
        away = sqrtf(dot(middle, middle));
        normalise(middle);
        float a[3] = {fabsf(middle[0]) < 0.5f ? 1.0f : 0.0f, fabsf(middle[0]) < 0.5f ? 0.0f : 1.0f, 0};
        for (int k = 0; k < 3; ++k)
            s[k] = middle[(k + 1) % 3] * a[(k + 2) % 3] - middle[(k + 2) % 3] * a[(k + 1) % 3];
        normalise(s);
        for (int k = 0; k < 3; ++k)
            t[k] = middle[(k + 1) % 3] * s[(k + 2) % 3] - middle[(k + 2) % 3] * s[(k + 1) % 3];
        gph_handle h = find(f, p, NULL);
        double edge = cos(asin((double)(lamp[3] / away))), part = 0; /* even radiance over the cone */
        for (int r = 0; r < RAYS; ++r) {
            double w = 1 - rnd() * (1 - edge), phi = 2 * PI * rnd(), x = sqrt(1 - w * w);
            for (int k = 0; k < 3; ++k)
                d[k] = (float)(w * (double)middle[k] + x * (cos(phi) * (double)s[k] + sin(phi) * (double)t[k]));
            part += 1 / (2 * PI * (1 - edge) * (double)gph_pdf(&h, d));
        }
        sum += part / RAYS;
    }
    return sum / PLACES;
}

/* ---- the map */

static void random_offset(float o[3])
{
    float l = rng_next() % 4 == 0 ? GPH_MOST_OFFSET : rng_next() % 4 == 0 ? 0 : GPH_MOST_OFFSET * rndf();
    random_direction(o);
    for (int k = 0; k < 3; ++k)
        o[k] *= l * 0.9999999f;
}

/* The point of the unit sphere that is seen from o in direction d, in double. */
static void sphere_point(const float o[3], const double d[3], double out[3])
{
    double b = 0, l = 0, n = 0;
    for (int k = 0; k < 3; ++k)
        n += d[k] * d[k];
    n = sqrt(n);
    for (int k = 0; k < 3; ++k) {
        b += (double)o[k] * d[k] / n;
        l += (double)o[k] * (double)o[k];
    }
    for (int k = 0; k < 3; ++k)
        out[k] = (double)o[k] + (sqrt(1 - l + b * b) - b) * d[k] / n;
}

static void test_map_and_its_solid_angle(void **state)
{
    (void)state;
    double worst = 0, worst_area = 0, worst_back = 0;
    seed(1);
    for (int i = 0; i < 20000; ++i) {
        float o[3], d[3], seen[3], back[3], s[3];
        double e[3][3], point[3][3], n = 0, area = 0, h = 1e-5;
        random_offset(o);
        random_direction(d);
        random_direction(s);
        float scale = gph_to_pivot(o, d, seen);
        for (int k = 0; k < 3; ++k) { /* two steps at right angles to d and each other */
            e[1][k] = (double)s[k] - (double)dot(s, d) * (double)d[k];
            n += e[1][k] * e[1][k];
        }
        for (int k = 0; k < 3; ++k)
            e[1][k] /= sqrt(n);
        for (int k = 0; k < 3; ++k)
            e[2][k] = (double)d[(k + 1) % 3] * e[1][(k + 2) % 3] - (double)d[(k + 2) % 3] * e[1][(k + 1) % 3];
        for (int j = 0; j < 3; ++j) {
            double to[3];
            for (int k = 0; k < 3; ++k)
                to[k] = (double)d[k] + (j ? h * e[j][k] : 0);
            sphere_point(o, to, point[j]);
        }
        for (int k = 0; k < 3; ++k) {
            int p = (k + 1) % 3, q = (k + 2) % 3;
            double c = (point[1][p] - point[0][p]) * (point[2][q] - point[0][q]) -
                       (point[1][q] - point[0][q]) * (point[2][p] - point[0][p]);
            area += c * c;
            worst = fmax(worst, fabs(point[0][k] - (double)seen[k]));
        }
        worst_area = fmax(worst_area, fabs(sqrt(area) / (h * h) / (double)scale - 1));
        memcpy(back, seen, sizeof back);
        gph_from_pivot(o, back);
        for (int k = 0; k < 3; ++k)
            worst_back = fmax(worst_back, fabs((double)(back[k] - d[k])));
    }
    print_message("point %.1e, solid angle %.1e, and back %.1e\n", worst, worst_area, worst_back);
    assert_true(worst < 4e-7 && worst_area < 2e-4 && worst_back < 2e-6);
}

static void test_far_light_changes_no_bit(void **state)
{
    (void)state;
    const float odd[4][3] = {{NAN, 0, 0}, {INFINITY, 1, 0}, {3e38f, -3e38f, 0}, {0, 0, 0}};
    gph_field *f;
    seed(2);
    f = learned(1e9f, 20000, 2, true);
    gph_view v = gph_get_view(f);
    for (int i = 0; i < 2000; ++i) {
        float p[3], n[3], d[3], w[3], x[3], u[2] = {rndf(), rndf()};
        gph_handle here, pivot;
        position(p);
        random_direction(n);
        random_direction(d);
        here = find(f, p, NULL);
        gph_set_voxel(&v, here.voxel, &pivot);
        assert_memory_equal(&here, &pivot, sizeof here);
        assert_true(gph_pdf(&here, d) == gph_pdf(&pivot, d) && gph_sample(&here, u, w) == gph_sample(&pivot, u, x));
        assert_memory_equal(w, x, sizeof w);
    }
    gph_destroy(f);
    f = learned(1e9f, 20000, 2, false);
    for (int i = 0; i < 4; ++i) { /* no more than wrong: finite, and a density */
        float d[3] = {0, 0.6f, 0.8f};
        gph_handle h = find(f, odd[i], NULL);
        assert_true(dot(h.offset, h.offset) <= 0.6401f);
        assert_true(gph_pdf(&h, d) > 0 && gph_pdf(&h, d) < 1e6f && gph_pdf(&h, odd[i]) >= 0);
    }
    gph_destroy(f);
}

/* ---- densities */

static void test_density_integrates_to_one(void **state)
{
    (void)state;
    enum { N = 1024 };
    double worst = 0;
    seed(3);
    gph_field *f = learned(1e9f, 20000, 2, false);
    assert_true(f->voxels[0].s.nearness > 0.4f);
    for (int i = 0; i < 12; ++i) {
        float p[3], n[3];
        double sum = 0;
        position(p);
        random_direction(n);
        gph_handle h = find(f, p, i % 2 ? n : NULL);
        for (int y = 0; y < N; ++y)
            for (int x = 0; x < 2 * N; ++x) {
                float d[3];
                at_place((y + rnd()) * 2 / N - 1, PI * (x + rnd()) / N, d);
                sum += (double)gph_pdf(&h, d);
            }
        worst = fmax(worst, fabs(sum * 4 * PI / (2.0 * N * N) - 1));
    }
    print_message("integral - 1: %.1e\n", worst); /* the grid's own error: 1e-3 */
    assert_true(worst < 4e-3);
    gph_destroy(f);
}

/* Sampled directions against the density's integrals over 16 x 32 squares, and against gph_pdf. */
static void samples_follow(const gph_handle *h, uint32_t n)
{
    enum { X = 32, Y = 16, SUB = 48 };
    static double expected[X * Y], seen[X * Y];
    memset(seen, 0, sizeof seen);
    for (int k = 0; k < X * Y; ++k) {
        expected[k] = 0;
        for (int s = 0; s < SUB * SUB; ++s) {
            float d[3];
            at_place((k / X + (s / SUB + rnd()) / SUB) * 2 / Y - 1, (k % X + (s % SUB + rnd()) / SUB) * 2 * PI / X, d);
            expected[k] += (double)gph_pdf(h, d) * 4 * PI / (X * Y) / (SUB * SUB) * n;
        }
    }
    for (uint32_t i = 0; i < n; ++i) {
        float u[2] = {rndf(), rndf()}, d[3];
        float pdf = gph_sample(h, u, d);
        assert_true(pdf == gph_pdf(h, d) && pdf > 0 && fabsf(dot(d, d) - 1) < 1e-5f);
        seen[gph_bin(Y, X, d)] += 1;
    }
    double off = counts_deviate(expected, seen, X * Y, 2e-3); /* of the integral */
    if (off > 4.5)
        fail_msg("counts are %g standard deviations off", off);
}

static void test_samples_follow_the_density(void **state)
{
    (void)state;
    seed(4);
    gph_field *f = learned(1e9f, 20000, 2, false);
    for (int i = 0; i < 10; ++i) {
        float p[3], n[3];
        position(p);
        random_direction(n);
        gph_handle h = find(f, p, i % 2 ? n : NULL);
        samples_follow(&h, 60000);
    }
    gph_destroy(f);
}

static void test_sampling_is_monotone_as_seen_from_the_pivot(void **state)
{
    (void)state;
    seed(5);
    gph_field *f = learned(1e9f, 20000, 2, false);
    for (int i = 0; i < 20; ++i) {
        float p[3], before = -1;
        position(p);
        gph_handle h = find(f, p, NULL);
        for (int k = 0; k < 4000; ++k) {
            float u[2] = {(float)k / 4000, 0.3f}, d[3], seen[3];
            gph_sample(&h, u, d);
            gph_to_pivot(h.offset, d, seen);
            assert_true(seen[2] >= before - 2e-6f);
            before = seen[2];
        }
    }
    gph_destroy(f);
}

static void test_batches_equal_single_queries(void **state)
{
    (void)state;
    enum { N = 2003 };
    static gph_handle handles[N];
    static float u[N][2], dir[N][4], pdf[N], in[N][3], p[N][3], normal[N][3], alpha[N];
    seed(6);
    gph_field *f = learned(1000, 20000, 3, false);
    gph_view v = gph_get_view(f);
    for (uint32_t i = 0; i < N; ++i) {
        for (int k = 0; k < 3; ++k)
            p[i][k] = 1.2f * rndf() - 0.1f; /* outside of the field too */
        random_direction(normal[i]);
        if (i % 2)
            memset(normal[i], 0, sizeof normal[i]);
        random_direction(in[i]);
        u[i][0] = rndf();
        u[i][1] = rndf();
    }
    gph_find_batch(&v, N, NULL, p[0], sizeof p[0], normal[0], sizeof normal[0], NULL, 0, handles, alpha);
    gph_sample_batch(&v, N, NULL, handles, u[0], sizeof u[0], dir[0], sizeof dir[0], pdf);
    for (uint32_t i = 0; i < N; ++i) {
        gph_handle h = find(f, p[i], normal[i]);
        float d[3];
        assert_memory_equal(&h, &handles[i], sizeof h);
        assert_true(gph_sample(&h, u[i], d) == pdf[i]);
        assert_memory_equal(d, dir[i], sizeof d);
    }
    gph_pdf_batch(&v, N, NULL, handles, in[0], sizeof in[0], pdf);
    for (uint32_t i = 0; i < N; ++i)
        assert_true(gph_pdf(&handles[i], in[i]) == pdf[i]);
    gph_destroy(f);
}

/* ---- learning */

static void test_a_near_lamp_is_sharp_from_everywhere(void **state)
{
    (void)state;
    double far, near, later, cut;
    seed(7);
    gph_field *f = learned(1e9f, 3000, 1, true);
    far = score(f);
    gph_destroy(f);
    f = learned(1e9f, 3000, 1, false); /* the first pass does it: its photons are kept until they can be seen right */
    near = score(f);
    assert_true(fabsf(1 / f->voxels[0].s.nearness - 1.45f) < 0.15f); /* the mean of 1 / distance, from the cube */
    pass(f, 3000, false);
    pass(f, 3000, false);
    later = score(f);
    gph_destroy(f);
    f = learned(2000, 3000, 3, false);
    assert_true(f->voxel_count >= 2);
    cut = score(f);
    gph_destroy(f);
    print_message("second moment: far %.1f, near %.1f, after three passes %.1f, in several voxels %.1f\n", far, near,
                  later, cut);
    assert_true(near < 0.5 * far && later < 0.5 * far && cut < 0.5 * far);
}

/* Light that is far and sharp decides, though the glow of what is near brings as much. */
static void test_a_sharp_sun_is_not_smeared_by_a_near_glow(void **state)
{
    (void)state;
    enum { N = 20000 };
    const float sun[3] = {0.36f, 0.48f, 0.8f}, place[3] = {0.9f, 0.1f, 0.2f};
    gph_field *f = one_cube(1e9f);
    gph_stream *stream;
    OK(gph_stream_create(f, &stream));
    seed(8);
    for (int i = 0; i < N; ++i) {
        float p[3], d[3];
        position(p);
        random_direction(d);
        gph_vertex v = gph_make_vertex(p, 0, 0, 0, 0, GPH_TOUCH_ONLY);
        gph_photon q = gph_make_photon(p, i % 2 ? sun : d, i % 2 ? INFINITY : 0.7f, 1);
        OK(gph_record_vertices(stream, &v, 1));
        OK(gph_record_photons(stream, &q, 1));
    }
    OK(gph_accumulate(f, &stream, 1, NULL, NULL));
    OK(gph_refine(f, NULL, NULL));
    gph_handle h = find(f, place, NULL);
    print_message("nearness %g, density of the sun %g\n", (double)f->voxels[0].s.nearness, (double)gph_pdf(&h, sun));
    assert_true(f->voxels[0].s.nearness < 0.01f && gph_pdf(&h, sun) > 0.3f * 2048 / (4 * (float)PI));
    gph_stream_destroy(stream);
    gph_destroy(f);
}

static void test_moved_histograms_keep_their_light(void **state)
{
    (void)state;
    seed(9);
    for (int dense = 0; dense < 2; ++dense) {
        gph_field *f = learned(1e9f, dense ? 20000 : 100, 1, false);
        gphi_voxel *v = &f->voxels[0];
        const float pivot[3] = {0.25f, 0.7f, 0.8f};
        double flux = 0, moved = 0, there = 0;
        uint32_t photons = 0, moved_photons = 0, n = gphi_bins(v, f->bins);
        assert_int_equal(v->s.form, dense ? GPHI_FORM_DENSE : GPHI_FORM_SPARSE);
        for (uint32_t i = 0; i < n; ++i) {
            gphi_bin b = gphi_get_bin(v, f->bins, i);
            flux += (double)(*b.old + *b.now);
            photons += (uint32_t)(*b.count_old + *b.count_now);
        }
        gphi_move_bins(v, f->desc.rows, pivot);
        memcpy(v->s.pivot, pivot, sizeof pivot);
        OK(gph_validate(f));
        for (uint32_t i = 0; i < gphi_bins(v, f->bins); ++i) {
            gphi_bin b = gphi_get_bin(v, f->bins, i);
            float d[3], to[3];
            moved += (double)(*b.old + *b.now);
            moved_photons += (uint32_t)(*b.count_old + *b.count_now);
            at_place((b.at / 64 + 0.5) / 16 - 1, (b.at % 64 + 0.5) * PI / 32, d);
            for (int k = 0; k < 3; ++k)
                to[k] = lamp[k] - pivot[k];
            normalise(to);
            there += dot(d, to) > 0.94f ? (double)(*b.old + *b.now) : 0;
        }
        assert_true(photons == moved_photons && fabs(flux - moved) < 1e-4 * flux);
        assert_true(there > 0.75 * flux); /* the lamp's share is 0.8 */
        gph_destroy(f);
    }
}

/* Two machines make a cube anew in the same pass: what one saw is moved to where the other sees it from. */
static void test_merged_voxels_see_the_lamp(void **state)
{
    (void)state;
    size_t size;
    seed(10);
    gph_field *a = one_cube(1e9f), *b = NULL;
    OK(gph_refine(a, NULL, NULL)); /* no photons in the first pass */
    char *data = malloc(gph_save_bound(a));
    OK(gph_save(a, data, gph_save_bound(a), &size));
    OK(gph_load(NULL, data, size, &b));
    free(data);
    for (int k = 0; k < 2; ++k) {
        gph_field *f[2] = {a, b};
        gph_stream *stream;
        for (int m = 0; m < 2; ++m) {
            OK(gph_stream_create(f[m], &stream));
            record(stream, m ? 2000 : 500, false);
            OK(gph_accumulate(f[m], &stream, 1, NULL, NULL));
            gph_stream_destroy(stream);
            if (k == 0)
                OK(gph_refine(f[m], NULL, NULL));
        }
    }
    assert_true(a->voxels[0].s.nearness != b->voxels[0].s.nearness && b->voxels[0].s.nearness > 0.4f);
    b->voxels[0].s.pivot[0] += 0.1f;
    OK(gph_merge(a, b, NULL, NULL));
    OK(gph_validate(a));
    OK(gph_refine(a, NULL, NULL));
    assert_true(gph_photons_at(a, lamp, NULL) < 0 && a->voxels[0].s.photons == 3000);
    assert_true(score(a) < 200);
    print_message("merged: %.1f\n", score(a));
    gph_destroy(a);
    gph_destroy(b);
}

static void test_distances_that_are_none_are_refused(void **state)
{
    (void)state;
    const float bad[] = {0, -1, NAN, -INFINITY, -0.0f}, good[] = {INFINITY, 1e-45f, 1e-30f, 3e38f, 1};
    const float p[3] = {0.5f, 0.5f, 0.2f}, w[3] = {0, 0, 1};
    gph_field *f = one_cube(1e9f);
    gph_vertex v = gph_make_vertex(p, 0, 0, 0, 0, GPH_TOUCH_ONLY);
    gph_stream *stream;
    gph_stats stats;
    OK(gph_stream_create(f, &stream));
    for (int k = 0; k < 3; ++k) {
        OK(gph_record_vertices(stream, &v, 1));
        for (int i = 0; i < 5; ++i) {
            gph_photon q[2] = {gph_make_photon(p, w, bad[i], 1), gph_make_photon(p, w, good[i], 1)};
            OK(gph_record_photons(stream, q, 2));
        }
        OK(gph_accumulate(f, &stream, 1, NULL, NULL));
        gph_stream_clear(stream);
        OK(gph_validate(f));
        OK(gph_refine(f, NULL, NULL));
        OK(gph_validate(f));
    }
    gph_get_stats(f, &stats);
    assert_int_equal(stats.refused, 15);
    assert_int_equal(stats.photons, 15);
    assert_true(f->voxels[0].s.nearness > 0 && f->voxels[0].s.nearness < 0.81f); /* within 0.7 radii of the cube */
    gph_handle h = find(f, p, NULL);
    assert_true(gph_pdf(&h, w) > 1 && gph_pdf(&h, w) < 1e6f);
    gph_stream_destroy(stream);
    gph_destroy(f);
}

int main(void)
{
    const struct CMUnitTest tests[] = {cmocka_unit_test(test_map_and_its_solid_angle),
                                       cmocka_unit_test(test_far_light_changes_no_bit),
                                       cmocka_unit_test(test_density_integrates_to_one),
                                       cmocka_unit_test(test_samples_follow_the_density),
                                       cmocka_unit_test(test_sampling_is_monotone_as_seen_from_the_pivot),
                                       cmocka_unit_test(test_batches_equal_single_queries),
                                       cmocka_unit_test(test_a_near_lamp_is_sharp_from_everywhere),
                                       cmocka_unit_test(test_a_sharp_sun_is_not_smeared_by_a_near_glow),
                                       cmocka_unit_test(test_moved_histograms_keep_their_light),
                                       cmocka_unit_test(test_merged_voxels_see_the_lamp),
                                       cmocka_unit_test(test_distances_that_are_none_are_refused)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
