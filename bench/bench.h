/* bench.h: timing and machine limits shared by the microbenchmarks. Every figure is the minimum of several repeats,
   with their median and spread, and is printed next to a limit measured in the same run: the machine may be shared. */
#ifndef BENCH_H
#define BENCH_H

#include "statistics.h"

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#define BENCH_X86 1
#endif

static inline double bench_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Times of several repeats, per item, in nanoseconds. */
typedef struct bench_time {
    double min, median;
    double spread; /* (third quartile - first quartile) / median */
} bench_time;

/* Sorts the times. */
static inline bench_time bench_summary(double *times, int n)
{
    bench_time t = {0, 0, 0};
    if (n < 1)
        return t;
    qsort(times, (size_t)n, sizeof *times, ascending);
    t.min = times[0];
    t.median = 0.5 * (times[(n - 1) / 2] + times[n / 2]);
    t.spread = (times[3 * (n - 1) / 4] - times[(n - 1) / 4]) / t.median;
    return t;
}

/* Run `body` `repeats` times, at most BENCH_REPEATS; all times go into one summary. */
#define BENCH_REPEATS 64
#define BENCH_TIME(result, repeats, items, body)                                                                       \
    do {                                                                                                               \
        double bench_times[BENCH_REPEATS];                                                                             \
        int bench_n = (repeats) < BENCH_REPEATS ? (repeats) : BENCH_REPEATS;                                           \
        for (int bench_i = 0; bench_i < bench_n; ++bench_i) {                                                          \
            double bench_start = bench_seconds();                                                                      \
            body;                                                                                                      \
            bench_times[bench_i] = (bench_seconds() - bench_start) * 1e9 / (double)(items);                            \
        }                                                                                                              \
        (result) = bench_summary(bench_times, bench_n);                                                                \
    } while (0)

/* Run `body` `repeats` times; the smallest time per item in nanoseconds. */
#define BENCH_MIN_NS(result, repeats, items, body)                                                                     \
    do {                                                                                                               \
        double bench_best = 1e30;                                                                                      \
        for (int bench_i = 0; bench_i < (repeats); ++bench_i) {                                                        \
            double bench_start = bench_seconds();                                                                      \
            body;                                                                                                      \
            double bench_took = bench_seconds() - bench_start;                                                         \
            bench_best = bench_took < bench_best ? bench_took : bench_best;                                            \
        }                                                                                                              \
        (result) = bench_best * 1e9 / (double)(items);                                                                 \
    } while (0)

/* Keep a value alive without storing it. */
static inline void bench_use(const void *p)
{
#if defined(__GNUC__)
    __asm__ volatile("" : : "r"(p) : "memory");
#else
    static volatile const void *sink;
    sink = p;
#endif
}

static inline uint64_t bench_random(uint64_t *state)
{
    uint64_t z = (*state += UINT64_C(0x9e3779b97f4a7c15));
    z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
    return z ^ (z >> 31);
}

/* Nanoseconds of one dependent load from a random cycle through `bytes` of memory, a cache line per element. */
static inline double bench_load_latency(size_t bytes)
{
    size_t n = bytes / 64, stride = 16;
    uint32_t *next = malloc(n * 64), *order = malloc(n * sizeof *order);
    uint64_t seed = 1;
    double ns = 0;
    if (next && order) {
        for (size_t i = 0; i < n; ++i)
            order[i] = (uint32_t)i;
        for (size_t i = n - 1; i > 0; --i) {
            size_t j = bench_random(&seed) % (i + 1);
            uint32_t t = order[i];
            order[i] = order[j];
            order[j] = t;
        }
        for (size_t i = 0; i < n; ++i)
            next[order[i] * stride] = (uint32_t)(order[(i + 1) % n] * stride);
        uint32_t at = 0;
        size_t steps = 1 << 20;
        BENCH_MIN_NS(ns, 4, steps, {
            for (size_t i = 0; i < steps; ++i)
                at = next[at];
            bench_use(&next[at]);
        });
    }
    free(next);
    free(order);
    return ns;
}

/* Nanoseconds per load of a random cache line out of `bytes`, the loads independent of each other and their addresses
   known long before: what a perfectly interleaved search pays per line that it touches. */
static inline double bench_load_throughput(size_t bytes)
{
    size_t n = bytes / 64 + 1, steps = 1 << 20;
    uint64_t *data = malloc(n * 64), sum = 0, seed = 2;
    uint32_t *at = malloc(steps * sizeof *at);
    double ns = 0;
    if (data && at) {
        memset(data, 1, n * 64);
        for (size_t i = 0; i < steps; ++i)
            at[i] = (uint32_t)(bench_random(&seed) % n);
        BENCH_MIN_NS(ns, 4, steps, {
            for (size_t i = 0; i < steps; ++i)
                sum += data[8 * (size_t)at[i]];
            bench_use(&sum);
        });
    }
    free(data);
    free(at);
    return ns;
}

