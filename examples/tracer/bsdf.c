/* bsdf.c: defaults, preparation and checks of bsdfs; resolving nested bsdfs and textures into a closure; sampling its
   delta part. Evaluation and sampling of the smooth part are in closure.c. */
#include <stdlib.h>
#include <string.h>

#include "bsdf_micro.h"

#define NESTING_MAX 16

static tr_param constant(float value)
{
    tr_param p = {v3s(value), -1};
    return p;
}

/* Values are Mitsuba's: polypropylene plastic, BK7 glass, air at 1.000277, copper (its n and k of Johnson & Christy
   1972 at the wavelengths of the sRGB primaries, rounded), Beckmann with alpha 0.1. PBR follows glTF 2.0. */
void tr_bsdf_defaults(tr_bsdf *bsdf, tr_bsdf_type type)
{
    const float air = 1.000277f;
    memset(bsdf, 0, sizeof *bsdf);
    bsdf->type = type;
    bsdf->reflectance = constant(type == TR_BSDF_PBR ? 1.0f : 0.5f);
    bsdf->specular_reflectance = constant(type == TR_BSDF_PHONG ? 0.2f : 1.0f);
    bsdf->specular_transmittance = constant(1);
    bsdf->alpha = constant(type == TR_BSDF_PBR ? 1.0f : 0.1f);
    bsdf->metallic = constant(1);
    bsdf->exponent = constant(30);
    bsdf->opacity = constant(0.5f);
    bsdf->eta = scale3(v3(0.20f, 0.92f, 1.10f), 1 / air);
    bsdf->k = scale3(v3(3.91f, 2.45f, 2.14f), 1 / air);
    bsdf->ior = (type == TR_BSDF_PLASTIC || type == TR_BSDF_ROUGHPLASTIC ? 1.49f : 1.5046f) / air;
    bsdf->distribution = TR_BECKMANN;
    bsdf->child[0] = bsdf->child[1] = -1;
    bsdf->bump_texture = -1;
    bsdf->bump_scale = 1;
}

/* ---- finish --------------------------------------------------------------------------------------------------- */

static bool nests(tr_bsdf_type type)
{
    return type == TR_BSDF_TWOSIDED || type == TR_BSDF_MASK || type == TR_BSDF_BUMPMAP;
}

/* Longest chain of nested bsdfs below id; more than NESTING_MAX also for cycles. */
static int nesting(const tr_scene *scene, int id, int depth)
{
    if (depth > NESTING_MAX || id < 0 || id >= scene->bsdf_count || !nests(scene->bsdfs[id].type))
        return depth;
    int a = nesting(scene, scene->bsdfs[id].child[0], depth + 1);
    int b = a > NESTING_MAX || scene->bsdfs[id].child[1] < 0 ? a : nesting(scene, scene->bsdfs[id].child[1], depth + 1);
    return a > b ? a : b;
}

/* Any bump map among bsdf and what nests in it, which is known to end. */
static bool has_bumps(const tr_scene *scene, const tr_bsdf *bsdf)
{
    if (!nests(bsdf->type))
        return false;
    if (bsdf->type == TR_BSDF_BUMPMAP && bsdf->bump_texture >= 0)
        return true;
    return has_bumps(scene, &scene->bsdfs[bsdf->child[0]]) ||
           (bsdf->child[1] >= 0 && has_bumps(scene, &scene->bsdfs[bsdf->child[1]]));
}

static bool check_texture(const tr_scene *scene, const tr_bsdf *bsdf, int texture, tr_log *log)
{
    if (texture >= -1 && texture < scene->texture_count)
        return true;
    tr_message(log, TR_ERROR, scene->path, bsdf->line, "bsdf refers to texture %d of %d", texture,
               scene->texture_count);
    return false;
}

/* Replace a constant that is not a number, or below lo, with a warning. */
static void check_number(const tr_scene *scene, const tr_bsdf *bsdf, float *value, float lo, float fallback,
                         const char *name, tr_log *log)
{
    if (isfinite(*value) && *value >= lo)
        return;
    tr_message(log, TR_WARNING, scene->path, bsdf->line, "%s %g is out of range, using %g", name, (double)*value,
               (double)fallback);
    *value = fallback;
}

