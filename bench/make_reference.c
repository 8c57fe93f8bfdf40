/* make_reference: a reference picture that knows its own error and that a second method agrees with.

     build/make_reference SCENE.xml -o REF.exr [options]; --help lists them

   Rounds with different seeds are averaged; their spread gives the variance of the mean, and with it the relMSE that
   the reference itself has. Rounds go on until that is small against the error to be measured (--ratio). Every fourth
   round is of another method, and tiles of both means must agree. After each round the sums are kept in --state, so
   that a later call goes on where this one stopped; the result is the same, bit for bit, as without the interruption.
   Where the sums are gone, --add has the picture that they made take part.

     >>options   command line
     >>settings  what a state belongs to: text and hash
     >>round     one render in a process of its own: a crash or a lack of memory costs one round; the scene's files
     >>state     sums on disk
     >>added     an earlier picture that takes part
     >>error     relMSE of the mean, and of the run that is to be measured
     >>check     z-test over tiles
     >>output    EXR with its history, heat map
     >>main      loop */
#define _POSIX_C_SOURCE 200809L
#include "options.h"
#include "statistics.h"
#include "threads.h"
#include "tracer.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#define MAX_OPTIONS 32
#define PATH_SIZE 1024
#define TILE 16
#define CHECK_EVERY 4     /* one round in so many is of the check's method */
#define MIN_ROUNDS 4      /* of each method: two in each half, the least that has a variance */
#define CONSISTENT 2.0    /* halves whose variances differ by more have met rare bright paths: no normal distribution */
#define CHECK_ALPHA 0.01  /* chance of refusing a good reference, all tiles together */
#define PROGRAM_FAILED 1  /* exit status: an error, or the methods disagree */
#define PROGRAM_ENOUGH 0  /* as good as was asked for */
#define PROGRAM_TOO_FEW 2 /* written, but not yet as good as was asked for, or not checked */

enum { MAIN, CHECK, METHODS };

typedef struct options {
    const char *scene, *out, *method, *check, *check_scene, *add, *rr;
    const char *state_dir;
    bool cache, quiet, no_nee;
    int width, height, max_depth, threads, rounds;
    int spp[METHODS]; /* of a round; 0 = found by a first short run */
    uint64_t seed;
    double measured, ratio, seconds, round_seconds, measure_seconds;
    tr_option set[MAX_OPTIONS];
    int set_count;
    tr_define defines[MAX_OPTIONS];
    int define_count;
    tr_roulette roulette;
} options;

static const char usage_text[] =
    "usage: make_reference SCENE -o REF.exr [options]\n"
    "  --method NAME          renders the reference (default sdtree)   [--set key=value]\n"
    "  --check NAME           another method that must agree with it (default pt), every fourth round\n"
    "  --check-scene SCENE    what the check renders, where it is another description of the same scene\n"
    "  --size WxH             default 320x180\n"
    "  --max-depth D          default: the scene's\n"
    "  --nee on|off, --rr guided|off|on, -D name=value   as render has them\n"
    "  --ratio N              go on until the reference's own relMSE is 1/N (default 50) of the one to be measured\n"
    "  --measured RELMSE      the relMSE that is to be measured; without it a run is made, of\n"
    "  --measure-seconds S    CPU seconds (default 60)\n"
    "  --seconds S            stop after so many CPU seconds of this call; a later call goes on\n"
    "  --rounds N             stop at N rounds of both methods, earlier calls' included, however good\n"
    "  --round-seconds S      CPU seconds of a round, about (default 60)\n"
    "  --round-spp N, --check-spp N   samples of a round instead\n"
    "  --state DIR            where sums are kept (default out/references)\n"
    "  --add OLD.exr          take an earlier reference of the same scene in, made with another --seed; it and the "
    "rounds\n"
    "                         weigh by 1 / their own relMSE\n"
    "  --cache                write DIR/HASH.exr, for scenes that are not part of the project, instead of -o\n"
    "  --seed N, --threads N, --quiet\n"
    "exit status: 0 = as good as asked for, 2 = written but not yet so good (call it again), 1 = refused or failed\n";

/* ---- >>options ---------------------------------------------------------------------------------------------- */

static int die(const char *format, ...)
{
    va_list args;
    va_start(args, format);
    fputs("make_reference: error: ", stderr);
    vfprintf(stderr, format, args);
    fputc('\n', stderr);
    va_end(args);
    return PROGRAM_FAILED;
}

static bool parse_int(const char *text, long min, long max, int *value)
{
    char *end;
    errno = 0;
    long v = strtol(text, &end, 10);
    *value = (int)v;
    return errno == 0 && end != text && *end == 0 && v >= min && v <= max;
}

static bool parse_positive(const char *text, double *value)
{
    char *end;
    *value = strtod(text, &end);
    return end != text && *end == 0 && isfinite(*value) && *value > 0;
}

static bool apply_text(options *o, const char *name, const char *value)
{
    struct {
        const char *name, **to;
    } texts[] = {{"-o", &o->out},        {"--output", &o->out},      {"--method", &o->method},
                 {"--check", &o->check}, {"--state", &o->state_dir}, {"--check-scene", &o->check_scene},
                 {"--add", &o->add}};
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; ++i)
        if (!strcmp(name, texts[i].name)) {
            *texts[i].to = value;
            return true;
        }
    return false;
}

/* Options that are one number. 1 = applied, 0 = not one of them, -1 = not a usable value. */
static int apply_number(options *o, const char *name, const char *value)
{
    struct {
        const char *name;
        double *to;
    } reals[] = {{"--ratio", &o->ratio},
                 {"--measured", &o->measured},
                 {"--seconds", &o->seconds},
                 {"--round-seconds", &o->round_seconds},
                 {"--measure-seconds", &o->measure_seconds}};
    struct {
        const char *name;
        int *to, max;
    } whole[] = {{"--max-depth", &o->max_depth, TR_MAX_DEPTH},
                 {"--threads", &o->threads, 256},
                 {"--rounds", &o->rounds, 1 << 24},
                 {"--round-spp", &o->spp[MAIN], 1 << 24},
                 {"--check-spp", &o->spp[CHECK], 1 << 24}};
    for (size_t i = 0; i < sizeof reals / sizeof reals[0]; ++i)
        if (!strcmp(name, reals[i].name))
            return parse_positive(value, reals[i].to) ? 1 : -1;
    for (size_t i = 0; i < sizeof whole / sizeof whole[0]; ++i)
        if (!strcmp(name, whole[i].name))
            return parse_int(value, 1, whole[i].max, whole[i].to) ? 1 : -1;
    return 0;
}

