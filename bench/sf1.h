/* sf1.h: known radiance fields in the unit cube, to score what a guiding method has learned without a renderer.

   Points lie uniformly on the six walls of [0,1]^3 with the normal inward. Ball-like sources, some of them hidden from
   part of the cube, are each seen as a von Mises-Fisher lobe that narrows with distance, over a constant 0.05. SF1 is
   the field of the four sources of sf1_default; field.h reads others from files.

     >>field    sources and radiance
     >>draw     training samples
     >>score    V = integral(h^2 / p) / (integral h)^2 over the upper hemisphere; 1 is perfect */
#ifndef SF1_H
#define SF1_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define SF1_PI 3.14159265358979323846
#define SF1_MAX_SOURCES 64
#define SF1_UPDATES 8
#define SF1_POINTS 512
#define SF1_DIRECTIONS 4096

/* ---- >>field ------------------------------------------------------------------------------------------------ */

typedef struct sf1_rng {
    uint64_t state;
} sf1_rng;

/* SplitMix64 (Steele et al. 2014). */
static inline uint64_t sf1_u64(sf1_rng *r)
{
    uint64_t z = (r->state += UINT64_C(0x9e3779b97f4a7c15));
    z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
    return z ^ (z >> 31);
}
static inline double sf1_uniform(sf1_rng *r) { return (double)(sf1_u64(r) >> 11) * 0x1p-53; }
static inline double sf1_normal(sf1_rng *r)
{
    double u = 1 - sf1_uniform(r), v = sf1_uniform(r);
    return sqrt(-2 * log(u)) * cos(2 * SF1_PI * v);
}

/* Seen from x iff visible . (x, 1) > 0. */
typedef struct sf1_source {
    double centre[3], radius, strength, visible[4];
} sf1_source;

typedef struct sf1_field {
    sf1_source source[SF1_MAX_SOURCES];
    int count;
} sf1_field;

static const sf1_field sf1_default = {{{{.5, .98, .5}, .20, 14.4, {0, 0, 0, 1}},
                                       {{.15, .5, .85}, .08, 56.25, {0, 0, 1, -.3}},
                                       {{.02, .3, .4}, .30, 3, {0, 0, 0, 1}},
                                       {{.98, .7, .2}, .12, 44.4, {0, -.5, -1, .9}}},
                                      4};

typedef struct sf1_lobe {
    double mu[3], kappa, phi, distance;
} sf1_lobe;

/* A point's view of the field. */
typedef struct sf1_point {
    double x[3], n[3];
    sf1_lobe lobe[SF1_MAX_SOURCES];
    int count;
    double phi_sum; /* 0 where no source is visible */
} sf1_point;

static inline double sf1_dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline void sf1_make_point(const sf1_field *field, sf1_rng *rng, sf1_point *p)
{
    int k = (int)(6 * sf1_uniform(rng)), axis = k >> 1, side = k & 1;
    for (int i = 0; i < 3; ++i) {
        p->x[i] = i == axis ? side : sf1_uniform(rng);
        p->n[i] = i == axis ? 1 - 2 * side : 0;
    }
    p->phi_sum = 0;
    p->count = field->count;
    for (int j = 0; j < p->count; ++j) {
        const sf1_source *s = &field->source[j];
        sf1_lobe *l = &p->lobe[j];
        double v[3] = {s->centre[0] - p->x[0], s->centre[1] - p->x[1], s->centre[2] - p->x[2]};
        double r2 = s->radius * s->radius, d = sqrt(sf1_dot(v, v)) + 1e-12;
        for (int i = 0; i < 3; ++i)
            l->mu[i] = v[i] / d;
        l->kappa = fmin(fmax(2 * d * d / r2, 1), 4000);
        l->phi = sf1_dot(s->visible, p->x) + s->visible[3] > 0 ? s->strength * r2 / (d * d + r2) : 0;
        l->distance = d;
        p->phi_sum += l->phi;
    }
}

