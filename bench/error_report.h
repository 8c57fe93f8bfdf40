/* error_report.h: from rows to tables, plots and verdicts. */
#ifndef ERROR_REPORT_H
#define ERROR_REPORT_H

#include "error_means.h"
#include "plot.h"
#include "statistics.h"
#include "tracer.h"

/* ---- bias: do two methods' pictures agree? */

#define TILE 16

/* Mean over channels and its variance, for every pixel, over all pictures of a column; two halves tell whether the
   variance is to be trusted: an estimator that rarely finds some light knows nothing of its own variance. */
typedef struct evidence {
    int width, height, count;
    double *mean, *variance[2], weight, half[2];
} evidence;

static void evidence_free(evidence *e)
{
    free(e->mean);
    free(e->variance[0]);
    free(e->variance[1]);
    memset(e, 0, sizeof *e);
}

static void evidence_add(evidence *e, const tr_image *color, const tr_image *variance, double spp, int half)
{
    size_t n = (size_t)color->width * (size_t)color->height;
    if (!e->mean) {
        e->width = color->width;
        e->height = color->height;
        e->mean = calloc(n, sizeof(double));
        e->variance[0] = calloc(n, sizeof(double));
        e->variance[1] = calloc(n, sizeof(double));
    }
    if (!e->mean || !e->variance[0] || !e->variance[1] || e->width != color->width || e->height != color->height)
        return;
    for (size_t i = 0; i < n; ++i) {
        double m = 0, s = 0; /* channels vary together at most: their deviations add up */
        for (int c = 0; c < 3; ++c) {
            m += color->data[3 * i + (size_t)c] / 3.0;
            s += sqrt(fmax(variance->data[3 * i + (size_t)c], 0)) / 3.0;
        }
        e->mean[i] += spp * m;
        e->variance[half][i] += spp * spp * s * s;
    }
    e->weight += spp;
    e->half[half] += spp;
    e->count++;
}

static evidence gather(const plan *p, const rows *all, const char *scene, column c)
{
    evidence e;
    memset(&e, 0, sizeof e);
    for (int b = 0; b < p->budgets.count; ++b)
        for (int seed = 1; seed <= p->seeds; ++seed) {
            const row *r = find_row(all, scene, c.build, c.method, p->budgets.at[b], seed);
            char path[1024], err[512];
            tr_image color, variance;
            if (!r)
                continue;
            picture_path(path, sizeof path, p->out, "pictures", r, ".exr");
            if (!tr_image_read(path, false, &color, err, sizeof err))
                continue;
            if (tr_exr_read_layer(path, "variance", &variance, err, sizeof err)) {
                evidence_add(&e, &color, &variance, r->spp, e.count & 1);
                tr_image_free(&variance);
            }
            tr_image_free(&color);
        }
    return e;
}

typedef struct disagreement {
    double z_all, z_tile; /* of the picture, of the worst tile */
    int x, y;             /* that tile */
    int tiles, used;      /* used: both variances hold up between halves, or cannot be tested */
    bool tested;          /* both sides have two halves; one picture has none */
    double limit;         /* of |z_tile|, Bonferroni-corrected */
} disagreement;

static void tile_sums(const evidence *e, int x0, int y0, double *mean, double variance[2])
{
    *mean = variance[0] = variance[1] = 0;
    for (int y = y0; y < y0 + TILE && y < e->height; ++y)
        for (int x = x0; x < x0 + TILE && x < e->width; ++x) {
            size_t i = (size_t)y * (size_t)e->width + (size_t)x;
            *mean += e->mean[i] / e->weight;
            for (int h = 0; h < 2; ++h)
                variance[h] += e->variance[h][i];
        }
}

/* Variance of a tile's sum, or -1 where the halves' variances per sample differ too much to be trusted. */
static double tile_variance(const evidence *e, const double variance[2])
{
    double total = (variance[0] + variance[1]) / (e->weight * e->weight);
    if (e->half[1] > 0) {
        double a = variance[0] / e->half[0], b = variance[1] / e->half[1];
        if (a > 2 * b || b > 2 * a)
            return -1;
    }
    return total;
}

