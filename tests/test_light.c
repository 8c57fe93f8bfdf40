/* test_light.c: lights against the outside: chi-square of directions against tr_light_pdf over the hits that Embree
   finds, the density's integral, analytic irradiance, quadrature by traced rays, the sky against Preetham's formulas
   written down again, the sun against known ephemerides.

     >>rig >>rays >>chi >>irradiance >>delta >>selection >>environment >>sky >>sun >>misuse */
#include "cmocka_prelude.h"

#include <stdlib.h>
#include <string.h>

#include "scale.h"
#include "scene_internal.h"

#define PI 3.14159265358979323846

/* ---- >>rig -------------------------------------------------------------------------------------------------- */

static tr_scene *scene_new(void)
{
    tr_scene *scene = tr_scene_new();
    assert_non_null(scene);
    assert_int_equal(tr_scene_add_bsdf(scene, TR_BSDF_DIFFUSE), 0);
    return scene;
}

static void scene_done(tr_scene *scene)
{
    tr_log log = {0};
    assert_true(tr_scene_finish(scene, 1, &log));
    assert_int_equal(log.warnings + log.errors, 0);
}

static tr_light *add_light(tr_scene *scene, tr_light_type type, float value)
{
    int id = tr_scene_add_light(scene, type);
    assert_true(id >= 0);
    scene->lights[id].value = v3s(value);
    return &scene->lights[id];
}

/* A new shape with an area light on it. */
static tr_shape *add_emitter(tr_scene *scene, float radiance)
{
    int id = tr_scene_add_shape(scene), light = (int)(add_light(scene, TR_LIGHT_AREA, radiance) - scene->lights);
    assert_true(id >= 0);
    scene->lights[light].shape = id;
    scene->shapes[id].bsdf = 0;
    scene->shapes[id].light = light;
    return &scene->shapes[id];
}

static mat4 placed(vec3 translate, vec3 axis, float degrees, vec3 scale)
{
    mat4 t = mat4_translate(translate), r = mat4_rotate(axis, degrees), s = mat4_scale(scale), tr = mat4_mul(&t, &r);
    return mat4_mul(&tr, &s);
}

static void add_rectangle(tr_scene *scene, float radiance, mat4 m)
{
    assert_true(tr_shape_rectangle(add_emitter(scene, radiance), &m));
}
static void add_disk(tr_scene *scene, float radiance, mat4 m)
{
    assert_true(tr_shape_disk(add_emitter(scene, radiance), &m));
}
static tr_shape *add_sphere(tr_scene *scene, float radiance, vec3 center, float radius)
{
    mat4 identity = mat4_identity();
    bool tessellated = false;
    tr_shape *shape = add_emitter(scene, radiance);
    assert_true(tr_shape_sphere(shape, &identity, center, radius, &tessellated));
    assert_false(tessellated);
    return shape;
}
/* Not through tr_shape_cylinder, which may tessellate what is squeezed. */
static void add_cylinder(tr_scene *scene, float radiance, mat4 m)
{
    tr_shape *shape = add_emitter(scene, radiance);
    shape->type = TR_SHAPE_CYLINDER;
    shape->object_to_world = m;
    assert_true(tr_shape_complete(shape));
}

/* A fan of triangles, bent, from large to tiny. */
static void add_fan(tr_scene *scene, float radiance, bool flip)
{
    tr_shape *shape = add_emitter(scene, radiance);
    enum { N = 12 };
    assert_true(tr_mesh_alloc(shape, N + 2, N, false, false));
    float angle = 0;
    for (int i = 0; i <= N; ++i) {
        float *p = shape->positions + 3 * (i + 1);
        p[0] = cosf(angle);
        p[1] = 2 + 0.1f * cosf(2 * angle);
        p[2] = sinf(angle);
        angle += 1.5f * powf(0.6f, (float)i);
    }
    shape->positions[1] = 2.2f;
    for (uint32_t i = 0; i < N; ++i) {
        uint32_t *t = shape->indices + 3 * i;
        t[0] = 0;
        t[1] = i + 1;
        t[2] = i + 2;
    }
    shape->flip_normals = flip;
}

static tr_light *add_envmap(tr_scene *scene, int w, int h, uint64_t seed)
{
    tr_light *light = add_light(scene, TR_LIGHT_ENVMAP, 1);
    assert_true(tr_image_alloc(&light->image, w, h, 3));
    tr_rng rng = rng_seed(seed, 0);
    for (int i = 0; i < w * h * 3; ++i) /* many black pixels, a few bright ones */
        light->image.data[i] = rng_float(&rng) < 0.5f ? 0 : expf(4 * rng_float(&rng));
    return light;
}

static void turn(tr_light *light, mat4 m)
{
    light->to_world = m;
    assert_true(mat4_inverse(&m, &light->to_local));
}

/* ---- >>rays ------------------------------------------------------------------------------------------------- */

/* True where the ray hits something, then described in surface. */
static bool trace(const tr_scene *scene, vec3 p, vec3 w, tr_surface *surface)
{
    struct RTCRayHit hit;
    memset(&hit, 0, sizeof hit);
    hit.ray.org_x = p.x;
    hit.ray.org_y = p.y;
    hit.ray.org_z = p.z;
    hit.ray.dir_x = w.x;
    hit.ray.dir_y = w.y;
    hit.ray.dir_z = w.z;
    hit.ray.tfar = INFINITY;
    hit.ray.mask = ~0u;
    hit.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    tr_rtc_intersect(scene->rtc, &hit);
    if (hit.hit.geomID == RTC_INVALID_GEOMETRY_ID)
        return false;
    tr_surface_from_hit(scene, &hit, surface);
    return true;
}

/* Density of light sampling, and radiance, along w as a path that samples its bsdf would see them. */
static float seen(const tr_scene *scene, vec3 p, vec3 w, vec3 *radiance)
{
    tr_surface surface;
    if (trace(scene, p, w, &surface)) {
        *radiance = tr_surface_emission(scene, &surface, neg3(w));
        return tr_light_pdf(scene, p, w, &surface);
    }
    *radiance = tr_environment(scene, w);
    return tr_light_pdf(scene, p, w, NULL);
}

