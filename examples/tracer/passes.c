/* passes.c: the pass loop: growing passes, learning after each, images combined by one scalar weight per group of
   passes. With settings.train the first passes only teach: the picture begins anew, with a field that stays as it is.

     >>rounds   a pass is cut into rounds of bounded memory; the method takes its records in after each
     >>combine  groups of passes, their variances and weights
     >>estimate the pixel estimate for variance-aware targets
     >>trend    whether learning still pays
     >>loop     tr_render */
#include "integrator.h"
#include "threads.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#define MAX_GROUPS 32
#define GROWTH 4 /* a learning pass is 1 / GROWTH of all before it */
/* Camera paths between two flushes, and photon paths: bounds the memory of records. Each may be split. */
#define ROUND_PATHS (1 << 17)

/* Passes that were sampled in the same way, or nearly so: plain sums are the best way to join them. */
typedef struct group {
    double *sum, *sum_squares;
    int spp, first_spp; /* first_spp: samples of the image when it began, >= 1 */
    bool guided;
    double variance; /* of a sample, relative, trimmed mean over pixels */
    double weight;
} group;

typedef struct render_state {
    const tr_settings *settings;
    tr_frame frame;
    tr_pool *pool;
    tr_worker **idle; /* workers not in use */
    int idle_count, worker_count;
    pthread_mutex_t lock;
    tr_worker **workers;
    group groups[MAX_GROUPS];
    int group_count;
    tr_image estimate, combined, variance;
    tr_result *result;
    double start_cpu, update_cpu, photon_cpu;
    tr_photon_stats photons;
    uint64_t round_tile; /* first tile of the round */
    bool guided;         /* the last pass met cells that guide */
    tr_trend trend;      /* of a timed render */
    int learned;         /* samples per pixel that were learned from */
    double learning_cpu; /* CPU seconds of the passes that taught */
    double learning;     /* share of the last such pass that recording, updating and photons took */
    double rest;         /* variance of a sample when learning no longer paid, 0 = it goes on */
    bool frozen;         /* after the training: one pass that teaches nothing */
    int done;            /* samples per pixel so far, those of the training too */
    double cost;         /* CPU seconds of a sample per pixel in the last pass */
    bool out_of_time;
} render_state;

static size_t pixel_count(const render_state *r) { return (size_t)r->frame.width * (size_t)r->frame.height; }
static double cpu_used(const render_state *r) { return tr_cpu_seconds() - r->start_cpu; }

/* ---- >>rounds ----------------------------------------------------------------------------------------------- */

static void render_tiles(void *context, uint32_t begin, uint32_t end)
{
    render_state *r = context;
    pthread_mutex_lock(&r->lock);
    tr_worker *worker = r->idle[--r->idle_count];
    pthread_mutex_unlock(&r->lock);
    for (uint32_t i = begin; i < end; ++i)
        tr_render_tile(worker, &r->frame, (int)(r->round_tile + i));
    pthread_mutex_lock(&r->lock);
    r->idle[r->idle_count++] = worker;
    pthread_mutex_unlock(&r->lock);
}

static void flush_records(render_state *r, bool recorded)
{
    double start = tr_cpu_seconds();
    if (recorded && r->settings->method->flush)
        r->settings->method->flush(r->frame.method_data);
    r->update_cpu += tr_cpu_seconds() - start;
}

/* `samples` per pixel over the whole image; tiles in groups when the image is large. Rounds depend on sizes alone. */
static void render_samples(render_state *r, uint64_t first_sample, int samples)
{
    tr_frame *f = &r->frame;
    int tiles = f->tiles_x * f->tiles_y, per_round = ROUND_PATHS / (TR_BATCH * samples);
    f->first_sample = first_sample;
    f->samples = samples;
    if (per_round < 1)
        per_round = 1;
    for (int first = 0; first < tiles; first += per_round) {
        int count = tiles - first < per_round ? tiles - first : per_round;
        r->round_tile = (uint64_t)first;
        tr_pool_run(r->pool, (uint32_t)count, 1, render_tiles, r);
        flush_records(r, r->frame.record);
    }
}

/* The photons that the method wants, after the camera paths of a pass, which have told where light is looked for. False
   = out of memory. */
