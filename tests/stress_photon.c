/* stress_photon.c: guide_photon.h under hostile and extreme input. See stress.h; `make stress` runs it.

   gcc -std=c11 -O2 -I. tests/stress_photon.c -lm -lpthread */
#define _XOPEN_SOURCE 700
#include "stress.h"

#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#define MOST 6000 /* samples of a batch */

static gph_vertex vertices[MOST];
static gph_photon photons[MOST];

/* ---- fields */

static gph_desc any_desc(stress *s)
{
    gph_desc d;
    memset(&d, 0, sizeof d);
    if (stress_chance(s, 0.7))
        d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = (float)stress_log(s, 1e-6, 1e6);
    d.grid_cells = 1 + stress_below(s, 12);
    d.rows = 16u << stress_below(s, 2);
    d.split_photons = (float)stress_log(s, 16, 2000);
    d.max_levels = 1 + stress_below(s, 24);
    d.keep_passes = 1 + stress_below(s, 3);
    d.cloud_photons = stress_chance(s, 0.3) ? 1024 : 0;
    d.max_bytes = stress_chance(s, 0.2) ? 1u << 20 : 1u << 26;
    d.repair = (gph_repair)stress_below(s, GPH_REPAIR_COUNT_);
    d.sigma = stress_chance(s, 0.3) ? (float)stress_log(s, 0.011, 15.9) : 0;
    d.pyramid_levels = 1 + stress_below(s, 5);
    d.alpha_mode = (gph_alpha_mode)stress_below(s, GPH_ALPHA_VARIANCE + 1);
    d.ratio_samples = 1 + stress_below(s, 100);
    d.no_gate = stress_chance(s, 0.3);
    d.gate_probe = 1 + stress_below(s, 3);
    return d;
}

/* n vertices and n photons; returns how many are bad, by the documented rules. */
static uint32_t make_samples(stress *s, const recipe *r, const gph_desc *d, uint32_t n)
{
    float high[3] = {1, 1, 1};
    uint32_t bad = 0;
    if (d->bounds_max[0] > d->bounds_min[0])
        memcpy(high, d->bounds_max, sizeof high);
    for (uint32_t i = 0; i < n; ++i) {
        float p[3], w[3], flux, l, distance = stress_chance(s, 0.02) ? hostile_number(s) : 1, value, mix, pb, pg;
        bool place = true;
        any_position(s, r, d->bounds_min, high, p);
        any_direction(s, r, w);
        flux = any_value(s, r, w);
        for (int k = 0; k < 3; ++k)
            place = place && (double)fabsf(p[k]) < 9.9e29;
        l = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
        photons[i] = gph_make_photon(p, w, distance, flux);
        bad += !place || !(l > 1e-12f && l < 1e12f) || bad_value(flux) || !(distance > 0);
        value = any_value(s, r, w);
        mix = any_pdf(s, r);
        pb = any_pdf(s, r);
        pg = any_pdf(s, r);
        vertices[i] = gph_make_vertex(p, value, mix, pb, pg, stress_below(s, 3));
        bad += !place ||
               (vertices[i].strategy != GPH_TOUCH_ONLY && (bad_value(value) || !(mix > 0 && mix < INFINITY) ||
                                                           !(pb >= 0 && pb < INFINITY) || !(pg >= 0 && pg < INFINITY)));
    }
    return bad;
}

/* ---- checks */

/* It holds together, and answers anywhere: densities positive and finite, of what was sampled too, and their mean over
   even directions is 1 / (4 pi). */
