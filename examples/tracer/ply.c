/* ply.c: PLY meshes, text and binary of either byte order.

   Not through assimp: its reader takes a newline byte that starts the binary data for the end of the header and shifts
   all that follows (seen with 5.2). Every read here is checked against the end of the file. */
#include "scene_internal.h"

#include <stdlib.h>
#include <string.h>

enum { PLY_NAME = 32, PLY_PROPERTIES = 32, PLY_ELEMENTS = 16 };

typedef enum ply_type { PLY_NONE, PLY_I8, PLY_U8, PLY_I16, PLY_U16, PLY_I32, PLY_U32, PLY_F32, PLY_F64 } ply_type;
static const uint8_t type_size[] = {0, 1, 1, 2, 2, 4, 4, 4, 8};

/* Where a property goes. */
typedef enum ply_use { USE_NOTHING, USE_X, USE_Y, USE_Z, USE_NX, USE_NY, USE_NZ, USE_U, USE_V, USE_INDICES } ply_use;

typedef struct ply_property {
    ply_type type, count_type; /* count_type: lists only */
    ply_use use;
} ply_property;

typedef struct ply_element {
    char name[PLY_NAME];
    uint64_t count;
    int property_count;
    ply_property properties[PLY_PROPERTIES];
} ply_element;

typedef struct ply_file {
    const unsigned char *at, *end;
    bool text, swap;
    int element_count;
    ply_element elements[PLY_ELEMENTS];
    tr_shape *shape;
    uint64_t index_count, index_capacity;
    char *err;
    size_t err_size;
} ply_file;

static bool fail(ply_file *f, const char *what)
{
    snprintf(f->err, f->err_size, "%s", what);
    return false;
}

/* ---- header --------------------------------------------------------------------------------------------------- */

static ply_type parse_type(const char *s)
{
    static const struct {
        const char *name;
        ply_type type;
    } names[] = {{"char", PLY_I8},   {"int8", PLY_I8},     {"uchar", PLY_U8},   {"uint8", PLY_U8},
                 {"short", PLY_I16}, {"int16", PLY_I16},   {"ushort", PLY_U16}, {"uint16", PLY_U16},
                 {"int", PLY_I32},   {"int32", PLY_I32},   {"uint", PLY_U32},   {"uint32", PLY_U32},
                 {"float", PLY_F32}, {"float32", PLY_F32}, {"double", PLY_F64}, {"float64", PLY_F64}};
    for (size_t i = 0; i < sizeof names / sizeof *names; ++i)
        if (strcmp(s, names[i].name) == 0)
            return names[i].type;
    return PLY_NONE;
}

static ply_use parse_use(const char *s)
{
    static const struct {
        const char *name;
        ply_use use;
    } names[] = {{"x", USE_X},
                 {"y", USE_Y},
                 {"z", USE_Z},
                 {"nx", USE_NX},
                 {"ny", USE_NY},
                 {"nz", USE_NZ},
                 {"u", USE_U},
                 {"s", USE_U},
                 {"texture_u", USE_U},
                 {"texture_s", USE_U},
                 {"v", USE_V},
                 {"t", USE_V},
                 {"texture_v", USE_V},
                 {"texture_t", USE_V},
                 {"vertex_indices", USE_INDICES},
                 {"vertex_index", USE_INDICES}};
    for (size_t i = 0; i < sizeof names / sizeof *names; ++i)
        if (strcmp(s, names[i].name) == 0)
            return names[i].use;
    return USE_NOTHING;
}

/* Split one header line into at most 5 words. Returns their number, -1 at the end of the file. */
static int header_line(ply_file *f, char words[5][PLY_NAME])
{
    const unsigned char *p = f->at, *stop = memchr(f->at, '\n', (size_t)(f->end - f->at));
    int count = 0;
    if (!stop)
        return -1;
    while (p < stop && count < 5) {
        int n = 0;
        while (p < stop && (*p == ' ' || *p == '\t' || *p == '\r'))
            ++p;
        for (; p < stop && *p != ' ' && *p != '\t' && *p != '\r'; ++p)
            if (n < PLY_NAME - 1)
                words[count][n++] = (char)*p;
        words[count][n] = 0;
        count += n > 0;
    }
    f->at = stop + 1;
    return count;
}

