/* photon_net.c: see photon_net.h.

     >>maps     inputs and answers of one map
     >>weights  the file
     >>visits   which voxels camera paths meet
     >>refine   which maps, and how many */
#include "photon_net.h"
#include "scene_internal.h"

#include <errno.h>
#include <float.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define GNN_IMPLEMENTATION
#include "guide_nn.h"

#define WEIGHTS "examples/weights/histogram.safetensors"

/* ---- >>maps ------------------------------------------------------------------------------------------------- */

gnn_unet_desc pn_desc(void)
{
    gnn_unet_desc d;
    memset(&d, 0, sizeof d);
    d.width = PN_COLUMNS;
    d.height = PN_ROWS;
    d.inputs = PN_INPUTS;
    d.no_mask = true; /* where no photon fell is known by the repaired map */
    d.levels = 4;
    d.channels[0] = d.channels[1] = 8;
    d.channels[2] = 16;
    d.channels[3] = 32;
    return d;
}

/* The network sees and answers square roots: what photons of one weight leave of noise is alike in all bins then
   (Anscombe 1948), and a few bright ones do not outweigh the rest of a map. */
static float bend(float x) { return x > 0 ? sqrtf(x) : 0; }

/* Divided by its mean; all 1 where that is nothing, infinite or so small that its values are no longer whole floats. */
static void normalise(float *map)
{
    double sum = 0;
    for (int i = 0; i < PN_AREA; ++i)
        sum += (double)map[i];
    double scale = sum >= (double)PN_AREA * (double)FLT_MIN && sum < INFINITY ? PN_AREA / sum : 0;
    for (int i = 0; i < PN_AREA; ++i)
        map[i] = scale > 0 ? (float)((double)map[i] * scale) : 1;
}

void pn_inputs(const float *repaired, const float *features, float photons, float *inputs)
{
    float noise = 0.125f * log2f(1 + photons);
    for (int i = 0; i < PN_AREA; ++i)
        inputs[i] = bend(repaired[i]);
    for (int i = 0; i < 4 * PN_AREA; ++i)
        inputs[PN_AREA + i] = bend(features[i]);
    for (int i = 0; i < PN_AREA; ++i) {
        inputs[5 * PN_AREA + i] = features[4 * PN_AREA + i];
        inputs[6 * PN_AREA + i] = noise;
    }
}

void pn_truth(const float *truth, float *target)
{
    memcpy(target, truth, PN_AREA * sizeof *target);
    normalise(target);
    for (int i = 0; i < PN_AREA; ++i)
        target[i] = bend(target[i]);
}

void pn_map(const float *repaired, const float *output, float *map)
{
    const float keep = 0.1f;
    for (int i = 0; i < PN_AREA; ++i)
        map[i] = output[i] > 0 ? output[i] * output[i] : 0;
    normalise(map);
    for (int i = 0; i < PN_AREA; ++i)
        map[i] = (1 - keep) * map[i] + keep * repaired[i];
}

void pn_repaired(const gph_handle *handle, float *map)
{
    for (int i = 0; i < PN_AREA; ++i)
        map[i] = handle->weights ? gnn_float_of_half(handle->weights[i]) : 0;
    normalise(map);
}

/* ---- >>weights ---------------------------------------------------------------------------------------------- */

/* Maps that are worked on at once: so many at a time, each range of GRAIN with a workspace of its own. */
enum { BATCH = 128, GRAIN = 8 };

/* Every SEEN-th vertex of a tile's camera paths since the last refine. */
enum { SEEN = 32 };
typedef struct seen {
    float (*at)[3];
    uint32_t count, capacity, passed;
} seen;

struct photon_net {
    gnn_unet *unet;
    seen *tiles;
    int tile_count;
    double share;
    uint64_t changed, done, over_budget; /* maps that changed, those that the network made, that it did not */
    /* of the call */
    const gph_field *field;
    gph_view view;
    const uint32_t *voxels;
    size_t workspace_size;
    char *workspaces; /* [BATCH / GRAIN] */
    float *inputs, *outputs, *maps;
};

/* The weights beside the folder that the program runs from, whatever folder it is called from. */
static bool beside_program(char *path, size_t size)
{
    ssize_t n = readlink("/proc/self/exe", path, size);
    if (n <= 0 || (size_t)n >= size)
        return false;
    path[n] = 0;
    char *name = strrchr(path, '/');
    size_t room = name ? size - (size_t)(name - path) : 0;
    return name && snprintf(name, room, "/../" WEIGHTS) < (int)room;
}

