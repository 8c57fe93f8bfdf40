/* bench_error.c: error against run time: scenes x methods x budgets x seeds, each in a process of its own.

     >>options   command line and the plan that it makes
     >>children  start, watch and read renders
     >>report    tables, plots, verdicts
     >>main

   The methods of one scene, budget and seed run next to each other, as many at a time as there are jobs, so that what
   else the machine does meets all of them. Every row is written when it is known; a second call with the same settings
   goes on where the first one stopped. A render that crashes or hangs marks its row, and the rest goes on. */
#define _DEFAULT_SOURCE
#define PROGRAM "bench_error"
#include "error_report.h"
#include "options.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static const char usage[] =
    "usage: bench_error [options]\n"
    "  --scenes a,b,c       own scenes by name, downloaded ones by the name of their folder in $GUIDE_SCENES, or "
    "files\n"
    "  --methods a,b:k=v    methods with their options; the first is what the others are compared with (pt,sdtree)\n"
    "  --seconds 10,30,60   budgets in CPU seconds, learning included, loading of the scene not (default 10,30), or\n"
    "  --spp 16,64          budgets in samples per pixel\n"
    "  --train 8,32         before each: samples per pixel after which the field is frozen; counted in --seconds only\n"
    "  --seeds N            (3)      --size WxH (320x180)      --max-depth D (13)      --nee on|off (on)\n"
    "  --builds a=f,b=g     renderers to compare, names and files (default: the one next to this program)\n"
    "  --references DIR     where NAME.exr are; else examples/scenes/references, then out/references\n"
    "  --jobs N             renders at a time, one thread each (default: the number of processors)\n"
    "  --out DIR            rows.csv, rows.json, table.md, *.svg, pictures (out/bench-error)\n"
    "  --retry              render failed rows again\n"
    "  --dry-run            say what would be rendered and how long it takes\n"
    "Exit status: 0, 1 = bad options or no row succeeded, 2 = a build is slower, worse or biased against the first.\n";

typedef struct options {
    plan plan;
    names amounts, trainings; /* which make the plan's budgets */
    char build_paths[MAX_NAMES][512];
    const char *size, *references, *nee;
    int max_depth, jobs;
    bool by_spp, retry, dry_run;
} options;

/* ---- >>options ---------------------------------------------------------------------------------------------- */

static bool split(const char *text, names *out)
{
    out->count = 0;
    for (const char *at = text; *at;) {
        size_t n = strcspn(at, ",");
        if (n == 0 || n >= sizeof out->at[0] || out->count == MAX_NAMES)
            return false;
        memcpy(out->at[out->count], at, n);
        out->at[out->count++][n] = 0;
        at += n + (at[n] == ',');
    }
    return out->count > 0;
}

/* Numbers greater than 0, each written in one way only: rows are found by their budgets' texts. */
static bool set_numbers(names *out, const char *text, bool whole)
{
    if (!split(text, out))
        return false;
    for (int i = 0; i < out->count; ++i) {
        char *end;
        double value = strtod(out->at[i], &end);
        if (*end || end == out->at[i] || !(value > 0) || !(value < 1e6) || (whole && value != floor(value)))
            return false;
        snprintf(out->at[i], sizeof out->at[i], "%g", value);
    }
    return true;
}

static bool set_amounts(options *o, const char *text, bool by_spp)
{
    o->by_spp = by_spp;
    return set_numbers(&o->amounts, text, by_spp);
}

/* Every training with every amount: "10s", "64spp", "8+64spp". */
static bool combine_budgets(options *o)
{
    names *b = &o->plan.budgets;
    const char *unit = o->by_spp ? "spp" : "s";
    o->plan.trained = o->trainings.count > 0;
    b->count = 0;
    for (int a = 0; a < o->amounts.count; ++a)
        for (int t = 0; t < (o->plan.trained ? o->trainings.count : 1); ++t) {
            if (b->count == MAX_NAMES)
                return false;
            char text[40];
            if (o->plan.trained)
                snprintf(text, sizeof text, "%.10s+%.10s%s", o->trainings.at[t], o->amounts.at[a], unit);
            else
                snprintf(text, sizeof text, "%.10s%s", o->amounts.at[a], unit);
            strcpy(b->at[b->count++], text);
        }
    return true;
}

