/* guide_photon.h 0.1: path guiding by photons, histograms in a hierarchical hash grid. Licence: MIT or Unlicense.

   In exactly one file, before including it:        #define GPH_IMPLEMENTATION
   Everywhere else only:                            #include "guide_photon.h"

   Photons traced from the lights find light that camera paths miss. This header counts them by place and direction:
   record what camera paths and photons met, accumulate, refine, then ask for directions and their densities. C99 or
   C++11, C standard library only (link with -lm).

       #define GPH_IMPLEMENTATION
       #include "guide_photon.h"
       int main(void)
       {
           static gph_desc desc; // zero: all defaults, the box comes from the first camera vertices
           gph_field *field; gph_stream *stream;
           if (gph_create(&desc, &field) || gph_stream_create(field, &stream))
               return 1;
           for (int pass = 0; pass < 4; ++pass) {
               gph_view view = gph_get_view(field);
               for (int i = 0; i < (2000 << pass); ++i) { // a "camera path" and a "photon" from a lamp around +z
                   float u = (float)(rand() & 0xffff) / 65536.0f, v = (float)(rand() & 0xffff) / 65536.0f;
                   float p[3] = {u, v, 0}, q[3] = {v, u, 0}, w[2] = {v, u}, d[3], lamp[3] = {u - 0.5f, v - 0.5f, 4};
                   gph_handle handle; gph_find(&view, p, NULL, NULL, &handle);
                   float pdf = gph_sample(&handle, w, d), L = d[2] > 0.97f ? 100.0f : 0.0f;
                   gph_vertex vertex = gph_make_vertex(p, L, pdf, pdf, 0, GPH_FROM_GUIDE);
                   gph_photon photon = gph_make_photon(q, lamp, 4, 1);
                   gph_record_vertices(stream, &vertex, 1);
                   gph_record_photons(stream, &photon, 1);
               }
               gph_accumulate(field, &stream, 1, NULL, NULL);
               gph_stream_clear(stream);
               gph_refine(field, NULL, NULL);
           }
           return gph_stream_destroy(stream), gph_destroy(field), 0;
       }

   CONTENTS (search for the tag)
     >>config    macros, versions              >>query   inline: find, sample, pdf
     >>types     descriptor, samples, results  >>batch   find, sample, pdf of arrays
     >>field     create, refine, stats         >>store   save, load, merge
     >>maps      features out, networks' maps in
     implementation:
     >>memory  >>histogram  >>grid  >>pivots  >>streams  >>accumulate  >>cloud  >>gate  >>split  >>recycle  >>repair
   >>weights
     >>publish  >>refine  >>life  >>exchange  >>batches  >>files  >>licence

   HOW IT WORKS
     Space is a hash grid of cubes, desc.grid_cells along the longest side of the box; the box is the descriptor's or
     that of the first camera vertices. Each cube is the root of a binary tree that cuts x, y, z in turn; its leaves are
     *voxels* [Zhu 2021a, 7.1]. Cubes are made where camera paths have vertices, and only voxels that a camera path
     touched are *valid* and take photons. A field has a *sampling part*, one flat relocatable block that queries read
     and only refine, gph_import_maps and load change, and a *building part* that accumulate writes.

     A voxel's histogram has rows x 2 rows bins of equal solid angle over (z, phi): z = cos of the polar angle in
     -1 .. 1, phi = atan2(y, x) in 0 .. 2 pi. Photons add their flux to the bin of the direction they came from: the
     share of a bin is what the bin holds of the light that arrives, radiance times cosine [eq. 8, 10]. Of all passes so
     far (S_t) and of all but the last (S_t-1) both flux and photon numbers (P_t, P_t-1) are kept.
     Density of a direction: (1 - e) learned + e/(4 pi), e = 0.01 (desc.uniform); it integrates to 1. Directions are
     unit, world space, away from the surface towards the light.

     Parallax: what is near is seen in another direction from each place of a voxel. A voxel's map lies on a sphere
     around its pivot, the voxel's middle, on which directions from any place within are mapped to those from the pivot
     and back, exactly (gph_to_pivot); the share e is even as seen from the pivot. 1 / radius is the mean of the
   photons' 1 / distance, each weighted by the flux of the others in its bin: what is sharp decides, for which it
   matters (a sun stays where it is, though more light comes from what is near); at most what keeps the voxel within 0.7
   radii. The photons of the first pass are counted twice, so that their radius is known. Later a voxel changes its
   pivot and radius only where its own ones would show light elsewhere by more than half a bin; what it has counted is
   moved bin by bin. Places beyond 0.8 radii, which only jitter leads to, are taken for those at 0.8.

     What is learned is the histogram after desc.repair, the classical filters of Table 1 that need no network, or the
     map that gph_import_maps wrote in its place. The Gaussian's width is chosen for each map by what its photons say of
     each other, anew when they have doubled or its voxel was split. Filters know that phi wraps and that the way over a
   pole goes on at phi + pi. A map is made anew when a third of its voxel's photons are new to it, that of a closed
   voxel (see Gate) not before it is tried again.

     Splits: a voxel that has seen more photons than split_photons sqrt(N / N_0) is halved, at most 3 levels a refine;
     N = photons so far, N_0 = of the first pass. (The paper has sqrt(2^t) in pass t, which is the same where passes
     double.) The photons of the first pass are kept until its refine, and cut at the median; later cuts are in the
     middle. Both halves inherit half of all sums and are invalid until a camera path touches them.
     Voxels that no camera path touched in desc.keep_passes passes are emptied; empty siblings become one, empty cubes
     go.

     Selection probability: handle.alpha is the probability to sample the BSDF; 1 means: do not guide here. The caller
     draws from the BSDF with alpha, else from gph_sample, and divides by alpha pdf_bsdf + (1 - alpha) gph_pdf.
       GPH_ALPHA_RATIO     L_bsdf / (L_bsdf + L_guide), means of contributions *not* divided by densities, each over the
                           vertices whose direction that strategy drew [eq. 14]; within 0.2 .. 0.8; both strategies need
                           desc.ratio_samples vertices.
       GPH_ALPHA_VARIANCE  minimum over a of V(a) = mean of g^2 / (p p_a), the second moment of the estimator with
                           selection probability a: g contribution, p what the direction was drawn with, p_a =
                           a pdf_bsdf + (1 - a) pdf_guide.
     Gate: a voxel closes (alpha 1) when its vertices show with 95 % confidence that V(1) <= (1 + gate_margin) V(a) for
     the best a. An open voxel closes at half the margin; a closed one is tried again after gate_probe passes, with its
     evidence dropped.

     With a normal, gph_find mirrors what lies below the surface up: p'(w) = p(w) + p(mirrored w), which is exact. There
     is no product with the cosine: photons already arrive with it.

   THE SAMPLES
     gph_vertex: one per non-delta vertex of a camera path, also where the field is not asked: it makes its voxel valid.
     contribution: mean over channels of f L cos, L as in the other headers: radiance from the sampled direction, not
     divided by a density. Zeros count. pdf_guide = 0: not evaluated. GPH_TOUCH_ONLY: only the position counts.
     sides: on which side its surface was met, so that gph_takes_photons can tell what of a thin wall nobody sees.
     gph_photon: one per hit of a photon on a non-delta surface. direction: to where it came from. flux: mean over
     channels of its path's power, W; not divided by the number of paths of the pass, so that paths of all passes count
     alike. distance: that it flew since the last non-delta surface or its light; INFINITY: from the environment or a
     sun. With next-event estimation leave out photons straight from a light that it samples.
     A pass's vertices go to accumulate before its photons or together with them: after a split they make halves valid.

   OPTIONS: see gph_desc. gph_resolve fills in defaults, gph_get_desc returns what a field uses.

   MEMORY
     n = bins (rows * rows * 2). Sampling part: 20 bytes per voxel, 3 n + 8 rows + 64 per map (1.58 times its
     half-floats), 8 per node, 24 to 48 per cube. Building part: 408 bytes per voxel; its histogram is nothing while
     empty, a list of 16 bytes per lit bin below 256 photons, 12 n bytes above. The first pass's photons wait in 36
     bytes each, at most desc.cloud_photons. refine makes a new sampling part beside the old one, whose memory is kept
     for the next, from the second on with up to a quarter to spare: as far as all this together stays, between
     refines, within 8 times the half-floats of all maps, which it does not where most histograms are dense. max_bytes
     bounds all of this together: beyond it cubes, histograms and splits are denied and counted. Allocation happens in
     create, stream_create, record, accumulate, refine, load; never in a query, and always from the calling thread.
     Stack: below 140 KB per call of refine and gph_import_maps, 8 KB for others.

   THREADS: each function has a tag.
     [any thread]   pure function on constant data
     [per stream]   different streams at the same time from different threads; one stream by one thread at a time
     [exclusive]    nothing else on this field at the same time
     No threads are started. Functions that take a gph_parallel_fn cut work by count and let the callback run it
     (NULL = serially). The result is bit-identical for any number of threads.

   ERRORS
     gph_result, 0 = ok; gph_result_string says which field to change. Asserts (GPH_ASSERT) catch programming errors.
     Bad samples (NaN, infinity, negative, >= 1e30, pdf_mix <= 0, zero direction, distance <= 0 or NaN) are refused and
     counted in gph_stats. A failed allocation leaves the field as it was before the call, except that samples that
     found no memory are lost (counted). gph_load checks size, version, byte order, checksum and every index before use.

   NUMERICAL LIMITS
     Cubes are numbered within +-2^20 of the box's lower corner on each axis; what lies farther out shares the outermost
     cubes (counted as clamped). Flux of a bin adds up in f32, pass by pass; it saturates at 1e37, photon numbers of a
     bin at 65535 a pass. A voxel needs a bin of more than 1e-30 W for a map. A map spans 2^40 between its largest and
   its smallest bin that is not zero.

   REFERENCES
     S. Zhu, Z. Xu, T. Sun, A. Kuznetsov, M. Meyer, H. W. Jensen, H. Su, R. Ramamoorthi 2021a, Photon-Driven Neural
     Reconstruction for Path Guiding. Equations without a name are from there.
     H. W. Jensen 1995, Importance Driven Path Tracing Using the Photon Map.
     J. Vorba, J. Krivanek 2016, Adjoint-Driven Russian Roulette and Splitting in Light Transport Simulation.
     S. Gortler, R. Grzeszczuk, R. Szeliski, M. Cohen 1996, The Lumigraph. (pull-push) */
#ifndef GUIDE_PHOTON_H
#define GUIDE_PHOTON_H

/* ---- >>config ----------------------------------------------------------------------------------------------- */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define GPH_VERSION 3 /* of the saved format */

#ifndef GPH_API /* linkage of the functions; e.g. static */
#define GPH_API extern
#endif
#ifndef GPH_QUERY /* qualifiers of the inline queries; e.g. __device__ static inline */
#define GPH_QUERY static inline
#endif
/* Other macros, read by the implementation only: GPH_ASSERT(x), GPH_MALLOC(n), GPH_FREE(p). */

#ifdef __cplusplus
extern "C" {
#endif

/* ---- >>types ------------------------------------------------------------------------------------------------ */

/* Results and their messages. */
#define GPH_RESULTS(X)                                                                                                 \
    X(GPH_OK, "ok")                                                                                                    \
    X(GPH_OUT_OF_MEMORY, "out of memory: lower desc.max_bytes or check desc.allocate")                                 \
    X(GPH_BAD_BOUNDS, "desc.bounds_min must not lie above desc.bounds_max, both finite")                               \
    X(GPH_BAD_OPTION, "an enum is out of range: desc.repair, .alpha_mode")                                             \
    X(GPH_BAD_RANGE, "a number in the descriptor is out of its range: see the comments of gph_desc")                   \
    X(GPH_BAD_ALLOCATOR, "set both desc.allocate and desc.release or neither")                                         \
    X(GPH_MISMATCH, "the fields' structures differ: merge between accumulate and refine, from one common ancestor")    \
    X(GPH_BUFFER_TOO_SMALL, "the buffer is too small: ask the _bound function")                                        \
    X(GPH_BAD_FILE, "not a saved field, or it is damaged")                                                             \
    X(GPH_BAD_VERSION, "saved by another version or on a machine of other byte order")                                 \
    X(GPH_CORRUPT, "the field does not hold together: memory was overwritten")

#define GPH_RESULT_ENUM(name, text) name,
typedef enum gph_result { GPH_RESULTS(GPH_RESULT_ENUM) GPH_RESULT_COUNT } gph_result;
#undef GPH_RESULT_ENUM

typedef enum gph_repair {
    GPH_REPAIR_DEFAULT,   /* = GPH_REPAIR_GAUSSIAN */
    GPH_REPAIR_NONE,      /* the raw histogram */
    GPH_REPAIR_GAUSSIAN,  /* blur by desc.sigma */
    GPH_REPAIR_PYRAMID,   /* down desc.pyramid_levels times by 2 x 2 means, up again with linear interpolation */
    GPH_REPAIR_PULL_PUSH, /* the same, but bins with photons keep their values [Gortler 1996] */
    GPH_REPAIR_COUNT_
} gph_repair;

typedef enum gph_alpha_mode {
    GPH_ALPHA_DEFAULT, /* = GPH_ALPHA_VARIANCE */
    GPH_ALPHA_FIXED,   /* stays desc.alpha */
    GPH_ALPHA_RATIO,   /* eq. 14 */
    GPH_ALPHA_VARIANCE /* least second moment */
} gph_alpha_mode;

/* Zero-initialise it; zero means the default. Fields named no_x switch a default behaviour off. */
typedef struct gph_desc {
    float bounds_min[3], bounds_max[3]; /* world-space box of the grid; all zero: from the first camera vertices */
    uint32_t grid_cells;     /* r_init, cubes along the box's longest side, 1 .. 1024; default 25 (the paper: 100) */
    uint32_t rows;           /* of a histogram, 16, 32 or 64; columns are twice as many; default 32 */
    float split_photons;     /* c of the split rule, 16 .. 1e9; default 500 */
    uint32_t max_levels;     /* of a cube's tree, 1 .. 24; default 18 */
    uint32_t keep_passes;    /* passes that an unread voxel is kept, 1 .. 1000; default 4 */
    uint32_t cloud_photons;  /* of the first pass that are kept for median splits, 1024 .. 2^28; default 2^21 */
    uint64_t max_bytes;      /* memory cap, see MEMORY; >= 2^20; default 2^30 */
    gph_repair repair;       /* of histograms before they are sampled */
    float sigma;             /* of the Gaussian, in bins; 0.01 .. 16; default 0 = chosen for each map, see >>repair */
    uint32_t pyramid_levels; /* 1 .. 5; default 3 */
    gph_alpha_mode alpha_mode;
    float alpha; /* start value (and fixed value) of the probability of BSDF sampling, 0.05 .. 1; default 0.5 */
    uint32_t ratio_samples; /* Q_thr of GPH_ALPHA_RATIO, 1 .. 1e9; default 64 */
    float uniform;          /* e, share of uniform sampling in the guide's density, 1e-4 .. 1; default 0.01 */
    bool no_gate;           /* guide in every voxel that has a map */
    float gate_margin;      /* V(1) / V(a) - 1 below which guiding does not pay, 0.001 .. 10; default 0.05 */
    uint32_t gate_probe;    /* passes until a closed voxel is tried again, 1 .. 1000; default 4 */
    void *(*allocate)(void *user, size_t size); /* default malloc; NULL on failure; 16-byte aligned; see MEMORY */
    void (*release)(void *user, void *pointer); /* default free; pointer may be NULL */
    void *user;
} gph_desc;

/* A vertex of a camera path. 32 bytes; see THE SAMPLES; densities in 1/sr. Filled by gph_make_vertex. */
typedef struct gph_vertex {
    float position[3];
    float contribution; /* mean over channels of f L cos */
    float pdf_mix;      /* what the direction was drawn with */
    float pdf_bsdf;
    float pdf_guide; /* 0 = not evaluated */
    uint16_t strategy;
    uint16_t sides; /* gph_sides of the normal towards wo; 0 = all */
} gph_vertex;
enum { GPH_FROM_BSDF, GPH_FROM_GUIDE, GPH_TOUCH_ONLY };
#define GPH_ALL_SIDES 63u

/* A hit of a photon. 32 bytes; see THE SAMPLES. Filled by gph_make_photon. */
typedef struct gph_photon {
    float position[3];
    float direction[3]; /* to where it came from; any length */
    float flux;         /* W */
    float nearness;     /* 1 / distance it flew; 0 = infinitely far; negative: will be refused */
} gph_photon;

typedef void (*gph_range_fn)(void *context, uint32_t begin, uint32_t end);
/* Calls fn on disjoint ranges that cover [0, count), of about grain, and returns when all are done. */
typedef void (*gph_parallel_fn)(void *user, uint32_t count, uint32_t grain, gph_range_fn fn, void *context);

typedef struct gph_field gph_field;
typedef struct gph_stream gph_stream;

/* Counters since create unless they say otherwise. No padding: a save holds it as it is. */
typedef struct gph_stats {
    uint64_t vertices;       /* accepted by accumulate */
    uint64_t photons;        /* taken by valid voxels */
    uint64_t unread;         /* photons where no camera path goes: dropped */
    uint64_t dark;           /* photons with flux 0: dropped */
    uint64_t refused;        /* bad vertices and photons; best 0 */
    uint64_t clamped;        /* positions more than 2^20 cubes away; best 0 */
    uint64_t lost;           /* samples that met a failed allocation; best 0 */
    uint64_t denied;         /* samples that met max_bytes; best 0 */
    uint64_t denied_splits;  /* for max_bytes, max_levels or floats that do not reach; best 0 */
    uint64_t splits;         /* voxels cut in two */
    uint64_t recycled;       /* voxels emptied because no camera path came */
    uint64_t built;          /* maps made from histograms */
    uint64_t skipped;        /* maps kept: fewer than a third of the photons are new to them */
    uint64_t imported;       /* maps written by gph_import_maps */
    uint64_t opened, closed; /* verdicts of the gate so far */
    uint64_t probed;         /* closed voxels tried again so far */
    uint64_t bytes;          /* both parts now */
    uint32_t passes;         /* calls of refine */
    uint32_t cubes, voxels;  /* now; of the sampling part */
    uint32_t maps;           /* voxels that can guide */
    uint32_t sparse;         /* voxels whose histogram is a list */
    uint32_t valid;          /* voxels that take photons */
    uint32_t levels;         /* of the deepest voxel */
    uint32_t open_voxels;    /* gate: guiding shown to pay */
    uint32_t closed_voxels;
    uint32_t unjudged_voxels; /* with a map, without verdict: they guide */
    float closed_share;       /* share of the last pass's vertices in closed voxels, 0 .. 1 */
    float mean_alpha;         /* over the last pass's vertices, 1 where nothing guides */
    float useful_share;       /* share of the last pass's photons that hit valid voxels, 0 .. 1 */
    float reserved;
} gph_stats;

/* ---- flat data of the sampling part (for queries and ports; not to be changed by callers) */

/* A voxel as queries see it, 20 bytes. */
typedef struct gph_voxel {
    uint32_t map;    /* GPH_NONE: nothing is known */
    float alpha;     /* probability of sampling the BSDF; 1 = do not guide */
    float photons;   /* that it has seen, half of its parents' counted */
    float reflected; /* see gph_handle */
    uint16_t gate;   /* GPH_GATE_... */
    uint16_t level;
} gph_voxel;
enum { GPH_GATE_UNJUDGED, GPH_GATE_OPEN, GPH_GATE_CLOSED };
#define GPH_NONE 0xffffffffu

/* A node of a cube's tree, 8 bytes. Leaf: link = GPH_LEAF + voxel. Else link = axis << 29 | index of the lower child;
   the upper one follows it. Positions below `split` go to the lower child. */
typedef struct gph_node {
    float split;
    uint32_t link;
} gph_node;
#define GPH_LEAF 0x80000000u

/* Pointers into one sampling part. Valid until the next exclusive call. A map: exact sums (64 bits, unit 2^-24) of the
   weights before each row of constant z and of all (rows + 1 of them), four floats: its pivot and nearness, see
   Parallax, zeros up to 64 bytes; sums of the weights before each 8 bins (bins / 8), then the weights, half-floats. */
typedef struct gph_view {
    const uint64_t *keys;  /* hash table of cubes: mask + 1 slots, GPH_NO_KEY = free */
    const uint32_t *roots; /* beside the keys: node */
    const gph_node *nodes;
    const gph_voxel *voxels;
    const unsigned char *maps;
    double origin[3], inverse_side;
    uint32_t mask, voxel_count;
    uint32_t rows, columns;
    uint32_t map_bytes; /* from one map to the next */
    float uniform;
    float side;
    uint32_t reserved;
} gph_view;
#define GPH_NO_KEY 0xffffffffffffffffull

/* ---- >>field ------------------------------------------------------------------------------------------------ */

/* Message that names what to change. [any thread] */
GPH_API const char *gph_result_string(gph_result result);

/* Check desc and write it with all defaults filled in to resolved (may be desc itself). [any thread] */
GPH_API gph_result gph_resolve(const gph_desc *desc, gph_desc *resolved);

/* An empty field: every query is uniform with alpha 1. *field = NULL on failure. [any thread] */
GPH_API gph_result gph_create(const gph_desc *desc, gph_field **field);
GPH_API void gph_destroy(gph_field *field); /* NULL is fine; streams are destroyed separately. [exclusive] */
GPH_API const gph_desc *gph_get_desc(const gph_field *field); /* resolved. [any thread] */
GPH_API gph_view gph_get_view(const gph_field *field);        /* for the queries. [any thread] */
GPH_API uint32_t gph_voxel_count(const gph_field *field);     /* of the sampling part. [any thread] */

/* A buffer of vertices and photons, one per image tile or batch, so that its content does not depend on threads. Grows
   in chunks, never copies. Must be destroyed before or after the field, with the same allocator alive. [any thread] */
GPH_API gph_result gph_stream_create(const gph_field *field, gph_stream **stream);
GPH_API void gph_stream_destroy(gph_stream *stream);        /* [per stream] */
GPH_API void gph_stream_clear(gph_stream *stream);          /* keeps its memory. [per stream] */
GPH_API uint64_t gph_stream_size(const gph_stream *stream); /* vertices and photons held. [per stream] */

/* Append. On GPH_OUT_OF_MEMORY the samples that did not fit are lost and counted; the stream stays usable.
   [per stream] */
GPH_API gph_result gph_record_vertices(gph_stream *stream, const gph_vertex *vertices, uint32_t count);
GPH_API gph_result gph_record_photons(gph_stream *stream, const gph_photon *photons, uint32_t count);

/* Add first the vertices, then the photons of streams[0], streams[1], ... in this order to the building part. May be
   called many times a pass. The first call with vertices fixes the grid's box where the descriptor gives none. Clear
   the streams afterwards. On GPH_OUT_OF_MEMORY some samples are lost and counted. [exclusive] */
GPH_API gph_result gph_accumulate(gph_field *field, gph_stream *const *streams, uint32_t count,
                                  gph_parallel_fn parallel, void *user);
/* A pass has ended: judge, split, recycle, then make what was learned the sampling part. Handles and views become
   invalid. On failure the sampling part stays; it may be called again: what was judged, split and recycled by then is
   not done twice. [exclusive] */
GPH_API gph_result gph_refine(gph_field *field, gph_parallel_fn parallel, void *user);

/* True when no voxel guides: a renderer may skip every query until the next refine. [any thread] */
GPH_API bool gph_all_closed(const gph_field *field);
/* True where a photon at this position would be kept in this pass; to end photon paths early. normal (NULL = none): of
   the surface, on the side that the photon came from; then false also where no camera path has met this side of
   anything in the voxel: such photons should not be recorded, a thin wall's other side may be in the sun. [any thread]
 */
GPH_API bool gph_takes_photons(const gph_field *field, const float position[3], const float *normal);
/* How many photons the voxel at this position has seen by the last accumulate, in the first pass 0 until its refine;
   negative where it takes none (gph_takes_photons). What another one would be worth there, to decide where to send
   them. [any thread] */
GPH_API double gph_photons_at(const gph_field *field, const float position[3], const float *normal);
/* How many camera vertices the voxel at this position has met, those of earlier passes faded by half a pass; 0 where
   there is none. How much it matters what is known there. [any thread] */
GPH_API double gph_vertices_at(const gph_field *field, const float position[3]);

GPH_API void gph_get_stats(const gph_field *field, gph_stats *stats); /* [any thread] */
/* Check every index and sum of both parts: GPH_OK, GPH_CORRUPT or GPH_OUT_OF_MEMORY. [any thread] */
GPH_API gph_result gph_validate(const gph_field *field);

/* ---- >>maps ------------------------------------------------------------------------------------------------- */

/* For networks that repair histograms, between refine and the next accumulate. Plain arrays; the result of the network
   replaces what desc.repair made, until a third of the voxel's photons are new. */

/* Write to voxels (NULL = only count) the voxels whose maps the last refine made anew and that a camera path touched in
   the pass before: those worth a network's time. Returns their number; writes at most capacity. [any thread] */
GPH_API uint32_t gph_changed_voxels(const gph_field *field, uint32_t *voxels, uint32_t capacity);
#define GPH_FEATURES 5
/* features [count][5][rows][columns]: S_t, S_t-1, P_t, P_t-1 [eq. 11], each divided by its mean (all zero where it has
   none), and B_t, 1 where a bin has photons. photons [count] (may be NULL): how many the voxel has seen, to choose an
   expert. Indices outside are written as zeros. [any thread] */
GPH_API void gph_export_maps(const gph_field *field, const uint32_t *voxels, uint32_t count, float *features,
                             float *photons);
/* maps [count][rows][columns], any scale; negative values and NaN count as 0, maps without any light are left out, as
   are voxels without a map. Views and handles stay valid, densities change. Returns how many were taken. [exclusive] */
GPH_API uint32_t gph_import_maps(gph_field *field, const uint32_t *voxels, uint32_t count, const float *maps,
                                 gph_parallel_fn parallel, void *user);

/* ---- >>store ------------------------------------------------------------------------------------------------ */

/* Bytes that gph_save writes. [any thread] */
GPH_API size_t gph_save_bound(const gph_field *field);
/* Write both parts, so that training can go on after load. *size = bytes written. [any thread] */
GPH_API gph_result gph_save(const gph_field *field, void *data, size_t capacity, size_t *size);
/* Restore. Options come from the save; desc (may be NULL) gives the allocator. The data need not be aligned and may
   come from an untrusted source. *field = NULL on failure. [any thread] */
GPH_API gph_result gph_load(const gph_desc *desc, const void *data, size_t size, gph_field **field);

/* Equal for fields whose grids have the same box and whose trees had the same splits at the last refine. */
GPH_API uint64_t gph_structure_id(const gph_field *field);
/* Add what source accumulated since its last refine. GPH_MISMATCH unless structure ids and options of the histograms
   are equal and both know their box. Cubes that only one of them has are fine. [exclusive] on field, source is only
   read. */
GPH_API gph_result gph_merge(gph_field *field, const gph_field *source, gph_parallel_fn parallel, void *user);

/* ---- >>query ------------------------------------------------------------------------------------------------ */

/* What sampling and densities need; about 88 bytes. */
typedef struct gph_handle {
    const uint16_t *weights; /* half-floats; NULL = uniform */
    const uint64_t *sums;    /* of the rows before */
    const uint64_t *blocks;  /* of the eights before */
    uint32_t voxel;          /* GPH_NONE: none */
    float alpha;             /* see Selection probability */
    float uniform;           /* e; 1 where there is no map */
    float scale;             /* density = scale * weight + uniform / (4 pi) */
    double share;            /* (1 - e) / sum of weights */
    uint32_t rows, columns;
    float normal[3];
    uint32_t surface; /* 1: normal is one, directions below are mirrored up */
    float reflected;  /* mean of contribution / pdf_mix in the voxel: the radiance that its surfaces reflect, W/m^2/sr;
                         0 = not known. What a path can still bring here, for Russian roulette [Vorba 2016] */
    float offset[3];  /* position relative to the map's pivot, in radii of its sphere; shorter than 1 */
} gph_handle;

#define GPH_PI 3.14159265358979324f
#define GPH_UNIFORM_PDF 0.0795774715459f /* 1 / (4 pi) */

/* Number of the cube of a position along an axis, 0 .. 2^21 - 1; NaN counts as the lowest. */
GPH_QUERY uint64_t gph_cube_number(double origin, double inverse_side, float x)
{
    double c = floor(((double)x - origin) * inverse_side);
    c = c > -1048576 ? c : -1048576;
    c = c < 1048575 ? c : 1048575;
    return (uint64_t)(c + 1048576);
}

/* Key of the cube of a position: 3 x 21 bits, so that no position can overflow it. [any thread] */
GPH_QUERY uint64_t gph_cube_key(const double origin[3], double inverse_side, const float position[3])
{
    return gph_cube_number(origin[0], inverse_side, position[0]) |
           gph_cube_number(origin[1], inverse_side, position[1]) << 21 |
           gph_cube_number(origin[2], inverse_side, position[2]) << 42;
}

/* Where to look for a key first. */
GPH_QUERY uint32_t gph_hash_key(uint64_t key)
{
    key = (key ^ key >> 29) * 0xbf58476d1ce4e5b9ull;
    return (uint32_t)(key >> 32);
}

/* Voxel of a position, GPH_NONE where there is none. [any thread] */
GPH_QUERY uint32_t gph_find_voxel(const gph_view *view, const float position[3])
{
    uint64_t key = gph_cube_key(view->origin, view->inverse_side, position);
    uint32_t slot = gph_hash_key(key) & view->mask, link;
    while (view->keys[slot] != key) {
        if (view->keys[slot] == GPH_NO_KEY)
            return GPH_NONE;
        slot = (slot + 1) & view->mask;
    }
    link = view->nodes[view->roots[slot]].link;
    if (!(link & GPH_LEAF)) {
        float split = view->nodes[view->roots[slot]].split;
        do {
            const gph_node *node = &view->nodes[(link & 0x1fffffffu) + !(position[link >> 29] < split)];
            split = node->split;
            link = node->link;
        } while (!(link & GPH_LEAF));
    }
    return link & ~GPH_LEAF;
}

/* Position moved at random by up to half a voxel: blurs the borders between voxels. u: 3 numbers in [0, 1). */
GPH_QUERY void gph_jitter(const gph_view *view, uint32_t voxel, const float position[3], const float u[3], float out[3])
{
    int level = view->voxels[voxel].level, k;
    for (k = 0; k < 3; ++k)
        out[k] = position[k] + (u[k] - 0.5f) * ldexpf(view->side, -((level + 2 - k) / 3));
}

/* Position relative to a pivot in radii 1 / nearness of the sphere around it, pulled within GPH_MOST_OFFSET of it. */
#define GPH_MOST_OFFSET 0.8f
GPH_QUERY void gph_offset(const float pivot[3], float nearness, const float position[3], float offset[3])
{
    float x = (position[0] - pivot[0]) * nearness, y = (position[1] - pivot[1]) * nearness;
    float z = (position[2] - pivot[2]) * nearness, l = x * x + y * y + z * z, f = 1;
    if (!(l <= GPH_MOST_OFFSET * GPH_MOST_OFFSET)) {
        f = l < 1e30f ? GPH_MOST_OFFSET / sqrtf(l) : 0;
        x = l < 1e30f ? x : 0; /* what is not finite must not meet the 0 */
        y = l < 1e30f ? y : 0;
        z = l < 1e30f ? z : 0;
    }
    offset[0] = x * f;
    offset[1] = y * f;
    offset[2] = z * f;
}

/* Direction from the offset to that from the pivot to the same point of the sphere, o + t w. Returns solid angle there
   per solid angle here: t^2 / s with s^2 = 1 - |o|^2 + (o . w)^2, t = s - o . w. Without offset nothing changes. */
GPH_QUERY float gph_to_pivot(const float offset[3], const float direction[3], float out[3])
{
    float b, l, s, t;
    if (!(offset[0] != 0 || offset[1] != 0 || offset[2] != 0)) { /* the rest would make NaN of infinity */
        memcpy(out, direction, 3 * sizeof *out);
        return 1;
    }
    b = (offset[0] * direction[0] + offset[1] * direction[1]) + offset[2] * direction[2];
    l = (offset[0] * offset[0] + offset[1] * offset[1]) + offset[2] * offset[2];
    s = sqrtf((1 - l) + b * b);
    t = s - b;
    out[0] = offset[0] + t * direction[0];
    out[1] = offset[1] + t * direction[1];
    out[2] = offset[2] + t * direction[2];
    t = t * t / s;
    return t < 8 ? t : 1; /* more only where the direction is not unit; NaN too */
}

/* The other way, in place: w - o, normalised. */
GPH_QUERY void gph_from_pivot(const float offset[3], float direction[3])
{
    float x = direction[0] - offset[0], y = direction[1] - offset[1], z = direction[2] - offset[2], f;
    if (!(offset[0] != 0 || offset[1] != 0 || offset[2] != 0))
        return;
    f = 1 / sqrtf((x * x + y * y) + z * z);
    direction[0] = x * f;
    direction[1] = y * f;
    direction[2] = z * f;
}

/* Handle of a voxel (GPH_NONE is fine), without a normal, seen from its map's pivot (from elsewhere: gph_see_from).
   [any thread] */
GPH_QUERY void gph_set_voxel(const gph_view *view, uint32_t voxel, gph_handle *handle)
{
    uint32_t map = voxel == GPH_NONE ? GPH_NONE : view->voxels[voxel].map, bins = view->rows * view->columns;
    memset(handle, 0, sizeof *handle);
    handle->voxel = voxel;
    handle->rows = view->rows;
    handle->columns = view->columns;
    handle->alpha = 1;
    handle->uniform = 1;
    handle->reflected = voxel == GPH_NONE ? 0 : view->voxels[voxel].reflected;
    if (map != GPH_NONE) {
        const unsigned char *p = view->maps + (size_t)map * view->map_bytes;
        handle->sums = (const uint64_t *)(const void *)p;
        handle->blocks = handle->sums + ((view->rows + 8) & ~7u);
        handle->weights = (const uint16_t *)(const void *)(handle->blocks + bins / 8);
        handle->alpha = view->voxels[voxel].alpha;
        handle->uniform = view->uniform;
        handle->share = (1 - (double)view->uniform) / (double)handle->sums[view->rows];
        handle->scale = (float)(handle->share * bins * 0.079577471545947668);
    }
}

/* See a handle from a position: gph_find does it itself, this is for gph_set_voxel. [any thread] */
GPH_QUERY void gph_see_from(gph_handle *handle, const float position[3])
{
    if (handle->weights) {
        const float *pivot = (const float *)(const void *)(handle->sums + handle->rows + 1);
        gph_offset(pivot, pivot[3], position, handle->offset);
    }
}

/* Voxel to sample from at a position; u as in gph_find. */
GPH_QUERY uint32_t gph_choose_voxel(const gph_view *view, const float position[3], const float *u)
{
    uint32_t voxel = gph_find_voxel(view, position), near;
    if (u && voxel != GPH_NONE) {
        float moved[3];
        gph_jitter(view, voxel, position, u, moved);
        near = gph_find_voxel(view, moved);
        voxel = near != GPH_NONE && view->voxels[near].map != GPH_NONE ? near : voxel;
    }
    return voxel;
}

/* Handle of a voxel, seen from a position, for the surface with this normal. */
GPH_QUERY void gph_set_place(const gph_view *view, uint32_t voxel, const float position[3], const float *normal,
                             gph_handle *handle)
{
    gph_set_voxel(view, voxel, handle);
    gph_see_from(handle, position);
    if (normal && normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] > 0.5f) {
        memcpy(handle->normal, normal, sizeof handle->normal);
        handle->surface = 1;
    }
}

