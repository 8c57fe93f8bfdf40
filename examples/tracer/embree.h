/* embree.h: the one place that knows which Embree this is. Embree 3 and 4 differ in two calls. */
#ifndef TR_EMBREE_H
#define TR_EMBREE_H

#if defined(__has_include)
#if __has_include(<embree4/rtcore.h>)
#define TR_EMBREE_MAJOR 4
#endif
#endif
#ifndef TR_EMBREE_MAJOR
#define TR_EMBREE_MAJOR 3
#endif

#if TR_EMBREE_MAJOR == 4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

static inline void tr_rtc_intersect(RTCScene scene, struct RTCRayHit *hit)
{
#if TR_EMBREE_MAJOR == 4
    rtcIntersect1(scene, hit, NULL);
#else
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(scene, &context, hit);
#endif
}

/* True where something lies on the ray within (tnear, tfar). */
static inline int tr_rtc_occluded(RTCScene scene, struct RTCRay *ray)
{
#if TR_EMBREE_MAJOR == 4
    rtcOccluded1(scene, ray, NULL);
#else
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(scene, &context, ray);
#endif
    return ray->tfar < 0;
}

#endif
