/* texture.c: bitmap and checkerboard lookups. Any thread; no allocation; any u, v (NaN and infinite read as 0). */
#include "tracer.h"

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
    texels[0] = texel(image, xa, ya);
    texels[1] = texel(image, xb, ya);
    texels[2] = texel(image, xa, yb);
    texels[3] = texel(image, xb, yb);
}

static inline bool has_pixels(const tr_image *image)
{
    return image->data && image->width > 0 && image->height > 0 && image->channels > 0;
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