/* True where the sampled light is what a ray finds there. */
static bool visible(const tr_scene *scene, vec3 p, const tr_light_sample *s)
{
    tr_surface surface;
    bool hit = trace(scene, p, s->wi, &surface);
    if (isinf(s->distance))
        return !hit;
    return hit && surface.t > s->distance * (1 - 1e-3f);
}

/* ---- >>chi -------------------------------------------------------------------------------------------------- */

/* Bins over the cone of half angle acos(1 - width) around an axis, equal in solid angle, and one for the rest. */
enum { RINGS = 14, SECTORS = 20, BINS = RINGS * SECTORS, SAMPLES = LESS(200000) };
typedef struct cone {
    frame3 frame;
    double width; /* 1 - cos of the half angle; 2 = the sphere */
    int grid;     /* quadrature points along each side of a bin */
} cone;

static vec3 cone_direction(const cone *c, double x, double turns)
{
    double t = x * c->width, s = sqrt(t * (2 - t)), phi = 2 * PI * turns;
    return to_world(&c->frame, v3((float)(s * cos(phi)), (float)(s * sin(phi)), (float)(1 - t)));
}

static int cone_bin(const cone *c, vec3 w)
{
    vec3 l = to_local(&c->frame, w);
    double s2 = (double)l.x * l.x + (double)l.y * l.y, t = l.z > 0 ? s2 / (1 + sqrt(fmax(0, 1 - s2))) : 1 - (double)l.z;
    double x = t / c->width, turns = atan2(l.y, l.x) / (2 * PI);
    int ring = (int)(x * RINGS), sector = (int)((turns < 0 ? turns + 1 : turns) * SECTORS);
    if (x >= 1)
        return ring == RINGS && x < 1 + 1e-6 ? BINS - 1 : BINS;
    return ring * SECTORS + (sector < SECTORS ? sector : SECTORS - 1);
}

/* What the rays say: the density in each bin, its sum, and the irradiance on a plane with normal n. */
static double quadrature(const tr_scene *scene, vec3 p, const cone *c, vec3 n, double *bins, double *irradiance)
{
    tr_rng rng = rng_seed(99, 0);
    int grid = c->grid;
    double total = 0, cell = 2 * PI * c->width / BINS / (grid * grid);
    *irradiance = 0;
    for (int b = 0; b < BINS; ++b) {
        bins[b] = 0;
        for (int i = 0; i < grid * grid; ++i) {
            double x = (b / SECTORS + (i / grid + rng_float(&rng)) / (double)grid) / RINGS,
                   phi = (b % SECTORS + (i % grid + rng_float(&rng)) / (double)grid) / SECTORS;
            vec3 w = cone_direction(c, x, phi), radiance;
            bins[b] += seen(scene, p, w, &radiance) * cell;
            *irradiance += (double)radiance.x * fmax(0, dot3(n, w)) * cell;
        }
        total += bins[b];
    }
    return total;
}

/* Chi-square as a standard normal deviate (Wilson and Hilferty 1931), bins of few pooled. */
static double chi_deviate(const double *expected, const double *count, int n)
{
    double chi = 0, pool_e = 0, pool_c = 0;
    int k = -1;
    for (int i = 0; i <= n; ++i) {
        double e = i < n ? expected[i] : pool_e, c = i < n ? count[i] : pool_c;
        if (e < 12 && i < n) {
            pool_e += e;
            pool_c += c;
        } else if (e >= 12) {
            chi += (c - e) * (c - e) / e;
            ++k;
        } else {
            assert_true(c <= e + 5 * sqrt(e) + 30); /* edges may slip between the points of the quadrature */
        }
    }
    if (k < 1)
        return 0;
    return (cbrt(chi / k) - (1 - 2.0 / (9 * k))) / sqrt(2.0 / (9 * k));
}

/* About twenty calls at 4 deviates: a false alarm in 1600 choices of the seeds, which are fixed. */
static void check_directions_fine(tr_scene *scene, vec3 p, vec3 axis, double width, bool always, uint64_t seed,
                                  int grid)
{
    cone c = {frame_from_normal(norm3(axis)), width, grid};
    vec3 n = norm3(axis);
    static double expected[BINS + 1], count[BINS + 1];
    double quad_e, total = quadrature(scene, p, &c, n, expected, &quad_e), sum = 0, sum2 = 0;
    int disagree = 0, drawn = 0;
    memset(count, 0, sizeof count);
    tr_rng rng = rng_seed(seed, 5);
    for (int i = 0; i < SAMPLES; ++i) {
        tr_light_sample s;
        float a = rng_float(&rng), b = rng_float(&rng), u = rng_float(&rng);
        if (!tr_light_sample_direction(scene, p, a, b, u, &s) || !visible(scene, p, &s))
            continue;
        vec3 radiance;
        float pdf = seen(scene, p, s.wi, &radiance);
        assert_true(fabsf(len3(s.wi) - 1) < 1e-5f);
        ++drawn;
        disagree += fabsf(pdf - s.pdf) > 2e-3f * s.pdf || len3(sub3(radiance, s.radiance)) > 1e-3f * len3(s.radiance);
        count[cone_bin(&c, s.wi)] += 1;
        double e = (double)s.radiance.x * fmaxf(0, dot3(n, s.wi)) / s.pdf;
        sum += e;
        sum2 += e * e;
    }
    /* Grazing hits lose digits of the cosine; edges move to a neighbouring pixel or off the light. */
    assert_true(disagree <= drawn / 200);
    assert_true(count[BINS] <= 1e-4 * drawn); /* nothing outside of the cone */
    if (always)
        assert_true(fabs(total - 1) < 4e-3 && drawn > 0.999 * SAMPLES);
    else
        assert_true(total < 1.004);
    for (int i = 0; i < BINS; ++i)
        expected[i] *= SAMPLES;
    double deviate = chi_deviate(expected, count, BINS);
    if (deviate > 4)
        print_message("chi-square deviate %g, integral %g\n", deviate, total);
    assert_true(deviate < 4);
    double mean = sum / SAMPLES, error = sqrt(fmax(0, sum2 / SAMPLES - mean * mean) / SAMPLES);
    assert_true(fabs(mean - quad_e) < 4.5 * error + 5e-3 * quad_e);
    tr_scene_free(scene);
}

