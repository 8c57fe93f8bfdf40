/* shape.c: the shapes: builders, Embree geometry, and surface points.

   contents: >>transform >>builders >>measure >>embree >>surface

   Rectangle and cube are baked into meshes. Sphere, disk and cylinder are Embree user geometry, intersected in double
   precision; the point found is then put back onto the shape in object space, so that p is exact to float rounding. */
#include "scene_internal.h"

#include <stdlib.h>
#include <string.h>

/* ---- >>transform -------------------------------------------------------------------------------------------- */

mat4 mat4_rotate(vec3 axis, float degrees)
{
    vec3 a = norm3(axis);
    double r = (double)degrees * (3.14159265358979323846 / 180.0), s = sin(r), c = cos(r);
    double x = a.x, y = a.y, z = a.z, k = 1 - c;
    double m[3][3] = {{x * x * k + c, x * y * k - z * s, x * z * k + y * s},
                      {y * x * k + z * s, y * y * k + c, y * z * k - x * s},
                      {z * x * k - y * s, z * y * k + x * s, z * z * k + c}};
    mat4 out = mat4_identity();
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out.m[i][j] = (float)m[i][j];
    return out;
}

bool mat4_lookat(vec3 origin, vec3 target, vec3 up, mat4 *out)
{
    vec3 d = sub3(target, origin), left = cross3(up, d);
    if (!(dot3(d, d) > 0) || !(dot3(left, left) > 1e-12f * dot3(up, up) * dot3(d, d)))
        return false;
    d = norm3(d);
    left = norm3(left);
    *out = mat4_columns(left, cross3(d, left), d, origin);
    return true;
}

bool mat4_inverse(const mat4 *a, mat4 *out)
{
    double m[4][8];
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) {
            m[i][j] = a->m[i][j];
            m[i][j + 4] = i == j;
        }
    *out = mat4_identity();
    for (int c = 0; c < 4; ++c) {
        int best = c;
        for (int r = c + 1; r < 4; ++r)
            if (fabs(m[r][c]) > fabs(m[best][c]))
                best = r;
        if (!(fabs(m[best][c]) > 1e-30) || !isfinite(m[best][c]))
            return false;
        for (int j = 0; j < 8; ++j) {
            double t = m[c][j];
            m[c][j] = m[best][j];
            m[best][j] = t;
        }
        double inv = 1 / m[c][c];
        for (int j = 0; j < 8; ++j)
            m[c][j] *= inv;
        for (int r = 0; r < 4; ++r) {
            double f = r == c ? 0 : m[r][c];
            for (int j = 0; j < 8; ++j)
                m[r][j] -= f * m[c][j];
        }
    }
    mat4 result;
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) {
            result.m[i][j] = (float)m[i][j + 4];
            if (!isfinite(result.m[i][j]))
                return false;
        }
    *out = result;
    return true;
}

/* ---- >>builders --------------------------------------------------------------------------------------------- */

static void set3(float *p, vec3 v)
{
    p[0] = v.x;
    p[1] = v.y;
    p[2] = v.z;
}
static vec3 get3(const float *p) { return v3(p[0], p[1], p[2]); }

static void set_quad(tr_shape *s, int quad, vec3 center, vec3 du, vec3 dv)
{
    static const float corner[4][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}};
    static const uint32_t order[6] = {0, 1, 2, 2, 3, 0};
    for (int i = 0; i < 4; ++i) {
        set3(s->positions + 3 * (4 * quad + i), madd3(madd3(center, du, corner[i][0]), dv, corner[i][1]));
        s->uvs[2 * (4 * quad + i)] = (corner[i][0] + 1) / 2;
        s->uvs[2 * (4 * quad + i) + 1] = (corner[i][1] + 1) / 2;
    }
    for (uint32_t i = 0; i < 6; ++i)
        s->indices[6 * quad + (int)i] = 4 * (uint32_t)quad + order[i];
}

