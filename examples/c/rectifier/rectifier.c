/* A rectification in place of Flockeye's own, in C.
 *
 *     make install-c PREFIX=/usr/local
 *     cmake -S examples/c/rectifier -B examples/c/rectifier/build && cmake --build examples/c/rectifier/build
 *     flockeye swap rectification --accept-worse -- examples/c/rectifier/build/rectifier
 *
 * Needs equirectangular frames. It samples them pixel by pixel (sphere.c), without threads or tables, so it is slower
 * than Flockeye's own: fewer views of each frame are cut.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "in_flight.h"
#include "plan.h"
#include "sphere.h"

/* A plan older than this is not followed: fusion has died since. */
static const int64_t STALE_PLAN_NS = 1000000000;
/* How often it looks for views that are late. */
static const int64_t POLL_NS = 50000000;

typedef struct {
    flockeye_stage *stage;
    flockeye_subscriber *frames, *plans, *answers;
    flockeye_publisher *lanes[MAX_WORKERS], *frame_ends;
    uint32_t window, width, height, largest_view_px, next_tile;
    int64_t overdue_ns;
    bool is_lossless, has_plan;
    plan tiles, newest;
    /* The newest frame, and the frame in work. There is one where `owner` is set. */
    flockeye_message waiting, frame;
    /* Of the frame in work: its plan, and how far it has come. */
    plan followed;
    int64_t taken_ns;
    uint32_t issued;
    bool has_hit, is_ended;
    in_flight views;
} rectifier;

/* Keeps the newest plan whose views can be cut. */
static void on_plan(rectifier *self, const flockeye_message *message) {
    const flockeye_planned_view *views = message->items;
    for (size_t k = 0; k < message->count; k++) {
        if (views[k].size_px > self->largest_view_px) {
            char what[96];
            snprintf(what, sizeof what, "a plan with a view of %u px, where %u px are the most", views[k].size_px,
                     self->largest_view_px);
            flockeye_stage_refuse(self->stage, what);
            return;
        }
    }
    /* A message with more than 256 views breaks the contract, and is not received. */
    self->newest.header = *(const flockeye_plan_header *)message->header;
    self->newest.count = (uint32_t)message->count;
    memcpy(self->newest.views, views, message->count * sizeof *views);
    self->has_plan = true;
}

static void on_answer(rectifier *self, const flockeye_detection_header *answer) {
    if (answer->worker < self->views.workers) {
        self->views.silences[answer->worker] = 0;
    }
    if (self->frame.owner) {
        const flockeye_frame_stamp *ours = &((const flockeye_frame_header *)self->frame.header)->stamp;
        const bool is_ours = answer->stamp.sequence == ours->sequence && answer->stamp.epoch == ours->epoch
                             && answer->stamp.source_generation == ours->source_generation;
        if (is_ours && in_flight_answered(&self->views, answer->view_index, answer->attempt)) {
            self->has_hit |= answer->hits > 0;
        }
    }
}

/* Takes up the frame that waits. It is kept until all of its views are answered. */
static void take_up(rectifier *self) {
    const flockeye_frame_header *frame = self->waiting.header;
    if (frame->width != self->width || frame->height != self->height) {
        char what[96];
        snprintf(what, sizeof what, "a frame of %ux%u pixels, where %ux%u are configured", frame->width, frame->height,
                 self->width, self->height);
        flockeye_stage_refuse(self->stage, what);
        flockeye_release(&self->waiting);
        return;
    }
    self->frame = self->waiting;
    self->waiting = (flockeye_message){0};
    self->taken_ns = flockeye_now_ns();
    self->issued = self->views.count = 0;
    self->has_hit = self->is_ended = false;
    if (self->has_plan
        && (self->is_lossless || self->newest.header.made_ns > self->taken_ns - STALE_PLAN_NS)) {
        self->followed = self->newest;
        return;
    }
    plan_begin_with(&self->tiles, self->next_tile, &self->followed);
    self->next_tile = (self->next_tile + 1) % self->tiles.count;
}

