/* test_nn_safetensors.c: reading and writing of safetensors files by guide_nn.h: round trips, files written out by
   hand, hostile files. Every file is read from a buffer of exactly its size, for the sanitizers' sake.

   gcc -std=c11 -O2 -I. tests/test_nn_safetensors.c -lcmocka -lm */
#include "cmocka_prelude.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define GNN_IMPLEMENTATION
#include "guide_nn.h"

#include "rng.h"

#define MOST 64

typedef struct file {
    unsigned char *bytes;
    size_t size;
} file;

/* Header text and that many bytes of data, 0, 1, 2, ... */
static file file_of(const char *header, size_t data)
{
    size_t n = strlen(header);
    file f = {malloc(8 + n + data), 8 + n + data};
    assert_non_null(f.bytes);
    for (int i = 0; i < 8; ++i)
        f.bytes[i] = (unsigned char)((uint64_t)n >> 8 * i);
    memcpy(f.bytes + 8, header, n);
    for (size_t i = 0; i < data; ++i)
        f.bytes[8 + n + i] = (unsigned char)i;
    return f;
}

static gnn_result read_header(const char *header, size_t data, gnn_message *message)
{
    gnn_tensor tensors[MOST];
    uint32_t count;
    file f = file_of(header, data);
    gnn_result result = gnn_tensors_read(f.bytes, f.size, tensors, MOST, &count, message);
    free(f.bytes);
    return result;
}

static void every_half_is_its_value_and_comes_back(void **state)
{
    (void)state;
    for (uint32_t h = 0; h < 65536; ++h) {
        float x = gnn_float_of_half((uint16_t)h);
        int exponent = (int)(h >> 10 & 31), mantissa = (int)(h & 1023);
        double want = exponent ? ldexp(1024 + mantissa, exponent - 25) : ldexp(mantissa, -24);
        want = h & 0x8000 ? -want : want;
        if (exponent == 31 && mantissa) {
            assert_true(x != x);
            assert_int_equal(gnn_half_of_float(x) & 0x7c00, 0x7c00);
            assert_int_not_equal(gnn_half_of_float(x) & 1023, 0);
            continue;
        }
        if (exponent == 31)
            want = h & 0x8000 ? -(double)INFINITY : (double)INFINITY;
        assert_true((double)x == want);
        assert_int_equal(gnn_half_of_float(x), h);
    }
}

static void floats_round_to_the_nearest_half_ties_to_even(void **state)
{
    (void)state;
    for (uint32_t h = 0; h < 0x7bff; ++h) { /* the point between two halves, and its neighbours */
        double low = (double)gnn_float_of_half((uint16_t)h), high = (double)gnn_float_of_half((uint16_t)(h + 1));
        float middle = (float)(0.5 * (low + high));
        uint32_t even = h & 1 ? h + 1 : h;
        assert_int_equal(gnn_half_of_float(middle), even);
        assert_int_equal(gnn_half_of_float(nextafterf(middle, 0)), h);
        assert_int_equal(gnn_half_of_float(nextafterf(middle, 1e9f)), h + 1);
        assert_int_equal(gnn_half_of_float(-middle), even | 0x8000);
    }
    assert_int_equal(gnn_half_of_float(65519.99f), 0x7bff);
    assert_int_equal(gnn_half_of_float(65520.0f), 0x7c00);
    assert_int_equal(gnn_half_of_float(3e38f), 0x7c00);
    assert_int_equal(gnn_half_of_float(1e-30f), 0);
}