/* Flat shapes keep the side that Mitsuba's transformed normal points to: a mirror must not turn them inside out. */
static void bake_flat(tr_shape *s, const mat4 *to_world)
{
    tr_mesh_transform(s, to_world);
    if (mat4_det3(to_world) < 0)
        for (uint32_t t = 0; t < s->triangle_count; ++t) {
            uint32_t swap = s->indices[3 * t + 1];
            s->indices[3 * t + 1] = s->indices[3 * t + 2];
            s->indices[3 * t + 2] = swap;
        }
}

bool tr_shape_rectangle(tr_shape *shape, const mat4 *to_world)
{
    shape->type = TR_SHAPE_MESH;
    if (!tr_mesh_alloc(shape, 4, 2, false, true))
        return false;
    set_quad(shape, 0, v3(0, 0, 0), v3(1, 0, 0), v3(0, 1, 0));
    bake_flat(shape, to_world);
    return true;
}

bool tr_shape_cube(tr_shape *shape, const mat4 *to_world)
{
    shape->type = TR_SHAPE_MESH;
    if (!tr_mesh_alloc(shape, 24, 12, false, true))
        return false;
    static const float axes[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int f = 0; f < 6; ++f) {
        float sign = f % 2 ? 1.0f : -1.0f;
        vec3 n = scale3(get3(axes[f / 2]), sign), u = get3(axes[(f / 2 + 1) % 3]), v = cross3(n, u);
        set_quad(shape, f, n, u, v);
    }
    bake_flat(shape, to_world);
    return true;
}

/* A grid of (columns x rows) quads over (u, v) in [0,1]^2 as smooth mesh: the unit sphere or cylinder. */
static bool tessellate(tr_shape *s, const mat4 *object_to_world, bool sphere)
{
    const int columns = 96, rows = sphere ? 48 : 1;
    s->type = TR_SHAPE_MESH;
    if (!tr_mesh_alloc(s, (uint64_t)(columns + 1) * (uint64_t)(rows + 1), 2 * (uint64_t)columns * (uint64_t)rows, true,
                       true))
        return false;
    for (int j = 0; j <= rows; ++j)
        for (int i = 0; i <= columns; ++i) {
            int k = j * (columns + 1) + i;
            float u = (float)i / (float)columns, v = (float)j / (float)rows, phi = 2 * TR_PI * u, theta = TR_PI * v;
            float st = sphere ? sinf(theta) : 1;
            vec3 n = v3(st * cosf(phi), st * sinf(phi), sphere ? cosf(theta) : 0);
            set3(s->normals + 3 * k, n);
            set3(s->positions + 3 * k, sphere ? n : v3(n.x, n.y, v));
            s->uvs[2 * k] = u;
            s->uvs[2 * k + 1] = v;
        }
    uint32_t *out = s->indices;
    for (int j = 0; j < rows; ++j)
        for (int i = 0; i < columns; ++i) {
            uint32_t a = (uint32_t)(j * (columns + 1) + i), b = a + 1, c = a + (uint32_t)columns + 1, d = c + 1;
            uint32_t quad[6] = {a, c, b, b, c, d};
            memcpy(out, quad, sizeof quad);
            out += 6;
        }
    tr_mesh_transform(s, object_to_world);
    tr_mesh_align_winding(s);
    return true;
}

/* Columns a and b of m are perpendicular, and (same) of one length. */
static bool columns_fit(const mat4 *m, int a, int b, bool same)
{
    vec3 x = mat4_column(m, a), y = mat4_column(m, b);
    float xx = dot3(x, x), yy = dot3(y, y), limit = 1e-4f;
    return fabsf(dot3(x, y)) <= limit * sqrtf(xx * yy) && (!same || fabsf(xx - yy) <= 2 * limit * fmaxf(xx, yy));
}

static mat4 sphere_matrix(vec3 center, float radius)
{
    return mat4_columns(v3(radius, 0, 0), v3(0, radius, 0), v3(0, 0, radius), center);
}

bool tr_shape_sphere(tr_shape *shape, const mat4 *to_world, vec3 center, float radius, bool *tessellated)
{
    mat4 local = sphere_matrix(center, radius), m = mat4_mul(to_world, &local);
    *tessellated = false;
    shape->object_to_world = m;
    if (mat4_inverse(&m, &shape->world_to_object) && columns_fit(&m, 0, 1, true) && columns_fit(&m, 1, 2, true) &&
        columns_fit(&m, 0, 2, true)) {
        shape->type = TR_SHAPE_SPHERE;
        return tr_shape_complete(shape);
    }
    *tessellated = true;
    return tessellate(shape, &m, true);
}