/* Density of lobe j at w, 1/sr. */
static inline double sf1_lobe_pdf(const sf1_lobe *l, const double *w)
{
    return l->kappa / (2 * SF1_PI * (1 - exp(-2 * l->kappa))) * exp(l->kappa * (sf1_dot(l->mu, w) - 1));
}

/* Radiance from w; `distance`: to the largest lobe's source where it exceeds the constant, else out of the cube. */
static inline double sf1_radiance(const sf1_point *p, const double *w, double *distance)
{
    double L = 0.05, largest = 0.05, exit = 1e30;
    for (int i = 0; i < 3; ++i) {
        double t = w[i] > 0 ? (1 - p->x[i]) / w[i] : w[i] < 0 ? -p->x[i] / w[i] : 1e30;
        exit = t < exit && t > 1e-9 ? t : exit;
    }
    if (distance)
        *distance = exit;
    for (int j = 0; j < p->count; ++j) {
        double term = p->lobe[j].phi * sf1_lobe_pdf(&p->lobe[j], w);
        L += term;
        if (term > largest) {
            largest = term;
            if (distance)
                *distance = p->lobe[j].distance;
        }
    }
    return L;
}

static inline void sf1_frame(const double *n, double *s, double *t)
{
    int a = fabs(n[0]) < 0.6 ? 0 : 1;
    double e[3] = {a ? 0. : 1., a ? 1. : 0., 0}, d = sf1_dot(e, n), l;
    for (int i = 0; i < 3; ++i)
        s[i] = e[i] - d * n[i];
    l = sqrt(sf1_dot(s, s));
    for (int i = 0; i < 3; ++i)
        s[i] /= l;
    t[0] = n[1] * s[2] - n[2] * s[1];
    t[1] = n[2] * s[0] - n[0] * s[2];
    t[2] = n[0] * s[1] - n[1] * s[0];
}

/* Unit vector at cosine z and azimuth 2 pi u around n. */
static inline void sf1_around(const double *n, double z, double u, double *w)
{
    double s[3], t[3], r = sqrt(fmax(0, 1 - z * z)), c = r * cos(2 * SF1_PI * u), d = r * sin(2 * SF1_PI * u);
    sf1_frame(n, s, t);
    for (int i = 0; i < 3; ++i)
        w[i] = c * s[i] + d * t[i] + z * n[i];
}

/* The visible lobes in proportion to their strength there; where none is visible, all directions alike. */
static inline void sf1_sample_lobes(sf1_rng *rng, const sf1_point *p, double *w)
{
    double u = sf1_uniform(rng) * p->phi_sum, e;
    int j = 0;
    while (j < p->count - 1 && u >= p->lobe[j].phi)
        u -= p->lobe[j++].phi;
    const sf1_lobe *l = &p->lobe[j];
    e = sf1_uniform(rng);
    if (!(p->phi_sum > 0)) {
        sf1_around(p->n, 2 * e - 1, sf1_uniform(rng), w);
        return;
    }
    sf1_around(l->mu, 1 + log(e + (1 - e) * exp(-2 * l->kappa)) / l->kappa, sf1_uniform(rng), w);
}

static inline double sf1_lobes_pdf(const sf1_point *p, const double *w)
{
    double sum = 0;
    if (!(p->phi_sum > 0))
        return 1 / (4 * SF1_PI);
    for (int j = 0; j < p->count; ++j)
        sum += p->lobe[j].phi * sf1_lobe_pdf(&p->lobe[j], w);
    return sum / p->phi_sum;
}

/* ---- >>draw ------------------------------------------------------------------------------------------------- */

typedef struct sf1_sample {
    float position[3], direction[3], normal[3];
    float radiance; /* with noise; radiance / pdf is the sample's weight */
    float pdf;      /* density it was drawn with */
    float distance, cosine;
} sf1_sample;

