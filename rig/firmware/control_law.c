#include "control_law.h"

static double clip(double x, double limit)
{
    x = x < limit ? x : limit;
    return x > -limit ? x : -limit;
}

double compute_current(struct control_law *law, double demand, double position, const struct gains *gains)
{
    const double error = demand - position;
    const double rate = law->has_previous ? (error - law->error) / gains->period : 0.0;
    const double integral = law->integral + gains->integral_gain * error * gains->period;
    const double wanted = gains->proportional_gain * error + integral + gains->derivative_gain * rate;
    const double current = clip(wanted, gains->current_limit);
    /* anti-windup: the integral part waits while the output is at its limit and the error would drive it further */
    const bool is_winding = current != wanted && wanted * error > 0.0;
    if (!is_winding)
        law->integral = integral;
    law->error = error;
    law->has_previous = true;
    return current;
}
