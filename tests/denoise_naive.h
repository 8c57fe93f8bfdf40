/* denoise_naive.h: Gaussian denoising of one quadtree, slow and plain, in double precision, to check the denoising of
   guide_sdtree.h and its kernels against. Written from the text of J. Nilsson's thesis (Chalmers University of
   Technology and University of Gothenburg), chapter 4; knows nothing of guide_sdtree.h but the form of its trees.

     >>tree      plain arrays, depth           >>blur      weights, borders, mask, 7 x 7
     >>flatten   a layer as a matrix           >>rebuild   layers to one matrix, matrix to tree
     >>work      what the work limit admits

   DEPTH. The thesis counts the root as depth 1 and gives layer d a matrix 2^d wide (its Fig. 4.1: depth 4, 16 wide).
   Both hold when a node is what it is in [Mueller 2017] and in gsd_tree: a square with four children whose masses it
   stores. The root node is depth 1, its children are the 2 x 2 elements of layer 1. So
     - a leaf after d halvings of the square belongs to a node of depth d and covers one element of layer d;
     - the depth of a tree is the number of halvings of its deepest leaf;
     - the subtree below an element (the node that the element is divided by) has d_s = 1 where its children are all
       leaves: d_s = halvings from the element to the deepest leaf below it. An element that is a leaf has d_s = 0.

   Rows are z (row 0 at z = -1), columns phi (column 0 at phi = 0); child number = (phi half) + 2 (z half). */
#ifndef DENOISE_NAIVE_H
#define DENOISE_NAIVE_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define DN_RADIUS 3        /* of the 7 x 7 window */
#define DN_MAX_DEPTH 10    /* deeper trees are left alone where the work limit is on */
#define DN_BASE_WORK 1.5e7 /* elements that pass 0 may blur */

static inline void *dn_allocate(size_t count, size_t size)
{
    void *p = calloc(count ? count : 1, size);
    if (!p)
        abort();
    return p;
}

/* ---- >>tree ------------------------------------------------------------------------------------------------- */

/* As gsd_tree: node 0 is the root, child 0 = leaf, children come later than parents. value of an inner child is the
   sum of its leaves. */
typedef struct dn_tree {
    uint32_t count;
    uint32_t *child; /* [count][4] */
    double *value;   /* [count][4] */
} dn_tree;

static inline void dn_free_tree(dn_tree *t)
{
    free(t->child);
    free(t->value);
    memset(t, 0, sizeof *t);
}

/* Mass of the leaves below a node. */
static inline double dn_mass(const dn_tree *t, uint32_t node)
{
    double sum = 0;
    for (uint32_t k = 4 * node; k < 4 * node + 4; ++k)
        sum += t->child[k] ? dn_mass(t, t->child[k]) : t->value[k];
    return sum;
}

/* Only the values of leaves are read. */
static inline dn_tree dn_make_tree(uint32_t count, const uint32_t *child, const float *value)
{
    dn_tree t = {count, dn_allocate(4 * (size_t)count, sizeof *t.child),
                 dn_allocate(4 * (size_t)count, sizeof *t.value)};
    memcpy(t.child, child, 4 * (size_t)count * sizeof *child);
    for (uint32_t k = 0; k < 4 * count; ++k)
        t.value[k] = (double)value[k];
    for (uint32_t k = 0; k < 4 * count; ++k)
        t.value[k] = child[k] ? dn_mass(&t, child[k]) : t.value[k];
    return t;
}

static inline dn_tree dn_copy_tree(const dn_tree *from)
{
    size_t n = 4 * (size_t)from->count;
    dn_tree t = {from->count, dn_allocate(n, sizeof *t.child), dn_allocate(n, sizeof *t.value)};
    memcpy(t.child, from->child, n * sizeof *t.child);
    memcpy(t.value, from->value, n * sizeof *t.value);
    return t;
}

/* Halvings from the square of this node to the deepest leaf below it: the tree's depth for node 0, d_s for others. */
static inline uint32_t dn_depth(const dn_tree *t, uint32_t node)
{
    uint32_t deepest = 0;
    for (uint32_t k = 4 * node; k < 4 * node + 4; ++k) {
        uint32_t below = t->child[k] ? dn_depth(t, t->child[k]) : 0;
        deepest = below > deepest ? below : deepest;
    }
    return 1 + deepest;
}

