/* A position controller on plain CAN: ecu.dbc describes its frames.
 *
 * It answers each Feedback with a Drive. Current flows in state OPERATIONAL, while Demand.Enable is 1. Three wrong frames
 * in a row, or no frame for a time, are a fault; it is latched until Enable is 0 and the frames are right again.
 */
#ifndef ECU_H
#define ECU_H

#include <stdbool.h>
#include <stdint.h>

#include "control_law.h"
#include "frame.h"
#include "protection.h"

#define DEMAND_ID (ID_EXTENDED | 0x18FF0110)
#define FEEDBACK_ID (ID_EXTENDED | 0x18FF0210)
#define DRIVE_ID (ID_EXTENDED | 0x18FF0320)
enum { DEMAND_LENGTH = 5, FEEDBACK_LENGTH = 8, DRIVE_LENGTH = 4 };

/* Drive.State */
enum ecu_state { ECU_INIT = 1, ECU_SYNCHRONISING, ECU_OPERATIONAL, ECU_FAULT };

struct ecu {
    struct output output;
    int64_t timeout_ns; /* without a valid frame for so long the rig is gone */
    enum ecu_state state;
    struct reception demand, feedback;
    bool is_enabled;
    double target, position; /* m */
    struct control_law law;
    uint8_t counter;     /* of the next Drive */
    int64_t idle_due_ns; /* next Drive without a Feedback */
};

/* Put the ECU together. */
void ecu_init(struct ecu *ecu, struct output output, int64_t timeout_ns);

/* A frame of another node arrived. */
void ecu_receive(struct ecu *ecu, const struct frame *frame);

/* It is now `t_ns`; call about every millisecond. */
void ecu_tick(struct ecu *ecu, int64_t t_ns);

#endif
