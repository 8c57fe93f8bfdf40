/* train_histogram.c: the network of photon_net.h, from nothing to its weights: random rooms, photons in them as the
   renderer traces them, and what hundreds of times as many say of the same voxels; then its training, which may be
   stopped and goes on from its checkpoint.

     build/train_histogram --data rooms.safetensors --rooms 120 --seconds 1800 --weights histogram.safetensors

   On held-out rooms it prints what maps are worth to sample from, for the network and the filters of guide_photon.h.
   build/train_histogram --help lists the options.

     >>options  command line           >>files  data sets
     >>rooms    random scenes          >>judge  what maps are worth
     >>data     examples               >>train  steps, checkpoints, curve
     >>fields   inputs                 >>main
     >>dense    truths */
#include "bench/plot.h"
#include "photon_net.h"
#include "scene_internal.h"
#include "threads.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* ---- >>options ---------------------------------------------------------------------------------------------- */

enum { MAX_DATA = 8 };

typedef struct options {
    const char *data[MAX_DATA], *scene, *checkpoint, *weights, *curve;
    int data_count;
    double rooms, room_seconds, seconds, steps, seed, threads, batch, rate, lambda, deep, features;
    uint32_t channels[GNN_MAX_LEVELS];
} options;

static void die(const char *what, const char *why)
{
    fprintf(stderr, "train_histogram: %s: %s\n", what, why);
    exit(1);
}

static void *need(void *p)
{
    if (!p)
        die("out of memory", "fewer rooms or a smaller --batch need less");
    return p;
}

/* ---- >>rooms ------------------------------------------------------------------------------------------------ */

static float within(tr_rng *r, float low, float high) { return low + (high - low) * rng_float(r); }
static float log_within(tr_rng *r, float low, float high) { return low * powf(high / low, rng_float(r)); }
static bool chance(tr_rng *r, float p) { return rng_float(r) < p; }

static vec3 colour(tr_rng *r, float low, float high)
{
    float base = within(r, low, high);
    return chance(r, 0.6f) ? v3s(base) : v3(base, base * within(r, 0.4f, 1), base * within(r, 0.3f, 1));
}

static int add_bsdf(tr_scene *s, tr_bsdf_type type)
{
    int id = tr_scene_add_bsdf(s, type);
    need(id < 0 ? NULL : s);
    return id;
}

static int add_light(tr_scene *s, tr_light_type type)
{
    int id = tr_scene_add_light(s, type);
    need(id < 0 ? NULL : s);
    return id;
}

/* Diffuse, plastic, metal or glass; what is opaque on both sides. */
static int any_bsdf(tr_scene *s, tr_rng *r, float smooth)
{
    float u = rng_float(r);
    int id, two;
    if (u < smooth * 0.5f) {
        id = add_bsdf(s, TR_BSDF_DIELECTRIC);
        s->bsdfs[id].ior = within(r, 1.3f, 1.8f);
        return id;
    }
    if (u < smooth * 0.6f) {
        id = add_bsdf(s, TR_BSDF_ROUGHDIELECTRIC);
        s->bsdfs[id].alpha.value = v3s(within(r, 0.05f, 0.4f));
        return id;
    }
    if (u < smooth * 0.9f) {
        id = add_bsdf(s, TR_BSDF_ROUGHCONDUCTOR);
        s->bsdfs[id].alpha.value = v3s(log_within(r, 0.02f, 0.5f));
    } else if (u < smooth) {
        id = add_bsdf(s, TR_BSDF_CONDUCTOR);
    } else if (u < smooth + 0.2f) {
        id = add_bsdf(s, TR_BSDF_ROUGHPLASTIC);
        s->bsdfs[id].reflectance.value = colour(r, 0.1f, 0.8f);
        s->bsdfs[id].alpha.value = v3s(log_within(r, 0.03f, 0.4f));
    } else {
        id = add_bsdf(s, TR_BSDF_DIFFUSE);
        s->bsdfs[id].reflectance.value = colour(r, 0.1f, 0.85f);
    }
    two = add_bsdf(s, TR_BSDF_TWOSIDED);
    s->bsdfs[two].child[0] = id;
    return two;
}

static mat4 placed(vec3 at, vec3 axis, float degrees, vec3 scale)
{
    mat4 t = mat4_translate(at), r = mat4_rotate(axis, degrees), z = mat4_scale(scale), tr = mat4_mul(&t, &r);
    return mat4_mul(&tr, &z);
}

static tr_shape *add_shape(tr_scene *s, int bsdf)
{
    int id = tr_scene_add_shape(s);
    need(id < 0 ? NULL : s);
    s->shapes[id].bsdf = bsdf;
    return &s->shapes[id];
}

static void add_cube(tr_scene *s, int bsdf, vec3 low, vec3 high)
{
    mat4 m = placed(scale3(add3(low, high), 0.5f), v3(0, 1, 0), 0, scale3(sub3(high, low), 0.5f));
    need(tr_shape_cube(add_shape(s, bsdf), &m) ? s : NULL);
}

static void shine(tr_scene *s, tr_shape *shape, vec3 radiance)
{
    int id = (int)(shape - s->shapes), light = add_light(s, TR_LIGHT_AREA);
    s->lights[light].value = radiance;
    s->lights[light].shape = id;
    s->shapes[id].light = light;
}

/* A wall of the room, within [low, high] (flat along one axis), with or without a window. */
static void add_wall(tr_scene *s, tr_rng *r, int bsdf, vec3 low, vec3 high, bool window)
{
    bool along_x = high.x - low.x > high.z - low.z;
    float a = along_x ? low.x : low.z, b = along_x ? high.x : high.z;
    float from = within(r, a, a + 0.6f * (b - a)), to = within(r, from + 0.1f * (b - a), b);
    float bottom = within(r, low.y, 0.6f * high.y), top = within(r, bottom + 0.1f * high.y, high.y);
    if (!window) {
        add_cube(s, bsdf, low, high);
        return;
    }
    for (int k = 0; k < 4; ++k) {
        vec3 lo = low, hi = high;
        if (k == 0)
            hi.y = bottom;
        else if (k == 1)
            lo.y = top;
        else {
            lo.y = bottom, hi.y = top;
            *(along_x ? (k == 2 ? &hi.x : &lo.x) : (k == 2 ? &hi.z : &lo.z)) = k == 2 ? from : to;
        }
        if (hi.x - lo.x > 1e-3f && hi.y - lo.y > 1e-3f && hi.z - lo.z > 1e-3f)
            add_cube(s, bsdf, lo, hi);
    }
}

