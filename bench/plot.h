/* plot.h: line plots as SVG, linear or logarithmic, for the programs in this folder. */
#ifndef PLOT_H
#define PLOT_H

#include <math.h>
#include <stdbool.h>
#include <stdio.h>

typedef struct plot_series {
    const char *name;
    const double *x, *y;
    int n;
    bool dashed;
} plot_series;

typedef struct plot_axis {
    double low, high; /* of the data; logarithms where log */
    double start, length;
    bool log;
} plot_axis;

#define PLOT_WIDTH 720
#define PLOT_HEIGHT 460

static const char *plot_colour(int i)
{
    static const char *const colours[] = {"#4477aa", "#ee6677", "#228833", "#aa3377",
                                          "#ccbb44", "#66ccee", "#000000", "#999999"};
    return colours[i % 8];
}

static void plot_text(FILE *f, const char *text)
{
    for (; *text; ++text)
        switch (*text) {
        case '<':
            fputs("&lt;", f);
            break;
        case '&':
            fputs("&amp;", f);
            break;
        default:
            fputc(*text, f);
        }
}

static bool plot_usable(double v, bool log) { return isfinite(v) && (!log || v > 0); }

static void plot_extend(plot_axis *a, double v)
{
    v = a->log ? log10(v) : v;
    a->low = fmin(a->low, v);
    a->high = fmax(a->high, v);
}

static double plot_place(const plot_axis *a, double v)
{
    return a->start + a->length * ((a->log ? log10(v) : v) - a->low) / (a->high - a->low);
}

/* Room around the data; something to show where there is none. */
static void plot_settle(plot_axis *a)
{
    if (!(a->high >= a->low))
        a->low = 0, a->high = 1;
    double room = a->high > a->low ? 0.05 * (a->high - a->low) : a->log ? 0.3 : fmax(fabs(a->low) * 0.1, 0.5);
    a->low -= room;
    a->high += room;
}

/* Distance of ticks: 1, 2 or 5 times a power of ten, about eight of them. */
static double plot_step(const plot_axis *a)
{
    double raw = (a->high - a->low) / 8, power = pow(10, floor(log10(raw)));
    return power * (raw > 5 * power ? 10 : raw > 2 * power ? 5 : raw > power ? 2 : 1);
}

static void plot_tick(FILE *f, const plot_axis *a, double v, bool vertical, bool labelled)
{
    double at = plot_place(a, v);
    if (at < fmin(a->start, a->start + a->length) - 0.5 || at > fmax(a->start, a->start + a->length) + 0.5)
        return;
    const char *colour = labelled ? "#cccccc" : "#eeeeee";
    if (vertical)
        fprintf(f, "<line x1=\"80\" x2=\"%d\" y1=\"%.1f\" y2=\"%.1f\" stroke=\"%s\"/>\n", PLOT_WIDTH - 20, at, at,
                colour);
    else
        fprintf(f, "<line y1=\"40\" y2=\"%d\" x1=\"%.1f\" x2=\"%.1f\" stroke=\"%s\"/>\n", PLOT_HEIGHT - 60, at, at,
                colour);
    if (labelled && vertical)
        fprintf(f, "<text x=\"74\" y=\"%.1f\" text-anchor=\"end\">%g</text>\n", at + 4, v);
    else if (labelled)
        fprintf(f, "<text x=\"%.1f\" y=\"%d\" text-anchor=\"middle\">%g</text>\n", at, PLOT_HEIGHT - 42, v);
}

static void plot_grid(FILE *f, const plot_axis *a, bool vertical)
{
    if (!a->log) {
        double step = plot_step(a);
        for (double v = ceil(a->low / step) * step; v <= a->high; v += step)
            plot_tick(f, a, fabs(v) < 1e-9 * step ? 0 : v, vertical, true);
        return;
    }
    bool narrow = a->high - a->low < 2.2; /* few decades: 2 and 5 get labels too */
    int skip = a->high - a->low > 12 ? 3 : 1;
    for (int decade = (int)floor(a->low); decade <= (int)ceil(a->high); ++decade)
        for (int digit = 1; digit < 10; ++digit)
            plot_tick(f, a, digit * pow(10, decade), vertical,
                      (digit == 1 && decade % skip == 0) || (narrow && (digit == 2 || digit == 5)));
}