/* Find what to sample from at a position. normal (NULL or zero = none, the full sphere): unit, on the side of the
   directions wanted. u (NULL = none): 3 random numbers for a stochastic lookup. [any thread] */
GPH_QUERY void gph_find(const gph_view *view, const float position[3], const float *normal, const float *u,
                        gph_handle *handle)
{
    gph_set_place(view, gph_choose_voxel(view, position, u), position, normal, handle);
}

/* A half-float >= 0 as an integer, unit 2^-24: sums of them are exact. */
GPH_QUERY uint64_t gph_weight(uint16_t half)
{
    uint32_t e = half >> 10, normal = e != 0;
    return (uint64_t)(normal << 10 | (half & 1023u)) << (e - normal);
}

/* Angle of (x, y) in turns, 0 .. 1, within 3e-11. No branches, so that queries overlap, and the same bins with any
   libm. */
GPH_QUERY double gph_turn(float x, float y)
{
    double ax = fabs((double)x), ay = fabs((double)y), most = ax > ay ? ax : ay, least = ax > ay ? ay : ax;
    int far = least > most * 0.41421356237309505; /* tan(pi / 8): from there as an angle to the diagonal */
    double t = (least - (far ? most : 0)) / ((most > 0 ? most : 1) + (far ? least : 0)), z = t * t, a;
    a = -0.14234379165354208 + z * (0.1053519219492079 + z * -0.05946057042973548);
    a = t + t * z * (-0.33333302847401997 + z * (0.19997888092958457 + z * a));
    a = a * 0.15915494309189535 + (far ? 0.125 : 0);
    a = ay > ax ? 0.25 - a : a;
    a = x < 0 ? 0.5 - a : a;
    return y < 0 ? 1 - a : a;
}

/* Bin of a direction (unit). NaN lands in a bin too. */
GPH_QUERY uint32_t gph_bin(uint32_t rows, uint32_t columns, const float direction[3])
{
    float z = (direction[2] + 1) * (0.5f * (float)rows);
    double c = gph_turn(direction[0], direction[1]) * columns; /* in double: no more rounding */
    z = z > 0 ? z : 0;
    z = z < (float)(rows - 1) ? z : (float)(rows - 1);
    c = c > 0 ? c : 0;
    c = c < columns - 1 ? c : columns - 1;
    return (uint32_t)z * columns + (uint32_t)c;
}

GPH_QUERY float gph_pdf_sphere(const gph_handle *handle, const float direction[3])
{
    float seen[3], scale;
    if (!handle->weights)
        return GPH_UNIFORM_PDF;
    scale = gph_to_pivot(handle->offset, direction, seen);
    return scale * (handle->scale * (float)gph_weight(handle->weights[gph_bin(handle->rows, handle->columns, seen)]) +
                    handle->uniform * GPH_UNIFORM_PDF);
}

/* Mirror about the surface. */
GPH_QUERY void gph_mirror(const gph_handle *handle, const float d[3], float out[3])
{
    const float *n = handle->normal;
    float c = 2 * (d[0] * n[0] + d[1] * n[1] + d[2] * n[2]);
    int k;
    for (k = 0; k < 3; ++k)
        out[k] = d[k] - c * n[k];
}

/* Density of a direction (unit), 1/sr; 0 below the surface where the handle has one. [any thread] */
GPH_QUERY float gph_pdf(const gph_handle *handle, const float direction[3])
{
    float other[3];
    if (!handle->surface)
        return gph_pdf_sphere(handle, direction);
    if (direction[0] * handle->normal[0] + direction[1] * handle->normal[1] + direction[2] * handle->normal[2] < -1e-6f)
        return 0; /* what gph_sample mirrored may lie below by rounding */
    gph_mirror(handle, direction, other);
    return gph_pdf_sphere(handle, direction) + gph_pdf_sphere(handle, other);
}

/* Probability of what lies before entry i of sums, each of so many bins. */
GPH_QUERY double gph_until(const gph_handle *handle, const uint64_t *sums, uint32_t i, uint32_t bins)
{
    return handle->share * (double)sums[i] +
           (double)handle->uniform / (double)(handle->rows * handle->columns) * (double)(i * bins);
}

/* Last of the entries first, ..., first + count - 1 before which lies at most x. count: a power of two. Three out of
   four at a time, and without a branch to guess wrong. */
GPH_QUERY uint32_t gph_search(const gph_handle *handle, const uint64_t *sums, uint32_t first, uint32_t count,
                              uint32_t bins, double x)
{
    uint32_t step = count / 4;
    for (; step; step /= 4) {
        uint32_t steps = (uint32_t)(gph_until(handle, sums, first + step, bins) <= x) +
                         (uint32_t)(gph_until(handle, sums, first + 2 * step, bins) <= x) +
                         (uint32_t)(gph_until(handle, sums, first + 3 * step, bins) <= x);
        first += steps * step;
        count /= 4;
    }
    return count == 2 ? first + (uint32_t)(gph_until(handle, sums, first + 1, bins) <= x) : first;
}

/* Where in a bin, 0 .. 1: not on its edges, where rounding would carry a direction into the next bin, whose density may
   be far lower. So directions within 2e-5 of a bin's width come to lie at that distance. */
GPH_QUERY double gph_inside(double v)
{
    v = v > 2e-5 ? v : 2e-5;
    return v < 1 - 2e-5 ? v : 1 - 2e-5;
}

/* A direction being drawn: row of bins, then eight of its bins, then a bin. */
typedef struct gph_draw {
    uint32_t row, block; /* of eights, in the map */
    float z;
    double x; /* what is left of the probability, row and eights found so far included */
} gph_draw;

/* The row by u[0], for a handle with weights. */
GPH_QUERY void gph_draw_row(const gph_handle *handle, const float u[2], gph_draw *draw)
{
    double low, mass;
    draw->row = gph_search(handle, handle->sums, 0, handle->rows, handle->columns, (double)u[0]);
    low = gph_until(handle, handle->sums, draw->row, handle->columns);
    mass = gph_until(handle, handle->sums, draw->row + 1, handle->columns) - low;
    draw->z = (float)(2 * (draw->row + gph_inside(((double)u[0] - low) / mass)) / handle->rows - 1);
    draw->x = low + (double)u[1] * mass;
}

GPH_QUERY void gph_draw_block(const gph_handle *handle, gph_draw *draw)
{
    uint32_t blocks = handle->columns / 8;
    draw->block = gph_search(handle, handle->blocks, draw->row * blocks, blocks, 8, draw->x);
    draw->x -= gph_until(handle, handle->blocks, draw->block, 8);
}

/* The bin, and phi, -pi .. pi: floats are finer there. */
GPH_QUERY float gph_draw_phi(const gph_handle *handle, const gph_draw *draw)
{
    const uint16_t *weights = handle->weights + draw->block * 8;
    double each = (double)handle->uniform / (double)(handle->rows * handle->columns), until = 0, low = 0, turn;
    uint32_t j, in = 0;
    for (j = 0; j < 7; ++j) {
        until += handle->share * (double)gph_weight(weights[j]) + each;
        in += (uint32_t)(until <= draw->x);
        low = until <= draw->x ? until : low;
    }
    turn = gph_inside((draw->x - low) / (handle->share * (double)gph_weight(weights[in]) + each));
    turn = (draw->block * 8 + in - draw->row * handle->columns + turn) / handle->columns;
    return (float)(6.28318530717958648 * (turn < 0.5 ? turn : turn - 1));
}

/* The direction, seen from the handle's position and above its surface. Returns its density. */
GPH_QUERY float gph_draw_end(const gph_handle *handle, float z, float phi, float direction[3])
{
    float r = 1 - z * z;
    r = sqrtf(r > 0 ? r : 0);
    direction[0] = r * cosf(phi);
    direction[1] = r * sinf(phi);
    direction[2] = z;
    gph_from_pivot(handle->offset, direction);
    if (handle->surface &&
        direction[0] * handle->normal[0] + direction[1] * handle->normal[1] + direction[2] * handle->normal[2] < 0) {
        float other[3];
        gph_mirror(handle, direction, other);
        memcpy(direction, other, sizeof other);
    }
    return gph_pdf(handle, direction);
}

/* Direction (unit) from u in [0, 1)^2: as seen from the map's pivot z grows with u[0], and phi with u[1] where z stays
   in one row of bins (so before mirroring). Returns the density of the direction after rounding. [any thread] */
GPH_QUERY float gph_sample(const gph_handle *handle, const float u[2], float direction[3])
{
    gph_draw draw;
    if (!handle->weights)
        return gph_draw_end(handle, 2 * u[0] - 1, 2 * GPH_PI * u[1], direction);
    gph_draw_row(handle, u, &draw);
    gph_draw_block(handle, &draw);
    return gph_draw_end(handle, draw.z, gph_draw_phi(handle, &draw), direction);
}

/* Sides of the axes that a surface with this normal (unit) shows to: bits of -x, +x, -y, ... Never two opposite ones.
   All for NULL or zero, as where light passes through. [any thread] */
GPH_QUERY uint32_t gph_sides(const float *normal)
{
    uint32_t sides = 0, k;
    for (k = 0; normal && k < 3; ++k)
        sides |= normal[k] > 0.4f ? 2u << 2 * k : normal[k] < -0.4f ? 1u << 2 * k : 0;
    return sides ? sides : GPH_ALL_SIDES;
}

/* A vertex from scalars; its sides may be set then. strategy: GPH_FROM_BSDF, GPH_FROM_GUIDE (which of them drew the
   direction), GPH_TOUCH_ONLY. [any thread] */
GPH_QUERY gph_vertex gph_make_vertex(const float position[3], float contribution, float pdf_mix, float pdf_bsdf,
                                     float pdf_guide, uint32_t strategy)
{
    gph_vertex v;
    memcpy(v.position, position, sizeof v.position);
    v.contribution = contribution;
    v.pdf_mix = pdf_mix;
    v.pdf_bsdf = pdf_bsdf;
    v.pdf_guide = pdf_guide;
    v.strategy = (uint16_t)strategy;
    v.sides = 0;
    return v;
}

/* A photon: direction to where it came from, distance it flew (INFINITY = from the environment), flux in W. Its
   normal is not needed: histograms cover the sphere. [any thread] */
GPH_QUERY gph_photon gph_make_photon(const float position[3], const float direction[3], float distance, float flux)
{
    gph_photon p;
    memcpy(p.position, position, sizeof p.position);
    memcpy(p.direction, direction, sizeof p.direction);
    p.flux = flux;
    p.nearness = distance > 0 ? 1 / distance : -1; /* -1: will be refused, NaN too */
    return p;
}

/* ---- >>batch ------------------------------------------------------------------------------------------------ */

/* The queries for arrays. index lists the entries to process in all arrays (NULL = 0 .. count - 1); strides are in
   bytes. normals, u and alpha (dense floats) of find may be NULL. Handles are dense. Results equal those of the single
   queries. [any thread] */
