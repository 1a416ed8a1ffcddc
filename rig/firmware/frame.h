/* One classical CAN data frame, and where the frames of a node go. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

#define ID_EXTENDED (UINT32_C(1) << 31) /* in an identifier: it has 29 bits, not 11 */

struct frame {
    int64_t t_ns; /* time of reception by the port's clock */
    uint32_t cob_id; /* identifier; CANopen has 11-bit ones only */
    uint8_t length; /* bytes of data, 0..8 */
    uint8_t data[8];
};

/* The way out of a node: `send` puts one frame on the bus; `context` is the port's own. */
struct output {
    void (*send)(void *context, uint32_t cob_id, const uint8_t *data, uint8_t length);
    void *context;
};

#endif