/* A file of three tensors; values are exact in half precision. */
static file sample_file(float *values)
{
    gnn_weight w[3];
    const char *metadata[] = {"version", "1", "note", "say \"hi\" \\ there", NULL};
    size_t size, written;
    file f;
    memset(w, 0, sizeof w);
    for (int i = 0; i < 24; ++i)
        values[i] = (float)(i - 7) * 0.25f;
    w[0].name = "net.weight", w[0].rank = 2, w[0].shape[0] = 3, w[0].shape[1] = 4, w[0].type = GNN_TYPE_F16;
    w[1].name = "net.bias", w[1].rank = 1, w[1].shape[0] = 11, w[1].type = GNN_TYPE_F32;
    w[2].name = "alpha", w[2].rank = 0, w[2].type = GNN_TYPE_F32;
    w[0].values = values, w[1].values = values + 12, w[2].values = values + 23;
    size = gnn_tensors_bound(w, 3, metadata);
    assert_true(size > 0);
    f.bytes = malloc(size), f.size = size;
    assert_int_equal(gnn_tensors_write(w, 3, metadata, f.bytes, size - 1, &written), GNN_BUFFER_TOO_SMALL);
    assert_int_equal(gnn_tensors_write(w, 3, metadata, f.bytes, size, &written), GNN_OK);
    assert_int_equal(written, size);
    return f;
}

static void what_is_written_is_read(void **state)
{
    float values[24], back[12];
    gnn_tensor t[3];
    uint32_t count;
    char text[40];
    file f = sample_file(values);
    (void)state;
    assert_int_equal(gnn_tensors_read(f.bytes, f.size, NULL, 0, &count, NULL), GNN_BUFFER_TOO_SMALL);
    assert_int_equal(count, 3);
    assert_int_equal(gnn_tensors_read(f.bytes, f.size, t, 3, &count, NULL), GNN_OK);
    const gnn_tensor *w = gnn_tensors_find(t, 3, "net.weight"), *b = gnn_tensors_find(t, 3, "net.bias");
    const gnn_tensor *a = gnn_tensors_find(t, 3, "alpha");
    assert_non_null(w);
    assert_non_null(b);
    assert_non_null(a);
    assert_null(gnn_tensors_find(t, 3, "net"));
    assert_null(gnn_tensors_find(t, 3, "net.weights"));
    assert_int_equal(w->rank, 2);
    assert_int_equal(w->shape[0], 3);
    assert_int_equal(w->shape[1], 4);
    assert_int_equal(w->type, GNN_TYPE_F16);
    assert_true(gnn_tensor_floats(w, 0, 12, back));
    assert_memory_equal(back, values, 12 * sizeof(float));
    assert_true(gnn_tensor_floats(b, 3, 8, back));
    assert_memory_equal(back, values + 15, 8 * sizeof(float));
    assert_false(gnn_tensor_floats(b, 4, 8, back));
    assert_false(gnn_tensor_floats(b, UINT64_MAX, 2, back));
    assert_int_equal(a->rank, 0);
    assert_true(gnn_tensor_floats(a, 0, 1, back) && back[0] == values[23]);
    assert_true(gnn_tensors_metadata(f.bytes, f.size, "note", text, sizeof text));
    assert_string_equal(text, "say \"hi\" \\ there");
    assert_true(gnn_tensors_metadata(f.bytes, f.size, "version", text, 1));
    assert_string_equal(text, "");
    assert_false(gnn_tensors_metadata(f.bytes, f.size, "missing", text, sizeof text));
    free(f.bytes);
}

/* What Python's library writes, spaces and unusual order included. */
static void files_of_other_writers_are_read(void **state)
{
    static const char header[] =
        " {\"__metadata__\" : {\"k\\u0041\": \"\\u0041\\n\\u00e9\", \"format\":\"pt\"}, \"b\" : "
        "{\"shape\":[2 , 1],\"data_offsets\":[4,8], \"dtype\":\"F16\"},\n\"a\":{\"dtype\":"
        "\"I8\",\"shape\":[4],\"data_offsets\":[0,4]},\"empty\":{\"dtype\":\"F32\",\"shape\":"
        "[3,0],\"data_offsets\":[4,4]}}   ";
    gnn_tensor t[3];
    uint32_t count;
    char text[8];
    float value;
    file f = file_of(header + 1, 8);
    (void)state;
    assert_int_equal(gnn_tensors_read(f.bytes, f.size, t, 3, &count, NULL), GNN_OK);
    assert_int_equal(count, 3);
    assert_int_equal(gnn_tensors_find(t, 3, "a")->type, GNN_TYPE_OTHER);
    assert_false(gnn_tensor_floats(gnn_tensors_find(t, 3, "a"), 0, 1, &value));
    assert_true(gnn_tensor_floats(gnn_tensors_find(t, 3, "b"), 1, 1, &value));
    assert_true(value == gnn_float_of_half(0x0706));
    assert_true(gnn_tensor_floats(gnn_tensors_find(t, 3, "empty"), 0, 0, &value));
    assert_true(gnn_tensors_metadata(f.bytes, f.size, "format", text, sizeof text));
    assert_string_equal(text, "pt");
    assert_true(gnn_tensors_metadata(f.bytes, f.size, "k\\u0041", text, sizeof text));
    assert_string_equal(text, "A\n?");
    free(f.bytes);
    f = file_of(header, 8); /* a header must begin with its brace */
    assert_int_equal(gnn_tensors_read(f.bytes, f.size, t, 3, &count, NULL), GNN_BAD_FILE);
    free(f.bytes);
}

