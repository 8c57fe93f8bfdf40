/* mesh.c: triangle meshes: memory, normals, and the files they come from (PLY, OBJ, .serialized).

   contents: >>memory >>normals >>file >>obj >>serialized >>load */
#include "scene_internal.h"

#include <errno.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>

#include <assimp/cimport.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>
#include <zlib.h>

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

bool tr_mesh_alloc(tr_shape *s, uint64_t vertices, uint64_t triangles, bool normals, bool uvs)
{
    if (vertices > TR_MESH_MAX || triangles > TR_MESH_MAX)
        return false;
    size_t nv = (size_t)vertices, nt = (size_t)triangles;
    s->type = TR_SHAPE_MESH;
    s->vertex_count = (uint32_t)vertices;
    s->triangle_count = (uint32_t)triangles;
    s->positions = calloc(nv + 1, 3 * sizeof(float));
    s->indices = calloc(nt + 1, 3 * sizeof(uint32_t));
    s->normals = normals ? calloc(nv + 1, 3 * sizeof(float)) : NULL;
    s->uvs = uvs ? calloc(nv + 1, 2 * sizeof(float)) : NULL;
    if (s->positions && s->indices && (!normals || s->normals) && (!uvs || s->uvs))
        return true;
    tr_mesh_free(s);
    return false;
}

void tr_mesh_free(tr_shape *s)
{
    free(s->positions);
    free(s->normals);
    free(s->uvs);
    free(s->indices);
    free(s->packed);
    s->positions = s->normals = s->uvs = s->packed = NULL;
    s->indices = NULL;
    s->vertex_count = s->triangle_count = 0;
}

bool tr_mesh_pack(tr_shape *s)
{
    free(s->packed);
    s->packed = tr_alloc_pages(((size_t)s->vertex_count + 1) * TR_PACKED * sizeof *s->packed);
    if (!s->packed)
        return false;
    for (size_t i = 0; i < s->vertex_count; ++i) {
        float *to = s->packed + TR_PACKED * i;
        memcpy(to, s->positions + 3 * i, 3 * sizeof *to);
        if (s->uvs)
            memcpy(to + 3, s->uvs + 2 * i, 2 * sizeof *to);
        if (s->normals)
            memcpy(to + 5, s->normals + 3 * i, 3 * sizeof *to);
    }
    return true;
}

bool tr_mesh_indices_valid(const tr_shape *s)
{
    for (size_t i = 0; i < 3 * (size_t)s->triangle_count; ++i)
        if (s->indices[i] >= s->vertex_count)
            return false;
    return true;
}

/* ---- >>normals ---------------------------------------------------------------------------------------------- */

static vec3 get3(const float *array, uint32_t i)
{
    const float *p = array + 3 * (size_t)i;
    return v3(p[0], p[1], p[2]);
}
static void set3(float *array, uint32_t i, vec3 v)
{
    float *p = array + 3 * (size_t)i;
    p[0] = v.x;
    p[1] = v.y;
    p[2] = v.z;
}

void tr_mesh_transform(tr_shape *s, const mat4 *to_world)
{
    mat4 identity = mat4_identity(), inverse;
    if (memcmp(to_world, &identity, sizeof identity) == 0)
        return;
    for (uint32_t i = 0; i < s->vertex_count; ++i)
        set3(s->positions, i, xform_point(to_world, get3(s->positions, i)));
    if (!s->normals)
        return;
    if (!mat4_inverse(to_world, &inverse)) { /* flattened: only face normals are left */
        free(s->normals);
        s->normals = NULL;
        return;
    }
    for (uint32_t i = 0; i < s->vertex_count; ++i) {
        vec3 n = get3(s->normals, i);
        set3(s->normals, i, black3(n) ? n : norm3(xform_normal(&inverse, n)));
    }
}

bool tr_mesh_smooth_normals(tr_shape *s)
{
    if (!s->normals)
        s->normals = malloc(((size_t)s->vertex_count + 1) * 3 * sizeof(float));
    if (!s->normals)
        return false;
    memset(s->normals, 0, ((size_t)s->vertex_count + 1) * 3 * sizeof(float));
    for (uint32_t t = 0; t < s->triangle_count; ++t) {
        const uint32_t *id = s->indices + 3 * (size_t)t;
        vec3 p[3] = {get3(s->positions, id[0]), get3(s->positions, id[1]), get3(s->positions, id[2])};
        vec3 n = cross3(sub3(p[1], p[0]), sub3(p[2], p[0]));
        float l = len3(n);
        if (!(l > 0) || !isfinite(l))
            continue;
        for (int c = 0; c < 3; ++c) {
            vec3 a = norm3(sub3(p[(c + 1) % 3], p[c])), b = norm3(sub3(p[(c + 2) % 3], p[c]));
            float angle = acosf(clampf(dot3(a, b), -1, 1));
            set3(s->normals, id[c], madd3(get3(s->normals, id[c]), n, angle / l));
        }
    }
    for (uint32_t i = 0; i < s->vertex_count; ++i) {
        vec3 n = get3(s->normals, i);
        set3(s->normals, i, black3(n) ? n : norm3(n));
    }
    return true;
}