static void check_directions(tr_scene *scene, vec3 p, vec3 axis, double width, bool always, uint64_t seed)
{
    check_directions_fine(scene, p, axis, width, always, seed, 20);
}

static void rectangle_directions_follow_the_density(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    add_rectangle(scene, 3, placed(v3(0, 2, 0.5f), v3(1, 0.2f, 0), 100, v3(1, 0.6f, 1)));
    scene_done(scene);
    vec3 p = v3(0.1f, 0, 0);
    check_directions(scene, p, sub3(v3(0, 2, 0.5f), p), 0.25, true, 1);
}

static void mesh_directions_follow_the_density(void **state)
{
    (void)state;
    for (int flip = 0; flip < 2; ++flip) {
        tr_scene *scene = scene_new();
        add_fan(scene, 2, flip);
        scene_done(scene);
        /* the fan faces down when not flipped; each side sees its front only */
        vec3 p = flip ? v3(0.2f, 3.5f, 0.1f) : v3(0.2f, 0.7f, 0.1f);
        tr_light_sample s;
        bool front = tr_light_sample_direction(scene, p, 0.5f, 0.5f, 0.5f, &s);
        assert_true(front != tr_light_sample_direction(scene, v3(0.2f, 4.2f - p.y, 0.1f), 0.5f, 0.5f, 0.5f, &s));
        if (!front)
            p.y = 4.2f - p.y;
        check_directions(scene, p, sub3(v3(0, 2.1f, 0), p), 0.5, true, 2);
    }
}

static void sphere_directions_follow_the_density(void **state)
{
    static const struct {
        float distance, radius;
        bool flip;
        double width;
    } cases[] = {{2, 1, false, 0.15}, {1000, 1, false, 6e-7}, {1.02f, 1, false, 0.9}, {0.3f, 1, true, 2}};
    (void)state;
    for (size_t i = 0; i < sizeof cases / sizeof *cases; ++i) {
        tr_scene *scene = scene_new();
        vec3 center = v3(0.6f * cases[i].distance, 0.8f * cases[i].distance, 0);
        add_sphere(scene, 2, center, cases[i].radius)->flip_normals = cases[i].flip;
        scene_done(scene);
        check_directions(scene, v3(0, 0, 0), center, cases[i].width, true, 3 + i);
    }
}

/* An unflipped sphere is dark inside, a flipped one outside, whatever is asked. */
static void spheres_are_dark_on_their_backs(void **state)
{
    (void)state;
    for (int flip = 0; flip < 2; ++flip) {
        tr_scene *scene = scene_new();
        add_sphere(scene, 2, v3(0, 0, 0), 1)->flip_normals = flip;
        scene_done(scene);
        vec3 p = v3(0, flip ? 2 : 0.5f, 0), radiance;
        tr_rng rng = rng_seed(2, 2);
        for (int i = 0; i < 2000; ++i) {
            tr_light_sample s;
            float a = rng_float(&rng), b = rng_float(&rng);
            if (tr_light_sample_direction(scene, p, 0, a, b, &s)) /* the far wall, through the near one */
                assert_true(flip && s.distance > 1.7f);
            assert_true(seen(scene, p, sample_uniform_sphere(a, b), &radiance) == 0 && black3(radiance));
        }
        tr_scene_free(scene);
    }
}

static void disk_directions_follow_the_density(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    add_disk(scene, 2, placed(v3(0.3f, 2, 0), v3(1, 0, 0.3f), 80, v3(1, 0.4f, 2))); /* an ellipse */
    scene_done(scene);
    check_directions(scene, v3(0, 0, 0), v3(0.3f, 2, 0), 0.2, true, 11);
}

static void cylinder_directions_follow_the_density(void **state)
{
    (void)state;
    for (int squeeze = 0; squeeze < 2; ++squeeze) {
        tr_scene *scene = scene_new();
        add_cylinder(scene, 2, placed(v3(-0.4f, 2, 0), v3(0.3f, 1, 0), 75, v3(0.5f, squeeze ? 0.2f : 0.5f, 1.2f)));
        scene_done(scene);
        /* where the surface turns away its density grows without bound, which takes a fine quadrature */
        check_directions_fine(scene, v3(0, 0, 0), v3(0.2f, 2, 0.1f), 0.3, false, 12, 100);
    }
}

static void environment_directions_follow_the_density(void **state)
{
    static const float scales[4][3] = {{1, 1, 1}, {-1, 1, 1}, {3, 3, 3}, {1, 2, 0.7f}};
    (void)state;
    tr_scene *scene = scene_new();
    add_light(scene, TR_LIGHT_CONSTANT, 2);
    scene_done(scene);
    check_directions(scene, v3(0, 0, 0), v3(1, 2, 3), 2, true, 20);
    for (uint64_t i = 0; i < 4; ++i) { /* turned, mirrored, scaled evenly and not */
        scene = scene_new();
        turn(add_envmap(scene, 16, 8, i),
             placed(v3(1, 2, 3), v3(1, 1, 0), i ? 50 : 0, v3(scales[i][0], scales[i][1], scales[i][2])));
        scene_done(scene);
        check_directions(scene, v3(0, 0, 0), v3(0.1f, 1, 0.2f), 2, true, 21 + i);
    }
}

static tr_sunsky sunsky_defaults(void)
{
    tr_sunsky d;
    memset(&d, 0, sizeof d);
    d.turbidity = 3;
    d.sun_direction = norm3(v3(0.5f, 0.8f, 0.3f));
    d.sky_scale = d.sun_scale = d.sun_radius_scale = 1;
    d.to_world = mat4_identity();
    return d;
}

static void add_sunsky(tr_scene *scene, const tr_sunsky *d, bool with_sky)
{
    int sun = tr_scene_add_light(scene, TR_LIGHT_SUN), sky = tr_scene_add_light(scene, TR_LIGHT_ENVMAP);
    assert_true(tr_sunsky_lights(d, &scene->lights[sky], &scene->lights[sun]));
    if (!with_sky) {
        tr_image_free(&scene->lights[sky].image);
        --scene->light_count;
    }
}

