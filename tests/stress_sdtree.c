/* stress_sdtree.c: guide_sdtree.h under hostile and extreme input. See stress.h; `make stress` runs it.

   gcc -std=c11 -O2 -I. tests/stress_sdtree.c -lm -lpthread */
#define _XOPEN_SOURCE 700
#include "stress.h"

#include <float.h>

#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include "building.h"

#define MOST 20000 /* samples of a batch */

/* ---- checks of a field */

/* Quadtree node on the way down: corner, depth, probability by the splits that sampling uses. */
typedef struct place {
    uint32_t node, x, y, depth;
    double share;
} place;

/* Integral of a leaf's density; an oriented one changes from bin to bin. */
static double leaf_integral(const gsd_view *v, const gsd_handle *h, const place *p)
{
    float pdf = v->nodes[p->node].leaf.pdf;
    uint32_t side = p->depth < 3 && h->product > 0 ? 8u >> p->depth : 1, i, j;
    double sum = 0, area = 4 * PI * pow(0.25, p->depth) / (side * side);
    for (j = 0; j < side; ++j)
        for (i = 0; i < side; ++i)
            sum += area * (double)gsd_oriented(v, h, pdf, p->x + (i << 21), p->y + (j << 21), 1);
    return sum;
}

/* Sum over the leaves; *apart = largest difference between a leaf's density and the splits that lead to it. */
static double integral(const gsd_view *v, const gsd_handle *h, double *apart)
{
    place stack[96] = {{h->root, 0, 0, 0, 1}};
    double sum = 0, e = (double)v->uniform;
    int top = 0;
    *apart = 0;
    while (top >= 0) {
        place p = stack[top--];
        const gsd_node *n = &v->nodes[p.node];
        const float *split = n->inner.split;
        if (n->inner.child == 0) {
            double area = pow(0.25, p.depth), difference;
            difference = fabs((1 - e) * p.share + e * area - (double)n->leaf.pdf * 4 * PI * area);
            *apart = h->root && difference > *apart ? difference : *apart;
            sum += leaf_integral(v, h, &p);
            continue;
        }
        for (uint32_t k = 0; k < 4 && p.depth < 24; ++k) {
            double x = (double)split[0], y = (double)split[1 + (k & 1)];
            double share = p.share * (k & 1 ? 1 - x : x) * (k & 2 ? 1 - y : y);
            stack[++top] = (place){n->inner.child + k, p.x + (k & 1) * (8388608u >> p.depth),
                                   p.y + (k >> 1) * (8388608u >> p.depth), p.depth + 1, share};
        }
    }
    return sum;
}

/* What an alias table gives each leaf against the leaf's density. */
static double alias_apart(const gsd_view *v, const gsd_handle *h)
{
    double apart = 0, e = (double)v->uniform, *share;
    uint32_t low = UINT32_MAX, high = 0, i;
    for (i = 0; i < h->alias_count; ++i) {
        const gsd_alias *a = &v->aliases[h->alias + i];
        low = a->node < low ? a->node : low;
        high = a->node > high ? a->node : high;
    }
    share = calloc(high - low + 1, sizeof *share);
    for (i = 0; i < h->alias_count; ++i) {
        const gsd_alias *a = &v->aliases[h->alias + i];
        share[a->node - low] += (double)a->threshold / h->alias_count;
        if (a->other >= low && a->other <= high)
            share[a->other - low] += (1 - (double)a->threshold) / h->alias_count;
    }
    for (i = low; i <= high; ++i) {
        const gsd_node *n = &v->nodes[i];
        double area = pow(0.25, n->leaf.x >> 24);
        if (n->leaf.child == 0)
            apart = fmax(apart, fabs((1 - e) * share[i - low] + e * area - (double)n->leaf.pdf * 4 * PI * area));
    }
    free(share);
    return apart;
}

static bool close_to(float a, float b) { return fabsf(a - b) <= 2e-6f * b; }

enum { BATCH = 48 };
typedef struct query {
    float position[BATCH][3], normal[BATCH][3], u[BATCH][2], jitter[BATCH][3], out[BATCH][3], pdf[BATCH];
    gsd_handle handle[BATCH];
} query;

static void make_query(stress *s, const gsd_field *f, const gsd_view *v, query *q)
{
    const gsd_desc *d = gsd_get_desc(f);
    for (int i = 0; i < BATCH; ++i) {
        for (int k = 0; k < 3; ++k) {
            float size = d->bounds_max[k] - d->bounds_min[k];
            q->position[i][k] =
                stress_chance(s, 0.05) ? hostile_number(s) : d->bounds_min[k] + size * (1.2f * stress_unitf(s) - 0.1f);
            q->jitter[i][k] = stress_unitf(s);
        }
        any_normal(s, q->normal[i]);
        any_random(s, q->u[i]);
        if (d->forest_cells) {
            q->handle[i] = gsd_find_cell(v, stress_below(s, v->cell_count + 2));
            gsd_orient(v, &q->handle[i], q->normal[i]);
        } else {
            q->handle[i] = gsd_find(v, q->position[i], stress_chance(s, 0.7) ? q->normal[i] : NULL,
                                    stress_chance(s, 0.5) ? q->jitter[i] : NULL);
        }
    }
}

/* Single queries: finite, unit, and the density that gsd_pdf gives. */
static void check_single(stress *s, const gsd_view *v, query *q)
{
    for (int i = 0; i < BATCH; ++i) {
        float *d = q->out[i], odd[3], pdf = gsd_sample(v, &q->handle[i], q->u[i], d), p;
        double length = (double)d[0] * (double)d[0] + (double)d[1] * (double)d[1] + (double)d[2] * (double)d[2];
        q->pdf[i] = pdf;
        STRESS_CHECK(s, q->handle[i].cell < v->cell_count, "no cell %u", q->handle[i].cell);
        STRESS_CHECK(s, isfinite(pdf) && pdf > 0 && fabs(length - 1) < 1e-6, "sample: pdf %g, length %g", (double)pdf,
                     length);
        p = gsd_pdf(v, &q->handle[i], d);
        STRESS_CHECK(s, p == pdf, "pdf of a sample: %.9g, not %.9g", (double)p, (double)pdf);
        unit_direction(s, odd);
        odd[stress_below(s, 3)] = hostile_number(s);
        p = gsd_pdf(v, &q->handle[i], odd);
        STRESS_CHECK(s, isfinite(p) && p > 0, "pdf %g of an odd direction", (double)p);
    }
}

/* Every SIMD level of this machine against single queries; rounding may choose the neighbour once. */
static void check_batches(stress *s, const gsd_view *v, const query *q)
{
    for (int level = GSD_SIMD_SCALAR; level <= GSD_SIMD_NEON; ++level) {
        static float out[BATCH][4], pdf[BATCH], again[BATCH];
        gsd_view at = *v;
        int apart = 0, other = 0;
        if (gsdi_simd((gsd_simd)level) != (gsd_simd)level)
            continue;
        at.simd = (uint32_t)level;
        gsd_sample_batch(&at, BATCH, NULL, q->handle, q->u[0], sizeof q->u[0], out[0], sizeof out[0], pdf);
        gsd_pdf_batch(&at, BATCH, NULL, q->handle, q->out[0], sizeof q->out[0], again);
        for (int i = 0; i < BATCH; ++i) {
            float away = 0;
            for (int k = 0; k < 3; ++k)
                away = fmaxf(away, fabsf(out[i][k] - q->out[i][k]));
            apart += !close_to(pdf[i], q->pdf[i]) || away > 2e-6f;
            other += !close_to(again[i], q->pdf[i]);
        }
        STRESS_CHECK(s, apart <= 1 && other <= 1, "level %d: %d samples and %d densities differ", level, apart, other);
    }
}

