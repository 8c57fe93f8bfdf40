/* guide_nn.h 0.1: small neural networks for path guiding: convolutions over directions, a U-Net that repairs
   histograms, safetensors. Licence: MIT or Unlicense.

   In exactly one file, before including it:        #define GNN_IMPLEMENTATION
   Everywhere else only:                            #include "guide_nn.h"

   A few hundred photons binned by direction are a poor distribution to sample from: most bins are empty. This header
   has the network that repairs such maps while rendering, the layers it is made of, and its training. C99 or C++11, C
   standard library only (link with -lm).

       #define GNN_IMPLEMENTATION
       #include "guide_nn.h"
       int main(void)
       {
           enum { maps = 4, area = 16 * 8 };
           static gnn_unet_desc desc; // zero: all defaults
           static float inputs[maps][5][area], truths[maps][area], outputs[maps][area];
           gnn_unet *net; gnn_step step; void *workspace; size_t size;
           desc.width = 16; desc.height = 8; desc.training = true; desc.rate = 0.01f;
           if (gnn_unet_create(&desc, &net))
               return 1;
           size = gnn_unet_workspace(net, maps, true);
           workspace = malloc(size);
           for (int i = 0; workspace && i < 400; ++i) {
               for (int k = 0; k < maps * area; ++k) { // "photons" of an even light: one bin in four has any
                   float photons = rand() % 4 ? 0.0f : 4.0f, *bin = &inputs[k / area][0][k % area];
                   bin[0] = bin[area] = bin[2 * area] = bin[3 * area] = photons;
                   bin[4 * area] = photons > 0; // the mask
                   truths[k / area][k % area] = 1;
               }
               gnn_unet_train(net, &inputs[0][0][0], &truths[0][0], maps, &step, workspace, size, NULL, NULL);
           }
           gnn_unet_forward(net, &inputs[0][0][0], maps, &outputs[0][0], workspace, size, NULL, NULL);
           return free(workspace), gnn_unet_destroy(net), step.loss > 1; // 1.5 without training
       }

   CONTENTS (search for the tag)
     >>config   macros                         >>layers  maps, convolution, pooling, masks, loss, Adam
     >>types    results, levels of SIMD        >>unet    create, run, train, load, save
     >>tensors  safetensors files, half floats
     implementation:
     >>levels  >>tiles  >>maps  >>convolution  >>winograd  >>prepare  >>backward  >>json  >>files  >>halves  >>writing
     >>parts  >>net  >>named  >>run  >>train  >>saves  >>licence

   HOW IT WORKS
     Maps hold features per direction, (z, phi), equal-area, channels side by side. phi wraps; beyond z = +-1 a map goes
     on at phi + pi. Each map has a halo of one pixel that says so: convolutions do not know of borders, and a light at
     a pole or at phi = 0 is repaired like any other.
     Convolutions are 3x3. All dense work, forward and backward, is done by one kind of kernel: a tile of rows (pixels)
     and columns (channels) is kept in registers over all that is summed.
     Upsampling and concatenation are part of the convolution that follows: it reads the small map through 2x2 kernels,
     one for each parity of a pixel's coordinates, sums of the weights that fall on the same small pixel. That saves 5
     of 9 multiplications too.
     Large maps are convolved by Winograd's method [Lavin 2016], a quarter of the multiplications; so is the
     upsampled concatenation then.
     Masked (partial) convolutions [Liu 2018] count only valid pixels, scale what they see by 9 / their number, and make
     valid what sees one. Histograms have no photon in most bins: those are unknown, not dark.
     The network [Zhu 2021, section 6] is a U-Net with residual links: see gnn_unet_desc. Its output is its input 0 plus
     what it learned. Inputs and truth should be normalised to mean 1, counts and masks included as the training had
     them; output can be negative: clamp it.
     Loss: asymmetric L1, see gnn_loss: of two answers equally far from the truth the one on the side of the input is
     better, so that noise may stay but details are not blurred away. Levels between are judged too (deep supervision).
     The paper does not tell the network's sizes, lambda or the weights of levels: the defaults here are our own.

   OPTIONS: see gnn_unet_desc. gnn_unet_resolve fills in defaults, gnn_unet_get_desc returns what a network uses.

   MEMORY
     A network holds its weights, and 2 to 5 times that prepared for kernels; with desc.training three times more.
     Running and training allocate nothing: the caller gives a workspace of gnn_unet_workspace bytes. gnn_unet_load,
     gnn_unet_bound and gnn_unet_save allocate for the time of the call. Stack: below 8 KB per call.

   THREADS: each function has a tag.
     [any thread]   pure function on constant data and on what the caller hands it for this call alone
     [exclusive]    nothing else on this network at the same time
     No threads are started. Functions that take a gnn_parallel_fn cut work by maps and let the callback run it (NULL =
     serially). Results, training too, are bit-identical for any number of threads and any size of workspace.

   ERRORS
     gnn_result, 0 = ok; gnn_result_string says which field to change; gnn_message names the tensor that did not fit.
     Asserts (GNN_ASSERT) catch programming errors. A map with NaN, infinity or values far out of range spoils its own
     output only, and is left out of training (gnn_step.refused).
     gnn_tensors_read and gnn_unet_load are safe for untrusted input.

   NUMERICAL LIMITS
     Winograd's method differs from the definition by <= 5e-5 of a convolution's output rms, the direct kernel by <=
     1e-5; levels of SIMD from each other by as much, a network's output by <= 1e-4; so trained weights differ between
     levels. Within a level all is bit-identical.
     NEON: the tests of convolutions against double precision and of the network against the scalar level have run in
     an emulator of AArch64 (tests/compile-matrix.sh, where there is one); its speed has not been measured.

   REFERENCES
     S. Zhu, Z. Xu, T. Sun, A. Kuznetsov, M. Meyer, H. Jensen, H. Su, R. Ramamoorthi 2021, Photon-Driven Neural
       Reconstruction for Path Guiding.
     G. Liu, F. Reda, K. Shih, T.-C. Wang, A. Tao, B. Catanzaro 2018, Image Inpainting for Irregular Holes Using Partial
       Convolutions.
     O. Ronneberger, P. Fischer, T. Brox 2015, U-Net: Convolutional Networks for Biomedical Image Segmentation.
     T. Vogels, F. Rousselle, B. McWilliams, G. Roethlin, A. Harvill, D. Adler, M. Meyer, J. Novak 2018, Denoising with
       Kernel Prediction and Asymmetric Loss Functions.
     K. He, X. Zhang, S. Ren, J. Sun 2015, Delving Deep into Rectifiers (initial weights).
     D. Kingma, J. Ba 2015, Adam.
     A. Lavin, S. Gray 2016, Fast Algorithms for Convolutional Neural Networks.
     K. Goto, R. van de Geijn 2008, Anatomy of High-Performance Matrix Multiplication (register tiles). */
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
    X(GNN_BAD_OPTION, "desc.simd is not a level that this machine has, or desc.training is not set")                   \
    X(GNN_BAD_RANGE, "a number in the descriptor is out of its range: see its comments")                               \
    X(GNN_BAD_SHAPE, "width and height do not fit: see the comment of gnn_conv or gnn_unet_desc")                      \
    X(GNN_BAD_ALLOCATOR, "set both desc.allocate and desc.release or neither")                                         \
    X(GNN_BUFFER_TOO_SMALL, "the buffer or workspace is too small: ask the function that tells its size")              \
    X(GNN_BAD_FILE, "not a safetensors file, or it is damaged")                                                        \
    X(GNN_MISSING_TENSOR, "the file lacks a tensor that the network needs")                                            \
    X(GNN_WRONG_TENSOR, "a tensor does not fit the network, or has values that are not finite or too large for F16")

#define GNN_RESULT_ENUM(name, text) name,
typedef enum gnn_result { GNN_RESULTS(GNN_RESULT_ENUM) GNN_RESULT_COUNT } gnn_result;
#undef GNN_RESULT_ENUM

/* AUTO: the best that the machine has. Levels differ by rounding, see NUMERICAL LIMITS. */
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
   escapes. Not checked: that strings are UTF-8, that keys of the metadata are unique (the first counts). Safe for
   untrusted input. On success tensors[0 .. *count - 1] are sorted by name. capacity: of `tensors`; too small gives
   GNN_BUFFER_TOO_SMALL and the number needed in *count (tensors may be NULL if capacity is 0). message may be NULL.
   Time O(size of header + n log n). */
GNN_API gnn_result gnn_tensors_read(const void *file, size_t size, gnn_tensor *tensors, uint32_t capacity,
                                    uint32_t *count, gnn_message *message);
/* [any thread] The tensor of that name in a list sorted by gnn_tensors_read; NULL where there is none. */
GNN_API const gnn_tensor *gnn_tensors_find(const gnn_tensor *tensors, uint32_t count, const char *name);
/* [any thread] The text of a key of the file's metadata, cut to capacity - 1 bytes and terminated. False where there
   is none. Escapes are resolved, but for code points above 127: "?". It reads no further than the metadata, and is safe
   for any file: but check the file with gnn_tensors_read first. */
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

/* [any thread] Bytes of the file that gnn_tensors_write makes; 0 where a name, key, shape or type is not allowed, or a
   name or key is there twice. metadata: pairs of key, text (printable ASCII), NULL at the end; or NULL. Time
   O(count^2). */
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
    uint32_t width, height; /* of the output; 2 .. 4096, 1 .. 4096 */
    uint32_t up, up_stride; /* channels of the map of half the size, 0 = none; its floats a pixel */
    uint32_t in, in_stride; /* channels of the map of full size, 0 = none; its floats a pixel, a multiple of 8 >= in */
    uint32_t out, out_stride; /* gnn_stride(out) */
    bool relu;
    gnn_simd simd;    /* a level that this machine has, not AUTO: what gnn_resolve_simd returns */
    bool no_winograd; /* else maps of at least 8 tiles of 4x4 are convolved by Winograd's method, which needs a quarter
                         of the multiplications and differs by <= 5e-5 of the output's rms; NaN and infinity reach
                         pixels of the same tiles then */
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
/* [any thread] GNN_BAD_SHAPE, GNN_BAD_RANGE, GNN_BAD_OPTION (simd) or GNN_OK. */
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
GNN_API void gnn_conv_backward(const gnn_conv *conv, const float *prepared, const gnn_conv_maps *maps, float *dout,
                               float *dup, float *din, float *dadd, float *dweights, float *scratch);

/* [any thread] Masks [height][width] of maps without halo, 1 = valid, 0 = not. scale = 9 / (valid pixels of the 3x3
   around) and grown = 1 where there is one, both 0 elsewhere: a partial convolution is gnn_conv_forward of a map that
   is 0 where it is not valid, with that scale (Liu et al. 2018, eqs. 1, 2). The result is valid where grown is. */
GNN_API void gnn_mask_grow(const float *mask, uint32_t width, uint32_t height, float *scale, float *grown);
/* [any thread] Means of 2x2 pixels: to is half as wide and high; halo written. width and height: of `from`, even,
   width / 2 even too. */
GNN_API void gnn_pool(const float *from, uint32_t width, uint32_t height, uint32_t stride, float *to);
/* [any thread] dfrom += gradient, from that by `to`. */
GNN_API void gnn_pool_backward(const float *dto, uint32_t width, uint32_t height, uint32_t stride, float *dfrom);
/* [any thread] One step of Adam (Kingma and Ba 2015, algorithm 1). first, second: moments, zero before step 1. */
GNN_API void gnn_adam(float *weights, const float *gradients, float *first, float *second, size_t count, uint64_t step,
                      float rate, float beta1, float beta2, float epsilon);
/* [any thread] Mean over pixels of |out - truth| (1 + (lambda - 1) H), H = 1 where out and input lie on different sides
   of truth (Zhu et al. 2021, eqs. 12, 13). dout = its gradient, times `weight`; may be NULL. */