static void sun_directions_follow_the_density(void **state)
{
    tr_sunsky d = sunsky_defaults();
    (void)state;
    for (int i = 0; i < 3; ++i) {
        tr_scene *scene = scene_new();
        d.sun_radius_scale = i ? 40 : 1;
        add_sunsky(scene, &d, i == 1);
        scene_done(scene);
        double angle = 0.2679 * PI / 180 * d.sun_radius_scale;
        if (i != 1) /* a cone wider than the sun */
            check_directions(scene, v3(0, 0, 0), d.sun_direction, 1.1 * (1 - cos(angle)), true, 30);
        else
            check_directions(scene, v3(0, 0, 0), v3(0, 1, 0), 2, true, 31);
    }
}

/* Four emitters that hide each other in part, and something dark, under an envmap: the densities of all of them at
 * once. */
static void directions_of_a_mixture_follow_the_density(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    add_rectangle(scene, 3, placed(v3(0, 2, 0), v3(1, 0, 0), 90, v3(1, 1, 1)));
    add_sphere(scene, 2, v3(0.5f, 1, 0.2f), 0.3f);
    add_disk(scene, 5, placed(v3(-2, 0, 0), v3(0, 1, 0), 90, v3(0.7f, 0.7f, 1)));
    add_cylinder(scene, 1, placed(v3(-1, 0.2f, -0.5f), v3(1, 0, 0), 10, v3(0.2f, 0.2f, 1)));
    tr_shape *dark = add_sphere(scene, 2, v3(-0.4f, 0.5f, 0.5f), 0.2f); /* a shape without a light */
    dark->light = -1;
    --scene->light_count;
    add_light(scene, TR_LIGHT_CONSTANT, 0.2f);
    turn(add_envmap(scene, 8, 4, 1), mat4_rotate(v3(0, 1, 0), 30));
    scene_done(scene);
    check_directions(scene, v3(0.1f, 0, 0), v3(0, 1, 0.2f), 2, false, 40);
}

/* ---- >>irradiance ------------------------------------------------------------------------------------------- */

static double irradiance(const tr_scene *scene, vec3 p, vec3 n, double *error)
{
    enum { N = 200000 };
    tr_rng rng = rng_seed(17, 3);
    double sum = 0, sum2 = 0;
    for (int i = 0; i < N; ++i) {
        tr_light_sample s;
        float a = rng_float(&rng), b = rng_float(&rng), c = rng_float(&rng);
        if (!tr_light_sample_direction(scene, p, a, b, c, &s))
            continue;
        double e = (double)s.radiance.x * fmaxf(0, dot3(n, s.wi)) / s.pdf;
        sum += e;
        sum2 += e * e;
    }
    sum /= N;
    *error = sqrt(fmax(0, sum2 / N - sum * sum) / N);
    return sum;
}

static void expect_irradiance(tr_scene *scene, vec3 p, vec3 n, double expected)
{
    double error, e = irradiance(scene, p, n, &error);
    if (fabs(e - expected) > 4.5 * error + 1e-4 * expected)
        print_message("irradiance %g +- %g, expected %g\n", e, error, expected);
    assert_true(fabs(e - expected) <= 4.5 * error + 1e-4 * expected);
    assert_true(error < 0.01 * expected);
    tr_scene_free(scene);
}

/* E = pi L sin^2 of the angle under which the disk's edge is seen. */
static void disk_above_a_plane(void **state)
{
    (void)state;
    for (int i = 0; i < 2; ++i) {
        double r = 0.7, h = i ? 0.5 : 3;
        tr_scene *scene = scene_new();
        add_disk(scene, 2, placed(v3(0, (float)h, 0), v3(1, 0, 0), 90, v3((float)r, (float)r, 1)));
        scene_done(scene);
        expect_irradiance(scene, v3(0, 0, 0), v3(0, 1, 0), PI * 2 * r * r / (r * r + h * h));
    }
}

/* E = pi L (r / d)^2 cos, while the sphere is above the horizon. */
static void sphere_above_a_plane(void **state)
{
    static const double cases[][2] = {{0.5, 3}, {1, 1.01}, {1, 2000}};
    (void)state;
    for (size_t i = 0; i < 3; ++i) {
        double r = cases[i][0], d = cases[i][1];
        tr_scene *scene = scene_new();
        add_sphere(scene, 3, v3(0, (float)d, 0), (float)r);
        scene_done(scene);
        expect_irradiance(scene, v3(0, 0, 0), v3(0, 1, 0), PI * 3 * r * r / (d * d));
    }
}

/* A patch below one corner of a parallel rectangle a x b at height 1 (Howell, A Catalog of Radiation Heat Transfer
   Configuration Factors, B-3). */
static void rectangle_above_a_plane(void **state)
{
    double a = 1.4, b = 0.6;
    (void)state;
    tr_scene *scene = scene_new();
    add_rectangle(
        scene, 2,
        placed(v3(0.5f * (float)a, 1, 0.5f * (float)b), v3(1, 0, 0), 90, v3(0.5f * (float)a, 0.5f * (float)b, 1)));
    scene_done(scene);
    double p = sqrt(1 + a * a), q = sqrt(1 + b * b);
    expect_irradiance(scene, v3(0, 0, 0), v3(0, 1, 0), 2 * PI / (2 * PI) * (a / p * atan(b / p) + b / q * atan(a / q)));
}

static void constant_light_and_constant_map_agree(void **state)
{
    (void)state;
    for (int i = 0; i < 2; ++i) {
        tr_scene *scene = scene_new();
        tr_light *light = i ? add_envmap(scene, 32, 16, 0) : add_light(scene, TR_LIGHT_CONSTANT, 0.75f);
        for (int k = 0; i && k < 32 * 16 * 3; ++k)
            light->image.data[k] = 0.75f;
        scene_done(scene);
        tr_rng rng = rng_seed(1, 1);
        for (int k = 0; k < 1000; ++k) {
            float u = rng_float(&rng), v = rng_float(&rng);
            vec3 w = sample_uniform_sphere(u, v), e = tr_environment(scene, w);
            assert_true(fabsf(e.x - 0.75f) < 1e-6f && fabsf(e.y - 0.75f) < 1e-6f && fabsf(e.z - 0.75f) < 1e-6f);
            assert_true(fabsf(tr_light_pdf(scene, v3(0, 0, 0), w, NULL) * 4 * TR_PI - 1) < 2e-3f);
        }
        expect_irradiance(scene, v3(1, 2, 3), norm3(v3(1, 1, 1)), PI * 0.75);
    }
}

