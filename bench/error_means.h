/* error_means.h: means and ratios of rows over seeds and scenes.

   Errors are averaged over seeds geometrically; ratios pair the seeds, and their 95 % intervals come from Student's t
   on the logarithms. */
#ifndef ERROR_MEANS_H
#define ERROR_MEANS_H

#include "error_rows.h"

#define MAX_NAMES 32

typedef struct names {
    char at[MAX_NAMES][128];
    int count;
} names;

/* What is to be rendered: every scene x build x method x budget x seed. */
typedef struct plan {
    names scenes, builds, methods, budgets;
    int seeds;
    bool trained; /* budgets name a training: plots show the error against it */
    const char *out;
} plan;

typedef struct estimate {
    double value, low, high; /* geometric mean and its 95 % interval; NaN = nothing to tell */
    int count;
} estimate;

/* 97.5 % quantile of Student's t. */
static inline double student(int degrees)
{
    static const double t[] = {12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228};
    return degrees < 1 ? (double)INFINITY : degrees <= 10 ? t[degrees - 1] : 2.0 + 2.3 / degrees;
}

static inline estimate geometric(const double *values, int n)
{
    estimate e = {(double)NAN, (double)NAN, (double)NAN, 0};
    double sum = 0, squares = 0;
    int zeros = 0;
    for (int i = 0; i < n; ++i) {
        zeros += values[i] == 0;
        if (isfinite(values[i]) && values[i] > 0) {
            double l = log(values[i]);
            sum += l;
            squares += l * l;
            e.count++;
        }
    }
    if (!e.count && zeros) { /* all that there is: 0, not nothing to tell */
        e.value = 0;
        e.count = zeros;
        return e;
    }
    if (!e.count)
        return e;
    double mean = sum / e.count;
    e.value = exp(mean);
    if (e.count > 1) {
        double spread = sqrt(fmax(squares / e.count - mean * mean, 0) / (e.count - 1));
        e.low = exp(mean - student(e.count - 1) * spread);
        e.high = exp(mean + student(e.count - 1) * spread);
    }
    return e;
}

static inline const row *find_row(const rows *all, const char *scene, const char *build, const char *method,
                                  const char *budget, int seed)
{
    for (int i = 0; i < all->count; ++i) {
        const row *r = &all->at[i];
        if (r->seed == seed && row_ok(r) && !strcmp(r->scene, scene) && !strcmp(r->build, build) &&
            !strcmp(r->method, method) && !strcmp(r->budget, budget))
            return r;
    }
    return NULL;
}

typedef double (*row_value)(const row *r);
static inline double value_relmse(const row *r) { return r->relmse; }
static inline double value_reference(const row *r) { return r->reference_relmse; }
static inline double value_mrae(const row *r) { return r->mrae; }
static inline double value_spp(const row *r) { return r->spp; }
static inline double value_seconds(const row *r) { return r->cpu_seconds; }
static inline double if_learned(double v) { return v > 0 ? v : (double)NAN; }
static inline double value_train_spp(const row *r) { return if_learned(r->train_spp); }
static inline double value_train_seconds(const row *r) { return if_learned(r->train_seconds); }
static inline double value_denoise(const row *r) { return 100 * r->denoise_seconds / r->train_seconds; }
static inline double value_speed(const row *r) { return r->spp / r->cpu_seconds; }
static inline double value_efficiency(const row *r) { return 1 / (r->relmse * r->cpu_seconds); }

typedef struct column { /* one build with one method */
    const char *build, *method;
} column;

static inline estimate mean_of(const plan *p, const rows *all, const char *scene, column c, const char *budget,
                               row_value of)
{
    double values[1000];
    int n = 0;
    for (int seed = 1; seed <= p->seeds && n < 1000; ++seed) {
        const row *r = find_row(all, scene, c.build, c.method, budget, seed);
        if (r)
            values[n++] = of(r);
    }
    return geometric(values, n);
}

/* Of column a over column b, seed by seed. */
static inline estimate ratio_of(const plan *p, const rows *all, const char *scene, column a, column b,
                                const char *budget, row_value of)
{
    double values[1000];
    int n = 0;
    for (int seed = 1; seed <= p->seeds && n < 1000; ++seed) {
        const row *ra = find_row(all, scene, a.build, a.method, budget, seed);
        const row *rb = find_row(all, scene, b.build, b.method, budget, seed);
        if (ra && rb)
            values[n++] = of(ra) / of(rb);
    }
    return geometric(values, n);
}

/* Of the relMSE of column a over that of column b without the error that the scene's reference has itself. Nothing
   where that is not known, or more than half of either: decided for all seeds together, single ones would choose
   themselves. */
static inline double ratio_less(const plan *p, const rows *all, const char *scene, column a, column b,
                                const char *budget)
{
    double reference = mean_of(p, all, scene, a, budget, value_reference).value;
    double over = mean_of(p, all, scene, a, budget, value_relmse).value;
    double under = mean_of(p, all, scene, b, budget, value_relmse).value;
    return reference <= 0.5 * fmin(over, under) ? (over - reference) / (under - reference) : (double)NAN;
}

/* Over several scenes; their number is mean.count. */
typedef struct overall {
    estimate mean;
    double lowest, highest; /* scene */
} overall;

/* Of column a over column b, all scenes together: geometric mean of the scenes' ratios. The interval is that of chance
   between seeds, for these scenes: the variances of the scenes' means add up, degrees of freedom by Welch and
   Satterthwaite. */
static inline overall overall_ratio(const plan *p, const rows *all, column a, column b, const char *budget,
                                    row_value of)
{
    overall o = {{(double)NAN, (double)NAN, (double)NAN, 0}, (double)INFINITY, 0};
    double sum = 0, variance = 0, degrees = 0;
    for (int s = 0; s < p->scenes.count; ++s) {
        estimate e = ratio_of(p, all, p->scenes.at[s], a, b, budget, of);
        if (!e.count)
            continue;
        double error = log(e.high / e.low) / (2 * student(e.count - 1)); /* NaN with one seed: no interval then */
        sum += log(e.value);
        variance += error * error;
        degrees += error * error * error * error / (e.count - 1);
        o.lowest = fmin(o.lowest, e.value);
        o.highest = fmax(o.highest, e.value);
        o.mean.count++;
    }
    if (!o.mean.count)
        return o;
    double mean = sum / o.mean.count, error = sqrt(variance) / o.mean.count;
    degrees = degrees > 0 ? variance * variance / degrees : 1; /* >= 1, but for rounding */
    o.mean.value = exp(mean);
    o.mean.low = exp(mean - student((int)(degrees + 1e-6)) * error);
    o.mean.high = exp(mean + student((int)(degrees + 1e-6)) * error);
    return o;
}

#endif
