/* test_nn_histogram.c: the U-Net of guide_nn.h that repairs histograms: against its definition in double precision, its
   gradients against finite differences, threads, saves, bad input, and whether it learns.

   gcc -std=c11 -O2 -I. -pthread tests/test_nn_histogram.c -lcmocka -lm */
#include "cmocka_prelude.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GNN_IMPLEMENTATION
#include "guide_nn.h"

typedef gnn_range_fn gsd_range_fn; /* crowd.h and counter.h speak of guide_sdtree.h */
typedef gnn_unet_desc gsd_desc;
#include "counter.h"
#include "crowd.h"
#include "nn_naive.h"
#include "rng.h"

/* ---- helpers */

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

/* A workspace of exactly the size that is asked for, not aligned to more than a float. */
typedef struct workspace {
    char *memory;
    size_t size;
} workspace;

static void *start(const workspace *w) { return w->memory + 4; }

static workspace make_workspace(const gnn_unet *net, uint32_t maps, bool train)
{
    workspace w;
    w.size = gnn_unet_workspace(net, maps, train);
    w.memory = malloc(w.size + 4);
    assert_non_null(w.memory);
    memset(w.memory, 0xff, w.size + 4); /* NaN */
    return w;
}

static gnn_unet_desc small_desc(uint32_t levels, bool no_mask)
{
    gnn_unet_desc d;
    memset(&d, 0, sizeof d);
    d.width = 16, d.height = 8;
    d.inputs = 3;
    d.levels = levels;
    d.channels[0] = 3, d.channels[1] = 9, d.channels[2] = 4;
    d.no_mask = no_mask;
    d.training = true;
    d.lambda = 2;
    d.deep = 0.5f;
    return d;
}

static gnn_unet *make_net(const gnn_unet_desc *d)
{
    gnn_unet *net;
    assert_int_equal(gnn_unet_create(d, &net), GNN_OK);
    return net;
}

/* Inputs with holes: the last plane is the mask of the others, about one pixel in five. */
static void draw_maps(const gnn_unet_desc *d, uint32_t maps, float *inputs, float *truths)
{
    size_t area = (size_t)d->width * d->height;
    for (uint32_t m = 0; m < maps; ++m)
        for (size_t i = 0; i < area; ++i) {
            bool there = rnd() < 0.2;
            for (uint32_t c = 0; c < d->inputs; ++c)
                inputs[(m * d->inputs + c) * area + i] = c + 1 == d->inputs ? (float)there : there ? 1 + rndf() : 0;
            if (truths)
                truths[m * area + i] = 2 * rndf();
        }
}

/* The network's weights in double precision, biases and heads made large enough to matter. */
typedef struct naive_weights {
    double *tensors[64];
    uint64_t counts[64];
    uint32_t count;
    int channels[8];
    naive_net net;
} naive_weights;

static naive_weights *naive_of(gnn_unet *net)
{
    naive_weights *w = calloc(1, sizeof *w);
    gnn_unet_desc d = gnn_unet_get_desc(net);
    char name[40];
    uint32_t rank;
    uint64_t shape[GNN_MAX_RANK];
    w->count = gnn_unet_tensors(net);
    for (uint32_t i = 0; i < w->count; ++i) {
        w->counts[i] = gnn_unet_tensor(net, i, name, &rank, shape);
        float *values = new_floats(w->counts[i]);
        gnn_unet_tensor_export(net, NULL, i, values);
        w->tensors[i] = naive_new(w->counts[i]);
        for (uint64_t k = 0; k < w->counts[i]; ++k) {
            if (rank == 1 || name[0] == 'h')
                values[k] = rndf() - 0.5f;
            w->tensors[i][k] = (double)values[k];
        }
        gnn_unet_tensor_import(net, i, values);
        free(values);
    }
    for (uint32_t l = 0; l < d.levels; ++l)
        w->channels[l] = (int)d.channels[l];
    naive_net n = {(int)d.width, (int)d.height,    (int)d.inputs,  (int)d.levels, !d.no_mask,
                   w->channels,  (double)d.lambda, (double)d.deep, w->tensors};
    w->net = n;
    return w;
}

static void free_naive(naive_weights *w)
{
    for (uint32_t i = 0; i < w->count; ++i)
        free(w->tensors[i]);
    free(w);
}

