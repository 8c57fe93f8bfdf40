/* method_photon.c: guide_photon.h as a method of the example renderer.

   Options (--set key=value), defaults as in guide_photon.h: photons (photon paths per camera path, 0 .. 16, default 1),
   repair=none|gaussian|pyramid|pull_push, sigma (bins), pyramid_levels, rows=16|32|64, grid (cubes along the longest
   side of the scene), c (photons before a voxel splits), max_levels, keep_passes, max_memory_mb,
   learn_alpha=ratio|variance|off (on = variance), alpha, gate=on|off, gate_margin, gate_probe, uniform, surface=on|off
   (what lies below the surface is mirrored up), jitter=on|off (find looks up a jittered position), parallax=on|off
   (off: photons do not tell their distances).

   A pass's photons are traced after its camera paths, which make voxels valid, also those that the refine before has
   cut. They start where earlier ones came to valid voxels (emission=on|off). How many there are follows from counted
   work and from what became of those before (budget=on|off, off: `photons` for each camera path in every pass), see
   >>budget. */
#include "emission.h"
#include "method_options.h"
#include "photon_net.h"

#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#define IDLE_PASSES 4     /* between two passes with photons where they are of no use */
#define WORK_SHARE 0.75   /* photons' part of the work, as camera paths' part is 1 */
#define FIRST_WORK 4      /* of a photon path, before there was any */
#define MIN_YIELD 0.0001  /* photons that valid voxels take, per path: below it they are of no use ... */
#define PATIENCE 2        /* ... after so many passes */
#define FEW_PHOTONS 32    /* in a voxel: the first ones say less than each is worth by root(n) / M */
#define PROBE_SHARE 0.125 /* of the paths, while they are of no use */

/* What the last pass's photons cost and were good for; see >>budget. */
typedef struct photon_budget {
    double rate;              /* photon paths per camera path in the last pass with photons */
    double each;              /* work of a photon path in the last pass that had some */
    uint64_t *handed;         /* photons handed over, by tile, in this pass */
    uint64_t vertices, taken; /* that the field had counted before this pass */
    uint32_t poor;            /* passes one after the other whose photons were of no use */
    uint32_t passes, skipped; /* with photons; without, though there were some to learn from */
    double yield;             /* photons taken per path, last pass */
} photon_budget;

typedef struct photon {
    gph_field *field;
    gph_view view;
    gph_stream **streams; /* of camera paths; those of photons follow */
    int tiles, photon_tiles;
    bool surface, jitter, adapts, parallax;
    tr_emission_map *emission; /* NULL: even emission */
    double per_path, paths;    /* photon paths per camera path; camera paths of one sample per pixel */
    photon_budget budget;
    double flux; /* of a photon of this pass: its power times the pass's paths, so that all paths count alike */
    uint64_t stream_peak;
    photon_net *net; /* NULL = none */
    tr_parallel_fn parallel;
    void *parallel_user;
} photon;

/* ---- options */

