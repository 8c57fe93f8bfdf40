/* photon_view.c: a picture of the irradiance that photons bring, to look at a photon pass. */
#include "integrator.h"
#include "scene_internal.h"

typedef struct view {
    const tr_scene *scene;
    mat4 to_camera;
    vec3 eye;
    float tx, ty, pixel; /* at distance 1: half the picture's width and height, area of a pixel */
    tr_image *picture;
} view;

static bool visible(const view *v, vec3 p)
{
    struct RTCRay ray;
    tr_set_ray(&ray, v->eye, sub3(p, v->eye), 1 - 1e-3f);
    return !tr_rtc_occluded(v->scene->rtc, &ray);
}

/* A photon counts in its pixel by flux over the area that the pixel covers of the surface there. */
static bool splat(void *user, int tile, const tr_photon *photons, int n)
{
    const view *v = user;
    int w = v->picture->width, h = v->picture->height;
    (void)tile;
    for (int i = 0; i < n; ++i) {
        const tr_photon *p = &photons[i];
        vec3 c = xform_point(&v->to_camera, p->p);
        if (!(c.z > 0))
            continue;
        float x = 0.5f * (1 - c.x / (c.z * v->tx)) * (float)w, y = 0.5f * (1 - c.y / (c.z * v->ty)) * (float)h;
        if (!(x >= 0 && x < (float)w && y >= 0 && y < (float)h) || !visible(v, p->p))
            continue;
        vec3 away = norm3(sub3(v->eye, p->p));
        float weight = fabsf(dot3(p->ng, away)) * len3(c) / (v->pixel * c.z * c.z * c.z);
        float *out = v->picture->data + 3 * ((size_t)y * (size_t)w + (size_t)x);
        out[0] += weight * p->flux.x;
        out[1] += weight * p->flux.y;
        out[2] += weight * p->flux.z;
    }
    return true;
}

bool tr_photon_picture(const tr_photon_pass *pass, tr_image *picture)
{
    const tr_camera *camera = &pass->scene->camera;
    float aspect = (float)picture->width / (float)picture->height;
    view v = {.scene = pass->scene, .picture = picture};
    tr_photon_pass serial = *pass; /* pixels have no locks */
    serial.parallel = NULL;
    mat4_inverse(&camera->to_world, &v.to_camera);
    v.eye = mat4_column(&camera->to_world, 3);
    v.tx = tr_tan_half_fov_x(camera, aspect);
    v.ty = v.tx / aspect;
    v.pixel = 4 * v.tx * v.ty / ((float)picture->width * (float)picture->height);
    return tr_trace_photons(&serial, splat, &v, NULL);
}