/* E = pi L sin^2 of the half angle; its rays arrive whatever the radius. */
static void sun_irradiance_is_that_of_its_disk(void **state)
{
    static const float radii[3] = {1, 4, 60};
    double first = 0;
    (void)state;
    for (int i = 0; i < 3; ++i) {
        tr_sunsky d = sunsky_defaults();
        d.sun_radius_scale = radii[i];
        tr_scene *scene = scene_new();
        add_sunsky(scene, &d, false);
        scene_done(scene);
        tr_light *sun = &scene->lights[0];
        double c = sun->cutoff_cos, sin2 = 1 - c * c, power = sun->value.x * 2 * PI * (1 - c);
        assert_true(fabs(acos(c) * 180 / PI - 0.2679 * radii[i]) < 2e-3 * radii[i]);
        first = i ? first : power;
        assert_true(fabs(power - first) < 1e-5 * first);
        expect_irradiance(scene, v3(0, 0, 0), d.sun_direction, PI * sun->value.x * sin2);
    }
}

/* ---- >>delta ------------------------------------------------------------------------------------------------ */

static void point_light_falls_off_with_the_square(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    add_light(scene, TR_LIGHT_POINT, 5)->position = v3(1, 2, 3);
    scene_done(scene);
    tr_light_sample s;
    for (int i = 1; i < 5; ++i) {
        assert_true(tr_light_sample_direction(scene, v3(1, 2 - (float)i, 3), 0.3f, 0.4f, 0.5f, &s));
        assert_true(s.delta && s.pdf == 1 && fabsf(s.distance - (float)i) < 1e-5f && s.light == 0);
        assert_true(fabsf(s.radiance.x * (float)(i * i) - 5) < 1e-4f && s.wi.y > 0.99999f);
    }
    assert_false(tr_light_sample_direction(scene, v3(1, 2, 3), 0.3f, 0.4f, 0.5f, &s)); /* at the light itself */
    assert_true(tr_light_pdf(scene, v3(0, 0, 0), v3(0, 1, 0), NULL) == 0);
    tr_scene_free(scene);
}

static void spot_light_falls_off_linearly_in_the_angle(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    tr_light *light = add_light(scene, TR_LIGHT_SPOT, 4);
    light->position = v3(0, 3, 0);
    light->direction = v3(0, -1, 0);
    light->cutoff_cos = cosf(40 * TR_PI / 180);
    light->beam_cos = cosf(20 * TR_PI / 180);
    scene_done(scene);
    static const float degrees[] = {0, 10, 19.9f, 25, 30, 35, 39.9f, 40.1f, 90, 180};
    for (size_t i = 0; i < sizeof degrees / sizeof *degrees; ++i) {
        float a = degrees[i] * TR_PI / 180, share = clampf((40 - degrees[i]) / 20, 0, 1);
        tr_light_sample s;
        bool lit = tr_light_sample_direction(scene, v3(2 * sinf(a), 3 - 2 * cosf(a), 0), 0, 0, 0, &s);
        assert_true(lit == (share > 0));
        if (lit)
            assert_true(s.delta && fabsf(s.radiance.y - share) < 1e-3f); /* 4 / 2^2 */
    }
    tr_scene_free(scene);
}

static void directional_light_is_the_same_everywhere(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    add_light(scene, TR_LIGHT_DIRECTIONAL, 7)->direction = v3(0, -2, -2);
    scene_done(scene);
    tr_light_sample s;
    assert_true(tr_light_sample_direction(scene, v3(100, 2, 3), 0.9f, 0, 0, &s));
    assert_true(s.delta && isinf(s.distance) && s.pdf == 1 && s.radiance.z == 7);
    assert_true(len3(sub3(s.wi, v3(0, sqrtf(0.5f), sqrtf(0.5f)))) < 1e-6f);
    assert_true(black3(tr_environment(scene, s.wi)));
    tr_scene_free(scene);
}

/* ---- >>selection -------------------------------------------------------------------------------------------- */

static void lights_are_picked_as_selection_says(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    for (int i = 0; i < 6; ++i)
        add_light(scene, TR_LIGHT_POINT, i == 2 ? 0 : powf(10, (float)-i))->position = v3((float)i, 1, 0);
    scene_done(scene);
    enum { N = 200000 };
    double count[6] = {0}, sum = 0;
    tr_rng rng = rng_seed(4, 4);
    for (int i = 0; i < N; ++i) {
        tr_light_sample s;
        assert_true(tr_light_sample_direction(scene, v3(0, 0, 0), rng_float(&rng), 0.5f, 0.5f, &s));
        assert_true(s.pdf == scene->lights[s.light].selection);
        count[s.light] += 1;
    }
    for (int i = 0; i < 6; ++i) {
        double p = scene->lights[i].selection;
        sum += p;
        assert_true(fabs(count[i] - N * p) <= 4.5 * sqrt(N * p));
        assert_true(i == 2 ? p == 0 : p > 0.035); /* none is starved, black ones are never picked */
    }
    assert_true(fabs(sum - 1) < 1e-6 && scene->lights[0].selection > 0.7f);
    tr_light_sample s; /* the ends of [0, 1) */
    assert_true(tr_light_sample_direction(scene, v3(0, 0, 0), 0, 0, 0, &s) && s.light == 0);
    assert_true(tr_light_sample_direction(scene, v3(0, 0, 0), 0x1.fffffep-1f, 0, 0, &s) && s.light == 5);
    tr_scene_free(scene);
}

