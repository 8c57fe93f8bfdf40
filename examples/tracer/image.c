/* image.c: pictures: EXR through OpenEXR's C core, PNG/JPEG/HDR through stb, tone mapping, error measures.

   contents: >>memory >>read-exr >>read >>write-exr >>write-png >>measures

   Files are read into memory before anything parses them and are built in memory before anything is written: the
   parsers then see one bounded block, and a failed write gives the system's own reason. */
#define _DEFAULT_SOURCE /* madvise */
#include "tracer.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#include <OpenEXR/openexr.h>
#include <stb/stb_image.h>
#include <stb/stb_image_write.h>

#define IMAGE_MAX_SIDE 65536
#define IMAGE_MAX_PIXELS (INT64_C(1) << 28)
#define HALF_MAX 65504.0f

#if defined(__GNUC__)
__attribute__((format(printf, 3, 4)))
#endif
static bool
fail(char *err, size_t err_size, const char *format, ...)
{
    va_list args;
    if (err && err_size) {
        va_start(args, format);
        vsnprintf(err, err_size, format, args);
        va_end(args);
    }
    return false;
}

/* ---- >>memory ----------------------------------------------------------------------------------------------- */

static bool size_allowed(int64_t width, int64_t height)
{
    return width > 0 && height > 0 && width <= IMAGE_MAX_SIDE && height <= IMAGE_MAX_SIDE &&
           width * height <= IMAGE_MAX_PIXELS;
}

void *tr_alloc_pages(size_t size)
{
    const size_t page = (size_t)1 << 21;
    void *p = NULL;
    if (size > SIZE_MAX - page || posix_memalign(&p, size < page ? 64 : page, size ? size : 1) != 0)
        return NULL;
#if defined(MADV_HUGEPAGE)
    if (size >= page)
        madvise(p, size / page * page, MADV_HUGEPAGE); /* only advice: failing changes nothing */
#endif
    memset(p, 0, size);
    return p;
}

bool tr_image_alloc(tr_image *image, int width, int height, int channels)
{
    memset(image, 0, sizeof *image);
    if (!size_allowed(width, height) || channels < 1 || channels > 4)
        return false;
    uint64_t count = (uint64_t)width * (uint64_t)height * (uint64_t)channels; /* <= 2^30 */
    if (count > SIZE_MAX / sizeof(float))
        return false;
    image->data = calloc((size_t)count, sizeof(float));
    if (!image->data)
        return false;
    image->width = width;
    image->height = height;
    image->channels = channels;
    return true;
}

void tr_image_free(tr_image *image)
{
    if (!image)
        return;
    free(image->data);
    memset(image, 0, sizeof *image);
}

static size_t pixel_count(const tr_image *image) { return (size_t)image->width * (size_t)image->height; }

/* A growing block of bytes: a file as it was read, or as it will be written. */
typedef struct blob {
    unsigned char *data;
    size_t size, capacity;
} blob;

static bool blob_reserve(blob *b, size_t size)
{
    if (size <= b->capacity)
        return true;
    size_t capacity = b->capacity ? b->capacity : 4096;
    while (capacity < size) {
        if (capacity > SIZE_MAX / 2)
            return false;
        capacity *= 2;
    }
    unsigned char *data = realloc(b->data, capacity);
    if (!data)
        return false;
    memset(data + b->capacity, 0, capacity - b->capacity);
    b->data = data;
    b->capacity = capacity;
    return true;
}

static bool blob_read_file(blob *b, const char *path, char *err, size_t err_size)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        return fail(err, err_size, "%s: cannot open: %s", path, strerror(errno));
    bool ok = true;
    for (;;) {
        if (b->size > INT32_MAX - 65536) {
            ok = fail(err, err_size, "%s: larger than 2 GB", path);
            break;
        }
        if (!blob_reserve(b, b->size + 65536)) {
            ok = fail(err, err_size, "%s: out of memory", path);
            break;
        }
        errno = 0;
        size_t got = fread(b->data + b->size, 1, 65536, file);
        b->size += got;
        if (got < 65536) {
            if (ferror(file))
                ok = fail(err, err_size, "%s: cannot read: %s", path, strerror(errno));
            break;
        }
    }
    fclose(file);
    return ok;
}

