/* bench_photon: what the queries and the learning of guide_photon.h cost.

     build/bench_photon [--quick] [--json FILE]

   Light is SF1. Densities and sampled directions are checked against double precision over the decoded weights, and
   histograms against counts that use no grid, before anything is timed. */
#define GPH_IMPLEMENTATION
#include "guide_photon.h"

#include "bench.h"
#include "sf1.h"

#define QUERIES 4096
#define GROUP 64 /* queries asked together */
/* Cache lines that are touched at least. Find: slot of the hash table, its root, node, voxel, two of the handle.
   Sample: four of the rows' sums, one of the eights', one of weights, two of the handle. Density: weights and handle.
   A photon: itself, slot, root, node, voxel, bin, on the way in and once more sorted. */
#define FIND_LINES 6
#define SAMPLE_LINES 8
#define PDF_LINES 3
#define PHOTON_LINES 8

static int repeats = 12;

static void fail(const char *what)
{
    fprintf(stderr, "bench_photon: %s\n", what);
    exit(1);
}

static void check(gph_result result, const char *what)
{
    if (result)
        fail(what);
}

static void *allocate(size_t count, size_t size)
{
    void *p = calloc(count, size);
    if (!p)
        fail("out of memory");
    return p;
}

/* ---- naive: one voxel's histogram as the definition has it, in double precision */

static uint32_t naive_bin(uint32_t rows, const float *w)
{
    double phi = atan2((double)w[1], (double)w[0]);
    int r = (int)floor((w[2] + 1.0) * 0.5 * rows), c = (int)floor((phi < 0 ? phi + 2 * SF1_PI : phi) / SF1_PI * rows);
    r = r < (int)rows ? r : (int)rows - 1;
    c = c < 2 * (int)rows ? c : 2 * (int)rows - 1;
    return (uint32_t)r * 2 * rows + (uint32_t)c;
}

static double naive_weight(uint16_t half)
{
    int e = half >> 10, m = half & 1023;
    return e ? ldexp(1024 + m, e - 25) : ldexp(m, -24);
}

static double naive_sum(const gph_handle *h, uint32_t bins)
{
    double sum = 0;
    for (uint32_t i = 0; i < bins; ++i)
        sum += naive_weight(h->weights[i]);
    return sum;
}

/* Where a direction meets the sphere of the map. Returns solid angle from its middle per solid angle here. */
static double naive_seen(const gph_handle *h, const float *w, float *seen)
{
    double b = 0, l = 0, s;
    for (int k = 0; k < 3; ++k) {
        b += (double)h->offset[k] * (double)w[k];
        l += (double)h->offset[k] * (double)h->offset[k];
    }
    s = sqrt(1 - l + b * b);
    for (int k = 0; k < 3; ++k)
        seen[k] = (float)((double)h->offset[k] + (s - b) * (double)w[k]);
    return (s - b) * (s - b) / s;
}

/* sum: of all weights. */
static double naive_pdf(const gph_handle *h, double sum, const float *w)
{
    float seen[3];
    double bins = (double)h->rows * h->columns, e = (double)h->uniform, scale = naive_seen(h, w, seen);
    return scale * ((1 - e) * naive_weight(h->weights[naive_bin(h->rows, seen)]) / sum * bins + e) / (4 * SF1_PI);
}

/* Whether rounding may put a direction, as seen from the map's pivot, in the next bin. */
static bool at_an_edge(const gph_handle *h, const float *w)
{
    float seen[3];
    naive_seen(h, w, seen);
    double z = (seen[2] + 1.0) * 0.5 * h->rows, phi = atan2((double)seen[1], (double)seen[0]) / SF1_PI * h->rows;
    return fabs(z - nearbyint(z)) < 1e-4 || fabs(phi - nearbyint(phi)) < 1e-4;
}

