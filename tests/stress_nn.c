/* stress_nn.c: guide_nn.h under hostile and extreme input. See stress.h; `make stress` runs it.

   gcc -std=c11 -O2 -I. tests/stress_nn.c -lm -lpthread */
#define _XOPEN_SOURCE 700
#include "stress.h"

#define GNN_IMPLEMENTATION
#include "guide_nn.h"

#include "nn_naive.h"

/* ---- memory and text */

static float *new_floats(size_t count)
{
    float *p = calloc(count ? count : 1, sizeof *p);
    if (!p)
        abort();
    return p;
}

/* Memory of any alignment, full of NaN. What lies around it is checked, or malloc's own edge is its end. */
typedef struct space {
    unsigned char *memory, *start;
    size_t size, behind;
} space;

static space new_space(stress *s, size_t size)
{
    size_t before = stress_below(s, 129);
    space p = {NULL, NULL, size, stress_chance(s, 0.5) ? 64 : 0};
    p.memory = malloc(before + size + p.behind + 1);
    if (!p.memory)
        abort();
    p.start = p.memory + before;
    memset(p.memory, 0xa5, before + size + p.behind);
    memset(p.start, 0xff, size);
    return p;
}

static void free_space(stress *s, space *p)
{
    size_t written = 0;
    for (const unsigned char *b = p->memory; b < p->start; ++b)
        written += *b != 0xa5;
    for (size_t i = 0; i < p->behind; ++i)
        written += p->start[p->size + i] != 0xa5;
    STRESS_CHECK(s, written == 0, "%zu bytes around the workspace were written", written);
    free(p->memory);
}

typedef struct text {
    char *bytes;
    size_t at, capacity;
} text;

__attribute__((format(printf, 2, 3))) static void put(text *t, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    t->at += (size_t)vsnprintf(t->bytes + t->at, t->capacity - t->at, format, arguments);
    va_end(arguments);
    if (t->at >= t->capacity)
        abort();
}

/* ---- hostile files: what the documented rules say of them is known */

enum { MOST_TENSORS = 12, MOST_RANK = 4 };

typedef struct entry {
    char name[24];
    const char *type;
    uint32_t rank, bits;
    uint64_t shape[MOST_RANK], from, to;
} entry;

typedef struct sketch {
    entry entries[MOST_TENSORS];
    uint32_t count;
    uint64_t data;     /* bytes behind the header */
    bool metadata;     /* "note": "a\"b" */
    const char *fault; /* NULL: the file is good */
} sketch;

static void any_name(stress *s, uint32_t i, char name[24])
{
    static const char *const endings[] = {"", ".weight", "\xff\xfe", "\xc3\xa9", " ", "[]{}:,", "__metadata__"};
    name[0] = 0;
    if (i)
        snprintf(name, 24, "%s%u", stress_chance(s, 0.3) ? "w" : "", i);
    if (stress_chance(s, 0.7))
        strcat(name, endings[stress_below(s, i ? 7 : 6)]);
}

static sketch any_sketch(stress *s)
{
    static const struct {
        const char *name;
        uint32_t bits;
    } types[] = {{"F32", 32}, {"F16", 16}, {"F32", 32}, {"BF16", 16}, {"U8", 8}, {"F64", 64}, {"BOOL", 8}};
    sketch k;
    memset(&k, 0, sizeof k);
    k.count = stress_below(s, MOST_TENSORS + 1);
    k.metadata = stress_chance(s, 0.5);
    for (uint32_t i = 0; i < k.count; ++i) {
        entry *e = &k.entries[i];
        uint32_t type = stress_below(s, 7);
        uint64_t size = types[type].bits / 8;
        any_name(s, i, e->name);
        e->type = types[type].name;
        e->rank = stress_below(s, MOST_RANK + 1);
        for (uint32_t r = 0; r < e->rank; ++r)
            size *= e->shape[r] = stress_chance(s, 0.1) ? 0 : 1 + stress_below(s, 4);
        e->from = k.data;
        e->to = k.data += size;
    }
    for (uint32_t i = k.count; i > 1; --i) { /* any order */
        uint32_t j = stress_below(s, i);
        entry e = k.entries[i - 1];
        k.entries[i - 1] = k.entries[j];
        k.entries[j] = e;
    }
    return k;
}

/* Spoil a tensor, where there is one that can be spoiled so. */
static void spoil_entry(stress *s, sketch *k)
{
    entry *e = &k->entries[stress_below(s, k->count)], *other = &k->entries[stress_below(s, k->count)];
    switch (stress_below(s, 8)) {
    case 0: /* begins within the tensor before, or at its end leaves a gap */
        if (e->to == e->from || e->from == 0)
            return;
        e->from--, e->to--;
        k->fault = "overlap";
        return;
    case 1:
        e->to++;
        k->fault = "longer than its shape";
        return;
    case 2:
        if (e == other)
            return;
        strcpy(e->name, other->name);
        k->fault = "twice";
        return;
    case 3: /* 2^64 elements, as bytes that wrap to what the offsets say, or with a zero at the end */
        e->rank = 3;
        e->shape[0] = (uint64_t)1 << (32 + stress_below(s, 32));
        e->shape[1] = (uint64_t)1 << (32 + stress_below(s, 32));
        e->shape[2] = stress_below(s, 2);
        k->fault = "wraps";
        return;
    case 4:
        e->rank = 1;
        e->shape[0] = ((uint64_t)1 << 62) + 1;
        e->type = "F32";
        k->fault = "wraps to four bytes";
        return;
    case 5:
        e->to = UINT64_MAX - stress_below(s, 3);
        k->fault = "ends beyond everything";
        return;
    case 6:
        e->type = stress_chance(s, 0.5) ? "f32" : "";
        k->fault = "type";
        return;
    default:
        e->from = k->data + 1, e->to = k->data;
        k->fault = "ends before it begins";
    }
}

static void put_space(stress *s, text *t)
{
    while (stress_chance(s, 0.05))
        put(t, "%c", " \t\n\r"[stress_below(s, 4)]);
}

static void put_entry(stress *s, text *t, const entry *e)
{
    uint32_t order = stress_below(s, 6);
    put(t, "\"%s\":", e->name);
    put_space(s, t);
    put(t, "{");
    for (uint32_t m = 0; m < 3; ++m, order += 1) {
        put_space(s, t);
        if (order % 3 == 0)
            put(t, "\"dtype\":\"%s\"", e->type);
        if (order % 3 == 1) {
            put(t, "\"shape\":[");
            for (uint32_t r = 0; r < e->rank; ++r)
                put(t, r ? ",%llu" : "%llu", (unsigned long long)e->shape[r]);
            put(t, "]");
        }
        if (order % 3 == 2)
            put(t, "\"data_offsets\":[%llu,%llu]", (unsigned long long)e->from, (unsigned long long)e->to);
        put(t, m < 2 ? "," : "}");
    }
}

