/* test_scene.c: scene files, meshes, shapes and glTF of the example renderer (examples/tracer).

   contents: >>files >>transforms >>spelling >>parameters >>colours >>materials >>emitters >>camera >>shapes >>meshes
             >>serialized >>gltf >>told >>bad >>code >>flips >>real

   GUIDE_SCENES=folder loads the downloaded scenes too (veach-ajar, veach-bidir, living-room, kitchen). */
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <zlib.h>

#include "cmocka_prelude.h"
#include "scene_internal.h"

/* ---- >>files ------------------------------------------------------------------------------------------------ */

static char folder[256];

static const char *in_folder(const char *name)
{
    static char path[8][600];
    static int next;
    char *p = path[next++ % 8];
    snprintf(p, sizeof path[0], "%s/%s", folder, name);
    return p;
}

static const char *write_file(const char *name, const void *data, size_t size)
{
    const char *path = in_folder(name);
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(data, 1, size, f), size);
    fclose(f);
    return path;
}

static const char *write_text(const char *name, const char *text) { return write_file(name, text, strlen(text)); }

/* Everything that was said by the last load. */
static char said[16384];
static tr_log messages;

static tr_scene *load_file(const char *path, const tr_define *defines, int count)
{
    memset(&messages, 0, sizeof messages);
    memset(said, 0, sizeof said);
    messages.out = tmpfile();
    assert_non_null(messages.out);
    tr_scene *scene = tr_scene_load(path, defines, count, 1, &messages);
    rewind(messages.out);
    said[fread(said, 1, sizeof said - 1, messages.out)] = 0;
    fclose(messages.out);
    messages.out = NULL;
    assert_int_equal(scene == NULL, messages.errors > 0);
    return scene;
}

static tr_scene *load_text(const char *xml) { return load_file(write_text("scene.xml", xml), NULL, 0); }

/* Loads without any message but notes. */
static tr_scene *load_clean(const char *xml)
{
    tr_scene *scene = load_text(xml);
    if (!scene || messages.warnings)
        fprintf(stderr, "%s\n", said);
    assert_non_null(scene);
    assert_int_equal(messages.warnings, 0);
    return scene;
}

#define LIGHT "<emitter type=\"constant\"/><sensor type=\"perspective\"/>"

static int setup(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/guide_test_scene_XXXXXX");
    return mkdtemp(folder) ? 0 : -1;
}

static int teardown(void **state)
{
    static const char *const names[] = {"scene.xml", "other.xml", "a.ply", "a.obj",      "a.serialized", "a.exr",
                                        "a.png",     "self.xml",  "a.spd", "scene.gltf", "scene.glb"};
    (void)state;
    for (size_t i = 0; i < sizeof names / sizeof *names; ++i)
        remove(in_folder(names[i]));
    return rmdir(folder);
}

static void near3(vec3 a, float x, float y, float z, float tolerance)
{
    if (!(fabsf(a.x - x) <= tolerance && fabsf(a.y - y) <= tolerance && fabsf(a.z - z) <= tolerance))
        fail_msg("(%.7g %.7g %.7g) should be (%.7g %.7g %.7g)", (double)a.x, (double)a.y, (double)a.z, (double)x,
                 (double)y, (double)z);
}

static void near1(float a, float b, float tolerance)
{
    if (!(fabsf(a - b) <= tolerance))
        fail_msg("%.8g should be %.8g", (double)a, (double)b);
}

static vec3 position(const tr_shape *s, uint32_t i)
{
    return v3(s->positions[3 * i], s->positions[3 * i + 1], s->positions[3 * i + 2]);
}

/* ---- >>transforms ------------------------------------------------------------------------------------------- */

static void test_transform_products(void **state)
{
    (void)state;
    tr_scene *s = load_clean("<scene version='0.5.0'>" LIGHT "<shape type='rectangle'><transform name='toWorld'>"
                             "<scale x='2' y='3'/><rotate z='1' angle='90'/><translate x='10' z='1'/></transform>"
                             "</shape><shape type='rectangle'><transform name='to_world'><scale value='2'/>"
                             "<translate value='1 2 3'/><matrix value='0 0 1 0  0 1 0 0  1 0 0 0  0 0 0 1'/>"
                             "</transform></shape></scene>");
    /* (-1,-1,0) -> (-2,-3,0) -> (3,-2,0) -> (13,-2,1) */
    near3(position(&s->shapes[0], 0), 13, -2, 1, 1e-5f);
    near3(position(&s->shapes[1], 0), 3, 0, -1, 1e-5f);
    tr_scene_free(s);
}

static void test_lookat_looks_at_the_target(void **state)
{
    (void)state;
    tr_scene *s = load_clean("<scene version='3.0.0'><emitter type='constant'/><sensor type='perspective'>"
                             "<transform name='to_world'><lookat origin='1, 2, 3' target='1, 2, 8' up='0, 1, 0'/>"
                             "</transform></sensor></scene>");
    near3(xform_point(&s->camera.to_world, v3(0, 0, 5)), 1, 2, 8, 1e-5f);
    near3(xform_vector(&s->camera.to_world, v3(1, 0, 0)), 1, 0, 0, 1e-5f);
    tr_scene_free(s);
}

static void test_inverse_times_matrix_is_identity(void **state)
{
    (void)state;
    tr_rng r = rng_seed(7, 0);
    for (int i = 0; i < 1000; ++i) {
        mat4 a, inv, id = mat4_identity();
        for (int k = 0; k < 16; ++k)
            a.m[k / 4][k % 4] = rng_float(&r) * 4 - 2 + (k % 5 == 0 ? 5.0f : 0);
        assert_true(mat4_inverse(&a, &inv));
        mat4 p = mat4_mul(&a, &inv);
        for (int k = 0; k < 16; ++k)
            near1(p.m[k / 4][k % 4], id.m[k / 4][k % 4], 2e-5f);
    }
    mat4 flat = mat4_scale(v3(1, 0, 1)), out;
    assert_false(mat4_inverse(&flat, &out));
}

/* ---- >>spelling --------------------------------------------------------------------------------------------- */

static void test_both_spellings_mean_the_same(void **state)
{
    (void)state;
    tr_scene *old = load_clean("<scene version='0.5.0'>" LIGHT "<integrator type='path'><integer name='maxDepth' "
                               "value='7'/></integrator><bsdf type='roughdielectric' id='g'><float name='intIOR' "
                               "value='1.7'/><float name='extIOR' value='1'/><float name='alpha' value='0.3'/><rgb "
                               "name='specularTransmittance' value='0.5, 0.25, 1'/></bsdf><shape type='rectangle'>"
                               "<boolean name='flipNormals' value='true'/><ref id='g'/></shape></scene>");
    assert_int_equal(old->max_depth, 7);
    tr_scene *new = load_clean("<scene version='3.0.0'>" LIGHT "<integrator type='path'><integer name='max_depth' "
                               "value='7'/></integrator><bsdf type='roughdielectric' id='g'><float name='int_ior' "
                               "value='1.7'/><float name='ext_ior' value='1'/><float name='alpha' value='0.3'/><rgb "
                               "name='specular_transmittance' value='0.5 0.25 1'/></bsdf><shape type='rectangle'>"
                               "<boolean name='flip_normals' value='true'/><ref id='g'/></shape></scene>");
    assert_int_equal(new->max_depth, 7);
    const tr_bsdf *a = &old->bsdfs[0], *b = &new->bsdfs[0];
    near1(a->ior, 1.7f, 1e-6f);
    near1(b->ior, 1.7f, 1e-6f);
    near1(a->alpha.value.x, b->alpha.value.x, 0);
    near3(b->specular_transmittance.value, 0.5f, 0.25f, 1, 0);
    near3(a->specular_transmittance.value, 0.5f, 0.25f, 1, 0);
    assert_true(old->shapes[0].flip_normals && new->shapes[0].flip_normals);
    tr_scene_free(old);
    tr_scene_free(new);
}

/* ---- >>parameters ------------------------------------------------------------------------------------------- */

static void test_defaults_and_defines(void **state)
{
    (void)state;
    const char *xml = "<scene version='3.0.0'><default name='d' value='5'/><default name='dx' value='9'/>"
                      "<default name='w' value='320'/><emitter type='constant'/>"
                      "<integrator type='path'><integer name='max_depth' value='$d'/></integrator>"
                      "<sensor type='perspective'><float name='fov' value='$dx'/><film type='hdrfilm'>"
                      "<integer name='width' value='$w'/><integer name='height' value='${w}'/></film></sensor></scene>";
    char fixed[1024];
    snprintf(fixed, sizeof fixed, "%s", xml);
    char *brace = strstr(fixed, "${w}");
    memcpy(brace, "1$d ", 4); /* within text */
    tr_scene *s = load_clean(fixed);
    assert_int_equal(s->max_depth, 5);
    assert_int_equal(s->width, 320);
    assert_int_equal(s->height, 15);
    near1(s->camera.fov, 9, 0);
    tr_scene_free(s);
    const tr_define defines[] = {{"d", "3"}, {"w", "64"}, {"nobody", "1"}};
    s = load_file(in_folder("scene.xml"), defines, 3);
    assert_non_null(s);
    assert_int_equal(s->max_depth, 3);
    assert_int_equal(s->width, 64);
    assert_int_equal(messages.warnings, 1);
    assert_non_null(strstr(said, "nobody"));
    tr_scene_free(s);
}

static void test_include(void **state)
{
    (void)state;
    write_text("other.xml", "<scene version='3.0.0'><default name='grey' value='0.25'/><bsdf type='diffuse' id='b'>"
                            "<rgb name='reflectance' value='$grey'/></bsdf></scene>");
    tr_scene *s = load_clean("<scene version='3.0.0'><include filename='other.xml'/>" LIGHT
                             "<shape type='cube'><ref id='b'/></shape></scene>");
    near3(s->bsdfs[s->shapes[0].bsdf].reflectance.value, 0.25f, 0.25f, 0.25f, 0);
    tr_scene_free(s);
    write_text("other.xml", "<scene version='3.0.0'>\n<bsdf type='diffuse'>\n<float name='nonsense' value='1'/>"
                            "</bsdf></scene>");
    s = load_text("<scene version='3.0.0'><include filename='other.xml'/>" LIGHT "</scene>");
    assert_non_null(s);
    assert_non_null(strstr(said, "other.xml:3: warning: unknown parameter 'nonsense'"));
    tr_scene_free(s);
}