static bool blob_write_file(const blob *b, const char *path, char *err, size_t err_size)
{
    FILE *file = fopen(path, "wb");
    if (!file)
        return fail(err, err_size, "%s: cannot write: %s", path, strerror(errno));
    errno = 0;
    bool ok = fwrite(b->data, 1, b->size, file) == b->size;
    int code = errno;
    if (fclose(file) != 0) {
        code = ok ? errno : code;
        ok = false;
    }
    if (!ok)
        return fail(err, err_size, "%s: cannot write: %s", path, strerror(code));
    return true;
}

/* ---- >>read-exr --------------------------------------------------------------------------------------------- */

static int64_t exr_read_blob(exr_const_context_t context, void *user, void *buffer, uint64_t size, uint64_t offset,
                             exr_stream_error_func_ptr_t error)
{
    const blob *b = user;
    (void)context;
    (void)error;
    if (offset >= b->size)
        return 0;
    uint64_t left = b->size - offset;
    if (size > left)
        size = left;
    memcpy(buffer, b->data + offset, (size_t)size);
    return (int64_t)size;
}

static int64_t exr_size_blob(exr_const_context_t context, void *user)
{
    (void)context;
    return (int64_t)((const blob *)user)->size;
}

/* The core prints to stderr unless told otherwise; we report its result codes instead. */
static void exr_silent(exr_const_context_t context, exr_result_t code, const char *message)
{
    (void)context;
    (void)code;
    (void)message;
}

static bool exr_fail(const char *path, const char *what, exr_result_t code, char *err, size_t err_size)
{
    return fail(err, err_size, "%s: %s: %s", path, what, exr_get_default_error_message(code));
}

static int find_channel(const exr_attr_chlist_t *list, const char *prefix, size_t prefix_length, const char *name)
{
    for (int i = 0; i < list->num_channels; ++i) {
        const char *s = list->entries[i].name.str;
        if (s && strlen(s) >= prefix_length && memcmp(s, prefix, prefix_length) == 0 &&
            strcmp(s + prefix_length, name) == 0)
            return i;
    }
    return -1;
}

static const char *const rgb_names[3] = {"R", "G", "B"};

/* The channels of a layer by its name: R, G, B, else X, Y, Z, else Y; false = it has none of these. */
static bool choose_layer(const exr_attr_chlist_t *list, const char *layer, int rgb[3])
{
    static const char *const names[3][3] = {{"R", "G", "B"}, {"X", "Y", "Z"}, {"Y", "Y", "Y"}};
    char prefix[256];
    int length = snprintf(prefix, sizeof prefix, "%s.", layer);
    for (int kind = 0; kind < 3; ++kind) {
        for (int c = 0; c < 3; ++c)
            rgb[c] = find_channel(list, prefix, (size_t)length, names[kind][c]);
        if (rgb[0] >= 0 && rgb[1] >= 0 && rgb[2] >= 0)
            return true;
    }
    return false;
}

/* Which channels hold the colour: R, G, B; else Y; else those of the first layer that has them; else the first channel
   there is (a picture of one unnamed quantity). */
static void choose_channels(const exr_attr_chlist_t *list, int rgb[3])
{
    for (int layer = -1; layer < list->num_channels; ++layer) {
        const char *prefix = layer < 0 ? "" : list->entries[layer].name.str, *dot = strrchr(prefix, '.');
        size_t length = dot ? (size_t)(dot - prefix) + 1 : 0;
        if (layer >= 0 && !length)
            continue;
        for (int c = 0; c < 3; ++c)
            rgb[c] = find_channel(list, prefix, length, rgb_names[c]);
        if (rgb[0] >= 0 && rgb[1] >= 0 && rgb[2] >= 0)
            return;
        rgb[0] = rgb[1] = rgb[2] = find_channel(list, prefix, length, "Y");
        if (rgb[0] >= 0)
            return;
    }
    rgb[0] = rgb[1] = rgb[2] = 0;
}

typedef struct exr_reader {
    exr_context_t context;
    exr_decode_pipeline_t decode;
    bool decode_ready;
    const char *layer; /* NULL = the colour */
    int rgb[3];
    exr_attr_box2i_t window;
    tr_image *image;
} exr_reader;

