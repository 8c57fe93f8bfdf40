/* bench_field: what guiding methods learn of known radiance fields, at what cost, and how the cost grows.

     build/bench_field [--methods a,b] [--fields FILE...] [--samples 14,17,20] [--seeds 5] [--exact] [--json FILE]
     build/bench_field --growth [--methods a,b] [--fields FILE] [--max-log2 22] [--plot DIRECTORY] [--json FILE]

   A: second moment over squared mean of radiance with the guide's density alone; C: of radiance times cosine with half
   cosine and half guide; 1 is perfect (sf1.h). A field named sf1 is built in. --growth exits with 1 where a method's
   time per sample or query grows worse than logarithmically, or its scores depend on the scene's size. */
#define GSD_IMPLEMENTATION
#include "field_sdtree.h"
#define GKD_IMPLEMENTATION
#include "field_kd.h"
#include "field_none.h"
#include "field_openpgl.h"
#include "plot.h"

#include <limits.h>
#include <stdarg.h>

static const field_method *const all_methods[] = {
    &field_none_method,     &field_sdtree_method,  &field_sdtree_switching_method, &field_kd_method,
    &field_kd_count_method, &field_openpgl_method, &field_openpgl_4000_method,     &field_openpgl_quadtree_method};
#define METHODS ((int)(sizeof all_methods / sizeof *all_methods))
#define MAX_FIELDS 32
#define MAX_SIZES 24

typedef struct named_field {
    const char *name;
    sf1_field field;
} named_field;

typedef struct options {
    const field_method *methods[METHODS];
    named_field fields[MAX_FIELDS];
    int method_count, field_count, size_count;
    int sizes[MAX_SIZES]; /* log2 of samples */
    int seeds, max_log2;
    bool exact, growth;
    const char *json, *plot;
} options;

static FILE *json_file;
static int json_rows;

static void fail(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    fputs("bench_field: ", stderr);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    va_end(arguments);
    exit(1);
}

/* ---- one learned field -------------------------------------------------------------------------------------- */

typedef struct outcome {
    sf1_score score;
    double record_ns, query_ns, bytes, cells;
} outcome;

/* The scored state, and where in the world it lies. */
typedef struct scored {
    const field_method *method;
    void *state;
    double extent;
} scored;

static double score_pdf(void *user, const sf1_point *point, const double *direction, int cosine)
{
    const scored *s = user;
    float p[3], n[3], w[3];
    for (int k = 0; k < 3; ++k) {
        p[k] = (float)((double)(float)point->x[k] * s->extent);
        n[k] = (float)point->n[k];
        w[k] = (float)direction[k];
    }
    field_place place = {p, cosine ? n : NULL, n};
    return s->method->pdf(s->state, place, w);
}

/* Learn, check, time and (with points > 0) score. */
static outcome measure(const field_setup *setup, int points, int directions)
{
    static field_queries queries;
    const field_method *m = setup->method;
    outcome out = {{0, 0}, 0, 0, 0, 0};
    field_learned learned = field_learn(setup);
    if (learned.error)
        fail("%s, 2^%d samples: %s", m->name, setup->log2_samples, learned.error);
    scored s = {m, learned.state, setup->extent};
    field_make_queries(&queries, setup->field, setup->extent, setup->seed + 9000);
    for (int normals = 0; normals < 2; ++normals) {
        const char *error = field_check(m, s.state, &queries, normals);
        if (error)
            fail("%s, 2^%d samples, %s: %s", m->name, setup->log2_samples, normals ? "normal given" : "no normal",
                 error);
    }
    out.record_ns = learned.ns;
    out.query_ns = field_query_ns(m, s.state, &queries);
    out.bytes = (double)m->bytes(s.state);
    out.cells = (double)m->cells(s.state);
    if (points)
        out.score = sf1_evaluate(setup->field, score_pdf, &s, setup->seed + 4000, points, directions);
    m->destroy(s.state);
    return out;
}

/* Times: the least over the seeds, as the machine may be shared; all else: the mean. */
static void add_outcome(outcome *mean, const outcome *one, int seed, int seeds)
{
    mean->score.a += one->score.a / seeds;
    mean->score.c += one->score.c / seeds;
    mean->bytes += one->bytes / seeds;
    mean->cells += one->cells / seeds;
    mean->record_ns = seed && mean->record_ns < one->record_ns ? mean->record_ns : one->record_ns;
    mean->query_ns = seed && mean->query_ns < one->query_ns ? mean->query_ns : one->query_ns;
}

