/* bench_nn: what the layers and the U-Net of guide_nn.h cost.

     build/bench_nn [--quick] [--json FILE]

   Each layer is checked against a naive reference in double precision before it is timed. Limits are the peak rate of
   fused multiply-adds that this run measures, at the width of the level: 8 floats a vector, or 16. Operations are
   counted as the definition has them (2 for each weight and pixel), so that a kernel that needs fewer can lie above.
   Where oneDNN 2 is there (Debian: libdnnl-dev, or DNNL_DIR names it) its times for the benchmark network stand beside
   ours, and the goal is 0.7 of its better one. */
#define GNN_IMPLEMENTATION
#include "guide_nn.h"

#include "bench.h"

#include "../tests/nn_naive.h"

#ifdef BENCH_DNNL
#include "peer_dnnl.h"
#endif

static int repeats = 40;
static FILE *json_file;
static int json_rows;
static double peak; /* GFLOP/s of the level in use */
static gnn_simd level;
static const char *level_name;

static void fail(const char *what)
{
    fprintf(stderr, "bench_nn: %s\n", what);
    exit(1);
}

static void check(gnn_result result, const char *what)
{
    if (result) {
        fprintf(stderr, "bench_nn: %s: %s\n", what, gnn_result_string(result));
        exit(1);
    }
}

static float *new_floats(size_t count)
{
    float *p = aligned_alloc(64, (count * sizeof *p + 127) / 64 * 64);
    if (!p)
        fail("out of memory");
    memset(p, 0, count * sizeof *p);
    return p;
}

static float *random_floats(size_t count, uint64_t seed)
{
    float *p = new_floats(count);
    for (size_t i = 0; i < count; ++i)
        p[i] = (float)(bench_random(&seed) >> 40) * 0x1p-23f - 1;
    return p;
}

/* time in ns for `operations`; naive in ns, 0 = none; target in ms, 0 = none. */
static void row(const char *name, bench_time t, double operations, double naive, double target)
{
    double rate = operations / t.min, limit = peak > 0 ? operations / peak : 0;
    printf("%-44s %9.1f %9.1f %5.0f%% %8.1f %8.1f %6.2f", name, t.min * 1e-3, t.median * 1e-3, 100 * t.spread,
           limit * 1e-3, rate, peak > 0 ? rate / peak : 0);
    if (naive > 0)
        printf(" %9.0f %6.0fx", naive * 1e-3, naive / t.min);
    else
        printf(" %9s %7s", "-", "-");
    if (target > 0)
        printf("   <= %.2f ms %s", target, t.min * 1e-6 <= target ? "reached" : "missed");
    printf("\n");
    if (json_file)
        fprintf(json_file,
                "%s\n  {\"name\": \"%s\", \"simd\": \"%s\", \"ns\": %.1f, \"median_ns\": %.1f, \"spread\": %.3f, "
                "\"limit_ns\": %.1f, "
                "\"naive_ns\": %.0f, \"target_ns\": %.0f}",
                json_rows++ ? "," : "", name, level_name, t.min, t.median, t.spread, limit, naive, target * 1e6);
}

static void row_titles(const char *what)
{
    printf("\n%-44s %9s %9s %6s %8s %8s %6s %9s %7s   target\n", what, "min us", "median", "spread", "limit", "GFLOP/s",
           "peak", "naive us", "faster");
}

/* ---- one convolution ---------------------------------------------------------------------------------------- */

typedef struct shape {
    uint32_t width, height, up, in, out;
} shape;

typedef struct layer {
    gnn_conv conv;
    gnn_conv_maps maps;
    float *up, *in, *out, *weights, *prepared, *scratch, *kernel, *bias, *up_planes, *in_planes;
} layer;

