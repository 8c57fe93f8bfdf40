/* bench_sdtree: what the SD-tree's queries and learning cost. (How well it learns: bench_field.)

     build/bench_sdtree [--quick] [--json FILE] [--set key=value]...

   Every figure is checked against the naive tree of sdtree_naive.h before it is timed, and printed as a ratio to it and
   to a limit that this run measured. */
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "bench.h"
#include "sdtree_naive.h"
#include "sf1.h"

#define INNER_NODES 75 /* of the random quadtrees: 300 children */
#define BATCH 4096

typedef struct options {
    bool quick;
    int repeats;
    uint32_t queries;
    FILE *json;
    gsd_desc desc; /* as the command line changed it */
} options;

static void fail(const char *what)
{
    fprintf(stderr, "bench_sdtree: %s\n", what);
    exit(1);
}

static void check(gsd_result result, const char *what)
{
    if (result) {
        fprintf(stderr, "bench_sdtree: %s: %s\n", what, gsd_result_string(result));
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

/* ---- rows --------------------------------------------------------------------------------------------------- */

/* Arrays that queries read. */
enum { AREA_SPACE, AREA_NODES, AREA_JUMPS, AREA_MASSES, AREA_ALIASES, AREAS };
static const char *const area_name[AREAS] = {"grid, spatial tree and cells", "nodes", "jumps", "masses", "alias slots"};

typedef struct machine {
    double latency[AREAS], throughput[AREAS]; /* of a random cache line in a block of that size, ns */
    double cached;                            /* of a cache line in 256 KB, ns, independent loads */
    double bandwidth;                         /* bytes per ns */
} machine;

/* ---- the field of the queries ------------------------------------------------------------------------------- */

static gsd_training_sample to_training(const sf1_sample *s)
{
    float contribution = s->radiance * s->cosine * (float)(1 / SF1_PI);
    return gsd_make_scalar_sample(s->position, s->direction, s->normal, s->distance, s->radiance, contribution,
                                  contribution, s->pdf, s->cosine * (float)(1 / SF1_PI), 0);
}

/* Draw about n training samples of this update. */
static uint32_t draw_samples(sf1_rng *rng, uint32_t n, int update, int exact, gsd_training_sample *out)
{
    uint32_t count = 0;
    sf1_sample s;
    for (uint32_t i = 0; i < n; ++i)
        if (sf1_draw(&sf1_default, rng, update, exact, &s))
            out[count++] = to_training(&s);
    return count;
}

/* A quadtree whose heaviest leaf is divided until it has INNER_NODES inner nodes, with skewed random shares. */
static void random_tree(uint64_t *seed, gsd_tree *tree)
{
    uint32_t count = 0, at = 0, corner = 0;
    float mass = 1;
    memset(tree->child, 0, 4 * INNER_NODES * sizeof *tree->child);
    for (;;) {
        float share[4], sum = 0;
        for (int c = 0; c < 4; ++c) {
            float u = (float)((bench_random(seed) >> 40) + 1) * 0x1p-24f;
            share[c] = powf(-logf(u), 1.5f) + 1e-3f;
            sum += share[c];
        }
        if (count)
            tree->child[4 * at + corner] = count;
        for (int c = 0; c < 4; ++c)
            tree->value[4 * count + c] = mass * share[c] / sum;
        if (++count == INNER_NODES)
            break;
        mass = -1;
        for (uint32_t i = 0; i < 4 * count; ++i)
            if (!tree->child[i] && tree->value[i] > mass) {
                mass = tree->value[i];
                at = i / 4;
                corner = i % 4;
            }
    }
    tree->count = count;
}

/* About 5,000 cells on the walls of the cube (800 where quick), a random quadtree of 301 nodes in each. */
static gsd_field *make_field(const options *o, bool alias)
{
    gsd_desc desc;
    gsd_field *field;
    gsd_stream *stream;
    uint32_t n = o->quick ? 1 << 16 : 1 << 19;
    gsd_training_sample *samples = allocate(n, sizeof *samples);
    sf1_rng rng = {7};
    memset(&desc, 0, sizeof desc);
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    desc.split_samples = 180;
    desc.no_gate = true;
    desc.target = GSD_TARGET_RADIANCE;
    desc.alias = alias;
    check(gsd_create(&desc, &field), "create");
    check(gsd_stream_create(field, &stream), "stream");
    for (int pass = 0; pass < 16 && gsd_cell_count(field) < (o->quick ? 600 : 4500); ++pass) {
        check(gsd_record(stream, samples, draw_samples(&rng, n, 0, 1, samples)), "record");
        check(gsd_accumulate(field, &stream, 1, NULL, NULL), "accumulate");
        gsd_stream_clear(stream);
        check(gsd_refine(field, NULL, NULL, NULL), "refine");
    }
    gsd_stream_destroy(stream);
    free(samples);
    uint32_t cells = gsd_cell_count(field);
    gsd_tree *trees = allocate(cells, sizeof *trees);
    uint64_t seed = 11;
    for (uint32_t i = 0; i < cells; ++i) {
        trees[i].cell = i;
        trees[i].child = allocate(4 * INNER_NODES, sizeof *trees[i].child);
        trees[i].value = allocate(4 * INNER_NODES, sizeof *trees[i].value);
        random_tree(&seed, &trees[i]);
    }
    check(gsd_import_trees(field, trees, cells), "import");
    for (uint32_t i = 0; i < cells; ++i) {
        free(trees[i].child);
        free(trees[i].value);
    }
    free(trees);
    return field;
}

/* Queries: positions on the walls; directions uniform, and drawn from the field. */
typedef struct queries {
    uint32_t count;
    float *position, *u, *uniform, *guided, *normal; /* [count][3], [2], [3], [3], [3] */
    double *position_d, *u_d, *guided_d;             /* the naive tree's copies: position in [0,1)^3 of the grid */
    double *uniform_d;
} queries;

static queries make_queries(uint32_t count, const gsd_view *view)
{
    queries q = {count, 0, 0, 0, 0, 0, 0, 0, 0, 0};
    sf1_rng rng = {23};
    q.position = allocate(3 * count, sizeof(float));
    q.u = allocate(2 * count, sizeof(float));
    q.uniform = allocate(3 * count, sizeof(float));
    q.guided = allocate(3 * count, sizeof(float));
    q.normal = allocate(3 * count, sizeof(float));
    q.position_d = allocate(3 * count, sizeof(double));
    q.u_d = allocate(2 * count, sizeof(double));
    q.guided_d = allocate(3 * count, sizeof(double));
    q.uniform_d = allocate(3 * count, sizeof(double));
    for (uint32_t i = 0; i < count; ++i) {
        sf1_point p;
        double w[3];
        static const double up[3] = {0, 0, 1};
        sf1_make_point(&sf1_default, &rng, &p);
        sf1_around(up, 2 * sf1_uniform(&rng) - 1, sf1_uniform(&rng), w);
        for (int k = 0; k < 3; ++k) {
            q.position[3 * i + k] = (float)p.x[k];
            q.normal[3 * i + k] = (float)p.n[k];
            q.uniform[3 * i + k] = (float)w[k];
        }
        for (int k = 0; k < 2; ++k)
            q.u[2 * i + k] = (float)(sf1_u64(&rng) >> 40) * 0x1p-24f;
    }
    for (uint32_t i = 0; i < count; ++i) { /* another point's random numbers, so that the directions are no samples */
        gsd_handle h = gsd_find(view, &q.position[3 * i], NULL, NULL);
        gsd_sample(view, &h, &q.u[2 * ((i + 1) % count)], &q.guided[3 * i]);
        gsd_extend_random(&q.u[2 * i], &q.u_d[2 * i]);
        for (int k = 0; k < 3; ++k) {
            uint32_t g = gsd_grid_coordinate(q.position[3 * i + k], view->origin[k], view->scale);
            q.position_d[3 * i + k] = ((double)g + 0.5) / 16777216;
            q.guided_d[3 * i + k] = (double)q.guided[3 * i + k];
            q.uniform_d[3 * i + k] = (double)q.uniform[3 * i + k];
        }
    }
    return q;
}

static void free_queries(queries *q)
{
    free(q->position);
    free(q->u);
    free(q->uniform);
    free(q->guided);
    free(q->normal);
    free(q->position_d);
    free(q->u_d);
    free(q->guided_d);
    free(q->uniform_d);
}

typedef struct order_key {
    uint32_t cell, index;
} order_key;

static int compare_keys(const void *a, const void *b)
{
    const order_key *x = a, *y = b;
    if (x->cell != y->cell)
        return x->cell < y->cell ? -1 : 1;
    return x->index < y->index ? -1 : x->index > y->index;
}

static void *permuted(void *data, const order_key *key, uint32_t count, size_t size)
{
    char *out = allocate(count, size), *in = data;
    for (uint32_t i = 0; i < count; ++i)
        memcpy(out + i * size, in + key[i].index * size, size);
    free(data);
    return out;
}

/* The same queries ordered by the cell they fall into. */
static queries sorted_queries(const queries *from, const gsd_view *view)
{
    queries q = make_queries(from->count, view);
    order_key *key = allocate(q.count, sizeof *key);
    for (uint32_t i = 0; i < q.count; ++i) {
        key[i].cell = gsd_find(view, &q.position[3 * i], NULL, NULL).cell;
        key[i].index = i;
    }
    qsort(key, q.count, sizeof *key, compare_keys);
    q.position = permuted(q.position, key, q.count, 3 * sizeof(float));
    q.u = permuted(q.u, key, q.count, 2 * sizeof(float));
    q.uniform = permuted(q.uniform, key, q.count, 3 * sizeof(float));
    q.guided = permuted(q.guided, key, q.count, 3 * sizeof(float));
    q.normal = permuted(q.normal, key, q.count, 3 * sizeof(float));
    q.position_d = permuted(q.position_d, key, q.count, 3 * sizeof(double));
    q.u_d = permuted(q.u_d, key, q.count, 2 * sizeof(double));
    q.guided_d = permuted(q.guided_d, key, q.count, 3 * sizeof(double));
    q.uniform_d = permuted(q.uniform_d, key, q.count, 3 * sizeof(double));
    free(key);
    return q;
}

/* ---- what is timed ------------------------------------------------------------------------------------------ */

/* Output of a batch; reused, so that it stays in cache. */
typedef struct results {
    gsd_handle handle[BATCH];
    float direction[3 * BATCH], pdf[BATCH];
} results;

static void find_scalar(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    for (uint32_t i = 0; i < n; ++i)
        r->handle[i] = gsd_find(v, &q->position[3 * (at + i)], NULL, NULL);
}
static void find_batch(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    gsd_find_batch(v, n, NULL, &q->position[3 * at], 12, NULL, 0, NULL, 0, r->handle, NULL);
}
static void sample_scalar(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    for (uint32_t i = 0; i < n; ++i) {
        gsd_handle h = gsd_find(v, &q->position[3 * (at + i)], NULL, NULL);
        r->pdf[i] = gsd_sample(v, &h, &q->u[2 * (at + i)], &r->direction[3 * i]);
    }
}
static void sample_batch(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    find_batch(v, q, at, n, r);
    gsd_sample_batch(v, n, NULL, r->handle, &q->u[2 * at], 8, r->direction, 12, r->pdf);
}
static void pdf_scalar(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    for (uint32_t i = 0; i < n; ++i) {
        gsd_handle h = gsd_find(v, &q->position[3 * (at + i)], NULL, NULL);
        r->pdf[i] = gsd_pdf(v, &h, &q->uniform[3 * (at + i)]);
    }
}
static void pdf_batch(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    find_batch(v, q, at, n, r);
    gsd_pdf_batch(v, n, NULL, r->handle, &q->uniform[3 * at], 12, r->pdf);
}
static void pdf_guided_batch(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    find_batch(v, q, at, n, r);
    gsd_pdf_batch(v, n, NULL, r->handle, &q->guided[3 * at], 12, r->pdf);
}

static void find_product(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    gsd_find_batch(v, n, NULL, &q->position[3 * at], 12, &q->normal[3 * at], 12, NULL, 0, r->handle, NULL);
}
static void sample_product(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    find_product(v, q, at, n, r);
    gsd_sample_batch(v, n, NULL, r->handle, &q->u[2 * at], 8, r->direction, 12, r->pdf);
}
static void pdf_product(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r)
{
    find_product(v, q, at, n, r);
    gsd_pdf_batch(v, n, NULL, r->handle, &q->uniform[3 * at], 12, r->pdf);
}

typedef void (*query_fn)(const gsd_view *v, const queries *q, uint32_t at, uint32_t n, results *r);

static bench_time time_queries(const options *o, query_fn fn, const gsd_view *v, const queries *q)
{
    bench_time time;
    results *r = allocate(1, sizeof *r);
    BENCH_TIME(time, o->repeats, q->count, {
        for (uint32_t at = 0; at < q->count; at += BATCH) {
            fn(v, q, at, q->count - at < BATCH ? q->count - at : BATCH, r);
            bench_use(r);
        }
    });
    free(r);
    return time;
}

enum { NAIVE_FIND, NAIVE_SAMPLE, NAIVE_PDF, NAIVE_PDF_GUIDED };

static double time_naive(const options *o, naive_space *root, const queries *q, int what)
{
    double ns, sum = 0, w[3];
    int repeats = (o->repeats + 2) / 3;
    BENCH_MIN_NS(ns, repeats, q->count, {
        for (uint32_t i = 0; i < q->count; ++i) {
            naive_space *s = naive_find(root, &q->position_d[3 * i]);
            if (what == NAIVE_FIND)
                sum += s->cell;
            else if (what == NAIVE_SAMPLE)
                sum += naive_sample_at(s, &q->position_d[3 * i], q->u_d[2 * i], q->u_d[2 * i + 1], w);
            else
                sum += naive_pdf_at(s, &q->position_d[3 * i],
                                    what == NAIVE_PDF ? &q->uniform_d[3 * i] : &q->guided_d[3 * i]);
        }
        bench_use(&sum);
    });
    return ns;
}

/* ---- validation --------------------------------------------------------------------------------------------- */

static int differs(double a, double b) { return !(fabs(a - b) <= 1e-5 * fmax(fabs(a), fabs(b))); }

typedef struct mismatches {
    uint32_t find, pdf, guided, sample, drawn;
} mismatches;

/* One batch of queries at one level, or one by one (batched = false), against the naive tree. */
static void compare(const gsd_view *v, const queries *q, naive_space *root, bool batched, uint32_t at, mismatches *m)
{
    results *r = allocate(1, sizeof *r), *g = allocate(1, sizeof *g), *d = allocate(1, sizeof *d);
    (batched ? find_batch : find_scalar)(v, q, at, BATCH, r);
    (batched ? pdf_batch : pdf_scalar)(v, q, at, BATCH, d);
    pdf_guided_batch(v, q, at, BATCH, g);
    for (uint32_t i = 0; i < BATCH; ++i) {
        const naive_space *s = naive_find(root, &q->position_d[3 * (at + i)]);
        m->find += r->handle[i].cell != s->cell;
        const double *p = &q->position_d[3 * (at + i)];
        m->pdf += differs((double)d->pdf[i], naive_pdf_at(s, p, &q->uniform_d[3 * (at + i)]));
        m->guided += differs((double)g->pdf[i], naive_pdf_at(s, p, &q->guided_d[3 * (at + i)]));
    }
    (batched ? sample_batch : sample_scalar)(v, q, at, BATCH, r);
    for (uint32_t i = 0; i < BATCH; ++i) {
        const naive_space *s = naive_find(root, &q->position_d[3 * (at + i)]);
        const float *f = &r->direction[3 * i];
        double w[3], drawn[3] = {(double)f[0], (double)f[1], (double)f[2]};
        const double *p = &q->position_d[3 * (at + i)];
        double pdf = naive_sample_at(s, p, q->u_d[2 * (at + i)], q->u_d[2 * (at + i) + 1], w);
        m->drawn += differs((double)r->pdf[i], naive_pdf_at(s, p, drawn));
        m->sample += differs((double)r->pdf[i], pdf) || sf1_dot(w, drawn) < 1 - 1e-5;
    }
    free(r);
    free(g);
    free(d);
}

/* Density equal to 1e-5 but for directions within rounding of a leaf's edge; the same u gives the same direction
   (not with alias tables). */
static void validate(const gsd_view *view, const queries *q, naive_space *root, bool alias)
{
    static const char *name[] = {"one by one", "scalar", "AVX2", "AVX-512"};
    for (uint32_t level = 0; level <= view->simd; ++level) {
        gsd_view v = *view;
        mismatches m = {0, 0, 0, 0, 0};
        uint32_t n = 0;
        v.simd = level ? level : v.simd;
        for (uint32_t at = 0; at + BATCH <= q->count && n < 16 * BATCH; at += BATCH, n += BATCH)
            compare(&v, q, root, level > 0, at, &m);
        printf("validated%s, %-10s %u queries: other leaf by rounding: pdf %u, guided pdf %u, sample %u, same u %u\n",
               alias ? " alias" : "", level < 4 ? name[level] : "SIMD", n, m.pdf, m.guided, m.drawn,
               alias ? 0 : m.sample);
        if (m.find || m.pdf > n / 2000 || m.guided > n / 2000 || m.drawn > n / 2000 || (!alias && m.sample > n / 500))
            fail("the field does not agree with the naive tree");
    }
}

/* ---- microbenchmarks ---------------------------------------------------------------------------------------- */

/* The distinct cache lines that a query touches, by array. */
typedef struct touched {
    uintptr_t line[1024]; /* since the last query, or the last cell */
    uint32_t count;
    double lines[AREAS];
} touched;

static void touch(touched *t, int area, const void *data, size_t size)
{
    for (uintptr_t line = (uintptr_t)data / 64; line <= ((uintptr_t)data + size - 1) / 64; ++line) {
        uint32_t i = 0;
        while (i < t->count && t->line[i] != line)
            ++i;
        if (i < t->count)
            continue;
        if (t->count < 1024)
            t->line[t->count++] = line;
        t->lines[area]++;
    }
}

static void touch_find(touched *t, const gsd_view *v, const float *position)
{
    uint32_t g[3], link, level = 12;
    for (int k = 0; k < 3; ++k)
        g[k] = gsd_grid_coordinate(position[k], v->origin[k], v->scale);
    const uint32_t *entry = &v->grid[(g[0] >> 20) << 8 | (g[1] >> 20) << 4 | g[2] >> 20];
    touch(t, AREA_SPACE, entry, sizeof *entry);
    for (link = *entry; !(link & GSD_CELL_BIT); ++level) {
        entry = &v->spatial[link + (g[level % 3] >> (23 - level / 3) & 1)];
        touch(t, AREA_SPACE, entry, sizeof *entry);
        link = *entry;
    }
    touch(t, AREA_SPACE, &v->cells[link & ~GSD_CELL_BIT], sizeof *v->cells);
}

/* From a node of this depth to the leaf of a direction. */
static void touch_path(touched *t, const gsd_view *v, uint32_t node, uint32_t depth, const float *direction)
{
    uint32_t x, y, child;
    gsd_coordinates(direction, &x, &y);
    touch(t, AREA_NODES, &v->nodes[node], sizeof *v->nodes);
    while ((child = v->nodes[node].inner.child) != 0) {
        ++depth;
        node = child + (x >> (24 - depth) & 1) + 2 * (y >> (24 - depth) & 1);
        touch(t, AREA_NODES, &v->nodes[node], sizeof *v->nodes);
    }
}

static void touch_jump(touched *t, const gsd_view *v, const gsd_handle *h, const float *direction)
{
    uint32_t x, y;
    gsd_coordinates(direction, &x, &y);
    const uint32_t *jump = &v->jumps[h->jump + (y >> 21) * 8 + (x >> 21)];
    touch(t, AREA_JUMPS, jump, sizeof *jump);
    touch_path(t, v, *jump, 3, direction);
}

static void touch_slot(touched *t, const gsd_view *v, const gsd_handle *h, const float *u)
{
    double r[2], e = (double)v->uniform;
    gsd_extend_random(u, r);
    double slot = (r[0] - e) / (1 - e) * h->alias_count;
    const gsd_alias *a = &v->aliases[h->alias + (uint32_t)fmin(fmax(slot, 0), h->alias_count - 1.0)];
    touch(t, AREA_ALIASES, a, sizeof *a);
    touch(t, AREA_NODES, &v->nodes[slot - floor(slot) < (double)a->threshold ? a->node : a->other], sizeof *v->nodes);
}

enum { QUERY_FIND, QUERY_SAMPLE, QUERY_PDF, QUERY_GUIDED, QUERY_FIND_PRODUCT, QUERY_SAMPLE_PRODUCT, QUERY_PDF_PRODUCT };

/* Mean numbers of distinct lines of a query; where sorted, of those that no query of the same cell has touched. */
static void count_lines(const gsd_view *v, const queries *q, int kind, bool sorted, double lines[AREAS])
{
    touched *t = allocate(1, sizeof *t);
    uint32_t n = sorted || q->count < 65536 ? q->count : 65536, cell = GSD_CELL_BIT;
    bool product = kind >= QUERY_FIND_PRODUCT;
    for (uint32_t i = 0; i < n; ++i) {
        float direction[3];
        gsd_handle h = gsd_find(v, &q->position[3 * i], product ? &q->normal[3 * i] : NULL, NULL);
        t->count = sorted && h.cell == cell ? t->count : 0;
        cell = h.cell;
        touch_find(t, v, &q->position[3 * i]);
        if (product && h.product > 0)
            touch(t, AREA_MASSES, &v->masses[h.jump], GSDI_BINS * sizeof *v->masses);
        gsd_sample(v, &h, &q->u[2 * i], direction);
        if (kind == QUERY_SAMPLE && h.alias_count)
            touch_slot(t, v, &h, &q->u[2 * i]);
        else if (kind == QUERY_SAMPLE)
            touch_path(t, v, h.root, 0, direction);
        else if (kind == QUERY_SAMPLE_PRODUCT)
            touch_jump(t, v, &h, direction);
        else if (kind == QUERY_PDF || kind == QUERY_PDF_PRODUCT)
            touch_jump(t, v, &h, &q->uniform[3 * i]);
        else if (kind == QUERY_GUIDED)
            touch_jump(t, v, &h, &q->guided[3 * i]);
    }
    for (int k = 0; k < AREAS; ++k)
        lines[k] = t->lines[k] / n;
    free(t);
}

typedef struct query_row {
    const char *name;
    query_fn fn;
    int kind;
    bool single, sorted, alias;
    double target;
} query_row;

static const query_row query_rows[] = {
    {"find, one by one", find_scalar, QUERY_FIND, true, false, false, 0},
    {"find, batched", find_batch, QUERY_FIND, false, false, false, 0},
    {"find + sample, one by one", sample_scalar, QUERY_SAMPLE, true, false, false, 0},
    {"find + sample, batched", sample_batch, QUERY_SAMPLE, false, false, false, 60},
    {"find + sample, alias, one by one", sample_scalar, QUERY_SAMPLE, true, false, true, 0},
    {"find + sample, alias, batched", sample_batch, QUERY_SAMPLE, false, false, true, 25},
    {"find + sample, sorted, batched", sample_batch, QUERY_SAMPLE, false, true, false, 0},
    {"find + sample, sorted, alias, batched", sample_batch, QUERY_SAMPLE, false, true, true, 0},
    {"find + pdf, one by one", pdf_scalar, QUERY_PDF, true, false, false, 0},
    {"find + pdf, batched", pdf_batch, QUERY_PDF, false, false, false, 95},
    {"find + pdf of guided directions, batched", pdf_guided_batch, QUERY_GUIDED, false, false, false, 0},
    {"find + pdf, sorted, one by one", pdf_scalar, QUERY_PDF, true, true, false, 0},
    {"find + pdf, sorted, batched", pdf_batch, QUERY_PDF, false, true, false, 40},
    {"find with product, batched", find_product, QUERY_FIND_PRODUCT, false, false, false, 0},
    {"find + sample with product, batched", sample_product, QUERY_SAMPLE_PRODUCT, false, false, false, 0},
    {"find + pdf with product, batched", pdf_product, QUERY_PDF_PRODUCT, false, false, false, 0},
};

/* Of the time: lines of each array times that of a random load there, one after another or independent. */
static double lines_ns(const machine *m, const double lines[AREAS], bool single)
{
    double ns = 0;
    for (int k = 0; k < AREAS; ++k)
        ns += lines[k] * (single ? m->latency : m->throughput)[k];
    return ns;
}

static void bench_levels(const options *o, const gsd_view *view, const queries *q, const machine *m,
                         const double *naive)
{
    static const char *level_name[] = {"", "scalar", "AVX2", "AVX-512"};
    for (uint32_t level = GSD_SIMD_SCALAR; level < view->simd; ++level)
        for (size_t i = 0; i < sizeof query_rows / sizeof *query_rows; ++i) {
            const query_row *w = &query_rows[i];
            char name[64];
            double lines[AREAS];
            gsd_view v = *view;
            v.simd = level;
            if (w->single || w->sorted || w->alias || (w->kind != QUERY_SAMPLE && w->kind != QUERY_PDF))
                continue;
            snprintf(name, sizeof name, "%s, %s", w->name, level_name[level]);
            count_lines(view, q, w->kind, false, lines);
            bench_row(name, time_queries(o, w->fn, &v, q), lines_ns(m, lines, false), naive[w->kind], 0);
        }
}

/* With the product, batches and single queries must agree bit by bit. */
static void validate_product(const gsd_view *v, const queries *q)
{
    results *r = allocate(1, sizeof *r);
    uint32_t wrong = 0;
    pdf_product(v, q, 0, BATCH, r);
    for (uint32_t i = 0; i < BATCH; ++i) {
        gsd_handle h = gsd_find(v, &q->position[3 * i], &q->normal[3 * i], NULL);
        wrong += gsd_pdf(v, &h, &q->uniform[3 * i]) != r->pdf[i];
    }
    free(r);
    if (wrong)
        fail("batches with the product do not agree with single queries");
}

static void bench_queries(const options *o, const gsd_view *v, const gsd_view *alias, const queries *q,
                          const queries *sorted, naive_space *root, const machine *m)
{
    double naive[4], naive_sorted[4];
    for (int i = 0; i < 4; ++i) {
        naive[i] = time_naive(o, root, q, i);
        naive_sorted[i] = time_naive(o, root, sorted, i);
    }
    validate_product(v, q);
    printf("limit: as many random loads as a query touches distinct cache lines (where sorted: lines that no query of "
           "the\n"
           "       same cell has touched) in blocks of the arrays' sizes, one after another for one by one, else\n"
           "       independent, ns:\n");
    for (int k = 0; k < AREAS; ++k)
        printf("       %-30s %6.1f, independent %5.1f\n", area_name[k], m->latency[k], m->throughput[k]);
    printf("lines: in these arrays; naive: without the product\n");
    bench_row_titles("ns per query");
    for (size_t i = 0; i < sizeof query_rows / sizeof *query_rows; ++i) {
        const query_row *w = &query_rows[i];
        const gsd_view *view = w->alias ? alias : v;
        const queries *what = w->sorted ? sorted : q;
        int like = w->kind >= QUERY_FIND_PRODUCT ? w->kind - QUERY_FIND_PRODUCT : w->kind;
        double lines[AREAS], all = 0;
        count_lines(view, what, w->kind, w->sorted, lines);
        bench_row(w->name, time_queries(o, w->fn, view, what), lines_ns(m, lines, w->single),
                  (w->sorted ? naive_sorted : naive)[like], w->target);
        for (int k = 0; k < AREAS; ++k)
            all += lines[k];
        printf("    %.1f lines: %.1f + %.1f + %.1f + %.1f + %.1f\n", all, lines[0], lines[1], lines[2], lines[3],
               lines[4]);
    }
    bench_levels(o, v, q, m, naive);
}

/* ---- learning ----------------------------------------------------------------------------------------------- */

typedef struct learning {
    double record, accumulate, refine; /* seconds */
    uint64_t samples;
} learning;

static double lap(double *since)
{
    double now = bench_seconds(), passed = now - *since;
    *since = now;
    return passed;
}

/* What a renderer knows about its samples: the guide's density, where it guides. */
static void fill_pdf_guide(const gsd_field *field, gsd_training_sample *samples, uint32_t count)
{
    gsd_view view = gsd_get_view(field);
    for (uint32_t i = 0; i < count; ++i) {
        gsd_training_sample *s = &samples[i];
        float n[3], d[3];
        gsd_unpack_normal(s->direction, n);
        gsd_direction((s->direction[0] & 0xffffff) + 0.5, (s->direction[1] & 0xffffff) + 0.5, d);
        gsd_handle h = gsd_find(&view, s->position, n, NULL);
        s->pdf_guide = h.alpha < 1 ? gsd_pdf(&view, &h, d) : 0;
    }
}

/* Learn SF1 from about 2^log2n samples in SF1_UPDATES equal updates. naive may be NULL: it gets the same samples. */
static gsd_field *learn(const gsd_desc *desc, int log2n, uint64_t seed, learning *t, naive_learner *naive,
                        double *naive_seconds)
{
    gsd_field *field;
    gsd_stream *stream;
    uint32_t n = (1u << log2n) / SF1_UPDATES;
    gsd_training_sample *samples = allocate(n, sizeof *samples);
    sf1_rng rng = {seed};
    memset(t, 0, sizeof *t);
    check(gsd_create(desc, &field), "create");
    check(gsd_stream_create(field, &stream), "stream");
    for (int update = 0; update < SF1_UPDATES; ++update) {
        uint32_t count = draw_samples(&rng, n, update, 0, samples), i;
        for (i = 0; naive && i < count; ++i)
            samples[i].nearness = 0; /* of which the naive learner knows nothing */
        fill_pdf_guide(field, samples, count);
        double time = bench_seconds();
        for (i = 0; i < count; i += 64)
            check(gsd_record(stream, samples + i, count - i < 64 ? count - i : 64), "record");
        t->record += lap(&time);
        check(gsd_accumulate(field, &stream, 1, NULL, NULL), "accumulate");
        gsd_stream_clear(stream);
        t->accumulate += lap(&time);
        check(gsd_refine(field, NULL, NULL, NULL), "refine");
        t->refine += lap(&time);
        t->samples += count;
        for (i = 0; naive && i < count; ++i) {
            const gsd_training_sample *s = &samples[i];
            double p[3] = {(double)s->position[0], (double)s->position[1], (double)s->position[2]};
            float d[3];
            gsd_direction((s->direction[0] & 0xffffff) + 0.5, (s->direction[1] & 0xffffff) + 0.5, d);
            double w[3] = {(double)d[0], (double)d[1], (double)d[2]};
            naive_record(naive, p, w, (double)s->radiance / (double)s->pdf_mix);
        }
        if (naive) {
            naive_refine(naive);
            *naive_seconds += lap(&time);
        }
    }
    gsd_stream_destroy(stream);
    free(samples);
    return field;
}

/* In one cell, without filters and history, the field and the naive learner must learn the same density. */
static void validate_learning(const options *o)
{
    double seconds = 0;
    learning t;
    uint64_t seed = 3;
    uint32_t wrong = 0, n = 1 << 14;
    gsd_desc desc = o->desc;
    naive_learner naive = naive_create(1e9, 0.01);
    static const float middle[3] = {0.5f, 0.5f, 0.5f};
    desc.denoise = GSD_DENOISE_OFF; /* validate_denoise checks that */
    desc.target = GSD_TARGET_RADIANCE;
    desc.split_samples = 1e9f;
    desc.rho = 0.01f;
    desc.directional_filter = GSD_DIRECTIONAL_NEAREST;
    desc.spatial_filter = GSD_SPATIAL_NEAREST;
    desc.no_history = desc.no_gate = true;
    desc.smoothing = 0.001f; /* the naive one takes shares as they are */
    gsd_field *field = learn(&desc, 17, 1, &t, &naive, &seconds);
    gsd_view view = gsd_get_view(field);
    gsd_handle handle = gsd_find(&view, middle, NULL, NULL);
    for (uint32_t i = 0; i < n; ++i) {
        double d[3];
        float u[2] = {(float)(bench_random(&seed) >> 40) * 0x1p-24f, (float)(bench_random(&seed) >> 40) * 0x1p-24f},
              f[3];
        float pdf = gsd_sample(&view, &handle, u, f);
        for (int k = 0; k < 3; ++k)
            d[k] = (double)f[k];
        wrong += differs((double)pdf, naive_pdf(naive.root->sampling, d));
    }
    printf("validated: %u samples learned in one cell: %u of %u densities differ from the naive ones\n",
           (unsigned)t.samples, wrong, n);
    if (wrong > n / 100) /* leaves without samples keep a trace of the smoothing */
        fail("the field did not learn what the naive one learned");
    gsd_destroy(field);
    naive_free_space(naive.root);
}

static void bench_learning(const options *o, const machine *m)
{
    static const struct {
        gsd_target target;
        gsd_denoise_mode denoise;
        double goal;
        const char *name;
    } kind[] = {{GSD_TARGET_RADIANCE, GSD_DENOISE_DEFAULT, 80, "record + accumulate + refine, radiance"},
                {GSD_TARGET_RADIANCE, GSD_DENOISE_OFF, 0, "record + accumulate + refine, denoise off"},
                {GSD_TARGET_SWITCHING, GSD_DENOISE_DEFAULT, 80, "record + accumulate + refine, switching"}};
    int log2n = o->quick ? 18 : 22;
    printf(
        "\nlearning SF1, 2^%d samples in %d updates; limit: four passes over the 48 bytes of a sample at %.1f GB/s\n",
        log2n, SF1_UPDATES, m->bandwidth);
    validate_learning(o);
    bench_row_titles("ns per sample");
    double naive_ns = 0;
    gsd_desc resolved;
    check(gsd_resolve(&o->desc, &resolved), "resolve");
    naive_learner naive = naive_create(1000, (double)resolved.rho);
    for (int k = 0; k < 3; ++k) {
        gsd_stats stats;
        double best = 1e30, times[5];
        learning t, fastest = {0, 0, 0, 1};
        int repeats = o->quick ? 1 : 5;
        for (int repeat = 0; repeat < repeats; ++repeat) {
            gsd_desc desc = o->desc;
            desc.target = kind[k].target;
            desc.denoise = kind[k].denoise;
            bool first = k == 0 && repeat == 0;
            gsd_field *field = learn(&desc, log2n, 1, &t, first ? &naive : NULL, &naive_ns);
            naive_ns *= first ? 1e9 / (double)t.samples : 1; /* were seconds */
            double ns = (t.record + t.accumulate + t.refine) / (double)t.samples * 1e9;
            times[repeat] = ns;
            if (ns < best) {
                best = ns;
                fastest = t;
            }
            gsd_get_stats(field, &stats);
            gsd_destroy(field);
        }
        bench_row(kind[k].name, bench_summary(times, repeats), 4 * 48 / m->bandwidth, naive_ns, kind[k].goal);
        printf("    record %.1f, accumulate %.1f, refine %.1f ns/sample; %u cells, %.0f nodes and %.0f bytes per cell, "
               "%.1f bytes per node; mean depth %.1f\n",
               fastest.record / (double)fastest.samples * 1e9, fastest.accumulate / (double)fastest.samples * 1e9,
               fastest.refine / (double)fastest.samples * 1e9, stats.cells, (double)stats.nodes / stats.cells,
               (double)stats.bytes / stats.cells, (double)stats.bytes / (double)stats.nodes, (double)stats.mean_depth);
    }
    naive_free_space(naive.root);
}

/* ---- denoising ---------------------------------------------------------------------------------------------- */

/* Building trees of a learned field, with new samples in them: what refine denoises. */
typedef struct trees {
    gsd_field *field;
    double *mass, *work; /* [nodes] */
    unsigned char *depth;
    float *blur; /* [GSDI_BLUR_FLOATS * nodes] */
    uint64_t leaves;
} trees;

static trees make_trees(int log2n)
{
    trees t = {NULL, NULL, NULL, NULL, NULL, 0};
    learning time;
    gsd_desc desc;
    gsd_stream *stream;
    sf1_rng rng = {77};
    uint32_t n = (1u << log2n) / SF1_UPDATES;
    memset(&desc, 0, sizeof desc);
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    desc.target = GSD_TARGET_RADIANCE;
    t.field = learn(&desc, log2n, 5, &time, NULL, NULL);
    gsd_training_sample *samples = allocate(n, sizeof *samples);
    check(gsd_stream_create(t.field, &stream), "stream");
    check(gsd_record(stream, samples, draw_samples(&rng, n, 7, 0, samples)), "record");
    check(gsd_accumulate(t.field, &stream, 1, NULL, NULL), "accumulate");
    gsd_stream_destroy(stream);
    free(samples);
    uint32_t nodes = t.field->building_nodes;
    t.mass = allocate(nodes, sizeof *t.mass);
    t.work = allocate(nodes, sizeof *t.work);
    t.depth = allocate(nodes, 1);
    t.blur = allocate(nodes, GSDI_BLUR_FLOATS * sizeof *t.blur);
    for (uint32_t c = 0; c < gsd_cell_count(t.field); ++c) {
        const gsdi_state *s = &t.field->states[c];
        gsdi_tree_masses(t.field->child + s->first, t.field->sum + s->first, s->count, false, t.mass + s->first,
                         t.depth + s->first);
        t.leaves += (s->count - 1) / 4 * 3 + 1;
    }
    return t;
}

static void free_trees(trees *t)
{
    free(t->mass);
    free(t->work);
    free(t->depth);
    free(t->blur);
    gsd_destroy(t->field);
}

/* Denoise the tree of cell c; the masses are in t->work afterwards. */
static double denoise(const trees *t, uint32_t c)
{
    const gsdi_state *s = &t->field->states[c];
    gsdi_blur b = gsdi_blur_make(t->blur + GSDI_BLUR_FLOATS * (size_t)s->first, s->count, t->work + s->first);
    memcpy(b.mass, t->mass + s->first, s->count * sizeof *b.mass);
    if (s->count < 5 || !(b.mass[0] > 0))
        return 0;
    return gsdi_blur_tree(t->field->child + s->first, t->field->sum + s->first, t->depth + s->first, s->count, false,
                          &b);
}

static naive_blur denoise_naively(const trees *t, uint32_t c)
{
    const gsdi_state *s = &t->field->states[c];
    return naive_denoise(t->field->child + s->first, t->field->sum + s->first, s->count);
}

/* Masses at the strength that was found, and that strength, against the naive ones. */
static void validate_denoise(const trees *t, uint32_t cells)
{
    uint32_t blurred = 0;
    double worst = 0, apart = 0;
    for (uint32_t c = 0; c < cells; ++c) {
        const gsdi_state *s = &t->field->states[c];
        const double *mass = t->mass + s->first;
        double strength = denoise(t, c);
        naive_blur naive = denoise_naively(t, c);
        apart = fmax(apart, fabs(strength - naive.strength));
        blurred += strength > 0;
        for (uint32_t k = 0; k < s->count; ++k) {
            double to = mass[k] + strength * (naive.near[k] - mass[k]), got = t->work[s->first + k];
            if (!t->field->child[s->first + k] && mass[0] > 0)
                worst = fmax(worst, fabs(got - to) / (to + 1e-9 * mass[0]));
        }
        free(naive.near);
    }
    printf(
        "\ndenoising %u trees of %.0f leaves, %u of them blurred; checked: masses within %.1e, strength within %.3f\n",
        cells, (double)t->leaves / cells, blurred, worst, apart);
    if (worst > 1e-5 || apart > 0.04) /* both look in steps */
        fail("denoising does not agree with the naive one");
}

static void bench_denoise(const options *o, const machine *m)
{
    trees t = make_trees(18);
    uint32_t cells = gsd_cell_count(t.field);
    bench_time naive, time;
    validate_denoise(&t, cells);
    BENCH_TIME(naive, 3, t.leaves, {
        for (uint32_t c = 0; c < cells; ++c)
            free(denoise_naively(&t, c).near);
    });
    BENCH_TIME(time, o->repeats, t.leaves, {
        for (uint32_t c = 0; c < cells; ++c)
            denoise(&t, c);
    });
    bench_row_titles("ns per leaf");
    bench_row("denoise", time, 8 * m->cached, naive.min, 170);
    free_trees(&t);
}

static void run_micro(const options *o)
{
    gsd_stats stats;
    gsd_field *field = make_field(o, false), *alias_field = make_field(o, true);
    gsd_view view = gsd_get_view(field), alias = gsd_get_view(alias_field);
    static const uint32_t zero[3] = {0, 0, 0};
    gsd_get_stats(field, &stats);
    const gsdi_block *b = field->block, *ab = alias_field->block;
    size_t area[AREAS] = {4 * (GSDI_GRID + (size_t)b->spatial) + sizeof(gsd_cell) * b->cells,
                          sizeof(gsd_node) * (size_t)b->nodes, 4 * (size_t)b->jumps, 4 * (size_t)b->jumps,
                          sizeof(gsd_alias) * (size_t)ab->aliases};
    machine m;
    for (int k = 0; k < AREAS; ++k) {
        m.latency[k] = bench_load_latency(area[k]);
        m.throughput[k] = bench_load_throughput(area[k]);
    }
    m.cached = bench_load_throughput((size_t)1 << 18);
    m.bandwidth = bench_read_bandwidth();
    printf("field: %u cells, %.0f nodes each; sampling part %.1f MB, both parts %.1f MB: %.0f bytes per cell\n",
           stats.cells, (double)stats.nodes / stats.cells, (double)b->size * 1e-6, (double)stats.bytes * 1e-6,
           (double)stats.bytes / stats.cells);
    queries q = make_queries(o->queries, &view), sorted = sorted_queries(&q, &view);
    naive_space *root = naive_copy_field(field, &view, zero, 0);
    validate(&view, &q, root, false);
    validate(&alias, &q, root, true);
    bench_queries(o, &view, &alias, &q, &sorted, root, &m);
    free_queries(&q);
    free_queries(&sorted);
    naive_free_space(root);
    gsd_destroy(field);
    gsd_destroy(alias_field);
    bench_learning(o, &m);
    bench_denoise(o, &m);
}

/* ---- command line ------------------------------------------------------------------------------------------- */

static void set_option(gsd_desc *d, const char *text)
{
    char key[64];
    double value;
    if (sscanf(text, "%63[^=]=%lf", key, &value) != 2)
        fail("--set wants key=value");
    if (!strcmp(key, "split_samples"))
        d->split_samples = (float)value;
    else if (!strcmp(key, "rho"))
        d->rho = (float)value;
    else if (!strcmp(key, "max_depth"))
        d->max_depth = (uint32_t)value;
    else if (!strcmp(key, "min_samples"))
        d->min_samples = (uint32_t)value;
    else if (!strcmp(key, "uniform"))
        d->uniform = (float)value;
    else if (!strcmp(key, "target"))
        d->target = (gsd_target)value;
    else if (!strcmp(key, "spatial_filter"))
        d->spatial_filter = (gsd_spatial_filter)value;
    else if (!strcmp(key, "directional_filter"))
        d->directional_filter = (gsd_directional_filter)value;
    else if (!strcmp(key, "no_history"))
        d->no_history = value != 0;
    else if (!strcmp(key, "no_gate"))
        d->no_gate = value != 0;
    else
        fail("--set: unknown key");
}

static void parse(int argc, char **argv, options *o)
{
    for (int i = 1; i < argc; ++i) {
        const char *a = argv[i], *next = i + 1 < argc ? argv[i + 1] : NULL;
        if (!strcmp(a, "--quick"))
            o->quick = true;
        else if (!next)
            fail("unknown option, or its value is missing; the first lines of bench_sdtree.c list them");
        else if (!strcmp(a, "--set"))
            set_option(&o->desc, argv[++i]);
        else if (!strcmp(a, "--json")) {
            if (!(bench_json = fopen(argv[++i], "w")))
                fail("cannot write the JSON file");
        } else
            fail("unknown option; the first lines of bench_sdtree.c list them");
    }
}

int main(int argc, char **argv)
{
    options o;
    memset(&o, 0, sizeof o);
    o.desc.target = GSD_TARGET_RADIANCE;
    o.desc.bounds_max[0] = o.desc.bounds_max[1] = o.desc.bounds_max[2] = 1;
    parse(argc, argv, &o);
    o.repeats = o.quick ? 2 : 12;
    o.queries = o.quick ? 1 << 16 : 1 << 18;
    bench_print_machine(bench_json);
    run_micro(&o);
    bench_close_json();
    return 0;
}
