/* xml_values.c: numbers, colours, transforms and paths out of an XML tree.

   contents: >>messages >>numbers >>colours >>transforms >>paths >>unused */
#include "xml_internal.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* ---- >>messages --------------------------------------------------------------------------------------------- */

void xml_say(xml_reader *r, tr_level level, const xnode *node, const char *format, ...)
{
    char text[360];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    tr_message(r->log, level, node->file, node->line, "%s", text);
    r->failed = r->failed || level == TR_ERROR;
}

bool xml_once(xml_reader *r, unsigned what)
{
    bool first = !(r->said & what);
    r->said |= what;
    return first;
}

xnode *xml_child(xnode *parent, const char *name)
{
    for (xnode *n = parent->first; n; n = n->next)
        if (strcmp(n->name, name) == 0) {
            n->used = true;
            return n;
        }
    return NULL;
}

static bool has_tag(const xnode *n, const char *list) { return xml_in_list(n->tag, list); }

/* ---- >>numbers ---------------------------------------------------------------------------------------------- */

static bool is_separator(char c) { return c == ' ' || c == ',' || c == '\t' || c == '\n' || c == '\r' || c == ';'; }

/* Numbers between blanks and commas, all finite. Returns how many, -1 = malformed or more than max. */
static int parse_numbers(const char *s, float *out, int max)
{
    int count = 0;
    for (;;) {
        char *end;
        while (is_separator(*s))
            ++s;
        if (!*s)
            return count;
        float v = strtof(s, &end);
        if (end == s || !isfinite(v) || count == max || (*end && !is_separator(*end)))
            return -1;
        out[count++] = v;
        s = end;
    }
}

static bool number_attr(xml_reader *r, xnode *n, const char *key, float *out)
{
    const char *text = xnode_attr(n, key);
    if (!text)
        return false;
    if (parse_numbers(text, out, 1) == 1)
        return true;
    xml_say(r, TR_ERROR, n, "'%.60s' is not a number (<%s>)", text, n->tag);
    return false;
}

static const char *value_of(xml_reader *r, xnode *n)
{
    const char *text = xnode_attr(n, "value");
    if (!text)
        xml_say(r, TR_ERROR, n, "<%s name=\"%s\"> has no value", n->tag, n->name);
    return text;
}

/* The child and its text where it has one of the tags; else NULL, said where it is there at all. */
static xnode *typed_child(xml_reader *r, xnode *parent, const char *name, const char *tags)
{
    xnode *n = xml_child(parent, name);
    if (n && !has_tag(n, tags)) {
        xml_say(r, TR_ERROR, n, "'%s' should be a %s, not <%s>", name, tags, n->tag);
        return NULL;
    }
    return n;
}

float xml_float(xml_reader *r, xnode *parent, const char *name, float fallback)
{
    xnode *n = typed_child(r, parent, name, "float,integer,spectrum");
    float value = fallback;
    if (n && value_of(r, n) && !number_attr(r, n, "value", &value))
        return fallback;
    return value;
}

int xml_int(xml_reader *r, xnode *parent, const char *name, int fallback)
{
    xnode *n = typed_child(r, parent, name, "integer,float");
    const char *text = n ? value_of(r, n) : NULL;
    char *end;
    if (!text)
        return fallback;
    errno = 0;
    long v = strtol(text, &end, 10);
    while (is_separator(*end))
        ++end;
    if (end != text && !*end && errno == 0 && v >= -2147483647L && v <= 2147483647L)
        return (int)v;
    xml_say(r, TR_ERROR, n, "'%.60s' is not a whole number (%s)", text, name);
    return fallback;
}

bool xml_bool(xml_reader *r, xnode *parent, const char *name, bool fallback)
{
    xnode *n = typed_child(r, parent, name, "boolean");
    const char *text = n ? value_of(r, n) : NULL;
    if (!text)
        return fallback;
    if (strcmp(text, "true") == 0 || strcmp(text, "True") == 0)
        return true;
    if (strcmp(text, "false") != 0 && strcmp(text, "False") != 0)
        xml_say(r, TR_ERROR, n, "'%.60s' is neither true nor false (%s)", text, name);
    return false;
}

