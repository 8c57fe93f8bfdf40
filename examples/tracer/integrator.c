/* integrator.c: one integrator for every guiding method. A worker advances a tile's paths bounce by bounce, as arrays:

     >>camera     start the paths
     >>intersect  trace, add emission, prepare closures
     >>find       method.find on the vertices that have a smooth part
     >>nee        sample a light, weigh it against the mixture, trace a shadow ray
     >>scatter    roulette and splitting, then a direction from bsdf or guide: one-sample MIS (Veach 1997), or
                  resampling of several (Talbot et al. 2005)
     >>record     carry radiance back along each path and hand the vertices to the method

   Random numbers: each path has two generators. The guide draws from the second one only, so that a render whose
   gates are all closed is the unguided render, bit for bit. */
#include "integrator.h"
#include "threads.h"

#include <stdlib.h>
#include <string.h>

/* A path between bounces. */
typedef struct path {
    tr_rng rng, guide_rng;
    vec3 origin, direction;
    vec3 throughput, radiance;
    float pdf;      /* of `direction` by the mixture, resampled or not: known of every direction, so MIS with NEE uses
                       it; meaningless after a delta bounce */
    float survival; /* product of albedos and eta^2: what roulette looks at, since guided throughput is small exactly
                       where light is expected */
    float roulette; /* weight for having survived at this vertex */
    bool specular;  /* the last bounce was a delta one, or there was none */
    bool seen;      /* a non-delta vertex has been met */
    int x, y;
    int last;  /* newest link, -1 = none */
    int root;  /* the camera path that it belongs to */
    int trail; /* of the worker's trails, while recording */
} path;

/* A path vertex, kept for the way back. */
typedef struct link {
    int previous;   /* link before it on the path, -1 = none */
    int vertex;     /* in the worker's vertices, -1 = delta */
    vec3 emitted;   /* radiance emitted here towards the previous vertex, MIS weight in */
    vec3 reflected; /* NEE: light reflected here towards the previous vertex */
    vec3 weight;    /* f cos / pdf, roulette in: from incident to reflected */
    vec3 normal;
    float distance; /* from the previous vertex */
    bool environment;
} link;

/* What is left of a path for the way back. */
typedef struct trail {
    int last; /* newest link, -1 = none */
    int join; /* link of the path it was split from, -1 = none */
} trail;

/* A direction chosen at a vertex. */
typedef struct choice {
    vec3 wi, f;     /* delta: f cos / probability instead of f */
    float pdf_bsdf; /* delta: square of the relative index instead */
    float pdf;      /* resampled: what to divide by, else 0 */
    uint8_t kind;
} choice;
enum { CHOICE_NONE, CHOICE_DELTA, CHOICE_BSDF, CHOICE_GUIDE, CHOICE_RESAMPLED };

/* A direction that resampling may choose. */
typedef struct candidate {
    choice choice;
    float pdf_guide;
} candidate;

struct tr_worker {
    tr_counters counters;
    path paths[TR_PATHS];
    int camera_count, path_count;   /* slots in use so far: camera paths first, then what was split off */
    int free[TR_PATHS], free_count; /* slots of split paths that have ended */
    int active[TR_PATHS], active_count;
    struct RTCRayHit hits[TR_PATHS];
    tr_surface surfaces[TR_PATHS];
    tr_closure closures[TR_PATHS];
    /* Vertices with a smooth part, by their place k in the lookup. */
    int smooth[TR_PATHS], smooth_count;
    int place[TR_PATHS]; /* path -> k, -1 = none */
    vec3 p[TR_PATHS], side[TR_PATHS], wo[TR_PATHS];
    float roughness[TR_PATHS], find_u[TR_PATHS][3], alpha[TR_PATHS], reflected[TR_PATHS];
    void *handles;
    int index[TR_PATHS];
    vec3 wi[TR_PATHS];
    float pdf_guide[TR_PATHS], sample_u[TR_PATHS][2];
    /* Resampling: vertices that choose among candidates, which come one after another. */
    int several[TR_PATHS], several_count;
    candidate *candidates; /* [TR_PATHS][frame->candidates] by their place in `several`; NULL for one-sample MIS */
    /* NEE, by the same k; `lit` lists those that a light may reach. */
    int lit[TR_PATHS], lit_count;
    tr_light_sample lights[TR_PATHS];
    vec3 light_f[TR_PATHS];
    float light_pdf_bsdf[TR_PATHS];
    /* way back */
    tr_vertex *vertices;
    link *links;
    trail *trails; /* in order of creation: a path before what was split from it */
    int vertex_count, vertex_capacity, link_count, link_capacity, trail_count, trail_capacity;
};

#define WORKER_PAGE ((size_t)1 << 21) /* fill a large page, so that all of a worker is one page away */

tr_worker *tr_worker_create(const tr_frame *frame)
{
    tr_worker *w = tr_alloc_pages(sizeof *w > WORKER_PAGE ? sizeof *w : WORKER_PAGE);
    if (!w)
        return NULL;
    size_t handle_size = frame->method->handle_size ? frame->method->handle_size : 1;
    if (posix_memalign(&w->handles, 64, handle_size * TR_PATHS) != 0) {
        free(w);
        return NULL;
    }
    memset(w->handles, 0, handle_size * TR_PATHS);
    if (frame->candidates > 1) {
        w->candidates = malloc(sizeof *w->candidates * (size_t)frame->candidates * TR_PATHS);
        if (!w->candidates) {
            tr_worker_destroy(w);
            return NULL;
        }
    }
    return w;
}