/* One option with its value; false = the value is not usable. */
static bool apply(options *o, const char *name, char *value, bool *known)
{
    int number = apply_number(o, name, value), seed;
    *known = true;
    if (number || apply_text(o, name, value))
        return number >= 0;
    if (!strcmp(name, "--size"))
        return parse_size(value, &o->width, &o->height);
    if (!strcmp(name, "--seed")) {
        bool ok = parse_int(value, 0, INT_MAX, &seed);
        o->seed = (uint64_t)seed;
        return ok;
    }
    if (!strcmp(name, "--rr")) {
        o->rr = value;
        return parse_roulette(value, &o->roulette);
    }
    if (!strcmp(name, "--nee")) {
        o->no_nee = !strcmp(value, "off");
        return o->no_nee || !strcmp(value, "on");
    }
    if (!strcmp(name, "--set") && o->set_count < MAX_OPTIONS) {
        tr_option *s = &o->set[o->set_count++];
        return parse_pair(value, &s->key, &s->value);
    }
    if (!strcmp(name, "-D") && o->define_count < MAX_OPTIONS) {
        tr_define *d = &o->defines[o->define_count++];
        return parse_pair(value, &d->name, &d->value);
    }
    *known = false;
    return true;
}

static int check_options(const options *o)
{
    if (!o->scene)
        return die("no scene given; run make_reference --help");
    if (!o->out == !o->cache)
        return die("give either -o REF.exr or --cache");
    if (!tr_method_find(o->method) || !tr_method_find(o->check))
        return die("unknown method '%s'; render --help lists them", tr_method_find(o->method) ? o->check : o->method);
    if (!strcmp(o->method, o->check) && !o->check_scene)
        return die("--check %s is the method of the reference: a method cannot check itself, choose another", o->check);
    return 0;
}

static int parse(options *o, int argc, char **argv)
{
    *o = (options){.method = "sdtree", .check = "pt", .state_dir = "out/references", .width = 320, .height = 180};
    o->ratio = 50;
    o->round_seconds = o->measure_seconds = 60;
    o->seed = 1000000; /* far from the seeds of pictures that will be measured: they must be independent */
    for (int i = 1; i < argc; ++i) {
        bool known = true, quiet = !strcmp(argv[i], "--quiet"), cache = !strcmp(argv[i], "--cache");
        o->quiet |= quiet;
        o->cache |= cache;
        if (quiet || cache)
            continue;
        if (argv[i][0] != '-') {
            if (o->scene)
                return die("two scenes given: '%s' and '%s'", o->scene, argv[i]);
            o->scene = argv[i];
            continue;
        }
        if (i + 1 >= argc)
            return die("option '%s' is unknown or needs a value; run make_reference --help", argv[i]);
        if (!apply(o, argv[i], argv[i + 1], &known))
            return die("option %s: '%s' is not a usable value; run make_reference --help", argv[i], argv[i + 1]);
        if (!known)
            return die("unknown option '%s'; run make_reference --help", argv[i]);
        ++i;
    }
    return check_options(o);
}

/* ---- >>settings --------------------------------------------------------------------------------------------- */

typedef struct text {
    char s[4096];
    size_t n;
} text;

static void append(text *t, const char *format, ...)
{
    va_list args;
    va_start(args, format);
    int n = vsnprintf(t->s + t->n, sizeof t->s - t->n, format, args);
    va_end(args);
    t->n += n > 0 ? (size_t)n : 0;
    t->n = t->n < sizeof t->s ? t->n : sizeof t->s - 1;
}

/* What pictures that may be averaged have in common: the scene's file, without its folder, and what decides the mean.
 */
static void picture_text(const options *o, text *t)
{
    const char *slash = strrchr(o->scene, '/');
    append(t, "%s --size %dx%d", slash ? slash + 1 : o->scene, o->width, o->height);
    if (o->max_depth)
        append(t, " --max-depth %d", o->max_depth);
    if (o->no_nee)
        append(t, " --nee off");
    for (int i = 0; i < o->define_count; ++i)
        append(t, " -D %s=%s", o->defines[i].name, o->defines[i].value);
}

/* Everything besides the scene that decides what a round computes, as options. */
static void settings_text(const options *o, text *t)
{
    append(t, "--size %dx%d --method %s", o->width, o->height, o->method);
    for (int i = 0; i < o->set_count; ++i)
        append(t, " --set %s=%s", o->set[i].key, o->set[i].value);
    append(t, " --check %s", o->check);
    if (o->max_depth)
        append(t, " --max-depth %d", o->max_depth);
    if (o->no_nee)
        append(t, " --nee off");
    if (o->rr)
        append(t, " --rr %s", o->rr);
    for (int i = 0; i < o->define_count; ++i)
        append(t, " -D %s=%s", o->defines[i].name, o->defines[i].value);
    append(t, " --seed %llu", (unsigned long long)o->seed);
}

#define FNV_START UINT64_C(0xcbf29ce484222325)

static uint64_t fnv(uint64_t h, const void *data, size_t size) /* FNV-1a */
{
    const unsigned char *p = data;
    for (size_t i = 0; i < size; ++i)
        h = (h ^ p[i]) * UINT64_C(0x100000001b3);
    return h;
}

static bool hash_file(const char *path, uint64_t *h)
{
    unsigned char buffer[65536];
    FILE *f = fopen(path, "rb");
    size_t n;
    if (!f)
        return false;
    while ((n = fread(buffer, 1, sizeof buffer, f)) > 0)
        *h = fnv(*h, buffer, n);
    bool ok = !ferror(f);
    fclose(f);
    return ok;
}

/* Of the settings and of the bytes of the scene file. hash_files adds the files that the scene names. */
static int hash_settings(const options *o, uint64_t *h)
{
    const char *scenes[] = {o->scene, o->check_scene};
    text t = {.n = 0};
    settings_text(o, &t);
    *h = fnv(FNV_START, t.s, t.n);
    for (int i = 0; i < 2; ++i)
        if (scenes[i] && !hash_file(scenes[i], h))
            return die("%s: cannot be read: %s; check the path", scenes[i], strerror(errno));
    return 0;
}

/* ---- >>round ------------------------------------------------------------------------------------------------ */

typedef struct job {
    const char *scene, *label;
    const tr_method *method;
    bool with_set; /* the options are the reference's method's */
    uint64_t seed;
    int spp;
    double seconds;
} job;

typedef struct answer {
    bool ok;
    int spp;
    double cpu, render_cpu; /* with and without loading the scene */
    uint64_t bad;           /* samples that were not finite and dropped */
    char err[512];
} answer;

typedef struct child_progress {
    pid_t parent;
    const char *label;
    bool show;
} child_progress;

