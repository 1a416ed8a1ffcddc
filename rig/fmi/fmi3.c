/* FMI 3.0 for co-simulation (fmi-standard.org, section 4.2): every function of the interface. */
#include "unit.h"

#include <stdbool.h>
#include <string.h>

typedef Unit *Instance;
typedef const char *String;
typedef void (*Logger)(void *environment, int status, String category, String message);

enum { ANY = INSTANTIATED | INITIALISING | STEPPING | TERMINATED | FAILED };
enum { READABLE = INITIALISING | STEPPING | TERMINATED | FAILED, WRITABLE = INSTANTIATED | INITIALISING | STEPPING };
#define REQUIRE(phases, name) if (!unit_allows(c, phases, name)) return ERROR
#define NAMES const uint32_t *

static void log_message(Unit *u, Status status, const char *message) {
    ((Logger)u->logger)(u->environment, status, "logStatusError", message);
}

EXPORT String fmi3GetVersion(void) { return "3.0"; }

EXPORT Status fmi3SetDebugLogging(Instance c, bool on, size_t n, const String categories[]) {
    REQUIRE(ANY, "fmi3SetDebugLogging");
    for (size_t i = 0; i < n; i++)
        if (categories == NULL || categories[i] == NULL || strcmp(categories[i], "logStatusError") != 0)
            return unit_fail(c, "fmi3SetDebugLogging: unknown category");
    c->is_logging = on;
    return OK;
}

EXPORT Instance fmi3InstantiateCoSimulation(String name, String token, String resources, bool visible, bool is_logging,
                                            bool has_events, bool may_return, NAMES needed, size_t n, void *environment,
                                            Logger logger, void (*update)(void)) {
    (void)resources, (void)visible, (void)may_return, (void)needed, (void)update;
    Unit first = {.is_logging = is_logging, .environment = environment, .logger = (void (*)(void))logger,
                  .log = log_message};
    Instance c = unit_create(name, token, TOKEN, first);
    if (c != NULL && (has_events || n > 0)) {
        unit_fail(c, "fmi3InstantiateCoSimulation: this unit has neither event mode nor intermediate variables");
        unit_free(c);
        return NULL;
    }
    return c;
}

static void refuse_type(Logger logger, void *environment) {
    if (logger != NULL) logger(environment, ERROR, "logStatusError", "this unit is for co-simulation");
}

EXPORT Instance fmi3InstantiateModelExchange(String name, String token, String resources, bool visible, bool is_logging,
                                             void *environment, Logger logger) {
    (void)name, (void)token, (void)resources, (void)visible, (void)is_logging;
    refuse_type(logger, environment);
    return NULL;
}

EXPORT Instance fmi3InstantiateScheduledExecution(String name, String token, String resources, bool visible,
                                                  bool is_logging, void *environment, Logger logger,
                                                  void (*update)(void *), void (*lock)(void), void (*unlock)(void)) {
    (void)name, (void)token, (void)resources, (void)visible, (void)is_logging, (void)update, (void)lock, (void)unlock;
    refuse_type(logger, environment);
    return NULL;
}

EXPORT void fmi3FreeInstance(Instance c) { unit_free(c); }

EXPORT Status fmi3EnterInitializationMode(Instance c, bool is_tolerance, double tolerance, double start, bool is_stop,
                                          double stop) {
    (void)is_tolerance, (void)tolerance, (void)is_stop, (void)stop;
    REQUIRE(INSTANTIATED, "fmi3EnterInitializationMode");
    if (!(start - start == 0)) return unit_fail(c, "fmi3EnterInitializationMode: the start time must be finite");
    c->now.start = start;
    c->now.phase = INITIALISING;
    return OK;
}

EXPORT Status fmi3ExitInitializationMode(Instance c) {
    REQUIRE(INITIALISING, "fmi3ExitInitializationMode");
    return unit_exit_initialisation(c);
}

EXPORT Status fmi3Terminate(Instance c) {
    REQUIRE(STEPPING, "fmi3Terminate");
    c->now.phase = TERMINATED;
    return OK;
}

EXPORT Status fmi3Reset(Instance c) {
    REQUIRE(ANY, "fmi3Reset");
    return unit_reset(c);
}

EXPORT Status fmi3GetFloat64(Instance c, NAMES r, size_t n, double v[], size_t nv) {
    REQUIRE(READABLE, "fmi3GetFloat64");
    return nv == n ? unit_get(c, REAL, r, n, v) : unit_fail(c, "fmi3GetFloat64: one value for each reference");
}

