/* test_nn_conv.c: the layers of guide_nn.h against their definitions in double precision, gradients against finite
   differences of those.

   gcc -std=c11 -O2 -I. tests/test_nn_conv.c -lcmocka -lm */
#include "cmocka_prelude.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GNN_IMPLEMENTATION
#include "guide_nn.h"

#include "nn_naive.h"
#include "rng.h"

/* ---- helpers */

/* x < limit; says both where not, NaN too. */
#define BELOW(x, limit) below((x), (limit), #x, __LINE__)

static void below(double x, double limit, const char *what, int line)
{
    if (!(x < limit))
        fail_msg("line %d: %s = %.4g, not below %.4g", line, what, x, limit);
}

static float *new_floats(size_t count)
{
    float *p = calloc(count ? count : 1, sizeof *p);
    assert_non_null(p);
    return p;
}

/* Values with signs, exact in float. */
static void draw(double *values, size_t count, double scale)
{
    for (size_t i = 0; i < count; ++i)
        values[i] = (double)(float)(scale * (2 * rnd() - 1));
}

static void to_map(const double *planes, int width, int height, int channels, uint32_t stride, float *map)
{
    float *p = new_floats((size_t)(width * height * channels));
    for (int i = 0; i < width * height * channels; ++i)
        p[i] = (float)planes[i];
    gnn_map_from_planes(p, (uint32_t)width, (uint32_t)height, (uint32_t)channels, stride, map);
    free(p);
}

/* Largest difference of a map's inside from planes, by the planes' root mean square. */
static double map_error(const float *map, uint32_t stride, const double *planes, int width, int height, int channels)
{
    int n = width * height * channels;
    float *p = new_floats((size_t)n);
    double worst = 0, square = 0;
    gnn_map_to_planes(map, (uint32_t)width, (uint32_t)height, (uint32_t)channels, stride, p);
    for (int i = 0; i < n; ++i) {
        double d = fabs((double)p[i] - planes[i]);
        worst = d > worst || d != d ? d : worst;
        square += planes[i] * planes[i];
    }
    free(p);
    return square > 0 ? worst / sqrt(square / n) : worst;
}

/* Levels that this machine has. */
static int levels(gnn_simd *list)
{
    static const gnn_simd all[] = {GNN_SIMD_SCALAR, GNN_SIMD_AVX2, GNN_SIMD_AVX512, GNN_SIMD_NEON};
    int n = 0;
    for (int i = 0; i < 4; ++i)
        if (gnn_resolve_simd(all[i]) == all[i])
            list[n++] = all[i];
    return n;
}

/* ---- a layer with everything that belongs to it, as floats and in double */

typedef struct layer {
    gnn_conv conv;
    int width, height, up, in, out;
    bool masked, residual;
    double *up_planes, *in_planes, *kernel, *bias, *mask, *add, *expected, *weight_of_loss;
    float *up_map, *in_map, *scale, *add_map, *out_map, *weights, *prepared, *scratch;
} layer;

static size_t area(const layer *l) { return (size_t)(l->width * l->height); }

/* The layer's output in double precision. */
static void expect(const layer *l, double *out)
{
    double *all = naive_new(area(l) * (size_t)(l->up + l->in));
    naive_upsample(l->up_planes, l->up, l->width / 2, l->height / 2, all);
    memcpy(all + area(l) * (size_t)l->up, l->in_planes, area(l) * (size_t)l->in * sizeof *all);
    naive_conv(all, l->up + l->in, l->width, l->height, l->kernel, l->bias, l->mask, l->add, l->conv.relu, l->out, out);
    free(all);
}

static void draw_mask(layer *l)
{
    l->mask = naive_new(area(l));
    for (size_t i = 0; i < area(l); ++i) {
        l->mask[i] = rnd() < 0.15;
        for (int c = 0; c < l->in; ++c)
            l->in_planes[(size_t)c * area(l) + i] *= l->mask[i];
    }
    for (int y = 0; y < l->height; ++y)
        for (int x = 0; x < l->width; ++x) {
            double count = 0;
            for (int k = 0; k < 9; ++k)
                count += naive_at(l->mask, l->width, l->height, x + k % 3 - 1, y + k / 3 - 1);
            l->scale[y * l->width + x] = count > 0 ? (float)(9 / count) : 0;
        }
}