void tr_worker_destroy(tr_worker *w)
{
    if (!w)
        return;
    free(w->handles);
    free(w->candidates);
    free(w->vertices);
    free(w->links);
    free(w->trails);
    free(w);
}

tr_counters *tr_worker_counters(tr_worker *w) { return &w->counters; }

/* An array with room for `more` elements behind `count`: itself or a larger one in its place, NULL = out of memory. */
static void *with_room(void *array, size_t size, int count, int more, int *capacity)
{
    if (count + more <= *capacity)
        return array;
    int larger = *capacity ? 2 * *capacity : 8 * TR_PATHS;
    void *grown = realloc(array, size * (size_t)larger);
    if (grown)
        *capacity = larger;
    return grown;
}

/* Room for what one bounce adds at most, so that the stages need not check. */
static bool reserve(tr_worker *w, bool recording)
{
    if (!recording)
        return true;
    tr_vertex *vertices = with_room(w->vertices, sizeof *vertices, w->vertex_count, TR_PATHS, &w->vertex_capacity);
    w->vertices = vertices ? vertices : w->vertices;
    link *links = with_room(w->links, sizeof *links, w->link_count, 2 * TR_PATHS, &w->link_capacity);
    w->links = links ? links : w->links;
    trail *trails = with_room(w->trails, sizeof *trails, w->trail_count, TR_PATHS, &w->trail_capacity);
    w->trails = trails ? trails : w->trails;
    return vertices && links && trails;
}

/* ---- >>camera ----------------------------------------------------------------------------------------------- */

/* Offset of a sample from the pixel's centre, in pixels, drawn from the reconstruction filter itself: every sample
   then counts for one pixel with weight 1 (filter importance sampling, Ernst et al. 2006). */
static float filter_offset(tr_filter filter, float u1, float u2)
{
    if (filter == TR_FILTER_TENT)
        return u1 < 0.5f ? sqrtf(2 * u1) - 1 : 1 - sqrtf(2 - 2 * u1);
    if (filter == TR_FILTER_GAUSSIAN) {
        float r = 0.5f * sqrtf(-2 * logf(1 - u1 * 0.9997f)); /* sigma 0.5, cut at 4 sigma */
        return r * cosf(2 * TR_PI * u2);
    }
    return u1 - 0.5f;
}

float tr_tan_half_fov_x(const tr_camera *camera, float aspect)
{
    float t = tanf(0.5f * camera->fov * (TR_PI / 180.0f));
    switch (camera->fov_axis) {
    case 1:
        return t * aspect;
    case 2:
        return t * aspect / sqrtf(1 + aspect * aspect);
    case 3:
        return aspect > 1 ? t * aspect : t;
    case 4:
        return aspect > 1 ? t : t * aspect;
    default:
        return t;
    }
}

static void camera_ray(const tr_frame *frame, path *p)
{
    const tr_camera *camera = &frame->scene->camera;
    tr_filter filter = frame->scene->filter;
    float u[6];
    for (int i = 0; i < 6; ++i)
        u[i] = rng_float(&p->rng);
    float aspect = (float)frame->width / (float)frame->height, tx = tr_tan_half_fov_x(camera, aspect);
    float sx = ((float)p->x + 0.5f + filter_offset(filter, u[0], u[2])) / (float)frame->width;
    float sy = ((float)p->y + 0.5f + filter_offset(filter, u[1], u[3])) / (float)frame->height;
    vec3 d = v3((1 - 2 * sx) * tx, (1 - 2 * sy) * tx / aspect, 1); /* camera space: +x is left */
    vec3 o = v3s(0);
    if (camera->aperture > 0) {
        float r = camera->aperture * sqrtf(u[4]), a = 2 * TR_PI * u[5];
        o = v3(r * cosf(a), r * sinf(a), 0);
        d = sub3(scale3(d, camera->focus), o);
    }
    p->origin = xform_point(&camera->to_world, o);
    p->direction = norm3(xform_vector(&camera->to_world, d));
}

static void start_paths(tr_worker *w, const tr_frame *frame, int tile, int sample)
{
    int x0 = tile % frame->tiles_x * TR_TILE_W, y0 = tile / frame->tiles_x * TR_TILE_H;
    int x1 = x0 + TR_TILE_W < frame->width ? x0 + TR_TILE_W : frame->width;
    int y1 = y0 + TR_TILE_H < frame->height ? y0 + TR_TILE_H : frame->height;
    w->active_count = w->vertex_count = w->link_count = w->trail_count = 0;
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            path *p = &w->paths[w->active_count];
            uint64_t pixel = (uint64_t)y * (uint64_t)frame->width + (uint64_t)x;
            uint64_t stream =
                (frame->first_sample + (uint64_t)sample) * (uint64_t)frame->width * (uint64_t)frame->height + pixel;
            p->rng = rng_seed(frame->settings->seed, 2 * stream);
            p->guide_rng = rng_seed(frame->settings->seed, 2 * stream + 1);
            p->throughput = v3s(1);
            p->radiance = v3s(0);
            p->survival = p->roulette = 1;
            p->pdf = 0;
            p->specular = true;
            p->seen = false;
            p->x = x;
            p->y = y;
            p->last = p->trail = -1;
            p->root = w->active_count;
            camera_ray(frame, p);
            w->active[w->active_count] = w->active_count;
            w->active_count++;
        }
    w->camera_count = w->path_count = w->active_count;
    w->counters.paths += (uint64_t)w->active_count;
}

