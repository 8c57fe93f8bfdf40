/* scene.c: a scene's memory, its checks, and what is derived from it: areas, bounds, lights, Embree.

   contents: >>memory >>load >>check >>derive >>embree >>finish */
#include "scene_internal.h"

#include <stdlib.h>
#include <string.h>

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

char *tr_string_copy(const char *s)
{
    size_t size = s ? strlen(s) + 1 : 0;
    char *copy = s ? malloc(size) : NULL;
    if (copy)
        memcpy(copy, s, size);
    return copy;
}

char *tr_path_beside(const char *base, const char *name)
{
    const char *slash = name[0] == '/' ? NULL : strrchr(base, '/');
    size_t folder = slash ? (size_t)(slash - base) + 1 : 0, size = strlen(name) + 1;
    char *path = malloc(folder + size);
    if (path) {
        memcpy(path, base, folder);
        memcpy(path + folder, name, size);
    }
    return path;
}

tr_scene *tr_scene_new(void)
{
    tr_scene *scene = calloc(1, sizeof *scene);
    if (!scene)
        return NULL;
    scene->camera.to_world = mat4_identity();
    scene->camera.fov = 2 * atanf(43.2666153f / 100) * (180 / TR_PI); /* a 50 mm lens on 36 x 24 mm film */
    scene->camera.fov_axis = 2;
    scene->camera.focus = 1;
    scene->width = 768;
    scene->height = 576;
    scene->filter = TR_FILTER_GAUSSIAN;
    scene->max_depth = -1;
    return scene;
}

/* Room for one more element, zeroed: capacities are the powers of two, so that no field need hold them. */
static void *append(void *array, int *count, size_t size)
{
    bool full = *count == 0 || (*count & (*count - 1)) == 0;
    if (*count >= 1 << 28)
        return NULL;
    char *grown = full ? realloc(array, (*count ? (size_t)*count * 2 : 1) * size) : array;
    if (grown)
        memset(grown + (size_t)(*count)++ * size, 0, size);
    return grown;
}

int tr_scene_add_texture(tr_scene *scene)
{
    tr_texture *grown = append(scene->textures, &scene->texture_count, sizeof *grown);
    if (!grown)
        return -1;
    scene->textures = grown;
    tr_texture *t = &grown[scene->texture_count - 1];
    t->uv[0][0] = t->uv[1][1] = 1;
    return scene->texture_count - 1;
}

int tr_scene_add_bsdf(tr_scene *scene, tr_bsdf_type type)
{
    tr_bsdf *grown = append(scene->bsdfs, &scene->bsdf_count, sizeof *grown);
    if (!grown)
        return -1;
    scene->bsdfs = grown;
    tr_bsdf_defaults(&grown[scene->bsdf_count - 1], type);
    return scene->bsdf_count - 1;
}

int tr_scene_add_shape(tr_scene *scene)
{
    tr_shape *grown = append(scene->shapes, &scene->shape_count, sizeof *grown);
    if (!grown)
        return -1;
    scene->shapes = grown;
    grown[scene->shape_count - 1].bsdf = grown[scene->shape_count - 1].light = -1;
    return scene->shape_count - 1;
}

int tr_scene_add_light(tr_scene *scene, tr_light_type type)
{
    tr_light *grown = append(scene->lights, &scene->light_count, sizeof *grown);
    if (!grown)
        return -1;
    scene->lights = grown;
    tr_light *l = &grown[scene->light_count - 1];
    l->type = type;
    l->shape = -1;
    l->to_world = l->to_local = mat4_identity();
    return scene->light_count - 1;
}

static void free_light(tr_light *l)
{
    tr_image_free(&l->image);
    free(l->marginal);
    free(l->conditional);
}