static void layer_maps(layer *l)
{
    gnn_conv *c = &l->conv;
    float *kernel = new_floats((size_t)(l->out * (l->up + l->in) * 9)), *bias = new_floats((size_t)l->out);
    for (int i = 0; i < l->out * (l->up + l->in) * 9; ++i)
        kernel[i] = (float)l->kernel[i];
    for (int i = 0; i < l->out; ++i)
        bias[i] = (float)l->bias[i];
    gnn_conv_import(c, kernel, bias, l->weights);
    gnn_conv_prepare(c, l->weights, l->prepared);
    if (l->up)
        to_map(l->up_planes, l->width / 2, l->height / 2, l->up, c->up_stride, l->up_map);
    if (l->in)
        to_map(l->in_planes, l->width, l->height, l->in, c->in_stride, l->in_map);
    if (l->add)
        to_map(l->add, l->width, l->height, l->out, c->out_stride, l->add_map);
    free(kernel);
    free(bias);
}

static layer make_layer(int width, int height, int up, int in, int out, bool relu, bool masked, bool residual)
{
    layer l;
    gnn_conv *c = &l.conv;
    memset(&l, 0, sizeof l);
    l.width = width, l.height = height, l.up = up, l.in = in, l.out = out;
    l.masked = masked, l.residual = residual;
    c->width = (uint32_t)width, c->height = (uint32_t)height;
    c->up = (uint32_t)up, c->up_stride = gnn_stride(c->up);
    c->in = (uint32_t)in, c->in_stride = gnn_stride(c->in);
    c->out = (uint32_t)out, c->out_stride = gnn_stride(c->out);
    c->relu = relu, c->simd = gnn_resolve_simd(GNN_SIMD_AUTO);
    assert_int_equal(gnn_conv_check(c), GNN_OK);
    size_t n = area(&l);
    l.up_planes = naive_new((size_t)up * n / 4), l.in_planes = naive_new((size_t)in * n);
    l.kernel = naive_new((size_t)(out * (up + in) * 9)), l.bias = naive_new((size_t)out);
    l.expected = naive_new((size_t)out * n), l.weight_of_loss = naive_new((size_t)out * n);
    draw(l.up_planes, (size_t)up * n / 4, 1);
    draw(l.in_planes, (size_t)in * n, 1);
    draw(l.kernel, (size_t)(out * (up + in) * 9), 1);
    draw(l.bias, (size_t)out, 1);
    draw(l.weight_of_loss, (size_t)out * n, 1);
    l.up_map = new_floats(gnn_map_floats(c->width / 2, c->height / 2, c->up_stride));
    l.in_map = new_floats(gnn_map_floats(c->width, c->height, c->in_stride));
    l.out_map = new_floats(gnn_map_floats(c->width, c->height, c->out_stride));
    l.add_map = new_floats(gnn_map_floats(c->width, c->height, c->out_stride));
    l.scale = new_floats(n);
    l.weights = new_floats(gnn_conv_weights(c));
    l.prepared = new_floats(gnn_conv_prepared(c));
    l.scratch = new_floats(gnn_conv_scratch(c));
    if (residual) {
        l.add = naive_new((size_t)out * n);
        draw(l.add, (size_t)out * n, 1);
    }
    if (masked)
        draw_mask(&l);
    layer_maps(&l);
    return l;
}

/* After a change of the layer's options. */
static void layer_prepare(layer *l)
{
    free(l->prepared);
    free(l->scratch);
    l->prepared = new_floats(gnn_conv_prepared(&l->conv));
    l->scratch = new_floats(gnn_conv_scratch(&l->conv));
    gnn_conv_prepare(&l->conv, l->weights, l->prepared);
}

