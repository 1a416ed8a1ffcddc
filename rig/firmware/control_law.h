/* Position law: PID on the sensed error with limited output and anti-windup. Numbers and units: docs/bus.md. */
#ifndef CONTROL_LAW_H
#define CONTROL_LAW_H

#include <stdbool.h>

/* Object 0x2110 sub 1..5. */
struct gains {
    double proportional_gain; /* A/m */
    double integral_gain;     /* A/(m s) */
    double derivative_gain;   /* A s/m */
    double current_limit;     /* A */
    double period;            /* s */
};

/* What the law remembers from cycle to cycle. All zero: the loop was just closed. */
struct control_law {
    double integral;   /* A, the integral part of the current */
    double error;      /* m, of the cycle before */
    bool has_previous; /* false in the first cycle, which has no derivative */
};

/* Current for the next cycle, A, from demand and sensed position, m. A positive current extends the ram.
 * The bits equal those of plant/pid.py, on any processor with IEEE 754 doubles, if the compiler does not fuse
 * multiply and add (-ffp-contract=off). */
double compute_current(struct control_law *law, double demand, double position, const struct gains *gains);

#endif
