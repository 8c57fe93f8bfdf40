/* method_openpgl.cpp: Intel Open PGL as a method of the example renderer, to compare with. Built where
   `make OPENPGL_DIR=/path` names an installation; uses nothing but its public headers.

   Options (--set key=value), defaults as in Open PGL: distribution=pavmm|vmm|quadtree (pavmm: parallax-aware mixture),
   leaf_size (samples of a cell before it splits, 32000), knn=on|off (stochastic lookup among near cells),
   deterministic=on|off, product=on|off (with the cosine, mixtures only), alpha (probability of bsdf sampling, 0.5).

   Guided Russian roulette asks for the radiance that a surface reflects. Open PGL tells that only where it was built
   with radiance caches, which it is not by default: the adapter keeps a grid of its own. */
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <string>
#include <vector>

#include "openpgl_common.h"

#include "embree.h"
extern "C" {
#include "tracer.h"
extern const tr_method tr_method_openpgl;
}

namespace
{

/* What PathSegmentStorage does to the samples it makes: densities below min_pdf are raised to it, and light from the
   environment counts as coming from afar. */
const float min_pdf = 0.01f;
const float far_away = 1e6f;
/* Learn within a pass when it has recorded as much: bounds the memory. */
const size_t most_samples = (size_t)1 << 22;

/* A lookup's slot. Slots are the workers' memory, zero at first and never handed back: the distribution stays with its
   slot, for it is large and slow to allocate, and the method frees it. */
struct slot {
    pgl::SurfaceSamplingDistribution *own,
        *distribution; /* its own, and the one to ask: where a path was split, another's */
    float reflected;
};

/* Mean of the radiance that surfaces reflect, in boxes of a grid over the scene, and in larger boxes where a box has
   met too few paths. Workers write one list a tile; the lists are added up in the order of tiles, so that sums do not
   depend on threads.

   Where light is rare, the mean of a few paths is mostly too low, and roulette then ends paths that matter. On ajar (20
   s, cells of 4,000 samples) relMSE is 0.91 with 128 boxes an axis and 32 paths, 0.42 with 64 and 32, 0.39 with 64 and
   1,000 or 4,000. */
struct reflected_grid {
    static const int levels = 4, finest = 64; /* boxes along an axis: 64, 32, 16, 8 */
    static const uint32_t enough = 1000;      /* paths for a mean to count */

    struct entry {
        uint32_t box; /* of the finest grid */
        float value;
    };
    struct total {
        double sum;
        uint64_t count;
    };

    vec3 low, scale;
    std::vector<std::vector<entry>> lists; /* one a tile */
    std::vector<total> totals;             /* of the finest grid, over all passes */
    std::vector<float> mean;               /* what queries read; 0 = not known */

    reflected_grid(const tr_scene *scene, int tiles)
        : low(scene->bounds_min), lists((size_t)tiles), totals((size_t)finest * finest * finest), mean(totals.size())
    {
        vec3 size = sub3(scene->bounds_max, low);
        scale = v3(per(size.x), per(size.y), per(size.z));
    }

    static float per(float size) { return size > 0 ? (float)finest / size : 0; }
    static uint32_t along(float at) { return at > 0 ? at < (float)finest ? (uint32_t)at : finest - 1 : 0; }

    uint32_t box_of(vec3 p) const
    {
        vec3 at = mul3(sub3(p, low), scale);
        return (along(at.z) * finest + along(at.y)) * finest + along(at.x);
    }

    void add(int tile, const tr_vertex *v)
    {
        float value = mean3(mul3(v->f, v->L)) * v->cosine / v->pdf_mix;
        if (std::isfinite(value) && value >= 0)
            lists[(size_t)tile].push_back({box_of(v->p), value});
    }

    void sum_up()
    {
        for (std::vector<entry> &list : lists) {
            for (const entry &e : list) {
                totals[e.box].sum += (double)e.value;
                totals[e.box].count++;
            }
            list.clear();
        }
    }

