#include "nmt.h"

enum nmt_command nmt_read_command(const struct frame *frame, uint8_t node_id)
{
    if (frame->length != 2 || (frame->data[1] != 0 && frame->data[1] != node_id)) /* 0: all nodes */
        return NMT_NO_COMMAND;
    switch (frame->data[0]) {
    case NMT_START:
    case NMT_STOP:
    case NMT_ENTER_PRE_OPERATIONAL:
    case NMT_RESET_NODE:
    case NMT_RESET_COMMUNICATION:
        return (enum nmt_command)frame->data[0];
    default:
        return NMT_NO_COMMAND;
    }
}

enum nmt_state nmt_target(enum nmt_command command)
{
    if (command == NMT_START)
        return NMT_OPERATIONAL;
    return command == NMT_STOP ? NMT_STOPPED : NMT_PRE_OPERATIONAL;
}

enum nmt_state nmt_state_after_error(enum nmt_state state, uint64_t behaviour)
{
    if (state != NMT_OPERATIONAL)
        return state;
    if (behaviour == 0)
        return NMT_PRE_OPERATIONAL;
    return behaviour == 2 ? NMT_STOPPED : state;
}

bool nmt_is_communicating(enum nmt_state state)
{
    return state == NMT_PRE_OPERATIONAL || state == NMT_OPERATIONAL;
}