/* ---- >>intersect -------------------------------------------------------------------------------------------- */

static void trace_paths(tr_worker *w, const tr_frame *frame)
{
    double start = tr_wall_seconds();
    for (int i = 0; i < w->active_count; ++i) {
        const path *p = &w->paths[w->active[i]];
        struct RTCRayHit *hit = &w->hits[w->active[i]];
        tr_trace_hit(frame->scene, p->origin, p->direction, hit);
    }
    w->counters.rays += (uint64_t)w->active_count;
    w->counters.trace += tr_wall_seconds() - start;
}

/* Radiance L towards path p counts for its camera path. */
static void add_radiance(tr_worker *w, const path *p, vec3 L)
{
    path *root = &w->paths[p->root];
    root->radiance = add3(root->radiance, mul3(p->throughput, L));
}

/* MIS weight of emission met by a traced direction against NEE. */
static float emission_weight(const tr_frame *frame, const path *p, const tr_surface *hit)
{
    if (p->specular || !frame->nee)
        return 1;
    float light = tr_light_pdf(frame->scene, p->origin, p->direction, hit);
    if (!(light > 0))
        return 1; /* nothing that NEE could have sampled */
    return frame->settings->no_bsdf_hits ? 0 : balance(p->pdf, light);
}

static link *push_link(tr_worker *w, path *p)
{
    link *l = &w->links[w->link_count];
    memset(l, 0, sizeof *l);
    l->previous = p->last;
    l->vertex = -1;
    p->last = w->link_count++;
    if (p->trail < 0) {
        p->trail = w->trail_count++;
        w->trails[p->trail].join = -1;
    }
    w->trails[p->trail].last = p->last;
    return l;
}

/* The surface that path id met, and what it emits. Returns whether the path can scatter there. */
static bool meet(tr_worker *w, const tr_frame *frame, int id, int depth, bool recording)
{
    const tr_scene *scene = frame->scene;
    path *p = &w->paths[id];
    const struct RTCRayHit *hit = &w->hits[id];
    tr_surface *s = &w->surfaces[id];
    bool met = hit->hit.geomID != RTC_INVALID_GEOMETRY_ID;
    vec3 emitted = v3s(0);
    bool visible = depth > 0 || !scene->hide_emitters;
    if (met) {
        tr_surface_from_hit_lean(scene, hit, s);
        if (scene->shapes[s->shape].light >= 0 && visible)
            emitted = tr_surface_emission(scene, s, neg3(p->direction));
    } else if (visible && scene->environment_count) {
        emitted = tr_environment(scene, p->direction);
    }
    if (!black3(emitted)) {
        emitted = scale3(emitted, emission_weight(frame, p, met ? s : NULL));
        add_radiance(w, p, emitted);
    }
    if (recording) {
        link *l = push_link(w, p);
        l->emitted = emitted;
        l->environment = !met;
        l->distance = met ? s->t : INFINITY;
        l->normal = met ? s->ng : v3s(0);
    }
    return met && depth + 1 < frame->max_depth;
}

/* Emission of whatever the rays met; then the closures there, in a second loop so that textures have time to come from
   memory. Paths that end are dropped from the active list. */
static void arrive(tr_worker *w, const tr_frame *frame, int depth, bool recording)
{
    const tr_scene *scene = frame->scene;
    int met = 0, kept = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        if (i + 16 < w->active_count)
            tr_surface_prefetch(scene, &w->hits[w->active[i + 16]], 0);
        if (i + 8 < w->active_count)
            tr_surface_prefetch(scene, &w->hits[w->active[i + 8]], 1);
        if (meet(w, frame, id, depth, recording)) {
            tr_closure_prefetch(scene, &w->surfaces[id]);
            w->active[met++] = id;
        }
    }
    for (int i = 0; i < met; ++i) {
        int id = w->active[i];
        if (tr_closure_prepare(scene, &w->surfaces[id], neg3(w->paths[id].direction), &w->closures[id]))
            w->active[kept++] = id;
    }
    w->active_count = kept;
}

/* First-hit layers. */
static void deposit_layers(tr_worker *w, const tr_frame *frame)
{
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        const path *p = &w->paths[id];
        size_t pixel = (size_t)p->y * (size_t)frame->width + (size_t)p->x;
        vec3 albedo = tr_closure_albedo(&w->closures[id]), n = w->closures[id].frame.n;
        float *a = frame->albedo + 3 * pixel, *m = frame->normal + 3 * pixel;
        a[0] += albedo.x, a[1] += albedo.y, a[2] += albedo.z;
        m[0] += n.x, m[1] += n.y, m[2] += n.z;
    }
}

/* ---- >>find ------------------------------------------------------------------------------------------------- */

