/* bench_kd: what the kd-tree's queries and learning cost. (How well it learns: bench_field.)

     build/bench_kd [--quick] [--json FILE]

   Densities are checked against a double-precision mixture before they are timed, and printed as a ratio to it and to a
   limit that this run measured. */
#define GKD_IMPLEMENTATION
#include "guide_kd.h"

#include "bench.h"
#include "sf1.h"

#define LOBES 8
#define MIXTURES 256
#define DIRECTIONS 4096
#define QUERY_LINES 20 /* cache lines that a query or a sample touches: tree, cell, lobes, handle */
#define LOBE_FMAS                                                                                                      \
    12 /* multiply-adds that a lobe's density takes at least: 4 for the exponent, 7 for exp2, 1 to add up */

static int repeats = 12;

static void fail(const char *what)
{
    fprintf(stderr, "bench_kd: %s\n", what);
    exit(1);
}

static void check(gkd_result result, const char *what)
{
    if (result) {
        fprintf(stderr, "bench_kd: %s: %s\n", what, gkd_result_string(result));
        exit(1);
    }
}

static void *allocate(size_t count, size_t size)
{
    void *p = calloc(count, size);
    if (!p)
        fail("out of memory");
    return p;
}

/* ---- mixtures ----------------------------------------------------------------------------------------------- */

/* As the definition has it: weight kappa / (2 pi (1 - exp(-2 kappa))) exp(kappa (mean . w - 1)). */
static double naive_pdf(const gkd_lobe *lobes, double uniform, const float *w)
{
    double sum = 0;
    for (int k = 0; k < LOBES; ++k) {
        double dx = (double)w[0] - (double)lobes[k].mean[0], dy = (double)w[1] - (double)lobes[k].mean[1];
        double dz = (double)w[2] - (double)lobes[k].mean[2], kappa = (double)lobes[k].kappa;
        sum += (double)lobes[k].weight * kappa / (2 * SF1_PI * (1 - exp(-2 * kappa))) *
               exp(-0.5 * kappa * (dx * dx + dy * dy + dz * dz));
    }
    return (1 - uniform) * sum + uniform / (4 * SF1_PI);
}

typedef struct mixtures {
    gkd_lobe lobes[MIXTURES][LOBES];
    gkd_handle handles[MIXTURES], spread[DIRECTIONS]; /* spread: a handle for each direction */
    float directions[DIRECTIONS][3], pdf[DIRECTIONS];
} mixtures;

static void make_mixtures(mixtures *m)
{
    static const float here[3] = {0, 0, 0};
    uint64_t seed = 7;
    for (int i = 0; i < MIXTURES; ++i) {
        for (int k = 0; k < LOBES; ++k) {
            gkd_lobe *l = &m->lobes[i][k];
            bench_direction(&seed, l->mean);
            l->kappa = (float)exp(log(1e3) * bench_unit(&seed));
            l->weight = 1.0f / LOBES;
            l->nearness = 0;
        }
        m->handles[i].uniform = 0.01f;
        gkd_orient_lobes(&m->handles[i], m->lobes[i], LOBES, here, here, NULL);
    }
    for (int i = 0; i < DIRECTIONS; ++i) {
        bench_direction(&seed, m->directions[i]);
        gkd_copy_handle(&m->spread[i], &m->handles[i % MIXTURES]);
    }
}

static void validate_mixtures(const gkd_view *view, mixtures *m)
{
    double worst = 0;
    for (int same = 0; same < 2; ++same) {
        if (same)
            gkd_pdf_directions(view, &m->handles[3], DIRECTIONS, m->directions[0], sizeof m->directions[0], m->pdf);
        else
            gkd_pdf_batch(view, DIRECTIONS, NULL, m->spread, m->directions[0], sizeof m->directions[0], m->pdf);
        for (int i = 0; i < DIRECTIONS; ++i) {
            double p = naive_pdf(m->lobes[same ? 3 : i % MIXTURES], 0.01, m->directions[i]);
            worst = fmax(worst, fabs((double)m->pdf[i] - p) / p);
        }
    }
    printf("\nmixtures of %d lobes, checked: within %.1e of double precision\n", LOBES, worst);
    if (worst > 1e-5)
        fail("densities do not agree with double precision");
}

