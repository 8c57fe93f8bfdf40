/* spectrum.c: colours from spectra, temperatures and material names. */
#include "scene_internal.h"

#include <string.h>

/* ---- spectra -------------------------------------------------------------------------------------------------- */

static double lobe(double x, double mean, double left, double right)
{
    double t = (x - mean) / (x < mean ? left : right);
    return exp(-0.5 * t * t);
}

/* CIE 1931 colour matching functions by the multi-lobe fits of Wyman, Sloan and Shirley, JCGT 2013, section 2.2. */
static void matching(double nm, double xyz[3])
{
    xyz[0] =
        1.056 * lobe(nm, 599.8, 37.9, 31.0) + 0.362 * lobe(nm, 442.0, 16.0, 26.7) - 0.065 * lobe(nm, 501.1, 20.4, 26.2);
    xyz[1] = 0.821 * lobe(nm, 568.8, 46.9, 40.5) + 0.286 * lobe(nm, 530.9, 16.3, 31.1);
    xyz[2] = 1.217 * lobe(nm, 437.0, 11.8, 36.0) + 0.681 * lobe(nm, 459.0, 26.0, 13.8);
}

static void xyz_to_rgb(const double xyz[3], double rgb[3])
{
    static const double m[3][3] = {{3.2404542, -1.5371385, -0.4985314}, /* sRGB primaries, D65 */
                                   {-0.9692660, 1.8760108, 0.0415560},
                                   {0.0556434, -0.2040259, 1.0572252}};
    for (int i = 0; i < 3; ++i)
        rgb[i] = m[i][0] * xyz[0] + m[i][1] * xyz[1] + m[i][2] * xyz[2];
}

typedef struct spectrum {
    const float *wavelengths, *values;
    int count, at;
    double kelvin; /* > 0: a black body instead */
} spectrum;

/* Asked at rising wavelengths only. */
static double spectrum_value(spectrum *s, double nm)
{
    if (s->kelvin > 0) { /* Planck, W/m^2/sr/nm */
        const double h = 6.62607015e-34, c = 299792458, k = 1.380649e-23, m = nm * 1e-9;
        return 2e-9 * h * c * c / (m * m * m * m * m * expm1(h * c / (m * k * s->kelvin)));
    }
    while (s->at + 1 < s->count && (double)s->wavelengths[s->at + 1] < nm)
        ++s->at;
    int i = s->at;
    if (i + 1 >= s->count || nm < (double)s->wavelengths[i])
        return 0;
    double a = (double)s->wavelengths[i], b = (double)s->wavelengths[i + 1];
    double t = b > a ? (nm - a) / (b - a) : 0;
    return (double)s->values[i] * (1 - t) + (double)s->values[i + 1] * t;
}

static vec3 integrate(spectrum *s, bool emission)
{
    double sum[3] = {0}, white[3] = {0}, rgb[3], white_rgb[3], xyz[3], y = 0;
    for (double nm = 360.5; nm < 830; nm += 1) {
        double v = spectrum_value(s, nm);
        matching(nm, xyz);
        for (int i = 0; i < 3; ++i) {
            sum[i] += v * xyz[i];
            white[i] += xyz[i];
        }
        y += xyz[1];
    }
    xyz_to_rgb(sum, rgb);
    xyz_to_rgb(white, white_rgb);
    for (int i = 0; i < 3; ++i)
        rgb[i] = fmax(0, rgb[i] / (emission ? y : white_rgb[i]));
    return v3((float)rgb[0], (float)rgb[1], (float)rgb[2]);
}

vec3 tr_spectrum_rgb(const float *wavelengths, const float *values, int count, bool emission)
{
    spectrum s = {wavelengths, values, count, 0, 0};
    return integrate(&s, emission);
}

vec3 tr_blackbody_rgb(float kelvin)
{
    spectrum s = {NULL, NULL, 0, 0, (double)kelvin};
    return integrate(&s, true);
}

float tr_srgb_decode(float x) { return x <= 0.04045f ? x / 12.92f : powf((x + 0.055f) / 1.055f, 2.4f); }

/* ---- materials ------------------------------------------------------------------------------------------------ */

/* Normal-incidence colours in linear sRGB, rounded as graphics texts list them, and one edge tint (how low the real
   part of the index is: 1 lowest) so that Gulbrandsen's n comes near the measured one in the green. */
static const struct {
    const char *name;
    float r, g, b, tint;
} metals[] = {{"Ag", 0.972f, 0.960f, 0.915f, 0.998f}, {"Al", 0.913f, 0.922f, 0.924f, 0.98f},
              {"Au", 0.980f, 0.766f, 0.336f, 0.98f},  {"Co", 0.662f, 0.655f, 0.634f, 0.8f},
              {"Cr", 0.549f, 0.556f, 0.554f, 0.56f},  {"Cu", 0.955f, 0.638f, 0.538f, 0.97f},
              {"Fe", 0.562f, 0.565f, 0.578f, 0.6f},   {"Ni", 0.660f, 0.609f, 0.526f, 0.8f},
              {"Pt", 0.673f, 0.637f, 0.585f, 0.75f},  {"Ti", 0.542f, 0.497f, 0.449f, 0.6f},
              {"W", 0.504f, 0.498f, 0.478f, 0.42f}};

/* Gulbrandsen, "Artist Friendly Metallic Fresnel", JCGT 2014, eq. 2 and 3. */
static void metal_index(float r, float tint, float *eta, float *k)
{
    float root = sqrtf(r), n = tint * (1 - r) / (1 + r) + (1 - tint) * (1 + root) / (1 - root);
    *eta = n;
    *k = sqrtf(fmaxf(0, (r * sqrf(n + 1) - sqrf(n - 1)) / (1 - r)));
}

bool tr_metal(const char *name, vec3 *eta, vec3 *k)
{
    size_t length = strcspn(name, "_"); /* "Ni_palik" is Ni */
    if (strcmp(name, "none") == 0) {    /* purely imaginary: reflects everything */
        *eta = v3s(0);
        *k = v3s(1);
        return true;
    }
    for (size_t i = 0; i < sizeof metals / sizeof *metals; ++i)
        if (strlen(metals[i].name) == length && memcmp(metals[i].name, name, length) == 0) {
            metal_index(metals[i].r, metals[i].tint, &eta->x, &k->x);
            metal_index(metals[i].g, metals[i].tint, &eta->y, &k->y);
            metal_index(metals[i].b, metals[i].tint, &eta->z, &k->z);
            return true;
        }
    return false;
}

bool tr_ior(const char *name, float *ior)
{
    static const struct {
        const char *name;
        float ior;
    } list[] = {{"vacuum", 1.0f},      {"helium", 1.000036f},        {"hydrogen", 1.000132f},
                {"air", 1.000277f},    {"carbon dioxide", 1.00045f}, {"water", 1.3330f},
                {"acetone", 1.36f},    {"ethanol", 1.361f},          {"carbon tetrachloride", 1.461f},
                {"glycerol", 1.4729f}, {"benzene", 1.501f},          {"silicone oil", 1.52045f},
                {"bromine", 1.661f},   {"water ice", 1.31f},         {"fused quartz", 1.458f},
                {"pyrex", 1.470f},     {"acrylic glass", 1.49f},     {"polypropylene", 1.49f},
                {"bk7", 1.5046f},      {"sodium chloride", 1.544f},  {"amber", 1.55f},
                {"pet", 1.575f},       {"diamond", 2.419f}};
    for (size_t i = 0; i < sizeof list / sizeof *list; ++i)
        if (strcmp(list[i].name, name) == 0) {
            *ior = list[i].ior;
            return true;
        }
    return false;
}
