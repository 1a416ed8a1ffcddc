/* EMCY producer (CiA 301, 7.2.7): emergency frames, error register 0x1001 and error history 0x1003. */
#ifndef EMCY_H
#define EMCY_H

#include <stdbool.h>
#include <stdint.h>

#include "dictionary.h"
#include "frame.h"

enum emcy_code {
    EMCY_RESET = 0x0000,
    EMCY_COMMUNICATION = 0x8100, /* SYNC stopped */
    EMCY_HEARTBEAT_LOST = 0x8130,
    EMCY_PDO_TOO_SHORT = 0x8210,
    EMCY_PDO_TOO_LONG = 0x8220,
    EMCY_SYNC_LENGTH = 0x8240,
    EMCY_RPDO_TIMEOUT = 0x8250
};

enum error_register { ERROR_GENERIC = 0x01, ERROR_COMMUNICATION = 0x10 };

enum { EMCY_ERRORS_MAX = 16 }; /* more than this stack and the application can raise together */

/* An error in force. Its code and its first information byte (which PDO, which node) identify it. */
struct emcy_error {
    uint16_t code;
    int16_t detail; /* first information byte, -1: none */
    uint8_t bits;   /* of the error register */
};

struct emcy {
    struct dictionary *od;
    struct output output;
    bool is_permitted; /* whether the NMT state lets EMCY through; register and history are kept in any state */
    struct emcy_error errors[EMCY_ERRORS_MAX];
    uint8_t count;
};

enum { EMCY_ANY_DETAIL = -1 };

/* Forget all errors silently, as at power-on. */
void emcy_reset(struct emcy *emcy);

/* An error came, with `length` bytes (up to 5) of information. Repeats of an error in force send nothing. */
void emcy_raise(struct emcy *emcy, uint16_t code, uint8_t bits, const uint8_t *info, uint8_t length);

/* The errors of that code (and first information byte, or EMCY_ANY_DETAIL) are gone; says so if there were any. */
void emcy_clear(struct emcy *emcy, uint16_t code, int16_t detail);

/* Every error is gone; says so if there were any. */
void emcy_clear_all(struct emcy *emcy);

/* The master wrote 0 to 0x1003 sub 0. */
void emcy_erase_history(struct emcy *emcy);

#endif