static void bench_mixtures(const gkd_view *view)
{
    mixtures *m = allocate(1, sizeof *m);
    double naive, limit = LOBES * LOBE_FMAS * 2 / bench_fma_peak();
    bench_time same, random;
    make_mixtures(m);
    validate_mixtures(view, m);
    BENCH_MIN_NS(naive, 5, DIRECTIONS, {
        double sum = 0;
        for (int i = 0; i < DIRECTIONS; ++i)
            sum += naive_pdf(m->lobes[i % MIXTURES], 0.01, m->directions[i]);
        bench_use(&sum);
    });
    BENCH_TIME(same, repeats, DIRECTIONS, {
        gkd_pdf_directions(view, &m->handles[3], DIRECTIONS, m->directions[0], sizeof m->directions[0], m->pdf);
        bench_use(m->pdf);
    });
    BENCH_TIME(random, repeats, DIRECTIONS, {
        gkd_pdf_batch(view, DIRECTIONS, NULL, m->spread, m->directions[0], sizeof m->directions[0], m->pdf);
        bench_use(m->pdf);
    });
    bench_row_titles("ns per density");
    bench_row("pdf of one mixture of 8 lobes", same, limit, naive, 1.5);
    bench_row("pdf of random mixtures of 8 lobes", random, limit, naive, 4);
    free(m);
}

/* ---- a learned field ---------------------------------------------------------------------------------------- */

static gkd_training_sample to_training(const sf1_sample *s, const gkd_view *view)
{
    float bsdf = s->cosine * (float)(1 / SF1_PI), contribution = s->radiance * bsdf;
    gkd_handle h;
    gkd_find(view, s->position, s->normal, NULL, &h); /* a renderer knows the guide's density where it guides */
    return gkd_make_scalar_sample(s->position, s->direction, s->normal, s->distance, s->radiance, contribution,
                                  contribution, s->pdf, bsdf, h.alpha < 1 ? gkd_pdf(&h, s->direction) : 0);
}

/* Learn SF1 from about 2^log2n samples in SF1_UPDATES equal updates; adds up the seconds and the samples. */
static gkd_field *learn(const gkd_desc *desc, int log2n, uint64_t seed, double *seconds, double *samples)
{
    gkd_field *field;
    gkd_stream *stream;
    uint32_t n = (1u << log2n) / SF1_UPDATES;
    gkd_training_sample *batch = allocate(n, sizeof *batch);
    sf1_rng rng = {seed};
    *seconds = *samples = 0;
    check(gkd_create(desc, &field), "create");
    check(gkd_stream_create(field, &stream), "stream");
    for (int update = 0; update < SF1_UPDATES; ++update) {
        gkd_view view = gkd_get_view(field);
        uint32_t count = 0;
        sf1_sample s;
        for (uint32_t i = 0; i < n; ++i)
            if (sf1_draw(&sf1_default, &rng, update, 0, &s))
                batch[count++] = to_training(&s, &view);
        double start = bench_seconds();
        for (uint32_t i = 0; i < count; i += 64)
            check(gkd_record(stream, batch + i, count - i < 64 ? count - i : 64), "record");
        check(gkd_accumulate(field, &stream, 1, NULL, NULL), "accumulate");
        gkd_stream_clear(stream);
        check(gkd_refine(field, NULL, NULL, NULL), "refine");
        *seconds += bench_seconds() - start;
        *samples += count;
    }
    gkd_stream_destroy(stream);
    free(batch);
    return field;
}

static bench_time time_learning(const gkd_desc *desc, int log2n, int times)
{
    double ns[32];
    for (int i = 0; i < times; ++i) {
        double seconds, samples;
        gkd_destroy(learn(desc, log2n, 1 + (uint64_t)i, &seconds, &samples));
        ns[i] = seconds * 1e9 / samples;
    }
    return bench_summary(ns, times);
}

typedef struct queries {
    float position[DIRECTIONS][3], normal[DIRECTIONS][3], u[DIRECTIONS][2], given[DIRECTIONS][3];
    float sampled[DIRECTIONS][3], pdf[DIRECTIONS];
    gkd_handle handle[64];
} queries;

