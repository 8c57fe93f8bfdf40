/* guide_sdtree.h 0.1: path guiding with a spatial tree of directional quadtrees (SD-tree). Licence: MIT or Unlicense.

   In exactly one file, before including it:        #define GSD_IMPLEMENTATION
   Everywhere else only:                            #include "guide_sdtree.h"

   A path tracer samples directions better when it knows where light comes from. This header learns that while
   rendering: record radiance samples, accumulate, refine, then ask for directions and their densities. C99 or C++11,
   C standard library only (link with -lm).

       #define GSD_IMPLEMENTATION
       #include "guide_sdtree.h"
       int main(void)
       {
           static gsd_desc desc; // zero: all defaults
           gsd_field *field; gsd_stream *stream;
           desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1; // the scene: a box 0 .. 1
           if (gsd_create(&desc, &field) || gsd_stream_create(field, &stream))
               return 1;
           for (int pass = 0; pass < 6; ++pass) { // trace with the field, then learn
               gsd_view view = gsd_get_view(field);
               for (int i = 0; i < (1000 << pass); ++i) { // "trace": a lamp of radiance 100 around +x
                   float p[3] = {0.5f, 0.5f, 0.5f}, d[3];
                   float u[2] = {(float)(rand() & 0xffff) / 65536.0f, (float)(rand() & 0xffff) / 65536.0f};
                   gsd_handle handle = gsd_find(&view, p, NULL, NULL);
                   float pdf = gsd_sample(&view, &handle, u, d), L = d[0] > 0.95f ? 100.0f : 1.0f;
                   gsd_training_sample sample = gsd_make_scalar_sample(p, d, NULL, 3, L, L, L, pdf, pdf, 0);
                   gsd_record(stream, &sample, 1);
               }
               gsd_accumulate(field, &stream, 1, NULL, NULL);
               gsd_stream_clear(stream);
               gsd_refine(field, NULL, NULL, NULL);
           }
           return gsd_stream_destroy(stream), gsd_destroy(field), 0;
       }

   CONTENTS (search for the tag)
     >>config    macros, versions              >>query   inline: find, sample, pdf
     >>types     descriptor, sample, results   >>batch   find, sample, pdf of arrays
     >>field     create, refine, stats         >>store   save, load, merge, export, import
     implementation:
     >>memory  >>math  >>streams  >>trees  >>denoise  >>gaussian  >>lanes  >>accumulate  >>gate  >>block  >>refine
     >>life  >>forest  >>batches  >>files  >>check  >>plain  >>licence

   HOW IT WORKS
     Space is a binary tree over a cube: axes in turn, cut in the middle. A leaf (*cell*) splits when it holds more than
     max(32, 2 sqrt(N)) samples, N = those that the whole field holds (or c sqrt(N / N of the first pass) with
     desc.split_samples = c [Mueller 2017]), unless fewer than a 24th of that are non-zero. Every cell has a quadtree
     over directions (z, phi), equal-area, that refines where a node holds more than rho of the mass. A field has a
     *sampling part*, one flat relocatable block that queries read and only refine (and import, load,
     gsd_forest_split) replaces, and a *building part* that accumulate writes. Density of a direction: (1 - e) learned
     + e/(4 pi), e = 0.01 (desc.uniform); it integrates to 1. Directions are unit, world space, away from the surface
     towards the light. phi = atan2(y, x) in [0, 2 pi).

     Product: with the surface's normal n given to gsd_find, the learned density is multiplied by a softened cosine
     c_k(n) (gsd_bin_cosine), constant in each of 8 x 8 bins k of (phi, z), and divided by its mean: exact, since pdf
     and sample speak of the same c_k. One cell can then serve both sides of a thin wall, and nothing is spent below
     the horizon. Quadtrees learn incident light without the cosine: give the same normal to gsd_make_sample.

     Parallax: what is near is seen in another direction from each place of a cell. A cell's quadtree lies on a sphere
     around its pivot, on which directions from any place within are mapped to those from the pivot and back, exactly
     (gsd_to_pivot). Its nearness, 1 / radius, is the mean of the samples' 1 / distance, weighted by what goes into the
     quadtree: bright light, for which it matters, decides. A quadtree of few far lights so stays sharp in a large cell
     [in place of the distance of every lobe, Ruppert 2020]. The pivot is the middle of the cell; parts of it keep it
     while all of them lie within 0.6 radii of it and nearness has not changed by a factor of two, since sums are seen
     from there. The first pass chooses none: what it met by chance from all over the scene would stay with its parts.
     The even share is even as seen from the place. Places beyond 0.8 radii, which only jitter and positions outside the
     bounds lead to, are taken for those at 0.8. Distances of INFINITY: no parallax; forests have none.

     What is learned (desc.target); p = pdf_mix, the density the direction was drawn with:
       radiance        mass of a leaf = sum of L / p                                              [Mueller 2017]
       simple          sqrt(solid angle * sum of (contribution * w)^2 / p)                        [Rath 2020]
       variance-aware  the same with pixel_contribution                                           [Rath 2020]
       switching       simple, then variance-aware after desc.switch_after first passes' worth of samples; sums
                       cleared between
     For the second moments the contribution is divided by c_k(n) first, where the sample has a normal.
     w = (1 - a) pdf_guide / (a pdf_bsdf + (1 - a) pdf_guide), a = the cell's alpha, but 0.5 where the cell did not
     guide; desc.no_guide_weight sets w = 1.

     History: refine keeps as much of the sums that half of all samples recorded so far count in the next pass. Passes
     can so be short: what a pass learns from are paths that the pass before has guided, so many short passes learn more
     from the same samples than few long ones [unlike Mueller 2017, who clears the sums and doubles]. Recommended: a
     pass of a quarter of all samples before it.
     Smoothing: what few samples say is uncertain. The shares of a node's children in the sampling tree are
     (n share + K / 4) / (n + K), n = the node's non-zero samples (mass share times the cell's), K = desc.smoothing, in
     trees blurred by t (see below) (1 - t) of it.

     Denoising: before it rebuilds a tree, refine moves the leaves' masses by a share t towards the mean of the eight
     squares of their size around them (phi wraps, poles are crossed), a blur whose width follows the tree. t comes from
     the data: the samples of a leaf are gathered in two halves, and t is what lets each half say most of the other
     (largest sum of mass_other log density), converted to that of both together, t / (2 - t). Trees whose halves agree
     best without a blur stay as they are; so do those of second moments whose halves differ by less than one
     sample a leaf explains (sum of squared differences of shares <= 4 / leaves). On by default; the idea is that of
     Nilsson's thesis [Nilsson], whose fixed Gaussians and matrices this does without.
     GSD_DENOISE_GAUSSIAN is the method of the thesis (its chapter 4), to compare with. Layers 6, 7, ... of a tree, down
     to its deepest leaf, become matrices 2^layer wide: leaves above a layer are split by area, the subtree below an
     element counts with its sum times 4^-(its depth). Each is blurred by a 7 x 7 Gaussian of desc.gaussian_sigma
     elements, zeros outside (desc.gaussian_sphere: phi wraps, poles are crossed), where the window reaches beyond one
     leaf. All are expanded to the width of the last and merged by their maximum; the tree is rebuilt from that with
     desc.gaussian_rho, scaled to its old mass, and keeps its sums, by area. Trees above layer 6 stay as they are. Work
     is limited to 1.5e7 2^k elements in the k-th refine (from 0) and to trees not deeper than 10, unless
     desc.gaussian_no_limit. Trees that find no room under max_bytes stay as they are.

     Selection probability: handle.alpha is the probability to sample the BSDF; 1 means: do not guide here. The caller
     draws from the BSDF with alpha, else from gsd_sample, and divides by alpha pdf_bsdf + (1 - alpha) gsd_pdf.

     Gate: guiding is used in a cell until its own samples show that it does not pay. V(a) = mean of g^2 / (p p_a), with
     g = contribution, p_a = a pdf_bsdf + (1 - a) pdf_guide, is the second moment with selection probability a; m = mean
     of g / p; W^2 = mean of (pixel_contribution / g)^2, weighted as in V(1), turns squared contributions into squared
     pixels. Guiding pays where V(1) > (1 + gate_margin) V(a) + gate_gain / W^2: it must save a share of the second
     moment, and enough of the pixel's noise to be worth its time. Samples of a pass judge the tree built from earlier
     passes. Since no guide has V(a) < m^2, a cell with V(1) < m^2 + gate_gain / W^2 closes whatever its tree, though
     not before eight rebuilds: light that is rare must have had the time to be found. Verdicts need 95 % confidence and
     many non-zero samples: cells whose light is rarely found stay open. Closed cells are tried again every gate_probe
     passes and need more to open than to close. Cells without verdict guide. Without a pixel estimate
     (gsd_pass.pixel_estimate) 1 / W^2 = 16 m^2.

   THE SAMPLE
     One per non-delta path vertex whose direction was traced. radiance L: from that direction, no cosine, no BSDF, not
     divided by a pdf; light that next-event estimation can sample weighted by its MIS weight; connections of this
     vertex not included. Zeros count: record them. distance: to the next vertex, INFINITY = the environment or not
     known. gsd_make_sample fills one from RGB arrays; the normal is the one that gsd_find got. A direction rejected
     before tracing (f = 0) has radiance GSD_REJECTED (-0.0f): it counts as a visit and as a zero for the second-moment
     targets and the gate. pdf_guide = 0 means "not evaluated"; the field evaluates it where it needs it. A vertex that
     was recorded counts as a read of its cell; cells without new samples are left alone by refine.

   OPTIONS: see gsd_desc. gsd_resolve fills in defaults, gsd_get_desc returns what a field uses.

   MEMORY
     Sampling part: 16 bytes per quadtree node, 64 per cell, 32 per quadtree, 512 per learned quadtree (bins of
     directions: skip three levels, carry the cosine), 12 per leaf with desc.alias, 4 per spatial node, and 16 KB.
     Building part: 20 bytes per quadtree node, sizeof(gsd_cell_state) (below 600) per cell.
     max_bytes bounds the peak of both parts while refine runs, old and new together: trees coarsen and cells stop
     splitting; it never fails. (Only what comes from outside can lie above it, and stays: the cells of a forest,
     imported trees.) Denoising takes of it 24 bytes per node of the old building part, which are gone before the new
     part is made; GSD_DENOISE_GAUSSIAN up to a quarter instead, 10 MB for a tree of depth 10, four times that for each
     level more and for up to 32 trees at once, and up to an eighth for the trees it makes, 28 bytes per node, which
     stay until the new part stands. Streams (48 bytes per sample) and the scratch of accumulate (at most 13 MB and 8
     bytes per cell, kept for the next call) come on top. Allocation happens in create, stream_create, record,
     accumulate, refine, import, load, gsd_forest_split; never in a query. Stack: below 16 KB per call.

   THREADS: each function has a tag.
     [any thread]   pure function on constant data
     [per stream]   different streams at the same time from different threads; one stream by one thread at a time
     [exclusive]    nothing else on this field at the same time
     No threads are started. Functions that take a gsd_parallel_fn cut work by count and let the callback run it
     (NULL = serially). The result is bit-identical for any number of threads and for any cut of the same sequence of
     samples into streams and accumulate calls.

   ERRORS
     gsd_result, 0 = ok; gsd_result_string says which field to change. Asserts (GSD_ASSERT) catch programming errors.
     Bad samples (NaN, infinity, negative, >= 1e30, pdf_mix <= 0, zero direction, distance <= 0 or NaN) are refused and
     counted in gsd_stats; positions outside the bounds are clamped and counted. A failed allocation leaves the field as
     it was before the call, except that accumulate has lost the samples it was given (counted). gsd_load checks size,
     version, byte order, checksum and every index before use.

   NUMERICAL LIMITS
     Quadtree depth <= 20 (default 16). Directions are quantised to 24 bits an axis; u is read to 24 bits and 8 more are
     filled with a hash of u, so that small leaves are covered densely. A float direction can land in a neighbour leaf
     after rounding (depth 20: 2 %, depth 12: 0.006 %): gsd_sample returns the density of the rounded direction, the
     same as gsd_pdf for it, but for some 4e-6 of directions near the poles of trees of depth 20 with parallax. phi is
     computed to 4e-8 rad. SIMD levels differ from scalar by <= 2e-6 relative (4e-6 with parallax), and by the
     neighbour's density for about 1e-6 of directions within rounding of a leaf's edge. accumulate and refine give the
     same bits at all levels (not with clang's -ffp-contract=fast, nor with -ffast-math, nor with gcc's -fno-inline),
     but for the matrices of GSD_DENOISE_GAUSSIAN: they differ by <= 1e-6 relative, so that a node within that of the
     threshold is divided at one level and not at another. After the header clang's FP_CONTRACT is what the command
     line says, whatever a pragma said before it.

   REFERENCES
     T. Mueller, M. Gross, J. Novak 2017, Practical Path Guiding for Efficient Light-Transport Simulation.
     T. Mueller 2019, "Practical Path Guiding" in Production, ch. 10 of SIGGRAPH course Path Guiding in Production.
     J. Vorba, J. Krivanek 2016, Adjoint-Driven Russian Roulette and Splitting in Light Transport Simulation.
     L. Ruppert, S. Herholz, H. Lensch 2020, Robust Fitting of Parallax-Aware Mixtures for Path Guiding.
     A. Rath, P. Grittmann, S. Herholz, P. Vevoda, P. Slusallek, J. Krivanek 2020, Variance-Aware Path Guiding.
     J. Nilsson, thesis on denoising the quadtrees of path guiding, Chalmers University of Technology.
     A. Walker 1977, An Efficient Method for Generating Discrete Random Variables with General Distributions (alias).
     D. Kingma, J. Ba 2015, Adam. */
#ifndef GUIDE_SDTREE_H
#define GUIDE_SDTREE_H

/* ---- >>config ----------------------------------------------------------------------------------------------- */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define GSD_VERSION 5 /* of the saved format */

#ifndef GSD_API /* linkage of the functions; e.g. static */
#define GSD_API extern
#endif
#ifndef GSD_QUERY /* qualifiers of the inline queries; e.g. __device__ static inline */
#define GSD_QUERY static inline
#endif
/* Other macros, read by the implementation only: GSD_ASSERT(x), GSD_MALLOC(n), GSD_FREE(p), GSD_NO_SIMD. */

#ifdef __cplusplus
extern "C" {
#endif

/* ---- >>types ------------------------------------------------------------------------------------------------ */

/* Results and their messages. */
#define GSD_RESULTS(X)                                                                                                 \
    X(GSD_OK, "ok")                                                                                                    \
    X(GSD_OUT_OF_MEMORY, "out of memory: lower desc.max_bytes or check desc.allocate")                                 \
    X(GSD_BAD_BOUNDS, "desc.bounds_min must lie below desc.bounds_max, both finite")                                   \
    X(GSD_BAD_OPTION,                                                                                                  \
      "an enum is out of range: desc.target, .spatial_filter, .alpha_mode, .denoise, .simd, pass->denoise")            \
    X(GSD_BAD_RANGE, "a number in the descriptor is out of its range: see the comments of gsd_desc")                   \
    X(GSD_BAD_ALLOCATOR, "set both desc.allocate and desc.release or neither")                                         \
    X(GSD_BAD_CELL, "no such cell: see gsd_cell_count")                                                                \
    X(GSD_BAD_TREE, "an imported tree is not a tree, too deep (desc.max_depth) or has a bad value")                    \
    X(GSD_NOT_A_FOREST, "cells can only be given or split when desc.forest_cells > 0")                                 \
    X(GSD_MISMATCH, "the fields' structures differ: merge between accumulate and refine, from one common ancestor")    \
    X(GSD_BUFFER_TOO_SMALL, "the buffer is too small: ask the _bound function")                                        \
    X(GSD_BAD_FILE, "not a saved field, or it is damaged")                                                             \
    X(GSD_BAD_VERSION, "saved by another version or on a machine of other byte order")                                 \
    X(GSD_CORRUPT, "the field does not hold together: memory was overwritten")

#define GSD_RESULT_ENUM(name, text) name,
typedef enum gsd_result { GSD_RESULTS(GSD_RESULT_ENUM) GSD_RESULT_COUNT } gsd_result;
#undef GSD_RESULT_ENUM

typedef enum gsd_target {
    GSD_TARGET_DEFAULT, /* = GSD_TARGET_SWITCHING */
    GSD_TARGET_RADIANCE,
    GSD_TARGET_SIMPLE,
    GSD_TARGET_VARIANCE,
    GSD_TARGET_SWITCHING
} gsd_target;

typedef enum gsd_spatial_filter {
    GSD_SPATIAL_DEFAULT,   /* = GSD_SPATIAL_NEAREST */
    GSD_SPATIAL_NEAREST,   /* a sample goes to the cell it lies in */
    GSD_SPATIAL_STOCHASTIC /* to the cell of its position jittered by the size of its cell [Mueller 2019] */
} gsd_spatial_filter;

typedef enum gsd_directional_filter {
    GSD_DIRECTIONAL_DEFAULT, /* = GSD_DIRECTIONAL_BOX */
    GSD_DIRECTIONAL_NEAREST, /* a sample goes to the leaf it lies in */
    GSD_DIRECTIONAL_BOX      /* spread over a box of its leaf's size, across phi's seam and the poles [Mueller 2019] */
} gsd_directional_filter;

typedef enum gsd_alpha_mode {
    GSD_ALPHA_DEFAULT, /* = GSD_ALPHA_GRID */
    GSD_ALPHA_FIXED,   /* stays desc.alpha */
    GSD_ALPHA_ADAM,    /* Adam on the KL divergence (radiance) or second moment (other targets) [Mueller 2019] */
    GSD_ALPHA_GRID     /* minimum of V(a) through the gate's estimates at five values of a, pulled towards desc.alpha */
} gsd_alpha_mode;

typedef enum gsd_denoise_mode {
    GSD_DENOISE_DEFAULT, /* = GSD_DENOISE_BLUR; in gsd_pass: what the descriptor says */
    GSD_DENOISE_OFF,     /* quadtrees as they were gathered */
    GSD_DENOISE_BLUR,    /* see HOW IT WORKS */
    GSD_DENOISE_GAUSSIAN /* fixed Gaussians over matrices, as published [Nilsson]: a reference to compare with */
} gsd_denoise_mode;

typedef enum gsd_simd {
    GSD_SIMD_AUTO,
    GSD_SIMD_SCALAR,
    GSD_SIMD_AVX2,
    GSD_SIMD_AVX512,
    GSD_SIMD_NEON /* the Gaussian denoiser only; queries as GSD_SIMD_SCALAR */
} gsd_simd;

/* Zero-initialise it; zero means the default. Fields named no_x switch a default behaviour off. */
typedef struct gsd_desc {
    float bounds_min[3], bounds_max[3]; /* world-space box of the positions; made a cube and 0.1 % larger */
    gsd_target target;
    float switch_after;   /* first passes' worth of samples before variance-aware, 0.001 .. 1e6; default 4 */
    float split_samples;  /* c, see HOW IT WORKS, 16 .. 1e9; default 0: the threshold follows the samples */
    float rho;            /* share of a quadtree's mass above which a node is divided, 1e-5 .. 1; default 0.01 */
    uint32_t max_depth;   /* of quadtrees, 1 .. 20; default 16 */
    uint32_t max_levels;  /* of the spatial tree (3 levels halve all axes), 1 .. 60; default 48 */
    uint32_t min_samples; /* a cell that holds fewer samples waits for more before its tree is rebuilt; default 16 */
    uint64_t max_bytes;   /* memory cap, see MEMORY; >= 2^20; default 2^30 */
    gsd_spatial_filter spatial_filter;
    gsd_directional_filter directional_filter;
    gsd_alpha_mode alpha_mode;
    float alpha;   /* start value (and fixed value) of the probability of BSDF sampling, 0.05 .. 1; default 0.5 */
    float uniform; /* e, share of uniform sampling in the guide's density, 1e-4 .. 1; default 0.01 */
    bool no_gate;  /* guide in every cell */
    bool no_guide_weight; /* second-moment targets: w = 1 */
    bool no_history;      /* clear the sums in every refine; see HOW IT WORKS */
    gsd_denoise_mode denoise;
    float denoise_budget;   /* leaves blurred a sample, beyond 131,072 in all; 0.001 .. 1e6; default 0.25: <= 15 ns */
    float gaussian_sigma;   /* of GSD_DENOISE_GAUSSIAN, in elements of a layer's matrix, 0.1 .. 100; default 0.8 */
    float gaussian_rho;     /* as rho, of the trees it makes, 1e-5 .. 1; default 0: rho */
    bool gaussian_sphere;   /* phi wraps and poles are crossed; the thesis has zeros outside the matrix */
    bool gaussian_no_limit; /* no limit of work, trees down to depth 12 */
    float smoothing;        /* K, samples' worth of evenness, see HOW IT WORKS, 0.001 .. 1000; default 3 */
    bool alias;            /* build alias tables: sampling in constant time, but not monotone in u; + 12 bytes a leaf */
    float gate_margin;     /* V(1) / V(a) - 1 below which guiding does not pay, 0.001 .. 10; default 0.05 */
    float gate_gain;       /* V(1) - V(a) below which guiding does not pay, 0.0001 .. 1000; default 0.25 */
    uint32_t gate_probe;   /* passes between tries of a closed cell, 1 .. 1000; default 1 */
    uint32_t forest_cells; /* > 0: no spatial tree; that many cells, which the caller addresses by index */
    gsd_simd simd;         /* pin the level of the batch queries and of GSD_DENOISE_GAUSSIAN; default: the best that
                              this machine has */
    void *(*allocate)(void *user, size_t size); /* default malloc; NULL on failure; 16-byte aligned */
    void (*release)(void *user, void *pointer); /* default free; pointer may be NULL */
    void *user;
} gsd_desc;

/* What is learned from one path vertex. 48 bytes. See THE SAMPLE; pdfs in 1/sr, L in W/m^2/sr. Filled by
   gsd_make_sample. */
typedef struct gsd_training_sample {
    float position[3];
    uint32_t direction[2];    /* with the normal; see gsd_pack_direction */
    float nearness;           /* 1 / distance to the next vertex; 0 = infinitely far */
    float radiance;           /* mean over channels of L; GSD_REJECTED */
    float contribution;       /* mean over channels of f L cos */
    float pixel_contribution; /* mean over channels of f L cos * throughput before this vertex / pixel estimate; not
                                 used by target radiance and simple without gsd_pass.pixel_estimate */
    float pdf_mix;            /* what the direction was drawn with */
    float pdf_bsdf;
    float pdf_guide; /* 0 = not evaluated */
} gsd_training_sample;
#define GSD_REJECTED (-0.0f)

/* Optional facts about the pass that refine ends. Zero-initialise it. */
typedef struct gsd_pass {
    bool pixel_estimate;      /* the pass's pixel_contributions were relative to a pixel estimate: see Gate */
    gsd_denoise_mode denoise; /* of this refine, in place of desc.denoise */
    /* Told as each step of refine begins, by the thread that called it: "measure", "denoise" (unless it is off),
       "split", "build", and NULL when all is done (not after a failure). For measuring where the time goes; NULL =
       nobody is told. */
    void (*on_step)(void *user, const char *step);
    void *on_step_user;
} gsd_pass;

typedef void (*gsd_range_fn)(void *context, uint32_t begin, uint32_t end);
/* Calls fn on disjoint ranges that cover [0, count), of about grain, and returns when all are done. */
typedef void (*gsd_parallel_fn)(void *user, uint32_t count, uint32_t grain, gsd_range_fn fn, void *context);

typedef struct gsd_field gsd_field;
typedef struct gsd_stream gsd_stream;

/* Counters since create unless they say otherwise. No padding: a save holds it as it is. */
typedef struct gsd_stats {
    uint64_t samples;  /* accepted by accumulate */
    uint64_t zeros;    /* of which radiance or contribution was 0 */
    uint64_t rejected; /* of which GSD_REJECTED */
    uint64_t refused;  /* bad samples; best 0 */
    uint64_t clamped;  /* positions outside the bounds; best 0 */
    uint64_t lost;     /* samples that met a failed allocation; best 0 */
    uint64_t nodes;    /* quadtree nodes in the sampling part now */
    uint64_t leaves;   /* of which leaves */
    uint64_t building_nodes;
    uint64_t bytes;             /* sampling and building part now */
    uint64_t peak_bytes;        /* most held at once by both, old and new; <= max_bytes; GSD_DENOISE_GAUSSIAN
                                   counts as if it ran in parallel */
    uint64_t opened, closed;    /* verdicts of the gate so far */
    uint64_t probed;            /* closed cells tried again so far */
    uint64_t denoised_leaves;   /* of all quadtrees that refine tried to blur so far, Gaussian aside */
    uint32_t passes;            /* calls of refine */
    uint32_t cells;             /* now */
    uint32_t trees;             /* distinct quadtrees in the sampling part now (cells share after a split) */
    uint32_t max_depth;         /* deepest leaf now */
    uint32_t split_cells;       /* by the last refine */
    uint32_t rebuilt_trees;     /* last refine: cells with new samples */
    uint32_t waiting_cells;     /* last refine: too few new samples, tree kept */
    uint32_t unread_cells;      /* last refine: no new samples: no work done */
    uint32_t denoised_trees;    /* last refine: rebuilt and blurred */
    uint32_t smooth_trees;      /* last refine: rebuilt, better without a blur by what their samples say, or one leaf */
    uint32_t over_budget_trees; /* last refine: rebuilt and left as they are, see desc.denoise_budget; Gaussian: over
                                   the limit of work, or no memory for them under max_bytes */
    uint32_t shallow_trees;     /* last refine, Gaussian: rebuilt and left as they are, nothing at layer 6 */
    uint32_t deep_trees;        /* last refine, Gaussian: deeper than 10 (without limit 12) */
    uint32_t open_cells;        /* gate: guiding shown to pay */
    uint32_t closed_cells;      /* gate: shown not to pay; alpha = 1 */
    uint32_t unjudged_cells;    /* gate: guiding (once there is a tree), no verdict yet */
    float effective_rho;        /* rho of the last refine, above desc.rho where max_bytes forced it; best desc.rho */
    float mean_depth;           /* mean over trees of leaf depth weighted by mass; 0 = nothing learned */
    float closed_share;         /* share of the last pass's samples in closed cells, 0 .. 1 */
    float mean_alpha;           /* over the last pass's samples, closed cells as 1 */
    float mean_blur; /* of the trees that the last refine rebuilt: how far shares moved towards those around; 0 where
                        the blur was Gaussian */
    float reserved;
} gsd_stats;

/* ---- flat data of the sampling part (for queries and ports; not to be changed by callers) */

/* 16 bytes. Inner: children child .. child + 3, number = (phi half) + 2 (z half); split[0] = share of the lower phi
   half, split[1], split[2] = share of the lower z half in the lower, upper phi half. Leaf: child = 0; pdf in 1/sr,
   final; x = lowest phi coordinate (24 bits) + depth << 24, y = lowest z coordinate (24 bits). */
typedef union gsd_node {
    struct gsd_inner {
        uint32_t child;
        float split[3];
    } inner;
    struct gsd_leaf {
        uint32_t child;
        float pdf;
        uint32_t x, y;
    } leaf;
} gsd_node;

/* 12 bytes. Slot i holds the leaf `node` with probability threshold, else the leaf `other`. */
typedef struct gsd_alias {
    float threshold;
    uint32_t node, other;
} gsd_alias;

/* 64 bytes, a cache line: what a query knows about a cell. */
typedef struct gsd_cell {
    uint32_t root;        /* node of its quadtree; 0 = uniform */
    uint32_t jump;        /* into the table of jumps; 0 = none */
    uint32_t alias;       /* into the alias slots */
    uint32_t alias_count; /* 0 = none */
    float alpha;
    uint32_t tree;   /* index of its quadtree */
    uint32_t level;  /* in the spatial tree */
    uint32_t gate;   /* GSD_GATE_... */
    float reflected; /* see gsd_handle */
    uint32_t depth;  /* of the deepest leaf of its quadtree */
    float pivot[3];  /* where its quadtree is seen from */
    float nearness;  /* 1 / radius of the sphere around it on which the quadtree lies; 0 = infinitely large */
    uint32_t reserved[2];
} gsd_cell;
enum { GSD_GATE_UNJUDGED, GSD_GATE_OPEN, GSD_GATE_CLOSED };

/* Pointers into one sampling part. Valid until the next exclusive call. */
typedef struct gsd_view {
    const uint32_t *grid;    /* [16][16][16]: links, see spatial */
    const uint32_t *spatial; /* link of each node: GSD_CELL_BIT + cell, or index of the first of two children */
    const gsd_cell *cells;
    const gsd_node *nodes; /* nodes[0] is the uniform leaf */
    const uint32_t *jumps; /* [8][8] per table: node at depth 3 or the leaf above; one table per quadtree */
    const float *masses;   /* [8][8] per table: learned probability of that bin of directions */
    const float *bins;     /* [3][64]: x, y, z of the mean of a bin's directions */
    const gsd_alias *aliases;
    float origin[3], scale; /* grid coordinate (24 bits an axis) = (position - origin) * scale */
    float uniform;
    uint32_t cell_count;
    uint32_t simd; /* gsd_simd, resolved */
} gsd_view;
#define GSD_CELL_BIT 0x80000000u

/* What find gives: plain data, 56 bytes, valid as long as the view. */
typedef struct gsd_handle {
    uint32_t cell, root, jump, alias, alias_count;
    float alpha;     /* probability of BSDF sampling; 1 = do not guide */
    float reflected; /* mean of contribution / pdf_mix in the cell: the radiance that its surfaces reflect, W/m^2/sr; 0
                        = not known. What a path can still bring here, for Russian roulette [Vorba 2016] */
    float normal[3];
    float product;   /* > 0: the density is multiplied by the cosine to this normal; 1 / (mean cosine) */
    float offset[3]; /* position relative to the pivot of the cell, in radii of its sphere; shorter than 1 */
} gsd_handle;

/* ---- >>field ------------------------------------------------------------------------------------------------ */

/* Message that names what to change. [any thread] */
GSD_API const char *gsd_result_string(gsd_result result);

/* Check desc and write it with all defaults filled in to resolved (may be desc itself). [any thread] */
GSD_API gsd_result gsd_resolve(const gsd_desc *desc, gsd_desc *resolved);

/* An untrained field: uniform density, alpha = desc.alpha. *field = NULL on failure. [any thread] */
GSD_API gsd_result gsd_create(const gsd_desc *desc, gsd_field **field);
GSD_API void gsd_destroy(gsd_field *field); /* NULL is fine; streams are destroyed separately. [exclusive] */
GSD_API const gsd_desc *gsd_get_desc(const gsd_field *field); /* resolved. [any thread] */
GSD_API gsd_view gsd_get_view(const gsd_field *field);        /* for the queries. [any thread] */
GSD_API uint32_t gsd_cell_count(const gsd_field *field);      /* [any thread] */

/* A buffer of samples, one per image tile or batch, so that its content does not depend on threads. Grows in chunks,
   never copies. Must be destroyed before or after the field, with the same allocator alive. [any thread] */
GSD_API gsd_result gsd_stream_create(const gsd_field *field, gsd_stream **stream);
GSD_API void gsd_stream_destroy(gsd_stream *stream);        /* [per stream] */
GSD_API void gsd_stream_clear(gsd_stream *stream);          /* keeps its memory. [per stream] */
GSD_API uint64_t gsd_stream_size(const gsd_stream *stream); /* samples held. [per stream] */

/* Append. On GSD_OUT_OF_MEMORY the samples that did not fit are lost and counted; the stream stays usable.
   [per stream] */
GSD_API gsd_result gsd_record(gsd_stream *stream, const gsd_training_sample *samples, uint32_t count);
/* The same for a forest: cells[i] is the cell of samples[i]; positions are ignored. [per stream] */
GSD_API gsd_result gsd_record_cells(gsd_stream *stream, const uint32_t *cells, const gsd_training_sample *samples,
                                    uint32_t count);

/* Add the samples of streams[0], streams[1], ... in this order to the building part. May be called many times a pass.
   Clear the streams afterwards. On GSD_OUT_OF_MEMORY the samples not yet added are lost and counted. [exclusive] */
GSD_API gsd_result gsd_accumulate(gsd_field *field, gsd_stream *const *streams, uint32_t count,
                                  gsd_parallel_fn parallel, void *user);
/* A pass has ended: rebuild the sampling part from what accumulate gathered, adapt the structure for the next pass.
   pass may be NULL. Handles and views become invalid. On failure nothing changes; it may be called again.
   [exclusive] */
GSD_API gsd_result gsd_refine(gsd_field *field, const gsd_pass *pass, gsd_parallel_fn parallel, void *user);

/* Share of image tiles (or paths) that are worth recording in the next pass: 1 while much of the field guides or has
   no verdict, down to 1/64 when nearly all of it is closed: enough to notice changes. [any thread] */
GSD_API float gsd_record_fraction(const gsd_field *field);
/* True when no cell guides: a renderer may skip every query until the next refine. [any thread] */
GSD_API bool gsd_all_closed(const gsd_field *field);

GSD_API void gsd_get_stats(const gsd_field *field, gsd_stats *stats); /* [any thread] */
/* Check every index and sum of both parts: GSD_OK or GSD_CORRUPT. [any thread] */
GSD_API gsd_result gsd_validate(const gsd_field *field);

/* Forest: cell `parent` was split into child_a and child_b (one of which may be parent itself); both start with its
   quadtree and half of its sums. Indices up to 2^26; cells between are created uniform. [exclusive] */
GSD_API gsd_result gsd_forest_split(gsd_field *field, uint32_t parent, uint32_t child_a, uint32_t child_b);

/* ---- >>store ------------------------------------------------------------------------------------------------ */

/* Bytes that gsd_save writes at most. [any thread] */
GSD_API size_t gsd_save_bound(const gsd_field *field);
/* Write both parts, so that training can go on after load. *size = bytes written. [any thread] */
GSD_API gsd_result gsd_save(const gsd_field *field, void *data, size_t capacity, size_t *size);
/* Restore. Options come from the save; desc (may be NULL) gives the allocator and the simd level. The data need not be
   aligned and may come from an untrusted source. *field = NULL on failure. [any thread] */
GSD_API gsd_result gsd_load(const gsd_desc *desc, const void *data, size_t size, gsd_field **field);

/* Equal for fields whose building parts have the same cells, pivots and quadtrees. Changes in refine. [any thread] */
GSD_API uint64_t gsd_structure_id(const gsd_field *field);
/* Add source's building sums (since the last refine) to field's; GSD_MISMATCH unless their structure ids are equal.
   [exclusive] on field, source is only read. */
GSD_API gsd_result gsd_merge(gsd_field *field, const gsd_field *source);

/* One quadtree as plain arrays: for each inner node (a tree that is one leaf has one inner node with four equal leaves)
   child[4]: index of an inner node, 0 = leaf; value[4]: mass of each child. Node 0 is the root; children come later
   than parents. Child number as in gsd_node. Directions are those from the cell's pivot (gsd_view.cells). */
typedef struct gsd_tree {
    uint32_t cell;
    uint32_t count;  /* inner nodes */
    uint32_t *child; /* [count][4] */
    float *value;    /* [count][4] */
} gsd_tree;
typedef enum gsd_part {
    GSD_PART_SAMPLING, /* learned density, without the uniform share; value sums to 1 over the leaves */
    GSD_PART_BUILDING  /* masses gathered since the last refine (root masses for second-moment targets) */
} gsd_part;
/* Inner nodes that gsd_export_tree writes for this cell; 0 = no such cell. [any thread] */
GSD_API uint32_t gsd_export_bound(const gsd_field *field, gsd_part part, uint32_t cell);
/* Fill tree->child and ->value, which hold tree->count nodes, for tree->cell; sets tree->count. [any thread] */
GSD_API gsd_result gsd_export_tree(const gsd_field *field, gsd_part part, gsd_tree *tree);
/* Replace the sampling trees of the cells named in trees[0..count); values of leaves count, those of inner nodes are
   ignored. Masses must be finite and >= 0; all zero = uniform. All or none are replaced. Building trees stay. The next
   refine builds anew from samples. [exclusive] */
GSD_API gsd_result gsd_import_trees(gsd_field *field, const gsd_tree *trees, uint32_t count);

/* ---- >>query ------------------------------------------------------------------------------------------------ */

#define GSD_INV_4PI 0.07957747154594766788f

#if defined(__clang__) /* accumulate asks them too: see the implementation */
#pragma STDC FP_CONTRACT OFF
#endif

/* Direction (unit, any finite) to 24-bit coordinates: x = phi / (2 pi), y = (z + 1) / 2. Polynomial: minimax fit of
   atan(t) / (2 pi) on 0 .. 1, error 6e-9 turns. Total function: NaN gives some valid coordinate. [any thread] */
GSD_QUERY void gsd_coordinates(const float direction[3], uint32_t *x, uint32_t *y)
{
    float dx = direction[0], dy = direction[1], z = direction[2];
    float ax = fabsf(dx), ay = fabsf(dy);
    float big = ax > ay ? ax : ay, small = ax > ay ? ay : ax;
    float t = big > 0 ? small / big : 0, s = t * t, p, q;
    int32_t i, swap = -(int32_t)(ay > ax), left = -(int32_t)(dx < 0), below = -(int32_t)(dy < 0);
    q = s * s;
    p = (0.01534600094f - 0.008898663359f * s) + q * (0.003479549227f - 0.0006452896099f * s);
    p = (0.1591548374f - 0.05304612139f * s) + q * ((0.03174594614f - 0.02213626529f * s) + q * p);
    p = p * t;
    p = p > 0 ? p : 0; /* NaN too */
    i = (int32_t)((p < 0.125f ? p : 0.125f) * 67108864.0f);
    i = (i ^ swap) - swap + (swap & 16777216); /* a quarter turn - i; without branches */
    i = (i ^ left) - left + (left & 33554432); /* half a turn - i */
    i = (i ^ below) + (below & 67108864);      /* a turn - i - 1 */
    *x = ((uint32_t)i >> 2) & 0xffffffu;
    z = z > -1 ? z : -1;
    z = z < 1 ? z : 1;
    i = (int32_t)((z + 1) * 8388608.0f);
    *y = i < 16777215 ? (uint32_t)i : 16777215u;
}

/* 24-bit coordinates with fractions (in units of 2^-24 of the axis) to a unit direction. Polynomials: minimax fits of
   sine and cosine on an eighth of a turn, error 2e-9. [any thread] */
GSD_QUERY void gsd_direction(double x, double y, float direction[3])
{
    float z = (float)(y * 1.1920928955078125e-7 - 1.0);
    double turn = x * 5.9604644775390625e-8; /* 2^-24 */
    int32_t q = (int32_t)(turn * 4 + 0.5);
    float f = (float)(turn - 0.25 * q), g = f * f, s, c, r, swap;
    s = f * (6.28318522f + g * (-41.3416277f + g * (81.5880703f + g * -75.2377448f)));
    c = 1 + g * (-19.7392087f + g * (64.9393261f + g * (-85.4436999f + g * 59.2443711f)));
    z = z > -1 ? z : -1;
    z = z < 1 ? z : 1;
    r = sqrtf((1 - z) * (1 + z));
    swap = q & 1 ? c : s; /* quarter turns: (c, s) -> (-s, c) */
    c = q & 1 ? -s : c;
    s = swap;
    r = q & 2 ? -r : r;
    direction[0] = r * c;
    direction[1] = r * s;
    direction[2] = z;
}

/* Two floats in [0, 1) to two doubles in [0, 1) of 32 bits: 24 bits of each float, then 8 of a hash of both. */
GSD_QUERY void gsd_extend_random(const float u[2], double out[2])
{
    uint32_t a = (uint32_t)((double)u[0] * 16777216.0), b = (uint32_t)((double)u[1] * 16777216.0), h;
    a = a < 16777215u ? a : 16777215u;
    b = b < 16777215u ? b : 16777215u;
    h = (a * 0x9e3779b1u) ^ (b * 0x85ebca6bu + 0x27d4eb2fu);
    h = (h ^ (h >> 15)) * 0x2c1b3c6du;
    h ^= h >> 13;
    out[0] = ((double)a * 256.0 + (double)(h & 255u)) * 2.3283064365386963e-10;
    out[1] = ((double)b * 256.0 + (double)((h >> 8) & 255u)) * 2.3283064365386963e-10;
}

/* Leaf of the quadtree at coordinates x, y. */
GSD_QUERY uint32_t gsd_leaf_at(const gsd_view *view, const gsd_handle *handle, uint32_t x, uint32_t y)
{
    uint32_t node = handle->root, shift = 24, child;
    if (handle->jump) {
        node = view->jumps[handle->jump + (y >> 21) * 8 + (x >> 21)];
        shift = 21;
    }
    while ((child = view->nodes[node].inner.child) != 0) {
        --shift;
        node = child + ((x >> shift) & 1u) + 2 * ((y >> shift) & 1u);
    }
    return node;
}

/* The cell as a handle, seen from its pivot (from elsewhere: gsd_see_from). cell < view->cell_count;
   larger ones give the uniform density. For forests. [any thread] */
GSD_QUERY gsd_handle gsd_find_cell(const gsd_view *view, uint32_t cell)
{
    gsd_handle handle = {0, 0, 0, 0, 0, 1.0f, 0, {0, 0, 0}, 0, {0, 0, 0}};
    if (cell < view->cell_count) {
        const gsd_cell *c = &view->cells[cell];
        handle.cell = cell;
        handle.root = c->root;
        handle.jump = c->jump;
        handle.alias = c->alias;
        handle.alias_count = c->alias_count;
        handle.alpha = c->alpha;
        handle.reflected = c->reflected;
    }
    return handle;
}

/* Position relative to a pivot in radii 1 / nearness of the sphere around it, pulled within GSD_MOST_OFFSET of it. */
#define GSD_MOST_OFFSET 0.8f
GSD_QUERY void gsd_offset(const float pivot[3], float nearness, const float position[3], float offset[3])
{
    float x = (position[0] - pivot[0]) * nearness, y = (position[1] - pivot[1]) * nearness;
    float z = (position[2] - pivot[2]) * nearness, l = x * x + y * y + z * z, f = 1;
    if (!(l <= GSD_MOST_OFFSET * GSD_MOST_OFFSET)) {
        f = l < 1e30f ? GSD_MOST_OFFSET / sqrtf(l) : 0;
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
GSD_QUERY float gsd_to_pivot(const float offset[3], const float direction[3], float out[3])
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
GSD_QUERY void gsd_from_pivot(const float offset[3], float direction[3])
{
    float x = direction[0] - offset[0], y = direction[1] - offset[1], z = direction[2] - offset[2];
    float f = 1 / sqrtf((x * x + y * y) + z * z);
    direction[0] = x * f;
    direction[1] = y * f;
    direction[2] = z * f;
}

/* Position along one axis to a 24-bit coordinate; outside and NaN are clamped. */
GSD_QUERY uint32_t gsd_grid_coordinate(float position, float origin, float scale)
{
    float t = (position - origin) * scale;
    t = t > 0 ? t : 0;
    return t < 16777215.0f ? (uint32_t)t : 16777215u;
}

/* Cell at grid coordinates. */
GSD_QUERY uint32_t gsd_cell_at(const gsd_view *view, const uint32_t g[3])
{
    uint32_t link = view->grid[(g[0] >> 20) << 8 | (g[1] >> 20) << 4 | g[2] >> 20], shift = 19;
    while (!(link & GSD_CELL_BIT)) {
        link = view->spatial[link + ((g[0] >> shift) & 1u)];
        if (link & GSD_CELL_BIT)
            break;
        link = view->spatial[link + ((g[1] >> shift) & 1u)];
        if (link & GSD_CELL_BIT)
            break;
        link = view->spatial[link + ((g[2] >> shift) & 1u)];
        --shift;
    }
    return link & ~GSD_CELL_BIT;
}

/* Extent along an axis of a cell at this level of the spatial tree, in grid units. */
GSD_QUERY uint32_t gsd_cell_extent(uint32_t level, uint32_t axis) { return 16777216u >> ((level + 2 - axis) / 3); }

/* Cosine that bin k of the 8 x 8 bins of directions counts with for a surface normal: the cosine t to the mean of the
   bin's directions (less lift, which is 0 where there is no offset: gsd_lift), softened near the horizon, which cuts
   through bins, and at least GSD_BELOW, so that no light is lost: GSD_BELOW + (0 | (t + h)^2 / 4h | t) for t (< -h |
   between | > h), h = GSD_HORIZON. */
#define GSD_HORIZON 0.25f
#define GSD_BELOW 0.02f
GSD_QUERY float gsd_bin_cosine(const gsd_view *view, const float normal[3], float lift, uint32_t k)
{
    const float *b = view->bins + k;
    float t = ((normal[0] * b[0] + normal[1] * b[64]) + normal[2] * b[128]) - lift, r = t + GSD_HORIZON;
    float above = t - GSD_HORIZON;
    r = r > 0 ? r : 0;
    r = r < 2 * GSD_HORIZON ? r : 2 * GSD_HORIZON;
    above = above > 0 ? above : 0;
    return r * r * (0.25f / GSD_HORIZON) + (above + GSD_BELOW);
}

/* How far the place lies above its pivot: a point of the sphere is above the surface where its cosine as seen from the
   pivot exceeds this. */
GSD_QUERY float gsd_lift(const float offset[3], const float normal[3])
{
    return offset[0] * normal[0] + offset[1] * normal[1] + offset[2] * normal[2];
}

/* Multiply a handle's density by the cosine to a normal (unit, on the side that light comes from): gsd_find does it
   itself, this is for gsd_find_cell. With a normal that is far from unit (zero, NaN), an untrained cell and one that
   does not guide (alpha = 1) it is left alone. [any thread] */
GSD_QUERY void gsd_orient(const gsd_view *view, gsd_handle *handle, const float normal[3])
{
    const float *mass = view->masses + handle->jump;
    float z[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    float l = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
    float lift = gsd_lift(handle->offset, normal);
    uint32_t k, i;
    if (handle->jump == 0 || handle->alpha >= 1 || !(l > 0.5f && l < 2))
        return;
    for (k = 0; k < 64; k += 8)
        for (i = 0; i < 8; ++i)
            z[i] += mass[k + i] * gsd_bin_cosine(view, normal, lift, k + i);
    memcpy(handle->normal, normal, sizeof handle->normal);
    handle->product = 1 / (((z[0] + z[1]) + (z[2] + z[3])) + ((z[4] + z[5]) + (z[6] + z[7])));
}

/* See a handle from a position, before gsd_orient: gsd_find does it itself, this is for gsd_find_cell. [any thread] */
GSD_QUERY void gsd_see_from(const gsd_view *view, gsd_handle *handle, const float position[3])
{
    const gsd_cell *c = &view->cells[handle->cell];
    gsd_offset(c->pivot, c->nearness, position, handle->offset);
}

/* Find the cell of a position. normal (unit, on the side that light comes from) makes the density follow the cosine
   there; NULL or zero = no surface, or one that light passes. u = three random numbers in [0,1) jitter the position by
   the size of its cell, which blends neighbours (unbiased: sample and pdf speak of the handle's cell); NULL = the cell
   it lies in. [any thread] */
GSD_QUERY gsd_handle gsd_find(const gsd_view *view, const float position[3], const float *normal, const float *u)
{
    gsd_handle handle;
    uint32_t g[3], cell, axis;
    for (axis = 0; axis < 3; ++axis)
        g[axis] = gsd_grid_coordinate(position[axis], view->origin[axis], view->scale);
    cell = gsd_cell_at(view, g);
    if (u) {
        uint32_t level = view->cells[cell].level;
        for (axis = 0; axis < 3; ++axis) {
            double t = (double)g[axis] + ((double)u[axis] - 0.5) * (double)gsd_cell_extent(level, axis);
            g[axis] = t <= 0 ? 0 : t < 16777215.0 ? (uint32_t)t : 16777215u;
        }
        cell = gsd_cell_at(view, g);
    }
    handle = gsd_find_cell(view, cell);
    gsd_see_from(view, &handle, position);
    if (normal)
        gsd_orient(view, &handle, normal);
    return handle;
}

/* A leaf's density as this handle sees it: (1 - e) learned * cosine / mean cosine * scale + e / (4 pi). x, y: a
   direction in the leaf; scale: of gsd_to_pivot. */
GSD_QUERY float gsd_oriented(const gsd_view *view, const gsd_handle *handle, float pdf, uint32_t x, uint32_t y,
                             float scale)
{
    float even = view->uniform * GSD_INV_4PI;
    if (!(handle->product > 0) && scale == 1)
        return pdf;
    pdf = (pdf > even ? pdf - even : 0) * scale;
    if (handle->product > 0)
        pdf *=
            gsd_bin_cosine(view, handle->normal, gsd_lift(handle->offset, handle->normal), (y >> 21) * 8 + (x >> 21)) *
            handle->product;
    return pdf + even;
}

/* Density (1/sr) with which gsd_sample draws this direction (unit); > 0 everywhere. [any thread] */
GSD_QUERY float gsd_pdf(const gsd_view *view, const gsd_handle *handle, const float direction[3])
{
    uint32_t x, y;
    float seen[3], scale = gsd_to_pivot(handle->offset, direction, seen);
    gsd_coordinates(seen, &x, &y);
    return gsd_oriented(view, handle, view->nodes[gsd_leaf_at(view, handle, x, y)].leaf.pdf, x, y, scale);
}

/* Direction at (tx, ty) in [0, 1)^2 within a leaf, and the density of the rounded direction: the leaf's, unless the
   direction is so near to the leaf's edge (GSD_EDGE of 2^24 units) that it may have crossed it. */
#define GSD_EDGE 6
GSD_QUERY float gsd_sample_leaf(const gsd_view *view, const gsd_handle *handle, uint32_t node, double tx, double ty,
                                float direction[3])
{
    const gsd_node *leaf = &view->nodes[node];
    uint32_t left = leaf->leaf.x & 0xffffffu, low = leaf->leaf.y;
    double size = (double)(16777216u >> (leaf->leaf.x >> 24));
    double fx, fy;
    float seen[3];
    tx = tx > 0 ? tx : 0;
    ty = ty > 0 ? ty : 0;
    fx = (tx < 0.99999999988 ? tx : 0.99999999988) * size;
    fy = (ty < 0.99999999988 ? ty : 0.99999999988) * size;
    gsd_direction((double)left + fx, (double)low + fy, direction);
    gsd_from_pivot(handle->offset, direction);
    if (fx < GSD_EDGE || fx > size - GSD_EDGE || fy < GSD_EDGE || fy > size - GSD_EDGE ||
        (handle->product > 0 && size > 2097152))
        return gsd_pdf(view, handle, direction);
    return gsd_oriented(view, handle, leaf->leaf.pdf, left, low, gsd_to_pivot(handle->offset, direction, seen));
}

/* Place of r (0 .. 1) among 8 weights; r becomes the place within that weight's share. Without branches. */
GSD_QUERY uint32_t gsd_choose_of_eight(const float *weight, double *r)
{
    float prefix[8];
    double t;
    uint32_t i, k = 0;
    prefix[0] = weight[0];
    for (i = 1; i < 8; ++i)
        prefix[i] = prefix[i - 1] + weight[i];
    t = *r * (double)prefix[7];
    for (i = 0; i < 7; ++i)
        k += t >= (double)prefix[i];
    t = (t - (double)(k ? prefix[k - 1] : 0)) / (double)weight[k];
    *r = t > 0 ? t < 0.99999999988 ? t : 0.99999999988 : 0; /* a weight of 0 gives NaN or infinity: any place will do */
    return k;
}

/* First step of sampling a product: choose a row of bins by r[1], a bin in it by r[0], which become the place in the
   bin. weight, row: from gsd_bin_weights. */
GSD_QUERY uint32_t gsd_choose_bin(const float *weight, const float *row, double r[2])
{
    uint32_t y = gsd_choose_of_eight(row, &r[1]);
    return y * 8 + gsd_choose_of_eight(weight + y * 8, &r[0]);
}

/* The place in a bin becomes that in the node its jump leads to: the same, unless that is a leaf of several bins. */
GSD_QUERY void gsd_leave_bin(const gsd_node *node, uint32_t bin, double r[2])
{
    uint32_t depth = node->leaf.x >> 24, mask;
    if (node->leaf.child == 0 && depth < 3) {
        double part = 1.0 / (double)(8u >> depth);
        mask = (8u >> depth) - 1;
        r[0] = ((double)(bin & mask) + r[0]) * part;
        r[1] = ((double)(bin >> 3 & mask) + r[1]) * part;
    }
}

/* Probabilities of the bins under the product, and the sums of the 8 rows. */
GSD_QUERY void gsd_bin_weights(const gsd_view *view, const gsd_handle *handle, float weight[64], float row[8])
{
    const float *mass = view->masses + handle->jump;
    float lift = gsd_lift(handle->offset, handle->normal);
    uint32_t k, y;
    for (k = 0; k < 64; ++k)
        weight[k] = mass[k] * gsd_bin_cosine(view, handle->normal, lift, k);
    for (y = 0; y < 8; ++y) {
        const float *w = weight + y * 8;
        row[y] = ((w[0] + w[1]) + (w[2] + w[3])) + ((w[4] + w[5]) + (w[6] + w[7]));
    }
}

/* Draw a direction from the two random numbers u in [0, 1); returns its density (1/sr). Monotone in u along phi and z
   within every quadtree node (keeps stratification), unless the field has alias tables. [any thread] */
GSD_QUERY float gsd_sample(const gsd_view *view, const gsd_handle *handle, const float u[2], float direction[3])
{
    double r[2], lo[2] = {0, 0}, width[2] = {1, 1}, e = (double)view->uniform;
    uint32_t node = handle->root, child;
    gsd_extend_random(u, r);
    if (r[0] < e) { /* uniform share */
        gsd_direction(r[0] / e * 16777216.0, r[1] * 16777216.0, direction);
        return gsd_pdf(view, handle, direction);
    }
    r[0] = (r[0] - e) / (1 - e);
    r[0] = r[0] < 0.99999999988 ? r[0] : 0.99999999988;
    if (handle->product > 0) {
        float weight[64], row[8];
        uint32_t bin;
        gsd_bin_weights(view, handle, weight, row);
        bin = gsd_choose_bin(weight, row, r);
        node = view->jumps[handle->jump + bin];
        gsd_leave_bin(&view->nodes[node], bin, r);
    } else if (handle->alias_count) {
        double slot = r[0] * (double)handle->alias_count;
        const gsd_alias *a = &view->aliases[handle->alias + (uint32_t)slot];
        double rest = slot - floor(slot), t = (double)a->threshold;
        bool own = rest < t;
        rest = own ? rest / t : (rest - t) / (1 - t);
        return gsd_sample_leaf(view, handle, own ? a->node : a->other, rest, r[1], direction);
    }
    while ((child = view->nodes[node].inner.child) != 0) { /* narrow [lo, lo + width) around r: no divisions */
        const float *split = view->nodes[node].inner.split;
        double w = width[0] * (double)split[0];
        uint32_t bx = r[0] >= lo[0] + w && w < width[0], by;
        lo[0] = bx ? lo[0] + w : lo[0];
        width[0] = bx ? width[0] - w : w;
        w = width[1] * (double)split[1 + bx];
        by = r[1] >= lo[1] + w && w < width[1];
        lo[1] = by ? lo[1] + w : lo[1];
        width[1] = by ? width[1] - w : w;
        node = child + bx + 2 * by;
    }
    r[0] = (r[0] - lo[0]) / width[0];
    r[1] = (r[1] - lo[1]) / width[1];
    return gsd_sample_leaf(view, handle, node, r[0], r[1], direction);
}

/* Direction as the field keeps it: coordinates in the lower 24 bits of both words; above them the normal as 8 + 8 bits
   of an octahedral map, 0 = none. False where the direction is not finite or zero. [any thread] */
GSD_QUERY bool gsd_pack_direction(const float direction[3], const float *normal, uint32_t packed[2])
{
    float l = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2], d[3], n, a, b;
    bool valid = l > 1e-12f && l < 1e12f;
    l = fabsf(l - 1) < 1e-4f || !valid ? 1 : 1 / sqrtf(l);
    d[0] = direction[0] * l;
    d[1] = direction[1] * l;
    d[2] = direction[2] * l;
    gsd_coordinates(d, &packed[0], &packed[1]);
    n = normal ? fabsf(normal[0]) + fabsf(normal[1]) + fabsf(normal[2]) : 0;
    if (!(n > 0.5f && n < 4))
        return valid;
    a = normal[0] / n;
    b = normal[1] / n;
    if (normal[2] < 0) {
        float t = (1 - fabsf(b)) * (a < 0 ? -1.0f : 1.0f);
        b = (1 - fabsf(a)) * (b < 0 ? -1.0f : 1.0f);
        a = t;
    }
    packed[0] |= (uint32_t)(128.5f + 127 * a) << 24;
    packed[1] |= (uint32_t)(128.5f + 127 * b) << 24;
    return valid;
}

/* The normal of a packed direction; zero where it has none. [any thread] */
GSD_QUERY void gsd_unpack_normal(const uint32_t packed[2], float normal[3])
{
    float a = ((float)(packed[0] >> 24) - 128) / 127, b = ((float)(packed[1] >> 24) - 128) / 127;
    float c = 1 - fabsf(a) - fabsf(b), t = c < 0 ? c : 0, l;
    normal[0] = normal[1] = normal[2] = 0;
    if (packed[0] >> 24 == 0)
        return;
    a += a < 0 ? -t : t;
    b += b < 0 ? -t : t;
    l = 1 / sqrtf(a * a + b * b + c * c);
    normal[0] = a * l;
    normal[1] = b * l;
    normal[2] = c * l;
}

/* A training sample from scalars (channel means); normal: what gsd_find got, NULL = none. [any thread] */
GSD_QUERY gsd_training_sample gsd_make_scalar_sample(const float position[3], const float direction[3],
                                                     const float *normal, float distance, float radiance,
                                                     float contribution, float pixel_contribution, float pdf_mix,
                                                     float pdf_bsdf, float pdf_guide)
{
    gsd_training_sample s;
    memcpy(s.position, position, sizeof s.position);
    s.nearness = distance > 0 ? 1 / distance : -1; /* -1: will be refused, NaN too */
    s.radiance = radiance;
    s.contribution = contribution;
    s.pixel_contribution = pixel_contribution;
    s.pdf_mix = gsd_pack_direction(direction, normal, s.direction) ? pdf_mix : 0; /* 0: will be refused */
    s.pdf_bsdf = pdf_bsdf;
    s.pdf_guide = pdf_guide;
    return s;
}

/* A training sample from the renderer's RGB values: normal what gsd_find got (NULL = none), L incident radiance, f BSDF
   without the cosine, pixel_weight throughput before this vertex / pixel estimate (NULL = 1; only the variance-aware
   target needs it). [any thread] */
GSD_QUERY gsd_training_sample gsd_make_sample(const float position[3], const float direction[3], const float *normal,
                                              float distance, const float L[3], const float f[3], float cosine,
                                              const float pixel_weight[3], float pdf_mix, float pdf_bsdf,
                                              float pdf_guide)
{
    float radiance = 0, contribution = 0, pixel = 0;
    int c;
    for (c = 0; c < 3; ++c) {
        float v = f[c] * L[c] * cosine * (1.0f / 3.0f);
        radiance += L[c] * (1.0f / 3.0f);
        contribution += v;
        pixel += pixel_weight ? v * pixel_weight[c] : v;
    }
    return gsd_make_scalar_sample(position, direction, normal, distance, radiance, contribution, pixel, pdf_mix,
                                  pdf_bsdf, pdf_guide);
}

#if defined(__clang__)
#pragma STDC FP_CONTRACT DEFAULT
#endif

/* ---- >>batch ------------------------------------------------------------------------------------------------ */

/* The queries for arrays: several in flight at once, so that memory latency overlaps. index lists the entries to
   process in all arrays (NULL = 0 .. count - 1); strides are in bytes. normals, u and alpha (dense floats) of find may
   be NULL. Handles are dense. [any thread] */
GSD_API void gsd_find_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gsd_handle *handles, float *alpha);
GSD_API void gsd_sample_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const gsd_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t direction_stride, float *pdf);
GSD_API void gsd_pdf_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const gsd_handle *handles,
                           const float *directions, size_t direction_stride, float *pdf);

#ifdef __cplusplus
}
#endif

#endif /* GUIDE_SDTREE_H */

/* ============================================== IMPLEMENTATION ============================================== */

#if defined(GSD_IMPLEMENTATION) && !defined(GSD_IMPLEMENTATION_DONE)
#define GSD_IMPLEMENTATION_DONE

/* Based on the papers listed under REFERENCES; no other code. */

#include <stdlib.h>

#ifndef GSD_ASSERT
#include <assert.h>
#define GSD_ASSERT(x) assert(x)
#endif
#ifndef GSD_MALLOC
#define GSD_MALLOC(n) malloc(n)
#define GSD_FREE(p) free(p)
#endif

#if !defined(GSD_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__x86_64__)
#define GSDI_X86 1
#include <immintrin.h>
#else
#define GSDI_X86 0
#endif
#if !defined(GSD_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__aarch64__)
#define GSDI_NEON 1
#include <arm_neon.h>
#else
#define GSDI_NEON 0
#endif
#if defined(__GNUC__) && !defined(__clang__)
#define GSDI_UNROLL _Pragma("GCC unroll 4")
#define GSDI_FLATTEN __attribute__((flatten)) /* inline queries are inlined, and so not contracted either */
#else
#define GSDI_UNROLL
#define GSDI_FLATTEN
#endif
#if defined(__GNUC__) || defined(__clang__)
#define GSDI_PREFETCH(p) __builtin_prefetch(p)
#else
#define GSDI_PREFETCH(p) ((void)(p))
#endif

/* What decides structure must not depend on contraction into fused multiply-adds. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#define GSDI_NONE 0xffffffffu
#define GSDI_GRID 4096u       /* 16^3 links */
#define GSDI_BINS 64u         /* 8 x 8 bins of directions: nodes of depth 3 */
#define GSDI_ROUND (1u << 18) /* samples sorted at once */
#define GSDI_SEGMENT 2048u    /* samples prepared at once */
#define GSDI_STACK 96         /* of a walk through a quadtree: 3 * depth 20 + 4 is the most */
#define GSDI_MAP_LEVELS 4u    /* of a quadtree that are unfolded for a cell's samples */
#define GSDI_MAP_FIRST(level) (((1u << 2 * (level)) - 1) & 0x55555555u) /* (4^level - 1) / 3 */
#define GSDI_MAP_NODES 341                                              /* GSDI_MAP_FIRST(GSDI_MAP_LEVELS + 1) */
#define GSDI_GATE_LOW 4        /* values of a below 1 at which V(a) is estimated */
#define GSDI_MAX_VALUE 9.9e29f /* radiance or weight from here on is a bad sample */
#define GSDI_MAX_ROOT 1e15     /* values are clamped to this before squaring */
#define GSDI_CONFIDENCE 1.645  /* one-sided 95 % of the normal distribution */
#define GSDI_MIN_EFFECTIVE                                                                                             \
    128.0                  /* effective non-zero samples for the verdict "this tree does not pay"; fewer closes        \
                              cells whose light is rarely found */
#define GSDI_MIN_EVEN 32.0 /* for "too even to pay" */
#define GSDI_MIN_EVEN_REBUILDS                                                                                         \
    8 /* and before that verdict: the first cells are large, and have not yet found light that is rare; without it all \
         of pool closes at once */
#define GSDI_MIN_OPEN 4.0         /* for "pays" */
#define GSDI_ENOUGH_HITS 256u     /* non-zero samples of a cell and pass; from then on the gate takes one of eight */
#define GSDI_REFLECTED_SAMPLES 32 /* of a cell and pass, for its mean reflected radiance to count */
#define GSDI_MIN_REBUILDS 3       /* before that verdict: the first trees are noise */
#define GSDI_SPLIT 2.0            /* a cell splits above that times sqrt(samples held): tuned on SF1 (1 .. 2), ajar */
#define GSDI_MIN_SPLIT 32.0       /* at least */
#define GSDI_MOST_REACH 0.7 /* a cell lies within so many radii of a new pivot: the sphere is made larger for it */
#define GSDI_KEPT_REACH 0.6 /* and of one that it keeps */
#define GSDI_LIT                                                                                                       \
    24.0                      /* ... times its share of non-zero samples: parts of a dark cell would know too little;  \
                                 tuned on lamps, ajar (8 .. 32) */
#define GSDI_BLUR_EVEN 0.005  /* share of evenness in the density that one half of the samples says of the other */
#define GSDI_BLUR_MOST 0.6    /* of the way towards the surroundings, for one half */
#define GSDI_BLUR_STEPS 5     /* halvings of the interval that holds the best blur */
#define GSDI_BLUR_NOISE 4     /* see gsdi_blur_useful; n samples: 4 leaves / n; tuned on spot, hole, lamps, torus */
#define GSDI_BLUR_FREE 131072 /* leaves that are blurred whatever the budget */
#define GSDI_MAX_CELLS (1u << 26)

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

static void *gsdi_default_allocate(void *user, size_t size)
{
    (void)user;
    return GSD_MALLOC(size);
}

static void gsdi_default_release(void *user, void *pointer)
{
    (void)user;
    GSD_FREE(pointer);
}

/* count * size bytes, zeroed; NULL on failure or overflow. */
static void *gsdi_allocate(const gsd_desc *desc, uint64_t count, size_t size)
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

static void gsdi_release(const gsd_desc *desc, void *pointer)
{
    if (pointer)
        desc->release(desc->user, pointer);
}

static void gsdi_run(gsd_parallel_fn parallel, void *user, uint32_t count, uint32_t grain, gsd_range_fn fn,
                     void *context)
{
    if (parallel && count > grain)
        parallel(user, count, grain, fn, context);
    else if (count)
        fn(context, 0, count);
}

/* What building knows about a cell; saved as it is, so no padding. Sums are f64. */
typedef struct gsdi_state {
    double held;                   /* samples in the sums, those kept from earlier passes included */
    double lit;                    /* of which non-zero */
    double fresh;                  /* of this pass */
    double gate_count;             /* samples that the gate has seen */
    double v[GSDI_GATE_LOW + 1];   /* sum of x_a = contribution^2 / (p p_a); the last is a = 1 */
    double vv[GSDI_GATE_LOW + 1];  /* sum of x_a^2 */
    double cross[GSDI_GATE_LOW];   /* sum of x_a x_1 */
    double weight;                 /* sum of contribution / p */
    double pixel, pixel_v;         /* sum of x_1 (pixel contribution / contribution)^2, and of x_1 beside it */
    double flow;                   /* sum of contribution / p of this pass */
    double mass, near_mass;        /* what its samples put into quadtrees, and the sum of that times 1 / distance */
    float theta, moment1, moment2; /* Adam: alpha = sigmoid(theta) */
    uint32_t steps;
    float alpha;    /* learned; what queries see is in gsd_cell */
    uint32_t gate;  /* GSD_GATE_... */
    uint32_t probe; /* closed: passes until the next try; 0 = trying */
    uint32_t first; /* building nodes first .. first + count - 1, root first */
    uint32_t count;
    uint32_t origin[3]; /* lowest corner on the grid */
    uint32_t level;
    uint32_t rebuilds; /* times its sampling tree was rebuilt */
    uint32_t hits;     /* non-zero samples that the gate took in this pass */
    float reflected;   /* flow / fresh of the last pass that had enough samples, 0 = none had */
    float pivot[3];    /* where its sums are seen from: see gsd_cell */
    float nearness;
    uint32_t bins[64]; /* held by 4 x 4 x 4 sub-cells, index x y z with 2 bits each, for several splits at once */
} gsdi_state;

/* What a leaf of a building tree has gathered, by halves of its samples: what one half says is tested on the other. */
typedef struct gsdi_sum {
    double half[2];
} gsdi_sum;

/* A quadtree of the sampling part. */
typedef struct gsdi_tree {
    uint32_t root;   /* node; 0 = uniform */
    uint32_t first;  /* children: groups of 4 nodes from here */
    uint32_t groups; /* = inner nodes */
    uint32_t jump, alias, leaves;
    uint32_t max_depth;
    float mean_depth;
} gsdi_tree;

/* Start of a sampling part; offsets in bytes from here. */
typedef struct gsdi_block {
    uint64_t size;
    uint32_t spatial, cells, trees, nodes, jumps, aliases; /* counts */
    uint64_t grid_at, spatial_at, cells_at, trees_at, nodes_at, jumps_at, masses_at, bins_at, aliases_at;
    float origin[3], scale;
    float uniform;
    uint32_t roots; /* nodes before the first group */
    uint32_t cell_capacity;
    uint32_t reserved;
} gsdi_block;

struct gsd_field {
    gsd_desc desc;
    void *memory;      /* of block */
    gsdi_block *block; /* 64-byte aligned within memory */
    gsdi_state *states;
    uint32_t *child; /* building nodes: first child relative to the tree's root, 0 = leaf */
    gsdi_sum *sum;   /* leaves: sums; inner nodes: scratch of refine */
    uint32_t building_nodes;
    uint32_t passes;
    double first_pass_samples, last_pass_samples;
    double all_samples;  /* recorded for this target so far */
    double held_samples; /* of which refine kept that many */
    uint32_t target;     /* gsd_target that is learned now: never switching */
    uint32_t pixels;     /* the last pass had a pixel estimate */
    uint64_t structure;
    gsd_stats stats;
    uint32_t guiding; /* cells with alpha < 1 */
    uint32_t state_capacity, node_capacity;
    void *scratch; /* of accumulate, kept */
    uint64_t scratch_size;
};

/* ---- >>math ------------------------------------------------------------------------------------------------- */

static const double gsdi_gate_alpha[GSDI_GATE_LOW + 1] = {0.1, 0.3, 0.5, 0.75, 1.0};

static bool gsdi_finite(float x) { return x - x == 0; }

static uint64_t gsdi_hash(uint64_t h, uint64_t x)
{
    h = (h ^ x) * 0x9fb21c651e98df25ull;
    return h ^ (h >> 29);
}

/* Hash of bytes, eight at a time. */
static uint64_t gsdi_hash_bytes(uint64_t h, const void *data, size_t size)
{
    const unsigned char *p = (const unsigned char *)data;
    uint64_t word;
    for (; size >= 8; p += 8, size -= 8) {
        memcpy(&word, p, 8);
        h = gsdi_hash(h, word);
    }
    for (word = 0; size; --size)
        word = word << 8 | p[size - 1];
    return gsdi_hash(h, word);
}

/* Three random numbers in [0, 1) from a sample's own bits, so that they do not depend on how samples were batched. */
static void gsdi_sample_random(const gsd_training_sample *s, double u[3])
{
    uint64_t h = gsdi_hash_bytes(0x2545f4914f6cdd1dull, s, 32);
    int i;
    for (i = 0; i < 3; ++i) {
        h = gsdi_hash(h, 0x9e3779b97f4a7c15ull);
        u[i] = (double)(h >> 32) * 2.3283064365386963e-10;
    }
}

/* ---- >>streams ---------------------------------------------------------------------------------------------- */

typedef struct gsdi_chunk {
    struct gsdi_chunk *next;
    uint32_t count, capacity;
    gsd_training_sample samples[1];
} gsdi_chunk;

struct gsd_stream {
    gsd_desc desc;
    gsdi_chunk *first, *current;
    uint64_t size, lost, lost_told;
};

GSD_API gsd_result gsd_stream_create(const gsd_field *field, gsd_stream **stream)
{
    *stream = (gsd_stream *)gsdi_allocate(&field->desc, 1, sizeof(gsd_stream));
    if (!*stream)
        return GSD_OUT_OF_MEMORY;
    (*stream)->desc = field->desc;
    return GSD_OK;
}

GSD_API void gsd_stream_destroy(gsd_stream *stream)
{
    gsdi_chunk *chunk, *next;
    if (!stream)
        return;
    for (chunk = stream->first; chunk; chunk = next) {
        next = chunk->next;
        gsdi_release(&stream->desc, chunk);
    }
    {
        gsd_desc desc = stream->desc;
        gsdi_release(&desc, stream);
    }
}

GSD_API void gsd_stream_clear(gsd_stream *stream)
{
    gsdi_chunk *chunk;
    for (chunk = stream->first; chunk; chunk = chunk->next)
        chunk->count = 0;
    stream->current = stream->first;
    stream->size = 0;
    stream->lost = stream->lost_told = 0;
}

GSD_API uint64_t gsd_stream_size(const gsd_stream *stream) { return stream->size; }

/* Room for one more sample at least; NULL = out of memory. Chunks: 256 samples, doubling up to 16384. */
static gsdi_chunk *gsdi_stream_room(gsd_stream *stream)
{
    gsdi_chunk *chunk = stream->current, *fresh;
    uint32_t capacity = 256;
    if (chunk && chunk->count < chunk->capacity)
        return chunk;
    if (chunk && chunk->next)
        return stream->current = chunk->next; /* from before clear */
    if (chunk)
        capacity = chunk->capacity < 16384 ? chunk->capacity * 2 : 16384;
    fresh = (gsdi_chunk *)stream->desc.allocate(stream->desc.user,
                                                sizeof(gsdi_chunk) + capacity * sizeof(gsd_training_sample));
    if (!fresh)
        return NULL;
    fresh->next = NULL;
    fresh->count = 0;
    fresh->capacity = capacity;
    if (chunk)
        chunk->next = fresh;
    else
        stream->first = fresh;
    return stream->current = fresh;
}

GSD_API gsd_result gsd_record(gsd_stream *stream, const gsd_training_sample *samples, uint32_t count)
{
    while (count) {
        gsdi_chunk *chunk = gsdi_stream_room(stream);
        uint32_t n;
        if (!chunk) {
            stream->lost += count;
            return GSD_OUT_OF_MEMORY;
        }
        n = chunk->capacity - chunk->count;
        n = n < count ? n : count;
        memcpy(chunk->samples + chunk->count, samples, n * sizeof *samples);
        chunk->count += n;
        stream->size += n;
        samples += n;
        count -= n;
    }
    return GSD_OK;
}

GSD_API gsd_result gsd_record_cells(gsd_stream *stream, const uint32_t *cells, const gsd_training_sample *samples,
                                    uint32_t count)
{
    uint32_t i;
    if (!stream->desc.forest_cells)
        return GSD_NOT_A_FOREST;
    for (i = 0; i < count; ++i) {
        gsd_training_sample s = samples[i];
        memcpy(s.position, &cells[i], sizeof(uint32_t)); /* a forest's samples carry their cell here */
        s.position[1] = s.position[2] = 0;
        if (gsd_record(stream, &s, 1)) {
            stream->lost += count - i - 1;
            return GSD_OUT_OF_MEMORY;
        }
    }
    return GSD_OK;
}

/* ---- >>trees ------------------------------------------------------------------------------------------------ */

/* One node of a walk. */
typedef struct gsdi_visit {
    uint32_t node, x, y, depth;
    uint32_t out; /* node in another tree */
    double mass;
    gsdi_sum sum;
} gsdi_visit;

/* The first levels of a building tree as pictures, made for the samples of a cell: in that of level l, row
   y >> (24 - l) and column x >> (24 - l) name the node of depth l there, or the leaf above. */
typedef struct gsdi_map {
    const uint32_t *child;
    gsdi_sum *sum;
    uint32_t levels;
    uint32_t node[GSDI_MAP_NODES];
    unsigned char depth[GSDI_MAP_NODES];
} gsdi_map;

/* For so many samples: pictures that cost less than they save. */
static void gsdi_map_make(gsdi_map *map, const uint32_t *child, gsdi_sum *sum, uint32_t samples)
{
    uint32_t l, x, y, k;
    map->child = child;
    map->sum = sum;
    map->node[0] = map->depth[0] = 0;
    for (l = 0; l < GSDI_MAP_LEVELS && (2u << 2 * l) <= samples; ++l) {
        uint32_t n = 1u << l, at = GSDI_MAP_FIRST(l), to = GSDI_MAP_FIRST(l + 1);
        for (y = 0; y < n; ++y)
            for (x = 0; x < n; ++x, ++at) {
                uint32_t c = child[map->node[at]];
                for (k = 0; k < 4; ++k) {
                    uint32_t i = to + (2 * y + (k >> 1)) * 2 * n + 2 * x + (k & 1);
                    map->node[i] = c ? c + k : map->node[at];
                    map->depth[i] = (unsigned char)(map->depth[at] + (c != 0));
                }
            }
    }
    map->levels = l;
}

/* Node of this depth at 24-bit coordinates, or the leaf above; *depth becomes its depth. */
static uint32_t gsdi_map_node(const gsdi_map *map, uint32_t x, uint32_t y, uint32_t *depth)
{
    uint32_t level = *depth < map->levels ? *depth : map->levels, shift = 24 - level, c;
    uint32_t i = GSDI_MAP_FIRST(level) + (y >> shift << level | x >> shift), node = map->node[i];
    for (level = map->depth[i]; level < *depth && (c = map->child[node]) != 0; ++level) {
        --shift;
        node = c + ((x >> shift) & 1u) + 2 * ((y >> shift) & 1u);
    }
    *depth = level;
    return node;
}

/* Add weight * (overlap area) to every leaf that overlaps a rectangle. */
typedef struct gsdi_rectangle {
    const gsdi_map *map;
    uint32_t half, x[2], y[2]; /* from, to */
    double weight;
} gsdi_rectangle;

static uint32_t gsdi_overlap(const uint32_t with[2], uint32_t from, uint32_t size)
{
    uint32_t a = with[0] > from ? with[0] : from, b = with[1] < from + size ? with[1] : from + size;
    return b > a ? b - a : 0;
}

/* The same within the square of an inner node: lowest corner, side. Leaves beside the rectangle get 0: no branches. */
static void gsdi_splat_rectangle(const gsdi_rectangle *r, uint32_t node, uint32_t x, uint32_t y, uint32_t size)
{
    uint32_t c = r->map->child[node], half = size >> 1, k;
    for (k = 0; k < 4; ++k) {
        uint32_t left = x + (k & 1) * half, low = y + (k >> 1) * half;
        double area = (double)gsdi_overlap(r->x, left, half) * (double)gsdi_overlap(r->y, low, half);
        if (!r->map->child[c + k])
            r->map->sum[c + k].half[r->half] += r->weight * area;
        else if (area > 0)
            gsdi_splat_rectangle(r, c + k, left, low, half);
    }
}

/* Where a box of this side, centred at x, lies: in the square of its size around x [0] and in the one beside it [1],
   above if upper, else below. at: a coordinate in each. Without branches: either is as likely. */
typedef struct gsdi_sides {
    uint32_t upper, at[2], length[2];
} gsdi_sides;

static gsdi_sides gsdi_box_sides(uint32_t x, uint32_t size)
{
    gsdi_sides s;
    uint32_t middle = size / 2, sign;
    s.upper = (x & middle) != 0;
    sign = s.upper - 1; /* all bits set: below */
    s.at[0] = x;
    s.at[1] = x + ((size ^ sign) - sign);
    s.length[1] = (((x & (size - 1)) - middle) ^ sign) - sign;
    s.length[0] = size - s.length[1];
    return s;
}

/* Box filter [Mueller 2019]: spread value over a box of the size of the leaf at (x, y), centred there. phi wraps; what
   passes a pole comes back at phi + half a turn. The sum over all leaves grows by value. The box overlaps four squares
   of its own size: k = 0 the leaf, 1 beside it, 2 above or below it, 3 beside that one; each of 1 .. 3 is a leaf, part
   of a larger one, or divided further. */
static void gsdi_splat_box(const gsdi_map *map, uint32_t half, uint32_t x, uint32_t y, double value)
{
    uint32_t depth = 24, leaf = gsdi_map_node(map, x, y, &depth), size = 16777216u >> depth, k;
    gsdi_sides h = gsdi_box_sides(x, size), v = gsdi_box_sides(y, size);
    uint32_t pole = v.at[1] >> 24 & 1u;
    double weight = value / ((double)size * (double)size);
    h.at[1] &= 0xffffffu;
    v.at[1] = pole ? y : v.at[1];
    map->sum[leaf].half[half] += weight * ((double)h.length[0] * (double)v.length[0]);
    GSDI_UNROLL
    for (k = 1; k < 4; ++k) {
        uint32_t i = k & 1, j = k >> 1, left = h.at[i] ^ (j & pole) << 23, low = v.at[j], to = depth;
        uint32_t node = gsdi_map_node(map, left, low, &to);
        if (map->child[node]) {
            gsdi_rectangle part;
            part.map = map;
            part.half = half;
            part.weight = weight;
            left &= ~(size - 1);
            low &= ~(size - 1);
            part.x[0] = left + (h.upper == i ? 0 : size - h.length[i]);
            part.x[1] = part.x[0] + h.length[i];
            part.y[0] = low + ((v.upper ^ (j & pole)) == j ? 0 : size - v.length[j]);
            part.y[1] = part.y[0] + v.length[j];
            gsdi_splat_rectangle(&part, node, left, low, size);
        } else {
            map->sum[node].half[half] += weight * ((double)h.length[i] * (double)v.length[j]);
        }
    }
}

/* Mass of a leaf: its sum, or the root of sum * solid-angle fraction. */
static double gsdi_leaf_mass(double sum, bool second_moment, uint32_t depth)
{
    return second_moment ? sqrt(sum) * (1.0 / (double)(1u << depth)) : sum;
}

/* Masses of all nodes of a building tree: leaves' own (or the root of sum * solid-angle fraction for second moments),
   inner nodes the sum of their children; inner sums likewise. Children come after parents. Returns the total. */
static double gsdi_tree_masses(const uint32_t *child, gsdi_sum *sum, uint32_t count, bool second_moment, double *mass,
                               unsigned char *depth)
{
    uint32_t i, k;
    depth[0] = 0;
    for (i = 0; i < count; ++i) {
        uint32_t c = child[i];
        if (c)
            depth[c] = depth[c + 1] = depth[c + 2] = depth[c + 3] = (unsigned char)(depth[i] + 1);
        else
            mass[i] = gsdi_leaf_mass(sum[i].half[0] + sum[i].half[1], second_moment, depth[i]);
    }
    for (i = count; i-- > 0;) {
        uint32_t c = child[i];
        if (c) {
            mass[i] = (mass[c] + mass[c + 1]) + (mass[c + 2] + mass[c + 3]);
            for (k = 0; k < 2; ++k)
                sum[i].half[k] = (sum[c].half[k] + sum[c + 1].half[k]) + (sum[c + 2].half[k] + sum[c + 3].half[k]);
        }
    }
    return mass[0];
}

/* Child k of a visited node of a tree: another node, or a quarter of a leaf; `out` is its number in another tree. */
static void gsdi_visit_child(const gsdi_visit *v, const uint32_t *child, const gsdi_sum *sum, uint32_t k, uint32_t out,
                             gsdi_visit *next)
{
    uint32_t c = v->node == GSDI_NONE ? 0 : child[v->node];
    next->node = c ? c + k : GSDI_NONE;
    next->depth = v->depth + 1;
    next->out = out;
    next->sum.half[0] = c ? sum[next->node].half[0] : v->sum.half[0] * 0.25;
    next->sum.half[1] = c ? sum[next->node].half[1] : v->sum.half[1] * 0.25;
}

/* Structure for the next pass: a node is divided where its mass exceeds limit; new halves get a quarter each. out_child
   and out_sum (keep times the old sums, pushed down evenly) may be NULL: count only. Returns the number of nodes. */
static uint32_t gsdi_refine_tree(const uint32_t *child, const gsdi_sum *sum, const double *mass, double limit,
                                 uint32_t max_depth, double keep, uint32_t *out_child, gsdi_sum *out_sum)
{
    gsdi_visit stack[GSDI_STACK];
    uint32_t total = 1;
    int top = 0, k;
    memset(&stack[0], 0, sizeof stack[0]);
    stack[0].mass = mass[0];
    stack[0].sum = sum[0];
    while (top >= 0) {
        gsdi_visit v = stack[top--];
        bool divide = v.mass > limit && v.depth < max_depth;
        if (out_child) {
            out_child[v.out] = divide ? total : 0;
            out_sum[v.out].half[0] = divide ? 0 : v.sum.half[0] * keep;
            out_sum[v.out].half[1] = divide ? 0 : v.sum.half[1] * keep;
        }
        if (!divide)
            continue;
        for (k = 3; k >= 0; --k) {
            gsdi_visit *next = &stack[++top];
            gsdi_visit_child(&v, child, sum, (uint32_t)k, total + (uint32_t)k, next);
            next->mass = next->node != GSDI_NONE ? mass[next->node] : v.mass * 0.25;
        }
        total += 4;
    }
    return total;
}

/* ---- >>denoise ---------------------------------------------------------------------------------------------- */

/* What the blur reads and writes of one building tree, shares of the half's or the tree's mass; [nodes] each. */
typedef struct gsdi_blur {
    float *half[2]; /* masses that each half of the samples gives, all nodes; of inner ones 0 once moves are known */
    float *near[3]; /* leaves: mean of the eight squares around, of each half and of both; then how far halves move */
    float *even;    /* mass of both halves, all nodes; then the density's share of evenness in each leaf */
    double *mass;   /* of both halves, all nodes, not divided by their sum */
} gsdi_blur;
#define GSDI_BLUR_FLOATS 6 /* a node */

/* Cut `work` [GSDI_BLUR_FLOATS * nodes] into the parts of a blur. */
static gsdi_blur gsdi_blur_make(float *work, uint32_t nodes, double *mass)
{
    gsdi_blur b;
    uint32_t k;
    for (k = 0; k < GSDI_BLUR_FLOATS; ++k)
        *(k < 2 ? &b.half[k] : k < 5 ? &b.near[k - 2] : &b.even) = work + (size_t)k * nodes;
    b.mass = mass;
    return b;
}

/* A node with the 3 x 3 squares of its size around it: `near` is a node of that size, or the leaf that lies `up` levels
   above. Row by row, upwards in z. */
typedef struct gsdi_around {
    uint32_t node, near[9];
    int32_t y; /* in units of its size */
    unsigned char depth, up[9];
} gsdi_around;

/* Child k of a node, with the squares around it: they lie in the squares around the parent. phi wraps; what passes a
   pole comes back at phi + half a turn. */
static void gsdi_around_child(const uint32_t *child, const gsdi_around *parent, uint32_t k, gsdi_around *out)
{
    /* along an axis, for the lower and the upper child: square of the parent's, and half of it */
    static const unsigned char square[2][3] = {{0, 1, 1}, {1, 1, 2}}, half[2][3] = {{1, 0, 1}, {0, 1, 0}};
    const unsigned char *sx = square[k & 1], *sy = square[k >> 1], *hx = half[k & 1], *hy = half[k >> 1];
    int32_t size, i, j;
    out->node = child[parent->node] + k;
    out->depth = (unsigned char)(parent->depth + 1);
    out->y = 2 * parent->y + (int32_t)(k >> 1);
    size = (int32_t)(1u << out->depth);
    for (j = 0; j < 3; ++j) {
        bool pole = out->y + j - 1 < 0 || out->y + j - 1 >= size;
        for (i = 0; i < 3; ++i) {
            uint32_t from = sx[i] + 3u * sy[j], to = (uint32_t)(i + 3 * j), c;
            uint32_t x = hx[i] ^ (uint32_t)(pole && size == 2), y = hy[j] ^ (uint32_t)pole;
            c = parent->up[from] ? 0 : child[parent->near[from]];
            out->near[to] = c ? c + x + 2 * y : parent->near[from];
            out->up[to] = (unsigned char)(c ? 0 : parent->up[from] + 1);
        }
    }
}

/* Masses of all nodes: of each half as shares of its sum, and of both. False: a half has none. */
static bool gsdi_blur_masses(const uint32_t *child, const gsdi_sum *sum, const unsigned char *depth, uint32_t count,
                             bool second_moment, gsdi_blur *b)
{
    double total[2] = {0, 0}, scale = 1 / b->mass[0];
    uint32_t i, k;
    for (i = 0; i < count; ++i)
        for (k = 0; k < 2 && !child[i]; ++k) {
            double m = gsdi_leaf_mass(sum[i].half[k], second_moment, depth[i]) * scale;
            b->half[k][i] = (float)m;
            total[k] += m;
        }
    if (!(total[0] > 1e-30) || !(total[1] > 1e-30))
        return false;
    total[0] = 1 / total[0];
    total[1] = 1 / total[1];
    for (i = count; i-- > 0;) {
        b->even[i] = (float)(b->mass[i] * scale);
        for (k = 0; k < 2; ++k) {
            float *m = b->half[k];
            uint32_t c = child[i];
            m[i] = c ? (m[c] + m[c + 1]) + (m[c + 2] + m[c + 3]) : (float)((double)m[i] * total[k]);
        }
    }
    return true;
}

/* Mean around a leaf, sides counting twice as much as corners, for either half and both. A leaf that is larger counts
   with the share of its area, a divided square with its sum. part[u] = 4^-u. */
static void gsdi_blur_mean(const gsdi_blur *b, const gsdi_around *at, const float *part, double total[3])
{
    static const float weight[9] = {1 / 12.0f, 1 / 6.0f,  1 / 12.0f, 1 / 6.0f, 0,
                                    1 / 6.0f,  1 / 12.0f, 1 / 6.0f,  1 / 12.0f};
    float sum[3] = {0, 0, 0};
    uint32_t k;
    for (k = 0; k < 9; ++k) {
        uint32_t n = at->near[k];
        float w = weight[k] * part[at->up[k]];
        sum[0] += w * b->half[0][n];
        sum[1] += w * b->half[1][n];
        sum[2] += w * b->even[n];
    }
    for (k = 0; k < 3; ++k) {
        b->near[k][at->node] = sum[k];
        total[k] += (double)sum[k];
    }
}

/* first * 4^-k: shares of a square that lies k levels above, or of the whole at depth k. */
static void gsdi_quarters(double first, float part[25])
{
    uint32_t k;
    for (k = 0; k < 25; ++k)
        part[k] = (float)(first / (double)((uint64_t)1 << (2 * k)));
}

/* Means around the leaves of a divided tree, and their sums. */
static void gsdi_blur_near(const uint32_t *child, gsdi_blur *b, double total[3])
{
    gsdi_around stack[GSDI_STACK], at;
    float part[25];
    uint32_t top = 0, k;
    gsdi_quarters(1, part);
    total[0] = total[1] = total[2] = 0;
    memset(&stack[0], 0, sizeof stack[0]);
    for (++top; top;) {
        at = stack[--top];
        for (k = 4; k-- > 0;) {
            gsdi_around_child(child, &at, k, &stack[top]);
            if (child[stack[top].node])
                ++top;
            else
                gsdi_blur_mean(b, &stack[top], part, total);
        }
    }
}

/* For gsdi_blur_slope: how far the leaves of either half would move, and each leaf's share of evenness. Inner nodes get
   zeros, which add nothing there. */
static void gsdi_blur_moves(const uint32_t *child, const unsigned char *depth, uint32_t count, gsdi_blur *b,
                            const double total[3])
{
    float part[25];
    uint32_t i, k;
    gsdi_quarters(GSDI_BLUR_EVEN / (1 - GSDI_BLUR_EVEN), part);
    for (i = 0; i < count; ++i) {
        b->even[i] = part[depth[i]];
        for (k = 0; k < 2; ++k) {
            float *own = &b->half[k][i];
            *own = child[i] ? 0 : *own;
            b->near[k][i] = child[i] ? 0 : (float)((double)b->near[k][i] / total[k]) - *own;
        }
    }
}

/* Slope over t of what each half says of the other: sum of mass_other log(density), where the density is that of the
   half's masses moved by t towards their surroundings, with a share of evenness. It falls with t. Node 0 is an inner
   one; the others are summed in fours, as they come. */
static double gsdi_blur_slope(uint32_t count, const gsdi_blur *b, float t)
{
    double slope = 0;
    uint32_t i = 1, k;
    while (i < count) {
        uint32_t end = count - i > 1024 ? i + 1024 : count;
        float lane[4] = {0, 0, 0, 0};
        for (; i < end; i += 4)
            for (k = 0; k < 4; ++k) {
                float a = b->half[0][i + k], c = b->half[1][i + k], e = b->even[i + k];
                float da = b->near[0][i + k], dc = b->near[1][i + k];
                lane[k] += c * da / (a + t * da + e) + a * dc / (c + t * dc + e);
            }
        slope += (double)((lane[0] + lane[1]) + (lane[2] + lane[3]));
    }
    return slope;
}

/* Whether the halves differ by enough to ask for a blur. Where they agree better, what one says of the other would
   still ask for it, but only as leaves that it missed look far too dark to it; desc.smoothing has mended those. */
static bool gsdi_blur_useful(const uint32_t *child, uint32_t count, const gsdi_blur *b)
{
    double square = 0, leaves = count - (count - 1) / 4;
    uint32_t i;
    for (i = 0; i < count; ++i) {
        double d = child[i] ? 0 : (double)b->half[0][i] - (double)b->half[1][i];
        square += d * d;
    }
    return square * leaves > GSDI_BLUR_NOISE;
}

/* Blur the masses of one divided building tree in place. Returns how far they moved towards their surroundings: 0 = not
   at all: the halves agree as they are, or what one says of the other would get worse by any blur. */
static double gsdi_blur_tree(const uint32_t *child, const gsdi_sum *sum, const unsigned char *depth, uint32_t count,
                             bool second_moment, gsdi_blur *b)
{
    double total[3], low = 0, high = GSDI_BLUR_MOST, scale;
    uint32_t i, k;
    if (!gsdi_blur_masses(child, sum, depth, count, second_moment, b) ||
        (second_moment && !gsdi_blur_useful(child, count, b)))
        return 0;
    gsdi_blur_near(child, b, total);
    gsdi_blur_moves(child, depth, count, b, total);
    if (gsdi_blur_slope(count, b, 0) <= 0)
        return 0;
    for (k = 0; k < GSDI_BLUR_STEPS; ++k) {
        double t = 0.5 * (low + high);
        if (gsdi_blur_slope(count, b, (float)t) > 0)
            low = t;
        else
            high = t;
    }
    low = low / (2 - low); /* both halves together have half the noise */
    if (low <= 0)
        return 0;
    scale = b->mass[0] / total[2];
    for (i = count; i-- > 0;) {
        double *m = b->mass;
        uint32_t c = child[i];
        m[i] = c ? (m[c] + m[c + 1]) + (m[c + 2] + m[c + 3]) : m[i] + low * ((double)b->near[2][i] * scale - m[i]);
    }
    return low;
}

/* ---- >>gaussian --------------------------------------------------------------------------------------------- */

/* The method of [Nilsson, ch. 4]; see HOW IT WORKS. 7 x 7 Gaussian blur of a layer of a quadtree, separable, over the
   whole matrix or only where it changes something:

     out[r][c] = sum over i, j = -3 .. 3 of w[|i|] w[|j|] in[r + i][c + j],  w[0] + 2 (w[1] + w[2] + w[3]) = 1

   >= 0 in, >= 0 out; a NaN or infinity spreads over its window and no further. Relative error 3e-7 (bench_denoise; all
   terms are positive), as long as no product of two weights and a mass underflows.

   THE MATRIX in: element (0, 0) 64-byte aligned, `stride` floats from row to row, a multiple of 16. Rows -3 ..
   width + 2 and columns -16 .. width + 15 exist, and 16 floats more (see gsdi_gauss_floats); gsdi_gauss_pad fills what
   is outside 0 .. width - 1, so that the kernels know no borders. width: a power of two, >= 32. The margins also keep
   the ten rows that are read at once out of each other's cache sets (width floats alone would put all of them into the
   same ones).
   THE RESULT out: 64-byte aligned rows, no margin needed, not in place.

   Four rows at once: ten rows are loaded for four vertical sums, which stay in registers; the horizontal sum takes its
   seven shifts from two neighbouring vectors of them. Nothing is stored in between. Taps of equal weight are added
   first: 3 additions and 4 multiplications (fused) instead of 7, and on many machines those have different ports.
   Deviation from the thesis's 4.3: separable instead of 49 products a pixel, vectors of neighbouring pixels instead of
   the window's rows, no tiles (four rows at a time stream), masked by blocks instead of pixels. */
#define GSDI_GAUSS_MARGIN 16u  /* columns on either side */
#define GSDI_GAUSS_ROWS 4u     /* of a block */
#define GSDI_GAUSS_COLUMNS 4u  /* of a block: beside a border three columns of either leaf change */
#define GSDI_GAUSS_BLOCK 16u   /* floats: one cache line */
#define GSDI_GAUSS_AHEAD 8u    /* runs that input is fetched ahead: the processor cannot guess where the next one is */
#define GSDI_GAUSS_FIRST 6u    /* layer: "a minimum depth of 6 was found to work well" */
#define GSDI_GAUSS_DEEPEST 10u /* tree that is denoised with the work limit on */
#define GSDI_GAUSS_MOST 12u    /* ... and without: 160 MB at once for one tree */
#define GSDI_GAUSS_WORK 1.5e7  /* elements that pass 0 may blur */
#define GSDI_GAUSS_SLOTS 32u   /* trees at once */

/* Floats from row to row, in all, and before element (0, 0). */
static inline size_t gsdi_gauss_stride(uint32_t width) { return (size_t)width + 2 * GSDI_GAUSS_MARGIN; }
static inline size_t gsdi_gauss_floats(uint32_t width) { return ((size_t)width + 6) * gsdi_gauss_stride(width) + 16; }
static inline size_t gsdi_gauss_origin(uint32_t width) { return 3 * gsdi_gauss_stride(width) + GSDI_GAUSS_MARGIN; }

/* w[0..3] for sigma > 0, in elements. */
static inline void gsdi_gauss_weights(double sigma, float w[4])
{
    double g[4], sum = 0;
    int i;
    for (i = 0; i < 4; ++i) {
        g[i] = exp(-i * i / (2 * sigma * sigma));
        sum += i ? 2 * g[i] : g[i];
    }
    for (i = 0; i < 4; ++i)
        w[i] = (float)(g[i] / sum);
}

/* Fill the margins: sphere = phi wraps and row -1-k is row k shifted by half the width, likewise at the other pole;
   otherwise zeros. */
static inline void gsdi_gauss_pad(float *in, size_t stride, uint32_t width, bool sphere)
{
    size_t w = width, half = w / 2, margin = GSDI_GAUSS_MARGIN, bytes = (w + 2 * margin) * sizeof(float), r;
    for (r = 0; r < w; ++r) {
        float *row = in + r * stride;
        if (sphere) {
            memcpy(row - margin, row + w - margin, margin * sizeof(float));
            memcpy(row + w, row, margin * sizeof(float));
        } else {
            memset(row - margin, 0, margin * sizeof(float));
            memset(row + w, 0, margin * sizeof(float));
        }
    }
    memset(in + (w + 3) * stride - margin, 0, margin * sizeof(float)); /* vectors reach so far; nobody uses it */
    for (r = 0; r < 3; ++r) {
        float *below = in - (r + 1) * stride, *above = in + (w + r) * stride;
        const float *first = in + r * stride, *last = in + (w - 1 - r) * stride;
        if (sphere) { /* the padded row, turned: columns half - 16 .. half + 15 exist on either side of half */
            memcpy(below - margin, first + half - margin, (half + margin) * sizeof(float));
            memcpy(below + half, first, (half + margin) * sizeof(float));
            memcpy(above - margin, last + half - margin, (half + margin) * sizeof(float));
            memcpy(above + half, last, (half + margin) * sizeof(float));
        } else {
            memset(below - margin, 0, bytes);
            memset(above - margin, 0, bytes);
        }
    }
}

/* Blocks first .. end - 1 of block row `row`. */
typedef struct gsdi_gauss_run {
    uint32_t row;
    uint16_t first, end;
} gsdi_gauss_run;

/* Words of 64 blocks in a block row; words of a whole map. */
static inline uint32_t gsdi_gauss_map_stride(uint32_t width) { return (width / GSDI_GAUSS_COLUMNS + 63) / 64; }
static inline size_t gsdi_gauss_map_words(uint32_t width)
{
    return (size_t)(width / GSDI_GAUSS_ROWS) * gsdi_gauss_map_stride(width);
}

/* Set bits first .. end - 1 of a row of the map. */
static inline void gsdi_gauss_mark(uint64_t *row, uint32_t first, uint32_t end)
{
    uint32_t word = first / 64, last = (end - 1) / 64;
    uint64_t low = ~(uint64_t)0 << (first % 64), high = ~(uint64_t)0 >> (63 - (end - 1) % 64);
    if (word == last) {
        row[word] |= low & high;
        return;
    }
    row[word] |= low;
    while (++word < last)
        row[word] = ~(uint64_t)0;
    row[last] |= high;
}

/* A square region of a quadtree: node, lowest corner, side. */
typedef struct gsdi_square {
    uint32_t node, x, y, size;
} gsdi_square;

/* Map of the blocks in which the window of any element reaches beyond its leaf; layer >= 5. A
   square of 16 or more that is a leaf is active along its frame; one of 8 is active whether it is divided or not, so
   that nothing below needs a look. */
static inline void gsdi_gauss_map(const uint32_t *child, uint32_t layer, uint64_t *map)
{
    gsdi_square stack[GSDI_STACK], s;
    uint32_t width = 1u << layer, stride = gsdi_gauss_map_stride(width), top = 1, k, r;
    memset(map, 0, gsdi_gauss_map_words(width) * sizeof *map);
    stack[0].node = stack[0].x = stack[0].y = 0;
    stack[0].size = width;
    while (top) {
        s = stack[--top];
        for (k = 0; k < 4; ++k) {
            uint32_t c = child[s.node] + k, size = s.size / 2;
            uint32_t x = s.x + (k & 1 ? size : 0), y = s.y + (k & 2 ? size : 0);
            uint32_t first = x / GSDI_GAUSS_COLUMNS, end = (x + size) / GSDI_GAUSS_COLUMNS;
            uint32_t lowest = y / GSDI_GAUSS_ROWS, highest = (y + size) / GSDI_GAUSS_ROWS - 1;
            if (child[c] && size > 8) {
                stack[top].node = c;
                stack[top].x = x;
                stack[top].y = y;
                stack[top++].size = size;
                continue;
            }
            gsdi_gauss_mark(map + (size_t)lowest * stride, first, end);
            gsdi_gauss_mark(map + (size_t)highest * stride, first, end);
            for (r = lowest + 1; r < highest; ++r) {
                map[(size_t)r * stride + first / 64] |= (uint64_t)1 << (first % 64);
                map[(size_t)r * stride + (end - 1) / 64] |= (uint64_t)1 << ((end - 1) % 64);
            }
        }
    }
}

/* Runs of a map, at most width / 8 in each block row. Returns their number. */
static inline size_t gsdi_gauss_runs(const uint64_t *map, uint32_t width, gsdi_gauss_run *run)
{
    uint32_t blocks = width / GSDI_GAUSS_COLUMNS, stride = gsdi_gauss_map_stride(width), r, b;
    size_t count = 0;
    for (r = 0; r < width / GSDI_GAUSS_ROWS; ++r) {
        const uint64_t *row = map + (size_t)r * stride;
        for (b = 0; b < blocks;) {
            uint64_t rest = row[b / 64] >> (b % 64);
            if (!rest) { /* nothing left in this word */
                b = (b / 64 + 1) * 64;
                continue;
            }
            while (!(rest & 1)) {
                rest >>= 1;
                ++b;
            }
            run[count].row = r;
            run[count].first = (uint16_t)b;
            while (b < blocks && (row[b / 64] >> (b % 64) & 1))
                ++b;
            run[count++].end = (uint16_t)b;
        }
    }
    return count;
}

/* Four rows, `columns` of them; in and out point to the first element of the first row. */
static inline void gsdi_gauss_strip(const float *in, size_t stride, float *out, size_t out_stride, uint32_t columns,
                                    const float *w)
{
    float v[4][64 + 6];
    uint32_t at, i, c, n;
    for (at = 0; at < columns; at += n) {
        n = columns - at < 64 ? columns - at : 64;
        for (i = 0; i < 4; ++i) {
            const float *p = in + i * stride + at - 3;
            for (c = 0; c < n + 6; ++c)
                v[i][c] = w[0] * p[c] + w[1] * (p[c - stride] + p[c + stride]) +
                          w[2] * (p[c - 2 * stride] + p[c + 2 * stride]) +
                          w[3] * (p[c - 3 * stride] + p[c + 3 * stride]);
        }
        for (i = 0; i < 4; ++i) {
            const float *h = v[i];
            float *o = out + i * out_stride + at;
            for (c = 0; c < n; ++c)
                o[c] = w[0] * h[c + 3] + w[1] * (h[c + 2] + h[c + 4]) + w[2] * (h[c + 1] + h[c + 5]) +
                       w[3] * (h[c] + h[c + 6]);
        }
    }
}

/* The whole matrix; out without margins. */
static inline void gsdi_gauss_full_scalar(const float *in, size_t stride, float *out, uint32_t width, const float w[4])
{
    size_t r;
    for (r = 0; r < width; r += GSDI_GAUSS_ROWS)
        gsdi_gauss_strip(in + r * stride, stride, out + r * width, width, width, w);
}

/* Only the blocks of these runs, packed: 4 rows of 4, block after block in the order of the runs; out 64-byte aligned,
   GSDI_GAUSS_BLOCK floats a block. (Written to their places in a matrix instead, most of the time goes into memory:
   half a line, then somewhere else.) */
static inline void gsdi_gauss_packed_scalar(const float *in, size_t stride, float *out, const gsdi_gauss_run *run,
                                            size_t count, const float w[4])
{
    size_t i;
    uint32_t b;
    for (i = 0; i < count; ++i)
        for (b = run[i].first; b < run[i].end; ++b, out += GSDI_GAUSS_BLOCK)
            gsdi_gauss_strip(in + (size_t)run[i].row * GSDI_GAUSS_ROWS * stride + (size_t)b * GSDI_GAUSS_COLUMNS,
                             stride, out, GSDI_GAUSS_COLUMNS, GSDI_GAUSS_COLUMNS, w);
}

/* Fetch the four rows of a run that the block row before it has not needed. */
static inline void gsdi_gauss_prefetch(const float *in, size_t stride, const gsdi_gauss_run *run)
{
    const float *p =
        in + ((size_t)run->row * GSDI_GAUSS_ROWS + 3) * stride + (size_t)run->first * GSDI_GAUSS_COLUMNS - 4;
    size_t c, end = (size_t)(run->end - run->first) * GSDI_GAUSS_COLUMNS + 8;
    for (c = 0; c < end; c += 16) {
        GSDI_PREFETCH(p + c);
        GSDI_PREFETCH(p + stride + c);
        GSDI_PREFETCH(p + 2 * stride + c);
        GSDI_PREFETCH(p + 3 * stride + c);
    }
}

#if GSDI_X86
#define GSDI_GAUSS_AVX2 __attribute__((target("avx2,fma")))
#define GSDI_GAUSS_AVX2_INLINE __attribute__((target("avx2,fma"), always_inline)) static inline
#define GSDI_GAUSS_AVX512 __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma")))
#define GSDI_GAUSS_AVX512_INLINE                                                                                       \
    __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma"), always_inline)) static inline

GSDI_GAUSS_AVX2_INLINE __m256 gsdi_gauss_taps_avx2(const __m256 *w, __m256 a, __m256 b, __m256 c, __m256 d, __m256 e,
                                                   __m256 f, __m256 g)
{
    __m256 near = _mm256_fmadd_ps(w[1], _mm256_add_ps(c, e), _mm256_mul_ps(w[0], d));
    return _mm256_fmadd_ps(w[3], _mm256_add_ps(a, g), _mm256_fmadd_ps(w[2], _mm256_add_ps(b, f), near));
}

/* Vertical sums of four rows at eight columns from p on, p in the first row. */
GSDI_GAUSS_AVX2_INLINE void gsdi_gauss_columns_avx2(const float *p, size_t stride, const __m256 *w, __m256 v[4])
{
    __m256 r0 = _mm256_loadu_ps(p - 3 * stride), r1 = _mm256_loadu_ps(p - 2 * stride);
    __m256 r2 = _mm256_loadu_ps(p - stride), r3 = _mm256_loadu_ps(p), r4 = _mm256_loadu_ps(p + stride);
    __m256 r5 = _mm256_loadu_ps(p + 2 * stride), r6 = _mm256_loadu_ps(p + 3 * stride);
    __m256 r7 = _mm256_loadu_ps(p + 4 * stride), r8 = _mm256_loadu_ps(p + 5 * stride);
    __m256 r9 = _mm256_loadu_ps(p + 6 * stride);
    v[0] = gsdi_gauss_taps_avx2(w, r0, r1, r2, r3, r4, r5, r6);
    v[1] = gsdi_gauss_taps_avx2(w, r1, r2, r3, r4, r5, r6, r7);
    v[2] = gsdi_gauss_taps_avx2(w, r2, r3, r4, r5, r6, r7, r8);
    v[3] = gsdi_gauss_taps_avx2(w, r3, r4, r5, r6, r7, r8, r9);
}

#define GSDI_GAUSS_SHIFT_AVX2(high, low, n)                                                                            \
    _mm256_castsi256_ps(_mm256_alignr_epi8(_mm256_castps_si256(high), _mm256_castps_si256(low), 4 * (n)))

/* Eight columns from the vectors `v`, which starts at column -4, and `next`: -3 .. 10 are numbers 1 .. 14 of the two.
 */
GSDI_GAUSS_AVX2_INLINE __m256 gsdi_gauss_row_avx2(const __m256 *w, __m256 v, __m256 next)
{
    __m256 middle = _mm256_permute2f128_ps(v, next, 0x21);
    return gsdi_gauss_taps_avx2(w, GSDI_GAUSS_SHIFT_AVX2(middle, v, 1), GSDI_GAUSS_SHIFT_AVX2(middle, v, 2),
                                GSDI_GAUSS_SHIFT_AVX2(middle, v, 3), middle, GSDI_GAUSS_SHIFT_AVX2(next, middle, 1),
                                GSDI_GAUSS_SHIFT_AVX2(next, middle, 2), GSDI_GAUSS_SHIFT_AVX2(next, middle, 3));
}

/* Rows are written out one by one: a loop over them would put v into memory where the compiler does not unroll. */
GSDI_GAUSS_AVX2 static inline void gsdi_gauss_full_avx2(const float *in, size_t stride, float *out, uint32_t width,
                                                        const float w[4])
{
    __m256 weight[4], v[4], next[4];
    uint32_t r, c;
    for (r = 0; r < 4; ++r)
        weight[r] = _mm256_set1_ps(w[r]);
    for (r = 0; r < width; r += GSDI_GAUSS_ROWS) {
        const float *p = in + r * stride;
        float *o = out + (size_t)r * width;
        gsdi_gauss_columns_avx2(p - 4, stride, weight, v);
        for (c = 0; c < width; c += 8) {
            gsdi_gauss_columns_avx2(p + c + 4, stride, weight, next);
            _mm256_stream_ps(o + c, gsdi_gauss_row_avx2(weight, v[0], next[0]));
            _mm256_stream_ps(o + width + c, gsdi_gauss_row_avx2(weight, v[1], next[1]));
            _mm256_stream_ps(o + 2 * (size_t)width + c, gsdi_gauss_row_avx2(weight, v[2], next[2]));
            _mm256_stream_ps(o + 3 * (size_t)width + c, gsdi_gauss_row_avx2(weight, v[3], next[3]));
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
    }
    _mm_sfence();
}

/* Two blocks at a time. Stores go through the caches: whoever merges the layers reads them soon. */
GSDI_GAUSS_AVX2 static inline void gsdi_gauss_packed_avx2(const float *in, size_t stride, float *out,
                                                          const gsdi_gauss_run *run, size_t count, const float w[4])
{
    __m256 weight[4], v[4], next[4], r0, r1, r2, r3;
    size_t k;
    uint32_t n;
    for (k = 0; k < 4; ++k)
        weight[k] = _mm256_set1_ps(w[k]);
    for (k = 0; k < count; ++k) {
        const float *p = in + (size_t)run[k].row * GSDI_GAUSS_ROWS * stride + (size_t)run[k].first * GSDI_GAUSS_COLUMNS;
        if (k + GSDI_GAUSS_AHEAD < count)
            gsdi_gauss_prefetch(in, stride, &run[k + GSDI_GAUSS_AHEAD]);
        gsdi_gauss_columns_avx2(p - 4, stride, weight, v);
        for (n = (uint32_t)(run[k].end - run[k].first);; n -= 2, p += 8) {
            gsdi_gauss_columns_avx2(p + 4, stride, weight, next);
            r0 = gsdi_gauss_row_avx2(weight, v[0], next[0]);
            r1 = gsdi_gauss_row_avx2(weight, v[1], next[1]);
            r2 = gsdi_gauss_row_avx2(weight, v[2], next[2]);
            r3 = gsdi_gauss_row_avx2(weight, v[3], next[3]);
            _mm256_store_ps(out, _mm256_permute2f128_ps(r0, r1, 0x20));
            _mm256_store_ps(out + 8, _mm256_permute2f128_ps(r2, r3, 0x20));
            out += GSDI_GAUSS_BLOCK;
            if (n == 1)
                break;
            _mm256_store_ps(out, _mm256_permute2f128_ps(r0, r1, 0x31));
            _mm256_store_ps(out + 8, _mm256_permute2f128_ps(r2, r3, 0x31));
            out += GSDI_GAUSS_BLOCK;
            if (n == 2)
                break;
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
    }
}

GSDI_GAUSS_AVX512_INLINE __m512 gsdi_gauss_taps_avx512(const __m512 *w, __m512 a, __m512 b, __m512 c, __m512 d,
                                                       __m512 e, __m512 f, __m512 g)
{
    __m512 near = _mm512_fmadd_ps(w[1], _mm512_add_ps(c, e), _mm512_mul_ps(w[0], d));
    return _mm512_fmadd_ps(w[3], _mm512_add_ps(a, g), _mm512_fmadd_ps(w[2], _mm512_add_ps(b, f), near));
}

GSDI_GAUSS_AVX512_INLINE void gsdi_gauss_columns_avx512(const float *p, size_t stride, const __m512 *w, __m512 v[4])
{
    __m512 r0 = _mm512_loadu_ps(p - 3 * stride), r1 = _mm512_loadu_ps(p - 2 * stride);
    __m512 r2 = _mm512_loadu_ps(p - stride), r3 = _mm512_loadu_ps(p), r4 = _mm512_loadu_ps(p + stride);
    __m512 r5 = _mm512_loadu_ps(p + 2 * stride), r6 = _mm512_loadu_ps(p + 3 * stride);
    __m512 r7 = _mm512_loadu_ps(p + 4 * stride), r8 = _mm512_loadu_ps(p + 5 * stride);
    __m512 r9 = _mm512_loadu_ps(p + 6 * stride);
    v[0] = gsdi_gauss_taps_avx512(w, r0, r1, r2, r3, r4, r5, r6);
    v[1] = gsdi_gauss_taps_avx512(w, r1, r2, r3, r4, r5, r6, r7);
    v[2] = gsdi_gauss_taps_avx512(w, r2, r3, r4, r5, r6, r7, r8);
    v[3] = gsdi_gauss_taps_avx512(w, r3, r4, r5, r6, r7, r8, r9);
}

/* The forms with a mask that is always set are the same instructions; g++ 12 warns of the others in C++. */
#define GSDI_GAUSS_SHIFT_AVX512(high, low, n)                                                                          \
    _mm512_castsi512_ps(_mm512_maskz_alignr_epi32(0xffff, _mm512_castps_si512(high), _mm512_castps_si512(low), (n)))
#define GSDI_GAUSS_BLOCKS_AVX512(a, b, n) _mm512_maskz_shuffle_f32x4(0xffff, (a), (b), (n))

/* Sixteen columns from the vectors `low`, which starts at column -16, `v` and `high`; past the caches. */
GSDI_GAUSS_AVX512_INLINE void gsdi_gauss_row_avx512(const __m512 *w, __m512 low, __m512 v, __m512 high, float *out)
{
    _mm512_stream_ps(out,
                     gsdi_gauss_taps_avx512(w, GSDI_GAUSS_SHIFT_AVX512(v, low, 13), GSDI_GAUSS_SHIFT_AVX512(v, low, 14),
                                            GSDI_GAUSS_SHIFT_AVX512(v, low, 15), v, GSDI_GAUSS_SHIFT_AVX512(high, v, 1),
                                            GSDI_GAUSS_SHIFT_AVX512(high, v, 2), GSDI_GAUSS_SHIFT_AVX512(high, v, 3)));
}

/* Whole rows: three aligned vectors of vertical sums at a time. */
GSDI_GAUSS_AVX512 static inline void gsdi_gauss_full_avx512(const float *in, size_t stride, float *out, uint32_t width,
                                                            const float w[4])
{
    __m512 weight[4];
    uint32_t r, c;
    for (r = 0; r < 4; ++r)
        weight[r] = _mm512_set1_ps(w[r]);
    for (r = 0; r < width; r += GSDI_GAUSS_ROWS) {
        const float *p = in + r * stride;
        float *o = out + (size_t)r * width;
        __m512 low[4], v[4], high[4];
        gsdi_gauss_columns_avx512(p - 16, stride, weight, low);
        gsdi_gauss_columns_avx512(p, stride, weight, v);
        for (c = 0; c < width; c += 16) {
            gsdi_gauss_columns_avx512(p + c + 16, stride, weight, high);
            gsdi_gauss_row_avx512(weight, low[0], v[0], high[0], o + c);
            gsdi_gauss_row_avx512(weight, low[1], v[1], high[1], o + width + c);
            gsdi_gauss_row_avx512(weight, low[2], v[2], high[2], o + 2 * (size_t)width + c);
            gsdi_gauss_row_avx512(weight, low[3], v[3], high[3], o + 3 * (size_t)width + c);
            low[0] = v[0];
            low[1] = v[1];
            low[2] = v[2];
            low[3] = v[3];
            v[0] = high[0];
            v[1] = high[1];
            v[2] = high[2];
            v[3] = high[3];
        }
    }
    _mm_sfence();
}

/* Sixteen columns from the vectors `v`, which starts at column -4, and `next`. */
GSDI_GAUSS_AVX512_INLINE __m512 gsdi_gauss_shifted_avx512(const __m512 *w, __m512 v, __m512 next)
{
    return gsdi_gauss_taps_avx512(w, GSDI_GAUSS_SHIFT_AVX512(next, v, 1), GSDI_GAUSS_SHIFT_AVX512(next, v, 2),
                                  GSDI_GAUSS_SHIFT_AVX512(next, v, 3), GSDI_GAUSS_SHIFT_AVX512(next, v, 4),
                                  GSDI_GAUSS_SHIFT_AVX512(next, v, 5), GSDI_GAUSS_SHIFT_AVX512(next, v, 6),
                                  GSDI_GAUSS_SHIFT_AVX512(next, v, 7));
}

/* Four blocks at a time; the last one or two need columns -3 .. 10 at most, which are in v: the usual run, along the
   border of two leaves, takes one vector of columns only. */
GSDI_GAUSS_AVX512 static inline void gsdi_gauss_packed_avx512(const float *in, size_t stride, float *out,
                                                              const gsdi_gauss_run *run, size_t count, const float w[4])
{
    __m512 weight[4], v[4], next[4], r0, r1, r2, r3, low01, low23, high01, high23;
    size_t k;
    uint32_t n;
    for (k = 0; k < 4; ++k)
        weight[k] = _mm512_set1_ps(w[k]);
    for (k = 0; k < count; ++k) {
        const float *p = in + (size_t)run[k].row * GSDI_GAUSS_ROWS * stride + (size_t)run[k].first * GSDI_GAUSS_COLUMNS;
        if (k + GSDI_GAUSS_AHEAD < count)
            gsdi_gauss_prefetch(in, stride, &run[k + GSDI_GAUSS_AHEAD]);
        gsdi_gauss_columns_avx512(p - 4, stride, weight, v);
        for (n = (uint32_t)(run[k].end - run[k].first); n > 2; n = n > 4 ? n - 4 : 0, p += 16) {
            gsdi_gauss_columns_avx512(p + 12, stride, weight, next);
            r0 = gsdi_gauss_shifted_avx512(weight, v[0], next[0]);
            r1 = gsdi_gauss_shifted_avx512(weight, v[1], next[1]);
            r2 = gsdi_gauss_shifted_avx512(weight, v[2], next[2]);
            r3 = gsdi_gauss_shifted_avx512(weight, v[3], next[3]);
            low01 = GSDI_GAUSS_BLOCKS_AVX512(r0, r1, 0x44);
            low23 = GSDI_GAUSS_BLOCKS_AVX512(r2, r3, 0x44);
            high01 = GSDI_GAUSS_BLOCKS_AVX512(r0, r1, 0xee);
            high23 = GSDI_GAUSS_BLOCKS_AVX512(r2, r3, 0xee);
            _mm512_store_ps(out, GSDI_GAUSS_BLOCKS_AVX512(low01, low23, 0x88));
            _mm512_store_ps(out + GSDI_GAUSS_BLOCK, GSDI_GAUSS_BLOCKS_AVX512(low01, low23, 0xdd));
            _mm512_store_ps(out + 2 * GSDI_GAUSS_BLOCK, GSDI_GAUSS_BLOCKS_AVX512(high01, high23, 0x88));
            if (n > 3)
                _mm512_store_ps(out + 3 * GSDI_GAUSS_BLOCK, GSDI_GAUSS_BLOCKS_AVX512(high01, high23, 0xdd));
            out += (n > 3 ? 4 : 3) * GSDI_GAUSS_BLOCK;
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
        if (!n)
            continue;
        r0 = gsdi_gauss_shifted_avx512(weight, v[0], v[0]);
        r1 = gsdi_gauss_shifted_avx512(weight, v[1], v[1]);
        r2 = gsdi_gauss_shifted_avx512(weight, v[2], v[2]);
        r3 = gsdi_gauss_shifted_avx512(weight, v[3], v[3]);
        low01 = GSDI_GAUSS_BLOCKS_AVX512(r0, r1, 0x44);
        low23 = GSDI_GAUSS_BLOCKS_AVX512(r2, r3, 0x44);
        _mm512_store_ps(out, GSDI_GAUSS_BLOCKS_AVX512(low01, low23, 0x88));
        if (n > 1)
            _mm512_store_ps(out + GSDI_GAUSS_BLOCK, GSDI_GAUSS_BLOCKS_AVX512(low01, low23, 0xdd));
        out += n * GSDI_GAUSS_BLOCK;
    }
}
#endif

#if GSDI_NEON
static inline float32x4_t gsdi_gauss_taps_neon(const float32x4_t *w, const float32x4_t *r)
{
    float32x4_t near = vfmaq_f32(vmulq_f32(w[0], r[3]), w[1], vaddq_f32(r[2], r[4]));
    return vfmaq_f32(vfmaq_f32(near, w[2], vaddq_f32(r[1], r[5])), w[3], vaddq_f32(r[0], r[6]));
}

/* Vertical sums of four rows at four columns from p on, p in the first row. */
static inline void gsdi_gauss_columns_neon(const float *p, size_t stride, const float32x4_t *w, float32x4_t v[4])
{
    float32x4_t r[10];
    uint32_t i;
    p -= 3 * stride;
    for (i = 0; i < 10; ++i)
        r[i] = vld1q_f32(p + i * stride);
    for (i = 0; i < 4; ++i)
        v[i] = gsdi_gauss_taps_neon(w, r + i);
}

/* Four columns from the vectors before, at and after them. */
static inline float32x4_t gsdi_gauss_row_neon(const float32x4_t *w, float32x4_t low, float32x4_t v, float32x4_t high)
{
    float32x4_t r[7];
    r[0] = vextq_f32(low, v, 1);
    r[1] = vextq_f32(low, v, 2);
    r[2] = vextq_f32(low, v, 3);
    r[3] = v;
    r[4] = vextq_f32(v, high, 1);
    r[5] = vextq_f32(v, high, 2);
    r[6] = vextq_f32(v, high, 3);
    return gsdi_gauss_taps_neon(w, r);
}

/* A strip of four rows, `blocks` blocks long, each written `step` floats after the one before. */
static inline void gsdi_gauss_strip_neon(const float *p, size_t stride, float *out, size_t out_stride, size_t step,
                                         uint32_t blocks, const float32x4_t *w)
{
    float32x4_t low[4], v[4], high[4];
    uint32_t i;
    gsdi_gauss_columns_neon(p - 4, stride, w, low);
    gsdi_gauss_columns_neon(p, stride, w, v);
    for (; blocks; --blocks, out += step) {
        p += 4;
        gsdi_gauss_columns_neon(p, stride, w, high);
        for (i = 0; i < 4; ++i) {
            vst1q_f32(out + i * out_stride, gsdi_gauss_row_neon(w, low[i], v[i], high[i]));
            low[i] = v[i];
            v[i] = high[i];
        }
    }
}

static inline void gsdi_gauss_full_neon(const float *in, size_t stride, float *out, uint32_t width, const float w[4])
{
    float32x4_t weight[4];
    size_t r;
    for (r = 0; r < 4; ++r)
        weight[r] = vdupq_n_f32(w[r]);
    for (r = 0; r < width; r += GSDI_GAUSS_ROWS)
        gsdi_gauss_strip_neon(in + r * stride, stride, out + r * width, width, GSDI_GAUSS_COLUMNS,
                              width / GSDI_GAUSS_COLUMNS, weight);
}

static inline void gsdi_gauss_packed_neon(const float *in, size_t stride, float *out, const gsdi_gauss_run *run,
                                          size_t count, const float w[4])
{
    float32x4_t weight[4];
    size_t k;
    for (k = 0; k < 4; ++k)
        weight[k] = vdupq_n_f32(w[k]);
    for (k = 0; k < count; ++k) {
        uint32_t blocks = (uint32_t)(run[k].end - run[k].first);
        const float *p = in + (size_t)run[k].row * GSDI_GAUSS_ROWS * stride + (size_t)run[k].first * GSDI_GAUSS_COLUMNS;
        if (k + GSDI_GAUSS_AHEAD < count)
            gsdi_gauss_prefetch(in, stride, &run[k + GSDI_GAUSS_AHEAD]);
        gsdi_gauss_strip_neon(p, stride, out, GSDI_GAUSS_COLUMNS, GSDI_GAUSS_BLOCK, blocks, weight);
        out += (size_t)blocks * GSDI_GAUSS_BLOCK;
    }
}
#endif

/* The whole of a layer at a SIMD level. */
static void gsdi_gauss_full(gsd_simd simd, const float *in, float *out, uint32_t width, const float w[4])
{
    size_t stride = gsdi_gauss_stride(width);
#if GSDI_X86
    if (simd == GSD_SIMD_AVX512)
        gsdi_gauss_full_avx512(in, stride, out, width, w);
    else if (simd == GSD_SIMD_AVX2)
        gsdi_gauss_full_avx2(in, stride, out, width, w);
    else
#elif GSDI_NEON
    if (simd == GSD_SIMD_NEON)
        gsdi_gauss_full_neon(in, stride, out, width, w);
    else
#endif
        gsdi_gauss_full_scalar(in, stride, out, width, w);
    (void)simd;
}

/* Runs of blocks of a layer, packed, at a SIMD level. */
static void gsdi_gauss_packed(gsd_simd simd, const float *in, float *out, uint32_t width, const gsdi_gauss_run *run,
                              size_t count, const float w[4])
{
    size_t stride = gsdi_gauss_stride(width);
#if GSDI_X86
    if (simd == GSD_SIMD_AVX512)
        gsdi_gauss_packed_avx512(in, stride, out, run, count, w);
    else if (simd == GSD_SIMD_AVX2)
        gsdi_gauss_packed_avx2(in, stride, out, run, count, w);
    else
#elif GSDI_NEON
    if (simd == GSD_SIMD_NEON)
        gsdi_gauss_packed_neon(in, stride, out, run, count, w);
    else
#endif
        gsdi_gauss_packed_scalar(in, stride, out, run, count, w);
    (void)simd;
}

/* What one tree is blurred in, for trees down to some depth. While layer d is at hand, matrix[(depth - d) & 1] holds it
   and the other one the layers above, merged. */
typedef struct gsdi_gauss_slot {
    void *memory;
    float *matrix[2]; /* element (0, 0); 2^depth and 2^(depth - 1) wide, with margins */
    float *packed;    /* [4^depth] blurred blocks or, where most are, rows; at last the sums over the merged matrix */
    uint64_t *map;
    gsdi_gauss_run *run;
    uint32_t cell;
    uint32_t depth; /* of that cell's tree */
    uint32_t nodes; /* of its new tree; 0 = leave it alone */
} gsdi_gauss_slot;

/* Bytes of the five parts of a slot, each a multiple of a cache line. */
static uint64_t gsdi_gauss_parts(uint32_t depth, uint64_t bytes[5])
{
    uint32_t width = 1u << depth, k;
    uint64_t sum = 64;
    bytes[0] = gsdi_gauss_floats(width) * sizeof(float);
    bytes[1] = gsdi_gauss_floats(width / 2) * sizeof(float);
    bytes[2] = (uint64_t)width * width * sizeof(float);
    bytes[3] = gsdi_gauss_map_words(width) * sizeof(uint64_t);
    bytes[4] = (uint64_t)width / GSDI_GAUSS_ROWS * (width / 8) * sizeof(gsdi_gauss_run);
    for (k = 0; k < 5; ++k)
        sum += bytes[k] = (bytes[k] + 63) & ~(uint64_t)63;
    return sum;
}

/* Cut a slot's memory into its parts. */
static void gsdi_gauss_slot_cut(gsdi_gauss_slot *slot, uint32_t depth)
{
    uint64_t bytes[5];
    char *at = (char *)slot->memory + ((64 - ((uintptr_t)slot->memory & 63)) & 63);
    gsdi_gauss_parts(depth, bytes);
    slot->matrix[0] = (float *)(void *)at + gsdi_gauss_origin(1u << depth);
    slot->matrix[1] = (float *)(void *)(at += bytes[0]) + gsdi_gauss_origin(1u << (depth - 1));
    slot->packed = (float *)(void *)(at += bytes[1]);
    slot->map = (uint64_t *)(void *)(at += bytes[2]);
    slot->run = (gsdi_gauss_run *)(void *)(at + bytes[3]);
}

/* Elements in all layers of a tree of this depth: the work of denoising it. */
static double gsdi_gauss_work(uint32_t depth)
{
    double work = 0;
    uint32_t layer;
    for (layer = GSDI_GAUSS_FIRST; layer <= depth; ++layer)
        work += ldexp(1, 2 * (int)layer);
    return work;
}

/* Halvings from every node to the deepest leaf below it. */
static void gsdi_gauss_heights(const uint32_t *child, uint32_t count, unsigned char *height)
{
    uint32_t i, k;
    for (i = count; i-- > 0;) {
        uint32_t c = child[i], most = 0;
        for (k = 0; c && k < 4; ++k)
            most = height[c + k] > most ? height[c + k] : most;
        height[i] = (unsigned char)(c ? 1 + most : 0);
    }
}

/* A layer as a matrix of shares of the tree's mass: leaves above it are split by area, a subtree below an element
   counts with its sum times 4^-(its depth). Shares below 1e-30 count as 0: sums of them could only be denormal. */
static void gsdi_gauss_flatten(const uint32_t *child, const double *mass, const unsigned char *height, uint32_t layer,
                               float *m, size_t stride)
{
    gsdi_square stack[GSDI_STACK];
    uint32_t top = 1, k, r, i;
    double scale = 1 / mass[0];
    memset(&stack[0], 0, sizeof stack[0]);
    stack[0].size = 1u << layer;
    while (top) {
        gsdi_square b = stack[--top];
        uint32_t c = child[b.node], half = b.size / 2;
        double parts = c ? (double)((uint64_t)1 << (2 * height[b.node])) : (double)b.size * (double)b.size;
        float value = (float)(mass[b.node] * scale / parts);
        for (k = 4; c && half && k-- > 0;) {
            gsdi_square *s = &stack[top++];
            s->node = c + k;
            s->x = b.x + (k & 1) * half;
            s->y = b.y + (k >> 1) * half;
            s->size = half;
        }
        if (c && half)
            continue;
        value = value >= 1e-30f ? value : 0; /* NaN too, where a loaded tree's mass is infinite */
        for (r = b.y; r < b.y + b.size; ++r)
            for (i = b.x; i < b.x + b.size; ++i)
                m[r * stride + i] = value;
    }
}

/* Put packed blocks to their places. */
static void gsdi_gauss_unpack(const float *packed, const gsdi_gauss_run *run, size_t count, float *m, size_t stride)
{
    size_t i, r;
    uint32_t b;
    for (i = 0; i < count; ++i)
        for (b = run[i].first; b < run[i].end; ++b, packed += GSDI_GAUSS_BLOCK)
            for (r = 0; r < GSDI_GAUSS_ROWS; ++r)
                memcpy(m + (run[i].row * GSDI_GAUSS_ROWS + r) * stride + (size_t)b * GSDI_GAUSS_COLUMNS,
                       packed + r * GSDI_GAUSS_COLUMNS, GSDI_GAUSS_COLUMNS * sizeof(float));
}

/* The larger of a layer and what the layers above it say, expanded: a quarter for each of four elements. above: NULL =
   this is the first one. from may be to. */
static void gsdi_gauss_merge(const float *from, size_t from_stride, const float *above, float *to, uint32_t width)
{
    size_t stride = gsdi_gauss_stride(width), above_stride = gsdi_gauss_stride(width / 2);
    uint32_t r, c;
    for (r = 0; r < width; ++r) {
        const float *f = from + r * from_stride, *a = above ? above + r / 2 * above_stride : f;
        float *t = to + r * stride;
        for (c = 0; above && c < width / 2; ++c) {
            float x = f[2 * c], y = f[2 * c + 1], z = 0.25f * a[c];
            t[2 * c] = x > z ? x : z;
            t[2 * c + 1] = y > z ? y : z;
        }
        if (!above && f != t)
            memcpy(t, f, width * sizeof *t);
    }
}

/* Flatten, blur and merge one layer. */
static void gsdi_gauss_layer(gsdi_gauss_slot *slot, const uint32_t *child, const double *mass,
                             const unsigned char *height, uint32_t layer, gsd_simd simd, bool sphere, const float w[4])
{
    uint32_t width = 1u << layer, parity = (slot->depth - layer) & 1;
    float *m = slot->matrix[parity];
    size_t stride = gsdi_gauss_stride(width), runs, blocks = 0, i;
    bool whole;
    gsdi_gauss_flatten(child, mass, height, layer, m, stride);
    gsdi_gauss_pad(m, stride, width, sphere);
    gsdi_gauss_map(child, layer, slot->map);
    runs = gsdi_gauss_runs(slot->map, width, slot->run);
    for (i = 0; i < runs; ++i)
        blocks += (size_t)(slot->run[i].end - slot->run[i].first);
    whole = blocks * GSDI_GAUSS_BLOCK * 4 > (size_t)width * width * 3;
    if (whole) {
        gsdi_gauss_full(simd, m, slot->packed, width, w);
    } else {
        gsdi_gauss_packed(simd, m, slot->packed, width, slot->run, runs, w);
        gsdi_gauss_unpack(slot->packed, slot->run, runs, m, stride);
    }
    gsdi_gauss_merge(whole ? slot->packed : m, whole ? width : stride,
                     layer > GSDI_GAUSS_FIRST ? slot->matrix[1 - parity] : NULL, m, width);
}

/* Sums of the merged matrix over the squares of all layers above: layer d from (4^d - 1) / 3 on, 2^d wide. */
static void gsdi_gauss_sums(gsdi_gauss_slot *slot)
{
    const float *from = slot->matrix[0];
    size_t stride = gsdi_gauss_stride(1u << slot->depth), x, y;
    uint32_t d;
    for (d = slot->depth; d-- > 0;) {
        size_t width = (size_t)1 << d;
        float *to = slot->packed + (((size_t)1 << (2 * d)) - 1) / 3;
        for (y = 0; y < width; ++y)
            for (x = 0; x < width; ++x) {
                const float *a = from + 2 * y * stride + 2 * x, *b = a + stride;
                to[y * width + x] = (a[0] + a[1]) + (b[0] + b[1]);
            }
        from = to;
        stride = width;
    }
}

/* All layers of one tree: the merged matrix and its sums. */
static void gsdi_gauss_blur(gsdi_gauss_slot *slot, const uint32_t *child, const double *mass,
                            const unsigned char *height, gsd_simd simd, bool sphere, const float w[4])
{
    uint32_t layer;
    for (layer = GSDI_GAUSS_FIRST; layer <= slot->depth; ++layer)
        gsdi_gauss_layer(slot, child, mass, height, layer, simd, sphere, w);
    gsdi_gauss_sums(slot);
}

/* The tree of a merged matrix: the root is divided, others where they hold more than rho of the sum, down to the
   matrix's elements; below, light is even. old, sum: the tree that was blurred; its sums go to the new one by area.
   child NULL: count only; else mass is the matrix's. Returns the number of nodes, 0 = the matrix is empty. */
static uint32_t gsdi_gauss_rebuild(const gsdi_gauss_slot *slot, double rho, const uint32_t *old,
                                   const gsdi_sum *old_sum, uint32_t *child, gsdi_sum *sum, double *mass)
{
    gsdi_visit stack[GSDI_STACK];
    double limit = rho * (double)slot->packed[0];
    uint32_t total = 1, k;
    int top = 0;
    memset(&stack[0], 0, sizeof stack[0]);
    stack[0].sum = old_sum[0];
    while (limit > 0 && top >= 0) {
        gsdi_visit v = stack[top--];
        size_t width = (size_t)1 << v.depth;
        const float *m = v.depth < slot->depth ? slot->packed + (((size_t)1 << (2 * v.depth)) - 1) / 3 + v.y * width
                                               : slot->matrix[0] + v.y * gsdi_gauss_stride(1u << v.depth);
        bool divide = v.depth == 0 || (v.depth < slot->depth && (double)m[v.x] > limit);
        if (child) {
            child[v.out] = divide ? total : 0;
            sum[v.out] = v.sum;
            mass[v.out] = (double)m[v.x];
        }
        for (k = 4; divide && k-- > 0;) {
            gsdi_visit *next = &stack[++top];
            gsdi_visit_child(&v, old, old_sum, k, total + k, next);
            next->x = 2 * v.x + (k & 1);
            next->y = 2 * v.y + (k >> 1);
        }
        total += divide ? 4 : 0;
    }
    return limit > 0 ? total : 0;
}

/* Scale masses so that the root has `total`; inner nodes become the sums of their children. */
static void gsdi_gauss_normalise(const uint32_t *child, double *mass, uint32_t count, double total)
{
    double sum = 0;
    uint32_t i;
    for (i = 0; i < count; ++i)
        sum += child[i] ? 0 : mass[i];
    for (i = count; i-- > 0;) {
        const double *c = mass + child[i];
        mass[i] = child[i] ? (c[0] + c[1]) + (c[2] + c[3]) : mass[i] * (total / sum);
    }
}

/* ---- >>lanes ------------------------------------------------------------------------------------------------ */

/* Eight at a time what the inline queries do one by one, in the same operations and thus the same bits: sums, products,
   quotients and roots are rounded alike everywhere, and nothing is contracted here. */
#if GSDI_X86
#define GSDI_AVX2 __attribute__((target("avx2")))
#define GSDI_AVX2_INLINE __attribute__((always_inline)) GSDI_AVX2 static inline

/* Eight rows of four floats in columns. */
GSDI_AVX2_INLINE void gsdi_columns_avx2(const void *const at[8], __m256 column[4])
{
    __m256 row[4], t[4];
    uint32_t i;
    for (i = 0; i < 4; ++i)
        row[i] = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps((const float *)at[i])),
                                      _mm_loadu_ps((const float *)at[i + 4]), 1);
    t[0] = _mm256_unpacklo_ps(row[0], row[1]);
    t[1] = _mm256_unpackhi_ps(row[0], row[1]);
    t[2] = _mm256_unpacklo_ps(row[2], row[3]);
    t[3] = _mm256_unpackhi_ps(row[2], row[3]);
    column[0] = _mm256_shuffle_ps(t[0], t[2], 0x44);
    column[1] = _mm256_shuffle_ps(t[0], t[2], 0xee);
    column[2] = _mm256_shuffle_ps(t[1], t[3], 0x44);
    column[3] = _mm256_shuffle_ps(t[1], t[3], 0xee);
}

GSDI_AVX2_INLINE __m256 gsdi_dot_avx2(const __m256 a[3], const __m256 b[3])
{
    __m256 xy = _mm256_add_ps(_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1]));
    return _mm256_add_ps(xy, _mm256_mul_ps(a[2], b[2]));
}

GSDI_AVX2_INLINE __m256 gsdi_absolute_avx2(__m256 x) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), x); }

/* The end of gsd_direction: z, and phi as q quarter turns and f turns. */
GSDI_AVX2_INLINE void gsdi_direction_avx2(__m256 f, __m256i q, __m256 z, __m256 out[3])
{
    __m256 g = _mm256_mul_ps(f, f), one = _mm256_set1_ps(1), s, c, r, odd, a;
    s = _mm256_add_ps(_mm256_set1_ps(81.5880703f), _mm256_mul_ps(g, _mm256_set1_ps(-75.2377448f)));
    s = _mm256_add_ps(_mm256_set1_ps(-41.3416277f), _mm256_mul_ps(g, s));
    s = _mm256_mul_ps(f, _mm256_add_ps(_mm256_set1_ps(6.28318522f), _mm256_mul_ps(g, s)));
    c = _mm256_add_ps(_mm256_set1_ps(-85.4436999f), _mm256_mul_ps(g, _mm256_set1_ps(59.2443711f)));
    c = _mm256_add_ps(_mm256_set1_ps(64.9393261f), _mm256_mul_ps(g, c));
    c = _mm256_add_ps(_mm256_set1_ps(-19.7392087f), _mm256_mul_ps(g, c));
    c = _mm256_add_ps(one, _mm256_mul_ps(g, c));
    z = _mm256_min_ps(_mm256_max_ps(z, _mm256_set1_ps(-1)), one);
    r = _mm256_sqrt_ps(_mm256_mul_ps(_mm256_sub_ps(one, z), _mm256_add_ps(one, z)));
    odd = _mm256_castsi256_ps(_mm256_slli_epi32(q, 31));
    a = _mm256_blendv_ps(c, _mm256_xor_ps(s, _mm256_set1_ps(-0.0f)), odd);
    s = _mm256_blendv_ps(s, c, odd);
    r = _mm256_xor_ps(r, _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_srli_epi32(q, 1), 31)));
    out[0] = _mm256_mul_ps(r, a);
    out[1] = _mm256_mul_ps(r, s);
    out[2] = z;
}

/* gsd_direction in the middle of 24-bit coordinates. What that has in double is exact in float: 2 x + 1 - 2^23 q has
   23 bits, 2 y + 1 - 2^24 is odd and has 24. */
GSDI_AVX2_INLINE void gsdi_middle_avx2(__m256i x, __m256i y, __m256 out[3])
{
    __m256i q = _mm256_srli_epi32(_mm256_add_epi32(x, _mm256_set1_epi32(2097152)), 22), one = _mm256_set1_epi32(1);
    __m256i f = _mm256_sub_epi32(_mm256_add_epi32(_mm256_add_epi32(x, x), one), _mm256_slli_epi32(q, 23));
    __m256i z = _mm256_sub_epi32(_mm256_add_epi32(y, y), _mm256_set1_epi32(16777215));
    gsdi_direction_avx2(_mm256_mul_ps(_mm256_cvtepi32_ps(f), _mm256_set1_ps(2.98023223876953125e-8f)), q,
                        _mm256_mul_ps(_mm256_cvtepi32_ps(z), _mm256_set1_ps(5.9604644775390625e-8f)), out);
}

/* gsd_coordinates. */
GSDI_AVX2_INLINE void gsdi_coordinates_avx2(const __m256 d[3], __m256i *x, __m256i *y)
{
    __m256 ax = gsdi_absolute_avx2(d[0]), ay = gsdi_absolute_avx2(d[1]), zero = _mm256_setzero_ps(), t, s, q, p, z;
    __m256 big = _mm256_max_ps(ax, ay);
    __m256i i, swap = _mm256_castps_si256(_mm256_cmp_ps(ay, ax, _CMP_GT_OQ));
    __m256i left = _mm256_castps_si256(_mm256_cmp_ps(d[0], zero, _CMP_LT_OQ));
    __m256i below = _mm256_castps_si256(_mm256_cmp_ps(d[1], zero, _CMP_LT_OQ));
    t = _mm256_and_ps(_mm256_div_ps(_mm256_min_ps(ay, ax), big), _mm256_cmp_ps(big, zero, _CMP_GT_OQ));
    s = _mm256_mul_ps(t, t);
    q = _mm256_mul_ps(s, s);
    p = _mm256_sub_ps(_mm256_set1_ps(0.003479549227f), _mm256_mul_ps(_mm256_set1_ps(0.0006452896099f), s));
    p = _mm256_mul_ps(q, p);
    p = _mm256_add_ps(_mm256_sub_ps(_mm256_set1_ps(0.01534600094f), _mm256_mul_ps(_mm256_set1_ps(0.008898663359f), s)),
                      p);
    z = _mm256_sub_ps(_mm256_set1_ps(0.03174594614f), _mm256_mul_ps(_mm256_set1_ps(0.02213626529f), s));
    p = _mm256_mul_ps(q, _mm256_add_ps(z, _mm256_mul_ps(q, p)));
    z = _mm256_sub_ps(_mm256_set1_ps(0.1591548374f), _mm256_mul_ps(_mm256_set1_ps(0.05304612139f), s));
    p = _mm256_max_ps(_mm256_mul_ps(_mm256_add_ps(z, p), t), zero);
    i = _mm256_cvttps_epi32(_mm256_mul_ps(_mm256_min_ps(p, _mm256_set1_ps(0.125f)), _mm256_set1_ps(67108864.0f)));
    i = _mm256_sub_epi32(_mm256_xor_si256(i, swap), swap);
    i = _mm256_add_epi32(i, _mm256_and_si256(swap, _mm256_set1_epi32(16777216)));
    i = _mm256_sub_epi32(_mm256_xor_si256(i, left), left);
    i = _mm256_add_epi32(i, _mm256_and_si256(left, _mm256_set1_epi32(33554432)));
    i = _mm256_add_epi32(_mm256_xor_si256(i, below), _mm256_and_si256(below, _mm256_set1_epi32(67108864)));
    *x = _mm256_and_si256(_mm256_srli_epi32(i, 2), _mm256_set1_epi32(0xffffff));
    z = _mm256_min_ps(_mm256_max_ps(d[2], _mm256_set1_ps(-1)), _mm256_set1_ps(1));
    i = _mm256_cvttps_epi32(_mm256_mul_ps(_mm256_add_ps(z, _mm256_set1_ps(1)), _mm256_set1_ps(8388608.0f)));
    *y = _mm256_min_epi32(i, _mm256_set1_epi32(16777215));
}

/* gsd_offset; pivot: with nearness. */
GSDI_AVX2_INLINE void gsdi_offset_avx2(const __m256 pivot[4], const __m256 position[3], __m256 offset[3])
{
    __m256 l, f, near, most = _mm256_set1_ps(GSD_MOST_OFFSET), one = _mm256_set1_ps(1);
    uint32_t k;
    for (k = 0; k < 3; ++k)
        offset[k] = _mm256_mul_ps(_mm256_sub_ps(position[k], pivot[k]), pivot[3]);
    l = gsdi_dot_avx2(offset, offset);
    near = _mm256_cmp_ps(l, _mm256_set1_ps(GSD_MOST_OFFSET * GSD_MOST_OFFSET), _CMP_LE_OQ);
    if (_mm256_movemask_ps(near) == 255)
        return;
    f = _mm256_div_ps(most, _mm256_sqrt_ps(l));
    l = _mm256_cmp_ps(l, _mm256_set1_ps(1e30f), _CMP_LT_OQ);
    f = _mm256_blendv_ps(_mm256_and_ps(f, l), one, near);
    for (k = 0; k < 3; ++k)
        offset[k] = _mm256_mul_ps(_mm256_and_ps(offset[k], l), f);
}

/* Which offsets are not zero. */
GSDI_AVX2_INLINE __m256 gsdi_apart_avx2(const __m256 o[3])
{
    return _mm256_cmp_ps(_mm256_or_ps(_mm256_or_ps(o[0], o[1]), o[2]), _mm256_setzero_ps(), _CMP_NEQ_UQ);
}

/* gsd_to_pivot. */
GSDI_AVX2_INLINE __m256 gsdi_to_pivot_avx2(const __m256 o[3], const __m256 w[3], __m256 out[3])
{
    __m256 one = _mm256_set1_ps(1), b = gsdi_dot_avx2(o, w), s, t;
    uint32_t k;
    s = _mm256_sqrt_ps(_mm256_add_ps(_mm256_sub_ps(one, gsdi_dot_avx2(o, o)), _mm256_mul_ps(b, b)));
    t = _mm256_sub_ps(s, b);
    for (k = 0; k < 3; ++k)
        out[k] = _mm256_add_ps(o[k], _mm256_mul_ps(t, w[k]));
    t = _mm256_div_ps(_mm256_mul_ps(t, t), s);
    return _mm256_blendv_ps(one, t, _mm256_cmp_ps(t, _mm256_set1_ps(8), _CMP_LT_OQ));
}

/* gsd_unpack_normal of what has one. */
GSDI_AVX2_INLINE void gsdi_normal_avx2(__m256i x, __m256i y, __m256 n[3])
{
    __m256 middle = _mm256_set1_ps(128), unit = _mm256_set1_ps(127), sign = _mm256_set1_ps(-0.0f), t;
    n[0] = _mm256_div_ps(_mm256_sub_ps(_mm256_cvtepi32_ps(_mm256_srli_epi32(x, 24)), middle), unit);
    n[1] = _mm256_div_ps(_mm256_sub_ps(_mm256_cvtepi32_ps(_mm256_srli_epi32(y, 24)), middle), unit);
    n[2] = _mm256_sub_ps(_mm256_set1_ps(1), gsdi_absolute_avx2(n[0]));
    n[2] = _mm256_sub_ps(n[2], gsdi_absolute_avx2(n[1]));
    t = _mm256_min_ps(n[2], _mm256_setzero_ps());
    n[0] = _mm256_add_ps(n[0], _mm256_xor_ps(t, _mm256_and_ps(n[0], sign)));
    n[1] = _mm256_add_ps(n[1], _mm256_xor_ps(t, _mm256_and_ps(n[1], sign)));
    t = _mm256_div_ps(_mm256_set1_ps(1), _mm256_sqrt_ps(gsdi_dot_avx2(n, n)));
    n[0] = _mm256_mul_ps(n[0], t);
    n[1] = _mm256_mul_ps(n[1], t);
    n[2] = _mm256_mul_ps(n[2], t);
}

/* gsd_bin_cosine from b, the means of the bins' directions. */
GSDI_AVX2_INLINE __m256 gsdi_cosine_avx2(const __m256 normal[3], const __m256 b[3], __m256 lift)
{
    __m256 h = _mm256_set1_ps(GSD_HORIZON), zero = _mm256_setzero_ps(), r, above;
    __m256 t = _mm256_sub_ps(gsdi_dot_avx2(normal, b), lift);
    r = _mm256_min_ps(_mm256_max_ps(_mm256_add_ps(t, h), zero), _mm256_set1_ps(2 * GSD_HORIZON));
    above = _mm256_add_ps(_mm256_max_ps(_mm256_sub_ps(t, h), zero), _mm256_set1_ps(GSD_BELOW));
    return _mm256_add_ps(_mm256_mul_ps(_mm256_mul_ps(r, r), _mm256_set1_ps(0.25f / GSD_HORIZON)), above);
}
#endif

/* ---- >>accumulate ------------------------------------------------------------------------------------------- */

/* What accumulate keeps of a sample while it sorts. 36 bytes. */
typedef struct gsdi_item {
    uint32_t x;  /* 24-bit coordinate; bits 24 .. 29: index into gsdi_state.bins */
    uint32_t y;  /* 24-bit coordinate */
    float value; /* radiance, contribution or pixel contribution, as the target asks */
    float contribution, pdf_mix, pdf_bsdf, pdf_guide;
    float pixel;    /* pixel contribution; then the weight that goes into the quadtree */
    float nearness; /* 1 / distance, at most gsdi_accumulation.nearest */
} gsdi_item;

typedef struct gsdi_segment {
    const gsd_training_sample *samples;
    uint32_t count, base;
    uint32_t refused, clamped, zeros, rejected;
} gsdi_segment;

typedef struct gsdi_accumulation {
    gsd_field *field;
    gsd_view view;
    gsd_target target; /* of this pass: never switching */
    bool second_moment, stochastic, box, judge;
    float nearest; /* larger nearness is taken for this: a thousandth of the field's extent */
    uint32_t total;
    gsdi_segment *segments;
    uint32_t segment_count, segment_capacity;
    gsdi_item *items;      /* [GSDI_ROUND] */
    uint32_t *read_cell;   /* [GSDI_ROUND] the cell a sample lies in */
    uint32_t *target_cell; /* [GSDI_ROUND] the cell it is added to (== read_cell without the stochastic filter) */
    uint32_t *order;       /* [GSDI_ROUND] items sorted by cell */
    uint32_t *start;       /* [cells + 1] */
    uint32_t *busy;        /* [cells] cells with samples */
} gsdi_accumulation;

/* False where a sample is bad: not finite, negative, out of range, no density. */
static bool gsdi_sample_valid(const gsd_training_sample *s)
{
    const float most = GSDI_MAX_VALUE, finite = 3.4028234e38f;
    return s->radiance >= 0 && s->radiance < most && s->contribution >= 0 && s->contribution < most &&
           s->pixel_contribution >= 0 && s->pixel_contribution < most && s->pdf_mix > 0 && s->pdf_mix <= finite &&
           s->pdf_bsdf >= 0 && s->pdf_bsdf <= finite && s->pdf_guide >= 0 && s->pdf_guide <= finite &&
           s->nearness >= 0 && s->nearness <= finite && s->radiance < most * s->pdf_mix &&
           gsdi_finite(s->position[0] + s->position[1] + s->position[2]);
}

/* The cell that a sample of the cell at g is added to. */
static uint32_t gsdi_target(const gsdi_accumulation *a, const gsd_training_sample *s, uint32_t cell,
                            const uint32_t g[3])
{
    uint32_t level = a->view.cells[cell].level, jittered[3], axis;
    double u[3];
    if (!a->stochastic)
        return cell;
    gsdi_sample_random(s, u);
    for (axis = 0; axis < 3; ++axis) {
        double t = (double)g[axis] + (u[axis] - 0.5) * (double)gsd_cell_extent(level, axis);
        jittered[axis] = t <= 0 ? 0 : t < 16777215.0 ? (uint32_t)t : 16777215u;
    }
    return gsd_cell_at(&a->view, jittered);
}

/* Cells of a sample: where it lies and where it is added. Sets the item's bin. False: no such cell. */
static bool gsdi_locate(gsdi_accumulation *a, const gsd_training_sample *s, uint32_t at, gsdi_item *item,
                        gsdi_segment *segment)
{
    const gsd_view *view = &a->view;
    uint32_t g[3], cell, level, axis, bin = 0;
    bool outside = false;
    if (a->field->desc.forest_cells) {
        memcpy(&cell, s->position, sizeof cell);
        a->read_cell[at] = a->target_cell[at] = cell;
        return cell < view->cell_count;
    }
    for (axis = 0; axis < 3; ++axis) {
        float p = s->position[axis];
        outside = outside || p < a->field->desc.bounds_min[axis] || p > a->field->desc.bounds_max[axis];
        g[axis] = gsd_grid_coordinate(p, view->origin[axis], view->scale);
    }
    segment->clamped += outside;
    cell = gsd_cell_at(view, g);
    level = view->cells[cell].level;
    for (axis = 0; axis < 3; ++axis)
        bin = bin << 2 | ((g[axis] >> (22 - (level + 2 - axis) / 3)) & 3u);
    item->x |= bin << 24;
    a->read_cell[at] = cell;
    a->target_cell[at] = gsdi_target(a, s, cell, g);
    return true;
}

/* The guide's density of a sample whose vertex did not ask for it. */
static float gsdi_sample_pdf(const gsdi_accumulation *a, const gsd_training_sample *s, uint32_t cell,
                             const float direction[3], const float normal[3])
{
    gsd_handle handle = gsd_find_cell(&a->view, cell);
    gsd_see_from(&a->view, &handle, s->position); /* in a forest nearness is 0 */
    handle.alpha = 0;                             /* closed cells too */
    gsd_orient(&a->view, &handle, normal);
    return gsd_pdf(&a->view, &handle, direction);
}

/* What a sample that is not zero needs besides: the guide's density, where nobody gave it. */
static void gsdi_see_guide(const gsdi_accumulation *a, const gsd_training_sample *s, uint32_t cell, gsdi_item *item)
{
    float direction[3], normal[3];
    if (item->pdf_guide > 0 || !(a->judge || (a->second_moment && !a->field->desc.no_guide_weight)))
        return;
    gsd_unpack_normal(s->direction, normal);
    gsd_direction((double)(s->direction[0] & 0xffffffu) + 0.5, (double)(s->direction[1] & 0xffffffu) + 0.5, direction);
    item->pdf_guide = gsdi_sample_pdf(a, s, cell, direction, normal);
}

/* A sample that is not zero as its quadtree sees it: coordinates, value per solid angle there, without the cosine,
   which is multiplied in when sampling. */
GSDI_FLATTEN static void gsdi_see(const gsdi_accumulation *a, const gsd_training_sample *s, const gsdi_state *state,
                                  gsdi_item *item)
{
    float direction[3], seen[3], offset[3] = {0, 0, 0}, normal[3], scale = 1;
    if (state->nearness > 0) { /* never in a forest */
        uint32_t bin = item->x & 0xff000000u;
        gsd_direction((double)(item->x & 0xffffffu) + 0.5, (double)item->y + 0.5, direction);
        gsd_offset(state->pivot, state->nearness, s->position, offset);
        scale = gsd_to_pivot(offset, direction, seen);
        gsd_coordinates(seen, &item->x, &item->y);
        item->x |= bin;
    }
    if (!a->second_moment)
        return;
    if (s->direction[0] >> 24) {
        gsd_unpack_normal(s->direction, normal);
        item->value /=
            gsd_bin_cosine(&a->view, normal, gsd_lift(offset, normal), (item->y >> 21) * 8 + (item->x >> 21 & 7u));
    }
    item->value /= sqrtf(scale); /* it will be squared */
}

#if GSDI_X86
/* The values of second moments in gsdi_see. */
GSDI_AVX2_INLINE __m256 gsdi_without_cosine_avx2(const gsd_view *view, const __m256i packed[2], __m256i x, __m256i y,
                                                 const __m256 offset[3], __m256 scale, __m256 value)
{
    __m256 normal[3], mean[3], cosine, none;
    __m256i bin = _mm256_add_epi32(_mm256_slli_epi32(_mm256_srli_epi32(y, 21), 3), _mm256_srli_epi32(x, 21));
    uint32_t k;
    gsdi_normal_avx2(packed[0], packed[1], normal);
    for (k = 0; k < 3; ++k)
        mean[k] = _mm256_i32gather_ps(view->bins + k * GSDI_BINS, bin, 4);
    cosine = gsdi_cosine_avx2(normal, mean, gsdi_dot_avx2(offset, normal));
    none = _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_srli_epi32(packed[0], 24), _mm256_setzero_si256()));
    value = _mm256_blendv_ps(_mm256_div_ps(value, cosine), value, none);
    return _mm256_div_ps(value, _mm256_sqrt_ps(scale));
}

/* gsdi_see for n <= 8 samples of a segment. */
GSDI_AVX2 static void gsdi_see_avx2(const gsdi_accumulation *a, const gsdi_segment *segment, const uint32_t *lane,
                                    uint32_t n)
{
    const void *pivot_at[8], *sample_at[8];
    uint32_t coordinate[2][8], i;
    float value[8];
    __m256 offset[3], position[4], pivot[4], direction[3], scale = _mm256_set1_ps(1), far;
    __m256i packed[2], x, y, seen[2], wide = _mm256_set1_epi32(0xffffff);
    for (i = 0; i < 8; ++i) { /* those from n on repeat the first */
        uint32_t k = lane[i < n ? i : 0], at = segment->base + k;
        sample_at[i] = segment->samples[k].position; /* and direction[0] */
        coordinate[1][i] = segment->samples[k].direction[1];
        pivot_at[i] = a->field->states[a->target_cell[at]].pivot; /* and nearness */
        value[i] = a->items[at].value;
    }
    gsdi_columns_avx2(sample_at, position);
    gsdi_columns_avx2(pivot_at, pivot);
    packed[0] = _mm256_castps_si256(position[3]);
    packed[1] = _mm256_loadu_si256((const __m256i *)(const void *)coordinate[1]);
    x = _mm256_and_si256(packed[0], wide);
    y = _mm256_and_si256(packed[1], wide);
    far = _mm256_cmp_ps(pivot[3], _mm256_setzero_ps(), _CMP_LE_OQ);
    offset[0] = offset[1] = offset[2] = _mm256_setzero_ps();
    if (_mm256_movemask_ps(far) != 255) {
        gsdi_middle_avx2(x, y, direction);
        gsdi_offset_avx2(pivot, position, offset);
        scale = gsdi_to_pivot_avx2(offset, direction, direction);
        gsdi_coordinates_avx2(direction, &seen[0], &seen[1]);
        x = _mm256_blendv_epi8(seen[0], x, _mm256_castps_si256(far));
        y = _mm256_blendv_epi8(seen[1], y, _mm256_castps_si256(far));
    }
    if (a->second_moment)
        _mm256_storeu_ps(value,
                         gsdi_without_cosine_avx2(&a->view, packed, x, y, offset, scale, _mm256_loadu_ps(value)));
    _mm256_storeu_si256((__m256i *)(void *)coordinate[0], x);
    _mm256_storeu_si256((__m256i *)(void *)coordinate[1], y);
    for (i = 0; i < n; ++i) {
        gsdi_item *item = &a->items[segment->base + lane[i]];
        item->x = (item->x & 0xff000000u) | coordinate[0][i];
        item->y = coordinate[1][i];
        item->value = value[i];
    }
}
#endif

static void gsdi_see_lanes(const gsdi_accumulation *a, const gsdi_segment *segment, const uint32_t *lane, uint32_t n)
{
    uint32_t i;
#if GSDI_X86
    if (a->view.simd >= GSD_SIMD_AVX2) {
        gsdi_see_avx2(a, segment, lane, n);
        return;
    }
#endif
    for (i = 0; i < n; ++i) {
        uint32_t at = segment->base + lane[i];
        gsdi_see(a, &segment->samples[lane[i]], &a->field->states[a->target_cell[at]], &a->items[at]);
    }
}

/* See those of a segment's samples that are not zero. */
static void gsdi_see_segment(const gsdi_accumulation *a, const gsdi_segment *segment)
{
    uint32_t lane[8], n = 0, i;
    for (i = 0; i < segment->count; ++i) {
        const gsd_training_sample *s = &segment->samples[i];
        const gsdi_state *state;
        uint32_t at = segment->base + i;
        gsdi_item *item = &a->items[at];
        if (a->read_cell[at] == GSDI_NONE || !(item->contribution > 0 || item->value > 0))
            continue;
        gsdi_see_guide(a, s, a->read_cell[at], item);
        state = &a->field->states[a->target_cell[at]];
        if (!(state->nearness > 0) && !(a->second_moment && s->direction[0] >> 24))
            continue; /* seen from anywhere alike */
        lane[n++] = i;
        if (n == 8) {
            gsdi_see_lanes(a, segment, lane, n);
            n = 0;
        }
    }
    if (n)
        gsdi_see_lanes(a, segment, lane, n);
}

/* Check sample i of a segment, find its cells and leaf coordinates. */
static void gsdi_read(gsdi_accumulation *a, gsdi_segment *segment, uint32_t i)
{
    const gsd_training_sample *s = &segment->samples[i];
    uint32_t at = segment->base + i;
    gsdi_item *item = &a->items[at];
    bool rejected = s->radiance == 0 && signbit(s->radiance);
    item->x = s->direction[0] & 0xffffffu;
    item->y = s->direction[1] & 0xffffffu;
    if (!gsdi_sample_valid(s) || !gsdi_locate(a, s, at, item, segment)) {
        segment->refused++;
        a->read_cell[at] = a->target_cell[at] = GSDI_NONE;
        return;
    }
    item->nearness = s->nearness < a->nearest ? s->nearness : a->nearest;
    item->value = a->target == GSD_TARGET_RADIANCE ? s->radiance
                  : a->target == GSD_TARGET_SIMPLE ? s->contribution
                                                   : s->pixel_contribution;
    item->value = rejected ? 0 : item->value;
    item->contribution = rejected ? 0 : s->contribution;
    item->pixel = rejected ? 0 : s->pixel_contribution;
    item->pdf_mix = s->pdf_mix;
    item->pdf_bsdf = s->pdf_bsdf;
    item->pdf_guide = s->pdf_guide;
    GSDI_PREFETCH(&a->field->states[a->target_cell[at]].pivot);
    segment->rejected += rejected;
    segment->zeros += !(s->radiance > 0) || !(s->contribution > 0);
}

#if GSDI_X86
/* 0 <= x < most; x <= most */
GSDI_AVX2_INLINE __m256 gsdi_below_avx2(__m256 x, __m256 most)
{
    return _mm256_and_ps(_mm256_cmp_ps(x, _mm256_setzero_ps(), _CMP_GE_OQ), _mm256_cmp_ps(x, most, _CMP_LT_OQ));
}
GSDI_AVX2_INLINE __m256 gsdi_upto_avx2(__m256 x, __m256 most)
{
    return _mm256_and_ps(_mm256_cmp_ps(x, _mm256_setzero_ps(), _CMP_GE_OQ), _mm256_cmp_ps(x, most, _CMP_LE_OQ));
}

/* gsdi_sample_valid; s: the words of gsd_training_sample. */
GSDI_AVX2_INLINE __m256 gsdi_valid_avx2(const __m256 s[12])
{
    __m256 most = _mm256_set1_ps(GSDI_MAX_VALUE), finite = _mm256_set1_ps(3.4028234e38f), ok;
    ok = _mm256_and_ps(gsdi_below_avx2(s[6], most), gsdi_below_avx2(s[7], most));
    ok = _mm256_and_ps(ok, gsdi_below_avx2(s[8], most));
    ok = _mm256_and_ps(ok, _mm256_cmp_ps(s[9], _mm256_setzero_ps(), _CMP_GT_OQ));
    ok = _mm256_and_ps(ok, _mm256_cmp_ps(s[9], finite, _CMP_LE_OQ));
    ok = _mm256_and_ps(ok, _mm256_and_ps(gsdi_upto_avx2(s[10], finite), gsdi_upto_avx2(s[11], finite)));
    ok = _mm256_and_ps(ok, gsdi_upto_avx2(s[5], finite));
    ok = _mm256_and_ps(ok, _mm256_cmp_ps(s[6], _mm256_mul_ps(most, s[9]), _CMP_LT_OQ));
    return _mm256_and_ps(
        ok, _mm256_cmp_ps(gsdi_absolute_avx2(_mm256_add_ps(_mm256_add_ps(s[0], s[1]), s[2])), finite, _CMP_LE_OQ));
}

/* gsdi_locate for samples at -> at + 7, not of a forest: finds their cells, returns the indices of their bins; outside:
   which positions are clamped. */
GSDI_AVX2_INLINE __m256i gsdi_locate_avx2(gsdi_accumulation *a, const gsd_training_sample *samples, uint32_t at,
                                          const __m256 position[3], __m256 *outside)
{
    const gsd_view *view = &a->view;
    const gsd_desc *desc = &a->field->desc;
    uint32_t grid[3][8], level[8], i, axis;
    __m256i g[3], bin = _mm256_setzero_si256();
    *outside = _mm256_setzero_ps();
    for (axis = 0; axis < 3; ++axis) {
        __m256 p = position[axis], t;
        *outside = _mm256_or_ps(*outside, _mm256_cmp_ps(p, _mm256_set1_ps(desc->bounds_min[axis]), _CMP_LT_OQ));
        *outside = _mm256_or_ps(*outside, _mm256_cmp_ps(p, _mm256_set1_ps(desc->bounds_max[axis]), _CMP_GT_OQ));
        t = _mm256_mul_ps(_mm256_sub_ps(p, _mm256_set1_ps(view->origin[axis])), _mm256_set1_ps(view->scale));
        t = _mm256_min_ps(_mm256_max_ps(t, _mm256_setzero_ps()), _mm256_set1_ps(16777215.0f));
        g[axis] = _mm256_cvttps_epi32(t);
        _mm256_storeu_si256((__m256i *)(void *)grid[axis], g[axis]);
    }
    for (i = 0; i < 8; ++i) {
        uint32_t one[3], cell;
        for (axis = 0; axis < 3; ++axis)
            one[axis] = grid[axis][i];
        cell = gsd_cell_at(view, one);
        level[i] = view->cells[cell].level;
        a->read_cell[at + i] = cell;
        a->target_cell[at + i] = gsdi_target(a, &samples[i], cell, one);
        GSDI_PREFETCH(&a->field->states[a->target_cell[at + i]].pivot);
    }
    for (axis = 0; axis < 3; ++axis) {
        __m256i l = _mm256_loadu_si256((const __m256i *)(const void *)level), shift, third = _mm256_set1_epi32(43691);
        l = _mm256_add_epi32(l, _mm256_set1_epi32(2 - (int)axis));
        shift = _mm256_srli_epi32(_mm256_mullo_epi32(l, third), 17); /* l / 3, up to l = 98303 */
        shift = _mm256_srlv_epi32(g[axis], _mm256_sub_epi32(_mm256_set1_epi32(22), shift));
        bin = _mm256_or_si256(_mm256_slli_epi32(bin, 2), _mm256_and_si256(shift, _mm256_set1_epi32(3)));
    }
    return bin;
}

/* Eight columns as the first eight words of items. */
GSDI_AVX2_INLINE void gsdi_items_avx2(const __m256 c[8], gsdi_item *items)
{
    uint32_t i;
    for (i = 0; i < 4; ++i) { /* rows i and i + 4 */
        __m256 half[2];
        uint32_t k;
        for (k = 0; k < 2; ++k) {
            const __m256 *from = c + 4 * k;
            __m256 low = i < 2 ? _mm256_unpacklo_ps(from[0], from[1]) : _mm256_unpackhi_ps(from[0], from[1]);
            __m256 high = i < 2 ? _mm256_unpacklo_ps(from[2], from[3]) : _mm256_unpackhi_ps(from[2], from[3]);
            half[k] = i & 1 ? _mm256_shuffle_ps(low, high, 0xee) : _mm256_shuffle_ps(low, high, 0x44);
        }
        _mm256_storeu_ps((float *)(void *)&items[i], _mm256_permute2f128_ps(half[0], half[1], 0x20));
        _mm256_storeu_ps((float *)(void *)&items[i + 4], _mm256_permute2f128_ps(half[0], half[1], 0x31));
    }
}

/* gsdi_read for samples i .. i + 7, not of a forest. */
GSDI_AVX2 static void gsdi_read_avx2(gsdi_accumulation *a, gsdi_segment *segment, uint32_t i)
{
    const gsd_training_sample *samples = segment->samples + i;
    uint32_t at = segment->base + i, k, wrong;
    const void *row[3][8];
    float nearness[8];
    __m256 s[12], c[8], valid, outside, rejected, zero = _mm256_setzero_ps(), lit;
    __m256i bin, wide = _mm256_set1_epi32(0xffffff);
    for (k = 0; k < 8; ++k) {
        row[0][k] = samples[k].position;
        row[1][k] = &samples[k].direction[1];
        row[2][k] = &samples[k].pixel_contribution;
    }
    for (k = 0; k < 3; ++k)
        gsdi_columns_avx2(row[k], s + 4 * k);
    valid = gsdi_valid_avx2(s);
    bin = gsdi_locate_avx2(a, samples, at, s, &outside);
    rejected = _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_castps_si256(s[6]), _mm256_set1_epi32((int)0x80000000u)));
    lit = _mm256_and_ps(_mm256_cmp_ps(s[6], zero, _CMP_GT_OQ), _mm256_cmp_ps(s[7], zero, _CMP_GT_OQ));
    _mm256_storeu_ps(nearness, _mm256_min_ps(s[5], _mm256_set1_ps(a->nearest)));
    c[0] = _mm256_castsi256_ps(
        _mm256_or_si256(_mm256_and_si256(_mm256_castps_si256(s[3]), wide), _mm256_slli_epi32(bin, 24)));
    c[1] = _mm256_castsi256_ps(_mm256_and_si256(_mm256_castps_si256(s[4]), wide));
    c[2] = _mm256_andnot_ps(rejected, s[a->target == GSD_TARGET_RADIANCE ? 6 : a->target == GSD_TARGET_SIMPLE ? 7 : 8]);
    c[3] = _mm256_andnot_ps(rejected, s[7]);
    c[4] = s[9];
    c[5] = s[10];
    c[6] = s[11];
    c[7] = _mm256_andnot_ps(rejected, s[8]);
    gsdi_items_avx2(c, a->items + at);
    for (k = 0; k < 8; ++k)
        a->items[at + k].nearness = nearness[k];
    wrong = 255u ^ (uint32_t)_mm256_movemask_ps(valid);
    segment->refused += (uint32_t)__builtin_popcount(wrong);
    segment->clamped += (uint32_t)__builtin_popcount((uint32_t)_mm256_movemask_ps(_mm256_and_ps(outside, valid)));
    segment->rejected += (uint32_t)__builtin_popcount((uint32_t)_mm256_movemask_ps(_mm256_and_ps(rejected, valid)));
    segment->zeros += (uint32_t)__builtin_popcount((uint32_t)_mm256_movemask_ps(_mm256_andnot_ps(lit, valid)));
    for (k = 0; wrong >> k; ++k)
        if (wrong >> k & 1)
            a->read_cell[at + k] = a->target_cell[at + k] = GSDI_NONE;
}
#endif

/* Check samples, find their cells and leaf coordinates. */
static void gsdi_prepare(void *context, uint32_t begin, uint32_t end)
{
    gsdi_accumulation *a = (gsdi_accumulation *)context;
    uint32_t k, i;
    for (k = begin; k < end; ++k) {
        gsdi_segment *segment = &a->segments[k];
        i = 0;
#if GSDI_X86
        if (a->view.simd >= GSD_SIMD_AVX2 && !a->field->desc.forest_cells)
            for (; i + 8 <= segment->count; i += 8)
                gsdi_read_avx2(a, segment, i);
#endif
        for (; i < segment->count; ++i)
            gsdi_read(a, segment, i);
        gsdi_see_segment(a, segment); /* apart, so that memory has had time */
    }
}

/* One Adam step [Kingma 2015; Mueller 2019] on theta, alpha = sigmoid(theta). Gradient of the KL divergence
   -(g / p) (p_b - p_g) / p_a, or of the second moment -(g^2 / p) (p_b - p_g) / p_a^2, times alpha (1 - alpha), plus
   0.01 theta. Step 0.01, beta 0.9, 0.999. */
static void gsdi_adam(gsdi_state *state, double g, double p, double pb, double pg, bool second_moment)
{
    double theta = (double)state->theta, a = 1 / (1 + exp(-theta)), pa = a * pb + (1 - a) * pg;
    double weight = second_moment ? (g / p) * (g / pa) : g / p, gradient, m, v, t;
    gradient = -weight * (pb - pg) / pa * a * (1 - a);
    if (!(fabs(gradient) < 1e30))
        return;
    gradient += 0.01 * theta;
    t = (double)(state->steps < 1000000u ? ++state->steps : state->steps);
    m = 0.9 * (double)state->moment1 + 0.1 * gradient;
    v = 0.999 * (double)state->moment2 + 0.001 * gradient * gradient;
    state->moment1 = (float)(m < 1e30 ? m > -1e30 ? m : -1e30 : 1e30);
    state->moment2 = (float)(v < 1e38 ? v : 1e38);
    m /= t < 300 ? 1 - pow(0.9, t) : 1;
    v /= t < 30000 ? 1 - pow(0.999, t) : 1;
    theta -= 0.01 * m / (sqrt(v) + 1e-8);
    state->theta = (float)(theta < -2.94 ? -2.94 : theta > 4 ? 4 : theta); /* alpha >= 0.05 */
}

/* Sums of the gate: x_a = g^2 / (p p_a) for each a. pb is floored, for a direction that was drawn by the guide but that
   the BSDF practically never draws. */
static void gsdi_gate_add(gsdi_state *state, double g, double pixel, double p, double pb, double pg)
{
    double w = pixel / g, q, x[GSDI_GATE_LOW + 1];
    int k;
    g = g < GSDI_MAX_ROOT ? g : GSDI_MAX_ROOT;
    q = g * (g / p);
    state->weight += g / p;
    pb = pb > 1e-4 * p ? pb : 1e-4 * p;
    for (k = 0; k <= GSDI_GATE_LOW; ++k) {
        double a = gsdi_gate_alpha[k];
        x[k] = q / (a * pb + (1 - a) * pg);
        x[k] = x[k] < 1e60 ? x[k] : 1e60;
        state->v[k] += x[k];
        state->vv[k] += x[k] * x[k];
    }
    for (k = 0; k < GSDI_GATE_LOW; ++k)
        state->cross[k] += x[k] * x[GSDI_GATE_LOW];
    w = w < 1e15 ? w : 1e15;
    state->pixel += w * w * x[GSDI_GATE_LOW];
    state->pixel_v += x[GSDI_GATE_LOW];
}

/* Learn from one item in the cell where it lies; sets the weight that goes into the quadtree. */
static void gsdi_learn(const gsdi_accumulation *a, gsdi_state *state, const gsd_handle *handle, gsdi_item *item)
{
    const gsd_desc *desc = &a->field->desc;
    double p = (double)item->pdf_mix, pb = (double)item->pdf_bsdf, pg = (double)item->pdf_guide;
    double c = (double)item->contribution, value = (double)item->value;
    bool judge = a->judge && (state->gate != GSD_GATE_CLOSED || state->probe == 0);
    bool weigh = a->second_moment && !desc->no_guide_weight && value > 0;
    state->fresh += 1;
    state->flow += c / p < 1e30 ? c / p : 1e30;
    state->bins[item->x >> 24] += 1;
    judge = judge && (state->hits < GSDI_ENOUGH_HITS || ((uint32_t)(int64_t)state->fresh & 7u) == 0);
    state->gate_count += judge;
    if (judge && c > 0) {
        state->hits++;
        gsdi_gate_add(state, c, (double)item->pixel, p, pb, handle->root ? pg : pb); /* without a tree: neutral */
        if (handle->root && desc->alpha_mode == GSD_ALPHA_ADAM)
            gsdi_adam(state, c < GSDI_MAX_ROOT ? c : GSDI_MAX_ROOT, p, pb, pg, a->second_moment);
    }
    if (a->second_moment) {
        value = value < GSDI_MAX_ROOT ? value : GSDI_MAX_ROOT;
        if (weigh) {
            double alpha = handle->alpha < 1 ? (double)handle->alpha : 0.5;
            double mix = alpha * pb + (1 - alpha) * pg;
            value *= mix > 0 ? (1 - alpha) * pg / mix : 1;
        }
        value *= value;
    }
    value /= p;
    value = value < 1e30 ? value : 1e30;
    item->pixel = (float)value;
    state->mass += value;
    state->near_mass += value * (double)item->nearness;
}

static void gsdi_cell_map(const gsdi_accumulation *a, uint32_t cell, gsdi_map *map)
{
    uint32_t first = a->field->states[cell].first;
    gsdi_map_make(map, a->field->child + first, a->field->sum + first, a->start[cell + 1] - a->start[cell]);
}

/* Add an item to the quadtree. */
static void gsdi_splat(const gsdi_accumulation *a, const gsdi_map *map, gsdi_state *state, const gsdi_item *item)
{
    uint32_t x = item->x & 0xffffffu, y = item->y, half = (x ^ y) & 1u, depth = 24;
    state->held += 1; /* one by one: sums that refine has scaled round alike for any cut */
    if (!(item->pixel > 0))
        return;
    state->lit += 1;
    if (a->box)
        gsdi_splat_box(map, half, x, y, (double)item->pixel);
    else
        map->sum[gsdi_map_node(map, x, y, &depth)].half[half] += (double)item->pixel;
}

/* Busy cells [begin, end): statistics, and the quadtree sums where both belong to the same cell. */
static void gsdi_learn_cells(void *context, uint32_t begin, uint32_t end)
{
    gsdi_accumulation *a = (gsdi_accumulation *)context;
    uint32_t b, i, last = a->start[a->view.cell_count];
    for (b = begin; b < end; ++b) {
        uint32_t cell = a->busy[b], stop = a->start[cell + 1];
        gsd_handle handle = gsd_find_cell(&a->view, cell);
        gsdi_state *state = &a->field->states[cell];
        gsdi_map map;
        if (!a->stochastic)
            gsdi_cell_map(a, cell, &map);
        for (i = a->start[cell]; i < stop; ++i) {
            gsdi_item *item = &a->items[a->order[i]];
            if (i + 8 < last) {
                GSDI_PREFETCH(&a->items[a->order[i + 8]].x);
                GSDI_PREFETCH(&a->items[a->order[i + 8]].nearness); /* may lie in the next cache line */
            }
            gsdi_learn(a, state, &handle, item);
            if (!a->stochastic)
                gsdi_splat(a, &map, state, item);
        }
    }
}

/* Busy cells [begin, end): quadtree sums with the stochastic filter. */
static void gsdi_splat_cells(void *context, uint32_t begin, uint32_t end)
{
    gsdi_accumulation *a = (gsdi_accumulation *)context;
    uint32_t b, i;
    for (b = begin; b < end; ++b) {
        uint32_t cell = a->busy[b];
        gsdi_map map;
        gsdi_cell_map(a, cell, &map);
        for (i = a->start[cell]; i < a->start[cell + 1]; ++i)
            gsdi_splat(a, &map, &a->field->states[cell], &a->items[a->order[i]]);
    }
}

/* Stable counting sort of items by cell; fills order, start and busy. Returns the number of busy cells. */
static uint32_t gsdi_sort(gsdi_accumulation *a, const uint32_t *cell_of)
{
    uint32_t cells = a->view.cell_count, i, sum = 0, busy = 0;
    memset(a->start, 0, ((size_t)cells + 1) * sizeof *a->start);
    for (i = 0; i < a->total; ++i)
        if (cell_of[i] != GSDI_NONE)
            a->start[cell_of[i]]++;
    for (i = 0; i <= cells; ++i) {
        uint32_t n = a->start[i];
        if (n)
            a->busy[busy++] = i;
        a->start[i] = sum;
        sum += n;
    }
    for (i = 0; i < a->total; ++i)
        if (cell_of[i] != GSDI_NONE)
            a->order[a->start[cell_of[i]]++] = i;
    memmove(a->start + 1, a->start, cells * sizeof *a->start);
    a->start[0] = 0;
    return busy;
}

/* Process the segments gathered so far. */
static void gsdi_round(gsdi_accumulation *a, gsd_parallel_fn parallel, void *user)
{
    gsd_field *field = a->field;
    uint32_t i, busy;
    gsdi_run(parallel, user, a->segment_count, 1, gsdi_prepare, a);
    busy = gsdi_sort(a, a->read_cell);
    gsdi_run(parallel, user, busy, 4, gsdi_learn_cells, a);
    if (a->stochastic) {
        busy = gsdi_sort(a, a->target_cell);
        gsdi_run(parallel, user, busy, 4, gsdi_splat_cells, a);
    }
    for (i = 0; i < a->segment_count; ++i) {
        const gsdi_segment *s = &a->segments[i];
        field->stats.samples += s->count - s->refused;
        field->stats.refused += s->refused;
        field->stats.clamped += s->clamped;
        field->stats.zeros += s->zeros;
        field->stats.rejected += s->rejected;
    }
    a->segment_count = a->total = 0;
}

static bool gsdi_accumulation_start(gsdi_accumulation *a, gsd_field *field, uint64_t samples)
{
    const gsd_desc *desc = &field->desc;
    uint64_t n = ((samples < GSDI_ROUND ? samples : GSDI_ROUND) + 1) & ~(uint64_t)1, cells = field->block->cells, size;
    memset(a, 0, sizeof *a);
    a->field = field;
    a->view = gsd_get_view(field);
    a->target = (gsd_target)field->target;
    a->second_moment = a->target != GSD_TARGET_RADIANCE;
    a->stochastic = desc->spatial_filter == GSD_SPATIAL_STOCHASTIC && !desc->forest_cells;
    a->box = desc->directional_filter == GSD_DIRECTIONAL_BOX;
    a->judge = !desc->no_gate || desc->alpha_mode != GSD_ALPHA_FIXED;
    a->segment_capacity = GSDI_ROUND / 64;
    a->nearest = 1000 * field->block->scale / 16777216;
    size = n * (sizeof(gsdi_item) + 3 * 4) + a->segment_capacity * sizeof(gsdi_segment) + (cells * 2 + 3) * 4;
    if (field->scratch_size < size) {
        gsdi_release(desc, field->scratch);
        field->scratch_size = 0;
        field->scratch = desc->allocate(desc->user, (size_t)size);
        if (!field->scratch)
            return false;
        field->scratch_size = size;
    }
    a->items = (gsdi_item *)field->scratch;
    a->segments = (gsdi_segment *)(void *)(a->items + n);
    a->read_cell = (uint32_t *)(void *)(a->segments + a->segment_capacity);
    a->target_cell = a->read_cell + n;
    a->order = a->target_cell + n;
    a->start = a->order + n;
    a->busy = a->start + cells + 2;
    return true;
}

GSD_API gsd_result gsd_accumulate(gsd_field *field, gsd_stream *const *streams, uint32_t count,
                                  gsd_parallel_fn parallel, void *user)
{
    gsdi_accumulation a;
    uint64_t samples = 0;
    uint32_t k, at, n;
    const gsdi_chunk *chunk;
    for (k = 0; k < count; ++k) {
        samples += streams[k]->size;
        field->stats.lost += streams[k]->lost - streams[k]->lost_told;
        streams[k]->lost_told = streams[k]->lost;
    }
    if (samples == 0)
        return GSD_OK;
    if (!gsdi_accumulation_start(&a, field, samples)) {
        field->stats.lost += samples;
        return GSD_OUT_OF_MEMORY;
    }
    for (k = 0; k < count; ++k)
        for (chunk = streams[k]->first; chunk && chunk->count; chunk = chunk->next)
            for (at = 0; at < chunk->count; at += n) {
                gsdi_segment *segment;
                if (a.total == GSDI_ROUND || a.segment_count == a.segment_capacity)
                    gsdi_round(&a, parallel, user);
                n = chunk->count - at;
                n = n < GSDI_SEGMENT ? n : GSDI_SEGMENT;
                n = n < GSDI_ROUND - a.total ? n : GSDI_ROUND - a.total;
                segment = &a.segments[a.segment_count++];
                memset(segment, 0, sizeof *segment);
                segment->samples = chunk->samples + at;
                segment->count = n;
                segment->base = a.total;
                a.total += n;
            }
    gsdi_round(&a, parallel, user);
    return GSD_OK;
}

/* ---- >>gate ------------------------------------------------------------------------------------------------- */

/* Mean and standard error of y = f1 x_1 - fa x_a, from the sums. */
static void gsdi_gate_difference(const gsdi_state *s, double f1, int a, double fa, double *mean, double *error)
{
    double n = s->gate_count, square;
    *mean = (f1 * s->v[GSDI_GATE_LOW] - fa * s->v[a]) / n;
    square = (f1 * f1 * s->vv[GSDI_GATE_LOW] - 2 * f1 * fa * s->cross[a] + fa * fa * s->vv[a]) / n - *mean * *mean;
    *error = GSDI_CONFIDENCE * sqrt((square > 0 ? square : 0) / n);
}

/* Scale all sums of the gate. */
static void gsdi_gate_scale(gsdi_state *s, double f)
{
    int k;
    for (k = 0; k <= GSDI_GATE_LOW; ++k) {
        s->v[k] *= f;
        s->vv[k] *= f;
    }
    for (k = 0; k < GSDI_GATE_LOW; ++k)
        s->cross[k] *= f;
    s->weight *= f;
    s->pixel *= f;
    s->pixel_v *= f;
    s->gate_count *= f;
}

/* Kish's effective number of samples behind V(1). */
static double gsdi_gate_effective(const gsdi_state *s)
{
    double v = s->v[GSDI_GATE_LOW], vv = s->vv[GSDI_GATE_LOW];
    return vv > 0 ? fmin(v * v / vv, 1e18) : 0; /* sums of a loaded field may be anything */
}

/* alpha from the five V(a), a convex function of a: the minimum of the parabola through the lowest point and its
   neighbours, pulled towards the present value by 32 effective samples. */
static float gsdi_grid_alpha(const gsdi_state *s)
{
    const double *x = gsdi_gate_alpha, *v = s->v;
    double best, n = gsdi_gate_effective(s), d0, d1, bend;
    int k, low = 0;
    for (k = 1; k <= GSDI_GATE_LOW; ++k)
        low = v[k] < v[low] ? k : low;
    if (!(v[0] > v[low] || v[GSDI_GATE_LOW] > v[low])) /* nothing known: no light, or no tree yet */
        return s->alpha;
    k = low < 1 ? 1 : low > GSDI_GATE_LOW - 1 ? GSDI_GATE_LOW - 1 : low;
    d0 = (v[k] - v[k - 1]) / (x[k] - x[k - 1]);
    d1 = (v[k + 1] - v[k]) / (x[k + 1] - x[k]);
    bend = (d1 - d0) / (x[k + 1] - x[k - 1]);
    best = bend > 0 ? 0.5 * (x[k - 1] + x[k]) - 0.5 * d0 / bend : x[low];
    best = best < 0.05 ? 0.05 : best > 0.95 ? 0.95 : best;
    best = (n * best + 32 * (double)s->alpha) / (n + 32);
    return (float)best;
}

/* Open, close or leave a cell; see "Gate" in the opening comment. */
static void gsdi_verdict(const gsd_desc *desc, bool pixels, gsdi_state *s, gsd_stats *stats)
{
    bool closed = s->gate == GSD_GATE_CLOSED;
    double n = gsdi_gate_effective(s), m = s->weight / s->gate_count, mean, error, even, even_error;
    double margin = (double)desc->gate_margin * (closed ? 2 : 1),
           need = (double)desc->gate_gain * (pixels && s->pixel > 0 ? s->pixel_v / s->pixel : 16 * m * m);
    double limit = m * m + need;
    int k, best = 0;
    stats->probed += closed;
    for (k = 1; k < GSDI_GATE_LOW; ++k)
        best = s->v[k] < s->v[best] ? k : best;
    gsdi_gate_difference(s, 1, best, 1 + margin, &mean, &error);
    gsdi_gate_difference(s, 1, 0, 0, &even, &even_error);
    mean -= closed ? 1.5 * need : need;
    if (mean - error > 0 && n >= GSDI_MIN_OPEN) {
        stats->opened += s->gate != GSD_GATE_OPEN;
        s->gate = GSD_GATE_OPEN;
    } else if (closed) { /* not as even as it seemed */
        s->gate = mean > 0 && even - even_error > 1.5 * limit ? GSD_GATE_UNJUDGED : GSD_GATE_CLOSED;
    } else if ((even + even_error < limit && n >= GSDI_MIN_EVEN && s->rebuilds >= GSDI_MIN_EVEN_REBUILDS) ||
               (mean + error < 0 && n >= GSDI_MIN_EFFECTIVE && s->rebuilds >= GSDI_MIN_REBUILDS)) {
        stats->closed++;
        s->gate = GSD_GATE_CLOSED;
    }
}

/* Verdict on a cell after a pass. changed: pixels are true now and were not before, or the reverse. */
static void gsdi_judge(const gsd_desc *desc, bool pixels, bool changed, double fade, gsdi_state *s, gsd_stats *stats)
{
    if (changed)
        s->pixel = s->pixel_v = 0;
    if (s->gate == GSD_GATE_CLOSED && s->probe > 0) {
        s->probe--;
        return;
    }
    if (desc->alpha_mode == GSD_ALPHA_GRID)
        s->alpha = gsdi_grid_alpha(s);
    else if (desc->alpha_mode == GSD_ALPHA_ADAM)
        s->alpha = 1 / (1 + expf(-s->theta));
    if (!desc->no_gate && s->gate_count > 0 && gsdi_gate_effective(s) > 0)
        gsdi_verdict(desc, pixels, s, stats);
    if (s->gate == GSD_GATE_CLOSED)
        s->probe = desc->gate_probe - 1;
    gsdi_gate_scale(s, fade);
}

/* ---- >>block ------------------------------------------------------------------------------------------------ */

static const gsdi_tree *gsdi_trees(const gsdi_block *b)
{
    return (const gsdi_tree *)(const void *)((const char *)b + b->trees_at);
}

static gsd_cell *gsdi_cells(gsdi_block *b) { return (gsd_cell *)(void *)((char *)b + b->cells_at); }
static gsd_node *gsdi_nodes(gsdi_block *b) { return (gsd_node *)(void *)((char *)b + b->nodes_at); }
static uint32_t *gsdi_words(gsdi_block *b, uint64_t at) { return (uint32_t *)(void *)((char *)b + at); }
static float *gsdi_floats(gsdi_block *b, uint64_t at) { return (float *)(void *)((char *)b + at); }

/* Offsets and size from the counts. */
static void gsdi_block_layout(gsdi_block *b)
{
    uint64_t at = (sizeof(gsdi_block) + 63) & ~(uint64_t)63;
    b->nodes_at = at;
    at += (uint64_t)b->nodes * sizeof(gsd_node);
    b->jumps_at = at = (at + 63) & ~(uint64_t)63;
    at += (uint64_t)b->jumps * 4;
    b->masses_at = at;
    at += (uint64_t)b->jumps * 4;
    b->bins_at = at;
    at += 3 * GSDI_BINS * 4;
    b->grid_at = at;
    at += GSDI_GRID * 4;
    b->trees_at = at;
    at += (uint64_t)b->trees * sizeof(gsdi_tree);
    b->spatial_at = at;
    at += (uint64_t)b->spatial * 4;
    b->aliases_at = at;
    at += (uint64_t)b->aliases * sizeof(gsd_alias);
    b->cells_at = at = (at + 63) & ~(uint64_t)63; /* last, with room to grow */
    b->cell_capacity = b->cell_capacity > b->cells ? b->cell_capacity : b->cells;
    b->size = at + (uint64_t)b->cell_capacity * sizeof(gsd_cell);
}

/* Memory for a block whose counts are set in shape; *memory is what to release. NULL = out of memory. */
static gsdi_block *gsdi_block_allocate(const gsd_desc *desc, gsdi_block *shape, void **memory)
{
    gsdi_block *b;
    gsdi_block_layout(shape);
    *memory = gsdi_allocate(desc, shape->size + 64, 1);
    if (!*memory)
        return NULL;
    b = (gsdi_block *)(void *)((char *)*memory + ((64 - ((uintptr_t)*memory & 63)) & 63));
    *b = *shape;
    return b;
}

GSD_API gsd_view gsd_get_view(const gsd_field *field)
{
    gsdi_block *b = field->block;
    gsd_view view;
    memset(&view, 0, sizeof view);
    view.grid = gsdi_words(b, b->grid_at);
    view.spatial = gsdi_words(b, b->spatial_at);
    view.cells = gsdi_cells(b);
    view.nodes = gsdi_nodes(b);
    view.jumps = gsdi_words(b, b->jumps_at);
    view.masses = gsdi_floats(b, b->masses_at);
    view.bins = gsdi_floats(b, b->bins_at);
    view.aliases = (const gsd_alias *)(const void *)((const char *)b + b->aliases_at);
    memcpy(view.origin, b->origin, sizeof view.origin);
    view.scale = b->scale;
    view.uniform = b->uniform;
    view.cell_count = b->cells;
    view.simd = (uint32_t)field->desc.simd;
    return view;
}

/* Link of the spatial tree at grid coordinates after at most 12 levels. */
static uint32_t gsdi_grid_link(const uint32_t *spatial, uint32_t gx, uint32_t gy, uint32_t gz)
{
    uint32_t g[3], link = spatial[0], level;
    g[0] = gx;
    g[1] = gy;
    g[2] = gz;
    for (level = 0; level < 12 && !(link & GSD_CELL_BIT); ++level)
        link = spatial[link + ((g[level % 3] >> (3 - level / 3)) & 1u)];
    return link;
}

static void gsdi_block_grid(gsdi_block *b)
{
    uint32_t i, *grid = gsdi_words(b, b->grid_at);
    const uint32_t *spatial = gsdi_words(b, b->spatial_at);
    for (i = 0; i < GSDI_GRID; ++i)
        grid[i] = gsdi_grid_link(spatial, i >> 8, (i >> 4) & 15u, i & 15u);
}

/* Counts of nodes and tables that a tree needs. */
static void gsdi_tree_shape(const gsd_desc *desc, gsdi_tree *tree, uint32_t groups)
{
    tree->groups = groups;
    tree->leaves = 3 * groups + 1;
    tree->jump = groups > 0;
    tree->alias = groups && desc->alias ? tree->leaves : 0;
}

/* Give every tree its place: root, groups, tables; from the shapes that gsdi_tree_shape left in trees. False: more
   than 32 bits of nodes. */
static bool gsdi_block_places(gsdi_tree *trees, uint32_t count, gsdi_block *shape)
{
    uint64_t nodes = 4, jumps = 0, aliases = 0;
    uint32_t t;
    for (t = 0; t < count; ++t)
        trees[t].root = trees[t].groups ? (uint32_t)nodes++ : 0;
    nodes = (nodes + 3) & ~(uint64_t)3;
    shape->roots = (uint32_t)nodes;
    for (t = 0; t < count; ++t) {
        trees[t].first = (uint32_t)nodes;
        nodes += (uint64_t)trees[t].groups * 4;
        jumps += trees[t].jump ? GSDI_BINS : 0;
        trees[t].jump = trees[t].jump ? (uint32_t)jumps : 0; /* offset 0 means none: the first table is left empty */
        if (trees[t].alias) {
            trees[t].alias = (uint32_t)aliases;
            aliases += trees[t].leaves;
        }
        if (nodes > 0xfffffff0u || aliases > 0xfffffff0u || jumps > 0xffffff00u)
            return false;
    }
    shape->trees = count;
    shape->nodes = (uint32_t)nodes;
    shape->jumps = (uint32_t)jumps + GSDI_BINS;
    shape->aliases = (uint32_t)aliases;
    return true;
}

/* Means of the directions in each bin: with r(z) = sqrt(1 - z^2), the mean of r over z by its integral, of cos phi and
   sin phi likewise. */
static void gsdi_bin_means(float *bins)
{
    uint32_t i;
    for (i = 0; i < GSDI_BINS; ++i) {
        double z0 = (i >> 3) * 0.25 - 1, z1 = z0 + 0.25, width = 0.78539816339744831, p = (i & 7u) * width,
               q = p + width;
        double r = 2 * (z1 * sqrt(1 - z1 * z1) + asin(z1) - z0 * sqrt(1 - z0 * z0) - asin(z0));
        bins[i] = (float)(r * (sin(q) - sin(p)) / width);
        bins[i + GSDI_BINS] = (float)(r * (cos(p) - cos(q)) / width);
        bins[i + 2 * GSDI_BINS] = (float)(0.5 * (z0 + z1));
    }
}

/* Copies of the uniform leaf in the reserved nodes. */
static void gsdi_block_uniform(gsdi_block *b)
{
    gsd_node *nodes = gsdi_nodes(b);
    uint32_t i;
    gsdi_bin_means(gsdi_floats(b, b->bins_at));
    for (i = 0; i < b->roots; ++i) {
        nodes[i].leaf.child = 0;
        nodes[i].leaf.pdf = GSD_INV_4PI;
        nodes[i].leaf.x = nodes[i].leaf.y = 0;
    }
}

/* Where bin i of a tree begins: its node of depth 3 or the leaf above, and the learned probability of the bin. */
static uint32_t gsdi_tree_bin(const gsd_node *nodes, uint32_t root, uint32_t i, float *mass)
{
    uint32_t node = root, k;
    *mass = 1;
    for (k = 0; k < 3 && nodes[node].inner.child; ++k) {
        uint32_t bx = (i >> (2 - k)) & 1u, by = (i >> (5 - k)) & 1u;
        float sx = nodes[node].inner.split[0], sy = nodes[node].inner.split[1 + bx];
        *mass *= (bx ? 1 - sx : sx) * (by ? 1 - sy : sy);
        node = nodes[node].inner.child + bx + 2 * by;
    }
    for (; k < 3; ++k)
        *mass *= 0.25f;
    return node;
}

static void gsdi_tree_jumps(gsdi_block *b, const gsdi_tree *tree)
{
    uint32_t *jumps = gsdi_words(b, b->jumps_at) + tree->jump, i;
    float *masses = gsdi_floats(b, b->masses_at) + tree->jump;
    for (i = 0; tree->jump && i < GSDI_BINS; ++i)
        jumps[i] = gsdi_tree_bin(gsdi_nodes(b), tree->root, i, &masses[i]);
}

/* Alias table [Walker 1977] over the leaves. The share of leaf l is its learned mass; slots are filled in node order
   with two stacks that share the `other` fields. */
static void gsdi_tree_aliases(gsdi_block *b, const gsdi_tree *tree)
{
    const gsd_node *nodes = gsdi_nodes(b);
    gsd_alias *slots = (gsd_alias *)(void *)((char *)b + b->aliases_at) + tree->alias;
    double e = (double)b->uniform, rest = 0; /* of the large leaf at hand: small ones take from it often */
    uint32_t n = 0, i, small = GSDI_NONE, large = GSDI_NONE, current = GSDI_NONE;
    for (i = tree->first; i < tree->first + tree->groups * 4; ++i) {
        const gsd_node *node = &nodes[i];
        double area, mass;
        if (node->leaf.child)
            continue;
        area = 12.566370614359172 / (double)((uint64_t)1 << (2 * (node->leaf.x >> 24)));
        mass = ((double)node->leaf.pdf - e * (double)GSD_INV_4PI) / (1 - e) * area * (double)tree->leaves;
        slots[n].node = i;
        slots[n].threshold = (float)(mass > 0 ? mass : 0);
        if (slots[n].threshold < 1) {
            slots[n].other = small;
            small = n++;
        } else {
            slots[n].other = large;
            large = n++;
        }
    }
    while (small != GSDI_NONE && large != GSDI_NONE) {
        uint32_t s = small, l = large;
        small = slots[s].other;
        slots[s].other = slots[l].node;
        if (l != current) {
            current = l;
            rest = (double)slots[l].threshold;
        }
        rest -= 1 - (double)slots[s].threshold;
        if (rest < 1) {
            slots[l].threshold = (float)rest;
            large = slots[l].other;
            slots[l].other = small;
            small = l;
        }
    }
    for (i = 0; i < 2; ++i) /* what rounding left over */
        for (n = i ? small : large; n != GSDI_NONE;) {
            uint32_t next = slots[n].other;
            slots[n].threshold = 1;
            slots[n].other = slots[n].node;
            n = next;
        }
}

/* Write a sampling tree from plain masses. child: relative, as in the building part. Shares are taken of samples * mass
   + even: see gsd_desc.smoothing. */
static void gsdi_tree_write(gsdi_block *b, gsdi_tree *tree, const uint32_t *child, const double *mass, double samples,
                            double even)
{
    struct gsdi_open {
        uint32_t node, out, x, y, depth;
        double pdf; /* learned, of the node as if it were a leaf */
    } stack[GSDI_STACK];
    gsd_node *nodes = gsdi_nodes(b);
    uint32_t next = tree->first, k;
    double e = (double)b->uniform, mean = 0;
    int top = 0;
    memset(&stack[0], 0, sizeof stack[0]);
    stack[0].out = tree->root;
    stack[0].pdf = 0.07957747154594766788;
    tree->max_depth = 0;
    while (tree->groups && top >= 0) {
        struct gsdi_open o = stack[top--];
        gsd_node *out = &nodes[o.out];
        uint32_t c = child[o.node];
        double m[4], total, left, right;
        if (!c) {
            out->leaf.child = 0;
            out->leaf.pdf = (float)((1 - e) * o.pdf + e * 0.07957747154594766788);
            out->leaf.x = o.x | o.depth << 24;
            out->leaf.y = o.y;
            tree->max_depth = o.depth > tree->max_depth ? o.depth : tree->max_depth;
            mean += (double)o.depth * o.pdf * 12.566370614359172 / (double)((uint64_t)1 << (2 * o.depth));
            continue;
        }
        for (k = 0; k < 4; ++k)
            m[k] = samples * mass[c + k] + even;
        total = (m[0] + m[1]) + (m[2] + m[3]);
        left = m[0] + m[2];
        right = m[1] + m[3];
        out->inner.child = next;
        out->inner.split[0] = (float)(total > 0 ? left / total : 0.5);
        out->inner.split[1] = (float)(left > 0 ? m[0] / left : 0.5);
        out->inner.split[2] = (float)(right > 0 ? m[1] / right : 0.5);
        for (k = 4; k-- > 0;) { /* densities follow from the rounded shares: what is drawn is what pdf says */
            struct gsdi_open *s = &stack[++top];
            double sx = (double)out->inner.split[0], sy = (double)out->inner.split[1 + (k & 1)];
            double share = (k & 1 ? 1 - sx : sx) * (k & 2 ? 1 - sy : sy);
            s->node = c + k;
            s->out = next + k;
            s->depth = o.depth + 1;
            s->x = o.x + (k & 1) * (16777216u >> s->depth);
            s->y = o.y + (k >> 1) * (16777216u >> s->depth);
            s->pdf = o.pdf * share * 4;
        }
        next += 4;
    }
    tree->mean_depth = (float)mean;
    gsdi_tree_jumps(b, tree);
    if (b->aliases)
        gsdi_tree_aliases(b, tree);
}

/* Copy a tree from another block to its new place. */
static void gsdi_tree_copy(gsdi_block *b, gsdi_tree *tree, gsdi_block *from, const gsdi_tree *old)
{
    gsd_node *nodes = gsdi_nodes(b);
    const gsd_node *source = gsdi_nodes(from);
    uint32_t i;
    if (!tree->groups)
        return;
    nodes[tree->root] = source[old->root];
    memcpy(nodes + tree->first, source + old->first, (size_t)tree->groups * 4 * sizeof(gsd_node));
    nodes[tree->root].inner.child += tree->first - old->first;
    for (i = tree->first; i < tree->first + tree->groups * 4; ++i)
        if (nodes[i].inner.child)
            nodes[i].inner.child += tree->first - old->first;
    tree->max_depth = old->max_depth;
    tree->mean_depth = old->mean_depth;
    gsdi_tree_jumps(b, tree);
    if (b->aliases)
        gsdi_tree_aliases(b, tree);
}

/* ---- >>refine ----------------------------------------------------------------------------------------------- */

/* What refine decides about an old cell. */
typedef struct gsdi_job {
    double blur;           /* of its tree; 0 = not denoised */
    double limit_mass;     /* total mass of its building tree */
    uint32_t rebuild;      /* 1: new sampling tree from the building tree */
    uint32_t denoise;      /* 1: blur it first */
    uint32_t height;       /* Gaussian: halvings of the deepest leaf */
    uint32_t groups;       /* of that tree */
    uint32_t nodes;        /* of the next building tree */
    uint32_t tree;         /* index of its sampling tree in the new block */
    uint32_t copy;         /* 1: this job copies that tree from the old block */
    const uint32_t *child; /* its building tree: the field's, or the one that the Gaussian denoiser made of it */
    const gsdi_sum *sum;
    double *mass;
    void *made; /* memory of such a tree */
} gsdi_job;

/* Building nodes of the new cells that have one sampling tree: all, and of the smallest; a single leaf counts 0. */
typedef struct gsdi_need {
    uint64_t nodes, least;
} gsdi_need;

/* A cell of the new part. */
typedef struct gsdi_place {
    uint32_t source; /* old cell */
    uint32_t first, count;
    uint32_t origin[3], level;
    uint32_t samples; /* of the source's bins that fall in here */
} gsdi_place;

typedef struct gsdi_refinement {
    gsd_field *field;
    const gsd_desc *desc;
    const gsd_pass *pass; /* or NULL */
    bool second_moment, clear;
    gsd_target target; /* of the next pass */
    gsd_denoise_mode denoise;
    double all_samples, held_samples;
    double rho, keep, split;
    double fade;          /* of the gate's sums */
    gsdi_job *jobs;       /* [old cells] */
    double *mass;         /* [building nodes] */
    unsigned char *depth; /* [building nodes] */
    float *blur;          /* [GSDI_BLUR_FLOATS * building nodes], while denoising */
    uint64_t blur_bytes;  /* most that denoising held, gone when the structure is planned */
    uint64_t made_bytes;  /* of the trees that the Gaussian denoiser made, until the new part stands */
    gsdi_place *places;   /* [cells] */
    uint32_t old_cells;   /* [jobs] */
    uint32_t cells, cell_limit, place_capacity;
    uint32_t *spatial; /* [spatial_count] */
    uint32_t spatial_count, spatial_capacity;
    gsdi_tree *trees;
    gsdi_need *needs; /* [trees] */
    uint32_t tree_count;
    uint32_t *old_tree; /* [old trees]: index in the new block + 1 */
    gsdi_block shape;   /* of the new block */
    void *memory;
    gsdi_block *block;
    gsdi_state *states;
    uint32_t *child;
    gsdi_sum *sum;
    gsd_stats stats;
} gsdi_refinement;

static void gsdi_refinement_free(gsdi_refinement *r)
{
    uint32_t c;
    for (c = 0; r->jobs && c < r->old_cells; ++c)
        gsdi_release(r->desc, r->jobs[c].made);
    gsdi_release(r->desc, r->jobs);
    gsdi_release(r->desc, r->mass);
    gsdi_release(r->desc, r->depth);
    gsdi_release(r->desc, r->places);
    gsdi_release(r->desc, r->spatial);
    gsdi_release(r->desc, r->trees);
    gsdi_release(r->desc, r->needs);
    gsdi_release(r->desc, r->old_tree);
    gsdi_release(r->desc, r->memory);
    gsdi_release(r->desc, r->states);
    gsdi_release(r->desc, r->child);
    gsdi_release(r->desc, r->sum);
}

static uint64_t gsdi_bytes(const gsdi_block *b, uint64_t building_nodes)
{
    return b->size + 64 + building_nodes * (sizeof(uint32_t) + sizeof(gsdi_sum)) + b->cells * sizeof(gsdi_state) +
           sizeof(gsd_field);
}

static void gsdi_step(const gsdi_refinement *r, const char *step)
{
    if (r->pass && r->pass->on_step)
        r->pass->on_step(r->pass->on_step_user, step);
}

/* Work on an old cell's building tree as the field has it. */
static void gsdi_job_old_tree(const gsdi_refinement *r, uint32_t c)
{
    const gsdi_state *s = &r->field->states[c];
    gsdi_job *job = &r->jobs[c];
    job->child = r->field->child + s->first;
    job->sum = r->field->sum + s->first;
    job->mass = r->mass + s->first;
    job->groups = (s->count - 1) / 4;
}

/* Masses of the old cells' building trees; whether to rebuild. */
static void gsdi_measure(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    uint32_t c;
    for (c = begin; c < end; ++c) {
        const gsdi_state *s = &r->field->states[c];
        gsdi_job *job = &r->jobs[c];
        job->nodes = s->count;
        gsdi_job_old_tree(r, c);
        if (s->fresh <= 0)
            continue;
        job->limit_mass = gsdi_tree_masses(job->child, r->field->sum + s->first, s->count, r->second_moment, job->mass,
                                           r->depth + s->first);
        job->rebuild = s->held >= (double)r->desc->min_samples && job->limit_mass > 1e-280;
    }
}

static void gsdi_denoise_range(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    uint32_t c;
    for (c = begin; c < end; ++c) {
        const gsdi_state *s = &r->field->states[c];
        gsdi_job *job = &r->jobs[c];
        gsdi_blur b;
        if (!job->denoise)
            continue;
        b = gsdi_blur_make(r->blur + GSDI_BLUR_FLOATS * (size_t)s->first, s->count, job->mass);
        job->blur = gsdi_blur_tree(job->child, job->sum, r->depth + s->first, s->count, r->second_moment, &b);
        job->limit_mass = b.mass[0];
    }
}

static uint32_t gsdi_building_leaves(const gsdi_state *s) { return s->count - (s->count - 1) / 4; }

/* Choose the trees to denoise: all that are divided or, over the budget, an even selection that starts elsewhere in
   every pass. False = none. */
static bool gsdi_denoise_choose(gsdi_refinement *r)
{
    gsd_stats *stats = &r->stats;
    bool any = false;
    uint32_t cells = r->field->block->cells, i, c = (uint32_t)((uint64_t)cells * (r->field->passes % 8) / 8);
    double allowed = GSDI_BLUR_FREE + (double)r->desc->denoise_budget * (double)stats->samples, needed = 0, due = 0;
    allowed = fmax(allowed - (double)stats->denoised_leaves, 0);
    for (i = 0; i < cells; ++i)
        needed += r->jobs[i].rebuild && r->field->states[i].count > 1 ? gsdi_building_leaves(&r->field->states[i]) : 0;
    for (i = 0; i < cells; ++i, c = c + 1 < cells ? c + 1 : 0) {
        double leaves = gsdi_building_leaves(&r->field->states[c]);
        if (!r->jobs[c].rebuild || r->field->states[c].count == 1)
            continue;
        due += needed > allowed ? leaves * (allowed / needed) : leaves;
        if (due < leaves) {
            stats->over_budget_trees++;
            continue;
        }
        due -= leaves;
        r->jobs[c].denoise = 1;
        stats->denoised_leaves += (uint64_t)leaves;
        any = true;
    }
    return any;
}

/* Move the masses of the old cells' building trees towards their surroundings. False = out of memory. */
static bool gsdi_denoise(gsdi_refinement *r, gsd_parallel_fn parallel, void *user)
{
    uint32_t cells = r->field->block->cells, i;
    double blur = 0;
    if (gsdi_denoise_choose(r)) {
        r->blur_bytes = r->field->building_nodes * (uint64_t)GSDI_BLUR_FLOATS * sizeof(float);
        r->blur = (float *)gsdi_allocate(r->desc, r->field->building_nodes, GSDI_BLUR_FLOATS * sizeof(float));
        if (!r->blur)
            return false;
        gsdi_run(parallel, user, cells, 16, gsdi_denoise_range, r);
        gsdi_release(r->desc, r->blur);
    }
    for (i = 0; i < cells; ++i) {
        r->stats.denoised_trees += r->jobs[i].blur > 0;
        blur += r->jobs[i].blur;
    }
    r->stats.smooth_trees = r->stats.rebuilt_trees - r->stats.denoised_trees - r->stats.over_budget_trees;
    if (r->stats.rebuilt_trees)
        r->stats.mean_blur = (float)(blur / r->stats.rebuilt_trees);
    return true;
}

/* Bytes that refine holds beside the old and the new part. */
static uint64_t gsdi_refine_scratch(const gsdi_block *old, uint64_t nodes, uint64_t places, uint64_t spatial)
{
    return old->cells * sizeof(gsdi_job) + nodes * (sizeof(double) + 1) + places * sizeof(gsdi_place) + spatial * 4 +
           ((uint64_t)old->cells + 1) * (sizeof(gsdi_tree) + sizeof(gsdi_need)) + old->trees * sizeof(uint32_t);
}

/* Bytes of the parts that refine replaces, with their room to grow. */
static uint64_t gsdi_old_bytes(const gsd_field *f)
{
    return gsdi_bytes(f->block, f->node_capacity) + (f->state_capacity - f->block->cells) * sizeof(gsdi_state);
}

/* The Gaussian denoiser at work on some trees at once. */
typedef struct gsdi_gauss {
    gsdi_refinement *r;
    gsdi_gauss_slot slot[GSDI_GAUSS_SLOTS];
    uint32_t slots, used; /* there are; with a tree in them */
    uint32_t chosen;      /* trees */
    uint32_t depth;       /* of the deepest */
    uint32_t next;        /* cell to look at */
    uint64_t made_limit;  /* bytes */
    float w[4];
} gsdi_gauss;

static void gsdi_gauss_measure(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    uint32_t c;
    for (c = begin; c < end; ++c) {
        const gsdi_state *s = &r->field->states[c];
        if (!r->jobs[c].rebuild)
            continue;
        gsdi_gauss_heights(r->jobs[c].child, s->count, r->depth + s->first); /* depths were for the masses only */
        r->jobs[c].height = r->depth[s->first];
    }
}

/* Choose the trees: in the order of the cells, each that is neither too deep nor more work than is left. What a tree
   and its slot may take of max_bytes does not depend on how many are blurred at once. */
static void gsdi_gauss_choose(gsdi_gauss *g)
{
    gsdi_refinement *r = g->r;
    const gsd_field *f = r->field;
    uint64_t held = gsdi_old_bytes(f) + gsdi_refine_scratch(f->block, f->building_nodes, 0, 0), bytes[5];
    uint64_t room = r->desc->max_bytes > held ? (r->desc->max_bytes - held) / 2 : 0, cap = r->desc->max_bytes / 4, each;
    bool limit = !r->desc->gaussian_no_limit;
    double left = ldexp(GSDI_GAUSS_WORK, f->passes < 900 ? (int)f->passes : 900);
    uint32_t c;
    g->made_limit = room < cap / 2 ? room : cap / 2;
    room = room < cap ? room : cap;
    for (c = 0; c < r->old_cells; ++c) {
        gsdi_job *job = &r->jobs[c];
        double work = gsdi_gauss_work(job->height);
        if (!job->rebuild)
            continue;
        if (job->height < GSDI_GAUSS_FIRST) {
            r->stats.shallow_trees++;
        } else if (job->height > (limit ? GSDI_GAUSS_DEEPEST : GSDI_GAUSS_MOST)) {
            r->stats.deep_trees++;
        } else if ((limit && work > left) || gsdi_gauss_parts(job->height, bytes) > room) {
            r->stats.over_budget_trees++;
        } else {
            left -= work;
            job->denoise = 1;
            g->chosen++;
            g->depth = job->height > g->depth ? job->height : g->depth;
        }
    }
    if (!g->chosen)
        return;
    each = gsdi_gauss_parts(g->depth, bytes);
    g->slots = g->chosen < GSDI_GAUSS_SLOTS ? g->chosen : GSDI_GAUSS_SLOTS;
    g->slots = (uint64_t)g->slots * each > room ? (uint32_t)(room / each) : g->slots;
    r->blur_bytes = g->slots * each;
}

/* Memory of the slots; one is enough where nothing runs beside it. */
static bool gsdi_gauss_open(gsdi_gauss *g, bool parallel)
{
    const gsd_desc *desc = g->r->desc;
    uint64_t bytes[5], each = gsdi_gauss_parts(g->depth, bytes);
    uint32_t i;
    g->slots = parallel ? g->slots : 1;
    for (i = 0; i < g->slots; ++i) {
        g->slot[i].memory = desc->allocate(desc->user, (size_t)each); /* not zeroed: all is written before it is read */
        if (!g->slot[i].memory)
            return false;
        gsdi_gauss_slot_cut(&g->slot[i], g->depth);
    }
    return true;
}

static void gsdi_gauss_blur_range(void *context, uint32_t begin, uint32_t end)
{
    gsdi_gauss *g = (gsdi_gauss *)context;
    const gsdi_refinement *r = g->r;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        gsdi_gauss_slot *slot = &g->slot[i];
        const gsdi_job *job = &r->jobs[slot->cell];
        gsdi_gauss_blur(slot, job->child, job->mass, r->depth + r->field->states[slot->cell].first, r->desc->simd,
                        r->desc->gaussian_sphere, g->w);
        slot->nodes = gsdi_gauss_rebuild(slot, (double)r->desc->gaussian_rho, job->child, job->sum, NULL, NULL, NULL);
    }
}

/* Bytes of a tree of so many nodes: masses, sums, children. */
static uint64_t gsdi_made_bytes(uint64_t nodes)
{
    return nodes * (sizeof(double) + sizeof(gsdi_sum) + sizeof(uint32_t));
}

/* Memory for the trees of the slots; those for which there is no room are left alone. */
static bool gsdi_gauss_make(gsdi_gauss *g)
{
    gsdi_refinement *r = g->r;
    uint32_t i;
    for (i = 0; i < g->used; ++i) {
        gsdi_gauss_slot *slot = &g->slot[i];
        uint64_t bytes = gsdi_made_bytes(slot->nodes);
        if (slot->nodes == 0 || r->made_bytes + bytes > g->made_limit)
            continue;
        r->jobs[slot->cell].made = r->desc->allocate(r->desc->user, (size_t)bytes);
        if (!r->jobs[slot->cell].made)
            return false;
        r->made_bytes += bytes;
    }
    return true;
}

static void gsdi_gauss_make_range(void *context, uint32_t begin, uint32_t end)
{
    gsdi_gauss *g = (gsdi_gauss *)context;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        const gsdi_gauss_slot *slot = &g->slot[i];
        gsdi_job *job = &g->r->jobs[slot->cell];
        double *mass = (double *)job->made;
        gsdi_sum *sum;
        uint32_t *child;
        if (!mass)
            continue;
        sum = (gsdi_sum *)(void *)(mass + slot->nodes);
        child = (uint32_t *)(void *)(sum + slot->nodes);
        gsdi_gauss_rebuild(slot, (double)g->r->desc->gaussian_rho, job->child, job->sum, child, sum, mass);
        gsdi_gauss_normalise(child, mass, slot->nodes, job->limit_mass);
        job->child = child;
        job->sum = sum;
        job->mass = mass;
        job->groups = (slot->nodes - 1) / 4;
    }
}

/* Put the next trees into the slots; false = there are none. */
static bool gsdi_gauss_fill(gsdi_gauss *g)
{
    for (g->used = 0; g->next < g->r->old_cells && g->used < g->slots; ++g->next)
        if (g->r->jobs[g->next].denoise) {
            gsdi_gauss_slot *slot = &g->slot[g->used++];
            slot->cell = g->next;
            slot->depth = g->r->jobs[g->next].height;
        }
    return g->used > 0;
}

/* Make blurred trees of the old cells' building trees. Allocations are made between the parallel parts, one for each
   tree, so that neither they nor the result depend on the number of slots. False = out of memory. */
static bool gsdi_gauss_denoise(gsdi_refinement *r, gsd_parallel_fn parallel, void *user)
{
    gsdi_gauss g;
    bool ok;
    uint32_t i;
    memset(&g, 0, sizeof g);
    g.r = r;
    gsdi_gauss_weights((double)r->desc->gaussian_sigma, g.w);
    gsdi_run(parallel, user, r->old_cells, 16, gsdi_gauss_measure, r);
    gsdi_gauss_choose(&g);
    if (!g.chosen)
        return true;
    for (ok = gsdi_gauss_open(&g, parallel != NULL); ok && gsdi_gauss_fill(&g);) {
        gsdi_run(parallel, user, g.used, 1, gsdi_gauss_blur_range, &g);
        ok = gsdi_gauss_make(&g);
        if (ok)
            gsdi_run(parallel, user, g.used, 1, gsdi_gauss_make_range, &g);
    }
    for (i = 0; i < g.slots; ++i)
        gsdi_release(r->desc, g.slot[i].memory);
    for (i = 0; i < r->old_cells; ++i)
        r->stats.denoised_trees += r->jobs[i].made != NULL;
    r->stats.over_budget_trees += g.chosen - r->stats.denoised_trees;
    return ok;
}

/* Take back half of the trees that the Gaussian denoiser made, the last ones. False: there is none. */
static bool gsdi_gauss_give_back(gsdi_refinement *r)
{
    uint32_t back = r->stats.denoised_trees - r->stats.denoised_trees / 2, c = r->old_cells, left = back;
    if (r->denoise != GSD_DENOISE_GAUSSIAN || !back)
        return false;
    while (left) {
        gsdi_job *job = &r->jobs[--c];
        if (!job->made)
            continue;
        r->made_bytes -= gsdi_made_bytes(job->groups * (uint64_t)4 + 1);
        gsdi_release(r->desc, job->made);
        job->made = NULL;
        gsdi_job_old_tree(r, c);
        --left;
    }
    r->stats.denoised_trees -= back;
    r->stats.over_budget_trees += back;
    return true;
}

/* Sizes of the next building trees at the present rho. */
static void gsdi_count_nodes(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    uint32_t c;
    for (c = begin; c < end; ++c) {
        gsdi_job *job = &r->jobs[c];
        if (job->rebuild)
            job->nodes = gsdi_refine_tree(job->child, job->sum, job->mass, r->rho * job->limit_mass, r->desc->max_depth,
                                          0, NULL, NULL);
    }
}

/* Samples in bins of a sub-cell of `levels` (<= 6) splits below a cell at `level`: bits of path, oldest first. */
static uint32_t gsdi_bin_samples(const uint32_t *bins, uint32_t level, uint32_t levels, uint32_t path)
{
    uint32_t mask = 0, want = 0, i, k, sum = 0;
    for (k = 0; k < levels; ++k) { /* bin index: x1 x0 y1 y0 z1 z0, high halves first */
        uint32_t axis = (level + k) % 3, bit = 1u << (5 - 2 * axis - k / 3);
        mask |= bit;
        want |= (path >> (levels - 1 - k)) & 1u ? bit : 0;
    }
    for (i = 0; i < 64; ++i)
        sum += (i & mask) == want ? bins[i] : 0;
    return sum;
}

/* Split one old cell as often as its bins ask for. The first part keeps the cell's number, others are appended. */
static void gsdi_split_cell(gsdi_refinement *r, uint32_t cell, uint32_t node)
{
    struct gsdi_part {
        uint32_t place, node, levels, path;
    } stack[16];
    const gsdi_state *s = &r->field->states[cell];
    int top = 0;
    stack[0].place = cell;
    stack[0].node = node;
    stack[0].levels = stack[0].path = 0;
    while (top >= 0) {
        struct gsdi_part p = stack[top--];
        gsdi_place *a = &r->places[p.place], *b;
        uint32_t axis = a->level % 3, k;
        if (!r->jobs[cell].rebuild || s->gate == GSD_GATE_CLOSED || p.levels == 6 || (double)a->samples <= r->split ||
            (double)a->samples * s->lit * GSDI_LIT < r->split * s->held || a->level >= r->desc->max_levels ||
            r->cells >= r->cell_limit || r->cells >= r->place_capacity)
            continue;
        r->stats.split_cells++;
        b = &r->places[r->cells];
        *b = *a;
        a->level = b->level = a->level + 1;
        b->origin[axis] += gsd_cell_extent(b->level, axis);
        p.path <<= 1;
        p.levels++;
        a->samples = gsdi_bin_samples(s->bins, s->level, p.levels, p.path);
        b->samples = gsdi_bin_samples(s->bins, s->level, p.levels, p.path | 1u);
        r->spatial[p.node] = r->spatial_count;
        for (k = 0; k < 2; ++k) {
            struct gsdi_part *next = &stack[++top];
            next->place = k ? r->cells : p.place;
            next->node = r->spatial_count + k;
            next->levels = p.levels;
            next->path = p.path | k;
            r->spatial[next->node] = GSD_CELL_BIT | next->place;
        }
        r->spatial_count += 2;
        r->cells++;
    }
}

/* How many parts splitting a cell can give at most: counts bins instead of building anything. */
static uint32_t gsdi_split_bound(const gsdi_refinement *r, const gsdi_state *s)
{
    double parts = r->split > 0 ? s->held / r->split : 0;
    parts = 6 * parts + 1; /* every split part holds more than `split`; at most 6 levels of them */
    return parts > 64 ? 64 : (uint32_t)parts;
}

/* The new cells, r->cell_limit at most; may be called again. False = out of memory. */
static bool gsdi_split_cells(gsdi_refinement *r)
{
    gsd_field *field = r->field;
    uint32_t old = field->block->cells, i, nodes = field->block->spatial;
    uint64_t capacity = 0;
    gsdi_release(r->desc, r->places);
    gsdi_release(r->desc, r->spatial);
    r->stats.split_cells = 0;
    for (i = 0; i < old; ++i)
        capacity += r->jobs[i].rebuild && !r->desc->forest_cells ? gsdi_split_bound(r, &field->states[i]) : 1;
    if (capacity > (uint64_t)r->cell_limit)
        capacity = r->cell_limit > old ? r->cell_limit : old;
    r->place_capacity = (uint32_t)capacity;
    r->spatial_capacity = nodes + 2 * (r->place_capacity - old);
    r->places = (gsdi_place *)gsdi_allocate(r->desc, r->place_capacity, sizeof *r->places);
    r->spatial = (uint32_t *)gsdi_allocate(r->desc, r->spatial_capacity, sizeof(uint32_t));
    if (!r->places || !r->spatial)
        return false;
    memcpy(r->spatial, gsdi_words(field->block, field->block->spatial_at), nodes * sizeof(uint32_t));
    r->spatial_count = nodes;
    r->cells = old;
    for (i = 0; i < old; ++i) {
        gsdi_place *p = &r->places[i];
        p->source = i;
        memcpy(p->origin, field->states[i].origin, sizeof p->origin);
        p->level = field->states[i].level;
        p->samples = gsdi_bin_samples(field->states[i].bins, 0, 0, 0);
    }
    if (!r->desc->forest_cells)
        for (i = 0; i < nodes; ++i)
            if (r->spatial[i] & GSD_CELL_BIT)
                gsdi_split_cell(r, r->spatial[i] & ~GSD_CELL_BIT, i);
    return true;
}

static uint32_t gsdi_cell_limit(const gsd_desc *desc)
{
    uint64_t limit = desc->max_bytes / 4 / (2 * sizeof(gsdi_state) + 16 * GSDI_BINS + 512);
    return limit < GSDI_MAX_CELLS ? (uint32_t)limit : GSDI_MAX_CELLS;
}

/* Where every new building tree goes; returns the total of nodes. */
static uint64_t gsdi_place_nodes(gsdi_refinement *r)
{
    uint64_t total = 0;
    uint32_t i;
    for (i = 0; i < r->tree_count; ++i) {
        r->needs[i].nodes = 0;
        r->needs[i].least = (uint64_t)-1;
    }
    for (i = 0; i < r->cells; ++i) {
        gsdi_place *p = &r->places[i];
        const gsdi_job *job = &r->jobs[p->source];
        gsdi_need *need = &r->needs[job->tree];
        uint64_t nodes;
        bool split = p->level != r->field->states[p->source].level;
        p->count = split && p->samples == 0 ? 1 : job->nodes; /* nothing seen there: start small */
        p->first = (uint32_t)total;
        total += p->count;
        nodes = p->count > 1 ? p->count : 0;
        need->nodes += nodes;
        need->least = nodes < need->least ? nodes : need->least;
    }
    return total;
}

/* Most bytes held at once while refine makes `block` and `nodes` building nodes. What denoising takes is gone by then,
   but for the trees that the Gaussian one made; the other takes no more than a new part with as many building nodes as
   the old one. */
static uint64_t gsdi_refine_peak(const gsdi_refinement *r, const gsdi_block *block, uint64_t nodes)
{
    const gsd_field *f = r->field;
    uint64_t next = gsdi_bytes(block, nodes) +
                    gsdi_refine_scratch(f->block, f->building_nodes, r->place_capacity, r->spatial_capacity);
    uint64_t blur = r->blur_bytes + gsdi_refine_scratch(f->block, f->building_nodes, 0, 0);
    return gsdi_old_bytes(f) + r->made_bytes + (next > blur ? next : blur);
}

/* Whether this refine stays under max_bytes, and the next one can. It can where there is room for sampling trees as
   large as any choice of cells to rebuild makes them and for building trees as they are now: if then no cell splits and
   all that is rebuilt shrinks to single leaves, the same holds for the refine after it, and so on. */
static bool gsdi_refine_fits(const gsdi_refinement *r, uint64_t nodes)
{
    uint64_t cap = r->desc->max_bytes, most = 8, places = gsdi_cell_limit(r->desc), jumps;
    gsdi_block now = r->shape, next;
    uint32_t t;
    for (t = 0; t < r->tree_count; ++t) { /* a tree that one cell keeps exists beside those that others build */
        uint64_t tree = r->trees[t].groups ? (uint64_t)r->trees[t].groups * 4 + 1 : 0, least = r->needs[t].least;
        most += r->needs[t].nodes + (tree > least ? tree - least : 0);
    }
    if (nodes >= 0xfffffff0u || most >= 0xfffffff0u)
        return false;
    gsdi_block_layout(&now);
    if (gsdi_refine_peak(r, &now, nodes) > cap)
        return false;
    places = places > r->cells ? places : r->cells;
    jumps = ((uint64_t)r->cells + 2) * GSDI_BINS; /* a tree for every cell */
    now.jumps = jumps < 0xffffff00u ? (uint32_t)jumps : 0xffffff00u;
    now.trees = r->cells + 1;
    next = now;
    next.nodes = (uint32_t)most;
    next.aliases = r->desc->alias ? (uint32_t)(most / 4 * 3) + r->cells : 0;
    gsdi_block_layout(&now);
    gsdi_block_layout(&next);
    return gsdi_bytes(&now, nodes) + gsdi_bytes(&next, nodes) +
               gsdi_refine_scratch(&now, nodes, places, now.spatial + 2 * (places - r->cells)) <=
           cap;
}

/* List the sampling trees of the new block: rebuilt ones, and old ones that some cell keeps. May be called again. */
static bool gsdi_list_trees(gsdi_refinement *r, gsdi_block *shape)
{
    gsdi_block *old = r->field->block;
    const gsdi_tree *old_trees = gsdi_trees(old);
    const gsd_cell *old_cells = gsdi_cells(old);
    uint32_t c;
    gsdi_release(r->desc, r->trees);
    gsdi_release(r->desc, r->old_tree);
    r->tree_count = 0;
    r->trees = (gsdi_tree *)gsdi_allocate(r->desc, (uint64_t)old->cells + 1, sizeof(gsdi_tree));
    r->old_tree = (uint32_t *)gsdi_allocate(r->desc, old->trees, sizeof(uint32_t));
    if (!r->trees || !r->old_tree)
        return false;
    gsdi_tree_shape(r->desc, &r->trees[r->tree_count++], 0); /* tree 0: uniform */
    r->old_tree[0] = 1;
    for (c = 0; c < old->cells; ++c) {
        gsdi_job *job = &r->jobs[c];
        uint32_t t = old_cells[c].tree;
        if (!job->rebuild && r->old_tree[t]) {
            job->tree = r->old_tree[t] - 1;
            continue;
        }
        job->tree = r->tree_count++;
        gsdi_tree_shape(r->desc, &r->trees[job->tree], job->rebuild ? job->groups : old_trees[t].groups);
        job->copy = !job->rebuild;
        if (job->copy)
            r->old_tree[t] = r->tree_count;
    }
    return gsdi_block_places(r->trees, r->tree_count, shape);
}

/* Sampling trees of old cells [begin, end). */
static void gsdi_write_trees(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    gsdi_block *old = r->field->block;
    uint32_t c;
    for (c = begin; c < end; ++c) {
        const gsdi_state *s = &r->field->states[c];
        const gsdi_job *job = &r->jobs[c];
        uint32_t t = gsdi_cells(old)[c].tree;
        if (job->rebuild)
            gsdi_tree_write(r->block, &r->trees[job->tree], job->child, job->mass, s->lit / job->limit_mass,
                            0.25 * (1 - job->blur) * (double)r->desc->smoothing);
        else if (job->copy)
            gsdi_tree_copy(r->block, &r->trees[job->tree], old, &gsdi_trees(old)[t]);
    }
}

/* What a cell of the block says to queries. */
static void gsdi_cell_write(gsdi_block *b, const gsdi_tree *trees, gsd_cell *cell, const gsdi_state *s, uint32_t tree,
                            const float pivot[3], float nearness)
{
    const gsdi_tree *t = &trees[tree];
    cell->root = t->root;
    cell->jump = t->jump;
    cell->alias = t->alias;
    cell->alias_count = b->aliases && t->groups ? t->leaves : 0;
    cell->tree = tree;
    cell->level = s->level;
    cell->gate = s->gate;
    cell->reflected = s->reflected;
    cell->depth = t->max_depth;
    memcpy(cell->pivot, pivot, sizeof cell->pivot);
    cell->nearness = cell->root ? nearness : 0;
    cell->reserved[0] = cell->reserved[1] = 0;
    cell->alpha = t->groups == 0 || s->gate == GSD_GATE_CLOSED ? 1.0f : s->alpha;
}

/* Where the sums of the next pass are seen from: see Parallax. */
static void gsdi_choose_pivot(const gsdi_block *b, gsdi_state *s)
{
    double size = 1 / (double)b->scale, radius = 0, reach = 0, middle[3];
    double nearness = s->mass > 0 ? s->near_mass / s->mass : 0, now = (double)s->nearness;
    bool own = true;
    uint32_t axis;
    for (axis = 0; axis < 3; ++axis) {
        double half = 0.5 * (double)gsd_cell_extent(s->level, axis) * size, far;
        middle[axis] = (double)b->origin[axis] + (double)s->origin[axis] * size + half;
        far = fabs(middle[axis] - (double)s->pivot[axis]) + half;
        own = own && (float)middle[axis] == s->pivot[axis];
        radius += half * half;
        reach += far * far;
    }
    nearness = fmin(nearness, GSDI_MOST_REACH / sqrt(radius));
    if (now > 0 && sqrt(reach) * now < (own ? 1.0001 * GSDI_MOST_REACH : GSDI_KEPT_REACH) && nearness < 2 * now &&
        now < 2 * nearness)
        return;
    for (axis = 0; axis < 3; ++axis)
        s->pivot[axis] = (float)middle[axis];
    s->nearness = (float)nearness;
}

/* State, building tree and query record of new cells [begin, end). */
static void gsdi_write_cells(void *context, uint32_t begin, uint32_t end)
{
    gsdi_refinement *r = (gsdi_refinement *)context;
    uint32_t i, k;
    for (i = begin; i < end; ++i) {
        const gsdi_place *p = &r->places[i];
        const gsdi_state *old = &r->field->states[p->source];
        const gsdi_job *job = &r->jobs[p->source];
        const gsd_cell *was = &gsdi_cells(r->field->block)[p->source];
        gsdi_state *s = &r->states[i];
        double total = 0, share, keep = 0;
        *s = *old;
        s->first = p->first;
        s->count = p->count;
        s->level = p->level;
        memcpy(s->origin, p->origin, sizeof s->origin);
        if (!job->rebuild) {
            memcpy(r->child + p->first, job->child, p->count * sizeof *r->child);
            memcpy(r->sum + p->first, job->sum, p->count * sizeof *r->sum);
        } else {
            for (k = 0; k < 64; ++k)
                total += (double)old->bins[k];
            share = total > 0 ? (double)p->samples / total : 1;
            share = p->level == old->level ? 1 : share;
            keep = r->keep * share;
            if (p->count > 1 || job->nodes == 1)
                gsdi_refine_tree(job->child, job->sum, job->mass, r->rho * job->limit_mass, r->desc->max_depth, keep,
                                 r->child + p->first, r->sum + p->first);
            s->held = old->held * keep;
            s->lit = old->lit * keep;
            if (!r->desc->forest_cells && r->field->passes > 0)
                gsdi_choose_pivot(r->block, s); /* before its mass fades, perhaps to nothing */
            s->mass *= r->keep;
            s->near_mass *= r->keep;
            s->rebuilds = old->rebuilds < 1000000u ? old->rebuilds + 1 : old->rebuilds;
            for (k = 0; k < 64; ++k)
                s->bins[k] = p->level == old->level ? (uint32_t)((double)old->bins[k] * r->keep) : 0;
            share = share < 0.01 ? 0.01 : share;
            gsdi_gate_scale(s, share);
        }
        if (r->clear) { /* another target: what waits is of no use */
            s->held = s->lit = s->mass = s->near_mass = 0;
            memset(s->bins, 0, sizeof s->bins);
            memset(r->sum + p->first, 0, p->count * sizeof *r->sum);
        }
        s->fresh = s->flow = 0;
        s->hits = 0;
        gsdi_cell_write(r->block, r->trees, &gsdi_cells(r->block)[i], s, job->tree,
                        job->rebuild ? old->pivot : was->pivot, job->rebuild ? old->nearness : was->nearness);
    }
}

/* Threshold of splitting, target, shares of the sums and of the gate's to keep. Growth of the last pass predicts the
   next one; half of all samples shall count in it. */
static void gsdi_pass_scale(gsdi_refinement *r, double samples)
{
    gsd_field *field = r->field;
    double first = field->passes ? field->first_pass_samples : samples, growth = 1;
    double all = field->all_samples + samples, held = field->held_samples + samples;
    if (field->last_pass_samples > 0)
        growth = samples / field->last_pass_samples;
    growth = growth > 1 ? growth < 2 ? growth : 2 : 1;
    r->fade = growth < 1.05 ? 0.95 : 1 / growth;
    if (r->desc->split_samples > 0)
        r->split = (double)r->desc->split_samples * sqrt(first > 0 && held > first ? held / first : 1);
    else
        r->split = fmax(GSDI_MIN_SPLIT, GSDI_SPLIT * sqrt(held));
    r->keep = held > 0 ? 0.5 * (all - growth * samples) / held : 0;
    r->keep = r->desc->no_history || r->keep < 0 ? 0 : r->keep < 1 ? r->keep : 1;
    r->target = (gsd_target)field->target;
    if (r->desc->target == GSD_TARGET_SWITCHING && all >= (double)r->desc->switch_after * first)
        r->target = GSD_TARGET_VARIANCE;
    r->clear = r->target != (gsd_target)field->target;
    r->keep = r->clear ? 0 : r->keep;
    r->all_samples = r->clear ? 0 : all;
    r->held_samples = r->keep * held;
}

/* Everything that refine allocates after the structure is known. */
static bool gsdi_refine_allocate(gsdi_refinement *r, uint32_t building_nodes)
{
    r->block = gsdi_block_allocate(r->desc, &r->shape, &r->memory);
    r->states = (gsdi_state *)gsdi_allocate(r->desc, r->cells, sizeof(gsdi_state));
    r->child = (uint32_t *)gsdi_allocate(r->desc, building_nodes, sizeof(uint32_t));
    r->sum = (gsdi_sum *)gsdi_allocate(r->desc, building_nodes, sizeof(gsdi_sum));
    return r->block && r->states && r->child && r->sum;
}

/* The new cells and the sizes of their trees: the largest that stay under the memory cap, with the trees that denoising
   left. Returns building nodes; *fits = they do. 0 = out of memory. */
static uint64_t gsdi_refine_structure(gsdi_refinement *r, gsd_parallel_fn parallel, void *user, bool *fits)
{
    uint32_t old = r->old_cells;
    uint64_t total;
    r->shape = *r->field->block;
    r->cell_limit = gsdi_cell_limit(r->desc);
    if (!gsdi_list_trees(r, &r->shape))
        return 0;
    do {
        if (!gsdi_split_cells(r))
            return 0;
        r->shape.cells = r->shape.cell_capacity = r->cells;
        r->shape.spatial = r->spatial_count;
        for (r->rho = (double)r->desc->rho;; r->rho *= r->rho < 0.9 ? 1.3 : 2) {
            gsdi_run(parallel, user, old, 16, gsdi_count_nodes, r);
            total = gsdi_place_nodes(r);
            *fits = gsdi_refine_fits(r, total);
            if (*fits || r->rho > 1) /* above 1 all trees are single leaves */
                break;
        }
        r->cell_limit = old + (r->cells - old) / 2;
    } while (!*fits && r->cells > old);
    return total;
}

/* Structure decisions of refine: judged cells, splits, rho under the memory cap. Returns building nodes, 0 = out of
   memory. */
static uint32_t gsdi_refine_plan(gsdi_refinement *r, gsd_parallel_fn parallel, void *user)
{
    gsd_field *field = r->field;
    uint32_t old = r->old_cells, i;
    uint64_t total;
    bool fits;
    gsdi_step(r, "measure");
    r->jobs = (gsdi_job *)gsdi_allocate(r->desc, old, sizeof *r->jobs);
    r->mass = (double *)gsdi_allocate(r->desc, field->building_nodes, sizeof(double));
    r->depth = (unsigned char *)gsdi_allocate(r->desc, field->building_nodes, 1);
    if (!r->jobs || !r->mass || !r->depth)
        return 0;
    gsdi_run(parallel, user, old, 16, gsdi_measure, r);
    for (i = 0; i < old; ++i) {
        const gsdi_state *s = &field->states[i];
        r->stats.rebuilt_trees += r->jobs[i].rebuild;
        r->stats.waiting_cells += !r->jobs[i].rebuild && s->fresh > 0;
        r->stats.unread_cells += !(s->fresh > 0);
    }
    if (r->denoise != GSD_DENOISE_OFF)
        gsdi_step(r, "denoise");
    if ((r->denoise == GSD_DENOISE_BLUR && !gsdi_denoise(r, parallel, user)) ||
        (r->denoise == GSD_DENOISE_GAUSSIAN && !gsdi_gauss_denoise(r, parallel, user)))
        return 0;
    gsdi_step(r, "split");
    r->needs = (gsdi_need *)gsdi_allocate(r->desc, (uint64_t)old + 1, sizeof *r->needs);
    if (!r->needs)
        return 0;
    do { /* what the Gaussian denoiser made is larger than what the last refine left room for */
        total = gsdi_refine_structure(r, parallel, user, &fits);
        if (!total)
            return 0;
    } while (!fits && gsdi_gauss_give_back(r));
    r->stats.effective_rho = (float)r->rho;
    return total < 0xfffffff0u ? (uint32_t)total : 0;
}

/* Hash of cells and building trees. */
static uint64_t gsdi_structure_hash(const gsdi_state *states, uint32_t cells, const uint32_t *child, uint32_t nodes)
{
    uint64_t h = 0x243f6a8885a308d3ull;
    uint32_t i;
    for (i = 0; i < cells; ++i) {
        const gsdi_state *s = &states[i];
        h = gsdi_hash(h, (uint64_t)s->first << 32 | s->count);
        h = gsdi_hash(h, (uint64_t)s->origin[0] << 32 | s->origin[1]);
        h = gsdi_hash(h, (uint64_t)s->origin[2] << 32 | s->level);
        h = gsdi_hash_bytes(h, s->pivot, sizeof s->pivot); /* sums that are seen from elsewhere do not add up */
        h = gsdi_hash_bytes(h, &s->nearness, sizeof s->nearness);
    }
    return gsdi_hash_bytes(h, child, (size_t)nodes * sizeof *child);
}

/* After a change of structure: its id, and how many cells guide. */
static void gsdi_field_changed(gsd_field *field)
{
    const gsd_cell *cells = gsdi_cells(field->block);
    uint32_t i;
    field->guiding = 0;
    for (i = 0; i < field->block->cells; ++i)
        field->guiding += cells[i].alpha < 1;
    field->structure = gsdi_structure_hash(field->states, field->block->cells, field->child, field->building_nodes);
}

/* The gate's verdicts, and how the pass's samples are spread over them. */
static void gsdi_judge_cells(gsdi_refinement *r, const gsd_pass *pass, double samples)
{
    bool pixels = pass && pass->pixel_estimate, changed = r->field->passes > 0 && pixels != (r->field->pixels != 0);
    double closed = 0, alpha = 0;
    uint32_t i;
    for (i = 0; i < r->field->block->cells; ++i) {
        gsdi_state *s = &r->field->states[i];
        if (s->fresh >= GSDI_REFLECTED_SAMPLES)
            s->reflected = (float)fmin(s->flow / s->fresh, 1e30); /* a loaded sum may be larger */
        if (s->fresh > 0)
            gsdi_judge(r->desc, pixels, changed, r->fade, s, &r->stats);
        closed += s->gate == GSD_GATE_CLOSED ? s->fresh : 0;
        alpha += s->gate == GSD_GATE_CLOSED ? s->fresh : s->fresh * (double)s->alpha;
    }
    r->field->pixels = pixels;
    if (samples > 0) {
        r->stats.closed_share = (float)(closed / samples);
        r->stats.mean_alpha = (float)(alpha / samples);
    }
}

/* Make the new parts the field's, free the old. */
static void gsdi_refine_commit(gsdi_refinement *r, uint32_t nodes, double samples)
{
    gsd_field *field = r->field;
    uint64_t peak = gsdi_refine_peak(r, r->block, nodes);
    r->stats.peak_bytes = peak > r->stats.peak_bytes ? peak : r->stats.peak_bytes;
    r->stats.passes++;
    gsdi_release(r->desc, field->memory);
    gsdi_release(r->desc, field->states);
    gsdi_release(r->desc, field->child);
    gsdi_release(r->desc, field->sum);
    field->memory = r->memory;
    field->block = r->block;
    field->states = r->states;
    field->child = r->child;
    field->sum = r->sum;
    field->building_nodes = field->node_capacity = nodes;
    field->state_capacity = r->cells;
    if (field->passes == 0)
        field->first_pass_samples = samples;
    field->last_pass_samples = samples;
    field->all_samples = r->all_samples;
    field->held_samples = r->held_samples;
    field->target = (uint32_t)r->target;
    field->passes++;
    field->stats = r->stats;
    gsdi_field_changed(field);
    r->memory = NULL;
    r->states = NULL;
    r->child = NULL;
    r->sum = NULL;
    gsdi_refinement_free(r);
}

GSD_API gsd_result gsd_refine(gsd_field *field, const gsd_pass *pass, gsd_parallel_fn parallel, void *user)
{
    gsdi_refinement r;
    uint32_t nodes, i;
    double samples = 0;
    memset(&r, 0, sizeof r);
    r.field = field;
    r.desc = &field->desc;
    r.pass = pass;
    r.denoise = pass && pass->denoise ? pass->denoise : r.desc->denoise;
    if ((unsigned)r.denoise > GSD_DENOISE_GAUSSIAN)
        return GSD_BAD_OPTION;
    r.old_cells = field->block->cells;
    r.stats = field->stats;
    r.stats.split_cells = r.stats.rebuilt_trees = r.stats.waiting_cells = r.stats.unread_cells = 0;
    r.stats.denoised_trees = r.stats.smooth_trees = r.stats.over_budget_trees = 0;
    r.stats.shallow_trees = r.stats.deep_trees = 0;
    r.stats.mean_blur = 0;
    r.second_moment = field->target != GSD_TARGET_RADIANCE;
    for (i = 0; i < field->block->cells; ++i)
        samples += field->states[i].fresh;
    gsdi_pass_scale(&r, samples);
    nodes = gsdi_refine_plan(&r, parallel, user);
    if (!nodes || !gsdi_refine_allocate(&r, nodes)) {
        gsdi_refinement_free(&r);
        return GSD_OUT_OF_MEMORY;
    }
    /* nothing can fail from here */
    gsdi_step(&r, "build");
    gsdi_judge_cells(&r, pass, samples);
    gsdi_block_uniform(r.block);
    memcpy(gsdi_words(r.block, r.block->spatial_at), r.spatial, r.spatial_count * sizeof(uint32_t));
    gsdi_block_grid(r.block);
    gsdi_run(parallel, user, field->block->cells, 16, gsdi_write_trees, &r);
    gsdi_run(parallel, user, r.cells, 16, gsdi_write_cells, &r);
    memcpy((char *)r.block + r.block->trees_at, r.trees, r.tree_count * sizeof(gsdi_tree));
    gsdi_refine_commit(&r, nodes, samples);
    gsdi_step(&r, NULL);
    return GSD_OK;
}

/* ---- >>life ------------------------------------------------------------------------------------------------- */

GSD_API const char *gsd_result_string(gsd_result result)
{
#define GSD_RESULT_TEXT(name, text) text,
    static const char *const texts[] = {GSD_RESULTS(GSD_RESULT_TEXT) ""};
#undef GSD_RESULT_TEXT
    return (unsigned)result < (unsigned)GSD_RESULT_COUNT ? texts[result] : "unknown result";
}

/* The best level of this machine, or the pinned one; GSD_SIMD_AUTO where that is not available. */
static gsd_simd gsdi_simd(gsd_simd wanted)
{
#if GSDI_X86
    bool avx2, avx512;
    __builtin_cpu_init();
    avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
             __builtin_cpu_supports("avx512vl");
    if (wanted == GSD_SIMD_AUTO)
        return avx512 ? GSD_SIMD_AVX512 : avx2 ? GSD_SIMD_AVX2 : GSD_SIMD_SCALAR;
    if ((wanted == GSD_SIMD_AVX2 && !avx2) || (wanted == GSD_SIMD_AVX512 && !avx512) || wanted == GSD_SIMD_NEON)
        return GSD_SIMD_AUTO;
    return wanted;
#elif GSDI_NEON
    if (wanted == GSD_SIMD_AUTO)
        return GSD_SIMD_NEON;
    return wanted == GSD_SIMD_NEON || wanted == GSD_SIMD_SCALAR ? wanted : GSD_SIMD_AUTO;
#else
    return wanted == GSD_SIMD_AUTO || wanted == GSD_SIMD_SCALAR ? GSD_SIMD_SCALAR : GSD_SIMD_AUTO;
#endif
}

static void gsdi_default_u32(uint32_t *x, uint32_t value) { *x = *x ? *x : value; }
static void gsdi_default_float(float *x, float value) { *x = *x != 0 ? *x : value; }
static bool gsdi_within(double x, double low, double high) { return x >= low && x <= high; }

static bool gsdi_bounds_ok(const gsd_desc *d)
{
    double extent = 0;
    int i;
    for (i = 0; i < 3; ++i) {
        double e = (double)d->bounds_max[i] - (double)d->bounds_min[i];
        if (!(e >= 0) || !(e < 1e30) || !(fabsf(d->bounds_min[i]) < 1e30f))
            return false;
        extent = e > extent ? e : extent;
    }
    return extent > 1e-30;
}

GSD_API gsd_result gsd_resolve(const gsd_desc *desc, gsd_desc *resolved)
{
    gsd_desc d = *desc;
    if (!d.allocate != !d.release)
        return GSD_BAD_ALLOCATOR;
    if (!d.allocate) {
        d.allocate = gsdi_default_allocate;
        d.release = gsdi_default_release;
    }
    d.target = d.target ? d.target : GSD_TARGET_SWITCHING;
    d.spatial_filter = d.spatial_filter ? d.spatial_filter : GSD_SPATIAL_NEAREST;
    d.directional_filter = d.directional_filter ? d.directional_filter : GSD_DIRECTIONAL_BOX;
    d.alpha_mode = d.alpha_mode ? d.alpha_mode : GSD_ALPHA_GRID;
    d.denoise = d.denoise ? d.denoise : GSD_DENOISE_BLUR;
    gsdi_default_float(&d.denoise_budget, 0.25f);
    gsdi_default_float(&d.switch_after, 4);
    gsdi_default_float(&d.rho, 0.01f);
    gsdi_default_float(&d.gaussian_sigma, 0.8f);
    gsdi_default_float(&d.gaussian_rho, d.rho);
    gsdi_default_float(&d.smoothing, 3);
    gsdi_default_u32(&d.max_depth, 16);
    gsdi_default_u32(&d.max_levels, 48);
    gsdi_default_u32(&d.min_samples, 16);
    d.max_bytes = d.max_bytes ? d.max_bytes : (uint64_t)1 << 30;
    gsdi_default_float(&d.alpha, 0.5f);
    gsdi_default_float(&d.uniform, 0.01f);
    gsdi_default_float(&d.gate_margin, 0.05f);
    gsdi_default_float(&d.gate_gain, 0.25f);
    gsdi_default_u32(&d.gate_probe, 1);
    if ((unsigned)d.target > GSD_TARGET_SWITCHING || (unsigned)d.spatial_filter > GSD_SPATIAL_STOCHASTIC ||
        (unsigned)d.directional_filter > GSD_DIRECTIONAL_BOX || (unsigned)d.alpha_mode > GSD_ALPHA_GRID ||
        (unsigned)d.denoise > GSD_DENOISE_GAUSSIAN || (unsigned)d.simd > GSD_SIMD_NEON)
        return GSD_BAD_OPTION;
    d.simd = gsdi_simd(d.simd);
    if (d.simd == GSD_SIMD_AUTO)
        return GSD_BAD_OPTION;
    if (!gsdi_within((double)d.switch_after, 0.99e-3, 1e6) || !gsdi_within((double)d.smoothing, 0.99e-3, 1000) ||
        !gsdi_within((double)d.denoise_budget, 0.99e-3, 1e6) || !gsdi_within((double)d.gaussian_sigma, 0.099, 100) ||
        !gsdi_within((double)d.gaussian_rho, 0.99e-5, 1) ||
        (d.split_samples != 0 && !gsdi_within((double)d.split_samples, 16, 1e9)) ||
        !gsdi_within((double)d.rho, 0.99e-5, 1) || !gsdi_within(d.max_depth, 1, 20) ||
        !gsdi_within(d.max_levels, 1, 60) || !gsdi_within((double)d.alpha, 0.0499, 1) ||
        !gsdi_within((double)d.uniform, 0.99e-4, 1) || !gsdi_within((double)d.gate_margin, 0.99e-3, 10) ||
        !gsdi_within((double)d.gate_gain, 0.99e-4, 1000) || !gsdi_within(d.gate_probe, 1, 1000) ||
        d.max_bytes < 1u << 20 || d.forest_cells > GSDI_MAX_CELLS)
        return GSD_BAD_RANGE;
    if (!d.forest_cells && !gsdi_bounds_ok(&d))
        return GSD_BAD_BOUNDS;
    *resolved = d;
    return GSD_OK;
}

/* Nodes of the even tree that a cell starts with. */
static uint32_t gsdi_start_nodes(uint32_t depth) { return ((4u << (2 * depth)) - 1) / 3; }

static void gsdi_start_tree(uint32_t *child, uint32_t depth)
{
    uint32_t i, inner = depth ? gsdi_start_nodes(depth - 1) : 0, total = gsdi_start_nodes(depth);
    for (i = 0; i < total; ++i)
        child[i] = i < inner ? 4 * i + 1 : 0;
}

static void gsdi_start_state(const gsd_desc *desc, gsdi_state *s, uint32_t first, uint32_t count)
{
    memset(s, 0, sizeof *s);
    s->first = first;
    s->count = count;
    s->alpha = desc->alpha;
    s->theta = desc->alpha < 0.98f ? logf(desc->alpha / (1 - desc->alpha)) : 4;
}

/* Depth of the starting trees: finer for the one cell of a spatial tree, since pass 0 learns only what it resolves. */
static uint32_t gsdi_start_depth(const gsd_desc *desc)
{
    uint32_t depth = desc->forest_cells ? 3 : 4;
    return depth < desc->max_depth ? depth : desc->max_depth;
}

static void gsdi_block_space(const gsd_desc *desc, gsdi_block *shape)
{
    double extent = 0;
    int i;
    for (i = 0; i < 3; ++i)
        extent = fmax(extent, (double)desc->bounds_max[i] - (double)desc->bounds_min[i]);
    extent *= 1.001;
    extent = extent > 0 ? extent : 1;
    for (i = 0; i < 3; ++i)
        shape->origin[i] = (float)(0.5 * ((double)desc->bounds_min[i] + (double)desc->bounds_max[i]) - 0.5 * extent);
    shape->scale = (float)(16777216.0 / extent);
    shape->uniform = desc->uniform;
}

GSD_API gsd_result gsd_create(const gsd_desc *desc, gsd_field **out)
{
    gsd_desc d;
    gsd_field *field;
    gsdi_block shape;
    gsdi_tree uniform;
    gsd_result result;
    uint32_t cells, nodes, depth, i;
    *out = NULL;
    result = gsd_resolve(desc, &d);
    if (result)
        return result;
    field = (gsd_field *)gsdi_allocate(&d, 1, sizeof *field);
    if (!field)
        return GSD_OUT_OF_MEMORY;
    field->desc = d;
    field->target = (uint32_t)(d.target == GSD_TARGET_SWITCHING ? GSD_TARGET_SIMPLE : d.target);
    cells = d.forest_cells ? d.forest_cells : 1;
    depth = gsdi_start_depth(&d);
    nodes = gsdi_start_nodes(depth);
    memset(&shape, 0, sizeof shape);
    memset(&uniform, 0, sizeof uniform);
    gsdi_tree_shape(&d, &uniform, 0);
    gsdi_block_places(&uniform, 1, &shape);
    gsdi_block_space(&d, &shape);
    shape.cells = cells;
    shape.spatial = 1;
    field->block = gsdi_block_allocate(&d, &shape, &field->memory);
    field->states = (gsdi_state *)gsdi_allocate(&d, cells, sizeof *field->states);
    field->child = (uint32_t *)gsdi_allocate(&d, (uint64_t)cells * nodes, sizeof(uint32_t));
    field->sum = (gsdi_sum *)gsdi_allocate(&d, (uint64_t)cells * nodes, sizeof(gsdi_sum));
    if (!field->block || !field->states || !field->child || !field->sum || (uint64_t)cells * nodes > 0xfffffff0u) {
        gsd_destroy(field);
        return GSD_OUT_OF_MEMORY;
    }
    gsdi_block_uniform(field->block);
    memcpy((char *)field->block + field->block->trees_at, &uniform, sizeof uniform);
    gsdi_words(field->block, field->block->spatial_at)[0] = GSD_CELL_BIT;
    gsdi_block_grid(field->block);
    field->building_nodes = field->node_capacity = cells * nodes;
    field->state_capacity = cells;
    for (i = 0; i < cells; ++i) {
        gsdi_start_state(&d, &field->states[i], i * nodes, nodes);
        gsdi_start_tree(field->child + (size_t)i * nodes, depth);
        gsdi_cell_write(field->block, &uniform, &gsdi_cells(field->block)[i], &field->states[i], 0,
                        field->states[i].pivot, 0);
    }
    field->stats.peak_bytes = gsdi_bytes(field->block, field->building_nodes);
    field->stats.effective_rho = d.rho;
    field->stats.mean_alpha = 1;
    gsdi_field_changed(field);
    *out = field;
    return GSD_OK;
}

GSD_API void gsd_destroy(gsd_field *field)
{
    gsd_desc desc;
    if (!field)
        return;
    desc = field->desc;
    gsdi_release(&desc, field->memory);
    gsdi_release(&desc, field->states);
    gsdi_release(&desc, field->child);
    gsdi_release(&desc, field->sum);
    gsdi_release(&desc, field->scratch);
    gsdi_release(&desc, field);
}

GSD_API const gsd_desc *gsd_get_desc(const gsd_field *field) { return &field->desc; }
GSD_API uint32_t gsd_cell_count(const gsd_field *field) { return field->block->cells; }
GSD_API uint64_t gsd_structure_id(const gsd_field *field) { return field->structure; }
GSD_API bool gsd_all_closed(const gsd_field *field) { return field->guiding == 0; }

GSD_API float gsd_record_fraction(const gsd_field *field)
{
    float open = 1 - field->stats.closed_share;
    return field->passes == 0 || open > 0.5f ? 1.0f : open + (1 - open) / 64;
}

GSD_API void gsd_get_stats(const gsd_field *field, gsd_stats *stats)
{
    gsdi_block *b = field->block;
    const gsdi_tree *trees = gsdi_trees(b);
    const gsd_cell *cells = gsdi_cells(b);
    double depth = 0, learned = 0;
    uint32_t i;
    *stats = field->stats;
    stats->cells = b->cells;
    stats->trees = b->trees;
    stats->nodes = stats->leaves = 0;
    stats->building_nodes = field->building_nodes;
    stats->bytes = gsdi_bytes(b, field->node_capacity);
    stats->max_depth = 0;
    for (i = 0; i < b->trees; ++i) {
        stats->nodes += trees[i].groups * 4 + 1;
        stats->leaves += trees[i].leaves;
        stats->max_depth = trees[i].max_depth > stats->max_depth ? trees[i].max_depth : stats->max_depth;
        depth += trees[i].groups ? (double)trees[i].mean_depth : 0;
        learned += trees[i].groups ? 1 : 0;
    }
    stats->mean_depth = learned > 0 ? (float)(depth / learned) : 0;
    stats->open_cells = stats->closed_cells = stats->unjudged_cells = 0;
    for (i = 0; i < b->cells; ++i) {
        stats->open_cells += cells[i].gate == GSD_GATE_OPEN;
        stats->closed_cells += cells[i].gate == GSD_GATE_CLOSED;
        stats->unjudged_cells += cells[i].gate == GSD_GATE_UNJUDGED;
    }
}

/* ---- >>forest ----------------------------------------------------------------------------------------------- */

/* Grow the cells of block and states to `cells`, and the building arrays by `nodes`. Capacity doubles. */
static bool gsdi_forest_reserve(gsd_field *field, uint32_t cells, uint64_t nodes)
{
    const gsd_desc *d = &field->desc;
    uint64_t wanted = field->building_nodes + nodes;
    if (wanted > 0xfffffff0u)
        return false;
    if (cells > field->state_capacity) {
        uint32_t capacity = cells + cells / 2;
        gsdi_state *states = (gsdi_state *)gsdi_allocate(d, capacity, sizeof *states);
        if (!states)
            return false;
        memcpy(states, field->states, field->block->cells * sizeof *states);
        gsdi_release(d, field->states);
        field->states = states;
        field->state_capacity = capacity;
    }
    if (cells > field->block->cell_capacity) {
        gsdi_block shape = *field->block, *block;
        void *memory;
        shape.cell_capacity = cells + cells / 2;
        block = gsdi_block_allocate(d, &shape, &memory); /* the same offsets: cells come last */
        if (!block)
            return false;
        memcpy((char *)block + sizeof *block, (char *)field->block + sizeof *block,
               (size_t)field->block->size - sizeof *block);
        gsdi_release(d, field->memory);
        field->memory = memory;
        field->block = block;
    }
    if (wanted > field->node_capacity) {
        uint64_t capacity = wanted + wanted / 2 < 0xfffffff0u ? wanted + wanted / 2 : wanted;
        uint32_t *child = (uint32_t *)gsdi_allocate(d, capacity, sizeof *child);
        gsdi_sum *sum = (gsdi_sum *)gsdi_allocate(d, capacity, sizeof *sum);
        if (!child || !sum) {
            gsdi_release(d, child);
            gsdi_release(d, sum);
            return false;
        }
        memcpy(child, field->child, field->building_nodes * sizeof *child);
        memcpy(sum, field->sum, field->building_nodes * sizeof *sum);
        gsdi_release(d, field->child);
        gsdi_release(d, field->sum);
        field->child = child;
        field->sum = sum;
        field->node_capacity = (uint32_t)capacity;
    }
    return true;
}

/* Make `cell` a copy of `from` at the end of the building arrays. */
static void gsdi_forest_copy(gsd_field *field, uint32_t cell, uint32_t from)
{
    gsdi_state *s = &field->states[cell];
    *s = field->states[from];
    memcpy(field->child + field->building_nodes, field->child + s->first, s->count * sizeof(uint32_t));
    memcpy(field->sum + field->building_nodes, field->sum + s->first, s->count * sizeof(gsdi_sum));
    s->first = field->building_nodes;
    field->building_nodes += s->count;
    field->guiding -= gsdi_cells(field->block)[cell].alpha < 1;
    gsdi_cells(field->block)[cell] = gsdi_cells(field->block)[from];
    field->guiding += gsdi_cells(field->block)[cell].alpha < 1;
}

GSD_API gsd_result gsd_forest_split(gsd_field *field, uint32_t parent, uint32_t child_a, uint32_t child_b)
{
    uint32_t old = field->block->cells, cells, depth = gsdi_start_depth(&field->desc), i, k;
    uint32_t nodes = gsdi_start_nodes(depth), children[2];
    gsdi_state *s;
    if (!field->desc.forest_cells)
        return GSD_NOT_A_FOREST;
    if (parent >= old || child_a == child_b || child_a >= GSDI_MAX_CELLS || child_b >= GSDI_MAX_CELLS)
        return GSD_BAD_CELL;
    cells = child_a > child_b ? child_a + 1 : child_b + 1;
    cells = cells > old ? cells : old;
    if (!gsdi_forest_reserve(field, cells, (uint64_t)(cells - old) * nodes + 2ull * field->states[parent].count))
        return GSD_OUT_OF_MEMORY;
    for (i = old; i < cells; ++i) {
        gsdi_start_state(&field->desc, &field->states[i], field->building_nodes, nodes);
        gsdi_start_tree(field->child + field->building_nodes, depth);
        memset(field->sum + field->building_nodes, 0, nodes * sizeof(gsdi_sum));
        field->building_nodes += nodes;
        gsdi_cell_write(field->block, gsdi_trees(field->block), &gsdi_cells(field->block)[i], &field->states[i], 0,
                        field->states[i].pivot, 0);
    }
    field->block->cells = cells;
    s = &field->states[parent];
    for (i = 0; i < s->count; ++i)
        for (k = 0; k < 2; ++k)
            field->sum[s->first + i].half[k] *= 0.5;
    s->held *= 0.5;
    s->lit *= 0.5;
    s->fresh *= 0.5;
    s->flow *= 0.5;
    gsdi_gate_scale(s, 0.5);
    children[0] = child_a;
    children[1] = child_b;
    for (k = 0; k < 2; ++k)
        if (children[k] != parent)
            gsdi_forest_copy(field, children[k], parent);
    field->structure = gsdi_hash(gsdi_hash(field->structure, (uint64_t)child_a << 32 | child_b), parent);
    return GSD_OK;
}

/* ---- >>batches ---------------------------------------------------------------------------------------------- */

#define GSDI_LANES 64u /* queries in flight; 16 and 32 wait for memory longer */

static uint32_t gsdi_at(const uint32_t *index, uint32_t i) { return index ? index[i] : i; }
static const float *gsdi_row(const float *base, size_t stride, uint32_t row)
{
    return (const float *)(const void *)((const char *)base + stride * row);
}
static float *gsdi_row_out(float *base, size_t stride, uint32_t row)
{
    return (float *)(void *)((char *)base + stride * row);
}

#if GSDI_X86
/* A row of eight bins: gsd_bin_cosine times mass; normal[3]: lift. */
GSDI_AVX2 static __m256 gsdi_bin_row_avx2(const gsd_view *view, const __m256 normal[4], const float *mass, uint32_t k)
{
    __m256 mean[3];
    uint32_t axis;
    for (axis = 0; axis < 3; ++axis)
        mean[axis] = _mm256_loadu_ps(view->bins + axis * GSDI_BINS + k);
    return _mm256_mul_ps(_mm256_loadu_ps(mass + k), gsdi_cosine_avx2(normal, mean, normal[3]));
}

/* gsd_orient. */
GSDI_AVX2 static void gsdi_orient_avx2(const gsd_view *view, gsd_handle *handle, const float *n)
{
    __m256 normal[4], z = _mm256_setzero_ps();
    float s[8], l = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    uint32_t k;
    if (handle->jump == 0 || handle->alpha >= 1 || !(l > 0.5f && l < 2))
        return;
    for (k = 0; k < 3; ++k)
        normal[k] = _mm256_set1_ps(n[k]);
    normal[3] = _mm256_set1_ps(gsd_lift(handle->offset, n));
    for (k = 0; k < GSDI_BINS; k += 8)
        z = _mm256_add_ps(z, gsdi_bin_row_avx2(view, normal, view->masses + handle->jump, k));
    _mm256_storeu_ps(s, z);
    memcpy(handle->normal, n, sizeof handle->normal);
    handle->product = 1 / (((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7])));
}

/* gsd_bin_weights. */
GSDI_AVX2 static void gsdi_bin_weights_avx2(const gsd_view *view, const gsd_handle *handle, float *weight, float *row)
{
    __m256 normal[4], w[8], a, b;
    uint32_t k;
    for (k = 0; k < 3; ++k)
        normal[k] = _mm256_set1_ps(handle->normal[k]);
    normal[3] = _mm256_set1_ps(gsd_lift(handle->offset, handle->normal));
    for (k = 0; k < 8; ++k) {
        w[k] = gsdi_bin_row_avx2(view, normal, view->masses + handle->jump, k * 8);
        _mm256_storeu_ps(weight + k * 8, w[k]);
    }
    a = _mm256_hadd_ps(_mm256_hadd_ps(w[0], w[1]), _mm256_hadd_ps(w[2], w[3]));
    b = _mm256_hadd_ps(_mm256_hadd_ps(w[4], w[5]), _mm256_hadd_ps(w[6], w[7]));
    _mm_storeu_ps(row, _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1)));
    _mm_storeu_ps(row + 4, _mm_add_ps(_mm256_castps256_ps128(b), _mm256_extractf128_ps(b, 1)));
}
#endif

/* Inline queries for what the lanes leave over, in the same bits. */
GSDI_FLATTEN static void gsdi_orient_one(const gsd_view *view, gsd_handle *handle, const float *normal)
{
    gsd_orient(view, handle, normal);
}
#if GSDI_X86
GSDI_FLATTEN static float gsdi_pdf_one(const gsd_view *view, const gsd_handle *handle, const float *direction)
{
    return gsd_pdf(view, handle, direction);
}
GSDI_FLATTEN static float gsdi_sample_one(const gsd_view *view, const gsd_handle *handle, const float *u, float *out)
{
    return gsd_sample(view, handle, u, out);
}
#endif
GSDI_FLATTEN static float gsdi_oriented(const gsd_view *view, const gsd_handle *handle, float pdf, uint32_t x,
                                        uint32_t y, float scale)
{
    return gsd_oriented(view, handle, pdf, x, y, scale);
}

static void gsdi_orient(const gsd_view *view, gsd_handle *handle, const float *normal)
{
#if GSDI_X86
    if (view->simd >= GSD_SIMD_AVX2) {
        gsdi_orient_avx2(view, handle, normal);
        return;
    }
#endif
    gsdi_orient_one(view, handle, normal);
}

GSD_API void gsd_find_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gsd_handle *handles, float *alpha)
{
    uint32_t start, i, k, axis;
    for (start = 0; start < count; start += GSDI_LANES) {
        uint32_t n = count - start < GSDI_LANES ? count - start : GSDI_LANES;
        uint32_t cell[GSDI_LANES], g[GSDI_LANES][3];
        for (i = 0; i < n; ++i) {
            const float *p = gsdi_row(positions, position_stride, gsdi_at(index, start + i));
            for (axis = 0; axis < 3; ++axis)
                g[i][axis] = gsd_grid_coordinate(p[axis], view->origin[axis], view->scale);
            GSDI_PREFETCH(&view->grid[(g[i][0] >> 20) << 8 | (g[i][1] >> 20) << 4 | g[i][2] >> 20]);
        }
        for (i = 0; i < n; ++i) {
            if (u) {
                uint32_t at = gsdi_at(index, start + i);
                cell[i] =
                    gsd_find(view, gsdi_row(positions, position_stride, at), NULL, gsdi_row(u, u_stride, at)).cell;
            } else {
                cell[i] = gsd_cell_at(view, g[i]);
            }
            GSDI_PREFETCH(&view->cells[cell[i]]);
        }
        for (i = 0; i < n; ++i) {
            uint32_t at = gsdi_at(index, start + i);
            handles[at] = gsd_find_cell(view, cell[i]);
            gsd_see_from(view, &handles[at], gsdi_row(positions, position_stride, at));
            if (alpha)
                alpha[at] = handles[at].alpha;
            for (k = 0; normals && k < GSDI_BINS; k += 16)
                GSDI_PREFETCH(view->masses + handles[at].jump + k);
        }
        for (i = 0; normals && i < n; ++i) {
            uint32_t at = gsdi_at(index, start + i);
            gsdi_orient(view, &handles[at], gsdi_row(normals, normal_stride, at));
        }
    }
}

/* Descend up to 64 trees together, one level of each in turn; node[i] ends at a leaf. Where a tree ends is anyone's
   guess: no branches. */
static void gsdi_descend(const gsd_view *view, uint32_t n, uint32_t *node, const uint32_t *x, const uint32_t *y,
                         uint32_t *shift)
{
    uint32_t lane[GSDI_LANES], active = n, i;
    for (i = 0; i < n; ++i)
        lane[i] = i;
    while (active) {
        uint32_t left = 0;
        for (i = 0; i < active; ++i) {
            uint32_t l = lane[i], at = node[l], child = view->nodes[at].inner.child, inner = 0u - (child != 0);
            uint32_t s = --shift[l], next = child + ((x[l] >> s) & 1u) + 2 * ((y[l] >> s) & 1u);
            node[l] = at ^ ((at ^ next) & inner);
            GSDI_PREFETCH(&view->nodes[node[l]]);
            lane[left] = l;
            left -= inner;
        }
        active = left;
    }
}

/* Up to 64 densities on their way, as arrays. */
typedef struct gsdi_looks {
    uint32_t at[GSDI_LANES]; /* index of the query */
    uint32_t node[GSDI_LANES], x[GSDI_LANES], y[GSDI_LANES], shift[GSDI_LANES];
    float scale[GSDI_LANES], pdf[GSDI_LANES], even[GSDI_LANES]; /* of the leaf; without a product */
} gsdi_looks;

/* Coordinates in the quadtree, of queries from i on: one, or eight. */
GSDI_FLATTEN static void gsdi_look(gsdi_looks *k, uint32_t i, const gsd_handle *handles, const float *directions,
                                   size_t stride)
{
    float seen[3];
    k->scale[i] = gsd_to_pivot(handles[k->at[i]].offset, gsdi_row(directions, stride, k->at[i]), seen);
    gsd_coordinates(seen, &k->x[i], &k->y[i]);
}

#if GSDI_X86
GSDI_AVX2 static void gsdi_look_avx2(gsdi_looks *k, uint32_t i, const gsd_handle *handles, const float *directions,
                                     size_t stride)
{
    const void *row[8];
    float in[3][8];
    __m256 offset[4], d[3], seen[3], apart, scale = _mm256_set1_ps(1);
    __m256i x, y;
    uint32_t l, axis;
    for (l = 0; l < 8; ++l) {
        const float *direction = gsdi_row(directions, stride, k->at[i + l]);
        row[l] = &handles[k->at[i + l]].product; /* and offset */
        for (axis = 0; axis < 3; ++axis)
            in[axis][l] = direction[axis];
    }
    gsdi_columns_avx2(row, offset);
    for (axis = 0; axis < 3; ++axis)
        d[axis] = _mm256_loadu_ps(in[axis]);
    apart = gsdi_apart_avx2(offset + 1);
    if (_mm256_movemask_ps(apart)) {
        scale = gsdi_to_pivot_avx2(offset + 1, d, seen);
        for (axis = 0; axis < 3; ++axis)
            d[axis] = _mm256_blendv_ps(d[axis], seen[axis], apart);
    }
    gsdi_coordinates_avx2(d, &x, &y);
    _mm256_storeu_ps(&k->scale[i], scale);
    _mm256_storeu_si256((__m256i *)(void *)&k->x[i], x);
    _mm256_storeu_si256((__m256i *)(void *)&k->y[i], y);
}

/* gsd_oriented without a product, of eight. */
GSDI_AVX2 static void gsdi_even_avx2(const float *pdf, const float *scale, float uniform, float *out)
{
    __m256 even = _mm256_set1_ps(uniform * GSD_INV_4PI), leaf = _mm256_loadu_ps(pdf), s = _mm256_loadu_ps(scale), p;
    p = _mm256_mul_ps(_mm256_max_ps(_mm256_sub_ps(leaf, even), _mm256_setzero_ps()), s);
    p = _mm256_blendv_ps(_mm256_add_ps(p, even), leaf, _mm256_cmp_ps(s, _mm256_set1_ps(1), _CMP_EQ_OQ));
    _mm256_storeu_ps(out, p);
}
#endif

GSD_API void gsd_pdf_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const gsd_handle *handles,
                           const float *directions, size_t direction_stride, float *pdf)
{
    uint32_t start, i, eights = 0;
    for (start = 0; start < count; start += GSDI_LANES) {
        uint32_t n = count - start < GSDI_LANES ? count - start : GSDI_LANES;
        gsdi_looks k;
        for (i = 0; i < n; ++i)
            k.at[i] = gsdi_at(index, start + i);
#if GSDI_X86
        eights = view->simd >= GSD_SIMD_AVX2 ? n & ~7u : 0;
        for (i = 0; i < eights; i += 8)
            gsdi_look_avx2(&k, i, handles, directions, direction_stride);
#endif
        for (i = eights; i < n; ++i)
            gsdi_look(&k, i, handles, directions, direction_stride);
        for (i = 0; i < n; ++i) {
            const gsd_handle *h = &handles[k.at[i]];
            k.shift[i] = h->jump;
            k.node[i] = h->jump ? h->jump + (k.y[i] >> 21) * 8 + (k.x[i] >> 21) : h->root;
            if (h->jump)
                GSDI_PREFETCH(&view->jumps[k.node[i]]);
            else
                GSDI_PREFETCH(&view->nodes[k.node[i]]);
        }
        for (i = 0; i < n; ++i) {
            if (k.shift[i]) {
                k.node[i] = view->jumps[k.node[i]];
                GSDI_PREFETCH(&view->nodes[k.node[i]]);
            }
            k.shift[i] = k.shift[i] ? 21 : 24;
        }
        gsdi_descend(view, n, k.node, k.x, k.y, k.shift);
        for (i = 0; i < n; ++i)
            k.pdf[i] = view->nodes[k.node[i]].leaf.pdf;
#if GSDI_X86
        for (i = 0; i < eights; i += 8)
            gsdi_even_avx2(&k.pdf[i], &k.scale[i], view->uniform, &k.even[i]);
#endif
        for (i = 0; i < n; ++i) {
            const gsd_handle *h = &handles[k.at[i]];
            bool done = i < eights && !(h->product > 0);
            pdf[k.at[i]] = done ? k.even[i] : gsdi_oriented(view, h, k.pdf[i], k.x[i], k.y[i], k.scale[i]);
        }
    }
}

/* State of one sampling query. */
typedef struct gsdi_draw {
    double r[2], lo[2], width[2];
    uint32_t node, bin;
} gsdi_draw;

/* Follow the inverse distribution of up to 64 draws to leaves, one level of each in turn; see gsd_sample. */
static void gsdi_draw_descend(const gsd_view *view, uint32_t n, gsdi_draw *draws, const bool *tree)
{
    uint32_t lane[GSDI_LANES], active = 0, i;
    for (i = 0; i < n; ++i)
        if (tree[i])
            lane[active++] = i;
    while (active) {
        uint32_t left = 0;
        for (i = 0; i < active; ++i) {
            gsdi_draw *d = &draws[lane[i]];
            const gsd_node *node = &view->nodes[d->node];
            uint32_t child = node->inner.child, bx, by;
            double w;
            if (!child)
                continue;
            w = d->width[0] * (double)node->inner.split[0];
            bx = (uint32_t)(d->r[0] >= d->lo[0] + w) & (uint32_t)(w < d->width[0]);
            d->lo[0] = bx ? d->lo[0] + w : d->lo[0];
            d->width[0] = bx ? d->width[0] - w : w;
            w = d->width[1] * (double)node->inner.split[1 + bx];
            by = (uint32_t)(d->r[1] >= d->lo[1] + w) & (uint32_t)(w < d->width[1]);
            d->lo[1] = by ? d->lo[1] + w : d->lo[1];
            d->width[1] = by ? d->width[1] - w : w;
            d->node = child + bx + 2 * by;
            GSDI_PREFETCH(&view->nodes[d->node]);
            lane[left++] = lane[i];
        }
        active = left;
    }
    for (i = 0; i < n; ++i)
        if (tree[i]) {
            draws[i].r[0] = (draws[i].r[0] - draws[i].lo[0]) / draws[i].width[0];
            draws[i].r[1] = (draws[i].r[1] - draws[i].lo[1]) / draws[i].width[1];
        }
}

/* Start one draw: 0 = uniform share (r is the place on the sphere), 1 = descend, 2 = alias slot in node, 3 = jump of a
   bin in node. */
static int gsdi_draw_start(const gsd_view *view, const gsd_handle *h, const float *u, gsdi_draw *d)
{
    double e = (double)view->uniform;
    gsd_extend_random(u, d->r);
    d->lo[0] = d->lo[1] = 0;
    d->width[0] = d->width[1] = 1;
    d->node = h->root;
    if (d->r[0] < e) {
        d->r[0] /= e;
        return 0;
    }
    d->r[0] = (d->r[0] - e) / (1 - e);
    d->r[0] = d->r[0] < 0.99999999988 ? d->r[0] : 0.99999999988;
    if (h->product > 0) {
        float weight[GSDI_BINS], row[8];
        gsd_bin_weights(view, h, weight, row);
        d->bin = gsd_choose_bin(weight, row, d->r);
        d->node = h->jump + d->bin;
        GSDI_PREFETCH(&view->jumps[d->node]);
        return 3;
    } else if (h->alias_count) {
        double slot = d->r[0] * (double)h->alias_count;
        d->node = h->alias + (uint32_t)slot;
        d->r[0] = slot - (double)(uint32_t)slot;
        GSDI_PREFETCH(&view->aliases[d->node]);
        return 2;
    }
    GSDI_PREFETCH(&view->nodes[d->node]);
    return 1;
}

/* Choose between the two leaves of an alias slot. */
static void gsdi_draw_alias(const gsd_view *view, gsdi_draw *d)
{
    const gsd_alias *a = &view->aliases[d->node];
    double t = (double)a->threshold;
    bool own = d->r[0] < t;
    d->r[0] = own ? d->r[0] / t : (d->r[0] - t) / (1 - t);
    d->node = own ? a->node : a->other;
    GSDI_PREFETCH(&view->nodes[d->node]);
}

#if GSDI_X86
/* Draws as arrays, in groups of eight. The steps are those of gsd_sample, in the same operations, so results
   are equal bit by bit. */
typedef struct gsdi_draws {
    double r[2][GSDI_LANES], lo[2][GSDI_LANES], width[2][GSDI_LANES];
    uint32_t bits[2][GSDI_LANES]; /* of u, 24 each; then [1]: the bin of a product */
    uint32_t node[GSDI_LANES];
    float out[3][GSDI_LANES], pdf[GSDI_LANES];
    float offset[3][GSDI_LANES], scale[GSDI_LANES]; /* of the handle; of gsd_to_pivot */
    float even[GSDI_LANES];                         /* density without a product */
    uint32_t edge[GSDI_LANES];                      /* not 0: near the leaf's edge */
    uint32_t deep[GSDI_LANES];                      /* not 0: the leaf lies within one bin */
} gsdi_draws;

/* Four 32-bit numbers without sign as doubles. */
GSDI_AVX2 static __m256d gsdi_u32_double(__m128i x)
{
    return _mm256_add_pd(_mm256_cvtepi32_pd(_mm_xor_si128(x, _mm_set1_epi32((int)0x80000000u))),
                         _mm256_set1_pd(2147483648.0));
}

/* gsd_extend_random, then r[0] without the uniform share. */
GSDI_AVX2 static void gsdi_extend_avx2(gsdi_draws *d, uint32_t lanes, double e)
{
    __m256d scale = _mm256_set1_pd(2.3283064365386963e-10);
    uint32_t i;
    for (i = 0; i < lanes; i += 4) {
        __m128i a = _mm_loadu_si128((const __m128i *)(const void *)&d->bits[0][i]);
        __m128i b = _mm_loadu_si128((const __m128i *)(const void *)&d->bits[1][i]), h, low = _mm_set1_epi32(255);
        h = _mm_xor_si128(
            _mm_mullo_epi32(a, _mm_set1_epi32((int)0x9e3779b1u)),
            _mm_add_epi32(_mm_mullo_epi32(b, _mm_set1_epi32((int)0x85ebca6bu)), _mm_set1_epi32(0x27d4eb2f)));
        h = _mm_mullo_epi32(_mm_xor_si128(h, _mm_srli_epi32(h, 15)), _mm_set1_epi32(0x2c1b3c6d));
        h = _mm_xor_si128(h, _mm_srli_epi32(h, 13));
        a = _mm_or_si128(_mm_slli_epi32(a, 8), _mm_and_si128(h, low));
        b = _mm_or_si128(_mm_slli_epi32(b, 8), _mm_and_si128(_mm_srli_epi32(h, 8), low));
        _mm256_storeu_pd(&d->r[1][i], _mm256_mul_pd(gsdi_u32_double(b), scale));
        _mm256_storeu_pd(
            &d->r[0][i],
            _mm256_min_pd(_mm256_div_pd(_mm256_sub_pd(_mm256_mul_pd(gsdi_u32_double(a), scale), _mm256_set1_pd(e)),
                                        _mm256_set1_pd(1 - e)),
                          _mm256_set1_pd(0.99999999988)));
    }
}

/* Eight nodes, their four words in columns. */
GSDI_AVX2_INLINE void gsdi_nodes_avx2(const gsd_node *nodes, const uint32_t *node, __m256 column[4])
{
    const void *at[8];
    uint32_t i;
    for (i = 0; i < 8; ++i)
        at[i] = &nodes[node[i]];
    gsdi_columns_avx2(at, column);
}

/* Narrow four intervals of one axis by split, where active; returns which took the upper half. */
GSDI_AVX2 static __m256d gsdi_narrow_avx2(const double *r, double *lo, double *width, __m256d split, __m256d active)
{
    __m256d l = _mm256_loadu_pd(lo), full = _mm256_loadu_pd(width), w = _mm256_mul_pd(full, split);
    __m256d middle = _mm256_add_pd(l, w), upper;
    upper = _mm256_and_pd(_mm256_cmp_pd(_mm256_loadu_pd(r), middle, _CMP_GE_OQ), _mm256_cmp_pd(w, full, _CMP_LT_OQ));
    _mm256_storeu_pd(lo, _mm256_blendv_pd(l, middle, _mm256_and_pd(upper, active)));
    _mm256_storeu_pd(width, _mm256_blendv_pd(full, _mm256_blendv_pd(w, _mm256_sub_pd(full, w), upper), active));
    return upper;
}

/* Masks of four doubles as four 32-bit masks. */
GSDI_AVX2 static __m128i gsdi_mask_avx2(__m256d mask)
{
    __m256i order = _mm256_setr_epi32(0, 2, 4, 6, 0, 2, 4, 6);
    return _mm256_castsi256_si128(_mm256_permutevar8x32_epi32(_mm256_castpd_si256(mask), order));
}

/* One level down for eight lanes; false when all are at leaves. */
GSDI_AVX2 static bool gsdi_step_avx2(const gsd_node *nodes, gsdi_draws *d, uint32_t lane)
{
    __m256 column[4];
    __m256i child, active, next;
    __m128i bx[2], by[2];
    uint32_t half, i;
    gsdi_nodes_avx2(nodes, &d->node[lane], column);
    child = _mm256_castps_si256(column[0]);
    active = _mm256_xor_si256(_mm256_cmpeq_epi32(child, _mm256_setzero_si256()), _mm256_set1_epi32(-1));
    if (_mm256_testz_si256(active, active))
        return false;
    for (half = 0; half < 2; ++half) {
        uint32_t at = lane + half * 4;
        __m256d act = _mm256_castsi256_pd(
            _mm256_cvtepi32_epi64(half ? _mm256_extracti128_si256(active, 1) : _mm256_castsi256_si128(active)));
        __m256d s0 = _mm256_cvtps_pd(half ? _mm256_extractf128_ps(column[1], 1) : _mm256_castps256_ps128(column[1]));
        __m256d s1 = _mm256_cvtps_pd(half ? _mm256_extractf128_ps(column[2], 1) : _mm256_castps256_ps128(column[2]));
        __m256d s2 = _mm256_cvtps_pd(half ? _mm256_extractf128_ps(column[3], 1) : _mm256_castps256_ps128(column[3]));
        __m256d x = gsdi_narrow_avx2(&d->r[0][at], &d->lo[0][at], &d->width[0][at], s0, act), y;
        y = gsdi_narrow_avx2(&d->r[1][at], &d->lo[1][at], &d->width[1][at], _mm256_blendv_pd(s1, s2, x), act);
        bx[half] = gsdi_mask_avx2(x);
        by[half] = gsdi_mask_avx2(y);
    }
    next = _mm256_sub_epi32(child, _mm256_inserti128_si256(_mm256_castsi128_si256(bx[0]), bx[1], 1));
    next =
        _mm256_sub_epi32(next, _mm256_slli_epi32(_mm256_inserti128_si256(_mm256_castsi128_si256(by[0]), by[1], 1), 1));
    next = _mm256_blendv_epi8(_mm256_loadu_si256((const __m256i *)(const void *)&d->node[lane]), next, active);
    _mm256_storeu_si256((__m256i *)(void *)&d->node[lane], next);
    for (i = 0; i < 8; ++i)
        GSDI_PREFETCH(&nodes[d->node[lane + i]]);
    return true;
}

/* Places in the leaves: coordinates r in units of 2^-24, whether near the edge, pdf. */
GSDI_AVX2 static void gsdi_leaves_avx2(const gsd_node *nodes, gsdi_draws *d, uint32_t lane)
{
    __m256 column[4];
    uint32_t half, k;
    gsdi_nodes_avx2(nodes, &d->node[lane], column);
    _mm256_storeu_ps(&d->pdf[lane], column[1]);
    for (half = 0; half < 2; ++half) {
        uint32_t at = lane + half * 4;
        __m128i xd = _mm_castps_si128(half ? _mm256_extractf128_ps(column[2], 1) : _mm256_castps256_ps128(column[2]));
        __m128i y = _mm_castps_si128(half ? _mm256_extractf128_ps(column[3], 1) : _mm256_castps256_ps128(column[3]));
        __m256d size = _mm256_cvtepi32_pd(_mm_srlv_epi32(_mm_set1_epi32(16777216), _mm_srli_epi32(xd, 24)));
        __m256d edge = _mm256_setzero_pd(), corner[2];
        _mm_storeu_si128((__m128i *)(void *)&d->deep[at], _mm_cmpgt_epi32(_mm_srli_epi32(xd, 24), _mm_set1_epi32(2)));
        corner[0] = _mm256_cvtepi32_pd(_mm_and_si128(xd, _mm_set1_epi32(0xffffff)));
        corner[1] = _mm256_cvtepi32_pd(y);
        for (k = 0; k < 2; ++k) {
            __m256d t = _mm256_div_pd(_mm256_sub_pd(_mm256_loadu_pd(&d->r[k][at]), _mm256_loadu_pd(&d->lo[k][at])),
                                      _mm256_loadu_pd(&d->width[k][at])),
                    f;
            t = _mm256_max_pd(t, _mm256_setzero_pd());
            f = _mm256_mul_pd(_mm256_min_pd(t, _mm256_set1_pd(0.99999999988)), size);
            edge = _mm256_or_pd(edge, _mm256_cmp_pd(f, _mm256_set1_pd(GSD_EDGE), _CMP_LT_OQ));
            edge = _mm256_or_pd(edge, _mm256_cmp_pd(f, _mm256_sub_pd(size, _mm256_set1_pd(GSD_EDGE)), _CMP_GT_OQ));
            _mm256_storeu_pd(&d->r[k][at], _mm256_add_pd(corner[k], f));
        }
        _mm_storeu_si128((__m128i *)(void *)&d->edge[at], gsdi_mask_avx2(edge));
    }
}

/* gsd_direction, then gsd_from_pivot and gsd_to_pivot, for eight lanes. */
GSDI_AVX2 static void gsdi_directions_avx2(gsdi_draws *d, uint32_t lane)
{
    __m128 fh[2], zh[2];
    __m128i qh[2];
    __m256 w[3], o[3], one = _mm256_set1_ps(1), l;
    uint32_t half, k;
    for (half = 0; half < 2; ++half) {
        __m256d turn = _mm256_mul_pd(_mm256_loadu_pd(&d->r[0][lane + half * 4]), _mm256_set1_pd(5.9604644775390625e-8));
        qh[half] = _mm256_cvttpd_epi32(_mm256_add_pd(_mm256_mul_pd(turn, _mm256_set1_pd(4)), _mm256_set1_pd(0.5)));
        fh[half] =
            _mm256_cvtpd_ps(_mm256_sub_pd(turn, _mm256_mul_pd(_mm256_set1_pd(0.25), _mm256_cvtepi32_pd(qh[half]))));
        zh[half] = _mm256_cvtpd_ps(_mm256_sub_pd(
            _mm256_mul_pd(_mm256_loadu_pd(&d->r[1][lane + half * 4]), _mm256_set1_pd(1.1920928955078125e-7)),
            _mm256_set1_pd(1)));
    }
    gsdi_direction_avx2(_mm256_insertf128_ps(_mm256_castps128_ps256(fh[0]), fh[1], 1),
                        _mm256_inserti128_si256(_mm256_castsi128_si256(qh[0]), qh[1], 1),
                        _mm256_insertf128_ps(_mm256_castps128_ps256(zh[0]), zh[1], 1), w);
    for (k = 0; k < 3; ++k) {
        o[k] = _mm256_loadu_ps(&d->offset[k][lane]);
        w[k] = _mm256_sub_ps(w[k], o[k]);
    }
    l = _mm256_div_ps(one, _mm256_sqrt_ps(gsdi_dot_avx2(w, w)));
    for (k = 0; k < 3; ++k) {
        w[k] = _mm256_mul_ps(w[k], l);
        _mm256_storeu_ps(&d->out[k][lane], w[k]);
    }
    l = one;
    if (_mm256_movemask_ps(gsdi_apart_avx2(o)))
        l = gsdi_to_pivot_avx2(o, w, w);
    _mm256_storeu_ps(&d->scale[lane], l);
}

static bool gsdi_aliased(const gsd_handle *h) { return h->alias_count && !(h->product > 0); }

/* Up to 64 draws. Those of the uniform share, and what has no alias table in a field of them, are done one by one. */
GSDI_AVX2 static void gsdi_sample_avx2(const gsd_view *view, uint32_t n, const uint32_t *at, const gsd_handle *handles,
                                       const float *u, size_t u_stride, float *directions, size_t direction_stride,
                                       float *pdf)
{
    gsdi_draws d;
    double e = (double)view->uniform;
    bool aliased = gsdi_aliased(&handles[at[0]]), done[GSDI_LANES / 8];
    uint32_t lanes = (n + 7) & ~7u, left = aliased ? 0 : lanes, i, k; /* those from n on repeat the first */
    for (i = 0; i < lanes; ++i) {
        const gsd_handle *h = &handles[at[i < n ? i : 0]];
        const float *v = gsdi_row(u, u_stride, at[i < n ? i : 0]);
        for (k = 0; k < 2; ++k) {
            int32_t b = (int32_t)(v[k] * 16777216.0f);
            d.bits[k][i] = b < 16777215 ? (uint32_t)b : 16777215u;
            d.lo[k][i] = 0;
            d.width[k][i] = 1;
        }
        for (k = 0; k < 3; ++k)
            d.offset[k][i] = h->offset[k];
        d.node[i] = h->root;
        done[i / 8] = false;
        if (!aliased)
            GSDI_PREFETCH(&view->nodes[d.node[i]]);
    }
    gsdi_extend_avx2(&d, lanes, e);
    for (i = 0; !aliased && i < n; ++i) { /* the steps of gsd_choose_bin and gsd_leave_bin, with a prefetch between */
        const gsd_handle *h = &handles[at[i]];
        float weight[GSDI_BINS], row[8];
        double r[2];
        if (!(h->product > 0))
            continue;
        gsdi_bin_weights_avx2(view, h, weight, row);
        r[0] = d.r[0][i] > 0 ? d.r[0][i] : 0; /* the uniform share comes later */
        r[1] = d.r[1][i];
        d.bits[1][i] = gsd_choose_bin(weight, row, r);
        d.r[0][i] = r[0];
        d.r[1][i] = r[1];
        GSDI_PREFETCH(&view->jumps[h->jump + d.bits[1][i]]);
    }
    for (i = 0; !aliased && i < n; ++i)
        if (handles[at[i]].product > 0) {
            d.node[i] = view->jumps[handles[at[i]].jump + d.bits[1][i]];
            GSDI_PREFETCH(&view->nodes[d.node[i]]);
        }
    for (i = 0; !aliased && i < n; ++i)
        if (handles[at[i]].product > 0) {
            double r[2] = {d.r[0][i], d.r[1][i]};
            gsd_leave_bin(&view->nodes[d.node[i]], d.bits[1][i], r);
            d.r[0][i] = r[0];
            d.r[1][i] = r[1];
        }
    for (i = 0; aliased && i < lanes; ++i) {
        const gsd_handle *h = &handles[at[i < n ? i : 0]];
        double slot = d.r[0][i] * (double)h->alias_count;
        slot = slot > 0 ? slot : 0; /* the uniform share comes later */
        d.node[i] = h->alias + (uint32_t)(int64_t)slot;
        d.r[0][i] = slot - (double)(int64_t)slot;
        GSDI_PREFETCH(&view->aliases[d.node[i]]);
    }
    for (i = 0; aliased && i < lanes; ++i) { /* without branches: either leaf may be the one */
        const gsd_alias *a = &view->aliases[d.node[i]];
        uint32_t other = !(d.r[0][i] < (double)a->threshold);
        d.lo[0][i] = (double)other * (double)a->threshold;
        d.width[0][i] = fabs((double)other - (double)a->threshold);
        d.node[i] = a->node ^ ((a->node ^ a->other) & (0 - other));
        d.node[i] = gsdi_aliased(&handles[at[i < n ? i : 0]]) ? d.node[i] : 0;
        GSDI_PREFETCH(&view->nodes[d.node[i]]);
    }
    while (left)
        for (i = 0; i < lanes; i += 8)
            if (!done[i / 8] && !gsdi_step_avx2(view->nodes, &d, i)) {
                done[i / 8] = true;
                left -= 8;
            }
    for (i = 0; i < lanes; i += 8) {
        gsdi_leaves_avx2(view->nodes, &d, i);
        gsdi_directions_avx2(&d, i);
        gsdi_even_avx2(&d.pdf[i], &d.scale[i], view->uniform, &d.even[i]);
    }
    for (i = 0; i < n; ++i) {
        const gsd_handle *h = &handles[at[i]];
        float *out = gsdi_row_out(directions, direction_stride, at[i]);
        if ((double)d.bits[0][i] < e * 16777216.0 + 1 || gsdi_aliased(h) != aliased) {
            pdf[at[i]] = gsdi_sample_one(view, h, gsdi_row(u, u_stride, at[i]), out);
            continue;
        }
        for (k = 0; k < 3; ++k)
            out[k] = d.out[k][i];
        if (d.edge[i] || (h->product > 0 && !d.deep[i]))
            pdf[at[i]] = gsdi_pdf_one(view, h, out);
        else if (!(h->product > 0))
            pdf[at[i]] = d.even[i];
        else
            pdf[at[i]] = gsdi_oriented(view, h, d.pdf[i], (uint32_t)d.r[0][i], (uint32_t)d.r[1][i], d.scale[i]);
    }
}
#endif

GSD_API void gsd_sample_batch(const gsd_view *view, uint32_t count, const uint32_t *index, const gsd_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t direction_stride, float *pdf)
{
    uint32_t start, i;
    for (start = 0; start < count; start += GSDI_LANES) {
        uint32_t n = count - start < GSDI_LANES ? count - start : GSDI_LANES;
        gsdi_draw draws[GSDI_LANES];
        int kind[GSDI_LANES];
        bool tree[GSDI_LANES];
#if GSDI_X86
        if (view->simd >= GSD_SIMD_AVX2) {
            uint32_t at[GSDI_LANES];
            for (i = 0; i < n; ++i)
                at[i] = gsdi_at(index, start + i);
            gsdi_sample_avx2(view, n, at, handles, u, u_stride, directions, direction_stride, pdf);
            continue;
        }
#endif
        for (i = 0; i < n; ++i) {
            uint32_t at = gsdi_at(index, start + i);
            kind[i] = gsdi_draw_start(view, &handles[at], gsdi_row(u, u_stride, at), &draws[i]);
            tree[i] = kind[i] & 1;
        }
        for (i = 0; i < n; ++i)
            if (kind[i] == 2) {
                gsdi_draw_alias(view, &draws[i]);
            } else if (kind[i] == 3) {
                draws[i].node = view->jumps[draws[i].node];
                GSDI_PREFETCH(&view->nodes[draws[i].node]);
            }
        for (i = 0; i < n; ++i)
            if (kind[i] == 3)
                gsd_leave_bin(&view->nodes[draws[i].node], draws[i].bin, draws[i].r);
        gsdi_draw_descend(view, n, draws, tree);
        for (i = 0; i < n; ++i) {
            uint32_t at = gsdi_at(index, start + i);
            float *out = gsdi_row_out(directions, direction_stride, at);
            if (kind[i] == 0) {
                gsd_direction(draws[i].r[0] * 16777216.0, draws[i].r[1] * 16777216.0, out);
                pdf[at] = gsd_pdf(view, &handles[at], out);
            } else {
                pdf[at] = gsd_sample_leaf(view, &handles[at], draws[i].node, draws[i].r[0], draws[i].r[1], out);
            }
        }
    }
}

#if defined(__clang__)
#pragma STDC FP_CONTRACT DEFAULT
#elif defined(__GNUC__)
#pragma GCC pop_options
#endif

/* ---- >>files ------------------------------------------------------------------------------------------------ */

/* Options in a save: X(type, name, type in gsd_desc). */
#define GSDI_OPTIONS(X)                                                                                                \
    X(uint64_t, max_bytes, uint64_t)                                                                                   \
    X(uint32_t, target, gsd_target)                                                                                    \
    X(float, switch_after, float)                                                                                      \
    X(float, smoothing, float)                                                                                         \
    X(float, denoise_budget, float)                                                                                    \
    X(float, gaussian_sigma, float)                                                                                    \
    X(float, gaussian_rho, float)                                                                                      \
    X(uint32_t, gaussian_sphere, bool)                                                                                 \
    X(uint32_t, gaussian_no_limit, bool)                                                                               \
    X(uint32_t, max_depth, uint32_t)                                                                                   \
    X(uint32_t, max_levels, uint32_t)                                                                                  \
    X(uint32_t, min_samples, uint32_t)                                                                                 \
    X(uint32_t, spatial_filter, gsd_spatial_filter)                                                                    \
    X(uint32_t, directional_filter, gsd_directional_filter)                                                            \
    X(uint32_t, alpha_mode, gsd_alpha_mode)                                                                            \
    X(uint32_t, gate_probe, uint32_t)                                                                                  \
    X(uint32_t, forest_cells, uint32_t)                                                                                \
    X(uint32_t, no_gate, bool)                                                                                         \
    X(uint32_t, no_guide_weight, bool)                                                                                 \
    X(uint32_t, no_history, bool)                                                                                      \
    X(uint32_t, denoise, gsd_denoise_mode)                                                                             \
    X(uint32_t, alias, bool)                                                                                           \
    X(float, split_samples, float)                                                                                     \
    X(float, rho, float)                                                                                               \
    X(float, alpha, float)                                                                                             \
    X(float, uniform, float)                                                                                           \
    X(float, gate_margin, float)                                                                                       \
    X(float, gate_gain, float)

#define GSDI_MAGIC "GSDTREE"
#define GSDI_BYTE_ORDER 0x01020304u

/* Start of a save. Then gsdi_block and what follows it, states, child, sum. */
#define GSDI_MEMBER(type, name, given) type name;
typedef struct gsdi_file {
    char magic[8];
    uint32_t byte_order, version;
    uint64_t size, checksum; /* of the whole save with checksum = 0 */
    uint64_t block_size, structure;
    double first_pass_samples, last_pass_samples, all_samples, held_samples;
    gsd_stats stats; /* plain numbers without padding */
    uint32_t cells, building_nodes, passes, learned, pixels;
    float bounds_min[3], bounds_max[3];
    GSDI_OPTIONS(GSDI_MEMBER)
} gsdi_file;
#undef GSDI_MEMBER

static uint64_t gsdi_file_size(uint64_t block_size, uint64_t cells, uint64_t nodes)
{
    return sizeof(gsdi_file) + block_size + cells * sizeof(gsdi_state) + nodes * (sizeof(uint32_t) + sizeof(gsdi_sum));
}

/* Block size without the room to grow. */
static uint64_t gsdi_block_used(const gsdi_block *b) { return b->cells_at + (uint64_t)b->cells * sizeof(gsd_cell); }

GSD_API size_t gsd_save_bound(const gsd_field *field)
{
    return (size_t)gsdi_file_size(gsdi_block_used(field->block), field->block->cells, field->building_nodes);
}

static gsd_result gsdi_file_desc(const gsdi_file *f, const gsd_desc *given, gsd_desc *d)
{
    memset(d, 0, sizeof *d);
#define GSDI_READ(type, name, given_type) d->name = (given_type)f->name;
    if (f->target > 255 || f->spatial_filter > 255 || f->directional_filter > 255 || f->alpha_mode > 255 ||
        f->denoise > 255)
        return GSD_BAD_OPTION;
    GSDI_OPTIONS(GSDI_READ)
#undef GSDI_READ
    memcpy(d->bounds_min, f->bounds_min, sizeof d->bounds_min);
    memcpy(d->bounds_max, f->bounds_max, sizeof d->bounds_max);
    if (given) {
        d->allocate = given->allocate;
        d->release = given->release;
        d->user = given->user;
        d->simd = given->simd;
    }
    return gsd_resolve(d, d);
}

static uint64_t gsdi_file_checksum(const gsdi_file *f, const unsigned char *rest, size_t rest_size)
{
    gsdi_file zero;
    memcpy(&zero, f, sizeof zero);
    zero.checksum = 0;
    return gsdi_hash_bytes(gsdi_hash_bytes(0x452821e638d01377ull, &zero, sizeof zero), rest, rest_size);
}

/* Copy and go on behind the copy. */
static unsigned char *gsdi_put(unsigned char *to, const void *from, size_t size)
{
    memcpy(to, from, size);
    return to + size;
}

GSD_API gsd_result gsd_save(const gsd_field *field, void *data, size_t capacity, size_t *size)
{
    const gsdi_block *b = field->block;
    gsdi_block shape = *b;
    gsdi_file f;
    unsigned char *at = (unsigned char *)data;
    uint32_t nodes = field->building_nodes;
    *size = 0;
    if (capacity < gsd_save_bound(field))
        return GSD_BUFFER_TOO_SMALL;
    memset(&f, 0, sizeof f);
    memcpy(f.magic, GSDI_MAGIC, sizeof GSDI_MAGIC);
    f.byte_order = GSDI_BYTE_ORDER;
    f.version = GSD_VERSION;
    f.size = gsd_save_bound(field);
    f.block_size = gsdi_block_used(b);
    f.structure = field->structure;
    f.first_pass_samples = field->first_pass_samples;
    f.last_pass_samples = field->last_pass_samples;
    f.cells = b->cells;
    f.building_nodes = nodes;
    f.passes = field->passes;
    f.learned = field->target;
    f.all_samples = field->all_samples;
    f.held_samples = field->held_samples;
    f.pixels = field->pixels;
    f.stats = field->stats;
    memcpy(f.bounds_min, field->desc.bounds_min, sizeof f.bounds_min);
    memcpy(f.bounds_max, field->desc.bounds_max, sizeof f.bounds_max);
#define GSDI_WRITE(type, name, given) f.name = (type)field->desc.name;
    GSDI_OPTIONS(GSDI_WRITE)
#undef GSDI_WRITE
    shape.cell_capacity = shape.cells;
    shape.size = f.block_size;
    at = gsdi_put(at, &f, sizeof f);
    at = gsdi_put(at, &shape, sizeof shape);
    at = gsdi_put(at, (const char *)b + sizeof shape, (size_t)f.block_size - sizeof shape);
    at = gsdi_put(at, field->states, b->cells * sizeof(gsdi_state));
    at = gsdi_put(at, field->child, nodes * sizeof(uint32_t));
    gsdi_put(at, field->sum, nodes * sizeof(gsdi_sum));
    f.checksum = gsdi_file_checksum(&f, (const unsigned char *)data + sizeof f, (size_t)f.size - sizeof f);
    memcpy(data, &f, sizeof f);
    *size = (size_t)f.size;
    return GSD_OK;
}

/* Header of a save: sizes add up, checksum is right. */
static gsd_result gsdi_file_check(const unsigned char *data, size_t size, gsdi_file *f)
{
    if (size < sizeof *f + sizeof(gsdi_block))
        return GSD_BAD_FILE;
    memcpy(f, data, sizeof *f);
    if (memcmp(f->magic, GSDI_MAGIC, sizeof GSDI_MAGIC) != 0)
        return GSD_BAD_FILE;
    if (f->byte_order != GSDI_BYTE_ORDER || f->version != GSD_VERSION)
        return GSD_BAD_VERSION;
    if (f->size != size || f->block_size > size || f->block_size < sizeof(gsdi_block) || f->cells == 0 ||
        f->building_nodes == 0 || f->cells > GSDI_MAX_CELLS ||
        gsdi_file_size(f->block_size, f->cells, f->building_nodes) != f->size ||
        f->checksum != gsdi_file_checksum(f, data + sizeof *f, size - sizeof *f))
        return GSD_BAD_FILE;
    return GSD_OK;
}

/* The block's own header agrees with what its counts imply. */
static bool gsdi_block_shape_ok(const gsdi_block *b, const gsdi_file *f, const gsd_desc *d)
{
    gsdi_block shape = *b, space = *b;
    if (b->cells != f->cells || b->cell_capacity != b->cells || b->trees == 0 || b->nodes < 4 || b->nodes % 4 ||
        b->jumps < 64 || b->jumps % 64 || b->spatial == 0 || b->roots < 4 || b->roots % 4 || b->roots > b->nodes)
        return false;
    gsdi_block_layout(&shape);
    gsdi_block_space(d, &space);
    return memcmp(&shape, b, sizeof shape) == 0 && shape.size == f->block_size &&
           memcmp(space.origin, b->origin, sizeof b->origin) == 0 && memcmp(&space.scale, &b->scale, 4) == 0 &&
           memcmp(&space.uniform, &b->uniform, 4) == 0;
}

GSD_API gsd_result gsd_load(const gsd_desc *desc, const void *data, size_t size, gsd_field **out)
{
    const unsigned char *at = (const unsigned char *)data + sizeof(gsdi_file);
    gsdi_file f;
    gsdi_block shape;
    gsd_desc d;
    gsd_field *field;
    gsd_result result;
    *out = NULL;
    result = gsdi_file_check((const unsigned char *)data, size, &f);
    if (result)
        return result;
    result = gsdi_file_desc(&f, desc, &d);
    if (result)
        return result == GSD_BAD_ALLOCATOR ? result : GSD_BAD_FILE;
    memcpy(&shape, at, sizeof shape);
    if (!gsdi_block_shape_ok(&shape, &f, &d))
        return GSD_BAD_FILE;
    field = (gsd_field *)gsdi_allocate(&d, 1, sizeof *field);
    if (!field)
        return GSD_OUT_OF_MEMORY;
    field->desc = d;
    field->block = gsdi_block_allocate(&d, &shape, &field->memory);
    field->states = (gsdi_state *)gsdi_allocate(&d, f.cells, sizeof *field->states);
    field->child = (uint32_t *)gsdi_allocate(&d, f.building_nodes, sizeof(uint32_t));
    field->sum = (gsdi_sum *)gsdi_allocate(&d, f.building_nodes, sizeof(gsdi_sum));
    if (!field->block || !field->states || !field->child || !field->sum) {
        gsd_destroy(field);
        return GSD_OUT_OF_MEMORY;
    }
    memcpy(field->block, at, (size_t)f.block_size);
    at += f.block_size;
    memcpy(field->states, at, f.cells * sizeof *field->states);
    at += f.cells * sizeof *field->states;
    memcpy(field->child, at, f.building_nodes * sizeof(uint32_t));
    at += f.building_nodes * sizeof(uint32_t);
    memcpy(field->sum, at, f.building_nodes * sizeof(gsdi_sum));
    field->building_nodes = field->node_capacity = f.building_nodes;
    field->state_capacity = f.cells;
    field->passes = f.passes;
    field->target = f.learned;
    field->all_samples = f.all_samples;
    field->held_samples = f.held_samples;
    field->pixels = f.pixels;
    field->first_pass_samples = f.first_pass_samples;
    field->last_pass_samples = f.last_pass_samples;
    field->stats = f.stats;
    if (gsd_validate(field)) {
        gsd_destroy(field);
        return GSD_BAD_FILE;
    }
    gsdi_field_changed(field);
    field->structure = f.structure;
    *out = field;
    return GSD_OK;
}

/* ---- >>check ------------------------------------------------------------------------------------------------ */

static bool gsdi_share_ok(float x) { return x >= 0 && x <= 1; }

/* One sampling tree: children in its own range, each group used once and later than its parent, leaves where their
   path says, depths as they are. */
static bool gsdi_tree_ok(const gsd_view *view, const gsdi_block *b, const gsdi_tree *tree, uint32_t max_depth)
{
    gsdi_visit stack[GSDI_STACK];
    uint32_t used = 0, deepest = 0, k;
    int top = 0;
    if (tree->groups == 0)
        return tree->root == 0 && tree->jump == 0 && tree->max_depth == 0;
    if (tree->root < 4 || tree->root >= b->roots || tree->first < b->roots || (tree->first - b->roots) % 4 ||
        (uint64_t)tree->first + (uint64_t)tree->groups * 4 > b->nodes)
        return false;
    memset(&stack[0], 0, sizeof stack[0]);
    stack[0].node = tree->root;
    while (top >= 0) {
        gsdi_visit v = stack[top--];
        const gsd_node *n = &view->nodes[v.node];
        if (n->inner.child == 0) {
            if (!(n->leaf.pdf > 0) || !(n->leaf.pdf < 1e30f) || n->leaf.x != (v.x | v.depth << 24) || n->leaf.y != v.y)
                return false;
            deepest = v.depth > deepest ? v.depth : deepest;
            continue;
        }
        if (n->inner.child != tree->first + used * 4 || used >= tree->groups || v.depth >= max_depth ||
            !gsdi_share_ok(n->inner.split[0]) || !gsdi_share_ok(n->inner.split[1]) || !gsdi_share_ok(n->inner.split[2]))
            return false;
        used++;
        for (k = 4; k-- > 0;) {
            gsdi_visit *s = &stack[++top];
            s->node = n->inner.child + k;
            s->depth = v.depth + 1;
            s->x = v.x + (k & 1) * (16777216u >> s->depth);
            s->y = v.y + (k >> 1) * (16777216u >> s->depth);
        }
    }
    return used == tree->groups && deepest == tree->max_depth &&
           gsdi_within((double)tree->mean_depth, 0, deepest + 0.001);
}

static bool gsdi_jumps_ok(const gsd_view *view, const gsdi_block *b, const gsdi_tree *tree)
{
    uint32_t i;
    float mass;
    if (tree->jump == 0)
        return tree->groups == 0;
    if (tree->jump % GSDI_BINS || tree->jump > b->jumps - GSDI_BINS)
        return false;
    for (i = 0; i < GSDI_BINS; ++i)
        if (view->jumps[tree->jump + i] != gsdi_tree_bin(view->nodes, tree->root, i, &mass) ||
            memcmp(&view->masses[tree->jump + i], &mass, sizeof mass) != 0)
            return false;
    return true;
}

static bool gsdi_aliases_ok(const gsd_view *view, const gsdi_block *b, const gsdi_tree *tree)
{
    uint32_t i;
    uint32_t low = tree->first, high = tree->first + tree->groups * 4;
    if (tree->groups == 0 || b->aliases == 0)
        return true;
    if (tree->leaves != 3 * tree->groups + 1 || (uint64_t)tree->alias + tree->leaves > b->aliases)
        return false;
    for (i = 0; i < tree->leaves; ++i) {
        const gsd_alias *a = &view->aliases[tree->alias + i];
        if (!gsdi_share_ok(a->threshold) || a->node < low || a->node >= high || a->other < low || a->other >= high ||
            view->nodes[a->node].inner.child || view->nodes[a->other].inner.child)
            return false;
    }
    return true;
}

/* The spatial tree: every node reached once, every cell once (forests: only cell 0), levels and corners as the states
   say. */
static bool gsdi_spatial_ok(const gsd_field *field, const gsd_view *view)
{
    struct gsdi_corner {
        uint32_t node, level, origin[3];
    } stack[64];
    const gsdi_block *b = field->block;
    uint32_t nodes = 1, cells = 0, i;
    int top = 0;
    memset(&stack[0], 0, sizeof stack[0]);
    while (top >= 0) {
        struct gsdi_corner c = stack[top--], *next;
        uint32_t link = view->spatial[c.node], axis = c.level % 3;
        if (link & GSD_CELL_BIT) {
            uint32_t cell = link & ~GSD_CELL_BIT;
            if (cell >= b->cells || field->states[cell].level != c.level ||
                memcmp(field->states[cell].origin, c.origin, sizeof c.origin) != 0)
                return false;
            cells++;
            continue;
        }
        if (link <= c.node || link > b->spatial - 2 || b->spatial < 3 || c.level >= 60 || nodes >= b->spatial)
            return false;
        nodes += 2;
        for (i = 0; i < 2; ++i) {
            next = &stack[++top];
            *next = c;
            next->node = link + i;
            next->level = c.level + 1;
            next->origin[axis] += i * gsd_cell_extent(next->level, axis);
        }
    }
    if (nodes != b->spatial || cells != (field->desc.forest_cells ? 1 : b->cells))
        return false;
    for (i = 0; i < GSDI_GRID; ++i)
        if (view->grid[i] != gsdi_grid_link(view->spatial, i >> 8, (i >> 4) & 15u, i & 15u))
            return false;
    return true;
}

/* One building tree: children later than parents, all nodes used, leaves' sums finite and >= 0. */
static bool gsdi_building_ok(const gsd_field *field, const gsdi_state *s)
{
    const uint32_t *child;
    const gsdi_sum *sum;
    uint32_t used = 1, top = 0, k;
    struct gsdi_down {
        uint32_t node, depth;
    } stack[GSDI_STACK], v;
    if (s->count == 0 || s->count > field->building_nodes || s->first > field->building_nodes - s->count)
        return false;
    child = field->child + s->first;
    sum = field->sum + s->first;
    stack[top].node = stack[top].depth = 0;
    ++top;
    while (top) {
        v = stack[--top];
        if (child[v.node] == 0) {
            for (k = 0; k < 2; ++k)
                if (!(sum[v.node].half[k] >= 0) || !(sum[v.node].half[k] < 1e300))
                    return false;
            continue;
        }
        if (child[v.node] <= v.node || s->count < 5 || child[v.node] > s->count - 4 || used >= s->count ||
            v.depth >= field->desc.max_depth)
            return false;
        used += 4;
        for (k = 0; k < 4; ++k, ++top) {
            stack[top].node = child[v.node] + k;
            stack[top].depth = v.depth + 1;
        }
    }
    return used == s->count;
}

/* A place and a nearness that gsd_offset can work with. */
static bool gsdi_pivot_ok(const float pivot[3], float nearness)
{
    return gsdi_finite(pivot[0]) && gsdi_finite(pivot[1]) && gsdi_finite(pivot[2]) && nearness >= 0 &&
           gsdi_finite(nearness);
}

static bool gsdi_state_ok(const gsd_field *field, const gsdi_state *s, const gsd_cell *c, const gsdi_tree *trees)
{
    const gsdi_tree *t;
    gsd_cell should;
    uint32_t k;
    if (c->tree >= field->block->trees || s->gate > GSD_GATE_CLOSED || !(s->alpha >= 0.049f && s->alpha <= 1) ||
        !(s->reflected >= 0 && s->reflected <= 1e30f) || !(s->theta > -10 && s->theta < 10) ||
        !gsdi_finite(s->moment1) || !gsdi_finite(s->moment2) || !(s->held >= 0 && s->held < 1e18) ||
        !(s->lit >= 0 && s->lit < 1e18) || !(s->fresh >= 0 && s->fresh < 1e18) || !(s->mass >= 0 && s->mass < 1e50) ||
        !(s->near_mass >= 0 && s->near_mass < 1e90) || !gsdi_pivot_ok(s->pivot, s->nearness) ||
        !gsdi_pivot_ok(c->pivot, c->nearness) || (field->desc.forest_cells && (s->nearness > 0 || c->nearness > 0)) ||
        !(s->flow >= 0 && s->flow < 1e50) || !(s->gate_count >= 0) || !(s->weight >= 0 && s->weight < 1e300) ||
        !(s->pixel >= 0 && s->pixel < 1e300) || !(s->pixel_v >= 0 && s->pixel_v < 1e300) || s->level > 60)
        return false;
    for (k = 0; k <= GSDI_GATE_LOW; ++k)
        if (!(s->v[k] >= 0 && s->v[k] < 1e300) || !(s->vv[k] >= 0 && s->vv[k] < 1e300))
            return false;
    for (k = 0; k < GSDI_GATE_LOW; ++k)
        if (!(s->cross[k] >= 0 && s->cross[k] < 1e300))
            return false;
    t = &trees[c->tree];
    gsdi_cell_write(field->block, t, &should, s, 0, c->pivot, c->nearness);
    should.tree = c->tree;
    should.alpha = c->alpha;
    should.gate = c->gate;
    should.reflected = c->reflected;
    return memcmp(&should, c, sizeof should) == 0 && c->reflected >= 0 && c->reflected <= 1e30f && c->alpha >= 0.049f &&
           c->alpha <= 1 && c->gate <= GSD_GATE_CLOSED && gsdi_building_ok(field, s);
}

GSD_API gsd_result gsd_validate(const gsd_field *field)
{
    const gsdi_block *b = field->block;
    const gsdi_tree *trees = gsdi_trees(b);
    gsd_view view = gsd_get_view(field);
    float bins[3 * GSDI_BINS];
    uint32_t i;
    for (i = 0; i < b->roots; ++i)
        if (i < 4 && (view.nodes[i].leaf.child || view.nodes[i].leaf.x || view.nodes[i].leaf.y ||
                      memcmp(&view.nodes[i].leaf.pdf, &view.nodes[0].leaf.pdf, 4) ||
                      !(fabsf(view.nodes[i].leaf.pdf - GSD_INV_4PI) < 1e-7f)))
            return GSD_CORRUPT;
    if (field->target < GSD_TARGET_RADIANCE || field->target > GSD_TARGET_VARIANCE ||
        !(field->first_pass_samples >= 0 && field->first_pass_samples < 1e18) ||
        !(field->last_pass_samples >= 0 && field->last_pass_samples < 1e18) ||
        !(field->all_samples >= 0 && field->all_samples < 1e18) ||
        !(field->held_samples >= 0 && field->held_samples < 1e18) || !gsdi_share_ok(field->stats.closed_share) ||
        !gsdi_share_ok(field->stats.mean_alpha))
        return GSD_CORRUPT;
    gsdi_bin_means(bins);
    for (i = 0; i < 3 * GSDI_BINS; ++i) /* libraries may round sines differently */
        if (!(fabsf(view.bins[i] - bins[i]) < 1e-6f))
            return GSD_CORRUPT;
    if (trees[0].groups)
        return GSD_CORRUPT;
    for (i = 0; i < b->trees; ++i)
        if (!gsdi_tree_ok(&view, b, &trees[i], field->desc.max_depth) || !gsdi_jumps_ok(&view, b, &trees[i]) ||
            !gsdi_aliases_ok(&view, b, &trees[i]))
            return GSD_CORRUPT;
    for (i = 0; i < b->cells; ++i)
        if (!gsdi_state_ok(field, &field->states[i], &view.cells[i], trees))
            return GSD_CORRUPT;
    return gsdi_spatial_ok(field, &view) ? GSD_OK : GSD_CORRUPT;
}

/* ---- >>plain: merge, export, import ------------------------------------------------------------------------- */

GSD_API gsd_result gsd_merge(gsd_field *field, const gsd_field *source)
{
    uint32_t i, k;
    if (field->structure != source->structure || field->block->cells != source->block->cells ||
        field->building_nodes != source->building_nodes || field->passes != source->passes ||
        field->target != source->target)
        return GSD_MISMATCH;
    for (i = 0; i < field->building_nodes; ++i)
        for (k = 0; k < 2; ++k)
            field->sum[i].half[k] += source->sum[i].half[k];
    for (i = 0; i < field->block->cells; ++i) {
        gsdi_state *s = &field->states[i];
        const gsdi_state *o = &source->states[i];
        double both = s->fresh + o->fresh, share = both > 0 ? o->fresh / both : 0;
        s->held += o->held;
        s->lit += o->lit;
        s->fresh += o->fresh;
        s->flow += o->flow;
        s->mass += o->mass;
        s->near_mass += o->near_mass;
        s->gate_count += o->gate_count;
        s->weight += o->weight;
        s->pixel += o->pixel;
        s->pixel_v += o->pixel_v;
        s->theta += (float)(share * ((double)o->theta - (double)s->theta));
        for (k = 0; k <= GSDI_GATE_LOW; ++k) {
            s->v[k] += o->v[k];
            s->vv[k] += o->vv[k];
            if (k < GSDI_GATE_LOW)
                s->cross[k] += o->cross[k];
        }
        for (k = 0; k < 64; ++k)
            s->bins[k] = s->bins[k] <= 0xffffffffu - o->bins[k] ? s->bins[k] + o->bins[k] : 0xffffffffu;
    }
    field->stats.samples += source->stats.samples;
    field->stats.denoised_leaves += source->stats.denoised_leaves;
    field->stats.zeros += source->stats.zeros;
    field->stats.rejected += source->stats.rejected;
    field->stats.refused += source->stats.refused;
    field->stats.clamped += source->stats.clamped;
    field->stats.lost += source->stats.lost;
    return GSD_OK;
}

static uint32_t gsdi_inner_nodes(const gsd_field *field, gsd_part part, uint32_t cell)
{
    uint32_t groups = part == GSD_PART_SAMPLING ? gsdi_trees(field->block)[gsdi_cells(field->block)[cell].tree].groups
                                                : (field->states[cell].count - 1) / 4;
    return groups ? groups : 1;
}

GSD_API uint32_t gsd_export_bound(const gsd_field *field, gsd_part part, uint32_t cell)
{
    return cell < field->block->cells ? gsdi_inner_nodes(field, part, cell) : 0;
}

/* Values of inner nodes from their children, which come later. */
static void gsdi_sum_up(gsd_tree *tree)
{
    uint32_t i, k;
    for (i = tree->count; i-- > 0;)
        for (k = 0; k < 4; ++k) {
            uint32_t c = tree->child[i * 4 + k];
            const float *v = tree->value + (size_t)c * 4;
            if (c)
                tree->value[i * 4 + k] = (v[0] + v[1]) + (v[2] + v[3]);
        }
}

/* Masses of an inner node's children, from the shares that sampling uses: leaves' densities hold little of what was
   learned where desc.uniform is large, and nothing where it is 1. */
static void gsdi_export_shares(const gsd_node *node, float mass, float value[4])
{
    uint32_t k;
    for (k = 0; k < 4; ++k) {
        float sx = node->inner.split[0], sy = node->inner.split[1 + (k & 1)];
        value[k] = mass * (k & 1 ? 1 - sx : sx) * (k & 2 ? 1 - sy : sy);
    }
}

static void gsdi_export_sampling(const gsd_field *field, const gsdi_tree *from, gsd_tree *tree)
{
    const gsd_node *all = gsdi_nodes(field->block), *nodes = all + from->first;
    uint32_t i;
    if (from->groups)
        gsdi_export_shares(&all[from->root], 1, tree->value);
    for (i = 0; i < from->groups * 4; ++i) { /* parents first */
        tree->child[i] = nodes[i].inner.child ? (nodes[i].inner.child - from->first) / 4 : 0;
        if (tree->child[i])
            gsdi_export_shares(&nodes[i], tree->value[i], tree->value + (size_t)tree->child[i] * 4);
    }
}

static void gsdi_export_building(const gsd_field *field, const gsdi_state *s, gsd_tree *tree)
{
    struct gsdi_down {
        uint32_t inner, depth;
    } stack[GSDI_STACK], v;
    const uint32_t *child = field->child + s->first;
    const gsdi_sum *sum = field->sum + s->first;
    bool second_moment = field->target != GSD_TARGET_RADIANCE;
    uint32_t top = 0, k;
    stack[top].inner = stack[top].depth = 0;
    ++top;
    while (top) { /* inner node g owns nodes 1 + 4 g .. 4 + 4 g */
        v = stack[--top];
        for (k = 0; k < 4; ++k) {
            uint32_t node = 1 + v.inner * 4 + k, c = child[node];
            double own = gsdi_leaf_mass(sum[node].half[0] + sum[node].half[1], second_moment, v.depth + 1);
            tree->child[v.inner * 4 + k] = c ? (c - 1) / 4 : 0;
            tree->value[v.inner * 4 + k] = (float)(c ? 0 : own < 3e38 ? own : 3e38);
            if (c) {
                stack[top].inner = (c - 1) / 4;
                stack[top++].depth = v.depth + 1;
            }
        }
    }
}

GSD_API gsd_result gsd_export_tree(const gsd_field *field, gsd_part part, gsd_tree *tree)
{
    const gsdi_sum *root;
    uint32_t count, k;
    if (tree->cell >= field->block->cells)
        return GSD_BAD_CELL;
    root = &field->sum[field->states[tree->cell].first];
    count = gsdi_inner_nodes(field, part, tree->cell);
    if (tree->count < count)
        return GSD_BUFFER_TOO_SMALL;
    tree->count = count;
    for (k = 0; k < 4; ++k) { /* what a single leaf gives */
        tree->child[k] = 0;
        tree->value[k] = part == GSD_PART_SAMPLING ? 0.25f : (float)((root->half[0] + root->half[1]) / 4);
    }
    if (part == GSD_PART_SAMPLING)
        gsdi_export_sampling(field, &gsdi_trees(field->block)[gsdi_cells(field->block)[tree->cell].tree], tree);
    else if (field->states[tree->cell].count > 1)
        gsdi_export_building(field, &field->states[tree->cell], tree);
    gsdi_sum_up(tree);
    return GSD_OK;
}

/* A plain tree to building form: child, mass of 1 + 4 count nodes. Total mass, or -1 where it is not a tree. */
static double gsdi_import_convert(const gsd_tree *tree, uint32_t max_depth, uint32_t *child, double *mass,
                                  unsigned char *depth)
{
    uint32_t i, k, reached = 1;
    memset(depth, 0, tree->count);
    child[0] = 1;
    for (i = 0; i < tree->count; ++i)
        for (k = 0; k < 4; ++k) {
            uint32_t c = tree->child[i * 4 + k];
            float v = tree->value[i * 4 + k];
            if (c == 0) {
                if (!(v >= 0 && v < 1e30f))
                    return -1;
            } else if (c <= i || c >= tree->count || depth[c] || depth[i] + 2u > max_depth) {
                return -1;
            } else {
                depth[c] = (unsigned char)(depth[i] + 1);
                ++reached;
            }
            child[1 + i * 4 + k] = c ? 1 + 4 * c : 0;
            mass[1 + i * 4 + k] = c ? 0 : (double)v;
        }
    for (i = 4 * tree->count + 1; i-- > 0;) {
        uint32_t c = child[i];
        if (c)
            mass[i] = (mass[c] + mass[c + 1]) + (mass[c + 2] + mass[c + 3]);
    }
    return reached == tree->count ? mass[0] : -1;
}

/* Sizes and addresses of the new block of an import. */
static gsd_result gsdi_import_plan(gsdi_refinement *r, const gsd_tree *trees, uint32_t count, uint32_t *largest)
{
    gsdi_block shape = *r->field->block;
    uint32_t i;
    r->jobs = (gsdi_job *)gsdi_allocate(r->desc, shape.cells, sizeof *r->jobs);
    if (!r->jobs)
        return GSD_OUT_OF_MEMORY;
    for (i = 0; i < count; ++i) {
        if (trees[i].cell >= shape.cells)
            return GSD_BAD_CELL;
        if (trees[i].count == 0 || trees[i].count > 0x0fffffffu || r->jobs[trees[i].cell].rebuild)
            return GSD_BAD_TREE;
        r->jobs[trees[i].cell].rebuild = 1 + i;
        r->jobs[trees[i].cell].groups = trees[i].count;
        *largest = trees[i].count > *largest ? trees[i].count : *largest;
    }
    r->child = (uint32_t *)gsdi_allocate(r->desc, (uint64_t)*largest * 4 + 1, sizeof(uint32_t));
    r->mass = (double *)gsdi_allocate(r->desc, (uint64_t)*largest * 4 + 1, sizeof(double));
    r->depth = (unsigned char *)gsdi_allocate(r->desc, *largest, 1);
    if (!r->child || !r->mass || !r->depth)
        return GSD_OUT_OF_MEMORY;
    for (i = 0; i < count; ++i) {
        double total = gsdi_import_convert(&trees[i], r->desc->max_depth, r->child, r->mass, r->depth);
        if (total < 0)
            return GSD_BAD_TREE;
        if (!(total > 0)) /* uniform */
            r->jobs[trees[i].cell].groups = 0;
    }
    if (!gsdi_list_trees(r, &shape))
        return GSD_OUT_OF_MEMORY;
    shape.cell_capacity = shape.cells;
    r->block = gsdi_block_allocate(r->desc, &shape, &r->memory);
    return r->block ? GSD_OK : GSD_OUT_OF_MEMORY;
}

GSD_API gsd_result gsd_import_trees(gsd_field *field, const gsd_tree *trees, uint32_t count)
{
    gsdi_refinement r;
    gsdi_block *old = field->block;
    uint32_t i, largest = 1;
    gsd_result result;
    memset(&r, 0, sizeof r);
    r.field = field;
    r.desc = &field->desc;
    result = gsdi_import_plan(&r, trees, count, &largest);
    if (result) {
        gsdi_refinement_free(&r);
        return result;
    }
    gsdi_block_uniform(r.block);
    memcpy(gsdi_words(r.block, r.block->spatial_at), gsdi_words(old, old->spatial_at), old->spatial * sizeof(uint32_t));
    gsdi_block_grid(r.block);
    for (i = 0; i < old->cells; ++i) {
        const gsdi_job *job = &r.jobs[i];
        gsdi_tree *tree = &r.trees[job->tree];
        if (job->rebuild) {
            gsdi_import_convert(&trees[job->rebuild - 1], r.desc->max_depth, r.child, r.mass, r.depth);
            gsdi_tree_write(r.block, tree, r.child, r.mass, 1, 0);
        } else if (job->copy) {
            gsdi_tree_copy(r.block, tree, old, &gsdi_trees(old)[gsdi_cells(old)[i].tree]);
        }
        gsdi_cell_write(r.block, r.trees, &gsdi_cells(r.block)[i], &field->states[i], job->tree,
                        gsdi_cells(old)[i].pivot, gsdi_cells(old)[i].nearness);
    }
    memcpy((char *)r.block + r.block->trees_at, r.trees, r.tree_count * sizeof(gsdi_tree));
    gsdi_release(r.desc, field->memory);
    field->memory = r.memory;
    field->block = r.block;
    r.memory = NULL;
    gsdi_refinement_free(&r);
    field->guiding = 0;
    for (i = 0; i < field->block->cells; ++i)
        field->guiding += gsdi_cells(field->block)[i].alpha < 1;
    return GSD_OK;
}

#endif /* GSD_IMPLEMENTATION */

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
