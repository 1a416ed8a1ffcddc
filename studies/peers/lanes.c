/* Many runs of the reference model from a measured current, in C: the yardstick for plant/lanes.py.
 *
 * The step is that of step.c. Runs stand side by side in blocks of WIDTH, one array a quantity, all in one structure of
 * known size; the loop over a block is marked as free of dependences, so that it becomes vector code. */
#include "step.c"

#ifndef WIDTH
#define WIDTH 16
#endif

/* What a step reads of the parameters, of the coefficients, and the state. */
#define PARAMETERS(X) X(torque_motor, gain) X(flapper, stiffness) X(flapper, travel) X(feedback_spring, stiffness) \
    X(spool, mass) X(spool, static_friction) X(spool, dynamic_friction) X(spool, travel) X(jack, area) X(jack, mass) \
    X(jack, static_friction) X(jack, dynamic_friction) X(jack, travel)
#define COEFFICIENTS(X) X(keep) X(push) X(pilot_gain) X(pilot_slope) X(pilot_limit) X(spool_free) X(spool_coupled) \
    X(spool_push) X(valve_gain) X(valve_slope) X(valve_limit) X(jack_free) X(jack_coupled)
#define STATE(X) X(xf) X(vf) X(xs) X(vs) X(xj) X(vj) X(p12)

typedef struct {
#define X(group, field) double group##_##field[WIDTH];
    PARAMETERS(X)
#undef X
#define X(field) double field[WIDTH];
    COEFFICIENTS(X) STATE(X)
#undef X
} Block;

static void laid_out(Block *b, const Model *models, double h)
{
    for (int l = 0; l < WIDTH; l++) {
        Coefficients k = coefficients(models + l, h);
#define X(group, field) b->group##_##field[l] = models[l].group.field;
        PARAMETERS(X)
#undef X
#define X(field) b->field[l] = k.field;
        COEFFICIENTS(X)
#undef X
#define X(field) b->field[l] = 0.0;
        STATE(X)
#undef X
    }
}

static inline void step_block(Block *restrict b, double current, double load, double h)
{
#pragma GCC ivdep
    for (int l = 0; l < WIDTH; l++) {
        Model p;
        Coefficients k;
        State s;
#define X(group, field) p.group.field = b->group##_##field[l];
        PARAMETERS(X)
#undef X
#define X(field) k.field = b->field[l];
        COEFFICIENTS(X)
#undef X
#define X(field) s.field = b->field[l];
        STATE(X)
#undef X
        s = step(s, current, load, &p, k, h);
#define X(field) b->field[l] = s.field;
        STATE(X)
#undef X
    }
}

/* `models` (m,), m a multiple of WIDTH; `current`, `load` (n,); `out` (m, 3, n): XJ, P12, XS at each sample. */
void replay_lanes(const Model *restrict models, int m, const double *restrict current, const double *restrict load,
                  long n, int steps, double *restrict out)
{
    double h = models->controller.period / steps;
    for (int first = 0; first < m; first += WIDTH) {
        Block b __attribute__((aligned(64)));
        laid_out(&b, models + first, h);
        for (long k = 0; k < n; k++) {
            for (int l = 0; l < WIDTH; l++) {
                double *row = out + (first + l) * 3 * n + k;
                row[0] = b.xj[l];
                row[n] = b.p12[l];
                row[2 * n] = b.xs[l];
            }
            for (int i = 0; i < steps; i++)
                step_block(&b, k ? current[k - 1] : 0.0, load[k], h);
        }
    }
}

/* The same, one run after the other. */
void replay_each(const Model *restrict models, int m, const double *restrict current, const double *restrict load,
                 long n, int steps, double *restrict out)
{
    double h = models->controller.period / steps;
    for (int j = 0; j < m; j++) {
        Coefficients q = coefficients(models + j, h);
        State s = {0};
        double *row = out + j * 3 * n;
        for (long k = 0; k < n; k++) {
            row[k] = s.xj;
            row[n + k] = s.p12;
            row[2 * n + k] = s.xs;
            for (int i = 0; i < steps; i++)
                s = step(s, k ? current[k - 1] : 0.0, load[k], models + j, q, h);
        }
    }
}
