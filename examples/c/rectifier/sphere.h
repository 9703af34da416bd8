/* Views cut from the sphere. */
#ifndef SPHERE_H
#define SPHERE_H

#include <stdint.h>

#include <flockeye/contract.h>

/* An equirectangular picture: `height` rows of `width` bytes of luma, a row every `stride` bytes. */
typedef struct {
    const uint8_t *luma;
    uint32_t width, height, stride;
} sphere;

/* A planned view's rotation at an exposure: it turns by its rate from the time for which it was planned. */
void turned(const flockeye_planned_view *planned, int64_t exposure_ns, double camera_from_view[4]);

/* Cuts a pinhole image of `size_px` rows and columns, its principal point in the middle. */
void cut(const sphere *picture, const double camera_from_view[4], double focal_px, uint32_t size_px, uint8_t *view);

#endif
