/* method_sdtree.c: guide_sdtree.h as a method of the example renderer.

   Options (--set key=value), defaults as in guide_sdtree.h: target=radiance|simple|variance|switching, switch_after, c
   (samples of a cell before it splits), rho, smoothing, max_depth, max_levels, min_samples, max_memory_mb,
   spatial_filter=nearest|stochastic, directional_filter=nearest|box, learn_alpha=grid|adam|off (on = grid), alpha,
   gate=on|off, gate_margin, gate_gain, gate_probe, guide_weight=on|off, history=on|off, denoise=on|off|gaussian,
   denoise_budget, denoise_when=training|last (in every refine, or only in that which ends --train); of
   denoise=gaussian: sigma, gaussian_rho, gaussian_sphere=off|on, gaussian_limit=on|off; uniform, alias=on|off,
   simd=scalar|avx2|avx512|neon, product=on|off (with the cosine), parallax=on|off (cells know distances), jitter=on|off
   (find looks up a jittered position), sparse=on|off (closed fields record only some tiles). With --train: save=FILE
   writes the field when the training ends; compare=FILE,FILE,... judges such fields by the samples of the picture, see
   >>rivals. */
#include "method_options.h"
#include "scene_internal.h"
#include "threads.h"

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

/* Another field, and by image tile the sums of the second moments that the samples have in their own and under it. */
typedef struct rival {
    gsd_field *field;
    gsd_view view;
    double *own, *other; /* [tiles] */
} rival;

typedef struct sdtree {
    gsd_field *field;
    gsd_view view;
    gsd_stream **streams;
    int tiles;
    bool product, parallax, jitter, sparse, denoise_last, frozen;
    float fraction; /* of the tiles that record in this pass */
    int pass;
    uint64_t stream_peak;
    tr_parallel_fn parallel;
    void *parallel_user;
    FILE *save;
    rival *rivals;
    int rival_count;
    double denoise_start; /* CPU seconds when refine's denoise step began; 0 = it is not there */
    double denoise_seconds;
} sdtree;

/* ---- options */

static bool parse(parser *p, gsd_desc *d, sdtree *m)
{
    int learn;
    d->target = (gsd_target)(choice(p, "target", "radiance|simple|variance|switching") + 1);
    d->switch_after = (float)number(p, "switch_after", 0);
    d->split_samples = (float)number(p, "c", 0);
    d->rho = (float)number(p, "rho", 0);
    d->smoothing = (float)number(p, "smoothing", 0);
    d->max_depth = whole(p, "max_depth", 0);
    d->max_levels = whole(p, "max_levels", 0);
    d->min_samples = whole(p, "min_samples", 0);
    d->max_bytes = (uint64_t)whole(p, "max_memory_mb", 0) << 20;
    d->spatial_filter = (gsd_spatial_filter)(choice(p, "spatial_filter", "nearest|stochastic") + 1);
    d->directional_filter = (gsd_directional_filter)(choice(p, "directional_filter", "nearest|box") + 1);
    learn = choice(p, "learn_alpha", "off|adam|grid|on");
    d->alpha_mode = (gsd_alpha_mode)(learn == 3 ? GSD_ALPHA_GRID : learn + 1);
    d->alpha = (float)number(p, "alpha", 0);
    d->uniform = (float)number(p, "uniform", 0);
    d->no_gate = choice(p, "gate", "off|on") == 0;
    d->gate_margin = (float)number(p, "gate_margin", 0);
    d->gate_gain = (float)number(p, "gate_gain", 0);
    d->gate_probe = whole(p, "gate_probe", 0);
    d->no_guide_weight = choice(p, "guide_weight", "off|on") == 0;
    d->no_history = choice(p, "history", "off|on") == 0;
    d->denoise = (gsd_denoise_mode)(choice(p, "denoise", "off|on|gaussian") + GSD_DENOISE_OFF);
    m->denoise_last = choice(p, "denoise_when", "training|last") == 1;
    if (m->denoise_last && d->denoise == GSD_DENOISE_OFF)
        complain(p, "denoise_when", "last", "denoise=on with it");
    else if (m->denoise_last && p->env->train == 0)
        complain(p, "denoise_when", "last", "--train, whose last refine it speaks of");
    d->denoise_budget = (float)number(p, "denoise_budget", 0);
    d->gaussian_sigma = (float)number(p, "sigma", 0);
    d->gaussian_rho = (float)number(p, "gaussian_rho", 0);
    d->gaussian_sphere = choice(p, "gaussian_sphere", "off|on") == 1;
    d->gaussian_no_limit = choice(p, "gaussian_limit", "off|on") == 0;
    d->alias = choice(p, "alias", "off|on") == 1;
    d->simd = (gsd_simd)(choice(p, "simd", "scalar|avx2|avx512|neon") + 1);
    m->product = choice(p, "product", "off|on") != 0;
    m->parallax = choice(p, "parallax", "off|on") != 0;
    m->jitter = choice(p, "jitter", "off|on") == 1;
    m->sparse = choice(p, "sparse", "off|on") != 0;
    return p->ok;
}