static void add_walls(tr_scene *s, tr_rng *r, vec3 size, bool window)
{
    const float t = 0.1f;
    int bsdfs[3], open = (int)(rng_float(r) * 4);
    for (int k = 0; k < 3; ++k) {
        int id = add_bsdf(s, TR_BSDF_DIFFUSE);
        bsdfs[k] = add_bsdf(s, TR_BSDF_TWOSIDED);
        s->bsdfs[id].reflectance.value = colour(r, 0.2f, 0.85f);
        s->bsdfs[bsdfs[k]].child[0] = id;
    }
    if (chance(r, 0.2f))
        bsdfs[0] = any_bsdf(s, r, 0);
    add_cube(s, bsdfs[0], v3(-t, -t, -t), v3(size.x + t, 0, size.z + t));
    add_cube(s, bsdfs[1], v3(-t, size.y, -t), v3(size.x + t, size.y + t, size.z + t));
    add_wall(s, r, bsdfs[1], v3(-t, 0, 0), v3(0, size.y, size.z), window && open == 0);
    add_wall(s, r, bsdfs[2], v3(size.x, 0, 0), v3(size.x + t, size.y, size.z), window && open == 1);
    add_wall(s, r, bsdfs[2], v3(-t, 0, -t), v3(size.x + t, size.y, 0), window && open == 2);
    add_wall(s, r, bsdfs[1], v3(-t, 0, size.z), v3(size.x + t, size.y, size.z + t), window && open == 3);
    if (chance(r, 0.35f)) { /* a wall between two parts, with a way through */
        float x = size.x * within(r, 0.3f, 0.7f), gap = within(r, 0.03f, 0.5f) * size.z;
        if (chance(r, 0.5f))
            add_cube(s, bsdfs[1], v3(x, 0, 0), v3(x + t, size.y, size.z - gap));
        else
            add_cube(s, bsdfs[1], v3(x, 0, gap), v3(x + t, size.y, size.z));
    }
}

static vec3 inside(tr_rng *r, vec3 size, float margin)
{
    return v3(within(r, margin, size.x - margin), within(r, margin, size.y - margin),
              within(r, margin, size.z - margin));
}

static void add_things(tr_scene *s, tr_rng *r, vec3 size, float smooth)
{
    int count = 2 + (int)(rng_float(r) * 12);
    bool tessellated;
    for (int k = 0; k < count; ++k) {
        int bsdf = any_bsdf(s, r, smooth);
        float radius = log_within(r, 0.06f, 0.6f), half = log_within(r, 0.05f, 0.7f);
        vec3 at = inside(r, size, 0.3f);
        mat4 m = mat4_identity();
        tr_shape *shape = add_shape(s, bsdf);
        if (chance(r, 0.7f))
            at.y = radius; /* on the floor */
        if (chance(r, 0.4f)) {
            need(tr_shape_sphere(shape, &m, at, radius, &tessellated) ? s : NULL);
        } else if (chance(r, 0.3f)) {
            vec3 to = madd3(at, sample_uniform_sphere(rng_float(r), rng_float(r)), 2 * half);
            need(tr_shape_cylinder(shape, &m, at, to, 0.4f * radius, &tessellated) ? s : NULL);
        } else {
            m = placed(at, v3(0, 1, 0), within(r, 0, 90), v3(half, radius, log_within(r, 0.05f, 0.7f)));
            need(tr_shape_cube(shape, &m) ? s : NULL);
        }
    }
}

static void add_spot(tr_scene *s, tr_rng *r, vec3 size, float power)
{
    int id = add_light(s, TR_LIGHT_SPOT);
    tr_light *l = &s->lights[id];
    float degrees = log_within(r, 1, 40);
    l->value = scale3(v3s(power), 1 / (1 - cosf(degrees * TR_PI / 180)));
    l->position = inside(r, size, 0.4f);
    l->direction = norm3(sub3(inside(r, size, 0.1f), l->position));
    l->cutoff_cos = cosf(degrees * TR_PI / 180);
    l->beam_cos = cosf(0.75f * degrees * TR_PI / 180);
}

/* A rectangle or ball that shines; some in a tube that lets light out on one side. */
static void add_lamp(tr_scene *s, tr_rng *r, vec3 size, float power)
{
    float half = log_within(r, 0.03f, 0.5f);
    vec3 at = inside(r, size, 0.5f), down = v3(0, -1, 0), d;
    int gray = any_bsdf(s, r, 0);
    bool tessellated;
    mat4 m = mat4_identity();
    if (chance(r, 0.3f)) { /* a bare bulb */
        tr_shape *shape = add_shape(s, gray);
        half *= 0.4f;
        need(tr_shape_sphere(shape, &m, at, half, &tessellated) ? s : NULL);
        shine(s, shape, v3s(power / (half * half)));
        return;
    }
    d = chance(r, 0.5f) ? down : sample_uniform_sphere(rng_float(r), rng_float(r));
    at.y = chance(r, 0.5f) ? size.y - 0.02f - 0.5f * half * (d.y != -1) : at.y;
    if (!mat4_lookat(at, add3(at, d), fabsf(d.y) > 0.9f ? v3(1, 0, 0) : v3(0, 1, 0), &m))
        return;
    mat4 scale = mat4_scale(v3(half, half * log_within(r, 0.3f, 1), 1));
    m = mat4_mul(&m, &scale);
    tr_shape *shape = add_shape(s, gray);
    need(tr_shape_rectangle(shape, &m) ? s : NULL);
    shine(s, shape, v3s(power / (half * half)));
    if (chance(r, 0.5f)) {
        mat4 identity = mat4_identity();
        vec3 from = madd3(at, d, -0.02f), to = madd3(at, d, half * within(r, 0.5f, 4));
        need(tr_shape_cylinder(add_shape(s, gray), &identity, from, to, 1.5f * half, &tessellated) ? s : NULL);
    }
}

static void add_lights(tr_scene *s, tr_rng *r, vec3 size, bool window)
{
    int count = (int)(rng_float(r) * 3) + !window;
    if (window) {
        int id = add_light(s, chance(r, 0.6f) ? TR_LIGHT_CONSTANT : TR_LIGHT_SUN);
        tr_light *l = &s->lights[id];
        l->value = v3s(5);
        if (l->type == TR_LIGHT_SUN) {
            l->direction = norm3(v3(within(r, -1, 1), within(r, -1, -0.2f), within(r, -1, 1)));
            l->cutoff_cos = cosf(log_within(r, 0.3f, 20) * TR_PI / 180);
            l->value = scale3(v3s(5), 1 / (1 - l->cutoff_cos));
        }
    }
    for (int k = 0; k < count; ++k) {
        float power = log_within(r, 0.2f, 5);
        if (chance(r, 0.35f))
            add_spot(s, r, size, power);
        else
            add_lamp(s, r, size, power);
    }
}

static tr_scene *make_room(tr_rng *r, vec3 *room_size)
{
    tr_scene *s = need(tr_scene_new());
    tr_log log = {0};
    vec3 size = v3(within(r, 2, 8), within(r, 2.2f, 4), within(r, 2, 8));
    bool window = chance(r, 0.25f);
    *room_size = size;
    add_walls(s, r, size, window);
    add_things(s, r, size, chance(r, 0.3f) ? 0 : within(r, 0, 0.7f));
    add_lights(s, r, size, window);
    if (!tr_scene_finish(s, 1, &log))
        die("a room", log.last);
    return s;
}

/* ---- >>data ------------------------------------------------------------------------------------------------- */

enum { REPAIRED, FEATURES, TRUTH_A = FEATURES + 4, TRUTH_B, TRAIN_PLANES };
/* Of held-out rooms also what other filters make of the histogram. */
enum { SIGMA_07 = TRAIN_PLANES, SIGMA_14, SIGMA_28, PYRAMID, PULL_PUSH, HELD_PLANES };
static const char *const filter_names[] = {"sigma 0.7", "sigma 1.4", "sigma 2.8", "pyramid", "pull-push"};
enum { FIELDS = 1 + HELD_PLANES - TRAIN_PLANES };
enum { HELD_EVERY = 6 }; /* one room of as many is held out */