static void child_tick(void *user, double done, const char *unused)
{
    const child_progress *p = user;
    (void)unused;
    if (getppid() != p->parent) /* nobody is left to take the round in */
        _exit(1);
    if (p->show)
        fprintf(stderr, "\r%s %3.0f %% ", p->label, 100 * done);
}

static bool write_all(int fd, const void *data, size_t size)
{
    for (const char *p = data; size;) {
        ssize_t n = write(fd, p, size);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            return false;
        p += n;
        size -= (size_t)n;
    }
    return true;
}

static bool read_all(int fd, void *data, size_t size)
{
    for (char *p = data; size;) {
        ssize_t n = read(fd, p, size);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            return false;
        p += n;
        size -= (size_t)n;
    }
    return true;
}

/* Runs in the child: load, render, send an answer and the pixels. */
static bool child_render(const options *o, const job *j, child_progress *progress, bool say, int fd)
{
    static options own; /* methods mark the options that they used */
    own = *o;
    answer a = {.ok = false};
    tr_log log = {.out = say ? stderr : NULL};
    tr_result result;
    tr_scene *scene = tr_scene_load(j->scene, own.defines, own.define_count, own.threads, &log);
    tr_settings s = {.width = o->width, .height = o->height, .spp = j->spp, .seconds = j->seconds};
    s.max_depth = o->max_depth;
    s.no_nee = o->no_nee;
    s.roulette = o->roulette;
    s.threads = o->threads;
    s.seed = j->seed;
    s.method = j->method;
    s.options = own.set;
    s.option_count = j->with_set ? own.set_count : 0;
    s.progress = child_tick;
    s.progress_user = progress;
    if (!scene)
        snprintf(a.err, sizeof a.err, "%.500s", say ? "the scene could not be loaded" : log.last);
    else
        a.ok = tr_render(scene, &s, &result, a.err, sizeof a.err);
    if (a.ok) {
        a.spp = result.spp;
        a.bad = result.bad_samples;
        a.cpu = tr_cpu_seconds();
        a.render_cpu = result.cpu_seconds;
    }
    size_t bytes = 3 * (size_t)o->width * (size_t)o->height * sizeof(float);
    bool sent = write_all(fd, &a, sizeof a) && (!a.ok || write_all(fd, result.color.data, bytes));
    return a.ok && sent;
}

/* A process beside this one: what it writes to its end of a pipe is read here. */
typedef struct helper {
    pid_t id;
    int fd; /* this side's end */
} helper;

/* *h: h->id is 0 in the new process, which is to _exit. False, and told: there is none. */
static bool helper_start(helper *h, const char *what)
{
    int fds[2];
    fflush(NULL);
    if (pipe(fds) != 0)
        return die("no pipe for %s: %s", what, strerror(errno)), false;
    h->id = fork();
    if (h->id < 0) {
        close(fds[0]);
        close(fds[1]);
        return die("no process for %s: %s; free some memory", what, strerror(errno)), false;
    }
    close(fds[h->id ? 1 : 0]);
    h->fd = fds[h->id ? 0 : 1];
    return true;
}

/* Exit status as waitpid has it. */
static int helper_end(const helper *h)
{
    int status = 0;
    close(h->fd);
    while (waitpid(h->id, &status, 0) < 0 && errno == EINTR) {
    }
    return status;
}

/* Render j in a process of its own. pixels: 3 * width * height. say: let the scene's messages through. */
static bool render_round(const options *o, const job *j, bool say, answer *a, float *pixels)
{
    helper h;
    bool show = !o->quiet && isatty(STDERR_FILENO);
    child_progress progress = {getpid(), j->label, show};
    if (!helper_start(&h, "a round"))
        return false;
    if (h.id == 0)
        _exit(child_render(o, j, &progress, say, h.fd) ? 0 : 1);
    *a = (answer){.ok = false};
    bool got = read_all(h.fd, a, sizeof *a);
    bool ok = got && a->ok;
    ok = ok && read_all(h.fd, pixels, 3 * (size_t)o->width * (size_t)o->height * sizeof *pixels);
    int status = helper_end(&h);
    if (show)
        fputs("\r                                                  \r", stderr);
    if (!ok && got && a->err[0])
        die("%s, %s: %s", j->scene, j->method->name, a->err);
    else if (!ok)
        die("%s, %s: the round ended by signal %d; earlier rounds are kept, call it again to go on (with fewer "
            "--threads or less --round-spp where memory was short)",
            j->scene, j->method->name, WIFSIGNALED(status) ? WTERMSIG(status) : 0);
    return ok;
}

/* What the scenes read besides themselves. */
typedef struct scene_files {
    const char *scene; /* that is loading */
    bool ok;
    uint64_t hash;
    char err[512];
} scene_files;

static void add_file(void *user, const char *path)
{
    scene_files *f = user;
    if (strcmp(path, f->scene) != 0 && !hash_file(path, &f->hash)) {
        f->ok = false;
        snprintf(f->err, sizeof f->err, "%.300s: cannot be read: %s", path, strerror(errno));
    }
}

/* Runs in the child. */
static bool child_hash(const options *o, uint64_t hash, int fd)
{
    const char *scenes[] = {o->scene, o->check_scene};
    scene_files f = {.ok = true, .hash = hash};
    for (int i = 0; i < 2 && f.ok; ++i) {
        tr_log log = {.on_file = add_file, .user = &f};
        f.scene = scenes[i];
        if (scenes[i] && !tr_scene_load(scenes[i], o->defines, o->define_count, o->threads, &log)) {
            f.ok = false;
            snprintf(f.err, sizeof f.err, "%.500s", log.last);
        }
    }
    return write_all(fd, &f, sizeof f);
}

/* Add the meshes, textures, spectra and included files that the scenes read, whatever their names: a scene that is one
   file keeps its hash. They are loaded in a process of its own, as rounds do. */
static int hash_files(const options *o, uint64_t *hash)
{
    scene_files f = {.ok = false};
    helper h;
    if (!helper_start(&h, "the scene's files"))
        return PROGRAM_FAILED;
    if (h.id == 0)
        _exit(child_hash(o, *hash, h.fd) ? 0 : 1);
    bool got = read_all(h.fd, &f, sizeof f);
    helper_end(&h);
    if (!got || !f.ok)
        return die("%s", got ? f.err : "the scene could not be loaded: not enough memory for it");
    *hash = f.hash;
    return 0;
}

/* ---- >>state ------------------------------------------------------------------------------------------------ */