/* ---- >>rivals: fields compared by the same samples

   A sample's direction had the density p; under another field it would have had q = alpha pdf_bsdf + (1 - alpha)
   pdf_guide. The mean of (contribution to the pixel / pixel estimate)^2 / (p q) is the second moment that the other
   field would have had. Its ratio to that of 1 / p^2 has little noise, since both come from the same samples. */

static void rivals_free(sdtree *m)
{
    for (int i = 0; i < m->rival_count; ++i) {
        gsd_destroy(m->rivals[i].field);
        free(m->rivals[i].own);
    }
    free(m->rivals);
}

static gsd_field *load_field(const char *path)
{
    gsd_field *field = NULL;
    size_t size;
    void *data = tr_file_read(path, &size, NULL, 0);
    if (data)
        gsd_load(NULL, data, size, &field);
    free(data);
    return field;
}

static bool save_field(sdtree *m)
{
    size_t size = gsd_save_bound(m->field);
    void *data = malloc(size);
    bool ok = data && !gsd_save(m->field, data, size, &size) && fwrite(data, 1, size, m->save) == size;
    free(data);
    ok = !fclose(m->save) && ok;
    m->save = NULL;
    return ok;
}

static bool add_rival(sdtree *m, const char *path)
{
    rival *more = realloc(m->rivals, (size_t)(m->rival_count + 1) * sizeof *more);
    if (!more)
        return false;
    rival *r = &more[m->rival_count++];
    m->rivals = more;
    r->field = load_field(path);
    r->own = calloc(2 * (size_t)m->tiles, sizeof *r->own);
    if (!r->field || !r->own)
        return false;
    r->other = r->own + m->tiles;
    r->view = gsd_get_view(r->field);
    return true;
}

/* Open what save and compare name. */
static bool open_rivals(parser *p, sdtree *m)
{
    const char *save = option(p->env, "save"), *list = option(p->env, "compare");
    char path[1024];
    if (list && p->env->train == 0)
        complain(p, "compare", list, "--train: a field that learns cannot be compared");
    while (p->ok && list && *list) {
        size_t n = strcspn(list, ",");
        snprintf(path, sizeof path, "%.*s", (int)n, list);
        if (!add_rival(m, path))
            complain(p, "compare", path, "a field that save=FILE wrote");
        list += n + (list[n] == ',');
    }
    if (save && p->env->train == 0)
        complain(p, "save", save, "--train, at whose end it is written");
    else if (save && p->ok && !(m->save = fopen(save, "wb")))
        complain(p, "save", save, "a file that can be written");
    return p->ok;
}