static void check_field(stress *s, gph_field *f)
{
    gph_view v = gph_get_view(f);
    uint32_t fault = s->sabotage && stress_chance(s, 0.5) && v.voxel_count ? stress_below(s, 3) : 3;
    gph_voxel *voxel = gphi_block_voxels(f->block);
    STRESS_CHECK(s, gph_validate(f) == GPH_OK, "does not validate");
    for (int i = 0; i < 12 && !s->failed; ++i) {
        float p[3], u[3], w[3], n[3], pdf;
        double sum = 0;
        gph_handle h;
        recipe r = any_recipe(s, true);
        float low[3] = {0, 0, 0}, high[3] = {1, 1, 1};
        any_position(s, &r, low, high, p);
        any_random(s, u);
        u[2] = u[0];
        gph_find(&v, p, NULL, stress_chance(s, 0.5) ? u : NULL, &h);
        if (i < 6 && v.voxel_count)
            gph_set_voxel(&v, stress_below(s, v.voxel_count), &h);
        pdf = gph_sample(&h, u, w);
        STRESS_CHECK(s, pdf > 0 && pdf < 1e6f && h.alpha > 0.04f && h.alpha <= 1, "density %g, alpha %g", (double)pdf,
                     (double)h.alpha);
        for (uint32_t row = 0; row < h.rows; ++row)
            for (uint32_t c = 0; c < h.columns; ++c) {
                double z = (row + 0.5) * 2 / h.rows - 1, phi = 2 * PI * (c + 0.5) / h.columns, x = sqrt(1 - z * z);
                float d[3] = {(float)(x * cos(phi)), (float)(x * sin(phi)), (float)z}, seen[3];
                gph_from_pivot(h.offset,
                               d); /* equal areas of the pivot's sphere, with bins that are those of the map */
                sum += (double)gph_pdf(&h, d) / (double)gph_to_pivot(h.offset, d, seen) * 4 * PI / (h.rows * h.columns);
            }
        STRESS_CHECK(s, fabs(sum - 1) < 1e-5, "integral %g", sum);
        any_normal(s, n);
        gph_find(&v, p, n, NULL, &h);
        pdf = gph_sample(&h, u, w);
        STRESS_CHECK(s, pdf < INFINITY || !isfinite(n[0] + n[1] + n[2]) || fabsf(n[0]) > 2, "with a normal: %g",
                     (double)pdf);
    }
    if (fault < 3) { /* damage that validation must find */
        s->deviating = true;
        if (fault == 0)
            voxel[0].alpha = -1;
        else if (fault == 1)
            voxel[0].map = f->block->maps;
        else
            f->voxels[0].s.photons = -1;
        STRESS_CHECK(s, gph_validate(f) == GPH_OK, "damage");
        voxel[0].alpha = 1;
        voxel[0].map = GPH_NONE;
        f->voxels[0].s.photons = 0;
    }
}

static void check_counts(stress *s, const gph_field *f, uint64_t told, uint64_t bad)
{
    gph_stats t;
    uint64_t sum, fault = s->sabotage && stress_chance(s, 0.5);
    s->deviating = s->deviating || fault;
    gph_get_stats(f, &t);
    sum = t.vertices + t.photons + t.unread + t.dark + t.refused + t.lost + t.denied;
    STRESS_CHECK(s, sum == told + fault, "%llu counted, %llu told", (unsigned long long)sum, (unsigned long long)told);
    STRESS_CHECK(s, t.lost || t.refused == bad, "%llu refused, %llu bad", (unsigned long long)t.refused,
                 (unsigned long long)bad);
}

/* ---- groups */

static void hostile_samples(stress *s)
{
    gph_desc d = any_desc(s);
    gph_field *f = NULL;
    gph_stream *stream = NULL;
    uint64_t told = 0, bad = 0;
    STRESS_CHECK(s, gph_create(&d, &f) == GPH_OK && gph_stream_create(f, &stream) == GPH_OK, "create");
    for (int pass = 0; pass < 4 && !s->failed; ++pass) {
        recipe r = any_recipe(s, stress_chance(s, 0.7));
        uint32_t n = some(s, MOST);
        bad += make_samples(s, &r, &d, n);
        told += 2 * n;
        STRESS_CHECK(s, gph_record_vertices(stream, vertices, n) == GPH_OK, "record");
        STRESS_CHECK(s, gph_record_photons(stream, photons, n) == GPH_OK, "record");
        STRESS_CHECK(s, gph_accumulate(f, &stream, 1, NULL, NULL) == GPH_OK, "accumulate");
        gph_stream_clear(stream);
        STRESS_CHECK(s, gph_refine(f, NULL, NULL) == GPH_OK, "refine");
        check_counts(s, f, told, bad);
        check_field(s, f);
        STRESS_CHECK(s, f->stats.bytes <= 0 || gphi_held(f) <= d.max_bytes, "%llu bytes held",
                     (unsigned long long)gphi_held(f));
    }
    gph_stream_destroy(stream);
    gph_destroy(f);
    stress_survived(s);
}

static const stress_limit limits[] = {STRESS_LIMIT(gph_desc, grid_cells, true, 1, 1024),
                                      STRESS_LIMIT(gph_desc, split_photons, false, 16, 1e9),
                                      STRESS_LIMIT(gph_desc, max_levels, true, 1, 24),
                                      STRESS_LIMIT(gph_desc, keep_passes, true, 1, 1000),
                                      STRESS_LIMIT(gph_desc, pyramid_levels, true, 1, 5),
                                      STRESS_LIMIT(gph_desc, alpha, false, 0.05, 1),
                                      STRESS_LIMIT(gph_desc, ratio_samples, true, 1, 1e9),
                                      STRESS_LIMIT(gph_desc, uniform, false, 1e-4, 1),
                                      STRESS_LIMIT(gph_desc, gate_margin, false, 0.001, 10),
                                      STRESS_LIMIT(gph_desc, gate_probe, true, 1, 1000),
                                      STRESS_LIMIT(gph_desc, cloud_photons, true, 1024, 268435456)};