static bool parse(parser *p, gph_desc *d, photon *m)
{
    int learn;
    m->per_path = number(p, "photons", 1);
    if (m->per_path > 16)
        complain(p, "photons", option(p->env, "photons"), "0 .. 16");
    m->adapts = choice(p, "budget", "off|on") != 0;
    bool learns_emission = choice(p, "emission", "off|on") != 0;
    d->repair = (gph_repair)(choice(p, "repair", "none|gaussian|pyramid|pull_push") + 1);
    d->sigma = (float)number(p, "sigma", 0);
    d->pyramid_levels = whole(p, "pyramid_levels", 0);
    d->rows = whole(p, "rows", 0);
    d->grid_cells = whole(p, "grid", 0);
    d->split_photons = (float)number(p, "c", 0);
    d->max_levels = whole(p, "max_levels", 0);
    d->keep_passes = whole(p, "keep_passes", 0);
    d->max_bytes = (uint64_t)whole(p, "max_memory_mb", 0) << 20;
    learn = choice(p, "learn_alpha", "off|ratio|variance|on");
    d->alpha_mode = (gph_alpha_mode)(learn == 3 ? GPH_ALPHA_VARIANCE : learn + 1);
    d->alpha = (float)number(p, "alpha", 0);
    d->uniform = (float)number(p, "uniform", 0);
    d->no_gate = choice(p, "gate", "off|on") == 0;
    d->gate_margin = (float)number(p, "gate_margin", 0);
    d->gate_probe = whole(p, "gate_probe", 0);
    m->surface = choice(p, "surface", "off|on") != 0;
    m->jitter = choice(p, "jitter", "off|on") == 1;
    m->parallax = choice(p, "parallax", "off|on") != 0;
    if (p->ok && learns_emission && !(m->emission = tr_emission_map_create(m->photon_tiles))) {
        snprintf(p->err, p->err_size, "photon: out of memory");
        return false;
    }
    return p->ok;
}

/* net=on|off|FILE. */
static bool parse_net(parser *p, const gph_desc *d, photon *m)
{
    const char *value = option(p->env, "net");
    double share = number(p, "net_share", 0.1);
    if (!p->ok || !value || !strcmp(value, "off"))
        return p->ok;
    if (d->rows != 0 && d->rows != PN_ROWS) {
        complain(p, "net", value, "rows=32 with it");
        return false;
    }
    m->net = photon_net_create(strcmp(value, "on") ? value : NULL, share, m->tiles, p->err, p->err_size);
    return m->net != NULL;
}

/* ---- life */

static void photon_destroy(void *method)
{
    photon *m = method;
    if (!m)
        return;
    for (int i = 0; m->streams && i < m->tiles + m->photon_tiles; ++i)
        gph_stream_destroy(m->streams[i]);
    free(m->streams);
    photon_net_destroy(m->net);
    gph_destroy(m->field);
    tr_emission_map_destroy(m->emission);
    free(m->budget.handed);
    free(m);
}

static void *photon_create(tr_method_env *env, char *err, size_t err_size)
{
    photon *m = calloc(1, sizeof *m);
    gph_desc desc;
    parser p = {env, err, err_size, true};
    const vec3 lo = env->scene->bounds_min, hi = env->scene->bounds_max;
    memset(&desc, 0, sizeof desc);
    snprintf(err, err_size, "out of memory");
    if (!m)
        return NULL;
    memcpy(desc.bounds_min, &lo, sizeof desc.bounds_min);
    memcpy(desc.bounds_max, &hi, sizeof desc.bounds_max);
    m->tiles = env->tiles;
    m->photon_tiles = env->photon_tiles;
    m->parallel = env->parallel;
    m->parallel_user = env->parallel_user;
    m->paths = (double)env->width * env->height;
    if (!parse(&p, &desc, m) || !parse_net(&p, &desc, m)) {
        photon_destroy(m);
        return NULL;
    }
    gph_result result = gph_create(&desc, &m->field);
    int streams = m->tiles + m->photon_tiles;
    m->streams = result ? NULL : calloc((size_t)streams, sizeof *m->streams);
    for (int i = 0; m->streams && i < streams && !result; ++i)
        result = gph_stream_create(m->field, &m->streams[i]);
    if (result || !m->streams) {
        snprintf(err, err_size, "photon: %s", gph_result_string(result ? result : GPH_OUT_OF_MEMORY));
        photon_destroy(m);
        return NULL;
    }
    m->view = gph_get_view(m->field);
    m->budget.each = FIRST_WORK;
    m->budget.handed = calloc((size_t)m->photon_tiles, sizeof *m->budget.handed);
    if (m->budget.handed)
        return m;
    snprintf(err, err_size, "photon: out of memory");
    photon_destroy(m);
    return NULL;
}

/* ---- passes */

static bool photon_begin_pass(void *method, const tr_pass *pass)
{
    (void)method;
    return !pass->last;
}

