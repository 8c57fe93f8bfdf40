/* light.c: which light to sample, directions to lights with their densities, emitted and environment radiance.

   contents: >>envmap >>tables >>cone >>area >>queries >>emission

   Light sampling picks a light by estimated power, then a point on it or a direction to it. The environment (envmap,
   constant, sun) is treated as one light with several sampling strategies: a sampled direction carries the radiance of
   all of them and the sum of their densities, which is what a ray that leaves the scene is weighed against (Veach
   1997, multiple importance sampling). */
#include "tracer.h"

#include <stdlib.h>
#include <string.h>

/* Share of the selection probability that is spread evenly, so that a dim light near the camera is not starved by a
   bright one far away. */
#define UNIFORM_SHARE 0.2

/* The i with cdf[i] <= u < cdf[i + 1]; intervals without width are never found. Without branches to mispredict. */
static uint32_t cdf_find(const float *cdf, uint32_t count, float u)
{
    uint32_t lo = 0;
    while (count > 1) {
        uint32_t half = count / 2;
        lo += (cdf[lo + half] <= u) * half;
        count -= half;
    }
    return lo;
}

/* Where u lies within the interval that cdf_find found, in [0, 1). */
static float cdf_rest(const float *cdf, uint32_t i, float u)
{
    float width = cdf[i + 1] - cdf[i];
    return width > 0 ? clampf((u - cdf[i]) / width, 0, 0x1.fffffep-1f) : 0;
}

/* Running sums of count weights, scaled to end at 1; returns the sum. cdf has count + 1 entries. */
static double cdf_build(float *cdf, const double *weight, uint32_t count)
{
    double sum = 0, run = 0;
    uint32_t last = 0;
    for (uint32_t i = 0; i < count; ++i) {
        sum += weight[i];
        if (weight[i] > 0)
            last = i;
    }
    cdf[0] = 0;
    for (uint32_t i = 0; i < count; ++i) {
        run += weight[i];
        cdf[i + 1] = sum > 0 ? (i >= last ? 1.0f : (float)fmin(run / sum, 1)) : 0;
    }
    return sum;
}

/* ---- >>envmap ----------------------------------------------------------------------------------------------- */

/* Direction to picture coordinates in [0, 1]: the left edge is -z, a quarter on is +x, the top is +y, as Mitsuba has
   it. d need not be unit. */
static void envmap_uv(vec3 d, float inverse_length, float *u, float *v)
{
    *u = atan2f(d.x, -d.z) * (0.5f * TR_INV_PI);
    *u = *u < 0 ? *u + 1 : *u;
    *v = acosf(clampf(d.y * inverse_length, -1, 1)) * TR_INV_PI;
}

static vec3 envmap_lookup(const tr_image *image, float u, float v)
{
    int w = image->width, h = image->height;
    float x = u * (float)w - 0.5f, y = clampf(v * (float)h - 0.5f, 0, (float)(h - 1));
    int x0 = (int)floorf(x), y0 = (int)y, y1 = y0 + 1 < h ? y0 + 1 : y0;
    float fx = x - (float)x0, fy = y - (float)y0;
    x0 = x0 < 0 ? x0 + w : x0 >= w ? x0 - w : x0;
    int x1 = x0 + 1 < w ? x0 + 1 : 0;
    const float *a = image->data + ((size_t)y0 * (size_t)w + (size_t)x0) * 3,
                *b = image->data + ((size_t)y0 * (size_t)w + (size_t)x1) * 3,
                *c = image->data + ((size_t)y1 * (size_t)w + (size_t)x0) * 3,
                *d = image->data + ((size_t)y1 * (size_t)w + (size_t)x1) * 3;
    float r[3];
    for (int k = 0; k < 3; ++k)
        r[k] = lerpf(lerpf(a[k], b[k], fx), lerpf(c[k], d[k], fx), fy);
    return v3(r[0], r[1], r[2]);
}

static vec3 envmap_radiance(const tr_light *light, vec3 direction)
{
    vec3 d = xform_vector(&light->to_local, direction);
    float l2 = dot3(d, d), u, v;
    if (!(l2 > 0) || !light->image.data)
        return v3s(0);
    envmap_uv(d, 1.0f / sqrtf(l2), &u, &v);
    return envmap_lookup(&light->image, u, v);
}

