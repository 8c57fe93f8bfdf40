/* stress_kd.c: guide_kd.h under hostile and extreme input. See stress.h; `make stress` runs it.

   gcc -std=c11 -O2 -I. tests/stress_kd.c -lm -lpthread */
#define _XOPEN_SOURCE 700
#include "stress.h"

#define GKD_IMPLEMENTATION
#include "guide_kd.h"

#define MOST 20000 /* samples of a batch */

/* ---- checks of a field */

/* Integral of the density: its mean ratio to that of its own lobes in double precision, at points spread like them. */
static double integral(const gkd_handle *h)
{
    enum { RINGS = 8, TURNS = 4 };
    double e = (double)h->uniform, sum = 0, before = 0;
    for (uint32_t k = 0; k < h->count; ++k) {
        const gkd_lobe_block *b = &h->block[k / 8];
        uint32_t j = k % 8;
        double weight = (double)b->upper[j] - before, part = 0;
        gkd_draw draw = {{b->x[j], b->y[j], b->z[j]}, b->falloff[j] * (2 * GKD_LN2), {0, 0, 0}, 0, 0};
        before = (double)b->upper[j];
        memcpy(draw.normal, h->normal, sizeof draw.normal);
        for (int i = 0; i < RINGS * TURNS; ++i) {
            float w[3];
            double q = 0, last = 0;
            draw.r = ((float)(i / TURNS) + 0.5f) / RINGS;
            draw.turn = ((float)(i % TURNS) + 0.37f) / TURNS;
            gkd_draw_direction(&draw, w);
            for (uint32_t l = 0; l < h->count; ++l) {
                const gkd_lobe_block *c = &h->block[l / 8];
                uint32_t o = l % 8;
                double x = (double)w[0] - (double)c->x[o], y = (double)w[1] - (double)c->y[o],
                       z = (double)w[2] - (double)c->z[o], kappa = (double)c->falloff[o] * 2 * log(2), p, up, down;
                up = x * x + y * y + z * z;
                p = exp(-0.5 * kappa * up);
                if (h->surface) {
                    double cw = 0, cm = (double)c->x[o] * (double)h->normal[0] +
                                        (double)c->y[o] * (double)h->normal[1] + (double)c->z[o] * (double)h->normal[2];
                    for (int a = 0; a < 3; ++a)
                        cw += (double)w[a] * (double)h->normal[a];
                    down = up + 4 * cw * cm;
                    p += exp(-0.5 * kappa * down);
                }
                q += ((double)c->upper[o] - last) * kappa / (2 * PI * -expm1(-2 * kappa)) * p;
                last = (double)c->upper[o];
            }
            part += (double)gkd_pdf(h, w) / ((1 - e) * q + e / (4 * PI)) / (RINGS * TURNS);
        }
        sum += weight * part;
    }
    return sum;
}

static bool close_to(float a, float b) { return fabsf(a - b) <= 3e-5f * b; }

enum { BATCH = 48 };
typedef struct query {
    float position[BATCH][3], normal[BATCH][3], u[BATCH][2], jitter[BATCH][3], out[BATCH][3], pdf[BATCH];
    gkd_handle handle[BATCH];
} query;

/* A normal as gkd_find asks for it, or one that is far from unit length. */
static void unit_or_odd_normal(stress *s, float n[3])
{
    float l;
    any_normal(s, n);
    l = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    for (int k = 0; k < 3 && l > 0.4f && l < 2.1f; ++k)
        n[k] /= sqrtf(l);
}

static void make_query(stress *s, const gkd_field *f, const gkd_view *v, query *q)
{
    const gkd_desc *d = gkd_get_desc(f);
    for (int i = 0; i < BATCH; ++i) {
        for (int k = 0; k < 3; ++k) {
            float size = d->bounds_max[k] - d->bounds_min[k];
            q->position[i][k] =
                stress_chance(s, 0.05) ? hostile_number(s) : d->bounds_min[k] + size * (1.2f * stress_unitf(s) - 0.1f);
            q->jitter[i][k] = stress_unitf(s);
        }
        unit_or_odd_normal(s, q->normal[i]);
        any_random(s, q->u[i]);
        gkd_find(v, q->position[i], stress_chance(s, 0.7) ? q->normal[i] : NULL,
                 stress_chance(s, 0.5) ? q->jitter[i] : NULL, &q->handle[i]);
    }
}

/* Single queries: finite, unit, and the density that gkd_pdf gives. */
static void check_single(stress *s, const gkd_view *v, query *q)
{
    for (int i = 0; i < BATCH; ++i) {
        const gkd_handle *h = &q->handle[i];
        float *d = q->out[i], odd[3], pdf = gkd_sample(h, q->u[i], d), p;
        double length = (double)d[0] * (double)d[0] + (double)d[1] * (double)d[1] + (double)d[2] * (double)d[2];
        q->pdf[i] = pdf;
        STRESS_CHECK(s, h->cell < v->cell_count && h->count >= 1 && h->count <= GKD_MAX_LOBES, "cell %u, %u lobes",
                     h->cell, h->count);
        STRESS_CHECK(s, isfinite(pdf) && pdf > 0 && fabs(length - 1) < 2e-6, "sample: pdf %g, length - 1 = %g",
                     (double)pdf, length - 1);
        STRESS_CHECK(s, h->alpha > 0 && h->alpha <= 1 && h->reflected >= 0 && isfinite(h->reflected), "alpha %g",
                     (double)h->alpha);
        p = gkd_pdf(h, d);
        STRESS_CHECK(s, p == pdf, "pdf of a sample: %.9g, not %.9g", (double)p, (double)pdf);
        unit_direction(s, odd);
        p = gkd_pdf(h, odd);
        STRESS_CHECK(s, isfinite(p) && p > 0, "pdf %g", (double)p);
    }
}

