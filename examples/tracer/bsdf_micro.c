/* bsdf_micro.c: sampling of visible microfacet normals, and the integrals over interfaces that plastics need. */
#include "bsdf_micro.h"

/* Inverse of erf on (-1, 1), relative error 3.5e-7 (Giles 2012, "Approximating the erfinv function", table 5). */
static float erf_inverse(float x)
{
    float w = -logf((1 - x) * (1 + x)), p;
    if (w < 5) {
        w -= 2.5f;
        p = 2.81022636e-08f;
        p = 3.43273939e-07f + p * w;
        p = -3.5233877e-06f + p * w;
        p = -4.39150654e-06f + p * w;
        p = 0.00021858087f + p * w;
        p = -0.00125372503f + p * w;
        p = -0.00417768164f + p * w;
        p = 0.246640727f + p * w;
        p = 1.50140941f + p * w;
    } else {
        w = sqrtf(w) - 3;
        p = -0.000200214257f;
        p = 0.000100950558f + p * w;
        p = 0.00134934322f + p * w;
        p = -0.00367342844f + p * w;
        p = 0.00573950773f + p * w;
        p = -0.0076224613f + p * w;
        p = 0.00943887047f + p * w;
        p = 1.00167406f + p * w;
        p = 2.83297682f + p * w;
    }
    return p * x;
}

/* Slope x, in the plane of incidence, of a Beckmann surface of unit roughness seen under (cos, sin). Visible slopes
   have the density (cos - x sin)+ exp(-x^2) / sqrt(pi), so their distribution function is, up to its norm,
     C(x) = cos (1 + erf x) + sin exp(-x^2) / sqrt(pi),   x <= cos / sin
   (Heitz & d'Eon 2014, section 4). Solved for b = erf x, where dC/db = cos - x sin is well scaled everywhere, by
   Newton steps kept inside a shrinking bracket; the last, small step is made in x. */
static float beckmann_slope(float c, float s, float u)
{
    const float inv_sqrt_pi = 0.56418958f;
    float cot = c / s, hi = 1;
    if (cot < 5)
        hi = 1 - tr_erfc_factor(cot) * expf(-cot * cot);
    float norm = c * (1 + hi) + s * inv_sqrt_pi * (cot < 9 ? expf(-cot * cot) : 0), target = u * norm;
    float lo = -1, b = lerpf(lo, hi, u), x = 0;
    for (int i = 0; i < 12; i++) {
        if (!(b > lo && b < hi))
            b = 0.5f * (lo + hi);
        x = erf_inverse(clampf(b, -0.9999999f, 0.9999999f));
        float e = expf(-x * x), error = c * (1 + b) + s * inv_sqrt_pi * e - target, step = error / (c - x * s);
        float dx = step * 0.88622693f / e; /* dx/db = sqrt(pi) / 2 exp(x^2) */
        if (fabsf(dx) < 3e-3f) {
            x -= dx;
            break;
        }
        if (error > 0)
            hi = b;
        else
            lo = b;
        b -= step;
    }
    return x;
}

/* Heitz & d'Eon 2014: stretch wo to unit roughness, sample a slope there, turn and stretch back. */
static vec3 sample_beckmann(float alpha, vec3 wo, float u1, float u2)
{
    vec3 w = norm3(v3(alpha * wo.x, alpha * wo.y, wo.z));
    float s = sqrtf(w.x * w.x + w.y * w.y), x, y, cos_phi = 1, sin_phi = 0;
    if (s < 1e-4f) {
        float r = sqrtf(-logf(1 - u1)), sine, cosine;
        sincos_turn(u2, &sine, &cosine);
        x = r * cosine;
        y = r * sine;
    } else {
        x = beckmann_slope(w.z, s, u1);
        y = erf_inverse(clampf(2 * u2 - 1, -0.9999999f, 0.9999999f));
        cos_phi = w.x / s;
        sin_phi = w.y / s;
    }
    return norm3(v3(-alpha * (cos_phi * x - sin_phi * y), -alpha * (sin_phi * x + cos_phi * y), 1));
}

/* Heitz 2018 in the form of Dupuy & Benyoub 2023: stretch wo to unit roughness, where the visible normal lies halfway
   between wo and a uniform direction of the spherical cap z >= -wo.z, and stretch back. */
static vec3 sample_ggx(float alpha, vec3 wo, float u1, float u2)
{
    vec3 w = norm3(v3(alpha * wo.x, alpha * wo.y, wo.z));
    float hz = (1 - u1) * (1 + w.z), z = hz - w.z; /* hz = z + w.z, without cancellation */
    float r = sqrtf(tr_max(0, 1 - z * z)), sine, cosine;
    sincos_turn(u2, &sine, &cosine);
    return norm3(v3(alpha * (r * cosine + w.x), alpha * (r * sine + w.y), hz));
}

vec3 tr_micro_sample(int distribution, float alpha, vec3 wo, float u1, float u2)
{
    return distribution == TR_GGX ? sample_ggx(alpha, wo, u1, u2) : sample_beckmann(alpha, wo, u1, u2);
}

/* 2 int_0^1 F(c) c dc by the midpoint rule in x = c^2. From the denser side F jumps to 1 at the critical angle, so that
   side goes through 1 - Fdr(1 / eta) = eta^2 (1 - Fdr(eta)) (reciprocity; Egan & Hilgeman 1979). */
float tr_fresnel_diffuse(float eta)
{
    float outer = eta >= 1 ? eta : 1 / eta, cos_t;
    double sum = 0;
    for (int i = 0; i < 2048; i++)
        sum += (double)tr_fresnel_dielectric(sqrtf(((float)i + 0.5f) / 2048), outer, &cos_t);
    float fdr = (float)(sum / 2048);
    return eta >= 1 ? fdr : 1 - (1 - fdr) * eta * eta;
}

/* E over visible normals m of (1 - F(wo.m)) G1(wi), wi refracted at m: the integral of the rough BTDF of Walter et al.
   2007 over the far side. Midpoint rule in the sampler's own unit square; half of it for u2, by mirror symmetry. */
static float transmittance_from(int distribution, float alpha, float eta, float cos_o)
{
    enum { N1 = 40, N2 = 16 };
    vec3 wo = v3(sqrtf(tr_max(0, 1 - cos_o * cos_o)), 0, cos_o);
    double sum = 0;
    for (int i = 0; i < N1; i++) {
        for (int j = 0; j < N2; j++) {
            vec3 m = tr_micro_sample(distribution, alpha, wo, ((float)i + 0.5f) / N1, 0.5f * ((float)j + 0.5f) / N2);
            float c = dot3(wo, m), cos_t, f = tr_fresnel_dielectric(tr_max(c, 0), eta, &cos_t);
            float z = wo.z / eta - m.z * (c / eta - cos_t); /* -wi.z */
            if (c > 0 && z > 0 && f < 1)
                sum += (double)((1 - f) * z * tr_micro_g(distribution, alpha, tr_min(z, 1)));
        }
    }
    return (float)(sum / (N1 * N2));
}

float tr_rough_transmittance(int distribution, float alpha, float eta, float *table)
{
    for (int i = 0; i < TR_TRANSMITTANCE_SIZE; i++) {
        float x = (float)i / (TR_TRANSMITTANCE_SIZE - 1);
        table[i] = clampf(transmittance_from(distribution, alpha, eta, tr_max(x * x, 1e-4f)), 0, 1);
    }
    double mean = 0;
    for (int i = 0; i < 2048; i++)
        mean += (double)tr_transmittance_at(table, sqrtf(((float)i + 0.5f) / 2048));
    return (float)(mean / 2048);
}