void tr_mesh_align_winding(tr_shape *s)
{
    for (uint32_t t = 0; s->normals && t < s->triangle_count; ++t) {
        uint32_t *id = s->indices + 3 * (size_t)t;
        vec3 p0 = get3(s->positions, id[0]);
        vec3 ng = cross3(sub3(get3(s->positions, id[1]), p0), sub3(get3(s->positions, id[2]), p0));
        vec3 ns = add3(add3(get3(s->normals, id[0]), get3(s->normals, id[1])), get3(s->normals, id[2]));
        if (dot3(ng, ns) < 0) {
            uint32_t swap = id[1];
            id[1] = id[2];
            id[2] = swap;
        }
    }
}

/* ---- >>file ------------------------------------------------------------------------------------------------- */

#if defined(__GNUC__)
__attribute__((format(printf, 3, 4)))
#endif
static bool
fail(char *err, size_t err_size, const char *format, ...)
{
    va_list args;
    va_start(args, format);
    vsnprintf(err, err_size, format, args);
    va_end(args);
    return false;
}

unsigned char *tr_file_read(const char *path, size_t *size, char *err, size_t err_size)
{
    unsigned char *data = NULL;
    long length = -1;
    int why = 0;
    *size = 0;
    errno = 0;
    FILE *f = fopen(path, "rb");
    if (f)
        (void)fgetc(f); /* a folder opens, but says here what it is */
    if (f && !ferror(f) && fseek(f, 0, SEEK_END) == 0 && (length = ftell(f)) >= 0 && length < LONG_MAX - 1 &&
        fseek(f, 0, SEEK_SET) == 0)
        data = malloc((size_t)length + 1);
    if (data && fread(data, 1, (size_t)length, f) == (size_t)length) {
        data[length] = 0;
        *size = (size_t)length;
    } else {
        why = errno ? errno : EIO;
        fail(err, err_size, "cannot read '%s': %s", path, strerror(why));
        free(data);
        data = NULL;
    }
    if (f)
        fclose(f);
    if (!data)
        errno = why;
    return data;
}

/* ---- >>obj -------------------------------------------------------------------------------------------------- */

static void copy_ai_mesh(tr_shape *s, const struct aiMesh *m, uint32_t *vertex, uint32_t *triangle)
{
    for (unsigned i = 0; i < m->mNumVertices; ++i) {
        uint32_t k = *vertex + i;
        set3(s->positions, k, v3(m->mVertices[i].x, m->mVertices[i].y, m->mVertices[i].z));
        if (s->normals)
            set3(s->normals, k, v3(m->mNormals[i].x, m->mNormals[i].y, m->mNormals[i].z));
        if (s->uvs && m->mTextureCoords[0]) {
            s->uvs[2 * (size_t)k] = m->mTextureCoords[0][i].x;
            s->uvs[2 * (size_t)k + 1] = m->mTextureCoords[0][i].y;
        }
    }
    for (unsigned i = 0; i < m->mNumFaces; ++i) {
        if (m->mFaces[i].mNumIndices != 3) /* points and lines */
            continue;
        for (int c = 0; c < 3; ++c)
            s->indices[3 * (size_t)*triangle + (size_t)c] = *vertex + m->mFaces[i].mIndices[c];
        ++*triangle;
    }
    *vertex += m->mNumVertices;
}

typedef struct obj_source {
    const unsigned char *data;
    unsigned size;
} obj_source;

static const struct aiScene *import_obj(const obj_source *source)
{
    return aiImportFileFromMemory(
        (const char *)source->data, source->size,
        aiProcess_ValidateDataStructure | aiProcess_Triangulate | aiProcess_JoinIdenticalVertices, "obj");
}

static void try_obj(void *context)
{
    const struct aiScene *ai = import_obj(context);
    if (ai)
        aiReleaseImport(ai);
}

