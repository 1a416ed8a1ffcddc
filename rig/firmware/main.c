/* The reference firmware of node 2 as a program for Linux:
 *
 *     controller BUS [--parent PID]      BUS: socketcan:can0 or udp_multicast[:GROUP]
 */
#include <stdio.h>
#include <stdlib.h>

#include "controller.h"
#include "options.h"
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
    const char *bus, *parent = "0";
    const struct option options[] = {{"--parent", &parent}, {NULL, NULL}};
    if (!read_options(count, words, &bus, options)) {
        fprintf(stderr, "usage: controller BUS [--parent PID]; BUS is socketcan:INTERFACE or udp_multicast[:GROUP]\n");
        return 2;
    }
    if (!controller_init(&controller, BUS_OUTPUT)) {
        fprintf(stderr, "controller: the object table is inconsistent\n");
        return 2;
    }
    return serve_node((struct node){&controller, receive, tick}, bus, atol(parent));
}
