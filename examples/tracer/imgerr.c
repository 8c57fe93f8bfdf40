/* imgerr.c: errors of a picture against a reference, and pictures for looking at.

   imgerr A.exr REF.exr                                    relMSE and MRAE, trimmed and untrimmed
   imgerr --compare OUT.png IMAGE.exr LABEL [IMAGE LABEL]...   side by side at one exposure
   imgerr --to-png IMAGE.exr OUT.png [EXPOSURE]             tone-mapped
   imgerr --cells OUT.png IMAGE.exr LABEL [IMAGE LABEL]...     cells of the guiding field in false colours, side by side
   imgerr --heat OUT.png IMAGE.exr REF.exr                  relative error per pixel: black 0, white 1 and more
   imgerr --regions IMAGE.exr REF.exr [CLAMP]               means of 6 x 4 regions over the reference's; any two sizes
 */
#include "tracer.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#if defined(__GNUC__) || defined(__clang__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wsign-compare"
#endif
#include <stb/stb_easy_font.h>
#if defined(__GNUC__) || defined(__clang__)
#pragma GCC diagnostic pop
#endif

#define SEPARATOR 2 /* pixels between pictures */
#define MAX_COLUMNS 16
#define REGIONS_X 6
#define REGIONS_Y 4

static const char usage[] = "usage: imgerr IMAGE.exr REFERENCE.exr\n"
                            "       imgerr --compare OUT.png IMAGE.exr LABEL [IMAGE.exr LABEL]...\n"
                            "       imgerr --to-png IMAGE.exr OUT.png [EXPOSURE]\n"
                            "       imgerr --cells OUT.png IMAGE.exr LABEL [IMAGE.exr LABEL]...\n"
                            "       imgerr --heat OUT.png IMAGE.exr REFERENCE.exr\n"
                            "       imgerr --regions IMAGE.exr REFERENCE.exr [CLAMP]\n";

static int complain(const char *text, const char *remedy)
{
    fprintf(stderr, "imgerr: error: %s%s%s\n", text, remedy ? "; " : "", remedy ? remedy : "");
    return 1;
}

static bool read_pair(const char *a_path, const char *b_path, tr_image *a, tr_image *b)
{
    char err[512];
    if (!tr_image_read(a_path, false, a, err, sizeof err)) {
        complain(err, "check the path, or render it again");
        return false;
    }
    if (!tr_image_read(b_path, false, b, err, sizeof err)) {
        complain(err, "check the path, or render it again");
        tr_image_free(a);
        return false;
    }
    return true;
}

static int print_errors(const char *image_path, const char *reference_path)
{
    tr_image image, reference;
    tr_error error;
    char err[512], text[1200];
    if (!read_pair(image_path, reference_path, &image, &reference))
        return 1;
    bool ok = tr_image_error(&image, &reference, &error, err, sizeof err);
    tr_image_free(&image);
    tr_image_free(&reference);
    if (!ok) {
        snprintf(text, sizeof text, "%s against %s: %s", image_path, reference_path, err);
        return complain(text, "render both at one size (--size WxH) and without bad samples");
    }
    printf("relMSE %.6g (untrimmed %.6g)  MRAE %.6g (untrimmed %.6g)\n", error.relmse, error.relmse_untrimmed,
           error.mrae, error.mrae_untrimmed);
    return 0;
}

static void fill_rect(tr_image *image, float x0, float y0, float x1, float y1, float value)
{
    int left = (int)fmaxf(x0, 0), top = (int)fmaxf(y0, 0);
    for (int y = top; y < image->height && (float)y < y1; ++y)
        for (int x = left; x < image->width && (float)x < x1; ++x)
            for (int c = 0; c < image->channels; ++c)
                image->data[((size_t)y * (size_t)image->width + (size_t)x) * (size_t)image->channels + (size_t)c] =
                    value;
}

/* White text on a black plate at (x, y), `scale` pixels per dot of the font. */
static void draw_text(tr_image *image, int x, int y, float scale, const char *label, float white)
{
    struct vertex {
        float x, y, z;
        unsigned char color[4];
    };
    static struct vertex quads[4 * 4096];
    char text[160];
    snprintf(text, sizeof text, "%s", label);
    for (char *s = text; *s; ++s) /* the font has only these */
        if ((unsigned char)*s < 32 || (unsigned char)*s > 126)
            *s = '?';
    int n = stb_easy_font_print(0, 0, text, NULL, quads, (int)sizeof quads);
    float fx = (float)x, fy = (float)y, pad = 2 * scale;
    fill_rect(image, fx, fy, fx + (float)stb_easy_font_width(text) * scale + 2 * pad,
              fy + (float)stb_easy_font_height(text) * scale + pad, 0);
    for (int i = 0; i < n; ++i)
        fill_rect(image, fx + pad + quads[4 * i].x * scale, fy + pad + quads[4 * i].y * scale,
                  fx + pad + quads[4 * i + 2].x * scale, fy + pad + quads[4 * i + 2].y * scale, white);
}