static bool shoot_photons(render_state *r, const tr_pass *info)
{
    const tr_method *m = r->settings->method;
    uint64_t total = m->wants_photons && m->record_photons ? m->wants_photons(r->frame.method_data, info) : 0;
    bool ok = true;
    for (uint64_t first = 0; ok && first < total; first += ROUND_PATHS) {
        tr_photon_pass pass = {.scene = r->frame.scene,
                               .emission = m->emission ? m->emission(r->frame.method_data) : NULL,
                               .seed = r->settings->seed,
                               .index = info->index,
                               .total = total,
                               .first = first,
                               .count = (uint32_t)(total - first < ROUND_PATHS ? total - first : ROUND_PATHS),
                               .max_depth = r->frame.max_depth,
                               .nee = r->frame.nee,
                               .parallel = tr_pool_run,
                               .parallel_user = r->pool};
        double start = tr_cpu_seconds();
        ok = tr_trace_photons(&pass, m->record_photons, r->frame.method_data, &r->photons);
        r->photon_cpu += tr_cpu_seconds() - start;
        flush_records(r, ok);
    }
    return ok;
}

static int samples_per_round(const render_state *r)
{
    size_t n = ROUND_PATHS / pixel_count(r);
    return n < 1 ? 1 : n > 64 ? 64 : (int)n;
}

/* ---- >>combine ---------------------------------------------------------------------------------------------- */

/* Move the `keep` smallest of n values to the front (Hoare's selection, middle pivot). */
static void select_smallest(double *value, size_t n, size_t keep)
{
    size_t lo = 0, hi = n;
    while (hi - lo > 1 && keep > lo && keep < hi) {
        double pivot = value[lo + (hi - lo) / 2];
        size_t i = lo, j = hi - 1;
        for (;;) {
            while (value[i] < pivot)
                ++i;
            while (value[j] > pivot)
                --j;
            if (i >= j)
                break;
            double t = value[i];
            value[i++] = value[j];
            value[j--] = t;
        }
        size_t middle = value[i] < pivot ? i + 1 : i; /* [lo, middle) <= pivot <= [middle, hi) */
        if (middle == lo)
            middle = lo + 1;
        if (keep <= middle)
            hi = middle;
        if (keep >= middle)
            lo = middle;
    }
}

/* Mean over pixels of the per-sample variance over (estimate^2 + floor^2), without the worst 0.1 % of pixels: the
   error measure's own scale. Negative = too few samples to tell. */
static double relative_variance(const render_state *r, const double *sums, const double *sum_squares, int spp)
{
    size_t n = pixel_count(r);
    if (spp < 2)
        return -1;
    double *value = malloc(n * sizeof *value), mean = 0;
    if (!value)
        return -1;
    for (size_t i = 0; i < 3 * n; ++i)
        mean += r->estimate.data[i];
    mean /= 3.0 * (double)n;
    double floor2 = 0.04 * mean * mean + 1e-30;
    for (size_t i = 0; i < n; ++i) {
        value[i] = 0;
        for (size_t c = 3 * i; c < 3 * i + 3; ++c) {
            double m = sums[c] / spp, v = (sum_squares[c] / spp - m * m) * spp / (spp - 1.0);
            value[i] += (v > 0 ? v : 0) / ((double)r->estimate.data[c] * r->estimate.data[c] + floor2) / 3;
        }
    }
    size_t keep = n - n / 1000;
    select_smallest(value, n, keep);
    double sum = 0;
    for (size_t i = 0; i < keep; ++i)
        sum += value[i];
    free(value);
    return sum / (double)keep;
}

/* Weight of a group = samples / variance. Learning only lowers the variance of a sample, while an early pass of a hard
   scene has often not seen its light yet and looks quiet: so a group counts as at least as noisy as every later one.
   A group of a single sample has no variance to tell and counts only when it is alone. */
static void weigh_groups(render_state *r)
{
    double worst = 0;
    bool any = false;
    for (int i = r->group_count - 1; i >= 0; --i) {
        group *g = &r->groups[i];
        g->variance = relative_variance(r, g->sum, g->sum_squares, g->spp);
        g->weight = 0;
        if (g->spp < 1 || (g->variance < 0 && r->group_count > 1))
            continue;
        worst = g->variance > worst ? g->variance : worst;
        g->weight = g->spp / (worst > 1e-12 ? worst : 1e-12);
        any = true;
    }
    if (!any)
        r->groups[r->group_count - 1].weight = 1;
}

