/* field_openpgl.h: Intel Open PGL as methods of field.h (field_openpgl.cpp), where OPENPGL_DIR names an installation.
 */
#ifndef FIELD_OPENPGL_H
#define FIELD_OPENPGL_H

#include "field_method.h"

#ifdef TR_OPENPGL
extern const field_method field_openpgl_method, field_openpgl_4000_method, field_openpgl_quadtree_method;
#else
#define FIELD_OPENPGL_ABSENT(name)                                                                                     \
    {                                                                                                                  \
        name, "Intel Open PGL (not built: make OPENPGL_DIR=...)", 0, 0, 0, 0, 0, 0, 0, 0                               \
    }
static const field_method field_openpgl_method = FIELD_OPENPGL_ABSENT("openpgl");
static const field_method field_openpgl_4000_method = FIELD_OPENPGL_ABSENT("openpgl-4000");
static const field_method field_openpgl_quadtree_method = FIELD_OPENPGL_ABSENT("openpgl-quadtree");
#endif

#endif
