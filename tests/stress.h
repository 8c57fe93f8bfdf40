/* stress.h: frame of the stress tests. A program lists groups; a group is a function that runs one random case.

   Each group runs in a process of its own for its share of the time, in cases 0, 1, ... that depend on the seed and
   their number only. A case consists of tries; each ends refused (with the error that is documented) or survived
   (result checked); a failed check makes it lost. A crash, a hang and too much memory are lost tries too.
   Before that a group runs some cases with faults planted (stress.sabotage): a group that notices none of them cannot
   fail, which is a loss as well.

     --seconds S   for all groups together (default 30)    --seed N    default 1
     --only NAME   one group                               --cases N   so many cases a group, whatever they take: the
                                                                       same tries on every machine
     --case N      this case only, without a process of its own (for a debugger)
     --rows        rows of the table only                  --list      names of the groups

   Include it once, after defining _XOPEN_SOURCE 700. */
#ifndef STRESS_H
#define STRESS_H

#include <float.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define STRESS_MEMORY ((size_t)1 << 30) /* that a group may hold through stress_allocate */
#define STRESS_PLANTED 24               /* cases with a planted fault, at most */

/* What the process of a group tells its parent. */
typedef struct stress_tally {
    long tried, refused, survived, lost;
    long planted, noticed; /* cases with a fault planted, and lost as they must be */
    long at;               /* case that runs now, from 0 on; negative: with a planted fault */
    long megabytes;        /* most held by the process */
} stress_tally;

typedef struct stress {
    stress_tally *tally;
    const char *group;
    uint64_t seed, rng;
    long number;    /* of the case */
    bool sabotage;  /* plant a fault: something must be lost */
    bool failed;    /* the try that runs now */
    bool deviating; /* a fault was planted in this case */
    long outcomes;  /* tries ended in this case */
    int told;       /* losses printed */
} stress;

typedef struct stress_group {
    const char *name;
    void (*run)(stress *s); /* one case */
    double share;           /* of the time, relative */
    bool refuses;           /* hostile input: some tries must be refused */
} stress_group;

/* ---- random numbers */

static uint64_t stress_mix(uint64_t z)
{
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
}

static uint64_t stress_next(stress *s) { return stress_mix(s->rng += 0x9e3779b97f4a7c15ull); }
static double stress_unit(stress *s) { return (double)(stress_next(s) >> 11) * 0x1p-53; }
static float stress_unitf(stress *s) { return (float)(stress_next(s) >> 40) * 0x1p-24f; }
static uint32_t stress_below(stress *s, uint32_t n) { return (uint32_t)((stress_next(s) >> 32) * n >> 32); }
static bool stress_chance(stress *s, double p) { return stress_unit(s) < p; }
/* Even in the logarithm. */
static double stress_log(stress *s, double low, double high) { return low * pow(high / low, stress_unit(s)); }

/* ---- hostile numbers, samples, options, files */

#define PI 3.14159265358979323846

static float hostile_number(stress *s)
{
    const float some[] = {NAN,     INFINITY, -INFINITY, 0,       -0.0f, 1,        -1,    1e-40f,
                          FLT_MIN, -1e30f,   1e30f,     FLT_MAX, 0.5f,  -FLT_MAX, 1e18f, 1e-20f};
    return some[stress_below(s, sizeof some / sizeof *some)];
}

static inline void unit_direction(stress *s, float d[3])
{
    double z = 2 * stress_unit(s) - 1, phi = 2 * PI * stress_unit(s), r = sqrt(1 - z * z);
    d[0] = (float)(r * cos(phi));
    d[1] = (float)(r * sin(phi));
    d[2] = (float)z;
}

static inline void any_normal(stress *s, float n[3])
{
    unit_direction(s, n);
    if (stress_chance(s, 0.3))
        n[stress_below(s, 3)] = hostile_number(s);
    if (stress_chance(s, 0.1))
        memset(n, 0, 3 * sizeof *n);
}

