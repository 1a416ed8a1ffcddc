/* The reference firmware of node 2 as a program for Linux:
 *
 *     controller BUS      BUS: socketcan:can0 or udp_multicast[:GROUP]
 */
#include <stdio.h>

#include "controller.h"
#include "serve.h"

static void receive(void *context, const struct frame *frame)
{
    controller_receive(context, frame);
}

static void tick(void *context, int64_t t_ns)
{
    controller_tick(context, t_ns);
}

int main(int count, char **words)
{
    static struct controller controller;
    if (count != 2) {
        fprintf(stderr, "usage: controller BUS; BUS is socketcan:INTERFACE or udp_multicast[:GROUP]\n");
        return 2;
    }
    if (!controller_init(&controller, BUS_OUTPUT)) {
        fprintf(stderr, "controller: the object table is inconsistent\n");
        return 2;
    }
    return serve_node((struct node){&controller, receive, tick}, words[1]);
}
