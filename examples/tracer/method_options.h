/* method_options.h: what guiding methods share: reading their --set key=value, and which tiles record. */
#ifndef TR_METHOD_OPTIONS_H
#define TR_METHOD_OPTIONS_H

#include <stdlib.h>
#include <string.h>

#include "tracer.h"

static const char *option(tr_method_env *env, const char *key)
{
    for (int i = 0; i < env->option_count; ++i)
        if (!strcmp(env->options[i].key, key)) {
            env->options[i].used = true;
            return env->options[i].value;
        }
    return NULL;
}

typedef struct parser {
    tr_method_env *env;
    char *err;
    size_t err_size;
    bool ok;
} parser;

static void complain(parser *p, const char *key, const char *value, const char *expected)
{
    if (p->ok)
        snprintf(p->err, p->err_size, "--set %s=%s: expected %s", key, value, expected);
    p->ok = false;
}

/* Index of the value among names separated by '|', -1 where the option was not given. */
static int choice(parser *p, const char *key, const char *names)
{
    const char *value = option(p->env, key), *at = names;
    for (int i = 0; value; ++i) {
        size_t n = strcspn(at, "|");
        if (strlen(value) == n && !strncmp(value, at, n))
            return i;
        if (!at[n]) {
            complain(p, key, value, names);
            break;
        }
        at += n + 1;
    }
    return -1;
}

static double number(parser *p, const char *key, double fallback)
{
    const char *value = option(p->env, key);
    if (!value)
        return fallback;
    char *end;
    double x = strtod(value, &end);
    if (end == value || *end || !(x >= 0))
        complain(p, key, value, "a number >= 0");
    return x;
}

/* A whole number that fits. */
static uint32_t whole(parser *p, const char *key, uint32_t fallback)
{
    double x = number(p, key, fallback);
    if (x >= 0 && x <= 4294967295.0 && x == floor(x))
        return (uint32_t)x;
    complain(p, key, option(p->env, key), "a whole number, 0 .. 4294967295");
    return fallback;
}

/* Whether a tile's paths are worth recording: every 1 / fraction-th, starting elsewhere in every pass. */
static inline bool tile_records(int pass, float fraction, int tile)
{
    double start = pass * 0.6180339887 + tile * (double)fraction;
    return floor(start + (double)fraction) > floor(start);
}

#endif
