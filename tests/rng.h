/* rng.h: random numbers of the tests, the same on every machine (splitmix64). */
#ifndef TEST_RNG_H
#define TEST_RNG_H

#include <math.h>
#include <stdint.h>

static uint64_t rng_state = 1;

static inline void seed(uint64_t s) { rng_state = s * 0x9e3779b97f4a7c15ull + 1; }

static inline uint64_t rng_next(void)
{
    uint64_t z = rng_state += 0x9e3779b97f4a7c15ull;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
}

static inline double rnd(void) { return (double)(rng_next() >> 11) * 0x1p-53; }
static inline float rndf(void) { return (float)(rng_next() >> 40) * 0x1p-24f; }

static inline void random_direction_double(double d[3])
{
    double z = 2 * rnd() - 1, phi = 2 * 3.14159265358979323846 * rnd(), r = sqrt(1 - z * z);
    d[0] = r * cos(phi);
    d[1] = r * sin(phi);
    d[2] = z;
}

static inline void random_direction(float d[3])
{
    double exact[3];
    random_direction_double(exact);
    d[0] = (float)exact[0];
    d[1] = (float)exact[1];
    d[2] = (float)exact[2];
}

#endif
