/* xml.c: Mitsuba scene files (0.5, 0.6 and 3.0 spellings) into a scene: camera, shapes, emitters.

   contents: >>sensor >>integrator >>emitters >>sunsky >>shapes >>load

   The file becomes a tree first (xmltree.c); here each element asks for what it knows by name, and whatever nobody
   asked for is reported with its line. Textures and bsdfs: xml_material.c. Values: xml_values.c. */
#include "xml_internal.h"

#include <stdlib.h>
#include <string.h>

/* ---- >>sensor ----------------------------------------------------------------------------------------------- */

static void read_film(xml_reader *r, xnode *node)
{
    static const char *const filters[] = {"box", "tent", "gaussian"};
    tr_scene *s = r->scene;
    s->width = xml_int(r, node, "width", s->width);
    s->height = xml_int(r, node, "height", s->height);
    if (s->width <= 0 || s->height <= 0 || (int64_t)s->width * s->height > INT64_C(1) << 28)
        xml_say(r, TR_ERROR, node, "a picture of %d x %d pixels is not possible", s->width, s->height);
    for (xnode *n = node->first; n; n = n->next) {
        if (strcmp(n->tag, "rfilter") != 0)
            continue;
        n->used = true;
        s->filter = TR_FILTER_GAUSSIAN;
        for (int i = 0; i < 3; ++i)
            if (strcmp(n->type, filters[i]) == 0)
                s->filter = (tr_filter)i;
        if (!xml_in_list(n->type, "box,tent,gaussian"))
            xml_say(r, TR_NOTE, n, "reconstruction filter '%s' is replaced by gaussian", n->type);
        xml_report_unused(r, n, "radius,stddev,b,c,lobes");
    }
    xml_report_unused(r, node,
                      "file_format,pixel_format,component_format,banner,attach_log,high_quality_edges,gamma,exposure,"
                      "tonemap_method,key,burn,variance,filename,sample_border,compensate");
}

static void read_fov(xml_reader *r, xnode *node)
{
    static const char *const axes[] = {"x", "y", "diagonal", "smaller", "larger"};
    tr_camera *c = &r->scene->camera;
    const char *axis = xml_string(r, node, "fov_axis", "x");
    xnode *lens = xml_child(node, "focal_length"), *fov = xml_child(node, "fov");
    if (fov) {
        c->fov = xml_float(r, node, "fov", c->fov);
        c->fov_axis = -1;
        for (int i = 0; i < 5; ++i)
            if (strcmp(axis, axes[i]) == 0)
                c->fov_axis = i;
        if (c->fov_axis < 0) {
            xml_say(r, TR_ERROR, node, "unknown fov_axis '%s'", axis);
            c->fov_axis = 0;
        }
    } else if (lens) { /* of 36 x 24 mm film, across the diagonal */
        const char *text = xnode_attr(lens, "value");
        char *end = NULL;
        float mm = text ? strtof(text, &end) : 0;
        if (!(mm > 0) || !isfinite(mm) || (*end && strcmp(end, "mm") != 0))
            xml_say(r, TR_ERROR, lens, "'%s' is not a focal length such as \"50mm\"", text ? text : "");
        else
            c->fov = 2 * atanf(43.2666153f / (2 * mm)) * (180 / TR_PI);
        c->fov_axis = 2;
    }
    if (!(c->fov > 0 && c->fov < 180)) {
        xml_say(r, TR_ERROR, node, "a field of view of %g degrees is not possible", (double)c->fov);
        c->fov = 45;
    }
}

static void read_sensor(xml_reader *r, xnode *node)
{
    tr_camera *c = &r->scene->camera;
    mat4 unused;
    bool thin = strcmp(node->type, "thinlens") == 0;
    if (!thin && strcmp(node->type, "perspective") != 0)
        xml_say(r, TR_WARNING, node, "sensor type '%s' is not supported; it is treated as perspective", node->type);
    xml_transform(r, node, "to_world", &c->to_world);
    if (!mat4_inverse(&c->to_world, &unused))
        xml_say(r, TR_ERROR, node, "the sensor's transform is singular");
    read_fov(r, node);
    c->focus = xml_float(r, node, "focus_distance", 1);
    if (thin) {
        c->aperture = xml_float(r, node, "aperture_radius", 0);
        if (!(c->aperture >= 0 && c->focus > 0))
            xml_say(r, TR_ERROR, node, "a thin lens needs aperture_radius >= 0 and focus_distance > 0");
    }
    for (xnode *n = node->first; n; n = n->next) {
        if (strcmp(n->tag, "film") == 0) {
            n->used = true;
            read_film(r, n);
        } else if (strcmp(n->tag, "sampler") == 0)
            xml_accept_all(n); /* we have our own */
    }
    xml_report_unused(r, node, "near_clip,far_clip,shutter_open,shutter_close");
}