bool tr_shape_disk(tr_shape *shape, const mat4 *to_world)
{
    shape->type = TR_SHAPE_DISK;
    shape->object_to_world = *to_world;
    if (tr_shape_complete(shape))
        return true;
    /* Flattened to nothing: an empty mesh, which draws a warning later. */
    shape->type = TR_SHAPE_MESH;
    return tr_mesh_alloc(shape, 0, 0, false, false);
}

bool tr_shape_cylinder(tr_shape *shape, const mat4 *to_world, vec3 p0, vec3 p1, float radius, bool *tessellated)
{
    vec3 axis = sub3(p1, p0);
    frame3 f = frame_from_normal(norm3(axis));
    mat4 local = mat4_columns(scale3(f.s, radius), scale3(f.t, radius), axis, p0), m = mat4_mul(to_world, &local);
    *tessellated = false;
    shape->object_to_world = m;
    if (mat4_inverse(&m, &shape->world_to_object) && columns_fit(&m, 0, 1, true) && columns_fit(&m, 0, 2, false) &&
        columns_fit(&m, 1, 2, false)) {
        shape->type = TR_SHAPE_CYLINDER;
        return tr_shape_complete(shape);
    }
    *tessellated = true;
    return tessellate(shape, &m, false);
}

/* ---- >>measure ---------------------------------------------------------------------------------------------- */

static bool is_zero(const mat4 *a)
{
    for (int i = 0; i < 16; ++i)
        if (a->m[i / 4][i % 4] != 0)
            return false;
    return true;
}

bool tr_shape_complete(tr_shape *s)
{
    if (s->type == TR_SHAPE_MESH)
        return true;
    if (s->type == TR_SHAPE_SPHERE && is_zero(&s->object_to_world))
        s->object_to_world = sphere_matrix(s->center, s->radius);
    if (!mat4_inverse(&s->object_to_world, &s->world_to_object))
        return false;
    if (s->type == TR_SHAPE_SPHERE) {
        s->center = mat4_column(&s->object_to_world, 3);
        s->radius = cbrtf(fabsf(mat4_det3(&s->object_to_world)));
        return s->radius > 0 && isfinite(s->radius);
    }
    return true;
}

static vec3 vertex(const tr_shape *s, uint32_t triangle, int corner)
{
    return get3(s->positions + 3 * (size_t)s->indices[3 * (size_t)triangle + (size_t)corner]);
}
static vec3 triangle_cross(const tr_shape *s, uint32_t t)
{
    vec3 p0 = vertex(s, t, 0);
    return cross3(sub3(vertex(s, t, 1), p0), sub3(vertex(s, t, 2), p0));
}

/* Room for area_cdf, still to be filled, and the emitters behind it. */
static bool make_emitters(tr_shape *s)
{
    size_t n = s->triangle_count;
    s->area_cdf = malloc((n + 1) * sizeof *s->area_cdf + n * sizeof *s->emitters);
    if (!s->area_cdf)
        return false;
    tr_emitter *e = (tr_emitter *)(s->area_cdf + n + 1);
    s->emitters = e;
    for (uint32_t t = 0; t < s->triangle_count; ++t) {
        e[t].p = vertex(s, t, 0);
        e[t].e1 = sub3(vertex(s, t, 1), e[t].p);
        e[t].e2 = sub3(vertex(s, t, 2), e[t].p);
        e[t].n = norm3(triangle_cross(s, t));
        if (s->flip_normals)
            e[t].n = neg3(e[t].n);
    }
    return true;
}

