/* gltf.c: a .gltf or .glb file as a scene: meshes, camera, materials, lights.

   contents: >>json >>images >>materials >>meshes >>lights >>load

   Assimp reads the file; what its glTF importer of 5.2 gets wrong or leaves out (the camera's field of view,
   KHR_materials_emissive_strength) is looked up in the JSON itself. Punctual lights and emission are in candela, lux
   and nits there; the numbers are taken as they are, in watts, so that their ratios stay. */
#include "scene_internal.h"

#include <stdlib.h>
#include <string.h>

#include <assimp/GltfMaterial.h>
#include <assimp/cimport.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>
#include <stb/stb_image.h>

typedef struct gltf {
    const struct aiScene *ai;
    const char *json; /* NULL = none found */
    const char *path;
    tr_scene *scene;
    tr_log *log;
    int *bsdfs;      /* of each material */
    vec3 *emission;  /* of each material */
    unsigned *uv;    /* texture coordinate set of each material */
    bool *has_light; /* aiLight already placed */
    bool has_camera, failed;
    unsigned said;
} gltf;

enum { SAID_NORMAL_MAP = 1, SAID_EMISSIVE = 2, SAID_CAMERAS = 4, SAID_TRANSMISSION = 8 };

static bool once(gltf *g, unsigned what)
{
    bool first = !(g->said & what);
    g->said |= what;
    return first;
}

static void out_of_memory(gltf *g)
{
    if (!g->failed)
        tr_message(g->log, TR_ERROR, g->path, 0, "out of memory");
    g->failed = true;
}

/* ---- >>json ------------------------------------------------------------------------------------------------- */

/* Assimp has parsed the text before, so these only have to be safe, not strict. Positions are pointers into it. */

static const char *json_blank(const char *s) { return s + strspn(s, " \t\r\n"); }

static const char *json_skip_string(const char *s)
{
    for (++s; *s && *s != '"'; ++s)
        if (*s == '\\' && s[1])
            ++s;
    return *s ? s + 1 : s;
}

/* Past the value at s. */
static const char *json_skip(const char *s)
{
    int depth = 0;
    s = json_blank(s);
    do {
        if (*s == '"')
            s = json_skip_string(s);
        else if (*s == '{' || *s == '[') {
            ++depth;
            ++s;
        } else if (*s == '}' || *s == ']') {
            --depth;
            ++s;
        } else if (depth == 0)
            return s + strcspn(s, ",}] \t\r\n");
        else
            s += *s != 0;
    } while (*s && depth > 0);
    return s;
}

/* Value of a member of the object at s; NULL = s is NULL or has none. */
static const char *json_member(const char *s, const char *key)
{
    size_t n = strlen(key);
    s = s ? json_blank(s) : "";
    if (*s != '{')
        return NULL;
    for (++s; *(s = json_blank(s)) == '"';) {
        const char *name = s + 1;
        s = json_blank(json_skip_string(s));
        if (*s != ':')
            return NULL;
        ++s;
        if (strncmp(name, key, n) == 0 && name[n] == '"')
            return json_blank(s);
        s = json_blank(json_skip(s));
        if (*s == ',')
            ++s;
    }
    return NULL;
}

static const char *json_element(const char *s, unsigned index)
{
    s = s ? json_blank(s) : "";
    if (*s != '[')
        return NULL;
    for (s = json_blank(s + 1); *s && *s != ']' && index > 0; --index) {
        s = json_blank(json_skip(s));
        if (*s == ',')
            s = json_blank(s + 1);
    }
    return *s && *s != ']' ? s : NULL;
}

static float json_number(const char *s, float fallback)
{
    char *end;
    float v = s ? strtof(s, &end) : 0;
    return s && end != s && isfinite(v) ? v : fallback;
}

/* The JSON text of a file in memory: all of it, or a .glb file's first chunk, which is cut off where it ends. */
static const char *json_text(unsigned char *data, size_t size)
{
    if (size < 20 || memcmp(data, "glTF", 4) != 0)
        return (const char *)data;
    uint32_t length =
        (uint32_t)data[12] | (uint32_t)data[13] << 8 | (uint32_t)data[14] << 16 | (uint32_t)data[15] << 24;
    if (length > size - 20)
        return NULL;
    data[20 + length] = 0; /* the buffer is one byte longer than the file */
    return (const char *)data + 20;
}