static void extreme_random_numbers_stay_on_the_light(void **state)
{
    static const float ends[3] = {0, 0x1.fffffep-1f, 0x1p-24f};
    (void)state;
    tr_scene *scene = scene_new();
    add_rectangle(scene, 3, placed(v3(0, 2, 0), v3(1, 0, 0), 90, v3(1, 1, 1)));
    add_fan(scene, 2, true);
    add_sphere(scene, 2, v3(3, 1, 0.2f), 0.3f);
    add_cylinder(scene, 1, placed(v3(-1, 0.2f, -0.5f), v3(1, 0, 0), 10, v3(0.2f, 0.2f, 1)));
    add_envmap(scene, 8, 4, 1);
    scene_done(scene);
    for (int i = 0; i < 400 * 9; ++i) {
        tr_light_sample s;
        if (!tr_light_sample_direction(scene, v3(0, 0, 0), (float)(i / 9) / 400, ends[i % 3], ends[i / 3 % 3], &s))
            continue;
        assert_true(fabsf(len3(s.wi) - 1) < 1e-5f && s.pdf > 0 && isfinite(s.pdf) && s.distance > 0);
    }
    tr_scene_free(scene);
}

/* ---- >>environment ------------------------------------------------------------------------------------------ */

static void envmap_faces_the_way_mitsuba_has_it(void **state)
{
    /* Pixels 8 x 4: the left edge is -z, a quarter to the right is +x, the top is +y. */
    static const struct {
        int x, y;
        float u, v; /* turns from -z by +x, half turns from +y */
    } cases[] = {{0, 0, 0.0625f, 0.125f}, {1, 2, 0.1875f, 0.625f}, {5, 1, 0.6875f, 0.375f}, {7, 3, 0.9375f, 0.875f}};
    (void)state;
    for (size_t i = 0; i < 4; ++i) {
        tr_scene *scene = scene_new();
        tr_light *light = add_light(scene, TR_LIGHT_ENVMAP, 1);
        assert_true(tr_image_alloc(&light->image, 8, 4, 3));
        light->image.data[(cases[i].y * 8 + cases[i].x) * 3 + 1] = 2;
        scene_done(scene);
        double phi = 2 * PI * cases[i].u, theta = PI * cases[i].v;
        vec3 w = v3((float)(sin(theta) * sin(phi)), (float)cos(theta), (float)(-sin(theta) * cos(phi)));
        vec3 e = tr_environment(scene, w);
        assert_true(e.x == 0 && fabsf(e.y - 2) < 1e-5f && e.z == 0);
        tr_scene_free(scene);
    }
    for (int x = 0; x < 8; x += 7) { /* the left and right edges meet: -z sees half of the pixels on both sides */
        tr_scene *scene = scene_new();
        tr_light *light = add_light(scene, TR_LIGHT_ENVMAP, 1);
        assert_true(tr_image_alloc(&light->image, 8, 1, 3));
        light->image.data[x * 3] = 2;
        scene_done(scene);
        for (int side = -1; side < 2; ++side)
            assert_true(fabsf(tr_environment(scene, norm3(v3(1e-4f * (float)side, 0.3f, -1))).x - 1) < 1e-3f);
        tr_scene_free(scene);
    }
    tr_scene *scene = scene_new(); /* and a turn by 90 degrees about y takes +x to -z */
    tr_light *light = add_light(scene, TR_LIGHT_ENVMAP, 1);
    assert_true(tr_image_alloc(&light->image, 4, 2, 3));
    for (int y = 0; y < 2; ++y) /* the two columns beside +x */
        light->image.data[(y * 4 + 0) * 3] = light->image.data[(y * 4 + 1) * 3] = 1;
    turn(light, mat4_rotate(v3(0, 1, 0), 90));
    scene_done(scene);
    assert_true(fabsf(tr_environment(scene, v3(0, 0, -1)).x - 1) < 1e-5f);
    assert_true(tr_environment(scene, v3(0, 0, 1)).x < 1e-5f);
    tr_scene_free(scene);
}

static void envmap_with_bad_pixels_warns_and_still_samples(void **state)
{
    (void)state;
    tr_scene *scene = scene_new();
    tr_light *light = add_envmap(scene, 8, 4, 1);
    light->image.data[0] = NAN;
    light->image.data[1] = -1;
    light->image.data[2] = INFINITY;
    tr_log log = {0};
    assert_true(tr_scene_finish(scene, 1, &log));
    assert_int_equal(log.warnings, 1);
    assert_non_null(strstr(log.last, "3 values"));
    tr_rng rng = rng_seed(1, 0);
    for (int i = 0; i < 1000; ++i) {
        tr_light_sample s;
        float a = rng_float(&rng), b = rng_float(&rng);
        assert_true(tr_light_sample_direction(scene, v3(0, 0, 0), 0, a, b, &s));
        assert_true(finite3(s.radiance));
    }
    tr_scene_free(scene);
}

/* ---- >>sky -------------------------------------------------------------------------------------------------- */

static double perez_y(double t, double cos_theta, double gamma)
{
    double a = 0.1787 * t - 1.4630, b = -0.3554 * t + 0.4275, c = -0.0227 * t + 5.3251, d = 0.1206 * t - 2.5771,
           e = -0.0670 * t + 0.3703;
    return (1 + a * exp(b / cos_theta)) * (1 + c * exp(d * gamma) + e * cos(gamma) * cos(gamma));
}

static double luminance(const float *p) { return 0.2126 * p[0] + 0.7152 * p[1] + 0.0722 * p[2]; }

static void sky_luminance_follows_perez(void **state)
{
    static const float turbidities[3] = {2, 3, 6};
    (void)state;
    for (int k = 0; k < 3; ++k) {
        tr_sunsky d = sunsky_defaults();
        d.turbidity = turbidities[k];
        tr_light sky, sun;
        memset(&sky, 0, sizeof sky);
        memset(&sun, 0, sizeof sun);
        assert_true(tr_sunsky_lights(&d, &sky, &sun));
        const tr_image *m = &sky.image;
        double sum = 0, sum2 = 0;
        int n = 0;
        for (int y = 0; y < m->height; y += 7)
            for (int x = 0; x < m->width; x += 13) {
                double theta = (y + 0.5) / m->height * PI, phi = (x + 0.5) / m->width * 2 * PI;
                vec3 w = v3((float)(sin(theta) * sin(phi)), (float)cos(theta), (float)(-sin(theta) * cos(phi)));
                const float *p = m->data + ((size_t)y * (size_t)m->width + (size_t)x) * 3;
                assert_true(p[0] >= 0 && p[1] >= 0 && p[2] >= 0);
                if (y >= m->height / 2) { /* below the horizon */
                    assert_true(p[0] + p[1] + p[2] == 0);
                    continue;
                }
                double ratio = luminance(p) / perez_y(d.turbidity, cos(theta), acos(dot3(w, d.sun_direction)));
                sum += ratio;
                sum2 += ratio * ratio;
                ++n;
            }
        double mean = sum / n;
        assert_true(mean > 0 && sqrt(fmax(0, sum2 / n - mean * mean)) < 2e-3 * mean); /* one ratio everywhere */
        tr_image_free(&sky.image);
    }
}

