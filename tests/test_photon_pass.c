/* test_photon_pass.c: photons against the outside. The flux on a receiver is counted, without a kernel, and compared
   with closed forms, with quadrature over the lights' surfaces and directions, and with the path tracer's picture of
   the receiver.

     >>rig >>shapes >>count >>camera >>lights >>power >>transport >>energy >>records >>identical
     >>emission >>adjoint >>method >>misuse */
#include "cmocka_prelude.h"

#include <stdlib.h>
#include <string.h>

#include "bsdf_micro.h"
#include "emission.h"
#include "scale.h"
#include "scene_internal.h"
#include "threads.h"

#define PI 3.14159265358979323846

/* ---- >>rig -------------------------------------------------------------------------------------------------- */

enum { GRAY }; /* first bsdf of every scene: diffuse, albedo 0.5 */

static tr_scene *scene_new(void)
{
    tr_scene *s = tr_scene_new();
    assert_non_null(s);
    assert_int_equal(tr_scene_add_bsdf(s, TR_BSDF_DIFFUSE), GRAY);
    s->filter = TR_FILTER_BOX;
    s->width = s->height = 16;
    return s;
}

static void scene_done(tr_scene *s)
{
    tr_log log = {0};
    if (!tr_scene_finish(s, 1, &log))
        fail_msg("%s", log.last);
}

static int add_bsdf(tr_scene *s, tr_bsdf_type type)
{
    int id = tr_scene_add_bsdf(s, type);
    assert_true(id >= 0);
    return id;
}

static tr_light *add_light(tr_scene *s, tr_light_type type, vec3 value)
{
    int id = tr_scene_add_light(s, type);
    assert_true(id >= 0);
    tr_light *l = &s->lights[id];
    l->value = value;
    l->to_world = l->to_local = mat4_identity();
    return l;
}

static tr_light *add_point(tr_scene *s, vec3 intensity, vec3 position)
{
    tr_light *l = add_light(s, TR_LIGHT_POINT, intensity);
    l->position = position;
    return l;
}

static tr_light *add_spot(tr_scene *s, vec3 intensity, vec3 position, vec3 direction, double cutoff, double beam)
{
    tr_light *l = add_light(s, TR_LIGHT_SPOT, intensity);
    l->position = position;
    l->direction = norm3(direction);
    l->cutoff_cos = (float)cos(cutoff * PI / 180);
    l->beam_cos = (float)cos(beam * PI / 180);
    return l;
}

/* ---- >>shapes ----------------------------------------------------------------------------------------------- */

static tr_shape *add_shape(tr_scene *s, int bsdf)
{
    int id = tr_scene_add_shape(s);
    assert_true(id >= 0);
    s->shapes[id].bsdf = bsdf;
    s->shapes[id].light = -1;
    return &s->shapes[id];
}

static void shine(tr_scene *s, tr_shape *shape, vec3 radiance)
{
    shape->light = (int)(add_light(s, TR_LIGHT_AREA, radiance) - s->lights);
    s->lights[shape->light].shape = (int)(shape - s->shapes);
}

static mat4 placed(vec3 translate, vec3 axis, float degrees, vec3 scale)
{
    mat4 t = mat4_translate(translate), r = mat4_rotate(axis, degrees), z = mat4_scale(scale), tr = mat4_mul(&t, &r);
    return mat4_mul(&tr, &z);
}

/* Faces down for `degrees` 90 around x, up for -90. */
static tr_shape *add_rectangle(tr_scene *s, int bsdf, vec3 at, float degrees, float half_x, float half_y)
{
    mat4 m = placed(at, v3(1, 0, 0), degrees, v3(half_x, half_y, 1));
    tr_shape *shape = add_shape(s, bsdf);
    assert_true(tr_shape_rectangle(shape, &m));
    return shape;
}

static tr_shape *add_floor(tr_scene *s, float half) { return add_rectangle(s, GRAY, v3s(0), -90, half, half); }

static tr_shape *add_sphere(tr_scene *s, int bsdf, vec3 center, float radius)
{
    mat4 identity = mat4_identity();
    bool tessellated;
    tr_shape *shape = add_shape(s, bsdf);
    assert_true(tr_shape_sphere(shape, &identity, center, radius, &tessellated));
    assert_false(tessellated);
    return shape;
}

/* A closed box from (-1, 0, -1) to (1, 2, 1) that looks inwards. */
static tr_shape *add_room(tr_scene *s, int bsdf)
{
    mat4 m = mat4_translate(v3(0, 1, 0));
    tr_shape *shape = add_shape(s, bsdf);
    assert_true(tr_shape_cube(shape, &m));
    shape->flip_normals = true;
    return shape;
}

/* ---- >>count ------------------------------------------------------------------------------------------------ */

/* The receiver: the floor y = 0 within |x|, |z| <= half, or within the disk of that radius. */
typedef struct receiver {
    double half;
    bool disk;
    uint32_t flags_out; /* photons with one of these are not counted */
    bool by_shading_normal;
    double flux[3];
} receiver;

static bool count(void *user, int tile, const tr_photon *photons, int n)
{
    receiver *r = user;
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_photon *p = &photons[i];
        double x = p->p.x, z = p->p.z;
        bool inside = r->disk ? x * x + z * z <= r->half * r->half : fabs(x) <= r->half && fabs(z) <= r->half;
        if (fabsf(p->p.y) > 1e-4f || !inside || (p->flags & r->flags_out))
            continue;
        double weight = r->by_shading_normal ? fabs((double)dot3(p->ns, p->wi) / dot3(p->ng, p->wi)) : 1;
        r->flux[0] += weight * p->flux.x;
        r->flux[1] += weight * p->flux.y;
        r->flux[2] += weight * p->flux.z;
    }
    return true;
}

static const tr_emission_map *the_emission; /* of all passes; NULL: even */

static tr_photon_pass pass_of(const tr_scene *s, uint32_t paths, int depth, bool nee)
{
    tr_photon_pass p = {.scene = s, .seed = 1, .total = paths, .count = paths, .max_depth = depth, .nee = nee};
    p.emission = the_emission;
    return p;
}

typedef struct estimate {
    double mean[3], sigma[3];
} estimate;

/* Passes are independent: their spread is the estimate's. */
enum { PASSES = 32 };

static estimate photon_flux(const tr_scene *s, receiver r, uint32_t paths, int depth, bool nee)
{
    estimate e = {{0}, {0}};
    double squares[3] = {0, 0, 0};
    static uint64_t seed; /* another one for each estimate: else all would be off alike */
    ++seed;
    for (int k = 0; k < PASSES; ++k) {
        tr_photon_pass pass = pass_of(s, LESS(paths), depth, nee);
        tr_photon_stats stats = {0};
        receiver here = r;
        pass.index = k;
        pass.seed = seed;
        assert_true(tr_trace_photons(&pass, count, &here, &stats));
        assert_int_equal(stats.bad, 0);
        for (int c = 0; c < 3; ++c) {
            e.mean[c] += here.flux[c] / PASSES;
            squares[c] += here.flux[c] * here.flux[c] / PASSES;
        }
    }
    for (int c = 0; c < 3; ++c)
        e.sigma[c] = sqrt(fmax(0, squares[c] - e.mean[c] * e.mean[c]) / (PASSES - 1));
    return e;
}

/* 31 degrees of freedom: |t| > 4.5 once in 10,000. The floor is for what floats round. */
static void check(const char *what, estimate a, estimate b)
{
    for (int c = 0; c < 3; ++c) {
        double difference = a.mean[c] - b.mean[c], sigma = hypot(a.sigma[c], b.sigma[c]);
        if (c == 0)
            print_message("%-28s %.6g against %.6g, sigma %.2f %%, z %.2f\n", what, a.mean[c], b.mean[c],
                          100 * sigma / fabs(b.mean[c] + 1e-300), difference / (sigma + 1e-300));
        if (!(fabs(difference) <= 4.5 * sigma + 2e-4 * fabs(b.mean[c])))
            fail_msg("%s, channel %d: %g +- %g against %g +- %g", what, c, a.mean[c], a.sigma[c], b.mean[c],
                     b.sigma[c]);
    }
}

static estimate exactly(vec3 value, double factor)
{
    estimate e = {{value.x * factor, value.y * factor, value.z * factor}, {0, 0, 0}};
    return e;
}

/* ---- >>camera ----------------------------------------------------------------------------------------------- */

/* The flux on the square |x|, |z| <= half of a gray floor from its picture, taken from `height` above: the pixels of a
   plane across the view are of one size. */
static estimate camera_flux(tr_scene *s, double half, double height, int spp, int depth, bool nee)
{
    s->camera.to_world = (mat4){{{1, 0, 0, 0}, {0, 0, -1, (float)height}, {0, 1, 0, 0}, {0, 0, 0, 1}}};
    s->camera.fov = (float)(2 * atan(half / height) * 180 / PI);
    s->camera.fov_axis = 0;
    tr_settings settings = {
        .width = 16, .height = 16, .spp = LESS(spp), .max_depth = depth, .no_nee = !nee, .threads = 2};
    settings.method = tr_method_find("pt");
    tr_result r;
    char err[256] = "";
    if (!tr_render(s, &settings, &r, err, sizeof err))
        fail_msg("%s", err);
    estimate e = {{0}, {0}};
    double factor = 4 * half * half * PI / 0.5 / 256;
    for (size_t i = 0; i < 256; ++i)
        for (int c = 0; c < 3; ++c) {
            e.mean[c] += factor * r.color.data[3 * i + (size_t)c];
            e.sigma[c] += factor * factor * r.variance.data[3 * i + (size_t)c];
        }
    for (int c = 0; c < 3; ++c)
        e.sigma[c] = sqrt(e.sigma[c]);
    tr_result_free(&r);
    return e;
}

/* Photons and pictures of one square. */
static void agree(const char *what, tr_scene *s, receiver r, uint32_t paths, int spp, int depth, bool nee)
{
    double height = r.by_shading_normal ? 2.5 : 0.2; /* normals that lean have no front where they lean away */
    scene_done(s);
    estimate photons = photon_flux(s, r, paths, depth, nee);
    check(what, photons, camera_flux(s, r.half, height, spp, depth, nee));
    tr_scene_free(s);
}