/* Tell of the files that the JSON text names: buffers, which the importer reads, and images. */
static void tell_files(tr_log *log, const char *path, const char *json)
{
    for (const char *at = json; at && (at = strstr(at, "\"uri\"")) != NULL;) {
        char name[1024];
        at += 5;
        at += strspn(at, " \t\r\n:");
        size_t n = *at == '"' ? strcspn(at + 1, "\"") : 0;
        if (n == 0 || n >= sizeof name || strncmp(at + 1, "data:", 5) == 0)
            continue;
        memcpy(name, at + 1, n);
        name[n] = 0;
        char *file = tr_path_beside(path, name);
        FILE *f = file ? fopen(file, "rb") : NULL;
        if (f) {
            fclose(f);
            tr_file_used(log, file);
        }
        free(file);
    }
}

/* ---- >>images ----------------------------------------------------------------------------------------------- */

typedef struct pixels {
    unsigned char *rgba; /* 4 bytes each, row 0 on top; NULL = none */
    int width, height;
    tr_wrap wrap;
} pixels;

static bool texture_index(const char *name, unsigned *index)
{
    char *end;
    if (name[0] != '*')
        return false;
    *index = (unsigned)strtoul(name + 1, &end, 10);
    return end != name + 1;
}

static void open_embedded(gltf *g, unsigned index, pixels *p)
{
    const struct aiTexture *t = index < g->ai->mNumTextures ? g->ai->mTextures[index] : NULL;
    int n;
    if (t && t->mHeight == 0 && t->mWidth <= INT32_MAX)
        p->rgba = stbi_load_from_memory((const stbi_uc *)t->pcData, (int)t->mWidth, &p->width, &p->height, &n, 4);
}

/* The picture of a material's texture slot. False = it has none; on a read error p->rgba stays NULL (said). */
static bool open_texture(gltf *g, const struct aiMaterial *m, enum aiTextureType type, pixels *p, unsigned *uv)
{
    struct aiString name;
    enum aiTextureMapMode mode[2] = {aiTextureMapMode_Wrap, aiTextureMapMode_Wrap};
    unsigned index, set = 0;
    int n;
    memset(p, 0, sizeof *p);
    if (aiGetMaterialTexture(m, type, 0, &name, NULL, &set, NULL, NULL, mode, NULL) != aiReturn_SUCCESS)
        return false;
    if (uv)
        *uv = set;
    p->wrap = mode[0] == aiTextureMapMode_Clamp    ? TR_WRAP_CLAMP
              : mode[0] == aiTextureMapMode_Mirror ? TR_WRAP_MIRROR
                                                   : TR_WRAP_REPEAT;
    if (texture_index(name.data, &index))
        open_embedded(g, index, p);
    else {
        char *path = tr_path_beside(g->path, name.data);
        p->rgba = path ? stbi_load(path, &p->width, &p->height, &n, 4) : NULL;
        free(path);
    }
    if (!p->rgba) {
        tr_message(g->log, TR_ERROR, g->path, 0, "cannot read the image '%.100s': %s", name.data,
                   stbi_failure_reason());
        g->failed = true;
    }
    return true;
}

/* A texture from three of the four channels; sRGB bytes become linear; times factor. cutoff >= 0: 0 or 1 instead. */
static int add_texture(gltf *g, const pixels *p, const int channels[3], bool srgb, vec3 factor, float cutoff)
{
    const float f[3] = {factor.x, factor.y, factor.z};
    float table[256];
    int id = tr_scene_add_texture(g->scene);
    tr_image image;
    if (id < 0 || !tr_image_alloc(&image, p->width, p->height, 3)) {
        out_of_memory(g);
        return -1;
    }
    for (int i = 0; i < 256; ++i)
        table[i] = srgb ? tr_srgb_decode((float)i / 255) : (float)i / 255;
    for (size_t i = 0; i < (size_t)p->width * (size_t)p->height; ++i)
        for (int c = 0; c < 3; ++c) {
            float v = table[p->rgba[4 * i + (size_t)channels[c]]] * f[c];
            image.data[3 * i + (size_t)c] = cutoff >= 0 ? (v >= cutoff ? 1.0f : 0.0f) : v;
        }
    tr_texture *t = &g->scene->textures[id];
    t->type = TR_TEXTURE_BITMAP;
    t->image = image;
    t->wrap = p->wrap;
    return id;
}

/* ---- >>materials -------------------------------------------------------------------------------------------- */

static float number(const struct aiMaterial *m, const char *key, float fallback)
{
    ai_real v = fallback;
    /* The array form: the scalar one is inline without a symbol, and -O0 would not link. */
    return aiGetMaterialFloatArray(m, key, 0, 0, &v, NULL) == aiReturn_SUCCESS && isfinite(v) ? v : fallback;
}

