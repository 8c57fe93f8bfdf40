/* photon.c: light carried from the lights to the surfaces (Jensen 1996), for methods that learn from it. A wavefront
   like the camera's: batches of paths advance bounce by bounce, as arrays.

     >>emit     start the paths at the lights
     >>arrive   trace, prepare closures, hand out what arrives
     >>scatter  adjoint sampling, roulette
     >>tiles    what each thread does

   Every path has a generator of its own, seeded by its place in the pass, and a tile's photons come in one order: so
   the photons do not depend on the number of threads. */
#include "emission.h"
#include "integrator.h"

#include <stdlib.h>
#include <string.h>

#define BATCH TR_BATCH

typedef struct photon_path {
    tr_rng rng;
    vec3 origin, direction, flux;
    float first_flux; /* largest channel when it left the light: roulette holds it there */
    float distance;   /* from the last vertex that was not delta */
    float u[5], density;
    int bounces;
    bool delta_light, unseen;
} photon_path;

typedef struct photon_worker {
    photon_path paths[BATCH];
    int active[BATCH], active_count;
    struct RTCRayHit hits[BATCH];
    tr_surface surfaces[BATCH];
    tr_closure closures[BATCH];
    tr_photon photons[BATCH];
} photon_worker;

/* ---- >>emit ------------------------------------------------------------------------------------------------- */

static void add_flux(double sum[3], vec3 flux)
{
    sum[0] += flux.x;
    sum[1] += flux.y;
    sum[2] += flux.z;
}

static void emit(photon_worker *w, const tr_photon_pass *pass, uint64_t first, int count, tr_photon_stats *stats)
{
    /* another seed than the camera's, and another one for each pass */
    uint64_t seed = tr_hash64(pass->seed ^ UINT64_C(0x9d7c3f6e51a2b84d)) + tr_hash64((uint64_t)pass->index + 1);
    float share = (float)(1.0 / (double)pass->total);
    w->active_count = 0;
    for (int i = 0; i < count; ++i) {
        photon_path *p = &w->paths[i];
        tr_emission e;
        float *u = p->u;
        p->rng = rng_seed(seed, first + (uint64_t)i);
        u[0] = rng_float(&p->rng);
        rng_float2(&p->rng, &u[1], &u[2]);
        rng_float2(&p->rng, &u[3], &u[4]);
        p->density = tr_emission_map_warp(pass->emission, u);
        if (!tr_light_emit(pass->scene, u, &e))
            continue;
        p->flux = scale3(e.flux, share / p->density);
        p->first_flux = max3(p->flux);
        p->direction = e.direction;
        p->origin = black3(e.ng) ? e.p : tr_leave_surface(pass->scene, e.p, e.ng, e.direction);
        p->distance = e.distant ? INFINITY : 0;
        p->bounces = 0;
        p->delta_light = e.delta;
        p->unseen = e.delta && !pass->nee;
        add_flux(stats->emitted, p->flux);
        w->active[w->active_count++] = i;
    }
    stats->paths += (uint64_t)count;
}

/* ---- >>arrive ----------------------------------------------------------------------------------------------- */

static void trace(photon_worker *w, const tr_scene *scene)
{
    for (int i = 0; i < w->active_count; ++i) {
        const photon_path *p = &w->paths[w->active[i]];
        struct RTCRayHit *hit = &w->hits[w->active[i]];
        tr_trace_hit(scene, p->origin, p->direction, hit);
    }
}

/* What has left the scene is dropped, and so is what arrives where nothing scatters. Two loops, so that textures have
   time to come from memory. */
static void arrive(photon_worker *w, const tr_scene *scene, tr_photon_stats *stats)
{
    int met = 0, kept = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        if (i + 16 < w->active_count)
            tr_surface_prefetch(scene, &w->hits[w->active[i + 16]], 0);
        if (i + 8 < w->active_count)
            tr_surface_prefetch(scene, &w->hits[w->active[i + 8]], 1);
        if (w->hits[id].hit.geomID == RTC_INVALID_GEOMETRY_ID) {
            add_flux(stats->escaped, w->paths[id].flux);
            continue;
        }
        tr_surface_from_hit_lean(scene, &w->hits[id], &w->surfaces[id]);
        tr_closure_prefetch(scene, &w->surfaces[id]);
        w->paths[id].distance += w->surfaces[id].t;
        w->active[met++] = id;
    }
    for (int i = 0; i < met; ++i) {
        int id = w->active[i];
        if (tr_closure_prepare(scene, &w->surfaces[id], neg3(w->paths[id].direction), &w->closures[id]))
            w->active[kept++] = id;
    }
    w->active_count = kept;
}

/* Hand out the photons at vertices with a smooth part. */
static bool deposit(photon_worker *w, bool nee, int tile, tr_photon_fn take, void *user, tr_photon_stats *stats)
{
    int n = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        const photon_path *p = &w->paths[id];
        const tr_surface *s = &w->surfaces[id];
        if (w->closures[id].delta_probability >= 1)
            continue;
        tr_photon *out = &w->photons[n++];
        out->p = s->p;
        out->wi = neg3(p->direction);
        out->flux = p->flux;
        out->distance = p->distance;
        out->ng = s->ng;
        out->ns = w->closures[id].frame.n;
        out->bounces = p->bounces;
        memcpy(out->u, p->u, sizeof out->u);
        out->density = p->density;
        out->flags = (nee && p->bounces == 0 ? TR_PHOTON_DIRECT : 0) | (p->unseen ? TR_PHOTON_UNSEEN : 0);
    }
    stats->photons += (uint64_t)n;
    return n == 0 || take(user, tile, w->photons, n);
}