void tr_scene_free(tr_scene *scene)
{
    if (!scene)
        return;
    if (scene->rtc)
        rtcReleaseScene(scene->rtc);
    if (scene->device)
        rtcReleaseDevice(scene->device);
    for (int i = 0; i < scene->texture_count; ++i) {
        /* Textures of one file share its pixels: the first frees them. */
        for (int j = i + 1; j < scene->texture_count; ++j)
            if (scene->textures[j].image.data == scene->textures[i].image.data) {
                scene->textures[j].image.data = NULL;
                scene->textures[j].texels = NULL;
            }
        tr_image_free(&scene->textures[i].image);
        tr_texels_free(scene->textures[i].texels);
        free(scene->textures[i].id);
    }
    for (int i = 0; i < scene->bsdf_count; ++i) {
        free(scene->bsdfs[i].transmittance);
        free(scene->bsdfs[i].id);
    }
    for (int i = 0; i < scene->shape_count; ++i) {
        tr_mesh_free(&scene->shapes[i]);
        free(scene->shapes[i].area_cdf);
        free(scene->shapes[i].id);
    }
    for (int i = 0; i < scene->light_count; ++i)
        free_light(&scene->lights[i]);
    free(scene->textures);
    free(scene->bsdfs);
    free(scene->shapes);
    free(scene->lights);
    free(scene->environment);
    free(scene->light_cdf);
    free(scene->path);
    free(scene);
}

/* ---- >>load ------------------------------------------------------------------------------------------------- */

static bool ends_with(const char *s, const char *end)
{
    size_t a = strlen(s), b = strlen(end);
    if (a < b)
        return false;
    for (size_t i = 0; i < b; ++i)
        if ((s[a - b + i] | 0x20) != (end[i] | 0x20))
            return false;
    return true;
}

tr_scene *tr_scene_load(const char *path, const tr_define *defines, int define_count, int threads, tr_log *log)
{
    tr_log quiet = {0};
    log = log ? log : &quiet;
    int errors = log->errors;
    tr_scene *scene = tr_scene_new();
    if (!scene || !(scene->path = tr_string_copy(path))) {
        tr_message(log, TR_ERROR, path, 0, "out of memory");
        tr_scene_free(scene);
        return NULL;
    }
    bool gltf = ends_with(path, ".gltf") || ends_with(path, ".glb");
    bool ok = gltf ? tr_gltf_load(scene, path, log) : tr_xml_load(scene, path, defines, define_count, log);
    if (ok && log->errors == errors && tr_scene_finish(scene, threads, log) && log->errors == errors)
        return scene;
    if (log->errors == errors)
        tr_message(log, TR_ERROR, path, 0, "the scene could not be loaded (out of memory?)");
    tr_scene_free(scene);
    return NULL;
}

static void scene_bounds(const tr_scene *scene, vec3 *lo, vec3 *hi)
{
    *lo = v3s(INFINITY);
    *hi = v3s(-INFINITY);
    for (int i = 0; i < scene->shape_count; ++i) {
        vec3 a, b;
        tr_shape_bounds(&scene->shapes[i], &a, &b);
        *lo = v3(fminf(lo->x, a.x), fminf(lo->y, a.y), fminf(lo->z, a.z));
        *hi = v3(fmaxf(hi->x, b.x), fmaxf(hi->y, b.y), fmaxf(hi->z, b.z));
    }
    if (!finite3(*lo) || !finite3(*hi))
        *lo = *hi = v3(0, 0, 0);
}

void tr_scene_frame(tr_scene *scene)
{
    vec3 lo, hi;
    scene_bounds(scene, &lo, &hi);
    vec3 center = scale3(add3(lo, hi), 0.5f);
    float radius = fmaxf(0.5f * len3(sub3(hi, lo)), 1e-3f);
    scene->camera.fov = 40;
    scene->camera.fov_axis = 3;
    vec3 eye = madd3(center, norm3(v3(0.5f, 0.35f, 1)), radius / sinf(20 * TR_PI / 180));
    if (!mat4_lookat(eye, center, v3(0, 1, 0), &scene->camera.to_world))
        scene->camera.to_world = mat4_translate(eye);
    scene->camera.focus = len3(sub3(eye, center));
}

/* ---- >>check ------------------------------------------------------------------------------------------------ */

typedef struct checker {
    tr_scene *scene;
    tr_log *log;
    bool ok;
} checker;

static void bad(checker *c, int line, const char *what, const char *id)
{
    tr_message(c->log, TR_ERROR, c->scene->path, line, "%s%s%s%s", what, id ? " '" : "", id ? id : "", id ? "'" : "");
    c->ok = false;
}

