#include "drive.h"

#include <math.h>
#include <string.h>

#include "bytes.h"

enum { GAINS = 0x2002, CONTROL_WORD = 0x6040, QUICK_STOP_OPTION = 0x605A, MODE = 0x6060 };
enum { HALT = 0x100, VOLTAGE = 0x10, REMOTE = 0x200, LIMITED = 0x800, FOLLOWS = 0x1000 }; /* control, then status word */
enum { NO_MODE = 0, CYCLIC_SYNCHRONOUS_POSITION = 8, STAY_IN_QUICK_STOP = 6 };
enum { EMCY_SENSOR = 0x7300, ERROR_PROFILE = 0x20 }; /* a position that is no number */
enum { LOST_AFTER = 3 };                             /* SYNCs in a row without an RPDO */
static const double DEFAULT_PERIOD = 1e-3;           /* s, of SYNC */

static double real_from_bits(uint64_t bits)
{
    const uint32_t word = (uint32_t)bits;
    float value;
    memcpy(&value, &word, sizeof value);
    return value;
}

/* The integer next to a value, limited; 0 for NaN. */
static int32_t round_limited(double value, int32_t limit)
{
    if (isnan(value))
        return 0;
    return (int32_t)nearbyint(fmin(fmax(value, -limit), limit));
}

static double read_position(const struct drive *drive) /* m */
{
    return real_from_bits(drive->values[OBJECT_2001_00]) / 1e3;
}

static bool is_running(const struct drive *drive)
{
    return drive->power.state == OPERATION_ENABLED && drive->device.state == NMT_OPERATIONAL &&
           drive->values[OBJECT_6060_00] == CYCLIC_SYNCHRONOUS_POSITION;
}

/* Set what the drive says, for TPDOs and SDO. */
static void update_outputs(struct drive *drive, double current)
{
    const bool is_following = is_running(drive) && !drive->is_halted;
    const double ampere_counts = 1e6 / (double)drive->values[OBJECT_6075_00]; /* per mille of the rated current */
    drive->values[OBJECT_6041_00] = (uint16_t)(power_status(drive->power.state) | VOLTAGE |
                                               (drive->device.state == NMT_OPERATIONAL ? REMOTE : 0) |
                                               (drive->is_limited ? LIMITED : 0) | (is_following ? FOLLOWS : 0));
    drive->values[OBJECT_6061_00] = drive->values[OBJECT_6060_00];
    drive->values[OBJECT_6064_00] = (uint32_t)round_limited(read_position(drive) * 1e6, INT32_MAX);
    drive->values[OBJECT_6078_00] = (uint16_t)round_limited(current * ampere_counts, INT16_MAX);
}

static void stop_current(struct drive *drive)
{
    memset(&drive->law, 0, sizeof drive->law);
    drive->is_halted = drive->is_limited = false;
    update_outputs(drive, 0.0);
}

static void enter_fault(struct drive *drive, uint16_t code)
{
    drive->values[OBJECT_603F_00] = code;
    power_fault(&drive->power);
    stop_current(drive);
}

static void follow_control_word(struct drive *drive, uint16_t control)
{
    const struct watch *position = &drive->watches[POSITION_RPDO - 1];
    const bool is_operable = drive->device.state == NMT_OPERATIONAL && position->is_heard && !position->is_lost;
    const bool was_faulty = drive->power.state == FAULT;
    drive->power.stays_in_quick_stop = drive->values[OBJECT_605A_00] == STAY_IN_QUICK_STOP;
    power_command(&drive->power, control, is_operable, drive->device.emcy.count == 0);
    if (was_faulty && drive->power.state != FAULT)
        drive->values[OBJECT_603F_00] = 0;
    if (!is_running(drive))
        stop_current(drive);
}

/* SYNC: without a new RPDO for too long, raise a fault. */
static void watch_rpdo(struct drive *drive, uint8_t number)
{
    struct watch *watch = &drive->watches[number - 1];
    const bool is_fresh = drive->device.pdos.rpdos[number - 1].is_fresh || watch->is_new;
    watch->is_new = false;
    if (is_fresh) {
        watch->is_heard = true;
        watch->silent = 0;
        if (watch->is_lost)
            emcy_clear(&drive->device.emcy, EMCY_RPDO_TIMEOUT, number);
        watch->is_lost = false;
        return;
    }
    if (watch->is_heard && watch->silent <= LOST_AFTER)
        watch->silent++;
    if (watch->silent <= LOST_AFTER)
        return;
    watch->is_lost = true;
    emcy_raise(&drive->device.emcy, EMCY_RPDO_TIMEOUT, ERROR_COMMUNICATION, &number, 1);
    enter_fault(drive, EMCY_RPDO_TIMEOUT);
}

static void watch_sensor(struct drive *drive)
{
    if (isfinite(read_position(drive))) {
        emcy_clear(&drive->device.emcy, EMCY_SENSOR, EMCY_ANY_DETAIL);
        return;
    }
    emcy_raise(&drive->device.emcy, EMCY_SENSOR, ERROR_PROFILE, NULL, 0);
    enter_fault(drive, EMCY_SENSOR);
}

