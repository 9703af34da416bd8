#include "plan.h"

#include <stdio.h>

/* A number of a tile, or a list of them. */
static int tile_numbers(const flockeye_stage *stage, size_t tile, const char *key, double *numbers, size_t count) {
    char pointer[64];
    snprintf(pointer, sizeof pointer, "/resolved/partitions/%zu/%s", tile, key);
    return flockeye_stage_numbers(stage, pointer, numbers, count);
}

int plan_of_all_tiles(const flockeye_stage *stage, plan *self) {
    size_t count;
    if (flockeye_stage_count(stage, "/resolved/partitions", &count) != FLOCKEYE_OK) {
        return FLOCKEYE_FAILED;
    }
    *self = (plan){.header = {.stop_rule = FLOCKEYE_STOP_RULE_DEADLINE, .view_budget = 1}};
    self->count = count < MAX_VIEWS ? (uint32_t)count : MAX_VIEWS;
    for (uint32_t tile = 0; tile < self->count; tile++) {
        flockeye_planned_view *view = &self->views[tile];
        double size_px;
        if (tile_numbers(stage, tile, "camera_from_view", view->camera_from_view, 4) != FLOCKEYE_OK
            || tile_numbers(stage, tile, "focal_px", &view->focal_px, 1) != FLOCKEYE_OK
            || tile_numbers(stage, tile, "size_px", &size_px, 1) != FLOCKEYE_OK) {
            return FLOCKEYE_FAILED;
        }
        view->size_px = (uint32_t)size_px;
        view->kind = FLOCKEYE_VIEW_KIND_PARTITION;
        view->tile = tile;
        view->target = FLOCKEYE_NONE;
    }
    return FLOCKEYE_OK;
}

void plan_begin_with(const plan *tiles, uint32_t first, plan *self) {
    *self = *tiles;
    for (uint32_t k = 0; k < tiles->count; k++) {
        self->views[k] = tiles->views[(first + k) % tiles->count];
    }
}

int plan_reason_to_stop(const plan *self, progress so_far) {
    if (self->header.stop_rule == FLOCKEYE_STOP_RULE_FIRST_HIT && so_far.has_hit) {
        return FLOCKEYE_STOP_REASON_HIT;
    }
    if (so_far.issued == self->count) {
        return FLOCKEYE_STOP_REASON_COMPLETE;
    }
    if (self->header.stop_rule == FLOCKEYE_STOP_RULE_DEADLINE && so_far.issued > 0) {
        if (so_far.is_lossless) {
            return so_far.issued >= self->header.view_budget ? FLOCKEYE_STOP_REASON_BUDGET : -1;
        }
        /* Regions of interest are cut even if a newer frame waits. */
        if (so_far.is_newer_there && self->views[so_far.issued].kind != FLOCKEYE_VIEW_KIND_GAZE) {
            return FLOCKEYE_STOP_REASON_NEWER;
        }
    }
    return -1;
}
