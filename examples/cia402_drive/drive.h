/* A drive after CiA 402 with a position loop, on the CANopen stack of rig/firmware.
 *
 * At SYNC it takes over control word and target (RPDO1) and the measured position (RPDO2), computes the current, and
 * answers with status word and current (TPDO1), mode and position (TPDO2). Current flows in OPERATION ENABLED, in mode 8
 * (cyclic synchronous position) alone. A fault is latched until it has gone and bit 7 of the control word rises.
 */
#ifndef DRIVE_H
#define DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "control_law.h"
#include "device.h"
#include "frame.h"
#include "object_table.h"
#include "power_state.h"

enum { TARGET_RPDO = 1, POSITION_RPDO = 2, RPDO_COUNT = 2 };

/* Supervision of a synchronous RPDO: it begins with the first one after NMT start. */
struct watch {
    bool is_heard;   /* since NMT start */
    bool is_new;     /* an asynchronous one came since the last SYNC */
    bool is_lost;    /* and announced by EMCY */
    unsigned silent; /* SYNCs since the last one */
};

struct drive {
    struct device device;
    uint64_t values[OBJECT_COUNT];
    uint8_t buffer[8];
    struct power power;
    struct watch watches[RPDO_COUNT];
    struct control_law law;
    bool is_halted;    /* bit 8 of the control word: the drive holds `held` */
    bool is_limited;   /* the current is at its limit */
    double held;       /* m */
};

/* Put the node together. False if the object table is inconsistent. */
bool drive_init(struct drive *drive, uint8_t node_id, struct output output);

/* A frame of another node arrived. */
void drive_receive(struct drive *drive, const struct frame *frame);

/* It is now `t_ns`; call about every millisecond. The first call boots the node. */
void drive_tick(struct drive *drive, int64_t t_ns);

#endif