typedef struct set {
    float *maps;    /* [capacity][planes][PN_AREA] */
    float *photons; /* [capacity][2]: of the input, of the truth */
    uint32_t count, capacity, planes;
    bool histogram_only; /* the network is shown S_t alone */
} set;

static void set_reserve(set *s, uint32_t capacity)
{
    s->capacity = capacity;
    s->maps =
        need(realloc(s->maps, ((size_t)capacity * s->planes * PN_AREA + 1) * sizeof(float))); /* 0 is no failure */
    s->photons = need(realloc(s->photons, ((size_t)capacity * 2 + 1) * sizeof(float)));
}

static float *set_push(set *s)
{
    if (s->count == s->capacity)
        set_reserve(s, s->capacity ? 2 * s->capacity : 256);
    return s->maps + (size_t)s->count++ * s->planes * PN_AREA;
}
static float *set_map(const set *s, uint32_t i) { return s->maps + (size_t)i * s->planes * PN_AREA; }

/* ---- >>fields ----------------------------------------------------------------------------------------------- */

enum { MAX_SNAPSHOTS = 6, PICKS = 64 };

typedef struct snapshot {
    gph_field *frozen;
    gph_view view;
    uint32_t *slots; /* [voxels]: which of the room's examples, or GPH_NONE */
} snapshot;

typedef struct room {
    tr_scene *scene;
    tr_rng rng;
    bool nee;
    vec3 size; /* 0 = not known: a scene from a file */
    int turn;  /* which axis of the world is the histograms' z */
    gph_field *fields[FIELDS];
    gph_stream *stream;
    double flux;
    int field_count, snapshot_count;
    snapshot snapshots[MAX_SNAPSHOTS];
    set *set;
    uint32_t first; /* of the room's examples in the set */
    int half;
} room;

/* Where camera paths of the room come. */
static bool within_room(const room *m, vec3 p)
{
    const float e = 0.02f;
    if (m->size.x == 0)
        return true;
    return p.x > -e && p.y > -e && p.z > -e && p.x < m->size.x + e && p.y < m->size.y + e && p.z < m->size.z + e;
}

static vec3 turned(const room *m, vec3 d)
{
    return m->turn == 0 ? d : m->turn == 1 ? v3(d.z, d.x, d.y) : v3(d.y, d.z, d.x);
}

static void make_fields(room *m)
{
    static const gph_repair repairs[] = {GPH_REPAIR_GAUSSIAN, GPH_REPAIR_GAUSSIAN, GPH_REPAIR_GAUSSIAN,
                                         GPH_REPAIR_GAUSSIAN, GPH_REPAIR_PYRAMID,  GPH_REPAIR_PULL_PUSH};
    static const float sigmas[] = {0, 0.7f, 1.4f, 2.8f, 0, 0};
    gph_desc d;
    memset(&d, 0, sizeof d);
    const vec3 low = turned(m, m->scene->bounds_min), high = turned(m, m->scene->bounds_max);
    memcpy(d.bounds_min, &low, sizeof d.bounds_min);
    memcpy(d.bounds_max, &high, sizeof d.bounds_max);
    d.grid_cells = m->size.x > 0 ? 5 + (uint32_t)(rng_float(&m->rng) * 8) : 0; /* the default */
    m->field_count = m->set->planes == HELD_PLANES ? FIELDS : 1;
    for (int k = 0; k < m->field_count; ++k) {
        d.repair = repairs[k];
        d.sigma = sigmas[k];
        gph_result result = gph_create(&d, &m->fields[k]);
        if (result)
            die("field", gph_result_string(result));
    }
    need(gph_stream_create(m->fields[0], &m->stream) ? NULL : m);
}

/* What the renderer records: positions of camera paths make voxels valid; here photons stand for them. */
static bool record(void *user, int tile, const tr_photon *photons, int n)
{
    room *m = user;
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_photon *p = &photons[i];
        vec3 place = turned(m, p->p), d = turned(m, p->wi);
        float at[3], from[3];
        if (!within_room(m, p->p))
            continue;
        memcpy(at, &place, sizeof at);
        memcpy(from, &d, sizeof from);
        gph_vertex v = gph_make_vertex(at, 0, 1, 1, 0, GPH_TOUCH_ONLY);
        gph_photon photon = gph_make_photon(at, from, p->distance, (float)((double)mean3(p->flux) * m->flux));
        if (gph_record_vertices(m->stream, &v, 1) || (!p->flags && gph_record_photons(m->stream, &photon, 1)))
            return false;
    }
    return true;
}

static uint64_t shoot(room *m, uint64_t seed, int index, uint32_t paths, tr_photon_fn take)
{
    tr_photon_pass pass = {
        .scene = m->scene, .seed = seed, .index = index, .total = paths, .count = paths, .nee = m->nee};
    tr_photon_stats stats = {0};
    pass.max_depth = 24;
    m->flux = paths;
    need(tr_trace_photons(&pass, take, m, &stats) ? m : NULL);
    return stats.photons;
}

static void learn(room *m)
{
    for (int k = 0; k < m->field_count; ++k) {
        gph_result result = gph_accumulate(m->fields[k], &m->stream, 1, NULL, NULL);
        result = result ? result : gph_refine(m->fields[k], NULL, NULL);
        if (result)
            die("field", gph_result_string(result));
    }
    gph_stream_clear(m->stream);
}

static void take_maps(room *m, uint32_t voxel, float *maps, float *photons)
{
    static float features[GPH_FEATURES * PN_AREA];
    for (int k = 0; k < m->field_count; ++k) {
        gph_view view = gph_get_view(m->fields[k]);
        gph_handle handle;
        gph_set_voxel(&view, voxel, &handle);
        pn_repaired(&handle, maps + (size_t)(k == 0 ? REPAIRED : TRAIN_PLANES + k - 1) * PN_AREA);
    }
    gph_export_maps(m->fields[0], &voxel, 1, features, photons);
    memcpy(maps + FEATURES * PN_AREA, features, 4 * PN_AREA * sizeof(float));
    memset(maps + TRUTH_A * PN_AREA, 0, 2 * PN_AREA * sizeof(float));
}

/* Some of the voxels that changed, and a copy of the field that knows where they are. */
static void take_snapshot(room *m)
{
    snapshot *s = &m->snapshots[m->snapshot_count++];
    size_t size = gph_save_bound(m->fields[0]);
    void *data = need(malloc(size));
    uint32_t voxels = gph_voxel_count(m->fields[0]), *list = need(malloc((voxels + 1) * sizeof *list));
    uint32_t changed = gph_changed_voxels(m->fields[0], list, voxels);
    need(gph_save(m->fields[0], data, size, &size) || gph_load(NULL, data, size, &s->frozen) ? NULL : m);
    free(data);
    s->view = gph_get_view(s->frozen);
    s->slots = need(malloc((voxels + 1) * sizeof *s->slots));
    memset(s->slots, 0xff, (voxels + 1) * sizeof *s->slots);
    for (uint32_t k = 0; k < PICKS && k < changed; ++k) {
        uint32_t other = k + (uint32_t)(rng_float(&m->rng) * (float)(changed - k)), voxel = list[other];
        list[other] = list[k];
        uint32_t slot = m->set->count;
        float *maps = set_push(m->set), *photons = m->set->photons + 2 * (size_t)slot;
        take_maps(m, voxel, maps, photons);
        photons[1] = 0;
        s->slots[voxel] = slot;
    }
    free(list);
}

