/* sdtree_naive.h: the SD-tree the textbook way, in double precision and with plain pointers, to check guide_sdtree.h
   against and to be measured against it: T. Mueller, M. Gross, J. Novak 2017, Practical Path Guiding.

     >>tree     quadtree over (z, phi): pdf, sample
     >>space    binary tree over the cube, copied out of a gsd_field
     >>learn    the whole method: record, refine
     >>denoise  surroundings of leaves by walks from the root; strength by trying out */
#ifndef SDTREE_NAIVE_H
#define SDTREE_NAIVE_H

#include "guide_sdtree.h"

#include <stdlib.h>

#define NAIVE_PI 3.14159265358979323846
#define NAIVE_UNIFORM 0.01

/* ---- >>tree ------------------------------------------------------------------------------------------------- */

/* Child number = (phi half) + 2 (z half). mass of a child includes everything below it. */
typedef struct naive_node {
    struct naive_node *child[4]; /* NULL = leaf */
    double mass[4];
} naive_node;

static inline double naive_total(const naive_node *n) { return n->mass[0] + n->mass[1] + n->mass[2] + n->mass[3]; }

static inline void naive_free(naive_node *n)
{
    if (!n)
        return;
    for (int c = 0; c < 4; ++c)
        naive_free(n->child[c]);
    free(n);
}

static inline naive_node *naive_new(void)
{
    naive_node *n = calloc(1, sizeof *n);
    if (!n)
        abort();
    return n;
}

static inline naive_node *naive_copy(const naive_node *from)
{
    naive_node *n = naive_new();
    *n = *from;
    for (int c = 0; c < 4; ++c)
        n->child[c] = from->child[c] ? naive_copy(from->child[c]) : NULL;
    return n;
}

static inline uint64_t naive_count(const naive_node *n)
{
    uint64_t count = 5; /* itself and four children */
    for (int c = 0; c < 4; ++c)
        count += n->child[c] ? naive_count(n->child[c]) - 1 : 0;
    return count;
}

/* Levels of the leaf in direction (x, y), both in [0, 1). */
static inline int naive_depth(const naive_node *n, double x, double y)
{
    int depth = 0;
    for (; n; ++depth) {
        int bx = x >= 0.5, by = y >= 0.5;
        x = 2 * x - bx;
        y = 2 * y - by;
        n = n->child[bx + 2 * by];
    }
    return depth;
}

static inline void naive_unit_square(const double *direction, double *x, double *y)
{
    double phi = atan2(direction[1], direction[0]) / (2 * NAIVE_PI);
    *x = phi < 0 ? phi + 1 : phi;
    *x = *x < 1 ? *x : 0;
    *y = fmin(fmax((direction[2] + 1) / 2, 0), 0x1.fffffffffffffp-1);
}

/* Density in 1/sr: product over levels of 4 mass(child) / mass(node), over 4 pi. */
static inline double naive_pdf(const naive_node *n, const double *direction)
{
    double x, y, density = 1;
    naive_unit_square(direction, &x, &y);
    while (n) {
        int bx = x >= 0.5, by = y >= 0.5;
        double total = naive_total(n);
        if (total > 0)
            density *= 4 * n->mass[bx + 2 * by] / total;
        x = 2 * x - bx;
        y = 2 * y - by;
        n = n->child[bx + 2 * by];
    }
    return ((1 - NAIVE_UNIFORM) * density + NAIVE_UNIFORM) / (4 * NAIVE_PI);
}

/* Which half r in [0, 1) falls into when the lower one has this share; r is stretched to [0, 1) again. */
static inline int naive_choose(double *r, double share)
{
    int upper = *r >= share;
    *r = upper ? (*r - share) / (1 - share) : *r / share;
    return upper;
}

