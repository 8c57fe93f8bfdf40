/* emission.c: where to start photon paths, learned from those that were of use (after Vorba et al. 2014).

   tr_light_emit makes a path's start of five numbers u in [0, 1): light, place, direction. What is learned is a density
   over these, a tree of boxes, so that one table serves lights of every kind: it narrows to a hole in a roof, to the
   lamp that lights what the camera sees, to a window's part of the sky.

     >>samples  numbers of the paths that were of use
     >>build    boxes, from all samples that are kept
     >>warp     from even numbers to the density

   A voxel that has M photons knows its light to about 1 / M of its variance, and a path that brings it h more changes
   that by h / M: the mean of the squared relative error over what camera paths meet, n vertices in each voxel, is
   least with a density proportional to the root of E[(sum of root(n) / M over the path's photons)^2]. A share of all
   paths stays even: no photon weighs more than 1 / EVEN of what it would. */
#include "emission.h"

#include <stdlib.h>
#include <string.h>

#define AXES 5
#define EVEN 0.25f      /* share of paths that are drawn evenly */
#define KEPT (1u << 15) /* samples; where there are more, every second is kept, then every fourth, ... */
#define MIN_SAMPLES 4u  /* of a box that is cut */
#define MIN_CHI 11.5  /* of a box that is cut: 3 degrees of freedom, one in 100 by chance; four paths in one quarter */
#define MAX_CUTS 8    /* of one axis */
#define MIN_GAIN 1.25 /* variance with even paths over that with guided ones, that guiding is to promise */
#define FADE 0.7f     /* of a pass's samples in the next one: by then more is known where they came */
#define MAX_AGE 13u   /* passes: FADE^13 is 1 %, such samples go */
#define BOXES 8192u
#define BELOW_ONE 0x1.fffffep-1f

typedef struct sample {
    float u[AXES], weight; /* weight: 1 / density */
    float need;            /* sum of root(n) / M over its photons, faded */
    uint16_t age;          /* passes */
    uint16_t halvings;     /* it stands for 2^halvings paths */
} sample;

/* A box; its halves are children and children + 1, unless it is a leaf. */
typedef struct box {
    float lower; /* probability of the lower half; of a leaf: its density */
    uint16_t children;
    uint8_t axis; /* AXES = leaf */
} box;

typedef struct tile_list {
    sample *samples;
    uint32_t count, capacity;
} tile_list;

struct tr_emission_map {
    tile_list *tiles;
    int tile_count;
    sample *kept;
    uint32_t count;
    uint32_t halvings; /* of the paths, one of every 2^halvings is kept */
    box *boxes;
    uint32_t box_count;
    bool guides;
    double gain;
};

tr_emission_map *tr_emission_map_create(int tiles)
{
    tr_emission_map *e = calloc(1, sizeof *e);
    if (!e)
        return NULL;
    e->tiles = calloc((size_t)tiles, sizeof *e->tiles);
    e->kept = malloc(KEPT * sizeof *e->kept);
    e->boxes = malloc(BOXES * sizeof *e->boxes);
    e->tile_count = e->tiles ? tiles : 0;
    e->gain = 1;
    if (e->tiles && e->kept && e->boxes)
        return e;
    tr_emission_map_destroy(e);
    return NULL;
}

void tr_emission_map_destroy(tr_emission_map *e)
{
    if (!e)
        return;
    for (int i = 0; i < e->tile_count; ++i)
        free(e->tiles[i].samples);
    free(e->tiles);
    free(e->kept);
    free(e->boxes);
    free(e);
}

double tr_emission_map_gain(const tr_emission_map *e) { return e->guides ? e->gain : 1; }

uint64_t tr_emission_map_bytes(const tr_emission_map *e)
{
    uint64_t samples = KEPT;
    for (int i = 0; i < e->tile_count; ++i)
        samples += e->tiles[i].capacity;
    return sizeof *e + (uint64_t)e->tile_count * sizeof *e->tiles + samples * sizeof(sample) + BOXES * sizeof *e->boxes;
}

/* ---- >>samples ---------------------------------------------------------------------------------------------- */

/* Whether a path is one of every 2^halvings that are kept. */
static bool keeps(const tr_emission_map *e, const float u[AXES])
{
    uint32_t bits[4];
    memcpy(bits, u + 1, sizeof bits);
    uint64_t h = tr_hash64((uint64_t)bits[0] << 32 | bits[1]) ^ ((uint64_t)bits[2] << 32 | bits[3]);
    return (tr_hash64(h) & ((UINT64_C(1) << e->halvings) - 1)) == 0;
}

