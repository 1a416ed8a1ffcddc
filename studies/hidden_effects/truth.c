/* The truth of the blind trial: the plant and its faults written from the equations alone, apart from plant/.
 *
 * Steps of 1 us, one rate at a time (Gauss-Seidel: coil, flapper, spool, jack), each implicit in its own speed where a
 * pressure damps it. Dry friction after Karnopp without a band: a body at rest stays until the static level is passed,
 * leaves against the dynamic one, and a speed that would change its sign becomes zero. Compiled with gcc -O2 by
 * truth.py, which reads the order of the fields from trial_fields(). All SI.
 */
#include <math.h>
#include <stddef.h>

#define FIELDS \
    X(GAP) X(Imax) X(GM) X(JF) X(BF) X(KF) X(XFM) X(KSF) X(Kintas) X(GQF) X(GPF) X(ASV) X(MS) X(CS) X(FSS) X(FDS) \
    X(XSM) X(GQ) X(GP) X(PSR) X(AJ) X(MJ) X(CJ) X(FSJ) X(FDJ) X(CLK) X(XJM) \
    /* the catalogue; zero is off */ \
    X(bias) X(motor_play) X(coil_tau) X(driver_cut) X(nozzle) X(gap) X(overlap) X(underlap) X(orifice) X(flow_force) \
    X(droop) X(ripple) X(ripple_hz) X(volume) X(stribeck) X(stribeck_v) X(bristle) X(bristle_v) X(asymmetry) X(recoil) \
    X(backlash) X(aero) X(force) X(sensor_tau) X(sensor_gain) X(sensor_offset) X(lsb) X(delay) X(rate) \
    /* outside the catalogue; zero is off */ \
    X(cog) X(cog_l) X(rough) X(rough_l) X(pilot_tau) X(mass2) X(spring2) X(damp2) X(leak_root) X(motor_drift) \
    X(spring_cubic) X(area_slope) X(jitter) X(torque) X(torque_hz) X(leak_sign) X(drag2) X(sensor_square)

#define X(name) double name;
struct plant { FIELDS };
#undef X
#define X(name) #name " "
const char *trial_fields(void) { return FIELDS; }
#undef X

static const double PI2 = 6.283185307179586, LINE = 2e-3; /* s, lag of the supply line */

struct state {
    double t, xf, vf, xs, vs, xj, vj, p12, coil, play, nozzle, droop, bristle, x2, v2, ram, lag;
};
/* What holds for one step: its length and the gains and pressures that depend on the supply. */
struct now { double h, gpf, ps1, gq, psr, pilot, valve; }; /* pilot = GPF1 / GQF1, valve = GP / GQ */

static inline double clip(double x, double most) { return x > most ? most : x < -most ? -most : x; }
static inline double dead(double x, double half) { return x > half ? x - half : x < -half ? x + half : 0.0; }
static inline double follow(double held, double x, double half)
{
    return held > x + half ? x + half : held < x - half ? x - half : held;
}

/* New speed of a body under `force` (without its damping c) and dry friction. */
static inline double dry(double v, double force, double m, double c, double h, double stick, double slide)
{
    if (v == 0.0) {
        if (fabs(force) <= stick) return 0.0;
        v = h * (force - copysign(slide, force)) / (m + h * c);
        return v * force > 0.0 ? v : 0.0;
    }
    double next = (m * v + h * (force - copysign(slide, v))) / (m + h * c);
    return next * v > 0.0 ? next : 0.0;
}

static inline void move(double *x, double *v, double h, double travel)
{
    *x += h * *v;
    if (fabs(*x) >= travel) {
        *x = copysign(travel, *x);
        *v = 0.0;
    }
}

/* Supply over nominal is r: PSR, GPF scale with r; GQF, GQ with sqrt(r). */
static inline struct now supply(const struct plant *p, struct state *s, struct now n, struct now full)
{
    if (p->droop == 0.0 && p->ripple == 0.0) return n;
    double flow = fabs(p->AJ * s->vj + p->CLK * s->p12);
    s->droop += n.h / LINE * (p->droop * flow - s->droop);
    double r = 1.0 - s->droop / p->PSR;
    if (p->ripple != 0.0) r *= 1.0 + p->ripple * sin(PI2 * p->ripple_hz * s->t);
    r = r < 0.01 ? 0.01 : r;
    double root = sqrt(r);
    n.gpf = full.gpf * r;
    n.ps1 = full.ps1 * r;
    n.psr = full.psr * r;
    n.gq = full.gq * root;
    n.pilot = full.pilot * root; /* r over its root */
    n.valve = full.valve / root;
    return n;
}

static inline double coil(const struct plant *p, struct state *s, double current, double h)
{
    if (p->driver_cut != 0.0) current = clip(current, p->Imax * (1.0 - p->driver_cut));
    current += p->bias;
    if (p->motor_play != 0.0) current = s->play = follow(s->play, current, 0.5 * p->motor_play);
    if (p->coil_tau == 0.0) return current;
    return s->coil += h / p->coil_tau * (current - s->coil);
}

