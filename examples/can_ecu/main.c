/* An ECU on plain CAN as a program for Linux:
 *
 *     can_ecu BUS [--timeout MS] [--fault NAME]      BUS: socketcan:can0 or udp_multicast[:GROUP]
 */
#include <stdio.h>
#include <stdlib.h>

#include "ecu.h"
#include "faults.h"
#include "options.h"
#include "serve.h"

static void receive(void *context, const struct frame *frame)
{
    faults_receive(context, frame);
}

static void tick(void *context, int64_t t_ns)
{
    ecu_tick(context, t_ns);
}

int main(int count, char **words)
{
    static struct ecu ecu;
    const char *bus, *timeout = "100", *fault = "none";
    const struct option options[] = {{"--timeout", &timeout}, {"--fault", &fault}, {NULL, NULL}};
    const bool is_read = read_options(count, words, &bus, options);
    const long timeout_ms = strtol(timeout, NULL, 10);
    if (!is_read || timeout_ms < 1 || !faults_select(fault)) {
        fprintf(stderr, "usage: can_ecu BUS [--timeout MS] [--fault NAME]; see README.md\n");
        return 2;
    }
    ecu_init(&ecu, (struct output){faults_send, &ecu}, (int64_t)timeout_ms * 1000000);
    return serve_node((struct node){&ecu, receive, tick}, bus);
}
