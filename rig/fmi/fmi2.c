/* FMI 2.0 for co-simulation (fmi-standard.org, section 4.2): every function of the interface. */
#include "unit.h"

#include <string.h>

typedef Unit *Component;
typedef const char *String;
typedef void (*Logger)(void *environment, String name, int status, String category, String message, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
} Callbacks;

enum { CO_SIMULATION = 1, ANY = INSTANTIATED | INITIALISING | STEPPING | TERMINATED | FAILED };
enum { READABLE = INITIALISING | STEPPING | TERMINATED | FAILED, WRITABLE = INSTANTIATED | INITIALISING | STEPPING };
#define REQUIRE(phases, name) if (!unit_allows(c, phases, name)) return ERROR

static void log_message(Unit *u, Status status, const char *message) {
    ((Logger)u->logger)(u->environment, u->name, status, "logStatusError", "%s", message);
}

EXPORT String fmi2GetTypesPlatform(void) { return "default"; }
EXPORT String fmi2GetVersion(void) { return "2.0"; }

EXPORT Status fmi2SetDebugLogging(Component c, int on, size_t n, const String categories[]) {
    REQUIRE(ANY, "fmi2SetDebugLogging");
    for (size_t i = 0; i < n; i++)
        if (categories == NULL || categories[i] == NULL || strcmp(categories[i], "logStatusError") != 0)
            return unit_fail(c, "fmi2SetDebugLogging: unknown category");
    c->is_logging = on;
    return OK;
}

EXPORT Component fmi2Instantiate(String name, int type, String guid, String resources, const Callbacks *functions,
                                 int visible, int is_logging) {
    (void)resources, (void)visible;
    Unit first = {.is_logging = is_logging};
    if (functions != NULL) {
        first.environment = functions->environment;
        first.logger = (void (*)(void))functions->logger;
        first.log = log_message;
    }
    Component c = unit_create(name, guid, TOKEN, first);
    if (c != NULL && type != CO_SIMULATION) {
        unit_fail(c, "fmi2Instantiate: this unit is for co-simulation");
        unit_free(c);
        return NULL;
    }
    return c;
}

EXPORT void fmi2FreeInstance(Component c) { unit_free(c); }

EXPORT Status fmi2SetupExperiment(Component c, int is_tolerance, double tolerance, double start, int is_stop, double stop) {
    (void)is_tolerance, (void)tolerance, (void)is_stop, (void)stop;
    REQUIRE(INSTANTIATED, "fmi2SetupExperiment");
    if (!(start - start == 0)) return unit_fail(c, "fmi2SetupExperiment: the start time must be finite");
    c->now.start = start;
    return OK;
}

EXPORT Status fmi2EnterInitializationMode(Component c) {
    REQUIRE(INSTANTIATED, "fmi2EnterInitializationMode");
    c->now.phase = INITIALISING;
    return OK;
}

EXPORT Status fmi2ExitInitializationMode(Component c) {
    REQUIRE(INITIALISING, "fmi2ExitInitializationMode");
    return unit_exit_initialisation(c);
}

EXPORT Status fmi2Terminate(Component c) {
    REQUIRE(STEPPING, "fmi2Terminate");
    c->now.phase = TERMINATED;
    return OK;
}

EXPORT Status fmi2Reset(Component c) {
    REQUIRE(ANY, "fmi2Reset");
    return unit_reset(c);
}

#define ACCESS(name, kind, type)                                                                                       \
    EXPORT Status fmi2Get##name(Component c, const uint32_t r[], size_t n, type v[]) {                                 \
        REQUIRE(READABLE, "fmi2Get" #name);                                                                            \
        return unit_get(c, kind, r, n, v);                                                                             \
    }                                                                                                                  \
    EXPORT Status fmi2Set##name(Component c, const uint32_t r[], size_t n, const type v[]) {                           \
        REQUIRE(WRITABLE, "fmi2Set" #name);                                                                            \
        return unit_set(c, kind, r, n, v);                                                                             \
    }
ACCESS(Real, REAL, double)
ACCESS(Integer, INTEGER, int32_t)
ACCESS(Boolean, BOOLEAN, int32_t)

EXPORT Status fmi2GetString(Component c, const uint32_t r[], size_t n, String v[]) {
    (void)r, (void)v;
    REQUIRE(READABLE, "fmi2GetString");
    return n == 0 ? OK : unit_fail(c, "fmi2GetString: the unit has no strings");
}

EXPORT Status fmi2SetString(Component c, const uint32_t r[], size_t n, const String v[]) {
    (void)r, (void)v;
    REQUIRE(WRITABLE, "fmi2SetString");
    return n == 0 ? OK : unit_fail(c, "fmi2SetString: the unit has no strings");
}

EXPORT Status fmi2GetFMUstate(Component c, void **saved) {
    REQUIRE(ANY, "fmi2GetFMUstate");
    return unit_save(c, saved);
}

EXPORT Status fmi2SetFMUstate(Component c, void *saved) {
    REQUIRE(ANY, "fmi2SetFMUstate");
    return unit_restore(c, saved);
}

EXPORT Status fmi2FreeFMUstate(Component c, void **saved) {
    REQUIRE(ANY, "fmi2FreeFMUstate");
    return unit_forget(c, saved);
}

EXPORT Status fmi2SerializedFMUstateSize(Component c, void *saved, size_t *size) {
    (void)saved;
    REQUIRE(ANY, "fmi2SerializedFMUstateSize");
    if (size == NULL) return unit_fail(c, "fmi2SerializedFMUstateSize: no place for the size");
    *size = unit_serialized_size();
    return OK;
}

EXPORT Status fmi2SerializeFMUstate(Component c, void *saved, char bytes[], size_t size) {
    REQUIRE(ANY, "fmi2SerializeFMUstate");
    return unit_serialize(c, saved, (unsigned char *)bytes, size);
}

EXPORT Status fmi2DeSerializeFMUstate(Component c, const char bytes[], size_t size, void **saved) {
    REQUIRE(ANY, "fmi2DeSerializeFMUstate");
    return unit_deserialize(c, (const unsigned char *)bytes, size, saved);
}

EXPORT Status fmi2DoStep(Component c, double t, double length, int is_not_before) {
    (void)is_not_before;
    REQUIRE(STEPPING, "fmi2DoStep");
    return unit_step(c, t, length);
}

/* What the unit does not offer, as its modelDescription.xml says */
#define REFUSE(name, ...)                                                                                              \
    EXPORT Status name(Component c, __VA_ARGS__) {                                                                     \
        REQUIRE(ANY, #name);                                                                                           \
        return unit_fail(c, #name ": not offered by this unit");                                                       \
    }
#define NAMES const uint32_t *
REFUSE(fmi2GetDirectionalDerivative, NAMES u, size_t nu, NAMES k, size_t nk, const double *dk, double *du)
REFUSE(fmi2SetRealInputDerivatives, NAMES r, size_t n, const int32_t *order, const double *v)
REFUSE(fmi2GetRealOutputDerivatives, NAMES r, size_t n, const int32_t *order, double *v)
REFUSE(fmi2GetStatus, int kind, int *value)
REFUSE(fmi2GetRealStatus, int kind, double *value)
REFUSE(fmi2GetIntegerStatus, int kind, int32_t *value)
REFUSE(fmi2GetBooleanStatus, int kind, int32_t *value)
REFUSE(fmi2GetStringStatus, int kind, String *value)

EXPORT Status fmi2CancelStep(Component c) {
    REQUIRE(ANY, "fmi2CancelStep");
    return unit_fail(c, "fmi2CancelStep: no step is in progress");
}
