/* uninitialised.c: learns small fields with guide_kd.h, asks them, and prints a hash of all of it. Built by
   uninitialised.sh with stack and heap filled with different bytes: the hash may not depend on them. */
#include <stdio.h>
#include <stdlib.h>

#define GKD_IMPLEMENTATION
#include "guide_kd.h"

#include "rng.h"

#ifndef FILL /* what fresh memory holds */
#define FILL 0
#endif

enum { N = 12000, ASKED = 64 };
static gkd_training_sample samples[N];
static uint64_t hash = 1;

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
    printf("%016llx\n", (unsigned long long)hash);
    return 0;
}
