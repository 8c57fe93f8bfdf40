/* test_image.c: EXR and PNG round trips, broken files, downsampling and error measures.

   Truth from outside: values written by hand or through OpenEXR directly, and measures worked out on paper. */
#define _POSIX_C_SOURCE 200809L /* mkdtemp */
#include "cmocka_prelude.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <OpenEXR/openexr.h>

#include "tracer.h"

static char folder[64];
static char err[512];

static const char *scratch(const char *name)
{
    static char path[2][160];
    static int turn;
    turn ^= 1;
    snprintf(path[turn], sizeof path[turn], "%s/%s", folder, name);
    return path[turn];
}

static int make_folder(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/test_image.XXXXXX");
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    static const char *const names[] = {"a.exr", "b.exr", "c.exr", "broken.exr", "broken.png", "a.png", "a.hdr"};
    (void)state;
    for (size_t i = 0; i < sizeof names / sizeof *names; ++i)
        remove(scratch(names[i]));
    return rmdir(folder);
}

static void fill(tr_image *image, int w, int h, int channels, uint64_t seed)
{
    assert_true(tr_image_alloc(image, w, h, channels));
    tr_rng rng = rng_seed(seed, 1);
    for (int i = 0; i < w * h * channels; ++i)
        image->data[i] = expf(8 * rng_float(&rng) - 4);
}

static unsigned char *slurp(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    fseek(file, 0, SEEK_END);
    *size = (size_t)ftell(file);
    rewind(file);
    unsigned char *data = malloc(*size + 1);
    assert_int_equal(fread(data, 1, *size, file), *size);
    fclose(file);
    return data;
}

static void spit(const char *path, const void *data, size_t size)
{
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    assert_int_equal(fwrite(data, 1, size, file), size);
    fclose(file);
}

/* ---- sizes -------------------------------------------------------------------------------------------------- */

static void bad_sizes_are_refused(void **state)
{
    static const int bad[][3] = {
        {0, 4, 3}, {4, 0, 3},     {-1, 4, 3},    {4, -1, 3},        {4, 4, 0},
        {4, 4, 5}, {65537, 1, 3}, {1, 65537, 3}, {65536, 65536, 1}, {2147483647, 2147483647, 4}};
    (void)state;
    for (size_t i = 0; i < sizeof bad / sizeof *bad; ++i) {
        tr_image image;
        assert_false(tr_image_alloc(&image, bad[i][0], bad[i][1], bad[i][2]));
        assert_null(image.data);
        tr_image_free(&image);
    }
}

/* ---- EXR ---------------------------------------------------------------------------------------------------- */

static void exr_round_trip_keeps_colours_within_half_precision(void **state)
{
    static const int sizes[][2] = {{1, 1}, {3, 40}, {64, 16}, {37, 21}};
    (void)state;
    for (size_t s = 0; s < 4; ++s) {
        tr_image image, back;
        fill(&image, sizes[s][0], sizes[s][1], 3, s);
        tr_layer layer = {"R,G,B", &image, false};
        assert_true(tr_exr_write(scratch("a.exr"), &layer, 1, err, sizeof err));
        assert_true(tr_image_read(scratch("a.exr"), false, &back, err, sizeof err));
        assert_int_equal(back.width, image.width);
        assert_int_equal(back.height, image.height);
        assert_int_equal(back.channels, 3);
        for (int i = 0; i < image.width * image.height * 3; ++i)
            assert_true(fabsf(back.data[i] - image.data[i]) <= 0x1p-11f * image.data[i]);
        tr_image_free(&back);
        tr_image_free(&image);
    }
}