/* Mass per area, area of the whole square = 1, at (x, y) = (phi, z) in [0, 1)^2. */
static inline double dn_density(const dn_tree *t, double x, double y)
{
    double area = 1;
    for (uint32_t node = 0;;) {
        uint32_t right = x >= 0.5, upper = y >= 0.5, k = 4 * node + right + 2 * upper;
        x = 2 * x - right;
        y = 2 * y - upper;
        area /= 4;
        if (!t->child[k])
            return t->value[k] / area;
        node = t->child[k];
    }
}

/* ---- >>flatten ---------------------------------------------------------------------------------------------- */

/* width x width, v[row * width + column]. */
typedef struct dn_matrix {
    uint32_t width;
    double *v;
} dn_matrix;

static inline dn_matrix dn_new_matrix(uint32_t width)
{
    dn_matrix m = {width, dn_allocate((size_t)width * width, sizeof *m.v)};
    return m;
}

static inline void dn_free_matrix(dn_matrix *m)
{
    free(m->v);
    m->v = NULL;
}

static inline double dn_sum(const dn_matrix *m)
{
    double sum = 0;
    for (size_t i = 0; i < (size_t)m->width * m->width; ++i)
        sum += m->v[i];
    return sum;
}

/* The square of this node is number (x, y) of 2^halvings x 2^halvings. leaf, where not NULL, gets for each element the
   number of the leaf that it lies in, from 1 on; 0 where a subtree lies below. */
static inline void dn_flatten_node(const dn_tree *t, uint32_t node, uint32_t halvings, uint32_t x, uint32_t y,
                                   uint32_t layer, dn_matrix *m, uint32_t *leaf)
{
    for (uint32_t k = 0; k < 4; ++k) {
        uint32_t c = t->child[4 * node + k], cx = 2 * x + (k & 1), cy = 2 * y + (k >> 1), below = layer - halvings - 1;
        if (c && below) {
            dn_flatten_node(t, c, halvings + 1, cx, cy, layer, m, leaf);
            continue;
        }
        double value = c ? dn_mass(t, c) * pow(0.25, dn_depth(t, c)) : t->value[4 * node + k] * pow(0.25, below);
        for (uint32_t row = cy << below; row < (cy + 1) << below; ++row)
            for (uint32_t column = cx << below; column < (cx + 1) << below; ++column) {
                m->v[(size_t)row * m->width + column] = value;
                if (leaf)
                    leaf[(size_t)row * m->width + column] = c ? 0 : 4 * node + k + 1;
            }
    }
}

/* Layer d >= 1 of the tree: masses, 2^d wide. Leaves above the layer are split by area; a subtree below an element
   counts with its sum times 4^-d_s. */
static inline dn_matrix dn_flatten(const dn_tree *t, uint32_t layer)
{
    dn_matrix m = dn_new_matrix(1u << layer);
    dn_flatten_node(t, 0, 0, 0, 0, layer, &m, NULL);
    return m;
}

/* ---- >>blur ------------------------------------------------------------------------------------------------- */

typedef enum dn_border {
    DN_ZERO,  /* nothing outside: the thesis */
    DN_SPHERE /* phi wraps; crossing z = +-1 continues at (+-2 - z, phi + pi): row -1-k is row k shifted by half a turn
               */
} dn_border;

/* Gaussian at -3 .. 3, sum 1. The 7 x 7 weights are products of two of these, so their sum is 1 too. */
static inline void dn_weights(double sigma, double weight[2 * DN_RADIUS + 1])
{
    double sum = 0;
    for (int i = -DN_RADIUS; i <= DN_RADIUS; ++i)
        sum += weight[i + DN_RADIUS] = exp(-i * i / (2 * sigma * sigma));
    for (int i = -DN_RADIUS; i <= DN_RADIUS; ++i)
        weight[i + DN_RADIUS] /= sum;
}

/* Index into a matrix for a row and column that may lie outside; -1 = nothing there. */
static inline long dn_index(long width, long row, long column, dn_border border)
{
    if (row >= 0 && row < width && column >= 0 && column < width)
        return row * width + column;
    if (border == DN_ZERO)
        return -1;
    while (row < 0 || row >= width) { /* more than once only where the matrix is narrower than the window */
        row = row < 0 ? -1 - row : 2 * width - 1 - row;
        column += width / 2;
    }
    return row * width + ((column % width) + width) % width;
}

