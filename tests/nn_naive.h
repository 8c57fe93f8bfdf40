/* nn_naive.h: the layers of guide_nn.h in double precision as their definitions have them, for the tests. Planes
   [channels][height][width]; shares no code with the header. */
#ifndef TEST_NN_NAIVE_H
#define TEST_NN_NAIVE_H

#include <stdlib.h>
#include <string.h>

/* Pixel (x, y) may lie one beyond the borders: phi wraps, and over a pole z turns back at phi + pi. */
static inline double naive_at(const double *plane, int width, int height, int x, int y)
{
    if (y < 0 || y >= height) {
        y = y < 0 ? -1 - y : 2 * height - 1 - y;
        x += width / 2;
    }
    x = ((x % width) + width) % width;
    return plane[y * width + x];
}

static inline double *naive_new(size_t count)
{
    double *p = calloc(count, sizeof *p);
    if (!p)
        abort();
    return p;
}

/* to[channels][2 height][2 width]: each pixel four times. */
static inline void naive_upsample(const double *from, int channels, int width, int height, double *to)
{
    for (int c = 0; c < channels; ++c)
        for (int y = 0; y < 2 * height; ++y)
            for (int x = 0; x < 2 * width; ++x)
                to[(c * 2 * height + y) * 2 * width + x] = from[(c * height + y / 2) * width + x / 2];
}

/* kernel[out][in][3][3]; mask, scale and valid as gnn_mask_grow has them, NULL = everywhere valid. */
static inline void naive_conv(const double *in, int channels, int width, int height, const double *kernel,
                              const double *bias, const double *mask, const double *add, int relu, int out_channels,
                              double *out)
{
    for (int o = 0; o < out_channels; ++o)
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                double sum = 0, count = 0, *to = &out[(o * height + y) * width + x];
                for (int ky = -1; ky <= 1; ++ky)
                    for (int kx = -1; kx <= 1; ++kx) {
                        if (mask && naive_at(mask, width, height, x + kx, y + ky) == 0)
                            continue;
                        count += 1;
                        for (int i = 0; i < channels; ++i)
                            sum += kernel[((o * channels + i) * 3 + ky + 1) * 3 + kx + 1] *
                                   naive_at(in + i * width * height, width, height, x + kx, y + ky);
                    }
                *to = count > 0 ? sum * 9 / count + bias[o] : 0;
                *to += add ? add[(o * height + y) * width + x] : 0;
                *to = relu && *to < 0 ? 0 : *to;
            }
}

#endif
