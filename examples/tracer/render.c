/* render.c: the command `render`: a scene file, a method and a budget in; EXR, PNG and JSON out.

     >>options  command line
     >>progress bar on a terminal, plain lines elsewhere
     >>output   EXR layers, PNG, JSON
     >>main */
#define _POSIX_C_SOURCE 200809L
#include "options.h"
#include "threads.h"
#include "tracer.h"

#include <errno.h>
#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define MAX_OPTIONS 64

typedef struct options {
    tr_settings settings;
    const char *scene, *method, *out, *png, *json, *reference, *photons;
    tr_option set[MAX_OPTIONS];
    tr_define defines[MAX_OPTIONS];
    int define_count;
    double exposure;
    bool quiet, list;
} options;

static const char usage_text[] =
    "usage: render SCENE.xml|SCENE.gltf|SCENE.glb [options]\n"
    "  --method NAME         guiding method (default pt), listed below\n"
    "  --set key=value       option of the method (repeatable)\n"
    "  --train N             N samples per pixel only teach, then the field is frozen and the picture begins anew\n"
    "  --spp N               budget in samples per pixel, those of --train not counted, or\n"
    "  --seconds S           budget in CPU seconds over all threads, learning and --train included\n"
    "  --size WxH            picture size (default: the scene's)\n"
    "  --max-depth D         path edges, 1 = emitted light only (default: the scene's)\n"
    "  --nee on|off          next event estimation (default on)\n"
    "  --rr guided|off|on    Russian roulette: by what the guide expects, with splitting (default; pt: off), none, by\n"
    "                        throughput\n"
    "  --seed N, --threads N\n"
    "  -D name=value         value for $name in the scene file (repeatable)\n"
    "  --reference R.exr     print errors against R; R may be larger by a whole factor\n"
    "  -o OUT.exr            layers: color, variance, albedo, normal, alpha, cell, depth\n"
    "  --png OUT.png         tone-mapped picture   [--exposure E]\n"
    "  --photon-png OUT.png  irradiance by a million photon paths, unfiltered\n"
    "  --json FILE           statistics\n"
    "  --quiet               no progress\n";

/* ---- >>options ---------------------------------------------------------------------------------------------- */

static int die(const char *format, const char *a, const char *b)
{
    fputs("render: ", stderr);
    fprintf(stderr, format, a, b);
    fputc('\n', stderr);
    return 1;
}

static bool parse_long(const char *text, long min, long max, long *value)
{
    char *end;
    errno = 0;
    *value = strtol(text, &end, 10);
    return errno == 0 && end != text && *end == 0 && *value >= min && *value <= max;
}

static bool parse_double(const char *text, double *value)
{
    char *end;
    *value = strtod(text, &end);
    return end != text && *end == 0 && isfinite(*value);
}

static bool parse_switch(const char *text, bool *on)
{
    *on = !strcmp(text, "on");
    return *on || !strcmp(text, "off");
}

/* One option with its value; false = the value is not usable. */
static bool apply(options *o, const char *name, char *value, bool *known)
{
    tr_settings *s = &o->settings;
    long n = 0;
    bool on = false, ok = true;
    *known = true;
    if (!strcmp(name, "--method"))
        o->method = value;
    else if (!strcmp(name, "-o") || !strcmp(name, "--output"))
        o->out = value;
    else if (!strcmp(name, "--png"))
        o->png = value;
    else if (!strcmp(name, "--photon-png"))
        o->photons = value;
    else if (!strcmp(name, "--json"))
        o->json = value;
    else if (!strcmp(name, "--reference"))
        o->reference = value;
    else if (!strcmp(name, "--train"))
        ok = parse_long(value, 1, 1 << 24, &n), s->train = (int)n;
    else if (!strcmp(name, "--spp"))
        ok = parse_long(value, 1, 1 << 24, &n), s->spp = (int)n;
    else if (!strcmp(name, "--seconds"))
        ok = parse_double(value, &s->seconds) && s->seconds > 0;
    else if (!strcmp(name, "--size"))
        ok = parse_size(value, &s->width, &s->height);
    else if (!strcmp(name, "--max-depth"))
        ok = parse_long(value, 1, TR_MAX_DEPTH, &n), s->max_depth = (int)n;
    else if (!strcmp(name, "--nee"))
        ok = parse_switch(value, &on), s->no_nee = !on;
    else if (!strcmp(name, "--rr"))
        ok = parse_roulette(value, &s->roulette);
    else if (!strcmp(name, "--seed"))
        ok = parse_long(value, 0, LONG_MAX, &n), s->seed = (uint64_t)n;
    else if (!strcmp(name, "--threads"))
        ok = parse_long(value, 1, 256, &n), s->threads = (int)n;
    else if (!strcmp(name, "--exposure"))
        ok = parse_double(value, &o->exposure) && o->exposure > 0;
    else if (!strcmp(name, "--set") && s->option_count < MAX_OPTIONS) {
        tr_option *opt = &o->set[s->option_count];
        ok = parse_pair(value, &opt->key, &opt->value);
        s->option_count += ok;
    } else if (!strcmp(name, "-D") && o->define_count < MAX_OPTIONS) {
        tr_define *d = &o->defines[o->define_count];
        ok = parse_pair(value, &d->name, &d->value);
        o->define_count += ok;
    } else
        *known = false;
    return ok;
}

