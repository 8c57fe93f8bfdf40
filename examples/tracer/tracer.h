/* tracer.h: the example renderer's shared types: scene, surfaces, closures, lights, images, methods.

   contents: >>log >>image >>texture >>bsdf >>shape >>light >>scene >>surface >>closure >>lightquery
             >>vertex >>photon >>method >>render

   Conventions. World space, metres; radiance in W/m^2/sr per RGB channel (linear sRGB primaries). Directions are unit
   vectors that point away from the surface: wo towards the viewer, wi towards the light. A pdf is per steradian unless
   its comment says otherwise. Ids are indices into the scene's arrays; -1 means none. */
#ifndef TR_TRACER_H
#define TR_TRACER_H

#include <stdarg.h>
#include <stdio.h>

#include "embree.h"
#include "tmath.h"

#if defined(__GNUC__)
#define TR_PREFETCH(p) __builtin_prefetch(p)
/* For what is rare within a hot function: inlined it would cost the rest its registers. */
#define TR_NOINLINE __attribute__((noinline))
#else
#define TR_PREFETCH(p) ((void)(p))
#define TR_NOINLINE
#endif

/* ---- >>log -------------------------------------------------------------------------------------------------- */

typedef enum tr_level { TR_NOTE, TR_WARNING, TR_ERROR } tr_level;

/* Where messages about a scene go. Counted, so that a test can see that something was said; the first TR_LOG_SHOWN
   of each level are printed to `out` (NULL = silent). `last` keeps the newest message for tests. */
typedef struct tr_log {
    FILE *out;
    int notes, warnings, errors;
    char last[512];
    void (*on_file)(void *user, const char *path); /* told of every file that was read, in the same order each time */
    void *user;
} tr_log;
#define TR_LOG_SHOWN 40

/* file may be NULL; line 0 = no line. Prints "file:line: warning: text". */
void tr_message(tr_log *log, tr_level level, const char *file, int line, const char *format, ...);
void tr_file_used(tr_log *log, const char *path); /* called by the loaders */

/* ---- >>image ------------------------------------------------------------------------------------------------ */

/* Interleaved float pixels, row 0 on top; channels 1..4 (RGB = 3). */
typedef struct tr_image {
    int width, height, channels;
    float *data;
} tr_image;

/* One named group of channels to write to an EXR: names such as "R,G,B" for the main layer or "variance.R,variance.G,
   variance.B", "albedo.R,...", "cell.Y"; one name per channel of `image`, separated by commas. */
typedef struct tr_layer {
    const char *names;
    const tr_image *image;
    bool full_float; /* write 32-bit float instead of half (cell ids need it) */
} tr_layer;

/* Zeroed memory in large pages where the system has them: for what is read here and there, where each small page costs
   a walk through the page tables. Aligned to 64; free() frees it; NULL = none. */
void *tr_alloc_pages(size_t size);
bool tr_image_alloc(tr_image *image, int width, int height,
                    int channels); /* zeroed; false = out of memory or bad size */
void tr_image_free(tr_image *image);
/* Read the RGB (or Y) of an EXR (OpenEXR C core), or an LDR/HDR picture (stb_image; 8-bit files are decoded from sRGB
   to linear unless `raw`). On failure returns false and writes a one-line reason to err. Safe against broken files. */
bool tr_image_read(const char *path, bool raw, tr_image *image, char *err, size_t err_size);
/* The channels layer.R, layer.G, layer.B of an EXR, else layer.X, .Y, .Z, else layer.Y thrice; fails where there are
   none of these. */
bool tr_exr_read_layer(const char *path, const char *layer, tr_image *image, char *err, size_t err_size);
/* Half-float (or float) scanline EXR, ZIP compression, all layers of one size. */
bool tr_exr_write(const char *path, const tr_layer *layers, int layer_count, char *err, size_t err_size);
/* One string for an EXR's header; names of at most 31 characters that no standard attribute has. */
typedef struct tr_attribute {
    const char *name, *value;
} tr_attribute;
bool tr_exr_write_attributes(const char *path, const tr_layer *layers, int layer_count, const tr_attribute *attributes,
                             int attribute_count, char *err, size_t err_size);
/* One of them, cut where it does not fit; false = not an EXR, or it has no such string. */
bool tr_exr_read_attribute(const char *path, const char *name, char *value, size_t size);
/* Tone-mapped PNG: exposure, then sRGB curve, clipped. exposure <= 0 picks one from the image's mean luminance. */
bool tr_png_write(const char *path, const tr_image *image, float exposure, char *err, size_t err_size);
float tr_auto_exposure(const tr_image *image);
/* Average blocks so that `image` gets the size w x h; false unless w and h divide its size by the same whole factor. */
bool tr_image_downsample(const tr_image *image, int w, int h, tr_image *out);

