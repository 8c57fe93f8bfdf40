/* bench_denoise: what it costs to blur one layer of a quadtree, 2048 x 2048.

     build/bench_denoise [--quick] [--json FILE] [--sigma S]

   A quadtree of depth 11 with about 3,000 leaves, grown where samples of a few lights fall, is flattened and blurred by
   a 7 x 7 Gaussian. 10 % of its elements are not copies (in the thesis, where masking gained 17x, 6 % at most). First
   runs the ladder of J. Nilsson's thesis (Chalmers University of Technology and University of
   Gothenburg, Table 5.1: Core i7-3770K, mean of 100 runs), then the kernels of guide_sdtree.h. Every result is
   compared with the double-precision reference of the tests before it is timed. The kernels take turns, so that all
   were measured on the machine in the same mood, and each finds the caches full of another's matrices. */
#include "tests/denoise_naive.h"

#include "bench.h"
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#define DEPTH 11u
#define WIDTH (1u << DEPTH)
#define LEAVES 3000u
#define TILE 32
#define MARGIN 3u                   /* of the thesis's padded matrix */
#define PADDED (WIDTH + 2 * MARGIN) /* its width */
#define REPEATS BENCH_REPEATS

static void fail(const char *what)
{
    fprintf(stderr, "bench_denoise: %s\n", what);
    exit(1);
}

static void *allocate(size_t count, size_t size)
{
    size_t bytes = (count * size + 63) / 64 * 64;
    void *p = aligned_alloc(64, bytes);
    if (!p)
        fail("out of memory");
    memset(p, 0, bytes);
    return p;
}

/* ---- a tree ------------------------------------------------------------------------------------------------- */

static double uniform(uint64_t *seed) { return (double)(bench_random(seed) >> 11) * 0x1p-53; }

static double gaussian(uint64_t *seed)
{
    double radius = sqrt(-2 * log(1 - uniform(seed)));
    return radius * cos(6.283185307179586 * uniform(seed));
}

/* What is seen of a room: walls, a window, lamps, one of them smaller than an element; (phi, z) in [0, 1)^2. */
static const struct light {
    double share, x, y, size;
} lights[] = {{0.25, 0.62, 0.55, 0.012},  {0.20, 0.20, 0.80, 0.006},  {0.15, 0.21, 0.40, 0.004},
              {0.10, 0.995, 0.60, 0.003}, {0.10, 0.40, 0.985, 0.002}, {0.05, 0.75, 0.20, 0.0003}};

/* Samples in each element of the finest layer, and in each square of the layers above: level[d] is 2^d wide. */
typedef struct pyramid {
    uint32_t *level[DEPTH + 1];
} pyramid;

static pyramid draw_samples(uint32_t count)
{
    pyramid p;
    uint64_t seed = 5;
    for (uint32_t d = 0; d <= DEPTH; ++d)
        p.level[d] = allocate((size_t)1 << (2 * d), sizeof(uint32_t));
    for (uint32_t i = 0; i < count; ++i) {
        double x = uniform(&seed), y = uniform(&seed), choice = uniform(&seed);
        for (size_t k = 0; k < sizeof lights / sizeof *lights; ++k) {
            if (choice < lights[k].share) {
                x = lights[k].x + lights[k].size * gaussian(&seed);
                y = fmin(fmax(lights[k].y + lights[k].size * gaussian(&seed), 0), 1 - 1e-9);
                x -= floor(x);
                break;
            }
            choice -= lights[k].share;
        }
        uint32_t column = (uint32_t)(x * WIDTH) % WIDTH, row = (uint32_t)(y * WIDTH);
        for (uint32_t d = 0; d <= DEPTH; ++d)
            ++p.level[d][(size_t)(row >> (DEPTH - d) << d) + (column >> (DEPTH - d))];
    }
    return p;
}

typedef struct grown {
    uint32_t count, leaves, capacity;
    uint32_t *child;
    float *value;
} grown;