static void descriptors(stress *s)
{
    gph_desc d = any_desc(s);
    double extent;
    bool bad = false;
    gph_field *f = NULL;
    gph_result result;
    if (stress_chance(s, 0.7))
        bad = set_extreme(s, &d, limits, sizeof limits / sizeof *limits);
    if (stress_chance(s, 0.6))
        bad = !set_bounds(s, d.bounds_min, d.bounds_max, &extent) || bad;
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, bad = !bad;
    result = gph_create(&d, &f);
    STRESS_CHECK(s, (result != GPH_OK) == bad && (result == GPH_OK) == (f != NULL), "%s, should be %s",
                 gph_result_string(result), bad ? "refused" : "accepted");
    if (f)
        check_field(s, f);
    gph_destroy(f);
    stress_end(s, result != GPH_OK);
}

/* A run again and again, with the first, second, ... request failing, or each k-th: reported, survived, no leak. */
static void failing_allocator(stress *s)
{
    uint64_t start = s->rng;
    bool every = stress_chance(s, 0.5);
    long requests = 1000;
    for (long pass = 0; pass < 12; ++pass) {
        stress_memory memory = {0};
        gph_desc d;
        gph_field *f = NULL;
        gph_stream *stream = NULL;
        uint64_t told = 0, bad = 0;
        long failed = 0, k = pass == 0 ? 0 : every ? 1 + pass : 1 + (pass * 7919) % requests;
        s->rng = start;
        d = any_desc(s);
        d.allocate = stress_allocate;
        d.release = stress_release;
        d.user = &memory;
        *(every ? &memory.fail_every : &memory.fail_at) = k;
        failed += gph_create(&d, &f) != GPH_OK;
        failed += f && gph_stream_create(f, &stream) != GPH_OK;
        for (int i = 0; i < 3 && stream; ++i) {
            recipe r = any_recipe(s, stress_chance(s, 0.3));
            uint32_t n = some(s, 2000);
            bad += make_samples(s, &r, &d, n);
            failed += gph_record_vertices(stream, vertices, n) != GPH_OK;
            failed += gph_record_photons(stream, photons, n) != GPH_OK;
            failed += gph_accumulate(f, &stream, 1, NULL, NULL) != GPH_OK;
            told += 2 * n;
            gph_stream_clear(stream);
            failed += gph_refine(f, NULL, NULL) != GPH_OK;
        }
        requests = pass == 0 ? memory.requests : requests;
        memory.fail_at = memory.fail_every = 0;
        if (f) {
            STRESS_CHECK(s, gph_refine(f, NULL, NULL) == GPH_OK, "refine with memory again");
            check_counts(s, f, told, bad);
            check_field(s, f);
        }
        if (pass == 0)
            STRESS_CHECK(s, failed == 0, "a call failed without cause");
        gph_stream_destroy(stream);
        gph_destroy(f);
        STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
        stress_end(s, memory.failed > 0);
    }
}

/* ---- saves */

static void seal(unsigned char *data, size_t size)
{
    gphi_header h;
    if (size < sizeof h)
        return;
    memcpy(&h, data, sizeof h);
    h.size = size;
    h.checksum = gphi_hash_bytes(1, data + GPHI_CHECKED_FROM, size - GPHI_CHECKED_FROM);
    memcpy(data, &h, sizeof h);
}

static void learn(stress *s, gph_field *f, uint32_t n)
{
    recipe r = any_recipe(s, false);
    gph_stream *stream = NULL;
    make_samples(s, &r, gph_get_desc(f), n);
    STRESS_CHECK(s,
                 gph_stream_create(f, &stream) == GPH_OK && gph_record_vertices(stream, vertices, n) == GPH_OK &&
                     gph_record_photons(stream, photons, n) == GPH_OK &&
                     gph_accumulate(f, &stream, 1, NULL, NULL) == GPH_OK,
                 "learn");
    gph_stream_destroy(stream);
}

static unsigned char *trained_save(stress *s, size_t *size)
{
    gph_desc d = any_desc(s);
    unsigned char *data;
    gph_field *f;
    d.rows = 16;
    d.split_photons = 64;
    STRESS_CHECK(s, gph_create(&d, &f) == GPH_OK, "create");
    for (uint32_t pass = stress_below(s, 3); pass > 0; --pass) {
        learn(s, f, 300);
        STRESS_CHECK(s, gph_refine(f, NULL, NULL) == GPH_OK, "refine");
    }
    learn(s, f, 100);
    *size = gph_save_bound(f);
    data = malloc(*size);
    STRESS_CHECK(s, gph_save(f, data, *size, size) == GPH_OK, "save");
    gph_destroy(f);
    return data;
}

