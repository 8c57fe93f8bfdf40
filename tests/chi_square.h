/* chi_square.h: how unlikely a chi-square is, and counts against what was expected of them. */
#ifndef TEST_CHI_SQUARE_H
#define TEST_CHI_SQUARE_H

#include <math.h>

/* Upper tail of chi-square as a normal deviate (Wilson and Hilferty). */
static inline double chi_square_deviate(double chi2, double df)
{
    return (cbrt(chi2 / df) - (1 - 2 / (9 * df))) / sqrt(2 / (9 * df));
}

/* The same for n counts, of which those that are expected below 20 are taken together; `error` is the relative one of
   the expectations. */
static inline double counts_deviate(const double *expected, const double *seen, int n, double error)
{
    double chi2 = 0, df = -1, rest = 0, rest_seen = 0;
    for (int k = 0; k < n; ++k) {
        double e = expected[k], s = error * e;
        if (e < 20) {
            rest += e;
            rest_seen += seen[k];
            continue;
        }
        chi2 += (seen[k] - e) * (seen[k] - e) / (e + s * s);
        df += 1;
    }
    if (rest > 5) {
        chi2 += (rest_seen - rest) * (rest_seen - rest) / rest;
        df += 1;
    }
    return chi_square_deviate(chi2, df);
}

#endif