/* Decode one chunk whose first pixel lies at (x, y) of the image. */
static exr_result_t decode_chunk(exr_reader *r, const exr_chunk_info_t *chunk, int64_t x, int64_t y)
{
    const tr_image *image = r->image;
    if (x < 0 || y < 0 || chunk->width <= 0 || chunk->height <= 0 || x + chunk->width > image->width ||
        y + chunk->height > image->height)
        return EXR_ERR_CORRUPT_CHUNK;
    exr_result_t rv = r->decode_ready ? exr_decoding_update(r->context, 0, chunk, &r->decode)
                                      : exr_decoding_initialize(r->context, 0, chunk, &r->decode);
    if (rv != EXR_ERR_SUCCESS)
        return rv;
    float *base = image->data + ((size_t)y * (size_t)image->width + (size_t)x) * 3;
    for (int c = 0; c < r->decode.channel_count; ++c) {
        exr_coding_channel_info_t *info = &r->decode.channels[c];
        info->decode_to_ptr = NULL;
        for (int k = 2; k >= 0; --k) /* a grey channel goes to red, and is copied to the others at the end */
            if (r->rgb[k] == c)
                info->decode_to_ptr = (uint8_t *)(base + k);
        info->user_bytes_per_element = 4;
        info->user_data_type = EXR_PIXEL_FLOAT;
        info->user_pixel_stride = 12;
        info->user_line_stride = image->width * 12;
    }
    if (!r->decode_ready) {
        r->decode_ready = true;
        rv = exr_decoding_choose_default_routines(r->context, 0, &r->decode);
        if (rv != EXR_ERR_SUCCESS)
            return rv;
    }
    return exr_decoding_run(r->context, 0, &r->decode);
}

static exr_result_t read_scanlines(exr_reader *r)
{
    int32_t lines = 0;
    exr_result_t rv = exr_get_scanlines_per_chunk(r->context, 0, &lines);
    if (rv == EXR_ERR_SUCCESS && lines < 1)
        rv = EXR_ERR_CORRUPT_CHUNK;
    for (int64_t y = r->window.min.y; rv == EXR_ERR_SUCCESS && y <= r->window.max.y; y += lines) {
        exr_chunk_info_t chunk;
        rv = exr_read_scanline_chunk_info(r->context, 0, (int)y, &chunk);
        if (rv == EXR_ERR_SUCCESS)
            rv = decode_chunk(r, &chunk, 0, (int64_t)chunk.start_y - r->window.min.y);
    }
    return rv;
}

static exr_result_t read_tiles(exr_reader *r)
{
    int32_t tile_w = 0, tile_h = 0;
    exr_result_t rv = exr_get_tile_sizes(r->context, 0, 0, 0, &tile_w, &tile_h);
    if (rv == EXR_ERR_SUCCESS && (tile_w < 1 || tile_h < 1))
        rv = EXR_ERR_CORRUPT_CHUNK;
    for (int64_t y = 0, ty = 0; rv == EXR_ERR_SUCCESS && y < r->image->height; y += tile_h, ++ty) {
        for (int64_t x = 0, tx = 0; rv == EXR_ERR_SUCCESS && x < r->image->width; x += tile_w, ++tx) {
            exr_chunk_info_t chunk;
            rv = exr_read_tile_chunk_info(r->context, 0, (int)tx, (int)ty, 0, 0, &chunk);
            if (rv == EXR_ERR_SUCCESS)
                rv = decode_chunk(r, &chunk, x, y);
        }
    }
    return rv;
}

static bool read_exr_header(exr_reader *r, const char *path, exr_storage_t *storage, char *err, size_t err_size)
{
    const exr_attr_chlist_t *channels = NULL;
    exr_result_t rv = exr_get_storage(r->context, 0, storage);
    if (rv == EXR_ERR_SUCCESS)
        rv = exr_get_data_window(r->context, 0, &r->window);
    if (rv == EXR_ERR_SUCCESS)
        rv = exr_get_channels(r->context, 0, &channels);
    if (rv != EXR_ERR_SUCCESS)
        return exr_fail(path, "damaged EXR header", rv, err, err_size);
    if (*storage != EXR_STORAGE_SCANLINE && *storage != EXR_STORAGE_TILED)
        return fail(err, err_size, "%s: a deep EXR; only flat pictures can be read", path);
    if (!channels || channels->num_channels < 1)
        return fail(err, err_size, "%s: the EXR has no channels", path);
    for (int i = 0; i < channels->num_channels; ++i)
        if (!channels->entries[i].name.str)
            return fail(err, err_size, "%s: damaged EXR header: a channel without a name", path);
    if (!r->layer)
        choose_channels(channels, r->rgb);
    else if (!choose_layer(channels, r->layer, r->rgb))
        return fail(err, err_size, "%s: no layer \"%.100s\" with R, G and B, or X, Y and Z, or Y", path, r->layer);
    for (int c = 0; c < 3; ++c) {
        const exr_attr_chlist_entry_t *e = &channels->entries[r->rgb[c]];
        if (e->x_sampling != 1 || e->y_sampling != 1)
            return fail(err, err_size, "%s: channel %s is subsampled; save it at full resolution", path, e->name.str);
    }
    int64_t width = (int64_t)r->window.max.x - r->window.min.x + 1,
            height = (int64_t)r->window.max.y - r->window.min.y + 1;
    if (!size_allowed(width, height))
        return fail(err, err_size, "%s: bad EXR size %lld x %lld", path, (long long)width, (long long)height);
    if (!tr_image_alloc(r->image, (int)width, (int)height, 3))
        return fail(err, err_size, "%s: out of memory for %lld x %lld pixels", path, (long long)width,
                    (long long)height);
    return true;
}