static void doubles(const float *from, size_t count, double *to)
{
    for (size_t i = 0; i < count; ++i)
        to[i] = (double)from[i];
}

/* ---- definition and gradients */

static void output_is_its_definition(gnn_unet *net, naive_weights *w)
{
    gnn_unet_desc d = gnn_unet_get_desc(net);
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(3 * d.inputs * area), *outputs = new_floats(3 * area);
    double *in = naive_new(d.inputs * area), *truth = naive_new(area), *out = naive_new(area);
    workspace space = make_workspace(net, 2, false); /* three maps: two groups */
    draw_maps(&d, 3, inputs, NULL);
    memset(inputs, 0, d.inputs * area * sizeof(float)); /* the first is empty */
    assert_int_equal(gnn_unet_forward(net, inputs, 3, outputs, start(&space), space.size, NULL, NULL), GNN_OK);
    for (uint32_t m = 0; m < 3; ++m) {
        double worst = 0, square = 0;
        doubles(inputs + m * d.inputs * area, d.inputs * area, in);
        naive_unet(&w->net, in, truth, out);
        for (size_t i = 0; i < area; ++i) {
            double e = fabs((double)outputs[m * area + i] - out[i]);
            worst = e > worst || e != e ? e : worst;
            square += out[i] * out[i];
        }
        BELOW(worst, 1e-5 * sqrt(square / (double)area) + 2e-6);
    }
    free(space.memory);
    free(inputs), free(outputs), free(in), free(truth), free(out);
}

/* Gradients by some weights of every tensor against central differences of the loss in double precision. Where the loss
   bends within the step (relu, absolute value) the sides differ: such weights are counted, not compared. */
static void gradients_are_slopes(gnn_unet *net, naive_weights *w)
{
    gnn_unet_desc d = gnn_unet_get_desc(net);
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(d.inputs * area), *truth = new_floats(area);
    float *gradients = new_floats(gnn_unet_floats(net));
    double *in = naive_new(d.inputs * area), *t = naive_new(area), *out = naive_new(area);
    workspace space = make_workspace(net, 1, true);
    gnn_step step;
    int bends = 0, compared = 0;
    draw_maps(&d, 1, inputs, truth);
    doubles(inputs, d.inputs * area, in);
    doubles(truth, area, t);
    assert_int_equal(gnn_unet_gradients(net, inputs, truth, 1, gradients, &step, start(&space), space.size, NULL, NULL),
                     GNN_OK);
    double middle = naive_unet(&w->net, in, t, out);
    BELOW(fabs(step.loss - middle), 1e-5 * middle);
    for (uint32_t i = 0; i < w->count; ++i) {
        float *values = new_floats(w->counts[i]);
        double worst = 0, square = 0;
        int count = 0;
        gnn_unet_tensor_export(net, gradients, i, values);
        for (uint64_t k = 0; k < w->counts[i]; k += w->counts[i] / 12 + 1) {
            double *x = &w->tensors[i][k], at = *x, h = 1e-7;
            *x = at - h;
            double low = naive_unet(&w->net, in, t, out);
            *x = at + h;
            double high = naive_unet(&w->net, in, t, out);
            *x = at;
            if (fabs(high - 2 * middle + low) > 1e-4 * h) {
                ++bends;
                continue;
            }
            double slope = (high - low) / (2 * h), e = fabs(slope - (double)values[k]);
            worst = e > worst || e != e ? e : worst;
            square += slope * slope;
            ++count;
        }
        BELOW(worst, 1e-4 * (count ? sqrt(square / count) : 0) + 1e-6);
        compared += count;
        free(values);
    }
    assert_true(compared > 5 * bends && compared > 80);
    free(space.memory);
    free(inputs), free(truth), free(gradients), free(in), free(t), free(out);
}

static void network_and_gradients_are_their_definition(void **state)
{
    (void)state;
    for (uint32_t levels = 1; levels <= 3; ++levels)
        for (int no_mask = 0; no_mask < 2; ++no_mask) {
            seed(10 * levels + (uint64_t)no_mask);
            gnn_unet_desc d = small_desc(levels, no_mask);
            gnn_unet *net = make_net(&d);
            naive_weights *w = naive_of(net);
            output_is_its_definition(net, w);
            if (levels > 1)
                gradients_are_slopes(net, w);
            free_naive(w);
            gnn_unet_destroy(net);
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(network_and_gradients_are_their_definition),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