static inline double naive_sample(const naive_node *n, double r0, double r1, double *direction)
{
    double x = 0, y = 0, size = 1, density = 1;
    int whole = r0 < NAIVE_UNIFORM;
    r0 = whole ? r0 / NAIVE_UNIFORM : (r0 - NAIVE_UNIFORM) / (1 - NAIVE_UNIFORM);
    while (n && !whole) {
        const double *m = n->mass;
        double total = naive_total(n);
        int bx = naive_choose(&r0, total > 0 ? (m[0] + m[2]) / total : 0.5);
        int by = naive_choose(&r1, m[bx] + m[bx + 2] > 0 ? m[bx] / (m[bx] + m[bx + 2]) : 0.5);
        if (total > 0)
            density *= 4 * m[bx + 2 * by] / total;
        size /= 2;
        x += bx * size;
        y += by * size;
        n = n->child[bx + 2 * by];
    }
    x += r0 * size;
    y += r1 * size;
    direction[2] = 2 * y - 1;
    double s = sqrt(fmax(0, 1 - direction[2] * direction[2]));
    direction[0] = s * cos(2 * NAIVE_PI * x);
    direction[1] = s * sin(2 * NAIVE_PI * x);
    if (whole)
        return naive_pdf(n, direction);
    return ((1 - NAIVE_UNIFORM) * density + NAIVE_UNIFORM) / (4 * NAIVE_PI);
}

/* ---- >>space ------------------------------------------------------------------------------------------------ */

/* A leaf has child[0] = NULL. */
typedef struct naive_space {
    struct naive_space *child[2];
    naive_node *building, *sampling;
    uint32_t cell;
    uint64_t samples;
    double pivot[3], nearness; /* the box is a unit cube */
} naive_space;

static inline void naive_free_space(naive_space *s)
{
    if (!s)
        return;
    naive_free_space(s->child[0]);
    naive_free_space(s->child[1]);
    naive_free(s->building);
    naive_free(s->sampling);
    free(s);
}

/* p in [0, 1)^3. */
static inline naive_space *naive_find(naive_space *s, const double *position)
{
    double p[3] = {position[0], position[1], position[2]};
    for (int axis = 0; s->child[0]; axis = axis == 2 ? 0 : axis + 1) {
        int upper = p[axis] >= 0.5;
        p[axis] = 2 * p[axis] - upper;
        s = s->child[upper];
    }
    return s;
}

/* Position relative to the pivot, as gsd_offset. */
static inline void naive_offset(const naive_space *s, const double *position, double *o)
{
    double l = 0;
    for (int k = 0; k < 3; ++k) {
        o[k] = (position[k] - s->pivot[k]) * s->nearness;
        l += o[k] * o[k];
    }
    for (int k = 0; k < 3 && l > 0.64; ++k)
        o[k] *= 0.8 / sqrt(l);
}

/* Density at a position: of the point of the sphere, by the solid angle there per solid angle here. */
static inline double naive_pdf_at(const naive_space *s, const double *position, const double *w)
{
    double o[3], seen[3], even = NAIVE_UNIFORM / (4 * NAIVE_PI), b, t, root;
    naive_offset(s, position, o);
    b = o[0] * w[0] + o[1] * w[1] + o[2] * w[2];
    root = sqrt(1 - (o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) + b * b);
    t = root - b;
    for (int k = 0; k < 3; ++k)
        seen[k] = o[k] + t * w[k];
    return (naive_pdf(s->sampling, seen) - even) * t * t / root + even;
}

static inline double naive_sample_at(const naive_space *s, const double *position, double r0, double r1, double *w)
{
    double o[3], l = 0;
    naive_sample(s->sampling, r0, r1, w);
    naive_offset(s, position, o);
    for (int k = 0; k < 3 && !(r0 < NAIVE_UNIFORM); ++k) { /* the even share is even as seen from here */
        w[k] -= o[k];
        l += w[k] * w[k];
    }
    for (int k = 0; k < 3 && l > 0; ++k)
        w[k] /= sqrt(l);
    return naive_pdf_at(s, position, w);
}

static inline naive_node *naive_import(const gsd_tree *tree, uint32_t node)
{
    naive_node *n = naive_new();
    for (int c = 0; c < 4; ++c) {
        uint32_t child = tree->child[4 * node + c];
        n->child[c] = child ? naive_import(tree, child) : NULL;
        n->mass[c] = child ? naive_total(n->child[c]) : (double)tree->value[4 * node + c];
    }
    return n;
}

