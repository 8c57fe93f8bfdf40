/* guide_nn.h 0.1: small neural networks for path guiding: convolutions over (z, phi), safetensors. Licence: MIT or
   Unlicense.

   In exactly one file, before including it:        #define GNN_IMPLEMENTATION
   Everywhere else only:                            #include "guide_nn.h"

       #define GNN_IMPLEMENTATION
       #include "guide_nn.h"
       int main(void)
       {
           static float map[34 * 18 * 8], out[34 * 18 * 8], weights[9 * 8 * 8 + 8], prepared[2 * 9 * 8 * 8];
           gnn_conv conv = {32, 16, 0, 0, 8, 8, 8, 8, true, GNN_SIMD_AUTO}; // 8 channels to 8 over 32 x 16 directions
           gnn_conv_maps maps = {NULL, map, NULL, NULL, out};
           conv.simd = gnn_resolve_simd(GNN_SIMD_AUTO);
           gnn_conv_prepare(&conv, weights, prepared);
           gnn_conv_forward(&conv, weights, prepared, &maps, NULL);
           return gnn_conv_check(&conv);
       }

   CONTENTS (search for the tag)
     >>config  macros   >>types  results   >>tensors  safetensors files   >>layers  maps, convolution
     implementation:
     >>levels  >>tiles  >>maps  >>convolution  >>backward  >>json  >>files  >>halves  >>writing  >>licence

   THREADS: each function has a tag.
     [any thread]   pure function on constant data and what the caller hands it */
#ifndef GUIDE_NN_H
#define GUIDE_NN_H

/* ---- >>config ----------------------------------------------------------------------------------------------- */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef GNN_API /* linkage of the functions; e.g. static */
#define GNN_API extern
#endif
/* Other macros, read by the implementation only: GNN_ASSERT(x), GNN_MALLOC(n), GNN_FREE(p), GNN_NO_SIMD. */

#ifdef __cplusplus
extern "C" {
#endif

/* ---- >>types ------------------------------------------------------------------------------------------------ */

/* Results and their messages. */
#define GNN_RESULTS(X)                                                                                                 \
    X(GNN_OK, "ok")                                                                                                    \
    X(GNN_OUT_OF_MEMORY, "out of memory: check desc.allocate")                                                         \
    X(GNN_BAD_OPTION, "desc.simd is out of range or not available on this machine")                                    \
    X(GNN_BAD_RANGE, "a number in the descriptor is out of its range: see its comments")                               \
    X(GNN_BAD_SHAPE, "width and height do not fit: see the comment of gnn_conv or gnn_unet_desc")                      \
    X(GNN_BAD_ALLOCATOR, "set both desc.allocate and desc.release or neither")                                         \
    X(GNN_BUFFER_TOO_SMALL, "the buffer or workspace is too small: ask the function that tells its size")              \
    X(GNN_BAD_FILE, "not a safetensors file, or it is damaged")                                                        \
    X(GNN_MISSING_TENSOR, "the file lacks a tensor that the network needs")                                            \
    X(GNN_WRONG_TENSOR, "a tensor has another shape or type than the network needs, or a value that is not finite")

#define GNN_RESULT_ENUM(name, text) name,
typedef enum gnn_result { GNN_RESULTS(GNN_RESULT_ENUM) GNN_RESULT_COUNT } gnn_result;
#undef GNN_RESULT_ENUM

/* AUTO: the best that the machine has. Levels differ by rounding: <= 1e-5 of a layer's output rms. */
typedef enum gnn_simd { GNN_SIMD_AUTO, GNN_SIMD_SCALAR, GNN_SIMD_AVX2, GNN_SIMD_AVX512, GNN_SIMD_NEON } gnn_simd;

typedef void (*gnn_range_fn)(void *context, uint32_t begin, uint32_t end);
/* Calls fn on disjoint ranges that cover [0, count), of about grain, and returns when all are done. */
typedef void (*gnn_parallel_fn)(void *user, uint32_t count, uint32_t grain, gnn_range_fn fn, void *context);

/* [any thread] Never NULL. */
GNN_API const char *gnn_result_string(gnn_result result);
/* [any thread] The level that `wanted` stands for on this machine; GNN_SIMD_AUTO where it is not available. */
GNN_API gnn_simd gnn_resolve_simd(gnn_simd wanted);

/* ---- >>tensors ---------------------------------------------------------------------------------------------- */

/* Element types of safetensors files. Of OTHER types only the place is known. */
typedef enum gnn_type { GNN_TYPE_OTHER, GNN_TYPE_F32, GNN_TYPE_F16 } gnn_type;

#define GNN_MAX_RANK 8
#define GNN_MAX_HEADER (16u << 20) /* bytes of a file's header that are read, at most */

/* A tensor in a file: pointers into the file's bytes, which must outlive it. Row-major, the last index fastest. */
typedef struct gnn_tensor {
    const char *name; /* as it stands in the file, not terminated; in messages what is not printable ASCII is "?" */
    uint32_t name_length;
    gnn_type type;
    uint32_t rank; /* 0 = one value */
    uint64_t shape[GNN_MAX_RANK];
    const unsigned char *data; /* may be unaligned */
    uint64_t size;             /* bytes */
} gnn_tensor;

/* Where a file or its use failed, for people: names the tensor. Empty after success. */
typedef struct gnn_message {
    char text[200];
} gnn_message;

/* [any thread] Reads the header of a safetensors file in memory and checks all of it: JSON, types, shapes, that the
   tensors' bytes follow each other without gap or overlap up to the file's end, that names are unique and free of
   escapes. Safe for untrusted input. On success tensors[0 .. *count - 1] are sorted by name. capacity: of `tensors`;
   too small gives GNN_BUFFER_TOO_SMALL and the number needed in *count (tensors may be NULL if capacity is 0).
   message may be NULL. Time O(size of header + n log n). */
GNN_API gnn_result gnn_tensors_read(const void *file, size_t size, gnn_tensor *tensors, uint32_t capacity,
                                    uint32_t *count, gnn_message *message);
/* [any thread] The tensor of that name in a list sorted by gnn_tensors_read; NULL where there is none. */
GNN_API const gnn_tensor *gnn_tensors_find(const gnn_tensor *tensors, uint32_t count, const char *name);
/* [any thread] The text of a key of the file's metadata, cut to capacity - 1 bytes and terminated. False where there
   is none, or gnn_tensors_read has refused the file. Escapes are resolved, but for code points above 127: "?". */
GNN_API bool gnn_tensors_metadata(const void *file, size_t size, const char *key, char *text, size_t capacity);
/* [any thread] Values begin .. begin + count - 1 of an F32 or F16 tensor as floats. False where the tensor has another
   type or fewer values. */
GNN_API bool gnn_tensor_floats(const gnn_tensor *tensor, uint64_t begin, uint64_t count, float *values);

/* A tensor to write. */
typedef struct gnn_weight {
    const char *name; /* printable ASCII without " and \ */
    uint32_t rank;
    uint64_t shape[GNN_MAX_RANK];
    const float *values; /* row-major */
    gnn_type type;       /* in the file: F32 or F16 (rounded to nearest even, beyond 65504 to infinity) */
} gnn_weight;

/* [any thread] Bytes of the file that gnn_tensors_write makes; 0 where a name, key, shape or type is not allowed.
   metadata: pairs of key, text (printable ASCII), NULL at the end; or NULL. */
GNN_API size_t gnn_tensors_bound(const gnn_weight *weights, uint32_t count, const char *const *metadata);
/* [any thread] Writes a safetensors file, tensors in the order given, to buffer; *written tells its size. */
GNN_API gnn_result gnn_tensors_write(const gnn_weight *weights, uint32_t count, const char *const *metadata,
                                     void *buffer, size_t size, size_t *written);

/* [any thread] IEEE binary16 to and from float; subnormals, infinities and NaN included. */
GNN_API float gnn_float_of_half(uint16_t half);
GNN_API uint16_t gnn_half_of_float(float value);

/* ---- >>layers ----------------------------------------------------------------------------------------------- */

/* A map of features over (z, phi): data[height + 2][width + 2][stride], rows are z, columns phi, the first `channels`
   floats of a pixel count and the others are 0. One pixel of halo lies around it: phi wraps, and beyond a pole the map
   goes on at phi + pi, so that row -1 is row 0 turned by width / 2. */
/* [any thread] Floats from one pixel to the next: channels rounded up to a multiple of 8. */
GNN_API uint32_t gnn_stride(uint32_t channels);
/* [any thread] Floats of one map, halo included. */
GNN_API size_t gnn_map_floats(uint32_t width, uint32_t height, uint32_t stride);
/* [any thread] Writes the halo of a map from its inside. */
GNN_API void gnn_map_halo(float *map, uint32_t width, uint32_t height, uint32_t stride);
/* [any thread] Copies planes[channels][height][width] into the inside of a map and writes the halo, or back. */
GNN_API void gnn_map_from_planes(const float *planes, uint32_t width, uint32_t height, uint32_t channels,
                                 uint32_t stride, float *map);
GNN_API void gnn_map_to_planes(const float *map, uint32_t width, uint32_t height, uint32_t channels, uint32_t stride,
                               float *planes);

/* A 3x3 convolution of one map or of the concatenation (map of half the size, each pixel read as 2x2; map), which is
   never written to memory:
     out[y][x][o] = f(scale[y][x] * sum over ky, kx, i of w[ky][kx][i][o] in[y + ky - 1][x + kx - 1][i]
                      + [scale[y][x] > 0] bias[o] + add[y][x][o]),   f = max(., 0) if relu, else itself
   scale: see gnn_mask_grow; NULL = 1. add: a residual; NULL = 0. width must be even, of a multiple of 4 if up > 0. */
typedef struct gnn_conv {
    uint32_t width, height;   /* of the output; 2 .. 4096, 1 .. 4096 */
    uint32_t up, up_stride;   /* channels of the map of half the size, 0 = none; its floats a pixel */
    uint32_t in, in_stride;   /* channels of the map of full size, 0 = none; its floats a pixel (any number >= in) */
    uint32_t out, out_stride; /* gnn_stride(out) */
    bool relu;
    gnn_simd simd; /* resolved, see gnn_resolve_simd */
} gnn_conv;

/* The maps of a call, all with halo (add and out: it is not read). dmaps of the backward pass have the same shapes. */
typedef struct gnn_conv_maps {
    const float *up, *in; /* NULL where conv.up, conv.in is 0 */
    const float *scale;   /* [height][width] or NULL */
    const float *add;     /* or NULL */
    float *out;           /* written, halo too */
} gnn_conv_maps;

/* Weights are stored as floats w_up[3][3][up_stride][out_stride], w_in[3][3][in_stride][out_stride], bias[out_stride];
   those beyond up, in, out are 0 (and their gradients are). */
/* [any thread] GNN_BAD_SHAPE, GNN_BAD_RANGE or GNN_OK. */
GNN_API gnn_result gnn_conv_check(const gnn_conv *conv);
/* [any thread] Floats of the weights, of what gnn_conv_prepare derives from them, and of a call's scratch. */
GNN_API size_t gnn_conv_weights(const gnn_conv *conv);
GNN_API size_t gnn_conv_prepared(const gnn_conv *conv);
GNN_API size_t gnn_conv_scratch(const gnn_conv *conv);
/* [any thread] From PyTorch's order, kernel[out][up + in][3][3] and bias[out] (NULL = 0), and back. */
GNN_API void gnn_conv_import(const gnn_conv *conv, const float *kernel, const float *bias, float *weights);
GNN_API void gnn_conv_export(const gnn_conv *conv, const float *weights, float *kernel, float *bias);
/* [any thread] To be called after each change of the weights. */
GNN_API void gnn_conv_prepare(const gnn_conv *conv, const float *weights, float *prepared);
/* [any thread] One map. */
GNN_API void gnn_conv_forward(const gnn_conv *conv, const float *weights, const float *prepared,
                              const gnn_conv_maps *maps, float *scratch);
/* [any thread] Gradients of a loss by what went in, from dout, its gradient by maps->out (without halo; it is
   overwritten: turned into the gradient before relu and scale). din, dup, dadd (each may be NULL) and dweights are
   added to; halos are not part of them. */
GNN_API void gnn_conv_backward(const gnn_conv *conv, const float *weights, const float *prepared,
                               const gnn_conv_maps *maps, float *dout, float *dup, float *din, float *dadd,
                               float *dweights, float *scratch);

#ifdef __cplusplus
}
#endif
#endif /* GUIDE_NN_H */