/* ---- >>scatter ---------------------------------------------------------------------------------------------- */

/* Survive with the probability that holds the flux where it was when it left the light: photons of one weight say more
   than photons of many (Jensen 1996). */
static bool survives(photon_path *p)
{
    float q = max3(p->flux) / p->first_flux;
    if (q >= 1)
        return true;
    if (rng_float(&p->rng) >= q)
        return false;
    p->flux = scale3(p->flux, 1 / q);
    return true;
}

/* The next ray; false = the path ends. */
static bool scatter_path(photon_worker *w, const tr_scene *scene, int id, tr_photon_stats *stats)
{
    photon_path *p = &w->paths[id];
    const tr_surface *s = &w->surfaces[id];
    float u[4];
    vec3 to, weight;
    bool delta;
    rng_float2(&p->rng, &u[0], &u[1]);
    rng_float2(&p->rng, &u[2], &u[3]);
    if (!tr_closure_sample_adjoint(scene, s, &w->closures[id], u, &to, &weight, &delta))
        return false;
    p->flux = mul3(p->flux, weight);
    if (!finite3(p->flux) || !finite3(to)) {
        stats->bad++;
        return false;
    }
    if (!(max3(p->flux) > 0) || !survives(p))
        return false;
    /* NEE reaches a light that no ray can hit from a smooth vertex only, past no mirror. */
    p->unseen |= p->delta_light && p->bounces == 0 && delta;
    p->bounces++;
    if (!delta)
        p->distance = 0;
    p->direction = to;
    p->origin = tr_leave_surface(scene, s->p, s->ng, to);
    return true;
}

static void scatter(photon_worker *w, const tr_scene *scene, tr_photon_stats *stats)
{
    int kept = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        if (scatter_path(w, scene, id, stats))
            w->active[kept++] = id;
    }
    w->active_count = kept;
}

/* ---- >>tiles ------------------------------------------------------------------------------------------------ */

static bool trace_batch(photon_worker *w, const tr_photon_pass *pass, int tile, uint64_t first, int count, int edges,
                        tr_photon_fn take, void *user, tr_photon_stats *stats)
{
    emit(w, pass, first, count, stats);
    for (int edge = 1; edge <= edges && w->active_count > 0; ++edge) {
        trace(w, pass->scene);
        stats->rays += (uint64_t)w->active_count;
        arrive(w, pass->scene, stats);
        if (!deposit(w, pass->nee, tile, take, user, stats))
            return false;
        if (edge < edges)
            scatter(w, pass->scene, stats);
    }
    return true;
}

typedef struct photon_job {
    const tr_photon_pass *pass;
    tr_photon_fn take;
    void *user;
    int edges;
    struct photon_tile {
        tr_photon_stats stats;
        bool done;
    } * tiles;
} photon_job;

static void trace_tiles(void *context, uint32_t begin, uint32_t end)
{
    const photon_job *job = context;
    const tr_photon_pass *pass = job->pass;
    photon_worker *w = malloc(sizeof *w);
    tr_flush_denormals();
    for (uint32_t t = begin; w && t < end; ++t) {
        uint32_t from = t * TR_PHOTON_TILE, left = pass->count - from;
        uint32_t to = from + (left < TR_PHOTON_TILE ? left : TR_PHOTON_TILE);
        struct photon_tile *tile = &job->tiles[t];
        tile->done = true;
        for (; from < to && tile->done; from += BATCH)
            tile->done = trace_batch(w, pass, (int)t, pass->first + from, to - from < BATCH ? (int)(to - from) : BATCH,
                                     job->edges, job->take, job->user, &tile->stats);
    }
    free(w);
}

bool tr_trace_photons(const tr_photon_pass *pass, tr_photon_fn take, void *user, tr_photon_stats *stats)
{
    uint32_t tiles = (uint32_t)tr_photon_tiles(pass->count);
    int depth = pass->max_depth > 0 && pass->max_depth < TR_MAX_DEPTH ? pass->max_depth : TR_MAX_DEPTH;
    photon_job job = {pass, take, user, depth - 1, calloc(tiles ? tiles : 1, sizeof *job.tiles)};
    bool ok = job.tiles != NULL;
    if (ok && pass->parallel)
        pass->parallel(pass->parallel_user, tiles, 1, trace_tiles, &job);
    else if (ok)
        trace_tiles(&job, 0, tiles);
    for (uint32_t t = 0; ok && t < tiles; ++t) {
        const tr_photon_stats *s = &job.tiles[t].stats;
        ok = job.tiles[t].done;
        if (!stats)
            continue;
        stats->paths += s->paths;
        stats->photons += s->photons;
        stats->rays += s->rays;
        stats->bad += s->bad;
        for (int c = 0; c < 3; ++c) {
            stats->emitted[c] += s->emitted[c];
            stats->escaped[c] += s->escaped[c];
        }
    }
    free(job.tiles);
    return ok;
}