/* ---- >>dense ------------------------------------------------------------------------------------------------ */

/* The truth: photons of other seeds, counted in the voxels as they were when the examples were taken. */
static bool count_dense(void *user, int tile, const tr_photon *photons, int n)
{
    room *m = user;
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_photon *p = &photons[i];
        float at[3], from[3], seen[3];
        vec3 place = turned(m, p->p), d = turned(m, p->wi);
        if (p->flags || !(p->distance > 0) || !within_room(m, p->p))
            continue;
        memcpy(at, &place, sizeof at);
        memcpy(from, &d, sizeof from);
        for (int k = 0; k < m->snapshot_count; ++k) {
            const snapshot *s = &m->snapshots[k];
            gph_handle handle;
            gph_find(&s->view, at, NULL, NULL, &handle);
            uint32_t slot = handle.voxel == GPH_NONE ? GPH_NONE : s->slots[handle.voxel];
            if (slot == GPH_NONE)
                continue;
            gph_to_pivot(handle.offset, from, seen);
            uint32_t bin = gph_bin(PN_ROWS, PN_COLUMNS, seen);
            set_map(m->set, slot)[(size_t)(TRUTH_A + m->half) * PN_AREA + bin] += mean3(p->flux) * (float)m->flux;
            m->set->photons[2 * (size_t)slot + 1] += 1;
        }
    }
    return true;
}

/* Keep examples whose truth is far better known than they are. */
static uint32_t keep_good(room *m)
{
    uint32_t to = m->first;
    for (uint32_t i = m->first; i < m->set->count; ++i) {
        const float *photons = m->set->photons + 2 * (size_t)i;
        double sums[2] = {0, 0};
        for (int k = 0; k < 2 * PN_AREA; ++k)
            sums[k / PN_AREA] += (double)set_map(m->set, i)[TRUTH_A * PN_AREA + k];
        if (!(photons[0] >= 4 && photons[1] >= 4096 && photons[1] >= 8 * photons[0] && sums[0] > 0 && sums[1] > 0))
            continue;
        if (to != i) {
            memcpy(set_map(m->set, to), set_map(m->set, i), (size_t)m->set->planes * PN_AREA * sizeof(float));
            memcpy(m->set->photons + 2 * (size_t)to, photons, 2 * sizeof(float));
        }
        ++to;
    }
    m->set->count = to;
    return to - m->first;
}

/* Each half with mean 1, so that half-floats hold them and both count alike. */
static void scale_truths(room *m)
{
    for (uint32_t i = m->first; i < m->set->count; ++i) {
        float *truth = set_map(m->set, i) + TRUTH_A * PN_AREA;
        for (int h = 0; h < 2; ++h, truth += PN_AREA) {
            double sum = 0;
            for (int k = 0; k < PN_AREA; ++k)
                sum += (double)truth[k];
            for (int k = 0; k < PN_AREA; ++k)
                truth[k] = (float)((double)truth[k] * PN_AREA / sum);
        }
    }
}

/* Whether enough light of this room comes to voxels: elsewhere photons would be spent for few examples. */
static bool worthwhile(const room *m, double begun, double seconds)
{
    double per_example, sum = 0, used = tr_cpu_seconds() - begun;
    for (uint32_t i = m->first; i < m->set->count; ++i)
        sum += (double)m->set->photons[2 * (size_t)i + 1];
    per_example = sum / (m->set->count - m->first + 1);
    return m->set->count > m->first + 40 && (used < 0.1 * seconds || per_example * seconds > 8192 * used);
}

static void free_room(room *m)
{
    for (int k = 0; k < m->snapshot_count; ++k) {
        gph_destroy(m->snapshots[k].frozen);
        free(m->snapshots[k].slots);
    }
    gph_stream_destroy(m->stream);
    for (int k = 0; k < m->field_count; ++k)
        gph_destroy(m->fields[k]);
    tr_scene_free(m->scene);
    free(m);
}

/* A random room, or with `path` a scene from a file, as the renderer would treat it. */
static void open_scene(room *m, const char *path)
{
    tr_log log = {.out = stderr};
    m->nee = path || !chance(&m->rng, 0.25f);
    m->turn = path ? 0 : (int)(rng_float(&m->rng) * 3);
    m->scene = path ? tr_scene_load(path, NULL, 0, 1, &log) : make_room(&m->rng, &m->size);
    if (!m->scene)
        die(path, "cannot be loaded");
}

/* Passes as the renderer makes them, each a quarter of all before or as many as all before, or all alike. */
static void run_room(const options *o, int number, set *to)
{
    static const float growths[] = {0.25f, 1, 0};
    room *m = need(calloc(1, sizeof *m));
    uint64_t hits = 0, dense = 0, seed = (uint64_t)o->seed * 1000003 + (uint64_t)number, all = 0;
    double start = tr_cpu_seconds();
    m->rng = rng_seed(seed, 0);
    m->set = to;
    m->first = to->count;
    open_scene(m, o->scene);
    make_fields(m);
    uint32_t first = (uint32_t)log_within(&m->rng, 1500, 30000), paths = first;
    float growth = growths[(int)(rng_float(&m->rng) * 3)];
    int passes = 1 + (int)(rng_float(&m->rng) * 12), stride = passes > MAX_SNAPSHOTS || o->scene ? 2 : 1;
    if (o->scene) {
        first = paths = 14400; /* a path a pixel */
        growth = 0.25f;
        passes = 12;
    }
    for (int t = 0; t < passes && all < 400000; ++t) {
        hits += shoot(m, seed * 2 + 1, t, paths, record);
        learn(m);
        all += paths;
        paths = growth > 0 && (double)growth * (double)all > first ? (uint32_t)((double)growth * (double)all) : first;
        if ((t % stride == 0 || t + 1 == passes) && m->snapshot_count < MAX_SNAPSHOTS)
            take_snapshot(m);
    }
    double begun = tr_cpu_seconds();
    for (int k = 0; k == 0 || (worthwhile(m, begun, o->room_seconds) && tr_cpu_seconds() - start < o->room_seconds);
         ++k) {
        m->half = k & 1;
        dense += shoot(m, seed * 2, k, 50000, count_dense);
    }
    uint32_t taken = to->count - m->first, kept = keep_good(m);
    scale_truths(m);
    fprintf(stderr,
            "room %d: %d lights, %s, grid %u, %d passes, %u voxels, photons %.2g, dense %.3g, %u of %u kept, %.1f s\n",
            number, m->scene->light_count, m->nee ? "nee" : "no nee", gph_get_desc(m->fields[0])->grid_cells, passes,
            gph_voxel_count(m->fields[0]), (double)hits, (double)dense, kept, taken, tr_cpu_seconds() - start);
    free_room(m);
}

/* ---- >>files ------------------------------------------------------------------------------------------------ */