static void free_layer(layer *l)
{
    void *all[] = {l->up_planes, l->in_planes,      l->kernel,   l->bias,   l->mask,  l->add,
                   l->expected,  l->weight_of_loss, l->up_map,   l->in_map, l->scale, l->add_map,
                   l->out_map,   l->weights,        l->prepared, l->scratch};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
}

static gnn_conv_maps maps_of(const layer *l)
{
    gnn_conv_maps m;
    memset(&m, 0, sizeof m);
    m.up = l->up ? l->up_map : NULL;
    m.in = l->in ? l->in_map : NULL;
    m.scale = l->masked ? l->scale : NULL;
    m.add = l->residual ? l->add_map : NULL;
    m.out = l->out_map;
    return m;
}

static void forward(layer *l)
{
    gnn_conv_maps m = maps_of(l);
    gnn_conv_forward(&l->conv, l->weights, l->prepared, &m, l->scratch);
}

typedef struct shape {
    int width, height, up, in, out;
    bool relu, masked, residual;
} shape; /* 16x8 and more, multiples of 4, have the 8 tiles from which on Winograd's method is used */

/* Odd heights, widths with every remainder of a tile, channels that fill no vector. */
static const shape shapes[] = {
    {8, 4, 0, 3, 5, false, false, false},   {2, 1, 0, 1, 1, false, false, false},
    {14, 7, 0, 5, 16, true, false, true},   {6, 3, 0, 8, 40, false, true, false},
    {34, 5, 0, 17, 24, true, true, true},   {8, 4, 3, 2, 9, false, false, false},
    {12, 6, 8, 0, 16, true, false, false},  {20, 2, 5, 7, 33, true, false, true},
    {4, 2, 1, 1, 1, false, false, false},   {8, 4, 40, 40, 9, true, false, true},
    {32, 16, 0, 5, 9, false, false, false}, {64, 8, 3, 17, 24, true, false, true},
    {36, 16, 0, 16, 40, true, true, true},  {32, 20, 8, 0, 7, false, false, false},
};
#define SHAPES (sizeof shapes / sizeof *shapes)
#define SMALL_SHAPES 10 /* before those for Winograd's method, which the backward pass does not use */

static layer layer_of(const shape *s)
{
    return make_layer(s->width, s->height, s->up, s->in, s->out, s->relu, s->masked, s->residual);
}

static void convolution_is_its_definition_on_every_level(void **state)
{
    gnn_simd list[4];
    int n = levels(list);
    (void)state;
    seed(1);
    for (size_t i = 0; i < SHAPES; ++i) {
        layer l = layer_of(&shapes[i]);
        expect(&l, l.expected);
        for (int k = 0; k < n; ++k) {
            l.conv.simd = list[k];
            forward(&l);
            BELOW(map_error(l.out_map, l.conv.out_stride, l.expected, l.width, l.height, l.out), 5e-5);
            l.conv.no_winograd = true;
            layer_prepare(&l);
            forward(&l);
            BELOW(map_error(l.out_map, l.conv.out_stride, l.expected, l.width, l.height, l.out), 1e-5);
            l.conv.no_winograd = false;
            layer_prepare(&l);
        }
        free_layer(&l);
    }
}

/* ---- gradients: loss = sum of weight_of_loss * out */

static double loss_of(const layer *l)
{
    double sum = 0;
    expect(l, l->expected);
    for (size_t i = 0; i < area(l) * (size_t)l->out; ++i)
        sum += l->expected[i] * l->weight_of_loss[i];
    return sum;
}

/* Central difference of the loss by one of its inputs. Piecewise linear, so exact but where a relu bends within the
   step: small steps, and NaN tells that both sides differ. */
static double slope(const layer *l, double *x)
{
    double at = *x, step = 1e-4, low, high, middle = loss_of(l);
    *x = at - step;
    low = loss_of(l);
    *x = at + step;
    high = loss_of(l);
    *x = at;
    return fabs(high - 2 * middle + low) < 1e-9 ? (high - low) / (2 * step) : (double)NAN;
}

