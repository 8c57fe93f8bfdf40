/* field_none.h: a method that learns nothing: uniform directions, cosine-distributed ones where there is a normal. Its
   scores are what the others start from. */
#ifndef FIELD_NONE_H
#define FIELD_NONE_H

#include "field.h"

static void *field_none_create(double extent)
{
    static char state;
    (void)extent;
    return &state;
}
static void field_none_destroy(void *state) { (void)state; }

static const char *field_none_record(void *state, const sf1_sample *samples, const float *guide, uint32_t count)
{
    (void)state, (void)samples, (void)guide, (void)count;
    return NULL;
}
static const char *field_none_update(void *state)
{
    (void)state;
    return NULL;
}

static double field_none_pdf(void *state, field_place place, const float w[3])
{
    const float *n = place.normal;
    (void)state;
    if (!n)
        return 1 / (4 * SF1_PI);
    return fmax((double)(w[0] * n[0] + w[1] * n[1] + w[2] * n[2]), 0) / SF1_PI;
}

static double field_none_query(void *state, field_place place, const float u[2], const float given[3], float sampled[3],
                               double *given_pdf)
{
    static const double up[3] = {0, 0, 1};
    double n[3] = {up[0], up[1], up[2]}, w[3];
    for (int k = 0; k < 3 && place.normal; ++k)
        n[k] = (double)place.normal[k];
    sf1_around(n, place.normal ? sqrt(1 - (double)u[0]) : 1 - 2 * (double)u[0], (double)u[1], w);
    for (int k = 0; k < 3; ++k)
        sampled[k] = (float)w[k];
    *given_pdf = field_none_pdf(state, place, given);
    return field_none_pdf(state, place, sampled);
}

static uint64_t field_none_bytes(void *state)
{
    (void)state;
    return 0;
}
static uint32_t field_none_cells(void *state)
{
    (void)state;
    return 0;
}

static const field_method field_none_method = {"none",
                                               "uniform, cosine where there is a normal; learns nothing",
                                               field_none_create,
                                               field_none_record,
                                               field_none_update,
                                               field_none_query,
                                               field_none_pdf,
                                               field_none_bytes,
                                               field_none_cells,
                                               field_none_destroy};

#endif
