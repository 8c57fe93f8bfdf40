/* field.h: a guiding method (field_method.h) learning a known radiance field; fields read from files.

     >>learn    draw samples of a field, record, update; time of a query
     >>check    that density and samples of a method belong together
     >>file     one source per line: centre x y z radius r strength s [visible a b c d] */
#ifndef FIELD_H
#define FIELD_H

#include "bench.h"
#include "field_method.h"

#include <errno.h>
#include <stdbool.h>

/* ---- >>learn ------------------------------------------------------------------------------------------------ */

typedef struct field_setup {
    const field_method *method;
    const sf1_field *field;
    double extent; /* of the cube, world units */
    uint64_t seed;
    int log2_samples; /* drawn; those below the horizon are dropped */
    bool exact;       /* weights without noise */
} field_setup;

typedef struct field_learned {
    void *state; /* NULL: see error */
    const char *error;
    uint64_t samples; /* recorded */
    double ns;        /* per sample: record and update */
} field_learned;

#define FIELD_CHUNK 4096

static inline void field_scale(sf1_sample *s, double extent)
{
    for (int k = 0; k < 3; ++k)
        s->position[k] = (float)((double)s->position[k] * extent);
    s->distance = (float)((double)s->distance * extent);
}

/* Draw up to `want` samples and record them; adds to the count and to the seconds that recording took. */
static inline const char *field_record_chunk(const field_setup *setup, void *state, sf1_rng *rng, int update,
                                             uint32_t want, uint64_t *samples, double *seconds)
{
    static sf1_sample sample[FIELD_CHUNK];
    static float guide[FIELD_CHUNK];
    uint32_t count = 0;
    for (uint32_t i = 0; i < want; ++i) {
        sf1_sample *s = &sample[count];
        if (!sf1_draw(setup->field, rng, update, setup->exact, s))
            continue;
        field_scale(s, setup->extent);
        field_place place = {s->position, s->normal, s->normal};
        guide[count++] = (float)setup->method->pdf(state, place, s->direction);
    }
    double start = bench_seconds();
    const char *error = setup->method->record(state, sample, guide, count);
    *seconds += bench_seconds() - start;
    *samples += count;
    return error;
}

/* Learn in SF1_UPDATES equal updates. The state is the caller's to destroy. */
static inline field_learned field_learn(const field_setup *setup)
{
    const field_method *m = setup->method;
    field_learned out = {m->create(setup->extent), NULL, 0, 0};
    uint32_t each = (uint32_t)((UINT64_C(1) << setup->log2_samples) / SF1_UPDATES);
    sf1_rng rng = {setup->seed};
    double seconds = 0;
    if (!out.state)
        out.error = "out of memory";
    for (int update = 0; update < SF1_UPDATES && !out.error; ++update) {
        for (uint32_t at = 0; at < each && !out.error; at += FIELD_CHUNK) {
            uint32_t want = each - at < FIELD_CHUNK ? each - at : FIELD_CHUNK;
            out.error = field_record_chunk(setup, out.state, &rng, update, want, &out.samples, &seconds);
        }
        double start = bench_seconds();
        if (!out.error)
            out.error = m->update(out.state);
        seconds += bench_seconds() - start;
    }
    if (out.error && out.state) {
        m->destroy(out.state);
        out.state = NULL;
    }
    out.ns = seconds * 1e9 / (double)(out.samples ? out.samples : 1);
    return out;
}

#define FIELD_QUERIES 16384

/* Positions on the walls, their normals, u, and directions of the hemisphere; in random order. */
typedef struct field_queries {
    float position[FIELD_QUERIES][3], normal[FIELD_QUERIES][3], u[FIELD_QUERIES][2], given[FIELD_QUERIES][3];
} field_queries;

static inline void field_make_queries(field_queries *q, const sf1_field *field, double extent, uint64_t seed)
{
    sf1_rng rng = {seed};
    for (int i = 0; i < FIELD_QUERIES; ++i) {
        sf1_point p;
        double w[3];
        sf1_make_point(field, &rng, &p);
        sf1_around(p.n, sf1_uniform(&rng), sf1_uniform(&rng), w);
        for (int k = 0; k < 3; ++k) {
            q->position[i][k] = (float)(p.x[k] * extent);
            q->normal[i][k] = (float)p.n[k];
            q->given[i][k] = (float)w[k];
        }
        for (int k = 0; k < 2; ++k)
            q->u[i][k] = (float)(sf1_u64(&rng) >> 40) * 0x1p-24f;
    }
}

static inline double field_run_queries(const field_method *m, void *state, const field_queries *q)
{
    double sum = 0;
    for (int i = 0; i < FIELD_QUERIES; ++i) {
        field_place place = {q->position[i], q->normal[i], q->normal[i]};
        float sampled[3];
        double given;
        sum += m->query(state, place, q->u[i], q->given[i], sampled, &given) + given;
    }
    return sum;
}

/* ns per find + sample + density, one by one, with the normal. */
static inline double field_query_ns(const field_method *m, void *state, const field_queries *q)
{
    double ns, sum = 0;
    BENCH_MIN_NS(ns, 5, FIELD_QUERIES, {
        sum += field_run_queries(m, state, q);
        bench_use(&sum);
    });
    return ns;
}

/* ---- >>check ------------------------------------------------------------------------------------------------ */

/* A sample's density is the density of the sampled direction (but for directions at an edge, where rounding decides),
   and the density integrates to 1: directions drawn half from the method and half uniformly, p / (their density) has
   the mean 1, and lies below 2. NULL = passed. */
