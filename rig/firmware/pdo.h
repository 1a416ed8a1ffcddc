/* PDOs (CiA 301, 7.2.2). The mapping is fixed; COB-ID and transmission type may be changed by SDO. */
#ifndef PDO_H
#define PDO_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "dictionary.h"
#include "emcy.h"
#include "frame.h"

enum { RPDO = 0x1400, TPDO = 0x1800 }; /* communication parameters; the mapping is 0x200 further on */
enum { PDOS_MAX = 4, MAPPED_MAX = 8 };

/* What lies in a PDO, in order. */
struct mapping {
    size_t positions[MAPPED_MAX]; /* in the object dictionary */
    uint8_t sizes[MAPPED_MAX];    /* bytes */
    uint8_t count;
    uint8_t length; /* bytes of the whole PDO */
};

struct rpdo {
    uint16_t number; /* from 1 */
    struct mapping mapping;
    bool is_valid; /* bit 31 of the COB-ID is clear */
    uint16_t cob_id;
    bool is_synchronous;
    bool is_waiting; /* for SYNC */
    bool is_fresh;   /* synchronous: a new frame was latched at this SYNC */
    bool is_faulty;  /* the last frame had a wrong length */
    uint8_t waiting[8];
};

struct tpdo {
    uint16_t number;
    struct mapping mapping;
    bool is_valid;
    uint16_t cob_id;
    uint8_t type;
    uint8_t countdown; /* SYNCs until a cyclic PDO is due */
    bool is_requested;
};

struct pdos {
    struct dictionary *od;
    struct emcy *emcy;
    struct output output;
    struct rpdo rpdos[PDOS_MAX];
    struct tpdo tpdos[PDOS_MAX];
    uint8_t rpdo_count, tpdo_count;
};

/* Read mapping and communication parameters. False if the dictionary maps what is not there, not mappable, of another
 * length, or beyond 8 bytes, or lets a master change the mapping. */
bool pdos_init(struct pdos *pdos);

/* Read the communication parameters again. */
void pdos_configure(struct pdos *pdos);

/* The device left OPERATIONAL: drop what waits for a SYNC. */
void pdos_forget(struct pdos *pdos);

/* The RPDO with that COB-ID, NULL if there is none. */
struct rpdo *pdos_find_rpdo(struct pdos *pdos, uint32_t cob_id);

/* A frame for an RPDO came. True if its values are in the dictionary: the RPDO is asynchronous. */
bool rpdo_receive(struct pdos *pdos, struct rpdo *rpdo, const struct frame *frame);

/* SYNC: the values that came last become valid. */
void pdos_latch(struct pdos *pdos);

/* SYNC: send the synchronous TPDOs that are due. */
void pdos_send_synchronous(struct pdos *pdos);

/* The application asks for a TPDO. A cyclic synchronous PDO keeps to its SYNCs. */
void pdos_transmit(struct pdos *pdos, uint16_t number);

/* Abort code of a new value of a communication parameter. */
uint32_t pdos_check(const struct pdos *pdos, uint16_t index, uint8_t sub, uint64_t value);

#endif