/* Colours are clamped where they are read; here the author is told. */
static void check_color(const tr_scene *scene, const tr_bsdf *bsdf, const tr_param *p, const char *name, tr_log *log)
{
    vec3 c = p->value;
    if (p->texture < 0 && !(fminf(c.x, fminf(c.y, c.z)) >= 0 && max3(c) <= 1 && finite3(c)))
        tr_message(log, TR_WARNING, scene->path, bsdf->line,
                   "%s (%g, %g, %g) is outside 0 .. 1 and is scaled down to conserve energy", name, (double)c.x,
                   (double)c.y, (double)c.z);
}

static float mean_of_param(const tr_scene *scene, const tr_param *p)
{
    if (p->texture < 0)
        return p->value.x;
    const tr_texture *t = &scene->textures[p->texture];
    if (t->type == TR_TEXTURE_CHECKERBOARD)
        return 0.5f * (mean3(t->color0) + mean3(t->color1));
    size_t n = (size_t)t->image.width * (size_t)t->image.height * (size_t)t->image.channels;
    double sum = 0;
    for (size_t i = 0; t->image.data && i < n; i++)
        sum += (double)t->image.data[i];
    return n && t->image.data && isfinite(sum) ? (float)(sum / (double)n) : 0;
}

static float clamp_alpha(float alpha) { return alpha > TR_ALPHA_MIN ? tr_min(10, alpha) : TR_ALPHA_MIN; }

/* The transmittance table of a rough plastic: copied from an earlier bsdf with the same interface where there is one,
   since scenes repeat a few roughnesses. The mean of a textured alpha stands for all of it. */
static bool make_transmittance(const tr_scene *scene, tr_bsdf *bsdf, tr_log *log)
{
    free(bsdf->transmittance);
    bsdf->transmittance = malloc(TR_TRANSMITTANCE_SIZE * sizeof *bsdf->transmittance);
    if (!bsdf->transmittance) {
        tr_message(log, TR_ERROR, scene->path, bsdf->line, "out of memory");
        return false;
    }
    float alpha = clamp_alpha(mean_of_param(scene, &bsdf->alpha));
    for (const tr_bsdf *b = scene->bsdfs; b < bsdf && b < scene->bsdfs + scene->bsdf_count; b++) {
        if (b->type == TR_BSDF_ROUGHPLASTIC && b->transmittance && b->alpha.texture < 0 && b->ior == bsdf->ior &&
            b->distribution == bsdf->distribution && clamp_alpha(b->alpha.value.x) == alpha) {
            memcpy(bsdf->transmittance, b->transmittance, TR_TRANSMITTANCE_SIZE * sizeof *bsdf->transmittance);
            bsdf->transmittance_internal = b->transmittance_internal;
            return true;
        }
    }
    float mean = tr_rough_transmittance((int)bsdf->distribution, alpha, bsdf->ior, bsdf->transmittance);
    /* The BTDF is reciprocal up to eta^2, so crossing outwards needs no second integral. */
    bsdf->transmittance_internal = mean / (bsdf->ior * bsdf->ior);
    return true;
}

bool tr_bsdf_finish(tr_scene *scene, tr_bsdf *bsdf, tr_log *log)
{
    const tr_param *params[] = {&bsdf->reflectance,
                                &bsdf->specular_reflectance,
                                &bsdf->specular_transmittance,
                                &bsdf->alpha,
                                &bsdf->metallic,
                                &bsdf->exponent,
                                &bsdf->opacity};
    for (size_t i = 0; i < sizeof params / sizeof *params; i++)
        if (!check_texture(scene, bsdf, params[i]->texture, log))
            return false;
    if (!check_texture(scene, bsdf, bsdf->bump_texture, log))
        return false;
    check_color(scene, bsdf, &bsdf->reflectance, "reflectance", log);
    check_color(scene, bsdf, &bsdf->specular_reflectance, "specular reflectance", log);
    check_color(scene, bsdf, &bsdf->specular_transmittance, "specular transmittance", log);
    check_number(scene, bsdf, &bsdf->ior, 1e-3f, 1.5f, "index of refraction", log);
    check_number(scene, bsdf, &bsdf->alpha.value.x, 0, 0.1f, "roughness", log);
    check_number(scene, bsdf, &bsdf->exponent.value.x, 0, 30, "exponent", log);
    check_number(scene, bsdf, &bsdf->metallic.value.x, 0, 0, "metallic", log);
    check_number(scene, bsdf, &bsdf->opacity.value.x, 0, 1, "opacity", log);
    check_number(scene, bsdf, &bsdf->bump_scale, -INFINITY, 1, "bump scale", log);
    if (!finite3(bsdf->eta) || !finite3(bsdf->k)) {
        tr_message(log, TR_WARNING, scene->path, bsdf->line, "complex index is not a number, using a perfect mirror");
        bsdf->eta = v3s(0);
        bsdf->k = v3s(1);
    }
    if (nests(bsdf->type)) {
        int a = bsdf->child[0], b = bsdf->child[1];
        if (a < 0 || a >= scene->bsdf_count || b < -1 || b >= scene->bsdf_count ||
            nesting(scene, (int)(bsdf - scene->bsdfs), 0) > NESTING_MAX) {
            tr_message(log, TR_ERROR, scene->path, bsdf->line,
                       "bsdf has no valid nested bsdf, or they nest in a cycle or deeper than %d", NESTING_MAX);
            return false;
        }
    }
    bsdf->bumped = has_bumps(scene, bsdf);
    const tr_bsdf *leaf = bsdf;
    while (nests(leaf->type))
        leaf = &scene->bsdfs[leaf->child[0]];
    bsdf->first_texture = leaf->reflectance.texture;
    if (bsdf->type == TR_BSDF_PLASTIC)
        bsdf->fdr_internal = tr_fresnel_diffuse(1 / bsdf->ior);
    return bsdf->type != TR_BSDF_ROUGHPLASTIC || make_transmittance(scene, bsdf, log);
}