/* Read one channel of a file by the library, as a check on both our writer and our reader. */
static void read_channel(const char *path, const char *name, exr_pixel_type_t *type, float *out, int width, int height)
{
    exr_context_t context = NULL;
    assert_int_equal(exr_start_read(&context, path, NULL), 0);
    for (int y = 0; y < height; y += 16) {
        exr_chunk_info_t chunk;
        exr_decode_pipeline_t decode = EXR_DECODE_PIPELINE_INITIALIZER;
        assert_int_equal(exr_read_scanline_chunk_info(context, 0, y, &chunk), 0);
        assert_int_equal(exr_decoding_initialize(context, 0, &chunk, &decode), 0);
        int found = 0;
        for (int c = 0; c < decode.channel_count; ++c) {
            exr_coding_channel_info_t *info = &decode.channels[c];
            info->decode_to_ptr = NULL;
            if (strcmp(info->channel_name, name) == 0) {
                found = 1;
                *type = (exr_pixel_type_t)info->data_type;
                info->decode_to_ptr = (uint8_t *)(out + y * width);
            }
            info->user_bytes_per_element = 4;
            info->user_data_type = EXR_PIXEL_FLOAT;
            info->user_pixel_stride = 4;
            info->user_line_stride = width * 4;
        }
        assert_true(found);
        assert_int_equal(exr_decoding_choose_default_routines(context, 0, &decode), 0);
        assert_int_equal(exr_decoding_run(context, 0, &decode), 0);
        exr_decoding_destroy(context, &decode);
    }
    exr_finish(&context);
}

static void exr_layers_arrive_under_their_names(void **state)
{
    enum { W = 23, H = 35 };
    tr_image color, variance, cell, back;
    float plane[W * H];
    exr_pixel_type_t type;
    (void)state;
    fill(&color, W, H, 3, 1);
    fill(&variance, W, H, 3, 2);
    fill(&cell, W, H, 1, 3);
    for (int i = 0; i < W * H; ++i)
        cell.data[i] = (float)(16777216 - i); /* needs all 24 bits */
    tr_layer layers[] = {
        {"variance.R,variance.G,variance.B", &variance, false}, {"R,G,B", &color, false}, {"cell.Y", &cell, true}};
    assert_true(tr_exr_write(scratch("a.exr"), layers, 3, err, sizeof err));
    read_channel(scratch("a.exr"), "cell.Y", &type, plane, W, H);
    assert_int_equal(type, EXR_PIXEL_FLOAT);
    assert_memory_equal(plane, cell.data, sizeof plane);
    read_channel(scratch("a.exr"), "variance.G", &type, plane, W, H);
    assert_int_equal(type, EXR_PIXEL_HALF);
    for (int i = 0; i < W * H; ++i)
        assert_true(fabsf(plane[i] - variance.data[3 * i + 1]) <= 0x1p-11f * plane[i] * 1.01f);
    assert_true(tr_image_read(scratch("a.exr"), false, &back, err, sizeof err)); /* the main layer wins */
    for (int i = 0; i < W * H * 3; ++i)
        assert_true(fabsf(back.data[i] - color.data[i]) <= 0x1p-11f * color.data[i]);
    tr_image_free(&back);
    tr_image_free(&color);
    tr_image_free(&variance);
    tr_image_free(&cell);
}

static void exr_half_clamps_what_is_finite_and_keeps_what_is_not(void **state)
{
    tr_image image, back;
    (void)state;
    assert_true(tr_image_alloc(&image, 2, 1, 3));
    image.data[0] = 1e9f;
    image.data[1] = -1e9f;
    image.data[2] = NAN;
    image.data[3] = INFINITY;
    tr_layer layer = {"R,G,B", &image, false};
    assert_true(tr_exr_write(scratch("a.exr"), &layer, 1, err, sizeof err));
    assert_true(tr_image_read(scratch("a.exr"), false, &back, err, sizeof err));
    assert_true(back.data[0] == 65504 && back.data[1] == -65504 && isnan(back.data[2]) && isinf(back.data[3]));
    tr_image_free(&back);
    tr_image_free(&image);
}

