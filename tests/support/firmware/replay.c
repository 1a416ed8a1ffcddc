/* Feeds a script to the controller and writes what it sends: the way to run it under the address sanitizer.
 *
 * Records of 19 bytes on standard input and output: time INT64 ns, COB-ID UNSIGNED16, length UNSIGNED8, data. COB-ID
 * 0xFFFF is a tick. Little endian.
 */
#include <stdio.h>
#include <string.h>

#include "bytes.h"
#include "controller.h"

enum { RECORD = 19, TICK = 0xFFFF };

static uint8_t record[RECORD];

static void write_record(void *context, uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    uint8_t sent[RECORD] = {0};
    (void)context;
    memcpy(sent, record, 8); /* the time of what it answers */
    write_bytes(sent + 8, cob_id, 2);
    sent[10] = length;
    memcpy(sent + 11, data, length);
    fwrite(sent, 1, RECORD, stdout);
}

int main(void)
{
    static struct controller controller;
    if (!controller_init(&controller, (struct output){write_record, NULL}))
        return 2;
    while (fread(record, 1, RECORD, stdin) == RECORD) {
        struct frame frame = {(int64_t)read_bytes(record, 8), (uint16_t)read_bytes(record + 8, 2), record[10], {0}};
        memcpy(frame.data, record + 11, 8);
        if (frame.cob_id == TICK)
            controller_tick(&controller, frame.t_ns);
        else
            controller_receive(&controller, &frame);
    }
    return 0;
}