static void find_handles(tr_worker *w, const tr_frame *frame)
{
    bool guiding = frame->guiding;
    w->smooth_count = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i], k = w->smooth_count;
        const tr_closure *c = &w->closures[id];
        w->place[id] = -1;
        if (c->delta_probability >= 1)
            continue;
        w->place[id] = k;
        w->smooth[k] = id;
        w->smooth_count++;
        w->alpha[k] = 1;
        if (!guiding)
            continue;
        w->p[k] = w->surfaces[id].p;
        w->side[k] = c->transmits ? v3s(0) : c->frame.n;
        w->wo[k] = neg3(w->paths[id].direction);
        w->roughness[k] = c->roughness;
        for (int j = 0; j < 3; ++j)
            w->find_u[k][j] = rng_float(&w->paths[id].guide_rng);
    }
    if (!guiding || w->smooth_count == 0)
        return;
    double start = tr_wall_seconds();
    tr_lookup lookup = {w->smooth_count, w->p, w->side, w->wo, w->roughness, (const float(*)[3])w->find_u};
    frame->method->find(frame->method_data, &lookup, w->handles, w->alpha);
    w->counters.query += tr_wall_seconds() - start;
    for (int k = 0; k < w->smooth_count; ++k)
        w->counters.guided_vertices += w->alpha[k] < 1;
    w->counters.vertices += (uint64_t)w->smooth_count;
}

/* The alpha, cell and depth layers: at the first vertex of each path that could be guided. */
static void describe_vertices(tr_worker *w, const tr_frame *frame)
{
    float cell[TR_PATHS], depth[TR_PATHS];
    bool describe = frame->describe && frame->guiding && frame->method->describe && w->smooth_count > 0;
    if (describe)
        frame->method->describe(frame->method_data, w->smooth_count, w->handles, cell, depth);
    for (int k = 0; k < w->smooth_count; ++k) {
        path *p = &w->paths[w->smooth[k]];
        if (p->seen)
            continue;
        size_t pixel = (size_t)p->y * (size_t)frame->width + (size_t)p->x;
        frame->alpha[pixel] += w->alpha[k];
        frame->alpha_count[pixel] += 1;
        if (describe) {
            frame->cell[pixel] = cell[k];
            frame->depth[pixel] = depth[k];
        }
    }
}

/* pdf_guide[k] for the first n entries of w->index, directions in w->wi. */
static void query_pdf(tr_worker *w, const tr_frame *frame, int n)
{
    if (n == 0)
        return;
    double start = tr_wall_seconds();
    frame->method->pdf(frame->method_data, n, w->index, w->handles, w->wi, w->pdf_guide);
    w->counters.query += tr_wall_seconds() - start;
}

/* ---- >>nee -------------------------------------------------------------------------------------------------- */

static void sample_lights(tr_worker *w, const tr_frame *frame)
{
    w->lit_count = 0;
    for (int k = 0; k < w->smooth_count; ++k) {
        int id = w->smooth[k];
        path *p = &w->paths[id];
        tr_light_sample *l = &w->lights[k];
        float u0 = rng_float(&p->rng), u1, u2;
        rng_float2(&p->rng, &u1, &u2);
        w->pdf_guide[k] = 0;
        if (!tr_light_sample_direction(frame->scene, w->surfaces[id].p, u0, u1, u2, l))
            continue;
        w->light_f[k] = tr_closure_eval(&w->closures[id], l->wi, &w->light_pdf_bsdf[k]);
        w->lit[w->lit_count] = k; /* kept by counting it: a branch would be guessed wrong */
        w->lit_count += !black3(w->light_f[k]);
    }
}

/* The mixture's density: what one-sample MIS drew from. */
static float mixture(const tr_closure *c, float alpha, float pdf_bsdf, float pdf_guide)
{
    float mix = alpha < 1 ? alpha * pdf_bsdf + (1 - alpha) * pdf_guide : pdf_bsdf;
    return (1 - c->delta_probability) * mix;
}

static void next_event(tr_worker *w, const tr_frame *frame, bool recording)
{
    int visible = 0, guided = 0;
    sample_lights(w, frame);
    double start = tr_wall_seconds();
    for (int i = 0; i < w->lit_count; ++i) {
        int k = w->lit[i];
        const tr_light_sample *l = &w->lights[k];
        const tr_surface *s = &w->surfaces[w->smooth[k]];
        struct RTCRay ray;
        vec3 origin = tr_leave_surface(frame->scene, s->p, s->ng, l->wi);
        if (isinf(l->distance))
            tr_set_ray(&ray, origin, l->wi, INFINITY);
        else /* to the sampled point: along wi from the shifted origin a curved light would shade itself */
            tr_set_ray(&ray, origin, sub3(madd3(s->p, l->wi, l->distance), origin), 1 - 1e-4f);
        w->lit[visible] = k;
        visible += !tr_rtc_occluded(frame->scene->rtc, &ray);
    }
    w->counters.trace += tr_wall_seconds() - start;
    w->counters.shadow_rays += (uint64_t)w->lit_count;
    w->lit_count = visible; /* what is in the shadow needs no weight */
    for (int i = 0; frame->guiding && i < visible; ++i) {
        int k = w->lit[i];
        if (w->alpha[k] < 1 && !w->lights[k].delta) {
            w->wi[k] = w->lights[k].wi;
            w->index[guided++] = k;
        }
    }
    query_pdf(w, frame, guided);
    for (int i = 0; i < visible; ++i) {
        int k = w->lit[i], id = w->smooth[k];
        const tr_light_sample *l = &w->lights[k];
        path *p = &w->paths[id];
        const tr_closure *c = &w->closures[id];
        float weight = 1;
        if (!l->delta && !frame->settings->no_bsdf_hits)
            weight = balance(l->pdf, mixture(c, w->alpha[k], w->light_pdf_bsdf[k], w->pdf_guide[k]));
        float cosine = fabsf(dot3(c->frame.n, l->wi));
        vec3 reflected = scale3(mul3(w->light_f[k], l->radiance), weight * cosine / l->pdf);
        add_radiance(w, p, reflected);
        if (recording)
            w->links[p->last].reflected = reflected;
    }
}

