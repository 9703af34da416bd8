/* Which views of a frame are cut, and when that stops. */
#ifndef PLAN_H
#define PLAN_H

#include <stdbool.h>
#include <stdint.h>

#include <flockeye/stage.h>

enum { MAX_VIEWS = 256 };

/* Views in the order in which they are to be cut. */
typedef struct {
    flockeye_plan_header header;
    flockeye_planned_view views[MAX_VIEWS];
    uint32_t count;
} plan;

/* How far a frame has come. */
typedef struct {
    uint32_t issued;
    bool has_hit, is_newer_there, is_lossless;
} progress;

/* The tiles of the sphere as the configuration has them: a plan for frames for which there is none. */
int plan_of_all_tiles(const flockeye_stage *stage, plan *self);

/* The same tiles in the same order, beginning with tile `first`. */
void plan_begin_with(const plan *tiles, uint32_t first, plan *self);

/* Why no more views are given, a flockeye_stop_reason; -1: more are. */
int plan_reason_to_stop(const plan *self, progress so_far);

#endif