static disagreement disagree(const evidence *a, const evidence *b)
{
    disagreement d = {0, 0, 0, 0, 0, 0, false, 0};
    double sum = 0, sum_variance = 0;
    if (!a->count || !b->count || a->width != b->width || a->height != b->height)
        return d;
    d.tested = a->half[1] > 0 && b->half[1] > 0;
    for (int y = 0; y < a->height; y += TILE)
        for (int x = 0; x < a->width; x += TILE) {
            double ma, mb, va[2], vb[2];
            tile_sums(a, x, y, &ma, va);
            tile_sums(b, x, y, &mb, vb);
            double ta = tile_variance(a, va), tb = tile_variance(b, vb);
            d.tiles++;
            if (ta < 0 || tb < 0 || !(ta + tb > 0))
                continue;
            d.used++;
            sum += ma - mb;
            sum_variance += ta + tb;
            double z = (ma - mb) / sqrt(ta + tb);
            if (fabs(z) > fabs(d.z_tile)) {
                d.z_tile = z;
                d.x = x / TILE;
                d.y = y / TILE;
            }
        }
    d.limit = normal_limit(0.001 / (d.used ? d.used : 1));
    d.z_all = sum_variance > 0 ? sum / sqrt(sum_variance) : 0;
    return d;
}

/* How many tiles the verdict rests on, and whether their variances could be tested. */
static void print_tiles(FILE *f, const disagreement *d)
{
    if (d->tested)
        fprintf(f, "%d of %d tiles trusted", d->used, d->tiles);
    else
        fprintf(f, "%d of %d tiles used, untested: needs 2 pictures each", d->used, d->tiles);
}

/* ---- tables */

static void print_estimate(FILE *f, estimate e, const char *format)
{
    char text[32];
    snprintf(text, sizeof text, format, e.value);
    fprintf(f, " %s |", isfinite(e.value) ? text : "-");
}

static void print_ratio(FILE *f, estimate e)
{
    if (!isfinite(e.value))
        fputs(" - |", f);
    else if (isfinite(e.low))
        fprintf(f, " %.3f (%.3f .. %.3f) |", e.value, e.low, e.high);
    else
        fprintf(f, " %.3f |", e.value);
}

/* Columns of a plan, the build running fastest: the first one is what the others are compared with. */
static int columns_of(const plan *p, column *out)
{
    int n = 0;
    for (int m = 0; m < p->methods.count; ++m)
        for (int b = 0; b < p->builds.count; ++b)
            out[n++] = (column){p->builds.at[b], p->methods.at[m]};
    return n;
}

static void label(char *text, size_t size, const plan *p, column c)
{
    snprintf(text, size, p->builds.count > 1 ? "%s (%s)" : "%s", c.method, c.build);
}

static void write_table(FILE *f, const plan *p, const rows *all)
{
    static column columns[MAX_NAMES * MAX_NAMES];
    int n = columns_of(p, columns);
    fputs("| scene | budget | method | spp | CPU s | learning s | denoise | relMSE | ratio (95 %) | less reference | "
          "MRAE | "
          "efficiency |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n",
          f);
    for (int s = 0; s < p->scenes.count; ++s)
        for (int b = 0; b < p->budgets.count; ++b)
            for (int c = 0; c < n; ++c) {
                const char *scene = p->scenes.at[s], *budget = p->budgets.at[b];
                char text[200];
                label(text, sizeof text, p, columns[c]);
                fprintf(f, "| %s | %s | %s |", scene, budget, text);
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_spp), "%.0f");
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_seconds), "%.1f");
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_train_seconds), "%.2f");
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_denoise), "%.2f %%");
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_relmse), "%.4g");
                print_ratio(f, ratio_of(p, all, scene, columns[c], columns[0], budget, value_relmse));
                double less = ratio_less(p, all, scene, columns[c], columns[0], budget);
                print_estimate(f, (estimate){less, 0, 0, 1}, "%.3f");
                print_estimate(f, mean_of(p, all, scene, columns[c], budget, value_mrae), "%.4g");
                print_estimate(f, ratio_of(p, all, scene, columns[c], columns[0], budget, value_efficiency), "%.2fx");
                fputc('\n', f);
            }
}