/* Combine the groups into r->combined and the variance of that mean into r->variance. */
static void combine(render_state *r)
{
    size_t n = 3 * pixel_count(r);
    double total = 0;
    for (int i = 0; i < r->group_count; ++i)
        total += r->groups[i].weight;
    for (size_t c = 0; c < n; ++c) {
        double value = 0, variance = 0;
        for (int i = 0; i < r->group_count; ++i) {
            const group *g = &r->groups[i];
            if (!(g->weight > 0))
                continue;
            double w = g->weight / total, m = g->sum[c] / g->spp;
            value += w * m;
            if (g->spp > 1) {
                double v = (g->sum_squares[c] / g->spp - m * m) / (g->spp - 1.0);
                variance += w * w * (v > 0 ? v : 0);
            }
        }
        r->combined.data[c] = (float)value;
        r->variance.data[c] = (float)variance;
    }
}

/* ---- >>estimate --------------------------------------------------------------------------------------------- */

/* One box filter of 2 radius + 1 pixels along one axis; step and stride in floats. Shrinks at the border. */
static void box_line(const float *in, float *out, int count, size_t stride, int radius)
{
    double sum = 0;
    int lo = 0, hi = 0; /* window [lo, hi) */
    for (int i = 0; i < count; ++i) {
        for (; hi < count && hi <= i + radius; ++hi)
            sum += in[(size_t)hi * stride];
        for (; lo < i - radius; ++lo)
            sum -= in[(size_t)lo * stride];
        out[(size_t)i * stride] = (float)(sum / (hi - lo));
    }
}

/* The pixel estimate: the image so far under three box filters, wider the more pixels are still black. */
static bool estimate_pixels(render_state *r)
{
    int w = r->frame.width, h = r->frame.height;
    size_t n = pixel_count(r), black = 0;
    float *scratch = malloc(3 * n * sizeof *scratch), *out = r->estimate.data;
    if (!scratch)
        return false;
    for (size_t i = 0; i < n; ++i) {
        const float *p = r->combined.data + 3 * i;
        black += !(p[0] + p[1] + p[2] > 0);
    }
    int radius = 1 + (int)(8 * (double)black / (double)n);
    memcpy(out, r->combined.data, 3 * n * sizeof *out);
    for (int iteration = 0; iteration < 3; ++iteration)
        for (int c = 0; c < 3; ++c) {
            for (int y = 0; y < h; ++y)
                box_line(out + 3 * (size_t)y * (size_t)w + c, scratch + 3 * (size_t)y * (size_t)w + c, w, 3, radius);
            for (int x = 0; x < w; ++x)
                box_line(scratch + 3 * (size_t)x + c, out + 3 * (size_t)x + c, h, 3 * (size_t)w, radius);
        }
    free(scratch);
    double mean = 0;
    for (size_t i = 0; i < 3 * n; ++i) {
        out[i] = out[i] > 0 ? out[i] : 0;
        mean += out[i];
    }
    mean /= 3.0 * (double)n;
    /* The error measure divides by sqrt(R^2 + 0.1^2) with mean(R) = 0.5: the same floor here. */
    r->frame.estimate_floor = mean > 0 ? (float)(0.2 * mean) : 1;
    return true;
}

/* ---- >>trend ------------------------------------------------------------------------------------------------

   Let a sample's variance fall like N^-b with the samples N that were learned from, and let learning take the share c
   of a pass's time. Teaching for a moment dt more lowers the variance of all that is left by b dt / spent, and loses c
   dt of the samples: it pays while b left / spent > c. */

#define TREND_LEAST 6   /* passes that make a trend */
#define TREND_SURE 2.1  /* standard errors above the slope: 95 % of six passes */
#define TREND_SPAN 3    /* it looks back to a third of the samples, or to those passes */
#define TREND_SOONEST 8 /* at least that share of the budget teaches */
#define TREND_RISE 1.5  /* of variance, at which a field that rests has met new light */