/* Row by the sums of rows, then bin by bin; as gph_sample without a normal. */
static void naive_sample(const gph_handle *h, double sum, const float *u, float *w)
{
    double bins = (double)h->rows * h->columns, e = (double)h->uniform, x = (double)u[0], mass = 0, p = 0, z, phi;
    uint32_t r, c;
    for (r = 0;; x -= mass, ++r) {
        for (mass = 0, c = 0; c < h->columns; ++c)
            mass += (1 - e) * naive_weight(h->weights[r * h->columns + c]) / sum + e / bins;
        if (x < mass || r + 1 == h->rows)
            break;
    }
    z = 2 * (r + fmin(x / mass, 1)) / h->rows - 1;
    x = (double)u[1] * mass;
    for (c = 0;; x -= p, ++c) {
        p = (1 - e) * naive_weight(h->weights[r * h->columns + c]) / sum + e / bins;
        if (x < p || c + 1 == h->columns)
            break;
    }
    phi = 2 * SF1_PI * (c + fmin(x / p, 1)) / h->columns;
    w[0] = (float)(sqrt(fmax(0, 1 - z * z)) * cos(phi));
    w[1] = (float)(sqrt(fmax(0, 1 - z * z)) * sin(phi));
    w[2] = (float)z;
    double l = 0;
    for (int k = 0; k < 3; ++k) {
        w[k] -= h->offset[k];
        l += (double)w[k] * (double)w[k];
    }
    for (int k = 0; k < 3; ++k)
        w[k] = (float)((double)w[k] / sqrt(l));
}

/* ---- learning */

typedef struct light {
    gph_photon *photons;
    gph_vertex *vertices;
    uint32_t photon_count, vertex_count;
} light;

/* A pass: a photon for each draw of SF1, its flux what the draw stands for; a vertex for every fourth. */
static light draw_pass(sf1_rng *rng, int pass, uint32_t n)
{
    light l = {allocate(n, sizeof *l.photons), allocate(n, sizeof *l.vertices), 0, 0};
    for (uint32_t i = 0; i < n; ++i) {
        sf1_sample s;
        if (!sf1_draw(&sf1_default, rng, pass, 0, &s))
            continue;
        l.photons[l.photon_count++] =
            gph_make_photon(s.position, s.direction, s.distance, s.radiance * s.cosine / s.pdf);
        if (i % 4 == 0)
            l.vertices[l.vertex_count++] =
                gph_make_vertex(s.position, s.radiance * s.cosine, s.pdf, s.cosine * 0.318f, 0.1f, GPH_FROM_BSDF);
    }
    return l;
}

typedef struct costs {
    double vertex, photon; /* seconds; the refine belongs to the photons */
    double vertices, photons;
    uint64_t bytes; /* of the field at the end */
} costs;

static gph_field *learn(int log2n, uint64_t seed, costs *sum)
{
    gph_desc desc;
    gph_field *f;
    gph_stream *stream;
    sf1_rng rng = {seed};
    memset(sum, 0, sizeof *sum);
    memset(&desc, 0, sizeof desc);
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    desc.grid_cells = 8;
    check(gph_create(&desc, &f), "create");
    check(gph_stream_create(f, &stream), "stream");
    for (int pass = 0; pass < SF1_UPDATES; ++pass) {
        light l = draw_pass(&rng, pass, (1u << log2n) / SF1_UPDATES);
        double start = bench_seconds();
        for (uint32_t i = 0; i < l.vertex_count; i += GROUP)
            check(gph_record_vertices(stream, l.vertices + i, l.vertex_count - i < GROUP ? l.vertex_count - i : GROUP),
                  "record");
        check(gph_accumulate(f, &stream, 1, NULL, NULL), "accumulate");
        gph_stream_clear(stream);
        double middle = bench_seconds();
        for (uint32_t i = 0; i < l.photon_count; i += GROUP)
            check(gph_record_photons(stream, l.photons + i, l.photon_count - i < GROUP ? l.photon_count - i : GROUP),
                  "record");
        check(gph_accumulate(f, &stream, 1, NULL, NULL), "accumulate");
        gph_stream_clear(stream);
        check(gph_refine(f, NULL, NULL), "refine");
        sum->photon += bench_seconds() - middle;
        sum->vertex += middle - start;
        sum->photons += l.photon_count;
        sum->vertices += l.vertex_count;
        free(l.photons);
        free(l.vertices);
    }
    gph_stats stats;
    gph_get_stats(f, &stats);
    sum->bytes = stats.bytes;
    gph_stream_destroy(stream);
    return f;
}