static void judge_rivals(sdtree *m, int tile, const tr_vertex *v, const gsd_training_sample *s)
{
    const double c = (double)s->pixel_contribution, p = (double)s->pdf_mix;
    float normal[3], wi[3];
    memcpy(normal, &v->ns, sizeof normal);
    memcpy(wi, &v->wi, sizeof wi);
    for (int i = 0; i < m->rival_count && c > 0 && p > 0; ++i) {
        rival *r = &m->rivals[i];
        gsd_handle h =
            gsd_find(&r->view, s->position, m->product && !(v->flags & TR_VERTEX_PASSES) ? normal : NULL, NULL);
        double a = (double)h.alpha, q = a * fmax((double)s->pdf_bsdf, 1e-4 * p);
        q += a < 1 ? (1 - a) * (double)gsd_pdf(&r->view, &h, wi) : 0;
        r->own[tile] += c * c / (p * p);
        r->other[tile] += c * c / (p * q);
    }
}

/* Second moment under the other field over the own one: of all samples; typical: geometric mean over tiles, weighted by
   the tile's root, which single bright samples do not decide. */
static double rival_ratio(const sdtree *m, const rival *r, bool typical)
{
    double own = 0, other = 0, sum = 0, weight = 0;
    for (int i = 0; i < m->tiles; ++i) {
        own += r->own[i];
        other += r->other[i];
        if (r->own[i] > 0) {
            sum += sqrt(r->own[i]) * log(r->other[i] / r->own[i]);
            weight += sqrt(r->own[i]);
        }
    }
    return own <= 0 ? 1 : typical ? exp(sum / weight) : other / own;
}

/* Members "compared" and "compared_typical": a number for each file. */
static void rivals_json(const sdtree *m, char *out, size_t size)
{
    for (int k = 0; k < 2; ++k)
        for (int i = 0; i < m->rival_count; ++i) {
            size_t n = strlen(out);
            snprintf(out + n, size - n, "%s%.6g%s",
                     i   ? ", "
                     : k ? ", \"compared_typical\": ["
                         : ", \"compared\": [",
                     rival_ratio(m, &m->rivals[i], k == 1), i == m->rival_count - 1 ? "]" : "");
        }
}

/* ---- life */

static void sdtree_destroy(void *method)
{
    sdtree *m = method;
    if (!m)
        return;
    for (int i = 0; m->streams && i < m->tiles; ++i)
        gsd_stream_destroy(m->streams[i]);
    free(m->streams);
    gsd_destroy(m->field);
    rivals_free(m);
    if (m->save)
        fclose(m->save);
    free(m);
}

static void *sdtree_create(tr_method_env *env, char *err, size_t err_size)
{
    sdtree *m = calloc(1, sizeof *m);
    gsd_desc desc;
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
    if (!parse(&p, &desc, m) || !open_rivals(&p, m)) {
        sdtree_destroy(m);
        return NULL;
    }
    gsd_result result = gsd_create(&desc, &m->field);
    m->streams = result ? NULL : calloc((size_t)m->tiles, sizeof *m->streams);
    for (int i = 0; m->streams && i < m->tiles && !result; ++i)
        result = gsd_stream_create(m->field, &m->streams[i]);
    if (result || !m->streams) {
        snprintf(err, err_size, "sdtree: %s", gsd_result_string(result ? result : GSD_OUT_OF_MEMORY));
        sdtree_destroy(m);
        return NULL;
    }
    m->view = gsd_get_view(m->field);
    m->fraction = 1;
    return m;
}

/* ---- passes */

static bool sdtree_begin_pass(void *method, const tr_pass *pass)
{
    sdtree *m = method;
    m->pass = pass->index;
    m->fraction = m->sparse && !pass->last ? gsd_record_fraction(m->field) : 1;
    m->frozen = pass->last;
    return !pass->last || m->rival_count > 0;
}

static bool sdtree_wants_records(void *method, int tile)
{
    const sdtree *m = method;
    return tile_records(m->pass, m->fraction, tile);
}

static gsd_training_sample convert(const sdtree *m, const tr_vertex *v)
{
    float p[3], d[3], n[3], L[3], f[3], w[3];
    memcpy(p, &v->p, sizeof p);
    memcpy(d, &v->wi, sizeof d);
    memcpy(n, &v->ns, sizeof n);
    memcpy(L, &v->L, sizeof L);
    memcpy(f, &v->f, sizeof f);
    memcpy(w, &v->pixel_weight, sizeof w);
    gsd_training_sample s = gsd_make_sample(p, d, m->product && !(v->flags & TR_VERTEX_PASSES) ? n : NULL,
                                            m->parallax ? v->distance : INFINITY, L, f, v->cosine, w, v->pdf_mix,
                                            v->pdf_bsdf, v->pdf_guide);
    if (v->flags & TR_VERTEX_REJECTED) {
        s.radiance = GSD_REJECTED;
        s.contribution = s.pixel_contribution = 0;
        s.nearness = 0; /* nothing was traced */
    }
    return s;
}