/* Two numbers in [0, 1), often at the ends; a careless 1 too, which is clamped. */
static inline void any_random(stress *s, float u[2])
{
    const float ends[] = {0, 0x1p-149f, 0x1p-24f, 0.25f, 0.5f, 0x1.fffffep-2f, 0x1.fffffep-1f, 1};
    for (int k = 0; k < 2; ++k)
        u[k] = stress_chance(s, 0.3) ? ends[stress_below(s, 8)] : stress_unitf(s);
}

/* How the samples of a batch are made. */
typedef struct recipe {
    int where;     /* 0 anywhere, 1 one point, 2 a line, 3 cell borders, 4 outside, 5 anything */
    int direction; /* 0 anywhere, 1 one, 2 seam and poles, 3 not unit, 4 anything */
    int value;     /* 0 one, 1 any power of ten, 2 a lamp, 3 zeros, 4 anything */
    int pdf;       /* 0 uniform, 1 any power of ten, 2 anything */
    float point[3], lamp[3];
} recipe;

static inline recipe any_recipe(stress *s, bool hostile)
{
    recipe r = {(int)stress_below(s, hostile ? 6 : 4),
                (int)stress_below(s, hostile ? 5 : 3),
                (int)stress_below(s, hostile ? 5 : 4),
                hostile ? (int)stress_below(s, 3) : 0,
                {0, 0, 0},
                {0, 0, 0}};
    for (int k = 0; k < 3; ++k)
        r.point[k] = stress_unitf(s);
    unit_direction(s, r.lamp);
    return r;
}

static inline void any_position(stress *s, const recipe *r, const float low[3], const float high[3], float p[3])
{
    float t = stress_unitf(s);
    for (int k = 0; k < 3; ++k) {
        float size = high[k] - low[k], x = stress_unitf(s);
        switch (r->where) {
        case 1:
            x = r->point[k];
            break;
        case 2:
            x = r->point[k] * t;
            break;
        case 3: /* of the cube, which is 0.1 % larger */
            x = (float)stress_below(s, 65) / 64 * 1.001f - 0.0005f;
            break;
        case 4:
            x = (2 * x - 1) * (float)stress_log(s, 1, 1e12);
            break;
        }
        p[k] = low[k] + size * x;
        if (r->where == 5 && stress_chance(s, 0.2))
            p[k] = hostile_number(s) * 0.125f; /* three of them stay finite when summed */
    }
}

static inline void any_direction(stress *s, const recipe *r, float d[3])
{
    const float axes[][3] = {{1, 0, 0}, {1, -0.0f, 0}, {-1, 0, 0}, {0, 0, 1}, {0, 0, -1}, {0, 1, 0}, {1, -1e-30f, 0}};
    unit_direction(s, d);
    if (r->direction == 1)
        memcpy(d, r->lamp, sizeof r->lamp);
    if (r->direction == 2)
        memcpy(d, axes[stress_below(s, 7)], 3 * sizeof *d);
    if (r->direction == 3) {
        float l = (float)stress_log(s, 1e-5, 1e5);
        for (int k = 0; k < 3; ++k)
            d[k] *= l;
    }
    if (r->direction == 4 && stress_chance(s, 0.2))
        d[stress_below(s, 3)] = hostile_number(s);
    if (r->direction == 4 && stress_chance(s, 0.1))
        memset(d, 0, 3 * sizeof *d);
}

static inline float any_value(stress *s, const recipe *r, const float d[3])
{
    switch (r->value) {
    case 0:
        return 1;
    case 1:
        return (float)stress_log(s, 1e-30, 9e29);
    case 2:
        return d[0] * r->lamp[0] + d[1] * r->lamp[1] + d[2] * r->lamp[2] > 0.95f ? 1000 : stress_unitf(s);
    case 3:
        return stress_chance(s, 0.5) ? 0 : -0.0f;
    default:
        return stress_chance(s, 0.2) ? hostile_number(s) : stress_unitf(s);
    }
}

