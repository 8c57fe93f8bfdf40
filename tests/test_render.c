/* test_render.c: the integrator against the outside: analytic irradiance and furnaces, three estimators that must
   agree, guided against unguided, and bit-identical images for any number of threads.

     >>tools >>analytic >>agree >>guided >>splitting >>trend >>identical >>misuse */
#include "cmocka_prelude.h"
#include "integrator.h"
#include "scale.h"
#include "threads.h"

#include <stdlib.h>
#include <string.h>

#define SCENES "examples/scenes/"

/* ---- >>tools ------------------------------------------------------------------------------------------------ */

static tr_scene *load(const char *name, const char *define, const char *value)
{
    char path[256];
    tr_define d = {define, value};
    tr_log log = {.out = stderr};
    snprintf(path, sizeof path, SCENES "%s.xml", name);
    tr_scene *scene = tr_scene_load(path, &d, define ? 1 : 0, 1, &log);
    assert_non_null(scene);
    assert_int_equal(log.errors, 0);
    return scene;
}

static tr_settings small(const char *method, int spp)
{
    tr_settings s;
    memset(&s, 0, sizeof s);
    s.width = 80;
    s.height = 48;
    s.spp = spp;
    s.max_depth = 6;
    s.threads = 2;
    s.method = tr_method_find(method);
    assert_non_null(s.method);
    return s;
}

static tr_result render(const tr_scene *scene, const tr_settings *settings)
{
    tr_result r;
    char err[256] = "";
    if (!tr_render(scene, settings, &r, err, sizeof err))
        fail_msg("%s", err);
    return r;
}

/* Largest |z| over 16x16 tiles and channels of the difference of two renders, and over channels of the whole image (the
   channels of a path are correlated: their sum would look three times as certain as it is). A tile's variance gets a
   floor: 0.1 % of its value, so that float rounding is no difference. */
static double worst_z(const tr_result *a, const tr_result *b, double *whole)
{
    int w = a->color.width, h = a->color.height;
    double worst = 0, all_difference[3] = {0, 0, 0}, all_variance[3] = {0, 0, 0};
    for (int y0 = 0; y0 < h; y0 += 16)
        for (int x0 = 0; x0 < w; x0 += 16)
            for (int c = 0; c < 3; ++c) {
                double difference = 0, variance = 0, value = 0;
                for (int y = y0; y < y0 + 16 && y < h; ++y)
                    for (int x = x0; x < x0 + 16 && x < w; ++x) {
                        size_t i = 3 * ((size_t)y * (size_t)w + (size_t)x) + (size_t)c;
                        difference += (double)a->color.data[i] - b->color.data[i];
                        variance += (double)a->variance.data[i] + b->variance.data[i];
                        value += a->color.data[i];
                    }
                all_difference[c] += difference;
                all_variance[c] += variance;
                double z = fabs(difference) / sqrt(variance + 1e-6 * value * value + 1e-20);
                worst = z > worst ? z : worst;
            }
    *whole = 0;
    for (int c = 0; c < 3; ++c)
        *whole = fmax(*whole, fabs(all_difference[c]) / sqrt(all_variance[c] + 1e-20));
    return worst;
}

/* 15 tiles x 3 channels: |z| < 4.6 is a family-wise error of 2e-4 for normal tiles; the images' tails are heavier
   than normal, hence the small margin above the Bonferroni bound (4.1 at 2e-3). */
#define Z_TILE 4.6
#define Z_WHOLE 4.0

static void assert_agree(const char *what, const tr_result *a, const tr_result *b)
{
    double whole, worst = worst_z(a, b, &whole);
    if (worst > Z_TILE || whole > Z_WHOLE)
        fail_msg("%s: images differ: worst tile z %.2f, whole image z %.2f", what, worst, whole);
}

/* ---- >>analytic --------------------------------------------------------------------------------------------- */

