/* chi_square.h: how unlikely a chi-square is. */
#ifndef TEST_CHI_SQUARE_H
#define TEST_CHI_SQUARE_H

#include <math.h>

/* Upper tail of chi-square as a normal deviate (Wilson and Hilferty). */
static inline double chi_square_deviate(double chi2, double df)
{
    return (cbrt(chi2 / df) - (1 - 2 / (9 * df))) / sqrt(2 / (9 * df));
}

#endif