typedef struct gradient {
    const layer *l;
    double worst, square;
    int count, bends;
} gradient;

static void compare(gradient *g, double *x, double computed)
{
    double s = slope(g->l, x);
    if (s != s) {
        ++g->bends;
        return;
    }
    double d = fabs(s - computed);
    g->worst = d > g->worst || d != d ? d : g->worst;
    g->square += s * s;
    ++g->count;
}

/* Some of the planes' values against a gradient map's. */
static void compare_planes(gradient *g, double *planes, int width, int height, int channels, uint32_t stride,
                           const float *map, const double *mask)
{
    int total = width * height * channels, step = total / 60 + 1;
    for (int i = (int)(rng_next() % (uint64_t)step); i < total; i += step) {
        int c = i / (width * height), y = i / width % height, x = i % width;
        if (mask && mask[y * width + x] == 0)
            continue; /* the definition does not read it; the map holds 0 there */
        compare(g, &planes[i],
                (double)map[((size_t)(y + 1) * (size_t)(width + 2) + (size_t)x + 1) * stride + (size_t)c]);
    }
}

static void check_gradient(gradient *g)
{
    assert_true(g->bends * 4 <= g->count);
    BELOW(g->worst, 2e-5 * (sqrt(g->square / (g->count ? g->count : 1)) + 1));
}

static void gradients_are_slopes(layer *l)
{
    gnn_conv *c = &l->conv;
    float *dout = new_floats(gnn_map_floats(c->width, c->height, c->out_stride));
    float *dadd = new_floats(gnn_map_floats(c->width, c->height, c->out_stride));
    float *din = new_floats(gnn_map_floats(c->width, c->height, c->in_stride));
    float *dup = new_floats(gnn_map_floats(c->width / 2, c->height / 2, c->up_stride));
    float *dweights = new_floats(gnn_conv_weights(c));
    float *dkernel = new_floats((size_t)(l->out * (l->up + l->in) * 9)), *dbias = new_floats((size_t)l->out);
    gnn_conv_maps m = maps_of(l);
    forward(l);
    to_map(l->weight_of_loss, l->width, l->height, l->out, c->out_stride, dout);
    gnn_conv_backward(c, l->prepared, &m, dout, l->up ? dup : NULL, l->in ? din : NULL, l->residual ? dadd : NULL,
                      dweights, l->scratch);
    gnn_conv_export(c, dweights, dkernel, dbias);
    gradient kernel = {l, 0, 0, 0, 0}, bias = kernel, up = kernel, in = kernel, add = kernel;
    int kernels = l->out * (l->up + l->in) * 9, step = kernels / 60 + 1;
    for (int i = 0; i < kernels; i += step)
        compare(&kernel, &l->kernel[i], (double)dkernel[i]);
    for (int i = 0; i < l->out; ++i)
        compare(&bias, &l->bias[i], (double)dbias[i]);
    compare_planes(&up, l->up_planes, l->width / 2, l->height / 2, l->up, c->up_stride, dup, NULL);
    compare_planes(&in, l->in_planes, l->width, l->height, l->in, c->in_stride, din, l->mask);
    if (l->residual)
        compare_planes(&add, l->add, l->width, l->height, l->out, c->out_stride, dadd, NULL);
    check_gradient(&kernel);
    check_gradient(&bias);
    check_gradient(&up);
    check_gradient(&in);
    check_gradient(&add);
    float *all[] = {dout, dadd, din, dup, dweights, dkernel, dbias};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
}

static void convolution_gradients_are_slopes_on_every_level(void **state)
{
    gnn_simd list[4];
    int n = levels(list);
    (void)state;
    for (int k = 0; k < n; ++k)
        for (size_t i = 0; i < SMALL_SHAPES; ++i) {
            seed(2 + i);
            layer l = layer_of(&shapes[i]);
            l.conv.simd = list[k];
            gradients_are_slopes(&l);
            free_layer(&l);
        }
}