/* A member of the header's object that no file may have. */
static const char *put_bad_member(stress *s, text *t)
{
    static const char *const bad[] = {
        "\"x\":{\"dtype\":\"U8\",\"shape\":[-0],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0.0],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0e0],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[00],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[18446744073709551616],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0,0,0,0,0,0,0,0,0],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0],\"shape\":[0],\"data_offsets\":[0,0]}",
        "\"x\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0],\"y\":0}",
        "\"x\":{\"dtype\":\"U8\",\"data_offsets\":[0,0]}",
        "\"x\\u0041\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}",
        "\"x\x01\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}",
        "\"x\\q\":{\"dtype\":\"U8\",\"shape\":[0],\"data_offsets\":[0,0]}",
        "\"x\":null",
        "\"x\":\"{}\"",
        "\"__metadata__\":{\"a\":1}",
        "\"__metadata__\":{\"a\":{\"b\":\"c\"}}",
        "\"__metadata__\":{},\"__metadata__\":{}",
        "\"__metadata__\":[]",
        "x:{}",
        ",",
    };
    uint32_t kind = stress_below(s, sizeof bad / sizeof *bad + 2), depth = some(s, 3000);
    if (kind < sizeof bad / sizeof *bad) {
        put(t, "%s", bad[kind]);
        return "member";
    }
    if (kind % 2)
        put(t, "\"x\":{\"shape\":");
    for (uint32_t i = 0; i < depth; ++i)
        put(t, kind % 2 ? "[" : "\"x\":{");
    return "nested";
}

/* The header's JSON. With `bad` one more member, that no file may have. */
static void put_header(stress *s, text *t, sketch *k, bool bad)
{
    uint32_t parts = k->count + k->metadata + bad, metadata = stress_below(s, k->count + 1), first = 0;
    put(t, "{");
    for (uint32_t i = 0; i <= k->count; ++i) {
        put_space(s, t);
        if (k->metadata && i == metadata)
            put(t, "\"__metadata__\":{\"key\":\"\",\"note\":\"a\\\"b\"}%s", ++first < parts ? "," : "");
        if (bad && i == k->count)
            k->fault = put_bad_member(s, t);
        if (i == k->count)
            break;
        put_entry(s, t, &k->entries[i]);
        put(t, "%s", ++first < parts ? "," : "");
    }
    put(t, "}");
    while (stress_chance(s, 0.5))
        put(t, " ");
}

/* The file; faults of its frame. */
static unsigned char *make_file(stress *s, sketch *k, size_t *size)
{
    static char header[40000];
    text t = {header, 0, sizeof header};
    uint32_t kind = stress_below(s, 12);
    uint64_t length;
    unsigned char *file;
    if (kind == 0 && k->count)
        spoil_entry(s, k);
    put_header(s, &t, k, kind == 1);
    if (kind == 2) {
        k->fault = "what follows";
        put(&t, "%s", stress_chance(s, 0.5) ? "{}" : "x");
    }
    length = t.at;
    *size = 8 + t.at + (size_t)k->data;
    if (kind == 3) {
        k->fault = "byte that no tensor has";
        ++*size;
    } else if (kind == 4) {
        k->fault = "cut";
        *size = stress_below(s, (uint32_t)*size);
    } else if (kind == 5) {
        const uint64_t lies[] = {0, 1, t.at - 1, t.at + k->data + 1, (16u << 20) + 1, UINT64_MAX, UINT64_MAX - 7};
        length = lies[stress_below(s, 7)];
        k->fault = "length";
    }
    file = malloc(*size ? *size : 1);
    for (size_t i = 0; i < *size; ++i)
        file[i] = i < 8          ? (unsigned char)(length >> 8 * i)
                  : i < 8 + t.at ? (unsigned char)header[i - 8]
                                 : (unsigned char)stress_next(s);
    return file;
}

/* Whatever was accepted is sound: sorted by name, and its bytes are the file's, each byte one tensor's. */
static void check_tensors(stress *s, const unsigned char *file, size_t size, const gnn_tensor *t, uint32_t count)
{
    uint64_t sum = 0, begin = size;
    for (uint32_t i = 0; i < count && !s->failed; ++i) {
        float value;
        uint64_t n = t[i].size / (t[i].type == GNN_TYPE_F32 ? 4 : 2);
        uint32_t shorter = i && t[i - 1].name_length < t[i].name_length ? t[i - 1].name_length : t[i].name_length;
        int order = i ? memcmp(t[i - 1].name, t[i].name, shorter) : -1;
        STRESS_CHECK(s, order < 0 || (order == 0 && t[i - 1].name_length < t[i].name_length), "not sorted");
        STRESS_CHECK(s, t[i].data >= file + 8 && t[i].size <= size && t[i].data + t[i].size <= file + size, "outside");
        sum += t[i].size;
        begin = (size_t)(t[i].data - file) < begin ? (size_t)(t[i].data - file) : begin;
        for (uint32_t j = 0; j < i && count < 64; ++j)
            STRESS_CHECK(
                s, t[i].data >= t[j].data + t[j].size || t[j].data >= t[i].data + t[i].size || !t[i].size || !t[j].size,
                "two tensors share bytes");
        STRESS_CHECK(s, !gnn_tensor_floats(&t[i], n, 1, &value) && !gnn_tensor_floats(&t[i], UINT64_MAX, 1, &value),
                     "a value beyond the end");
        if (t[i].type != GNN_TYPE_OTHER && n)
            STRESS_CHECK(s, gnn_tensor_floats(&t[i], n - 1, 1, &value), "the last value");
    }
    STRESS_CHECK(s, count == 0 || begin + sum == size, "bytes that no tensor has");
}

static void check_message(stress *s, const gnn_message *m, gnn_result result)
{
    size_t length = strnlen(m->text, sizeof m->text);
    STRESS_CHECK(s, length < sizeof m->text && (length > 0) == (result != GNN_OK), "%zu letters after: %s", length,
                 gnn_result_string(result));
    for (size_t i = 0; i < length; ++i)
        STRESS_CHECK(s, m->text[i] >= 32 && m->text[i] < 127, "a message with byte %d", m->text[i]);
}

/* The metadata's text, cut to any capacity. */
static void check_metadata(stress *s, const unsigned char *file, size_t size, const sketch *k)
{
    size_t capacity = stress_below(s, 6);
    char *note = malloc(capacity ? capacity : 1); /* exact, so that a sanitizer sees what lies beyond */
    bool found = gnn_tensors_metadata(file, size, "note", note, capacity);
    if (k && !k->fault) {
        STRESS_CHECK(s, found == (k->metadata && capacity > 0), "the note is %s", found ? "there" : "not there");
        STRESS_CHECK(s, !found || strncmp(note, "a\"b", capacity - 1) == 0, "the note says %.5s", note);
    }
    STRESS_CHECK(s, capacity == 0 || memchr(note, 0, capacity), "a text without end");
    free(note);
}

