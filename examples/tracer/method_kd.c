/* method_kd.c: guide_kd.h as a method of the example renderer.

   Options (--set key=value), defaults as in guide_kd.h: split=signature|count, count (non-zero samples of a cell before
   it splits), lookahead (levels), min_samples, radiance_step, direction_step (degrees), confidence,
   criteria=both|radiance|direction, tests=own|published, keep_signatures (0 .. 1), prune=on|off (lookahead cells that
   are surely like their cell go), rest=on|off (mixtures that no longer change are not fitted), max_levels, max_lobes,
   update_samples, max_memory_mb, learn_alpha=grid|off (on = grid), alpha, gate=on|off, gate_margin, gate_gain,
   gate_probe, uniform, simd=scalar|avx2|avx512|neon, product=on|off (with the cosine), parallax=on|off (lobes know
   distances), jitter=on|off (find looks up a jittered position), sampling=mis|ris (where the bsdf is not diffuse: one
   direction, or one of candidates=2 chosen by what the product of bsdf and guide is there), sparse=on|off (closed
   fields record only some tiles), time_structure=on|off (a second field without mixtures learns from the same samples:
   its CPU seconds are the price of the tree and its signatures, sorting of the samples included). */
#include "method_options.h"
#include "threads.h"

#define GKD_IMPLEMENTATION
#include "guide_kd.h"

typedef struct kd {
    gkd_field *field;
    gkd_field *structure; /* time_structure: the same tree alone; else NULL */
    double structure_seconds;
    gkd_view view;
    gkd_stream **streams;
    int tiles;
    bool product, jitter, sparse, parallax, time_structure;
    int candidates;
    float fraction; /* of the tiles that record in this pass */
    int pass;
    uint64_t stream_peak;
    tr_parallel_fn parallel;
    void *parallel_user;
} kd;

/* ---- options */

static bool parse(parser *p, gkd_desc *d, kd *m)
{
    int learn, criteria;
    d->split = (gkd_split)(choice(p, "split", "signature|count") + 1);
    d->split_samples = whole(p, "count", 0);
    d->lookahead = whole(p, "lookahead", 0);
    d->min_samples = whole(p, "min_samples", 0);
    d->radiance_step = (float)number(p, "radiance_step", 0);
    d->direction_step = (float)(number(p, "direction_step", 0) * 3.14159265358979 / 180);
    d->confidence = (float)number(p, "confidence", 0);
    criteria = choice(p, "criteria", "both|radiance|direction");
    d->no_radiance_test = criteria == 2;
    d->no_direction_test = criteria == 1;
    d->published_tests = choice(p, "tests", "own|published") == 1;
    d->keep_signatures = (float)number(p, "keep_signatures", 0);
    d->no_prune = choice(p, "prune", "off|on") == 0;
    d->no_rest = choice(p, "rest", "off|on") == 0;
    d->max_levels = whole(p, "max_levels", 0);
    d->max_lobes = whole(p, "max_lobes", 0);
    d->update_samples = whole(p, "update_samples", 0);
    d->max_bytes = (uint64_t)whole(p, "max_memory_mb", 0) << 20;
    learn = choice(p, "learn_alpha", "off|grid|on");
    d->alpha_mode = (gkd_alpha_mode)(learn == 2 ? GKD_ALPHA_GRID : learn + 1);
    d->alpha = (float)number(p, "alpha", 0);
    d->uniform = (float)number(p, "uniform", 0);
    d->no_gate = choice(p, "gate", "off|on") == 0;
    d->gate_margin = (float)number(p, "gate_margin", 0);
    d->gate_gain = (float)number(p, "gate_gain", 0);
    d->gate_probe = whole(p, "gate_probe", 0);
    d->simd = (gkd_simd)(choice(p, "simd", "scalar|avx2|avx512|neon") + 1);
    m->product = choice(p, "product", "off|on") != 0;
    m->parallax = choice(p, "parallax", "off|on") != 0;
    m->jitter = choice(p, "jitter", "off|on") == 1;
    m->sparse = choice(p, "sparse", "off|on") != 0;
    m->time_structure = choice(p, "time_structure", "off|on") == 1;
    m->candidates = choice(p, "sampling", "mis|ris") == 1 ? (int)whole(p, "candidates", 2) : 1;
    if (m->candidates < 1 || m->candidates > TR_MAX_CANDIDATES) {
        char range[16];
        snprintf(range, sizeof range, "1 .. %d", TR_MAX_CANDIDATES);
        complain(p, "candidates", option(p->env, "candidates"), range);
    }
    return p->ok;
}

