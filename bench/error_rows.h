/* error_rows.h: what one render measured, as a row of a CSV file that grows while bench_error runs. A file that exists
   is read first and goes on, so that an interrupted run loses nothing but the renders that were under way. */
#ifndef ERROR_ROWS_H
#define ERROR_ROWS_H

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Says what is wrong, in the name of PROGRAM, which whoever includes this has defined. Returns the exit status. */
static inline int die(const char *what, const char *value)
{
    fprintf(stderr, PROGRAM ": %s%s%s\n", what, value ? ": " : "", value ? value : "");
    return 1;
}

/* A file to write; NULL, and said, where that fails. */
static inline FILE *open_in(const char *folder, const char *name)
{
    char path[1024];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *f = fopen(path, "w");
    if (!f)
        die("cannot be written", path);
    return f;
}

/* Numbers of a row, by the names that the renderer's JSON and the CSV use. Missing ones are NaN. */
#define ROW_NUMBERS(X)                                                                                                 \
    X(spp)                                                                                                             \
    X(cpu_seconds)                                                                                                     \
    X(trace_seconds)                                                                                                   \
    X(shade_seconds)                                                                                                   \
    X(query_seconds)                                                                                                   \
    X(record_seconds)                                                                                                  \
    X(update_seconds)                                                                                                  \
    X(relmse)                                                                                                          \
    X(mrae)                                                                                                            \
    X(relmse_untrimmed)                                                                                                \
    X(mrae_untrimmed)                                                                                                  \
    X(cells)                                                                                                           \
    X(bytes)                                                                                                           \
    X(train_spp)                                                                                                       \
    X(train_seconds)                                                                                                   \
    X(denoise_seconds)                                                                                                 \
    X(structure_seconds)                                                                                               \
    X(samples)                                                                                                         \
    X(zeros)                                                                                                           \
    X(lookahead_cells)                                                                                                 \
    X(levels)                                                                                                          \
    X(lobes)                                                                                                           \
    X(reference_relmse)

typedef struct row {
    char scene[64], build[32], method[128];
    char budget[24]; /* "60s" or "64spp", after a training "8+64spp" */
    int seed;
    char status[24]; /* ok, exit N, signal N, timeout */
#define ROW_FIELD(name) double name;
    ROW_NUMBERS(ROW_FIELD)
#undef ROW_FIELD
} row;

typedef struct rows {
    row *at;
    int count, capacity;
} rows;

static inline bool rows_add(rows *all, const row *r)
{
    if (all->count == all->capacity) {
        int capacity = all->capacity ? 2 * all->capacity : 64;
        row *grown = realloc(all->at, sizeof *grown * (size_t)capacity);
        if (!grown)
            return false;
        all->at = grown;
        all->capacity = capacity;
    }
    all->at[all->count++] = *r;
    return true;
}

static inline bool row_same_task(const row *a, const row *b)
{
    return !strcmp(a->scene, b->scene) && !strcmp(a->build, b->build) && !strcmp(a->method, b->method) &&
           !strcmp(a->budget, b->budget) && a->seed == b->seed;
}

/* What rows of one file have in common. */
static inline void rows_settings(char *text, size_t size, const char *picture, int max_depth, const char *nee)
{
    snprintf(text, size, "size %s; max depth %d; nee %s; threads 1", picture, max_depth, nee);
}

static inline bool row_ok(const row *r) { return !strcmp(r->status, "ok"); }

static inline void row_print_csv(FILE *f, const row *r)
{
    fprintf(f, "%s,%s,%s,%s,%d,%s", r->scene, r->build, r->method, r->budget, r->seed, r->status);
#define ROW_PRINT(name)                                                                                                \
    if (isfinite(r->name))                                                                                             \
        fprintf(f, ",%.9g", r->name);                                                                                  \
    else                                                                                                               \
        fputs(",", f);
    ROW_NUMBERS(ROW_PRINT)
#undef ROW_PRINT
    fputc('\n', f);
}

static inline void rows_print_header(FILE *f, const char *settings)
{
    fprintf(f, "# %s\nscene,build,method,budget,seed,status", settings);
#define ROW_NAME(name) fputs("," #name, f);
    ROW_NUMBERS(ROW_NAME)
#undef ROW_NAME
    fputc('\n', f);
}

/* The next field of a line, "" at its end; commas do not occur inside fields. */
static inline const char *csv_field(char **line)
{
    char *start = *line ? *line : (char *)"";
    char *comma = strchr(start, ',');
    *line = comma ? comma + 1 : NULL;
    if (comma)
        *comma = 0;
    return start;
}

static inline double csv_number(char **line)
{
    const char *text = csv_field(line);
    char *end;
    double value = strtod(text, &end);
    return end == text || *end ? (double)NAN : value;
}

