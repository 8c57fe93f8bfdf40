/* uninitialised.c: learns small fields with guide_kd.h and guide_photon.h, asks them, and prints a hash of all of it.
   Built by uninitialised.sh with stack and heap filled with different bytes: the hash may not depend on them. */
#include <stdio.h>
#include <stdlib.h>

#define GKD_IMPLEMENTATION
#include "guide_kd.h"
#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#include "rng.h"

#ifndef FILL /* what fresh memory holds */
#define FILL 0
#endif

enum { N = 12000, ASKED = 64 };
static gkd_training_sample samples[N];
static uint64_t hash = 1;
static const float mean_up[3] = {0, 0, 1};

static void *filled(void *user, size_t size)
{
    void *p = malloc(size);
    (void)user;
    return p ? memset(p, FILL, size) : NULL;
}

static void release(void *user, void *pointer)
{
    (void)user;
    free(pointer);
}

static void add(const void *data, size_t size) { hash = gkdi_hash_bytes(hash, data, size); }

static void direction(float d[3])
{
    float z = 2 * rndf() - 1, r = sqrtf(1 - z * z), s, c;
    gkd_circle(rndf(), &s, &c);
    d[0] = r * s;
    d[1] = r * c;
    d[2] = z;
}

/* Two lights, one of them near, a wall that lights one half, and zeros. */
static void make(const gkd_view *v, bool ask)
{
    for (int i = 0; i < N; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, d[3], u[2] = {rndf(), rndf()}, L, pdf = 0.0795774715f;
        gkd_handle h;
        direction(d);
        if (ask && i % 2) {
            gkd_find(v, p, i % 4 == 1 ? d : NULL, NULL, &h);
            pdf = gkd_sample(&h, u, d);
        }
        L = d[2] > 0.98f ? 100 : d[0] > 0.3f && p[1] > 0.4f ? 5 : i % 5 ? 0.2f : 0;
        samples[i] = gkd_make_scalar_sample(p, d, i % 3 ? NULL : d, d[2] > 0.98f ? 2 : INFINITY, L, L, L * p[0], pdf,
                                            0.0795774715f, i % 7 && ask ? pdf : 0);
        if (i % 501 == 0)
            samples[i].radiance = i % 2 ? NAN : GKD_REJECTED;
    }
}

static void ask(const gkd_view *v)
{
    static float p[ASKED][3], n[ASKED][3], u[ASKED][2], w[ASKED][3], pdf[ASKED], alpha[ASKED];
    static gkd_handle h[ASKED];
    memset(h, FILL, sizeof h);
    for (int i = 0; i < ASKED; ++i) {
        for (int k = 0; k < 3; ++k)
            p[i][k] = rndf();
        direction(n[i]);
        u[i][0] = rndf();
        u[i][1] = rndf();
    }
    for (int level = GKD_SIMD_SCALAR; level <= GKD_SIMD_NEON; ++level) {
        gkd_view at = *v;
        at.simd = (uint32_t)level;
        if (gkdi_simd((gkd_simd)level) != (gkd_simd)level)
            continue;
        gkd_find_batch(&at, ASKED, NULL, p[0], sizeof p[0], n[0], sizeof n[0], NULL, 0, h, alpha);
        gkd_sample_batch(&at, ASKED, NULL, h, u[0], sizeof u[0], w[0], sizeof w[0], pdf);
        add(w, sizeof w);
        add(pdf, sizeof pdf);
        add(alpha, sizeof alpha);
        gkd_pdf_batch(&at, ASKED, NULL, h, n[0], sizeof n[0], pdf);
        add(pdf, sizeof pdf);
        gkd_pdf_directions(&at, &h[3], ASKED, w[0], sizeof w[0], pdf);
        add(pdf, sizeof pdf);
    }
}

static bool learn(gkd_field *f, int pass)
{
    gkd_view v = gkd_get_view(f);
    gkd_stream *stream;
    size_t size, bound;
    void *data;
    bool good;
    make(&v, pass > 0);
    if (gkd_stream_create(f, &stream))
        return false;
    good = !gkd_record(stream, samples, N) && !gkd_accumulate(f, &stream, 1, NULL, NULL);
    gkd_stream_destroy(stream);
    for (int k = 0; k < 2 && good; ++k) { /* with samples that wait, and without */
        good = k == 0 || !gkd_refine(f, NULL, NULL, NULL);
        bound = gkd_save_bound(f);
        data = malloc(bound);
        good = good && data && !gkd_save(f, data, bound, &size) && !gkd_validate(f);
        if (good)
            add(data, size);
        free(data);
    }
    v = gkd_get_view(f);
    ask(&v);
    return good;
}

/* ---- photons */

static gph_photon photons[N];
static gph_vertex vertices[N];

/* Two lights; camera paths see two thirds of the box, later ones half of it. */
static void make_photons(const gph_view *v, int pass)
{
    for (int i = 0; i < N; ++i) {
        float p[3] = {rndf(), rndf(), rndf()}, q[3] = {rndf(), rndf(), rndf()}, d[3], u[2] = {rndf(), rndf()}, pdf;
        gph_handle h;
        direction(d);
        d[2] = i % 3 ? d[2] : 5;
        photons[i] = gph_make_photon(q, d, i % 401 ? 1 : NAN, i % 5 ? rndf() : 0);
        p[0] *= pass < 2 ? 0.67f : 0.5f;
        gph_find(v, p, i % 2 ? mean_up : NULL, NULL, &h);
        pdf = gph_sample(&h, u, d);
        vertices[i] = gph_make_vertex(p, d[2] > 0.9f ? 10 : 0.1f, i % 307 ? pdf : 0, 0.3f, i % 7 ? pdf : 0,
                                      i % 11 ? (uint32_t)i % 2 : GPH_TOUCH_ONLY);
    }
}