GPH_API void gph_find_batch(const gph_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gph_handle *handles, float *alpha);
GPH_API void gph_sample_batch(const gph_view *view, uint32_t count, const uint32_t *index, const gph_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t direction_stride, float *pdf);
GPH_API void gph_pdf_batch(const gph_view *view, uint32_t count, const uint32_t *index, const gph_handle *handles,
                           const float *directions, size_t direction_stride, float *pdf);

#ifdef __cplusplus
}
#endif

#endif /* GUIDE_PHOTON_H */

/* ============================================== IMPLEMENTATION ============================================== */

#if defined(GPH_IMPLEMENTATION) && !defined(GPH_IMPLEMENTATION_DONE)
#define GPH_IMPLEMENTATION_DONE

/* Based on the papers listed under REFERENCES; no other code. */

#include <stdlib.h>

#ifndef GPH_ASSERT
#include <assert.h>
#define GPH_ASSERT(x) assert(x)
#endif
#ifndef GPH_MALLOC
#define GPH_MALLOC(n) malloc(n)
#define GPH_FREE(p) free(p)
#endif

/* What decides structure must not depend on contraction into fused multiply-adds. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#if defined(__GNUC__) || defined(__clang__)
#define GPHI_PREFETCH(p) __builtin_prefetch(p)
#else
#define GPHI_PREFETCH(p) ((void)(p))
#endif

#define GPHI_MAX_ROWS 64u
#define GPHI_MAX_BINS (GPHI_MAX_ROWS * GPHI_MAX_ROWS * 2)
#define GPHI_SPARSE 256u       /* entries from which on a histogram is dense */
#define GPHI_BATCH 32768u      /* samples sorted at once */
#define GPHI_NEW_LEVELS 3u     /* of a voxel in one refine [Zhu 2021a, 7.1] */
#define GPHI_MAX_VALUE 9.9e29f /* flux or contribution from here on is a bad sample */
#define GPHI_MAX_SUM 1e37f     /* of a bin */
#define GPHI_MIN_LIT 1e-30f    /* a histogram without a bin above this has no map: filters would underflow */
#define GPHI_MAX_ROOT 1e15     /* contributions are clamped to this before squaring */
#define GPHI_CONFIDENCE 1.645  /* one-sided 95 % of the normal distribution */
#define GPHI_MIN_CLOSE 64.0    /* effective samples for the verdict "does not pay" */
#define GPHI_MIN_OPEN 4.0      /* for "pays" */
#define GPHI_MIN_SEEN 32.0     /* vertices of a voxel, those of earlier passes faded, for its reflected radiance */
#define GPHI_MAX_VOXELS (1u << 26)
#define GPHI_GROUP 16u      /* positions looked up together */
#define GPHI_MOST_REACH 0.7 /* a voxel lies within so many radii of its pivot: the sphere is made larger for it */
/* Instead of a voxel in a batch. */
#define GPHI_BAD 0xfffffffeu
#define GPHI_DARK 0xfffffffdu

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

static void *gphi_default_allocate(void *user, size_t size)
{
    (void)user;
    return GPH_MALLOC(size);
}

static void gphi_default_release(void *user, void *pointer)
{
    (void)user;
    GPH_FREE(pointer);
}

/* count * size bytes, zeroed; NULL on failure or overflow. */
static void *gphi_allocate(const gph_desc *desc, uint64_t count, size_t size)
{
    void *p;
    if (count > (uint64_t)((size_t)-1 / 2) / size)
        return NULL;
    if (count == 0)
        count = 1;
    p = desc->allocate(desc->user, (size_t)count * size);
    if (p)
        memset(p, 0, (size_t)count * size);
    return p;
}

static void gphi_release(const gph_desc *desc, void *pointer)
{
    if (pointer)
        desc->release(desc->user, pointer);
}

/* An array with room for `need` entries of `size` bytes, the first `used` of them kept: the old one where it is large
   enough, else a new one with twice the capacity. NULL = out of memory, the old one stays. */
static void *gphi_grown(const gph_desc *desc, void *old, uint32_t used, uint32_t *capacity, uint32_t need, size_t size)
{
    uint64_t n = *capacity ? *capacity : 16;
    void *p;
    if (need <= *capacity)
        return old;
    while (n < need)
        n *= 2;
    p = gphi_allocate(desc, n, size);
    if (!p)
        return NULL;
    if (used)
        memcpy(p, old, used * size);
    gphi_release(desc, old);
    *capacity = (uint32_t)n;
    return p;
}

static void gphi_run(gph_parallel_fn parallel, void *user, uint32_t count, uint32_t grain, gph_range_fn fn,
                     void *context)
{
    if (parallel && count > grain)
        parallel(user, count, grain, fn, context);
    else if (count)
        fn(context, 0, count);
}

static bool gphi_finite(float x) { return x - x == 0; }

/* ---- >>histogram -------------------------------------------------------------------------------------------- */

#define GPHI_GATE 4 /* values of a at which V(a) is estimated; the last is 1 */

/* Sums over vertices. f64; saved as it is, so no padding. */
typedef struct gphi_sums {
    double count;                       /* that V has seen */
    double q_bsdf, l_bsdf;              /* number and contributions of what the BSDF drew [eq. 14] */
    double q_guide, l_guide;            /* and of what the guide drew */
    double flow;                        /* contributions / p of all these: what surfaces reflect */
    double pairs, near_pairs;           /* of photons: flux times that of others in its bin; times 1 / distance */
    double v[GPHI_GATE], vv[GPHI_GATE]; /* sums of x_a = g^2 / (p p_a), and of x_a^2 */
    double cross[GPHI_GATE - 1];        /* of x_a x_1 */
} gphi_sums;

typedef enum gphi_form { GPHI_FORM_EMPTY, GPHI_FORM_SPARSE, GPHI_FORM_DENSE } gphi_form;

/* What building knows of a voxel beside its histogram. Saved as it is, so no padding. */
typedef struct gphi_state {
    gphi_sums now, held; /* of this pass; of all passes before, faded */
    double photons;      /* M, half of the parents' counted */
    uint32_t level;      /* of the leaf in its cube's tree */
    uint32_t touched;    /* vertices in this pass */
    uint32_t unread;     /* passes without a vertex */
    uint32_t fresh;      /* photons since `map` was made, half of the parents' counted */
    uint32_t valid;      /* sides of surfaces that take photons, 0 = none */
    uint32_t form;       /* gphi_form */
    uint32_t entries;    /* of a list */
    uint32_t rolled;     /* pass whose photons `now` of the histogram holds */
    uint32_t map;        /* in the sampling part; GPH_NONE */
    uint32_t changed;    /* bit 0: photons since `map` was made; 1: the last refine made it, and it is read */
    uint32_t verdict;    /* GPH_GATE_... */
    uint32_t probe;      /* closed: passes until the next try */
    uint32_t blocked;    /* found no memory: passing */
    float alpha;         /* learned */
    float reflected;     /* mean of contribution / p when there were enough vertices last, 0 = there were not yet */
    float chosen;        /* photons when the Gaussian's sigma was chosen; 0 = it is to be chosen */
    float pivot[3];      /* where its histogram is seen from */
    float nearness;      /* 1 / radius of the sphere around it on which the histogram lies; 0 = infinitely large */
} gphi_state;

/* A lit bin of a list, which is ordered by bin. */
typedef struct gphi_entry {
    float old, now; /* flux of all passes before, and of this one */
    uint16_t bin, spare;
    uint16_t count_old, count_now; /* photons */
} gphi_entry;

typedef struct gphi_voxel {
    gphi_state s;
    void *data;        /* gphi_entry [capacity], or float old[n], now[n], uint16_t count_old[n], count_now[n] */
    uint32_t capacity; /* of a list */
    uint32_t sigma;    /* 1 + index of the Gaussian's sigma that was chosen last; 0 = none */
} gphi_voxel;

typedef struct gphi_dense {
    float *old, *now;
    uint16_t *count_old, *count_now;
} gphi_dense;

static gphi_dense gphi_dense_of(const gphi_voxel *v, uint32_t bins)
{
    gphi_dense d;
    d.old = (float *)v->data;
    d.now = d.old + bins;
    d.count_old = (uint16_t *)(void *)(d.now + bins);
    d.count_now = d.count_old + bins;
    return d;
}

static size_t gphi_data_bytes(const gphi_voxel *v, uint32_t bins)
{
    return v->s.form == GPHI_FORM_DENSE ? (size_t)bins * 12 : (size_t)v->capacity * sizeof(gphi_entry);
}

/* Position of the first entry whose bin is not below `bin`. */
static uint32_t gphi_entry_at(const gphi_entry *e, uint32_t count, uint32_t bin)
{
    uint32_t low = 0, high = count;
    while (low < high) {
        uint32_t middle = (low + high) / 2;
        if (e[middle].bin < bin)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* A bin that may hold something. */
typedef struct gphi_bin {
    float *old, *now;
    uint16_t *count_old, *count_now;
    uint32_t at;
} gphi_bin;

static gphi_bin gphi_get_bin(const gphi_voxel *v, uint32_t bins, uint32_t i)
{
    gphi_bin b;
    if (v->s.form == GPHI_FORM_DENSE) {
        gphi_dense d = gphi_dense_of(v, bins);
        b.old = d.old + i;
        b.now = d.now + i;
        b.count_old = d.count_old + i;
        b.count_now = d.count_now + i;
        b.at = i;
    } else {
        gphi_entry *e = (gphi_entry *)v->data + i;
        b.old = &e->old;
        b.now = &e->now;
        b.count_old = &e->count_old;
        b.count_now = &e->count_now;
        b.at = e->bin;
    }
    return b;
}

/* How many of them there are. */
static uint32_t gphi_bins(const gphi_voxel *v, uint32_t bins)
{
    return v->s.form == GPHI_FORM_DENSE ? bins : v->s.form == GPHI_FORM_SPARSE ? v->s.entries : 0;
}

static float gphi_sum(float a, float b) { return a + b < GPHI_MAX_SUM ? a + b : GPHI_MAX_SUM; }

/* So many photons to one bin; there is room. Returns the flux that was there before. */
static float gphi_add(gphi_voxel *v, uint32_t bins, uint32_t at, float flux, uint32_t count)
{
    float before;
    gphi_bin b;
    uint32_t i = at;
    v->s.photons += count;
    v->s.fresh = v->s.fresh < 0xffffffffu - count ? v->s.fresh + count : 0xffffffffu;
    if (v->s.form == GPHI_FORM_SPARSE) {
        gphi_entry *e = (gphi_entry *)v->data;
        i = gphi_entry_at(e, v->s.entries, at);
        if (i == v->s.entries || e[i].bin != at) {
            memmove(e + i + 1, e + i, (v->s.entries - i) * sizeof *e);
            memset(e + i, 0, sizeof *e);
            e[i].bin = (uint16_t)at;
            v->s.entries++;
        }
    }
    b = gphi_get_bin(v, bins, i);
    before = *b.old + *b.now;
    *b.now = gphi_sum(*b.now, flux);
    *b.count_now = (uint16_t)(*b.count_now + count < 65535 ? *b.count_now + count : 65535);
    return before;
}

/* A new pass begins: what was new is old now. Photon numbers keep their ratios where one outgrows 16 bits. */
static void gphi_roll(gphi_voxel *v, uint32_t bins, uint32_t pass)
{
    uint32_t i, n = gphi_bins(v, bins), most = 0, shift = 0;
    if (v->s.rolled == pass)
        return;
    v->s.rolled = pass;
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, bins, i);
        most = (uint32_t)*b.count_old + *b.count_now > most ? (uint32_t)*b.count_old + *b.count_now : most;
    }
    while (most >> shift > 65535)
        ++shift;
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, bins, i);
        *b.old = gphi_sum(*b.old, *b.now);
        *b.now = 0;
        *b.count_old = (uint16_t)(((uint32_t)*b.count_old + *b.count_now + shift) >> shift);
        *b.count_now = 0;
    }
}

/* Half of everything, for a child that inherits; photons stay where there were some. */
static void gphi_halve(gphi_voxel *v, uint32_t bins)
{
    uint32_t i, n = gphi_bins(v, bins);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, bins, i);
        *b.old *= 0.5f;
        *b.now *= 0.5f;
        *b.count_old = (uint16_t)((*b.count_old + 1) / 2);
        *b.count_now = (uint16_t)((*b.count_now + 1) / 2);
    }
    v->s.photons *= 0.5;
    v->s.fresh /= 2;
    v->s.chosen = 0; /* half as large, other light */
}

/* Give a voxel room for `more` entries. bytes: what that took. False: out of memory, nothing changed. */
static bool gphi_room(const gph_desc *desc, gphi_voxel *v, uint32_t bins, uint32_t more, uint64_t *bytes)
{
    uint32_t i, need = v->s.entries + more;
    gphi_voxel fresh = *v;
    *bytes = 0;
    if (v->s.form == GPHI_FORM_DENSE || (v->s.form == GPHI_FORM_SPARSE && need <= v->capacity))
        return true;
    if (more < GPHI_SPARSE && need < GPHI_SPARSE) {
        fresh.capacity = v->capacity ? v->capacity : 8;
        while (fresh.capacity < need)
            fresh.capacity *= 2;
        fresh.s.form = GPHI_FORM_SPARSE;
    } else {
        fresh.s.form = GPHI_FORM_DENSE;
        fresh.capacity = 0;
    }
    fresh.data = gphi_allocate(desc, gphi_data_bytes(&fresh, bins), 1);
    if (!fresh.data)
        return false;
    if (fresh.s.form == GPHI_FORM_DENSE) {
        gphi_dense d = gphi_dense_of(&fresh, bins);
        for (i = 0; i < v->s.entries; ++i) {
            const gphi_entry *e = (const gphi_entry *)v->data + i;
            d.old[e->bin] = e->old;
            d.now[e->bin] = e->now;
            d.count_old[e->bin] = e->count_old;
            d.count_now[e->bin] = e->count_now;
        }
        fresh.s.entries = 0;
    } else if (v->s.entries)
        memcpy(fresh.data, v->data, v->s.entries * sizeof(gphi_entry));
    *bytes = gphi_data_bytes(&fresh, bins) - gphi_data_bytes(v, bins);
    gphi_release(desc, v->data);
    *v = fresh;
    return true;
}

/* ---- >>grid ------------------------------------------------------------------------------------------------- */

typedef struct gphi_cube {
    uint64_t key;
    uint32_t root; /* node */
    uint32_t spare;
} gphi_cube;

/* A photon of the first pass. No padding: a save holds it as it is. */
typedef struct gphi_cloud_photon {
    gph_photon photon;
    uint32_t voxel;
} gphi_cloud_photon;

/* The sampling part: this, then what the offsets say. */
typedef struct gphi_block {
    uint64_t size, keys_at, roots_at, nodes_at, voxels_at, maps_at;
    double origin[3], side;
    uint32_t slots, nodes, voxels, maps;
    uint32_t rows, map_bytes;
    float uniform;
    uint32_t reserved;
} gphi_block;

struct gph_field {
    gph_desc desc;
    gph_stats stats;
    uint32_t bins, map_bytes;
    double origin[3], side; /* side 0: the box is not known yet */
    gphi_cube *cubes;
    uint32_t *slots; /* of the hash table: cube, GPH_NONE = free */
    gph_node *nodes;
    gphi_voxel *voxels;
    uint32_t cube_count, cube_capacity, slot_count;
    uint32_t node_count, node_capacity, voxel_count, voxel_capacity;
    gphi_cloud_photon *cloud;
    uint32_t cloud_count, cloud_capacity;
    uint32_t cloud_closed;
    uint32_t judged;                    /* a refine could not publish: its other steps are done */
    uint32_t mapped;                    /* voxels with a histogram */
    uint64_t data_bytes;                /* of histograms */
    uint64_t first_photons;             /* N_0 */
    uint64_t pass_photons, pass_useful; /* photons seen and taken in this pass */
    uint64_t structure;
    gphi_block *block, *spare;         /* spare: the one before, to be written again; NULL = none */
    uint64_t block_bytes, spare_bytes; /* that they have room for */
    uint32_t guiding;                  /* voxels of the sampling part with alpha < 1 */
};

/* Bytes of both parts. */
static uint64_t gphi_held(const gph_field *f)
{
    return sizeof *f + f->block_bytes + f->spare_bytes + f->data_bytes + (uint64_t)f->cube_capacity * sizeof *f->cubes +
           (uint64_t)f->slot_count * 4 + (uint64_t)f->node_capacity * sizeof *f->nodes +
           (uint64_t)f->voxel_capacity * sizeof *f->voxels + (uint64_t)f->cloud_capacity * sizeof *f->cloud;
}

/* Give the memory for the next sampling part back. */
static void gphi_drop_spare(gph_field *f)
{
    gphi_release(&f->desc, f->spare);
    f->spare = NULL;
    f->spare_bytes = 0;
}

/* The same when the next refines have made a sampling part and another one beside it. */
static uint64_t gphi_bytes(const gph_field *f)
{
    uint64_t part = (uint64_t)f->mapped * f->map_bytes + (uint64_t)f->voxel_count * sizeof(gph_voxel) +
                    (uint64_t)f->node_count * sizeof(gph_node) + (uint64_t)f->cube_count * 48 + 1024;
    return gphi_held(f) - f->block_bytes - f->spare_bytes + (part > f->block_bytes ? part : f->block_bytes) +
           (part > f->spare_bytes ? part : f->spare_bytes);
}

static bool gphi_fits(const gph_field *f, uint64_t more) { return gphi_bytes(f) + more <= f->desc.max_bytes; }

/* Growing an array doubles it for a while. */
static uint64_t gphi_growth(uint32_t capacity, uint32_t need, size_t size)
{
    return need > capacity ? (uint64_t)(need > 16 ? need : 16) * 2 * size : 0;
}

/* Cube with this key, GPH_NONE. */
static uint32_t gphi_find_cube(const gph_field *f, uint64_t key)
{
    uint32_t slot;
    if (!f->slot_count)
        return GPH_NONE;
    for (slot = gph_hash_key(key) & (f->slot_count - 1); f->slots[slot] != GPH_NONE;
         slot = (slot + 1) & (f->slot_count - 1))
        if (f->cubes[f->slots[slot]].key == key)
            return f->slots[slot];
    return GPH_NONE;
}

static uint64_t gphi_key(const gph_field *f, const float position[3])
{
    return gph_cube_key(f->origin, 1 / f->side, position);
}

/* Leaf of the building part at a position, GPH_NONE. */
static uint32_t gphi_find_leaf(const gph_field *f, const float position[3])
{
    uint32_t cube = f->side > 0 ? gphi_find_cube(f, gphi_key(f, position)) : GPH_NONE, node;
    if (cube == GPH_NONE)
        return GPH_NONE;
    for (node = f->cubes[cube].root; !(f->nodes[node].link & GPH_LEAF);) {
        uint32_t link = f->nodes[node].link;
        node = (link & 0x1fffffffu) + !(position[link >> 29] < f->nodes[node].split);
    }
    return node;
}

static uint32_t gphi_find(const gph_field *f, const float position[3])
{
    uint32_t node = gphi_find_leaf(f, position);
    return node == GPH_NONE ? GPH_NONE : f->nodes[node].link & ~GPH_LEAF;
}

static void gphi_cube_box(const gph_field *f, uint32_t cube, double low[3], double high[3])
{
    uint32_t k;
    for (k = 0; k < 3; ++k) {
        low[k] = f->origin[k] + f->side * ((double)(f->cubes[cube].key >> (21 * k) & 0x1fffffu) - 1048576.0);
        high[k] = low[k] + f->side;
    }
}

static void gphi_put_slot(gph_field *f, uint32_t cube)
{
    uint32_t slot = gph_hash_key(f->cubes[cube].key) & (f->slot_count - 1);
    while (f->slots[slot] != GPH_NONE)
        slot = (slot + 1) & (f->slot_count - 1);
    f->slots[slot] = cube;
}

/* A hash table of the cubes with at least half of its slots free for `count` cubes. */
static bool gphi_hash_cubes(gph_field *f, uint32_t count)
{
    uint32_t n = 16, i, *slots;
    while (n < 2 * count)
        n *= 2;
    if (n > f->slot_count) {
        slots = (uint32_t *)gphi_allocate(&f->desc, n, sizeof *slots);
        if (!slots)
            return false;
        gphi_release(&f->desc, f->slots);
        f->slots = slots;
        f->slot_count = n;
    } else if (f->cube_count && count > f->cube_count)
        return true; /* room for one more */
    memset(f->slots, 0xff, f->slot_count * sizeof *f->slots);
    for (i = 0; i < f->cube_count; ++i)
        gphi_put_slot(f, i);
    return true;
}

static void gphi_state_init(gphi_state *s, float alpha, uint32_t pass)
{
    memset(s, 0, sizeof *s);
    s->map = GPH_NONE;
    s->alpha = alpha;
    s->rolled = pass;
}

/* Room for so many more cubes, nodes and voxels. */
static gph_result gphi_reserve(gph_field *f, uint32_t cubes, uint32_t nodes, uint32_t voxels)
{
    void *p;
    if (f->voxel_count + voxels > GPHI_MAX_VOXELS)
        return GPH_OUT_OF_MEMORY;
    p = gphi_grown(&f->desc, f->cubes, f->cube_count, &f->cube_capacity, f->cube_count + cubes, sizeof *f->cubes);
    if (!p && f->cube_count + cubes > 0)
        return GPH_OUT_OF_MEMORY;
    f->cubes = (gphi_cube *)p;
    p = gphi_grown(&f->desc, f->nodes, f->node_count, &f->node_capacity, f->node_count + nodes, sizeof *f->nodes);
    if (!p)
        return GPH_OUT_OF_MEMORY;
    f->nodes = (gph_node *)p;
    p = gphi_grown(&f->desc, f->voxels, f->voxel_count, &f->voxel_capacity, f->voxel_count + voxels, sizeof *f->voxels);
    if (!p)
        return GPH_OUT_OF_MEMORY;
    f->voxels = (gphi_voxel *)p;
    return cubes && !gphi_hash_cubes(f, f->cube_count + cubes) ? GPH_OUT_OF_MEMORY : GPH_OK;
}

/* A new cube with one empty voxel; GPH_NONE where there is no memory, denied where max_bytes forbids it. */
static uint32_t gphi_add_cube(gph_field *f, uint64_t key, bool *denied)
{
    uint64_t more = gphi_growth(f->cube_capacity, f->cube_count + 1, sizeof *f->cubes) +
                    gphi_growth(f->node_capacity, f->node_count + 1, sizeof *f->nodes) +
                    gphi_growth(f->voxel_capacity, f->voxel_count + 1, sizeof *f->voxels) + 256;
    gphi_voxel *v;
    *denied = !gphi_fits(f, more);
    if (*denied || gphi_reserve(f, 1, 1, 1))
        return GPH_NONE;
    f->cubes[f->cube_count].key = key;
    f->cubes[f->cube_count].root = f->node_count;
    f->cubes[f->cube_count].spare = 0;
    f->nodes[f->node_count].split = 0;
    f->nodes[f->node_count].link = GPH_LEAF | f->voxel_count;
    v = &f->voxels[f->voxel_count];
    memset(v, 0, sizeof *v);
    gphi_state_init(&v->s, f->desc.alpha, f->stats.passes);
    gphi_put_slot(f, f->cube_count);
    f->cube_count++;
    f->node_count++;
    return f->voxel_count++;
}