/* A white diffuse floor at y = 0 looked at from straight above through a narrow lens. */
static tr_scene *floor_scene(void)
{
    tr_scene *s = tr_scene_new();
    assert_non_null(s);
    int b = tr_scene_add_bsdf(s, TR_BSDF_DIFFUSE), shape = tr_scene_add_shape(s);
    assert_true(b >= 0 && shape >= 0);
    s->bsdfs[b].reflectance.value = v3s(1);
    tr_shape *f = &s->shapes[shape];
    f->type = TR_SHAPE_MESH;
    f->bsdf = b;
    f->light = -1;
    f->vertex_count = 3;
    f->triangle_count = 1;
    f->positions = calloc(12, sizeof(float));
    f->indices = calloc(3, sizeof(uint32_t));
    assert_true(f->positions && f->indices);
    const float p[9] = {-10, 0, -10, 0, 0, 20, 10, 0, -10};
    memcpy(f->positions, p, sizeof p);
    f->indices[1] = 1;
    f->indices[2] = 2;
    memset(&s->camera, 0, sizeof s->camera);
    /* columns: left = +x, up = +z, forward = -y */
    s->camera.to_world = (mat4){{{1, 0, 0, 0}, {0, 0, -1, 0.5f}, {0, 1, 0, 0}, {0, 0, 0, 1}}};
    s->camera.fov = 0.02f;
    s->width = s->height = 16;
    s->max_depth = 2;
    return s;
}

static void add_black(tr_shape *f, tr_scene *s, int shape, vec3 radiance)
{
    int b = tr_scene_add_bsdf(s, TR_BSDF_DIFFUSE), l = tr_scene_add_light(s, TR_LIGHT_AREA);
    assert_true(b >= 0 && l >= 0);
    s->bsdfs[b].reflectance.value = v3s(0);
    s->lights[l].shape = shape;
    s->lights[l].value = radiance;
    f->bsdf = b;
    f->light = l;
}

/* Mean radiance of the floor under `scene`, times pi = irradiance. */
static double floor_irradiance(tr_scene *scene, bool nee, double *sigma)
{
    tr_log log = {.out = stderr};
    assert_true(tr_scene_finish(scene, 1, &log));
    tr_settings s = small("pt", 256);
    s.width = s.height = 16;
    s.max_depth = 2;
    s.no_nee = !nee;
    tr_result r = render(scene, &s);
    double sum = 0, variance = 0;
    for (int i = 0; i < 16 * 16; ++i) {
        sum += r.color.data[3 * i];
        variance += r.variance.data[3 * i];
    }
    *sigma = TR_PI * sqrt(variance) / 256;
    tr_result_free(&r);
    tr_scene_free(scene);
    return TR_PI * sum / 256;
}

static void check_irradiance(tr_scene *(*make)(void), double expected)
{
    for (int nee = 0; nee < 2; ++nee) {
        double sigma, e = floor_irradiance(make(), nee, &sigma);
        if (fabs(e - expected) > 4.5 * sigma + 2e-4 * expected)
            fail_msg("irradiance with nee %d: %g +- %g, expected %g", nee, e, sigma, expected);
    }
}

/* The camera sits at y = 0.5 below these lights, which lie at y = 2. */
static tr_scene *disk_over_floor(void)
{
    tr_scene *s = floor_scene();
    int shape = tr_scene_add_shape(s);
    tr_shape *d = &s->shapes[shape];
    d->type = TR_SHAPE_DISK;
    /* local z -> -y, radius 1.5, at y = 2 */
    d->object_to_world = (mat4){{{1.5f, 0, 0, 0}, {0, 0, -1, 2}, {0, 1.5f, 0, 0}, {0, 0, 0, 1}}};
    d->world_to_object = (mat4){{{1 / 1.5f, 0, 0, 0}, {0, 0, 1 / 1.5f, 0}, {0, -1, 0, 2}, {0, 0, 0, 1}}};
    add_black(d, s, shape, v3s(3));
    return s;
}

static tr_scene *sphere_over_floor(void)
{
    tr_scene *s = floor_scene();
    int shape = tr_scene_add_shape(s);
    tr_shape *d = &s->shapes[shape];
    d->type = TR_SHAPE_SPHERE;
    d->center = v3(0, 2, 0);
    d->radius = 0.7f;
    d->object_to_world = (mat4){{{0.7f, 0, 0, 0}, {0, 0.7f, 0, 2}, {0, 0, 0.7f, 0}, {0, 0, 0, 1}}};
    d->world_to_object = (mat4){{{1 / 0.7f, 0, 0, 0}, {0, 1 / 0.7f, 0, -2 / 0.7f}, {0, 0, 1 / 0.7f, 0}, {0, 0, 0, 1}}};
    add_black(d, s, shape, v3s(3));
    return s;
}