void tr_trend_add(tr_trend *t, double learned, double variance)
{
    if (!(learned > 0) || !(variance > 0))
        return;
    if (t->count == TR_TREND_MAX) {
        t->count--;
        memmove(t->learned, t->learned + 1, (size_t)t->count * sizeof *t->learned);
        memmove(t->variance, t->variance + 1, (size_t)t->count * sizeof *t->variance);
    }
    t->learned[t->count] = learned;
    t->variance[t->count++] = variance;
}

/* The trend's b: slope of the line through the logarithms, and its standard error. False = too few passes. A variance
   that rises is one of rare light, which is only being found: it tells as little as one that scatters. */
static bool trend_slope(const tr_trend *t, double *slope, double *error)
{
    double x[TR_TREND_MAX], y[TR_TREND_MAX], mx = 0, my = 0, xx = 0, xy = 0, yy = 0;
    int n = 0;
    for (int i = t->count; i-- > 0 && (n < TREND_LEAST || t->learned[i] * TREND_SPAN >= t->learned[t->count - 1]);
         ++n) {
        mx += x[n] = log(t->learned[i]);
        my += y[n] = log(t->variance[i]);
    }
    for (int i = 0; i < n; ++i) {
        double dx = x[i] - mx / n, dy = y[i] - my / n;
        xx += dx * dx;
        xy += dx * dy;
        yy += dy * dy;
    }
    if (n < TREND_LEAST || !(xx > 0))
        return false;
    *slope = xy / xx;
    *error = sqrt(fmax(0, yy - xy * *slope) / ((n - 2) * xx));
    return true;
}

bool tr_learning_pays(const tr_trend *t, double spent, double left, double share)
{
    double slope, error;
    if (spent * (TREND_SOONEST - 1) < left || !trend_slope(t, &slope, &error))
        return true;
    return (fabs(slope) + TREND_SURE * error) * left > share * spent;
}

/* What has been spent so far, in all and on learning; workers count wall-clock seconds. */
typedef struct pass_clock {
    double cpu, update, photon, workers, record;
} pass_clock;

static pass_clock read_clock(const render_state *r)
{
    pass_clock t = {.cpu = cpu_used(r), .update = r->update_cpu, .photon = r->photon_cpu};
    for (int i = 0; i < r->worker_count; ++i) {
        const tr_counters *c = tr_worker_counters(r->workers[i]);
        t.workers += c->total;
        t.record += c->record;
    }
    return t;
}

/* Decide whether the next pass of a timed render teaches. */
static bool pass_teaches(render_state *r)
{
    const tr_settings *s = r->settings;
    if (!s->method->learns || s->train > 0 || s->seconds <= 0)
        return true;
    if (r->rest <= 0 && !tr_learning_pays(&r->trend, r->learning_cpu, s->seconds - cpu_used(r), r->learning))
        r->rest = r->trend.variance[r->trend.count - 1];
    return r->rest <= 0;
}

/* What a pass tells about the next: the variance of its samples, and how much of its time learning from them took. */
static void watch_pass(render_state *r, const pass_clock *before, double variance, bool taught)
{
    pass_clock now = read_clock(r);
    double cpu = now.cpu - before->cpu, workers = now.workers - before->workers;
    double update = now.update - before->update + now.photon - before->photon;
    if (taught && cpu > 0) {
        double record = workers > 0 ? (now.record - before->record) / workers * fmax(0, cpu - update) : 0;
        tr_trend_add(&r->trend, r->learned, variance);
        r->learning = (update + record) / cpu;
        r->learning_cpu += cpu;
    } else if (r->rest > 0 && variance > TREND_RISE * r->rest) {
        r->rest = 0;
        r->trend.count = 0;
    }
}

/* ---- >>loop ------------------------------------------------------------------------------------------------- */

static bool fail(char *err, size_t err_size, const char *text)
{
    if (err_size && !err[0])
        snprintf(err, err_size, "%s", text);
    return false;
}

static void *zalloc(size_t count, size_t size) { return calloc(count ? count : 1, size); }