/* Origin and side from a box, which may be empty: then cubes are as small as floats there allow. */
static void gphi_set_box(gph_field *f, const float low[3], const float high[3])
{
    double extent = 0, far = 0;
    int k;
    for (k = 0; k < 3; ++k) {
        f->origin[k] = (double)low[k];
        extent = fmax(extent, (double)high[k] - (double)low[k]);
        far = fmax(far, fmax(fabs((double)low[k]), fabs((double)high[k])));
    }
    f->side = fmax(extent / f->desc.grid_cells, fmax(far * 1.2e-7, 1e-30));
}

/* Cut a leaf in two. The lower half keeps the voxel, the upper one is a new one; both inherit half of the sums and of
   the histogram, and the map. */
static gph_result gphi_cut(gph_field *f, uint32_t node, uint32_t axis, float split)
{
    uint32_t low = f->nodes[node].link & ~GPH_LEAF, k;
    uint64_t bytes = gphi_data_bytes(&f->voxels[low], f->bins);
    gphi_voxel *a, *b;
    void *data = NULL;
    if (bytes) {
        data = gphi_allocate(&f->desc, bytes, 1);
        if (!data)
            return GPH_OUT_OF_MEMORY;
    }
    if (gphi_reserve(f, 0, 2, 1)) {
        gphi_release(&f->desc, data);
        return GPH_OUT_OF_MEMORY;
    }
    a = &f->voxels[low];
    b = &f->voxels[f->voxel_count];
    for (k = 0; k < sizeof(gphi_sums) / sizeof(double); ++k) {
        ((double *)(void *)&a->s.held)[k] *= 0.5;
        ((double *)(void *)&a->s.now)[k] *= 0.5;
    }
    gphi_halve(a, f->bins);
    a->s.level++;
    *b = *a;
    b->data = data;
    if (bytes) {
        memcpy(data, a->data, (size_t)bytes);
        f->data_bytes += bytes;
        f->mapped++;
    }
    f->nodes[f->node_count].split = f->nodes[f->node_count + 1].split = 0;
    f->nodes[f->node_count].link = GPH_LEAF | low;
    f->nodes[f->node_count + 1].link = GPH_LEAF | f->voxel_count;
    f->nodes[node].split = split;
    f->nodes[node].link = axis << 29 | f->node_count;
    f->node_count += 2;
    f->voxel_count++;
    f->stats.splits++;
    return GPH_OK;
}

/* Whether max_bytes allows to cut this voxel. */
static bool gphi_cut_fits(const gph_field *f, const gphi_voxel *v)
{
    uint64_t more = gphi_growth(f->node_capacity, f->node_count + 2, sizeof *f->nodes) +
                    gphi_growth(f->voxel_capacity, f->voxel_count + 1, sizeof *f->voxels) +
                    gphi_data_bytes(v, f->bins) + 2 * (uint64_t)f->map_bytes + 64;
    return gphi_fits(f, more);
}

/* Photons from which on a voxel is cut: c sqrt(N / N_0). */
static double gphi_threshold(const gph_field *f)
{
    double ratio = f->first_photons ? (double)f->stats.photons / (double)f->first_photons : 1;
    return (double)f->desc.split_photons * sqrt(ratio > 1 ? ratio : 1);
}

/* ---- >>pivots ----------------------------------------------------------------------------------------------- */

/* Bin that a bin's middle falls in, as seen from a pivot that lies at -shift, in radii of its sphere. */
static uint32_t gphi_moved_bin(uint32_t rows, uint32_t bin, const float shift[3])
{
    uint32_t row = bin / (2 * rows), column = bin % (2 * rows);
    float z = ((float)row + 0.5f) * 2 / (float)rows - 1, r = sqrtf(1 - z * z), d[3];
    float phi = ((float)column + 0.5f) * GPH_PI / (float)rows;
    d[0] = r * cosf(phi) + shift[0];
    d[1] = r * sinf(phi) + shift[1];
    d[2] = z + shift[2];
    r = 1 / sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    d[2] *= r;
    return gph_bin(rows, 2 * rows, d);
}

/* Where one pivot's sphere lies from another pivot, in radii. */
static void gphi_shift(const gphi_state *s, const float pivot[3], float shift[3])
{
    int k;
    for (k = 0; k < 3; ++k)
        shift[k] = (s->pivot[k] - pivot[k]) * s->nearness;
}

/* Move what a histogram holds to where another pivot sees it. Lit bins do not become more. */
static void gphi_move_bins(gphi_voxel *v, uint32_t rows, const float pivot[3])
{
    float old[GPHI_MAX_BINS], now[GPHI_MAX_BINS], shift[3];
    uint16_t count_old[GPHI_MAX_BINS], count_now[GPHI_MAX_BINS];
    uint32_t bins = rows * rows * 2, i, n = gphi_bins(v, bins), entries = 0;
    gphi_shift(&v->s, pivot, shift);
    memset(old, 0, bins * sizeof *old);
    memset(now, 0, bins * sizeof *now);
    memset(count_old, 0, bins * sizeof *count_old);
    memset(count_now, 0, bins * sizeof *count_now);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, bins, i);
        uint32_t at, sum_old, sum_now;
        if (!(*b.old > 0 || *b.now > 0))
            continue;
        at = gphi_moved_bin(rows, b.at, shift);
        sum_old = (uint32_t)count_old[at] + *b.count_old;
        sum_now = (uint32_t)count_now[at] + *b.count_now;
        old[at] = gphi_sum(old[at], *b.old);
        now[at] = gphi_sum(now[at], *b.now);
        count_old[at] = (uint16_t)(sum_old < 65535 ? sum_old : 65535);
        count_now[at] = (uint16_t)(sum_now < 65535 ? sum_now : 65535);
    }
    for (i = 0; i < bins; ++i) {
        bool list = v->s.form == GPHI_FORM_SPARSE;
        gphi_bin b;
        if (list && !(old[i] > 0 || now[i] > 0))
            continue;
        if (list)
            ((gphi_entry *)v->data)[entries].bin = (uint16_t)i;
        b = gphi_get_bin(v, bins, list ? entries++ : i);
        *b.old = old[i];
        *b.now = now[i];
        *b.count_old = count_old[i];
        *b.count_now = count_now[i];
    }
    v->s.entries = entries;
}

/* Where the photons to come of a voxel are seen from: see Parallax. Small changes are not worth the blur of moving. */
static void gphi_choose_pivot(gphi_voxel *v, uint32_t rows, const double low[3], const double high[3])
{
    gphi_state *s = &v->s;
    double radius = 0, pairs = s->held.pairs + s->now.pairs, nearness;
    float pivot[3];
    int k;
    if (!(pairs > 0))
        return;
    for (k = 0; k < 3; ++k) {
        radius += 0.25 * (high[k] - low[k]) * (high[k] - low[k]);
        pivot[k] = (float)(0.5 * (low[k] + high[k]));
    }
    radius = sqrt(radius);
    nearness = fmin((s->held.near_pairs + s->now.near_pairs) / pairs, GPHI_MOST_REACH / radius);
    if (fabs(nearness - (double)s->nearness) * radius < 1.6 / rows)
        return;
    if (s->nearness > 0 && memcmp(pivot, s->pivot, sizeof pivot) != 0)
        gphi_move_bins(v, rows, pivot);
    memcpy(s->pivot, pivot, sizeof pivot);
    s->nearness = (float)fmin(nearness, 1e30); /* a loaded field may be as small */
    s->fresh = 0xffffffffu;                    /* its map is to be made anew */
    s->chosen = 0;
}

/* Pivots of the voxels below a node. */
static void gphi_place_below(gph_field *f, uint32_t node, const double low[3], const double high[3])
{
    uint32_t link = f->nodes[node].link, axis = link >> 29;
    double to[3], from[3];
    if (link & GPH_LEAF) {
        gphi_choose_pivot(&f->voxels[link & ~GPH_LEAF], f->desc.rows, low, high);
        return;
    }
    memcpy(to, high, sizeof to);
    memcpy(from, low, sizeof from);
    to[axis] = from[axis] = (double)f->nodes[node].split;
    gphi_place_below(f, link & 0x1fffffffu, low, to);
    gphi_place_below(f, (link & 0x1fffffffu) + 1, from, high);
}

static void gphi_place_all(gph_field *f)
{
    uint32_t i;
    for (i = 0; i < f->cube_count; ++i) {
        double low[3], high[3];
        gphi_cube_box(f, i, low, high);
        gphi_place_below(f, f->cubes[i].root, low, high);
    }
}

/* ---- >>streams ---------------------------------------------------------------------------------------------- */

typedef struct gphi_chunk {
    struct gphi_chunk *next; /* the samples follow */
    uint32_t count, capacity;
} gphi_chunk;

typedef struct gphi_list {
    gphi_chunk *first, *current;
    uint64_t size, lost;
} gphi_list;

struct gph_stream {
    gph_desc desc;
    gphi_list vertices, photons;
};

GPH_API gph_result gph_stream_create(const gph_field *field, gph_stream **stream)
{
    *stream = (gph_stream *)gphi_allocate(&field->desc, 1, sizeof(gph_stream));
    if (!*stream)
        return GPH_OUT_OF_MEMORY;
    (*stream)->desc = field->desc;
    return GPH_OK;
}

static void gphi_list_free(const gph_desc *desc, gphi_list *list)
{
    gphi_chunk *chunk, *next;
    for (chunk = list->first; chunk; chunk = next) {
        next = chunk->next;
        gphi_release(desc, chunk);
    }
}

GPH_API void gph_stream_destroy(gph_stream *stream)
{
    gph_desc desc;
    if (!stream)
        return;
    desc = stream->desc;
    gphi_list_free(&desc, &stream->vertices);
    gphi_list_free(&desc, &stream->photons);
    gphi_release(&desc, stream);
}

static void gphi_list_clear(gphi_list *list)
{
    gphi_chunk *chunk;
    for (chunk = list->first; chunk; chunk = chunk->next)
        chunk->count = 0;
    list->current = list->first;
    list->size = list->lost = 0;
}

GPH_API void gph_stream_clear(gph_stream *stream)
{
    gphi_list_clear(&stream->vertices);
    gphi_list_clear(&stream->photons);
}

GPH_API uint64_t gph_stream_size(const gph_stream *stream) { return stream->vertices.size + stream->photons.size; }

/* Room for one more sample at least; NULL = out of memory. Chunks: 256 samples, doubling up to 16384. */
static gphi_chunk *gphi_list_room(const gph_desc *desc, gphi_list *list, size_t size)
{
    gphi_chunk *chunk = list->current, *fresh;
    uint32_t capacity = 256;
    if (chunk && chunk->count < chunk->capacity)
        return chunk;
    if (chunk && chunk->next)
        return list->current = chunk->next; /* from before clear */
    if (chunk)
        capacity = chunk->capacity < 16384 ? chunk->capacity * 2 : 16384;
    fresh = (gphi_chunk *)desc->allocate(desc->user, sizeof *fresh + capacity * size);
    if (!fresh)
        return NULL;
    fresh->next = NULL;
    fresh->count = 0;
    fresh->capacity = capacity;
    if (chunk)
        chunk->next = fresh;
    else
        list->first = fresh;
    return list->current = fresh;
}

static gph_result gphi_list_add(const gph_desc *desc, gphi_list *list, const void *samples, uint32_t count, size_t size)
{
    const char *from = (const char *)samples;
    while (count) {
        gphi_chunk *chunk = gphi_list_room(desc, list, size);
        uint32_t n;
        if (!chunk) {
            list->lost += count;
            return GPH_OUT_OF_MEMORY;
        }
        n = chunk->capacity - chunk->count;
        n = n < count ? n : count;
        memcpy((char *)(chunk + 1) + chunk->count * size, from, n * size);
        chunk->count += n;
        list->size += n;
        from += n * size;
        count -= n;
    }
    return GPH_OK;
}

GPH_API gph_result gph_record_vertices(gph_stream *stream, const gph_vertex *vertices, uint32_t count)
{
    return gphi_list_add(&stream->desc, &stream->vertices, vertices, count, sizeof *vertices);
}

GPH_API gph_result gph_record_photons(gph_stream *stream, const gph_photon *photons, uint32_t count)
{
    return gphi_list_add(&stream->desc, &stream->photons, photons, count, sizeof *photons);
}

/* ---- >>accumulate ------------------------------------------------------------------------------------------- */

static const double gphi_gate_alpha[GPHI_GATE] = {0.2, 0.45, 0.75, 1.0};

/* Samples on their way to their voxels. */
typedef struct gphi_batch {
    gph_field *field;
    const void **samples;      /* each begins with its position */
    uint32_t *voxel;           /* or GPH_NONE, GPHI_BAD, GPHI_DARK */
    uint32_t *order, *offsets; /* samples by voxel; per voxel + 1 */
    uint32_t count;
} gphi_batch;

static bool gphi_batch_make(gphi_batch *b, gph_field *f)
{
    memset(b, 0, sizeof *b);
    b->field = f;
    b->samples =
        (const void **)gphi_allocate(&f->desc, GPHI_BATCH, sizeof *b->samples + sizeof *b->voxel + sizeof *b->order);
    if (!b->samples)
        return false;
    b->voxel = (uint32_t *)(void *)(b->samples + GPHI_BATCH);
    b->order = b->voxel + GPHI_BATCH;
    return true;
}

static void gphi_batch_free(gphi_batch *b) { gphi_release(&b->field->desc, (void *)(uintptr_t)b->samples); }

static const float *gphi_batch_position(const gphi_batch *b, uint32_t i) { return (const float *)b->samples[i]; }

/* Sort the samples by voxel, stably. */
static bool gphi_batch_sort(gphi_batch *b)
{
    gph_field *f = b->field;
    uint32_t i, sum = 0;
    b->offsets = (uint32_t *)gphi_allocate(&f->desc, (uint64_t)f->voxel_count + 1, sizeof *b->offsets);
    if (!b->offsets)
        return false;
    for (i = 0; i < b->count; ++i)
        if (b->voxel[i] < f->voxel_count)
            b->offsets[b->voxel[i]]++;
    for (i = 0; i <= f->voxel_count; ++i) {
        uint32_t n = b->offsets[i];
        b->offsets[i] = sum;
        sum += n;
    }
    for (i = 0; i < b->count; ++i)
        if (b->voxel[i] < f->voxel_count)
            b->order[b->offsets[b->voxel[i]]++] = i;
    for (i = f->voxel_count; i > 0; --i) /* back to the beginnings */
        b->offsets[i] = b->offsets[i - 1];
    b->offsets[0] = 0;
    return true;
}

static void gphi_batch_unsort(gphi_batch *b)
{
    gphi_release(&b->field->desc, b->offsets);
    b->offsets = NULL;
}

/* What was counted as accepted finds no memory. */
static void gphi_lose(gphi_batch *b, uint64_t *accepted)
{
    uint32_t i;
    for (i = 0; i < b->count; ++i)
        if (b->voxel[i] < b->field->voxel_count) {
            b->field->stats.lost++;
            --*accepted;
        }
}

static bool gphi_position_ok(const float p[3])
{
    return fabsf(p[0]) < GPHI_MAX_VALUE && fabsf(p[1]) < GPHI_MAX_VALUE && fabsf(p[2]) < GPHI_MAX_VALUE;
}

static bool gphi_far(const gph_field *f, const float p[3])
{
    double most = 0;
    int k;
    for (k = 0; k < 3; ++k)
        most = fmax(most, fabs((double)p[k] - f->origin[k]));
    return most > 1048575 * f->side;
}

static bool gphi_vertex_ok(const gph_vertex *v)
{
    if (!gphi_position_ok(v->position) || v->strategy > GPH_TOUCH_ONLY || v->sides > GPH_ALL_SIDES)
        return false;
    return v->strategy == GPH_TOUCH_ONLY ||
           (v->contribution >= 0 && v->contribution < GPHI_MAX_VALUE && v->pdf_mix > 0 && v->pdf_mix < INFINITY &&
            v->pdf_bsdf >= 0 && v->pdf_bsdf < INFINITY && v->pdf_guide >= 0 && v->pdf_guide < INFINITY);
}

static void gphi_find_vertices(void *context, uint32_t begin, uint32_t end)
{
    gphi_batch *b = (gphi_batch *)context;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        const gph_vertex *v = (const gph_vertex *)b->samples[i];
        b->voxel[i] = gphi_vertex_ok(v) ? gphi_find(b->field, v->position) : GPHI_BAD;
    }
}

/* Sums of x_a = g^2 / (p p_a). pdf_bsdf is floored, for directions that the BSDF practically never draws. */
static void gphi_vertex_add(gphi_sums *s, const gph_vertex *v, bool mapped)
{
    double g = fmin((double)v->contribution, GPHI_MAX_ROOT), p = (double)v->pdf_mix, pb, q = g * (g / p);
    double x[GPHI_GATE];
    int k;
    if (v->strategy == GPH_TOUCH_ONLY)
        return;
    s->q_bsdf += v->strategy == GPH_FROM_BSDF;
    s->q_guide += v->strategy == GPH_FROM_GUIDE;
    *(v->strategy == GPH_FROM_BSDF ? &s->l_bsdf : &s->l_guide) += g;
    s->flow += fmin(g / p, 1e30);
    if (!mapped || (g > 0 && !(v->pdf_guide > 0)))
        return;
    s->count += 1;
    if (!(g > 0))
        return;
    pb = fmax((double)v->pdf_bsdf, 1e-4 * p);
    for (k = 0; k < GPHI_GATE; ++k) {
        double a = gphi_gate_alpha[k];
        x[k] = fmin(q / (a * pb + (1 - a) * (double)v->pdf_guide), 1e60);
        s->v[k] += x[k];
        s->vv[k] += x[k] * x[k];
    }
    for (k = 0; k < GPHI_GATE - 1; ++k)
        s->cross[k] += x[k] * x[GPHI_GATE - 1];
}

static void gphi_add_vertices(void *context, uint32_t begin, uint32_t end)
{
    gphi_batch *b = (gphi_batch *)context;
    uint32_t i, k;
    for (i = begin; i < end; ++i)
        for (k = b->offsets[i]; k < b->offsets[i + 1]; ++k)
            gphi_vertex_add(&b->field->voxels[i].s.now, (const gph_vertex *)b->samples[b->order[k]],
                            b->field->voxels[i].s.map != GPH_NONE);
}

/* The vertices of a batch. */
static gph_result gphi_take_vertices(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    gph_result result = GPH_OK;
    uint32_t i;
    gphi_run(parallel, user, b->count, 1024, gphi_find_vertices, b);
    for (i = 0; i < b->count; ++i) {
        const float *position = gphi_batch_position(b, i);
        uint32_t *voxel = &b->voxel[i], sides;
        bool denied = false;
        if (*voxel == GPHI_BAD) {
            f->stats.refused++;
            continue;
        }
        if (*voxel == GPH_NONE) /* perhaps one before it made the cube */
            *voxel = gphi_find(f, position);
        if (*voxel == GPH_NONE)
            *voxel = gphi_add_cube(f, gphi_key(f, position), &denied);
        if (*voxel == GPH_NONE) {
            *(denied ? &f->stats.denied : &f->stats.lost) += 1;
            result = denied ? result : GPH_OUT_OF_MEMORY;
            continue;
        }
        f->stats.vertices++;
        f->stats.clamped += gphi_far(f, position);
        f->voxels[*voxel].s.touched++;
        sides = ((const gph_vertex *)b->samples[i])->sides;
        f->voxels[*voxel].s.valid |= sides ? sides : GPH_ALL_SIDES;
    }
    if (!gphi_batch_sort(b)) {
        gphi_lose(b, &f->stats.vertices);
        return GPH_OUT_OF_MEMORY;
    }
    gphi_run(parallel, user, f->voxel_count, 256, gphi_add_vertices, b);
    gphi_batch_unsort(b);
    return result;
}

static bool gphi_photon_ok(const gph_photon *p)
{
    const float *d = p->direction;
    float l = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    return l > 1e-12f && l < 1e12f && p->flux >= 0 && p->flux < GPHI_MAX_VALUE && p->nearness >= 0 &&
           gphi_position_ok(p->position);
}

static void gphi_find_photons(void *context, uint32_t begin, uint32_t end)
{
    gphi_batch *b = (gphi_batch *)context;
    const gph_field *f = b->field;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        const gph_photon *p = (const gph_photon *)b->samples[i];
        uint32_t *voxel = &b->voxel[i];
        *voxel = !gphi_photon_ok(p) ? GPHI_BAD : p->flux > 0 ? gphi_find(f, p->position) : GPHI_DARK;
        if (*voxel < f->voxel_count && !f->voxels[*voxel].s.valid)
            *voxel = GPH_NONE;
    }
}

/* Bin of a photon as seen from the pivot of its voxel. */
static uint32_t gphi_photon_bin(const gphi_state *s, uint32_t rows, const gph_photon *p)
{
    const float *w = p->direction;
    float r = 1 / sqrtf(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]), d[3], offset[3], seen[3];
    d[0] = w[0] * r;
    d[1] = w[1] * r;
    d[2] = w[2] * r;
    gph_offset(s->pivot, s->nearness, p->position, offset);
    gph_to_pivot(offset, d, seen);
    return gph_bin(rows, 2 * rows, seen);
}

/* Room in the histogram of voxel i for `count` photons of a batch. */
static gph_result gphi_make_room(gph_field *f, uint32_t i, uint32_t count)
{
    gphi_voxel *v = &f->voxels[i];
    uint64_t first = v->s.form == GPHI_FORM_EMPTY ? 2 * (uint64_t)f->map_bytes : 0, bytes, most;
    bool dense = v->s.entries + count >= GPHI_SPARSE;
    v->s.blocked = 0;
    if (v->s.form == GPHI_FORM_DENSE || (v->s.form == GPHI_FORM_SPARSE && v->s.entries + count <= v->capacity))
        return GPH_OK;
    most = dense ? (uint64_t)f->bins * 12 : GPHI_SPARSE * sizeof(gphi_entry);
    v->s.blocked = 1;
    if (!gphi_fits(f, most + first)) {
        f->stats.denied += count;
        return GPH_OK;
    }
    if (!gphi_room(&f->desc, v, f->bins, count, &bytes)) {
        f->stats.lost += count;
        return GPH_OUT_OF_MEMORY;
    }
    v->s.blocked = 0;
    f->mapped += first > 0;
    f->data_bytes += bytes;
    return GPH_OK;
}

/* Add a photon to a histogram. What is nearer than a thousandth of the box counts as that. */
static void gphi_add_photon(const gph_field *f, gphi_voxel *v, const gph_photon *p)
{
    double near = fmin(fmin((double)p->nearness, 1000 / (f->side * f->desc.grid_cells)), 1e30);
    float others = gphi_add(v, f->bins, gphi_photon_bin(&v->s, f->desc.rows, p), p->flux, 1);
    v->s.now.pairs += (double)p->flux * (double)others;
    v->s.now.near_pairs += (double)p->flux * (double)others * near;
}

static void gphi_add_hits(void *context, uint32_t begin, uint32_t end)
{
    gphi_batch *b = (gphi_batch *)context;
    uint32_t i, k;
    for (i = begin; i < end; ++i) {
        gphi_voxel *v = &b->field->voxels[i];
        if (b->offsets[i] == b->offsets[i + 1] || v->s.blocked)
            continue;
        gphi_roll(v, b->field->bins, b->field->stats.passes);
        v->s.changed |= 1;
        for (k = b->offsets[i]; k < b->offsets[i + 1]; ++k)
            gphi_add_photon(b->field, v, (const gph_photon *)b->samples[b->order[k]]);
    }
}