static tr_scene *rectangle_over_floor(void)
{
    tr_scene *s = floor_scene();
    int shape = tr_scene_add_shape(s);
    tr_shape *d = &s->shapes[shape];
    d->type = TR_SHAPE_MESH;
    d->vertex_count = 4;
    d->triangle_count = 2;
    d->positions = calloc(15, sizeof(float));
    d->indices = calloc(6, sizeof(uint32_t));
    assert_true(d->positions && d->indices);
    const float p[12] = {-1, 2, -2, 1, 2, -2, 1, 2, 2, -1, 2, 2};
    const uint32_t t[6] = {0, 1, 2, 0, 2, 3}; /* normal down */
    memcpy(d->positions, p, sizeof p);
    memcpy(d->indices, t, sizeof t);
    add_black(d, s, shape, v3s(3));
    return s;
}

static void irradiance_under_a_disk(void **state)
{
    (void)state;
    check_irradiance(disk_over_floor, TR_PI * 3 * 1.5 * 1.5 / (1.5 * 1.5 + 2 * 2));
}

static void irradiance_under_a_sphere(void **state)
{
    (void)state;
    check_irradiance(sphere_over_floor, TR_PI * 3 * 0.7 * 0.7 / (2 * 2));
}

static void irradiance_under_a_rectangle(void **state)
{
    (void)state;
    /* Four corner configurations a x b at height c: E/L = 2 * (a/sqrt(a^2+c^2) atan(b/sqrt(a^2+c^2)) + ...). */
    double a = 1, b = 2, c = 2, p = sqrt(a * a + c * c), q = sqrt(b * b + c * c);
    check_irradiance(rectangle_over_floor, 3 * 4 * 0.5 * (a / p * atan(b / p) + b / q * atan(a / q)));
}

/* A closed white furnace: radiance 1 from everywhere, albedo-1 floor: every pixel is exactly 1 in expectation. */
static void furnace_is_white(void **state)
{
    (void)state;
    tr_scene *s = floor_scene();
    int l = tr_scene_add_light(s, TR_LIGHT_CONSTANT);
    s->lights[l].value = v3s(1);
    double sigma, e = floor_irradiance(s, true, &sigma);
    assert_true(fabs(e / TR_PI - 1) < 4.5 * sigma / TR_PI + 1e-4);
}

/* ---- >>agree ------------------------------------------------------------------------------------------------ */

/* BSDF sampling alone, NEE alone and both by MIS estimate the same image. */
static void estimators_agree(const char *scene_name, const char *define, const char *value, int spp)
{
    tr_scene *scene = load(scene_name, define, value);
    tr_settings s = small("pt", LESS(spp));
    tr_result mis = render(scene, &s);
    s.no_bsdf_hits = true;
    s.seed = 1;
    tr_result nee = render(scene, &s);
    s.no_bsdf_hits = false;
    s.no_nee = true;
    s.seed = 2;
    s.spp = 4 * LESS(spp);
    tr_result bsdf = render(scene, &s);
    assert_agree("MIS and NEE only", &mis, &nee);
    assert_agree("MIS and BSDF only", &mis, &bsdf);
    tr_result_free(&mis);
    tr_result_free(&nee);
    tr_result_free(&bsdf);
    tr_scene_free(scene);
}

static void estimators_agree_on_cornell(void **state) { (void)state, estimators_agree("cornell", NULL, NULL, 64); }
static void estimators_agree_on_hall(void **state) { (void)state, estimators_agree("hall", NULL, NULL, 64); }
static void estimators_agree_on_gloss(void **state) { (void)state, estimators_agree("gloss", NULL, NULL, 128); }
static void estimators_agree_on_ajar(void **state) { (void)state, estimators_agree("ajar", "gap", "120", 64); }
static void estimators_agree_on_egg(void **state) { (void)state, estimators_agree("egg", "bulb", "0.11", 64); }
static void estimators_agree_on_torus(void **state) { (void)state, estimators_agree("torus", "light_size", "1", 64); }

/* ---- >>guided ----------------------------------------------------------------------------------------------- */

static double mean_alpha(const tr_result *r)
{
    double sum = 0;
    for (int i = 0; i < 80 * 48; ++i)
        sum += r->alpha.data[i];
    return sum / (80 * 48);
}