static bool bytes_told(const outcome *o) { return o->bytes > 0 || o->cells <= 0; }

static void json_row(const field_method *m, const char *field, int log2_samples, double extent, const outcome *o)
{
    if (!json_file)
        return;
    fprintf(json_file, "%s\n  {\"method\": \"%s\", \"field\": \"", json_rows++ ? "," : "", m->name);
    for (const char *c = field; *c; ++c)
        if ((unsigned char)*c >= ' ')
            fprintf(json_file, *c == '"' || *c == '\\' ? "\\%c" : "%c", *c);
    fprintf(json_file, "\", \"log2_samples\": %d, \"extent\": %g, ", log2_samples, extent);
    if (o->score.a > 0)
        fprintf(json_file, "\"a\": %.6g, \"c\": %.6g, ", o->score.a, o->score.c);
    fprintf(json_file, "\"ns_per_sample\": %.2f, \"ns_per_query\": %.2f, \"cells\": %.0f", o->record_ns, o->query_ns,
            o->cells);
    if (bytes_told(o))
        fprintf(json_file, ", \"bytes\": %.0f", o->bytes);
    fputc('}', json_file);
}

/* Says so where a method is not. */
static bool built(const field_method *m)
{
    if (m->create)
        return true;
    printf("%-18s not built: make OPENPGL_DIR=/path/to/installation\n", m->name);
    if (json_file)
        fprintf(json_file, "%s\n  {\"method\": \"%s\", \"built\": false}", json_rows++ ? "," : "", m->name);
    return false;
}

/* ---- scores ------------------------------------------------------------------------------------------------- */

static void run_scores(const options *o)
{
    for (int f = 0; f < o->field_count; ++f) {
        const named_field *field = &o->fields[f];
        printf("\n%s: %d source%s, %s weights, %d seed%s, %d updates\n", field->name, field->field.count,
               field->field.count == 1 ? "" : "s", o->exact ? "exact" : "noisy", o->seeds, o->seeds == 1 ? "" : "s",
               SF1_UPDATES);
        printf("%-18s %8s %8s %8s %10s %10s %8s %10s\n", "method", "samples", "A", "C", "ns/sample", "ns/query",
               "cells", "bytes");
        for (int i = 0; i < o->method_count; ++i)
            for (int k = 0; built(o->methods[i]) && k < o->size_count; ++k) {
                outcome mean = {{0, 0}, 0, 0, 0, 0};
                for (int seed = 0; seed < o->seeds; ++seed) {
                    field_setup setup = {o->methods[i], &field->field, 1, 1000 + (uint64_t)seed, o->sizes[k], o->exact};
                    outcome one = measure(&setup, SF1_POINTS, SF1_DIRECTIONS);
                    add_outcome(&mean, &one, seed, o->seeds);
                }
                printf("%-18s     2^%-2d %8.3f %8.3f %10.1f %10.1f %8.0f ", o->methods[i]->name, o->sizes[k],
                       mean.score.a, mean.score.c, mean.record_ns, mean.query_ns, mean.cells);
                if (bytes_told(&mean))
                    printf("%10.0f\n", mean.bytes);
                else
                    printf("%10s\n", "not told");
                fflush(stdout);
                json_row(o->methods[i], field->name, o->sizes[k], 1, &mean);
            }
    }
}

/* ---- growth ------------------------------------------------------------------------------------------------- */

#define GROWTH_MIN_LOG2 16
#define GROWTH_SIZES 11
#define EXTENTS 10
#define EXTENT_LOG2 16

typedef struct growth {
    int count;
    double samples[GROWTH_SIZES], log2[GROWTH_SIZES];
    double record[GROWTH_SIZES], query[GROWTH_SIZES], bytes[GROWTH_SIZES];
    double load[GROWTH_SIZES]; /* ns of a random load that waits for the last, out of a block of that many bytes */
    double record_line[GROWTH_SIZES], query_line[GROWTH_SIZES]; /* fitted a + b log2(samples) */
    double extent[EXTENTS], a[EXTENTS];
} growth;

