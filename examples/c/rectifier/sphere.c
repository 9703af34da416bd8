#include "sphere.h"

#include <math.h>
#include <stddef.h>

static const double PI = 3.14159265358979323846;

void turned(const flockeye_planned_view *planned, int64_t exposure_ns, double camera_from_view[4]) {
    /* Unsigned, where any difference of two stamps is defined. */
    const double seconds = (double)(int64_t)((uint64_t)exposure_ns - (uint64_t)planned->reference_ns) * 1e-9;
    const double *rate = planned->rate_in_camera, *p = planned->camera_from_view;
    const double angle = sqrt(rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]) * seconds;
    /* The turn as a quaternion t (x, y, z, w); a view without a reference does not turn. */
    double t[4] = {0, 0, 0, 1};
    if (planned->reference_ns != 0 && fabs(angle) > 1e-9) {
        for (int axis = 0; axis < 3; axis++) {
            t[axis] = rate[axis] * seconds / angle * sin(angle / 2);
        }
        t[3] = cos(angle / 2);
    }
    const double product[4] = {
        t[3] * p[0] + t[0] * p[3] + t[1] * p[2] - t[2] * p[1],
        t[3] * p[1] - t[0] * p[2] + t[1] * p[3] + t[2] * p[0],
        t[3] * p[2] + t[0] * p[1] - t[1] * p[0] + t[2] * p[3],
        t[3] * p[3] - t[0] * p[0] - t[1] * p[1] - t[2] * p[2],
    };
    const double length = sqrt(product[0] * product[0] + product[1] * product[1] + product[2] * product[2]
                               + product[3] * product[3]);
    for (int k = 0; k < 4; k++) {
        camera_from_view[k] = product[k] / length;
    }
}

/* The luma along a ray of any length in the camera frame, between the four pixels around it. */
static uint8_t level(const sphere *picture, float forward, float left, float up) {
    const int32_t width = (int32_t)picture->width, height = (int32_t)picture->height;
    const float longitude = atan2f(left, forward);
    const float latitude = atan2f(up, sqrtf(forward * forward + left * left));
    const float u = (0.5f - longitude / (2 * (float)PI)) * (float)width - 0.5f;
    const float v = (0.5f - latitude / (float)PI) * (float)height - 0.5f;
    const int32_t column = (int32_t)floorf(u), row = (int32_t)floorf(v);
    const float s = u - (float)column, t = v - (float)row;
    /* Columns go round; rows end at the poles. */
    const int32_t first = (column + width) % width, second = (first + 1) % width;
    const int32_t above = row < 0 ? 0 : row, below = row + 1 < height ? row + 1 : height - 1;
    const uint8_t *upper = picture->luma + (size_t)above * picture->stride;
    const uint8_t *lower = picture->luma + (size_t)below * picture->stride;
    const float over = (1 - s) * (float)upper[first] + s * (float)upper[second];
    const float under = (1 - s) * (float)lower[first] + s * (float)lower[second];
    return (uint8_t)((1 - t) * over + t * under + 0.5f);
}

void cut(const sphere *picture, const double camera_from_view[4], double focal_px, uint32_t size_px, uint8_t *view) {
    const double *q = camera_from_view;
    /* The axes of the view (x right, y down, z forward) in the camera frame (x forward, y left, z up). */
    const float right[3] = {
        (float)(1 - 2 * (q[1] * q[1] + q[2] * q[2])),
        (float)(2 * (q[0] * q[1] + q[2] * q[3])),
        (float)(2 * (q[0] * q[2] - q[1] * q[3])),
    };
    const float down[3] = {
        (float)(2 * (q[0] * q[1] - q[2] * q[3])),
        (float)(1 - 2 * (q[0] * q[0] + q[2] * q[2])),
        (float)(2 * (q[1] * q[2] + q[0] * q[3])),
    };
    const float ahead[3] = {
        (float)(2 * (q[0] * q[2] + q[1] * q[3])),
        (float)(2 * (q[1] * q[2] - q[0] * q[3])),
        (float)(1 - 2 * (q[0] * q[0] + q[1] * q[1])),
    };
    const float centre = (float)(size_px - 1) / 2, focal = (float)focal_px;
    for (uint32_t row = 0; row < size_px; row++) {
        const float y = ((float)row - centre) / focal;
        for (uint32_t column = 0; column < size_px; column++) {
            const float x = ((float)column - centre) / focal;
            float ray[3];
            for (int axis = 0; axis < 3; axis++) {
                ray[axis] = x * right[axis] + y * down[axis] + ahead[axis];
            }
            view[(size_t)row * size_px + column] = level(picture, ray[0], ray[1], ray[2]);
        }
    }
}
