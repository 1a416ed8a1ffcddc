/* Heartbeat producer (0x1017) and consumer (0x1016), CiA 301, 7.2.8.3.2. */
#ifndef HEARTBEAT_H
#define HEARTBEAT_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"
#include "nmt.h"

enum { HEARTBEAT_COB_ID = 0x700 }; /* + node */

struct heartbeat_producer {
    struct output output;
    uint8_t node_id;
    int64_t period_ns; /* 0: off */
    int64_t due_ns;
};

/* A new producer time (0x1017, ms) takes effect at once; the first heartbeat is one period away. 0 stops it. */
void heartbeat_configure(struct heartbeat_producer *producer, uint64_t period_ms, int64_t t_ns);

/* Announce a boot-up. */
void heartbeat_send_boot_up(struct heartbeat_producer *producer);

/* Send the state if it is due. Due time += period, so a late call does not shift the heartbeats after it. */
void heartbeat_tick(struct heartbeat_producer *producer, int64_t t_ns, enum nmt_state state);

enum { WATCHED_NODES_MAX = 8 }; /* sub-indices of 0x1016 */

struct watched_node {
    uint8_t node; /* 0: unused */
    int64_t limit_ns;
    bool is_heard; /* watching begins with the first heartbeat, as the standard has it */
    int64_t deadline_ns;
};

struct heartbeat_consumer {
    struct watched_node nodes[WATCHED_NODES_MAX];
};

/* Watch the nodes of these entries of 0x1016: bits 16..23 node, bits 0..15 ms; a zero in either disables.
 * A node whose entry does not change stays watched as it was. */
void heartbeat_watch(struct heartbeat_consumer *consumer, const uint64_t *entries, uint8_t count);

/* Abort code of a new value of an entry of 0x1016 (CiA 301, 7.5.2.19), beside the values of the other entries.
 * The standard leaves an entry with a node above 127 unused. It is refused here, because nobody would notice that the
 * supervision asked for does not happen. Time 0 or node 0 switch an entry off. */
uint32_t heartbeat_check_entry(uint64_t entry, const uint64_t *others, uint8_t count);

/* Whether a frame is a heartbeat of a watched node. */
bool heartbeat_is_watched(const struct heartbeat_consumer *consumer, uint32_t cob_id);

/* A heartbeat or boot-up of a watched node came. True if the node was not heard before, or was lost. */
bool heartbeat_receive(struct heartbeat_consumer *consumer, const struct frame *frame);

/* A node that has been silent for too long, 0 if there is none. Call again until it is 0. */
uint8_t heartbeat_find_lost(struct heartbeat_consumer *consumer, int64_t t_ns);

#endif