static bool allocate(render_state *r)
{
    tr_frame *f = &r->frame;
    tr_result *res = r->result;
    size_t n = pixel_count(r);
    f->sum = zalloc(3 * n, sizeof(double));
    f->sum_squares = zalloc(3 * n, sizeof(double));
    f->alpha_count = zalloc(n, sizeof(float));
    bool ok = f->sum && f->sum_squares && f->alpha_count;
    struct {
        tr_image *image;
        int channels;
    } images[] = {{&r->estimate, 3}, {&res->color, 3}, {&res->variance, 3}, {&res->albedo, 3},
                  {&res->normal, 3}, {&res->alpha, 1}, {&res->cell, 1},     {&res->depth, 1}};
    for (size_t i = 0; i < sizeof images / sizeof images[0]; ++i)
        ok = tr_image_alloc(images[i].image, f->width, f->height, images[i].channels) && ok;
    if (!ok)
        return false;
    r->combined = res->color; /* the same pixels: the combined image is the result */
    r->variance = res->variance;
    f->albedo = res->albedo.data;
    f->normal = res->normal.data;
    f->alpha = res->alpha.data;
    f->cell = res->cell.data;
    f->depth = res->depth.data;
    int threads = r->settings->threads > 0 ? r->settings->threads : tr_cpu_count();
    r->pool = tr_pool_create(threads);
    r->workers = zalloc((size_t)threads, sizeof *r->workers);
    r->idle = zalloc((size_t)threads, sizeof *r->idle);
    return r->pool && r->workers && r->idle;
}

static bool allocate_workers(render_state *r)
{
    int threads = r->settings->threads > 0 ? r->settings->threads : tr_cpu_count();
    for (; r->worker_count < threads; ++r->worker_count) {
        tr_worker *w = tr_worker_create(&r->frame);
        if (!w)
            return false;
        r->workers[r->worker_count] = w;
        r->idle[r->idle_count++] = w;
    }
    return true;
}

static void drop_groups(render_state *r)
{
    for (int i = 0; i < r->group_count; ++i) {
        free(r->groups[i].sum);
        free(r->groups[i].sum_squares);
    }
    memset(r->groups, 0, sizeof r->groups);
    r->group_count = 0;
}

static void release(render_state *r)
{
    for (int i = 0; i < r->worker_count; ++i)
        tr_worker_destroy(r->workers[i]);
    drop_groups(r);
    if (r->frame.method_data)
        r->settings->method->destroy(r->frame.method_data);
    tr_pool_destroy(r->pool);
    free(r->workers);
    free(r->idle);
    free(r->frame.sum);
    free(r->frame.sum_squares);
    free(r->frame.alpha_count);
    tr_image_free(&r->estimate);
    pthread_mutex_destroy(&r->lock);
}

static uint64_t total_guided(const render_state *r)
{
    uint64_t n = 0;
    for (int i = 0; i < r->worker_count; ++i)
        n += tr_worker_counters(r->workers[i])->guided_vertices;
    return n;
}

/* Close a pass of spp samples after done_spp earlier ones: its sums join the last group or become one. */
static bool close_pass(render_state *r, int done_spp, int spp, bool guided)
{
    size_t n = 3 * pixel_count(r);
    tr_frame *f = &r->frame;
    group *g = r->group_count ? &r->groups[r->group_count - 1] : NULL;
    /* Passes grow slowly, and so does what they know: a new group begins where the image has twice the samples that it
       had when the last one began. */
    bool join = g && (!r->settings->method->learns || (!g->guided && !guided) ||
                      (g->guided && guided && done_spp < 2 * g->first_spp) || r->group_count == MAX_GROUPS);
    if (!join) {
        g = &r->groups[r->group_count];
        g->sum = zalloc(n, sizeof(double));
        g->sum_squares = zalloc(n, sizeof(double));
        r->group_count++; /* even when memory is out: release frees both */
        if (!g->sum || !g->sum_squares)
            return false;
        g->guided = guided;
        g->first_spp = done_spp > 1 ? done_spp : 1;
    }
    for (size_t i = 0; i < n; ++i) {
        g->sum[i] += f->sum[i];
        g->sum_squares[i] += f->sum_squares[i];
    }
    g->spp += spp;
    memset(f->sum, 0, n * sizeof *f->sum);
    memset(f->sum_squares, 0, n * sizeof *f->sum_squares);
    weigh_groups(r);
    combine(r);
    return estimate_pixels(r);
}

static void report(const render_state *r, double done, int spp, int pass)
{
    char text[128];
    if (!r->settings->progress)
        return;
    snprintf(text, sizeof text, "pass %d, %d spp, %.1f CPU s", pass, spp, cpu_used(r));
    r->settings->progress(r->settings->progress_user, done > 1 ? 1 : done, text);
}