/* Cuts a view into the memory of the worker's lane. */
static int give(rectifier *self, uint32_t index, uint32_t attempt, uint32_t worker) {
    const flockeye_planned_view *planned = &self->followed.views[index];
    const flockeye_frame_header *frame = self->frame.header;
    flockeye_view_header view = {
        .stamp = frame->stamp,
        .plan_id = self->followed.header.plan_id,
        .taken_ns = self->taken_ns,
        .focal_px = planned->focal_px,
        .predicted_camera_from_markers = planned->predicted_camera_from_markers,
        .readout_ns = frame->readout_ns,
        .generation = flockeye_stage_generation(self->stage),
        .view_index = index,
        .attempt = attempt,
        .worker = worker,
        .size_px = planned->size_px,
        .stride = planned->size_px,
        .kind = planned->kind,
        .tile = planned->tile,
        .target = planned->target,
        .has_prediction = planned->has_prediction,
        .transfer = frame->transfer,
        .gamma = frame->gamma,
        .range = frame->range,
        .search = planned->search,
    };
    flockeye_loan loan;
    if (flockeye_loan_items(self->lanes[worker], (size_t)view.size_px * view.size_px, &loan) != FLOCKEYE_OK) {
        return FLOCKEYE_FAILED;
    }
    const sphere picture = {self->frame.items, frame->width, frame->height, frame->stride};
    turned(planned, frame->stamp.exposure_ns, view.camera_from_view);
    cut(&picture, view.camera_from_view, view.focal_px, view.size_px, loan.items);
    view.issued_ns = flockeye_now_ns();
    in_flight_add(&self->views, (given_view){index, attempt, worker, view.issued_ns});
    return flockeye_send_loan(self->lanes[worker], &loan, &view);
}

static int end(rectifier *self, int reason) {
    const flockeye_frame_end message = {
        .stamp = ((const flockeye_frame_header *)self->frame.header)->stamp,
        .plan_id = self->followed.header.plan_id,
        .taken_ns = self->taken_ns,
        .ended_ns = flockeye_now_ns(),
        .views_issued = self->issued,
        .views_abandoned = self->followed.count - self->issued,
        .reason = (uint32_t)reason,
        .generation = flockeye_stage_generation(self->stage),
    };
    self->is_ended = true;
    return flockeye_send(self->frame_ends, &message, NULL, 0);
}

/* Does one piece of work for the frame. FLOCKEYE_NOTHING: there is nothing to do but to wait. */
static int work(rectifier *self) {
    given_view late;
    if (in_flight_take_late(&self->views, flockeye_now_ns() - self->overdue_ns, &late)) {
        flockeye_stage_complain(self->stage, late.worker, self->views.silences[late.worker], "a view is not answered");
        /* An ended frame makes room for a newer one: nobody needs its view any more. */
        if (self->is_ended && self->waiting.owner) {
            return FLOCKEYE_OK;
        }
        return give(self, late.index, late.attempt + 1, in_flight_other(&self->views, late.worker));
    }
    if (self->is_ended) {
        if (self->views.count > 0) {
            return FLOCKEYE_NOTHING;
        }
        flockeye_release(&self->frame);
        return FLOCKEYE_OK;
    }
    const progress so_far = {self->issued, self->has_hit, self->waiting.owner != NULL, self->is_lossless};
    const int reason = plan_reason_to_stop(&self->followed, so_far);
    if (reason >= 0) {
        return end(self, reason);
    }
    const uint32_t worker = in_flight_next(&self->views, self->window);
    return worker == FLOCKEYE_NONE ? FLOCKEYE_NOTHING : give(self, self->issued++, 0, worker);
}

/* The newest frame; in a lossless run none is left out. */
static int receive_frames(rectifier *self) {
    flockeye_message message;
    int outcome = FLOCKEYE_NOTHING;
    while (!(self->is_lossless && self->waiting.owner)
           && (outcome = flockeye_receive(self->frames, &message)) == FLOCKEYE_OK) {
        flockeye_release(&self->waiting);
        self->waiting = message;
    }
    return outcome == FLOCKEYE_FAILED ? FLOCKEYE_FAILED : FLOCKEYE_OK;
}

