/* sunsky.c: daylight: the sky of Preetham et al. 1999 as an environment map, and the sun as a disk of radiance.

   contents: >>colour >>sky >>sun >>position

   Everything is computed from published formulas: "A Practical Analytic Model for Daylight", A. J. Preetham, P. Shirley
   and B. Smits, SIGGRAPH 1999 (sky: section 4 and appendix A.2; the sun's attenuation: appendix A.1); the colour
   matching functions are the multi-lobe fits of C. Wyman, P.-P. Sloan and P. Shirley, "Simple Analytic Approximations
   to the CIE XYZ Color Matching Functions", JCGT 2013; the sun's place is the algorithm of M. Blanco-Muriel et al.,
   "Computing the Solar Vector", Solar Energy 2001.

   Units as Mitsuba's: spectral radiance averaged over the luminous efficiency, W/(m^2 sr nm). A luminance of
   683 lm/W * 106.857 nm = 72,983 cd/m^2 has Y = 1. */
#include "tracer.h"

#include <stdlib.h>
#include <string.h>

#define SKY_WIDTH 1024
#define SKY_HEIGHT 512
#define PI 3.14159265358979323846
#define LUMENS_PER_WATT 683.002
#define CIE_Y_INTEGRAL 106.856895                /* nm: the integral of the 1931 luminous efficiency */
#define SUN_HALF_ANGLE (0.5 * 0.5358 * PI / 180) /* its apparent diameter in the year's mean, 0.5358 degrees */

/* ---- >>colour ----------------------------------------------------------------------------------------------- */

static double lobe(double wavelength, double peak, double below, double above)
{
    double t = (wavelength - peak) * (wavelength < peak ? below : above);
    return exp(-0.5 * t * t);
}

/* Wyman et al. 2013, the multi-lobe fits to the CIE 1931 functions; wavelength in nm. */
static void colour_matching(double w, double xyz[3])
{
    xyz[0] = 0.362 * lobe(w, 442.0, 0.0624, 0.0374) + 1.056 * lobe(w, 599.8, 0.0264, 0.0323) -
             0.065 * lobe(w, 501.1, 0.0490, 0.0382);
    xyz[1] = 0.821 * lobe(w, 568.8, 0.0213, 0.0247) + 0.286 * lobe(w, 530.9, 0.0613, 0.0322);
    xyz[2] = 1.217 * lobe(w, 437.0, 0.0845, 0.0278) + 0.681 * lobe(w, 459.0, 0.0385, 0.0725);
}

/* Linear sRGB (IEC 61966-2-1); colours outside its gamut are clipped to it. */
static vec3 xyz_to_rgb(const double xyz[3])
{
    double r = 3.2406 * xyz[0] - 1.5372 * xyz[1] - 0.4986 * xyz[2],
           g = -0.9689 * xyz[0] + 1.8758 * xyz[1] + 0.0415 * xyz[2],
           b = 0.0557 * xyz[0] - 0.2040 * xyz[1] + 1.0570 * xyz[2];
    return v3((float)fmax(r, 0), (float)fmax(g, 0), (float)fmax(b, 0));
}

/* ---- >>sky -------------------------------------------------------------------------------------------------- */

/* Perez et al. 1993: relative luminance at zenith angle theta and angle gamma to the sun. */
static double perez(const double c[5], double cos_theta, double gamma, double cos_gamma)
{
    return (1 + c[0] * exp(c[1] / cos_theta)) * (1 + c[2] * exp(c[3] * gamma) + c[4] * cos_gamma * cos_gamma);
}

/* The three distributions (Y in cd/m^2, x, y), each with its zenith value over its value there. */
typedef struct preetham {
    double c[3][5], scale[3];
} preetham;

