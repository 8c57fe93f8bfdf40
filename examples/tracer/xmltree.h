/* xmltree.h: an XML file as a tree, with Mitsuba's <default>, $parameters and <include> already carried out, names in
   one spelling (toWorld and to_world are both to_world), and marks for what has been used. */
#ifndef TR_XMLTREE_H
#define TR_XMLTREE_H

#include "tracer.h"

typedef struct xattr {
    const char *key, *value;
    bool used;
} xattr;

typedef struct xnode {
    const char *tag;       /* lower case; "sensor", "emitter" also for 0.4's "camera", "luminaire" */
    const char *name;      /* the name attribute in snake case, "" = none */
    const char *type, *id; /* "" = none */
    const char *file;
    int line;
    xattr *attrs;
    int attr_count;
    struct xnode *parent, *first, *last, *next;
    bool used;
    int state, result; /* for the reader: 0 = new, 1 = being read, 2 = done */
} xnode;

typedef struct xtree xtree;

/* Parse a file. NULL after errors were logged. */
xtree *xtree_load(const char *path, const tr_define *defines, int define_count, tr_log *log);
void xtree_free(xtree *tree);
xnode *xtree_root(const xtree *tree);
xnode *xtree_find(const xtree *tree, const char *id); /* NULL = no such id */
/* Value of an attribute, marked as used; NULL = absent. */
const char *xnode_attr(xnode *node, const char *key);

#endif