static void query_all(const gkd_view *view, queries *q, bool normals)
{
    for (int i = 0; i < DIRECTIONS; i += 64) {
        gkd_find_batch(view, 64, NULL, q->position[i], sizeof q->position[0], normals ? q->normal[i] : NULL,
                       sizeof q->normal[0], NULL, 0, q->handle, NULL);
        gkd_sample_batch(view, 64, NULL, q->handle, q->u[i], sizeof q->u[0], q->sampled[i], sizeof q->sampled[0],
                         &q->pdf[i]);
        gkd_pdf_batch(view, 64, NULL, q->handle, q->given[i], sizeof q->given[0], &q->pdf[i]);
    }
    bench_use(q->pdf);
}

static void query_singly(const gkd_view *view, queries *q, bool normals)
{
    for (int i = 0; i < DIRECTIONS; ++i) {
        gkd_handle h;
        gkd_find(view, q->position[i], normals ? q->normal[i] : NULL, NULL, &h);
        q->pdf[i] = gkd_sample(&h, q->u[i], q->sampled[i]) + gkd_pdf(&h, q->given[i]);
    }
    bench_use(q->pdf);
}

static void bench_queries(const gkd_view *view, queries *q)
{
    double limit = QUERY_LINES * bench_load_throughput((size_t)1 << 18), naive;
    gkd_view scalar = *view;
    scalar.simd = GKD_SIMD_SCALAR;
    bench_row_titles("ns per query: find, sample, another pdf");
    for (int normals = 0; normals < 2; ++normals) {
        bench_time batched, single;
        BENCH_MIN_NS(naive, 3, DIRECTIONS, query_singly(&scalar, q, normals););
        BENCH_TIME(batched, repeats, DIRECTIONS, query_all(view, q, normals););
        BENCH_TIME(single, repeats, DIRECTIONS, query_singly(view, q, normals););
        bench_row(normals ? "query, batched, with the cosine" : "query, batched", batched, limit, naive, 100);
        bench_row(normals ? "query, single, with the cosine" : "query, single", single, limit, naive, 200);
    }
}

static void bench_field(bool quick)
{
    gkd_desc desc;
    gkd_stats stats;
    double seconds, samples, load = bench_load_throughput((size_t)1 << 18);
    queries *q = allocate(1, sizeof *q);
    memset(&desc, 0, sizeof desc);
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    gkd_field *field = learn(&desc, quick ? 17 : 20, 1, &seconds, &samples);
    gkd_view view = gkd_get_view(field);
    gkd_get_stats(field, &stats);
    sf1_queries(77, DIRECTIONS, q->position, q->normal, q->given, q->u);
    printf("\nSF1: %u cells, %.1f lobes each, %.0f bytes a cell in both parts, %llu lookahead cells\n", stats.cells,
           (double)stats.lobes / stats.cells, (double)stats.bytes / stats.cells, (unsigned long long)stats.lookahead);
    bench_queries(&view, q);
    bench_row_titles("ns per sample");
    int times = quick ? 1 : 5, log2n = quick ? 16 : 20;
    desc.split = GKD_SPLIT_SIGNATURE;
    bench_row("record + accumulate + refine, signatures", time_learning(&desc, log2n, times), QUERY_LINES * load, 0,
              130);
    desc.split = GKD_SPLIT_COUNT;
    bench_row("record + accumulate + refine, count", time_learning(&desc, log2n, times), QUERY_LINES * load, 0, 130);
    desc.no_mixtures = true;
    bench_row("the same, without mixtures", time_learning(&desc, log2n, times), QUERY_LINES * load, 0, 0);
    gkd_destroy(field);
    free(q);
}

int main(int argc, char **argv)
{
    bool quick;
    if (!bench_options(argc, argv, &quick))
        fail("unknown option, or its value is missing or cannot be written; the first lines of bench_kd.c list them");
    repeats = quick ? 2 : 12;
    bench_print_machine(bench_json);
    gkd_desc desc;
    gkd_field *field;
    memset(&desc, 0, sizeof desc);
    check(gkd_create(&desc, &field), "create");
    gkd_view view = gkd_get_view(field);
    bench_mixtures(&view);
    gkd_destroy(field);
    bench_field(quick);
    bench_close_json();
    return 0;
}
