/* Stages in C, over the runtime that Flockeye's own stages have: shared memory, health, hand-overs, a clean end.
 *
 * docs/CONTRACT.md says what each message means and what each stage owes; contract.h has the types. All
 * messages have passed what stands under "What a message must pass" there; other numbers are as they were sent.
 *
 *     static int step(void *context) { ... flockeye_receive ... flockeye_send ... return FLOCKEYE_OK; }
 *
 *     flockeye_stage *stage = flockeye_stage_open("detection");
 *     if (!stage) { fprintf(stderr, "cannot start: %s\n", flockeye_error()); return FLOCKEYE_CANNOT_START; }
 *     ... flockeye_subscribe, flockeye_advertise ...
 *     int outcome = flockeye_stage_run(stage, "what it works with", step, &context);
 *
 * One thread uses a stage and its ports. Functions that return a pointer return NULL, and functions that return
 * a code return FLOCKEYE_FAILED, where they fail; flockeye_error() then says why.
 */
#ifndef FLOCKEYE_STAGE_H
#define FLOCKEYE_STAGE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "contract.h"

#ifdef __cplusplus
extern "C" {
#endif

enum flockeye_code {
    FLOCKEYE_OK = 0,
    FLOCKEYE_NOTHING = 1,
    FLOCKEYE_FAILED = -1,
};

/* Exit status of a stage that cannot start, where trying again does not help. */
#define FLOCKEYE_CANNOT_START 2

typedef struct FlockeyeStage flockeye_stage;
typedef struct FlockeyeSubscriber flockeye_subscriber;
typedef struct FlockeyePublisher flockeye_publisher;

/* A message in shared memory. It is kept until flockeye_release: the contract says how many a reader may keep. */
typedef struct {
    const void *header; /* of the topic's header type */
    const void *items;  /* `count` of the topic's item type; bytes of pixels for views and frames */
    size_t count;
    void *owner;
} flockeye_message;

/* Memory for a message, in shared memory, to be filled in place. */
typedef struct {
    void *items;
    size_t count;
    void *owner;
} flockeye_loan;

/* Why the last call of this thread failed. Valid until its next call. */
const char *flockeye_error(void);

/* Joins the pipeline that the launcher's environment names, as the stage with this name in pipeline.yaml. Health
 * says `starting`. From now on SIGTERM and SIGINT end flockeye_stage_run. */
flockeye_stage *flockeye_stage_open(const char *name);
/* Leaves it, after all ports are closed and all messages released. */
void flockeye_stage_close(flockeye_stage *stage);

/* Which of the stage's workers this is, from 0, and how often its process was replaced. */
uint32_t flockeye_stage_replica(const flockeye_stage *stage);
uint32_t flockeye_stage_generation(const flockeye_stage *stage);
/* The configuration as JSON: the keys of pipeline.yaml, and `resolved` with what follows from them. */
const char *flockeye_stage_pipeline(const flockeye_stage *stage);
/* Single values of it, by JSON Pointers (RFC 6901). A number, "/rectification/window" with `count` 1, or a whole list
 * of `count` numbers, "/resolved/partitions/0/camera_from_view"; a text with its zero, "/camera/projection", in at
 * most `room` bytes; how many entries a list has, "/resolved/partitions". */
int flockeye_stage_numbers(const flockeye_stage *stage, const char *pointer, double *numbers, size_t count);
int flockeye_stage_text(const flockeye_stage *stage, const char *pointer, char *text, size_t room);
int flockeye_stage_count(const flockeye_stage *stage, const char *pointer, size_t *count);
/* The dictionary of all markers, by OpenCV's name or as a file; whether a configured body has a marker. */
const char *flockeye_stage_dictionary(const flockeye_stage *stage);
bool flockeye_stage_owns_marker(const flockeye_stage *stage, uint32_t id);
/* The `target` number of the body that has a marker, or FLOCKEYE_NONE; the name of a target's body, or NULL. */
uint32_t flockeye_stage_target_of_marker(const flockeye_stage *stage, uint32_t id);
const char *flockeye_stage_target_name(const flockeye_stage *stage, uint32_t target);

/* Ports of a topic, by its name: FLOCKEYE_TOPIC_VIEW. `lane`: of a topic with lanes, the worker's number; else 0.
 * They are opened before flockeye_stage_run. */
flockeye_subscriber *flockeye_subscribe(flockeye_stage *stage, const char *topic, uint32_t lane);
flockeye_publisher *flockeye_advertise(flockeye_stage *stage, const char *topic, uint32_t lane);
void flockeye_subscriber_close(flockeye_subscriber *subscriber);
void flockeye_publisher_close(flockeye_publisher *publisher);

/* Says that everything is open, in words for people, and calls `step` whenever something was published on a topic,
 * until SIGTERM. A step receives from each subscriber until FLOCKEYE_NOTHING, or asks for the next one at once with
 * flockeye_stage_wake_within(stage, 0). Health is sent between two steps, so a step must not take long. It returns
 * FLOCKEYE_OK; anything else ends the loop with FLOCKEYE_FAILED. */
int flockeye_stage_run(flockeye_stage *stage, const char *detail, int (*step)(void *context), void *context);
/* In a step: asks for the next one after so many nanoseconds at the latest. */
void flockeye_stage_wake_within(const flockeye_stage *stage, int64_t ns);
/* Counts something that cannot be worked with in the stage's health, and logs it, not more than now and then. */
void flockeye_stage_refuse(const flockeye_stage *stage, const char *what);
/* What a rectification owes: reports that a detection worker has not answered in time, for the `count`-th time in a
 * row, in words for people. The launcher replaces a worker if that goes on. */
void flockeye_stage_complain(const flockeye_stage *stage, uint32_t worker, uint64_t count, const char *detail);

/* The next message that waits, FLOCKEYE_OK, or FLOCKEYE_NOTHING. One that `message` held before must have been
 * released. Messages that break the contract, or that are of a
 * process that does not count while a stage is swapped, are left out. */
int flockeye_receive(flockeye_subscriber *subscriber, flockeye_message *message);
/* Gives its memory back; header and items must not be used any more. Twice does no harm. */
void flockeye_release(flockeye_message *message);

/* Memory for `count` items. A publisher lends as much at once as the contract's limits say. */
int flockeye_loan_items(const flockeye_publisher *publisher, size_t count, flockeye_loan *loan);
/* Sends it under a header of the topic's type, or gives it back unsent. */
int flockeye_send_loan(const flockeye_publisher *publisher, flockeye_loan *loan, const void *header);
void flockeye_drop_loan(flockeye_loan *loan);
/* Sends a copy of a header and `count` items. */
int flockeye_send(const flockeye_publisher *publisher, const void *header, const void *items, size_t count);
/* Gives whoever has joined since the last message what the topic keeps for late ones: the last plan. A fusion calls it
 * in each step, because a lossless run begins with its first plan. */
int flockeye_update_connections(const flockeye_publisher *publisher);

/* The header that a detection owes for a view: what it copies, who answers, and when. `hits` and `failed` are the
 * caller's. */
void flockeye_answer(const flockeye_stage *stage, const flockeye_view_header *view, int64_t received_ns,
                     flockeye_detection_header *answer);

/* CLOCK_MONOTONIC, nanoseconds: the clock of all messages. */
int64_t flockeye_now_ns(void);

#ifdef __cplusplus
}
#endif

#endif