static bool add_element(ply_file *f, const char *name, const char *count)
{
    char *end;
    if (f->element_count == PLY_ELEMENTS)
        return fail(f, "too many elements in the PLY header");
    ply_element *e = &f->elements[f->element_count++];
    memcpy(e->name, name, PLY_NAME);
    e->count = strtoull(count, &end, 10);
    if (*end || *count == '-' || e->count > (uint64_t)(f->end - f->at))
        return fail(f, "the PLY header counts more elements than the file can hold");
    return true;
}

static bool add_property(ply_file *f, int count, char words[5][PLY_NAME])
{
    ply_element *e = f->element_count ? &f->elements[f->element_count - 1] : NULL;
    bool list = count == 5 && strcmp(words[1], "list") == 0;
    if (!e || (count != 3 && !list) || e->property_count == PLY_PROPERTIES)
        return fail(f, "bad property line in the PLY header");
    ply_property *p = &e->properties[e->property_count++];
    p->type = parse_type(words[list ? 3 : 1]);
    p->count_type = list ? parse_type(words[2]) : PLY_NONE;
    p->use = parse_use(words[list ? 4 : 2]);
    if (!p->type || (list && !p->count_type))
        return fail(f, "unknown property type in the PLY header");
    if (list != (p->use == USE_INDICES))
        p->use = USE_NOTHING;
    return true;
}

static bool read_header(ply_file *f)
{
    static const uint16_t probe = 1;
    bool little = *(const uint8_t *)&probe == 1, format = false;
    char w[5][PLY_NAME];
    if (header_line(f, w) < 1 || strcmp(w[0], "ply") != 0)
        return fail(f, "not a PLY file");
    for (;;) {
        int n = header_line(f, w);
        bool ok = true;
        if (n < 0)
            return fail(f, "the PLY header does not end");
        if (n == 0 || strcmp(w[0], "comment") == 0 || strcmp(w[0], "obj_info") == 0)
            continue;
        if (strcmp(w[0], "end_header") == 0)
            return format || fail(f, "the PLY header names no format");
        if (strcmp(w[0], "format") == 0 && n >= 2) {
            f->text = strcmp(w[1], "ascii") == 0;
            bool le = strcmp(w[1], "binary_little_endian") == 0, be = strcmp(w[1], "binary_big_endian") == 0;
            f->swap = little ? be : le;
            format = ok = f->text || le || be;
            if (!ok)
                return fail(f, "unknown PLY format");
        } else if (strcmp(w[0], "element") == 0 && n == 3)
            ok = add_element(f, w[1], w[2]);
        else if (strcmp(w[0], "property") == 0)
            ok = add_property(f, n, w);
        else
            ok = fail(f, "unknown line in the PLY header");
        if (!ok)
            return false;
    }
}

/* ---- data ----------------------------------------------------------------------------------------------------- */

static bool read_text(ply_file *f, double *value)
{
    char *end;
    *value = strtod((const char *)f->at, &end); /* the file ends with a 0 byte */
    if ((const unsigned char *)end == f->at)
        return fail(f, "a number is missing or malformed in the PLY file");
    f->at = (const unsigned char *)end;
    return true;
}

static bool read_number(ply_file *f, ply_type type, double *value)
{
    union {
        unsigned char b[8];
        int8_t i8;
        uint8_t u8;
        int16_t i16;
        uint16_t u16;
        int32_t i32;
        uint32_t u32;
        float f32;
        double f64;
    } v;
    if (f->text)
        return read_text(f, value);
    size_t n = type_size[type];
    if ((size_t)(f->end - f->at) < n)
        return fail(f, "the PLY file is truncated");
    for (size_t i = 0; i < n; ++i)
        v.b[f->swap ? n - 1 - i : i] = f->at[i];
    f->at += n;
    switch (type) {
    case PLY_I8:
        *value = v.i8;
        break;
    case PLY_U8:
        *value = v.u8;
        break;
    case PLY_I16:
        *value = v.i16;
        break;
    case PLY_U16:
        *value = v.u16;
        break;
    case PLY_I32:
        *value = v.i32;
        break;
    case PLY_U32:
        *value = v.u32;
        break;
    case PLY_F32:
        *value = (double)v.f32;
        break;
    default:
        *value = v.f64;
        break;
    }
    return true;
}

