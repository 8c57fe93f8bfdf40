/* texture.c: bitmap and checkerboard lookups. Any thread; no allocation; any u, v (NaN and infinite read as 0). */
#include "tracer.h"

#include <stdlib.h>
#include <string.h>

/* floorf without the library call; |x| < 2^31. */
static inline int floor_int(float x)
{
    int i = (int)x;
    return i - (x < (float)i);
}

/* A coordinate that is safe to turn into an int after scaling by an image size. */
static inline float safe_uv(float x) { return fabsf(x) < 1e6f ? x : 0; }

/* x brought to [0, 1] by the wrap mode. */
static inline float wrap_uv(float x, tr_wrap wrap)
{
    if (wrap == TR_WRAP_CLAMP)
        return clampf(x, 0, 1);
    if (wrap == TR_WRAP_REPEAT)
        return x - (float)floor_int(x);
    float m = x - 2 * (float)floor_int(0.5f * x);
    return m > 1 ? 2 - m : m;
}

/* A texel index one step outside [0, n) brought back: around for repeat; the border texel for clamp and mirror, whose
   reflection at the border is the border texel itself. */
static inline int wrap_index(int i, int n, tr_wrap wrap)
{
    if ((unsigned)i < (unsigned)n)
        return i;
    if (wrap == TR_WRAP_REPEAT)
        return i < 0 ? n - 1 : 0;
    return i < 0 ? 0 : n - 1;
}

static inline vec3 texel(const tr_image *image, int x, int y)
{
    const float *p = image->data + ((size_t)y * (size_t)image->width + (size_t)x) * (size_t)image->channels;
    return image->channels >= 3 ? v3(p[0], p[1], p[2]) : v3s(p[0]);
}

/* The place of texel (x, y) in blocks is the sum of these. */
static inline size_t block_x(int x) { return (size_t)(x & ~3) * 4 + (size_t)(x & 3); }
static inline size_t block_y(const tr_texels *t, int y)
{
    return (size_t)(y >> 2) * t->block_row + (size_t)(y & 3) * 4;
}

static inline vec3 palette_texel(const tr_texels *t, size_t at)
{
    const uint8_t *code = t->code[at];
    return v3(t->palette[code[0]], t->palette[code[1]], t->palette[code[2]]);
}

static inline void texture_uv(const tr_texture *t, float u, float v, float *s, float *r)
{
    *s = safe_uv(t->uv[0][0] * u + t->uv[0][1] * v + t->uv[0][2]);
    *r = safe_uv(t->uv[1][0] * u + t->uv[1][1] * v + t->uv[1][2]);
}

/* The four texels around (s, r) and the place between them. Texel centres lie at (i + 0.5) / size. */
static inline void footprint(const tr_texture *t, float s, float r, vec3 texels[4], float *fx, float *fy)
{
    const tr_image *image = &t->image;
    float x = wrap_uv(s, t->wrap) * (float)image->width - 0.5f;
    float y = (1 - wrap_uv(r, t->wrap)) * (float)image->height - 0.5f;
    int x0 = floor_int(x), y0 = floor_int(y);
    *fx = x - (float)x0;
    *fy = y - (float)y0;
    int xa = wrap_index(x0, image->width, t->wrap), xb = wrap_index(x0 + 1, image->width, t->wrap);
    int ya = wrap_index(y0, image->height, t->wrap), yb = wrap_index(y0 + 1, image->height, t->wrap);
    const tr_texels *packed = t->texels;
    if (packed) {
        size_t ia = block_x(xa), ib = block_x(xb), ja = block_y(packed, ya), jb = block_y(packed, yb);
        texels[0] = palette_texel(packed, ia + ja);
        texels[1] = palette_texel(packed, ib + ja);
        texels[2] = palette_texel(packed, ia + jb);
        texels[3] = palette_texel(packed, ib + jb);
        return;
    }
    texels[0] = texel(image, xa, ya);
    texels[1] = texel(image, xb, ya);
    texels[2] = texel(image, xa, yb);
    texels[3] = texel(image, xb, yb);
}

static inline bool has_pixels(const tr_image *image)
{
    return image->data && image->width > 0 && image->height > 0 && image->channels > 0;
}

/* The palette as it is found, through a hash table of the values' bits with open addressing. */
typedef struct palette_builder {
    uint32_t bits[1024];
    int16_t code[1024]; /* -1 = free */
    int count;
    float *palette;
} palette_builder;

/* The code of a value, a new one if need be; -1 where all are taken. */
static inline int palette_code(palette_builder *b, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    uint32_t at = (bits * 0x9e3779b1u) >> 22;
    while (b->code[at] >= 0 && b->bits[at] != bits)
        at = (at + 1) & 1023;
    if (b->code[at] < 0) {
        if (b->count == 256)
            return -1;
        b->palette[b->count] = value;
        b->bits[at] = bits;
        b->code[at] = (int16_t)b->count++;
    }
    return b->code[at];
}