typedef struct hostile {
    const char *header;
    size_t data;
    const char *says; /* must be in the message */
} hostile;

#define T(name, type, shape, from, to)                                                                                 \
    "\"" name "\":{\"dtype\":\"" type "\",\"shape\":[" shape "],\"data_offsets\":[" from "," to "]}"

static void hostile_headers_are_refused_and_name_the_tensor(void **state)
{
    static const hostile all[] = {
        {"{" T("w1", "F32", "2", "0", "8") "," T("w2", "F32", "2", "4", "12") "}", 12, "\"w2\""},  /* overlap */
        {"{" T("w1", "F32", "2", "0", "8") "," T("w2", "F32", "1", "12", "16") "}", 16, "\"w2\""}, /* gap */
        {"{" T("w1", "F32", "2", "0", "8") "," T("w1", "F32", "1", "8", "12") "}", 12, "\"w1\": it is there twice"},
        {"{" T("w1", "F32", "1", "0", "4") "," T("w2", "F32", "1", "0", "4") "}", 4, "overlap"},
        {"{" T("w1", "F32", "2", "0", "8") "}", 7, "\"w1\""},
        {"{" T("w1", "F32", "2", "0", "8") "}", 9, "belong to no tensor"},
        {"{" T("w1", "F32", "2", "8", "0") "}", 8, "\"w1\""},
        {"{" T("w1", "F32", "3", "0", "8") "}", 8, "\"w1\""},
        {"{" T("w1", "F32", "4294967296,4294967296", "0", "0") "}", 0, "\"w1\""}, /* 2^64 elements */
        {"{" T("w1", "F32", "4611686018427387905", "0", "4") "}", 4, "\"w1\""},   /* 4 times that is 4 */
        {"{" T("w1", "F32", "1", "18446744073709551612", "18446744073709551616") "}", 4, "\"w1\""},
        {"{" T("w1", "F32", "1", "18446744073709551612", "0") "}", 4, "\"w1\""},
        {"{" T("w1", "F32", "-1", "0", "4") "}", 4, "\"w1\""},
        {"{" T("w1", "F32", "1.0", "0", "4") "}", 4, "\"w1\""},
        {"{" T("w1", "F32", "01", "0", "4") "}", 4, "\"w1\""},
        {"{" T("w1", "F32", "1,1,1,1,1,1,1,1,1", "0", "4") "}", 4, "\"w1\""},
        {"{" T("w1", "F31", "1", "0", "4") "}", 4, "\"w1\": its dtype"},
        {"{" T("w\\u0031", "F32", "1", "0", "4") "}", 4, "escape"},
        {"{\"w1\":{\"dtype\":\"F32\",\"shape\":[1]}}", 4, "\"w1\": it lacks"},
        {"{\"w1\":{}}", 4, "\"w1\": it lacks"},
        {"{\"w1\":{\"dtype\":\"F32\",\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4]}}", 4, "\"w1\": it has"},
        {"{\"w1\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4],\"more\":1}}", 4, "\"w1\": it has"},
        {"{\"w1\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0]}}", 4, "\"w1\": data_offsets"},
        {"{\"w1\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4,4]}}", 4, "\"w1\""},
        {"{\"w1\":[]}", 0, "\"w1\""},
        {"{\"w1\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":[0,4]},}", 4, ""},
        {"{\"w1", 0, "no end"},
        {"{\"w1\\", 0, "no end"},
        {"{\"__metadata__\":{\"a\":\"\\u12", 0, "no end"},
        {"{\"__metadata__\":{\"a\":\"\\x\"}}", 0, "bad escape"},
        {"{\"__metadata__\":{\"a\":\"\\u12g4\"}}", 0, "bad escape"},
        {"{\"__metadata__\":{\"a\":\"\\u123\"}}", 0, "bad escape"},
        {"{\"w1\\'\":{}}", 0, "bad escape"},
        {"{\"w\n1\":{}}", 0, "control"},
        {"{", 0, "header"},
        {"{}x", 0, "follows"},
        {"{}{}", 0, "follows"},
        {"[]", 0, "header"},
        {"{\"__metadata__\":{\"a\":1}}", 0, "__metadata__"},
        {"{\"__metadata__\":{},\"__metadata__\":{}}", 0, "twice"},
        {"{\"__metadata__\":{\"a\":{\"a\":\"b\"}}}", 0, "__metadata__"},
    };
    gnn_message message;
    (void)state;
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i) {
        gnn_result result = read_header(all[i].header, all[i].data, &message);
        if (result != GNN_BAD_FILE || !strstr(message.text, all[i].says) || !message.text[0])
            fail_msg("%s: result %d, says: %s", all[i].header, (int)result, message.text);
        assert_int_equal(read_header(all[i].header, all[i].data, NULL), GNN_BAD_FILE);
    }
    assert_int_equal(read_header("{\"__metadata__\":{\"a\":\"\\\"\\\\\\/\\b\\f\\n\\r\\t\\u09aF\"}}", 0, NULL), GNN_OK);
    assert_int_equal(read_header("{" T("w1", "C64", "2", "0", "16") "}", 16, NULL), GNN_OK);
    assert_int_equal(read_header("{" T("w1", "F8_E8M0", "3", "0", "3") "}", 3, NULL), GNN_OK);
    assert_int_equal(read_header("{}", 0, &message), GNN_OK);
    assert_string_equal(message.text, "");
}