/* ============================================== IMPLEMENTATION ============================================== */

#if defined(GNN_IMPLEMENTATION) && !defined(GNN_IMPLEMENTATION_DONE)
#define GNN_IMPLEMENTATION_DONE

/* Based on: Goto and van de Geijn 2008 (register tiles), Lavin and Gray 2016 (Winograd convolutions), Liu et al. 2018
   (partial convolutions). */

#include <stdlib.h>

#ifndef GNN_ASSERT
#include <assert.h>
#define GNN_ASSERT(x) assert(x)
#endif
#ifndef GNN_MALLOC
#define GNN_MALLOC(n) malloc(n)
#define GNN_FREE(p) free(p)
#endif

#if !defined(GNN_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__x86_64__)
#define GNNI_X86 1
#include <immintrin.h>
#else
#define GNNI_X86 0
#endif
#if !defined(GNN_NO_SIMD) && (defined(__GNUC__) || defined(__clang__)) && defined(__aarch64__)
#define GNNI_NEON 1
#include <arm_neon.h>
#else
#define GNNI_NEON 0
#endif
#if defined(__clang__)
#define GNNI_UNROLL _Pragma("clang loop unroll(full)")
#elif defined(__GNUC__)
#define GNNI_UNROLL _Pragma("GCC unroll 16")
#else
#define GNNI_UNROLL
#endif

/* ---- >>levels ----------------------------------------------------------------------------------------------- */

GNN_API const char *gnn_result_string(gnn_result result)
{
#define GNN_RESULT_TEXT(name, text) text,
    static const char *const texts[] = {GNN_RESULTS(GNN_RESULT_TEXT) ""};
#undef GNN_RESULT_TEXT
    return (unsigned)result < (unsigned)GNN_RESULT_COUNT ? texts[result] : "unknown result";
}

GNN_API gnn_simd gnn_resolve_simd(gnn_simd wanted)
{
#if GNNI_X86
    bool avx2, avx512;
    __builtin_cpu_init();
    avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
             __builtin_cpu_supports("avx512vl");
    if (wanted == GNN_SIMD_AUTO)
        return avx512 ? GNN_SIMD_AVX512 : avx2 ? GNN_SIMD_AVX2 : GNN_SIMD_SCALAR;
    if (wanted == GNN_SIMD_AVX2)
        return avx2 ? wanted : GNN_SIMD_AUTO;
    if (wanted == GNN_SIMD_AVX512)
        return avx512 ? wanted : GNN_SIMD_AUTO;
#elif GNNI_NEON
    if (wanted == GNN_SIMD_AUTO || wanted == GNN_SIMD_NEON)
        return GNN_SIMD_NEON;
#else
    if (wanted == GNN_SIMD_AUTO)
        return GNN_SIMD_SCALAR;
#endif
    return wanted == GNN_SIMD_SCALAR ? wanted : GNN_SIMD_AUTO;
}

/* ---- >>tiles ------------------------------------------------------------------------------------------------ */

/* All dense work is sums of small matrix products, c[rows][columns] = tail(sum over terms of a b):
   a[row * row_step + k * k_step], b[k * b_step + column]. A 3x3 convolution has one term per row of its kernel: in a
   map the three pixels of a row are 3 stride contiguous floats. */
typedef struct gnni_term {
    const float *a, *b;
    ptrdiff_t row_step, k_step, b_step;
    uint32_t k;
} gnni_term;

typedef struct gnni_product {
    gnni_term terms[9];
    uint32_t count, rows, columns; /* columns: a multiple of 8 */
    bool keep;                     /* add to what c holds */
    float *c;
    ptrdiff_t c_step;
    /* tail: c = f(scale c + [scale > 0] bias + add) */
    bool relu;
    const float *bias, *scale, *add; /* each may be NULL; scale[row * scale_step]; add[row * c_step + column] */
    ptrdiff_t scale_step;
} gnni_product;

/* A tile of R rows and NV vectors of columns stays in registers over all terms. Each element is summed in the same
   order whatever tile it is in, so that results do not depend on how rows are cut. */
#define GNNI_TILE(L, NV, R)                                                                                            \
    GNNI_##L##_TARGET static void gnni_tile_##L##_##NV##_##R(const gnni_product *p, uint32_t row, uint32_t column)     \
    {                                                                                                                  \
        GNNI_##L##_V acc[R][NV], w[NV], x;                                                                             \
        float *c = p->c + (ptrdiff_t)row * p->c_step + column;                                                         \
        const gnni_term *t = p->terms, *end = t + p->count;                                                            \
        const float *add = p->add ? p->add + (c - p->c) : NULL;                                                        \
        int r, v;                                                                                                      \
        GNNI_UNROLL for (r = 0; r < R; ++r) GNNI_UNROLL for (v = 0; v < NV; ++v) acc[r][v] =                           \
            p->keep ? GNNI_##L##_LOAD(c + r * p->c_step + v * GNNI_##L##_W) : GNNI_##L##_SET(0);                       \
        for (; t < end; ++t) {                                                                                         \
            const float *a = t->a + (ptrdiff_t)row * t->row_step, *b = t->b + column;                                  \
            ptrdiff_t row_step = t->row_step, k_step = t->k_step, b_step = t->b_step;                                  \
            uint32_t k;                                                                                                \
            for (k = t->k; k > 0; --k, a += k_step, b += b_step) {                                                     \
                GNNI_UNROLL for (v = 0; v < NV; ++v) w[v] = GNNI_##L##_LOAD(b + v * GNNI_##L##_W);                     \
                GNNI_UNROLL for (r = 0; r < R; ++r)                                                                    \
                {                                                                                                      \
                    x = GNNI_##L##_SET(a[r * row_step]);                                                               \
                    GNNI_UNROLL for (v = 0; v < NV; ++v) acc[r][v] = GNNI_##L##_FMA(x, w[v], acc[r][v]);               \
                }                                                                                                      \
            }                                                                                                          \
        }                                                                                                              \
        GNNI_UNROLL for (r = 0; r < R; ++r)                                                                            \
        {                                                                                                              \
            float scale = p->scale ? p->scale[((ptrdiff_t)row + r) * p->scale_step] : 1;                               \
            GNNI_UNROLL for (v = 0; v < NV; ++v)                                                                       \
            {                                                                                                          \
                x = acc[r][v];                                                                                         \
                if (p->scale)                                                                                          \
                    x = GNNI_##L##_MUL(x, GNNI_##L##_SET(scale));                                                      \
                if (p->bias && scale > 0)                                                                              \
                    x = GNNI_##L##_ADD(x, GNNI_##L##_LOAD(p->bias + column + v * GNNI_##L##_W));                       \
                if (add)                                                                                               \
                    x = GNNI_##L##_ADD(x, GNNI_##L##_LOAD(add + r * p->c_step + v * GNNI_##L##_W));                    \
                if (p->relu)                                                                                           \
                    x = GNNI_##L##_MAX0(x);                                                                            \
                GNNI_##L##_STORE(c + r * p->c_step + v * GNNI_##L##_W, x);                                             \
            }                                                                                                          \
        }                                                                                                              \
    }

