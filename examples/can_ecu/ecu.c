#include "ecu.h"

#include <math.h>
#include <string.h>

enum { QUALIFIED = 5, WRONG_MAX = 3 };      /* frames in a row: that make the ECU operational, that are a fault */
static const int64_t IDLE_PERIOD_NS = 10000000;

/* The derivative part makes up for the delay of the cycle of 2 ms: time constant 1.2 ms. */
static const struct gains GAINS = {.proportional_gain = 3.6, .derivative_gain = 3.6 * 1.2e-3, .current_limit = 8e-3,
                                   .period = 2e-3};

/* A signed big-endian number of `bits` bits that ends with a byte. */
static int32_t read_signed(const uint8_t *data, uint8_t first, uint8_t last, uint8_t bits)
{
    uint32_t value = 0;
    for (uint8_t i = first; i <= last; i++)
        value = value << 8 | data[i];
    const uint32_t sign = UINT32_C(1) << (bits - 1), mask = sign | (sign - 1);
    return (int32_t)((value & mask) ^ sign) - (int32_t)sign;
}

static double compute_drive(struct ecu *ecu) /* A */
{
    if (ecu->state == ECU_OPERATIONAL && ecu->is_enabled)
        return compute_current(&ecu->law, ecu->target, ecu->position, &GAINS);
    memset(&ecu->law, 0, sizeof ecu->law);
    return 0.0;
}

static void send_drive(struct ecu *ecu)
{
    const uint16_t counts = (uint16_t)(int16_t)nearbyint(compute_drive(ecu) * 1e6);
    uint8_t data[DRIVE_LENGTH] = {0, (uint8_t)(ecu->state << 1), (uint8_t)(counts >> 8), (uint8_t)counts};
    protect(data, DRIVE_LENGTH, ecu->counter);
    ecu->counter = (ecu->counter + 1) & 0x0F;
    ecu->output.send(ecu->output.context, DRIVE_ID, data, DRIVE_LENGTH);
}

static void update_state(struct ecu *ecu)
{
    const bool is_qualified = ecu->demand.valid >= QUALIFIED && ecu->feedback.valid >= QUALIFIED;
    const bool is_wrong = ecu->demand.invalid >= WRONG_MAX || ecu->feedback.invalid >= WRONG_MAX;
    if (ecu->state == ECU_INIT)
        ecu->state = ECU_SYNCHRONISING;
    if (ecu->state == ECU_OPERATIONAL && is_wrong)
        ecu->state = ECU_FAULT;
    else if (is_qualified && (ecu->state == ECU_SYNCHRONISING || (ecu->state == ECU_FAULT && !ecu->is_enabled)))
        ecu->state = ECU_OPERATIONAL;
}

void ecu_init(struct ecu *ecu, struct output output, int64_t timeout_ns)
{
    memset(ecu, 0, sizeof *ecu);
    ecu->output = output;
    ecu->timeout_ns = timeout_ns;
    ecu->state = ECU_INIT;
}

void ecu_receive(struct ecu *ecu, const struct frame *frame)
{
    if (frame->cob_id == DEMAND_ID && frame->length == DEMAND_LENGTH) {
        if (check_protection(&ecu->demand, frame)) {
            ecu->is_enabled = frame->data[1] & 0x08;
            ecu->target = read_signed(frame->data, 2, 4, 24) / 1e6;
        }
        update_state(ecu);
    } else if (frame->cob_id == FEEDBACK_ID && frame->length == FEEDBACK_LENGTH) {
        if (check_protection(&ecu->feedback, frame))
            ecu->position = read_signed(frame->data, 1, 4, 28) / 1e8;
        update_state(ecu);
        ecu->idle_due_ns = frame->t_ns + ecu->timeout_ns;
        send_drive(ecu);
    }
}

/* Frames stopped: with the current on a fault, otherwise the rig has only ended its test. */
static void watch_reception(struct ecu *ecu, struct reception *reception, int64_t t_ns)
{
    if (!reception->is_heard || t_ns - reception->t_ns <= ecu->timeout_ns)
        return;
    memset(reception, 0, sizeof *reception);
    if (ecu->state == ECU_OPERATIONAL || ecu->state == ECU_SYNCHRONISING)
        ecu->state = ecu->state == ECU_OPERATIONAL && ecu->is_enabled ? ECU_FAULT : ECU_INIT;
}

void ecu_tick(struct ecu *ecu, int64_t t_ns)
{
    watch_reception(ecu, &ecu->demand, t_ns);
    watch_reception(ecu, &ecu->feedback, t_ns);
    if (t_ns >= ecu->idle_due_ns) {
        send_drive(ecu);
        ecu->idle_due_ns = t_ns + IDLE_PERIOD_NS;
    }
}