/* NULL = there is none. One that is there and cannot be read is not for this program to write over. */
static void *read_file(const char *path, size_t *size)
{
    void *data = tr_file_read(path, size, NULL, 0);
    if (!data && errno != ENOENT)
        die(path, strerror(errno));
    return data;
}

enum { MOST_PATH = 1024 };

static void suffixed(char name[MOST_PATH], const char *path, const char *suffix)
{
    if (snprintf(name, MOST_PATH, "%s%s", path, suffix) >= MOST_PATH)
        die(path, "the name is too long");
}

/* Beside it first, then in its place: an interrupted write leaves the old file. */
static void write_file(const char *path, const void *data, size_t size)
{
    char beside[MOST_PATH];
    suffixed(beside, path, ".new");
    FILE *f = fopen(beside, "wb");
    bool ok = f && fwrite(data, 1, size, f) == size;
    ok = f && !fclose(f) && ok;
    if (!ok || rename(beside, path))
        die(path, strerror(errno));
}

/* What tells one run of making data from another. */
static void describe_run(const options *o, char text[64])
{
    snprintf(text, 64, "seed %.0f, %g CPU seconds a room", o->seed, o->room_seconds);
}

static void save_data(const options *o, const char *path, int rooms, const set sets[2])
{
    char made[16], run[64];
    const char *metadata[] = {"rooms", made, "run", run, NULL};
    static const char *const names[2][2] = {{"train.maps", "train.photons"}, {"held.maps", "held.photons"}};
    gnn_weight w[4];
    memset(w, 0, sizeof w);
    for (int k = 0; k < 2; ++k) {
        gnn_weight *a = &w[2 * k], *b = a + 1;
        a->name = names[k][0], b->name = names[k][1];
        a->rank = 4, b->rank = 2;
        a->shape[0] = b->shape[0] = sets[k].count;
        a->shape[1] = sets[k].planes, a->shape[2] = PN_ROWS, a->shape[3] = PN_COLUMNS, b->shape[1] = 2;
        a->values = sets[k].maps, b->values = sets[k].photons;
        a->type = GNN_TYPE_F16, b->type = GNN_TYPE_F32;
    }
    snprintf(made, sizeof made, "%d", rooms);
    describe_run(o, run);
    size_t size = gnn_tensors_bound(w, 4, metadata);
    void *data = need(malloc(size ? size : 1));
    gnn_result result = gnn_tensors_write(w, 4, metadata, data, size, &size);
    if (result)
        die(path, gnn_result_string(result));
    write_file(path, data, size);
    free(data);
}

/* rooms: NULL, or how many the file has of this very run, which is to be gone on with. False = no such file. */
static bool load_data(const options *o, const char *path, int *rooms, set sets[2])
{
    size_t size;
    void *data = read_file(path, &size);
    char text[64] = "", run[64];
    gnn_tensor tensors[8];
    uint32_t count;
    gnn_message message;
    if (!data)
        return false;
    if (gnn_tensors_read(data, size, tensors, 8, &count, &message))
        die(path, message.text);
    describe_run(o, run);
    if (rooms && (!gnn_tensors_metadata(data, size, "run", text, sizeof text) || strcmp(text, run)))
        die(path, "was begun with another --seed or --room-seconds: give them again, or remove it");
    if (rooms && gnn_tensors_metadata(data, size, "rooms", text, sizeof text))
        *rooms = atoi(text);
    for (int k = 0; k < 2; ++k) {
        const gnn_tensor *a = gnn_tensors_find(tensors, count, k ? "held.maps" : "train.maps");
        const gnn_tensor *b = gnn_tensors_find(tensors, count, k ? "held.photons" : "train.photons");
        if (!a || !b || a->rank != 4 || a->shape[1] != sets[k].planes || a->shape[2] != PN_ROWS ||
            a->shape[3] != PN_COLUMNS || b->rank != 2 || b->shape[0] != a->shape[0] || b->shape[1] != 2)
            die(path, "not a data set of this program: remove it, or name another one by --data");
        size_t n = (size_t)a->shape[0];
        set *s = &sets[k];
        set_reserve(s, s->count + (uint32_t)n);
        if (!gnn_tensor_floats(a, 0, n * s->planes * PN_AREA, set_map(s, s->count)) ||
            !gnn_tensor_floats(b, 0, n * 2, s->photons + 2 * (size_t)s->count))
            die(path, "not of numbers that this program reads");
        s->count = s->capacity;
    }
    free(data);
    return true;
}

/* What an interrupted run has made lies in FILE.part; only all of it becomes FILE. */
static void make_rooms(const options *o, set sets[2])
{
    const char *path = o->data_count ? o->data[0] : NULL;
    char part[MOST_PATH] = "";
    int done = 0, rooms = (int)o->rooms;
    if (path) {
        suffixed(part, path, ".part");
        if (load_data(o, part, &done, sets))
            printf("%s: going on after %d rooms\n", part, done);
    }
    for (int k = done; k < rooms; ++k) {
        run_room(o, k, &sets[k % HELD_EVERY == HELD_EVERY - 1]);
        if (path && (k % 10 == 9 || k + 1 == rooms))
            save_data(o, part, k + 1, sets);
    }
    if (path && rename(part, path))
        die(path, strerror(errno));
}

static void get_data(const options *o, set sets[2])
{
    int there = 0;
    if (o->scene) {
        run_room(o, 0, &sets[1]);
        return;
    }
    for (int k = 0; k < o->data_count; ++k)
        there += load_data(o, o->data[k], NULL, sets);
    if (there < o->data_count && o->data_count > 1)
        die("--data", "not all files are there: only a single one is made");
    if (!there)
        make_rooms(o, sets);
}

/* ---- >>judge ------------------------------------------------------------------------------------------------ */

/* Room for one example as the network sees it. */
typedef struct example {
    float features[GPH_FEATURES * PN_AREA], repaired[PN_AREA], truth[PN_AREA];
} example;

/* A plane turned by `turn` columns, mirrored in phi or z: what a room turned or mirrored would give. */
static void transform(const float *from, uint32_t change, float *to)
{
    uint32_t turn = change % PN_COLUMNS, mirror = change / PN_COLUMNS & 1, flip = change / PN_COLUMNS / 2 & 1;
    for (uint32_t y = 0; y < PN_ROWS; ++y)
        for (uint32_t x = 0; x < PN_COLUMNS; ++x) {
            uint32_t column = ((mirror ? PN_COLUMNS - 1 - x : x) + turn) % PN_COLUMNS;
            to[y * PN_COLUMNS + x] = from[(flip ? PN_ROWS - 1 - y : y) * PN_COLUMNS + column];
        }
}

static void load_example(const set *s, uint32_t i, uint32_t change, float *inputs, float *target)
{
    static example e;
    const float *maps = set_map(s, i);
    transform(maps + REPAIRED * PN_AREA, change, e.repaired);
    for (int k = 0; k < 4; ++k)
        transform(maps + (size_t)(FEATURES + k) * PN_AREA, change, e.features + k * PN_AREA);
    for (int k = 0; k < PN_AREA; ++k)
        e.features[4 * PN_AREA + k] = e.features[2 * PN_AREA + k] > 0 ? 1.0f : 0.0f;
    pn_inputs(e.repaired, e.features, s->photons[2 * (size_t)i], inputs);
    if (s->histogram_only) /* S_t and its blur are left */
        memset(inputs + 2 * PN_AREA, 0, 4 * PN_AREA * sizeof *inputs);
    if (!target)
        return;
    transform(maps + TRUTH_A * PN_AREA, change, e.truth);
    transform(maps + TRUTH_B * PN_AREA, change, e.features);
    for (int k = 0; k < PN_AREA; ++k)
        e.truth[k] += e.features[k];
    pn_truth(e.truth, target);
}

