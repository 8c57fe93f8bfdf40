/* closure.c: evaluation and sampling of a closure's smooth part. Everything here runs once or more per path vertex:
   floats only, no allocation, no trigonometry outside the warps. */
#include "bsdf_micro.h"

/* One rough reflection: h = wo + wi, D, and the density D G1(wo) / (4 wo.z) of sampling visible normals, from which
   f = F G1(wi) / wi.z * density (Torrance & Sparrow 1967; Heitz 2014). */
typedef struct reflection {
    float cos_h, density, f; /* cos_h = wo.h; f without Fresnel */
} reflection;

static inline reflection reflect_rough(const tr_closure *c, vec3 wi)
{
    reflection r;
    vec3 h = add3(c->wo, wi);
    float h2 = dot3(h, h);
    r.cos_h = tr_min(1, 0.5f * sqrtf(h2)); /* |wo + wi| = 2 cos of the half angle */
    r.density = 0.25f * c->scratch[0] * tr_micro_d(c->distribution, c->alpha, h, h2);
    r.f = r.density * tr_micro_g(c->distribution, c->alpha, wi.z);
    return r;
}

static inline vec3 eval_roughconductor(const tr_closure *c, vec3 wi, float *pdf)
{
    reflection r = reflect_rough(c, wi);
    *pdf = r.density;
    return scale3(mul3(c->specular, tr_fresnel_conductor(r.cos_h, c->eta, c->k)), r.f);
}

static inline vec3 eval_plastic(const tr_closure *c, vec3 wi, float *pdf)
{
    float cos_t, f = tr_fresnel_dielectric(wi.z, c->ior, &cos_t);
    *pdf = wi.z * TR_INV_PI;
    return scale3(c->diffuse, (1 - f) * TR_INV_PI);
}

static inline vec3 eval_roughplastic(const tr_closure *c, vec3 wi, float *pdf)
{
    reflection r = reflect_rough(c, wi);
    float cos_t, f = tr_fresnel_dielectric(r.cos_h, c->ior, &cos_t), p = c->specular_probability;
    float t = tr_transmittance_at(c->bsdf->transmittance, tr_min(1, wi.z));
    *pdf = lerpf(wi.z * TR_INV_PI, r.density, p);
    return madd3(scale3(c->specular, f * r.f), c->diffuse, t * TR_INV_PI);
}

/* Phong 1975 as Lafortune & Willems 1994 normalise it: (n + 2) / (2 pi) cos^n around the mirrored wo. */
static inline vec3 eval_phong(const tr_closure *c, vec3 wi, float *pdf)
{
    float n = c->exponent, p = c->specular_probability;
    float cosine = wi.z * c->wo.z - wi.x * c->wo.x - wi.y * c->wo.y;
    float lobe = p > 0 && cosine > 0 ? powf(tr_min(1, cosine), n) * 0.5f * TR_INV_PI : 0;
    *pdf = (1 - p) * wi.z * TR_INV_PI + p * (n + 1) * lobe;
    return madd3(scale3(c->diffuse, TR_INV_PI), c->specular, (n + 2) * lobe);
}

/* See prepare_pbr. */
static inline vec3 eval_pbr(const tr_closure *c, vec3 wi, float *pdf)
{
    reflection r = reflect_rough(c, wi);
    float s = tr_schlick(r.cos_h);
    vec3 fresnel = madd3(scale3(c->specular, 1 - s), c->transmitted, s);
    *pdf = lerpf(wi.z * TR_INV_PI, r.density, c->specular_probability);
    return madd3(scale3(fresnel, r.f), c->diffuse, 0.96f * (1 - tr_schlick(wi.z)) * TR_INV_PI);
}

/* Share of samples that reflect at a microfacet with Fresnel term f: f itself where both colours are white. */
static inline float reflect_share(const tr_closure *c, float f)
{
    float r = f * c->scratch[1], t = (1 - f) * c->scratch[2];
    return r + t > 0 ? r / (r + t) : 1;
}