/* ---- prepare -------------------------------------------------------------------------------------------------- */

/* A colour within 0 .. 1, scaled down where it would make energy (Mitsuba scales whole textures by their maximum). */
static inline vec3 limit_color(vec3 c)
{
    if (c.x > 1 || c.y > 1 || c.z > 1) {
        float m = max3(c);
        c = m < INFINITY ? scale3(c, 1 / m) : v3s(0);
    }
    return v3(c.x > 0 ? c.x : 0, c.y > 0 ? c.y : 0, c.z > 0 ? c.z : 0); /* NaN reads as 0 */
}
static inline vec3 color_of(const tr_scene *scene, const tr_param *p, const tr_surface *s)
{
    return limit_color(p->texture < 0 ? p->value : tr_texture_eval(&scene->textures[p->texture], s->u, s->v));
}
static inline float number_of(const tr_scene *scene, const tr_param *p, const tr_surface *s)
{
    return p->texture < 0 ? p->value.x : mean3(tr_texture_eval(&scene->textures[p->texture], s->u, s->v));
}
static inline float unit_of(const tr_scene *scene, const tr_param *p, const tr_surface *s)
{
    float x = number_of(scene, p, s);
    return x > 0 ? tr_min(1, x) : 0;
}

/* The normal of the surface displaced along n by the bump texture (Blinn 1978): with the tangents made perpendicular
   to n, n' = (dpdu + n db/du) x (dpdv + n db/dv), on n's side. n where the tangents are degenerate. */
static TR_NOINLINE vec3 bump_normal(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, vec3 n)
{
    if (b->bump_texture < 0)
        return n;
    float du, dv;
    tr_texture_gradient(&scene->textures[b->bump_texture], s->u, s->v, &du, &dv);
    vec3 tu = madd3(s->dpdu, n, b->bump_scale * du - dot3(n, s->dpdu));
    vec3 tv = madd3(s->dpdv, n, b->bump_scale * dv - dot3(n, s->dpdv));
    vec3 m = cross3(tu, tv);
    float l2 = dot3(m, m), side = dot3(m, n);
    if (!(l2 > 0) || !isfinite(l2) || side == 0)
        return n;
    return scale3(m, (side > 0 ? 1.0f : -1.0f) / sqrtf(l2));
}

/* Share given to the first of two strategies, a : b; 1 where b is 0. */
static inline float share(float a, float b) { return b > 0 ? a / (a + b) : 1; }

static inline bool prepare_diffuse(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, tr_closure *c)
{
    c->diffuse = color_of(scene, &b->reflectance, s);
    c->roughness = 1;
    return c->wo.z > 0 && !black3(c->diffuse);
}