/* Reads the header; where that fails, there is nothing to finish. */
static exr_result_t start_exr(exr_context_t *context, const char *path, blob *b)
{
    exr_context_initializer_t init = EXR_DEFAULT_CONTEXT_INITIALIZER;
    init.error_handler_fn = exr_silent;
    init.user_data = b;
    init.read_fn = exr_read_blob;
    init.size_fn = exr_size_blob;
    init.max_image_width = init.max_image_height = IMAGE_MAX_SIDE;
    init.flags = EXR_CONTEXT_FLAG_SILENT_HEADER_PARSE | EXR_CONTEXT_FLAG_DISABLE_CHUNK_RECONSTRUCTION;
    return exr_start_read(context, path, &init);
}

static bool read_exr(const char *path, blob *b, const char *layer, tr_image *image, char *err, size_t err_size)
{
    exr_reader r;
    memset(&r, 0, sizeof r);
    r.layer = layer;
    r.image = image;
    exr_result_t rv = start_exr(&r.context, path, b);
    if (rv != EXR_ERR_SUCCESS)
        return exr_fail(path, "damaged EXR header", rv, err, err_size);
    exr_storage_t storage = EXR_STORAGE_SCANLINE;
    bool ok = read_exr_header(&r, path, &storage, err, err_size);
    if (ok) {
        rv = storage == EXR_STORAGE_TILED ? read_tiles(&r) : read_scanlines(&r);
        if (rv != EXR_ERR_SUCCESS)
            ok = exr_fail(path, "damaged or truncated EXR", rv, err, err_size);
    }
    exr_decoding_destroy(r.context, &r.decode);
    exr_finish(&r.context);
    if (ok && r.rgb[0] == r.rgb[1])
        for (size_t i = 0, n = pixel_count(image); i < n; ++i)
            image->data[3 * i + 1] = image->data[3 * i + 2] = image->data[3 * i];
    if (!ok)
        tr_image_free(image);
    return ok;
}

/* ---- >>read ------------------------------------------------------------------------------------------------- */

static float srgb_to_linear(float s) { return s <= 0.04045f ? s / 12.92f : powf((s + 0.055f) / 1.055f, 2.4f); }
static float linear_to_srgb(float l) { return l <= 0.0031308f ? 12.92f * l : 1.055f * powf(l, 1.0f / 2.4f) - 0.055f; }

/* 8- or 16-bit pictures. Exactly one of the two pixel pointers is used. */
static void decode_ldr(const stbi_uc *bytes, const stbi_us *words, bool raw, tr_image *image)
{
    size_t n = pixel_count(image) * 3;
    float table[256];
    for (int i = 0; i < 256; ++i)
        table[i] = raw ? (float)i / 255.0f : srgb_to_linear((float)i / 255.0f);
    if (bytes)
        for (size_t i = 0; i < n; ++i)
            image->data[i] = table[bytes[i]];
    else
        for (size_t i = 0; i < n; ++i) {
            float s = (float)words[i] / 65535.0f;
            image->data[i] = raw ? s : srgb_to_linear(s);
        }
}

