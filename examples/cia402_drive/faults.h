/* Faults of a drive, to see that a test finds them. They change frames around a sound drive. */
#ifndef FAULTS_H
#define FAULTS_H

#include <stdbool.h>

#include "drive.h"

/* Choose a fault: none, wrong_sign, wrong_scaling (twice the current), ignores_enable (current whatever the control word
 * says), stops_sending (no TPDO1 after the thousandth), stuck_status (always OPERATION ENABLED). False if there is none
 * of that name. */
bool faults_select(const char *name);

/* Pass a frame to the drive as the fault lets it hear it. */
void faults_receive(struct drive *drive, const struct frame *frame);

/* Where the drive sends: the bus, with frames as the fault makes them. Its context is the drive. */
void faults_send(void *drive, uint32_t cob_id, const uint8_t *data, uint8_t length);

#endif