/* What comes after the training. */
static const char *amount_of(const char *budget)
{
    const char *plus = strchr(budget, '+');
    return plus ? plus + 1 : budget;
}

static bool set_builds(options *o, const char *text)
{
    names pairs;
    if (!split(text, &pairs))
        return false;
    o->plan.builds.count = pairs.count;
    for (int i = 0; i < pairs.count; ++i) {
        char *equals = strchr(pairs.at[i], '=');
        if (!equals || equals == pairs.at[i] || equals - pairs.at[i] > 31)
            return false;
        snprintf(o->build_paths[i], sizeof o->build_paths[i], "%s", equals + 1);
        *equals = 0;
        snprintf(o->plan.builds.at[i], sizeof o->plan.builds.at[i], "%s", pairs.at[i]);
    }
    return true;
}

static bool set_integer(const char *text, int low, int high, int *value)
{
    char *end;
    long n = strtol(text, &end, 10);
    *value = (int)n;
    return end != text && !*end && n >= low && n <= high;
}

static bool apply(options *o, const char *name, const char *value, bool *known)
{
    *known = true;
    if (!strcmp(name, "--scenes"))
        return split(value, &o->plan.scenes);
    if (!strcmp(name, "--methods"))
        return split(value, &o->plan.methods);
    if (!strcmp(name, "--seconds"))
        return set_amounts(o, value, false);
    if (!strcmp(name, "--spp"))
        return set_amounts(o, value, true);
    if (!strcmp(name, "--train"))
        return set_numbers(&o->trainings, value, true);
    if (!strcmp(name, "--builds"))
        return set_builds(o, value);
    if (!strcmp(name, "--seeds"))
        return set_integer(value, 1, 1000, &o->plan.seeds);
    if (!strcmp(name, "--max-depth"))
        return set_integer(value, 1, 1000, &o->max_depth);
    if (!strcmp(name, "--jobs"))
        return set_integer(value, 1, 30, &o->jobs);
    int w, h;
    if (!strcmp(name, "--size"))
        return o->size = value, parse_size(value, &w, &h);
    if (!strcmp(name, "--nee"))
        return o->nee = value, !strcmp(value, "on") || !strcmp(value, "off");
    if (!strcmp(name, "--references"))
        return o->references = value, true;
    if (!strcmp(name, "--out"))
        return o->plan.out = value, true;
    *known = false;
    return false;
}

/* The renderer that lies next to this program. */
static void default_build(options *o, const char *self)
{
    const char *slash = strrchr(self, '/');
    o->plan.builds.count = 1;
    strcpy(o->plan.builds.at[0], "render");
    snprintf(o->build_paths[0], sizeof o->build_paths[0], "%.*s/render", slash ? (int)(slash - self) : 1,
             slash ? self : ".");
}

static int parse(options *o, int argc, char **argv)
{
    split("ajar,cornell", &o->plan.scenes);
    split("pt,sdtree", &o->plan.methods);
    set_amounts(o, "10,30", false);
    default_build(o, argv[0]);
    for (int i = 1; i < argc; ++i) {
        bool known;
        if (!strcmp(argv[i], "--retry") || !strcmp(argv[i], "--dry-run")) {
            *(argv[i][2] == 'r' ? &o->retry : &o->dry_run) = true;
            continue;
        }
        if (i + 1 >= argc)
            return die("unknown option, or it needs a value; see --help", argv[i]);
        bool ok = apply(o, argv[i], argv[i + 1], &known);
        if (!known)
            return die("unknown option; see --help", argv[i]);
        if (!ok) {
            fprintf(stderr, "bench_error: %s: '%s' is not usable; see --help\n", argv[i], argv[i + 1]);
            return 1;
        }
        ++i;
    }
    if (!combine_budgets(o))
        return die("too many budgets", NULL);
    for (int i = 0; i < o->plan.builds.count; ++i)
        if (access(o->build_paths[i], X_OK))
            return die("no such renderer; build it with `make`, or name it with --builds", o->build_paths[i]);
    return 0;
}

