#include "options.h"

#include <stddef.h>
#include <string.h>

bool read_options(int count, char **words, const char **bus, const struct option *options)
{
    if (count < 2 || count % 2 != 0) /* program and bus, then pairs */
        return false;
    *bus = words[1];
    for (int i = 2; i < count; i += 2) {
        const struct option *option = options;
        while (option->name != NULL && strcmp(option->name, words[i]) != 0)
            option++;
        if (option->name == NULL)
            return false;
        *option->value = words[i + 1];
    }
    return true;
}