/* Errors as the README states them: both images scaled by 0.5 / mean(reference), per pixel the mean over channels of
   (I-R)^2 / (R^2 + 0.01) and |I-R| / (R + 0.01). Trimmed drops the worst 0.1 % of pixels of each measure. */
typedef struct tr_error {
    double relmse, mrae; /* trimmed */
    double relmse_untrimmed, mrae_untrimmed;
} tr_error;
bool tr_image_error(const tr_image *image, const tr_image *reference, tr_error *error, char *err, size_t err_size);

/* ---- >>texture ---------------------------------------------------------------------------------------------- */

typedef enum tr_texture_type { TR_TEXTURE_BITMAP, TR_TEXTURE_CHECKERBOARD } tr_texture_type;
typedef enum tr_wrap { TR_WRAP_REPEAT, TR_WRAP_CLAMP, TR_WRAP_MIRROR } tr_wrap;

typedef struct tr_texture {
    tr_texture_type type;
    char *id;
    float uv[2][3];           /* u' = uv[0] . (u, v, 1), v' = uv[1] . (u, v, 1) */
    vec3 color0, color1;      /* checkerboard: color0 where floor(2u') + floor(2v') is even */
    tr_image image;           /* bitmap: linear RGB (3 channels); row 0 of the image is v = 1 */
    struct tr_texels *texels; /* the image once more, smaller, or NULL; textures that share pixels share it */
    tr_wrap wrap;
    bool nearest; /* else bilinear */
} tr_texture;

/* A picture of at most 256 different values, as those of 8-bit files have: codes into a palette. Blocks of 4 x 4 texels
   fill a cache line, since lookups are scattered and wait for memory more than for anything else. */
typedef struct tr_texels {
    float palette[256];
    uint8_t (*code)[4]; /* [ceil(height / 4)][ceil(width / 4)][4][4] of red, green, blue and nothing */
    size_t block_row;   /* texels in a row of blocks */
} tr_texels;
/* The compact form of an RGB image, NULL where there is none or no memory for it. */
tr_texels *tr_texels_make(const tr_image *image);
void tr_texels_free(tr_texels *texels);

vec3 tr_texture_eval(const tr_texture *texture, float u, float v);
/* Ask the cache for the texels that tr_texture_eval will read. */
void tr_texture_prefetch(const tr_texture *texture, float u, float v);
/* Derivative of the mean of channels to u and v, for bump maps. */
void tr_texture_gradient(const tr_texture *texture, float u, float v, float *du, float *dv);

/* A colour or number that may come from a texture; a number lies in value.x and a texture's mean channel. */
typedef struct tr_param {
    vec3 value;
    int texture; /* -1 = constant */
} tr_param;

/* ---- >>bsdf ------------------------------------------------------------------------------------------------- */

typedef enum tr_bsdf_type {
    TR_BSDF_DIFFUSE,
    TR_BSDF_CONDUCTOR,
    TR_BSDF_ROUGHCONDUCTOR,
    TR_BSDF_DIELECTRIC,
    TR_BSDF_ROUGHDIELECTRIC,
    TR_BSDF_THINDIELECTRIC,
    TR_BSDF_PLASTIC,
    TR_BSDF_ROUGHPLASTIC,
    TR_BSDF_PHONG,
    TR_BSDF_PBR,      /* glTF 2.0 metallic-roughness */
    TR_BSDF_TWOSIDED, /* child[0] in front, child[1] behind (-1 = child[0]) */
    TR_BSDF_MASK,     /* child[0] with probability opacity, else straight through */
    TR_BSDF_BUMPMAP   /* child[0] with its normal tilted by bump_texture */
} tr_bsdf_type;

typedef enum tr_distribution { TR_BECKMANN, TR_GGX } tr_distribution;

typedef struct tr_bsdf {
    tr_bsdf_type type;
    char *id;
    int line;                        /* where the scene file declares it */
    tr_param reflectance;            /* diffuse colour; PBR: base colour */
    tr_param specular_reflectance;   /* default 1 */
    tr_param specular_transmittance; /* default 1 */
    tr_param alpha;                  /* microfacet roughness; PBR: perceptual roughness */
    tr_param metallic;               /* PBR */
    tr_param exponent;               /* phong */
    tr_param opacity;                /* mask */
    vec3 eta, k;                     /* conductor: complex index of refraction over that of the outside, per channel */
    float ior;                       /* dielectric, plastic: interior over exterior index */
    tr_distribution distribution;
    bool nonlinear; /* plastic: colour shifts by internal scattering */
    int child[2];
    int bump_texture;
    float bump_scale;
    /* Filled by tr_bsdf_finish. */
    bool bumped;          /* this or a nested bsdf is a bump map with a texture */
    int first_texture;    /* what this or the first nested bsdf reads for its colour, to prefetch; -1 = none */
    float fdr_internal;   /* plastic: diffuse Fresnel reflectance from inside */
    float *transmittance; /* rough plastic: hemispherical transmittance over cos theta, TR_TRANSMITTANCE_SIZE entries */
    float transmittance_internal;
} tr_bsdf;
#define TR_TRANSMITTANCE_SIZE 64