/* Within a pixel the density is constant over solid angle: the azimuth and the cosine of the polar angle are uniform.
   So there is no singularity at the poles and the density is the same number for every direction in the pixel. */
static float envmap_local_pdf(const tr_light *light, uint32_t x, uint32_t y)
{
    uint32_t w = (uint32_t)light->image.width, h = (uint32_t)light->image.height;
    const float *row = light->conditional + (size_t)y * (w + 1);
    float p = (light->marginal[y + 1] - light->marginal[y]) * (row[x + 1] - row[x]);
    /* cos a - cos b = 2 sin((a+b)/2) sin((b-a)/2), without the cancellation at the poles */
    float step = TR_PI / (float)h;
    float dcos = 2 * sinf(((float)y + 0.5f) * step) * sinf(0.5f * step);
    return p * (float)w / (2 * TR_PI * dcos);
}

static float envmap_pdf(const tr_light *light, vec3 direction)
{
    vec3 d = xform_vector(&light->to_local, direction);
    float l2 = dot3(d, d), u, v;
    if (!(l2 > 0) || !light->marginal)
        return 0;
    float inverse = 1.0f / sqrtf(l2);
    envmap_uv(d, inverse, &u, &v);
    int w = light->image.width, h = light->image.height, x = (int)(u * (float)w), y = (int)(v * (float)h);
    x = x < 0 ? 0 : x >= w ? w - 1 : x;
    y = y < 0 ? 0 : y >= h ? h - 1 : y;
    /* The change of solid angle under a transform that scales: det(to_local) / |to_local direction|^3; 1 for turns. */
    const float(*m)[4] = light->to_local.m;
    float det = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
                m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    return envmap_local_pdf(light, (uint32_t)x, (uint32_t)y) * fabsf(det) * inverse * inverse * inverse;
}

static TR_NOINLINE vec3 envmap_sample(const tr_light *light, float u1, float u2)
{
    uint32_t w = (uint32_t)light->image.width, h = (uint32_t)light->image.height;
    uint32_t y = cdf_find(light->marginal, h, u2);
    const float *row = light->conditional + (size_t)y * (w + 1);
    uint32_t x = cdf_find(row, w, u1);
    float fx = cdf_rest(row, x, u1), fy = cdf_rest(light->marginal, y, u2);
    float step = TR_PI / (float)h, c0 = cosf((float)y * step), c1 = cosf((float)(y + 1) * step);
    float s0 = sinf(0.5f * (float)y * step), s1 = sinf(0.5f * (float)(y + 1) * step);
    float c = lerpf(c0, c1, fy), t = lerpf(s0 * s0, s1 * s1, fy); /* t = (1 - c) / 2, exact near the upper pole */
    float s = 2 * sqrtf(fmaxf(0, t * (1 - t)));
    float phi = ((float)x + fx) / (float)w * (2 * TR_PI);
    return norm3(xform_vector(&light->to_world, v3(s * sinf(phi), c, -s * cosf(phi))));
}

/* Weight of each pixel: the integral of the bilinear picture over it, which is positive wherever the picture is. */
static bool envmap_build(const char *path, tr_light *light, double *integral, tr_log *log)
{
    tr_image *image = &light->image;
    *integral = 0;
    if (!image->data || image->width < 1 || image->height < 1 || image->channels != 3)
        return true; /* no picture: a black environment */
    uint32_t w = (uint32_t)image->width, h = (uint32_t)image->height;
    size_t count = (size_t)w * h * 3, bad = 0;
    for (size_t i = 0; i < count; ++i)
        if (!(image->data[i] >= 0) || isinf(image->data[i])) {
            image->data[i] = 0;
            ++bad;
        }
    if (bad)
        tr_message(log, TR_WARNING, path, light->line,
                   "%zu values of the environment map are negative or not finite; "
                   "they are taken as 0",
                   bad);
    light->marginal = malloc((h + 1) * sizeof(float));
    light->conditional = malloc((size_t)h * (w + 1) * sizeof(float));
    double *weight = malloc(((size_t)w + h) * sizeof(double));
    if (!light->marginal || !light->conditional || !weight) {
        free(weight);
        return false;
    }
    double *rows = weight + w;
    for (uint32_t y = 0; y < h; ++y) {
        uint32_t around[3] = {y ? y - 1 : 0, y, y + 1 < h ? y + 1 : y};
        static const double tap[3] = {0.125, 0.75, 0.125}; /* the mean of a linear interpolant over a pixel */
        for (uint32_t x = 0; x < w; ++x) {
            uint32_t beside[3] = {x ? x - 1 : w - 1, x, x + 1 < w ? x + 1 : 0};
            weight[x] = 0;
            for (int j = 0; j < 3; ++j)
                for (int i = 0; i < 3; ++i) {
                    const float *p = image->data + ((size_t)around[j] * w + beside[i]) * 3;
                    weight[x] += tap[j] * tap[i] * ((double)p[0] + p[1] + p[2]) / 3;
                }
        }
        double angle = 2.0 * 3.14159265358979323846 / w * 2 * sin((y + 0.5) * 3.14159265358979323846 / h) *
                       sin(0.5 * 3.14159265358979323846 / h);
        rows[y] = cdf_build(light->conditional + (size_t)y * (w + 1), weight, w) * angle;
    }
    *integral = cdf_build(light->marginal, rows, h);
    free(weight);
    return true;
}