static void test_references_work_forwards_and_into_nested_elements(void **state)
{
    (void)state;
    tr_scene *s = load_clean("<scene version='3.0.0'><shape type='rectangle'><ref id='late'/></shape>" LIGHT
                             "<shape type='rectangle'><ref id='inner'/></shape>"
                             "<bsdf type='twosided' id='late'><bsdf type='phong' id='inner'/></bsdf></scene>");
    assert_int_equal(s->bsdfs[s->shapes[0].bsdf].type, TR_BSDF_TWOSIDED);
    assert_int_equal(s->bsdfs[s->shapes[1].bsdf].type, TR_BSDF_PHONG);
    assert_int_equal(s->bsdfs[s->shapes[0].bsdf].child[0], s->shapes[1].bsdf);
    tr_scene_free(s);
}

/* ---- >>colours ---------------------------------------------------------------------------------------------- */

static vec3 reflectance_of(const char *element)
{
    char xml[2048];
    snprintf(xml, sizeof xml, "<scene version='3.0.0'>" LIGHT "<bsdf type='diffuse'>%s</bsdf></scene>", element);
    tr_scene *s = load_clean(xml);
    vec3 c = s->bsdfs[0].reflectance.value;
    tr_scene_free(s);
    return c;
}

static void test_colour_spellings(void **state)
{
    (void)state;
    near3(reflectance_of("<rgb name='reflectance' value='0.1, 0.2,0.3'/>"), 0.1f, 0.2f, 0.3f, 0);
    near3(reflectance_of("<rgb name='reflectance' value='0.1 0.2 0.3'/>"), 0.1f, 0.2f, 0.3f, 0);
    near3(reflectance_of("<rgb name='reflectance' value='0.4'/>"), 0.4f, 0.4f, 0.4f, 0);
    near3(reflectance_of("<rgb name='reflectance' value='#ff0033'/>"), 1, 0, 0.2f, 1e-6f);
    near3(reflectance_of("<srgb name='reflectance' value='0.5, 1, 0'/>"), 0.21404114f, 1, 0, 1e-5f);
    near3(reflectance_of("<spectrum name='reflectance' value='0.3'/>"), 0.3f, 0.3f, 0.3f, 0);
    near3(reflectance_of("<float name='reflectance' value='0.3'/>"), 0.3f, 0.3f, 0.3f, 0);
    near3(reflectance_of("<spectrum name='reflectance' value='300:0.3, 900:0.3'/>"), 0.3f, 0.3f, 0.3f, 1e-5f);
    near3(reflectance_of("<spectrum name='reflectance' type='uniform'><float name='value' value='0.3'/></spectrum>"),
          0.3f, 0.3f, 0.3f, 0);
    vec3 red = reflectance_of("<spectrum name='reflectance' value='300:0, 600:0, 601:0.8, 900:0.8'/>");
    assert_true(red.x > 0.6f && red.y < 0.1f && red.z < 0.05f);
    write_text("a.spd", "# a file\n300 0.6\n900 0.6\n");
    near3(reflectance_of("<spectrum name='reflectance' filename='a.spd'/>"), 0.6f, 0.6f, 0.6f, 1e-5f);
}

static void test_black_bodies(void **state)
{
    (void)state;
    /* CIE daylight's correlated temperature is near 6504 K, so such a body is nearly white in sRGB. */
    vec3 w = tr_blackbody_rgb(6504), warm = tr_blackbody_rgb(2700), cold = tr_blackbody_rgb(12000);
    assert_true(w.x / w.y > 0.97f && w.x / w.y < 1.09f && w.z / w.y > 0.92f && w.z / w.y < 1.06f);
    assert_true(warm.x > 2 * warm.z && cold.z > 1.3f * cold.x);
    /* Luminance: Planck at 555 nm is 4.6e4 W/m^2/sr/nm there, near the weighted mean. */
    float y = 0.2126f * w.x + 0.7152f * w.y + 0.0722f * w.z;
    assert_true(y > 4.2e4f && y < 4.8e4f);
}

/* ---- >>materials -------------------------------------------------------------------------------------------- */

static void test_metal_reflects_its_colour_at_normal_incidence(void **state)
{
    (void)state;
    vec3 n, k;
    assert_true(tr_metal("Au", &n, &k));
    const float eta[3] = {n.x, n.y, n.z}, kk[3] = {k.x, k.y, k.z}, f0[3] = {0.980f, 0.766f, 0.336f};
    for (int i = 0; i < 3; ++i) {
        float k2 = kk[i] * kk[i];
        near1((sqrf(eta[i] - 1) + k2) / (sqrf(eta[i] + 1) + k2), f0[i], 1e-4f);
    }
    assert_true(tr_metal("Ni_palik", &n, &k));
    assert_false(tr_metal("Unobtainium", &n, &k));
    assert_true(tr_metal("none", &n, &k));
    near3(n, 0, 0, 0, 0);
}

static void test_material_parameters(void **state)
{
    (void)state;
    tr_scene *s = load_text("<scene version='0.6.0'>" LIGHT
                            "<bsdf type='dielectric'><string name='intIOR' value='diamond'/><string name='extIOR' "
                            "value='water'/></bsdf>"
                            "<bsdf type='roughconductor'><float name='alphaU' value='0.1'/><float name='alphaV' "
                            "value='0.4'/><string name='distribution' value='ggx'/><float name='extEta' value='2'/>"
                            "<rgb name='eta' value='1, 2, 3'/><rgb name='k' value='4, 5, 6'/></bsdf>"
                            "<bsdf type='conductor'><string name='material' value='none'/></bsdf>"
                            "<bsdf type='mask'><float name='opacity' value='0.3'/><bsdf type='diffuse'/></bsdf>"
                            "<bsdf type='plastic'><boolean name='nonlinear' value='true'/><rgb "
                            "name='diffuseReflectance' value='0.1, 0.2, 0.3'/></bsdf>"
                            "<bsdf type='null'/>"
                            "<bsdf type='bumpmap'><texture type='scale'><float name='scale' value='3'/><texture "
                            "type='checkerboard'><rgb name='color0' value='1'/><float name='uscale' value='4'/>"
                            "</texture></texture><bsdf type='diffuse'/></bsdf></scene>");
    assert_non_null(s);
    assert_int_equal(messages.warnings, 1); /* anisotropy */
    near1(s->bsdfs[0].ior, 2.419f / 1.333f, 1e-5f);
    near1(s->bsdfs[1].alpha.value.x, 0.2f, 1e-6f);
    assert_int_equal(s->bsdfs[1].distribution, TR_GGX);
    near3(s->bsdfs[1].eta, 0.5f, 1, 1.5f, 1e-6f);
    near3(s->bsdfs[1].k, 2, 2.5f, 3, 1e-6f);
    near3(s->bsdfs[2].eta, 0, 0, 0, 0);
    assert_int_equal(s->bsdfs[3].type, TR_BSDF_DIFFUSE);
    assert_int_equal(s->bsdfs[4].type, TR_BSDF_MASK);
    near1(s->bsdfs[4].opacity.value.x, 0.3f, 0);
    assert_int_equal(s->bsdfs[4].child[0], 3);
    assert_true(s->bsdfs[5].nonlinear);
    near3(s->bsdfs[5].reflectance.value, 0.1f, 0.2f, 0.3f, 0);
    const tr_bsdf *bump = &s->bsdfs[s->bsdf_count - 1];
    assert_int_equal(bump->type, TR_BSDF_BUMPMAP);
    const tr_texture *t = &s->textures[bump->bump_texture];
    near1(t->color0.x, 3, 1e-6f);
    near1(t->color1.x, 0.6f, 1e-6f);
    near1(t->uv[0][0], 4, 0);
    tr_scene_free(s);
}

static void write_exr(const char *name, int w, int h)
{
    tr_image image;
    char err[200];
    assert_true(tr_image_alloc(&image, w, h, 3));
    for (int i = 0; i < 3 * w * h; ++i)
        image.data[i] = (float)i;
    tr_layer layer = {"R,G,B", &image, true};
    assert_true(tr_exr_write(in_folder(name), &layer, 1, err, sizeof err));
    tr_image_free(&image);
}

static void test_textures_share_a_file(void **state)
{
    (void)state;
    write_exr("a.exr", 4, 2);
    tr_scene *s = load_clean("<scene version='3.0.0'>" LIGHT "<bsdf type='diffuse'><texture name='reflectance' "
                             "type='bitmap'><string name='filename' value='a.exr'/></texture></bsdf>"
                             "<bsdf type='diffuse'><texture name='reflectance' type='bitmap'><string name='filename' "
                             "value='a.exr'/><string name='wrap_mode' value='clamp'/><string name='filter_type' "
                             "value='nearest'/><transform name='to_uv'><scale x='2' y='3'/><translate x='0.5'/>"
                             "</transform></texture></bsdf></scene>");
    assert_int_equal(s->texture_count, 2);
    assert_ptr_equal(s->textures[0].image.data, s->textures[1].image.data);
    assert_int_equal(s->textures[1].wrap, TR_WRAP_CLAMP);
    assert_true(s->textures[1].nearest);
    near1(s->textures[1].uv[0][0], 2, 0);
    near1(s->textures[1].uv[0][2], 0.5f, 0);
    near1(s->textures[1].uv[1][1], 3, 0);
    near1(s->textures[0].image.data[5], 5, 0);
    tr_scene_free(s);
}

/* ---- >>emitters --------------------------------------------------------------------------------------------- */