void tr_bsdf_defaults(tr_bsdf *bsdf,
                      tr_bsdf_type type); /* Mitsuba's defaults: reflectance 0.5, alpha 0.1, BK7/air ... */

/* ---- >>shape ------------------------------------------------------------------------------------------------ */

/* Rectangle and cube are meshes; the others are analytic in object space: unit sphere at the origin, unit disk in
   z = 0 with normal +z, unit cylinder around z from z = 0 to 1. */
typedef enum tr_shape_type { TR_SHAPE_MESH, TR_SHAPE_SPHERE, TR_SHAPE_DISK, TR_SHAPE_CYLINDER } tr_shape_type;

/* A triangle of a light: one place in memory to read instead of an index and three vertices. */
typedef struct tr_emitter {
    vec3 p, e1, e2, n; /* corner, edges from it, unit front normal (flip_normals applied) */
} tr_emitter;

#define TR_PACKED 8 /* floats: x, y, z, u, v, and the normal's x, y, z */
typedef struct tr_shape {
    tr_shape_type type;
    char *id;
    int line;
    int bsdf, light; /* light: -1 or the area light on this shape */
    bool flip_normals;
    /* Mesh, world space. Geometric normal = cross(p1 - p0, p2 - p0), turned by flip_normals. */
    uint32_t vertex_count, triangle_count;
    float *positions;  /* [vertex_count + 1][3]: one vertex of padding for Embree */
    float *normals;    /* [vertex_count][3] or NULL = face normals */
    float *uvs;        /* [vertex_count][2] or NULL */
    uint32_t *indices; /* [triangle_count][3] */
    /* [vertex_count][TR_PACKED], filled by tr_scene_finish: positions, uvs and normals (0 where there are none) once
       more, so that a hit reads half a cache line for each corner of its triangle instead of three lines. */
    float *packed;
    /* Analytic, world space. The sphere has centre and radius (uniform scale); disk and cylinder keep the transforms.
     */
    mat4 object_to_world, world_to_object;
    vec3 center;
    float radius;
    float area;
    float *area_cdf; /* light meshes: [triangle_count + 1], 0 .. 1, and behind it what `emitters` points to */
    const struct tr_emitter *emitters; /* light meshes: [triangle_count] */
} tr_shape;

/* ---- >>light ------------------------------------------------------------------------------------------------ */

typedef enum tr_light_type {
    TR_LIGHT_AREA,        /* radiance, on the front side of its shape */
    TR_LIGHT_ENVMAP,      /* image [height][width][3] in the (theta, phi) layout of Mitsuba, turned by to_world */
    TR_LIGHT_CONSTANT,    /* radiance from everywhere */
    TR_LIGHT_POINT,       /* intensity W/sr at position */
    TR_LIGHT_SPOT,        /* intensity W/sr at position along direction, falling off from beam_cos to cutoff_cos */
    TR_LIGHT_DIRECTIONAL, /* irradiance W/m^2 along direction */
    TR_LIGHT_SUN          /* radiance within the cone cutoff_cos around -direction: a disk that rays can hit */
} tr_light_type;

typedef struct tr_light {
    tr_light_type type;
    int line;
    int shape;  /* area */
    vec3 value; /* radiance, intensity or irradiance */
    vec3 position;
    vec3 direction; /* spot, directional, sun: the way the light travels */
    float cutoff_cos, beam_cos;
    mat4 to_world, to_local;
    tr_image image; /* envmap, already scaled */
    /* Filled by tr_lights_finish. */
    float *marginal, *conditional; /* envmap: cumulative, [height + 1] and [height][width + 1] */
    float selection;               /* probability that light sampling picks this light */
} tr_light;

/* Fill `sky` (an envmap of width x height, upper hemisphere) and `sun` from Preetham et al. 1999. sun_direction points
   to the sun; `up` is +y unless to_world turns it. Values are in the W/m^2/sr-like units of Mitsuba's sunsky. */
