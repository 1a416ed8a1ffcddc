#include "faults.h"

#include <stddef.h>
#include <string.h>

#include "bytes.h"
#include "serve.h"

enum { LAST_SENT = 1000, ENABLE = 0x0F, RESET = 0x80, ENABLED_STATUS = 0x1237, STATE = 0x6F /* bits of the status word */ };
enum { STATUS = 0, CURRENT = 2, TPDO1_LENGTH = 4, RPDO1_LENGTH = 6 }; /* bytes */

static const char *const NAMES[] = {"none", "wrong_sign", "wrong_scaling", "ignores_enable", "stops_sending",
                                    "stuck_status"};
static const char *fault = "none";
static struct power sound = {.state = SWITCH_ON_DISABLED}; /* that follows the control word on the bus */
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

void faults_receive(struct drive *drive, const struct frame *frame)
{
    struct frame heard = *frame;
    if (has("ignores_enable") && frame->cob_id == 0x200u + drive->device.node_id && frame->length == RPDO1_LENGTH) {
        const uint16_t control = (uint16_t)read_bytes(frame->data, 2);
        power_command(&sound, control, true, true);
        write_bytes(heard.data, ENABLE | (control & RESET), 2);
        if (drive->power.state < OPERATION_ENABLED && drive->power.state != NOT_READY)
            drive->power.state = OPERATION_ENABLED;
    }
    drive_receive(drive, &heard);
}

static void spoil(uint8_t *data)
{
    const uint16_t status = (uint16_t)read_bytes(data + STATUS, 2);
    const int16_t current = (int16_t)(uint16_t)read_bytes(data + CURRENT, 2);
    if (has("wrong_sign"))
        write_bytes(data + CURRENT, (uint16_t)-current, 2);
    else if (has("wrong_scaling"))
        write_bytes(data + CURRENT, (uint16_t)(2 * current), 2);
    else if (has("ignores_enable") && (status & STATE) == power_status(OPERATION_ENABLED))
        write_bytes(data + STATUS, (uint16_t)((status & ~STATE) | power_status(sound.state)), 2);
    else if (has("stuck_status"))
        write_bytes(data + STATUS, ENABLED_STATUS, 2);
}

void faults_send(void *context, uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    const struct drive *drive = context;
    uint8_t spoiled[8] = {0};
    memcpy(spoiled, data, length);
    if (cob_id == 0x180u + drive->device.node_id && length == TPDO1_LENGTH) {
        if (has("stops_sending") && sent++ >= LAST_SENT)
            return;
        spoil(spoiled);
    }
    BUS_OUTPUT.send(BUS_OUTPUT.context, cob_id, spoiled, length);
}
