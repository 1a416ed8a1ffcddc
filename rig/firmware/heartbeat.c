#include "heartbeat.h"

#include <string.h>

#include "dictionary.h"

static const int64_t MS = 1000000; /* ns */

void heartbeat_configure(struct heartbeat_producer *producer, uint64_t period_ms, int64_t t_ns)
{
    producer->period_ns = (int64_t)period_ms * MS;
    producer->due_ns = t_ns + producer->period_ns;
}

static void send_state(struct heartbeat_producer *producer, enum nmt_state state)
{
    uint8_t data = (uint8_t)state;
    producer->output.send(producer->output.context, HEARTBEAT_COB_ID + producer->node_id, &data, 1);
}

void heartbeat_send_boot_up(struct heartbeat_producer *producer)
{
    send_state(producer, NMT_INITIALISING);
}

void heartbeat_tick(struct heartbeat_producer *producer, int64_t t_ns, enum nmt_state state)
{
    if (producer->period_ns == 0 || t_ns < producer->due_ns)
        return;
    send_state(producer, state);
    producer->due_ns += producer->period_ns;
    if (producer->due_ns <= t_ns) /* more than a period behind: skip, never send a burst */
        producer->due_ns = t_ns + producer->period_ns;
}

static struct watched_node *find_node(struct heartbeat_consumer *consumer, uint8_t node)
{
    for (uint8_t i = 0; i < WATCHED_NODES_MAX; i++)
        if (node != 0 && consumer->nodes[i].node == node)
            return &consumer->nodes[i];
    return NULL;
}

void heartbeat_watch(struct heartbeat_consumer *consumer, const uint64_t *entries, uint8_t count)
{
    struct heartbeat_consumer old = *consumer;
    memset(consumer, 0, sizeof *consumer);
    for (uint8_t i = 0; i < count && i < WATCHED_NODES_MAX; i++) {
        uint8_t node = entries[i] >> 16 & 0xFF;
        int64_t limit_ns = (int64_t)(entries[i] & 0xFFFF) * MS;
        if (node == 0 || limit_ns == 0)
            continue;
        struct watched_node *before = find_node(&old, node);
        bool is_unchanged = before != NULL && before->limit_ns == limit_ns;
        consumer->nodes[i] = is_unchanged ? *before : (struct watched_node){node, limit_ns, false, 0};
    }
}

uint32_t heartbeat_check_entry(uint64_t entry, const uint64_t *others, uint8_t count)
{
    if (entry >> 24) /* reserved bits */
        return ABORT_VALUE;
    const uint64_t node = entry >> 16, time = entry & 0xFFFF;
    if (node > 127 && time > 0)
        return ABORT_VALUE;
    for (uint8_t i = 0; i < count; i++)
        if (node > 0 && time > 0 && (others[i] >> 16 & 0xFF) == node && others[i] & 0xFFFF)
            return ABORT_INCOMPATIBLE;
    return ABORT_NONE;
}

bool heartbeat_is_watched(const struct heartbeat_consumer *consumer, uint32_t cob_id)
{
    for (uint8_t i = 0; i < WATCHED_NODES_MAX; i++)
        if (consumer->nodes[i].node != 0 && cob_id - HEARTBEAT_COB_ID == consumer->nodes[i].node)
            return true;
    return false;
}

bool heartbeat_receive(struct heartbeat_consumer *consumer, const struct frame *frame)
{
    struct watched_node *watched = find_node(consumer, (uint8_t)(frame->cob_id - HEARTBEAT_COB_ID));
    if (watched == NULL)
        return false;
    bool is_new = !watched->is_heard;
    watched->is_heard = true;
    watched->deadline_ns = frame->t_ns + watched->limit_ns;
    return is_new;
}

uint8_t heartbeat_find_lost(struct heartbeat_consumer *consumer, int64_t t_ns)
{
    for (uint8_t i = 0; i < WATCHED_NODES_MAX; i++) {
        struct watched_node *watched = &consumer->nodes[i];
        if (watched->node != 0 && watched->is_heard && t_ns > watched->deadline_ns) {
            watched->is_heard = false;
            return watched->node;
        }
    }
    return 0;
}
