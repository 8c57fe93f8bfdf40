/* denoise_kernels.h: 7 x 7 Gaussian blur of a layer of a quadtree, separable, over the whole matrix or only where it
   changes something. C99 or C++11; no allocation, no state.

     out[r][c] = sum over i, j = -3 .. 3 of w[|i|] w[|j|] in[r + i][c + j],  w[0] + 2 (w[1] + w[2] + w[3]) = 1

   >= 0 in, >= 0 out; a NaN or infinity spreads over its window and no further. Relative error 3e-7 (bench_denoise; all
   terms are positive), as long as no product of two weights and a mass underflows.

   THE MATRIX in: element (0, 0) 64-byte aligned, `stride` floats from row to row, a multiple of 16. Rows -3 ..
   width + 2 and columns -16 .. width + 15 exist, and 16 floats more (see blur_floats); blur_pad fills what is outside
   0 .. width - 1, so that the kernels know no borders. width: a power of two, >= 32. blur_stride keeps the ten rows
   that are read at once out of each other's cache sets (width floats alone would put all of them into the same ones).
   THE RESULT out: 64-byte aligned rows, no margin needed, not in place.

   Four rows at once: ten rows are loaded for four vertical sums, which stay in registers; the horizontal sum takes its
   seven shifts from two neighbouring vectors of them. Nothing is stored in between. Taps of equal weight are added
   first: 3 additions and 4 multiplications (fused) instead of 7, and on many machines those have different ports.
   Deviation from the thesis (J. Nilsson, 4.3): separable instead of 49 products a pixel, vectors of neighbouring pixels
   instead of the window's rows, no tiles (four rows at a time stream), masked by blocks instead of pixels. */
#ifndef DENOISE_KERNELS_H
#define DENOISE_KERNELS_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__) && !defined(GSD_NO_SIMD)
#include <immintrin.h>
#define BLUR_X86 1
#else
#define BLUR_X86 0
#endif

#define BLUR_MARGIN 16u   /* columns on either side */
#define BLUR_ROWS 4u      /* of a block */
#define BLUR_COLUMNS 4u   /* of a block: beside a border three columns of either leaf change */
#define BLUR_BLOCK 16u    /* floats: one cache line */
#define BLUR_AHEAD 8u     /* runs that input is fetched ahead: the processor cannot guess where the next one is */
#define BLUR_MAX_STACK 64 /* of the walk through a quadtree: 3 * depth 20 + 4 is the most */

/* Floats from row to row, in all, and before element (0, 0). */
static inline size_t blur_stride(uint32_t width) { return (size_t)width + 2 * BLUR_MARGIN; }
static inline size_t blur_floats(uint32_t width) { return ((size_t)width + 6) * blur_stride(width) + 16; }
static inline size_t blur_origin(uint32_t width) { return 3 * blur_stride(width) + BLUR_MARGIN; }

