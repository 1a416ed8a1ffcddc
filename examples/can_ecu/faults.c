#include "faults.h"

#include <stddef.h>
#include <string.h>

#include "serve.h"

enum { SOUND_FRAMES = 1000, ENABLE = 0x08 };

static const char *const NAMES[] = {"none", "wrong_sign", "wrong_scaling", "ignores_enable", "stops_sending",
                                    "wrong_counter"};
static const char *fault = "none";
static unsigned sent;

bool faults_select(const char *name)
{
    fault = name;
    for (size_t i = 0; i < sizeof NAMES / sizeof NAMES[0]; i++)
        if (strcmp(name, NAMES[i]) == 0)
            return true;
    return false;
}

static bool has(const char *name)
{
    return strcmp(fault, name) == 0;
}

void faults_receive(struct ecu *ecu, const struct frame *frame)
{
    struct frame heard = *frame;
    if (has("ignores_enable") && frame->cob_id == DEMAND_ID && frame->length == DEMAND_LENGTH) {
        const uint8_t difference = heard.data[0] ^ compute_crc8(heard.data + 1, DEMAND_LENGTH - 1); /* 0: right */
        heard.data[1] |= ENABLE;
        heard.data[0] = difference ^ compute_crc8(heard.data + 1, DEMAND_LENGTH - 1);
    }
    ecu_receive(ecu, &heard);
}

static void set_current(uint8_t *data, int32_t factor)
{
    const int32_t current = factor * (int16_t)(uint16_t)(data[2] << 8 | data[3]);
    data[2] = (uint8_t)(current >> 8);
    data[3] = (uint8_t)current;
}

void faults_send(void *context, uint32_t identifier, const uint8_t *data, uint8_t length)
{
    uint8_t spoiled[DRIVE_LENGTH];
    const struct ecu *ecu = context;
    const bool is_late = sent >= SOUND_FRAMES;
    sent += ecu->state == ECU_OPERATIONAL;
    if (is_late && has("stops_sending"))
        return;
    memcpy(spoiled, data, DRIVE_LENGTH); /* it sends no other frame */
    if (has("wrong_sign"))
        set_current(spoiled, -1);
    else if (has("wrong_scaling"))
        set_current(spoiled, 2);
    protect(spoiled, length, is_late && has("wrong_counter") ? 0 : data[1] >> 4);
    BUS_OUTPUT.send(BUS_OUTPUT.context, identifier, spoiled, length);
}