/* Add hits whose voxels are known to the histograms. */
static gph_result gphi_take_hits(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    gph_result result = GPH_OK;
    uint32_t i;
    if (!gphi_batch_sort(b)) {
        gphi_lose(b, &f->stats.photons);
        return GPH_OUT_OF_MEMORY;
    }
    for (i = 0; i < f->voxel_count; ++i) {
        uint32_t n = b->offsets[i + 1] - b->offsets[i];
        if (n && gphi_make_room(f, i, n))
            result = GPH_OUT_OF_MEMORY;
        f->stats.photons -= n && f->voxels[i].s.blocked ? n : 0;
    }
    gphi_run(parallel, user, f->voxel_count, 64, gphi_add_hits, b);
    gphi_batch_unsort(b);
    return result;
}

static gph_result gphi_close_cloud(gphi_batch *b, gph_parallel_fn parallel, void *user);

/* The hits of a batch join the cloud. False where it has no room for them. */
static bool gphi_join_cloud(gphi_batch *b)
{
    gph_field *f = b->field;
    gphi_cloud_photon *cloud;
    uint32_t i;
    if (f->cloud_count + b->count > f->desc.cloud_photons ||
        !gphi_fits(f, gphi_growth(f->cloud_capacity, f->cloud_count + b->count, sizeof *cloud)))
        return false;
    cloud = (gphi_cloud_photon *)gphi_grown(&f->desc, f->cloud, f->cloud_count, &f->cloud_capacity,
                                            f->cloud_count + b->count, sizeof *cloud);
    if (!cloud)
        return false;
    f->cloud = cloud;
    for (i = 0; i < b->count; ++i)
        if (b->voxel[i] < f->voxel_count) {
            memcpy(&cloud[f->cloud_count].photon, b->samples[i], sizeof cloud->photon);
            cloud[f->cloud_count++].voxel = b->voxel[i];
        }
    return true;
}

/* Hits whose voxels are known: in the first pass to the cloud, else to the histograms. */
static gph_result gphi_settle(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    gph_result result = GPH_OK, close = GPH_OK;
    uint32_t i;
    if (!f->cloud_closed) {
        gphi_batch other;
        if (gphi_join_cloud(b))
            return GPH_OK;
        if (!gphi_batch_make(&other, f)) {
            gphi_lose(b, &f->stats.photons);
            return GPH_OUT_OF_MEMORY;
        }
        close = gphi_close_cloud(&other, parallel, user);
        gphi_batch_free(&other);
        for (i = 0; i < b->count; ++i) /* its voxel may have been cut */
            if (b->voxel[i] < f->voxel_count)
                b->voxel[i] = gphi_find(f, gphi_batch_position(b, i));
    }
    result = gphi_take_hits(b, parallel, user);
    return result ? result : close;
}

/* The photons of a batch. */
static gph_result gphi_take_photons(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    uint32_t i;
    gphi_run(parallel, user, b->count, 1024, gphi_find_photons, b);
    for (i = 0; i < b->count; ++i) {
        uint32_t voxel = b->voxel[i];
        bool useful = voxel < f->voxel_count;
        f->stats.refused += voxel == GPHI_BAD;
        f->stats.dark += voxel == GPHI_DARK;
        f->stats.unread += voxel == GPH_NONE;
        f->stats.clamped += useful && gphi_far(f, gphi_batch_position(b, i));
        f->stats.photons += useful;
        f->pass_useful += useful;
        f->pass_photons += useful || voxel == GPH_NONE;
    }
    return gphi_settle(b, parallel, user);
}

/* The grid's box from the vertices of all streams. */
static void gphi_discover_box(gph_field *f, gph_stream *const *streams, uint32_t count)
{
    float low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    uint32_t i, j, k;
    const gphi_chunk *chunk;
    for (i = 0; i < count; ++i)
        for (chunk = streams[i]->vertices.first; chunk; chunk = chunk->next)
            for (j = 0; j < chunk->count; ++j) {
                const gph_vertex *v = (const gph_vertex *)(const void *)(chunk + 1) + j;
                for (k = 0; gphi_vertex_ok(v) && k < 3; ++k) {
                    low[k] = v->position[k] < low[k] ? v->position[k] : low[k];
                    high[k] = v->position[k] > high[k] ? v->position[k] : high[k];
                }
            }
    if (low[0] <= high[0])
        gphi_set_box(f, low, high);
}

/* What the streams lost is counted once. */
static void gphi_count_lost(gph_field *f, gphi_list *list)
{
    f->stats.lost += list->lost;
    list->lost = 0;
}

typedef gph_result (*gphi_take_fn)(gphi_batch *b, gph_parallel_fn parallel, void *user);

static gph_result gphi_flush(gphi_batch *b, gphi_take_fn take, gph_parallel_fn parallel, void *user)
{
    gph_result result = b->count ? take(b, parallel, user) : GPH_OK;
    b->count = 0;
    return result;
}

/* Add a stream's samples to the batch, and take it in whenever it is full: a batch costs something for each voxel. */
static gph_result gphi_gather(gphi_batch *b, gphi_list *list, size_t size, gphi_take_fn take, gph_parallel_fn parallel,
                              void *user)
{
    gph_result result = GPH_OK;
    const gphi_chunk *chunk;
    uint32_t k;
    gphi_count_lost(b->field, list);
    for (chunk = list->first; chunk; chunk = chunk->next)
        for (k = 0; k < chunk->count; ++k) {
            b->samples[b->count++] = (const char *)(chunk + 1) + k * size;
            if (b->count == GPHI_BATCH && gphi_flush(b, take, parallel, user))
                result = GPH_OUT_OF_MEMORY;
        }
    return result;
}

GPH_API gph_result gph_accumulate(gph_field *field, gph_stream *const *streams, uint32_t count,
                                  gph_parallel_fn parallel, void *user)
{
    gph_result result = GPH_OK;
    gphi_batch b;
    uint32_t i;
    if (!(field->side > 0))
        gphi_discover_box(field, streams, count);
    if (!gphi_batch_make(&b, field)) {
        for (i = 0; i < count; ++i) {
            field->stats.lost += gph_stream_size(streams[i]);
            gphi_count_lost(field, &streams[i]->vertices);
            gphi_count_lost(field, &streams[i]->photons);
        }
        return GPH_OUT_OF_MEMORY;
    }
    for (i = 0; i < count; ++i)
        if (gphi_gather(&b, &streams[i]->vertices, sizeof(gph_vertex), gphi_take_vertices, parallel, user))
            result = GPH_OUT_OF_MEMORY;
    if (gphi_flush(&b, gphi_take_vertices, parallel, user))
        result = GPH_OUT_OF_MEMORY;
    for (i = 0; i < count; ++i)
        if (gphi_gather(&b, &streams[i]->photons, sizeof(gph_photon), gphi_take_photons, parallel, user))
            result = GPH_OUT_OF_MEMORY;
    if (gphi_flush(&b, gphi_take_photons, parallel, user))
        result = GPH_OUT_OF_MEMORY;
    gphi_batch_free(&b);
    return result;
}

/* ---- >>cloud ------------------------------------------------------------------------------------------------ */

/* The k-th smallest of n numbers, k < n; they are moved (Hoare's selection, the middle one as pivot). */
static float gphi_select(float *x, uint32_t n, uint32_t k)
{
    uint32_t low = 0, high = n - 1;
    while (low < high) {
        float pivot = x[low + (high - low) / 2];
        uint32_t i = low, j = high;
        for (;; ++i, --j) {
            float t;
            while (x[i] < pivot)
                ++i;
            while (x[j] > pivot)
                --j;
            if (i >= j)
                break;
            t = x[i];
            x[i] = x[j];
            x[j] = t;
        }
        if (k <= j) /* what is at or before j is at most the pivot, what follows at least */
            high = j;
        else
            low = j + 1;
    }
    return x[k];
}

/* The photons of one leaf, as indices into the cloud. */
typedef struct gphi_group {
    gph_field *field;
    float *numbers; /* room for as many */
    uint32_t *spare;
} gphi_group;

/* Median of the photons' coordinates along an axis, the photon itself above it; false where all are the same. */
static bool gphi_median(const gphi_group *g, const uint32_t *photons, uint32_t count, uint32_t axis, float *split)
{
    float least = INFINITY, median, next = INFINITY; /* next: smallest that is more than the least */
    uint32_t i;
    for (i = 0; i < count; ++i) {
        g->numbers[i] = g->field->cloud[photons[i]].photon.position[axis];
        least = g->numbers[i] < least ? g->numbers[i] : least;
    }
    for (i = 0; i < count; ++i)
        next = g->numbers[i] > least && g->numbers[i] < next ? g->numbers[i] : next;
    median = gphi_select(g->numbers, count, count / 2);
    *split = median > least ? median : next; /* something must lie below */
    return next < INFINITY;
}

/* Cut a leaf at the median of its photons, and its halves, while they have more than the threshold. */
static gph_result gphi_cut_group(gphi_group *g, uint32_t node, uint32_t *photons, uint32_t count, uint32_t levels)
{
    gph_field *f = g->field;
    uint32_t voxel = f->nodes[node].link & ~GPH_LEAF, level = f->voxels[voxel].s.level, i, low = 0, high = 0, axis,
             child;
    gph_result result;
    float split = 0;
    if (!levels || (double)count <= gphi_threshold(f))
        return GPH_OK;
    for (i = 0, axis = level % 3; i < 3 && !gphi_median(g, photons, count, axis, &split); ++i)
        axis = (axis + 1) % 3;
    if (i == 3 || level >= f->desc.max_levels || !gphi_cut_fits(f, &f->voxels[voxel])) {
        f->stats.denied_splits++;
        return GPH_OK;
    }
    result = gphi_cut(f, node, axis, split);
    if (result)
        return result;
    child = f->nodes[node].link & 0x1fffffffu;
    for (i = 0; i < count; ++i) {
        gphi_cloud_photon *p = &f->cloud[photons[i]];
        if (p->photon.position[axis] < split)
            photons[low++] = photons[i];
        else {
            p->voxel = f->voxel_count - 1;
            g->spare[high++] = photons[i];
        }
    }
    memcpy(photons + low, g->spare, high * sizeof *photons);
    result = gphi_cut_group(g, child, photons, low, levels - 1);
    return result ? result : gphi_cut_group(g, child + 1, photons + low, high, levels - 1);
}

/* Cut the voxels of the first pass where they have many photons. */
static gph_result gphi_cut_cloud(gph_field *f)
{
    gphi_group g;
    gph_result result = GPH_OK;
    uint32_t i, sum = 0, voxels = f->voxel_count, *offsets, *order;
    g.field = f;
    g.numbers = (float *)gphi_allocate(&f->desc, f->cloud_count, 3 * sizeof(uint32_t));
    offsets = (uint32_t *)gphi_allocate(&f->desc, (uint64_t)voxels + 1, sizeof *offsets);
    if (!g.numbers || !offsets) {
        gphi_release(&f->desc, g.numbers);
        gphi_release(&f->desc, offsets);
        return GPH_OUT_OF_MEMORY;
    }
    g.spare = (uint32_t *)(void *)(g.numbers + f->cloud_count);
    order = g.spare + f->cloud_count;
    for (i = 0; i < f->cloud_count; ++i)
        offsets[f->cloud[i].voxel + 1]++;
    for (i = 0; i < voxels; ++i)
        offsets[i + 1] += offsets[i];
    for (i = 0; i < f->cloud_count; ++i)
        order[offsets[f->cloud[i].voxel]++] = i;
    for (i = 0; i < voxels && !result; ++i) {
        uint32_t *photons = order + sum, count = offsets[i] - sum;
        sum = offsets[i];
        if (count)
            result = gphi_cut_group(&g, gphi_find_leaf(f, f->cloud[photons[0]].photon.position), photons, count,
                                    GPHI_NEW_LEVELS);
    }
    gphi_release(&f->desc, g.numbers);
    gphi_release(&f->desc, offsets);
    return result;
}

/* All photons of the cloud to the histograms. */
static gph_result gphi_add_cloud(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    gph_result result = GPH_OK;
    uint32_t i, k;
    for (i = 0; i < f->cloud_count; i += b->count) {
        b->count = f->cloud_count - i < GPHI_BATCH ? f->cloud_count - i : GPHI_BATCH;
        for (k = 0; k < b->count; ++k) {
            b->samples[k] = &f->cloud[i + k].photon;
            b->voxel[k] = f->cloud[i + k].voxel;
        }
        if (gphi_take_hits(b, parallel, user))
            result = GPH_OUT_OF_MEMORY;
    }
    return result;
}

/* Take all photons out of the histograms, which keep their room. */
static void gphi_empty_histograms(gph_field *f)
{
    uint32_t i;
    for (i = 0; i < f->voxel_count; ++i) {
        gphi_voxel *v = &f->voxels[i];
        if (v->data)
            memset(v->data, 0, gphi_data_bytes(v, f->bins));
        v->s.entries = v->s.fresh = 0;
        v->s.photons = v->s.now.pairs = v->s.now.near_pairs = 0;
    }
}

/* The first pass is over, or has too many photons to keep: median splits, then all of them go to histograms, twice: the
   first time tells where from they are to be seen. Where the splits find no memory, voxels stay as they are. */
static gph_result gphi_close_cloud(gphi_batch *b, gph_parallel_fn parallel, void *user)
{
    gph_field *f = b->field;
    gph_stats before;
    gph_result result = GPH_OK;
    f->cloud_closed = 1;
    if (f->cloud_count)
        result = gphi_cut_cloud(f);
    before = f->stats;
    if (gphi_add_cloud(b, parallel, user))
        result = GPH_OUT_OF_MEMORY;
    gphi_place_all(f);
    gphi_empty_histograms(f);
    f->stats = before; /* what found no room is counted once */
    if (gphi_add_cloud(b, parallel, user))
        result = GPH_OUT_OF_MEMORY;
    gphi_release(&f->desc, f->cloud);
    f->cloud = NULL;
    f->cloud_count = f->cloud_capacity = 0;
    return result;
}

/* ---- >>gate ------------------------------------------------------------------------------------------------- */

/* held = held / 2 + now. */
static void gphi_fold(gphi_state *s)
{
    double *held = (double *)(void *)&s->held, *now = (double *)(void *)&s->now;
    uint32_t k;
    for (k = 0; k < sizeof(gphi_sums) / sizeof(double); ++k)
        held[k] = fmin(0.5 * held[k] + now[k], 1e150);
    memset(&s->now, 0, sizeof s->now);
}

/* Mean and 95 % error of y = x_1 - fa x_a, from the sums. */
static void gphi_gate_difference(const gphi_sums *s, int a, double fa, double *mean, double *error)
{
    const int one = GPHI_GATE - 1;
    double n = s->count, square;
    *mean = (s->v[one] - fa * s->v[a]) / n;
    square = (s->vv[one] - 2 * fa * s->cross[a] + fa * fa * s->vv[a]) / n - *mean * *mean;
    *error = GPHI_CONFIDENCE * sqrt((square > 0 ? square : 0) / n);
}

/* Kish's effective number of samples behind V(1). */
static double gphi_gate_effective(const gphi_sums *s)
{
    double v = s->v[GPHI_GATE - 1], vv = s->vv[GPHI_GATE - 1];
    return vv > 0 ? fmin(v * v / vv, 1e18) : 0;
}

/* Minimum of the parabola through the lowest V(a) and its neighbours, pulled towards the present value by 32 effective
   samples. */
static float gphi_variance_alpha(const gphi_state *state)
{
    const double *x = gphi_gate_alpha, *v = state->held.v;
    double best, n = gphi_gate_effective(&state->held), d0, d1, bend;
    int k, low = 0;
    for (k = 1; k < GPHI_GATE; ++k)
        low = v[k] < v[low] ? k : low;
    if (!(v[0] > v[low] || v[GPHI_GATE - 1] > v[low])) /* nothing known */
        return state->alpha;
    k = low < 1 ? 1 : low > GPHI_GATE - 2 ? GPHI_GATE - 2 : low;
    d0 = (v[k] - v[k - 1]) / (x[k] - x[k - 1]);
    d1 = (v[k + 1] - v[k]) / (x[k + 1] - x[k]);
    bend = (d1 - d0) / (x[k + 1] - x[k - 1]);
    best = bend > 0 ? 0.5 * (x[k - 1] + x[k]) - 0.5 * d0 / bend : x[low];
    best = best > 0.05 ? best : 0.05; /* NaN too */
    best = best < 0.95 ? best : 0.95;
    return (float)((n * best + 32 * (double)state->alpha) / (n + 32));
}

/* [eq. 14], within 0.2 .. 0.8. */
static float gphi_ratio_alpha(const gph_desc *desc, const gphi_state *state)
{
    const gphi_sums *s = &state->held;
    double bsdf, guide, a;
    if (!(s->q_bsdf >= desc->ratio_samples) || !(s->q_guide >= desc->ratio_samples))
        return state->alpha;
    bsdf = s->l_bsdf / s->q_bsdf;
    guide = s->l_guide / s->q_guide;
    if (!(bsdf + guide > 0))
        return state->alpha;
    a = bsdf / (bsdf + guide);
    return (float)(a < 0.2 ? 0.2 : a > 0.8 ? 0.8 : a);
}

/* Open, close or leave a voxel; see Gate in the opening comment. */
static void gphi_verdict(const gph_desc *desc, gphi_state *s, gph_stats *stats)
{
    double n = gphi_gate_effective(&s->held), mean, error, margin = (double)desc->gate_margin;
    int k, best = 0;
    if (!(s->held.count > 0) || !(n > 0))
        return;
    for (k = 1; k < GPHI_GATE - 1; ++k)
        best = s->held.v[k] < s->held.v[best] ? k : best;
    gphi_gate_difference(&s->held, best, 1 + margin * (s->verdict == GPH_GATE_OPEN ? 0.5 : 1), &mean, &error);
    if (mean - error > 0 && n >= GPHI_MIN_OPEN) {
        stats->opened += s->verdict != GPH_GATE_OPEN;
        s->verdict = GPH_GATE_OPEN;
    } else if (mean + error < 0 && n >= GPHI_MIN_CLOSE) {
        stats->closed++;
        s->verdict = GPH_GATE_CLOSED;
        s->probe = desc->gate_probe;
    }
}

/* Fold the sums after a pass. Without a map V has seen nothing; what the BSDF drew and what surfaces reflect is the
   same under any guide. */
static void gphi_fold_pass(gphi_state *s)
{
    double seen;
    gphi_fold(s);
    seen = s->held.q_bsdf + s->held.q_guide;
    if (seen >= GPHI_MIN_SEEN)
        s->reflected = (float)fmin(s->held.flow / seen, 1e30); /* a loaded sum may be larger */
}

/* After a pass: fold the sums, learn alpha, judge. A closed voxel waits, then is tried anew. */
static void gphi_judge(gph_field *f, gphi_state *s)
{
    gphi_fold_pass(s);
    if (s->map == GPH_NONE)
        return;
    if (s->verdict == GPH_GATE_CLOSED) {
        s->probe -= s->probe > 0;
        if (!s->probe) {
            f->stats.probed++;
            s->verdict = GPH_GATE_UNJUDGED;
            memset(&s->held, 0, sizeof s->held);
        }
        return;
    }
    if (f->desc.alpha_mode == GPH_ALPHA_VARIANCE)
        s->alpha = gphi_variance_alpha(s);
    else if (f->desc.alpha_mode == GPH_ALPHA_RATIO)
        s->alpha = gphi_ratio_alpha(&f->desc, s);
    if (!f->desc.no_gate)
        gphi_verdict(&f->desc, s, &f->stats);
}

/* Judge all voxels, and what the pass was like. */
static void gphi_judge_all(gph_field *f)
{
    double vertices = 0, closed = 0, alpha = 0;
    uint32_t i;
    for (i = 0; i < f->voxel_count; ++i) {
        gphi_state *s = &f->voxels[i].s;
        double n = (double)s->touched;
        gphi_judge(f, s);
        vertices += n;
        closed += s->verdict == GPH_GATE_CLOSED ? n : 0;
        alpha += s->verdict == GPH_GATE_CLOSED || s->map == GPH_NONE ? n : n * (double)s->alpha;
    }
    if (vertices > 0) {
        f->stats.closed_share = (float)(closed / vertices);
        f->stats.mean_alpha = (float)(alpha / vertices);
        for (i = 0; i < f->voxel_count; ++i)
            f->voxels[i].s.unread = f->voxels[i].s.touched ? 0 : f->voxels[i].s.unread + 1;
    }
    if (f->pass_photons)
        f->stats.useful_share = (float)((double)f->pass_useful / (double)f->pass_photons);
    f->pass_photons = f->pass_useful = 0;
}

/* ---- >>split ------------------------------------------------------------------------------------------------ */

/* Cut a leaf with too many photons in the middle of its box, and its halves; look for leaves below a node. */
static gph_result gphi_split_below(gph_field *f, uint32_t node, const double low[3], const double high[3],
                                   uint32_t levels)
{
    uint32_t link = f->nodes[node].link, k, axis;
    double to[3], from[3];
    gph_result result;
    if (link & GPH_LEAF) {
        gphi_voxel *v = &f->voxels[link & ~GPH_LEAF];
        float split = 0;
        bool found = false;
        if (!levels || !(v->s.photons > gphi_threshold(f)) || !v->s.valid)
            return GPH_OK;
        for (k = 0, axis = v->s.level % 3; k < 3; ++k, axis = (axis + 1) % 3) {
            split = (float)((low[axis] + high[axis]) * 0.5);
            found = (double)split > low[axis] && (double)split < high[axis];
            if (found)
                break;
        }
        if (!found || v->s.level >= f->desc.max_levels || !gphi_cut_fits(f, v)) {
            f->stats.denied_splits++;
            return GPH_OK;
        }
        result = gphi_cut(f, node, axis, split);
        if (result)
            return result;
        link = f->nodes[node].link;
        --levels;
    }
    axis = link >> 29;
    memcpy(to, high, sizeof to);
    memcpy(from, low, sizeof from);
    to[axis] = from[axis] = (double)f->nodes[node].split;
    result = gphi_split_below(f, link & 0x1fffffffu, low, to, levels);
    return result ? result : gphi_split_below(f, (link & 0x1fffffffu) + 1, from, high, levels);
}

/* All cubes. Halves are invalid until a camera path touches them [Zhu 2021a, 7.1]. */
static gph_result gphi_split_all(gph_field *f)
{
    gph_result result = GPH_OK;
    uint32_t i, before = f->voxel_count;
    for (i = 0; i < before; ++i)
        f->voxels[i].s.blocked = f->voxels[i].s.level;
    for (i = 0; i < f->cube_count && !result; ++i) {
        double low[3], high[3];
        gphi_cube_box(f, i, low, high);
        result = gphi_split_below(f, f->cubes[i].root, low, high, GPHI_NEW_LEVELS);
    }
    for (i = 0; i < f->voxel_count; ++i) {
        gphi_state *s = &f->voxels[i].s;
        if (i >= before || s->blocked != s->level)
            s->valid = 0;
        s->blocked = 0;
    }
    return result;
}

/* ---- >>recycle ---------------------------------------------------------------------------------------------- */

static bool gphi_dead_voxel(const gph_field *f, const gphi_voxel *v)
{
    return v->s.form == GPHI_FORM_EMPTY && v->s.unread >= f->desc.keep_passes;
}