static void method_agrees_with(const char *method, tr_option *options, int option_count, const char *scene_name,
                               const char *define, const char *value, int spp, bool nee, int train)
{
    tr_scene *scene = load(scene_name, define, value);
    tr_settings s = small("pt", LESS(spp));
    s.no_nee = !nee;
    tr_result pt = render(scene, &s);
    s.method = tr_method_find(method);
    s.options = options;
    s.option_count = option_count;
    s.seed = 1;
    s.train = train;
    tr_result guided = render(scene, &s);
    print_message("%s: mean selection probability %.2f\n", method, mean_alpha(&guided));
    assert_agree("pt and the method", &pt, &guided);
    assert_true(mean_alpha(&guided) < 0.9); /* it did guide: without, there would be nothing to compare */
    tr_result_free(&pt);
    tr_result_free(&guided);
    tr_scene_free(scene);
}

static void method_agrees(const char *method, const char *scene_name, const char *define, const char *value, int spp,
                          bool nee, int train)
{
    method_agrees_with(method, NULL, 0, scene_name, define, value, spp, nee, train);
}

static void guided_agrees(const char *scene_name, const char *define, const char *value, int spp, bool nee)
{
    method_agrees("sdtree", scene_name, define, value, spp, nee, 0);
}

/* Lamps are so large that unguided paths find them often: z means little where one path in a million brings the light,
   as behind the egg's glass. Over eight seeds each no tile had |z| above 3.7 and no image above 2.3. */
static void guided_agrees_on_cornell(void **state) { (void)state, guided_agrees("cornell", NULL, NULL, 127, false); }
static void guided_agrees_on_gloss(void **state) { (void)state, guided_agrees("gloss", "bulb", "0.3", 127, true); }
static void guided_agrees_on_ajar(void **state) { (void)state, guided_agrees("ajar", "gap", "120", 127, true); }
static void trained_agrees_on_ajar(void **state)
{
    (void)state, method_agrees("sdtree", "ajar", "gap", "120", 127, true, 16);
}
static void guided_agrees_on_torus(void **state) { (void)state, guided_agrees("torus", "light_size", "1", 127, true); }
static void guided_agrees_on_egg(void **state) { (void)state, guided_agrees("egg", "bulb", "0.3", 100, true); }
static void guided_agrees_on_lamps(void **state) { (void)state, guided_agrees("lamps", "bulb", "0.12", 100, true); }
static void guided_agrees_on_pool(void **state) { (void)state, guided_agrees("pool", "sun_size", "40", 100, true); }
static void guided_agrees_on_maze(void **state) { (void)state, guided_agrees("maze", "lamp_z", "-2.3", 100, true); }
static void kd_agrees_on_ajar(void **state) { (void)state, method_agrees("kd", "ajar", "gap", "120", 127, true, 0); }
static void kd_agrees_on_egg(void **state) { (void)state, method_agrees("kd", "egg", "bulb", "0.3", 100, true, 0); }

/* The first is two candidates, both are three. */
static tr_option three_candidates[] = {{"sampling", "ris", false}, {"candidates", "3", false}};

/* Metal: candidates from both, MIS with next event estimation by their mixture. */
static void resampled_agrees_on_gloss(void **state)
{
    (void)state;
    method_agrees_with("kd", three_candidates, 1, "gloss", "bulb", "0.3", 100, true, 0);
    method_agrees_with("kd", three_candidates, 2, "gloss", "bulb", "0.3", 100, false, 0);
}

/* That it agrees means something: the pictures are not those of one-sample MIS. */
static void resampled_is_another_picture(void **state)
{
    (void)state;
    tr_option mis = {"sampling", "mis", false};
    tr_scene *scene = load("gloss", "bulb", "0.3");
    tr_settings s = small("kd", 7);
    tr_result r[3];
    s.options = &mis;
    s.option_count = 1;
    r[0] = render(scene, &s);
    s.options = three_candidates;
    for (int k = 1; k < 3; ++k) {
        s.option_count = k;
        r[k] = render(scene, &s);
    }
    assert_true(mean_alpha(&r[0]) < 0.9);
    for (int k = 0; k < 3; ++k)
        assert_memory_not_equal(r[k].color.data, r[(k + 1) % 3].color.data, sizeof(float) * 80 * 48 * 3);
    for (int k = 0; k < 3; ++k)
        tr_result_free(&r[k]);
    tr_scene_free(scene);
}
static void photons_agree_on_ajar(void **state)
{
    (void)state, method_agrees("photon", "ajar", "gap", "120", 127, true, 0);
}
static void photons_agree_on_egg(void **state)
{
    (void)state, method_agrees("photon", "egg", "bulb", "0.3", 100, false, 0);
}