static void check_texture(checker *c, const tr_texture *t)
{
    if (t->type == TR_TEXTURE_BITMAP && (t->image.width <= 0 || t->image.height <= 0 || !t->image.data))
        bad(c, 0, "empty image in texture", t->id ? t->id : "?");
    else if (t->type == TR_TEXTURE_BITMAP && t->image.channels != 3)
        bad(c, 0, "image without three channels in texture", t->id ? t->id : "?");
    for (int i = 0; i < 6; ++i)
        if (!isfinite(t->uv[i / 3][i % 3]))
            bad(c, 0, "uv transform is not finite in texture", t->id ? t->id : "?");
}

static bool texture_ok(const tr_scene *scene, int id) { return id >= -1 && id < scene->texture_count; }

/* Nesting depth of a bsdf, -1 for cycles and for more than 32 levels. depth: 0 = unknown, -2 = being visited. */
static int bsdf_depth(const tr_scene *scene, int id, int *depth, int level)
{
    if (depth[id] > 0)
        return depth[id];
    if (depth[id] == -2 || level > 32)
        return -1;
    depth[id] = -2;
    int deepest = 0;
    for (int i = 0; i < 2; ++i) {
        int child = scene->bsdfs[id].child[i], d = 0;
        if (child >= 0 && child < scene->bsdf_count)
            d = bsdf_depth(scene, child, depth, level + 1);
        if (d < 0)
            return -1;
        deepest = d > deepest ? d : deepest;
    }
    return depth[id] = deepest + 1;
}

static void check_bsdf(checker *c, const tr_bsdf *b)
{
    const tr_scene *s = c->scene;
    const tr_param *params[] = {
        &b->reflectance, &b->specular_reflectance, &b->specular_transmittance, &b->alpha, &b->metallic, &b->exponent,
        &b->opacity};
    for (size_t i = 0; i < sizeof params / sizeof *params; ++i) {
        if (!texture_ok(s, params[i]->texture))
            bad(c, b->line, "a bsdf names a texture that does not exist", b->id);
        if (!finite3(params[i]->value))
            bad(c, b->line, "a bsdf has a parameter that is not finite", b->id);
    }
    if (!finite3(b->eta) || !finite3(b->k) || !isfinite(b->ior) || !isfinite(b->bump_scale))
        bad(c, b->line, "a bsdf has a parameter that is not finite", b->id);
    bool wraps = b->type == TR_BSDF_TWOSIDED || b->type == TR_BSDF_MASK || b->type == TR_BSDF_BUMPMAP;
    for (int i = 0; i < 2; ++i)
        if (b->child[i] < -1 || b->child[i] >= s->bsdf_count || (wraps && i == 0 && b->child[i] < 0))
            bad(c, b->line, "a bsdf names a nested bsdf that does not exist", b->id);
    if (!texture_ok(s, b->bump_texture) || (b->type == TR_BSDF_BUMPMAP && b->bump_texture < 0))
        bad(c, b->line, "a bumpmap names a texture that does not exist", b->id);
}

/* NaN, infinite or absurd vertices: Embree and the bounds must never see them. */
static void drop_bad_triangles(checker *c, tr_shape *s)
{
    uint32_t kept = 0, lost_uv = 0;
    for (uint32_t t = 0; t < s->triangle_count; ++t) {
        const uint32_t *id = s->indices + 3 * (size_t)t;
        bool fine = true;
        for (int i = 0; i < 9; ++i)
            fine = fine && fabsf(s->positions[3 * (size_t)id[i / 3] + (size_t)(i % 3)]) < 1e18f;
        if (fine) {
            memmove(s->indices + 3 * (size_t)kept, id, 3 * sizeof *id);
            ++kept;
        }
    }
    if (kept < s->triangle_count)
        tr_message(c->log, TR_WARNING, c->scene->path, s->line,
                   "%u triangles with vertices that are NaN, infinite or huge were dropped", s->triangle_count - kept);
    s->triangle_count = kept;
    for (size_t i = 0; s->uvs && i < 2 * (size_t)s->vertex_count; ++i)
        if (!isfinite(s->uvs[i])) {
            s->uvs[i] = 0;
            ++lost_uv;
        }
    if (lost_uv)
        tr_message(c->log, TR_WARNING, c->scene->path, s->line, "%u texture coordinates were not finite", lost_uv);
}