static void exr_grey_and_layered_colours_are_found(void **state)
{
    static const struct {
        const char *names;
        int channels;
    } cases[] = {{"Y", 1}, {"diffuse.R,diffuse.G,diffuse.B", 3}, {"depth.Y", 1}, {"Z", 1}};
    (void)state;
    for (size_t k = 0; k < 4; ++k) {
        tr_image image, back;
        fill(&image, 5, 4, cases[k].channels, k);
        tr_layer layer = {cases[k].names, &image, true};
        assert_true(tr_exr_write(scratch("a.exr"), &layer, 1, err, sizeof err));
        assert_true(tr_image_read(scratch("a.exr"), false, &back, err, sizeof err));
        for (int i = 0; i < 60; ++i)
            assert_true(back.data[i] == image.data[cases[k].channels == 1 ? i / 3 : i]);
        tr_image_free(&back);
        tr_image_free(&image);
    }
}

/* Tiles, an offset window, and half, float and integer channels in one file: written by the library itself. */
static void exr_tiles_offsets_and_all_pixel_types_are_read(void **state)
{
    enum { W = 21, H = 13, T = 8 };
    static float planes[3][T * T]; /* B, G, R: sorted */
    exr_context_t context = NULL;
    int part;
    (void)state;
    assert_int_equal(exr_start_write(&context, scratch("b.exr"), EXR_WRITE_FILE_DIRECTLY, NULL), 0);
    assert_int_equal(exr_add_part(context, "tiles", EXR_STORAGE_TILED, &part), 0);
    exr_attr_box2i_t window = {{{{-3, 5}}}, {{{-3 + W - 1, 5 + H - 1}}}};
    exr_attr_v2f_t center = {{{0, 0}}};
    assert_int_equal(exr_initialize_required_attr(context, part, &window, &window, 1, &center, 1,
                                                  EXR_LINEORDER_INCREASING_Y, EXR_COMPRESSION_PIZ),
                     0);
    assert_int_equal(exr_set_tile_descriptor(context, part, T, T, EXR_TILE_ONE_LEVEL, EXR_TILE_ROUND_DOWN), 0);
    static const exr_pixel_type_t types[3] = {EXR_PIXEL_UINT, EXR_PIXEL_FLOAT, EXR_PIXEL_HALF};
    static const char *const names[3] = {"B", "G", "R"};
    for (int c = 0; c < 3; ++c)
        assert_int_equal(exr_add_channel(context, part, names[c], types[c], EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1), 0);
    assert_int_equal(exr_write_header(context), 0);
    for (int ty = 0; ty * T < H; ++ty)
        for (int tx = 0; tx * T < W; ++tx) {
            exr_chunk_info_t chunk;
            exr_encode_pipeline_t encode = EXR_ENCODE_PIPELINE_INITIALIZER;
            assert_int_equal(exr_write_tile_chunk_info(context, part, tx, ty, 0, 0, &chunk), 0);
            assert_int_equal(exr_encoding_initialize(context, part, &chunk, &encode), 0);
            for (int c = 0; c < 3; ++c) {
                for (int i = 0; i < T * T; ++i) {
                    int x = tx * T + i % T, y = ty * T + i / T;
                    float v = c == 0 ? (float)(x + 100 * y) : c == 1 ? (float)x / 7 : (float)y + 0.5f;
                    planes[c][i] = v;
                }
                encode.channels[c].encode_from_ptr = (const uint8_t *)planes[c];
                encode.channels[c].user_bytes_per_element = 4;
                encode.channels[c].user_data_type = EXR_PIXEL_FLOAT;
                encode.channels[c].user_pixel_stride = 4;
                encode.channels[c].user_line_stride = 4 * T;
            }
            assert_int_equal(exr_encoding_choose_default_routines(context, part, &encode), 0);
            assert_int_equal(exr_encoding_run(context, part, &encode), 0);
            exr_encoding_destroy(context, &encode);
        }
    assert_int_equal(exr_finish(&context), 0);

    tr_image back;
    assert_true(tr_image_read(scratch("b.exr"), false, &back, err, sizeof err));
    assert_int_equal(back.width, W);
    assert_int_equal(back.height, H);
    for (int y = 0; y < H; ++y)
        for (int x = 0; x < W; ++x) {
            const float *p = back.data + 3 * (y * W + x);
            assert_true(p[0] == (float)y + 0.5f && p[1] == (float)x / 7 && p[2] == (float)(x + 100 * y));
        }
    tr_image_free(&back);
}