/* ---- the small parts */

static void halo_wraps_and_crosses_poles(void **state)
{
    static const int sizes[][2] = {{2, 1}, {6, 3}, {8, 1}, {10, 7}};
    (void)state;
    for (size_t s = 0; s < sizeof sizes / sizeof *sizes; ++s) {
        int w = sizes[s][0], h = sizes[s][1];
        double *plane = naive_new((size_t)(w * h));
        for (int i = 0; i < w * h; ++i)
            plane[i] = i + 1;
        float *map = new_floats(gnn_map_floats((uint32_t)w, (uint32_t)h, 8));
        to_map(plane, w, h, 1, 8, map);
        for (int y = -1; y <= h; ++y)
            for (int x = -1; x <= w; ++x) {
                const float *pixel = map + ((y + 1) * (w + 2) + x + 1) * 8;
                assert_true((double)pixel[0] == naive_at(plane, w, h, x, y));
                for (int c = 1; c < 8; ++c)
                    assert_true(pixel[c] == 0);
            }
        free(map), free(plane);
    }
}

static void pooling_is_the_mean_and_its_adjoint(void **state)
{
    enum { W = 12, H = 6, C = 3 };
    double *planes = naive_new(W * H * C), *small = naive_new(W * H * C / 4);
    float *map = new_floats(gnn_map_floats(W, H, 8)), *to = new_floats(gnn_map_floats(W / 2, H / 2, 8));
    float *back = new_floats(gnn_map_floats(W, H, 8));
    double left = 0, right = 0;
    (void)state;
    seed(4);
    draw(planes, W * H * C, 1);
    for (int c = 0; c < C; ++c)
        for (int y = 0; y < H; ++y)
            for (int x = 0; x < W; ++x)
                small[(c * (H / 2) + y / 2) * (W / 2) + x / 2] += planes[(c * H + y) * W + x] / 4;
    to_map(planes, W, H, C, 8, map);
    gnn_pool(map, W, H, 8, to);
    BELOW(map_error(to, 8, small, W / 2, H / 2, C), 1e-6);
    /* <g, pool(x)> = <back(g), x>, here with g = pool(x) */
    gnn_pool_backward(to, W, H, 8, back);
    for (int i = 0; i < W * H * C / 4; ++i)
        left += small[i] * small[i];
    for (int c = 0; c < C; ++c)
        for (int y = 0; y < H; ++y)
            for (int x = 0; x < W; ++x)
                right += planes[(c * H + y) * W + x] * (double)back[((y + 1) * (W + 2) + x + 1) * 8 + c];
    BELOW(fabs(left - right), 1e-6 * left);
    free(planes), free(small), free(map), free(to), free(back);
}

static void masks_grow_over_the_seam_and_the_poles(void **state)
{
    static const int sizes[][2] = {{2, 1}, {6, 3}, {8, 1}, {10, 7}, {140, 3}};
    (void)state;
    seed(9);
    for (size_t s = 0; s < sizeof sizes / sizeof *sizes; ++s)
        for (int full = 0; full <= 4; ++full) { /* from empty to full */
            int w = sizes[s][0], h = sizes[s][1];
            double *plane = naive_new((size_t)(w * h));
            float *mask = new_floats((size_t)(w * h)), *scale = new_floats((size_t)(w * h));
            float *grown = new_floats((size_t)(w * h));
            for (int i = 0; i < w * h; ++i)
                mask[i] = (float)(plane[i] = rnd() < 0.25 * full);
            gnn_mask_grow(mask, (uint32_t)w, (uint32_t)h, scale, grown);
            for (int i = 0; i < w * h; ++i) {
                double count = 0;
                for (int k = 0; k < 9; ++k)
                    count += naive_at(plane, w, h, i % w + k % 3 - 1, i / w + k / 3 - 1);
                assert_true(grown[i] == (count > 0));
                assert_true(count > 0 ? fabs((double)scale[i] * count - 9) < 1e-5 : scale[i] == 0);
                assert_true(full < 4 || scale[i] == 1);
            }
            free(plane), free(mask), free(scale), free(grown);
        }
}