static int step(void *context) {
    rectifier *self = context;
    flockeye_message message;
    int outcome;
    while ((outcome = flockeye_receive(self->plans, &message)) == FLOCKEYE_OK) {
        on_plan(self, &message);
        flockeye_release(&message);
    }
    while (outcome != FLOCKEYE_FAILED && (outcome = flockeye_receive(self->answers, &message)) == FLOCKEYE_OK) {
        on_answer(self, message.header);
        flockeye_release(&message);
    }
    if (outcome == FLOCKEYE_FAILED || receive_frames(self) == FLOCKEYE_FAILED) {
        return FLOCKEYE_FAILED;
    }
    if (!self->frame.owner && self->waiting.owner) {
        take_up(self);
    }
    outcome = self->frame.owner ? work(self) : FLOCKEYE_NOTHING;
    /* Another step at once while there is work. */
    flockeye_stage_wake_within(self->stage, outcome == FLOCKEYE_OK ? 0 : POLL_NS);
    return outcome == FLOCKEYE_NOTHING ? FLOCKEYE_OK : outcome;
}

/* Reads the settings and opens the ports; false: flockeye_error() says why not. */
static bool open_all(rectifier *self) {
    flockeye_stage *stage = self->stage;
    double overdue_ms;
    const struct {
        const char *pointer;
        uint32_t *value;
    } settings[] = {
        {"/camera/width", &self->width},
        {"/camera/height", &self->height},
        {"/rectification/window", &self->window},
        {"/resolved/workers", &self->views.workers},
        {"/resolved/largest_view_px", &self->largest_view_px},
    };
    for (size_t k = 0; k < sizeof settings / sizeof *settings; k++) {
        double number;
        if (flockeye_stage_numbers(stage, settings[k].pointer, &number, 1) != FLOCKEYE_OK) {
            return false;
        }
        *settings[k].value = (uint32_t)number;
    }
    if (self->views.workers > MAX_WORKERS) {
        self->views.workers = MAX_WORKERS;
    }
    char flow[16];
    if (flockeye_stage_numbers(stage, "/rectification/overdue_ms", &overdue_ms, 1) != FLOCKEYE_OK
        || flockeye_stage_text(stage, "/flow", flow, sizeof flow) != FLOCKEYE_OK
        || plan_of_all_tiles(stage, &self->tiles) != FLOCKEYE_OK) {
        return false;
    }
    self->overdue_ns = (int64_t)(overdue_ms * 1e6);
    self->is_lossless = strcmp(flow, "lossless") == 0;
    self->frames = flockeye_subscribe(stage, FLOCKEYE_TOPIC_FRAME, 0);
    self->plans = flockeye_subscribe(stage, FLOCKEYE_TOPIC_PLAN, 0);
    self->answers = flockeye_subscribe(stage, FLOCKEYE_TOPIC_DETECTION, 0);
    self->frame_ends = flockeye_advertise(stage, FLOCKEYE_TOPIC_FRAME_END, 0);
    bool is_open = self->frames && self->plans && self->answers && self->frame_ends;
    for (uint32_t worker = 0; worker < self->views.workers && is_open; worker++) {
        self->lanes[worker] = flockeye_advertise(stage, FLOCKEYE_TOPIC_VIEW, worker);
        is_open = self->lanes[worker] != NULL;
    }
    return is_open;
}

static int cannot_start(const char *why) {
    fprintf(stderr, "cannot start: %s\n", why);
    return FLOCKEYE_CANNOT_START;
}

int main(void) {
    static rectifier self;
    self.stage = flockeye_stage_open("rectification");
    if (!self.stage || !open_all(&self)) {
        return cannot_start(flockeye_error());
    }
    char projection[32];
    if (flockeye_stage_text(self.stage, "/camera/projection", projection, sizeof projection) != FLOCKEYE_OK
        || strcmp(projection, "equirectangular") != 0) {
        return cannot_start("this rectification knows camera.projection: equirectangular alone");
    }
    const int outcome = flockeye_stage_run(self.stage, "plain C, pixel by pixel", step, &self);
    if (outcome != FLOCKEYE_OK) {
        fprintf(stderr, "%s\n", flockeye_error());
    }
    flockeye_release(&self.waiting);
    flockeye_release(&self.frame);
    flockeye_subscriber_close(self.frames);
    flockeye_subscriber_close(self.plans);
    flockeye_subscriber_close(self.answers);
    flockeye_publisher_close(self.frame_ends);
    for (uint32_t worker = 0; worker < self.views.workers; worker++) {
        flockeye_publisher_close(self.lanes[worker]);
    }
    flockeye_stage_close(self.stage);
    return outcome == FLOCKEYE_OK ? EXIT_SUCCESS : EXIT_FAILURE;
}