static bool load_weights(photon_net *n, const char *path, char *err, size_t err_size)
{
    const char *remedy = "give others by --set net=FILE, restore the file, or train it with build/train_histogram";
    char beside[1024];
    bool looked = !path && beside_program(beside, sizeof beside);
    size_t size = 0;
    const char *named = path ? path : looked ? beside : WEIGHTS;
    void *data = tr_file_read(named, &size, NULL, 0);
    gnn_message message = {""};
    if (!data && looked && errno == ENOENT)
        data = tr_file_read(named = WEIGHTS, &size, NULL, 0);
    if (!data) {
        const char *why = strerror(errno);
        bool both = looked && named != beside;
        snprintf(err, err_size, "photon: cannot read the network's weights %s: %s%s%s: %s", named, why,
                 both ? "; nor is there " : "", both ? beside : "", remedy);
        return false;
    }
    gnn_result result = gnn_unet_load(n->unet, data, size, &message);
    free(data);
    if (result)
        snprintf(err, err_size, "photon: the network's weights %s: %s: %s", named,
                 message.text[0] ? message.text : gnn_result_string(result), remedy);
    return !result;
}

photon_net *photon_net_create(const char *path, double share, int tiles, char *err, size_t err_size)
{
    photon_net *n = calloc(1, sizeof *n);
    gnn_unet_desc desc = pn_desc();
    seen *all = calloc(tiles > 0 ? (size_t)tiles : 1, sizeof *all);
    if (!n || !all || gnn_unet_create(&desc, &n->unet)) {
        snprintf(err, err_size, "photon: out of memory for the network");
        free(all);
        free(n);
        return NULL;
    }
    n->tiles = all;
    n->tile_count = tiles;
    n->share = share;
    if (!load_weights(n, path, err, err_size)) {
        photon_net_destroy(n);
        return NULL;
    }
    return n;
}

void photon_net_destroy(photon_net *n)
{
    if (!n)
        return;
    gnn_unet_destroy(n->unet);
    for (int i = 0; i < n->tile_count; ++i)
        free(n->tiles[i].at);
    free(n->tiles);
    free(n->workspaces);
    free(n->inputs);
    free(n);
}

/* ---- >>visits ----------------------------------------------------------------------------------------------- */

void photon_net_see(photon_net *n, int tile, const tr_vertex *vertices, int count)
{
    seen *s = &n->tiles[tile];
    for (int i = 0; i < count; ++i) {
        if (s->passed++ % SEEN)
            continue;
        if (s->count == s->capacity) {
            uint32_t capacity = s->capacity ? 2 * s->capacity : 256;
            void *grown = realloc(s->at, capacity * sizeof *s->at);
            if (!grown)
                return; /* it is but a sample */
            s->at = grown;
            s->capacity = capacity;
        }
        memcpy(s->at[s->count++], &vertices[i].p, sizeof *s->at);
    }
}

typedef struct visited {
    uint32_t times, voxel;
} visited;

static int by_times(const void *a, const void *b)
{
    const visited *x = a, *y = b;
    if (x->times != y->times)
        return x->times > y->times ? -1 : 1;
    return x->voxel < y->voxel ? -1 : x->voxel > y->voxel;
}

/* False = out of memory. */
static bool most_visited_first(photon_net *n, uint32_t *voxels, uint32_t count)
{
    uint32_t *times = calloc((size_t)n->view.voxel_count + 1, sizeof *times);
    visited *list = malloc((count + 1) * sizeof *list);
    for (int t = 0; times && t < n->tile_count; ++t) {
        for (uint32_t i = 0; i < n->tiles[t].count; ++i) {
            uint32_t voxel = gph_find_voxel(&n->view, n->tiles[t].at[i]);
            times[voxel == GPH_NONE ? n->view.voxel_count : voxel]++;
        }
        n->tiles[t].count = 0;
    }
    bool ok = times && list;
    for (uint32_t i = 0; ok && i < count; ++i) {
        list[i].times = times[voxels[i]];
        list[i].voxel = voxels[i];
    }
    if (ok)
        qsort(list, count, sizeof *list, by_times);
    for (uint32_t i = 0; ok && i < count; ++i)
        voxels[i] = list[i].voxel;
    free(times);
    free(list);
    return ok;
}

