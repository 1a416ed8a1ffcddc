/* A CAN frame in a UDP datagram, as python-can's udp_multicast packs it: one msgpack map. */
#ifndef DATAGRAM_H
#define DATAGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "frame.h"

enum { DATAGRAM_MAX = 256 }; /* bytes that `datagram_pack` needs at most */

/* Write a frame; returns the number of bytes. */
size_t datagram_pack(const struct frame *frame, uint8_t *bytes);

/* Read a frame; its time is left as it is. False for what is not a classical data frame. */
bool datagram_unpack(const uint8_t *bytes, size_t length, struct frame *frame);

#endif
