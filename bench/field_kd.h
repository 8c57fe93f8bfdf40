/* field_kd.h: guide_kd.h as methods of field.h. */
#ifndef FIELD_KD_H
#define FIELD_KD_H

#include "field.h"
#include "guide_kd.h"

typedef struct field_kd {
    gkd_field *field;
    gkd_stream *stream;
    gkd_view view;  /* until the next update */
    float place[9]; /* position, normal, surface (or 0) that `handle` was found for: many densities are asked there */
    gkd_handle handle;
    bool kept;
} field_kd;

static void field_kd_destroy(void *state)
{
    field_kd *t = state;
    if (t->stream)
        gkd_stream_destroy(t->stream);
    gkd_destroy(t->field);
    free(t);
}

static void *field_kd_create_with(double extent, gkd_desc desc)
{
    field_kd *t = calloc(1, sizeof *t);
    if (!t)
        return NULL;
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = (float)extent;
    if (gkd_create(&desc, &t->field) || gkd_stream_create(t->field, &t->stream)) {
        field_kd_destroy(t);
        return NULL;
    }
    t->view = gkd_get_view(t->field);
    return t;
}

static void *field_kd_create(double extent)
{
    gkd_desc desc;
    memset(&desc, 0, sizeof desc);
    return field_kd_create_with(extent, desc);
}

static void *field_kd_create_count(double extent)
{
    gkd_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.split = GKD_SPLIT_COUNT;
    return field_kd_create_with(extent, desc);
}

/* In batches of 64, about what a path tracer hands over at once. A white diffuse surface: BSDF density cos / pi. */
static const char *field_kd_record(void *state, const sf1_sample *samples, const float *guide, uint32_t count)
{
    field_kd *t = state;
    gkd_training_sample batch[64];
    for (uint32_t at = 0; at < count; at += 64) {
        uint32_t n = count - at < 64 ? count - at : 64;
        for (uint32_t i = 0; i < n; ++i) {
            const sf1_sample *s = &samples[at + i];
            float bsdf = s->cosine * (float)(1 / SF1_PI), contribution = s->radiance * bsdf;
            batch[i] = gkd_make_scalar_sample(s->position, s->direction, s->normal, s->distance, s->radiance,
                                              contribution, contribution, s->pdf, bsdf, guide[at + i]);
        }
        gkd_result result = gkd_record(t->stream, batch, n);
        if (result)
            return gkd_result_string(result);
    }
    return NULL;
}

static const char *field_kd_update(void *state)
{
    field_kd *t = state;
    gkd_result result = gkd_accumulate(t->field, &t->stream, 1, NULL, NULL);
    gkd_stream_clear(t->stream);
    result = result ? result : gkd_refine(t->field, NULL, NULL, NULL);
    t->view = gkd_get_view(t->field);
    t->kept = false;
    return result ? gkd_result_string(result) : NULL;
}

/* Where the cosine is not to be multiplied in, the surface still bounds the directions. */
static void field_kd_find(const field_kd *t, field_place place, gkd_handle *h)
{
    gkd_view view = t->view;
    view.no_product = !place.normal;
    gkd_find(&view, place.position, place.surface, NULL, h);
}

static double field_kd_query(void *state, field_place place, const float u[2], const float given[3], float sampled[3],
                             double *given_pdf)
{
    gkd_handle h;
    field_kd_find(state, place, &h);
    *given_pdf = (double)gkd_pdf(&h, given);
    return (double)gkd_sample(&h, u, sampled);
}

static double field_kd_pdf(void *state, field_place place, const float direction[3])
{
    field_kd *t = state;
    float asked[9] = {place.position[0], place.position[1], place.position[2], 0, 0, 0, 0, 0, 0};
    if (place.normal)
        memcpy(asked + 3, place.normal, 3 * sizeof *asked);
    if (place.surface)
        memcpy(asked + 6, place.surface, 3 * sizeof *asked);
    if (!t->kept || memcmp(asked, t->place, sizeof asked) != 0) {
        field_kd_find(t, place, &t->handle);
        memcpy(t->place, asked, sizeof asked);
        t->kept = true;
    }
    return (double)gkd_pdf(&t->handle, direction);
}

static uint64_t field_kd_bytes(void *state)
{
    gkd_stats stats;
    gkd_get_stats(((field_kd *)state)->field, &stats);
    return stats.bytes;
}

static uint32_t field_kd_cells(void *state) { return gkd_cell_count(((field_kd *)state)->field); }

#define FIELD_KD_METHOD(name, create, what)                                                                            \
    {                                                                                                                  \
        name, what, create, field_kd_record, field_kd_update, field_kd_query, field_kd_pdf, field_kd_bytes,            \
            field_kd_cells, field_kd_destroy                                                                           \
    }
static const field_method field_kd_method = FIELD_KD_METHOD("kd", field_kd_create, "guide_kd.h, all defaults");
static const field_method field_kd_count_method =
    FIELD_KD_METHOD("kd-count", field_kd_create_count, "guide_kd.h, split=count");

#endif