/* 0 = the window of this element lies within one leaf, where blurring changes nothing; 1 = blur. [width^2] bytes. */
static inline unsigned char *dn_mask(const dn_tree *t, uint32_t layer, dn_border border)
{
    dn_matrix m = dn_new_matrix(1u << layer);
    long w = (long)m.width;
    uint32_t *leaf = dn_allocate((size_t)w * (size_t)w, sizeof *leaf);
    unsigned char *mask = dn_allocate((size_t)w * (size_t)w, 1);
    dn_flatten_node(t, 0, 0, 0, 0, layer, &m, leaf);
    for (long row = 0; row < w; ++row)
        for (long column = 0; column < w; ++column) {
            uint32_t own = leaf[row * w + column];
            bool one = own != 0;
            for (long i = -DN_RADIUS; i <= DN_RADIUS && one; ++i)
                for (long j = -DN_RADIUS; j <= DN_RADIUS && one; ++j) {
                    long at = dn_index(w, row + i, column + j, border);
                    one = at >= 0 && leaf[at] == own;
                }
            mask[row * w + column] = !one;
        }
    free(leaf);
    dn_free_matrix(&m);
    return mask;
}

/* 7 x 7 weighted sums; elements whose mask is 0 are copied (mask may be NULL). */
static inline dn_matrix dn_blur(const dn_matrix *in, double sigma, dn_border border, const unsigned char *mask)
{
    double weight[2 * DN_RADIUS + 1];
    dn_matrix out = dn_new_matrix(in->width);
    long w = (long)in->width;
    dn_weights(sigma, weight);
    for (long row = 0; row < w; ++row)
        for (long column = 0; column < w; ++column) {
            double sum = 0;
            if (mask && !mask[row * w + column]) {
                out.v[row * w + column] = in->v[row * w + column];
                continue;
            }
            for (long i = -DN_RADIUS; i <= DN_RADIUS; ++i)
                for (long j = -DN_RADIUS; j <= DN_RADIUS; ++j) {
                    long at = dn_index(w, row + i, column + j, border);
                    sum += at < 0 ? 0 : weight[i + DN_RADIUS] * weight[j + DN_RADIUS] * in->v[at];
                }
            out.v[row * w + column] = sum;
        }
    return out;
}

/* ---- >>rebuild ---------------------------------------------------------------------------------------------- */

typedef struct dn_options {
    uint32_t first_layer; /* 6 in the thesis; layers first_layer .. depth of the tree; the depth: only the deepest */
    double sigma;
    const double *layer_sigma; /* [depth + 1], sigma of each layer; NULL = sigma for all */
    dn_border border;
    bool mask;          /* copy where the window lies within one leaf */
    double rho;         /* a node with more than that share of the mass is divided */
    uint32_t max_depth; /* of the new tree, in halvings; below the matrix mass is even */
} dn_options;

/* into = max(into, from expanded to into's width). */
static inline void dn_expand_max(dn_matrix *into, const dn_matrix *from)
{
    uint32_t times = into->width / from->width;
    for (uint32_t row = 0; row < into->width; ++row)
        for (uint32_t column = 0; column < into->width; ++column) {
            double *to = &into->v[(size_t)row * into->width + column];
            *to = fmax(*to, from->v[(size_t)(row / times) * from->width + column / times] / ((double)times * times));
        }
}

/* The blurred layers as one matrix, 2^depth wide. first_layer <= depth of the tree. */
static inline dn_matrix dn_merge_layers(const dn_tree *t, const dn_options *o)
{
    uint32_t depth = dn_depth(t, 0);
    dn_matrix merged = dn_new_matrix(1u << depth);
    for (uint32_t layer = o->first_layer; layer <= depth; ++layer) {
        unsigned char *mask = o->mask ? dn_mask(t, layer, o->border) : NULL;
        dn_matrix flat = dn_flatten(t, layer);
        dn_matrix blurred = dn_blur(&flat, o->layer_sigma ? o->layer_sigma[layer] : o->sigma, o->border, mask);
        dn_expand_max(&merged, &blurred);
        dn_free_matrix(&flat);
        dn_free_matrix(&blurred);
        free(mask);
    }
    return merged;
}

