/* study_kd.c: the studies of Zheng et al. 2025, "Illumination-Aware Spatial Subdivision for Path Guiding", with
   guide_kd.h in our renderer and on our scenes: cells split by signatures against cells split by sample counts.

     >>plan     what is rendered: studies, presets
     >>run      bench_error renders, one folder for each size and next-event estimation, so that studies share rows
     >>tables   study_kd.md, study_kd.csv, study_kd.json
     >>pictures cells in false colours, error against cells
     >>main

   Every picture is rendered after a training with a frozen field; the training's own pictures are thrown away. */
#define _DEFAULT_SOURCE
#include "bench.h"
#define PROGRAM "study_kd"
#include "error_means.h"
#include "options.h"
#include "plot.h"

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

static const char usage[] = "usage: study_kd [--preset tiny|quick|full] [options]\n"
                            "  --only a,b       of thresholds, nee, resolution, lookahead, criteria, confidence\n"
                            "  --scenes a,b     instead of the preset's, in every study\n"
                            "  --seeds N        instead of the preset's\n"
                            "  --jobs N         renders at a time (default: the number of processors)\n"
                            "  --report         render nothing: tables and pictures of the rows that are there\n"
                            "  --out DIR        (out/study-kd-PRESET)\n"
                            "quick takes about 10 minutes of one core, full half a day. A run that was stopped goes on "
                            "with the same command.\n";

/* ---- >>plan ------------------------------------------------------------------------------------------------- */

#define MAX_DEPTH 13
#define TIMED ":time_structure=on" /* the price of the structure with every render: what is rendered stays the same */
#define VARIANTS 8

typedef struct variant {
    const char *label, *method;
} variant;

enum { THRESHOLDS, NEE, RESOLUTION, LOOKAHEAD, CRITERIA, CONFIDENCE, STUDIES };

typedef struct study {
    const char *name, *title, *note, *nee; /* nee: on, off, or both, with a comma */
    variant variants[VARIANTS];
} study;

#define SIGNATURE                                                                                                      \
    {                                                                                                                  \
        "signatures", "kd" TIMED                                                                                       \
    }
#define COUNT(label, n)                                                                                                \
    {                                                                                                                  \
        label, "kd" TIMED ":split=count:count=" n                                                                      \
    }
static const study studies[STUDIES] = {
    {"thresholds",
     "Signatures against sample counts (Figures 6, 7)",
     "1K is none of the paper's.",

     "on",
     {SIGNATURE, COUNT("32K", "32000"), COUNT("16K", "16000"), COUNT("8K", "8000"), COUNT("4K", "4000"),
      COUNT("1K", "1000")}},
    {"nee",
     "Next-event estimation on and off (Figure 9)",
     "Without it the field learns direct light too: signatures should ask for other cells, counts for as many as the "
     "samples.",
     "on,off",
     {SIGNATURE, COUNT("4K", "4000")}},
    {"resolution",
     "Resolution at equal samples per pixel (Figure 10)",
     "Each size has a reference of its size. Four times the pixels are four times the samples.",

     "on",
     {SIGNATURE, COUNT("32K", "32000"), COUNT("4K", "4000")}},
    {"lookahead",
     "Levels of lookahead cells (Figure 11)",
     "",

     "off",
     {{"1", "kd" TIMED ":lookahead=1"},
      {"3", "kd" TIMED ":lookahead=3"},
      {"5", "kd" TIMED ":lookahead=5"},
      {"6 (default)", "kd" TIMED},
      {"7", "kd" TIMED ":lookahead=7"}}},
    {"criteria",
     "Each criterion alone (Figure 12)",
     "",

     "off",
     {{"both (default)", "kd" TIMED},
      {"radiance", "kd" TIMED ":criteria=radiance"},
      {"direction", "kd" TIMED ":criteria=direction"}}},
    {"confidence",
     "Probability of a wrong split, each criterion alone (Figure 13)",
     "The gate is off, so that all cells go on learning.",

     "on",
     {{"radiance 1e-1", "kd" TIMED ":gate=off:criteria=radiance:confidence=1e-1"},
      {"radiance 1e-4", "kd" TIMED ":gate=off:criteria=radiance"},
      {"radiance 1e-7", "kd" TIMED ":gate=off:criteria=radiance:confidence=1e-7"},
      {"direction 1e-1", "kd" TIMED ":gate=off:criteria=direction:confidence=1e-1"},
      {"direction 1e-4", "kd" TIMED ":gate=off:criteria=direction"},
      {"direction 1e-7", "kd" TIMED ":gate=off:criteria=direction:confidence=1e-7"}}},
};