/* ---- >>lights ----------------------------------------------------------------------------------------------- */

static const vec3 WARM = {3, 2, 0.5f};

/* A speck, too small to shade anything, for a bounding box with sides. */
static void add_speck(tr_scene *s) { add_sphere(s, GRAY, v3(1.5f, 2.5f, -2), 1e-3f); }

/* Direct light alone: two edges. */
static void check_direct(const char *what, tr_scene *s, double half, bool disk, uint32_t paths, estimate expected)
{
    receiver r = {.half = half, .disk = disk};
    scene_done(s);
    check(what, photon_flux(s, r, paths, 2, true), expected);
    tr_scene_free(s);
}

/* A point of a light's surface and its two derivatives, by (u, v) in the unit square. */
typedef void (*patch_fn)(double u, double v, double p[3], double du[3], double dv[3]);

/* Form factor integral of a convex patch over the floor's disk: midpoint rule over both, per unit of radiance. */
static double patch_flux(patch_fn patch, double radius)
{
    enum { N = 48, M = 24 };
    double sum = 0;
    for (int i = 0; i < N * N; ++i) {
        double p[3], a[3], b[3];
        patch((i % N + 0.5) / N, (i / N + 0.5) / N, p, a, b);
        double n[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
        for (int j = 0; j < M * M; ++j) {
            double r = radius * sqrt((j % M + 0.5) / M), phi = 2 * PI * (j / M + 0.5) / M;
            double d[3] = {r * cos(phi) - p[0], -p[1], r * sin(phi) - p[2]};
            double d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2], out = n[0] * d[0] + n[1] * d[1] + n[2] * d[2];
            sum += out > 0 && d[1] < 0 ? out * -d[1] / (d2 * d2) : 0;
        }
    }
    return sum * PI * radius * radius / (N * N * (double)(M * M));
}

static void disk_light_shines_on_a_disk(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    mat4 m = placed(v3(0, 2, 0), v3(1, 0, 0), 90, v3s(1.5f));
    add_floor(s, 4);
    tr_shape *light = add_shape(s, GRAY);
    assert_true(tr_shape_disk(light, &m));
    shine(s, light, WARM);
    double r1 = 1.5 / 2, r2 = 0.8 / 2, x = 1 + (1 + r2 * r2) / (r1 * r1); /* coaxial disks */
    double factor = 0.5 * (x - sqrt(x * x - 4 * (r2 / r1) * (r2 / r1)));
    check_direct("disk", s, 0.8, true, 1 << 15, exactly(WARM, PI * PI * 1.5 * 1.5 * factor));
}

static void sphere_light_shines_on_a_disk(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 4);
    shine(s, add_sphere(s, GRAY, v3(0, 2, 0), 0.7f), WARM);
    double factor = 0.5 * (1 - 1 / sqrt(1 + 0.25)); /* to a coaxial disk of radius 1 */
    check_direct("sphere", s, 1, true, 1 << 15, exactly(WARM, 4 * PI * PI * 0.49 * factor));
}

static void rectangle_light_shines_on_its_like(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 1);
    shine(s, add_rectangle(s, GRAY, v3(0, 2, 0), 90, 1, 1), WARM);
    double x = 1, y = 1, p = sqrt(1 + y * y), q = sqrt(1 + x * x); /* two equal, parallel, aligned squares */
    double factor = 2 / (PI * x * y) *
                    (0.5 * log((1 + x * x) * (1 + y * y) / (1 + x * x + y * y)) + x * p * atan(x / p) +
                     y * q * atan(y / q) - x * atan(x) - y * atan(y));
    check_direct("rectangle", s, 1, false, 1 << 15, exactly(WARM, PI * 4 * factor));
}

/* Lying along x, squeezed to an ellipse: 0.3 across, 0.6 high. */
static void cylinder_patch(double u, double v, double p[3], double du[3], double dv[3])
{
    double phi = -2 * PI * u, c = cos(phi), n = sin(phi); /* so that du x dv points out */
    p[0] = 2 * v - 1, p[1] = 1.5 + 0.6 * n, p[2] = 0.3 * c;
    du[0] = 0, du[1] = -2 * PI * 0.6 * c, du[2] = 2 * PI * 0.3 * n;
    dv[0] = 2, dv[1] = dv[2] = 0;
}

static void squeezed_cylinder_light_shines_on_a_disk(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 4);
    tr_shape *light = add_shape(s, GRAY);
    light->type = TR_SHAPE_CYLINDER;
    light->object_to_world = mat4_columns(v3(0, 0.6f, 0), v3(0, 0, 0.3f), v3(2, 0, 0), v3(-1, 1.5f, 0));
    assert_true(tr_shape_complete(light));
    shine(s, light, WARM);
    check_direct("squeezed cylinder", s, 1, true, 1 << 15, exactly(WARM, patch_flux(cylinder_patch, 1)));
}

static void point_light_shines_on_a_disk(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 4);
    add_point(s, WARM, v3(0, 1.5f, 0));
    check_direct("point", s, 1, true, 1 << 15, exactly(WARM, 2 * PI * (1 - 1.5 / sqrt(1.5 * 1.5 + 1))));
}

/* A point light far outside of the scene's bounds. */
static void point_light_outside_of_the_bounds(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 2);
    add_point(s, WARM, v3(0, 20, 0));
    check_direct("point far away", s, 2, true, 1 << 18, exactly(WARM, 2 * PI * (1 - 20 / sqrt(404.0))));
}

/* Off its axis, so that the falloff counts; by quadrature over the disk. */
static void check_spot(const char *what, double cutoff, double beam, vec3 at, vec3 target, double radius)
{
    enum { N = 800 };
    tr_scene *s = scene_new();
    add_floor(s, 4);
    vec3 axis = norm3(sub3(target, at));
    add_spot(s, WARM, at, axis, cutoff, beam);
    double sum = 0;
    for (int i = 0; i < N * N; ++i) {
        double r = radius * sqrt((i % N + 0.5) / N), phi = 2 * PI * (i / N + 0.5) / N;
        double d[3] = {r * cos(phi) - at.x, -at.y, r * sin(phi) - at.z};
        double d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2], l = sqrt(d2);
        double angle = acos(fmin(1, (d[0] * axis.x + d[1] * axis.y + d[2] * axis.z) / l)) * 180 / PI;
        double falloff = angle <= beam ? 1 : angle >= cutoff ? 0 : (cutoff - angle) / (cutoff - beam);
        sum += falloff * at.y / (l * d2);
    }
    check_direct(what, s, radius, true, 1 << 15, exactly(WARM, sum * PI * radius * radius / (N * (double)N)));
}

static void spot_light_shines_on_a_disk(void **state)
{
    (void)state;
    check_spot("spot", 30, 20, v3(0.5f, 2, 0.2f), v3(0, 0, 0.4f), 0.8);
    check_spot("spot of 100 degrees", 100, 5, v3(0, 1, 0), v3(0.3f, 1, 0), 1);
}

static void spot_of_one_degree(void **state)
{
    (void)state;
    check_spot("spot of 1 degree", 1, 0.75, v3(0, 3, 0), v3(0.02f, 0, 0), 0.05);
}

static void directional_light_shines_on_a_square(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 1);
    add_speck(s);
    add_light(s, TR_LIGHT_DIRECTIONAL, WARM)->direction = v3(1, -2, 0.5f);
    check_direct("directional", s, 1, false, 1 << 15, exactly(WARM, 4 * 2 / sqrt(5.25)));
}

static void sun_shines_on_a_square(void **state)
{
    (void)state;
    for (int wide = 0; wide < 2; ++wide) {
        tr_scene *s = scene_new();
        add_floor(s, 1);
        add_speck(s);
        tr_light *l = add_light(s, TR_LIGHT_SUN, WARM);
        l->direction = v3(1, -2, 0.5f);
        l->cutoff_cos = wide ? 0.9f : (float)cos(0.005); /* the wide one still stays above the horizon */
        double sine2 = (1 - (double)l->cutoff_cos) * (1 + (double)l->cutoff_cos);
        check_direct(wide ? "wide sun" : "sun", s, 1, false, 1 << 15, exactly(WARM, 4 * PI * sine2 * 2 / sqrt(5.25)));
    }
}

static void constant_light_shines_on_a_square(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 1);
    add_speck(s);
    add_light(s, TR_LIGHT_CONSTANT, WARM);
    check_direct("constant", s, 1, false, 1 << 15, exactly(WARM, 4 * PI));
}

/* Irradiance on the floor from all of the environment but suns, by quadrature. */
static estimate environment_flux(const tr_scene *s, double area)
{
    enum { N = 1500 };
    estimate e = {{0}, {0}};
    for (int i = 0; i < N * N; ++i) {
        double y = (i % N + 0.5) / N, phi = 2 * PI * (i / N + 0.5) / N, r = sqrt(1 - y * y);
        vec3 L = tr_environment(s, v3((float)(r * cos(phi)), (float)y, (float)(r * sin(phi))));
        e.mean[0] += L.x * y, e.mean[1] += L.y * y, e.mean[2] += L.z * y;
    }
    for (int c = 0; c < 3; ++c)
        e.mean[c] *= area * 2 * PI / (N * (double)N);
    return e;
}

static tr_light *add_envmap(tr_scene *s, uint64_t seed)
{
    tr_light *l = add_light(s, TR_LIGHT_ENVMAP, v3s(1));
    assert_true(tr_image_alloc(&l->image, 12, 6, 3));
    tr_rng rng = rng_seed(seed, 0);
    for (int i = 0; i < 12 * 6 * 3; ++i) /* many black pixels, a few bright ones */
        l->image.data[i] = rng_float(&rng) < 0.4f ? 0 : expf(3 * rng_float(&rng));
    l->to_world = placed(v3s(0), v3(1, 2, 3), 50, v3(1, 1, 1));
    assert_true(mat4_inverse(&l->to_world, &l->to_local));
    return l;
}