static int parse(options *o, int argc, char **argv)
{
    o->method = "pt";
    o->settings.options = o->set;
    for (int i = 1; i < argc; ++i) {
        bool known = true;
        if (!strcmp(argv[i], "--quiet")) {
            o->quiet = true;
            continue;
        }
        if (argv[i][0] != '-') {
            if (o->scene)
                return die("two scenes given: '%s' and '%s'", o->scene, argv[i]);
            o->scene = argv[i];
            continue;
        }
        if (i + 1 >= argc)
            return die("option '%s' is unknown or needs a value; run render --help", argv[i], "");
        bool ok = apply(o, argv[i], argv[i + 1], &known);
        if (!known)
            return die("unknown option '%s'; run render --help", argv[i], "");
        if (!ok)
            return die("option %s: '%s' is not a usable value; run render --help", argv[i], argv[i + 1]);
        ++i;
    }
    if (!o->scene)
        return die("no scene given; run render --help", "", "");
    if (o->settings.spp > 0 && o->settings.seconds > 0)
        return die("give --spp or --seconds, not both", "", "");
    if (o->settings.spp == 0 && !(o->settings.seconds > 0))
        o->settings.spp = 16;
    o->settings.method = tr_method_find(o->method);
    if (!o->settings.method)
        return die("unknown method '%s'; run render --help", o->method, "");
    return 0;
}

/* ---- >>progress --------------------------------------------------------------------------------------------- */

typedef struct progress {
    bool terminal;
    double next; /* share at which the next plain line is due */
} progress;

static void show_progress(void *user, double done, const char *text)
{
    progress *p = user;
    if (p->terminal) {
        char bar[31];
        int filled = (int)(30 * done);
        for (int i = 0; i < 30; ++i)
            bar[i] = i < filled ? '#' : '.';
        bar[30] = 0;
        fprintf(stderr, "\r[%s] %3.0f %%  %s   ", bar, 100 * done, text);
        if (done >= 1)
            fputc('\n', stderr);
    } else if (done >= p->next) {
        fprintf(stderr, "%3.0f %%  %s\n", 100 * done, text);
        p->next += 0.25;
    }
}

/* ---- >>output ----------------------------------------------------------------------------------------------- */

static bool write_exr(const char *path, const tr_result *r, char *err, size_t err_size)
{
    const tr_layer layers[] = {{"R,G,B", &r->color, false},
                               {"variance.R,variance.G,variance.B", &r->variance, true},
                               {"albedo.R,albedo.G,albedo.B", &r->albedo, false},
                               {"normal.X,normal.Y,normal.Z", &r->normal, false},
                               {"alpha.Y", &r->alpha, false},
                               {"cell.Y", &r->cell, true},
                               {"depth.Y", &r->depth, false}};
    return tr_exr_write(path, layers, (int)(sizeof layers / sizeof layers[0]), err, err_size);
}

static void json_string(FILE *f, const char *key, const char *value)
{
    fprintf(f, "  \"%s\": \"", key);
    for (; *value; ++value) {
        unsigned char c = (unsigned char)*value;
        if (c == '"' || c == '\\')
            fputc('\\', f);
        if (c >= 0x20)
            fputc(c, f);
        else
            fprintf(f, "\\u%04x", c);
    }
    fputs("\",\n", f);
}

static void json_number(FILE *f, const char *key, double value)
{
    if (isfinite(value))
        fprintf(f, "  \"%s\": %.9g,\n", key, value);
    else
        fprintf(f, "  \"%s\": null,\n", key);
}

