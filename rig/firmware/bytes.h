/* Little-endian numbers in frames (CiA 301, 7.1.4), whatever the byte order of the processor. */
#ifndef BYTES_H
#define BYTES_H

#include <stdint.h>

static inline uint64_t read_bytes(const uint8_t *data, uint8_t size)
{
    uint64_t value = 0;
    for (uint8_t i = 0; i < size; i++)
        value |= (uint64_t)data[i] << (8 * i);
    return value;
}

static inline void write_bytes(uint8_t *data, uint64_t value, uint8_t size)
{
    for (uint8_t i = 0; i < size; i++)
        data[i] = (uint8_t)(value >> (8 * i));
}

#endif