const char *xml_string(xml_reader *r, xnode *parent, const char *name, const char *fallback)
{
    xnode *n = typed_child(r, parent, name, "string");
    const char *text = n ? value_of(r, n) : NULL;
    return text ? text : fallback;
}

/* x, y, z attributes, or a value with one number (for all) or three. */
static vec3 components(xml_reader *r, xnode *n, vec3 fallback, bool one_for_all)
{
    float v[3] = {fallback.x, fallback.y, fallback.z};
    const char *text = xnode_attr(n, "value");
    if (text) {
        int count = parse_numbers(text, v, 3);
        if (count == 1 && one_for_all)
            return v3s(v[0]);
        if (count != 3 && !(count == 2 && one_for_all))
            xml_say(r, TR_ERROR, n, "'%.60s' is not three numbers (<%s>)", text, n->tag);
        return v3(v[0], v[1], v[2]);
    }
    number_attr(r, n, "x", &v[0]);
    number_attr(r, n, "y", &v[1]);
    number_attr(r, n, "z", &v[2]);
    return v3(v[0], v[1], v[2]);
}

vec3 xml_point(xml_reader *r, xnode *parent, const char *name, vec3 fallback)
{
    xnode *n = typed_child(r, parent, name, "point,vector");
    return n ? components(r, n, v3(0, 0, 0), false) : fallback;
}

float xml_ior(xml_reader *r, xnode *parent, const char *name, float fallback)
{
    xnode *n = xml_child(parent, name);
    float ior = fallback;
    if (!n)
        return fallback;
    if (!has_tag(n, "string"))
        ior = xml_float(r, parent, name, fallback);
    else if (!tr_ior(xml_string(r, parent, name, ""), &ior))
        xml_say(r, TR_WARNING, n, "unknown material '%s', index of refraction %g is used",
                xml_string(r, parent, name, ""), (double)fallback);
    if (ior > 0)
        return ior;
    xml_say(r, TR_ERROR, n, "an index of refraction must be positive");
    return fallback;
}

/* ---- >>colours ---------------------------------------------------------------------------------------------- */

static bool hex_color(const char *s, vec3 *out)
{
    char *end;
    if (s[0] != '#' || strlen(s) != 7 || s[1] == '-' || s[1] == '+')
        return false;
    unsigned long v = strtoul(s + 1, &end, 16);
    *out = v3((float)(v >> 16) / 255, (float)(v >> 8 & 255) / 255, (float)(v & 255) / 255);
    return *end == 0;
}

static vec3 rgb_value(xml_reader *r, xnode *n)
{
    const char *text = value_of(r, n);
    float v[3] = {0};
    vec3 c = {0, 0, 0};
    if (!text)
        return c;
    if (!hex_color(text, &c)) {
        int count = parse_numbers(text, v, 3);
        if (count != 1 && count != 3)
            xml_say(r, TR_ERROR, n, "'%.60s' is not a colour: one number, three, or #rrggbb", text);
        c = count == 1 ? v3s(v[0]) : v3(v[0], v[1], v[2]);
    }
    if (has_tag(n, "srgb"))
        c = v3(tr_srgb_decode(c.x), tr_srgb_decode(c.y), tr_srgb_decode(c.z));
    return c;
}

enum { SPECTRUM_MAX = 4096 };

/* "400:0.1, 500:0.2" or, from a file, "400 0.1" lines with # comments. */
static vec3 spectrum_list(xml_reader *r, xnode *n, const char *text, bool emission)
{
    float *w = malloc(2 * SPECTRUM_MAX * sizeof *w), *v = w ? w + SPECTRUM_MAX : NULL;
    int count = 0;
    bool ok = w != NULL;
    vec3 rgb = {0, 0, 0};
    for (const char *s = text; ok;) {
        char *end;
        while (is_separator(*s) || *s == '#')
            s += *s == '#' ? strcspn(s, "\n") : 1;
        if (!*s)
            break;
        ok = count < SPECTRUM_MAX;
        w[ok ? count : 0] = strtof(s, &end);
        ok = ok && end != s;
        s = end + strspn(end, ": \t");
        v[ok ? count : 0] = strtof(s, &end);
        ok = ok && end != s && isfinite(v[count]) && isfinite(w[count]) && (count == 0 || w[count] > w[count - 1]);
        s = end;
        ++count;
    }
    if (ok && count)
        rgb = tr_spectrum_rgb(w, v, count, emission);
    else
        xml_say(r, TR_ERROR, n, "not a spectrum: pairs wavelength:value at rising wavelengths are expected");
    free(w);
    return rgb;
}

