/* The monitoring model over many cells from a measured current, in C: the yardstick for plant/monitor.py.
 *
 * Same closed form, one step a cycle. Cells stand side by side in blocks of WIDTH, the blocks on all cores by OpenMP. */
#include <math.h>

#ifndef WIDTH
#define WIDTH 16
#endif

/* As plant.monitor.Cell, in order. */
#define CELL(X) X(tilt) X(back) X(unback) X(dead) X(slide) X(most) X(speed) X(rate) X(unrate) X(wait) X(spool_travel) \
    X(follow) X(lag) X(fade) X(push) X(coast) X(jack_travel) X(pressure_gain) X(pressure_slope) X(pressure_limit)

typedef struct {
#define X(field) double field[WIDTH];
    CELL(X)
#undef X
    double spool[WIDTH], position[WIDTH], moving[WIDTH], sliding[WIDTH], squares[WIDTH];
} Block;

static inline double clip(double x, double limit)
{
    x = x < limit ? x : limit;
    return x > -limit ? x : -limit;
}

static inline void step(Block *restrict b, int l, double current, double h)
{
    double tilt = b->tilt[l] * current - b->back[l] * b->spool[l];
    double asked = tilt - clip(tilt, b->slide[l]);
    int moves = (asked * b->sliding[l] > 0.0) | (fabs(tilt) > b->dead[l]);
    asked = moves ? asked : 0.0;
    double begin = clip(asked, b->most[l]);
    double wait = fabs(asked - begin) * b->wait[l];
    wait = wait < h ? wait : h;
    double end = begin * exp(b->rate[l] * (wait - h));
    double line = b->speed[l] * begin * wait, curve = (begin - end) * b->unback[l], left = h - wait;
    double spool = clip(b->spool[l] + line + curve, b->spool_travel[l]);
    double area = line * (0.5 * wait + left) + (begin * left - (begin - end) * b->unrate[l]) * b->unback[l];
    double total = clip(h * b->spool[l] + area, h * b->spool_travel[l]);
    double before = b->spool[l] - b->lag[l] * b->speed[l] * begin, v0 = b->moving[l];
    double free = b->follow[l] * (spool - b->lag[l] * b->speed[l] * end) + (v0 - b->follow[l] * before) * b->fade[l];
    double low = b->coast[l] * v0 - b->push[l], high = b->coast[l] * v0 + b->push[l];
    double v = free > low ? free : low;
    v = v < high ? v : high;
    double way = v == free ? b->follow[l] * total - b->lag[l] * (v - v0) : 0.5 * h * (v0 + v);
    double x = b->position[l] + way;
    b->spool[l] = spool;
    b->position[l] = clip(x, b->jack_travel[l]);
    b->moving[l] = fabs(x) <= b->jack_travel[l] ? v : 0.0;
    b->sliding[l] = (asked > 0.0 ? 1.0 : 0.0) - (asked < 0.0 ? 1.0 : 0.0);
}

/* `cells` (fields, m), m a multiple of WIDTH; `current`, `position` (n,); `pull` the share by which the ram is drawn to
 * the measured position in a cycle of `h` seconds; `out` (m,): RMS of XJ, measured less the cell's. */
void map_cells(const double *restrict cells, long m, const double *restrict current,
               const double *restrict position, double pull, long n, double h, double *restrict out)
{
#pragma omp parallel for schedule(dynamic)
    for (long first = 0; first < m; first += WIDTH) {
        Block b __attribute__((aligned(64)));
        const double *field = cells + first;
        for (int l = 0; l < WIDTH; l++) {
            const double *at = field + l;
#define X(name) b.name[l] = *at, at += m;
            CELL(X)
#undef X
            b.spool[l] = b.moving[l] = b.sliding[l] = b.squares[l] = 0.0;
            b.position[l] = position[0];
        }
        for (long k = 0; k < n; k++) {
            double acting = k ? current[k - 1] : 0.0, shown = position[k];
            for (int l = 0; l < WIDTH; l++) {
                double left = shown - b.position[l];
                b.squares[l] += left * left;
                b.position[l] += pull * left;
            }
#pragma omp simd
            for (int l = 0; l < WIDTH; l++)
                step(&b, l, acting, h);
        }
        for (int l = 0; l < WIDTH; l++)
            out[first + l] = sqrt(b.squares[l] / n);
    }
}
