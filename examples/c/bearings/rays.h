/* Directions in which a neighbour's markers are seen, and the track that they make. */
#ifndef RAYS_H
#define RAYS_H

#include <stdint.h>

#include <flockeye/contract.h>

/* Sums over unit rays in the observer's frame, and over their squares. */
typedef struct {
    double sum[3], squares[3];
    uint32_t count;
} rays;

/* Adds a ray of the camera frame. */
void rays_add(rays *self, const flockeye_pose *observer_from_camera, const double ray_in_camera[3]);

/* Writes the poses, covariances and count of markers of a neighbour one metre off, along the mean of its rays. */
void rays_to_track(const rays *self, const flockeye_pose *observer_from_camera, flockeye_track *track);

#endif