static void envmap_shines_on_a_square(void **state)
{
    (void)state;
    for (int squeezed = 0; squeezed < 2; ++squeezed) {
        tr_scene *s = scene_new();
        add_floor(s, 1);
        add_speck(s);
        tr_light *l = add_envmap(s, 7);
        if (squeezed) {
            l->to_world = placed(v3s(0), v3(1, 2, 3), 50, v3(1, 2, 0.7f));
            assert_true(mat4_inverse(&l->to_world, &l->to_local));
        }
        scene_done(s);
        receiver r = {.half = 1};
        check(squeezed ? "squeezed envmap" : "envmap", photon_flux(s, r, 1 << 15, 2, true), environment_flux(s, 4));
        tr_scene_free(s);
    }
}

static void sunsky_shines_on_a_square(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 1);
    add_speck(s);
    int sky = tr_scene_add_light(s, TR_LIGHT_ENVMAP), sun = tr_scene_add_light(s, TR_LIGHT_SUN);
    tr_sunsky desc = {.turbidity = 3,
                      .sun_direction = norm3(v3(1, 1, 0.5f)),
                      .sky_scale = 1,
                      .sun_scale = 1,
                      .sun_radius_scale = 1,
                      .to_world = mat4_identity()};
    assert_true(tr_sunsky_lights(&desc, &s->lights[sky], &s->lights[sun]));
    vec3 sun_value = s->lights[sun].value;
    double cutoff = s->lights[sun].cutoff_cos, sine2 = (1 - cutoff) * (1 + cutoff), y = desc.sun_direction.y;
    scene_done(s);
    s->environment_count = 1; /* quadrature would miss the sun or meet it by chance */
    estimate expected = environment_flux(s, 4), rest = exactly(sun_value, 4 * PI * sine2 * y);
    s->environment_count = 2;
    for (int c = 0; c < 3; ++c)
        expected.mean[c] += rest.mean[c];
    receiver r = {.half = 1};
    check("sunsky", photon_flux(s, r, 1 << 15, 2, true), expected);
    tr_scene_free(s);
}

/* ---- >>power ------------------------------------------------------------------------------------------------ */

/* What all paths begin with is the power of all lights, here of every type at once; each light's share is its own. */
static void lights_emit_their_power(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    mat4 m = placed(v3(0, 2, 0), v3(1, 0, 0), 90, v3s(1.5f));
    add_floor(s, 1);
    tr_shape *disk = add_shape(s, GRAY);
    assert_true(tr_shape_disk(disk, &m));
    shine(s, disk, WARM);
    shine(s, add_sphere(s, GRAY, v3(0, 1, 0), 0.5f), v3(0, 0, 7));
    add_point(s, v3(1, 5, 2), v3(9, 9, 9));
    add_spot(s, v3(300, 1, 1), v3(0, 1, 0), v3(0, -1, 0.5f), 30, 10);
    tr_light *directional = add_light(s, TR_LIGHT_DIRECTIONAL, v3(1, 0, 2));
    directional->direction = v3(0, -1, 0);
    add_light(s, TR_LIGHT_CONSTANT, v3(0.1f, 0.2f, 0.3f));
    tr_light *sun = add_light(s, TR_LIGHT_SUN, v3(400, 300, 200));
    sun->direction = v3(0, -1, 0);
    sun->cutoff_cos = 0.999f;
    add_point(s, v3s(0), v3s(0)); /* black */
    scene_done(s);
    /* Distant lights shine through the bounding box: 3 x 3 across, 2 high. A convex body's mean shadow is a quarter of
       its surface (Cauchy). The sun's cone is narrow: the sides add half the mean sine of its directions. */
    double c = 30 * PI / 180, b = 10 * PI / 180, sun_cos = 0.999, alpha = acos(sun_cos);
    double sun_shadow = 9 * 0.5 * (1 - sun_cos * sun_cos) +
                        2 * 6 * 2 / PI * 0.5 * (alpha - sin(alpha) * cos(alpha)); /* integral over cosine, /2 pi */
    double factor[8] = {PI * PI * 2.25,
                        4 * PI * PI * 0.25,
                        4 * PI,
                        2 * PI * (1 - (sin(c) - sin(b)) / (c - b)), /* the falloff over the cone, by parts */
                        9,
                        PI * (2 * 9 + 4 * 6),
                        2 * PI * sun_shadow,
                        0};
    enum { N = 1 << 20 };
    double sum[8][3] = {{0}}, squares[8][3] = {{0}};
    tr_rng rng = rng_seed(3, 3);
    for (int i = 0; i < N; ++i) {
        tr_emission e;
        float u[5];
        for (int k = 0; k < 5; ++k)
            u[k] = rng_float(&rng);
        if (!tr_light_emit(s, u, &e))
            continue;
        const double flux[3] = {e.flux.x, e.flux.y, e.flux.z};
        assert_true(fabsf(len3(e.direction) - 1) < 1e-5f);
        for (int k = 0; k < 3; ++k) {
            sum[e.light][k] += flux[k];
            squares[e.light][k] += flux[k] * flux[k];
        }
    }
    for (int l = 0; l < s->light_count; ++l) {
        estimate e, truth = exactly(s->lights[l].value, factor[l]);
        for (int k = 0; k < 3; ++k) {
            e.mean[k] = sum[l][k] / N;
            e.sigma[k] = sqrt((squares[l][k] / N - e.mean[k] * e.mean[k]) / N);
        }
        check("power", e, truth);
    }
    tr_scene_free(s);
}

/* A single light that emits evenly: every path carries the same, so the sum is exact. */
static void emitted_power_is_exact(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    shine(s, add_sphere(s, GRAY, v3(0, 1, 0), 0.5f), WARM);
    scene_done(s);
    tr_photon_pass pass = pass_of(s, 1000, 2, true);
    tr_photon_stats stats = {0};
    receiver r = {0};
    assert_true(tr_trace_photons(&pass, count, &r, &stats));
    assert_int_equal(stats.paths, 1000);
    assert_true(fabs(stats.emitted[0] - 3 * PI * PI) < 1e-4 * 3 * PI * PI);
    assert_true(fabs(stats.emitted[2] - 0.5 * PI * PI) < 1e-4 * 0.5 * PI * PI);
    assert_memory_equal(stats.emitted, stats.escaped, sizeof stats.emitted); /* a convex light sees nothing */
    tr_scene_free(s);
}

/* ---- >>transport -------------------------------------------------------------------------------------------- */

/* A lamp over the floor, and what lies between; seen by paths without NEE. */
static tr_scene *under_a_lamp(void)
{
    tr_scene *s = scene_new();
    add_floor(s, 2);
    shine(s, add_rectangle(s, GRAY, v3(0, 3, 0), 90, 0.7f, 0.7f), WARM);
    return s;
}

static void glass_ball(void **state)
{
    (void)state;
    tr_scene *s = under_a_lamp();
    add_sphere(s, add_bsdf(s, TR_BSDF_DIELECTRIC), v3(0, 1, 0), 0.6f);
    receiver r = {.half = 0.5};
    agree("glass ball", s, r, 1 << 15, 512, 10, false);
}

static void rough_glass_ball(void **state)
{
    (void)state;
    for (int k = 0; k < 2; ++k) {
        tr_scene *s = under_a_lamp();
        int b = add_bsdf(s, TR_BSDF_ROUGHDIELECTRIC);
        s->bsdfs[b].alpha.value = v3s(k ? 0.4f : 0.1f);
        s->bsdfs[b].distribution = k ? TR_GGX : TR_BECKMANN;
        add_sphere(s, b, v3(0, 1, 0), 0.6f);
        receiver r = {.half = 0.5};
        agree(k ? "rough glass ball, GGX" : "rough glass ball", s, r, 1 << 15, 512, 10, false);
    }
}

/* A slab that lies over the floor: the light also goes to and fro between both. */
static void glass_slab(void **state)
{
    (void)state;
    tr_scene *s = under_a_lamp();
    mat4 m = placed(v3(0, 1, 0), v3(1, 0, 0), 20, v3(1.5f, 0.1f, 1.5f));
    tr_shape *slab = add_shape(s, add_bsdf(s, TR_BSDF_DIELECTRIC));
    assert_true(tr_shape_cube(slab, &m));
    receiver r = {.half = 0.5};
    agree("glass slab", s, r, 1 << 15, 512, 10, false);
}

/* The floor lies in the denser medium, under one rough or smooth face: radiance gathers there, flux does not. */
static void under_water(void **state)
{
    (void)state;
    for (int rough = 0; rough < 2; ++rough) {
        tr_scene *s = under_a_lamp();
        int b = add_bsdf(s, rough ? TR_BSDF_ROUGHDIELECTRIC : TR_BSDF_DIELECTRIC);
        s->bsdfs[b].alpha.value = v3s(0.2f);
        add_rectangle(s, b, v3(0, 1, 0), -90, 2, 2);
        receiver r = {.half = 0.5};
        agree(rough ? "under rough water" : "under water", s, r, 1 << 14, 512, 10, false);
    }
}

/* A wall that light reaches by way of whatever `bsdf` the floor's middle has: light from above, but the camera sees
   only a gray floor behind a blind. Rough, glossy and coated surfaces in turn, both sides of twosided ones. */
