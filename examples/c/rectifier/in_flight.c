#include "in_flight.h"

static given_view take(in_flight *self, uint32_t place) {
    const given_view taken = self->views[place];
    self->views[place] = self->views[--self->count];
    return taken;
}

void in_flight_add(in_flight *self, given_view view) {
    self->views[self->count++] = view;
}

bool in_flight_answered(in_flight *self, uint32_t index, uint32_t attempt) {
    for (uint32_t place = 0; place < self->count; place++) {
        if (self->views[place].index == index && attempt <= self->views[place].attempt) {
            take(self, place);
            return true;
        }
    }
    return false;
}

bool in_flight_take_late(in_flight *self, int64_t given_before_ns, given_view *late) {
    for (uint32_t place = 0; place < self->count; place++) {
        if (self->views[place].given_ns < given_before_ns) {
            *late = take(self, place);
            self->silences[late->worker]++;
            return true;
        }
    }
    return false;
}

/* How many views a worker has. */
static uint32_t load(const in_flight *self, uint32_t worker) {
    uint32_t count = 0;
    for (uint32_t place = 0; place < self->count; place++) {
        count += self->views[place].worker == worker;
    }
    return count;
}

uint32_t in_flight_next(const in_flight *self, uint32_t window) {
    uint32_t best = FLOCKEYE_NONE, best_load = 0;
    /* Those that answer first. */
    for (int is_silent = 0; is_silent <= 1 && best == FLOCKEYE_NONE; is_silent++) {
        for (uint32_t worker = 0; worker < self->workers; worker++) {
            const uint32_t its_load = load(self, worker);
            const bool has_room = its_load < (is_silent ? 1 : window);
            const bool is_better = best == FLOCKEYE_NONE || its_load < best_load;
            if ((self->silences[worker] > 0) == is_silent && has_room && is_better) {
                best = worker;
                best_load = its_load;
            }
        }
    }
    return best;
}

uint32_t in_flight_other(const in_flight *self, uint32_t silent) {
    uint32_t best = silent;
    for (uint32_t worker = 0; worker < self->workers; worker++) {
        if (worker != silent && (best == silent || load(self, worker) < load(self, best))) {
            best = worker;
        }
    }
    return best;
}