static void test_emitters(void **state)
{
    (void)state;
    write_exr("a.exr", 4, 2);
    tr_scene *s = load_clean(
        "<scene version='3.0.0'><sensor type='perspective'/>"
        "<emitter type='point'><point name='position' x='1' y='2' z='3'/><rgb name='intensity' value='4'/></emitter>"
        "<emitter type='spot'><transform name='to_world'><lookat origin='0,5,0' target='0,0,0' up='0,0,1'/></transform>"
        "<float name='cutoff_angle' value='60'/><rgb name='intensity' value='2'/></emitter>"
        "<emitter type='directional'><vector name='direction' x='0' y='-2' z='0'/><rgb name='irradiance' value='3'/>"
        "</emitter><emitter type='envmap'><string name='filename' value='a.exr'/><float name='scale' value='10'/>"
        "<transform name='to_world'><rotate y='1' angle='90'/></transform></emitter>"
        "<emitter type='sunsky'><float name='turbidity' value='4'/><vector name='sun_direction' x='0' y='1' z='1'/>"
        "</emitter><shape type='rectangle'><emitter type='area'><rgb name='radiance' value='5, 6, 7'/></emitter>"
        "</shape><shape type='cube'/></scene>");
    assert_int_equal(s->light_count, 7);
    near3(s->lights[0].position, 1, 2, 3, 0);
    near3(s->lights[0].value, 4, 4, 4, 0);
    near3(s->lights[1].position, 0, 5, 0, 0);
    near3(s->lights[1].direction, 0, -1, 0, 1e-6f);
    near1(s->lights[1].cutoff_cos, 0.5f, 1e-6f);
    near1(s->lights[1].beam_cos, cosf(45 * TR_PI / 180), 1e-6f);
    near3(s->lights[2].direction, 0, -1, 0, 1e-6f);
    near3(s->lights[2].value, 3, 3, 3, 0);
    near1(s->lights[3].image.data[5], 50, 0);
    near3(xform_vector(&s->lights[3].to_world, v3(0, 0, 1)), 1, 0, 0, 1e-6f);
    near3(xform_vector(&s->lights[3].to_local, v3(1, 0, 0)), 0, 0, 1, 1e-6f);
    assert_int_equal(s->lights[4].type, TR_LIGHT_ENVMAP);
    assert_int_equal(s->lights[5].type, TR_LIGHT_SUN);
    near3(s->lights[5].direction, 0, -sqrtf(0.5f), -sqrtf(0.5f), 1e-5f);
    assert_int_equal(s->lights[6].type, TR_LIGHT_AREA);
    assert_int_equal(s->lights[6].shape, 0);
    assert_int_equal(s->shapes[0].light, 6);
    assert_int_equal(s->shapes[1].light, -1);
    assert_int_equal(s->environment_count, 3);
    near1(s->shapes[0].area, 4, 1e-5f);
    near1(s->shapes[0].area_cdf[1], 0.5f, 1e-6f);
    near3(s->bounds_max, 1, 1, 1, 1e-6f);
    tr_scene_free(s);
}

/* ---- >>camera ----------------------------------------------------------------------------------------------- */

static void test_camera_and_film(void **state)
{
    (void)state;
    tr_scene *s = load_clean("<scene version='0.5.0'><emitter type='constant'/><sensor type='thinlens'>"
                             "<float name='fov' value='50'/><string name='fovAxis' value='y'/>"
                             "<float name='apertureRadius' value='0.25'/><float name='focusDistance' value='3'/>"
                             "<sampler type='independent'><integer name='sampleCount' value='4'/></sampler>"
                             "<film type='hdrfilm'><integer name='width' value='100'/><integer name='height' "
                             "value='50'/><boolean name='banner' value='false'/><rfilter type='box'/></film></sensor>"
                             "</scene>");
    near1(s->camera.fov, 50, 0);
    assert_int_equal(s->camera.fov_axis, 1);
    near1(s->camera.aperture, 0.25f, 0);
    near1(s->camera.focus, 3, 0);
    assert_int_equal(s->width, 100);
    assert_int_equal(s->filter, TR_FILTER_BOX);
    tr_scene_free(s);
    s = load_clean("<scene version='0.5.0'><emitter type='constant'/><sensor type='perspective'>"
                   "<string name='focalLength' value='50mm'/></sensor></scene>");
    near1(s->camera.fov, 46.79f, 0.01f);
    assert_int_equal(s->camera.fov_axis, 2);
    assert_int_equal(s->filter, TR_FILTER_GAUSSIAN);
    tr_scene_free(s);
}

/* ---- >>shapes ----------------------------------------------------------------------------------------------- */

static bool trace(const tr_scene *s, vec3 o, vec3 d, float near, tr_surface *surface)
{
    struct RTCRayHit rh;
    memset(&rh, 0, sizeof rh);
    d = norm3(d);
    rh.ray.org_x = o.x;
    rh.ray.org_y = o.y;
    rh.ray.org_z = o.z;
    rh.ray.dir_x = d.x;
    rh.ray.dir_y = d.y;
    rh.ray.dir_z = d.z;
    rh.ray.tnear = near;
    rh.ray.tfar = INFINITY;
    rh.ray.mask = UINT32_MAX;
    rh.hit.geomID = RTC_INVALID_GEOMETRY_ID;
    struct RTCRay shadow = rh.ray;
    tr_rtc_intersect(s->rtc, &rh);
    bool hit = rh.hit.geomID != RTC_INVALID_GEOMETRY_ID;
    assert_int_equal(hit, tr_rtc_occluded(s->rtc, &shadow) != 0);
    if (hit)
        tr_surface_from_hit(s, &rh, surface);
    return hit;
}

static tr_scene *one_shape(const char *shape)
{
    char xml[2048];
    snprintf(xml, sizeof xml, "<scene version='3.0.0'>" LIGHT "%s</scene>", shape);
    return load_clean(xml);
}

static void check_frame(const tr_surface *s)
{
    near1(len3(s->ng), 1, 1e-5f);
    near1(len3(s->ns), 1, 1e-5f);
    near1(dot3(s->ns, norm3(s->dpdu)), 0, 1e-4f);
    near1(dot3(s->ns, norm3(s->dpdv)), 0, 1e-4f);
}

static void test_rectangle(void **state)
{
    (void)state;
    tr_surface h;
    tr_scene *s = one_shape("<shape type='rectangle'/>");
    assert_true(trace(s, v3(0.5f, -0.25f, 2), v3(0, 0, -1), 0, &h));
    near3(h.p, 0.5f, -0.25f, 0, 1e-6f);
    near3(h.ng, 0, 0, 1, 1e-6f);
    near1(h.u, 0.75f, 1e-6f);
    near1(h.v, 0.375f, 1e-6f);
    near1(h.t, 2, 1e-6f);
    near3(h.dpdu, 2, 0, 0, 1e-5f);
    near3(h.dpdv, 0, 2, 0, 1e-5f);
    check_frame(&h);
    assert_false(trace(s, v3(1.5f, 0, 2), v3(0, 0, -1), 0, &h));
    tr_scene_free(s);
    /* A mirrored rectangle still shows the side that the transformed normal points to. */
    s = one_shape("<shape type='rectangle'><transform name='to_world'><scale x='-1'/></transform></shape>");
    assert_true(trace(s, v3(0.5f, 0, 2), v3(0, 0, -1), 0, &h));
    near3(h.ng, 0, 0, 1, 1e-6f);
    near1(h.u, 0.25f, 1e-6f);
    tr_scene_free(s);
    s = one_shape("<shape type='rectangle'><boolean name='flip_normals' value='true'/></shape>");
    assert_true(trace(s, v3(0, 0, 2), v3(0, 0, -1), 0, &h));
    near3(h.ng, 0, 0, -1, 1e-6f);
    near3(h.ns, 0, 0, -1, 1e-6f);
    tr_scene_free(s);
}

static void test_cube_faces_point_outwards(void **state)
{
    (void)state;
    static const float axes[6][3] = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}, {0, 0, 1}, {0, 0, -1}};
    tr_surface h;
    tr_scene *s = one_shape("<shape type='cube'/>");
    for (int i = 0; i < 6; ++i) {
        vec3 n = v3(axes[i][0], axes[i][1], axes[i][2]);
        assert_true(trace(s, add3(scale3(n, 3), v3(0.1f, 0.1f, 0.1f)), neg3(n), 0, &h));
        near3(h.ng, n.x, n.y, n.z, 1e-6f);
        check_frame(&h);
        assert_true(trace(s, v3(0, 0, 0), n, 0, &h)); /* from inside */
        near3(h.ng, n.x, n.y, n.z, 1e-6f);
    }
    near1(s->shapes[0].area, 24, 1e-4f);
    tr_scene_free(s);
}

static void test_sphere(void **state)
{
    (void)state;
    tr_surface h;
    tr_rng r = rng_seed(3, 1);
    tr_scene *s = one_shape("<shape type='sphere'><point name='center' x='1' y='2' z='3'/><float name='radius' "
                            "value='0.5'/><transform name='to_world'><scale value='2'/><translate x='100'/>"
                            "</transform></shape>");
    vec3 c = v3(102, 4, 6);
    assert_int_equal(s->shapes[0].type, TR_SHAPE_SPHERE);
    near1(s->shapes[0].radius, 1, 1e-5f);
    near1(s->shapes[0].area, 4 * TR_PI, 1e-4f);
    assert_true(trace(s, add3(c, v3(0, 0, 5)), v3(0, 0, -1), 0, &h));
    near3(h.p, 102, 4, 7, 1e-5f);
    near1(h.v, 0, 1e-3f);
    check_frame(&h);
    for (int i = 0; i < 2000; ++i) {
        vec3 d = sample_uniform_sphere(rng_float(&r), rng_float(&r));
        assert_true(trace(s, c, d, 0, &h)); /* from inside */
        near1(h.t, 1, 2e-5f);
        near3(h.ng, d.x, d.y, d.z, 2e-5f);
        check_frame(&h);
        float phi = atan2f(d.y, d.x);
        near1(h.u, (phi < 0 ? phi + 2 * TR_PI : phi) / (2 * TR_PI), 1e-4f);
        near1(h.v, acosf(clampf(d.z, -1, 1)) / TR_PI, 1e-3f);
        /* From far off towards a point on it: p lies on the sphere to float rounding. */
        vec3 far = madd3(c, sample_uniform_sphere(rng_float(&r), rng_float(&r)), 3000);
        if (trace(s, far, sub3(madd3(c, d, 0.9f), far), 0, &h)) {
            near1(len3(sub3(h.p, c)), 1, 2e-5f);
            assert_true(dot3(h.ng, sub3(far, h.p)) > 0);
        }
        /* Leaving from the surface inwards crosses it once more. */
        assert_true(trace(s, add3(c, d), neg3(d), 1e-3f, &h));
        near1(h.t, 2, 1e-4f);
    }
    tr_scene_free(s);
    s = one_shape("<shape type='sphere'><boolean name='flip_normals' value='true'/></shape>");
    assert_true(trace(s, v3(0, 0, 0), v3(1, 0, 0), 0, &h));
    near3(h.ng, -1, 0, 0, 1e-6f);
    tr_scene_free(s);
}