static vec3 spectrum_file(xml_reader *r, xnode *n, const char *name, bool emission)
{
    char err[300];
    size_t size;
    char *path = tr_path_beside(n->file, name);
    unsigned char *data = path ? tr_file_read(path, &size, err, sizeof err) : NULL;
    vec3 rgb = {0, 0, 0};
    if (data) {
        tr_file_used(r->log, path);
        rgb = spectrum_list(r, n, (const char *)data, emission);
    } else
        xml_say(r, TR_ERROR, n, "%s", path ? err : "out of memory");
    free(data);
    free(path);
    return rgb;
}

static vec3 blackbody(xml_reader *r, xnode *n)
{
    const char *text = xnode_attr(n, "temperature");
    float kelvin = 5000, scale = 1;
    if (text) {
        char *end;
        kelvin = strtof(text, &end);
        if (end == text || (*end && strcmp(end, "K") != 0 && strcmp(end, "k") != 0))
            kelvin = -1;
    } else
        kelvin = xml_float(r, n, "temperature", kelvin);
    if (xnode_attr(n, "scale"))
        number_attr(r, n, "scale", &scale);
    else
        scale = xml_float(r, n, "scale", scale);
    if (!(kelvin > 0) || !isfinite(kelvin)) {
        xml_say(r, TR_ERROR, n, "a black body needs a positive temperature");
        return v3(0, 0, 0);
    }
    return scale3(tr_blackbody_rgb(kelvin), scale);
}

static vec3 spectrum_value(xml_reader *r, xnode *n, bool emission)
{
    const char *text = xnode_attr(n, "value"), *file = xnode_attr(n, "filename");
    float v[3];
    if (strcmp(n->type, "blackbody") == 0)
        return blackbody(r, n);
    if (strcmp(n->type, "d65") == 0)
        return v3s(xml_float(r, n, "scale", 1));
    if (strcmp(n->type, "uniform") == 0)
        return v3s(xml_float(r, n, "value", 1));
    if (strcmp(n->type, "rgb") == 0 || strcmp(n->type, "srgb") == 0)
        return xml_color(r, n, strcmp(n->type, "rgb") == 0 ? "value" : "color", v3s(0.5f), emission);
    if (*n->type)
        xml_say(r, TR_WARNING, n, "spectrum type '%s' is not supported; 0.5 is used", n->type);
    if (*n->type)
        return v3s(0.5f);
    if (file)
        return spectrum_file(r, n, file, emission);
    if (!text)
        text = value_of(r, n);
    if (!text)
        return v3(0, 0, 0);
    if (strchr(text, ':'))
        return spectrum_list(r, n, text, emission);
    int count = parse_numbers(text, v, 3);
    if (count != 1 && count != 3)
        xml_say(r, TR_ERROR, n, "'%.60s' is not a spectrum", text);
    return count == 3 ? v3(v[0], v[1], v[2]) : v3s(count == 1 ? v[0] : 0);
}

/* A colour element; false = it is something else. */
static bool color_value(xml_reader *r, xnode *n, bool emission, vec3 *out)
{
    if (has_tag(n, "rgb,srgb,color"))
        *out = rgb_value(r, n);
    else if (has_tag(n, "spectrum"))
        *out = spectrum_value(r, n, emission);
    else if (has_tag(n, "blackbody"))
        *out = blackbody(r, n);
    else if (has_tag(n, "float,integer")) {
        float v = 0;
        if (value_of(r, n))
            number_attr(r, n, "value", &v);
        *out = v3s(v);
    } else
        return false;
    xnode_attr(n, "intent");
    xnode_attr(n, "unit");
    xnode_attr(n, "space");
    if (out->x < 0 || out->y < 0 || out->z < 0) {
        xml_say(r, TR_WARNING, n, "a negative colour was set to 0");
        *out = v3(fmaxf(out->x, 0), fmaxf(out->y, 0), fmaxf(out->z, 0));
    }
    return true;
}

