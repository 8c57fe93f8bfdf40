/* plot.h: line plots as SVG files, linear or logarithmic, with grid, ticks and legend. Static functions, no state.

     plot_series s[2] = {{"ours", x, y, n, false}, {"bound", x, z, n, true}};
     if (!plot_write("error.svg", "Error against time", "seconds", "relMSE", s, 2, true, true))
         perror("error.svg"); */
#ifndef PLOT_H
#define PLOT_H

#include <math.h>
#include <stdbool.h>
#include <stdio.h>

#define PLOT_WIDTH 760
#define PLOT_HEIGHT 480
#define PLOT_LEFT 84
#define PLOT_RIGHT 196 /* the legend's column */
#define PLOT_TOP 44
#define PLOT_BOTTOM 58

typedef struct plot_series {
    const char *name;
    const double *x, *y;
    int n;
    bool dashed;
} plot_series;

/* One axis: the data's range (of the logarithm to base 10 where log) and the pixels it is drawn on. */
typedef struct plot_axis {
    double low, high, from, to;
    bool log;
} plot_axis;

static inline bool plot_drawable(double v, bool log_axis) { return isfinite(v) && (!log_axis || v > 0); }

static inline double plot_pixel(const plot_axis *a, double v)
{
    double t = ((a->log ? log10(v) : v) - a->low) / (a->high - a->low);
    return a->from + t * (a->to - a->from);
}

/* Distance of a linear axis's ticks: 1, 2 or 5 times a power of ten, about 6 in the range. */
static inline double plot_step(double range)
{
    double unit = pow(10, floor(log10(range / 6))), m = range / 6 / unit;
    return unit * (m <= 1 ? 1 : m <= 2 ? 2 : m <= 5 ? 5 : 10);
}

static inline void plot_text(FILE *f, const char *s)
{
    for (; s && *s; ++s)
        if (*s == '&')
            fputs("&amp;", f);
        else if (*s == '<')
            fputs("&lt;", f);
        else if (*s == '>')
            fputs("&gt;", f);
        else if ((unsigned char)*s >= ' ' || *s == '\t' || *s == '\n') /* XML forbids other control characters */
            fputc(*s, f);
}

/* Range of what can be drawn; a point counts only where both of its coordinates can. */
static inline plot_axis plot_make_axis(const plot_series *series, int count, bool of_x, bool log_x, bool log_y)
{
    plot_axis a = {INFINITY, -INFINITY, 0, 0, of_x ? log_x : log_y};
    for (int i = 0; i < count; ++i)
        for (int j = 0; j < series[i].n; ++j) {
            double x = series[i].x[j], y = series[i].y[j], v = of_x ? x : y;
            if (!plot_drawable(x, log_x) || !plot_drawable(y, log_y))
                continue;
            v = a.log ? log10(v) : v;
            a.low = fmin(a.low, v);
            a.high = fmax(a.high, v);
        }
    if (!(a.low <= a.high))
        a.low = 0, a.high = 1;
    double pad = 0.03 * (a.high - a.low), least = a.log ? 0.4 : 1e-6 * fmax(fabs(a.low), fabs(a.high));
    if (!a.log && a.high - a.low <= least)
        pad = a.low == 0 ? 1 : 0.5 * fabs(a.low);
    else if (a.log && pad < 0.05)
        pad = fmax(0.05, (least - (a.high - a.low)) / 2);
    bool from_zero = !a.log && a.low >= 0 && a.low - pad < 0.3 * a.high;
    a.low = from_zero ? 0 : a.low - pad;
    a.high += pad;
    a.from = of_x ? PLOT_LEFT : PLOT_HEIGHT - PLOT_BOTTOM;
    a.to = of_x ? PLOT_WIDTH - PLOT_RIGHT : PLOT_TOP;
    return a;
}

