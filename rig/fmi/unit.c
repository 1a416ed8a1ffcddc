#include "unit.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MARK UINT64_C(0x65686172696731)

/* numba's calling convention: address of the result, of the failure, then the arguments; an array is owner, parent,
 * number of items, bytes an item, data, length, stride */
#define ARRAY void *, void *, int64_t, int64_t, void *, int64_t, int64_t
#define PASS(data, n, size) NULL, NULL, (int64_t)(n), (int64_t)(size), (data), (int64_t)(n), (int64_t)(size)
int32_t advance_unit(void *, void *, ARRAY, ARRAY, ARRAY, ARRAY, ARRAY, int64_t, ARRAY);

static const Variable VARIABLES[REALS] = VARIABLE_TABLE;
static const double FLAT[STATES] = FLAT_TABLE, LOOP_START[LOOP] = LOOP_TABLE;

/* -------------------------------------------------------------------------------------------------- random numbers
 * Those of numpy.random.default_rng(seed).standard_normal: SeedSequence, PCG64, and the ziggurat of Marsaglia and Tsang
 * with numpy's tables. M. E. O'Neill, PCG, technical report HMC-CS-2014-0905. */

typedef struct { uint64_t low, high; } Wide;

static Wide add(Wide a, Wide b) {
    Wide sum = {a.low + b.low, a.high + b.high};
    sum.high += sum.low < a.low;
    return sum;
}

static Wide multiply(Wide a, Wide b) {
    const uint64_t half = UINT64_C(0xffffffff);
    uint64_t ll = (a.low & half) * (b.low & half), lh = (a.low & half) * (b.low >> 32);
    uint64_t hl = (a.low >> 32) * (b.low & half), hh = (a.low >> 32) * (b.low >> 32);
    uint64_t middle = (ll >> 32) + (lh & half) + hl;
    Wide product = {(middle << 32) | (ll & half), hh + (middle >> 32) + (lh >> 32) + a.low * b.high + a.high * b.low};
    return product;
}

static uint64_t draw_bits(uint64_t *random) {
    const Wide factor = {UINT64_C(4865540595714422341), UINT64_C(2549297995355413924)};
    Wide state = {random[0], random[1]}, increment = {random[2], random[3]};
    state = add(multiply(state, factor), increment);
    random[0] = state.low;
    random[1] = state.high;
    unsigned turn = (unsigned)(state.high >> 58);
    uint64_t mixed = state.high ^ state.low;
    return mixed >> turn | mixed << (-turn & 63);
}

static double draw_uniform(uint64_t *random) { return (double)(draw_bits(random) >> 11) / 9007199254740992.0; }

static double draw_normal(uint64_t *random) {
    static const uint64_t K[256] = ZIGGURAT_K;
    static const double W[256] = ZIGGURAT_W, F[256] = ZIGGURAT_F;
    for (;;) {
        uint64_t bits = draw_bits(random);
        unsigned layer = bits & 0xff;
        uint64_t size = bits >> 9 & UINT64_C(0x000fffffffffffff);
        double x = (double)size * W[layer];
        if (bits >> 8 & 1) x = -x;
        if (size < K[layer]) return x;
        if (layer == 0) {
            for (;;) {
                double a = -ZIGGURAT_INVERSE_R * log1p(-draw_uniform(random)), b = -log1p(-draw_uniform(random));
                if (b + b > a * a) return size >> 8 & 1 ? -(ZIGGURAT_R + a) : ZIGGURAT_R + a;
            }
        }
        if ((F[layer - 1] - F[layer]) * draw_uniform(random) + F[layer] < exp(-0.5 * x * x)) return x;
    }
}

/* numpy's SeedSequence of one 32-bit number: four words of 64 bits */
static void seed_random(uint64_t *random, uint32_t seed) {
    uint32_t pool[4], constant = 0x43b0d7e5u, words[8];
    for (int i = 0; i < 4; i++) {
        uint32_t value = (i == 0 ? seed : 0) ^ constant;
        constant *= 0x931e8875u;
        value *= constant;
        pool[i] = value ^ value >> 16;
    }
    for (int from = 0; from < 4; from++) {
        for (int to = 0; to < 4; to++) {
            if (from == to) continue;
            uint32_t value = pool[from] ^ constant;
            constant *= 0x931e8875u;
            value *= constant;
            value ^= value >> 16;
            uint32_t mixed = 0xca01f9ddu * pool[to] - 0x4973f715u * value;
            pool[to] = mixed ^ mixed >> 16;
        }
    }
    constant = 0x8b51f9ddu;
    for (int i = 0; i < 8; i++) {
        uint32_t value = pool[i % 4] ^ constant;
        constant *= 0x58f38dedu;
        value *= constant;
        words[i] = value ^ value >> 16;
    }
    Wide state = {words[2] | (uint64_t)words[3] << 32, words[0] | (uint64_t)words[1] << 32};
    Wide increment = {words[6] | (uint64_t)words[7] << 32, words[4] | (uint64_t)words[5] << 32};
    random[2] = increment.low << 1 | 1;
    random[3] = increment.high << 1 | increment.low >> 63;
    random[0] = random[1] = 0;
    draw_bits(random);
    Wide sum = add((Wide){random[0], random[1]}, state);
    random[0] = sum.low;
    random[1] = sum.high;
    draw_bits(random);
}

