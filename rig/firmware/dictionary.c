#include "dictionary.h"

static int compare_keys(const struct object *object, uint16_t index, uint8_t sub)
{
    uint32_t key = (uint32_t)object->index << 8 | object->sub;
    uint32_t wanted = (uint32_t)index << 8 | sub;
    return (key > wanted) - (key < wanted);
}

size_t dictionary_find(const struct dictionary *od, uint16_t index, uint8_t sub)
{
    size_t first = 0, end = od->count;
    while (first < end) {
        size_t middle = first + (end - first) / 2;
        int order = compare_keys(&od->objects[middle], index, sub);
        if (order == 0)
            return middle;
        if (order < 0)
            first = middle + 1;
        else
            end = middle;
    }
    return NO_OBJECT;
}

uint32_t dictionary_explain_absence(const struct dictionary *od, uint16_t index)
{
    for (size_t i = 0; i < od->count; i++)
        if (od->objects[i].index == index)
            return ABORT_NO_SUBINDEX;
    return ABORT_NO_OBJECT;
}

uint64_t dictionary_read(const struct dictionary *od, uint16_t index, uint8_t sub, uint64_t absent)
{
    size_t position = dictionary_find(od, index, sub);
    return position == NO_OBJECT ? absent : od->values[position];
}

void dictionary_write(struct dictionary *od, uint16_t index, uint8_t sub, uint64_t value)
{
    size_t position = dictionary_find(od, index, sub);
    if (position != NO_OBJECT)
        od->values[position] = value;
}

uint8_t dictionary_last_sub(const struct dictionary *od, uint16_t index)
{
    uint8_t last = 0;
    for (size_t i = 0; i < od->count; i++)
        if (od->objects[i].index == index)
            last = od->objects[i].sub;
    return last;
}

void dictionary_restore(struct dictionary *od, uint16_t first, uint16_t last)
{
    for (size_t i = 0; i < od->count; i++)
        if (od->objects[i].index >= first && od->objects[i].index <= last)
            od->values[i] = od->objects[i].initial + (od->objects[i].flags & NODE_RELATIVE ? od->node_id : 0);
}

uint32_t dictionary_check_range(const struct object *object, uint64_t value)
{
    if (object->kind != KIND_UNSIGNED && object->kind != KIND_SIGNED)
        return ABORT_NONE;
    unsigned unused = 64u - 8u * object->size;
    int64_t number = (int64_t)value;
    if (object->kind == KIND_SIGNED && unused > 0 && value >> (63 - unused)) /* extend the sign */
        number = (int64_t)(value | UINT64_MAX << (64 - unused));
    if (object->flags & HAS_HIGH_LIMIT && number > object->high)
        return ABORT_TOO_HIGH;
    if (object->flags & HAS_LOW_LIMIT && number < object->low)
        return ABORT_TOO_LOW;
    return ABORT_NONE;
}