/* Squares with more than `threshold` samples are divided. */
static uint32_t grow(grown *t, const pyramid *p, uint32_t d, uint32_t x, uint32_t y, uint32_t threshold)
{
    uint32_t node = t->count++;
    if (node >= t->capacity)
        fail("the tree does not fit");
    for (uint32_t k = 0; k < 4; ++k) {
        uint32_t cx = 2 * x + (k & 1), cy = 2 * y + (k >> 1), n = p->level[d + 1][((size_t)cy << (d + 1)) + cx];
        bool divide = n > threshold && d + 1 < DEPTH;
        t->value[4 * node + k] = (float)n * 0x1p-20f;
        t->leaves += !divide;
        t->child[4 * node + k] = divide ? grow(t, p, d + 1, cx, cy, threshold) : 0;
    }
    return node;
}

static dn_tree make_tree(uint32_t *leaves)
{
    uint32_t samples = 1 << 20;
    pyramid p = draw_samples(samples);
    grown t = {0, 0, 8 * LEAVES, allocate(32 * LEAVES, sizeof(uint32_t)), allocate(32 * LEAVES, sizeof(float))};
    for (uint32_t threshold = samples / 100; threshold > 1 && t.leaves < LEAVES; threshold = threshold * 31 / 32) {
        t.count = t.leaves = 0;
        grow(&t, &p, 0, 0, 0, threshold);
    }
    dn_tree tree = dn_make_tree(t.count, t.child, t.value);
    *leaves = t.leaves;
    for (uint32_t d = 0; d <= DEPTH; ++d)
        free(p.level[d]);
    free(t.child);
    free(t.value);
    return tree;
}

/* Child links from gsd_tree's form to that of the building part: node 0 the root, the children of inner node i of the
   tree are 4 i + 1 .. 4 i + 4. */
static uint32_t *building_form(const dn_tree *t)
{
    uint32_t *child = allocate(4 * (size_t)t->count + 1, sizeof *child);
    child[0] = 1;
    for (uint32_t k = 0; k < 4 * t->count; ++k)
        child[k + 1] = t->child[k] ? 4 * t->child[k] + 1 : 0;
    return child;
}

/* ---- what is measured --------------------------------------------------------------------------------------- */

typedef struct data {
    dn_tree tree;
    uint32_t *building; /* the tree as refine has it: first of four children, 0 = leaf */
    float *plain;       /* WIDTH x WIDTH */
    float *thesis;      /* PADDED x PADDED and eight more, zeros around */
    float *own;         /* element (0, 0) of a matrix of guide_sdtree.h */
    float *out;         /* WIDTH x WIDTH */
    unsigned char *mask;
    float kernel[7][7], w[4];
    uint64_t *map;
    gsdi_gauss_run *run;
    size_t runs;
    gsdi_gauss_slot slot; /* to blur the whole tree in */
    gsdi_sum *sum;
    double *mass;
    unsigned char *height;
    gsd_simd simd;
} data;

typedef void (*kernel_fn)(data *d);

/* The weighted sum as section 2.3 describes it: nothing outside the matrix. */
static float window(const data *d, int row, int column)
{
    float sum = 0;
    for (int i = 0; i < 7; ++i)
        for (int j = 0; j < 7; ++j) {
            int r = row + i - 3, c = column + j - 3;
            if (r >= 0 && r < (int)WIDTH && c >= 0 && c < (int)WIDTH)
                sum += d->kernel[i][j] * d->plain[r * (int)WIDTH + c];
        }
    return sum;
}

static void run_naive(data *d)
{
    for (int row = 0; row < (int)WIDTH; ++row)
        for (int column = 0; column < (int)WIDTH; ++column)
            d->out[row * (int)WIDTH + column] = window(d, row, column);
}