/* Share of the budget that is spent. */
static double share_done(const render_state *r)
{
    const tr_settings *s = r->settings;
    return s->seconds > 0 ? cpu_used(r) / s->seconds : (double)r->done / ((double)s->train + s->spp);
}

/* Render one pass of up to `spp` samples; fewer where the CPU budget ends, which a training does not look at. Returns
   the samples taken. */
static int run_pass(render_state *r, int pass, int spp)
{
    const tr_settings *s = r->settings;
    int step = samples_per_round(r), taken = 0;
    bool timed = s->seconds > 0 && (s->train == 0 || r->frozen);
    while (taken < spp && !r->out_of_time) {
        int count = spp - taken < step ? spp - taken : step;
        double before = cpu_used(r);
        r->frame.describe = taken == 0;
        render_samples(r, (uint64_t)r->done, count);
        taken += count;
        r->done += count;
        double now = cpu_used(r), round = now - before;
        r->out_of_time = timed && now + 0.5 * round >= s->seconds;
        report(r, share_done(r), r->done, pass);
    }
    return taken;
}

static bool learn(render_state *r, const tr_pass *pass)
{
    const tr_method *m = r->settings->method;
    double start = tr_cpu_seconds();
    bool ok = true;
    if (m->wants_pixel_estimate && m->set_pixel_estimate)
        m->set_pixel_estimate(r->frame.method_data, &r->estimate);
    if (m->end_pass)
        ok = m->end_pass(r->frame.method_data, pass);
    r->update_cpu += tr_cpu_seconds() - start;
    if (m->learns)
        r->result->train_seconds = cpu_used(r);
    return ok;
}

/* Samples of a pass. Guiding learns in generations, each from paths that the one before has guided; sums live on from
   pass to pass, so passes need not double: a quarter of all before. Where nothing is guided they do. */
static int pass_spp(int done_spp, bool guided)
{
    int spp = guided ? done_spp / GROWTH : done_spp;
    return spp < 1 ? 1 : spp < 1 << 24 ? spp : 1 << 24;
}

/* Samples for the next pass of a phase that ends at `limit` samples, or with the CPU budget where that is 0. A timed
   pass, or one of a training, takes the rest where it would leave too little for a full next one: what a training ends
   with is to meet most cells. `last` tells. */
static int plan_pass(const render_state *r, int limit, bool *last)
{
    int spp = pass_spp(r->done, r->guided);
    if (limit > 0) {
        int left = limit - r->done, next = pass_spp(r->done + spp, r->guided);
        *last = r->frozen || spp >= left || (r->settings->train > 0 && spp + next > left);
        return *last ? left : spp;
    }
    double left = r->settings->seconds - cpu_used(r);
    *last = r->frozen || (r->cost > 0 && r->cost * spp >= left);
    return *last ? 1 << 24 : spp;
}

/* Plan a pass, render it, learn from it. False = out of memory. */
static bool next_pass(render_state *r, int limit)
{
    const tr_method *m = r->settings->method;
    tr_result *res = r->result;
    int pass = res->passes++;
    bool training = r->settings->train > 0 && !r->frozen;
    tr_pass info = {.index = pass, .budget = share_done(r)};
    info.spp = plan_pass(r, limit, &info.last);
    info.freezes = training && info.last;
    info.last = !training && (info.last || !pass_teaches(r));
    bool teaches = !info.last;
    pass_clock before = read_clock(r);
    uint64_t guided_before = total_guided(r);
    r->frame.record = m->begin_pass ? m->begin_pass(r->frame.method_data, &info) : m->record != NULL;
    r->frame.guiding = m->find && !(m->idle && m->idle(r->frame.method_data));
    r->frame.estimate = m->wants_pixel_estimate && pass > 0 ? &r->estimate : NULL;
    info.spp = run_pass(r, pass, info.spp);
    r->cost = (cpu_used(r) - before.cpu) / info.spp;
    r->guided = total_guided(r) > guided_before;
    double variance = relative_variance(r, r->frame.sum, r->frame.sum_squares, info.spp);
    bool ok = close_pass(r, r->done - info.spp, info.spp, r->guided);
    if (ok && !info.last && !r->out_of_time)
        ok = shoot_photons(r, &info) && learn(r, &info);
    watch_pass(r, &before, variance, teaches);
    r->learned += teaches ? info.spp : 0;
    res->pass[pass].spp = info.spp;
    res->pass[pass].cpu_seconds = cpu_used(r) - before.cpu;
    res->pass[pass].variance = variance;
    return ok;
}