static void long_and_strange_names_do_not_overrun_the_message(void **state)
{
    char header[3000] = "{\"";
    gnn_message message;
    (void)state;
    for (int i = 2; i < 2500; ++i)
        header[i] = (char)(i % 7 ? 0xc0 + i % 60 : 'x');
    strcpy(header + 2500, "\":3}");
    assert_int_equal(read_header(header, 0, &message), GNN_BAD_FILE);
    assert_true(strlen(message.text) < sizeof message.text && strlen(message.text) > 100);
    for (const char *p = message.text; *p; ++p)
        assert_true(*p >= 32 && *p < 127);
}

static void truncated_files_are_refused(void **state)
{
    float values[24];
    gnn_tensor t[3];
    uint32_t count;
    file f = sample_file(values);
    (void)state;
    assert_int_equal(gnn_tensors_read(NULL, 0, t, 3, &count, NULL), GNN_BAD_FILE);
    for (size_t size = 0; size < f.size; ++size) {
        unsigned char *cut = malloc(size ? size : 1);
        memcpy(cut, f.bytes, size);
        assert_int_equal(gnn_tensors_read(cut, size, t, 3, &count, NULL), GNN_BAD_FILE);
        free(cut);
    }
    free(f.bytes);
}

/* What may be read must be readable: to be called for whatever was accepted. */
static void read_all(const file *f, const gnn_tensor *t, uint32_t count)
{
    char text[16];
    float value;
    for (uint32_t i = 0; i < count; ++i) {
        assert_true(t[i].data >= f->bytes && t[i].size <= (uint64_t)(f->bytes + f->size - t[i].data));
        uint64_t n = t[i].type == GNN_TYPE_F32 ? t[i].size / 4 : t[i].size / 2;
        if (n && t[i].type != GNN_TYPE_OTHER)
            assert_true(gnn_tensor_floats(&t[i], n - 1, 1, &value));
        assert_false(gnn_tensor_floats(&t[i], n, 1, &value));
        assert_true(i == 0 || t[i].name_length != t[i - 1].name_length ||
                    memcmp(t[i].name, t[i - 1].name, t[i].name_length) != 0);
    }
    gnn_tensors_metadata(f->bytes, f->size, "note", text, sizeof text);
}