static void run_masking(data *d)
{
    for (int row = 0; row < (int)WIDTH; ++row)
        for (int column = 0; column < (int)WIDTH; ++column) {
            int at = row * (int)WIDTH + column;
            d->out[at] = d->mask[at] ? window(d, row, column) : d->plain[at];
        }
}

static void run_padding(data *d)
{
    for (size_t row = 0; row < WIDTH; ++row)
        for (size_t column = 0; column < WIDTH; ++column) {
            const float *corner = d->thesis + row * PADDED + column;
            float sum = 0;
            if (!d->mask[row * WIDTH + column]) {
                d->out[row * WIDTH + column] = corner[MARGIN * PADDED + MARGIN];
                continue;
            }
            for (size_t i = 0; i < 7; ++i)
                for (size_t j = 0; j < 7; ++j)
                    sum += d->kernel[i][j] * corner[i * PADDED + j];
            d->out[row * WIDTH + column] = sum;
        }
}

#ifdef BENCH_X86
/* One pixel: seven rows of the window times seven rows of weights (the eighth weight is 0), summed across. The thesis
   gathers each row element by element; unaligned loads do here. */
__attribute__((target("avx2"), always_inline)) static inline float window_avx(const float *corner, const __m256 *k)
{
    __m256 sum = _mm256_mul_ps(k[0], _mm256_loadu_ps(corner));
    for (size_t i = 1; i < 7; ++i)
        sum = _mm256_add_ps(sum, _mm256_mul_ps(k[i], _mm256_loadu_ps(corner + i * PADDED)));
    __m128 four = _mm_add_ps(_mm256_castps256_ps128(sum), _mm256_extractf128_ps(sum, 1));
    __m128 two = _mm_add_ps(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)));
}

__attribute__((target("avx2"))) static void load_weights(const data *d, __m256 *k)
{
    for (int i = 0; i < 7; ++i) {
        float row[8] = {0};
        memcpy(row, d->kernel[i], sizeof d->kernel[i]);
        k[i] = _mm256_loadu_ps(row);
    }
}

__attribute__((target("avx2"))) static void run_avx(data *d)
{
    __m256 k[7];
    load_weights(d, k);
    for (size_t row = 0; row < WIDTH; ++row)
        for (size_t column = 0; column < WIDTH; ++column) {
            const float *corner = d->thesis + row * PADDED + column;
            size_t at = row * WIDTH + column;
            d->out[at] = d->mask[at] ? window_avx(corner, k) : corner[MARGIN * PADDED + MARGIN];
        }
}

__attribute__((target("avx2"))) static void run_tiling(data *d)
{
    __m256 k[7];
    load_weights(d, k);
    for (size_t rows = 0; rows < WIDTH; rows += TILE)
        for (size_t columns = 0; columns < WIDTH; columns += TILE)
            for (size_t row = rows; row < rows + TILE; ++row)
                for (size_t column = columns; column < columns + TILE; ++column) {
                    const float *corner = d->thesis + row * PADDED + column;
                    size_t at = row * WIDTH + column;
                    d->out[at] = d->mask[at] ? window_avx(corner, k) : corner[MARGIN * PADDED + MARGIN];
                }
}
#endif

/* The limit: every element read and written once, past the caches where the machine can. */
static void run_copy(data *d)
{
#ifdef BENCH_X86
    for (size_t i = 0; i < (size_t)WIDTH * WIDTH; i += 4)
        _mm_stream_ps(d->out + i, _mm_load_ps(d->plain + i));
    _mm_sfence();
#else
    memcpy(d->out, d->plain, (size_t)WIDTH * WIDTH * sizeof(float));
#endif
}