static bool prepare_conductor(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, tr_closure *c)
{
    if (!(c->wo.z > 0))
        return false;
    c->specular = color_of(scene, &b->specular_reflectance, s);
    c->eta = b->eta;
    c->k = b->k;
    if (b->type == TR_BSDF_CONDUCTOR) {
        c->delta_probability = 1;
    } else {
        c->roughness = c->alpha = clamp_alpha(number_of(scene, &b->alpha, s));
        c->specular_probability = 1;
        c->scratch[0] = tr_micro_g(c->distribution, c->alpha, c->wo.z);
    }
    return !black3(c->specular);
}

/* Dielectrics turn their frame to wo; c->ior becomes the index of the far side over that of wo's side. A rough one
   whose refracted lobe is narrower than floats resolve (index matched) becomes a smooth one. */
static bool prepare_dielectric(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, bool turned, tr_closure *c)
{
    if (c->wo.z == 0)
        return false;
    if (c->wo.z < 0) {
        c->frame.n = neg3(c->frame.n);
        c->base_n = neg3(c->base_n);
        c->wo.z = -c->wo.z;
        turned = !turned;
    }
    c->ior = turned && b->type != TR_BSDF_THINDIELECTRIC ? 1 / b->ior : b->ior;
    c->specular = color_of(scene, &b->specular_reflectance, s);
    c->transmitted = color_of(scene, &b->specular_transmittance, s);
    c->scratch[1] = mean3(c->specular);
    c->scratch[2] = mean3(c->transmitted);
    if (b->type == TR_BSDF_ROUGHDIELECTRIC) {
        c->alpha = clamp_alpha(number_of(scene, &b->alpha, s));
        if (c->alpha * fabsf(c->ior - 1) < 2e-5f) {
            c->type = TR_BSDF_DIELECTRIC;
        } else {
            c->transmits = 1;
            c->roughness = c->alpha;
            c->specular_probability = 1;
            c->scratch[0] = tr_micro_g(c->distribution, c->alpha, c->wo.z);
            return c->scratch[1] + c->scratch[2] > 0;
        }
    }
    float cos_t, f = tr_fresnel_dielectric(c->wo.z, c->ior, &cos_t);
    if (b->type == TR_BSDF_THINDIELECTRIC)
        f = 2 * f / (1 + f); /* both faces: R + T R T + T R R R T + ... */
    c->fresnel = f;
    c->scratch[0] = cos_t;
    c->delta_probability = 1;
    /* probability of reflecting: F where both colours are white */
    float r = f * c->scratch[1], t = (1 - f) * c->scratch[2];
    c->specular_probability = share(r, t);
    return r + t > 0;
}

/* Diffuse base under a dielectric coat: the light that enters, scatters and leaves, with all orders of internal
   reflection summed; (1 - F(wi)) is left to eval. `enters` is 1 - F(wo) or its rough counterpart. */
static inline vec3 coated_diffuse(vec3 rho, float internal, bool nonlinear, float enters, float ior)
{
    float scale = enters / (ior * ior);
    if (!nonlinear)
        return scale3(rho, scale / (1 - internal));
    return v3(rho.x * scale / (1 - rho.x * internal), rho.y * scale / (1 - rho.y * internal),
              rho.z * scale / (1 - rho.z * internal));
}

static bool prepare_plastic(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, tr_closure *c)
{
    if (!(c->wo.z > 0))
        return false;
    vec3 rho = color_of(scene, &b->reflectance, s);
    c->specular = color_of(scene, &b->specular_reflectance, s);
    c->ior = b->ior;
    float f, cos_t, internal;
    if (b->type == TR_BSDF_PLASTIC) {
        f = tr_fresnel_dielectric(c->wo.z, c->ior, &cos_t);
        internal = b->fdr_internal;
        c->fresnel = f;
    } else {
        c->alpha = clamp_alpha(number_of(scene, &b->alpha, s));
        f = 1 - tr_transmittance_at(b->transmittance, c->wo.z);
        internal = 1 - b->transmittance_internal;
        c->scratch[0] = tr_micro_g(c->distribution, c->alpha, c->wo.z);
    }
    c->diffuse = coated_diffuse(rho, internal, b->nonlinear, 1 - f, c->ior);
    float p = share(f * mean3(c->specular), (1 - f) * mean3(rho));
    if (b->type == TR_BSDF_PLASTIC) {
        c->delta_probability = p;
        c->roughness = 1;
    } else {
        c->specular_probability = p;
        c->roughness = tr_min(1, lerpf(1, c->alpha, p));
    }
    return !black3(c->diffuse) || !black3(c->specular);
}

