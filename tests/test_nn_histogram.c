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
        BELOW(worst, 5e-5 * sqrt(square / (double)area) + 2e-6);
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

/* ---- threads, groups, levels */

static void results_do_not_depend_on_threads_and_groups(void **state)
{
    static const int threads[] = {1, 2, 5, 8};
    gnn_unet_desc d = small_desc(3, false);
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(11 * d.inputs * area), *truths = new_floats(11 * area);
    float *first = new_floats(11 * area), *outputs = new_floats(11 * area);
    float *weights = NULL, *again;
    (void)state;
    seed(3);
    draw_maps(&d, 11, inputs, truths);
    for (int i = 0; i < 4; ++i) {
        crowd c = {threads[i], 1};
        gnn_unet *net = make_net(&d);
        gnn_step step;
        workspace space = make_workspace(net, i == 0 ? 1 : 2 + (uint32_t)i, true);
        for (int k = 0; k < 5; ++k)
            assert_int_equal(
                gnn_unet_train(net, inputs, truths, 11, &step, start(&space), space.size, i ? crowd_for : NULL, &c),
                GNN_OK);
        assert_int_equal(step.maps, 11);
        assert_int_equal(
            gnn_unet_forward(net, inputs, 11, outputs, start(&space), space.size, i ? crowd_for : NULL, &c), GNN_OK);
        again = new_floats(gnn_unet_floats(net));
        memcpy(again, net->weights, gnn_unet_floats(net) * sizeof(float));
        if (i == 0) {
            weights = again;
            memcpy(first, outputs, 11 * area * sizeof(float));
        } else {
            assert_memory_equal(weights, again, gnn_unet_floats(net) * sizeof(float));
            assert_memory_equal(first, outputs, 11 * area * sizeof(float));
            free(again);
        }
        free(space.memory);
        gnn_unet_destroy(net);
    }
    free(weights), free(inputs), free(truths), free(first), free(outputs);
}

static void levels_of_simd_agree(void **state)
{
    static const gnn_simd all[] = {GNN_SIMD_SCALAR, GNN_SIMD_AVX2, GNN_SIMD_AVX512, GNN_SIMD_NEON};
    gnn_unet_desc d;
    (void)state;
    memset(&d, 0, sizeof d); /* all defaults */
    assert_int_equal(gnn_unet_resolve(&d), GNN_OK);
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(d.inputs * area), *outputs[2] = {new_floats(area), new_floats(area)};
    seed(4);
    draw_maps(&d, 1, inputs, NULL);
    for (int i = 0; i < 4; ++i) {
        if (gnn_resolve_simd(all[i]) != all[i])
            continue;
        d.simd = all[i];
        gnn_unet *net = make_net(&d);
        seed(5);
        free_naive(naive_of(net)); /* heads that matter; the same ones each time */
        workspace space = make_workspace(net, 1, false);
        assert_int_equal(gnn_unet_forward(net, inputs, 1, outputs[i > 0], start(&space), space.size, NULL, NULL),
                         GNN_OK);
        double worst = 0, square = 0;
        for (size_t k = 0; i && k < area; ++k) {
            double e = fabs((double)outputs[1][k] - (double)outputs[0][k]);
            worst = e > worst || e != e ? e : worst;
            square += (double)outputs[0][k] * (double)outputs[0][k];
        }
        BELOW(worst, 1e-4 * sqrt(square / (double)area) + 1e-30);
        free(space.memory);
        gnn_unet_destroy(net);
    }
    free(inputs), free(outputs[0]), free(outputs[1]);
}

/* ---- bad input */