static inline const char *field_check(const field_method *m, void *state, const field_queries *q, bool normals)
{
    double sum = 0, given;
    int differ = 0;
    sf1_rng rng = {77};
    for (int i = 0; i < FIELD_QUERIES; ++i) {
        static const double up[3] = {0, 0, 1};
        double w[3];
        float d[3];
        const float *normal = normals ? q->normal[i] : NULL;
        field_place place = {q->position[i], normal, normal};
        double sampled = m->query(state, place, q->u[i], q->given[i], d, &given), pdf = m->pdf(state, place, d);
        differ += !(fabs(sampled - pdf) <= 1e-3 * fmax(sampled, pdf));
        if (!(given >= 0) || !(sampled > 0) || !isfinite(given) || !isfinite(sampled))
            return "a density is not a positive, finite number";
        sf1_around(up, 2 * sf1_uniform(&rng) - 1, sf1_uniform(&rng), w);
        for (int k = 0; k < 3; ++k)
            d[k] = (float)w[k];
        double uniform = m->pdf(state, place, d);
        sum += pdf / (pdf + 1 / (4 * SF1_PI)) + uniform / (uniform + 1 / (4 * SF1_PI));
    }
    if (differ > FIELD_QUERIES / 50)
        return "sampled directions do not have the density that sampling says";
    return fabs(sum / FIELD_QUERIES - 1) < 0.03 ? NULL : "the density does not integrate to 1";
}

/* ---- >>file ------------------------------------------------------------------------------------------------- */

#define FIELD_FORM "centre x y z radius r strength s [visible a b c d]"

/* Read `count` numbers after the word `name` at *text; false with a message in error. */
static inline bool field_numbers(char **text, const char *name, int count, double *out, char *error, size_t size)
{
    char *at = *text + strspn(*text, " \t");
    size_t length = strcspn(at, " \t");
    if (length != strlen(name) || strncmp(at, name, length)) {
        snprintf(error, size, "\"%s\" expected, found \"%.*s\"", name, (int)(length < 40 ? length : 40), at);
        return false;
    }
    for (at += length; count > 0; --count, ++out) {
        char *end;
        at += strspn(at, " \t");
        *out = strtod(at, &end);
        if (end == at || !isfinite(*out) || (*end && !strchr(" \t", *end))) {
            length = strcspn(at, " \t");
            snprintf(error, size, "\"%s\" wants %d more number%s, found \"%.*s\"", name, count, count == 1 ? "" : "s",
                     (int)(length < 40 ? length : 40), at);
            return false;
        }
        at = end;
    }
    *text = at + strspn(at, " \t");
    return true;
}

/* One source from a line without its comment. */
static inline bool field_parse_source(char *text, sf1_source *s, char *error, size_t size)
{
    static const sf1_source always = {{0, 0, 0}, 0, 0, {0, 0, 0, 1}};
    *s = always;
    if (!field_numbers(&text, "centre", 3, s->centre, error, size) ||
        !field_numbers(&text, "radius", 1, &s->radius, error, size) ||
        !field_numbers(&text, "strength", 1, &s->strength, error, size) ||
        (*text && !field_numbers(&text, "visible", 4, s->visible, error, size)))
        return false;
    const char *wrong = NULL;
    for (int k = 0; k < 3; ++k)
        if (s->centre[k] < 0 || s->centre[k] > 1)
            wrong = "\"centre\" wants a point in the unit cube: three numbers from 0 to 1";
    if (!(s->radius > 0) || s->radius > 1)
        wrong = "\"radius\" wants a number above 0, up to 1";
    if (!(s->strength > 0) || s->strength > 1e9)
        wrong = "\"strength\" wants a number above 0, up to 1e9";
    if (*text)
        wrong = "nothing may follow the four numbers of \"visible\"";
    if (wrong)
        snprintf(error, size, "%s", wrong);
    return !wrong;
}

/* False, with file, line and remedy in error, where the file is not a field. */
static inline bool field_read(const char *path, sf1_field *field, char *error, size_t size)
{
    char line[512], why[200];
    bool ok = true;
    int number = 0;
    FILE *f = fopen(path, "r");
    field->count = 0;
    if (!f) {
        snprintf(error, size, "%s: %s; --fields wants files of lines \"%s\"", path, strerror(errno), FIELD_FORM);
        return false;
    }
    while (ok && fgets(line, sizeof line, f)) {
        ++number;
        why[0] = 0;
        if (strlen(line) == sizeof line - 1 && line[sizeof line - 2] != '\n')
            snprintf(why, sizeof why, "the line is longer than %d characters", (int)sizeof line - 2);
        line[strcspn(line, "#\r\n")] = 0;
        if (why[0] == 0 && line[strspn(line, " \t")]) {
            if (field->count == SF1_MAX_SOURCES)
                snprintf(why, sizeof why, "more than %d sources: remove some", SF1_MAX_SOURCES);
            else if (field_parse_source(line, &field->source[field->count], why, sizeof why))
                ++field->count;
        }
        ok = !why[0];
    }
    bool failed = ferror(f) != 0;
    fclose(f);
    if (!ok)
        snprintf(error, size, "%s:%d: %s; a line is: %s", path, number, why, FIELD_FORM);
    else if (failed)
        snprintf(error, size, "%s: cannot be read: --fields wants text files", path);
    else if (!field->count)
        snprintf(error, size, "%s:%d: no source; write at least one line: %s", path, number, FIELD_FORM);
    return ok && !failed && field->count > 0;
}

#endif