/* Columns column .. column + NV * width - 1, all rows, in tiles of R, then R2 rows, then one by one. */
#define GNNI_ROWS(L, NV, R, R2)                                                                                        \
    GNNI_##L##_TARGET static void gnni_rows_##L##_##NV(const gnni_product *p, uint32_t column)                         \
    {                                                                                                                  \
        uint32_t row = 0;                                                                                              \
        for (; row + R <= p->rows; row += R)                                                                           \
            gnni_tile_##L##_##NV##_##R(p, row, column);                                                                \
        for (; row + R2 <= p->rows; row += R2)                                                                         \
            gnni_tile_##L##_##NV##_##R2(p, row, column);                                                               \
        for (; row < p->rows; ++row)                                                                                   \
            gnni_tile_##L##_##NV##_1(p, row, column);                                                                  \
    }

/* Scalar: "vectors" of 8 floats that compilers may or may not make vectors of. */
typedef struct gnni_eight {
    float v[8];
} gnni_eight;
static inline gnni_eight gnni_eight_load(const float *p)
{
    gnni_eight r;
    memcpy(r.v, p, sizeof r.v);
    return r;
}
static inline gnni_eight gnni_eight_set(float x)
{
    gnni_eight r;
    int i;
    for (i = 0; i < 8; ++i)
        r.v[i] = x;
    return r;
}
static inline gnni_eight gnni_eight_add(gnni_eight a, gnni_eight b)
{
    int i;
    for (i = 0; i < 8; ++i)
        a.v[i] += b.v[i];
    return a;
}
static inline gnni_eight gnni_eight_mul(gnni_eight a, gnni_eight b)
{
    int i;
    for (i = 0; i < 8; ++i)
        a.v[i] *= b.v[i];
    return a;
}
static inline gnni_eight gnni_eight_max0(gnni_eight a)
{
    int i;
    for (i = 0; i < 8; ++i)
        a.v[i] = a.v[i] < 0 ? 0 : a.v[i]; /* NaN stays, as with the vector instructions */
    return a;
}
#define GNNI_SCALAR_TARGET
#define GNNI_SCALAR_V gnni_eight
#define GNNI_SCALAR_W 8
#define GNNI_SCALAR_LOAD(p) gnni_eight_load(p)
#define GNNI_SCALAR_STORE(p, x) memcpy(p, (x).v, sizeof(gnni_eight))
#define GNNI_SCALAR_SET(x) gnni_eight_set(x)
#define GNNI_SCALAR_FMA(a, b, c) gnni_eight_add(gnni_eight_mul(a, b), c)
#define GNNI_SCALAR_ADD(a, b) gnni_eight_add(a, b)
#define GNNI_SCALAR_MUL(a, b) gnni_eight_mul(a, b)
#define GNNI_SCALAR_MAX0(x) gnni_eight_max0(x)
GNNI_TILE(SCALAR, 1, 4)
GNNI_TILE(SCALAR, 1, 1)
GNNI_ROWS(SCALAR, 1, 4, 4)

#if GNNI_X86
#define GNNI_AVX2_TARGET __attribute__((target("avx2,fma")))
#define GNNI_AVX2_V __m256
#define GNNI_AVX2_W 8
#define GNNI_AVX2_LOAD(p) _mm256_loadu_ps(p)
#define GNNI_AVX2_STORE(p, x) _mm256_storeu_ps(p, x)
#define GNNI_AVX2_SET(x) _mm256_set1_ps(x)
#define GNNI_AVX2_FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define GNNI_AVX2_ADD(a, b) _mm256_add_ps(a, b)
#define GNNI_AVX2_MUL(a, b) _mm256_mul_ps(a, b)
#define GNNI_AVX2_MAX0(x) _mm256_max_ps(_mm256_setzero_ps(), x)
GNNI_TILE(AVX2, 1, 8)
GNNI_TILE(AVX2, 1, 4)
GNNI_TILE(AVX2, 1, 1)
GNNI_ROWS(AVX2, 1, 8, 4)
GNNI_TILE(AVX2, 2, 4)
GNNI_TILE(AVX2, 2, 1)
GNNI_ROWS(AVX2, 2, 4, 4)

#define GNNI_AVX512_TARGET __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma")))
#define GNNI_AVX512_V __m512
#define GNNI_AVX512_W 16
#define GNNI_AVX512_LOAD(p) _mm512_loadu_ps(p)
#define GNNI_AVX512_STORE(p, x) _mm512_storeu_ps(p, x)
#define GNNI_AVX512_SET(x) _mm512_set1_ps(x)
#define GNNI_AVX512_FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define GNNI_AVX512_ADD(a, b) _mm512_add_ps(a, b)
#define GNNI_AVX512_MUL(a, b) _mm512_mul_ps(a, b)
/* gcc 12 takes what _mm512_max_ps leaves undefined, and nobody reads, for uninitialised. */
#define GNNI_AVX512_MAX0(x) _mm512_maskz_max_ps(0xffff, _mm512_setzero_ps(), x)
GNNI_TILE(AVX512, 1, 16)
GNNI_TILE(AVX512, 1, 8)
GNNI_TILE(AVX512, 1, 1)
GNNI_ROWS(AVX512, 1, 16, 8)
GNNI_TILE(AVX512, 2, 8)
GNNI_TILE(AVX512, 2, 4)
GNNI_TILE(AVX512, 2, 1)
GNNI_ROWS(AVX512, 2, 8, 4)
#endif

#if GNNI_NEON
#define GNNI_NEON_TARGET
#define GNNI_NEON_V float32x4_t
#define GNNI_NEON_W 4
#define GNNI_NEON_LOAD(p) vld1q_f32(p)
#define GNNI_NEON_STORE(p, x) vst1q_f32(p, x)
#define GNNI_NEON_SET(x) vdupq_n_f32(x)
#define GNNI_NEON_FMA(a, b, c) vfmaq_f32(c, a, b)
#define GNNI_NEON_ADD(a, b) vaddq_f32(a, b)
#define GNNI_NEON_MUL(a, b) vmulq_f32(a, b)
#define GNNI_NEON_MAX0(x) vmaxq_f32(x, vdupq_n_f32(0))
GNNI_TILE(NEON, 2, 8)
GNNI_TILE(NEON, 2, 4)
GNNI_TILE(NEON, 2, 1)
GNNI_ROWS(NEON, 2, 8, 4)
#endif

static void gnni_multiply(const gnni_product *p, gnn_simd simd)
{
    uint32_t column = 0;
#if GNNI_X86
    if (simd == GNN_SIMD_AVX512) {
        for (; column + 32 <= p->columns; column += 32)
            gnni_rows_AVX512_2(p, column);
        for (; column + 16 <= p->columns; column += 16)
            gnni_rows_AVX512_1(p, column);
    }
    if (simd == GNN_SIMD_AVX512 || simd == GNN_SIMD_AVX2) {
        for (; column + 16 <= p->columns; column += 16)
            gnni_rows_AVX2_2(p, column);
        for (; column < p->columns; column += 8)
            gnni_rows_AVX2_1(p, column);
    }
#elif GNNI_NEON
    if (simd == GNN_SIMD_NEON)
        for (; column < p->columns; column += 8)
            gnni_rows_NEON_2(p, column);
#endif
    (void)simd;
    for (; column < p->columns; column += 8)
        gnni_rows_SCALAR_1(p, column);
}

/* ---- >>maps ------------------------------------------------------------------------------------------------- */

GNN_API uint32_t gnn_stride(uint32_t channels) { return (channels + 7) & ~7u; }

GNN_API size_t gnn_map_floats(uint32_t width, uint32_t height, uint32_t stride)
{
    return (size_t)(width + 2) * (height + 2) * stride;
}

/* Floats from the map's start to pixel (x, y), which may lie in the halo. */
static size_t gnni_at(uint32_t width, uint32_t stride, int64_t x, int64_t y)
{
    return (size_t)((y + 1) * ((int64_t)width + 2) + x + 1) * stride;
}

