/* COB-ID entries of the object dictionary: which identifiers may be used, and when an entry may be changed. */
#ifndef COB_ID_H
#define COB_ID_H

#include <stdbool.h>
#include <stdint.h>

#define COB_ID_INVALID (UINT32_C(1) << 31)  /* PDO and EMCY: switched off */
#define COB_ID_PRODUCER (UINT32_C(1) << 30) /* 0x1005: the node sends SYNC */

/* Whether no configurable object may use this identifier (CiA 301, 7.3.5, table 40). */
bool cob_id_is_restricted(uint64_t can_id);

/* Abort code of a new value of an entry with a valid bit: PDO (CiA 301, 7.5.2.35 and 7.5.2.37), EMCY (7.5.2.17).
 * The identifier of a valid entry is fixed: it is first made invalid, with whatever identifier, then changed. */
uint32_t cob_id_check_switchable(uint64_t old, uint64_t new);

/* Abort code of a new value of 0x1005 (CiA 301, 7.5.2.5); this device consumes SYNC and cannot produce it. */
uint32_t cob_id_check_sync(uint64_t new);

#endif