static bool join(tr_image *images, const char *const *labels, int count, tr_image *out, float exposure)
{
    int width = -SEPARATOR, height = 0;
    for (int i = 0; i < count; ++i) {
        width += images[i].width + SEPARATOR;
        height = images[i].height > height ? images[i].height : height;
    }
    if (!tr_image_alloc(out, width, height, 3))
        return false;
    float scale = height >= 400 ? 2 : 1;
    for (int i = 0, left = 0; i < count; ++i) {
        const tr_image *image = &images[i];
        for (int y = 0; y < image->height; ++y)
            memcpy(out->data + ((size_t)y * (size_t)width + (size_t)left) * 3,
                   image->data + (size_t)y * (size_t)image->width * 3, (size_t)image->width * 3 * sizeof(float));
        draw_text(out, left, 0, scale, labels[i], 1 / exposure);
        left += image->width;
        if (i + 1 < count)
            fill_rect(out, (float)left, 0, (float)(left + SEPARATOR), (float)height, 1 / exposure);
        left += SEPARATOR;
    }
    return true;
}

typedef bool (*image_reader)(const char *path, tr_image *image, char *err, size_t err_size);

static bool read_colour(const char *path, tr_image *image, char *err, size_t err_size)
{
    return tr_image_read(path, false, image, err, err_size);
}

/* A colour of its own for every number; neighbours in the tree, which have numbers far apart or next to each other,
   differ. Hue by the golden ratio, three lightnesses. */
static vec3 cell_colour(float cell)
{
    float hue = 6 * (float)fmod(0.61803398875 * (double)cell, 1), light = 0.35f + 0.3f * (float)fmod((double)cell, 3);
    vec3 c = v3(clampf(fabsf(hue - 3) - 1, 0, 1), clampf(2 - fabsf(hue - 2), 0, 1), clampf(2 - fabsf(hue - 4), 0, 1));
    return v3(light * (0.15f + 0.85f * c.x), light * (0.15f + 0.85f * c.y), light * (0.15f + 0.85f * c.z));
}

/* Cells in false colours, shaded by the normals so that the scene can be made out. */
static bool read_cells(const char *path, tr_image *image, char *err, size_t err_size)
{
    tr_image normal;
    if (!tr_exr_read_layer(path, "cell", image, err, err_size))
        return false;
    if (!tr_exr_read_layer(path, "normal", &normal, err, err_size)) {
        tr_image_free(image);
        return false;
    }
    for (size_t i = 0, n = (size_t)image->width * (size_t)image->height; i < n; ++i) {
        float *p = image->data + 3 * i, *d = normal.data + 3 * i;
        float shade = 0.55f + 0.2f * (d[0] + d[1]) + 0.05f * d[2]; /* light from above, and from one side */
        vec3 c = isfinite(p[0]) ? cell_colour(p[0]) : v3(0, 0, 0);
        p[0] = c.x * shade;
        p[1] = c.y * shade;
        p[2] = c.z * shade;
    }
    tr_image_free(&normal);
    return true;
}

/* exposure 0: that of the last picture, which is the best one by custom (the reference). */
static int compare(const char *out_path, char **args, int count, image_reader read, float exposure)
{
    tr_image images[MAX_COLUMNS], all = {0};
    const char *labels[MAX_COLUMNS];
    char err[512] = "out of memory";
    int columns = count / 2, loaded = 0;
    memset(images, 0, sizeof images);
    if (columns > MAX_COLUMNS)
        return complain("too many pictures", "16 at most");
    bool ok = true;
    for (; loaded < columns; ++loaded) {
        ok = read(args[2 * loaded], &images[loaded], err, sizeof err);
        if (!ok)
            break;
        labels[loaded] = args[2 * loaded + 1];
    }
    if (ok) {
        if (!(exposure > 0))
            exposure = tr_auto_exposure(&images[columns - 1]);
        snprintf(err, sizeof err, "%s: the pictures together are too large", out_path);
        ok = join(images, labels, columns, &all, exposure) && tr_png_write(out_path, &all, exposure, err, sizeof err);
    }
    tr_image_free(&all);
    for (int i = 0; i < loaded; ++i)
        tr_image_free(&images[i]);
    return ok ? 0 : complain(err, "check the paths, and that the folder of the output exists");
}

/* A positive number, `fallback` where there is no text; 0 after a complaint. */
static float positive(const char *text, const char *what, float fallback)
{
    char err[200], *end = NULL;
    float value = text ? strtof(text, &end) : fallback;
    if (text && (end == text || *end || !(value > 0) || !isfinite(value))) {
        snprintf(err, sizeof err, "bad %s \"%.100s\"", what, text);
        complain(err, "give a positive number, or leave it out");
        return 0;
    }
    return value;
}

static int to_png(const char *in_path, const char *out_path, const char *exposure_text)
{
    tr_image image;
    char err[512];
    float exposure = positive(exposure_text, "exposure", INFINITY);
    if (!(exposure > 0))
        return 1;
    if (isinf(exposure))
        exposure = 0; /* automatic */
    bool ok = tr_image_read(in_path, false, &image, err, sizeof err);
    ok = ok && tr_png_write(out_path, &image, exposure, err, sizeof err);
    tr_image_free(&image);
    return ok ? 0 : complain(err, "check both paths");
}