/* ---- >>scatter ---------------------------------------------------------------------------------------------- */

#define ROULETTE_DEPTH 5
/* Weight window around what the pixel needs: below LOW paths are ended, above HIGH they are split. The ratio is that of
   Vorba and Krivanek 2016, the place half of theirs: measured best over our scenes. */
#define ROULETTE_LOW (1.0f / 6)
#define ROULETTE_HIGH (5.0f / 6)
#define ROULETTE_MIN 0.1f /* no weight grows by more than ten at once */
#define ROULETTE_MOST 6   /* paths that one becomes */

/* Survival by the product of albedos. */
static float throughput_survival(tr_worker *w, int id, int depth)
{
    path *p = &w->paths[id];
    p->survival *= clampf(max3(tr_closure_albedo(&w->closures[id])), 0, 1);
    if (depth + 1 < ROULETTE_DEPTH)
        return 1;
    float q = clampf(p->survival, 0.05f, 0.95f);
    p->survival /= q;
    return q;
}

/* Expected contribution of a path, throughput times the radiance reflected here, over the pixel's estimate; negative
   where it is not known. */
static float expectation(const tr_worker *w, const tr_frame *frame, int id)
{
    const path *p = &w->paths[id];
    int k = w->place[id];
    if (k < 0 || !p->seen || !(w->reflected[k] > 0))
        return -1;
    const float *e = frame->estimate->data + 3 * ((size_t)p->y * (size_t)frame->width + (size_t)p->x);
    float pixel = (e[0] + e[1] + e[2]) * (1.0f / 3) + 0.25f * frame->estimate_floor;
    return mean3(p->throughput) * w->reflected[k] / pixel;
}

/* Let a path go on from this vertex as n paths, each with a share of 1 / n of what it would have been. */
static void split_path(tr_worker *w, const tr_frame *frame, int id, int n, bool recording)
{
    const tr_method *method = frame->method;
    int from = w->place[id], room = w->free_count + TR_PATHS - w->path_count;
    if (room > TR_PATHS - w->smooth_count) /* places of paths that roulette has ended are not used again */
        room = TR_PATHS - w->smooth_count;
    w->counters.unsplit_paths += n - 1 < room ? 0 : (uint64_t)(n - 1 - room);
    n = n - 1 < room ? n : room + 1;
    w->paths[id].roulette = 1 / (float)n;
    for (int i = 1; i < n; ++i) {
        int copy = w->free_count ? w->free[--w->free_count] : w->path_count++, k = w->smooth_count++;
        path *p = &w->paths[copy];
        *p = w->paths[id];
        uint64_t seed = (uint64_t)rng_u32(&w->paths[id].guide_rng) << 32;
        seed |= rng_u32(&w->paths[id].guide_rng);
        p->rng = rng_seed(seed, 0);
        p->guide_rng = rng_seed(seed, 1);
        p->last = p->trail = -1;
        if (recording) {
            push_link(w, p);
            w->trails[p->trail].join = w->paths[id].last;
        }
        w->surfaces[copy] = w->surfaces[id];
        w->closures[copy] = w->closures[id];
        w->place[copy] = k;
        w->smooth[k] = copy;
        w->alpha[k] = w->alpha[from];
        char *to = (char *)w->handles + (size_t)k * method->handle_size;
        const char *handle = (const char *)w->handles + (size_t)from * method->handle_size;
        if (method->copy_handle)
            method->copy_handle(to, handle);
        else
            memcpy(to, handle, method->handle_size);
        w->active[w->active_count++] = copy;
    }
    w->counters.split_paths += (uint64_t)(n - 1);
}

/* The slots of split paths that are not active any more. */
static void find_free_slots(tr_worker *w)
{
    bool alive[TR_PATHS];
    memset(alive, 0, (size_t)w->path_count * sizeof *alive);
    for (int i = 0; i < w->active_count; ++i)
        alive[w->active[i]] = true;
    w->free_count = 0;
    for (int id = w->path_count; id-- > w->camera_count;)
        if (!alive[id])
            w->free[w->free_count++] = id;
}

/* Paths that are expected to add little are ended by chance, paths that are expected to add much go on as several. */
static void guided_roulette(tr_worker *w, const tr_frame *frame, bool recording)
{
    int kept = 0, added = 0, count[TR_PATHS];
    frame->method->reflected(frame->method_data, w->smooth_count, w->handles, w->reflected);
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        float e = expectation(w, frame, id), q = e < 0 ? 1 : e / ROULETTE_LOW;
        q = q < ROULETTE_MIN ? ROULETTE_MIN : q < 1 ? q : 1;
        w->paths[id].roulette = 1 / q;
        if (q < 1 && rng_float(&w->paths[id].guide_rng) >= q)
            continue;
        count[kept] = e > ROULETTE_HIGH ? (int)ceilf(tr_min(e / ROULETTE_HIGH, ROULETTE_MOST)) : 1;
        added += count[kept] - 1;
        w->active[kept++] = id;
    }
    w->active_count = kept;
    if (added == 0)
        return;
    find_free_slots(w);
    for (int i = 0; i < kept; ++i)
        if (count[i] > 1)
            split_path(w, frame, w->active[i], count[i], recording);
}