GNN_API double gnn_loss(const float *out, const float *input, const float *truth, size_t count, float lambda,
                        float weight, float *dout);

/* ---- >>unet ------------------------------------------------------------------------------------------------- */

#define GNN_MAX_LEVELS 6
#define GNN_MAX_INPUTS 16

/* The network that repairs histograms of photons (Zhu et al. 2021, section 6), as compact as its levels say:
     level l, going down:  a = relu(conv(x)), y = relu(conv(a) + a), masked; x = the input, below it the pooled y above
     going up:             a = relu(conv(upsampled level below, y of this level)), y = relu(conv(a) + a)
     output:               1x1 convolution of the top y, plus input 0
   While training, 1x1 convolutions of the levels between give outputs of their own, judged by the pooled truth.
   Zero-initialise it; zero means the default. */
typedef struct gnn_unet_desc {
    uint32_t width, height;            /* directions: columns are phi, rows z; default 64 x 32. height a multiple of
                                          2^(levels - 1), width of 2^levels; <= 1024 */
    uint32_t inputs;                   /* maps, 1 .. 16; default 5: S_t, S_t-1, P_t, P_t-1, B_t. Input 0 is repaired */
    uint32_t levels;                   /* 1 .. 6; default 3 */
    uint32_t channels[GNN_MAX_LEVELS]; /* of each level, 1 .. 512; default 8, 16, 32, ... */
    bool no_mask;                      /* else the last input is the mask: pixels where it is <= 0 are not valid */
    bool training;                     /* keep what gnn_unet_train needs: three more floats a parameter */
    float lambda;                      /* of the loss, see gnn_loss, 1 .. 100; default 1.5 */
    float deep;         /* weight of the losses of levels below the top, 0 .. 100, -1 = 0; default 0.25 */
    float rate;         /* of Adam, 1e-8 .. 1; default 0.001 */
    float beta1, beta2; /* of Adam, > 0 .. 0.99999; default 0.9, 0.999 */
    gnn_simd simd;      /* default: the best that this machine has */
    void *(*allocate)(void *user, size_t size); /* default malloc; NULL on failure; 16-byte aligned */
    void (*release)(void *user, void *pointer); /* default free; pointer may be NULL */
    void *user;
} gnn_unet_desc;

typedef struct gnn_unet gnn_unet;

/* [any thread] Fills in defaults and checks. GNN_BAD_RANGE too where size_t cannot count the network's memory. */
GNN_API gnn_result gnn_unet_resolve(gnn_unet_desc *desc);
/* [any thread] All memory that the network ever takes is allocated here; weights are those of gnn_unet_seed(net, 1). */
GNN_API gnn_result gnn_unet_create(const gnn_unet_desc *desc, gnn_unet **net);
/* [exclusive] net may be NULL. */
GNN_API void gnn_unet_destroy(gnn_unet *net);
/* [any thread] What create has resolved. */
GNN_API gnn_unet_desc gnn_unet_get_desc(const gnn_unet *net);
/* [any thread] Weights that training changes. */
GNN_API uint64_t gnn_unet_parameters(const gnn_unet *net);
/* [any thread] Floating-point operations of one map as the definition counts them: 2 for each weight and pixel. */
GNN_API double gnn_unet_operations(const gnn_unet *net);
/* [exclusive] Random weights (He et al. 2015), the same on every machine; training begins anew. */
GNN_API void gnn_unet_seed(gnn_unet *net, uint64_t seed);

/* [any thread] Bytes of workspace for `maps` maps at once, to run or to train. More maps than fit at once are worked
   on one group after the other, with the same result; a group's maps are what can run in parallel. SIZE_MAX where it
   would be more than that. */
GNN_API size_t gnn_unet_workspace(const gnn_unet *net, uint32_t maps, bool train);
/* [any thread] (a workspace of its own for each call) inputs[count][inputs][height][width] to
   outputs[count][height][width]. Outputs can be negative. NaN and infinity in a map's input stay in that map. No
   allocation. parallel = NULL: serially; the result is the same, bit for bit. */
GNN_API gnn_result gnn_unet_forward(const gnn_unet *net, const float *inputs, uint32_t count, float *outputs,
                                    void *workspace, size_t size, gnn_parallel_fn parallel, void *parallel_user);

/* What a training step saw. */
typedef struct gnn_step {
    double loss;      /* mean over the maps that counted, of the sum over levels; 0 where none did */
    uint32_t maps;    /* that counted */
    uint32_t refused; /* maps whose loss is not below 1e6 or that have a derivative of 1e15 or more, or not finite: a
                         square of those would stay in Adam's moments for ever. They do not count; best 0 */
} gnn_step;

/* [any thread] Mean gradient over maps by all weights, in the network's order (gnn_unet_floats of them, see
   gnn_unet_tensor_export). truths[count][height][width]. */
GNN_API gnn_result gnn_unet_gradients(const gnn_unet *net, const float *inputs, const float *truths, uint32_t count,
                                      float *gradients, gnn_step *step, void *workspace, size_t size,
                                      gnn_parallel_fn parallel, void *parallel_user);
/* [exclusive] gnn_unet_gradients, then one step of Adam (none if no map counted). GNN_BAD_OPTION where
   desc.training is not set. */
GNN_API gnn_result gnn_unet_train(gnn_unet *net, const float *inputs, const float *truths, uint32_t count,
                                  gnn_step *step, void *workspace, size_t size, gnn_parallel_fn parallel,
                                  void *parallel_user);
/* [exclusive] The learning rate from now on, 1e-8 .. 1. */
GNN_API void gnn_unet_set_rate(gnn_unet *net, float rate);

/* Tensors have PyTorch's shapes and are named down0.conv1.weight, down0.conv1.bias, down0.conv2.weight, ...,
   up0.conv1.weight, ..., head0.weight, ... */
/* [any thread] */
GNN_API uint32_t gnn_unet_tensors(const gnn_unet *net);
/* [any thread] Name (terminated), rank, shape; returns the number of values. */
GNN_API uint64_t gnn_unet_tensor(const gnn_unet *net, uint32_t index, char name[40], uint32_t *rank,
                                 uint64_t shape[GNN_MAX_RANK]);
/* [any thread] Floats in the network's own order, padding included. */
GNN_API size_t gnn_unet_floats(const gnn_unet *net);
/* [any thread] The values of a tensor out of such floats; NULL = the weights. */
GNN_API void gnn_unet_tensor_export(const gnn_unet *net, const float *floats, uint32_t index, float *values);
/* [exclusive] Sets a tensor's values. */
GNN_API void gnn_unet_tensor_import(gnn_unet *net, uint32_t index, const float *values);

/* [exclusive] Weights out of a safetensors file in memory, by name; other tensors of the file do not matter. If the
   file has what gnn_unet_save kept for training and desc.training is set, training goes on where it was. If its
   metadata have the key gnn_unet, that must be of such a network, else GNN_WRONG_TENSOR. On failure the network is as
   it was, and message (may be NULL) names the tensor. Safe for untrusted input. Allocates a table of the file's tensors
   for the time of the call. */
GNN_API gnn_result gnn_unet_load(gnn_unet *net, const void *file, size_t size, gnn_message *message);
/* [any thread] Bytes that gnn_unet_save writes; 0 = out of memory, a bad type or metadata. A save's metadata have a key
   of their own, "gnn_unet", that says what shapes do not: whether inputs are masked. type F16 or F32; F32 of a network
   for training keeps all that training needs to go on. metadata: see gnn_tensors_bound; may be NULL. */
GNN_API size_t gnn_unet_bound(const gnn_unet *net, gnn_type type, const char *const *metadata);
/* [any thread] Allocates a copy of the weights for the time of the call. GNN_WRONG_TENSOR where a value is not finite,
   or is 65520 or more and would be infinite as F16. */
GNN_API gnn_result gnn_unet_save(const gnn_unet *net, gnn_type type, const char *const *metadata, void *buffer,
                                 size_t size, size_t *written);

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

/* Contraction into fused multiply-adds off: results depend on the level of SIMD, not on the compiler's choices. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
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
    /* tail, if there is one: c = f(scale c + [scale > 0] bias + add) */
    bool tail, relu;
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
        if (!p->tail) {                                                                                                \
            GNNI_UNROLL for (r = 0; r < R; ++r) GNNI_UNROLL for (v = 0; v < NV; ++v)                                   \
                GNNI_##L##_STORE(c + r * p->c_step + v * GNNI_##L##_W, acc[r][v]);                                     \
            return;                                                                                                    \
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
#define GNNI_SCALAR_SUB(a, b) gnni_eight_add(a, gnni_eight_mul(gnni_eight_set(-1), b))
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
#define GNNI_AVX2_SUB(a, b) _mm256_sub_ps(a, b)
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
#define GNNI_AVX512_SUB(a, b) _mm512_sub_ps(a, b)
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
#define GNNI_NEON_SUB(a, b) vsubq_f32(a, b)
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
        c->in_stride < c->in || c->in_stride % 8 || (c->up && c->up_stride != gnn_stride(c->up)) ||
        c->out_stride != gnn_stride(c->out))
        return GNN_BAD_RANGE;
    return gnn_resolve_simd(c->simd) == c->simd ? GNN_OK : GNN_BAD_OPTION; /* AUTO never resolves to itself */
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

/* ---- >>winograd --------------------------------------------------------------------------------------------- */

/* F(4x4, 3x3) of Lavin and Gray 2016: a tile of 4x4 outputs needs 36 products for 144. Tiles of 6x6 inputs are
   transformed, B^T d B; for each of the 36 places a matrix product over channels adds up; A^T m A gives the outputs.
   Vectors run along channels. Rounding: about 1e-6 of the outputs' rms, up to 5e-5. */
#define GNNI_TILES 32u /* worked on at once: 36 * 32 * (channels in and out) floats stay in the second-level cache */

/* Fewer tiles than this do not share the transformed weights, four times as many bytes as the weights. Measured: at 8
   tiles, 64 -> 64 channels, 15 us for 43 of the direct kernel. */
#define GNNI_MIN_TILES 8u

static bool gnni_winograd(const gnn_conv *c)
{
    return !c->no_winograd && c->width % 4 == 0 && c->height % 4 == 0 &&
           (c->width / 4) * (c->height / 4) >= GNNI_MIN_TILES;
}

static uint32_t gnni_channels(const gnn_conv *c) { return (c->up ? c->up_stride : 0) + (c->in ? c->in_stride : 0); }

/* Floats from one of the 36 places to the next; staggered by a cache line, else all fall on the same sets. */
static size_t gnni_plane(uint32_t channels) { return (size_t)GNNI_TILES * channels + 16; }

static size_t gnni_winograd_prepared(const gnn_conv *c)
{
    return gnni_winograd(c) ? (size_t)36 * gnni_channels(c) * c->out_stride : 0;
}

static size_t gnni_winograd_scratch(const gnn_conv *c)
{
    return gnni_winograd(c) ? 36 * (gnni_plane(gnni_channels(c)) + gnni_plane(c->out_stride)) : 0;
}

/* u = G g G^T of one 3x3 kernel whose taps lie `step` floats apart; u[36]. In double precision: done once. */
static void gnni_winograd_weight(const float *g, size_t step, double *u)
{
    static const double G[6][3] = {{1.0 / 4, 0, 0},
                                   {-1.0 / 6, -1.0 / 6, -1.0 / 6},
                                   {-1.0 / 6, 1.0 / 6, -1.0 / 6},
                                   {1.0 / 24, 1.0 / 12, 1.0 / 6},
                                   {1.0 / 24, -1.0 / 12, 1.0 / 6},
                                   {0, 0, 1}};
    double half[6][3];
    uint32_t i, j;
    for (i = 0; i < 6; ++i)
        for (j = 0; j < 3; ++j)
            half[i][j] = G[i][0] * (double)g[j * step] + G[i][1] * (double)g[(3 + j) * step] +
                         G[i][2] * (double)g[(6 + j) * step];
    for (i = 0; i < 6; ++i)
        for (j = 0; j < 6; ++j)
            u[6 * i + j] = half[i][0] * G[j][0] + half[i][1] * G[j][1] + half[i][2] * G[j][2];
}

