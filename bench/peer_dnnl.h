/* peer_dnnl.h: the U-Net of bench_nn by Intel's oneDNN 2, a peer to measure against. Less work than ours: zeros beyond
   the borders, no masks, no residual links; weights are arbitrary. One map, one thread. */
#ifndef BENCH_PEER_DNNL_H
#define BENCH_PEER_DNNL_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <oneapi/dnnl/dnnl.h>

enum { PEER_MOST = 128 };

typedef struct peer_tensor {
    dnnl_memory_desc_t md;
    dnnl_memory_t memory;
} peer_tensor;

typedef struct peer {
    dnnl_engine_t engine;
    dnnl_stream_t stream;
    dnnl_primitive_t steps[PEER_MOST];
    dnnl_exec_arg_t arguments[PEER_MOST][4];
    int argument_counts[PEER_MOST], count;
    dnnl_memory_t memories[PEER_MOST];
    int memory_count;
    bool winograd; /* where oneDNN has it for the shape */
    int winograds; /* convolutions done so */
    peer_tensor input, output;
} peer;

static void peer_check(dnnl_status_t status, const char *what)
{
    if (status != dnnl_success) {
        fprintf(stderr, "bench_nn: oneDNN: %s: status %d\n", what, (int)status);
        exit(1);
    }
}

/* oneDNN asks OpenMP for its threads when it is loaded: begin again with one. False = that cannot be: timings of it
   would be of several threads. */
static bool peer_one_thread(char **argv)
{
    const char *threads = getenv("OMP_NUM_THREADS");
    if (threads && !strcmp(threads, "1"))
        return true;
    setenv("OMP_NUM_THREADS", "1", 1);
    execv("/proc/self/exe", argv);
    fprintf(stderr, "bench_nn: cannot begin again with OMP_NUM_THREADS=1: set it to compare with oneDNN\n");
    return false;
}

static dnnl_memory_desc_t peer_desc(int n, int c, int h, int w, dnnl_format_tag_t tag)
{
    dnnl_dims_t dims = {n, c, h, w};
    dnnl_memory_desc_t md;
    peer_check(dnnl_memory_desc_init_by_tag(&md, 4, dims, dnnl_f32, tag), "descriptor");
    return md;
}

/* Memory of a tensor with small numbers in it. */
static peer_tensor peer_new(peer *p, const dnnl_memory_desc_t *md)
{
    peer_tensor t = {*md, NULL};
    void *data;
    peer_check(dnnl_memory_create(&t.memory, md, p->engine, DNNL_MEMORY_ALLOCATE), "memory");
    peer_check(dnnl_memory_get_data_handle(t.memory, &data), "memory");
    for (size_t i = 0; i < dnnl_memory_desc_get_size(md) / sizeof(float); ++i)
        ((float *)data)[i] = (float)(i * 2654435761u % 1000u) * 2e-5f - 0.005f;
    p->memories[p->memory_count++] = t.memory;
    return t;
}

static void peer_step(peer *p, dnnl_primitive_desc_t pd, int count, const dnnl_exec_arg_t *arguments)
{
    peer_check(dnnl_primitive_create(&p->steps[p->count], pd), "primitive");
    peer_check(dnnl_primitive_desc_destroy(pd), "primitive");
    for (int i = 0; i < count; ++i)
        p->arguments[p->count][i] = arguments[i];
    p->argument_counts[p->count++] = count;
}

static peer_tensor peer_out(peer *p, const_dnnl_primitive_desc_t pd)
{
    return peer_new(p, dnnl_primitive_desc_query_md(pd, dnnl_query_dst_md, 0));
}

/* The tensor in the layout that a primitive wants. */
static peer_tensor peer_reordered(peer *p, peer_tensor from, const dnnl_memory_desc_t *wanted)
{
    dnnl_primitive_desc_t pd;
    peer_tensor to;
    if (dnnl_memory_desc_equal(&from.md, wanted))
        return from;
    to = peer_new(p, wanted);
    peer_check(dnnl_reorder_primitive_desc_create(&pd, &from.md, p->engine, &to.md, p->engine, NULL), "reorder");
    dnnl_exec_arg_t a[] = {{DNNL_ARG_FROM, from.memory}, {DNNL_ARG_TO, to.memory}};
    peer_step(p, pd, 2, a);
    return to;
}