/* Paths that lose are dropped. */
static void roulette(tr_worker *w, const tr_frame *frame, int depth, bool recording)
{
    int kept = 0;
    tr_roulette mode = frame->settings->roulette;
    if (mode == TR_ROULETTE_GUIDED && frame->guiding && frame->estimate && frame->method->reflected &&
        w->smooth_count > 0)
        guided_roulette(w, frame, recording);
    if (mode != TR_ROULETTE_THROUGHPUT)
        return;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        float q = throughput_survival(w, id, depth);
        w->paths[id].roulette = 1 / q;
        if (q < 1 && rng_float(&w->paths[id].rng) >= q)
            continue;
        w->active[kept++] = id;
    }
    w->active_count = kept;
}

/* Whether a guided vertex chooses among several directions: where the bsdf says nothing about them there is nothing to
   choose by. */
static inline bool resamples(const tr_worker *w, int id) { return w->candidates && w->closures[id].roughness < 1; }

/* Decide delta, bsdf, guide or several candidates; draw what needs no method. */
static inline void choose(tr_worker *w, int id, choice *ch)
{
    path *p = &w->paths[id];
    const tr_closure *c = &w->closures[id];
    float u0, u1, u2, u3;
    rng_float2(&p->rng, &u0, &u1);
    rng_float2(&p->rng, &u2, &u3);
    ch->kind = CHOICE_NONE;
    ch->pdf = ch->pdf_bsdf = 0;
    if (u0 < c->delta_probability) {
        if (tr_closure_sample_delta(c, u1, &ch->wi, &ch->f, &ch->pdf_bsdf))
            ch->kind = CHOICE_DELTA;
        return;
    }
    int k = w->place[id];
    if (k < 0)
        return;
    if (w->alpha[k] < 1) {
        if (resamples(w, id)) {
            ch->kind = CHOICE_RESAMPLED;
            return;
        }
        float choose_u = rng_float(&p->guide_rng);
        w->sample_u[k][0] = rng_float(&p->guide_rng);
        w->sample_u[k][1] = rng_float(&p->guide_rng);
        if (choose_u >= w->alpha[k]) {
            ch->kind = CHOICE_GUIDE;
            return;
        }
    }
    if (tr_closure_sample(c, u1, u2, u3, &ch->wi, &ch->f, &ch->pdf_bsdf))
        ch->kind = CHOICE_BSDF;
}

/* Directions of the method for the first n entries of w->index: wi and pdf_guide, by k. */
static void query_sample(tr_worker *w, const tr_frame *frame, int n)
{
    if (n == 0)
        return;
    double start = tr_wall_seconds();
    frame->method->sample(frame->method_data, n, w->index, w->handles, (const float(*)[2])w->sample_u, w->wi,
                          w->pdf_guide);
    w->counters.query += tr_wall_seconds() - start;
}

/* What the bsdf says of the direction that the method drew at place k. */
static void complete_guided(tr_worker *w, int k, choice *ch)
{
    ch->wi = w->wi[k];
    ch->f = w->pdf_guide[k] > 0 ? tr_closure_eval(&w->closures[w->smooth[k]], ch->wi, &ch->pdf_bsdf) : v3s(0);
}

/* Candidate j of each vertex that resamples: of n, alpha n come from the bsdf, with no more chance than it takes. */
static void draw_candidates(tr_worker *w, const tr_frame *frame, int j)
{
    int n = frame->candidates, guided = 0, asked = 0;
    for (int i = 0; i < w->several_count; ++i) {
        int k = w->several[i], id = w->smooth[k];
        tr_rng *rng = &w->paths[id].guide_rng;
        candidate *c = &w->candidates[i * n + j];
        float u0 = rng_float(rng), u1, u2;
        rng_float2(rng, &u1, &u2);
        memset(c, 0, sizeof *c);
        if (u0 >= w->alpha[k] * (float)n - (float)j) {
            c->choice.kind = CHOICE_GUIDE;
            w->sample_u[k][0] = u1;
            w->sample_u[k][1] = u2;
            w->index[guided++] = k;
        } else if (tr_closure_sample(&w->closures[id], rng_float(rng), u1, u2, &c->choice.wi, &c->choice.f,
                                     &c->choice.pdf_bsdf)) {
            c->choice.kind = CHOICE_BSDF;
        }
    }
    query_sample(w, frame, guided);
    for (int i = 0; i < w->several_count; ++i) {
        int k = w->several[i];
        candidate *c = &w->candidates[i * n + j];
        if (c->choice.kind == CHOICE_GUIDE) {
            complete_guided(w, k, &c->choice);
            c->pdf_guide = w->pdf_guide[k];
        } else if (c->choice.kind == CHOICE_BSDF) {
            w->wi[k] = c->choice.wi;
            w->index[asked++] = k;
        }
    }
    query_pdf(w, frame, asked);
    for (int i = 0; i < w->several_count; ++i) {
        candidate *c = &w->candidates[i * n + j];
        if (c->choice.kind == CHOICE_BSDF)
            c->pdf_guide = w->pdf_guide[w->several[i]];
    }
}