typedef struct tr_sunsky {
    float turbidity;    /* 2 .. 10 */
    vec3 sun_direction; /* local space, y up */
    float sky_scale, sun_scale, sun_radius_scale;
    vec3 albedo;
    mat4 to_world;
} tr_sunsky;
bool tr_sunsky_lights(const tr_sunsky *desc, tr_light *sky, tr_light *sun); /* false = out of memory */
/* Local (y up) direction to the sun; Mitsuba's convention: east = x, south = z. */
vec3 tr_sun_direction(int year, int month, int day, float hour, float minute, float second, float latitude,
                      float longitude, float timezone);

/* ---- >>scene ------------------------------------------------------------------------------------------------ */

typedef enum tr_filter { TR_FILTER_BOX, TR_FILTER_TENT, TR_FILTER_GAUSSIAN } tr_filter;

/* Camera space as in Mitsuba: looking along +z, +y up, +x to the LEFT of the picture. */
typedef struct tr_camera {
    mat4 to_world;
    float fov;      /* degrees across `fov_axis` */
    int fov_axis;   /* 0 = x, 1 = y, 2 = diagonal, 3 = smaller, 4 = larger */
    float aperture; /* thin lens radius, 0 = pinhole */
    float focus;    /* distance of the focal plane */
} tr_camera;

typedef struct tr_scene {
    char *path;
    tr_texture *textures;
    int texture_count;
    tr_bsdf *bsdfs;
    int bsdf_count;
    tr_shape *shapes;
    int shape_count;
    tr_light *lights;
    int light_count;
    tr_camera camera;
    int width, height;
    tr_filter filter;
    int max_depth; /* path edges: 1 = only emitted light seen directly, -1 = unlimited (cut at TR_MAX_DEPTH) */
    bool hide_emitters;
    /* Filled by tr_scene_finish. */
    vec3 bounds_min, bounds_max;
    float bounds_radius;
    vec3 bounds_center;
    int *environment; /* ids of envmap, constant and sun lights */
    int environment_count;
    float *light_cdf; /* [light_count + 1] */
    float *power_cdf; /* [light_count + 1], by power alone, for photons; within light_cdf's memory */
    uint64_t triangles;
    RTCDevice device;
    RTCScene rtc;
} tr_scene;
#define TR_MAX_DEPTH 256

typedef struct tr_define {
    const char *name, *value; /* $name in the file */
} tr_define;

/* Load a Mitsuba XML (0.5, 0.6 or 3.0 spelling) or a .gltf/.glb file and finish it (lights, Embree). threads: for
   Embree's build, 0 = all. Returns NULL after an error was logged with file and line; warnings do not fail. */
tr_scene *tr_scene_load(const char *path, const tr_define *defines, int define_count, int threads, tr_log *log);
tr_scene *tr_scene_new(void); /* empty, camera and film at defaults; NULL = out of memory. For scenes built in code. */
/* Append a zeroed element (array grown), returning its id or -1 when out of memory. */
int tr_scene_add_texture(tr_scene *scene);
int tr_scene_add_bsdf(tr_scene *scene, tr_bsdf_type type);
int tr_scene_add_shape(tr_scene *scene);
int tr_scene_add_light(tr_scene *scene, tr_light_type type);
/* Check everything (indices in range, NaN vertices dropped with a warning, zero-area lights disabled with a warning),
   build bounds, light tables and the Embree scene. The loader has called it; scenes built in code call it once. */
bool tr_scene_finish(tr_scene *scene, int threads, tr_log *log);
void tr_scene_free(tr_scene *scene);

bool tr_bsdf_finish(tr_scene *scene, tr_bsdf *bsdf, tr_log *log); /* called by tr_scene_finish */
bool tr_lights_finish(tr_scene *scene, tr_log *log);              /* called by tr_scene_finish, before Embree */

/* ---- >>surface ---------------------------------------------------------------------------------------------- */

/* A point on a surface. ng and ns are unit, as the shape defines its front (not turned towards the ray). */
typedef struct tr_surface {
    vec3 p, ng, ns;
    float u, v;
    float t; /* distance along the ray */
    int shape;
    uint32_t prim;
    vec3 dpdu, dpdv;
} tr_surface;

/* Fill a surface from Embree's answer (ray.geomID valid). */
void tr_surface_from_hit(const tr_scene *scene, const struct RTCRayHit *hit, tr_surface *surface);
/* The same, but dpdu and dpdv are only valid where the shape's bsdf reads them (tr_bsdf.bumped). */
void tr_surface_from_hit_lean(const tr_scene *scene, const struct RTCRayHit *hit, tr_surface *surface);
/* Ask the cache for what tr_surface_from_hit will read: stage 0 some hits ahead, stage 1 (needs stage 0's) nearer. */
void tr_surface_prefetch(const tr_scene *scene, const struct RTCRayHit *hit, int stage);

/* ---- >>closure ---------------------------------------------------------------------------------------------- */