static bool sdtree_record(void *method, int tile, const tr_vertex *vertices, int n)
{
    sdtree *m = method;
    gsd_training_sample samples[64];
    bool ok = true;
    for (int done = 0; done < n;) {
        int k = 0;
        for (; k < 64 && done < n; ++k, ++done)
            samples[k] = convert(m, &vertices[done]);
        for (int i = 0; m->frozen && i < k; ++i)
            judge_rivals(m, tile, &vertices[done - k + i], &samples[i]);
        ok = (m->frozen || !gsd_record(m->streams[tile], samples, (uint32_t)k)) && ok;
    }
    return ok;
}

static void sdtree_flush(void *method)
{
    sdtree *m = method;
    uint64_t bytes = 0;
    for (int i = 0; i < m->tiles; ++i)
        bytes += gsd_stream_size(m->streams[i]) * sizeof(gsd_training_sample);
    m->stream_peak = bytes > m->stream_peak ? bytes : m->stream_peak;
    gsd_accumulate(m->field, m->streams, (uint32_t)m->tiles, m->parallel, m->parallel_user); /* losses: in the stats */
    for (int i = 0; i < m->tiles; ++i)
        gsd_stream_clear(m->streams[i]);
}

/* CPU seconds, over all threads, of refine's denoise step. */
static void sdtree_on_step(void *method, const char *step)
{
    sdtree *m = method;
    if (m->denoise_start > 0)
        m->denoise_seconds += tr_cpu_seconds() - m->denoise_start;
    m->denoise_start = step && !strcmp(step, "denoise") ? tr_cpu_seconds() : 0;
}

static bool sdtree_end_pass(void *method, const tr_pass *pass)
{
    sdtree *m = method;
    gsd_pass info = {.on_step = sdtree_on_step, .on_step_user = method};
    if (pass->last)
        return true;
    sdtree_flush(m);
    info.pixel_estimate = pass->index > 0; /* of the passes before */
    info.denoise = m->denoise_last && !pass->freezes ? GSD_DENOISE_OFF : GSD_DENOISE_DEFAULT;
    gsd_result result = gsd_refine(m->field, &info, m->parallel, m->parallel_user);
    m->view = gsd_get_view(m->field);
    return !result && (!m->save || !pass->freezes || save_field(m));
}

/* ---- queries */

static bool sdtree_idle(void *method)
{
    const sdtree *m = method;
    return gsd_all_closed(m->field);
}

static void sdtree_find(void *method, const tr_lookup *lookup, void *handles, float *alpha)
{
    const sdtree *m = method;
    gsd_find_batch(&m->view, (uint32_t)lookup->n, NULL, &lookup->p->x, sizeof(vec3),
                   m->product ? &lookup->side->x : NULL, sizeof(vec3), m->jitter && lookup->u ? lookup->u[0] : NULL,
                   sizeof lookup->u[0], handles, alpha);
}

/* Index lists of ints are lists of uint32_t: the two types may alias, and no index is negative. */
static void sdtree_sample(void *method, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi,
                          float *pdf)
{
    const sdtree *m = method;
    gsd_sample_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, u[0], sizeof u[0], &wi->x, sizeof *wi,
                     pdf);
}

static void sdtree_pdf(void *method, int n, const int *index, const void *handles, const vec3 *wi, float *pdf)
{
    const sdtree *m = method;
    gsd_pdf_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, &wi->x, sizeof *wi, pdf);
}

static void sdtree_reflected(void *method, int n, const void *handles, float *radiance)
{
    const gsd_handle *h = handles;
    (void)method;
    for (int i = 0; i < n; ++i)
        radiance[i] = h[i].reflected;
}