/* ---- >>budget

   Work is counted, not timed, so that pictures do not depend on the machine: a path and each of its vertices count one.
   Photons get WORK_SHARE of what the pass's camera paths took, at most `photons` paths for each of those. That work is
   known by then; what a photon path takes is that of the last pass with photons, in the first one FIRST_WORK: so the
   share is exact as far as passes are alike, and in the first one only where FIRST_WORK is right. Where valid
   voxels take next to none of them (light that leaves the scene, or goes where no camera path comes), or where no voxel
   guides, only every IDLE_PASSES-th pass has some, and few. */

static uint64_t photon_wants_photons(void *method, const tr_pass *pass)
{
    photon *m = method;
    photon_budget *b = &m->budget;
    gph_stats s;
    gph_get_stats(m->field, &s);
    double paths = m->paths * pass->spp, camera = paths + (double)(s.vertices - b->vertices);
    double rate = m->adapts ? fmin(m->per_path, WORK_SHARE * camera / paths / b->each) : m->per_path;
    bool closed = s.maps > 0 && gph_all_closed(m->field), useless = m->adapts && b->poor >= PATIENCE;
    m->flux = 0;
    if (pass->last)
        return 0;
    if ((closed || useless) && pass->index % IDLE_PASSES != 0) {
        b->skipped += rate > 0;
        return 0;
    }
    m->flux = floor((useless ? PROBE_SHARE : 1) * rate * paths + 0.5);
    b->rate = m->flux / paths;
    b->passes += m->flux > 0;
    return (uint64_t)m->flux;
}

/* After a pass: what its photons cost and were good for. */
static void photon_judge(photon *m)
{
    photon_budget *b = &m->budget;
    gph_stats s;
    double handed = 0;
    gph_get_stats(m->field, &s);
    for (int i = 0; i < m->photon_tiles; ++i) {
        handed += (double)b->handed[i];
        b->handed[i] = 0;
    }
    if (m->flux > 0) {
        b->each = 1 + handed / m->flux;
        b->yield = (double)(s.photons - b->taken) / m->flux;
        b->poor = b->yield < MIN_YIELD ? b->poor + 1 : 0;
    }
    b->vertices = s.vertices;
    b->taken = s.photons;
}

static const tr_emission_map *photon_emission(void *method) { return ((const photon *)method)->emission; }

/* ---- records */

/* The side that a direction lies on. */
static vec3 towards(vec3 normal, vec3 direction) { return dot3(normal, direction) < 0 ? neg3(normal) : normal; }

static gph_vertex convert(const tr_vertex *v)
{
    float p[3], contribution = v->cosine * (v->f.x * v->L.x + v->f.y * v->L.y + v->f.z * v->L.z) / 3;
    memcpy(p, &v->p, sizeof p);
    if (v->flags & TR_VERTEX_REJECTED)
        contribution = 0;
    gph_vertex vertex = gph_make_vertex(p, contribution, v->pdf_mix, v->pdf_bsdf, v->pdf_guide,
                                        v->flags & TR_VERTEX_GUIDED ? GPH_FROM_GUIDE : GPH_FROM_BSDF);
    vec3 normal = towards(v->ng, v->wo);
    vertex.sides = (uint16_t)gph_sides(v->flags & TR_VERTEX_PASSES ? NULL : &normal.x);
    return vertex;
}

static bool photon_record(void *method, int tile, const tr_vertex *vertices, int n)
{
    photon *m = method;
    gph_vertex samples[64];
    bool ok = true;
    if (m->net)
        photon_net_see(m->net, tile, vertices, n);
    for (int done = 0; done < n;) {
        int k = 0;
        for (; k < 64 && done < n; ++k, ++done)
            samples[k] = convert(&vertices[done]);
        ok = !gph_record_vertices(m->streams[tile], samples, (uint32_t)k) && ok;
    }
    return ok;
}