/* Black, violet, orange, white over [0, 1], of rising lightness. */
static vec3 heat_colour(float t)
{
    t = clampf(t, 0, 1);
    return v3(clampf(2.2f * t, 0, 1), t * t,
              clampf(t < 0.4f ? 1.5f * t : 0.6f - 2 * (t - 0.4f) + 4 * t * t * t * t, 0, 1));
}

static int heat(const char *out_path, const char *image_path, const char *reference_path)
{
    tr_image image, reference;
    char err[1200];
    if (!read_pair(image_path, reference_path, &image, &reference))
        return 1;
    bool ok = image.width == reference.width && image.height == reference.height;
    if (!ok)
        snprintf(err, sizeof err, "%s has %d x %d pixels, %s %d x %d", image_path, image.width, image.height,
                 reference_path, reference.width, reference.height);
    size_t n = (size_t)image.width * (size_t)image.height;
    double sum = 0;
    for (size_t i = 0; ok && i < 3 * n; ++i)
        sum += isfinite(reference.data[i]) ? reference.data[i] : 0;
    float scale = sum > 0 ? (float)(0.5 * 3 * (double)n / sum) : 1;
    for (size_t i = 0; ok && i < n; ++i) {
        float *a = image.data + 3 * i, *r = reference.data + 3 * i, e = 0;
        for (int c = 0; c < 3; ++c)
            e += fabsf(a[c] - r[c]) * scale / (fmaxf(r[c] * scale, 0) + 0.01f) / 3;
        vec3 colour = isnan(e) ? v3(0, 1, 0) : heat_colour(e); /* green = NaN */
        a[0] = colour.x;
        a[1] = colour.y;
        a[2] = colour.z;
    }
    ok = ok && tr_png_write(out_path, &image, 1, err, sizeof err);
    tr_image_free(&image);
    tr_image_free(&reference);
    return ok ? 0 : complain(err, "compare pictures of one size, and check the output's folder");
}

/* Mean over channels and pixels of a region, values clamped; NaN counts as 0. */
static double region_mean(const tr_image *image, int column, int row, float clamp)
{
    int x0 = image->width * column / REGIONS_X, x1 = image->width * (column + 1) / REGIONS_X;
    int y0 = image->height * row / REGIONS_Y, y1 = image->height * (row + 1) / REGIONS_Y;
    double sum = 0;
    for (int y = y0; y < y1; ++y)
        for (int i = 3 * x0; i < 3 * x1; ++i)
            sum += fminf(fmaxf(image->data[(size_t)y * (size_t)image->width * 3 + (size_t)i], 0), clamp);
    return sum / (3.0 * fmax((x1 - x0) * (y1 - y0), 1));
}

/* Is there a bias? Fireflies sway means: a clamp compares what lies below it (and is itself a bias of the noisier). */
static int regions(const char *image_path, const char *reference_path, const char *clamp_text)
{
    tr_image image, reference;
    float clamp = positive(clamp_text, "clamp", INFINITY);
    if (!(clamp > 0) || !read_pair(image_path, reference_path, &image, &reference))
        return 1;
    double low = INFINITY, high = 0, all[2] = {0, 0};
    for (int row = 0; row < REGIONS_Y; ++row)
        for (int column = 0; column < REGIONS_X; ++column) {
            double a = region_mean(&image, column, row, clamp), b = region_mean(&reference, column, row, clamp);
            double ratio = b > 0 ? a / b : a > 0 ? INFINITY : 1;
            low = fmin(low, ratio);
            high = fmax(high, ratio);
            all[0] += a;
            all[1] += b;
            printf("%7.4f%s", ratio, column + 1 < REGIONS_X ? " " : "\n");
        }
    printf("all %.4f  lowest %.4f  highest %.4f\n", all[1] > 0 ? all[0] / all[1] : 1, low, high);
    tr_image_free(&image);
    tr_image_free(&reference);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc == 2 && strcmp(argv[1], "--help") == 0) {
        fputs(usage, stdout);
        return 0;
    }
    if (argc == 3 && argv[1][0] != '-')
        return print_errors(argv[1], argv[2]);
    if (argc >= 5 && argc % 2 == 1 && strcmp(argv[1], "--compare") == 0)
        return compare(argv[2], argv + 3, argc - 3, read_colour, 0);
    if (argc >= 5 && argc % 2 == 1 && strcmp(argv[1], "--cells") == 0)
        return compare(argv[2], argv + 3, argc - 3, read_cells, 1);
    if ((argc == 4 || argc == 5) && strcmp(argv[1], "--to-png") == 0)
        return to_png(argv[2], argv[3], argc == 5 ? argv[4] : NULL);
    if (argc == 5 && strcmp(argv[1], "--heat") == 0)
        return heat(argv[2], argv[3], argv[4]);
    if ((argc == 4 || argc == 5) && strcmp(argv[1], "--regions") == 0)
        return regions(argv[2], argv[3], argc == 5 ? argv[4] : NULL);
    fputs(usage, stderr);
    return 1;
}
