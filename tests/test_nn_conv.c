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
} shape;

/* Odd heights, widths with every remainder of a tile, channels that fill no vector. */
static const shape shapes[] = {
    {8, 4, 0, 3, 5, false, false, false},  {2, 1, 0, 1, 1, false, false, false}, {14, 7, 0, 5, 16, true, false, true},
    {6, 3, 0, 8, 40, false, true, false},  {34, 5, 0, 17, 24, true, true, true}, {8, 4, 3, 2, 9, false, false, false},
    {12, 6, 8, 0, 16, true, false, false}, {20, 2, 5, 7, 33, true, false, true}, {4, 2, 1, 1, 1, false, false, false},
};
#define SHAPES (sizeof shapes / sizeof *shapes)

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
            BELOW(map_error(l.out_map, l.conv.out_stride, l.expected, l.width, l.height, l.out), 1e-5);
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
    gnn_conv_backward(c, l->weights, l->prepared, &m, dout, l->up ? dup : NULL, l->in ? din : NULL,
                      l->residual ? dadd : NULL, dweights, l->scratch);
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
        for (size_t i = 0; i < SHAPES; ++i) {
            seed(2 + i);
            layer l = layer_of(&shapes[i]);
            l.conv.simd = list[k];
            gradients_are_slopes(&l);
            free_layer(&l);
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(convolution_is_its_definition_on_every_level),
        cmocka_unit_test(convolution_gradients_are_slopes_on_every_level),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