static bool read_stb(const char *path, const blob *b, bool raw, tr_image *image, char *err, size_t err_size)
{
    int width = 0, height = 0, components = 0, size = (int)b->size;
    if (!stbi_info_from_memory(b->data, size, &width, &height, &components))
        return fail(err, err_size, "%s: not a picture that can be read (EXR, PNG, JPEG, TGA, BMP, HDR): %s", path,
                    stbi_failure_reason());
    if (!size_allowed(width, height))
        return fail(err, err_size, "%s: bad picture size %d x %d", path, width, height);
    void *pixels;
    bool hdr = stbi_is_hdr_from_memory(b->data, size), wide = !hdr && stbi_is_16_bit_from_memory(b->data, size);
    if (hdr)
        pixels = stbi_loadf_from_memory(b->data, size, &width, &height, &components, 3);
    else if (wide)
        pixels = stbi_load_16_from_memory(b->data, size, &width, &height, &components, 3);
    else
        pixels = stbi_load_from_memory(b->data, size, &width, &height, &components, 3);
    if (!pixels)
        return fail(err, err_size, "%s: damaged picture: %s", path, stbi_failure_reason());
    bool ok = tr_image_alloc(image, width, height, 3);
    if (!ok)
        fail(err, err_size, "%s: out of memory for %d x %d pixels", path, width, height);
    else if (hdr)
        memcpy(image->data, pixels, pixel_count(image) * 3 * sizeof(float));
    else
        decode_ldr(wide ? NULL : pixels, wide ? pixels : NULL, raw, image);
    stbi_image_free(pixels);
    return ok;
}

bool tr_image_read(const char *path, bool raw, tr_image *image, char *err, size_t err_size)
{
    static const unsigned char exr_magic[4] = {0x76, 0x2f, 0x31, 0x01};
    blob b = {0};
    memset(image, 0, sizeof *image);
    bool ok = blob_read_file(&b, path, err, err_size);
    if (ok) {
        if (b.size == 0)
            ok = fail(err, err_size, "%s: the file is empty", path);
        else if (b.size >= 4 && memcmp(b.data, exr_magic, 4) == 0)
            ok = read_exr(path, &b, NULL, image, err, err_size);
        else
            ok = read_stb(path, &b, raw, image, err, err_size);
    }
    free(b.data);
    return ok;
}

bool tr_exr_read_layer(const char *path, const char *layer, tr_image *image, char *err, size_t err_size)
{
    blob b = {0};
    memset(image, 0, sizeof *image);
    bool ok = blob_read_file(&b, path, err, err_size) && read_exr(path, &b, layer, image, err, err_size);
    free(b.data);
    return ok;
}

bool tr_exr_read_attribute(const char *path, const char *name, char *value, size_t size)
{
    blob b = {0};
    exr_context_t context;
    const char *text = NULL;
    char err[256];
    int32_t length = 0;
    bool ok = blob_read_file(&b, path, err, sizeof err) && start_exr(&context, path, &b) == EXR_ERR_SUCCESS;
    if (ok) {
        ok = exr_attr_get_string(context, 0, name, &length, &text) == EXR_ERR_SUCCESS && text;
        if (ok)
            snprintf(value, size, "%.*s", (int)length, text);
        exr_finish(&context);
    }
    free(b.data);
    return ok;
}

/* ---- >>write-exr -------------------------------------------------------------------------------------------- */

static int64_t exr_write_blob(exr_const_context_t context, void *user, const void *buffer, uint64_t size,
                              uint64_t offset, exr_stream_error_func_ptr_t error)
{
    blob *b = user;
    (void)context;
    (void)error;
    if (offset > SIZE_MAX - size || !blob_reserve(b, (size_t)(offset + size)))
        return -1;
    memcpy(b->data + offset, buffer, (size_t)size);
    if (offset + size > b->size)
        b->size = (size_t)(offset + size);
    return (int64_t)size;
}

#define EXR_MAX_CHANNELS 64
#define EXR_NAME_SIZE 64

/* Where a channel's values come from. */
typedef struct exr_source {
    char name[EXR_NAME_SIZE];
    const tr_image *image;
    int channel;
    bool full_float;
} exr_source;

/* Split the layers' comma lists. Returns the number of channels, 0 on an error. */
static int list_sources(const char *path, const tr_layer *layers, int layer_count, exr_source *sources, char *err,
                        size_t err_size)
{
    int count = 0;
    for (int l = 0; l < layer_count; ++l) {
        const tr_image *image = layers[l].image;
        if (!image || !image->data || image->width != layers[0].image->width ||
            image->height != layers[0].image->height) {
            fail(err, err_size, "%s: layer %s is missing or differs in size from the first", path, layers[l].names);
            return 0;
        }
        const char *s = layers[l].names;
        for (int c = 0; c < image->channels; ++c) {
            size_t length = strcspn(s, ",");
            bool last = s[length] == 0;
            if (!length || length >= EXR_NAME_SIZE || count >= EXR_MAX_CHANNELS || last != (c + 1 == image->channels)) {
                fail(err, err_size, "%s: layer \"%s\" must name each of its %d channels", path, layers[l].names,
                     image->channels);
                return 0;
            }
            exr_source *source = &sources[count];
            memcpy(source->name, s, length);
            source->name[length] = 0;
            source->image = image;
            source->channel = c;
            source->full_float = layers[l].full_float;
            for (int i = 0; i < count; ++i)
                if (strcmp(sources[i].name, source->name) == 0) {
                    fail(err, err_size, "%s: two channels are named %s", path, source->name);
                    return 0;
                }
            ++count;
            s += length + !last;
        }
    }
    return count;
}