/* ---- life */

static void kd_destroy(void *method)
{
    kd *m = method;
    if (!m)
        return;
    for (int i = 0; m->streams && i < m->tiles; ++i)
        gkd_stream_destroy(m->streams[i]);
    free(m->streams);
    gkd_destroy(m->field);
    gkd_destroy(m->structure);
    free(m);
}

static void *kd_create(tr_method_env *env, char *err, size_t err_size)
{
    kd *m = calloc(1, sizeof *m);
    gkd_desc desc;
    parser p = {env, err, err_size, true};
    const vec3 lo = env->scene->bounds_min, hi = env->scene->bounds_max;
    memset(&desc, 0, sizeof desc);
    snprintf(err, err_size, "out of memory");
    if (!m)
        return NULL;
    memcpy(desc.bounds_min, &lo, sizeof desc.bounds_min);
    memcpy(desc.bounds_max, &hi, sizeof desc.bounds_max);
    m->tiles = env->tiles;
    m->parallel = env->parallel;
    m->parallel_user = env->parallel_user;
    if (!parse(&p, &desc, m)) {
        kd_destroy(m);
        return NULL;
    }
    gkd_result result = gkd_create(&desc, &m->field);
    desc.no_mixtures = true;
    if (!result && m->time_structure)
        result = gkd_create(&desc, &m->structure);
    m->streams = result ? NULL : calloc((size_t)m->tiles, sizeof *m->streams);
    for (int i = 0; m->streams && i < m->tiles && !result; ++i)
        result = gkd_stream_create(m->field, &m->streams[i]);
    if (result || !m->streams) {
        snprintf(err, err_size, "kd: %s", gkd_result_string(result ? result : GKD_OUT_OF_MEMORY));
        kd_destroy(m);
        return NULL;
    }
    m->view = gkd_get_view(m->field);
    m->fraction = 1;
    return m;
}

/* ---- passes */

static bool kd_begin_pass(void *method, const tr_pass *pass)
{
    kd *m = method;
    m->pass = pass->index;
    m->fraction = m->sparse ? gkd_record_fraction(m->field) : 1;
    return !pass->last;
}

static bool kd_wants_records(void *method, int tile)
{
    const kd *m = method;
    return tile_records(m->pass, m->fraction, tile);
}

static gkd_training_sample convert(const kd *m, const tr_vertex *v)
{
    float p[3], d[3], n[3], L[3], f[3], w[3];
    memcpy(p, &v->p, sizeof p);
    memcpy(d, &v->wi, sizeof d);
    memcpy(n, &v->ns, sizeof n);
    memcpy(L, &v->L, sizeof L);
    memcpy(f, &v->f, sizeof f);
    memcpy(w, &v->pixel_weight, sizeof w);
    gkd_training_sample s = gkd_make_sample(p, d, m->product && !(v->flags & TR_VERTEX_PASSES) ? n : NULL,
                                            m->parallax ? v->distance : INFINITY, L, f, v->cosine, w, v->pdf_mix,
                                            v->pdf_bsdf, v->pdf_guide);
    if (v->flags & TR_VERTEX_REJECTED) {
        s.radiance = GKD_REJECTED;
        s.contribution = s.pixel_contribution = 0;
        s.nearness = 0; /* nothing was traced */
    }
    return s;
}