/* u[36][channels][out_stride], each in pieces of columns. */
static void gnni_winograd_prepare(const gnn_conv *c, const float *weights, float *u)
{
    uint32_t channels = gnni_channels(c), up = c->up ? c->up_stride : 0, i, o, column, piece, k;
    size_t plane = (size_t)channels * c->out_stride;
    double one[36];
    for (column = 0; column < c->out_stride; column += piece) {
        piece = gnni_piece(c->out_stride - column);
        for (i = 0; i < channels; ++i)
            for (o = 0; o < piece; ++o) {
                uint32_t stride = i < up ? c->up_stride : c->in_stride;
                const float *g = i < up ? weights + (size_t)i * c->out_stride
                                        : weights + gnni_up_weights(c) + (size_t)(i - up) * c->out_stride;
                gnni_winograd_weight(g + column + o, (size_t)stride * c->out_stride, one);
                for (k = 0; k < 36; ++k)
                    u[k * plane + (size_t)column * channels + (size_t)i * piece + o] = (float)one[k];
            }
    }
}

/* What a tile's outputs become. */
typedef struct gnni_finish {
    const float *m, *bias, *scale, *add; /* m[36][plane]; scale, add may be NULL */
    float *out;
    size_t plane, scale_row, row, pixel; /* floats from one to the next */
    bool relu;
} gnni_finish;

/* t = B^T d. */
#define GNNI_INPUT_6(L, d, t)                                                                                          \
    do {                                                                                                               \
        GNNI_##L##_V four = GNNI_##L##_SET(4), minus4 = GNNI_##L##_SET(-4), minus5 = GNNI_##L##_SET(-5);               \
        GNNI_##L##_V a = GNNI_##L##_FMA(minus4, d[2], d[4]), b = GNNI_##L##_FMA(minus4, d[1], d[3]);                   \
        GNNI_##L##_V p = GNNI_##L##_SUB(d[4], d[2]), q = GNNI_##L##_SUB(d[3], d[1]);                                   \
        q = GNNI_##L##_ADD(q, q);                                                                                      \
        t[0] = GNNI_##L##_FMA(four, d[0], GNNI_##L##_FMA(minus5, d[2], d[4]));                                         \
        t[1] = GNNI_##L##_ADD(a, b);                                                                                   \
        t[2] = GNNI_##L##_SUB(a, b);                                                                                   \
        t[3] = GNNI_##L##_ADD(p, q);                                                                                   \
        t[4] = GNNI_##L##_SUB(p, q);                                                                                   \
        t[5] = GNNI_##L##_FMA(four, d[1], GNNI_##L##_FMA(minus5, d[3], d[5]));                                         \
    } while (0)

/* o = A^T m. */
#define GNNI_OUTPUT_4(L, m, o)                                                                                         \
    do {                                                                                                               \
        GNNI_##L##_V s = GNNI_##L##_ADD(m[1], m[2]), d = GNNI_##L##_SUB(m[1], m[2]);                                   \
        GNNI_##L##_V u = GNNI_##L##_ADD(m[3], m[4]), v = GNNI_##L##_SUB(m[3], m[4]);                                   \
        o[0] = GNNI_##L##_ADD(GNNI_##L##_ADD(m[0], s), u);                                                             \
        o[1] = GNNI_##L##_FMA(GNNI_##L##_SET(2), v, d);                                                                \
        o[2] = GNNI_##L##_FMA(GNNI_##L##_SET(4), u, s);                                                                \
        o[3] = GNNI_##L##_ADD(GNNI_##L##_FMA(GNNI_##L##_SET(8), v, d), m[5]);                                          \
    } while (0)

/* Where the pixels of a tile of 6x6 stand: (i, j) at rows[i] + columns[j] floats from the tile's first. */
typedef struct gnni_offsets {
    size_t rows[6], columns[6];
} gnni_offsets;

/* Channels of one vector of one tile. */
#define GNNI_WINOGRAD(L)                                                                                               \
    GNNI_##L##_TARGET static void gnni_winograd_in_##L(const float *tile, const gnni_offsets *at, float *v,            \
                                                       size_t plane)                                                   \
    {                                                                                                                  \
        GNNI_##L##_V half[6][6], d[6], t[6];                                                                           \
        int i, j;                                                                                                      \
        GNNI_UNROLL for (j = 0; j < 6; ++j)                                                                            \
        {                                                                                                              \
            GNNI_UNROLL for (i = 0; i < 6; ++i) d[i] = GNNI_##L##_LOAD(tile + at->rows[i] + at->columns[j]);           \
            GNNI_INPUT_6(L, d, t);                                                                                     \
            GNNI_UNROLL for (i = 0; i < 6; ++i) half[i][j] = t[i];                                                     \
        }                                                                                                              \
        GNNI_UNROLL for (i = 0; i < 6; ++i)                                                                            \
        {                                                                                                              \
            GNNI_INPUT_6(L, half[i], t);                                                                               \
            GNNI_UNROLL for (j = 0; j < 6; ++j) GNNI_##L##_STORE(v + (size_t)(6 * i + j) * plane, t[j]);               \
        }                                                                                                              \
    }                                                                                                                  \
    GNNI_##L##_TARGET static void gnni_winograd_out_##L(const gnni_finish *f, uint32_t column)                         \
    {                                                                                                                  \
        GNNI_##L##_V half[4][6], m[6], o[4], x, bias = GNNI_##L##_LOAD(f->bias + column);                              \
        int i, j;                                                                                                      \
        GNNI_UNROLL for (j = 0; j < 6; ++j)                                                                            \
        {                                                                                                              \
            GNNI_UNROLL for (i = 0; i < 6; ++i) m[i] =                                                                 \
                GNNI_##L##_LOAD(f->m + (size_t)(6 * i + j) * f->plane + column);                                       \
            GNNI_OUTPUT_4(L, m, o);                                                                                    \
            GNNI_UNROLL for (i = 0; i < 4; ++i) half[i][j] = o[i];                                                     \
        }                                                                                                              \
        GNNI_UNROLL for (i = 0; i < 4; ++i)                                                                            \
        {                                                                                                              \
            GNNI_OUTPUT_4(L, half[i], o);                                                                              \
            GNNI_UNROLL for (j = 0; j < 4; ++j)                                                                        \
            {                                                                                                          \
                size_t at = (size_t)i * f->row + (size_t)j * f->pixel + column;                                        \
                float scale = f->scale ? f->scale[(size_t)i * f->scale_row + (size_t)j] : 1;                           \
                x = o[j];                                                                                              \
                if (f->scale)                                                                                          \
                    x = GNNI_##L##_MUL(x, GNNI_##L##_SET(scale));                                                      \
                if (scale > 0)                                                                                         \
                    x = GNNI_##L##_ADD(x, bias);                                                                       \
                if (f->add)                                                                                            \
                    x = GNNI_##L##_ADD(x, GNNI_##L##_LOAD(f->add + at));                                               \
                if (f->relu)                                                                                           \
                    x = GNNI_##L##_MAX0(x);                                                                            \
                GNNI_##L##_STORE(f->out + at, x);                                                                      \
            }                                                                                                          \
        }                                                                                                              \
    }

GNNI_WINOGRAD(SCALAR)
#if GNNI_X86
GNNI_WINOGRAD(AVX2)
GNNI_WINOGRAD(AVX512)
#endif
#if GNNI_NEON
GNNI_WINOGRAD(NEON)
#endif

static void gnni_winograd_in(gnn_simd simd, const float *tile, const gnni_offsets *at, uint32_t channels, float *v,
                             size_t plane)
{
    uint32_t c = 0, step;
    for (; c < channels; c += step) {
        step = 8;
#if GNNI_X86
        if (simd == GNN_SIMD_AVX512 && c + 16 <= channels) {
            gnni_winograd_in_AVX512(tile + c, at, v + c, plane);
            step = 16;
        } else if (simd == GNN_SIMD_AVX2 || simd == GNN_SIMD_AVX512) {
            gnni_winograd_in_AVX2(tile + c, at, v + c, plane);
        } else
#elif GNNI_NEON
        if (simd == GNN_SIMD_NEON) {
            gnni_winograd_in_NEON(tile + c, at, v + c, plane);
            step = 4;
        } else
#endif
            gnni_winograd_in_SCALAR(tile + c, at, v + c, plane);
    }
    (void)simd;
}

static void gnni_winograd_out(gnn_simd simd, const gnni_finish *f, uint32_t columns)
{
    uint32_t c = 0, step;
    for (; c < columns; c += step) {
        step = 8;
#if GNNI_X86
        if (simd == GNN_SIMD_AVX512 && c + 16 <= columns) {
            gnni_winograd_out_AVX512(f, c);
            step = 16;
        } else if (simd == GNN_SIMD_AVX2 || simd == GNN_SIMD_AVX512) {
            gnni_winograd_out_AVX2(f, c);
        } else
#elif GNNI_NEON
        if (simd == GNN_SIMD_NEON) {
            gnni_winograd_out_NEON(f, c);
            step = 4;
        } else
#endif
            gnni_winograd_out_SCALAR(f, c);
    }
    (void)simd;
}

/* Pixel p of the upsampled map is pixel p >> 1 of the small one; tiles begin at odd pixels. */
static gnni_offsets gnni_winograd_offsets(uint32_t width, uint32_t stride, bool up)
{
    gnni_offsets at;
    size_t k;
    for (k = 0; k < 6; ++k) {
        at.columns[k] = (up ? (k + 1) / 2 : k) * stride;
        at.rows[k] = at.columns[k] * ((up ? width / 2 : width) + 2);
    }
    return at;
}

/* The transformed inputs of tiles [first, first + tiles); v[36][plane]. */
static void gnni_winograd_tiles_in(const gnn_conv *c, const gnn_conv_maps *m, uint32_t first, uint32_t tiles, float *v)
{
    gnni_offsets up = gnni_winograd_offsets(c->width, c->up_stride, true);
    gnni_offsets in = gnni_winograd_offsets(c->width, c->in_stride, false);
    uint32_t across = c->width / 4, channels = gnni_channels(c), x = first % across, y = first / across, t;
    size_t plane = gnni_plane(channels);
    for (t = 0; t < tiles; ++t, v += channels) {
        if (c->up)
            gnni_winograd_in(c->simd, m->up + (size_t)(2 * y * (c->width / 2 + 2) + 2 * x) * c->up_stride, &up,
                             c->up_stride, v, plane);
        if (c->in)
            gnni_winograd_in(c->simd, m->in + (size_t)(4 * y * (c->width + 2) + 4 * x) * c->in_stride, &in,
                             c->in_stride, v + (c->up ? c->up_stride : 0), plane);
        if (++x == across)
            x = 0, ++y;
    }
}

static void gnni_winograd_multiply(const gnn_conv *c, const float *u, const float *v, float *m, uint32_t tiles)
{
    uint32_t channels = gnni_channels(c), column, k;
    gnni_product p;
    memset(&p, 0, sizeof p);
    p.rows = tiles;
    p.c_step = (ptrdiff_t)c->out_stride;
    for (k = 0; k < 36; ++k)
        for (column = 0; column < c->out_stride; column += p.columns) {
            p.columns = gnni_piece(c->out_stride - column);
            p.count = 0;
            gnni_term_add(&p, v + k * gnni_plane(channels), channels,
                          u + (size_t)k * channels * c->out_stride + (size_t)column * channels, p.columns, channels);
            p.c = m + k * gnni_plane(c->out_stride) + column;
            gnni_multiply(&p, c->simd);
        }
}