/* Largest of the scenes' means of a column. */
static estimate most(const plan *p, const rows *all, column c, const char *budget, row_value of)
{
    estimate e = {(double)NAN, (double)NAN, (double)NAN, 0};
    for (int s = 0; s < p->scenes.count; ++s)
        e.value = fmax(e.value, mean_of(p, all, p->scenes.at[s], c, budget, of).value);
    return e;
}

/* Over the scenes that have a ratio without their reference's error, and how many these are. */
static void print_less(FILE *f, const plan *p, const rows *all, column a, column b, const char *budget)
{
    double ratios[MAX_NAMES];
    for (int s = 0; s < p->scenes.count; ++s)
        ratios[s] = ratio_less(p, all, p->scenes.at[s], a, b, budget);
    estimate e = geometric(ratios, p->scenes.count);
    if (e.count)
        fprintf(f, " %.3f, %d scenes |", e.value, e.count);
    else
        fputs(" - |", f);
}

/* What the scenes say together. */
static void write_overall(FILE *f, const plan *p, const rows *all)
{
    static column columns[MAX_NAMES * MAX_NAMES];
    int n = columns_of(p, columns);
    fprintf(f,
            "\nRatios to `%s`, geometric means over scenes (95 %% for these scenes):\n\n"
            "| budget | method | scenes | relMSE | lowest | highest | less reference | MRAE | CPU s | denoise, most |\n"
            "|---|---|---|---|---|---|---|---|---|---|\n",
            columns[0].method);
    for (int b = 0; b < p->budgets.count; ++b)
        for (int c = 1; c < n; ++c) {
            const char *budget = p->budgets.at[b];
            char text[200];
            label(text, sizeof text, p, columns[c]);
            overall o = overall_ratio(p, all, columns[c], columns[0], budget, value_relmse);
            fprintf(f, "| %s | %s | %d |", budget, text, o.mean.count);
            print_ratio(f, o.mean);
            print_estimate(f, (estimate){o.lowest, 0, 0, 1}, "%.3f");
            print_estimate(f, (estimate){o.highest, 0, 0, 1}, "%.3f");
            print_less(f, p, all, columns[c], columns[0], budget);
            print_ratio(f, overall_ratio(p, all, columns[c], columns[0], budget, value_mrae).mean);
            print_ratio(f, overall_ratio(p, all, columns[c], columns[0], budget, value_seconds).mean);
            print_estimate(f, most(p, all, columns[c], budget, value_denoise), "%.2f %%");
            fputc('\n', f);
        }
}

/* Denoise: CPU seconds of that step over all that were spent until the method had learned for the last time. */
static void write_tables(FILE *f, const plan *p, const rows *all)
{
    write_table(f, p, all);
    fputs(
        "\nlearning s: CPU seconds until the last update; denoise: its step's share of them; less reference: ratio of "
        "what is\nleft without the relMSE of the reference itself, where that is known and at most half\n",
        f);
    if (p->methods.count * p->builds.count > 1)
        write_overall(f, p, all);
}

/* ---- plots */

/* Columns that a plot has room for, and their labels. Returns their number. */
static int plotted(const plan *p, column *columns, char labels[MAX_NAMES][200])
{
    int n = columns_of(p, columns);
    n = n < MAX_NAMES ? n : MAX_NAMES;
    for (int c = 0; c < n; ++c)
        label(labels[c], 200, p, columns[c]);
    return n;
}