static void reflected_by(const char *what, tr_bsdf_type type, bool bumped, bool masked)
{
    tr_scene *s = scene_new();
    add_floor(s, 0.6f);
    int b = add_bsdf(s, type);
    s->bsdfs[b].distribution = TR_GGX;
    s->bsdfs[b].alpha.value = v3s(0.3f);
    if (bumped) {
        int t = tr_scene_add_texture(s), outer = add_bsdf(s, TR_BSDF_BUMPMAP);
        s->textures[t].type = TR_TEXTURE_BITMAP;
        s->textures[t].wrap = TR_WRAP_REPEAT;
        s->textures[t].uv[0][0] = s->textures[t].uv[1][1] = 1;
        assert_true(tr_image_alloc(&s->textures[t].image, 16, 16, 3));
        tr_rng rng = rng_seed(5, 5);
        for (int i = 0; i < 16 * 16; ++i)
            s->textures[t].image.data[3 * i] = s->textures[t].image.data[3 * i + 1] =
                s->textures[t].image.data[3 * i + 2] = rng_float(&rng);
        s->bsdfs[outer].bump_texture = t;
        s->bsdfs[outer].bump_scale = 0.15f;
        s->bsdfs[outer].child[0] = b;
        b = outer;
    }
    if (masked) {
        int outer = add_bsdf(s, TR_BSDF_MASK);
        s->bsdfs[outer].opacity.value = v3s(0.6f);
        s->bsdfs[outer].child[0] = b;
        b = outer;
    }
    /* Two plates beside the floor, gray walls behind them; above it, out of its sight, two lamps that face the plates.
     */
    for (int side = -1; side <= 1; side += 2) {
        float x = (float)side;
        mat4 plate = placed(v3(1.2f * x, 0.8f, 0), v3(0, 1, 0), -90 * x, v3(1, 0.8f, 1)),
             wall = placed(v3(1.5f * x, 0.8f, 0), v3(0, 1, 0), -90 * x, v3(1, 0.8f, 1)),
             lamp = placed(v3(0.62f * x, 1.2f, 0), v3(0, 1, 0), 90 * x, v3(0.5f, 0.3f, 1));
        assert_true(tr_shape_rectangle(add_shape(s, b), &plate));
        assert_true(tr_shape_rectangle(add_shape(s, GRAY), &wall));
        tr_shape *light = add_shape(s, GRAY);
        assert_true(tr_shape_rectangle(light, &lamp));
        shine(s, light, WARM);
    }
    add_rectangle(s, GRAY, v3(0, 0.85f, 0), 90, 0.62f, 1);
    receiver r = {.half = 0.5};
    agree(what, s, r, 1 << 15, 512, 6, true);
}

static void smooth_parts_of_every_bsdf(void **state)
{
    (void)state;
    reflected_by("diffuse", TR_BSDF_DIFFUSE, false, false);
    reflected_by("rough conductor", TR_BSDF_ROUGHCONDUCTOR, false, false);
    reflected_by("plastic", TR_BSDF_PLASTIC, false, false);
    reflected_by("rough plastic", TR_BSDF_ROUGHPLASTIC, false, false);
    reflected_by("phong", TR_BSDF_PHONG, false, false);
    reflected_by("pbr", TR_BSDF_PBR, false, false);
    reflected_by("conductor", TR_BSDF_CONDUCTOR, false, false);
    reflected_by("rough glass", TR_BSDF_ROUGHDIELECTRIC, false, false);
    reflected_by("thin glass", TR_BSDF_THINDIELECTRIC, false, false);
}

static void bump_maps_and_masks(void **state)
{
    (void)state;
    reflected_by("bumped diffuse", TR_BSDF_DIFFUSE, true, false);
    reflected_by("bumped conductor", TR_BSDF_ROUGHCONDUCTOR, true, false);
    reflected_by("bumped mirror", TR_BSDF_CONDUCTOR, true, false);
    reflected_by("masked diffuse", TR_BSDF_DIFFUSE, false, true);
    reflected_by("masked bumped plastic", TR_BSDF_PLASTIC, true, true);
}

/* Normals of a flat mesh that lean by up to 50 degrees, each corner another way. */
static tr_shape *add_wavy(tr_scene *s, int bsdf, vec3 at, float half)
{
    enum { N = 9 };
    tr_shape *shape = add_shape(s, bsdf);
    assert_true(tr_mesh_alloc(shape, N * N, 2 * (N - 1) * (N - 1), true, false));
    uint32_t *out = shape->indices;
    for (uint32_t j = 0; j < N; ++j)
        for (uint32_t i = 0; i < N; ++i) {
            uint32_t k = j * N + i;
            float *p = shape->positions + 3 * k, *n = shape->normals + 3 * k;
            p[0] = at.x + half * (2 * (float)i / (N - 1) - 1);
            p[1] = at.y;
            p[2] = at.z + half * (2 * (float)j / (N - 1) - 1);
            vec3 normal = norm3(v3(0.8f * sinf(2.1f * (float)k), 1, 0.8f * cosf(3.7f * (float)k)));
            n[0] = normal.x, n[1] = normal.y, n[2] = normal.z;
            if (i + 1 < N && j + 1 < N) {
                uint32_t quad[6] = {k, k + N, k + 1, k + 1, k + N, k + N + 1}; /* up */
                memcpy(out, quad, sizeof quad);
                out += 6;
            }
        }
    return shape;
}

/* What leaves a surface with interpolated normals is f |wi.ns| of what arrives. */
static void interpolated_normals_at_the_receiver(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_wavy(s, GRAY, v3s(0), 1);
    shine(s, add_rectangle(s, GRAY, v3(0, 3, 0), 90, 0.7f, 0.7f), WARM);
    receiver r = {.half = 0.5, .by_shading_normal = true};
    agree("normals that lean", s, r, 1 << 16, 512, 2, true);
}

/* Light that is thrown up by a surface with interpolated normals, then down again by a flat one: without Veach's
   correction the photons would be off by a third. */
static void interpolated_normals_on_the_way(void **state)
{
    static const tr_bsdf_type types[] = {TR_BSDF_DIFFUSE, TR_BSDF_ROUGHCONDUCTOR, TR_BSDF_CONDUCTOR};
    (void)state;
    for (int k = 0; k < 3; ++k) {
        tr_scene *s = scene_new();
        int b = add_bsdf(s, types[k]);
        s->bsdfs[b].alpha.value = v3s(0.3f);
        add_floor(s, 0.6f);
        add_wavy(s, b, v3(1.7f, 0.1f, 0), 1);
        add_rectangle(s, GRAY, v3(0.5f, 1.5f, 0), 90, 1.5f, 1.5f);
        /* a lamp beside, which shines on the wavy mesh under a small angle and not on the floor */
        mat4 m = placed(v3(3.5f, 0.8f, 0), v3(0, 1, 0), -90, v3(1, 0.4f, 1));
        mat4 blind = placed(v3(0.65f, 0.5f, 0), v3(0, 1, 0), 90, v3(1, 0.5f, 1));
        tr_shape *lamp = add_shape(s, GRAY), *wall;
        assert_true(tr_shape_rectangle(lamp, &m));
        shine(s, lamp, WARM);
        wall = add_shape(s, GRAY);
        assert_true(tr_shape_rectangle(wall, &blind));
        receiver r = {.half = 0.5};
        agree(k == 0   ? "leaning, diffuse"
              : k == 1 ? "leaning, rough conductor"
                       : "leaning, mirror",
              s, r, 1 << 16, 1024, 4, true);
    }
}

/* ---- >>energy ----------------------------------------------------------------------------------------------- */

static bool absorb(void *user, int tile, const tr_photon *photons, int n)
{
    double *sum = user;
    (void)tile;
    for (int i = 0; i < n; ++i)
        sum[0] += photons[i].flux.x, sum[1] += photons[i].flux.y, sum[2] += photons[i].flux.z;
    return true;
}

/* In a closed room all that is emitted is absorbed: (1 - albedo) of what arrives at the walls. `inside` absorbs nothing
   and is no receiver. */
static void check_room(const char *what, vec3 albedo, tr_bsdf_type inside)
{
    tr_scene *s = scene_new();
    int room = add_bsdf(s, TR_BSDF_DIFFUSE);
    s->bsdfs[room].reflectance.value = albedo;
    add_room(s, room);
    mat4 m = placed(v3(0, 1.9f, 0), v3(1, 0, 0), 90, v3s(0.3f));
    int both = add_bsdf(s, TR_BSDF_TWOSIDED);
    s->bsdfs[both].child[0] = room;
    tr_shape *disk = add_shape(s, both);
    assert_true(tr_shape_disk(disk, &m));
    shine(s, disk, WARM);
    add_point(s, v3(0.1f, 0.2f, 0.3f), v3(0.2f, 1.2f, 0.3f));
    if (inside != TR_BSDF_DIFFUSE)
        add_sphere(s, add_bsdf(s, inside), v3(-0.3f, 0.6f, -0.3f), 0.5f);
    scene_done(s);
    double power[3], value[3] = {WARM.x, WARM.y, WARM.z}, point[3] = {0.1, 0.2, 0.3},
                     a[3] = {albedo.x, albedo.y, albedo.z};
    estimate sum = {{0}, {0}}, truth = {{0}, {0}};
    double squares[3] = {0, 0, 0};
    for (int k = 0; k < PASSES; ++k) {
        double arrived[3] = {0, 0, 0};
        tr_photon_pass pass = pass_of(s, LESS(1 << 13), 0, true);
        tr_photon_stats stats = {0};
        pass.index = k;
        assert_true(tr_trace_photons(&pass, absorb, arrived, &stats));
        assert_int_equal(stats.bad, 0);
        for (int c = 0; c < 3; ++c) {
            double x = arrived[c] * (1 - a[c]);
            assert_true(stats.escaped[c] < 1e-5 * stats.emitted[c]); /* none slips out between two walls */
            sum.mean[c] += x / PASSES;
            squares[c] += x * x / PASSES;
        }
    }
    for (int c = 0; c < 3; ++c) {
        power[c] = value[c] * PI * PI * 0.09 + point[c] * 4 * PI;
        truth.mean[c] = power[c];
        sum.sigma[c] = sqrt(fmax(0, squares[c] - sum.mean[c] * sum.mean[c]) / (PASSES - 1));
    }
    check(what, sum, truth);
    tr_scene_free(s);
}

static void closed_rooms_absorb_what_is_emitted(void **state)
{
    (void)state;
    check_room("room, gray", v3s(0.5f), TR_BSDF_DIFFUSE);
    check_room("room, coloured", v3(0.9f, 0.6f, 0.1f), TR_BSDF_DIFFUSE);
    check_room("room with glass", v3(0.7f, 0.6f, 0.5f), TR_BSDF_DIELECTRIC);
    check_room("room with thin glass", v3(0.7f, 0.6f, 0.5f), TR_BSDF_THINDIELECTRIC);
}

/* ---- >>records ---------------------------------------------------------------------------------------------- */