static void exr_writer_refuses_bad_layers_and_paths(void **state)
{
    tr_image a, b;
    (void)state;
    fill(&a, 4, 4, 3, 1);
    fill(&b, 5, 4, 3, 2);
    tr_layer wrong_count = {"R,G", &a, false}, too_many = {"R,G,B,A", &a, false}, empty = {"R,,B", &a, false};
    tr_layer sizes[] = {{"R,G,B", &a, false}, {"x.R,x.G,x.B", &b, false}};
    tr_layer twice[] = {{"R,G,B", &a, false}, {"x.R,G,x.B", &a, false}}, good = {"R,G,B", &a, false};
    assert_false(tr_exr_write(scratch("c.exr"), &wrong_count, 1, err, sizeof err));
    assert_false(tr_exr_write(scratch("c.exr"), &too_many, 1, err, sizeof err));
    assert_false(tr_exr_write(scratch("c.exr"), &empty, 1, err, sizeof err));
    assert_false(tr_exr_write(scratch("c.exr"), sizes, 2, err, sizeof err));
    assert_false(tr_exr_write(scratch("c.exr"), twice, 2, err, sizeof err));
    assert_false(tr_exr_write(scratch("c.exr"), &good, 0, err, sizeof err));
    err[0] = 0;
    assert_false(tr_exr_write("/no/such/folder/a.exr", &good, 1, err, sizeof err));
    assert_non_null(strstr(err, "/no/such/folder/a.exr"));
    assert_false(tr_exr_write("/dev/full", &good, 1, err, sizeof err)); /* a full disk */
    assert_false(tr_png_write("/dev/full", &a, 1, err, sizeof err));
    tr_image_free(&a);
    tr_image_free(&b);
}

/* ---- broken files ------------------------------------------------------------------------------------------- */

static void expect_refused(const char *path)
{
    tr_image image;
    err[0] = 0;
    assert_false(tr_image_read(path, false, &image, err, sizeof err));
    assert_true(err[0] != 0 && !strchr(err, '\n'));
    assert_null(image.data);
}

static void missing_empty_and_foreign_files_are_refused(void **state)
{
    (void)state;
    expect_refused(scratch("not-there.exr"));
    expect_refused(folder);
    spit(scratch("broken.exr"), "", 0);
    expect_refused(scratch("broken.exr"));
    spit(scratch("broken.exr"), "hello, this is not a picture", 28);
    expect_refused(scratch("broken.exr"));
    spit(scratch("broken.exr"), "\x76\x2f\x31\x01", 4);
    expect_refused(scratch("broken.exr"));
}

static void write_samples(void)
{
    tr_image color, cell;
    fill(&color, 19, 37, 3, 5);
    fill(&cell, 19, 37, 1, 6);
    tr_layer layers[] = {{"R,G,B", &color, false}, {"cell.Y", &cell, true}};
    assert_true(tr_exr_write(scratch("a.exr"), layers, 2, err, sizeof err));
    assert_true(tr_png_write(scratch("a.png"), &color, 1, err, sizeof err));
    tr_image_free(&color);
    tr_image_free(&cell);
}

static void truncated_files_are_refused(void **state)
{
    (void)state;
    write_samples();
    size_t size;
    unsigned char *data = slurp(scratch("a.exr"), &size);
    for (size_t n = 0; n < size; n += n < 600 || n > size - 20 ? 1 : 13) {
        spit(scratch("broken.exr"), data, n);
        expect_refused(scratch("broken.exr"));
    }
    free(data);
    data = slurp(scratch("a.png"), &size);
    for (size_t n = 0; n < size - 16; n += 7) { /* past there only the end marker is missing */
        spit(scratch("broken.png"), data, n);
        expect_refused(scratch("broken.png"));
    }
    free(data);
}

