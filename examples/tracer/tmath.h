/* tmath.h: vectors, frames, transforms, random numbers and warps shared by the example renderer. */
#ifndef TR_TMATH_H
#define TR_TMATH_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define TR_PI 3.14159265358979323846f
#define TR_INV_PI 0.31830988618379067154f

typedef struct vec3 {
    float x, y, z;
} vec3;

static inline vec3 v3(float x, float y, float z)
{
    vec3 r = {x, y, z};
    return r;
}
static inline vec3 v3s(float s) { return v3(s, s, s); }
static inline vec3 add3(vec3 a, vec3 b) { return v3(a.x + b.x, a.y + b.y, a.z + b.z); }
static inline vec3 sub3(vec3 a, vec3 b) { return v3(a.x - b.x, a.y - b.y, a.z - b.z); }
static inline vec3 mul3(vec3 a, vec3 b) { return v3(a.x * b.x, a.y * b.y, a.z * b.z); }
static inline vec3 scale3(vec3 a, float s) { return v3(a.x * s, a.y * s, a.z * s); }
static inline vec3 madd3(vec3 a, vec3 b, float s) { return v3(a.x + b.x * s, a.y + b.y * s, a.z + b.z * s); }
static inline vec3 neg3(vec3 a) { return v3(-a.x, -a.y, -a.z); }
static inline float dot3(vec3 a, vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline vec3 cross3(vec3 a, vec3 b)
{
    return v3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
static inline float len3(vec3 a) { return sqrtf(dot3(a, a)); }
static inline float mean3(vec3 a) { return (a.x + a.y + a.z) * (1.0f / 3.0f); }
/* fminf and fmaxf are library calls without -ffast-math; these are one instruction. A NaN x gives the bound. */
static inline float tr_min(float bound, float x) { return x < bound ? x : bound; }
static inline float tr_max(float bound, float x) { return x > bound ? x : bound; }
static inline float max3(vec3 a) { return tr_max(tr_max(a.z, a.y), a.x); }
static inline bool finite3(vec3 a) { return (a.x - a.x) + (a.y - a.y) + (a.z - a.z) == 0; } /* inf - inf is NaN */
static inline bool black3(vec3 a) { return a.x == 0 && a.y == 0 && a.z == 0; }
/* The unit vector along a; (0, 0, 1) where a has no direction. */
static inline vec3 norm3(vec3 a)
{
    float l2 = dot3(a, a);
    return l2 > 0 && isfinite(l2) ? scale3(a, 1.0f / sqrtf(l2)) : v3(0, 0, 1);
}
static inline float clampf(float x, float lo, float hi) { return x < lo ? lo : x > hi ? hi : x; }
static inline float lerpf(float a, float b, float t) { return a + (b - a) * t; }
static inline float sqrf(float x) { return x * x; }

/* An orthonormal frame; n is the local z axis. */
typedef struct frame3 {
    vec3 s, t, n;
} frame3;

/* A frame around unit n without a branch on its direction (Duff et al. 2017). */
static inline frame3 frame_from_normal(vec3 n)
{
    float sign = copysignf(1.0f, n.z), a = -1.0f / (sign + n.z), b = n.x * n.y * a;
    frame3 f;
    f.s = v3(1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x);
    f.t = v3(b, sign + n.y * n.y * a, -n.y);
    f.n = n;
    return f;
}
static inline vec3 to_local(const frame3 *f, vec3 w) { return v3(dot3(f->s, w), dot3(f->t, w), dot3(f->n, w)); }
static inline vec3 to_world(const frame3 *f, vec3 l)
{
    return add3(add3(scale3(f->s, l.x), scale3(f->t, l.y)), scale3(f->n, l.z));
}

/* Row-major 4x4 matrix acting on column vectors: p' = M p, as Mitsuba's <matrix> lists it. */
typedef struct mat4 {
    float m[4][4];
} mat4;

static inline vec3 xform_point(const mat4 *a, vec3 p)
{
    return v3(a->m[0][0] * p.x + a->m[0][1] * p.y + a->m[0][2] * p.z + a->m[0][3],
              a->m[1][0] * p.x + a->m[1][1] * p.y + a->m[1][2] * p.z + a->m[1][3],
              a->m[2][0] * p.x + a->m[2][1] * p.y + a->m[2][2] * p.z + a->m[2][3]);
}
static inline vec3 xform_vector(const mat4 *a, vec3 v)
{
    return v3(a->m[0][0] * v.x + a->m[0][1] * v.y + a->m[0][2] * v.z,
              a->m[1][0] * v.x + a->m[1][1] * v.y + a->m[1][2] * v.z,
              a->m[2][0] * v.x + a->m[2][1] * v.y + a->m[2][2] * v.z);
}
/* Normals go by the transpose of the inverse: pass the inverse of the matrix that points go by. */
static inline vec3 xform_normal(const mat4 *inverse, vec3 n)
{
    const mat4 *i = inverse;
    return v3(i->m[0][0] * n.x + i->m[1][0] * n.y + i->m[2][0] * n.z,
              i->m[0][1] * n.x + i->m[1][1] * n.y + i->m[2][1] * n.z,
              i->m[0][2] * n.x + i->m[1][2] * n.y + i->m[2][2] * n.z);
}

/* Random numbers: PCG32 (O'Neill 2014), seeded by a hash so that neighbouring paths are unrelated. */
typedef struct tr_rng {
    uint64_t state, inc;
} tr_rng;

static inline uint64_t tr_hash64(uint64_t x)
{
    x ^= x >> 32;
    x *= UINT64_C(0xd6e8feb86659fd93);
    x ^= x >> 32;
    x *= UINT64_C(0xd6e8feb86659fd93);
    x ^= x >> 32;
    return x;
}
static inline uint32_t rng_u32(tr_rng *r)
{
    uint64_t old = r->state;
    r->state = old * UINT64_C(6364136223846793005) + r->inc;
    uint32_t xs = (uint32_t)(((old >> 18) ^ old) >> 27), rot = (uint32_t)(old >> 59);
    return (xs >> rot) | (xs << ((32 - rot) & 31));
}
/* Uniform in [0, 1), 24 bits. */
static inline float rng_float(tr_rng *r) { return (float)(int32_t)(rng_u32(r) >> 8) * 0x1p-24f; }
/* Two at once from one step, through a permutation of all 64 bits (RXS-M-XS of the same paper). */
static inline void rng_float2(tr_rng *r, float *a, float *b)
{
    uint64_t old = r->state;
    r->state = old * UINT64_C(6364136223846793005) + r->inc;
    uint64_t word = ((old >> ((old >> 59) + 5)) ^ old) * UINT64_C(12605985483714917081);
    word ^= word >> 43;
    *a = (float)(int32_t)(word >> 40) * 0x1p-24f;
    *b = (float)(int32_t)((uint32_t)word >> 8) * 0x1p-24f;
}
static inline tr_rng rng_seed(uint64_t seed, uint64_t stream)
{
    tr_rng r;
    r.state = tr_hash64(seed + UINT64_C(0x9e3779b97f4a7c15) * (stream + 1));
    r.inc = (tr_hash64(stream ^ UINT64_C(0xda3e39cb94b95bdb)) << 1) | 1;
    rng_u32(&r);
    return r;
}

/* Sine and cosine of u full turns, 0 <= u <= 1, to 1e-7, inline: the warps below take most of their time here. The
   nearest quarter turn is taken off exactly; Taylor's polynomials, their last terms adjusted, do the rest. */
static inline void sincos_turn(float u, float *sine, float *cosine)
{
    int quarter = (int)(u * 4 + 0.5f);
    float x = (u - 0.25f * (float)quarter) * (2 * TR_PI), x2 = x * x;
    float s = x + x * x2 * (-1.6666654611e-1f + x2 * (8.3321608736e-3f - x2 * 1.9515295891e-4f));
    float c =
        1 - 0.5f * x2 + x2 * x2 * (4.166664568298827e-2f + x2 * (-1.388731625493765e-3f + x2 * 2.443315711809948e-5f));
    const float both[3] = {s, c, s}; /* indexed and multiplied, since branches on a random quarter are guessed wrong */
    *sine = both[quarter & 1] * (float)(1 - (quarter & 2));
    *cosine = both[(quarter & 1) + 1] * (float)(1 - ((quarter + 1) & 2));
}

/* Warps of (u1, u2) in [0,1)^2. */
static inline vec3 sample_cosine_hemisphere(float u1, float u2)
{
    float r = sqrtf(u1), s, c;
    sincos_turn(u2, &s, &c);
    return v3(r * c, r * s, sqrtf(tr_max(0, 1 - u1)));
}
static inline vec3 sample_uniform_sphere(float u1, float u2)
{
    float z = 1 - 2 * u1, r = sqrtf(tr_max(0, 1 - z * z)), s, c;
    sincos_turn(u2, &s, &c);
    return v3(r * c, r * s, z);
}
/* The share of strategy a in the balance heuristic (Veach 1997). */
static inline float balance(float a, float b) { return a > 0 ? (isinf(a) ? 1 : a / (a + b)) : 0; }

#endif
