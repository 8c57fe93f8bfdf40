/* integrator.h: the wavefront integrator's seam to the pass loop. */
#ifndef TR_INTEGRATOR_H
#define TR_INTEGRATOR_H

#include "tracer.h"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

/* Numbers below the normal ones are 0 on this thread from now on: they say nothing here and are slow. */
static inline void tr_flush_denormals(void)
{
#if defined(__SSE2__)
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _mm_setcsr(_mm_getcsr() | 0x0040); /* denormals are zero */
#endif
}

static inline void tr_set_ray(struct RTCRay *ray, vec3 o, vec3 d, float far)
{
    ray->org_x = o.x;
    ray->org_y = o.y;
    ray->org_z = o.z;
    ray->tnear = 0;
    ray->dir_x = d.x;
    ray->dir_y = d.y;
    ray->dir_z = d.z;
    ray->time = 0;
    ray->tfar = far;
    ray->mask = 0xffffffffu;
    ray->id = 0;
    ray->flags = 0;
}

/* The nearest hit from o along d. */
static inline void tr_trace_hit(const tr_scene *scene, vec3 o, vec3 d, struct RTCRayHit *hit)
{
    tr_set_ray(&hit->ray, o, d, INFINITY);
    hit->hit.geomID = RTC_INVALID_GEOMETRY_ID;
    hit->hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
    tr_rtc_intersect(scene->rtc, hit);
}

/* Leave the surface at p on the side of w, by a step that covers rounding of the hit point. */
static inline vec3 tr_leave_surface(const tr_scene *scene, vec3 p, vec3 ng, vec3 w)
{
    float size = max3(v3(fabsf(p.x), fabsf(p.y), fabsf(p.z)));
    float step = 2e-5f * tr_max(size, 0.01f * scene->bounds_radius);
    return madd3(p, ng, dot3(ng, w) < 0 ? -step : step);
}

#define TR_TILE_W 32
#define TR_TILE_H 16
#define TR_BATCH (TR_TILE_W * TR_TILE_H)
#define TR_PATHS (4 * TR_BATCH) /* with those that are split off: where they run out, paths stay whole */

/* What every tile of a pass shares. Pixels belong to one tile and a tile to one thread at a time: no locks. */
typedef struct tr_frame {
    const tr_scene *scene;
    const tr_settings *settings;
    const tr_method *method;
    void *method_data;
    int width, height, tiles_x, tiles_y;
    int max_depth;
    bool nee;
    /* of this pass */
    uint64_t first_sample; /* index of the round's first sample per pixel, over the whole render */
    int samples;           /* samples per pixel to take now */
    bool record;
    int candidates;           /* directions that a guided vertex chooses from, 1 .. TR_MAX_CANDIDATES */
    bool guiding;             /* some vertex may be guided: ask the method */
    bool describe;            /* fill the cell and depth layers from this round's first sample */
    const tr_image *estimate; /* pixel estimate for the records' weights, or NULL */
    float estimate_floor;
    /* sums over the samples of this pass, double [height][width][3] */
    double *sum, *sum_squares;
    /* first-hit layers, summed over the pass: albedo 3, normal 3; alpha 1 and its count 1 */
    float *albedo, *normal, *alpha, *alpha_count, *cell, *depth;
} tr_frame;

typedef struct tr_counters {
    double trace, record, query, total; /* seconds on the worker's clock */
    uint64_t rays, shadow_rays, paths, bad_samples, guided_vertices, vertices, split_paths, unsplit_paths;
    bool out_of_memory;
} tr_counters;

typedef struct tr_worker tr_worker;

/* Variances of the latest passes, each with the samples per pixel that had been learned from before it. */
#define TR_TREND_MAX 16
typedef struct tr_trend {
    int count;
    double learned[TR_TREND_MAX], variance[TR_TREND_MAX];
} tr_trend;

/* Forgets the oldest when full. Nothing happens where either number is not positive. */
void tr_trend_add(tr_trend *trend, double learned, double variance);
/* Whether it pays to learn from the samples of the next pass: `spent` and `left` are CPU seconds of passes that taught
   and of the rest of the budget, `share` is the share of a pass's time that learning takes. */
bool tr_learning_pays(const tr_trend *trend, double spent, double left, double share);

float tr_tan_half_fov_x(const tr_camera *camera, float aspect); /* aspect: width over height */

tr_worker *tr_worker_create(const tr_frame *frame);
void tr_worker_destroy(tr_worker *worker);
tr_counters *tr_worker_counters(tr_worker *worker);
/* Trace `frame->samples` paths through every pixel of the tile, add them up and record them. */
void tr_render_tile(tr_worker *worker, const tr_frame *frame, int tile);

#endif