/* Photons without those that no camera path gathers are what the camera sees, with and without NEE: under a glass ball
   in the light of a point, there is a shadow. With DIRECT left out too, what is left is the indirect light. */
static tr_scene *point_over_a_ball(void)
{
    tr_scene *s = scene_new();
    add_floor(s, 2);
    int mirror = add_bsdf(s, TR_BSDF_CONDUCTOR);
    add_rectangle(s, mirror, v3(0, 1.8f, -1.5f), 30, 1, 1); /* its caustic is not seen either */
    add_sphere(s, add_bsdf(s, TR_BSDF_DIELECTRIC), v3(0.3f, 1, 0), 0.4f);
    mat4 m = placed(v3(-1.2f, 1, 0), v3(0, 1, 0), 90, v3(1, 0.8f, 1));
    tr_shape *wall = add_shape(s, GRAY);
    assert_true(tr_shape_rectangle(wall, &m));
    add_point(s, WARM, v3(0.5f, 2.5f, 0.2f));
    return s;
}

static void flags_say_what_camera_paths_find(void **state)
{
    (void)state;
    receiver seen = {.half = 0.5, .flags_out = TR_PHOTON_UNSEEN}, guided = {.half = 0.5, .flags_out = ~0u},
             all = {.half = 0.5};
    agree("what NEE finds", point_over_a_ball(), seen, 1 << 15, 512, 6, true);
    tr_scene *s = point_over_a_ball();
    scene_done(s);
    estimate rest = photon_flux(s, guided, 1 << 16, 6, true), both = camera_flux(s, 0.5, 0.2, 512, 6, true),
             direct = camera_flux(s, 0.5, 0.2, 512, 2, true), everything = photon_flux(s, all, 1 << 16, 6, true);
    for (int c = 0; c < 3; ++c) {
        both.mean[c] -= direct.mean[c];
        both.sigma[c] = hypot(both.sigma[c], direct.sigma[c]);
        assert_true(everything.mean[c] > 1.05 * (rest.mean[c] + direct.mean[c])); /* there are caustics */
    }
    check("what guiding finds", rest, both);
    estimate none = photon_flux(s, seen, 1 << 12, 6, false);
    assert_true(none.mean[0] == 0); /* without NEE no path finds a point */
    tr_scene_free(s);
}

typedef struct listing {
    tr_photon *photon;
    size_t count, capacity;
} listing;

static bool list(void *user, int tile, const tr_photon *photons, int n)
{
    listing *l = &((listing *)user)[tile];
    if (l->count + (size_t)n > l->capacity) {
        l->capacity = 2 * l->capacity + (size_t)n;
        l->photon = realloc(l->photon, l->capacity * sizeof *l->photon);
        assert_non_null(l->photon);
    }
    memcpy(l->photon + l->count, photons, (size_t)n * sizeof *photons);
    l->count += (size_t)n;
    return true;
}

/* Behind a mirror lies the light's picture; a photon that was thrown by a diffuse surface comes from one. */
static void distances_run_on_through_mirrors(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    vec3 light = v3(0.5f, 1, 0.3f), picture = v3(-2.5f, 1, 0.3f);
    int mirror = add_bsdf(s, TR_BSDF_CONDUCTOR);
    mat4 m = placed(v3(-1, 1, 0), v3(0, 1, 0), 90, v3(2, 2, 1)); /* the plane x = -1 */
    add_floor(s, 2);
    tr_shape *wall = add_shape(s, mirror);
    assert_true(tr_shape_rectangle(wall, &m));
    add_rectangle(s, GRAY, v3(0, 2, 0), 90, 2, 2);
    add_point(s, WARM, light);
    scene_done(s);
    listing l[2] = {{0}, {0}};
    tr_photon_pass pass = pass_of(s, 4000, 8, true);
    assert_true(tr_trace_photons(&pass, list, l, NULL));
    int direct = 0, mirrored = 0, diffuse = 0;
    for (size_t i = 0; i < l[0].count; ++i) {
        const tr_photon *p = &l[0].photon[i];
        vec3 from = madd3(p->p, p->wi, p->distance);
        assert_true(fabsf(len3(p->wi) - 1) < 1e-5f && fabsf(len3(p->ng) - 1) < 1e-5f && dot3(p->ns, p->wi) > 0);
        if (p->bounces == 0) {
            ++direct;
            assert_int_equal(p->flags, TR_PHOTON_DIRECT);
            assert_true(len3(sub3(from, light)) < 1e-3f);
        } else if (p->flags & TR_PHOTON_UNSEEN && p->bounces == 1) {
            ++mirrored;
            assert_true(len3(sub3(from, picture)) < 1e-3f);
        } else {
            /* from a point between floor and ceiling, or its picture in the mirror */
            ++diffuse;
            assert_true(fabsf(from.y) < 1e-3f || fabsf(from.y - 2) < 1e-3f);
            assert_true(from.x < 2.001f && from.x > -4.001f);
        }
    }
    assert_true(direct > 900 && mirrored > 100 && diffuse > 300);
    free(l[0].photon);
    free(l[1].photon);
    tr_scene_free(s);
}

static void distances_to_the_sky_are_infinite(void **state)
{
    (void)state;
    for (int k = 0; k < 3; ++k) {
        tr_scene *s = scene_new();
        add_floor(s, 1);
        add_sphere(s, GRAY, v3(0, 1, 0), 0.5f);
        tr_light *light = add_light(s, k == 0 ? TR_LIGHT_CONSTANT : k == 1 ? TR_LIGHT_DIRECTIONAL : TR_LIGHT_SUN, WARM);
        light->direction = v3(0.1f, -1, 0.2f);
        light->cutoff_cos = 0.99f;
        scene_done(s);
        listing l[1] = {{0}};
        tr_photon_pass pass = pass_of(s, 2000, 8, true);
        assert_true(tr_trace_photons(&pass, list, l, NULL));
        int later = 0;
        for (size_t i = 0; i < l->count; ++i) {
            assert_true(isinf(l->photon[i].distance) == (l->photon[i].bounces == 0));
            later += l->photon[i].bounces > 0;
        }
        assert_true(l->count > 300 && later > 20);
        free(l->photon);
        tr_scene_free(s);
    }
}

/* ---- >>identical -------------------------------------------------------------------------------------------- */

static void photons_are_identical_for_any_threads(void **state)
{
    (void)state;
    tr_log log = {.out = stderr};
    tr_scene *s = tr_scene_load("examples/scenes/egg.xml", NULL, 0, 1, &log);
    assert_non_null(s);
    enum { PATHS = 5 * TR_PHOTON_TILE + 77, TILES = 6 };
    listing one[TILES] = {{0}}, other[TILES] = {{0}};
    tr_photon_stats stats[2] = {{0}, {0}};
    tr_photon_pass pass = pass_of(s, PATHS, 0, true);
    assert_int_equal(tr_photon_tiles(PATHS), TILES);
    assert_true(tr_trace_photons(&pass, list, one, &stats[0]));
    for (int threads = 1; threads <= 4; threads += 3) {
        tr_pool *pool = tr_pool_create(threads);
        assert_non_null(pool);
        pass.parallel = tr_pool_run;
        pass.parallel_user = pool;
        memset(&stats[1], 0, sizeof stats[1]);
        assert_true(tr_trace_photons(&pass, list, other, &stats[1]));
        assert_memory_equal(&stats[0], &stats[1], sizeof stats[0]);
        for (int t = 0; t < TILES; ++t) {
            assert_int_equal(one[t].count, other[t].count);
            assert_true(one[t].count > 0);
            assert_memory_equal(one[t].photon, other[t].photon, one[t].count * sizeof *one[t].photon);
            other[t].count = 0;
        }
        tr_pool_destroy(pool);
    }
    /* in two parts */
    pass.parallel = NULL;
    pass.first = 2 * TR_PHOTON_TILE;
    pass.count = TR_PHOTON_TILE;
    assert_true(tr_trace_photons(&pass, list, other, NULL));
    assert_int_equal(one[2].count, other[0].count);
    assert_memory_equal(one[2].photon, other[0].photon, one[2].count * sizeof *one[2].photon);
    /* another seed, another pass */
    for (int k = 0; k < 2; ++k) {
        other[0].count = 0;
        pass.seed = k ? 1 : 2;
        pass.index = k;
        assert_true(tr_trace_photons(&pass, list, other, NULL));
        assert_true(other[0].count > 0 && one[2].count > 0);
        assert_memory_not_equal(one[2].photon, other[0].photon, sizeof *one[2].photon);
    }
    for (int t = 0; t < TILES; ++t) {
        free(one[t].photon);
        free(other[t].photon);
    }
    tr_scene_free(s);
}

/* ---- >>emission --------------------------------------------------------------------------------------------- */

/* In a box of 1/8 x 1/4 of the numbers all is of use, elsewhere one in 50. */
static bool of_use(const float u[5], tr_rng *rng)
{
    return (u[1] >= 0.25f && u[1] < 0.375f && u[4] >= 0.75f) || rng_float(rng) < 0.02f;
}

static void random_numbers(tr_rng *rng, float u[5])
{
    for (int k = 0; k < 5; ++k)
        u[k] = rng_float(rng);
}

/* Passes of an emission map that learns from of_use; more samples than it keeps. */
static tr_emission_map *learned_map(int tiles)
{
    tr_emission_map *map = tr_emission_map_create(tiles);
    tr_rng rng = rng_seed(5, 5);
    assert_non_null(map);
    assert_true(tr_emission_map_gain(map) == 1);
    for (int pass = 0; pass < 6; ++pass) {
        enum { N = 50000 };
        for (int i = 0; i < N; ++i) {
            float u[5], density;
            random_numbers(&rng, u);
            density = tr_emission_map_warp(map, u);
            if (of_use(u, &rng))
                assert_true(tr_emission_map_record(map, i * tiles / N, u, density, 1));
        }
        tr_emission_map_flush(map);
        tr_emission_map_learn(map);
    }
    return map;
}

