/* A complete path tracer with and without guiding: a room that gets its light through a door that is ajar.
   cc -O2 -I. examples/sdtree.c -lembree3 -lm -o sdtree && ./sdtree      (or -lembree4)
   Writes sdtree.pgm (left without, right with guiding, equal samples), prints the errors; ./sdtree 5 makes 5 passes,
   not 7. */
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"
#include <stdio.h>
#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

static const struct box { // corners, grey of the surface, radiance of a lamp
    float corner[2][3], grey, light;
} boxes[] = {{{{0, 0, 0}, {3, 2, 1.5f}}, 0.3f, 0},                   // the walls, seen from inside
             {{{2, 0, 0}, {2.05f, 0.7f, 1.5f}}, 0.3f, 0},            // the wall with the door,
             {{{2, 0.85f, 0}, {2.05f, 2, 1.5f}}, 0.3f, 0},           // which is ajar
             {{{0.9f, 1.2f, 0}, {1.2f, 1.5f, 0.8f}}, 0.6f, 0},       // something in the room
             {{{2.9f, 0.2f, 0.2f}, {2.95f, 1.2f, 1.2f}}, 0.5f, 10}}; // the lamp behind the door
enum { W = 96, H = 72, PIXELS = W * H, MAX_DEPTH = 12, BOXES = sizeof boxes / sizeof *boxes };
static RTCScene scene;