static void run_pad(data *d) { gsdi_gauss_pad(d->own, gsdi_gauss_stride(WIDTH), WIDTH, true); }
static void run_runs(data *d)
{
    gsdi_gauss_map(d->building, DEPTH, d->map);
    d->runs = gsdi_gauss_runs(d->map, WIDTH, d->run);
}
static void run_full(data *d) { gsdi_gauss_full_scalar(d->own, gsdi_gauss_stride(WIDTH), d->out, WIDTH, d->w); }
static void run_packed(data *d)
{
    gsdi_gauss_packed_scalar(d->own, gsdi_gauss_stride(WIDTH), d->out, d->run, d->runs, d->w);
}
#if GSDI_X86
static void run_full_avx2(data *d) { gsdi_gauss_full_avx2(d->own, gsdi_gauss_stride(WIDTH), d->out, WIDTH, d->w); }
static void run_full_avx512(data *d) { gsdi_gauss_full_avx512(d->own, gsdi_gauss_stride(WIDTH), d->out, WIDTH, d->w); }
static void run_packed_avx2(data *d)
{
    gsdi_gauss_packed_avx2(d->own, gsdi_gauss_stride(WIDTH), d->out, d->run, d->runs, d->w);
}
static void run_packed_avx512(data *d)
{
    gsdi_gauss_packed_avx512(d->own, gsdi_gauss_stride(WIDTH), d->out, d->run, d->runs, d->w);
}
#endif

#if GSDI_NEON
static void run_full_neon(data *d) { gsdi_gauss_full_neon(d->own, gsdi_gauss_stride(WIDTH), d->out, WIDTH, d->w); }
static void run_packed_neon(data *d)
{
    gsdi_gauss_packed_neon(d->own, gsdi_gauss_stride(WIDTH), d->out, d->run, d->runs, d->w);
}
#endif

/* All of it for one tree: layers 6 .. 11, merged, and the nodes of the new tree counted. */
static void run_tree(data *d)
{
    gsdi_gauss_blur(&d->slot, d->building, d->mass, d->height, d->simd, false, d->w);
    if (gsdi_gauss_rebuild(&d->slot, 0.01, d->building, d->sum, NULL, NULL, NULL) < 5)
        fail("the blurred tree is empty");
}

typedef enum check { CHECK_NONE, CHECK_THESIS, CHECK_OWN, CHECK_PACKED } check;

typedef struct kernel {
    const char *name;
    kernel_fn run;
    check check;
    int repeats;
    double target; /* times the copy; 0 = none */
    double thesis; /* ms, Table 5.1; 0 = not there */
    double times[REPEATS];
} kernel;

enum { COPY, NAIVE };

static kernel kernels[20];
static int kernel_count;

static void add(const char *name, kernel_fn run, check what, int repeats, double target, double thesis)
{
    kernel *k = &kernels[kernel_count++];
    k->name = name;
    k->run = run;
    k->check = what;
    k->repeats = repeats < REPEATS ? repeats : REPEATS;
    k->target = target;
    k->thesis = thesis;
}

/* ---- validation --------------------------------------------------------------------------------------------- */

/* Elements of active blocks, or all, within 1e-5 of the reference; others must not be written and need no blur. */
static double largest_error(const data *d, const double *truth, bool packed)
{
    double largest = 0;
    for (size_t row = 0; row < WIDTH; ++row)
        for (size_t column = 0; column < WIDTH; ++column) {
            size_t at = row * WIDTH + column, block = column / GSDI_GAUSS_COLUMNS;
            uint64_t word = d->map[row / GSDI_GAUSS_ROWS * gsdi_gauss_map_stride(WIDTH) + block / 64];
            bool active = !packed || (word >> (block % 64) & 1);
            double value = active ? (double)d->out[at] : (double)d->plain[at];
            double error = fabs(value - truth[at]) / (truth[at] > 0 ? truth[at] : 1);
            if (!active && !(d->out[at] < 0))
                fail("a packed kernel wrote outside its blocks");
            largest = error <= largest ? largest : error; /* NaN stays */
        }
    return largest;
}