/* Least squares y = at + slope x; error: standard error of the slope. */
typedef struct line_fit {
    double at, slope, error;
} line_fit;

static line_fit fit_line(const double *x, const double *y, int n)
{
    double mx = 0, my = 0, xx = 0, xy = 0, rest = 0;
    for (int i = 0; i < n; ++i) {
        mx += x[i] / n;
        my += y[i] / n;
    }
    for (int i = 0; i < n; ++i) {
        xx += (x[i] - mx) * (x[i] - mx);
        xy += (x[i] - mx) * (y[i] - my);
    }
    line_fit f = {my - xy / xx * mx, xy / xx, 0};
    for (int i = 0; i < n; ++i)
        rest += (y[i] - f.at - f.slope * x[i]) * (y[i] - f.at - f.slope * x[i]);
    f.error = n > 2 ? sqrt(rest / (n - 2) / xx) : 0;
    return f;
}

/* A cost that is at most logarithmic rises by no more per doubling late than early. True where it rises by more than
   half again as much, a twentieth of the cost and twice the error of the slope. Simulated with 10 % of noise and the
   default seven sizes: the square root of the samples is found in 82 of 100 runs, with eight or more in all; a
   logarithm is mistaken in 1 of 100. */
static bool accelerates(const double *log2n, const double *y, int n, double *early, double *late)
{
    int half = (n + 1) / 2;
    double mean = 0;
    line_fit first = fit_line(log2n, y, half), last = fit_line(log2n + n - half, y + n - half, half);
    for (int i = 0; i < n; ++i)
        mean += y[i] / n;
    *early = first.slope;
    *late = last.slope;
    return last.slope - 2 * last.error > 1.5 * fmax(first.slope, 0) + 0.05 * mean;
}

/* Caches end at some size, and beyond it any method waits for memory: the time that LOADS random loads have become
   longer is taken out before a cost counts as worse than logarithmic. */
#define LOADS 3
static bool judge_time(const char *name, const growth *g, const double *ns, double *line)
{
    double early, late, early_less, late_less, less[GROWTH_SIZES];
    line_fit f = fit_line(g->log2, ns, g->count);
    for (int i = 0; i < g->count; ++i) {
        line[i] = f.at + f.slope * g->log2[i];
        less[i] = ns[i] - LOADS * fmax(g->load[i] - g->load[0], 0);
    }
    bool worse = accelerates(g->log2, ns, g->count, &early, &late);
    bool worse_less = accelerates(g->log2, less, g->count, &early_less, &late_less);
    printf("  %s: %+.1f ns per doubling; first half %+.1f, second %+.1f (less the wait for memory: %+.1f, %+.1f): %s\n",
           name, f.slope, early, late, early_less, late_less,
           worse && worse_less ? "WORSE than logarithmic"
           : worse             ? "logarithmic or better but for memory's latency"
                               : "logarithmic or better");
    return !(worse && worse_less);
}

/* Blank where there is no value. */
static void print_cell(int width, int digits, double value)
{
    if (isfinite(value))
        printf(" %*.*f", width, digits, value);
    else
        printf(" %*s", width, "");
}

/* y[i], its step over y[i - 1], and that over the step before. */
static void print_steps(const double *y, int i)
{
    double step = i ? y[i] - y[i - 1] : NAN, before = i > 1 ? y[i - 1] - y[i - 2] : NAN;
    print_cell(10, 1, y[i]);
    print_cell(8, 1, step);
    print_cell(7, 2, before != 0 ? step / before : NAN);
}

/* Small sizes are repeated, as their times are short. */
static outcome measure_size(const options *o, const field_method *m, int log2n)
{
    outcome mean = {{0, 0}, 0, 0, 0, 0};
    int repeats = log2n < 20 ? 5 : log2n < 22 ? 2 : 1;
    for (int i = 0; i < repeats; ++i) {
        field_setup setup = {m, &o->fields[0].field, 1, 1000 + (uint64_t)i, log2n, o->exact};
        outcome one = measure(&setup, 0, 0);
        add_outcome(&mean, &one, i, repeats);
    }
    json_row(m, o->fields[0].name, log2n, 1, &mean);
    return mean;
}