/* size: of every study but that of resolutions, which has its own. train, spp: samples per pixel. */
typedef struct preset {
    const char *name, *size, *sizes, *train, *spp;
    int seeds;
    const char *scenes[STUDIES];
} preset;

static const preset presets[] = {
    {"tiny", "80x45", "32x18,80x45", "8", "4", 2, {"cornell,pool", "pool", "pool", "pool", "pool", "cornell"}},
    {"quick",
     "160x90",
     "80x45,160x90,320x180",
     "32",
     "32",
     3,
     {"ajar,pool,torus", "pool,torus", "pool,torus", "pool,torus", "pool,hall", "cornell,torus"}},
    {"full",
     "320x180",
     "80x45,160x90,320x180",
     "8,32,128",
     "64",
     5,
     {"ajar,egg,gloss,lamps,maze,pool,torus,cornell,hall", "ajar,pool,torus,hall", "ajar,pool,torus,hall",
      "ajar,pool,torus,hall", "ajar,pool,torus,hall", "ajar,pool,torus,hall,cornell"}},
};
#define PRESETS (sizeof presets / sizeof presets[0])

typedef struct options {
    preset preset;
    const char *only, *out, *jobs, *program;
    bool report;
} options;

/* Is the word in the list a,b,c? */
static bool listed(const char *list, const char *word)
{
    size_t n = strlen(word);
    for (const char *at = list; at; at = strchr(at, ',') ? strchr(at, ',') + 1 : NULL)
        if (!strncmp(at, word, n) && (!at[n] || at[n] == ','))
            return true;
    return false;
}

static names split(const char *list)
{
    names out;
    out.count = 0;
    for (const char *at = list; *at && out.count < MAX_NAMES;) {
        size_t n = strcspn(at, ",");
        snprintf(out.at[out.count++], sizeof out.at[0], "%.*s", (int)n, at);
        at += n + (at[n] == ',');
    }
    return out;
}

static int variants_of(const study *s)
{
    int n = 0;
    while (n < VARIANTS && s->variants[n].label)
        ++n;
    return n;
}

/* One study at one size, with or without next-event estimation: what one call of bench_error renders. */
typedef struct block {
    plan plan;
    const study *study;
    const char *size, *nee;
    char folder[600];
    rows rows;
} block;

static const char *sizes_of(const options *o, int which)
{
    return which == RESOLUTION ? o->preset.sizes : o->preset.size;
}

static void make_block(const options *o, int which, const char *size, const char *nee, block *b)
{
    memset(b, 0, sizeof *b);
    b->study = &studies[which];
    b->size = size;
    b->nee = nee;
    snprintf(b->folder, sizeof b->folder, "%.500s/%s-nee-%s", o->out, size, nee);
    b->plan.scenes = split(o->preset.scenes[which]);
    b->plan.builds = split("render");
    for (int i = 0; i < variants_of(b->study); ++i)
        strcpy(b->plan.methods.at[b->plan.methods.count++], b->study->variants[i].method);
    names trainings = split(o->preset.train);
    for (int i = 0; i < trainings.count; ++i)
        snprintf(b->plan.budgets.at[i], sizeof b->plan.budgets.at[i], "%s+%sspp", trainings.at[i], o->preset.spp);
    b->plan.budgets.count = trainings.count;
    b->plan.seeds = o->preset.seeds;
    b->plan.trained = true;
    b->plan.out = b->folder;
}

/* ---- >>run -------------------------------------------------------------------------------------------------- */

/* A program of this one's folder, its standard output in `log`. Exit status. */
static int call(const options *o, const char *name, const char *const *words, const char *log)
{
    const char *slash = strrchr(o->program, '/');
    const char *argv[40];
    char path[1024];
    int n = 0, status = 0;
    snprintf(path, sizeof path, "%.*s/%s", slash ? (int)(slash - o->program) : 1, slash ? o->program : ".", name);
    argv[n++] = path;
    while (*words && n < 39)
        argv[n++] = *words++;
    argv[n] = NULL;
    fflush(NULL);
    pid_t pid = fork();
    if (pid == 0) {
        int fd = log ? open(log, O_WRONLY | O_CREAT | O_TRUNC, 0644) : -1;
        if (fd >= 0)
            dup2(fd, 1);
        execv(path, (char *const *)argv);
        perror(path);
        _exit(127);
    }
    if (pid < 0 || waitpid(pid, &status, 0) != pid)
        return 127;
    return WIFEXITED(status) ? WEXITSTATUS(status) : 128;
}