/* A good file is read, and says what was written; a bad one is refused. */
static void try_file(stress *s, const unsigned char *file, size_t size, const sketch *k)
{
    gnn_tensor t[MOST_TENSORS];
    gnn_message message;
    uint32_t count, capacity = stress_chance(s, 0.3) ? stress_below(s, MOST_TENSORS) : MOST_TENSORS;
    gnn_result result = gnn_tensors_read(file, size, t, capacity, &count, &message);
    bool small = result == GNN_BUFFER_TOO_SMALL && k->count > capacity, bad = k->fault != NULL;
    if (s->sabotage && !small && stress_chance(s, 0.1))
        s->deviating = true, bad = !bad;
    STRESS_CHECK(s, small || result == (bad ? GNN_BAD_FILE : GNN_OK), "%s: %s", k->fault ? k->fault : "a good file",
                 message.text);
    STRESS_CHECK(s, small || k->fault || k->count <= capacity, "%u tensors for room of %u", count, capacity);
    STRESS_CHECK(s, !small || k->fault || count == k->count, "%u tensors, not %u", count, k->count);
    check_message(s, &message, result);
    check_metadata(s, file, size, k);
    for (uint32_t i = 0; i < k->count && result == GNN_OK && !s->failed; ++i) {
        const entry *e = &k->entries[i];
        const gnn_tensor *found = gnn_tensors_find(t, count, e->name);
        STRESS_CHECK(s,
                     found && found->rank == e->rank && memcmp(found->shape, e->shape, e->rank * 8) == 0 &&
                         found->data == file + size - k->data + e->from && found->size == e->to - e->from &&
                         found->type == (!strcmp(e->type, "F32")   ? GNN_TYPE_F32
                                         : !strcmp(e->type, "F16") ? GNN_TYPE_F16
                                                                   : GNN_TYPE_OTHER),
                     "tensor %s", e->name);
    }
    if (result == GNN_OK)
        check_tensors(s, file, size, t, count);
    stress_end(s, result != GNN_OK);
}

/* Bits, pieces of JSON and words of a good file changed: whatever is accepted is sound. */
static void try_changed_file(stress *s, const unsigned char *file, size_t size)
{
    static const char *const pieces[] = {
        "\"",           "{",    "}",  "[", "]", ",", ":", "\\", "0", "18446744073709551615", "F16", "\\u00",
        "__metadata__", "\xff", "e1", "-"};
    gnn_tensor t[64];
    gnn_message message;
    uint32_t count;
    gnn_result result;
    unsigned char *changed = malloc(size + 1), *exact;
    memcpy(changed, file, size);
    for (uint32_t n = 1 + stress_below(s, 3); n > 0 && size; --n) {
        const char *piece = pieces[stress_below(s, sizeof pieces / sizeof *pieces)];
        size_t at = stress_below(s, (uint32_t)size);
        if (stress_chance(s, 0.5))
            forge(s, changed, &size, file, size);
        else if (at + strlen(piece) <= size)
            memcpy(changed + at, piece, strlen(piece));
    }
    exact = malloc(size ? size : 1);
    memcpy(exact, changed, size);
    result = gnn_tensors_read(exact, size, t, 64, &count, &message);
    STRESS_CHECK(s, result == GNN_OK || result == GNN_BAD_FILE, "%s", gnn_result_string(result));
    check_message(s, &message, result);
    check_metadata(s, exact, size, NULL);
    if (result == GNN_OK)
        check_tensors(s, exact, size, t, count);
    free(exact);
    free(changed);
    stress_end(s, result != GNN_OK);
}

static void files(stress *s)
{
    for (int i = 0; i < 20 && !s->failed; ++i) {
        sketch k = any_sketch(s);
        size_t size;
        unsigned char *file = make_file(s, &k, &size);
        try_file(s, file, size, &k);
        if (!k.fault)
            for (int j = 0; j < 10; ++j)
                try_changed_file(s, file, size);
        free(file);
    }
}

/* ---- networks and their maps */

static gnn_unet_desc any_desc(stress *s)
{
    gnn_unet_desc d;
    memset(&d, 0, sizeof d);
    d.levels = 1 + stress_below(s, 3);
    d.width = (1u << d.levels) * (1 + stress_below(s, 16 >> d.levels));
    d.height = (1u << (d.levels - 1)) * (1 + stress_below(s, 16 >> d.levels));
    d.inputs = 1 + stress_below(s, 6);
    for (uint32_t l = 0; l < d.levels; ++l)
        d.channels[l] = 1 + stress_below(s, 12);
    d.no_mask = stress_chance(s, 0.3);
    d.training = true;
    d.rate = (float)stress_log(s, 1e-4, 1);
    d.simd = (gnn_simd)(GNN_SIMD_SCALAR + (int)stress_below(s, 4));
    if (gnn_resolve_simd(d.simd) != d.simd)
        d.simd = GNN_SIMD_AUTO;
    return d;
}

static size_t area_of(const gnn_unet_desc *d) { return (size_t)d->width * d->height; }

/* A network whose heads and biases matter. */
static gnn_unet *new_net(stress *s, const gnn_unet_desc *d)
{
    gnn_unet *net = NULL;
    char name[40];
    uint32_t rank;
    uint64_t shape[GNN_MAX_RANK];
    STRESS_CHECK(s, gnn_unet_create(d, &net) == GNN_OK, "create");
    for (uint32_t i = 0; net && i < gnn_unet_tensors(net); ++i) {
        float values[64];
        uint64_t n = gnn_unet_tensor(net, i, name, &rank, shape);
        if (n > 64 || (rank > 1 && name[0] != 'h'))
            continue;
        for (uint64_t k = 0; k < n; ++k)
            values[k] = stress_unitf(s) - 0.5f;
        gnn_unet_tensor_import(net, i, values);
    }
    return net;
}

/* What a map is made of; those before HOSTILE give finite output. */
enum { ORDINARY, EMPTY, FULL, ONE_BIN, DENORMAL, NEGATIVE, HOSTILE, LARGE, ALL_HOSTILE, BAD_MASK, KINDS };

static void make_map(stress *s, const gnn_unet_desc *d, uint32_t kind, float *inputs)
{
    size_t area = area_of(d), one = stress_below(s, (uint32_t)area);
    for (size_t i = 0; i < area; ++i) {
        bool there = kind == ORDINARY || kind == HOSTILE ? stress_chance(s, 0.3) : kind != EMPTY;
        there = kind == ONE_BIN ? i == one : there;
        for (uint32_t c = 0; c < d->inputs; ++c) {
            float *x = &inputs[c * area + i];
            *x = there ? kind == ONE_BIN ? (float)area : 2 * stress_unitf(s) : 0;
            if (kind == DENORMAL)
                *x = FLT_MIN * stress_unitf(s);
            if (kind == NEGATIVE)
                *x = -*x;
            if (kind == LARGE)
                *x = (float)stress_log(s, 1e6, 1e38);
            if (kind == ALL_HOSTILE || (kind == HOSTILE && stress_chance(s, 0.03)))
                *x = hostile_number(s);
        }
        if (!d->no_mask && d->inputs > 1 && kind != ALL_HOSTILE)
            inputs[(d->inputs - 1) * area + i] = kind == BAD_MASK ? hostile_number(s) : (float)there;
    }
}

typedef struct batch {
    uint32_t count, kinds[8];
    float *inputs, *truths, *outputs;
} batch;

static batch new_batch(stress *s, const gnn_unet_desc *d, uint32_t count, bool hostile)
{
    size_t area = area_of(d);
    batch b = {count, {0}, new_floats(count * d->inputs * area), new_floats(count * area), new_floats(count * area)};
    for (uint32_t m = 0; m < count; ++m) {
        b.kinds[m] = stress_below(s, hostile ? KINDS : HOSTILE);
        make_map(s, d, b.kinds[m], b.inputs + m * d->inputs * area);
        for (size_t i = 0; i < area; ++i)
            b.truths[m * area + i] = 2 * stress_unitf(s);
        if (hostile && stress_chance(s, 0.1)) {
            b.truths[m * area + stress_below(s, (uint32_t)area)] = hostile_number(s);
            b.kinds[m] = b.kinds[m] < HOSTILE ? HOSTILE : b.kinds[m]; /* only what is trained is bad, at most */
        }
    }
    return b;
}