/* w[0..3] for sigma > 0, in elements. */
static inline void blur_weights(double sigma, float w[4])
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
static inline void blur_pad(float *in, size_t stride, uint32_t width, bool sphere)
{
    size_t w = width, half = w / 2, margin = BLUR_MARGIN, bytes = (w + 2 * margin) * sizeof(float), r;
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

/* ---- blocks that are not constant --------------------------------------------------------------------------- */

/* Blocks first .. end - 1 of block row `row`. */
typedef struct blur_run {
    uint32_t row;
    uint16_t first, end;
} blur_run;

/* Words of 64 blocks in a block row; words of a whole map. */
static inline uint32_t blur_map_stride(uint32_t width) { return (width / BLUR_COLUMNS + 63) / 64; }
static inline size_t blur_map_words(uint32_t width) { return (size_t)(width / BLUR_ROWS) * blur_map_stride(width); }

/* Set bits first .. end - 1 of a row of the map. */
static inline void blur_mark(uint64_t *row, uint32_t first, uint32_t end)
{
    uint32_t word = first / 64, last = (end - 1) / 64;
    uint64_t low = ~UINT64_C(0) << (first % 64), high = ~UINT64_C(0) >> (63 - (end - 1) % 64);
    if (word == last) {
        row[word] |= low & high;
        return;
    }
    row[word] |= low;
    while (++word < last)
        row[word] = ~UINT64_C(0);
    row[last] |= high;
}

/* Map of the blocks in which the window of any element reaches beyond its leaf; child as in gsd_tree, layer >= 5. A
   square of 16 or more that is a leaf is active along its frame; one of 8 is active whether it is divided or not, so
   that nothing below needs a look. */
static inline void blur_map(const uint32_t *child, uint32_t layer, uint64_t *map)
{
    struct blur_square {
        uint32_t node, x, y, size;
    } stack[BLUR_MAX_STACK], s;
    uint32_t width = 1u << layer, stride = blur_map_stride(width), top = 1, k, r;
    memset(map, 0, blur_map_words(width) * sizeof *map);
    stack[0].node = stack[0].x = stack[0].y = 0;
    stack[0].size = width;
    while (top) {
        s = stack[--top];
        for (k = 0; k < 4; ++k) {
            uint32_t c = child[4 * s.node + k], size = s.size / 2;
            uint32_t x = s.x + (k & 1 ? size : 0), y = s.y + (k & 2 ? size : 0);
            uint32_t first = x / BLUR_COLUMNS, end = (x + size) / BLUR_COLUMNS;
            uint32_t lowest = y / BLUR_ROWS, highest = (y + size) / BLUR_ROWS - 1;
            if (c && size > 8) {
                stack[top].node = c;
                stack[top].x = x;
                stack[top].y = y;
                stack[top++].size = size;
                continue;
            }
            blur_mark(map + (size_t)lowest * stride, first, end);
            blur_mark(map + (size_t)highest * stride, first, end);
            for (r = lowest + 1; r < highest; ++r) {
                map[(size_t)r * stride + first / 64] |= UINT64_C(1) << (first % 64);
                map[(size_t)r * stride + (end - 1) / 64] |= UINT64_C(1) << ((end - 1) % 64);
            }
        }
    }
}

/* Runs of the block rows `from` .. `to` - 1; at most (to - from) * width / 8. Returns their number. */
static inline size_t blur_runs(const uint64_t *map, uint32_t width, uint32_t from, uint32_t to, blur_run *run)
{
    uint32_t blocks = width / BLUR_COLUMNS, stride = blur_map_stride(width), r, b;
    size_t count = 0;
    for (r = from; r < to; ++r) {
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

/* ---- scalar ------------------------------------------------------------------------------------------------- */

/* Four rows, `columns` of them; in and out point to the first element of the first row. */
static inline void blur_strip(const float *in, size_t stride, float *out, size_t out_stride, uint32_t columns,
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

/* Rows `from` .. `to` - 1, multiples of 4. */
static inline void blur_full(const float *in, size_t stride, float *out, size_t out_stride, uint32_t width,
                             uint32_t from, uint32_t to, const float w[4])
{
    uint32_t r;
    for (r = from; r < to; r += BLUR_ROWS)
        blur_strip(in + r * stride, stride, out + r * out_stride, out_stride, width, w);
}

/* Only the blocks of these runs, packed: 4 rows of 4, block after block in the order of the runs; out 64-byte aligned,
   BLUR_BLOCK floats a block. (Written to their places in a matrix instead, most of the time goes into memory: half a
   line, then somewhere else.) */
static inline void blur_packed(const float *in, size_t stride, float *out, const blur_run *run, size_t count,
                               const float w[4])
{
    size_t i;
    uint32_t b;
    for (i = 0; i < count; ++i)
        for (b = run[i].first; b < run[i].end; ++b, out += BLUR_BLOCK)
            blur_strip(in + (size_t)run[i].row * BLUR_ROWS * stride + (size_t)b * BLUR_COLUMNS, stride, out,
                       BLUR_COLUMNS, BLUR_COLUMNS, w);
}

/* ---- AVX2 --------------------------------------------------------------------------------------------------- */

#if BLUR_X86
#define BLUR_AVX2 __attribute__((target("avx2,fma")))
#define BLUR_AVX2_INLINE __attribute__((target("avx2,fma"), always_inline)) static inline
#define BLUR_AVX512 __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma")))
#define BLUR_AVX512_INLINE __attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma"), always_inline)) static inline

BLUR_AVX2_INLINE __m256 blur_taps_avx2(const __m256 *w, __m256 a, __m256 b, __m256 c, __m256 d, __m256 e, __m256 f,
                                       __m256 g)
{
    __m256 near = _mm256_fmadd_ps(w[1], _mm256_add_ps(c, e), _mm256_mul_ps(w[0], d));
    return _mm256_fmadd_ps(w[3], _mm256_add_ps(a, g), _mm256_fmadd_ps(w[2], _mm256_add_ps(b, f), near));
}

/* Vertical sums of four rows at eight columns from p on, p in the first row. */
BLUR_AVX2_INLINE void blur_columns_avx2(const float *p, size_t stride, const __m256 *w, __m256 v[4])
{
    __m256 r0 = _mm256_loadu_ps(p - 3 * stride), r1 = _mm256_loadu_ps(p - 2 * stride);
    __m256 r2 = _mm256_loadu_ps(p - stride), r3 = _mm256_loadu_ps(p), r4 = _mm256_loadu_ps(p + stride);
    __m256 r5 = _mm256_loadu_ps(p + 2 * stride), r6 = _mm256_loadu_ps(p + 3 * stride);
    __m256 r7 = _mm256_loadu_ps(p + 4 * stride), r8 = _mm256_loadu_ps(p + 5 * stride);
    __m256 r9 = _mm256_loadu_ps(p + 6 * stride);
    v[0] = blur_taps_avx2(w, r0, r1, r2, r3, r4, r5, r6);
    v[1] = blur_taps_avx2(w, r1, r2, r3, r4, r5, r6, r7);
    v[2] = blur_taps_avx2(w, r2, r3, r4, r5, r6, r7, r8);
    v[3] = blur_taps_avx2(w, r3, r4, r5, r6, r7, r8, r9);
}

#define BLUR_SHIFT_AVX2(high, low, n)                                                                                  \
    _mm256_castsi256_ps(_mm256_alignr_epi8(_mm256_castps_si256(high), _mm256_castps_si256(low), 4 * (n)))

/* Eight columns from the vectors `v`, which starts at column -4, and `next`: -3 .. 10 are numbers 1 .. 14 of the two.
 */
BLUR_AVX2_INLINE __m256 blur_row_avx2(const __m256 *w, __m256 v, __m256 next)
{
    __m256 middle = _mm256_permute2f128_ps(v, next, 0x21);
    return blur_taps_avx2(w, BLUR_SHIFT_AVX2(middle, v, 1), BLUR_SHIFT_AVX2(middle, v, 2),
                          BLUR_SHIFT_AVX2(middle, v, 3), middle, BLUR_SHIFT_AVX2(next, middle, 1),
                          BLUR_SHIFT_AVX2(next, middle, 2), BLUR_SHIFT_AVX2(next, middle, 3));
}

/* Rows are written out one by one: a loop over them would put v into memory where the compiler does not unroll. */
BLUR_AVX2 static inline void blur_full_avx2(const float *in, size_t stride, float *out, size_t out_stride,
                                            uint32_t width, uint32_t from, uint32_t to, const float w[4])
{
    __m256 weight[4], v[4], next[4];
    uint32_t r, c;
    for (r = 0; r < 4; ++r)
        weight[r] = _mm256_set1_ps(w[r]);
    for (r = from; r < to; r += BLUR_ROWS) {
        const float *p = in + r * stride;
        float *o = out + r * out_stride;
        blur_columns_avx2(p - 4, stride, weight, v);
        for (c = 0; c < width; c += 8) {
            blur_columns_avx2(p + c + 4, stride, weight, next);
            _mm256_stream_ps(o + c, blur_row_avx2(weight, v[0], next[0]));
            _mm256_stream_ps(o + out_stride + c, blur_row_avx2(weight, v[1], next[1]));
            _mm256_stream_ps(o + 2 * out_stride + c, blur_row_avx2(weight, v[2], next[2]));
            _mm256_stream_ps(o + 3 * out_stride + c, blur_row_avx2(weight, v[3], next[3]));
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
    }
    _mm_sfence();
}

/* Fetch the four rows of a run that the block row before it has not needed. */
static inline void blur_prefetch(const float *in, size_t stride, const blur_run *run)
{
    const float *p = in + ((size_t)run->row * BLUR_ROWS + 3) * stride + (size_t)run->first * BLUR_COLUMNS - 4;
    size_t c, end = (size_t)(run->end - run->first) * BLUR_COLUMNS + 8;
    for (c = 0; c < end; c += 16) {
        _mm_prefetch((const char *)(p + c), _MM_HINT_T0);
        _mm_prefetch((const char *)(p + stride + c), _MM_HINT_T0);
        _mm_prefetch((const char *)(p + 2 * stride + c), _MM_HINT_T0);
        _mm_prefetch((const char *)(p + 3 * stride + c), _MM_HINT_T0);
    }
}

/* Two blocks at a time. Stores go through the caches: whoever merges the layers reads them soon. */
BLUR_AVX2 static inline void blur_packed_avx2(const float *in, size_t stride, float *out, const blur_run *run,
                                              size_t count, const float w[4])
{
    __m256 weight[4], v[4], next[4], r0, r1, r2, r3;
    size_t k;
    uint32_t n;
    for (k = 0; k < 4; ++k)
        weight[k] = _mm256_set1_ps(w[k]);
    for (k = 0; k < count; ++k) {
        const float *p = in + (size_t)run[k].row * BLUR_ROWS * stride + (size_t)run[k].first * BLUR_COLUMNS;
        if (k + BLUR_AHEAD < count)
            blur_prefetch(in, stride, &run[k + BLUR_AHEAD]);
        blur_columns_avx2(p - 4, stride, weight, v);
        for (n = (uint32_t)(run[k].end - run[k].first);; n -= 2, p += 8) {
            blur_columns_avx2(p + 4, stride, weight, next);
            r0 = blur_row_avx2(weight, v[0], next[0]);
            r1 = blur_row_avx2(weight, v[1], next[1]);
            r2 = blur_row_avx2(weight, v[2], next[2]);
            r3 = blur_row_avx2(weight, v[3], next[3]);
            _mm256_store_ps(out, _mm256_permute2f128_ps(r0, r1, 0x20));
            _mm256_store_ps(out + 8, _mm256_permute2f128_ps(r2, r3, 0x20));
            out += BLUR_BLOCK;
            if (n == 1)
                break;
            _mm256_store_ps(out, _mm256_permute2f128_ps(r0, r1, 0x31));
            _mm256_store_ps(out + 8, _mm256_permute2f128_ps(r2, r3, 0x31));
            out += BLUR_BLOCK;
            if (n == 2)
                break;
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
    }
}

/* ---- AVX-512 ------------------------------------------------------------------------------------------------ */

BLUR_AVX512_INLINE __m512 blur_taps_avx512(const __m512 *w, __m512 a, __m512 b, __m512 c, __m512 d, __m512 e, __m512 f,
                                           __m512 g)
{
    __m512 near = _mm512_fmadd_ps(w[1], _mm512_add_ps(c, e), _mm512_mul_ps(w[0], d));
    return _mm512_fmadd_ps(w[3], _mm512_add_ps(a, g), _mm512_fmadd_ps(w[2], _mm512_add_ps(b, f), near));
}

BLUR_AVX512_INLINE void blur_columns_avx512(const float *p, size_t stride, const __m512 *w, __m512 v[4])
{
    __m512 r0 = _mm512_loadu_ps(p - 3 * stride), r1 = _mm512_loadu_ps(p - 2 * stride);
    __m512 r2 = _mm512_loadu_ps(p - stride), r3 = _mm512_loadu_ps(p), r4 = _mm512_loadu_ps(p + stride);
    __m512 r5 = _mm512_loadu_ps(p + 2 * stride), r6 = _mm512_loadu_ps(p + 3 * stride);
    __m512 r7 = _mm512_loadu_ps(p + 4 * stride), r8 = _mm512_loadu_ps(p + 5 * stride);
    __m512 r9 = _mm512_loadu_ps(p + 6 * stride);
    v[0] = blur_taps_avx512(w, r0, r1, r2, r3, r4, r5, r6);
    v[1] = blur_taps_avx512(w, r1, r2, r3, r4, r5, r6, r7);
    v[2] = blur_taps_avx512(w, r2, r3, r4, r5, r6, r7, r8);
    v[3] = blur_taps_avx512(w, r3, r4, r5, r6, r7, r8, r9);
}

#define BLUR_SHIFT_AVX512(high, low, n)                                                                                \
    _mm512_castsi512_ps(_mm512_alignr_epi32(_mm512_castps_si512(high), _mm512_castps_si512(low), (n)))

/* Sixteen columns from the vectors `low`, which starts at column -16, `v` and `high`; past the caches. */
BLUR_AVX512_INLINE void blur_row_avx512(const __m512 *w, __m512 low, __m512 v, __m512 high, float *out)
{
    _mm512_stream_ps(out, blur_taps_avx512(w, BLUR_SHIFT_AVX512(v, low, 13), BLUR_SHIFT_AVX512(v, low, 14),
                                           BLUR_SHIFT_AVX512(v, low, 15), v, BLUR_SHIFT_AVX512(high, v, 1),
                                           BLUR_SHIFT_AVX512(high, v, 2), BLUR_SHIFT_AVX512(high, v, 3)));
}

/* Whole rows: three aligned vectors of vertical sums at a time. */
BLUR_AVX512 static inline void blur_full_avx512(const float *in, size_t stride, float *out, size_t out_stride,
                                                uint32_t width, uint32_t from, uint32_t to, const float w[4])
{
    __m512 weight[4];
    uint32_t r, c;
    for (r = 0; r < 4; ++r)
        weight[r] = _mm512_set1_ps(w[r]);
    for (r = from; r < to; r += BLUR_ROWS) {
        const float *p = in + r * stride;
        float *o = out + r * out_stride;
        __m512 low[4], v[4], high[4];
        blur_columns_avx512(p - 16, stride, weight, low);
        blur_columns_avx512(p, stride, weight, v);
        for (c = 0; c < width; c += 16) {
            blur_columns_avx512(p + c + 16, stride, weight, high);
            blur_row_avx512(weight, low[0], v[0], high[0], o + c);
            blur_row_avx512(weight, low[1], v[1], high[1], o + out_stride + c);
            blur_row_avx512(weight, low[2], v[2], high[2], o + 2 * out_stride + c);
            blur_row_avx512(weight, low[3], v[3], high[3], o + 3 * out_stride + c);
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
BLUR_AVX512_INLINE __m512 blur_shifted_avx512(const __m512 *w, __m512 v, __m512 next)
{
    return blur_taps_avx512(w, BLUR_SHIFT_AVX512(next, v, 1), BLUR_SHIFT_AVX512(next, v, 2),
                            BLUR_SHIFT_AVX512(next, v, 3), BLUR_SHIFT_AVX512(next, v, 4), BLUR_SHIFT_AVX512(next, v, 5),
                            BLUR_SHIFT_AVX512(next, v, 6), BLUR_SHIFT_AVX512(next, v, 7));
}

/* Four blocks at a time; the last one or two need columns -3 .. 10 at most, which are in v: the usual run, along the
   border of two leaves, takes one vector of columns only. */
BLUR_AVX512 static inline void blur_packed_avx512(const float *in, size_t stride, float *out, const blur_run *run,
                                                  size_t count, const float w[4])
{
    __m512 weight[4], v[4], next[4], r0, r1, r2, r3, low01, low23, high01, high23;
    size_t k;
    uint32_t n;
    for (k = 0; k < 4; ++k)
        weight[k] = _mm512_set1_ps(w[k]);
    for (k = 0; k < count; ++k) {
        const float *p = in + (size_t)run[k].row * BLUR_ROWS * stride + (size_t)run[k].first * BLUR_COLUMNS;
        if (k + BLUR_AHEAD < count)
            blur_prefetch(in, stride, &run[k + BLUR_AHEAD]);
        blur_columns_avx512(p - 4, stride, weight, v);
        for (n = (uint32_t)(run[k].end - run[k].first); n > 2; n = n > 4 ? n - 4 : 0, p += 16) {
            blur_columns_avx512(p + 12, stride, weight, next);
            r0 = blur_shifted_avx512(weight, v[0], next[0]);
            r1 = blur_shifted_avx512(weight, v[1], next[1]);
            r2 = blur_shifted_avx512(weight, v[2], next[2]);
            r3 = blur_shifted_avx512(weight, v[3], next[3]);
            low01 = _mm512_shuffle_f32x4(r0, r1, 0x44);
            low23 = _mm512_shuffle_f32x4(r2, r3, 0x44);
            high01 = _mm512_shuffle_f32x4(r0, r1, 0xee);
            high23 = _mm512_shuffle_f32x4(r2, r3, 0xee);
            _mm512_store_ps(out, _mm512_shuffle_f32x4(low01, low23, 0x88));
            _mm512_store_ps(out + BLUR_BLOCK, _mm512_shuffle_f32x4(low01, low23, 0xdd));
            _mm512_store_ps(out + 2 * BLUR_BLOCK, _mm512_shuffle_f32x4(high01, high23, 0x88));
            if (n > 3)
                _mm512_store_ps(out + 3 * BLUR_BLOCK, _mm512_shuffle_f32x4(high01, high23, 0xdd));
            out += (n > 3 ? 4 : 3) * BLUR_BLOCK;
            v[0] = next[0];
            v[1] = next[1];
            v[2] = next[2];
            v[3] = next[3];
        }
        if (!n)
            continue;
        r0 = blur_shifted_avx512(weight, v[0], v[0]);
        r1 = blur_shifted_avx512(weight, v[1], v[1]);
        r2 = blur_shifted_avx512(weight, v[2], v[2]);
        r3 = blur_shifted_avx512(weight, v[3], v[3]);
        low01 = _mm512_shuffle_f32x4(r0, r1, 0x44);
        low23 = _mm512_shuffle_f32x4(r2, r3, 0x44);
        _mm512_store_ps(out, _mm512_shuffle_f32x4(low01, low23, 0x88));
        if (n > 1)
            _mm512_store_ps(out + BLUR_BLOCK, _mm512_shuffle_f32x4(low01, low23, 0xdd));
        out += n * BLUR_BLOCK;
    }
}
#endif

#endif