/* Packed blocks to their places, from the last on: none overwrites one that comes later. */
static void unpack(data *d)
{
    size_t count = 0, elements = (size_t)WIDTH * WIDTH;
    float *packed = allocate(elements, sizeof(float)), *from = packed;
    memcpy(packed, d->out, elements * sizeof(float));
    for (size_t i = 0; i < elements; ++i)
        d->out[i] = -1;
    for (size_t i = 0; i < d->runs; ++i)
        for (size_t b = d->run[i].first; b < d->run[i].end; ++b, from += GSDI_GAUSS_BLOCK, ++count)
            for (size_t r = 0; r < GSDI_GAUSS_ROWS; ++r)
                memcpy(d->out + (d->run[i].row * GSDI_GAUSS_ROWS + r) * WIDTH + b * GSDI_GAUSS_COLUMNS,
                       from + r * GSDI_GAUSS_COLUMNS, GSDI_GAUSS_COLUMNS * sizeof(float));
    for (size_t i = count * GSDI_GAUSS_BLOCK; i < elements; ++i)
        if (!(packed[i] < 0))
            fail("a packed kernel wrote beyond its blocks");
    free(packed);
}

static void validate(data *d, const kernel *k, const dn_matrix *zero, const dn_matrix *sphere)
{
    for (int border = DN_ZERO; border <= DN_SPHERE; ++border) {
        if (k->check == CHECK_NONE || (k->check == CHECK_THESIS && border == DN_SPHERE))
            continue;
        gsdi_gauss_pad(d->own, gsdi_gauss_stride(WIDTH), WIDTH, border == DN_SPHERE);
        for (size_t i = 0; i < (size_t)WIDTH * WIDTH; ++i)
            d->out[i] = -1;
        k->run(d);
        if (k->check == CHECK_PACKED)
            unpack(d);
        double error = largest_error(d, border == DN_ZERO ? zero->v : sphere->v, k->check == CHECK_PACKED);
        printf("validated %-34s %-13s largest relative error %.1e\n", k->name,
               border == DN_ZERO ? "zeros around" : "sphere", error);
        if (!(error <= 1e-5))
            fail("a kernel does not agree with the reference");
    }
}

/* ---- main --------------------------------------------------------------------------------------------------- */

static data make_data(double sigma)
{
    data d;
    uint32_t leaves;
    size_t elements = (size_t)WIDTH * WIDTH, active = 0, blocks = 0, zero = 0;
    memset(&d, 0, sizeof d);
    d.tree = make_tree(&leaves);
    d.building = building_form(&d.tree);
    if (dn_depth(&d.tree, 0) != DEPTH)
        fail("the tree has another depth");
    dn_matrix m = dn_flatten(&d.tree, DEPTH);
    d.plain = allocate(elements, sizeof(float));
    d.out = allocate(elements, sizeof(float));
    d.thesis = allocate((size_t)PADDED * PADDED + 8, sizeof(float));
    d.own = (float *)allocate(gsdi_gauss_floats(WIDTH), sizeof(float)) + gsdi_gauss_origin(WIDTH);
    for (size_t row = 0; row < WIDTH; ++row)
        for (size_t column = 0; column < WIDTH; ++column) {
            float value = (float)m.v[row * WIDTH + column];
            d.plain[row * WIDTH + column] = value;
            d.thesis[(row + MARGIN) * PADDED + column + MARGIN] = value;
            d.own[row * gsdi_gauss_stride(WIDTH) + column] = value;
            zero += !(value > 0);
        }
    dn_free_matrix(&m);
    d.mask = dn_mask(&d.tree, DEPTH, DN_ZERO);
    for (size_t i = 0; i < elements; ++i)
        active += d.mask[i];
    double weight[7];
    dn_weights(sigma, weight);
    for (int i = 0; i < 7; ++i)
        for (int j = 0; j < 7; ++j)
            d.kernel[i][j] = (float)(weight[i] * weight[j]);
    gsdi_gauss_weights(sigma, d.w);
    d.map = allocate(gsdi_gauss_map_words(WIDTH), sizeof *d.map);
    d.run = allocate((size_t)WIDTH / GSDI_GAUSS_ROWS * (WIDTH / 8), sizeof *d.run);
    run_runs(&d);
    for (size_t i = 0; i < d.runs; ++i)
        blocks += (size_t)(d.run[i].end - d.run[i].first);
    printf(
        "tree: depth %u, %u leaves; sigma %.2f; %.1f %% of the elements are not copies, %.1f %% of the blocks of %u x "
        "%u, in %zu runs; %.1f %% are 0\n",
        DEPTH, leaves, sigma, 100 * (double)active / (double)elements,
        100 * (double)(blocks * GSDI_GAUSS_BLOCK) / (double)elements, GSDI_GAUSS_ROWS, GSDI_GAUSS_COLUMNS, d.runs,
        100 * (double)zero / (double)elements);
    return d;
}