static inline float any_pdf(stress *s, const recipe *r)
{
    if (r->pdf == 1)
        return (float)stress_log(s, 1e-30, 1e30);
    return r->pdf == 2 && stress_chance(s, 0.1) ? hostile_number(s) : (float)(1 / (4 * PI));
}

static inline float any_distance(stress *s, bool hostile)
{
    if (hostile && stress_chance(s, 0.1))
        return hostile_number(s);
    return stress_chance(s, 0.3) ? INFINITY : (float)stress_log(s, 1e-3, 100);
}

static inline bool bad_value(float x) { return !(x >= 0) || !isfinite(x) || !((double)x < 9.9e29); }

static uint32_t some(stress *s, double most) { return (uint32_t)stress_log(s, 1, most); }

/* A number in a descriptor and its range. */
typedef struct stress_limit {
    size_t at;
    bool whole;
    double low, high;
} stress_limit;
#define STRESS_LIMIT(desc, name, whole, low, high)                                                                     \
    {                                                                                                                  \
        offsetof(desc, name), whole, low, high                                                                         \
    }

/* Put one option at or beyond a limit; true where it must be refused. */
static inline bool set_extreme(stress *s, void *d, const stress_limit *limits, size_t count)
{
    const stress_limit *l = &limits[stress_below(s, (uint32_t)count)];
    const double beyond[] = {l->low * 0.9, l->high * 1.1 + 1, -1, NAN, INFINITY, -l->high, 1e-40};
    uint32_t kind = stress_below(s, 14);
    double x = kind < 7 ? beyond[kind] : kind < 10 ? l->low : kind < 13 ? l->high : 0;
    if (l->whole) {
        uint32_t n = kind < 7 ? (uint32_t)l->high + 1 + stress_below(s, 0x7fffffff) : (uint32_t)x;
        memcpy((char *)d + l->at, &n, sizeof n);
    } else {
        float v = (float)x;
        memcpy((char *)d + l->at, &v, sizeof v);
    }
    return kind < 7;
}

/* Bounds of all sizes and places, and the largest extent; false where they must be refused. */
static inline bool set_bounds(stress *s, float bounds_min[3], float bounds_max[3], double *extent)
{
    bool bad = false;
    *extent = 0;
    for (int k = 0; k < 3; ++k) {
        float size = stress_chance(s, 0.2) ? 0 : (float)stress_log(s, 1e-29, 1e29);
        float low = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 1e-20, 1e20) * (stress_chance(s, 0.5) ? -1 : 1);
        low = stress_chance(s, 0.2) ? -0.0f : low;
        bounds_min[k] = stress_chance(s, 0.03) ? hostile_number(s) : low;
        bounds_max[k] = stress_chance(s, 0.03) ? hostile_number(s) : low + size;
        bad |= !isfinite(bounds_min[k]) || !isfinite(bounds_max[k]) || bounds_max[k] < bounds_min[k];
        *extent = fmax(*extent, (double)bounds_max[k] - (double)bounds_min[k]);
        bad |= !(*extent < 1e30) || !(fabsf(bounds_min[k]) < 1e30f);
    }
    return !bad;
}

static const char *forge(stress *s, unsigned char *data, size_t *size, const unsigned char *other, size_t other_size)
{
    size_t at = stress_chance(s, 0.5) ? stress_below(s, 700) % *size : stress_below(s, (uint32_t)*size), n;
    uint32_t word = stress_chance(s, 0.2) ? 0xffffffffu : (uint32_t)stress_next(s) >> stress_below(s, 32);
    switch (stress_below(s, 5)) {
    case 0:
        data[at] ^= (unsigned char)(1u << stress_below(s, 8));
        return "bit";
    case 1:
        *size = at;
        return "cut";
    case 2: /* a piece of another save, at the same place or elsewhere */
        n = some(s, (double)other_size);
        n = n < *size - at ? n : *size - at;
        memcpy(data + at, other + (at + n <= other_size ? at : 0), n < other_size ? n : other_size);
        return "splice";
    case 3: /* lengths and counts stand in the headers */
        at = stress_below(s, 700) / 4 * 4;
        break;
    }
    at = at / 4 * 4;
    if (at + 4 <= *size)
        memcpy(data + at, &word, 4);
    return "word";
}