/* Resampled importance sampling (Talbot et al. 2005): the method chooses a candidate. Where it takes none, one of them
   stays to be recorded, as refused. */
static void choose_candidate(tr_worker *w, const tr_frame *frame, int k, const candidate *c, choice *ch)
{
    int id = w->smooth[k], n = frame->candidates, at;
    const void *handle = (const char *)w->handles + (size_t)k * frame->method->handle_size;
    tr_candidate offers[TR_MAX_CANDIDATES];
    float pdf;
    for (int j = 0; j < n; ++j) {
        float cosine = fabsf(dot3(w->closures[id].frame.n, c[j].choice.wi)), f = mean3(c[j].choice.f);
        offers[j] = (tr_candidate){c[j].choice.pdf_bsdf, c[j].pdf_guide, f, cosine};
    }
    at = frame->method->resample(frame->method_data, handle, offers, n, w->alpha[k], rng_float(&w->paths[id].guide_rng),
                                 &pdf);
    if (!(pdf > 0))
        at = n;
    ch->kind = CHOICE_NONE;
    for (int j = 0; at == n && j < n && ch->kind == CHOICE_NONE; ++j) {
        *ch = c[j].choice;
        ch->f = v3s(0);
        w->pdf_guide[k] = c[j].pdf_guide;
    }
    if (at == n)
        return;
    *ch = c[at].choice;
    ch->pdf = pdf;
    w->pdf_guide[k] = c[at].pdf_guide;
}

static void choose_among_several(tr_worker *w, const tr_frame *frame, choice *choices)
{
    for (int j = 0; j < frame->candidates; ++j)
        draw_candidates(w, frame, j);
    for (int i = 0; i < w->several_count; ++i) {
        int k = w->several[i];
        choose_candidate(w, frame, k, &w->candidates[i * frame->candidates], &choices[w->smooth[k]]);
    }
}

/* Make all choices and complete the guided ones (f and bsdf pdf) and the guide's pdf of bsdf choices. */
static void choose_guided(tr_worker *w, const tr_frame *frame, choice *choices)
{
    int guided = 0, asked = 0;
    w->several_count = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        choose(w, id, &choices[id]);
        if (choices[id].kind == CHOICE_GUIDE)
            w->index[guided++] = w->place[id];
        else if (choices[id].kind == CHOICE_RESAMPLED)
            w->several[w->several_count++] = w->place[id];
    }
    query_sample(w, frame, guided);
    for (int i = 0; i < guided; ++i)
        complete_guided(w, w->index[i], &choices[w->smooth[w->index[i]]]);
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i], k = w->place[id];
        if (choices[id].kind == CHOICE_BSDF && w->alpha[k] < 1) {
            w->wi[k] = choices[id].wi;
            w->index[asked++] = k;
        }
    }
    query_pdf(w, frame, asked);
    if (w->several_count)
        choose_among_several(w, frame, choices);
}

static void fill_vertex(tr_worker *w, const tr_frame *frame, int id, const choice *ch, float cosine, float pdf_mix,
                        vec3 throughput)
{
    path *p = &w->paths[id];
    const tr_surface *s = &w->surfaces[id];
    const tr_closure *c = &w->closures[id];
    int k = w->place[id];
    float smooth = 1 - c->delta_probability;
    tr_vertex *v = &w->vertices[w->vertex_count];
    w->links[p->last].vertex = w->vertex_count++;
    v->p = s->p;
    v->ng = s->ng;
    v->ns = c->frame.n;
    v->wo = neg3(p->direction);
    v->wi = ch->wi;
    v->f = ch->f;
    v->cosine = cosine;
    v->roughness = c->roughness;
    v->pdf_mix = pdf_mix;
    v->pdf_bsdf = smooth * ch->pdf_bsdf;
    v->alpha = w->alpha[k];
    v->pdf_guide = v->alpha < 1 ? smooth * w->pdf_guide[k] : 0;
    v->u = 0;
    v->flags = (p->seen ? 0 : TR_VERTEX_FIRST) | (c->transmits ? TR_VERTEX_PASSES : 0);
    v->flags |= ch->kind == CHOICE_GUIDE ? TR_VERTEX_GUIDED : 0;
    if (black3(ch->f))
        v->flags |= TR_VERTEX_REJECTED;
    v->pixel_weight = throughput;
    if (frame->estimate) {
        const float *e = frame->estimate->data + 3 * ((size_t)p->y * (size_t)frame->width + (size_t)p->x);
        float floor = frame->estimate_floor;
        v->pixel_weight =
            v3(throughput.x / (e[0] + floor), throughput.y / (e[1] + floor), throughput.z / (e[2] + floor));
    }
    v->distance = 0;
    v->next_normal = v3s(0);
    v->L = v3s(0);
}