/* ---- >>splitting -------------------------------------------------------------------------------------------- */

/* A method that guides evenly over the sphere and says what it likes of the reflected radiance; it adds up what the
   first vertices of the paths receive. */
typedef struct even_method {
    float reflected;
    double first, first_squares;
    uint64_t first_count, count;
} even_method;
static even_method even;

static void *even_create(tr_method_env *env, char *err, size_t err_size)
{
    return (void)env, (void)err, (void)err_size, &even;
}
static void even_destroy(void *method) { (void)method; }
static void even_find(void *method, const tr_lookup *lookup, void *handles, float *alpha)
{
    (void)method;
    for (int i = 0; i < lookup->n; ++i) {
        ((float *)handles)[i] = 0.25f / TR_PI;
        alpha[i] = 0.5f;
    }
}
static void even_sample(void *method, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi,
                        float *pdf)
{
    (void)method;
    for (int i = 0; i < n; ++i) {
        int k = index[i];
        float z = 2 * u[k][0] - 1, r = sqrtf(1 - z * z), phi = 2 * TR_PI * u[k][1];
        wi[k] = v3(r * cosf(phi), r * sinf(phi), z);
        pdf[k] = ((const float *)handles)[k];
    }
}
static void even_pdf(void *method, int n, const int *index, const void *handles, const vec3 *wi, float *pdf)
{
    (void)method, (void)wi;
    for (int i = 0; i < n; ++i)
        pdf[index[i]] = ((const float *)handles)[index[i]];
}
static void even_reflected(void *method, int n, const void *handles, float *radiance)
{
    (void)handles;
    for (int i = 0; i < n; ++i)
        radiance[i] = ((const even_method *)method)->reflected;
}
static bool even_record(void *method, int tile, const tr_vertex *vertices, int n)
{
    even_method *m = method;
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_vertex *v = &vertices[i];
        double brought = v->pdf_mix > 0 ? (double)(mean3(mul3(v->f, v->L)) * v->cosine / v->pdf_mix) : 0;
        m->count++;
        if (!(v->flags & TR_VERTEX_FIRST))
            continue;
        m->first += brought;
        m->first_squares += brought * brought;
        m->first_count++;
    }
    return true;
}

static const tr_method even_method_table = {.name = "even",
                                            .handle_size = sizeof(float),
                                            .create = even_create,
                                            .destroy = even_destroy,
                                            .find = even_find,
                                            .sample = even_sample,
                                            .pdf = even_pdf,
                                            .reflected = even_reflected,
                                            .record = even_record,
                                            .wants_pixel_estimate = true};

/* Split wherever that is possible, or never: the same picture, and records that say the same of what first vertices
   receive. */
static void splitting_changes_no_mean(void **state)
{
    (void)state;
    tr_scene *scene = load("gloss", "bulb", "0.3");
    tr_settings s = small("pt", LESS(64));
    tr_result r[2];
    even_method m[2];
    s.method = &even_method_table;
    s.threads = 1; /* one sum for all tiles */
    for (int split = 0; split < 2; ++split) {
        memset(&even, 0, sizeof even);
        even.reflected = split ? 1e6f : 0;
        s.seed = (uint64_t)split;
        r[split] = render(scene, &s);
        m[split] = even;
    }
    assert_int_equal(r[0].split_paths, 0);
    assert_true(r[1].split_paths > r[1].paths); /* the first pass has no pixel estimate to compare with */
    assert_true(m[1].count > m[0].count + r[1].split_paths / 2);
    assert_agree("whole and split", &r[0], &r[1]);
    double mean[2], variance = 0;
    for (int k = 0; k < 2; ++k) {
        double n = (double)m[k].first_count;
        mean[k] = m[k].first / n;
        variance += (m[k].first_squares / n - mean[k] * mean[k]) / n;
        tr_result_free(&r[k]);
    }
    print_message("first vertices receive %.5f whole, %.5f split: z %.2f\n", mean[0], mean[1],
                  (mean[1] - mean[0]) / sqrt(variance));
    assert_true(fabs(mean[1] - mean[0]) < 3.5 * sqrt(variance));
    tr_scene_free(scene);
}