static void test_stretched_sphere_becomes_a_mesh(void **state)
{
    (void)state;
    tr_surface h;
    tr_scene *s = one_shape("<shape type='sphere'><transform name='to_world'><scale x='2' y='1' z='-1'/></transform>"
                            "</shape>");
    assert_int_equal(messages.notes, 1);
    assert_int_equal(s->shapes[0].type, TR_SHAPE_MESH);
    assert_true(trace(s, v3(5, 0.01f, 0.02f), v3(-1, 0, 0), 0, &h));
    near3(h.p, 2, 0.01f, 0.02f, 1e-2f);
    near3(h.ng, 1, 0, 0, 0.1f);
    near3(h.ns, 1, 0, 0, 0.1f);
    tr_scene_free(s);
}

static void test_disk(void **state)
{
    (void)state;
    tr_surface h;
    tr_scene *s = one_shape("<shape type='disk'><transform name='to_world'><scale x='2' y='3'/><translate z='1'/>"
                            "</transform></shape>");
    near1(s->shapes[0].area, 6 * TR_PI, 1e-4f);
    assert_true(trace(s, v3(0, 1.5f, 5), v3(0, 0, -1), 0, &h));
    near3(h.p, 0, 1.5f, 1, 1e-6f);
    near3(h.ng, 0, 0, 1, 1e-6f);
    near1(h.u, 0.5f, 1e-6f);
    near1(h.v, 0.25f, 1e-6f);
    near3(h.dpdu, 0, 3, 0, 1e-5f);
    check_frame(&h);
    assert_true(trace(s, v3(0, 1.5f, -5), v3(0, 0, 1), 0, &h));
    near3(h.ng, 0, 0, 1, 1e-6f);
    assert_false(trace(s, v3(2.1f, 0, 5), v3(0, 0, -1), 0, &h));
    assert_false(trace(s, v3(0, 0, 5), v3(1, 0, 0), 0, &h));
    tr_scene_free(s);
}

static void test_cylinder(void **state)
{
    (void)state;
    tr_surface h;
    tr_scene *s = one_shape("<shape type='cylinder'><point name='p0' x='0' y='1' z='0'/><point name='p1' x='0' y='5' "
                            "z='0'/><float name='radius' value='2'/></shape>");
    assert_int_equal(s->shapes[0].type, TR_SHAPE_CYLINDER);
    near1(s->shapes[0].area, 16 * TR_PI, 1e-3f);
    assert_true(trace(s, v3(10, 2, 0), v3(-1, 0, 0), 0, &h));
    near3(h.p, 2, 2, 0, 1e-5f);
    near3(h.ng, 1, 0, 0, 1e-5f);
    near1(h.v, 0.25f, 1e-5f);
    check_frame(&h);
    assert_true(trace(s, v3(0, 3, 0), v3(0, 0, -1), 0, &h)); /* from inside */
    near3(h.p, 0, 3, -2, 1e-5f);
    near3(h.ng, 0, 0, -1, 1e-5f);
    assert_true(trace(s, v3(1, 10, 0), v3(1, -6, 0), 0, &h)); /* in through the open end */
    near3(h.p, 2, 4, 0, 1e-4f);
    assert_false(trace(s, v3(0, 10, 0), v3(0, -1, 0), 0, &h)); /* along the axis: no caps */
    near3(s->bounds_min, -2, 1, -2, 1e-3f);
    near3(s->bounds_max, 2, 5, 2, 1e-3f);
    tr_scene_free(s);
}

/* ---- >>meshes ----------------------------------------------------------------------------------------------- */

/* A quad in z = 0 as a PLY: header and text rows. */
#define PLY_HEAD(format, normals)                                                                                      \
    "ply\nformat " format                                                                                              \
    " 1.0\ncomment c\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n" normals                \
    "property float u\nproperty float v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"

static const float quad[4][5] = {{0, 0, 0, 0, 0}, {2, 0, 0, 1, 0}, {2, 2, 0, 1, 1}, {0, 2, 0, 0, 1}};

static void put(unsigned char **at, const void *value, size_t size, bool swap)
{
    const unsigned char *v = value;
    for (size_t i = 0; i < size; ++i)
        *(*at)++ = v[swap ? size - 1 - i : i];
}

static size_t binary_ply(unsigned char *out, bool big)
{
    const char *head = big ? PLY_HEAD("binary_big_endian", "") : PLY_HEAD("binary_little_endian", "");
    unsigned char *at = out + strlen(head);
    memcpy(out, head, strlen(head));
    for (int i = 0; i < 20; ++i)
        put(&at, &quad[i / 5][i % 5], 4, big);
    *at++ = 4;
    for (int32_t i = 0; i < 4; ++i)
        put(&at, &i, 4, big);
    return (size_t)(at - out);
}

static const char *const mesh_xml = "<scene version='3.0.0'>" LIGHT "\n<shape type='ply'>\n<string name='filename' "
                                    "value='a.ply'/></shape></scene>";

static void check_quad(const char *xml)
{
    tr_surface h;
    tr_scene *s = load_clean(xml);
    assert_int_equal(s->shapes[0].triangle_count, 2);
    assert_true(trace(s, v3(0.5f, 1.5f, 3), v3(0, 0, -1), 0, &h));
    near3(h.p, 0.5f, 1.5f, 0, 1e-6f);
    near3(h.ng, 0, 0, 1, 1e-6f);
    near1(h.u, 0.25f, 1e-6f);
    near1(h.v, 0.75f, 1e-6f);
    check_frame(&h);
    tr_scene_free(s);
}

static void test_ply_formats(void **state)
{
    (void)state;
    unsigned char data[2048];
    write_text("a.ply", PLY_HEAD("ascii", "") "0 0 0 0 0\n2 0 0 1 0\n2 2 0 1 1\n0 2 0 0 1\n4 0 1 2 3\n");
    check_quad(mesh_xml);
    write_file("a.ply", data, binary_ply(data, false));
    check_quad(mesh_xml);
    write_file("a.ply", data, binary_ply(data, true));
    check_quad(mesh_xml);
}

/* Assimp 5.2 takes such a byte for the end of a line and reads everything after it shifted by one. */
static void test_binary_ply_that_starts_with_a_newline_byte(void **state)
{
    (void)state;
    unsigned char data[2048], *x;
    size_t size = binary_ply(data, false);
    x = data + strlen(PLY_HEAD("binary_little_endian", ""));
    x[0] = '\n'; /* a denormal instead of 0 */
    write_file("a.ply", data, size);
    check_quad(mesh_xml);
}

static void test_mesh_normals(void **state)
{
    (void)state;
    tr_surface h;
    /* A roof: two triangles sharing the ridge (0,0,1)-(0,2,1). */
    const char *roof = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
                       "element face 2\nproperty list uchar int vertex_index\nend_header\n"
                       "0 0 1\n0 2 1\n-1 1 0\n1 1 0\n3 0 1 2\n3 1 0 3\n";
    write_text("a.ply", roof);
    tr_scene *s = load_clean(mesh_xml);
    assert_true(trace(s, v3(1e-4f, 1, 5), v3(0, 0, -1), 0, &h));
    near3(h.ns, 0, 0, 1, 1e-3f); /* smooth across the ridge */
    near3(h.ng, sqrtf(0.5f), 0, sqrtf(0.5f), 1e-4f);
    tr_scene_free(s);
    s = load_clean("<scene version='3.0.0'>" LIGHT "<shape type='ply'><string name='filename' value='a.ply'/><boolean "
                   "name='face_normals' value='true'/></shape></scene>");
    assert_true(trace(s, v3(1e-4f, 1, 5), v3(0, 0, -1), 0, &h));
    near3(h.ns, sqrtf(0.5f), 0, sqrtf(0.5f), 1e-4f);
    assert_null(s->shapes[0].normals);
    tr_scene_free(s);
    /* Vertex normals on the other side than the winding: the geometric normal follows them. */
    write_text(
        "a.ply",
        PLY_HEAD(
            "ascii",
            "property float nx\nproperty float ny\nproperty float nz\n") "0 0 0 0 0 -1 0 0\n2 0 0 0 0 -1 1 0\n2 2 0 0 "
                                                                         "0 -1 1 1\n0 2 0 0 0 -1 0 1\n4 0 1 2 3\n");
    s = load_clean(mesh_xml);
    assert_true(trace(s, v3(0.5f, 1.5f, 3), v3(0, 0, -1), 0, &h));
    near3(h.ng, 0, 0, -1, 1e-6f);
    near3(h.ns, 0, 0, -1, 1e-6f);
    near1(h.u, 0.25f, 1e-6f);
    tr_scene_free(s);
    /* Mirrored: vertex normals keep their side, face normals follow the winding. */
    s = load_clean("<scene version='3.0.0'>" LIGHT "<shape type='ply'><string name='filename' value='a.ply'/>"
                   "<transform name='to_world'><scale x='-1'/></transform></shape><shape type='ply'><string "
                   "name='filename' value='a.ply'/><boolean name='face_normals' value='true'/><transform "
                   "name='to_world'><scale x='-1'/><translate x='10'/></transform></shape></scene>");
    assert_true(trace(s, v3(-0.5f, 1, 3), v3(0, 0, -1), 0, &h));
    near3(h.ng, 0, 0, -1, 1e-6f);
    assert_true(trace(s, v3(9.5f, 1, 3), v3(0, 0, -1), 0, &h));
    near3(h.ng, 0, 0, -1, 1e-6f);
    tr_scene_free(s);
}

