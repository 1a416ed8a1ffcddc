/* Serves one node on a port until a signal ends it: the loop of the program. */
#ifndef SERVE_H
#define SERVE_H

#include <stdint.h>

#include "frame.h"

/* A node as the loop sees it. */
struct node {
    void *context;
    void (*receive)(void *context, const struct frame *frame);
    void (*tick)(void *context, int64_t t_ns);
};

extern const struct output BUS_OUTPUT; /* where a node sends: the bus that is served */

/* Serve a node on `bus` (socketcan:INTERFACE or udp_multicast[:GROUP]) until SIGINT or SIGTERM. Returns the exit status: 0, 1 if the bus is gone, 2 if it cannot be opened. */
int serve_node(struct node node, const char *bus);

#endif