static layer make_layer(const shape *s)
{
    layer l;
    gnn_conv *c = &l.conv;
    memset(&l, 0, sizeof l);
    c->width = s->width, c->height = s->height, c->up = s->up, c->in = s->in, c->out = s->out;
    c->up_stride = gnn_stride(s->up), c->in_stride = gnn_stride(s->in), c->out_stride = gnn_stride(s->out);
    c->simd = level;
    check(gnn_conv_check(c), "shape");
    l.kernel = random_floats((size_t)s->out * (s->up + s->in) * 9, 1);
    l.bias = random_floats(s->out, 2);
    l.up_planes = random_floats((size_t)s->up * s->width * s->height / 4, 3);
    l.in_planes = random_floats((size_t)s->in * s->width * s->height, 4);
    l.up = new_floats(gnn_map_floats(s->width / 2, s->height / 2, c->up_stride));
    l.in = new_floats(gnn_map_floats(s->width, s->height, c->in_stride));
    l.out = new_floats(gnn_map_floats(s->width, s->height, c->out_stride));
    l.weights = new_floats(gnn_conv_weights(c));
    l.prepared = new_floats(gnn_conv_prepared(c));
    l.scratch = new_floats(gnn_conv_scratch(c));
    gnn_conv_import(c, l.kernel, l.bias, l.weights);
    gnn_conv_prepare(c, l.weights, l.prepared);
    if (s->up)
        gnn_map_from_planes(l.up_planes, s->width / 2, s->height / 2, s->up, c->up_stride, l.up);
    gnn_map_from_planes(l.in_planes, s->width, s->height, s->in, c->in_stride, l.in);
    l.maps.up = s->up ? l.up : NULL;
    l.maps.in = l.in;
    l.maps.out = l.out;
    return l;
}

static void free_layer(layer *l)
{
    float *all[] = {l->up,      l->in,     l->out,  l->weights,   l->prepared,
                    l->scratch, l->kernel, l->bias, l->up_planes, l->in_planes};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
}

static double *doubles(const float *from, size_t count)
{
    double *to = naive_new(count);
    for (size_t i = 0; i < count; ++i)
        to[i] = (double)from[i];
    return to;
}

/* Checks the layer's output; returns the reference's time in ns. */
static double validate(const layer *l)
{
    const gnn_conv *c = &l->conv;
    int w = (int)c->width, h = (int)c->height, channels = (int)(c->up + c->in);
    size_t area = (size_t)c->width * c->height, n = area * c->out;
    double *in = doubles(l->in_planes, area * c->in), *up = doubles(l->up_planes, area / 4 * c->up);
    double *all = naive_new(area * (size_t)channels),
           *kernel = doubles(l->kernel, (size_t)c->out * (c->up + c->in) * 9);
    double *bias = doubles(l->bias, c->out), *want = naive_new(n), worst = 0, square = 0, took = bench_seconds();
    float *got = new_floats(n);
    naive_upsample(up, (int)c->up, w / 2, h / 2, all);
    memcpy(all + area * c->up, in, area * c->in * sizeof *in);
    naive_conv(all, channels, w, h, kernel, bias, NULL, NULL, 0, (int)c->out, want);
    took = bench_seconds() - took;
    gnn_conv_forward(c, l->weights, l->prepared, &l->maps, l->scratch);
    gnn_map_to_planes(l->out, c->width, c->height, c->out, c->out_stride, got);
    for (size_t i = 0; i < n; ++i) {
        double e = fabs((double)got[i] - want[i]);
        worst = e > worst || e != e ? e : worst;
        square += want[i] * want[i];
    }
    if (!(worst <= 5e-5 * sqrt(square / (double)n)))
        fail("a convolution is not what its definition says");
    free(in), free(up), free(all), free(kernel), free(bias), free(want), free(got);
    return took * 1e9;
}