/* Half floats end at 65504; a brighter pixel becomes that rather than infinite, so that it can still be measured. */
static void gather_lines(const exr_source *source, int y, int lines, float *out)
{
    const tr_image *image = source->image;
    size_t n = (size_t)lines * (size_t)image->width, step = (size_t)image->channels;
    const float *in = image->data + (size_t)y * (size_t)image->width * step + (size_t)source->channel;
    for (size_t i = 0; i < n; ++i) {
        float v = in[i * step];
        if (!source->full_float && isfinite(v))
            v = clampf(v, -HALF_MAX, HALF_MAX);
        out[i] = v;
    }
}

static exr_result_t write_chunks(exr_context_t context, const exr_source *sources, int count, float *scratch, int lines)
{
    int width = sources[0].image->width, height = sources[0].image->height;
    exr_encode_pipeline_t encode = EXR_ENCODE_PIPELINE_INITIALIZER;
    exr_result_t rv = EXR_ERR_SUCCESS;
    for (int y = 0; rv == EXR_ERR_SUCCESS && y < height; y += lines) {
        exr_chunk_info_t chunk;
        int here = height - y < lines ? height - y : lines;
        rv = exr_write_scanline_chunk_info(context, 0, y, &chunk);
        if (rv == EXR_ERR_SUCCESS)
            rv = y == 0 ? exr_encoding_initialize(context, 0, &chunk, &encode)
                        : exr_encoding_update(context, 0, &chunk, &encode);
        if (rv != EXR_ERR_SUCCESS)
            break;
        for (int c = 0; c < encode.channel_count; ++c) { /* sorted by name, unlike our list */
            exr_coding_channel_info_t *info = &encode.channels[c];
            float *plane = scratch + (size_t)c * (size_t)lines * (size_t)width;
            int s = 0;
            while (s < count - 1 && strcmp(sources[s].name, info->channel_name) != 0)
                ++s;
            gather_lines(&sources[s], y, here, plane);
            info->encode_from_ptr = (const uint8_t *)plane;
            info->user_bytes_per_element = 4;
            info->user_data_type = EXR_PIXEL_FLOAT;
            info->user_pixel_stride = 4;
            info->user_line_stride = width * 4;
        }
        if (y == 0)
            rv = exr_encoding_choose_default_routines(context, 0, &encode);
        if (rv == EXR_ERR_SUCCESS)
            rv = exr_encoding_run(context, 0, &encode);
    }
    exr_encoding_destroy(context, &encode);
    return rv;
}

static exr_result_t encode_exr(blob *b, const char *path, const exr_source *sources, int count,
                               const tr_attribute *attributes, int attribute_count)
{
    exr_context_t context = NULL;
    exr_context_initializer_t init = EXR_DEFAULT_CONTEXT_INITIALIZER;
    init.error_handler_fn = exr_silent;
    init.user_data = b;
    init.write_fn = exr_write_blob;
    exr_result_t rv = exr_start_write(&context, path, EXR_WRITE_FILE_DIRECTLY, &init);
    if (rv != EXR_ERR_SUCCESS)
        return rv;
    int part = 0, width = sources[0].image->width, height = sources[0].image->height;
    int32_t lines = 0;
    rv = exr_add_part(context, NULL, EXR_STORAGE_SCANLINE, &part);
    if (rv == EXR_ERR_SUCCESS)
        rv = exr_initialize_required_attr_simple(context, part, width, height, EXR_COMPRESSION_ZIP);
    for (int i = 0; rv == EXR_ERR_SUCCESS && i < count; ++i)
        rv = exr_add_channel(context, part, sources[i].name, sources[i].full_float ? EXR_PIXEL_FLOAT : EXR_PIXEL_HALF,
                             EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1);
    for (int i = 0; rv == EXR_ERR_SUCCESS && i < attribute_count; ++i)
        rv = exr_attr_set_string(context, part, attributes[i].name, attributes[i].value);
    if (rv == EXR_ERR_SUCCESS)
        rv = exr_write_header(context);
    if (rv == EXR_ERR_SUCCESS)
        rv = exr_get_scanlines_per_chunk(context, part, &lines);
    if (rv == EXR_ERR_SUCCESS) {
        float *scratch = malloc((size_t)count * (size_t)lines * (size_t)width * sizeof(float));
        rv = scratch ? write_chunks(context, sources, count, scratch, lines) : EXR_ERR_OUT_OF_MEMORY;
        free(scratch);
    }
    exr_result_t end = exr_finish(&context);
    return rv == EXR_ERR_SUCCESS ? end : rv;
}

