/* methods.c: the table of guiding methods. Adding one is one more file and one more line here. */
#include "tracer.h"

#include <stdlib.h>
#include <string.h>

/* The null method: plain path tracing. */
static void *pt_create(tr_method_env *env, char *err, size_t err_size)
{
    (void)env;
    (void)err;
    (void)err_size;
    return malloc(1);
}

static const tr_method pt_method = {
    .name = "pt", .summary = "path tracing with BSDF sampling only", .create = pt_create, .destroy = free};

extern const tr_method tr_method_sdtree;

static const tr_method *const methods[] = {&pt_method, &tr_method_sdtree, NULL};

const tr_method *const *tr_method_list(void) { return methods; }

const tr_method *tr_method_find(const char *name)
{
    for (int i = 0; methods[i]; ++i)
        if (!strcmp(methods[i]->name, name))
            return methods[i];
    return NULL;
}
