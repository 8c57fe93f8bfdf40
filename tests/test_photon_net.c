/* test_photon_net.c: the trained network in the renderer's photon method: its weights, what it makes of maps whose
   truth is known, hostile maps, broken files, threads and its share of the time. */
#include "cmocka_prelude.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "photon_net.h"
#include "rng.h"
#include "scene_internal.h"
#include "threads.h"

#define WEIGHTS "examples/weights/histogram.safetensors"

static const float at[3] = {0.5f, 0.5f, 0.5f};

static photon_net *make_net(double share)
{
    char err[512] = "";
    photon_net *net = photon_net_create(NULL, share, 0, err, sizeof err);
    if (!net)
        fail_msg("%s", err);
    return net;
}

/* ---- maps whose truth is known */

/* Lobes of random widths and heights over a base, one value a bin, with mean 1. */
static void draw_truth(double truth[PN_AREA])
{
    double sum = 0, base = rnd() < 0.5 ? 0.05 * rnd() : 0, lobes[4][5];
    int count = 1 + (int)(rnd() * 4);
    for (int k = 0; k < count; ++k) {
        double z = 2 * rnd() - 1, phi = 6.283185307 * rnd(), r = sqrt(1 - z * z);
        lobes[k][0] = r * cos(phi), lobes[k][1] = r * sin(phi), lobes[k][2] = z;
        lobes[k][3] = exp(log(1) + rnd() * log(200));        /* concentration */
        lobes[k][4] = (0.1 + rnd()) * pow(lobes[k][3], 0.5); /* height */
    }
    for (int i = 0; i < PN_AREA; ++i) {
        double z = 2 * (i / PN_COLUMNS + 0.5) / PN_ROWS - 1, phi = 6.283185307 * (i % PN_COLUMNS + 0.5) / PN_COLUMNS;
        double r = sqrt(1 - z * z), d[3] = {r * cos(phi), r * sin(phi), z};
        truth[i] = base;
        for (int k = 0; k < count; ++k)
            truth[i] +=
                lobes[k][4] * exp(lobes[k][3] * (lobes[k][0] * d[0] + lobes[k][1] * d[1] + lobes[k][2] * d[2] - 1));
        sum += truth[i];
    }
    for (int i = 0; i < PN_AREA; ++i)
        truth[i] *= PN_AREA / sum;
}

/* A direction within a bin. */
static gph_photon photon_in(int bin, float flux)
{
    double z = 2 * (bin / PN_COLUMNS + 0.1 + 0.8 * rnd()) / PN_ROWS - 1;
    double phi = 6.283185307 * (bin % PN_COLUMNS + 0.1 + 0.8 * rnd()) / PN_COLUMNS, r = sqrt(1 - z * z);
    float d[3] = {(float)(r * cos(phi)), (float)(r * sin(phi)), (float)z};
    return gph_make_photon(at, d, INFINITY, flux);
}

static int draw_bin(const double truth[PN_AREA])
{
    double x = rnd() * PN_AREA;
    int i = 0;
    for (; i < PN_AREA - 1 && x >= truth[i]; ++i)
        x -= truth[i];
    return i;
}

/* A field of one voxel. */
static gph_field *make_field(gph_repair repair)
{
    gph_desc d;
    gph_field *field;
    memset(&d, 0, sizeof d);
    d.bounds_max[0] = d.bounds_max[1] = d.bounds_max[2] = 1;
    d.grid_cells = 1;
    d.split_photons = 1e9f;
    d.repair = repair;
    assert_int_equal(gph_create(&d, &field), GPH_OK);
    return field;
}

static void teach(gph_field *field, const gph_photon *photons, int count)
{
    gph_stream *stream;
    gph_vertex touch = gph_make_vertex(at, 0, 1, 1, 0, GPH_TOUCH_ONLY);
    assert_int_equal(gph_stream_create(field, &stream), GPH_OK);
    assert_int_equal(gph_record_vertices(stream, &touch, 1), GPH_OK);
    assert_int_equal(gph_record_photons(stream, photons, (uint32_t)count), GPH_OK);
    assert_int_equal(gph_accumulate(field, &stream, 1, NULL, NULL), GPH_OK);
    assert_int_equal(gph_refine(field, NULL, NULL), GPH_OK);
    gph_stream_destroy(stream);
}

static void read_map(const gph_field *field, float map[PN_AREA])
{
    gph_view view = gph_get_view(field);
    gph_handle handle;
    gph_find(&view, at, NULL, NULL, &handle);
    assert_non_null(handle.weights);
    pn_repaired(&handle, map);
}

/* Second moment over squared mean of what the map samples, 1 % uniform: 1 = perfect. */
static double moment(const double truth[PN_AREA], const float map[PN_AREA])
{
    double v = 0;
    for (int i = 0; i < PN_AREA; ++i)
        v += truth[i] * truth[i] / (0.99 * (double)map[i] + 0.01) / PN_AREA;
    return v;
}