    /* Means of the smallest boxes that have met enough paths. */
    void publish()
    {
        std::vector<total> grid = totals;
        std::fill(mean.begin(), mean.end(), 0.0f);
        for (int level = 0; level < levels; ++level) {
            size_t side = (size_t)(finest >> level);
            for (size_t i = 0; i < mean.size(); ++i) {
                const total &t = grid[box_at(i, level)];
                if (mean[i] <= 0 && t.count >= enough)
                    mean[i] = (float)(t.sum / (double)t.count);
            }
            std::vector<total> coarser(side * side * side / 8);
            for (size_t i = 0; i < grid.size(); ++i) {
                size_t x = i % side, y = i / side % side, z = i / side / side;
                total &t = coarser[(z / 2 * (side / 2) + y / 2) * (side / 2) + x / 2];
                t.sum += grid[i].sum;
                t.count += grid[i].count;
            }
            grid.swap(coarser);
        }
    }

    /* Where box i of the finest grid lies in a coarser one. */
    static size_t box_at(size_t i, int level)
    {
        size_t side = (size_t)(finest >> level);
        size_t x = i % finest >> level, y = i / finest % finest >> level, z = i / finest / finest >> level;
        return (z * side + y) * side + x;
    }

    size_t bytes() const { return totals.size() * sizeof(total) + mean.size() * sizeof(float); }
};

struct method {
    std::unique_ptr<pgl::Device> device;
    std::unique_ptr<pgl::Field> field;
    std::unique_ptr<pgl::SampleStorage> storage; /* takes samples from several threads */
    std::unique_ptr<reflected_grid> reflected;
    std::vector<std::unique_ptr<pgl::SurfaceSamplingDistribution>> pool;
    std::mutex pool_lock;
    std::atomic<uint64_t> refused{0}; /* directions not traced, or samples not finite */
    uint64_t samples = 0, zeros = 0;
    size_t stored_peak = 0; /* bytes */
    unsigned updates = 0;
    float alpha = 0.5f;
    bool product = true, quadtree = false;
};

pgl_vec3f vector(vec3 a) { return {a.x, a.y, a.z}; }

/* ---- options */

struct parser {
    tr_method_env *env;
    std::string error;

    const char *option(const char *key)
    {
        for (int i = 0; i < env->option_count; ++i)
            if (!strcmp(env->options[i].key, key)) {
                env->options[i].used = true;
                return env->options[i].value;
            }
        return nullptr;
    }

    void complain(const char *key, const char *value, const std::string &expected)
    {
        if (error.empty())
            error = std::string("--set ") + key + "=" + value + ": expected " + expected;
    }

    /* Index of the value among the names, 0 where the option was not given. */
    size_t choice(const char *key, const std::vector<std::string> &names)
    {
        const char *value = option(key);
        std::string all;
        for (size_t i = 0; value && i < names.size(); ++i) {
            if (names[i] == value)
                return i;
            all += (i ? "|" : "") + names[i];
        }
        if (value)
            complain(key, value, all);
        return 0;
    }

