/* xmltree.c: XML through expat into a tree. See xmltree.h. */
#include "xmltree.h"
#include "scene_internal.h"

#include <expat.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_DEPTH = 100, MAX_INCLUDES = 12, BLOCK = 65536, BUCKETS = 4096 };

typedef struct block {
    struct block *next;
    size_t used, size;
} block;

typedef struct parameter {
    const char *name, *value;
    bool fixed; /* from the caller: the file's <default> does not change it */
    bool used;
    struct parameter *next;
} parameter;

typedef struct id_entry {
    xnode *node;
    struct id_entry *next;
} id_entry;

struct xtree {
    block *blocks;
    xnode *root;
    parameter *parameters;
    id_entry *ids[BUCKETS];
    tr_log *log;
    int includes; /* depth of <include> now */
    bool failed;
};

/* One file being parsed. */
typedef struct reader {
    xtree *tree;
    XML_Parser parser;
    const char *file;
    xnode *at;
    int depth;
    bool wrapped; /* an included file's <scene> is only a wrapper */
} reader;

/* ---- memory: an arena, freed at once --------------------------------------------------------------------------- */

static void *arena(xtree *t, size_t size)
{
    size = (size + 15) & ~(size_t)15;
    if (!t->blocks || t->blocks->size - t->blocks->used < size) {
        size_t room = size > BLOCK ? size : BLOCK;
        block *b = malloc(sizeof *b + 16 + room);
        if (!b) {
            if (!t->failed)
                tr_message(t->log, TR_ERROR, NULL, 0, "out of memory");
            t->failed = true;
            return NULL;
        }
        b->next = t->blocks;
        b->used = 0;
        b->size = room;
        t->blocks = b;
    }
    unsigned char *base = (unsigned char *)(t->blocks + 1);
    base += (16 - ((uintptr_t)base & 15)) & 15;
    void *p = base + t->blocks->used;
    t->blocks->used += size;
    memset(p, 0, size);
    return p;
}

static char *arena_string(xtree *t, const char *s, size_t length)
{
    char *copy = arena(t, length + 1);
    if (copy)
        memcpy(copy, s, length);
    return copy;
}

void xtree_free(xtree *t)
{
    for (block *b = t ? t->blocks : NULL; b;) {
        block *next = b->next;
        free(b);
        b = next;
    }
    free(t);
}

/* ---- names ---------------------------------------------------------------------------------------------------- */

static bool is_upper(char c) { return c >= 'A' && c <= 'Z'; }
static char lower(char c) { return is_upper(c) ? (char)(c + 32) : c; }

/* toWorld -> to_world, intIOR -> int_ior, sunRadiusScale -> sun_radius_scale; snake_case stays. */
static const char *snake_case(xtree *t, const char *s)
{
    size_t n = strlen(s), k = 0;
    char *out = arena(t, 2 * n + 1);
    for (size_t i = 0; out && i < n; ++i) {
        if (i && is_upper(s[i]) && !is_upper(s[i - 1]) && s[i - 1] != '_')
            out[k++] = '_';
        out[k++] = lower(s[i]);
    }
    return out;
}

static const char *tag_name(xtree *t, const char *s)
{
    char *tag = arena_string(t, s, strlen(s));
    for (char *c = tag; c && *c; ++c)
        *c = lower(*c);
    if (tag && strcmp(tag, "luminaire") == 0)
        return "emitter";
    if (tag && strcmp(tag, "camera") == 0)
        return "sensor";
    return tag;
}

static unsigned hash(const char *s)
{
    unsigned h = 2166136261u;
    while (*s)
        h = (h ^ (unsigned char)*s++) * 16777619u;
    return h % BUCKETS;
}

xnode *xtree_find(const xtree *t, const char *id)
{
    for (id_entry *e = t->ids[hash(id)]; e; e = e->next)
        if (strcmp(e->node->id, id) == 0)
            return e->node;
    return NULL;
}

static void add_id(xtree *t, xnode *node)
{
    id_entry *e = arena(t, sizeof *e);
    if (!e)
        return;
    const xnode *other = xtree_find(t, node->id);
    if (other) {
        tr_message(t->log, TR_WARNING, node->file, node->line, "id '%s' is already used in line %d, which counts",
                   node->id, other->line);
        return;
    }
    e->node = node;
    e->next = t->ids[hash(node->id)];
    t->ids[hash(node->id)] = e;
}

const char *xnode_attr(xnode *node, const char *key)
{
    for (int i = 0; i < node->attr_count; ++i)
        if (strcmp(node->attrs[i].key, key) == 0) {
            node->attrs[i].used = true;
            return node->attrs[i].value;
        }
    return NULL;
}

/* ---- parameters ------------------------------------------------------------------------------------------------ */

static void stop(reader *r, const char *what, const char *detail)
{
    if (!r->tree->failed)
        tr_message(r->tree->log, TR_ERROR, r->file, (int)XML_GetCurrentLineNumber(r->parser), "%s%s%.200s%s", what,
                   detail ? " '" : "", detail ? detail : "", detail ? "'" : "");
    r->tree->failed = true;
    XML_StopParser(r->parser, XML_FALSE);
}