/* ---- >>trend ------------------------------------------------------------------------------------------------ */

/* Passes that grow by a quarter, variances N^-b, every other one times 1 + scatter. */
static tr_trend trend_of(int passes, double b, double scatter)
{
    tr_trend t = {.count = 0};
    double learned = 8;
    for (int i = 0; i < passes; ++i, learned *= 1.25)
        tr_trend_add(&t, learned, 3 * pow(learned, -b) * (i % 2 ? 1 + scatter : 1));
    return t;
}

/* With V ~ N^-0.2 and 30 % of a pass for learning it pays while left > 1.5 spent. */
static void learning_pays_by_the_trend(void **state)
{
    (void)state;
    tr_trend t = trend_of(12, 0.2, 0);
    assert_true(tr_learning_pays(&t, 10, 15.1, 0.3));
    assert_false(tr_learning_pays(&t, 10, 14.9, 0.3));
    assert_true(tr_learning_pays(&t, 10, 10.1, 0.2));
    assert_false(tr_learning_pays(&t, 10, 9.9, 0.2));
    t = trend_of(12, 0, 0); /* nothing to gain, but not before an eighth of the budget */
    assert_false(tr_learning_pays(&t, 10, 69, 0.01));
    assert_true(tr_learning_pays(&t, 10, 71, 0.99));
    t = trend_of(12, 0, 1); /* variances that tell nothing */
    assert_true(tr_learning_pays(&t, 10, 10, 0.2));
    t = trend_of(12, -0.5, 0); /* light that is only being found */
    assert_true(tr_learning_pays(&t, 10, 10, 0.3));
    t = trend_of(5, 0, 0);
    assert_true(tr_learning_pays(&t, 10, 10, 0.9));
}

/* It looks back to a third of the samples, to six passes at least, and past what is no number. */
static void trend_looks_back_so_far(void **state)
{
    (void)state;
    tr_trend flat = trend_of(6, 0, 0), steep = trend_of(40, 2, 0);
    assert_int_equal(steep.count, TR_TREND_MAX);
    for (int i = 0; i < 6; ++i) /* what was learned before is of no interest */
        tr_trend_add(&steep, 1e6 * pow(1.25, i), 1);
    assert_false(tr_learning_pays(&steep, 10, 10, 0.01));
    tr_trend_add(&flat, NAN, 1);
    tr_trend_add(&flat, 1, NAN);
    tr_trend_add(&flat, 0, 1);
    tr_trend_add(&flat, 30, -1);
    assert_int_equal(flat.count, 6);
    tr_trend doubling = {.count = 0};
    for (int i = 0; i < 6; ++i)
        tr_trend_add(&doubling, 1 << i, 1);
    assert_false(tr_learning_pays(&doubling, 10, 10, 0.01));
}

/* A method that learns nothing and takes three times as long for it as the samples took. */
static struct {
    int taught, rested;
    double start;
} vain;
static void *vain_create(tr_method_env *env, char *err, size_t err_size)
{
    memset(&vain, 0, sizeof vain);
    vain.start = tr_cpu_seconds();
    return (void)env, (void)err, (void)err_size, &vain;
}
static bool vain_begin(void *method, const tr_pass *pass)
{
    (void)method;
    vain.taught += !pass->last;
    vain.rested += pass->last;
    return !pass->last;
}
static bool vain_record(void *method, int tile, const tr_vertex *vertices, int n)
{
    return (void)method, (void)tile, (void)vertices, (void)n, true;
}
static bool vain_end(void *method, const tr_pass *pass)
{
    double now = tr_cpu_seconds(), until = now + 3 * (now - vain.start);
    (void)method, (void)pass;
    while (tr_cpu_seconds() < until)
        continue;
    vain.start = until;
    return true;
}
static const tr_method vain_method = {.name = "vain",
                                      .learns = true,
                                      .create = vain_create,
                                      .destroy = even_destroy,
                                      .record = vain_record,
                                      .begin_pass = vain_begin,
                                      .end_pass = vain_end};