static tr_param constant(vec3 v)
{
    tr_param p = {v, -1};
    return p;
}

/* Base colour and the opacity that hides in its alpha; opacity->value.x stays 1 where everything is opaque. */
static void read_base(gltf *g, const struct aiMaterial *m, unsigned *uv, tr_param *color, tr_param *opacity)
{
    static const int rgb[3] = {0, 1, 2}, alpha[3] = {3, 3, 3};
    struct aiColor4D c = {1, 1, 1, 1};
    struct aiString mode;
    pixels p;
    aiGetMaterialColor(m, AI_MATKEY_BASE_COLOR, &c);
    vec3 factor = v3(clampf(c.r, 0, 1), clampf(c.g, 0, 1), clampf(c.b, 0, 1));
    bool has_mode = aiGetMaterialString(m, AI_MATKEY_GLTF_ALPHAMODE, &mode) == aiReturn_SUCCESS;
    bool mask = has_mode && strcmp(mode.data, "MASK") == 0, blend = has_mode && strcmp(mode.data, "BLEND") == 0;
    float cutoff = mask ? number(m, "$mat.gltf.alphaCutoff", 0.5f) : -1, a = clampf(c.a, 0, 1);
    *color = constant(factor);
    *opacity = constant(v3s(mask ? (a >= cutoff ? 1.0f : 0.0f) : blend ? a : 1.0f));
    bool found =
        open_texture(g, m, aiTextureType_BASE_COLOR, &p, uv) || open_texture(g, m, aiTextureType_DIFFUSE, &p, uv);
    if (!found || !p.rgba)
        return;
    color->texture = add_texture(g, &p, rgb, true, factor, -1);
    bool opaque = true;
    for (size_t i = 0; i < (size_t)p.width * (size_t)p.height; ++i)
        opaque = opaque && p.rgba[4 * i + 3] == 255;
    if (!opaque && (mask || blend))
        opacity->texture = add_texture(g, &p, alpha, false, v3s(a), cutoff);
    stbi_image_free(p.rgba);
}

static void read_metallic_roughness(gltf *g, const struct aiMaterial *m, unsigned *uv, tr_bsdf *b)
{
    static const int green[3] = {1, 1, 1}, blue[3] = {2, 2, 2};
    float metallic = clampf(number(m, "$mat.metallicFactor", 1), 0, 1);
    float roughness = clampf(number(m, "$mat.roughnessFactor", 1), 0, 1);
    pixels p;
    b->metallic = constant(v3s(metallic));
    b->alpha = constant(v3s(roughness));
    bool found =
        open_texture(g, m, aiTextureType_UNKNOWN, &p, uv) || open_texture(g, m, aiTextureType_METALNESS, &p, uv);
    if (!found || !p.rgba)
        return;
    b->metallic.texture = add_texture(g, &p, blue, false, v3s(metallic), -1);
    b->alpha.texture = add_texture(g, &p, green, false, v3s(roughness), -1);
    stbi_image_free(p.rgba);
}

static vec3 read_emission(gltf *g, const struct aiMaterial *m, unsigned index)
{
    struct aiColor4D c = {0, 0, 0, 1};
    pixels p;
    const char *json = json_element(json_member(g->json, "materials"), index);
    json = json_member(json_member(json, "extensions"), "KHR_materials_emissive_strength");
    float strength = json_number(json_member(json, "emissiveStrength"), 1);
    if (aiGetMaterialColor(m, AI_MATKEY_COLOR_EMISSIVE, &c) != aiReturn_SUCCESS)
        return v3(0, 0, 0);
    vec3 e = scale3(v3(fmaxf(c.r, 0), fmaxf(c.g, 0), fmaxf(c.b, 0)), fmaxf(strength, 0));
    if (!finite3(e) || black3(e) || !open_texture(g, m, aiTextureType_EMISSIVE, &p, NULL) || !p.rgba)
        return finite3(e) ? e : v3(0, 0, 0);
    double sum[3] = {0}, n = (double)p.width * p.height;
    for (size_t i = 0; i < (size_t)p.width * (size_t)p.height; ++i)
        for (size_t k = 0; k < 3; ++k)
            sum[k] += (double)tr_srgb_decode((float)p.rgba[4 * i + k] / 255);
    stbi_image_free(p.rgba);
    if (once(g, SAID_EMISSIVE))
        tr_message(g->log, TR_WARNING, g->path, 0, "emissive textures are replaced by their mean colour");
    return mul3(e, v3((float)(sum[0] / n), (float)(sum[1] / n), (float)(sum[2] / n)));
}