/* Words of a list, with commas. */
static void join(char *text, size_t size, const names *n)
{
    text[0] = 0;
    for (int i = 0; i < n->count; ++i)
        snprintf(text + strlen(text), size - strlen(text), "%s%s", i ? "," : "", n->at[i]);
}

static int render(const options *o, const block *b)
{
    static char methods[4096], scenes[4096], log[800], seeds[16], depth[16];
    join(methods, sizeof methods, &b->plan.methods);
    join(scenes, sizeof scenes, &b->plan.scenes);
    snprintf(seeds, sizeof seeds, "%d", b->plan.seeds);
    snprintf(depth, sizeof depth, "%d", MAX_DEPTH);
    snprintf(log, sizeof log, "%s/bench_error.txt", b->folder);
    const char *words[] = {"--scenes", scenes,        "--methods", methods,   "--size",
                           b->size,    "--nee",       b->nee,      "--train", o->preset.train,
                           "--spp",    o->preset.spp, "--seeds",   seeds,     "--out",
                           b->folder,  "--max-depth", depth,       "--retry", o->jobs ? "--jobs" : NULL,
                           o->jobs,    NULL};
    fprintf(stderr, "%s, %s, nee %s: ", b->study->name, b->size, b->nee);
    if (!make_folders(b->folder))
        return die("cannot be made", b->folder);
    return call(o, "bench_error", words, log);
}

static int read_rows(block *b)
{
    char path[800], settings[256], err[512];
    bool cut;
    rows_settings(settings, sizeof settings, b->size, MAX_DEPTH, b->nee);
    snprintf(path, sizeof path, "%s/rows.csv", b->folder);
    return rows_read(path, settings, &b->rows, &cut, err, sizeof err) ? 0 : die(err, NULL);
}

/* ---- >>tables ----------------------------------------------------------------------------------------------- */

static double value_cells(const row *r) { return r->cells; }
static double value_kib(const row *r) { return r->bytes / 1024; }
static double value_light(const row *r) { return r->samples - r->zeros; }
/* CPU seconds, less those that went into measuring the structure's. */
static double value_cost(const row *r) { return r->cpu_seconds - r->structure_seconds; }

static estimate mean(const block *b, int scene, int v, int budget, row_value of)
{
    column c = {b->plan.builds.at[0], b->plan.methods.at[v]};
    return mean_of(&b->plan, &b->rows, b->plan.scenes.at[scene], c, b->plan.budgets.at[budget], of);
}

/* Of variant v over variant w. */
static estimate ratio(const block *b, int scene, int v, int w, int budget, row_value of)
{
    column cv = {b->plan.builds.at[0], b->plan.methods.at[v]}, cw = {b->plan.builds.at[0], b->plan.methods.at[w]};
    return ratio_of(&b->plan, &b->rows, b->plan.scenes.at[scene], cv, cw, b->plan.budgets.at[budget], of);
}

/* Standard deviation of one picture's logarithm over seeds, from all variants of a line: 0.05 = 5 %. */
static double scatter(const block *b, int scene, int budget, row_value of)
{
    double sum = 0;
    int degrees = 0;
    for (int v = 0; v < b->plan.methods.count; ++v) {
        estimate e = mean(b, scene, v, budget, of);
        if (e.count < 2)
            continue;
        double error = log(e.high / e.low) / (2 * student(e.count - 1)); /* of the mean */
        sum += error * error * e.count * (e.count - 1);
        degrees += e.count - 1;
    }
    return degrees ? sqrt(sum / degrees) : (double)NAN;
}

typedef void (*cell_text)(FILE *f, const block *b, int scene, int v, int budget);

static void text_errors(FILE *f, const block *b, int scene, int v, int budget)
{
    estimate m = mean(b, scene, v, budget, value_mrae), r = mean(b, scene, v, budget, value_relmse);
    if (m.count)
        fprintf(f, " %.3g; %.3g |", m.value, r.value);
    else
        fputs(" - |", f);
}

static void text_cells(FILE *f, const block *b, int scene, int v, int budget)
{
    estimate c = mean(b, scene, v, budget, value_cells), k = mean(b, scene, v, budget, value_kib);
    if (c.count)
        fprintf(f, " %.0f; %.0f |", c.value, k.value);
    else
        fputs(" - |", f);
}