/* Bytes per nanosecond read from memory in order. */
static inline double bench_read_bandwidth(void)
{
    size_t n = (size_t)1 << 24; /* 128 MB */
    uint64_t *data = malloc(n * sizeof *data), sum = 0;
    double ns = 0;
    if (!data)
        return 0;
    memset(data, 1, n * sizeof *data);
    BENCH_MIN_NS(ns, 4, n * sizeof *data, {
        for (size_t i = 0; i < n; ++i)
            sum += data[i];
        bench_use(&sum);
    });
    free(data);
    return ns > 0 ? 1 / ns : 0;
}

#ifdef BENCH_X86
__attribute__((target("avx2,fma"))) static inline float bench_fma_chains(size_t steps)
{
    __m256 a[12], x = _mm256_set1_ps(0.999f), y = _mm256_set1_ps(0.001f);
    float out[8];
    for (int k = 0; k < 12; ++k)
        a[k] = _mm256_set1_ps((float)k);
    for (size_t i = 0; i < steps; ++i)
        for (int k = 0; k < 12; ++k)
            a[k] = _mm256_fmadd_ps(a[k], x, y);
    for (int k = 1; k < 12; ++k)
        a[0] = _mm256_add_ps(a[0], a[k]);
    _mm256_storeu_ps(out, a[0]);
    return out[0];
}

__attribute__((target("avx512f"))) static inline float bench_fma_chains_512(size_t steps)
{
    __m512 a[12], x = _mm512_set1_ps(0.999f), y = _mm512_set1_ps(0.001f);
    float out[16];
    for (int k = 0; k < 12; ++k)
        a[k] = _mm512_set1_ps((float)k);
    for (size_t i = 0; i < steps; ++i)
        for (int k = 0; k < 12; ++k)
            a[k] = _mm512_fmadd_ps(a[k], x, y);
    for (int k = 1; k < 12; ++k)
        a[0] = _mm512_add_ps(a[0], a[k]);
    _mm512_storeu_ps(out, a[0]);
    return out[0];
}
#endif

/* Fused multiply-adds in single precision on one core, GFLOP/s (two operations each); 0 = not measured here. */
static inline double bench_fma_peak(void)
{
#ifdef BENCH_X86
    size_t steps = 1 << 20;
    double ns;
    if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma"))
        return 0;
    BENCH_MIN_NS(ns, 6, steps * 12 * 8 * 2, {
        float sum = bench_fma_chains(steps);
        bench_use(&sum);
    });
    return 1 / ns;
#else
    return 0;
#endif
}

/* The same by vectors of 16 floats; 0 = the machine has none. */
static inline double bench_fma_peak_512(void)
{
#ifdef BENCH_X86
    size_t steps = 1 << 20;
    double ns;
    if (!__builtin_cpu_supports("avx512f"))
        return 0;
    BENCH_MIN_NS(ns, 6, steps * 12 * 16 * 2, {
        float sum = bench_fma_chains_512(steps);
        bench_use(&sum);
    });
    return 1 / ns;
#else
    return 0;
#endif
}

/* Milliseconds to copy a matrix of 2048 x 2048 floats, past the caches where the machine can. */
static inline double bench_copy_ms(void)
{
    size_t bytes = (size_t)2048 * 2048 * 4;
    char *from = aligned_alloc(64, bytes), *to = aligned_alloc(64, bytes);
    double ns = 0;
    if (from && to) {
        memset(from, 1, bytes);
        memset(to, 2, bytes);
        BENCH_MIN_NS(ns, 10, 1, {
#ifdef BENCH_X86
            for (size_t i = 0; i < bytes; i += 16)
                _mm_stream_si128((__m128i *)(void *)(to + i),
                                 _mm_load_si128((const __m128i *)(const void *)(from + i)));
            _mm_sfence();
#else
            memcpy(to, from, bytes);
#endif
            bench_use(to);
        });
    }
    free(from);
    free(to);
    return ns * 1e-6;
}

/* The processor's name. */
static inline void bench_cpu(char *name, size_t size)
{
    char line[256];
    FILE *f = fopen("/proc/cpuinfo", "r");
    snprintf(name, size, "unknown CPU");
    while (f && fgets(line, sizeof line, f))
        if (!strncmp(line, "model name", 10) && strchr(line, ':')) {
            snprintf(name, size, "%s", strchr(line, ':') + 2);
            name[strcspn(name, "\n")] = 0;
            break;
        }
    if (f)
        fclose(f);
}

