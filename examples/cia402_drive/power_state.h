/* Power state machine of a drive (CiA 402, "finite state automaton"): control word 0x6040 in, status word 0x6041 out.
 *
 *     NOT READY -1-> SWITCH ON DISABLED -2-> READY -3-> SWITCHED ON -4-> OPERATION ENABLED -11-> QUICK STOP ACTIVE
 *                                     <-7-       <-6-             <-5-                    <-16-
 *     8: OPERATION ENABLED to READY. 9, 10, 12: to SWITCH ON DISABLED from the three on the right.
 *     any -13-> FAULT REACTION ACTIVE -14-> FAULT -15-> SWITCH ON DISABLED
 */
#ifndef POWER_STATE_H
#define POWER_STATE_H

#include <stdbool.h>
#include <stdint.h>

enum power_state {
    NOT_READY,
    SWITCH_ON_DISABLED,
    READY_TO_SWITCH_ON,
    SWITCHED_ON,
    OPERATION_ENABLED,
    QUICK_STOP_ACTIVE,
    FAULT_REACTION_ACTIVE,
    FAULT
};

struct power {
    enum power_state state;
    bool is_reset_seen;       /* bit 7 of the control word was up already: no rising edge */
    bool stays_in_quick_stop; /* option code 6; with 2 the state is left by itself (12) */
};

/* Transitions that need no command: 1, 12 and 14. */
void power_advance(struct power *power);

/* Follow a control word: 2 to 12, 15 and 16. `is_operable`: 4 and 16 are permitted; `is_healthy`: 15 is. */
void power_command(struct power *power, uint16_t control, bool is_operable, bool is_healthy);

/* A fault occurred: 13. It stays in FAULT if it is there. */
void power_fault(struct power *power);

/* Bits 0 to 3, 5 and 6 of the status word. */
uint16_t power_status(enum power_state state);

#endif
