/* A unit of another tool: a slide with a motor, x'' = (k u - load)/m - d x', in steps of whatever length; position
 * in mm. It misbehaves as the macros say: CRASH, HANG, REFUSE, GIVE_NAN, END (number of the step),
 * EVENT_MODE, TOKEN (refuses it in silence) and DIVERGE (where k is above 4). */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifndef STEP_THAT
#define STEP_THAT -1
#endif
enum { NOTHING, CRASH, HANG, REFUSE, GIVE_NAN, END, EVENT_MODE, TOKEN, DIVERGE };
#ifndef DOES
#define DOES NOTHING
#endif

typedef struct { double u, load, x, v, k, d; int32_t steps, is_big; void *environment; void (*logger)(void); } Slide;

static Slide *create(void *environment, void (*logger)(void)) {
    Slide *s = calloc(1, sizeof *s);
    s->k = 2.0, s->d = 5.0, s->environment = environment, s->logger = logger;
    return s;
}

static int reset(Slide *s) {
    s->u = s->load = s->x = s->v = 0.0, s->k = 2.0, s->d = 5.0, s->steps = s->is_big = 0;
    return 0;
}

static double *find(Slide *s, uint32_t reference) {
    double *const places[] = {NULL, &s->u, &s->load, &s->x, &s->k, &s->d};
    return reference >= 1 && reference <= 5 ? places[reference] : NULL;
}

static void say(Slide *s, int status, const char *text);

static int step(Slide *s, double h) {
    double mass = s->is_big ? 10.0 : 1.0;
    if (s->steps++ == STEP_THAT) {
        if (DOES == CRASH) say(s, 1, "about to fail"), *(volatile int *)0 = 1;
        if (DOES == HANG) for (;;) pause();
        if (DOES == REFUSE) return say(s, 3, "the solver did not converge"), 3;
        if (DOES == GIVE_NAN) s->x = NAN;
    }
    if (DOES == DIVERGE && s->k > 4.0) s->x = NAN;
    s->v += h * ((s->k * s->u - s->load) / mass - s->d * s->v);
    s->x += h * s->v * 1e3;
    return 0;
}

#ifdef FMI3
typedef void (*Logger)(void *, int, const char *, const char *);
static void say(Slide *s, int status, const char *text) {
    if (s->logger) ((Logger)s->logger)(s->environment, status, "all", text);
}
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool logging,
                                  bool has_events, bool early, const uint32_t *r, size_t n, void *environment,
                                  void (*logger)(void), void (*update)(void)) {
    if (DOES == EVENT_MODE && !has_events) {
        if (logger) ((Logger)logger)(environment, 3, "all", "this unit needs event mode");
        return NULL;
    }
    return DOES == TOKEN ? NULL : create(environment, logger);
}
void fmi3FreeInstance(Slide *s) { free(s); }
int fmi3EnterInitializationMode(Slide *s, bool a, double b, double c, bool d, double e) { return 0; }
int fmi3ExitInitializationMode(Slide *s) { return 0; }
int fmi3Terminate(Slide *s) { return 0; }
int fmi3Reset(Slide *s) { return reset(s); }
int fmi3GetFloat64(Slide *s, const uint32_t *r, size_t n, double *v, size_t nv) {
    for (size_t i = 0; i < n; i++) v[i] = *find(s, r[i]);
    return 0;
}
int fmi3SetFloat64(Slide *s, const uint32_t *r, size_t n, const double *v, size_t nv) {
    for (size_t i = 0; i < n; i++) *find(s, r[i]) = v[i];
    return 0;
}
int fmi3SetBoolean(Slide *s, const uint32_t *r, size_t n, const bool *v, size_t nv) { s->is_big = v[0]; return 0; }
int fmi3DoStep(Slide *s, double t, double h, bool a, bool *is_event, bool *is_end, bool *is_early, double *last) {
    *is_event = *is_early = false;
    *is_end = DOES == END && s->steps == STEP_THAT;
    *last = t + h;
    return step(s, h);
}
#else
typedef struct { void (*logger)(void); void *a, *b, *c; void *environment; } Callbacks;
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
static void say(Slide *s, int status, const char *text) {
    if (s->logger) ((Logger)s->logger)(s->environment, "slide", status, "all", "%s", text);
}
const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const Callbacks *c, int visible,
                      int logging) { return create(c ? c->environment : NULL, c ? c->logger : NULL); }
void fmi2FreeInstance(Slide *s) { free(s); }
int fmi2SetupExperiment(Slide *s, int a, double b, double c, int d, double e) { return 0; }
int fmi2EnterInitializationMode(Slide *s) { return 0; }
int fmi2ExitInitializationMode(Slide *s) { return 0; }
int fmi2Terminate(Slide *s) { return 0; }
int fmi2Reset(Slide *s) { return reset(s); }
int fmi2GetReal(Slide *s, const uint32_t *r, size_t n, double *v) {
    for (size_t i = 0; i < n; i++) v[i] = *find(s, r[i]);
    return 0;
}
int fmi2SetReal(Slide *s, const uint32_t *r, size_t n, const double *v) {
    for (size_t i = 0; i < n; i++) *find(s, r[i]) = v[i];
    return 0;
}
int fmi2SetBoolean(Slide *s, const uint32_t *r, size_t n, const int *v) { s->is_big = v[0]; return 0; }
int fmi2DoStep(Slide *s, double t, double h, int a) { return step(s, h); }
#endif