enum { SHARES = 3 };
static const double uniform_shares[SHARES] = {0.01, 0.1, 0.5};

/* How good a map is to sample: second moment over squared mean of the estimator of the truth's integral by it, mixed
   with uniform directions; 1 = perfect. The truth's halves are independent, so that noise of their bins does not raise
   its expectation. And L1, which has that noise. */
typedef struct score {
    double v[SHARES], l1;
} score;

static score judge(const float *maps, const float *map)
{
    const float *a = maps + TRUTH_A * PN_AREA, *b = maps + TRUTH_B * PN_AREA;
    score s = {{0}, 0};
    double sum = 0, scale;
    for (int i = 0; i < PN_AREA; ++i)
        sum += (double)map[i];
    scale = sum > 0 ? PN_AREA / sum : 0;
    for (int k = 0; k < SHARES; ++k) {
        double e = scale > 0 ? uniform_shares[k] : 1;
        for (int i = 0; i < PN_AREA; ++i)
            s.v[k] += (double)a[i] * (double)b[i] / ((1 - e) * scale * (double)map[i] + e) / PN_AREA;
    }
    for (int i = 0; i < PN_AREA; ++i)
        s.l1 += fabs(scale * (double)map[i] - 0.5 * ((double)a[i] + (double)b[i])) / PN_AREA;
    return s;
}

typedef struct tally {
    double v[SHARES], log_v[SHARES], l1;
    uint32_t n;
} tally;

static void add_score(tally *t, score s)
{
    for (int k = 0; k < SHARES; ++k) {
        t->v[k] += s.v[k];
        t->log_v[k] += log(fmax(s.v[k], 1e-3));
    }
    t->l1 += s.l1;
    t->n++;
}

static void print_tally(const char *name, const tally *t)
{
    double n = t->n ? t->n : 1;
    printf("  %-12s", name);
    for (int k = 0; k < SHARES; ++k)
        printf("  %7.3f %7.3f", t->v[k] / n, exp(t->log_v[k] / n));
    printf("  %7.4f\n", t->l1 / n);
}

/* The network over a set: with its maps, a workspace of one map. */
typedef struct runner {
    gnn_unet *net;
    void *workspace;
    size_t size;
    float *inputs, *outputs, *targets;
    uint32_t batch;
    tr_pool *pool;
} runner;

static void start_runner(runner *r, gnn_unet *net, uint32_t batch, int threads)
{
    r->net = net;
    r->batch = batch;
    r->size = gnn_unet_workspace(net, batch, true);
    r->workspace = need(malloc(r->size));
    r->inputs = need(malloc((size_t)batch * PN_INPUTS * PN_AREA * sizeof(float)));
    r->outputs = need(malloc((size_t)batch * PN_AREA * sizeof(float)));
    r->targets = need(malloc((size_t)batch * PN_AREA * sizeof(float)));
    r->pool = threads > 1 ? need(tr_pool_create(threads)) : NULL;
}

static void end_runner(runner *r)
{
    gnn_unet_destroy(r->net);
    free(r->workspace);
    free(r->inputs);
    free(r->outputs);
    free(r->targets);
    tr_pool_destroy(r->pool);
}

/* Maps of low .. high photons, every stride-th. */
static void judge_net(runner *r, const set *s, float low, float high, uint32_t stride, tally *t, double *loss)
{
    gnn_unet_desc d = gnn_unet_get_desc(r->net);
    float map[PN_AREA];
    memset(t, 0, sizeof *t);
    *loss = 0;
    for (uint32_t i = 0; i < s->count; i += stride) {
        if (!(s->photons[2 * (size_t)i] >= low && s->photons[2 * (size_t)i] < high))
            continue;
        load_example(s, i, 0, r->inputs, r->targets);
        gnn_unet_forward(r->net, r->inputs, 1, r->outputs, r->workspace, r->size, NULL, NULL);
        *loss += gnn_loss(r->outputs, r->inputs, r->targets, PN_AREA, d.lambda, 1, NULL);
        pn_map(set_map(s, i) + REPAIRED * PN_AREA, r->outputs, map);
        add_score(t, judge(set_map(s, i), map));
    }
    *loss /= t->n ? t->n : 1;
}

static void judge_plane(const set *s, int plane, float low, float high, tally *t)
{
    memset(t, 0, sizeof *t);
    for (uint32_t i = 0; i < s->count; ++i)
        if (s->photons[2 * (size_t)i] >= low && s->photons[2 * (size_t)i] < high)
            add_score(t, judge(set_map(s, i), set_map(s, i) + (size_t)plane * PN_AREA));
}

/* Bins around in reach, with less weight the further they are and the more their square roots differ: by twice what
   chance makes of them, where photons are of one weight (Anscombe 1948). */
static void bilateral(const float *map, double photons, float *out)
{
    enum { REACH = 4 };
    const double across = 1.4, apart = 2 * 0.5 * sqrt(PN_AREA / fmax(photons, 1));
    for (int y = 0; y < PN_ROWS; ++y)
        for (int x = 0; x < PN_COLUMNS; ++x) {
            double sum = 0, all = 0, here = sqrt((double)map[y * PN_COLUMNS + x]);
            for (int j = -REACH; j <= REACH; ++j)
                for (int i = -REACH; i <= REACH && y + j >= 0 && y + j < PN_ROWS; ++i) {
                    double there = (double)map[(y + j) * PN_COLUMNS + (x + i + PN_COLUMNS) % PN_COLUMNS];
                    double d = (sqrt(there) - here) / apart,
                           w = exp(-0.5 * (d * d + (i * i + j * j) / (across * across)));
                    sum += w * there;
                    all += w;
                }
            out[y * PN_COLUMNS + x] = (float)(sum / all);
        }
}

static void judge_bilateral(const set *s, tally *t)
{
    float map[PN_AREA];
    memset(t, 0, sizeof *t);
    for (uint32_t i = 0; i < s->count; ++i) {
        bilateral(set_map(s, i) + FEATURES * PN_AREA, (double)s->photons[2 * (size_t)i], map);
        add_score(t, judge(set_map(s, i), map));
    }
}

/* ---- >>train ------------------------------------------------------------------------------------------------ */

/* Where a training stands; kept in the checkpoint's metadata. */
typedef struct state {
    uint64_t step;
    double seconds, loss; /* CPU seconds spent; the last steps' mean loss, 0 = not known */
    uint64_t refused;     /* maps that gnn_unet_train refused, since this program began; best 0 */
} state;

static void save_net(const gnn_unet *net, gnn_type type, const char *path, const state *s)
{
    char step[32], seconds[32], loss[32];
    const char *metadata[] = {"step", step, "cpu_seconds", seconds, "loss", loss, NULL};
    snprintf(step, sizeof step, "%llu", (unsigned long long)s->step);
    snprintf(seconds, sizeof seconds, "%.1f", s->seconds);
    snprintf(loss, sizeof loss, "%.6f", s->loss);
    size_t size = gnn_unet_bound(net, type, metadata);
    void *data = need(malloc(size ? size : 1));
    gnn_result result = gnn_unet_save(net, type, metadata, data, size, &size);
    if (result)
        die(path, gnn_result_string(result));
    write_file(path, data, size);
    free(data);
}

