/* NMT slave (CiA 301, 7.3.2): states, commands and the error behaviour object 0x1029. */
#ifndef NMT_H
#define NMT_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"

/* States as the heartbeat carries them. */
enum nmt_state {
    NMT_INITIALISING = 0,
    NMT_STOPPED = 4,
    NMT_OPERATIONAL = 5,
    NMT_PRE_OPERATIONAL = 127
};

/* Command specifiers of the frame 0x000. */
enum nmt_command {
    NMT_NO_COMMAND = 0,
    NMT_START = 1,
    NMT_STOP = 2,
    NMT_ENTER_PRE_OPERATIONAL = 128,
    NMT_RESET_NODE = 129,
    NMT_RESET_COMMUNICATION = 130
};

/* The command of a frame 0x000; NMT_NO_COMMAND if it is malformed, unknown or for another node. */
enum nmt_command nmt_read_command(const struct frame *frame, uint8_t node_id);

/* The state that a command other than a reset leads to. */
enum nmt_state nmt_target(enum nmt_command command);

/* The state after a communication error; `behaviour` is 0x1029 sub 1. Only an operational device reacts. */
enum nmt_state nmt_state_after_error(enum nmt_state state, uint64_t behaviour);

/* Whether SDO, SYNC and EMCY exist in a state (CiA 301, table 39). */
bool nmt_is_communicating(enum nmt_state state);

#endif