/* ---- >>integrator ------------------------------------------------------------------------------------------- */

static void read_integrator(xml_reader *r, xnode *node)
{
    tr_scene *s = r->scene;
    char names[200] = "";
    size_t used = 0;
    for (xnode *n = node->first; n; n = n->next)
        if (strcmp(n->tag, "integrator") == 0) { /* a wrapper such as "aov" or "adaptive" */
            n->used = true;
            read_integrator(r, n);
        }
    int depth = strcmp(node->type, "direct") == 0 ? 2 : s->max_depth;
    s->max_depth = xml_int(r, node, "max_depth", depth);
    if (s->max_depth == 0 || s->max_depth < -1)
        xml_say(r, TR_ERROR, node, "max_depth must be -1 (unlimited) or more than 0, not %d", s->max_depth);
    s->hide_emitters = xml_bool(r, node, "hide_emitters", s->hide_emitters);
    xml_child(node, "rr_depth"); /* roulette is a command line option */
    if (!xml_in_list(node->type, "path,volpath,volpath_simple,direct,guided_path"))
        xml_say(r, TR_NOTE, node, "integrator '%s': rendering is by path tracing with its max_depth", node->type);
    for (xnode *n = node->first; n; n = n->next) {
        if (n->used)
            continue;
        if (*n->name && used + strlen(n->name) + 3 < sizeof names)
            used += (size_t)snprintf(names + used, sizeof names - used, "%s%s", used ? ", " : "", n->name);
        xml_accept_all(n);
    }
    if (used)
        xml_say(r, TR_NOTE, node, "integrator '%s': these parameters are not used: %s", node->type, names);
}

/* ---- >>emitters --------------------------------------------------------------------------------------------- */

static tr_light *add_light(xml_reader *r, const xnode *node, tr_light_type type)
{
    int id = tr_scene_add_light(r->scene, type);
    if (id < 0) {
        xml_say(r, TR_ERROR, node, "out of memory");
        return NULL;
    }
    r->scene->lights[id].line = node->line;
    return &r->scene->lights[id];
}

/* The light's transform and its inverse; an error where there is none. */
static void light_transform(xml_reader *r, xnode *node, tr_light *l)
{
    xml_transform(r, node, "to_world", &l->to_world);
    if (!mat4_inverse(&l->to_world, &l->to_local))
        xml_say(r, TR_ERROR, node, "the emitter's transform is singular");
}

static void read_envmap(xml_reader *r, xnode *node, tr_light *l)
{
    float scale = xml_float(r, node, "scale", 1), gamma = xml_float(r, node, "gamma", -1);
    xnode *name = xml_child(node, "filename");
    char *path = xml_path(r, node, "filename");
    l->value = v3s(1);
    light_transform(r, node, l);
    if (!(scale >= 0))
        xml_say(r, TR_ERROR, node, "a negative scale makes no light");
    if (path && xml_read_image(r, name ? name : node, path, gamma > 0, gamma, &l->image, false))
        for (size_t i = 0; i < 3 * (size_t)l->image.width * (size_t)l->image.height; ++i)
            l->image.data[i] *= scale;
    free(path);
}

static void read_point_like(xml_reader *r, xnode *node, tr_light *l)
{
    bool directional = l->type == TR_LIGHT_DIRECTIONAL;
    light_transform(r, node, l);
    vec3 p = mat4_column(&l->to_world, 3), d = norm3(mat4_column(&l->to_world, 2));
    l->position = xml_point(r, node, "position", p);
    l->direction = norm3(xml_point(r, node, "direction", d));
    l->value = xml_color(r, node, directional ? "irradiance" : "intensity", v3s(1), true);
    if (l->type != TR_LIGHT_SPOT)
        return;
    float cutoff = xml_float(r, node, "cutoff_angle", 20), beam = xml_float(r, node, "beam_width", cutoff * 0.75f);
    if (!(cutoff > 0 && cutoff <= 180 && beam >= 0 && beam <= cutoff)) {
        xml_say(r, TR_ERROR, node, "a spot needs 0 < cutoff_angle <= 180 and beam_width <= cutoff_angle");
        return;
    }
    l->cutoff_cos = cosf(cutoff * (TR_PI / 180));
    l->beam_cos = cosf(beam * (TR_PI / 180));
}

