#include "device.h"

#include <string.h>

#include "bytes.h"
#include "cob_id.h"

enum { HISTORY = 0x1003, SYNC_COB_ID = 0x1005, SYNC_PERIOD = 0x1006, EMCY_COB_ID = 0x1014, CONSUMER = 0x1016,
       PRODUCER = 0x1017, ERROR_BEHAVIOUR = 0x1029 };

static void enter(struct device *device, enum nmt_state new)
{
    enum nmt_state old = device->state;
    if (new == old)
        return;
    device->state = new;
    device->emcy.is_permitted = nmt_is_communicating(new);
    if (new != NMT_OPERATIONAL) {
        pdos_forget(&device->pdos);
        sync_stop(&device->sync);
    }
    if (!nmt_is_communicating(new))
        sdo_reset(&device->sdo);
    if (device->hooks.on_nmt != NULL)
        device->hooks.on_nmt(device->hooks.context, old, new);
}

static void configure_consumer(struct device *device)
{
    uint64_t entries[WATCHED_NODES_MAX] = {0};
    for (uint8_t i = 0; i < WATCHED_NODES_MAX; i++)
        entries[i] = dictionary_read(&device->od, CONSUMER, i + 1, 0);
    heartbeat_watch(&device->consumer, entries, WATCHED_NODES_MAX);
}

void device_configure(struct device *device, uint16_t index)
{
    if (index == SYNC_PERIOD)
        sync_configure(&device->sync, dictionary_read(&device->od, SYNC_PERIOD, 0, 0));
    else if (index == CONSUMER)
        configure_consumer(device);
    else if (index == PRODUCER)
        heartbeat_configure(&device->producer, dictionary_read(&device->od, PRODUCER, 0, 0), device->t_ns);
    else if ((index >= RPDO && index < RPDO + 0x200) || (index >= TPDO && index < TPDO + 0x200))
        pdos_configure(&device->pdos);
}

static void boot(struct device *device)
{
    device_configure(device, SYNC_PERIOD);
    device_configure(device, CONSUMER);
    pdos_configure(&device->pdos);
    heartbeat_send_boot_up(&device->producer);
    enter(device, NMT_PRE_OPERATIONAL);
    device_configure(device, PRODUCER);
}

/* Reset node (all objects) or reset communication (0x1000..0x1FFF): initial values, then boot-up. */
static void restart(struct device *device, bool is_whole_node)
{
    enter(device, NMT_INITIALISING);
    dictionary_restore(&device->od, 0x1000, is_whole_node ? 0xFFFF : 0x1FFF);
    emcy_reset(&device->emcy);
    heartbeat_watch(&device->consumer, NULL, 0);
    boot(device);
}

static void handle_command(struct device *device, enum nmt_command command)
{
    if (command == NMT_RESET_NODE || command == NMT_RESET_COMMUNICATION)
        restart(device, command == NMT_RESET_NODE);
    else if (command != NMT_NO_COMMAND)
        enter(device, nmt_target(command));
}

static void run_cycle(struct device *device)
{
    pdos_latch(&device->pdos);
    if (device->hooks.on_sync != NULL)
        device->hooks.on_sync(device->hooks.context);
    if (device->state == NMT_OPERATIONAL) /* the application may have given up just now */
        pdos_send_synchronous(&device->pdos);
}

static void handle_rpdo(struct device *device, struct rpdo *rpdo, const struct frame *frame)
{
    if (rpdo_receive(&device->pdos, rpdo, frame) && device->hooks.on_rpdo != NULL)
        device->hooks.on_rpdo(device->hooks.context, rpdo->number);
}

static void handle_heartbeat(struct device *device, const struct frame *frame)
{
    if (heartbeat_receive(&device->consumer, frame))
        emcy_clear(&device->emcy, EMCY_HEARTBEAT_LOST, (int16_t)(frame->cob_id - HEARTBEAT_COB_ID));
}

static void report_lost_heartbeat(struct device *device, uint8_t node)
{
    emcy_raise(&device->emcy, EMCY_HEARTBEAT_LOST, ERROR_COMMUNICATION, &node, 1);
    enter(device, nmt_state_after_error(device->state, dictionary_read(&device->od, ERROR_BEHAVIOUR, 1, 0)));
    if (device->hooks.on_heartbeat_lost != NULL)
        device->hooks.on_heartbeat_lost(device->hooks.context, node);
}

/* What a frame may do depends on the NMT state (CiA 301, table 39). */
void device_receive(struct device *device, const struct frame *frame)
{
    if (device->state == NMT_INITIALISING)
        return;
    const int64_t before_ns = device->t_ns;
    device->t_ns = frame->t_ns;
    if (device->state == NMT_OPERATIONAL) {
        struct rpdo *rpdo = pdos_find_rpdo(&device->pdos, frame->cob_id);
        if (rpdo != NULL) {
            handle_rpdo(device, rpdo, frame);
            return;
        }
        if (frame->cob_id == (dictionary_read(&device->od, SYNC_COB_ID, 0, 0x80) & 0x7FF)) {
            if (sync_receive(&device->sync, frame))
                run_cycle(device);
            return;
        }
    }
    if (nmt_is_communicating(device->state) && frame->cob_id == 0x600u + device->node_id)
        sdo_receive(&device->sdo, frame);
    else if (heartbeat_is_watched(&device->consumer, frame->cob_id))
        handle_heartbeat(device, frame);
    else if (frame->cob_id == 0)
        handle_command(device, nmt_read_command(frame, device->node_id));
    else
        device->t_ns = before_ns; /* not for us */
}

