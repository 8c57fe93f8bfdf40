/* photon.c: photons guide camera paths, with nothing but guide_photon.h and the C library.
   cc -O2 -I. examples/photon.c -o photon -lm && ./photon
   A room of 2 x 1 x 1 m whose lamp, a hand wide, is behind a wall with a door ajar. The floor of the dark half is
   rendered twice with the same number of camera paths, by path tracing alone and guided by as many photons; the
   variance of both is printed. There are 6 passes of 2, 4, 8 ... paths per pixel; ./photon 4 makes 4. */
#define GPH_IMPLEMENTATION
#include "guide_photon.h"
#include <stdio.h>

enum { SIZE = 64, DEPTH = 12 }; /* pixels across, path length */
#define ALBEDO 0.7f
#define PI 3.14159265f

/* The room's corner opposite to the origin; the lamp on its ceiling. */
static const float room[3] = {2, 1, 1}, lamp[2] = {1.6f, 0.3f}, half = 0.05f;

static float random_float(void)
{
    static uint64_t rng = 1;
    rng = rng * 6364136223846793005ull + 1442695040888963407ull;
    return (float)(rng >> 40) / 16777216.0f;
}

/* Move p along d to the next surface; returns the distance, the axis of the normal and its side, and the light. */
static float trace(float p[3], const float d[3], int *axis, float *side, float *emitted)
{
    float t = 1e30f, wall = (1 - p[0]) / d[0], y = p[1] + wall * d[1];
    for (int k = 0; k < 3; ++k) {
        float s = ((d[k] > 0 ? room[k] : 0) - p[k]) / d[k];
        if (d[k] != 0 && s < t) {
            t = s;
            *axis = k;
        }
    }
    if (d[0] != 0 && wall > 1e-5f && wall < t && y < 0.9f) { /* the door leaves 10 cm open at y = 1 */
        t = wall;
        *axis = 0;
    }
    for (int k = 0; k < 3; ++k)
        p[k] += t * d[k];
    *side = d[*axis] > 0 ? -1.0f : 1.0f;
    *emitted = *axis == 2 && d[2] > 0 && fabsf(p[0] - lamp[0]) < half && fabsf(p[1] - lamp[1]) < half ? 320.0f : 0;
    return t;
}

/* Cosine-distributed direction around the axis. */
static void scatter(int axis, float side, float d[3])
{
    float r = sqrtf(random_float()), phi = 2 * PI * random_float();
    d[axis] = side * sqrtf(1 - r * r);
    d[(axis + 1) % 3] = r * cosf(phi);
    d[(axis + 2) % 3] = r * sinf(phi);
}

/* A photon's way from the lamp: it arrives, with what its path carries, and is scattered or absorbed. */
static void trace_photon(gph_stream *stream)
{
    float p[3] = {lamp[0] + half * (2 * random_float() - 1), lamp[1] + half * (2 * random_float() - 1), 1}, d[3];
    int axis = 2;
    float side = -1, unused;
    do {
        scatter(axis, side, d);
        float distance = trace(p, d, &axis, &side, &unused), back[3] = {-d[0], -d[1], -d[2]};
        gph_photon photon = gph_make_photon(p, back, distance, 1); /* every path has the same power */
        gph_record_photons(stream, &photon, 1);
    } while (random_float() < ALBEDO);
}

/* Light leaving p, on a surface with normal side * axis. Tells stream where it went, if there is one. */
static float radiance(float p[3], int axis, float side, const gph_view *field, gph_stream *stream)
{
    gph_vertex vertex[DEPTH];
    float emitted[DEPTH] = {0}, fcos[DEPTH], cosine = 1, light = 0;
    int n = 0;
    for (; n < DEPTH && cosine > 0; ++n) { /* until it goes into the wall */
        float normal[3] = {0, 0, 0}, u[2] = {random_float(), random_float()}, d[3];
        gph_handle handle;
        normal[axis] = side;
        gph_find(field, p, normal, NULL, &handle);
        float alpha = stream ? handle.alpha : 1;
        bool guided = random_float() >= alpha;
        if (guided)
            gph_sample(&handle, u, d);
        else
            scatter(axis, side, d);
        cosine = fmaxf(d[axis] * side, 0);
        float pdf_guide = stream ? gph_pdf(&handle, d) : 0, pdf_bsdf = cosine / PI;
        fcos[n] = ALBEDO / PI * cosine;
        vertex[n] = gph_make_vertex(p, 0, alpha * pdf_bsdf + (1 - alpha) * pdf_guide, pdf_bsdf, pdf_guide,
                                    guided ? GPH_FROM_GUIDE : GPH_FROM_BSDF);
        if (cosine > 0)
            trace(p, d, &axis, &side, &emitted[n]);
    }
    for (int i = n - 1; i >= 0; --i) { /* back along the path */
        vertex[i].contribution = (emitted[i] + light) * fcos[i];
        light = vertex[i].pdf_mix > 0 ? vertex[i].contribution / vertex[i].pdf_mix : 0;
    }
    if (stream)
        gph_record_vertices(stream, vertex, (uint32_t)n);
    return light;
}

/* Render all passes; returns the variance of the mean pixel at the end, and what the floor looks like on average. */
static double render(int passes, gph_field *field, gph_stream *stream, double *mean)
{
    double weights = 0;
    for (int pass = 0; pass < passes; ++pass) {
        gph_view view = gph_get_view(field);
        double variance = 0, all = 0, paths = 2 << pass;
        for (int i = 0; i < SIZE * SIZE; ++i) {
            double sum = 0, square = 0;
            for (int k = 0; k < paths; ++k) {
                float x = (float)(i % SIZE) + random_float(), y = (float)(i / SIZE) + random_float();
                float p[3] = {x / SIZE, y / SIZE, 0}, L = radiance(p, 2, 1, &view, stream);
                sum += L / paths;
                square += (double)L * L / paths;
                if (stream)
                    trace_photon(stream);
            }
            all += sum / (SIZE * SIZE);
            variance += (square - sum * sum) / (paths - 1) / (SIZE * SIZE);
        }
        *mean = (*mean * weights + all / variance) / (weights + 1 / variance); /* one weight per pass: unbiased */
        weights += 1 / variance;
        if (stream) {
            gph_accumulate(field, &stream, 1, NULL, NULL);
            gph_stream_clear(stream);
            gph_refine(field, NULL, NULL);
        }
        printf("%s: %3g paths, variance of one %.4g\n", stream ? "guided  " : "unguided", paths, variance * paths);
    }
    return 1 / weights;
}

int main(int argc, char **argv)
{
    int passes = argc > 1 ? atoi(argv[1]) : 6;
    if (passes < 1 || passes > 12)
        return fputs("usage: photon [number of passes, 1 to 12]\n", stderr), 2;
    gph_desc desc = {.grid_cells = 16}; /* few photons: large voxels at first; the rest: defaults */
    gph_field *field;
    gph_stream *stream;
    double mean[2] = {0, 0};
    if (gph_create(&desc, &field) || gph_stream_create(field, &stream))
        return 1;
    double unguided = render(passes, field, NULL, &mean[0]), guided = render(passes, field, stream, &mean[1]);
    printf("means %.4g and %.4g; guided / unguided variance: %.3g\n", mean[0], mean[1], guided / unguided);
    return gph_stream_destroy(stream), gph_destroy(field), 0;
}