static void plot_scene(const plan *p, const rows *all, const char *scene, bool by_spp)
{
    const char *kind = !by_spp ? "seconds" : p->trained ? "train" : "spp";
    const char *axis = !by_spp ? "CPU seconds" : p->trained ? "samples per pixel of the training" : "samples per pixel";
    row_value of = !by_spp ? value_seconds : p->trained ? value_train_spp : value_spp;
    static column columns[MAX_NAMES * MAX_NAMES];
    static double x[MAX_NAMES][MAX_NAMES], y[MAX_NAMES][MAX_NAMES];
    static char labels[MAX_NAMES][200];
    plot_series series[MAX_NAMES];
    char path[1024], title[160];
    int n = plotted(p, columns, labels);
    for (int c = 0; c < n; ++c) {
        for (int b = 0; b < p->budgets.count; ++b) {
            x[c][b] = mean_of(p, all, scene, columns[c], p->budgets.at[b], of).value;
            y[c][b] = mean_of(p, all, scene, columns[c], p->budgets.at[b], value_relmse).value;
        }
        series[c] = (plot_series){labels[c], x[c], y[c], p->budgets.count, false};
    }
    snprintf(path, sizeof path, "%s/error-%s-%s.svg", p->out, kind, scene);
    snprintf(title, sizeof title, "%s: error against %s", scene, axis);
    plot_write(path, title, axis, "relMSE", series, n, true, true);
}

/* Errors over the first column's, all scenes together. */
static void plot_overall(const plan *p, const rows *all)
{
    static column columns[MAX_NAMES * MAX_NAMES];
    static double x[MAX_NAMES], y[MAX_NAMES][MAX_NAMES];
    static char labels[MAX_NAMES][200];
    plot_series series[MAX_NAMES];
    char path[1024], title[300];
    int n = plotted(p, columns, labels);
    for (int b = 0; b < p->budgets.count; ++b)
        x[b] = atof(p->budgets.at[b]); /* the training, where there is one */
    for (int c = 0; c < n; ++c) {
        for (int b = 0; b < p->budgets.count; ++b)
            y[c][b] = overall_ratio(p, all, columns[c], columns[0], p->budgets.at[b], value_relmse).mean.value;
        series[c] = (plot_series){labels[c], x, y[c], p->budgets.count, c == 0};
    }
    snprintf(path, sizeof path, "%s/overall.svg", p->out);
    snprintf(title, sizeof title, "relMSE over that of %s, geometric mean of the scenes", columns[0].method);
    plot_write(path, title, p->trained ? "samples per pixel of the training" : "budget", "relMSE ratio", series, n,
               true, false);
}

/* Stacked bars: where the CPU seconds of the largest budget went. */
static bool plot_cost(const plan *p, const rows *all)
{
    static const char *const parts[] = {"trace", "shade", "query", "record", "update", "denoise"};
    static const char *const colours[] = {"#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377"};
    static column columns[MAX_NAMES * MAX_NAMES];
    char path[1024];
    int n = columns_of(p, columns), line = 0, height = 60 + 20 * n * p->scenes.count;
    snprintf(path, sizeof path, "%s/cost.svg", p->out);
    FILE *f = fopen(path, "w");
    if (!f)
        return false;
    fprintf(f,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"900\" height=\"%d\" font-family=\"sans-serif\" "
            "font-size=\"12\"><rect width=\"100%%\" height=\"100%%\" fill=\"white\"/>\n",
            height);
    for (int k = 0; k < 6; ++k)
        fprintf(f,
                "<rect x=\"%d\" y=\"12\" width=\"12\" height=\"12\" fill=\"%s\"/><text x=\"%d\" y=\"22\">%s</text>\n",
                250 + 90 * k, colours[k], 267 + 90 * k, parts[k]);
    for (int s = 0; s < p->scenes.count; ++s)
        for (int c = 0; c < n; ++c) {
            const char *budget = p->budgets.at[p->budgets.count - 1];
            char text[200];
            const row *r = NULL;
            for (int seed = 1; seed <= p->seeds && !r; ++seed)
                r = find_row(all, p->scenes.at[s], columns[c].build, columns[c].method, budget, seed);
            int y = 40 + 20 * line++;
            label(text, sizeof text, p, columns[c]);
            fprintf(f, "<text x=\"240\" y=\"%d\" text-anchor=\"end\">%s, %s</text>\n", y + 12, p->scenes.at[s], text);
            if (!r)
                continue;
            double denoise = isfinite(r->denoise_seconds) ? r->denoise_seconds : 0; /* a part of update */
            double part[] = {
                r->trace_seconds, r->shade_seconds, r->query_seconds, r->record_seconds, r->update_seconds - denoise,
                denoise};
            double x = 250;
            for (int k = 0; k < 6; ++k) {
                double w = isfinite(part[k]) ? 600 * fmax(part[k], 0) / r->cpu_seconds : 0;
                fprintf(f, "<rect x=\"%.1f\" y=\"%d\" width=\"%.1f\" height=\"15\" fill=\"%s\"/>\n", x, y, w,
                        colours[k]);
                x += w;
            }
        }
    fputs("</svg>\n", f);
    return fclose(f) == 0;
}

