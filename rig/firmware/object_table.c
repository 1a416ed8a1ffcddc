/* Generated, see object_table.h. */
#include "object_table.h"

const struct object OBJECT_TABLE[OBJECT_COUNT] = {
    /* Device type */
    {0x1000, 0x00, KIND_UNSIGNED, 4, READABLE, 0x198u, 0, 0, NULL, 0},
    /* Error register */
    {0x1001, 0x00, KIND_UNSIGNED, 1, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Number of errors */
    {0x1003, 0x00, KIND_UNSIGNED, 1, READABLE | WRITABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 1 */
    {0x1003, 0x01, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 2 */
    {0x1003, 0x02, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 3 */
    {0x1003, 0x03, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 4 */
    {0x1003, 0x04, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 5 */
    {0x1003, 0x05, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 6 */
    {0x1003, 0x06, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 7 */
    {0x1003, 0x07, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Standard error field 8 */
    {0x1003, 0x08, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* COB-ID SYNC message */
    {0x1005, 0x00, KIND_UNSIGNED, 4, READABLE, 0x80u, 0, 0, NULL, 0},
    /* Communication cycle period */
    {0x1006, 0x00, KIND_UNSIGNED, 4, READABLE | WRITABLE, 0x3E8u, 0, 0, NULL, 0},
    /* Manufacturer device name */
    {0x1008, 0x00, KIND_TEXT, 0, READABLE, 0, 0, 0, "EHA controller", 14},
    /* Manufacturer hardware version */
    {0x1009, 0x00, KIND_TEXT, 0, READABLE, 0, 0, 0, "emulated", 8},
    /* Manufacturer software version */
    {0x100A, 0x00, KIND_TEXT, 0, READABLE, 0, 0, 0, "1", 1},
    /* COB-ID EMCY */
    {0x1014, 0x00, KIND_UNSIGNED, 4, READABLE | NODE_RELATIVE, 0x80u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1016, 0x00, KIND_UNSIGNED, 1, READABLE, 0x1u, 0, 0, NULL, 0},
    /* Consumer heartbeat time 1 */
    {0x1016, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE, 0x100FAu, 0, 0, NULL, 0},
    /* Producer heartbeat time */
    {0x1017, 0x00, KIND_UNSIGNED, 2, READABLE | WRITABLE, 0x64u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1018, 0x00, KIND_UNSIGNED, 1, READABLE, 0x4u, 0, 0, NULL, 0},
    /* Vendor-ID */
    {0x1018, 0x01, KIND_UNSIGNED, 4, READABLE, 0xFFFFFFFFu, 0, 0, NULL, 0},
    /* Product code */
    {0x1018, 0x02, KIND_UNSIGNED, 4, READABLE, 0x2u, 0, 0, NULL, 0},
    /* Revision number */
    {0x1018, 0x03, KIND_UNSIGNED, 4, READABLE, 0x10000u, 0, 0, NULL, 0},
    /* Serial number */
    {0x1018, 0x04, KIND_UNSIGNED, 4, READABLE, 0x0u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1029, 0x00, KIND_UNSIGNED, 1, READABLE, 0x1u, 0, 0, NULL, 0},
    /* Communication error */
    {0x1029, 0x01, KIND_UNSIGNED, 1, READABLE | WRITABLE | HAS_LOW_LIMIT | HAS_HIGH_LIMIT, 0x0u, 0, 2, NULL, 0},
    /* Highest sub-index supported */
    {0x1200, 0x00, KIND_UNSIGNED, 1, READABLE, 0x2u, 0, 0, NULL, 0},
    /* COB-ID client to server (rx) */
    {0x1200, 0x01, KIND_UNSIGNED, 4, READABLE | NODE_RELATIVE, 0x600u, 0, 0, NULL, 0},
    /* COB-ID server to client (tx) */
    {0x1200, 0x02, KIND_UNSIGNED, 4, READABLE | NODE_RELATIVE, 0x580u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1400, 0x00, KIND_UNSIGNED, 1, READABLE, 0x2u, 0, 0, NULL, 0},
    /* COB-ID used by PDO */
    {0x1400, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE, 0x202u, 0, 0, NULL, 0},
    /* Transmission type */
    {0x1400, 0x02, KIND_UNSIGNED, 1, READABLE | WRITABLE, 0x1u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1401, 0x00, KIND_UNSIGNED, 1, READABLE, 0x2u, 0, 0, NULL, 0},
    /* COB-ID used by PDO */
    {0x1401, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE, 0x183u, 0, 0, NULL, 0},
    /* Transmission type */
    {0x1401, 0x02, KIND_UNSIGNED, 1, READABLE | WRITABLE, 0xFFu, 0, 0, NULL, 0},
    /* Number of mapped objects */
    {0x1600, 0x00, KIND_UNSIGNED, 1, READABLE, 0x3u, 0, 0, NULL, 0},
    /* Mapped object 1 */
    {0x1600, 0x01, KIND_UNSIGNED, 4, READABLE, 0x21000020u, 0, 0, NULL, 0},
    /* Mapped object 2 */
    {0x1600, 0x02, KIND_UNSIGNED, 4, READABLE, 0x60400010u, 0, 0, NULL, 0},
    /* Mapped object 3 */
    {0x1600, 0x03, KIND_UNSIGNED, 4, READABLE, 0x21010010u, 0, 0, NULL, 0},
    /* Number of mapped objects */
    {0x1601, 0x00, KIND_UNSIGNED, 1, READABLE, 0x2u, 0, 0, NULL, 0},
    /* Mapped object 1 */
    {0x1601, 0x01, KIND_UNSIGNED, 4, READABLE, 0x21020020u, 0, 0, NULL, 0},
    /* Mapped object 2 */
    {0x1601, 0x02, KIND_UNSIGNED, 4, READABLE, 0x21030020u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x1800, 0x00, KIND_UNSIGNED, 1, READABLE, 0x2u, 0, 0, NULL, 0},
    /* COB-ID used by PDO */
    {0x1800, 0x01, KIND_UNSIGNED, 4, READABLE | WRITABLE | NODE_RELATIVE, 0x180u, 0, 0, NULL, 0},
    /* Transmission type */
    {0x1800, 0x02, KIND_UNSIGNED, 1, READABLE | WRITABLE, 0xFFu, 0, 0, NULL, 0},
    /* Number of mapped objects */
    {0x1A00, 0x00, KIND_UNSIGNED, 1, READABLE, 0x3u, 0, 0, NULL, 0},
    /* Mapped object 1 */
    {0x1A00, 0x01, KIND_UNSIGNED, 4, READABLE, 0x21040020u, 0, 0, NULL, 0},
    /* Mapped object 2 */
    {0x1A00, 0x02, KIND_UNSIGNED, 4, READABLE, 0x60410010u, 0, 0, NULL, 0},
    /* Mapped object 3 */
    {0x1A00, 0x03, KIND_UNSIGNED, 4, READABLE, 0x21050010u, 0, 0, NULL, 0},
    /* Position demand */
    {0x2100, 0x00, KIND_SIGNED, 4, READABLE | WRITABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Cycle of the command */
    {0x2101, 0x00, KIND_UNSIGNED, 2, READABLE | WRITABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Ram position XJ */
    {0x2102, 0x00, KIND_SIGNED, 4, READABLE | WRITABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Load pressure P12 */
    {0x2103, 0x00, KIND_SIGNED, 4, READABLE | WRITABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Current demand Cor */
    {0x2104, 0x00, KIND_SIGNED, 4, READABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Cycle answered */
    {0x2105, 0x00, KIND_UNSIGNED, 2, READABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Highest sub-index supported */
    {0x2110, 0x00, KIND_UNSIGNED, 1, READABLE, 0x5u, 0, 0, NULL, 0},
    /* Proportional gain */
    {0x2110, 0x01, KIND_REAL, 8, READABLE | WRITABLE, 0x400E666666666666ull, 0, 0, NULL, 0},
    /* Integral gain */
    {0x2110, 0x02, KIND_REAL, 8, READABLE | WRITABLE, 0x0ull, 0, 0, NULL, 0},
    /* Derivative gain */
    {0x2110, 0x03, KIND_REAL, 8, READABLE | WRITABLE, 0x0ull, 0, 0, NULL, 0},
    /* Current limit */
    {0x2110, 0x04, KIND_REAL, 8, READABLE | WRITABLE, 0x3F80624DD2F1A9FCull, 0, 0, NULL, 0},
    /* Period */
    {0x2110, 0x05, KIND_REAL, 8, READABLE | WRITABLE, 0x3F50624DD2F1A9FCull, 0, 0, NULL, 0},
    /* Control word */
    {0x6040, 0x00, KIND_UNSIGNED, 2, READABLE | WRITABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
    /* Status word */
    {0x6041, 0x00, KIND_UNSIGNED, 2, READABLE | MAPPABLE, 0x0u, 0, 0, NULL, 0},
};
