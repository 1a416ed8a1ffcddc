#include "cob_id.h"

#include <stddef.h>

#include "dictionary.h"

static const uint64_t UNUSED = 0x3FFFF800; /* bit 29 asks for a 29-bit identifier, whose bits follow */

bool cob_id_is_restricted(uint64_t can_id)
{
    static const struct {
        uint16_t first, last;
    } ranges[] = {{0x000, 0x07F}, {0x101, 0x180}, {0x581, 0x5FF}, {0x601, 0x67F}, {0x6E0, 0x6FF}, {0x701, 0x7FF}};
    for (size_t i = 0; i < sizeof ranges / sizeof ranges[0]; i++)
        if (can_id >= ranges[i].first && can_id <= ranges[i].last)
            return true;
    return false;
}

uint32_t cob_id_check_switchable(uint64_t old, uint64_t new)
{
    if (new & UNUSED)
        return ABORT_VALUE;
    if (new & COB_ID_INVALID)
        return ABORT_NONE;
    if (cob_id_is_restricted(new & 0x7FF))
        return ABORT_VALUE;
    return !(old & COB_ID_INVALID) && (old ^ new) & 0x7FF ? ABORT_STATE : ABORT_NONE;
}

uint32_t cob_id_check_sync(uint64_t new)
{
    return new & (UNUSED | COB_ID_PRODUCER) || cob_id_is_restricted(new & 0x7FF) ? ABORT_VALUE : ABORT_NONE;
}