/* A forged save: no field, or one that is whole and can go on. */
static void try_save(stress *s, const unsigned char *data, size_t size, bool sealed, const char *how)
{
    stress_memory memory = {0};
    gph_desc d = {.allocate = stress_allocate, .release = stress_release, .user = &memory};
    unsigned char *exact = malloc(size ? size : 1); /* so that a sanitizer sees every byte beyond */
    gph_field *f;
    gph_result result;
    memcpy(exact, data, size);
    result = gph_load(&d, exact, size, &f);
    free(exact);
    STRESS_CHECK(s, (result == GPH_OK) == (f != NULL), "%s: %s, yet %s", how, gph_result_string(result),
                 f ? "a field" : "none");
    STRESS_CHECK(s, result == GPH_OK || result == GPH_BAD_FILE || result == GPH_BAD_VERSION || sealed, "%s: %s", how,
                 gph_result_string(result));
    STRESS_CHECK(s, result != GPH_OK || sealed || how[0] == 'u', "%s: loaded", how);
    if (f) {
        check_field(s, f);
        for (int pass = 0; pass < 2 && !s->failed; ++pass) {
            learn(s, f, 100);
            STRESS_CHECK(s, gph_refine(f, NULL, NULL) == GPH_OK && gph_validate(f) == GPH_OK, "%s: going on", how);
        }
        gph_destroy(f);
    }
    STRESS_CHECK(s, memory.live == 0, "%s: %ld leaks", how, memory.live);
    stress_end(s, f == NULL);
}

static void forged_saves(stress *s)
{
    size_t size, other_size;
    unsigned char *data = trained_save(s, &size), *other = trained_save(s, &other_size), *forged = malloc(size);
    try_save(s, data, size, false, "untouched");
    for (int i = 0; i < 30; ++i) {
        size_t n = size;
        bool sealed = stress_chance(s, 0.7);
        const char *how = "";
        memcpy(forged, data, size);
        for (uint32_t k = 1 + stress_below(s, 3); k > 0 && n > 0; --k)
            how = forge(s, forged, &n, other, other_size);
        if (sealed)
            seal(forged, n);
        if (!sealed && n == size && memcmp(forged, data, size) == 0)
            how = "untouched";
        try_save(s, forged, n, sealed, how);
    }
    free(data);
    free(other);
    free(forged);
}

/* Learning on threads gives the same bits as without. */
static void threads(stress *s)
{
    gph_desc d = any_desc(s);
    gph_field *f[2];
    unsigned char *data[2];
    size_t size[2];
    stress_crowd crowd = {1 + (int)stress_below(s, 8)};
    for (int k = 0; k < 2; ++k)
        STRESS_CHECK(s, gph_create(&d, &f[k]) == GPH_OK, "create");
    for (int pass = 0; pass < 3 && !s->failed; ++pass) {
        recipe r = any_recipe(s, stress_chance(s, 0.3));
        uint32_t n = some(s, MOST);
        make_samples(s, &r, &d, n);
        for (int k = 0; k < 2; ++k) {
            gph_stream *stream = NULL;
            STRESS_CHECK(s,
                         gph_stream_create(f[k], &stream) == GPH_OK &&
                             gph_record_vertices(stream, vertices, n) == GPH_OK &&
                             gph_record_photons(stream, photons, n) == GPH_OK,
                         "record");
            gph_accumulate(f[k], &stream, 1, k ? stress_parallel : NULL, &crowd);
            gph_refine(f[k], k ? stress_parallel : NULL, &crowd);
            gph_stream_destroy(stream);
            if (s->sabotage && k == 0) { /* a race's result: something else comes in */
                s->deviating = true;
                memset(photons[0].position, 0, sizeof photons[0].position);
                vertices[0] = gph_make_vertex(photons[0].position, 0, 0, 0, 0, GPH_TOUCH_ONLY);
            }
        }
    }
    for (int k = 0; k < 2; ++k) {
        data[k] = malloc(gph_save_bound(f[k]));
        gph_save(f[k], data[k], gph_save_bound(f[k]), &size[k]);
    }
    STRESS_CHECK(s, size[0] == size[1] && memcmp(data[0], data[1], size[0]) == 0, "other threads, another field");
    for (int k = 0; k < 2; ++k) {
        free(data[k]);
        gph_destroy(f[k]);
    }
    stress_survived(s);
}

int main(int argc, char **argv)
{
    static const stress_group groups[] = {
        {"photon-hostile-samples", hostile_samples, 2, false},
        {"photon-descriptors", descriptors, 1, true},
        {"photon-failing-allocator", failing_allocator, 2, true},
        {"photon-forged-saves", forged_saves, 3, true},
        {"photon-threads", threads, 1, false},
    };
    return stress_main(argc, argv, "photon", groups, (int)(sizeof groups / sizeof *groups));
}
