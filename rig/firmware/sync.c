#include "sync.h"

#include <stddef.h>

/* 0x1006 gives the period of SYNC but not when SYNC counts as lost. The bench measures the lateness of a single SYNC
 * itself; a dozen missing in a row mean that the producer is gone. The rig writes 8 ms. */
static const int64_t LOST_AFTER = 12; /* periods */

void sync_configure(struct sync_consumer *sync, uint64_t period_us)
{
    sync->limit_ns = (int64_t)period_us * 1000 * LOST_AFTER;
    sync->deadline_ns = 0;
}

void sync_stop(struct sync_consumer *sync)
{
    sync->deadline_ns = 0;
}

bool sync_receive(struct sync_consumer *sync, const struct frame *frame)
{
    if (frame->length > 0) { /* a SYNC counter, which the device does not ask for (no 0x1019) */
        sync->is_malformed = true;
        emcy_raise(sync->emcy, EMCY_SYNC_LENGTH, ERROR_COMMUNICATION, NULL, 0);
        return false;
    }
    if (sync->limit_ns > 0)
        sync->deadline_ns = frame->t_ns + sync->limit_ns;
    if (sync->is_lost || sync->is_malformed) {
        sync->is_lost = sync->is_malformed = false;
        emcy_clear(sync->emcy, EMCY_COMMUNICATION, EMCY_ANY_DETAIL);
        emcy_clear(sync->emcy, EMCY_SYNC_LENGTH, EMCY_ANY_DETAIL);
    }
    return true;
}

bool sync_tick(struct sync_consumer *sync, int64_t t_ns)
{
    if (sync->deadline_ns == 0 || t_ns <= sync->deadline_ns)
        return false;
    sync->deadline_ns = 0;
    sync->is_lost = true;
    emcy_raise(sync->emcy, EMCY_COMMUNICATION, ERROR_COMMUNICATION, NULL, 0);
    return true;
}