static void draw_cycle(State *s) {
    memcpy(s->noise, s->noise + NOISES, NOISES * sizeof(double));
    for (int i = 0; i < NOISES; i++) s->noise[NOISES + i] = draw_normal(s->random);
}

/* -------------------------------------------------------------------------------------------------- the actuator */

/* One cycle, or the reading at the start where `loop` says that there was none. */
static Status run_cycle(Unit *u) {
    State *s = &u->now;
    void *result = NULL, *failure = NULL;
    double period = s->reals[PERIOD], steps = rint(period / SOLVER_STEP);
    double inputs[5] = {s->reals[INPUTS], s->reals[INPUTS + 1], s->reals[INPUTS + 2], s->closed, s->noise[NOISES - 1]};
    int32_t status = advance_unit(&result, &failure, PASS(s->flat, STATES, 8), PASS(s->loop, LOOP, 8), PASS(inputs, 5, 8),
                             PASS(s->noise + NOISES, NOISES, 8), PASS(s->reals + PARAMETERS, 1, 8 * PARAMETER_COUNT),
                             steps > 1 ? (int64_t)steps : 1, PASS(s->reals + OUTPUTS, OUTPUT_COUNT, 8));
    int is_finite = status == 0;
    for (int i = 0; i < OUTPUT_COUNT; i++) is_finite &= isfinite(s->reals[OUTPUTS + i]) != 0;
    if (is_finite) return OK;
    s->phase = FAILED;
    return unit_fail(u, "the plant has diverged: a signal is not a finite number");
}

static Status calculate_start(Unit *u) {
    State *s = &u->now;
    if (!s->is_dirty) return OK;
    s->is_dirty = 0;
    memcpy(s->flat, FLAT, sizeof FLAT);
    memcpy(s->loop, LOOP_START, sizeof LOOP_START);
    s->reals[TIME_AT] = s->start;
    seed_random(s->random, (uint32_t)s->seed);
    draw_cycle(s);
    return run_cycle(u);
}

Status unit_exit_initialisation(Unit *u) {
    Status status = calculate_start(u);
    if (status == OK) u->now.phase = STEPPING;
    return status;
}

Status unit_step(Unit *u, double t, double length) {
    State *s = &u->now;
    double period = s->reals[PERIOD], cycles = rint(length / period);
    if (!(fabs(t - s->reals[TIME_AT]) <= 1e-6 * period + 1e-12 * fabs(t)))
        return unit_fail(u, "the step must begin at %.9g s, where the last one ended, not at %.9g s", s->reals[TIME_AT], t);
    if (!(cycles >= 1 && cycles < 1e9 && fabs(length - cycles * period) <= 1e-6 * period + 1e-12 * fabs(t)))
        return unit_fail(u, "the step must be a whole number of cycles of %.9g s, not %.9g s", period, length);
    for (; cycles > 0; cycles--) {
        draw_cycle(s);
        Status status = run_cycle(u);
        if (status != OK) return status;
        s->reals[TIME_AT] = s->start + s->loop[0] * period;
    }
    return OK;
}

/* -------------------------------------------------------------------------------------------------- life of an instance */

Unit *unit_create(const char *name, const char *token, const char *known_token, Unit first) {
    Unit *u = malloc(sizeof *u);
    if (u == NULL) return NULL;
    *u = first;
    u->mark = MARK;
    char *copy = malloc(name == NULL ? 1 : strlen(name) + 1);
    if (copy != NULL) strcpy(copy, name == NULL ? "" : name);
    u->name = copy;
    if (copy == NULL || name == NULL || *name == 0)
        unit_fail(u, "an instance needs a name");
    else if (token == NULL || strcmp(token, known_token) != 0)
        unit_fail(u, "the modelDescription.xml is not the one of this binary: its token must be %s", known_token);
    else {
        unit_reset(u);
        return u;
    }
    unit_free(u);
    return NULL;
}

void unit_free(Unit *u) {
    if (u == NULL || u->mark != MARK) return;
    u->mark = 0;
    free((char *)u->name);
    free(u);
}

Status unit_reset(Unit *u) {
    State *s = &u->now;
    memset(s, 0, sizeof *s);
    for (int i = 0; i < REALS; i++) s->reals[i] = VARIABLES[i].start;
    s->seed = SEED;
    s->phase = INSTANTIATED;
    s->is_dirty = 1;
    return OK;
}

/* Whether a call is allowed now; the caller returns ERROR where it is not. */
int unit_allows(Unit *u, int phases, const char *function) {
    if (u == NULL || u->mark != MARK) return 0;
    if (u->now.phase & phases) return 1;
    unit_fail(u, "%s: not allowed in this state of the unit", function);
    return 0;
}