/* A number of the metadata, 0 where it is not there. */
static double number_of(const char *path, const void *data, size_t size, const char *key)
{
    char text[32], *end;
    if (!gnn_tensors_metadata(data, size, key, text, sizeof text))
        return 0;
    double value = strtod(text, &end);
    if (end == text || *end || !(value >= 0 && value < 1e15)) {
        fprintf(stderr, "train_histogram: %s: %s of its metadata is %s\n", path, key, text);
        exit(1);
    }
    return value;
}

/* False = there is no checkpoint yet. */
static bool load_net(gnn_unet *net, const char *path, state *s)
{
    size_t size;
    void *data = read_file(path, &size);
    gnn_message message = {""};
    if (!data)
        return false;
    gnn_result result = gnn_unet_load(net, data, size, &message);
    if (result)
        die(path, message.text[0] ? message.text : gnn_result_string(result));
    s->step = (uint64_t)number_of(path, data, size, "step");
    s->seconds = number_of(path, data, size, "cpu_seconds");
    s->loss = number_of(path, data, size, "loss");
    free(data);
    return true;
}

/* The validation's points so far, one a line, beside the checkpoint: step, seconds, loss of training, loss and mean V
   of held-out maps. */
static void draw_curve(const options *o, const char *points)
{
    enum { MOST = 4096 };
    static double seconds[MOST], train[MOST], held[MOST], v[MOST], step;
    int n = 0;
    FILE *f = fopen(points, "r");
    while (f && n < MOST && fscanf(f, "%lf %lf %lf %lf %lf", &step, &seconds[n], &train[n], &held[n], &v[n]) == 5)
        ++n;
    if (f)
        fclose(f);
    plot_series s[2] = {{"training, all levels", seconds, train, n, true},
                        {"held-out rooms, top level", seconds, held, n, false}};
    if (!plot_write(o->curve, "Loss of the network for histograms", "CPU seconds", "loss", s, 2, false, false))
        die(o->curve, "cannot be written");
}

static void validate(const options *o, runner *r, const set *held, const state *s, double done)
{
    char points[MOST_PATH];
    tally t;
    double loss, spent = done > 0 ? s->seconds / done : 0;
    judge_net(r, held, 0, 1e9f, 4, &t, &loss);
    printf("step %llu, %.0f CPU s, %.0f to go: loss %.4f, held out %.4f, V %.3f\n", (unsigned long long)s->step,
           s->seconds, spent - s->seconds, s->loss, loss, t.v[1] / (t.n ? t.n : 1));
    if (s->refused)
        printf("%llu maps refused: not finite, or far too large\n", (unsigned long long)s->refused);
    fflush(stdout);
    save_net(r->net, GNN_TYPE_F32, o->checkpoint, s);
    suffixed(points, o->checkpoint, ".curve");
    FILE *f = fopen(points, "a");
    if (!f || fprintf(f, "%llu %.1f %.6f %.6f %.6f\n", (unsigned long long)s->step, s->seconds, s->loss, loss,
                      t.v[1] / (t.n ? t.n : 1)) < 0)
        die(points, "cannot be written");
    fclose(f);
    if (o->curve)
        draw_curve(o, points);
}

/* One step, whose examples depend on its number alone, so that a training goes on as if it had not been stopped. */
static void train_step(const options *o, runner *r, const set *s, state *at, double done)
{
    gnn_step seen;
    float warm = (float)fmin(1, (double)(at->step + 1) / 200), cosine = 0.5f + 0.5f * cosf(TR_PI * (float)done);
    gnn_unet_set_rate(r->net, (float)o->rate * warm * cosine + 1e-7f);
    for (uint32_t k = 0; k < r->batch; ++k) {
        uint64_t h = tr_hash64((uint64_t)o->seed * 1000003 + at->step * r->batch + k + 1);
        load_example(s, (uint32_t)((h >> 32) % s->count), (uint32_t)h & 255,
                     r->inputs + (size_t)k * PN_INPUTS * PN_AREA, r->targets + (size_t)k * PN_AREA);
    }
    gnn_result result = gnn_unet_train(r->net, r->inputs, r->targets, r->batch, &seen, r->workspace, r->size,
                                       r->pool ? tr_pool_run : NULL, r->pool);
    if (result)
        die("training", gnn_result_string(result));
    at->refused += seen.refused;
    at->loss += (seen.loss - at->loss) * (at->loss > 0 ? fmax(0.01, 1.0 / (double)(at->step + 1)) : 1);
    at->step++;
}

static double share_done(const options *o, const state *s)
{
    return o->steps ? (double)s->step / (double)o->steps : o->seconds > 0 ? s->seconds / o->seconds : 1;
}

/* Writes a checkpoint only where it has made a step. */
static void train(const options *o, runner *r, const set sets[2], state *s)
{
    uint64_t begun = s->step;
    double before = s->seconds, start = tr_cpu_seconds(), shown = before;
    while (share_done(o, s) < 1) {
        train_step(o, r, &sets[0], s, share_done(o, s));
        s->seconds = before + tr_cpu_seconds() - start;
        if (s->seconds - shown > 30) {
            validate(o, r, &sets[1], s, share_done(o, s));
            shown = s->seconds;
        }
    }
    if (s->step > begun)
        validate(o, r, &sets[1], s, 1);
}

static double net_milliseconds(runner *r)
{
    double cpu = tr_cpu_seconds();
    for (int k = 0; k < 500; ++k)
        gnn_unet_forward(r->net, r->inputs, 1, r->outputs, r->workspace, r->size, NULL, NULL);
    return 2 * (tr_cpu_seconds() - cpu);
}

/* The filters and the network on rooms that it has not seen, and on their maps by the number of photons. */
static void report(runner *r, const set *held, bool trained)
{
    static const float limits[] = {0, 32, 128, 512, 2048, 1e9f};
    char name[40];
    tally t;
    double loss;
    printf("held-out maps: V when 0.01, 0.1, 0.5 of the directions are uniform (mean, geometric mean); L1\n");
    judge_plane(held, FEATURES, 0, 1e9f, &t);
    print_tally("raw", &t);
    judge_plane(held, REPAIRED, 0, 1e9f, &t);
    print_tally("gaussian", &t);
    for (int k = TRAIN_PLANES; k < HELD_PLANES; ++k) {
        judge_plane(held, k, 0, 1e9f, &t);
        print_tally(filter_names[k - TRAIN_PLANES], &t);
    }
    judge_bilateral(held, &t);
    print_tally("bilateral", &t);
    if (!trained)
        return;
    judge_net(r, held, 0, 1e9f, 1, &t, &loss);
    print_tally("net", &t);
    for (int k = 0; k < 5; ++k) {
        judge_plane(held, REPAIRED, limits[k], limits[k + 1], &t);
        printf("%u maps of %g .. %g photons\n", t.n, (double)limits[k], (double)limits[k + 1]);
        print_tally("gaussian", &t);
        judge_net(r, held, limits[k], limits[k + 1], 1, &t, &loss);
        print_tally("net", &t);
    }
    snprintf(name, sizeof name, "%.1f MFLOP", gnn_unet_operations(r->net) * 1e-6);
    printf("%.3f ms a map, %s, %llu weights\n", net_milliseconds(r), name,
           (unsigned long long)gnn_unet_parameters(r->net));
}