static void bad_values_stay_in_their_map(void **state)
{
    static const float bad[] = {NAN, INFINITY, -INFINITY, 1e30f, 3e38f};
    gnn_unet_desc d = small_desc(3, false);
    gnn_unet *net = make_net(&d);
    size_t area = (size_t)d.width * d.height, map = d.inputs * area;
    float *inputs = new_floats(3 * map), *truths = new_floats(3 * area);
    float *good = new_floats(3 * area), *outputs = new_floats(3 * area), *want = new_floats(gnn_unet_floats(net));
    float *gradients = new_floats(gnn_unet_floats(net));
    gnn_step step;
    workspace space = make_workspace(net, 1, true); /* one after the other in the same memory */
    (void)state;
    seed(6);
    free_naive(naive_of(net));
    draw_maps(&d, 3, inputs, truths);
    assert_int_equal(gnn_unet_forward(net, inputs, 3, good, start(&space), space.size, NULL, NULL), GNN_OK);
    for (size_t b = 0; b < sizeof bad / sizeof *bad; ++b) {
        float saved[2] = {inputs[map + 7], inputs[map + area + 9]};
        inputs[map + 7] = inputs[map + area + 9] = bad[b];
        inputs[map + 2 * area + 7] = 1;
        assert_int_equal(gnn_unet_forward(net, inputs, 3, outputs, start(&space), space.size, NULL, NULL), GNN_OK);
        assert_memory_equal(outputs, good, area * sizeof(float));
        assert_memory_equal(outputs + 2 * area, good + 2 * area, area * sizeof(float));
        assert_int_equal(
            gnn_unet_gradients(net, inputs, truths, 3, gradients, &step, start(&space), space.size, NULL, NULL),
            GNN_OK);
        assert_int_equal(step.refused, 1);
        assert_int_equal(step.maps, 2);
        assert_true(gnni_all_below(gradients, gnn_unet_floats(net), INFINITY));
        inputs[map + 7] = saved[0], inputs[map + area + 9] = saved[1];
    }
    /* the gradient of the two that count is what these two alone give */
    memmove(inputs + map, inputs + 2 * map, map * sizeof(float));
    memmove(truths + area, truths + 2 * area, area * sizeof(float));
    assert_int_equal(gnn_unet_gradients(net, inputs, truths, 2, want, &step, start(&space), space.size, NULL, NULL),
                     GNN_OK);
    assert_memory_equal(want, gradients, gnn_unet_floats(net) * sizeof(float));
    /* where no map counts, no step is made */
    memcpy(want, net->weights, gnn_unet_floats(net) * sizeof(float));
    truths[0] = NAN;
    assert_int_equal(gnn_unet_train(net, inputs, truths, 1, &step, start(&space), space.size, NULL, NULL), GNN_OK);
    assert_int_equal(step.refused, 1);
    assert_memory_equal(want, net->weights, gnn_unet_floats(net) * sizeof(float));
    free(space.memory);
    gnn_unet_destroy(net);
    free(inputs), free(truths), free(good), free(outputs), free(want), free(gradients);
}

/* Finite, and the loss is small: but a square of such a derivative would stay in Adam's moments. */
static void huge_derivatives_are_left_out_of_training(void **state)
{
    gnn_unet_desc d = small_desc(2, false);
    gnn_unet *net = make_net(&d);
    size_t area = (size_t)d.width * d.height, floats = gnn_unet_floats(net);
    float *inputs = new_floats(d.inputs * area), *truths = new_floats(area), *before = new_floats(3 * floats),
          zeros[16];
    gnn_step step;
    workspace space = make_workspace(net, 1, true);
    (void)state;
    seed(9);
    draw_maps(&d, 1, inputs, truths);
    memset(zeros, 0, sizeof zeros);
    for (uint32_t i = 12; i < gnn_unet_tensors(net); ++i) /* the head: the output is input 0 then */
        gnn_unet_tensor_import(net, i, zeros);
    for (int k = 0; k < 2; ++k) {
        float value = k ? 1e19f : 1e12f;
        for (size_t i = 0; i < area; ++i)
            inputs[area + i] = inputs[2 * area + i] > 0 ? value : 0;
        memcpy(before, net->weights, floats * sizeof(float));
        memcpy(before + floats, net->first, 2 * floats * sizeof(float));
        assert_int_equal(gnn_unet_train(net, inputs, truths, 1, &step, start(&space), space.size, NULL, NULL), GNN_OK);
        assert_int_equal(step.refused, k);
        assert_true(k || step.loss < 10);
        assert_int_equal(memcmp(before, net->weights, floats * sizeof(float)) == 0, k);
        assert_int_equal(memcmp(before + floats, net->first, 2 * floats * sizeof(float)) == 0, k);
        for (uint32_t i = 12; i < gnn_unet_tensors(net); ++i)
            gnn_unet_tensor_import(net, i, zeros);
    }
    free(space.memory);
    gnn_unet_destroy(net);
    free(inputs), free(truths), free(before);
}