/* What a line tells besides the scene: only what differs within the study. */
static void line_head(FILE *f, const options *o, const block *b, int scene, int budget)
{
    fprintf(f, "| %s", b->plan.scenes.at[scene]);
    if (strchr(sizes_of(o, (int)(b->study - studies)), ','))
        fprintf(f, ", %s", b->size);
    if (strchr(b->study->nee, ','))
        fprintf(f, ", nee %s", b->nee);
    if (strchr(o->preset.train, ','))
        fprintf(f, ", %s", b->plan.budgets.at[budget]);
    fputs(" |", f);
}

static void table_head(FILE *f, const block *b, const char *more)
{
    fputs("\n| scene |", f);
    for (int v = 0; v < b->plan.methods.count; ++v)
        fprintf(f, " %s |", b->study->variants[v].label);
    fprintf(f, "%s\n|---|", more);
    for (int v = 0; v < b->plan.methods.count; ++v)
        fputs("---|", f);
    for (const char *at = more; *at; ++at)
        if (*at == '|')
            fputs("---|", f);
    fputc('\n', f);
}

/* One line for each scene and training of the blocks of a study. */
static void table(FILE *f, const options *o, const block *blocks, int count, cell_text text, row_value spread)
{
    table_head(f, blocks, spread ? " scatter |" : "");
    for (int s = 0; s < blocks->plan.scenes.count; ++s)
        for (int i = 0; i < count; ++i)
            for (int g = 0; g < blocks->plan.budgets.count; ++g) {
                line_head(f, o, &blocks[i], s, g);
                for (int v = 0; v < blocks->plan.methods.count; ++v)
                    text(f, &blocks[i], s, v, g);
                double seeds = spread ? scatter(&blocks[i], s, g, spread) : 0;
                if (isfinite(seeds) && spread)
                    fprintf(f, " %.0f %% |", 100 * seeds);
                else if (spread)
                    fputs(" - |", f);
                fputc('\n', f);
            }
}

static void text_ratio(FILE *f, estimate e, int digits)
{
    if (e.count)
        fprintf(f, " %.*f", digits, e.value);
    else
        fputs(" -", f);
    if (isfinite(e.low)) /* more than one seed */
        fprintf(f, " (%.*f .. %.*f)", digits, e.low, digits, e.high);
    fputs(" |", f);
}

#define LIMIT 1.02

/* What a ratio and its interval say of the claim that it is at most LIMIT; NaN, as of one seed, decides nothing. */
static const char *claim_of(estimate e)
{
    if (e.high <= LIMIT)
        return "shown";
    if (e.low > LIMIT)
        return "refuted";
    return e.value <= LIMIT ? "open, likely" : "open, unlikely";
}

/* The paper's claim: MRAE of signatures at most 1.02 times that of the best of the four thresholds, with fewer cells
   than 4K. The best is picked by the errors that are compared, which favours the thresholds by about the scatter. */
static void verdict(FILE *f, const options *o, const block *b)
{
    enum { FIRST = 1, LAST = 4 };
    int held = 0, failed = 0, fewer = 0, all = 0;
    fputs(
        "\n| scene | best of the four | MRAE over its (95 %) | relMSE | CPU s | at most 1.02 | cells over 4K's | KiB | "
        "non-zero samples |\n|---|---|---|---|---|---|---|---|---|\n",
        f);
    for (int s = 0; s < b->plan.scenes.count; ++s)
        for (int g = 0; g < b->plan.budgets.count; ++g) {
            int best = FIRST;
            for (int v = FIRST; v <= LAST; ++v)
                if (mean(b, s, v, g, value_mrae).value < mean(b, s, best, g, value_mrae).value)
                    best = v;
            estimate e = ratio(b, s, 0, best, g, value_mrae), c = ratio(b, s, 0, LAST, g, value_cells);
            if (!e.count)
                continue;
            line_head(f, o, b, s, g);
            fprintf(f, " %s |", b->study->variants[best].label);
            text_ratio(f, e, 3);
            fprintf(f, " %.3f | %.2f |", ratio(b, s, 0, best, g, value_relmse).value,
                    ratio(b, s, 0, best, g, value_cost).value);
            fprintf(f, " %s | %.2f | %.2f | %.0f |\n", claim_of(e), c.value, ratio(b, s, 0, LAST, g, value_kib).value,
                    mean(b, s, 0, g, value_light).value);
            held += e.high <= LIMIT;
            failed += e.low > LIMIT;
            fewer += c.value < 1;
            all++;
        }
    fprintf(f,
            "\nMRAE at most 1.02 times the best threshold's: shown on %d of %d lines, refuted on %d, open on %d. Fewer "
            "cells than 4K: %d of %d.\n",
            held, all, failed, all - held - failed, fewer, all);
}