static inline const char *bench_compiler(void)
{
#if defined(__clang__)
    return __VERSION__; /* names itself */
#elif defined(__GNUC__)
    return "gcc " __VERSION__;
#else
    return "unknown";
#endif
}

typedef struct bench_limits {
    double fma, fma_512; /* GFLOP/s of one core, by vectors of 8 and of 16 floats; 0 = not measured here */
} bench_limits;

/* What was measured, on what: the first lines of every benchmark. The Makefile tells flags and commit. */
static inline bench_limits bench_print_machine(FILE *json)
{
    char cpu[200];
    const char *flags = getenv("BENCH_FLAGS"), *commit = getenv("BENCH_COMMIT"), *compiler = bench_compiler();
    bench_cpu(cpu, sizeof cpu);
    double small = bench_load_latency((size_t)1 << 18), middle = bench_load_latency((size_t)1 << 22);
    double large = bench_load_latency((size_t)1 << 26), read = bench_read_bandwidth(), copy = bench_copy_ms();
    bench_limits limits = {bench_fma_peak(), bench_fma_peak_512()};
    printf("machine: %s; %s; flags: %s; commit: %s\n", cpu, compiler, flags ? flags : "not told",
           commit ? commit : "not told");
    printf(
        "limits:  FMA %.0f GFLOP/s, %.0f by AVX-512; copy of 2048^2 floats %.2f ms; memory read %.1f GB/s; random load "
        "256 KB %.1f ns, 4 MB %.1f ns, 64 MB %.1f ns\n",
        limits.fma, limits.fma_512, copy, read, small, middle, large);
    if (json)
        fprintf(json,
                "{\"machine\": {\"cpu\": \"%s\", \"compiler\": \"%s\", \"flags\": \"%s\", \"commit\": \"%s\", "
                "\"fma_gflops\": %.1f, \"fma_512_gflops\": %.1f, \"copy_ms\": %.3f, \"read_gb_s\": %.1f, "
                "\"load_ns\": [%.1f, %.1f, %.1f]},\n\"rows\": [",
                cpu, compiler, flags ? flags : "", commit ? commit : "", limits.fma, limits.fma_512, copy, read, small,
                middle, large);
    return limits;
}

/* ---- rows of a table, on screen and as JSON */

static FILE *bench_json;
static int bench_json_rows;

/* limit and naive in ns, 0 = none; target 0 = none. */
static inline void bench_row(const char *name, bench_time t, double limit, double naive, double target)
{
    printf("%-44s %8.2f %8.2f %5.0f%% %8.2f %6.2fx", name, t.min, t.median, 100 * t.spread, limit, t.min / limit);
    if (naive > 0)
        printf(" %8.1f %6.2fx", naive, naive / t.min);
    else
        printf(" %8s %7s", "-", "-");
    if (target > 0)
        printf("   <= %.1f %s", target, t.min <= target ? "reached" : "missed");
    printf("\n");
    if (bench_json)
        fprintf(bench_json,
                "%s\n  {\"name\": \"%s\", \"ns\": %.2f, \"median_ns\": %.2f, \"spread\": %.3f, \"limit_ns\": %.2f, "
                "\"naive_ns\": %.2f, \"target_ns\": %.1f}",
                bench_json_rows++ ? "," : "", name, t.min, t.median, t.spread, limit, naive, target);
}

static inline void bench_row_titles(const char *what)
{
    printf("\n%-44s %8s %8s %6s %8s %7s %8s %7s   target\n", what, "min", "median", "spread", "limit", "ratio", "naive",
           "faster");
}

static inline double bench_unit(uint64_t *state) { return (double)(bench_random(state) >> 11) * 0x1p-53; }

static inline void bench_direction(uint64_t *state, float *d)
{
    double z = 1 - 2 * bench_unit(state), phi = 6.283185307179586 * bench_unit(state), r = sqrt(1 - z * z);
    d[0] = (float)(r * cos(phi));
    d[1] = (float)(r * sin(phi));
    d[2] = (float)z;
}

/* --quick and --json FILE, which it opens. False: others, or the file cannot be written. */
static inline bool bench_options(int argc, char **argv, bool *quick)
{
    *quick = false;
    for (int i = 1; i < argc; ++i)
        if (!strcmp(argv[i], "--quick"))
            *quick = true;
        else if (strcmp(argv[i], "--json") || i + 1 >= argc || !(bench_json = fopen(argv[++i], "w")))
            return false;
    return true;
}

static inline void bench_close_json(void)
{
    if (!bench_json)
        return;
    fprintf(bench_json, "\n]}\n");
    fclose(bench_json);
}

#endif