/* KHR_materials_transmission: glass. Without a volume the walls are thin, as the extension says. */
static void read_transmission(gltf *g, const struct aiMaterial *m, tr_bsdf *b)
{
    float amount = number(m, "$mat.transmission.factor", 0);
    float rough = b->alpha.texture < 0 ? b->alpha.value.x : 0;
    if (!(amount > 0))
        return;
    if (once(g, SAID_TRANSMISSION) && amount < 1)
        tr_message(g->log, TR_NOTE, g->path, 0, "transmission is all or nothing: factors of 0.5 and more make glass");
    if (amount < 0.5f)
        return;
    bool thin = !(number(m, "$mat.volume.thicknessFactor", 0) > 0);
    tr_param color = b->reflectance;
    tr_bsdf_defaults(b, rough > 0.1f ? TR_BSDF_ROUGHDIELECTRIC : thin ? TR_BSDF_THINDIELECTRIC : TR_BSDF_DIELECTRIC);
    b->distribution = TR_GGX;
    b->alpha = constant(v3s(fmaxf(rough * rough, 1e-3f)));
    b->ior = clampf(number(m, "$mat.refracti", 1.5f), 1.0001f, 5);
    b->specular_transmittance = color;
}

static int wrap_bsdf(gltf *g, tr_bsdf_type type, int child)
{
    int id = child < 0 ? -1 : tr_scene_add_bsdf(g->scene, type);
    if (id < 0)
        out_of_memory(g);
    else
        g->scene->bsdfs[id].child[0] = child;
    return id;
}

static void read_material(gltf *g, unsigned index)
{
    const struct aiMaterial *m = g->ai->mMaterials[index];
    struct aiString name;
    tr_param opacity;
    tr_bsdf b;
    tr_bsdf_defaults(&b, TR_BSDF_PBR);
    read_base(g, m, &g->uv[index], &b.reflectance, &opacity);
    read_metallic_roughness(g, m, &g->uv[index], &b);
    read_transmission(g, m, &b);
    g->emission[index] = read_emission(g, m, index);
    if (aiGetMaterialTextureCount(m, aiTextureType_NORMALS) && once(g, SAID_NORMAL_MAP))
        tr_message(g->log, TR_WARNING, g->path, 0, "normal maps are not supported and ignored");
    int id = tr_scene_add_bsdf(g->scene, b.type);
    if (id < 0) {
        out_of_memory(g);
        return;
    }
    if (aiGetMaterialString(m, AI_MATKEY_NAME, &name) == aiReturn_SUCCESS)
        b.id = tr_string_copy(name.data);
    g->scene->bsdfs[id] = b;
    /* Both sides always: a renderer of light cannot leave out backs, which is all that doubleSided = false asks. */
    if (b.type == TR_BSDF_PBR)
        id = wrap_bsdf(g, TR_BSDF_TWOSIDED, id);
    if (opacity.texture >= 0 || opacity.value.x < 1) {
        id = wrap_bsdf(g, TR_BSDF_MASK, id);
        if (id >= 0)
            g->scene->bsdfs[id].opacity = opacity;
    }
    g->bsdfs[index] = id;
}

/* ---- >>meshes ----------------------------------------------------------------------------------------------- */

static mat4 matrix_of(const struct aiMatrix4x4 *a)
{
    mat4 m = {{{a->a1, a->a2, a->a3, a->a4},
               {a->b1, a->b2, a->b3, a->b4},
               {a->c1, a->c2, a->c3, a->c4},
               {a->d1, a->d2, a->d3, a->d4}}};
    return m;
}

static bool copy_mesh(tr_shape *s, const struct aiMesh *m, unsigned uv_set)
{
    const struct aiVector3D *uv = uv_set < AI_MAX_NUMBER_OF_TEXTURECOORDS ? m->mTextureCoords[uv_set] : NULL;
    uint32_t t = 0;
    if (!tr_mesh_alloc(s, m->mNumVertices, m->mNumFaces, m->mNormals != NULL, uv != NULL))
        return false;
    for (size_t i = 0; i < m->mNumVertices; ++i) {
        memcpy(s->positions + 3 * i, &m->mVertices[i], 3 * sizeof(float));
        if (s->normals)
            memcpy(s->normals + 3 * i, &m->mNormals[i], 3 * sizeof(float));
        if (s->uvs)
            memcpy(s->uvs + 2 * i, &uv[i], 2 * sizeof(float));
    }
    for (unsigned i = 0; i < m->mNumFaces; ++i)
        if (m->mFaces[i].mNumIndices == 3) /* else a point or a line */
            memcpy(s->indices + 3 * (size_t)t++, m->mFaces[i].mIndices, 3 * sizeof(uint32_t));
    s->triangle_count = t;
    return true;
}

