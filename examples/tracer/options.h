/* options.h: values of the command line that several programs take, and folders that it names. */
#ifndef TR_OPTIONS_H
#define TR_OPTIONS_H

#include "tracer.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

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

/* "640x360": both 1 .. 16384. */
static inline bool parse_size(const char *text, int *w, int *h)
{
    char *end;
    long a = strtol(text, &end, 10);
    if (end == text || *end != 'x')
        return false;
    const char *second = end + 1;
    long b = strtol(second, &end, 10);
    if (end == second || *end || a < 1 || b < 1 || a > 16384 || b > 16384)
        return false;
    *w = (int)a;
    *h = (int)b;
    return true;
}

/* Make a folder and those above it, where they are missing. */
static inline bool make_folders(const char *path)
{
    char part[1024];
    for (size_t i = 1; path[0] && i < sizeof part && path[i - 1]; ++i)
        if (path[i] == '/' || !path[i]) {
            memcpy(part, path, i);
            part[i] = 0;
            if (mkdir(part, 0777) != 0 && errno != EEXIST)
                return false;
        }
    struct stat there;
    return stat(path, &there) == 0 && S_ISDIR(there.st_mode);
}

#endif