static bool fill_texels(tr_texels *t, const tr_image *image)
{
    palette_builder b = {.palette = t->palette};
    memset(b.code, 0xff, sizeof b.code);
    const float *p = image->data;
    for (int y = 0; y < image->height; ++y)
        for (int x = 0; x < image->width; ++x) {
            uint8_t *code = t->code[block_x(x) + block_y(t, y)];
            for (int c = 0; c < 3; ++c) {
                int found = palette_code(&b, *p++);
                if (found < 0)
                    return false;
                code[c] = (uint8_t)found;
            }
        }
    return true;
}

tr_texels *tr_texels_make(const tr_image *image)
{
    if (!has_pixels(image) || image->channels != 3)
        return NULL;
    tr_texels *t = calloc(1, sizeof *t);
    if (!t)
        return NULL;
    t->block_row = ((size_t)image->width + 3) / 4 * 16;
    size_t size = ((size_t)image->height + 3) / 4 * t->block_row * sizeof *t->code;
    t->code = tr_alloc_pages(size);
    if (t->code && fill_texels(t, image))
        return t;
    tr_texels_free(t);
    return NULL;
}

void tr_texels_free(tr_texels *texels)
{
    if (texels)
        free(texels->code);
    free(texels);
}

void tr_texture_prefetch(const tr_texture *texture, float u, float v)
{
    const tr_image *image = &texture->image;
    if (texture->type != TR_TEXTURE_BITMAP || !has_pixels(image))
        return;
    float s, r;
    texture_uv(texture, u, v, &s, &r);
    int x = (int)(wrap_uv(s, texture->wrap) * (float)image->width - 0.5f);
    int y = (int)((1 - wrap_uv(r, texture->wrap)) * (float)image->height - 0.5f);
    if (texture->texels) {
        /* With its diagonal neighbour, which is the other block wherever there are two. */
        int x1 = x + 1 < image->width ? x + 1 : x, y1 = y + 1 < image->height ? y + 1 : y;
        TR_PREFETCH(texture->texels->code + block_x(x) + block_y(texture->texels, y));
        TR_PREFETCH(texture->texels->code + block_x(x1) + block_y(texture->texels, y1));
        return;
    }
    size_t row = (size_t)image->width * (size_t)image->channels;
    const float *p = image->data + (size_t)y * row + (size_t)x * (size_t)image->channels;
    TR_PREFETCH(p);
    TR_PREFETCH(p + (y + 1 < image->height ? row : 0));
}

vec3 tr_texture_eval(const tr_texture *texture, float u, float v)
{
    float s, r;
    texture_uv(texture, u, v, &s, &r);
    if (texture->type == TR_TEXTURE_CHECKERBOARD)
        return ((floor_int(2 * s) + floor_int(2 * r)) & 1) ? texture->color1 : texture->color0;
    const tr_image *image = &texture->image;
    if (!has_pixels(image))
        return v3s(0);
    if (texture->nearest) {
        int x = (int)(wrap_uv(s, texture->wrap) * (float)image->width);
        int y = (int)((1 - wrap_uv(r, texture->wrap)) * (float)image->height);
        return texel(image, x < image->width ? x : image->width - 1, y < image->height ? y : image->height - 1);
    }
    vec3 q[4];
    float fx, fy;
    footprint(texture, s, r, q, &fx, &fy);
    vec3 top = madd3(q[0], sub3(q[1], q[0]), fx), bottom = madd3(q[2], sub3(q[3], q[2]), fx);
    return madd3(top, sub3(bottom, top), fy);
}

/* The exact derivative of the bilinear patch (what a finite difference within one texel converges to), also for
   nearest lookups, whose own derivative is 0 almost everywhere. Row 0 is v = 1, hence the sign of the second term. */
void tr_texture_gradient(const tr_texture *texture, float u, float v, float *du, float *dv)
{
    *du = *dv = 0;
    if (texture->type != TR_TEXTURE_BITMAP || !has_pixels(&texture->image))
        return;
    float s, r, fx, fy;
    texture_uv(texture, u, v, &s, &r);
    vec3 q[4];
    footprint(texture, s, r, q, &fx, &fy);
    float a = mean3(q[0]), b = mean3(q[1]), c = mean3(q[2]), d = mean3(q[3]);
    float ds = lerpf(b - a, d - c, fy) * (float)texture->image.width;
    float dr = -lerpf(c - a, d - b, fx) * (float)texture->image.height;
    if (texture->wrap == TR_WRAP_MIRROR) { /* every other period runs backwards */
        ds = floor_int(s) & 1 ? -ds : ds;
        dr = floor_int(r) & 1 ? -dr : dr;
    } else if (texture->wrap == TR_WRAP_CLAMP) {
        ds = s < 0 || s > 1 ? 0 : ds;
        dr = r < 0 || r > 1 ? 0 : dr;
    }
    *du = ds * texture->uv[0][0] + dr * texture->uv[1][0];
    *dv = ds * texture->uv[0][1] + dr * texture->uv[1][1];
}