static void bench_layer(const shape *s)
{
    layer l = make_layer(s);
    char name[80], text[40] = "";
    bench_time t;
    double operations = 18.0 * s->width * s->height * (s->up + s->in) * s->out, naive = validate(&l);
    int times = 1 + (int)(2e6 / operations);
    if (s->up)
        snprintf(text, sizeof text, "%u upsampled + ", s->up);
    snprintf(name, sizeof name, "convolution %ux%u, %s%u -> %u", s->height, s->width, text, s->in, s->out);
    BENCH_TIME(t, repeats, times, {
        for (int i = 0; i < times; ++i)
            gnn_conv_forward(&l.conv, l.weights, l.prepared, &l.maps, l.scratch);
        bench_use(l.out);
    });
    row(name, t, operations, naive, 0);
    if (s->in % 8 == 0) {
        float *dout = random_floats(gnn_map_floats(s->width, s->height, l.conv.out_stride), 6);
        float *din = new_floats(gnn_map_floats(s->width, s->height, l.conv.in_stride));
        float *dup = new_floats(gnn_map_floats(s->width / 2, s->height / 2, l.conv.up_stride));
        float *dweights = new_floats(gnn_conv_weights(&l.conv));
        BENCH_TIME(t, repeats, times, {
            for (int i = 0; i < times; ++i)
                gnn_conv_backward(&l.conv, l.prepared, &l.maps, dout, s->up ? dup : NULL, din, NULL, dweights,
                                  l.scratch);
            bench_use(dweights);
        });
        row("  its gradients", t, 2 * operations, 0, 0);
        free(dout), free(din), free(dup), free(dweights);
    }
    free_layer(&l);
}

/* ---- networks ----------------------------------------------------------------------------------------------- */

/* target in ms a map, 0 = none. Returns the ns of a map. */
static double bench_net(const char *name, const uint32_t *channels, uint32_t levels, double target)
{
    enum { MAPS = 8 };
    gnn_unet_desc d;
    gnn_unet *net;
    bench_time t;
    char text[80];
    memset(&d, 0, sizeof d);
    d.levels = levels;
    for (uint32_t l = 0; l < levels; ++l)
        d.channels[l] = channels[l];
    d.training = true;
    d.simd = level;
    check(gnn_unet_create(&d, &net), "network");
    d = gnn_unet_get_desc(net);
    size_t area = (size_t)d.width * d.height, size = gnn_unet_workspace(net, 1, true);
    float *inputs = random_floats(MAPS * d.inputs * area, 5), *outputs = new_floats(MAPS * area);
    void *workspace = new_floats(size / sizeof(float));
    gnn_step step;
    snprintf(text, sizeof text, "%s, %.0f MFLOP, %llu weights", name, gnn_unet_operations(net) * 1e-6,
             (unsigned long long)gnn_unet_parameters(net));
    BENCH_TIME(t, repeats, MAPS, {
        check(gnn_unet_forward(net, inputs, MAPS, outputs, workspace, size, NULL, NULL), "forward");
        bench_use(outputs);
    });
    row(text, t, gnn_unet_operations(net), 0, target);
    double forward = t.min;
    BENCH_TIME(t, repeats / 4 + 1, MAPS, {
        check(gnn_unet_train(net, inputs, outputs, MAPS, &step, workspace, size, NULL, NULL), "train");
        bench_use(&step);
    });
    row("  a step of training, per map of 8", t, 3 * gnn_unet_operations(net), 0, 0);
    free(inputs), free(outputs), free(workspace);
    gnn_unet_destroy(net);
    return forward;
}

#ifdef BENCH_DNNL
static bool peer_alone; /* oneDNN has one thread: there is something to compare */
#endif

/* The same network by oneDNN: the ns of the better of its two ways; 0 = not built, or not comparable. */
static double bench_peer(const uint32_t *channels, int levels, double operations)
{
    double best = 0;
#ifdef BENCH_DNNL
    for (int winograd = 0; peer_alone && winograd < 2; ++winograd) {
        static peer p;
        bench_time t;
        char name[80];
        peer_create(&p, 64, 32, 5, channels, levels, winograd);
        if (!peer_works(&p))
            fail("oneDNN's network does not depend on its input");
        if (winograd && !p.winograds) {
            printf("%-44s none of the layers on this machine\n", "  oneDNN, Winograd");
            peer_destroy(&p);
            continue;
        }
        BENCH_TIME(t, repeats, 8, {
            for (int i = 0; i < 8; ++i)
                peer_run(&p);
        });
        snprintf(name, sizeof name, "  oneDNN %d.%d, direct", dnnl_version()->major, dnnl_version()->minor);
        if (winograd)
            snprintf(name, sizeof name, "  oneDNN, Winograd (%d layers)", p.winograds);
        row(name, t, operations, 0, 0);
        best = best == 0 || t.min < best ? t.min : best;
        peer_destroy(&p);
    }
#else
    (void)channels, (void)levels, (void)operations;
    printf("%-44s not built\n", "  oneDNN");
#endif
    return best;
}