typedef struct head {
    char magic[8]; /* version in it, and native byte order: a state stays on its machine */
    uint64_t key;  /* hash of the settings */
    int32_t width, height;
    int32_t spp[METHODS]; /* of a round, 0 = not known yet */
    int32_t rounds[METHODS];
    uint64_t bad;
    double cpu[METHODS], other_cpu, wall;
    double run_cpu; /* of the run that is to be measured; 0 = none yet */
    uint64_t sum;   /* of all that follows, to know a damaged file */
} head;

static const char state_magic[8] = "trref02";

/* Per method, halves of its rounds (even, odd), of each the sums and sums of squares of the rounds' pixels. */
typedef struct state {
    head h;
    size_t n;     /* pixels * 3 */
    double *data; /* [METHODS][2][2][n] */
    float *run;   /* [n] */
    char path[PATH_SIZE];
    int lock;
} state;

static double *sums(const state *s, int method, int half, int power)
{
    return s->data + (size_t)(method * 4 + half * 2 + power - 1) * s->n;
}

static int half_rounds(const state *s, int method, int half) { return (s->h.rounds[method] + 1 - half) / 2; }
static size_t data_bytes(const state *s) { return METHODS * 4 * s->n * sizeof *s->data; }
static size_t run_bytes(const state *s) { return s->n * sizeof *s->run; }
static int total_rounds(const state *s) { return s->h.rounds[MAIN] + s->h.rounds[CHECK]; }

static uint64_t state_sum(const state *s) { return fnv(fnv(FNV_START, s->data, data_bytes(s)), s->run, run_bytes(s)); }

/* Written beside the old one and renamed over it: an interruption leaves either. */
static bool state_save(state *s)
{
    char beside[PATH_SIZE + 8];
    snprintf(beside, sizeof beside, "%s.new", s->path);
    int fd = open(beside, O_WRONLY | O_CREAT | O_TRUNC, 0666);
    s->h.sum = state_sum(s);
    bool ok = fd >= 0 && write_all(fd, &s->h, sizeof s->h) && write_all(fd, s->data, data_bytes(s)) &&
              write_all(fd, s->run, run_bytes(s)) && fsync(fd) == 0;
    if (fd >= 0)
        ok = close(fd) == 0 && ok;
    if (!ok || rename(beside, s->path) != 0)
        return die("%s: cannot be written: %s; free space, or choose another --state", beside, strerror(errno)), false;
    return true;
}

static int state_read(state *s, int fd, uint64_t key)
{
    head fresh = s->h;
    char extra;
    bool whole = read_all(fd, &s->h, sizeof s->h) && !memcmp(s->h.magic, state_magic, sizeof state_magic);
    if (whole && (s->h.key != key || s->h.width != fresh.width || s->h.height != fresh.height))
        return die("%s: belongs to another scene or other settings; remove it, or choose another --state", s->path);
    whole = whole && read_all(fd, s->data, data_bytes(s)) && read_all(fd, s->run, run_bytes(s)) &&
            read(fd, &extra, 1) == 0 && s->h.sum == state_sum(s);
    if (!whole)
        return die("%s: damaged, or of another version; remove it to start again", s->path);
    return 0;
}

/* Two calls at once on one state would each lose the other's rounds. */
static bool state_lock(state *s)
{
    char path[PATH_SIZE + 8];
    struct flock lock = {.l_type = F_WRLCK, .l_whence = SEEK_SET};
    snprintf(path, sizeof path, "%s.lock", s->path);
    s->lock = open(path, O_RDWR | O_CREAT, 0666);
    if (s->lock < 0)
        return die("%s: cannot be written: %s; choose another --state", path, strerror(errno)), false;
    if (fcntl(s->lock, F_SETLK, &lock) != 0)
        return die("%s: another call is at work on this reference; wait for it", s->path), false;
    return true;
}

static int state_open(state *s, const options *o, uint64_t key)
{
    *s = (state){.n = 3 * (size_t)o->width * (size_t)o->height, .lock = -1};
    memcpy(s->h.magic, state_magic, sizeof state_magic);
    s->h.key = key;
    s->h.width = o->width;
    s->h.height = o->height;
    s->data = calloc(METHODS * 4 * s->n, sizeof *s->data);
    s->run = calloc(s->n, sizeof *s->run);
    if (!s->data || !s->run)
        return die("out of memory for the sums; choose a smaller --size");
    int n = snprintf(s->path, sizeof s->path, "%s/%016llx.state", o->state_dir, (unsigned long long)key);
    if (n < 0 || n >= (int)sizeof s->path || !make_folders(o->state_dir) || access(o->state_dir, W_OK) != 0)
        return die("%s: cannot be created or written: %s; choose another --state", o->state_dir, strerror(errno));
    if (!state_lock(s))
        return PROGRAM_FAILED;
    int fd = open(s->path, O_RDONLY);
    if (fd < 0 && errno != ENOENT)
        return die("%s: cannot be read: %s", s->path, strerror(errno));
    int rc = fd >= 0 ? state_read(s, fd, key) : 0;
    if (fd >= 0)
        close(fd);
    for (int m = 0; m < METHODS && !rc; ++m) {
        if (s->h.spp[m] && o->spp[m] && s->h.spp[m] != o->spp[m])
            rc =
                die("%s: has rounds of %d samples per pixel, %s asks for %d; leave that out, or choose another --state",
                    s->path, s->h.spp[m], m == MAIN ? "--round-spp" : "--check-spp", o->spp[m]);
        else if (o->spp[m])
            s->h.spp[m] = o->spp[m];
    }
    return rc;
}

static void state_close(state *s)
{
    free(s->data);
    free(s->run);
    if (s->lock >= 0)
        close(s->lock);
}

static void state_add(state *s, int method, const answer *a, const float *pixels)
{
    int half = s->h.rounds[method]++ & 1;
    double *sum = sums(s, method, half, 1), *squares = sums(s, method, half, 2);
    for (size_t i = 0; i < s->n; ++i) {
        sum[i] += pixels[i];
        squares[i] += (double)pixels[i] * pixels[i];
    }
    s->h.cpu[method] += a->cpu;
    s->h.bad += a->bad;
}

/* ---- >>added ------------------------------------------------------------------------------------------------- */

#define ALIKE 4.0 /* a picture that differs by more than so many times the errors of both is of something else */

/* An earlier reference, made with other seeds. It is independent of the rounds: they weigh by 1 / relMSE. */
typedef struct added {
    tr_image image;
    double relmse;    /* its own; 0 = there is none */
    char made[16384]; /* its command, and of what it had taken in itself */
} added;

/* Was a command among those of `made` given this seed? */
static bool made_with(const char *made, uint64_t seed)
{
    char option[40];
    snprintf(option, sizeof option, " --seed %llu ", (unsigned long long)seed);
    return strstr(made, option) != NULL;
}