/* Worked out by hand from the paper's zenith formulas at turbidity 2 and the sun 30 degrees from the zenith: 5.878
   kcd/m^2, x 0.2474, y 0.2510. */
static void zenith_has_the_papers_luminance_and_colour(void **state)
{
    tr_sunsky d = sunsky_defaults();
    tr_light sky, sun;
    (void)state;
    d.turbidity = 2;
    d.sun_direction = v3(0.5f, sqrtf(0.75f), 0);
    memset(&sky, 0, sizeof sky);
    memset(&sun, 0, sizeof sun);
    assert_true(tr_sunsky_lights(&d, &sky, &sun));
    const float *p = sky.image.data + (size_t)sky.image.width / 2 * 3;
    assert_true(fabs(luminance(p) * 72984 / 5878 - 1) < 0.01);
    /* back to xy by the inverse of the sRGB matrix (IEC 61966-2-1) */
    double x = 0.4124 * p[0] + 0.3576 * p[1] + 0.1805 * p[2], y = luminance(p),
           z = 0.0193 * p[0] + 0.1192 * p[1] + 0.9505 * p[2];
    double t = PI / 6;
    double xz = 4 * (0.00166 * t * t * t - 0.00375 * t * t + 0.00209 * t) +
                2 * (-0.02903 * t * t * t + 0.06377 * t * t - 0.03202 * t + 0.00394) +
                (0.11693 * t * t * t - 0.21196 * t * t + 0.06052 * t + 0.25886);
    double yz = 4 * (0.00275 * t * t * t - 0.00610 * t * t + 0.00317 * t) +
                2 * (-0.04214 * t * t * t + 0.08970 * t * t - 0.04153 * t + 0.00516) +
                (0.15346 * t * t * t - 0.26756 * t * t + 0.06670 * t + 0.26688);
    assert_true(fabs(x / (x + y + z) - xz) < 1e-3 && fabs(y / (x + y + z) - yz) < 1e-3);
    tr_image_free(&sky.image);
}

/* ---- >>sun -------------------------------------------------------------------------------------------------- */

static double elevation(vec3 w) { return asin(w.y) * 180 / PI; }
static double azimuth(vec3 w) /* from north by east */
{
    double a = atan2(w.x, -w.z) * 180 / PI;
    return a < 0 ? a + 360 : a;
}

static void sun_stands_where_almanacs_say(void **state)
{
    (void)state;
    /* the equator at noon of an equinox, 7.5 minutes before the sun is due south */
    vec3 w = tr_sun_direction(2010, 3, 20, 12, 7, 30, 0, 0, 0);
    assert_true(elevation(w) > 89.5);
    /* London, local noon of the June solstice: 90 - 51.507 + 23.438 degrees */
    w = tr_sun_direction(2010, 6, 21, 12, 2, 20, 51.5074f, -0.1278f, 0);
    assert_true(fabs(elevation(w) - 61.93) < 0.05 && fabs(azimuth(w) - 180) < 0.3);
    /* Sydney, noon of the December solstice: 90 - 33.869 + 23.438, to the north */
    w = tr_sun_direction(2010, 12, 22, 11, 53, 40, -33.8688f, 151.2093f, 10);
    assert_true(fabs(elevation(w) - 79.57) < 0.1 && (azimuth(w) < 2 || azimuth(w) > 358));
    /* six hours from noon at an equinox: on the horizon, due east and due west */
    w = tr_sun_direction(2010, 3, 20, 6, 7, 0, 0, 0, 0);
    assert_true(fabs(elevation(w)) < 0.3 && fabs(azimuth(w) - 90) < 0.3);
    w = tr_sun_direction(2010, 3, 20, 18, 7, 0, 0, 0, 0);
    assert_true(fabs(elevation(w)) < 0.3 && fabs(azimuth(w) - 270) < 0.3);
    /* Mitsuba's default place and day at 9:00: the sun's pixel in the sunsky map it baked for the kitchen scene */
    w = tr_sun_direction(2010, 7, 10, 9, 0, 0, 35.6894f, 139.6917f, 9);
    assert_true(fabs(azimuth(w) - 140.5 / 512 * 360) < 0.7 && fabs(90 - elevation(w) - 54.5 / 256 * 180) < 0.7);
}

/* Direct sunlight of a clear day is about 100 klx, redder and weaker the lower the sun and the hazier the air; the
   flux that Mitsuba baked for the kitchen scene (turbidity 5, the sun at 51.5 degrees): 1.104, 0.871, 0.667. */
static void sunlight_has_plausible_strength_and_colour(void **state)
{
    static const float heights[4] = {1, 0.5f, 0.2f, 0.05f};
    vec3 last = v3(INFINITY, 0, 1e30f);
    (void)state;
    for (int i = 0; i < 6; ++i) {
        tr_sunsky d = sunsky_defaults();
        float h = i < 4 ? heights[i] : i == 4 ? 0.7828f : -0.1f;
        d.turbidity = i == 4 ? 5 : 2;
        d.sun_direction = v3(sqrtf(1 - h * h), h, 0);
        tr_light sky, sun;
        memset(&sky, 0, sizeof sky);
        memset(&sun, 0, sizeof sun);
        assert_true(tr_sunsky_lights(&d, &sky, &sun));
        vec3 flux = scale3(sun.value, (float)(2 * PI * (1 - (double)sun.cutoff_cos)));
        if (i == 0) {
            float rgb[3] = {flux.x, flux.y, flux.z};
            double lux = luminance(rgb) * 72984;
            assert_true(lux > 90e3 && lux < 125e3);
        }
        if (i < 4) {
            assert_true(flux.x < last.x && (i == 0 || flux.z / flux.x < last.z / last.x));
            last = flux;
        } else if (i == 4) {
            assert_true(fabsf(flux.x / 1.104f - 1) < 0.05f && fabsf(flux.y / 0.871f - 1) < 0.05f &&
                        fabsf(flux.z / 0.667f - 1) < 0.15f);
        } else {
            assert_true(black3(sun.value)); /* it has set; the sky is that of sunset */
        }
        for (int k = 0; k < 3 * sky.image.width * sky.image.height; ++k)
            assert_true(sky.image.data[k] >= 0 && isfinite(sky.image.data[k]));
        tr_image_free(&sky.image);
    }
}