static void an_empty_mask_gives_zeros_and_no_gradient(void **state)
{
    (void)state;
    seed(12);
    layer l = make_layer(8, 4, 0, 5, 9, true, true, false);
    gnn_conv *c = &l.conv;
    size_t map = gnn_map_floats(c->width, c->height, c->out_stride);
    float *dout = new_floats(map), *din = new_floats(gnn_map_floats(c->width, c->height, c->in_stride));
    float *dweights = new_floats(gnn_conv_weights(c));
    gnn_conv_maps m = maps_of(&l);
    memset(l.scale, 0, area(&l) * sizeof(float));
    forward(&l);
    for (size_t i = 0; i < map; ++i)
        assert_true(l.out_map[i] == 0);
    for (size_t i = 0; i < map; ++i)
        dout[i] = 1;
    gnn_conv_backward(c, l.prepared, &m, dout, NULL, din, NULL, dweights, l.scratch);
    for (size_t i = 0; i < gnn_conv_weights(c); ++i)
        assert_true(dweights[i] == 0);
    for (size_t i = 0; i < gnn_map_floats(c->width, c->height, c->in_stride); ++i)
        assert_true(din[i] == 0);
    free(dout), free(din), free(dweights);
    free_layer(&l);
}

static void losses_prefer_the_side_of_the_input_and_their_gradients_are_slopes(void **state)
{
    static const float truth[] = {1, 1, 1, 1, 2}, input[] = {3, 3, 0, 0, 2}, out[] = {2, 0, 2, 0, 2.5f};
    float dout[5];
    (void)state;
    assert_true(gnn_loss(out, input, truth, 5, 3, 1, NULL) == (double)(1 + 3 + 3 + 1 + 0.5f) / 5);
    assert_true(gnn_loss(out, input, truth, 5, 3, 2, dout) == (double)(1 + 3 + 3 + 1 + 0.5f) / 5);
    for (int i = 0; i < 5; ++i) {
        float moved[5];
        memcpy(moved, out, sizeof moved);
        moved[i] += 0.125f;
        double slope = 2 * (gnn_loss(moved, input, truth, 5, 3, 1, NULL) - gnn_loss(out, input, truth, 5, 3, 1, NULL));
        BELOW(fabs(slope / 0.125 - (double)dout[i]), 1e-6);
    }
}

/* Adam in double precision, as its algorithm 1 has it. */
static void adam_is_its_algorithm(void **state)
{
    float w[3] = {1, -2, 0.5f}, first[3] = {0}, second[3] = {0}, g[3];
    double x[3] = {1, -2, 0.5}, m[3] = {0}, v[3] = {0};
    (void)state;
    seed(3);
    for (int step = 1; step <= 200; ++step) {
        for (int i = 0; i < 3; ++i) {
            g[i] = i == 2 ? 0 : 4 * rndf() - 1;
            m[i] = 0.9 * m[i] + 0.1 * (double)g[i];
            v[i] = 0.99 * v[i] + 0.01 * (double)g[i] * (double)g[i];
            x[i] -= 0.01 * (m[i] / (1 - pow(0.9, step))) / (sqrt(v[i] / (1 - pow(0.99, step))) + 1e-8);
        }
        gnn_adam(w, g, first, second, 3, (uint64_t)step, 0.01f, 0.9f, 0.99f, 1e-8f);
    }
    for (int i = 0; i < 3; ++i)
        BELOW(fabs((double)w[i] - x[i]), 1e-4);
    assert_true(w[2] == 0.5f);
}

