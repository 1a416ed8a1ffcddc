#include "datagram.h"

#include <string.h>

/* msgpack: first bytes of the values that occur */
enum { FIXMAP = 0x80, FIXSTR = 0xA0, NIL = 0xC0, FALSE_ = 0xC2, TRUE_ = 0xC3, BIN8 = 0xC4, FLOAT64 = 0xCB,
       UINT16 = 0xCD, UINT32 = 0xCE };

static const uint32_t STANDARD_LAST = 0x7FF, EXTENDED_LAST = 0x1FFFFFFF; /* identifiers */

static uint8_t *put_key(uint8_t *next, const char *key)
{
    const size_t length = strlen(key); /* below 32 */
    *next++ = (uint8_t)(FIXSTR | length);
    memcpy(next, key, length);
    return next + length;
}

static uint8_t *put_number(uint8_t *next, uint8_t first, uint32_t number, unsigned size)
{
    *next++ = first;
    while (size-- > 0)
        *next++ = (uint8_t)(number >> (8 * size)); /* msgpack is big-endian */
    return next;
}

static uint8_t *put_flag(uint8_t *next, const char *key, bool value)
{
    next = put_key(next, key);
    *next++ = value ? TRUE_ : FALSE_;
    return next;
}

size_t datagram_pack(const struct frame *frame, uint8_t *bytes)
{
    uint8_t *next = bytes;
    *next++ = FIXMAP | 11;
    next = put_key(next, "timestamp"); /* 0.0: none */
    *next++ = FLOAT64;
    memset(next, 0, 8);
    next = put_key(next + 8, "arbitration_id");
    const uint32_t identifier = frame->cob_id & EXTENDED_LAST;
    next = identifier > 0xFFFF ? put_number(next, UINT32, identifier, 4) : put_number(next, UINT16, identifier, 2);
    next = put_flag(next, "is_extended_id", frame->cob_id & ID_EXTENDED);
    next = put_flag(next, "is_remote_frame", false);
    next = put_flag(next, "is_error_frame", false);
    next = put_key(next, "channel");
    *next++ = NIL;
    next = put_key(next, "dlc");
    *next++ = frame->length;
    next = put_key(next, "data");
    *next++ = BIN8;
    *next++ = frame->length;
    memcpy(next, frame->data, frame->length);
    next = put_flag(next + frame->length, "is_fd", false);
    next = put_flag(next, "bitrate_switch", false);
    next = put_flag(next, "error_state_indicator", false);
    return (size_t)(next - bytes);
}

struct reader {
    const uint8_t *next, *end;
};

/* One value: a number or flag in `number`, or `length` bytes of a string or binary at `bytes`. */
struct value {
    bool is_bytes;
    uint64_t number;
    const uint8_t *bytes;
    size_t length;
};

static bool take_number(struct reader *reader, size_t size, uint64_t *number)
{
    if ((size_t)(reader->end - reader->next) < size)
        return false;
    *number = 0;
    while (size-- > 0)
        *number = *number << 8 | *reader->next++;
    return true;
}

static bool take_bytes(struct reader *reader, size_t length, struct value *value)
{
    if ((size_t)(reader->end - reader->next) < length)
        return false;
    *value = (struct value){true, 0, reader->next, length};
    reader->next += length;
    return true;
}

/* Read a nil, flag, number, string or binary; nothing else occurs in a frame. */
static bool take_value(struct reader *reader, struct value *value)
{
    uint64_t length;
    *value = (struct value){false, 0, NULL, 0};
    if (reader->next == reader->end)
        return false;
    const uint8_t first = *reader->next++;
    if (first < 0x80 || first >= 0xE0) { /* small integers; a negative one becomes too large for any field */
        value->number = first < 0x80 ? first : UINT64_MAX;
        return true;
    }
    if (first >= FIXSTR && first < FIXSTR + 32)
        return take_bytes(reader, first - FIXSTR, value);
    switch (first) {
    case NIL:
    case FALSE_:
        return true;
    case TRUE_:
        value->number = 1;
        return true;
    case BIN8: /* and 16, 32 */
    case 0xC5:
    case 0xC6:
        return take_number(reader, (size_t)1 << (first - BIN8), &length) && take_bytes(reader, length, value);
    case 0xD9: /* strings */
    case 0xDA:
    case 0xDB:
        return take_number(reader, (size_t)1 << (first - 0xD9), &length) && take_bytes(reader, length, value);
    case 0xCA: /* float32 */
        return take_number(reader, 4, &value->number);
    case FLOAT64:
        return take_number(reader, 8, &value->number);
    case 0xCC: /* unsigned integers */
    case UINT16:
    case UINT32:
    case 0xCF:
        return take_number(reader, (size_t)1 << (first - 0xCC), &value->number);
    case 0xD0: /* signed integers */
    case 0xD1:
    case 0xD2:
    case 0xD3:
        return take_number(reader, (size_t)1 << (first - 0xD0), &value->number);
    default:
        return false;
    }
}

static bool is_key(const struct value *key, const char *name)
{
    return key->length == strlen(name) && memcmp(key->bytes, name, key->length) == 0;
}

bool datagram_unpack(const uint8_t *bytes, size_t length, struct frame *frame)
{
    struct reader reader = {bytes, bytes + length};
    struct value key, value, data = {true, 0, NULL, 0};
    uint64_t count, cob_id = 0, dlc = UINT64_MAX;
    bool is_extended = true, is_special = false; /* python-can's defaults for keys that are left out */
    if (length == 0 || (bytes[0] & 0xF0) != FIXMAP)
        return false;
    count = *reader.next++ & 0x0F;
    while (count-- > 0) {
        if (!take_value(&reader, &key) || !key.is_bytes || !take_value(&reader, &value))
            return false;
        if (is_key(&key, "arbitration_id"))
            cob_id = value.number;
        else if (is_key(&key, "is_extended_id"))
            is_extended = value.number != 0;
        else if (is_key(&key, "is_remote_frame") || is_key(&key, "is_error_frame") || is_key(&key, "is_fd"))
            is_special |= value.number != 0;
        else if (is_key(&key, "dlc"))
            dlc = value.number;
        else if (is_key(&key, "data"))
            data = value;
    }
    if (is_special || cob_id > (is_extended ? EXTENDED_LAST : STANDARD_LAST))
        return false;
    if (data.length > 8 || (dlc != UINT64_MAX && dlc != data.length))
        return false;
    frame->cob_id = (uint32_t)cob_id | (is_extended ? ID_EXTENDED : 0);
    frame->length = (uint8_t)data.length;
    memset(frame->data, 0, sizeof frame->data);
    if (data.length > 0)
        memcpy(frame->data, data.bytes, data.length);
    return true;
}