static void free_batch(batch *b)
{
    free(b->inputs);
    free(b->truths);
    free(b->outputs);
}

static bool all_finite(const float *x, size_t count)
{
    size_t i = 0;
    while (i < count && isfinite(x[i]))
        ++i;
    return i == count;
}

/* Each map alone gives the bits it has in the batch, whatever the others hold and wherever the workspace lies. */
static void check_outputs(stress *s, const gnn_unet *net, const gnn_unet_desc *d, const batch *b)
{
    size_t area = area_of(d);
    float *alone = new_floats(area);
    space w = new_space(s, gnn_unet_workspace(net, 1, false));
    for (uint32_t m = 0; m < b->count && !s->failed; ++m) {
        STRESS_CHECK(
            s, gnn_unet_forward(net, b->inputs + m * d->inputs * area, 1, alone, w.start, w.size, NULL, NULL) == GNN_OK,
            "forward");
        STRESS_CHECK(s, memcmp(alone, b->outputs + m * area, area * sizeof *alone) == 0, "map %u is another alone", m);
        STRESS_CHECK(s, b->kinds[m] >= HOSTILE || all_finite(alone, area), "map %u, kind %u, is not finite", m,
                     b->kinds[m]);
    }
    free_space(s, &w);
    free(alone);
}

/* The batch's gradient is that of its maps that count, and those are what count alone. */
static uint32_t check_gradients(stress *s, const gnn_unet *net, const gnn_unet_desc *d, const batch *b)
{
    size_t area = area_of(d), floats = gnn_unet_floats(net);
    float *g = new_floats(2 * floats);
    batch good = new_batch(s, d, b->count, false);
    gnn_step step, one;
    space w = new_space(s, gnn_unet_workspace(net, 1 + stress_below(s, b->count), true));
    gnn_unet_gradients(net, b->inputs, b->truths, b->count, g, &step, w.start, w.size, NULL, NULL);
    STRESS_CHECK(s, step.maps + step.refused == b->count && step.loss >= 0 && step.loss < 1e6, "loss %g", step.loss);
    STRESS_CHECK(s, all_finite(g, floats), "a gradient is not finite");
    good.count = 0;
    for (uint32_t m = 0; m < b->count; ++m) {
        const float *input = b->inputs + m * d->inputs * area, *truth = b->truths + m * area;
        gnn_unet_gradients(net, input, truth, 1, g + floats, &one, w.start, w.size, NULL, NULL);
        STRESS_CHECK(s, b->kinds[m] >= HOSTILE || one.maps == 1, "map %u, kind %u, refused", m, b->kinds[m]);
        if (!one.maps)
            continue;
        memcpy(good.inputs + good.count * d->inputs * area, input, d->inputs * area * sizeof(float));
        memcpy(good.truths + good.count++ * area, truth, area * sizeof(float));
    }
    if (s->sabotage && good.count && stress_chance(s, 0.5))
        s->deviating = true, good.inputs[0] += 1, good.truths[0] -= 1;
    gnn_unet_gradients(net, good.inputs, good.truths, good.count, g + floats, &one, w.start, w.size, NULL, NULL);
    STRESS_CHECK(s, one.maps == step.maps, "%u maps count alone, %u together", one.maps, step.maps);
    STRESS_CHECK(s, one.loss == step.loss && memcmp(g, g + floats, floats * sizeof *g) == 0,
                 "refused maps change the gradient: loss %g, %g", one.loss, step.loss);
    free_space(s, &w);
    free_batch(&good);
    free(g);
    return step.refused;
}

static void hostile_maps(stress *s)
{
    gnn_unet_desc d = any_desc(s);
    gnn_unet *net = new_net(s, &d);
    batch b = new_batch(s, &d, 1 + stress_below(s, 6), true);
    space w = new_space(s, gnn_unet_workspace(net, 1 + stress_below(s, b.count), true));
    uint32_t refused;
    gnn_step step;
    STRESS_CHECK(s, gnn_unet_forward(net, b.inputs, b.count, b.outputs, w.start, w.size, NULL, NULL) == GNN_OK,
                 "forward");
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, b.outputs[0] = 12345;
    check_outputs(s, net, &d, &b);
    refused = check_gradients(s, net, &d, &b);
    for (int i = 0; i < 4; ++i) {
        STRESS_CHECK(s, gnn_unet_train(net, b.inputs, b.truths, b.count, &step, w.start, w.size, NULL, NULL) == GNN_OK,
                     "train");
        STRESS_CHECK(s, all_finite(net->weights, net->floats) && all_finite(net->first, 2 * net->floats),
                     "training leaves weights that are not finite");
    }
    if (s->sabotage && !s->deviating && w.behind)
        s->deviating = true, w.start[w.size] = 0;
    free_space(s, &w);
    free_batch(&b);
    gnn_unet_destroy(net);
    stress_end(s, refused > 0);
}

/* Any workspace: too small is refused and nothing is written. Any alignment; any number of threads: the same bits. */
static void threads(stress *s)
{
    gnn_unet_desc d = any_desc(s);
    size_t area = area_of(&d);
    gnn_unet *net[2] = {new_net(s, &d), NULL};
    batch b = new_batch(s, &d, 1 + stress_below(s, 8), stress_chance(s, 0.3));
    float *outputs = new_floats(b.count * area);
    gnn_step step[2];
    gnn_unet_create(&d, &net[1]);
    for (uint32_t i = 0; i < gnn_unet_tensors(net[0]); ++i) {
        float *values = new_floats(gnni_tensor_count(net[0], i));
        gnn_unet_tensor_export(net[0], NULL, i, values);
        gnn_unet_tensor_import(net[1], i, values);
        free(values);
    }
    for (int k = 0; k < 2; ++k) {
        stress_crowd crowd = {1 + (int)stress_below(s, 8)};
        space w = new_space(s, gnn_unet_workspace(net[k], 1 + stress_below(s, b.count), true));
        float *out = k ? outputs : b.outputs;
        for (int i = 0; i < 3; ++i)
            gnn_unet_train(net[k], b.inputs, b.truths, b.count, &step[k], w.start, w.size, k ? stress_parallel : NULL,
                           &crowd);
        gnn_unet_forward(net[k], b.inputs, b.count, out, w.start, w.size, k ? stress_parallel : NULL, &crowd);
        free_space(s, &w);
        if (s->sabotage && k == 0)
            s->deviating = true, b.kinds[0] = ORDINARY, make_map(s, &d, ORDINARY, b.inputs), b.truths[0] += 1;
    }
    STRESS_CHECK(s, memcmp(&step[0], &step[1], sizeof step[0]) == 0, "loss %g, on threads %g", step[0].loss,
                 step[1].loss);
    STRESS_CHECK(s, memcmp(net[0]->weights, net[1]->weights, net[0]->floats * sizeof(float)) == 0, "weights");
    STRESS_CHECK(s, memcmp(outputs, b.outputs, b.count * area * sizeof(float)) == 0, "outputs");
    free(outputs);
    free_batch(&b);
    gnn_unet_destroy(net[0]);
    gnn_unet_destroy(net[1]);
    stress_survived(s);
}