static void gnni_winograd_forward(const gnn_conv *c, const float *bias, const float *u, const gnn_conv_maps *maps,
                                  float *scratch)
{
    uint32_t across = c->width / 4, count = across * (c->height / 4), first, t, channels = gnni_channels(c);
    float *v = scratch, *m = scratch + 36 * gnni_plane(channels);
    gnni_finish f;
    f.plane = gnni_plane(c->out_stride);
    f.scale_row = c->width;
    f.pixel = c->out_stride;
    f.row = (size_t)(c->width + 2) * c->out_stride;
    f.relu = c->relu;
    f.bias = bias;
    for (first = 0; first < count; first += GNNI_TILES) {
        uint32_t tiles = count - first < GNNI_TILES ? count - first : GNNI_TILES;
        gnni_winograd_tiles_in(c, maps, first, tiles, v);
        gnni_winograd_multiply(c, u, v, m, tiles);
        for (t = 0; t < tiles; ++t) {
            uint32_t x = 4 * ((first + t) % across), y = 4 * ((first + t) / across);
            size_t at = gnni_at(c->width, c->out_stride, x, y);
            f.m = m + (size_t)t * c->out_stride;
            f.out = maps->out + at;
            f.add = maps->add ? maps->add + at : NULL;
            f.scale = maps->scale ? maps->scale + (size_t)y * c->width + x : NULL;
            gnni_winograd_out(c->simd, &f, c->out_stride);
        }
    }
}

/* ---- >>prepare ---------------------------------------------------------------------------------------------- */

/* What prepare derives, in this order. Upsampling: pixels of the output of equal parity (y & 1, x & 1) see the small
   map through a 2x2 kernel whose weights are sums of those of the 3x3 kernel: 4 multiplications for 9. */
typedef struct gnni_prepared {
    size_t up;       /* [4 parities][2x2][up_stride][out_stride]; up and in: only where Winograd's method is not used */
    size_t in;       /* [9][in_stride][out_stride] in pieces */
    size_t back_up;  /* [9 taps][out_stride][up_stride] in pieces of each tap, taps as in the forward pass */
    size_t back_in;  /* the same with in_stride */
    size_t winograd; /* [36][channels][out_stride] in pieces; only where it is used */
    size_t total;
} gnni_prepared;

