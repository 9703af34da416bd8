/* Which worker has which view of a frame, and for how long. */
#ifndef IN_FLIGHT_H
#define IN_FLIGHT_H

#include <stdbool.h>
#include <stdint.h>

#include "plan.h"

/* As many as a pipeline may have. */
enum { MAX_WORKERS = 16 };

/* A view that its worker has not answered. */
typedef struct {
    uint32_t index, attempt, worker;
    int64_t given_ns;
} given_view;

typedef struct {
    given_view views[MAX_VIEWS];
    uint32_t count;
    uint32_t workers;
    /* How often in a row each worker has not answered in time. */
    uint64_t silences[MAX_WORKERS];
} in_flight;

/* Notes that a worker has a view. No view is given twice unless it was taken back. */
void in_flight_add(in_flight *self, given_view view);

/* Takes a view that was answered out; false if nobody waits for this answer. An earlier attempt may answer too. */
bool in_flight_answered(in_flight *self, uint32_t index, uint32_t attempt);

/* Takes a view back that was given before `given_before_ns`, and counts its worker's silence; false if none is late. */
bool in_flight_take_late(in_flight *self, int64_t given_before_ns, given_view *late);

/* The worker with the fewest views, of those with fewer than `window`; FLOCKEYE_NONE if none has room. A silent worker
 * gets a view only where the others have no room, and one at a time. */
uint32_t in_flight_next(const in_flight *self, uint32_t window);

/* Who gets a silent worker's view: another with the fewest, or the same one if it is alone. */
uint32_t in_flight_other(const in_flight *self, uint32_t silent);

#endif