/* True where no voxel below a node is of use. */
static bool gphi_dead(const gph_field *f, uint32_t node)
{
    uint32_t link = f->nodes[node].link;
    if (link & GPH_LEAF)
        return gphi_dead_voxel(f, &f->voxels[link & ~GPH_LEAF]);
    return gphi_dead(f, link & 0x1fffffffu) && gphi_dead(f, (link & 0x1fffffffu) + 1);
}

/* Nodes and voxels of the field without what is dead. */
typedef struct gphi_copy {
    gph_field *field;
    gph_node *nodes;
    gphi_voxel *voxels;
    uint32_t node_count, voxel_count;
} gphi_copy;

/* Copy the tree below node `from` to node `to`, dead subtrees as one empty voxel. */
static void gphi_copy_tree(gphi_copy *c, uint32_t from, uint32_t to, uint32_t level)
{
    uint32_t link = c->field->nodes[from].link, child = c->node_count;
    if (link & GPH_LEAF || gphi_dead(c->field, from)) {
        gphi_voxel *v = &c->voxels[c->voxel_count];
        while (!(link & GPH_LEAF)) /* the lowest stands for all */
            link = c->field->nodes[link & 0x1fffffffu].link;
        *v = c->field->voxels[link & ~GPH_LEAF];
        v->s.level = level;
        c->nodes[to].split = 0;
        c->nodes[to].link = GPH_LEAF | c->voxel_count++;
        return;
    }
    c->node_count += 2;
    c->nodes[to].split = c->field->nodes[from].split;
    c->nodes[to].link = (link & 0x60000000u) | child;
    gphi_copy_tree(c, link & 0x1fffffffu, child, level + 1);
    gphi_copy_tree(c, (link & 0x1fffffffu) + 1, child + 1, level + 1);
}

/* Drop dead cubes and subtrees. Without memory for that they stay until the next time. */
static void gphi_compact(gph_field *f)
{
    gphi_copy c;
    uint32_t i, cubes = 0;
    if (gphi_held(f) + (uint64_t)f->node_count * sizeof *c.nodes + (uint64_t)f->voxel_count * sizeof *c.voxels >
        f->desc.max_bytes)
        gphi_drop_spare(f);
    memset(&c, 0, sizeof c);
    c.field = f;
    c.nodes = (gph_node *)gphi_allocate(&f->desc, f->node_count, sizeof *c.nodes);
    c.voxels = (gphi_voxel *)gphi_allocate(&f->desc, f->voxel_count, sizeof *c.voxels);
    if (!c.nodes || !c.voxels) {
        gphi_release(&f->desc, c.nodes);
        gphi_release(&f->desc, c.voxels);
        return;
    }
    for (i = 0; i < f->cube_count; ++i)
        if (!gphi_dead(f, f->cubes[i].root)) {
            uint32_t root = c.node_count++;
            gphi_copy_tree(&c, f->cubes[i].root, root, 0);
            f->cubes[cubes] = f->cubes[i];
            f->cubes[cubes++].root = root;
        }
    gphi_release(&f->desc, f->nodes);
    gphi_release(&f->desc, f->voxels);
    f->node_capacity = f->node_count ? f->node_count : 1;
    f->voxel_capacity = f->voxel_count ? f->voxel_count : 1;
    f->nodes = c.nodes;
    f->voxels = c.voxels;
    f->node_count = c.node_count;
    f->voxel_count = c.voxel_count;
    f->cube_count = cubes;
    gphi_hash_cubes(f, cubes); /* fits: there were more */
}

/* Empty the voxels that no camera path reads. */
static void gphi_recycle(gph_field *f)
{
    bool any = false;
    uint32_t i;
    for (i = 0; i < f->voxel_count; ++i) {
        gphi_voxel *v = &f->voxels[i];
        if (v->s.unread < f->desc.keep_passes)
            continue;
        any = true;
        f->stats.recycled += v->s.form != GPHI_FORM_EMPTY;
        f->mapped -= v->s.form != GPHI_FORM_EMPTY;
        f->data_bytes -= gphi_data_bytes(v, f->bins);
        gphi_release(&f->desc, v->data);
        v->data = NULL;
        v->capacity = v->sigma = 0;
        {
            uint32_t level = v->s.level, unread = v->s.unread;
            gphi_state_init(&v->s, f->desc.alpha, f->stats.passes);
            v->s.level = level;
            v->s.unread = unread;
        }
    }
    if (any)
        gphi_compact(f);
}

/* ---- >>repair ----------------------------------------------------------------------------------------------- */

/* Row r, which may lie beyond the poles: going on over a pole is coming back half a turn on. Returns the columns that
   this shifts by. */
static uint32_t gphi_over_pole(int *r, int rows, int columns)
{
    int m = *r % (2 * rows);
    m = m < 0 ? m + 2 * rows : m;
    *r = m < rows ? m : 2 * rows - 1 - m;
    return m < rows ? 0 : (uint32_t)columns / 2;
}

/* to[i] += k from[i]. */
static void gphi_add_row(float *to, const float *from, float k, int n)
{
    int i;
    for (i = 0; i < n; ++i)
        to[i] += k * from[i];
}

/* Separable Gaussian blur of a[rows][columns], with b as scratch; the sum is kept. Rows without light cost nothing.
   Returns the kernel's middle. */
static float gphi_blur(float *a, float *b, int rows, int columns, double sigma)
{
    float kernel[2 * 48 + 1], *k = kernel + 48, wide[2 * GPHI_MAX_ROWS + 2 * 48];
    int radius = (int)ceil(3 * sigma), r, c, d;
    bool lit[GPHI_MAX_ROWS];
    double sum = 0;
    radius = radius > 48 ? 48 : radius;
    for (d = -radius; d <= radius; ++d)
        sum += exp(-0.5 * d * d / (sigma * sigma));
    for (d = -radius; d <= radius; ++d)
        k[d] = (float)(exp(-0.5 * d * d / (sigma * sigma)) / sum);
    memset(b, 0, (size_t)(rows * columns) * sizeof *b);
    for (r = 0; r < rows; ++r) {
        float *row = a + r * columns;
        lit[r] = false;
        for (c = 0; c < columns; ++c)
            lit[r] = lit[r] || row[c] > 0;
        if (!lit[r])
            continue;
        for (c = -radius; c < columns + radius; ++c)
            wide[c + radius] = row[c & (columns - 1)];
        for (d = -radius; d <= radius; ++d)
            gphi_add_row(b + r * columns, wide + radius + d, k[d], columns);
    }
    memset(a, 0, (size_t)(rows * columns) * sizeof *a);
    for (r = 0; r < rows; ++r)
        for (d = -radius; d <= radius; ++d) {
            int from = r + d, shift = (int)gphi_over_pole(&from, rows, columns);
            if (!lit[from])
                continue;
            gphi_add_row(a + r * columns, b + from * columns + shift, k[d], columns - shift);
            gphi_add_row(a + r * columns + columns - shift, b + from * columns, k[d], shift);
        }
    return k[0];
}

/* How likely a blur makes each photon given all others: sum over bins of flux times log of (1 - e) (b - k^2 w) /
   (sum - w) + e / bins, b the blurred histogram, k the kernel's middle, w the mean flux of the bin's photons.
   Leave-one-out cross-validation, own. map: the histogram, whose sum is `sum`; its second half and the first half of
   scratch are lost. */
static double gphi_likelihood(const gph_field *f, const gphi_voxel *v, float *map, float *scratch, double sum,
                              double sigma)
{
    int rows = (int)f->desc.rows;
    uint32_t i, n = gphi_bins(v, f->bins);
    double likely = 0, middle, e = (double)f->desc.uniform;
    memcpy(map + f->bins, map, f->bins * sizeof *map);
    middle = (double)gphi_blur(map + f->bins, scratch, rows, 2 * rows, sigma);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, f->bins, i);
        double flux = (double)map[b.at], one = flux / ((double)*b.count_old + *b.count_now), others;
        if (!(flux > 0))
            continue;
        others = ((double)map[f->bins + b.at] - middle * middle * one) / fmax(sum - one, 1e-9 * sum);
        likely += flux / sum * log((1 - e) * fmax(others, 0) + e / f->bins);
    }
    return likely;
}

#define GPHI_SIGMAS 8

/* Blur a map by the likeliest sigma of the Gaussian: from the one chosen last up while that is likelier, else down. */
static void gphi_blur_likeliest(const gph_field *f, gphi_voxel *v, float *map, float *scratch)
{
    static const double sigmas[GPHI_SIGMAS] = {0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0};
    double best, sum = 0, scale = f->desc.rows / 32.0;
    int at = v->sigma ? (int)v->sigma - 1 : 3, from = at, step;
    uint32_t i;
    for (i = 0; i < f->bins; ++i)
        sum += (double)map[i];
    if (v->sigma && v->s.photons < 2 * (double)v->s.chosen) { /* it falls with a small root of the photons */
        gphi_blur(map, scratch, (int)f->desc.rows, 2 * (int)f->desc.rows, sigmas[at] * scale);
        return;
    }
    best = gphi_likelihood(f, v, map, scratch, sum, sigmas[at] * scale);
    memcpy(scratch + f->bins, map + f->bins, f->bins * sizeof *map);
    for (step = 1; step >= -1 && at == from; step -= 2)
        while (at + step >= 0 && at + step < GPHI_SIGMAS) {
            double likely = gphi_likelihood(f, v, map, scratch, sum, sigmas[at + step] * scale);
            if (!(likely > best))
                break;
            best = likely;
            at += step;
            memcpy(scratch + f->bins, map + f->bins, f->bins * sizeof *map);
        }
    memcpy(map, scratch + f->bins, f->bins * sizeof *map);
    v->sigma = (uint32_t)at + 1;
    v->s.chosen = (float)v->s.photons;
}

/* Value of a coarse map [rows][columns] at the centre of bin (r, c) of the map twice as fine: linear interpolation. */
static float gphi_coarse(const float *a, int rows, int columns, int r, int c)
{
    int dr = r & 1 ? 1 : -1, dc = c & 1 ? 1 : -1, r0 = r / 2, r1 = r / 2 + dr, c0 = c / 2;
    int shift = (int)gphi_over_pole(&r1, rows, columns), c1 = (c0 + dc) & (columns - 1);
    const float *p = a + r0 * columns, *q = a + r1 * columns;
    return 0.5625f * p[c0] + 0.1875f * (p[c1] + q[(c0 + shift) & (columns - 1)]) +
           0.0625f * q[(c1 + shift) & (columns - 1)];
}

/* Pyramid over a[rows][columns], whose coarser levels follow it in memory. lit (NULL = none): 1 where a bin keeps its
   value, with the same room: then values count by their weight on the way down, and only the rest of the weight is
   filled from above [Gortler 1996]. */
static void gphi_pyramid(float *a, float *lit, int rows, int columns, int levels)
{
    int l, r, c, q, n = 0;
    float *at[8], *w[8];
    at[0] = a;
    w[0] = lit;
    for (l = 0; l < levels && rows >> (l + 1) > 0; ++l, ++n) {
        int half = columns >> (l + 1), full = columns >> l;
        at[l + 1] = at[l] + (rows >> l) * full;
        w[l + 1] = lit ? w[l] + (rows >> l) * full : NULL;
        for (r = 0; r < rows >> (l + 1); ++r)
            for (c = 0; c < half; ++c) {
                float sum = 0, weight = 0;
                for (q = 0; q < 4; ++q) {
                    int i = (2 * r + (q >> 1)) * full + 2 * c + (q & 1);
                    float m = lit ? (w[l][i] < 1 ? w[l][i] : 1) : 0.25f;
                    sum += m * at[l][i];
                    weight += m;
                }
                at[l + 1][r * half + c] = weight > 0 ? sum / weight : 0;
                if (lit)
                    w[l + 1][r * half + c] = weight;
            }
    }
    for (l = n - 1; l >= 0; --l)
        for (r = 0; r < rows >> l; ++r)
            for (c = 0; c < columns >> l; ++c) {
                float up = gphi_coarse(at[l + 1], rows >> (l + 1), columns >> (l + 1), r, c), *x;
                x = &at[l][r * (columns >> l) + c];
                if (lit) {
                    float m = w[l][r * (columns >> l) + c];
                    m = m < 1 ? m : 1;
                    *x = m * *x + (1 - m) * up;
                } else
                    *x = up;
            }
}

/* What is learned of a voxel: its histogram after desc.repair; its sigma is noted. map and scratch have room for 2 *
 * bins. */
static void gphi_repair_map(const gph_field *f, gphi_voxel *v, float *map, float *scratch)
{
    int rows = (int)f->desc.rows, columns = 2 * rows;
    uint32_t i, n = gphi_bins(v, f->bins);
    memset(map, 0, f->bins * sizeof *map);
    memset(scratch, 0, f->bins * sizeof *scratch);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, f->bins, i);
        map[b.at] = *b.old + *b.now;
        scratch[b.at] = *b.count_old || *b.count_now ? 1.0f : 0.0f;
    }
    if (f->desc.repair == GPH_REPAIR_GAUSSIAN) {
        if (f->desc.sigma > 0)
            gphi_blur(map, scratch, rows, columns, (double)f->desc.sigma);
        else
            gphi_blur_likeliest(f, v, map, scratch);
    } else if (f->desc.repair == GPH_REPAIR_PYRAMID)
        gphi_pyramid(map, NULL, rows, columns, (int)f->desc.pyramid_levels);
    else if (f->desc.repair == GPH_REPAIR_PULL_PUSH)
        gphi_pyramid(map, scratch, rows, columns, (int)f->desc.pyramid_levels);
}

/* ---- >>weights ---------------------------------------------------------------------------------------------- */

/* x in 0 .. 65504 as the nearest half-float. */
static uint16_t gphi_half(float x)
{
    uint32_t bits;
    if (x < 6.1035156e-5f)
        return (uint16_t)(x * 16777216.0f + 0.5f);
    memcpy(&bits, &x, sizeof bits);
    return (uint16_t)((bits + 0x1000u - (112u << 23)) >> 13);
}

/* Parts of a map. */
static uint64_t *gphi_map_blocks(unsigned char *map, uint32_t rows)
{
    return (uint64_t *)(void *)map + ((rows + 8) & ~7u);
}
static uint16_t *gphi_map_weights(unsigned char *map, uint32_t rows)
{
    return (uint16_t *)(void *)(gphi_map_blocks(map, rows) + rows * rows / 4);
}

/* Sums of the weights before each row and each 8 bins. compare: tell whether they are there already, and write
   nothing. */
static bool gphi_sum_weights(unsigned char *map, uint32_t rows, bool compare)
{
    uint64_t *sums = (uint64_t *)(void *)map, *blocks = gphi_map_blocks(map, rows), sum = 0;
    const uint16_t *weights = gphi_map_weights(map, rows);
    uint32_t i, k, bins = rows * rows * 2;
    bool same = true;
    for (i = 0; i < bins / 8; ++i) {
        uint64_t *row = i % (rows / 4) == 0 ? &sums[i / (rows / 4)] : &blocks[i];
        same = same && blocks[i] == sum && *row == sum;
        if (!compare)
            blocks[i] = *row = sum;
        for (k = 0; k < 8; ++k)
            sum += gph_weight(weights[8 * i + k]);
    }
    same = same && sums[rows] == sum;
    if (!compare)
        sums[rows] = sum;
    return (same || !compare) && sum > 0;
}

/* Pivot and nearness. */
static float *gphi_map_pivot(unsigned char *map, uint32_t rows) { return (float *)(void *)(map + (rows + 1) * 8); }

/* A map of values >= 0 as weights whose largest is 2^15, with their sums, seen from the pivot of s. False, and nothing
   written, without light. */
static bool gphi_write_map(unsigned char *to, const float *map, uint32_t rows, const gphi_state *s)
{
    uint16_t *weights = gphi_map_weights(to, rows);
    float most = 0;
    double scale;
    uint32_t i, bins = rows * rows * 2;
    for (i = 0; i < bins; ++i)
        most = map[i] > most ? map[i] : most;
    if (!(most > 0 && most < INFINITY))
        return false;
    scale = 32768 / (double)most;
    for (i = 0; i < bins; ++i)
        weights[i] = map[i] > 0 ? gphi_half((float)((double)map[i] * scale)) : 0;
    memset(to + (rows + 1) * 8, 0, 56); /* between the sums of rows and of eights */
    memcpy(gphi_map_pivot(to, rows), s->pivot, sizeof s->pivot);
    gphi_map_pivot(to, rows)[3] = s->nearness;
    gphi_sum_weights(to, rows, false);
    return true;
}

/* ---- >>publish ---------------------------------------------------------------------------------------------- */

static void *gphi_part(const gphi_block *b, uint64_t at) { return (char *)(uintptr_t)b + at; }
static gph_voxel *gphi_block_voxels(const gphi_block *b) { return (gph_voxel *)gphi_part(b, b->voxels_at); }
static unsigned char *gphi_block_map(const gphi_block *b, uint32_t map)
{
    return (unsigned char *)gphi_part(b, b->maps_at + (uint64_t)map * b->map_bytes);
}

/* Offsets and size from the counts. */
static void gphi_block_layout(gphi_block *b)
{
    uint64_t at = (sizeof *b + 63) & ~(uint64_t)63;
    b->keys_at = at;
    at = (at + (uint64_t)b->slots * sizeof(uint64_t) + 63) & ~(uint64_t)63;
    b->roots_at = at;
    at = (at + (uint64_t)b->slots * sizeof(uint32_t) + 63) & ~(uint64_t)63;
    b->nodes_at = at;
    at = (at + (uint64_t)b->nodes * sizeof(gph_node) + 63) & ~(uint64_t)63;
    b->voxels_at = at;
    at = (at + (uint64_t)b->voxels * sizeof(gph_voxel) + 63) & ~(uint64_t)63;
    b->maps_at = at;
    b->size = at + (uint64_t)b->maps * b->map_bytes;
}

GPH_API gph_view gph_get_view(const gph_field *field)
{
    const gphi_block *b = field->block;
    gph_view view;
    memset(&view, 0, sizeof view);
    view.keys = (const uint64_t *)gphi_part(b, b->keys_at);
    view.roots = (const uint32_t *)gphi_part(b, b->roots_at);
    view.nodes = (const gph_node *)gphi_part(b, b->nodes_at);
    view.voxels = gphi_block_voxels(b);
    view.maps = (const unsigned char *)gphi_part(b, b->maps_at);
    memcpy(view.origin, b->origin, sizeof view.origin);
    view.inverse_side = b->side > 0 ? 1 / b->side : 0;
    view.side = (float)b->side;
    view.mask = b->slots - 1;
    view.voxel_count = b->voxels;
    view.rows = b->rows;
    view.columns = 2 * b->rows;
    view.map_bytes = b->map_bytes;
    view.uniform = b->uniform;
    return view;
}

typedef struct gphi_publish {
    gph_field *field;
    gphi_block *block;
} gphi_publish;

/* Whether a map is to be made anew: at the third of the photons that is new, what they add is more than noise. A closed
   voxel's is not used before it is tried again. */
static bool gphi_stale(const gphi_state *s)
{
    return s->map == GPH_NONE ||
           (s->changed & 1 && s->verdict != GPH_GATE_CLOSED && 3.0 * (double)s->fresh >= s->photons);
}

/* Stale maps are made anew, others kept. */
static void gphi_publish_maps(void *context, uint32_t begin, uint32_t end)
{
    const gphi_publish *p = (const gphi_publish *)context;
    const gph_field *f = p->field;
    float map[2 * GPHI_MAX_BINS], scratch[2 * GPHI_MAX_BINS];
    uint32_t i;
    for (i = begin; i < end; ++i) {
        gphi_voxel *v = &f->voxels[i];
        gph_voxel *out = &gphi_block_voxels(p->block)[i];
        out->alpha = 1;
        out->photons = (float)v->s.photons;
        out->reflected = v->s.reflected;
        out->level = (uint16_t)v->s.level;
        out->gate = (uint16_t)v->s.verdict;
        if (out->map == GPH_NONE)
            continue;
        if (!gphi_stale(&v->s))
            memcpy(gphi_block_map(p->block, out->map), gphi_block_map(f->block, v->s.map), f->map_bytes);
        else {
            gphi_repair_map(f, v, map, scratch);
            gphi_write_map(gphi_block_map(p->block, out->map), map, f->desc.rows, &v->s); /* it is lit */
        }
        out->alpha = v->s.verdict == GPH_GATE_CLOSED ? 1.0f : v->s.alpha;
    }
}

/* A voxel has a map where its histogram has light: halving may have left next to none. */
static bool gphi_lit(const gphi_voxel *v, uint32_t bins)
{
    uint32_t i, n = gphi_bins(v, bins);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, bins, i);
        if (*b.old + *b.now > GPHI_MIN_LIT)
            return true;
    }
    return false;
}

/* Cubes into the block's hash table. */
static void gphi_publish_cubes(const gph_field *f, gphi_block *b)
{
    uint64_t *keys = (uint64_t *)gphi_part(b, b->keys_at);
    uint32_t *roots = (uint32_t *)gphi_part(b, b->roots_at), i, slot;
    memset(keys, 0xff, b->slots * sizeof *keys);
    for (i = 0; i < f->cube_count; ++i) {
        slot = gph_hash_key(f->cubes[i].key) & (b->slots - 1);
        while (keys[slot] != GPH_NO_KEY)
            slot = (slot + 1) & (b->slots - 1);
        keys[slot] = f->cubes[i].key;
        roots[slot] = f->cubes[i].root;
    }
}

/* Whether all this, with so many bytes of sampling parts, is within 8 times the half-floats of all maps. */
static bool gphi_lean(const gph_field *f, uint64_t parts)
{
    return gphi_held(f) - f->block_bytes - f->spare_bytes + parts <= 16 * (uint64_t)f->bins * f->mapped;
}

/* See that the spare block has room for `size` bytes, and not for many more. After the first refine a new one has a
   quarter more where there is room: fresh memory is slow, zeroed by the system page by page. */
static bool gphi_spare_room(gph_field *f, uint64_t size)
{
    uint64_t bytes = f->stats.passes && gphi_lean(f, size + size / 4) ? size + size / 4 : size;
    if (f->spare && size <= f->spare_bytes && f->spare_bytes / 2 <= bytes)
        return true;
    gphi_drop_spare(f);
    if (gphi_held(f) - f->block_bytes + (bytes > f->block_bytes ? bytes : f->block_bytes) + bytes > f->desc.max_bytes)
        bytes = size; /* the next one is to find room too */
    if (bytes > (uint64_t)((size_t)-1 / 2))
        return false;
    f->spare = (gphi_block *)f->desc.allocate(f->desc.user, (size_t)bytes);
    f->spare_bytes = f->spare ? bytes : 0;
    return f->spare != NULL;
}

/* Make the spare block a sampling part, with its header and cubes; voxels and maps are to be written. False = out of
   memory. */
static bool gphi_block_make(gph_field *f, uint32_t maps)
{
    gphi_block shape, *b;
    memset(&shape, 0, sizeof shape);
    for (shape.slots = 16; shape.slots < 2 * f->cube_count;)
        shape.slots *= 2;
    shape.nodes = f->node_count;
    shape.voxels = f->voxel_count;
    shape.maps = maps;
    shape.rows = f->desc.rows;
    shape.map_bytes = f->map_bytes;
    shape.uniform = f->desc.uniform;
    memcpy(shape.origin, f->origin, sizeof shape.origin);
    shape.side = f->side;
    gphi_block_layout(&shape);
    if (!gphi_spare_room(f, shape.size))
        return false;
    b = f->spare;
    memset(b, 0, (size_t)shape.maps_at); /* gaps and free slots, so that saves are alike; maps are written in full */
    *b = shape;
    if (f->node_count)
        memcpy(gphi_part(b, b->nodes_at), f->nodes, f->node_count * sizeof *f->nodes);
    gphi_publish_cubes(f, b);
    return true;
}