static parameter *find_parameter(xtree *t, const char *name, size_t length)
{
    for (parameter *p = t->parameters; p; p = p->next)
        if (strlen(p->name) == length && memcmp(p->name, name, length) == 0)
            return p;
    return NULL;
}

static void set_parameter(xtree *t, const char *name, const char *value, bool fixed)
{
    parameter *p = find_parameter(t, name, strlen(name));
    if (p && p->fixed)
        p->used = true; /* the file knows it */
    if (p)
        return; /* the first <default> counts */
    p = arena(t, sizeof *p);
    if (!p)
        return;
    p->name = arena_string(t, name, strlen(name));
    p->value = arena_string(t, value, strlen(value));
    p->fixed = fixed;
    p->next = t->parameters;
    if (p->name && p->value)
        t->parameters = p;
}

static size_t identifier(const char *s)
{
    size_t n = 0;
    while ((s[n] >= '0' && s[n] <= '9') || (lower(s[n]) >= 'a' && lower(s[n]) <= 'z') || s[n] == '_')
        ++n;
    return n;
}

/* The longest known parameter that starts the text after a $. */
static parameter *match_parameter(xtree *t, const char *s)
{
    for (size_t n = identifier(s); n > 0; --n) {
        parameter *p = find_parameter(t, s, n);
        if (p)
            return p;
    }
    return NULL;
}

static const char *substitute(reader *r, const char *s)
{
    const char *dollar = strchr(s, '$');
    if (!dollar)
        return arena_string(r->tree, s, strlen(s));
    size_t room = 1;
    for (const char *p = s; *p; ++p, ++room)
        if (*p == '$') {
            parameter *found = match_parameter(r->tree, p + 1);
            if (!found) {
                stop(r, "parameter is used but has neither <default> nor a value from outside:", p);
                return NULL;
            }
            room += strlen(found->value);
        }
    char *out = arena(r->tree, room), *w = out;
    while (out && *s) {
        parameter *p = *s == '$' ? match_parameter(r->tree, s + 1) : NULL;
        if (p) {
            size_t n = strlen(p->value);
            memcpy(w, p->value, n);
            p->used = true;
            w += n;
            s += 1 + strlen(p->name);
        } else
            *w++ = *s++;
    }
    return out;
}

/* ---- parsing -------------------------------------------------------------------------------------------------- */

static bool parse_file(xtree *t, const char *path, xnode *into);

static void add_child(xnode *parent, xnode *child)
{
    child->parent = parent;
    if (parent->last)
        parent->last->next = child;
    else
        parent->first = child;
    parent->last = child;
}

static void include(reader *r, xnode *node)
{
    const char *name = xnode_attr(node, "filename");
    if (!name) {
        stop(r, "<include> has no filename", NULL);
        return;
    }
    if (r->tree->includes >= MAX_INCLUDES) {
        stop(r, "<include> is nested too deep (does a file include itself?):", name);
        return;
    }
    char *path = tr_path_beside(node->file, name);
    const char *kept = path ? arena_string(r->tree, path, strlen(path)) : NULL;
    free(path);
    ++r->tree->includes;
    if (kept && !parse_file(r->tree, kept, r->at))
        stop(r, "the included file cannot be read:", name);
    --r->tree->includes;
}

static void set_attributes(reader *r, xnode *node, const char **atts)
{
    int count = 0;
    while (atts[2 * count])
        ++count;
    node->attrs = arena(r->tree, ((size_t)count + 1) * sizeof *node->attrs);
    for (int i = 0; node->attrs && i < count; ++i) {
        xattr *a = &node->attrs[node->attr_count];
        a->key = arena_string(r->tree, atts[2 * i], strlen(atts[2 * i]));
        a->value = substitute(r, atts[2 * i + 1]);
        if (!a->key || !a->value)
            return;
        ++node->attr_count;
    }
    const char *name = xnode_attr(node, "name"), *type = xnode_attr(node, "type"), *id = xnode_attr(node, "id");
    node->name = name ? snake_case(r->tree, name) : "";
    node->type = type ? type : "";
    node->id = id ? id : "";
}

static void XMLCALL on_start(void *user, const char *tag, const char **atts)
{
    reader *r = user;
    xnode *node = arena(r->tree, sizeof *node);
    if (r->tree->failed || !node) {
        XML_StopParser(r->parser, XML_FALSE);
        return;
    }
    if (++r->depth > MAX_DEPTH) {
        stop(r, "elements are nested too deep", NULL);
        return;
    }
    node->tag = tag_name(r->tree, tag);
    node->name = node->type = node->id = "";
    node->file = r->file;
    node->line = (int)XML_GetCurrentLineNumber(r->parser);
    bool is_default = node->tag && strcmp(node->tag, "default") == 0;
    set_attributes(r, node, atts);
    if (r->tree->failed || !node->name || !node->tag) {
        XML_StopParser(r->parser, XML_FALSE);
        return;
    }
    if (is_default) {
        const char *value = xnode_attr(node, "value"), *name = xnode_attr(node, "name");
        node->used = true;
        if (!name || !*name || !value)
            stop(r, "<default> needs a name and a value", NULL);
        else
            set_parameter(r->tree, name, value, false);
    }
    if (r->depth == 1 && strcmp(node->tag, "scene") == 0 && r->at) {
        r->wrapped = true;
        return;
    }
    if (r->at)
        add_child(r->at, node);
    else
        r->tree->root = node;
    if (*node->id && strcmp(node->tag, "ref") != 0 && strcmp(node->tag, "alias") != 0)
        add_id(r->tree, node);
    r->at = node;
}