static bool grow_samples(const options *o, const field_method *m, growth *g)
{
    printf("\n%s on %s, growth with the number of samples (step: over the line before; incr.: ratio of steps)\n",
           m->name, o->fields[0].name);
    printf("%8s %10s %8s %7s %10s %8s %7s %11s %6s %12s\n", "samples", "ns/sample", "step", "incr.", "ns/query", "step",
           "incr.", "bytes", "ratio", "random load");
    for (int k = GROWTH_MIN_LOG2; k <= o->max_log2; ++k) {
        int i = g->count++;
        outcome one = measure_size(o, m, k);
        g->samples[i] = ldexp(1, k);
        g->log2[i] = k;
        g->record[i] = one.record_ns;
        g->query[i] = one.query_ns;
        g->bytes[i] = one.bytes;
        g->load[i] = bench_load_latency((size_t)fmax(one.bytes, 1 << 15));
        printf("    2^%-2d", k);
        print_steps(g->record, i);
        print_steps(g->query, i);
        printf(" %11.0f", g->bytes[i]);
        print_cell(6, 2, i && g->bytes[i - 1] > 0 ? g->bytes[i] / g->bytes[i - 1] : NAN);
        printf(" %9.1f ns\n", g->load[i]);
        fflush(stdout);
    }
    bool record = judge_time("per sample", g, g->record, g->record_line);
    bool query = judge_time("per query", g, g->query, g->query_line);
    if (g->bytes[0] > 0) {
        double times = pow(g->bytes[g->count - 1] / g->bytes[0], 1 / (g->log2[g->count - 1] - g->log2[0]));
        printf("  bytes: x%.2f per doubling, samples^%.2f\n", times, log2(times));
    }
    return record && query;
}

/* The same samples in a larger world must give the same density, but for rounding. */
static bool grow_extent(const options *o, const field_method *m, growth *g)
{
    outcome mean[EXTENTS];
    double one_a[EXTENTS], spread = 0;
    int unit = 3;
    bool same = true;
    printf("%s, 2^%d samples, growth with the scene's extent\n%8s %8s %8s %10s %10s\n", m->name, EXTENT_LOG2, "extent",
           "A", "C", "ns/sample", "ns/query");
    memset(mean, 0, sizeof mean);
    for (int i = 0; i < EXTENTS; ++i) {
        double squares = 0;
        g->extent[i] = pow(10, i - unit);
        for (int seed = 0; seed < o->seeds; ++seed) {
            field_setup setup = {m, &o->fields[0].field, g->extent[i], 1000 + (uint64_t)seed, EXTENT_LOG2, o->exact};
            outcome one = measure(&setup, SF1_POINTS / 2, SF1_DIRECTIONS / 4);
            squares += one.score.a * one.score.a / o->seeds;
            add_outcome(&mean[i], &one, seed, o->seeds);
        }
        one_a[i] = g->a[i] = mean[i].score.a;
        if (i == unit)
            spread = sqrt(fmax(squares - one_a[i] * one_a[i], 0) / o->seeds);
        printf("%8g %8.3f %8.3f %10.1f %10.1f\n", g->extent[i], mean[i].score.a, mean[i].score.c, mean[i].record_ns,
               mean[i].query_ns);
        fflush(stdout);
        json_row(m, o->fields[0].name, EXTENT_LOG2, g->extent[i], &mean[i]);
    }
    double allowed = 0.02 * one_a[unit] + 2 * spread, most = 0;
    for (int i = 0; i < EXTENTS; ++i) {
        most = fmax(most, fabs(one_a[i] - one_a[unit]));
        same = same && fabs(one_a[i] - one_a[unit]) <= allowed;
    }
    printf("  A differs by at most %.3f from that at extent 1, noise %.3f: %s\n", most, allowed,
           same ? "independent of the extent" : "DEPENDS on the extent");
    return same;
}

static void plot_growth(const options *o, const char *file, const char *title, const char *x_label, const char *y_label,
                        const plot_series *series, int count, bool log_y)
{
    char path[1024];
    if (snprintf(path, sizeof path, "%s/%s", o->plot, file) >= (int)sizeof path)
        fail("--plot: the path is longer than %d characters", (int)sizeof path - 1);
    if (!plot_write(path, title, x_label, y_label, series, count, true, log_y))
        fail("%s: cannot be written: %s; --plot wants a directory that exists", path, strerror(errno));
}