/* ---- >>sunsky ----------------------------------------------------------------------------------------------- */

static vec3 read_sun_direction(xml_reader *r, xnode *node, const mat4 *to_local)
{
    int year = xml_int(r, node, "year", 2010), month = xml_int(r, node, "month", 7), day = xml_int(r, node, "day", 10);
    float hour = xml_float(r, node, "hour", 15), minute = xml_float(r, node, "minute", 0);
    float second = xml_float(r, node, "second", 0), latitude = xml_float(r, node, "latitude", 35.6894f);
    float longitude = xml_float(r, node, "longitude", 139.6917f), timezone = xml_float(r, node, "timezone", 9);
    vec3 d = xml_point(r, node, "sun_direction", v3(0, 0, 0));
    if (!black3(d)) /* given in world space */
        return norm3(xform_vector(to_local, d));
    if (year < 1 || year > 9999 || month < 1 || month > 12 || day < 1 || day > 31) {
        xml_say(r, TR_ERROR, node, "%d-%d-%d is not a date", year, month, day);
        return v3(0, 1, 0);
    }
    return tr_sun_direction(year, month, day, hour, minute, second, latitude, longitude, timezone);
}

/* "sunsky", "sky" or "sun": up to two lights. */
static void read_sunsky(xml_reader *r, xnode *node)
{
    tr_sunsky desc = {0};
    tr_light lights[2] = {{0}, {0}};
    mat4 to_local;
    bool want[2] = {strcmp(node->type, "sun") != 0, strcmp(node->type, "sky") != 0};
    xml_transform(r, node, "to_world", &desc.to_world);
    if (!mat4_inverse(&desc.to_world, &to_local))
        xml_say(r, TR_ERROR, node, "the emitter's transform is singular");
    desc.turbidity = xml_float(r, node, "turbidity", 3);
    if (!(desc.turbidity >= 2 && desc.turbidity <= 10)) {
        xml_say(r, TR_WARNING, node, "turbidity %g is outside the model's range 2 .. 10", (double)desc.turbidity);
        desc.turbidity = clampf(desc.turbidity, 2, 10);
    }
    desc.sun_direction = read_sun_direction(r, node, &to_local);
    float scale = xml_float(r, node, "scale", 1);
    desc.sky_scale = scale * xml_float(r, node, "sky_scale", 1);
    desc.sun_scale = scale * xml_float(r, node, "sun_scale", 1);
    desc.sun_radius_scale = xml_float(r, node, "sun_radius_scale", 1);
    desc.albedo = xml_color(r, node, "albedo", v3s(0.2f), false);
    want[1] = want[1] && desc.sun_scale > 0 && desc.sun_radius_scale > 0;
    if (desc.sky_scale < 0 || desc.sun_scale < 0)
        xml_say(r, TR_ERROR, node, "a negative scale makes no light");
    if (r->failed)
        return;
    for (int i = 0; i < 2; ++i) {
        lights[i].shape = -1;
        lights[i].to_world = lights[i].to_local = mat4_identity();
    }
    if (!tr_sunsky_lights(&desc, &lights[0], &lights[1])) {
        xml_say(r, TR_ERROR, node, "out of memory for the sky");
        want[0] = want[1] = false;
    }
    for (int i = 0; i < 2; ++i) {
        tr_light *l = want[i] ? add_light(r, node, lights[i].type) : NULL;
        lights[i].line = node->line;
        if (l)
            *l = lights[i];
        else
            tr_image_free(&lights[i].image);
    }
}

