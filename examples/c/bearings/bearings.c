/* A fusion in place of Flockeye's own that only says in which direction neighbours are, in C.
 *
 *     make install-c PREFIX=/usr/local
 *     cmake -S examples/c/bearings -B examples/c/bearings/build && cmake --build examples/c/bearings/build
 *     flockeye swap fusion --accept-worse -- examples/c/bearings/build/bearings
 *
 * A neighbour is reported at one metre along the mean of its markers' rays, with a covariance that says that only the
 * direction is known. It keeps no track: every frame stands for itself. Plans sweep the whole sphere.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <flockeye/stage.h>

#include "rays.h"

enum { MAX_VIEWS = 256, MAX_TARGETS = 64, MAX_TRACKS = 16, MAX_FRAMES = 16 };

/* How often it looks for frames that are overdue. */
static const int64_t POLL_NS = 50000000;

/* What was said of one frame. */
typedef struct {
    flockeye_frame_stamp stamp;
    int64_t begun_ns;
    bool has_end, is_answered[MAX_VIEWS];
    uint32_t views_issued;
    rays of[MAX_TARGETS];
} open_frame;

typedef struct {
    flockeye_stage *stage;
    flockeye_subscriber *answers, *frame_ends;
    flockeye_publisher *tracks, *plans;
    flockeye_planned_view tiles[MAX_VIEWS];
    uint32_t tile_count, next_tile, budget;
    flockeye_pose observer_from_camera;
    int64_t deadline_ns;
    uint64_t plan_id;
    /* Open frames, the oldest first, and the newest that has ended. */
    open_frame frames[MAX_FRAMES];
    uint32_t frame_count;
    flockeye_frame_stamp ended;
    bool has_ended;
} fusion;

/* Whether a frame comes before another. */
static bool is_before(const flockeye_frame_stamp *a, const flockeye_frame_stamp *b) {
    if (a->source_generation != b->source_generation) {
        return a->source_generation < b->source_generation;
    }
    return a->epoch != b->epoch ? a->epoch < b->epoch : a->sequence < b->sequence;
}

/* Where to look next: the tiles in turn. */
static int send_plan(fusion *self, const flockeye_frame_stamp *after) {
    flockeye_planned_view views[MAX_VIEWS];
    for (uint32_t k = 0; k < self->tile_count; k++) {
        views[k] = self->tiles[(self->next_tile + k) % self->tile_count];
    }
    self->next_tile = (self->next_tile + self->budget) % self->tile_count;
    flockeye_plan_header header = {
        .plan_id = ++self->plan_id,
        .made_ns = flockeye_now_ns(),
        .has_after = after != NULL,
        .generation = flockeye_stage_generation(self->stage),
        .stop_rule = FLOCKEYE_STOP_RULE_DEADLINE,
        .mode = FLOCKEYE_SEARCH_MODE_GAZE,
        .view_budget = self->budget,
    };
    if (after) {
        header.after = *after;
    }
    return flockeye_send(self->plans, &header, views, self->tile_count);
}

/* Ends the oldest frame: says whom it shows, and plans the next one. */
static int end_oldest(fusion *self) {
    const open_frame *frame = &self->frames[0];
    flockeye_track tracks[MAX_TRACKS];
    size_t count = 0;
    for (uint32_t target = 0; target < MAX_TARGETS && count < MAX_TRACKS; target++) {
        if (frame->of[target].count > 0) {
            const char *name = flockeye_stage_target_name(self->stage, target);
            flockeye_track *track = &tracks[count++];
            *track = (flockeye_track){
                .target = target,
                .state = FLOCKEYE_TRACK_STATE_MEASURED,
                .measured_by = FLOCKEYE_MEASURED_BY_DECODED,
            };
            strncpy(track->name, name ? name : "", sizeof track->name - 1);
            rays_to_track(&frame->of[target], &self->observer_from_camera, track);
        }
    }
    const flockeye_track_header header = {
        .stamp = frame->stamp,
        .generation = flockeye_stage_generation(self->stage),
        .is_last = 1,
    };
    self->ended = frame->stamp;
    self->has_ended = true;
    memmove(&self->frames[0], &self->frames[1], --self->frame_count * sizeof *frame);
    if (flockeye_send(self->tracks, &header, tracks, count) != FLOCKEYE_OK) {
        return FLOCKEYE_FAILED;
    }
    return send_plan(self, &header.stamp);
}

