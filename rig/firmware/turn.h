/* The turn to send on a UDP group, see rig/network/udp.py: all programs of the machine send one after the other. */
#ifndef TURN_H
#define TURN_H

#include <stdbool.h>
#include <stdint.h>

/* Join the programs that use a group and port. False for no IPv4 address, and where there is no /dev/null. */
bool turn_join(const char *group, uint16_t port);

/* Wait up to a second for the turn. False if another program held it for longer. */
bool turn_take(void);

/* Let the next one send. */
void turn_give(void);

/* Leave, and give the turn. */
void turn_leave(void);

#endif