/* All groups become one shape. Material files are not read: the scene's bsdfs count. */
static bool read_obj(tr_shape *s, const unsigned char *data, size_t size, char *err, size_t err_size)
{
    obj_source source = {data, (unsigned)size};
    if (size > UINT32_MAX)
        return fail(err, err_size, "the OBJ file is larger than 4 GiB");
    if (!tr_survives(try_obj, &source))
        return fail(err, err_size, "the OBJ file is broken in a way that crashes its importer");
    const struct aiScene *ai = import_obj(&source);
    if (!ai)
        return fail(err, err_size, "not a valid OBJ file: %.150s", aiGetErrorString());
    uint64_t vertices = 0, triangles = 0;
    bool normals = true, uvs = false;
    for (unsigned i = 0; i < ai->mNumMeshes; ++i) {
        vertices += ai->mMeshes[i]->mNumVertices;
        triangles += ai->mMeshes[i]->mNumFaces;
        normals = normals && ai->mMeshes[i]->mNormals;
        uvs = uvs || ai->mMeshes[i]->mTextureCoords[0];
    }
    bool ok = tr_mesh_alloc(s, vertices, triangles, normals && vertices, uvs);
    uint32_t v = 0, t = 0;
    for (unsigned i = 0; ok && i < ai->mNumMeshes; ++i)
        copy_ai_mesh(s, ai->mMeshes[i], &v, &t);
    s->triangle_count = ok ? t : 0;
    aiReleaseImport(ai);
    return ok || fail(err, err_size, "out of memory for the OBJ file");
}

/* ---- >>serialized ------------------------------------------------------------------------------------------- */

/* Mitsuba's format, as its manual documents it: a dictionary of offsets at the end of the file; at each offset a
   little-endian 0x041c, a version (3 or 4), then one zlib stream. */
enum {
    SERIAL_NORMALS = 0x0001,
    SERIAL_UVS = 0x0002,
    SERIAL_COLORS = 0x0008,
    SERIAL_FACE_NORMALS = 0x0010,
    SERIAL_SINGLE = 0x1000,
    SERIAL_DOUBLE = 0x2000
};

static uint64_t little(const unsigned char *p, int bytes)
{
    uint64_t v = 0;
    for (int i = bytes - 1; i >= 0; --i)
        v = v << 8 | p[i];
    return v;
}

static bool inflate_bytes(z_stream *z, void *out, uint64_t size)
{
    unsigned char *p = out;
    while (size) {
        uInt part = size > 1u << 30 ? 1u << 30 : (uInt)size;
        z->next_out = p;
        z->avail_out = part;
        int r = inflate(z, Z_SYNC_FLUSH);
        uInt got = part - z->avail_out;
        if (got == 0 || (r != Z_OK && r != Z_STREAM_END))
            return false;
        p += got;
        size -= got;
    }
    return true;
}

/* count floats (or doubles, narrowed) into out; NULL = skip them. */
static bool inflate_floats(z_stream *z, float *out, uint64_t count, bool wide)
{
    unsigned char buffer[4096];
    const uint64_t size = wide ? 8 : 4, batch = sizeof buffer / size;
    for (uint64_t done = 0; done < count;) {
        uint64_t n = count - done < batch ? count - done : batch;
        if (!inflate_bytes(z, buffer, n * size))
            return false;
        for (uint64_t i = 0; out && i < n; ++i) {
            uint64_t bits = little(buffer + i * size, (int)size);
            uint32_t bits32 = (uint32_t)bits;
            double d;
            float f;
            memcpy(&d, &bits, 8);
            memcpy(&f, &bits32, 4);
            out[done + i] = wide ? (float)d : f;
        }
        done += n;
    }
    return true;
}

static bool inflate_indices(z_stream *z, tr_shape *s, uint64_t vertices, char *err, size_t err_size)
{
    unsigned char buffer[12 * 256];
    const uint64_t size = vertices > UINT64_C(0xffffffff) ? 8 : 4, count = 3 * (uint64_t)s->triangle_count;
    for (uint64_t i = 0; i < count;) {
        uint64_t n = count - i < 256 ? count - i : 256;
        if (!inflate_bytes(z, buffer, n * size))
            return fail(err, err_size, "the serialized mesh is truncated or corrupt");
        for (uint64_t k = 0; k < n; ++k) {
            uint64_t id = little(buffer + k * size, (int)size);
            if (id >= vertices)
                return fail(err, err_size, "a face of the serialized mesh names a vertex that does not exist");
            s->indices[i + k] = (uint32_t)id;
        }
        i += n;
    }
    return true;
}