static void small_workspaces(stress *s)
{
    gnn_unet_desc d = any_desc(s);
    gnn_unet *net = new_net(s, &d);
    batch b = new_batch(s, &d, 2, false);
    float *before = new_floats(gnn_unet_floats(net));
    memcpy(before, net->weights, net->floats * sizeof(float));
    for (int i = 0; i < 12; ++i) {
        bool train = stress_chance(s, 0.5);
        size_t needed = gnn_unet_workspace(net, 1, train), size = needed - 64;
        space w;
        gnn_step step;
        gnn_result result;
        if (stress_chance(s, 0.5))
            size = (size_t)stress_log(s, 1, (double)size);
        if (s->sabotage && stress_chance(s, 0.2))
            s->deviating = true, size = needed;
        w = new_space(s, size);
        result = train ? gnn_unet_train(net, b.inputs, b.truths, 2, &step, w.start, size - 1, NULL, NULL)
                       : gnn_unet_forward(net, b.inputs, 2, b.outputs, w.start, size - 1, NULL, NULL);
        STRESS_CHECK(s, result == GNN_BUFFER_TOO_SMALL, "%zu bytes of %zu: %s", size - 1, needed,
                     gnn_result_string(result));
        for (size_t k = 0; k < size; ++k)
            STRESS_CHECK(s, s->failed || w.start[k] == 0xff, "%zu bytes of %zu: byte %zu written", size, needed, k);
        for (size_t k = 0; k < 2 * area_of(&d); ++k)
            STRESS_CHECK(s, s->failed || b.outputs[k] == 0, "output written");
        STRESS_CHECK(s, memcmp(before, net->weights, net->floats * sizeof(float)) == 0, "weights changed");
        free_space(s, &w);
        stress_end(s, result != GNN_OK);
    }
    free(before);
    free_batch(&b);
    gnn_unet_destroy(net);
}

/* ---- saves of networks */

static unsigned char *new_save(stress *s, const gnn_unet *net, gnn_type type, size_t *size)
{
    const char *note[] = {"note", "a\"b", NULL};
    const char *const *metadata = stress_chance(s, 0.5) ? note : NULL;
    size_t bound = gnn_unet_bound(net, type, metadata), written;
    unsigned char *data = malloc(bound + 1);
    STRESS_CHECK(s, bound && gnn_unet_save(net, type, metadata, data, bound - 1, &written) == GNN_BUFFER_TOO_SMALL,
                 "a save of %zu bytes fits into one less", bound);
    STRESS_CHECK(s, gnn_unet_save(net, type, metadata, data, bound, size) == GNN_OK && *size == bound,
                 "%zu bytes saved of %zu", *size, bound);
    return data;
}

/* Values behind the header become whatever a float or half can be. */
static void spoil_values(stress *s, unsigned char *data, size_t size)
{
    const uint16_t halves[] = {0x7c00, 0xfc00, 0x7e00, 0x7c01, 1, 0x8000, 0x7bff, 0xfbff};
    size_t header = 8 + data[0] + 256u * data[1] + 65536u * data[2];
    for (uint32_t n = 1 + stress_below(s, 4); n > 0 && header + 4 < size; --n) {
        size_t at = header + stress_below(s, (uint32_t)((size - header) / 4)) * 4;
        float x = hostile_number(s);
        if (stress_chance(s, 0.5))
            memcpy(data + at, &halves[stress_below(s, 8)], 2);
        else
            memcpy(data + at, &x, 4);
    }
}

/* A network that has taken whatever it was: sound, and able to go on. */
static void check_loaded(stress *s, gnn_unet *net, const gnn_unet_desc *d)
{
    batch b = new_batch(s, d, 2, false);
    space w = new_space(s, gnn_unet_workspace(net, 1, true));
    gnn_step step;
    unsigned char *data;
    size_t size = 0;
    STRESS_CHECK(s, all_finite(net->weights, net->floats), "weights that are not finite");
    STRESS_CHECK(s, gnn_unet_forward(net, b.inputs, 2, b.outputs, w.start, w.size, NULL, NULL) == GNN_OK, "forward");
    for (int i = 0; i < 2 && d->training; ++i)
        STRESS_CHECK(s, gnn_unet_train(net, b.inputs, b.truths, 2, &step, w.start, w.size, NULL, NULL) == GNN_OK,
                     "train");
    STRESS_CHECK(s, all_finite(net->weights, net->floats), "weights that are not finite after going on");
    STRESS_CHECK(s, !d->training || all_finite(net->first, 2 * net->floats), "moments that are not finite");
    data = new_save(s, net, GNN_TYPE_F32, &size);
    STRESS_CHECK(s, gnn_unet_load(net, data, size, NULL) == GNN_OK, "what it saves it does not load");
    free(data);
    free_space(s, &w);
    free_batch(&b);
}

/* All that a network keeps. */
static size_t kept_floats(const gnn_unet *net) { return net->floats * (net->desc.training ? 3 : 1); }

static void keep(const gnn_unet *net, float *kept)
{
    memcpy(kept, net->weights, net->floats * sizeof *kept);
    if (net->desc.training)
        memcpy(kept + net->floats, net->first, 2 * net->floats * sizeof *kept);
}

static void try_save(stress *s, gnn_unet *net, const gnn_unet_desc *d, const unsigned char *data, size_t size,
                     const char *how)
{
    unsigned char *exact = malloc(size ? size : 1);
    float *before = new_floats(2 * kept_floats(net)), *after = before + kept_floats(net);
    uint64_t steps = net->step;
    gnn_message message;
    gnn_result result;
    bool same;
    memcpy(exact, data, size);
    keep(net, before);
    result = gnn_unet_load(net, exact, size, &message);
    free(exact);
    if (s->sabotage && stress_chance(s, 0.1))
        s->deviating = true, net->weights[0] = NAN;
    keep(net, after);
    same = memcmp(before, after, kept_floats(net) * sizeof *before) == 0 && net->step == steps;
    check_message(s, &message, result);
    STRESS_CHECK(
        s, result == GNN_OK || result == GNN_BAD_FILE || result == GNN_MISSING_TENSOR || result == GNN_WRONG_TENSOR,
        "%s: %s", how, gnn_result_string(result));
    STRESS_CHECK(s, result == GNN_OK || same, "%s: refused, yet the network is another", how);
    STRESS_CHECK(s, result == GNN_OK || strcmp(how, "untouched"), "untouched: %s", message.text);
    if (result == GNN_OK)
        check_loaded(s, net, d);
    free(before);
    stress_end(s, result != GNN_OK);
}