/* All scenes' errors over those of signatures. */
static void overall_lines(FILE *f, const block *b)
{
    if (b->plan.scenes.count < 2)
        return;
    fprintf(f, "\n| over those of %s, geometric means of the scenes |", b->study->variants[0].label);
    for (int v = 1; v < b->plan.methods.count; ++v)
        fprintf(f, " %s |", b->study->variants[v].label);
    fputs("\n|---|", f);
    for (int v = 1; v < b->plan.methods.count; ++v)
        fputs("---|", f);
    const char *what[] = {"MRAE", "relMSE", "cells", "KiB", "CPU s"};
    const row_value of[] = {value_mrae, value_relmse, value_cells, value_kib, value_cost};
    for (int k = 0; k < 5; ++k)
        for (int g = 0; g < b->plan.budgets.count; ++g) {
            fprintf(f, "\n| %s, %s |", what[k], b->plan.budgets.at[g]);
            for (int v = 1; v < b->plan.methods.count; ++v) {
                column c = {b->plan.builds.at[0], b->plan.methods.at[v]};
                column first = {b->plan.builds.at[0], b->plan.methods.at[0]};
                overall e = overall_ratio(&b->plan, &b->rows, c, first, b->plan.budgets.at[g], of[k]);
                text_ratio(f, e.mean, 2);
            }
        }
    fputc('\n', f);
}

/* Sums over seeds of a scene, or of all (scene < 0): learning, structure, training, all in CPU seconds. */
typedef struct cost {
    double learning, structure, training;
} cost;

static cost cost_of(const block *b, int scene, int v, int budget)
{
    cost c = {0, 0, 0};
    for (int s = 0; s < b->plan.scenes.count; ++s)
        for (int seed = 1; seed <= b->plan.seeds && (scene < 0 || s == scene); ++seed) {
            const row *r = find_row(&b->rows, b->plan.scenes.at[s], b->plan.builds.at[0], b->plan.methods.at[v],
                                    b->plan.budgets.at[budget], seed);
            if (!r)
                continue;
            c.learning += r->record_seconds + r->update_seconds - r->structure_seconds;
            c.structure += r->structure_seconds;
            c.training += r->train_seconds - r->structure_seconds;
        }
    return c;
}

static void text_cost(FILE *f, const block *b, int scene, int v, int budget)
{
    cost c = cost_of(b, scene, v, budget);
    if (c.training > 0)
        fprintf(f, " %.1f; %.1f %% |", 100 * c.learning / c.training, 100 * c.structure / c.training);
    else
        fputs(" - |", f);
}

static void write_cost(FILE *f, const options *o, const block *b)
{
    fputs(
        "\n**Cost of learning (Table 1)**: recording and learning; of which the tree: finding cells, sorting samples, "
        "signatures, splits. Shares of the training's CPU seconds.\n",
        f);
    table(f, o, b, 1, text_cost, NULL);
    for (int g = 0; g < b->plan.budgets.count; ++g) {
        fprintf(f, "| all, %s |", b->plan.budgets.at[g]);
        for (int v = 0; v < b->plan.methods.count; ++v)
            text_cost(f, b, -1, v, g);
        fputc('\n', f);
    }
}

/* What all tables have in common. */
static void write_head(FILE *f, const options *o)
{
    const char *commit = getenv("BENCH_COMMIT");
    char cpu[200];
    bench_cpu(cpu, sizeof cpu);
    names trainings = split(o->preset.train);
    double paths = atof(trainings.at[trainings.count - 1]);
    int w = 0, h = 0;
    parse_size(o->preset.size, &w, &h);
    fprintf(f,
            "\nPreset `%s`: %s samples per pixel of training, whose pictures are thrown away, then %s with the frozen "
            "field; seeds 1 to %d; %s, %s, commit %s. That is %.2g million camera paths of training at %s; the paper's "
            "had 265. Errors are geometric means over the seeds; scatter is the standard deviation of one picture's "
            "MRAE between seeds, that of the mean is %.2f of it.\n",
            o->preset.name, o->preset.train, o->preset.spp, o->preset.seeds, cpu, bench_compiler(),
            commit ? commit : "not told", 1e-6 * w * h * paths, o->preset.size, 1 / sqrt((double)o->preset.seeds));
}