/* Warped numbers follow the density that comes with them: the mean of 1 / density over any box is its volume. */
static void emission_map_is_a_density(void **state)
{
    (void)state;
    tr_emission_map *map = learned_map(3), *other = learned_map(1);
    tr_rng rng = rng_seed(6, 6);
    double volume[5][4] = {{0}}, squares[5][4] = {{0}}, inside = 0;
    enum { N = 200000 };
    assert_true(tr_emission_map_gain(map) > 1.4);
    for (int i = 0; i < N; ++i) {
        float u[5], v[5], density;
        random_numbers(&rng, u);
        memcpy(v, u, sizeof v);
        density = tr_emission_map_warp(map, u);
        assert_true(density >= 0.2499f && density < 100);
        assert_true(tr_emission_map_warp(other, v) == density); /* streams in one order: tiles do not matter */
        assert_memory_equal(u, v, sizeof u);
        for (int k = 0; k < 5; ++k) {
            assert_true(u[k] >= 0 && u[k] < 1);
            volume[k][(int)(4 * u[k])] += 1 / (double)density;
            squares[k][(int)(4 * u[k])] += 1 / ((double)density * (double)density);
        }
        inside += u[1] >= 0.25f && u[1] < 0.375f && u[4] >= 0.75f;
    }
    for (int k = 0; k < 5; ++k)
        for (int q = 0; q < 4; ++q) {
            double mean = volume[k][q] / N, sigma = sqrt((squares[k][q] / N - mean * mean) / N);
            if (!(fabs(mean - 0.25) < 4.5 * sigma))
                fail_msg("axis %d, quarter %d: %g, sigma %g", k, q, mean, sigma);
        }
    /* The best density is as the root of how many are of use; a quarter stays even. */
    double box = 1.0 / 32, rest = sqrt(0.02) * 31 / 32, best = 0.75 * box / (box + rest) + 0.25 / 32;
    assert_true(fabs(inside / N - best) < 0.1 * best);
    tr_emission_map_destroy(map);
    tr_emission_map_destroy(other);
    tr_emission_map_destroy(NULL);
}

/* Much is of use all over, so few of the paths are kept; then only in a corner, and not often: the old ones go, more of
   the new ones are kept, and soon all start there. */
static void emission_map_forgets(void **state)
{
    (void)state;
    tr_emission_map *map = tr_emission_map_create(1);
    tr_rng rng = rng_seed(8, 8);
    int corner = 0;
    uint64_t bytes[2] = {0, 0};
    assert_non_null(map);
    for (int pass = 0; pass < 60; ++pass) {
        int n = pass < 3 ? 300000 : 12;
        for (int i = 0; i < n; ++i) {
            float u[5];
            random_numbers(&rng, u);
            if (pass >= 3)
                u[2] *= 0.0625f, u[3] *= 0.0625f;
            assert_true(tr_emission_map_record(map, 0, u, pass < 3 ? 1 : 256, 1));
        }
        bytes[pass > 0] = tr_emission_map_bytes(map);
        tr_emission_map_flush(map);
        tr_emission_map_learn(map);
    }
    assert_true(bytes[0] > 300000 * 32 && bytes[1] == bytes[0]); /* later lists are shorter, and none is given back */
    for (int i = 0; i < 1000; ++i) {
        float u[5];
        random_numbers(&rng, u);
        tr_emission_map_warp(map, u);
        corner += u[2] < 0.0625f && u[3] < 0.0625f;
    }
    print_message("%d of 1000 in the corner, gain %.0f\n", corner, tr_emission_map_gain(map));
    assert_true(corner > 650); /* 750, less what the boxes are too wide */
    tr_emission_map_destroy(map);
}

/* Nothing is gained: the numbers stay as they are. */
static void even_use_leaves_emission_even(void **state)
{
    (void)state;
    tr_emission_map *map = tr_emission_map_create(1);
    tr_rng rng = rng_seed(7, 7);
    for (int pass = 0; pass < 4; ++pass) {
        for (int i = 0; i < 20000; ++i) {
            float u[5], v[5];
            random_numbers(&rng, u);
            memcpy(v, u, sizeof v);
            assert_true(tr_emission_map_warp(map, u) == 1);
            assert_memory_equal(u, v, sizeof u);
            for (int hit = 0; hit < (i % 1000 ? 2 : 50); ++hit) /* a path that comes often is still one */
                assert_true(tr_emission_map_record(map, 0, u, 1, i % 1000 ? 1 : 0.04f));
        }
        tr_emission_map_flush(map);
        tr_emission_map_learn(map);
    }
    assert_true(tr_emission_map_gain(map) == 1);
    tr_emission_map_destroy(map);
}

typedef struct learner {
    tr_emission_map *map;
    float half;
} learner;

static bool record_inside(void *user, int tile, const tr_photon *photons, int n)
{
    learner *l = user;
    for (int i = 0; i < n; ++i)
        if (fabsf(photons[i].p.y) < 1e-4f && fabsf(photons[i].p.x) < l->half && fabsf(photons[i].p.z) < l->half)
            assert_true(tr_emission_map_record(l->map, tile, photons[i].u, photons[i].density, 1));
    return true;
}

/* A lamp, a spot and the sun shine on a ball on a floor; what arrives on a small part of the floor is of use. Guided
   passes bring the same flux there and on the whole floor, and there with less noise. */
static void guided_emission_keeps_the_flux(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    learner l = {tr_emission_map_create(tr_photon_tiles(1 << 15)), 0.2f};
    add_floor(s, 4);
    add_sphere(s, GRAY, v3(0.6f, 0.4f, 0), 0.3f);
    tr_shape *lamp = add_rectangle(s, GRAY, v3(1, 3, 0), 90, 0.5f, 0.5f);
    shine(s, lamp, v3(4, 2, 1));
    add_spot(s, v3(20, 30, 20), v3(0, 3, 1), v3(0, -1, -0.3f), 30, 10);
    tr_light *sun = add_light(s, TR_LIGHT_SUN, v3(2000, 1500, 1000));
    sun->direction = norm3(v3(0.3f, -1, 0.1f));
    sun->cutoff_cos = 0.9999f;
    scene_done(s);
    assert_non_null(l.map);
    for (int k = 0; k < 6; ++k) {
        the_emission = l.map;
        tr_photon_pass pass = pass_of(s, 1 << 15, 6, false);
        pass.index = k;
        pass.seed = 99;
        assert_true(tr_trace_photons(&pass, record_inside, &l, NULL));
        tr_emission_map_flush(l.map);
        tr_emission_map_learn(l.map);
    }
    assert_true(tr_emission_map_gain(l.map) > 5);
    receiver r[2] = {{.half = 0.2}, {.half = 4}};
    for (int k = 0; k < 2; ++k) {
        the_emission = NULL;
        estimate even = photon_flux(s, r[k], 1 << 13, 6, false);
        the_emission = l.map;
        estimate guided = photon_flux(s, r[k], 1 << 13, 6, false);
        check(k ? "guided, everywhere" : "guided, where it is of use", guided, even);
        for (int c = 0; c < 3 && k == 0; ++c)
            assert_true(guided.sigma[c] < 0.7 * even.sigma[c]);
    }
    the_emission = NULL;
    tr_emission_map_destroy(l.map);
    tr_scene_free(s);
}

/* ---- >>adjoint ---------------------------------------------------------------------------------------------- */

static vec3 random_direction(tr_rng *rng)
{
    float a = rng_float(rng), b = rng_float(rng);
    return sample_uniform_sphere(a, b);
}

/* A surface of one bsdf, with a bump map where `bumped`; two-sided where it does not transmit. */
static tr_scene *one_bsdf(tr_bsdf_type type, bool bumped, int *id)
{
    tr_scene *s = scene_new();
    int b = add_bsdf(s, type);
    s->bsdfs[b].reflectance.value = v3(0.8f, 0.5f, 0.2f);
    s->bsdfs[b].specular_reflectance.value = v3(0.9f, 0.6f, 0.8f);
    s->bsdfs[b].specular_transmittance.value = v3(0.7f, 0.9f, 1);
    s->bsdfs[b].alpha.value = v3s(0.5f);
    s->bsdfs[b].distribution = TR_GGX;
    s->bsdfs[b].metallic.value = v3s(0.4f);
    s->bsdfs[b].exponent.value = v3s(5);
    if (bumped) {
        int t = tr_scene_add_texture(s), outer = add_bsdf(s, TR_BSDF_BUMPMAP);
        assert_true(tr_image_alloc(&s->textures[t].image, 8, 8, 3));
        s->textures[t].uv[0][0] = s->textures[t].uv[1][1] = 1;
        for (int i = 0; i < 8 * 8 * 3; ++i)
            s->textures[t].image.data[i] = (float)(i / 3 * 37 % 64) / 64;
        s->bsdfs[outer].bump_texture = t;
        s->bsdfs[outer].bump_scale = 0.3f;
        s->bsdfs[outer].child[0] = b;
        b = outer;
    }
    int both = add_bsdf(s, TR_BSDF_TWOSIDED);
    bool transmits = type == TR_BSDF_ROUGHDIELECTRIC;
    s->bsdfs[both].child[0] = b;
    *id = transmits ? b : both;
    add_rectangle(s, *id, v3s(0), 0, 1, 1);
    scene_done(s);
    return s;
}