bool tr_shape_measure(tr_shape *s, bool with_cdf)
{
    vec3 x = mat4_column(&s->object_to_world, 0), y = mat4_column(&s->object_to_world, 1);
    double sum = 0;
    if (s->type == TR_SHAPE_SPHERE)
        sum = 4.0 * (double)TR_PI * s->radius * s->radius;
    else if (s->type == TR_SHAPE_DISK)
        sum = (double)TR_PI * len3(cross3(x, y));
    else if (s->type == TR_SHAPE_CYLINDER)
        sum = 2.0 * (double)TR_PI * len3(x) * len3(mat4_column(&s->object_to_world, 2));
    else {
        free(s->area_cdf);
        s->area_cdf = NULL;
        s->emitters = NULL;
        if (with_cdf && !make_emitters(s))
            return false;
        for (uint32_t t = 0; t < s->triangle_count; ++t)
            sum += 0.5 * (double)len3(triangle_cross(s, t));
        double run = 0;
        for (uint32_t t = 0; with_cdf && t < s->triangle_count; ++t) {
            s->area_cdf[t] = sum > 0 ? (float)(run / sum) : 0;
            run += 0.5 * (double)len3(triangle_cross(s, t));
        }
        if (with_cdf)
            s->area_cdf[s->triangle_count] = 1;
    }
    s->area = (float)sum;
    return true;
}

static void grow(vec3 *lo, vec3 *hi, vec3 p)
{
    *lo = v3(fminf(lo->x, p.x), fminf(lo->y, p.y), fminf(lo->z, p.z));
    *hi = v3(fmaxf(hi->x, p.x), fmaxf(hi->y, p.y), fmaxf(hi->z, p.z));
}

void tr_shape_bounds(const tr_shape *s, vec3 *lo, vec3 *hi)
{
    *lo = v3s(INFINITY);
    *hi = v3s(-INFINITY);
    if (s->type == TR_SHAPE_MESH) {
        for (uint32_t t = 0; t < s->triangle_count; ++t)
            for (int c = 0; c < 3; ++c)
                grow(lo, hi, vertex(s, t, c));
        return;
    }
    const mat4 *m = &s->object_to_world;
    vec3 x = mat4_column(m, 0), y = mat4_column(m, 1), z = mat4_column(m, 2), o = mat4_column(m, 3);
    /* Half extents: of a circle the length of its two axes' rows, of the sphere its radius. */
    vec3 half = v3(hypotf(x.x, y.x), hypotf(x.y, y.y), hypotf(x.z, y.z));
    if (s->type == TR_SHAPE_SPHERE)
        half = v3s(s->radius);
    grow(lo, hi, sub3(o, half));
    grow(lo, hi, add3(o, half));
    if (s->type == TR_SHAPE_CYLINDER) {
        grow(lo, hi, sub3(add3(o, z), half));
        grow(lo, hi, add3(add3(o, z), half));
    }
}

/* ---- >>embree ----------------------------------------------------------------------------------------------- */

static void user_bounds(const struct RTCBoundsFunctionArguments *args)
{
    const tr_shape *s = args->geometryUserPtr;
    vec3 lo, hi;
    tr_shape_bounds(s, &lo, &hi);
    float pad = 1e-5f * (max3(sub3(hi, lo)) + fmaxf(max3(hi), max3(neg3(lo)))) + 1e-30f;
    struct RTCBounds *b = args->bounds_o;
    b->lower_x = lo.x - pad;
    b->lower_y = lo.y - pad;
    b->lower_z = lo.z - pad;
    b->upper_x = hi.x + pad;
    b->upper_y = hi.y + pad;
    b->upper_z = hi.z + pad;
}

/* A ray in object space; t keeps its world scale. */
typedef struct dray {
    double o[3], d[3], near, far;
} dray;

static dray object_ray(const tr_shape *s, const float o[3], const float d[3], float near, float far)
{
    dray r = {{0}, {0}, (double)near, (double)far};
    const float(*m)[4] = (const float(*)[4])s->world_to_object.m;
    for (int i = 0; i < 3; ++i) {
        r.o[i] = (double)m[i][3];
        for (int j = 0; j < 3; ++j) {
            r.o[i] += (double)m[i][j] * (double)o[j];
            r.d[i] += (double)m[i][j] * (double)d[j];
        }
    }
    return r;
}