/* Turn a choice into the next ray; false = the path ends. */
static inline bool follow(tr_worker *w, const tr_frame *frame, int id, const choice *ch, bool recording)
{
    path *p = &w->paths[id];
    const tr_closure *c = &w->closures[id];
    float pdf = 0;
    vec3 weight;
    if (ch->kind == CHOICE_NONE)
        return false;
    if (ch->kind == CHOICE_DELTA) {
        weight = scale3(ch->f, p->roulette / c->delta_probability);
        p->survival *= ch->pdf_bsdf;
    } else {
        int k = w->place[id];
        pdf = mixture(c, w->alpha[k], ch->pdf_bsdf, w->pdf_guide[k]);
        float cosine = fabsf(dot3(c->frame.n, ch->wi));
        float divisor = ch->pdf > 0 ? (1 - c->delta_probability) * ch->pdf : pdf;
        if (!(pdf > 0))
            return false;
        weight = scale3(ch->f, p->roulette * cosine / divisor);
        if (recording)
            fill_vertex(w, frame, id, ch, cosine, divisor, scale3(p->throughput, p->roulette));
    }
    if (!finite3(weight) || max3(weight) <= 0)
        return false;
    if (recording)
        w->links[p->last].weight = weight;
    p->throughput = mul3(p->throughput, weight);
    p->roulette = 1;
    p->specular = ch->kind == CHOICE_DELTA;
    p->seen |= ch->kind != CHOICE_DELTA;
    p->pdf = pdf;
    p->direction = ch->wi;
    p->origin = tr_leave_surface(frame->scene, w->surfaces[id].p, w->surfaces[id].ng, ch->wi);
    return true;
}

static void scatter(tr_worker *w, const tr_frame *frame, bool recording)
{
    choice choices[TR_PATHS];
    bool guiding = frame->guiding;
    if (guiding)
        choose_guided(w, frame, choices);
    int kept = 0;
    for (int i = 0; i < w->active_count; ++i) {
        int id = w->active[i];
        if (!guiding) /* nobody to ask in between: the vertex stays in the nearest cache */
            choose(w, id, &choices[0]);
        if (follow(w, frame, id, &choices[guiding ? id : 0], recording))
            w->active[kept++] = id;
    }
    w->active_count = kept;
}

/* ---- >>record ----------------------------------------------------------------------------------------------- */

/* Walk each path from its end, so that a vertex knows the radiance its direction brought. Split ones come before what
   they were split from: what they bring is reflected there. */
static void carry_back(tr_worker *w)
{
    for (int t = w->trail_count; t-- > 0;) {
        vec3 incident = v3s(0);
        float beyond = 0; /* from `next`, where it is a delta vertex, to what is seen in it */
        const link *next = NULL;
        for (int at = w->trails[t].last; at >= 0; at = w->links[at].previous) {
            const link *l = &w->links[at];
            beyond = next ? next->distance + (next->vertex < 0 ? beyond : 0) : 0;
            if (l->vertex >= 0) {
                tr_vertex *v = &w->vertices[l->vertex];
                v->L = incident;
                if (next) {
                    v->distance = beyond;
                    v->next_normal = next->normal;
                }
            }
            incident = add3(l->emitted, add3(l->reflected, mul3(l->weight, incident)));
            next = l;
        }
        if (w->trails[t].join >= 0) {
            link *from = &w->links[w->trails[t].join];
            from->reflected = add3(from->reflected, incident);
        }
    }
}

static void deposit(tr_worker *w, const tr_frame *frame, int camera_paths)
{
    for (int id = 0; id < camera_paths; ++id) {
        const path *p = &w->paths[id];
        size_t at = 3 * ((size_t)p->y * (size_t)frame->width + (size_t)p->x);
        if (!finite3(p->radiance)) {
            w->counters.bad_samples++;
            continue;
        }
        const float value[3] = {p->radiance.x, p->radiance.y, p->radiance.z};
        for (int c = 0; c < 3; ++c) {
            frame->sum[at + (size_t)c] += value[c];
            frame->sum_squares[at + (size_t)c] += (double)value[c] * value[c];
        }
    }
}

static void trace_batch(tr_worker *w, const tr_frame *frame, int tile, int sample, bool recording)
{
    start_paths(w, frame, tile, sample);
    int camera_paths = w->active_count;
    for (int depth = 0; w->active_count > 0 && depth < frame->max_depth; ++depth) {
        if (!reserve(w, recording)) {
            w->counters.out_of_memory = true;
            return;
        }
        trace_paths(w, frame);
        arrive(w, frame, depth, recording);
        if (depth == 0)
            deposit_layers(w, frame);
        find_handles(w, frame);
        describe_vertices(w, frame);
        if (frame->nee && w->smooth_count > 0 && frame->scene->light_count > 0)
            next_event(w, frame, recording);
        roulette(w, frame, depth, recording);
        scatter(w, frame, recording);
    }
    deposit(w, frame, camera_paths);
    if (recording) {
        double start = tr_wall_seconds();
        carry_back(w);
        if (!frame->method->record(frame->method_data, tile, w->vertices, w->vertex_count))
            w->counters.out_of_memory = true;
        w->counters.record += tr_wall_seconds() - start;
    }
}

void tr_render_tile(tr_worker *w, const tr_frame *frame, int tile)
{
    tr_flush_denormals();
    double start = tr_wall_seconds();
    bool recording = frame->record && frame->method->record &&
                     (!frame->method->wants_records || frame->method->wants_records(frame->method_data, tile));
    for (int s = 0; s < frame->samples; ++s)
        trace_batch(w, frame, tile, s, recording);
    w->counters.total += tr_wall_seconds() - start;
}