static const char *const quad_obj = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
                                    "f 1/1 2/2 3/3 4/4\n";

static void test_obj(void **state)
{
    (void)state;
    write_text("a.obj", quad_obj);
    check_quad("<scene version='3.0.0'>" LIGHT "<shape type='obj'><string name='filename' value='a.obj'/></shape>"
               "</scene>");
}

/* ---- >>serialized ------------------------------------------------------------------------------------------- */

enum { SERIAL_MAX = 8192 };

static void put_number(unsigned char **at, uint64_t v, int bytes)
{
    for (int i = 0; i < bytes; ++i)
        *(*at)++ = (unsigned char)(v >> 8 * i);
}

/* A mesh as Mitsuba writes it: the quad moved up by z. */
static size_t serialized_mesh(unsigned char *out, int version, bool wide, float z)
{
    unsigned char raw[1024], *r = raw, *at = out;
    static const uint32_t indices[6] = {0, 1, 2, 2, 3, 0};
    put_number(&r, 0x2u | (wide ? 0x2000u : 0x1000u), 4);
    if (version == 4)
        put_number(&r, 'm' | 'e' << 8, 3); /* name "me" */
    put_number(&r, 4, 8);
    put_number(&r, 2, 8);
    for (int part = 0; part < 2; ++part) /* positions, then texture coordinates */
        for (int i = 0; i < 4; ++i)
            for (int c = part ? 3 : 0; c < (part ? 5 : 3); ++c) {
                float f = c == 2 ? z : quad[i][c];
                double d = (double)f;
                put(&r, wide ? (void *)&d : (void *)&f, wide ? 8 : 4, false);
            }
    for (int i = 0; i < 6; ++i)
        put_number(&r, indices[i], 4);
    put_number(&at, 0x041c, 2);
    put_number(&at, (uint64_t)version, 2);
    uLongf size = SERIAL_MAX / 4;
    assert_int_equal(compress(at, &size, raw, (uLong)(r - raw)), Z_OK);
    return 4 + (size_t)size;
}

static size_t serialized_file(unsigned char *out, int version, bool wide)
{
    size_t first = serialized_mesh(out, version, wide, 0), second = serialized_mesh(out + first, version, !wide, 4);
    unsigned char *at = out + first + second;
    put_number(&at, 0, version == 4 ? 8 : 4);
    put_number(&at, first, version == 4 ? 8 : 4);
    put_number(&at, 2, 4);
    return (size_t)(at - out);
}

static void test_serialized(void **state)
{
    (void)state;
    unsigned char data[SERIAL_MAX];
    for (int version = 3; version <= 4; ++version)
        for (int wide = 0; wide < 2; ++wide) {
            write_file("a.serialized", data, serialized_file(data, version, wide));
            check_quad("<scene version='0.6.0'>" LIGHT "<shape type='serialized'><string name='filename' "
                       "value='a.serialized'/></shape></scene>");
            tr_scene *s = load_clean("<scene version='0.6.0'>" LIGHT "<shape type='serialized'><string name='filename' "
                                     "value='a.serialized'/><integer name='shapeIndex' value='1'/></shape></scene>");
            near1(s->bounds_min.z, 4, 0);
            tr_scene_free(s);
        }
}

/* ---- >>gltf ------------------------------------------------------------------------------------------------- */

static void base64(char *out, const unsigned char *data, size_t size)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for (size_t i = 0; i < size; i += 3) {
        uint32_t v = (uint32_t)data[i] << 16;
        v |= i + 1 < size ? (uint32_t)data[i + 1] << 8 : 0;
        v |= i + 2 < size ? data[i + 2] : 0;
        *out++ = digits[v >> 18];
        *out++ = digits[v >> 12 & 63];
        *out++ = i + 1 < size ? digits[v >> 6 & 63] : '=';
        *out++ = i + 2 < size ? digits[v & 63] : '=';
    }
    *out = 0;
}

/* 2x1 pixels as an uncompressed PNG; alpha of the right one 0. */
static void png_base64(char *out)
{
    unsigned char png[256], *at = png, raw[9] = {0, 255, 128, 64, 255, 10, 20, 30, 0}, z[64];
    static const unsigned char head[8] = {0x89, 'P', 'N', 'G', 13, 10, 26, 10},
                               end[12] = {0, 0, 0, 0, 'I', 'E', 'N', 'D', 0xae, 0x42, 0x60, 0x82};
    const uint32_t ihdr[2] = {2, 1};
    uLongf size = sizeof z;
    assert_int_equal(compress(z, &size, raw, sizeof raw), Z_OK);
    memcpy(at, head, 8);
    at += 8;
    for (int chunk = 0; chunk < 2; ++chunk) {
        uint32_t length = chunk ? (uint32_t)size : 13;
        put(&at, &length, 4, true);
        unsigned char *start = at;
        memcpy(at, chunk ? "IDAT" : "IHDR", 4);
        at += 4;
        if (chunk) {
            memcpy(at, z, size);
            at += size;
        } else {
            put(&at, &ihdr[0], 4, true);
            put(&at, &ihdr[1], 4, true);
            memcpy(at, "\10\6\0\0\0", 5);
            at += 5;
        }
        uint32_t crc = (uint32_t)crc32(crc32(0, NULL, 0), start, (uInt)(at - start));
        put(&at, &crc, 4, true);
    }
    memcpy(at, end, 12);
    base64(out, png, (size_t)(at + 12 - png));
}

enum { GLTF_BINARY = 68 };

/* binary: the buffer itself, which the text then leaves out as .glb files do; NULL = embed it. */
static const char *gltf_text(bool with_camera, bool with_lights, unsigned char *binary)
{
    static char text[8192];
    char buffer[256], uri[320], image[512];
    unsigned char data[GLTF_BINARY], *at = data;
    static const float p[15] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1}; /* positions, then uv */
    for (int i = 0; i < 9; ++i)
        put(&at, &p[i], 4, false);
    for (int i = 0; i < 4; ++i)
        put_number(&at, i < 3 ? (uint64_t)i : 0, 2);
    for (int i = 9; i < 15; ++i)
        put(&at, &p[i], 4, false);
    base64(buffer, data, sizeof data);
    snprintf(uri, sizeof uri, ",\"uri\":\"data:application/octet-stream;base64,%s\"", buffer);
    if (binary)
        memcpy(binary, data, sizeof data);
    png_base64(image);
    snprintf(
        text, sizeof text,
        "{\"asset\":{\"version\":\"2.0\"},\"scene\":0,\"scenes\":[{\"nodes\":[0,1%s%s]}],"
        "\"extensionsUsed\":[\"KHR_lights_punctual\",\"KHR_materials_emissive_strength\"],"
        "\"extensions\":{\"KHR_lights_punctual\":{\"lights\":[{\"type\":\"point\",\"color\":[1,0.5,0.25],"
        "\"intensity\":20},{\"type\":\"spot\",\"intensity\":10,\"spot\":{\"innerConeAngle\":0.3,"
        "\"outerConeAngle\":0.5}},{\"type\":\"directional\",\"intensity\":3}]}},"
        "\"nodes\":[{\"mesh\":0,\"name\":\"tri\",\"translation\":[0,0,-5]},{\"mesh\":1,\"name\":\"glow\",\"scale\":"
        "[2,2,2]},{\"camera\":0,\"name\":\"cam\",\"translation\":[0,1,3]},"
        "{\"name\":\"pl\",\"translation\":[1,2,3],\"extensions\":{\"KHR_lights_punctual\":{\"light\":0}}},"
        "{\"name\":\"sp\",\"translation\":[0,3,0],\"extensions\":{\"KHR_lights_punctual\":{\"light\":1}}},"
        "{\"name\":\"di\",\"extensions\":{\"KHR_lights_punctual\":{\"light\":2}}}],"
        "\"cameras\":[{\"type\":\"perspective\",\"perspective\":{\"yfov\":0.8,\"aspectRatio\":1.6,\"znear\":0.1}}],"
        "\"images\":[{\"uri\":\"data:image/png;base64,%s\"}],\"textures\":[{\"source\":0}],"
        "\"materials\":[{\"name\":\"metal\",\"alphaMode\":\"MASK\",\"pbrMetallicRoughness\":{\"baseColorFactor\":"
        "[0.5,1,1,1],\"metallicFactor\":0.25,\"roughnessFactor\":0.75,\"baseColorTexture\":{\"index\":0},"
        "\"metallicRoughnessTexture\":{\"index\":0}}},"
        "{\"name\":\"glow\"%s,\"pbrMetallicRoughness\":{\"baseColorFactor\":[0.2,0.4,0.6,1],\"metallicFactor\":0.5,"
        "\"roughnessFactor\":0.3}}],"
        "\"meshes\":[{\"primitives\":[{\"attributes\":{\"POSITION\":0,\"TEXCOORD_0\":2},\"indices\":1,\"material\":0}]}"
        ",{\"primitives\":[{\"attributes\":{\"POSITION\":0},\"indices\":1,\"material\":1}]}],"
        "\"buffers\":[{\"byteLength\":68%s}],"
        "\"bufferViews\":[{\"buffer\":0,\"byteOffset\":0,\"byteLength\":36},{\"buffer\":0,\"byteOffset\":36,"
        "\"byteLength\":6},{\"buffer\":0,\"byteOffset\":44,\"byteLength\":24}],"
        "\"accessors\":[{\"bufferView\":0,\"componentType\":5126,\"count\":3,\"type\":\"VEC3\",\"min\":[0,0,0],"
        "\"max\":[1,1,0]},{\"bufferView\":1,\"componentType\":5123,\"count\":3,\"type\":\"SCALAR\"},{\"bufferView\":2,"
        "\"componentType\":5126,\"count\":3,\"type\":\"VEC2\"}]}",
        with_camera ? ",2" : "", with_lights ? ",3,4,5" : "", image,
        with_lights ? ",\"emissiveFactor\":[1,0.5,0],\"extensions\":{\"KHR_materials_emissive_strength\":"
                      "{\"emissiveStrength\":7}}"
                    : "",
        binary ? "" : uri);
    return text;
}