/* CPU seconds of what is timed by itself. */
static double all_parts(const tr_result *r)
{
    return r->trace_seconds + r->record_seconds + r->update_seconds + r->query_seconds + r->photon_seconds;
}

static bool write_json(const char *path, const options *o, const tr_result *r, const tr_error *e)
{
    FILE *f = !strcmp(path, "-") ? stdout : fopen(path, "w");
    if (!f)
        return false;
    double parts = all_parts(r);
    fputs("{\n", f);
    json_string(f, "scene", o->scene);
    json_string(f, "method", o->method);
    json_number(f, "width", r->color.width);
    json_number(f, "height", r->color.height);
    json_number(f, "spp", r->spp);
    json_number(f, "train_spp", o->settings.train);
    json_number(f, "passes", r->passes);
    json_number(f, "train_passes", r->train_passes);
    json_number(f, "cpu_seconds", r->cpu_seconds);
    json_number(f, "train_seconds", r->train_seconds);
    json_number(f, "render_seconds", r->cpu_seconds - r->train_seconds);
    json_number(f, "wall_seconds", r->wall_seconds);
    json_number(f, "trace_seconds", r->trace_seconds);
    json_number(f, "shade_seconds", r->cpu_seconds - parts);
    json_number(f, "record_seconds", r->record_seconds);
    json_number(f, "update_seconds", r->update_seconds);
    json_number(f, "query_seconds", r->query_seconds);
    json_number(f, "photon_seconds", r->photon_seconds);
    json_number(f, "photon_paths", (double)r->photon_paths);
    json_number(f, "photon_rays", (double)r->photon_rays);
    json_number(f, "photons", (double)r->photons);
    json_number(f, "rays", (double)r->rays);
    json_number(f, "shadow_rays", (double)r->shadow_rays);
    json_number(f, "paths", (double)r->paths);
    json_number(f, "split_paths", (double)r->split_paths);
    json_number(f, "unsplit_paths", (double)r->unsplit_paths);
    json_number(f, "bad_samples", (double)r->bad_samples);
    json_number(f, "samples", (double)r->method.samples);
    json_number(f, "refused", (double)r->method.refused);
    json_number(f, "cells", (double)r->method.cells);
    json_number(f, "bytes", (double)r->method.bytes);
    json_number(f, "extra_bytes", r->method.extra_bytes);
    if (e) {
        json_number(f, "relmse", e->relmse);
        json_number(f, "mrae", e->mrae);
        json_number(f, "relmse_untrimmed", e->relmse_untrimmed);
        json_number(f, "mrae_untrimmed", e->mrae_untrimmed);
    }
    if (r->method.json[0])
        fprintf(f, "  %s,\n", r->method.json);
    fputs("  \"pass\": [", f);
    for (int i = 0; i < r->passes; ++i)
        fprintf(f, "%s\n    {\"spp\": %d, \"cpu_seconds\": %.4g, \"variance\": %.6g, \"weight\": %.4g}", i ? "," : "",
                r->pass[i].spp, r->pass[i].cpu_seconds, r->pass[i].variance, r->pass[i].weight);
    fputs("\n  ]\n}\n", f);
    return (f == stdout ? fflush(f) : fclose(f)) == 0;
}

/* Errors against the reference, shrunk first where it is larger. */
static bool measure(const char *path, const tr_image *image, tr_error *e, char *err, size_t err_size)
{
    tr_image reference, small;
    if (!tr_image_read(path, true, &reference, err, err_size))
        return false;
    if (reference.width != image->width || reference.height != image->height) {
        if (!tr_image_downsample(&reference, image->width, image->height, &small)) {
            snprintf(err, err_size, "%s: its size %dx%d is no whole multiple of the picture's", path, reference.width,
                     reference.height);
            tr_image_free(&reference);
            return false;
        }
        tr_image_free(&reference);
        reference = small;
    }
    bool ok = tr_image_error(image, &reference, e, err, err_size);
    tr_image_free(&reference);
    return ok;
}