/* ---- outcomes */

__attribute__((format(printf, 2, 3))) static void stress_fail(stress *s, const char *format, ...)
{
    va_list arguments;
    s->failed = true;
    if (s->sabotage || s->told++ >= 5)
        return;
    fprintf(stderr, "lost: %s, case %ld: ", s->group, s->number);
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fprintf(stderr, "   [--seed %llu --only %s --case %ld]\n", (unsigned long long)s->seed, s->group, s->number);
}

/* Whether the condition holds; the try is lost where not. */
#define STRESS_CHECK(s, condition, ...) ((condition) ? true : (stress_fail((s), __VA_ARGS__), false))

static void stress_end(stress *s, bool refused)
{
    s->tally->tried++;
    s->outcomes++;
    if (s->failed)
        s->tally->lost++;
    else if (refused)
        s->tally->refused++;
    else
        s->tally->survived++;
    s->failed = false;
}

static void stress_survived(stress *s) { stress_end(s, false); }

/* ---- an allocator that counts and fails */

typedef struct stress_memory {
    long live, requests;
    long fail_at;    /* this request fails; 0 = none */
    long fail_every; /* and each multiple of this */
    long failed;
    size_t bytes, peak;
} stress_memory;

static void *stress_allocate(void *user, size_t size)
{
    stress_memory *m = user;
    unsigned char *p;
    m->requests++;
    if ((m->fail_at && m->requests == m->fail_at) || (m->fail_every && m->requests % m->fail_every == 0) ||
        size > STRESS_MEMORY || m->bytes + size > STRESS_MEMORY || !(p = malloc(size + 16))) {
        m->failed++;
        return NULL;
    }
    memcpy(p, &size, sizeof size);
    memset(p + 16, 0xa5, size < 4096 ? size : 4096);
    m->live++;
    m->bytes += size;
    m->peak = m->bytes > m->peak ? m->bytes : m->peak;
    return p + 16;
}

static void stress_release(void *user, void *pointer)
{
    stress_memory *m = user;
    unsigned char *p = pointer;
    size_t size;
    if (!p)
        return;
    memcpy(&size, p - 16, sizeof size);
    m->live--;
    m->bytes -= size;
    free(p - 16);
}

/* ---- a parallel_for on threads; pieces are handed out from the end */

typedef struct stress_crowd {
    int threads; /* 1 .. 8 */
} stress_crowd;

typedef struct stress_job {
    void (*fn)(void *context, uint32_t begin, uint32_t end);
    void *context;
    uint32_t count, grain, threads, me;
} stress_job;

static void *stress_thread(void *p)
{
    const stress_job *j = p;
    uint32_t pieces = j->count / j->grain + (j->count % j->grain != 0), k;
    for (k = j->me; k < pieces; k += j->threads) {
        uint32_t begin = (pieces - 1 - k) * j->grain;
        uint32_t end = j->count - begin < j->grain ? j->count : begin + j->grain;
        j->fn(j->context, begin, end);
    }
    return NULL;
}

static void stress_parallel(void *user, uint32_t count, uint32_t grain, void (*fn)(void *, uint32_t, uint32_t),
                            void *context)
{
    uint32_t threads = (uint32_t)((const stress_crowd *)user)->threads, i;
    pthread_t thread[8];
    stress_job job[8];
    bool started[8];
    for (i = 0; i < threads; ++i) {
        job[i] = (stress_job){fn, context, count, grain ? grain : 1, threads, i};
        started[i] = pthread_create(&thread[i], NULL, stress_thread, &job[i]) == 0;
        if (!started[i])
            stress_thread(&job[i]);
    }
    for (i = 0; i < threads; ++i)
        if (started[i])
            pthread_join(thread[i], NULL);
}