static void empty_full_and_one_bin_maps_give_finite_output(void **state)
{
    gnn_unet_desc d;
    (void)state;
    memset(&d, 0, sizeof d);
    assert_int_equal(gnn_unet_resolve(&d), GNN_OK);
    gnn_unet *net = make_net(&d);
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(3 * d.inputs * area), *outputs = new_floats(3 * area);
    workspace space = make_workspace(net, 1, false);
    for (uint32_t c = 0; c < d.inputs; ++c) {
        inputs[(d.inputs + c) * area + 31 * d.width] = c == 4 ? 1 : 2048; /* one bin, at a pole */
        for (size_t i = 0; i < area; ++i)
            inputs[(2 * d.inputs + c) * area + i] = 1;
    }
    assert_int_equal(gnn_unet_forward(net, inputs, 3, outputs, start(&space), space.size, NULL, NULL), GNN_OK);
    assert_true(gnni_all_below(outputs, 3 * area, INFINITY));
    for (size_t i = 1; i < area; ++i) { /* a map that is even stays so: the wrapped borders are no borders */
        BELOW(fabs((double)(outputs[i] - outputs[0])), 1e-6);
        BELOW(fabs((double)(outputs[2 * area + i] - outputs[2 * area])), 1e-6);
    }
    free(space.memory);
    gnn_unet_destroy(net);
    free(inputs), free(outputs);
}

static void small_workspaces_and_bad_descriptors_are_refused(void **state)
{
    gnn_unet_desc d = small_desc(3, false), bad;
    gnn_unet *net = make_net(&d), *none;
    size_t area = (size_t)d.width * d.height;
    float *inputs = new_floats(d.inputs * area), *outputs = new_floats(area);
    float *gradients = new_floats(gnn_unet_floats(net));
    gnn_step step;
    workspace space = make_workspace(net, 1, false);
    (void)state;
    assert_int_equal(gnn_unet_forward(net, inputs, 1, outputs, start(&space), space.size - 64, NULL, NULL),
                     GNN_BUFFER_TOO_SMALL);
    assert_int_equal(gnn_unet_forward(net, inputs, 1, outputs, NULL, space.size, NULL, NULL), GNN_BUFFER_TOO_SMALL);
    assert_int_equal(gnn_unet_forward(net, inputs, 1, outputs, start(&space), 3, NULL, NULL), GNN_BUFFER_TOO_SMALL);
    assert_int_equal(
        gnn_unet_gradients(net, inputs, outputs, 1, gradients, &step, start(&space), space.size, NULL, NULL),
        GNN_BUFFER_TOO_SMALL);
#define REFUSED(result, change)                                                                                        \
    bad = d;                                                                                                           \
    change;                                                                                                            \
    assert_int_equal(gnn_unet_create(&bad, &none), result);                                                            \
    assert_null(none)
    REFUSED(GNN_BAD_SHAPE, bad.width = 20);
    REFUSED(GNN_BAD_SHAPE, bad.height = 6);
    REFUSED(GNN_BAD_SHAPE, bad.width = 2048);
    REFUSED(GNN_BAD_RANGE, bad.levels = 7);
    REFUSED(GNN_BAD_RANGE, bad.inputs = 17);
    REFUSED(GNN_BAD_RANGE, bad.channels[1] = 513);
    REFUSED(GNN_BAD_RANGE, bad.lambda = 0.5f);
    REFUSED(GNN_BAD_RANGE, bad.rate = NAN);
    REFUSED(GNN_BAD_RANGE, bad.beta2 = 1);
    REFUSED(GNN_BAD_OPTION, bad.simd = (gnn_simd)9);
    REFUSED(GNN_BAD_ALLOCATOR, bad.allocate = count_allocate);
    free(space.memory);
    gnn_unet_destroy(net);
    gnn_unet_destroy(NULL);
    free(inputs), free(outputs), free(gradients);
}

