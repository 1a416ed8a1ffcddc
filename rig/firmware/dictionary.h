/* Object dictionary (CiA 301, 7.4): constant entries and, beside them, the values in use. */
#ifndef DICTIONARY_H
#define DICTIONARY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum object_kind {
    KIND_UNSIGNED, /* BOOLEAN and UNSIGNED8..64 */
    KIND_SIGNED,   /* INTEGER8..64 */
    KIND_REAL,     /* REAL32, REAL64 */
    KIND_TEXT,     /* VISIBLE_STRING, OCTET_STRING: constant */
    KIND_DOMAIN    /* the application takes what is written */
};

enum object_flag {
    READABLE = 1,
    WRITABLE = 2,
    MAPPABLE = 4,
    HAS_LOW_LIMIT = 8,
    HAS_HIGH_LIMIT = 16,
    NODE_RELATIVE = 32 /* the node-ID is added to the initial value ("$NODEID+0x180" of an EDS) */
};

/* One sub-index. The table is sorted by index and sub-index. */
struct object {
    uint16_t index;
    uint8_t sub;
    uint8_t kind;
    uint8_t size;     /* bytes of a number; 0: any length */
    uint8_t flags;    /* of enum object_flag */
    uint64_t initial; /* bits of the value after power-on */
    int64_t low, high;
    const char *text; /* of KIND_TEXT */
    uint32_t text_length;
};

struct dictionary {
    const struct object *objects;
    size_t count;
    uint64_t *values; /* bits of the numbers, zero-extended, in the order of `objects`; hot: PDOs use it directly */
    uint8_t node_id;
};

/* SDO abort codes (CiA 301, table 22), as far as this stack uses them; 0 is success. */
enum sdo_abort {
    ABORT_NONE = 0,
    ABORT_TOGGLE = 0x05030000,
    ABORT_TIMEOUT = 0x05040000,
    ABORT_COMMAND = 0x05040001,
    ABORT_MEMORY = 0x05040005,
    ABORT_WRITE_ONLY = 0x06010001,
    ABORT_READ_ONLY = 0x06010002,
    ABORT_NO_OBJECT = 0x06020000,
    ABORT_INCOMPATIBLE = 0x06040043,
    ABORT_TOO_LONG = 0x06070012,
    ABORT_TOO_SHORT = 0x06070013,
    ABORT_NO_SUBINDEX = 0x06090011,
    ABORT_VALUE = 0x06090030,
    ABORT_TOO_HIGH = 0x06090031,
    ABORT_TOO_LOW = 0x06090032,
    ABORT_STATE = 0x08000022,
    ABORT_NO_DATA = 0x08000024
};

#define NO_OBJECT SIZE_MAX /* position of an object that is not there */

/* Position of an object in the table, NO_OBJECT if there is none. */
size_t dictionary_find(const struct dictionary *od, uint16_t index, uint8_t sub);

/* Why an object that was not found cannot be accessed: no such sub-index, or no such object. */
uint32_t dictionary_explain_absence(const struct dictionary *od, uint16_t index);

/* An integer object's value, or `absent` where the device has no such object. */
uint64_t dictionary_read(const struct dictionary *od, uint16_t index, uint8_t sub, uint64_t absent);

/* Set an integer object's value; nothing happens where there is no such object. */
void dictionary_write(struct dictionary *od, uint16_t index, uint8_t sub, uint64_t value);

/* Highest sub-index of an object that is present, 0 for none. */
uint8_t dictionary_last_sub(const struct dictionary *od, uint16_t index);

/* Set the objects from index `first` to `last` to their initial values. */
void dictionary_restore(struct dictionary *od, uint16_t first, uint16_t last);

/* Check an SDO download of a number of the right length: abort code of a value out of range. */
uint32_t dictionary_check_range(const struct object *object, uint64_t value);

#endif