GNN_API void gnn_map_halo(float *map, uint32_t width, uint32_t height, uint32_t stride)
{
    size_t row = (size_t)(width + 2) * stride, pixel = stride * sizeof(float), half = (size_t)(width / 2) * pixel;
    uint32_t y;
    int pole;
    for (y = 1; y <= height; ++y) {
        memcpy(map + y * row, map + y * row + (size_t)width * stride, pixel);
        memcpy(map + y * row + (size_t)(width + 1) * stride, map + y * row + stride, pixel);
    }
    for (pole = 0; pole < 2; ++pole) { /* pixels -1 .. width of it are those -1 + width / 2 .. of the row inside */
        float *to = map + (pole ? (height + 1) * row : 0);
        const float *from = map + (pole ? height : 1) * row;
        memcpy(to, from + (size_t)(width / 2) * stride, pixel);
        memcpy(to + stride, from + (size_t)(width / 2 + 1) * stride, half);
        memcpy(to + (size_t)(width / 2 + 1) * stride, from + stride, half);
        memcpy(to + (size_t)(width + 1) * stride, from + (size_t)(width / 2 + 1) * stride, pixel);
    }
}

GNN_API void gnn_map_from_planes(const float *planes, uint32_t width, uint32_t height, uint32_t channels,
                                 uint32_t stride, float *map)
{
    uint32_t x, y, c;
    for (y = 0; y < height; ++y)
        for (x = 0; x < width; ++x) {
            float *pixel = map + gnni_at(width, stride, x, y);
            for (c = 0; c < channels; ++c)
                pixel[c] = planes[((size_t)c * height + y) * width + x];
            for (; c < stride; ++c)
                pixel[c] = 0;
        }
    gnn_map_halo(map, width, height, stride);
}

GNN_API void gnn_map_to_planes(const float *map, uint32_t width, uint32_t height, uint32_t channels, uint32_t stride,
                               float *planes)
{
    uint32_t x, y, c;
    for (y = 0; y < height; ++y)
        for (x = 0; x < width; ++x)
            for (c = 0; c < channels; ++c)
                planes[((size_t)c * height + y) * width + x] = map[gnni_at(width, stride, x, y) + c];
}

/* ---- >>convolution ------------------------------------------------------------------------------------------ */

/* Columns are worked on in pieces of 32, 16 or 8; packed weights have a piece's columns side by side. */
static uint32_t gnni_piece(uint32_t columns) { return columns >= 32 ? 32 : columns >= 16 ? 16 : 8; }

GNN_API gnn_result gnn_conv_check(const gnn_conv *c)
{
    if (c->width < 2 || c->width > 4096 || c->height < 1 || c->height > 4096 || c->width % 2)
        return GNN_BAD_SHAPE;
    if (c->up && (c->width % 4 || c->height % 2))
        return GNN_BAD_SHAPE;
    if (c->up + c->in == 0 || c->up > 4096 || c->in > 4096 || c->out < 1 || c->out > 4096 || c->in_stride > 8192 ||
        c->in_stride < c->in || (c->up && c->up_stride != gnn_stride(c->up)) || c->out_stride != gnn_stride(c->out))
        return GNN_BAD_RANGE;
    return GNN_OK;
}

static size_t gnni_in_weights(const gnn_conv *c) { return c->in ? (size_t)9 * c->in_stride * c->out_stride : 0; }
static size_t gnni_up_weights(const gnn_conv *c) { return c->up ? (size_t)9 * c->up_stride * c->out_stride : 0; }

GNN_API size_t gnn_conv_weights(const gnn_conv *c) { return gnni_up_weights(c) + gnni_in_weights(c) + c->out_stride; }

/* The place of w[ky][kx][channel][o], channels counted through up, then in. */
static float *gnni_weight(const gnn_conv *c, float *weights, uint32_t tap, uint32_t channel, uint32_t o)
{
    if (channel < c->up)
        return weights + ((size_t)tap * c->up_stride + channel) * c->out_stride + o;
    return weights + gnni_up_weights(c) + ((size_t)tap * c->in_stride + channel - c->up) * c->out_stride + o;
}

GNN_API void gnn_conv_import(const gnn_conv *c, const float *kernel, const float *bias, float *weights)
{
    uint32_t o, i, tap;
    memset(weights, 0, gnn_conv_weights(c) * sizeof(float));
    for (o = 0; o < c->out; ++o)
        for (i = 0; i < c->up + c->in; ++i)
            for (tap = 0; tap < 9; ++tap)
                *gnni_weight(c, weights, tap, i, o) = kernel[((size_t)o * (c->up + c->in) + i) * 9 + tap];
    for (o = 0; bias && o < c->out; ++o)
        weights[gnni_up_weights(c) + gnni_in_weights(c) + o] = bias[o];
}

GNN_API void gnn_conv_export(const gnn_conv *c, const float *weights, float *kernel, float *bias)
{
    uint32_t o, i, tap;
    float *w = (float *)weights; /* gnni_weight serves reading and writing */
    for (o = 0; o < c->out; ++o)
        for (i = 0; i < c->up + c->in; ++i)
            for (tap = 0; tap < 9; ++tap)
                kernel[((size_t)o * (c->up + c->in) + i) * 9 + tap] = *gnni_weight(c, w, tap, i, o);
    for (o = 0; bias && o < c->out; ++o)
        bias[o] = weights[gnni_up_weights(c) + gnni_in_weights(c) + o];
}

/* What prepare derives, in this order. Upsampling: pixels of the output of equal parity (y & 1, x & 1) see the small
   map through a 2x2 kernel whose weights are sums of those of the 3x3 kernel: 4 multiplications for 9. */
typedef struct gnni_prepared {
    size_t up;      /* [4 parities][2x2][up_stride][out_stride] */
    size_t in;      /* [9][in_stride][out_stride] in pieces */
    size_t back_up; /* [9 taps][out_stride][up_stride] in pieces of each tap, taps as in the forward pass */
    size_t back_in; /* the same with in_stride; only where that is a multiple of 8 */
    size_t total;
} gnni_prepared;

static bool gnni_has_back(const gnn_conv *c) { return c->in && c->in_stride % 8 == 0; }

static gnni_prepared gnni_layout(const gnn_conv *c)
{
    gnni_prepared p;
    p.up = 0;
    p.in = p.up + (c->up ? (size_t)16 * c->up_stride * c->out_stride : 0);
    p.back_up = p.in + gnni_in_weights(c);
    p.back_in = p.back_up + gnni_up_weights(c);
    p.total = p.back_in + (gnni_has_back(c) ? gnni_in_weights(c) : 0);
    return p;
}

GNN_API size_t gnn_conv_prepared(const gnn_conv *c) { return gnni_layout(c).total; }

/* w[k][columns] to pieces. */
static void gnni_pack(const float *w, size_t k, uint32_t columns, float *packed)
{
    uint32_t column, piece;
    size_t i;
    for (column = 0; column < columns; column += piece) {
        piece = gnni_piece(columns - column);
        for (i = 0; i < k; ++i)
            memcpy(packed + (size_t)column * k + i * piece, w + i * columns + column, piece * sizeof(float));
    }
}

/* w[rows][columns] of one tap to pieces of its transpose. */
static void gnni_pack_transposed(const float *w, uint32_t rows, uint32_t columns, float *packed)
{
    uint32_t row, piece, i, j;
    for (row = 0; row < rows; row += piece) {
        piece = gnni_piece(rows - row);
        for (i = 0; i < columns; ++i)
            for (j = 0; j < piece; ++j)
                packed[(size_t)row * columns + (size_t)i * piece + j] = w[(size_t)(row + j) * columns + i];
    }
}

/* Tap 0 .. 2 of a row or column of the 3x3 kernel, seen from a pixel of that parity, falls on pixel 0 or 1 of the two
   of the small map: (parity + tap - 1) >> 1 is -1, 0 or 1; counted from -1 + parity. */
static uint32_t gnni_small_tap(uint32_t parity, uint32_t tap) { return ((parity + tap + 1) >> 1) - parity; }

static void gnni_prepare_up(const gnn_conv *c, const float *weights, float *up, float *sums)
{
    size_t tap_floats = (size_t)c->up_stride * c->out_stride, i;
    uint32_t parity, tap;
    for (parity = 0; parity < 4; ++parity) {
        memset(sums, 0, 4 * tap_floats * sizeof(float));
        for (tap = 0; tap < 9; ++tap) {
            uint32_t small = 2 * gnni_small_tap(parity >> 1, tap / 3) + gnni_small_tap(parity & 1, tap % 3);
            for (i = 0; i < tap_floats; ++i)
                sums[small * tap_floats + i] += weights[tap * tap_floats + i];
        }
        gnni_pack(sums, (size_t)4 * c->up_stride, c->out_stride, up + 4 * parity * tap_floats);
    }
}

