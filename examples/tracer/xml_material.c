/* xml_material.c: textures and bsdfs out of an XML tree.

   contents: >>images >>textures >>tables >>bsdfs */
#include "xml_internal.h"

#include <stdlib.h>
#include <string.h>

#include <stb/stb_image.h>

enum { NESTING_MAX = 40 };

/* ---- >>images ----------------------------------------------------------------------------------------------- */

/* A file that was read: its texture holds the pixels, which others share. */
typedef struct xml_image {
    struct xml_image *next;
    char *path;
    bool raw;
    float gamma;
    tr_image image;
} xml_image;

void xml_free_images(xml_reader *r)
{
    while (r->images) {
        xml_image *next = r->images->next;
        free(r->images->path);
        free(r->images);
        r->images = next;
    }
}

static bool is_hdr(const char *path)
{
    size_t n = strlen(path);
    return n > 4 && (strcmp(path + n - 4, ".exr") == 0 || strcmp(path + n - 4, ".hdr") == 0);
}

/* Give an image three channels, whatever the file had. */
static bool three_channels(tr_image *image)
{
    tr_image wide;
    if (image->channels == 3)
        return true;
    if (!tr_image_alloc(&wide, image->width, image->height, 3)) {
        tr_image_free(image);
        return false;
    }
    for (size_t i = 0; i < (size_t)image->width * (size_t)image->height; ++i)
        for (size_t c = 0; c < 3; ++c) {
            size_t channels = (size_t)image->channels;
            wide.data[3 * i + c] = image->data[channels * i + (channels < 3 ? 0 : c)];
        }
    tr_image_free(image);
    *image = wide;
    return true;
}

bool xml_read_image(xml_reader *r, xnode *node, const char *path, bool raw, float gamma, tr_image *image, bool share)
{
    char err[300];
    for (const struct xml_image *i = share ? r->images : NULL; i; i = i->next)
        if (i->raw == raw && i->gamma == gamma && strcmp(i->path, path) == 0) {
            *image = i->image;
            return true;
        }
    if (!tr_image_read(path, raw, image, err, sizeof err)) {
        xml_say(r, TR_ERROR, node, "cannot read the image: %s", err);
        return false;
    }
    tr_file_used(r->log, path);
    if (image->width <= 0 || image->height <= 0 || !three_channels(image)) {
        xml_say(r, TR_ERROR, node, "the image '%s' is empty", path);
        tr_image_free(image);
        return false;
    }
    size_t count = 3 * (size_t)image->width * (size_t)image->height, bad = 0;
    for (size_t i = 0; i < count; ++i) {
        float v = image->data[i];
        bool fine = v >= 0 && v < 1e30f;
        bad += !fine;
        image->data[i] = !fine ? 0 : gamma > 0 && gamma != 1 && !is_hdr(path) ? powf(v, gamma) : v;
    }
    if (bad)
        xml_say(r, TR_WARNING, node, "%zu values of '%s' are negative, NaN or infinite and were set to 0", bad, path);
    struct xml_image *entry = share ? calloc(1, sizeof *entry) : NULL;
    if (entry && (entry->path = tr_string_copy(path))) {
        entry->raw = raw;
        entry->gamma = gamma;
        entry->image = *image;
        entry->next = r->images;
        r->images = entry;
    } else
        free(entry);
    return true;
}

vec3 xml_texture_mean(const tr_texture *t)
{
    double sum[3] = {0};
    size_t n = (size_t)t->image.width * (size_t)t->image.height;
    if (t->type == TR_TEXTURE_CHECKERBOARD)
        return scale3(add3(t->color0, t->color1), 0.5f);
    for (size_t i = 0; i < n; ++i)
        for (int c = 0; c < 3; ++c)
            sum[c] += (double)t->image.data[3 * i + (size_t)c];
    n = n ? n : 1;
    return v3((float)(sum[0] / (double)n), (float)(sum[1] / (double)n), (float)(sum[2] / (double)n));
}

/* ---- >>textures --------------------------------------------------------------------------------------------- */

static void read_uv(xml_reader *r, xnode *node, tr_texture *t)
{
    mat4 m;
    xml_transform(r, node, "to_uv", &m);
    float us = xml_float(r, node, "uscale", 1), vs = xml_float(r, node, "vscale", 1);
    float uo = xml_float(r, node, "uoffset", 0), vo = xml_float(r, node, "voffset", 0);
    for (int j = 0; j < 3; ++j) {
        int column = j == 2 ? 3 : j;
        t->uv[0][j] = us * m.m[0][column] + (j == 2 ? uo : 0);
        t->uv[1][j] = vs * m.m[1][column] + (j == 2 ? vo : 0);
    }
}

