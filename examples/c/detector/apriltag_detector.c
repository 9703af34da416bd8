/* A detector in place of Flockeye's own, in C: AprilRobotics' detector, for bodies of the family tag36h11.
 *
 *     make install-c PREFIX=/usr/local
 *     cmake -S examples/c/detector -B examples/c/detector/build && cmake --build examples/c/detector/build
 *     flockeye up --set bodies.dictionary=DICT_APRILTAG_36h11 &
 *     flockeye swap detection -- examples/c/detector/build/apriltag-detector
 *
 * Needs Debian's libapriltag-dev. `flockeye stage test detection --set bodies.dictionary=DICT_APRILTAG_36h11 --
 * examples/c/detector/build/apriltag-detector` says how it compares with Flockeye's own.
 */
#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <flockeye/stage.h>

enum { MAX_MARKERS = 64, SMALLEST_PX = 16 };

/* Assumed standard deviation of a corner. */
static const double DEVIATION_PX = 0.3;

typedef struct {
    flockeye_stage *stage;
    flockeye_subscriber *views;
    flockeye_publisher *detections;
    apriltag_detector_t *detector;
} worker;

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

/* A corner in the view, and its ray in the camera frame. */
static void set_corner(const flockeye_view_header *view, const double pixel[2], flockeye_detected_marker *marker, int k) {
    /* AprilTag's origin is the corner of the first pixel, the contract's is its centre. What is stored, rounded to
     * float, is what the ray must belong to. */
    const float x = (float)(pixel[0] - 0.5), y = (float)(pixel[1] - 0.5);
    const double centre = (view->size_px - 1) / 2.0;
    double ray[3] = {(x - centre) / view->focal_px, (y - centre) / view->focal_px, 1.0};
    const double length = sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0);
    for (int axis = 0; axis < 3; axis++) {
        ray[axis] /= length;
    }
    rotate(view->camera_from_view, ray, marker->rays_in_camera[k]);
    marker->corners_in_view[k][0] = x;
    marker->corners_in_view[k][1] = y;
    marker->deviations[k] = DEVIATION_PX / view->focal_px;
}

/* Searches a view in place, and returns how many markers were found. */
static size_t search(const worker *self, const flockeye_view_header *view, const void *pixels,
                     flockeye_detected_marker *markers, uint32_t *hits) {
    /* AprilTag only reads the picture. */
    image_u8_t image = {
        .width = (int32_t)view->size_px,
        .height = (int32_t)view->size_px,
        .stride = (int32_t)view->stride,
        .buf = (uint8_t *)pixels,
    };
    zarray_t *found = apriltag_detector_detect(self->detector, &image);
    size_t count = 0;
    for (int index = 0; index < zarray_size(found) && count < MAX_MARKERS; index++) {
        apriltag_detection_t *tag;
        zarray_get(found, index, &tag);
        /* Two wrong bits are as many as can be mended without doubt. */
        if (tag->hamming > 2) {
            continue;
        }
        flockeye_detected_marker *marker = &markers[count++];
        memset(marker, 0, sizeof *marker);
        marker->id = (uint32_t)tag->id;
        for (int k = 0; k < 4; k++) {
            /* AprilTag goes round the other way. OpenCV's picture of a tag is turned by half against its own, so
             * the corner that the contract begins with is its second. */
            set_corner(view, tag->p[(5 - k) % 4], marker, k);
        }
        *hits += flockeye_stage_owns_marker(self->stage, marker->id);
    }
    apriltag_detections_destroy(found);
    return count;
}

/* Answers every view that waits. */
static int step(void *context) {
    const worker *self = context;
    flockeye_message message;
    int outcome;
    while ((outcome = flockeye_receive(self->views, &message)) == FLOCKEYE_OK) {
        const flockeye_view_header *view = message.header;
        const int64_t received_ns = flockeye_now_ns();
        /* A view left over from another worker of this lane is not ours to answer. */
        if (view->worker == flockeye_stage_replica(self->stage)) {
            flockeye_detected_marker markers[MAX_MARKERS];
            flockeye_detection_header answer;
            uint32_t hits = 0;
            size_t count = 0;
            /* AprilTag must not be given a picture of a few pixels. */
            if (view->search != FLOCKEYE_SEARCH_NOTHING && view->size_px >= SMALLEST_PX) {
                count = search(self, view, message.items, markers, &hits);
            }
            flockeye_answer(self->stage, view, received_ns, &answer);
            answer.hits = hits;
            outcome = flockeye_send(self->detections, &answer, markers, count);
        }
        flockeye_release(&message);
        if (outcome != FLOCKEYE_OK) {
            return outcome;
        }
    }
    return outcome == FLOCKEYE_NOTHING ? FLOCKEYE_OK : outcome;
}

static int cannot_start(const char *why) {
    fprintf(stderr, "cannot start: %s\n", why);
    return FLOCKEYE_CANNOT_START;
}

int main(void) {
    worker self = {.stage = flockeye_stage_open("detection")};
    if (!self.stage) {
        return cannot_start(flockeye_error());
    }
    if (strcmp(flockeye_stage_dictionary(self.stage), "DICT_APRILTAG_36h11") != 0) {
        return cannot_start("this detector knows bodies.dictionary: DICT_APRILTAG_36h11 alone");
    }
    self.views = flockeye_subscribe(self.stage, FLOCKEYE_TOPIC_VIEW, flockeye_stage_replica(self.stage));
    self.detections = flockeye_advertise(self.stage, FLOCKEYE_TOPIC_DETECTION, 0);
    if (!self.views || !self.detections) {
        return cannot_start(flockeye_error());
    }
    apriltag_family_t *family = tag36h11_create();
    self.detector = apriltag_detector_create();
    apriltag_detector_add_family(self.detector, family);
    self.detector->nthreads = 1;
    self.detector->quad_decimate = 1.0;

    const int outcome = flockeye_stage_run(self.stage, "AprilTag 3, in C", step, &self);
    if (outcome != FLOCKEYE_OK) {
        fprintf(stderr, "%s\n", flockeye_error());
    }
    flockeye_subscriber_close(self.views);
    flockeye_publisher_close(self.detections);
    flockeye_stage_close(self.stage);
    apriltag_detector_destroy(self.detector);
    tag36h11_destroy(family);
    return outcome == FLOCKEYE_OK ? EXIT_SUCCESS : EXIT_FAILURE;
}
