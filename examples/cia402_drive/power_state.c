#include "power_state.h"

#include <stddef.h>

enum { RESET = 0x80 };

/* Commands: bits of the control word that matter, and what they must be. */
struct command {
    uint8_t mask, bits;
};
#define SHUTDOWN {0x87, 0x06}
#define SWITCH_ON {0x8F, 0x07} /* in OPERATION ENABLED: disable operation */
#define ENABLE {0x8F, 0x0F}
#define DISABLE_VOLTAGE {0x82, 0x00}
#define QUICK_STOP {0x86, 0x02}

static const struct {
    enum power_state from;
    struct command command;
    enum power_state to;
} TRANSITIONS[] = {
    {SWITCH_ON_DISABLED, SHUTDOWN, READY_TO_SWITCH_ON},       /* 2 */
    {READY_TO_SWITCH_ON, SWITCH_ON, SWITCHED_ON},             /* 3 */
    {READY_TO_SWITCH_ON, ENABLE, SWITCHED_ON},                /* 3, and 4 follows */
    {SWITCHED_ON, ENABLE, OPERATION_ENABLED},                 /* 4 */
    {OPERATION_ENABLED, SWITCH_ON, SWITCHED_ON},              /* 5 */
    {SWITCHED_ON, SHUTDOWN, READY_TO_SWITCH_ON},              /* 6 */
    {READY_TO_SWITCH_ON, DISABLE_VOLTAGE, SWITCH_ON_DISABLED}, /* 7 */
    {READY_TO_SWITCH_ON, QUICK_STOP, SWITCH_ON_DISABLED},     /* 7 */
    {OPERATION_ENABLED, SHUTDOWN, READY_TO_SWITCH_ON},        /* 8 */
    {OPERATION_ENABLED, DISABLE_VOLTAGE, SWITCH_ON_DISABLED}, /* 9 */
    {SWITCHED_ON, DISABLE_VOLTAGE, SWITCH_ON_DISABLED},       /* 10 */
    {SWITCHED_ON, QUICK_STOP, SWITCH_ON_DISABLED},            /* 10 */
    {OPERATION_ENABLED, QUICK_STOP, QUICK_STOP_ACTIVE},       /* 11 */
    {QUICK_STOP_ACTIVE, DISABLE_VOLTAGE, SWITCH_ON_DISABLED}, /* 12 */
    {QUICK_STOP_ACTIVE, ENABLE, OPERATION_ENABLED},           /* 16 */
};

void power_advance(struct power *power)
{
    if (power->state == FAULT_REACTION_ACTIVE)
        power->state = FAULT;
    else if (power->state == NOT_READY || (power->state == QUICK_STOP_ACTIVE && !power->stays_in_quick_stop))
        power->state = SWITCH_ON_DISABLED;
}

static bool take_transition(struct power *power, uint16_t control, bool is_operable)
{
    for (size_t i = 0; i < sizeof TRANSITIONS / sizeof TRANSITIONS[0]; i++) {
        const struct command command = TRANSITIONS[i].command;
        const enum power_state to = TRANSITIONS[i].to;
        if (TRANSITIONS[i].from != power->state || (control & command.mask) != command.bits)
            continue;
        if (to == OPERATION_ENABLED && !is_operable)
            continue;
        power->state = to;
        return true;
    }
    return false;
}

void power_command(struct power *power, uint16_t control, bool is_operable, bool is_healthy)
{
    const bool is_reset = control & RESET;
    if (power->state == FAULT && is_reset && !power->is_reset_seen && is_healthy)
        power->state = SWITCH_ON_DISABLED;
    power->is_reset_seen = is_reset;
    while (take_transition(power, control, is_operable)) {
    }
}

void power_fault(struct power *power)
{
    if (power->state != FAULT)
        power->state = FAULT_REACTION_ACTIVE;
}

uint16_t power_status(enum power_state state)
{
    static const uint8_t bits[] = {
        [NOT_READY] = 0x00,         [SWITCH_ON_DISABLED] = 0x40, [READY_TO_SWITCH_ON] = 0x21,
        [SWITCHED_ON] = 0x23,       [OPERATION_ENABLED] = 0x27,  [QUICK_STOP_ACTIVE] = 0x07,
        [FAULT_REACTION_ACTIVE] = 0x0F, [FAULT] = 0x08,
    };
    return bits[state];
}
