/* field_sdtree.h: guide_sdtree.h as methods of field.h. */
#ifndef FIELD_SDTREE_H
#define FIELD_SDTREE_H

#include "field.h"
#include "guide_sdtree.h"

typedef struct field_sdtree {
    gsd_field *field;
    gsd_stream *stream;
    gsd_view view; /* until the next update */
} field_sdtree;

static void field_sdtree_destroy(void *state)
{
    field_sdtree *t = state;
    if (t->stream)
        gsd_stream_destroy(t->stream);
    gsd_destroy(t->field);
    free(t);
}

static void *field_sdtree_create_for(double extent, gsd_target target)
{
    field_sdtree *t = calloc(1, sizeof *t);
    gsd_desc desc;
    if (!t)
        return NULL;
    memset(&desc, 0, sizeof desc);
    desc.target = target;
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = (float)extent;
    if (gsd_create(&desc, &t->field) || gsd_stream_create(t->field, &t->stream)) {
        field_sdtree_destroy(t);
        return NULL;
    }
    t->view = gsd_get_view(t->field);
    return t;
}
/* The score is that of a density in proportion to radiance. */
static void *field_sdtree_create(double extent) { return field_sdtree_create_for(extent, GSD_TARGET_RADIANCE); }
static void *field_sdtree_create_switching(double extent)
{
    return field_sdtree_create_for(extent, GSD_TARGET_SWITCHING);
}

/* In batches of 64, about what a path tracer hands over at once. A white diffuse surface: BSDF density cos / pi. */
static const char *field_sdtree_record(void *state, const sf1_sample *samples, const float *guide, uint32_t count)
{
    field_sdtree *t = state;
    gsd_training_sample batch[64];
    for (uint32_t at = 0; at < count; at += 64) {
        uint32_t n = count - at < 64 ? count - at : 64;
        for (uint32_t i = 0; i < n; ++i) {
            const sf1_sample *s = &samples[at + i];
            float bsdf = s->cosine * (float)(1 / SF1_PI), contribution = s->radiance * bsdf;
            batch[i] = gsd_make_scalar_sample(s->position, s->direction, s->normal, s->distance, s->radiance,
                                              contribution, contribution, s->pdf, bsdf, guide[at + i]);
        }
        gsd_result result = gsd_record(t->stream, batch, n);
        if (result)
            return gsd_result_string(result);
    }
    return NULL;
}

static const char *field_sdtree_update(void *state)
{
    field_sdtree *t = state;
    gsd_result result = gsd_accumulate(t->field, &t->stream, 1, NULL, NULL);
    gsd_stream_clear(t->stream);
    result = result ? result : gsd_refine(t->field, NULL, NULL, NULL);
    t->view = gsd_get_view(t->field);
    return result ? gsd_result_string(result) : NULL;
}

static double field_sdtree_query(void *state, field_place place, const float u[2], const float given[3],
                                 float sampled[3], double *given_pdf)
{
    const field_sdtree *t = state;
    gsd_handle h = gsd_find(&t->view, place.position, place.normal, NULL);
    *given_pdf = (double)gsd_pdf(&t->view, &h, given);
    return (double)gsd_sample(&t->view, &h, u, sampled);
}

static double field_sdtree_pdf(void *state, field_place place, const float direction[3])
{
    const field_sdtree *t = state;
    gsd_handle h = gsd_find(&t->view, place.position, place.normal, NULL);
    return (double)gsd_pdf(&t->view, &h, direction);
}

static uint64_t field_sdtree_bytes(void *state)
{
    gsd_stats stats;
    gsd_get_stats(((field_sdtree *)state)->field, &stats);
    return stats.bytes;
}

static uint32_t field_sdtree_cells(void *state) { return gsd_cell_count(((field_sdtree *)state)->field); }

#define FIELD_SDTREE_METHOD(name, create, what)                                                                        \
    {                                                                                                                  \
        name, what, create, field_sdtree_record, field_sdtree_update, field_sdtree_query, field_sdtree_pdf,            \
            field_sdtree_bytes, field_sdtree_cells, field_sdtree_destroy                                               \
    }
static const field_method field_sdtree_method =
    FIELD_SDTREE_METHOD("sdtree", field_sdtree_create, "guide_sdtree.h, target radiance, else defaults");
static const field_method field_sdtree_switching_method =
    FIELD_SDTREE_METHOD("sdtree-switching", field_sdtree_create_switching, "guide_sdtree.h, all defaults");

#endif