/* Roots of |o + t d| = 1 over the first n axes, about the point of closest approach, where nothing cancels. */
static bool unit_roots(const dray *r, int n, double t[2])
{
    double a = 0, b = 0, h = 0;
    for (int i = 0; i < n; ++i) {
        a += r->d[i] * r->d[i];
        b += r->d[i] * r->o[i];
    }
    if (!(a > 0))
        return false;
    double mid = -b / a;
    for (int i = 0; i < n; ++i) {
        double q = r->o[i] + mid * r->d[i];
        h += q * q;
    }
    if (!(h <= 1))
        return false;
    double w = sqrt((1 - h) / a);
    t[0] = mid - w;
    t[1] = mid + w;
    return true;
}

/* Nearest hit within (near, far); false = none. */
static bool user_hit(const tr_shape *s, const dray *r, double *hit)
{
    double t[2];
    if (s->type == TR_SHAPE_DISK) {
        double at = -r->o[2] / r->d[2], x = r->o[0] + at * r->d[0], y = r->o[1] + at * r->d[1];
        *hit = at;
        return at > r->near && at < r->far && x * x + y * y <= 1;
    }
    bool cylinder = s->type == TR_SHAPE_CYLINDER;
    if (!unit_roots(r, cylinder ? 2 : 3, t))
        return false;
    for (int i = 0; i < 2; ++i) {
        double z = r->o[2] + t[i] * r->d[2];
        if (t[i] > r->near && t[i] < r->far && (!cylinder || (z >= 0 && z <= 1))) {
            *hit = t[i];
            return true;
        }
    }
    return false;
}

/* Embree's packets are arrays of field k for n rays (its own accessors are C++ only). */
enum { RAY_ORG = 0, RAY_NEAR = 3, RAY_DIR = 4, RAY_FAR = 8, RAY_FIELDS = 12, HIT_NG = 0, HIT_U = 3, HIT_PRIM = 5 };
enum { HIT_GEOM = 6, HIT_INST = 7 };

static bool user_trace(const tr_shape *s, const float *ray, unsigned n, double *t)
{
    const float o[3] = {ray[RAY_ORG * n], ray[(RAY_ORG + 1) * n], ray[(RAY_ORG + 2) * n]};
    const float d[3] = {ray[RAY_DIR * n], ray[(RAY_DIR + 1) * n], ray[(RAY_DIR + 2) * n]};
    dray r = object_ray(s, o, d, ray[RAY_NEAR * n], ray[RAY_FAR * n]);
    return user_hit(s, &r, t);
}

static void user_intersect(const struct RTCIntersectFunctionNArguments *args)
{
    unsigned n = args->N;
    for (unsigned i = 0; i < n; ++i) {
        float *ray = (float *)args->rayhit + i, *hit = ray + RAY_FIELDS * n;
        uint32_t *ids = (uint32_t *)args->rayhit + i + RAY_FIELDS * n;
        double t;
        if (!args->valid[i] || !user_trace(args->geometryUserPtr, ray, n, &t))
            continue;
        ray[RAY_FAR * n] = (float)t;
        hit[HIT_NG * n] = hit[(HIT_NG + 1) * n] = 0;
        hit[(HIT_NG + 2) * n] = 1;
        hit[HIT_U * n] = hit[(HIT_U + 1) * n] = 0;
        ids[HIT_PRIM * n] = args->primID;
        ids[HIT_GEOM * n] = args->geomID;
        ids[HIT_INST * n] = args->context->instID[0];
    }
}

static void user_occluded(const struct RTCOccludedFunctionNArguments *args)
{
    for (unsigned i = 0; i < args->N; ++i) {
        float *ray = (float *)args->ray + i;
        double t;
        if (args->valid[i] && user_trace(args->geometryUserPtr, ray, args->N, &t))
            ray[RAY_FAR * args->N] = -INFINITY;
    }
}