static bool inflate_mesh(z_stream *z, int version, tr_shape *s, bool *face_normals, char *err, size_t err_size)
{
    const char *corrupt = "the serialized mesh is truncated or corrupt";
    unsigned char head[16], c = 1;
    const uint64_t most = (uint64_t)z->avail_in * 1040 + 64; /* deflate's best ratio is 1032 : 1 */
    if (!inflate_bytes(z, head, 4))
        return fail(err, err_size, "%s", corrupt);
    uint64_t flags = little(head, 4);
    for (int i = 0; version >= 4 && c; ++i) /* the mesh's name */
        if (i > 4096 || !inflate_bytes(z, &c, 1))
            return fail(err, err_size, "%s", corrupt);
    if (!inflate_bytes(z, head, 16))
        return fail(err, err_size, "%s", corrupt);
    uint64_t vertices = little(head, 8), triangles = little(head + 8, 8);
    bool wide = (flags & SERIAL_DOUBLE) != 0;
    if (vertices > TR_MESH_MAX || triangles > TR_MESH_MAX || (vertices + triangles) * 12 > most)
        return fail(err, err_size, "the serialized mesh counts more vertices than the file can hold");
    if (!tr_mesh_alloc(s, vertices, triangles, flags & SERIAL_NORMALS, flags & SERIAL_UVS))
        return fail(err, err_size, "out of memory for the serialized mesh");
    *face_normals = (flags & SERIAL_FACE_NORMALS) != 0;
    bool ok = inflate_floats(z, s->positions, 3 * vertices, wide) &&
              (!s->normals || inflate_floats(z, s->normals, 3 * vertices, wide)) &&
              (!s->uvs || inflate_floats(z, s->uvs, 2 * vertices, wide)) &&
              (!(flags & SERIAL_COLORS) || inflate_floats(z, NULL, 3 * vertices, wide));
    if (!ok)
        return fail(err, err_size, "%s", corrupt);
    return inflate_indices(z, s, vertices, err, err_size);
}

static bool read_serialized(tr_shape *s, const unsigned char *data, size_t size, int index, bool *face_normals,
                            char *err, size_t err_size)
{
    if (size < 8 || little(data, 2) != 0x041c)
        return fail(err, err_size, "not a serialized mesh file");
    int version = (int)little(data + 2, 2), width = version >= 4 ? 8 : 4;
    if (version != 3 && version != 4)
        return fail(err, err_size, "serialized mesh version %d is not supported (3 and 4 are)", version);
    uint64_t count = little(data + size - 4, 4), table = count * (uint64_t)width;
    if (table > size - 8)
        return fail(err, err_size, "the serialized mesh's table of shapes is corrupt");
    if (index < 0 || (uint64_t)index >= count)
        return fail(err, err_size, "shape_index %d, but the file holds %llu shapes", index, (unsigned long long)count);
    uint64_t end = size - 4 - table, at = little(data + end + (uint64_t)index * (uint64_t)width, width);
    if (at > end || end - at < 4 || little(data + at, 2) != 0x041c)
        return fail(err, err_size, "the serialized mesh's table of shapes is corrupt");
    version = (int)little(data + at + 2, 2);
    if (version != 3 && version != 4)
        return fail(err, err_size, "serialized mesh version %d is not supported (3 and 4 are)", version);
    z_stream z = {0};
    uint64_t length = end - at - 4;
    z.next_in = (Bytef *)(uintptr_t)(data + at + 4); /* zlib's pointer lacks the const */
    z.avail_in = length > UINT32_MAX ? UINT32_MAX : (uInt)length;
    if (inflateInit(&z) != Z_OK)
        return fail(err, err_size, "zlib could not start");
    bool ok = inflate_mesh(&z, version, s, face_normals, err, err_size);
    inflateEnd(&z);
    return ok;
}

/* ---- >>load ------------------------------------------------------------------------------------------------- */

bool tr_mesh_load(tr_shape *s, const char *path, const tr_mesh_options *options, char *err, size_t err_size)
{
    size_t size;
    bool ok = false, face_normals = false;
    unsigned char *data = tr_file_read(path, &size, err, err_size);
    if (!data)
        return false;
    if (options->format == TR_MESH_PLY)
        ok = tr_ply_read(s, data, size, err, err_size);
    else if (options->format == TR_MESH_OBJ)
        ok = read_obj(s, data, size, err, err_size);
    else
        ok = read_serialized(s, data, size, options->shape_index, &face_normals, err, err_size);
    free(data);
    if (ok && options->flip_v)
        for (uint32_t i = 0; s->uvs && i < s->vertex_count; ++i)
            s->uvs[2 * (size_t)i + 1] = 1 - s->uvs[2 * (size_t)i + 1];
    if (ok) {
        if (options->face_normals || face_normals) {
            free(s->normals);
            s->normals = NULL;
        }
        tr_mesh_transform(s, &options->to_world);
        /* As Mitsuba: a mesh without normals is smooth unless the scene says face_normals. */
        if (!s->normals && !options->face_normals && !face_normals)
            ok = tr_mesh_smooth_normals(s) || fail(err, err_size, "out of memory");
    }
    if (!ok)
        tr_mesh_free(s);
    return ok;
}