static float rnd(void) // in [0, 1)
{
    static unsigned long long s = 1;
    return (float)((s = s * 6364136223846793005u + 1442695040888963407u) >> 40) / 16777216.0f;
}
static float dot(const float *a, const float *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// The box that the ray hits; moves p there; n is the normal on the ray's side, nearness 1 / distance.
static const struct box *trace(float *p, const float *d, float *n, float *nearness)
{
    struct RTCRayHit r = {.ray = {p[0], p[1], p[2], 1e-4f, d[0], d[1], d[2], 0, 1e9f, ~0u, 0, 0}};
    r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
    rtcIntersect1(scene, &r, NULL);
#else
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(scene, &context, &r);
#endif
    float ng[3] = {r.hit.Ng_x, r.hit.Ng_y, r.hit.Ng_z}, scale = (dot(ng, d) > 0 ? -1 : 1) / sqrtf(dot(ng, ng));
    for (int k = 0; k < 3; ++k) {
        n[k] = ng[k] * scale;
        p[k] += r.ray.tfar * d[k];
    }
    *nearness = 1 / r.ray.tfar;
    return r.hit.geomID == RTC_INVALID_GEOMETRY_ID ? NULL : &boxes[r.hit.primID / 6];
}

static void sample_cosine(const float *n, float *d) // a point on the unit sphere around the tip of n
{
    float z = 1 - 2 * rnd(), phi = 6.2831853f * rnd(), r = sqrtf(1 - z * z);
    float v[3] = {n[0] + r * cosf(phi), n[1] + r * sinf(phi), n[2] + z}, length = sqrtf(dot(v, v)) + 1e-9f;
    for (int k = 0; k < 3; ++k)
        d[k] = v[k] / length;
}

// Radiance along one camera path; stream = NULL: unguided.
static float radiance(float *p, float *d, const gsd_view *field, gsd_stream *stream)
{
    gsd_training_sample vertex[MAX_DEPTH]; // what to learn: filled in on the way, completed on the way back
    float n[3], f_cos[MAX_DEPTH], unused;
    int count = 0;
    const struct box *hit = trace(p, d, n, &unused);
    for (; hit && !(hit->light > 0) && count < MAX_DEPTH; ++count) { // lamps do not reflect
        float jitter[3] = {rnd(), rnd(), rnd()}, u[2] = {rnd(), rnd()};
        gsd_handle handle = gsd_find(field, p, n, jitter); // 1. Find the cell; jittered, which blends neighbours.
        float alpha = stream ? handle.alpha : 1;           //    How often it wants the BSDF.
        if (rnd() < alpha)                                 // 2. One-sample MIS: draw from one of the two ...
            sample_cosine(n, d);
        else
            gsd_sample(field, &handle, u, d);
        float cosine = dot(n, d), pdf_bsdf = cosine > 0 ? cosine / 3.14159265f : 0;
        float pdf_guide = alpha < 1 ? gsd_pdf(field, &handle, d) : 0;
        float pdf = alpha * pdf_bsdf + (1 - alpha) * pdf_guide; // ... and divide by the density of both.
        f_cos[count] = hit->grey / 3.14159265f * cosine;
        vertex[count] =
            gsd_make_scalar_sample(p, d, n, INFINITY, cosine > 0 ? 0 : GSD_REJECTED, 0, 0, pdf, pdf_bsdf, pdf_guide);
        hit = cosine > 0 ? trace(p, d, n, &vertex[count].nearness) : NULL;
    }
    float L = hit ? hit->light : 0;
    for (int i = count - 1; i >= 0 && L > 0; --i) { // 3. Back along the path: L comes from vertex[i].direction.
        vertex[i].radiance = L;
        vertex[i].contribution = vertex[i].pixel_contribution = f_cos[i] * L;
        L *= f_cos[i] / vertex[i].pdf_mix;
    }
    if (stream)
        gsd_record(stream, vertex, (uint32_t)count);
    return L;
}

// Mean of 2^passes - 1 samples per pixel, in passes of 1, 2, 4, ...
static void render(float *image, int passes, gsd_field *field, gsd_stream *stream)
{
    for (int pass = 0; pass < passes; ++pass) {
        gsd_view view = gsd_get_view(field);
        for (int i = 0; i < PIXELS << pass; ++i) {
            float x = ((float)(i % W) + rnd()) / W - 0.5f, y = ((float)(i / W % H) + rnd()) / H - 0.5f;
            float p[3] = {1, 0.05f, 0.75f}, d[3] = {1.2f * x, 1, -0.9f * y};
            image[i % PIXELS] += radiance(p, d, &view, stream) / (float)((1 << passes) - 1);
        }
        if (stream) { // 4. Learn from the pass.
            gsd_accumulate(field, &stream, 1, NULL, NULL);
            gsd_stream_clear(stream);
            gsd_refine(field, NULL, NULL, NULL);
        }
    }
}

int main(int argc, char **argv)
{
    static const unsigned char quad[24] = {0, 2, 6, 4, 1, 5, 7, 3, 0, 4, 5, 1, 2, 3, 7, 6, 0, 1, 3, 2, 4, 6, 7, 5};
    static float image[3][PIXELS]; // unguided, guided, reference
    double error[2] = {0, 0};
    int passes = argc > 1 ? atoi(argv[1]) : 7;
    if (passes < 1 || passes > 12)
        return fputs("usage: sdtree [number of passes, 1 to 12]\n", stderr), 2;
    gsd_desc desc = {.bounds_max = {3, 2, 1.5f}, .target = GSD_TARGET_SIMPLE}; // the rest: defaults
    gsd_field *field;
    gsd_stream *stream;
    FILE *file = fopen("sdtree.pgm", "wb");
    RTCDevice device = rtcNewDevice(NULL);
    if (!device || !file || gsd_create(&desc, &field) || gsd_stream_create(field, &stream))
        return 1;
    RTCGeometry g = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_QUAD); // one mesh; quad i belongs to box i / 6
    float *v = rtcSetNewGeometryBuffer(g, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, 8 * BOXES);
    unsigned *index = rtcSetNewGeometryBuffer(g, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT4, 16, 6 * BOXES);
    for (int i = 0; i < 24 * BOXES; ++i) {
        v[i] = boxes[i / 24].corner[i / 3 % 8 >> i % 3 & 1][i % 3];
        index[i] = (unsigned)(i / 24 * 8 + quad[i % 24]);
    }
    scene = rtcNewScene(device);
    rtcCommitGeometry(g);
    rtcAttachGeometry(scene, g);
    rtcReleaseGeometry(g);
    rtcCommitScene(scene);
    for (int i = 0; i < 3; ++i) // the reference goes on learning
        render(image[i], i < 2 ? passes : passes + 2, field, i ? stream : NULL);
    fprintf(file, "P5 %d %d 255\n", 2 * W, H);
    for (int i = 0; i < 2 * PIXELS; ++i) {
        int side = i / W % 2, pixel = i / (2 * W) * W + i % W;
        error[side] += pow(image[side][pixel] - image[2][pixel], 2) / PIXELS;
        fputc((int)fmin(255, 255 * sqrt(9 * image[side][pixel])), file);
    }
    printf("squared error, %d samples a pixel: %.2e unguided, %.2e guided\n", (1 << passes) - 1, error[0], error[1]);
    fclose(file);
    return gsd_stream_destroy(stream), gsd_destroy(field), 0;
}