static void plot_all(const options *o, const growth *g)
{
    plot_series record[2 * METHODS], query[2 * METHODS], bytes[METHODS], extent[METHODS];
    static char fit[METHODS][64];
    int n = o->method_count;
    for (int i = 0; i < n; ++i) {
        const char *name = o->methods[i]->name;
        snprintf(fit[i], sizeof fit[i], "%s: fit", name);
        plot_series series[6] = {{name, g[i].samples, g[i].record, g[i].count, false},
                                 {fit[i], g[i].samples, g[i].record_line, g[i].count, true},
                                 {name, g[i].samples, g[i].query, g[i].count, false},
                                 {fit[i], g[i].samples, g[i].query_line, g[i].count, true},
                                 {name, g[i].samples, g[i].bytes, g[i].count, false},
                                 {name, g[i].extent, g[i].a, EXTENTS, false}};
        record[i] = series[0];
        record[n + i] = series[1];
        query[i] = series[2];
        query[n + i] = series[3];
        bytes[i] = series[4];
        extent[i] = series[5];
    }
    plot_growth(o, "growth-sample.svg", "Time to learn from a sample (fit: a + b log n)", "samples", "ns", record,
                2 * n, false);
    plot_growth(o, "growth-query.svg", "Find, sample and density (fit: a + b log n)", "samples", "ns", query, 2 * n,
                false);
    plot_growth(o, "growth-bytes.svg", "Memory", "samples", "bytes", bytes, n, true);
    plot_growth(o, "growth-extent.svg", "Score and scene's extent", "extent", "A (1 is perfect)", extent, n, true);
}

/* False where a method's cost grows worse than logarithmically or its scores depend on the extent. */
static bool run_growth(const options *o)
{
    static growth g[METHODS];
    bool ok = true;
    if (o->plot)
        plot_all(o, g); /* empty: an unwritable directory is told before the measurements */
    for (int i = 0; i < o->method_count; ++i) {
        if (!built(o->methods[i]))
            continue;
        bool samples = grow_samples(o, o->methods[i], &g[i]), extent = grow_extent(o, o->methods[i], &g[i]);
        ok = ok && samples && extent;
    }
    if (o->plot)
        plot_all(o, g);
    return ok;
}

/* ---- command line ------------------------------------------------------------------------------------------- */

static void usage(FILE *f)
{
    fputs("usage: bench_field [options]          scores: A and C (1 is perfect), ns per sample and query, bytes\n"
          "       bench_field --growth [options] growth of the costs with samples and with the scene's size\n"
          "  --methods a,b         of those below; default all\n"
          "  --fields FILE...      lines \"" FIELD_FORM "\"; sf1 = built in (default)\n"
          "  --samples 14,17,20    log2 of the numbers of samples\n"
          "  --seeds 5             of which the mean is taken\n"
          "  --exact               weights without noise\n"
          "  --max-log2 22         log2 of the largest number of samples of --growth, 20 to 26\n"
          "  --plot DIRECTORY      write growth-*.svg there\n"
          "  --json FILE           write all rows\n"
          "methods:\n",
          f);
    for (int i = 0; i < METHODS; ++i)
        fprintf(f, "  %-18s    %s\n", all_methods[i]->name, all_methods[i]->what);
}

static int parse_number(const char *option, const char *text, int low, int high)
{
    char *end;
    long value = strtol(text, &end, 10);
    if (end == text || *end || value < low || value > high)
        fail("%s wants a number from %d to %d, not \"%s\"", option, low, high, text);
    return (int)value;
}

static void parse_sizes(options *o, const char *text)
{
    o->size_count = 0;
    while (*text) {
        char part[16];
        size_t length = strcspn(text, ",");
        snprintf(part, sizeof part, "%.*s", (int)(length < 15 ? length : 15), text);
        if (o->size_count == MAX_SIZES)
            fail("--samples: at most %d numbers", MAX_SIZES);
        o->sizes[o->size_count++] = parse_number("--samples", part, 4, 26);
        text += length + (text[length] == ',');
    }
    if (!o->size_count)
        fail("--samples wants numbers, as in 14,17,20");
}