/* The spare block becomes the sampling part, and the other way round. */
static void gphi_swap_blocks(gph_field *f)
{
    gphi_block *old = f->block;
    uint64_t bytes = f->block_bytes;
    f->block = f->spare;
    f->block_bytes = f->spare_bytes;
    f->spare = old;
    f->spare_bytes = bytes;
    if (bytes / 2 > f->block->size + f->block->size / 4 || !gphi_lean(f, f->block_bytes + f->spare_bytes))
        gphi_drop_spare(f);
}

/* Make what building knows the sampling part. */
static gph_result gphi_publish_all(gph_field *f, gph_parallel_fn parallel, void *user)
{
    gphi_publish p;
    uint32_t i, maps = 0;
    for (i = 0; i < f->voxel_count; ++i)
        maps += gphi_lit(&f->voxels[i], f->bins);
    p.field = f;
    if (!gphi_block_make(f, maps))
        return GPH_OUT_OF_MEMORY;
    p.block = f->spare;
    for (maps = i = 0; i < f->voxel_count; ++i)
        gphi_block_voxels(p.block)[i].map = gphi_lit(&f->voxels[i], f->bins) ? maps++ : GPH_NONE;
    gphi_run(parallel, user, f->voxel_count, 16, gphi_publish_maps, &p);
    for (i = 0; i < f->voxel_count; ++i) {
        gphi_state *s = &f->voxels[i].s;
        uint32_t map = gphi_block_voxels(p.block)[i].map, made = map != GPH_NONE && gphi_stale(s);
        f->stats.built += made;
        f->stats.skipped += map != GPH_NONE && !made;
        s->changed = !made ? s->changed & 1 : s->touched ? 2 : 0;
        s->fresh = made ? 0 : s->fresh;
        s->map = map;
        s->touched = 0;
    }
    gphi_swap_blocks(f);
    return GPH_OK;
}

/* ---- >>refine ----------------------------------------------------------------------------------------------- */

static uint64_t gphi_hash(uint64_t h, uint64_t x)
{
    h = (h ^ x) * 0x9fb21c651e98df25ull;
    return h ^ (h >> 29);
}

/* Hash of bytes, eight at a time. */
static uint64_t gphi_hash_bytes(uint64_t h, const void *data, size_t size)
{
    const unsigned char *p = (const unsigned char *)data;
    uint64_t word;
    for (; size >= 8; p += 8, size -= 8) {
        memcpy(&word, p, 8);
        h = gphi_hash(h, word);
    }
    for (word = 0; size; --size)
        word = word << 8 | p[size - 1];
    return gphi_hash(h, word);
}

/* Counters that follow from the sampling part and the histograms; id of the structure. */
static void gphi_count(gph_field *f)
{
    gph_stats *s = &f->stats;
    const gphi_block *b = f->block;
    uint32_t i;
    s->sparse = s->valid = s->levels = s->open_voxels = s->closed_voxels = s->unjudged_voxels = 0;
    f->guiding = 0;
    for (i = 0; i < f->voxel_count; ++i) {
        s->sparse += f->voxels[i].s.form == GPHI_FORM_SPARSE;
        s->valid += f->voxels[i].s.valid != 0;
    }
    for (i = 0; i < b->voxels; ++i) {
        const gph_voxel *v = &gphi_block_voxels(b)[i];
        s->levels = v->level > s->levels ? v->level : s->levels;
        s->open_voxels += v->map != GPH_NONE && v->gate == GPH_GATE_OPEN;
        s->closed_voxels += v->map != GPH_NONE && v->gate == GPH_GATE_CLOSED;
        s->unjudged_voxels += v->map != GPH_NONE && v->gate == GPH_GATE_UNJUDGED;
        f->guiding += v->alpha < 1;
    }
    s->cubes = f->cube_count;
    s->voxels = b->voxels;
    s->maps = b->maps;
    f->structure = gphi_hash(gphi_hash_bytes(1, f->origin, sizeof f->origin), s->passes);
    f->structure = gphi_hash_bytes(f->structure, &f->side, sizeof f->side);
    f->structure = gphi_hash_bytes(f->structure, gphi_part(b, b->keys_at), (size_t)(b->voxels_at - b->keys_at));
}

GPH_API gph_result gph_refine(gph_field *field, gph_parallel_fn parallel, void *user)
{
    gph_result result = GPH_OK;
    bool first = !field->cloud_closed || !field->first_photons; /* its cloud may have been cut in mid-pass */
    if (!field->cloud_closed && field->cloud_count) {
        gphi_batch b;
        if (!gphi_batch_make(&b, field))
            return GPH_OUT_OF_MEMORY;
        result = gphi_close_cloud(&b, parallel, user);
        gphi_batch_free(&b);
    }
    if (!field->first_photons)
        field->first_photons = field->stats.photons;
    if (!field->judged) {
        gphi_judge_all(field);
        if (!first && gphi_split_all(field))
            result = GPH_OUT_OF_MEMORY;
        gphi_recycle(field);
        gphi_place_all(field);
        field->judged = 1; /* what follows may fail: then the next call only publishes */
    }
    if (gphi_publish_all(field, parallel, user))
        return GPH_OUT_OF_MEMORY;
    field->judged = 0;
    field->stats.passes++;
    gphi_count(field);
    return result;
}

GPH_API bool gph_all_closed(const gph_field *field) { return field->guiding == 0; }

GPH_API double gph_photons_at(const gph_field *field, const float position[3], const float *normal)
{
    uint32_t voxel = gphi_find(field, position);
    return voxel != GPH_NONE && field->voxels[voxel].s.valid & gph_sides(normal) ? field->voxels[voxel].s.photons : -1;
}

GPH_API double gph_vertices_at(const gph_field *field, const float position[3])
{
    uint32_t voxel = gphi_find(field, position);
    const gphi_state *s = voxel != GPH_NONE ? &field->voxels[voxel].s : NULL;
    return s ? s->held.q_bsdf + s->held.q_guide + (double)s->touched : 0;
}

GPH_API bool gph_takes_photons(const gph_field *field, const float position[3], const float *normal)
{
    return gph_photons_at(field, position, normal) >= 0;
}

GPH_API void gph_get_stats(const gph_field *field, gph_stats *stats)
{
    *stats = field->stats;
    stats->bytes = gphi_held(field);
}

GPH_API uint64_t gph_structure_id(const gph_field *field) { return field->structure; }

/* ---- >>life ------------------------------------------------------------------------------------------------- */

GPH_API const char *gph_result_string(gph_result result)
{
#define GPH_RESULT_TEXT(name, text) text,
    static const char *const texts[] = {GPH_RESULTS(GPH_RESULT_TEXT) ""};
#undef GPH_RESULT_TEXT
    return (unsigned)result < (unsigned)GPH_RESULT_COUNT ? texts[result] : "unknown result";
}

static void gphi_default_u32(uint32_t *x, uint32_t value) { *x = *x ? *x : value; }
static void gphi_default_float(float *x, float value) { *x = *x != 0 ? *x : value; }
static bool gphi_within(double x, double low, double high) { return x >= low && x <= high; }
/* A float that is set to a limit is within, whichever way the limit is rounded. */
static bool gphi_within_float(float x, float low, float high) { return x >= low && x <= high; }

static bool gphi_bounds_ok(const gph_desc *d)
{
    int i;
    for (i = 0; i < 3; ++i) {
        double e = (double)d->bounds_max[i] - (double)d->bounds_min[i];
        if (!(e >= 0) || !(e < 1e30) || !(fabsf(d->bounds_min[i]) < 1e30f))
            return false;
    }
    return true;
}

/* All zero: the first camera vertices tell. */
static bool gphi_has_bounds(const gph_desc *d)
{
    int i;
    for (i = 0; i < 3; ++i)
        if (d->bounds_min[i] != 0 || d->bounds_max[i] != 0)
            return true;
    return false;
}

static bool gphi_ranges_ok(const gph_desc *d)
{
    return gphi_within(d->grid_cells, 1, 1024) && (d->rows == 16 || d->rows == 32 || d->rows == 64) &&
           gphi_within_float(d->split_photons, 16, 1e9f) && gphi_within(d->max_levels, 1, 24) &&
           gphi_within(d->keep_passes, 1, 1000) && gphi_within(d->cloud_photons, 1024, 1 << 28) &&
           d->max_bytes >= (uint64_t)1 << 20 && (d->sigma == 0 || gphi_within_float(d->sigma, 0.01f, 16)) &&
           gphi_within(d->pyramid_levels, 1, 5) && gphi_within_float(d->alpha, 0.05f, 1) &&
           gphi_within(d->ratio_samples, 1, 1e9) && gphi_within_float(d->uniform, 1e-4f, 1) &&
           gphi_within_float(d->gate_margin, 0.001f, 10) && gphi_within(d->gate_probe, 1, 1000);
}

GPH_API gph_result gph_resolve(const gph_desc *desc, gph_desc *resolved)
{
    gph_desc d = *desc;
    if (!d.allocate != !d.release)
        return GPH_BAD_ALLOCATOR;
    if (!d.allocate) {
        d.allocate = gphi_default_allocate;
        d.release = gphi_default_release;
    }
    gphi_default_u32(&d.grid_cells, 25);
    gphi_default_u32(&d.rows, 32);
    gphi_default_float(&d.split_photons, 500);
    gphi_default_u32(&d.max_levels, 18);
    gphi_default_u32(&d.keep_passes, 4);
    gphi_default_u32(&d.cloud_photons, 1u << 21);
    d.max_bytes = d.max_bytes ? d.max_bytes : (uint64_t)1 << 30;
    d.repair = d.repair ? d.repair : GPH_REPAIR_GAUSSIAN;
    gphi_default_u32(&d.pyramid_levels, 3);
    d.alpha_mode = d.alpha_mode ? d.alpha_mode : GPH_ALPHA_VARIANCE;
    gphi_default_float(&d.alpha, 0.5f);
    gphi_default_u32(&d.ratio_samples, 64);
    gphi_default_float(&d.uniform, 0.01f);
    gphi_default_float(&d.gate_margin, 0.05f);
    gphi_default_u32(&d.gate_probe, 4);
    if ((unsigned)d.repair >= (unsigned)GPH_REPAIR_COUNT_ || (unsigned)d.alpha_mode > (unsigned)GPH_ALPHA_VARIANCE)
        return GPH_BAD_OPTION;
    if (!gphi_bounds_ok(&d))
        return GPH_BAD_BOUNDS;
    if (!gphi_ranges_ok(&d))
        return GPH_BAD_RANGE;
    *resolved = d;
    return GPH_OK;
}

/* What follows from the descriptor. */
static void gphi_field_options(gph_field *f)
{
    f->bins = f->desc.rows * f->desc.rows * 2;
    f->map_bytes = ((f->desc.rows + 8) & ~7u) * 8 + f->bins + f->bins * 2;
}

GPH_API gph_result gph_create(const gph_desc *desc, gph_field **field)
{
    gph_desc d;
    gph_field *f;
    gph_result result = gph_resolve(desc, &d);
    *field = NULL;
    if (result)
        return result;
    f = (gph_field *)gphi_allocate(&d, 1, sizeof *f);
    if (!f)
        return GPH_OUT_OF_MEMORY;
    f->desc = d;
    gphi_field_options(f);
    if (gphi_has_bounds(&d))
        gphi_set_box(f, d.bounds_min, d.bounds_max);
    if (!gphi_block_make(f, 0)) {
        gphi_release(&d, f);
        return GPH_OUT_OF_MEMORY;
    }
    gphi_swap_blocks(f);
    gphi_count(f);
    *field = f;
    return GPH_OK;
}

GPH_API void gph_destroy(gph_field *field)
{
    gph_desc d;
    uint32_t i;
    if (!field)
        return;
    d = field->desc;
    for (i = 0; i < field->voxel_count; ++i)
        gphi_release(&d, field->voxels[i].data);
    gphi_release(&d, field->cubes);
    gphi_release(&d, field->slots);
    gphi_release(&d, field->nodes);
    gphi_release(&d, field->voxels);
    gphi_release(&d, field->cloud);
    gphi_release(&d, field->block);
    gphi_release(&d, field->spare);
    gphi_release(&d, field);
}

GPH_API const gph_desc *gph_get_desc(const gph_field *field) { return &field->desc; }

GPH_API uint32_t gph_voxel_count(const gph_field *field) { return field->block->voxels; }

/* ---- >>exchange --------------------------------------------------------------------------------------------- */

GPH_API uint32_t gph_changed_voxels(const gph_field *field, uint32_t *voxels, uint32_t capacity)
{
    uint32_t i, n = 0;
    for (i = 0; i < field->voxel_count; ++i)
        if (field->voxels[i].s.changed & 2) {
            if (voxels && n < capacity)
                voxels[n] = i;
            ++n;
        }
    return n;
}

/* Divide by the mean, or leave all zero. */
static void gphi_normalise(float *x, uint32_t n)
{
    double sum = 0;
    uint32_t i;
    for (i = 0; i < n; ++i)
        sum += (double)x[i];
    for (i = 0; i < n && sum > 0; ++i)
        x[i] = (float)((double)x[i] * n / sum);
}

GPH_API void gph_export_maps(const gph_field *field, const uint32_t *voxels, uint32_t count, float *features,
                             float *photons)
{
    uint32_t k, i, n, bins = field->bins;
    memset(features, 0, (size_t)count * GPH_FEATURES * bins * sizeof *features);
    for (k = 0; k < count; ++k, features += GPH_FEATURES * bins) {
        const gphi_voxel *v = voxels[k] < field->voxel_count ? &field->voxels[voxels[k]] : NULL;
        bool last; /* `now` is the pass that the last refine ended */
        if (photons)
            photons[k] = v ? (float)v->s.photons : 0;
        if (!v)
            continue;
        last = v->s.rolled + 1 >= field->stats.passes;
        for (i = 0, n = gphi_bins(v, bins); i < n; ++i) {
            gphi_bin b = gphi_get_bin(v, bins, i);
            float *x = features + b.at;
            x[0] = *b.old + *b.now;
            x[bins] = last ? *b.old : *b.old + *b.now;
            x[2 * bins] = (float)*b.count_old + (float)*b.count_now;
            x[3 * bins] = last ? (float)*b.count_old : (float)*b.count_old + (float)*b.count_now;
            x[4 * bins] = *b.count_old || *b.count_now ? 1.0f : 0.0f;
        }
        for (i = 0; i < 4; ++i)
            gphi_normalise(features + i * bins, bins);
    }
}

typedef struct gphi_import {
    gph_field *field;
    const uint32_t *voxels;
    const float *maps;
    unsigned char *taken;
} gphi_import;

static void gphi_import_some(void *context, uint32_t begin, uint32_t end)
{
    const gphi_import *p = (const gphi_import *)context;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        uint32_t v = p->voxels[i], map = v < p->field->voxel_count ? p->field->voxels[v].s.map : GPH_NONE;
        if (map != GPH_NONE)
            p->taken[i] = gphi_write_map(gphi_block_map(p->field->block, map), p->maps + (size_t)i * p->field->bins,
                                         p->field->desc.rows, &p->field->voxels[v].s);
    }
}

/* In pieces, so that the marks need no memory. A voxel listed twice in one piece would be written by two threads. */
GPH_API uint32_t gph_import_maps(gph_field *field, const uint32_t *voxels, uint32_t count, const float *maps,
                                 gph_parallel_fn parallel, void *user)
{
    unsigned char taken[4096];
    uint32_t begin, i, n, all = 0;
    for (begin = 0; begin < count; begin += n) {
        gphi_import p;
        n = count - begin < 4096 ? count - begin : 4096;
        memset(taken, 0, sizeof taken);
        p.field = field;
        p.voxels = voxels + begin;
        p.maps = maps + (size_t)begin * field->bins;
        p.taken = taken;
        gphi_run(parallel, user, n, 16, gphi_import_some, &p);
        for (i = 0; i < n; ++i)
            all += taken[i];
    }
    field->stats.imported += all;
    return all;
}

/* ---- >>batches ---------------------------------------------------------------------------------------------- */

static const float *gphi_row(const float *rows, size_t stride, uint32_t i)
{
    return (const float *)(const void *)((const char *)rows + stride * i);
}

static uint32_t gphi_at(const uint32_t *index, uint32_t k) { return index ? index[k] : k; }

/* Maps lie anywhere in memory: a group's queries ask for what each will read next, then go on together. */

GPH_API void gph_find_batch(const gph_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gph_handle *handles, float *alpha)
{
    uint32_t voxels[GPHI_GROUP], begin, k, n;
    for (begin = 0; begin < count; begin += n) {
        n = count - begin < GPHI_GROUP ? count - begin : GPHI_GROUP;
        for (k = 0; k < n; ++k) {
            const float *p = gphi_row(positions, position_stride, gphi_at(index, begin + k));
            uint32_t slot = gph_hash_key(gph_cube_key(view->origin, view->inverse_side, p)) & view->mask;
            GPHI_PREFETCH(&view->keys[slot]);
            GPHI_PREFETCH(&view->roots[slot]);
        }
        for (k = 0; k < n; ++k) {
            uint32_t i = gphi_at(index, begin + k);
            voxels[k] =
                gph_choose_voxel(view, gphi_row(positions, position_stride, i), u ? gphi_row(u, u_stride, i) : NULL);
            if (voxels[k] != GPH_NONE)
                GPHI_PREFETCH(&view->voxels[voxels[k]]);
        }
        for (k = 0; k < n; ++k) {
            uint32_t map = voxels[k] == GPH_NONE ? GPH_NONE : view->voxels[voxels[k]].map, r;
            for (r = 0; map != GPH_NONE && r < view->rows + 8; r += 8)
                GPHI_PREFETCH((const uint64_t *)(const void *)(view->maps + (size_t)map * view->map_bytes) + r);
        }
        for (k = 0; k < n; ++k) {
            uint32_t i = gphi_at(index, begin + k);
            gph_set_place(view, voxels[k], gphi_row(positions, position_stride, i),
                          normals ? gphi_row(normals, normal_stride, i) : NULL, &handles[i]);
            if (alpha)
                alpha[i] = handles[i].alpha;
        }
    }
}

GPH_API void gph_sample_batch(const gph_view *view, uint32_t count, const uint32_t *index, const gph_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t direction_stride, float *pdf)
{
    gph_draw draws[GPHI_GROUP];
    uint32_t begin, k, n;
    (void)view;
    for (begin = 0; begin < count; begin += n) {
        n = count - begin < GPHI_GROUP ? count - begin : GPHI_GROUP;
        for (k = 0; k < n; ++k) {
            const gph_handle *h = &handles[gphi_at(index, begin + k)];
            if (!h->weights)
                continue;
            gph_draw_row(h, gphi_row(u, u_stride, gphi_at(index, begin + k)), &draws[k]);
            GPHI_PREFETCH(h->blocks + draws[k].row * (h->columns / 8));
        }
        for (k = 0; k < n; ++k) {
            const gph_handle *h = &handles[gphi_at(index, begin + k)];
            if (!h->weights)
                continue;
            gph_draw_block(h, &draws[k]);
            GPHI_PREFETCH(h->weights + draws[k].block * 8);
        }
        for (k = 0; k < n; ++k) {
            uint32_t i = gphi_at(index, begin + k);
            const float *x = gphi_row(u, u_stride, i);
            bool drawn = handles[i].weights != NULL;
            float z = drawn ? draws[k].z : 2 * x[0] - 1;
            float phi = drawn ? gph_draw_phi(&handles[i], &draws[k]) : 2 * GPH_PI * x[1];
            pdf[i] = gph_draw_end(&handles[i], z, phi, (float *)(void *)((char *)directions + direction_stride * i));
        }
    }
}

GPH_API void gph_pdf_batch(const gph_view *view, uint32_t count, const uint32_t *index, const gph_handle *handles,
                           const float *directions, size_t direction_stride, float *pdf)
{
    uint32_t k;
    (void)view;
    for (k = 0; k < count; ++k) {
        uint32_t i = gphi_at(index, k);
        pdf[i] = gph_pdf(&handles[i], gphi_row(directions, direction_stride, i));
    }
}

/* ---- >>files ------------------------------------------------------------------------------------------------ */

/* The descriptor without pointers; no padding. */
typedef struct gphi_options {
    uint64_t max_bytes;
    float bounds_min[3], bounds_max[3];
    float split_photons, sigma, alpha, uniform, gate_margin, reserved;
    uint32_t grid_cells, rows, max_levels, keep_passes, cloud_photons, repair, pyramid_levels, alpha_mode,
        ratio_samples, no_gate, gate_probe, spare;
} gphi_options;

/* A save: this, cubes, nodes, voxels, histograms, cloud, the sampling part. */
typedef struct gphi_header {
    char magic[8];
    uint32_t version, byte_order;
    uint64_t size;     /* of all */
    uint64_t checksum; /* of what follows this member */
    gphi_options options;
    gph_stats stats;
    double origin[3], side;
    uint64_t first_photons, pass_photons, pass_useful, block_size;
    uint32_t cubes, nodes, voxels, cloud, cloud_closed, judged;
} gphi_header;

static const char gphi_magic[8] = {'g', 'u', 'i', 'd', 'e', 'p', 'h', 'o'};
#define GPHI_BYTE_ORDER 0x01020304u
#define GPHI_CHECKED_FROM (offsetof(gphi_header, options))

/* Members that both structures have alike. */
#define GPHI_OPTIONS(X)                                                                                                \
    X(max_bytes)                                                                                                       \
    X(split_photons)                                                                                                   \
    X(sigma)                                                                                                           \
    X(alpha)                                                                                                           \
    X(uniform)                                                                                                         \
    X(gate_margin)                                                                                                     \
    X(grid_cells)                                                                                                      \
    X(rows) X(max_levels) X(keep_passes) X(cloud_photons) X(pyramid_levels) X(ratio_samples) X(gate_probe)

static gphi_options gphi_options_of(const gph_desc *d)
{
    gphi_options o;
    memset(&o, 0, sizeof o);
#define GPHI_COPY(name) o.name = d->name;
    GPHI_OPTIONS(GPHI_COPY)
#undef GPHI_COPY
    memcpy(o.bounds_min, d->bounds_min, sizeof o.bounds_min);
    memcpy(o.bounds_max, d->bounds_max, sizeof o.bounds_max);
    o.repair = (uint32_t)d->repair;
    o.alpha_mode = (uint32_t)d->alpha_mode;
    o.no_gate = d->no_gate ? 1 : 0;
    return o;
}

/* The other way; the allocator stays as it is in d. */
static void gphi_options_to(const gphi_options *o, gph_desc *d)
{
#define GPHI_COPY(name) d->name = o->name;
    GPHI_OPTIONS(GPHI_COPY)
#undef GPHI_COPY
    memcpy(d->bounds_min, o->bounds_min, sizeof o->bounds_min);
    memcpy(d->bounds_max, o->bounds_max, sizeof o->bounds_max);
    d->repair = (gph_repair)o->repair;
    d->alpha_mode = (gph_alpha_mode)o->alpha_mode;
    d->no_gate = o->no_gate != 0;
}

