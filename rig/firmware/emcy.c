#include "emcy.h"

#include <string.h>

#include "bytes.h"
#include "cob_id.h"

enum { REGISTER = 0x1001, HISTORY = 0x1003, COB_ID = 0x1014 };

static void record(struct emcy *emcy, uint16_t code, const uint8_t *info, uint8_t length)
{
    uint8_t depth = dictionary_last_sub(emcy->od, HISTORY);
    if (depth == 0)
        return;
    for (uint8_t sub = depth; sub > 1; sub--) /* newest first: sub 1 */
        dictionary_write(emcy->od, HISTORY, sub, dictionary_read(emcy->od, HISTORY, sub - 1, 0));
    uint64_t detail = read_bytes(info, length < 2 ? length : 2);
    dictionary_write(emcy->od, HISTORY, 1, code | detail << 16);
    uint64_t count = dictionary_read(emcy->od, HISTORY, 0, 0) + 1;
    dictionary_write(emcy->od, HISTORY, 0, count < depth ? count : depth);
}

static void transmit(struct emcy *emcy, uint16_t code, const uint8_t *info, uint8_t length)
{
    uint8_t bits = 0;
    for (uint8_t i = 0; i < emcy->count; i++)
        bits |= emcy->errors[i].bits;
    dictionary_write(emcy->od, REGISTER, 0, bits);
    uint64_t cob_id = dictionary_read(emcy->od, COB_ID, 0, COB_ID_INVALID);
    if (!emcy->is_permitted || cob_id & COB_ID_INVALID)
        return;
    uint8_t data[8] = {0};
    write_bytes(data, code, 2);
    data[2] = bits;
    if (length > 0)
        memcpy(data + 3, info, length < 5 ? length : 5);
    emcy->output.send(emcy->output.context, cob_id & 0x7FF, data, 8);
}

void emcy_reset(struct emcy *emcy)
{
    emcy->count = 0;
}

void emcy_raise(struct emcy *emcy, uint16_t code, uint8_t bits, const uint8_t *info, uint8_t length)
{
    int16_t detail = length > 0 ? info[0] : EMCY_ANY_DETAIL;
    for (uint8_t i = 0; i < emcy->count; i++)
        if (emcy->errors[i].code == code && emcy->errors[i].detail == detail)
            return;
    if (emcy->count < EMCY_ERRORS_MAX)
        emcy->errors[emcy->count++] = (struct emcy_error){code, detail, bits | ERROR_GENERIC};
    record(emcy, code, info, length);
    transmit(emcy, code, info, length);
}

void emcy_clear(struct emcy *emcy, uint16_t code, int16_t detail)
{
    uint8_t kept = 0;
    for (uint8_t i = 0; i < emcy->count; i++) {
        struct emcy_error error = emcy->errors[i];
        bool is_gone = error.code == code && (detail == EMCY_ANY_DETAIL || error.detail == detail);
        if (!is_gone)
            emcy->errors[kept++] = error;
    }
    if (kept < emcy->count) {
        emcy->count = kept;
        transmit(emcy, EMCY_RESET, NULL, 0);
    }
}

void emcy_clear_all(struct emcy *emcy)
{
    if (emcy->count > 0) {
        emcy->count = 0;
        transmit(emcy, EMCY_RESET, NULL, 0);
    }
}

void emcy_erase_history(struct emcy *emcy)
{
    for (unsigned sub = 0; sub <= dictionary_last_sub(emcy->od, HISTORY); sub++)
        dictionary_write(emcy->od, HISTORY, (uint8_t)sub, 0);
}