vec3 xml_color(xml_reader *r, xnode *parent, const char *name, vec3 fallback, bool emission)
{
    xnode *n = xml_child(parent, name);
    vec3 c = fallback;
    if (!n || color_value(r, n, emission, &c))
        return c;
    int id = xml_texture(r, n);
    if (id < 0)
        return fallback;
    xml_say(r, TR_WARNING, n, "'%s' cannot vary over the surface here; the texture's mean is used", name);
    return xml_texture_mean(&r->scene->textures[id]);
}

tr_param xml_param(xml_reader *r, xnode *parent, const char *name, tr_param fallback, bool is_number)
{
    xnode *n = xml_child(parent, name);
    tr_param p = fallback;
    if (!n)
        return p;
    if (color_value(r, n, false, &p.value)) {
        p.texture = -1;
        if (is_number)
            p.value = v3s(mean3(p.value));
    } else
        p.texture = xml_texture(r, n);
    return p;
}

/* ---- >>transforms ------------------------------------------------------------------------------------------- */

static bool matrix_value(xml_reader *r, xnode *n, bool uv, mat4 *m)
{
    const char *text = xnode_attr(n, "value");
    float v[16];
    int count = text ? parse_numbers(text, v, 16) : -1;
    *m = mat4_identity();
    if (count == 16)
        memcpy(m->m, v, sizeof v);
    else if (count == 9)
        for (int i = 0; i < 9; ++i) {
            int row = i / 3, column = i % 3;
            if (!uv)
                m->m[row][column] = v[i];
            else if (row < 2) /* the last column of a 3x3 matrix moves uv */
                m->m[row][column == 2 ? 3 : column] = v[i];
        }
    else {
        xml_say(r, TR_ERROR, n, "a <matrix> needs 16 (or 9) numbers");
        return false;
    }
    return true;
}

static bool lookat_value(xml_reader *r, xnode *n, mat4 *m)
{
    static const char *const keys[3] = {"origin", "target", "up"};
    float v[3][3] = {{0, 0, 0}, {0, 0, 1}, {0, 1, 0}};
    for (int i = 0; i < 3; ++i) {
        const char *text = xnode_attr(n, keys[i]);
        if (!text && i == 2) { /* any up will do */
            frame3 f = frame_from_normal(norm3(v3(v[1][0] - v[0][0], v[1][1] - v[0][1], v[1][2] - v[0][2])));
            v[2][0] = f.t.x;
            v[2][1] = f.t.y;
            v[2][2] = f.t.z;
        } else if (!text || parse_numbers(text, v[i], 3) != 3) {
            xml_say(r, TR_ERROR, n, "<lookat> needs three numbers in '%s'", keys[i]);
            return false;
        }
    }
    if (mat4_lookat(v3(v[0][0], v[0][1], v[0][2]), v3(v[1][0], v[1][1], v[1][2]), v3(v[2][0], v[2][1], v[2][2]), m))
        return true;
    xml_say(r, TR_ERROR, n, "<lookat>: origin, target and up lie on one line");
    return false;
}

/* One step of a transform; false = unknown element (said) or bad values (said). */
static bool transform_step(xml_reader *r, xnode *n, bool uv, mat4 *m)
{
    if (strcmp(n->tag, "matrix") == 0)
        return matrix_value(r, n, uv, m);
    if (strcmp(n->tag, "lookat") == 0)
        return lookat_value(r, n, m);
    if (strcmp(n->tag, "translate") == 0)
        *m = mat4_translate(components(r, n, v3(0, 0, 0), false));
    else if (strcmp(n->tag, "scale") == 0)
        *m = mat4_scale(components(r, n, v3(1, 1, 1), true));
    else if (strcmp(n->tag, "rotate") == 0) {
        float angle = 0;
        vec3 axis = components(r, n, v3(0, 0, 0), false);
        if (!xnode_attr(n, "angle"))
            xml_say(r, TR_ERROR, n, "<rotate> has no angle");
        number_attr(r, n, "angle", &angle);
        if (uv && black3(axis))
            axis = v3(0, 0, 1);
        if (black3(axis))
            xml_say(r, TR_ERROR, n, "<rotate> has no axis");
        *m = mat4_rotate(axis, angle);
    } else {
        xml_say(r, TR_WARNING, n, "unknown element <%s> in a transform", n->tag);
        return false;
    }
    return true;
}