static void check_cell(stress *s, const gsd_view *v, const gsd_handle *h)
{
    double apart, sum = integral(v, h, &apart);
    STRESS_CHECK(s, fabs(sum - 1) < 1e-4, "cell %u: pdf integrates to %.9g%s", h->cell, sum,
                 h->product > 0 ? " (oriented)" : "");
    STRESS_CHECK(s, apart < 1e-5, "cell %u: splits and pdf differ by %g", h->cell, apart);
    if (h->alias_count) {
        apart = alias_apart(v, h);
        STRESS_CHECK(s, apart < 1e-5, "cell %u: alias table and pdf differ by %g", h->cell, apart);
    }
}

/* All that holds for any field; a forged save may hold densities that its splits do not give. */
static void check_intact(stress *s, const gsd_field *f, bool forged)
{
    static query q;
    gsd_view v = gsd_get_view(f);
    gsd_stats stats;
    STRESS_CHECK(s, gsd_validate(f) == GSD_OK, "the field does not validate");
    if (s->failed)
        return;
    make_query(s, f, &v, &q);
    check_single(s, &v, &q);
    check_batches(s, &v, &q);
    for (int i = 0; i < 3 && !forged; ++i)
        check_cell(s, &v, &q.handle[stress_below(s, BATCH)]);
    gsd_get_stats(f, &stats);
    STRESS_CHECK(s, gsd_record_fraction(f) > 0 && gsd_record_fraction(f) <= 1, "record fraction");
    STRESS_CHECK(s, stats.cells == gsd_cell_count(f) && stats.max_depth <= gsd_get_desc(f)->max_depth,
                 "stats: %u cells, depth %u", stats.cells, stats.max_depth);
}

/* A fault in a copy of the nodes or of the building part's links, so that the field can be put right again. */
static void check_damaged(stress *s, gsd_field *f)
{
    gsd_node *nodes = gsdi_nodes(f->block);
    uint32_t count = f->block->nodes, kind = stress_below(s, 3);
    gsd_node *keep = malloc(count * sizeof *keep);
    uint32_t child = f->child[0];
    s->deviating = true;
    memcpy(keep, nodes, count * sizeof *keep);
    for (uint32_t i = 0; i < count; ++i)
        if (kind == 0 && nodes[i].leaf.child == 0)
            nodes[i].leaf.pdf *= 1.001f;
        else if (kind == 1 && nodes[i].inner.child)
            nodes[i].inner.split[0] = 0.7f * nodes[i].inner.split[0] + 0.1f;
    f->child[0] = kind == 2 ? 0x7fffffff : child;
    check_intact(s, f, false);
    memcpy(nodes, keep, count * sizeof *keep);
    f->child[0] = child;
    free(keep);
}

static void check_field(stress *s, gsd_field *f)
{
    if (s->sabotage && !s->deviating)
        check_damaged(s, f);
    else
        check_intact(s, f, false);
}

static unsigned char *save_of(stress *s, const gsd_field *f, size_t *size)
{
    size_t bound = gsd_save_bound(f);
    unsigned char *data = malloc(bound);
    STRESS_CHECK(s, gsd_save(f, data, bound, size) == GSD_OK && *size <= bound, "save");
    return data;
}

static bool same_save(stress *s, const gsd_field *f, const unsigned char *data, size_t size)
{
    size_t now;
    unsigned char *other = save_of(s, f, &now);
    bool same = now == size && memcmp(data, other, size) == 0;
    free(other);
    return same;
}

/* ---- descriptors and samples */

static gsd_desc any_desc(stress *s)
{
    gsd_desc d;
    memset(&d, 0, sizeof d);
    for (int k = 0; k < 3; ++k)
        d.bounds_max[k] = 1;
    d.target = (gsd_target)stress_below(s, 5);
    d.spatial_filter = (gsd_spatial_filter)stress_below(s, 3);
    d.directional_filter = (gsd_directional_filter)stress_below(s, 3);
    d.alpha_mode = (gsd_alpha_mode)stress_below(s, 4);
    d.alias = stress_chance(s, 0.3);
    d.no_gate = stress_chance(s, 0.5);
    d.no_history = stress_chance(s, 0.2);
    d.no_guide_weight = stress_chance(s, 0.2);
    d.split_samples = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 16, 5000);
    d.rho = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 1e-4, 1);
    d.max_depth = stress_below(s, 21);
    d.max_levels = stress_below(s, 61);
    d.min_samples = stress_below(s, 40);
    d.switch_after = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 0.001, 10);
    d.uniform = stress_chance(s, 0.7) ? 0 : (float)stress_log(s, 1e-4, 1);
    d.smoothing = stress_chance(s, 0.7) ? 0 : (float)stress_log(s, 0.001, 1000);
    d.denoise = (gsd_denoise_mode)stress_below(s, 4);
    d.gaussian_sigma = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 0.1, 100);
    d.gaussian_rho = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 1e-5, 1);
    d.gaussian_sphere = stress_chance(s, 0.5);
    d.gaussian_no_limit = stress_chance(s, 0.2);
    d.denoise_budget = stress_chance(s, 0.7) ? 0 : (float)stress_log(s, 0.001, 1e6);
    d.alpha = stress_chance(s, 0.7) ? 0 : 0.05f + 0.95f * stress_unitf(s);
    d.max_bytes = (uint64_t)1 << (20 + stress_below(s, 6));
    d.forest_cells = stress_chance(s, 0.2) ? 1 + stress_below(s, 20) : 0;
    return d;
}

/* Whether a sample is bad, by the words of the header's ERRORS; its direction shows as pdf_mix = 0. */
static bool bad_sample(const gsd_training_sample *t, bool forest)
{
    for (int k = 0; k < 3 && !forest; ++k)
        if (!isfinite(t->position[k]))
            return true;
    return bad_value(t->radiance) || bad_value(t->contribution) || bad_value(t->pixel_contribution) ||
           !(t->pdf_mix > 0) || !isfinite(t->pdf_mix) || !(t->pdf_bsdf >= 0) || !isfinite(t->pdf_bsdf) ||
           !(t->pdf_guide >= 0) || !isfinite(t->pdf_guide) || !(t->nearness >= 0) || !isfinite(t->nearness) ||
           (double)t->radiance >= 9.9e29 * (double)t->pdf_mix;
}

/* n samples; returns how many of them are bad. */
static uint32_t make_samples(stress *s, const recipe *r, const gsd_desc *d, gsd_training_sample *t, uint32_t n)
{
    uint32_t bad = 0;
    for (uint32_t i = 0; i < n; ++i) {
        float p[3], dir[3], normal[3], value, contribution, pixel;
        any_position(s, r, d->bounds_min, d->bounds_max, p);
        any_direction(s, r, dir);
        any_normal(s, normal);
        value = any_value(s, r, dir);
        contribution = r->value == 4 ? any_value(s, r, dir) : value;
        pixel = r->value == 4 ? any_value(s, r, dir) : value;
        t[i] = gsd_make_scalar_sample(p, dir, stress_chance(s, 0.5) ? normal : NULL, any_distance(s, r->pdf == 2),
                                      value, contribution, pixel, any_pdf(s, r), any_pdf(s, r),
                                      stress_chance(s, 0.5) ? 0 : any_pdf(s, r));
        bad += bad_sample(&t[i], d->forest_cells > 0);
    }
    return bad;
}