/* Draw one training sample of the given update; 0 where the direction was below the horizon and is dropped. */
static inline int sf1_draw(const sf1_field *field, sf1_rng *rng, int update, int exact_weights, sf1_sample *out)
{
    sf1_point p;
    double w[3], distance;
    sf1_make_point(field, rng, &p);
    if (update > 0 && sf1_uniform(rng) < 0.5)
        sf1_sample_lobes(rng, &p, w);
    else
        sf1_around(p.n, sqrt(1 - sf1_uniform(rng)), sf1_uniform(rng), w);
    double noise = exact_weights ? 1 : exp(sf1_normal(rng) - 0.5), cosine = sf1_dot(w, p.n);
    if (cosine <= 1e-4)
        return 0;
    double q = cosine / SF1_PI;
    if (update > 0)
        q = 0.5 * q + 0.5 * sf1_lobes_pdf(&p, w);
    double L = sf1_radiance(&p, w, &distance);
    for (int i = 0; i < 3; ++i) {
        out->position[i] = (float)p.x[i];
        out->direction[i] = (float)w[i];
        out->normal[i] = (float)p.n[i];
    }
    out->radiance = (float)(L * noise);
    out->pdf = (float)q;
    out->distance = (float)distance;
    out->cosine = (float)cosine;
    return 1;
}

/* Places with their normals, directions of late training samples there, and numbers in [0,1)^2, to ask a guide with. */
static inline void sf1_queries(uint64_t seed, int count, float (*position)[3], float (*normal)[3], float (*given)[3],
                               float (*u)[2])
{
    sf1_rng rng = {seed};
    for (int i = 0; i < count;) {
        sf1_sample s;
        if (!sf1_draw(&sf1_default, &rng, 4, 0, &s))
            continue;
        memcpy(position[i], s.position, sizeof position[i]);
        memcpy(normal[i], s.normal, sizeof normal[i]);
        memcpy(given[i], s.direction, sizeof given[i]);
        u[i][0] = (float)(0.999999 * sf1_uniform(&rng));
        u[i++][1] = (float)(0.999999 * sf1_uniform(&rng));
    }
}

/* ---- >>score ------------------------------------------------------------------------------------------------ */

/* Density per sr that the method would use at this point for this direction; cosine: with the surface's cosine
   multiplied in, where the method can do that. */
typedef double (*sf1_pdf_fn)(void *user, const sf1_point *point, const double *direction, int cosine);

typedef struct sf1_score {
    double a; /* h = L, p = the guide alone */
    double c; /* h = L cos, p = half cosine, half guide */
} sf1_score;

static inline sf1_score sf1_evaluate(const sf1_field *field, sf1_pdf_fn pdf, void *user, uint64_t seed, int points,
                                     int directions)
{
    sf1_rng rng = {seed};
    sf1_score mean = {0, 0};
    for (int i = 0; i < points; ++i) {
        sf1_point p;
        double ha = 0, va = 0, hc = 0, vc = 0;
        sf1_make_point(field, &rng, &p);
        for (int j = 0; j < directions; ++j) {
            double w[3];
            if (sf1_uniform(&rng) < 0.8)
                sf1_sample_lobes(&rng, &p, w);
            else
                sf1_around(p.n, sf1_uniform(&rng), sf1_uniform(&rng), w);
            double cosine = sf1_dot(w, p.n);
            if (cosine <= 0)
                continue;
            double q = 0.8 * sf1_lobes_pdf(&p, w) + 0.2 / (2 * SF1_PI), L = sf1_radiance(&p, w, 0);
            double guide = fmax(pdf(user, &p, w, 0), 1e-6), product = pdf(user, &p, w, 1);
            ha += L / q;
            va += L * L / (guide * q);
            hc += L * cosine / q;
            vc += L * cosine * L * cosine / ((0.5 * cosine / SF1_PI + 0.5 * product) * q);
        }
        mean.a += va * directions / (ha * ha) / points;
        mean.c += vc * directions / (hc * hc) / points;
    }
    return mean;
}

#endif