/* ---- verdicts */

#define SLOWER 0.75 /* speed of a build over the first one's that is called slower */
#define WORSE 1.33  /* relMSE likewise */

/* Compare a build with the first one, method by method. Returns how many flags went up. */
static int judge_builds(FILE *f, const plan *p, const rows *all, const char *scene)
{
    int flags = 0;
    const char *budget = p->budgets.at[p->budgets.count - 1];
    for (int m = 0; m < p->methods.count && p->builds.count > 1; ++m) {
        column first = {p->builds.at[0], p->methods.at[m]};
        evidence eb = gather(p, all, scene, first);
        for (int b = 1; b < p->builds.count; ++b) {
            column other = {p->builds.at[b], p->methods.at[m]};
            estimate speed = ratio_of(p, all, scene, other, first, budget, value_speed);
            estimate error = ratio_of(p, all, scene, other, first, budget, value_relmse);
            evidence ea = gather(p, all, scene, other);
            disagreement d = disagree(&ea, &eb);
            bool slower = speed.value<SLOWER, biased = fabs(d.z_all)> 5 || fabs(d.z_tile) > d.limit;
            bool worse = error.value > WORSE && !(error.count > 1 && error.low < 1);
            fprintf(f, "%s, %s: %s against %s: speed %.2fx%s, relMSE %.2fx%s, z %.1f, worst tile %.1f of %.1f%s, ",
                    scene, first.method, other.build, first.build, speed.value, slower ? " SLOWER" : "", error.value,
                    worse ? " WORSE" : "", d.z_all, fabs(d.z_tile), d.limit, biased ? " BIASED" : "");
            print_tiles(f, &d);
            fputc('\n', f);
            flags += slower + worse + biased;
            evidence_free(&ea);
        }
        evidence_free(&eb);
    }
    return flags;
}

/* Do the methods' pictures agree with the first one's? Told, not judged: a method that cannot find some light at this
   budget knows neither its mean nor its variance. */
static void compare_methods(FILE *f, const plan *p, const rows *all, const char *scene)
{
    column first = {p->builds.at[0], p->methods.at[0]};
    evidence eb = gather(p, all, scene, first);
    for (int m = 1; m < p->methods.count; ++m) {
        column other = {p->builds.at[0], p->methods.at[m]};
        evidence ea = gather(p, all, scene, other);
        disagreement d = disagree(&ea, &eb);
        fprintf(f, "%s: %s against %s: z %.1f, worst tile (%d, %d) %.1f, limit %.1f, ", scene, other.method,
                first.method, d.z_all, d.x, d.y, fabs(d.z_tile), d.limit);
        print_tiles(f, &d);
        fputc('\n', f);
        evidence_free(&ea);
    }
    evidence_free(&eb);
}

#endif