static void forged_saves(stress *s)
{
    stress_memory memory = {0};
    gnn_unet_desc d = any_desc(s);
    gnn_unet *net, *target;
    gnn_type type = stress_chance(s, 0.5) ? GNN_TYPE_F32 : GNN_TYPE_F16;
    size_t size[2] = {0, 0};
    unsigned char *data[2], *forged;
    d.training = stress_chance(s, 0.7);
    net = new_net(s, &d);
    for (int k = 0; k < 2; ++k) {
        data[k] = new_save(s, net, type, &size[k]);
        if (d.training && k == 0)
            check_loaded(s, net, &d); /* trains */
        else
            gnn_unet_seed(net, 7);
    }
    d.allocate = stress_allocate;
    d.release = stress_release;
    d.user = &memory;
    target = new_net(s, &d);
    forged = malloc(size[0]);
    try_save(s, target, &d, data[0], size[0], "untouched");
    for (int i = 0; i < 12; ++i) {
        size_t n = size[0];
        const char *how = "values";
        memcpy(forged, data[0], n);
        if (stress_chance(s, 0.5))
            spoil_values(s, forged, n);
        for (uint32_t k = stress_below(s, 3); k > 0 && n > 0; --k)
            how = forge(s, forged, &n, data[1], size[1]);
        try_save(s, target, &d, forged, n, how);
    }
    gnn_unet_destroy(target);
    STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
    gnn_unet_destroy(net);
    free(forged);
    free(data[0]);
    free(data[1]);
}

/* Create, load, measure, save with each request of memory failing in turn: told, nothing lost, nothing changed. */
static void failing_allocator(stress *s)
{
    gnn_unet_desc d = any_desc(s);
    gnn_unet *net = new_net(s, &d);
    size_t size = 0, written;
    unsigned char *data = new_save(s, net, GNN_TYPE_F32, &size), *again = malloc(size);
    bool every = stress_chance(s, 0.5);
    for (long k = 0; k < 8; ++k) {
        stress_memory memory = {0};
        gnn_unet_desc own = d;
        gnn_unet *other = NULL;
        void *planted = NULL;
        long before;
        bool good;
        own.allocate = stress_allocate;
        own.release = stress_release;
        own.user = &memory;
        *(every ? &memory.fail_every : &memory.fail_at) = k;
        good = gnn_unet_create(&own, &other) == GNN_OK;
        STRESS_CHECK(s, good == (other != NULL) && good == (memory.failed == 0), "create with %ld failures",
                     memory.failed);
        if (other && s->sabotage && stress_chance(s, 0.3))
            s->deviating = true, planted = stress_allocate(&memory, 8);
        for (int i = 0; other && i < 2; ++i) {
            gnn_result result;
            before = memory.failed;
            gnn_unet_seed(other, 5);
            result = gnn_unet_load(other, data, size, NULL);
            STRESS_CHECK(
                s, (result == GNN_OUT_OF_MEMORY) == (memory.failed > before) && (result == GNN_OK || memory.failed),
                "load: %s", gnn_result_string(result));
            before = memory.failed;
            STRESS_CHECK(s, (gnn_unet_bound(other, GNN_TYPE_F32, NULL) == 0) == (memory.failed > before), "bound");
            before = memory.failed;
            result = gnn_unet_save(other, GNN_TYPE_F32, NULL, again, size, &written);
            STRESS_CHECK(
                s, (result == GNN_OUT_OF_MEMORY) == (memory.failed > before) && (result == GNN_OK || memory.failed),
                "save: %s", gnn_result_string(result));
        }
        memory.fail_at = memory.fail_every = 0;
        if (other)
            check_loaded(s, other, &d);
        STRESS_CHECK(s, memory.live == (other ? 2 : 0), "%ld pieces of memory are held", memory.live);
        gnn_unet_destroy(other);
        STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
        stress_release(&memory, planted);
        stress_end(s, memory.failed > 0);
    }
    gnn_unet_destroy(net);
    free(data);
    free(again);
}

/* ---- descriptors */

/* Descriptors of networks that are too large for a test fail for want of memory. */
static void *allocate_little(void *user, size_t size)
{
    stress_memory *m = user;
    if (size > (size_t)8 << 20)
        return ++m->failed, NULL;
    return stress_allocate(user, size);
}

static bool within(double x, double low, double high) { return x >= low && x <= high; }

/* Whether the header's comments refuse the descriptor. */
static bool is_bad(const gnn_unet_desc *d)
{
    uint32_t levels = d->levels ? d->levels : 3, width = d->width ? d->width : 64, height = d->height ? d->height : 32;
    uint32_t channels = 8;
    bool bad = levels > 6 || d->inputs > 16 || width > 1024 || height > 1024;
    for (uint32_t l = 0; l < levels && l < 6; ++l) {
        channels = d->channels[l] ? d->channels[l] : l ? 2 * channels : 8;
        bad = bad || channels > 512;
    }
    bad = bad || width % (1u << levels) || height % (1u << (levels - 1));
    bad = bad || (d->lambda != 0 && !within((double)d->lambda, 1, 100));
    bad = bad || (d->deep != 0 && d->deep != -1 && !within((double)d->deep, 0, 100));
    bad = bad || (d->rate != 0 && !within((double)d->rate, (double)1e-8f, 1));
    bad = bad || (d->beta1 != 0 && !within((double)d->beta1, 0, 0.99999));
    bad = bad || (d->beta2 != 0 && !within((double)d->beta2, 0, 0.99999));
    return bad || (unsigned)d->simd > GNN_SIMD_NEON || gnn_resolve_simd(d->simd) == GNN_SIMD_AUTO;
}

static uint32_t wild_size(stress *s, uint32_t usual)
{
    const uint32_t some[] = {0, 1, 2, 3, 63, 512, 513, 1024, 1025, 2048, 0x80000000u, 0xffffffffu};
    return stress_chance(s, 0.5) ? usual : some[stress_below(s, 12)];
}

static gnn_unet_desc wild_desc(stress *s)
{
    gnn_unet_desc d = any_desc(s);
    float *numbers[] = {&d.lambda, &d.deep, &d.rate, &d.beta1, &d.beta2};
    d.training = stress_chance(s, 0.5);
    if (stress_chance(s, 0.3))
        d.levels = stress_below(s, 9);
    for (uint32_t n = stress_below(s, 3); n > 0; --n) {
        uint32_t kind = stress_below(s, 6), l = stress_below(s, 6);
        if (kind == 0)
            d.width = wild_size(s, 64u * (1 + stress_below(s, 16)));
        if (kind == 1)
            d.height = wild_size(s, 32u * (1 + stress_below(s, 32)));
        if (kind == 2)
            d.inputs = wild_size(s, 1 + stress_below(s, 17));
        if (kind == 3)
            d.channels[l] = wild_size(s, 1 + stress_below(s, 100));
        if (kind == 4)
            d.simd = (gnn_simd)stress_below(s, 8);
        if (kind == 5)
            *numbers[stress_below(s, 5)] = stress_chance(s, 0.5) ? hostile_number(s) : stress_unitf(s);
    }
    return d;
}

/* Names are there once, values come back as they were set, and what is not set is left alone. */
static void check_named(stress *s, gnn_unet *net)
{
    uint64_t sum = 0;
    for (uint32_t i = 0; i < gnn_unet_tensors(net); ++i) {
        char name[40], other[40];
        uint32_t rank;
        uint64_t shape[GNN_MAX_RANK], count = gnn_unet_tensor(net, i, name, &rank, shape), product = 1;
        for (uint32_t r = 0; r < rank; ++r)
            product *= shape[r];
        STRESS_CHECK(s, product == count && strlen(name) < 40, "%s: %llu values", name, (unsigned long long)count);
        sum += count;
        for (uint32_t j = 0; j < i; ++j) {
            gnn_unet_tensor(net, j, other, &rank, shape);
            STRESS_CHECK(s, strcmp(name, other), "two tensors %s", name);
        }
    }
    STRESS_CHECK(s, sum == gnn_unet_parameters(net) && sum <= gnn_unet_floats(net), "%llu values in all",
                 (unsigned long long)sum);
}