Status unit_fail(Unit *u, const char *format, ...) {
    char text[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    if (u->log != NULL && u->logger != NULL) u->log(u, ERROR, text);
    return ERROR;
}

/* -------------------------------------------------------------------------------------------------- variables */

static int32_t *find_integer(Unit *u, Kind kind, uint32_t reference) {
    if (kind == INTEGER && reference == SEED_AT) return &u->now.seed;
    if (kind == BOOLEAN && reference == CLOSED_AT) return &u->now.closed;
    return NULL;
}

static Status refuse_reference(Unit *u, Kind kind, uint32_t reference) {
    static const char *const NAMES[] = {"real", "integer", "boolean"};
    return unit_fail(u, "value reference %u: no %s variable", (unsigned)reference, NAMES[kind]);
}

Status unit_get(Unit *u, Kind kind, const uint32_t *references, size_t n, void *values) {
    if (n > 0 && (references == NULL || values == NULL)) return unit_fail(u, "get: no array of references or values");
    if (n > 0 && u->now.phase == INITIALISING && calculate_start(u) != OK) return ERROR;
    for (size_t i = 0; i < n; i++) {
        int32_t *integer = find_integer(u, kind, references[i]);
        if (integer != NULL)
            ((int32_t *)values)[i] = *integer;
        else if (kind == REAL && references[i] < REALS)
            ((double *)values)[i] = u->now.reals[references[i]];
        else
            return refuse_reference(u, kind, references[i]);
    }
    return OK;
}

/* Sets all or, where one is refused, none. */
Status unit_set(Unit *u, Kind kind, const uint32_t *references, size_t n, const void *values) {
    State *s = &u->now;
    if (n > 0 && (references == NULL || values == NULL)) return unit_fail(u, "set: no array of references or values");
    int is_starting = (s->phase & (INSTANTIATED | INITIALISING)) != 0;
    for (size_t i = 0; i < n; i++) {
        if (find_integer(u, kind, references[i]) != NULL) {
            int32_t value = ((const int32_t *)values)[i];
            if (!is_starting) return unit_fail(u, "value reference %u is fixed after the start", (unsigned)references[i]);
            if (value < 0 || (kind == BOOLEAN && value > 1)) return unit_fail(u, "%ld is out of range", (long)value);
            continue;
        }
        if (kind != REAL || references[i] >= REALS) return refuse_reference(u, kind, references[i]);
        const Variable *v = &VARIABLES[references[i]];
        double value = ((const double *)values)[i];
        if (v->role == TIME || v->role == OUTPUT) return unit_fail(u, "%s cannot be set", v->name);
        if (v->role == FIXED && !is_starting) return unit_fail(u, "%s is fixed after the start", v->name);
        if (!(value >= v->low && value <= v->high))
            return unit_fail(u, "%s must be between %g and %g, not %g", v->name, v->low, v->high, value);
    }
    for (size_t i = 0; i < n; i++) {
        if (kind == REAL)
            s->reals[references[i]] = ((const double *)values)[i];
        else
            *find_integer(u, kind, references[i]) = ((const int32_t *)values)[i];
    }
    if (is_starting) s->is_dirty = 1;
    return OK;
}

/* -------------------------------------------------------------------------------------------------- saved states */

typedef struct { uint64_t mark, size, model; State state; } Saved;

static Saved *find_saved(Unit *u, void *saved) {
    Saved *found = saved;
    if (found != NULL && found->mark == MARK && found->size == sizeof *found && found->model == MODEL_HASH) return found;
    unit_fail(u, "not a saved state of this unit");
    return NULL;
}

Status unit_save(Unit *u, void **saved) {
    if (saved == NULL) return unit_fail(u, "no place for the saved state");
    Saved *made = *saved == NULL ? calloc(1, sizeof *made) : find_saved(u, *saved);
    if (made == NULL) return ERROR;
    made->mark = MARK;
    made->size = sizeof *made;
    made->model = MODEL_HASH;
    made->state = u->now;
    *saved = made;
    return OK;
}

Status unit_restore(Unit *u, void *saved) {
    Saved *found = find_saved(u, saved);
    if (found == NULL) return ERROR;
    u->now = found->state;
    return OK;
}

Status unit_forget(Unit *u, void **saved) {
    if (saved == NULL || *saved == NULL) return OK;
    Saved *found = find_saved(u, *saved);
    if (found == NULL) return ERROR;
    found->mark = 0;
    free(found);
    *saved = NULL;
    return OK;
}

size_t unit_serialized_size(void) { return sizeof(Saved); }

Status unit_serialize(Unit *u, void *saved, unsigned char *bytes, size_t size) {
    Saved *found = find_saved(u, saved);
    if (found == NULL) return ERROR;
    if (bytes == NULL || size < sizeof *found) return unit_fail(u, "a saved state needs %lu bytes", (unsigned long)sizeof *found);
    memcpy(bytes, found, sizeof *found);
    return OK;
}

Status unit_deserialize(Unit *u, const unsigned char *bytes, size_t size, void **saved) {
    Saved read;
    if (bytes == NULL || saved == NULL || size < sizeof read) return unit_fail(u, "not the bytes of a saved state");
    memcpy(&read, bytes, sizeof read);
    if (find_saved(u, &read) == NULL) return ERROR;
    Status status = unit_save(u, saved);
    if (status == OK) *(Saved *)*saved = read;
    return status;
}