static void read_wrap(xml_reader *r, xnode *node, tr_texture *t)
{
    const char *mode = xml_string(r, node, "wrap_mode", "repeat");
    const char *u = xml_string(r, node, "wrap_mode_u", mode), *v = xml_string(r, node, "wrap_mode_v", mode);
    if (strcmp(u, v) != 0)
        xml_say(r, TR_WARNING, node, "one wrap mode holds for both axes: '%s' for v is ignored", v);
    t->wrap = strcmp(u, "clamp") == 0 ? TR_WRAP_CLAMP : strcmp(u, "mirror") == 0 ? TR_WRAP_MIRROR : TR_WRAP_REPEAT;
    if (!xml_in_list(u, "repeat,clamp,mirror"))
        xml_say(r, TR_WARNING, node, "unknown wrap mode '%s', the texture repeats", u);
}

/* One channel as grey; the alpha channel is only in the file. */
static bool pick_channel(xml_reader *r, xnode *node, const char *path, const char *channel, tr_image *image)
{
    size_t n = (size_t)image->width * (size_t)image->height;
    const char *at = strchr("rgb", channel[0]);
    unsigned char *rgba = NULL;
    int w = 0, h = 0, original = 0;
    if (channel[0] == 'a' && !is_hdr(path)) {
        rgba = stbi_load(path, &w, &h, &original, 4);
        if (!rgba || w != image->width || h != image->height) {
            stbi_image_free(rgba);
            xml_say(r, TR_WARNING, node, "cannot read the alpha channel of '%s'", path);
            return true;
        }
    } else if (!at || !*channel) {
        xml_say(r, TR_WARNING, node, "texture channel '%s' is not supported", channel);
        return true;
    }
    for (size_t i = 0; i < n; ++i) {
        float v = rgba ? (float)rgba[4 * i + 3] / 255 : image->data[3 * i + (size_t)(at - "rgb")];
        for (size_t c = 0; c < 3; ++c)
            image->data[3 * i + c] = v;
    }
    stbi_image_free(rgba);
    return true;
}

/* The file has an alpha channel that says something. */
static bool has_alpha(const char *path)
{
    int w, h, channels;
    bool found = false;
    if (is_hdr(path) || !stbi_info(path, &w, &h, &channels) || (channels != 2 && channels != 4))
        return false;
    unsigned char *rgba = stbi_load(path, &w, &h, &channels, 4);
    for (size_t i = 0; rgba && i < (size_t)w * (size_t)h && !found; ++i)
        found = rgba[4 * i + 3] < 255;
    stbi_image_free(rgba);
    return found;
}

static bool read_bitmap(xml_reader *r, xnode *node, tr_texture *t)
{
    const char *filter = xml_string(r, node, "filter_type", "bilinear");
    const char *channel = xml_string(r, node, "channel", "all");
    float gamma = xml_float(r, node, "gamma", -1);
    bool raw = xml_bool(r, node, "raw", false), all = strcmp(channel, "all") == 0 || !*channel;
    t->type = TR_TEXTURE_BITMAP;
    t->nearest = strcmp(filter, "nearest") == 0;
    if (!xml_in_list(filter, "nearest,bilinear") && xml_once(r, ONCE_FILTER))
        xml_say(r, TR_NOTE, node, "texture filter '%s' is treated as bilinear (there are no mip maps)", filter);
    read_uv(r, node, t);
    read_wrap(r, node, t);
    char *path = xml_path(r, node, "filename");
    xnode *name = xml_child(node, "filename");
    if (path && all && strcmp(node->name, "opacity") == 0 && has_alpha(path)) {
        xml_say(r, TR_NOTE, node, "the opacity is the picture's alpha channel (Mitsuba would take its colour)");
        channel = "a";
        all = false;
    }
    bool ok = path && xml_read_image(r, name ? name : node, path, raw || gamma > 0, gamma, &t->image, all);
    if (ok && !all)
        ok = pick_channel(r, node, path, channel, &t->image);
    free(path);
    xml_report_unused(r, node, "format,max_anisotropy,cache,accel,variant");
    return ok;
}

