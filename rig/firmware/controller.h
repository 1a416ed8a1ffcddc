/* Node 2, the controller: a position loop in a CANopen device (docs/bus.md says what it must do).
 *
 * It answers each feedback frame with a drive frame. The control word (CiA 408) lets current flow only in device mode
 * ACTIVE without a fault; a fault is latched until it has gone and the control word's reset bit rises. The safe state
 * is zero current.
 */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdbool.h>
#include <stdint.h>

#include "control_law.h"
#include "device.h"
#include "frame.h"
#include "object_table.h"

enum { CONTROLLER_NODE = 2, DRIVE_TPDO = 1 };

struct controller {
    struct device device;
    uint64_t values[OBJECT_COUNT];
    uint8_t buffer[8]; /* the largest object that can be written, a REAL64, comes in segments */
    struct control_law law;
    struct gains gains;     /* taken over at NMT start */
    unsigned silent_cycles, uncommanded_cycles; /* SYNCs since the last feedback, and since the last command */
    bool is_feedback_lost, is_command_lost; /* and announced by EMCY; a restart of the loop does not take that back */
    bool has_fault;
    bool is_reset_seen; /* the reset bit was up already: no rising edge */
};

/* Put the node together with the gains of the object table. False if the object table is inconsistent. */
bool controller_init(struct controller *controller, struct output output);

/* A frame of another node arrived. */
void controller_receive(struct controller *controller, const struct frame *frame);

/* It is now `t_ns`; call about every millisecond. The first call boots the node. */
void controller_tick(struct controller *controller, int64_t t_ns);

#endif