static void network_beats_raw_and_blurred_histograms(void **state)
{
    enum { MAPS = 60 };
    static const int numbers[] = {30, 100, 400};
    static double truth[PN_AREA];
    static gph_photon photons[400];
    photon_net *net = make_net(1e6);
    (void)state;
    for (int n = 0; n < 3; ++n) {
        double sums[3] = {0, 0, 0};
        int better = 0;
        seed(7 + (uint64_t)n);
        for (int k = 0; k < MAPS; ++k) {
            double v[3];
            float map[PN_AREA];
            draw_truth(truth);
            for (int i = 0; i < numbers[n]; ++i)
                photons[i] = photon_in(draw_bin(truth), 1);
            for (int what = 0; what < 3; ++what) {
                gph_field *field = make_field(what == 0 ? GPH_REPAIR_NONE : GPH_REPAIR_GAUSSIAN);
                teach(field, photons, numbers[n]);
                if (what == 2)
                    assert_true(photon_net_refine(net, field, NULL, NULL));
                read_map(field, map);
                v[what] = moment(truth, map);
                sums[what] += log(v[what]) / MAPS;
                gph_destroy(field);
            }
            better += v[2] < v[0];
        }
        print_message("%d photons: geometric mean of V raw %.2f, blurred %.2f, network %.2f; better than raw in %d "
                      "of %d\n",
                      numbers[n], exp(sums[0]), exp(sums[1]), exp(sums[2]), better, MAPS);
        assert_true(exp(sums[2]) < 0.5 * exp(sums[0]));
        assert_true(sums[2] < sums[1]);
        assert_true(better >= MAPS * 9 / 10);
    }
    photon_net_destroy(net);
}

/* ---- hostile maps */

static void every_map_stays_finite(void **state)
{
    static const float fluxes[] = {1, 1e30f, 1e-20f, 3e-5f};
    static gph_photon photons[512];
    photon_net *net = make_net(1e6);
    (void)state;
    seed(11);
    for (int k = 0; k < 16; ++k) {
        int count = k % 4 == 0 ? 1 : k % 4 == 1 ? 2 : 512;
        float map[PN_AREA], flux = fluxes[k / 4];
        gph_field *field = make_field(GPH_REPAIR_DEFAULT);
        for (int i = 0; i < count; ++i) { /* the last: of very different weights, all in one bin or everywhere */
            int bin = k % 4 == 2 ? 40 : (int)(rnd() * PN_AREA);
            photons[i] = photon_in(bin, flux * (i & 1 ? 1 : 1e-4f) * (flux < 1e29f ? 1 : 0.5f));
        }
        teach(field, photons, count);
        assert_true(photon_net_refine(net, field, NULL, NULL));
        read_map(field, map);
        for (int i = 0; i < PN_AREA; ++i)
            if (!(map[i] >= 0 && map[i] <= PN_AREA))
                fail_msg("case %d, bin %d: %g", k, i, (double)map[i]);
        assert_int_equal(gph_validate(field), GPH_OK);
        gph_destroy(field);
    }
    photon_net_destroy(net);
}

/* Even an answer of nothing but NaN, infinity or darkness becomes a map. */
static void bad_answers_become_maps(void **state)
{
    static const float answers[] = {NAN, INFINITY, -INFINITY, -1, 0, 3e38f, 1e-30f, 3e-20f, 1e-19f, 1e19f};
    enum { ANSWERS = sizeof answers / sizeof *answers };
    static float repaired[PN_AREA], output[PN_AREA], map[PN_AREA];
    (void)state;
    for (int k = 0; k < ANSWERS; ++k)
        for (int all = 0; all < 2; ++all) {
            for (int i = 0; i < PN_AREA; ++i) {
                repaired[i] = 1;
                output[i] = all || i == 9 ? answers[k] : 1;
            }
            pn_map(repaired, output, map);
            for (int i = 0; i < PN_AREA; ++i)
                if (!(map[i] > 0 && map[i] <= PN_AREA))
                    fail_msg("answer %g: %g", (double)answers[k], (double)map[i]);
        }
}

/* ---- files */

static char folder[32], file[64], folder_of_weights[64];

static int make_folder(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/photon_net.XXXXXX");
    if (!mkdtemp(folder))
        return -1;
    snprintf(file, sizeof file, "%s/net", folder);
    snprintf(folder_of_weights, sizeof folder_of_weights, "%s/folder", folder);
    return mkdir(folder_of_weights, 0700);
}

static int remove_folder(void **state)
{
    (void)state;
    remove(file);
    rmdir(folder_of_weights);
    return rmdir(folder);
}

