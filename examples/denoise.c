/* denoise.c: what denoising does to a quadtree of guide_sdtree.h.

   cc -O2 -I. examples/denoise.c -o denoise -lm && ./denoise > denoise.svg

   One point sees a glow, a lamp and a bright slit. Its quadtree learns from the same 2,000 noisy samples without and
   with denoising, and from two million. Three panels show its leaves over (phi, z), brighter where the density is
   higher; V = integral of L^2 / p over (integral of L)^2 says how well each fits (1 is perfect). */
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include <stdio.h>

enum { PASSES = 8, PANEL = 300 }; /* pixels */
static uint64_t rng;

static double random_double(void)
{
    rng = rng * 6364136223846793005ull + 1442695040888963407ull;
    return (double)(rng >> 11) * 0x1p-53;
}

static double light(const float d[3])
{
    double glow = exp(5 * (0.6 * (double)d[0] + 0.8 * (double)d[2] - 1)),
           lamp = -0.8 * (double)d[0] + 0.6 * (double)d[1];
    return 0.03 + glow + 8 * (lamp > 0.97) + 3 * (fabs((double)d[2] + 0.2) < 0.05 && d[1] < 0);
}

static int record(gsd_stream *stream, const gsd_view *view, const float at[3])
{
    gsd_handle handle = gsd_find(view, at, NULL, NULL);
    float u[2] = {(float)(random_double() * 0.999999), (float)(random_double() * 0.999999)}, d[3], pdf;
    pdf = gsd_sample(view, &handle, u, d);
    if (random_double() < 0.5) /* half of them anywhere */
        gsd_direction(random_double() * 16777216, random_double() * 16777216, d);
    pdf = 0.5f * (gsd_pdf(view, &handle, d) + GSD_INV_4PI);
    float L = (float)(light(d) * -log(1 - random_double())); /* as noisy as a path */
    gsd_training_sample sample = gsd_make_scalar_sample(at, d, NULL, INFINITY, L, L, L, pdf, GSD_INV_4PI, 0);
    return gsd_record(stream, &sample, 1);
}

/* V of the density that queries see, by the midpoint rule. */
static double fit(const gsd_view *view, const gsd_handle *handle)
{
    double sum = 0, square = 0;
    float d[3];
    for (int i = 0; i < 512 * 512; ++i) {
        gsd_direction((i % 512 + 0.5) * 32768, (i / 512 + 0.5) * 32768, d);
        double L = light(d);
        sum += L;
        square += L * L / ((double)gsd_pdf(view, handle, d) * 12.566370614359172);
    }
    return square / sum / sum * 512 * 512;
}

static void draw(const gsd_tree *tree, uint32_t node, double x, double y, double size)
{
    for (uint32_t k = 0; k < 4; ++k) {
        double half = size / 2, left = x + (k & 1) * half, top = y + (k < 2) * half; /* z upwards */
        if (tree->child[4 * node + k]) {
            draw(tree, tree->child[4 * node + k], left, top, half);
            continue;
        }
        double density = (double)tree->value[4 * node + k] * PANEL * PANEL / (half * half);
        double bright = 0.5 + 0.17 * log2(density + 1e-6) / 1.2;
        bright = bright < 0 ? 0 : bright > 1 ? 1 : bright;
        printf("<rect x=\"%.2f\" y=\"%.2f\" width=\"%.2f\" height=\"%.2f\" fill=\"#%02x%02x%02x\"/>\n", left, top, half,
               half, (unsigned)(255 * bright), (unsigned)(255 * bright * bright), (unsigned)(90 * (1 - bright)));
    }
}

/* Learn, draw the quadtree as a panel. */
static int panel(int number, const char *title, int samples, bool denoise)
{
    static gsd_desc desc;
    static const float at[3] = {0.5f, 0.5f, 0.5f};
    static uint32_t child[4 << 16];
    static float value[4 << 16];
    gsd_tree tree = {0, 1 << 16, child, value};
    gsd_field *field = NULL;
    gsd_stream *stream = NULL;
    desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1;
    desc.target = GSD_TARGET_RADIANCE;
    desc.split_samples = 1e9f; /* one cell */
    desc.no_gate = true;
    desc.denoise = denoise ? GSD_DENOISE_BLUR : GSD_DENOISE_OFF;
    rng = 1;
    int bad = gsd_create(&desc, &field) || gsd_stream_create(field, &stream);
    for (int pass = 0; !bad && pass < PASSES; ++pass) {
        gsd_view view = gsd_get_view(field);
        for (int i = 0; i < samples / PASSES; ++i)
            bad |= record(stream, &view, at);
        bad |= gsd_accumulate(field, &stream, 1, NULL, NULL);
        gsd_stream_clear(stream);
        bad |= gsd_refine(field, NULL, NULL, NULL);
    }
    if (!bad && !(bad = gsd_export_tree(field, GSD_PART_SAMPLING, &tree))) {
        gsd_view view = gsd_get_view(field);
        gsd_handle handle = gsd_find(&view, at, NULL, NULL);
        printf("<g transform=\"translate(%d 24)\">\n<text y=\"-8\">%s: V = %.2f</text>\n", number * (PANEL + 12), title,
               fit(&view, &handle));
        draw(&tree, 0, 0, 0, PANEL);
        printf("</g>\n");
    }
    if (stream)
        gsd_stream_destroy(stream);
    gsd_destroy(field);
    return bad;
}

int main(void)
{
    printf("<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%d\" height=\"%d\" font-family=\"sans-serif\" "
           "font-size=\"13\" shape-rendering=\"crispEdges\" stroke=\"none\">\n",
           3 * PANEL + 24, PANEL + 24);
    int bad = panel(0, "2,000 samples, as gathered", 2000, false) || panel(1, "2,000 samples, denoised", 2000, true) ||
              panel(2, "2,000,000 samples", 2000000, true);
    printf("</svg>\n");
    if (bad)
        fprintf(stderr, "denoise: out of memory\n");
    return bad;
}