/* ---- >>main ------------------------------------------------------------------------------------------------- */

static const char usage[] =
    "usage: train_histogram [options]\n"
    "  --data FILE          data set: read where the file is there, else made and written; repeatable to read several\n"
    "  --rooms N            rooms to make (60), every sixth held out   --room-seconds S  CPU seconds for each (5)\n"
    "  --scene FILE         no rooms and no training: judge on the maps of this scene\n"
    "  --seconds S          CPU seconds of training (0 = none), or     --steps N  as many steps\n"
    "  --checkpoint FILE    written while training; where it is there, training goes on from it "
    "(histogram.checkpoint)\n"
    "  --weights FILE       half-float weights, written at the end     --curve FILE.svg  losses over time\n"
    "  --seed N  --threads N  --batch N (16)  --rate R (0.002)  --lambda L  --deep W  --channels A,B,...\n"
    "  --features 0         what S_t-1, P_t, P_t-1 and B_t are worth: without them\n";

/* A,B,...: one to six whole numbers of 1 .. 512. */
static bool parse_channels(const char *text, uint32_t channels[GNN_MAX_LEVELS])
{
    memset(channels, 0, GNN_MAX_LEVELS * sizeof *channels);
    for (int l = 0; l < GNN_MAX_LEVELS; ++l) {
        char *end;
        unsigned long value = *text >= '0' && *text <= '9' ? strtoul(text, &end, 10) : 0;
        if (value < 1 || value > 512)
            return false;
        channels[l] = (uint32_t)value;
        if (!*end)
            return true;
        if (*end != ',')
            return false;
        text = end + 1;
    }
    return false;
}

static void refuse_number(const char *key, const char *value, double low, double high, bool whole)
{
    fprintf(stderr, "train_histogram: %s %s: %s of %g .. %g is needed\n", key, value,
            whole ? "a whole number" : "a number", low, high);
    exit(1);
}

static bool set_number(options *o, const char *key, const char *value)
{
    const struct {
        const char *key;
        double *to, low, high;
        bool whole;
    } numbers[] = {{"--rooms", &o->rooms, 1, 1e5, true},      {"--room-seconds", &o->room_seconds, 0, 1e6, false},
                   {"--seconds", &o->seconds, 0, 1e8, false}, {"--steps", &o->steps, 0, 1e9, true},
                   {"--seed", &o->seed, 0, 1e9, true},        {"--threads", &o->threads, 1, 256, true},
                   {"--batch", &o->batch, 1, 1024, true},     {"--rate", &o->rate, 0, 1, false},
                   {"--lambda", &o->lambda, 0, 1000, false},  {"--deep", &o->deep, 0, 1000, false},
                   {"--features", &o->features, 0, 1, true}};
    for (size_t k = 0; k < sizeof numbers / sizeof *numbers; ++k)
        if (!strcmp(key, numbers[k].key)) {
            char *end;
            double x = strtod(value, &end);
            if (end == value || *end || !(x >= numbers[k].low && x <= numbers[k].high) ||
                (numbers[k].whole && x != floor(x)))
                refuse_number(key, value, numbers[k].low, numbers[k].high, numbers[k].whole);
            *numbers[k].to = x;
            return true;
        }
    return false;
}

static bool set_option(options *o, const char *key, const char *value)
{
    if (set_number(o, key, value))
        return true;
    if (!strcmp(key, "--channels")) {
        if (!parse_channels(value, o->channels))
            die("--channels", "one to six whole numbers of 1 .. 512 are needed, with commas between them");
    } else if (!strcmp(key, "--data")) {
        if (o->data_count == MAX_DATA)
            die("--data", "so many files are not read");
        o->data[o->data_count++] = value;
    } else if (!strcmp(key, "--scene"))
        o->scene = value;
    else if (!strcmp(key, "--checkpoint"))
        o->checkpoint = value;
    else if (!strcmp(key, "--weights"))
        o->weights = value;
    else if (!strcmp(key, "--curve"))
        o->curve = value;
    else
        return false;
    return true;
}

static void parse_options(options *o, int argc, char **argv)
{
    for (int i = 1; i < argc; i += 2)
        if (i + 1 == argc || !set_option(o, argv[i], argv[i + 1]))
            die(argv[i], "unknown, or without its value; --help lists the options");
    if (o->scene && o->data_count)
        die("--scene", "is judged on maps of its own: leave out --data");
    if (o->weights && !strcmp(o->weights, o->checkpoint))
        die("--weights", "would be written over the checkpoint");
    if (o->weights && !o->features)
        die("--features 0", "makes no network to use: leave out --weights");
}

static gnn_unet *make_net(const options *o)
{
    gnn_unet_desc d = pn_desc();
    gnn_unet *net;
    for (int l = 0; l < GNN_MAX_LEVELS && o->channels[l]; ++l) {
        d.channels[l] = o->channels[l];
        d.levels = (uint32_t)l + 1;
    }
    d.training = true;
    d.lambda = (float)o->lambda;
    d.deep = (float)o->deep;
    gnn_result result = gnn_unet_create(&d, &net);
    if (result)
        die("network", gnn_result_string(result));
    return net;
}

int main(int argc, char **argv)
{
    options o = {.rooms = 60,
                 .room_seconds = 5,
                 .seed = 1,
                 .threads = 1,
                 .batch = 16,
                 .rate = 0.002,
                 .features = 1,
                 .checkpoint = "histogram.checkpoint"};
    set sets[2] = {{.planes = TRAIN_PLANES}, {.planes = HELD_PLANES}};
    state s = {0, 0, 0, 0};
    runner r;
    if (argc == 2 && !strcmp(argv[1], "--help")) {
        fputs(usage, stdout);
        return 0;
    }
    parse_options(&o, argc, argv);
    get_data(&o, sets);
    sets[0].histogram_only = sets[1].histogram_only = o.features == 0;
    printf("%u maps to train, %u held out\n", sets[0].count, sets[1].count);
    if ((!sets[0].count && !o.scene) || !sets[1].count)
        die("data", "too few rooms had enough light: make other data, with more --rooms or --room-seconds");
    start_runner(&r, make_net(&o), (uint32_t)o.batch, (int)o.threads);
    bool there = load_net(r.net, o.checkpoint, &s);
    if (there)
        printf("%s: step %llu, %.0f CPU s\n", o.checkpoint, (unsigned long long)s.step, s.seconds);
    else
        printf("%s is not there: %s\n", o.checkpoint, o.scene ? "no network is judged" : "begun anew");
    if (!o.scene)
        train(&o, &r, sets, &s);
    report(&r, &sets[1], there || s.step > 0);
    if (o.weights && (there || s.step > 0))
        save_net(r.net, GNN_TYPE_F16, o.weights, &s);
    end_runner(&r);
    for (int k = 0; k < 2; ++k) {
        free(sets[k].maps);
        free(sets[k].photons);
    }
    return 0;
}