/* Three quarters of every pass go into learning that lowers no variance: a timed render stops that soon after the
   eighth of the budget that teaches anyhow, one with a budget of samples goes on to its last pass. */
static void learning_in_vain_stops(void **state)
{
    (void)state;
    tr_scene *scene = load("cornell", NULL, NULL);
    tr_settings s = small("pt", 0);
    s.method = &vain_method;
    s.width = 40;
    s.height = 24;
    s.max_depth = 3;
    s.seconds = 3;
    s.threads = 1;
    tr_result timed = render(scene, &s);
    print_message("%d passes taught, %.2f s, %d did not, %.2f s\n", vain.taught, timed.train_seconds, vain.rested,
                  timed.cpu_seconds - timed.train_seconds);
    assert_true(vain.taught >= 6 && vain.rested >= 2);
    assert_true(timed.train_seconds < 2);
    s.seconds = 0;
    s.spp = 64;
    tr_result counted = render(scene, &s);
    assert_true(vain.taught >= 6 && vain.rested == 1);
    tr_result_free(&timed);
    tr_result_free(&counted);
    tr_scene_free(scene);
}

/* ---- >>identical -------------------------------------------------------------------------------------------- */

static void same_for_threads_with(const char *method, tr_option *options, int option_count, const char *scene_name,
                                  int train)
{
    tr_scene *scene = load(scene_name, NULL, NULL);
    tr_settings s = small(method, 15);
    s.options = options;
    s.option_count = option_count;
    s.train = train;
    s.threads = 1;
    tr_result one = render(scene, &s);
    assert_true(strcmp(method, "pt") == 0 || one.split_paths > 0);
    for (int threads = 2; threads <= 5; threads += 3) {
        s.threads = threads;
        tr_result many = render(scene, &s);
        assert_memory_equal(one.color.data, many.color.data, sizeof(float) * 80 * 48 * 3);
        assert_memory_equal(one.variance.data, many.variance.data, sizeof(float) * 80 * 48 * 3);
        assert_memory_equal(one.alpha.data, many.alpha.data, sizeof(float) * 80 * 48);
        tr_result_free(&many);
    }
    s.seed = 7;
    tr_result other = render(scene, &s);
    assert_memory_not_equal(one.color.data, other.color.data, sizeof(float) * 80 * 48 * 3);
    tr_result_free(&other);
    tr_result_free(&one);
    tr_scene_free(scene);
}

static void same_for_threads(const char *method, int train) { same_for_threads_with(method, NULL, 0, "ajar", train); }

static void pt_is_identical_for_any_threads(void **state) { (void)state, same_for_threads("pt", 0); }
static void sdtree_is_identical_for_any_threads(void **state) { (void)state, same_for_threads("sdtree", 0); }
static void photons_are_identical_for_any_threads(void **state) { (void)state, same_for_threads("photon", 0); }
static void trained_is_identical_for_any_threads(void **state) { (void)state, same_for_threads("sdtree", 9); }
static void resampled_is_identical_for_any_threads(void **state)
{
    (void)state, same_for_threads_with("kd", three_candidates, 2, "gloss", 0);
}

/* With every gate closed the guided render is the unguided one. */
static void closed_gate_changes_no_bit(void **state)
{
    (void)state;
    tr_scene *scene = load("cornell", NULL, NULL);
    tr_settings s = small("pt", 31);
    tr_result pt = render(scene, &s);
    tr_option off[] = {{"alpha", "1", false}, {"learn_alpha", "off", false}};
    s.method = tr_method_find("sdtree");
    s.options = off;
    s.option_count = 2;
    tr_result closed = render(scene, &s);
    assert_memory_equal(pt.color.data, closed.color.data, sizeof(float) * 80 * 48 * 3);
    tr_result_free(&pt);
    tr_result_free(&closed);
    tr_scene_free(scene);
}