static bool prepare_phong(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, tr_closure *c)
{
    if (!(c->wo.z > 0))
        return false;
    c->diffuse = color_of(scene, &b->reflectance, s);
    c->specular = color_of(scene, &b->specular_reflectance, s);
    float sum = max3(add3(c->diffuse, c->specular)), n = number_of(scene, &b->exponent, s);
    if (sum > 1) {
        c->diffuse = scale3(c->diffuse, 1 / sum);
        c->specular = scale3(c->specular, 1 / sum);
    }
    c->exponent = n > 0 ? tr_min(1e6f, n) : 0;
    c->specular_probability = share(mean3(c->specular), mean3(c->diffuse));
    c->roughness = tr_min(1, lerpf(1, sqrtf(2 / (c->exponent + 2)), c->specular_probability));
    return sum > 0;
}

/* glTF 2.0, appendix B: a mix by `metallic` of a metal and of a diffuse base under a layer with F0 = 0.04. Schlick's
   Fresnel is linear in F0, so the mix of both specular lobes is one lobe with the mixed F0. The layer takes
   (1 - F(wo)) (1 - F(wi)) / (1 - Favg) from the base, Favg = 0.04 + 0.96 / 21, where the specification's simple form
   takes 1 - F(wo.h), which reflects more than arrives at grazing angles. */
static bool prepare_pbr(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, tr_closure *c)
{
    if (!(c->wo.z > 0))
        return false;
    vec3 base = color_of(scene, &b->reflectance, s);
    float metallic = unit_of(scene, &b->metallic, s), rough = unit_of(scene, &b->alpha, s);
    float schlick = tr_schlick(c->wo.z);
    c->distribution = TR_GGX;
    c->alpha = clamp_alpha(rough * rough);
    c->specular = add3(v3s(0.04f * (1 - metallic)), scale3(base, metallic));
    c->diffuse = scale3(base, (1 - metallic) * 0.96f * (1 - schlick) / (0.96f * 20 / 21));
    c->transmitted = v3s(1); /* F90, so that mask can scale it */
    c->specular_probability =
        share(lerpf(mean3(c->specular), 1, schlick), (1 - metallic) * mean3(base) * 0.96f * (1 - schlick));
    c->roughness = tr_min(1, lerpf(1, c->alpha, c->specular_probability));
    c->scratch[0] = tr_micro_g(TR_GGX, c->alpha, c->wo.z);
    return true;
}

static TR_NOINLINE bool prepare_leaf(const tr_scene *scene, const tr_bsdf *b, const tr_surface *s, bool turned,
                                     tr_closure *c)
{
    switch (b->type) {
    case TR_BSDF_DIFFUSE:
        return prepare_diffuse(scene, b, s, c);
    case TR_BSDF_CONDUCTOR:
    case TR_BSDF_ROUGHCONDUCTOR:
        return prepare_conductor(scene, b, s, c);
    case TR_BSDF_DIELECTRIC:
    case TR_BSDF_ROUGHDIELECTRIC:
    case TR_BSDF_THINDIELECTRIC:
        return prepare_dielectric(scene, b, s, turned, c);
    case TR_BSDF_PLASTIC:
    case TR_BSDF_ROUGHPLASTIC:
        return prepare_plastic(scene, b, s, c);
    case TR_BSDF_PHONG:
        return prepare_phong(scene, b, s, c);
    case TR_BSDF_PBR:
        return prepare_pbr(scene, b, s, c);
    default:
        return false;
    }
}

/* Put a mask's gap around a closure: f is scaled by opacity, and the delta part gains the way straight through, taken
   with probability 1 - opacity overall. Only the gap is left where the child scatters nothing. */
static TR_NOINLINE bool apply_mask(tr_closure *c, float opacity, bool scatters)
{
    if (!scatters) {
        c->diffuse = c->specular = c->transmitted = v3s(0);
        c->type = TR_BSDF_DIFFUSE;
        c->delta_probability = 0;
    }
    float child = c->delta_probability;
    c->opacity = opacity;
    c->diffuse = scale3(c->diffuse, opacity);
    c->specular = scale3(c->specular, opacity);
    c->transmitted = scale3(c->transmitted, opacity);
    c->delta_probability = scatters && opacity > 0 ? 1 - opacity * (1 - child) : 1;
    c->gap_probability = child > 0 ? (1 - opacity) / c->delta_probability : 1;
    return true;
}