static bool run_phase(render_state *r, int limit)
{
    bool ok = true;
    while (ok && r->result->passes < TR_MAX_PASSES && !r->out_of_time && (limit <= 0 || r->done < limit))
        ok = next_pass(r, limit);
    return ok;
}

/* The training is over: what it has rendered leaves the picture and its layers, and stays only as pixel estimate. */
static void freeze(render_state *r)
{
    tr_frame *f = &r->frame;
    size_t n = pixel_count(r);
    r->frozen = true;
    r->result->train_passes = r->result->passes;
    drop_groups(r);
    memset(f->albedo, 0, 3 * n * sizeof *f->albedo);
    memset(f->normal, 0, 3 * n * sizeof *f->normal);
    memset(f->alpha, 0, n * sizeof *f->alpha);
    memset(f->alpha_count, 0, n * sizeof *f->alpha_count);
}

static bool run_passes(render_state *r, char *err, size_t err_size)
{
    const tr_settings *s = r->settings;
    bool ok = s->train == 0 || run_phase(r, s->train);
    if (ok && s->train > 0) {
        freeze(r);
        if (s->seconds > 0 && cpu_used(r) >= s->seconds) {
            snprintf(err, err_size, "the training of %d samples per pixel alone took %.3g CPU seconds: nothing is left",
                     s->train, cpu_used(r));
            return false;
        }
    }
    ok = ok && run_phase(r, s->spp > 0 ? s->train + s->spp : 0);
    r->result->spp = r->done - s->train;
    return ok || fail(err, err_size, "out of memory while rendering");
}

static void finish_layers(render_state *r)
{
    tr_result *res = r->result;
    float scale = res->spp > 0 ? 1.0f / (float)res->spp : 0;
    for (size_t i = 0; i < 3 * pixel_count(r); ++i) {
        res->albedo.data[i] *= scale;
        res->normal.data[i] *= scale;
    }
    for (size_t i = 0; i < pixel_count(r); ++i)
        res->alpha.data[i] = r->frame.alpha_count[i] > 0 ? res->alpha.data[i] / r->frame.alpha_count[i] : 1;
}

/* Stage times are taken on the wall clock of each worker, cheap enough for every batch; they are scaled so that they
   add up to the CPU time really used. */
static bool collect(render_state *r)
{
    tr_result *res = r->result;
    tr_counters sum = {0};
    for (int i = 0; i < r->worker_count; ++i) {
        const tr_counters *c = tr_worker_counters(r->workers[i]);
        sum.trace += c->trace;
        sum.record += c->record;
        sum.query += c->query;
        sum.total += c->total;
        sum.rays += c->rays;
        sum.shadow_rays += c->shadow_rays;
        sum.paths += c->paths;
        sum.split_paths += c->split_paths;
        sum.unsplit_paths += c->unsplit_paths;
        sum.bad_samples += c->bad_samples;
        sum.out_of_memory |= c->out_of_memory;
    }
    double workers_cpu = res->cpu_seconds - r->update_cpu - r->photon_cpu;
    double scale = sum.total > 0 ? workers_cpu / sum.total : 0;
    res->trace_seconds = sum.trace * scale;
    res->record_seconds = sum.record * scale;
    res->query_seconds = sum.query * scale;
    res->update_seconds = r->update_cpu;
    res->photon_seconds = r->photon_cpu;
    res->photon_paths = r->photons.paths;
    res->photon_rays = r->photons.rays;
    res->photons = r->photons.photons;
    res->rays = sum.rays;
    res->shadow_rays = sum.shadow_rays;
    res->paths = sum.paths;
    res->split_paths = sum.split_paths;
    res->unsplit_paths = sum.unsplit_paths;
    res->bad_samples = sum.bad_samples + r->photons.bad;
    double total = 0;
    for (int i = 0; i < r->group_count; ++i)
        total += r->groups[i].weight;
    for (int i = res->train_passes, g = 0, spp = 0; i < res->passes; ++i) {
        res->pass[i].weight = r->groups[g].weight / total * res->pass[i].spp / r->groups[g].spp;
        spp += res->pass[i].spp;
        if (spp >= r->groups[g].spp && g + 1 < r->group_count)
            ++g, spp = 0;
    }
    if (r->settings->method->stats)
        r->settings->method->stats(r->frame.method_data, &res->method);
    return !sum.out_of_memory;
}