/* Mitsuba 0.6's "scale": another texture times a colour. Its pixels are multiplied here, once. */
static bool read_scale(xml_reader *r, xnode *node, tr_texture *t)
{
    vec3 factor = xml_color(r, node, xml_child(node, "value") ? "value" : "scale", v3s(1), false);
    int id = -1;
    for (xnode *n = node->first; n; n = n->next)
        if (!n->used && xml_in_list(n->tag, "texture,ref") && id < 0)
            id = xml_texture(r, n);
    xml_report_unused(r, node, "");
    if (id < 0) {
        xml_say(r, TR_WARNING, node, "a scale texture has no texture inside");
        return false;
    }
    tr_image copy = {0};
    *t = r->scene->textures[id];
    t->id = NULL;
    t->color0 = mul3(t->color0, factor);
    t->color1 = mul3(t->color1, factor);
    if (t->type != TR_TEXTURE_BITMAP)
        return true;
    if (!tr_image_alloc(&copy, t->image.width, t->image.height, 3)) {
        xml_say(r, TR_ERROR, node, "out of memory");
        return false;
    }
    const float f[3] = {factor.x, factor.y, factor.z};
    for (size_t i = 0; i < 3 * (size_t)copy.width * (size_t)copy.height; ++i)
        copy.data[i] = t->image.data[i] * f[i % 3];
    t->image = copy;
    return true;
}

static bool read_texture(xml_reader *r, xnode *node, tr_texture *t)
{
    t->uv[0][0] = t->uv[1][1] = 1;
    if (strcmp(node->type, "bitmap") == 0)
        return read_bitmap(r, node, t);
    if (strcmp(node->type, "scale") == 0)
        return read_scale(r, node, t);
    if (strcmp(node->type, "checkerboard") == 0) {
        t->type = TR_TEXTURE_CHECKERBOARD;
        t->color0 = xml_color(r, node, "color0", v3s(0.4f), false);
        t->color1 = xml_color(r, node, "color1", v3s(0.2f), false);
        read_uv(r, node, t);
        xml_report_unused(r, node, "");
        return true;
    }
    xml_say(r, TR_WARNING, node, "texture type '%s' is not supported; a plain colour is used", node->type);
    xml_accept_all(node);
    return false;
}

/* Common to textures and bsdfs: an element is read once, and never while it is being read. */
static bool begin(xml_reader *r, xnode *node)
{
    if (node->state == 1 || r->depth >= NESTING_MAX) {
        xml_say(r, TR_ERROR, node,
                node->state == 1 ? "<%s id=\"%s\"> contains itself" : "<%s id=\"%s\"> nests too deep", node->tag,
                node->id);
        return false;
    }
    node->state = 1;
    ++r->depth;
    return true;
}

static int end(xml_reader *r, xnode *node, int result)
{
    node->state = 2;
    node->result = result;
    --r->depth;
    return result;
}

int xml_texture(xml_reader *r, xnode *node)
{
    tr_texture t = {0};
    xnode *n = xml_resolve(r, node);
    if (!n)
        return -1;
    if (n->state == 2 && strcmp(n->tag, "texture") == 0)
        return n->result;
    if (strcmp(n->tag, "texture") != 0) {
        xml_say(r, TR_ERROR, node, "a texture or a colour is expected here, not <%s>", n->tag);
        return -1;
    }
    if (!begin(r, n))
        return -1;
    if (!read_texture(r, n, &t))
        return end(r, n, -1);
    int id = tr_scene_add_texture(r->scene);
    if (id < 0) {
        xml_say(r, TR_ERROR, n, "out of memory");
        return end(r, n, -1);
    }
    t.id = *n->id ? tr_string_copy(n->id) : NULL;
    r->scene->textures[id] = t;
    return end(r, n, id);
}

/* ---- >>tables ----------------------------------------------------------------------------------------------- */

enum {
    HAS_REFLECTANCE = 1,
    HAS_DIFFUSE = 2, /* the same under another name */
    HAS_SPECULAR = 4,
    HAS_TRANSMITTANCE = 8,
    HAS_ROUGHNESS = 16,
    HAS_IOR = 32,
    HAS_METAL = 64,
    HAS_NONLINEAR = 128,
    HAS_EXPONENT = 256,
    HAS_CHILD = 512,
    HAS_OPACITY = 1024,
    HAS_BUMP = 2048,
    HAS_PRINCIPLED = 4096
};