static void make_slot(data *d)
{
    uint32_t count = 4 * d->tree.count + 1;
    unsigned char *depth = allocate(count, 1);
    uint64_t bytes[5];
    d->sum = allocate(count, sizeof *d->sum);
    d->mass = allocate(count, sizeof *d->mass);
    d->height = allocate(count, 1);
    for (uint32_t k = 0; k + 1 < count; ++k)
        d->sum[k + 1].half[0] = d->tree.child[k] ? 0 : d->tree.value[k];
    gsdi_tree_masses(d->building, d->sum, count, false, d->mass, depth);
    gsdi_gauss_heights(d->building, count, d->height);
    d->slot.depth = DEPTH;
    d->slot.memory = allocate(1, (size_t)gsdi_gauss_parts(DEPTH, bytes));
    gsdi_gauss_slot_cut(&d->slot, DEPTH);
    d->simd = gsdi_simd(GSD_SIMD_AUTO);
    free(depth);
}

static void list_kernels(bool quick)
{
    int slow = quick ? 1 : 4, medium = quick ? 2 : 16, fast = quick ? 4 : REPEATS;
    bool avx2 = false, avx512 = false;
#ifdef BENCH_X86
    avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
             __builtin_cpu_supports("avx512vl");
#endif
    add("non-temporal copy", run_copy, CHECK_NONE, fast, 0, 0);
    add("thesis: naive", run_naive, CHECK_THESIS, slow, 0, 250);
    add("thesis: + masking", run_masking, CHECK_THESIS, medium, 0, 14.7);
    add("thesis: + padding", run_padding, CHECK_THESIS, medium, 0, 13.4);
#ifdef BENCH_X86
    if (avx2) {
        add("thesis: + AVX", run_avx, CHECK_THESIS, medium, 0, 12.5);
        add("thesis: + tiling", run_tiling, CHECK_THESIS, medium, 0, 12.2);
    }
#endif
    add("separable, scalar", run_full, CHECK_OWN, medium, 0, 0);
#if GSDI_X86
    if (avx2)
        add("separable, AVX2", run_full_avx2, CHECK_OWN, fast, 3, 0);
    if (avx512)
        add("separable, AVX-512", run_full_avx512, CHECK_OWN, fast, 1.5, 0);
#endif
#if GSDI_NEON
    add("separable, NEON", run_full_neon, CHECK_OWN, fast, 0, 0);
#endif
    add("separable, masked, scalar", run_packed, CHECK_PACKED, medium, 0, 0);
#if GSDI_X86
    if (avx2)
        add("separable, masked, AVX2", run_packed_avx2, CHECK_PACKED, fast, 0.5, 0);
    if (avx512)
        add("separable, masked, AVX-512", run_packed_avx512, CHECK_PACKED, fast, 0.5, 0);
#endif
#if GSDI_NEON
    add("separable, masked, NEON", run_packed_neon, CHECK_PACKED, fast, 0, 0);
#endif
    add("fill the margins", run_pad, CHECK_NONE, fast, 0, 0);
    add("list the runs of blocks", run_runs, CHECK_NONE, fast, 0, 0);
    add("a whole tree, best level", run_tree, CHECK_NONE, medium, 0, 0);
    (void)avx2;
    (void)avx512;
}

