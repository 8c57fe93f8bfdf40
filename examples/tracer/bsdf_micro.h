/* bsdf_micro.h: Fresnel terms and microfacet distributions, as small inline kernels in the local frame (z = normal).

   Distributions are isotropic, heights uncorrelated between wo and wi (G = G1(wo) G1(wi)), normals sampled from those
   visible to wo, so that f cos / pdf of a reflection is F G1(wi). Angles come as cosines; all functions are finite for
   0 < cos <= 1 and alpha >= TR_ALPHA_MIN. */
#ifndef TR_BSDF_MICRO_H
#define TR_BSDF_MICRO_H

#include "tracer.h"

#define TR_ALPHA_MIN 1e-3f

/* tr_closure_sample_delta without its test of what a bump map blocks. *gap: straight through a mask. */
bool tr_closure_draw_delta(const tr_closure *closure, float u, vec3 *wi, vec3 *weight, float *eta_scale, bool *gap);

/* Unpolarised reflectance between dielectrics (Fresnel; Born & Wolf 1999, 1.5.2), from both cosines, >= 0 and not both
   0; eta = index of the far side over that of the near side. */
static inline float tr_fresnel_cosines(float cos_i, float cos_t, float eta)
{
    float s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t), p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t);
    return 0.5f * (s * s + p * p);
}

/* The same from cos_i >= 0 alone. *cos_t is the refracted cosine, 0 under total internal reflection (F = 1). */
static inline float tr_fresnel_dielectric(float cos_i, float eta, float *cos_t)
{
    float cos2_t = 1 - (1 - cos_i * cos_i) / (eta * eta);
    if (!(cos2_t > 0)) {
        *cos_t = 0;
        return 1;
    }
    *cos_t = sqrtf(cos2_t);
    return tr_fresnel_cosines(cos_i, *cos_t, eta);
}

/* Reflectance of a conductor with index eta + i k (Born & Wolf 1999, 14.2, solved for real terms):
     a^2 + b^2 = sqrt((eta^2 - k^2 - s^2)^2 + 4 eta^2 k^2),  2 a^2 = a^2 + b^2 + eta^2 - k^2 - s^2
     Rs = (a^2 + b^2 - 2 a c + c^2) / (a^2 + b^2 + 2 a c + c^2)
     Rp = Rs (c^2 (a^2 + b^2) + s^4 - 2 a c s^2) / (c^2 (a^2 + b^2) + s^4 + 2 a c s^2)
   written over one division: (Rs + Rp) / 2 = (t1 - t2) t3 / ((t1 + t2) (t3 + t4)). eta = 0 gives exactly 1. */
static inline float tr_fresnel_conductor1(float c, float c2, float s2, float eta, float k)
{
    float d = eta * eta - k * k - s2, e = 2 * eta * k;
    float ab = sqrtf(d * d + e * e), a = sqrtf(tr_max(0, 0.5f * (ab + d)));
    float t1 = ab + c2, t2 = 2 * a * c, t3 = c2 * ab + s2 * s2, t4 = t2 * s2;
    return (t1 - t2) * t3 / ((t1 + t2) * (t3 + t4));
}
static inline vec3 tr_fresnel_conductor(float c, vec3 eta, vec3 k)
{
    float c2 = c * c, s2 = tr_max(0, 1 - c2);
    return v3(tr_fresnel_conductor1(c, c2, s2, eta.x, k.x), tr_fresnel_conductor1(c, c2, s2, eta.y, k.y),
              tr_fresnel_conductor1(c, c2, s2, eta.z, k.z));
}

/* (1 - c)^5 of Schlick 1994. */
static inline float tr_schlick(float c)
{
    float m = clampf(1 - c, 0, 1), m2 = m * m;
    return m2 * m2 * m;
}

/* exp(-x^2) P(t) = 1 - erf(x) for x >= 0, to 1.5e-7 (Abramowitz & Stegun 1964, 7.1.26); returns P(t). */
static inline float tr_erfc_factor(float x)
{
    float t = 1 / (1 + 0.3275911f * x);
    return t * (0.254829592f + t * (-0.284496736f + t * (1.421413741f + t * (-1.453152027f + t * 1.061405429f))));
}

/* Normal distribution D(h), 1/sr, for an unnormalised h with squared length h2 and h.z > 0.
     GGX (Walter et al. 2007, eq. 33):       alpha^2 / (pi (x^2 + y^2 + alpha^2 z^2)^2)     for unit h
     Beckmann (Walter et al. 2007, eq. 25):  exp(-tan^2 / alpha^2) / (pi alpha^2 cos^4)
   in terms of x^2 + y^2, which keeps its digits for h near the normal where 1 - z^2 does not. */
static inline float tr_micro_d(int distribution, float alpha, vec3 h, float h2)
{
    float a2 = alpha * alpha, s2 = h.x * h.x + h.y * h.y, c2 = h.z * h.z;
    if (distribution == TR_GGX) {
        float q = s2 + a2 * c2;
        return a2 * h2 * h2 * TR_INV_PI / (q * q);
    }
    float x = s2 / (a2 * c2);
    return x < 80 ? expf(-x) * h2 * h2 * TR_INV_PI / (a2 * c2 * c2) : 0;
}

/* G1(w) / cos, the masking function over the cosine: finite down to the horizon.
     GGX (Walter et al. 2007, eq. 34):  G1 = 2 / (1 + sqrt(1 + alpha^2 tan^2))
     Beckmann (Smith 1967; Heitz 2014): G1 = 2 / (1 + erf(a) + exp(-a^2) / (a sqrt(pi))),  a = 1 / (alpha tan)
   Beckmann's is exact, not Walter's rational fit: the density of visible normals integrates to 1 only with it. */
static inline float tr_micro_g(int distribution, float alpha, float cos_w)
{
    float s2 = tr_max(0, 1 - cos_w * cos_w);
    if (distribution == TR_GGX)
        return 2 / (cos_w + sqrtf(cos_w * cos_w + alpha * alpha * s2));
    float t = alpha * sqrtf(s2); /* a = cos / t */
    if (cos_w > 4 * t)
        return 1 / cos_w;
    float a = cos_w / t;
    return 2 / (2 * cos_w + expf(-a * a) * (t * 0.56418958f - cos_w * tr_erfc_factor(a)));
}

/* A microfacet normal with density D(m) G1(wo) max(0, wo.m) / wo.z; wo.z > 0. Unit, m.z > 0. */
vec3 tr_micro_sample(int distribution, float alpha, vec3 wo, float u1, float u2);

/* Share of uniform (cosine-weighted) illumination that a smooth interface reflects; eta as above. */
float tr_fresnel_diffuse(float eta);

/* Fill table[TR_TRANSMITTANCE_SIZE] with the share of light from a direction that crosses a rough interface in one
   scattering (what masking blocks counts as lost; to 2e-3), seen from the side whose index is 1 / eta of the other's.
   Entry i is for cos theta = (i / (size - 1))^2. Returns the cosine-weighted mean over the hemisphere. */
float tr_rough_transmittance(int distribution, float alpha, float eta, float *table);

static inline float tr_transmittance_at(const float *table, float cos_w)
{
    float x = sqrtf(cos_w) * (TR_TRANSMITTANCE_SIZE - 1);
    int i = (int)x;
    i = i < TR_TRANSMITTANCE_SIZE - 2 ? i : TR_TRANSMITTANCE_SIZE - 2;
    return lerpf(table[i], table[i + 1], x - (float)i);
}

#endif