/* Whether each of a frame's views is answered, or it has been waited for long enough. */
static bool is_over(const fusion *self, const open_frame *frame, int64_t now_ns) {
    uint32_t answered = 0;
    while (answered < MAX_VIEWS && frame->is_answered[answered]) {
        answered++;
    }
    return (frame->has_end && answered >= frame->views_issued) || now_ns - frame->begun_ns > self->deadline_ns;
}

/* Ends what is over, and what is older: it was under way when this process began, or its worker died. */
static int end_frames(fusion *self) {
    const int64_t now_ns = flockeye_now_ns();
    uint32_t over = 0;
    for (uint32_t k = 0; k < self->frame_count; k++) {
        over = is_over(self, &self->frames[k], now_ns) ? k + 1 : over;
    }
    while (over-- > 0) {
        if (end_oldest(self) != FLOCKEYE_OK) {
            return FLOCKEYE_FAILED;
        }
    }
    return FLOCKEYE_OK;
}

/* The open frame of a stamp, which it opens; NULL if the frame has ended, or is older than all that fit. */
static open_frame *open_one(fusion *self, const flockeye_frame_stamp *stamp) {
    if (self->has_ended && !is_before(&self->ended, stamp)) {
        return NULL;
    }
    uint32_t place = self->frame_count;
    while (place > 0 && is_before(stamp, &self->frames[place - 1].stamp)) {
        place--;
    }
    if (place > 0 && !is_before(&self->frames[place - 1].stamp, stamp)) {
        return &self->frames[place - 1];
    }
    if (self->frame_count == MAX_FRAMES) {
        return NULL;
    }
    open_frame *frame = &self->frames[place];
    memmove(frame + 1, frame, (self->frame_count++ - place) * sizeof *frame);
    memset(frame, 0, sizeof *frame);
    frame->stamp = *stamp;
    frame->begun_ns = flockeye_now_ns();
    return frame;
}

/* Of two records of one view the first counts. */
static void on_record(fusion *self, const flockeye_message *message) {
    const flockeye_detection_header *record = message->header;
    const flockeye_detected_marker *markers = message->items;
    open_frame *frame = record->view_index < MAX_VIEWS ? open_one(self, &record->stamp) : NULL;
    if (!frame || frame->is_answered[record->view_index]) {
        return;
    }
    frame->is_answered[record->view_index] = true;
    for (size_t k = 0; k < message->count; k++) {
        const uint32_t target = flockeye_stage_target_of_marker(self->stage, markers[k].id);
        for (int corner = 0; corner < 4 && target < MAX_TARGETS && !markers[k].doubtful; corner++) {
            rays_add(&frame->of[target], &self->observer_from_camera, markers[k].rays_in_camera[corner]);
        }
    }
}

static void on_end(fusion *self, const flockeye_frame_end *end) {
    open_frame *frame = open_one(self, &end->stamp);
    if (frame) {
        frame->has_end = true;
        frame->views_issued = end->views_issued;
    }
}

static int step(void *context) {
    fusion *self = context;
    flockeye_message message;
    int outcome = flockeye_update_connections(self->plans);
    while (outcome != FLOCKEYE_FAILED && (outcome = flockeye_receive(self->answers, &message)) == FLOCKEYE_OK) {
        on_record(self, &message);
        flockeye_release(&message);
    }
    while (outcome != FLOCKEYE_FAILED && (outcome = flockeye_receive(self->frame_ends, &message)) == FLOCKEYE_OK) {
        on_end(self, message.header);
        flockeye_release(&message);
    }
    flockeye_stage_wake_within(self->stage, POLL_NS);
    return outcome == FLOCKEYE_FAILED ? FLOCKEYE_FAILED : end_frames(self);
}