/* ---- >>tables ----------------------------------------------------------------------------------------------- */

static bool is_environment(const tr_light *light)
{
    return light->type == TR_LIGHT_ENVMAP || light->type == TR_LIGHT_CONSTANT || light->type == TR_LIGHT_SUN;
}

static double bounds_radius(const tr_scene *scene)
{
    return scene->bounds_radius > 0 && isfinite(scene->bounds_radius) ? scene->bounds_radius : 1;
}

/* Power into the scene, mean over channels. The environment's goes through the disk that the scene's bounding sphere
   shows to each direction. */
static double light_power(const tr_scene *scene, const tr_light *light, double envmap_integral)
{
    const double pi = 3.14159265358979323846;
    double value = ((double)light->value.x + light->value.y + light->value.z) / 3;
    double radius = bounds_radius(scene), disk = pi * radius * radius;
    switch (light->type) {
    case TR_LIGHT_AREA:
        return value * scene->shapes[light->shape].area * pi;
    case TR_LIGHT_ENVMAP:
        return envmap_integral * disk;
    case TR_LIGHT_CONSTANT:
        return value * 4 * pi * disk;
    case TR_LIGHT_POINT:
        return value * 4 * pi;
    case TR_LIGHT_SPOT:
        return value * 2 * pi * (1 - 0.5 * ((double)light->cutoff_cos + light->beam_cos));
    case TR_LIGHT_DIRECTIONAL:
        return value * disk;
    case TR_LIGHT_SUN:
        return value * 2 * pi * (1 - (double)light->cutoff_cos) * disk;
    }
    return 0;
}

/* Area of the shadow that the scene's bounding box casts along d, and of each of the three pairs of faces in it. */
static float box_shadow(const tr_scene *scene, vec3 d, float face[3])
{
    vec3 e = sub3(scene->bounds_max, scene->bounds_min);
    face[0] = e.y * e.z * fabsf(d.x);
    face[1] = e.z * e.x * fabsf(d.y);
    face[2] = e.x * e.y * fabsf(d.z);
    return face[0] + face[1] + face[2];
}

/* Share of what light_power counts that photons carry: they start from the box, which is smaller than its sphere. */
static double photon_share(const tr_scene *scene, const tr_light *light)
{
    const double disk = 3.14159265358979323846 * bounds_radius(scene) * bounds_radius(scene);
    float face[3];
    if (light->type == TR_LIGHT_DIRECTIONAL || light->type == TR_LIGHT_SUN)
        return box_shadow(scene, light->direction, face) / disk;
    if (light->type == TR_LIGHT_ENVMAP || light->type == TR_LIGHT_CONSTANT)
        return 0.5 * box_shadow(scene, v3s(1), face) / disk; /* a convex body's mean shadow: surface / 4 (Cauchy) */
    return 1;
}