static bool kd_record(void *method, int tile, const tr_vertex *vertices, int n)
{
    kd *m = method;
    gkd_training_sample samples[64];
    bool ok = true;
    for (int done = 0; done < n;) {
        int k = 0;
        for (; k < 64 && done < n; ++k, ++done)
            samples[k] = convert(m, &vertices[done]);
        ok = !gkd_record(m->streams[tile], samples, (uint32_t)k) && ok;
    }
    return ok;
}

/* What the field was given, for the field without mixtures. */
static void structure_accumulate(kd *m)
{
    double start = tr_cpu_seconds();
    if (m->structure)
        gkd_accumulate(m->structure, m->streams, (uint32_t)m->tiles, m->parallel, m->parallel_user);
    m->structure_seconds += tr_cpu_seconds() - start;
}

static gkd_result structure_refine(kd *m)
{
    double start = tr_cpu_seconds();
    gkd_result result = m->structure ? gkd_refine(m->structure, NULL, m->parallel, m->parallel_user) : GKD_OK;
    m->structure_seconds += tr_cpu_seconds() - start;
    return result;
}

static void kd_flush(void *method)
{
    kd *m = method;
    uint64_t bytes = 0;
    for (int i = 0; i < m->tiles; ++i)
        bytes += gkd_stream_size(m->streams[i]) * sizeof(gkd_training_sample);
    m->stream_peak = bytes > m->stream_peak ? bytes : m->stream_peak;
    gkd_accumulate(m->field, m->streams, (uint32_t)m->tiles, m->parallel, m->parallel_user); /* losses: in the stats */
    structure_accumulate(m);
    for (int i = 0; i < m->tiles; ++i)
        gkd_stream_clear(m->streams[i]);
}

static bool kd_end_pass(void *method, const tr_pass *pass)
{
    kd *m = method;
    gkd_pass info = {.pixel_estimate = pass->index > 0}; /* of the passes before */
    if (pass->last)
        return true;
    kd_flush(m);
    gkd_result result = gkd_refine(m->field, &info, m->parallel, m->parallel_user);
    if (!result)
        result = structure_refine(m);
    m->view = gkd_get_view(m->field);
    return !result;
}

/* ---- queries */

static bool kd_idle(void *method)
{
    const kd *m = method;
    return gkd_all_closed(m->field);
}

static void kd_find(void *method, const tr_lookup *lookup, void *handles, float *alpha)
{
    const kd *m = method;
    gkd_find_batch(&m->view, (uint32_t)lookup->n, NULL, &lookup->p->x, sizeof(vec3),
                   m->product ? &lookup->side->x : NULL, sizeof(vec3), m->jitter && lookup->u ? lookup->u[0] : NULL,
                   sizeof lookup->u[0], handles, alpha);
}

/* Index lists of ints are lists of uint32_t: the two types may alias, and no index is negative. */
static void kd_sample(void *method, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi,
                      float *pdf)
{
    const kd *m = method;
    gkd_sample_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, u[0], sizeof u[0], &wi->x, sizeof *wi,
                     pdf);
}

static void kd_pdf(void *method, int n, const int *index, const void *handles, const vec3 *wi, float *pdf)
{
    const kd *m = method;
    gkd_pdf_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, &wi->x, sizeof *wi, pdf);
}

static void kd_copy_handle(void *to, const void *from) { gkd_copy_handle(to, from); }

static void kd_reflected(void *method, int n, const void *handles, float *radiance)
{
    const gkd_handle *h = handles;
    (void)method;
    for (int i = 0; i < n; ++i)
        radiance[i] = h[i].reflected;
}

static int kd_candidates(void *method) { return ((const kd *)method)->candidates; }