/* A bsdf at one point for one wo, textures and nested bsdfs resolved. A closure has a *delta part* (mirror, smooth
   glass, mask's gap) and a *smooth part*; delta_probability is how often to sample the delta part (0 = none, 1 =
   nothing else). Everything about the smooth part is conditional on having chosen it. */
typedef struct tr_closure {
    uint8_t type;         /* tr_bsdf_type, never a nesting one */
    uint8_t distribution; /* tr_distribution */
    uint8_t nonlinear;
    uint8_t transmits; /* smooth part reaches the far side of the surface */
    uint8_t bumped;    /* directions on different sides of base_n and frame.n count as blocked */
    float roughness;   /* 0 mirror .. 1 diffuse, for guiding records */
    float delta_probability;
    frame3 frame; /* shading frame; frame.n is bumped, and turned to wo for twosided and dielectrics */
    vec3 diffuse, specular, transmitted;
    float specular_probability; /* share of the smooth part's samples given to its glossy lobe */
    float gap_probability;      /* mask: share of the delta part that goes straight through */
    float opacity;
    vec3 base_n; /* frame.n without the bump map */
    vec3 wo;     /* local */
    /* Only where the type has them: */
    const tr_bsdf *bsdf;
    vec3 eta, k;
    float ior, alpha, exponent;
    /* Scratch that prepare computes once (Fresnel terms and the like). */
    float fresnel, scratch[3];
} tr_closure;

/* wo in world space. False where nothing scatters (black, or seen from behind a one-sided bsdf). */
bool tr_closure_prepare(const tr_scene *scene, const tr_surface *surface, vec3 wo, tr_closure *closure);
/* Ask the cache for what tr_closure_prepare will read first. */
void tr_closure_prefetch(const tr_scene *scene, const tr_surface *surface);
/* Smooth part: f (1/sr, without cosine) and, where pdf is not NULL, its sampling density. wi in world space.
   The cosine to use with f is |dot(closure->frame.n, wi)|. Zero outside its support. */
vec3 tr_closure_eval(const tr_closure *closure, vec3 wi, float *pdf);
/* Draw wi (world) from the smooth part; u in [0,1). False = no direction (count as zero). f, pdf as from eval. */
bool tr_closure_sample(const tr_closure *closure, float u_lobe, float u1, float u2, vec3 *wi, vec3 *f, float *pdf);
/* Draw from the delta part: weight = f cos / probability of this direction within the delta part. eta_scale: square
   of the relative index when the path refracts (1 otherwise), by which roulette corrects the throughput. */
bool tr_closure_sample_delta(const tr_closure *closure, float u, vec3 *wi, vec3 *weight, float *eta_scale);
vec3 tr_closure_albedo(const tr_closure *closure); /* approximate, for the albedo layer */
/* Draw where light goes on that came along wo: `to` (world) from the delta part (where u[0] < delta_probability) or the
   smooth part, and the share of flux that goes there over its probability. The adjoint of what camera paths see (Veach
   1997, 5.2 and 5.3): nothing gathers in the denser side, and a shading normal ns beside the geometric one ng counts
   as |wo.ns to.ng| / (|wo.ng to.ns|). u in [0,1)^4. False = absorbed. */
bool tr_closure_sample_adjoint(const tr_scene *scene, const tr_surface *surface, const tr_closure *closure,
                               const float u[4], vec3 *to, vec3 *weight, bool *delta);

/* ---- >>lightquery ------------------------------------------------------------------------------------------- */

typedef struct tr_light_sample {
    vec3 wi;
    float distance; /* to the light along wi; INFINITY for the environment, sun and directional lights */
    vec3 radiance;  /* arriving at p if nothing is between; for delta lights intensity / distance^2 or irradiance */
    float pdf;      /* per steradian, selection included; for delta lights the selection probability */
    bool delta;     /* no direction sampled by a bsdf or guide can hit it: no MIS */
    int light;
} tr_light_sample;

/* Pick a light and a direction to it. False when there is none or it cannot reach p (behind the emitter). */
bool tr_light_sample_direction(const tr_scene *scene, vec3 p, float u_select, float u1, float u2,
                               tr_light_sample *sample);
/* Density with which tr_light_sample_direction draws wi: hit = the light surface reached from p (area lights), NULL =
   the environment (sum over envmap, constant and sun). 0 where hit does not emit. */
float tr_light_pdf(const tr_scene *scene, vec3 p, vec3 wi, const tr_surface *hit);
/* Radiance leaving an emissive surface along wo (0 for others and behind). */
vec3 tr_surface_emission(const tr_scene *scene, const tr_surface *surface, vec3 wo);
/* Radiance arriving from the environment along direction (pointing away from the scene). */
vec3 tr_environment(const tr_scene *scene, vec3 direction);