/* Switch off what cannot be sampled, saying so. A light that is merely black says nothing. */
static bool light_usable(const tr_scene *scene, tr_light *light, tr_log *log)
{
    const char *reason = NULL;
    if (!finite3(light->value) || light->value.x < 0 || light->value.y < 0 || light->value.z < 0)
        reason = "has a negative value or one that is not finite";
    else if (light->type == TR_LIGHT_AREA && (light->shape < 0 || light->shape >= scene->shape_count))
        reason = "is on no shape";
    else if (light->type == TR_LIGHT_AREA && !black3(light->value)) {
        const tr_shape *shape = &scene->shapes[light->shape];
        if (!(shape->area > 0) || !isfinite(shape->area) || (shape->type == TR_SHAPE_MESH && !shape->area_cdf))
            reason = "is on a shape without area";
    } else if ((light->type == TR_LIGHT_POINT || light->type == TR_LIGHT_SPOT) && !finite3(light->position))
        reason = "has no finite position";
    if (reason) {
        tr_message(log, TR_WARNING, scene->path, light->line, "the light %s; it is ignored", reason);
        light->value = v3s(0);
    }
    return !reason;
}

static void select_lights(tr_scene *scene, double *power, const double *photon_power)
{
    uint32_t n = (uint32_t)scene->light_count;
    double total = 0;
    int lit = 0;
    for (uint32_t i = 0; i < n; ++i) {
        total += power[i];
        lit += power[i] > 0;
    }
    scene->light_cdf[0] = scene->power_cdf[0] = 0;
    if (n)
        cdf_build(scene->power_cdf, photon_power, n);
    for (uint32_t i = 0; i < n; ++i)
        if (power[i] > 0)
            power[i] = (1 - UNIFORM_SHARE) * power[i] / total + UNIFORM_SHARE / lit;
    if (n)
        cdf_build(scene->light_cdf, power, n);
    for (uint32_t i = 0; i < n; ++i) /* as drawn, rounding and all */
        scene->lights[i].selection = scene->light_cdf[i + 1] - scene->light_cdf[i];
}

bool tr_lights_finish(tr_scene *scene, tr_log *log)
{
    size_t n = (size_t)scene->light_count;
    free(scene->environment);
    free(scene->light_cdf);
    scene->environment_count = 0;
    scene->environment = malloc((n + 1) * sizeof(int));
    scene->light_cdf = malloc(2 * (n + 1) * sizeof(float));
    scene->power_cdf = scene->light_cdf ? scene->light_cdf + n + 1 : NULL;
    double *power = malloc(2 * (n + 1) * sizeof(double)), *photon_power = power ? power + n + 1 : NULL;
    bool ok = scene->environment && scene->light_cdf && power;
    for (size_t i = 0; ok && i < n; ++i) {
        tr_light *light = &scene->lights[i];
        double integral = 0;
        free(light->marginal);
        free(light->conditional);
        light->marginal = light->conditional = NULL;
        if (light->type == TR_LIGHT_ENVMAP)
            ok = envmap_build(scene->path, light, &integral, log);
        if (is_environment(light))
            scene->environment[scene->environment_count++] = (int)i;
        if (light->type == TR_LIGHT_SPOT || light->type == TR_LIGHT_DIRECTIONAL || light->type == TR_LIGHT_SUN)
            light->direction = norm3(light->direction);
        power[i] = light_usable(scene, light, log) ? light_power(scene, light, integral) : 0;
        if (!(power[i] > 0) || isinf(power[i]))
            power[i] = 0;
        photon_power[i] = power[i] > 0 ? power[i] * photon_share(scene, light) : 0;
        if (!isfinite(photon_power[i]))
            photon_power[i] = 0;
    }
    if (ok)
        select_lights(scene, power, photon_power);
    else
        tr_message(log, TR_ERROR, scene->path, 0, "out of memory for the light tables");
    free(power);
    return ok;
}

/* ---- >>cone ------------------------------------------------------------------------------------------------- */

/* Uniform directions within a cone. one_minus_cos rather than the cosine: a narrow cone has none to spare. */
static TR_NOINLINE vec3 cone_sample(vec3 axis, float one_minus_cos, float u1, float u2)
{
    frame3 f = frame_from_normal(axis);
    float x = u1 * one_minus_cos, s = sqrtf(tr_max(0, x * (2 - x))), sine, cosine;
    sincos_turn(u2, &sine, &cosine);
    return norm3(to_world(&f, v3(s * cosine, s * sine, 1 - x)));
}