/* What the adjoint draws is f for the path the other way round, as a closure that was prepared for that has it. */
static void check_way_back(tr_bsdf_type type, bool bumped)
{
    int id, drawn = 0;
    tr_scene *s = one_bsdf(type, bumped, &id);
    tr_rng rng = rng_seed(11, (uint64_t)type);
    for (int i = 0; i < 20000; ++i) {
        tr_surface at = {.u = rng_float(&rng), .v = rng_float(&rng), .dpdu = v3(1, 0, 0), .dpdv = v3(0, 1, 0)};
        at.ng = v3(0, 0, 1);
        at.ns = norm3(madd3(at.ng, random_direction(&rng), 0.5f));
        vec3 from = random_direction(&rng), to, weight;
        tr_closure c, back;
        float u[4], pdf;
        bool delta;
        for (int k = 0; k < 4; ++k)
            u[k] = rng_float(&rng);
        if (fabsf(from.z) < 1e-2f || !tr_closure_prepare(s, &at, from, &c) || u[0] < c.delta_probability)
            continue;
        bool goes = tr_closure_sample_adjoint(s, &at, &c, u, &to, &weight, &delta);
        if (!goes && c.transmits)
            continue;
        if (!goes) { /* blocked: then the way back is too. `to` is what a plain sample draws */
            vec3 f;
            if (!tr_closure_sample(&c, u[1], u[2], u[3], &to, &f, &pdf))
                continue;
            assert_true(!tr_closure_prepare(s, &at, to, &back) || black3(tr_closure_eval(&back, from, NULL)));
            continue;
        }
        assert_false(delta);
        tr_closure_eval(&c, to, &pdf);
        assert_true(tr_closure_prepare(s, &at, to, &back));
        vec3 f = tr_closure_eval(&back, from, NULL);
        float scale = fabsf(dot3(back.frame.n, from) * dot3(at.ng, to) / dot3(at.ng, from));
        vec3 expected = scale3(f, scale / (pdf * (1 - c.delta_probability)));
        vec3 difference = sub3(weight, expected);
        ++drawn;
        if (!(max3(v3(fabsf(difference.x), fabsf(difference.y), fabsf(difference.z))) <=
              5e-3f * max3(expected) + 1e-4f))
            fail_msg("bsdf %d, bumped %d: weight %g %g %g, expected %g %g %g", (int)type, bumped, (double)weight.x,
                     (double)weight.y, (double)weight.z, (double)expected.x, (double)expected.y, (double)expected.z);
    }
    assert_true(drawn > 3000);
    tr_scene_free(s);
}

static void adjoint_is_the_way_back(void **state)
{
    static const tr_bsdf_type types[] = {TR_BSDF_DIFFUSE, TR_BSDF_ROUGHCONDUCTOR, TR_BSDF_ROUGHDIELECTRIC,
                                         TR_BSDF_PLASTIC, TR_BSDF_ROUGHPLASTIC,   TR_BSDF_PHONG,
                                         TR_BSDF_PBR};
    (void)state;
    for (size_t i = 0; i < sizeof types / sizeof *types; ++i)
        for (int bumped = 0; bumped < 2; ++bumped)
            if (!bumped || types[i] != TR_BSDF_ROUGHDIELECTRIC)
                check_way_back(types[i], bumped);
}

/* Clear glass keeps every photon whole, whichever way: no light gathers. */
static void smooth_glass_keeps_flux(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_rectangle(s, add_bsdf(s, TR_BSDF_DIELECTRIC), v3s(0), 0, 1, 1);
    scene_done(s);
    tr_rng rng = rng_seed(4, 4);
    int refracted = 0;
    for (int i = 0; i < 5000; ++i) {
        tr_surface at = {.ng = v3(0, 0, 1), .ns = v3(0, 0, 1)};
        vec3 from = random_direction(&rng), to, weight;
        float u[4] = {rng_float(&rng), rng_float(&rng), 0, 0};
        tr_closure c;
        bool delta;
        assert_true(tr_closure_prepare(s, &at, from, &c));
        assert_true(tr_closure_sample_adjoint(s, &at, &c, u, &to, &weight, &delta));
        assert_true(delta && fabsf(weight.x - 1) < 1e-4f && fabsf(weight.z - 1) < 1e-4f);
        refracted += from.z * to.z < 0;
    }
    assert_true(refracted > 2000);
    tr_scene_free(s);
}

/* ---- >>method ----------------------------------------------------------------------------------------------- */

/* A method that counts photons, and refuses them from the fail_at-th call on. */
enum { SHOOTER_TILES = 256, SHOOTER_PATHS = 150000 }; /* more than a round */
typedef struct shooter {
    double flux[SHOOTER_TILES];
    uint64_t photons[SHOOTER_TILES];
    int tiles, asked, flushed, fail;
    bool seen[SHOOTER_TILES]; /* camera tiles with records that were not taken in yet */
    int taken;                /* those taken in since it was asked */
    bool pending;             /* photons were not taken in yet */
} shooter;
static shooter the_shooter;

static void *shooter_create(tr_method_env *env, char *err, size_t err_size)
{
    (void)err, (void)err_size;
    assert_in_range(env->photon_tiles, 1, SHOOTER_TILES);
    assert_in_range(env->tiles, 1, SHOOTER_TILES);
    the_shooter.tiles = env->photon_tiles;
    return &the_shooter;
}
static void shooter_destroy(void *method) { (void)method; }
static uint64_t shooter_wants(void *method, const tr_pass *pass)
{
    shooter *m = method;
    assert_int_equal(pass->index, m->asked);
    assert_false(pass->last);
    assert_true(m->taken > 0); /* the pass's camera paths were before */
    m->taken = 0;
    m->pending = pass->index == 1;
    m->asked++;
    return pass->index == 1 ? SHOOTER_PATHS : 0;
}
static bool shooter_record(void *method, int tile, const tr_photon *photons, int n)
{
    shooter *m = method;
    if (m->fail || tile < 0 || tile >= m->tiles)
        return false;
    for (int i = 0; i < n; ++i)
        m->flux[tile] += photons[i].flux.x;
    m->photons[tile] += (uint64_t)n;
    return true;
}
static bool shooter_record_camera(void *method, int tile, const tr_vertex *vertices, int n)
{
    (void)vertices;
    ((shooter *)method)->seen[tile] = n > 0;
    return true;
}
static void shooter_flush(void *method)
{
    shooter *m = method;
    int before = m->taken;
    for (int i = 0; i < SHOOTER_TILES; ++i)
        m->taken += m->seen[i];
    memset(m->seen, 0, sizeof m->seen);
    if (m->taken == before) { /* photons */
        m->flushed++;
        m->pending = false;
    }
}
static bool shooter_end(void *method, const tr_pass *pass)
{
    assert_false(pass->last || ((shooter *)method)->pending);
    return true;
}
static const tr_method shooter_table = {.name = "shooter",
                                        .create = shooter_create,
                                        .destroy = shooter_destroy,
                                        .record = shooter_record_camera,
                                        .wants_photons = shooter_wants,
                                        .record_photons = shooter_record,
                                        .flush = shooter_flush,
                                        .end_pass = shooter_end};

static void passes_hand_photons_to_the_method(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_room(s, GRAY);
    add_point(s, v3s(1), v3(0.2f, 1.2f, 0.3f));
    scene_done(s);
    s->camera.to_world = mat4_translate(v3(0, 1, -0.9f));
    s->camera.fov = 60;
    tr_settings settings = {.width = 32, .height = 32, .spp = 4, .max_depth = 40, .threads = 2};
    tr_result plain, result;
    char err[256] = "";
    settings.method = tr_method_find("pt");
    assert_true(tr_render(s, &settings, &plain, err, sizeof err));
    assert_true(plain.photon_paths == 0 && plain.photon_seconds == 0);
    settings.method = &shooter_table;
    memset(&the_shooter, 0, sizeof the_shooter);
    assert_true(tr_render(s, &settings, &result, err, sizeof err));
    assert_int_equal(the_shooter.asked, result.passes - 1); /* the last pass teaches nothing */
    assert_int_equal(the_shooter.flushed, 2);               /* two rounds of photons */
    assert_int_equal(result.photon_paths, SHOOTER_PATHS);
    assert_true(result.photon_seconds > 0 && result.photon_seconds < result.cpu_seconds);
    double flux = 0;
    uint64_t photons = 0;
    for (int t = 0; t < SHOOTER_TILES; ++t) {
        flux += the_shooter.flux[t];
        photons += the_shooter.photons[t];
    }
    assert_int_equal(result.photons, photons);
    assert_true(result.photon_rays >= photons);
    /* both rounds together carry the light's power: half of what arrives is absorbed */
    assert_true(fabs(0.5 * flux / (4 * PI) - 1) < 0.01);
    /* the picture knows nothing of it */
    assert_memory_equal(plain.color.data, result.color.data, sizeof(float) * 32 * 32 * 3);
    tr_result_free(&plain);
    tr_result_free(&result);
    memset(&the_shooter, 0, sizeof the_shooter);
    the_shooter.fail = 1;
    assert_false(tr_render(s, &settings, &result, err, sizeof err));
    assert_non_null(strstr(err, "memory"));
    tr_scene_free(s);
}

/* The picture of a plane across the view holds all the flux that arrives there, seen where the camera sees it. */
static void the_picture_holds_the_flux(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_floor(s, 2);
    mat4 blind = placed(v3(0.3f, 0.5f, 0), v3(1, 0, 0), -90, v3s(0.1f)); /* hides a part of the floor, faces up */
    assert_true(tr_shape_rectangle(add_shape(s, GRAY), &blind));
    add_point(s, WARM, v3(0, 3, 0));
    s->camera.to_world = (mat4){{{1, 0, 0, 0}, {0, 0, -1, 2}, {0, 1, 0, 0}, {0, 0, 0, 1}}};
    s->camera.fov = (float)(2 * atan(0.5) * 180 / PI); /* |x|, |z| < 1 on the floor */
    s->camera.fov_axis = 0;
    scene_done(s);
    tr_image picture;
    assert_true(tr_image_alloc(&picture, 20, 20, 3));
    tr_photon_pass pass = pass_of(s, 1 << 20, 2, true);
    assert_true(tr_photon_picture(&pass, &picture));
    /* the blind and its shadow lie before the floor's 0.2 .. 0.6 */
    double sum = 0, hidden = 0, shown = 0;
    for (int i = 0; i < 20; ++i)
        for (int j = 0; j < 20; ++j) {
            double value = picture.data[3 * (20 * j + i)] * 0.01, x = 1 - (i + 0.5) / 10, z = 1 - (j + 0.5) / 10;
            bool behind = fabs(x - 0.4) < 0.2 && fabs(z) < 0.2;
            *(behind ? &hidden : &sum) += value;
            shown += behind ? 0 : 0.01 * WARM.x * 3 / pow(9 + x * x + z * z, 1.5);
        }
    assert_true(fabs(sum / shown - 1) < 0.025); /* 35,000 photons: 4.5 sigma */
    assert_true(hidden > 0.5 * shown * 16 / 384);
    tr_image_free(&picture);
    tr_scene_free(s);
}