/* Every SIMD level of this machine against single queries; rounding may choose the next lobe once. */
static void check_batches(stress *s, const gkd_view *v, const query *q)
{
    for (int level = GKD_SIMD_SCALAR; level <= GKD_SIMD_NEON; ++level) {
        static float out[BATCH][4], pdf[BATCH], again[BATCH];
        gkd_view at = *v;
        int apart = 0;
        if (gkdi_simd((gkd_simd)level) != (gkd_simd)level)
            continue;
        at.simd = (uint32_t)level;
        gkd_sample_batch(&at, BATCH, NULL, q->handle, q->u[0], sizeof q->u[0], out[0], sizeof out[0], pdf);
        gkd_pdf_batch(&at, BATCH, NULL, q->handle, q->out[0], sizeof q->out[0], again);
        for (int i = 0; i < BATCH; ++i) {
            float away = 0, own = gkd_pdf(&q->handle[i], out[i]);
            for (int k = 0; k < 3; ++k)
                away = fmaxf(away, fabsf(out[i][k] - q->out[i][k]));
            apart += away > 2e-3f;
            STRESS_CHECK(s, close_to(pdf[i], own), "level %d: pdf %g of a draw, not %g", level, (double)pdf[i],
                         (double)own);
            STRESS_CHECK(s, close_to(again[i], q->pdf[i]), "level %d: pdf %g, not %g", level, (double)again[i],
                         (double)q->pdf[i]);
        }
        STRESS_CHECK(s, apart <= 1, "level %d: %d draws are elsewhere", level, apart);
    }
}

/* All that holds for any field. */
static void check_intact(stress *s, const gkd_field *f)
{
    static query q;
    gkd_view v = gkd_get_view(f);
    gkd_stats stats;
    STRESS_CHECK(s, gkd_validate(f) == GKD_OK, "the field does not validate");
    if (s->failed)
        return;
    make_query(s, f, &v, &q);
    check_single(s, &v, &q);
    check_batches(s, &v, &q);
    for (int i = 0; i < 4; ++i) {
        double sum = integral(&q.handle[stress_below(s, BATCH)]);
        STRESS_CHECK(s, fabs(sum - 1) < 5e-5, "pdf integrates to %.9g", sum);
    }
    gkd_get_stats(f, &stats);
    STRESS_CHECK(s, gkd_record_fraction(f) > 0 && gkd_record_fraction(f) <= 1, "record fraction");
    STRESS_CHECK(s, stats.cells == gkd_cell_count(f) && stats.levels <= 60, "stats: %u cells, level %u", stats.cells,
                 stats.levels);
}

/* A fault in the sampling part or the building part's tree, so that the field can be put right again. */
static void check_damaged(stress *s, gkd_field *f)
{
    uint32_t kind = f->block->lobes ? stress_below(s, 3) : 2,
             k = f->block->lobes ? stress_below(s, f->block->lobes) : 0;
    gkd_lobe *l = gkdi_block_lobes(f->block) + k, keep = {{0, 0, 0}, 0, 0, 0};
    uint32_t link = f->nodes[0].link;
    s->deviating = true;
    if (kind < 2) {
        keep = *l;
        *(kind ? &l->weight : &l->kappa) = NAN;
    } else {
        f->nodes[0].link = 0x7fffffff;
    }
    check_intact(s, f);
    if (kind < 2)
        *l = keep;
    f->nodes[0].link = link;
}

static void check_field(stress *s, gkd_field *f)
{
    if (s->sabotage && !s->deviating)
        check_damaged(s, f);
    else
        check_intact(s, f);
}

static unsigned char *save_of(stress *s, const gkd_field *f, size_t *size)
{
    size_t bound = gkd_save_bound(f);
    unsigned char *data = malloc(bound);
    STRESS_CHECK(s, gkd_save(f, data, bound, size) == GKD_OK && *size <= bound, "save");
    return data;
}

static bool same_save(stress *s, const gkd_field *f, const unsigned char *data, size_t size)
{
    size_t now;
    unsigned char *other = save_of(s, f, &now);
    bool same = now == size && memcmp(data, other, size) == 0;
    free(other);
    return same;
}

/* ---- descriptors and samples */