/* Renders that should be there and are not, or failed. */
static int missing(const block *b)
{
    int n = 0;
    for (int s = 0; s < b->plan.scenes.count; ++s)
        for (int v = 0; v < b->plan.methods.count; ++v)
            for (int g = 0; g < b->plan.budgets.count; ++g)
                n += b->plan.seeds - mean(b, s, v, g, value_mrae).count;
    return n;
}

static void write_study(FILE *f, const options *o, const block *blocks, int count)
{
    const study *s = blocks->study;
    fprintf(f, "\n**%s**: MRAE; relMSE. Size %s, next-event estimation %s.%s%s\n", s->title,
            sizes_of(o, (int)(s - studies)), s->nee, s->note[0] ? " " : "", s->note);
    int gone = 0;
    for (int i = 0; i < count; ++i)
        gone += missing(&blocks[i]);
    if (gone)
        fprintf(f, "\n%d renders are missing, failed or were not measured.\n", gone);
    table(f, o, blocks, count, text_errors, value_mrae);
    fputs("\nCells; KiB of the field:\n", f);
    table(f, o, blocks, count, text_cells, NULL);
    if (s != &studies[THRESHOLDS])
        return;
    verdict(f, o, blocks);
    overall_lines(f, blocks);
    write_cost(f, o, blocks);
}

/* Every mean as a line of CSV and JSON. */
#define STUDY_NUMBERS(X)                                                                                               \
    X(mrae)                                                                                                            \
    X(relmse)                                                                                                          \
    X(cells)                                                                                                           \
    X(lookahead_cells)                                                                                                 \
    X(lobes)                                                                                                           \
    X(levels)                                                                                                          \
    X(bytes)                                                                                                           \
    X(cpu_seconds)                                                                                                     \
    X(train_seconds)                                                                                                   \
    X(record_seconds)                                                                                                  \
    X(update_seconds)                                                                                                  \
    X(structure_seconds)                                                                                               \
    X(samples)                                                                                                         \
    X(zeros)

#define STUDY_VALUE(name)                                                                                              \
    static double number_##name(const row *r) { return r->name; }
STUDY_NUMBERS(STUDY_VALUE)
#undef STUDY_VALUE

static void data_head(FILE *csv, FILE *json, const options *o)
{
    fputs("study,scene,size,nee,budget,variant,method,seeds", csv);
#define STUDY_HEAD(name) fputs("," #name "," #name "_low," #name "_high", csv);
    STUDY_NUMBERS(STUDY_HEAD)
#undef STUDY_HEAD
    fputc('\n', csv);
    fprintf(json, "{\"preset\": \"%s\", \"rows\": [", o->preset.name);
}

static void data_number(FILE *csv, FILE *json, const char *name, estimate e)
{
    if (!e.count) {
        fputs(",,,", csv);
        return;
    }
    fprintf(csv, ",%.6g", e.value);
    fprintf(json, ", \"%s\": %.6g", name, e.value);
    if (isfinite(e.low))
        fprintf(csv, ",%.6g,%.6g", e.low, e.high);
    else
        fputs(",,", csv);
    if (isfinite(e.low))
        fprintf(json, ", \"%s_95\": [%.6g, %.6g]", name, e.low, e.high);
}

static void write_data(FILE *csv, FILE *json, const block *b, bool *first)
{
    for (int s = 0; s < b->plan.scenes.count; ++s)
        for (int g = 0; g < b->plan.budgets.count; ++g)
            for (int v = 0; v < b->plan.methods.count; ++v) {
                int seeds = mean(b, s, v, g, value_mrae).count;
                fprintf(csv, "%s,%s,%s,%s,%s,%s,%s,%d", b->study->name, b->plan.scenes.at[s], b->size, b->nee,
                        b->plan.budgets.at[g], b->study->variants[v].label, b->plan.methods.at[v], seeds);
                fprintf(json,
                        "%s\n  {\"study\": \"%s\", \"scene\": \"%s\", \"size\": \"%s\", \"nee\": \"%s\", \"budget\": "
                        "\"%s\", \"variant\": \"%s\", \"method\": \"%s\", \"seeds\": %d",
                        *first ? "" : ",", b->study->name, b->plan.scenes.at[s], b->size, b->nee, b->plan.budgets.at[g],
                        b->study->variants[v].label, b->plan.methods.at[v], seeds);
#define STUDY_PRINT(name) data_number(csv, json, #name, mean(b, s, v, g, number_##name));
                STUDY_NUMBERS(STUDY_PRINT)
#undef STUDY_PRINT
                fputc('\n', csv);
                fputc('}', json);
                *first = false;
            }
}

