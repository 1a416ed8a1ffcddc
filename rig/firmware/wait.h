/* The clock of Linux and waiting for a socket; shared by the ports for Linux. */
#ifndef WAIT_H
#define WAIT_H

#include <stdbool.h>
#include <stdint.h>

/* The monotonic clock, ns. */
int64_t read_clock(void);

/* Wait until a socket can be read or the clock says `until_ns`. False on time-out or a signal. */
bool wait_readable(int socket, int64_t until_ns);

/* Ask for a receive buffer that holds seconds of a busy bus, beyond the system's limit where that is permitted. */
void enlarge_receive_buffer(int socket);

#endif