GNN_API void gnn_conv_prepare(const gnn_conv *c, const float *weights, float *prepared)
{
    gnni_prepared at = gnni_layout(c);
    const float *in = weights + gnni_up_weights(c);
    size_t up_tap = (size_t)c->up_stride * c->out_stride, in_tap = (size_t)c->in_stride * c->out_stride;
    uint32_t tap;
    if (c->up) /* back_up is large enough to hold the sums on the way */
        gnni_prepare_up(c, weights, prepared + at.up, prepared + at.back_up);
    if (c->in)
        gnni_pack(in, (size_t)9 * c->in_stride, c->out_stride, prepared + at.in);
    for (tap = 0; tap < 9; ++tap) {
        if (c->up)
            gnni_pack_transposed(weights + tap * up_tap, c->up_stride, c->out_stride,
                                 prepared + at.back_up + tap * up_tap);
        if (gnni_has_back(c))
            gnni_pack_transposed(in + tap * in_tap, c->in_stride, c->out_stride, prepared + at.back_in + tap * in_tap);
    }
}

/* Add the term that reads k contiguous floats a row. */
static void gnni_term_add(gnni_product *p, const float *a, size_t row_step, const float *b, uint32_t b_step, uint32_t k)
{
    gnni_term *t = &p->terms[p->count++];
    t->a = a;
    t->b = b;
    t->row_step = (ptrdiff_t)row_step;
    t->k_step = 1;
    t->b_step = (ptrdiff_t)b_step;
    t->k = k;
}

/* A row of outputs: all pixels, or with up those of one parity; columns of one piece. */
static void gnni_forward_row(const gnn_conv *c, const float *prepared, const gnn_conv_maps *m, gnni_product *p,
                             uint32_t y, uint32_t parity, uint32_t column)
{
    gnni_prepared at = gnni_layout(c);
    uint32_t step = c->up ? 2 : 1, piece = gnni_piece(c->out_stride - column), k, ky;
    size_t out = gnni_at(c->width, c->out_stride, parity & 1, y) + column;
    p->count = 0;
    if (c->up) {
        const float *b = prepared + at.up + (size_t)4 * parity * c->up_stride * c->out_stride;
        b += (size_t)4 * c->up_stride * column;
        k = 2 * c->up_stride;
        for (ky = 0; ky < 2; ++ky)
            gnni_term_add(p,
                          m->up + gnni_at(c->width / 2, c->up_stride, (int64_t)(parity & 1) - 1,
                                          (int64_t)(y / 2 + ky + (y & 1)) - 1),
                          c->up_stride, b + (size_t)ky * k * piece, piece, k);
    }
    if (c->in) {
        const float *b = prepared + at.in + (size_t)9 * c->in_stride * column;
        k = 3 * c->in_stride;
        for (ky = 0; ky < 3; ++ky)
            gnni_term_add(p, m->in + gnni_at(c->width, c->in_stride, (int64_t)(parity & 1) - 1, (int64_t)(y + ky) - 1),
                          (size_t)step * c->in_stride, b + (size_t)ky * k * piece, piece, k);
    }
    p->rows = c->width / step;
    p->columns = piece;
    p->c = m->out + out;
    p->c_step = (ptrdiff_t)(step * c->out_stride);
    p->add = m->add ? m->add + out : NULL;
    p->scale = m->scale ? m->scale + (size_t)y * c->width + (parity & 1) : NULL;
    p->scale_step = (ptrdiff_t)step;
}

GNN_API void gnn_conv_forward(const gnn_conv *c, const float *weights, const float *prepared, const gnn_conv_maps *m,
                              float *scratch)
{
    gnni_product p;
    const float *bias = weights + gnni_up_weights(c) + gnni_in_weights(c);
    uint32_t y, column, x;
    (void)scratch;
    GNN_ASSERT(gnn_conv_check(c) == GNN_OK);
    memset(&p, 0, sizeof p);
    p.relu = c->relu;
    for (column = 0; column < c->out_stride; column += p.columns)
        for (y = 0; y < c->height; ++y)
            for (x = 0; x < (c->up ? 2u : 1u); ++x) {
                gnni_forward_row(c, prepared, m, &p, y, c->up ? 2 * (y & 1) + x : 0, column);
                p.bias = bias + column;
                gnni_multiply(&p, c->simd);
            }
    gnn_map_halo(m->out, c->width, c->height, c->out_stride);
}

/* ---- >>backward --------------------------------------------------------------------------------------------- */

GNN_API size_t gnn_conv_scratch(const gnn_conv *c)
{
    size_t small = c->up ? (size_t)16 * c->up_stride * c->out_stride : 0;
    size_t large = c->up ? gnn_map_floats(c->width, c->height, c->up_stride) : 0;
    return small > large ? small : large;
}

/* dout becomes the gradient by the sum before scale; what bias and add get from it on the way. */
static void gnni_backward_tail(const gnn_conv *c, const gnn_conv_maps *m, float *dout, float *dadd, float *dbias)
{
    uint32_t x, y, o;
    for (y = 0; y < c->height; ++y)
        for (x = 0; x < c->width; ++x) {
            size_t at = gnni_at(c->width, c->out_stride, x, y);
            float scale = m->scale ? m->scale[(size_t)y * c->width + x] : 1, one = scale > 0 ? 1.0f : 0.0f;
            for (o = 0; o < c->out_stride; ++o) {
                float d = c->relu && !(m->out[at + o] > 0) ? 0 : dout[at + o];
                if (dadd)
                    dadd[at + o] += d;
                dbias[o] += one * d;
                dout[at + o] = scale * d;
            }
        }
    gnn_map_halo(dout, c->width, c->height, c->out_stride);
}

/* din += the adjoint of the convolution with w, in pieces back[tap][out][channels]. Inside, it is a convolution of dout
   with the kernel turned by 180 degrees. Across a pole the map is turned, so that what lies beyond reaches this row
   through the same row of the kernel that this row reaches beyond with: rows 0 and height - 1 use another order. */
static void gnni_backward_map(const gnn_conv *c, const float *back, uint32_t stride, const float *dout, float *din)
{
    gnni_product p;
    uint32_t y, column, ky, kx, k = c->out_stride;
    memset(&p, 0, sizeof p);
    p.keep = true;
    for (column = 0; column < stride; column += p.columns)
        for (y = 0; y < c->height; ++y) {
            uint32_t piece = gnni_piece(stride - column);
            p.count = 0;
            for (ky = 0; ky < 3; ++ky) {
                int64_t from = (int64_t)(y + ky) - 1;
                uint32_t row = from < 0 ? 0 : from >= c->height ? 2 : 2 - ky;
                for (kx = 0; kx < 3; ++kx)
                    gnni_term_add(&p, dout + gnni_at(c->width, k, (int64_t)kx - 1, from), k,
                                  back + (size_t)(3 * row + 2 - kx) * stride * k + (size_t)column * k, piece, k);
            }
            p.rows = c->width;
            p.columns = piece;
            p.c = din + gnni_at(c->width, stride, 0, y) + column;
            p.c_step = (ptrdiff_t)stride;
            gnni_multiply(&p, c->simd);
        }
}

/* dw[rows][out_stride] += sum over n pixels of a row of a map, a[pixel * a_step + row], times those of dout. */
static void gnni_backward_weights(const gnn_conv *c, const float *a, size_t a_step, uint32_t rows, const float *dout,
                                  size_t d_step, uint32_t n, float *dw)
{
    gnni_product p;
    gnni_term *t = p.terms;
    memset(&p, 0, sizeof p);
    t->a = a;
    t->b = dout;
    t->row_step = 1;
    t->k_step = (ptrdiff_t)a_step;
    t->b_step = (ptrdiff_t)d_step;
    t->k = n;
    p.count = 1;
    p.keep = true;
    p.rows = rows;
    p.columns = c->out_stride;
    p.c = dw;
    p.c_step = (ptrdiff_t)c->out_stride;
    gnni_multiply(&p, c->simd);
}

/* Through the 2x2 kernels of the four parities, whose gradients go to all 3x3 taps that they are sums of. */
static void gnni_backward_up_weights(const gnn_conv *c, const float *up, const float *dout, float *dw, float *small)
{
    size_t tap_floats = (size_t)c->up_stride * c->out_stride, i;
    uint32_t parity, tap, y;
    memset(small, 0, 16 * tap_floats * sizeof(float));
    for (y = 0; y < c->height; ++y)
        for (parity = 2 * (y & 1); parity < 2 * (y & 1) + 2; ++parity)
            for (tap = 0; tap < 4; ++tap)
                gnni_backward_weights(c,
                                      up + gnni_at(c->width / 2, c->up_stride, (int64_t)((parity & 1) + (tap & 1)) - 1,
                                                   (int64_t)(y / 2 + (y & 1) + (tap >> 1)) - 1),
                                      c->up_stride, c->up_stride,
                                      dout + gnni_at(c->width, c->out_stride, parity & 1, y), (size_t)2 * c->out_stride,
                                      c->width / 2, small + (4 * parity + tap) * tap_floats);
    for (parity = 0; parity < 4; ++parity)
        for (tap = 0; tap < 9; ++tap) {
            const float *from =
                small + (4 * parity + 2 * gnni_small_tap(parity >> 1, tap / 3) + gnni_small_tap(parity & 1, tap % 3)) *
                            tap_floats;
            for (i = 0; i < tap_floats; ++i)
                dw[tap * tap_floats + i] += from[i];
        }
}

