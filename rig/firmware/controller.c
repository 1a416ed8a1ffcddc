#include "controller.h"

#include <math.h>
#include <string.h>

#include "bytes.h"

enum { GAINS = 0x2110, CURRENT_LIMIT = 4, PERIOD = 5 };
/* control word 0x6040 and status word 0x6041 (CiA 408): the three levels build on each other */
enum { LEVELS = 0x7, RESET = 0x8, LOOP_CLOSED = 0x4, READY = 0x8 };
enum { LOST_AFTER = 3 }; /* SYNCs in a row without feedback, or without a command */
static const uint8_t COMMAND_RPDO = 1, FEEDBACK_RPDO = 2; /* first information byte of EMCY 0x8250 */

static double real_from_bits(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Metres of a position in counts of 1e-7 m. The division gives the double nearest to the decimal. */
static double metres(uint64_t bits)
{
    return (double)(int32_t)(uint32_t)bits / 1e7;
}

/* Counts of a current, 1e-8 A; half counts go to the even one. */
static int32_t current_counts(double amperes)
{
    const double counts = amperes * 1e8;
    if (counts >= INT32_MAX)
        return INT32_MAX;
    if (counts <= INT32_MIN)
        return INT32_MIN;
    return isnan(counts) ? 0 : (int32_t)nearbyint(counts);
}

static void open_loop(struct controller *controller)
{
    memset(&controller->law, 0, sizeof controller->law);
}

static void restart_loop(struct controller *controller)
{
    const uint64_t *values = controller->values;
    open_loop(controller);
    controller->gains = (struct gains){
        .proportional_gain = real_from_bits(values[OBJECT_2110_01]),
        .integral_gain = real_from_bits(values[OBJECT_2110_02]),
        .derivative_gain = real_from_bits(values[OBJECT_2110_03]),
        .current_limit = real_from_bits(values[OBJECT_2110_04]),
        .period = real_from_bits(values[OBJECT_2110_05]),
    };
    controller->silent_cycles = 0;
    controller->uncommanded_cycles = 0;
    controller->has_fault = false;
    controller->is_reset_seen = true;
}

/* Status word: the level bits of the control word, unless a fault is latched. */
static uint16_t update_status(struct controller *controller)
{
    const uint64_t control = controller->values[OBJECT_6040_00];
    const bool is_reset = control & RESET;
    if (controller->has_fault && is_reset && !controller->is_reset_seen && controller->device.emcy.count == 0)
        controller->has_fault = false;
    controller->is_reset_seen = is_reset;
    if (controller->has_fault)
        return 0;
    const uint16_t levels = control & LEVELS; /* each needs the ones below: 1, 3, 7 */
    return (uint16_t)((levels & (levels + 1)) == 0 ? levels | READY : READY);
}

static void send_drive(struct controller *controller, double current, uint16_t status)
{
    controller->values[OBJECT_2104_00] = (uint32_t)current_counts(current);
    controller->values[OBJECT_6041_00] = status;
    controller->values[OBJECT_2105_00] = controller->values[OBJECT_2101_00];
    device_transmit(&controller->device, DRIVE_TPDO);
}

/* SYNC: without a new command for too long, raise a fault. */
static void watch_command(struct controller *controller)
{
    struct emcy *emcy = &controller->device.emcy;
    if (controller->device.pdos.rpdos[COMMAND_RPDO - 1].is_fresh) {
        controller->uncommanded_cycles = 0;
        if (controller->is_command_lost)
            emcy_clear(emcy, EMCY_RPDO_TIMEOUT, COMMAND_RPDO);
        controller->is_command_lost = false;
        return;
    }
    if (controller->uncommanded_cycles <= LOST_AFTER)
        controller->uncommanded_cycles++;
    if (controller->uncommanded_cycles <= LOST_AFTER)
        return;
    controller->is_command_lost = true;
    controller->has_fault = true;
    emcy_raise(emcy, EMCY_RPDO_TIMEOUT, ERROR_COMMUNICATION, &COMMAND_RPDO, 1);
}

/* SYNC: the command of this cycle is latched and feedback follows. Without either for too long, raise a fault. */
static void on_sync(void *context)
{
    struct controller *controller = context;
    watch_command(controller);
    if (controller->silent_cycles <= LOST_AFTER)
        controller->silent_cycles++;
    if (controller->silent_cycles <= LOST_AFTER)
        return;
    controller->is_feedback_lost = true;
    controller->has_fault = true;
    emcy_raise(&controller->device.emcy, EMCY_RPDO_TIMEOUT, ERROR_COMMUNICATION, &FEEDBACK_RPDO, 1);
    send_drive(controller, 0.0, update_status(controller));
}

/* Feedback arrived: close the loop. */
static void on_rpdo(void *context, uint16_t number)
{
    struct controller *controller = context;
    (void)number;
    if (controller->is_feedback_lost) {
        controller->is_feedback_lost = false;
        emcy_clear(&controller->device.emcy, EMCY_RPDO_TIMEOUT, FEEDBACK_RPDO);
    }
    controller->silent_cycles = 0;
    const uint16_t status = update_status(controller);
    double current = 0.0;
    if (status & LOOP_CLOSED)
        current = compute_current(&controller->law, metres(controller->values[OBJECT_2100_00]),
                                  metres(controller->values[OBJECT_2102_00]), &controller->gains);
    else
        open_loop(controller);
    send_drive(controller, current, status);
}

/* Refuse NaN and infinite gains (they would produce a NaN current), a negative limit and a period of 0. */
static uint32_t on_write(void *context, uint16_t index, uint8_t sub, const uint8_t *data, uint32_t length)
{
    (void)context;
    if (index != GAINS)
        return ABORT_NONE;
    const double value = real_from_bits(read_bytes(data, (uint8_t)length));
    const bool is_in_range = (sub != CURRENT_LIMIT || value >= 0.0) && (sub != PERIOD || value > 0.0);
    return isfinite(value) && is_in_range ? ABORT_NONE : ABORT_VALUE;
}

static void on_nmt(void *context, enum nmt_state old, enum nmt_state new)
{
    struct controller *controller = context;
    (void)old;
    if (new == NMT_OPERATIONAL)
        restart_loop(controller);
    else if (new == NMT_INITIALISING)
        controller->is_feedback_lost = controller->is_command_lost = false;
}

/* SYNC has stopped, so no feedback will ask for an answer: say at once that there is no current any more. */
static void on_sync_lost(void *context)
{
    struct controller *controller = context;
    controller->has_fault = true;
    send_drive(controller, 0.0, update_status(controller));
}

static void on_heartbeat_lost(void *context, uint8_t node)
{
    struct controller *controller = context;
    (void)node;
    controller->has_fault = true;
}

bool controller_init(struct controller *controller, struct output output)
{
    memset(controller, 0, sizeof *controller);
    const struct dictionary od = {OBJECT_TABLE, OBJECT_COUNT, controller->values, 0};
    const struct hooks hooks = {controller, on_sync, on_rpdo, on_write, on_nmt, on_sync_lost, on_heartbeat_lost};
    bool is_consistent = device_init(&controller->device, CONTROLLER_NODE, od, output, hooks, controller->buffer,
                                     sizeof controller->buffer);
    restart_loop(controller);
    return is_consistent;
}

void controller_receive(struct controller *controller, const struct frame *frame)
{
    device_receive(&controller->device, frame);
}

void controller_tick(struct controller *controller, int64_t t_ns)
{
    device_tick(&controller->device, t_ns);
}