/* shape: the id of the shape around it, or -1. */
static void read_emitter(xml_reader *r, xnode *node, int shape)
{
    static const struct {
        const char *name;
        tr_light_type type;
    } kinds[] = {{"area", TR_LIGHT_AREA},   {"envmap", TR_LIGHT_ENVMAP}, {"constant", TR_LIGHT_CONSTANT},
                 {"point", TR_LIGHT_POINT}, {"spot", TR_LIGHT_SPOT},     {"directional", TR_LIGHT_DIRECTIONAL}};
    const char *accepted = "sampling_weight,samples,shadow_samples,resolution,extend,cache,filter_type,wrap_mode";
    tr_light *l = NULL;
    node->used = true;
    if (xml_in_list(node->type, "sunsky,sky,sun")) {
        read_sunsky(r, node);
        xml_report_unused(r, node, accepted);
        return;
    }
    for (size_t i = 0; i < sizeof kinds / sizeof *kinds; ++i)
        if (strcmp(node->type, kinds[i].name) == 0) {
            if ((kinds[i].type == TR_LIGHT_AREA) != (shape >= 0)) {
                xml_say(r, TR_ERROR, node, "emitter type '%s' %s", node->type,
                        shape >= 0 ? "does not belong on a shape" : "only makes sense on a shape");
                return;
            }
            l = add_light(r, node, kinds[i].type);
            if (!l)
                return;
        }
    if (!l) {
        xml_say(r, TR_WARNING, node, "emitter type '%s' is not supported and left out", node->type);
        xml_accept_all(node);
        return;
    }
    if (l->type == TR_LIGHT_ENVMAP)
        read_envmap(r, node, l);
    else if (l->type == TR_LIGHT_AREA || l->type == TR_LIGHT_CONSTANT)
        l->value = xml_color(r, node, "radiance", v3s(1), true);
    else
        read_point_like(r, node, l);
    if (shape >= 0) {
        l->shape = shape;
        r->scene->shapes[shape].light = (int)(l - r->scene->lights);
    }
    xml_report_unused(r, node, accepted);
}

/* ---- >>shapes ----------------------------------------------------------------------------------------------- */

static bool load_mesh(xml_reader *r, xnode *node, const mat4 *m, tr_shape *s)
{
    tr_mesh_options o = {TR_MESH_PLY, *m, false, false, 0};
    char err[300];
    bool obj = strcmp(node->type, "obj") == 0;
    if (strcmp(node->type, "ply") != 0)
        o.format = obj ? TR_MESH_OBJ : TR_MESH_SERIALIZED;
    o.face_normals = xml_bool(r, node, "face_normals", false);
    /* OBJ counts v upwards, as we do; Mitsuba calls that flipped. */
    o.flip_v = xml_bool(r, node, "flip_tex_coords", obj) != obj;
    o.shape_index = xml_int(r, node, "shape_index", 0);
    xnode *name = xml_child(node, "filename");
    char *path = xml_path(r, node, "filename");
    bool ok = path && tr_mesh_load(s, path, &o, err, sizeof err);
    if (ok)
        tr_file_used(r->log, path);
    else if (path)
        xml_say(r, TR_ERROR, name ? name : node, "%s%s%s", strstr(err, path) ? "" : path, strstr(err, path) ? "" : ": ",
                err);
    free(path);
    return ok;
}

/* Geometry of a shape element into s; false = error (said). */
static bool load_geometry(xml_reader *r, xnode *node, tr_shape *s)
{
    mat4 m;
    bool ok, tessellated = false;
    xml_transform(r, node, "to_world", &m);
    if (xml_in_list(node->type, "ply,obj,serialized"))
        return load_mesh(r, node, &m, s);
    if (strcmp(node->type, "rectangle") == 0)
        ok = tr_shape_rectangle(s, &m);
    else if (strcmp(node->type, "cube") == 0)
        ok = tr_shape_cube(s, &m);
    else if (strcmp(node->type, "disk") == 0)
        ok = tr_shape_disk(s, &m);
    else if (strcmp(node->type, "sphere") == 0) {
        vec3 center = xml_point(r, node, "center", v3(0, 0, 0));
        ok = tr_shape_sphere(s, &m, center, xml_float(r, node, "radius", 1), &tessellated);
    } else {
        vec3 p0 = xml_point(r, node, "p0", v3(0, 0, 0)), p1 = xml_point(r, node, "p1", v3(0, 0, 1));
        ok = tr_shape_cylinder(s, &m, p0, p1, xml_float(r, node, "radius", 1), &tessellated);
    }
    if (!ok)
        xml_say(r, TR_ERROR, node, "out of memory for a shape");
    if (tessellated)
        xml_say(r, TR_NOTE, node, "a %s under a transform that stretches it is made of triangles", node->type);
    return ok;
}

