/* What the firmware needs of a machine: a CAN controller and a clock, as five functions. Porting is writing these. */
#ifndef PORT_H
#define PORT_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"

enum port_result { PORT_GONE = -1, PORT_NOTHING = 0, PORT_FRAME = 1 };

struct port {
    /* Connect to a channel: an interface, a group, a pin. False with a message on standard error if that fails. */
    bool (*open)(const char *channel);
    /* Wait for a frame until `until_ns` by this port's clock. Frames that are not classical data frames, and the node's
     * own, are left out. */
    enum port_result (*receive)(struct frame *frame, int64_t until_ns);
    /* Put a frame on the bus without waiting; a full transmit queue drops it. False if the bus is gone. */
    bool (*send)(uint32_t cob_id, const uint8_t *data, uint8_t length);
    /* Time since any fixed moment, ns; never goes back. */
    int64_t (*now)(void);
    void (*close)(void);
};

extern const struct port PORT_SOCKETCAN; /* channel: an interface such as can0 or vcan0 */
extern const struct port PORT_UDP;       /* channel: an IPv4 multicast group; the project's bus on one machine */

#endif