/* Grid line at v, with the tick's label where text is not null. */
static inline void plot_tick(FILE *f, const plot_axis *a, bool of_x, double v, const char *text)
{
    double p = plot_pixel(a, v);
    int right = PLOT_WIDTH - PLOT_RIGHT, bottom = PLOT_HEIGHT - PLOT_BOTTOM;
    const char *colour = text ? "#cccccc" : "#eeeeee";
    if (of_x)
        fprintf(f, "<line x1=\"%.1f\" x2=\"%.1f\" y1=\"%d\" y2=\"%d\" stroke=\"%s\"/>\n", p, p, PLOT_TOP, bottom,
                colour);
    else
        fprintf(f, "<line x1=\"%d\" x2=\"%d\" y1=\"%.1f\" y2=\"%.1f\" stroke=\"%s\"/>\n", PLOT_LEFT, right, p, p,
                colour);
    if (text && of_x)
        fprintf(f, "<text x=\"%.1f\" y=\"%d\" text-anchor=\"middle\">%s</text>\n", p, bottom + 18, text);
    else if (text)
        fprintf(f, "<text x=\"%d\" y=\"%.1f\" text-anchor=\"end\">%s</text>\n", PLOT_LEFT - 7, p + 4, text);
}

/* A line per decade and faint ones between; where the axis spans less than two decades these are labelled too. */
static inline void plot_log_ticks(FILE *f, const plot_axis *a, bool of_x)
{
    double range = a->high - a->low;
    int every = range > 12 ? (int)ceil(range / 8) : 1;
    for (int pass = 0; pass < 2; ++pass) /* faint lines first, so that decades lie over them */
        for (int e = (int)floor(a->low); e <= (int)ceil(a->high); ++e)
            for (int m = 1; m < 10; ++m) {
                double v = m * pow(10, e), l = log10(v);
                bool label = m == 1 ? e % every == 0 : range < 0.7 || (range < 2 && (m == 2 || m == 5));
                char text[32];
                if (l < a->low - 1e-9 || l > a->high + 1e-9 || label != (pass == 1) || (m > 1 && range > 8))
                    continue;
                if (e < -3 || e > 4)
                    snprintf(text, sizeof text, "%de%d", m, e);
                else
                    snprintf(text, sizeof text, "%g", v);
                plot_tick(f, a, of_x, v, label ? text : NULL);
            }
}

static inline void plot_ticks(FILE *f, const plot_axis *a, bool of_x)
{
    if (a->log) {
        plot_log_ticks(f, a, of_x);
        return;
    }
    double step = plot_step(a->high - a->low);
    for (double i = ceil(a->low / step - 1e-9); i * step <= a->high + 1e-9 * step; ++i) {
        char text[32];
        snprintf(text, sizeof text, "%.6g", i == 0 ? 0 : i * step);
        plot_tick(f, a, of_x, i * step, text);
    }
}

/* One marker: shapes differ as colours do, for those who cannot tell the colours. */
static inline void plot_marker(FILE *f, int which, double x, double y, const char *colour)
{
    if (which % 4 == 0)
        fprintf(f, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"3.5\" fill=\"%s\"/>\n", x, y, colour);
    else if (which % 4 == 1)
        fprintf(f, "<rect x=\"%.1f\" y=\"%.1f\" width=\"6.4\" height=\"6.4\" fill=\"%s\"/>\n", x - 3.2, y - 3.2,
                colour);
    else if (which % 4 == 2)
        fprintf(f, "<path d=\"M%.1f %.1fl4.2 7.4h-8.4z\" fill=\"%s\"/>\n", x, y - 4.6, colour);
    else
        fprintf(f, "<path d=\"M%.1f %.1fl4.4 4.4l-4.4 4.4l-4.4 -4.4z\" fill=\"%s\"/>\n", x, y - 4.4, colour);
}

/* The line breaks where a point is left out. */
static inline void plot_curve(FILE *f, const plot_series *s, const plot_axis *ax, const plot_axis *ay,
                              const char *style)
{
    bool pen = false;
    for (int i = 0; i <= s->n; ++i) {
        bool draw = i < s->n && plot_drawable(s->x[i], ax->log) && plot_drawable(s->y[i], ay->log);
        if (draw && !pen)
            fputs("<polyline points=\"", f);
        if (draw)
            fprintf(f, "%.1f,%.1f ", plot_pixel(ax, s->x[i]), plot_pixel(ay, s->y[i]));
        else if (pen)
            fprintf(f, "\" %s/>\n", style);
        pen = draw;
    }
}