static inline void flapper(const struct plant *p, struct state *s, double current, double h)
{
    double xs = p->gap != 0.0 ? dead(s->xs, 0.5 * p->gap) : s->xs;
    double gain = p->GM * (1.0 + p->motor_drift * s->t);
    double torque = gain * current - p->KSF * (xs + p->spring_cubic * xs * xs * xs);
    if (p->torque != 0.0) torque += p->torque * sin(PI2 * p->torque_hz * s->t);
    s->vf = (s->vf * p->JF + h * (torque - p->KF * s->xf)) / (p->JF + h * p->BF);
    move(&s->xf, &s->vf, h, p->XFM);
}

/* P1 = clip(gpf xf - gpf/gqf ASV v, ps1), implicit in v: once as if unsaturated, else with the limit as the force. */
static inline void spool(const struct plant *p, struct state *s, const struct now *n)
{
    double xn = s->xf * (1.0 + copysign(1.0, s->xf) * p->nozzle), h = n->h;
    if (p->pilot_tau != 0.0) xn = s->nozzle += h / p->pilot_tau * (xn - s->nozzle);
    double push = n->gpf * xn, damping = n->pilot * p->ASV;
    double back = p->flow_force * s->xs * (n->psr - fabs(s->p12));
    double v = dry(s->vs, p->ASV * push - back, p->MS, p->ASV * damping + p->CS, h, p->FSS, p->FDS);
    double p1 = push - damping * v;
    if (fabs(p1) > n->ps1)
        v = dry(s->vs, p->ASV * copysign(n->ps1, p1) - back, p->MS, p->CS, h, p->FSS, p->FDS);
    s->vs = v;
    move(&s->xs, &s->vs, h, p->XSM);
}

/* Spool displacement as the metering edges see it. */
static inline double edges(const struct plant *p, double xs)
{
    double x = p->overlap != 0.0 ? dead(xs, p->overlap) : xs;
    return p->underlap != 0.0 ? x + clip(xs, p->underlap) : x;
}

/* z = sqrt(1 - sign(XS) P12 / PSR) of the bridge, from a z^2 + b z = a + sign(XS) c; P12 = sign(XS) PSR (1 - z^2). */
static double orifice(const struct plant *p, const struct now *n, double x, double taken, double leak)
{
    double side = copysign(1.0, x), a = n->psr * (1.0 + n->valve * leak), b = p->GP * fabs(x);
    double right = a + side * n->valve * taken;
    if (right <= 0.0) return side * n->psr;
    double z = (sqrt(b * b + 4.0 * a * right) - b) / (2.0 * a);
    return side * n->psr * (1.0 - z * z);
}

/* P12 where it does not follow from the new speed linearly; the old speed will do at 1 us. */
static double pressure(const struct plant *p, struct state *s, const struct now *n, double x, double area, double leak)
{
    double taken = area * s->vj;
    if (p->volume != 0.0)
        return s->p12 + n->h / p->volume * (n->gq * x - (1.0 / n->valve + leak) * s->p12 - taken);
    if (p->orifice != 0.0) return orifice(p, n, x, taken, leak);
    double ratio = n->valve, free = (p->GP * x - ratio * taken) / (1.0 + ratio * leak);
    double k = 0.5 * ratio * p->leak_root / (1.0 + ratio * leak), y = sqrt(k * k + fabs(free)) - k;
    return copysign(y * y, free); /* y^2 + 2 k y = |free|, y = sqrt|P12| */
}

/* Force on the ram against extension, all but pressure, damping and dry friction. */
static inline double load(const struct plant *p, struct state *s, double known, double h)
{
    double force = known + p->force + p->aero * s->xj;
    if (p->cog != 0.0) force += p->cog * sin(PI2 * s->xj / p->cog_l);
    if (p->mass2 == 0.0) return force;
    double pull = p->spring2 * (s->x2 - s->xj) + p->damp2 * (s->v2 - s->vj);
    s->v2 -= h * pull / p->mass2;
    s->x2 += h * s->v2;
    return force - pull;
}

/* LuGre: z' = v - s0 |v| z / g(v), F = s0 z + s1 z'; g falls from static to dynamic over bristle_v, or is dynamic. */
static double bristle(const struct plant *p, struct state *s, double h)
{
    double v = s->vj, g = p->FDJ;
    if (p->bristle_v != 0.0) g += (p->FSJ - p->FDJ) * exp(-v * v / (p->bristle_v * p->bristle_v));
    double rate = v - p->bristle * fabs(v) * s->bristle / g;
    s->bristle += h * rate;
    return p->bristle * s->bristle + 0.02 * sqrt(p->bristle * p->MJ) * rate;
}