/* NaN reaches what looks at it, and nothing else: no sum over pixels or channels hides in a kernel. */
static void not_a_number_reaches_its_neighbours_only(void **state)
{
    gnn_simd list[4];
    int n = levels(list);
    (void)state;
    for (int k = 0; k < 2 * n; ++k) {
        int reach = k % 2 ? 1 : 4; /* of whoever shares a tile of 4x4 */
        seed(6);
        layer l = make_layer(40, 20, 0, 16, 16, false, false, false);
        l.conv.simd = list[k / 2];
        l.conv.no_winograd = k % 2;
        layer_prepare(&l);
        size_t total = gnn_map_floats(40, 20, 16);
        float *before = new_floats(total);
        forward(&l);
        memcpy(before, l.out_map, total * sizeof(float));
        l.in_map[(11 * 42 + 21) * 16 + 3] = NAN; /* x = 20, y = 10 */
        forward(&l);
        for (int y = 0; y < 20; ++y)
            for (int x = 0; x < 40; ++x)
                for (int c = 0; c < 16; ++c) {
                    size_t at = (size_t)(((y + 1) * 42 + x + 1) * 16 + c);
                    bool near = abs(x - 20) <= reach && abs(y - 10) <= reach;
                    if (abs(x - 20) <= 1 && abs(y - 10) <= 1)
                        assert_true(l.out_map[at] != l.out_map[at]);
                    else
                        assert_true(near || memcmp(&l.out_map[at], &before[at], sizeof(float)) == 0);
                }
        free(before);
        free_layer(&l);
    }
}

static void shapes_that_do_not_fit_are_refused(void **state)
{
    gnn_conv good = {8, 4, 3, 8, 2, 8, 5, 8, true, GNN_SIMD_SCALAR, false}, c;
    (void)state;
    assert_int_equal(gnn_conv_check(&good), GNN_OK);
#define REFUSED(result, change)                                                                                        \
    c = good;                                                                                                          \
    change;                                                                                                            \
    assert_int_equal(gnn_conv_check(&c), result)
    REFUSED(GNN_BAD_SHAPE, c.width = 6);
    REFUSED(GNN_BAD_SHAPE, c.width = 0);
    REFUSED(GNN_BAD_SHAPE, c.height = 3);
    REFUSED(GNN_BAD_SHAPE, c.height = 0);
    REFUSED(GNN_BAD_SHAPE, c.width = 8192);
    REFUSED(GNN_BAD_RANGE, c.up_stride = 3);
    REFUSED(GNN_BAD_RANGE, c.in_stride = 1);
    REFUSED(GNN_BAD_RANGE, c.in_stride = 12);
    REFUSED(GNN_BAD_OPTION, c.simd = GNN_SIMD_AUTO);
    REFUSED(GNN_BAD_OPTION, c.simd = (gnn_simd)77);
    REFUSED(GNN_BAD_RANGE, c.out_stride = 5);
    REFUSED(GNN_BAD_RANGE, c.out = c.out_stride = 0);
    REFUSED(GNN_BAD_RANGE, c.up = c.in = 0);
    REFUSED(GNN_BAD_RANGE, c.in = c.in_stride = 100000);
    assert_int_equal(gnn_resolve_simd((gnn_simd)77), GNN_SIMD_AUTO);
    assert_string_equal(gnn_result_string(GNN_OK), "ok");
    assert_non_null(gnn_result_string((gnn_result)99));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(convolution_is_its_definition_on_every_level),
        cmocka_unit_test(convolution_gradients_are_slopes_on_every_level),
        cmocka_unit_test(halo_wraps_and_crosses_poles),
        cmocka_unit_test(pooling_is_the_mean_and_its_adjoint),
        cmocka_unit_test(masks_grow_over_the_seam_and_the_poles),
        cmocka_unit_test(an_empty_mask_gives_zeros_and_no_gradient),
        cmocka_unit_test(losses_prefer_the_side_of_the_input_and_their_gradients_are_slopes),
        cmocka_unit_test(adam_is_its_algorithm),
        cmocka_unit_test(not_a_number_reaches_its_neighbours_only),
        cmocka_unit_test(shapes_that_do_not_fit_are_refused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