/* side x side convolution, then relu. */
static peer_tensor peer_conv(peer *p, peer_tensor in, int out, int side, bool relu)
{
    int c = (int)in.md.dims[1], h = (int)in.md.dims[2], w = (int)in.md.dims[3];
    dnnl_memory_desc_t src = peer_desc(1, c, h, w, dnnl_format_tag_any),
                       dst = peer_desc(1, out, h, w, dnnl_format_tag_any);
    dnnl_memory_desc_t weights = peer_desc(out, c, side, side, dnnl_format_tag_any), bias;
    dnnl_dims_t strides = {1, 1}, padding = {side / 2, side / 2}, outs = {out};
    dnnl_primitive_attr_t attr;
    dnnl_post_ops_t post;
    dnnl_convolution_desc_t d;
    dnnl_primitive_desc_t pd = NULL;
    peer_check(dnnl_memory_desc_init_by_tag(&bias, 1, outs, dnnl_f32, dnnl_x), "bias");
    peer_check(dnnl_primitive_attr_create(&attr), "attributes");
    peer_check(dnnl_post_ops_create(&post), "attributes");
    if (relu)
        peer_check(dnnl_post_ops_append_eltwise(post, 1, dnnl_eltwise_relu, 0, 0), "relu");
    peer_check(dnnl_primitive_attr_set_post_ops(attr, post), "relu");
    for (int direct = !p->winograd; direct < 2 && !pd; ++direct) {
        peer_check(dnnl_convolution_forward_desc_init(&d, dnnl_forward_inference,
                                                      direct ? dnnl_convolution_direct : dnnl_convolution_winograd,
                                                      &src, &weights, &bias, &dst, strides, padding, padding),
                   "convolution");
        if (dnnl_primitive_desc_create(&pd, &d, attr, p->engine, NULL) != dnnl_success)
            pd = NULL;
        p->winograds += pd && !direct;
    }
    peer_check(pd ? dnnl_success : dnnl_unimplemented, "convolution");
    in = peer_reordered(p, in, dnnl_primitive_desc_query_md(pd, dnnl_query_src_md, 0));
    peer_tensor k = peer_new(p, dnnl_primitive_desc_query_md(pd, dnnl_query_weights_md, 0));
    peer_tensor b = peer_new(p, &bias), to = peer_out(p, pd);
    dnnl_exec_arg_t a[] = {
        {DNNL_ARG_SRC, in.memory}, {DNNL_ARG_WEIGHTS, k.memory}, {DNNL_ARG_BIAS, b.memory}, {DNNL_ARG_DST, to.memory}};
    peer_step(p, pd, 4, a);
    dnnl_post_ops_destroy(post);
    dnnl_primitive_attr_destroy(attr);
    return to;
}

static peer_tensor peer_pool(peer *p, peer_tensor in)
{
    dnnl_memory_desc_t dst =
        peer_desc(1, (int)in.md.dims[1], (int)in.md.dims[2] / 2, (int)in.md.dims[3] / 2, dnnl_format_tag_any);
    dnnl_dims_t two = {2, 2}, none = {0, 0};
    dnnl_pooling_desc_t d;
    dnnl_primitive_desc_t pd;
    peer_check(dnnl_pooling_forward_desc_init(&d, dnnl_forward_inference, dnnl_pooling_avg, &in.md, &dst, two, two,
                                              none, none),
               "pooling");
    peer_check(dnnl_primitive_desc_create(&pd, &d, NULL, p->engine, NULL), "pooling");
    peer_tensor to = peer_out(p, pd);
    dnnl_exec_arg_t a[] = {{DNNL_ARG_SRC, in.memory}, {DNNL_ARG_DST, to.memory}};
    peer_step(p, pd, 2, a);
    return to;
}