static void ask_photons(const gph_view *v)
{
    static float p[ASKED][3], n[ASKED][3], u[ASKED][3], w[ASKED][3], pdf[ASKED], alpha[ASKED];
    static gph_handle h[ASKED];
    memset(h, FILL, sizeof h);
    for (int i = 0; i < ASKED; ++i) {
        for (int k = 0; k < 3; ++k) {
            p[i][k] = rndf();
            u[i][k] = rndf();
        }
        direction(n[i]);
    }
    gph_find_batch(v, ASKED, NULL, p[0], sizeof p[0], n[0], sizeof n[0], u[0], sizeof u[0], h, alpha);
    gph_sample_batch(v, ASKED, NULL, h, u[0], sizeof u[0], w[0], sizeof w[0], pdf);
    add(w, sizeof w);
    add(pdf, sizeof pdf);
    add(alpha, sizeof alpha);
    for (int i = 0; i < ASKED; ++i)
        add(&h[i].reflected, sizeof h[i].reflected);
    gph_pdf_batch(v, ASKED, NULL, h, n[0], sizeof n[0], pdf);
    add(pdf, sizeof pdf);
}

/* The voxels' histograms go out, and come back as maps. */
static void exchange_maps(gph_field *f)
{
    uint32_t list[4], n = gph_changed_voxels(f, list, 4), bins = gph_get_desc(f)->rows * gph_get_desc(f)->rows * 2;
    float *features = malloc(4 * GPH_FEATURES * bins * sizeof *features), seen[4];
    if (!features)
        exit(1);
    n = n < 4 ? n : 4;
    gph_export_maps(f, list, n, features, seen);
    add(features, n * GPH_FEATURES * bins * sizeof *features);
    add(seen, n * sizeof *seen);
    for (uint32_t i = 1; i < n; ++i)
        memmove(features + i * bins, features + i * GPH_FEATURES * bins, bins * sizeof *features);
    gph_import_maps(f, list, n, features, NULL, NULL);
    free(features);
}

static bool learn_photons(gph_field *f, int pass)
{
    gph_view v = gph_get_view(f);
    gph_stream *stream;
    size_t size, bound;
    bool good;
    make_photons(&v, pass);
    if (gph_stream_create(f, &stream))
        return false;
    good = !gph_record_vertices(stream, vertices, N) && !gph_record_photons(stream, photons, N) &&
           !gph_accumulate(f, &stream, 1, NULL, NULL);
    gph_stream_destroy(stream);
    for (int k = 0; k < 2 && good; ++k) { /* before refine, when the first pass's photons wait, and after */
        void *data;
        good = k == 0 || !gph_refine(f, NULL, NULL);
        if (k == 1)
            exchange_maps(f);
        bound = gph_save_bound(f);
        data = malloc(bound);
        good = good && data && !gph_save(f, data, bound, &size) && !gph_validate(f);
        if (good)
            add(data, size);
        free(data);
    }
    v = gph_get_view(f);
    ask_photons(&v);
    return good;
}

/* Every repair, and voxels that are recycled. */
static bool photon_fields(void)
{
    for (int repair = GPH_REPAIR_NONE; repair < GPH_REPAIR_COUNT_; ++repair) {
        gph_desc d;
        gph_field *f;
        gph_stats s;
        memset(&d, 0, sizeof d);
        d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = repair == GPH_REPAIR_NONE ? 0 : 1;
        d.grid_cells = 3;
        d.rows = repair == GPH_REPAIR_GAUSSIAN ? 32 : 16;
        d.repair = (gph_repair)repair;
        d.alpha_mode = repair == GPH_REPAIR_NONE ? GPH_ALPHA_RATIO : GPH_ALPHA_VARIANCE;
        d.split_photons = 300;
        d.keep_passes = 1;
        d.allocate = filled;
        d.release = release;
        if (gph_create(&d, &f))
            return false;
        for (int pass = 0; pass < 4; ++pass)
            if (!learn_photons(f, pass))
                return false;
        gph_get_stats(f, &s);
        if (s.splits < 4 || s.recycled < 1 || s.maps < 9)
            return false;
        gph_destroy(f);
    }
    return true;
}

int main(void)
{
    for (int kind = 0; kind < 3; ++kind) {
        gkd_desc d;
        gkd_field *f;
        memset(&d, 0, sizeof d);
        d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
        d.split = kind == 1 ? GKD_SPLIT_COUNT : GKD_SPLIT_SIGNATURE;
        d.min_samples = 200;
        d.update_samples = 5000;
        d.keep_signatures = kind == 2 ? 0.5f : 0;
        d.published_tests = kind == 2;
        d.allocate = filled;
        d.release = release;
        if (gkd_create(&d, &f))
            return 1;
        for (int pass = 0; pass < 3; ++pass)
            if (!learn(f, pass))
                return 1;
        if (gkd_cell_count(f) < 4)
            return 1;
        gkd_destroy(f);
    }
    if (!photon_fields())
        return 1;
    printf("%016llx\n", (unsigned long long)hash);
    return 0;
}