EXPORT Status fmi3SetFloat64(Instance c, NAMES r, size_t n, const double v[], size_t nv) {
    REQUIRE(WRITABLE, "fmi3SetFloat64");
    return nv == n ? unit_set(c, REAL, r, n, v) : unit_fail(c, "fmi3SetFloat64: one value for each reference");
}

EXPORT Status fmi3GetInt32(Instance c, NAMES r, size_t n, int32_t v[], size_t nv) {
    REQUIRE(READABLE, "fmi3GetInt32");
    return nv == n ? unit_get(c, INTEGER, r, n, v) : unit_fail(c, "fmi3GetInt32: one value for each reference");
}

EXPORT Status fmi3SetInt32(Instance c, NAMES r, size_t n, const int32_t v[], size_t nv) {
    REQUIRE(WRITABLE, "fmi3SetInt32");
    return nv == n ? unit_set(c, INTEGER, r, n, v) : unit_fail(c, "fmi3SetInt32: one value for each reference");
}

EXPORT Status fmi3GetBoolean(Instance c, NAMES r, size_t n, bool v[], size_t nv) {
    REQUIRE(READABLE, "fmi3GetBoolean");
    if (nv != n || (n > 0 && v == NULL)) return unit_fail(c, "fmi3GetBoolean: one value for each reference");
    for (size_t i = 0; i < n; i++) {
        int32_t value;
        if (unit_get(c, BOOLEAN, r == NULL ? NULL : r + i, 1, &value) != OK) return ERROR;
        v[i] = value != 0;
    }
    return OK;
}

EXPORT Status fmi3SetBoolean(Instance c, NAMES r, size_t n, const bool v[], size_t nv) {
    REQUIRE(WRITABLE, "fmi3SetBoolean");
    if (nv != n || (n > 0 && v == NULL)) return unit_fail(c, "fmi3SetBoolean: one value for each reference");
    for (size_t i = 0; i < n; i++) {
        int32_t value = v[i];
        if (unit_set(c, BOOLEAN, r == NULL ? NULL : r + i, 1, &value) != OK) return ERROR;
    }
    return OK;
}

EXPORT Status fmi3GetFMUState(Instance c, void **saved) {
    REQUIRE(ANY, "fmi3GetFMUState");
    return unit_save(c, saved);
}

EXPORT Status fmi3SetFMUState(Instance c, void *saved) {
    REQUIRE(ANY, "fmi3SetFMUState");
    return unit_restore(c, saved);
}

EXPORT Status fmi3FreeFMUState(Instance c, void **saved) {
    REQUIRE(ANY, "fmi3FreeFMUState");
    return unit_forget(c, saved);
}

EXPORT Status fmi3SerializedFMUStateSize(Instance c, void *saved, size_t *size) {
    (void)saved;
    REQUIRE(ANY, "fmi3SerializedFMUStateSize");
    if (size == NULL) return unit_fail(c, "fmi3SerializedFMUStateSize: no place for the size");
    *size = unit_serialized_size();
    return OK;
}

EXPORT Status fmi3SerializeFMUState(Instance c, void *saved, unsigned char bytes[], size_t size) {
    REQUIRE(ANY, "fmi3SerializeFMUState");
    return unit_serialize(c, saved, bytes, size);
}

EXPORT Status fmi3DeserializeFMUState(Instance c, const unsigned char bytes[], size_t size, void **saved) {
    REQUIRE(ANY, "fmi3DeserializeFMUState");
    return unit_deserialize(c, bytes, size, saved);
}

EXPORT Status fmi3DoStep(Instance c, double t, double length, bool is_not_before, bool *is_event, bool *is_terminating,
                         bool *is_early, double *last) {
    (void)is_not_before;
    REQUIRE(STEPPING, "fmi3DoStep");
    if (is_event == NULL || is_terminating == NULL || is_early == NULL || last == NULL)
        return unit_fail(c, "fmi3DoStep: no place for the answers");
    *is_event = *is_terminating = *is_early = false;
    Status status = unit_step(c, t, length);
    *last = c->now.reals[TIME_AT];
    return status;
}

