/* bench.h: timing and machine limits shared by the microbenchmarks. Every figure is the minimum of several repeats and
   is printed next to a limit measured in the same run: the machine may be shared. */
#ifndef BENCH_H
#define BENCH_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static inline double bench_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Run `body` `repeats` times; the smallest time per item in nanoseconds. */
#define BENCH_MIN_NS(result, repeats, items, body)                                                                     \
    do {                                                                                                               \
        double bench_best = 1e30;                                                                                      \
        for (int bench_i = 0; bench_i < (repeats); ++bench_i) {                                                        \
            double bench_start = bench_seconds();                                                                      \
            body;                                                                                                      \
            double bench_time = bench_seconds() - bench_start;                                                         \
            bench_best = bench_time < bench_best ? bench_time : bench_best;                                            \
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

/* Nanoseconds per load of a random cache line out of `bytes`, the loads independent of each other: what a perfectly
   interleaved search pays per line that it touches. */
static inline double bench_load_throughput(size_t bytes)
{
    size_t n = bytes / 64, steps = 1 << 20;
    uint64_t *data = malloc(n * 64), sum = 0;
    double ns = 0;
    if (data && n) {
        memset(data, 1, n * 64);
        BENCH_MIN_NS(ns, 4, steps, {
            for (uint32_t i = 0; i < steps; ++i) {
                uint32_t h = i * UINT32_C(0x9e3779b1);
                h = (h ^ (h >> 15)) * UINT32_C(0x85ebca6b);
                sum += data[8 * (size_t)(((uint64_t)h * n) >> 32)];
            }
            bench_use(&sum);
        });
    }
    free(data);
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

/* What was measured, on what: the first lines of every benchmark. */
static inline void bench_print_machine(void)
{
    char line[256], cpu[200] = "unknown CPU";
    FILE *f = fopen("/proc/cpuinfo", "r");
    while (f && fgets(line, sizeof line, f))
        if (!strncmp(line, "model name", 10) && strchr(line, ':')) {
            snprintf(cpu, sizeof cpu, "%s", strchr(line, ':') + 2);
            cpu[strcspn(cpu, "\n")] = 0;
            break;
        }
    if (f)
        fclose(f);
#if defined(__VERSION__)
    printf("machine: %s; compiler: %s\n", cpu, __VERSION__);
#else
    printf("machine: %s\n", cpu);
#endif
    printf("limits:  random load 256 KB %.1f ns, 4 MB %.1f ns, 64 MB %.1f ns; memory read %.1f GB/s\n",
           bench_load_latency((size_t)1 << 18), bench_load_latency((size_t)1 << 22),
           bench_load_latency((size_t)1 << 26), bench_read_bandwidth());
}

#endif