/* ---- the run */

typedef struct stress_options {
    double seconds;
    uint64_t seed;
    const char *only;
    long cases, number; /* -1 = by time; -1 = all */
    bool rows;
} stress_options;

static double stress_clock(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void stress_one(stress *s, const stress_group *g, long number)
{
    const char *c;
    s->number = number;
    s->rng = s->seed;
    for (c = g->name; *c; ++c)
        s->rng = stress_mix(s->rng + (unsigned char)*c);
    s->rng = stress_mix(s->rng ^ ((uint64_t)number * 0x9e3779b97f4a7c15ull + 1));
    s->outcomes = 0;
    s->failed = s->deviating = false;
    s->tally->at = s->sabotage ? -1 - number : number;
    g->run(s);
    if (s->failed || s->outcomes == 0) {
        if (!s->failed)
            stress_fail(s, "the case ended without an outcome");
        stress_survived(s);
    }
}

/* Faults on purpose, all of them or by time. What they cost and give does not count. */
static void stress_plant(stress *s, const stress_group *g, bool all, double seconds)
{
    stress_tally keep = *s->tally;
    double end = stress_clock() + seconds;
    long i;
    s->sabotage = true;
    for (i = 0; i < STRESS_PLANTED && (all || i < 4 || stress_clock() < end); ++i) {
        long lost = s->tally->lost;
        stress_one(s, g, i);
        keep.planted += s->deviating;
        keep.noticed += s->deviating && s->tally->lost > lost;
    }
    s->sabotage = false;
    *s->tally = keep;
}

/* All cases of a group, in its own process. */
static void stress_cases(stress *s, const stress_group *g, const stress_options *o, double seconds)
{
    struct rusage usage;
    double end;
    long i;
    alarm(o->cases >= 0 ? 1800 : (unsigned)(20 * seconds) + 120); /* a case that hangs */
    stress_plant(s, g, o->cases >= 0, 0.15 * seconds);
    end = stress_clock() + 0.85 * seconds;
    for (i = 0; o->cases >= 0 ? i < o->cases : i < 1 || stress_clock() < end; ++i)
        stress_one(s, g, i);
    if (getrusage(RUSAGE_SELF, &usage) == 0) {
        s->tally->megabytes = usage.ru_maxrss / 1024;
#ifdef __APPLE__
        s->tally->megabytes /= 1024;
#endif
    }
}

/* Run a group as a child process; false = something was lost. */
static bool stress_run(const stress_group *g, const char *program, const stress_options *o, double seconds,
                       stress_tally *tally)
{
    stress s = {.tally = tally, .group = g->name, .seed = o->seed};
    double start = stress_clock();
    int status = 0;
    pid_t child;
    memset(tally, 0, sizeof *tally);
    fflush(NULL);
    child = fork();
    if (child == 0) {
        stress_cases(&s, g, o, seconds);
        exit(0); /* not _exit: leak checkers look now */
    }
    if (child < 0 || waitpid(child, &status, 0) != child || status != 0) {
        stress_tally before = *tally;
        s.number = before.at < 0 ? -1 - before.at : before.at;
        stress_fail(&s, "%s, status %d%s",
                    WIFSIGNALED(status) && WTERMSIG(status) == SIGALRM ? "hangs" : "the process ended early", status,
                    before.at < 0 ? ", with a planted fault" : "");
        stress_survived(&s);
    }
    if (tally->noticed == 0) {
        stress_fail(&s, "cannot fail: none of %ld planted faults was noticed", tally->planted);
        stress_survived(&s);
    }
    if (g->refuses && tally->refused == 0 && o->cases < 0) {
        stress_fail(&s, "nothing was refused");
        stress_survived(&s);
    }
    printf("%-8s %-20s %9ld %9ld %9ld %6ld %5ld/%-3ld %7.1f %6ld\n", program, g->name, tally->tried, tally->refused,
           tally->survived, tally->lost, tally->noticed, tally->planted, stress_clock() - start, tally->megabytes);
    return tally->lost == 0;
}

#define STRESS_HEADER "header   group                    tried   refused  survived   lost    faults seconds     MB\n"

static bool stress_argument(stress_options *o, const char *name, const char *value)
{
    if (strcmp(name, "--seconds") == 0)
        o->seconds = atof(value);
    else if (strcmp(name, "--seed") == 0)
        o->seed = strtoull(value, NULL, 10);
    else if (strcmp(name, "--only") == 0)
        o->only = value;
    else if (strcmp(name, "--cases") == 0)
        o->cases = atol(value);
    else if (strcmp(name, "--case") == 0)
        o->number = atol(value);
    else
        return false;
    return true;
}

static bool stress_arguments(stress_options *o, int argc, char **argv)
{
    int i;
    for (i = 1; i < argc; ++i) {
        if (strcmp(argv[i], "--rows") == 0)
            o->rows = true;
        else if (i + 1 >= argc || !stress_argument(o, argv[i], argv[i + 1]))
            return false;
        else
            ++i;
    }
    return o->seconds > 0 && o->seconds < 1e5 && (o->number < 0 || o->only);
}

/* One case in this process. */
static int stress_debug(const stress_group *g, const stress_options *o)
{
    stress_tally tally = {0};
    stress s = {.tally = &tally, .group = g->name, .seed = o->seed};
    stress_one(&s, g, o->number);
    printf("%s, case %ld: %ld tried, %ld refused, %ld survived, %ld lost\n", g->name, o->number, tally.tried,
           tally.refused, tally.survived, tally.lost);
    return tally.lost != 0;
}

static int stress_main(int argc, char **argv, const char *program, const stress_group *groups, int count)
{
    stress_options o = {.seconds = 30, .seed = 1, .cases = -1, .number = -1};
    FILE *file = tmpfile();
    stress_tally *tally = NULL;
    double shares = 0;
    int i, ran = 0;
    bool good = true;
    for (i = 0; argc == 2 && strcmp(argv[1], "--list") == 0 && i < count; ++i)
        printf("%s\n", groups[i].name);
    if (i)
        return 0;
    if (!stress_arguments(&o, argc, argv)) {
        fprintf(stderr, "usage: [--seconds S] [--seed N] [--only NAME [--case N]] [--cases N] [--rows] | --list\n");
        return 2;
    }
    if (file && ftruncate(fileno(file), sizeof *tally) == 0)
        tally = mmap(NULL, sizeof *tally, PROT_READ | PROT_WRITE, MAP_SHARED, fileno(file), 0);
    if (!tally || tally == MAP_FAILED)
        return fprintf(stderr, "no room for the tally\n"), 2;
    for (i = 0; i < count; ++i)
        shares += o.only && strcmp(o.only, groups[i].name) != 0 ? 0 : groups[i].share;
    if (!o.rows && o.number < 0)
        printf("seed %llu\n%s", (unsigned long long)o.seed, STRESS_HEADER);
    for (i = 0; i < count; ++i) {
        if (o.only && strcmp(o.only, groups[i].name) != 0)
            continue;
        ran++;
        if (o.number >= 0)
            return stress_debug(&groups[i], &o);
        good = stress_run(&groups[i], program, &o, o.seconds * groups[i].share / shares, tally) && good;
    }
    if (ran == 0 && !o.rows)
        fprintf(stderr, "no such group: see --list\n");
    return ran == 0 ? 3 : !good; /* 3: --only names another program's group */
}

#endif