static void training_needs_a_network_for_it(void **state)
{
    gnn_unet_desc d = small_desc(2, false);
    d.training = false;
    gnn_unet *net = make_net(&d);
    float *inputs = new_floats(3 * 128), *truths = new_floats(128), *before = new_floats(gnn_unet_floats(net));
    gnn_step step = {1, 1, 1};
    workspace space = make_workspace(net, 1, true);
    (void)state;
    memcpy(before, net->weights, gnn_unet_floats(net) * sizeof(float));
    assert_true(!net->first && !net->second && !net->gradients);
    assert_int_equal(gnn_unet_train(net, inputs, truths, 1, &step, start(&space), space.size, NULL, NULL),
                     GNN_BAD_OPTION);
    assert_true(step.loss == 0 && step.maps == 0 && step.refused == 0);
    assert_memory_equal(before, net->weights, gnn_unet_floats(net) * sizeof(float));
    free(inputs), free(truths), free(before), free(space.memory);
    gnn_unet_destroy(net);
}

static void sizes_stay_below_the_bound_and_do_not_wrap(void **state)
{
    static const uint32_t shapes[][4] = {{64, 32, 5, 3}, {1024, 1024, 16, 1}, {64, 32, 1, 6}, {2, 1, 1, 1}};
    static const uint32_t channels[] = {1, 8, 33};
    (void)state;
    for (int k = 0; k < 12; ++k) {
        gnn_unet_desc d;
        memset(&d, 0, sizeof d);
        d.width = shapes[k / 3][0], d.height = shapes[k / 3][1], d.inputs = shapes[k / 3][2],
        d.levels = shapes[k / 3][3];
        for (uint32_t l = 0; l < d.levels; ++l)
            d.channels[l] = channels[k % 3];
        d.training = true;
        gnn_unet *net = make_net(&d);
        uint64_t most = gnni_most_floats(&net->desc), place = net->train.total;
        assert_true(place <= most && net->run.total <= most && 4 * net->floats + net->prepared_floats <= most);
        assert_true(gnn_unet_workspace(net, 0, true) == place * sizeof(float) + 64);
        assert_true(gnn_unet_workspace(net, 7, true) == 7 * place * sizeof(float) + 64);
        net->train.total = SIZE_MAX / 16;
        assert_true(gnn_unet_workspace(net, 3, true) == SIZE_MAX / 16 * 4 * 3 + 64);
        assert_true(gnn_unet_workspace(net, 4, true) == SIZE_MAX);
        assert_true(gnn_unet_workspace(net, UINT32_MAX, true) == SIZE_MAX);
        gnn_unet_destroy(net);
    }
}

static void failed_allocations_are_told_and_nothing_leaks(void **state)
{
    gnn_unet_desc d = small_desc(2, false);
    counter c;
    gnn_unet *net, *source = make_net(&d);
    size_t size = gnn_unet_bound(source, GNN_TYPE_F32, NULL), written;
    char *file = malloc(size);
    (void)state;
    assert_int_equal(gnn_unet_save(source, GNN_TYPE_F32, NULL, file, size, &written), GNN_OK);
    for (long fail = 1; fail <= 5; ++fail) {
        memset(&c, 0, sizeof c);
        c.fail_at = fail;
        count_with(&d, &c);
        gnn_result result = gnn_unet_create(&d, &net);
        assert_int_equal(result, fail <= 2 ? GNN_OUT_OF_MEMORY : GNN_OK);
        if (result == GNN_OK) {
            assert_int_equal(gnn_unet_load(net, file, size, NULL), fail <= 4 ? GNN_OUT_OF_MEMORY : GNN_OK);
            assert_int_equal(gnn_unet_bound(net, GNN_TYPE_F32, NULL), fail <= 4 ? size : 0);
            assert_int_equal(c.live, 2);
            long requests = c.requests;
            workspace space = make_workspace(net, 1, true);
            float *inputs = new_floats(3 * 128), *outputs = new_floats(128);
            gnn_step step;
            gnn_unet_forward(net, inputs, 1, outputs, start(&space), space.size, NULL, NULL);
            gnn_unet_train(net, inputs, outputs, 1, &step, start(&space), space.size, NULL, NULL);
            assert_int_equal(c.requests, requests); /* running and training allocate nothing */
            free(space.memory), free(inputs), free(outputs);
            gnn_unet_destroy(net);
        }
        assert_int_equal(c.live, 0);
    }
    gnn_unet_destroy(source);
    free(file);
}