/* Walter et al. 2007, eqs. 16-21, for radiance that arrives along wi and leaves along wo; eta = c->ior is the index of
   wi's side over wo's when they differ. h = -(wo + eta wi), turned to wo's side:
     f   = (1 - F) D G1(wo) G1(wi) |wo.h| |wi.h| / (wo.z |wi.z| (wo.h + eta wi.h)^2)
     pdf = D G1(wo) |wo.h| / wo.z * eta^2 |wi.h| / (wo.h + eta wi.h)^2 * P(refract) */
static vec3 eval_roughdielectric(const tr_closure *c, vec3 wi, float *pdf)
{
    *pdf = 0;
    if (wi.z > 0) {
        reflection r = reflect_rough(c, wi);
        float cos_t, f = tr_fresnel_dielectric(r.cos_h, c->ior, &cos_t);
        *pdf = r.density * reflect_share(c, f);
        return scale3(c->specular, f * r.f);
    }
    float eta = c->ior;
    vec3 h = v3(-(c->wo.x + eta * wi.x), -(c->wo.y + eta * wi.y), -(c->wo.z + eta * wi.z));
    float h2 = dot3(h, h);
    if (!(h2 > 0))
        return v3s(0);
    h = scale3(h, (h.z < 0 ? -1.0f : 1.0f) / sqrtf(h2));
    float o = dot3(c->wo, h), i = -dot3(wi, h);
    if (!(h.z > 0 && o > 0 && i > 0)) /* back-facing microfacets refract nothing */
        return v3s(0);
    /* o and i are each other's refraction; from o alone i would lose its digits near total reflection */
    float f = tr_fresnel_cosines(o, i, eta), denominator = sqrf(o - eta * i);
    if (!(f < 1 && denominator > 0))
        return v3s(0);
    float common = tr_micro_d(c->distribution, c->alpha, h, dot3(h, h)) * c->scratch[0] * o * i / denominator;
    *pdf = common * eta * eta * (1 - reflect_share(c, f));
    return scale3(c->transmitted, (1 - f) * common * tr_micro_g(c->distribution, c->alpha, -wi.z));
}

static vec3 eval_local(const tr_closure *c, vec3 wi, float *pdf)
{
    *pdf = 0;
    if (c->transmits ? wi.z == 0 : !(wi.z > 0))
        return v3s(0);
    switch (c->type) {
    case TR_BSDF_DIFFUSE:
        *pdf = wi.z * TR_INV_PI;
        return scale3(c->diffuse, TR_INV_PI);
    case TR_BSDF_ROUGHCONDUCTOR:
        return eval_roughconductor(c, wi, pdf);
    case TR_BSDF_ROUGHDIELECTRIC:
        return eval_roughdielectric(c, wi, pdf);
    case TR_BSDF_PLASTIC:
        return eval_plastic(c, wi, pdf);
    case TR_BSDF_ROUGHPLASTIC:
        return eval_roughplastic(c, wi, pdf);
    case TR_BSDF_PHONG:
        return eval_phong(c, wi, pdf);
    case TR_BSDF_PBR:
        return eval_pbr(c, wi, pdf);
    default:
        return v3s(0);
    }
}

/* Bump maps can tilt a direction through the real surface: blocked, as in Mitsuba. */
static inline bool blocked(const tr_closure *c, vec3 wi, float local_z)
{
    return c->bumped && dot3(c->base_n, wi) * local_z <= 0;
}

/* Any type but the diffuse one. */
static TR_NOINLINE vec3 eval_lobes(const tr_closure *c, vec3 wi, float *pdf)
{
    vec3 local = to_local(&c->frame, wi), f = eval_local(c, local, pdf);
    return blocked(c, wi, local.z) ? v3s(0) : f;
}