static bool readable(const char *path) { return access(path, R_OK) == 0; }

/* The file of a scene; its short name goes to rows, tables and file names. */
static bool scene_file(const char *scene, char *path, size_t size)
{
    const char *folder = getenv("GUIDE_SCENES");
    snprintf(path, size, "%s", scene);
    if (strchr(scene, '.'))
        return readable(path);
    snprintf(path, size, "examples/scenes/%s.xml", scene);
    if (readable(path) || !folder)
        return readable(path);
    snprintf(path, size, "%s/%s/scene.xml", folder, scene);
    if (!readable(path))
        snprintf(path, size, "%s/%s/%s.xml", folder, scene, scene);
    return readable(path);
}

static const char *scene_name(const char *scene)
{
    static char name[64];
    const char *slash = strrchr(scene, '/');
    snprintf(name, sizeof name, "%s", slash ? slash + 1 : scene);
    if (strchr(scene, '.'))
        *strrchr(name, '.') = 0;
    return name;
}

static bool reference_file(const options *o, const char *scene, char *path, size_t size)
{
    const char *folders[] = {o->references, "examples/scenes/references", "out/references"};
    for (int i = o->references ? 0 : 1; i < 3; ++i) {
        snprintf(path, size, "%s/%s.exr", folders[i], scene);
        if (readable(path))
            return true;
        if (i == 0)
            break; /* a folder that was asked for stands alone */
    }
    return false;
}

/* ---- >>children --------------------------------------------------------------------------------------------- */

typedef struct child {
    pid_t pid;
    row row;
    double deadline; /* wall clock */
} child;

static volatile sig_atomic_t interrupted;
static void on_interrupt(int signal_number)
{
    (void)signal_number;
    interrupted = 1;
}

