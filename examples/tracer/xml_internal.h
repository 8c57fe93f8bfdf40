/* xml_internal.h: what the files that turn an XML tree into a scene share. */
#ifndef TR_XML_INTERNAL_H
#define TR_XML_INTERNAL_H

#include "scene_internal.h"
#include "xmltree.h"

/* Things that are said once a scene. */
enum {
    ONCE_FILTER = 1u << 0,
    ONCE_METAL = 1u << 1,
    ONCE_RFILTER = 1u << 2,
    ONCE_SCALE = 1u << 3,
    ONCE_WEIGHT = 1u << 4
};

typedef struct xml_reader {
    tr_scene *scene;
    tr_log *log;
    xtree *tree;
    bool failed;
    int depth;                /* of nested bsdfs and textures */
    int default_bsdf;         /* for shapes that name none; -1 = not made yet */
    unsigned said;            /* ONCE_... */
    struct xml_image *images; /* files already read */
} xml_reader;

/* A message at a node. Errors make the load fail. */
#if defined(__GNUC__)
__attribute__((format(printf, 4, 5)))
#endif
void xml_say(xml_reader *r, tr_level level, const xnode *node, const char *format, ...);
bool xml_once(xml_reader *r, unsigned what); /* true the first time */

/* The child with this name (snake case), marked as used; NULL = none. */
xnode *xml_child(xnode *parent, const char *name);
/* Values of named children; fallback where there is none, and after an error. */
float xml_float(xml_reader *r, xnode *parent, const char *name, float fallback);
int xml_int(xml_reader *r, xnode *parent, const char *name, int fallback);
bool xml_bool(xml_reader *r, xnode *parent, const char *name, bool fallback);
const char *xml_string(xml_reader *r, xnode *parent, const char *name, const char *fallback);
vec3 xml_point(xml_reader *r, xnode *parent, const char *name, vec3 fallback);
vec3 xml_color(xml_reader *r, xnode *parent, const char *name, vec3 fallback, bool emission);
tr_param xml_param(xml_reader *r, xnode *parent, const char *name, tr_param fallback, bool is_number);
float xml_ior(xml_reader *r, xnode *parent, const char *name, float fallback);
/* False = absent; *out is then the identity. */
bool xml_transform(xml_reader *r, xnode *parent, const char *name, mat4 *out);
/* The path of the named string child, beside the file that holds it (or else beside the scene). NULL = error, said.
   To be freed. */
char *xml_path(xml_reader *r, xnode *parent, const char *name);

xnode *xml_resolve(xml_reader *r, xnode *node); /* follows <ref>; NULL = unknown id, said */
void xml_accept_all(xnode *node);               /* marks a subtree as used */
/* Warn about children that nobody asked for, but for those in `accepted` (names or tags, comma-separated). */
void xml_report_unused(xml_reader *r, xnode *node, const char *accepted);
bool xml_in_list(const char *name, const char *list);

int xml_texture(xml_reader *r, xnode *node); /* id; -1 = none (said) */
int xml_bsdf(xml_reader *r, xnode *node);
int xml_default_bsdf(xml_reader *r);
bool xml_read_image(xml_reader *r, xnode *node, const char *path, bool raw, float gamma, tr_image *image, bool share);
void xml_free_images(xml_reader *r);
vec3 xml_texture_mean(const tr_texture *texture);

#endif