vec3 tr_closure_eval(const tr_closure *closure, vec3 wi, float *pdf)
{
    float unused;
    if (!pdf)
        pdf = &unused;
    *pdf = 0;
    if (closure->delta_probability >= 1)
        return v3s(0);
    if (closure->type != TR_BSDF_DIFFUSE)
        return eval_lobes(closure, wi, pdf);
    float z = dot3(closure->frame.n, wi); /* most vertices need no more than the cosine */
    if (!(z > 0))
        return v3s(0);
    *pdf = z * TR_INV_PI;
    return blocked(closure, wi, z) ? v3s(0) : scale3(closure->diffuse, TR_INV_PI);
}

/* Around the mirrored wo with density (n + 1) / (2 pi) cos^n. */
static vec3 sample_phong(const tr_closure *c, float u1, float u2)
{
    vec3 mirror = v3(-c->wo.x, -c->wo.y, c->wo.z);
    float z = powf(1 - u1, 1 / (c->exponent + 1)), r = sqrtf(tr_max(0, 1 - z * z)), sine, cosine;
    sincos_turn(u2, &sine, &cosine);
    frame3 f = frame_from_normal(mirror);
    return to_world(&f, v3(r * cosine, r * sine, z));
}

/* Reflect or refract wo at microfacet m. Single scattering only: false where that leads through the macrosurface. */
static bool sample_roughdielectric(const tr_closure *c, vec3 m, float u_lobe, vec3 *wi)
{
    float o = dot3(c->wo, m), cos_t, f = tr_fresnel_dielectric(o < 1 ? o : 1, c->ior, &cos_t);
    if (!(o > 0))
        return false;
    if (u_lobe < reflect_share(c, f)) {
        *wi = sub3(scale3(m, 2 * o), c->wo);
        return wi->z > 0;
    }
    *wi = scale3(sub3(scale3(m, o - c->ior * cos_t), c->wo), 1 / c->ior);
    return wi->z < 0;
}

/* A local direction from the smooth part, where it is not the diffuse type. */
static inline bool sample_local(const tr_closure *c, float u_lobe, float u1, float u2, vec3 *wi)
{
    vec3 local, m;
    switch (c->type) {
    case TR_BSDF_ROUGHCONDUCTOR:
    case TR_BSDF_ROUGHPLASTIC:
    case TR_BSDF_PBR:
        if (u_lobe < c->specular_probability) {
            m = tr_micro_sample(c->distribution, c->alpha, c->wo, u1, u2);
            local = sub3(scale3(m, 2 * dot3(c->wo, m)), c->wo);
        } else {
            local = sample_cosine_hemisphere(u1, u2);
        }
        break;
    case TR_BSDF_ROUGHDIELECTRIC:
        m = tr_micro_sample(c->distribution, c->alpha, c->wo, u1, u2);
        if (!sample_roughdielectric(c, m, u_lobe, &local))
            return false;
        break;
    case TR_BSDF_PHONG:
        local = u_lobe < c->specular_probability ? sample_phong(c, u1, u2) : sample_cosine_hemisphere(u1, u2);
        break;
    case TR_BSDF_PLASTIC:
        local = sample_cosine_hemisphere(u1, u2);
        break;
    default:
        return false;
    }
    *wi = local;
    return true;
}

/* Any type but the diffuse one. */
static TR_NOINLINE bool sample_lobes(const tr_closure *c, float u_lobe, float u1, float u2, vec3 *wi, vec3 *f,
                                     float *pdf)
{
    vec3 local;
    if (!sample_local(c, u_lobe, u1, u2, &local))
        return false;
    *wi = to_world(&c->frame, local);
    *f = eval_local(c, local, pdf);
    if (blocked(c, *wi, local.z))
        *f = v3s(0);
    return *pdf > 0;
}