void device_tick(struct device *device, int64_t t_ns)
{
    device->t_ns = t_ns;
    if (device->state == NMT_INITIALISING)
        boot(device);
    heartbeat_tick(&device->producer, t_ns, device->state);
    for (uint8_t node = heartbeat_find_lost(&device->consumer, t_ns); node != 0;
         node = heartbeat_find_lost(&device->consumer, t_ns))
        report_lost_heartbeat(device, node);
    if (sync_tick(&device->sync, t_ns) && device->hooks.on_sync_lost != NULL)
        device->hooks.on_sync_lost(device->hooks.context);
    sdo_tick(&device->sdo, t_ns);
}

void device_transmit(struct device *device, uint16_t number)
{
    if (device->state == NMT_OPERATIONAL)
        pdos_transmit(&device->pdos, number);
}

/* The following three are how the SDO server reaches the objects. */

static uint32_t find_object(struct device *device, uint16_t index, uint8_t sub, uint8_t access, size_t *position)
{
    *position = dictionary_find(&device->od, index, sub);
    if (*position == NO_OBJECT)
        return dictionary_explain_absence(&device->od, index);
    if (device->od.objects[*position].flags & access)
        return ABORT_NONE;
    return access == READABLE ? ABORT_WRITE_ONLY : ABORT_READ_ONLY;
}

static uint32_t upload(void *context, uint16_t index, uint8_t sub, const uint8_t **data, uint32_t *length)
{
    struct device *device = context;
    size_t position;
    uint32_t code = find_object(device, index, sub, READABLE, &position);
    bool is_empty_history = index == HISTORY && sub > dictionary_read(&device->od, HISTORY, 0, 0);
    if (is_empty_history && position != NO_OBJECT)
        return ABORT_NO_DATA;
    if (code != ABORT_NONE)
        return code;
    const struct object *object = &device->od.objects[position];
    if (object->size > 0) {
        write_bytes(device->number, device->od.values[position], object->size);
        *data = device->number;
        *length = object->size;
    } else {
        *data = (const uint8_t *)object->text;
        *length = object->text_length;
    }
    return ABORT_NONE;
}

static uint32_t find_size(void *context, uint16_t index, uint8_t sub, uint32_t *size)
{
    struct device *device = context;
    size_t position;
    uint32_t code = find_object(device, index, sub, WRITABLE, &position);
    if (code == ABORT_NONE)
        *size = device->od.objects[position].size;
    return code;
}

/* Abort code of a new value of a communication object that CiA 301 forbids. */
static uint32_t check_communication(const struct device *device, uint16_t index, uint8_t sub, uint64_t value)
{
    uint64_t others[WATCHED_NODES_MAX];
    uint8_t count = 0;
    switch (index) {
    case SYNC_COB_ID:
        return cob_id_check_sync(value);
    case EMCY_COB_ID:
        return cob_id_check_switchable(dictionary_read(&device->od, EMCY_COB_ID, 0, 0), value);
    case CONSUMER:
        for (uint8_t other = 1; other <= WATCHED_NODES_MAX; other++)
            if (other != sub)
                others[count++] = dictionary_read(&device->od, CONSUMER, other, 0);
        return heartbeat_check_entry(value, others, count);
    default:
        return pdos_check(&device->pdos, index, sub, value);
    }
}

static uint32_t check_number(const struct device *device, size_t position, const uint8_t *data, uint32_t length)
{
    const struct object *object = &device->od.objects[position];
    if (length != object->size)
        return length > object->size ? ABORT_TOO_LONG : ABORT_TOO_SHORT;
    const uint64_t value = read_bytes(data, object->size);
    uint32_t code = dictionary_check_range(object, value);
    return code != ABORT_NONE ? code : check_communication(device, object->index, object->sub, value);
}

static uint32_t download(void *context, uint16_t index, uint8_t sub, const uint8_t *data, uint32_t length)
{
    struct device *device = context;
    size_t position;
    uint32_t code = find_object(device, index, sub, WRITABLE, &position);
    if (code != ABORT_NONE)
        return code;
    const bool is_number = device->od.objects[position].size > 0;
    if (is_number && (code = check_number(device, position, data, length)) != ABORT_NONE)
        return code;
    if (index == HISTORY) {
        if (read_bytes(data, 1) != 0)
            return ABORT_VALUE;
        emcy_erase_history(&device->emcy);
        return ABORT_NONE;
    }
    if (device->hooks.on_write != NULL)
        code = device->hooks.on_write(device->hooks.context, index, sub, data, length);
    if (code != ABORT_NONE || !is_number)
        return code;
    device->od.values[position] = read_bytes(data, (uint8_t)length);
    device_configure(device, index);
    return ABORT_NONE;
}

bool device_init(struct device *device, uint8_t node_id, struct dictionary od, struct output output,
                 struct hooks hooks, uint8_t *buffer, uint32_t capacity)
{
    memset(device, 0, sizeof *device);
    device->node_id = node_id;
    device->state = NMT_INITIALISING;
    device->od = od;
    device->od.node_id = node_id;
    device->output = output;
    device->hooks = hooks;
    dictionary_restore(&device->od, 0x1000, 0xFFFF);
    device->emcy.od = &device->od;
    device->emcy.output = output;
    device->producer.output = output;
    device->producer.node_id = node_id;
    device->sync.emcy = &device->emcy;
    device->sdo.output = output;
    device->sdo.cob_id = 0x580 + node_id;
    device->sdo.objects = (struct sdo_objects){device, upload, find_size, download};
    device->sdo.buffer = buffer;
    device->sdo.capacity = capacity;
    sdo_reset(&device->sdo);
    device->pdos.od = &device->od;
    device->pdos.emcy = &device->emcy;
    device->pdos.output = output;
    return pdos_init(&device->pdos);
}
