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

extern const tr_method tr_method_sdtree, tr_method_kd, tr_method_photon;

#ifdef TR_OPENPGL
extern const tr_method tr_method_openpgl;
#else
/* Stands in for method_openpgl.cpp, to say how to get it. */
static void *openpgl_create(tr_method_env *env, char *err, size_t err_size)
{
    (void)env;
    snprintf(err, err_size, "method 'openpgl' is not built: make OPENPGL_DIR=/path/to/installation");
    return NULL;
}

static const tr_method tr_method_openpgl = {.name = "openpgl",
                                            .summary = "Intel Open PGL (not built: make OPENPGL_DIR=...)",
                                            .create = openpgl_create,
                                            .destroy = free};
#endif

static const tr_method *const methods[] = {&pt_method,        &tr_method_sdtree,  &tr_method_kd,
                                           &tr_method_photon, &tr_method_openpgl, NULL};

const tr_method *const *tr_method_list(void) { return methods; }

const tr_method *tr_method_find(const char *name)
{
    for (int i = 0; methods[i]; ++i)
        if (!strcmp(methods[i]->name, name))
            return methods[i];
    return NULL;
}