static void check_gltf(const tr_scene *s)
{
    tr_surface h;
    near1(s->camera.fov, 0.8f * 180 / TR_PI, 1e-3f);
    assert_int_equal(s->camera.fov_axis, 1);
    assert_int_equal(s->height, 800);
    near3(xform_point(&s->camera.to_world, v3(0, 0, 0)), 0, 1, 3, 1e-6f);
    near3(xform_vector(&s->camera.to_world, v3(0, 0, 1)), 0, 0, -1, 1e-6f);
    near3(xform_vector(&s->camera.to_world, v3(1, 0, 0)), -1, 0, 0, 1e-6f); /* +x is left */
    near3(xform_vector(&s->camera.to_world, v3(0, 1, 0)), 0, 1, 0, 1e-6f);
    assert_int_equal(s->light_count, 4);
    assert_int_equal(s->lights[0].type, TR_LIGHT_AREA);
    near3(s->lights[0].value, 7, 3.5f, 0, 1e-5f);
    assert_int_equal(s->lights[1].type, TR_LIGHT_POINT);
    near3(s->lights[1].value, 20, 10, 5, 1e-4f);
    near3(s->lights[1].position, 1, 2, 3, 1e-6f);
    assert_int_equal(s->lights[2].type, TR_LIGHT_SPOT);
    near1(s->lights[2].cutoff_cos, cosf(0.5f), 1e-6f);
    near1(s->lights[2].beam_cos, cosf(0.3f), 1e-6f);
    near3(s->lights[2].direction, 0, 0, -1, 1e-6f);
    assert_int_equal(s->lights[3].type, TR_LIGHT_DIRECTIONAL);
    near3(s->lights[3].value, 3, 3, 3, 1e-5f);
    assert_true(trace(s, v3(0.1f, 0.5f, -4), v3(0, 0, -1), 0, &h));
    near3(h.p, 0.1f, 0.5f, -5, 1e-5f);
    near1(h.v, 0.5f, 1e-6f); /* glTF counts v downwards */
    const tr_bsdf *mask = &s->bsdfs[s->shapes[h.shape].bsdf];
    assert_int_equal(mask->type, TR_BSDF_MASK);
    assert_int_equal(s->bsdfs[mask->child[0]].type, TR_BSDF_TWOSIDED);
    const tr_bsdf *pbr = &s->bsdfs[s->bsdfs[mask->child[0]].child[0]];
    assert_int_equal(pbr->type, TR_BSDF_PBR);
    const float *opacity = s->textures[mask->opacity.texture].image.data;
    near1(opacity[0], 1, 0);
    near1(opacity[3], 0, 0);
    const float *color = s->textures[pbr->reflectance.texture].image.data;
    near1(color[0], 0.5f, 1e-6f);
    near1(color[1], tr_srgb_decode(128 / 255.0f), 1e-6f);
    near1(s->textures[pbr->alpha.texture].image.data[0], 0.75f * 128 / 255, 1e-6f);
    near1(s->textures[pbr->metallic.texture].image.data[0], 0.25f * 64 / 255, 1e-6f);
    assert_true(trace(s, v3(0.2f, 0.2f, 3), v3(0, 0, -1), 0, &h));
    near1(s->shapes[h.shape].area, 2, 1e-5f);
    const tr_bsdf *glow = &s->bsdfs[s->bsdfs[s->shapes[h.shape].bsdf].child[0]];
    near3(glow->reflectance.value, 0.2f, 0.4f, 0.6f, 1e-6f);
    near1(glow->alpha.value.x, 0.3f, 1e-6f);
    near1(glow->metallic.value.x, 0.5f, 1e-6f);
}

static void test_gltf(void **state)
{
    (void)state;
    const char *text = gltf_text(true, true, NULL);
    tr_scene *s = load_file(write_text("scene.gltf", text), NULL, 0);
    if (!s || messages.warnings)
        fprintf(stderr, "%s", said);
    assert_non_null(s);
    assert_int_equal(messages.warnings, 0);
    check_gltf(s);
    tr_scene_free(s);
    /* The same as .glb. */
    unsigned char glb[8192 + 128], binary[GLTF_BINARY], *at = glb;
    text = gltf_text(true, true, binary);
    size_t length = strlen(text), padded = (length + 3) & ~(size_t)3, total = 28 + padded + GLTF_BINARY;
    put_number(&at, 0x46546c67, 4);
    put_number(&at, 2, 4);
    put_number(&at, total, 4);
    put_number(&at, padded, 4);
    put_number(&at, 0x4e4f534a, 4);
    memset(at, ' ', padded);
    memcpy(at, text, length);
    at += padded;
    put_number(&at, GLTF_BINARY, 4);
    put_number(&at, 0x004e4942, 4);
    memcpy(at, binary, GLTF_BINARY);
    s = load_file(write_file("scene.glb", glb, total), NULL, 0);
    if (!s)
        fprintf(stderr, "%s", said);
    assert_non_null(s);
    check_gltf(s);
    tr_scene_free(s);
}

static void test_gltf_without_camera_and_lights(void **state)
{
    (void)state;
    tr_scene *s = load_file(write_text("scene.gltf", gltf_text(false, false, NULL)), NULL, 0);
    tr_surface h;
    assert_non_null(s);
    assert_int_equal(messages.notes, 2);
    assert_int_equal(s->lights[0].type, TR_LIGHT_CONSTANT);
    vec3 eye = xform_point(&s->camera.to_world, v3(0, 0, 0));
    vec3 middle = v3(0.3f, 0.3f, -5); /* a point of the far triangle */
    assert_true(trace(s, eye, sub3(middle, eye), 0, &h));
    tr_scene_free(s);
    s = load_file(write_text("scene.gltf", "{\"asset\":"), NULL, 0);
    assert_null(s);
    assert_non_null(strstr(said, "scene.gltf: error:"));
}

/* ---- >>told ------------------------------------------------------------------------------------------------- */

static void note_file(void *user, const char *path)
{
    char *list = user;
    const char *slash = strrchr(path, '/');
    strcat(list, slash ? slash + 1 : path);
    strcat(list, " ");
}

