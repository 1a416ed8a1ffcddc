/* SDO server (CiA 301, 7.2.4.3): expedited and segmented upload and download, with the abort codes.
 *
 * Block transfer is optional for a server; it is refused with "command specifier not valid", and the client falls back.
 */
#ifndef SDO_H
#define SDO_H

#include <stdbool.h>
#include <stdint.h>

#include "frame.h"

/* How the server reaches the objects. All functions return an abort code, 0 for success. */
struct sdo_objects {
    void *context;
    /* The bytes of an object; they stay valid until the next upload. */
    uint32_t (*upload)(void *context, uint16_t index, uint8_t sub, const uint8_t **data, uint32_t *length);
    /* Bytes that a download must bring, 0 for any number. */
    uint32_t (*find_size)(void *context, uint16_t index, uint8_t sub, uint32_t *size);
    uint32_t (*download)(void *context, uint16_t index, uint8_t sub, const uint8_t *data, uint32_t length);
};

struct sdo_server {
    struct output output;
    uint16_t cob_id; /* of the answers */
    struct sdo_objects objects;
    uint8_t *buffer; /* for downloads in segments; the largest number needs 8 bytes */
    uint32_t capacity;

    uint16_t index; /* of the present or last transfer */
    uint8_t sub;
    uint8_t open; /* command specifier of the segments expected */
    uint8_t toggle;
    int64_t last_ns;        /* time of the last request */
    const uint8_t *left;    /* upload: bytes to send */
    uint32_t length;        /* upload: how many; download: how many have come */
    uint32_t limit;         /* download: bytes that may come */
    uint32_t excess_abort;  /* download: abort code of the byte after those */
    bool is_announced;      /* download: `limit` is the length that the client announced */
};

/* Forget an open transfer. */
void sdo_reset(struct sdo_server *sdo);

/* Handle a request. A frame that is not 8 bytes long is not an SDO and is ignored. */
void sdo_receive(struct sdo_server *sdo, const struct frame *frame);

/* Abort a transfer whose client stopped sending. */
void sdo_tick(struct sdo_server *sdo, int64_t t_ns);

#endif