static int added_open(added *a, const options *o)
{
    char err[512], relmse[128], picture[4096], before[sizeof a->made / 2];
    text own = {.n = 0};
    *a = (added){0};
    if (!o->add)
        return 0;
    picture_text(o, &own);
    if (!tr_image_read(o->add, true, &a->image, err, sizeof err))
        return die("%s", err);
    if (a->image.width != o->width || a->image.height != o->height)
        return die("%s: is %dx%d, not %dx%d; choose that --size", o->add, a->image.width, a->image.height, o->width,
                   o->height);
    if (!tr_exr_read_attribute(o->add, "referenceRelMSE", relmse, sizeof relmse) ||
        !tr_exr_read_attribute(o->add, "referenceCommand", a->made, sizeof a->made / 2) ||
        sscanf(relmse, "%lf", &a->relmse) != 1 || !(a->relmse > 0))
        return die("%s: does not tell its own error and how it was made; only pictures of make_reference can be added",
                   o->add);
    if (tr_exr_read_attribute(o->add, "referencePicture", picture, sizeof picture) && strcmp(picture, own.s) != 0)
        return die("%s: is of '%s', not of '%s'; choose the same settings", o->add, picture, own.s);
    if (tr_exr_read_attribute(o->add, "referenceAdded", before, sizeof before)) {
        size_t n = strlen(a->made);
        snprintf(a->made + n, sizeof a->made - n, " | %s", before);
    }
    if (made_with(a->made, o->seed))
        return die("%s: was made with --seed %llu, so the rounds would be the same; choose another --seed", o->add,
                   (unsigned long long)o->seed);
    return 0;
}

/* ---- >>error ------------------------------------------------------------------------------------------------ */

typedef struct quality {
    tr_error own;    /* relmse of the reference itself */
    double measured; /* relmse that is to be measured; 0 = not known */
    double share;    /* weight of the rounds; the rest is the added picture's */
    double apart;    /* relmse of the added picture against the rounds; 0 = there is none */
    double rounds;   /* relmse of the rounds' mean */
    bool known, reached;
} quality;

/* Mean of the rounds of `method` in channel i, and the variance of that mean; needs two rounds. */
static void mean_variance(const state *s, int method, size_t i, double *mean, double *variance)
{
    int n = s->h.rounds[method];
    *mean = (sums(s, method, 0, 1)[i] + sums(s, method, 1, 1)[i]) / n;
    double v = (sums(s, method, 0, 2)[i] + sums(s, method, 1, 2)[i]) / n - *mean * *mean;
    *variance = v > 0 ? v / (n - 1.0) : 0;
}

/* Of the rounds; with share < 1 the added picture has the rest of the weight. */
static bool mean_image(const state *s, const added *a, double share, tr_image *image)
{
    double variance, mean;
    if (!tr_image_alloc(image, s->h.width, s->h.height, 3))
        return die("out of memory for the picture"), false;
    for (size_t i = 0; i < s->n; ++i) {
        mean_variance(s, MAIN, i, &mean, &variance);
        image->data[i] = (float)(share < 1 ? share * mean + (1 - share) * (double)a->image.data[i] : mean);
    }
    return true;
}

/* The error measure of tr_image_error with the variance of the mean in the place of (I - R)^2. The trimming drops the
   worst 0.1 % of *expected* errors, which takes less away than the worst of errors that happened: on the safe side. */
static bool own_error(const state *s, tr_error *own)
{
    size_t pixels = s->n / 3, keep = pixels - pixels / 1000;
    double *value = calloc(pixels, sizeof *value), total = 0, m, v;
    if (!value)
        return die("out of memory for the error"), false;
    for (size_t i = 0; i < s->n; ++i) {
        mean_variance(s, MAIN, i, &m, &v);
        total += m;
    }
    double scale2 = total > 0 ? pow(0.5 * (double)s->n / total, 2) : 1;
    for (size_t i = 0; i < s->n; ++i) {
        mean_variance(s, MAIN, i, &m, &v);
        value[i / 3] += v * scale2 / (m * m * scale2 + 0.01) / 3;
    }
    qsort(value, pixels, sizeof *value, ascending);
    *own = (tr_error){0};
    for (size_t i = 0; i < pixels; ++i) {
        own->relmse += i < keep ? value[i] / (double)keep : 0;
        own->relmse_untrimmed += value[i] / (double)pixels;
    }
    free(value);
    return true;
}

/* relMSE of a picture against the rounds' mean. */
static bool against_rounds(const state *s, const tr_image *picture, const char *what, double *relmse)
{
    tr_image mean = {0};
    tr_error e = {0};
    char err[512];
    bool ok = mean_image(s, NULL, 1, &mean);
    if (ok && !tr_image_error(picture, &mean, &e, err, sizeof err))
        ok = (die("%s: %s", what, err), false);
    tr_image_free(&mean);
    *relmse = e.relmse;
    return ok;
}

/* Where a run is measured against the mean so far, the mean's error is in the figure and is taken out, as far as that
   can be believed. */
static bool judge(const options *o, const state *s, const added *a, quality *q)
{
    tr_image run = {s->h.width, s->h.height, 3, s->run};
    *q = (quality){.measured = o->measured, .share = 1};
    if (s->h.rounds[MAIN] < 2)
        return true;
    if (!own_error(s, &q->own))
        return false;
    q->known = true;
    q->rounds = q->own.relmse;
    if (!(q->measured > 0) && s->h.run_cpu > 0) {
        double relmse;
        if (!against_rounds(s, &run, "the measured run", &relmse))
            return false;
        q->measured = fmax(relmse - q->own.relmse, 0.5 * relmse);
    }
    if (a->relmse > 0) {
        if (!against_rounds(s, &a->image, o->add, &q->apart))
            return false;
        q->share = a->relmse / (a->relmse + q->rounds);
        q->own.relmse *= q->share;
        q->own.relmse_untrimmed *= q->share;
    }
    q->reached = s->h.rounds[MAIN] >= MIN_ROUNDS && q->own.relmse * o->ratio <= q->measured;
    return true;
}

/* Is the added picture one of the same scene? */
static int check_added(const options *o, const added *a, const quality *q)
{
    if (q->apart <= ALIKE * (a->relmse + q->rounds))
        return 0;
    return die("%s: not written: %s differs from the rounds by relMSE %.3g, where both errors make %.3g: is it of this "
               "scene and these settings?",
               o->out, o->add, q->apart, a->relmse + q->rounds);
}

/* ---- >>check ------------------------------------------------------------------------------------------------ */