/* Light on its way from a light source. */
typedef struct tr_emission {
    vec3 p, direction; /* the lights without a place start beyond the scene's bounds */
    vec3 ng;           /* front normal of an area light's surface, else 0 */
    vec3 flux;         /* W: power over the probability of this ray; its mean over all u is the power of all lights */
    bool distant;      /* from a light without a place */
    bool delta;        /* from a light that no camera path can hit */
    int light;
} tr_emission;

/* Draw a ray that leaves a light: the light by power, a point on it by area, a direction by cosine or by the
   environment map; those without a place shine through the shadow of the scene's bounding box. u in [0,1)^5: light,
   place, direction. False = none (no light has power, or a spot's rim). */
bool tr_light_emit(const tr_scene *scene, const float u[5], tr_emission *emission);

/* ---- >>vertex ----------------------------------------------------------------------------------------------- */

/* What a guiding method learns from: one path vertex whose next direction was traced. Delta vertices are left out; L
   passes through them. */
typedef struct tr_vertex {
    vec3 p, ng, ns, wo, wi;
    float distance;   /* along the path to the next vertex that is not delta: a mirror's picture lies behind it;
                         +INFINITY = the environment */
    vec3 next_normal; /* geometric normal there, 0 for the environment */
    vec3 L;           /* incident radiance estimate from wi: w_light Le + reflected, see README "What is recorded" */
    vec3 f;           /* smooth bsdf, without cosine */
    float cosine;     /* |dot(ns, wi)| */
    float roughness;
    float pdf_mix, pdf_bsdf, pdf_guide; /* per steradian; pdf_mix = alpha pdf_bsdf + (1 - alpha) pdf_guide, or what
                                           resampling divides by instead. All three hold the probability of taking the
                                           smooth part; pdf_guide 0 = not asked */
    float alpha;                        /* probability of bsdf sampling used here */
    vec3 pixel_weight;                  /* throughput before this vertex (all pdfs and roulette in) / pixel estimate */
    float u;                            /* time or wavelength feature in [0, 1) */
    uint32_t flags;                     /* TR_VERTEX_... */
} tr_vertex;
#define TR_VERTEX_REJECTED 1u /* the direction was refused before tracing: f = 0, L = 0 */
#define TR_VERTEX_FIRST 2u    /* first non-delta vertex seen by the camera */
#define TR_VERTEX_PASSES 4u   /* light also passes through: directions on both sides of ns */
#define TR_VERTEX_GUIDED 8u   /* the direction was drawn by the guide */

/* ---- >>photon ----------------------------------------------------------------------------------------------- */

typedef void (*tr_range_fn)(void *context, uint32_t begin, uint32_t end);
/* Calls fn on disjoint ranges covering [0, count) from several threads and returns when all are done. */
typedef void (*tr_parallel_fn)(void *user, uint32_t count, uint32_t grain, tr_range_fn fn, void *context);

/* Light that arrives at a surface that scatters, not only as a mirror or smooth glass does. The sum of flux over an
   area is the flux that arrives there (by the geometric normal): the surface reflects flux f |wi.ns| / |wi.ng| of it
   per area and steradian. */
typedef struct tr_photon {
    vec3 p;         /* where it arrives */
    vec3 wi;        /* unit, towards where it came from */
    vec3 flux;      /* W; the paths of a pass together carry the power of all lights */
    float distance; /* along the path to the vertex before it that is not delta, or the light: a mirror's picture lies
                       behind it; +INFINITY = the environment, a sun or directional light */
    vec3 ng, ns;    /* at p; ns as the bsdf turned it */
    int bounces;    /* surfaces it has left before, delta ones too */
    uint32_t flags; /* TR_PHOTON_..., 0 = what a guided direction from p can find */
    float u[5];     /* that tr_light_emit made its path's start of */
    float density;  /* of them, see emission.h; 1 = even */
} tr_photon;
#define TR_PHOTON_DIRECT 1u /* straight from a light, which next event estimation samples */
/* Light that no camera path gathers: a point's, spot's or directional light's through glass or mirrors, or any of
   theirs without next event estimation. */
#define TR_PHOTON_UNSEEN 2u

typedef struct tr_emission_map tr_emission_map;

/* Photon paths first .. first + count - 1 of pass `index`, whose paths are `total`. */
typedef struct tr_photon_pass {
    const tr_scene *scene;
    const tr_emission_map *emission; /* NULL = even */
    uint64_t seed;
    int index;
    uint64_t total, first;
    uint32_t count;
    int max_depth; /* path edges from light to camera, which takes one; <= 0 or > TR_MAX_DEPTH: TR_MAX_DEPTH */
    bool nee;      /* camera paths use next event estimation */
    tr_parallel_fn parallel; /* NULL = serial */
    void *parallel_user;
} tr_photon_pass;