static gsd_training_sample batch[MOST];
static uint32_t batch_cells[MOST];

static gsd_result record(stress *s, gsd_stream *stream, const gsd_field *f, uint32_t n)
{
    if (!gsd_get_desc(f)->forest_cells)
        return gsd_record(stream, batch, n);
    for (uint32_t i = 0; i < n; ++i)
        batch_cells[i] = stress_below(s, gsd_cell_count(f));
    return gsd_record_cells(stream, batch_cells, batch, n);
}

/* One pass over a batch of n samples; without memory trouble nothing may fail. */
static void learn(stress *s, gsd_field *f, gsd_stream *stream, uint32_t n)
{
    gsd_pass pass = {.pixel_estimate = stress_chance(s, 0.5), .denoise = (gsd_denoise_mode)stress_below(s, 4)};
    STRESS_CHECK(s, record(s, stream, f, n) == GSD_OK, "record");
    STRESS_CHECK(s, gsd_accumulate(f, &stream, 1, NULL, NULL) == GSD_OK, "accumulate");
    gsd_stream_clear(stream);
    STRESS_CHECK(s, gsd_refine(f, stress_chance(s, 0.5) ? &pass : NULL, NULL, NULL) == GSD_OK, "refine");
}

/* A field and a stream, or the loss of the try. */
static gsd_field *new_field(stress *s, const gsd_desc *d, gsd_stream **stream)
{
    gsd_field *f = NULL;
    gsd_result result = gsd_create(d, &f);
    *stream = NULL;
    if (STRESS_CHECK(s, result == GSD_OK, "create: %s", gsd_result_string(result)))
        STRESS_CHECK(s, gsd_stream_create(f, stream) == GSD_OK, "stream_create");
    return f;
}

static void end_field(gsd_field *f, gsd_stream *stream)
{
    gsd_stream_destroy(stream);
    gsd_destroy(f);
}

/* ---- groups: samples */

/* Samples of all kinds for some passes; exactly the bad ones are refused. */
static void hostile_samples(stress *s)
{
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    gsd_field *f = new_field(s, &d, &stream);
    uint64_t bad = 0, all = 0;
    gsd_stats stats;
    for (uint32_t pass = 0; !s->failed && pass < 1 + stress_below(s, 5); ++pass) {
        recipe r = any_recipe(s, true);
        uint32_t n = some(s, 10000);
        bad += make_samples(s, &r, gsd_get_desc(f), batch, n);
        all += n;
        learn(s, f, stream, n);
    }
    if (s->sabotage && stress_chance(s, 0.3))
        s->deviating = ++bad;
    if (!s->failed) {
        gsd_get_stats(f, &stats);
        STRESS_CHECK(s, stats.refused == bad && stats.samples == all - bad, "%llu of %llu refused, %llu are bad",
                     (unsigned long long)stats.refused, (unsigned long long)all, (unsigned long long)bad);
        check_field(s, f);
    }
    end_field(f, stream);
    stress_end(s, bad == all);
}

