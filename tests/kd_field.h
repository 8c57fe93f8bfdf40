/* kd_field.h: fields of guide_kd.h, for the tests. After cmocka_prelude.h and guide_kd.h. */
#ifndef TEST_KD_FIELD_H
#define TEST_KD_FIELD_H

#include <string.h>

#define PI 3.14159265358979323846
#define UNIFORM (1 / (4 * PI))
#define OK(call) assert_int_equal((call), GKD_OK)

static inline gkd_desc unit_cube(void)
{
    gkd_desc d;
    memset(&d, 0, sizeof d);
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    return d;
}

static inline void learn(gkd_field *f, const gkd_training_sample *s, uint32_t n)
{
    gkd_stream *stream;
    OK(gkd_stream_create(f, &stream));
    OK(gkd_record(stream, s, n));
    OK(gkd_accumulate(f, &stream, 1, NULL, NULL));
    gkd_stream_destroy(stream);
}

#endif