static gkd_desc any_desc(stress *s)
{
    gkd_desc d;
    memset(&d, 0, sizeof d);
    for (int k = 0; k < 3; ++k)
        d.bounds_max[k] = 1;
    d.split = (gkd_split)stress_below(s, 3);
    d.split_samples = stress_chance(s, 0.5) ? 0 : (uint32_t)stress_log(s, 64, 5000);
    d.lookahead = stress_below(s, 8);
    d.min_samples = stress_chance(s, 0.3) ? 0 : (uint32_t)stress_log(s, 16, 2000);
    d.radiance_step = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 0.002, 50);
    d.direction_step = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 0.002, 3);
    d.confidence = stress_chance(s, 0.5) ? 0 : (float)stress_log(s, 1e-11, 0.39);
    d.no_radiance_test = stress_chance(s, 0.1);
    d.no_direction_test = stress_chance(s, 0.1);
    d.published_tests = stress_chance(s, 0.2);
    d.keep_signatures = stress_chance(s, 0.6) ? 0 : stress_unitf(s);
    d.max_levels = stress_below(s, 61);
    d.max_lobes = stress_below(s, 33);
    d.update_samples = (uint32_t)stress_log(s, 1024, 40000);
    d.max_bytes = (uint64_t)1 << (20 + stress_below(s, 6));
    d.alpha_mode = (gkd_alpha_mode)stress_below(s, 3);
    d.alpha = stress_chance(s, 0.7) ? 0 : 0.05f + 0.95f * stress_unitf(s);
    d.uniform = stress_chance(s, 0.7) ? 0 : (float)stress_log(s, 1.01e-4, 1);
    d.no_mixtures = stress_chance(s, 0.05);
    d.no_gate = stress_chance(s, 0.5);
    d.gate_probe = stress_below(s, 4);
    return d;
}

/* Whether a sample is bad, by the words of the header's ERRORS; its direction shows as pdf_mix = 0, its distance as a
   nearness below 0 or not finite. */
static bool bad_sample(const gkd_training_sample *t)
{
    for (int k = 0; k < 3; ++k)
        if (!isfinite(t->position[k]))
            return true;
    return bad_value(t->radiance) || bad_value(t->contribution) || bad_value(t->pixel_contribution) ||
           !(t->pdf_mix > 0) || !isfinite(t->pdf_mix) || !(t->pdf_bsdf >= 0) || !isfinite(t->pdf_bsdf) ||
           !(t->pdf_guide >= 0) || !isfinite(t->pdf_guide) || !(t->nearness >= 0) || !isfinite(t->nearness);
}

static gkd_training_sample batch[MOST];

/* n samples into the batch; returns how many of them are bad. */
static uint32_t make_samples(stress *s, const recipe *r, const gkd_desc *d, uint32_t n, bool hostile)
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
        batch[i] = gkd_make_scalar_sample(p, dir, stress_chance(s, 0.5) ? normal : NULL, any_distance(s, hostile),
                                          value, contribution, pixel, any_pdf(s, r), any_pdf(s, r),
                                          stress_chance(s, 0.5) ? 0 : any_pdf(s, r));
        bad += bad_sample(&batch[i]);
    }
    return bad;
}

/* One pass over the batch; without memory trouble nothing may fail. */
static void learn(stress *s, gkd_field *f, gkd_stream *stream, uint32_t n)
{
    gkd_pass pass = {.pixel_estimate = stress_chance(s, 0.5)};
    STRESS_CHECK(s, gkd_record(stream, batch, n) == GKD_OK, "record");
    STRESS_CHECK(s, gkd_accumulate(f, &stream, 1, NULL, NULL) == GKD_OK, "accumulate");
    gkd_stream_clear(stream);
    STRESS_CHECK(s, gkd_refine(f, stress_chance(s, 0.5) ? &pass : NULL, NULL, NULL) == GKD_OK, "refine");
}

/* A field and a stream, or the loss of the try. */
static gkd_field *new_field(stress *s, const gkd_desc *d, gkd_stream **stream)
{
    gkd_field *f = NULL;
    gkd_result result = gkd_create(d, &f);
    *stream = NULL;
    if (STRESS_CHECK(s, result == GKD_OK, "create: %s", gkd_result_string(result)))
        STRESS_CHECK(s, gkd_stream_create(f, stream) == GKD_OK, "stream_create");
    return f;
}

static void end_field(gkd_field *f, gkd_stream *stream)
{
    gkd_stream_destroy(stream);
    gkd_destroy(f);
}

/* ---- groups: samples */

/* Samples of all kinds for some passes; exactly the bad ones are refused. */
static void hostile_samples(stress *s)
{
    gkd_desc d = any_desc(s);
    gkd_stream *stream;
    gkd_field *f = new_field(s, &d, &stream);
    uint64_t bad = 0, all = 0;
    gkd_stats stats;
    for (uint32_t pass = 0; !s->failed && pass < 1 + stress_below(s, 5); ++pass) {
        recipe r = any_recipe(s, true);
        uint32_t n = some(s, 10000);
        bad += make_samples(s, &r, gkd_get_desc(f), n, true);
        all += n;
        learn(s, f, stream, n);
    }
    if (s->sabotage && stress_chance(s, 0.3))
        s->deviating = ++bad;
    if (!s->failed) {
        gkd_get_stats(f, &stats);
        STRESS_CHECK(s, stats.refused == bad && stats.samples == all - bad && stats.lost == 0,
                     "%llu of %llu refused, %llu are bad", (unsigned long long)stats.refused, (unsigned long long)all,
                     (unsigned long long)bad);
        check_field(s, f);
    }
    end_field(f, stream);
    stress_end(s, bad == all);
}