static void XMLCALL on_end(void *user, const char *tag)
{
    reader *r = user;
    (void)tag;
    if (r->tree->failed)
        return;
    xnode *node = r->at;
    --r->depth;
    if (r->depth == 0 && r->wrapped)
        return;
    r->at = node->parent;
    if (strcmp(node->tag, "include") == 0 && r->at) {
        node->used = true;
        include(r, node);
    }
}

static void XMLCALL on_text(void *user, const char *text, int length)
{
    reader *r = user;
    for (int i = 0; i < length; ++i)
        if (text[i] != ' ' && text[i] != '\t' && text[i] != '\n' && text[i] != '\r') {
            if (!r->tree->failed)
                tr_message(r->tree->log, TR_WARNING, r->file, (int)XML_GetCurrentLineNumber(r->parser),
                           "text between elements means nothing here: '%.*s'", length - i < 40 ? length - i : 40,
                           text + i);
            return;
        }
}

static bool parse_file(xtree *t, const char *path, xnode *into)
{
    char err[300];
    size_t size;
    unsigned char *data = tr_file_read(path, &size, err, sizeof err);
    if (!data) {
        if (into)
            return false; /* the includer knows the line */
        tr_message(t->log, TR_ERROR, path, 0, "%s", err);
        t->failed = true;
        return false;
    }
    tr_file_used(t->log, path);
    reader r = {t, XML_ParserCreate(NULL), path, into, 0, false};
    bool ok = r.parser != NULL;
    if (ok) {
        XML_SetUserData(r.parser, &r);
        XML_SetElementHandler(r.parser, on_start, on_end);
        XML_SetCharacterDataHandler(r.parser, on_text);
        const int part = 1 << 20;
        enum XML_Status status = XML_STATUS_OK;
        for (size_t at = 0; status == XML_STATUS_OK && at <= size; at += (size_t)part) {
            size_t left = size - at;
            bool last = left <= (size_t)part;
            status = XML_Parse(r.parser, (const char *)data + at, last ? (int)left : part, last);
            if (last)
                break;
        }
        ok = status == XML_STATUS_OK && !t->failed;
        if (!ok && !t->failed)
            tr_message(t->log, TR_ERROR, path, (int)XML_GetCurrentLineNumber(r.parser), "XML: %s",
                       XML_ErrorString(XML_GetErrorCode(r.parser)));
        XML_ParserFree(r.parser);
    }
    t->failed = t->failed || !ok;
    free(data);
    return ok;
}

/* <alias id="old" as="new"/>: another name for an element. */
static void add_aliases(xtree *t, xnode *scene)
{
    for (xnode *n = scene->first; n; n = n->next) {
        if (strcmp(n->tag, "alias") != 0)
            continue;
        const char *as = xnode_attr(n, "as");
        xnode *target = xtree_find(t, n->id);
        id_entry *e = target && as ? arena(t, sizeof *e) : NULL;
        xnode *copy = e ? arena(t, sizeof *copy) : NULL;
        n->used = true;
        if (!copy) {
            tr_message(t->log, TR_ERROR, n->file, n->line, "<alias> of unknown id '%s'", n->id);
            t->failed = true;
            return;
        }
        *copy = *target; /* shares the children; read on its own */
        copy->id = as;
        copy->next = NULL;
        e->node = copy;
        e->next = t->ids[hash(as)];
        t->ids[hash(as)] = e;
    }
}

xtree *xtree_load(const char *path, const tr_define *defines, int define_count, tr_log *log)
{
    xtree *t = calloc(1, sizeof *t);
    if (!t) {
        tr_message(log, TR_ERROR, path, 0, "out of memory");
        return NULL;
    }
    t->log = log;
    for (int i = 0; i < define_count; ++i)
        set_parameter(t, defines[i].name, defines[i].value, true);
    const char *kept = arena_string(t, path, strlen(path));
    bool ok = kept && parse_file(t, kept, NULL);
    if (ok && (!t->root || strcmp(t->root->tag, "scene") != 0)) {
        tr_message(log, TR_ERROR, path, t->root ? t->root->line : 0, "the file's root is not <scene>");
        ok = false;
    }
    if (ok)
        add_aliases(t, t->root);
    for (parameter *p = t->parameters; ok && p; p = p->next)
        if (p->fixed && !p->used)
            tr_message(log, TR_WARNING, path, 0, "the scene has no parameter '%s'", p->name);
    if (ok && !t->failed)
        return t;
    xtree_free(t);
    return NULL;
}

xnode *xtree_root(const xtree *t) { return t->root; }
