/* The reference model in closed loop, in C: the yardstick for the compiled Python of plant/.
 *
 * Same scheme, same order of operations, each division once a cycle (plant/step.py, friction.py, controller.py, solve.py);
 * no effects. Built with -ffp-contract=off the results are equal bit for bit. With fused multiply-add, which gcc uses
 * otherwise, the rounding differs. */
#include <math.h>

typedef struct { /* as plant.parameters.GROUPS, in order */
    struct { double proportional_gain, integral_gain, derivative_gain, current_limit, period; } controller;
    struct { double gain; } torque_motor;
    struct { double inertia, damping, stiffness, travel; } flapper;
    struct { double stiffness; } feedback_spring;
    struct { double clogging, law; } filter;
    struct { double flow_gain, pressure_gain; } pilot;
    struct { double end_area, mass, damping, static_friction, dynamic_friction, travel; } spool;
    struct { double flow_gain, pressure_gain; } valve;
    struct { double pressure; } supply;
    struct { double area, mass, damping, static_friction, dynamic_friction, leakage, travel; } jack;
    struct { double position_noise, pressure_noise, spool_noise; } sensors;
} Model;

typedef struct { double xf, vf, xs, vs, xj, vj, p12; } State;
typedef struct { double integral, error; int cycles; } Loop;

typedef struct { /* constant over a cycle */
    double keep, push, pilot_gain, pilot_slope, pilot_limit, spool_free, spool_coupled, spool_push;
    double valve_gain, valve_slope, valve_limit, jack_free, jack_coupled;
} Coefficients;

static inline double clip(double x, double limit)
{
    x = x < limit ? x : limit;
    return x > -limit ? x : -limit;
}

static inline double soften(double x, double band) { return x - clip(x, band); }

static inline double slide(double v0, double impulse, double push, double line, double slope, double limit,
                           double dry, double free, double coupled)
{
    double v = soften(coupled * impulse + coupled * push * line, coupled * dry);
    double wanted = line - slope * v, held = clip(wanted, limit);
    if (held != wanted)
        v = soften(impulse + push * held, dry) * free;
    double low = v0 > 0.0 ? 0.0 : -INFINITY, high = v0 < 0.0 ? 0.0 : INFINITY;
    v = v > low ? v : low;
    return v < high ? v : high;
}

static inline void travel(double *x, double *v, double v1, double h, double limit)
{
    double wanted = (*x + 0.5 * h * *v) + 0.5 * h * v1;
    *x = clip(wanted, limit);
    *v = fabs(wanted) <= limit ? v1 : 0.0;
}

static Coefficients coefficients(const Model *p, double h)
{
    double left = 1.0 - p->filter.clogging;
    double gpf1 = p->pilot.pressure_gain * left;
    double slope1 = gpf1 * p->spool.end_area / (p->pilot.flow_gain * pow(left, p->filter.law));
    double gq = p->valve.flow_gain, gp = p->valve.pressure_gain;
    double leak = 1.0 / (1.0 + gp * p->jack.leakage / gq);
    double slope2 = gp * p->jack.area / gq * leak;
    double stiff = 1.0 / (p->flapper.inertia + 0.5 * h * p->flapper.damping + 0.25 * h * h * p->flapper.stiffness);
    double spool = p->spool.mass + h * p->spool.damping, jack = p->jack.mass + h * p->jack.damping;
    return (Coefficients){
        .keep = (p->flapper.inertia - 0.5 * h * p->flapper.damping - 0.25 * h * h * p->flapper.stiffness) * stiff,
        .push = h * stiff,
        .pilot_gain = gpf1,
        .pilot_slope = slope1,
        .pilot_limit = p->supply.pressure * left,
        .spool_free = 1.0 / spool,
        .spool_coupled = 1.0 / (spool + h * p->spool.end_area * slope1),
        .spool_push = h * p->spool.end_area,
        .valve_gain = gp * leak,
        .valve_slope = slope2,
        .valve_limit = p->supply.pressure,
        .jack_free = 1.0 / jack,
        .jack_coupled = 1.0 / (jack + h * p->jack.area * slope2),
    };
}

static inline State step(State s, double current, double load, const Model *restrict p, Coefficients k, double h)
{
    double torque = p->torque_motor.gain * current - p->flapper.stiffness * s.xf
                    - p->feedback_spring.stiffness * (s.xs + 0.5 * h * s.vs);
    travel(&s.xf, &s.vf, k.keep * s.vf + k.push * torque, h, p->flapper.travel);

    double dry = s.vs == 0.0 ? h * p->spool.static_friction : h * p->spool.dynamic_friction;
    double v = slide(s.vs, p->spool.mass * s.vs, k.spool_push, k.pilot_gain * s.xf, k.pilot_slope, k.pilot_limit,
                     dry, k.spool_free, k.spool_coupled);
    travel(&s.xs, &s.vs, v, h, p->spool.travel);

    double line = k.valve_gain * s.xs;
    dry = s.vj == 0.0 ? h * p->jack.static_friction : h * p->jack.dynamic_friction;
    v = slide(s.vj, p->jack.mass * s.vj - h * load, h * p->jack.area, line, k.valve_slope, k.valve_limit, dry,
              k.jack_free, k.jack_coupled);
    travel(&s.xj, &s.vj, v, h, p->jack.travel);
    s.p12 = clip(line - k.valve_slope * s.vj, k.valve_limit);
    return s;
}

static double answer(Loop *c, double demand, double position, const Model *p)
{
    double error = demand - position;
    double rate = c->cycles ? (error - c->error) / p->controller.period : 0.0;
    double integral = c->integral + p->controller.integral_gain * error * p->controller.period;
    double wanted = p->controller.proportional_gain * error + integral + p->controller.derivative_gain * rate;
    double current = clip(wanted, p->controller.current_limit);
    if (current == wanted || wanted * error <= 0.0)
        c->integral = integral;
    c->error = error;
    c->cycles = 1;
    return current;
}

/* So that the caller can see that both mean the same parameters. */
int model_bytes(void) { return sizeof(Model); }

/* `noise` (n, 4) standard normal numbers; `out` (n, 4): XJ, Cor, P12, XS as sensed. */
void closed_loop(const Model *restrict p, const double *restrict com, const double *restrict load,
                 const double (*restrict noise)[4], int n, int steps, double (*restrict out)[4])
{
    State s = {0};
    Loop c = {0};
    double current = 0.0, h = p->controller.period / steps;
    for (int k = 0; k < n; k++) {
        out[k][0] = s.xj + p->sensors.position_noise * noise[k][0];
        out[k][2] = s.p12 + p->sensors.pressure_noise * noise[k][1];
        out[k][3] = s.xs + p->sensors.spool_noise * noise[k][2];
        out[k][1] = answer(&c, com[k], out[k][0], p);
        Coefficients q = coefficients(p, h);
        for (int i = 0; i < steps; i++)
            s = step(s, current, load[k], p, q, h);
        current = out[k][1];
    }
}
