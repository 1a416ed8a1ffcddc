#include "protection.h"

enum { COUNTER_MASK = 0x0F, DELTA_MAX = 3, COUNT_MAX = 255 };

uint8_t compute_crc8(const uint8_t *data, uint8_t length)
{
    uint8_t crc = 0xFF;
    for (uint8_t i = 0; i < length; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            crc = (uint8_t)(crc & 0x80 ? crc << 1 ^ 0x1D : crc << 1);
    }
    return crc ^ 0xFF;
}

void protect(uint8_t *data, uint8_t length, uint8_t counter)
{
    data[1] = (uint8_t)((data[1] & 0x0F) | counter << 4);
    data[0] = compute_crc8(data + 1, length - 1);
}

static bool is_valid(struct reception *reception, const struct frame *frame)
{
    if (frame->data[0] != compute_crc8(frame->data + 1, frame->length - 1))
        return false;
    const uint8_t counter = frame->data[1] >> 4, delta = (counter - reception->counter) & COUNTER_MASK;
    const bool is_first = !reception->is_heard;
    reception->is_heard = true;
    reception->counter = counter;
    return is_first || (delta >= 1 && delta <= DELTA_MAX);
}

bool check_protection(struct reception *reception, const struct frame *frame)
{
    const bool is_good = is_valid(reception, frame);
    unsigned *count = is_good ? &reception->valid : &reception->invalid;
    if (is_good) {
        reception->invalid = 0;
        reception->t_ns = frame->t_ns;
    } else {
        reception->valid = 0;
    }
    if (*count < COUNT_MAX)
        ++*count;
    return is_good;
}