/* The small map upsampled, then the large one behind it. */
static peer_tensor peer_join(peer *p, peer_tensor small, peer_tensor large)
{
    float factors[] = {2, 2};
    dnnl_resampling_desc_t d;
    dnnl_primitive_desc_t pd;
    dnnl_memory_desc_t dst =
        peer_desc(1, (int)small.md.dims[1], (int)large.md.dims[2], (int)large.md.dims[3], dnnl_format_tag_any);
    peer_check(dnnl_resampling_forward_desc_init(&d, dnnl_forward_inference, dnnl_resampling_nearest, factors,
                                                 &small.md, &dst),
               "resampling");
    peer_check(dnnl_primitive_desc_create(&pd, &d, NULL, p->engine, NULL), "resampling");
    peer_tensor up = peer_out(p, pd);
    dnnl_exec_arg_t a[] = {{DNNL_ARG_SRC, small.memory}, {DNNL_ARG_DST, up.memory}};
    peer_step(p, pd, 2, a);
    dnnl_memory_desc_t both[] = {up.md, large.md};
    peer_check(dnnl_concat_primitive_desc_create(&pd, NULL, 2, 1, both, NULL, p->engine), "concatenation");
    peer_tensor to = peer_out(p, pd);
    dnnl_exec_arg_t c[] = {
        {DNNL_ARG_MULTIPLE_SRC, up.memory}, {DNNL_ARG_MULTIPLE_SRC + 1, large.memory}, {DNNL_ARG_DST, to.memory}};
    peer_step(p, pd, 3, c);
    return to;
}

static void peer_create(peer *p, int width, int height, int inputs, const uint32_t *channels, int levels, bool winograd)
{
    peer_tensor x, level[8];
    dnnl_memory_desc_t plain = peer_desc(1, inputs, height, width, dnnl_nchw);
    memset(p, 0, sizeof *p);
    p->winograd = winograd;
    peer_check(dnnl_engine_create(&p->engine, dnnl_cpu, 0), "engine");
    peer_check(dnnl_stream_create(&p->stream, p->engine, dnnl_stream_default_flags), "stream");
    x = p->input = peer_new(p, &plain);
    for (int l = 0; l < levels; ++l) {
        x = l ? peer_pool(p, x) : x;
        x = peer_conv(p, x, (int)channels[l], 3, true);
        x = level[l] = peer_conv(p, x, (int)channels[l], 3, true);
    }
    for (int l = levels - 2; l >= 0; --l) {
        x = peer_conv(p, peer_join(p, x, level[l]), (int)channels[l], 3, true);
        x = peer_conv(p, x, (int)channels[l], 3, true);
    }
    plain = peer_desc(1, 1, height, width, dnnl_nchw);
    p->output = peer_reordered(p, peer_conv(p, x, 1, 1, false), &plain);
}

static void peer_run(const peer *p)
{
    for (int i = 0; i < p->count; ++i)
        peer_check(dnnl_primitive_execute(p->steps[i], p->stream, p->argument_counts[i], p->arguments[i]), "execution");
    peer_check(dnnl_stream_wait(p->stream), "execution");
}

/* Does the output exist, and depend on the input? */
static bool peer_works(const peer *p)
{
    void *in, *out;
    float before;
    peer_check(dnnl_memory_get_data_handle(p->input.memory, &in), "memory");
    peer_check(dnnl_memory_get_data_handle(p->output.memory, &out), "memory");
    peer_run(p);
    before = ((float *)out)[100];
    ((float *)in)[100] += 10;
    peer_run(p);
    return isfinite(before) && isfinite(((float *)out)[100]) && before != ((float *)out)[100];
}

static void peer_destroy(peer *p)
{
    for (int i = 0; i < p->count; ++i)
        dnnl_primitive_destroy(p->steps[i]);
    for (int i = 0; i < p->memory_count; ++i)
        dnnl_memory_destroy(p->memories[i]);
    dnnl_stream_destroy(p->stream);
    dnnl_engine_destroy(p->engine);
}

#endif