static void add_mesh(gltf *g, const struct aiMesh *m, const mat4 *to_world, const char *name)
{
    unsigned material = m->mMaterialIndex;
    int id;
    if (material >= g->ai->mNumMaterials || m->mNumFaces == 0 || !(m->mPrimitiveTypes & aiPrimitiveType_TRIANGLE))
        return;
    id = tr_scene_add_shape(g->scene);
    if (id < 0 || !copy_mesh(&g->scene->shapes[id], m, g->uv[material])) {
        out_of_memory(g);
        return;
    }
    tr_shape *s = &g->scene->shapes[id];
    tr_mesh_transform(s, to_world);
    s->bsdf = g->bsdfs[material];
    s->id = tr_string_copy(name);
    if (black3(g->emission[material]))
        return;
    int light = tr_scene_add_light(g->scene, TR_LIGHT_AREA);
    if (light < 0) {
        out_of_memory(g);
        return;
    }
    g->scene->lights[light].shape = id;
    g->scene->lights[light].value = g->emission[material];
    g->scene->shapes[id].light = light;
}

/* ---- >>lights ----------------------------------------------------------------------------------------------- */

static void add_punctual(gltf *g, const struct aiLight *l, const mat4 *to_world)
{
    bool spot = l->mType == aiLightSource_SPOT, directional = l->mType == aiLightSource_DIRECTIONAL;
    if (!spot && !directional && l->mType != aiLightSource_POINT) {
        tr_message(g->log, TR_WARNING, g->path, 0, "the light '%.80s' has an unknown type", l->mName.data);
        return;
    }
    int id = tr_scene_add_light(g->scene, spot ? TR_LIGHT_SPOT : directional ? TR_LIGHT_DIRECTIONAL : TR_LIGHT_POINT);
    if (id < 0) {
        out_of_memory(g);
        return;
    }
    tr_light *t = &g->scene->lights[id];
    vec3 d = v3(l->mDirection.x, l->mDirection.y, l->mDirection.z);
    float outer = clampf(l->mAngleOuterCone, 1e-3f, TR_PI / 2);
    t->value = v3(l->mColorDiffuse.r, l->mColorDiffuse.g, l->mColorDiffuse.b);
    t->position = xform_point(to_world, v3(l->mPosition.x, l->mPosition.y, l->mPosition.z));
    t->direction = norm3(xform_vector(to_world, black3(d) ? v3(0, 0, -1) : d));
    if (spot) {
        t->cutoff_cos = cosf(outer);
        t->beam_cos = cosf(clampf(l->mAngleInnerCone, 0, outer));
    }
}

static void read_camera(gltf *g, unsigned index, const mat4 *to_world)
{
    const struct aiCamera *c = g->ai->mCameras[index];
    const char *json = json_member(json_element(json_member(g->json, "cameras"), index), "perspective");
    float aspect = json_number(json_member(json, "aspectRatio"), 0);
    float fov = json_number(json_member(json, "yfov"), aspect > 0 ? c->mHorizontalFOV / aspect : c->mHorizontalFOV);
    /* glTF looks along -z with +x to the right; ours along +z with +x to the left. */
    mat4 turn = mat4_scale(v3(-1, 1, -1));
    tr_camera *out = &g->scene->camera;
    if (!json)
        tr_message(g->log, TR_WARNING, g->path, 0, "the camera '%.80s' is not a perspective one", c->mName.data);
    out->to_world = mat4_mul(to_world, &turn);
    out->fov = clampf(fov * (180 / TR_PI), 0.1f, 179);
    out->fov_axis = 1;
    if (aspect > 0.01f && aspect < 100) {
        g->scene->width = aspect >= 1 ? 1280 : (int)(1280 * aspect + 0.5f);
        g->scene->height = aspect >= 1 ? (int)(1280 / aspect + 0.5f) : 1280;
    }
    g->has_camera = true;
}

/* ---- >>load ------------------------------------------------------------------------------------------------- */

