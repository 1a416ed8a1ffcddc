/* A CANopen slave (CiA 301): the protocol services around one object dictionary, driven by frames and ticks alone.
 *
 * It never sees a bus or a clock: `device_receive` and `device_tick` are the ways in, `output` is the way out. It
 * allocates nothing; the caller owns the structure and the table of objects.
 */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>
#include <stdint.h>

#include "dictionary.h"
#include "emcy.h"
#include "frame.h"
#include "heartbeat.h"
#include "nmt.h"
#include "pdo.h"
#include "sdo.h"
#include "sync.h"

/* What the application does at the events of the device. A hook that is NULL is not called. */
struct hooks {
    void *context;
    /* OPERATIONAL: synchronous RPDOs are in the dictionary, synchronous TPDOs are not yet packed. */
    void (*on_sync)(void *context);
    /* An asynchronous RPDO arrived and is in the dictionary. */
    void (*on_rpdo)(void *context, uint16_t number);
    /* An SDO download is about to be stored; an abort code refuses it. */
    uint32_t (*on_write)(void *context, uint16_t index, uint8_t sub, const uint8_t *data, uint32_t length);
    /* The NMT state has changed. */
    void (*on_nmt)(void *context, enum nmt_state old, enum nmt_state new);
    /* SYNC has stopped (0x1006); EMCY 0x8100 is already sent. */
    void (*on_sync_lost)(void *context);
    /* The heartbeat of a watched node stopped; EMCY and 0x1029 are already handled. */
    void (*on_heartbeat_lost)(void *context, uint8_t node);
};

struct device {
    uint8_t node_id;
    enum nmt_state state;
    int64_t t_ns; /* of the last frame or tick */
    struct dictionary od;
    struct output output;
    struct hooks hooks;
    struct emcy emcy;
    struct heartbeat_producer producer;
    struct heartbeat_consumer consumer;
    struct sync_consumer sync;
    struct sdo_server sdo;
    struct pdos pdos;
    uint8_t number[8]; /* bytes of the last number that was uploaded */
};

/* Put a device together; its values become the initial ones, those that depend on the node-ID included. It boots at its first tick. `buffer` takes downloads in
 * segments. False if the object dictionary is inconsistent. */
bool device_init(struct device *device, uint8_t node_id, struct dictionary od, struct output output,
                 struct hooks hooks, uint8_t *buffer, uint32_t capacity);

/* A frame of another node arrived. */
void device_receive(struct device *device, const struct frame *frame);

/* It is now `t_ns`; call about every millisecond. */
void device_tick(struct device *device, int64_t t_ns);

/* Send a TPDO because the application has new values; nothing is sent unless OPERATIONAL. */
void device_transmit(struct device *device, uint16_t number);

/* Pass a changed communication object to the service that uses it. */
void device_configure(struct device *device, uint16_t index);

#endif
