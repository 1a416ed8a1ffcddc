#include "pdo.h"

#include <string.h>

#include "bytes.h"
#include "cob_id.h"

enum { LAST_SYNCHRONOUS = 240, EVENT_DRIVEN = 254 }; /* transmission types; 254 and 255 are event-driven */

static bool is_writable(const struct dictionary *od, uint16_t index)
{
    for (size_t i = 0; i < od->count; i++)
        if (od->objects[i].index == index && od->objects[i].flags & WRITABLE)
            return true;
    return false;
}

static bool read_mapping(const struct dictionary *od, uint16_t index, struct mapping *mapping)
{
    memset(mapping, 0, sizeof *mapping);
    uint64_t count = dictionary_read(od, index, 0, 0);
    if (count > MAPPED_MAX || is_writable(od, index))
        return false;
    unsigned length = 0;
    for (uint8_t sub = 1; sub <= count; sub++) {
        uint64_t word = dictionary_read(od, index, sub, 0);
        size_t position = dictionary_find(od, word >> 16 & 0xFFFF, word >> 8 & 0xFF);
        if (position == NO_OBJECT)
            return false;
        const struct object *object = &od->objects[position];
        if (!(object->flags & MAPPABLE) || object->size == 0 || 8u * object->size != (word & 0xFF))
            return false;
        mapping->positions[mapping->count] = position;
        mapping->sizes[mapping->count++] = object->size;
        length += object->size;
    }
    mapping->length = (uint8_t)length;
    return length <= 8;
}

static void unpack(struct pdos *pdos, const struct mapping *mapping, const uint8_t *data)
{
    for (uint8_t i = 0; i < mapping->count; i++) {
        pdos->od->values[mapping->positions[i]] = read_bytes(data, mapping->sizes[i]);
        data += mapping->sizes[i];
    }
}

bool pdos_init(struct pdos *pdos)
{
    pdos->rpdo_count = pdos->tpdo_count = 0;
    for (uint16_t n = 1; n <= 0x200; n++) {
        bool is_received = dictionary_find(pdos->od, (uint16_t)(RPDO + n - 1), 1) != NO_OBJECT;
        bool is_sent = dictionary_find(pdos->od, (uint16_t)(TPDO + n - 1), 1) != NO_OBJECT;
        if ((is_received && pdos->rpdo_count == PDOS_MAX) || (is_sent && pdos->tpdo_count == PDOS_MAX))
            return false;
        if (is_received) {
            struct rpdo *rpdo = &pdos->rpdos[pdos->rpdo_count++];
            memset(rpdo, 0, sizeof *rpdo);
            rpdo->number = n;
            if (!read_mapping(pdos->od, (uint16_t)(RPDO + 0x200 + n - 1), &rpdo->mapping))
                return false;
        }
        if (is_sent) {
            struct tpdo *tpdo = &pdos->tpdos[pdos->tpdo_count++];
            memset(tpdo, 0, sizeof *tpdo);
            tpdo->number = n;
            if (!read_mapping(pdos->od, (uint16_t)(TPDO + 0x200 + n - 1), &tpdo->mapping))
                return false;
        }
    }
    pdos_configure(pdos);
    return true;
}

static void forget_rpdo(struct rpdo *rpdo)
{
    rpdo->is_waiting = rpdo->is_fresh = false;
}

static void forget_tpdo(struct tpdo *tpdo)
{
    tpdo->countdown = tpdo->type;
    tpdo->is_requested = false;
}

void pdos_configure(struct pdos *pdos)
{
    for (uint8_t i = 0; i < pdos->rpdo_count; i++) {
        struct rpdo *rpdo = &pdos->rpdos[i];
        uint64_t word = dictionary_read(pdos->od, (uint16_t)(RPDO + rpdo->number - 1), 1, COB_ID_INVALID);
        rpdo->is_valid = !(word & COB_ID_INVALID);
        rpdo->cob_id = word & 0x7FF;
        uint64_t type = dictionary_read(pdos->od, (uint16_t)(RPDO + rpdo->number - 1), 2, 0);
        rpdo->is_synchronous = type <= LAST_SYNCHRONOUS;
        if (!rpdo->is_valid)
            forget_rpdo(rpdo);
    }
    for (uint8_t i = 0; i < pdos->tpdo_count; i++) {
        struct tpdo *tpdo = &pdos->tpdos[i];
        uint64_t word = dictionary_read(pdos->od, (uint16_t)(TPDO + tpdo->number - 1), 1, COB_ID_INVALID);
        tpdo->is_valid = !(word & COB_ID_INVALID);
        tpdo->cob_id = word & 0x7FF;
        tpdo->type = (uint8_t)dictionary_read(pdos->od, (uint16_t)(TPDO + tpdo->number - 1), 2, 0);
        forget_tpdo(tpdo);
    }
}