typedef struct bsdf_kind {
    const char *name;
    tr_bsdf_type type;
    unsigned has;
    const char *warning;
} bsdf_kind;

static const bsdf_kind kinds[] = {
    {"diffuse", TR_BSDF_DIFFUSE, HAS_REFLECTANCE, NULL},
    {"roughdiffuse", TR_BSDF_DIFFUSE, HAS_REFLECTANCE | HAS_DIFFUSE, "roughdiffuse is treated as diffuse"},
    {"conductor", TR_BSDF_CONDUCTOR, HAS_METAL | HAS_SPECULAR, NULL},
    {"roughconductor", TR_BSDF_ROUGHCONDUCTOR, HAS_METAL | HAS_SPECULAR | HAS_ROUGHNESS, NULL},
    {"dielectric", TR_BSDF_DIELECTRIC, HAS_IOR | HAS_SPECULAR | HAS_TRANSMITTANCE, NULL},
    {"roughdielectric", TR_BSDF_ROUGHDIELECTRIC, HAS_IOR | HAS_SPECULAR | HAS_TRANSMITTANCE | HAS_ROUGHNESS, NULL},
    {"thindielectric", TR_BSDF_THINDIELECTRIC, HAS_IOR | HAS_SPECULAR | HAS_TRANSMITTANCE, NULL},
    {"plastic", TR_BSDF_PLASTIC, HAS_IOR | HAS_SPECULAR | HAS_DIFFUSE | HAS_NONLINEAR, NULL},
    {"roughplastic", TR_BSDF_ROUGHPLASTIC, HAS_IOR | HAS_SPECULAR | HAS_DIFFUSE | HAS_NONLINEAR | HAS_ROUGHNESS, NULL},
    {"phong", TR_BSDF_PHONG, HAS_SPECULAR | HAS_DIFFUSE | HAS_EXPONENT, NULL},
    {"principled", TR_BSDF_PBR, HAS_PRINCIPLED, "principled is treated as base colour, roughness and metallic alone"},
    {"twosided", TR_BSDF_TWOSIDED, HAS_CHILD, NULL},
    {"mask", TR_BSDF_MASK, HAS_CHILD | HAS_OPACITY, NULL},
    {"bumpmap", TR_BSDF_BUMPMAP, HAS_CHILD | HAS_BUMP, NULL},
    {"null", TR_BSDF_MASK, 0, NULL}};

/* Parameters that only change how Mitsuba samples or that say what is the default anyway. */
static const char *const harmless = "sample_visible,specular_sampling_weight,fast_approx,use_fast_approx";

/* ---- >>bsdfs ------------------------------------------------------------------------------------------------ */

static tr_param clamp_param(xml_reader *r, const xnode *node, tr_param p, const char *name)
{
    if (max3(p.value) > 1 && p.texture < 0) {
        xml_say(r, TR_WARNING, node, "%s above 1 would create energy and is cut to 1", name);
        p.value = v3(fminf(p.value.x, 1), fminf(p.value.y, 1), fminf(p.value.z, 1));
    }
    return p;
}

static void read_colors(xml_reader *r, xnode *node, unsigned has, tr_bsdf *b)
{
    static const struct {
        unsigned has;
        const char *name;
    } rows[] = {{HAS_REFLECTANCE, "reflectance"},
                {HAS_DIFFUSE, "diffuse_reflectance"},
                {HAS_SPECULAR, "specular_reflectance"},
                {HAS_TRANSMITTANCE, "specular_transmittance"}};
    tr_param *to[] = {&b->reflectance, &b->reflectance, &b->specular_reflectance, &b->specular_transmittance};
    for (size_t i = 0; i < sizeof rows / sizeof *rows; ++i)
        if (has & rows[i].has)
            *to[i] = clamp_param(r, node, xml_param(r, node, rows[i].name, *to[i], false), rows[i].name);
}