/* Copy the sampling part: low = the box's lowest grid coordinates, level = its depth. */
static inline naive_space *naive_copy_field(const gsd_field *field, const gsd_view *view, const uint32_t *low,
                                            uint32_t level)
{
    naive_space *s = calloc(1, sizeof *s);
    if (!s)
        abort();
    uint32_t cell = gsd_cell_at(view, low), axis = level % 3;
    if (view->cells[cell].level > level) {
        uint32_t high[3] = {low[0], low[1], low[2]};
        high[axis] += gsd_cell_extent(level + 1, axis);
        s->child[0] = naive_copy_field(field, view, low, level + 1);
        s->child[1] = naive_copy_field(field, view, high, level + 1);
        return s;
    }
    s->cell = cell;
    for (int k = 0; k < 3; ++k)
        s->pivot[k] = ((double)view->cells[cell].pivot[k] - (double)view->origin[k]) * (double)view->scale * 0x1p-24;
    s->nearness = (double)view->cells[cell].nearness / (double)view->scale * 0x1p24;
    gsd_tree tree = {0, 0, NULL, NULL};
    tree.cell = cell;
    tree.count = gsd_export_bound(field, GSD_PART_SAMPLING, cell);
    tree.child = malloc(4 * tree.count * sizeof *tree.child);
    tree.value = malloc(4 * tree.count * sizeof *tree.value);
    if (!tree.child || !tree.value || gsd_export_tree(field, GSD_PART_SAMPLING, &tree))
        abort();
    s->sampling = naive_import(&tree, 0);
    free(tree.child);
    free(tree.value);
    return s;
}

/* ---- >>learn ------------------------------------------------------------------------------------------------ */

typedef struct naive_learner {
    naive_space *root;
    double split_samples, rho;
    int max_depth;
} naive_learner;

static inline naive_learner naive_create(double split_samples, double rho)
{
    naive_learner l = {calloc(1, sizeof(naive_space)), split_samples, rho, 16};
    if (!l.root)
        abort();
    l.root->building = naive_new();
    l.root->sampling = naive_new();
    return l;
}

static inline void naive_record(naive_learner *l, const double *position, const double *direction, double weight)
{
    double x, y;
    naive_space *s = naive_find(l->root, position);
    ++s->samples;
    naive_unit_square(direction, &x, &y);
    for (naive_node *n = s->building; n;) {
        int bx = x >= 0.5, by = y >= 0.5, c = bx + 2 * by;
        n->mass[c] += weight;
        x = 2 * x - bx;
        y = 2 * y - by;
        n = n->child[c];
    }
}

/* The next structure: divided where a child holds more than rho of all mass; sums zero. from may be NULL below the
   leaves of the old tree: the mass then spreads evenly. */
static inline naive_node *naive_rebuild(const naive_node *from, double mass, double total, double rho, int depth)
{
    naive_node *n = naive_new();
    for (int c = 0; c < 4; ++c) {
        double m = from ? from->mass[c] : mass / 4;
        if (m > rho * total && depth > 1)
            n->child[c] = naive_rebuild(from ? from->child[c] : NULL, m, total, rho, depth - 1);
    }
    return n;
}

static inline void naive_split(naive_space *s, double threshold)
{
    if (!s->child[0] && (double)s->samples > threshold) {
        for (int c = 0; c < 2; ++c) {
            s->child[c] = calloc(1, sizeof *s);
            if (!s->child[c])
                abort();
            s->child[c]->building = naive_copy(s->building);
            s->child[c]->sampling = naive_copy(s->sampling);
            s->child[c]->samples = s->samples / 2;
        }
        naive_free(s->building);
        naive_free(s->sampling);
        s->building = s->sampling = NULL;
    }
    for (int c = 0; c < 2; ++c)
        if (s->child[c])
            naive_split(s->child[c], threshold);
}

static inline void naive_rebuild_leaves(naive_space *s, const naive_learner *l)
{
    if (s->child[0]) {
        naive_rebuild_leaves(s->child[0], l);
        naive_rebuild_leaves(s->child[1], l);
        return;
    }
    naive_free(s->sampling);
    s->sampling = s->building;
    double total = naive_total(s->sampling);
    s->building = total > 0 ? naive_rebuild(s->sampling, total, total, l->rho, l->max_depth) : naive_new();
    s->samples = 0;
}