/* A value of a tile: a number, or a list of them. */
static bool read_tile(const fusion *self, uint32_t tile, const char *key, double *numbers, size_t count) {
    char pointer[64];
    snprintf(pointer, sizeof pointer, "/resolved/partitions/%u/%s", tile, key);
    return flockeye_stage_numbers(self->stage, pointer, numbers, count) == FLOCKEYE_OK;
}

/* Reads the settings and opens the ports; false: flockeye_error() says why not. */
static bool open_all(fusion *self) {
    flockeye_stage *stage = self->stage;
    flockeye_pose *mount = &self->observer_from_camera;
    double deadline_ms, budget, size_px;
    size_t tiles;
    if (flockeye_stage_numbers(stage, "/fusion/deadline_ms", &deadline_ms, 1) != FLOCKEYE_OK
        || flockeye_stage_numbers(stage, "/search/lossless_partitions", &budget, 1) != FLOCKEYE_OK
        || flockeye_stage_numbers(stage, "/resolved/observer_from_camera/position", mount->position, 3) != FLOCKEYE_OK
        || flockeye_stage_numbers(stage, "/resolved/observer_from_camera/orientation", mount->orientation, 4)
               != FLOCKEYE_OK
        || flockeye_stage_count(stage, "/resolved/partitions", &tiles) != FLOCKEYE_OK) {
        return false;
    }
    self->deadline_ns = (int64_t)(deadline_ms * 1e6);
    self->tile_count = tiles < MAX_VIEWS ? (uint32_t)tiles : MAX_VIEWS;
    self->budget = budget < self->tile_count ? (uint32_t)budget : self->tile_count;
    for (uint32_t tile = 0; tile < self->tile_count; tile++) {
        flockeye_planned_view *view = &self->tiles[tile];
        if (!read_tile(self, tile, "camera_from_view", view->camera_from_view, 4)
            || !read_tile(self, tile, "focal_px", &view->focal_px, 1)
            || !read_tile(self, tile, "size_px", &size_px, 1)) {
            return false;
        }
        view->size_px = (uint32_t)size_px;
        view->kind = FLOCKEYE_VIEW_KIND_PARTITION;
        view->tile = tile;
        view->target = FLOCKEYE_NONE;
    }
    self->answers = flockeye_subscribe(stage, FLOCKEYE_TOPIC_DETECTION, 0);
    self->frame_ends = flockeye_subscribe(stage, FLOCKEYE_TOPIC_FRAME_END, 0);
    self->tracks = flockeye_advertise(stage, FLOCKEYE_TOPIC_TRACK, 0);
    self->plans = flockeye_advertise(stage, FLOCKEYE_TOPIC_PLAN, 0);
    return self->answers && self->frame_ends && self->tracks && self->plans && send_plan(self, NULL) == FLOCKEYE_OK;
}

int main(void) {
    static fusion self;
    self.stage = flockeye_stage_open("fusion");
    if (!self.stage || !open_all(&self)) {
        fprintf(stderr, "cannot start: %s\n", flockeye_error());
        return FLOCKEYE_CANNOT_START;
    }
    const int outcome = flockeye_stage_run(self.stage, "bearings alone, in C", step, &self);
    if (outcome != FLOCKEYE_OK) {
        fprintf(stderr, "%s\n", flockeye_error());
    }
    flockeye_subscriber_close(self.answers);
    flockeye_subscriber_close(self.frame_ends);
    flockeye_publisher_close(self.tracks);
    flockeye_publisher_close(self.plans);
    flockeye_stage_close(self.stage);
    return outcome == FLOCKEYE_OK ? EXIT_SUCCESS : EXIT_FAILURE;
}