static void descriptors(stress *s)
{
    gnn_unet_desc d = wild_desc(s), resolved = d;
    stress_memory memory = {0};
    gnn_unet *net = NULL;
    bool bad = is_bad(&d);
    gnn_result result;
    d.allocate = allocate_little;
    d.release = stress_chance(s, 0.05) ? NULL : stress_release;
    d.user = &memory;
    bad = bad || !d.release;
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, bad = !bad;
    result = gnn_unet_create(&d, &net);
    STRESS_CHECK(s, (result == GNN_OK) == (net != NULL), "%s", gnn_result_string(result));
    STRESS_CHECK(s, result == GNN_OUT_OF_MEMORY ? memory.failed > 0 && !bad : (result != GNN_OK) == bad,
                 "%s, should be %s", gnn_result_string(result), bad ? "refused" : "accepted");
    if (net) {
        resolved = gnn_unet_get_desc(net);
        STRESS_CHECK(s, gnn_unet_resolve(&resolved) == GNN_OK && resolved.simd == gnn_unet_get_desc(net).simd,
                     "what is resolved is not accepted");
        check_named(s, net);
    }
    if (net && gnn_unet_workspace(net, 1, false) < (size_t)8 << 20 && gnn_unet_operations(net) < 1e8) {
        batch b = new_batch(s, &resolved, 1, false);
        space w = new_space(s, gnn_unet_workspace(net, 1, false));
        STRESS_CHECK(s,
                     gnn_unet_forward(net, b.inputs, 1, b.outputs, w.start, w.size, NULL, NULL) == GNN_OK &&
                         all_finite(b.outputs, area_of(&resolved)),
                     "forward");
        free_space(s, &w);
        free_batch(&b);
    }
    gnn_unet_destroy(net);
    STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
    stress_end(s, result != GNN_OK);
}

/* ---- convolutions of any shape against their definition in double precision */

typedef struct layer {
    gnn_conv conv;
    double *all, *kernel, *bias, *mask, *add, *expected; /* planes; all: upsampled, then in */
    float *up, *in, *scale, *add_map, *out, *weights;    /* exactly as large as the comments say */
} layer;

static gnn_conv any_conv(stress *s)
{
    gnn_conv c;
    memset(&c, 0, sizeof c);
    c.up = stress_chance(s, 0.4) ? 1 + stress_below(s, 20) : 0;
    c.in = !c.up || stress_chance(s, 0.7) ? 1 + stress_below(s, 20) : 0;
    c.width = c.up ? 4 + 4 * stress_below(s, 6) : 2 + 2 * stress_below(s, 12);
    c.height = c.up ? 2 + 2 * stress_below(s, 6) : 1 + stress_below(s, 12);
    c.out = 1 + stress_below(s, stress_chance(s, 0.2) ? 70 : 20);
    c.up_stride = gnn_stride(c.up);
    c.in_stride = gnn_stride(c.in) + (stress_chance(s, 0.2) ? 8 : 0);
    c.out_stride = gnn_stride(c.out);
    c.relu = stress_chance(s, 0.5);
    c.no_winograd = stress_chance(s, 0.3);
    do
        c.simd = (gnn_simd)(GNN_SIMD_SCALAR + (int)stress_below(s, 4));
    while (gnn_resolve_simd(c.simd) != c.simd);
    return c;
}

/* Put one number of it beyond its limits; it must be refused. */
static void spoil_conv(stress *s, gnn_conv *c)
{
    uint32_t *odd[] = {&c->width, &c->in_stride, &c->out_stride};
    uint32_t *sizes[] = {&c->width, &c->height, &c->up, &c->in, &c->in_stride, &c->out, &c->out_stride};
    switch (stress_below(s, 4)) {
    case 0:
        *odd[stress_below(s, 3)] += 1;
        break;
    case 1:
        *sizes[stress_below(s, 7)] = stress_chance(s, 0.5) ? 8200 : UINT32_MAX - stress_below(s, 3);
        break;
    case 2:
        *(stress_chance(s, 0.5) ? &c->width : &c->out) = 0;
        break;
    default:
        c->simd = stress_chance(s, 0.5) ? GNN_SIMD_AUTO : (gnn_simd)7;
    }
}

/* Planes with values of one power of ten. */
static double *any_planes(stress *s, size_t count, double scale)
{
    double *p = naive_new(count ? count : 1);
    for (size_t i = 0; i < count; ++i)
        p[i] = (double)(float)(scale * (2 * stress_unit(s) - 1));
    return p;
}

/* A map of exactly its size, NaN where it is not written. */
static float *new_map(const double *planes, uint32_t width, uint32_t height, uint32_t channels, uint32_t stride)
{
    size_t floats = gnn_map_floats(width, height, stride), n = (size_t)width * height * channels;
    float *map = malloc(floats * sizeof *map + 1), *p = new_floats(n);
    memset(map, 0xff, floats * sizeof *map);
    for (size_t i = 0; i < n && planes; ++i)
        p[i] = (float)planes[i];
    if (planes)
        gnn_map_from_planes(p, width, height, channels, stride, map);
    free(p);
    return map;
}

static layer new_layer(stress *s, const gnn_conv *c, double scale)
{
    layer l;
    size_t area = (size_t)c->width * c->height, inputs = c->up + c->in, kernels = c->out * inputs * 9;
    double *up = any_planes(s, area / 4 * c->up, scale);
    float *kernel = new_floats(kernels + c->out), *bias = kernel + kernels;
    memset(&l, 0, sizeof l);
    l.conv = *c;
    l.all = any_planes(s, area * inputs, scale);
    l.kernel = any_planes(s, kernels, 1);
    l.bias = any_planes(s, c->out, scale);
    l.add = stress_chance(s, 0.4) ? any_planes(s, area * c->out, scale) : NULL;
    l.expected = naive_new(area * c->out);
    if (!c->up && stress_chance(s, 0.4)) {
        l.mask = naive_new(area);
        l.scale = new_floats(2 * area);
        for (size_t i = 0; i < area; ++i)
            l.scale[area + i] = (float)(l.mask[i] = stress_chance(s, 0.2));
        gnn_mask_grow(l.scale + area, c->width, c->height, l.scale, NULL);
    }
    naive_upsample(up, (int)c->up, (int)c->width / 2, (int)c->height / 2, l.all);
    for (size_t i = 0; i < area * inputs && l.mask; ++i)
        l.all[i] *= l.mask[i % area];
    if (c->up)
        l.up = new_map(up, c->width / 2, c->height / 2, c->up, c->up_stride);
    if (c->in)
        l.in = new_map(l.all + area * c->up, c->width, c->height, c->in, c->in_stride);
    if (l.add)
        l.add_map = new_map(l.add, c->width, c->height, c->out, c->out_stride);
    l.out = new_map(NULL, c->width, c->height, c->out, c->out_stride);
    for (size_t i = 0; i < kernels; ++i)
        kernel[i] = (float)l.kernel[i];
    for (size_t i = 0; i < c->out; ++i)
        bias[i] = (float)l.bias[i];
    l.weights = malloc(gnn_conv_weights(c) * sizeof(float));
    gnn_conv_import(c, kernel, bias, l.weights);
    free(up);
    free(kernel);
    return l;
}