/* Where nothing is guided, a training of 15 samples and a picture of 16 are the first 31 of pt. */
static void training_is_not_in_the_picture(void **state)
{
    (void)state;
    tr_scene *scene = load("cornell", NULL, NULL);
    tr_settings s = small("pt", 15);
    tr_result first = render(scene, &s);
    s.spp = 31;
    tr_result all = render(scene, &s);
    tr_option off[] = {{"alpha", "1", false}, {"learn_alpha", "off", false}};
    s.method = tr_method_find("sdtree");
    s.options = off;
    s.option_count = 2;
    s.train = 15;
    s.spp = 16;
    tr_result rest = render(scene, &s);
    assert_int_equal(rest.spp, 16);
    assert_int_equal(rest.passes, rest.train_passes + 1);
    for (int i = 0; i < rest.train_passes; ++i)
        assert_true(rest.pass[i].weight == 0);
    assert_true(rest.train_seconds > 0 && rest.train_seconds < rest.cpu_seconds);
    for (size_t i = 0; i < 80 * 48 * 3; ++i) {
        double sum = 31.0 * all.color.data[i], parts = 15.0 * first.color.data[i] + 16.0 * rest.color.data[i];
        assert_true(fabs(sum - parts) <= 1e-5 * sum);
        sum = 31.0 * all.albedo.data[i];
        parts = 15.0 * first.albedo.data[i] + 16.0 * rest.albedo.data[i];
        assert_true(fabs(sum - parts) <= 1e-4 * sum);
    }
    tr_result_free(&first);
    tr_result_free(&all);
    tr_result_free(&rest);
    tr_scene_free(scene);
}

/* ---- >>misuse ----------------------------------------------------------------------------------------------- */

static void refuses_a_missing_budget_and_unknown_options(void **state)
{
    (void)state;
    tr_scene *scene = load("cornell", NULL, NULL);
    tr_settings s = small("pt", 0);
    tr_result r;
    char err[256] = "";
    assert_false(tr_render(scene, &s, &r, err, sizeof err));
    assert_non_null(strstr(err, "budget"));
    tr_option odd = {"colour", "blue", false};
    s.spp = 1;
    s.options = &odd;
    s.option_count = 1;
    assert_false(tr_render(scene, &s, &r, err, sizeof err));
    assert_non_null(strstr(err, "colour"));
    tr_scene_free(scene);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(irradiance_under_a_disk),
        cmocka_unit_test(irradiance_under_a_sphere),
        cmocka_unit_test(irradiance_under_a_rectangle),
        cmocka_unit_test(furnace_is_white),
        cmocka_unit_test(estimators_agree_on_cornell),
        cmocka_unit_test(estimators_agree_on_hall),
        cmocka_unit_test(estimators_agree_on_gloss),
        cmocka_unit_test(estimators_agree_on_ajar),
        cmocka_unit_test(estimators_agree_on_egg),
        cmocka_unit_test(estimators_agree_on_torus),
        cmocka_unit_test(guided_agrees_on_cornell),
        cmocka_unit_test(guided_agrees_on_gloss),
        cmocka_unit_test(guided_agrees_on_ajar),
        cmocka_unit_test(guided_agrees_on_torus),
        cmocka_unit_test(guided_agrees_on_egg),
        cmocka_unit_test(guided_agrees_on_lamps),
        cmocka_unit_test(guided_agrees_on_pool),
        cmocka_unit_test(guided_agrees_on_maze),
        cmocka_unit_test(kd_agrees_on_ajar),
        cmocka_unit_test(kd_agrees_on_egg),
        cmocka_unit_test(resampled_agrees_on_gloss),
        cmocka_unit_test(resampled_is_another_picture),
        cmocka_unit_test(photons_agree_on_ajar),
        cmocka_unit_test(photons_agree_on_egg),
        cmocka_unit_test(splitting_changes_no_mean),
        cmocka_unit_test(trained_agrees_on_ajar),
        cmocka_unit_test(learning_pays_by_the_trend),
        cmocka_unit_test(trend_looks_back_so_far),
        cmocka_unit_test(learning_in_vain_stops),
        cmocka_unit_test(pt_is_identical_for_any_threads),
        cmocka_unit_test(sdtree_is_identical_for_any_threads),
        cmocka_unit_test(photons_are_identical_for_any_threads),
        cmocka_unit_test(trained_is_identical_for_any_threads),
        cmocka_unit_test(resampled_is_identical_for_any_threads),
        cmocka_unit_test(training_is_not_in_the_picture),
        cmocka_unit_test(closed_gate_changes_no_bit),
        cmocka_unit_test(refuses_a_missing_budget_and_unknown_options),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
