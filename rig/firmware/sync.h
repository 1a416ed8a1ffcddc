/* SYNC consumer (CiA 301, 7.2.5): whether a SYNC is valid, and whether they still come (0x1006). */
#ifndef SYNC_H
#define SYNC_H

#include <stdbool.h>
#include <stdint.h>

#include "emcy.h"
#include "frame.h"

struct sync_consumer {
    struct emcy *emcy;
    int64_t limit_ns;    /* 0: do not watch */
    int64_t deadline_ns; /* 0: not waiting */
    bool is_lost, is_malformed;
};

/* A new communication cycle period (0x1006, us); 0: do not watch. Watching begins with the next SYNC. */
void sync_configure(struct sync_consumer *sync, uint64_t period_us);

/* The device leaves OPERATIONAL: no SYNC is missed. */
void sync_stop(struct sync_consumer *sync);

/* A SYNC came: EMCY 0x8240 if it carries data. True if the cycle is to run. */
bool sync_receive(struct sync_consumer *sync, const struct frame *frame);

/* EMCY 0x8100 when SYNC has stopped. True at that moment. */
bool sync_tick(struct sync_consumer *sync, int64_t t_ns);

#endif