typedef struct tile {
    bool tested, usable; /* usable: its own variances can be believed; tested: those of its neighbours too */
    double z, ratio;     /* of the channel that differs most; the reference's mean over the check's */
} tile;

typedef struct verdict {
    int across, down, tested, left_out, failed;
    double limit, worst;
    tile *tiles;
} verdict;

/* Mean over one tile and channel, its variance, and whether both halves of the rounds agree on the variance. Pixels of
   a round are uncorrelated: guiding steers them together but leaves each without bias. */
static bool tile_statistics(const state *s, int method, const int box[4], int channel, double *mean, double *variance)
{
    double v[2] = {0, 0}, total = 0;
    int count = (box[2] - box[0]) * (box[3] - box[1]);
    for (int half = 0; half < 2; ++half) {
        int n = half_rounds(s, method, half);
        const double *sum = sums(s, method, half, 1), *squares = sums(s, method, half, 2);
        for (int y = box[1]; y < box[3]; ++y)
            for (int x = box[0]; x < box[2]; ++x) {
                size_t i = 3 * ((size_t)y * (size_t)s->h.width + (size_t)x) + (size_t)channel;
                double m = sum[i] / n, d = (squares[i] / n - m * m) * n / (n - 1.0);
                total += sum[i];
                v[half] += d > 0 ? d : 0;
            }
    }
    *mean = total / ((double)count * s->h.rounds[method]);
    *variance = 0.5 * (v[0] + v[1]) / ((double)count * count * s->h.rounds[method]);
    return fmax(v[0], v[1]) <= CONSISTENT * fmin(v[0], v[1]);
}

/* All channels of a tile count: where one cannot be tested, the tile is left out. */
static tile test_tile(const state *s, const int box[4])
{
    tile t = {.usable = true, .ratio = 1};
    for (int c = 0; c < 3; ++c) {
        double m[METHODS], v[METHODS];
        bool usable = tile_statistics(s, MAIN, box, c, &m[MAIN], &v[MAIN]);
        usable = tile_statistics(s, CHECK, box, c, &m[CHECK], &v[CHECK]) && usable;
        if (!usable || (v[MAIN] > 0) != (v[CHECK] > 0)) { /* no variance at all: that method has found nothing yet */
            t.usable = false;
            return t;
        }
        /* Pixels that are the same in every round: an emitter, or black. Rounding is then the only noise. */
        double rounding = 1e-6 * fmax(fabs(m[MAIN]), fabs(m[CHECK]));
        double difference = fabs(m[MAIN] - m[CHECK]), deviation = sqrt(v[MAIN] + v[CHECK] + rounding * rounding);
        double z = deviation > 0 ? difference / deviation : 0;
        if (z >= t.z) {
            t.z = z;
            t.ratio = m[CHECK] > 0 ? m[MAIN] / m[CHECK] : m[MAIN] > 0 ? INFINITY : 1;
        }
    }
    return t;
}

/* Rare bright paths reach whole regions: a tile among such ones that looks calm has only not met its own yet, and would
   be too dark by more than its variance says. So a tile counts only where all its neighbours are usable. */
static bool neighbours_usable(const verdict *c, int column, int row)
{
    for (int y = row > 0 ? row - 1 : 0; y <= row + 1 && y < c->down; ++y)
        for (int x = column > 0 ? column - 1 : 0; x <= column + 1 && x < c->across; ++x)
            if (!c->tiles[y * c->across + x].usable)
                return false;
    return true;
}

/* Do the two methods agree? Bonferroni over channels and tiles, among those that can be tested. */
static bool run_check(const state *s, verdict *c)
{
    *c = (verdict){.across = (s->h.width + TILE - 1) / TILE, .down = (s->h.height + TILE - 1) / TILE};
    c->tiles = calloc((size_t)c->across * (size_t)c->down, sizeof *c->tiles);
    if (!c->tiles)
        return die("out of memory for the check"), false;
    if (s->h.rounds[MAIN] < MIN_ROUNDS || s->h.rounds[CHECK] < MIN_ROUNDS) {
        c->left_out = c->across * c->down;
        return true;
    }
    for (int i = 0; i < c->across * c->down; ++i) {
        int x = i % c->across * TILE, y = i / c->across * TILE;
        int box[4] = {x, y, x + TILE < s->h.width ? x + TILE : s->h.width,
                      y + TILE < s->h.height ? y + TILE : s->h.height};
        c->tiles[i] = test_tile(s, box);
    }
    for (int i = 0; i < c->across * c->down; ++i) {
        tile *t = &c->tiles[i];
        t->tested = neighbours_usable(c, i % c->across, i / c->across);
        c->tested += t->tested;
        c->left_out += !t->tested;
        c->worst = t->tested ? fmax(c->worst, t->z) : c->worst;
    }
    c->limit = c->tested ? normal_limit(CHECK_ALPHA / (3.0 * c->tested)) : 0;
    for (int i = 0; i < c->across * c->down; ++i)
        c->failed += c->tiles[i].tested && c->tiles[i].z > c->limit;
    return true;
}

/* ---- >>output ----------------------------------------------------------------------------------------------- */

/* Grey to white up to the limit, red beyond it, blue where nothing could be told. */
static bool write_heat(const state *s, const verdict *c, const char *path)
{
    tr_image image;
    char err[512];
    if (!tr_image_alloc(&image, s->h.width, s->h.height, 3))
        return die("out of memory for the heat map"), false;
    for (size_t i = 0; i < s->n / 3; ++i) {
        size_t x = i % (size_t)s->h.width / TILE, y = i / (size_t)s->h.width / TILE;
        const tile *t = &c->tiles[y * (size_t)c->across + x];
        float grey = (float)(0.6 * t->z / (c->limit > 0 ? c->limit : 1)), *p = image.data + 3 * i;
        bool bad = t->tested && t->z > c->limit;
        p[0] = !t->tested ? 0 : bad ? 1 : grey;
        p[1] = !t->tested || bad ? 0 : grey;
        p[2] = !t->tested ? 0.2f : bad ? 0 : grey;
    }
    bool ok = tr_png_write(path, &image, 1, err, sizeof err);
    tr_image_free(&image);
    if (!ok)
        die("%s: cannot write the heat map: %s", path, err);
    return ok;
}

static void print_worst(const verdict *c)
{
    int n = c->across * c->down;
    double below = INFINITY;
    for (int shown = 0; shown < 8; ++shown) {
        int worst = -1;
        for (int i = 0; i < n; ++i)
            if (c->tiles[i].tested && c->tiles[i].z < below && (worst < 0 || c->tiles[i].z > c->tiles[worst].z))
                worst = i;
        if (worst < 0 || c->tiles[worst].z <= c->limit)
            return;
        below = c->tiles[worst].z;
        fprintf(stderr, "  tile at pixel %d,%d: z %.2f, reference / check = %.4f\n", worst % c->across * TILE,
                worst / c->across * TILE, below, c->tiles[worst].ratio);
    }
}