typedef struct tr_photon_stats {
    uint64_t paths, photons, rays;
    uint64_t bad;                  /* dropped: weights that are NaN or infinite */
    double emitted[3], escaped[3]; /* W: that these paths began with; of it and what was reflected, what met nothing */
} tr_photon_stats;

#define TR_PHOTON_TILE 2048 /* paths of a tile; its photons come in one order, whatever the threads */
static inline int tr_photon_tiles(uint32_t count) { return (int)((count + TR_PHOTON_TILE - 1u) / TR_PHOTON_TILE); }

/* Takes n photons of a tile (0 .. tr_photon_tiles(count) - 1): called many times for a tile, by one thread at a time,
   for different tiles at once. False = out of memory. */
typedef bool (*tr_photon_fn)(void *user, int tile, const tr_photon *photons, int n);
/* Trace them. stats may be NULL, else they are added to. False = out of memory, here or there. */
bool tr_trace_photons(const tr_photon_pass *pass, tr_photon_fn take, void *user, tr_photon_stats *stats);

/* Add the irradiance (W/m^2) that the pass's photons bring, pixel by pixel, to a picture of 3 channels as the camera
   sees it; a lens counts as a pinhole. To look at; no filter, so as noisy as the photons are. False = out of memory. */
bool tr_photon_picture(const tr_photon_pass *pass, tr_image *picture);

/* ---- >>method ----------------------------------------------------------------------------------------------- */

typedef struct tr_option {
    const char *key, *value; /* from --set key=value */
    bool used;               /* a method marks what it understood; the rest is an error */
} tr_option;

typedef struct tr_method_env {
    const tr_scene *scene;
    int width, height;
    int tiles;        /* streams that record is called with: 0 .. tiles - 1 */
    int photon_tiles; /* the same of record_photons */
    bool nee;
    int train; /* samples per pixel after which the field is frozen; 0 = it learns while it renders */
    uint64_t seed;
    int threads; /* that `parallel` uses: for methods with threads of their own */
    tr_parallel_fn parallel;
    void *parallel_user;
    tr_option *options;
    int option_count;
} tr_method_env;

typedef struct tr_pass {
    int index, spp;
    bool last;    /* nothing is to be learned from it: the last one, or one after which learning would not pay */
    bool freezes; /* the training ends with it: what is learned now is what the picture is made with */
    float budget; /* share of the budget spent before this pass, 0 .. 1 */
} tr_pass;

/* A batch of vertices to look up; arrays of n. */
typedef struct tr_lookup {
    int n;
    const vec3 *p, *side, *wo; /* side: shading normal that light must be above; 0 where light also passes through */
    const float *roughness;
    const float (*u)[3]; /* random numbers in [0,1)^3 for stochastic lookup */
} tr_lookup;

/* One of several directions between which a method chooses. */
typedef struct tr_candidate {
    float pdf_bsdf, pdf_guide; /* per steradian */
    float f, cosine;           /* mean over channels of the smooth bsdf; 0 = no direction could be drawn */
} tr_candidate;
#define TR_MAX_CANDIDATES 8

typedef struct tr_method_stats {
    uint64_t samples, refused, cells, bytes;
    double extra_bytes; /* streams and scratch at their peak */
    char json[2048];    /* method-specific members, without braces; may be empty */
} tr_method_stats;

/* A guiding method. Handles have handle_size bytes, zero at first; they are found once a vertex, asked many times and
   copied where a path splits. Every function but find, sample, pdf, record and record_photons (one stream per
   thread at a time) is called by one thread. NULL entries are allowed everywhere but create and destroy: a method
   without find never guides. */
