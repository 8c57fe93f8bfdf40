/* guide_kd.h 0.1: path guiding with a kd-tree of parallax-aware vMF mixtures. Licence: MIT or Unlicense.

   In exactly one file, before including it:        #define GKD_IMPLEMENTATION
   Everywhere else only:                            #include "guide_kd.h"

   A path tracer samples directions better when it knows where light comes from. This header learns that while
   rendering: record radiance samples, accumulate, refine, then ask for directions and their densities. C99 or C++11,
   C standard library only (link with -lm).

       #define GKD_IMPLEMENTATION
       #include "guide_kd.h"
       int main(void)
       {
           static gkd_desc desc; // zero: all defaults
           gkd_field *field; gkd_stream *stream;
           desc.bounds_max[0] = desc.bounds_max[1] = desc.bounds_max[2] = 1; // the scene: a box 0 .. 1
           if (gkd_create(&desc, &field) || gkd_stream_create(field, &stream))
               return 1;
           for (int pass = 0; pass < 6; ++pass) { // trace with the field, then learn
               gkd_view view = gkd_get_view(field);
               for (int i = 0; i < (1000 << pass); ++i) { // "trace": a lamp of radiance 100 around +x, 3 away
                   float p[3] = {0.5f, 0.5f, 0.5f}, d[3];
                   float u[2] = {(float)(rand() & 0xffff) / 65536.0f, (float)(rand() & 0xffff) / 65536.0f};
                   gkd_handle handle; gkd_find(&view, p, NULL, NULL, &handle);
                   float pdf = gkd_sample(&handle, u, d), L = d[0] > 0.95f ? 100.0f : 1.0f;
                   gkd_training_sample sample = gkd_make_scalar_sample(p, d, NULL, 3, L, L, L, pdf, pdf, 0);
                   gkd_record(stream, &sample, 1);
               }
               gkd_accumulate(field, &stream, 1, NULL, NULL);
               gkd_stream_clear(stream);
               gkd_refine(field, NULL, NULL, NULL);
           }
           return gkd_stream_destroy(stream), gkd_destroy(field), 0;
       }

   CONTENTS (search for the tag)
     >>config    macros, versions              >>query   inline: find, sample, pdf, resample
     >>types     descriptor, sample, results   >>batch   find, sample, pdf of arrays
     >>field     create, refine, stats         >>store   save, load, merge
     implementation:
     >>memory  >>signature  >>quantile  >>table  >>compare  >>model  >>moments  >>kernel  >>mstep  >>fit  >>change
     >>gate  >>update  >>streams  >>accumulate  >>refine  >>life  >>batches  >>files  >>licence

   HOW IT WORKS
     Space is a kd-tree, cut on the axis along which the positions of non-zero samples vary most, at their mean
     [Ruppert 2020]. Every leaf (*cell*) has a mixture of von Mises-Fisher lobes over directions. A field has a
     *sampling part*, one flat relocatable block that queries read and only refine (and load) replaces, and a
     *building part* that accumulate writes. Density of a direction: (1 - e) learned + e/(4 pi), e = 0.01
     (desc.uniform); it integrates to 1. Directions are unit, world space, away from the surface towards the light.

     When a cell splits (desc.split):
       signature   when it can be told with confidence that the light in a part of it differs from that in the whole
                   [Zheng 2025]. Below each cell lie up to desc.lookahead levels of lookahead cells, made where the
                   parent has min_samples samples; each keeps the moments of radiance / pdf and the sum of directions
                   weighted by it. A cell splits when the mean radiance of one differs by more than desc.radiance_step,
                   or its mean direction by more than desc.direction_step radians, with error probability
                   desc.confidence per test.
       count       when it has seen desc.split_samples non-zero samples.
     Where both halves of a lookahead cell are like their cell with confidence (the same tests, turned round: surely
     less than radiance_step and direction_step away), and so is all that was below, nothing is kept below it until it
     differs or its samples pass twice to four times those.
     After a split the lookahead cells of both halves start anew from the samples of the current update, and each half
     is looked at again, so that one update can split many times. Mixtures are inherited, seen from the new pivots.

     What is learned: radiance. Each sample counts with its largest channel over pdf_mix. An *update* happens after
     every desc.update_samples samples and in refine: signatures, splits, and a few steps of weighted EM on each
     cell's mixture. A mixture that no longer changes rests until its cell has seen twice the samples [after Zheng 2025,
     section 7.5]: it has moved by less than 0.005 nats per share of new samples. Of all samples of a cell a quarter
     counts, earlier ones fade: they were drawn with worse guides. What queries see changes in refine only.

     Parallax: each lobe knows how far away that is what it shows. gkd_find turns every lobe to the position that asks
     [Ruppert 2020]. With a normal, lobes are multiplied by the cosine, and what lies below the surface is mirrored up:
     p'(w) = p(w) + p(mirrored w), which is exact.

     Selection probability: handle.alpha is the probability to sample the BSDF; 1 means: do not guide here. The caller
     draws from the BSDF with alpha, else from gkd_sample, and divides by alpha pdf_bsdf + (1 - alpha) gkd_pdf.

     Resampling (RIS) [Talbot 2005], in place of choosing between BSDF and guide blindly, pays where the BSDF is glossy:
     draw n candidates, number i from the BSDF with probability clamp(alpha n - i, 0, 1), else from gkd_sample;
     evaluate both densities and the BSDF at each; gkd_resample takes one by f cos L, as the guide sees L. Divide by the
     pdf that it returns, and record this as pdf_mix: both stay unbiased. It is not a density that could be known of any
     other direction. MIS with other techniques weighs therefore by m = alpha pdf_bsdf + (1 - alpha) gkd_pdf, on both
     sides: weights have to sum to 1 for each direction, no more, as the quotient by the returned pdf is an unbiased
     estimate of any integral, that with a weight too. On diffuse surfaces there is nothing to gain: n = 1 is
     one-sample MIS. Divided by the returned pdf, radiance alone has heavy tails where the BSDF vanishes: what is hardly
     ever taken weighs much. Mixtures bear it, as no sample weighs more than a share of its batch (a cap, which biases
     them, not the picture); signatures and the gate take it as it is.

     Gate: guiding is used in a cell until its own samples show that it does not pay. V(a) = mean of g^2 / (p p_a), with
     g = contribution, p_a = a pdf_bsdf + (1 - a) pdf_guide, is the second moment with selection probability a; m = mean
     of g / p; W^2 = mean of (pixel_contribution / g)^2, weighted as in V(1), turns squared contributions into squared
     pixels. Guiding pays where V(1) > (1 + gate_margin) V(a) + gate_gain / W^2. Since no guide has V(a) < m^2, a cell
     with V(1) < m^2 + gate_gain / W^2 closes whatever its mixture, though not before eight refines: light that is rare
     must have had the time to be found. Verdicts need 95 % confidence; cells without verdict guide. Without a pixel
     estimate (gkd_pass.pixel_estimate) 1 / W^2 = 16 m^2.

     Use with another directional model: desc.no_mixtures keeps the tree and its splits only. gkd_find_cell tells the
     cell; gkd_pass.on_split tells of each split in order, which the other model repeats.

   THE SAMPLE
     One per non-delta path vertex whose direction was traced. radiance L: from that direction, no cosine, no BSDF, not
     divided by a pdf; light that next-event estimation can sample weighted by its MIS weight; connections of this
     vertex not included. distance: to the next vertex, INFINITY = the environment. Zeros count: record them.
     gkd_make_sample fills one from RGB arrays; the normal is the one that gkd_find got. A direction rejected before
     tracing (f = 0) has radiance GKD_REJECTED (-0.0f): it counts for the gate only. pdf_guide = 0 means "not
     evaluated".

   OPTIONS: see gkd_desc. gkd_resolve fills in defaults, gkd_get_desc returns what a field uses.

   MEMORY
     Sampling part: 32 bytes per cell, 24 per lobe, 8 per node of the tree, and at most 320 bytes; refine makes a new
     one beside the old. Building part: see gkd_stats; about 300 bytes and 32 + 24 per lobe for each cell,
     sizeof(gkd_signature) (at most 96) per lookahead cell, of which at most 2^(lookahead + 1) - 2 per cell. max_bytes
     bounds both parts: beyond it cells stop splitting. Samples wait for an update in desc.update_samples * 48 bytes.
     Allocation happens in create, stream_create, record, accumulate, refine, load; never in a query. accumulate and
     refine may call desc.allocate and desc.release from the threads of the parallel callback at the same time.
     Stack: below 64 KB per call.

   THREADS: each function has a tag.
     [any thread]   pure function on constant data
     [per stream]   different streams at the same time from different threads; one stream by one thread at a time
     [exclusive]    nothing else on this field at the same time
     No threads are started. Functions that take a gkd_parallel_fn cut work by count and let the callback run it
     (NULL = serially). The result is bit-identical for any number of threads and for any cut of the same sequence of
     samples into streams and accumulate calls.

   ERRORS
     gkd_result, 0 = ok; gkd_result_string says which field to change. Asserts (GKD_ASSERT) catch programming errors.
     Bad samples (NaN, infinity, negative, >= 1e30, pdf_mix <= 0, zero direction, distance <= 0 or NaN) are refused and
     counted in gkd_stats; positions outside the bounds are clamped and counted. A failed allocation leaves the field as
     it was before the call, except that samples of cells that found no memory are lost (counted).
     gkd_load checks size, version, byte order, checksum and every index before use.

   REFERENCES
     L. Ruppert, S. Herholz, H. Lensch 2020, Robust Fitting of Parallax-Aware Mixtures for Path Guiding.
     F. Zheng, C. Peters, S. Herholz, M. Manzi, E. Eisemann 2025, Illumination-Aware Spatial Subdivision for Path
     Guiding.
     J. Talbot, D. Cline, P. Egbert 2005, Importance Resampling for Global Illumination.
     J. Vorba, J. Krivanek 2016, Adjoint-Driven Russian Roulette and Splitting in Light Transport Simulation.
     F. Downton 1973, The Estimation of Pr(Y < X) in the Normal Case. */
#ifndef GUIDE_KD_H
#define GUIDE_KD_H

/* ---- >>config ----------------------------------------------------------------------------------------------- */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define GKD_VERSION 3 /* of the saved format */

#ifndef GKD_API /* linkage of the functions; e.g. static */
#define GKD_API extern
#endif
#ifndef GKD_QUERY /* qualifiers of the inline queries; e.g. __device__ static inline: then they are scalar */
#define GKD_QUERY static inline
#define GKD_QUERY_SIMD 1
#endif
/* Other macros, read by the implementation only: GKD_ASSERT(x), GKD_MALLOC(n), GKD_FREE(p), GKD_NO_SIMD. */

#ifdef __cplusplus
extern "C" {
#endif

/* ---- >>types ------------------------------------------------------------------------------------------------ */

/* Results and their messages. */
#define GKD_RESULTS(X)                                                                                                 \
    X(GKD_OK, "ok")                                                                                                    \
    X(GKD_OUT_OF_MEMORY, "out of memory: lower desc.max_bytes or check desc.allocate")                                 \
    X(GKD_BAD_BOUNDS, "desc.bounds_min must not lie above desc.bounds_max, both finite")                               \
    X(GKD_BAD_OPTION, "an enum is out of range: desc.split, .alpha_mode, .simd")                                       \
    X(GKD_BAD_RANGE, "a number in the descriptor is out of its range: see the comments of gkd_desc")                   \
    X(GKD_BAD_ALLOCATOR, "set both desc.allocate and desc.release or neither")                                         \
    X(GKD_MISMATCH, "the fields' structures differ: merge between accumulate and refine, from one common ancestor")    \
    X(GKD_BUFFER_TOO_SMALL, "the buffer is too small: ask the _bound function")                                        \
    X(GKD_BAD_FILE, "not a saved field, or it is damaged")                                                             \
    X(GKD_BAD_VERSION, "saved by another version or on a machine of other byte order")                                 \
    X(GKD_CORRUPT, "the field does not hold together: memory was overwritten")

#define GKD_RESULT_ENUM(name, text) name,
typedef enum gkd_result { GKD_RESULTS(GKD_RESULT_ENUM) GKD_RESULT_COUNT } gkd_result;
#undef GKD_RESULT_ENUM

typedef enum gkd_split {
    GKD_SPLIT_DEFAULT,   /* = GKD_SPLIT_SIGNATURE */
    GKD_SPLIT_SIGNATURE, /* where the light changes [Zheng 2025] */
    GKD_SPLIT_COUNT      /* after desc.split_samples non-zero samples */
} gkd_split;

typedef enum gkd_alpha_mode {
    GKD_ALPHA_DEFAULT, /* = GKD_ALPHA_GRID */
    GKD_ALPHA_FIXED,   /* stays desc.alpha */
    GKD_ALPHA_GRID     /* minimum of V(a) through the gate's estimates at five values of a, pulled towards desc.alpha */
} gkd_alpha_mode;

typedef enum gkd_simd { GKD_SIMD_AUTO, GKD_SIMD_SCALAR, GKD_SIMD_AVX2, GKD_SIMD_AVX512, GKD_SIMD_NEON } gkd_simd;

#define GKD_MAX_LOBES 32

/* Zero-initialise it; zero means the default. Fields named no_x switch a default behaviour off. */
typedef struct gkd_desc {
    float bounds_min[3], bounds_max[3]; /* world-space box of the positions; may be empty along an axis */
    gkd_split split;
    uint32_t split_samples; /* of GKD_SPLIT_COUNT: non-zero samples, 64 .. 1e9; default 4000 */
    uint32_t lookahead;     /* levels of lookahead cells, 1 .. 7; default 6 */
    uint32_t min_samples;   /* of a cell that is compared or divided into lookahead cells, 16 .. 1e9; default 1000 */
    float radiance_step;    /* T, relative difference of mean radiance, 0.001 .. 100; default 0.05 */
    float direction_step;   /* tau, angle between mean directions, radians, 0.001 .. 3.1; default 3 degrees */
    float confidence;       /* probability that a test is wrong, 1e-12 .. 0.4; default 1e-4 */
    bool no_radiance_test, no_direction_test;
    bool no_prune;           /* keep lookahead cells also where all are surely like their cell */
    bool published_tests;    /* the formulas of [Zheng 2025] word for word, to compare with */
    float keep_signatures;   /* after a split, what lookahead cells have seen counts so many times, 0 .. 1; default 0:
                                they start anew [Zheng 2025, sections 3.2, 7.2] */
    uint32_t max_levels;     /* of the tree, 1 .. 60; default 40 */
    uint32_t max_lobes;      /* of a mixture, 1 .. 32; default 32 */
    uint32_t update_samples; /* between updates, 1024 .. 2^26; default 2^18 */
    uint64_t max_bytes;      /* memory cap, see MEMORY; >= 2^20; default 2^30 */
    gkd_alpha_mode alpha_mode;
    float alpha;         /* start value (and fixed value) of the probability of BSDF sampling, 0.05 .. 1; default 0.5 */
    float uniform;       /* e, share of uniform sampling in the guide's density, 1e-4 .. 1; default 0.01 */
    bool no_mixtures;    /* structure only: for other directional models */
    bool no_rest;        /* fit also mixtures that no longer change */
    bool no_gate;        /* guide in every cell */
    float gate_margin;   /* V(1) / V(a) - 1 below which guiding does not pay, 0.001 .. 10; default 0.05 */
    float gate_gain;     /* V(1) - V(a) below which guiding does not pay, 0.0001 .. 1000; default 0.25 */
    uint32_t gate_probe; /* passes between tries of a closed cell, 1 .. 1000; default 1 */
    gkd_simd simd;       /* pin the level; default: the best that this machine has */
    void *(*allocate)(void *user, size_t size); /* default malloc; NULL on failure; 16-byte aligned; see MEMORY */
    void (*release)(void *user, void *pointer); /* default free; pointer may be NULL */
    void *user;
} gkd_desc;

/* What is learned from one path vertex. 48 bytes. See THE SAMPLE; pdfs in 1/sr, L in W/m^2/sr. Filled by
   gkd_make_sample. */
typedef struct gkd_training_sample {
    float position[3];
    uint32_t direction[2];    /* with the normal; see gkd_pack_direction */
    float nearness;           /* 1 / distance to the next vertex; 0 = infinitely far */
    float radiance;           /* largest channel of L; GKD_REJECTED */
    float contribution;       /* mean over channels of f L cos */
    float pixel_contribution; /* mean over channels of f L cos * throughput before this vertex / pixel estimate */
    float pdf_mix;            /* what the direction was drawn with, or gkd_resample's */
    float pdf_bsdf;
    float pdf_guide; /* 0 = not evaluated */
} gkd_training_sample;
#define GKD_REJECTED (-0.0f)

/* Optional facts about the pass that refine ends. Zero-initialise it. */
typedef struct gkd_pass {
    bool pixel_estimate; /* the pass's pixel_contributions were relative to a pixel estimate: see Gate */
    /* Told of every split since the last refine, in order: cell `parent` became child_a (= parent) and child_b. */
    void (*on_split)(void *user, uint32_t parent, uint32_t child_a, uint32_t child_b);
    void *on_split_user;
} gkd_pass;

typedef void (*gkd_range_fn)(void *context, uint32_t begin, uint32_t end);
/* Calls fn on disjoint ranges that cover [0, count), of about grain, and returns when all are done. */
typedef void (*gkd_parallel_fn)(void *user, uint32_t count, uint32_t grain, gkd_range_fn fn, void *context);

typedef struct gkd_field gkd_field;
typedef struct gkd_stream gkd_stream;

/* Counters since create unless they say otherwise. No padding: a save holds it as it is. */
typedef struct gkd_stats {
    uint64_t samples;                           /* accepted by accumulate */
    uint64_t zeros;                             /* of which radiance was 0 */
    uint64_t rejected;                          /* of which GKD_REJECTED */
    uint64_t refused;                           /* bad samples; best 0 */
    uint64_t clamped;                           /* positions outside the bounds; best 0 */
    uint64_t lost;                              /* samples that met a failed allocation; best 0 */
    uint64_t bytes;                             /* sampling and building part now */
    uint64_t lookahead;                         /* lookahead cells now */
    uint64_t lobes;                             /* in the sampling part now */
    uint64_t opened, closed;                    /* verdicts of the gate so far */
    uint64_t probed;                            /* closed cells tried again so far */
    uint64_t radiance_splits, direction_splits; /* by which test; those that both asked for count in both */
    uint64_t fits;                              /* mixtures that an update changed */
    uint64_t rests;                             /* mixtures that had converged, so that it did not */
    uint64_t alike;                             /* lookahead cells given up so far, since they are like their cell */
    uint64_t denied_splits;                     /* for max_bytes or max_levels; best 0 */
    uint32_t passes;                            /* calls of refine */
    uint32_t updates;
    uint32_t cells;      /* now */
    uint32_t levels;     /* of the deepest cell now */
    uint32_t open_cells; /* gate: guiding shown to pay */
    uint32_t closed_cells;
    uint32_t unjudged_cells;
    float closed_share; /* share of the last pass's samples in closed cells, 0 .. 1 */
    float mean_alpha;   /* over the last pass's samples, closed cells as 1 */
    float reserved;
} gkd_stats;

/* ---- flat data of the sampling part (for queries and ports; not to be changed by callers) */

/* One von Mises-Fisher lobe, 24 bytes. */
typedef struct gkd_lobe {
    float mean[3];  /* unit, as seen from the cell's pivot */
    float kappa;    /* concentration, 0 .. 1e5 */
    float weight;   /* >= 0; a cell's weights sum to 1 */
    float nearness; /* 1 / distance from the pivot to what it shows; 0 = infinitely far */
} gkd_lobe;

/* A cell as queries see it, 32 bytes. */
typedef struct gkd_cell {
    float pivot[3];  /* mean position of its samples */
    uint32_t lobes;  /* index of the first lobe */
    uint32_t count;  /* number of lobes; 0 = untrained: uniform */
    float alpha;     /* probability of sampling the BSDF; 1 = do not guide */
    float reflected; /* see gkd_handle */
    uint32_t gate;   /* GKD_GATE_... */
} gkd_cell;
enum { GKD_GATE_UNJUDGED, GKD_GATE_OPEN, GKD_GATE_CLOSED };

/* A node of the tree, 8 bytes. Leaf: link = GKD_LEAF + cell. Else link = axis << 29 | index of the lower child; the
   upper one follows it. Positions below `split` go to the lower child. */
typedef struct gkd_node {
    float split;
    uint32_t link;
} gkd_node;
#define GKD_LEAF 0x80000000u

/* Pointers into one sampling part. Valid until the next exclusive call. */
typedef struct gkd_view {
    const gkd_node *nodes; /* nodes[0] is the root */
    const gkd_cell *cells;
    const gkd_lobe *lobes;
    float bounds_min[3], bounds_max[3];
    float uniform;
    uint32_t cell_count;
    uint32_t simd;       /* gkd_simd, resolved */
    uint32_t no_product; /* 1: normals bound directions, but the cosine is not multiplied in; the caller may set it */
} gkd_view;

/* ---- >>field ------------------------------------------------------------------------------------------------ */

/* Message that names what to change. [any thread] */
GKD_API const char *gkd_result_string(gkd_result result);

/* Check desc and write it with all defaults filled in to resolved (may be desc itself). [any thread] */
GKD_API gkd_result gkd_resolve(const gkd_desc *desc, gkd_desc *resolved);

/* An untrained field: one cell, uniform density, alpha = desc.alpha. *field = NULL on failure. [any thread] */
GKD_API gkd_result gkd_create(const gkd_desc *desc, gkd_field **field);
GKD_API void gkd_destroy(gkd_field *field); /* NULL is fine; streams are destroyed separately. [exclusive] */
GKD_API const gkd_desc *gkd_get_desc(const gkd_field *field); /* resolved. [any thread] */
GKD_API gkd_view gkd_get_view(const gkd_field *field);        /* for the queries. [any thread] */
GKD_API uint32_t gkd_cell_count(const gkd_field *field);      /* of the sampling part. [any thread] */

/* A buffer of samples, one per image tile or batch, so that its content does not depend on threads. Grows in chunks,
   never copies. Must be destroyed before or after the field, with the same allocator alive. [any thread] */
GKD_API gkd_result gkd_stream_create(const gkd_field *field, gkd_stream **stream);
GKD_API void gkd_stream_destroy(gkd_stream *stream);        /* [per stream] */
GKD_API void gkd_stream_clear(gkd_stream *stream);          /* keeps its memory. [per stream] */
GKD_API uint64_t gkd_stream_size(const gkd_stream *stream); /* samples held. [per stream] */

/* Append. On GKD_OUT_OF_MEMORY the samples that did not fit are lost and counted; the stream stays usable.
   [per stream] */
GKD_API gkd_result gkd_record(gkd_stream *stream, const gkd_training_sample *samples, uint32_t count);

/* Add the samples of streams[0], streams[1], ... in this order to the building part. May be called many times a pass.
   Clear the streams afterwards. On GKD_OUT_OF_MEMORY some samples are lost and counted. [exclusive] */
GKD_API gkd_result gkd_accumulate(gkd_field *field, gkd_stream *const *streams, uint32_t count,
                                  gkd_parallel_fn parallel, void *user);
/* A pass has ended: update with the samples that still wait, then make what was learned the sampling part. pass may be
   NULL. Handles and views become invalid. On failure the sampling part stays; it may be called again. [exclusive] */
GKD_API gkd_result gkd_refine(gkd_field *field, const gkd_pass *pass, gkd_parallel_fn parallel, void *user);

/* Share of image tiles (or paths) that are worth recording in the next pass: 1 while much of the field guides or has
   no verdict, down to 1/64 when nearly all of it is closed: enough to notice changes. [any thread] */
GKD_API float gkd_record_fraction(const gkd_field *field);
/* True when no cell guides: a renderer may skip every query until the next refine. [any thread] */
GKD_API bool gkd_all_closed(const gkd_field *field);

GKD_API void gkd_get_stats(const gkd_field *field, gkd_stats *stats); /* [any thread] */
/* Check every index and sum of both parts: GKD_OK or GKD_CORRUPT. [any thread] */
GKD_API gkd_result gkd_validate(const gkd_field *field);

/* ---- >>store ------------------------------------------------------------------------------------------------ */

/* Bytes that gkd_save writes. [any thread] */
GKD_API size_t gkd_save_bound(const gkd_field *field);
/* Write both parts and the samples that wait, so that training can go on after load. *size = bytes written.
   [any thread] */
GKD_API gkd_result gkd_save(const gkd_field *field, void *data, size_t capacity, size_t *size);
/* Restore. Options come from the save; desc (may be NULL) gives the allocator and the simd level. The data need not be
   aligned and may come from an untrusted source. *field = NULL on failure. [any thread] */
GKD_API gkd_result gkd_load(const gkd_desc *desc, const void *data, size_t size, gkd_field **field);

/* Equal for fields whose building parts have the same cells. Changes when cells split. [any thread] */
GKD_API uint64_t gkd_structure_id(const gkd_field *field);
/* Take over the samples that wait in source: what it accumulated since its last update (desc.update_samples large
   enough: since its last refine). GKD_MISMATCH unless both have had the same updates. [exclusive] on field, source is
   only read. */
GKD_API gkd_result gkd_merge(gkd_field *field, const gkd_field *source, gkd_parallel_fn parallel, void *user);

/* ---- >>query ------------------------------------------------------------------------------------------------ */

/* Lobes as seen from a position, eight a block of 224 bytes, so that lanes are lobes. Lanes past the last lobe have
   scale 0 and upper 1. Density of a lobe at w: scale 2^(-falloff |w - mean|^2), and the same at w mirrored about the
   surface where there is one: |mirrored w - mean|^2 = |w - mean|^2 + 4 (w . normal) (mean . normal). */
typedef struct gkd_lobe_block {
    float x[8], y[8], z[8]; /* unit mean; on the normal's side */
    float falloff[8];       /* kappa / 2 in powers of two: kappa / (2 ln 2) */
    float lift[8];          /* 4 falloff (mean . normal) >= 0; 0 without a normal */
    float scale[8];         /* weight kappa / (2 pi (1 - exp(-2 kappa))): density at the mean */
    float upper[8];         /* sum of the weights up to this one; the last lobe's is 1 */
} gkd_lobe_block;

typedef struct gkd_handle {
    uint32_t cell, count; /* count: lobes, at least 1 */
    uint32_t surface;     /* 1: normal is one */
    float alpha, reflected;
    float normal[3];      /* 0 = full sphere. Else directions below are mirrored up: p'(w) = p(w) + p(mirrored w) */
    float uniform;        /* e: share of uniform sphere sampling */
    uint32_t simd;        /* level of the view that found it: gkd_sample and gkd_pdf use it */
    uint32_t reserved[6]; /* the blocks start at byte 64 */
    gkd_lobe_block block[GKD_MAX_LOBES / 8]; /* (count + 7) / 8 are set */
} gkd_handle;

/* Find, sample and pdf of one, by the SIMD level: what the inline functions call, unless GKD_QUERY is defined. Two
   to three times the time of batches: one waits for its own results. [any thread] */
GKD_API void gkd_find_one(const gkd_view *view, const float position[3], const float *normal, const float *u,
                          gkd_handle *handle);
GKD_API float gkd_sample_one(const gkd_handle *handle, const float u[2], float direction[3]);
GKD_API float gkd_pdf_one(const gkd_handle *handle, const float direction[3]);

#define GKD_LN2 0.69314718055994531f
#define GKD_LOG2E 1.44269504088896341f
#define GKD_PI 3.14159265358979324f
#define GKD_MIN_KAPPA 1e-6f /* smaller ones count as this */
#define GKD_MAX_KAPPA 1e5f

/* Functions of one number */

GKD_QUERY float gkd_least(float a, float b) { return a < b ? a : b; } /* b where a is NaN; one instruction */
GKD_QUERY float gkd_most(float a, float b) { return a > b ? a : b; }
GKD_QUERY float gkd_clamp(float x, float low, float high) { return gkd_least(gkd_most(x, low), high); }

/* 2^t for t <= 127; 2^-100 from there down. Minimax polynomial of degree 5 on [-1/2, 1/2]: relative error 2e-7, that
   of t apart. [any thread] */
GKD_QUERY float gkd_exp2(float t)
{
    float c = gkd_most(t, -100), f, p; /* no denormal numbers: slow */
    int32_t e = (int32_t)(c + 127.5f);
    uint32_t bits = (uint32_t)e << 23;
    f = c - (float)(e - 127);
    p = 1.32647291e-3f * f + 9.67151396e-3f;
    p = p * f + 5.55073375e-2f;
    p = p * f + 2.40222421e-1f;
    p = p * f + 6.93146978e-1f;
    p = p * f + 1;
    memcpy(&f, &bits, sizeof f);
    return f * p;
}

/* 1 - exp(-x) for x >= 0, without cancellation. */
GKD_QUERY float gkd_one_minus_exp(float x)
{
    float s = x * (1 - x * (1.0f / 2) *
                           (1 - x * (1.0f / 3) * (1 - x * (1.0f / 4) * (1 - x * (1.0f / 5) * (1 - x * (1.0f / 6))))));
    return x < 0.25f ? s : 1 - gkd_exp2(-GKD_LOG2E * x);
}

/* -log(1 - y) for 0 <= y < 1, without cancellation: 2^e m = 1 - y, sqrt(1/2) <= m < sqrt(2), then
   log m = 2 atanh((m - 1) / (m + 1)). */
GKD_QUERY float gkd_minus_log1m(float y)
{
    float t = 1 - y, d, z, q;
    uint32_t bits;
    int32_t e;
    memcpy(&bits, &t, sizeof bits);
    e = (int32_t)(bits - 0x3f3504f3u) >> 23;
    bits -= (uint32_t)e << 23;
    memcpy(&t, &bits, sizeof t);
    d = t - 1;
    d += (float)(e == 0) * (-y - d); /* -y there: exact; no branch */
    z = d / (2 + d);
    q = z * z;
    q = 2 * z * (1 + q * (1.0f / 3 + q * (1.0f / 5 + q * (1.0f / 7 + q * (1.0f / 9)))));
    return -(q + (float)e * GKD_LN2);
}

/* sin(2 pi x) for |x| <= 1/4; minimax: error 2e-7, of rounding. */
GKD_QUERY float gkd_sine(float x)
{
    float q = x * x;
    return x * (6.2831852f + q * (-41.341655f + q * (81.601004f + q * (-76.549782f + q * 39.536707f))));
}

/* Sine and cosine of 2 pi u, 0 <= u < 1, without branches, which could not be predicted. */
GKD_QUERY void gkd_circle(float u, float *sine, float *cosine)
{
    float d = 0.5f - u;
    *sine = gkd_sine(gkd_most(gkd_least(d, 0.5f - d), -0.5f - d));
    *cosine = gkd_sine(fabsf(d) - 0.25f);
}

/* a . b without cancellation. */
GKD_QUERY float gkd_dot(const float a[3], const float b[3])
{
    return (float)((double)a[0] * (double)b[0] + (double)a[1] * (double)b[1] + (double)a[2] * (double)b[2]);
}

/* Orient */

#define GKD_SHARPER 1.25f /* most that kappa grows with distance; tuned on SF1 (1 .. 4) */
#define GKD_DIM 1e-4f     /* of a mixture's weight above the horizon; with less, its lobes there are mere tails */

/* Orienting goes in steps over all lobes, each short enough that the processor overlaps several lobes. Until the last
   step a block holds kappa in falloff and the weight in upper. */

/* Seen from elsewhere: direction of pivot + mean / nearness - position [Ruppert 2020], without division by nearness.
   l^2 = (distance there / distance from the pivot)^2: a patch of fixed size and radiance has 1 / l^2 of the solid angle
   (hence weight) and l^2 of the concentration. At the source itself the direction stays and kappa becomes small. Own.
 */
GKD_QUERY void gkd_turn_lobe(gkd_handle *handle, uint32_t i, const gkd_lobe *lobe, const float offset[3])
{
    gkd_lobe_block *b = &handle->block[i / 8];
    float x = lobe->mean[0] + offset[0] * lobe->nearness, y = lobe->mean[1] + offset[1] * lobe->nearness;
    float z = lobe->mean[2] + offset[2] * lobe->nearness, l2 = x * x + y * y + z * z, r;
    bool fine = l2 > 1e-6f && l2 < 1e12f;
    i %= 8;
    r = fine ? 1 / sqrtf(l2) : 1;
    b->x[i] = fine ? x * r : lobe->mean[0];
    b->y[i] = fine ? y * r : lobe->mean[1];
    b->z[i] = fine ? z * r : lobe->mean[2];
    b->falloff[i] = gkd_clamp(lobe->kappa * gkd_clamp(l2, 1e-3f, GKD_SHARPER), GKD_MIN_KAPPA, GKD_MAX_KAPPA);
    b->upper[i] = gkd_most(lobe->weight, 0) / gkd_clamp(l2, 0.25f, 4);
    b->lift[i] = 0;
}

/* Weight above the surface, and in lift how much of the normal is to be added to kappa mean.
   product: multiply by max(0, w . normal). X = w . normal is nearly a normal variable of mean m and variance s^2 which,
   with x = m / s, has E[max(0, X)] = s (x Phi(x) + phi(x)). How that grows with the mean, P(X > 0) = Phi(x), tells
   where the product lies (Stein's lemma): kappa mean grows by Phi(x) / E of the normal. That is within 2 % of the best
   lobe by integral(h^2 / p). m and s: fits to the integral over a lobe, within 0.005; exact for kappa = 0 and large
   kappa. Phi: Boyd 1959's bound of Mills' ratio. Without product only cut at the horizon: what lies above keeps its
   weight, since it was learned above horizons; a lobe below is moved up to it. No branches on signs, which cannot be
   predicted. Own. */
GKD_QUERY void gkd_weigh_lobe(gkd_handle *handle, uint32_t i, bool product)
{
    gkd_lobe_block *b = &handle->block[i / 8];
    const float *n = handle->normal;
    float c, c2, k, j, d, m, s, x, a, phi, q, tail, above, e;
    i %= 8;
    c = b->x[i] * n[0] + b->y[i] * n[1] + b->z[i] * n[2];
    c2 = gkd_least(c * c, 1);
    k = b->falloff[i];
    j = gkd_least(k, 1e4f);
    d = 1 + j * (0.5f + 0.2f * j);
    m = c * j * d / ((j + 1) * d + 2);
    s = sqrtf((1 - c2) * d / ((j + 0.78f) * d + 1.766f) + c2 / (0.24f * j * j + 2.546f));
    x = m / s;
    a = gkd_least(fabsf(x), 8); /* farther, nothing is left above or below */
    phi = 0.39894228f * gkd_exp2(-0.5f * GKD_LOG2E * a * a);
    q = sqrtf(a * a + 2 * GKD_PI);
    tail = phi * GKD_PI / ((GKD_PI - 1) * a + q);
    above = tail + (float)(x > 0) * (1 - 2 * tail);
    e = s * (0.5f * (x + fabsf(x)) + 2 * tail / (q + a));
    b->lift[i] = gkd_least(product ? above / e : 0.5f * k * (fabsf(c) - c), 2 * k + 4);
    b->upper[i] *= product ? e : gkd_least(2 * above, 1);
}

/* kappa mean += lift normal, then mirrored up (a lobe and its mirror image are the same when mirrored up); lift as it
   is to be. */
GKD_QUERY void gkd_tilt_lobe(gkd_handle *handle, uint32_t i)
{
    gkd_lobe_block *b = &handle->block[i / 8];
    const float *n = handle->normal;
    float k, l2, r, m[3];
    i %= 8;
    k = b->falloff[i];
    r = b->lift[i];
    m[0] = b->x[i] * k + n[0] * r;
    m[1] = b->y[i] * k + n[1] * r;
    m[2] = b->z[i] * k + n[2] * r;
    l2 = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
    if (l2 < 1e-6f * k * k) { /* straight below */
        m[0] = n[0] * k;
        m[1] = n[1] * k;
        m[2] = n[2] * k;
        l2 = k * k;
    }
    r = 1 / sqrtf(l2);
    k = gkd_clamp(l2 * r, GKD_MIN_KAPPA, GKD_MAX_KAPPA);
    m[0] *= r;
    m[1] *= r;
    m[2] *= r;
    r = m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
    r -= fabsf(r);
    b->x[i] = m[0] -= r * n[0];
    b->y[i] = m[1] -= r * n[1];
    b->z[i] = m[2] -= r * n[2];
    b->falloff[i] = k;
    b->lift[i] = k * (2 * GKD_LOG2E) * gkd_most(gkd_dot(m, n), 0);
}

/* The cosine alone, or without a surface all directions alike. */
GKD_QUERY void gkd_set_plain(gkd_handle *handle, bool product)
{
    gkd_lobe_block *b = &handle->block[0];
    const float *n = handle->normal;
    float k = product && handle->surface ? 2.46f : GKD_MIN_KAPPA; /* 2.46: least integral(cos^2 / p), 1.06 pi^2 */
    b->x[0] = n[0];
    b->y[0] = n[1];
    b->z[0] = handle->surface ? n[2] : 1;
    b->falloff[0] = k;
    b->lift[0] = handle->surface ? k * (2 * GKD_LOG2E) : 0;
    b->upper[0] = 1;
    handle->count = 1;
}

/* Weights become sums up to 1; scale and falloff as they are to be; lanes past the last lobe. */
GKD_QUERY void gkd_finish_lobes(gkd_handle *handle, float sum)
{
    float l = 1 / sum, upper = 0;
    uint32_t i;
    for (i = 0; i < handle->count; ++i) {
        gkd_lobe_block *b = &handle->block[i / 8];
        float k = b->falloff[i % 8], w = b->upper[i % 8] * l;
        b->scale[i % 8] = w * k / (2 * GKD_PI * gkd_one_minus_exp(2 * k));
        b->falloff[i % 8] = k * (0.5f * GKD_LOG2E);
        b->upper[i % 8] = upper += w;
    }
    handle->block[(i - 1) / 8].upper[(i - 1) % 8] = 1;
    for (; i % 8; ++i) {
        gkd_lobe_block *b = &handle->block[i / 8];
        b->x[i % 8] = b->y[i % 8] = b->falloff[i % 8] = b->lift[i % 8] = b->scale[i % 8] = 0;
        b->z[i % 8] = b->upper[i % 8] = 1;
    }
}

/* Vector from position to pivot, 0 where it is not finite; normal of the handle. True where there is a surface. */
GKD_QUERY bool gkd_place_handle(gkd_handle *handle, const float pivot[3], const float position[3], const float *normal,
                                float offset[3])
{
    float l = normal ? normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] : 0;
    bool surface = l > 0.5f && l < 2;
    uint32_t i;
    l = fabsf(l - 1) > 1e-5f && surface ? 1 / sqrtf(l) : 1; /* draws mirrored by another length would not be unit */
    handle->surface = surface;
    handle->simd = GKD_SIMD_SCALAR; /* find knows better */
    for (i = 0; i < 3; ++i) {
        offset[i] = pivot[i] - position[i];
        handle->normal[i] = surface ? normal[i] * l : 0;
    }
    if (!(fabsf(offset[0]) + fabsf(offset[1]) + fabsf(offset[2]) < 1e18f))
        offset[0] = offset[1] = offset[2] = 0;
    return surface;
}

/* The lobes (at most GKD_MAX_LOBES) of a cell as seen from a position; sets count, surface, normal and blocks of the
   handle. normal: unit, NULL or zero = full sphere. product: multiply by the cosine; else only cut at the horizon.
   [any thread] */
GKD_QUERY void gkd_orient_lobes_as(gkd_handle *handle, const gkd_lobe *lobes, uint32_t count, const float pivot[3],
                                   const float position[3], const float *normal, bool product)
{
    float offset[3], sum = 0;
    bool surface = gkd_place_handle(handle, pivot, position, normal, offset);
    uint32_t i;
    handle->count = count;
    for (i = 0; i < count; ++i)
        gkd_turn_lobe(handle, i, &lobes[i], offset);
    for (i = 0; surface && i < count; ++i)
        gkd_weigh_lobe(handle, i, product);
    for (i = 0; surface && i < count; ++i)
        gkd_tilt_lobe(handle, i);
    for (i = 0; i < count; ++i)
        sum += handle->block[i / 8].upper[i % 8];
    if (!(sum > GKD_DIM)) {
        gkd_set_plain(handle, product);
        sum = 1;
    }
    gkd_finish_lobes(handle, sum);
}

GKD_QUERY void gkd_orient_lobes(gkd_handle *handle, const gkd_lobe *lobes, uint32_t count, const float pivot[3],
                                const float position[3], const float *normal)
{
    gkd_orient_lobes_as(handle, lobes, count, pivot, position, normal, true);
}

/* Pdf, sample */

/* Density (1/sr) of a unit direction: (1 - e) p' + e / (4 pi), and e / (4 pi) below the surface. By differences, since
   kappa (mean . w - 1) cancels. Relative error 1e-5. gkd_pdf of the scalar level. [any thread] */
GKD_QUERY float gkd_pdf_scalar(const gkd_handle *handle, const float direction[3])
{
    const float e = handle->uniform, x = direction[0], y = direction[1], z = direction[2];
    float sum[8] = {0, 0, 0, 0, 0, 0, 0, 0}, c;
    uint32_t i, k;
    float mirrored = handle->surface ? 1.0f : 0.0f; /* no branch in the loop: then it is vectors */
    c = gkd_dot(direction, handle->normal);
    if (handle->surface && !(c > 0))
        return e * (1 / (4 * GKD_PI));
    for (i = 0; i < handle->count; i += 8) {
        const gkd_lobe_block *b = &handle->block[i / 8];
        for (k = 0; k < 8; ++k) {
            float dx = x - b->x[k], dy = y - b->y[k], dz = z - b->z[k];
            float t = -b->falloff[k] * (dx * dx + dy * dy + dz * dz);
            sum[k] += b->scale[k] * (gkd_exp2(t) + mirrored * gkd_exp2(t - b->lift[k] * c));
        }
    }
    return (1 - e) * (((sum[0] + sum[4]) + (sum[2] + sum[6])) + ((sum[1] + sum[5]) + (sum[3] + sum[7]))) +
           e * (1 / (4 * GKD_PI));
}

/* Density (1/sr) of a unit direction, as above, by the SIMD level of the handle. [any thread] */
GKD_QUERY float gkd_pdf(const gkd_handle *handle, const float direction[3])
{
#ifdef GKD_QUERY_SIMD
    if (handle->simd > GKD_SIMD_SCALAR)
        return gkd_pdf_one(handle, direction);
#endif
    return gkd_pdf_scalar(handle, direction);
}

/* A draw: what to draw from, and with which numbers. */
typedef struct gkd_draw {
    float mean[3], kappa; /* kappa = 1e-6: uniform */
    float normal[3];      /* to mirror about */
    float r, turn;        /* random numbers: polar, around */
} gkd_draw;

/* Random numbers of 24 bits, as floats are, get more: a fraction of 2^-24 from all bits of u. */
GKD_QUERY float gkd_extend_random(const float u[2])
{
    uint32_t h, bits[2];
    memcpy(bits, u, sizeof bits);
    h = bits[0] * 0x9e3779b1u + bits[1] * 0x85ebca6bu + 0x27d4eb2fu;
    h = (h ^ (h >> 15)) * 0x2c1b3c6du;
    h ^= h >> 13;
    return (float)(h >> 8) * (5.9604645e-8f * 5.9604645e-8f);
}

/* The lobe for a number r in [0, 1), of which the index is given: parameters, and what remains of r. */
GKD_QUERY void gkd_draw_lobe(const gkd_handle *handle, uint32_t i, float r, float extra, gkd_draw *out)
{
    const gkd_lobe_block *b;
    float low, width;
    uint32_t k;
    i = i < handle->count ? i : handle->count - 1;
    low = i ? handle->block[(i - 1) / 8].upper[(i - 1) % 8] : 0;
    b = &handle->block[i / 8];
    k = i % 8;
    width = b->upper[k] - low;
    out->r = (r - low + extra) / gkd_most(width, 1e-9f);
    out->mean[0] = b->x[k];
    out->mean[1] = b->y[k];
    out->mean[2] = b->z[k];
    out->kappa = b->falloff[k] * (2 * GKD_LN2);
    out->normal[0] = handle->normal[0];
    out->normal[1] = handle->normal[1];
    out->normal[2] = handle->normal[2];
}

GKD_QUERY void gkd_draw_uniform(float r, float extra, float e, gkd_draw *out)
{
    out->r = (r + extra) / e;
    out->mean[0] = out->mean[1] = 0;
    out->mean[2] = 1;
    out->kappa = 1e-6f;
    out->normal[0] = out->normal[1] = out->normal[2] = 0;
}

/* u[0] chooses between the uniform share and the lobes, in order. */
GKD_QUERY void gkd_choose_lobe(const gkd_handle *handle, const float u[2], gkd_draw *out)
{
    float e = handle->uniform, extra = gkd_extend_random(u), r = (u[0] - e) / (1 - e);
    uint32_t i, k, n = 0;
    out->turn = u[1];
    if (u[0] < e) {
        gkd_draw_uniform(u[0], extra, e, out);
        return;
    }
    for (i = 0; i < handle->count; i += 8)
        for (k = 0; k < 8; ++k)
            n += handle->block[i / 8].upper[k] <= r;
    gkd_draw_lobe(handle, n, r, extra / (1 - e), out);
}

/* Draws from a lobe: 1 - cosine = -log(1 - r (1 - exp(-2 kappa))) / kappa, mirrored up. Frame: Duff et al. 2017. */
GKD_QUERY void gkd_draw_direction(const gkd_draw *in, float direction[3])
{
    const float *m = in->mean, *n = in->normal;
    float v = gkd_minus_log1m(gkd_clamp(in->r, 0, 0.99999994f) * gkd_one_minus_exp(2 * in->kappa)) / in->kappa;
    float s, c, radius, sign = m[2] < 0 ? -1.0f : 1.0f, a = -1 / (sign + m[2]), b = m[0] * m[1] * a;
    uint32_t k;
    v = v < 2 ? v : 2;
    radius = sqrtf(v * (2 - v));
    gkd_circle(in->turn, &s, &c);
    s *= radius;
    c *= radius;
    v = 1 - v;
    direction[0] = v * m[0] + c * (1 + sign * m[0] * m[0] * a) + s * b;
    direction[1] = v * m[1] + c * sign * b + s * (sign + m[1] * m[1] * a);
    direction[2] = v * m[2] - c * sign * m[0] - s * m[1];
    a = direction[0] * n[0] + direction[1] * n[1] + direction[2] * n[2];
    a = 2 * gkd_least(a, 0);
    b = 0;
    for (k = 0; k < 3; ++k) {
        direction[k] -= a * n[k];
        b += direction[k] * direction[k];
    }
    for (k = 0; k < 3; ++k)
        direction[k] *= 1.5f - 0.5f * b;
}

/* gkd_sample of the scalar level. [any thread] */
GKD_QUERY float gkd_sample_scalar(const gkd_handle *handle, const float u[2], float direction[3])
{
    gkd_draw draw;
    gkd_choose_lobe(handle, u, &draw);
    gkd_draw_direction(&draw, direction);
    return gkd_pdf_scalar(handle, direction);
}

/* Draw a direction; returns its density, of the rounded direction, by gkd_pdf. u in [0,1): u[0] chooses the lobe
   (monotone) and, with what remains of it, the angle to its mean; u[1] the angle around. [any thread] */
GKD_QUERY float gkd_sample(const gkd_handle *handle, const float u[2], float direction[3])
{
#ifdef GKD_QUERY_SIMD
    if (handle->simd > GKD_SIMD_SCALAR)
        return gkd_sample_one(handle, u, direction);
#endif
    return gkd_sample_scalar(handle, u, direction);
}

/* Resample */

/* One of several directions that might be taken. */
typedef struct gkd_candidate {
    float pdf_bsdf, pdf_guide; /* densities of the direction, 1/sr: sampling the BSDF's; gkd_pdf */
    float f;                   /* mean over channels of the BSDF there, without cosine; 0 where drawing failed */
    float cosine;              /* with the normal that gkd_find got. Without one, or with view.no_product: 1, the cosine
                                  in f */
} gkd_candidate;

/* What candidates are chosen by: the BSDF times the radiance and cosine as the guide sees them, of which a share is
   taken to be even, for the guide may be wrong. The guide's density holds the cosine. */
#define GKD_RESAMPLE_GUIDE 0.9f /* tuned on a glossy scene (0.5 .. 0.95) */
GKD_QUERY float gkd_candidate_target(const gkd_candidate *c)
{
    float target =
        c->f * (GKD_RESAMPLE_GUIDE * c->pdf_guide + (1 - GKD_RESAMPLE_GUIDE) * (1 / GKD_PI) * gkd_most(c->cosine, 0));
    return target > 0 && target < 1e30f ? target : 0;
}

/* Choose one of `count` candidates (at least 1), u in [0,1): see Resampling. Returns its index and in *pdf what its
   contribution is to be divided by; `count` and 0 where none can be taken: the contribution is 0. [any thread] */
GKD_QUERY uint32_t gkd_resample(const gkd_candidate *candidates, uint32_t count, float alpha, float u, float *pdf)
{
    float sum = 0, chosen = 0;
    uint32_t i, index = count;
    for (i = 0; i < count; ++i) {
        const gkd_candidate *c = &candidates[i];
        float target = gkd_candidate_target(c), mix = alpha * c->pdf_bsdf + (1 - alpha) * c->pdf_guide;
        float weight = mix > 0 ? target / mix : 0, p;
        if (!(weight > 0 && sum + weight < 1e30f))
            continue;
        sum += weight;
        p = weight / sum;
        if (u < p) { /* what remains of u is uniform again */
            u = u / p;
            index = i;
            chosen = target;
        } else {
            u = (u - p) / (1 - p);
        }
    }
    *pdf = sum > 0 ? (float)count * chosen / sum : 0;
    return index;
}

/* Leaf of the tree at a position. NaN goes up. [any thread] */
GKD_QUERY uint32_t gkd_find_cell(const gkd_view *view, const float position[3])
{
    uint32_t link = view->nodes[0].link;
    float split = view->nodes[0].split;
    while (!(link & GKD_LEAF)) {
        const gkd_node *node = &view->nodes[(link & 0x1fffffffu) + !(position[link >> 29] < split)];
        link = node->link;
        split = node->split;
    }
    return link & ~GKD_LEAF;
}

/* The same, and the box of the cell. [any thread] */
GKD_QUERY uint32_t gkd_find_box(const gkd_view *view, const float position[3], float low[3], float high[3])
{
    uint32_t link = view->nodes[0].link, axis;
    float split = view->nodes[0].split;
    for (axis = 0; axis < 3; ++axis) {
        low[axis] = view->bounds_min[axis];
        high[axis] = view->bounds_max[axis];
    }
    while (!(link & GKD_LEAF)) {
        const gkd_node *node;
        axis = link >> 29;
        if (position[axis] < split)
            high[axis] = split;
        else
            low[axis] = split;
        node = &view->nodes[(link & 0x1fffffffu) + !(position[axis] < split)];
        link = node->link;
        split = node->split;
    }
    return link & ~GKD_LEAF;
}

/* The position moved within the size of its cell. [any thread] */
GKD_QUERY void gkd_jitter(const gkd_view *view, const float position[3], const float u[3], float out[3])
{
    float low[3], high[3];
    uint32_t axis;
    gkd_find_box(view, position, low, high);
    for (axis = 0; axis < 3; ++axis)
        out[axis] = position[axis] + (u[axis] - 0.5f) * (high[axis] - low[axis]);
}

/* The cell of a position; with u, three random numbers in [0,1), that of the position jittered by the size of its cell,
   which blends neighbours. [any thread] */
GKD_QUERY uint32_t gkd_find_cell_near(const gkd_view *view, const float position[3], const float *u)
{
    float p[3];
    if (!u)
        return gkd_find_cell(view, position);
    gkd_jitter(view, position, u, p);
    return gkd_find_cell(view, p);
}

/* What a view knows of a cell, but for the lobes. [any thread] */
GKD_QUERY const gkd_cell *gkd_set_cell(const gkd_view *view, uint32_t index, gkd_handle *handle)
{
    const gkd_cell *cell = &view->cells[index];
    handle->cell = index;
    handle->alpha = cell->alpha;
    handle->reflected = cell->reflected;
    handle->uniform = view->uniform;
    return cell;
}

/* gkd_find of the scalar level. [any thread] */
GKD_QUERY void gkd_find_scalar(const gkd_view *view, const float position[3], const float *normal, const float *u,
                               gkd_handle *handle)
{
    const gkd_cell *cell = gkd_set_cell(view, gkd_find_cell_near(view, position, u), handle);
    gkd_orient_lobes_as(handle, view->lobes + cell->lobes, cell->count, cell->pivot, position, normal,
                        !view->no_product);
}

/* Find the cell of a position and its lobes as seen from there. normal (unit, on the side that light comes from) makes
   the density follow the cosine there; NULL or zero = no surface, or one that light passes. u: see gkd_find_cell_near
   (unbiased: sample and pdf speak of the handle's cell); NULL = the cell it lies in. [any thread] */
GKD_QUERY void gkd_find(const gkd_view *view, const float position[3], const float *normal, const float *u,
                        gkd_handle *handle)
{
#ifdef GKD_QUERY_SIMD
    if (view->simd > GKD_SIMD_SCALAR) {
        gkd_find_one(view, position, normal, u, handle);
        return;
    }
#endif
    gkd_find_scalar(view, position, normal, u, handle);
}

/* A handle is large and mostly unset: copy what is set. [any thread] */
GKD_QUERY void gkd_copy_handle(gkd_handle *to, const gkd_handle *from)
{
    memcpy(to, from, offsetof(gkd_handle, block) + (from->count + 7) / 8 * sizeof from->block[0]);
}

/* Octahedral coordinates of a direction or normal, both in [-1, 1]. [any thread] */
GKD_QUERY void gkd_octahedral(const float d[3], float *a, float *b)
{
    float n = fabsf(d[0]) + fabsf(d[1]) + fabsf(d[2]), x = d[0] / n, y = d[1] / n, t;
    if (d[2] < 0) {
        t = (1 - fabsf(y)) * (x < 0 ? -1.0f : 1.0f);
        y = (1 - fabsf(x)) * (y < 0 ? -1.0f : 1.0f);
        x = t;
    }
    *a = x;
    *b = y;
}

/* And back, to unit length. [any thread] */
GKD_QUERY void gkd_from_octahedral(float a, float b, float d[3])
{
    float c = 1 - fabsf(a) - fabsf(b), t = c < 0 ? c : 0, l;
    a += a < 0 ? -t : t;
    b += b < 0 ? -t : t;
    l = 1 / sqrtf(a * a + b * b + c * c);
    d[0] = a * l;
    d[1] = b * l;
    d[2] = c * l;
}

/* Direction as the field keeps it: octahedral, 24 bits a coordinate, above them the normal's octahedral coordinates
   with 8 bits each, 0 = none. Error of a direction 1e-7. False where the direction is not finite or zero. [any thread]
   */
GKD_QUERY bool gkd_pack_direction(const float direction[3], const float *normal, uint32_t packed[2])
{
    float l = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2], a = 0, b = 0, n;
    bool valid = l > 1e-12f && l < 1e12f;
    if (valid)
        gkd_octahedral(direction, &a, &b);
    packed[0] = (uint32_t)(8388608.0f + a * 8388607.0f);
    packed[1] = (uint32_t)(8388608.0f + b * 8388607.0f);
    n = normal ? fabsf(normal[0]) + fabsf(normal[1]) + fabsf(normal[2]) : 0;
    if (!(n > 0.5f && n < 4))
        return valid;
    gkd_octahedral(normal, &a, &b);
    packed[0] |= (uint32_t)(128.5f + 127 * a) << 24;
    packed[1] |= (uint32_t)(128.5f + 127 * b) << 24;
    return valid;
}

/* Direction (unit) of a sample. [any thread] */
GKD_QUERY void gkd_unpack_direction(const uint32_t packed[2], float direction[3])
{
    const float step = 1.0f / 8388607;
    gkd_from_octahedral(((float)(int32_t)(packed[0] & 0xffffffu) - 8388608.0f) * step,
                        ((float)(int32_t)(packed[1] & 0xffffffu) - 8388608.0f) * step, direction);
}

/* Normal of a sample; zero where it has none. [any thread] */
GKD_QUERY void gkd_unpack_normal(const uint32_t packed[2], float normal[3])
{
    normal[0] = normal[1] = normal[2] = 0;
    if (packed[0] >> 24)
        gkd_from_octahedral(((float)(packed[0] >> 24) - 128) / 127, ((float)(packed[1] >> 24) - 128) / 127, normal);
}

/* A training sample from scalars: radiance = largest channel, contributions = channel means; normal: what gkd_find got,
   NULL = none; distance to the next vertex, INFINITY = the environment. [any thread] */
GKD_QUERY gkd_training_sample gkd_make_scalar_sample(const float position[3], const float direction[3],
                                                     const float *normal, float distance, float radiance,
                                                     float contribution, float pixel_contribution, float pdf_mix,
                                                     float pdf_bsdf, float pdf_guide)
{
    gkd_training_sample s;
    memcpy(s.position, position, sizeof s.position);
    s.nearness = distance > 0 ? 1 / distance : -1; /* -1: will be refused, NaN too */
    s.radiance = radiance;
    s.contribution = contribution;
    s.pixel_contribution = pixel_contribution;
    s.pdf_mix = gkd_pack_direction(direction, normal, s.direction) ? pdf_mix : 0; /* 0: will be refused */
    s.pdf_bsdf = pdf_bsdf;
    s.pdf_guide = pdf_guide;
    return s;
}

/* A training sample from the renderer's RGB values: L incident radiance, f BSDF without the cosine, pixel_weight
   throughput before this vertex / pixel estimate (NULL = 1). [any thread] */
GKD_QUERY gkd_training_sample gkd_make_sample(const float position[3], const float direction[3], const float *normal,
                                              float distance, const float L[3], const float f[3], float cosine,
                                              const float pixel_weight[3], float pdf_mix, float pdf_bsdf,
                                              float pdf_guide)
{
    float radiance = L[0], contribution = 0, pixel = 0;
    int c;
    for (c = 0; c < 3; ++c) {
        float v = f[c] * L[c] * cosine * (1.0f / 3.0f);
        radiance = L[c] > radiance || !(L[c] - L[c] == 0) ? L[c] : radiance; /* what is not finite must show */
        contribution += v;
        pixel += pixel_weight ? v * pixel_weight[c] : v;
    }
    return gkd_make_scalar_sample(position, direction, normal, distance, radiance, contribution, pixel, pdf_mix,
                                  pdf_bsdf, pdf_guide);
}

/* ---- >>batch ------------------------------------------------------------------------------------------------ */

/* The queries for arrays: several in flight at once, by the SIMD level of the view. index lists the entries to process
   in all arrays (NULL = 0 .. count - 1); strides are in bytes. normals, u and alpha (dense floats) of find may be NULL.
   Handles are dense. Densities differ between levels by <= 1e-5 relative, by 5e-5 at kappa 1e5.
   [any thread] */
GKD_API void gkd_find_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gkd_handle *handles, float *alpha);
GKD_API void gkd_sample_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const gkd_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t direction_stride, float *pdf);
GKD_API void gkd_pdf_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const gkd_handle *handles,
                           const float *directions, size_t direction_stride, float *pdf);
/* One handle, many directions. [any thread] */
GKD_API void gkd_pdf_directions(const gkd_view *view, const gkd_handle *handle, uint32_t count, const float *directions,
                                size_t direction_stride, float *pdf);

#ifdef __cplusplus
}
#endif

#endif /* GUIDE_KD_H */

/* ============================================== IMPLEMENTATION ============================================== */

#if defined(GKD_IMPLEMENTATION) && !defined(GKD_IMPLEMENTATION_DONE)
#define GKD_IMPLEMENTATION_DONE

/* Based on the papers listed under REFERENCES; no other code. */

#include <stdlib.h>

#ifndef GKD_ASSERT
#include <assert.h>
#define GKD_ASSERT(x) assert(x)
#endif
#ifndef GKD_MALLOC
#define GKD_MALLOC(n) malloc(n)
#define GKD_FREE(p) free(p)
#endif

#if !defined(GKD_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__x86_64__)
#define GKDI_X86 1
#include <immintrin.h>
#define GKDI_EXACT __attribute__((target("avx2"))) /* no fma: for what has the same bits at every level */
#else
#define GKDI_X86 0
#endif
#if !defined(GKD_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__aarch64__)
#define GKDI_NEON 1
#include <arm_neon.h>
#else
#define GKDI_NEON 0
#endif

/* What decides structure must not depend on contraction into fused multiply-adds. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#if defined(__GNUC__) || defined(__clang__)
#define GKDI_PREFETCH(p) __builtin_prefetch(p)
#else
#define GKDI_PREFETCH(p) ((void)(p))
#endif

#define GKDI_GATE_LOW 4        /* values of a below 1 at which V(a) is estimated */
#define GKDI_MAX_VALUE 9.9e29f /* radiance or weight from here on is a bad sample */
#define GKDI_MAX_ROOT 1e15     /* contributions are clamped to this before squaring */
#define GKDI_CONFIDENCE 1.645  /* one-sided 95 % of the normal distribution */
#define GKDI_MIN_EFFECTIVE                                                                                             \
    128.0                  /* effective non-zero samples for the verdict "this mixture does not pay"; fewer            \
                              closes cells whose light is rarely found */
#define GKDI_MIN_EVEN 32.0 /* for "too even to pay" */
#define GKDI_MIN_EVEN_REBUILDS                                                                                         \
    8 /* and before that verdict: the first cells are large, and have not yet found light that is rare; without it all \
         of pool closes at once */
#define GKDI_MIN_OPEN 4.0         /* for "pays" */
#define GKDI_ENOUGH_HITS 256u     /* non-zero samples of a cell and pass; from then on the gate takes one of eight */
#define GKDI_REFLECTED_SAMPLES 32 /* of a cell and pass, for its mean reflected radiance to count */
#define GKDI_MIN_REBUILDS 3       /* before that verdict: the first mixtures are noise */
#define GKDI_MAX_LOOK 255         /* nodes of a cell's lookahead tree: 2^(7 + 1) - 1 */
#define GKDI_MAX_CELLS (1u << 26)
#define GKDI_NONE 0xffffffffu
#define GKDI_CALM 0.005f    /* nats: a guide so far from the best costs so little that noise of pictures hides it */
#define GKDI_CALM_FITS 2    /* in a row: one may be chance */
#define GKDI_AHEAD 16       /* samples in the order of cells lie anywhere: so many are on their way */
#define GKDI_GROUP 16       /* positions looked up, handles oriented together */
#define GKDI_PACKED_COUNT 3 /* word of a packed mixture that holds the number of lobes */

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

static void *gkdi_default_allocate(void *user, size_t size)
{
    (void)user;
    return GKD_MALLOC(size);
}

static void gkdi_default_release(void *user, void *pointer)
{
    (void)user;
    GKD_FREE(pointer);
}

/* count * size bytes, zeroed; NULL on failure or overflow. */
static void *gkdi_allocate(const gkd_desc *desc, uint64_t count, size_t size)
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

static void gkdi_release(const gkd_desc *desc, void *pointer)
{
    if (pointer)
        desc->release(desc->user, pointer);
}

static void gkdi_run(gkd_parallel_fn parallel, void *user, uint32_t count, uint32_t grain, gkd_range_fn fn,
                     void *context)
{
    if (parallel && count > grain)
        parallel(user, count, grain, fn, context);
    else if (count)
        fn(context, 0, count);
}

/* A non-zero training sample as mixtures learn from it: 32 bytes. */
typedef struct gkdi_item {
    float position[3];
    float direction[3]; /* unit, as seen from the position */
    float nearness;     /* 1 / distance to the next vertex */
    float weight;       /* radiance / pdf_mix, > 0, finite, <= 1e30 */
} gkdi_item;

/* ---- >>signature -------------------------------------------------------------------------------------------- */

/* What a cell or lookahead cell remembers of its samples, L = largest channel / pdf_mix [Zheng 2025, 4.1, 5.2], and its
   place in the lookahead tree. 96 bytes; all zero = no samples. Sums are f64: 1e12 samples keep nine digits, so the
   paper's halving every 8 million samples is not needed. Position moments are running means, over the last 2^24 (mean)
   and 2^20 (variance) non-zero samples or so: precise at any distance from the origin, and they cannot drift. */
typedef struct gkd_signature {
    double samples;      /* b0: all samples, zeros too */
    double sum;          /* b1: of L */
    double squares;      /* b2: of L^2 */
    double direction[3]; /* sum of L * direction */
    double mean[3];      /* position of non-zero samples */
    float variance[3];   /* of their position */
    float lit;           /* number of non-zero samples; stays at 2^24 */
    float split;         /* the lookahead tree's: position[axis] < split goes to child, others to child + 1 */
    uint16_t child;      /* 0 = none */
    uint8_t axis;
    uint8_t alike; /* not 0: surely like the cell, and so is all that was below: stays without children */
} gkd_signature;

/* Sum of L^2 direction direction^T of a cell: xx yy zz xy xz yz. How noise in the mean direction is spread (own). */
typedef struct gkdi_shape {
    double s[6];
} gkdi_shape;

#define GKDI_ALIKE_SIGMAS 2          /* 2.3 % of those just T or tau away count as alike at a look, until the next */
#define GKDI_LIT_MAX 16777216.0f     /* counting in f32 ends here */
#define GKDI_VARIANCE_WINDOW 1048576 /* 1 / it is well above the rounding of f32 */

/* x >= 0 as f32, at most 3e38. */
static float gkdi_float_of(double x) { return x < 3e38 ? (float)x : 3e38f; }
static float gkdi_lit_of(double x) { return x < (double)GKDI_LIT_MAX ? (float)x : GKDI_LIT_MAX; }

/* Sums of a batch, before they become part of signatures: of a lookahead cell and of the cells about it. */
typedef struct gkdi_sum {
    double samples, sum, squares, direction[3]; /* as in gkd_signature */
    double lit, away[3], square[3];             /* non-zero samples, their positions from a reference point */
} gkdi_sum;

#if GKDI_X86
/* gkdi_sum_items; lanes are sums, so that each is added up in the same order. */
GKDI_EXACT static void gkdi_sum_items_avx2(gkdi_sum *sum, gkdi_shape *shape, const double from[3],
                                           const gkdi_item *items, const uint32_t *list, uint32_t count)
{
    const __m256d pivot = _mm256_setr_pd(from[0], from[1], from[2], 0);
    __m256d away = _mm256_setzero_pd(), square = away, light = away, squares = away, products = away;
    double out[5][4];
    uint32_t i, k;
    for (i = 0; i < count; ++i) {
        const gkdi_item *p = &items[list[i]];
        __m256d x = _mm256_sub_pd(_mm256_cvtps_pd(_mm_loadu_ps(p->position)), pivot); /* the fourth is not used */
        __m256d v = _mm256_set1_pd((double)p->weight);
        away = _mm256_add_pd(away, x);
        square = _mm256_add_pd(square, _mm256_mul_pd(x, x));
        x = _mm256_cvtps_pd(_mm_blend_ps(_mm_loadu_ps(p->direction), _mm_set1_ps(1), 8));
        x = _mm256_mul_pd(x, v);
        light = _mm256_add_pd(light, x);
        squares = _mm256_add_pd(squares, _mm256_mul_pd(x, x));
        products = _mm256_add_pd(products, _mm256_mul_pd(x, _mm256_permute4x64_pd(x, 0xc9))); /* xy yz zx */
    }
    _mm256_storeu_pd(out[0], away);
    _mm256_storeu_pd(out[1], square);
    _mm256_storeu_pd(out[2], light);
    _mm256_storeu_pd(out[3], squares);
    _mm256_storeu_pd(out[4], products);
    sum->sum += out[2][3];
    sum->squares += out[3][3];
    for (k = 0; k < 3; ++k) {
        sum->away[k] += out[0][k];
        sum->square[k] += out[1][k];
        sum->direction[k] += out[2][k];
        shape->s[k] += out[3][k];
    }
    shape->s[3] += out[4][0];
    shape->s[4] += out[4][2];
    shape->s[5] += out[4][1];
}
#endif

/* Add the light of items[list[0 .. count - 1]], all of them non-zero. */
static void gkdi_sum_light(gkdi_sum *sum, gkdi_shape *shape, const gkdi_item *items, const uint32_t *list,
                           uint32_t count)
{
    double light[5] = {0, 0, 0, 0, 0}, s[6] = {0, 0, 0, 0, 0, 0};
    uint32_t i, k;
    for (i = 0; i < count; ++i) {
        const gkdi_item *p = &items[list[i]];
        double v = (double)p->weight, x = (double)p->direction[0] * v, y = (double)p->direction[1] * v;
        double z = (double)p->direction[2] * v;
        light[0] += v;
        light[1] += v * v;
        light[2] += x;
        light[3] += y;
        light[4] += z;
        s[0] += x * x;
        s[1] += y * y;
        s[2] += z * z;
        s[3] += x * y;
        s[4] += x * z;
        s[5] += y * z;
    }
    sum->sum += light[0];
    sum->squares += light[1];
    for (k = 0; k < 3; ++k)
        sum->direction[k] += light[2 + k];
    for (k = 0; k < 6; ++k)
        shape->s[k] += s[k];
}

/* Add their positions, as seen from a reference point. Loops of their own: sums stay in registers. */
static void gkdi_sum_places(gkdi_sum *sum, const double from[3], const gkdi_item *items, const uint32_t *list,
                            uint32_t count)
{
    double away[3] = {0, 0, 0}, square[3] = {0, 0, 0};
    uint32_t i, k;
    for (i = 0; i < count; ++i) {
        const float *p = items[list[i]].position;
        for (k = 0; k < 3; ++k) {
            double x = (double)p[k] - from[k];
            away[k] += x;
            square[k] += x * x;
        }
    }
    for (k = 0; k < 3; ++k) {
        sum->away[k] += away[k];
        sum->square[k] += square[k];
    }
}

/* Add items[list[0 .. count - 1]], all of them non-zero: their light, and their positions as seen from a reference
   point. */
static void gkdi_sum_items(uint32_t simd, gkdi_sum *sum, gkdi_shape *shape, const double from[3],
                           const gkdi_item *items, const uint32_t *list, uint32_t count)
{
    sum->samples += count;
    sum->lit += count;
#if GKDI_X86
    if (simd > GKD_SIMD_SCALAR) {
        gkdi_sum_items_avx2(sum, shape, from, items, list, count);
        return;
    }
#endif
    (void)simd;
    gkdi_sum_light(sum, shape, items, list, count);
    gkdi_sum_places(sum, from, items, list, count);
}

static void gkdi_sum_add(gkdi_sum *sum, const gkdi_sum *other)
{
    uint32_t k;
    sum->samples += other->samples;
    sum->sum += other->sum;
    sum->squares += other->squares;
    sum->lit += other->lit;
    for (k = 0; k < 3; ++k) {
        sum->direction[k] += other->direction[k];
        sum->away[k] += other->away[k];
        sum->square[k] += other->square[k];
    }
}

/* Make a batch part of a signature. Positions count as if they had come one by one, but for the window of their
   variance. */
static void gkdi_signature_add(gkd_signature *s, const gkdi_sum *b, const double from[3])
{
    double old = fmin((double)s->lit, GKDI_VARIANCE_WINDOW), m = b->lit, n = old + m;
    bool first = !(s->lit > 0);
    uint32_t k;
    s->samples += b->samples;
    s->sum += b->sum;
    s->squares += b->squares;
    for (k = 0; k < 3; ++k)
        s->direction[k] += b->direction[k];
    if (!(m > 0))
        return;
    s->lit = gkdi_lit_of((double)s->lit + m);
    for (k = 0; k < 3; ++k) {
        double mean = b->away[k] / m, spread = b->square[k] - b->away[k] * mean;
        double move = from[k] + mean - (first ? 0 : s->mean[k]);
        spread = (spread > 0 ? spread : 0) + (first ? 0 : old * ((double)s->variance[k] + move * move * m / n));
        s->mean[k] = first ? move : s->mean[k] + move * m / fmax((double)s->lit, m);
        s->variance[k] = gkdi_float_of(spread / n);
    }
}

/* Let what was seen so far count for `factor` of its samples [Zheng 2025, section 7.2]. All signatures that are
   compared with each other need the same factor. */
static void gkdi_signature_scale(gkd_signature *s, double factor)
{
    uint32_t k;
    s->samples *= factor;
    s->sum *= factor;
    s->squares *= factor;
    s->lit = (float)((double)s->lit * factor);
    for (k = 0; k < 3; ++k)
        s->direction[k] *= factor;
}

static void gkdi_shape_scale(gkdi_shape *s, double factor)
{
    uint32_t k;
    for (k = 0; k < 6; ++k)
        s->s[k] *= factor;
}

/* Mean position of the non-zero samples. */
static void gkdi_signature_mean(const gkd_signature *s, float mean[3])
{
    uint32_t k;
    for (k = 0; k < 3; ++k)
        mean[k] = (float)s->mean[k];
}

/* Smallest float not below x. */
static float gkdi_float_above(double x)
{
    float f = (float)x;
    return (double)f < x ? nextafterf(f, INFINITY) : f;
}

/* Where to cut: at the mean, across the axis of greatest variance [Ruppert 2020]. The mean is rounded up: then at least
   one sample lies on either side of it, also where floats are few (own). False: all positions are the same. */
static bool gkdi_signature_split_axis(const gkd_signature *s, uint32_t *axis, float *split)
{
    uint32_t k, best = 0;
    for (k = 1; k < 3; ++k)
        if (s->variance[k] > s->variance[best])
            best = k;
    *axis = best;
    *split = gkdi_float_above(s->mean[best]);
    return s->lit > 1 && s->variance[best] > 0;
}

/* Can these be sums of samples? For files. */
static bool gkdi_signature_valid(const gkd_signature *s)
{
    double n = s->samples, w = 0;
    uint32_t k;
    for (k = 0; k < 3; ++k) {
        w += s->direction[k] * s->direction[k];
        if (!(s->variance[k] >= 0 && s->variance[k] <= 3e38f && fabs(s->mean[k]) < 3e38))
            return false;
    }
    return n >= 0 && n < 1e300 && s->lit >= 0 && s->lit <= GKDI_LIT_MAX && (double)s->lit <= n * 1.001 &&
           fabsf(s->split) <= 3e38f && s->sum >= 0 && s->squares >= 0 && s->squares < 1e150 &&
           s->sum * s->sum <= n * s->squares * 1.00001 && w <= s->sum * s->sum * 1.00001 && s->axis < 3;
}

/* ---- >>quantile --------------------------------------------------------------------------------------------- */

/* x with P(standard normal > x) = alpha, alpha in (0, 0.5]. Newton on the logarithm of the tail: concave, so that from
   the second step on it comes from the right and never passes. Relative error below 1e-13 for alpha down to 1e-307. */
static double gkdi_normal_quantile(double alpha)
{
    const double root_half = 0.70710678118654752440, root_tau = 2.50662827463100050242;
    double x = sqrt(-2 * log(2 * alpha)), goal = log(alpha); /* the tail is below exp(-x^2 / 2) / 2 */
    int i;
    for (i = 0; i < 12; ++i) {
        double tail = 0.5 * erfc(x * root_half);
        double step = (log(tail) - goal) * tail * root_tau * exp(0.5 * x * x);
        x += step;
        if (fabs(step) < 1e-14 * x)
            break;
    }
    return x;
}

/* kappa coth(kappa) - 1, stable at 0. */
static double gkdi_coth_excess(double kappa)
{
    static const double series[6] = {1 / 3.0, -1 / 45.0, 2 / 945.0, -1 / 4725.0, 2 / 93555.0, -1382 / 638512875.0};
    double k2 = kappa * kappa, sum = 0;
    int i;
    if (kappa >= 0.25)
        return kappa / tanh(kappa) - 1;
    for (i = 5; i >= 0; --i) /* what is left out is below 1e-13 of the sum */
        sum = sum * k2 + series[i];
    return sum * k2;
}

/* kappa with kappa coth(kappa) = 1 + excess, excess = y - 1 >= 0 [Zheng 2025, eq. 4, brackets mended], then Newton
   steps (own): relative error below 1e-11 for any excess. */
static double gkdi_kappa_of(double excess)
{
    double e = excess, y = e + 1, kappa;
    int i;
    if (!(e > 0))
        return 0;
    if (e > 1e6) /* coth = 1 */
        return y;
    kappa = sqrt(e * (((y + 1.69934861) * y + 5.38753272) * y + 9.85021305) / ((y + 0.67453491) * y + 4.31180006));
    for (i = 0; i < 2; ++i) {
        double f = gkdi_coth_excess(kappa), s = sinh(kappa < 300 ? kappa : 300);
        /* d/dkappa = coth(kappa) - kappa / sinh(kappa)^2 */
        double slope = kappa < 0.01 ? kappa * (2 / 3.0) : (f + 1) / kappa - kappa / (s * s);
        kappa -= (f - e) / slope;
    }
    return kappa;
}

/* ---- >>table ------------------------------------------------------------------------------------------------ */

#define GKDI_TABLE 256

/* What the tests need, made once for a field. */
typedef struct gkdi_split_tests {
    double radiance_step;    /* T */
    double direction_step;   /* tau, radians */
    double radiance_sigmas;  /* Phi^-1(1 - alpha) */
    double min_samples;      /* of either side */
    double cos_step;         /* cos(tau) */
    double spread_max;       /* largest spread at which directions can differ significantly */
    bool reference;          /* the paper's formulas, word for word */
    float angle[GKDI_TABLE]; /* beta: least significant angle over the spread 1 / sqrt(kappa), from 0 to spread_max */
} gkdi_split_tests;

/* exp(-x) I0(x), x >= 0, relative error 2e-7 [Abramowitz and Stegun 1964, 9.8.1 and 9.8.2]. */
static double gkdi_bessel_scaled(double x)
{
    static const double near[7] = {1, 3.5156229, 3.0899424, 1.2067492, 0.2659732, 0.0360768, 0.0045813};
    static const double far[9] = {0.39894228,  0.01328592, 0.00225319,  -0.00157565, 0.00916281,
                                  -0.02057706, 0.02635537, -0.01647633, 0.00392377};
    double t = x / 3.75, sum = 0;
    int i;
    if (t < 1) {
        for (i = 6; i >= 0; --i)
            sum = sum * t * t + near[i];
        return sum * exp(-x);
    }
    for (i = 8; i >= 0; --i)
        sum = sum / t + far[i];
    return sum / sqrt(x);
}

/* log P(a < angle(v, m) < b), v von Mises-Fisher distributed about a direction at the angle `from` to m. Integrated
   over the azimuth around m it is a Bessel function, over the angle Gauss-Legendre: 6 panels of 8 points, over the part
   of [a, b] that matters. Up to 6e-7 relative. */
static double gkdi_band_log(double from, double a, double b, double kappa)
{
    static const double node[4] = {0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363};
    static const double weight[4] = {0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763};
    double reach = 9 / sqrt(kappa), peak = from < a ? a : from > b ? b : from, h, top, sum = 0;
    double sin_from = sin(from), away = fabs(peak - from) * sqrt(kappa);
    int p, i;
    if (away > 5)
        reach *= 5 / away; /* far out it falls like exp(-away * x) */
    a = a > peak - reach ? a : peak - reach;
    b = b < peak + reach ? b : peak + reach;
    h = (b - a) / 12;
    top = sin((peak - from) / 2);
    top = -2 * kappa * top * top;
    for (p = 0; p < 6; ++p)
        for (i = 0; i < 8; ++i) {
            double t = a + h * (2 * p + 1 + (i & 1 ? -node[i >> 1] : node[i >> 1])), u = sin((t - from) / 2);
            sum +=
                weight[i >> 1] * sin(t) * exp(-2 * kappa * u * u - top) * gkdi_bessel_scaled(kappa * sin(t) * sin_from);
        }
    return sum > 0 ? top + log(h * sum * kappa / -expm1(-2 * kappa)) : -1e4;
}

/* What is to be 0 at the least significant angle beta, falling in beta.
   Own: at the true angle tau, an estimate with this spread exceeds beta with probability alpha.
   Paper: if the true direction lies around the estimate with this spread, it is closer than tau with probability alpha.
   Both come to beta = tau + z / sqrt(kappa) for a small spread. For one that is not small against tau, the paper's beta
   shrinks, to 0 if alpha > (1 - cos tau) / 2: no circle of radius tau holds much of a wide distribution. Noise then
   splits cells. */
static double gkdi_table_error(const gkdi_split_tests *t, double beta, double spread, double goal)
{
    double kappa = 1 / (spread * spread);
    return (t->reference ? gkdi_band_log(beta, 0, t->direction_step, kappa)
                         : gkdi_band_log(t->direction_step, beta, 3.14159265358979324, kappa)) -
           goal;
}

/* beta between low and high for a spread: false position (Illinois). */
static double gkdi_table_solve(const gkdi_split_tests *t, double low, double high, double spread, double goal)
{
    double at_low = gkdi_table_error(t, low, spread, goal), at_high, x = low;
    int i, side = 0;
    if (at_low < 0) {
        high = low;
        low = 0;
        at_low = gkdi_table_error(t, low, spread, goal);
    }
    at_high = gkdi_table_error(t, high, spread, goal);
    if (at_high > 0) {
        low = high;
        at_low = at_high;
        high = 3.14159265358979324;
        at_high = gkdi_table_error(t, high, spread, goal);
    }
    if (at_low <= 0 || at_high >= 0)
        return at_low <= 0 ? low : high;
    for (i = 0; i < 60 && high - low > 1e-9; ++i) {
        double e;
        x = at_high < -1e3 ? 0.5 * (low + high) : (low * at_high - high * at_low) / (at_high - at_low);
        e = gkdi_table_error(t, x, spread, goal);
        if (fabs(e) < 1e-9)
            break;
        if (e > 0) {
            low = x;
            at_low = e;
            at_high *= side == 1 ? 0.5 : 1;
            side = 1;
        } else {
            high = x;
            at_high = e;
            at_low *= side == 2 ? 0.5 : 1;
            side = 2;
        }
    }
    return x;
}

/* The largest spread worth a table. Paper: where beta becomes pi, or else 0. Own: where beta has gone half way from tau
   to pi. */
static double gkdi_table_end(const gkdi_split_tests *t, double goal)
{
    const double pi = 3.14159265358979324;
    double low = 1e-5, high = t->reference ? 1e3 : 4, beta = 0.5 * (t->direction_step + pi);
    bool rises = true;
    int i;
    if (t->reference) {
        rises = log(0.5 * (1 - t->cos_step)) > goal;
        beta = rises ? pi : 0;
    }
    if ((gkdi_table_error(t, beta, high, goal) > 0) != rises)
        return high;
    for (i = 0; i < 40; ++i) {
        double middle = sqrt(low * high);
        if ((gkdi_table_error(t, beta, middle, goal) > 0) == rises)
            high = middle;
        else
            low = middle;
    }
    return low;
}

/* T, tau in radians in (0, pi), alpha of each test in (0, 0.5), samples that either side needs. */
static void gkdi_split_tests_init(gkdi_split_tests *t, double radiance_step, double direction_step,
                                  double radiance_alpha, double direction_alpha, double min_samples, bool reference)
{
    double goal = log(direction_alpha), sigmas = gkdi_normal_quantile(direction_alpha), step, beta;
    int i;
    memset(t, 0, sizeof *t);
    t->radiance_step = radiance_step;
    t->direction_step = direction_step;
    t->radiance_sigmas = gkdi_normal_quantile(radiance_alpha);
    t->min_samples = min_samples;
    t->cos_step = cos(direction_step);
    t->reference = reference;
    t->spread_max = gkdi_table_end(t, goal);
    step = t->spread_max / (GKDI_TABLE - 1);
    beta = direction_step;
    t->angle[0] = (float)beta;
    for (i = 1; i < GKDI_TABLE; ++i) {
        beta = gkdi_table_solve(t, beta, beta + (sigmas + 3) * step, step * i, goal);
        t->angle[i] = (float)beta;
    }
}

/* beta at a spread; above pi where nothing is significant. */
static double gkdi_least_angle(const gkdi_split_tests *t, double spread)
{
    double x = spread / t->spread_max * (GKDI_TABLE - 1), at;
    int i;
    if (!(x < GKDI_TABLE - 1))
        return 4;
    i = (int)x;
    at = x - i;
    return (double)t->angle[i] * (1 - at) + (double)t->angle[i + 1] * at;
}

/* ---- >>compare ---------------------------------------------------------------------------------------------- */

/* By how much a lookahead cell's mean radiance lies farther than T above (sign 1) or below (-1) the cell's, and the
   standard error of that [Zheng 2025, Appendix A], divided by N_g; "rest" is the cell without the lookahead cell.
   Own: 1. A score test. Both variances are at least what they are if all samples have the same relative variance and
   the lookahead cell's mean is (1 -+ T) times the cell's, the edge of the null hypothesis. A lookahead cell that rare
   bright samples have missed so far sees neither them nor the variance that they make; the cell does.
   2. N_l / N_g is random too: adds (1 -+ T)^2 f (1 - f) (difference of the two means)^2 / N_g. */
static double gkdi_radiance_excess(const gkdi_split_tests *t, const gkd_signature *g, const gkd_signature *l, int sign,
                                   double *error)
{
    double ng = g->samples, nl = l->samples, nr = ng - nl, f = nl / ng, bright = g->sum / ng;
    double r1 = g->sum > l->sum ? g->sum - l->sum : 0, r2 = g->squares > l->squares ? g->squares - l->squares : 0;
    double ml = l->sum / nl, mr = r1 / nr, vl = l->squares / nl - ml * ml, vr = r2 / nr - mr * mr, more = 0;
    double k = 1 + sign * t->radiance_step, cr = k * (1 - f), cl = 1 - k * f;
    vl = vl > 0 ? vl : 0;
    vr = vr > 0 ? vr : 0;
    *error = 0;
    if (k <= 0 || (sign > 0 && cl <= 0)) /* no cell can be so dark, no part so bright */
        return -1;
    if (!t->reference) {
        double null_l = k * bright, null_r = bright * cl / (1 - f), apart = null_l - null_r, pooled;
        pooled = f * vl / (null_l * null_l) + (1 - f) * vr / (null_r * null_r);
        vl = fmax(vl, pooled * null_l * null_l);
        vr = fmax(vr, pooled * null_r * null_r);
        more = k * k * f * (1 - f) * apart * apart / ng;
    }
    *error = sqrt(cr * cr * vr / nr + cl * cl * vl / nl + more);
    return sign * (ml - k * bright);
}

static bool gkdi_radiance_differs(const gkdi_split_tests *t, const gkd_signature *g, const gkd_signature *l)
{
    double below, above, low = gkdi_radiance_excess(t, g, l, -1, &below),
                         high = gkdi_radiance_excess(t, g, l, 1, &above);
    return (low > 0 && low > t->radiance_sigmas * below) || (high > 0 && high > t->radiance_sigmas * above);
}

static double gkdi_dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void gkdi_cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* 1 - |r|^2 of a mean vector r = w / sum. Directions are unit vectors in f32: below 1e-7 is rounding. */
static double gkdi_lack(double length, double sum)
{
    double lack = (sum - length) * (sum + length) / (sum * sum);
    return lack > 1e-7 ? lack : 1e-7;
}

/* Mean of (direction . axis)^2 weighted by L, across the mean direction, of a von Mises-Fisher distribution with sum
   w of L * direction: |r| / kappa, kappa = |r| (3 - |r|^2) / (1 - |r|^2) [Zheng 2025, 5.2]. */
static double gkdi_vmf_width(double length, double sum)
{
    double r = length < sum ? length / sum : 1;
    return gkdi_lack(length, sum) / (3 - r * r);
}

/* Mean of (q . direction)^2 weighted by L^2. */
static double gkdi_shape_moment(const gkdi_shape *shape, const double q[3])
{
    const double *s = shape->s;
    double m = q[0] * q[0] * s[0] + q[1] * q[1] * s[1] + q[2] * q[2] * s[2] +
               2 * (q[0] * q[1] * s[3] + q[0] * q[2] * s[4] + q[1] * q[2] * s[5]);
    return m / (s[0] + s[1] + s[2]);
}

/* A cell's mean direction, and the plane in which it is compared. */
typedef struct gkdi_plane {
    double normal[3], mean[3], tangent[3]; /* tangent = normal x mean */
    double length;                         /* of the cell's sum of L * direction */
} gkdi_plane;

/* Variance of q . w, w = a part's sum of L * direction, q in the plane; n, sum and squares are its b0, b1, b2 (own).
   It is the sum of L^2 (q . direction)^2. Of a lookahead cell only the sum of L^2 is known; the shape is taken from the
   cell, turned to the part's mean direction, and widened if the part is wider than the cell as to their means of L *
   direction. Relative noise is at least the whole cell's: as in gkdi_radiance_excess. */
static double gkdi_part_variance(const gkd_signature *g, const gkdi_shape *shape, const gkdi_plane *p, double n,
                                 double sum, double squares, const double w[3], const double q[3])
{
    double length = sqrt(gkdi_dot(w, w)), share = sum / g->sum, strength = share * share * g->samples / n * g->squares;
    double along = length > 0 ? gkdi_dot(q, w) / length : 0, across = 0, turned[3], wide, cell, moment;
    uint32_t k;
    strength = strength > squares ? strength : squares;
    if (length > 0) {
        double tangent[3];
        gkdi_cross(p->normal, w, tangent);
        across = gkdi_dot(q, tangent) / length;
    }
    wide = gkdi_vmf_width(length, sum);
    wide = wide * across * across + (1 - 2 * wide) * along * along;
    cell = gkdi_vmf_width(p->length, g->sum);
    cell = cell * across * across + (1 - 2 * cell) * along * along;
    for (k = 0; k < 3; ++k)
        turned[k] = across * p->tangent[k] + along * p->mean[k];
    moment = shape ? gkdi_shape_moment(shape, turned) : cell;
    if (wide > cell)
        moment = fmax(moment * wide / cell, moment + wide - cell);
    return strength * fmax(moment, 1e-7 * gkdi_dot(q, q));
}

/* 1 / kappa_l of the mean direction estimate [Zheng 2025, eq. 4 and before]; infinite without direction. */
static double gkdi_reference_variance(const gkd_signature *s)
{
    double length = sqrt(gkdi_dot(s->direction, s->direction)), r = length / s->sum, kappa;
    kappa = r * (3 - r * r) / gkdi_lack(length, s->sum);
    kappa = gkdi_kappa_of(s->sum * s->sum / s->squares * gkdi_coth_excess(kappa));
    return 1 / kappa;
}

/* Variance of the angle between the mean directions of a lookahead cell and the cell.
   Own: the lookahead cell's samples are the cell's too. With w_g = w_delta + w_l and in-plane tangents t_g, t_l of
   either mean, the angle changes by t_g . dw_delta / |w_g| + (t_g / |w_g| - t_l / |w_l|) . dw_l to first order, where
   dw are independent: that gives the spread. */
static double gkdi_direction_variance(const gkd_signature *g, const gkdi_shape *shape, const gkd_signature *l,
                                      double lg, double ll)
{
    gkdi_plane p;
    double tl[3], ql[3], qr[3], wr[3], sine, variance;
    uint32_t k;
    p.length = lg;
    for (k = 0; k < 3; ++k) {
        p.mean[k] = g->direction[k] / lg;
        ql[k] = l->direction[k] / ll;
        wr[k] = g->direction[k] - l->direction[k];
    }
    gkdi_cross(ql, p.mean, p.normal);
    sine = sqrt(gkdi_dot(p.normal, p.normal));
    if (!(sine > 1e-12)) { /* the same or opposite: any plane */
        double axis[3] = {0, 0, 0};
        axis[fabs(p.mean[0]) > 0.7] = 1;
        gkdi_cross(axis, p.mean, p.normal);
        sine = sqrt(gkdi_dot(p.normal, p.normal));
    }
    for (k = 0; k < 3; ++k)
        p.normal[k] /= sine;
    gkdi_cross(p.normal, p.mean, p.tangent);
    gkdi_cross(p.normal, ql, tl);
    for (k = 0; k < 3; ++k) {
        qr[k] = p.tangent[k] / lg;
        ql[k] = qr[k] - tl[k] / ll;
    }
    variance = gkdi_part_variance(g, shape, &p, l->samples, l->sum, l->squares, l->direction, ql);
    if (g->sum > l->sum)
        variance += gkdi_part_variance(g, shape, &p, g->samples - l->samples, g->sum - l->sum,
                                       g->squares > l->squares ? g->squares - l->squares : 0, wr, qr);
    return variance;
}

/* Does a lookahead cell's mean direction differ by more than tau from the cell's? [Zheng 2025, 5.3] */
static bool gkdi_direction_differs(const gkdi_split_tests *t, const gkd_signature *g, const gkdi_shape *shape,
                                   const gkd_signature *l)
{
    double lg = sqrt(gkdi_dot(g->direction, g->direction)), ll = sqrt(gkdi_dot(l->direction, l->direction)), cosine;
    if (!(lg > 0 && ll > 0))
        return false;
    cosine = gkdi_dot(g->direction, l->direction) / (lg * ll);
    if (t->reference)
        return cosine < cos(gkdi_least_angle(t, sqrt(gkdi_reference_variance(g) + gkdi_reference_variance(l))));
    return cosine < t->cos_step &&
           acos(cosine > -1 ? cosine : -1) > gkdi_least_angle(t, sqrt(gkdi_direction_variance(g, shape, l, lg, ll)));
}

/* Is a lookahead cell surely like the cell, less than T and tau away (own)? The null hypotheses are turned round: that
   it is T brighter, T darker, or tau away; each is rejected at GKDI_ALIKE_SIGMAS. A mean direction has two components:
   where the true angle is tau, its estimate is hardly ever tau less some standard errors of the component along. */
static bool gkdi_alike(const gkdi_split_tests *t, const gkd_signature *g, const gkdi_shape *shape,
                       const gkd_signature *l, bool radiance, bool direction)
{
    double rest = g->samples - l->samples, error, lg, ll, cosine;
    int sign;
    if (!(l->samples >= t->min_samples && rest >= t->min_samples && g->sum > 0 && l->sum > 0 && g->squares > 0 &&
          g->squares < 1e150))
        return false;
    for (sign = -1; sign <= 1 && radiance; sign += 2)
        if (!(gkdi_radiance_excess(t, g, l, sign, &error) < -GKDI_ALIKE_SIGMAS * error))
            return false;
    if (!direction)
        return true;
    lg = sqrt(gkdi_dot(g->direction, g->direction));
    ll = sqrt(gkdi_dot(l->direction, l->direction));
    if (!(lg > 0 && ll > 0))
        return false;
    cosine = gkdi_dot(g->direction, l->direction) / (lg * ll);
    if (shape && !(shape->s[0] + shape->s[1] + shape->s[2] > 0))
        shape = NULL;
    error = sqrt(gkdi_direction_variance(g, shape, l, lg, ll));
    return acos(cosine < 1 ? (cosine > -1 ? cosine : -1) : 1) + GKDI_ALIKE_SIGMAS * error < t->direction_step;
}

/* What distinguishes a lookahead cell from the cell, with confidence: 1 mean radiance, 2 mean direction; 0 nothing.
   shape: the cell's; NULL: von Mises-Fisher [Zheng 2025]. No test where either side is small: CLT. */
static int gkdi_compare(const gkdi_split_tests *t, const gkd_signature *cell, const gkdi_shape *shape,
                        const gkd_signature *look)
{
    double rest = cell->samples - look->samples;
    if (!(look->samples >= t->min_samples && rest >= (t->reference ? 1 : t->min_samples)))
        return 0;
    if (!(cell->sum > 0 && cell->squares > 0 && cell->squares < 1e150))
        return 0;
    if (shape && !(shape->s[0] + shape->s[1] + shape->s[2] > 0))
        shape = NULL;
    return (int)gkdi_radiance_differs(t, cell, look) | (int)gkdi_direction_differs(t, cell, shape, look) << 1;
}

/* ---- >>model ------------------------------------------------------------------------------------------------ */

#define GKDI_MAX_KAPPA 1e5
#define GKDI_STRETCH 1.5f /* most by which, in learning, another position changes the solid angle of what is seen */
#define GKDI_CHUNK 64     /* samples of an expectation step */
#define GKDI_SEEDS 64     /* candidates for first lobes */
#define GKDI_PAIR 0.05    /* squared distance of samples that may show the same light: 13 degrees */
#define GKDI_TOP 32       /* largest weights known singly */
#define GKDI_MIN_TEST 8   /* effective samples that a lobe needs to be split */
#define GKDI_TESTS 5      /* moments beyond those of a lobe */

enum { GKDI_BASE, GKDI_AVX2, GKDI_PLAIN }; /* plain: without vector types */

/* Sums of a mixture, in effective samples. Lobes are columns. */
typedef struct gkdi_sums {
    float soft[GKD_MAX_LOBES];    /* sum of v = weight * responsibility */
    float squares[GKD_MAX_LOBES]; /* sum of v^2; soft^2 / squares is the lobe's own number of samples, and fades */
    float x[GKD_MAX_LOBES], y[GKD_MAX_LOBES], z[GKD_MAX_LOBES]; /* sum of v * direction from the pivot */
    float nearness[GKD_MAX_LOBES];                              /* sum of v * nearness from the pivot */
} gkdi_sums;

typedef struct gkdi_model {
    float pivot[3];
    uint32_t count; /* lobes; 0 = nothing learned */
    float held;     /* effective samples in the sums; sum of soft */
    float level;    /* mean weight of the samples that they stand for */
    float samples;  /* whose number that is */
    uint32_t seen;  /* samples in all, whatever their weight, faded or not; saturates; a split halves it */
    gkdi_sums sums;
} gkdi_model;

/* Defaults are tuned on SF1, where all are flat around the chosen value, but for history, kappa_prior, merge and share:
   those come from renders. */
typedef struct gkdi_fit_options {
    uint32_t simd;         /* GKDI_BASE ...; the same bits from all */
    uint32_t most;         /* lobes of a mixture, 1 .. GKD_MAX_LOBES */
    uint32_t lobes;        /* first lobes at most */
    uint32_t seed_seen;    /* while a model has seen fewer samples, a batch may bring more first lobes */
    uint32_t first_passes; /* over a subset, for a new model */
    uint32_t passes;       /* over all samples; 1: no splits */
    uint32_t subset;       /* samples of first passes */
    float history;         /* of all samples seen so many count: those held before a batch fade to it */
    float weight_prior;    /* samples added to each lobe's weight */
    float kappa_prior;     /* samples added to each lobe's concentration, ... */
    float kappa_spread;    /* with that 1 - mean cosine: 0.03 for many samples, 0.1 for few */
    float broad_kappa;     /* lobe 0 stays at most so concentrated; 0: no such lobe */
    float broad_prior;     /* samples added to its weight */
    float broad_share;     /* and it weighs at least this */
    float split;           /* chi-square of a lobe's moments, times its weight, above which it is split, */
    float split_price;     /* raised by that over the samples of the batch */
    float split_lobe;      /* and least chi-square of the lobe alone, */
    float split_sigma;     /* with that many standard errors */
    float merge;           /* Pearson chi-square of two lobes against one, times their weight, below which they merge */
    float share;           /* a sample weighs at most share / sqrt(n) of its batch */
    float parallax;        /* nearness is at most this over the root mean square distance of samples to the pivot */
    bool jacobian;         /* solid angles change with the position, see gkdi_load */
    double *likelihood;    /* NULL, or `passes` values: mean log density before each pass (slow) */
} gkdi_fit_options;

static inline gkdi_fit_options gkdi_fit_defaults(void)
{
    gkdi_fit_options o;
    memset(&o, 0, sizeof o);
    o.most = GKD_MAX_LOBES;
    o.lobes = 12;
    o.seed_seen = 64;
    o.first_passes = 3;
    o.passes = 2;
    o.subset = 1024;
    o.history = 0.25f;
    o.weight_prior = 0.05f;
    o.kappa_prior = 0.1f;
    o.kappa_spread = 0.06f;
    o.broad_kappa = 1;
    o.broad_prior = 1;
    o.broad_share = 0.05f;
    o.split = 0.01f;
    o.split_lobe = 0.1f;
    o.split_sigma = 4;
    o.split_price = 4;
    o.merge = 0.002f;
    o.share = 20;
    o.parallax = 4;
    o.jacobian = true;
    return o;
}

/* What the expectation step reads: log2 of the density of lobe k at w is log[k] - sharp[k] |w - mean|^2. */
typedef struct gkdi_mixture {
    uint32_t count;
    float x[GKD_MAX_LOBES], y[GKD_MAX_LOBES], z[GKD_MAX_LOBES], kappa[GKD_MAX_LOBES];
    float sharp[GKD_MAX_LOBES], log[GKD_MAX_LOBES];
    float s[GKD_MAX_LOBES][3], t[GKD_MAX_LOBES][3]; /* tangents times sqrt(kappa), where there are tests */
    float weight[GKD_MAX_LOBES];
} gkdi_mixture;

/* Of one pass. */
typedef struct gkdi_batch {
    double soft[GKD_MAX_LOBES], squares[GKD_MAX_LOBES], x[GKD_MAX_LOBES], y[GKD_MAX_LOBES], z[GKD_MAX_LOBES],
        nearness[GKD_MAX_LOBES];
    double test[GKD_MAX_LOBES][GKDI_TESTS];
    double likelihood, weight;
} gkdi_batch;

/* ---- >>moments ---------------------------------------------------------------------------------------------- */

static inline double gkdi_min(double a, double b) { return a < b ? a : b; } /* fmin may be a call */
static inline double gkdi_max(double a, double b) { return a > b ? a : b; }

/* exp(-2 kappa), 0 where that is below a float's rounding. */
static inline double gkdi_decline(double kappa) { return kappa > 20 ? 0 : exp(-2 * kappa); }

/* coth(kappa) - 1 / kappa, the mean cosine. */
static inline double gkdi_mean_cosine(double kappa)
{
    if (kappa < 0.02)
        return kappa / 3;
    double e = gkdi_decline(kappa);
    return (1 + e) / (1 - e) - 1 / kappa;
}

/* Concentration whose mean cosine is 1 - spread: [Banerjee 2005] and a Newton step, relative error 3e-3. */
static inline double gkdi_kappa(double spread)
{
    double r = 1 - spread, k, e, c;
    if (!(r > 1e-6))
        return 0;
    if (spread <= 0.04) /* coth = 1 */
        return gkdi_min(1 / gkdi_max(spread, 1e-12), GKDI_MAX_KAPPA);
    k = r * (3 - r * r) / (1 - r * r);
    if (k < 0.05)
        return k;
    e = gkdi_decline(k);
    c = (1 + e) / (1 - e);
    return gkdi_max(k - (c - 1 / k - r) / (1 - c * c + 1 / (k * k)), 0);
}

/* kappa / (2 pi (1 - exp(-2 kappa))), the density at the mean. */
static inline double gkdi_peak(double kappa)
{
    return 0.15915494309189535 * (kappa < 1e-4 ? 0.5 * (1 + kappa) : kappa / (1 - gkdi_decline(kappa)));
}

static inline void gkdi_tangents(const float *m, float scale, float *s, float *t)
{
    /* [Duff 2017] */
    float sign = m[2] < 0 ? -1.0f : 1.0f, a = -1 / (sign + m[2]), b = m[0] * m[1] * a;
    s[0] = scale * (1 + sign * m[0] * m[0] * a);
    s[1] = scale * sign * b;
    s[2] = -scale * sign * m[0];
    t[0] = scale * b;
    t[1] = scale * (sign + m[1] * m[1] * a);
    t[2] = -scale * m[1];
}

/* ---- >>kernel ----------------------------------------------------------------------------------------------- */

/* Lanes are samples, always eight, whatever the width of the machine: so sums have one order and all levels give the
   same bits. There are two sources: with vector types (SSE2, AVX2 without fma, NEON), and plain C for other compilers,
   which is the reference of the tests. */
#if (defined(__GNUC__) || defined(__clang__)) && !defined(GKD_NO_SIMD)
#define GKDI_VECTORS 1
#else
#define GKDI_VECTORS 0
#endif

/* How items become weighted directions. */
typedef struct gkdi_view {
    float pivot[3];
    float nearest;             /* larger nearness is taken for this */
    float cap, inverse, scale; /* weight = min(weight, cap) * inverse * scale; inverse = 1 / cap */
    uint32_t stride;           /* every so many-th item */
    double sum;                /* of min(weight, cap) over the items */
    bool jacobian;
} gkdi_view;

#if GKDI_VECTORS
typedef float gkdi_v4 __attribute__((vector_size(16)));
typedef float gkdi_v8 __attribute__((vector_size(32)));
typedef int32_t gkdi_i8 __attribute__((vector_size(32)));
#define GKDI_INLINE static inline __attribute__((always_inline))
#define GKDI_SELECT(m, a, b) ((gkdi_v8)(((gkdi_i8)(a) & (m)) | ((gkdi_i8)(b) & ~(m))))

typedef struct gkdi_chunk {
    gkdi_v8 x[GKDI_CHUNK / 8], y[GKDI_CHUNK / 8], z[GKDI_CHUNK / 8], nearness[GKDI_CHUNK / 8], weight[GKDI_CHUNK / 8];
    uint32_t groups; /* of eight samples */
} gkdi_chunk;

GKDI_INLINE float gkdi_add_lanes(const gkdi_v8 *v)
{
    gkdi_v4 half[2];
    memcpy(half, v, sizeof half);
    half[0] += half[1];
    return (half[0][0] + half[0][2]) + (half[0][1] + half[0][3]);
}

/* 1 / sqrt(v) for v in [1e-4, 1e30]: the exponent halved, then three Newton steps (rounded alike everywhere, and
   compilers do not vectorise sqrtf as long as it sets errno). */
GKDI_INLINE void gkdi_inverse_sqrt(gkdi_v8 *v)
{
    gkdi_v8 half = 0.5f * *v, y = (gkdi_v8)(0x5f375a86 - ((gkdi_i8)*v >> 1));
    y = y * (1.5f - half * y * y);
    y = y * (1.5f - half * y * y);
    *v = y * (1.5f - half * y * y);
}

/* Items become columns, up to a multiple of eight; past the end: the last one with weight 0. */
GKDI_INLINE void gkdi_turn(const gkdi_item *items, uint32_t n, uint32_t stride, float (*column)[GKDI_CHUNK])
{
    uint32_t i = 0, k;
#if GKDI_X86
    for (; i + 4 <= n; i += 4)
        for (k = 0; k < 8; k += 4) {
            const float *p = (const float *)(const void *)(items + (size_t)i * stride) + k;
            size_t row = stride * (sizeof *items / sizeof *p);
            __m128 a = _mm_loadu_ps(p), b = _mm_loadu_ps(p + row);
            __m128 c = _mm_loadu_ps(p + 2 * row), d = _mm_loadu_ps(p + 3 * row);
            _MM_TRANSPOSE4_PS(a, b, c, d);
            _mm_storeu_ps(column[k] + i, a);
            _mm_storeu_ps(column[k + 1] + i, b);
            _mm_storeu_ps(column[k + 2] + i, c);
            _mm_storeu_ps(column[k + 3] + i, d);
        }
#endif
    for (; i < (n + 7) / 8 * 8; ++i) {
        const gkdi_item *p = items + (size_t)(i < n ? i : n - 1) * stride;
        for (k = 0; k < 3; ++k) {
            column[k][i] = p->position[k];
            column[3 + k][i] = p->direction[k];
        }
        column[6][i] = p->nearness;
        column[7][i] = i < n ? p->weight : 0;
    }
}

/* From the pivot the point x + w / nearness is in direction w + nearness (x - pivot); with len its length, nearness
   there is nearness / len and a patch's solid angle is 1 / len^2 as large (facing alike; own, [Ruppert 2020] keeps
   it). No division by nearness, so 0 needs no case. Where the point is at the pivot or numbers overflow the direction
   stays. */
GKDI_INLINE void gkdi_load(const gkdi_item *items, uint32_t n, const gkdi_view *view, gkdi_chunk *c)
{
    const gkdi_v8 zero = {0};
    float column[8][GKDI_CHUNK];
    c->groups = (n + 7) / 8;
    gkdi_turn(items, n, view->stride, column);
    for (uint32_t g = 0; g < c->groups; ++g) {
        gkdi_v8 v[8];
        for (uint32_t k = 0; k < 8; ++k)
            memcpy(&v[k], column[k] + 8 * g, sizeof v[k]);
        v[6] = GKDI_SELECT(v[6] < view->nearest, v[6], zero + view->nearest);
        gkdi_v8 x = v[3] + v[6] * (v[0] - view->pivot[0]), y = v[4] + v[6] * (v[1] - view->pivot[1]),
                z = v[5] + v[6] * (v[2] - view->pivot[2]), inverse = x * x + y * y + z * z, w;
        gkdi_i8 ok = (inverse > 1e-4f) & (inverse < 1e30f);
        inverse = GKDI_SELECT(ok, inverse, zero + 1.0f);
        gkdi_inverse_sqrt(&inverse);
        c->x[g] = GKDI_SELECT(ok, x * inverse, v[3]);
        c->y[g] = GKDI_SELECT(ok, y * inverse, v[4]);
        c->z[g] = GKDI_SELECT(ok, z * inverse, v[5]);
        c->nearness[g] = v[6] * inverse;
        w = GKDI_SELECT(v[7] < view->cap, v[7], zero + view->cap) * view->inverse * view->scale;
        if (view->jacobian) {
            gkdi_v8 f = inverse * inverse;
            f = GKDI_SELECT(f < GKDI_STRETCH, f, zero + GKDI_STRETCH);
            w *= GKDI_SELECT(f > 1 / GKDI_STRETCH, f, zero + 1 / GKDI_STRETCH);
        }
        c->weight[g] = w;
    }
}

/* density[k][.] of every lobe and their sum; 2^x by a polynomial of degree 4 on [0, 1), relative error 4e-6. */
GKDI_INLINE void gkdi_densities(const gkdi_mixture *q, const gkdi_chunk *c, gkdi_v8 (*density)[GKDI_CHUNK / 8],
                                gkdi_v8 *total)
{
    const gkdi_v8 zero = {0};
    for (uint32_t k = 0; k < q->count; ++k) {
        float mx = q->x[k], my = q->y[k], mz = q->z[k], h = q->sharp[k], l = q->log[k];
        for (uint32_t g = 0; g < c->groups; ++g) {
            gkdi_v8 x = c->x[g] - mx, y = c->y[g] - my, z = c->z[g] - mz, e = l - h * (x * x + y * y + z * z), f, v;
            e = GKDI_SELECT(e > -100.0f, e, zero - 100.0f); /* a sample that no lobe explains is shared by all */
            gkdi_i8 i = __builtin_convertvector(e + 128.0f, gkdi_i8) - 128;
            f = e - __builtin_convertvector(i, gkdi_v8);
            v = 1.0f + f * (0.693143747f + f * (0.240227f + f * (0.0555f + f * 0.0096f)));
            v = (gkdi_v8)((gkdi_i8)v + (i << 23));
            density[k][g] = v;
            total[g] += v;
        }
    }
}

/* Adds the chunk's responsibilities to the batch. */
GKDI_INLINE void gkdi_collect(const gkdi_mixture *q, const gkdi_chunk *c, gkdi_v8 (*density)[GKDI_CHUNK / 8],
                              const gkdi_v8 *share, gkdi_batch *out)
{
    for (uint32_t k = 0; k < q->count; ++k) {
        float mx = q->x[k], my = q->y[k], mz = q->z[k];
        gkdi_v8 a[6] = {{0}, {0}, {0}, {0}, {0}, {0}};
        for (uint32_t g = 0; g < c->groups; ++g) {
            gkdi_v8 r = density[k][g] * share[g];
            a[0] += r;
            a[1] += r * (c->x[g] - mx);
            a[2] += r * (c->y[g] - my);
            a[3] += r * (c->z[g] - mz);
            a[4] += r * c->nearness[g];
            a[5] += r * r;
        }
        double soft = (double)gkdi_add_lanes(&a[0]);
        out->soft[k] += soft;
        out->x[k] += (double)gkdi_add_lanes(&a[1]) + soft * (double)mx;
        out->y[k] += (double)gkdi_add_lanes(&a[2]) + soft * (double)my;
        out->z[k] += (double)gkdi_add_lanes(&a[3]) + soft * (double)mz;
        out->nearness[k] += (double)gkdi_add_lanes(&a[4]);
        out->squares[k] += (double)gkdi_add_lanes(&a[5]);
    }
}

/* Moments that tell whether a lobe fits; a, b: tangent coordinates times sqrt(kappa), u = kappa (1 - cosine). */
GKDI_INLINE void gkdi_collect_tests(const gkdi_mixture *q, const gkdi_chunk *c, gkdi_v8 (*density)[GKDI_CHUNK / 8],
                                    const gkdi_v8 *share, gkdi_batch *out)
{
    for (uint32_t k = 0; k < q->count; ++k) {
        float mx = q->x[k], my = q->y[k], mz = q->z[k], h = q->kappa[k] * 0.5f;
        const float *s = q->s[k], *t = q->t[k];
        gkdi_v8 sum[GKDI_TESTS] = {{0}, {0}, {0}, {0}, {0}};
        for (uint32_t g = 0; g < c->groups; ++g) {
            gkdi_v8 r = density[k][g] * share[g], x = c->x[g] - mx, y = c->y[g] - my, z = c->z[g] - mz;
            gkdi_v8 a = x * s[0] + y * s[1] + z * s[2], b = x * t[0] + y * t[1] + z * t[2];
            gkdi_v8 u = h * (x * x + y * y + z * z), ru = r * u;
            sum[0] += r * (a * a - b * b);
            sum[1] += r * (a * b);
            sum[2] += ru * u;
            sum[3] += ru * a;
            sum[4] += ru * b;
        }
        for (int j = 0; j < GKDI_TESTS; ++j)
            out->test[k][j] += (double)gkdi_add_lanes(&sum[j]);
    }
}

static inline void gkdi_add_likelihood(const gkdi_chunk *c, const gkdi_v8 *total, gkdi_batch *out)
{
    for (uint32_t g = 0; g < c->groups; ++g)
        for (int j = 0; j < 8; ++j) {
            out->likelihood += (double)c->weight[g][j] * log((double)total[g][j]);
            out->weight += (double)c->weight[g][j];
        }
}

GKDI_INLINE void gkdi_pass(const gkdi_mixture *q, const gkdi_item *items, uint32_t n, const gkdi_view *view, bool tests,
                           bool likelihood, gkdi_batch *out)
{
    gkdi_v8 density[GKD_MAX_LOBES][GKDI_CHUNK / 8], total[GKDI_CHUNK / 8];
    gkdi_chunk c;
    memset(out, 0, sizeof *out);
    for (uint32_t i = 0; i < n; i += GKDI_CHUNK) {
        gkdi_load(items + (size_t)i * view->stride, n - i < GKDI_CHUNK ? n - i : GKDI_CHUNK, view, &c);
        memset(total, 0, sizeof total);
        gkdi_densities(q, &c, density, total);
        if (likelihood)
            gkdi_add_likelihood(&c, total, out);
        for (uint32_t g = 0; g < c.groups; ++g)
            total[g] = c.weight[g] / total[g];
        gkdi_collect(q, &c, density, total, out);
        if (tests)
            gkdi_collect_tests(q, &c, density, total, out);
    }
}

static inline void gkdi_pass_base(const gkdi_mixture *q, const gkdi_item *items, uint32_t n, const gkdi_view *view,
                                  bool tests, bool likelihood, gkdi_batch *out)
{
    gkdi_pass(q, items, n, view, tests, likelihood, out);
}

#if defined(__x86_64__)
__attribute__((target("avx2"))) static inline void gkdi_pass_avx2(const gkdi_mixture *q, const gkdi_item *items,
                                                                  uint32_t n, const gkdi_view *view, bool tests,
                                                                  bool likelihood, gkdi_batch *out)
{
    gkdi_pass(q, items, n, view, tests, likelihood, out);
}
#endif
#endif /* GKDI_VECTORS */

/* The same in plain C: arrays of samples, sample i in lane i % 8. */
typedef struct gkdi_plain_chunk {
    float x[GKDI_CHUNK], y[GKDI_CHUNK], z[GKDI_CHUNK], nearness[GKDI_CHUNK], weight[GKDI_CHUNK];
    float total[GKDI_CHUNK], density[GKD_MAX_LOBES][GKDI_CHUNK];
    uint32_t count; /* a multiple of eight */
} gkdi_plain_chunk;

static inline void gkdi_plain_load(const gkdi_item *p, const gkdi_view *view, bool real, gkdi_plain_chunk *c,
                                   uint32_t i)
{
    float d = p->nearness < view->nearest ? p->nearness : view->nearest, inverse, half, w;
    float x = p->direction[0] + d * (p->position[0] - view->pivot[0]),
          y = p->direction[1] + d * (p->position[1] - view->pivot[1]),
          z = p->direction[2] + d * (p->position[2] - view->pivot[2]), l2 = x * x + y * y + z * z;
    bool ok = l2 > 1e-4f && l2 < 1e30f;
    int32_t bits;
    l2 = ok ? l2 : 1;
    half = 0.5f * l2;
    memcpy(&bits, &l2, 4);
    bits = 0x5f375a86 - (bits >> 1);
    memcpy(&inverse, &bits, 4);
    for (int k = 0; k < 3; ++k)
        inverse = inverse * (1.5f - half * inverse * inverse);
    c->x[i] = ok ? x * inverse : p->direction[0];
    c->y[i] = ok ? y * inverse : p->direction[1];
    c->z[i] = ok ? z * inverse : p->direction[2];
    c->nearness[i] = d * inverse;
    w = real ? p->weight : 0;
    w = (w < view->cap ? w : view->cap) * view->inverse * view->scale;
    if (view->jacobian) {
        float f = inverse * inverse;
        f = f < GKDI_STRETCH ? f : GKDI_STRETCH;
        w *= f > 1 / GKDI_STRETCH ? f : 1 / GKDI_STRETCH;
    }
    c->weight[i] = w;
}

static inline float gkdi_plain_density(const gkdi_mixture *q, uint32_t k, const gkdi_plain_chunk *c, uint32_t i)
{
    float x = c->x[i] - q->x[k], y = c->y[i] - q->y[k], z = c->z[i] - q->z[k], f, v;
    float e = q->log[k] - q->sharp[k] * (x * x + y * y + z * z);
    int32_t whole, bits;
    e = e > -100.0f ? e : -100.0f;
    whole = (int32_t)(e + 128.0f) - 128;
    f = e - (float)whole;
    v = 1.0f + f * (0.693143747f + f * (0.240227f + f * (0.0555f + f * 0.0096f)));
    memcpy(&bits, &v, 4);
    bits += whole * (1 << 23);
    memcpy(&v, &bits, 4);
    return v;
}

static inline void gkdi_plain_collect(const gkdi_mixture *q, uint32_t k, const gkdi_plain_chunk *c, bool tests,
                                      gkdi_batch *out)
{
    float a[6 + GKDI_TESTS][8], mx = q->x[k], my = q->y[k], mz = q->z[k], h = q->kappa[k] * 0.5f;
    const float *s = q->s[k], *t = q->t[k];
    double sum[6 + GKDI_TESTS];
    memset(a, 0, sizeof a);
    for (uint32_t i = 0; i < c->count; ++i) {
        uint32_t j = i & 7;
        float r = c->density[k][i] * c->total[i], x = c->x[i] - mx, y = c->y[i] - my, z = c->z[i] - mz;
        a[0][j] += r;
        a[1][j] += r * x;
        a[2][j] += r * y;
        a[3][j] += r * z;
        a[4][j] += r * c->nearness[i];
        a[5][j] += r * r;
        if (!tests)
            continue;
        float ta = x * s[0] + y * s[1] + z * s[2], tb = x * t[0] + y * t[1] + z * t[2];
        float u = h * (x * x + y * y + z * z), ru = r * u;
        a[6][j] += r * (ta * ta - tb * tb);
        a[7][j] += r * (ta * tb);
        a[8][j] += ru * u;
        a[9][j] += ru * ta;
        a[10][j] += ru * tb;
    }
    for (int i = 0; i < 6 + GKDI_TESTS; ++i)
        sum[i] = (double)(((a[i][0] + a[i][4]) + (a[i][2] + a[i][6])) + ((a[i][1] + a[i][5]) + (a[i][3] + a[i][7])));
    out->soft[k] += sum[0];
    out->x[k] += sum[1] + sum[0] * (double)mx;
    out->y[k] += sum[2] + sum[0] * (double)my;
    out->z[k] += sum[3] + sum[0] * (double)mz;
    out->nearness[k] += sum[4];
    out->squares[k] += sum[5];
    for (int i = 0; tests && i < GKDI_TESTS; ++i)
        out->test[k][i] += sum[6 + i];
}

static inline void gkdi_pass_plain(const gkdi_mixture *q, const gkdi_item *items, uint32_t n, const gkdi_view *view,
                                   bool tests, bool likelihood, gkdi_batch *out)
{
    gkdi_plain_chunk c;
    memset(out, 0, sizeof *out);
    for (uint32_t first = 0; first < n; first += GKDI_CHUNK) {
        uint32_t count = n - first < GKDI_CHUNK ? n - first : GKDI_CHUNK;
        c.count = (count + 7) / 8 * 8;
        for (uint32_t i = 0; i < c.count; ++i) {
            size_t at = first + (i < count ? i : count - 1);
            gkdi_plain_load(items + at * view->stride, view, i < count, &c, i);
            c.total[i] = 0;
            for (uint32_t k = 0; k < q->count; ++k)
                c.total[i] += c.density[k][i] = gkdi_plain_density(q, k, &c, i);
            if (likelihood) {
                out->likelihood += (double)c.weight[i] * log((double)c.total[i]);
                out->weight += (double)c.weight[i];
            }
            c.total[i] = c.weight[i] / c.total[i];
        }
        for (uint32_t k = 0; k < q->count; ++k)
            gkdi_plain_collect(q, k, &c, tests, out);
    }
}

static inline void gkdi_run_pass(uint32_t simd, const gkdi_mixture *q, const gkdi_item *items, uint32_t n,
                                 const gkdi_view *view, bool tests, bool likelihood, gkdi_batch *out)
{
#if GKDI_VECTORS && defined(__x86_64__)
    if (simd == GKDI_AVX2) {
        gkdi_pass_avx2(q, items, n, view, tests, likelihood, out);
        return;
    }
#endif
#if GKDI_VECTORS
    if (simd != GKDI_PLAIN) {
        gkdi_pass_base(q, items, n, view, tests, likelihood, out);
        return;
    }
#endif
    (void)simd;
    gkdi_pass_plain(q, items, n, view, tests, likelihood, out);
}

/* ---- >>mstep ------------------------------------------------------------------------------------------------ */

static inline void gkdi_mixture_set(gkdi_mixture *q, uint32_t k, const float *mean, double kappa, double weight)
{
    q->x[k] = mean[0];
    q->y[k] = mean[1];
    q->z[k] = mean[2];
    q->kappa[k] = (float)kappa;
    q->weight[k] = (float)weight;
    q->sharp[k] = (float)(0.5 * kappa * 1.4426950408889634);
    q->log[k] = (float)log2(gkdi_max(weight, 1e-20) * gkdi_peak(kappa));
}

/* MAP: weights (soft + a) / (sum + a count); 1 - mean cosine = (soft - |direction sum| + own spread) / (soft + own):
   b of the lobe's own samples, own = b squares / soft, with the spread of a broad lobe are added, so that few samples
   that are bright do not count for many (own; [Ruppert 2020] adds a mean cosine of 0, which keeps lobes of fewer than
   kappa samples from becoming sharp). Lobe 0 stays broad and keeps a share: it answers for what no other
   lobe explains (own). */
static inline void gkdi_maximise(const gkdi_sums *s, uint32_t count, const gkdi_fit_options *o, gkdi_mixture *q)
{
    double sum = 0, a = (double)o->weight_prior, b = (double)o->kappa_prior, first, factor = 1;
    bool has_broad = o->broad_kappa > 0;
    q->count = count;
    for (uint32_t k = 0; k < count; ++k)
        sum += (double)s->soft[k] + (k || !has_broad ? a : (double)o->broad_prior);
    if (has_broad && count > 1) {
        first = (double)s->soft[0] + (double)o->broad_prior;
        if (first < sum * (double)o->broad_share)
            factor = (1 - (double)o->broad_share) * sum / (sum - first);
    }
    for (uint32_t k = 0; k < count; ++k) {
        bool broad = !k && has_broad;
        double w = (double)s->soft[k], x = (double)s->x[k], y = (double)s->y[k], z = (double)s->z[k];
        double r = sqrt(x * x + y * y + z * z), spread, kappa, weight;
        float mean[3] = {0, 0, 1};
        if (r > 1e-30) {
            mean[0] = (float)(x / r);
            mean[1] = (float)(y / r);
            mean[2] = (float)(z / r);
        }
        double own = w > 0 && s->squares[k] > 0 ? b * (double)s->squares[k] / w : b; /* squares may have underflowed */
        spread = (gkdi_max(w - r, 0) + own * (double)o->kappa_spread) / (w + own);
        kappa = gkdi_kappa(spread);
        weight = broad ? (w + (double)o->broad_prior) / sum : (w + a) / sum * factor;
        if (broad) {
            kappa = gkdi_min(kappa, (double)o->broad_kappa);
            weight = gkdi_max(weight, count > 1 ? (double)o->broad_share : 1);
        }
        gkdi_mixture_set(q, k, mean, kappa, weight);
    }
}

/* Of an orthonormal basis of functions on a lobe: coefficients of (radiance / mixture) - 1, and the error of their
   squares' sum. By Bessel's inequality the sum is at most the chi-square divergence in that lobe, and unlike the
   estimate of [Ruppert 2020] it needs no pdf of the samples (own). */
typedef struct gkdi_misfit {
    double c[5]; /* (a^2 - b^2), a b, u^2, u a, u b, made orthogonal */
    double chi2, samples;
} gkdi_misfit;

static inline gkdi_misfit gkdi_test(const gkdi_mixture *q, const gkdi_batch *b, uint32_t k)
{
    gkdi_misfit m;
    memset(&m, 0, sizeof m);
    double w = b->soft[k], kappa = (double)q->kappa[k], end = 2 * kappa, e = gkdi_decline(kappa), tail, p = 1;
    double u[5] = {1, 0, 0, 0, 0};
    if (!(w > 1e-12) || !(b->squares[k] > 0) || q->kappa[k] < 0.25f)
        return m;
    m.samples = w * w / b->squares[k];
    if (m.samples < GKDI_MIN_TEST)
        return m;
    tail = e / (1 - e);
    for (int j = 1; j < 5; ++j) {
        p *= end;
        u[j] = j * u[j - 1] - p * tail;
    }
    /* a^2 has the mean v = u - u^2 / (2 kappa) around the axis */
    double g = 1 / (2 * kappa), v1 = u[1] - g * u[2], v2 = u[2] - 2 * g * u[3] + g * g * u[4], vu = u[2] - g * u[3],
           vuu = u[3] - g * u[4], c = vu / v1;
    double mean_u, mean_a, mean_b, var = u[2] - u[1] * u[1], slope = (u[3] - u[2] * u[1]) / var, flat;
    double dx = b->x[k] / w - (double)q->x[k], dy = b->y[k] / w - (double)q->y[k], dz = b->z[k] / w - (double)q->z[k];
    mean_a = dx * (double)q->s[k][0] + dy * (double)q->s[k][1] + dz * (double)q->s[k][2];
    mean_b = dx * (double)q->t[k][0] + dy * (double)q->t[k][1] + dz * (double)q->t[k][2];
    mean_u = -(double)q->kappa[k] * (dx * (double)q->x[k] + dy * (double)q->y[k] + dz * (double)q->z[k]);
    flat = u[4] - u[2] * u[2] - slope * slope * var;
    m.c[0] = b->test[k][0] / w / sqrt(2 * v2);
    m.c[1] = b->test[k][1] / w / sqrt(v2 / 2);
    m.c[2] = (b->test[k][2] / w - u[2] - slope * (mean_u - u[1])) / sqrt(gkdi_max(flat, 1e-12));
    m.c[3] = (b->test[k][3] / w - c * mean_a) / sqrt(gkdi_max(vuu - c * vu, 1e-12));
    m.c[4] = (b->test[k][4] / w - c * mean_b) / sqrt(gkdi_max(vuu - c * vu, 1e-12));
    for (int j = 0; j < 5; ++j)
        m.chi2 += m.c[j] * m.c[j];
    return m;
}

static inline void gkdi_unit(float *v)
{
    double x = (double)v[0], y = (double)v[1], z = (double)v[2], l = sqrt(x * x + y * y + z * z);
    if (!(l > 1e-30)) {
        v[0] = v[1] = 0;
        v[2] = 1;
        return;
    }
    v[0] = (float)(x / l);
    v[1] = (float)(y / l);
    v[2] = (float)(z / l);
}

/* Sets lobe k's sums to what `soft` samples of such a lobe would give. */
static inline void gkdi_sums_set(gkdi_sums *s, uint32_t k, const float *mean, double kappa, float soft, float squares,
                                 float nearness)
{
    float r = (float)gkdi_mean_cosine(kappa) * soft;
    s->soft[k] = soft;
    s->squares[k] = squares;
    s->x[k] = r * mean[0];
    s->y[k] = r * mean[1];
    s->z[k] = r * mean[2];
    s->nearness[k] = nearness;
}

/* Two lobes for lobe k: where its samples are longer along one axis, left and right of the middle with the shorter
   axis' spread, so that all second moments stay; else one sharper, one broader at the same place, so that the mean of
   u and u^2 stay. */
static inline void gkdi_split(const gkdi_mixture *q, const gkdi_misfit *m, uint32_t k, uint32_t other, gkdi_sums *a,
                              gkdi_sums *b)
{
    double kappa = gkdi_max((double)q->kappa[k], 0.25), stretch = sqrt(m->c[0] * m->c[0] + m->c[1] * m->c[1]);
    double skew = sqrt(m->c[3] * m->c[3] + m->c[4] * m->c[4]);
    double angle = stretch > skew ? 0.5 * atan2(m->c[1], m->c[0]) : atan2(m->c[4], m->c[3]);
    double offset, first, second;
    float one[3], two[3];
    if (gkdi_max(stretch, skew) >= fabs(m->c[2])) {
        /* var(a) - var(b) = 2 stretch / kappa, half the difference of eigenvalues: 1 + stretch, 1 - stretch */
        double d = gkdi_min(gkdi_max(stretch, 0.25 * skew), 0.8);
        offset = sqrt(2 * d / kappa);
        first = second = kappa / gkdi_max(1 - d, 0.2);
    } else {
        /* spreads 1 + s and 1 - s times the old: mean of u^2 is 2 (1 + s^2) */
        double s = gkdi_min(sqrt(gkdi_max(m->c[2], 0.1)), 0.8);
        offset = 0.1 / sqrt(kappa);
        first = kappa / (1 - s);
        second = kappa / (1 + s);
    }
    offset = gkdi_min(offset, 1);
    double ca = offset * cos(angle) / sqrt(kappa), sa = offset * sin(angle) / sqrt(kappa);
    const float mean[3] = {q->x[k], q->y[k], q->z[k]};
    for (int i = 0; i < 3; ++i) {
        float step = (float)(ca * (double)q->s[k][i] + sa * (double)q->t[k][i]);
        one[i] = mean[i] + step;
        two[i] = mean[i] - step;
    }
    gkdi_unit(one);
    gkdi_unit(two);
    gkdi_sums *both[2] = {a, b};
    for (int i = 0; i < 2; ++i) {
        float soft = 0.5f * both[i]->soft[k], squares = 0.5f * both[i]->squares[k],
              nearness = 0.5f * both[i]->nearness[k];
        gkdi_sums_set(both[i], k, one, first, soft, squares, nearness);
        gkdi_sums_set(both[i], other, two, second, soft, squares, nearness);
    }
}

/* Splits lobes that do not fit, the most harmful first. Returns the new count. */
static inline uint32_t gkdi_split_all(const gkdi_mixture *q, const gkdi_batch *b, const gkdi_fit_options *o,
                                      gkdi_sums *history, gkdi_sums *sums)
{
    gkdi_misfit misfit[GKD_MAX_LOBES];
    double harm[GKD_MAX_LOBES];
    uint32_t count = q->count;
    double held = 0, limit;
    for (uint32_t k = 0; k < count; ++k)
        held += b->soft[k];
    limit = (double)o->split + (double)o->split_price / gkdi_max(held, 1);
    for (uint32_t k = 0; k < q->count; ++k) {
        misfit[k] = gkdi_test(q, b, k);
        double n = misfit[k].samples, excess = misfit[k].chi2 - 5 / gkdi_max(n, 1e-9);
        harm[k] = 0;
        if (n >= GKDI_MIN_TEST && excess > (double)o->split_lobe && excess > (double)o->split_sigma * sqrt(10.0) / n)
            harm[k] = excess * (double)q->weight[k];
        if (!k && o->broad_kappa > 0 && !(q->kappa[k] > 0.9f * o->broad_kappa))
            harm[k] = 0;
    }
    while (count < o->most) {
        uint32_t worst = 0;
        for (uint32_t k = 1; k < q->count; ++k)
            if (harm[k] > harm[worst])
                worst = k;
        if (!(harm[worst] > limit))
            break;
        gkdi_split(q, &misfit[worst], worst, count++, history, sums);
        harm[worst] = 0;
    }
    return count;
}

/* Integral of vMF(a) vMF(b) / vMF(m) = peak(a) peak(b) / (peak(m) peak(k)) exp(k - ka - kb + km), k the length of
   ka a + kb b - km m. */
static inline double gkdi_overlap(double (*v)[3], const double *kappa, const double *peak, int a, int b)
{
    double l = 0, k;
    for (int i = 0; i < 3; ++i) {
        double d = v[a][i] * kappa[a] + v[b][i] * kappa[b] - v[2][i] * kappa[2];
        l += d * d;
    }
    k = sqrt(l);
    return peak[a] * peak[b] / (peak[2] * gkdi_peak(k)) * exp(gkdi_min(k - kappa[a] - kappa[b] + kappa[2], 50));
}

/* Pearson chi-square of two lobes, weights summing to 1, against the one with their moments, integral((pa va + pb
   vb)^2 / vm) - 1 [Ruppert 2020]; stops with a lower bound where that is above `limit`: like gkdi_test's first
   coefficient, pa pb d^2 km / 2. */
static inline double gkdi_merge_cost(const gkdi_mixture *q, uint32_t a, uint32_t b, double limit)
{
    double wa = (double)q->weight[a], wb = (double)q->weight[b], pa = wa / (wa + wb), pb = 1 - pa, l = 0, d2 = 0, r;
    double kappa[3] = {(double)q->kappa[a], (double)q->kappa[b], 0}, ra = gkdi_mean_cosine(kappa[0]) * pa,
           rb = gkdi_mean_cosine(kappa[1]) * pb, peak[3];
    double v[3][3] = {{(double)q->x[a], (double)q->y[a], (double)q->z[a]},
                      {(double)q->x[b], (double)q->y[b], (double)q->z[b]},
                      {0, 0, 0}};
    for (int i = 0; i < 3; ++i) {
        v[2][i] = ra * v[0][i] + rb * v[1][i];
        l += v[2][i] * v[2][i];
        d2 += (v[0][i] - v[1][i]) * (v[0][i] - v[1][i]);
    }
    r = sqrt(l);
    kappa[2] = gkdi_kappa(1 - r);
    double bound = 0.25 * pa * pb * d2 * kappa[2]; /* half, to be on the safe side for broad lobes */
    if (bound * bound > limit)
        return bound * bound;
    for (int i = 0; i < 3; ++i) {
        v[2][i] /= gkdi_max(r, 1e-30);
        peak[i] = gkdi_peak(kappa[i]);
    }
    return pa * pa * gkdi_overlap(v, kappa, peak, 0, 0) + 2 * pa * pb * gkdi_overlap(v, kappa, peak, 0, 1) +
           pb * pb * gkdi_overlap(v, kappa, peak, 1, 1) - 1;
}

/* Column `to` becomes, or with `add` grows by, another's column. */
static inline void gkdi_sums_add(gkdi_sums *s, uint32_t to, const gkdi_sums *b, uint32_t from, bool add)
{
    s->soft[to] = b->soft[from] + (add ? s->soft[to] : 0);
    s->squares[to] = b->squares[from] + (add ? s->squares[to] : 0);
    s->x[to] = b->x[from] + (add ? s->x[to] : 0);
    s->y[to] = b->y[from] + (add ? s->y[to] : 0);
    s->z[to] = b->z[from] + (add ? s->z[to] : 0);
    s->nearness[to] = b->nearness[from] + (add ? s->nearness[to] : 0);
}

static inline uint32_t gkdi_remove(gkdi_sums *s, gkdi_mixture *q, uint32_t k, uint32_t count)
{
    --count;
    if (k != count) {
        const float mean[3] = {q->x[count], q->y[count], q->z[count]};
        gkdi_sums_add(s, k, s, count, false);
        gkdi_mixture_set(q, k, mean, (double)q->kappa[count], (double)q->weight[count]);
    }
    return count;
}

/* Merges pairs that one lobe replaces well: chi-square times weight is what the mixture's own chi-square rises by. Lobe
   0 stays apart if it is the broad one. */
static inline uint32_t gkdi_merge_all(const gkdi_fit_options *o, gkdi_mixture *q, gkdi_sums *s, uint32_t count)
{
    uint32_t first = o->broad_kappa > 0 ? 1 : 0;
    double limit = (double)o->merge;
    for (uint32_t a = first; a < count; ++a)
        for (uint32_t b = a + 1; b < count; ++b) {
            double x = (double)q->x[a] - (double)q->x[b], y = (double)q->y[a] - (double)q->y[b],
                   z = (double)q->z[a] - (double)q->z[b], d2 = x * x + y * y + z * z;
            double w = (double)q->weight[a] + (double)q->weight[b];
            double ka = (double)q->kappa[a], kb = (double)q->kappa[b], least = gkdi_min(ka, kb),
                   most = gkdi_max(ka, kb);
            bool tiny = gkdi_min((double)q->weight[a], (double)q->weight[b]) * 1000 < w;
            if (!tiny && (d2 * least > 4 || most > 8 * least + 8))
                continue;
            if (!(gkdi_merge_cost(q, a, b, limit / w) * w < limit))
                continue;
            gkdi_sums_add(s, a, s, b, true);
            count = gkdi_remove(s, q, b, count);
            x = (double)s->x[a];
            y = (double)s->y[a];
            z = (double)s->z[a];
            double r = gkdi_max(sqrt(x * x + y * y + z * z), 1e-30), soft = gkdi_max((double)s->soft[a], 1e-30);
            const float mean[3] = {(float)(x / r), (float)(y / r), (float)(z / r)};
            gkdi_mixture_set(q, a, mean, gkdi_kappa(gkdi_max(1 - r / soft, 0)), w);
            b = a; /* look at all partners again */
        }
    return count;
}

/* ---- >>fit -------------------------------------------------------------------------------------------------- */

/* Weights of a batch. cap: no sample weighs more than `share` of all (own): then cap = share (rest + j cap), rest = sum
   of all but the j largest, so cap = share rest / (1 - j share) for the first j whose next weight is below it. At most
   GKDI_TOP are capped: where more are alike, none of them rules. Squares of f32 fit f64. */
typedef struct gkdi_weights {
    double cap, sum;  /* sum of min(w, cap) */
    double effective; /* samples: (sum w)^2 / sum w^2 */
} gkdi_weights;

static inline gkdi_weights gkdi_weigh(const gkdi_item *items, uint32_t n, double share)
{
    gkdi_weights out = {0, 0, 0};
    float top[GKDI_TOP + 1]; /* descending, and one place to drop out of */
    uint32_t held = 0, j;
    double squares = 0, rest[GKDI_TOP + 1];
    for (uint32_t i = 0; i < n; ++i) {
        float w = items[i].weight;
        if (held < GKDI_TOP || w > top[GKDI_TOP - 1]) {
            for (j = held; j > 0 && top[j - 1] < w; --j)
                top[j] = top[j - 1];
            top[j] = w;
            if (held < GKDI_TOP) {
                ++held;
                continue;
            }
            w = top[GKDI_TOP];
        }
        out.sum += (double)w;
        squares += (double)w * (double)w;
    }
    rest[held] = out.sum;
    for (j = held; j-- > 0;)
        rest[j] = rest[j + 1] + (double)top[j];
    out.cap = (double)top[0];
    for (j = 0; j < held && share * j < 1 && rest[j] > 0; ++j) {
        out.cap = gkdi_min(out.cap, share * rest[j] / (1 - j * share));
        if ((double)top[j] <= out.cap)
            break;
    }
    out.cap = gkdi_max(gkdi_max(out.cap, held == GKDI_TOP ? (double)top[GKDI_TOP - 1] : 0), 1e-36);
    for (j = 0; j < held; ++j) {
        double w = gkdi_min((double)top[j], out.cap);
        out.sum += w;
        squares += w * w;
    }
    out.effective = squares > 0 ? out.sum * out.sum / squares : 0;
    return out;
}

static inline void gkdi_model_init(gkdi_model *m, const float pivot[3])
{
    memset(m, 0, sizeof *m);
    memcpy(m->pivot, pivot, sizeof m->pivot);
}

/* Directions of items drawn in proportion to their capped weights, systematically, hence repeatably. */
typedef struct gkdi_candidates {
    float dir[GKDI_SEEDS][3];
    uint32_t item[GKDI_SEEDS], count;
    double apart[GKDI_SEEDS]; /* squared distance to the nearest lobe; 0 where lobes explain it */
} gkdi_candidates;

static inline void gkdi_draw(const gkdi_item *items, uint32_t n, const gkdi_view *view, uint32_t most,
                             gkdi_candidates *c)
{
    double run = 0, sum = view->sum;
    c->count = 0;
    for (uint32_t i = 0; i < n && c->count < most; ++i) {
        const gkdi_item *p = items + (size_t)i * view->stride;
        float *d = c->dir[c->count];
        float nearness = p->nearness < view->nearest ? p->nearness : view->nearest;
        double l = 0;
        run += (double)(p->weight < view->cap ? p->weight : view->cap);
        if (run * most < (c->count + 0.5) * sum)
            continue;
        for (int a = 0; a < 3; ++a) {
            d[a] = p->direction[a] + nearness * (p->position[a] - view->pivot[a]);
            l += (double)d[a] * (double)d[a];
        }
        if (l > 1e-4 && l < 1e30)
            gkdi_unit(d);
        else
            memcpy(d, p->direction, sizeof p->direction);
        c->apart[c->count] = 8;
        c->item[c->count++] = i;
        for (; c->count < most && run * most >= (c->count + 0.5) * sum; ++c->count) { /* the same one again */
            memcpy(c->dir[c->count], d, sizeof c->dir[0]);
            c->item[c->count] = i;
            c->apart[c->count] = 8;
        }
    }
}

static inline double gkdi_distance2(const float *a, const float *b)
{
    double x = (double)a[0] - (double)b[0], y = (double)a[1] - (double)b[1], z = (double)a[2] - (double)b[2];
    return x * x + y * y + z * z;
}

/* The candidate farthest from lobes first .. count - 1 and those of earlier calls; within e^-4 of a lobe's peak counts
   as at it. c->count where all are. */
static inline uint32_t gkdi_farthest(gkdi_candidates *c, const gkdi_mixture *q, uint32_t first)
{
    uint32_t best = 0;
    for (uint32_t i = 0; i < c->count; ++i) {
        for (uint32_t k = first; k < q->count; ++k) {
            const float v[3] = {q->x[k], q->y[k], q->z[k]};
            double d2 = gkdi_distance2(c->dir[i], v);
            c->apart[i] = gkdi_min(c->apart[i], d2 * (double)q->kappa[k] < 8 ? 0 : d2);
        }
        best = c->apart[i] > c->apart[best] ? i : best;
    }
    return c->count && c->apart[best] > 1e-6 ? best : c->count;
}

/* First lobes, and where little is held more of them: those candidates that are farthest from each other (own), as
   sharp as the gaps between them tell. Lobe 0 is broad. */
static inline void gkdi_seed(const gkdi_item *items, uint32_t n, const gkdi_view *view, const gkdi_fit_options *o,
                             gkdi_mixture *q)
{
    gkdi_candidates c;
    uint32_t first = o->broad_kappa > 0, most = o->lobes + first < o->most ? o->lobes : o->most - first, old;
    float mean[3] = {0, 0, 0};
    gkdi_draw(items, n, view, GKDI_SEEDS, &c);
    if (!q->count && first) {
        for (uint32_t i = 0; i < c.count; ++i)
            for (int a = 0; a < 3; ++a)
                mean[a] += c.dir[i][a];
        gkdi_unit(mean);
        gkdi_mixture_set(q, q->count++, mean, gkdi_min(1, (double)o->broad_kappa), 0.2);
    }
    old = q->count;
    for (uint32_t best = gkdi_farthest(&c, q, first); q->count < most + first && best < c.count;) {
        gkdi_mixture_set(q, q->count++, c.dir[best], GKDI_MAX_KAPPA, 0.8 / most);
        best = gkdi_farthest(&c, q, q->count - 1);
    }
    for (uint32_t k = old; k < q->count; ++k) {
        const float v[3] = {q->x[k], q->y[k], q->z[k]};
        double d2 = 8;
        for (uint32_t i = old; i < q->count; ++i) {
            const float b[3] = {q->x[i], q->y[i], q->z[i]};
            d2 = i == k ? d2 : gkdi_min(d2, gkdi_distance2(v, b));
        }
        gkdi_mixture_set(q, k, v, gkdi_min(gkdi_max(4 / d2, 1), 1000), (double)q->weight[k]);
    }
}

/* Lobes for light that is new: where many more candidates lie together than the mixture expects there. [Ruppert 2020]
   has splits alone, but those need what is new to stand out of what a lobe holds, and expectation maximisation takes
   many passes to move a lobe (own). */
static inline void gkdi_seed_new(const gkdi_item *items, uint32_t n, const gkdi_view *view, const gkdi_fit_options *o,
                                 gkdi_mixture *q)
{
    gkdi_candidates c;
    gkdi_plain_chunk at;
    gkdi_mixture blurred;
    double expected[GKDI_SEEDS];
    if (n < 16 * 16)
        return;
    gkdi_draw(items, n, view, n / 16 < GKDI_SEEDS ? n / 16 : GKDI_SEEDS, &c);
    blurred.count = q->count;
    for (uint32_t k = 0; k < q->count; ++k) { /* the mean over a cap of squared radius GKDI_PAIR, roughly */
        const float v[3] = {q->x[k], q->y[k], q->z[k]};
        double kappa = (double)q->kappa[k];
        gkdi_mixture_set(&blurred, k, v, kappa / (1 + kappa * GKDI_PAIR / 4), (double)q->weight[k]);
    }
    for (uint32_t i = 0; i < c.count; ++i) {
        expected[i] = 0;
        at.x[i] = c.dir[i][0];
        at.y[i] = c.dir[i][1];
        at.z[i] = c.dir[i][2];
        for (uint32_t k = 0; k < blurred.count; ++k)
            expected[i] += (double)gkdi_plain_density(&blurred, k, &at, i);
        expected[i] *= 3.14159265358979 * GKDI_PAIR * c.count;
    }
    for (uint32_t i = 0; i < c.count && q->count < o->most; ++i) {
        uint32_t close = 0;
        double spread = 0, d2;
        for (uint32_t j = 0; j < c.count && 10 * expected[i] < c.count; ++j)
            if (c.item[j] != c.item[i] && (d2 = gkdi_distance2(c.dir[i], c.dir[j])) < GKDI_PAIR) {
                ++close;
                spread += d2;
            }
        if (close <= 10 * expected[i])
            continue;
        for (uint32_t j = 0; j < c.count; ++j)
            if (gkdi_distance2(c.dir[i], c.dir[j]) < GKDI_PAIR)
                expected[j] = c.count;
        gkdi_mixture_set(q, q->count++, c.dir[i], gkdi_min(4 * close / gkdi_max(spread, 1e-2), 1000),
                         (close + 1.0) / c.count);
    }
}

static inline void gkdi_add(const gkdi_sums *history, const gkdi_batch *b, uint32_t count, gkdi_sums *out)
{
    for (uint32_t k = 0; k < count; ++k) {
        out->soft[k] = (float)((double)history->soft[k] + b->soft[k]);
        out->squares[k] = (float)((double)history->squares[k] + b->squares[k]);
        out->x[k] = (float)((double)history->x[k] + b->x[k]);
        out->y[k] = (float)((double)history->y[k] + b->y[k]);
        out->z[k] = (float)((double)history->z[k] + b->z[k]);
        out->nearness[k] = (float)((double)history->nearness[k] + b->nearness[k]);
    }
}

/* Every sample counts f times what it did, which leaves a lobe's own number of samples; of those only `keep` count. */
static inline void gkdi_scale(gkdi_sums *s, uint32_t count, double f, double keep)
{
    for (uint32_t k = 0; k < count; ++k) {
        s->soft[k] = (float)((double)s->soft[k] * f);
        s->squares[k] = (float)((double)s->squares[k] * f * f / keep);
        s->x[k] = (float)((double)s->x[k] * f);
        s->y[k] = (float)((double)s->y[k] * f);
        s->z[k] = (float)((double)s->z[k] * f);
        s->nearness[k] = (float)((double)s->nearness[k] * f);
    }
}

/* Passes over the items with the history added each time; tests and splits in all but the last. */
static inline void gkdi_iterate(gkdi_model *m, gkdi_mixture *q, gkdi_sums *history, const gkdi_item *items, uint32_t n,
                                const gkdi_view *view, uint32_t passes, const gkdi_fit_options *o, double *likelihood)
{
    gkdi_batch batch;
    for (uint32_t i = 0; i < passes; ++i) {
        bool tests = i + 1 < passes;
        for (uint32_t k = 0; tests && k < q->count; ++k) {
            const float mean[3] = {q->x[k], q->y[k], q->z[k]};
            gkdi_tangents(mean, sqrtf(q->kappa[k]), q->s[k], q->t[k]);
        }
        gkdi_run_pass(o->simd, q, items, n, view, tests, likelihood != NULL, &batch);
        if (likelihood)
            likelihood[i] = batch.likelihood / batch.weight;
        gkdi_add(history, &batch, q->count, &m->sums);
        m->count = q->count;
        if (tests)
            m->count = gkdi_split_all(q, &batch, o, history, &m->sums);
        gkdi_maximise(&m->sums, m->count, o, q);
    }
}

/* Mean square distance to the pivot, of 256 items. */
static inline double gkdi_radius2(const gkdi_item *items, uint32_t n, const float *pivot)
{
    double sum = 0;
    uint32_t stride = n > 256 ? n / 256 : 1, count = 0;
    for (uint32_t i = 0; i < n; i += stride, ++count)
        for (int a = 0; a < 3; ++a) {
            double d = (double)items[i].position[a] - (double)pivot[a];
            sum += d * d;
        }
    return sum / count;
}

/* Of two mean weights neither may outweigh the other by more than chance explains: the one known from fewer samples
   moves (own). Else one bad sample rules for good. */
static inline void gkdi_level(double n_a, double *a, double n_b, double *b)
{
    double ratio = 2 + 16 / sqrt(gkdi_max(gkdi_min(n_a, n_b), 1e-3));
    if (n_a > n_b)
        *b = gkdi_min(gkdi_max(*b, *a / ratio), *a * ratio);
    else
        *a = gkdi_min(gkdi_max(*a, *b / ratio), *b * ratio);
}

/* A new model's first passes, over a subset of the items. */
static inline void gkdi_fit_first(gkdi_model *m, const gkdi_item *items, uint32_t n, const gkdi_view *view,
                                  const gkdi_fit_options *o, gkdi_mixture *q)
{
    gkdi_sums nothing;
    gkdi_view part = *view;
    part.stride = n > o->subset ? n / o->subset : 1;
    part.scale *= (float)part.stride;
    part.sum /= part.stride;
    memset(&nothing, 0, sizeof nothing);
    q->count = 0;
    gkdi_seed(items, n / part.stride, &part, o, q);
    gkdi_iterate(m, q, &nothing, items, n / part.stride, &part, o->first_passes, o, NULL);
}

static inline void gkdi_total(gkdi_model *m, double level)
{
    double sum = 0;
    for (uint32_t k = 0; k < m->count; ++k)
        sum += (double)m->sums.soft[k];
    m->held = (float)sum;
    m->level = (float)level;
}

/* Learns from items: all of the batch in one call. The model's pivot must be set. History and batch count as much as
   the light that they have seen, and the sums are scaled to the effective number of both together (own): a batch of
   few effective samples is one that has found light that is rare and bright, and must not count for less. */
static inline void gkdi_model_fit(gkdi_model *m, const gkdi_item *items, uint32_t n, const gkdi_fit_options *o)
{
    gkdi_mixture q;
    gkdi_sums history;
    gkdi_view view;
    if (!n)
        return;
    gkdi_weights w = gkdi_weigh(items, n, gkdi_min((double)o->share / sqrt((double)n), 1));
    if (!(w.sum > 0))
        return;
    double keep = gkdi_min((double)o->history * (double)m->seen / gkdi_max((double)m->samples, 1e-30), 1);
    double held = m->count ? (double)m->held * keep : 0, old = (double)m->level, level;
    double samples = m->count ? (double)m->samples * keep : 0, total, mass;
    double now = gkdi_max(w.sum / n, 1e-37);
    if (held > 0)
        gkdi_level(held, &old, w.effective, &now);
    samples = held > 0 ? samples : 0;
    m->count = held > 0 ? m->count : 0;
    level = (samples * old + n * now) / (samples + n);
    mass = n * now / (samples * old + n * now);
    total = held > 0 ? 1 / ((1 - mass) * (1 - mass) / held + mass * mass / w.effective) : w.effective;
    memcpy(view.pivot, m->pivot, sizeof view.pivot);
    view.jacobian = o->jacobian;
    view.nearest = (float)gkdi_min((double)o->parallax / gkdi_max(sqrt(gkdi_radius2(items, n, m->pivot)), 1e-18), 1e18);
    view.cap = (float)w.cap;
    view.inverse = 1 / view.cap;
    view.scale = (float)(mass * total / (w.sum / w.cap));
    view.sum = w.sum;
    view.stride = 1;
    memset(&history, 0, sizeof history);
    if (m->count) {
        for (uint32_t k = 0; k < m->count; ++k) /* lobes to come have none */
            gkdi_sums_add(&history, k, &m->sums, k, false);
        gkdi_scale(&history, m->count, (1 - mass) * total / (double)m->held, keep);
        gkdi_maximise(&history, m->count, o, &q);
        if (m->seen < o->seed_seen)
            gkdi_seed(items, n, &view, o, &q);
        else
            gkdi_seed_new(items, n, &view, o, &q);
    } else
        gkdi_fit_first(m, items, n, &view, o, &q);
    gkdi_iterate(m, &q, &history, items, n, &view, o->passes, o, o->likelihood);
    m->count = gkdi_merge_all(o, &q, &m->sums, m->count);
    m->seen = m->seen > UINT32_MAX - n ? UINT32_MAX : m->seen + n;
    m->samples = (float)(samples + n);
    gkdi_total(m, level);
}

/* ---- >>change ----------------------------------------------------------------------------------------------- */

static inline uint32_t gkdi_model_lobes(const gkdi_model *m, const gkdi_fit_options *o, gkd_lobe *out)
{
    gkdi_mixture q;
    gkdi_maximise(&m->sums, m->count, o, &q);
    for (uint32_t k = 0; k < m->count; ++k) {
        out[k].mean[0] = q.x[k];
        out[k].mean[1] = q.y[k];
        out[k].mean[2] = q.z[k];
        out[k].kappa = q.kappa[k];
        out[k].weight = q.weight[k];
        out[k].nearness = m->sums.soft[k] > 1e-20f ? m->sums.nearness[k] / m->sums.soft[k] : 0;
    }
    return m->count;
}

/* History counts `factor` times as much from now on. */
static inline void gkdi_model_decay(gkdi_model *m, float factor)
{
    gkdi_scale(&m->sums, m->count, (double)factor, (double)factor);
    m->held *= factor;
    m->samples *= factor;
    m->seen = (uint32_t)ceil((double)m->seen * (double)factor);
}

/* The same light seen from another pivot: means turn, and a lobe at finite distance becomes sharper and weaker with
   the square of its distance, as gkdi_load does for samples. */
static inline void gkdi_model_move(gkdi_model *m, const float pivot[3], const gkdi_fit_options *o)
{
    double sum = 0;
    gkdi_sums *s = &m->sums;
    for (uint32_t k = 0; k < m->count; ++k) {
        double w = (double)s->soft[k], v[3] = {(double)s->x[k], (double)s->y[k], (double)s->z[k]}, l2 = 0, len, f;
        double r = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), nearness = w > 0 ? (double)s->nearness[k] / w : 0;
        if (!(r > 1e-30) || !(nearness > 0)) {
            sum += w;
            continue;
        }
        for (int i = 0; i < 3; ++i) {
            v[i] = v[i] / r + nearness * ((double)m->pivot[i] - (double)pivot[i]);
            l2 += v[i] * v[i];
        }
        len = sqrt(l2);
        f = o->jacobian ? gkdi_min(gkdi_max(l2, 1 / (double)GKDI_STRETCH), (double)GKDI_STRETCH) : 1;
        if (!(len > 1e-2 && len < 1e15)) {
            sum += w;
            continue;
        }
        const float mean[3] = {(float)(v[0] / len), (float)(v[1] / len), (float)(v[2] / len)};
        double kappa = gkdi_min(gkdi_kappa(gkdi_max(w - r, 0) / w) * f, GKDI_MAX_KAPPA);
        gkdi_sums_set(s, k, mean, kappa, (float)(w / f), (float)((double)s->squares[k] / (f * f)),
                      (float)(w / f * nearness / len));
        sum += w / f;
    }
    if (sum > 0)
        gkdi_scale(s, m->count, (double)m->held / sum, 1);
    memcpy(m->pivot, pivot, sizeof m->pivot);
}

/* Packed form: 8 + 6 * count words of 32 bits. Returns the words written. */
static inline uint32_t gkdi_model_words(uint32_t count) { return 8 + 6 * count; }
static inline uint32_t gkdi_model_pack(const gkdi_model *m, void *out)
{
    unsigned char *p = (unsigned char *)out;
    const float *from[6] = {m->sums.soft, m->sums.squares, m->sums.x, m->sums.y, m->sums.z, m->sums.nearness};
    memcpy(p, m, 32);
    for (int i = 0; i < 6; ++i)
        memcpy(p + 32 + 4 * (size_t)i * m->count, from[i], 4 * (size_t)m->count);
    return gkdi_model_words(m->count);
}
static inline uint32_t gkdi_model_unpack(gkdi_model *m, const void *in)
{
    const unsigned char *p = (const unsigned char *)in;
    memcpy(m, p, 32);
    float *to[6] = {m->sums.soft, m->sums.squares, m->sums.x, m->sums.y, m->sums.z, m->sums.nearness};
    if (m->count > GKD_MAX_LOBES) /* only from a damaged file */
        m->count = 0;
    for (int i = 0; i < 6; ++i)
        memcpy(to[i], p + 32 + 4 * (size_t)i * m->count, 4 * (size_t)m->count);
    return gkdi_model_words(m->count);
}

/* ---- >>gate ------------------------------------------------------------------------------------------------- */

static const double gkdi_gate_alpha[GKDI_GATE_LOW + 1] = {0.1, 0.3, 0.5, 0.75, 1.0};

/* What a cell knows of whether guiding pays there. Saved as it is, so no padding. Sums are f64. */
typedef struct gkdi_gate {
    double fresh;                 /* samples of this pass */
    double flow;                  /* sum of contribution / p of this pass */
    double count;                 /* samples that the sums below have seen */
    double v[GKDI_GATE_LOW + 1];  /* sum of x_a = contribution^2 / (p p_a); the last is a = 1 */
    double vv[GKDI_GATE_LOW + 1]; /* sum of x_a^2 */
    double cross[GKDI_GATE_LOW];  /* sum of x_a x_1 */
    double weight;                /* sum of contribution / p */
    double pixel, pixel_v;        /* sum of x_1 (pixel contribution / contribution)^2, and of x_1 beside it */
    float alpha;                  /* learned; what queries see is in gkd_cell */
    float reflected;              /* flow / fresh of the last pass that had enough samples, 0 = none had */
    uint32_t verdict;             /* GKD_GATE_... */
    uint32_t probe;               /* closed: passes until the next try; 0 = trying */
    uint32_t rebuilds;            /* times its mixture was published; 0 = queries see none */
    uint32_t hits;                /* non-zero samples taken in this pass */
} gkdi_gate;

/* Sums of x_a = g^2 / (p p_a) for each a. pb is floored, for a direction that was drawn by the guide but that the BSDF
   practically never draws. */
static void gkdi_gate_add(gkdi_gate *s, double g, double pixel, double p, double pb, double pg)
{
    double w = pixel / g, q, x[GKDI_GATE_LOW + 1];
    int k;
    g = g < GKDI_MAX_ROOT ? g : GKDI_MAX_ROOT;
    q = g * (g / p);
    s->weight += g / p;
    pb = pb > 1e-4 * p ? pb : 1e-4 * p;
    for (k = 0; k <= GKDI_GATE_LOW; ++k) {
        double a = gkdi_gate_alpha[k];
        x[k] = q / (a * pb + (1 - a) * pg);
        x[k] = x[k] < 1e60 ? x[k] : 1e60;
        s->v[k] += x[k];
        s->vv[k] += x[k] * x[k];
    }
    for (k = 0; k < GKDI_GATE_LOW; ++k)
        s->cross[k] += x[k] * x[GKDI_GATE_LOW];
    w = w < 1e15 ? w : 1e15;
    s->pixel += w * w * x[GKDI_GATE_LOW];
    s->pixel_v += x[GKDI_GATE_LOW];
}

/* Mean and standard error of y = f1 x_1 - fa x_a, from the sums. */
static void gkdi_gate_difference(const gkdi_gate *s, double f1, int a, double fa, double *mean, double *error)
{
    double n = s->count, square;
    *mean = (f1 * s->v[GKDI_GATE_LOW] - fa * s->v[a]) / n;
    square = (f1 * f1 * s->vv[GKDI_GATE_LOW] - 2 * f1 * fa * s->cross[a] + fa * fa * s->vv[a]) / n - *mean * *mean;
    *error = GKDI_CONFIDENCE * sqrt((square > 0 ? square : 0) / n);
}

/* Scale all sums of the gate. */
static void gkdi_gate_scale(gkdi_gate *s, double f)
{
    int k;
    for (k = 0; k <= GKDI_GATE_LOW; ++k) {
        s->v[k] *= f;
        s->vv[k] *= f;
    }
    for (k = 0; k < GKDI_GATE_LOW; ++k)
        s->cross[k] *= f;
    s->weight *= f;
    s->pixel *= f;
    s->pixel_v *= f;
    s->count *= f;
}

/* Kish's effective number of samples behind V(1). */
static double gkdi_gate_effective(const gkdi_gate *s)
{
    double v = s->v[GKDI_GATE_LOW], vv = s->vv[GKDI_GATE_LOW];
    return vv > 0 ? fmin(v * v / vv, 1e18) : 0; /* sums of a loaded field may be anything */
}

/* alpha from the five V(a), a convex function of a: the minimum of the parabola through the lowest point and its
   neighbours, pulled towards the present value by 32 effective samples. */
static float gkdi_grid_alpha(const gkdi_gate *s)
{
    const double *x = gkdi_gate_alpha, *v = s->v;
    double best, n = gkdi_gate_effective(s), d0, d1, bend;
    int k, low = 0;
    for (k = 1; k <= GKDI_GATE_LOW; ++k)
        low = v[k] < v[low] ? k : low;
    if (!(v[0] > v[low] || v[GKDI_GATE_LOW] > v[low])) /* nothing known: no light, or no mixture yet */
        return s->alpha;
    k = low < 1 ? 1 : low > GKDI_GATE_LOW - 1 ? GKDI_GATE_LOW - 1 : low;
    d0 = (v[k] - v[k - 1]) / (x[k] - x[k - 1]);
    d1 = (v[k + 1] - v[k]) / (x[k + 1] - x[k]);
    bend = (d1 - d0) / (x[k + 1] - x[k - 1]);
    best = bend > 0 ? 0.5 * (x[k - 1] + x[k]) - 0.5 * d0 / bend : x[low];
    best = best < 0.05 ? 0.05 : best > 0.95 ? 0.95 : best;
    best = (n * best + 32 * (double)s->alpha) / (n + 32);
    return (float)best;
}

/* Open, close or leave a cell; see "Gate" in the opening comment. */
static void gkdi_verdict(const gkd_desc *desc, bool pixels, gkdi_gate *s, gkd_stats *stats)
{
    bool closed = s->verdict == GKD_GATE_CLOSED;
    double n = gkdi_gate_effective(s), m = s->weight / s->count, mean, error, even, even_error;
    double margin = (double)desc->gate_margin * (closed ? 2 : 1),
           need = (double)desc->gate_gain * (pixels && s->pixel > 0 ? s->pixel_v / s->pixel : 16 * m * m);
    double limit = m * m + need;
    int k, best = 0;
    stats->probed += closed;
    for (k = 1; k < GKDI_GATE_LOW; ++k)
        best = s->v[k] < s->v[best] ? k : best;
    gkdi_gate_difference(s, 1, best, 1 + margin, &mean, &error);
    gkdi_gate_difference(s, 1, 0, 0, &even, &even_error);
    mean -= closed ? 1.5 * need : need;
    if (mean - error > 0 && n >= GKDI_MIN_OPEN) {
        stats->opened += s->verdict != GKD_GATE_OPEN;
        s->verdict = GKD_GATE_OPEN;
    } else if (closed) { /* not as even as it seemed */
        s->verdict = mean > 0 && even - even_error > 1.5 * limit ? GKD_GATE_UNJUDGED : GKD_GATE_CLOSED;
    } else if ((even + even_error < limit && n >= GKDI_MIN_EVEN && s->rebuilds >= GKDI_MIN_EVEN_REBUILDS) ||
               (mean + error < 0 && n >= GKDI_MIN_EFFECTIVE && s->rebuilds >= GKDI_MIN_REBUILDS)) {
        stats->closed++;
        s->verdict = GKD_GATE_CLOSED;
    }
}

/* Verdict on a cell after a pass. changed: pixels are true now and were not before, or the reverse. */
static void gkdi_judge(const gkd_desc *desc, bool pixels, bool changed, double fade, gkdi_gate *s, gkd_stats *stats)
{
    if (s->fresh >= GKDI_REFLECTED_SAMPLES)
        s->reflected = (float)fmin(s->flow / s->fresh, 1e30); /* a loaded sum may be larger */
    if (changed)
        s->pixel = s->pixel_v = 0;
    if (s->verdict == GKD_GATE_CLOSED && s->probe > 0) {
        s->probe--;
        return;
    }
    if (desc->alpha_mode == GKD_ALPHA_GRID)
        s->alpha = gkdi_grid_alpha(s);
    if (!desc->no_gate && s->count > 0 && gkdi_gate_effective(s) > 0)
        gkdi_verdict(desc, pixels, s, stats);
    if (s->verdict == GKD_GATE_CLOSED)
        s->probe = desc->gate_probe - 1;
    gkdi_gate_scale(s, fade);
}

/* ---- >>update ----------------------------------------------------------------------------------------------- */

/* A cell as building knows it. */
typedef struct gkdi_cell {
    gkdi_gate gate;
    gkd_signature *look; /* [look_count]: 0 is the cell itself, then its lookahead cells, children in pairs */
    uint32_t *model;     /* packed, see gkdi_model_pack; NULL = untrained */
    gkdi_shape shape;    /* of the cell's own signature */
    double lit;          /* non-zero samples since the cell exists, and half of its parent's */
    double wakes;        /* the mixture rests until lit is this; 0 = it does not */
    uint32_t look_count, look_capacity;
    uint32_t level;
    uint32_t model_capacity; /* words */
    uint32_t calm;           /* fits in a row after which the mixture could rest */
    uint32_t reserved;
} gkdi_cell;

typedef struct gkdi_split_event {
    uint32_t parent, child;
} gkdi_split_event;

/* Start of a sampling part; offsets in bytes from here. */
typedef struct gkdi_block {
    uint64_t size, nodes_at, cells_at, lobes_at;
    uint32_t nodes, cells, lobes; /* counts */
    float uniform;
    float bounds_min[3], bounds_max[3];
} gkdi_block;

struct gkd_field {
    gkd_desc desc;
    gkdi_block *block; /* sampling part */
    gkd_node *nodes;   /* building part's tree; leaves name building cells */
    gkdi_cell *cells;
    uint32_t node_count, cell_count, node_capacity, cell_capacity;
    gkdi_split_event *splits; /* since the last refine */
    uint32_t split_count, split_capacity;
    gkd_training_sample *pending; /* samples that wait for an update */
    uint32_t pending_count, pending_capacity;
    uint32_t pixels; /* the last pass had a pixel estimate */
    uint32_t guiding;
    double all_samples, held_samples; /* by the gate */
    gkdi_split_tests tests;
    gkdi_fit_options fit;
    gkd_stats stats;
};

/* What has become of one cell in an update: the cells that take its place, and a tree over them. Cell 0 keeps the
   cell's index. */
typedef struct gkdi_outcome {
    uint32_t cell;       /* of the field */
    uint32_t first, end; /* its samples in the sorted order */
    uint32_t room;       /* cells that it may add */
    uint32_t count, capacity, node_count, node_capacity;
    gkdi_cell *cells;
    gkd_node *nodes; /* links of leaves: local cells; 0 is the root */
    uint32_t *range; /* [capacity][4]: begin and end of a cell's items, then of its zeros */
    uint64_t radiance_splits, direction_splits, denied, fits, rests, alike;
    bool failed; /* no memory for its samples */
    bool grows;  /* its lookahead tree may take more memory */
} gkdi_outcome;

typedef struct gkdi_update {
    gkd_field *field;
    const gkd_training_sample *samples;
    uint32_t count;
    uint32_t *cell_of; /* [count], GKDI_NONE = refused */
    uint32_t *order;   /* samples by cell, each cell's in the order they came */
    uint32_t kept;     /* how many those are */
    gkdi_outcome *outcomes;
    uint32_t outcome_count;
} gkdi_update;

/* The samples of one cell: items are non-zero, zeros only have a position. Two arrays of each, and of lists of items,
   for stable partitions. */
typedef struct gkdi_cell_samples {
    gkdi_item *items, *other_items;
    float (*zeros)[3], (*other_zeros)[3];
    uint32_t *list, *other_list; /* of items */
} gkdi_cell_samples;

static uint64_t gkdi_cell_bytes(const gkdi_cell *c)
{
    return sizeof *c + (uint64_t)c->look_capacity * sizeof *c->look + (uint64_t)c->model_capacity * sizeof *c->model;
}

static uint32_t gkdi_cell_lobes(const gkdi_cell *c) { return c->model ? c->model[GKDI_PACKED_COUNT] : 0; }

static void gkdi_cell_free(const gkd_desc *desc, gkdi_cell *c)
{
    gkdi_release(desc, c->look);
    gkdi_release(desc, c->model);
    c->look = NULL;
    c->model = NULL;
}

/* Another capacity for a cell's lookahead tree. */
static bool gkdi_look_resize(const gkd_desc *desc, gkdi_cell *c, uint32_t capacity)
{
    gkd_signature *look = (gkd_signature *)gkdi_allocate(desc, capacity, sizeof *look);
    if (!look)
        return false;
    if (c->look_count)
        memcpy(look, c->look, c->look_count * sizeof *look);
    gkdi_release(desc, c->look);
    c->look = look;
    c->look_capacity = capacity;
    return true;
}

/* Levels below the cell that its lookahead tree may have. */
static uint32_t gkdi_look_levels(const gkd_desc *desc)
{
    return desc->split == GKD_SPLIT_SIGNATURE ? desc->lookahead : 0;
}

/* Lookahead cells that a cell with `count` of them has room for, until the next update. */
static uint32_t gkdi_look_room(const gkd_desc *desc, uint32_t count)
{
    uint32_t most = (2u << gkdi_look_levels(desc)) - 1, n = count + count / 4 + 6;
    return n < most ? n : most;
}

/* Stable partition of a range by a plane; the first part's end. */
static uint32_t gkdi_cut_items(gkdi_cell_samples *batch, uint32_t begin, uint32_t end, uint32_t axis, float split)
{
    uint32_t i, low = begin, high = 0;
    for (i = begin; i < end; ++i) { /* no branch: it could not be predicted */
        gkdi_item item = batch->items[i];
        bool above = !(item.position[axis] < split);
        batch->items[low] = item;
        batch->other_items[high] = item;
        low += !above;
        high += above;
    }
    memcpy(batch->items + low, batch->other_items, high * sizeof *batch->items);
    return low;
}

static uint32_t gkdi_cut_zeros(gkdi_cell_samples *batch, uint32_t begin, uint32_t end, uint32_t axis, float split)
{
    uint32_t i, low = begin, high = 0;
    for (i = begin; i < end; ++i) {
        float zero[3];
        bool above = !(batch->zeros[i][axis] < split);
        memcpy(zero, batch->zeros[i], sizeof zero);
        memcpy(batch->zeros[low], zero, sizeof zero);
        memcpy(batch->other_zeros[high], zero, sizeof zero);
        low += !above;
        high += above;
    }
    memcpy(batch->zeros + low, batch->other_zeros, high * sizeof *batch->zeros);
    return low;
}

/* A batch on its way down a lookahead tree: items by lists of their indices, which keeps them in the order they came;
   zeros themselves. */
typedef struct gkdi_feeder {
    const gkd_desc *desc;
    gkdi_cell *cell;
    gkdi_cell_samples *batch;
    double from[3]; /* reference point of positions */
} gkdi_feeder;

typedef struct gkdi_portion {
    uint32_t *list, count; /* items */
    uint32_t begin, end;   /* zeros */
} gkdi_portion;

/* The first `most` samples of a portion, items first, become part of a lookahead cell and are taken out of it. */
static void gkdi_look_take_in(const gkdi_feeder *f, gkd_signature *s, gkdi_portion *p, double most, gkdi_sum *sum)
{
    uint32_t items = (double)p->count < most ? p->count : (uint32_t)most, zeros = p->end - p->begin;
    gkdi_sum part;
    memset(&part, 0, sizeof part);
    gkdi_sum_items((uint32_t)f->desc->simd, &part, &f->cell->shape, f->from, f->batch->items, p->list, items);
    most -= items;
    zeros = (double)zeros < most ? zeros : (uint32_t)most;
    part.samples += zeros;
    p->list += items;
    p->count -= items;
    p->begin += zeros;
    gkdi_signature_add(s, &part, f->from);
    gkdi_sum_add(sum, &part);
}

/* Divide a lookahead cell where its samples allow it: true if it now has children. */
static bool gkdi_look_divide(gkdi_cell *c, gkd_signature *s)
{
    uint32_t axis;
    float split;
    if (!gkdi_signature_split_axis(s, &axis, &split))
        return false;
    s->axis = (uint8_t)axis;
    s->split = split;
    s->child = (uint16_t)c->look_count;
    memset(&c->look[c->look_count], 0, 2 * sizeof *c->look);
    c->look_count += 2;
    return true;
}

#if GKDI_X86
/* Those of four lanes whose bits are set in a mask, in front. */
GKDI_EXACT static inline __m128i gkdi_front4(__m128i lanes, uint32_t mask)
{
    static const uint32_t order[16] = {0, 0,        1,        0x000100, 2,        0x000200, 0x000201, 0x020100,
                                       3, 0x000300, 0x000301, 0x030100, 0x000302, 0x030200, 0x030201, 0x03020100};
    __m128i at = _mm_cvtepu8_epi32(_mm_cvtsi32_si128((int)order[mask]));
    return _mm_castps_si128(_mm_permutevar_ps(_mm_castsi128_ps(lanes), at));
}

/* gkdi_list_cut of a multiple of eight. */
GKDI_EXACT static uint32_t gkdi_list_cut_avx2(const float *places, float split, uint32_t *list, uint32_t count,
                                              uint32_t *other)
{
    uint32_t i, k, low = 0, up = 0;
    for (i = 0; i < count; i += 8) {
        __m256i at = _mm256_loadu_si256((const __m256i *)(const void *)(list + i));
        __m256 x = _mm256_i32gather_ps(places, _mm256_slli_epi32(at, 3), 4); /* floats of a gkdi_item: 2^3 */
        uint32_t above = (uint32_t)_mm256_movemask_ps(_mm256_cmp_ps(x, _mm256_set1_ps(split), _CMP_NLT_UQ));
        for (k = 0; k < 2; ++k, above >>= 4) {
            __m128i four = k ? _mm256_extracti128_si256(at, 1) : _mm256_castsi256_si128(at);
            uint32_t n = (uint32_t)__builtin_popcount(above & 15);
            _mm_storeu_si128((__m128i *)(void *)(list + low), gkdi_front4(four, ~above & 15));
            _mm_storeu_si128((__m128i *)(void *)(other + up), gkdi_front4(four, above & 15));
            low += 4 - n;
            up += n;
        }
    }
    return low;
}
#endif

/* Stable partition of a list of items by a plane, places = items[0].position + axis: what lies above goes to other. How
   many are left. */
static uint32_t gkdi_list_cut(uint32_t simd, const float *places, float split, uint32_t *list, uint32_t count,
                              uint32_t *other)
{
    uint32_t i = 0, low = 0, up = 0;
#if GKDI_X86
    if (simd > GKD_SIMD_SCALAR) {
        i = count & ~7u;
        low = gkdi_list_cut_avx2(places, split, list, i, other);
        up = i - low;
    }
#endif
    (void)simd;
    for (; i < count; ++i) { /* no branch: it could not be predicted */
        uint32_t at = list[i];
        bool above = !(places[at * (sizeof(gkdi_item) / sizeof(float))] < split);
        list[low] = other[up] = at;
        up += above;
        low += !above;
    }
    return low;
}

/* Stable partition of a portion by the plane of a lookahead cell: what lies below is left in it, the rest returned. */
static gkdi_portion gkdi_portion_cut(const gkdi_feeder *f, const gkd_signature *s, gkdi_portion *p)
{
    gkdi_portion high;
    uint32_t *other = f->batch->other_list;
    uint32_t low = gkdi_list_cut((uint32_t)f->desc->simd, f->batch->items[0].position + s->axis, s->split, p->list,
                                 p->count, other);
    uint32_t up = p->count - low;
    memcpy(p->list + low, other, up * sizeof *other);
    high.list = p->list + low;
    high.count = up;
    high.end = p->end;
    high.begin = p->end = gkdi_cut_zeros(f->batch, p->begin, p->end, s->axis, s->split);
    p->count = low;
    return high;
}

/* Add a portion to lookahead cell `node` (0: the cell itself), which lies `level` below it, and to those below; adds up
   what was added. Each sample is read where it ends; cells above get the sums of what is below. Where a cell without
   children has enough samples and levels and room are left, it is divided, and later samples go on below. */
static void gkdi_look_feed(const gkdi_feeder *f, uint32_t node, uint32_t level, gkdi_portion p, gkdi_sum *sum)
{
    gkdi_cell *c = f->cell;
    gkd_signature *s = &c->look[node];
    gkdi_portion high;
    gkdi_sum below;
    if (p.count == 0 && p.begin == p.end)
        return;
    if (!s->child) {
        double enough = (double)f->desc->min_samples;
        bool divides = level < gkdi_look_levels(f->desc) && !s->alike && c->look_count + 2 <= c->look_capacity;
        if (divides)
            gkdi_look_take_in(f, s, &p, fmax(ceil(enough - s->samples), 1), sum);
        if (!divides || s->samples < enough || !gkdi_look_divide(c, s)) {
            gkdi_look_take_in(f, s, &p, 1e10, sum);
            return;
        }
    }
    memset(&below, 0, sizeof below);
    high = gkdi_portion_cut(f, s, &p);
    gkdi_look_feed(f, s->child, level + 1, p, &below);
    gkdi_look_feed(f, s->child + 1u, level + 1, high, &below);
    gkdi_signature_add(s, &below, f->from);
    gkdi_sum_add(sum, &below);
}

/* Add a range of a batch to a cell; zeros change their order. */
static void gkdi_feed(const gkd_desc *desc, gkdi_cell *c, gkdi_cell_samples *batch, const uint32_t range[4])
{
    gkdi_feeder f;
    gkdi_portion p;
    gkdi_sum sum;
    uint32_t i;
    f.desc = desc;
    f.cell = c;
    f.batch = batch;
    p.list = batch->list;
    p.count = range[1] - range[0];
    p.begin = range[2];
    p.end = range[3];
    for (i = 0; i < 3; ++i)
        f.from[i] = c->look[0].lit > 0 || !p.count ? c->look[0].mean[i] : (double)batch->items[range[0]].position[i];
    for (i = 0; i < p.count; ++i)
        p.list[i] = range[0] + i;
    memset(&sum, 0, sizeof sum);
    gkdi_look_feed(&f, 0, 0, p, &sum);
    c->lit += range[1] - range[0];
}

/* Which tests (1 radiance, 2 direction, 4 count) want the cell split; 0 = none. */
static uint32_t gkdi_wants_split(const gkd_field *field, const gkdi_cell *c)
{
    const gkd_desc *desc = &field->desc;
    uint32_t i, asks = 0, mask = (desc->no_radiance_test ? 0 : 1u) | (desc->no_direction_test ? 0 : 2u);
    if (desc->split == GKD_SPLIT_COUNT)
        return c->lit > (double)desc->split_samples ? 4u : 0u;
    for (i = 1; i < c->look_count && asks != mask; ++i)
        asks |= (uint32_t)gkdi_compare(&field->tests, &c->look[0], &c->shape, &c->look[i]) & mask;
    return asks;
}

/* Take lookahead cells without use out of a cell's tree. used: 1 for those that are left, whose order stays. */
static void gkdi_look_pack(gkdi_cell *c, const unsigned char *used)
{
    uint16_t place[GKDI_MAX_LOOK];
    uint32_t i, count = 0;
    for (i = 0; i < c->look_count; ++i)
        place[i] = (uint16_t)(used[i] ? count++ : 0);
    for (i = 0; i < c->look_count; ++i)
        if (used[i]) {
            c->look[place[i]] = c->look[i];
            c->look[place[i]].child = c->look[i].child ? place[c->look[i].child] : 0;
        }
    c->look_count = count;
}

/* Give up the children of lookahead cells of which both are surely like the cell, from the last level up, so that
   nothing is given up of which the parts were not seen. Those about them stay and are asked again at every update; when
   they differ, or their samples pass the power of two that `alike` holds the exponent of, twice to four times those at
   which they were given up, they grow again: light may have changed in a small part of them. Returns how many were
   given up. */
static uint32_t gkdi_look_prune(const gkd_field *field, gkdi_cell *c)
{
    const gkd_desc *desc = &field->desc;
    unsigned char level[GKDI_MAX_LOOK], used[GKDI_MAX_LOOK];
    uint32_t i, k, gone = 0;
    memset(used, 1, sizeof used);
    memset(level, 0, sizeof level);
    for (i = level[0] = 0; i < c->look_count; ++i) /* children come after their parents */
        for (k = 0; k < 2 && c->look[i].child; ++k)
            level[c->look[i].child + k] = (unsigned char)(level[i] + 1);
    for (i = c->look_count; i-- > 1;) {
        gkd_signature *s = &c->look[i], *child = &c->look[s->child];
        uint32_t doubled = 1 + (uint32_t)ilogb(fmin(s->samples + 1, 1e70));
        bool same;
        if (s->child && child[0].alike && child[1].alike) {
            used[s->child] = used[s->child + 1] = 0;
            gone += 2;
            s->child = 0;
            s->alike = (uint8_t)(doubled + 1);
        }
        if (s->child || (!s->alike && level[i] < gkdi_look_levels(desc)))
            continue;
        same = gkdi_alike(&field->tests, &c->look[0], &c->shape, s, !desc->no_radiance_test, !desc->no_direction_test);
        if (level[i] < gkdi_look_levels(desc))
            s->alike = (uint8_t)(same && s->alike >= doubled ? s->alike : 0);
        else
            s->alike = (uint8_t)(same ? doubled : 0);
    }
    if (gone) {
        uint32_t room;
        gkdi_look_pack(c, used);
        room = gkdi_look_room(desc, c->look_count);
        if (room < c->look_capacity)         /* growing is for updates, which count bytes */
            gkdi_look_resize(desc, c, room); /* or it stays large */
    }
    return gone;
}

/* Make `to` the part of `from` below node `root` of its lookahead tree. What was seen counts `keep` times: 0 leaves
   only where the tree is cut. */
static void gkdi_look_take(const gkdi_cell *from, uint32_t root, gkdi_cell *to, double keep)
{
    uint32_t source[GKDI_MAX_LOOK], i, k;
    to->look_count = 1;
    source[0] = root;
    for (i = 0; i < to->look_count; ++i) {
        const gkd_signature *s = &from->look[source[i]];
        gkd_signature *d = &to->look[i];
        memset(d, 0, sizeof *d);
        if (keep > 0) {
            *d = *s;
            gkdi_signature_scale(d, keep);
        }
        d->axis = s->axis;
        d->split = s->split;
        d->child = 0;
        d->alike = 0; /* another cell to be like */
        if (!s->child)
            continue;
        d->child = (uint16_t)to->look_count;
        for (k = 0; k < 2; ++k)
            source[to->look_count++] = (uint32_t)s->child + k;
    }
    if (keep > 0 && from->look[0].squares > 0) /* the noise of the part has the shape of the whole */
        gkdi_shape_scale(&to->shape, to->look[0].squares / from->look[0].squares);
    else
        memset(&to->shape, 0, sizeof to->shape);
}

/* Room for one more cell and two more nodes. */
static bool gkdi_outcome_room(const gkd_desc *desc, gkdi_outcome *o)
{
    if (o->count == o->capacity) {
        uint32_t n = o->capacity ? 2 * o->capacity : 4;
        gkdi_cell *cells = (gkdi_cell *)gkdi_allocate(desc, n, sizeof *cells);
        gkd_node *nodes = (gkd_node *)gkdi_allocate(desc, 2 * (uint64_t)n, sizeof *nodes);
        uint32_t *range = (uint32_t *)gkdi_allocate(desc, 4 * (uint64_t)n, sizeof *range);
        if (!cells || !nodes || !range) {
            gkdi_release(desc, cells);
            gkdi_release(desc, nodes);
            gkdi_release(desc, range);
            return false;
        }
        if (o->count) {
            memcpy(cells, o->cells, o->count * sizeof *cells);
            memcpy(nodes, o->nodes, o->node_count * sizeof *nodes);
            memcpy(range, o->range, 4 * (size_t)o->count * sizeof *range);
        }
        gkdi_release(desc, o->cells);
        gkdi_release(desc, o->nodes);
        gkdi_release(desc, o->range);
        o->cells = cells;
        o->nodes = nodes;
        o->range = range;
        o->capacity = n;
    }
    return true;
}

static void gkdi_outcome_free(const gkd_desc *desc, gkdi_outcome *o)
{
    uint32_t i;
    for (i = 0; i < o->count; ++i)
        gkdi_cell_free(desc, &o->cells[i]);
    gkdi_release(desc, o->cells);
    gkdi_release(desc, o->nodes);
    gkdi_release(desc, o->range);
    o->cells = NULL;
    o->nodes = NULL;
    o->range = NULL;
    o->count = 0;
}

/* Copy of a cell with lookahead tree and mixture of its own; the tree has room for all levels. */
static bool gkdi_cell_copy(const gkd_desc *desc, const gkdi_cell *from, gkdi_cell *to)
{
    uint32_t most = (2u << gkdi_look_levels(desc)) - 1;
    *to = *from;
    to->look = (gkd_signature *)gkdi_allocate(desc, most, sizeof *to->look);
    to->look_capacity = most;
    to->model = from->model ? (uint32_t *)gkdi_allocate(desc, from->model_capacity, sizeof *to->model) : NULL;
    if (!to->look || (from->model && !to->model)) {
        gkdi_cell_free(desc, to);
        return false;
    }
    memcpy(to->look, from->look, from->look_count * sizeof *to->look);
    if (from->model)
        memcpy(to->model, from->model, from->model_capacity * sizeof *to->model);
    return true;
}

/* Divide local cell `at` in two: itself and a new one, the last. */
static bool gkdi_divide(const gkd_field *field, gkdi_outcome *o, uint32_t at, uint32_t axis, float split,
                        gkdi_cell_samples *batch)
{
    const gkd_desc *desc = &field->desc;
    uint32_t *range, *other, k;
    gkdi_cell low, high, *old;
    if (!gkdi_outcome_room(desc, o))
        return false;
    old = &o->cells[at];
    range = o->range + 4 * at;
    other = o->range + 4 * o->count;
    old->lit = (old->lit - (range[1] - range[0])) / 2;
    gkdi_gate_scale(&old->gate, 0.5);
    old->gate.fresh /= 2;
    old->gate.flow /= 2;
    old->level++;
    old->calm = 0;
    old->wakes = 0;
    if (!gkdi_cell_copy(desc, old, &low))
        return false;
    if (!gkdi_cell_copy(desc, old, &high)) {
        gkdi_cell_free(desc, &low);
        return false;
    }
    for (k = 0; k < 2; ++k) {
        gkdi_cell *half = k ? &high : &low;
        if (half->model) { /* of the other half's light: counts less than what comes */
            gkdi_model model;
            gkdi_model_unpack(&model, half->model);
            gkdi_model_decay(&model, 0.5f);
            gkdi_model_pack(&model, half->model);
        }
        if (old->look[0].child) {
            gkdi_look_take(old, (uint32_t)old->look[0].child + k, half, (double)desc->keep_signatures);
            continue;
        }
        half->look_count = 1;
        memset(&half->look[0], 0, sizeof *half->look);
        memset(&half->shape, 0, sizeof half->shape);
    }
    gkdi_cell_free(desc, old);
    *old = low;
    o->cells[o->count] = high;
    memcpy(other, range, 4 * sizeof *range);
    range[1] = other[0] = gkdi_cut_items(batch, range[0], range[1], axis, split);
    range[3] = other[2] = gkdi_cut_zeros(batch, range[2], range[3], axis, split);
    if (!(desc->keep_signatures > 0) || desc->split == GKD_SPLIT_COUNT) {
        gkdi_feed(desc, &o->cells[at], batch, range);
        gkdi_feed(desc, &o->cells[o->count], batch, other);
    } else {
        o->cells[at].lit += range[1] - range[0];
        o->cells[o->count].lit += other[1] - other[0];
    }
    o->count++;
    return true;
}

/* Split local cell `at`, leaf `node` of the local tree, and its parts for as long as they ask for it. */
static bool gkdi_split_parts(const gkd_field *field, gkdi_outcome *o, uint32_t at, uint32_t node,
                             gkdi_cell_samples *batch)
{
    const gkd_desc *desc = &field->desc;
    uint32_t asks = gkdi_wants_split(field, &o->cells[at]), axis, pair;
    float split;
    const gkd_signature *s = &o->cells[at].look[0];
    if (!asks)
        return true;
    if (o->cells[at].level >= desc->max_levels || o->count > o->room) {
        o->denied++;
        return true;
    }
    axis = s->axis;
    split = s->split;
    if (!s->child && !gkdi_signature_split_axis(s, &axis, &split))
        return true;
    if (!gkdi_divide(field, o, at, axis, split, batch))
        return false;
    o->radiance_splits += asks & 1u;
    o->direction_splits += asks >> 1 & 1u;
    pair = o->node_count;
    o->node_count += 2;
    o->nodes[node].split = split;
    o->nodes[node].link = axis << 29 | pair;
    o->nodes[pair].split = o->nodes[pair + 1].split = 0;
    o->nodes[pair].link = GKD_LEAF | at;
    o->nodes[pair + 1].link = GKD_LEAF | (o->count - 1);
    {
        uint32_t other = o->count - 1;
        return gkdi_split_parts(field, o, at, pair, batch) && gkdi_split_parts(field, o, other, pair + 1, batch);
    }
}

/* The guide's density of a sample whose vertex did not ask for it. */
static float gkdi_sample_pdf(const gkd_view *view, const gkd_training_sample *s, const float direction[3])
{
    gkd_handle handle;
    float normal[3];
    gkd_unpack_normal(s->direction, normal);
    gkd_find_scalar(view, s->position, normal, NULL, &handle); /* the same bits from all levels */
    return gkd_pdf_scalar(&handle, direction);
}

/* A sample's position, within the bounds. */
static void gkdi_place(const gkd_desc *desc, const gkd_training_sample *s, float position[3])
{
    uint32_t k;
    for (k = 0; k < 3; ++k) {
        float x = s->position[k] > desc->bounds_min[k] ? s->position[k] : desc->bounds_min[k];
        position[k] = x < desc->bounds_max[k] ? x : desc->bounds_max[k];
    }
}

/* Decode a cell's samples and tell its gate of them; range is set to what there is. */
static void gkdi_take_samples(const gkdi_update *u, const gkdi_outcome *o, gkdi_cell *c, gkdi_cell_samples *batch,
                              uint32_t range[4])
{
    const gkd_desc *desc = &u->field->desc;
    gkd_view view = gkd_get_view(u->field);
    bool judge = !desc->no_gate && !desc->no_mixtures && (c->gate.verdict != GKD_GATE_CLOSED || c->gate.probe == 0);
    uint32_t i, k, items = 0, zeros = 0;
    for (i = o->first; i < o->end; ++i) {
        const gkd_training_sample *s = &u->samples[u->order[i]];
        const gkd_training_sample *soon = &u->samples[u->order[i + GKDI_AHEAD < u->kept ? i + GKDI_AHEAD : i]];
        bool rejected = s->radiance == 0 && signbit(s->radiance);
        double p = (double)s->pdf_mix, pg = (double)s->pdf_guide, g = rejected ? 0 : (double)s->contribution;
        float direction[3], position[3];
        GKDI_PREFETCH(soon);
        GKDI_PREFETCH(&soon->pdf_guide); /* may be on the next cache line */
        gkdi_place(desc, s, position);
        gkd_unpack_direction(s->direction, direction);
        c->gate.fresh += 1;
        c->gate.flow += g / p < 1e30 ? g / p : 1e30;
        if (judge && (c->gate.hits < GKDI_ENOUGH_HITS || ((uint32_t)(int64_t)c->gate.fresh & 7u) == 0)) {
            c->gate.count += 1;
            if (g > 0) {
                bool guided = c->gate.rebuilds > 0;
                if (guided && !(pg > 0))
                    pg = (double)gkdi_sample_pdf(&view, s, direction);
                c->gate.hits++;
                gkdi_gate_add(&c->gate, g, (double)s->pixel_contribution, p, (double)s->pdf_bsdf,
                              guided ? pg : (double)s->pdf_bsdf); /* without a mixture: neutral */
            }
        }
        if (rejected)
            continue;
        if (s->radiance > 0) {
            gkdi_item *item = &batch->items[items++];
            for (k = 0; k < 3; ++k) { /* memcpy of a pair waits until both were stored */
                item->position[k] = position[k];
                item->direction[k] = direction[k];
            }
            item->nearness = s->nearness;
            item->weight = s->radiance / s->pdf_mix;
            item->weight = item->weight < 1e30f ? item->weight : 1e30f;
            items -= !(item->weight > 0); /* underflow */
        } else
            memcpy(batch->zeros[zeros++], position, sizeof position);
    }
    range[0] = range[2] = 0;
    range[1] = items;
    range[3] = zeros;
}

/* Room for so many lobes. */
static bool gkdi_model_room(const gkd_desc *desc, gkdi_cell *c, uint32_t lobes)
{
    uint32_t words = gkdi_model_words((lobes + 3) & ~3u);
    uint32_t *model;
    if (gkdi_model_words(lobes) <= c->model_capacity)
        return true;
    model = (uint32_t *)gkdi_allocate(desc, words, sizeof *model);
    if (!model)
        return false;
    gkdi_release(desc, c->model);
    c->model = model;
    c->model_capacity = words;
    return true;
}

/* Kullback-Leibler divergence, in nats, of a mixture from what it was before: at most that of the weights and the mean
   of that of pairs of lobes (log-sum inequality). Of lobes, with C = kappa / (2 pi (1 - exp(-2 kappa))) and A the mean
   cosine, it is log(C'/C) + A' (kappa' - kappa mean' . mean) - (kappa' - kappa). Pairs are by index: infinite where
   their number changed, large where some were split and others merged. */
static double gkdi_divergence(const gkdi_model *before, const gkdi_model *now, const gkdi_fit_options *o)
{
    gkdi_mixture p, q;
    double bound = 0;
    uint32_t k;
    if (before->count != now->count || !now->count)
        return (double)INFINITY;
    gkdi_maximise(&before->sums, before->count, o, &q);
    gkdi_maximise(&now->sums, now->count, o, &p);
    for (k = 0; k < now->count; ++k) {
        const float mp[3] = {p.x[k], p.y[k], p.z[k]}, mq[3] = {q.x[k], q.y[k], q.z[k]};
        double w = (double)p.weight[k], kp = (double)p.kappa[k], kq = (double)q.kappa[k];
        double lobes = log(gkdi_peak(kp) / gkdi_peak(kq)) - (kp - kq) +
                       gkdi_mean_cosine(kp) * (kp - kq + kq * 0.5 * gkdi_distance2(mp, mq));
        bound += w > 0 ? w * (log(w / gkdi_max((double)q.weight[k], 1e-30)) + lobes) : 0;
    }
    return bound;
}

/* After a fit: could the mixture rest? If it moved by at most GKDI_CALM nats, over the share h of its samples that was
   new (own). Noise: where d is how far a mixture of all samples is from the truth, a fit moves it by about h d. Change:
   light that is D from what is known moves it by h^2 D. So d and h D are small. After GKDI_CALM_FITS of these in a row
   it rests until the cell has seen twice the samples; if it moves then, it is awake. */
static void gkdi_calm(gkdi_cell *c, const gkdi_model *before, const gkdi_model *now, uint32_t n,
                      const gkdi_fit_options *o)
{
    double share = gkdi_min(n / gkdi_max((double)now->samples, 1), 1);
    bool calm = gkdi_divergence(before, now, o) <= (double)GKDI_CALM * share;
    c->calm = !calm ? 0 : c->calm < GKDI_CALM_FITS ? c->calm + 1 : c->calm;
    c->wakes = c->calm == GKDI_CALM_FITS ? 2 * c->lit : 0;
}

/* Learn a cell's mixture from items, seen from the mean position of all that the cell has seen. False = out of memory:
   it stays as it was. */
static bool gkdi_fit_cell(const gkd_field *field, gkdi_outcome *o, gkdi_cell *c, const gkdi_item *items, uint32_t n)
{
    const gkd_desc *desc = &field->desc;
    gkdi_model model, before;
    float pivot[3];
    if (n == 0 || desc->no_mixtures)
        return true;
    if (c->lit < c->wakes) {
        o->rests++;
        return true;
    }
    gkdi_signature_mean(&c->look[0], pivot);
    if (c->model) {
        gkdi_model_unpack(&model, c->model);
        gkdi_model_move(&model, pivot, &field->fit);
    } else
        gkdi_model_init(&model, pivot);
    before = model;
    gkdi_model_fit(&model, items, n, &field->fit);
    if (!gkdi_model_room(desc, c, model.count))
        return false;
    gkdi_model_pack(&model, c->model);
    o->fits++;
    if (!desc->no_rest)
        gkdi_calm(c, &before, &model, n, &field->fit);
    return true;
}

/* Divide a copy of a cell for as long as its parts ask for it, and fit the parts' mixtures. False = out of memory. */
static bool gkdi_split_cell(const gkd_field *field, gkdi_outcome *o, gkdi_cell_samples *batch, const uint32_t range[4])
{
    const gkd_desc *desc = &field->desc;
    uint32_t i;
    if (!gkdi_outcome_room(desc, o) || !gkdi_cell_copy(desc, &field->cells[o->cell], &o->cells[0]))
        return false;
    o->count = o->node_count = 1;
    o->nodes[0].link = GKD_LEAF;
    memcpy(o->range, range, 4 * sizeof *range);
    if (!gkdi_split_parts(field, o, 0, 0, batch))
        return false;
    for (i = 0; i < o->count; ++i) {
        gkdi_cell *c = &o->cells[i];
        if (!gkdi_fit_cell(field, o, c, batch->items + o->range[4 * i], o->range[4 * i + 1] - o->range[4 * i]) ||
            !gkdi_look_resize(desc, c,
                              o->count > 1 ? gkdi_look_room(desc, c->look_count) /* undivided: as it was */
                                           : field->cells[o->cell].look_capacity))
            return false;
    }
    return true;
}

/* All of one cell: its samples, signatures, splits and mixtures. Without a split everything is done in place; where a
   split finds no memory, the cell goes on undivided. */
static void gkdi_update_cell(const gkdi_update *u, gkdi_outcome *o, gkdi_cell_samples *batch)
{
    gkd_field *field = u->field;
    const gkd_desc *desc = &field->desc;
    gkdi_cell *c = &field->cells[o->cell];
    uint32_t range[4], room = gkdi_look_room(desc, c->look_count);
    gkdi_take_samples(u, o, c, batch, range);
    if (room > c->look_capacity && o->grows)
        gkdi_look_resize(desc, c, room); /* else it grows later */
    gkdi_feed(desc, c, batch, range);
    if (gkdi_wants_split(field, c)) {
        if (gkdi_split_cell(field, o, batch, range))
            return;
        gkdi_outcome_free(desc, o);
        o->denied++;
    } else if (desc->split == GKD_SPLIT_SIGNATURE && !desc->no_prune && !desc->published_tests)
        o->alike += gkdi_look_prune(field, c);
    gkdi_fit_cell(field, o, c, batch->items, range[1]);
}

static void gkdi_update_cells(void *context, uint32_t begin, uint32_t end)
{
    gkdi_update *u = (gkdi_update *)context;
    const gkd_desc *desc = &u->field->desc;
    gkdi_cell_samples batch;
    uint32_t k;
    size_t n = 0;
    for (k = begin; k < end; ++k)
        n = u->outcomes[k].end - u->outcomes[k].first > n ? u->outcomes[k].end - u->outcomes[k].first : n;
    batch.items = (gkdi_item *)desc->allocate(desc->user, n * 2 * sizeof *batch.items);
    batch.zeros = (float(*)[3])desc->allocate(desc->user, n * 2 * sizeof *batch.zeros);
    batch.list = (uint32_t *)desc->allocate(desc->user, n * 2 * sizeof *batch.list);
    for (k = begin; k < end; ++k) {
        u->outcomes[k].failed = !batch.items || !batch.zeros || !batch.list;
        if (u->outcomes[k].failed)
            continue;
        batch.other_items = batch.items + n;
        batch.other_zeros = batch.zeros + n;
        batch.other_list = batch.list + n;
        gkdi_update_cell(u, &u->outcomes[k], &batch);
    }
    gkdi_release(desc, batch.items);
    gkdi_release(desc, batch.zeros);
    gkdi_release(desc, batch.list);
}

static bool gkdi_finite(float x) { return x - x == 0; }

static bool gkdi_sample_valid(const gkd_training_sample *s)
{
    return gkdi_finite(s->position[0]) && gkdi_finite(s->position[1]) && gkdi_finite(s->position[2]) &&
           s->radiance >= 0 && s->radiance < GKDI_MAX_VALUE && s->contribution >= 0 &&
           s->contribution < GKDI_MAX_VALUE && s->pixel_contribution >= 0 && s->pixel_contribution < GKDI_MAX_VALUE &&
           s->pdf_mix > 0 && s->pdf_mix < INFINITY && s->pdf_bsdf >= 0 && s->pdf_bsdf < INFINITY && s->pdf_guide >= 0 &&
           s->pdf_guide < INFINITY && s->nearness >= 0 && s->nearness < INFINITY;
}

#if GKDI_X86
/* gkdi_find_cells of 16 positions; lanes are positions. */
GKDI_EXACT static void gkdi_find_cells_avx2(const gkd_node *nodes, const float (*positions)[16], uint32_t *cells)
{
    const int *words = (const int *)(const void *)nodes;
    __m256i at[2], link[2], leaves;
    int g;
    at[0] = at[1] = _mm256_setzero_si256();
    do {
        leaves = _mm256_set1_epi32(-1);
        for (g = 0; g < 2; ++g) {
            __m256 split = _mm256_castsi256_ps(_mm256_i32gather_epi32(words, at[g], 8)), place, next;
            link[g] = _mm256_i32gather_epi32(words + 1, at[g], 8);
            place = _mm256_blendv_ps(_mm256_loadu_ps(positions[0] + 8 * g), _mm256_loadu_ps(positions[1] + 8 * g),
                                     _mm256_castsi256_ps(_mm256_slli_epi32(link[g], 2)));
            place = _mm256_blendv_ps(place, _mm256_loadu_ps(positions[2] + 8 * g),
                                     _mm256_castsi256_ps(_mm256_slli_epi32(link[g], 1)));
            place = _mm256_cmp_ps(place, split, _CMP_NLT_UQ); /* -1: the upper child */
            next = _mm256_castsi256_ps(
                _mm256_sub_epi32(_mm256_and_si256(link[g], _mm256_set1_epi32(0x1fffffff)), _mm256_castps_si256(place)));
            at[g] =
                _mm256_castps_si256(_mm256_blendv_ps(next, _mm256_castsi256_ps(at[g]), _mm256_castsi256_ps(link[g])));
            leaves = _mm256_and_si256(leaves, link[g]);
        }
    } while (_mm256_movemask_ps(_mm256_castsi256_ps(leaves)) != 0xff);
    for (g = 0; g < 2; ++g)
        _mm256_storeu_si256((__m256i *)(void *)(cells + 8 * g),
                            _mm256_andnot_si256(_mm256_set1_epi32((int)GKD_LEAF), link[g]));
}
#endif

/* gkd_find_cell of up to GKDI_GROUP positions, level by level: how deep a leaf lies cannot be predicted. */
static void gkdi_find_cells(uint32_t simd, const gkd_node *nodes, uint32_t count, const float *const *positions,
                            uint32_t *cells)
{
    uint32_t at[GKDI_GROUP], k, more = 1;
#if GKDI_X86
    if (simd > GKD_SIMD_SCALAR && count > 4) {
        float columns[3][GKDI_GROUP];
        for (k = 0; k < GKDI_GROUP; ++k) {
            const float *p = positions[k < count ? k : count - 1];
            columns[0][k] = p[0];
            columns[1][k] = p[1];
            columns[2][k] = p[2];
        }
        gkdi_find_cells_avx2(nodes, (const float(*)[GKDI_GROUP])columns, at);
        memcpy(cells, at, count * sizeof *cells);
        return;
    }
#endif
    (void)simd;
    memset(at, 0, sizeof at);
    while (more) {
        more = 0;
        for (k = 0; k < count; ++k) {
            uint32_t link = nodes[at[k]].link;
            uint32_t next = (link & 0x1fffffffu) + !(positions[k][link >> 29 & 3] < nodes[at[k]].split);
            at[k] = link & GKD_LEAF ? at[k] : next;
            more |= ~link & GKD_LEAF;
        }
    }
    for (k = 0; k < count; ++k)
        cells[k] = nodes[at[k]].link & ~GKD_LEAF;
}

static void gkdi_locate(void *context, uint32_t begin, uint32_t end)
{
    gkdi_update *u = (gkdi_update *)context;
    float place[GKDI_GROUP][3];
    const float *places[GKDI_GROUP];
    bool valid[GKDI_GROUP];
    uint32_t i, k, n;
    for (k = 0; k < GKDI_GROUP; ++k)
        places[k] = place[k];
    for (i = begin; i < end; i += n) {
        n = end - i < GKDI_GROUP ? end - i : GKDI_GROUP;
        for (k = 0; k < n; ++k) {
            gkdi_place(&u->field->desc, &u->samples[i + k], place[k]);
            valid[k] = gkdi_sample_valid(&u->samples[i + k]);
        }
        gkdi_find_cells((uint32_t)u->field->desc.simd, u->field->nodes, n, places, u->cell_of + i);
        for (k = 0; k < n; ++k)
            if (!valid[k])
                u->cell_of[i + k] = GKDI_NONE;
    }
}

/* Count what came, and sort it by cell; outcomes has room for every cell that could have samples. */
static void gkdi_sort(gkdi_update *u, uint32_t *start)
{
    gkd_field *field = u->field;
    const gkd_desc *desc = &field->desc;
    uint32_t i, k, at = 0;
    for (i = 0; i < u->count; ++i) {
        const gkd_training_sample *s = &u->samples[i];
        bool outside = false;
        if (u->cell_of[i] == GKDI_NONE) {
            field->stats.refused++;
            continue;
        }
        for (k = 0; k < 3; ++k)
            outside = outside || s->position[k] < desc->bounds_min[k] || s->position[k] > desc->bounds_max[k];
        field->stats.samples++;
        field->stats.clamped += outside;
        field->stats.zeros += !(s->radiance > 0);
        field->stats.rejected += s->radiance == 0 && signbit(s->radiance);
        start[u->cell_of[i]]++;
    }
    for (i = 0; i < field->cell_count; ++i) {
        uint32_t n = start[i];
        start[i] = at;
        if (!n)
            continue;
        memset(&u->outcomes[u->outcome_count], 0, sizeof *u->outcomes);
        u->outcomes[u->outcome_count].cell = i;
        u->outcomes[u->outcome_count].first = at;
        u->outcomes[u->outcome_count++].end = at += n;
    }
    u->kept = at;
    for (i = 0; i < u->count; ++i)
        if (u->cell_of[i] != GKDI_NONE)
            u->order[start[u->cell_of[i]]++] = i;
}

/* Room for so many more cells in the field; false = out of memory, nothing changed. */
static bool gkdi_field_room(gkd_field *field, uint64_t cells)
{
    const gkd_desc *desc = &field->desc;
    uint64_t need = field->cell_count + cells, n = field->cell_capacity;
    gkdi_cell *new_cells;
    gkd_node *new_nodes;
    gkdi_split_event *splits;
    if (need <= field->cell_capacity && field->split_count + cells <= field->split_capacity)
        return true;
    n = need > n ? need + need / 2 : n;
    new_cells = (gkdi_cell *)gkdi_allocate(desc, n, sizeof *new_cells);
    new_nodes = (gkd_node *)gkdi_allocate(desc, 2 * n, sizeof *new_nodes);
    splits = (gkdi_split_event *)gkdi_allocate(desc, n, sizeof *splits); /* splits since refine < cells */
    if (!new_cells || !new_nodes || !splits) {
        gkdi_release(desc, new_cells);
        gkdi_release(desc, new_nodes);
        gkdi_release(desc, splits);
        return false;
    }
    memcpy(new_cells, field->cells, field->cell_count * sizeof *new_cells);
    memcpy(new_nodes, field->nodes, field->node_count * sizeof *new_nodes);
    if (field->split_count)
        memcpy(splits, field->splits, field->split_count * sizeof *splits);
    gkdi_release(desc, field->cells);
    gkdi_release(desc, field->nodes);
    gkdi_release(desc, field->splits);
    field->cells = new_cells;
    field->nodes = new_nodes;
    field->splits = splits;
    field->cell_capacity = (uint32_t)n;
    field->node_capacity = (uint32_t)(2 * n);
    field->split_capacity = (uint32_t)n;
    return true;
}

/* Put an outcome in the place of its cell, whose leaf is `leaf`. There is room. */
static void gkdi_commit(gkd_field *field, gkdi_outcome *o, uint32_t leaf)
{
    uint32_t base = field->node_count, first = field->cell_count, i;
    gkdi_cell_free(&field->desc, &field->cells[o->cell]);
    field->cells[o->cell] = o->cells[0];
    for (i = 1; i < o->count; ++i)
        field->cells[field->cell_count++] = o->cells[i];
    for (i = 0; i < o->node_count; ++i) {
        gkd_node n = o->nodes[i];
        if (n.link & GKD_LEAF) {
            uint32_t local = n.link & ~GKD_LEAF;
            n.link = GKD_LEAF | (local ? first + local - 1 : o->cell);
        } else {
            uint32_t pair = n.link & 0x1fffffffu;
            n.link = (n.link & 0x60000000u) | (base + pair - 1);
        }
        field->nodes[i ? base + i - 1 : leaf] = n;
    }
    field->node_count += o->node_count - 1;
    o->count = 0; /* the cells are the field's now */
}

/* The splits of an outcome in the order they were made: local cell c came from the cell that held its place. */
static void gkdi_tell_splits(gkd_field *field, const gkdi_outcome *o, uint32_t first)
{
    uint32_t pair;
    for (pair = 1; pair + 1 < o->node_count; pair += 2) {
        /* walk down the lower (upper) children to the cell that had the pair's parent when it was split */
        uint32_t low = pair, high = pair + 1, a, b;
        while (!(o->nodes[low].link & GKD_LEAF))
            low = o->nodes[low].link & 0x1fffffffu;
        while (!(o->nodes[high].link & GKD_LEAF))
            high = o->nodes[high].link & 0x1fffffffu;
        a = o->nodes[low].link & ~GKD_LEAF;
        b = o->nodes[high].link & ~GKD_LEAF;
        field->splits[field->split_count].parent = a ? first + a - 1 : o->cell;
        field->splits[field->split_count++].child = first + b - 1;
    }
}

/* New cells that memory allows. */
static uint64_t gkdi_cells_allowed(const gkd_field *field, uint64_t bytes)
{
    const gkd_desc *desc = &field->desc;
    uint64_t one = 2 * sizeof(gkdi_cell) + sizeof(gkd_cell) + 2 * sizeof(gkd_node) + sizeof(gkdi_model) +
                   desc->max_lobes * sizeof(gkd_lobe) + ((2u << gkdi_look_levels(desc)) - 1) * sizeof(gkd_signature);
    uint64_t left = bytes < desc->max_bytes ? desc->max_bytes - bytes : 0, n = left / one;
    uint64_t most = GKDI_MAX_CELLS - field->cell_count;
    return n < most ? n : most;
}

static uint64_t gkdi_field_bytes(const gkd_field *field)
{
    uint64_t bytes = sizeof *field + field->block->size + field->node_capacity * sizeof(gkd_node) +
                     field->split_capacity * sizeof(gkdi_split_event) +
                     (uint64_t)(field->cell_capacity - field->cell_count) * sizeof(gkdi_cell);
    uint32_t i;
    for (i = 0; i < field->cell_count; ++i)
        bytes += gkdi_cell_bytes(&field->cells[i]);
    return bytes;
}

/* Scratch of an update; false = out of memory. */
static bool gkdi_update_start(gkdi_update *u, gkd_field *field, uint32_t **start)
{
    const gkd_desc *desc = &field->desc;
    uint32_t cells = field->cell_count < field->pending_count ? field->cell_count : field->pending_count;
    u->field = field;
    u->samples = field->pending;
    u->count = field->pending_count;
    u->cell_of = (uint32_t *)desc->allocate(desc->user, ((size_t)u->count + 1) * 2 * sizeof *u->cell_of);
    u->outcomes = (gkdi_outcome *)gkdi_allocate(desc, cells, sizeof *u->outcomes);
    *start = (uint32_t *)gkdi_allocate(desc, field->cell_count, sizeof **start);
    if (u->cell_of && u->outcomes && *start) {
        u->order = u->cell_of + u->count;
        return true;
    }
    return false;
}

/* Make the outcomes the field's. leaves: node of each cell with an outcome. */
static void gkdi_update_commit(gkdi_update *u, const uint32_t *leaves)
{
    gkd_field *field = u->field;
    uint64_t more = 0;
    uint32_t k;
    for (k = 0; k < u->outcome_count; ++k)
        more += u->outcomes[k].count > 1 ? u->outcomes[k].count - 1 : 0;
    if (!gkdi_field_room(field, more))
        for (k = 0; k < u->outcome_count; ++k)
            gkdi_outcome_free(&field->desc, &u->outcomes[k]);
    for (k = 0; k < u->outcome_count; ++k) {
        gkdi_outcome *o = &u->outcomes[k];
        field->stats.radiance_splits += o->radiance_splits;
        field->stats.direction_splits += o->direction_splits;
        field->stats.denied_splits += o->denied;
        field->stats.fits += o->fits;
        field->stats.rests += o->rests;
        field->stats.alike += o->alike;
        if (o->failed) {
            field->stats.samples -= o->end - o->first;
            field->stats.lost += o->end - o->first;
        }
        if (o->count) {
            gkdi_tell_splits(field, o, field->cell_count);
            gkdi_commit(field, o, leaves[o->cell]);
        }
        gkdi_outcome_free(&field->desc, o);
    }
}

/* Learn from the samples that wait: see HOW IT WORKS. They are gone afterwards, whatever happens. */
static gkd_result gkdi_do_update(gkd_field *field, gkd_parallel_fn parallel, void *user)
{
    const gkd_desc *desc = &field->desc;
    gkdi_update u;
    uint32_t *start = NULL, i, k;
    uint64_t allowed, lost = field->stats.lost, bytes = field->stats.bytes;
    bool ok;
    memset(&u, 0, sizeof u);
    ok = gkdi_update_start(&u, field, &start);
    if (ok) {
        gkdi_run(parallel, user, u.count, 4096, gkdi_locate, &u);
        gkdi_sort(&u, start);
        for (k = 0; k < u.outcome_count; ++k) { /* lookahead trees grow while memory allows */
            const gkdi_cell *c = &field->cells[u.outcomes[k].cell];
            uint32_t n = gkdi_look_room(desc, c->look_count), more = n > c->look_capacity ? n - c->look_capacity : 0;
            u.outcomes[k].grows = bytes + more * sizeof *c->look <= desc->max_bytes;
            bytes += u.outcomes[k].grows ? more * sizeof *c->look : 0;
        }
        allowed = gkdi_cells_allowed(field, bytes);
        for (k = 0; k < u.outcome_count; ++k) { /* each cell's share of them */
            double share = (double)(u.outcomes[k].end - u.outcomes[k].first) / (double)u.count;
            u.outcomes[k].room = (uint32_t)fmin((double)allowed * share, 1e6);
        }
        gkdi_run(parallel, user, u.outcome_count, 4, gkdi_update_cells, &u);
        for (i = 0; i < field->node_count; ++i)
            if (field->nodes[i].link & GKD_LEAF)
                start[field->nodes[i].link & ~GKD_LEAF] = i;
        gkdi_update_commit(&u, start);
        field->stats.updates++;
    } else
        field->stats.lost += field->pending_count;
    gkdi_release(desc, u.cell_of);
    gkdi_release(desc, u.outcomes);
    gkdi_release(desc, start);
    field->pending_count = 0;
    field->stats.bytes = gkdi_field_bytes(field);
    return field->stats.lost == lost ? GKD_OK : GKD_OUT_OF_MEMORY;
}

/* ---- >>streams ---------------------------------------------------------------------------------------------- */

typedef struct gkdi_samples {
    struct gkdi_samples *next;
    uint32_t count, capacity;
    gkd_training_sample samples[1];
} gkdi_samples;

struct gkd_stream {
    gkd_desc desc;
    gkdi_samples *first, *current;
    uint64_t size, lost, lost_told;
};

GKD_API gkd_result gkd_stream_create(const gkd_field *field, gkd_stream **stream)
{
    *stream = (gkd_stream *)gkdi_allocate(&field->desc, 1, sizeof(gkd_stream));
    if (!*stream)
        return GKD_OUT_OF_MEMORY;
    (*stream)->desc = field->desc;
    return GKD_OK;
}

GKD_API void gkd_stream_destroy(gkd_stream *stream)
{
    gkdi_samples *chunk, *next;
    if (!stream)
        return;
    for (chunk = stream->first; chunk; chunk = next) {
        next = chunk->next;
        gkdi_release(&stream->desc, chunk);
    }
    {
        gkd_desc desc = stream->desc;
        gkdi_release(&desc, stream);
    }
}

GKD_API void gkd_stream_clear(gkd_stream *stream)
{
    gkdi_samples *chunk;
    for (chunk = stream->first; chunk; chunk = chunk->next)
        chunk->count = 0;
    stream->current = stream->first;
    stream->size = 0;
    stream->lost = stream->lost_told = 0;
}

GKD_API uint64_t gkd_stream_size(const gkd_stream *stream) { return stream->size; }

/* Room for one more sample at least; NULL = out of memory. Chunks: 256 samples, doubling up to 16384. */
static gkdi_samples *gkdi_stream_room(gkd_stream *stream)
{
    gkdi_samples *chunk = stream->current, *fresh;
    uint32_t capacity = 256;
    if (chunk && chunk->count < chunk->capacity)
        return chunk;
    if (chunk && chunk->next)
        return stream->current = chunk->next; /* from before clear */
    if (chunk)
        capacity = chunk->capacity < 16384 ? chunk->capacity * 2 : 16384;
    fresh = (gkdi_samples *)stream->desc.allocate(stream->desc.user,
                                                  sizeof(gkdi_samples) + capacity * sizeof(gkd_training_sample));
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

GKD_API gkd_result gkd_record(gkd_stream *stream, const gkd_training_sample *samples, uint32_t count)
{
    while (count) {
        gkdi_samples *chunk = gkdi_stream_room(stream);
        uint32_t n;
        if (!chunk) {
            stream->lost += count;
            return GKD_OUT_OF_MEMORY;
        }
        n = chunk->capacity - chunk->count;
        n = n < count ? n : count;
        memcpy(chunk->samples + chunk->count, samples, n * sizeof *samples);
        chunk->count += n;
        stream->size += n;
        samples += n;
        count -= n;
    }
    return GKD_OK;
}

/* ---- >>accumulate ------------------------------------------------------------------------------------------- */

/* Room for `count` more samples that wait, up to update_samples. */
static bool gkdi_pending_room(gkd_field *field, uint64_t count)
{
    uint64_t need = field->pending_count + count, n = field->pending_capacity ? field->pending_capacity : 1024;
    gkd_training_sample *pending;
    need = need < field->desc.update_samples ? need : field->desc.update_samples;
    if (need <= field->pending_capacity)
        return true;
    while (n < need)
        n *= 2;
    n = n < field->desc.update_samples ? n : field->desc.update_samples;
    pending = (gkd_training_sample *)field->desc.allocate(field->desc.user, (size_t)n * sizeof *pending);
    if (!pending)
        return false;
    if (field->pending_count)
        memcpy(pending, field->pending, field->pending_count * sizeof *pending);
    gkdi_release(&field->desc, field->pending);
    field->pending = pending;
    field->pending_capacity = (uint32_t)n;
    return true;
}

/* Add samples to those that wait; an update wherever enough have come. */
static gkd_result gkdi_take(gkd_field *field, const gkd_training_sample *samples, uint32_t count,
                            gkd_parallel_fn parallel, void *user)
{
    gkd_result result = GKD_OK;
    while (count) {
        uint32_t n;
        if (!gkdi_pending_room(field, count)) {
            field->stats.lost += count;
            return GKD_OUT_OF_MEMORY;
        }
        n = field->pending_capacity - field->pending_count;
        n = n < count ? n : count;
        memcpy(field->pending + field->pending_count, samples, n * sizeof *samples);
        field->pending_count += n;
        samples += n;
        count -= n;
        if (field->pending_count == field->desc.update_samples && gkdi_do_update(field, parallel, user))
            result = GKD_OUT_OF_MEMORY;
    }
    return result;
}

GKD_API gkd_result gkd_accumulate(gkd_field *field, gkd_stream *const *streams, uint32_t count,
                                  gkd_parallel_fn parallel, void *user)
{
    gkd_result result = GKD_OK;
    uint64_t all = 0;
    uint32_t i;
    for (i = 0; i < count; ++i)
        all += streams[i]->size;
    gkdi_pending_room(field, all); /* at once; where that fails, a chunk may still fit */
    for (i = 0; i < count; ++i) {
        gkdi_samples *chunk;
        field->stats.lost += streams[i]->lost - streams[i]->lost_told;
        streams[i]->lost_told = streams[i]->lost;
        for (chunk = streams[i]->first; chunk; chunk = chunk->next)
            if (gkdi_take(field, chunk->samples, chunk->count, parallel, user))
                result = GKD_OUT_OF_MEMORY;
    }
    return result;
}

/* ---- >>refine ----------------------------------------------------------------------------------------------- */

static gkd_node *gkdi_block_nodes(gkdi_block *b) { return (gkd_node *)(void *)((char *)b + b->nodes_at); }
static gkd_cell *gkdi_block_cells(gkdi_block *b) { return (gkd_cell *)(void *)((char *)b + b->cells_at); }
static gkd_lobe *gkdi_block_lobes(gkdi_block *b) { return (gkd_lobe *)(void *)((char *)b + b->lobes_at); }

/* Offsets and size from the counts. */
static void gkdi_block_layout(gkdi_block *b)
{
    uint64_t at = (sizeof *b + 63) & ~(uint64_t)63;
    b->nodes_at = at;
    at = (at + b->nodes * sizeof(gkd_node) + 63) & ~(uint64_t)63;
    b->cells_at = at;
    at = (at + b->cells * sizeof(gkd_cell) + 63) & ~(uint64_t)63;
    b->lobes_at = at;
    b->size = at + b->lobes * sizeof(gkd_lobe);
}

GKD_API gkd_view gkd_get_view(const gkd_field *field)
{
    gkdi_block *b = field->block;
    gkd_view view;
    memset(&view, 0, sizeof view);
    view.nodes = gkdi_block_nodes(b);
    view.cells = gkdi_block_cells(b);
    view.lobes = gkdi_block_lobes(b);
    memcpy(view.bounds_min, b->bounds_min, sizeof view.bounds_min);
    memcpy(view.bounds_max, b->bounds_max, sizeof view.bounds_max);
    view.uniform = b->uniform;
    view.cell_count = b->cells;
    view.simd = (uint32_t)field->desc.simd;
    return view;
}

typedef struct gkdi_publish {
    gkd_field *field;
    gkdi_block *block;
} gkdi_publish;

static void gkdi_publish_cells(void *context, uint32_t begin, uint32_t end)
{
    const gkdi_publish *p = (const gkdi_publish *)context;
    uint32_t i;
    for (i = begin; i < end; ++i) {
        const gkdi_cell *c = &p->field->cells[i];
        gkd_cell *out = &gkdi_block_cells(p->block)[i];
        out->alpha = c->gate.verdict == GKD_GATE_CLOSED ? 1.0f : c->gate.alpha;
        out->reflected = c->gate.reflected;
        out->gate = c->gate.verdict;
        if (out->count) {
            gkdi_model model;
            gkdi_model_unpack(&model, c->model);
            memcpy(out->pivot, model.pivot, sizeof out->pivot);
            gkdi_model_lobes(&model, &p->field->fit, gkdi_block_lobes(p->block) + out->lobes);
        } else
            out->alpha = 1.0f;
    }
}

/* A sampling part of what building knows; NULL = out of memory. */
static gkdi_block *gkdi_block_make(gkd_field *field, gkd_parallel_fn parallel, void *user)
{
    gkdi_block shape;
    gkdi_publish p;
    uint32_t i, lobes = 0;
    memset(&shape, 0, sizeof shape);
    for (i = 0; i < field->cell_count; ++i)
        lobes += gkdi_cell_lobes(&field->cells[i]);
    shape.nodes = field->node_count;
    shape.cells = field->cell_count;
    shape.lobes = lobes;
    shape.uniform = field->desc.uniform;
    memcpy(shape.bounds_min, field->desc.bounds_min, sizeof shape.bounds_min);
    memcpy(shape.bounds_max, field->desc.bounds_max, sizeof shape.bounds_max);
    gkdi_block_layout(&shape);
    p.field = field;
    p.block = (gkdi_block *)gkdi_allocate(&field->desc, shape.size, 1);
    if (!p.block)
        return NULL;
    *p.block = shape;
    memcpy(gkdi_block_nodes(p.block), field->nodes, field->node_count * sizeof(gkd_node));
    for (lobes = i = 0; i < field->cell_count; ++i) {
        gkd_cell *c = &gkdi_block_cells(p.block)[i];
        c->lobes = lobes;
        c->count = gkdi_cell_lobes(&field->cells[i]);
        lobes += c->count;
    }
    gkdi_run(parallel, user, field->cell_count, 64, gkdi_publish_cells, &p);
    return p.block;
}

/* Counters that follow from the cells. */
static void gkdi_count_cells(gkd_field *field)
{
    gkd_stats *s = &field->stats;
    uint32_t i;
    s->open_cells = s->closed_cells = s->unjudged_cells = 0;
    s->lookahead = 0;
    s->levels = 0;
    field->guiding = 0;
    s->cells = field->block->cells;
    s->lobes = field->block->lobes;
    for (i = 0; i < field->cell_count; ++i) {
        const gkdi_cell *c = &field->cells[i];
        s->open_cells += c->gate.verdict == GKD_GATE_OPEN;
        s->closed_cells += c->gate.verdict == GKD_GATE_CLOSED;
        s->unjudged_cells += c->gate.verdict == GKD_GATE_UNJUDGED;
        s->lookahead += c->look_count - 1;
        s->levels = c->level > s->levels ? c->level : s->levels;
    }
    for (i = 0; i < field->block->cells; ++i)
        field->guiding += gkdi_block_cells(field->block)[i].alpha < 1;
    s->bytes = gkdi_field_bytes(field);
}

/* The gate's verdicts on all cells. Of the gate's sums so much is kept that half of all samples count. */
static void gkdi_judge_cells(gkd_field *field, const gkd_pass *pass)
{
    bool pixels = pass && pass->pixel_estimate, changed = field->stats.passes > 0 && pixels != (field->pixels != 0);
    double samples = 0, closed = 0, alpha = 0, fade;
    uint32_t i;
    for (i = 0; i < field->cell_count; ++i)
        samples += field->cells[i].gate.fresh;
    field->all_samples += samples;
    field->held_samples += samples;
    fade = field->held_samples > 0 ? fmin(0.5 * field->all_samples / field->held_samples, 1) : 1;
    field->held_samples *= fade;
    for (i = 0; i < field->cell_count; ++i) {
        gkdi_gate *s = &field->cells[i].gate;
        if (s->fresh > 0)
            gkdi_judge(&field->desc, pixels, changed, fade, s, &field->stats);
        closed += s->verdict == GKD_GATE_CLOSED ? s->fresh : 0;
        alpha += s->verdict == GKD_GATE_CLOSED ? s->fresh : s->fresh * (double)s->alpha;
        s->rebuilds += s->fresh > 0 && gkdi_cell_lobes(&field->cells[i]) > 0;
        s->fresh = s->flow = 0;
        s->hits = 0;
    }
    field->pixels = pixels;
    if (samples > 0) {
        field->stats.closed_share = (float)(closed / samples);
        field->stats.mean_alpha = (float)(alpha / samples);
    }
}

GKD_API gkd_result gkd_refine(gkd_field *field, const gkd_pass *pass, gkd_parallel_fn parallel, void *user)
{
    gkd_result result = field->pending_count ? gkdi_do_update(field, parallel, user) : GKD_OK;
    gkdi_block *block;
    uint32_t i;
    gkdi_judge_cells(field, pass);
    block = gkdi_block_make(field, parallel, user);
    if (!block)
        return GKD_OUT_OF_MEMORY;
    gkdi_release(&field->desc, field->block);
    field->block = block;
    for (i = 0; pass && pass->on_split && i < field->split_count; ++i)
        pass->on_split(pass->on_split_user, field->splits[i].parent, field->splits[i].parent, field->splits[i].child);
    field->split_count = 0;
    field->stats.passes++;
    gkdi_count_cells(field);
    return result;
}

GKD_API float gkd_record_fraction(const gkd_field *field)
{
    float open = 1 - field->stats.closed_share;
    return field->stats.passes == 0 || open > 0.5f ? 1.0f : open + (1 - open) / 64;
}

GKD_API bool gkd_all_closed(const gkd_field *field) { return field->guiding == 0; }

GKD_API void gkd_get_stats(const gkd_field *field, gkd_stats *stats) { *stats = field->stats; }

/* ---- >>life ------------------------------------------------------------------------------------------------- */

GKD_API const char *gkd_result_string(gkd_result result)
{
#define GKD_RESULT_TEXT(name, text) text,
    static const char *const texts[] = {GKD_RESULTS(GKD_RESULT_TEXT) ""};
#undef GKD_RESULT_TEXT
    return (unsigned)result < (unsigned)GKD_RESULT_COUNT ? texts[result] : "unknown result";
}

/* The best level of this machine, or the pinned one; GKD_SIMD_AUTO where that is not available. */
static gkd_simd gkdi_simd(gkd_simd wanted)
{
#if GKDI_X86
    bool avx2, avx512;
    __builtin_cpu_init();
    avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
             __builtin_cpu_supports("avx512vl");
    if (wanted == GKD_SIMD_AUTO)
        return avx512 ? GKD_SIMD_AVX512 : avx2 ? GKD_SIMD_AVX2 : GKD_SIMD_SCALAR;
    if ((wanted == GKD_SIMD_AVX2 && !avx2) || (wanted == GKD_SIMD_AVX512 && !avx512) || wanted == GKD_SIMD_NEON)
        return GKD_SIMD_AUTO;
    return wanted;
#elif GKDI_NEON
    if (wanted == GKD_SIMD_AUTO)
        return GKD_SIMD_NEON;
    return wanted == GKD_SIMD_NEON || wanted == GKD_SIMD_SCALAR ? wanted : GKD_SIMD_AUTO;
#else
    return wanted == GKD_SIMD_AUTO || wanted == GKD_SIMD_SCALAR ? GKD_SIMD_SCALAR : GKD_SIMD_AUTO;
#endif
}

static void gkdi_default_u32(uint32_t *x, uint32_t value) { *x = *x ? *x : value; }
static void gkdi_default_float(float *x, float value) { *x = *x != 0 ? *x : value; }
static bool gkdi_within(double x, double low, double high) { return x >= low && x <= high; }
/* A float that is set to a limit is within, whichever way the limit is rounded. */
static bool gkdi_within_float(float x, float low, float high) { return x >= low && x <= high; }

static bool gkdi_bounds_ok(const gkd_desc *d)
{
    int i;
    for (i = 0; i < 3; ++i) {
        double e = (double)d->bounds_max[i] - (double)d->bounds_min[i];
        if (!(e >= 0) || !(e < 1e30) || !(fabsf(d->bounds_min[i]) < 1e30f))
            return false;
    }
    return true;
}

static bool gkdi_ranges_ok(const gkd_desc *d)
{
    return gkdi_within(d->split_samples, 64, 1e9) && gkdi_within(d->lookahead, 1, 7) &&
           gkdi_within(d->min_samples, 16, 1e9) && gkdi_within_float(d->radiance_step, 0.001f, 100) &&
           gkdi_within_float(d->direction_step, 0.001f, 3.1f) && gkdi_within_float(d->confidence, 1e-12f, 0.4f) &&
           gkdi_within_float(d->keep_signatures, 0, 1) && gkdi_within(d->max_levels, 1, 60) &&
           gkdi_within(d->max_lobes, 1, GKD_MAX_LOBES) && gkdi_within(d->update_samples, 1024, 1 << 26) &&
           d->max_bytes >= (uint64_t)1 << 20 && gkdi_within_float(d->alpha, 0.05f, 1) &&
           gkdi_within_float(d->uniform, 1e-4f, 1) && gkdi_within_float(d->gate_margin, 0.001f, 10) &&
           gkdi_within_float(d->gate_gain, 0.0001f, 1000) && gkdi_within(d->gate_probe, 1, 1000);
}

GKD_API gkd_result gkd_resolve(const gkd_desc *desc, gkd_desc *resolved)
{
    gkd_desc d = *desc;
    if (!d.allocate != !d.release)
        return GKD_BAD_ALLOCATOR;
    if (!d.allocate) {
        d.allocate = gkdi_default_allocate;
        d.release = gkdi_default_release;
    }
    d.split = d.split ? d.split : GKD_SPLIT_SIGNATURE;
    gkdi_default_u32(&d.split_samples, 4000);
    gkdi_default_u32(&d.lookahead, 6);
    gkdi_default_u32(&d.min_samples, 1000);
    gkdi_default_float(&d.radiance_step, 0.05f);
    gkdi_default_float(&d.direction_step, 0.05235988f);
    gkdi_default_float(&d.confidence, 1e-4f);
    gkdi_default_u32(&d.max_levels, 40);
    gkdi_default_u32(&d.max_lobes, GKD_MAX_LOBES);
    gkdi_default_u32(&d.update_samples, 1u << 18);
    d.max_bytes = d.max_bytes ? d.max_bytes : (uint64_t)1 << 30;
    d.alpha_mode = d.alpha_mode ? d.alpha_mode : GKD_ALPHA_GRID;
    gkdi_default_float(&d.alpha, 0.5f);
    gkdi_default_float(&d.uniform, 0.01f);
    gkdi_default_float(&d.gate_margin, 0.05f);
    gkdi_default_float(&d.gate_gain, 0.25f);
    gkdi_default_u32(&d.gate_probe, 1);
    if ((unsigned)d.split > GKD_SPLIT_COUNT || (unsigned)d.alpha_mode > GKD_ALPHA_GRID ||
        (unsigned)d.simd > GKD_SIMD_NEON)
        return GKD_BAD_OPTION;
    if (!gkdi_bounds_ok(&d))
        return GKD_BAD_BOUNDS;
    if (!gkdi_ranges_ok(&d))
        return GKD_BAD_RANGE;
    d.simd = gkdi_simd(d.simd);
    if (d.simd == GKD_SIMD_AUTO)
        return GKD_BAD_OPTION;
    *resolved = d;
    return GKD_OK;
}

GKD_API void gkd_destroy(gkd_field *field)
{
    gkd_desc desc;
    uint32_t i;
    if (!field)
        return;
    desc = field->desc;
    for (i = 0; field->cells && i < field->cell_count; ++i)
        gkdi_cell_free(&desc, &field->cells[i]);
    gkdi_release(&desc, field->cells);
    gkdi_release(&desc, field->nodes);
    gkdi_release(&desc, field->splits);
    gkdi_release(&desc, field->pending);
    gkdi_release(&desc, field->block);
    gkdi_release(&desc, field);
}

/* What follows from the descriptor. */
static void gkdi_field_options(gkd_field *field)
{
    const gkd_desc *d = &field->desc;
    gkdi_split_tests_init(&field->tests, (double)d->radiance_step, (double)d->direction_step, (double)d->confidence,
                          (double)d->confidence, (double)d->min_samples, d->published_tests);
    field->fit = gkdi_fit_defaults();
    field->fit.most = d->max_lobes;
    field->fit.simd = d->simd == GKD_SIMD_AVX2 || d->simd == GKD_SIMD_AVX512 ? GKDI_AVX2 : GKDI_BASE;
}

GKD_API gkd_result gkd_create(const gkd_desc *desc, gkd_field **field)
{
    gkd_desc d;
    gkd_field *f;
    gkd_result result = gkd_resolve(desc, &d);
    *field = NULL;
    if (result)
        return result;
    f = (gkd_field *)gkdi_allocate(&d, 1, sizeof *f);
    if (!f)
        return GKD_OUT_OF_MEMORY;
    f->desc = d;
    f->cell_capacity = 1;
    f->node_capacity = 2;
    f->cells = (gkdi_cell *)gkdi_allocate(&d, 1, sizeof *f->cells);
    f->nodes = (gkd_node *)gkdi_allocate(&d, 2, sizeof *f->nodes);
    if (!f->cells || !f->nodes || !gkdi_look_resize(&d, &f->cells[0], 1)) {
        gkd_destroy(f);
        return GKD_OUT_OF_MEMORY;
    }
    f->cell_count = f->node_count = 1;
    f->nodes[0].link = GKD_LEAF;
    f->cells[0].look_count = 1;
    f->cells[0].gate.alpha = d.alpha;
    gkdi_field_options(f);
    f->block = gkdi_block_make(f, NULL, NULL);
    if (!f->block) {
        gkd_destroy(f);
        return GKD_OUT_OF_MEMORY;
    }
    gkdi_count_cells(f);
    *field = f;
    return GKD_OK;
}

GKD_API const gkd_desc *gkd_get_desc(const gkd_field *field) { return &field->desc; }
GKD_API uint32_t gkd_cell_count(const gkd_field *field) { return field->block->cells; }

/* ---- >>batches ---------------------------------------------------------------------------------------------- */

/* What a handle is to be made of. */
typedef struct gkdi_view_from {
    gkd_handle *handle;
    const gkd_lobe *lobes;
    uint32_t count;
    const float *pivot, *position, *normal;
} gkdi_view_from;

static uint32_t gkdi_at(const uint32_t *index, uint32_t i) { return index ? index[i] : i; }
static const float *gkdi_row(const float *base, size_t stride, uint32_t row)
{
    return (const float *)(const void *)((const char *)base + stride * row);
}
static float *gkdi_row_out(float *base, size_t stride, uint32_t row)
{
    return (float *)(void *)((char *)base + stride * row);
}

/* ---- eight floats: AVX2, NEON (two halves) */

#if GKDI_X86
#define GKDI_WIDE __attribute__((target("avx2,fma")))
#define GKDI_OP __attribute__((target("avx2,fma"), always_inline)) static inline
typedef __m256 gkdi_f;
typedef __m256 gkdi_mask;
GKDI_OP gkdi_f gkdi_v_load(const float *p) { return _mm256_loadu_ps(p); }
GKDI_OP void gkdi_v_store(float *p, gkdi_f v) { _mm256_storeu_ps(p, v); }
GKDI_OP gkdi_f gkdi_v_all(float a) { return _mm256_set1_ps(a); }
GKDI_OP gkdi_f gkdi_v_add(gkdi_f a, gkdi_f b) { return _mm256_add_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_sub(gkdi_f a, gkdi_f b) { return _mm256_sub_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_mul(gkdi_f a, gkdi_f b) { return _mm256_mul_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_div(gkdi_f a, gkdi_f b) { return _mm256_div_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_madd(gkdi_f a, gkdi_f b, gkdi_f c) { return _mm256_fmadd_ps(a, b, c); }
GKDI_OP gkdi_f gkdi_v_nmadd(gkdi_f a, gkdi_f b, gkdi_f c) { return _mm256_fnmadd_ps(a, b, c); }
GKDI_OP gkdi_f gkdi_v_min(gkdi_f a, gkdi_f b) { return _mm256_min_ps(a, b); } /* b where a is NaN */
GKDI_OP gkdi_f gkdi_v_max(gkdi_f a, gkdi_f b) { return _mm256_max_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_sqrt(gkdi_f v) { return _mm256_sqrt_ps(v); }
GKDI_OP gkdi_mask gkdi_v_less(gkdi_f a, gkdi_f b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
GKDI_OP gkdi_mask gkdi_v_both(gkdi_mask a, gkdi_mask b) { return _mm256_and_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_where(gkdi_mask a, gkdi_f b) { return _mm256_and_ps(a, b); }
GKDI_OP gkdi_f gkdi_v_pick(gkdi_mask m, gkdi_f a, gkdi_f b) { return _mm256_blendv_ps(b, a, m); }
GKDI_OP bool gkdi_v_any(gkdi_mask m) { return _mm256_movemask_ps(m) != 0; }
GKDI_OP gkdi_f gkdi_v_rsqrt(gkdi_f a) /* relative error 3e-7 */
{
    gkdi_f r = _mm256_rsqrt_ps(a), h = gkdi_v_mul(gkdi_v_mul(a, r), gkdi_v_all(0.5f));
    return gkdi_v_mul(r, gkdi_v_nmadd(h, r, gkdi_v_all(1.5f)));
}
/* a = 2^e (1 + out), sqrt(1/2) <= 1 + out < sqrt(2); returns e. */
GKDI_OP gkdi_f gkdi_v_split_exponent(gkdi_f a, gkdi_f *out)
{
    __m256i bits = _mm256_castps_si256(a), e;
    e = _mm256_srai_epi32(_mm256_sub_epi32(bits, _mm256_set1_epi32(0x3f3504f3)), 23);
    *out = _mm256_sub_ps(_mm256_castsi256_ps(_mm256_sub_epi32(bits, _mm256_slli_epi32(e, 23))), _mm256_set1_ps(1));
    return _mm256_cvtepi32_ps(e);
}
GKDI_OP float gkdi_v_sum(gkdi_f a)
{
    __m128 s = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
    s = _mm_add_ps(s, _mm_movehl_ps(s, s));
    return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}
/* Lane i: sum of lanes 0 .. i. */
GKDI_OP gkdi_f gkdi_v_prefix(gkdi_f a)
{
    a = _mm256_add_ps(a, _mm256_castsi256_ps(_mm256_slli_si256(_mm256_castps_si256(a), 4)));
    a = _mm256_add_ps(a, _mm256_castsi256_ps(_mm256_slli_si256(_mm256_castps_si256(a), 8)));
    return _mm256_add_ps(a, _mm256_permute_ps(_mm256_permute2f128_ps(a, a, 0x08), 0xff));
}
GKDI_OP uint32_t gkdi_v_count_at_most(gkdi_f v, float limit)
{
    return (uint32_t)__builtin_popcount(
        (uint32_t)_mm256_movemask_ps(_mm256_cmp_ps(v, _mm256_set1_ps(limit), _CMP_LE_OQ)));
}
/* 2^t, t already rounded to units of 1/8 by adding 1.5 * 2^20: from a table without the exponent that j/8 adds. */
GKDI_OP gkdi_f gkdi_v_power(gkdi_f s)
{
    const __m256 table = _mm256_castsi256_ps(_mm256_setr_epi32(0x3f800000, 0x3f7b95c2, 0x3f7837f0, 0x3f75fed7,
                                                               0x3f7504f3, 0x3f75672a, 0x3f7744fd, 0x3f7ac0c7));
    __m256i y = _mm256_castps_si256(_mm256_permutevar8x32_ps(table, _mm256_castps_si256(s)));
    return _mm256_castsi256_ps(_mm256_add_epi32(y, _mm256_slli_epi32(_mm256_castps_si256(s), 20)));
}
/* 2^t for t <= 0: 2^(j/8), quadratic between: relative error 3.5e-6. */
GKDI_OP gkdi_f gkdi_v_exp2(gkdi_f t)
{
    gkdi_f magic = gkdi_v_all(1572864.0f), s, f, p, y;
    t = gkdi_v_max(t, gkdi_v_all(-100));
    s = gkdi_v_add(t, magic);
    f = gkdi_v_sub(t, gkdi_v_sub(s, magic));
    y = gkdi_v_power(s);
    p = gkdi_v_madd(f, gkdi_v_all(0.240225888f), gkdi_v_all(0.693308884f));
    return gkdi_v_madd(gkdi_v_mul(f, y), p, y);
}
/* The same with a cubic: 1e-7. */
GKDI_OP gkdi_f gkdi_v_exp2_fine(gkdi_f t)
{
    gkdi_f magic = gkdi_v_all(1572864.0f), s, f, p, y;
    t = gkdi_v_max(t, gkdi_v_all(-100));
    s = gkdi_v_add(t, magic);
    f = gkdi_v_sub(t, gkdi_v_sub(s, magic));
    y = gkdi_v_power(s);
    p = gkdi_v_madd(f, gkdi_v_all(0.055496222f), gkdi_v_all(0.240257631f));
    p = gkdi_v_madd(f, p, gkdi_v_all(0.693147214f));
    return gkdi_v_madd(gkdi_v_mul(f, y), p, y);
}
/* Lanes from the n-th on. */
GKDI_OP gkdi_mask gkdi_v_lanes_from(uint32_t n)
{
    return _mm256_castsi256_ps(
        _mm256_cmpgt_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32((int32_t)n - 1)));
}
/* Four rows of four become columns, in both halves. */
GKDI_OP void gkdi_v_turn4(__m256 r[4])
{
    __m256 a = _mm256_unpacklo_ps(r[0], r[1]), b = _mm256_unpackhi_ps(r[0], r[1]);
    __m256 c = _mm256_unpacklo_ps(r[2], r[3]), d = _mm256_unpackhi_ps(r[2], r[3]);
    r[0] = _mm256_shuffle_ps(a, c, 0x44);
    r[1] = _mm256_shuffle_ps(a, c, 0xee);
    r[2] = _mm256_shuffle_ps(b, d, 0x44);
    r[3] = _mm256_shuffle_ps(b, d, 0xee);
}
#define GKDI_JOIN(p, q) _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p)), _mm_loadu_ps(q), 1)
#define GKDI_TWO(p, q)                                                                                                 \
    _mm_loadh_pi(_mm_loadl_pi(_mm_setzero_ps(), (const __m64 *)(const void *)(p)), (const __m64 *)(const void *)(q))
/* Eight lobes as columns x, y, z, kappa, weight, nearness; of fewer, the last one repeats with weight 0. */
GKDI_OP void gkdi_v_load_lobes(const gkd_lobe *lobes, uint32_t n, gkdi_f out[6])
{
    const gkd_lobe *l0 = lobes, *l1 = lobes + (n > 1 ? 1 : n - 1), *l2 = lobes + (n > 2 ? 2 : n - 1);
    const gkd_lobe *l3 = lobes + (n > 3 ? 3 : n - 1), *l4 = lobes + (n > 4 ? 4 : n - 1);
    const gkd_lobe *l5 = lobes + (n > 5 ? 5 : n - 1), *l6 = lobes + (n > 6 ? 6 : n - 1);
    const gkd_lobe *l7 = lobes + (n > 7 ? 7 : n - 1);
    __m256 a, b;
    out[0] = GKDI_JOIN(l0->mean, l4->mean);
    out[1] = GKDI_JOIN(l1->mean, l5->mean);
    out[2] = GKDI_JOIN(l2->mean, l6->mean);
    out[3] = GKDI_JOIN(l3->mean, l7->mean);
    gkdi_v_turn4(out);
    a = _mm256_insertf128_ps(_mm256_castps128_ps256(GKDI_TWO(&l0->weight, &l1->weight)),
                             GKDI_TWO(&l4->weight, &l5->weight), 1);
    b = _mm256_insertf128_ps(_mm256_castps128_ps256(GKDI_TWO(&l2->weight, &l3->weight)),
                             GKDI_TWO(&l6->weight, &l7->weight), 1);
    out[4] = _mm256_andnot_ps(gkdi_v_lanes_from(n), _mm256_shuffle_ps(a, b, 0x88));
    out[5] = _mm256_shuffle_ps(a, b, 0xdd);
}
/* Eight directions as columns (out[3]: scratch); reads nothing past the last. */
GKDI_OP void gkdi_v_load_directions(const float *p, size_t stride, gkdi_f out[4])
{
    const float *q = gkdi_row(p, stride, 4), *last = gkdi_row(p, stride, 7);
    out[0] = GKDI_JOIN(p, q);
    out[1] = GKDI_JOIN(gkdi_row(p, stride, 1), gkdi_row(q, stride, 1));
    out[2] = GKDI_JOIN(gkdi_row(p, stride, 2), gkdi_row(q, stride, 2));
    out[3] = _mm256_insertf128_ps(
        _mm256_castps128_ps256(_mm_loadu_ps(gkdi_row(p, stride, 3))),
        _mm_movelh_ps(_mm_loadl_pi(_mm_setzero_ps(), (const __m64 *)(const void *)last), _mm_load_ss(last + 2)), 1);
    gkdi_v_turn4(out);
}
GKDI_OP __m256d gkdi_v_wide(__m256 a, bool high)
{
    return _mm256_cvtps_pd(high ? _mm256_extractf128_ps(a, 1) : _mm256_castps256_ps128(a));
}
GKDI_OP __m128 gkdi_v_rises4(const gkdi_f d[3], const float *n, bool high)
{
    __m256d s = _mm256_mul_pd(gkdi_v_wide(d[0], high), _mm256_set1_pd((double)n[0]));
    s = _mm256_fmadd_pd(gkdi_v_wide(d[1], high), _mm256_set1_pd((double)n[1]), s);
    return _mm256_cvtpd_ps(_mm256_fmadd_pd(gkdi_v_wide(d[2], high), _mm256_set1_pd((double)n[2]), s));
}
/* Cosines with one normal, by doubles. */
GKDI_OP gkdi_f gkdi_v_rises(const gkdi_f d[3], const float *n)
{
    __m128 a = gkdi_v_rises4(d, n, false), b = gkdi_v_rises4(d, n, true);
    return _mm256_insertf128_ps(_mm256_castps128_ps256(a), b, 1);
}
#elif GKDI_NEON
#define GKDI_WIDE
#define GKDI_OP __attribute__((always_inline)) static inline
typedef struct gkdi_f {
    float32x4_t a, b;
} gkdi_f;
typedef struct gkdi_mask {
    uint32x4_t a, b;
} gkdi_mask;
/* Function name(x, ...) of type from op on halves. */
#define GKDI_HALVES1(type, name, op, t)                                                                                \
    GKDI_OP type name(t x)                                                                                             \
    {                                                                                                                  \
        type v;                                                                                                        \
        v.a = op(x.a);                                                                                                 \
        v.b = op(x.b);                                                                                                 \
        return v;                                                                                                      \
    }
#define GKDI_HALVES2(type, name, op, t)                                                                                \
    GKDI_OP type name(t x, t y)                                                                                        \
    {                                                                                                                  \
        type v;                                                                                                        \
        v.a = op(x.a, y.a);                                                                                            \
        v.b = op(x.b, y.b);                                                                                            \
        return v;                                                                                                      \
    }
#define GKDI_HALVES3(name, op, t)                                                                                      \
    GKDI_OP gkdi_f name(t x, gkdi_f y, gkdi_f z)                                                                       \
    {                                                                                                                  \
        gkdi_f v;                                                                                                      \
        v.a = op(x.a, y.a, z.a);                                                                                       \
        v.b = op(x.b, y.b, z.b);                                                                                       \
        return v;                                                                                                      \
    }
GKDI_OP gkdi_f gkdi_v_load(const float *p)
{
    gkdi_f v;
    v.a = vld1q_f32(p);
    v.b = vld1q_f32(p + 4);
    return v;
}
GKDI_OP void gkdi_v_store(float *p, gkdi_f v)
{
    vst1q_f32(p, v.a);
    vst1q_f32(p + 4, v.b);
}
GKDI_OP gkdi_f gkdi_v_all(float a)
{
    gkdi_f v;
    v.a = v.b = vdupq_n_f32(a);
    return v;
}
GKDI_HALVES2(gkdi_f, gkdi_v_add, vaddq_f32, gkdi_f)
GKDI_HALVES2(gkdi_f, gkdi_v_sub, vsubq_f32, gkdi_f)
GKDI_HALVES2(gkdi_f, gkdi_v_mul, vmulq_f32, gkdi_f)
GKDI_HALVES2(gkdi_f, gkdi_v_div, vdivq_f32, gkdi_f)
GKDI_HALVES2(gkdi_f, gkdi_v_min, vminnmq_f32, gkdi_f) /* y where x is NaN */
GKDI_HALVES2(gkdi_f, gkdi_v_max, vmaxnmq_f32, gkdi_f)
GKDI_HALVES2(gkdi_mask, gkdi_v_less, vcltq_f32, gkdi_f)
GKDI_HALVES2(gkdi_mask, gkdi_v_both, vandq_u32, gkdi_mask)
GKDI_HALVES1(gkdi_f, gkdi_v_sqrt, vsqrtq_f32, gkdi_f)
#define GKDI_MADD4(x, y, z) vfmaq_f32(z, x, y)
#define GKDI_NMADD4(x, y, z) vfmsq_f32(z, x, y)
GKDI_HALVES3(gkdi_v_madd, GKDI_MADD4, gkdi_f)
GKDI_HALVES3(gkdi_v_nmadd, GKDI_NMADD4, gkdi_f)
GKDI_HALVES3(gkdi_v_pick, vbslq_f32, gkdi_mask)
GKDI_OP gkdi_f gkdi_v_where(gkdi_mask m, gkdi_f x) { return gkdi_v_pick(m, x, gkdi_v_all(0)); }
GKDI_OP bool gkdi_v_any(gkdi_mask m) { return vmaxvq_u32(vorrq_u32(m.a, m.b)) != 0; }
GKDI_OP gkdi_f gkdi_v_rsqrt(gkdi_f x) { return gkdi_v_div(gkdi_v_all(1), gkdi_v_sqrt(x)); }
GKDI_OP float32x4_t gkdi_v_split_exponent4(float32x4_t x, float32x4_t *out)
{
    int32x4_t bits = vreinterpretq_s32_f32(x), e = vshrq_n_s32(vsubq_s32(bits, vdupq_n_s32(0x3f3504f3)), 23);
    *out = vsubq_f32(vreinterpretq_f32_s32(vsubq_s32(bits, vshlq_n_s32(e, 23))), vdupq_n_f32(1));
    return vcvtq_f32_s32(e);
}
/* x = 2^e (1 + out), sqrt(1/2) <= 1 + out < sqrt(2); returns e. */
GKDI_OP gkdi_f gkdi_v_split_exponent(gkdi_f x, gkdi_f *out)
{
    gkdi_f e;
    e.a = gkdi_v_split_exponent4(x.a, &out->a);
    e.b = gkdi_v_split_exponent4(x.b, &out->b);
    return e;
}
GKDI_OP float gkdi_v_sum(gkdi_f v) { return vaddvq_f32(vaddq_f32(v.a, v.b)); }
GKDI_OP float32x4_t gkdi_v_prefix4(float32x4_t a, float before)
{
    float32x4_t zero = vdupq_n_f32(0);
    a = vaddq_f32(a, vextq_f32(zero, a, 3));
    a = vaddq_f32(a, vextq_f32(zero, a, 2));
    return vaddq_f32(a, vdupq_n_f32(before));
}
/* Lane i: sum of lanes 0 .. i. */
GKDI_OP gkdi_f gkdi_v_prefix(gkdi_f v)
{
    v.a = gkdi_v_prefix4(v.a, 0);
    v.b = gkdi_v_prefix4(v.b, vgetq_lane_f32(v.a, 3));
    return v;
}
#define GKDI_AT_MOST4(x) vshrq_n_u32(vcleq_f32(x, l), 31)
GKDI_OP uint32_t gkdi_v_count_at_most(gkdi_f v, float limit)
{
    float32x4_t l = vdupq_n_f32(limit);
    return vaddvq_u32(vaddq_u32(GKDI_AT_MOST4(v.a), GKDI_AT_MOST4(v.b)));
}
/* Lanes from the n-th on. */
GKDI_OP gkdi_mask gkdi_v_lanes_from(uint32_t n)
{
    static const float lanes[8] = {0, 1, 2, 3, 4, 5, 6, 7};
    return gkdi_v_less(gkdi_v_all((float)n - 0.5f), gkdi_v_load(lanes));
}
/* As gkd_exp2. */
GKDI_OP float32x4_t gkdi_v_exp2_4(float32x4_t t)
{
    int32x4_t n;
    float32x4_t f, p;
    t = vmaxnmq_f32(t, vdupq_n_f32(-100));
    n = vcvtnq_s32_f32(t);
    f = vsubq_f32(t, vcvtq_f32_s32(n));
    p = vfmaq_f32(vdupq_n_f32(9.67151396e-3f), f, vdupq_n_f32(1.32647291e-3f));
    p = vfmaq_f32(vdupq_n_f32(5.55073375e-2f), f, p);
    p = vfmaq_f32(vdupq_n_f32(2.40222421e-1f), f, p);
    p = vfmaq_f32(vdupq_n_f32(6.93146978e-1f), f, p);
    p = vfmaq_f32(vdupq_n_f32(1), f, p);
    return vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(p), vshlq_n_s32(n, 23)));
}
GKDI_HALVES1(gkdi_f, gkdi_v_exp2, gkdi_v_exp2_4, gkdi_f)
GKDI_OP gkdi_f gkdi_v_exp2_fine(gkdi_f t) { return gkdi_v_exp2(t); }
/* Eight lobes as columns x, y, z, kappa, weight, nearness; of fewer, the last one repeats with weight 0. */
GKDI_OP void gkdi_v_load_lobes(const gkd_lobe *lobes, uint32_t n, gkdi_f out[6])
{
    float column[6][8];
    uint32_t i, k;
    for (i = 0; i < 8; ++i) {
        const gkd_lobe *p = lobes + (i < n ? i : n - 1);
        for (k = 0; k < 3; ++k)
            column[k][i] = p->mean[k];
        column[3][i] = p->kappa;
        column[4][i] = i < n ? p->weight : 0;
        column[5][i] = p->nearness;
    }
    for (k = 0; k < 6; ++k)
        out[k] = gkdi_v_load(column[k]);
}
/* Eight directions as columns. */
GKDI_OP void gkdi_v_load_directions(const float *p, size_t stride, gkdi_f out[4])
{
    float column[3][8];
    uint32_t i, k;
    for (i = 0; i < 8; ++i)
        for (k = 0; k < 3; ++k)
            column[k][i] = gkdi_row(p, stride, i)[k];
    for (k = 0; k < 3; ++k)
        out[k] = gkdi_v_load(column[k]);
}
GKDI_OP float32x4_t gkdi_v_rises4(float32x4_t x, float32x4_t y, float32x4_t z, const float *n)
{
    float64x2_t a = vmulq_n_f64(vcvt_f64_f32(vget_low_f32(x)), (double)n[0]);
    float64x2_t b = vmulq_n_f64(vcvt_high_f64_f32(x), (double)n[0]);
    a = vfmaq_n_f64(a, vcvt_f64_f32(vget_low_f32(y)), (double)n[1]);
    b = vfmaq_n_f64(b, vcvt_high_f64_f32(y), (double)n[1]);
    a = vfmaq_n_f64(a, vcvt_f64_f32(vget_low_f32(z)), (double)n[2]);
    b = vfmaq_n_f64(b, vcvt_high_f64_f32(z), (double)n[2]);
    return vcombine_f32(vcvt_f32_f64(a), vcvt_f32_f64(b));
}
/* Cosines with one normal, by doubles. */
GKDI_OP gkdi_f gkdi_v_rises(const gkdi_f d[3], const float *n)
{
    gkdi_f v;
    v.a = gkdi_v_rises4(d[0].a, d[1].a, d[2].a, n);
    v.b = gkdi_v_rises4(d[0].b, d[1].b, d[2].b, n);
    return v;
}
#endif

#if GKDI_X86 || GKDI_NEON
GKDI_OP gkdi_f gkdi_v_abs(gkdi_f a) { return gkdi_v_max(a, gkdi_v_sub(gkdi_v_all(0), a)); }
GKDI_OP gkdi_f gkdi_v_bound(gkdi_f a, float low, float high)
{
    return gkdi_v_min(gkdi_v_max(a, gkdi_v_all(low)), gkdi_v_all(high));
}
GKDI_OP gkdi_f gkdi_v_dot(gkdi_f ax, gkdi_f ay, gkdi_f az, gkdi_f bx, gkdi_f by, gkdi_f bz)
{
    return gkdi_v_madd(ax, bx, gkdi_v_madd(ay, by, gkdi_v_mul(az, bz)));
}

/* The sum over lobes for a direction, by lanes; lanes are lobes. Nothing below the surface. */
GKDI_OP gkdi_f gkdi_pdf_lanes(const gkd_handle *handle, const float d[3])
{
    gkdi_f x = gkdi_v_all(d[0]), y = gkdi_v_all(d[1]), z = gkdi_v_all(d[2]), sum = gkdi_v_all(0), lift;
    uint32_t i, blocks = (handle->count + 7) / 8;
    bool surface = handle->surface != 0;
    float c = surface ? gkd_dot(d, handle->normal) : 1;
    if (!(c > 0))
        return sum;
    lift = gkdi_v_all(-c);
    for (i = 0; i < blocks; ++i) {
        const gkd_lobe_block *b = &handle->block[i];
        gkdi_f dx = gkdi_v_sub(x, gkdi_v_load(b->x)), dy = gkdi_v_sub(y, gkdi_v_load(b->y)),
               dz = gkdi_v_sub(z, gkdi_v_load(b->z));
        gkdi_f t = gkdi_v_mul(gkdi_v_dot(dx, dy, dz, dx, dy, dz), gkdi_v_load(b->falloff)), p;
        t = gkdi_v_sub(gkdi_v_all(0), t);
        p = gkdi_v_exp2(t);
        if (surface)
            p = gkdi_v_add(p, gkdi_v_exp2(gkdi_v_madd(lift, gkdi_v_load(b->lift), t)));
        sum = gkdi_v_madd(p, gkdi_v_load(b->scale), sum);
    }
    return sum;
}

GKDI_OP float gkdi_pdf_inline(const gkd_handle *handle, const float d[3])
{
    float e = handle->uniform;
    return (1 - e) * gkdi_v_sum(gkdi_pdf_lanes(handle, d)) + e * (1 / (4 * GKD_PI));
}

GKDI_WIDE static float gkdi_pdf_wide(const gkd_handle *handle, const float *d) { return gkdi_pdf_inline(handle, d); }

GKDI_WIDE static void gkdi_pdf_batch_wide(uint32_t count, const uint32_t *index, const gkd_handle *handles,
                                          const float *directions, size_t stride, float *pdf)
{
    uint32_t i;
    for (i = 0; i < count; ++i) {
        uint32_t at = gkdi_at(index, i);
        pdf[at] = gkdi_pdf_inline(&handles[at], gkdi_row(directions, stride, at));
    }
}

/* Eight directions of one handle; lanes are directions. Above a surface, c: cosines with it, least: the same with 2 for
   those below. */
GKDI_OP gkdi_f gkdi_pdf_sum(const gkd_handle *handle, const gkdi_f d[3], gkdi_f c, gkdi_f least, bool surface)
{
    gkdi_f sum = gkdi_v_all(0);
    uint32_t k, l, end;
    for (k = 0; k < handle->count; k += 8) {
        const float *b = (const float *)(const void *)&handle->block[k / 8]; /* columns are 8 apart */
        end = handle->count - k < 8 ? handle->count - k : 8;
        for (l = 0; l < end; ++l, ++b) {
            gkdi_f x = gkdi_v_sub(d[0], gkdi_v_all(b[0])), y = gkdi_v_sub(d[1], gkdi_v_all(b[8])),
                   z = gkdi_v_sub(d[2], gkdi_v_all(b[16])), p;
            x = gkdi_v_mul(gkdi_v_dot(x, y, z, x, y, z), gkdi_v_all(-b[24]));
            p = gkdi_v_exp2(x);
            if (surface && gkdi_v_any(gkdi_v_less(gkdi_v_mul(least, gkdi_v_all(b[32])), gkdi_v_all(26))))
                p = gkdi_v_add(p, gkdi_v_exp2(gkdi_v_nmadd(c, gkdi_v_all(b[32]), x)));
            sum = gkdi_v_madd(p, gkdi_v_all(b[40]), sum);
        }
    }
    return sum;
}

/* One handle, count directions, a multiple of 8. */
GKDI_WIDE static void gkdi_pdf_same_wide(const gkd_handle *handle, uint32_t count, const float *directions,
                                         size_t stride, float *pdf)
{
    const float *n = handle->normal, e = handle->uniform;
    bool surface = handle->surface != 0;
    uint32_t i;
    for (i = 0; i < count; i += 8) {
        gkdi_f d[4], sum;
        gkdi_v_load_directions(gkdi_row(directions, stride, i), stride, d);
        if (surface) {
            gkdi_f c = gkdi_v_rises(d, n);
            gkdi_mask above = gkdi_v_less(gkdi_v_all(0), c);
            sum = gkdi_v_where(above, gkdi_pdf_sum(handle, d, c, gkdi_v_pick(above, c, gkdi_v_all(2)), true));
        } else
            sum = gkdi_pdf_sum(handle, d, d[0], d[0], false);
        gkdi_v_store(pdf + i, gkdi_v_madd(sum, gkdi_v_all(1 - e), gkdi_v_all(e * (1 / (4 * GKD_PI)))));
    }
}

#if GKDI_X86
#define GKDI_512 __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma")))
#define GKDI_512_OP __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma"), always_inline)) static inline

/* 2^t for t <= 0; minimax polynomial of degree 4 on [0, 1): relative error 2.6e-6. */
GKDI_512_OP __m512 gkdi_exp2_512(__m512 t)
{
    __m512 f, p;
    t = _mm512_maskz_max_ps(0xffff, t, _mm512_set1_ps(-100)); /* maskz: else gcc 12 warns of its own header */
    f = _mm512_reduce_ps(t, 1);                               /* t - floor(t) */
    p = _mm512_fmadd_ps(f, _mm512_set1_ps(0.0135341709f), _mm512_set1_ps(0.0520114722f));
    p = _mm512_fmadd_ps(f, p, _mm512_set1_ps(0.241442736f));
    p = _mm512_fmadd_ps(f, p, _mm512_set1_ps(0.693003843f));
    p = _mm512_fmadd_ps(f, p, _mm512_set1_ps(1.00000259f));
    return _mm512_maskz_scalef_ps(0xffff, p, t);
}

/* Sixteen directions as columns; packed ones (stride 12) by two permutations a column. */
GKDI_512_OP void gkdi_load_directions_512(const float *p, size_t stride, __m512 out[3])
{
    const __m512i lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    gkdi_f a[4], b[4];
    int k;
    if (stride == 12) {
        __m512 low = _mm512_loadu_ps(p), middle = _mm512_loadu_ps(p + 16), high = _mm512_loadu_ps(p + 32);
        for (k = 0; k < 3; ++k) {
            __m512i at = _mm512_add_epi32(_mm512_mullo_epi32(lanes, _mm512_set1_epi32(3)), _mm512_set1_epi32(k));
            __mmask16 last = _mm512_cmp_epi32_mask(at, _mm512_set1_epi32(32), _MM_CMPINT_NLT);
            __m512i then = _mm512_mask_sub_epi32(lanes, last, at, _mm512_set1_epi32(16));
            out[k] = _mm512_permutex2var_ps(_mm512_permutex2var_ps(low, at, middle), then, high);
        }
        return;
    }
    gkdi_v_load_directions(p, stride, a);
    gkdi_v_load_directions(gkdi_row(p, stride, 8), stride, b);
    for (k = 0; k < 3; ++k)
        out[k] = _mm512_insertf32x8(_mm512_castps256_ps512(a[k]), b[k], 1);
}

/* gkdi_v_rises. */
GKDI_512_OP __m512 gkdi_rises_512(const __m512 d[3], const float *n)
{
    __m256 half[2][3];
    int k;
    for (k = 0; k < 3; ++k) {
        half[0][k] = _mm512_maskz_extractf32x8_ps(0xff, d[k], 0); /* maskz: see gkdi_exp2_512 */
        half[1][k] = _mm512_maskz_extractf32x8_ps(0xff, d[k], 1);
    }
    return _mm512_insertf32x8(_mm512_castps256_ps512(gkdi_v_rises(half[0], n)), gkdi_v_rises(half[1], n), 1);
}

/* gkdi_pdf_sum. */
GKDI_512_OP __m512 gkdi_pdf_sum_512(const gkd_handle *handle, const __m512 d[3], __m512 c, __m512 least, bool surface)
{
    __m512 sum = _mm512_setzero_ps();
    uint32_t k, l, end;
    for (k = 0; k < handle->count; k += 8) {
        const float *b = (const float *)(const void *)&handle->block[k / 8];
        end = handle->count - k < 8 ? handle->count - k : 8;
        for (l = 0; l < end; ++l, ++b) {
            __m512 x = _mm512_sub_ps(d[0], _mm512_set1_ps(b[0])), y = _mm512_sub_ps(d[1], _mm512_set1_ps(b[8]));
            __m512 z = _mm512_sub_ps(d[2], _mm512_set1_ps(b[16])), lift, p;
            x = _mm512_fmadd_ps(x, x, _mm512_fmadd_ps(y, y, _mm512_mul_ps(z, z)));
            x = _mm512_fnmadd_ps(x, _mm512_set1_ps(b[24]), _mm512_setzero_ps());
            p = gkdi_exp2_512(x);
            if (surface) {
                lift = _mm512_set1_ps(b[32]);
                if (_mm512_cmp_ps_mask(_mm512_mul_ps(least, lift), _mm512_set1_ps(26), _CMP_LT_OQ))
                    p = _mm512_add_ps(p, gkdi_exp2_512(_mm512_fnmadd_ps(c, lift, x)));
            }
            sum = _mm512_fmadd_ps(p, _mm512_set1_ps(b[40]), sum);
        }
    }
    return sum;
}

/* gkdi_pdf_same_wide, a multiple of 16. */
GKDI_512 static void gkdi_pdf_same_512(const gkd_handle *handle, uint32_t count, const float *directions, size_t stride,
                                       float *pdf)
{
    const float e = handle->uniform;
    uint32_t i;
    for (i = 0; i < count; i += 16) {
        __m512 d[3], sum, c = _mm512_setzero_ps();
        __mmask16 above;
        gkdi_load_directions_512(gkdi_row(directions, stride, i), stride, d);
        if (handle->surface) {
            c = gkdi_rises_512(d, handle->normal);
            above = _mm512_cmp_ps_mask(c, _mm512_setzero_ps(), _CMP_GT_OQ);
            sum = gkdi_pdf_sum_512(handle, d, c, _mm512_mask_blend_ps(above, _mm512_set1_ps(2), c), true);
            sum = _mm512_maskz_mov_ps(above, sum);
        } else
            sum = gkdi_pdf_sum_512(handle, d, c, c, false);
        sum = _mm512_fmadd_ps(sum, _mm512_set1_ps(1 - e), _mm512_set1_ps(e * (1 / (4 * GKD_PI))));
        _mm512_storeu_ps(pdf + i, sum);
    }
}
#endif

/* gkd_one_minus_exp. */
GKDI_OP gkdi_f gkdi_one_minus_exp(gkdi_f x)
{
    gkdi_f one = gkdi_v_all(1), s = gkdi_v_nmadd(x, gkdi_v_all(1.0f / 6), one);
    s = gkdi_v_nmadd(gkdi_v_mul(x, gkdi_v_all(1.0f / 5)), s, one);
    s = gkdi_v_nmadd(gkdi_v_mul(x, gkdi_v_all(1.0f / 4)), s, one);
    s = gkdi_v_nmadd(gkdi_v_mul(x, gkdi_v_all(1.0f / 3)), s, one);
    s = gkdi_v_mul(x, gkdi_v_nmadd(gkdi_v_mul(x, gkdi_v_all(1.0f / 2)), s, one));
    return gkdi_v_pick(gkdi_v_less(x, gkdi_v_all(0.25f)), s,
                       gkdi_v_sub(one, gkdi_v_exp2_fine(gkdi_v_mul(x, gkdi_v_all(-GKD_LOG2E)))));
}

/* Orienting goes in steps over a group of handles, each short enough that the processor overlaps several handles. Until
   the last step a block holds kappa in falloff, the weight in upper. */
/* gkd_turn_lobe. */
GKDI_OP void gkdi_turn_lobes(gkd_lobe_block *b, const gkd_lobe *lobes, uint32_t count, const float offset[3])
{
    gkdi_f v[6], x, y, z, l2, r;
    gkdi_mask fine;
    gkdi_v_load_lobes(lobes, count, v);
    x = gkdi_v_madd(v[5], gkdi_v_all(offset[0]), v[0]);
    y = gkdi_v_madd(v[5], gkdi_v_all(offset[1]), v[1]);
    z = gkdi_v_madd(v[5], gkdi_v_all(offset[2]), v[2]);
    l2 = gkdi_v_dot(x, y, z, x, y, z);
    fine = gkdi_v_both(gkdi_v_less(gkdi_v_all(1e-6f), l2), gkdi_v_less(l2, gkdi_v_all(1e12f)));
    r = gkdi_v_rsqrt(gkdi_v_pick(fine, l2, gkdi_v_all(1)));
    gkdi_v_store(b->x, gkdi_v_pick(fine, gkdi_v_mul(x, r), v[0]));
    gkdi_v_store(b->y, gkdi_v_pick(fine, gkdi_v_mul(y, r), v[1]));
    gkdi_v_store(b->z, gkdi_v_pick(fine, gkdi_v_mul(z, r), v[2]));
    r = gkdi_v_mul(v[3], gkdi_v_bound(l2, 1e-3f, GKD_SHARPER));
    gkdi_v_store(b->falloff, gkdi_v_bound(r, GKD_MIN_KAPPA, GKD_MAX_KAPPA));
    gkdi_v_store(b->upper, gkdi_v_div(gkdi_v_max(v[4], gkdi_v_all(0)), gkdi_v_bound(l2, 0.25f, 4)));
}

/* gkd_weigh_lobe. */
GKDI_OP void gkdi_weigh_lobes(gkd_lobe_block *b, const float *normal, bool product)
{
    gkdi_f one = gkdi_v_all(1), zero = gkdi_v_all(0), k = gkdi_v_load(b->falloff), c, c2, m, s2, r, x, a, phi, q, tail,
           g;
    gkdi_f above, d;
    gkdi_mask up;
    c = gkdi_v_dot(gkdi_v_load(b->x), gkdi_v_load(b->y), gkdi_v_load(b->z), gkdi_v_all(normal[0]),
                   gkdi_v_all(normal[1]), gkdi_v_all(normal[2]));
    c2 = gkdi_v_min(gkdi_v_mul(c, c), one);
    q = gkdi_v_min(k, gkdi_v_all(1e4f));
    d = gkdi_v_madd(q, gkdi_v_madd(q, gkdi_v_all(0.2f), gkdi_v_all(0.5f)), one);
    /* m = c q d / a, s^2 = (1 - c^2) d / g + c^2 / tail by one division */
    a = gkdi_v_madd(gkdi_v_add(q, one), d, gkdi_v_all(2));
    g = gkdi_v_madd(gkdi_v_add(q, gkdi_v_all(0.78f)), d, gkdi_v_all(1.766f));
    tail = gkdi_v_madd(gkdi_v_mul(q, q), gkdi_v_all(0.24f), gkdi_v_all(2.546f));
    phi = gkdi_v_mul(g, tail);
    r = gkdi_v_div(one, gkdi_v_mul(phi, a));
    m = gkdi_v_mul(gkdi_v_mul(gkdi_v_mul(c, q), d), gkdi_v_mul(phi, r));
    s2 = gkdi_v_madd(gkdi_v_mul(gkdi_v_sub(one, c2), d), tail, gkdi_v_mul(c2, g));
    s2 = gkdi_v_mul(s2, gkdi_v_mul(a, r));
    r = gkdi_v_rsqrt(s2);
    x = gkdi_v_mul(m, r);
    a = gkdi_v_min(gkdi_v_abs(x), gkdi_v_all(8));
    phi = gkdi_v_mul(gkdi_v_all(0.39894228f),
                     gkdi_v_exp2_fine(gkdi_v_mul(gkdi_v_mul(a, a), gkdi_v_all(-0.5f * GKD_LOG2E))));
    q = gkdi_v_sqrt(gkdi_v_madd(a, a, gkdi_v_all(2 * GKD_PI)));
    d = gkdi_v_add(q, a); /* tail = phi pi / ((pi - 1) a + q), g = phi - a tail = 2 tail / (q + a) */
    g = gkdi_v_div(gkdi_v_mul(phi, gkdi_v_all(GKD_PI)), gkdi_v_mul(gkdi_v_madd(a, gkdi_v_all(GKD_PI - 1), q), d));
    tail = gkdi_v_mul(g, d);
    g = gkdi_v_add(g, g);
    up = gkdi_v_less(zero, x);
    above = gkdi_v_pick(up, gkdi_v_sub(one, tail), tail);
    g = gkdi_v_mul(gkdi_v_mul(s2, r), gkdi_v_add(gkdi_v_max(x, zero), g));
    if (product) {
        r = gkdi_v_div(above, g);
    } else {
        r = gkdi_v_max(gkdi_v_sub(zero, gkdi_v_mul(c, k)), zero);
        g = gkdi_v_min(gkdi_v_add(above, above), one);
    }
    gkdi_v_store(b->lift, gkdi_v_min(r, gkdi_v_madd(k, gkdi_v_all(2), gkdi_v_all(4))));
    gkdi_v_store(b->upper, gkdi_v_mul(gkdi_v_load(b->upper), g));
}

/* gkd_tilt_lobe. */
GKDI_OP void gkdi_tilt_lobes(gkd_lobe_block *b, const float *normal)
{
    gkdi_f n[3], m[3], k = gkdi_v_load(b->falloff), r = gkdi_v_load(b->lift), l2;
    gkdi_mask below;
    n[0] = gkdi_v_all(normal[0]);
    n[1] = gkdi_v_all(normal[1]);
    n[2] = gkdi_v_all(normal[2]);
    m[0] = gkdi_v_madd(gkdi_v_load(b->x), k, gkdi_v_mul(n[0], r));
    m[1] = gkdi_v_madd(gkdi_v_load(b->y), k, gkdi_v_mul(n[1], r));
    m[2] = gkdi_v_madd(gkdi_v_load(b->z), k, gkdi_v_mul(n[2], r));
    l2 = gkdi_v_dot(m[0], m[1], m[2], m[0], m[1], m[2]);
    below = gkdi_v_less(l2, gkdi_v_mul(gkdi_v_mul(k, k), gkdi_v_all(1e-6f)));
    m[0] = gkdi_v_pick(below, gkdi_v_mul(n[0], k), m[0]);
    m[1] = gkdi_v_pick(below, gkdi_v_mul(n[1], k), m[1]);
    m[2] = gkdi_v_pick(below, gkdi_v_mul(n[2], k), m[2]);
    l2 = gkdi_v_pick(below, gkdi_v_mul(k, k), l2);
    r = gkdi_v_rsqrt(l2);
    k = gkdi_v_bound(gkdi_v_mul(l2, r), GKD_MIN_KAPPA, GKD_MAX_KAPPA);
    gkdi_v_store(b->falloff, k);
    m[0] = gkdi_v_mul(m[0], r);
    m[1] = gkdi_v_mul(m[1], r);
    m[2] = gkdi_v_mul(m[2], r);
    r = gkdi_v_min(gkdi_v_dot(m[0], m[1], m[2], n[0], n[1], n[2]), gkdi_v_all(0));
    r = gkdi_v_add(r, r);
    m[0] = gkdi_v_nmadd(r, n[0], m[0]);
    m[1] = gkdi_v_nmadd(r, n[1], m[1]);
    m[2] = gkdi_v_nmadd(r, n[2], m[2]);
    gkdi_v_store(b->x, m[0]);
    gkdi_v_store(b->y, m[1]);
    gkdi_v_store(b->z, m[2]);
    r = gkdi_v_dot(m[0], m[1], m[2], n[0], n[1], n[2]);
    if (gkdi_v_any(gkdi_v_less(gkdi_v_all(16384), k))) /* narrow lobes feel its rounding */
        r = gkdi_v_rises(m, normal);
    gkdi_v_store(b->lift, gkdi_v_mul(gkdi_v_mul(k, gkdi_v_all(2 * GKD_LOG2E)), gkdi_v_max(r, gkdi_v_all(0))));
}

/* Up to eight lobes of a handle. Handles have few lobes, but how few cannot be predicted: so steps go over all parts of
   a group. */
typedef struct gkdi_part {
    gkd_lobe_block *block;
    const gkd_lobe *lobes;
    uint32_t of, left; /* handle; lobes from here on */
} gkdi_part;

/* Scale, sums of weights, falloff. inverse: of the handle's sum; before: sum of the parts before, adds this one's. */
GKDI_OP void gkdi_finish_lobes(gkd_lobe_block *b, uint32_t left, float inverse, float *before)
{
    gkdi_f k = gkdi_v_load(b->falloff), w = gkdi_v_mul(gkdi_v_load(b->upper), gkdi_v_all(inverse)), m, upper;
    m = gkdi_v_mul(gkdi_v_all(2 * GKD_PI), gkdi_one_minus_exp(gkdi_v_add(k, k)));
    gkdi_v_store(b->scale, gkdi_v_div(gkdi_v_mul(w, k), m));
    gkdi_v_store(b->falloff, gkdi_v_mul(k, gkdi_v_all(0.5f * GKD_LOG2E)));
    upper = gkdi_v_add(gkdi_v_prefix(w), gkdi_v_all(*before));
    gkdi_v_store(b->upper, gkdi_v_pick(gkdi_v_lanes_from(left - 1), gkdi_v_all(1), upper));
    *before += gkdi_v_sum(w);
}

/* gkd_orient_lobes_as of up to GKDI_GROUP handles. */
GKDI_WIDE static void gkdi_orient_wide(uint32_t count, const gkdi_view_from *from, bool product)
{
    float offset[GKDI_GROUP][3], sum[GKDI_GROUP], inverse[GKDI_GROUP], before[GKDI_GROUP];
    bool surface[GKDI_GROUP];
    gkdi_part part[GKDI_GROUP * GKD_MAX_LOBES / 8];
    uint32_t i, k, n = 0;
    for (i = 0; i < count; ++i) {
        gkd_handle *h = from[i].handle;
        surface[i] = gkd_place_handle(h, from[i].pivot, from[i].position, from[i].normal, offset[i]);
        h->count = from[i].count;
        sum[i] = before[i] = 0;
        for (k = 0; k < h->count; k += 8, ++n) {
            part[n].block = &h->block[k / 8];
            part[n].lobes = from[i].lobes + k;
            part[n].of = i;
            part[n].left = h->count - k;
            GKDI_PREFETCH(part[n].lobes);
            GKDI_PREFETCH((const char *)part[n].lobes + 64);
            GKDI_PREFETCH((const char *)part[n].lobes + 128);
        }
    }
    for (k = 0; k < n; ++k)
        gkdi_turn_lobes(part[k].block, part[k].lobes, part[k].left, offset[part[k].of]);
    for (k = 0; k < n; ++k)
        if (surface[part[k].of])
            gkdi_weigh_lobes(part[k].block, from[part[k].of].handle->normal, product);
        else
            gkdi_v_store(part[k].block->lift, gkdi_v_all(0));
    for (k = 0; k < n; ++k) {
        if (surface[part[k].of])
            gkdi_tilt_lobes(part[k].block, from[part[k].of].handle->normal);
        sum[part[k].of] += gkdi_v_sum(gkdi_v_load(part[k].block->upper));
    }
    for (i = 0; i < count; ++i)
        inverse[i] = sum[i] > GKD_DIM ? 1 / sum[i] : 0;
    for (k = 0; k < n; ++k)
        gkdi_finish_lobes(part[k].block, part[k].left, inverse[part[k].of], &before[part[k].of]);
    for (i = 0; i < count; ++i)
        if (!(sum[i] > GKD_DIM)) {
            gkd_set_plain(from[i].handle, product);
            gkd_finish_lobes(from[i].handle, 1);
        }
}

/* Columns of draws. */
#define GKDI_DRAWS 64
typedef struct gkdi_draws {
    float mean[3][GKDI_DRAWS], kappa[GKDI_DRAWS], normal[3][GKDI_DRAWS], r[GKDI_DRAWS], turn[GKDI_DRAWS];
} gkdi_draws;

/* gkd_minus_log1m. */
GKDI_OP gkdi_f gkdi_minus_log1m(gkdi_f y)
{
    gkdi_f one = gkdi_v_all(1), zero = gkdi_v_all(0), t, z, q, p,
           exponent = gkdi_v_split_exponent(gkdi_v_sub(one, y), &t);
    t = gkdi_v_pick(gkdi_v_less(exponent, zero), t, gkdi_v_sub(zero, y));
    z = gkdi_v_div(t, gkdi_v_add(t, gkdi_v_all(2)));
    q = gkdi_v_mul(z, z);
    p = gkdi_v_madd(q, gkdi_v_all(1.0f / 9), gkdi_v_all(1.0f / 7));
    p = gkdi_v_madd(q, p, gkdi_v_all(1.0f / 5));
    p = gkdi_v_madd(q, p, gkdi_v_all(1.0f / 3));
    p = gkdi_v_mul(gkdi_v_add(z, z), gkdi_v_madd(q, p, one));
    return gkdi_v_nmadd(exponent, gkdi_v_all(GKD_LN2), gkdi_v_sub(zero, p));
}

/* gkd_sine. */
GKDI_OP gkdi_f gkdi_sine(gkdi_f x)
{
    gkdi_f q = gkdi_v_mul(x, x), p = gkdi_v_madd(q, gkdi_v_all(39.536707f), gkdi_v_all(-76.549782f));
    p = gkdi_v_madd(q, p, gkdi_v_all(81.601004f));
    p = gkdi_v_madd(q, p, gkdi_v_all(-41.341655f));
    return gkdi_v_mul(x, gkdi_v_madd(q, p, gkdi_v_all(6.2831852f)));
}

/* gkd_draw_direction of eight draws: in m means, out directions; n normals. */
GKDI_OP void gkdi_draw_directions(gkdi_f m[3], const gkdi_f n[3], gkdi_f k, gkdi_f r, gkdi_f turn)
{
    gkdi_f w[3], one = gkdi_v_all(1), zero = gkdi_v_all(0), v, s, c, radius, sign, a, b;
    uint32_t j;
    v = gkdi_v_mul(gkdi_v_bound(r, 0, 0.99999994f), gkdi_one_minus_exp(gkdi_v_add(k, k)));
    v = gkdi_v_bound(gkdi_v_div(gkdi_minus_log1m(v), k), 0, 2);
    sign = gkdi_v_pick(gkdi_v_less(m[2], zero), gkdi_v_all(-1), one);
    a = gkdi_v_div(gkdi_v_all(-1), gkdi_v_add(sign, m[2]));
    radius = gkdi_v_sqrt(gkdi_v_mul(v, gkdi_v_sub(gkdi_v_all(2), v)));
    c = gkdi_v_all(0.5f); /* gkd_circle */
    s = gkdi_v_sub(c, turn);
    b = gkdi_v_max(gkdi_v_min(s, gkdi_v_sub(c, s)), gkdi_v_sub(gkdi_v_sub(zero, c), s));
    c = gkdi_v_mul(gkdi_sine(gkdi_v_sub(gkdi_v_abs(s), gkdi_v_all(0.25f))), radius);
    s = gkdi_v_mul(gkdi_sine(b), radius);
    b = gkdi_v_mul(gkdi_v_mul(m[0], m[1]), a);
    v = gkdi_v_sub(one, v);
    w[0] = gkdi_v_madd(gkdi_v_mul(gkdi_v_mul(m[0], m[0]), a), sign, one);
    w[0] = gkdi_v_madd(v, m[0], gkdi_v_madd(c, w[0], gkdi_v_mul(s, b)));
    w[1] = gkdi_v_madd(gkdi_v_mul(m[1], m[1]), a, sign);
    w[1] = gkdi_v_madd(v, m[1], gkdi_v_madd(s, w[1], gkdi_v_mul(c, gkdi_v_mul(sign, b))));
    w[2] = gkdi_v_nmadd(gkdi_v_mul(c, sign), m[0], gkdi_v_nmadd(s, m[1], gkdi_v_mul(v, m[2])));
    a = gkdi_v_min(gkdi_v_dot(w[0], w[1], w[2], n[0], n[1], n[2]), zero);
    a = gkdi_v_add(a, a);
    for (j = 0; j < 3; ++j)
        w[j] = gkdi_v_nmadd(a, n[j], w[j]);
    b = gkdi_v_nmadd(gkdi_v_all(0.5f), gkdi_v_dot(w[0], w[1], w[2], w[0], w[1], w[2]), gkdi_v_all(1.5f));
    for (j = 0; j < 3; ++j)
        m[j] = gkdi_v_mul(w[j], b);
}

/* gkd_choose_lobe. */
GKDI_OP void gkdi_choose_lobe(const gkd_handle *handle, const float *u, gkd_draw *out)
{
    float e = handle->uniform, extra = gkd_extend_random(u), r = (u[0] - e) / (1 - e);
    uint32_t k, n = 0, blocks = (handle->count + 7) / 8;
    out->turn = u[1];
    if (u[0] < e) {
        gkd_draw_uniform(u[0], extra, e, out);
        return;
    }
    for (k = 0; k < blocks; ++k)
        n += gkdi_v_count_at_most(gkdi_v_load(handle->block[k].upper), r);
    gkd_draw_lobe(handle, n, r, extra / (1 - e), out);
}

GKDI_WIDE static float gkdi_sample_wide(const gkd_handle *handle, const float *u, float *direction)
{
    gkd_draw draw;
    gkdi_f m[3], n[3];
    float lanes[8];
    uint32_t k;
    gkdi_choose_lobe(handle, u, &draw);
    for (k = 0; k < 3; ++k) {
        m[k] = gkdi_v_all(draw.mean[k]);
        n[k] = gkdi_v_all(draw.normal[k]);
    }
    gkdi_draw_directions(m, n, gkdi_v_all(draw.kappa), gkdi_v_all(draw.r), gkdi_v_all(draw.turn));
    for (k = 0; k < 3; ++k) {
        gkdi_v_store(lanes, m[k]);
        direction[k] = lanes[0];
    }
    return gkdi_pdf_inline(handle, direction);
}

GKDI_WIDE static void gkdi_sample_batch_wide(uint32_t count, const uint32_t *index, const gkd_handle *handles,
                                             const float *u, size_t u_stride, float *directions, size_t stride,
                                             float *pdf)
{
    gkdi_draws draws;
    uint32_t start, i, k, n;
    memset(&draws, 0, sizeof draws);
    for (i = 0; i < GKDI_DRAWS; ++i)
        draws.kappa[i] = 1;
    for (start = 0; start < count; start += n) {
        n = count - start < GKDI_DRAWS ? count - start : GKDI_DRAWS;
        for (i = 0; i < n; ++i) {
            uint32_t at = gkdi_at(index, start + i);
            gkd_draw draw;
            gkdi_choose_lobe(&handles[at], gkdi_row(u, u_stride, at), &draw);
            for (k = 0; k < 3; ++k) {
                draws.mean[k][i] = draw.mean[k];
                draws.normal[k][i] = draw.normal[k];
            }
            draws.kappa[i] = draw.kappa;
            draws.r[i] = draw.r;
            draws.turn[i] = draw.turn;
        }
        for (i = 0; i < n; i += 8) {
            gkdi_f m[3], normal[3];
            for (k = 0; k < 3; ++k) {
                m[k] = gkdi_v_load(draws.mean[k] + i);
                normal[k] = gkdi_v_load(draws.normal[k] + i);
            }
            gkdi_draw_directions(m, normal, gkdi_v_load(draws.kappa + i), gkdi_v_load(draws.r + i),
                                 gkdi_v_load(draws.turn + i));
            for (k = 0; k < 3; ++k)
                gkdi_v_store(draws.mean[k] + i, m[k]);
        }
        for (i = 0; i < n; ++i) {
            uint32_t at = gkdi_at(index, start + i);
            float *out = gkdi_row_out(directions, stride, at), d[3];
            for (k = 0; k < 3; ++k)
                out[k] = d[k] = draws.mean[k][i];
            pdf[at] = gkdi_pdf_inline(&handles[at], d);
        }
    }
}
#endif

/* gkd_orient_lobes_as at a level, of up to GKDI_GROUP handles. */
static void gkdi_orient_group(uint32_t simd, uint32_t count, const gkdi_view_from *from, bool product)
{
    uint32_t i;
#if GKDI_X86 || GKDI_NEON
    if (simd > GKD_SIMD_SCALAR) {
        gkdi_orient_wide(count, from, product);
        for (i = 0; i < count; ++i)
            from[i].handle->simd = simd;
        return;
    }
#endif
    (void)simd;
    for (i = 0; i < count; ++i)
        gkd_orient_lobes_as(from[i].handle, from[i].lobes, from[i].count, from[i].pivot, from[i].position,
                            from[i].normal, product);
}

GKD_API void gkd_pdf_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const gkd_handle *handles,
                           const float *directions, size_t stride, float *pdf)
{
    uint32_t i;
#if GKDI_X86 || GKDI_NEON
    if (view->simd > GKD_SIMD_SCALAR) {
        gkdi_pdf_batch_wide(count, index, handles, directions, stride, pdf);
        return;
    }
#endif
    (void)view;
    for (i = 0; i < count; ++i) {
        uint32_t at = gkdi_at(index, i);
        const float *w = gkdi_row(directions, stride, at);
        const float direction[3] = {w[0], w[1], w[2]}; /* w may be seen to point to the first member of a struct */
        pdf[at] = gkd_pdf_scalar(&handles[at], direction);
    }
}

GKD_API void gkd_pdf_directions(const gkd_view *view, const gkd_handle *handle, uint32_t count, const float *directions,
                                size_t stride, float *pdf)
{
    uint32_t i = 0;
#if GKDI_X86 || GKDI_NEON
    if (view->simd > GKD_SIMD_SCALAR) {
#if GKDI_X86
        if (view->simd == GKD_SIMD_AVX512) {
            i = count & ~15u;
            gkdi_pdf_same_512(handle, i, directions, stride, pdf);
        } else
#endif
        {
            i = count & ~7u;
            gkdi_pdf_same_wide(handle, i, directions, stride, pdf);
        }
    }
#endif
    (void)view;
    for (; i < count; ++i)
        pdf[i] = gkd_pdf_scalar(handle, gkdi_row(directions, stride, i));
}

GKD_API void gkd_sample_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const gkd_handle *handles,
                              const float *u, size_t u_stride, float *directions, size_t stride, float *pdf)
{
    uint32_t i;
#if GKDI_X86 || GKDI_NEON
    if (view->simd > GKD_SIMD_SCALAR) {
        gkdi_sample_batch_wide(count, index, handles, u, u_stride, directions, stride, pdf);
        return;
    }
#endif
    (void)view;
    for (i = 0; i < count; ++i) {
        uint32_t at = gkdi_at(index, i);
        pdf[at] = gkd_sample_scalar(&handles[at], gkdi_row(u, u_stride, at), gkdi_row_out(directions, stride, at));
    }
}

GKD_API void gkd_find_batch(const gkd_view *view, uint32_t count, const uint32_t *index, const float *positions,
                            size_t position_stride, const float *normals, size_t normal_stride, const float *u,
                            size_t u_stride, gkd_handle *handles, float *alpha)
{
    gkdi_view_from from[GKDI_GROUP];
    const float *at[GKDI_GROUP];
    float jittered[GKDI_GROUP][3];
    uint32_t cells[GKDI_GROUP], done, k;
    for (done = 0; done < count; done += GKDI_GROUP) {
        uint32_t n = count - done < GKDI_GROUP ? count - done : GKDI_GROUP;
        for (k = 0; k < n; ++k) {
            uint32_t i = gkdi_at(index, done + k);
            at[k] = gkdi_row(positions, position_stride, i);
            if (u) {
                gkd_jitter(view, at[k], gkdi_row(u, u_stride, i), jittered[k]);
                at[k] = jittered[k];
            }
        }
        if (n > 1)
            gkdi_find_cells(view->simd, view->nodes, n, at, cells);
        else
            cells[0] = gkd_find_cell(view, at[0]); /* shorter: nothing to overlap */
        for (k = 0; k < n; ++k) {
            uint32_t i = gkdi_at(index, done + k);
            const float *position = gkdi_row(positions, position_stride, i);
            const gkd_cell *cell = gkd_set_cell(view, cells[k], &handles[i]);
            if (alpha)
                alpha[i] = cell->alpha;
            from[k].handle = &handles[i];
            from[k].lobes = view->lobes + cell->lobes;
            from[k].count = cell->count;
            from[k].pivot = cell->pivot;
            from[k].position = position;
            from[k].normal = normals ? gkdi_row(normals, normal_stride, i) : NULL;
        }
        gkdi_orient_group(view->simd, n, from, !view->no_product);
    }
}

GKD_API void gkd_find_one(const gkd_view *view, const float position[3], const float *normal, const float *u,
                          gkd_handle *handle)
{
    gkd_find_batch(view, 1, NULL, position, 0, normal, 0, u, 0, handle, NULL);
}

GKD_API float gkd_sample_one(const gkd_handle *handle, const float u[2], float direction[3])
{
#if GKDI_X86 || GKDI_NEON
    if (handle->simd > GKD_SIMD_SCALAR)
        return gkdi_sample_wide(handle, u, direction);
#endif
    return gkd_sample_scalar(handle, u, direction);
}

GKD_API float gkd_pdf_one(const gkd_handle *handle, const float direction[3])
{
#if GKDI_X86 || GKDI_NEON
    if (handle->simd > GKD_SIMD_SCALAR)
        return gkdi_pdf_wide(handle, direction);
#endif
    return gkd_pdf_scalar(handle, direction);
}

/* ---- >>files ------------------------------------------------------------------------------------------------ */

/* The descriptor without pointers; no padding. */
typedef struct gkdi_options {
    uint64_t max_bytes;
    float bounds_min[3], bounds_max[3];
    float radiance_step, direction_step, confidence, keep_signatures, alpha, uniform, gate_margin, gate_gain;
    uint32_t split, split_samples, lookahead, min_samples, flags, max_levels, max_lobes, update_samples, alpha_mode,
        gate_probe;
} gkdi_options;

/* A save: this, nodes, cells, then each cell's lookahead tree and mixture, splits, samples that wait, the sampling
   part. */
typedef struct gkdi_header {
    char magic[8];
    uint32_t version, byte_order;
    uint64_t size;     /* of all */
    uint64_t checksum; /* of what follows this member */
    gkdi_options options;
    gkd_stats stats;
    double all_samples, held_samples;
    uint64_t block_size;
    uint32_t nodes, cells, splits, pending, pixels, reserved;
} gkdi_header;

/* A cell in a save. */
typedef struct gkdi_saved_cell {
    gkdi_gate gate;
    gkdi_shape shape;
    double lit, wakes;
    uint32_t look_count, model_words, level, calm;
} gkdi_saved_cell;

static const char gkdi_magic[8] = {'g', 'u', 'i', 'd', 'e', '_', 'k', 'd'};
#define GKDI_BYTE_ORDER 0x01020304u
#define GKDI_CHECKED_FROM (offsetof(gkdi_header, options))

static gkdi_options gkdi_options_of(const gkd_desc *d)
{
    gkdi_options o;
    memset(&o, 0, sizeof o);
    o.max_bytes = d->max_bytes;
    memcpy(o.bounds_min, d->bounds_min, sizeof o.bounds_min);
    memcpy(o.bounds_max, d->bounds_max, sizeof o.bounds_max);
    o.radiance_step = d->radiance_step;
    o.direction_step = d->direction_step;
    o.confidence = d->confidence;
    o.keep_signatures = d->keep_signatures;
    o.alpha = d->alpha;
    o.uniform = d->uniform;
    o.gate_margin = d->gate_margin;
    o.gate_gain = d->gate_gain;
    o.split = (uint32_t)d->split;
    o.split_samples = d->split_samples;
    o.lookahead = d->lookahead;
    o.min_samples = d->min_samples;
    o.flags = (d->no_radiance_test ? 1u : 0) | (d->no_direction_test ? 2u : 0) | (d->keep_signatures > 0 ? 4u : 0) |
              (d->no_mixtures ? 8u : 0) | (d->no_gate ? 16u : 0) | (d->published_tests ? 32u : 0) |
              (d->no_prune ? 64u : 0) | (d->no_rest ? 128u : 0);
    o.max_levels = d->max_levels;
    o.max_lobes = d->max_lobes;
    o.update_samples = d->update_samples;
    o.alpha_mode = (uint32_t)d->alpha_mode;
    o.gate_probe = d->gate_probe;
    return o;
}

/* The other way; allocator and simd stay as they are in d. */
static void gkdi_options_to(const gkdi_options *o, gkd_desc *d)
{
    d->max_bytes = o->max_bytes;
    memcpy(d->bounds_min, o->bounds_min, sizeof o->bounds_min);
    memcpy(d->bounds_max, o->bounds_max, sizeof o->bounds_max);
    d->radiance_step = o->radiance_step;
    d->direction_step = o->direction_step;
    d->confidence = o->confidence;
    d->alpha = o->alpha;
    d->uniform = o->uniform;
    d->gate_margin = o->gate_margin;
    d->gate_gain = o->gate_gain;
    d->split = (gkd_split)o->split;
    d->split_samples = o->split_samples;
    d->lookahead = o->lookahead;
    d->min_samples = o->min_samples;
    d->no_radiance_test = (o->flags & 1u) != 0;
    d->no_direction_test = (o->flags & 2u) != 0;
    d->keep_signatures = o->keep_signatures;
    d->no_mixtures = (o->flags & 8u) != 0;
    d->no_gate = (o->flags & 16u) != 0;
    d->published_tests = (o->flags & 32u) != 0;
    d->no_prune = (o->flags & 64u) != 0;
    d->no_rest = (o->flags & 128u) != 0;
    d->max_levels = o->max_levels;
    d->max_lobes = o->max_lobes;
    d->update_samples = o->update_samples;
    d->alpha_mode = (gkd_alpha_mode)o->alpha_mode;
    d->gate_probe = o->gate_probe;
}

static uint64_t gkdi_hash(uint64_t h, uint64_t x)
{
    h = (h ^ x) * 0x9fb21c651e98df25ull;
    return h ^ (h >> 29);
}

/* Hash of bytes, eight at a time. */
static uint64_t gkdi_hash_bytes(uint64_t h, const void *data, size_t size)
{
    const unsigned char *p = (const unsigned char *)data;
    uint64_t word;
    for (; size >= 8; p += 8, size -= 8) {
        memcpy(&word, p, 8);
        h = gkdi_hash(h, word);
    }
    for (word = 0; size; --size)
        word = word << 8 | p[size - 1];
    return gkdi_hash(h, word);
}

GKD_API uint64_t gkd_structure_id(const gkd_field *field)
{
    uint64_t h = gkdi_hash(0x2545f4914f6cdd1dull, field->cell_count);
    return gkdi_hash_bytes(gkdi_hash(h, field->stats.updates), field->nodes, field->node_count * sizeof *field->nodes);
}

GKD_API size_t gkd_save_bound(const gkd_field *field)
{
    uint64_t n = sizeof(gkdi_header) + field->node_count * sizeof(gkd_node) +
                 field->cell_count * sizeof(gkdi_saved_cell) + field->split_count * sizeof(gkdi_split_event) +
                 field->pending_count * sizeof(gkd_training_sample) + field->block->size;
    uint32_t i;
    for (i = 0; i < field->cell_count; ++i) {
        const gkdi_cell *c = &field->cells[i];
        n += c->look_count * sizeof *c->look + (size_t)c->model_capacity * sizeof *c->model;
    }
    return (size_t)n;
}

static void gkdi_write(char **at, const void *data, size_t size)
{
    if (size)
        memcpy(*at, data, size);
    *at += size;
}

GKD_API gkd_result gkd_save(const gkd_field *field, void *data, size_t capacity, size_t *size)
{
    gkdi_header h;
    char *at = (char *)data;
    uint32_t i;
    *size = gkd_save_bound(field);
    if (capacity < *size)
        return GKD_BUFFER_TOO_SMALL;
    memset(&h, 0, sizeof h);
    memcpy(h.magic, gkdi_magic, sizeof h.magic);
    h.version = GKD_VERSION;
    h.byte_order = GKDI_BYTE_ORDER;
    h.size = *size;
    h.options = gkdi_options_of(&field->desc);
    h.stats = field->stats;
    h.all_samples = field->all_samples;
    h.held_samples = field->held_samples;
    h.block_size = field->block->size;
    h.nodes = field->node_count;
    h.cells = field->cell_count;
    h.splits = field->split_count;
    h.pending = field->pending_count;
    h.pixels = field->pixels;
    gkdi_write(&at, &h, sizeof h);
    gkdi_write(&at, field->nodes, field->node_count * sizeof *field->nodes);
    for (i = 0; i < field->cell_count; ++i) {
        const gkdi_cell *c = &field->cells[i];
        gkdi_saved_cell s;
        memset(&s, 0, sizeof s);
        s.gate = c->gate;
        s.shape = c->shape;
        s.lit = c->lit;
        s.wakes = c->wakes;
        s.calm = c->calm;
        s.look_count = c->look_count;
        s.model_words = c->model_capacity;
        s.level = c->level;
        gkdi_write(&at, &s, sizeof s);
    }
    for (i = 0; i < field->cell_count; ++i) {
        const gkdi_cell *c = &field->cells[i];
        gkdi_write(&at, c->look, c->look_count * sizeof *c->look);
        gkdi_write(&at, c->model, c->model_capacity * sizeof *c->model);
    }
    gkdi_write(&at, field->splits, field->split_count * sizeof *field->splits);
    gkdi_write(&at, field->pending, field->pending_count * sizeof *field->pending);
    gkdi_write(&at, field->block, (size_t)field->block->size);
    h.checksum = gkdi_hash_bytes(1, (char *)data + GKDI_CHECKED_FROM, *size - GKDI_CHECKED_FROM);
    memcpy(data, &h, sizeof h);
    return GKD_OK;
}

/* Data that is read front to back. */
typedef struct gkdi_reader {
    const char *at;
    size_t left;
    bool cut; /* something was not there */
} gkdi_reader;

/* Copy of the next count * size bytes in memory of its own; NULL where they are not there or memory is out. */
static void *gkdi_read(gkdi_reader *r, const gkd_desc *desc, uint64_t count, size_t size)
{
    void *p;
    r->cut = r->cut || count > r->left / size;
    if (r->cut)
        return NULL;
    p = gkdi_allocate(desc, count, size);
    if (p && count)
        memcpy(p, r->at, (size_t)count * size);
    r->at += count * size;
    r->left -= (size_t)count * size;
    return p;
}

/* Every node reached once from the root, every cell named by one leaf, no path longer than the levels allowed. seen has
   one byte per cell; false otherwise. */
static bool gkdi_tree_valid(const gkd_node *nodes, uint32_t count, uint32_t cells, unsigned char *seen)
{
    uint32_t stack[2 * 64], depth[2 * 64], n = 1, visited = 0, leaves = 0;
    if (count != 2 * cells - 1)
        return false;
    stack[0] = depth[0] = 0;
    while (n) {
        uint32_t i = stack[--n], d = depth[n], link = nodes[i].link;
        ++visited;
        if (link & GKD_LEAF) {
            link &= ~GKD_LEAF;
            if (link >= cells || seen[link])
                return false;
            seen[link] = 1;
            ++leaves;
            continue;
        }
        if (link >> 29 > 2 || !gkdi_finite(nodes[i].split) || d >= 60 || visited > count)
            return false;
        link &= 0x1fffffffu;
        if (link <= i || link + 1 >= count) /* children come later */
            return false;
        stack[n] = link;
        stack[n + 1] = link + 1;
        depth[n] = depth[n + 1] = d + 1;
        n += 2;
    }
    return visited == count && leaves == cells;
}

static bool gkdi_look_valid(const gkdi_cell *c, uint32_t most)
{
    uint32_t i, next = 1;
    if (c->look_count < 1 || c->look_count > most)
        return false;
    for (i = 0; i < c->look_count; ++i) {
        const gkd_signature *s = &c->look[i];
        uint32_t child = s->child;
        if (!gkdi_signature_valid(s) || s->axis > 2 ||
            (child && (s->alike || child + 1 >= c->look_count || child <= i)))
            return false;
        next += child ? 2 : 0;
    }
    return next == c->look_count;
}

static bool gkdi_gate_valid(const gkdi_gate *g)
{
    double sum = g->fresh + g->flow + g->count + g->weight + g->pixel + g->pixel_v;
    int k;
    for (k = 0; k <= GKDI_GATE_LOW; ++k)
        sum += fabs(g->v[k]) * 1e-200 + fabs(g->vv[k]) * 1e-200;
    for (k = 0; k < GKDI_GATE_LOW; ++k)
        sum += fabs(g->cross[k]) * 1e-200;
    return sum >= 0 && sum < INFINITY && g->fresh >= 0 && g->count >= 0 && g->alpha >= 0.04f && g->alpha <= 1 &&
           g->reflected >= 0 && g->reflected <= 1e30f && g->verdict <= GKD_GATE_CLOSED;
}

static bool gkdi_lobe_valid(const gkd_lobe *l)
{
    double n = (double)l->mean[0] * (double)l->mean[0] + (double)l->mean[1] * (double)l->mean[1] +
               (double)l->mean[2] * (double)l->mean[2];
    return fabs(n - 1) < 1e-3 && l->kappa >= 0 && l->kappa <= 1.001e5f && l->weight >= 0 && l->weight <= 1.001f &&
           l->nearness >= 0 && l->nearness < INFINITY;
}

/* A packed mixture: counts, and sums that hold together. */
static bool gkdi_model_valid(const uint32_t *packed, uint32_t words)
{
    gkdi_model m;
    uint32_t k, count;
    bool ok;
    if (words < gkdi_model_words(0))
        return false;
    count = packed[GKDI_PACKED_COUNT];
    if (count > GKD_MAX_LOBES || gkdi_model_words(count) > words)
        return false;
    gkdi_model_unpack(&m, packed);
    ok = m.held >= 0 && m.held < INFINITY && m.level >= 0 && m.level < INFINITY && m.samples >= 0 &&
         m.samples < INFINITY && gkdi_finite(m.pivot[0]) && gkdi_finite(m.pivot[1]) && gkdi_finite(m.pivot[2]);
    for (k = 0; ok && k < count; ++k) {
        double x = (double)m.sums.x[k], y = (double)m.sums.y[k], z = (double)m.sums.z[k], w = (double)m.sums.soft[k];
        ok = w >= 0 && w < INFINITY && x * x + y * y + z * z <= 1.001 * w * w + 1e-30 && m.sums.nearness[k] >= 0 &&
             m.sums.nearness[k] < INFINITY && m.sums.squares[k] >= 0 && m.sums.squares[k] < 1e30f;
    }
    return ok;
}

/* The sampling part: its own counts and offsets, then every index and number. */
static gkd_result gkdi_block_valid(gkdi_block *b, uint64_t size, const gkd_desc *desc)
{
    gkdi_block shape = *b;
    unsigned char *seen;
    uint32_t i, k, lobes = 0;
    bool ok;
    if (b->cells < 1 || b->cells > GKDI_MAX_CELLS || b->nodes != 2 * b->cells - 1)
        return GKD_CORRUPT;
    gkdi_block_layout(&shape);
    if (shape.size != size || memcmp(&shape, b, sizeof shape) != 0 || !gkdi_within_float(b->uniform, 1e-4f, 1))
        return GKD_CORRUPT;
    seen = (unsigned char *)gkdi_allocate(desc, b->cells, 1);
    if (!seen)
        return GKD_OUT_OF_MEMORY;
    ok = gkdi_tree_valid(gkdi_block_nodes(b), b->nodes, b->cells, seen);
    gkdi_release(desc, seen);
    for (i = 0; ok && i < b->cells; ++i) {
        const gkd_cell *c = &gkdi_block_cells(b)[i];
        ok = c->count <= GKD_MAX_LOBES && c->lobes == lobes && c->count <= b->lobes - lobes && c->alpha >= 0.04f &&
             c->alpha <= 1 && c->reflected >= 0 && c->reflected <= 1e30f && c->gate <= GKD_GATE_CLOSED;
        for (k = 0; ok && k < 3; ++k)
            ok = gkdi_finite(c->pivot[k]);
        for (k = 0; ok && k < c->count; ++k)
            ok = gkdi_lobe_valid(&gkdi_block_lobes(b)[lobes + k]);
        lobes += ok ? c->count : 0;
    }
    return ok && lobes == b->lobes ? GKD_OK : GKD_CORRUPT;
}

GKD_API gkd_result gkd_validate(const gkd_field *field)
{
    uint32_t i, most = (2u << gkdi_look_levels(&field->desc)) - 1;
    unsigned char *seen = (unsigned char *)gkdi_allocate(&field->desc, field->cell_count, 1);
    bool ok;
    if (!seen)
        return GKD_OUT_OF_MEMORY;
    ok = gkdi_tree_valid(field->nodes, field->node_count, field->cell_count, seen);
    gkdi_release(&field->desc, seen);
    for (i = 0; ok && i < field->cell_count; ++i) {
        const gkdi_cell *c = &field->cells[i];
        ok = gkdi_look_valid(c, most) && gkdi_gate_valid(&c->gate) && c->lit >= 0 && c->lit < INFINITY &&
             c->wakes >= 0 && c->wakes < INFINITY && c->calm <= GKDI_CALM_FITS && c->level <= 60 &&
             (!c->model || gkdi_model_valid(c->model, c->model_capacity));
    }
    for (i = 0; ok && i < field->split_count; ++i)
        ok = field->splits[i].parent < field->cell_count && field->splits[i].child < field->cell_count;
    return ok ? gkdi_block_valid(field->block, field->block->size, &field->desc) : GKD_CORRUPT;
}

/* The parts of a save after the header; what cannot be read stays NULL. */
static gkd_result gkdi_load_parts(gkd_field *f, const gkdi_header *h, gkdi_reader *r)
{
    const gkd_desc *d = &f->desc;
    gkdi_saved_cell *saved;
    uint32_t i;
    f->nodes = (gkd_node *)gkdi_read(r, d, h->nodes, sizeof *f->nodes);
    saved = (gkdi_saved_cell *)gkdi_read(r, d, h->cells, sizeof *saved);
    f->cells = (gkdi_cell *)gkdi_allocate(d, h->cells, sizeof *f->cells);
    if (!f->nodes || !saved || !f->cells) {
        gkdi_release(d, saved);
        return r->cut ? GKD_BAD_FILE : GKD_OUT_OF_MEMORY;
    }
    f->node_count = f->node_capacity = h->nodes;
    f->cell_count = f->cell_capacity = h->cells;
    for (i = 0; i < h->cells; ++i) {
        gkdi_cell *c = &f->cells[i];
        c->gate = saved[i].gate;
        c->shape = saved[i].shape;
        c->lit = saved[i].lit;
        c->wakes = saved[i].wakes;
        c->calm = saved[i].calm;
        c->level = saved[i].level;
        c->look = (gkd_signature *)gkdi_read(r, d, saved[i].look_count, sizeof *c->look);
        c->look_count = c->look_capacity = saved[i].look_count;
        if (c->look && saved[i].model_words)
            c->model = (uint32_t *)gkdi_read(r, d, saved[i].model_words, sizeof *c->model);
        c->model_capacity = c->model ? saved[i].model_words : 0;
        if (!c->look || (saved[i].model_words && !c->model)) {
            gkdi_release(d, saved);
            return r->cut ? GKD_BAD_FILE : GKD_OUT_OF_MEMORY;
        }
    }
    gkdi_release(d, saved);
    f->splits = (gkdi_split_event *)gkdi_read(r, d, h->splits, sizeof *f->splits);
    f->split_count = f->split_capacity = f->splits ? h->splits : 0;
    f->pending = (gkd_training_sample *)gkdi_read(r, d, h->pending, sizeof *f->pending);
    f->pending_count = f->pending_capacity = f->pending ? h->pending : 0;
    if (h->block_size < sizeof(gkdi_block) || h->block_size != r->left)
        return GKD_BAD_FILE;
    f->block = (gkdi_block *)gkdi_read(r, d, h->block_size, 1);
    return f->splits && f->pending && f->block ? GKD_OK : r->cut ? GKD_BAD_FILE : GKD_OUT_OF_MEMORY;
}

GKD_API gkd_result gkd_load(const gkd_desc *desc, const void *data, size_t size, gkd_field **field)
{
    gkdi_header h;
    gkdi_reader r;
    gkd_desc d;
    gkd_field *f;
    gkd_result result;
    *field = NULL;
    if (size < sizeof h)
        return GKD_BAD_FILE;
    memcpy(&h, data, sizeof h);
    if (memcmp(h.magic, gkdi_magic, sizeof h.magic) != 0)
        return GKD_BAD_FILE;
    if (h.version != GKD_VERSION || h.byte_order != GKDI_BYTE_ORDER)
        return GKD_BAD_VERSION;
    if (h.size != size ||
        h.checksum != gkdi_hash_bytes(1, (const char *)data + GKDI_CHECKED_FROM, size - GKDI_CHECKED_FROM))
        return GKD_BAD_FILE;
    memset(&d, 0, sizeof d);
    gkdi_options_to(&h.options, &d);
    if (desc) {
        d.allocate = desc->allocate;
        d.release = desc->release;
        d.user = desc->user;
        d.simd = desc->simd;
    }
    result = gkd_resolve(&d, &d);
    if (result)
        return result == GKD_BAD_ALLOCATOR ? result : GKD_BAD_FILE;
    if (!gkdi_within((double)h.stats.closed_share, 0, 1) || !gkdi_within((double)h.stats.mean_alpha, 0, 1) ||
        h.cells < 1 || h.cells > GKDI_MAX_CELLS || h.nodes != 2 * h.cells - 1 || h.pending > d.update_samples ||
        !(h.all_samples >= 0 && h.all_samples < INFINITY && h.held_samples >= 0 && h.held_samples <= h.all_samples))
        return GKD_BAD_FILE;
    f = (gkd_field *)gkdi_allocate(&d, 1, sizeof *f);
    if (!f)
        return GKD_OUT_OF_MEMORY;
    f->desc = d;
    f->stats = h.stats;
    f->all_samples = h.all_samples;
    f->held_samples = h.held_samples;
    f->pixels = h.pixels != 0;
    r.at = (const char *)data + sizeof h;
    r.left = size - sizeof h;
    r.cut = false;
    gkdi_field_options(f);
    result = gkdi_load_parts(f, &h, &r);
    if (!result)
        result = gkdi_block_valid(f->block, h.block_size, &d);
    if (!result)
        result = gkd_validate(f);
    result = result == GKD_CORRUPT ? GKD_BAD_FILE : result;
    if (result) {
        gkd_destroy(f);
        return result;
    }
    gkdi_count_cells(f);
    *field = f;
    return GKD_OK;
}

GKD_API gkd_result gkd_merge(gkd_field *field, const gkd_field *source, gkd_parallel_fn parallel, void *user)
{
    if (gkd_structure_id(field) != gkd_structure_id(source) || field->stats.passes != source->stats.passes)
        return GKD_MISMATCH;
    return gkdi_take(field, source->pending, source->pending_count, parallel, user);
}

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

#endif /* GKD_IMPLEMENTATION */

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
