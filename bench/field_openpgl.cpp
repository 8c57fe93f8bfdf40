/* field_openpgl.cpp: Intel Open PGL as methods of field.h, to compare with. Built where `make OPENPGL_DIR=/path` names
   an installation; uses nothing but its public headers.

   A stochastic lookup among near cells (kNN) takes its random number from the position, so that samples and densities
   of a place speak of the same cell. One thread. */
#include <cmath>
#include <cstring>
#include <exception>
#include <memory>
#include <new>

#include "openpgl_common.h"

extern "C" {
#include "field_openpgl.h"
}

namespace
{

struct field_openpgl {
    std::unique_ptr<pgl::Device> device;
    std::unique_ptr<pgl::Field> field;
    std::unique_ptr<pgl::SampleStorage> storage;
    std::unique_ptr<pgl::SurfaceSamplingDistribution> distribution; /* of the last lookup */
    bool quadtree = false, learned = false, found = false;
    bool kept = false; /* the last lookup was of `place`: many densities are asked for one place */
    float place[6];    /* position, normal or 0 */
};

void destroy(void *state) { delete static_cast<field_openpgl *>(state); }

/* What went wrong in a call that may throw, told until the next one. */
const char *told(const std::exception &e)
{
    static char text[200];
    strncpy(text, e.what(), sizeof text - 1);
    return text;
}

void *create(double extent, PGL_DIRECTIONAL_DISTRIBUTION_TYPE type, size_t leaf_size, bool knn)
{
    std::unique_ptr<field_openpgl> t;
    try {
        t.reset(new field_openpgl);
        t->quadtree = type == PGL_DIRECTIONAL_DISTRIBUTION_QUADTREE;
        t->device.reset(new pgl::Device(openpgl_device_type(1), 1));
        pgl::FieldConfig config;
        config.Init(PGL_SPATIAL_STRUCTURE_KDTREE, type, true, leaf_size);
        config.SetUseKnnLookup(knn);
        t->field.reset(new pgl::Field(t->device.get(), config));
        float size = (float)extent;
        t->field->SetSceneBounds({{0, 0, 0}, {size, size, size}});
        t->storage.reset(new pgl::SampleStorage);
        t->distribution.reset(new pgl::SurfaceSamplingDistribution(t->field.get()));
    } catch (const std::exception &) {
        return nullptr;
    }
    return t.release();
}

void *create_default(double extent)
{
    return create(extent, PGL_DIRECTIONAL_DISTRIBUTION_PARALLAX_AWARE_VMM, PGL_TREE_MAX_SAMPLE_PER_LEAF, true);
}
void *create_4000(double extent)
{
    return create(extent, PGL_DIRECTIONAL_DISTRIBUTION_PARALLAX_AWARE_VMM, 4000, false);
}
void *create_quadtree(double extent) { return create(extent, PGL_DIRECTIONAL_DISTRIBUTION_QUADTREE, 4000, true); }

/* In batches of 64, about what a path tracer hands over at once. */
const char *record(void *state, const sf1_sample *samples, const float *, uint32_t count)
{
    field_openpgl *t = static_cast<field_openpgl *>(state);
    pgl::SampleData batch[64];
    try {
        for (uint32_t at = 0; at < count; at += 64) {
            uint32_t n = count - at < 64 ? count - at : 64;
            for (uint32_t i = 0; i < n; ++i) {
                const sf1_sample *s = &samples[at + i];
                pgl::SampleData d{};
                d.position = {s->position[0], s->position[1], s->position[2]};
                d.direction = pgl_vec3f{s->direction[0], s->direction[1], s->direction[2]};
                d.weight = s->radiance / s->pdf;
                d.pdf = s->pdf;
                d.distance = s->distance;
                batch[i] = d;
            }
            t->storage->AddSamples(batch, n);
        }
    } catch (const std::exception &e) {
        return told(e);
    }
    return nullptr;
}

const char *update(void *state)
{
    field_openpgl *t = static_cast<field_openpgl *>(state);
    try {
        t->field->Update(*t->storage);
        t->storage->Clear();
    } catch (const std::exception &e) {
        return told(e);
    }
    t->learned = true;
    t->kept = false;
    return nullptr;
}

/* In [0, 1): a mix of the position's bits. */
float lookup_number(const float p[3])
{
    uint64_t h = 0;
    for (int k = 0; k < 3; ++k) {
        uint32_t bits;
        memcpy(&bits, &p[k], sizeof bits);
        h = (h ^ bits) * UINT64_C(0x9e3779b97f4a7c15);
        h ^= h >> 29;
    }
    return (float)(h >> 40) * 0x1p-24f;
}

bool find(field_openpgl *t, field_place place)
{
    const float *p = place.position, *n = place.normal;
    float u = lookup_number(p);
    t->found = t->learned && t->distribution->Init(t->field.get(), {p[0], p[1], p[2]}, u);
    if (t->found && n && !t->quadtree)
        t->distribution->ApplyCosineProduct({n[0], n[1], n[2]});
    return t->found;
}

double density(const field_openpgl *t, const float direction[3])
{
    float pdf = t->distribution->PDF({direction[0], direction[1], direction[2]});
    return pdf > 0 && std::isfinite(pdf) ? (double)pdf : 0;
}

double query(void *state, field_place place, const float u[2], const float given[3], float sampled[3],
             double *given_pdf)
{
    field_openpgl *t = static_cast<field_openpgl *>(state);
    *given_pdf = 0;
    t->kept = false;
    if (!find(t, place))
        return 0;
    pgl_vec3f d{0, 0, 1};
    double pdf = (double)t->distribution->SamplePDF({u[0], u[1]}, d);
    *given_pdf = density(t, given);
    sampled[0] = d.x;
    sampled[1] = d.y;
    sampled[2] = d.z;
    return pdf;
}

double pdf_of(void *state, field_place place, const float direction[3])
{
    field_openpgl *t = static_cast<field_openpgl *>(state);
    float asked[6] = {place.position[0], place.position[1], place.position[2], 0, 0, 0};
    if (place.normal)
        memcpy(asked + 3, place.normal, 3 * sizeof *asked);
    if (!t->kept || memcmp(asked, t->place, sizeof asked) != 0) {
        find(t, place);
        memcpy(t->place, asked, sizeof asked);
        t->kept = true;
    }
    return t->found ? density(t, direction) : 0;
}

/* Of mixtures only. */
uint64_t bytes(void *state)
{
    const field_openpgl *t = static_cast<const field_openpgl *>(state);
    return t->quadtree ? 0 : openpgl_measure(*t->field).bytes;
}
uint32_t cells(void *state) { return (uint32_t)openpgl_measure(*static_cast<field_openpgl *>(state)->field).cells; }

field_method describe(const char *name, const char *what, void *(*create)(double))
{
    return {name, what, create, record, update, query, pdf_of, bytes, cells, destroy};
}

} // namespace

const field_method field_openpgl_method =
    describe("openpgl", "Intel Open PGL: parallax-aware mixtures, all defaults", create_default);
const field_method field_openpgl_4000_method =
    describe("openpgl-4000", "the same, cells of up to 4,000 samples, no kNN", create_4000);
const field_method field_openpgl_quadtree_method =
    describe("openpgl-quadtree", "Intel Open PGL: quadtrees, cells of up to 4,000 samples", create_quadtree);