static void read_node(gltf *g, const struct aiNode *node, const mat4 *parent, int depth)
{
    mat4 local = matrix_of(&node->mTransformation), to_world = mat4_mul(parent, &local);
    if (depth > 200) {
        tr_message(g->log, TR_ERROR, g->path, 0, "nodes are nested too deep");
        g->failed = true;
    }
    for (unsigned i = 0; i < node->mNumMeshes && !g->failed; ++i)
        if (node->mMeshes[i] < g->ai->mNumMeshes)
            add_mesh(g, g->ai->mMeshes[node->mMeshes[i]], &to_world, node->mName.data);
    for (unsigned i = 0; i < g->ai->mNumCameras; ++i)
        if (strcmp(g->ai->mCameras[i]->mName.data, node->mName.data) == 0) {
            if (!g->has_camera)
                read_camera(g, i, &to_world);
            else if (once(g, SAID_CAMERAS))
                tr_message(g->log, TR_NOTE, g->path, 0, "only the first camera is used");
        }
    for (unsigned i = 0; i < g->ai->mNumLights && !g->failed; ++i)
        if (!g->has_light[i] && strcmp(g->ai->mLights[i]->mName.data, node->mName.data) == 0) {
            g->has_light[i] = true;
            add_punctual(g, g->ai->mLights[i], &to_world);
        }
    for (unsigned i = 0; i < node->mNumChildren && !g->failed; ++i)
        read_node(g, node->mChildren[i], &to_world, depth + 1);
}

static void read_scene(gltf *g)
{
    const struct aiScene *ai = g->ai;
    mat4 identity = mat4_identity();
    g->bsdfs = calloc((size_t)ai->mNumMaterials + 1, sizeof *g->bsdfs);
    g->emission = calloc((size_t)ai->mNumMaterials + 1, sizeof *g->emission);
    g->uv = calloc((size_t)ai->mNumMaterials + 1, sizeof *g->uv);
    g->has_light = calloc((size_t)ai->mNumLights + 1, sizeof *g->has_light);
    g->scene->width = 1280;
    g->scene->height = 720;
    if (!g->bsdfs || !g->emission || !g->uv || !g->has_light) {
        out_of_memory(g);
        return;
    }
    for (unsigned i = 0; i < ai->mNumMaterials && !g->failed; ++i)
        read_material(g, i);
    if (!g->failed && ai->mRootNode)
        read_node(g, ai->mRootNode, &identity, 0);
    if (g->failed)
        return;
    if (!g->has_camera) {
        tr_message(g->log, TR_NOTE, g->path, 0, "there is no camera; one is placed to see everything");
        tr_scene_frame(g->scene);
    }
    if (g->scene->light_count == 0) {
        tr_message(g->log, TR_NOTE, g->path, 0, "there is no light; a white sky of radiance 1 is added");
        int id = tr_scene_add_light(g->scene, TR_LIGHT_CONSTANT);
        if (id < 0)
            out_of_memory(g);
        else
            g->scene->lights[id].value = v3s(1);
    }
}

static const struct aiScene *import(const char *path)
{
    return aiImportFile(path, aiProcess_ValidateDataStructure | aiProcess_Triangulate | aiProcess_TransformUVCoords);
}

static void try_import(void *path)
{
    const struct aiScene *ai = import(path);
    if (ai)
        aiReleaseImport(ai);
}

bool tr_gltf_load(tr_scene *scene, const char *path, tr_log *log)
{
    gltf g = {0};
    char err[300];
    size_t size;
    unsigned char *data = tr_file_read(path, &size, err, sizeof err);
    if (!data) {
        tr_message(log, TR_ERROR, path, 0, "%s", err);
        return false;
    }
    g.path = path;
    g.scene = scene;
    g.log = log;
    bool survives = tr_survives(try_import, scene->path);
    g.ai = survives ? import(path) : NULL;
    if (g.ai && g.ai->mNumMeshes) {
        g.json = json_text(data, size);
        tr_file_used(log, path);
        tell_files(log, path, g.json);
        read_scene(&g);
    } else {
        tr_message(log, TR_ERROR, path, 0, "not a usable glTF file: %.200s",
                   !survives ? "it crashes its importer"
                   : g.ai    ? "no meshes"
                             : aiGetErrorString());
        g.failed = true;
    }
    if (g.ai)
        aiReleaseImport(g.ai);
    free(g.bsdfs);
    free(g.emission);
    free(g.uv);
    free(g.has_light);
    free(data);
    return !g.failed;
}