static void free_layer(layer *l)
{
    void *all[] = {l->all, l->kernel, l->bias,  l->mask,    l->add, l->expected,
                   l->up,  l->in,     l->scale, l->add_map, l->out, l->weights};
    for (size_t i = 0; i < sizeof all / sizeof *all; ++i)
        free(all[i]);
}

/* Worst difference by the definition's root mean square. */
static double forward_error(const layer *l)
{
    const gnn_conv *c = &l->conv;
    size_t area = (size_t)c->width * c->height, n = area * c->out;
    double worst = 0, square = 0;
    float *got = new_floats(n);
    naive_conv(l->all, (int)(c->up + c->in), (int)c->width, (int)c->height, l->kernel, l->bias, l->mask, l->add,
               c->relu, (int)c->out, l->expected);
    gnn_map_to_planes(l->out, c->width, c->height, c->out, c->out_stride, got);
    for (size_t i = 0; i < n; ++i) {
        double e = fabs((double)got[i] - l->expected[i]);
        worst = e <= worst ? worst : e; /* NaN stays */
        square += l->expected[i] * l->expected[i];
    }
    free(got);
    return square > 0 ? worst / sqrt(square / (double)n) : worst;
}

static double dot(const double *a, const float *map, uint32_t width, uint32_t height, uint32_t channels,
                  uint32_t stride)
{
    size_t n = (size_t)width * height * channels;
    float *planes = new_floats(n);
    double sum = 0;
    gnn_map_to_planes(map, width, height, channels, stride, planes);
    for (size_t i = 0; i < n; ++i)
        sum += a[i] * (double)planes[i];
    free(planes);
    return sum;
}

/* The sum is linear in its input and in its kernel: <g, out - bias - add> = <in, din> = <kernel, dkernel>. */
static void check_backward(stress *s, layer *l, const gnn_conv_maps *m, const float *prepared, float *scratch)
{
    const gnn_conv *c = &l->conv;
    size_t area = (size_t)c->width * c->height, kernels = (size_t)c->out * (c->up + c->in) * 9;
    double *g = any_planes(s, area * c->out, 1), *bias = naive_new(c->out), left = 0, by_map = 0, by_kernel = 0,
           size = 0;
    float *dout = new_map(NULL, c->width, c->height, c->out, c->out_stride);
    float *dup = new_floats(gnn_map_floats(c->width / 2, c->height / 2, c->up_stride));
    float *din = new_floats(gnn_map_floats(c->width, c->height, c->in_stride));
    float *dweights = new_floats(gnn_conv_weights(c)), *dkernel = new_floats(kernels);
    naive_conv(l->all, (int)(c->up + c->in), (int)c->width, (int)c->height, l->kernel, bias, l->mask, NULL, 0,
               (int)c->out, l->expected);
    for (size_t i = 0; i < area * c->out; ++i) {
        left += g[i] * l->expected[i];
        size += fabs(g[i] * l->expected[i]);
    }
    for (uint32_t o = 0; o < c->out_stride; ++o) /* the halo stays NaN: it is not read */
        for (size_t i = 0; i < area; ++i)
            dout[((i / c->width + 1) * (c->width + 2) + i % c->width + 1) * c->out_stride + o] =
                o < c->out ? (float)g[o * area + i] : 0;
    gnn_conv_backward(c, prepared, m, dout, c->up ? dup : NULL, c->in ? din : NULL, NULL, dweights, scratch);
    gnn_conv_export(c, dweights, dkernel, NULL);
    for (size_t i = 0; i < kernels; ++i)
        by_kernel += l->kernel[i] * (double)dkernel[i];
    by_map = dot(l->all + area * c->up, din, c->width, c->height, c->in, c->in_stride);
    for (uint32_t k = 0; k < c->up * (area / 4); ++k) { /* each pixel of the small map is 2x2 of the large one */
        uint32_t w = c->width / 2, x = k % w, y = k / w % (c->height / 2), i = k / (w * (c->height / 2));
        by_map +=
            l->all[i * area + 2 * y * c->width + 2 * x] * (double)dup[((y + 1) * (w + 2) + x + 1) * c->up_stride + i];
    }
    STRESS_CHECK(s, fabs(by_kernel - left) <= 2e-5 * size, "by the kernel %g, should be %g", by_kernel, left);
    STRESS_CHECK(s, fabs(by_map - left) <= 2e-5 * size, "by the map %g, should be %g", by_map, left);
    free(g), free(bias), free(dout), free(dup), free(din), free(dweights), free(dkernel);
}

static void convolutions(stress *s)
{
    gnn_conv c = any_conv(s), bad = c;
    double error;
    STRESS_CHECK(s, gnn_conv_check(&c) == GNN_OK, "a good shape: %s", gnn_result_string(gnn_conv_check(&c)));
    spoil_conv(s, &bad);
    STRESS_CHECK(s, gnn_conv_check(&bad) != GNN_OK, "%ux%u, %u (%u) + %u (%u) -> %u (%u) is accepted", bad.width,
                 bad.height, bad.up, bad.up_stride, bad.in, bad.in_stride, bad.out, bad.out_stride);
    stress_end(s, true);
    layer l = new_layer(s, &c, stress_log(s, 1e-24, 1e24));
    float *prepared = malloc(gnn_conv_prepared(&c) * sizeof(float) + 1);
    float *scratch = malloc(gnn_conv_scratch(&c) * sizeof(float) + 1);
    gnn_conv_maps m = {l.up, l.in, l.mask ? l.scale : NULL, l.add_map, l.out};
    gnn_conv_prepare(&c, l.weights, prepared);
    gnn_conv_forward(&c, l.weights, prepared, &m, scratch);
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, l.kernel[0] += 1;
    error = forward_error(&l);
    STRESS_CHECK(s, error <= 5e-5, "%ux%u, %u + %u -> %u, level %d: error %g", c.width, c.height, c.up, c.in, c.out,
                 (int)c.simd, error);
    l.conv.relu = false; /* nor was it, for a gradient without */
    check_backward(s, &l, &m, prepared, scratch);
    free(prepared);
    free(scratch);
    free_layer(&l);
    stress_survived(s);
}

int main(int argc, char **argv)
{
    static const stress_group groups[] = {
        {"nn-files", files, 2, true},
        {"nn-forged-saves", forged_saves, 2, true},
        {"nn-hostile-maps", hostile_maps, 3, true},
        {"nn-descriptors", descriptors, 1, true},
        {"nn-convolutions", convolutions, 2, true},
        {"nn-small-workspaces", small_workspaces, 1, true},
        {"nn-failing-allocator", failing_allocator, 1, true},
        {"nn-threads", threads, 1, false},
    };
    return stress_main(argc, argv, "nn", groups, (int)(sizeof groups / sizeof *groups));
}