GPH_API size_t gph_save_bound(const gph_field *field)
{
    return (size_t)(sizeof(gphi_header) + field->cube_count * sizeof(gphi_cube) + field->node_count * sizeof(gph_node) +
                    field->voxel_count * sizeof(gphi_voxel) + field->data_bytes +
                    field->cloud_count * sizeof(gphi_cloud_photon) + field->block->size);
}

static void gphi_write(char **at, const void *data, size_t size)
{
    if (size)
        memcpy(*at, data, size);
    *at += size;
}

GPH_API gph_result gph_save(const gph_field *field, void *data, size_t capacity, size_t *size)
{
    gphi_header h;
    char *at = (char *)data;
    uint32_t i;
    *size = gph_save_bound(field);
    if (capacity < *size)
        return GPH_BUFFER_TOO_SMALL;
    memset(&h, 0, sizeof h);
    memcpy(h.magic, gphi_magic, sizeof h.magic);
    h.version = GPH_VERSION;
    h.byte_order = GPHI_BYTE_ORDER;
    h.size = *size;
    h.options = gphi_options_of(&field->desc);
    h.stats = field->stats;
    memcpy(h.origin, field->origin, sizeof h.origin);
    h.side = field->side;
    h.first_photons = field->first_photons;
    h.pass_photons = field->pass_photons;
    h.pass_useful = field->pass_useful;
    h.block_size = field->block->size;
    h.cubes = field->cube_count;
    h.nodes = field->node_count;
    h.voxels = field->voxel_count;
    h.cloud = field->cloud_count;
    h.cloud_closed = field->cloud_closed;
    h.judged = field->judged;
    gphi_write(&at, &h, sizeof h);
    gphi_write(&at, field->cubes, field->cube_count * sizeof *field->cubes);
    gphi_write(&at, field->nodes, field->node_count * sizeof *field->nodes);
    for (i = 0; i < field->voxel_count; ++i) {
        gphi_voxel v = field->voxels[i];
        v.s.blocked = 0;
        v.data = NULL;
        gphi_write(&at, &v, sizeof v);
    }
    for (i = 0; i < field->voxel_count; ++i)
        gphi_write(&at, field->voxels[i].data, gphi_data_bytes(&field->voxels[i], field->bins));
    gphi_write(&at, field->cloud, field->cloud_count * sizeof *field->cloud);
    gphi_write(&at, field->block, (size_t)field->block->size);
    h.checksum = gphi_hash_bytes(1, (char *)data + GPHI_CHECKED_FROM, *size - GPHI_CHECKED_FROM);
    memcpy(data, &h, sizeof h);
    return GPH_OK;
}

/* A tree whose children come after their parents, no deeper than depth allows, no voxel named twice. */
typedef struct gphi_tree {
    const gph_node *nodes;
    unsigned char *seen;      /* per voxel */
    const gphi_voxel *voxels; /* NULL, or those whose levels must fit */
    uint32_t node_count, voxel_count, visited;
} gphi_tree;

static bool gphi_tree_valid(gphi_tree *t, uint32_t node, uint32_t depth)
{
    uint32_t link, child;
    if (node >= t->node_count || depth > 24)
        return false;
    t->visited++;
    link = t->nodes[node].link;
    child = link & 0x1fffffffu;
    if (link & GPH_LEAF) {
        link &= ~GPH_LEAF;
        if (link >= t->voxel_count || t->seen[link] || (t->voxels && t->voxels[link].s.level != depth))
            return false;
        t->seen[link] = 1;
        return true;
    }
    return link >> 29 <= 2 && gphi_finite(t->nodes[node].split) && child > node && child + 1 < t->node_count &&
           gphi_tree_valid(t, child, depth + 1) && gphi_tree_valid(t, child + 1, depth + 1);
}

static bool gphi_sums_valid(const gphi_sums *s)
{
    const double *x = (const double *)(const void *)s;
    bool ok = true;
    uint32_t k;
    for (k = 0; k < sizeof *s / sizeof *x; ++k)
        ok = ok && x[k] >= 0 && x[k] < 1e160;
    return ok;
}

static bool gphi_pivot_ok(const float pivot[3], float nearness)
{
    return gphi_finite(pivot[0]) && gphi_finite(pivot[1]) && gphi_finite(pivot[2]) && nearness >= 0 &&
           nearness <= 1e30f;
}

static bool gphi_voxel_valid(const gph_field *f, const gphi_voxel *v)
{
    uint32_t i, n = gphi_bins(v, f->bins), last = 0;
    if (!gphi_sums_valid(&v->s.now) || !gphi_sums_valid(&v->s.held) || !(v->s.photons >= 0 && v->s.photons < 1e30) ||
        v->s.valid > GPH_ALL_SIDES || v->s.rolled > f->stats.passes ||
        (v->s.map != GPH_NONE && v->s.map >= f->block->maps) || v->s.changed > 3 || v->sigma > GPHI_SIGMAS ||
        v->s.verdict > GPH_GATE_CLOSED || !gphi_within_float(v->s.alpha, 0.04f, 1) ||
        !gphi_within_float(v->s.reflected, 0, 1e30f) || !gphi_within_float(v->s.chosen, 0, 1e30f) ||
        !gphi_pivot_ok(v->s.pivot, v->s.nearness))
        return false;
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(v, f->bins, i);
        if (b.at >= f->bins || (i && b.at <= last) || !(*b.old >= 0 && *b.old <= GPHI_MAX_SUM) ||
            !(*b.now >= 0 && *b.now <= GPHI_MAX_SUM))
            return false;
        last = b.at;
    }
    return true;
}

/* Sizes of a histogram that must hold before it is looked into. */
static bool gphi_form_valid(const gphi_state *s, uint32_t capacity)
{
    return s->form == GPHI_FORM_SPARSE
               ? capacity >= 8 && capacity <= GPHI_SPARSE && (capacity & (capacity - 1)) == 0 && s->entries <= capacity
               : s->form <= GPHI_FORM_DENSE && capacity == 0 && s->entries == 0;
}

static gph_result gphi_building_valid(const gph_field *f)
{
    gphi_tree t;
    uint32_t i;
    bool ok = true;
    memset(&t, 0, sizeof t);
    t.seen = (unsigned char *)gphi_allocate(&f->desc, f->voxel_count, 1);
    if (!t.seen)
        return GPH_OUT_OF_MEMORY;
    t.nodes = f->nodes;
    t.voxels = f->voxels;
    t.node_count = f->node_count;
    t.voxel_count = f->voxel_count;
    for (i = 0; ok && i < f->cube_count; ++i)
        ok = f->cubes[i].key >> 63 == 0 && gphi_find_cube(f, f->cubes[i].key) == i && /* else another has its key */
             gphi_tree_valid(&t, f->cubes[i].root, 0);
    ok = ok && t.visited == f->node_count;
    for (i = 0; ok && i < f->voxel_count; ++i)
        ok = t.seen[i] && gphi_form_valid(&f->voxels[i].s, f->voxels[i].capacity) && gphi_voxel_valid(f, &f->voxels[i]);
    for (i = 0; ok && i < f->cloud_count; ++i)
        ok = f->cloud[i].voxel < f->voxel_count && gphi_photon_ok(&f->cloud[i].photon) && f->cloud[i].photon.flux > 0 &&
             gphi_find(f, f->cloud[i].photon.position) == f->cloud[i].voxel;
    gphi_release(&f->desc, t.seen);
    return ok ? GPH_OK : GPH_CORRUPT;
}

static bool gphi_map_valid(unsigned char *map, uint32_t rows)
{
    const uint16_t *weights = gphi_map_weights(map, rows);
    uint32_t i;
    for (i = 0; i < rows * rows * 2; ++i)
        if (weights[i] > 0x7800)
            return false;
    return gphi_pivot_ok(gphi_map_pivot(map, rows), gphi_map_pivot(map, rows)[3]) && gphi_sum_weights(map, rows, true);
}

/* Shape of the block against its own counts: before anything in it is looked at. */
static bool gphi_block_shape_valid(const gphi_block *b, uint64_t size, const gph_field *f)
{
    gphi_block shape = *b;
    if (b->slots < 16 || (b->slots & (b->slots - 1)) || b->nodes > 4 * (uint64_t)GPHI_MAX_VOXELS ||
        b->voxels > GPHI_MAX_VOXELS || b->maps > b->voxels || b->rows != f->desc.rows || b->map_bytes != f->map_bytes)
        return false;
    gphi_block_layout(&shape);
    return shape.size == size && memcmp(&shape, b, sizeof shape) == 0 && gphi_within_float(b->uniform, 1e-4f, 1) &&
           b->side >= 0 && b->side < 1e31;
}

static gph_result gphi_block_valid(const gph_field *f)
{
    const gphi_block *b = f->block;
    const uint64_t *keys = (const uint64_t *)gphi_part(b, b->keys_at);
    const uint32_t *roots = (const uint32_t *)gphi_part(b, b->roots_at);
    gphi_tree t;
    uint32_t i, used = 0;
    bool ok = true;
    memset(&t, 0, sizeof t);
    t.seen = (unsigned char *)gphi_allocate(&f->desc, b->voxels, 1);
    if (!t.seen)
        return GPH_OUT_OF_MEMORY;
    t.nodes = (const gph_node *)gphi_part(b, b->nodes_at);
    t.node_count = b->nodes;
    t.voxel_count = b->voxels;
    for (i = 0; ok && i < b->slots; ++i)
        if (keys[i] != GPH_NO_KEY) {
            ok = gphi_tree_valid(&t, roots[i], 0);
            ++used;
        }
    ok = ok && used <= b->slots / 2 && t.visited == b->nodes;
    for (i = 0; ok && i < b->voxels; ++i) {
        const gph_voxel *v = &gphi_block_voxels(b)[i];
        ok = t.seen[i] && (v->map == GPH_NONE || v->map < b->maps) && gphi_within_float(v->alpha, 0.04f, 1) &&
             gphi_within_float(v->reflected, 0, 1e30f) && v->gate <= GPH_GATE_CLOSED && v->level <= 24;
    }
    for (i = 0; ok && i < b->maps; ++i)
        ok = gphi_map_valid(gphi_block_map(b, i), f->desc.rows);
    gphi_release(&f->desc, t.seen);
    return ok ? GPH_OK : GPH_CORRUPT;
}

GPH_API gph_result gph_validate(const gph_field *field)
{
    gph_result result = gphi_building_valid(field);
    if (result)
        return result;
    return gphi_block_shape_valid(field->block, field->block->size, field) ? gphi_block_valid(field) : GPH_CORRUPT;
}

/* Data that is read front to back. */
typedef struct gphi_reader {
    const char *at;
    size_t left;
    bool cut; /* something was not there */
} gphi_reader;

/* Copy of the next count * size bytes in memory of its own; NULL where they are not there or memory is out. */
static void *gphi_read(gphi_reader *r, const gph_desc *desc, uint64_t count, size_t size)
{
    void *p;
    r->cut = r->cut || count > r->left / size;
    if (r->cut)
        return NULL;
    p = gphi_allocate(desc, count, size);
    if (p && count)
        memcpy(p, r->at, (size_t)count * size);
    r->at += count * size;
    r->left -= (size_t)count * size;
    return p;
}

/* The voxels with their histograms. */
static gph_result gphi_load_voxels(gph_field *f, uint32_t count, gphi_reader *r)
{
    uint32_t i;
    f->voxels = (gphi_voxel *)gphi_read(r, &f->desc, count, sizeof *f->voxels);
    if (!f->voxels)
        return r->cut ? GPH_BAD_FILE : GPH_OUT_OF_MEMORY;
    f->voxel_count = f->voxel_capacity = count;
    for (i = 0; i < count; ++i)
        f->voxels[i].data = NULL;
    for (i = 0; i < count; ++i) {
        gphi_voxel *v = &f->voxels[i];
        if (!gphi_form_valid(&v->s, v->capacity) || v->s.blocked)
            return GPH_BAD_FILE;
        if (v->s.form == GPHI_FORM_EMPTY)
            continue;
        v->data = gphi_read(r, &f->desc, gphi_data_bytes(v, f->bins), 1);
        if (!v->data)
            return r->cut ? GPH_BAD_FILE : GPH_OUT_OF_MEMORY;
        f->mapped++;
        f->data_bytes += gphi_data_bytes(v, f->bins);
    }
    return GPH_OK;
}

/* The parts of a save after the header; what cannot be read stays NULL. */
static gph_result gphi_load_parts(gph_field *f, const gphi_header *h, gphi_reader *r)
{
    const gph_desc *d = &f->desc;
    gph_result result;
    f->cubes = (gphi_cube *)gphi_read(r, d, h->cubes, sizeof *f->cubes);
    f->nodes = (gph_node *)gphi_read(r, d, h->nodes, sizeof *f->nodes);
    if (!f->cubes || !f->nodes)
        return r->cut ? GPH_BAD_FILE : GPH_OUT_OF_MEMORY;
    f->cube_count = f->cube_capacity = h->cubes;
    f->node_count = f->node_capacity = h->nodes;
    result = gphi_load_voxels(f, h->voxels, r);
    if (result)
        return result;
    f->cloud = (gphi_cloud_photon *)gphi_read(r, d, h->cloud, sizeof *f->cloud);
    if (!f->cloud)
        return r->cut ? GPH_BAD_FILE : GPH_OUT_OF_MEMORY;
    f->cloud_count = f->cloud_capacity = h->cloud;
    if (h->block_size < sizeof(gphi_block) || h->block_size != r->left)
        return GPH_BAD_FILE;
    f->block = (gphi_block *)gphi_read(r, d, h->block_size, 1);
    f->block_bytes = f->block ? h->block_size : 0;
    if (!f->block || !gphi_hash_cubes(f, h->cubes))
        return GPH_OUT_OF_MEMORY;
    return gphi_block_shape_valid(f->block, h->block_size, f) ? gph_validate(f) : GPH_BAD_FILE;
}

/* Numbers of a header that must hold before memory is asked for. */
static bool gphi_header_valid(const gphi_header *h, const gph_desc *d)
{
    int k;
    bool ok = h->voxels <= GPHI_MAX_VOXELS && h->nodes <= 2 * h->voxels && h->cubes <= h->voxels &&
              h->cloud <= d->cloud_photons && h->cloud_closed <= 1 && h->judged <= 1 && h->stats.passes < 1u << 30 &&
              h->side >= 0 && h->side < 1e31 && (h->side > 0 || h->voxels == 0);
    for (k = 0; k < 3; ++k)
        ok = ok && fabs(h->origin[k]) < 1e31;
    return ok && gphi_within_float(h->stats.closed_share, 0, 1) && gphi_within_float(h->stats.mean_alpha, 0, 1) &&
           gphi_within_float(h->stats.useful_share, 0, 1);
}

GPH_API gph_result gph_load(const gph_desc *desc, const void *data, size_t size, gph_field **field)
{
    gphi_header h;
    gphi_reader r;
    gph_desc d;
    gph_field *f;
    gph_result result;
    *field = NULL;
    if (size < sizeof h)
        return GPH_BAD_FILE;
    memcpy(&h, data, sizeof h);
    if (memcmp(h.magic, gphi_magic, sizeof h.magic) != 0)
        return GPH_BAD_FILE;
    if (h.version != GPH_VERSION || h.byte_order != GPHI_BYTE_ORDER)
        return GPH_BAD_VERSION;
    if (h.size != size ||
        h.checksum != gphi_hash_bytes(1, (const char *)data + GPHI_CHECKED_FROM, size - GPHI_CHECKED_FROM))
        return GPH_BAD_FILE;
    memset(&d, 0, sizeof d);
    gphi_options_to(&h.options, &d);
    if (desc) {
        d.allocate = desc->allocate;
        d.release = desc->release;
        d.user = desc->user;
    }
    result = gph_resolve(&d, &d);
    if (result)
        return result == GPH_BAD_ALLOCATOR ? result : GPH_BAD_FILE;
    if (!gphi_header_valid(&h, &d))
        return GPH_BAD_FILE;
    f = (gph_field *)gphi_allocate(&d, 1, sizeof *f);
    if (!f)
        return GPH_OUT_OF_MEMORY;
    f->desc = d;
    f->stats = h.stats;
    memcpy(f->origin, h.origin, sizeof f->origin);
    f->side = h.side;
    f->first_photons = h.first_photons;
    f->pass_photons = h.pass_photons;
    f->pass_useful = h.pass_useful;
    f->cloud_closed = h.cloud_closed;
    f->judged = h.judged;
    gphi_field_options(f);
    r.at = (const char *)data + sizeof h;
    r.left = size - sizeof h;
    r.cut = false;
    result = gphi_load_parts(f, &h, &r);
    if (result) {
        gph_destroy(f);
        return result == GPH_CORRUPT ? GPH_BAD_FILE : result;
    }
    gphi_count(f);
    f->stats = h.stats; /* as of the last refine */
    *field = f;
    return GPH_OK;
}

/* Whether two subtrees are cut alike. */
static bool gphi_same_tree(const gph_field *f, uint32_t a, const gph_field *g, uint32_t b)
{
    const gph_node *x = &f->nodes[a], *y = &g->nodes[b];
    uint32_t c = x->link & 0x1fffffffu, d = y->link & 0x1fffffffu;
    if (x->link & GPH_LEAF || y->link & GPH_LEAF)
        return (x->link & y->link & GPH_LEAF) != 0;
    return x->link >> 29 == y->link >> 29 && x->split == y->split && gphi_same_tree(f, c, g, d) &&
           gphi_same_tree(f, c + 1, g, d + 1);
}

/* Add what voxel `from` of g got in this pass to voxel `to`. */
static gph_result gphi_merge_voxel(gph_field *f, uint32_t to, const gph_field *g, uint32_t from)
{
    const gphi_voxel *source = &g->voxels[from];
    gphi_voxel *v = &f->voxels[to];
    double *sum = (double *)(void *)&v->s.now;
    const double *more = (const double *)(const void *)&source->s.now;
    float shift[3];
    uint32_t i, n = gphi_bins(source, g->bins), lit = 0;
    if (source->s.rolled != g->stats.passes)
        n = 0; /* no photons in this pass */
    for (i = 0; i < sizeof(gphi_sums) / sizeof(double); ++i)
        sum[i] += more[i];
    v->s.touched += source->s.touched;
    v->s.valid |= source->s.valid;
    f->stats.vertices += source->s.touched;
    for (i = 0; i < n; ++i)
        lit += *gphi_get_bin(source, g->bins, i).count_now > 0;
    if (!lit)
        return GPH_OK;
    if (v->s.form == GPHI_FORM_EMPTY) {
        memcpy(v->s.pivot, source->s.pivot, sizeof v->s.pivot);
        v->s.nearness = source->s.nearness;
    }
    gphi_shift(&source->s, v->s.pivot, shift);
    if (gphi_make_room(f, to, lit) || v->s.blocked)
        return GPH_OUT_OF_MEMORY;
    gphi_roll(v, f->bins, f->stats.passes);
    for (i = 0; i < n; ++i) {
        gphi_bin b = gphi_get_bin(source, g->bins, i);
        uint32_t at =
            shift[0] != 0 || shift[1] != 0 || shift[2] != 0 ? gphi_moved_bin(f->desc.rows, b.at, shift) : b.at;
        if (*b.count_now)
            gphi_add(v, f->bins, at, *b.now, *b.count_now);
        f->stats.photons += *b.count_now;
    }
    v->s.changed |= 1;
    return GPH_OK;
}

static gph_result gphi_merge_tree(gph_field *f, uint32_t a, const gph_field *g, uint32_t b)
{
    uint32_t c = f->nodes[a].link, d = g->nodes[b].link;
    gph_result low, high;
    if (c & GPH_LEAF)
        return gphi_merge_voxel(f, c & ~GPH_LEAF, g, d & ~GPH_LEAF);
    low = gphi_merge_tree(f, c & 0x1fffffffu, g, d & 0x1fffffffu);
    high = gphi_merge_tree(f, (c & 0x1fffffffu) + 1, g, (d & 0x1fffffffu) + 1);
    return low ? low : high;
}

/* Photons of the first pass. */
static gph_result gphi_merge_cloud(gph_field *f, const gph_field *g, gph_parallel_fn parallel, void *user)
{
    gphi_batch b;
    gph_result result = GPH_OK;
    uint32_t i, k;
    if (!g->cloud_count)
        return GPH_OK;
    if (!gphi_batch_make(&b, f))
        return GPH_OUT_OF_MEMORY;
    for (i = 0; i < g->cloud_count; i += b.count) {
        b.count = g->cloud_count - i < GPHI_BATCH ? g->cloud_count - i : GPHI_BATCH;
        for (k = 0; k < b.count; ++k) {
            b.voxel[k] = gphi_find(f, g->cloud[i + k].photon.position);
            b.samples[k] = &g->cloud[i + k].photon;
            f->stats.photons += b.voxel[k] < f->voxel_count;
        }
        if (gphi_settle(&b, parallel, user))
            result = GPH_OUT_OF_MEMORY;
    }
    gphi_batch_free(&b);
    return result;
}

GPH_API gph_result gph_merge(gph_field *field, const gph_field *source, gph_parallel_fn parallel, void *user)
{
    gph_result result = GPH_OK, one;
    uint32_t i, cube;
    if (field->structure != source->structure || field->desc.rows != source->desc.rows || !(field->side > 0) ||
        field->side != source->side || memcmp(field->origin, source->origin, sizeof field->origin) != 0 ||
        field->cloud_closed != source->cloud_closed)
        return GPH_MISMATCH;
    for (i = 0; i < source->cube_count; ++i) {
        cube = gphi_find_cube(field, source->cubes[i].key);
        if (cube == GPH_NONE ? !(source->nodes[source->cubes[i].root].link & GPH_LEAF)
                             : !gphi_same_tree(field, field->cubes[cube].root, source, source->cubes[i].root))
            return GPH_MISMATCH;
    }
    for (i = 0; i < source->cube_count; ++i) {
        bool denied = false;
        if (gphi_find_cube(field, source->cubes[i].key) == GPH_NONE &&
            gphi_add_cube(field, source->cubes[i].key, &denied) == GPH_NONE) {
            result = GPH_OUT_OF_MEMORY;
            continue;
        }
        cube = gphi_find_cube(field, source->cubes[i].key);
        one = gphi_merge_tree(field, field->cubes[cube].root, source, source->cubes[i].root);
        result = result ? result : one;
    }
    field->pass_photons += source->pass_photons;
    field->pass_useful += source->pass_useful;
    one = gphi_merge_cloud(field, source, parallel, user);
    return result ? result : one;
}

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

#endif /* GPH_IMPLEMENTATION */

/* ---- >>licence

   This file is available under two licences; choose either.

   MIT licence. Copyright (c) 2026 guide authors

   Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
   documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
   rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to
   permit persons to whom the Software is furnished to do so, subject to the following conditions: the above copyright
   notice and this permission notice shall be included in all copies or substantial portions of the Software.

   THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
   WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
   COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
   OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.

   Unlicense (public domain, www.unlicense.org). This is free and unencumbered software released into the public domain.
   Anyone is free to copy, modify, publish, use, compile, sell, or distribute this software, either in source code form
   or as a compiled binary, for any purpose, commercial or non-commercial, and by any means. In jurisdictions that
   recognize copyright laws, the author or authors of this software dedicate any and all copyright interest in the
   software to the public domain. THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND. */