/* Not every flip can be noticed (a name, a pixel of the PNG), but none may crash, hang or leak. */
static void flipped_bits_do_no_harm(void **state)
{
    (void)state;
    write_samples();
    static const char *const names[3] = {"a.exr", "b.exr", "a.png"};
    int refused[3] = {0, 0, 0};
    for (int k = 0; k < 3; ++k) {
        size_t size;
        unsigned char *data = slurp(scratch(names[k]), &size);
        tr_rng rng = rng_seed(7, (uint64_t)k);
        for (int i = 0; i < 1500; ++i) {
            size_t range = i % 2 && size > 500 ? 500 : size; /* half of them in the header */
            size_t at = rng_u32(&rng) % range;
            unsigned char old = data[at];
            data[at] ^= (unsigned char)(i % 5 ? 1u << (rng_u32(&rng) & 7) : rng_u32(&rng) | 1);
            spit(scratch("broken.exr"), data, size);
            data[at] = old;
            tr_image image;
            err[0] = 0;
            if (!tr_image_read(scratch("broken.exr"), false, &image, err, sizeof err)) {
                ++refused[k];
                assert_true(err[0] != 0);
            }
            tr_image_free(&image);
        }
        free(data);
    }
    assert_true(refused[0] > 300 && refused[1] > 300);
}

static void random_bytes_after_a_magic_number_are_refused(void **state)
{
    static const unsigned char magic[3][8] = {{0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0},
                                              {0x89, 'P', 'N', 'G', 13, 10, 26, 10},
                                              {0xff, 0xd8, 0xff, 0xe0, 0, 16, 'J', 'F'}};
    unsigned char data[600];
    (void)state;
    tr_rng rng = rng_seed(11, 0);
    for (int i = 0; i < 600; ++i) {
        for (size_t j = 0; j < sizeof data; ++j)
            data[j] = (unsigned char)rng_u32(&rng);
        memcpy(data, magic[i % 3], 8);
        spit(scratch("broken.exr"), data, 16 + rng_u32(&rng) % (sizeof data - 16));
        expect_refused(scratch("broken.exr"));
    }
}

/* ---- PNG and HDR -------------------------------------------------------------------------------------------- */

static void png_holds_the_srgb_curve_of_exposed_pixels(void **state)
{
    tr_image image, back, raw;
    (void)state;
    assert_true(tr_image_alloc(&image, 4, 1, 3));
    static const float in[12] = {0, 0.25f, 0.5f, 1, 2, -1, NAN, INFINITY, 0.001f, 0.1f, 0.05f, 0.4f};
    memcpy(image.data, in, sizeof in);
    assert_true(tr_png_write(scratch("a.png"), &image, 2, err, sizeof err));
    assert_true(tr_image_read(scratch("a.png"), false, &back, err, sizeof err));
    assert_true(tr_image_read(scratch("a.png"), true, &raw, err, sizeof err));
    assert_int_equal(back.width, 4);
    /* 0.5 -> 188, 0.2 -> 124, 0.1 -> 89, 0.8 -> 231, 0.002 -> 7 of 255 in sRGB (IEC 61966-2-1) */
    static const float bytes[12] = {0, 188, 255, 255, 255, 0, 0, 255, 7, 124, 89, 231};
    for (int i = 0; i < 12; ++i) {
        assert_true(fabsf(raw.data[i] * 255 - bytes[i]) < 0.01f);
        float clipped = isnan(in[i]) ? 0 : clampf(in[i] * 2, 0, 1);
        assert_true(fabsf(back.data[i] - clipped) < 0.006f);
    }
    tr_image_free(&image);
    tr_image_free(&back);
    tr_image_free(&raw);
}

static void one_channel_png_is_grey(void **state)
{
    tr_image image, back;
    (void)state;
    fill(&image, 6, 3, 1, 4);
    assert_true(tr_png_write(scratch("a.png"), &image, 0, err, sizeof err));
    assert_true(tr_image_read(scratch("a.png"), false, &back, err, sizeof err));
    for (int i = 0; i < 18; ++i)
        assert_true(back.data[3 * i] == back.data[3 * i + 1] && back.data[3 * i] == back.data[3 * i + 2]);
    tr_image_free(&image);
    tr_image_free(&back);
}