/* Of 8 x 8 x 8 in the unit cube, by division. */
static uint32_t naive_cell(const float *p)
{
    uint32_t cell = 0;
    for (int k = 0; k < 3; ++k) {
        double c = floor((double)p[k] / 0.125);
        cell = 8 * cell + (uint32_t)(c < 7 ? c : 7);
    }
    return cell;
}

/* A grid as fine as the field's, found by division; double sums by bin; all its maps summed up in every pass. */
static double naive_learning(int log2n)
{
    enum { CELLS = 8 * 8 * 8, ROWS = 32, BINS = ROWS * ROWS * 2 };
    double *flux = allocate((size_t)CELLS * BINS, sizeof *flux), *cdf = allocate((size_t)CELLS * BINS, sizeof *cdf);
    sf1_rng rng = {1};
    double seconds = 0, photons = 0;
    for (int pass = 0; pass < SF1_UPDATES; ++pass) {
        light l = draw_pass(&rng, pass, (1u << log2n) / SF1_UPDATES);
        double start = bench_seconds();
        for (uint32_t i = 0; i < l.photon_count; ++i) {
            flux[(size_t)naive_cell(l.photons[i].position) * BINS + naive_bin(ROWS, l.photons[i].direction)] +=
                (double)l.photons[i].flux;
        }
        for (size_t c = 0; c < CELLS; ++c) {
            double sum = 0;
            for (size_t b = 0; b < BINS; ++b)
                cdf[c * BINS + b] = sum += flux[c * BINS + b];
        }
        bench_use(cdf);
        seconds += bench_seconds() - start;
        photons += l.photon_count;
        free(l.photons);
        free(l.vertices);
    }
    free(flux);
    free(cdf);
    return seconds * 1e9 / photons;
}

static void bench_learning(int log2n, int times)
{
    double photon[32], vertex[32], load, naive = 1e30;
    uint64_t bytes = 0;
    for (int i = 0; i < times; ++i) {
        costs c;
        gph_destroy(learn(log2n, 1 + (uint64_t)i, &c));
        bytes = c.bytes > bytes ? c.bytes : bytes;
        photon[i] = c.photon * 1e9 / c.photons;
        vertex[i] = c.vertex * 1e9 / c.vertices;
        naive = fmin(naive, naive_learning(log2n));
    }
    load = bench_load_throughput((size_t)bytes); /* what is touched lies anywhere in the field */
    bench_row_titles("ns per photon, per camera vertex");
    bench_row("record + accumulate + refine, photons", bench_summary(photon, times), PHOTON_LINES * load, naive, 250);
    bench_row("record + accumulate, camera vertices", bench_summary(vertex, times), PHOTON_LINES * load, 0, 120);
}

/* ---- queries */

typedef struct queries {
    float position[QUERIES][3], normal[QUERIES][3], u[QUERIES][2], given[QUERIES][3];
    float sampled[QUERIES][3], pdf[QUERIES];
    double sum[QUERIES];
    gph_handle handle[QUERIES];
} queries;

static void find_all(const gph_view *view, queries *q, bool normals)
{
    for (int i = 0; i < QUERIES; i += GROUP)
        gph_find_batch(view, GROUP, NULL, q->position[i], sizeof q->position[0], normals ? q->normal[i] : NULL,
                       sizeof q->normal[0], NULL, 0, &q->handle[i], NULL);
}

static void find_and_sample(const gph_view *view, queries *q, bool normals)
{
    for (int i = 0; i < QUERIES; i += GROUP) {
        gph_find_batch(view, GROUP, NULL, q->position[i], sizeof q->position[0], normals ? q->normal[i] : NULL,
                       sizeof q->normal[0], NULL, 0, &q->handle[i], NULL);
        gph_sample_batch(view, GROUP, NULL, &q->handle[i], q->u[i], sizeof q->u[0], q->sampled[i], sizeof q->sampled[0],
                         &q->pdf[i]);
    }
    bench_use(q->pdf);
}