static void sun_and_sky_turn_together(void **state)
{
    tr_sunsky d = sunsky_defaults();
    (void)state;
    d.to_world = mat4_rotate(v3(1, 0.5f, 0), 70);
    tr_scene *scene = scene_new();
    add_sunsky(scene, &d, true);
    scene_done(scene);
    vec3 w = norm3(xform_vector(&d.to_world, d.sun_direction)), beside = norm3(add3(w, v3(0.02f, 0, 0.01f))),
         sun = scene->lights[0].value;
    assert_true(tr_environment(scene, w).x > sun.x);
    float near_sun = tr_environment(scene, beside).x;
    assert_true(near_sun < 0.01f * sun.x);
    tr_rng rng = rng_seed(1, 2);
    for (int i = 0; i < 1000; ++i) {
        float a = rng_float(&rng), b = rng_float(&rng);
        vec3 v = sample_uniform_sphere(a, b), e = tr_environment(scene, v);
        if (dot3(v, w) < 0.999f)
            assert_true(e.x <= near_sun * 1.05f);
        if (xform_vector(&scene->lights[1].to_local, v).y < -0.01f)
            assert_true(black3(e));
    }
    tr_scene_free(scene);
}

/* ---- >>misuse ----------------------------------------------------------------------------------------------- */

static void a_scene_without_light_gives_no_sample(void **state)
{
    (void)state;
    tr_light_sample s;
    for (int i = 0; i < 3; ++i) {
        tr_scene *scene = scene_new();
        tr_log log = {0};
        if (i == 1)
            add_light(scene, TR_LIGHT_CONSTANT, 0);
        if (i == 2)
            for (int k = 0; k < 24; ++k)
                add_envmap(scene, 4, 2, 0)->image.data[k] = 0;
        for (int k = 0; k < scene->light_count; ++k)
            for (int j = 0; i == 2 && j < 24; ++j)
                scene->lights[k].image.data[j] = 0;
        assert_true(tr_scene_finish(scene, 1, &log));
        assert_false(tr_light_sample_direction(scene, v3(0, 0, 0), 0.5f, 0.5f, 0.5f, &s));
        assert_true(tr_light_pdf(scene, v3(0, 0, 0), v3(0, 1, 0), NULL) == 0);
        assert_true(black3(tr_environment(scene, v3(0, 1, 0))));
        tr_scene_free(scene);
    }
}

static void hostile_points_give_no_bad_numbers(void **state)
{
    static const float odd[] = {0, NAN, INFINITY, 1e30f, -1e-30f, 2};
    (void)state;
    tr_scene *scene = scene_new();
    add_rectangle(scene, 3, placed(v3(0, 2, 0), v3(1, 0, 0), 90, v3(1, 1, 1)));
    add_sphere(scene, 2, v3(0, 0, 0), 1);
    add_light(scene, TR_LIGHT_POINT, 3);
    add_envmap(scene, 8, 4, 1);
    scene_done(scene);
    tr_rng rng = rng_seed(1, 2);
    for (int i = 0; i < 216 * 20; ++i) {
        vec3 p = v3(odd[i % 6], odd[i / 6 % 6], odd[i / 36 % 6]);
        tr_light_sample s;
        float a = rng_float(&rng), b = rng_float(&rng), c = rng_float(&rng);
        if (tr_light_sample_direction(scene, p, a, b, c, &s))
            assert_true(s.pdf > 0 && isfinite(s.pdf) && finite3(s.wi) && finite3(s.radiance));
        tr_surface surface;
        memset(&surface, 0, sizeof surface);
        surface.ng = v3(0, -1, 0);
        surface.shape = i & 1;
        float pdf = tr_light_pdf(scene, p, v3(0, 1, 0), &surface);
        assert_true(pdf >= 0 && isfinite(pdf));
    }
    tr_scene_free(scene);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(rectangle_directions_follow_the_density),
        cmocka_unit_test(mesh_directions_follow_the_density),
        cmocka_unit_test(sphere_directions_follow_the_density),
        cmocka_unit_test(spheres_are_dark_on_their_backs),
        cmocka_unit_test(disk_directions_follow_the_density),
        cmocka_unit_test(cylinder_directions_follow_the_density),
        cmocka_unit_test(environment_directions_follow_the_density),
        cmocka_unit_test(sun_directions_follow_the_density),
        cmocka_unit_test(directions_of_a_mixture_follow_the_density),
        cmocka_unit_test(disk_above_a_plane),
        cmocka_unit_test(sphere_above_a_plane),
        cmocka_unit_test(rectangle_above_a_plane),
        cmocka_unit_test(constant_light_and_constant_map_agree),
        cmocka_unit_test(sun_irradiance_is_that_of_its_disk),
        cmocka_unit_test(point_light_falls_off_with_the_square),
        cmocka_unit_test(spot_light_falls_off_linearly_in_the_angle),
        cmocka_unit_test(directional_light_is_the_same_everywhere),
        cmocka_unit_test(lights_are_picked_as_selection_says),
        cmocka_unit_test(extreme_random_numbers_stay_on_the_light),
        cmocka_unit_test(envmap_faces_the_way_mitsuba_has_it),
        cmocka_unit_test(envmap_with_bad_pixels_warns_and_still_samples),
        cmocka_unit_test(sky_luminance_follows_perez),
        cmocka_unit_test(zenith_has_the_papers_luminance_and_colour),
        cmocka_unit_test(sun_stands_where_almanacs_say),
        cmocka_unit_test(sunlight_has_plausible_strength_and_colour),
        cmocka_unit_test(sun_and_sky_turn_together),
        cmocka_unit_test(a_scene_without_light_gives_no_sample),
        cmocka_unit_test(hostile_points_give_no_bad_numbers),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