static void radiance_hdr_is_read_linear(void **state)
{
    /* One pixel of RGBE: mantissas 128, 64, 32 at exponent 129 are 1, 0.5, 0.25. */
    static const char text[] = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n";
    unsigned char data[80];
    tr_image back;
    (void)state;
    memcpy(data, text, sizeof text - 1);
    memcpy(data + sizeof text - 1, "\x80\x40\x20\x81", 4);
    spit(scratch("a.hdr"), data, sizeof text - 1 + 4);
    assert_true(tr_image_read(scratch("a.hdr"), false, &back, err, sizeof err));
    assert_true(back.data[0] == 1 && back.data[1] == 0.5f && back.data[2] == 0.25f);
    tr_image_free(&back);
}

static void auto_exposure_ignores_fireflies_and_survives_black(void **state)
{
    tr_image image;
    (void)state;
    assert_true(tr_image_alloc(&image, 20, 20, 3));
    assert_true(tr_auto_exposure(&image) == 1);
    for (int i = 0; i < 1200; ++i)
        image.data[i] = 0.36f;
    assert_true(fabsf(tr_auto_exposure(&image) - 0.5f) < 1e-5f);
    image.data[3] = image.data[4] = image.data[5] = 1e20f;
    image.data[9] = NAN;
    assert_true(fabsf(tr_auto_exposure(&image) - 0.5f) < 1e-5f);
    tr_image_free(&image);
}

/* ---- measures ----------------------------------------------------------------------------------------------- */

static void downsampling_averages_blocks_exactly(void **state)
{
    tr_image image, out;
    (void)state;
    assert_true(tr_image_alloc(&image, 6, 4, 2));
    for (int i = 0; i < 48; ++i)
        image.data[i] = (float)i;
    assert_true(tr_image_downsample(&image, 3, 2, &out));
    /* the block at (0, 0), channel 0: pixels 0, 1, 6, 7 hold 0, 2, 12, 14 */
    assert_true(out.data[0] == 7 && out.data[1] == 8);
    /* the block at (2, 1): pixels 16, 17, 22, 23 hold 32, 34, 44, 46 */
    assert_true(out.data[10] == 39 && out.data[11] == 40);
    tr_image_free(&out);
    assert_true(tr_image_downsample(&image, 6, 4, &out));
    assert_memory_equal(out.data, image.data, 48 * sizeof(float));
    tr_image_free(&out);
    assert_false(tr_image_downsample(&image, 4, 4, &out));
    assert_false(tr_image_downsample(&image, 3, 4, &out));
    assert_false(tr_image_downsample(&image, 0, 0, &out));
    assert_false(tr_image_downsample(&image, 12, 8, &out));
    tr_image_free(&image);
}

static void measures_agree_with_paper(void **state)
{
    tr_image image, reference;
    tr_error e;
    (void)state;
    assert_true(tr_image_alloc(&image, 2, 1, 3));
    assert_true(tr_image_alloc(&reference, 2, 1, 3));
    /* mean(R) = 2, so everything is scaled by 1/4. */
    static const float r[6] = {2, 2, 2, 0, 4, 2}, a[6] = {4, 2, 2, 0.4f, 0, 2};
    memcpy(image.data, a, sizeof a);
    memcpy(reference.data, r, sizeof r);
    assert_true(tr_image_error(&image, &reference, &e, err, sizeof err));
    /* pixel 0: one channel off by 0.5 of 0.5; pixel 1: 0.1 off 0, 1 off 1 */
    double square = (0.25 / 0.26 / 3 + (0.01 / 0.01 + 1 / 1.01) / 3) / 2,
           absolute = (0.5 / 0.51 / 3 + (0.1 / 0.01 + 1 / 1.01) / 3) / 2;
    assert_true(fabs(e.relmse - square) < 1e-6 && fabs(e.relmse_untrimmed - square) < 1e-6);
    assert_true(fabs(e.mrae - absolute) < 1e-6 && fabs(e.mrae_untrimmed - absolute) < 1e-6);
    for (int i = 0; i < 6; ++i) { /* the common scale does not matter */
        image.data[i] *= 1000;
        reference.data[i] *= 1000;
    }
    assert_true(tr_image_error(&image, &reference, &e, err, sizeof err));
    assert_true(fabs(e.relmse - square) < 1e-6);
    tr_image_free(&image);
    tr_image_free(&reference);
}