/* Mass of square (x, y) of 2^halvings x 2^halvings. */
static inline double dn_square(const dn_matrix *m, uint32_t halvings, uint32_t x, uint32_t y)
{
    uint32_t squares = 1u << halvings;
    if (squares > m->width) { /* even below an element */
        uint32_t parts = squares / m->width;
        return m->v[(size_t)(y / parts) * m->width + x / parts] / ((double)parts * parts);
    }
    double sum = 0;
    uint32_t size = m->width / squares;
    for (uint32_t row = y * size; row < (y + 1) * size; ++row)
        for (uint32_t column = x * size; column < (x + 1) * size; ++column)
            sum += m->v[(size_t)row * m->width + column];
    return sum;
}

/* Divide squares while they hold more than rho of the mass, down to max_depth halvings. The root is always divided: the
   arrays cannot hold less. Nodes are in order of depth. */
static inline dn_tree dn_rebuild(const dn_matrix *m, double rho, uint32_t max_depth)
{
    typedef struct square {
        uint32_t halvings, x, y;
    } square;
    double total = dn_sum(m);
    uint32_t capacity = 64;
    dn_tree t = {1, dn_allocate(4 * (size_t)capacity, sizeof *t.child),
                 dn_allocate(4 * (size_t)capacity, sizeof *t.value)};
    square *of = dn_allocate(capacity, sizeof *of);
    for (uint32_t node = 0; node < t.count; ++node)
        for (uint32_t k = 0; k < 4; ++k) {
            square s = {of[node].halvings + 1, 2 * of[node].x + (k & 1), 2 * of[node].y + (k >> 1)};
            double mass = dn_square(m, s.halvings, s.x, s.y);
            t.value[4 * node + k] = mass;
            t.child[4 * node + k] = 0;
            if (!(mass > rho * total) || s.halvings >= max_depth)
                continue;
            if (t.count == capacity) {
                capacity *= 2;
                t.child = realloc(t.child, 4 * (size_t)capacity * sizeof *t.child);
                t.value = realloc(t.value, 4 * (size_t)capacity * sizeof *t.value);
                of = realloc(of, capacity * sizeof *of);
                if (!t.child || !t.value || !of)
                    abort();
            }
            of[t.count] = s;
            t.child[4 * node + k] = t.count++;
        }
    free(of);
    return t;
}

/* All of it. A tree shallower than the first layer is returned as it is. */
static inline dn_tree dn_denoise(const dn_tree *t, const dn_options *o)
{
    if (dn_depth(t, 0) < o->first_layer)
        return dn_copy_tree(t);
    dn_matrix merged = dn_merge_layers(t, o);
    dn_tree out = dn_rebuild(&merged, o->rho, o->max_depth);
    dn_free_matrix(&merged);
    return out;
}

/* ---- >>work ------------------------------------------------------------------------------------------------- */

/* Elements of all layers of a tree of this depth. */
static inline double dn_work(uint32_t depth, uint32_t first_layer)
{
    double work = 0;
    for (uint32_t layer = first_layer; layer <= depth; ++layer)
        work += ldexp(1, 2 * (int)layer);
    return work;
}

static inline double dn_work_limit(uint32_t pass) { return ldexp(DN_BASE_WORK, (int)pass); }

/* Which of these trees are denoised in a pass with the work limit on: those not deeper than DN_MAX_DEPTH, in order,
   each if the sum of elements stays within the limit with it. Returns the sum. (The thesis says only that the sum
   decides; where all of them fit, every reading admits the same.) */
static inline double dn_admit(uint32_t count, const uint32_t *depth, uint32_t first_layer, uint32_t pass,
                              bool *admitted)
{
    double sum = 0;
    for (uint32_t i = 0; i < count; ++i) {
        double work = dn_work(depth[i], first_layer);
        admitted[i] = depth[i] <= DN_MAX_DEPTH && depth[i] >= first_layer && sum + work <= dn_work_limit(pass);
        sum += admitted[i] ? work : 0;
    }
    return sum;
}

#endif