static void gnni_backward_up(const gnn_conv *c, const float *back, const float *dout, float *dup, float *large)
{
    uint32_t x, y, i;
    memset(large, 0, gnn_map_floats(c->width, c->height, c->up_stride) * sizeof(float));
    gnni_backward_map(c, back, c->up_stride, dout, large);
    for (y = 0; y < c->height / 2; ++y)
        for (x = 0; x < c->width / 2; ++x) {
            const float *a = large + gnni_at(c->width, c->up_stride, 2 * (int64_t)x, 2 * (int64_t)y);
            const float *b = a + (size_t)(c->width + 2) * c->up_stride;
            float *to = dup + gnni_at(c->width / 2, c->up_stride, x, y);
            for (i = 0; i < c->up_stride; ++i)
                to[i] += (a[i] + a[c->up_stride + i]) + (b[i] + b[c->up_stride + i]);
        }
}

GNN_API void gnn_conv_backward(const gnn_conv *c, const float *weights, const float *prepared, const gnn_conv_maps *m,
                               float *dout, float *dup, float *din, float *dadd, float *dweights, float *scratch)
{
    gnni_prepared at = gnni_layout(c);
    size_t up = gnni_up_weights(c), in = gnni_in_weights(c), in_tap = (size_t)c->in_stride * c->out_stride;
    uint32_t y, tap;
    (void)weights;
    GNN_ASSERT(gnn_conv_check(c) == GNN_OK && (!din || gnni_has_back(c)));
    gnni_backward_tail(c, m, dout, dadd, dweights + up + in);
    for (tap = 0; c->in && tap < 9; ++tap)
        for (y = 0; y < c->height; ++y)
            gnni_backward_weights(
                c, m->in + gnni_at(c->width, c->in_stride, (int64_t)(tap % 3) - 1, (int64_t)(y + tap / 3) - 1),
                c->in_stride, c->in_stride, dout + gnni_at(c->width, c->out_stride, 0, y), c->out_stride, c->width,
                dweights + up + tap * in_tap);
    if (c->up)
        gnni_backward_up_weights(c, m->up, dout, dweights, scratch);
    if (din)
        gnni_backward_map(c, prepared + at.back_in, c->in_stride, dout, din);
    if (dup)
        gnni_backward_up(c, prepared + at.back_up, dout, dup, scratch);
}

/* ---- >>json ------------------------------------------------------------------------------------------------- */

/* What goes into a message: text, up to n bytes of it; what is not printable becomes "?". */
static void gnni_say(gnn_message *message, const char *text, size_t n)
{
    size_t at, i;
    if (!message)
        return;
    at = strlen(message->text);
    for (i = 0; i < n && text[i] && at + 1 < sizeof message->text; ++i)
        message->text[at++] = text[i] >= 32 && text[i] < 127 ? text[i] : '?';
    message->text[at] = 0;
}

static gnn_result gnni_fail(gnn_message *message, gnn_result result, const char *text, const gnn_tensor *tensor)
{
    if (message)
        message->text[0] = 0;
    if (tensor) {
        gnni_say(message, "tensor \"", 8);
        gnni_say(message, tensor->name, tensor->name_length < 100 ? tensor->name_length : 100);
        gnni_say(message, "\": ", 3);
    }
    gnni_say(message, text, strlen(text));
    return result;
}

typedef struct gnni_json {
    const char *at, *end;
    const char *error; /* NULL = none yet */
} gnni_json;

static bool gnni_json_error(gnni_json *j, const char *error)
{
    if (!j->error)
        j->error = error;
    return false;
}

static void gnni_json_space(gnni_json *j)
{
    while (j->at < j->end && (*j->at == ' ' || *j->at == '\t' || *j->at == '\n' || *j->at == '\r'))
        ++j->at;
}

/* Is c next? Then it is taken. */
static bool gnni_json_take(gnni_json *j, char c)
{
    gnni_json_space(j);
    if (j->at == j->end || *j->at != c)
        return false;
    ++j->at;
    return true;
}

static bool gnni_json_need(gnni_json *j, char c)
{
    return gnni_json_take(j, c) || gnni_json_error(j, "the header is not the JSON that it should be");
}

/* A string, escapes left as they stand. */
static bool gnni_json_string(gnni_json *j, const char **text, size_t *length, bool *escapes)
{
    if (!gnni_json_need(j, '"'))
        return false;
    *text = j->at;
    *escapes = false;
    for (; j->at < j->end && *j->at != '"'; ++j->at) {
        if ((unsigned char)*j->at < 32)
            return gnni_json_error(j, "a control character in a string of the header");
        if (*j->at == '\\') {
            *escapes = true;
            if (++j->at == j->end)
                break;
        }
    }
    if (j->at == j->end)
        return gnni_json_error(j, "a string of the header has no end");
    *length = (size_t)(j->at - *text);
    ++j->at;
    return true;
}

static bool gnni_json_number(gnni_json *j, uint64_t *value)
{
    const char *first;
    gnni_json_space(j);
    first = j->at;
    *value = 0;
    for (; j->at < j->end && *j->at >= '0' && *j->at <= '9'; ++j->at) {
        uint64_t digit = (uint64_t)(*j->at - '0');
        if (*value > (UINT64_MAX - digit) / 10)
            return gnni_json_error(j, "a number in the header is too large");
        *value = *value * 10 + digit;
    }
    if (j->at == first || (*first == '0' && j->at > first + 1))
        return gnni_json_error(j, "a number in the header is not a plain integer");
    return true;
}

/* An array of at most `capacity` numbers. */
static bool gnni_json_numbers(gnni_json *j, uint64_t *values, uint32_t capacity, uint32_t *count)
{
    *count = 0;
    if (!gnni_json_need(j, '['))
        return false;
    if (gnni_json_take(j, ']'))
        return true;
    do {
        if (*count == capacity)
            return gnni_json_error(j, "too many numbers in an array of the header");
        if (!gnni_json_number(j, &values[(*count)++]))
            return false;
    } while (gnni_json_take(j, ','));
    return gnni_json_need(j, ']');
}

static bool gnni_is(const char *text, size_t length, const char *word)
{
    return strlen(word) == length && memcmp(text, word, length) == 0;
}

/* ---- >>files ------------------------------------------------------------------------------------------------ */

/* Bits of an element; 0 = no such type. */
static uint32_t gnni_type_bits(const char *text, size_t length)
{
    static const char *const names[] = {"BOOL", "U8",  "I8",  "F8_E5M2", "F8_E4M3", "I16", "U16", "F16",
                                        "BF16", "I32", "U32", "F32",     "F64",     "I64", "U64"};
    static const unsigned char bits[] = {8, 8, 8, 8, 8, 16, 16, 16, 16, 32, 32, 32, 64, 64, 64};
    uint32_t i;
    for (i = 0; i < sizeof bits; ++i)
        if (gnni_is(text, length, names[i]))
            return bits[i];
    return 0;
}

/* The header's bytes; false where the file has none. */
static bool gnni_header(const void *file, size_t size, gnni_json *j, const unsigned char **data)
{
    const unsigned char *bytes = (const unsigned char *)file;
    uint64_t length = 0;
    int i;
    if (!file || size < 10)
        return false;
    for (i = 7; i >= 0; --i)
        length = length << 8 | bytes[i];
    if (length > size - 8 || length > GNN_MAX_HEADER || length < 2 || bytes[8] != '{')
        return false;
    j->at = (const char *)bytes + 8;
    j->end = j->at + length;
    j->error = NULL;
    *data = bytes + 8 + length;
    return true;
}

typedef struct gnni_entry {
    const char *type;
    size_t type_length;
    uint64_t offsets[2];
    uint32_t seen; /* bits: type, shape, offsets */
} gnni_entry;

/* One member of a tensor's object. */
static bool gnni_entry_member(gnni_json *j, gnn_tensor *t, gnni_entry *e)
{
    const char *key;
    size_t length;
    bool escapes;
    uint32_t count, bit;
    if (!gnni_json_string(j, &key, &length, &escapes) || !gnni_json_need(j, ':'))
        return false;
    bit = gnni_is(key, length, "dtype") ? 1 : gnni_is(key, length, "shape") ? 2 : 0;
    bit = gnni_is(key, length, "data_offsets") ? 4 : bit;
    if (!bit)
        return gnni_json_error(j, "it has a member that is not dtype, shape or data_offsets");
    if (e->seen & bit)
        return gnni_json_error(j, "it has a member twice");
    e->seen |= bit;
    if (bit == 1)
        return gnni_json_string(j, &e->type, &e->type_length, &escapes);
    if (bit == 2)
        return gnni_json_numbers(j, t->shape, GNN_MAX_RANK, &t->rank);
    return gnni_json_numbers(j, e->offsets, 2, &count) &&
           (count == 2 || gnni_json_error(j, "data_offsets must be two numbers"));
}

/* Bytes of a tensor of that shape; false on overflow. */
static bool gnni_tensor_size(const gnn_tensor *t, uint32_t bits, uint64_t *size)
{
    uint64_t count = 1;
    uint32_t i;
    for (i = 0; i < t->rank; ++i) {
        if (t->shape[i] && count > (UINT64_MAX / 8) / t->shape[i])
            return false;
        count *= t->shape[i];
    }
    *size = count * (bits / 8);
    return true;
}