void pdos_forget(struct pdos *pdos)
{
    for (uint8_t i = 0; i < pdos->rpdo_count; i++)
        forget_rpdo(&pdos->rpdos[i]);
    for (uint8_t i = 0; i < pdos->tpdo_count; i++)
        forget_tpdo(&pdos->tpdos[i]);
}

struct rpdo *pdos_find_rpdo(struct pdos *pdos, uint32_t cob_id)
{
    for (uint8_t i = pdos->rpdo_count; i-- > 0;) /* of two with one COB-ID the last */
        if (pdos->rpdos[i].is_valid && pdos->rpdos[i].cob_id == cob_id)
            return &pdos->rpdos[i];
    return NULL;
}

/* Whether a frame of that length is used: too short no (EMCY 0x8210), too long its first bytes (0x8220). */
static bool judge_length(struct pdos *pdos, struct rpdo *rpdo, uint8_t length)
{
    uint8_t info = (uint8_t)rpdo->number;
    if (length < rpdo->mapping.length)
        emcy_raise(pdos->emcy, EMCY_PDO_TOO_SHORT, ERROR_COMMUNICATION, &info, 1);
    else
        emcy_clear(pdos->emcy, EMCY_PDO_TOO_SHORT, info);
    if (length > rpdo->mapping.length)
        emcy_raise(pdos->emcy, EMCY_PDO_TOO_LONG, ERROR_COMMUNICATION, &info, 1);
    else
        emcy_clear(pdos->emcy, EMCY_PDO_TOO_LONG, info);
    rpdo->is_faulty = length != rpdo->mapping.length;
    return length >= rpdo->mapping.length;
}

bool rpdo_receive(struct pdos *pdos, struct rpdo *rpdo, const struct frame *frame)
{
    if ((frame->length != rpdo->mapping.length || rpdo->is_faulty) && !judge_length(pdos, rpdo, frame->length))
        return false;
    if (rpdo->is_synchronous) {
        memcpy(rpdo->waiting, frame->data, 8);
        rpdo->is_waiting = true;
        return false;
    }
    unpack(pdos, &rpdo->mapping, frame->data);
    return true;
}

void pdos_latch(struct pdos *pdos)
{
    for (uint8_t i = 0; i < pdos->rpdo_count; i++) {
        struct rpdo *rpdo = &pdos->rpdos[i];
        if (!rpdo->is_synchronous)
            continue;
        rpdo->is_fresh = rpdo->is_waiting;
        if (rpdo->is_waiting)
            unpack(pdos, &rpdo->mapping, rpdo->waiting);
        rpdo->is_waiting = false;
    }
}

static void send_tpdo(struct pdos *pdos, const struct tpdo *tpdo)
{
    if (!tpdo->is_valid)
        return;
    uint8_t data[8], *next = data;
    for (uint8_t i = 0; i < tpdo->mapping.count; i++) {
        write_bytes(next, pdos->od->values[tpdo->mapping.positions[i]], tpdo->mapping.sizes[i]);
        next += tpdo->mapping.sizes[i];
    }
    pdos->output.send(pdos->output.context, tpdo->cob_id, data, tpdo->mapping.length);
}

void pdos_send_synchronous(struct pdos *pdos)
{
    for (uint8_t i = 0; i < pdos->tpdo_count; i++) {
        struct tpdo *tpdo = &pdos->tpdos[i];
        if (tpdo->type > LAST_SYNCHRONOUS)
            continue;
        bool is_due = tpdo->type == 0 ? tpdo->is_requested : --tpdo->countdown == 0;
        tpdo->is_requested = false;
        if (is_due) {
            tpdo->countdown = tpdo->type;
            send_tpdo(pdos, tpdo);
        }
    }
}

void pdos_transmit(struct pdos *pdos, uint16_t number)
{
    for (uint8_t i = 0; i < pdos->tpdo_count; i++) {
        struct tpdo *tpdo = &pdos->tpdos[i];
        if (tpdo->number != number)
            continue;
        if (tpdo->type >= EVENT_DRIVEN)
            send_tpdo(pdos, tpdo);
        else
            tpdo->is_requested = true;
    }
}

uint32_t pdos_check(const struct pdos *pdos, uint16_t index, uint8_t sub, uint64_t value)
{
    bool is_parameter = (index >= RPDO && index < RPDO + 0x200) || (index >= TPDO && index < TPDO + 0x200);
    if (!is_parameter)
        return ABORT_NONE;
    if (sub == 2 && value > LAST_SYNCHRONOUS && value < EVENT_DRIVEN) /* reserved, or by remote frame */
        return ABORT_VALUE;
    if (sub != 1)
        return ABORT_NONE;
    uint32_t code = cob_id_check_switchable(dictionary_read(pdos->od, index, 1, 0), value);
    bool is_sync = (value & 0x7FF) == (dictionary_read(pdos->od, 0x1005, 0, 0x80) & 0x7FF); /* consumed by the device */
    return code == ABORT_NONE && !(value & COB_ID_INVALID) && is_sync ? ABORT_VALUE : code;
}
