/* The command line of a node: PROGRAM BUS [--option VALUE]... */
#ifndef OPTIONS_H
#define OPTIONS_H

#include <stdbool.h>

struct option {
    const char *name;   /* "--node"; NULL ends the list */
    const char **value; /* keeps its default if the option is not given */
};

/* Read the bus and the options. False if the line is another one. */
bool read_options(int count, char **words, const char **bus, const struct option *options);

#endif