static void print_rows(FILE *json)
{
    bench_time time[20];
    for (int k = 0; k < kernel_count; ++k)
        time[k] = bench_summary(kernels[k].times, kernels[k].repeats);
    printf("\n%-28s %9s %9s %6s %9s %9s %9s   target\n", "ms", "min", "median", "spread", "x copy", "faster", "thesis");
    for (int k = 0; k < kernel_count; ++k) {
        double ratio = time[k].min / time[COPY].min, target = kernels[k].target;
        printf("%-28s %9.3f %9.3f %5.0f%% %9.2f %8.1fx ", kernels[k].name, time[k].min * 1e-6, time[k].median * 1e-6,
               100 * time[k].spread, ratio, time[NAIVE].min / time[k].min);
        if (kernels[k].thesis > 0)
            printf("%9.1f", kernels[k].thesis);
        else
            printf("%9s", "");
        if (target > 0)
            printf("   <= %.1f x copy %s", target, ratio <= target ? "reached" : "missed");
        printf("\n");
        if (json)
            fprintf(json,
                    "%s\n  {\"name\": \"%s\", \"ns\": %.0f, \"median_ns\": %.0f, \"spread\": %.3f, \"limit_ns\": %.0f, "
                    "\"naive_ns\": %.0f, \"target_ns\": %.0f, \"thesis_ns\": %.0f}",
                    k ? "," : "", kernels[k].name, time[k].min, time[k].median, time[k].spread, time[COPY].min,
                    time[NAIVE].min, target * time[COPY].min, kernels[k].thesis * 1e6);
    }
}

int main(int argc, char **argv)
{
    bool quick = false;
    double sigma = 0.8; /* of the thesis's Fig. 5.3 */
    FILE *json = NULL;
    for (int i = 1; i < argc; ++i) {
        if (!strcmp(argv[i], "--quick"))
            quick = true;
        else if (!strcmp(argv[i], "--sigma") && i + 1 < argc)
            sigma = atof(argv[++i]);
        else if (!strcmp(argv[i], "--json") && i + 1 < argc) {
            if (!(json = fopen(argv[++i], "w")))
                fail("cannot write the JSON file");
        } else
            fail("unknown option, or its value is missing; the first lines of bench_denoise.c list them");
    }
    if (!(sigma >= 0.3 && sigma <= 100))
        fail("--sigma wants 0.3 .. 100");
    bench_print_machine(json);
    data d = make_data(sigma);
    make_slot(&d);
    dn_matrix m = dn_flatten(&d.tree, DEPTH);
    dn_matrix zero = dn_blur(&m, sigma, DN_ZERO, NULL), sphere = dn_blur(&m, sigma, DN_SPHERE, NULL);
    list_kernels(quick);
    for (int k = 0; k < kernel_count; ++k)
        validate(&d, &kernels[k], &zero, &sphere);
    dn_free_matrix(&m);
    dn_free_matrix(&zero);
    dn_free_matrix(&sphere);
    for (int repeat = 0; repeat < REPEATS; ++repeat)
        for (int k = 0; k < kernel_count; ++k)
            if (repeat < kernels[k].repeats) {
                double start = bench_seconds();
                kernels[k].run(&d);
                kernels[k].times[repeat] = (bench_seconds() - start) * 1e9;
                bench_use(d.out);
            }
    print_rows(json);
    if (json) {
        fprintf(json, "\n]}\n");
        fclose(json);
    }
    dn_free_tree(&d.tree);
    free(d.building);
    free(d.slot.memory);
    free(d.sum);
    free(d.mass);
    free(d.height);
    free(d.plain);
    free(d.thesis);
    free(d.own - gsdi_gauss_origin(WIDTH));
    free(d.out);
    free(d.mask);
    free(d.map);
    free(d.run);
    return 0;
}