static int refuse(const options *o, const state *s, const verdict *c)
{
    char path[PATH_SIZE + 16];
    size_t n = strlen(o->out);
    n -= n > 4 && !strcmp(o->out + n - 4, ".exr") ? 4 : 0;
    snprintf(path, sizeof path, "%.*s-check.png", (int)(n < PATH_SIZE ? n : PATH_SIZE), o->out);
    die("%s: not written: %s and %s differ in %d of %d tested tiles (%d left out), worst z %.2f, allowed %.2f", o->out,
        o->method, o->check, c->failed, c->tested, c->left_out, c->worst, c->limit);
    print_worst(c);
    if (write_heat(s, c, path))
        fprintf(stderr,
                "  %s shows where (red); one of the methods is wrong there. The rounds are kept in %s:\n  where chance "
                "is suspected, more --rounds settle it\n",
                path, s->path);
    return PROGRAM_FAILED;
}

static int write_reference(const options *o, const state *s, const added *a, const quality *q, const verdict *c)
{
    tr_image mean;
    text command = {.n = 0}, picture = {.n = 0};
    char relmse[128], samples[128], check[192], goal[128], taken_in[sizeof a->made + 128], err[512];
    const char *slash = strrchr(o->out, '/');
    append(&command, "make_reference %s ", o->scene);
    settings_text(o, &command);
    if (o->check_scene)
        append(&command, " --check-scene %s", o->check_scene);
    append(&command, " --round-spp %d --check-spp %d --rounds %d", s->h.spp[MAIN], s->h.spp[CHECK], total_rounds(s));
    if (o->add)
        append(&command, " --add %s", o->add);
    append(&command, " --measured %.4g --ratio %g -o %s", q->measured, o->ratio, slash ? slash + 1 : o->out);
    snprintf(relmse, sizeof relmse, "%.4g (untrimmed %.4g)", q->own.relmse, q->own.relmse_untrimmed);
    snprintf(samples, sizeof samples, "%lld spp = %d rounds of %d, %llu bad samples",
             (long long)s->h.spp[MAIN] * s->h.rounds[MAIN], s->h.rounds[MAIN], s->h.spp[MAIN],
             (unsigned long long)s->h.bad);
    snprintf(goal, sizeof goal, "1/%g of %.4g: %s", o->ratio, q->measured, q->reached ? "reached" : "not reached");
    snprintf(check, sizeof check, "%.32s, %lld spp: %d tiles agree, %d left out, worst z %.2f, allowed %.2f", o->check,
             (long long)s->h.spp[CHECK] * s->h.rounds[CHECK], c->tested, c->left_out, c->worst, c->limit);
    snprintf(taken_in, sizeof taken_in, "own relMSE %.4g, from the rounds by %.4g, weight %.3f: %s", a->relmse,
             q->apart, 1 - q->share, a->made);
    picture_text(o, &picture);
    const tr_attribute attributes[] = {{"referencePicture", picture.s}, {"referenceCommand", command.s},
                                       {"referenceRelMSE", relmse},     {"referenceGoal", goal},
                                       {"referenceSamples", samples},   {"referenceCheck", check},
                                       {"referenceAdded", taken_in}};
    int count = (int)(sizeof attributes / sizeof attributes[0]) - (a->relmse > 0 ? 0 : 1);
    if (!mean_image(s, a, q->share, &mean))
        return PROGRAM_FAILED;
    const tr_layer layer = {"R,G,B", &mean, false};
    bool ok = tr_exr_write_attributes(o->out, &layer, 1, attributes, count, err, sizeof err);
    tr_image_free(&mean);
    if (!ok)
        return die("%s: cannot write the picture: %s", o->out, err);
    struct stat file;
    if (o->quiet)
        return 0;
    printf("%s: %.0f kB, %s\n  own relMSE %s, wanted %s\n  check: %s\n  %.0f CPU s (%s %.0f, %s %.0f)\n", o->out,
           stat(o->out, &file) == 0 ? (double)file.st_size / 1000 : 0, samples, relmse, goal, check,
           s->h.cpu[MAIN] + s->h.cpu[CHECK] + s->h.other_cpu, o->method, s->h.cpu[MAIN], o->check, s->h.cpu[CHECK]);
    return 0;
}

/* ---- >>main ------------------------------------------------------------------------------------------------- */

typedef struct session {
    const options *o;
    state s;
    added added;
    float *pixels;
    double used, wall; /* CPU and wall-clock seconds of this call */
    bool said;         /* the scene's messages have been shown */
} session;

static bool do_job(session *w, const job *j, answer *a)
{
    double start = tr_wall_seconds();
    if (!render_round(w->o, j, !w->said, a, w->pixels))
        return false;
    /* Scenes may differ: the check's messages count as well. */
    w->said = w->s.h.rounds[CHECK] > 0 || !w->o->check_scene;
    w->used += a->cpu;
    w->wall += tr_wall_seconds() - start;
    return true;
}

static job make_job(const session *w, int method, uint64_t number)
{
    const options *o = w->o;
    const char *name = method == MAIN ? o->method : o->check;
    job j = {.scene = method == CHECK && o->check_scene ? o->check_scene : o->scene, .label = name};
    j.method = tr_method_find(name);
    j.with_set = method == MAIN;
    /* Hashed twice: rounds of neighbouring --seed share none, so that --add can take them together. See also rng_seed.
     */
    j.seed = tr_hash64(tr_hash64(o->seed) + 4 * number + (uint64_t)method);
    return j;
}

/* Numbers of jobs that are not rounds, out of their way. */
#define PILOT_NUMBER (UINT64_C(1) << 40)
#define RUN_NUMBER (UINT64_C(1) << 41)

/* Samples for rounds of about --round-seconds, from a short run. */
static bool find_spp(session *w)
{
    for (int m = 0; m < METHODS; ++m) {
        answer a;
        if (w->s.h.spp[m])
            continue;
        job j = make_job(w, m, PILOT_NUMBER);
        j.seconds = fmin(5, w->o->round_seconds / 4);
        if (!do_job(w, &j, &a))
            return false;
        double spp = floor(a.spp * w->o->round_seconds / fmax(a.render_cpu, 1e-3));
        w->s.h.spp[m] = (int32_t)fmin(fmax(spp, 1), 1 << 24);
        w->s.h.other_cpu += a.cpu;
    }
    return true;
}