bool tr_emission_map_record(tr_emission_map *e, int tile, const float u[5], float density, float need)
{
    tile_list *t = &e->tiles[tile];
    if (!keeps(e, u))
        return true;
    if (t->count == t->capacity) {
        uint32_t larger = t->capacity ? 2 * t->capacity : 256;
        sample *grown = realloc(t->samples, larger * sizeof *grown);
        if (!grown)
            return false;
        t->samples = grown;
        t->capacity = larger;
    }
    sample *s = &t->samples[t->count++];
    memset(s, 0, sizeof *s);
    memcpy(s->u, u, sizeof s->u);
    s->weight = 1 / density;
    s->need = need;
    return true;
}

static int by_path(const void *a, const void *b)
{
    const sample *x = a, *y = b;
    int order = memcmp(x->u, y->u, sizeof x->u);
    return order ? order : (x->need > y->need) - (x->need < y->need); /* sums are to have one order */
}

/* Samples of one path become one. */
static void join_paths(tr_emission_map *e)
{
    uint32_t n = 0;
    qsort(e->kept, e->count, sizeof *e->kept, by_path);
    for (uint32_t i = 0; i < e->count; ++i)
        if (n && !memcmp(e->kept[n - 1].u, e->kept[i].u, sizeof e->kept->u))
            e->kept[n - 1].need += e->kept[i].need;
        else
            e->kept[n++] = e->kept[i];
    e->count = n;
}

/* Half of the paths go, unless joining makes as much room. */
static void make_room(tr_emission_map *e)
{
    uint32_t n = 0;
    join_paths(e);
    if (e->count <= KEPT / 2)
        return;
    e->halvings++;
    for (uint32_t i = 0; i < e->count; ++i)
        if (keeps(e, e->kept[i].u)) {
            e->kept[n] = e->kept[i];
            if (e->kept[n].halvings < e->halvings) /* else it is from when fewer were kept */
                e->kept[n].halvings = (uint16_t)e->halvings;
            n++;
        }
    e->count = n;
}

void tr_emission_map_flush(tr_emission_map *e)
{
    for (int t = 0; t < e->tile_count; ++t) {
        for (uint32_t i = 0; i < e->tiles[t].count; ++i) {
            const sample *s = &e->tiles[t].samples[i];
            if (e->count == KEPT)
                make_room(e);
            if (e->count == KEPT || !keeps(e, s->u)) /* more halvings than when it was recorded */
                continue;
            e->kept[e->count] = *s;
            e->kept[e->count++].halvings = (uint16_t)e->halvings;
        }
        e->tiles[t].count = 0;
    }
}

/* A pass later: what is known by now fades, the oldest samples go, and where that leaves room more of the next paths
   are kept. */
static void grow_old(tr_emission_map *e)
{
    uint32_t n = 0;
    for (uint32_t i = 0; i < e->count; ++i) {
        sample s = e->kept[i];
        s.need *= FADE;
        if (++s.age < MAX_AGE)
            e->kept[n++] = s;
    }
    e->count = n;
    e->halvings -= e->halvings && n < KEPT / 4;
}

/* ---- >>build ------------------------------------------------------------------------------------------------ */

/* A box that is being made: numbers from low on, 2^-cuts wide on each axis. */
typedef struct part {
    float low[AXES];
    int cuts[AXES];
    double volume;
} part;

/* What a path adds to the second moment, as an even one would. */
static double square(const sample *s) { return ldexp((double)s->weight * s->need * s->need, s->halvings); }

/* The axis on which the samples are least even, by quarters; AXES = even on all, or too few. */
static int uneven_axis(const part *p, const sample *s, uint32_t n)
{
    double best = MIN_CHI, weight[AXES][4] = {{0}}, squares = 0;
    int axis = AXES;
    for (uint32_t i = 0; i < n && n >= MIN_SAMPLES; ++i) {
        double x = square(&s[i]);
        squares += x * x;
        for (int k = 0; k < AXES; ++k) {
            int q = (int)ldexpf(s[i].u[k] - p->low[k], p->cuts[k] + 2);
            weight[k][q < 0 ? 0 : q > 3 ? 3 : q] += x;
        }
    }
    for (int k = 0; k < AXES && squares > 0; ++k) {
        double *w = weight[k], mean = 0.25 * (w[0] + w[1] + w[2] + w[3]), chi = 0;
        for (int q = 0; q < 4; ++q)
            chi += 4 * (w[q] - mean) * (w[q] - mean) / squares;
        if (chi > best && p->cuts[k] < MAX_CUTS) {
            best = chi;
            axis = k;
        }
    }
    return axis;
}