static void ask_densities(const gph_view *view, queries *q)
{
    for (int i = 0; i < QUERIES; i += GROUP)
        gph_pdf_batch(view, GROUP, NULL, &q->handle[i], q->given[i], sizeof q->given[0], &q->pdf[i]);
    bench_use(q->pdf);
}

/* Against double precision, without normals: densities, and where sampling leads. */
static void validate(const gph_view *view, queries *q)
{
    double worst = 0, apart = 0;
    int edges = 0;
    find_and_sample(view, q, false);
    for (int i = 0; i < QUERIES; ++i) {
        float w[3];
        if (!q->handle[i].weights)
            fail("a position of SF1 has no map");
        q->sum[i] = naive_sum(&q->handle[i], view->rows * view->columns);
        naive_sample(&q->handle[i], q->sum[i], q->u[i], w);
        for (int k = 0; k < 3; ++k)
            apart = fmax(apart, fabs((double)w[k] - (double)q->sampled[i][k]));
    }
    ask_densities(view, q);
    for (int i = 0; i < QUERIES; ++i) {
        double p = naive_pdf(&q->handle[i], q->sum[i], q->given[i]);
        if (at_an_edge(&q->handle[i], q->given[i]))
            ++edges;
        else
            worst = fmax(worst, fabs((double)q->pdf[i] - p) / p);
    }
    printf("\nchecked: densities within %.1e of double precision, samples within %.1e\n", worst, apart);
    if (worst > 1e-5 || apart > 1e-3 || edges > QUERIES / 500)
        fail("queries do not agree with double precision");
}

/* Histograms of one pass from gph_export_maps against counts of the same photons: those of a voxel are told by its box
   alone, bins by the definition. Before any split and any filter. */
static void validate_histograms(void)
{
    enum { CELLS = 8, ROWS = 32, BINS = ROWS * ROWS * 2, PHOTONS = 200000 };
    gph_desc desc;
    gph_field *f;
    gph_stream *stream;
    sf1_rng rng = {5};
    double worst = 0;
    float *features = allocate((size_t)GPH_FEATURES * BINS, sizeof *features);
    double *flux = allocate((size_t)CELLS * CELLS * CELLS * BINS, sizeof *flux);
    light l = draw_pass(&rng, 0, PHOTONS);
    uint32_t inside = 0;
    for (uint32_t i = 0; i < l.photon_count; ++i) { /* the walls at 1 lie in cubes that the naive grid has not */
        const float *p = l.photons[i].position;
        if (p[0] < 1 && p[1] < 1 && p[2] < 1) {
            l.photons[inside] = l.photons[i];
            l.photons[inside++].nearness = 0; /* seen alike from everywhere in a voxel */
        }
    }
    l.photon_count = inside;
    memset(&desc, 0, sizeof desc);
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    desc.grid_cells = CELLS;
    desc.split_photons = 1e9f;
    check(gph_create(&desc, &f), "create");
    check(gph_stream_create(f, &stream), "stream");
    for (uint32_t i = 0; i < l.photon_count; ++i) { /* every place is looked at */
        gph_vertex v = gph_make_vertex(l.photons[i].position, 0, 0, 0, 0, GPH_TOUCH_ONLY);
        check(gph_record_vertices(stream, &v, 1), "record");
    }
    check(gph_record_photons(stream, l.photons, l.photon_count), "record");
    check(gph_accumulate(f, &stream, 1, NULL, NULL), "accumulate");
    check(gph_refine(f, NULL, NULL), "refine");
    for (uint32_t i = 0; i < l.photon_count; ++i)
        flux[(size_t)naive_cell(l.photons[i].position) * BINS + naive_bin(ROWS, l.photons[i].direction)] +=
            (double)l.photons[i].flux;
    gph_view view = gph_get_view(f);
    bool *seen = allocate((size_t)view.voxel_count, sizeof *seen);
    for (uint32_t i = 0; i < l.photon_count; ++i) {
        uint32_t voxel = gph_find_voxel(&view, l.photons[i].position);
        const double *mine = flux + (size_t)naive_cell(l.photons[i].position) * BINS;
        double sum = 0, peak = 0, mean = 0;
        if (voxel == GPH_NONE)
            fail("a photon's place has no voxel");
        if (seen[voxel])
            continue;
        seen[voxel] = true;
        gph_export_maps(f, &voxel, 1, features, NULL);
        for (int b = 0; b < BINS; ++b) {
            sum += mine[b];
            peak = fmax(peak, mine[b]);
            mean += (double)features[b] / BINS;
        }
        if (!(fabs(mean - 1) < 1e-4))
            fail("an exported histogram is not divided by its mean");
        for (int b = 0; b < BINS; ++b)
            worst = fmax(worst, fabs((double)features[b] * sum / BINS - mine[b]) / peak);
    }
    printf("checked: histograms of %u voxels within %.1e of their largest bin\n", view.voxel_count, worst);
    if (worst > 1e-5)
        fail("histograms do not agree with counts");
    gph_stream_destroy(stream);
    gph_destroy(f);
    free(seen);
    free(flux);
    free(features);
    free(l.photons);
    free(l.vertices);
}