static int kd_resample(void *method, const void *handle, const tr_candidate *candidates, int n, float alpha, float u,
                       float *pdf)
{
    const kd *m = method;
    const bool cosine = m->product && ((const gkd_handle *)handle)->surface; /* the guide's density holds it */
    gkd_candidate c[TR_MAX_CANDIDATES];
    for (int i = 0; i < n; ++i) {
        const tr_candidate *t = &candidates[i];
        c[i].pdf_bsdf = t->pdf_bsdf;
        c[i].pdf_guide = t->pdf_guide;
        c[i].f = cosine ? t->f : t->f * t->cosine;
        c[i].cosine = cosine ? t->cosine : 1;
    }
    return (int)gkd_resample(c, (uint32_t)n, alpha, u, pdf);
}

/* ---- reports */

/* Cell number, and the lobes of its mixture. */
static void kd_describe(void *method, int n, const void *handles, float *cell, float *depth)
{
    const kd *m = method;
    const gkd_handle *h = handles;
    for (int i = 0; i < n; ++i) {
        cell[i] = (float)h[i].cell;
        depth[i] = (float)m->view.cells[h[i].cell].count;
    }
}

static void kd_stats(void *method, tr_method_stats *stats)
{
    const kd *m = method;
    gkd_stats s;
    gkd_get_stats(m->field, &s);
    memset(stats, 0, sizeof *stats);
    stats->samples = s.samples;
    stats->refused = s.refused;
    stats->cells = s.cells;
    stats->bytes = s.bytes;
    stats->extra_bytes = (double)m->stream_peak;
    snprintf(stats->json, sizeof stats->json,
             "\"passes\": %u, \"updates\": %u, \"zeros\": %llu, \"rejected\": %llu, \"clamped\": %llu, \"lost\": %llu, "
             "\"levels\": %u, \"lookahead_cells\": %llu, \"lobes\": %llu, \"radiance_splits\": %llu, "
             "\"direction_splits\": %llu, \"denied_splits\": %llu, \"fits\": %llu, \"rests\": %llu, \"alike\": %llu, "
             "\"open_cells\": %u, "
             "\"closed_cells\": %u, \"unjudged_cells\": %u, \"opened\": %llu, \"closed\": %llu, \"probed\": %llu, "
             "\"closed_share\": %.4f, \"mean_alpha\": %.4f, \"record_fraction\": %.4f",
             s.passes, s.updates, (unsigned long long)s.zeros, (unsigned long long)s.rejected,
             (unsigned long long)s.clamped, (unsigned long long)s.lost, s.levels, (unsigned long long)s.lookahead,
             (unsigned long long)s.lobes, (unsigned long long)s.radiance_splits, (unsigned long long)s.direction_splits,
             (unsigned long long)s.denied_splits, (unsigned long long)s.fits, (unsigned long long)s.rests,
             (unsigned long long)s.alike, s.open_cells, s.closed_cells, s.unjudged_cells, (unsigned long long)s.opened,
             (unsigned long long)s.closed, (unsigned long long)s.probed, (double)s.closed_share, (double)s.mean_alpha,
             (double)gkd_record_fraction(m->field));
    if (m->structure) {
        size_t n = strlen(stats->json);
        gkd_get_stats(m->structure, &s);
        snprintf(stats->json + n, sizeof stats->json - n, ", \"structure_seconds\": %.6g, \"structure_cells\": %u",
                 m->structure_seconds, s.cells);
    }
}

const tr_method tr_method_kd = {.name = "kd",
                                .summary = "kd-tree of parallax-aware vMF mixtures (guide_kd.h)",
                                .handle_size = sizeof(gkd_handle),
                                .learns = true,
                                .create = kd_create,
                                .destroy = kd_destroy,
                                .begin_pass = kd_begin_pass,
                                .idle = kd_idle,
                                .find = kd_find,
                                .sample = kd_sample,
                                .pdf = kd_pdf,
                                .candidates = kd_candidates,
                                .resample = kd_resample,
                                .copy_handle = kd_copy_handle,
                                .reflected = kd_reflected,
                                .record = kd_record,
                                .wants_records = kd_wants_records,
                                .flush = kd_flush,
                                .end_pass = kd_end_pass,
                                .describe = kd_describe,
                                .wants_pixel_estimate = true,
                                .stats = kd_stats};