bool tr_shape_attach(tr_shape *s, RTCDevice device, RTCScene rtc, unsigned id)
{
    bool mesh = s->type == TR_SHAPE_MESH;
    if (mesh && s->triangle_count == 0)
        return true;
    RTCGeometry g = rtcNewGeometry(device, mesh ? RTC_GEOMETRY_TYPE_TRIANGLE : RTC_GEOMETRY_TYPE_USER);
    if (!g)
        return false;
    if (mesh) {
        rtcSetSharedGeometryBuffer(g, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, s->positions, 0, 3 * sizeof(float),
                                   s->vertex_count);
        rtcSetSharedGeometryBuffer(g, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, s->indices, 0, 3 * sizeof(uint32_t),
                                   s->triangle_count);
    } else {
        rtcSetGeometryUserPrimitiveCount(g, 1);
        rtcSetGeometryUserData(g, s);
        rtcSetGeometryBoundsFunction(g, user_bounds, NULL);
        rtcSetGeometryIntersectFunction(g, user_intersect);
        rtcSetGeometryOccludedFunction(g, user_occluded);
    }
    rtcSetGeometryBuildQuality(g, RTC_BUILD_QUALITY_HIGH);
    rtcCommitGeometry(g);
    rtcAttachGeometryByID(rtc, g, id);
    rtcReleaseGeometry(g);
    return rtcGetDeviceError(device) == RTC_ERROR_NONE;
}

/* ---- >>surface ---------------------------------------------------------------------------------------------- */

/* dpdu and dpdv from uv differences (a linear solve), else any frame around ng. */
static void mesh_tangents(const tr_shape *s, tr_surface *out)
{
    if (s->uvs) {
        const uint32_t *id = s->indices + 3 * (size_t)out->prim;
        const float *a = s->uvs + 2 * (size_t)id[0], *b = s->uvs + 2 * (size_t)id[1], *c = s->uvs + 2 * (size_t)id[2];
        float du1 = b[0] - a[0], dv1 = b[1] - a[1], du2 = c[0] - a[0], dv2 = c[1] - a[1];
        float det = du1 * dv2 - dv1 * du2;
        vec3 p0 = vertex(s, out->prim, 0), e1 = sub3(vertex(s, out->prim, 1), p0),
             e2 = sub3(vertex(s, out->prim, 2), p0);
        if (fabsf(det) > 1e-20f) {
            out->dpdu = scale3(sub3(scale3(e1, dv2), scale3(e2, dv1)), 1 / det);
            out->dpdv = scale3(sub3(scale3(e2, du1), scale3(e1, du2)), 1 / det);
            if (dot3(out->dpdu, out->dpdu) > 0 && finite3(out->dpdu) && finite3(out->dpdv))
                return;
        }
    }
    frame3 f = frame_from_normal(out->ng);
    out->dpdu = f.s;
    out->dpdv = f.t;
}

static inline void mesh_surface(const tr_shape *s, uint32_t t, float b1, float b2, tr_surface *out)
{
    const uint32_t *id = s->indices + 3 * (size_t)t;
    const float *a = s->packed + TR_PACKED * (size_t)id[0], *b = s->packed + TR_PACKED * (size_t)id[1],
                *c = s->packed + TR_PACKED * (size_t)id[2];
    float e1[TR_PACKED], e2[TR_PACKED], at[TR_PACKED];
    for (int i = 0; i < TR_PACKED; ++i) {
        e1[i] = b[i] - a[i];
        e2[i] = c[i] - a[i];
        at[i] = a[i] + e1[i] * b1 + e2[i] * b2;
    }
    out->p = get3(at);
    out->ng = out->ns = norm3(cross3(get3(e1), get3(e2)));
    out->u = s->uvs ? at[3] : b1;
    out->v = s->uvs ? at[4] : b2;
    if (!s->normals)
        return;
    vec3 ns = get3(at + 5);
    float l2 = dot3(ns, ns);
    if (!(l2 > 1e-20f) || !isfinite(l2))
        return;
    out->ns = scale3(ns, 1 / sqrtf(l2));
    /* Triangles were wound to agree with their normals, but an interpolated normal can still lean over. Mitsuba then
       turns the geometric normal; on lights it stays, so that sampling and hits name the same front. */
    if (dot3(out->ns, out->ng) < 0) {
        if (s->light >= 0)
            out->ns = out->ng;
        else
            out->ng = neg3(out->ng);
    }
}

