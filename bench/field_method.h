/* field_method.h: what bench_field asks of a guiding method (field_sdtree.h is an example); C and C++. */
#ifndef FIELD_METHOD_H
#define FIELD_METHOD_H

#include "sf1.h"

/* Where a direction is asked for. The cube is [0, extent]^3; normal NULL = density of radiance alone, else the method
   may multiply the surface's cosine in. surface: the normal even where the cosine is not wanted, for methods that leave
   out what lies below; NULL = directions of the whole sphere. */
typedef struct field_place {
    const float *position, *normal, *surface;
} field_place;

/* Functions that return text return NULL where all went well, else what went wrong. */
typedef struct field_method {
    const char *name, *what;
    void *(*create)(double extent); /* NULL = out of memory; where this pointer is NULL the method is not built */
    /* Samples of the running update; guide[i] = the method's own density at samples[i], 0 = not guided there. */
    const char *(*record)(void *state, const sf1_sample *samples, const float *guide, uint32_t count);
    const char *(*update)(void *state); /* learn from what was recorded; queries see it from here on */
    /* Find, then sample with u (in [0, 1)^2) and the density of a given direction; returns the sample's density. */
    double (*query)(void *state, field_place place, const float u[2], const float given[3], float sampled[3],
                    double *given_pdf);
    double (*pdf)(void *state, field_place place, const float direction[3]); /* find, then the density, 1/sr */
    uint64_t (*bytes)(void *state); /* all that it needs between updates, without buffers of samples; 0 = not told */
    uint32_t (*cells)(void *state);
    void (*destroy)(void *state);
} field_method;

#endif
