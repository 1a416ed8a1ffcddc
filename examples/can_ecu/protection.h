/* Protection of a frame, after AUTOSAR E2E: byte 0 is a checksum of the others, the high half of byte 1 an alive counter.
 */
#ifndef PROTECTION_H
#define PROTECTION_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"

/* What the receiver of a protected frame remembers. All zero: none was heard. */
struct reception {
    bool is_heard;
    uint8_t counter;  /* of the last frame whose checksum is right */
    unsigned valid;   /* frames in a row, up to 255 */
    unsigned invalid; /* frames in a row, up to 255 */
    int64_t t_ns;     /* of the last valid frame */
};

/* CRC-8 SAE J1850: polynomial 0x1D, initial value and final XOR 0xFF. */
uint8_t compute_crc8(const uint8_t *data, uint8_t length);

/* Set counter and checksum of a frame. */
void protect(uint8_t *data, uint8_t length, uint8_t counter);

/* Check a frame of the right length: checksum, and a counter that is 1 to 3 ahead (two frames may be lost). */
bool check_protection(struct reception *reception, const struct frame *frame);

#endif