/* Those that next-event estimation finds anyhow, those that no camera path can find, and those that arrive where none
   comes, as on a roof's outside, are of no use. */
static bool photon_record_photons(void *method, int tile, const tr_photon *photons, int n)
{
    photon *m = method;
    gph_photon samples[64];
    bool ok = true;
    m->budget.handed[tile] += (uint64_t)n;
    for (int done = 0; done < n;) {
        int k = 0;
        for (; k < 64 && done < n; ++done) {
            const tr_photon *p = &photons[done];
            const vec3 normal = towards(p->ng, p->wi);
            float at[3], from[3];
            memcpy(at, &p->p, sizeof at);
            double known = p->flags ? -1 : gph_photons_at(m->field, at, &normal.x);
            if (known < 0)
                continue;
            if (m->emission) {
                double need = sqrt(gph_vertices_at(m->field, at)) / (known + FEW_PHOTONS);
                ok = tr_emission_map_record(m->emission, tile, p->u, p->density, (float)need) && ok;
            }
            memcpy(from, &p->wi, sizeof from);
            samples[k++] = gph_make_photon(at, from, m->parallax ? p->distance : INFINITY,
                                           (float)((double)((p->flux.x + p->flux.y + p->flux.z) / 3) * m->flux));
        }
        ok = !gph_record_photons(m->streams[m->tiles + tile], samples, (uint32_t)k) && ok;
    }
    return ok;
}

static void photon_flush(void *method)
{
    photon *m = method;
    int streams = m->tiles + m->photon_tiles;
    uint64_t bytes = 0;
    for (int i = 0; i < streams; ++i)
        bytes += gph_stream_size(m->streams[i]) * sizeof(gph_vertex);
    m->stream_peak = bytes > m->stream_peak ? bytes : m->stream_peak;
    gph_accumulate(m->field, m->streams, (uint32_t)streams, m->parallel, m->parallel_user); /* losses: in the stats */
    for (int i = 0; i < streams; ++i)
        gph_stream_clear(m->streams[i]);
    if (m->emission)
        tr_emission_map_flush(m->emission);
}

static bool photon_end_pass(void *method, const tr_pass *pass)
{
    photon *m = method;
    if (pass->last)
        return true;
    photon_flush(m);
    gph_result result = gph_refine(m->field, m->parallel, m->parallel_user);
    bool ok = !result && (!m->net || photon_net_refine(m->net, m->field, m->parallel, m->parallel_user));
    m->view = gph_get_view(m->field);
    if (m->emission && m->flux > 0)
        tr_emission_map_learn(m->emission);
    photon_judge(m);
    return ok;
}

/* ---- queries */

static bool photon_idle(void *method)
{
    const photon *m = method;
    return gph_all_closed(m->field);
}

static void photon_find(void *method, const tr_lookup *lookup, void *handles, float *alpha)
{
    const photon *m = method;
    gph_find_batch(&m->view, (uint32_t)lookup->n, NULL, &lookup->p->x, sizeof(vec3),
                   m->surface ? &lookup->side->x : NULL, sizeof(vec3), m->jitter && lookup->u ? lookup->u[0] : NULL,
                   sizeof lookup->u[0], handles, alpha);
}

/* Index lists of ints are lists of uint32_t: the two types may alias, and no index is negative. */
static void photon_sample(void *method, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi,
                          float *pdf)
{
    const photon *m = method;
    gph_sample_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, u[0], sizeof u[0], &wi->x, sizeof *wi,
                     pdf);
}

static void photon_pdf(void *method, int n, const int *index, const void *handles, const vec3 *wi, float *pdf)
{
    const photon *m = method;
    gph_pdf_batch(&m->view, (uint32_t)n, (const uint32_t *)index, handles, &wi->x, sizeof *wi, pdf);
}