static void check_shape(checker *c, tr_shape *s)
{
    if (s->bsdf < 0 || s->bsdf >= c->scene->bsdf_count)
        bad(c, s->line, "a shape names a bsdf that does not exist", s->id);
    if (s->light < -1 || s->light >= c->scene->light_count)
        bad(c, s->line, "a shape names a light that does not exist", s->id);
    if (s->type != TR_SHAPE_MESH) {
        if (!tr_shape_complete(s))
            bad(c, s->line, "a shape's transform is singular or not finite", s->id);
        return;
    }
    if (s->triangle_count && (!s->positions || !s->indices || !tr_mesh_indices_valid(s))) {
        bad(c, s->line, "a mesh has vertex indices out of range", s->id);
        return;
    }
    drop_bad_triangles(c, s);
    if (s->triangle_count == 0)
        tr_message(c->log, TR_WARNING, c->scene->path, s->line, "the shape has no triangles");
    else if (s->normals)
        tr_mesh_align_winding(s);
}

static void check_light(checker *c, int id)
{
    tr_scene *s = c->scene;
    tr_light *l = &s->lights[id];
    if (!finite3(l->value) || fminf(l->value.x, fminf(l->value.y, l->value.z)) < 0)
        bad(c, l->line, "a light's colour is negative or not finite", NULL);
    if (!finite3(l->position) || !finite3(l->direction))
        bad(c, l->line, "a light's position or direction is not finite", NULL);
    if (l->type == TR_LIGHT_AREA && (l->shape < 0 || l->shape >= s->shape_count || s->shapes[l->shape].light != id))
        bad(c, l->line, "an area light and its shape do not name each other", NULL);
    if (l->type == TR_LIGHT_ENVMAP && (l->image.width <= 0 || l->image.height <= 0 || l->image.channels != 3))
        bad(c, l->line, "an environment map has no pixels", NULL);
}

static bool check_scene(tr_scene *scene, tr_log *log)
{
    checker c = {scene, log, true};
    const tr_camera *cam = &scene->camera;
    mat4 unused;
    if (scene->width <= 0 || scene->height <= 0 || (int64_t)scene->width * scene->height > INT64_C(1) << 28)
        bad(&c, 0, "the picture's size is zero or absurd", NULL);
    if (!mat4_inverse(&cam->to_world, &unused) || !(cam->fov > 0 && cam->fov < 180) || !(cam->aperture >= 0) ||
        !isfinite(cam->aperture) || (cam->aperture > 0 && !(cam->focus > 0)))
        bad(&c, 0, "the camera is impossible (singular transform, field of view or lens)", NULL);
    for (int i = 0; i < scene->texture_count; ++i)
        check_texture(&c, &scene->textures[i]);
    for (int i = 0; i < scene->bsdf_count; ++i)
        check_bsdf(&c, &scene->bsdfs[i]);
    int *depth = calloc((size_t)scene->bsdf_count + 1, sizeof *depth);
    for (int i = 0; c.ok && depth && i < scene->bsdf_count; ++i)
        if (bsdf_depth(scene, i, depth, 0) < 0)
            bad(&c, scene->bsdfs[i].line, "a bsdf contains itself or is nested too deep", scene->bsdfs[i].id);
    c.ok = c.ok && depth;
    free(depth);
    for (int i = 0; i < scene->shape_count; ++i)
        check_shape(&c, &scene->shapes[i]);
    for (int i = 0; i < scene->light_count; ++i)
        check_light(&c, i);
    return c.ok;
}

/* ---- >>derive ----------------------------------------------------------------------------------------------- */

static void remove_light(tr_scene *scene, int id)
{
    if (scene->lights[id].shape >= 0)
        scene->shapes[scene->lights[id].shape].light = -1;
    free_light(&scene->lights[id]);
    for (int i = id; i + 1 < scene->light_count; ++i)
        scene->lights[i] = scene->lights[i + 1];
    --scene->light_count;
    for (int i = 0; i < scene->shape_count; ++i)
        if (scene->shapes[i].light > id)
            --scene->shapes[i].light;
}

static bool measure_shapes(tr_scene *scene, tr_log *log)
{
    scene->triangles = 0;
    for (int i = 0; i < scene->shape_count; ++i) {
        tr_shape *s = &scene->shapes[i];
        scene->triangles += s->triangle_count;
        if (!tr_shape_measure(s, s->light >= 0) || (s->type == TR_SHAPE_MESH && !tr_mesh_pack(s)))
            return false;
        if (s->light >= 0 && !(s->area > 0 && isfinite(s->area))) {
            tr_message(log, TR_WARNING, scene->path, s->line,
                       "an area light on a shape without area emits nothing and was removed");
            remove_light(scene, s->light);
        }
    }
    return true;
}