static inline bool row_parse(char *line, row *r)
{
    memset(r, 0, sizeof *r);
    snprintf(r->scene, sizeof r->scene, "%.63s", csv_field(&line));
    snprintf(r->build, sizeof r->build, "%.31s", csv_field(&line));
    snprintf(r->method, sizeof r->method, "%.127s", csv_field(&line));
    snprintf(r->budget, sizeof r->budget, "%.23s", csv_field(&line));
    r->seed = atoi(csv_field(&line));
    snprintf(r->status, sizeof r->status, "%.23s", csv_field(&line));
    if (!line || !r->status[0])
        return false; /* cut off in the middle */
#define ROW_READ(name) r->name = csv_number(&line);
    ROW_NUMBERS(ROW_READ)
#undef ROW_READ
    return true;
}

/* Rows of an earlier run; none where there is no file. False, with a message: made with other settings, or unreadable.
   A last line that was cut off is dropped, and told in *cut: the caller writes the file anew. */
static inline bool rows_read(const char *path, const char *settings, rows *all, bool *cut, char *err, size_t err_size)
{
    FILE *f = fopen(path, "r");
    char line[1024];
    *cut = false;
    if (!f)
        return true;
    for (int number = 1; fgets(line, sizeof line, f); ++number) {
        bool whole = strchr(line, '\n') != NULL;
        row r;
        line[strcspn(line, "\r\n")] = 0;
        if (number == 1 && (strncmp(line, "# ", 2) || strcmp(line + 2, settings))) {
            snprintf(err, err_size, "%.200s: made with other settings (%.200s): choose another --out, or remove it",
                     path, line);
            fclose(f);
            return false;
        }
        if (number <= 2)
            continue;
        if (!whole || !row_parse(line, &r))
            *cut = true;
        else if (!rows_add(all, &r)) {
            snprintf(err, err_size, "%.200s: out of memory", path);
            fclose(f);
            return false;
        }
    }
    fclose(f);
    return true;
}

static inline bool rows_write(const char *path, const char *settings, const rows *all)
{
    FILE *f = fopen(path, "w");
    if (!f)
        return false;
    rows_print_header(f, settings);
    for (int i = 0; i < all->count; ++i)
        row_print_csv(f, &all->at[i]);
    return fclose(f) == 0;
}

static inline bool rows_write_json(const char *path, const rows *all)
{
    FILE *f = fopen(path, "w");
    if (!f)
        return false;
    fputs("[", f);
    for (int i = 0; i < all->count; ++i) {
        const row *r = &all->at[i];
        fprintf(f,
                "%s\n  {\"scene\": \"%s\", \"build\": \"%s\", \"method\": \"%s\", \"budget\": \"%s\", \"seed\": %d, "
                "\"status\": \"%s\"",
                i ? "," : "", r->scene, r->build, r->method, r->budget, r->seed, r->status);
#define ROW_JSON(name)                                                                                                 \
    if (isfinite(r->name))                                                                                             \
        fprintf(f, ", \"" #name "\": %.9g", r->name);
        ROW_NUMBERS(ROW_JSON)
#undef ROW_JSON
        fputs("}", f);
    }
    fputs("\n]\n", f);
    return fclose(f) == 0;
}

/* The number after "key": in a JSON text that holds the key once; NaN where it is not there. */
static inline double json_find(const char *text, const char *key)
{
    char quoted[64];
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    if (!at)
        return (double)NAN;
    char *end;
    double value = strtod(at + strlen(quoted), &end);
    return end == at + strlen(quoted) ? (double)NAN : value;
}

/* Fill in the numbers from the renderer's statistics; false = no such file. */
static inline bool row_read_json(const char *path, row *r)
{
    FILE *f = fopen(path, "r");
    static char text[1 << 16];
    if (!f)
        return false;
    size_t n = fread(text, 1, sizeof text - 1, f);
    text[n] = 0;
    fclose(f);
    char *passes = strstr(text, "\"pass\":"); /* whose own keys would be found too */
    if (passes)
        *passes = 0;
#define ROW_FIND(name) r->name = json_find(text, #name);
    ROW_NUMBERS(ROW_FIND)
#undef ROW_FIND
    return isfinite(r->spp) && isfinite(r->cpu_seconds);
}

/* out/kind/SCENE-BUILD-METHOD-BUDGET-SEED.end */
static inline void picture_path(char *path, size_t size, const char *out, const char *kind, const row *r,
                                const char *end)
{
    int n = snprintf(path, size, "%s/%s/%s-%s-%s-%s-%d%s", out, kind, r->scene, r->build, r->method, r->budget, r->seed,
                     end);
    for (int i = (int)strlen(out) + (int)strlen(kind) + 2; i < n && i < (int)size - 1; ++i)
        if (path[i] == ':' || path[i] == '=' || path[i] == '/')
            path[i] = '_';
}

#endif