static gnni_prepared gnni_layout(const gnn_conv *c)
{
    gnni_prepared p;
    bool direct = !gnni_winograd(c);
    p.up = 0;
    p.in = p.up + (direct && c->up ? (size_t)16 * c->up_stride * c->out_stride : 0);
    p.back_up = p.in + (direct ? gnni_in_weights(c) : 0);
    p.back_in = p.back_up + gnni_up_weights(c);
    p.winograd = p.back_in + gnni_in_weights(c);
    p.total = p.winograd + gnni_winograd_prepared(c);
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
    bool direct = !gnni_winograd(c);
    if (!direct)
        gnni_winograd_prepare(c, weights, prepared + at.winograd);
    if (direct && c->up) /* back_up is large enough to hold the sums on the way */
        gnni_prepare_up(c, weights, prepared + at.up, prepared + at.back_up);
    if (direct && c->in)
        gnni_pack(in, (size_t)9 * c->in_stride, c->out_stride, prepared + at.in);
    for (tap = 0; tap < 9; ++tap) {
        if (c->up)
            gnni_pack_transposed(weights + tap * up_tap, c->up_stride, c->out_stride,
                                 prepared + at.back_up + tap * up_tap);
        if (c->in)
            gnni_pack_transposed(in + tap * in_tap, c->in_stride, c->out_stride, prepared + at.back_in + tap * in_tap);
    }
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
    GNN_ASSERT(gnn_conv_check(c) == GNN_OK);
    if (gnni_winograd(c)) {
        gnni_winograd_forward(c, bias, prepared + gnni_layout(c).winograd, m, scratch);
        gnn_map_halo(m->out, c->width, c->height, c->out_stride);
        return;
    }
    memset(&p, 0, sizeof p);
    p.tail = true;
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
    size_t winograd = gnni_winograd_scratch(c);
    large = small > large ? small : large;
    return winograd > large ? winograd : large;
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

GNN_API void gnn_conv_backward(const gnn_conv *c, const float *prepared, const gnn_conv_maps *m, float *dout,
                               float *dup, float *din, float *dadd, float *dweights, float *scratch)
{
    gnni_prepared at = gnni_layout(c);
    size_t up = gnni_up_weights(c), in = gnni_in_weights(c), in_tap = (size_t)c->in_stride * c->out_stride;
    uint32_t y, tap;
    GNN_ASSERT(gnn_conv_check(c) == GNN_OK && (!din || c->in) && (!dup || c->up));
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

static bool gnni_is_hex(char c) { return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'f') || (c >= 'A' && c <= 'F'); }

/* From a \ to the last character of the escape, or to the end; false where JSON has no such escape. */
static bool gnni_json_escape(gnni_json *j)
{
    int k;
    if (++j->at == j->end)
        return true;
    if (!*j->at || !strchr("\"\\/bfnrtu", *j->at))
        return false;
    for (k = *j->at == 'u' ? 4 : 0; k > 0; --k)
        if (++j->at == j->end || !gnni_is_hex(*j->at))
            return j->at == j->end;
    return true;
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
            if (!gnni_json_escape(j))
                return gnni_json_error(j, "a bad escape in a string of the header");
            if (j->at == j->end)
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
    static const char *const names[] = {"BOOL", "U8",  "I8",  "F8_E5M2", "F8_E4M3", "F8_E8M0", "I16", "U16", "F16",
                                        "BF16", "I32", "U32", "F32",     "F64",     "I64",     "U64", "C64"};
    static const unsigned char bits[] = {8, 8, 8, 8, 8, 8, 16, 16, 16, 16, 32, 32, 32, 64, 64, 64, 64};
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
    uint32_t i, k;
    w.bytes = NULL;
    w.at = 8;
    for (i = 0; metadata && metadata[i]; i += 2) {
        if (!gnni_printable(metadata[i], true) || !gnni_printable(metadata[i + 1], false))
            return 0;
        for (k = 0; k < i; k += 2)
            if (strcmp(metadata[k], metadata[i]) == 0)
                return 0;
    }
    for (i = 0; i < count; ++i) {
        if (!gnni_weight_ok(&weights[i]))
            return 0;
        for (k = 0; k < i; ++k)
            if (strcmp(weights[k].name, weights[i].name) == 0)
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

/* ---- >>parts ------------------------------------------------------------------------------------------------ */

/* Three rows of masks one above the other; a turned one begins at phi + pi. */
typedef struct gnni_mask_rows {
    const float *row[3];
    uint32_t turn[3];
} gnni_mask_rows;

/* Valid pixels of column x of the three. */
static float gnni_mask_column(const gnni_mask_rows *m, uint32_t width, uint32_t x)
{
    return m->row[0][(x + m->turn[0]) % width] + m->row[1][x] + m->row[2][(x + m->turn[2]) % width];
}

/* n <= 64 pixels of a row of the result, from pixel `begin` on; neither of the three rows wraps among them. */
static void gnni_mask_piece(const gnni_mask_rows *m, uint32_t width, uint32_t begin, uint32_t n, float *scale)
{
    const float *a = m->row[0] + (begin + m->turn[0]) % width, *b = m->row[1] + begin;
    const float *c = m->row[2] + (begin + m->turn[2]) % width;
    float columns[66];
    uint32_t i;
    columns[0] = gnni_mask_column(m, width, begin ? begin - 1 : width - 1);
    columns[n + 1] = gnni_mask_column(m, width, begin + n < width ? begin + n : 0);
    for (i = 0; i < n; ++i)
        columns[i + 1] = a[i] + b[i] + c[i];
    for (i = 0; i < n; ++i) {
        float count = columns[i] + columns[i + 1] + columns[i + 2];
        scale[i] = 9 / (count > 0 ? count : INFINITY); /* no branch: compilers make vectors of it */
    }
}

GNN_API void gnn_mask_grow(const float *mask, uint32_t width, uint32_t height, float *scale, float *grown)
{
    uint32_t x, y, k, n, half = width - width / 2;
    for (y = 0; y < height; ++y, scale += width) {
        gnni_mask_rows m;
        for (k = 0; k < 3; ++k) { /* rows y - 1, y, y + 1; turned by half beyond a pole */
            int64_t at = (int64_t)(y + k) - 1;
            m.turn[k] = at < 0 || at >= height ? width / 2 : 0;
            m.row[k] = mask + (size_t)(at < 0 ? 0 : at >= height ? height - 1 : at) * width;
        }
        for (x = 0; x < width; x += n) {
            n = (x < half ? half : width) - x;
            n = n < 64 ? n : 64;
            gnni_mask_piece(&m, width, x, n, scale + x);
        }
        for (x = 0; grown && x < width; ++x)
            grown[(size_t)y * width + x] = scale[x] > 0 ? 1.0f : 0.0f;
    }
}

GNN_API void gnn_pool(const float *from, uint32_t width, uint32_t height, uint32_t stride, float *to)
{
    uint32_t x, y, c;
    for (y = 0; y < height / 2; ++y)
        for (x = 0; x < width / 2; ++x) {
            const float *a = from + gnni_at(width, stride, 2 * (int64_t)x, 2 * (int64_t)y);
            const float *b = a + (size_t)(width + 2) * stride;
            float *mean = to + gnni_at(width / 2, stride, x, y);
            for (c = 0; c < stride; ++c)
                mean[c] = 0.25f * ((a[c] + a[stride + c]) + (b[c] + b[stride + c]));
        }
    gnn_map_halo(to, width / 2, height / 2, stride);
}

GNN_API void gnn_pool_backward(const float *dto, uint32_t width, uint32_t height, uint32_t stride, float *dfrom)
{
    uint32_t x, y, c;
    for (y = 0; y < height; ++y)
        for (x = 0; x < width; ++x) {
            const float *d = dto + gnni_at(width / 2, stride, x / 2, y / 2);
            float *to = dfrom + gnni_at(width, stride, x, y);
            for (c = 0; c < stride; ++c)
                to[c] += 0.25f * d[c];
        }
}

GNN_API void gnn_adam(float *weights, const float *gradients, float *first, float *second, size_t count, uint64_t step,
                      float rate, float beta1, float beta2, float epsilon)
{
    float correct1 = (float)(1 / (1 - pow((double)beta1, (double)step)));
    float correct2 = (float)(1 / (1 - pow((double)beta2, (double)step)));
    size_t i;
    for (i = 0; i < count; ++i) {
        float g = gradients[i];
        first[i] = beta1 * first[i] + (1 - beta1) * g;
        second[i] = beta2 * second[i] + (1 - beta2) * g * g;
        weights[i] -= rate * (first[i] * correct1) / (sqrtf(second[i] * correct2) + epsilon);
    }
}

GNN_API double gnn_loss(const float *out, const float *input, const float *truth, size_t count, float lambda,
                        float weight, float *dout)
{
    double sum = 0;
    float share = weight / (float)count;
    size_t i;
    for (i = 0; i < count; ++i) {
        float away = out[i] - truth[i], before = input[i] - truth[i];
        float w = (away > 0 && before < 0) || (away < 0 && before > 0) ? lambda : 1;
        sum += (double)(w * fabsf(away));
        if (dout)
            dout[i] = away > 0 ? w * share : away < 0 ? -w * share : 0;
    }
    return sum / (double)count;
}

/* ---- >>net -------------------------------------------------------------------------------------------------- */

#define GNNI_ALIGN(n) (((n) + 15) & ~(size_t)15) /* floats of a cache line */
#define GNNI_HEAD 8                              /* columns that a head's one output is computed in */
#define GNNI_MAX_LOSS 1e6                        /* of a map; beyond, a photon of 1e30 W or the like is in it */
#define GNNI_MAX_GRADIENT 1e15f                  /* its square is far from overflow */

static void *gnni_default_allocate(void *user, size_t size)
{
    (void)user;
    return GNN_MALLOC(size);
}

static void gnni_default_release(void *user, void *pointer)
{
    (void)user;
    GNN_FREE(pointer);
}

/* A convolution of the network: where its weights and what is prepared of them lie. */
typedef struct gnni_layer {
    gnn_conv conv;
    size_t weights, prepared;
} gnni_layer;

/* Where a map's data lie in its part of the workspace, in floats. Offsets of gradients are those of the maps. */
typedef struct gnni_places {
    size_t input, x[GNN_MAX_LEVELS]; /* x: what a level begins with; 0 unused */
    size_t a[GNN_MAX_LEVELS], y[GNN_MAX_LEVELS], up_a[GNN_MAX_LEVELS], up_y[GNN_MAX_LEVELS];
    size_t maps;                                                 /* all of the above: end of what has gradients */
    size_t mask, scale1[GNN_MAX_LEVELS], scale2[GNN_MAX_LEVELS]; /* mask: two planes */
    size_t head, out, plain, truth, dout;                        /* planes of one level; head: a row of the product */
    size_t scratch, gradients, weights, total;                   /* gradients: of maps; weights: gradients of weights */
} gnni_places;

struct gnn_unet {
    gnn_unet_desc desc;
    gnni_layer down[GNN_MAX_LEVELS][2], up[GNN_MAX_LEVELS][2];
    size_t heads[GNN_MAX_LEVELS]; /* [stride][8], then [8] biases */
    size_t floats, prepared_floats, scratch;
    gnni_places run, train;
    uint64_t step;
    float *weights, *prepared, *first, *second, *gradients; /* the last three: NULL but for training */
};

static uint32_t gnni_ups(const gnn_unet *n) { return n->desc.levels - 1; }

/* Heads: of the top, and of the levels between it and the lowest. */
static uint32_t gnni_heads(const gnn_unet *n) { return n->desc.levels > 1 ? n->desc.levels - 1 : 1; }

static bool gnni_within(double x, double low, double high) { return x >= low && x <= high; }

static void gnni_default(float *x, float value) { *x = *x != 0 ? *x : value; }

/* No allocation or part of a workspace has more floats than this. It need not be close: it is there to refuse what a
   size_t of 32 bits cannot count. */
static uint64_t gnni_most_floats(const gnn_unet_desc *d)
{
    uint64_t sum = 1 << 20; /* names, tables, alignment */
    uint32_t l;
    for (l = 0; l < d->levels; ++l) {
        uint64_t s = gnn_stride(d->channels[l]), in = gnn_stride(l ? d->channels[l - 1] : d->inputs);
        uint64_t up = l + 1 < d->levels ? gnn_stride(d->channels[l + 1]) : 0, all = in + 4 * s + up;
        uint64_t pixels = (uint64_t)((d->width >> l) + 2) * ((d->height >> l) + 2);
        sum += pixels * (2 * all + 32);        /* maps, their gradients, planes, scratch */
        sum += 36 * 2 * (uint64_t)32 * all;    /* scratch of Winograd's method */
        sum += 16 * up * s + 10 * 9 * s * all; /* weights, what is prepared, moments, gradients */
    }
    return sum;
}

GNN_API gnn_result gnn_unet_resolve(gnn_unet_desc *d)
{
    uint32_t l;
    d->width = d->width ? d->width : 64;
    d->height = d->height ? d->height : 32;
    d->inputs = d->inputs ? d->inputs : 5;
    d->levels = d->levels ? d->levels : 3;
    if (d->inputs > GNN_MAX_INPUTS || d->levels > GNN_MAX_LEVELS)
        return GNN_BAD_RANGE;
    for (l = 0; l < d->levels; ++l) {
        d->channels[l] = d->channels[l] ? d->channels[l] : l ? 2 * d->channels[l - 1] : 8;
        if (d->channels[l] > 512)
            return GNN_BAD_RANGE;
    }
    if (d->width > 1024 || d->height > 1024 || d->width % (1u << d->levels) || d->height % (1u << (d->levels - 1)))
        return GNN_BAD_SHAPE;
    gnni_default(&d->lambda, 1.5f);
    gnni_default(&d->deep, 0.25f);
    gnni_default(&d->rate, 0.001f);
    gnni_default(&d->beta1, 0.9f);
    gnni_default(&d->beta2, 0.999f);
    if (!gnni_within(d->lambda, 1, 100) || !(d->deep == -1 || gnni_within(d->deep, 0, 100)) ||
        !gnni_within(d->rate, 1e-8f, 1) || !gnni_within(d->beta1, 0, 0.99999) || !gnni_within(d->beta2, 0, 0.99999))
        return GNN_BAD_RANGE;
    if (gnni_most_floats(d) > SIZE_MAX / sizeof(float))
        return GNN_BAD_RANGE;
    d->simd = gnn_resolve_simd(d->simd);
    if (d->simd == GNN_SIMD_AUTO)
        return GNN_BAD_OPTION;
    if (!d->allocate != !d->release)
        return GNN_BAD_ALLOCATOR;
    if (!d->allocate) {
        d->allocate = gnni_default_allocate;
        d->release = gnni_default_release;
    }
    return GNN_OK;
}

/* Plans a layer and gives it its place. */
static void gnni_layer_plan(gnn_unet *n, gnni_layer *layer, uint32_t level, uint32_t up, uint32_t in,
                            uint32_t in_stride)
{
    gnn_conv *c = &layer->conv;
    size_t scratch;
    memset(c, 0, sizeof *c);
    c->width = n->desc.width >> level;
    c->height = n->desc.height >> level;
    c->up = up;
    c->up_stride = gnn_stride(up);
    c->in = in;
    c->in_stride = in_stride;
    c->out = n->desc.channels[level];
    c->out_stride = gnn_stride(c->out);
    c->relu = true;
    c->simd = n->desc.simd;
    layer->weights = n->floats;
    layer->prepared = n->prepared_floats;
    n->floats += GNNI_ALIGN(gnn_conv_weights(c));
    n->prepared_floats += GNNI_ALIGN(gnn_conv_prepared(c));
    scratch = gnn_conv_scratch(c);
    n->scratch = scratch > n->scratch ? scratch : n->scratch;
}

static void gnni_plan_layers(gnn_unet *n)
{
    const gnn_unet_desc *d = &n->desc;
    uint32_t l;
    for (l = 0; l < d->levels; ++l) {
        uint32_t in = l ? d->channels[l - 1] : d->inputs;
        gnni_layer_plan(n, &n->down[l][0], l, 0, in, gnn_stride(in));
        gnni_layer_plan(n, &n->down[l][1], l, 0, d->channels[l], gnn_stride(d->channels[l]));
    }
    for (l = 0; l < gnni_ups(n); ++l) {
        gnni_layer_plan(n, &n->up[l][0], l, d->channels[l + 1], d->channels[l], gnn_stride(d->channels[l]));
        gnni_layer_plan(n, &n->up[l][1], l, 0, d->channels[l], gnn_stride(d->channels[l]));
    }
    for (l = 0; l < gnni_heads(n); ++l) {
        n->heads[l] = n->floats;
        n->floats += GNNI_ALIGN(((size_t)gnn_stride(d->channels[l]) + 1) * GNNI_HEAD);
    }
}

static size_t gnni_place(size_t *end, size_t floats)
{
    size_t at = *end;
    *end += GNNI_ALIGN(floats);
    return at;
}

/* To run, the way up overwrites the maps of the way down that it has read; to train all of them stay. */
static void gnni_plan_places(gnn_unet *n, gnni_places *p, bool train)
{
    const gnn_unet_desc *d = &n->desc;
    size_t end = 0, area = (size_t)d->width * d->height;
    uint32_t l;
    memset(p, 0, sizeof *p);
    p->input = gnni_place(&end, gnn_map_floats(d->width, d->height, gnn_stride(d->inputs)));
    for (l = 0; l < d->levels; ++l) {
        uint32_t w = d->width >> l, h = d->height >> l;
        size_t map = gnn_map_floats(w, h, gnn_stride(d->channels[l]));
        p->x[l] = l ? gnni_place(&end, gnn_map_floats(w, h, gnn_stride(d->channels[l - 1]))) : p->input;
        p->a[l] = gnni_place(&end, map);
        p->y[l] = gnni_place(&end, map);
        p->up_a[l] = train && l < gnni_ups(n) ? gnni_place(&end, map) : p->a[l];
        p->up_y[l] = train && l < gnni_ups(n) ? gnni_place(&end, map) : p->y[l];
    }
    p->maps = end;
    p->mask = gnni_place(&end, 2 * area);
    for (l = 0; l < d->levels; ++l) {
        p->scale1[l] = gnni_place(&end, area >> 2 * l);
        p->scale2[l] = gnni_place(&end, area >> 2 * l);
    }
    p->head = gnni_place(&end, (size_t)d->width * GNNI_HEAD);
    p->out = gnni_place(&end, area);
    p->plain = gnni_place(&end, area);
    p->truth = gnni_place(&end, train ? area : 0);
    p->dout = gnni_place(&end, train ? area : 0);
    p->scratch = gnni_place(&end, n->scratch);
    p->gradients = gnni_place(&end, train ? p->maps : 0);
    p->weights = gnni_place(&end, train ? n->floats : 0);
    p->total = end + 16; /* one more cache line, so that maps of equal place do not fall on equal sets */
}

static void gnni_prepare(gnn_unet *n)
{
    uint32_t l, k;
    for (l = 0; l < n->desc.levels; ++l)
        for (k = 0; k < 2; ++k) {
            const gnni_layer *down = &n->down[l][k], *up = &n->up[l][k];
            gnn_conv_prepare(&down->conv, n->weights + down->weights, n->prepared + down->prepared);
            if (l < gnni_ups(n))
                gnn_conv_prepare(&up->conv, n->weights + up->weights, n->prepared + up->prepared);
        }
}

GNN_API gnn_result gnn_unet_create(const gnn_unet_desc *desc, gnn_unet **out)
{
    gnn_unet_desc d = *desc;
    gnn_result result = gnn_unet_resolve(&d);
    gnn_unet *n;
    size_t floats;
    *out = NULL;
    if (result)
        return result;
    n = (gnn_unet *)d.allocate(d.user, sizeof *n);
    if (!n)
        return GNN_OUT_OF_MEMORY;
    memset(n, 0, sizeof *n);
    n->desc = d;
    gnni_plan_layers(n);
    gnni_plan_places(n, &n->run, false);
    gnni_plan_places(n, &n->train, true);
    floats = n->floats * (d.training ? 4 : 1) + n->prepared_floats;
    n->weights = (float *)d.allocate(d.user, floats * sizeof(float));
    if (!n->weights) {
        d.release(d.user, n);
        return GNN_OUT_OF_MEMORY;
    }
    n->prepared = n->weights + n->floats;
    if (d.training) {
        n->first = n->prepared + n->prepared_floats;
        n->second = n->first + n->floats;
        n->gradients = n->second + n->floats;
    }
    memset(n->weights, 0, floats * sizeof(float));
    gnn_unet_seed(n, 1);
    *out = n;
    return GNN_OK;
}

GNN_API void gnn_unet_destroy(gnn_unet *n)
{
    gnn_unet_desc d;
    if (!n)
        return;
    d = n->desc;
    d.release(d.user, n->weights);
    d.release(d.user, n);
}

GNN_API gnn_unet_desc gnn_unet_get_desc(const gnn_unet *n) { return n->desc; }
GNN_API size_t gnn_unet_floats(const gnn_unet *n) { return n->floats; }

GNN_API void gnn_unet_set_rate(gnn_unet *n, float rate)
{
    GNN_ASSERT(gnni_within(rate, 1e-8f, 1));
    n->desc.rate = rate;
}

/* ---- >>named ------------------------------------------------------------------------------------------------ */

/* Tensors: two of each convolution down, up, then of each head. */
typedef struct gnni_named {
    const gnni_layer *layer; /* NULL: a head */
    size_t head;
    uint32_t channels; /* of the head's level */
    bool bias;
} gnni_named;

GNN_API uint32_t gnn_unet_tensors(const gnn_unet *n)
{
    return 4 * n->desc.levels + 4 * gnni_ups(n) + 2 * gnni_heads(n);
}

static gnni_named gnni_tensor_of(const gnn_unet *n, uint32_t index)
{
    gnni_named t;
    uint32_t down = 4 * n->desc.levels, up = 4 * gnni_ups(n);
    memset(&t, 0, sizeof t);
    t.bias = index & 1;
    if (index < down) {
        t.layer = &n->down[index / 4][index / 2 % 2];
    } else if (index < down + up) {
        t.layer = &n->up[(index - down) / 4][(index - down) / 2 % 2];
    } else {
        index = (index - down - up) / 2;
        t.head = n->heads[index];
        t.channels = n->desc.channels[index];
    }
    return t;
}

/* Writes text after what is there, number too where it is >= 0. */
static void gnni_name(char name[40], const char *text, int number)
{
    size_t at = strlen(name);
    memcpy(name + at, text, strlen(text));
    at += strlen(text);
    if (number >= 0)
        name[at++] = (char)('0' + number);
    name[at] = 0;
}

GNN_API uint64_t gnn_unet_tensor(const gnn_unet *n, uint32_t index, char name[40], uint32_t *rank,
                                 uint64_t shape[GNN_MAX_RANK])
{
    gnni_named t = gnni_tensor_of(n, index);
    uint32_t down = 4 * n->desc.levels, up = 4 * gnni_ups(n);
    uint32_t in = t.layer ? t.layer->conv.up + t.layer->conv.in : t.channels, side = t.layer ? 3 : 1;
    name[0] = 0;
    if (t.layer) {
        gnni_name(name, index < down ? "down" : "up", (int)(index < down ? index / 4 : (index - down) / 4));
        gnni_name(name, ".conv", (int)(index / 2 % 2 + 1));
    } else {
        gnni_name(name, "head", (int)((index - down - up) / 2));
    }
    gnni_name(name, t.bias ? ".bias" : ".weight", -1);
    memset(shape, 0, GNN_MAX_RANK * sizeof *shape);
    *rank = t.bias ? 1 : 4;
    shape[0] = t.layer ? t.layer->conv.out : 1;
    if (t.bias)
        return shape[0];
    shape[1] = in;
    shape[2] = shape[3] = side;
    return shape[0] * in * side * side;
}

/* The place of a value of a tensor, PyTorch's order, in the network's. */
static size_t gnni_value_at(const gnni_named *t, size_t i)
{
    const gnn_conv *c;
    size_t in, o, channel, tap;
    if (!t->layer)
        return t->head + (t->bias ? (size_t)gnn_stride(t->channels) : i) * GNNI_HEAD;
    c = &t->layer->conv;
    if (t->bias)
        return t->layer->weights + gnni_up_weights(c) + gnni_in_weights(c) + i;
    in = c->up + c->in;
    tap = i % 9;
    channel = i / 9 % in;
    o = i / 9 / in;
    if (channel < c->up)
        return t->layer->weights + (tap * c->up_stride + channel) * c->out_stride + o;
    return t->layer->weights + gnni_up_weights(c) + (tap * c->in_stride + channel - c->up) * c->out_stride + o;
}

static uint64_t gnni_tensor_count(const gnn_unet *n, uint32_t index)
{
    char name[40];
    uint32_t rank;
    uint64_t shape[GNN_MAX_RANK];
    return gnn_unet_tensor(n, index, name, &rank, shape);
}

GNN_API void gnn_unet_tensor_export(const gnn_unet *n, const float *floats, uint32_t index, float *values)
{
    gnni_named t = gnni_tensor_of(n, index);
    size_t i, count = (size_t)gnni_tensor_count(n, index);
    for (i = 0; i < count; ++i)
        values[i] = (floats ? floats : n->weights)[gnni_value_at(&t, i)];
}

static void gnni_import(const gnn_unet *n, float *floats, uint32_t index, const float *values)
{
    gnni_named t = gnni_tensor_of(n, index);
    size_t i, count = (size_t)gnni_tensor_count(n, index);
    for (i = 0; i < count; ++i)
        floats[gnni_value_at(&t, i)] = values[i];
}

GNN_API void gnn_unet_tensor_import(gnn_unet *n, uint32_t index, const float *values)
{
    gnni_import(n, n->weights, index, values);
    gnni_prepare(n);
}

GNN_API uint64_t gnn_unet_parameters(const gnn_unet *n)
{
    uint64_t sum = 0;
    uint32_t i;
    for (i = 0; i < gnn_unet_tensors(n); ++i)
        sum += gnni_tensor_count(n, i);
    return sum;
}

static double gnni_layer_operations(const gnni_layer *l)
{
    const gnn_conv *c = &l->conv;
    return 18.0 * c->width * c->height * (c->up + c->in) * c->out;
}

GNN_API double gnn_unet_operations(const gnn_unet *n)
{
    double sum = 2.0 * n->desc.width * n->desc.height * n->desc.channels[0];
    uint32_t l, k;
    for (l = 0; l < n->desc.levels; ++l)
        for (k = 0; k < 2; ++k)
            sum += gnni_layer_operations(&n->down[l][k]) + (l < gnni_ups(n) ? gnni_layer_operations(&n->up[l][k]) : 0);
    return sum;
}

/* A normal deviate from the i-th pair of numbers of a seed (splitmix64, Box and Muller). */
static float gnni_normal(uint64_t seed, uint64_t i)
{
    double u[2];
    int k;
    for (k = 0; k < 2; ++k) {
        uint64_t z = seed * UINT64_C(0xd1342543de82ef95) + (2 * i + (uint64_t)k + 1) * UINT64_C(0x9e3779b97f4a7c15);
        z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
        z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
        z ^= z >> 31;
        u[k] = ((double)(z >> 11) + 0.5) * (1.0 / 9007199254740992.0);
    }
    return (float)(sqrt(-2 * log(u[0])) * cos(6.283185307179586 * u[1]));
}

GNN_API void gnn_unet_seed(gnn_unet *n, uint64_t seed)
{
    uint32_t i;
    uint64_t k, drawn = 0;
    for (i = 0; i < gnn_unet_tensors(n); ++i) {
        gnni_named t = gnni_tensor_of(n, i);
        uint64_t count = gnni_tensor_count(n, i);
        /* heads begin small: the output is then input 0 */
        float width = t.layer ? sqrtf(2.0f / (9 * (float)(t.layer->conv.up + t.layer->conv.in))) : 0.01f;
        for (k = 0; k < count; ++k)
            n->weights[gnni_value_at(&t, (size_t)k)] = t.bias ? 0 : width * gnni_normal(seed, drawn++);
    }
    n->step = 0;
    if (n->desc.training)
        memset(n->first, 0, 2 * n->floats * sizeof(float));
    gnni_prepare(n);
}

/* ---- >>run -------------------------------------------------------------------------------------------------- */

/* A map being worked on: w is its part of the workspace. */
typedef struct gnni_map {
    const gnn_unet *net;
    const gnni_places *at;
    float *w;
} gnni_map;

static void gnni_layer_forward(const gnni_map *m, const gnni_layer *l, const float *up, const float *in,
                               const float *scale, const float *add, float *out)
{
    gnn_conv_maps maps;
    maps.up = up;
    maps.in = in;
    maps.scale = scale;
    maps.add = add;
    maps.out = out;
    gnn_conv_forward(&l->conv, m->net->weights + l->weights, m->net->prepared + l->prepared, &maps,
                     m->w + m->at->scratch);
}

/* The input as a map, 0 where it is not valid, and the mask. */
static void gnni_take_input(const gnni_map *m, const float *planes)
{
    const gnn_unet_desc *d = &m->net->desc;
    size_t area = (size_t)d->width * d->height, i;
    const float *b = planes + (d->inputs - 1) * area;
    float *map = m->w + m->at->input, *mask = m->w + m->at->mask;
    uint32_t c, stride = gnn_stride(d->inputs);
    if (d->no_mask) {
        gnn_map_from_planes(planes, d->width, d->height, d->inputs, stride, map);
        return;
    }
    memset(map, 0, gnn_map_floats(d->width, d->height, stride) * sizeof(float));
    for (i = 0; i < area; ++i) {
        float *pixel = map + (i + i / d->width * 2 + d->width + 3) * stride; /* rows are 2 longer, one is before them */
        mask[i] = b[i] > 0 ? 1.0f : 0.0f;
        for (c = 0; c < d->inputs && b[i] > 0; ++c)
            pixel[c] = planes[c * area + i];
    }
    gnn_map_halo(map, d->width, d->height, stride);
}

/* Scales of a level's two convolutions; leaves the mask of the next level. */
static void gnni_level_masks(const gnni_map *m, uint32_t level)
{
    const gnn_unet_desc *d = &m->net->desc;
    uint32_t width = d->width >> level, height = d->height >> level, x, y;
    float *mask = m->w + m->at->mask, *grown = mask + (size_t)d->width * d->height;
    gnn_mask_grow(mask, width, height, m->w + m->at->scale1[level], grown);
    gnn_mask_grow(grown, width, height, m->w + m->at->scale2[level], mask);
    for (y = 0; y < height / 2; ++y)
        for (x = 0; x < width / 2; ++x) {
            const float *from = mask + (size_t)2 * y * width + 2 * x;
            float any = from[0] + from[1] + from[width] + from[width + 1];
            mask[(size_t)y * (width / 2) + x] = any > 0 ? 1.0f : 0.0f; /* never ahead of what is read */
        }
}

static void gnni_down(const gnni_map *m)
{
    const gnn_unet *n = m->net;
    const gnni_places *at = m->at;
    uint32_t l;
    for (l = 0; l < n->desc.levels; ++l) {
        const gnn_conv *c = &n->down[l][0].conv;
        const float *scale1 = n->desc.no_mask ? NULL : m->w + at->scale1[l];
        const float *scale2 = n->desc.no_mask ? NULL : m->w + at->scale2[l];
        if (!n->desc.no_mask)
            gnni_level_masks(m, l);
        if (l)
            gnn_pool(m->w + at->y[l - 1], 2 * c->width, 2 * c->height, c->in_stride, m->w + at->x[l]);
        gnni_layer_forward(m, &n->down[l][0], NULL, m->w + at->x[l], scale1, NULL, m->w + at->a[l]);
        gnni_layer_forward(m, &n->down[l][1], NULL, m->w + at->a[l], scale2, m->w + at->a[l], m->w + at->y[l]);
    }
}

static void gnni_up(const gnni_map *m)
{
    const gnn_unet *n = m->net;
    const gnni_places *at = m->at;
    uint32_t l;
    for (l = gnni_ups(n); l-- > 0;) {
        const float *below = m->w + at->up_y[l + 1]; /* of the lowest level: y */
        gnni_layer_forward(m, &n->up[l][0], below, m->w + at->y[l], NULL, NULL, m->w + at->up_a[l]);
        gnni_layer_forward(m, &n->up[l][1], NULL, m->w + at->up_a[l], NULL, m->w + at->up_a[l], m->w + at->up_y[l]);
    }
}

/* out[height][width] of a level = its head's convolution + plain. */
static void gnni_head(const gnni_map *m, uint32_t level, const float *plain, float *out)
{
    const gnn_unet_desc *d = &m->net->desc;
    uint32_t width = d->width >> level, height = d->height >> level, stride = gnn_stride(d->channels[level]), x, y;
    const float *weights = m->net->weights + m->net->heads[level];
    float *row = m->w + m->at->head, bias = weights[stride * GNNI_HEAD];
    gnni_product p;
    memset(&p, 0, sizeof p);
    p.rows = width;
    p.columns = GNNI_HEAD;
    p.c = row;
    p.c_step = GNNI_HEAD;
    for (y = 0; y < height; ++y) {
        p.count = 0;
        gnni_term_add(&p, m->w + m->at->up_y[level] + gnni_at(width, stride, 0, y), stride, weights, GNNI_HEAD, stride);
        gnni_multiply(&p, d->simd);
        for (x = 0; x < width; ++x)
            out[(size_t)y * width + x] = row[x * GNNI_HEAD] + bias + plain[(size_t)y * width + x];
    }
}

/* A workspace cut into parts for maps that are worked on at once. */
typedef struct gnni_job {
    const gnn_unet *net;
    const gnni_places *at;
    const float *inputs, *truths;
    float *outputs, *parts, *gradients;
    uint32_t first, group; /* first map of those that are worked on now, and their number */
} gnni_job;

GNN_API size_t gnn_unet_workspace(const gnn_unet *n, uint32_t maps, bool train)
{
    size_t part = (train ? n->train.total : n->run.total) * sizeof(float);
    maps = maps ? maps : 1;
    return maps > (SIZE_MAX - 64) / part ? SIZE_MAX : part * maps + 64;
}

/* The parts of a workspace: their number, 0 = none fits. */
static uint32_t gnni_parts(const gnni_places *at, void *workspace, size_t size, float **parts)
{
    size_t skip = (64 - ((uintptr_t)workspace & 63)) & 63, count;
    if (!workspace || size < skip)
        return 0;
    *parts = (float *)(void *)((char *)workspace + skip);
    count = (size - skip) / (at->total * sizeof(float));
    return count > 0xffffu ? 0xffffu : (uint32_t)count;
}

static void gnni_run_range(void *context, uint32_t begin, uint32_t end)
{
    const gnni_job *j = (const gnni_job *)context;
    const gnn_unet_desc *d = &j->net->desc;
    size_t area = (size_t)d->width * d->height;
    for (; begin < end; ++begin) {
        const float *input = j->inputs + (size_t)(j->first + begin) * d->inputs * area;
        gnni_map m;
        m.net = j->net;
        m.at = j->at;
        m.w = j->parts + begin * j->at->total;
        gnni_take_input(&m, input);
        gnni_down(&m);
        gnni_up(&m);
        gnni_head(&m, 0, input, j->outputs + (j->first + begin) * area);
    }
}

static void gnni_run(gnn_parallel_fn parallel, void *user, uint32_t count, uint32_t grain, gnn_range_fn fn,
                     void *context)
{
    if (parallel && count > grain)
        parallel(user, count, grain, fn, context);
    else if (count)
        fn(context, 0, count);
}

GNN_API gnn_result gnn_unet_forward(const gnn_unet *n, const float *inputs, uint32_t count, float *outputs,
                                    void *workspace, size_t size, gnn_parallel_fn parallel, void *parallel_user)
{
    gnni_job j;
    uint32_t parts;
    memset(&j, 0, sizeof j);
    j.net = n;
    j.at = &n->run;
    j.inputs = inputs;
    j.outputs = outputs;
    parts = gnni_parts(j.at, workspace, size, &j.parts);
    if (!parts)
        return GNN_BUFFER_TOO_SMALL;
    for (j.first = 0; j.first < count; j.first += parts)
        gnni_run(parallel, parallel_user, count - j.first < parts ? count - j.first : parts, 1, gnni_run_range, &j);
    return GNN_OK;
}

/* ---- >>train ------------------------------------------------------------------------------------------------ */

/* Gradients of the head's weights, and of its level's map. */
static void gnni_head_backward(const gnni_map *m, uint32_t level)
{
    const gnn_unet_desc *d = &m->net->desc;
    uint32_t width = d->width >> level, height = d->height >> level, stride = gnn_stride(d->channels[level]), x, y, c;
    const float *weights = m->net->weights + m->net->heads[level], *dout = m->w + m->at->dout;
    float *dweights = m->w + m->at->weights + m->net->heads[level];
    const float *map = m->w + m->at->up_y[level];
    float *dmap = m->w + m->at->gradients + m->at->up_y[level];
    for (y = 0; y < height; ++y)
        for (x = 0; x < width; ++x) {
            size_t at = gnni_at(width, stride, x, y);
            float g = dout[(size_t)y * width + x];
            for (c = 0; c < stride; ++c) {
                dweights[c * GNNI_HEAD] += g * map[at + c];
                dmap[at + c] += g * weights[c * GNNI_HEAD];
            }
            dweights[stride * GNNI_HEAD] += g;
        }
}

static void gnni_halve(float *plane, uint32_t width, uint32_t height)
{
    uint32_t x, y;
    for (y = 0; y < height / 2; ++y)
        for (x = 0; x < width / 2; ++x) {
            const float *from = plane + (size_t)2 * y * width + 2 * x;
            plane[(size_t)y * (width / 2) + x] = 0.25f * ((from[0] + from[1]) + (from[width] + from[width + 1]));
        }
}

/* Loss over all levels and its gradients by heads and maps. */
static double gnni_losses(const gnni_map *m, const float *input, const float *truth)
{
    const gnn_unet_desc *d = &m->net->desc;
    size_t area = (size_t)d->width * d->height;
    float *plain = m->w + m->at->plain, *small_truth = m->w + m->at->truth, *out = m->w + m->at->out;
    double sum = 0;
    uint32_t l;
    memcpy(plain, input, area * sizeof(float));
    memcpy(small_truth, truth, area * sizeof(float));
    for (l = 0; l < gnni_heads(m->net); ++l) {
        float weight = l == 0 ? 1 : d->deep > 0 ? d->deep : 0;
        if (weight == 0)
            break;
        gnni_head(m, l, plain, out);
        sum += (double)weight * gnn_loss(out, plain, small_truth, area >> 2 * l, d->lambda, weight, m->w + m->at->dout);
        gnni_head_backward(m, l);
        gnni_halve(plain, d->width >> l, d->height >> l);
        gnni_halve(small_truth, d->width >> l, d->height >> l);
    }
    return sum;
}

/* Gradient maps lie where the maps do; g is where those begin. dup, din, dadd: NULL = not wanted. */
static void gnni_layer_backward(const gnni_map *m, const gnni_layer *l, const gnn_conv_maps *maps, size_t out,
                                float *dup, float *din, float *dadd)
{
    gnn_conv_maps all = *maps;
    all.out = m->w + out;
    gnn_conv_backward(&l->conv, m->net->prepared + l->prepared, &all, m->w + m->at->gradients + out, dup, din, dadd,
                      m->w + m->at->weights + l->weights, m->w + m->at->scratch);
}

static void gnni_up_backward(const gnni_map *m)
{
    const gnn_unet *n = m->net;
    const gnni_places *at = m->at;
    float *g = m->w + at->gradients;
    uint32_t l;
    for (l = 0; l < gnni_ups(n); ++l) {
        gnn_conv_maps maps;
        memset(&maps, 0, sizeof maps);
        maps.in = maps.add = m->w + at->up_a[l];
        gnni_layer_backward(m, &n->up[l][1], &maps, at->up_y[l], NULL, g + at->up_a[l], g + at->up_a[l]);
        maps.up = m->w + at->up_y[l + 1];
        maps.in = m->w + at->y[l];
        maps.add = NULL;
        gnni_layer_backward(m, &n->up[l][0], &maps, at->up_a[l], g + at->up_y[l + 1], g + at->y[l], NULL);
    }
}

static void gnni_down_backward(const gnni_map *m)
{
    const gnn_unet *n = m->net;
    const gnni_places *at = m->at;
    float *g = m->w + at->gradients;
    uint32_t l;
    for (l = n->desc.levels; l-- > 0;) {
        const gnn_conv *c = &n->down[l][0].conv;
        gnn_conv_maps maps;
        memset(&maps, 0, sizeof maps);
        maps.in = maps.add = m->w + at->a[l];
        maps.scale = n->desc.no_mask ? NULL : m->w + at->scale2[l];
        gnni_layer_backward(m, &n->down[l][1], &maps, at->y[l], NULL, g + at->a[l], g + at->a[l]);
        maps.in = m->w + at->x[l];
        maps.add = NULL;
        maps.scale = n->desc.no_mask ? NULL : m->w + at->scale1[l];
        gnni_layer_backward(m, &n->down[l][0], &maps, at->a[l], NULL, l ? g + at->x[l] : NULL, NULL);
        if (l)
            gnn_pool_backward(g + at->x[l], 2 * c->width, 2 * c->height, c->in_stride, g + at->y[l - 1]);
    }
}

/* |x| < limit for all; false for NaN. */
static bool gnni_all_below(const float *x, size_t count, float limit)
{
    size_t i, good = 0;
    for (i = 0; i < count; ++i)
        good += fabsf(x[i]) < limit;
    return good == count;
}

static void gnni_train_range(void *context, uint32_t begin, uint32_t end)
{
    const gnni_job *j = (const gnni_job *)context;
    const gnn_unet_desc *d = &j->net->desc;
    size_t area = (size_t)d->width * d->height;
    for (; begin < end; ++begin) {
        const float *input = j->inputs + (size_t)(j->first + begin) * d->inputs * area;
        gnni_map m;
        double loss;
        m.net = j->net;
        m.at = j->at;
        m.w = j->parts + begin * j->at->total;
        memset(m.w + j->at->gradients, 0, (j->at->total - j->at->gradients) * sizeof(float));
        gnni_take_input(&m, input);
        gnni_down(&m);
        gnni_up(&m);
        loss = gnni_losses(&m, input, j->truths + (j->first + begin) * area);
        gnni_up_backward(&m);
        gnni_down_backward(&m);
        if (!(loss < GNNI_MAX_LOSS) || !gnni_all_below(m.w + j->at->weights, j->net->floats, GNNI_MAX_GRADIENT))
            loss = -1;                                 /* refused */
        memcpy(m.w + j->at->head, &loss, sizeof loss); /* for whoever adds up */
    }
}

/* Adds the group's gradients in the order of the maps. */
static void gnni_add_range(void *context, uint32_t begin, uint32_t end)
{
    const gnni_job *j = (const gnni_job *)context;
    uint32_t map, i;
    for (map = 0; map < j->group; ++map) {
        const float *part = j->parts + map * j->at->total, *from = part + j->at->weights;
        double loss;
        memcpy(&loss, part + j->at->head, sizeof loss);
        for (i = begin; i < end && loss >= 0; ++i)
            j->gradients[i] += from[i];
    }
}

GNN_API gnn_result gnn_unet_gradients(const gnn_unet *n, const float *inputs, const float *truths, uint32_t count,
                                      float *gradients, gnn_step *step, void *workspace, size_t size,
                                      gnn_parallel_fn parallel, void *parallel_user)
{
    gnni_job j;
    uint32_t parts, i;
    memset(&j, 0, sizeof j);
    memset(step, 0, sizeof *step);
    memset(gradients, 0, n->floats * sizeof(float));
    j.net = n;
    j.at = &n->train;
    j.inputs = inputs;
    j.truths = truths;
    j.gradients = gradients;
    parts = gnni_parts(j.at, workspace, size, &j.parts);
    if (!parts)
        return GNN_BUFFER_TOO_SMALL;
    for (j.first = 0; j.first < count; j.first += parts) {
        j.group = count - j.first < parts ? count - j.first : parts;
        gnni_run(parallel, parallel_user, j.group, 1, gnni_train_range, &j);
        gnni_run(parallel, parallel_user, (uint32_t)n->floats, 4096, gnni_add_range, &j);
        for (i = 0; i < j.group; ++i) {
            double loss;
            memcpy(&loss, j.parts + i * j.at->total + j.at->head, sizeof loss);
            step->maps += loss >= 0;
            step->loss += loss >= 0 ? loss : 0;
        }
    }
    step->refused = count - step->maps;
    if (!step->maps)
        return GNN_OK;
    step->loss /= step->maps;
    for (i = 0; i < n->floats; ++i)
        gradients[i] /= (float)step->maps;
    return GNN_OK;
}

GNN_API gnn_result gnn_unet_train(gnn_unet *n, const float *inputs, const float *truths, uint32_t count, gnn_step *step,
                                  void *workspace, size_t size, gnn_parallel_fn parallel, void *parallel_user)
{
    gnn_result result;
    if (!n->desc.training) {
        memset(step, 0, sizeof *step);
        return GNN_BAD_OPTION;
    }
    result = gnn_unet_gradients(n, inputs, truths, count, n->gradients, step, workspace, size, parallel, parallel_user);
    if (result || !step->maps)
        return result;
    gnn_adam(n->weights, n->gradients, n->first, n->second, n->floats, ++n->step, n->desc.rate, n->desc.beta1,
             n->desc.beta2, 1e-8f);
    gnni_prepare(n);
    return GNN_OK;
}

/* ---- >>saves ------------------------------------------------------------------------------------------------ */

/* Tensors of a save: the weights, and to go on training both moments and the number of steps. */
static const char *const gnni_kinds[] = {"", "adam1.", "adam2."};

/* Values of one tensor of the file as the network needs it. */
static gnn_result gnni_load_tensor(const gnn_unet *n, float *floats, uint32_t index, const char *kind,
                                   const gnn_tensor *tensors, uint32_t count, float *values, gnn_message *message)
{
    char full[64];
    uint32_t rank;
    uint64_t shape[GNN_MAX_RANK], wanted;
    const gnn_tensor *t;
    memcpy(full, kind, strlen(kind));
    wanted = gnn_unet_tensor(n, index, full + strlen(kind), &rank, shape);
    t = gnn_tensors_find(tensors, count, full);
    if (!t) {
        gnn_tensor missing;
        memset(&missing, 0, sizeof missing);
        missing.name = full;
        missing.name_length = (uint32_t)strlen(full);
        return gnni_fail(message, GNN_MISSING_TENSOR, "it is not in the file", &missing);
    }
    if (t->rank != rank || memcmp(t->shape, shape, rank * sizeof *shape) != 0)
        return gnni_fail(message, GNN_WRONG_TENSOR, "its shape does not fit the network", t);
    if (!gnn_tensor_floats(t, 0, wanted, values))
        return gnni_fail(message, GNN_WRONG_TENSOR, "its dtype is neither F32 nor F16", t);
    if (!gnni_all_below(values, (size_t)wanted, INFINITY))
        return gnni_fail(message, GNN_WRONG_TENSOR, "it has values that are not finite", t);
    gnni_import(n, floats, index, values);
    return GNN_OK;
}

/* All tensors of the file into fresh[kinds][floats]; *step where there is one. */
static gnn_result gnni_load_all(const gnn_unet *n, const gnn_tensor *tensors, uint32_t count, float *fresh,
                                float *values, uint64_t *step, gnn_message *message)
{
    const gnn_tensor *t = n->desc.training ? gnn_tensors_find(tensors, count, "adam.step") : NULL;
    uint32_t kinds = t ? 3 : 1, kind, i;
    float halves[2];
    for (kind = 0; kind < kinds; ++kind)
        for (i = 0; i < gnn_unet_tensors(n); ++i) {
            gnn_result result =
                gnni_load_tensor(n, fresh + kind * n->floats, i, gnni_kinds[kind], tensors, count, values, message);
            if (result)
                return result;
        }
    *step = 0;
    if (!t)
        return GNN_OK;
    if (!gnn_tensor_floats(t, 0, 2, halves) || !(halves[0] >= 0 && halves[0] < 16777216.0f) ||
        !(halves[1] >= 0 && halves[1] < 16777216.0f))
        return gnni_fail(message, GNN_WRONG_TENSOR, "it must be two counts", t);
    *step = (uint64_t)halves[0] + ((uint64_t)halves[1] << 24);
    if (!gnni_all_below(fresh + n->floats, n->floats, 2 * GNNI_MAX_GRADIENT))
        return gnni_fail(message, GNN_WRONG_TENSOR, "a tensor adam1. has values that are too large", NULL);
    for (i = 0; i < n->floats; ++i)
        if (!(fresh[2 * n->floats + i] >= 0 && fresh[2 * n->floats + i] < 4 * GNNI_MAX_GRADIENT * GNNI_MAX_GRADIENT))
            return gnni_fail(message, GNN_WRONG_TENSOR, "a tensor adam2. has values out of range", NULL);
    return GNN_OK;
}

/* Of what kind a network is, as metadata: "1 masked inputs=5 levels=3". 1: of the format. */
static void gnni_kind(const gnn_unet *n, char text[40])
{
    gnni_writer w;
    w.bytes = (unsigned char *)text;
    w.at = 0;
    gnni_put(&w, n->desc.no_mask ? "1 unmasked inputs=" : "1 masked inputs=");
    gnni_put_number(&w, n->desc.inputs);
    gnni_put(&w, " levels=");
    gnni_put_number(&w, n->desc.levels);
    text[w.at] = 0;
}

static gnn_result gnni_check_kind(const gnn_unet *n, const void *file, size_t size, gnn_message *message)
{
    char wanted[40], text[64]; /* what is cut differs too */
    gnni_kind(n, wanted);
    if (!gnn_tensors_metadata(file, size, "gnn_unet", text, sizeof text) || strcmp(text, wanted) == 0)
        return GNN_OK;
    return gnni_fail(message, GNN_WRONG_TENSOR, "its metadata say that the file is of another kind of network", NULL);
}

GNN_API gnn_result gnn_unet_load(gnn_unet *n, const void *file, size_t size, gnn_message *message)
{
    const gnn_unet_desc *d = &n->desc;
    uint32_t count;
    uint64_t step;
    gnn_tensor *tensors;
    float *fresh;
    gnn_result result = gnn_tensors_read(file, size, NULL, 0, &count, message);
    if (result && result != GNN_BUFFER_TOO_SMALL)
        return result;
    tensors = (gnn_tensor *)d->allocate(d->user, (count ? count : 1) * sizeof *tensors);
    fresh = (float *)d->allocate(d->user, 4 * n->floats * sizeof *fresh);
    if (!tensors || !fresh) {
        result = gnni_fail(message, GNN_OUT_OF_MEMORY, gnn_result_string(GNN_OUT_OF_MEMORY), NULL);
    } else {
        memset(fresh, 0, 3 * n->floats * sizeof *fresh);
        result = gnn_tensors_read(file, size, tensors, count, &count, message);
        if (!result)
            result = gnni_check_kind(n, file, size, message);
        if (!result)
            result = gnni_load_all(n, tensors, count, fresh, fresh + 3 * n->floats, &step, message);
        if (!result) {
            memcpy(n->weights, fresh, n->floats * sizeof(float));
            if (d->training) {
                memcpy(n->first, fresh + n->floats, 2 * n->floats * sizeof(float));
                n->step = step;
            }
            gnni_prepare(n);
        }
    }
    d->release(d->user, tensors);
    d->release(d->user, fresh);
    return result;
}

/* The list of what is saved; values, names and pointers to metadata lie behind it in memory. */
typedef struct gnni_save {
    gnn_weight *weights;
    uint32_t count;
    const char **metadata;
    char kind[40];
    void *memory;
} gnni_save;

/* "gnn_unet" and its text, then the caller's pairs, NULL. */
static void gnni_save_metadata(const gnn_unet *n, const char *const *metadata, size_t pointers, gnni_save *s)
{
    gnni_kind(n, s->kind);
    memset(s->metadata, 0, (pointers + 3) * sizeof *s->metadata);
    s->metadata[0] = "gnn_unet";
    s->metadata[1] = s->kind;
    if (pointers)
        memcpy(s->metadata + 2, metadata, pointers * sizeof *metadata);
}

static bool gnni_save_plan(const gnn_unet *n, gnn_type type, const char *const *metadata, gnni_save *s)
{
    uint32_t kinds = n->desc.training && type == GNN_TYPE_F32 ? 3 : 1, count = gnn_unet_tensors(n), kind, i;
    size_t list = (kinds * count + 1) * sizeof(gnn_weight), names = (size_t)kinds * count * 64, pointers = 0;
    size_t keys;
    char *name;
    float *values;
    while (metadata && metadata[pointers])
        ++pointers;
    keys = (pointers + 3) * sizeof *s->metadata;
    s->memory = n->desc.allocate(n->desc.user, list + keys + names + (kinds * n->floats + 2) * sizeof(float));
    if (!s->memory)
        return false;
    s->weights = (gnn_weight *)s->memory;
    s->metadata = (const char **)(void *)((char *)s->memory + list);
    name = (char *)s->memory + list + keys;
    values = (float *)(void *)(name + names);
    s->count = 0;
    memset(s->weights, 0, list);
    gnni_save_metadata(n, metadata, pointers, s);
    for (kind = 0; kind < kinds; ++kind)
        for (i = 0; i < count; ++i, ++s->count, name += 64) {
            gnn_weight *w = &s->weights[s->count];
            const float *from = kind == 0 ? n->weights : kind == 1 ? n->first : n->second;
            memcpy(name, gnni_kinds[kind], strlen(gnni_kinds[kind]));
            w->name = name;
            w->type = type;
            w->values = values;
            gnn_unet_tensor_export(n, from, i, values);
            values += gnn_unet_tensor(n, i, name + strlen(gnni_kinds[kind]), &w->rank, w->shape);
        }
    if (kinds == 3) {
        gnn_weight *w = &s->weights[s->count++];
        w->name = "adam.step";
        w->type = type;
        w->rank = 1;
        w->shape[0] = 2;
        w->values = values;
        values[0] = (float)(n->step & 0xffffffu);
        values[1] = (float)(n->step >> 24);
    }
    return true;
}

GNN_API size_t gnn_unet_bound(const gnn_unet *n, gnn_type type, const char *const *metadata)
{
    gnni_save s;
    size_t bound;
    if (!gnni_save_plan(n, type, metadata, &s))
        return 0;
    bound = gnn_tensors_bound(s.weights, s.count, s.metadata);
    n->desc.release(n->desc.user, s.memory);
    return bound;
}

GNN_API gnn_result gnn_unet_save(const gnn_unet *n, gnn_type type, const char *const *metadata, void *buffer,
                                 size_t size, size_t *written)
{
    gnni_save s;
    gnn_result result = GNN_OK;
    uint32_t i;
    *written = 0;
    if (!gnni_save_plan(n, type, metadata, &s))
        return GNN_OUT_OF_MEMORY;
    for (i = 0; i < s.count; ++i) /* 65520 is the first to round to infinity */
        if (!gnni_all_below(s.weights[i].values, (size_t)gnni_weight_count(&s.weights[i]),
                            type == GNN_TYPE_F16 ? 65520.0f : INFINITY))
            result = GNN_WRONG_TENSOR;
    if (!result)
        result = gnn_tensors_write(s.weights, s.count, s.metadata, buffer, size, written);
    n->desc.release(n->desc.user, s.memory);
    return result;
}

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

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