static float cone_pdf(float one_minus_cos) { return 1.0f / (2 * TR_PI * one_minus_cos); }

/* By the chord |d - a|^2 = 2 (1 - cos): the cosine itself would blur the sun's edge by a hundredth of its radius. */
static bool sun_hit(const tr_light *light, vec3 direction)
{
    vec3 chord = add3(direction, light->direction);
    return dot3(chord, chord) <= 2 * (1 - light->cutoff_cos);
}

/* ---- >>area ------------------------------------------------------------------------------------------------- */

/* A point drawn on a shape, its unit front normal and the density per area. */
typedef struct area_point {
    vec3 p, ng;
    float pdf;
} area_point;

/* A point on triangle i of a mesh; u1 is what chose it. u_extra, what choosing the light left over, refills the low
   bits of u1 that choosing the triangle used up. */
static void triangle_point(const tr_shape *shape, uint32_t i, float u_extra, float u1, float u2, area_point *out)
{
    const tr_emitter *e = &shape->emitters[i];
    float width = shape->area_cdf[i + 1] - shape->area_cdf[i];
    float a = width > 0 ? (u1 - shape->area_cdf[i] + u_extra * 0x1p-24f) / width : 0;
    a = clampf(a, 0, 1);
    float s = sqrtf(a), b1 = s * (1 - u2), b2 = s * u2;
    out->p = madd3(madd3(e->p, e->e1, b1), e->e2, b2);
    out->ng = e->n;
    out->pdf = 1.0f / shape->area;
}

/* Area of the world per unit of (phi, z) around a local point of the cylinder; not constant where the transform scales
   unevenly. */
static float cylinder_stretch(const tr_shape *shape, float x, float y)
{
    vec3 along_phi = xform_vector(&shape->object_to_world, v3(-y, x, 0)),
         along_z = xform_vector(&shape->object_to_world, v3(0, 0, 1));
    return len3(cross3(along_phi, along_z));
}

static float shape_area_pdf(const tr_shape *shape, vec3 p)
{
    if (shape->type != TR_SHAPE_CYLINDER)
        return 1.0f / shape->area;
    vec3 l = xform_point(&shape->world_to_object, p);
    float r = sqrtf(l.x * l.x + l.y * l.y);
    return r > 0 ? 1.0f / (2 * TR_PI * cylinder_stretch(shape, l.x / r, l.y / r)) : 0;
}

static TR_NOINLINE void analytic_point(const tr_shape *shape, float u1, float u2, area_point *out)
{
    float sine, cosine;
    vec3 n = v3(0, 0, 1);
    sincos_turn(u2, &sine, &cosine);
    switch (shape->type) {
    case TR_SHAPE_SPHERE:
        n = sample_uniform_sphere(u1, u2);
        out->p = madd3(shape->center, n, shape->radius);
        out->pdf = 1.0f / (4 * TR_PI * shape->radius * shape->radius);
        break;
    case TR_SHAPE_DISK:
        out->p = xform_point(&shape->object_to_world, v3(sqrtf(u1) * cosine, sqrtf(u1) * sine, 0));
        out->pdf = 1.0f / shape->area;
        n = norm3(xform_normal(&shape->world_to_object, n));
        break;
    case TR_SHAPE_CYLINDER:
        n = v3(cosine, sine, 0);
        out->p = xform_point(&shape->object_to_world, v3(n.x, n.y, u1));
        out->pdf = 1.0f / (2 * TR_PI * cylinder_stretch(shape, n.x, n.y));
        n = norm3(xform_normal(&shape->world_to_object, n));
        break;
    default:
        break;
    }
    out->ng = shape->flip_normals ? neg3(n) : n;
}

/* 1 - cos of the half angle under which a sphere is seen; 0 when p is not outside. An unflipped sphere shows nothing
   to points inside, and all it shows to points outside is within this cone. A flipped one is sampled by area. */
static float sphere_cone(const tr_shape *shape, vec3 p, float *distance2)
{
    vec3 d = sub3(shape->center, p);
    float d2 = dot3(d, d), r2 = shape->radius * shape->radius;
    *distance2 = d2;
    if (!(d2 > r2))
        return 0;
    float sin2 = r2 / d2;
    return sin2 / (1 + sqrtf(1 - sin2));
}