static bool write_photons(const options *o, const tr_scene *scene, const tr_image *like, char *err, size_t err_size)
{
    const tr_settings *s = &o->settings;
    const uint32_t paths = 1u << 20;
    tr_image picture;
    tr_photon_pass pass = {.scene = scene, .seed = s->seed, .total = paths, .count = paths, .nee = !s->no_nee};
    pass.max_depth = s->max_depth > 0 ? s->max_depth : scene->max_depth;
    snprintf(err, err_size, "out of memory");
    if (!tr_image_alloc(&picture, like->width, like->height, 3))
        return false;
    bool ok =
        tr_photon_picture(&pass, &picture) && tr_png_write(o->photons, &picture, (float)o->exposure, err, err_size);
    tr_image_free(&picture);
    return ok;
}

static int write_outputs(const options *o, const tr_scene *scene, const tr_result *r)
{
    char err[512] = "";
    tr_error e;
    int rc = 0;
    bool measured = false;
    if (o->reference) {
        measured = measure(o->reference, &r->color, &e, err, sizeof err);
        if (!measured)
            rc = die("--reference: %s", err, "");
    }
    if (o->out && !write_exr(o->out, r, err, sizeof err))
        rc = die("%s: cannot write the picture: %s", o->out, err);
    if (o->png && !tr_png_write(o->png, &r->color, (float)o->exposure, err, sizeof err))
        rc = die("%s: cannot write the picture: %s", o->png, err);
    if (o->photons && !write_photons(o, scene, &r->color, err, sizeof err))
        rc = die("%s: cannot write the picture: %s", o->photons, err);
    if (o->json && !write_json(o->json, o, r, measured ? &e : NULL))
        rc = die("%s: cannot write the statistics: %s", o->json, strerror(errno));
    if (!o->quiet) {
        double parts = all_parts(r);
        printf("%s: %d spp in %.2f CPU s", o->method, r->spp, r->cpu_seconds);
        if (o->settings.train)
            printf(", of which %.2f for %d spp of training", r->train_seconds, o->settings.train);
        printf(" (trace %.0f %%, shade %.0f %%, query %.0f %%, record %.0f %%, update %.0f %%",
               100 * r->trace_seconds / r->cpu_seconds, 100 * (1 - parts / r->cpu_seconds),
               100 * r->query_seconds / r->cpu_seconds, 100 * r->record_seconds / r->cpu_seconds,
               100 * r->update_seconds / r->cpu_seconds);
        if (r->photon_paths)
            printf(", photons %.0f %%", 100 * r->photon_seconds / r->cpu_seconds);
        printf(")");
        if (r->method.cells)
            printf(", %.0f cells, %.1f MB", (double)r->method.cells, (double)r->method.bytes / 1e6);
        if (measured)
            printf(", relMSE %.4g (untrimmed %.4g), MRAE %.4g", e.relmse, e.relmse_untrimmed, e.mrae);
        printf("\n");
    }
    return rc;
}

/* ---- >>main ------------------------------------------------------------------------------------------------- */

/* An output that cannot be written is better known before the render than after it. */
static int check_outputs(const options *o)
{
    const char *paths[] = {o->out, o->png, o->json, o->photons};
    for (size_t i = 0; i < sizeof paths / sizeof *paths; ++i) {
        if (!paths[i] || !strcmp(paths[i], "-"))
            continue;
        FILE *f = fopen(paths[i], "ab");
        if (!f)
            return die("%s: cannot be written: %s", paths[i], strerror(errno));
        fclose(f);
    }
    return 0;
}

int main(int argc, char **argv)
{
    static options o;
    char err[512] = "";
    for (int i = 1; i < argc; ++i)
        if (!strcmp(argv[i], "--help") || !strcmp(argv[i], "-h")) {
            fputs(usage_text, stdout);
            puts("methods:");
            for (const tr_method *const *m = tr_method_list(); *m; ++m)
                printf("  %-21s %s\n", (*m)->name, (*m)->summary);
            return 0;
        }
    if (parse(&o, argc, argv) || check_outputs(&o))
        return 1;
    tr_log log = {.out = stderr};
    tr_scene *scene = tr_scene_load(o.scene, o.defines, o.define_count, o.settings.threads, &log);
    if (!scene)
        return 1;
    progress bar = {.terminal = isatty(STDERR_FILENO) != 0};
    if (!o.quiet) {
        o.settings.progress = show_progress;
        o.settings.progress_user = &bar;
    }
    tr_result result;
    int rc = 0;
    if (!tr_render(scene, &o.settings, &result, err, sizeof err))
        rc = die("%s: %s", o.scene, err);
    else {
        rc = write_outputs(&o, scene, &result);
        tr_result_free(&result);
    }
    tr_scene_free(scene);
    return rc;
}