/* Curve, markers and the line of the legend. */
static inline void plot_draw(FILE *f, const plot_series *s, int which, const plot_axis *ax, const plot_axis *ay)
{
    static const char *const colours[] = {"#0072b2", "#d55e00", "#009e73", "#cc3399", /* after Okabe and Ito */
                                          "#b8860b", "#56b4e9", "#000000", "#7a5195"};
    const char *colour = colours[which % 8];
    int x = PLOT_WIDTH - PLOT_RIGHT + 14, y = PLOT_TOP + 10 + 20 * which;
    char style[128];
    snprintf(style, sizeof style, "fill=\"none\" stroke=\"%s\" stroke-width=\"2\"%s", colour,
             s->dashed ? " stroke-dasharray=\"7 4\"" : "");
    plot_curve(f, s, ax, ay, style);
    for (int i = 0; i < s->n; ++i)
        if (plot_drawable(s->x[i], ax->log) && plot_drawable(s->y[i], ay->log))
            plot_marker(f, which, plot_pixel(ax, s->x[i]), plot_pixel(ay, s->y[i]), colour);
    fprintf(f, "<polyline points=\"%d,%d %d,%d\" %s/>\n", x, y, x + 26, y, style);
    plot_marker(f, which, x + 13, y, colour);
    fprintf(f, "<text x=\"%d\" y=\"%d\">", x + 32, y + 4);
    plot_text(f, s->name);
    fputs("</text>\n", f);
}

static inline void plot_frame(FILE *f, const char *title, const char *x_label, const char *y_label)
{
    int width = PLOT_WIDTH - PLOT_RIGHT - PLOT_LEFT, height = PLOT_HEIGHT - PLOT_BOTTOM - PLOT_TOP;
    fprintf(f, "<rect x=\"%d\" y=\"%d\" width=\"%d\" height=\"%d\" fill=\"none\" stroke=\"#444444\"/>\n", PLOT_LEFT,
            PLOT_TOP, width, height);
    fprintf(f, "<text x=\"%d\" y=\"26\" font-size=\"16\" text-anchor=\"middle\">", PLOT_LEFT + width / 2);
    plot_text(f, title);
    fprintf(f, "</text>\n<text x=\"%d\" y=\"%d\" text-anchor=\"middle\">", PLOT_LEFT + width / 2, PLOT_HEIGHT - 14);
    plot_text(f, x_label);
    fprintf(f, "</text>\n<text transform=\"translate(20 %d) rotate(-90)\" text-anchor=\"middle\">",
            PLOT_TOP + height / 2);
    plot_text(f, y_label);
    fputs("</text>\n", f);
}

/* SVG with axes, decade grid lines and tick labels where log, a legend; points that are not finite (or <= 0 on a log
   axis) are left out. False when the file cannot be written. */
static inline bool plot_write(const char *path, const char *title, const char *x_label, const char *y_label,
                              const plot_series *series, int count, bool log_x, bool log_y)
{
    FILE *f = fopen(path, "w");
    if (!f)
        return false;
    plot_axis ax = plot_make_axis(series, count, true, log_x, log_y);
    plot_axis ay = plot_make_axis(series, count, false, log_x, log_y);
    int legend = 20 * count + PLOT_TOP + 20, tall = legend > PLOT_HEIGHT ? legend : PLOT_HEIGHT; /* of a long legend */
    fprintf(f,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%d\" height=\"%d\" viewBox=\"0 0 %d %d\" "
            "font-family=\"Helvetica,Arial,sans-serif\" font-size=\"12\" fill=\"#222222\" stroke=\"none\">\n"
            "<rect width=\"%d\" height=\"%d\" fill=\"#ffffff\"/>\n",
            PLOT_WIDTH, tall, PLOT_WIDTH, tall, PLOT_WIDTH, tall);
    plot_ticks(f, &ax, true);
    plot_ticks(f, &ay, false);
    plot_frame(f, title, x_label, y_label);
    for (int i = 0; i < count; ++i)
        plot_draw(f, &series[i], i, &ax, &ay);
    fputs("</svg>\n", f);
    bool ok = !ferror(f);
    return fclose(f) == 0 && ok;
}

#endif