/* ---- >>pictures --------------------------------------------------------------------------------------------- */

/* The cells of signatures and of the other variants side by side, after the longest training. */
static int draw_cells(const options *o, const block *b)
{
    static char paths[VARIANTS][1024], labels[VARIANTS][64], out[1024];
    for (int s = 0; s < b->plan.scenes.count; ++s) {
        const char *words[2 * VARIANTS + 3] = {"--cells", out};
        int n = 2;
        snprintf(out, sizeof out, "%s/cells-%s.png", o->out, b->plan.scenes.at[s]);
        for (int v = 0; v < b->plan.methods.count; ++v) {
            const row *r = find_row(&b->rows, b->plan.scenes.at[s], b->plan.builds.at[0], b->plan.methods.at[v],
                                    b->plan.budgets.at[b->plan.budgets.count - 1], 1);
            if (!r)
                continue;
            picture_path(paths[v], sizeof paths[v], b->folder, "pictures", r, ".exr");
            snprintf(labels[v], sizeof labels[v], "%s: %.0f cells", b->study->variants[v].label, r->cells);
            words[n++] = paths[v];
            words[n++] = labels[v];
        }
        if (n > 2 && call(o, "imgerr", words, NULL))
            return 1;
    }
    return 0;
}

/* Error against the number of cells: what is below the line of the sample counts spends its cells better. */
static bool plot_cells(const options *o, const block *b, int scene)
{
    static double x[VARIANTS], y[VARIANTS];
    char path[1024], title[200];
    int n = b->plan.methods.count, last = b->plan.budgets.count - 1;
    for (int v = 0; v < n; ++v) {
        x[v] = mean(b, scene, v, last, value_cells).value;
        y[v] = mean(b, scene, v, last, value_mrae).value;
    }
    plot_series series[] = {{b->study->variants[0].label, x, y, 1, false},
                            {"32K .. 1K samples", x + 1, y + 1, n - 1, true}};
    snprintf(path, sizeof path, "%s/mrae-cells-%s.svg", o->out, b->plan.scenes.at[scene]);
    snprintf(title, sizeof title, "%s: error against cells, %s", b->plan.scenes.at[scene], b->plan.budgets.at[last]);
    return plot_write(path, title, "cells", "MRAE", series, 2, true, true);
}

/* Figure 7: how a quantity goes with the training. */
static bool plot_training(const options *o, const block *b, int scene, row_value of, const char *name, const char *unit)
{
    static double x[VARIANTS][MAX_NAMES], y[VARIANTS][MAX_NAMES];
    plot_series series[VARIANTS];
    char path[1024], title[200];
    for (int v = 0; v < b->plan.methods.count; ++v) {
        for (int g = 0; g < b->plan.budgets.count; ++g) {
            x[v][g] = mean(b, scene, v, g, value_train_spp).value;
            y[v][g] = mean(b, scene, v, g, of).value;
        }
        series[v] = (plot_series){b->study->variants[v].label, x[v], y[v], b->plan.budgets.count, v > 0};
    }
    snprintf(path, sizeof path, "%s/%s-train-%s.svg", o->out, name, b->plan.scenes.at[scene]);
    snprintf(title, sizeof title, "%s: %s after a training", b->plan.scenes.at[scene], unit);
    return plot_write(path, title, "samples per pixel of the training", unit, series, b->plan.methods.count, true,
                      true);
}

/* Cells are drawn after the first study, and larger after that of resolutions, whose scenes are fewer. */
static int draw(const options *o, const block *blocks, int count)
{
    bool first = blocks->study == &studies[THRESHOLDS], ok = true;
    if (first || blocks->study == &studies[RESOLUTION])
        ok = draw_cells(o, &blocks[count - 1]) == 0;
    for (int s = 0; s < blocks->plan.scenes.count && first; ++s) {
        ok = plot_cells(o, blocks, s) && ok;
        if (blocks->plan.budgets.count > 1)
            ok = plot_training(o, blocks, s, value_mrae, "mrae", "MRAE") &&
                 plot_training(o, blocks, s, value_kib, "memory", "KiB of the field") && ok;
    }
    return ok ? 0 : die("plots and pictures cannot be written", o->out);
}