/* The bsdf and emitter inside a shape, by element or by reference. */
static void read_shape_children(xml_reader *r, xnode *node, int id)
{
    int bsdf = -1;
    for (xnode *n = node->first; n; n = n->next) {
        if (n->used || !xml_in_list(n->tag, "bsdf,emitter,ref,medium"))
            continue;
        xnode *target = xml_resolve(r, n);
        if (!target)
            continue;
        if (strcmp(target->tag, "bsdf") == 0)
            bsdf = xml_bsdf(r, n);
        else if (strcmp(target->tag, "emitter") == 0 && r->scene->shapes[id].light < 0)
            read_emitter(r, target, id);
        else if (strcmp(target->tag, "medium") == 0) {
            xml_say(r, TR_WARNING, n, "participating media are not supported; the shape stays empty");
            xml_accept_all(n);
        } else
            xml_say(r, TR_ERROR, n, "<%s> cannot be used on a shape here", target->tag);
    }
    r->scene->shapes[id].bsdf = bsdf >= 0 ? bsdf : xml_default_bsdf(r);
}

static void read_shape(xml_reader *r, xnode *node)
{
    if (!xml_in_list(node->type, "rectangle,cube,sphere,disk,cylinder,ply,obj,serialized")) {
        xml_say(r, TR_WARNING, node, "shape type '%s' is not supported and left out", node->type);
        xml_accept_all(node);
        return;
    }
    int id = tr_scene_add_shape(r->scene);
    if (id < 0) {
        xml_say(r, TR_ERROR, node, "out of memory");
        return;
    }
    tr_shape *s = &r->scene->shapes[id];
    s->line = node->line;
    s->id = *node->id ? tr_string_copy(node->id) : NULL;
    s->flip_normals = xml_bool(r, node, "flip_normals", false);
    load_geometry(r, node, s);
    read_shape_children(r, node, id);
    xml_report_unused(r, node, "sampling_weight,max_smooth_angle,srgb,load_materials");
}

/* ---- >>load ------------------------------------------------------------------------------------------------- */

static void read_children(xml_reader *r, xnode *root)
{
    int sensors = 0, integrators = 0;
    for (xnode *n = root->first; n; n = n->next) {
        if (n->used)
            continue;
        n->used = true;
        if (strcmp(n->tag, "shape") == 0)
            read_shape(r, n);
        else if (strcmp(n->tag, "bsdf") == 0)
            xml_bsdf(r, n);
        else if (strcmp(n->tag, "texture") == 0)
            xml_texture(r, n);
        else if (strcmp(n->tag, "emitter") == 0) {
            if (strcmp(n->type, "area") != 0 || !*n->id) /* one with an id waits for a <ref> on a shape */
                read_emitter(r, n, -1);
        } else if (strcmp(n->tag, "sensor") == 0 && sensors++ == 0)
            read_sensor(r, n);
        else if (strcmp(n->tag, "integrator") == 0 && integrators++ == 0)
            read_integrator(r, n);
        else if (xml_in_list(n->tag, "sensor,integrator"))
            xml_say(r, TR_WARNING, n, "only the first <%s> is used", n->tag);
        else if (xml_in_list(n->tag, "medium,volume"))
            xml_say(r, TR_WARNING, n, "participating media are not supported; <%s> is ignored", n->tag);
        else if (strcmp(n->tag, "sampler") != 0)
            n->used = false;
    }
    xml_report_unused(r, root, "");
    if (!sensors) {
        tr_message(r->log, TR_WARNING, r->scene->path, 0, "there is no sensor; the camera is placed to see everything");
        tr_scene_frame(r->scene);
    }
}

bool tr_xml_load(tr_scene *scene, const char *path, const tr_define *defines, int define_count, tr_log *log)
{
    xml_reader r = {0};
    r.scene = scene;
    r.log = log;
    r.default_bsdf = -1;
    r.tree = xtree_load(path, defines, define_count, log);
    if (!r.tree)
        return false;
    read_children(&r, xtree_root(r.tree));
    xml_free_images(&r);
    xtree_free(r.tree);
    return !r.failed;
}