/* Preetham et al. 1999, appendix A.2. theta: the sun's angle from the zenith. */
static preetham preetham_model(double turbidity, double theta)
{
    static const double slope[3][5] = {{0.1787, -0.3554, -0.0227, 0.1206, -0.0670},
                                       {-0.0193, -0.0665, -0.0004, -0.0641, -0.0033},
                                       {-0.0167, -0.0950, -0.0079, -0.0441, -0.0109}},
                        offset[3][5] = {{-1.4630, 0.4275, 5.3251, -2.5771, 0.3703},
                                        {-0.2592, 0.0008, 0.2125, -0.8989, 0.0452},
                                        {-0.2608, 0.0092, 0.2102, -1.6537, 0.0529}};
    /* rows: turbidity^2, turbidity, 1; columns: theta^3, theta^2, theta, 1 */
    static const double zenith[2][3][4] = {{{0.00166, -0.00375, 0.00209, 0},
                                            {-0.02903, 0.06377, -0.03202, 0.00394},
                                            {0.11693, -0.21196, 0.06052, 0.25886}},
                                           {{0.00275, -0.00610, 0.00317, 0},
                                            {-0.04214, 0.08970, -0.04153, 0.00516},
                                            {0.15346, -0.26756, 0.06670, 0.26688}}};
    preetham m;
    double t = turbidity, chi = (4.0 / 9.0 - t / 120) * (PI - 2 * theta);
    m.scale[0] = 1000 * fmax(0, (4.0453 * t - 4.9710) * tan(chi) - 0.2155 * t + 2.4192);
    for (int i = 0; i < 2; ++i) {
        double sum = 0;
        for (int j = 0; j < 3; ++j) {
            const double *z = zenith[i][j];
            sum = sum * t + ((z[0] * theta + z[1]) * theta + z[2]) * theta + z[3];
        }
        m.scale[1 + i] = sum;
    }
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 5; ++j)
            m.c[i][j] = slope[i][j] * t + offset[i][j];
        m.scale[i] /= perez(m.c[i], 1, theta, cos(theta));
    }
    return m;
}

static vec3 preetham_radiance(const preetham *m, double cos_theta, double cos_gamma)
{
    double gamma = acos(fmin(fmax(cos_gamma, -1), 1)), v[3];
    for (int i = 0; i < 3; ++i)
        v[i] = m->scale[i] * perez(m->c[i], cos_theta, gamma, cos_gamma);
    double y = fmax(v[0], 0) / (LUMENS_PER_WATT * CIE_Y_INTEGRAL);
    if (!(v[2] > 1e-3))
        return v3s((float)y);
    double xyz[3] = {y * v[1] / v[2], y, y * (1 - v[1] - v[2]) / v[2]};
    return xyz_to_rgb(xyz);
}

static void fill_sky(const tr_sunsky *desc, double turbidity, vec3 sun, tr_image *image)
{
    /* A sun below the horizon is outside of the model: the sky of sunset is used. */
    preetham m = preetham_model(turbidity, acos(fmin(fmax(sun.y, 0), 1)));
    for (int y = 0; y < image->height / 2; ++y) { /* nothing comes from below */
        double theta = (y + 0.5) * PI / image->height, s = sin(theta), c = cos(theta);
        for (int x = 0; x < image->width; ++x) {
            double phi = (x + 0.5) / image->width * 2 * PI; /* the layout of light.c: from -z by +x */
            vec3 rgb = preetham_radiance(&m, c, s * sin(phi) * sun.x + c * sun.y - s * cos(phi) * sun.z);
            float *p = image->data + ((size_t)y * (size_t)image->width + (size_t)x) * 3;
            p[0] = rgb.x * desc->sky_scale;
            p[1] = rgb.y * desc->sky_scale;
            p[2] = rgb.z * desc->sky_scale;
        }
    }
}

/* ---- >>sun -------------------------------------------------------------------------------------------------- */

/* Spectral radiance of the sun's disk outside of the atmosphere, W/(m^2 sr nm): a black body of 5778 K, scaled to the
   solar constant of 1361 W/m^2. Fraunhofer lines and limb darkening are left out. */
static double sun_spectrum(double nm)
{
    const double h = 6.62607015e-34, c = 299792458, k = 1.380649e-23, sigma = 5.670374419e-8, t = 5778;
    double l = nm * 1e-9, angle = 2 * PI * (1 - cos(SUN_HALF_ANGLE));
    double planck = 2 * h * c * c / (l * l * l * l * l * (exp(h * c / (l * k * t)) - 1)) * 1e-9;
    return planck * 1361 / (sigma * t * t * t * t / PI * angle);
}

/* Share of the light that comes through (Preetham et al. 1999, appendix A.1, after Iqbal 1983). mass: relative optical
   mass. The absorption of mixed gases and water vapour is left out: it lies beyond 690 nm, where the eye is nearly
   blind. Ozone's visible (Chappuis) band is taken as a Gaussian of 0.13/cm at 600 nm and 52 nm wide. */
static double transmittance(double nm, double turbidity, double mass)
{
    double um = nm * 1e-3, beta = fmax(0, 0.04608 * turbidity - 0.04586), t = (nm - 600) / 52;
    double rayleigh = 0.008735 * pow(um, -4.08), aerosol = beta * pow(um, -1.3),
           ozone = 0.35 * 0.13 * exp(-0.5 * t * t);
    return exp(-(rayleigh + aerosol + ozone) * mass);
}