/* Up to three bits or pieces of text of the first `most` bytes changed. */
static void mutate(unsigned char *bytes, size_t size, size_t most)
{
    static const char *const pieces[] = {
        "\"",           "{",         "}",   "[", "]",     ",",           ":", "\\", "0", "9", "18446744073709551615",
        "\"net.bias\"", "\"dtype\"", "F16", " ", "\\u00", "__metadata__"};
    for (uint64_t k = 1 + rng_next() % 3; k > 0; --k) {
        size_t at = rng_next() % most;
        const char *piece = pieces[rng_next() % (sizeof pieces / sizeof *pieces)];
        if (rng_next() % 2)
            bytes[at] ^= (unsigned char)(1 << rng_next() % 8);
        else if (at + strlen(piece) <= size)
            memcpy(bytes + at, piece, strlen(piece));
    }
}

static void flipped_bits_and_bytes_never_overrun(void **state)
{
    float values[24];
    gnn_tensor t[8];
    uint32_t count, accepted = 0, refused = 0;
    file f = sample_file(values);
    unsigned char *copy = malloc(f.size);
    (void)state;
    seed(5);
    for (int round = 0; round < 60000; ++round) {
        file g = {copy, f.size};
        memcpy(copy, f.bytes, f.size);
        mutate(copy, f.size, f.size - 56);
        if (gnn_tensors_read(g.bytes, g.size, t, 8, &count, NULL) == GNN_OK) {
            read_all(&g, t, count);
            ++accepted;
        } else {
            char text[16];
            gnn_tensors_metadata(g.bytes, g.size, "note", text, sizeof text);
            ++refused;
        }
    }
    assert_true(accepted > 100 && refused > 10000); /* both ways were taken */
    free(copy);
    free(f.bytes);
}

static file training_save(const gnn_unet *net)
{
    size_t size = gnn_unet_bound(net, GNN_TYPE_F32, NULL), written;
    file f = {malloc(size), size};
    assert_non_null(f.bytes);
    assert_int_equal(gnn_unet_save(net, GNN_TYPE_F32, NULL, f.bytes, size, &written), GNN_OK);
    assert_int_equal(written, size);
    return f;
}

/* A network takes a changed save, and is sound then, or refuses it and is as it was. */
static void changed_saves_of_networks_load_whole_or_not_at_all(void **state)
{
    gnn_unet_desc d;
    gnn_unet *net;
    uint32_t accepted = 0, refused = 0;
    (void)state;
    memset(&d, 0, sizeof d);
    d.width = 8, d.height = 4, d.inputs = 2, d.levels = 2, d.channels[0] = d.channels[1] = 1;
    d.training = true;
    assert_int_equal(gnn_unet_create(&d, &net), GNN_OK);
    size_t floats = gnn_unet_floats(net), bytes = floats * sizeof(float);
    file f = training_save(net);
    unsigned char *copy = malloc(f.size);
    float *before = malloc(3 * bytes);
    size_t header = 8 + f.bytes[0] + 256u * f.bytes[1];
    assert_true(copy && before && header < f.size);
    seed(7);
    for (int round = 0; round < 20000; ++round) {
        memcpy(copy, f.bytes, f.size);
        if (rng_next() % 4)
            mutate(copy, f.size, header);
        else
            mutate(copy + header, f.size - header, f.size - header);
        memcpy(before, net->weights, bytes);
        memcpy(before + floats, net->first, 2 * bytes);
        if (gnn_unet_load(net, copy, f.size, NULL) == GNN_OK) {
            assert_true(gnni_all_below(net->weights, floats, INFINITY));
            assert_true(gnni_all_below(net->first, floats, 2e15f));
            for (size_t i = 0; i < floats; ++i)
                assert_true(net->second[i] >= 0 && net->second[i] < 4e30f);
            ++accepted;
        } else {
            assert_memory_equal(before, net->weights, bytes);
            assert_memory_equal(before + floats, net->first, 2 * bytes);
            ++refused;
        }
    }
    assert_true(accepted > 1000 && refused > 1000); /* both ways were taken */
    free(before);
    free(copy);
    free(f.bytes);
    gnn_unet_destroy(net);
}