/* What the unit does not offer, as its modelDescription.xml says */
#define REFUSE(name, ...)                                                                                              \
    EXPORT Status name(Instance c, __VA_ARGS__) {                                                                      \
        REQUIRE(ANY, #name);                                                                                           \
        return unit_fail(c, #name ": not offered by this unit");                                                       \
    }
#define REFUSE_CALL(name)                                                                                              \
    EXPORT Status name(Instance c) {                                                                                   \
        REQUIRE(ANY, #name);                                                                                           \
        return unit_fail(c, #name ": not offered by this unit");                                                       \
    }
#define REFUSE_TYPE(name, type)                                                                                        \
    REFUSE(fmi3Get##name, NAMES r, size_t n, type *v, size_t nv)                                                       \
    REFUSE(fmi3Set##name, NAMES r, size_t n, const type *v, size_t nv)
REFUSE_TYPE(Float32, float)
REFUSE_TYPE(Int8, int8_t)
REFUSE_TYPE(UInt8, uint8_t)
REFUSE_TYPE(Int16, int16_t)
REFUSE_TYPE(UInt16, uint16_t)
REFUSE_TYPE(UInt32, uint32_t)
REFUSE_TYPE(Int64, int64_t)
REFUSE_TYPE(UInt64, uint64_t)
REFUSE_TYPE(String, String)
REFUSE(fmi3GetBinary, NAMES r, size_t n, size_t *sizes, const unsigned char **v, size_t nv)
REFUSE(fmi3SetBinary, NAMES r, size_t n, const size_t *sizes, const unsigned char **v, size_t nv)
REFUSE(fmi3GetClock, NAMES r, size_t n, bool *v)
REFUSE(fmi3SetClock, NAMES r, size_t n, const bool *v)
REFUSE(fmi3GetNumberOfVariableDependencies, uint32_t r, size_t *n)
REFUSE(fmi3GetVariableDependencies, uint32_t r, size_t *i, uint32_t *on, size_t *j, int *kinds, size_t n)
REFUSE(fmi3GetDirectionalDerivative, NAMES u, size_t nu, NAMES k, size_t nk, const double *s, size_t ns, double *d, size_t nd)
REFUSE(fmi3GetAdjointDerivative, NAMES u, size_t nu, NAMES k, size_t nk, const double *s, size_t ns, double *d, size_t nd)
REFUSE_CALL(fmi3EnterConfigurationMode)
REFUSE_CALL(fmi3ExitConfigurationMode)
REFUSE_CALL(fmi3EnterEventMode)
REFUSE_CALL(fmi3EnterStepMode)
REFUSE_CALL(fmi3EnterContinuousTimeMode)
REFUSE_CALL(fmi3EvaluateDiscreteStates)
REFUSE(fmi3GetIntervalDecimal, NAMES r, size_t n, double *v, int *qualifiers)
REFUSE(fmi3GetIntervalFraction, NAMES r, size_t n, uint64_t *counters, uint64_t *resolutions, int *qualifiers)
REFUSE(fmi3GetShiftDecimal, NAMES r, size_t n, double *v)
REFUSE(fmi3GetShiftFraction, NAMES r, size_t n, uint64_t *counters, uint64_t *resolutions)
REFUSE(fmi3SetIntervalDecimal, NAMES r, size_t n, const double *v)
REFUSE(fmi3SetIntervalFraction, NAMES r, size_t n, const uint64_t *counters, const uint64_t *resolutions)
REFUSE(fmi3SetShiftDecimal, NAMES r, size_t n, const double *v)
REFUSE(fmi3SetShiftFraction, NAMES r, size_t n, const uint64_t *counters, const uint64_t *resolutions)
REFUSE(fmi3UpdateDiscreteStates, bool *a, bool *b, bool *c1, bool *d, bool *e, double *t)
REFUSE(fmi3CompletedIntegratorStep, bool no_set, bool *a, bool *b)
REFUSE(fmi3SetTime, double t)
REFUSE(fmi3SetContinuousStates, const double *v, size_t n)
REFUSE(fmi3GetContinuousStateDerivatives, double *v, size_t n)
REFUSE(fmi3GetEventIndicators, double *v, size_t n)
REFUSE(fmi3GetContinuousStates, double *v, size_t n)
REFUSE(fmi3GetNominalsOfContinuousStates, double *v, size_t n)
REFUSE(fmi3GetNumberOfEventIndicators, size_t *n)
REFUSE(fmi3GetNumberOfContinuousStates, size_t *n)
REFUSE(fmi3GetOutputDerivatives, NAMES r, size_t n, const int32_t *orders, double *v, size_t nv)
REFUSE(fmi3ActivateModelPartition, uint32_t clock, double t)
