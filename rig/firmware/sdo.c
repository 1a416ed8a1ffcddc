#include "sdo.h"

#include <string.h>

#include "bytes.h"
#include "dictionary.h"

/* client command specifiers */
enum { DOWNLOAD_SEGMENT, DOWNLOAD, UPLOAD, UPLOAD_SEGMENT, ABORT, NOTHING_OPEN = 0xFF };

/* between two requests of one transfer: a client on a busy machine may stand still */
static const int64_t TIMEOUT_NS = 5000000000;

void sdo_reset(struct sdo_server *sdo)
{
    sdo->open = NOTHING_OPEN;
    sdo->toggle = 0;
    sdo->length = 0;
    sdo->is_announced = false;
}

static void answer(struct sdo_server *sdo, const uint8_t *data)
{
    sdo->output.send(sdo->output.context, sdo->cob_id, data, 8);
}

static void write_head(const struct sdo_server *sdo, uint8_t *data, uint8_t command)
{
    data[0] = command;
    write_bytes(data + 1, sdo->index, 2);
    data[3] = sdo->sub;
}

static void abort_transfer(struct sdo_server *sdo, uint32_t code)
{
    uint8_t data[8] = {0};
    sdo_reset(sdo);
    write_head(sdo, data, 0x80);
    write_bytes(data + 4, code, 4);
    answer(sdo, data);
}

static uint32_t begin_download(struct sdo_server *sdo, const uint8_t *request, uint8_t *reply)
{
    const bool is_expedited = request[0] & 2, is_announced = request[0] & 1;
    uint32_t size;
    uint32_t code = sdo->objects.find_size(sdo->objects.context, sdo->index, sdo->sub, &size);
    if (code != ABORT_NONE)
        return code;
    write_head(sdo, reply, 0x60);
    if (is_expedited) {
        uint32_t length = is_announced ? 4u - (request[0] >> 2 & 3) : size != 0 && size < 4 ? size : 4u;
        return sdo->objects.download(sdo->objects.context, sdo->index, sdo->sub, request + 4, length);
    }
    /* without an announced length the object's own is the limit, or else the memory */
    sdo->limit = size != 0 ? size : sdo->capacity;
    sdo->excess_abort = size != 0 ? ABORT_TOO_LONG : ABORT_MEMORY;
    if (is_announced) {
        uint32_t announced = (uint32_t)read_bytes(request + 4, 4);
        if (size != 0 && announced != size)
            return announced > size ? ABORT_TOO_LONG : ABORT_TOO_SHORT;
        if (announced > sdo->capacity)
            return ABORT_MEMORY;
        sdo->limit = announced;
        sdo->excess_abort = ABORT_TOO_LONG;
    }
    sdo->is_announced = is_announced;
    sdo->open = DOWNLOAD_SEGMENT;
    return ABORT_NONE;
}

static uint32_t begin_upload(struct sdo_server *sdo, uint8_t *reply)
{
    const uint8_t *value;
    uint32_t length;
    uint32_t code = sdo->objects.upload(sdo->objects.context, sdo->index, sdo->sub, &value, &length);
    if (code != ABORT_NONE)
        return code;
    if (length > 0 && length <= 4) {
        write_head(sdo, reply, (uint8_t)(0x43 | (4 - length) << 2));
        memcpy(reply + 4, value, length);
        return ABORT_NONE;
    }
    write_head(sdo, reply, 0x41);
    write_bytes(reply + 4, length, 4);
    sdo->left = value;
    sdo->length = length;
    sdo->open = UPLOAD_SEGMENT;
    return ABORT_NONE;
}

static uint32_t receive_segment(struct sdo_server *sdo, const uint8_t *request, uint8_t *reply)
{
    const bool is_last = request[0] & 1;
    const uint32_t count = 7u - (request[0] >> 1 & 7);
    reply[0] = (uint8_t)(0x20 | (request[0] & 0x10));
    if (count > sdo->limit - sdo->length)
        return sdo->excess_abort;
    memcpy(sdo->buffer + sdo->length, request + 1, count);
    sdo->length += count;
    if (!is_last)
        return ABORT_NONE;
    if (sdo->is_announced && sdo->length < sdo->limit)
        return ABORT_TOO_SHORT;
    uint32_t length = sdo->length;
    sdo_reset(sdo);
    return sdo->objects.download(sdo->objects.context, sdo->index, sdo->sub, sdo->buffer, length);
}

static void send_segment(struct sdo_server *sdo, const uint8_t *request, uint8_t *reply)
{
    const uint32_t count = sdo->length < 7 ? sdo->length : 7;
    if (count > 0)
        memcpy(reply + 1, sdo->left, count);
    sdo->left += count;
    sdo->length -= count;
    const bool is_last = sdo->length == 0;
    reply[0] = (uint8_t)((request[0] & 0x10) | (7 - count) << 1 | is_last);
    if (is_last)
        sdo_reset(sdo);
}

static uint32_t handle_segment(struct sdo_server *sdo, const uint8_t *request, uint8_t *reply)
{
    if (sdo->open != request[0] >> 5)
        return ABORT_COMMAND;
    if ((request[0] & 0x10) != sdo->toggle)
        return ABORT_TOGGLE;
    sdo->toggle ^= 0x10;
    if (sdo->open == DOWNLOAD_SEGMENT)
        return receive_segment(sdo, request, reply);
    send_segment(sdo, request, reply);
    return ABORT_NONE;
}

static uint32_t handle_request(struct sdo_server *sdo, const uint8_t *request, uint8_t *reply)
{
    const uint8_t specifier = request[0] >> 5;
    if (specifier == DOWNLOAD_SEGMENT || specifier == UPLOAD_SEGMENT)
        return handle_segment(sdo, request, reply);
    sdo_reset(sdo); /* a new request takes the place of an unfinished one */
    sdo->index = (uint16_t)read_bytes(request + 1, 2);
    sdo->sub = request[3];
    if (specifier == DOWNLOAD)
        return begin_download(sdo, request, reply);
    if (specifier == UPLOAD)
        return begin_upload(sdo, reply);
    return ABORT_COMMAND; /* block transfer, or nothing the standard knows */
}

void sdo_receive(struct sdo_server *sdo, const struct frame *frame)
{
    if (frame->length != 8)
        return;
    sdo->last_ns = frame->t_ns;
    if (frame->data[0] >> 5 == ABORT) {
        sdo_reset(sdo);
        return;
    }
    uint8_t reply[8] = {0};
    uint32_t code = handle_request(sdo, frame->data, reply);
    if (code != ABORT_NONE)
        abort_transfer(sdo, code);
    else
        answer(sdo, reply);
}

void sdo_tick(struct sdo_server *sdo, int64_t t_ns)
{
    if (sdo->open != NOTHING_OPEN && t_ns - sdo->last_ns > TIMEOUT_NS)
        abort_transfer(sdo, ABORT_TIMEOUT);
}