/* The run whose error the reference has to measure: the method's own, at the time that is to be compared. */
static bool measure_run(session *w)
{
    answer a;
    if (w->o->measured > 0 || w->s.h.run_cpu > 0)
        return true;
    job j = make_job(w, MAIN, RUN_NUMBER);
    j.seconds = w->o->measure_seconds;
    if (!do_job(w, &j, &a))
        return false;
    memcpy(w->s.run, w->pixels, run_bytes(&w->s));
    w->s.h.run_cpu = a.cpu;
    w->s.h.other_cpu += a.cpu;
    return state_save(&w->s);
}

/* The rounds' relMSE falls as 1 / time, and a part of the time is the check's. */
static void show(const session *w, int method, const quality *q, const verdict *c)
{
    const state *s = &w->s;
    if (w->o->quiet)
        return;
    fprintf(stderr, "round %d (%s), %.0f CPU s", total_rounds(s), method == MAIN ? w->o->method : w->o->check, w->used);
    if (q->known) {
        double spent = s->h.cpu[MAIN] + s->h.cpu[CHECK], goal = q->measured / w->o->ratio;
        double known = w->added.relmse > 0 ? 1 / w->added.relmse : 0; /* precision; the rounds have to bring the rest */
        double left = goal > 0 ? fmax(spent * (q->rounds * (1 / goal - known) - 1), 0) : 0;
        fprintf(stderr, ": own relMSE %.3g, wanted %.3g (1/%g of %.3g)", q->own.relmse, goal, w->o->ratio, q->measured);
        fprintf(stderr, q->reached ? ", reached" : ", about %.0f CPU s = %.0f s to go", left,
                left * w->wall / fmax(w->used, 1e-3));
    }
    if (c->tested)
        fprintf(stderr, "; check: worst z %.2f of %.2f, %d tiles tested, %d left out", c->worst, c->limit, c->tested,
                c->left_out);
    fputc('\n', stderr);
}

/* Which method comes next depends on counts alone, so that an interruption changes nothing. */
static int next_method(const state *s)
{
    return s->h.rounds[CHECK] + 1 <= (total_rounds(s) + 1) / CHECK_EVERY ? CHECK : MAIN;
}

static bool finished(const session *w, const quality *q)
{
    const state *s = &w->s;
    if (w->o->rounds)
        return total_rounds(s) >= w->o->rounds;
    return q->reached && s->h.rounds[CHECK] >= MIN_ROUNDS;
}

/* Rounds until the reference is good enough or a limit is reached; false = an error. */
static bool run_rounds(session *w, quality *q, verdict *c)
{
    state *s = &w->s;
    double start = tr_wall_seconds(), last = 0;
    if (!find_spp(w) || !measure_run(w) || !judge(w->o, s, &w->added, q) || !run_check(s, c))
        return false;
    while (!finished(w, q) && !(w->o->seconds > 0 && w->used + 0.5 * last >= w->o->seconds)) {
        answer a;
        int method = next_method(s);
        job j = make_job(w, method, (uint64_t)s->h.rounds[method]);
        j.spp = s->h.spp[method];
        if (!do_job(w, &j, &a))
            return false;
        state_add(s, method, &a, w->pixels);
        last = a.cpu;
        s->h.wall += tr_wall_seconds() - start;
        start = tr_wall_seconds();
        free(c->tiles);
        c->tiles = NULL;
        if (!state_save(s) || !judge(w->o, s, &w->added, q) || !run_check(s, c))
            return false;
        show(w, method, q, c);
        if (s->h.rounds[MAIN] >= MIN_ROUNDS && check_added(w->o, &w->added, q))
            return false;
    }
    return true;
}

static int conclude(const session *w, const quality *q, const verdict *c)
{
    const options *o = w->o;
    if (!q->known)
        return die("%s: not written: %d rounds of %s are too few to know its error; give it more --seconds or --rounds",
                   o->out, w->s.h.rounds[MAIN], o->method);
    if (c->failed)
        return refuse(o, &w->s, c);
    if (check_added(o, &w->added, q) || write_reference(o, &w->s, &w->added, q, c))
        return PROGRAM_FAILED;
    if (!q->reached)
        fprintf(stderr, "make_reference: %s is not good enough yet: call it again, with more --seconds or --rounds\n",
                o->out);
    if (!c->tested)
        fprintf(stderr,
                "make_reference: %s is not checked: %s is too noisy in every tile, or has fewer than %d rounds\n",
                o->out, o->check, MIN_ROUNDS);
    return q->reached && c->tested ? PROGRAM_ENOUGH : PROGRAM_TOO_FEW;
}

/* The folder of the output must take it: better known before the rounds than after them. */
static int check_output(const options *o)
{
    char folder[PATH_SIZE];
    const char *slash = strrchr(o->out, '/');
    struct stat there;
    if (snprintf(folder, sizeof folder, "%.*s", slash ? (int)(slash - o->out + 1) : 1, slash ? o->out : ".") >=
        (int)sizeof folder)
        return die("%s: the name is too long", o->out);
    if (access(folder, W_OK) != 0 || (stat(o->out, &there) == 0 && access(o->out, W_OK) != 0))
        return die("%s: cannot be written: %s; check the folder", o->out, strerror(errno));
    return 0;
}

int main(int argc, char **argv)
{
    static options o;
    static char cache_path[PATH_SIZE];
    uint64_t key;
    quality q = {0};
    verdict c = {0};
    for (int i = 1; i < argc; ++i)
        if (!strcmp(argv[i], "--help") || !strcmp(argv[i], "-h")) {
            fputs(usage_text, stdout);
            return 0;
        }
    if (parse(&o, argc, argv) || hash_settings(&o, &key) || (o.out && check_output(&o)) || hash_files(&o, &key))
        return PROGRAM_FAILED;
    static session w;
    w.o = &o;
    if (added_open(&w.added, &o))
        return PROGRAM_FAILED;
    int rc = state_open(&w.s, &o, key);
    if (o.cache) {
        snprintf(cache_path, sizeof cache_path, "%s/%016llx.exr", o.state_dir, (unsigned long long)key);
        o.out = cache_path;
    }
    w.pixels = rc ? NULL : malloc(run_bytes(&w.s));
    if (!rc && !w.pixels)
        rc = die("out of memory for a round; choose a smaller --size");
    if (!rc)
        rc = run_rounds(&w, &q, &c) ? conclude(&w, &q, &c) : PROGRAM_FAILED;
    free(c.tiles);
    free(w.pixels);
    tr_image_free(&w.added.image);
    state_close(&w.s);
    return rc;
}