/* Passes of equal size: the threshold stays c. */
static inline void naive_refine(naive_learner *l)
{
    naive_split(l->root, l->split_samples);
    naive_rebuild_leaves(l->root, l);
}

/* ---- >>denoise ---------------------------------------------------------------------------------------------- */

/* Mass of the square (x, y) of 2^depth x 2^depth: of a node, a share of a leaf's by area, or the sum of a subtree. */
static inline double naive_square(const uint32_t *child, const double *mass, long x, long y, uint32_t depth)
{
    long n = 1l << depth;
    uint32_t node = 0, left = depth;
    if (y < 0 || y >= n) { /* past a pole */
        y = y < 0 ? -1 - y : 2 * n - 1 - y;
        x += n / 2;
    }
    x &= n - 1;
    while (left && child[node]) {
        --left;
        node = child[node] + (uint32_t)((x >> left) & 1) + 2 * (uint32_t)((y >> left) & 1);
    }
    return mass[node] / (double)(1ull << (2 * left));
}

static inline double naive_around(const uint32_t *child, const double *mass, long x, long y, uint32_t depth)
{
    double sum = 0;
    for (long j = -1; j <= 1; ++j)
        for (long i = -1; i <= 1; ++i)
            if (i || j)
                sum += (i && j ? 1 : 2) / 12.0 * naive_square(child, mass, x + i, y + j, depth);
    return sum;
}

typedef struct naive_blur {
    double strength;
    double *near; /* [nodes], leaves: the mass of their surroundings; the caller frees it */
} naive_blur;

/* gsdi_blur_tree for the radiance target, plainly: the strength is the best of many. */
static inline naive_blur naive_denoise(const uint32_t *child, const gsdi_sum *sum, uint32_t count)
{
    naive_blur out = {0, NULL};
    double *mass[3], *near[3], best = -1e300, near_total[3] = {0, 0, 0};
    long *x = calloc(count, sizeof *x), *y = calloc(count, sizeof *y);
    uint32_t *depth = calloc(count, sizeof *depth);
    for (int h = 0; h < 3; ++h) {
        mass[h] = calloc(count, sizeof(double));
        near[h] = calloc(count, sizeof(double));
        if (!x || !y || !depth || !mass[h] || !near[h])
            abort();
        for (uint32_t i = count; i-- > 0;) {
            const double *below = mass[h] + child[i];
            mass[h][i] = child[i] ? below[0] + below[1] + below[2] + below[3]
                         : h < 2  ? sum[i].half[h]
                                  : sum[i].half[0] + sum[i].half[1];
        }
    }
    for (uint32_t i = 0; i < count; ++i)
        for (uint32_t k = 0; k < 4 && child[i]; ++k) {
            x[child[i] + k] = 2 * x[i] + (k & 1);
            y[child[i] + k] = 2 * y[i] + (k >> 1);
            depth[child[i] + k] = depth[i] + 1;
        }
    for (int h = 0; h < 3; ++h)
        for (uint32_t i = 0; i < count; ++i)
            if (!child[i])
                near_total[h] += near[h][i] = naive_around(child, mass[h], x[i], y[i], depth[i]);
    for (int step = 0; step <= 24 && mass[0][0] > 0 && mass[1][0] > 0; ++step) {
        double t = GSDI_BLUR_MOST * step / 24, score = 0;
        for (uint32_t i = 0; i < count; ++i)
            for (int h = 0; h < 2 && !child[i]; ++h)
                score +=
                    mass[1 - h][i] / mass[1 - h][0] *
                    log((1 - GSDI_BLUR_EVEN) * ((1 - t) * mass[h][i] / mass[h][0] + t * near[h][i] / near_total[h]) +
                        GSDI_BLUR_EVEN * pow(0.25, depth[i]));
        if (score > best) {
            best = score;
            out.strength = t / (2 - t);
        }
    }
    for (uint32_t i = 0; i < count; ++i)
        near[2][i] *= near_total[2] > 0 ? mass[2][0] / near_total[2] : 0;
    out.near = near[2];
    for (int h = 0; h < 3; ++h) {
        free(mass[h]);
        if (h < 2)
            free(near[h]);
    }
    free(x);
    free(y);
    free(depth);
    return out;
}

#endif
