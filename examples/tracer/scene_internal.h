/* scene_internal.h: what the scene's own files share: transforms, shape builders, loaders.

   contents: >>transform >>memory >>shape >>mesh >>colour >>load */
#ifndef TR_SCENE_INTERNAL_H
#define TR_SCENE_INTERNAL_H

#include "tracer.h"

/* ---- >>transform -------------------------------------------------------------------------------------------- */

static inline mat4 mat4_identity(void)
{
    mat4 r = {{{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}}};
    return r;
}
static inline mat4 mat4_mul(const mat4 *a, const mat4 *b)
{
    mat4 r;
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) {
            double s = 0;
            for (int k = 0; k < 4; ++k)
                s += (double)a->m[i][k] * b->m[k][j];
            r.m[i][j] = (float)s;
        }
    return r;
}
static inline mat4 mat4_translate(vec3 t)
{
    mat4 r = mat4_identity();
    r.m[0][3] = t.x;
    r.m[1][3] = t.y;
    r.m[2][3] = t.z;
    return r;
}
static inline mat4 mat4_scale(vec3 s)
{
    mat4 r = mat4_identity();
    r.m[0][0] = s.x;
    r.m[1][1] = s.y;
    r.m[2][2] = s.z;
    return r;
}
/* Columns x, y, z and origin. */
static inline mat4 mat4_columns(vec3 x, vec3 y, vec3 z, vec3 o)
{
    mat4 r = {{{x.x, y.x, z.x, o.x}, {x.y, y.y, z.y, o.y}, {x.z, y.z, z.z, o.z}, {0, 0, 0, 1}}};
    return r;
}
static inline vec3 mat4_column(const mat4 *a, int c) { return v3(a->m[0][c], a->m[1][c], a->m[2][c]); }
/* Determinant of the upper left 3x3: its sign tells whether the transform mirrors. */
static inline float mat4_det3(const mat4 *a)
{
    return dot3(mat4_column(a, 0), cross3(mat4_column(a, 1), mat4_column(a, 2)));
}
mat4 mat4_rotate(vec3 axis, float degrees);
/* Mitsuba's: looks from origin along +z to target, +x to the left. False where the vectors are degenerate. */
bool mat4_lookat(vec3 origin, vec3 target, vec3 up, mat4 *out);
bool mat4_inverse(const mat4 *a, mat4 *out); /* false = singular or not finite; out is then the identity */

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

char *tr_string_copy(const char *s); /* NULL = out of memory (or s is NULL) */

/* ---- >>shape ------------------------------------------------------------------------------------------------ */

/* Each fills a shape that tr_scene_add_shape made and returns false when out of memory. Where the transform leaves the
   analytic form (a sphere scaled to an ellipsoid), the shape is tessellated and *tessellated is set. */
bool tr_shape_rectangle(tr_shape *shape, const mat4 *to_world);
bool tr_shape_cube(tr_shape *shape, const mat4 *to_world);
bool tr_shape_sphere(tr_shape *shape, const mat4 *to_world, vec3 center, float radius, bool *tessellated);
bool tr_shape_disk(tr_shape *shape, const mat4 *to_world);
bool tr_shape_cylinder(tr_shape *shape, const mat4 *to_world, vec3 p0, vec3 p1, float radius, bool *tessellated);

bool tr_shape_complete(tr_shape *shape); /* analytic: fill the fields that follow from the others; false = singular */
bool tr_shape_measure(tr_shape *shape, bool with_cdf); /* area, and area_cdf for lights; false = out of memory */
void tr_shape_bounds(const tr_shape *shape, vec3 *lo, vec3 *hi);
/* Add the shape to Embree's scene under geomID id; false = Embree refused. */
bool tr_shape_attach(tr_shape *shape, RTCDevice device, RTCScene rtc, unsigned id);

/* ---- >>mesh ------------------------------------------------------------------------------------------------- */

/* Zeroed arrays of a mesh. Counts above TR_MESH_MAX are refused. */
bool tr_mesh_alloc(tr_shape *shape, uint64_t vertices, uint64_t triangles, bool normals, bool uvs);
void tr_mesh_free(tr_shape *shape);
void tr_mesh_transform(tr_shape *shape, const mat4 *to_world);
/* Vertex normals weighted by the angle of each triangle's corner (Thuermer and Wuethrich 1998). */
bool tr_mesh_smooth_normals(tr_shape *shape);
/* Turn each triangle so that its winding agrees with its vertex normals. */
void tr_mesh_align_winding(tr_shape *shape);
bool tr_mesh_pack(tr_shape *shape); /* fill `packed`; false = out of memory */
bool tr_mesh_indices_valid(const tr_shape *shape);
#define TR_MESH_MAX (UINT64_C(1) << 29)

typedef enum tr_mesh_format { TR_MESH_PLY, TR_MESH_OBJ, TR_MESH_SERIALIZED } tr_mesh_format;

typedef struct tr_mesh_options {
    tr_mesh_format format;
    mat4 to_world;
    bool face_normals; /* drop the file's normals and compute none */
    bool flip_v;
    int shape_index; /* .serialized */
} tr_mesh_options;

/* Read a file into an empty shape; on failure a one-line reason goes to err. Safe against broken files. */
bool tr_mesh_load(tr_shape *shape, const char *path, const tr_mesh_options *options, char *err, size_t err_size);
bool tr_ply_read(tr_shape *shape, const unsigned char *data, size_t size, char *err, size_t err_size);
/* Run call(context) in a child process; false = it crashed or took minutes there. */
bool tr_survives(void (*call)(void *), void *context);
/* The whole file in memory with a 0 byte after it; NULL = could not read (reason in err and errno: ENOENT only where
   there is none). */
unsigned char *tr_file_read(const char *path, size_t *size, char *err, size_t err_size);

/* ---- >>colour ----------------------------------------------------------------------------------------------- */

/* A spectrum given at rising wavelengths (nm), linear in between and zero outside, to linear sRGB through Wyman et al.
   2013. emission: its true colour, luminance = mean of the spectrum under the y curve; else a reflectance, for which
   the constant 1 is (1, 1, 1). */
vec3 tr_spectrum_rgb(const float *wavelengths, const float *values, int count, bool emission);
vec3 tr_blackbody_rgb(float kelvin); /* Planck, W/m^2/sr/nm */
/* Complex index of refraction of a metal by its symbol ("Au") from its colour (Gulbrandsen 2014). False = unknown. */
bool tr_metal(const char *name, vec3 *eta, vec3 *k);
bool tr_ior(const char *name, float *ior); /* "bk7", "water", ... */
float tr_srgb_decode(float x);

/* ---- >>load ------------------------------------------------------------------------------------------------- */

bool tr_xml_load(tr_scene *scene, const char *path, const tr_define *defines, int define_count, tr_log *log);
bool tr_gltf_load(tr_scene *scene, const char *path, tr_log *log);
/* Place the camera so that it sees all shapes. */
void tr_scene_frame(tr_scene *scene);
/* `name` beside the file `base`; absolute names stay. NULL = out of memory. */
char *tr_path_beside(const char *base, const char *name);

#endif