/* Everything that decides what is seen is told, so that a caller can notice that it changed. */
static void test_files_that_are_read_are_told(void **state)
{
    (void)state;
    char list[400] = "";
    tr_log log = {.on_file = note_file, .user = list};
    write_text("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    write_text("a.spd", "400 0.5 700 0.5");
    write_exr("a.exr", 4, 2);
    write_text("other.xml", "<scene><shape type='obj'><string name='filename' value='a.obj'/>"
                            "<bsdf type='diffuse'><texture name='reflectance' type='bitmap'>"
                            "<string name='filename' value='a.exr'/></texture></bsdf></shape></scene>");
    const char *xml = write_text("scene.xml", "<scene version='3.0.0'><include filename='other.xml'/>" LIGHT
                                              "<shape type='sphere'><bsdf type='diffuse'><spectrum name='reflectance' "
                                              "filename='a.spd'/></bsdf></shape></scene>");
    tr_scene *s = tr_scene_load(xml, NULL, 0, 1, &log);
    assert_non_null(s);
    assert_non_null(strstr(list, "scene.xml "));
    assert_non_null(strstr(list, "other.xml "));
    assert_non_null(strstr(list, "a.obj "));
    assert_non_null(strstr(list, "a.exr "));
    assert_non_null(strstr(list, "a.spd "));
    tr_scene_free(s);
    /* The importer of glTF reads its buffers itself. */
    static char text[8192];
    unsigned char binary[GLTF_BINARY];
    const char *embedded = gltf_text(true, true, binary), *at = strstr(embedded, "\"byteLength\":68}");
    assert_non_null(at);
    snprintf(text, sizeof text, "%.*s\"byteLength\":68,\"uri\" : \"a.spd\"}%s", (int)(at - embedded), embedded,
             at + 16);
    write_file("a.spd", binary, sizeof binary);
    *list = 0;
    s = tr_scene_load(write_text("scene.gltf", text), NULL, 0, 1, &log);
    assert_non_null(s);
    assert_string_equal(list, "scene.gltf a.spd ");
    tr_scene_free(s);
}

/* ---- >>bad -------------------------------------------------------------------------------------------------- */

/* What must be said, with its place, for a scene whose body starts in line 2. */
typedef struct bad_case {
    const char *body, *expected;
} bad_case;

static void check_bad(const bad_case *c)
{
    char xml[8192];
    snprintf(xml, sizeof xml, "<scene version='3.0.0'>" LIGHT "\n%s\n</scene>", c->body);
    tr_scene *s = load_text(xml);
    if (!strstr(said, c->expected) || !strstr(said, "scene.xml:"))
        fail_msg("\n%s\nshould say '%s' but says\n%s", c->body, c->expected, said);
    tr_scene_free(s);
}

static void test_bad_scenes_name_file_and_line(void **state)
{
    (void)state;
    static const bad_case cases[] = {
        {"<shape type='ply'>\n<string name='filename' value='absent.ply'/></shape>", "scene.xml:3: error: cannot read"},
        {"<shape type='sphere'>\n<float name='radius' value='1.5x'/></shape>", ":3: error: '1.5x' is not a number"},
        {"<shape type='sphere'>\n<float name='radius' value='nan'/></shape>", ":3: error: 'nan' is not a number"},
        {"<integrator type='path'>\n<integer name='max_depth' value='3.5'/></integrator>", ":3: error: '3.5'"},
        {"<shape type='cube'>\n<boolean name='flip_normals' value='yes'/></shape>", ":3: error: 'yes'"},
        {"<shape type='cube'><transform name='to_world'>\n<matrix value='1 2 3'/></transform></shape>", ":3: error:"},
        {"<shape type='cube'><transform name='to_world'>\n<rotate angle='3'/></transform></shape>", ":3: error:"},
        {"<bsdf type='diffuse'>\n<rgb name='reflectance' value='1 2'/></bsdf>", ":3: error: '1 2' is not a colour"},
        {"<bsdf type='diffuse'>\n<spectrum name='reflectance' value='500:1, 400:1'/></bsdf>", ":3: error:"},
        {"\n<nonsense/>", ":3: warning: unknown element <nonsense>"},
        {"<shape type='cube'>\n<float name='sharpness' value='3'/></shape>", ":3: warning: unknown parameter 'sharp"},
        {"<shape type='cube'>\n<nonsense/></shape>", ":3: warning: unknown element <nonsense>"},
        {"<shape type='cube'><transform name='to_world'>\n<shear x='3'/></transform></shape>", ":3: warning: unknown"},
        {"<shape type='sphere'>\n<float name='radius' value='1' colour='red'/></shape>", ":3: warning: unknown attr"},
        {"\n<bsdf type='velvet'><float name='x' value='1'/></bsdf>", ":3: warning: bsdf type 'velvet'"},
        {"\n<shape type='teapot'/>", ":3: warning: shape type 'teapot'"},
        {"\n<emitter type='laser'/>", ":3: warning: emitter type 'laser'"},
        {"<bsdf type='diffuse'>\n<texture name='reflectance' type='marble'/></bsdf>", ":3: warning: texture type"},
        {"\n<medium type='homogeneous'/>", ":3: warning: participating media"},
        {"<shape type='cube'>\n<ref id='nobody'/></shape>", ":3: error: <ref> to unknown id 'nobody'"},
        {"\n<bsdf type='twosided' id='a'><ref id='a'/></bsdf>", ":3: error: <bsdf id=\"a\"> contains itself"},
        {"<bsdf type='twosided' id='a'><ref id='b'/></bsdf>\n<bsdf type='mask' id='b'><ref id='a'/></bsdf>",
         "contains itself"},
        {"<bsdf type='diffuse'>\n<texture name='reflectance' type='scale' id='t'><ref id='t'/></texture></bsdf>",
         ":3: error: <texture id=\"t\"> contains itself"},
        {"\n<bsdf type='twosided'/>", ":3: error: <bsdf type=\"twosided\"> has 0 nested bsdfs"},
        {"\n<shape type='rectangle'><transform name='to_world'><scale x='0'/></transform><emitter "
         "type='area'/></shape>",
         ":3: warning: an area light on a shape without area"},
        {"\n<shape type='sphere'><float name='radius' value='0'/><emitter type='area'/></shape>",
         ":3: warning: an area light on a shape without area"},
        {"\n<shape type='disk'><transform name='to_world'><scale value='0'/></transform><emitter type='area'/></shape>",
         ":3: warning: an area light on a shape without area"},
        {"\n<emitter type='area'/>", ":3: error: emitter type 'area' only makes sense"},
        {"<emitter type='spot'>\n<rgb name='intensity' value='-1'/></emitter>", ":3: warning: a negative colour"},
        {"<bsdf type='diffuse'>\n<texture name='reflectance' type='bitmap'><string name='filename' value='absent.png'/>"
         "</texture></bsdf>",
         ":3: error: cannot read the image"},
        {"<bsdf type='diffuse'>\n<rgb name='reflectance' value='2'/></bsdf>", "2: warning: reflectance above 1"},
        {"<shape type='cube'>\ntext</shape>", ":3: warning: text between elements"},
        {"<bsdf type='diffuse' id='x'/>\n<bsdf type='diffuse' id='x'/>", ":3: warning: id 'x' is already used"},
        {"\n<include filename='absent.xml'/>", ":3: error: the included file cannot be read: 'absent.xml'"},
        {"\n<include filename='scene.xml'/>", "nested too deep"},
        {"\n<shape type='cube'><float name='radius' value='$missing'/></shape>", ":3: error: parameter is used"},
        {"\n<shape type='cube'>", "error: XML: mismatched tag"},
        {"<shape type='obj'>\n<string name='filename' value='scene.xml'/></shape>", ":3: "},
        {"\n<emitter type='envmap'/>", ":3: error: <emitter type=\"envmap\"> needs a filename"},
        {"\n<emitter type='constant'><transform name='to_world'><scale value='0'/></transform></emitter>",
         ":3: warning: unknown parameter 'to_world'"},
        {"\n<emitter type='point'><transform name='to_world'><scale value='0'/></transform></emitter>",
         ":3: error: the emitter's transform is singular"},
    };
    for (size_t i = 0; i < sizeof cases / sizeof *cases; ++i)
        check_bad(&cases[i]);
}

static void test_bad_sensors(void **state)
{
    (void)state;
    static const bad_case cases[] = {
        {"<sensor type='perspective'>\n<film type='hdrfilm'><integer name='width' value='0'/></film></sensor>",
         "scene.xml:2: error: a picture of 0 x"},
        {"<sensor type='perspective'>\n<film type='hdrfilm'><integer name='width' value='99999999'/></film></sensor>",
         "scene.xml:2: error: a picture of 99999999"},
        {"\n<sensor type='perspective'><float name='fov' value='180'/></sensor>",
         "scene.xml:2: error: a field of view"},
        {"\n<sensor type='perspective'><transform name='to_world'><scale y='0'/></transform></sensor>",
         "scene.xml:2: error: the sensor's transform is singular"},
        {"\n<sensor type='fisheye'/>", "scene.xml:2: warning: sensor type 'fisheye'"},
        {"\n<sensor type='perspective'/><sensor type='perspective'/>", "scene.xml:2: warning: only the first"},
        {"<sensor type='perspective'><film type='hdrfilm'>\n<integer name='cropWidth' value='9'/></film></sensor>",
         "scene.xml:2: warning: unknown parameter 'crop_width'"}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; ++i) {
        char xml[2048];
        snprintf(xml, sizeof xml, "<scene version='0.5.0'><emitter type='constant'/>%s</scene>", cases[i].body);
        tr_scene *s = load_text(xml);
        if (!strstr(said, cases[i].expected))
            fail_msg("\n%s\nshould say '%s' but says\n%s", cases[i].body, cases[i].expected, said);
        tr_scene_free(s);
    }
}

static void test_bad_files(void **state)
{
    (void)state;
    static const struct {
        const char *name, *content, *body, *expected;
    } cases[] = {
        {"a.exr", "v/1\1garbage garbage garbage",
         "<emitter type='envmap'>\n<string name='filename' value='a.exr'/>"
         "</emitter>",
         ":3: error: cannot read the image"},
        {"a.exr", "", "<emitter type='envmap'>\n<string name='filename' value='a.exr'/></emitter>", ":3: error:"},
        {"a.png", "\x89PNG\r\n\x1a\n\0\0",
         "<bsdf type='diffuse'><texture name='reflectance' type='bitmap'>\n<string "
         "name='filename' value='a.png'/></texture></bsdf>",
         ":3: error: cannot read"},
        {"a.ply",
         "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
         "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
         "<shape type='ply'>\n<string name='filename' value='a.ply'/></shape>",
         "a face of the PLY file names a vertex"},
        {"a.ply", "ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n",
         "<shape type='ply'>\n<string name='filename' value='a.ply'/></shape>", ":3: error:"},
        {"a.ply",
         "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
         "property float z\nend_header\nabc",
         "<shape type='ply'>\n<string name='filename' value='a.ply'/></shape>", "truncated"},
        {"a.ply",
         "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
         "element face 0\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n",
         "\n<shape type='ply'><string name='filename' value='a.ply'/></shape>",
         ":3: warning: the shape has no triangles"},
        {"a.ply",
         "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
         "element face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\nnan 0 1\n"
         "3 0 1 2\n3 1 2 3\n",
         "\n<shape type='ply'><string name='filename' value='a.ply'/></shape>",
         ":3: warning: 1 triangles with vertices"},
        {"a.serialized", "garbage garbage",
         "<shape type='serialized'>\n<string name='filename' value='a.serialized'/>"
         "</shape>",
         ":3: error: "},
        {"other.xml", "<scene><oops></scene>", "<include filename='other.xml'/>", "other.xml:1: error: XML"}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; ++i) {
        bad_case c = {cases[i].body, cases[i].expected};
        write_text(cases[i].name, cases[i].content);
        if (strcmp(cases[i].name, "other.xml") == 0) {
            char xml[512];
            snprintf(xml, sizeof xml, "<scene version='3.0.0'>%s</scene>", c.body);
            assert_null(load_text(xml));
            assert_non_null(strstr(said, c.expected));
        } else
            check_bad(&c);
    }
    assert_null(load_file(in_folder("absent.xml"), NULL, 0));
    assert_non_null(strstr(said, "absent.xml"));
    assert_null(load_file(folder, NULL, 0));
    assert_null(load_text("<nonscene/>"));
    assert_non_null(strstr(said, "scene.xml:1: error:"));
    assert_null(load_text(""));
}

static void test_deep_nesting_is_refused(void **state)
{
    (void)state;
    enum { DEPTH = 5000 };
    static char xml[DEPTH * 40 + 200];
    char *at = xml + sprintf(xml, "<scene version='3.0.0'>" LIGHT);
    for (int i = 0; i < DEPTH; ++i)
        at += sprintf(at, "<bsdf type='twosided'>");
    for (int i = 0; i < DEPTH; ++i)
        at += sprintf(at, "</bsdf>");
    sprintf(at, "</scene>");
    assert_null(load_text(xml));
    assert_non_null(strstr(said, "nested too deep"));
    /* A long chain of references is as deep. */
    at = xml + sprintf(xml, "<scene version='3.0.0'>" LIGHT "<bsdf type='mask' id='b0'><ref id='b1'/></bsdf>");
    for (int i = 1; i < 2000; ++i)
        at += sprintf(at, "<bsdf type='mask' id='b%d'><ref id='b%d'/></bsdf>", i, i + 1);
    sprintf(at, "<bsdf type='diffuse' id='b2000'/></scene>");
    assert_null(load_text(xml));
    assert_non_null(strstr(said, "nests too deep"));
}

/* ---- >>code ------------------------------------------------------------------------------------------------- */

static tr_scene *code_scene(void)
{
    tr_scene *s = tr_scene_new();
    mat4 id = mat4_identity();
    assert_non_null(s);
    s->path = tr_string_copy("code");
    assert_int_equal(tr_scene_add_bsdf(s, TR_BSDF_DIFFUSE), 0);
    assert_int_equal(tr_scene_add_shape(s), 0);
    assert_true(tr_shape_rectangle(&s->shapes[0], &id));
    s->shapes[0].bsdf = 0;
    assert_int_equal(tr_scene_add_light(s, TR_LIGHT_AREA), 0);
    s->lights[0].shape = 0;
    s->lights[0].value = v3s(1);
    s->shapes[0].light = 0;
    return s;
}

static void test_scenes_built_in_code(void **state)
{
    (void)state;
    for (int broken = 0; broken < 9; ++broken) {
        tr_log log = {0};
        tr_scene *s = code_scene();
        if (broken == 1)
            s->shapes[0].bsdf = 3;
        if (broken == 2)
            s->shapes[0].indices[2] = 99;
        if (broken == 3)
            s->camera.to_world.m[0][0] = NAN;
        if (broken == 4)
            s->bsdfs[0].reflectance.texture = 0;
        if (broken == 5) {
            int a = tr_scene_add_bsdf(s, TR_BSDF_TWOSIDED), b = tr_scene_add_bsdf(s, TR_BSDF_MASK);
            s->bsdfs[a].child[0] = b;
            s->bsdfs[b].child[0] = a;
        }
        if (broken == 6)
            s->lights[0].value.x = NAN;
        if (broken == 7)
            s->width = 0;
        if (broken == 8)
            s->lights[0].shape = 5;
        assert_int_equal(tr_scene_finish(s, 1, &log), broken == 0);
        assert_int_equal(log.errors > 0, broken != 0);
        if (broken == 0)
            near1(s->shapes[0].area, 4, 1e-5f);
        tr_scene_free(s);
    }
}

static void test_zero_area_light_is_removed_and_others_keep_their_shapes(void **state)
{
    (void)state;
    tr_scene *s = load_text("<scene version='3.0.0'><sensor type='perspective'/><shape type='rectangle'><transform "
                            "name='to_world'><scale y='0'/></transform><emitter type='area'/></shape><shape "
                            "type='cube'><emitter type='area'><rgb name='radiance' value='3'/></emitter></shape>"
                            "</scene>");
    assert_non_null(s);
    assert_int_equal(s->light_count, 1);
    assert_int_equal(s->shapes[0].light, -1);
    assert_int_equal(s->shapes[1].light, 0);
    assert_int_equal(s->lights[0].shape, 1);
    near3(s->lights[0].value, 3, 3, 3, 0);
    tr_scene_free(s);
}

/* ---- >>flips ------------------------------------------------------------------------------------------------ */

/* Load `name` (or a scene that names it) after random changes to its bytes: whatever comes out, nothing breaks. */
static void flip(const char *name, const unsigned char *data, size_t size, int rounds, const char *xml)
{
    static unsigned char copy[16384];
    tr_rng r = rng_seed(11, size);
    assert_true(size <= sizeof copy);
    if (xml)
        write_text("scene.xml", xml);
    for (int i = 0; i < rounds; ++i) {
        tr_log log = {0};
        size_t length = size;
        memcpy(copy, data, size);
        for (uint32_t k = 0, n = 1 + rng_u32(&r) % 4; k < n; ++k) {
            uint32_t how = rng_u32(&r) % 4, at = rng_u32(&r) % (uint32_t)size;
            if (how == 0)
                length = 1 + at;
            else if (how == 1)
                copy[at] = (unsigned char)"0123456789-.<>/'\" \n"[rng_u32(&r) % 19];
            else
                copy[at] = (unsigned char)(copy[at] ^ 1u << rng_u32(&r) % 8);
        }
        const char *path = write_file(name, copy, length);
        tr_scene *s = tr_scene_load(xml ? in_folder("scene.xml") : path, NULL, 0, 1, &log);
        assert_int_equal(s == NULL, log.errors > 0);
        tr_scene_free(s);
    }
}

static void test_flipped_xml(void **state)
{
    (void)state;
    const char *xml = "<scene version='3.0.0'><default name='d' value='5'/><emitter type='constant'/>"
                      "<integrator type='path'><integer name='max_depth' value='$d'/></integrator>"
                      "<sensor type='perspective'><float name='fov' value='40'/><film type='hdrfilm'><integer "
                      "name='width' value='64'/><rfilter type='tent'/></film></sensor>"
                      "<bsdf type='twosided' id='b'><bsdf type='roughplastic'><rgb name='diffuse_reflectance' "
                      "value='0.1, 0.2, 0.3'/><float name='alpha' value='0.2'/></bsdf></bsdf>"
                      "<shape type='sphere'><point name='center' x='1' y='2' z='3'/><transform name='to_world'>"
                      "<lookat origin='0,0,1' target='0,0,0' up='0,1,0'/><scale value='2'/></transform><ref id='b'/>"
                      "<emitter type='area'><rgb name='radiance' value='3'/></emitter></shape></scene>";
    flip("scene.xml", (const unsigned char *)xml, strlen(xml), 600, NULL);
}

static void test_flipped_meshes(void **state)
{
    (void)state;
    unsigned char data[SERIAL_MAX];
    const char *text = PLY_HEAD("ascii", "") "0 0 0 0 0\n2 0 0 1 0\n2 2 0 1 1\n0 2 0 0 1\n4 0 1 2 3\n";
    flip("a.ply", data, binary_ply(data, false), 400, mesh_xml);
    flip("a.ply", (const unsigned char *)text, strlen(text), 400, mesh_xml);
    flip("a.serialized", data, serialized_file(data, 4, false), 400,
         "<scene version='0.6.0'>" LIGHT "<shape type='serialized'><string name='filename' value='a.serialized'/>"
         "<integer name='shapeIndex' value='1'/></shape></scene>");
    flip("a.obj", (const unsigned char *)quad_obj, strlen(quad_obj), 200,
         "<scene version='0.6.0'>" LIGHT "<shape type='obj'><string name='filename' value='a.obj'/></shape></scene>");
}

static void test_flipped_gltf(void **state)
{
    (void)state;
    const char *text = gltf_text(true, true, NULL);
    flip("scene.gltf", (const unsigned char *)text, strlen(text), 200, NULL);
}

/* ---- >>real ------------------------------------------------------------------------------------------------- */

static void test_real_scenes(void **state)
{
    (void)state;
    static const struct {
        const char *file;
        uint64_t triangles;
    } scenes[] = {{"veach-ajar/scene.xml", 382690},
                  {"veach-bidir/scene.xml", 11544},
                  {"living-room/scene.xml", 143163},
                  {"kitchen/kitchen.xml", 1414391},
                  {"kitchen/kitchen-sunsky.xml", 1414391}};
    const char *root = getenv("GUIDE_SCENES");
    if (!root || !*root) {
        print_message("GUIDE_SCENES is not set: the downloaded scenes are not loaded\n");
        skip();
    }
    for (size_t i = 0; i < sizeof scenes / sizeof *scenes; ++i) {
        char path[1024];
        tr_surface h;
        snprintf(path, sizeof path, "%s/%s", root, scenes[i].file);
        tr_scene *s = load_file(path, NULL, 0);
        if (!s || messages.warnings)
            fprintf(stderr, "%s", said);
        assert_non_null(s);
        assert_int_equal(messages.warnings, 0);
        assert_int_equal(s->triangles, scenes[i].triangles);
        vec3 eye = xform_point(&s->camera.to_world, v3(0, 0, 0));
        assert_true(trace(s, eye, xform_vector(&s->camera.to_world, v3(0, -0.2f, 1)), 0, &h));
        tr_scene_free(s);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_transform_products),
        cmocka_unit_test(test_lookat_looks_at_the_target),
        cmocka_unit_test(test_inverse_times_matrix_is_identity),
        cmocka_unit_test(test_both_spellings_mean_the_same),
        cmocka_unit_test(test_defaults_and_defines),
        cmocka_unit_test(test_include),
        cmocka_unit_test(test_references_work_forwards_and_into_nested_elements),
        cmocka_unit_test(test_colour_spellings),
        cmocka_unit_test(test_black_bodies),
        cmocka_unit_test(test_metal_reflects_its_colour_at_normal_incidence),
        cmocka_unit_test(test_material_parameters),
        cmocka_unit_test(test_textures_share_a_file),
        cmocka_unit_test(test_emitters),
        cmocka_unit_test(test_camera_and_film),
        cmocka_unit_test(test_rectangle),
        cmocka_unit_test(test_cube_faces_point_outwards),
        cmocka_unit_test(test_sphere),
        cmocka_unit_test(test_stretched_sphere_becomes_a_mesh),
        cmocka_unit_test(test_disk),
        cmocka_unit_test(test_cylinder),
        cmocka_unit_test(test_ply_formats),
        cmocka_unit_test(test_binary_ply_that_starts_with_a_newline_byte),
        cmocka_unit_test(test_mesh_normals),
        cmocka_unit_test(test_obj),
        cmocka_unit_test(test_serialized),
        cmocka_unit_test(test_gltf),
        cmocka_unit_test(test_gltf_without_camera_and_lights),
        cmocka_unit_test(test_files_that_are_read_are_told),
        cmocka_unit_test(test_bad_scenes_name_file_and_line),
        cmocka_unit_test(test_bad_sensors),
        cmocka_unit_test(test_bad_files),
        cmocka_unit_test(test_deep_nesting_is_refused),
        cmocka_unit_test(test_scenes_built_in_code),
        cmocka_unit_test(test_zero_area_light_is_removed_and_others_keep_their_shapes),
        cmocka_unit_test(test_flipped_xml),
        cmocka_unit_test(test_flipped_meshes),
        cmocka_unit_test(test_flipped_gltf),
        cmocka_unit_test(test_real_scenes),
    };
    return cmocka_run_group_tests(tests, setup, teardown);
}