static void refuse(const char *path, const void *data, size_t size, const char *reason)
{
    char err[512] = "";
    FILE *f = data ? fopen(path, "wb") : NULL;
    if (data) {
        assert_non_null(f);
        assert_int_equal(fwrite(data, 1, size, f), size);
        fclose(f);
    }
    assert_null(photon_net_create(path, 0.1, 0, err, sizeof err));
    print_message("%s\n", err);
    assert_non_null(strstr(err, path));
    assert_non_null(strstr(err, reason));
    assert_non_null(strstr(err, "--set net=FILE"));
}

static void broken_weights_are_refused_with_file_and_remedy(void **state)
{
    size_t size;
    unsigned char *data = tr_file_read(WEIGHTS, &size, NULL, 0);
    (void)state;
    assert_non_null(data);
    assert_true(size > 1000 && size <= 1u << 20);
    refuse("no/such/file", NULL, 0, "cannot read the network's weights no/such/file: No such file");
    refuse(folder_of_weights, NULL, 0, "Is a directory");
    refuse(file, data, size / 2, "lie outside the file");
    refuse(file, data, 0, "its header does not fit");
    data[12] ^= 0x40; /* in the header's first key */
    refuse(file, data, size, "not dtype, shape or data_offsets");
    data[12] ^= 0x40;
    data[size - 1] = 0x7c, data[size - 2] = 0; /* infinity, as a half-float */
    refuse(file, data, size, "finite");
    free(data);
}

/* ---- the renderer */

static tr_result render(const tr_scene *scene, tr_option *options, int count, int threads)
{
    tr_settings s;
    tr_result r;
    char err[512] = "";
    memset(&s, 0, sizeof s);
    s.width = 48;
    s.height = 27;
    s.spp = 8;
    s.max_depth = 5;
    s.threads = threads;
    s.method = tr_method_find("photon");
    s.options = options;
    s.option_count = count;
    if (!tr_render(scene, &s, &r, err, sizeof err))
        fail_msg("%s", err);
    return r;
}

static double member(const tr_result *r, const char *name)
{
    char key[64];
    snprintf(key, sizeof key, "\"%s\": ", name);
    const char *found = strstr(r->method.json, key);
    if (!found)
        fail_msg("no %s in %s", name, r->method.json);
    return atof(found + strlen(key));
}

static void pictures_do_not_depend_on_threads(void **state)
{
    tr_log log = {0};
    tr_scene *scene = tr_scene_load("examples/scenes/spot.xml", NULL, 0, 1, &log);
    tr_option with[] = {{"net", "on", false}, {"grid", "6", false}, {"net_share", "1", false}};
    tr_option without[] = {{"net", "off", false}, {"grid", "6", false}};
    (void)state;
    assert_non_null(scene);
    tr_result one = render(scene, with, 3, 1), two = render(scene, with, 3, 2), off = render(scene, without, 2, 2);
    size_t size = 3 * 48 * 27 * sizeof(float);
    assert_memory_equal(one.color.data, two.color.data, size);
    assert_string_equal(one.method.json, two.method.json);
    assert_true(memcmp(one.color.data, off.color.data, size) != 0);
    assert_true(member(&one, "net_maps") > 20);
    assert_null(strstr(off.method.json, "net_maps"));
    tr_result_free(&one);
    tr_result_free(&two);
    tr_result_free(&off);
    tr_scene_free(scene);
}

/* The share is of counted work: a tenth of it makes a tenth of the maps, where there are enough. */
static void share_bounds_the_networks_maps(void **state)
{
    tr_log log = {0};
    tr_scene *scene = tr_scene_load("examples/scenes/spot.xml", NULL, 0, 1, &log);
    static const char *const shares[] = {"0", "0.01", "0.1", "100"};
    double maps[4], changed = 0;
    (void)state;
    assert_non_null(scene);
    for (int k = 0; k < 4; ++k) {
        tr_option options[] = {{"net", "on", false}, {"grid", "12", false}, {"net_share", shares[k], false}};
        tr_result r = render(scene, options, 3, 2);
        maps[k] = member(&r, "net_maps");
        changed = member(&r, "net_changed");
        assert_int_equal((int)(maps[k] + member(&r, "net_over_budget")), (int)changed);
        tr_result_free(&r);
    }
    print_message("%g, %g, %g, %g of %g maps\n", maps[0], maps[1], maps[2], maps[3], changed);
    assert_true(maps[0] == 0);
    assert_true(maps[1] > 0 && maps[2] > 9 * maps[1] - 10 && maps[2] < 11 * maps[1] + 10);
    assert_true(maps[2] < 0.5 * changed && maps[3] == changed);
    tr_scene_free(scene);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(network_beats_raw_and_blurred_histograms),
        cmocka_unit_test(every_map_stays_finite),
        cmocka_unit_test(bad_answers_become_maps),
        cmocka_unit_test_setup_teardown(broken_weights_are_refused_with_file_and_remedy, make_folder, remove_folder),
        cmocka_unit_test(pictures_do_not_depend_on_threads),
        cmocka_unit_test(share_bounds_the_networks_maps),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