void tr_closure_prefetch(const tr_scene *scene, const tr_surface *surface)
{
    int id = scene->shapes[surface->shape].bsdf, texture = id < 0 ? -1 : scene->bsdfs[id].first_texture;
    if (texture >= 0)
        tr_texture_prefetch(&scene->textures[texture], surface->u, surface->v);
}

/* What the bsdfs nested around a leaf do to it. */
typedef struct nested {
    vec3 n, base_n; /* turned; with and without the bump map */
    float opacity;
    bool turned, bumped;
} nested;

/* The leaf below bsdf b at a surface, NULL = none. */
static const tr_bsdf *resolve(const tr_scene *scene, const tr_bsdf *b, const tr_surface *surface, vec3 wo, nested *out)
{
    for (int depth = 0; depth <= NESTING_MAX && nests(b->type); depth++) {
        int id = b->child[0];
        if (b->type == TR_BSDF_TWOSIDED) {
            if (dot3(out->n, wo) < 0) {
                out->n = neg3(out->n);
                out->base_n = neg3(out->base_n);
                out->turned = !out->turned;
                if (b->child[1] >= 0)
                    id = b->child[1];
            }
        } else if (b->type == TR_BSDF_MASK) {
            out->opacity *= unit_of(scene, &b->opacity, surface);
        } else {
            out->n = bump_normal(scene, b, surface, out->n);
            out->bumped = true;
        }
        if (id < 0)
            return NULL;
        b = &scene->bsdfs[id];
    }
    return b;
}

/* The closure's type and frame. Not memset: most of what is left here its type of closure never reads. */
static inline void start_closure(tr_closure *c, const tr_bsdf *b, vec3 n, vec3 base_n, vec3 wo, bool bumped)
{
    c->type = (uint8_t)b->type;
    c->distribution = (uint8_t)b->distribution;
    c->nonlinear = b->nonlinear;
    c->transmits = 0;
    c->bumped = bumped;
    c->specular = c->transmitted = v3s(0);
    c->specular_probability = c->delta_probability = c->gap_probability = c->roughness = 0;
    c->opacity = 1;
    c->bsdf = b;
    c->frame = frame_from_normal(n);
    c->base_n = base_n;
    c->wo = to_local(&c->frame, wo);
}

/* With any nesting around the leaf. */
static TR_NOINLINE bool prepare_nested(const tr_scene *scene, const tr_bsdf *outer, const tr_surface *s, vec3 wo,
                                       tr_closure *c)
{
    nested around = {s->ns, s->ns, 1, false, false};
    const tr_bsdf *b = resolve(scene, outer, s, wo, &around);
    if (!b)
        return false;
    start_closure(c, b, around.n, around.base_n, wo, around.bumped);
    c->diffuse = v3s(0);
    bool scatters = around.opacity > 0 && prepare_leaf(scene, b, s, around.turned, c);
    return around.opacity < 1 ? apply_mask(c, around.opacity, scatters) : scatters;
}

bool tr_closure_prepare(const tr_scene *scene, const tr_surface *surface, vec3 wo, tr_closure *closure)
{
    tr_closure *c = closure;
    int id = scene->shapes[surface->shape].bsdf;
    if (id < 0)
        return false;
    const tr_bsdf *outer = &scene->bsdfs[id], *b = outer;
    bool turned = false;
    if (b->type == TR_BSDF_TWOSIDED) {
        turned = dot3(surface->ns, wo) < 0;
        b = &scene->bsdfs[b->child[turned && b->child[1] >= 0]];
    }
    if (nests(b->type))
        return prepare_nested(scene, outer, surface, wo, c);
    vec3 n = scale3(surface->ns, turned ? -1.0f : 1.0f);
    start_closure(c, b, n, n, wo, false);
    if (b->type != TR_BSDF_DIFFUSE) {
        c->diffuse = v3s(0);
        return prepare_leaf(scene, b, surface, turned, c);
    }
    return prepare_diffuse(scene, b, surface, c);
}

/* ---- delta part ----------------------------------------------------------------------------------------------- */

