/* A CiA 402 drive as a program for Linux:
 *
 *     cia402_drive BUS [--node N] [--fault NAME]      BUS: socketcan:can0 or udp_multicast[:GROUP]
 */
#include <stdio.h>
#include <stdlib.h>

#include "drive.h"
#include "faults.h"
#include "options.h"
#include "serve.h"

static void receive(void *context, const struct frame *frame)
{
    faults_receive(context, frame);
}

static void tick(void *context, int64_t t_ns)
{
    drive_tick(context, t_ns);
}

int main(int count, char **words)
{
    static struct drive drive;
    const char *bus, *node = "5", *fault = "none";
    const struct option options[] = {{"--node", &node}, {"--fault", &fault}, {NULL, NULL}};
    const bool is_read = read_options(count, words, &bus, options);
    const long node_id = strtol(node, NULL, 10);
    if (!is_read || node_id < 1 || node_id > 127 || !faults_select(fault)) {
        fprintf(stderr, "usage: cia402_drive BUS [--node 1..127] [--fault NAME]; see README.md\n");
        return 2;
    }
    if (!drive_init(&drive, (uint8_t)node_id, (struct output){faults_send, &drive})) {
        fprintf(stderr, "cia402_drive: the object table is inconsistent\n");
        return 2;
    }
    return serve_node((struct node){&drive, receive, tick}, bus);
}