bool tr_closure_sample(const tr_closure *closure, float u_lobe, float u1, float u2, vec3 *wi, vec3 *f, float *pdf)
{
    const tr_closure *c = closure;
    if (c->delta_probability >= 1)
        return false;
    if (c->type != TR_BSDF_DIFFUSE)
        return sample_lobes(c, u_lobe, u1, u2, wi, f, pdf);
    vec3 local = sample_cosine_hemisphere(u1, u2); /* most vertices */
    *wi = to_world(&c->frame, local);
    *f = blocked(c, *wi, local.z) ? v3s(0) : scale3(c->diffuse, TR_INV_PI);
    *pdf = local.z * TR_INV_PI;
    return local.z > 0;
}

/* The closure that a camera path has which comes along `to`. A bump map makes it another one than that for `from` where
   the bumped and the real surface disagree on the side of a direction. */
static TR_NOINLINE bool prepare_way_back(const tr_scene *scene, const tr_surface *s, const tr_closure *c, vec3 to,
                                         bool delta, tr_closure *back)
{
    if (!tr_closure_prepare(scene, s, to, back))
        return false;
    /* Mirrors and glass: the same normal, or it leads elsewhere. */
    float turned = dot3(back->frame.n, c->frame.n), crosses = dot3(c->frame.n, to);
    return !delta || (fabsf(turned) > 0.9999f && turned * crosses > 0);
}

/* f on the way back times both cosines, over the density of `to`. eval_local has from and to the other way round, which
   differs by the square of the index where light refracts (Veach 1997, 5.2). */
static bool sample_adjoint_smooth(const tr_scene *scene, const tr_surface *s, const tr_closure *c, const float u[4],
                                  vec3 from, vec3 *to, vec3 *weight)
{
    vec3 local;
    float pdf, cosine = c->wo.z;
    if (c->type == TR_BSDF_DIFFUSE)
        local = sample_cosine_hemisphere(u[2], u[3]);
    else if (!sample_local(c, u[1], u[2], u[3], &local))
        return false;
    vec3 f = eval_local(c, local, &pdf);
    *to = to_world(&c->frame, local);
    if (local.z < 0)
        f = scale3(f, c->ior * c->ior);
    if (c->bumped) {
        tr_closure back;
        if (!prepare_way_back(scene, s, c, *to, false, &back))
            return false;
        f = tr_closure_eval(&back, from, NULL);
        cosine = dot3(back.frame.n, from);
    }
    *weight = scale3(f, fabsf(cosine * dot3(s->ng, *to)) / ((1 - c->delta_probability) * pdf));
    return pdf > 0;
}

static bool sample_adjoint_delta(const tr_scene *scene, const tr_surface *s, const tr_closure *c, float u, vec3 from,
                                 vec3 *to, vec3 *weight)
{
    float eta_scale = 1, scale;
    bool gap;
    if (!tr_closure_draw_delta(c, u, to, weight, &eta_scale, &gap))
        return false;
    if (gap) { /* no surface is there */
        scale = fabsf(dot3(s->ng, from));
    } else {
        scale = eta_scale * fabsf(c->wo.z * dot3(s->ng, *to) / dot3(c->frame.n, *to));
        tr_closure back;
        if (c->bumped &&
            (!prepare_way_back(scene, s, c, *to, true, &back) || blocked(&back, from, dot3(back.frame.n, from))))
            return false;
    }
    *weight = scale3(*weight, scale / c->delta_probability);
    return true;
}

bool tr_closure_sample_adjoint(const tr_scene *scene, const tr_surface *surface, const tr_closure *closure,
                               const float u[4], vec3 *to, vec3 *weight, bool *delta)
{
    const tr_closure *c = closure;
    vec3 from = to_world(&c->frame, c->wo);
    *delta = u[0] < c->delta_probability;
    bool drawn = *delta ? sample_adjoint_delta(scene, surface, c, u[1], from, to, weight)
                        : c->delta_probability < 1 && sample_adjoint_smooth(scene, surface, c, u, from, to, weight);
    if (!drawn)
        return false;
    *weight = scale3(*weight, 1 / fabsf(dot3(surface->ng, from)));
    return !black3(*weight);
}