static void parse_methods(options *o, const char *text)
{
    o->method_count = 0;
    while (*text) {
        size_t length = strcspn(text, ",");
        int found = -1;
        for (int i = 0; i < METHODS; ++i)
            if (strlen(all_methods[i]->name) == length && !strncmp(all_methods[i]->name, text, length))
                found = i;
        if (found < 0)
            fail("no method \"%.*s\": --help lists them", (int)(length < 40 ? length : 40), text);
        if (o->method_count == METHODS)
            fail("--methods: name each once");
        o->methods[o->method_count++] = all_methods[found];
        text += length + (text[length] == ',');
    }
    if (!o->method_count)
        fail("--methods wants names: --help lists them");
}

static void add_field(options *o, const char *path)
{
    char error[700];
    if (o->field_count == MAX_FIELDS)
        fail("--fields: at most %d files", MAX_FIELDS);
    named_field *f = &o->fields[o->field_count++];
    f->name = path;
    if (!strcmp(path, "sf1"))
        f->field = sf1_default;
    else if (!field_read(path, &f->field, error, sizeof error))
        fail("%s", error);
}

/* An option and its value; false where there is no such option. */
static bool parse_value(options *o, const char *option, const char *value)
{
    if (!strcmp(option, "--methods"))
        parse_methods(o, value);
    else if (!strcmp(option, "--samples"))
        parse_sizes(o, value);
    else if (!strcmp(option, "--seeds"))
        o->seeds = parse_number(option, value, 1, 1000);
    else if (!strcmp(option, "--max-log2"))
        o->max_log2 = parse_number(option, value, GROWTH_MIN_LOG2 + 4, 26);
    else if (!strcmp(option, "--plot"))
        o->plot = value;
    else if (!strcmp(option, "--json"))
        o->json = value;
    else
        return false;
    return true;
}

static void parse(int argc, char **argv, options *o)
{
    static const char *const with_value[] = {"--methods", "--samples", "--seeds", "--max-log2", "--plot", "--json"};
    for (int i = 1; i < argc; ++i) {
        const char *a = argv[i];
        bool known = false;
        for (size_t k = 0; k < sizeof with_value / sizeof *with_value; ++k)
            known |= !strcmp(a, with_value[k]);
        if (known && (i + 1 == argc || !strncmp(argv[i + 1], "--", 2)))
            fail("%s wants a value: see --help", a);
        if (known)
            parse_value(o, a, argv[++i]);
        else if (!strcmp(a, "--fields")) {
            if (i + 1 == argc || !strncmp(argv[i + 1], "--", 2))
                fail("--fields wants at least one file");
            while (i + 1 < argc && strncmp(argv[i + 1], "--", 2))
                add_field(o, argv[++i]);
        } else if (!strcmp(a, "--exact"))
            o->exact = true;
        else if (!strcmp(a, "--growth"))
            o->growth = true;
        else if (!strcmp(a, "--help")) {
            usage(stdout);
            exit(0);
        } else
            fail("unknown option \"%s\": see --help", a);
    }
    if (!o->field_count)
        add_field(o, "sf1");
    if (o->plot && !o->growth)
        fail("--plot draws what --growth measures: give both");
    if (o->growth && o->field_count > 1)
        fail("--growth takes one field, not %d", o->field_count);
}

static void close_json(const options *o)
{
    bool ok = fputs("\n]}\n", json_file) >= 0 && !ferror(json_file);
    if (fclose(json_file) || !ok)
        fail("%s: cannot be written", o->json);
}

int main(int argc, char **argv)
{
    static options o;
    bool ok = true;
    o.seeds = 5;
    o.max_log2 = 22;
    parse_sizes(&o, "14,17,20");
    for (int i = 0; i < METHODS; ++i)
        o.methods[o.method_count++] = all_methods[i];
    parse(argc, argv, &o);
    if (o.json && !(json_file = fopen(o.json, "w")))
        fail("%s: cannot be written: %s", o.json, strerror(errno));
    bench_print_machine(json_file);
    if (o.growth)
        ok = run_growth(&o);
    else
        run_scores(&o);
    if (json_file)
        close_json(&o);
    return ok ? 0 : 1;
}