static TR_NOINLINE bool sphere_sample(const tr_shape *shape, vec3 p, float u1, float u2, tr_light_sample *sample)
{
    float d2, cone = sphere_cone(shape, p, &d2);
    if (!(cone > 0))
        return false;
    /* With c = 1 - cos of the cone and x = 1 - cos of the angle drawn, r^2 = d^2 c (2 - c), which leaves no difference
       of nearly equal numbers: rounding near the rim would put the light behind its own surface. */
    float d = sqrtf(d2), x = u1 * cone, root = sqrtf(cone * (1 - u1) * (2 - cone - x));
    sample->wi = cone_sample(scale3(sub3(shape->center, p), 1 / d), cone, u1, u2);
    sample->distance = (d2 - shape->radius * shape->radius) / (d * (1 - x + root));
    sample->pdf = cone_pdf(cone);
    return sample->distance > 0;
}

static bool area_sample(const tr_scene *scene, const tr_light *light, vec3 p, float u_select, float u1, float u2,
                        tr_light_sample *sample)
{
    const tr_shape *shape = &scene->shapes[light->shape];
    area_point point;
    if (shape->type == TR_SHAPE_MESH) {
        /* A triangle that turns its back to p is the most common answer: it is found out before all else. */
        uint32_t i = cdf_find(shape->area_cdf, shape->triangle_count, u1);
        if (!(dot3(shape->emitters[i].n, sub3(p, shape->emitters[i].p)) > 0))
            return false;
        triangle_point(shape, i, cdf_rest(scene->light_cdf, (uint32_t)sample->light, u_select), u1, u2, &point);
    } else if (shape->type == TR_SHAPE_SPHERE && !shape->flip_normals) {
        sample->radiance = light->value;
        return sphere_sample(shape, p, u1, u2, sample);
    } else {
        analytic_point(shape, u1, u2, &point);
    }
    sample->radiance = light->value;
    vec3 d = sub3(point.p, p);
    float d2 = dot3(d, d), facing = -dot3(point.ng, d);
    if (!(facing > 0 && d2 > 0))
        return false;
    sample->distance = sqrtf(d2);
    sample->wi = scale3(d, 1 / sample->distance);
    sample->pdf = point.pdf * d2 * sample->distance / facing;
    return true;
}

/* ---- >>queries ---------------------------------------------------------------------------------------------- */

static TR_NOINLINE float environment_pdf(const tr_scene *scene, vec3 wi)
{
    float pdf = 0;
    for (int i = 0; i < scene->environment_count; ++i) {
        const tr_light *light = &scene->lights[scene->environment[i]];
        if (!(light->selection > 0))
            continue;
        if (light->type == TR_LIGHT_ENVMAP)
            pdf += light->selection * envmap_pdf(light, wi);
        else if (light->type == TR_LIGHT_CONSTANT)
            pdf += light->selection * (0.25f * TR_INV_PI);
        else if (sun_hit(light, wi))
            pdf += light->selection * cone_pdf(1 - light->cutoff_cos);
    }
    return pdf;
}

/* Mitsuba's falloff: full within the beam, then linear in the angle down to the cutoff. */
static float spot_falloff(const tr_light *light, float cosine)
{
    if (cosine <= light->cutoff_cos)
        return 0;
    if (cosine >= light->beam_cos)
        return 1;
    float cutoff = acosf(clampf(light->cutoff_cos, -1, 1)), beam = acosf(clampf(light->beam_cos, -1, 1));
    return clampf((cutoff - acosf(clampf(cosine, -1, 1))) / (cutoff - beam), 0, 1);
}

/* Point, spot and directional lights: one direction. */
static TR_NOINLINE bool delta_sample(const tr_light *light, vec3 p, tr_light_sample *sample)
{
    sample->delta = true;
    sample->pdf = 1;
    sample->radiance = light->value;
    if (light->type == TR_LIGHT_DIRECTIONAL) {
        sample->wi = neg3(light->direction);
        sample->distance = INFINITY;
        return true;
    }
    vec3 d = sub3(light->position, p);
    float d2 = dot3(d, d), scale = 1;
    if (!(d2 > 0))
        return false;
    sample->distance = sqrtf(d2);
    sample->wi = scale3(d, 1 / sample->distance);
    if (light->type == TR_LIGHT_SPOT)
        scale = spot_falloff(light, -dot3(sample->wi, light->direction));
    sample->radiance = scale3(light->value, scale / d2);
    return scale > 0;
}