/* ---- >>refine ----------------------------------------------------------------------------------------------- */

/* Work in microseconds of one core (AVX2, scenes spot and egg): of a recorded vertex all that a camera path spends on
   it, of a photon its path, of a map gph_refine's repair; of the network's map with its way in and out. */
static const double vertex_work = 0.7, photon_work = 0.4, map_work = 90, net_work = 230;

/* How many more maps the share pays for. */
static uint32_t maps_to_afford(const photon_net *n, const gph_field *field)
{
    gph_stats s;
    gph_get_stats(field, &s);
    double work =
        vertex_work * (double)s.vertices + photon_work * (double)(s.photons + s.unread) + map_work * (double)s.built;
    double maps = n->share * work / net_work - (double)n->done;
    return maps >= 4294967295.0 ? 0xffffffffu : maps > 0 ? (uint32_t)maps : 0;
}

static void refine_range(void *context, uint32_t begin, uint32_t end)
{
    const photon_net *n = context;
    char *workspace = n->workspaces + begin / GRAIN * n->workspace_size;
    float features[GPH_FEATURES * PN_AREA], repaired[PN_AREA], photons;
    for (uint32_t i = begin; i < end; ++i) {
        float *inputs = n->inputs + (size_t)(i / GRAIN) * PN_INPUTS * PN_AREA;
        float *output = n->outputs + (size_t)(i / GRAIN) * PN_AREA;
        gph_handle handle;
        gph_set_voxel(&n->view, n->voxels[i], &handle);
        pn_repaired(&handle, repaired);
        gph_export_maps(n->field, &n->voxels[i], 1, features, &photons);
        pn_inputs(repaired, features, photons, inputs);
        gnn_unet_forward(n->unet, inputs, 1, output, workspace, n->workspace_size, NULL, NULL); /* it has room */
        pn_map(repaired, output, n->maps + (size_t)i * PN_AREA);
    }
}

static bool need_memory(photon_net *n)
{
    enum { RANGES = BATCH / GRAIN };
    if (n->inputs)
        return true;
    n->workspace_size = (gnn_unet_workspace(n->unet, 1, false) + 63) & ~(size_t)63;
    n->workspaces = n->workspaces ? n->workspaces : malloc(RANGES * n->workspace_size);
    n->inputs = n->workspaces ? malloc((size_t)(RANGES * (PN_INPUTS + 1) + BATCH) * PN_AREA * sizeof(float)) : NULL;
    if (!n->inputs)
        return false;
    n->outputs = n->inputs + (size_t)RANGES * PN_INPUTS * PN_AREA;
    n->maps = n->outputs + (size_t)RANGES * PN_AREA;
    return true;
}

bool photon_net_refine(photon_net *n, gph_field *field, tr_parallel_fn parallel, void *parallel_user)
{
    uint32_t count = gph_changed_voxels(field, NULL, 0), afford = maps_to_afford(n, field);
    uint32_t *voxels = malloc((count + 1) * sizeof *voxels);
    n->field = field;
    n->view = gph_get_view(field);
    afford = afford < count ? afford : count;
    if (!voxels || !need_memory(n)) {
        free(voxels);
        return false;
    }
    gph_changed_voxels(field, voxels, count);
    bool ok = most_visited_first(n, voxels, count);
    n->changed += count;
    n->over_budget += count - afford;
    for (uint32_t begin = 0, k; ok && begin < afford; begin += k) {
        k = afford - begin < BATCH ? afford - begin : BATCH;
        n->voxels = voxels + begin;
        if (parallel)
            parallel(parallel_user, k, GRAIN, refine_range, n);
        else
            refine_range(n, 0, k);
        n->done += gph_import_maps(field, n->voxels, k, n->maps, parallel, parallel_user);
    }
    free(voxels);
    return ok;
}

void photon_net_stats(const photon_net *n, char *text, size_t size)
{
    snprintf(text, size, ", \"net_changed\": %llu, \"net_maps\": %llu, \"net_over_budget\": %llu",
             (unsigned long long)n->changed, (unsigned long long)n->done, (unsigned long long)n->over_budget);
}
