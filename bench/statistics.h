/* statistics.h: what the programs of this folder need of order and chance. */
#ifndef STATISTICS_H
#define STATISTICS_H

#include <math.h>

/* For qsort, of doubles. */
static inline int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* |z| that a normal variable exceeds with this probability, both sides together; by bisection. */
static inline double normal_limit(double probability)
{
    double low = 0, high = 40;
    for (int i = 0; i < 60; ++i) {
        double z = 0.5 * (low + high);
        if (erfc(z / sqrt(2.0)) > probability)
            low = z;
        else
            high = z;
    }
    return high;
}

#endif
