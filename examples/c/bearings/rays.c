#include "rays.h"

#include <math.h>
#include <string.h>

/* Standard deviation along the line of sight, and of the attitude, which nothing is known of. */
static const double UNKNOWN_M = 1.0, UNKNOWN_RAD = 3.0;

/* Turns a vector by a unit quaternion (x, y, z, w). */
static void rotate(const double q[4], const double v[3], double out[3]) {
    const double t[3] = {
        2 * (q[1] * v[2] - q[2] * v[1]),
        2 * (q[2] * v[0] - q[0] * v[2]),
        2 * (q[0] * v[1] - q[1] * v[0]),
    };
    out[0] = v[0] + q[3] * t[0] + q[1] * t[2] - q[2] * t[1];
    out[1] = v[1] + q[3] * t[1] + q[2] * t[0] - q[0] * t[2];
    out[2] = v[2] + q[3] * t[2] + q[0] * t[1] - q[1] * t[0];
}

void rays_add(rays *self, const flockeye_pose *observer_from_camera, const double ray_in_camera[3]) {
    double ray[3];
    rotate(observer_from_camera->orientation, ray_in_camera, ray);
    for (int axis = 0; axis < 3; axis++) {
        self->sum[axis] += ray[axis];
        self->squares[axis] += ray[axis] * ray[axis];
    }
    self->count++;
}

void rays_to_track(const rays *self, const flockeye_pose *observer_from_camera, flockeye_track *track) {
    double length = 0, across = 0, bearing[3];
    for (int axis = 0; axis < 3; axis++) {
        const double mean = self->sum[axis] / self->count;
        const double variance = self->squares[axis] / self->count - mean * mean;
        across = fmax(across, sqrt(fmax(variance, 0)));
        bearing[axis] = mean;
        length += mean * mean;
    }
    across = across / 2 + 1e-3;
    /* Opposite rays have no mean direction; their track must still be made of numbers. */
    length = fmax(sqrt(length), 1e-9);
    flockeye_pose pose = {.orientation = {0, 0, 0, 1}};
    for (int axis = 0; axis < 3; axis++) {
        bearing[axis] /= length;
        pose.position[axis] = observer_from_camera->position[axis] + bearing[axis];
    }
    double covariance[36] = {0};
    for (int row = 0; row < 3; row++) {
        for (int column = 0; column < 3; column++) {
            covariance[6 * row + column] = UNKNOWN_M * UNKNOWN_M * bearing[row] * bearing[column];
        }
        covariance[7 * row] += across * across;
        covariance[7 * (row + 3)] = UNKNOWN_RAD * UNKNOWN_RAD;
    }
    track->observer_from_target = track->measured_observer_from_target = track->predicted_observer_from_target = pose;
    memcpy(track->covariance, covariance, sizeof covariance);
    memcpy(track->measured_covariance, covariance, sizeof covariance);
    memcpy(track->predicted_covariance, covariance, sizeof covariance);
    track->markers = self->count / 4;
}