static bool create_method(render_state *r, char *err, size_t err_size)
{
    const tr_settings *s = r->settings;
    tr_method_env env = {.scene = r->frame.scene,
                         .width = r->frame.width,
                         .height = r->frame.height,
                         .tiles = r->frame.tiles_x * r->frame.tiles_y,
                         .photon_tiles = tr_photon_tiles(ROUND_PATHS),
                         .nee = r->frame.nee,
                         .train = s->train,
                         .seed = s->seed,
                         .threads = s->threads > 0 ? s->threads : tr_cpu_count(),
                         .parallel = tr_pool_run,
                         .parallel_user = r->pool,
                         .options = s->options,
                         .option_count = s->option_count};
    const tr_method *m = s->method;
    r->frame.method_data = m->create(&env, err, err_size);
    if (!r->frame.method_data)
        return fail(err, err_size, "the method could not start: out of memory");
    r->frame.candidates = m->candidates && m->resample ? m->candidates(r->frame.method_data) : 1;
    if (r->frame.candidates < 1 || r->frame.candidates > TR_MAX_CANDIDATES)
        return fail(err, err_size, "the method wants no candidates, or too many");
    for (int i = 0; i < s->option_count; ++i)
        if (!s->options[i].used) {
            snprintf(err, err_size, "--set %s: method '%s' has no such option", s->options[i].key, s->method->name);
            return false;
        }
    return true;
}

bool tr_render(const tr_scene *scene, const tr_settings *settings, tr_result *result, char *err, size_t err_size)
{
    render_state r;
    memset(&r, 0, sizeof r);
    memset(result, 0, sizeof *result);
    if (err_size)
        err[0] = 0;
    pthread_mutex_init(&r.lock, NULL);
    r.settings = settings;
    r.result = result;
    tr_frame *f = &r.frame;
    f->scene = scene;
    f->settings = settings;
    f->method = settings->method;
    f->width = settings->width > 0 ? settings->width : scene->width;
    f->height = settings->height > 0 ? settings->height : scene->height;
    f->tiles_x = (f->width + TR_TILE_W - 1) / TR_TILE_W;
    f->tiles_y = (f->height + TR_TILE_H - 1) / TR_TILE_H;
    f->max_depth = settings->max_depth > 0 ? settings->max_depth : scene->max_depth;
    if (f->max_depth < 0 || f->max_depth > TR_MAX_DEPTH)
        f->max_depth = TR_MAX_DEPTH;
    f->nee = !settings->no_nee;
    bool ok = settings->spp > 0 || settings->seconds > 0;
    if (!ok)
        fail(err, err_size, "no budget: give samples per pixel or CPU seconds");
    if (ok && settings->train > 0 && !settings->method->learns) {
        snprintf(err, err_size, "nothing to train: method '%s' does not learn", settings->method->name);
        ok = false;
    }
    if (ok && !(ok = allocate(&r)))
        fail(err, err_size, "out of memory for the image");
    double wall = tr_wall_seconds();
    r.start_cpu = tr_cpu_seconds();
    ok = ok && create_method(&r, err, err_size);
    if (ok && !(ok = allocate_workers(&r)))
        fail(err, err_size, "out of memory for the workers");
    ok = ok && run_passes(&r, err, err_size);
    if (ok) {
        finish_layers(&r);
        result->cpu_seconds = cpu_used(&r);
        result->wall_seconds = tr_wall_seconds() - wall;
        if (!(ok = collect(&r)))
            fail(err, err_size, "out of memory for path records");
    }
    release(&r);
    if (!ok)
        tr_result_free(result);
    return ok;
}

void tr_result_free(tr_result *result)
{
    tr_image *images[] = {&result->color, &result->variance, &result->albedo, &result->normal,
                          &result->alpha, &result->cell,     &result->depth};
    for (size_t i = 0; i < sizeof images / sizeof images[0]; ++i)
        tr_image_free(images[i]);
}