static void huge_headers_are_refused_and_many_tensors_read_in_time(void **state)
{
    unsigned char lying[32] = {0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, '{', '}'};
    uint32_t n = 50000, count;
    char *header = malloc(n * 64), *p = header;
    gnn_tensor *t = calloc(n, sizeof *t);
    (void)state;
    assert_int_equal(gnn_tensors_read(lying, sizeof lying, t, n, &count, NULL), GNN_BAD_FILE);
    memset(lying, 0, 8);
    lying[3] = 2; /* 32 MB */
    assert_int_equal(gnn_tensors_read(lying, sizeof lying, t, n, &count, NULL), GNN_BAD_FILE);
    *p++ = '{';
    for (uint32_t i = 0; i < n; ++i)
        p += sprintf(p, "%s\"t%u\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}", i ? "," : "",
                     (i * 7919u) % n);
    strcpy(p, "}");
    file f = file_of(header, 0);
    assert_int_equal(gnn_tensors_read(f.bytes, f.size, t, n, &count, NULL), GNN_OK);
    assert_int_equal(count, n);
    assert_non_null(gnn_tensors_find(t, n, "t49999"));
    free(f.bytes);
    free(header);
    free(t);
}

static void what_cannot_be_named_is_not_written(void **state)
{
    static const char *const bad[] = {"a\"b", "a\\b", "a\nb", "\xc3\xa9", "__metadata__"};
    const char *odd[] = {"key", NULL}, *control[] = {"key", "a\tb", NULL};
    const char *twice[] = {"key", "1", "other", "1", "key", "2", NULL};
    float value = 1;
    gnn_weight w, pair[2];
    size_t written;
    char buffer[256];
    (void)state;
    memset(&w, 0, sizeof w);
    w.values = &value, w.type = GNN_TYPE_F32, w.name = "ok";
    assert_true(gnn_tensors_bound(&w, 1, NULL) > 0);
    assert_int_equal(gnn_tensors_bound(&w, 1, odd), 0);
    assert_int_equal(gnn_tensors_bound(&w, 1, control), 0);
    assert_int_equal(gnn_tensors_bound(&w, 1, twice), 0);
    pair[0] = pair[1] = w;
    assert_int_equal(gnn_tensors_bound(pair, 2, NULL), 0);
    assert_int_equal(gnn_tensors_write(pair, 2, NULL, buffer, sizeof buffer, &written), GNN_BAD_RANGE);
    pair[1].name = "okay";
    assert_int_equal(gnn_tensors_write(pair, 2, NULL, buffer, sizeof buffer, &written), GNN_OK);
    for (size_t i = 0; i < sizeof bad / sizeof *bad; ++i) {
        w.name = bad[i];
        assert_int_equal(gnn_tensors_bound(&w, 1, NULL), 0);
    }
    w.name = "ok", w.rank = 2, w.shape[0] = w.shape[1] = UINT64_C(1) << 33;
    assert_int_equal(gnn_tensors_bound(&w, 1, NULL), 0);
    w.rank = 0, w.type = GNN_TYPE_OTHER;
    assert_int_equal(gnn_tensors_bound(&w, 1, NULL), 0);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(every_half_is_its_value_and_comes_back),
        cmocka_unit_test(floats_round_to_the_nearest_half_ties_to_even),
        cmocka_unit_test(what_is_written_is_read),
        cmocka_unit_test(files_of_other_writers_are_read),
        cmocka_unit_test(hostile_headers_are_refused_and_name_the_tensor),
        cmocka_unit_test(long_and_strange_names_do_not_overrun_the_message),
        cmocka_unit_test(truncated_files_are_refused),
        cmocka_unit_test(flipped_bits_and_bytes_never_overrun),
        cmocka_unit_test(changed_saves_of_networks_load_whole_or_not_at_all),
        cmocka_unit_test(huge_headers_are_refused_and_many_tensors_read_in_time),
        cmocka_unit_test(what_cannot_be_named_is_not_written),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