static double wall(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int index_of(const names *n, const char *name)
{
    for (int i = 0; i < n->count; ++i)
        if (!strcmp(n->at[i], name))
            return i;
    return 0;
}

/* A method that does not learn renders without a training. */
static bool trains(const options *o, const char *method)
{
    const tr_method *m = tr_method_find(method);
    return o->plan.trained && (!m || m->learns);
}

/* The words of a renderer's command line; `text` holds those that are made here. */
static int command_line(const options *o, const row *r, const char *scene, char text[][1024], char **argv)
{
    char *at = text[0], *end;
    const char *reference = text[1];
    int n = 0;
    snprintf(at, 1024, "%s", r->method); /* name:key=value:key=value */
    end = at + strcspn(at, ":");
    bool more = *end == ':';
    *end = 0;
    picture_path(text[2], 1024, o->plan.out, "pictures", r, ".exr");
    picture_path(text[3], 1024, o->plan.out, "pictures", r, ".json");
    snprintf(text[4], 1024, "%d", r->seed);
    snprintf(text[5], 1024, "%.*s", (int)strcspn(amount_of(r->budget), "sp"), amount_of(r->budget));
    snprintf(text[6], 1024, "%d", o->max_depth);
    snprintf(text[7], 1024, "%s", scene);
    const char *words[] = {o->build_paths[index_of(&o->plan.builds, r->build)],
                           text[7],
                           "--method",
                           at,
                           o->by_spp ? "--spp" : "--seconds",
                           text[5],
                           "--seed",
                           text[4],
                           "--max-depth",
                           text[6],
                           "--size",
                           o->size,
                           "--nee",
                           o->nee,
                           "--threads",
                           "1",
                           "-o",
                           text[2],
                           "--json",
                           text[3],
                           "--quiet"};
    for (size_t i = 0; i < sizeof words / sizeof words[0]; ++i)
        argv[n++] = (char *)words[i];
    if (trains(o, at)) {
        snprintf(text[8], 1024, "%.*s", (int)strcspn(r->budget, "+"), r->budget);
        argv[n++] = (char *)"--train";
        argv[n++] = text[8];
    }
    while (more && n < 60) {
        char *key = end + 1;
        end = key + strcspn(key, ":");
        more = *end == ':';
        *end = 0;
        argv[n++] = (char *)"--set";
        argv[n++] = key;
    }
    if (reference_file(o, r->scene, text[1], 1024)) {
        argv[n++] = (char *)"--reference";
        argv[n++] = (char *)reference;
    }
    argv[n] = NULL;
    return n;
}

static bool start(const options *o, child *c, const row *task)
{
    static char text[9][1024];
    char scene[1024], log[1024];
    char *argv[64];
    c->row = *task;
    for (int i = 0; i < o->plan.scenes.count; ++i)
        if (!strcmp(scene_name(o->plan.scenes.at[i]), task->scene))
            scene_file(o->plan.scenes.at[i], scene, sizeof scene);
    command_line(o, task, scene, text, argv);
    picture_path(log, sizeof log, o->plan.out, "pictures", task, ".log");
    unlink(text[3]); /* an old one is not this run's */
    double seconds = o->by_spp ? 3600 : atof(amount_of(task->budget));
    c->deadline = wall() + 120 + 20 * seconds;
    fflush(NULL);
    c->pid = fork();
    if (c->pid == 0) {
        int fd = open(log, O_WRONLY | O_CREAT | O_TRUNC, 0644);
        if (fd >= 0) {
            dup2(fd, 1);
            dup2(fd, 2);
        }
        execv(argv[0], argv);
        perror(argv[0]);
        _exit(127);
    }
    return c->pid > 0;
}

/* relMSE of the scene's reference itself, as make_reference wrote it, at the size of the picture: references can be
   larger by a whole factor, and the mean of k pixels has a k-th of their error. NaN = not known. */
static double reference_relmse(const options *o, const char *scene)
{
    char path[1024], text[128], err[512];
    double relmse;
    int width, height;
    tr_image reference;
    if (!reference_file(o, scene, path, sizeof path) ||
        !tr_exr_read_attribute(path, "referenceRelMSE", text, sizeof text) || sscanf(text, "%lf", &relmse) != 1 ||
        !parse_size(o->size, &width, &height) || !tr_image_read(path, true, &reference, err, sizeof err))
        return (double)NAN;
    relmse *= (double)width * height / ((double)reference.width * reference.height);
    tr_image_free(&reference);
    return relmse;
}

/* The row of a child that ended. */
static void finish(const options *o, child *c, int status, bool late)
{
    row *r = &c->row;
    char json[1024];
    picture_path(json, sizeof json, o->plan.out, "pictures", r, ".json");
#define ROW_UNKNOWN(name) r->name = (double)NAN;
    ROW_NUMBERS(ROW_UNKNOWN)
#undef ROW_UNKNOWN
    if (late)
        strcpy(r->status, "timeout");
    else if (WIFSIGNALED(status))
        snprintf(r->status, sizeof r->status, "signal %d", WTERMSIG(status));
    else if (WEXITSTATUS(status))
        snprintf(r->status, sizeof r->status, "exit %d", WEXITSTATUS(status));
    else
        strcpy(r->status, row_read_json(json, r) ? "ok" : "no statistics");
    r->reference_relmse = reference_relmse(o, r->scene);
    c->pid = 0;
}

static bool known(const options *o, const rows *all, const row *task)
{
    for (int i = 0; i < all->count; ++i)
        if (row_same_task(&all->at[i], task))
            return row_ok(&all->at[i]) || !o->retry;
    return false;
}

/* All tasks that no row answers yet, in the order they run. */
static bool list_tasks(const options *o, const rows *done, rows *tasks)
{
    const plan *p = &o->plan;
    static column columns[MAX_NAMES * MAX_NAMES];
    int n = columns_of(p, columns);
    for (int seed = 1; seed <= p->seeds; ++seed)
        for (int b = 0; b < p->budgets.count; ++b)
            for (int s = 0; s < p->scenes.count; ++s)
                for (int c = 0; c < n; ++c) {
                    row r;
                    memset(&r, 0, sizeof r);
                    snprintf(r.scene, sizeof r.scene, "%s", scene_name(p->scenes.at[s]));
                    snprintf(r.build, sizeof r.build, "%.31s", columns[c].build);
                    snprintf(r.method, sizeof r.method, "%s", columns[c].method);
                    snprintf(r.budget, sizeof r.budget, "%.23s", p->budgets.at[b]);
                    r.seed = seed;
                    if (!known(o, done, &r) && !rows_add(tasks, &r))
                        return false;
                }
    return true;
}

static void tell(const row *r, int done, int total, double seconds)
{
    double left = seconds / done * (total - done);
    fprintf(stderr, "%3d/%d  %s %s %s seed %d: ", done, total, r->scene, r->method, r->budget, r->seed);
    if (row_ok(r))
        fprintf(stderr, "%.0f spp in %.1f CPU s, relMSE %.4g", r->spp, r->cpu_seconds, r->relmse);
    else
        fprintf(stderr, "%s", r->status);
    fprintf(stderr, "  (about %.0f min left)\n", ceil(left / 60));
}

static void keep(const options *o, rows *all, const row *r, FILE *csv)
{
    if (o->retry) /* the failed row that this one replaces */
        for (int i = 0; i < all->count; ++i)
            if (row_same_task(&all->at[i], r)) {
                all->at[i] = all->at[--all->count];
                break;
            }
    rows_add(all, r);
    row_print_csv(csv, r);
    fflush(csv);
}

static int poll_children(child *children, int jobs, const options *o, rows *all, FILE *csv)
{
    int ended = 0, status;
    for (int i = 0; i < jobs; ++i) {
        child *c = &children[i];
        if (c->pid <= 0)
            continue;
        bool late = wall() > c->deadline;
        if (late || interrupted)
            kill(c->pid, SIGKILL);
        if (waitpid(c->pid, &status, late || interrupted ? 0 : WNOHANG) != c->pid)
            continue;
        finish(o, c, status, late);
        if (!interrupted)
            keep(o, all, &c->row, csv);
        ended |= 1 << i;
    }
    return ended;
}

static bool run_tasks(const options *o, const rows *tasks, rows *all, FILE *csv)
{
    static child children[30];
    int next = 0, done = 0, running = 0;
    double begin = wall();
    while ((next < tasks->count || running) && !interrupted) {
        for (int i = 0; i < o->jobs && next < tasks->count; ++i)
            if (children[i].pid <= 0) {
                if (!start(o, &children[i], &tasks->at[next]))
                    return die("cannot start a process", strerror(errno)), false;
                ++next;
                ++running;
            }
        int ended = poll_children(children, o->jobs, o, all, csv);
        for (int i = 0; i < o->jobs; ++i)
            if (ended & 1 << i) {
                --running;
                tell(&children[i].row, ++done, tasks->count, wall() - begin);
            }
        if (!ended)
            usleep(20000);
    }
    if (interrupted)
        poll_children(children, o->jobs, o, all, csv);
    return !interrupted;
}

/* ---- >>report ----------------------------------------------------------------------------------------------- */

static int report(const options *o, plan *p, const rows *all)
{
    int flags = 0, ok = 0;
    char path[1024];
    for (int i = 0; i < p->scenes.count; ++i) { /* from here on short names */
        char name[128];
        snprintf(name, sizeof name, "%s", scene_name(p->scenes.at[i]));
        strcpy(p->scenes.at[i], name);
    }
    FILE *f = open_in(p->out, "table.md");
    if (!f)
        return 1;
    write_tables(f, p, all);
    fclose(f);
    write_tables(stdout, p, all);
    printf("\nPictures against the first method's (|z| of all and of the worst 16x16 tile):\n");
    for (int s = 0; s < p->scenes.count; ++s) {
        plot_scene(p, all, p->scenes.at[s], false);
        plot_scene(p, all, p->scenes.at[s], true);
        compare_methods(stdout, p, all, p->scenes.at[s]);
    }
    plot_overall(p, all);
    plot_cost(p, all);
    if (p->builds.count > 1)
        printf("\nBuilds:\n");
    for (int s = 0; s < p->scenes.count; ++s)
        flags += judge_builds(stdout, p, all, p->scenes.at[s]);
    for (int i = 0; i < all->count; ++i)
        ok += row_ok(&all->at[i]);
    snprintf(path, sizeof path, "%s/rows.json", p->out);
    if (!rows_write_json(path, all))
        return die("cannot be written", path);
    printf("\n%d rows, %d failed; %s: rows.csv, rows.json, table.md, *.svg\n", all->count, all->count - ok,
           o->plan.out);
    return !ok ? 1 : flags ? 2 : 0;
}

/* ---- >>main ------------------------------------------------------------------------------------------------- */

/* Everything that must hold before hours are spent. */
static int check(const options *o)
{
    char path[1024];
    for (int i = 0; i < o->plan.scenes.count; ++i) {
        const char *scene = o->plan.scenes.at[i];
        if (!scene_file(scene, path, sizeof path))
            return die("no such scene: name one of examples/scenes, a folder in $GUIDE_SCENES or a file", scene);
        if (!reference_file(o, scene_name(scene), path, sizeof path))
            fprintf(stderr, "bench_error: %s has no reference, so no errors are measured; see build/make_reference\n",
                    scene);
    }
    int n = snprintf(path, sizeof path, "%s/pictures", o->plan.out);
    bool made = n < (int)sizeof path && make_folders(path) && access(path, W_OK) == 0;
    return made ? 0 : die("the folder of --out cannot be made", o->plan.out);
}

static void plan_text(const options *o, const rows *tasks)
{
    double seconds = 0;
    for (int i = 0; i < tasks->count; ++i)
        seconds += o->by_spp ? 0 : atof(amount_of(tasks->at[i].budget));
    fprintf(stderr, "%d renders to do", tasks->count);
    if (seconds > 0)
        fprintf(stderr, ", %.0f CPU seconds, at least %.0f minutes with %d at a time", seconds,
                ceil(seconds / 60 / o->jobs), o->jobs);
    fputc('\n', stderr);
}

int main(int argc, char **argv)
{
    static options o;
    static rows all, tasks;
    char settings[512], path[1024], err[512];
    bool cut = false;
    o.size = "320x180";
    o.nee = "on";
    o.max_depth = 13;
    o.jobs = (int)sysconf(_SC_NPROCESSORS_ONLN);
    o.jobs = o.jobs < 1 ? 1 : o.jobs > 30 ? 30 : o.jobs;
    o.plan.seeds = 3;
    o.plan.out = "out/bench-error";
    if (argc == 2 && !strcmp(argv[1], "--help"))
        return fputs(usage, stdout), 0;
    if (parse(&o, argc, argv) || check(&o))
        return 1;
    rows_settings(settings, sizeof settings, o.size, o.max_depth, o.nee);
    snprintf(path, sizeof path, "%s/rows.csv", o.plan.out);
    if (!rows_read(path, settings, &all, &cut, err, sizeof err))
        return die(err, NULL);
    if (!list_tasks(&o, &all, &tasks))
        return die("out of memory", NULL);
    plan_text(&o, &tasks);
    if (o.dry_run)
        return 0;
    if (!rows_write(path, settings, &all)) /* also drops what was cut off */
        return die("cannot be written", path);
    FILE *csv = fopen(path, "a");
    if (!csv)
        return die("cannot be written", path);
    signal(SIGINT, on_interrupt);
    signal(SIGTERM, on_interrupt);
    bool complete = run_tasks(&o, &tasks, &all, csv);
    fclose(csv);
    if (!complete)
        return die("stopped; the same command goes on from here", NULL);
    rows_write(path, settings, &all);
    int rc = report(&o, &o.plan, &all);
    free(all.at);
    free(tasks.at);
    return rc;
}