/* New speed of the ram under `force`, damped by c; friction for where it is and goes, or that of the bristles. */
static inline double ram_speed(const struct plant *p, const struct state *s, double force, double c, double h)
{
    if (p->bristle != 0.0) return (p->MJ * s->vj + h * force) / (p->MJ + h * c);
    double stick = p->FSJ, slide = p->FDJ;
    if (p->stribeck != 0.0) {
        double part = s->vj / p->stribeck_v;
        slide += p->stribeck * p->FSJ * exp(-part * part);
        if (slide > stick) stick = slide;
    }
    double scale = 1.0 + copysign(1.0, s->vj != 0.0 ? s->vj : force) * p->asymmetry;
    if (p->rough != 0.0) scale *= 1.0 + p->rough * sin(PI2 * s->xj / p->rough_l);
    return dry(s->vj, force, p->MJ, c, h, stick * scale, slide * scale);
}

static inline void jack(const struct plant *p, struct state *s, const struct now *n, double known)
{
    double h = n->h, x = edges(p, s->xs), area = p->AJ * (1.0 + p->area_slope * s->xj), v;
    double leak = p->CLK + (s->p12 > 0.0 ? p->leak_sign : 0.0);
    double resist = load(p, s, known, h), drag = p->CJ + p->drag2 * fabs(s->vj);
    double scale = 1.0 / (1.0 + n->valve * leak), slope = n->valve * area * scale;
    double push = p->GP * x * scale; /* P12 = push - slope v */
    int direct = p->volume != 0.0 || p->orifice != 0.0 || p->leak_root != 0.0;
    if (direct) {
        push = clip(pressure(p, s, n, x, area, leak), n->psr);
        slope = 0.0;
    }
    if (p->bristle != 0.0) resist += bristle(p, s, h);
    v = ram_speed(p, s, area * push - resist, area * slope + drag, h);
    s->p12 = push - slope * v;
    if (fabs(s->p12) > n->psr) {
        s->p12 = copysign(n->psr, s->p12);
        v = ram_speed(p, s, area * s->p12 - resist, drag, h);
    }
    s->vj = v;
    move(&s->xj, &s->vj, h, p->XJM);
}

/* The transducer's parts with a memory, which must see every step. */
static inline void sense(const struct plant *p, struct state *s, double h)
{
    double x = s->xj + p->recoil * p->AJ * s->p12;
    if (p->backlash != 0.0) x = follow(s->ram, x, 0.5 * p->backlash);
    s->ram = x;
    if (p->sensor_tau != 0.0) s->lag += h / p->sensor_tau * (x - s->lag);
}

static double sensed(const struct plant *p, const struct state *s, double noise)
{
    double x = p->sensor_tau != 0.0 ? s->lag : s->ram;
    x = x * (1.0 + p->sensor_gain) + p->sensor_square * x * x + p->sensor_offset + noise;
    return p->lsb != 0.0 ? p->lsb * floor(x / p->lsb + 0.5) : x;
}

/* Cor as the coil sees it in cycle k at `part` of the cycle: answer k-1, or one before when there is dead time. */
static double acting(const struct plant *p, const double *cor, long k, double part)
{
    if (k < 1) return 0.0;
    double dead_time = p->delay + p->jitter * fabs(cor[k - 1]) / p->Imax; /* cycles */
    long i = k - 1 + (long)floor(part - dead_time + 1e-9);
    return i < 0 ? 0.0 : cor[i];
}

/* A run of n cycles, `steps` steps each. `replay` != 0: cor is given, not written. out is (n, 3): XJ sensed with
 * noise, P12, XS without. */
void trial_run(const struct plant *p, long n, long steps, int replay, const double *com, const double *known,
               const double *noise, double period, double *cor, double *out)
{
    struct state s = {0};
    double demand = 0.0, most = p->rate * period, left = 1.0 - p->Kintas;
    struct now full = {period / steps, p->GPF * left, p->PSR * left, p->GQ, p->PSR,
                       p->GPF / p->GQF * sqrt(left), p->GP / p->GQ};
    for (long k = 0; k < n; k++) {
        double measured = sensed(p, &s, noise[k]);
        demand = most != 0.0 ? demand + clip(com[k] - demand, most) : com[k];
        if (!replay) cor[k] = clip(p->GAP * (demand - measured), p->Imax);
        out[3 * k] = measured;
        out[3 * k + 1] = s.p12;
        out[3 * k + 2] = s.xs;
        int late = p->delay != 0.0 || p->jitter != 0.0;
        double current = k > 0 ? cor[k - 1] : 0.0;
        for (long i = 0; i < steps; i++) {
            s.t = (k + (double)i / steps) * period;
            if (late) current = acting(p, cor, k, (double)i / steps);
            struct now now = supply(p, &s, full, full);
            flapper(p, &s, coil(p, &s, current, now.h), now.h);
            spool(p, &s, &now);
            jack(p, &s, &now, known[k]);
            sense(p, &s, now.h);
        }
    }
}