/* ---- saves */

static void saved_training_goes_on_as_if_it_had_not_stopped(void **state)
{
    gnn_unet_desc d = small_desc(3, false);
    const char *metadata[] = {"architecture", "gnn_unet", NULL};
    gnn_unet *net = make_net(&d), *other = make_net(&d);
    size_t area = (size_t)d.width * d.height, size, written;
    float *inputs = new_floats(2 * d.inputs * area), *truths = new_floats(2 * area);
    gnn_step step;
    gnn_message message;
    workspace space = make_workspace(net, 2, true);
    (void)state;
    seed(8);
    draw_maps(&d, 2, inputs, truths);
    for (int i = 0; i < 4; ++i)
        gnn_unet_train(net, inputs, truths, 2, &step, start(&space), space.size, NULL, NULL);
    size = gnn_unet_bound(net, GNN_TYPE_F32, metadata);
    char *file = malloc(size);
    assert_int_equal(gnn_unet_save(net, GNN_TYPE_F32, metadata, file, size - 1, &written), GNN_BUFFER_TOO_SMALL);
    assert_int_equal(gnn_unet_save(net, GNN_TYPE_F32, metadata, file, size, &written), GNN_OK);
    assert_int_equal(written, size);
    gnn_unet_seed(other, 99);
    assert_int_equal(gnn_unet_load(other, file, size, &message), GNN_OK);
    for (int i = 0; i < 3; ++i) {
        gnn_unet_train(net, inputs, truths, 2, &step, start(&space), space.size, NULL, NULL);
        gnn_unet_train(other, inputs, truths, 2, &step, start(&space), space.size, NULL, NULL);
    }
    assert_memory_equal(net->weights, other->weights, gnn_unet_floats(net) * sizeof(float));
    /* half precision: weights only, rounded */
    free(file);
    size = gnn_unet_bound(net, GNN_TYPE_F16, NULL);
    assert_true(size < 2 * gnn_unet_parameters(net) + 6000);
    file = malloc(size);
    assert_int_equal(gnn_unet_save(net, GNN_TYPE_F16, NULL, file, size, &written), GNN_OK);
    assert_int_equal(gnn_unet_load(other, file, size, &message), GNN_OK);
    for (size_t i = 0; i < gnn_unet_floats(net); ++i)
        BELOW(fabs((double)(net->weights[i] - other->weights[i])), 5e-4 * fabs((double)net->weights[i]) + 1e-7);
    free(file), free(space.memory), free(inputs), free(truths);
    gnn_unet_destroy(net);
    gnn_unet_destroy(other);
}

