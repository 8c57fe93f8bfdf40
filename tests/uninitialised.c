/* uninitialised.c: learns small fields with guide_kd.h and guide_photon.h, asks them, trains and runs small networks of
   guide_nn.h, and prints a hash of all of it. Built by uninitialised.sh with stack and heap filled with different
   bytes: the hash may not depend on them. */
#include <stdio.h>
#include <stdlib.h>

#define GKD_IMPLEMENTATION
#include "guide_kd.h"
#define GPH_IMPLEMENTATION
#include "guide_photon.h"
#define GNN_IMPLEMENTATION
#include "guide_nn.h"

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

/* Maps with holes, in memory that is filled before it is written. */
enum { MAPS = 3, WIDTH = 16, HEIGHT = 8, INPUTS = 3 };
static float inputs[MAPS][INPUTS][HEIGHT][WIDTH], truths[MAPS][HEIGHT][WIDTH], outputs[MAPS][HEIGHT][WIDTH];

static void make_maps(void)
{
    for (int i = 0; i < MAPS * HEIGHT * WIDTH; ++i) {
        int m = i / (HEIGHT * WIDTH), y = i / WIDTH % HEIGHT, x = i % WIDTH;
        bool there = rndf() < 0.3f;
        for (int c = 0; c < INPUTS; ++c)
            inputs[m][c][y][x] = c + 1 == INPUTS ? (float)there : there ? 1 + rndf() : 0;
        truths[m][y][x] = 2 * rndf();
    }
    memset(outputs, FILL, sizeof outputs);
}

/* Saves it and loads that; the save is part of the hash. */
static bool save_net(gnn_unet *net, gnn_type type)
{
    size_t bound = gnn_unet_bound(net, type, NULL), size = 0;
    void *file = filled(NULL, bound);
    bool good = file && !gnn_unet_save(net, type, NULL, file, bound, &size) && !gnn_unet_load(net, file, size, NULL);
    add(file, size);
    free(file);
    return good;
}

static bool train_net(const gnn_unet_desc *d)
{
    gnn_unet *net;
    gnn_step step;
    size_t size;
    void *workspace;
    bool good = true;
    if (gnn_unet_create(d, &net))
        return false;
    size = gnn_unet_workspace(net, 2, true);
    workspace = filled(NULL, size);
    make_maps();
    for (int i = 0; i < 3 && good; ++i) {
        good =
            workspace && !gnn_unet_train(net, inputs[0][0][0], truths[0][0], MAPS, &step, workspace, size, NULL, NULL);
        add(&step, sizeof step);
        good = good && step.maps == MAPS && save_net(net, i == 1 ? GNN_TYPE_F16 : GNN_TYPE_F32);
        good = good && !gnn_unet_forward(net, inputs[0][0][0], MAPS, outputs[0][0], workspace, size, NULL, NULL);
        add(outputs, sizeof outputs);
    }
    free(workspace);
    gnn_unet_destroy(net);
    return good;
}

/* At every level of SIMD, with and without a mask; channels that fill no vector. */
static bool train_nets(void)
{
    bool good = true;
    for (int k = 0; k < 2 * (GNN_SIMD_NEON + 1) && good; ++k) {
        gnn_unet_desc d;
        memset(&d, 0, sizeof d);
        d.width = WIDTH, d.height = HEIGHT, d.inputs = INPUTS;
        d.channels[0] = 3, d.channels[1] = 9, d.channels[2] = 17;
        d.no_mask = k % 2;
        d.training = true;
        d.simd = (gnn_simd)(k / 2);
        d.allocate = filled;
        d.release = release;
        good = gnn_resolve_simd(d.simd) == GNN_SIMD_AUTO || train_net(&d);
    }
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
    if (!train_nets())
        return 2;
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