static void trimming_drops_the_worst_thousandth_of_each_measure(void **state)
{
    tr_image image, reference;
    tr_error e;
    (void)state;
    assert_true(tr_image_alloc(&image, 100, 25, 1)); /* 2500 pixels: two are dropped */
    assert_true(tr_image_alloc(&reference, 100, 25, 1));
    for (int i = 0; i < 2500; ++i)
        image.data[i] = reference.data[i] = 1;
    image.data[7] = 101; /* scaled by 1/2: errors 50, 25, 0.5 */
    image.data[100] = 51;
    image.data[2499] = 2;
    assert_true(tr_image_error(&image, &reference, &e, err, sizeof err));
    assert_true(fabs(e.relmse - 0.25 / 0.26 / 2498) < 1e-9);
    assert_true(fabs(e.mrae - 0.5 / 0.51 / 2498) < 1e-9);
    assert_true(fabs(e.relmse_untrimmed - (2500 + 625 + 0.25) / 0.26 / 2500) < 1e-6);
    assert_true(fabs(e.mrae_untrimmed - 75.5 / 0.51 / 2500) < 1e-9);
    tr_image_free(&image);
    tr_image_free(&reference);
}

static void measures_refuse_what_cannot_be_compared(void **state)
{
    tr_image a, b, black;
    tr_error e;
    (void)state;
    fill(&a, 4, 4, 3, 1);
    fill(&b, 4, 5, 3, 1);
    assert_false(tr_image_error(&a, &b, &e, err, sizeof err));
    tr_image_free(&b);
    fill(&b, 4, 4, 3, 2);
    a.data[0] = a.data[1] = NAN;
    a.data[30] = INFINITY;
    assert_false(tr_image_error(&a, &b, &e, err, sizeof err));
    assert_non_null(strstr(err, "2 pixels"));
    assert_non_null(strstr(err, "image"));
    assert_false(tr_image_error(&b, &a, &e, err, sizeof err));
    assert_non_null(strstr(err, "reference"));
    assert_true(tr_image_alloc(&black, 4, 4, 3));
    assert_false(tr_image_error(&b, &black, &e, err, sizeof err));
    assert_true(tr_image_error(&black, &b, &e, err, sizeof err));
    tr_image_free(&a);
    tr_image_free(&b);
    tr_image_free(&black);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(bad_sizes_are_refused),
        cmocka_unit_test(exr_round_trip_keeps_colours_within_half_precision),
        cmocka_unit_test(exr_layers_arrive_under_their_names),
        cmocka_unit_test(exr_half_clamps_what_is_finite_and_keeps_what_is_not),
        cmocka_unit_test(exr_grey_and_layered_colours_are_found),
        cmocka_unit_test(exr_tiles_offsets_and_all_pixel_types_are_read),
        cmocka_unit_test(exr_writer_refuses_bad_layers_and_paths),
        cmocka_unit_test(missing_empty_and_foreign_files_are_refused),
        cmocka_unit_test(truncated_files_are_refused),
        cmocka_unit_test(flipped_bits_do_no_harm),
        cmocka_unit_test(random_bytes_after_a_magic_number_are_refused),
        cmocka_unit_test(png_holds_the_srgb_curve_of_exposed_pixels),
        cmocka_unit_test(one_channel_png_is_grey),
        cmocka_unit_test(radiance_hdr_is_read_linear),
        cmocka_unit_test(auto_exposure_ignores_fireflies_and_survives_black),
        cmocka_unit_test(downsampling_averages_blocks_exactly),
        cmocka_unit_test(measures_agree_with_paper),
        cmocka_unit_test(trimming_drops_the_worst_thousandth_of_each_measure),
        cmocka_unit_test(measures_refuse_what_cannot_be_compared),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