/* Ours between two runs of the peer, so that both see the same machine. */
static void bench_against_peer(const uint32_t *channels)
{
    enum { LEVELS = 4 };
    double theirs = bench_peer(channels, LEVELS, 168e6);
    double ours =
        bench_net("U-Net 5 -> 16-32-64-128 -> 1 on 32x64", channels, LEVELS, theirs > 0 ? 0.7e-6 * theirs : 0.69);
    if (theirs == 0)
        return;
    double again = bench_peer(channels, LEVELS, 168e6);
    theirs = again < theirs ? again : theirs;
    printf("%-44s %9.2f   <= 0.70 %s\n", "  ours / oneDNN's best", ours / theirs,
           ours <= 0.7 * theirs ? "reached" : "missed");
}

int main(int argc, char **argv)
{
    static const shape shapes[] = {{64, 32, 0, 5, 16},   {64, 32, 0, 16, 16},  {32, 16, 0, 32, 32},
                                   {16, 8, 0, 64, 64},   {8, 4, 0, 128, 128},  {64, 32, 32, 16, 16},
                                   {32, 16, 64, 32, 32}, {16, 8, 128, 64, 64}, {64, 32, 0, 8, 8}};
    static const uint32_t benchmark[] = {16, 32, 64, 128}, quarter[] = {8, 16, 32, 64}, small[] = {8, 16, 32};
    static const gnn_simd all[] = {GNN_SIMD_AVX512, GNN_SIMD_AVX2, GNN_SIMD_NEON, GNN_SIMD_SCALAR};
    static const char *const names[] = {"AVX-512", "AVX2", "NEON", "no SIMD"};
#ifdef BENCH_DNNL
    peer_alone = peer_one_thread(argv);
#endif
    for (int i = 1; i < argc; ++i)
        if (!strcmp(argv[i], "--quick"))
            repeats = 4;
        else if (!strcmp(argv[i], "--json") && i + 1 < argc) {
            if (!(json_file = fopen(argv[++i], "w")))
                fail("cannot write the JSON file");
        } else
            fail("unknown option, or its value is missing; the first lines of bench_nn.c list them");
    bench_limits limits = bench_print_machine(json_file);
    for (int i = 0; i < 4; ++i) {
        if (gnn_resolve_simd(all[i]) != all[i])
            continue;
        char what[80];
        level = all[i];
        level_name = names[i];
        peak = level == GNN_SIMD_AVX512 ? limits.fma_512 : limits.fma;
        snprintf(what, sizeof what, "%s, FMA peak %.0f GFLOP/s", level_name, peak);
        row_titles(what);
        bool best = level == gnn_resolve_simd(GNN_SIMD_AUTO);
        for (size_t s = 0; best && s < sizeof shapes / sizeof *shapes; ++s)
            bench_layer(&shapes[s]);
        if (!best)
            bench_net("U-Net 5 -> 16-32-64-128 -> 1 on 32x64", benchmark, 4, 0);
        if (best) {
            bench_against_peer(benchmark);
            bench_net("U-Net 8-16-32-64", quarter, 4, 0.15);
            bench_net("U-Net 8-16-32 (default)", small, 3, 0.15);
        }
    }
    if (json_file) {
        fprintf(json_file, "\n]}\n");
        fclose(json_file);
    }
    return 0;
}
