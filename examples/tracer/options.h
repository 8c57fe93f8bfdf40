/* options.h: values of the command line that several programs take. */
#ifndef TR_OPTIONS_H
#define TR_OPTIONS_H

#include "tracer.h"

#include <string.h>

/* Split key=value in place. */
static inline bool parse_pair(char *text, const char **key, const char **value)
{
    char *equals = strchr(text, '=');
    if (!equals || equals == text)
        return false;
    *equals = 0;
    *key = text;
    *value = equals + 1;
    return true;
}

static inline bool parse_roulette(const char *text, tr_roulette *mode)
{
    bool guided = !strcmp(text, "guided"), on = !strcmp(text, "on");
    *mode = guided ? TR_ROULETTE_GUIDED : on ? TR_ROULETTE_THROUGHPUT : TR_ROULETTE_OFF;
    return guided || on || !strcmp(text, "off");
}

#endif