static bool push_triangle(ply_file *f, uint32_t a, uint32_t b, uint32_t c)
{
    if (f->index_count + 3 > f->index_capacity) {
        uint64_t capacity = f->index_capacity ? f->index_capacity * 2 : 96;
        uint32_t *grown =
            capacity > 3 * TR_MESH_MAX ? NULL : realloc(f->shape->indices, (size_t)capacity * sizeof *grown);
        if (!grown)
            return fail(f, "out of memory for the PLY file's faces");
        f->shape->indices = grown;
        f->index_capacity = capacity;
    }
    uint32_t *out = f->shape->indices + f->index_count;
    out[0] = a;
    out[1] = b;
    out[2] = c;
    f->index_count += 3;
    return true;
}

/* A list property; polygons become fans. */
static bool read_list(ply_file *f, const ply_property *p)
{
    double count = 0, value = 0;
    uint32_t first = 0, last = 0;
    if (!read_number(f, p->count_type, &count))
        return false;
    if (!(count >= 0 && count <= (double)(f->end - f->at)))
        return fail(f, "a list in the PLY file is longer than the file");
    for (uint64_t i = 0; i < (uint64_t)count; ++i) {
        if (!read_number(f, p->type, &value))
            return false;
        if (p->use != USE_INDICES)
            continue;
        if (!(value >= 0 && value < (double)f->shape->vertex_count))
            return fail(f, "a face of the PLY file names a vertex that does not exist");
        uint32_t id = (uint32_t)value;
        if (i >= 2 && !push_triangle(f, first, last, id))
            return false;
        first = i == 0 ? id : first;
        last = id;
    }
    return true;
}

static bool uses(const ply_element *e, ply_use use)
{
    for (int i = 0; i < e->property_count; ++i)
        if (e->properties[i].use == use)
            return true;
    return false;
}

static void store(tr_shape *s, uint64_t row, ply_use use, float value)
{
    if (use >= USE_X && use <= USE_Z)
        s->positions[3 * row + (uint64_t)(use - USE_X)] = value;
    else if (use >= USE_NX && use <= USE_NZ && s->normals)
        s->normals[3 * row + (uint64_t)(use - USE_NX)] = value;
    else if ((use == USE_U || use == USE_V) && s->uvs)
        s->uvs[2 * row + (uint64_t)(use - USE_U)] = value;
}

static bool read_element(ply_file *f, const ply_element *e)
{
    bool vertices = strcmp(e->name, "vertex") == 0, faces = strcmp(e->name, "face") == 0;
    if (strcmp(e->name, "tristrips") == 0 && e->count)
        return fail(f, "PLY triangle strips are not supported");
    if (vertices) {
        if (f->shape->positions || !uses(e, USE_X) || !uses(e, USE_Y) || !uses(e, USE_Z))
            return fail(f, "the PLY file's vertices have no x, y and z, or come twice");
        bool normals = uses(e, USE_NX) && uses(e, USE_NY) && uses(e, USE_NZ), uvs = uses(e, USE_U) && uses(e, USE_V);
        if (!tr_mesh_alloc(f->shape, e->count, 0, normals, uvs))
            return fail(f, "out of memory for the PLY file's vertices");
    }
    for (uint64_t row = 0; e->property_count && row < e->count; ++row)
        for (int i = 0; i < e->property_count; ++i) {
            const ply_property *p = &e->properties[i];
            double value = 0;
            bool ok = true;
            if (p->count_type) {
                ply_property skip = *p;
                skip.use = faces ? p->use : USE_NOTHING;
                ok = read_list(f, &skip);
            } else
                ok = read_number(f, p->type, &value);
            if (!ok)
                return false;
            if (vertices && p->use)
                store(f->shape, row, p->use, (float)value);
        }
    return true;
}

bool tr_ply_read(tr_shape *shape, const unsigned char *data, size_t size, char *err, size_t err_size)
{
    ply_file *f = calloc(1, sizeof *f);
    if (!f) {
        snprintf(err, err_size, "out of memory");
        return false;
    }
    f->at = data;
    f->end = data + size;
    f->shape = shape;
    f->err = err;
    f->err_size = err_size;
    bool ok = read_header(f);
    for (int i = 0; ok && i < f->element_count; ++i)
        ok = read_element(f, &f->elements[i]);
    if (ok && !shape->positions)
        ok = fail(f, "the PLY file has no vertices");
    shape->triangle_count = ok ? (uint32_t)(f->index_count / 3) : 0;
    free(f);
    return ok;
}