static void photon_reflected(void *method, int n, const void *handles, float *radiance)
{
    const gph_handle *h = handles;
    (void)method;
    for (int i = 0; i < n; ++i)
        radiance[i] = h[i].reflected;
}

/* ---- reports */

/* Voxel number, and how many photons it has seen. */
static void photon_describe(void *method, int n, const void *handles, float *cell, float *depth)
{
    const photon *m = method;
    const gph_handle *h = handles;
    for (int i = 0; i < n; ++i) {
        bool none = h[i].voxel == GPH_NONE;
        cell[i] = none ? 0 : (float)h[i].voxel;
        depth[i] = none ? 0 : m->view.voxels[h[i].voxel].photons;
    }
}

static void photon_stats(void *method, tr_method_stats *stats)
{
    const photon *m = method;
    gph_stats s;
    gph_get_stats(m->field, &s);
    memset(stats, 0, sizeof *stats);
    stats->samples = s.vertices;
    stats->refused = s.refused;
    stats->cells = s.voxels;
    stats->bytes = s.bytes;
    stats->extra_bytes = (double)(m->stream_peak + (uint64_t)m->photon_tiles * sizeof *m->budget.handed +
                                  (m->emission ? tr_emission_map_bytes(m->emission) : 0));
    snprintf(stats->json, sizeof stats->json,
             "\"passes\": %u, \"clamped\": %llu, \"lost\": %llu, \"denied\": %llu, \"kept_photons\": %llu, "
             "\"cubes\": %u, \"maps\": %u, \"valid\": %u, \"sparse\": %u, \"levels\": %u, \"splits\": %llu, "
             "\"recycled\": %llu, \"built\": %llu, \"skipped\": %llu, \"open_voxels\": %u, \"closed_voxels\": %u, "
             "\"unjudged_voxels\": %u, \"opened\": %llu, \"closed\": %llu, \"probed\": %llu, \"closed_share\": %.4f, "
             "\"mean_alpha\": %.4f, \"useful_share\": %.4f, \"photon_rate\": %.4f, \"photon_yield\": %.4f, "
             "\"photon_passes\": %u, \"skipped_photon_passes\": %u, \"emission_gain\": %.2f",
             s.passes, (unsigned long long)s.clamped, (unsigned long long)s.lost, (unsigned long long)s.denied,
             (unsigned long long)s.photons, s.cubes, s.maps, s.valid, s.sparse, s.levels, (unsigned long long)s.splits,
             (unsigned long long)s.recycled, (unsigned long long)s.built, (unsigned long long)s.skipped, s.open_voxels,
             s.closed_voxels, s.unjudged_voxels, (unsigned long long)s.opened, (unsigned long long)s.closed,
             (unsigned long long)s.probed, (double)s.closed_share, (double)s.mean_alpha, (double)s.useful_share,
             m->budget.rate, m->budget.yield, m->budget.passes, m->budget.skipped,
             m->emission ? tr_emission_map_gain(m->emission) : 1);
    if (m->net) {
        size_t n = strlen(stats->json);
        photon_net_stats(m->net, stats->json + n, sizeof stats->json - n);
    }
}

const tr_method tr_method_photon = {.name = "photon",
                                    .summary = "histograms of photons in a hash grid (guide_photon.h)",
                                    .handle_size = sizeof(gph_handle),
                                    .learns = true,
                                    .create = photon_create,
                                    .destroy = photon_destroy,
                                    .begin_pass = photon_begin_pass,
                                    .idle = photon_idle,
                                    .find = photon_find,
                                    .sample = photon_sample,
                                    .pdf = photon_pdf,
                                    .reflected = photon_reflected,
                                    .record = photon_record,
                                    .wants_photons = photon_wants_photons,
                                    .emission = photon_emission,
                                    .record_photons = photon_record_photons,
                                    .flush = photon_flush,
                                    .end_pass = photon_end_pass,
                                    .describe = photon_describe,
                                    .wants_pixel_estimate = true,
                                    .stats = photon_stats};