bool tr_light_sample_direction(const tr_scene *scene, vec3 p, float u_select, float u1, float u2,
                               tr_light_sample *sample)
{
    uint32_t n = (uint32_t)scene->light_count;
    if (!n || !(scene->light_cdf[n] > 0))
        return false;
    uint32_t i = cdf_find(scene->light_cdf, n, u_select);
    const tr_light *light = &scene->lights[i];
    sample->light = (int)i;
    sample->delta = false;
    sample->distance = INFINITY;
    bool ok = true;
    switch (light->type) {
    case TR_LIGHT_AREA:
        ok = area_sample(scene, light, p, u_select, u1, u2, sample);
        break;
    case TR_LIGHT_POINT:
    case TR_LIGHT_SPOT:
    case TR_LIGHT_DIRECTIONAL:
        ok = delta_sample(light, p, sample);
        break;
    case TR_LIGHT_ENVMAP:
        sample->wi = envmap_sample(light, u1, u2);
        break;
    case TR_LIGHT_CONSTANT:
        sample->wi = sample_uniform_sphere(u1, u2);
        break;
    case TR_LIGHT_SUN:
        sample->wi = cone_sample(neg3(light->direction), 1 - light->cutoff_cos, u1, u2);
        break;
    }
    if (!ok)
        return false;
    if (is_environment(light)) {
        sample->radiance = tr_environment(scene, sample->wi);
        sample->pdf = environment_pdf(scene, sample->wi);
    } else {
        sample->pdf *= light->selection;
    }
    return sample->pdf > 0 && !isinf(sample->pdf) && finite3(sample->wi) && finite3(sample->radiance);
}

float tr_light_pdf(const tr_scene *scene, vec3 p, vec3 wi, const tr_surface *hit)
{
    if (!hit)
        return environment_pdf(scene, wi);
    const tr_shape *shape = &scene->shapes[hit->shape];
    if (shape->light < 0)
        return 0;
    const tr_light *light = &scene->lights[shape->light];
    float cosine = -dot3(hit->ng, wi), pdf;
    if (!(light->selection > 0) || !(cosine > 0))
        return 0;
    vec3 d = sub3(hit->p, p);
    float d2 = dot3(d, d);
    if (shape->type == TR_SHAPE_SPHERE && !shape->flip_normals) {
        float cone = sphere_cone(shape, p, &d2);
        pdf = cone > 0 ? cone_pdf(cone) : 0;
    } else {
        pdf = shape_area_pdf(shape, hit->p) * d2 / cosine;
    }
    pdf *= light->selection;
    return isfinite(pdf) ? pdf : 0;
}

vec3 tr_surface_emission(const tr_scene *scene, const tr_surface *surface, vec3 wo)
{
    int light = scene->shapes[surface->shape].light;
    return light >= 0 && dot3(surface->ng, wo) > 0 ? scene->lights[light].value : v3s(0);
}

vec3 tr_environment(const tr_scene *scene, vec3 direction)
{
    vec3 sum = v3s(0);
    for (int i = 0; i < scene->environment_count; ++i) {
        const tr_light *light = &scene->lights[scene->environment[i]];
        if (light->type == TR_LIGHT_ENVMAP)
            sum = add3(sum, envmap_radiance(light, direction));
        else if (light->type == TR_LIGHT_CONSTANT || sun_hit(light, direction))
            sum = add3(sum, light->value);
    }
    return sum;
}

/* ---- >>emission --------------------------------------------------------------------------------------------- */

/* From the front of an area light, by area and cosine. Returns flux over radiance. */
static float emit_area(const tr_scene *scene, const tr_light *light, const float u[5], tr_emission *out)
{
    const tr_shape *shape = &scene->shapes[light->shape];
    area_point point;
    if (shape->type == TR_SHAPE_MESH) {
        float rest = cdf_rest(scene->power_cdf, (uint32_t)out->light, u[0]);
        triangle_point(shape, cdf_find(shape->area_cdf, shape->triangle_count, u[1]), rest, u[1], u[2], &point);
    } else {
        analytic_point(shape, u[1], u[2], &point);
    }
    frame3 f = frame_from_normal(point.ng);
    out->p = point.p;
    out->ng = point.ng;
    out->direction = norm3(to_world(&f, sample_cosine_hemisphere(u[3], u[4])));
    return TR_PI / point.pdf;
}