static void analytic_surface(const tr_shape *s, const struct RTCRay *ray, tr_surface *out)
{
    const mat4 *m = &s->object_to_world;
    const float o[3] = {ray->org_x, ray->org_y, ray->org_z}, d[3] = {ray->dir_x, ray->dir_y, ray->dir_z};
    dray r = object_ray(s, o, d, 0, 0);
    double q[3], l2 = 0;
    for (int i = 0; i < 3; ++i)
        q[i] = r.o[i] + (double)ray->tfar * r.d[i];
    int round_axes = s->type == TR_SHAPE_SPHERE ? 3 : 2;
    for (int i = 0; i < round_axes; ++i)
        l2 += q[i] * q[i];
    if (s->type == TR_SHAPE_DISK)
        q[2] = 0;
    else if (l2 > 0)
        for (int i = 0; i < round_axes; ++i)
            q[i] /= sqrt(l2);
    vec3 l = v3((float)q[0], (float)q[1], (float)q[2]), du, dv, n;
    float phi = atan2f(l.y, l.x), rho = hypotf(l.x, l.y);
    phi = phi < 0 ? phi + 2 * TR_PI : phi;
    float cp = rho > 0 ? l.x / rho : 1, sp = rho > 0 ? l.y / rho : 0;
    out->u = phi / (2 * TR_PI);
    du = v3(-l.y * 2 * TR_PI, l.x * 2 * TR_PI, 0);
    if (s->type == TR_SHAPE_SPHERE) {
        out->v = atan2f(rho, l.z) * TR_INV_PI;
        dv = scale3(v3(l.z * cp, l.z * sp, -rho), TR_PI);
        n = l;
    } else if (s->type == TR_SHAPE_CYLINDER) {
        out->v = l.z;
        dv = v3(0, 0, 1);
        n = v3(l.x, l.y, 0);
    } else { /* disk: u is the radius, v the angle */
        out->v = out->u;
        out->u = rho;
        dv = du;
        du = v3(cp, sp, 0);
        n = v3(0, 0, 1);
    }
    out->p = xform_point(m, l);
    out->ng = out->ns = norm3(xform_normal(&s->world_to_object, n));
    out->dpdu = xform_vector(m, du);
    out->dpdv = xform_vector(m, dv);
    if (!(dot3(out->dpdu, out->dpdu) > 0) || !(dot3(out->dpdv, out->dpdv) > 0)) { /* a pole, the disk's centre */
        frame3 f = frame_from_normal(out->ng);
        out->dpdu = f.s;
        out->dpdv = f.t;
    }
}

void tr_surface_prefetch(const tr_scene *scene, const struct RTCRayHit *hit, int stage)
{
    if (hit->hit.geomID == RTC_INVALID_GEOMETRY_ID)
        return;
    const tr_shape *s = &scene->shapes[hit->hit.geomID];
    if (s->type != TR_SHAPE_MESH)
        return;
    const uint32_t *id = s->indices + 3 * (size_t)hit->hit.primID;
    if (stage == 0) {
        TR_PREFETCH(id);
        return;
    }
    for (int i = 0; i < 3; ++i)
        TR_PREFETCH(s->packed + TR_PACKED * (size_t)id[i]);
}

static inline void surface_from_hit(const tr_shape *s, const struct RTCRayHit *hit, bool tangents, tr_surface *surface)
{
    surface->shape = (int)hit->hit.geomID;
    surface->prim = hit->hit.primID;
    surface->t = hit->ray.tfar;
    if (s->type == TR_SHAPE_MESH) {
        mesh_surface(s, hit->hit.primID, hit->hit.u, hit->hit.v, surface);
        if (tangents)
            mesh_tangents(s, surface);
    } else {
        analytic_surface(s, &hit->ray, surface);
    }
    if (s->flip_normals) {
        surface->ng = neg3(surface->ng);
        surface->ns = neg3(surface->ns);
    }
}

void tr_surface_from_hit(const tr_scene *scene, const struct RTCRayHit *hit, tr_surface *surface)
{
    surface_from_hit(&scene->shapes[hit->hit.geomID], hit, true, surface);
}

void tr_surface_from_hit_lean(const tr_scene *scene, const struct RTCRayHit *hit, tr_surface *surface)
{
    const tr_shape *s = &scene->shapes[hit->hit.geomID];
    surface_from_hit(s, hit, s->bsdf >= 0 && scene->bsdfs[s->bsdf].bumped, surface);
}