static void read_roughness(xml_reader *r, xnode *node, tr_bsdf *b)
{
    const char *d = xml_string(r, node, "distribution", "beckmann");
    b->distribution = strcmp(d, "ggx") == 0 ? TR_GGX : TR_BECKMANN;
    if (!xml_in_list(d, "ggx,beckmann"))
        xml_say(r, TR_WARNING, node, "distribution '%s' is not supported; beckmann is used", d);
    b->alpha = xml_param(r, node, "alpha", b->alpha, true);
    if (xml_child(node, "alpha_u") || xml_child(node, "alpha_v")) {
        float u = xml_float(r, node, "alpha_u", b->alpha.value.x), v = xml_float(r, node, "alpha_v", b->alpha.value.x);
        b->alpha.texture = -1;
        b->alpha.value = v3s(sqrtf(fmaxf(u * v, 0)));
        if (u != v)
            xml_say(r, TR_WARNING, node, "anisotropic roughness is not supported; alpha %g is used",
                    (double)b->alpha.value.x);
    }
    if (b->alpha.texture < 0 && !(b->alpha.value.x > 0 && b->alpha.value.x <= 1)) {
        b->alpha.value = v3s(clampf(b->alpha.value.x, 1e-3f, 1));
        xml_say(r, TR_WARNING, node, "roughness must lie in (0, 1]; %g is used", (double)b->alpha.value.x);
    }
}

static void read_ior(xml_reader *r, xnode *node, tr_bsdf *b)
{
    const float air = 1.000277f;
    float outside = xml_ior(r, node, "ext_ior", air), inside = xml_ior(r, node, "int_ior", b->ior * air);
    b->ior = inside / outside;
    if (!(b->ior > 0.05f && b->ior < 20)) {
        xml_say(r, TR_ERROR, node, "a relative index of refraction of %g is absurd", (double)b->ior);
        b->ior = 1.5f;
    }
}

static void read_metal(xml_reader *r, xnode *node, tr_bsdf *b)
{
    float outside = xml_ior(r, node, xml_child(node, "ext_eta") ? "ext_eta" : "ext_ior", 1.000277f);
    const char *material = xml_string(r, node, "material", NULL);
    vec3 eta = scale3(b->eta, 1.000277f), k = scale3(b->k, 1.000277f);
    if (material && !tr_metal(material, &eta, &k))
        xml_say(r, TR_WARNING, node, "unknown metal '%s'; copper is used", material);
    else if (material && strcmp(material, "none") != 0 && xml_once(r, ONCE_METAL))
        xml_say(r, TR_NOTE, node, "metals named by material get an index that fits their colour, not measured data");
    bool mirror = material && strcmp(material, "none") == 0;
    eta = xml_color(r, node, "eta", eta, false);
    k = xml_color(r, node, "k", k, false);
    b->eta = mirror ? eta : scale3(eta, 1 / outside);
    b->k = mirror ? k : scale3(k, 1 / outside);
}

/* The bsdfs nested in a wrapper, in order. Returns how many there are (at most 2 are kept). */
static int read_children(xml_reader *r, xnode *node, int child[2])
{
    int count = 0;
    for (xnode *n = node->first; n; n = n->next) {
        const xnode *target = n;
        if (n->used)
            continue;
        if (strcmp(n->tag, "ref") == 0)
            target = xml_resolve(r, n);
        if (!target || strcmp(target->tag, "bsdf") != 0) {
            n->used = n->used && !target; /* an unknown id is said already; textures are asked for later */
            continue;
        }
        int id = xml_bsdf(r, n);
        if (count < 2)
            child[count] = id;
        ++count;
    }
    return count;
}

static bool transmits(const tr_scene *s, int id)
{
    tr_bsdf_type t = s->bsdfs[id].type;
    return t == TR_BSDF_DIELECTRIC || t == TR_BSDF_ROUGHDIELECTRIC || t == TR_BSDF_THINDIELECTRIC || t == TR_BSDF_MASK;
}

/* Wrappers. Returns false where *only is to take the wrapper's place (-1 = failed). */
static bool read_wrapper(xml_reader *r, xnode *node, const bsdf_kind *kind, tr_bsdf *b, int *only)
{
    int count = read_children(r, node, b->child), limit = b->type == TR_BSDF_TWOSIDED ? 2 : 1;
    *only = -1;
    if (count == 0 || count > limit) {
        xml_say(r, count ? TR_WARNING : TR_ERROR, node, "<bsdf type=\"%s\"> has %d nested bsdfs", node->type, count);
        if (count == 0)
            return false;
    }
    if (limit == 1)
        b->child[1] = -1;
    if (b->child[0] < 0 || (count > 1 && limit > 1 && b->child[1] < 0)) {
        if (!r->failed)
            xml_say(r, TR_ERROR, node, "<bsdf type=\"%s\">: a nested bsdf is missing", node->type);
        return false;
    }
    if (b->type == TR_BSDF_TWOSIDED && transmits(r->scene, b->child[0])) {
        xml_say(r, TR_WARNING, node, "twosided around a bsdf that transmits is left out");
        *only = b->child[0];
        return false;
    }
    if (kind->has & HAS_OPACITY)
        b->opacity = clamp_param(r, node, xml_param(r, node, "opacity", b->opacity, true), "opacity");
    if (kind->has & HAS_BUMP) {
        b->bump_scale = xml_float(r, node, "scale", 1);
        for (xnode *n = node->first; n; n = n->next)
            if (!n->used && xml_in_list(n->tag, "texture,ref"))
                b->bump_texture = xml_texture(r, n);
        *only = b->child[0];
        if (b->bump_texture < 0) {
            xml_say(r, TR_WARNING, node, "a bumpmap without a usable texture is left out");
            return false;
        }
    }
    return true;
}