/* A file of the network with one tensor changed: its name, its shape, or one value. */
static char *spoiled_file(gnn_unet *net, uint32_t which, int how, size_t *size)
{
    gnn_weight w[64];
    char names[64][40];
    uint32_t count = gnn_unet_tensors(net);
    float *values[64];
    memset(w, 0, sizeof w);
    for (uint32_t i = 0; i < count; ++i) {
        uint64_t n = gnn_unet_tensor(net, i, names[i], &w[i].rank, w[i].shape);
        values[i] = new_floats(n);
        gnn_unet_tensor_export(net, NULL, i, values[i]);
        w[i].name = names[i], w[i].values = values[i], w[i].type = GNN_TYPE_F32;
    }
    if (how == 0)
        w[which].name = "other";
    if (how == 1)
        w[which].shape[0] *= 2, w[which].values = new_floats(2 * gnni_tensor_count(net, which));
    if (how == 2)
        values[which][0] = NAN;
    if (how == 3)
        w[which].type = GNN_TYPE_F16, values[which][0] = 1e6f; /* infinite as a half */
    *size = gnn_tensors_bound(w, count, NULL);
    char *file = malloc(*size);
    size_t written;
    assert_int_equal(gnn_tensors_write(w, count, NULL, file, *size, &written), GNN_OK);
    if (how == 1)
        free((float *)(uintptr_t)w[which].values);
    for (uint32_t i = 0; i < count; ++i)
        free(values[i]);
    return file;
}

static void spoiled_weights_are_refused_name_the_tensor_and_change_nothing(void **state)
{
    gnn_unet_desc d = small_desc(3, false);
    gnn_unet *net = make_net(&d);
    float *before = new_floats(gnn_unet_floats(net));
    gnn_message message;
    (void)state;
    memcpy(before, net->weights, gnn_unet_floats(net) * sizeof(float));
    for (uint32_t which = 0; which < gnn_unet_tensors(net); which += 3)
        for (int how = 0; how < 4; ++how) {
            char name[40];
            uint32_t rank;
            uint64_t shape[GNN_MAX_RANK];
            size_t size;
            char *file = spoiled_file(net, which, how, &size);
            gnn_unet_tensor(net, which, name, &rank, shape);
            assert_int_equal(gnn_unet_load(net, file, size, &message), how ? GNN_WRONG_TENSOR : GNN_MISSING_TENSOR);
            assert_non_null(strstr(message.text, name));
            assert_memory_equal(before, net->weights, gnn_unet_floats(net) * sizeof(float));
            free(file);
        }
    assert_int_equal(gnn_unet_load(net, "nothing", 7, &message), GNN_BAD_FILE);
    size_t size; /* what says nothing of its kind, and is not spoiled */
    char *file = spoiled_file(net, 0, -1, &size);
    assert_int_equal(gnn_unet_load(net, file, size, &message), GNN_OK);
    free(file);
    free(before);
    gnn_unet_destroy(net);
}

static gnn_result saved_as(const gnn_unet *net, gnn_type type, const char *const *metadata, char **file, size_t *size)
{
    size_t bound = gnn_unet_bound(net, type, metadata);
    *file = malloc(bound + 1);
    return gnn_unet_save(net, type, metadata, *file, bound, size);
}

static void saves_say_of_which_kind_they_are(void **state)
{
    const char *mine[] = {"gnn_unet", "x", NULL}, *note[] = {"note", "y", NULL};
    gnn_unet_desc d = small_desc(3, false), unmasked = small_desc(3, true);
    gnn_unet *net = make_net(&d), *other = make_net(&unmasked);
    gnn_message message;
    char text[64], *file;
    size_t size;
    (void)state;
    assert_int_equal(saved_as(net, GNN_TYPE_F16, note, &file, &size), GNN_OK);
    assert_true(gnn_tensors_metadata(file, size, "gnn_unet", text, sizeof text));
    assert_string_equal(text, "1 masked inputs=3 levels=3");
    assert_true(gnn_tensors_metadata(file, size, "note", text, sizeof text));
    assert_string_equal(text, "y");
    assert_int_equal(gnn_unet_load(net, file, size, &message), GNN_OK);
    assert_int_equal(gnn_unet_load(other, file, size, &message), GNN_WRONG_TENSOR);
    assert_non_null(strstr(message.text, "kind"));
    free(file);
    assert_int_equal(gnn_unet_bound(net, GNN_TYPE_F16, mine), 0);
    assert_int_equal(saved_as(net, GNN_TYPE_F16, mine, &file, &size), GNN_BAD_RANGE);
    free(file);
    gnn_unet_destroy(net);
    gnn_unet_destroy(other);
}