bool xml_transform(xml_reader *r, xnode *parent, const char *name, mat4 *out)
{
    xnode *t = typed_child(r, parent, name, "transform");
    *out = mat4_identity();
    for (xnode *n = t ? t->first : NULL; n; n = n->next) {
        mat4 step;
        n->used = true;
        if (transform_step(r, n, strcmp(name, "to_uv") == 0, &step))
            *out = mat4_mul(&step, out);
    }
    if (t)
        xml_report_unused(r, t, "");
    for (int i = 0; i < 16; ++i)
        if (!isfinite(out->m[i / 4][i % 4])) {
            xml_say(r, TR_ERROR, t, "the transform is not finite");
            *out = mat4_identity();
            break;
        }
    return t != NULL;
}

/* ---- >>paths ------------------------------------------------------------------------------------------------ */

char *xml_path(xml_reader *r, xnode *parent, const char *name)
{
    xnode *n = typed_child(r, parent, name, "string");
    const char *text = n ? value_of(r, n) : NULL;
    if (!text || !*text) {
        xml_say(r, TR_ERROR, n ? n : parent, "<%s type=\"%s\"> needs a %s", parent->tag, parent->type, name);
        return NULL;
    }
    char *path = tr_path_beside(n->file, text);
    FILE *f = path ? fopen(path, "rb") : NULL;
    if (f)
        fclose(f);
    else if (path && strcmp(n->file, r->scene->path) != 0) {
        free(path);
        path = tr_path_beside(r->scene->path, text);
    }
    if (!path)
        xml_say(r, TR_ERROR, n, "out of memory");
    return path;
}

xnode *xml_resolve(xml_reader *r, xnode *node)
{
    node->used = true;
    if (strcmp(node->tag, "ref") != 0)
        return node;
    xnode *target = *node->id ? xtree_find(r->tree, node->id) : NULL;
    if (!target)
        xml_say(r, TR_ERROR, node, "<ref> to unknown id '%s'", node->id);
    return target;
}

/* ---- >>unused ----------------------------------------------------------------------------------------------- */

bool xml_in_list(const char *name, const char *list)
{
    size_t n = strlen(name);
    for (const char *s = list; *s; s += *s == ',') {
        size_t length = strcspn(s, ",");
        if (length == n && n && memcmp(s, name, n) == 0)
            return true;
        s += length;
    }
    return false;
}

void xml_accept_all(xnode *node)
{
    node->used = true;
    for (int i = 0; i < node->attr_count; ++i)
        node->attrs[i].used = true;
    for (xnode *n = node->first; n; n = n->next)
        xml_accept_all(n);
}

static void report_child(xml_reader *r, const xnode *parent, const xnode *n)
{
    if (*n->name)
        xml_say(r, TR_WARNING, n, "unknown parameter '%s' (<%s>) in <%s type=\"%s\"> is ignored", n->name, n->tag,
                parent->tag, parent->type);
    else
        xml_say(r, TR_WARNING, n, "unknown element <%s%s%s%s> in <%s%s%s%s> is ignored", n->tag,
                *n->type ? " type=\"" : "", n->type, *n->type ? "\"" : "", parent->tag, *parent->type ? " type=\"" : "",
                parent->type, *parent->type ? "\"" : "");
}

void xml_report_unused(xml_reader *r, xnode *node, const char *accepted)
{
    for (xnode *n = node->first; n; n = n->next) {
        if (n->used && xml_in_list(n->tag, "float,integer,boolean,string,point,vector,rgb,spectrum,translate,scale,"
                                           "rotate,matrix,lookat,transform"))
            for (int i = 0; i < n->attr_count; ++i)
                if (!n->attrs[i].used)
                    xml_say(r, TR_WARNING, n, "unknown attribute '%s' in <%s> is ignored", n->attrs[i].key, n->tag);
        if (n->used)
            continue;
        if (xml_in_list(n->name, accepted) || (!*n->name && xml_in_list(n->tag, accepted)))
            xml_accept_all(n);
        else
            report_child(r, node, n);
        n->used = true;
    }
}