bool tr_exr_write_attributes(const char *path, const tr_layer *layers, int layer_count, const tr_attribute *attributes,
                             int attribute_count, char *err, size_t err_size)
{
    exr_source sources[EXR_MAX_CHANNELS];
    if (layer_count < 1 || !layers[0].image)
        return fail(err, err_size, "%s: nothing to write", path);
    int count = list_sources(path, layers, layer_count, sources, err, err_size);
    if (!count)
        return false;
    blob b = {0};
    exr_result_t rv = encode_exr(&b, path, sources, count, attributes, attribute_count);
    bool ok = rv == EXR_ERR_SUCCESS ? blob_write_file(&b, path, err, err_size)
                                    : exr_fail(path, "cannot build the EXR", rv, err, err_size);
    free(b.data);
    return ok;
}

bool tr_exr_write(const char *path, const tr_layer *layers, int layer_count, char *err, size_t err_size)
{
    return tr_exr_write_attributes(path, layers, layer_count, NULL, 0, err, err_size);
}

/* ---- >>write-png -------------------------------------------------------------------------------------------- */

static float luminance(const tr_image *image, size_t pixel)
{
    const float *p = image->data + pixel * (size_t)image->channels;
    return image->channels < 3 ? p[0] : 0.2126f * p[0] + 0.7152f * p[1] + 0.0722f * p[2];
}

