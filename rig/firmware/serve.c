#define _GNU_SOURCE
#include "serve.h"

#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>

#include "port.h"

static const int64_t TICK_NS = 1000000;
static const unsigned BURST = 1000; /* frames between two ticks: a babbling node must not stop the timers */

static const struct port *port;
static bool is_bus_gone;
static volatile sig_atomic_t is_ended;

static void end(int number)
{
    (void)number;
    is_ended = 1;
}

static void send_frame(void *context, uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    (void)context;
    if (!port->send(cob_id, data, length))
        is_bus_gone = true;
}

const struct output BUS_OUTPUT = {send_frame, NULL};

static const char *choose_port(const char *bus)
{
    static const struct {
        const char *kind;
        const struct port *port;
        const char *channel; /* if the bus names none */
    } ports[] = {{"socketcan", &PORT_SOCKETCAN, NULL}, {"udp_multicast", &PORT_UDP, "239.74.163.2"}};
    for (size_t i = 0; i < sizeof ports / sizeof ports[0]; i++) {
        const size_t length = strlen(ports[i].kind);
        if (strncmp(bus, ports[i].kind, length) != 0)
            continue;
        port = ports[i].port;
        if (bus[length] == ':' && bus[length + 1] != '\0')
            return bus + length + 1;
        if (bus[length] == '\0' && ports[i].channel != NULL)
            return ports[i].channel;
    }
    fprintf(stderr, "bus: expected socketcan:INTERFACE or udp_multicast[:GROUP], not %s\n", bus);
    return NULL;
}

/* Real-time rights as far as the machine grants them: memory that stays, and the priority of the bench's own nodes. */
static void raise_priority(void)
{
    const struct sched_param priority = {20};
    mlockall(MCL_CURRENT | MCL_FUTURE);
    sched_setscheduler(0, SCHED_FIFO, &priority);
}

/* Frames that wait are handled before the timers run: after a stall of this process they are not late, we are. */
static void run(struct node node)
{
    int64_t tick_ns = port->now();
    while (!is_ended && !is_bus_gone) {
        struct frame frame;
        enum port_result result = PORT_FRAME;
        for (unsigned count = 0; result == PORT_FRAME && count < BURST; count++) {
            result = port->receive(&frame, tick_ns);
            if (result == PORT_FRAME)
                node.receive(node.context, &frame);
        }
        is_bus_gone |= result == PORT_GONE;
        const int64_t now_ns = port->now();
        if (now_ns >= tick_ns) {
            node.tick(node.context, now_ns);
            tick_ns = tick_ns + TICK_NS > now_ns ? tick_ns + TICK_NS : now_ns;
        }
    }
}

int serve_node(struct node node, const char *bus)
{
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = end;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    const char *channel = choose_port(bus);
    if (channel == NULL || !port->open(channel))
        return 2;
    printf("on %s\n", bus); /* who has started this program waits for the line */
    fflush(stdout);
    raise_priority();
    run(node);
    port->close();
    if (is_bus_gone)
        fprintf(stderr, "%s: the bus is gone\n", bus);
    return is_bus_gone ? 1 : 0;
}