/* A tensor's object, checked on its own; data points to its bytes. */
static bool gnni_entry_read(gnni_json *j, gnn_tensor *t, const unsigned char *data, uint64_t data_size)
{
    gnni_entry e;
    uint32_t bits;
    memset(&e, 0, sizeof e);
    if (!gnni_json_need(j, '{'))
        return false;
    if (!gnni_json_take(j, '}')) {
        do
            if (!gnni_entry_member(j, t, &e))
                return false;
        while (gnni_json_take(j, ','));
        if (!gnni_json_need(j, '}'))
            return false;
    }
    if (e.seen != 7)
        return gnni_json_error(j, "it lacks dtype, shape or data_offsets");
    bits = gnni_type_bits(e.type, e.type_length);
    if (!bits)
        return gnni_json_error(j, "its dtype is unknown");
    t->type = gnni_is(e.type, e.type_length, "F32")   ? GNN_TYPE_F32
              : gnni_is(e.type, e.type_length, "F16") ? GNN_TYPE_F16
                                                      : GNN_TYPE_OTHER;
    if (e.offsets[0] > e.offsets[1] || e.offsets[1] > data_size)
        return gnni_json_error(j, "its data_offsets lie outside the file");
    if (!gnni_tensor_size(t, bits, &t->size) || t->size != e.offsets[1] - e.offsets[0])
        return gnni_json_error(j, "its shape and data_offsets disagree");
    t->data = data + e.offsets[0];
    return true;
}

/* "__metadata__": an object of strings. With key, *text is where its value stands; true where it was found. */
static bool gnni_metadata(gnni_json *j, const char *key, const char **text, size_t *length)
{
    bool found = false, escapes;
    if (!gnni_json_need(j, '{') || gnni_json_take(j, '}'))
        return false;
    do {
        const char *name, *value;
        size_t name_length, value_length;
        if (!gnni_json_string(j, &name, &name_length, &escapes) || !gnni_json_need(j, ':') ||
            !gnni_json_string(j, &value, &value_length, &escapes))
            return false;
        if (key && !found && gnni_is(name, name_length, key)) {
            *text = value;
            *length = value_length;
            found = true;
        }
    } while (gnni_json_take(j, ','));
    return gnni_json_need(j, '}') && found;
}

static int gnni_by_name(const gnn_tensor *a, const gnn_tensor *b)
{
    uint32_t n = a->name_length < b->name_length ? a->name_length : b->name_length;
    int order = n ? memcmp(a->name, b->name, n) : 0;
    return order ? order : (a->name_length > b->name_length) - (a->name_length < b->name_length);
}

/* Empty tensors come before what begins at the same byte. */
static int gnni_by_place(const gnn_tensor *a, const gnn_tensor *b)
{
    if (a->data != b->data)
        return a->data < b->data ? -1 : 1;
    return (a->size > b->size) - (a->size < b->size);
}

/* Heap sort: no recursion, no allocation, and no bad case for hostile files. */
static void gnni_sort(gnn_tensor *t, uint32_t count, int (*order)(const gnn_tensor *, const gnn_tensor *))
{
    uint32_t first = count / 2, last = count;
    while (last > 1) {
        uint32_t root, child;
        gnn_tensor moved;
        if (first > 0) {
            moved = t[--first];
        } else {
            moved = t[--last];
            t[last] = t[0];
        }
        for (root = first; (child = 2 * root + 1) < last; root = child) {
            if (child + 1 < last && order(&t[child], &t[child + 1]) < 0)
                ++child;
            if (order(&moved, &t[child]) >= 0)
                break;
            t[root] = t[child];
        }
        t[root] = moved;
    }
}

/* The header's tensors, each checked on its own. On failure *bad is the one it happened in, or has no name. */
static bool gnni_entries(gnni_json *j, const unsigned char *data, uint64_t data_size, gnn_tensor *tensors,
                         uint32_t capacity, uint32_t *count, gnn_tensor *bad)
{
    bool metadata = false;
    if (!gnni_json_need(j, '{'))
        return false;
    if (!gnni_json_take(j, '}')) {
        do {
            gnn_tensor t;
            size_t length;
            bool escapes;
            memset(&t, 0, sizeof t);
            memset(bad, 0, sizeof *bad);
            if (!gnni_json_string(j, &t.name, &length, &escapes))
                return false;
            t.name_length = (uint32_t)length; /* below GNN_MAX_HEADER */
            *bad = t;
            if (!gnni_json_need(j, ':'))
                return false;
            if (gnni_is(t.name, length, "__metadata__")) {
                if (metadata)
                    return gnni_json_error(j, "it is there twice");
                metadata = true;
                gnni_metadata(j, NULL, NULL, NULL);
                if (j->error)
                    return false;
                continue;
            }
            if (escapes)
                return gnni_json_error(j, "its name has an escape");
            if (!gnni_entry_read(j, &t, data, data_size))
                return false;
            if (*count < capacity)
                tensors[*count] = t;
            ++*count;
        } while (gnni_json_take(j, ','));
        memset(bad, 0, sizeof *bad);
        if (!gnni_json_need(j, '}'))
            return false;
    }
    gnni_json_space(j);
    return j->at == j->end || gnni_json_error(j, "something follows the header's object");
}

GNN_API gnn_result gnn_tensors_read(const void *file, size_t size, gnn_tensor *tensors, uint32_t capacity,
                                    uint32_t *count, gnn_message *message)
{
    gnni_json j;
    const unsigned char *data, *end;
    gnn_tensor bad;
    uint32_t i;
    *count = 0;
    memset(&bad, 0, sizeof bad);
    if (message)
        message->text[0] = 0;
    if (!gnni_header(file, size, &j, &data))
        return gnni_fail(message, GNN_BAD_FILE, "not a safetensors file: its header does not fit", NULL);
    end = (const unsigned char *)file + size;
    if (!gnni_entries(&j, data, (uint64_t)(end - data), tensors, capacity, count, &bad)) {
        *count = 0;
        return gnni_fail(message, GNN_BAD_FILE, j.error, bad.name ? &bad : NULL);
    }
    if (*count > capacity)
        return gnni_fail(message, GNN_BUFFER_TOO_SMALL, gnn_result_string(GNN_BUFFER_TOO_SMALL), NULL);
    gnni_sort(tensors, *count, gnni_by_place);
    for (i = 0; i < *count; data += tensors[i++].size)
        if (tensors[i].data != data)
            return gnni_fail(message, GNN_BAD_FILE, "a gap before its bytes, or they overlap another's", &tensors[i]);
    if (data != end)
        return gnni_fail(message, GNN_BAD_FILE, "bytes that belong to no tensor at the file's end", NULL);
    gnni_sort(tensors, *count, gnni_by_name);
    for (i = 1; i < *count; ++i)
        if (gnni_by_name(&tensors[i - 1], &tensors[i]) == 0)
            return gnni_fail(message, GNN_BAD_FILE, "it is there twice", &tensors[i]);
    return GNN_OK;
}

GNN_API const gnn_tensor *gnn_tensors_find(const gnn_tensor *tensors, uint32_t count, const char *name)
{
    gnn_tensor wanted;
    uint32_t low = 0, high = count;
    memset(&wanted, 0, sizeof wanted);
    wanted.name = name;
    wanted.name_length = (uint32_t)strlen(name);
    while (low < high) {
        uint32_t middle = low + (high - low) / 2;
        int order = gnni_by_name(&tensors[middle], &wanted);
        if (order == 0)
            return &tensors[middle];
        if (order < 0)
            low = middle + 1;
        else
            high = middle;
    }
    return NULL;
}

/* Resolves the escapes of a string's text. */
static void gnni_unescape(const char *from, size_t length, char *text, size_t capacity)
{
    size_t i, at = 0;
    for (i = 0; i < length && at + 1 < capacity; ++i) {
        char c = from[i];
        if (c == '\\' && i + 1 < length) {
            static const char codes[] = "bfnrt", meant[] = "\b\f\n\r\t";
            const char *code;
            c = from[++i];
            code = strchr(codes, c);
            if (c == 'u') {
                unsigned value = 0, k;
                for (k = 0; k < 4 && i + 1 < length; ++k) {
                    char h = from[++i];
                    unsigned digit = h >= '0' && h <= '9' ? (unsigned)(h - '0') : ((unsigned)(h | 32) - 'a' + 10) & 15;
                    value = value << 4 | digit;
                }
                c = value > 0 && value < 128 ? (char)value : '?';
            } else if (c && code) {
                c = meant[code - codes];
            }
        }
        text[at++] = c;
    }
    text[at] = 0;
}

GNN_API bool gnn_tensors_metadata(const void *file, size_t size, const char *key, char *text, size_t capacity)
{
    gnni_json j;
    const unsigned char *data;
    gnn_tensor t;
    if (capacity)
        text[0] = 0;
    if (!gnni_header(file, size, &j, &data) || !gnni_json_need(&j, '{'))
        return false;
    do {
        size_t length;
        bool escapes;
        const char *value;
        memset(&t, 0, sizeof t);
        if (!gnni_json_string(&j, &t.name, &length, &escapes) || !gnni_json_need(&j, ':'))
            return false;
        if (gnni_is(t.name, length, "__metadata__")) {
            if (!gnni_metadata(&j, key, &value, &length) || capacity == 0)
                return false;
            gnni_unescape(value, length, text, capacity);
            return true;
        }
        if (!gnni_entry_read(&j, &t, data, (uint64_t)((const unsigned char *)file + size - data)))
            return false;
    } while (gnni_json_take(&j, ','));
    return false;
}

