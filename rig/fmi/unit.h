/* One actuator as a functional mock-up unit: the state, and what both versions of FMI do with it.
 *
 * fmi2.c and fmi3.c are the interface, unit.c the work; the equations are the object code that numba compiled from the
 * model, and unit_tables.h holds the numbers of the model. rig/fmi/export.py writes that file and puts all together. */
#ifndef UNIT_H
#define UNIT_H

#include <stddef.h>
#include <stdint.h>

#include "unit_tables.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status; /* the same numbers in FMI 2 and 3 */
typedef enum { INSTANTIATED = 1, INITIALISING = 2, STEPPING = 4, TERMINATED = 8, FAILED = 16 } Phase;
typedef enum { TIME, INPUT, OUTPUT, FIXED, TUNABLE } Role;
typedef enum { REAL, INTEGER, BOOLEAN } Kind;

typedef struct { const char *name; Role role; double start, low, high; } Variable;

/* All that changes. Real variables are found in `reals` by their value reference: time, inputs, outputs, parameters. */
typedef struct {
    double reals[REALS];
    double flat[STATES];      /* of the plant */
    double loop[LOOP];        /* cycles of the plant, -1: not started; answer of the controller; what it remembers */
    double noise[2 * NOISES]; /* random numbers of this cycle and of the next */
    double start;             /* s */
    uint64_t random[4];       /* state and increment of the generator, low word first */
    int32_t seed, closed;     /* the other two variables */
    int32_t phase, is_dirty;  /* is_dirty: outputs are to be calculated before they are read */
} State;

typedef struct Unit Unit;
struct Unit {
    uint64_t mark; /* MARK while the instance lives */
    State now;
    int is_logging;
    void *environment;
    const char *name;
    void (*logger)(void);
    void (*log)(Unit *, Status, const char *message);
};

Unit *unit_create(const char *name, const char *token, const char *known_token, Unit first);
void unit_free(Unit *);
int unit_allows(Unit *, int phases, const char *function);
Status unit_fail(Unit *, const char *format, ...);
Status unit_reset(Unit *);
Status unit_exit_initialisation(Unit *);
Status unit_step(Unit *, double t, double length);
Status unit_get(Unit *, Kind, const uint32_t *references, size_t n, void *values);
Status unit_set(Unit *, Kind, const uint32_t *references, size_t n, const void *values);
Status unit_save(Unit *, void **saved);
Status unit_restore(Unit *, void *saved);
Status unit_forget(Unit *, void **saved);
Status unit_serialize(Unit *, void *saved, unsigned char *bytes, size_t size);
Status unit_deserialize(Unit *, const unsigned char *bytes, size_t size, void **saved);
size_t unit_serialized_size(void);

#endif