/* Whole pictures agree within 4 sigma, channel by channel. */
static void same_picture(const char *what, const tr_result *a, const tr_result *b)
{
    size_t pixels = (size_t)a->color.width * (size_t)a->color.height;
    for (size_t c = 0; c < 3; ++c) {
        double sum = 0, difference = 0, variance = 0;
        for (size_t i = c; i < 3 * pixels; i += 3) {
            sum += (double)b->color.data[i];
            difference += (double)a->color.data[i] - (double)b->color.data[i];
            variance += (double)a->variance.data[i] + (double)b->variance.data[i];
        }
        print_message("%-28s sigma %.2f %%, z %.2f\n", what, 100 * sqrt(variance) / sum, difference / sqrt(variance));
        assert_true(variance > 0 && sqrt(variance) < 0.03 * sum); /* else nothing would be told apart */
        assert_true(fabs(difference) < 4 * sqrt(variance));
    }
}

/* The sun does not come into a closed room: after two passes photons are few and rare, and the picture is that of
   photons in every pass and of a method without any. */
static void photons_of_no_use_are_given_up(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    add_room(s, GRAY);
    shine(s, add_sphere(s, GRAY, v3(0, 1.5f, 0), 0.1f), v3s(1e-3f));
    tr_light *sun = add_light(s, TR_LIGHT_DIRECTIONAL, v3s(1e6f));
    sun->direction = norm3(v3(0.3f, -1, 0.2f));
    scene_done(s);
    s->camera.to_world = mat4_translate(v3(0, 1, -0.9f));
    s->camera.fov = 60;
    tr_result result[3]; /* budget off, budget on, no photons */
    for (int k = 0; k < 3; ++k) {
        tr_option option = {.key = "budget", .value = k ? "on" : "off"};
        tr_settings settings = {.width = 16, .height = 16, .spp = 64, .threads = 1, .options = &option};
        settings.max_depth = 5;
        settings.seed = (uint64_t)k;
        char err[256] = "";
        settings.option_count = k < 2;
        settings.method = tr_method_find(k < 2 ? "photon" : "pt");
        assert_true(tr_render(s, &settings, &result[k], err, sizeof err));
        const char *skipped = strstr(result[k].method.json, "\"skipped_photon_passes\": ");
        assert_true((skipped != NULL) == (k < 2));
        assert_true(k == 2 || (k ? atoi(skipped + 25) >= 3 : atoi(skipped + 25) == 0));
    }
    assert_true(result[0].photon_paths > 8 * result[1].photon_paths);
    same_picture("few photons, none", &result[1], &result[2]);
    same_picture("few photons, many", &result[1], &result[0]);
    for (int k = 0; k < 3; ++k)
        tr_result_free(&result[k]);
    tr_scene_free(s);
}

/* ---- >>misuse ----------------------------------------------------------------------------------------------- */

static void check_nothing(tr_scene *s, uint32_t paths, int depth)
{
    double sum[3] = {0, 0, 0};
    tr_photon_stats stats = {0};
    tr_photon_pass pass = pass_of(s, paths, depth, true);
    pass.total = pass.total ? pass.total : 1;
    assert_true(tr_trace_photons(&pass, absorb, sum, &stats));
    assert_true(sum[0] == 0 && stats.photons == 0 && stats.bad == 0 && stats.paths == paths);
    assert_true(isfinite(stats.emitted[0]) && isfinite(stats.escaped[0]));
    tr_scene_free(s);
}

static void no_light_no_photons(void **state)
{
    (void)state;
    tr_scene *s = scene_new(); /* no light */
    add_floor(s, 1);
    scene_done(s);
    check_nothing(s, 5000, 8);
    s = scene_new(); /* no power */
    add_floor(s, 1);
    add_point(s, v3s(0), v3(0, 1, 0));
    add_light(s, TR_LIGHT_CONSTANT, v3s(0));
    add_light(s, TR_LIGHT_DIRECTIONAL, v3s(0));
    tr_light *night = add_envmap(s, 1);
    memset(night->image.data, 0, 12 * 6 * 3 * sizeof(float));
    add_spot(s, v3s(1), v3(0, 1, 0), v3(0, -1, 0), 0, 0);
    scene_done(s);
    check_nothing(s, 5000, 8);
    for (int late = 0; late < 2; ++late) { /* a light that is no number is ignored with a warning, later in silence */
        tr_log log = {0};
        s = scene_new();
        add_floor(s, 1);
        add_point(s, v3s(1), v3(0, 1, 0));
        scene_done(s);
        s->lights[0].value.y = NAN;
        if (!late) {
            assert_true(tr_lights_finish(s, &log));
            assert_int_equal(log.warnings, 1);
        }
        check_nothing(s, 5000, 8);
    }
    s = scene_new(); /* a light and nothing that it could reach */
    add_light(s, TR_LIGHT_CONSTANT, v3s(1));
    scene_done(s);
    check_nothing(s, 5000, 8);
    s = scene_new(); /* no paths; no edge left for them */
    add_floor(s, 1);
    add_light(s, TR_LIGHT_CONSTANT, v3s(1));
    scene_done(s);
    double sum[3] = {0, 0, 0};
    tr_photon_pass pass = pass_of(s, 0, 8, true);
    assert_true(tr_trace_photons(&pass, absorb, sum, NULL));
    assert_true(sum[0] == 0);
    check_nothing(s, 100, 1);
}

/* Black surfaces and back sides take photons and give none. */
static void nothing_arrives_where_nothing_scatters(void **state)
{
    (void)state;
    tr_scene *s = scene_new();
    int black = add_bsdf(s, TR_BSDF_DIFFUSE);
    s->bsdfs[black].reflectance.value = v3s(0);
    add_rectangle(s, black, v3s(0), -90, 1, 1);
    add_rectangle(s, GRAY, v3(0, 3, 0), -90, 1, 1); /* looks away */
    add_point(s, v3s(1), v3(0, 1, 0));
    scene_done(s);
    check_nothing(s, 5000, 8);
}

/* Weights that are huge, denormal or far away: nothing that is not finite comes out. */
static bool all_finite(void *user, int tile, const tr_photon *photons, int n)
{
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_photon *p = &photons[i];
        if (!finite3(p->flux) || !finite3(p->p) || !finite3(p->wi) || !(p->distance >= 0) || !(max3(p->flux) > 0))
            return false;
    }
    *(uint64_t *)user += (uint64_t)n;
    return true;
}

static void extreme_lights_make_no_nan(void **state)
{
    static const float value[] = {1e30f, 1e-30f, 3e38f};
    (void)state;
    for (size_t i = 0; i < sizeof value / sizeof *value; ++i)
        for (int far = 0; far < 2; ++far) {
            tr_scene *s = scene_new();
            uint64_t n = 0;
            tr_photon_stats stats = {0};
            tr_shape *floor = add_floor(s, far ? 1e6f : 1);
            (void)floor;
            add_wavy(s, GRAY, v3(0, far ? 1e5f : 0.1f, 0), far ? 1e5f : 0.5f);
            add_point(s, v3(value[i], 0, value[i]), v3(0, far ? 1e6f : 1, 0));
            add_spot(s, v3s(value[i]), v3(0, far ? 1e6f : 1, 0), v3(0, -1, 0), 1, 1);
            add_light(s, TR_LIGHT_DIRECTIONAL, v3s(value[i]))->direction = v3(1, -1e-3f, 0);
            scene_done(s);
            tr_photon_pass pass = pass_of(s, 20000, 0, true);
            assert_true(tr_trace_photons(&pass, all_finite, &n, &stats));
            assert_int_equal(n, stats.photons);
            tr_scene_free(s);
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(disk_light_shines_on_a_disk),
        cmocka_unit_test(sphere_light_shines_on_a_disk),
        cmocka_unit_test(rectangle_light_shines_on_its_like),
        cmocka_unit_test(squeezed_cylinder_light_shines_on_a_disk),
        cmocka_unit_test(point_light_shines_on_a_disk),
        cmocka_unit_test(point_light_outside_of_the_bounds),
        cmocka_unit_test(spot_light_shines_on_a_disk),
        cmocka_unit_test(spot_of_one_degree),
        cmocka_unit_test(directional_light_shines_on_a_square),
        cmocka_unit_test(sun_shines_on_a_square),
        cmocka_unit_test(constant_light_shines_on_a_square),
        cmocka_unit_test(envmap_shines_on_a_square),
        cmocka_unit_test(sunsky_shines_on_a_square),
        cmocka_unit_test(lights_emit_their_power),
        cmocka_unit_test(emitted_power_is_exact),
        cmocka_unit_test(glass_ball),
        cmocka_unit_test(rough_glass_ball),
        cmocka_unit_test(glass_slab),
        cmocka_unit_test(under_water),
        cmocka_unit_test(smooth_parts_of_every_bsdf),
        cmocka_unit_test(bump_maps_and_masks),
        cmocka_unit_test(interpolated_normals_at_the_receiver),
        cmocka_unit_test(interpolated_normals_on_the_way),
        cmocka_unit_test(closed_rooms_absorb_what_is_emitted),
        cmocka_unit_test(flags_say_what_camera_paths_find),
        cmocka_unit_test(distances_run_on_through_mirrors),
        cmocka_unit_test(distances_to_the_sky_are_infinite),
        cmocka_unit_test(photons_are_identical_for_any_threads),
        cmocka_unit_test(emission_map_is_a_density),
        cmocka_unit_test(emission_map_forgets),
        cmocka_unit_test(even_use_leaves_emission_even),
        cmocka_unit_test(guided_emission_keeps_the_flux),
        cmocka_unit_test(adjoint_is_the_way_back),
        cmocka_unit_test(smooth_glass_keeps_flux),
        cmocka_unit_test(passes_hand_photons_to_the_method),
        cmocka_unit_test(photons_of_no_use_are_given_up),
        cmocka_unit_test(the_picture_holds_the_flux),
        cmocka_unit_test(no_light_no_photons),
        cmocka_unit_test(nothing_arrives_where_nothing_scatters),
        cmocka_unit_test(extreme_lights_make_no_nan),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