/* From a point or spot light. Returns flux over intensity. */
static float emit_point(const tr_light *light, const float u[5], tr_emission *out)
{
    out->p = light->position;
    out->delta = true;
    if (light->type == TR_LIGHT_POINT) {
        out->direction = sample_uniform_sphere(u[3], u[4]);
        return 4 * TR_PI;
    }
    float width = 1 - light->cutoff_cos;
    out->direction = cone_sample(light->direction, width, u[3], u[4]);
    return spot_falloff(light, dot3(out->direction, light->direction)) / cone_pdf(width);
}

/* Where light from wi enters the bounding box, drawn evenly from the shadow that it casts; then back, out of the scene.
   Returns the shadow's area. */
static float enter_box(const tr_scene *scene, vec3 wi, float u1, float u2, vec3 *p)
{
    float face[3], area = box_shadow(scene, wi, face), at[3], x = u1 * area;
    const float lo[3] = {scene->bounds_min.x, scene->bounds_min.y, scene->bounds_min.z};
    const float hi[3] = {scene->bounds_max.x, scene->bounds_max.y, scene->bounds_max.z};
    const float d[3] = {wi.x, wi.y, wi.z};
    int k = x < face[0] ? 0 : x < face[0] + face[1] || !(face[2] > 0) ? 1 : 2;
    x = (k == 0 ? x : k == 1 ? x - face[0] : x - face[0] - face[1]) / face[k];
    at[k] = d[k] > 0 ? hi[k] : lo[k];
    at[(k + 1) % 3] = lerpf(lo[(k + 1) % 3], hi[(k + 1) % 3], clampf(x, 0, 1));
    at[(k + 2) % 3] = lerpf(lo[(k + 2) % 3], hi[(k + 2) % 3], u2);
    *p = madd3(v3(at[0], at[1], at[2]), wi, (float)bounds_radius(scene));
    return area;
}

/* From a light without a place, parallel. *value is radiance, of a directional light irradiance. Returns flux over
   that. */
static float emit_distant(const tr_scene *scene, const tr_light *light, const float u[5], vec3 *value, tr_emission *out)
{
    float pdf = 1;
    out->distant = true;
    vec3 wi = neg3(light->direction);
    if (light->type == TR_LIGHT_ENVMAP) {
        wi = envmap_sample(light, u[3], u[4]);
        pdf = envmap_pdf(light, wi);
        *value = envmap_radiance(light, wi);
    } else if (light->type == TR_LIGHT_CONSTANT) {
        wi = sample_uniform_sphere(u[3], u[4]);
        pdf = 0.25f * TR_INV_PI;
    } else if (light->type == TR_LIGHT_SUN) {
        wi = cone_sample(wi, 1 - light->cutoff_cos, u[3], u[4]);
        pdf = cone_pdf(1 - light->cutoff_cos);
    } else {
        out->delta = true;
    }
    out->direction = neg3(wi);
    return pdf > 0 ? enter_box(scene, wi, u[1], u[2], &out->p) / pdf : 0;
}

bool tr_light_emit(const tr_scene *scene, const float u[5], tr_emission *emission)
{
    uint32_t n = (uint32_t)scene->light_count;
    tr_emission *out = emission;
    if (!n || !(scene->power_cdf[n] > 0))
        return false;
    uint32_t i = cdf_find(scene->power_cdf, n, u[0]);
    const tr_light *light = &scene->lights[i];
    memset(out, 0, sizeof *out);
    out->light = (int)i;
    vec3 value = light->value;
    float flux;
    if (light->type == TR_LIGHT_AREA)
        flux = emit_area(scene, light, u, out);
    else if (light->type == TR_LIGHT_POINT || light->type == TR_LIGHT_SPOT)
        flux = emit_point(light, u, out);
    else
        flux = emit_distant(scene, light, u, &value, out);
    out->flux = scale3(value, flux / (scene->power_cdf[i + 1] - scene->power_cdf[i]));
    return finite3(out->flux) && finite3(out->p) && max3(out->flux) > 0;
}