/* ---- >>main ------------------------------------------------------------------------------------------------- */

static int parse(options *o, int argc, char **argv)
{
    const char *scenes = NULL, *name = "quick";
    int seeds = 0;
    o->program = argv[0];
    for (int i = 1; i < argc; ++i) {
        if (!strcmp(argv[i], "--report")) {
            o->report = true;
            continue;
        }
        const char *const keys[] = {"--preset", "--only", "--scenes", "--out", "--jobs"};
        const char **values[] = {&name, &o->only, &scenes, &o->out, &o->jobs};
        bool known = false;
        for (size_t k = 0; k < sizeof keys / sizeof keys[0] && i + 1 < argc; ++k)
            if (!strcmp(argv[i], keys[k])) {
                *values[k] = argv[i + 1];
                known = true;
            }
        if (i + 1 < argc && !strcmp(argv[i], "--seeds")) {
            seeds = atoi(argv[i + 1]);
            if (seeds < 1 || seeds > 1000)
                return die("--seeds: not usable", argv[i + 1]);
            known = true;
        }
        if (!known)
            return die("unknown option, or it needs a value; see --help", argv[i]);
        ++i;
    }
    size_t p = 0;
    while (p < PRESETS && strcmp(presets[p].name, name))
        ++p;
    if (p == PRESETS)
        return die("--preset is tiny, quick or full, not", name);
    o->preset = presets[p];
    o->preset.seeds = seeds ? seeds : o->preset.seeds;
    names only = split(o->only ? o->only : "");
    for (int i = 0; i < only.count; ++i) {
        int k = 0;
        while (k < STUDIES && strcmp(studies[k].name, only.at[i]))
            ++k;
        if (k == STUDIES)
            return die("--only names no study", only.at[i]);
    }
    for (int i = 0; scenes && i < STUDIES; ++i)
        o->preset.scenes[i] = scenes;
    return 0;
}

/* A study: render what is missing, then write its tables. */
static int run_study(const options *o, int which, FILE *md, FILE *csv, FILE *json, bool *first)
{
    static block blocks[8];
    static names sizes, nees;
    int count = 0, rc = 0;
    sizes = split(sizes_of(o, which));
    nees = split(studies[which].nee);
    for (int s = 0; s < sizes.count && !rc; ++s)
        for (int n = 0; n < nees.count && !rc && count < 8; ++n) {
            block *b = &blocks[count++];
            make_block(o, which, sizes.at[s], nees.at[n], b);
            rc = o->report ? 0 : render(o, b);
            rc = rc ? rc : read_rows(b);
        }
    if (!rc) {
        write_study(md, o, blocks, count);
        rc = draw(o, blocks, count);
    }
    for (int i = 0; i < count; ++i) {
        if (!rc)
            write_data(csv, json, &blocks[i], first);
        free(blocks[i].rows.at);
    }
    return rc;
}

int main(int argc, char **argv)
{
    static options o;
    char out[64];
    bool first = true;
    int rc = 0;
    if (argc == 2 && !strcmp(argv[1], "--help"))
        return fputs(usage, stdout), 0;
    if (parse(&o, argc, argv))
        return 1;
    snprintf(out, sizeof out, "out/study-kd-%s", o.preset.name);
    o.out = o.out ? o.out : out;
    if (!make_folders(o.out))
        return die("cannot be made", o.out);
    FILE *md = open_in(o.out, "study_kd.md"), *csv = open_in(o.out, "study_kd.csv");
    FILE *json = open_in(o.out, "study_kd.json");
    if (!md || !csv || !json)
        return 1;
    write_head(md, &o);
    data_head(csv, json, &o);
    for (int i = 0; i < STUDIES && !rc; ++i)
        if (!o.only || listed(o.only, studies[i].name))
            rc = run_study(&o, i, md, csv, json, &first);
    fputs("\n]}\n", json);
    bool ok = !ferror(md) && !ferror(csv) && !ferror(json);
    ok = fclose(md) == 0 && fclose(csv) == 0 && fclose(json) == 0 && ok;
    return rc ? rc : ok ? 0 : die("cannot be written", o.out);
}
