/* The reference firmware with a fault, to see that the bench notices:
 *
 *     faulty FAULT BUS
 *
 * The faults change frames and memory around a sound controller, as a careless programmer would have from within.
 */
#include <stdio.h>
#include <string.h>

#include "bytes.h"
#include "controller.h"
#include "serve.h"

enum { DRIVE = 0x182, HEARTBEAT = 0x702 };

static struct controller controller;
static const char *fault;
static uint8_t previous[8]; /* drive frame */
static int64_t now_ns, start_ns;
static struct frame start;

static bool has(const char *name)
{
    return strcmp(fault, name) == 0;
}

/* Put the last drive frame in place of this one. */
static void swap_with_previous(uint8_t *drive)
{
    uint8_t sound[8];
    memcpy(sound, drive, 8);
    memcpy(drive, previous, 8);
    memcpy(previous, sound, 8);
}

static void send_spoiled(void *context, uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    uint8_t spoiled[8] = {0};
    memcpy(spoiled, data, length);
    if (cob_id == DRIVE && length == 8 && has("late_frame"))
        swap_with_previous(spoiled);
    if (cob_id == HEARTBEAT && has("no_heartbeat") && data[0] != NMT_INITIALISING)
        return;
    BUS_OUTPUT.send(context, cob_id, spoiled, length);
}

static void receive(void *context, const struct frame *frame)
{
    (void)context;
    if (has("slow_start") && nmt_read_command(frame, CONTROLLER_NODE) == NMT_START && frame->cob_id == 0) {
        start = *frame;
        start_ns = now_ns + INT64_C(1500000000);
        return;
    }
    const struct control_law before = controller.law;
    controller_receive(&controller, frame);
    if (has("leaks_state") && controller.law.integral == 0.0) /* a reset and an open loop must clear it */
        controller.law.integral = before.integral;
}

static void tick(void *context, int64_t t_ns)
{
    (void)context;
    now_ns = t_ns;
    if (start_ns != 0 && t_ns >= start_ns) {
        start.t_ns = t_ns;
        controller_receive(&controller, &start);
        start_ns = 0;
    }
    controller_tick(&controller, t_ns);
}

int main(int count, char **words)
{
    if (count != 3)
        return 2;
    fault = words[1];
    const struct output output = {send_spoiled, NULL};
    if (!controller_init(&controller, output))
        return 2;
    if (has("leaks_state")) { /* with an integral part there is something to leak */
        const double gain = 20.0;
        memcpy(&controller.values[OBJECT_2110_02], &gain, sizeof gain);
    }
    return serve_node((struct node){NULL, receive, tick}, words[2]);
}