    double number(const char *key, double fallback, double least, double most)
    {
        const char *value = option(key);
        if (!value)
            return fallback;
        char *end;
        double x = strtod(value, &end);
        if (end == value || *end || !(x >= least && x <= most)) {
            char range[80];
            snprintf(range, sizeof range, "a number from %g to %g", least, most);
            complain(key, value, range);
            return fallback;
        }
        return x;
    }
};

/* ---- life */

bool configure(method *m, tr_method_env *env, char *err, size_t err_size)
{
    static const PGL_DIRECTIONAL_DISTRIBUTION_TYPE types[] = {PGL_DIRECTIONAL_DISTRIBUTION_PARALLAX_AWARE_VMM,
                                                              PGL_DIRECTIONAL_DISTRIBUTION_VMM,
                                                              PGL_DIRECTIONAL_DISTRIBUTION_QUADTREE};
    parser p{env, {}};
    PGL_DIRECTIONAL_DISTRIBUTION_TYPE type = types[p.choice("distribution", {"pavmm", "vmm", "quadtree"})];
    size_t leaf_size = (size_t)p.number("leaf_size", PGL_TREE_MAX_SAMPLE_PER_LEAF, 16, 1e9);
    bool knn = p.choice("knn", {"on", "off"}) == 0, deterministic = p.choice("deterministic", {"on", "off"}) == 0;
    m->product = p.choice("product", {"on", "off"}) == 0;
    m->alpha = (float)p.number("alpha", 0.5, 0.01, 1); /* 0 would leave to the guide what it has not seen */
    m->quadtree = type == PGL_DIRECTIONAL_DISTRIBUTION_QUADTREE;
    if (!p.error.empty()) {
        snprintf(err, err_size, "%s", p.error.c_str());
        return false;
    }
    size_t threads = (size_t)(env->threads > 0 ? env->threads : 1);
    PGL_DEVICE_TYPE device = openpgl_device_type(threads);
    if (device == PGL_DEVICE_TYPE_NONE) {
        snprintf(err, err_size, "openpgl: the library has no code for this processor");
        return false;
    }
    m->device.reset(new pgl::Device(device, threads));
    pgl::FieldConfig config;
    config.Init(PGL_SPATIAL_STRUCTURE_KDTREE, type, deterministic, leaf_size);
    config.SetUseKnnLookup(knn);
    m->field.reset(new pgl::Field(m->device.get(), config));
    m->storage.reset(new pgl::SampleStorage);
    m->reflected.reset(new reflected_grid(env->scene, env->tiles));
    m->field->SetSceneBounds({vector(env->scene->bounds_min), vector(env->scene->bounds_max)});
    return true;
}

void destroy(void *data) { delete static_cast<method *>(data); }

void *create(tr_method_env *env, char *err, size_t err_size)
{
    method *m = nullptr;
    try {
        m = new method;
        if (configure(m, env, err, err_size))
            return m;
    } catch (const std::exception &e) {
        snprintf(err, err_size, "openpgl: %s", e.what());
    }
    delete m;
    return nullptr;
}

/* ---- passes */

bool begin_pass(void *, const tr_pass *pass) { return !pass->last; }

/* A traced direction is a sample; one that brought no light is counted apart, as Open PGL has it. Directions that were
   refused before tracing say nothing about the light there. */
bool record(void *data, int tile, const tr_vertex *vertices, int n)
try {
    method *m = static_cast<method *>(data);
    pgl::SampleData samples[64];
    size_t count = 0;
    uint64_t refused = 0;
    for (int i = 0; i < n; ++i) {
        const tr_vertex *v = &vertices[i];
        m->reflected->add(tile, v);
        float L = mean3(v->L), pdf = v->pdf_mix > min_pdf ? v->pdf_mix : min_pdf;
        float distance = v->distance < far_away ? v->distance : far_away;
        if ((v->flags & TR_VERTEX_REJECTED) || !std::isfinite(L / pdf) || !(L >= 0) || !(distance > 0)) {
            ++refused;
        } else if (L > 0) {
            pgl::SampleData s{};
            s.position = vector(v->p);
            s.direction = vector(v->wi);
            s.weight = L / pdf;
            s.pdf = pdf;
            s.distance = distance;
            samples[count++] = s;
        } else {
            pgl::ZeroValueSampleData s{};
            s.position = vector(v->p);
            s.direction = vector(v->wi);
            m->storage->AddZeroValueSample(s);
        }
        if (count == 64 || (i + 1 == n && count)) {
            m->storage->AddSamples(samples, count);
            count = 0;
        }
    }
    m->refused += refused;
    return true;
} catch (const std::bad_alloc &) {
    return false;
}

void learn(method *m)
{
    m->reflected->sum_up();
    m->reflected->publish();
    size_t samples = m->storage->GetSizeSurface(), zeros = m->storage->GetSizeZeroValueSurface();
    size_t bytes = samples * sizeof(pgl::SampleData) + zeros * sizeof(pgl::ZeroValueSampleData);
    if (samples == 0) /* nothing has been lit yet */
        return;
    m->stored_peak = bytes > m->stored_peak ? bytes : m->stored_peak;
    m->samples += samples;
    m->zeros += zeros;
    m->updates++;
    m->field->Update(*m->storage);
    m->storage->Clear();
}

void flush(void *data)
{
    method *m = static_cast<method *>(data);
    m->reflected->sum_up();
    if (m->storage->GetSizeSurface() + m->storage->GetSizeZeroValueSurface() >= most_samples)
        learn(m);
}

bool end_pass(void *data, const tr_pass *pass)
try {
    if (!pass->last)
        learn(static_cast<method *>(data));
    return true;
} catch (const std::bad_alloc &) {
    return false;
}

/* ---- queries: from several threads, while nothing learns */

bool idle(void *data) { return static_cast<method *>(data)->updates == 0; }

pgl::SurfaceSamplingDistribution *of_slot(method *m, slot *s)
{
    if (!s->own)
        try {
            std::unique_ptr<pgl::SurfaceSamplingDistribution> made(
                new pgl::SurfaceSamplingDistribution(m->field.get()));
            std::lock_guard<std::mutex> hold(m->pool_lock);
            m->pool.push_back(std::move(made));
            s->own = m->pool.back().get();
        } catch (const std::exception &) {
            return nullptr; /* unguided then */
        }
    return s->distribution = s->own;
}

void find(void *data, const tr_lookup *lookup, void *handles, float *alpha)
{
    method *m = static_cast<method *>(data);
    slot *slots = static_cast<slot *>(handles);
    for (int i = 0; i < lookup->n; ++i) {
        pgl::SurfaceSamplingDistribution *d = of_slot(m, &slots[i]);
        float u = lookup->u ? lookup->u[i][0] : -1; /* below 0: the cell itself */
        bool found = d && d->Init(m->field.get(), vector(lookup->p[i]), u);
        if (found && m->product && !m->quadtree && !black3(lookup->side[i]))
            d->ApplyCosineProduct(vector(lookup->side[i]));
        slots[i].reflected = m->reflected->mean[m->reflected->box_of(lookup->p[i])];
        alpha[i] = found ? m->alpha : 1;
    }
}

void copy_handle(void *to, const void *from)
{
    slot *s = static_cast<slot *>(to);
    s->distribution = static_cast<const slot *>(from)->distribution;
    s->reflected = static_cast<const slot *>(from)->reflected;
}

void reflected(void *, int n, const void *handles, float *radiance)
{
    const slot *slots = static_cast<const slot *>(handles);
    for (int i = 0; i < n; ++i)
        radiance[i] = slots[i].reflected;
}

float usable(float pdf) { return pdf > 0 && std::isfinite(pdf) ? pdf : 0; }

void sample(void *, int n, const int *index, const void *handles, const float (*u)[2], vec3 *wi, float *pdf)
{
    const slot *slots = static_cast<const slot *>(handles);
    for (int i = 0; i < n; ++i) {
        int k = index[i];
        pgl_vec3f d{0, 0, 1};
        pdf[k] = usable(slots[k].distribution->SamplePDF({u[k][0], u[k][1]}, d));
        wi[k] = norm3(v3(d.x, d.y, d.z));
    }
}

void pdf_of(void *, int n, const int *index, const void *handles, const vec3 *wi, float *pdf)
{
    const slot *slots = static_cast<const slot *>(handles);
    for (int i = 0; i < n; ++i)
        pdf[index[i]] = usable(slots[index[i]].distribution->PDF(vector(wi[index[i]])));
}

/* ---- reports */

/* Cell number; how deep it lies is not told. A slot without a distribution was never asked for. */
void describe(void *, int n, const void *handles, float *cell, float *depth)
{
    const slot *slots = static_cast<const slot *>(handles);
    for (int i = 0; i < n; ++i) {
        cell[i] = slots[i].distribution ? (float)slots[i].distribution->GetId() : 0;
        depth[i] = 0;
    }
}

void stats(void *data, tr_method_stats *out)
{
    method *m = static_cast<method *>(data);
    memset(out, 0, sizeof *out);
    out->samples = m->samples + m->zeros;
    out->refused = m->refused;
    out->extra_bytes = (double)(m->stored_peak + m->reflected->bytes());
    openpgl_size size;
    if (m->updates)
        size = openpgl_measure(*m->field);
    out->cells = size.cells;
    out->bytes = size.bytes;
    snprintf(out->json, sizeof out->json,
             "\"updates\": %u, \"zeros\": %llu, \"nodes\": %.0f, \"mean_components\": %.3f", m->updates,
             (unsigned long long)m->zeros, size.nodes, size.components);
}

tr_method describe_method()
{
    tr_method t = {};
    t.name = "openpgl";
    t.summary = "Intel Open PGL: a tree of directional mixtures";
    t.handle_size = sizeof(slot);
    t.learns = true;
    t.create = create;
    t.destroy = destroy;
    t.begin_pass = begin_pass;
    t.idle = idle;
    t.find = find;
    t.sample = sample;
    t.pdf = pdf_of;
    t.copy_handle = copy_handle;
    t.reflected = reflected;
    t.wants_pixel_estimate = true; /* that roulette compares with */
    t.record = record;
    t.flush = flush;
    t.end_pass = end_pass;
    t.describe = describe;
    t.stats = stats;
    return t;
}

} // namespace

const tr_method tr_method_openpgl = describe_method();