static void plot_line(FILE *f, const plot_series *s, const plot_axis *x, const plot_axis *y, int index)
{
    fprintf(f, "<polyline fill=\"none\" stroke=\"%s\" stroke-width=\"2\"%s points=\"", plot_colour(index),
            s->dashed ? " stroke-dasharray=\"6 4\"" : "");
    for (int i = 0; i < s->n; ++i)
        if (plot_usable(s->x[i], x->log) && plot_usable(s->y[i], y->log))
            fprintf(f, "%.1f,%.1f ", plot_place(x, s->x[i]), plot_place(y, s->y[i]));
    fputs("\"/>\n", f);
    for (int i = 0; i < s->n; ++i)
        if (plot_usable(s->x[i], x->log) && plot_usable(s->y[i], y->log))
            fprintf(f, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"3\" fill=\"%s\"/>\n", plot_place(x, s->x[i]),
                    plot_place(y, s->y[i]), plot_colour(index));
}

static void plot_legend(FILE *f, const plot_series *series, int count)
{
    for (int i = 0; i < count; ++i) {
        int y = 54 + 16 * i;
        fprintf(f,
                "<rect x=\"%d\" y=\"%d\" width=\"14\" height=\"4\" fill=\"%s\"/><text x=\"%d\" y=\"%d\" "
                "text-anchor=\"end\">",
                PLOT_WIDTH - 44, y - 6, plot_colour(i), PLOT_WIDTH - 50, y);
        plot_text(f, series[i].name);
        fputs("</text>\n", f);
    }
}

/* Points that are not finite, or not positive on a logarithmic axis, are left out. False = the file cannot be written.
 */
static bool plot_write(const char *path, const char *title, const char *x_label, const char *y_label,
                       const plot_series *series, int count, bool log_x, bool log_y)
{
    FILE *f = fopen(path, "w");
    plot_axis x = {(double)INFINITY, -(double)INFINITY, 80, PLOT_WIDTH - 100, log_x};
    plot_axis y = {(double)INFINITY, -(double)INFINITY, PLOT_HEIGHT - 60, -(PLOT_HEIGHT - 100), log_y};
    if (!f)
        return false;
    for (int s = 0; s < count; ++s)
        for (int i = 0; i < series[s].n; ++i)
            if (plot_usable(series[s].x[i], log_x) && plot_usable(series[s].y[i], log_y)) {
                plot_extend(&x, series[s].x[i]);
                plot_extend(&y, series[s].y[i]);
            }
    plot_settle(&x);
    plot_settle(&y);
    fprintf(f,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%d\" height=\"%d\" font-family=\"sans-serif\" "
            "font-size=\"12\"><rect width=\"100%%\" height=\"100%%\" fill=\"white\"/>\n",
            PLOT_WIDTH, PLOT_HEIGHT);
    plot_grid(f, &x, false);
    plot_grid(f, &y, true);
    fprintf(f, "<text x=\"80\" y=\"26\" font-size=\"15\">");
    plot_text(f, title);
    fprintf(f, "</text><text x=\"%d\" y=\"%d\" text-anchor=\"middle\">", 80 + (PLOT_WIDTH - 100) / 2, PLOT_HEIGHT - 16);
    plot_text(f, x_label);
    fprintf(f, "</text><text transform=\"translate(18,%d) rotate(-90)\" text-anchor=\"middle\">", PLOT_HEIGHT / 2);
    plot_text(f, y_label);
    fputs("</text>\n", f);
    for (int s = 0; s < count; ++s)
        plot_line(f, &series[s], &x, &y, s);
    plot_legend(f, series, count);
    fputs("</svg>\n", f);
    return fclose(f) == 0;
}

#endif