/* ---- reports */

/* Cell number, and depth of its quadtree. */
static void sdtree_describe(void *method, int n, const void *handles, float *cell, float *depth)
{
    const sdtree *m = method;
    const gsd_handle *h = handles;
    for (int i = 0; i < n; ++i) {
        cell[i] = (float)h[i].cell;
        depth[i] = (float)m->view.cells[h[i].cell].depth;
    }
}

static void sdtree_stats(void *method, tr_method_stats *stats)
{
    const sdtree *m = method;
    gsd_stats s;
    gsd_get_stats(m->field, &s);
    memset(stats, 0, sizeof *stats);
    stats->samples = s.samples;
    stats->refused = s.refused;
    stats->cells = s.cells;
    stats->bytes = s.bytes;
    stats->extra_bytes = (double)m->stream_peak + (double)(s.peak_bytes - s.bytes);
    snprintf(stats->json, sizeof stats->json,
             "\"passes\": %u, \"zeros\": %llu, \"rejected\": %llu, \"clamped\": %llu, \"lost\": %llu, \"trees\": %u, "
             "\"nodes\": %llu, \"leaves\": %llu, \"building_nodes\": %llu, \"peak_bytes\": %llu, \"max_depth\": %u, "
             "\"mean_depth\": %.3f, \"effective_rho\": %.4g, \"split_cells\": %u, \"rebuilt_trees\": %u, "
             "\"waiting_cells\": %u, \"unread_cells\": %u, \"denoised_trees\": %u, \"smooth_trees\": %u, "
             "\"over_budget_trees\": %u, \"shallow_trees\": %u, \"deep_trees\": %u, \"denoised_leaves\": %llu, "
             "\"mean_blur\": %.3f, "
             "\"denoise_seconds\": %.6g, "
             "\"open_cells\": %u, \"closed_cells\": %u, "
             "\"unjudged_cells\": %u, \"opened\": %llu, \"closed\": %llu, \"probed\": %llu, \"closed_share\": %.4f, "
             "\"mean_alpha\": %.4f, \"record_fraction\": %.4f",
             s.passes, (unsigned long long)s.zeros, (unsigned long long)s.rejected, (unsigned long long)s.clamped,
             (unsigned long long)s.lost, s.trees, (unsigned long long)s.nodes, (unsigned long long)s.leaves,
             (unsigned long long)s.building_nodes, (unsigned long long)s.peak_bytes, s.max_depth, (double)s.mean_depth,
             (double)s.effective_rho, s.split_cells, s.rebuilt_trees, s.waiting_cells, s.unread_cells, s.denoised_trees,
             s.smooth_trees, s.over_budget_trees, s.shallow_trees, s.deep_trees, (unsigned long long)s.denoised_leaves,
             (double)s.mean_blur, m->denoise_seconds, s.open_cells, s.closed_cells, s.unjudged_cells,
             (unsigned long long)s.opened, (unsigned long long)s.closed, (unsigned long long)s.probed,
             (double)s.closed_share, (double)s.mean_alpha, (double)gsd_record_fraction(m->field));
    rivals_json(m, stats->json, sizeof stats->json);
}

const tr_method tr_method_sdtree = {.name = "sdtree",
                                    .summary = "spatial tree of directional quadtrees (guide_sdtree.h)",
                                    .handle_size = sizeof(gsd_handle),
                                    .learns = true,
                                    .create = sdtree_create,
                                    .destroy = sdtree_destroy,
                                    .begin_pass = sdtree_begin_pass,
                                    .idle = sdtree_idle,
                                    .find = sdtree_find,
                                    .sample = sdtree_sample,
                                    .pdf = sdtree_pdf,
                                    .reflected = sdtree_reflected,
                                    .record = sdtree_record,
                                    .wants_records = sdtree_wants_records,
                                    .flush = sdtree_flush,
                                    .end_pass = sdtree_end_pass,
                                    .describe = sdtree_describe,
                                    .wants_pixel_estimate = true,
                                    .stats = sdtree_stats};
