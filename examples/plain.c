/* plain.c: path guiding with nothing but guide_sdtree.h and the C library.
   cc -O2 -I. examples/plain.c -o plain -lm && ./plain

   A room of 2 x 1 x 1 m whose lamp is behind a wall with a door ajar. The floor of the dark half is rendered twice with
   the same number of paths, by path tracing alone and guided, to plain.pgm (above: unguided, below: guided); the
   variance of both is printed. Pictures are combined by the inverse of each pass's variance. There are 7 passes of 2,
   4, 8 ... paths per pixel; ./plain 5 makes 5. */
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include <stdio.h>

enum { SIZE = 96, DEPTH = 12 }; /* pixels across, path length */
#define ALBEDO 0.7f

static const float room[3] = {2, 1, 1}; /* corner opposite to the origin */
static uint64_t rng = 1;

static float random_float(void)
{
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
    if (d[0] != 0 && wall > 1e-5f && wall < t && y < 0.94f) { /* the door leaves 6 cm open at y = 1 */
        t = wall;
        *axis = 0;
    }
    for (int k = 0; k < 3; ++k)
        p[k] += t * d[k];
    *side = d[*axis] > 0 ? -1.0f : 1.0f;
    *emitted = *axis == 2 && d[2] > 0 && fabsf(p[0] - 1.6f) < 0.2f && fabsf(p[1] - 0.3f) < 0.2f ? 20.0f : 0;
    return t;
}

/* Cosine-distributed direction around the axis, away from where d came from. */
static void scatter(int axis, float side, float d[3])
{
    float r = sqrtf(random_float()), phi = 6.2831853f * random_float();
    d[axis] = side * sqrtf(1 - r * r);
    d[(axis + 1) % 3] = r * cosf(phi);
    d[(axis + 2) % 3] = r * sinf(phi);
}

/* Light leaving p, on a surface with normal side * axis. Learns into stream, if there is one; weight = 1 / estimate of
   the pixel's value. */
static float radiance(float p[3], int axis, float side, float weight, const gsd_view *field, gsd_stream *stream)
{
    gsd_training_sample vertex[DEPTH];
    float emitted[DEPTH], cosine[DEPTH], light = 0;
    int n = 0;
    while (n < DEPTH) {
        float normal[3] = {0, 0, 0};
        normal[axis] = side;
        gsd_handle handle = gsd_find(field, p, normal, NULL);
        float alpha = stream ? handle.alpha : 1, u[2] = {random_float(), random_float()}, d[3];
        if (random_float() < alpha)
            scatter(axis, side, d);
        else
            gsd_sample(field, &handle, u, d);
        float pdf_guide = alpha < 1 ? gsd_pdf(field, &handle, d) : 0;
        float pdf_bsdf = fmaxf(d[axis] * side, 0) / 3.14159265f;
        float pdf = alpha < 1 ? alpha * pdf_bsdf + (1 - alpha) * pdf_guide : pdf_bsdf;
        cosine[n] = d[axis] * side;
        vertex[n] = gsd_make_scalar_sample(p, d, normal, INFINITY, cosine[n] > 0 ? 0 : GSD_REJECTED, 0, weight, pdf,
                                           pdf_bsdf, pdf_guide);
        weight *= ALBEDO / 3.14159265f * cosine[n] / pdf;
        emitted[n++] = 0;
        if (!(cosine[n - 1] > 0) || !(pdf > 0)) /* into the wall */
            break;
        vertex[n - 1].nearness = 1 / trace(p, d, &axis, &side, &emitted[n - 1]);
    }
    for (int i = n - 1; i >= 0; --i) { /* back along the path: light is what arrives at vertex i from its direction */
        float fcos = ALBEDO / 3.14159265f * fmaxf(cosine[i], 0), arriving = emitted[i] + light;
        vertex[i].radiance = arriving;
        vertex[i].contribution = arriving * fcos;
        vertex[i].pixel_contribution *= arriving * fcos;
        light = vertex[i].pdf_mix > 0 ? arriving * fcos / vertex[i].pdf_mix : 0;
    }
    if (stream)
        gsd_record(stream, vertex, (uint32_t)n);
    return light;
}

/* Render all passes into image; returns the variance of the mean pixel at the end. */
static double render(float *image, int passes, gsd_field *field, gsd_stream *stream)
{
    double weights = 0, mean = 0;
    for (int pass = 0; pass < passes; ++pass) {
        static float picture[SIZE * SIZE];
        gsd_view view = gsd_get_view(field);
        double variance = 0, weight = pass ? pass / mean : 1, paths = 2 << pass; /* estimate: the floor's mean */
        for (int i = 0; i < SIZE * SIZE; ++i) {
            double sum = 0, square = 0;
            for (int k = 0; k < paths; ++k) {
                float x = (float)(i % SIZE) + random_float(), y = (float)(i / SIZE) + random_float();
                float p[3] = {x / SIZE, y / SIZE, 0}, L = radiance(p, 2, 1, (float)weight, &view, stream);
                sum += L;
                square += (double)L * L;
            }
            sum /= paths;
            mean += (picture[i] = (float)sum) / (SIZE * SIZE);
            variance += (square / paths - sum * sum) / (paths - 1) / (SIZE * SIZE);
        }
        for (int i = 0; i < SIZE * SIZE; ++i) /* one weight per pass: the pictures stay unbiased */
            image[i] = (float)((weights * image[i] + picture[i] / variance) / (weights + 1 / variance));
        weights += 1 / variance;
        if (stream) {
            gsd_accumulate(field, &stream, 1, NULL, NULL);
            gsd_stream_clear(stream);
            gsd_refine(field, &(gsd_pass){.pixel_estimate = pass > 0}, NULL, NULL);
        }
        printf("%s: %3g paths, variance of one %.4g\n", stream ? "guided  " : "unguided", paths, variance * paths);
    }
    return 1 / weights;
}

int main(int argc, char **argv)
{
    static float image[2 * SIZE * SIZE];
    int passes = argc > 1 ? atoi(argv[1]) : 7;
    if (passes < 1 || passes > 12)
        return fputs("usage: plain [number of passes, 1 to 12]\n", stderr), 2;
    gsd_desc desc = {.bounds_max = {room[0], room[1], room[2]}}; /* the rest: defaults */
    gsd_field *field;
    gsd_stream *stream;
    FILE *file = fopen("plain.pgm", "wb");
    if (!file || gsd_create(&desc, &field) || gsd_stream_create(field, &stream))
        return 1;
    double plain = render(image, passes, field, NULL), guided = render(image + SIZE * SIZE, passes, field, stream);
    printf("variance of the picture: unguided %.4g, guided %.4g: %.1f times less\n", plain, guided, plain / guided);
    fprintf(file, "P5 %d %d 255\n", SIZE, 2 * SIZE);
    for (int i = 0; i < 2 * SIZE * SIZE; ++i)
        fputc((int)fminf(255, 255 * powf(image[i] * 25, 1 / 2.2f)), file);
    fclose(file);
    gsd_stream_destroy(stream);
    gsd_destroy(field);
    return 0;
}