/* Radiance and density over sixty powers of ten. */
static void contrast(stress *s)
{
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    gsd_field *f = new_field(s, &d, &stream);
    for (uint32_t pass = 0; !s->failed && pass < 6; ++pass) {
        recipe r = any_recipe(s, false);
        uint32_t n = some(s, 8000);
        r.value = 1;
        r.pdf = (int)stress_below(s, 2);
        make_samples(s, &r, gsd_get_desc(f), batch, n);
        learn(s, f, stream, n);
    }
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* All light from one direction: the tree goes down to depth 20 there and samples follow. */
static void hot_leaf(stress *s)
{
    gsd_desc d = {.bounds_max = {1, 1, 1}, .target = (gsd_target)stress_below(s, 5), .max_depth = 20, .min_samples = 1};
    gsd_stream *stream;
    gsd_field *f;
    recipe r = any_recipe(s, false);
    float bright = (float)stress_log(s, 1e-3, 1e10);
    uint32_t hits = 0, depth = 0;
    /* Second moments weigh a leaf by the root of its solid angle: what is left of older, wider sums still counts. */
    float near_light = d.target == GSD_TARGET_RADIANCE ? 0.999f : 0.99f;
    d.no_gate = d.no_guide_weight = true;
    d.smoothing = 0.001f;
    d.directional_filter = GSD_DIRECTIONAL_NEAREST;
    d.alias = stress_chance(s, 0.5);
    f = new_field(s, &d, &stream);
    r.direction = r.value = 0;
    for (uint32_t pass = 0; !s->failed && depth < 20 && pass < 60; ++pass) {
        gsd_stats stats;
        make_samples(s, &r, gsd_get_desc(f), batch, 400);
        for (uint32_t i = 0; i < 400; ++i)
            batch[i] =
                gsd_make_scalar_sample(batch[i].position, r.lamp, NULL, INFINITY, bright, bright, bright, 1, 1, 0);
        learn(s, f, stream, 400);
        gsd_get_stats(f, &stats);
        depth = stats.max_depth;
    }
    if (!s->failed) {
        gsd_view v = gsd_get_view(f);
        STRESS_CHECK(s, depth == 20, "depth %u", depth);
        for (int i = 0; i < 100; ++i) {
            float u[2] = {stress_unitf(s), stress_unitf(s)}, out[3];
            gsd_handle h = gsd_find(&v, batch[i].position, NULL, NULL);
            gsd_sample(&v, &h, u, out);
            hits += out[0] * r.lamp[0] + out[1] * r.lamp[1] + out[2] * r.lamp[2] > near_light;
        }
        STRESS_CHECK(s, hits > 80, "only %u of 100 samples find the light", hits);
        check_field(s, f);
    }
    end_field(f, stream);
    stress_survived(s);
}

/* Nothing but zeros: the density stays uniform. */
static void all_zeros(stress *s)
{
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    gsd_field *f = new_field(s, &d, &stream);
    float fault = s->sabotage && stress_chance(s, 0.5) ? 1e-3f : 0;
    s->deviating = fault > 0;
    for (uint32_t pass = 0; !s->failed && pass < 4; ++pass) {
        recipe r = any_recipe(s, false);
        uint32_t n = some(s, 5000);
        r.value = 3;
        make_samples(s, &r, gsd_get_desc(f), batch, n);
        learn(s, f, stream, n);
    }
    for (int i = 0; !s->failed && i < 100; ++i) {
        gsd_view v = gsd_get_view(f);
        gsd_handle h = gsd_find_cell(&v, stress_below(s, v.cell_count));
        float n[3], pdf;
        any_normal(s, n);
        gsd_orient(&v, &h, n);
        unit_direction(s, n);
        pdf = gsd_pdf(&v, &h, n);
        STRESS_CHECK(s, fabsf(pdf - GSD_INV_4PI + fault) < 1e-6f, "pdf %g after nothing but zeros", (double)pdf);
    }
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* ---- groups: descriptors, memory */

/* As gsd_desc documents them. */
#define LIMIT(name, whole, low, high) STRESS_LIMIT(gsd_desc, name, whole, low, high)
static const stress_limit limits[] = {
    LIMIT(switch_after, false, 0.001, 1e6),
    LIMIT(split_samples, false, 16, 1e9),
    LIMIT(rho, false, 1e-5, 1),
    LIMIT(max_depth, true, 1, 20),
    LIMIT(max_levels, true, 1, 60),
    LIMIT(alpha, false, 0.05, 1),
    LIMIT(uniform, false, 1e-4, 1),
    LIMIT(smoothing, false, 1e-3, 1000),
    LIMIT(denoise_budget, false, 1e-3, 1e6),
    LIMIT(gaussian_sigma, false, 0.1, 100),
    LIMIT(gaussian_rho, false, 1e-5, 1),
    LIMIT(gate_margin, false, 0.001, 10),
    LIMIT(gate_gain, false, 1e-4, 1000),
    LIMIT(gate_probe, true, 1, 1000),
};

/* Options at and beyond their limits: refused or a field that learns. */
static void descriptors(stress *s)
{
    gsd_desc d = any_desc(s);
    double extent;
    bool bad = false;
    gsd_field *f = NULL;
    gsd_stream *stream = NULL;
    gsd_result result;
    if (stress_chance(s, 0.7))
        bad = set_extreme(s, &d, limits, sizeof limits / sizeof *limits);
    if (stress_chance(s, 0.6))
        bad =
            (!set_bounds(s, d.bounds_min, d.bounds_max, &extent) || !(extent > 1e-30)) && !d.forest_cells ? true : bad;
    d.alpha_mode = stress_chance(s, 0.02) ? (gsd_alpha_mode)77 : d.alpha_mode;
    d.max_bytes = stress_chance(s, 0.05) ? (1u << 20) - 1 : d.max_bytes;
    bad = bad || d.alpha_mode > GSD_ALPHA_GRID || d.max_bytes < 1u << 20;
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, bad = !bad;
    result = gsd_create(&d, &f);
    STRESS_CHECK(s, (result != GSD_OK) == bad && (result == GSD_OK) == (f != NULL), "%s, should be %s",
                 gsd_result_string(result), bad ? "refused" : "accepted");
    if (result == GSD_OK && !s->failed) {
        gsd_stream_create(f, &stream);
        for (int pass = 0; pass < 3 && !s->failed; ++pass) {
            recipe r = any_recipe(s, false);
            uint32_t n = some(s, 4000);
            make_samples(s, &r, gsd_get_desc(f), batch, n);
            learn(s, f, stream, n);
        }
        check_field(s, f);
    }
    end_field(f, stream);
    stress_end(s, result != GSD_OK);
}

/* The smallest caps and many samples: neither what the field says nor what the allocator sees goes beyond. */
static void memory_cap(stress *s)
{
    gsd_desc d = any_desc(s);
    stress_memory memory = {0};
    gsd_stream *stream;
    gsd_field *f;
    d.forest_cells = 0;
    d.max_bytes = (1u << 20) + (stress_chance(s, 0.7) ? 0 : stress_below(s, 1u << 21));
    d.max_depth = 12 + stress_below(s, 9);
    d.max_levels = 0;
    d.split_samples = 16;
    d.min_samples = 1;
    d.rho = (float)stress_log(s, 1e-5, 1e-3);
    d.allocate = stress_allocate;
    d.release = stress_release;
    d.user = &memory;
    f = new_field(s, &d, &stream);
    gsd_stream_destroy(stream); /* streams and scratch are outside the cap */
    for (int pass = 0; !s->failed && pass < 4; ++pass) {
        recipe r = any_recipe(s, false);
        gsd_stats stats;
        uint32_t n = MOST;
        make_samples(s, &r, gsd_get_desc(f), batch, n);
        STRESS_CHECK(s, gsd_stream_create(f, &stream) == GSD_OK && gsd_record(stream, batch, n) == GSD_OK, "record");
        STRESS_CHECK(s, gsd_accumulate(f, &stream, 1, NULL, NULL) == GSD_OK, "accumulate");
        gsd_stream_destroy(stream);
        gsdi_release(&f->desc, f->scratch);
        f->scratch = NULL;
        f->scratch_size = 0;
        memory.peak = memory.bytes;
        STRESS_CHECK(s, gsd_refine(f, NULL, NULL, NULL) == GSD_OK, "refine");
        gsd_get_stats(f, &stats);
        if (s->sabotage && stress_chance(s, 0.3))
            s->deviating = true, stats.peak_bytes = d.max_bytes + 1;
        STRESS_CHECK(s, stats.peak_bytes <= d.max_bytes && memory.peak <= d.max_bytes,
                     "peak %llu, the allocator saw %zu, cap %llu", (unsigned long long)stats.peak_bytes, memory.peak,
                     (unsigned long long)d.max_bytes);
    }
    if (!s->failed)
        check_field(s, f);
    gsd_destroy(f);
    STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
    stress_survived(s);
}

/* ---- groups: sequences of calls */

enum { FIELDS = 3 };

/* Fields, their streams, and how many samples each field must have heard of. */
typedef struct world {
    gsd_desc desc;
    stress_memory memory;
    gsd_field *field[FIELDS];
    gsd_stream *stream[FIELDS];
    uint64_t waiting[FIELDS], told[FIELDS]; /* recorded since the stream was cleared; given to accumulate */
    bool failing;
    long refused;
} world;

/* Before and after a call that may fail for want of memory: then the field must be as before. */
typedef struct snapshot {
    unsigned char *data;
    size_t size;
} snapshot;

/* Sums of inner nodes follow from those of the leaves; refine may have written them or not. */
static void settle(gsd_field *f)
{
    for (uint32_t i = 0; i < f->building_nodes; ++i)
        if (f->child[i])
            memset(&f->sum[i], 0, sizeof f->sum[i]);
}

static snapshot look(stress *s, const world *w, int i)
{
    snapshot shot = {NULL, 0};
    if (w->failing)
        settle(w->field[i]);
    if (w->failing)
        shot.data = save_of(s, w->field[i], &shot.size);
    return shot;
}

static void compare(stress *s, world *w, int i, snapshot shot, gsd_result result, const char *call)
{
    STRESS_CHECK(s, result == GSD_OK || (w->failing && result == GSD_OUT_OF_MEMORY), "%s: %s", call,
                 gsd_result_string(result));
    w->refused += result != GSD_OK;
    if (result && shot.data) {
        settle(w->field[i]);
        STRESS_CHECK(s, same_save(s, w->field[i], shot.data, shot.size), "%s failed and changed the field", call);
    }
    free(shot.data);
}

static void do_create(stress *s, world *w, int i)
{
    gsd_result result;
    end_field(w->field[i], w->stream[i]);
    w->stream[i] = NULL;
    w->waiting[i] = w->told[i] = 0;
    result = gsd_create(&w->desc, &w->field[i]);
    STRESS_CHECK(s, (result == GSD_OK) == (w->field[i] != NULL) && (result == GSD_OK || w->failing), "create: %s",
                 gsd_result_string(result));
    if (result == GSD_OK)
        result = gsd_stream_create(w->field[i], &w->stream[i]);
    w->refused += result != GSD_OK;
}

static void do_record(stress *s, world *w, int i)
{
    recipe r = any_recipe(s, stress_chance(s, 0.3));
    uint32_t n = some(s, 3000);
    gsd_result result;
    if (!w->stream[i])
        return;
    make_samples(s, &r, gsd_get_desc(w->field[i]), batch, n);
    result = record(s, w->stream[i], w->field[i], n);
    STRESS_CHECK(s, result == GSD_OK || w->failing, "record: %s", gsd_result_string(result));
    w->refused += result != GSD_OK;
    w->waiting[i] += n;
}

static void do_accumulate(stress *s, world *w, int i)
{
    gsd_result result;
    if (!w->stream[i])
        return;
    result = gsd_accumulate(w->field[i], &w->stream[i], 1, NULL, NULL);
    STRESS_CHECK(s, result == GSD_OK || (w->failing && result == GSD_OUT_OF_MEMORY), "accumulate: %s",
                 gsd_result_string(result));
    w->refused += result != GSD_OK;
    gsd_stream_clear(w->stream[i]);
    w->told[i] += w->waiting[i];
    w->waiting[i] = 0;
}

static void do_refine(stress *s, world *w, int i)
{
    snapshot shot = look(s, w, i);
    compare(s, w, i, shot, gsd_refine(w->field[i], NULL, NULL, NULL), "refine");
}

/* Another field becomes a copy of this one, through a save. */
static void do_copy(stress *s, world *w, int i)
{
    int to = (i + 1 + (int)stress_below(s, FIELDS - 1)) % FIELDS;
    size_t size;
    unsigned char *data = save_of(s, w->field[i], &size);
    gsd_field *copy;
    gsd_result result = gsd_load(&w->desc, data, size, &copy);
    STRESS_CHECK(s, (result == GSD_OK) == (copy != NULL) && (!result || (w->failing && result == GSD_OUT_OF_MEMORY)),
                 "load: %s", gsd_result_string(result));
    w->refused += result != GSD_OK;
    if (copy) {
        STRESS_CHECK(s, same_save(s, copy, data, size), "a save of what was loaded differs");
        end_field(w->field[to], w->stream[to]);
        w->field[to] = copy;
        w->told[to] = w->told[i];
        w->waiting[to] = 0;
        w->refused += gsd_stream_create(copy, &w->stream[to]) != GSD_OK;
    }
    free(data);
}

/* Copies of one ancestor merge, all others are refused. */
static void do_merge(stress *s, world *w, int i)
{
    int from = (i + 1 + (int)stress_below(s, FIELDS - 1)) % FIELDS;
    bool match, same;
    size_t size, other_size;
    unsigned char *data, *other;
    gsd_result result;
    if (!w->field[from])
        return;
    match = gsd_structure_id(w->field[i]) == gsd_structure_id(w->field[from]);
    data = save_of(s, w->field[i], &size);
    other = save_of(s, w->field[from], &other_size);
    result = gsd_merge(w->field[i], w->field[from]);
    same = same_save(s, w->field[i], data, size);
    STRESS_CHECK(s, result == GSD_OK || (result == GSD_MISMATCH && same), "merge: %s", gsd_result_string(result));
    STRESS_CHECK(s, match || result, "fields of different structure were merged");
    STRESS_CHECK(s, same_save(s, w->field[from], other, other_size), "merge changed its source");
    w->told[i] += result ? 0 : w->told[from];
    free(data);
    free(other);
}

/* A random tree: count inner nodes at most, preferring deep ones. */
static gsd_tree any_tree(stress *s, uint32_t cell, uint32_t inner, uint32_t max_depth)
{
    gsd_tree t = {cell, 1, calloc(inner * 4, sizeof(uint32_t)), calloc(inner * 4, sizeof(float))};
    uint32_t *depth = calloc(inner, sizeof *depth), tries;
    double low = stress_chance(s, 0.3) ? 1e-30 : 1, zeros = stress_unit(s), deep = stress_unit(s);
    for (uint32_t i = 0; i < inner * 4; ++i)
        t.value[i] = stress_chance(s, 0.9 * zeros) ? 0 : (float)stress_log(s, low, low < 1 ? 9e29 : 1000);
    for (tries = 0; t.count < inner && tries < inner * 50; ++tries) {
        uint32_t parent = stress_chance(s, deep) ? t.count - 1 : stress_below(s, t.count), k = stress_below(s, 4);
        if (depth[parent] + 2 > max_depth || t.child[parent * 4 + k])
            continue;
        t.child[parent * 4 + k] = t.count;
        depth[t.count++] = depth[parent] + 1;
    }
    free(depth);
    return t;
}

static void free_tree(gsd_tree *t)
{
    free(t->child);
    free(t->value);
}

static void do_import(stress *s, world *w, int i)
{
    gsd_tree t =
        any_tree(s, stress_below(s, gsd_cell_count(w->field[i])), some(s, 300), gsd_get_desc(w->field[i])->max_depth);
    snapshot shot = look(s, w, i);
    compare(s, w, i, shot, gsd_import_trees(w->field[i], &t, 1), "import");
    free_tree(&t);
}

static void do_split(stress *s, world *w, int i)
{
    uint32_t cells = gsd_cell_count(w->field[i]), parent = stress_below(s, cells + 1);
    uint32_t a = stress_below(s, cells + 3), b = stress_below(s, cells + 3);
    snapshot shot = look(s, w, i);
    gsd_result result = gsd_forest_split(w->field[i], parent, a, b);
    gsd_result expected = !w->desc.forest_cells ? GSD_NOT_A_FOREST : parent >= cells || a == b ? GSD_BAD_CELL : GSD_OK;
    if (expected) {
        STRESS_CHECK(s, result == expected, "forest_split: %s", gsd_result_string(result));
        result = GSD_OK;
    }
    compare(s, w, i, shot, result, "forest_split");
}

static void do_something(stress *s, world *w, int i)
{
    static void (*const calls[])(stress *, world *, int) = {
        do_record, do_record, do_record, do_accumulate, do_accumulate, do_accumulate, do_refine,
        do_refine, do_copy,   do_merge,  do_merge,      do_import,     do_split,
    };
    if (!w->field[i] || stress_chance(s, 0.03))
        do_create(s, w, i);
    else
        calls[stress_below(s, sizeof calls / sizeof *calls)](s, w, i);
    if (w->field[i])
        STRESS_CHECK(s, gsd_validate(w->field[i]) == GSD_OK, "the field does not validate");
}

/* Every sample is accepted, refused or lost; nothing leaks. */
static void end_world(stress *s, world *w)
{
    uint64_t fault = s->sabotage && stress_chance(s, 0.5);
    s->deviating = s->deviating || fault;
    w->memory.fail_at = w->memory.fail_every = 0;
    for (int i = 0; i < FIELDS; ++i) {
        if (w->field[i] && !s->failed) {
            gsd_stats stats;
            gsd_get_stats(w->field[i], &stats);
            STRESS_CHECK(s, stats.samples + stats.refused + stats.lost == w->told[i] + fault,
                         "%llu accepted, %llu refused, %llu lost of %llu", (unsigned long long)stats.samples,
                         (unsigned long long)stats.refused, (unsigned long long)stats.lost,
                         (unsigned long long)w->told[i]);
            check_field(s, w->field[i]);
        }
        end_field(w->field[i], w->stream[i]);
    }
    STRESS_CHECK(s, w->memory.live == 0, "%ld leaks", w->memory.live);
}

static world new_world(stress *s)
{
    world w;
    memset(&w, 0, sizeof w);
    w.desc = any_desc(s);
    w.desc.allocate = stress_allocate;
    w.desc.release = stress_release;
    return w;
}

static void sequences(stress *s)
{
    world w = new_world(s);
    w.desc.user = &w.memory;
    for (uint32_t n = 10 + stress_below(s, 30); n > 0 && !s->failed; --n)
        do_something(s, &w, (int)stress_below(s, FIELDS));
    end_world(s, &w);
    stress_survived(s);
}

/* A sequence again and again, with the first, second, ... request failing, or each k-th. */
static void failing_allocator(stress *s)
{
    uint64_t start = s->rng;
    bool every = stress_chance(s, 0.5);
    long requests = 1000, k = 0;
    for (long pass = 0; pass < 25; ++pass) {
        world w;
        s->rng = start;
        w = new_world(s);
        w.desc.user = &w.memory;
        w.desc.max_bytes = 1 << 20;
        w.failing = true;
        k = pass == 0 ? 0 : every ? 1 + pass : 1 + (pass * 7919) % requests;
        *(every ? &w.memory.fail_every : &w.memory.fail_at) = k;
        for (uint32_t n = 8 + stress_below(s, 12); n > 0 && !s->failed; --n)
            do_something(s, &w, (int)stress_below(s, FIELDS));
        requests = pass == 0 ? w.memory.requests : requests;
        if (pass == 0)
            STRESS_CHECK(s, w.refused == 0, "a call failed without cause");
        else
            STRESS_CHECK(s, w.memory.failed == 0 || w.refused > 0, "a failed request was not reported");
        end_world(s, &w);
        stress_end(s, w.memory.failed > 0);
    }
}

/* ---- groups: saves */

/* Make size and checksum right again, so that what follows them is looked at. */
static void seal(unsigned char *data, size_t size)
{
    gsdi_file f;
    if (size < sizeof f)
        return;
    memcpy(&f, data, sizeof f);
    f.size = size;
    f.checksum = gsdi_file_checksum(&f, data + sizeof f, size - sizeof f);
    memcpy(data, &f, sizeof f);
}

static unsigned char *trained_save(stress *s, size_t *size)
{
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    unsigned char *data;
    gsd_field *f;
    d.rho = 0.05f;
    d.forest_cells %= 5;
    f = new_field(s, &d, &stream);
    for (int pass = 0; pass < 2; ++pass) {
        recipe r = any_recipe(s, false);
        make_samples(s, &r, gsd_get_desc(f), batch, 500);
        learn(s, f, stream, 500);
    }
    data = save_of(s, f, size);
    end_field(f, stream);
    return data;
}

/* A forged save: no field, or one that is whole and can go on. */
static void try_save(stress *s, const unsigned char *data, size_t size, bool sealed, const char *how)
{
    stress_memory memory = {0};
    gsd_desc d = {.allocate = stress_allocate, .release = stress_release, .user = &memory};
    unsigned char *exact = malloc(size ? size : 1); /* so that a sanitizer sees every byte beyond */
    gsd_field *f;
    gsd_result result;
    memcpy(exact, data, size);
    result = gsd_load(&d, exact, size, &f);
    free(exact);
    STRESS_CHECK(s, (result == GSD_OK) == (f != NULL), "%s: %s, yet %s", how, gsd_result_string(result),
                 f ? "a field" : "none");
    STRESS_CHECK(s, result == GSD_OK || result == GSD_BAD_FILE || result == GSD_BAD_VERSION || sealed, "%s: %s", how,
                 gsd_result_string(result));
    if (f) {
        gsd_stream *stream = NULL;
        if (s->sabotage)
            check_field(s, f);
        else
            check_intact(s, f, how[0] != 'u');
        STRESS_CHECK(s, gsd_stream_create(f, &stream) == GSD_OK, "stream_create");
        for (int pass = 0; pass < 2 && !s->failed; ++pass) {
            recipe r = any_recipe(s, true);
            make_samples(s, &r, gsd_get_desc(f), batch, 100);
            STRESS_CHECK(s, record(s, stream, f, 100) == GSD_OK, "record");
            STRESS_CHECK(s, gsd_accumulate(f, &stream, 1, NULL, NULL) == GSD_OK, "accumulate");
            gsd_stream_clear(stream);
            result = gsd_refine(f, NULL, NULL, NULL);
            STRESS_CHECK(s, result == GSD_OK, "%s: refine: %s", how, gsd_result_string(result));
            check_intact(s, f, true);
        }
        end_field(f, stream);
    }
    STRESS_CHECK(s, memory.live == 0, "%s: %ld leaks", how, memory.live);
    stress_end(s, f == NULL);
}

static void forged_saves(stress *s)
{
    size_t size, other_size;
    unsigned char *data = trained_save(s, &size), *other = trained_save(s, &other_size), *forged = malloc(size);
    try_save(s, data, size, false, "untouched");
    for (int i = 0; i < 40; ++i) {
        size_t n = size;
        bool sealed = stress_chance(s, 0.7);
        const char *how = "";
        memcpy(forged, data, size);
        for (uint32_t k = 1 + stress_below(s, 3); k > 0 && n > 0; --k)
            how = forge(s, forged, &n, other, other_size);
        if (sealed)
            seal(forged, n);
        try_save(s, forged, n, sealed, how);
    }
    free(data);
    free(other);
    free(forged);
}

/* ---- groups: trees, queries, threads */

/* Whether a tree keeps to what gsd_tree documents, by walking it. */
static bool tree_is_good(const gsd_tree *t, uint32_t cells, uint32_t max_depth)
{
    unsigned char *depth;
    uint32_t reached = 1, i, k;
    bool good = t->cell < cells && t->count > 0;
    depth = calloc(t->count + 1, 1);
    for (i = 0; good && i < t->count; ++i)
        for (k = 0; good && k < 4; ++k) {
            uint32_t c = t->child[i * 4 + k];
            if (c == 0) {
                good = t->value[i * 4 + k] >= 0 && t->value[i * 4 + k] < 1e30f;
                continue;
            }
            good = c > i && c < t->count && depth[c] == 0 && depth[i] + 2u <= max_depth;
            reached++;
            if (good)
                depth[c] = (unsigned char)(depth[i] + 1);
        }
    free(depth);
    return good && reached == t->count;
}

static void spoil_tree(stress *s, gsd_tree *t, uint32_t cells)
{
    uint32_t at = stress_below(s, t->count * 4);
    switch (stress_below(s, 4)) {
    case 0:
        t->child[at] = stress_chance(s, 0.5) ? stress_below(s, t->count + 2) : (uint32_t)stress_next(s);
        break;
    case 1:
        t->value[at] = hostile_number(s);
        break;
    case 2:
        t->cell = stress_chance(s, 0.5) ? cells : (uint32_t)stress_next(s);
        break;
    case 3:
        t->count = stress_below(s, t->count);
        break;
    }
}

/* The same children and shares, whatever the order of the inner nodes. */
static void check_same_tree(stress *s, const gsd_tree *in, const gsd_tree *out, double total)
{
    uint32_t stack[128][2] = {{0, 0}}, top = 1;
    STRESS_CHECK(s, out->count == in->count, "%u inner nodes became %u", in->count, out->count);
    while (top && !s->failed) {
        uint32_t a = stack[--top][0], b = stack[top][1];
        for (uint32_t k = 0; k < 4 && !s->failed; ++k) {
            uint32_t i = in->child[a * 4 + k], o = out->child[b * 4 + k];
            double wanted = (double)in->value[a * 4 + k] / total, got = (double)out->value[b * 4 + k];
            if (!STRESS_CHECK(s, !i == !o, "a child became a leaf or a leaf a child"))
                break;
            if (i) {
                stack[top][0] = i;
                stack[top++][1] = o;
            } else {
                STRESS_CHECK(s, fabs(got - wanted) < 1e-5, "share %g came out as %g", wanted, got);
            }
        }
    }
}

/* What comes out is what went in, as shares. */
static void check_export(stress *s, const gsd_field *f, const gsd_tree *in)
{
    uint32_t count = gsd_export_bound(f, GSD_PART_SAMPLING, in->cell);
    gsd_tree out = {in->cell, count, calloc(count * 4, sizeof(uint32_t)), calloc(count * 4, sizeof(float))};
    double total = 0, back = 0;
    uint32_t i;
    for (i = 0; i < in->count * 4; ++i)
        total += in->child[i] ? 0 : (double)in->value[i];
    STRESS_CHECK(s, gsd_export_tree(f, GSD_PART_SAMPLING, &out) == GSD_OK, "export");
    for (i = 0; i < out.count * 4; ++i)
        back += out.child[i] ? 0 : (double)out.value[i];
    STRESS_CHECK(s, fabs(back - 1) < 1e-4, "exported shares sum to %g", back);
    if (total > 0)
        check_same_tree(s, in, &out, total);
    free_tree(&out);
}

static void imported_trees(stress *s)
{
    enum { TREES = 4 };
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    gsd_field *f;
    gsd_tree trees[TREES];
    size_t size;
    unsigned char *before;
    bool good = true;
    gsd_result result;
    d.forest_cells = TREES + stress_below(s, 3);
    d.max_depth = 1 + stress_below(s, 20);
    f = new_field(s, &d, &stream);
    for (uint32_t i = 0; i < TREES; ++i)
        trees[i] = any_tree(s, i, some(s, 500), stress_chance(s, 0.9) ? d.max_depth : 22);
    if (stress_chance(s, 0.5))
        spoil_tree(s, &trees[stress_below(s, TREES)], d.forest_cells);
    if (stress_chance(s, 0.1))
        trees[1].cell = trees[3].cell;
    for (int i = 0; i < TREES; ++i) {
        good = good && tree_is_good(&trees[i], d.forest_cells, d.max_depth);
        for (int j = 0; j < i; ++j)
            good = good && trees[i].cell != trees[j].cell;
    }
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, good = !good;
    before = save_of(s, f, &size);
    result = gsd_import_trees(f, trees, TREES);
    STRESS_CHECK(s, good == (result == GSD_OK), "import: %s, should be %s", gsd_result_string(result),
                 good ? "accepted" : "refused");
    STRESS_CHECK(s, result == GSD_OK || same_save(s, f, before, size), "a refused import changed the field");
    for (int i = 0; i < TREES && !result && !s->failed; ++i)
        check_export(s, f, &trees[i]);
    check_field(s, f);
    for (int i = 0; i < TREES; ++i)
        free_tree(&trees[i]);
    free(before);
    end_field(f, stream);
    stress_end(s, result != GSD_OK);
}

/* Many queries of all kinds on deep random trees. */
static void queries(stress *s)
{
    gsd_desc d = any_desc(s);
    gsd_stream *stream;
    gsd_field *f;
    gsd_tree t;
    d.forest_cells = 0;
    d.max_depth = 1 + stress_below(s, 20);
    f = new_field(s, &d, &stream);
    t = any_tree(s, 0, some(s, 2000), d.max_depth);
    STRESS_CHECK(s, gsd_import_trees(f, &t, 1) == GSD_OK, "import");
    free_tree(&t);
    for (int i = 0; i < 10 && !s->failed; ++i)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* ---- group: denoising of hostile building trees */

/* Give the field's first `count` cells these trees as building trees, as if samples had made them. */
static void plant_trees(stress *s, gsd_field *f, const gsd_tree *trees, uint32_t count)
{
    uint32_t more = 0;
    for (uint32_t c = 0; c < count; ++c)
        more += 4 * trees[c].count + 1;
    uint32_t nodes = more_building_nodes(f, more), *child = f->child;
    gsdi_sum *sum = f->sum;
    for (uint32_t c = 0; c < count; ++c) { /* children of inner node i are 4 i + 1 .. 4 i + 4 */
        const gsd_tree *t = &trees[c];
        gsdi_state *state = &f->states[c];
        double share = stress_chance(s, 0.2) ? 0 : stress_unit(s);
        state->first = nodes;
        state->count = 4 * t->count + 1;
        state->held = state->fresh = state->lit = stress_log(s, 1, 1e9);
        child[nodes++] = 1;
        for (uint32_t k = 0; k < 4 * t->count; ++k, ++nodes) {
            child[nodes] = t->child[k] ? 4 * t->child[k] + 1 : 0;
            sum[nodes].half[0] = t->child[k] ? 0 : share * (double)t->value[k];
            sum[nodes].half[1] = t->child[k] ? 0 : (1 - share) * (double)t->value[k];
        }
    }
    gsdi_field_changed(f);
}

/* Any tree, often with extreme values: one hot leaf, all alike, all zero. */
static gsd_tree hostile_tree(stress *s, uint32_t cell, uint32_t max_depth)
{
    gsd_tree t = any_tree(s, cell, some(s, 1500), max_depth);
    uint32_t kind = stress_below(s, 6), hot = stress_below(s, 4 * t.count);
    for (uint32_t k = 0; kind < 3 && k < 4 * t.count; ++k)
        t.value[k] = kind == 0 ? (k == hot ? 9e29f : 0) : kind == 1 ? 1 : 0;
    return t;
}

/* Every rebuilt tree is accounted for, and shares are shares. */
static void check_denoised(stress *s, const gsd_field *f, uint32_t cells)
{
    gsd_stats stats;
    gsd_get_stats(f, &stats);
    if (s->sabotage && stress_chance(s, 0.2))
        s->deviating = true, stats.denoised_trees++;
    STRESS_CHECK(
        s,
        stats.denoised_trees + stats.smooth_trees + stats.shallow_trees + stats.deep_trees + stats.over_budget_trees ==
            stats.rebuilt_trees,
        "%u rebuilt, %u denoised, %u smooth, %u shallow, %u deep, %u over budget", stats.rebuilt_trees,
        stats.denoised_trees, stats.smooth_trees, stats.shallow_trees, stats.deep_trees, stats.over_budget_trees);
    for (uint32_t c = 0; c < cells && !s->failed; ++c) {
        gsd_tree t = {c, gsd_export_bound(f, GSD_PART_SAMPLING, c), NULL, NULL};
        double sum = 0;
        bool good = true;
        t.child = calloc(4 * (size_t)t.count, sizeof *t.child);
        t.value = calloc(4 * (size_t)t.count, sizeof *t.value);
        STRESS_CHECK(s, gsd_export_tree(f, GSD_PART_SAMPLING, &t) == GSD_OK, "export");
        for (uint32_t k = 0; k < 4 * t.count; ++k) {
            good = good && t.value[k] >= 0;
            sum += t.child[k] ? 0 : (double)t.value[k];
        }
        STRESS_CHECK(s, good && fabs(sum - 1) < 1e-4, "cell %u: shares sum to %g%s", c, sum, good ? "" : ", some < 0");
        free_tree(&t);
    }
}

/* Learned masses of all coarse bins: levels of SIMD may not differ there. */
static void check_levels(stress *s, const gsd_field *a, const gsd_field *b)
{
    gsd_view v = gsd_get_view(a), w = gsd_get_view(b);
    STRESS_CHECK(s, a->block->jumps == b->block->jumps, "other trees at another SIMD level");
    for (uint32_t k = 0; k < a->block->jumps && !s->failed; ++k)
        STRESS_CHECK(s, fabsf(v.masses[k] - w.masses[k]) <= 1e-4f, "bin %u: mass %g at one SIMD level, %g at another",
                     k, (double)v.masses[k], (double)w.masses[k]);
}

/* A copy of a saved field, refined in one mode. */
static gsd_field *denoised_copy(stress *s, const unsigned char *data, size_t size, gsd_simd simd, gsd_denoise_mode mode)
{
    gsd_desc given;
    gsd_pass pass = {.pixel_estimate = false, .denoise = mode};
    gsd_field *f = NULL;
    memset(&given, 0, sizeof given);
    given.simd = simd;
    if (STRESS_CHECK(s, gsd_load(&given, data, size, &f) == GSD_OK, "load"))
        STRESS_CHECK(s, gsd_refine(f, &pass, NULL, NULL) == GSD_OK, "refine");
    return f;
}

static void denoise(stress *s)
{
    enum { TREES = 3 };
    gsd_desc d = any_desc(s);
    gsd_field *f, *blurred, *gaussian = NULL, *scalar = NULL;
    gsd_stream *stream;
    gsd_tree trees[TREES];
    unsigned char *data;
    size_t size;
    d.forest_cells = TREES;
    d.max_depth = 6 + stress_below(s, 15);
    d.max_bytes = stress_chance(s, 0.2) ? d.max_bytes : 1u << 30;
    f = new_field(s, &d, &stream);
    for (uint32_t c = 0; c < TREES; ++c)
        trees[c] = hostile_tree(s, c, d.max_depth);
    plant_trees(s, f, trees, TREES);
    data = save_of(s, f, &size);
    blurred = denoised_copy(s, data, size, GSD_SIMD_AUTO, GSD_DENOISE_BLUR);
    if (!s->failed)
        gaussian = denoised_copy(s, data, size, GSD_SIMD_AUTO, GSD_DENOISE_GAUSSIAN);
    if (!s->failed)
        scalar = denoised_copy(s, data, size, GSD_SIMD_SCALAR, GSD_DENOISE_GAUSSIAN);
    if (!s->failed) {
        check_denoised(s, blurred, TREES);
        check_denoised(s, gaussian, TREES);
        check_levels(s, gaussian, scalar);
        check_field(s, blurred);
        check_field(s, gaussian);
    }
    for (uint32_t c = 0; c < TREES; ++c)
        free_tree(&trees[c]);
    free(data);
    gsd_destroy(blurred);
    gsd_destroy(gaussian);
    gsd_destroy(scalar);
    end_field(f, stream);
    stress_survived(s);
}

/* The same samples, cut at other places into streams and calls, by other numbers of threads. */
static void learn_cut(stress *s, gsd_field *f, uint32_t n, uint32_t cuts, stress_crowd *crowd)
{
    gsd_stream *streams[8] = {NULL};
    uint32_t at = 0, done = 0, i;
    for (i = 0; i < cuts; ++i) {
        uint32_t end = i + 1 == cuts ? n : at + stress_below(s, n - at + 1);
        STRESS_CHECK(s, gsd_stream_create(f, &streams[i]) == GSD_OK, "stream_create");
        STRESS_CHECK(s, gsd_record(streams[i], batch + at, end - at) == GSD_OK, "record");
        at = end;
    }
    while (done < cuts) {
        uint32_t part = 1 + stress_below(s, cuts - done);
        STRESS_CHECK(s,
                     gsd_accumulate(f, streams + done, part, crowd->threads ? stress_parallel : NULL, crowd) == GSD_OK,
                     "accumulate");
        done += part;
    }
    STRESS_CHECK(s, gsd_refine(f, NULL, crowd->threads ? stress_parallel : NULL, crowd) == GSD_OK, "refine");
    for (i = 0; i < cuts; ++i)
        gsd_stream_destroy(streams[i]);
}

static void threads(stress *s)
{
    gsd_desc d = any_desc(s);
    gsd_stream *none;
    gsd_field *a, *b;
    stress_crowd alone = {0}, crowd = {1 + (int)stress_below(s, 5)};
    size_t size;
    unsigned char *data;
    uint32_t passes = 1 + stress_below(s, 4);
    d.forest_cells = 0;
    a = new_field(s, &d, &none);
    gsd_stream_destroy(none);
    b = new_field(s, &d, &none);
    gsd_stream_destroy(none);
    for (uint32_t pass = 0; pass < passes && !s->failed; ++pass) {
        recipe r = any_recipe(s, stress_chance(s, 0.3));
        uint32_t n = some(s, MOST);
        make_samples(s, &r, gsd_get_desc(a), batch, n);
        learn_cut(s, a, n, 1, &alone);
        if (s->sabotage && pass == 0) { /* a race's result: one sample came in at another place */
            uint32_t other = stress_below(s, n);
            gsd_training_sample keep = batch[0];
            s->deviating = true;
            batch[0] = batch[other];
            batch[other] = keep;
            batch[0].radiance = keep.radiance > 0 ? 0 : 1;
        }
        learn_cut(s, b, n, 1 + stress_below(s, 8), &crowd);
    }
    data = save_of(s, a, &size);
    STRESS_CHECK(s, same_save(s, b, data, size), "%d threads give another field", crowd.threads);
    check_intact(s, a, false);
    free(data);
    gsd_destroy(a);
    gsd_destroy(b);
    stress_survived(s);
}

int main(int argc, char **argv)
{
    static const stress_group groups[] = {
        {"hostile-samples", hostile_samples, 2, false},
        {"contrast", contrast, 2, false},
        {"hot-leaf", hot_leaf, 1, false},
        {"all-zeros", all_zeros, 1, false},
        {"descriptors", descriptors, 2, true},
        {"memory-cap", memory_cap, 2, false},
        {"sequences", sequences, 3, false},
        {"failing-allocator", failing_allocator, 3, true},
        {"forged-saves", forged_saves, 3, true},
        {"imported-trees", imported_trees, 2, true},
        {"queries", queries, 2, false},
        {"denoise", denoise, 2, false},
        {"threads", threads, 2, false},
    };
    return stress_main(argc, argv, "sdtree", groups, (int)(sizeof groups / sizeof *groups));
}