static void read_principled(xml_reader *r, xnode *node, tr_bsdf *b)
{
    tr_param rough = {v3s(0.5f), -1}, metal = {v3s(0), -1}, base = {v3s(0.5f), -1};
    b->reflectance = clamp_param(r, node, xml_param(r, node, "base_color", base, false), "base_color");
    b->alpha = xml_param(r, node, "roughness", rough, true);
    b->metallic = xml_param(r, node, "metallic", metal, true);
}

static int add_bsdf(xml_reader *r, const xnode *node, tr_bsdf *b)
{
    int id = tr_scene_add_bsdf(r->scene, b->type);
    if (id < 0) {
        xml_say(r, TR_ERROR, node, "out of memory");
        return -1;
    }
    b->line = node->line;
    b->id = *node->id ? tr_string_copy(node->id) : NULL;
    r->scene->bsdfs[id] = *b;
    return id;
}

int xml_default_bsdf(xml_reader *r)
{
    if (r->default_bsdf < 0)
        r->default_bsdf = tr_scene_add_bsdf(r->scene, TR_BSDF_DIFFUSE);
    return r->default_bsdf;
}

static int read_bsdf(xml_reader *r, xnode *node)
{
    const bsdf_kind *kind = NULL;
    tr_bsdf b;
    int only;
    for (size_t i = 0; i < sizeof kinds / sizeof *kinds; ++i)
        if (strcmp(kinds[i].name, node->type) == 0)
            kind = &kinds[i];
    tr_bsdf_defaults(&b, kind ? kind->type : TR_BSDF_DIFFUSE);
    if (!kind) {
        xml_say(r, TR_WARNING, node, "bsdf type '%s' is not supported; grey diffuse is used", node->type);
        xml_accept_all(node);
        return add_bsdf(r, node, &b);
    }
    if (kind->warning)
        xml_say(r, TR_WARNING, node, "%s", kind->warning);
    if ((kind->has & HAS_CHILD) && !read_wrapper(r, node, kind, &b, &only)) {
        xml_report_unused(r, node, harmless);
        return only;
    }
    if (strcmp(node->type, "null") == 0) { /* nothing there: a mask without any opacity */
        b.opacity.value = v3s(0);
        b.child[0] = xml_default_bsdf(r);
    }
    read_colors(r, node, kind->has, &b);
    if (kind->has & HAS_ROUGHNESS)
        read_roughness(r, node, &b);
    if (kind->has & HAS_IOR)
        read_ior(r, node, &b);
    if (kind->has & HAS_METAL)
        read_metal(r, node, &b);
    if (kind->has & HAS_NONLINEAR)
        b.nonlinear = xml_bool(r, node, "nonlinear", false);
    if (kind->has & HAS_EXPONENT)
        b.exponent = xml_param(r, node, "exponent", b.exponent, true);
    if (kind->has & HAS_PRINCIPLED)
        read_principled(r, node, &b);
    xml_report_unused(r, node, harmless);
    return add_bsdf(r, node, &b);
}

int xml_bsdf(xml_reader *r, xnode *node)
{
    xnode *n = xml_resolve(r, node);
    if (!n)
        return -1;
    if (strcmp(n->tag, "bsdf") != 0) {
        xml_say(r, TR_ERROR, node, "a bsdf is expected here, not <%s>", n->tag);
        return -1;
    }
    if (n->state == 2)
        return n->result;
    return begin(r, n) ? end(r, n, read_bsdf(r, n)) : -1;
}