/* wi as the child of a mask chooses it; local. The weight is f cos / probability within the child's delta part. */
static vec3 sample_child_delta(const tr_closure *c, float u, vec3 *weight, float *eta_scale)
{
    vec3 wo = c->wo, mirror = v3(-wo.x, -wo.y, wo.z);
    float p = c->specular_probability;
    switch (c->type) {
    case TR_BSDF_CONDUCTOR:
        *weight = mul3(c->specular, tr_fresnel_conductor(tr_min(1, wo.z), c->eta, c->k));
        return mirror;
    case TR_BSDF_PLASTIC:
        *weight = scale3(c->specular, c->fresnel);
        return mirror;
    case TR_BSDF_DIELECTRIC:
    case TR_BSDF_THINDIELECTRIC:
        if (u < p) {
            *weight = scale3(c->specular, c->fresnel / p);
            return mirror;
        }
        *weight = scale3(c->transmitted, (1 - c->fresnel) / (1 - p));
        if (c->type == TR_BSDF_THINDIELECTRIC)
            return neg3(wo);
        /* Radiance gathers by 1 / eta^2 when it is followed backwards into the denser side (Veach 1997, 5.2). */
        *eta_scale = c->ior * c->ior;
        *weight = scale3(*weight, 1 / *eta_scale);
        return v3(-wo.x / c->ior, -wo.y / c->ior, -c->scratch[0]);
    default:
        *weight = v3s(0);
        return mirror;
    }
}

bool tr_closure_draw_delta(const tr_closure *closure, float u, vec3 *wi, vec3 *weight, float *eta_scale, bool *gap)
{
    const tr_closure *c = closure;
    float share_of_gap = c->gap_probability;
    *eta_scale = 1;
    *gap = u < share_of_gap;
    if (!(c->delta_probability > 0))
        return false;
    if (*gap) {
        *wi = neg3(to_world(&c->frame, c->wo));
        *weight = v3s((1 - c->opacity) / share_of_gap);
        return c->opacity < 1;
    }
    if (share_of_gap > 0)
        u = (u - share_of_gap) / (1 - share_of_gap);
    *wi = norm3(to_world(&c->frame, sample_child_delta(c, u, weight, eta_scale)));
    if (share_of_gap > 0)
        *weight = scale3(*weight, 1 / (1 - share_of_gap));
    return max3(*weight) > 0;
}

bool tr_closure_sample_delta(const tr_closure *closure, float u, vec3 *wi, vec3 *weight, float *eta_scale)
{
    const tr_closure *c = closure;
    bool gap;
    if (!tr_closure_draw_delta(c, u, wi, weight, eta_scale, &gap))
        return false;
    return gap || !c->bumped || dot3(c->base_n, *wi) * dot3(c->frame.n, *wi) > 0;
}

/* ---- albedo --------------------------------------------------------------------------------------------------- */

vec3 tr_closure_albedo(const tr_closure *closure)
{
    const tr_closure *c = closure;
    vec3 gap = v3s(1 - c->opacity);
    float cos_t, f;
    switch (c->type) {
    case TR_BSDF_CONDUCTOR:
    case TR_BSDF_ROUGHCONDUCTOR:
        return add3(gap, mul3(c->specular, tr_fresnel_conductor(tr_min(1, c->wo.z), c->eta, c->k)));
    case TR_BSDF_DIELECTRIC:
    case TR_BSDF_THINDIELECTRIC:
        return add3(gap, madd3(scale3(c->specular, c->fresnel), c->transmitted, 1 - c->fresnel));
    case TR_BSDF_ROUGHDIELECTRIC:
        f = tr_fresnel_dielectric(tr_min(1, c->wo.z), c->ior, &cos_t);
        return add3(gap, madd3(scale3(c->specular, f), c->transmitted, 1 - f));
    case TR_BSDF_PLASTIC: /* 2 int (1 - F) cos = eta^2 (1 - Fdr internal) */
        f = c->ior * c->ior * (1 - c->bsdf->fdr_internal);
        return add3(gap, madd3(scale3(c->specular, c->fresnel), c->diffuse, f));
    case TR_BSDF_ROUGHPLASTIC:
        f = c->ior * c->ior * c->bsdf->transmittance_internal;
        cos_t = tr_transmittance_at(c->bsdf->transmittance, tr_min(1, c->wo.z));
        return add3(gap, madd3(scale3(c->specular, 1 - cos_t), c->diffuse, f));
    case TR_BSDF_PBR:
        f = tr_schlick(c->wo.z);
        return add3(gap, add3(scale3(c->diffuse, 0.96f * 20 / 21),
                              add3(scale3(c->specular, 1 - f), scale3(c->transmitted, f))));
    default:
        return add3(gap, add3(c->diffuse, c->specular));
    }
}