static void bench_queries(const gph_view *view, queries *q)
{
    double load = bench_load_throughput((size_t)view->voxel_count * view->map_bytes), naive_sampling, naive_density;
    bench_time sample, pdf;
    BENCH_MIN_NS(naive_sampling, 3, QUERIES, {
        find_all(view, q, false);
        for (int i = 0; i < QUERIES; ++i)
            naive_sample(&q->handle[i], q->sum[i], q->u[i], q->sampled[i]);
        bench_use(q->sampled);
    });
    BENCH_MIN_NS(naive_density, 3, QUERIES, {
        double all = 0;
        for (int i = 0; i < QUERIES; ++i)
            all += naive_pdf(&q->handle[i], q->sum[i], q->given[i]);
        bench_use(&all);
    });
    bench_row_titles("ns per query");
    for (int normals = 0; normals < 2; ++normals) {
        BENCH_TIME(sample, repeats, QUERIES, find_and_sample(view, q, normals););
        BENCH_TIME(pdf, repeats, QUERIES, ask_densities(view, q););
        bench_row(normals ? "find and sample, mirrored" : "find and sample", sample, (FIND_LINES + SAMPLE_LINES) * load,
                  normals ? 0 : naive_sampling, normals ? 220 : 180);
        bench_row(normals ? "density, mirrored" : "density", pdf, PDF_LINES * load, normals ? 0 : naive_density,
                  normals ? 90 : 50);
    }
}

static void bench_field(int log2n)
{
    queries *q = allocate(1, sizeof *q);
    gph_stats stats;
    costs sum;
    gph_field *f = learn(log2n, 1, &sum);
    gph_view view = gph_get_view(f);
    gph_get_stats(f, &stats);
    sf1_queries(77, QUERIES, q->position, q->normal, q->given, q->u);
    printf("\nSF1: %u voxels, %u of them sparse, %.0f bytes each in both parts\n", stats.voxels, stats.sparse,
           (double)stats.bytes / stats.voxels);
    validate(&view, q);
    bench_queries(&view, q);
    gph_destroy(f);
    free(q);
}

int main(int argc, char **argv)
{
    bool quick;
    if (!bench_options(argc, argv, &quick))
        fail("unknown option, or its value is missing or cannot be written; the first lines of bench_photon.c list "
             "them");
    repeats = quick ? 2 : 12;
    bench_print_machine(bench_json);
    validate_histograms();
    bench_field(quick ? 16 : 20);
    bench_learning(quick ? 16 : 20, quick ? 1 : 5);
    bench_close_json();
    return 0;
}
