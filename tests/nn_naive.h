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

/* ---- the U-Net of gnn_unet_desc */

typedef struct naive_net {
    int width, height, inputs, levels, masked;
    const int *channels;
    double lambda, deep;
    double **tensors; /* in the order of gnn_unet_tensor */
} naive_net;

static inline void naive_halve(const double *from, int channels, int width, int height, double *to)
{
    for (int c = 0; c < channels; ++c)
        for (int y = 0; y < height / 2; ++y)
            for (int x = 0; x < width / 2; ++x) {
                const double *p = &from[(c * height + 2 * y) * width + 2 * x];
                to[(c * (height / 2) + y) * (width / 2) + x] = (p[0] + p[1] + p[width] + p[width + 1]) / 4;
            }
}

/* Two convolutions; the second adds what it gets. mask becomes that of the result; NULL = none. */
static inline void naive_pair(const double *x, int in, int width, int height, double **t, double *mask, int out,
                              double *y)
{
    double *a = naive_new((size_t)(out * width * height)), *grown = naive_new((size_t)(width * height));
    naive_conv(x, in, width, height, t[0], t[1], mask, NULL, 1, out, a);
    for (int step = 0; step < 2; ++step) {
        if (step)
            naive_conv(a, out, width, height, t[2], t[3], mask, a, 1, out, y);
        for (int i = 0; mask && i < width * height; ++i) {
            grown[i] = 0;
            for (int k = 0; k < 9; ++k)
                if (naive_at(mask, width, height, i % width + k % 3 - 1, i / width + k / 3 - 1) > 0)
                    grown[i] = 1;
        }
        if (mask)
            memcpy(mask, grown, (size_t)(width * height) * sizeof *mask);
    }
    free(a);
    free(grown);
}

static inline double *naive_down(const naive_net *n, int level, const double *above, double *mask)
{
    int width = n->width >> level, height = n->height >> level, in = level ? n->channels[level - 1] : n->inputs;
    double *x = naive_new((size_t)(in * width * height));
    double *y = naive_new((size_t)(n->channels[level] * width * height));
    if (level) {
        naive_halve(above, in, 2 * width, 2 * height, x);
        double *small = naive_new((size_t)(width * height));
        naive_halve(mask, 1, 2 * width, 2 * height, small);
        for (int i = 0; i < width * height; ++i)
            mask[i] = small[i] > 0;
        free(small);
    } else {
        for (int i = 0; i < in * width * height; ++i)
            x[i] = n->masked && mask[i % (width * height)] == 0 ? 0 : above[i];
    }
    naive_pair(x, in, width, height, n->tensors + 4 * level, n->masked ? mask : NULL, n->channels[level], y);
    free(x);
    return y;
}

/* Takes what lies below, returns this level. */
static inline double *naive_up(const naive_net *n, int level, double *below, const double *skip)
{
    int width = n->width >> level, height = n->height >> level, up = n->channels[level + 1], in = n->channels[level];
    double *x = naive_new((size_t)((up + in) * width * height)), *y = naive_new((size_t)(in * width * height));
    naive_upsample(below, up, width / 2, height / 2, x);
    memcpy(x + up * width * height, skip, (size_t)(in * width * height) * sizeof *x);
    naive_pair(x, up + in, width, height, n->tensors + 4 * n->levels + 4 * level, NULL, in, y);
    free(x);
    free(below);
    return y;
}

/* Loss of one level; out = its output. */
static inline double naive_level_loss(const naive_net *n, int level, const double *y, const double *input,
                                      const double *truth, double *out)
{
    int area = (n->width >> level) * (n->height >> level);
    double **head = n->tensors + 8 * n->levels - 4 + 2 * level, sum = 0;
    for (int i = 0; i < area; ++i) {
        out[i] = input[i] + head[1][0];
        for (int c = 0; c < n->channels[level]; ++c)
            out[i] += head[0][c] * y[c * area + i];
        double away = out[i] - truth[i], before = input[i] - truth[i];
        sum += (away * before < 0 ? n->lambda : 1) * (away < 0 ? -away : away);
    }
    return sum / area;
}

/* Loss of one map; out[height][width]. */
static inline double naive_unet(const naive_net *n, const double *inputs, const double *truth, double *out)
{
    int area = n->width * n->height;
    double *down[8] = {0}, *below, sum = 0, *mask = naive_new((size_t)area), *spare = naive_new((size_t)area);
    double *plain[8], *small[8];
    for (int i = 0; i < area; ++i)
        mask[i] = inputs[(n->inputs - 1) * area + i] > 0;
    for (int l = 0; l < n->levels; ++l) {
        down[l] = naive_down(n, l, l ? down[l - 1] : inputs, mask);
        plain[l] = naive_new((size_t)area);
        small[l] = naive_new((size_t)area);
        if (l) {
            naive_halve(plain[l - 1], 1, n->width >> (l - 1), n->height >> (l - 1), plain[l]);
            naive_halve(small[l - 1], 1, n->width >> (l - 1), n->height >> (l - 1), small[l]);
        } else {
            memcpy(plain[0], inputs, (size_t)area * sizeof(double));
            memcpy(small[0], truth, (size_t)area * sizeof(double));
        }
    }
    below = down[n->levels - 1];
    for (int l = n->levels - 2; l >= 0; --l) {
        below = naive_up(n, l, below, down[l]);
        if (l)
            sum += n->deep * naive_level_loss(n, l, below, plain[l], small[l], spare);
    }
    sum += naive_level_loss(n, 0, below, plain[0], small[0], out);
    for (int l = 0; l < n->levels; ++l) {
        if (l < n->levels - 1)
            free(down[l]);
        free(plain[l]);
        free(small[l]);
    }
    free(below);
    free(mask);
    free(spare);
    return sum;
}

#endif