static void values_that_would_not_load_are_not_saved(void **state)
{
    static const struct {
        float value;
        gnn_result half, full;
    } all[] = {{65519.9f, GNN_OK, GNN_OK},
               {65520.0f, GNN_WRONG_TENSOR, GNN_OK},
               {-1e30f, GNN_WRONG_TENSOR, GNN_OK},
               {INFINITY, GNN_WRONG_TENSOR, GNN_WRONG_TENSOR},
               {NAN, GNN_WRONG_TENSOR, GNN_WRONG_TENSOR}};
    gnn_unet_desc d = small_desc(2, false);
    gnn_unet *net = make_net(&d);
    char *file;
    size_t size;
    (void)state;
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        for (int half = 0; half < 2; ++half) {
            gnn_unet_tensor_import(net, gnn_unet_tensors(net) - 1, &all[i].value);
            gnn_result want = half ? all[i].half : all[i].full;
            assert_int_equal(saved_as(net, half ? GNN_TYPE_F16 : GNN_TYPE_F32, NULL, &file, &size), want);
            if (want == GNN_OK)
                assert_int_equal(gnn_unet_load(net, file, size, NULL), GNN_OK);
            free(file);
        }
    gnn_unet_seed(net, 1);
    net->second[0] = 1e31f; /* finite, but no moment of training */
    assert_int_equal(saved_as(net, GNN_TYPE_F32, NULL, &file, &size), GNN_OK);
    assert_int_equal(gnn_unet_load(net, file, size, NULL), GNN_WRONG_TENSOR);
    free(file);
    gnn_unet_destroy(net);
}

/* ---- learning */

/* Light from a few directions as a map with mean 1: lobes over (z, phi), some narrow, on an even ground. */
static void draw_light(int width, int height, float *map)
{
    int lobes = 1 + (int)(rng_next() % 3);
    double sum = 0, axis[3][3], sharp[3], strong[3];
    for (int k = 0; k < lobes; ++k) {
        double z = 2 * rnd() - 1, phi = 6.283185307 * rnd(), r = sqrt(1 - z * z);
        axis[k][0] = r * cos(phi), axis[k][1] = r * sin(phi), axis[k][2] = z;
        sharp[k] = exp(1 + 3 * rnd());
        strong[k] = sharp[k] * (0.3 + rnd());
    }
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            double z = 2 * (y + 0.5) / height - 1, phi = 6.283185307 * (x + 0.5) / width, r = sqrt(1 - z * z),
                   value = 0.1;
            for (int k = 0; k < lobes; ++k)
                value += strong[k] *
                         exp(sharp[k] * (axis[k][0] * r * cos(phi) + axis[k][1] * r * sin(phi) + axis[k][2] * z - 1));
            map[y * width + x] = (float)value;
            sum += value;
        }
    for (int i = 0; i < width * height; ++i)
        map[i] *= (float)(width * height / sum);
}

/* What `photons` photons say of it: histograms after all and after half of them, counts, and where there are any. */
static void draw_photons(const float *truth, int area, int photons, float *inputs)
{
    double *cdf = naive_new((size_t)area + 1);
    memset(inputs, 0, 5 * (size_t)area * sizeof(float));
    for (int i = 0; i < area; ++i)
        cdf[i + 1] = cdf[i] + (double)truth[i];
    for (int p = 0; p < photons; ++p) {
        double u = rnd() * cdf[area];
        int low = 0, high = area;
        while (high - low > 1) {
            int middle = (low + high) / 2;
            if (cdf[middle] <= u)
                low = middle;
            else
                high = middle;
        }
        inputs[low] += (float)area / (float)photons;
        inputs[2 * area + low] += (float)area / (float)photons;
        if (2 * p < photons) {
            inputs[area + low] += 2 * (float)area / (float)photons;
            inputs[3 * area + low] += 2 * (float)area / (float)photons;
        }
        inputs[4 * area + low] = 1;
    }
    free(cdf);
}