static int compare_float(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

/* The mean luminance goes to middle grey, 0.18. The brightest hundredth is left out: a lamp in the picture, or
   fireflies, would darken everything else. */
float tr_auto_exposure(const tr_image *image)
{
    size_t n = image && image->data ? pixel_count(image) : 0, used = 0;
    float *values = malloc((n ? n : 1) * sizeof *values);
    if (!values)
        return 1;
    for (size_t i = 0; i < n; ++i) {
        float l = luminance(image, i);
        if (isfinite(l))
            values[used++] = fmaxf(l, 0);
    }
    qsort(values, used, sizeof *values, compare_float);
    used -= used / 100;
    double sum = 0;
    for (size_t i = 0; i < used; ++i)
        sum += values[i];
    free(values);
    double mean = used ? sum / (double)used : 0, exposure = 0.18 / mean;
    return mean > 0 && exposure < 1e30 ? (float)exposure : 1.0f;
}

static void png_to_blob(void *context, void *data, int size)
{
    blob *b = context;
    if (size > 0 && blob_reserve(b, b->size + (size_t)size)) {
        memcpy(b->data + b->size, data, (size_t)size);
        b->size += (size_t)size;
    }
}

bool tr_png_write(const char *path, const tr_image *image, float exposure, char *err, size_t err_size)
{
    if (!image->data || !size_allowed(image->width, image->height))
        return fail(err, err_size, "%s: nothing to write", path);
    if (!(exposure > 0) || !isfinite(exposure))
        exposure = tr_auto_exposure(image);
    int channels = image->channels < 3 ? 1 : 3;
    size_t n = pixel_count(image);
    unsigned char *bytes = malloc(n * (size_t)channels);
    if (!bytes)
        return fail(err, err_size, "%s: out of memory", path);
    for (size_t i = 0; i < n; ++i)
        for (int c = 0; c < channels; ++c) {
            float v = image->data[i * (size_t)image->channels + (size_t)c] * exposure;
            v = v > 0 ? fminf(v, 1) : 0; /* NaN becomes black */
            bytes[i * (size_t)channels + (size_t)c] = (unsigned char)(linear_to_srgb(v) * 255.0f + 0.5f);
        }
    blob b = {0};
    int done =
        stbi_write_png_to_func(png_to_blob, &b, image->width, image->height, channels, bytes, image->width * channels);
    free(bytes);
    bool ok =
        done && b.size ? blob_write_file(&b, path, err, err_size) : fail(err, err_size, "%s: out of memory", path);
    free(b.data);
    return ok;
}

/* ---- >>measures --------------------------------------------------------------------------------------------- */

bool tr_image_downsample(const tr_image *image, int w, int h, tr_image *out)
{
    memset(out, 0, sizeof *out);
    if (!image->data || w < 1 || h < 1 || image->width % w || image->height % h ||
        image->width / w != image->height / h)
        return false;
    if (!tr_image_alloc(out, w, h, image->channels))
        return false;
    int factor = image->width / w, channels = image->channels;
    double scale = 1.0 / ((double)factor * factor);
    for (int y = 0; y < h; ++y)
        for (int x = 0; x < w; ++x)
            for (int c = 0; c < channels; ++c) {
                double sum = 0;
                for (int j = 0; j < factor; ++j)
                    for (int i = 0; i < factor; ++i)
                        sum += image->data[(((size_t)y * (size_t)factor + (size_t)j) * (size_t)image->width +
                                            (size_t)x * (size_t)factor + (size_t)i) *
                                               (size_t)channels +
                                           (size_t)c];
                out->data[((size_t)y * (size_t)w + (size_t)x) * (size_t)channels + (size_t)c] = (float)(sum * scale);
            }
    return true;
}

static int compare_double(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Mean of all values and of all but the worst thousandth; sorts them. */
static void trimmed_mean(double *values, size_t n, double *trimmed, double *untrimmed)
{
    qsort(values, n, sizeof *values, compare_double);
    size_t keep = n - n / 1000;
    double sum = 0;
    for (size_t i = 0; i < keep; ++i)
        sum += values[i];
    *trimmed = sum / (double)keep;
    for (size_t i = keep; i < n; ++i)
        sum += values[i];
    *untrimmed = sum / (double)n;
}

/* Pixels with a NaN or an infinity in them. */
static size_t bad_pixels(const tr_image *image)
{
    size_t bad = 0, channels = (size_t)image->channels;
    for (size_t i = 0, n = pixel_count(image); i < n; ++i) {
        bool good = true;
        for (size_t c = 0; c < channels; ++c)
            good = good && isfinite(image->data[i * channels + c]);
        bad += !good;
    }
    return bad;
}

static bool comparable(const tr_image *image, const tr_image *reference, double *mean, char *err, size_t err_size)
{
    if (!image->data || !reference->data)
        return fail(err, err_size, "an image is empty");
    if (image->width != reference->width || image->height != reference->height ||
        image->channels != reference->channels)
        return fail(err, err_size, "the image has %d x %d pixels of %d channels, the reference %d x %d of %d",
                    image->width, image->height, image->channels, reference->width, reference->height,
                    reference->channels);
    size_t bad = bad_pixels(image), bad_reference = bad_pixels(reference);
    if (bad || bad_reference)
        return fail(err, err_size, "%zu pixels of the %s are NaN or infinite", bad ? bad : bad_reference,
                    bad ? "image" : "reference");
    size_t n = pixel_count(reference) * (size_t)reference->channels;
    double sum = 0;
    for (size_t i = 0; i < n; ++i)
        sum += reference->data[i];
    *mean = sum / (double)n;
    if (!(*mean > 0))
        return fail(err, err_size, "the reference is black: errors relative to it have no meaning");
    return true;
}

bool tr_image_error(const tr_image *image, const tr_image *reference, tr_error *error, char *err, size_t err_size)
{
    double mean = 0;
    memset(error, 0, sizeof *error);
    if (!comparable(image, reference, &mean, err, err_size))
        return false;
    size_t n = pixel_count(image), channels = (size_t)image->channels;
    double scale = 0.5 / mean, *square = malloc(2 * n * sizeof *square);
    if (!square)
        return fail(err, err_size, "out of memory");
    double *absolute = square + n;
    for (size_t i = 0; i < n; ++i) {
        double s = 0, a = 0;
        for (size_t c = 0; c < channels; ++c) {
            double v = image->data[i * channels + c] * scale, r = reference->data[i * channels + c] * scale;
            s += (v - r) * (v - r) / (r * r + 0.01);
            a += fabs(v - r) / (fmax(r, 0) + 0.01); /* a reference can be slightly negative: filters with lobes */
        }
        square[i] = s / (double)channels;
        absolute[i] = a / (double)channels;
    }
    trimmed_mean(square, n, &error->relmse, &error->relmse_untrimmed);
    trimmed_mean(absolute, n, &error->mrae, &error->mrae_untrimmed);
    free(square);
    return true;
}