/* ---- >>halves ----------------------------------------------------------------------------------------------- */

GNN_API float gnn_float_of_half(uint16_t half)
{
    uint32_t sign = (uint32_t)(half & 0x8000u) << 16, exponent = half >> 10 & 31, mantissa = half & 1023u, bits;
    float value;
    if (exponent == 0) { /* zero or subnormal: mantissa 2^-24 */
        value = (float)mantissa * (1.0f / 16777216.0f);
        memcpy(&bits, &value, sizeof bits);
        bits |= sign;
    } else if (exponent == 31) {
        bits = sign | 0x7f800000u | mantissa << 13;
    } else {
        bits = sign | (exponent + 112) << 23 | mantissa << 13;
    }
    memcpy(&value, &bits, sizeof value);
    return value;
}

GNN_API uint16_t gnn_half_of_float(float value)
{
    uint32_t bits, sign, low, result;
    int shift;
    memcpy(&bits, &value, sizeof bits);
    sign = bits >> 16 & 0x8000u;
    bits &= 0x7fffffffu;
    if (bits > 0x7f800000u) /* NaN keeps what fits of its payload, and stays one */
        return (uint16_t)(sign | 0x7e00u | (bits >> 13 & 1023u));
    if (bits >= 0x477ff000u) /* 65520 and more */
        return (uint16_t)(sign | 0x7c00u);
    if (bits < 0x33000000u) /* below 2^-25; 2^-25 itself is a tie, and goes to zero, even */
        return (uint16_t)sign;
    if (bits < 0x38800000u) { /* subnormal: the mantissa with its leading one, shifted */
        shift = 126 - (int)(bits >> 23);
        low = (bits & 0x7fffffu) | 0x800000u;
    } else {
        shift = 13;
        low = bits - (112u << 23);
    }
    result = low >> shift;
    low &= (1u << shift) - 1;
    if (low > 1u << (shift - 1) || (low == 1u << (shift - 1) && (result & 1)))
        ++result;
    return (uint16_t)(sign | result);
}

GNN_API bool gnn_tensor_floats(const gnn_tensor *tensor, uint64_t begin, uint64_t count, float *values)
{
    uint64_t i, element = tensor->type == GNN_TYPE_F32 ? 4 : tensor->type == GNN_TYPE_F16 ? 2 : 0, have;
    if (!element)
        return false;
    have = tensor->size / element;
    if (begin > have || count > have - begin)
        return false;
    for (i = 0; i < count; ++i) {
        const unsigned char *p = tensor->data + (begin + i) * element;
        if (element == 4) {
            uint32_t bits = (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
            memcpy(&values[i], &bits, sizeof bits);
        } else {
            values[i] = gnn_float_of_half((uint16_t)(p[0] | p[1] << 8));
        }
    }
    return true;
}

/* ---- >>writing ---------------------------------------------------------------------------------------------- */

/* Counts, and writes where there is room for all: bytes is NULL while counting. */
typedef struct gnni_writer {
    unsigned char *bytes;
    size_t at;
} gnni_writer;

static void gnni_put(gnni_writer *w, const char *text)
{
    size_t n = strlen(text);
    if (w->bytes)
        memcpy(w->bytes + w->at, text, n);
    w->at += n;
}

static void gnni_put_number(gnni_writer *w, uint64_t value)
{
    char digits[24];
    int at = 23;
    digits[at] = 0;
    do
        digits[--at] = (char)('0' + value % 10);
    while (value /= 10);
    gnni_put(w, digits + at);
}

/* A string, " and \ escaped. */
static void gnni_put_string(gnni_writer *w, const char *text)
{
    char one[3] = {'\\', 0, 0};
    gnni_put(w, "\"");
    for (; *text; ++text) {
        one[1] = *text;
        gnni_put(w, one + (*text != '"' && *text != '\\'));
    }
    gnni_put(w, "\"");
}

static bool gnni_printable(const char *text, bool name)
{
    if (!text)
        return false;
    for (; *text; ++text)
        if (*text < 32 || *text > 126 || (name && (*text == '"' || *text == '\\')))
            return false;
    return true;
}

static uint64_t gnni_weight_count(const gnn_weight *w)
{
    uint64_t count = 1;
    uint32_t i;
    for (i = 0; i < w->rank; ++i)
        count *= w->shape[i];
    return count;
}

static bool gnni_weight_ok(const gnn_weight *w)
{
    gnn_tensor t;
    uint64_t size;
    memset(&t, 0, sizeof t);
    if (!gnni_printable(w->name, true) || strcmp(w->name, "__metadata__") == 0 || w->rank > GNN_MAX_RANK ||
        (w->type != GNN_TYPE_F32 && w->type != GNN_TYPE_F16))
        return false;
    t.rank = w->rank;
    memcpy(t.shape, w->shape, sizeof t.shape);
    return gnni_tensor_size(&t, 32, &size) && size < UINT64_C(1) << 40;
}

static void gnni_write_header(gnni_writer *w, const gnn_weight *weights, uint32_t count, const char *const *metadata)
{
    uint64_t offset = 0;
    uint32_t i, k;
    gnni_put(w, "{");
    if (metadata && metadata[0]) {
        gnni_put(w, "\"__metadata__\":{");
        for (i = 0; metadata[i]; i += 2) {
            gnni_put(w, i ? "," : "");
            gnni_put_string(w, metadata[i]);
            gnni_put(w, ":");
            gnni_put_string(w, metadata[i + 1]);
        }
        gnni_put(w, count ? "}," : "}");
    }
    for (i = 0; i < count; ++i) {
        const gnn_weight *t = &weights[i];
        uint64_t size = gnni_weight_count(t) * (t->type == GNN_TYPE_F32 ? 4 : 2);
        gnni_put(w, i ? "," : "");
        gnni_put_string(w, t->name);
        gnni_put(w, t->type == GNN_TYPE_F32 ? ":{\"dtype\":\"F32\",\"shape\":[" : ":{\"dtype\":\"F16\",\"shape\":[");
        for (k = 0; k < t->rank; ++k) {
            gnni_put(w, k ? "," : "");
            gnni_put_number(w, t->shape[k]);
        }
        gnni_put(w, "],\"data_offsets\":[");
        gnni_put_number(w, offset);
        gnni_put(w, ",");
        gnni_put_number(w, offset += size);
        gnni_put(w, "]}");
    }
    gnni_put(w, "}");
    while (w->at % 8)
        gnni_put(w, " ");
}

GNN_API size_t gnn_tensors_bound(const gnn_weight *weights, uint32_t count, const char *const *metadata)
{
    gnni_writer w;
    uint64_t size = 0;
    uint32_t i;
    w.bytes = NULL;
    w.at = 8;
    for (i = 0; metadata && metadata[i]; ++i)
        if (!gnni_printable(metadata[i], false) ||
            (i % 2 == 0 && (!metadata[i + 1] || !gnni_printable(metadata[i], true))))
            return 0;
    for (i = 0; i < count; ++i) {
        if (!gnni_weight_ok(&weights[i]))
            return 0;
        size += gnni_weight_count(&weights[i]) * (weights[i].type == GNN_TYPE_F32 ? 4 : 2);
    }
    gnni_write_header(&w, weights, count, metadata);
    if (w.at - 8 > GNN_MAX_HEADER || size > (size_t)-1 / 2)
        return 0;
    return w.at + (size_t)size;
}

GNN_API gnn_result gnn_tensors_write(const gnn_weight *weights, uint32_t count, const char *const *metadata,
                                     void *buffer, size_t size, size_t *written)
{
    size_t bound = gnn_tensors_bound(weights, count, metadata), at;
    gnni_writer w;
    uint32_t i;
    uint64_t k;
    *written = 0;
    if (!bound)
        return GNN_BAD_RANGE;
    if (size < bound)
        return GNN_BUFFER_TOO_SMALL;
    w.bytes = (unsigned char *)buffer;
    w.at = 8;
    gnni_write_header(&w, weights, count, metadata);
    for (i = 0; i < 8; ++i)
        w.bytes[i] = (unsigned char)((uint64_t)(w.at - 8) >> 8 * i);
    at = w.at;
    for (i = 0; i < count; ++i)
        for (k = 0; k < gnni_weight_count(&weights[i]); ++k) {
            uint32_t bits, n = weights[i].type == GNN_TYPE_F32 ? 4 : 2, b;
            memcpy(&bits, &weights[i].values[k], sizeof bits);
            bits = n == 4 ? bits : gnn_half_of_float(weights[i].values[k]);
            for (b = 0; b < n; ++b)
                w.bytes[at++] = (unsigned char)(bits >> 8 * b);
        }
    *written = at;
    return GNN_OK;
}

#endif /* GNN_IMPLEMENTATION */

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