typedef struct tr_method {
    const char *name, *summary;
    size_t handle_size;
    bool learns; /* passes differ: combine them by variance instead of by spp */
    void *(*create)(tr_method_env *env, char *err, size_t err_size);
    void (*destroy)(void *method);
    /* false = this pass needs no records (nothing to learn any more). */
    bool (*begin_pass)(void *method, const tr_pass *pass);
    bool (*idle)(void *method); /* true = nothing would be guided in this pass: do not ask */
    /* Fill handles[i] and alpha[i], the probability of bsdf sampling; 1 = do not guide here. */
    void (*find)(void *method, const tr_lookup *lookup, void *handles, float *alpha);
    /* For the handles listed in index[0..n): direction and its density. pdf 0 = none. */
    void (*sample)(void *method, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi,
                   float *pdf);
    /* Density of wi[index[i]] under handles[index[i]], to pdf[index[i]]. */
    void (*pdf)(void *method, int n, const int *index, const void *handles, const vec3 *wi, float *pdf);
    /* Resampling: directions to draw at each guided vertex that is not diffuse, alpha of them from the bsdf; NULL: one,
       which is one-sample MIS. At most TR_MAX_CANDIDATES. resample chooses among n = candidates(): the index and in
       *pdf what to divide by, n where none can be taken. */
    int (*candidates)(void *method);
    int (*resample)(void *method, const void *handle, const tr_candidate *candidates, int n, float alpha, float u,
                    float *pdf);
    /* Make `to` as good as `from`, which find filled, until find fills it again; NULL = a copy of its bytes is. */
    void (*copy_handle)(void *to, const void *from);
    /* Mean radiance that the surface at each handle's vertex reflects, to radiance[i]; 0 = not known yet. */
    void (*reflected)(void *method, int n, const void *handles, float *radiance);
    bool (*record)(void *method, int tile, const tr_vertex *vertices, int n); /* false = out of memory */
    bool (*wants_records)(void *method, int tile);       /* false = this tile's records are not needed in this pass */
    void (*flush)(void *method);                         /* take in what the tiles recorded */
    bool (*end_pass)(void *method, const tr_pass *pass); /* learn; false = out of memory */
    void (*describe)(void *method, int n, const void *handles, float *cell, float *depth); /* for the picture layers */
    void (*set_pixel_estimate)(void *method, const tr_image *estimate);
    bool wants_pixel_estimate;
    /* Photon paths to trace after this pass's camera paths have been taken in, before end_pass; 0 = none. Asked only
       where end_pass follows. */
    uint64_t (*wants_photons)(void *method, const tr_pass *pass);
    const tr_emission_map *(*emission)(void *method); /* where these paths start, see emission.h */
    /* A tr_photon_fn: streams like record's, taken in by flush. */
    bool (*record_photons)(void *method, int tile, const tr_photon *photons, int n);
    void (*stats)(void *method, tr_method_stats *stats);
} tr_method;

const tr_method *tr_method_find(const char *name); /* NULL = unknown */
const tr_method *const *tr_method_list(void);      /* NULL-terminated */

/* ---- >>render ----------------------------------------------------------------------------------------------- */

/* Guided roulette compares what a vertex is expected to add with what its pixel needs (Vorba and Krivanek 2016): paths
   that promise little are ended by chance, paths that promise much go on as several. It asks the method, and is off
   where the method cannot tell. Throughput: product of albedos, from edge 5 on. */
typedef enum tr_roulette { TR_ROULETTE_GUIDED, TR_ROULETTE_OFF, TR_ROULETTE_THROUGHPUT } tr_roulette;

typedef struct tr_settings {
    int width, height; /* 0 = the scene's */
    int train;         /* samples per pixel that teach and are not in the picture; the field is frozen after them */
    int spp;           /* budget in samples per pixel, those of the training not counted, or 0 */
    double seconds;    /* budget in CPU seconds over all threads, learning and training included, or 0 */
    int max_depth;     /* 0 = the scene's */
    bool no_nee;
    bool no_bsdf_hits; /* emission counts only through NEE (for tests: NEE-only) */
    tr_roulette roulette;
    int threads; /* 0 = all */
    uint64_t seed;
    const tr_method *method;
    tr_option *options;
    int option_count;
    /* called between rounds with the share done (0 .. 1) and text; NULL = silent */
    void (*progress)(void *user, double done, const char *text);
    void *progress_user;
} tr_settings;

#define TR_MAX_PASSES 256
typedef struct tr_result {
    tr_image color, variance, albedo, normal, alpha, cell, depth; /* variance: of the pixel mean */
    int spp, passes, train_passes; /* train_passes: the first ones, which are not in the picture */
    double cpu_seconds, wall_seconds;
    double train_seconds; /* CPU seconds until the method had learned for the last time; what follows renders only */
    double trace_seconds, record_seconds, update_seconds, query_seconds; /* CPU seconds; shading is the rest */
    double photon_seconds;                                               /* CPU seconds, of none of those above */
    uint64_t rays, shadow_rays, paths;                                   /* of camera paths */
    uint64_t photon_paths, photon_rays;
    uint64_t photons;                    /* handed to the method */
    uint64_t split_paths, unsplit_paths; /* that guided roulette added; that it had no room for */
    uint64_t bad_samples;                /* NaN or infinite contributions dropped */
    tr_method_stats method;
    struct tr_pass_result {
        int spp;
        double weight, variance, cpu_seconds;
    } pass[TR_MAX_PASSES];
} tr_result;

bool tr_render(const tr_scene *scene, const tr_settings *settings, tr_result *result, char *err, size_t err_size);
void tr_result_free(tr_result *result);

#endif