/* Current for this cycle, A. While halted the drive holds the position where the halt found it. */
static double run_loop(struct drive *drive)
{
    const double rated = (double)drive->values[OBJECT_6075_00] * 1e-3; /* A */
    const uint64_t period = drive->values[OBJECT_1006_00]; /* of SYNC, us; 0: not told */
    const struct gains gains = {
        .proportional_gain = real_from_bits(drive->values[OBJECT_2002_01]),
        .current_limit = (double)drive->values[OBJECT_6073_00] * 1e-3 * rated,
        .derivative_gain = real_from_bits(drive->values[OBJECT_2002_02]),
        .period = period ? (double)period * 1e-6 : DEFAULT_PERIOD,
    };
    const double position = read_position(drive);
    const bool is_halted = drive->values[OBJECT_6040_00] & HALT;
    if (is_halted && !drive->is_halted)
        drive->held = position;
    drive->is_halted = is_halted;
    const double target = (double)(int32_t)(uint32_t)drive->values[OBJECT_607A_00] / 1e6;
    const double current = compute_current(&drive->law, is_halted ? drive->held : target, position, &gains);
    drive->is_limited = fabs(current) >= gains.current_limit;
    return current;
}

/* SYNC: the RPDOs are latched, the TPDOs are packed after this. */
static void on_sync(void *context)
{
    struct drive *drive = context;
    power_advance(&drive->power);
    watch_rpdo(drive, TARGET_RPDO);
    watch_rpdo(drive, POSITION_RPDO);
    watch_sensor(drive);
    follow_control_word(drive, (uint16_t)drive->values[OBJECT_6040_00]);
    if (is_running(drive))
        update_outputs(drive, run_loop(drive));
    device_transmit(&drive->device, 1);
    device_transmit(&drive->device, 2);
}

static void on_rpdo(void *context, uint16_t number)
{
    struct drive *drive = context;
    drive->watches[number - 1].is_new = true;
}

/* A control word by SDO acts at once; modes other than 8, and gains that are no number, are refused. */
static uint32_t on_write(void *context, uint16_t index, uint8_t sub, const uint8_t *data, uint32_t length)
{
    struct drive *drive = context;
    const uint64_t value = read_bytes(data, (uint8_t)length);
    (void)sub;
    if (index == CONTROL_WORD)
        follow_control_word(drive, (uint16_t)value);
    else if (index == MODE && value != NO_MODE && value != CYCLIC_SYNCHRONOUS_POSITION)
        return ABORT_VALUE;
    else if (index == QUICK_STOP_OPTION && value != 2 && value != STAY_IN_QUICK_STOP)
        return ABORT_VALUE;
    else if (index == GAINS && !(isfinite(real_from_bits(value)) && real_from_bits(value) >= 0.0))
        return ABORT_VALUE;
    return ABORT_NONE;
}

/* Who leaves OPERATIONAL with the power on has lost its master: a fault. A reset starts the drive anew. */
static void on_nmt(void *context, enum nmt_state old, enum nmt_state new)
{
    struct drive *drive = context;
    (void)old;
    for (unsigned i = 0; i < RPDO_COUNT; i++) {
        const bool is_lost = drive->watches[i].is_lost && new != NMT_INITIALISING;
        drive->watches[i] = (struct watch){.is_lost = is_lost};
    }
    if (new == NMT_INITIALISING) {
        drive->power = (struct power){.state = NOT_READY, .is_reset_seen = true};
        drive->values[OBJECT_603F_00] = 0;
    } else if (new != NMT_OPERATIONAL &&
               (drive->power.state == OPERATION_ENABLED || drive->power.state == QUICK_STOP_ACTIVE)) {
        enter_fault(drive, EMCY_COMMUNICATION);
    }
    stop_current(drive);
}

static void on_sync_lost(void *context)
{
    enter_fault(context, EMCY_COMMUNICATION);
}

static void on_heartbeat_lost(void *context, uint8_t node)
{
    (void)node;
    enter_fault(context, EMCY_HEARTBEAT_LOST);
}

bool drive_init(struct drive *drive, uint8_t node_id, struct output output)
{
    memset(drive, 0, sizeof *drive);
    const struct dictionary od = {OBJECT_TABLE, OBJECT_COUNT, drive->values, 0};
    const struct hooks hooks = {drive, on_sync, on_rpdo, on_write, on_nmt, on_sync_lost, on_heartbeat_lost};
    return device_init(&drive->device, node_id, od, output, hooks, drive->buffer, sizeof drive->buffer);
}

void drive_receive(struct drive *drive, const struct frame *frame)
{
    device_receive(&drive->device, frame);
}

void drive_tick(struct drive *drive, int64_t t_ns)
{
    device_tick(&drive->device, t_ns);
    if (drive->device.state != NMT_OPERATIONAL || drive->device.sync.is_lost) { /* no SYNC that would do it */
        power_advance(&drive->power);
        update_outputs(drive, 0.0);
    }
}
