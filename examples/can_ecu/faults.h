/* Faults of an ECU, to see that a test finds them. They change frames around a sound ECU. */
#ifndef FAULTS_H
#define FAULTS_H

#include <stdbool.h>

#include "ecu.h"

/* Choose a fault: none, wrong_sign, wrong_scaling (twice the current), ignores_enable (current whatever Enable says),
 * stops_sending, wrong_counter (it stands still), both after 1000 frames in state OPERATIONAL. False if there is none of
 * that name. */
bool faults_select(const char *name);

/* Pass a frame to the ECU as the fault lets it hear it. */
void faults_receive(struct ecu *ecu, const struct frame *frame);

/* Where the ECU sends: the bus, with frames as the fault makes them. Its context is the ECU. */
void faults_send(void *ecu, uint32_t identifier, const uint8_t *data, uint8_t length);

#endif