static bool list_environment(tr_scene *scene)
{
    free(scene->environment);
    scene->environment_count = 0;
    scene->environment = calloc((size_t)scene->light_count + 1, sizeof *scene->environment);
    if (!scene->environment)
        return false;
    for (int i = 0; i < scene->light_count; ++i) {
        tr_light_type type = scene->lights[i].type;
        if (type == TR_LIGHT_ENVMAP || type == TR_LIGHT_CONSTANT || type == TR_LIGHT_SUN)
            scene->environment[scene->environment_count++] = i;
    }
    return true;
}

/* ---- >>embree ----------------------------------------------------------------------------------------------- */

static void embree_error(void *user, enum RTCError code, const char *text)
{
    (void)code;
    tr_message(user, TR_ERROR, "embree", 0, "%s", text ? text : "unknown error");
}

static bool build_embree(tr_scene *scene, int threads, tr_log *log)
{
    char config[64] = "";
    if (threads > 0)
        snprintf(config, sizeof config, "threads=%d,user_threads=0", threads);
    scene->device = rtcNewDevice(config);
    if (!scene->device) {
        tr_message(log, TR_ERROR, scene->path, 0, "Embree could not start (error %d)", (int)rtcGetDeviceError(NULL));
        return false;
    }
    int errors = log->errors;
    rtcSetDeviceErrorFunction(scene->device, embree_error, log);
    scene->rtc = rtcNewScene(scene->device);
    bool ok = scene->rtc != NULL;
    if (ok) {
        rtcSetSceneBuildQuality(scene->rtc, RTC_BUILD_QUALITY_HIGH);
        /* Robust: without it rays slip between triangles that share an edge, and light leaks. */
        rtcSetSceneFlags(scene->rtc, RTC_SCENE_FLAG_ROBUST);
        for (int i = 0; ok && i < scene->shape_count; ++i)
            ok = tr_shape_attach(&scene->shapes[i], scene->device, scene->rtc, (unsigned)i);
        rtcCommitScene(scene->rtc);
    }
    rtcSetDeviceErrorFunction(scene->device, NULL, NULL);
    return ok && log->errors == errors;
}

/* ---- >>finish ----------------------------------------------------------------------------------------------- */

/* Compact forms of bitmaps; what has none is looked up in its floats. */
static void compact_textures(tr_scene *scene)
{
    for (int i = 0; i < scene->texture_count; ++i) {
        tr_texture *t = &scene->textures[i];
        if (t->type != TR_TEXTURE_BITMAP || t->texels)
            continue;
        int j = 0;
        while (scene->textures[j].image.data != t->image.data)
            ++j;
        t->texels = j < i ? scene->textures[j].texels : tr_texels_make(&t->image);
    }
}

static bool finish(tr_scene *scene, int threads, tr_log *log)
{
    if (!check_scene(scene, log))
        return false;
    compact_textures(scene);
    for (int i = 0; i < scene->bsdf_count; ++i)
        if (!tr_bsdf_finish(scene, &scene->bsdfs[i], log))
            return false;
    if (!measure_shapes(scene, log))
        return false;
    scene_bounds(scene, &scene->bounds_min, &scene->bounds_max);
    scene->bounds_center = scale3(add3(scene->bounds_min, scene->bounds_max), 0.5f);
    scene->bounds_radius = fmaxf(0.5f * len3(sub3(scene->bounds_max, scene->bounds_min)), 1e-6f);
    if (scene->light_count == 0)
        tr_message(log, TR_WARNING, scene->path, 0, "there is no light: the picture will be black");
    return list_environment(scene) && tr_lights_finish(scene, log) && build_embree(scene, threads, log);
}

bool tr_scene_finish(tr_scene *scene, int threads, tr_log *log)
{
    tr_log quiet = {0};
    log = log ? log : &quiet;
    int errors = log->errors;
    bool ok = finish(scene, threads, log);
    if (!ok && log->errors == errors)
        tr_message(log, TR_ERROR, scene->path, 0, "out of memory");
    return ok;
}