static vec3 sun_radiance(double turbidity, double cos_theta)
{
    double theta = acos(fmin(fmax(cos_theta, 0), 1));
    double mass = 1 / (cos(theta) + 0.15 * pow(93.885 - theta * 180 / PI, -1.253));
    double sum[3] = {0, 0, 0};
    for (int nm = 380; nm <= 780; nm += 2) {
        double cmf[3], l = sun_spectrum(nm) * transmittance(nm, turbidity, mass);
        colour_matching(nm, cmf);
        for (int i = 0; i < 3; ++i)
            sum[i] += 2 * cmf[i] * l / CIE_Y_INTEGRAL;
    }
    return xyz_to_rgb(sum);
}

/* The inverse of a transform's linear part; the identity where there is none. */
static mat4 linear_inverse(const mat4 *a)
{
    const float(*m)[4] = a->m;
    mat4 r;
    memset(&r, 0, sizeof r);
    r.m[3][3] = 1;
    double det = 0, c[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            c[i][j] = (double)m[i1][j1] * m[i2][j2] - (double)m[i1][j2] * m[i2][j1];
        }
    for (int j = 0; j < 3; ++j)
        det += m[0][j] * c[0][j];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            r.m[i][j] = fabs(det) > 0 ? (float)(c[j][i] / det) : (float)(i == j);
    return r;
}

bool tr_sunsky_lights(const tr_sunsky *desc, tr_light *sky, tr_light *sun)
{
    double turbidity = fmin(fmax(desc->turbidity, 2), 10);
    vec3 local = norm3(desc->sun_direction);
    sky->type = TR_LIGHT_ENVMAP;
    sky->value = v3s(1);
    sky->to_world = desc->to_world;
    sky->to_local = linear_inverse(&desc->to_world);
    if (!tr_image_alloc(&sky->image, SKY_WIDTH, SKY_HEIGHT, 3))
        return false;
    fill_sky(desc, turbidity, local, &sky->image);

    double radius = fmin(fmax(desc->sun_radius_scale, 1e-3) * SUN_HALF_ANGLE, 0.5 * PI);
    sun->type = TR_LIGHT_SUN;
    sun->direction = neg3(norm3(xform_vector(&desc->to_world, local)));
    sun->cutoff_cos = (float)cos(radius);
    if (sun->cutoff_cos >= 1)
        sun->cutoff_cos = 1 - 0x1p-24f;
    /* A larger disk sends the same power. Its angle is what the rounded cosine says, so that the power stays exact. */
    double spread = (1 - cos(SUN_HALF_ANGLE)) / (1 - (double)sun->cutoff_cos);
    sun->value = local.y > 0 ? scale3(sun_radiance(turbidity, local.y), (float)(desc->sun_scale * spread)) : v3s(0);
    return true;
}

/* ---- >>position --------------------------------------------------------------------------------------------- */

/* Blanco-Muriel et al. 2001 (the "PSA algorithm"), good to 0.01 degrees for the years 1999 to 2015 and to a few
   hundredths for a century around. Atmospheric refraction is left out, as there. */
vec3 tr_sun_direction(int year, int month, int day, float hour, float minute, float second, float latitude,
                      float longitude, float timezone)
{
    double hours = (double)hour - timezone + ((double)minute + second / 60.0) / 60.0;
    int64_t y = year, m = month, a = (m - 14) / 12;
    int64_t days =
        (1461 * (y + 4800 + a)) / 4 + (367 * (m - 2 - 12 * a)) / 12 - (3 * ((y + 4900 + a) / 100)) / 4 + day - 32075;
    double n = (double)days - 0.5 + hours / 24 - 2451545.0;

    double omega = 2.1429 - 0.0010394594 * n, mean_longitude = 4.8950630 + 0.017202791698 * n,
           anomaly = 6.2400600 + 0.0172019699 * n;
    double ecliptic =
        mean_longitude + 0.03341607 * sin(anomaly) + 0.00034894 * sin(2 * anomaly) - 0.0001134 - 0.0000203 * sin(omega);
    double obliquity = 0.4090928 - 6.2140e-9 * n + 0.0000396 * cos(omega);
    double ascension = atan2(cos(obliquity) * sin(ecliptic), cos(ecliptic)),
           declination = asin(sin(obliquity) * sin(ecliptic));

    double sidereal = 6.6974243242 + 0.0657098283 * n + hours; /* Greenwich, hours */
    double angle = (sidereal * 15 + longitude) * PI / 180 - ascension, phi = latitude * PI / 180;
    double theta = acos(fmin(fmax(cos(phi) * cos(angle) * cos(declination) + sin(declination) * sin(phi), -1), 1));
    double azimuth = atan2(-sin(angle), tan(declination) * cos(phi) - sin(phi) * cos(angle)); /* from north by east */
    theta += 6371.01 / 149597890.0 * sin(theta);                                              /* parallax */
    return v3((float)(sin(theta) * sin(azimuth)), (float)cos(theta), (float)(-sin(theta) * cos(azimuth)));
}