/* The samples below the cut to the front. Returns their number. */
static uint32_t divide(sample *s, uint32_t n, int axis, float cut)
{
    uint32_t low = 0;
    for (uint32_t i = 0; i < n; ++i)
        if (s[i].u[axis] < cut) {
            sample t = s[low];
            s[low++] = s[i];
            s[i] = t;
        }
    return low;
}

/* Make box `at` of its samples. Returns the integral of the root over it. */
static double build(tr_emission_map *e, uint32_t at, const part *p, sample *s, uint32_t n)
{
    int axis = e->box_count + 2 <= BOXES ? uneven_axis(p, s, n) : AXES;
    box *b = &e->boxes[at];
    b->axis = (uint8_t)axis;
    if (axis == AXES) {
        double sum = 0;
        for (uint32_t i = 0; i < n; ++i)
            sum += square(&s[i]);
        b->lower = (float)sqrt(sum / p->volume);
        return (double)b->lower * p->volume;
    }
    part half = *p;
    float cut = p->low[axis] + ldexpf(0.5f, -p->cuts[axis]);
    uint32_t low = divide(s, n, axis, cut);
    half.cuts[axis]++;
    half.volume *= 0.5;
    b->children = (uint16_t)e->box_count;
    e->box_count += 2;
    double below = build(e, b->children, &half, s, low);
    half.low[axis] = cut;
    double above = build(e, b->children + 1u, &half, s + low, n - low);
    b->lower = below + above > 0 ? (float)(below / (below + above)) : 0.5f;
    return below + above;
}

/* From roots to probabilities, with the share of even paths. mass, volume: of box `at`. Adds to the variances of even
   and of guided paths. */
static void mix(tr_emission_map *e, uint32_t at, double mass, double volume, double total, double variance[2])
{
    box *b = &e->boxes[at];
    if (b->axis == AXES) {
        double root = (double)b->lower;
        b->lower = (float)((1 - EVEN) * root / total + EVEN);
        variance[0] += root * root * volume;
        variance[1] += root * root * volume / (double)b->lower;
        return;
    }
    double below = mass * (double)b->lower, above = mass - below;
    double low = (1 - EVEN) * below / total + EVEN * 0.5 * volume;
    double high = (1 - EVEN) * above / total + EVEN * 0.5 * volume;
    b->lower = clampf((float)(low / (low + high)), 0x1p-16f, 1 - 0x1p-16f); /* no half is out of reach */
    mix(e, b->children, below, 0.5 * volume, total, variance);
    mix(e, b->children + 1u, above, 0.5 * volume, total, variance);
}

static void build_boxes(tr_emission_map *e)
{
    part p = {.volume = 1};
    double variance[2] = {0, 0};
    e->guides = false;
    if (e->count < MIN_SAMPLES)
        return;
    e->box_count = 1;
    double mass = build(e, 0, &p, e->kept, e->count);
    if (!(mass > 0))
        return;
    mix(e, 0, mass, 1, mass, variance);
    e->gain = variance[0] / variance[1];
    e->guides = e->box_count > 1 && e->gain > MIN_GAIN;
}

void tr_emission_map_learn(tr_emission_map *e)
{
    join_paths(e);
    build_boxes(e);
    grow_old(e);
}

/* ---- >>warp ------------------------------------------------------------------------------------------------- */

float tr_emission_map_warp(const tr_emission_map *e, float u[5])
{
    const box *b = e ? e->boxes : NULL;
    float low[AXES] = {0}, width[AXES] = {1, 1, 1, 1, 1};
    double density = 1;
    if (!e || !e->guides)
        return 1;
    for (; b->axis < AXES;) {
        int k = b->axis;
        float lower = b->lower;
        width[k] *= 0.5f;
        if (u[k] < lower) {
            u[k] /= lower;
            density *= 2 * (double)lower;
            b = &e->boxes[b->children];
        } else {
            u[k] = (u[k] - lower) / (1 - lower);
            density *= 2 * (1 - (double)lower);
            low[k] += width[k];
            b = &e->boxes[b->children + 1];
        }
        u[k] = u[k] < BELOW_ONE ? u[k] : BELOW_ONE;
    }
    for (int k = 0; k < AXES; ++k) {
        u[k] = low[k] + width[k] * u[k];
        u[k] = u[k] < BELOW_ONE ? u[k] : BELOW_ONE;
    }
    return (float)density;
}