/* Loss of maps that training does not see, by what handing input 0 on would give. */
static double held_out(const gnn_unet *net, const float *inputs, const float *truths, uint32_t maps, workspace *space)
{
    gnn_unet_desc d = gnn_unet_get_desc(net);
    size_t area = (size_t)d.width * d.height;
    float *outputs = new_floats(maps * area);
    double loss = 0, plain = 0;
    assert_int_equal(gnn_unet_forward(net, inputs, maps, outputs, start(space), space->size, NULL, NULL), GNN_OK);
    for (uint32_t m = 0; m < maps; ++m) {
        const float *input = inputs + m * d.inputs * area;
        loss += gnn_loss(outputs + m * area, input, truths + m * area, area, 1, 1, NULL);
        plain += gnn_loss(input, input, truths + m * area, area, 1, 1, NULL);
    }
    free(outputs);
    return loss / plain;
}

static void training_repairs_histograms_it_has_not_seen(void **state)
{
    enum { BATCH = 16, STEPS = 150, HELD = 64, WIDTH = 32, HEIGHT = 16, AREA = WIDTH * HEIGHT };
    gnn_unet_desc d;
    (void)state;
    memset(&d, 0, sizeof d);
    d.width = WIDTH, d.height = HEIGHT;
    d.training = true;
    d.rate = 0.005f;
    gnn_unet *net = make_net(&d);
    float *inputs = new_floats(BATCH * 5 * AREA), *truths = new_floats(BATCH * AREA);
    float *held_inputs = new_floats(HELD * 5 * AREA), *held_truths = new_floats(HELD * AREA);
    workspace space = make_workspace(net, BATCH, true);
    gnn_step step;
    seed(77);
    for (int m = 0; m < HELD; ++m) {
        draw_light(WIDTH, HEIGHT, held_truths + m * AREA);
        draw_photons(held_truths + m * AREA, AREA, 200 + (int)(rng_next() % 400), held_inputs + m * 5 * AREA);
    }
    double before = held_out(net, held_inputs, held_truths, HELD, &space);
    for (int i = 0; i < STEPS; ++i) {
        for (int m = 0; m < BATCH; ++m) {
            draw_light(WIDTH, HEIGHT, truths + m * AREA);
            draw_photons(truths + m * AREA, AREA, 200 + (int)(rng_next() % 400), inputs + m * 5 * AREA);
        }
        gnn_unet_set_rate(net, i < STEPS * 2 / 3 ? 0.005f : 0.001f);
        assert_int_equal(gnn_unet_train(net, inputs, truths, BATCH, &step, start(&space), space.size, NULL, NULL),
                         GNN_OK);
        assert_int_equal(step.maps, BATCH);
    }
    double after = held_out(net, held_inputs, held_truths, HELD, &space);
    BELOW(fabs(before - 1), 0.2); /* a fresh network hands input 0 on */
    BELOW(after, 0.7);
    free(inputs), free(truths), free(held_inputs), free(held_truths), free(space.memory);
    gnn_unet_destroy(net);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(network_and_gradients_are_their_definition),
        cmocka_unit_test(results_do_not_depend_on_threads_and_groups),
        cmocka_unit_test(levels_of_simd_agree),
        cmocka_unit_test(bad_values_stay_in_their_map),
        cmocka_unit_test(huge_derivatives_are_left_out_of_training),
        cmocka_unit_test(empty_full_and_one_bin_maps_give_finite_output),
        cmocka_unit_test(small_workspaces_and_bad_descriptors_are_refused),
        cmocka_unit_test(training_needs_a_network_for_it),
        cmocka_unit_test(sizes_stay_below_the_bound_and_do_not_wrap),
        cmocka_unit_test(failed_allocations_are_told_and_nothing_leaks),
        cmocka_unit_test(saved_training_goes_on_as_if_it_had_not_stopped),
        cmocka_unit_test(spoiled_weights_are_refused_name_the_tensor_and_change_nothing),
        cmocka_unit_test(saves_say_of_which_kind_they_are),
        cmocka_unit_test(values_that_would_not_load_are_not_saved),
        cmocka_unit_test(training_repairs_histograms_it_has_not_seen),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
