/* forest.c: quadtrees of guide_sdtree.h in the cells of guide_kd.h.

   cc -O2 -I. examples/forest.c -o forest -lm && ./forest

   guide_kd.h splits space where the light changes; what each cell knows of directions may be any model. Here the cells
   keep no mixtures, and each has a quadtree of a forest, which is told of every split. A floor of 4 x 1 m is lit by
   three lamps, each seen from a third of it only; the variance of direct light is printed for each pass. */
#define GKD_IMPLEMENTATION
#include "guide_kd.h"
#define GSD_IMPLEMENTATION
#include "guide_sdtree.h"

#include <stdio.h>

enum { SAMPLES = 200000, PASSES = 6 };

typedef struct guide {
    gkd_field *cells;
    gkd_stream *cell_stream;
    gsd_field *forest;
    gsd_stream *forest_stream;
    bool failed;
} guide;

static uint64_t rng = 1;

static float random_float(void)
{
    rng = rng * 6364136223846793005ull + 1442695040888963407ull;
    return (float)(rng >> 40) / 16777216.0f;
}

/* Radiance at p from direction d: ball lamps of radius 5 cm at a height of 1 m, with walls between them. */
static float light(const float p[3], const float d[3], float *distance)
{
    int third = p[0] < 1.3f ? 0 : p[0] < 2.7f ? 1 : 2;
    float c[3] = {0.4f + 1.5f * (float)third - p[0], 0.8f - 0.3f * (float)third - p[1], 1 - p[2]};
    float along = c[0] * d[0] + c[1] * d[1] + c[2] * d[2];
    float square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2] - along * along;
    *distance = along > 0 && square < 0.0025f ? along : INFINITY;
    return along > 0 && square < 0.0025f ? 100.0f : 0.05f;
}

/* Cell `parent` became child_a (= parent) and child_b: so do their quadtrees. */
static void on_split(void *user, uint32_t parent, uint32_t child_a, uint32_t child_b)
{
    guide *g = user;
    g->failed |= gsd_forest_split(g->forest, parent, child_a, child_b) != GSD_OK;
}

/* One direction at p, drawn from the cosine and, by chance, from the cell's quadtree; records it, returns its estimate.
 */
static float estimate(guide *g, const gkd_view *cells, const gsd_view *trees, const float p[3])
{
    const float up[3] = {0, 0, 1};
    float u[2] = {random_float(), random_float()}, d[3], distance;
    uint32_t cell = gkd_find_cell(cells, p);
    gsd_handle handle = gsd_find_cell(trees, cell);
    gsd_orient(trees, &handle, up);
    if (random_float() < handle.alpha) {
        float r = sqrtf(u[0]), phi = 6.2831853f * u[1];
        d[0] = r * cosf(phi);
        d[1] = r * sinf(phi);
        d[2] = sqrtf(1 - u[0]);
    } else
        gsd_sample(trees, &handle, u, d);
    float pdf_guide = gsd_pdf(trees, &handle, d), pdf_bsdf = fmaxf(d[2], 0) / 3.14159265f;
    float pdf = handle.alpha * pdf_bsdf + (1 - handle.alpha) * pdf_guide;
    float L = light(p, d, &distance), value = L * fmaxf(d[2], 0) / 3.14159265f;
    /* below the floor nothing is traced: rejected */
    gkd_training_sample to_cells =
        gkd_make_scalar_sample(p, d, up, distance, d[2] > 0 ? L : GKD_REJECTED, value, value, pdf, pdf_bsdf, pdf_guide);
    gsd_training_sample to_trees =
        gsd_make_scalar_sample(p, d, up, distance, d[2] > 0 ? L : GSD_REJECTED, value, value, pdf, pdf_bsdf, pdf_guide);
    g->failed |= gkd_record(g->cell_stream, &to_cells, 1) != GKD_OK;
    g->failed |= gsd_record_cells(g->forest_stream, &cell, &to_trees, 1) != GSD_OK;
    return pdf > 0 ? value / pdf : 0;
}

/* First the forest, whose samples name the cells that they were drawn in, then the cells, which may split. */
static void learn(guide *g)
{
    gkd_pass pass = {0};
    pass.on_split = on_split;
    pass.on_split_user = g;
    g->failed |= gsd_accumulate(g->forest, &g->forest_stream, 1, NULL, NULL) != GSD_OK;
    g->failed |= gkd_accumulate(g->cells, &g->cell_stream, 1, NULL, NULL) != GKD_OK;
    gsd_stream_clear(g->forest_stream);
    gkd_stream_clear(g->cell_stream);
    g->failed |= gkd_refine(g->cells, &pass, NULL, NULL) != GKD_OK;
    g->failed |= gsd_refine(g->forest, NULL, NULL, NULL) != GSD_OK;
}

static bool create(guide *g)
{
    gkd_desc cells = {0};
    gsd_desc trees = {0};
    cells.bounds_max[0] = 4;
    cells.bounds_max[1] = cells.bounds_max[2] = 1;
    cells.no_mixtures = true;
    trees.forest_cells = 1; /* as many as the tree of cells has at first */
    return !gkd_create(&cells, &g->cells) && !gkd_stream_create(g->cells, &g->cell_stream) &&
           !gsd_create(&trees, &g->forest) && !gsd_stream_create(g->forest, &g->forest_stream);
}

int main(void)
{
    static guide g;
    g.failed = !create(&g);
    for (int pass = 0; pass < PASSES && !g.failed; ++pass) {
        gkd_view cells = gkd_get_view(g.cells);
        gsd_view trees = gsd_get_view(g.forest);
        double sum = 0, square = 0;
        for (int i = 0; i < SAMPLES; ++i) {
            const float p[3] = {4 * random_float(), random_float(), 0};
            double value = estimate(&g, &cells, &trees, p);
            sum += value;
            square += value * value;
        }
        sum /= SAMPLES;
        printf("pass %d: %3u cells, mean %.4f, variance of one sample %.4f\n", pass, cells.cell_count, sum,
               square / SAMPLES - sum * sum);
        learn(&g);
    }
    if (g.failed)
        fprintf(stderr, "forest: out of memory\n");
    gkd_stream_destroy(g.cell_stream);
    gsd_stream_destroy(g.forest_stream);
    gkd_destroy(g.cells);
    gsd_destroy(g.forest);
    return g.failed;
}