/* Radiance and density over sixty powers of ten. */
static void contrast(stress *s)
{
    gkd_desc d = any_desc(s);
    gkd_stream *stream;
    gkd_field *f = new_field(s, &d, &stream);
    for (uint32_t pass = 0; !s->failed && pass < 5; ++pass) {
        recipe r = any_recipe(s, false);
        uint32_t n = some(s, 8000);
        r.value = 1;
        r.pdf = (int)stress_below(s, 2);
        make_samples(s, &r, gkd_get_desc(f), n, false);
        learn(s, f, stream, n);
    }
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* Nothing but zeros: no lobes, the density stays uniform, and only the radiance of nothing was seen. */
static void all_zeros(stress *s)
{
    gkd_desc d = any_desc(s);
    gkd_stream *stream;
    gkd_field *f = new_field(s, &d, &stream);
    float fault = s->sabotage && stress_chance(s, 0.5) ? 1e-3f : 0;
    s->deviating = fault > 0;
    for (uint32_t pass = 0; !s->failed && pass < 4; ++pass) {
        recipe r = any_recipe(s, false);
        uint32_t n = some(s, 5000);
        r.value = 3;
        make_samples(s, &r, gkd_get_desc(f), n, false);
        learn(s, f, stream, n);
    }
    for (int i = 0; !s->failed && i < 100; ++i) {
        gkd_view v = gkd_get_view(f);
        float p[3] = {stress_unitf(s), stress_unitf(s), stress_unitf(s)}, w[3], pdf;
        gkd_handle h;
        unit_direction(s, w);
        gkd_find(&v, p, NULL, NULL, &h);
        pdf = gkd_pdf(&h, w);
        STRESS_CHECK(s, fabsf(pdf - (float)(1 / (4 * PI)) + fault) < 1e-6f, "pdf %g after nothing but zeros",
                     (double)pdf);
    }
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* The same scene at another place and in another size: its lamp is known as well there. */
static void huge_and_tiny(stress *s)
{
    gkd_desc d;
    gkd_stream *stream;
    gkd_field *f;
    double size = stress_log(s, 1e-17, 1e17), far = size * stress_log(s, 1, 1e4), gain = 0;
    float lamp[3], turned;
    memset(&d, 0, sizeof d);
    for (int k = 0; k < 3; ++k) {
        d.bounds_min[k] = (float)(stress_chance(s, 0.5) ? 0 : stress_chance(s, 0.5) ? far : -far);
        d.bounds_max[k] = d.bounds_min[k] + (float)size;
    }
    d.update_samples = 4096;
    f = new_field(s, &d, &stream);
    unit_direction(s, lamp);
    turned = s->sabotage ? -1 : 1;
    s->deviating = s->sabotage;
    for (int pass = 0; pass < 3 && !s->failed; ++pass) {
        for (uint32_t i = 0; i < 4000; ++i) {
            float p[3], w[3], L = i % 3 ? 1 : 100;
            double c[3], l = 0;
            unit_direction(s, w);
            for (int k = 0; k < 3; ++k) {
                c[k] = stress_unit(s);
                p[k] = d.bounds_min[k] + (float)(size * c[k]);
                c[k] = 0.5 + 4 * (double)lamp[k] + 0.1 * (double)w[k] - c[k]; /* a ball 4 sizes away */
                l += c[k] * c[k];
            }
            for (int k = 0; k < 3 && i % 3 == 0; ++k)
                w[k] = (float)(c[k] / sqrt(l)) * turned;
            batch[i] =
                gkd_make_scalar_sample(p, w, NULL, i % 3 ? INFINITY : (float)(sqrt(l) * size), L, L, L, 1, 0.08f, 0);
        }
        learn(s, f, stream, 4000);
    }
    for (int i = 0; i < 100 && !s->failed; ++i) {
        gkd_view v = gkd_get_view(f);
        float p[3], w[3];
        double l = 0, c[3];
        gkd_handle h;
        for (int k = 0; k < 3; ++k) {
            c[k] = stress_unit(s);
            p[k] = d.bounds_min[k] + (float)(size * c[k]);
            c[k] = 0.5 + 4 * (double)lamp[k] - c[k];
            l += c[k] * c[k];
        }
        for (int k = 0; k < 3; ++k)
            w[k] = (float)(c[k] / sqrt(l));
        gkd_find(&v, p, NULL, NULL, &h);
        gain += log((double)gkd_pdf(&h, w) * 4 * PI) / 100;
    }
    STRESS_CHECK(s, gain > 3, "size %g, %g away: the lamp is e^%g times denser only", size, far, gain);
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* Even light whose samples have heavy tails: no test may see more edges than its error allows, whatever the tail. */
static void heavy_tails(stress *s)
{
    gkd_desc d;
    gkd_stream *stream;
    gkd_field *f;
    gkd_stats stats;
    double tail = 0.25 + 2 * stress_unit(s), edge = s->sabotage ? 8 : 1; /* L = u^-1/(1 + tail): infinite variance */
    memset(&d, 0, sizeof d);
    for (int k = 0; k < 3; ++k)
        d.bounds_max[k] = 1;
    d.no_mixtures = true;
    d.confidence = 1e-6f;
    d.update_samples = (uint32_t)stress_log(s, 1024, 40000);
    d.lookahead = 1 + stress_below(s, 6);
    d.no_direction_test = true;
    s->deviating = s->sabotage;
    f = new_field(s, &d, &stream);
    for (int pass = 0; pass < 4 && !s->failed; ++pass) {
        for (uint32_t i = 0; i < MOST; ++i) {
            float p[3] = {stress_unitf(s), stress_unitf(s), stress_unitf(s)}, w[3];
            float L = (float)pow(1 - stress_unit(s), -1 / (1 + tail)) * (p[0] > 0.5f ? (float)edge : 1);
            unit_direction(s, w);
            batch[i] = gkd_make_scalar_sample(p, w, NULL, INFINITY, L, L, L, (float)(1 / (4 * PI)), 0.08f, 0);
        }
        learn(s, f, stream, MOST);
    }
    if (!s->failed) {
        gkd_get_stats(f, &stats);
        STRESS_CHECK(s, stats.cells <= 2, "%u cells of even light, tail %g", stats.cells, 1 + tail);
        check_field(s, f);
    }
    end_field(f, stream);
    stress_survived(s);
}

/* ---- groups: descriptors, memory */

/* As gkd_desc documents them. */
#define LIMIT(name, whole, low, high) STRESS_LIMIT(gkd_desc, name, whole, low, high)
static const stress_limit limits[] = {
    LIMIT(split_samples, true, 64, 1e9),
    LIMIT(lookahead, true, 1, 7),
    LIMIT(min_samples, true, 16, 1e9),
    LIMIT(radiance_step, false, 0.001, 100),
    LIMIT(direction_step, false, 0.001, 3.1),
    LIMIT(confidence, false, 1e-12, 0.4),
    LIMIT(max_levels, true, 1, 60),
    LIMIT(max_lobes, true, 1, 32),
    LIMIT(update_samples, true, 1024, 1 << 26),
    LIMIT(alpha, false, 0.05, 1),
    LIMIT(uniform, false, 1e-4, 1),
    LIMIT(gate_margin, false, 0.001, 10),
    LIMIT(gate_gain, false, 1e-4, 1000),
    LIMIT(gate_probe, true, 1, 1000),
};

/* Options at and beyond their limits: refused or a field that learns. */
static void descriptors(stress *s)
{
    gkd_desc d = any_desc(s);
    double extent;
    bool bad = false;
    gkd_field *f = NULL;
    gkd_stream *stream = NULL;
    gkd_result result;
    if (stress_chance(s, 0.7))
        bad = set_extreme(s, &d, limits, sizeof limits / sizeof *limits);
    if (stress_chance(s, 0.6))
        bad = !set_bounds(s, d.bounds_min, d.bounds_max, &extent) || bad;
    d.alpha_mode = stress_chance(s, 0.02) ? (gkd_alpha_mode)77 : d.alpha_mode;
    d.max_bytes = stress_chance(s, 0.05) ? (1u << 20) - 1 : d.max_bytes;
    bad = bad || d.alpha_mode > GKD_ALPHA_GRID || d.max_bytes < 1u << 20;
    if (s->sabotage && stress_chance(s, 0.5))
        s->deviating = true, bad = !bad;
    result = gkd_create(&d, &f);
    STRESS_CHECK(s, (result != GKD_OK) == bad && (result == GKD_OK) == (f != NULL), "%s, should be %s",
                 gkd_result_string(result), bad ? "refused" : "accepted");
    if (result == GKD_OK && !s->failed) {
        gkd_stream_create(f, &stream);
        for (int pass = 0; pass < 3 && !s->failed; ++pass) {
            recipe r = any_recipe(s, false);
            uint32_t n = some(s, 4000);
            make_samples(s, &r, gkd_get_desc(f), n, false);
            learn(s, f, stream, n);
        }
        check_field(s, f);
    }
    end_field(f, stream);
    stress_end(s, result != GKD_OK);
}

/* Small caps and many samples: what is held stays at most a tenth beyond, and the field says the truth. */
static void memory_cap(stress *s)
{
    gkd_desc d = any_desc(s);
    stress_memory memory = {0};
    gkd_stream *stream;
    gkd_field *f;
    d.max_bytes = (1u << 20) + (stress_chance(s, 0.5) ? 0 : stress_below(s, 1u << 21));
    d.max_levels = 0;
    d.split_samples = 64;
    d.min_samples = 16;
    d.confidence = 0.39f;
    d.radiance_step = 0.001f;
    d.allocate = stress_allocate;
    d.release = stress_release;
    d.user = &memory;
    f = new_field(s, &d, &stream);
    gkd_stream_destroy(stream); /* streams, samples that wait and scratch are outside the cap */
    for (int pass = 0; !s->failed && pass < 4; ++pass) {
        recipe r = any_recipe(s, false);
        gkd_stats stats;
        double held;
        make_samples(s, &r, gkd_get_desc(f), MOST, false);
        STRESS_CHECK(s, gkd_stream_create(f, &stream) == GKD_OK, "stream_create");
        learn(s, f, stream, MOST);
        gkd_stream_destroy(stream);
        gkd_get_stats(f, &stats);
        if (s->sabotage && stress_chance(s, 0.3))
            s->deviating = true, memory.bytes += 1u << 21;
        held = (double)memory.bytes - f->pending_capacity * (double)sizeof *f->pending;
        STRESS_CHECK(s, fabs(held - (double)stats.bytes) <= 0.01 * held, "held %g, says %llu", held,
                     (unsigned long long)stats.bytes);
        STRESS_CHECK(s, held <= 1.1 * (double)d.max_bytes, "held %g, cap %llu", held, (unsigned long long)d.max_bytes);
        memory.bytes -= s->deviating ? 1u << 21 : 0;
        if (s->deviating)
            break;
    }
    if (!s->failed)
        check_field(s, f);
    gkd_destroy(f);
    STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
    stress_survived(s);
}

/* A run again and again, with the first, second, ... request failing, or each k-th: reported, survived, no leak. */
static void failing_allocator(stress *s)
{
    uint64_t start = s->rng;
    bool every = stress_chance(s, 0.5);
    long requests = 1000;
    for (long pass = 0; pass < 20; ++pass) {
        stress_memory memory = {0};
        gkd_desc d;
        gkd_field *f = NULL;
        gkd_stream *stream = NULL;
        uint64_t told = 0;
        long failed = 0, k = pass == 0 ? 0 : every ? 1 + pass : 1 + (pass * 7919) % requests;
        s->rng = start;
        d = any_desc(s);
        d.allocate = stress_allocate;
        d.release = stress_release;
        d.user = &memory;
        *(every ? &memory.fail_every : &memory.fail_at) = k;
        failed += gkd_create(&d, &f) != GKD_OK;
        failed += f && gkd_stream_create(f, &stream) != GKD_OK;
        for (int i = 0; i < 3 && stream; ++i) {
            recipe r = any_recipe(s, stress_chance(s, 0.3));
            uint32_t n = some(s, 5000);
            make_samples(s, &r, gkd_get_desc(f), n, false);
            failed += gkd_record(stream, batch, n) != GKD_OK;
            failed += gkd_accumulate(f, &stream, 1, NULL, NULL) != GKD_OK;
            told += n;
            gkd_stream_clear(stream);
            failed += gkd_refine(f, NULL, NULL, NULL) != GKD_OK;
        }
        requests = pass == 0 ? memory.requests : requests;
        memory.fail_at = memory.fail_every = 0;
        if (f) {
            gkd_stats stats;
            uint64_t fault = s->sabotage && stress_chance(s, 0.5);
            s->deviating = s->deviating || fault;
            gkd_refine(f, NULL, NULL, NULL); /* a pass that could not be published is, now */
            gkd_get_stats(f, &stats);
            STRESS_CHECK(s, stats.samples + stats.refused + stats.lost == told + fault,
                         "%llu accepted, %llu refused, %llu lost of %llu", (unsigned long long)stats.samples,
                         (unsigned long long)stats.refused, (unsigned long long)stats.lost, (unsigned long long)told);
            check_field(s, f);
        }
        if (pass == 0)
            STRESS_CHECK(s, failed == 0, "a call failed without cause");
        end_field(f, stream);
        STRESS_CHECK(s, memory.live == 0, "%ld leaks", memory.live);
        stress_end(s, memory.failed > 0);
    }
}

/* ---- groups: saves and merges */

/* Make size and checksum right again, so that what follows them is looked at. */
static void seal(unsigned char *data, size_t size)
{
    gkdi_header h;
    if (size < sizeof h)
        return;
    memcpy(&h, data, sizeof h);
    h.size = size;
    h.checksum = gkdi_hash_bytes(1, data + GKDI_CHECKED_FROM, size - GKDI_CHECKED_FROM);
    memcpy(data, &h, sizeof h);
}

static unsigned char *trained_save(stress *s, size_t *size)
{
    gkd_desc d = any_desc(s);
    gkd_stream *stream;
    unsigned char *data;
    gkd_field *f;
    d.lookahead = 1 + d.lookahead % 3;
    d.min_samples = 100;
    d.split_samples = 64;
    f = new_field(s, &d, &stream);
    for (int pass = 0; pass < 2; ++pass) {
        recipe r = any_recipe(s, false);
        make_samples(s, &r, gkd_get_desc(f), 600, false);
        learn(s, f, stream, 600);
    }
    STRESS_CHECK(s, gkd_record(stream, batch, 50) == GKD_OK && gkd_accumulate(f, &stream, 1, NULL, NULL) == GKD_OK,
                 "accumulate");
    data = save_of(s, f, size);
    end_field(f, stream);
    return data;
}

/* A forged save: no field, or one that is whole and can go on. */
static void try_save(stress *s, const unsigned char *data, size_t size, bool sealed, const char *how)
{
    stress_memory memory = {0};
    gkd_desc d = {.allocate = stress_allocate, .release = stress_release, .user = &memory};
    unsigned char *exact = malloc(size ? size : 1); /* so that a sanitizer sees every byte beyond */
    gkd_field *f;
    gkd_result result;
    memcpy(exact, data, size);
    result = gkd_load(&d, exact, size, &f);
    free(exact);
    STRESS_CHECK(s, (result == GKD_OK) == (f != NULL), "%s: %s, yet %s", how, gkd_result_string(result),
                 f ? "a field" : "none");
    STRESS_CHECK(s, result == GKD_OK || result == GKD_BAD_FILE || result == GKD_BAD_VERSION || sealed, "%s: %s", how,
                 gkd_result_string(result));
    STRESS_CHECK(s, result != GKD_OK || sealed || how[0] == 'u', "%s: loaded", how);
    if (f) {
        gkd_stream *stream = NULL;
        check_field(s, f);
        STRESS_CHECK(s, gkd_stream_create(f, &stream) == GKD_OK, "stream_create");
        for (int pass = 0; pass < 2 && !s->failed; ++pass) {
            recipe r = any_recipe(s, true);
            make_samples(s, &r, gkd_get_desc(f), 100, true);
            learn(s, f, stream, 100);
            check_intact(s, f);
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
        if (!sealed && n == size && memcmp(forged, data, size) == 0)
            how = "untouched";
        try_save(s, forged, n, sealed, how);
    }
    free(data);
    free(other);
    free(forged);
}

/* A copy of a field by way of a save. */
static gkd_field *copy_of(stress *s, const gkd_field *f)
{
    size_t size;
    unsigned char *data = save_of(s, f, &size);
    gkd_field *copy = NULL;
    STRESS_CHECK(s, gkd_load(NULL, data, size, &copy) == GKD_OK, "load");
    if (copy)
        STRESS_CHECK(s, gkd_validate(copy) == GKD_OK, "a copy does not validate");
    free(data);
    return copy;
}

/* Equal but for how much memory is held, which depends on how it came. */
static void check_same(stress *s, gkd_field *a, gkd_field *b, const char *what)
{
    size_t size;
    uint64_t bytes_a = a->stats.bytes, bytes_b = b->stats.bytes;
    unsigned char *data;
    a->stats.bytes = b->stats.bytes = 0;
    data = save_of(s, a, &size);
    STRESS_CHECK(s, same_save(s, b, data, size), "%s", what);
    a->stats.bytes = bytes_a;
    b->stats.bytes = bytes_b;
    free(data);
}

/* Copies of one field that each see a part equal, once merged, one that saw all; others are refused unharmed. */
static void merges(stress *s)
{
    gkd_desc d = any_desc(s);
    gkd_stream *stream, *streams[3] = {NULL, NULL, NULL};
    gkd_field *f, *part[3] = {NULL, NULL, NULL};
    recipe r;
    uint32_t n = 3 + some(s, 900), cut = 1 + stress_below(s, n - 1);
    size_t size;
    unsigned char *data;
    bool apart = stress_chance(s, 0.3);
    d.max_bytes = 1u << 28; /* else a share of memory decides, which depends on what is held */
    f = new_field(s, &d, &stream);
    for (int pass = 0; pass < 2 && !s->failed; ++pass) {
        r = any_recipe(s, false);
        make_samples(s, &r, gkd_get_desc(f), 3000, false);
        learn(s, f, stream, 3000);
    }
    for (int i = 0; i < 3 && !s->failed; ++i) {
        part[i] = copy_of(s, f);
        STRESS_CHECK(s, part[i] && gkd_stream_create(part[i], &streams[i]) == GKD_OK, "stream_create");
    }
    r = any_recipe(s, false);
    make_samples(s, &r, gkd_get_desc(f), n, false);
    if (!s->failed) {
        STRESS_CHECK(s, gkd_record(streams[0], batch, cut) == GKD_OK, "record");
        STRESS_CHECK(s, gkd_record(streams[1], batch + cut, n - cut) == GKD_OK, "record");
        if (s->sabotage) /* a merge that changes a sample */
            s->deviating = true, batch[cut].position[0] = 0.77f, batch[cut].radiance = 3;
        STRESS_CHECK(s, gkd_record(streams[2], batch, n) == GKD_OK, "record");
        for (int i = 0; i < 3; ++i)
            STRESS_CHECK(s, gkd_accumulate(part[i], &streams[i], 1, NULL, NULL) == GKD_OK, "accumulate");
        if (apart)
            gkd_refine(part[1], NULL, NULL, NULL);
        data = save_of(s, part[0], &size);
        gkd_result result = gkd_merge(part[0], part[1], NULL, NULL);
        STRESS_CHECK(s, result == (apart ? GKD_MISMATCH : GKD_OK), "merge: %s", gkd_result_string(result));
        if (apart) {
            if (s->sabotage)
                STRESS_CHECK(s, same_save(s, part[1], data, size), "planted");
            else
                STRESS_CHECK(s, same_save(s, part[0], data, size), "a refused merge changed the field");
        } else {
            gkd_refine(part[0], NULL, NULL, NULL);
            gkd_refine(part[2], NULL, NULL, NULL);
            check_same(s, part[0], part[2], "merging is not learning together");
        }
        free(data);
        check_intact(s, part[0]);
    }
    for (int i = 0; i < 3; ++i)
        end_field(part[i], streams[i]);
    end_field(f, stream);
    stress_end(s, apart);
}

/* ---- groups: splits, threads */

typedef struct reports {
    uint32_t cells, parents[65536];
    bool wrong;
} reports;

static void on_split(void *user, uint32_t parent, uint32_t a, uint32_t b)
{
    reports *r = user;
    r->wrong = r->wrong || a != parent || parent >= r->cells || b != r->cells || b >= 65536;
    if (!r->wrong)
        r->parents[r->cells++] = parent;
}

/* Structure only: whoever hears of every split knows of which cell each one is a part. */
static void split_reports(stress *s)
{
    enum { PLACES = 400 };
    static reports r;
    gkd_desc d = any_desc(s);
    gkd_stream *stream;
    gkd_field *f;
    gkd_stats stats;
    float place[PLACES][3];
    uint32_t cell[PLACES] = {0};
    d.no_mixtures = true;
    d.min_samples = 16 + stress_below(s, 200);
    d.confidence = 0.3f;
    f = new_field(s, &d, &stream);
    r.cells = 1;
    r.wrong = false;
    for (int i = 0; i < PLACES; ++i)
        for (int k = 0; k < 3; ++k)
            place[i][k] = stress_unitf(s);
    for (int pass = 0; pass < 4 && !s->failed; ++pass) {
        gkd_pass facts = {.on_split = on_split, .on_split_user = &r};
        recipe how = any_recipe(s, false);
        uint32_t n = some(s, MOST), before = r.cells;
        gkd_view v;
        make_samples(s, &how, gkd_get_desc(f), n, false);
        STRESS_CHECK(s, gkd_record(stream, batch, n) == GKD_OK, "record");
        STRESS_CHECK(s, gkd_accumulate(f, &stream, 1, NULL, NULL) == GKD_OK, "accumulate");
        gkd_stream_clear(stream);
        STRESS_CHECK(s, gkd_refine(f, &facts, NULL, NULL) == GKD_OK, "refine");
        if (s->sabotage && stress_chance(s, 0.5) && r.cells > before)
            s->deviating = true, r.cells--;
        STRESS_CHECK(s, !r.wrong && r.cells == gkd_cell_count(f), "%u cells by reports, %u in fact", r.cells,
                     gkd_cell_count(f));
        v = gkd_get_view(f);
        for (int i = 0; i < PLACES && !s->failed; ++i) {
            uint32_t now = gkd_find_cell(&v, place[i]), from = now;
            while (from >= before)
                from = r.parents[from];
            STRESS_CHECK(s, from == cell[i], "cell %u came from %u, not %u", now, from, cell[i]);
            cell[i] = now;
        }
    }
    gkd_get_stats(f, &stats);
    STRESS_CHECK(s, stats.lobes == 0, "lobes without mixtures");
    if (!s->failed)
        check_field(s, f);
    end_field(f, stream);
    stress_survived(s);
}

/* The same samples, cut at other places into streams and calls, by other numbers of threads. */
static void learn_cut(stress *s, gkd_field *f, uint32_t n, uint32_t cuts, stress_crowd *crowd)
{
    gkd_stream *streams[8] = {NULL};
    gkd_parallel_fn parallel = crowd->threads ? stress_parallel : NULL;
    uint32_t at = 0, done = 0, i;
    for (i = 0; i < cuts; ++i) {
        uint32_t end = i + 1 == cuts ? n : at + stress_below(s, n - at + 1);
        STRESS_CHECK(s, gkd_stream_create(f, &streams[i]) == GKD_OK, "stream_create");
        STRESS_CHECK(s, gkd_record(streams[i], batch + at, end - at) == GKD_OK, "record");
        at = end;
    }
    while (done < cuts) {
        uint32_t part = 1 + stress_below(s, cuts - done);
        STRESS_CHECK(s, gkd_accumulate(f, streams + done, part, parallel, crowd) == GKD_OK, "accumulate");
        done += part;
    }
    STRESS_CHECK(s, gkd_refine(f, NULL, parallel, crowd) == GKD_OK, "refine");
    for (i = 0; i < cuts; ++i)
        gkd_stream_destroy(streams[i]);
}

/* Threads, cuts and SIMD levels give the same bits. */
static void threads(stress *s)
{
    gkd_desc d = any_desc(s);
    gkd_stream *none;
    gkd_field *a, *b;
    stress_crowd alone = {0}, crowd = {1 + (int)stress_below(s, 5)};
    uint32_t passes = 1 + stress_below(s, 4);
    a = new_field(s, &d, &none);
    gkd_stream_destroy(none);
    d.simd = stress_chance(s, 0.5) ? GKD_SIMD_SCALAR : GKD_SIMD_AUTO;
    b = new_field(s, &d, &none);
    gkd_stream_destroy(none);
    for (uint32_t pass = 0; pass < passes && !s->failed; ++pass) {
        recipe r = any_recipe(s, stress_chance(s, 0.3));
        uint32_t n = some(s, MOST);
        make_samples(s, &r, gkd_get_desc(a), n, false);
        learn_cut(s, a, n, 1, &alone);
        if (s->sabotage && pass == 0) { /* a race's result: one sample came in at another place */
            uint32_t other = stress_below(s, n);
            gkd_training_sample keep = batch[0];
            s->deviating = true;
            batch[0] = batch[other];
            batch[other] = keep;
            batch[0].radiance = keep.radiance > 0 ? 0 : 1;
        }
        learn_cut(s, b, n, 1 + stress_below(s, 8), &crowd);
    }
    check_same(s, a, b, "other threads, cuts or levels give another field");
    check_intact(s, a);
    gkd_destroy(a);
    gkd_destroy(b);
    stress_survived(s);
}

int main(int argc, char **argv)
{
    static const stress_group groups[] = {
        {"kd-hostile-samples", hostile_samples, 2, false},
        {"kd-contrast", contrast, 2, false},
        {"kd-all-zeros", all_zeros, 1, false},
        {"kd-huge-and-tiny", huge_and_tiny, 1, false},
        {"kd-heavy-tails", heavy_tails, 2, false},
        {"kd-descriptors", descriptors, 2, true},
        {"kd-memory-cap", memory_cap, 2, false},
        {"kd-failing-allocator", failing_allocator, 3, true},
        {"kd-forged-saves", forged_saves, 3, true},
        {"kd-merges", merges, 2, true},
        {"kd-split-reports", split_reports, 2, false},
        {"kd-threads", threads, 2, false},
    };
    return stress_main(argc, argv, "kd", groups, (int)(sizeof groups / sizeof *groups));
}
