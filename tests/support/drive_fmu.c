/* Drives an FMI 2.0 unit without any interpreter: demands from standard input, rows of its outputs in hexadecimal.
 *
 *     drive_fmu LIBRARY GUID SEED PERIOD FIRST_OUTPUT OUTPUTS SEED_REFERENCE */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

typedef void *Component;

int main(int count, char **words) {
    if (count != 8) return 2;
    void *library = dlopen(words[1], RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) return fprintf(stderr, "%s\n", dlerror()), 1;
    Component (*instantiate)(const char *, int, const char *, const char *, void *, int, int) = dlsym(library, "fmi2Instantiate");
    int (*setup)(Component, int, double, double, int, double) = dlsym(library, "fmi2SetupExperiment");
    int (*enter)(Component) = dlsym(library, "fmi2EnterInitializationMode");
    int (*leave)(Component) = dlsym(library, "fmi2ExitInitializationMode");
    int (*set_integer)(Component, const unsigned *, size_t, const int *) = dlsym(library, "fmi2SetInteger");
    int (*set_boolean)(Component, const unsigned *, size_t, const int *) = dlsym(library, "fmi2SetBoolean");
    int (*set_real)(Component, const unsigned *, size_t, const double *) = dlsym(library, "fmi2SetReal");
    int (*get_real)(Component, const unsigned *, size_t, double *) = dlsym(library, "fmi2GetReal");
    int (*step)(Component, double, double, int) = dlsym(library, "fmi2DoStep");
    Component c = instantiate("unit", 1, words[2], NULL, NULL, 0, 0);
    int seed = atoi(words[3]), on = 1, first = atoi(words[5]), outputs = atoi(words[6]);
    double period = atof(words[4]), demand, value;
    unsigned command = 1, seed_at = (unsigned)atoi(words[7]), closed_at = seed_at + 1;
    if (c == NULL || set_integer(c, &seed_at, 1, &seed) || set_boolean(c, &closed_at, 1, &on)) return 1;
    if (setup(c, 0, 0, 0, 0, 0) || enter(c) || leave(c)) return 1;
    for (long k = 0; scanf("%lf", &demand) == 1; k++) {
        for (int i = 0; i < outputs; i++) {
            unsigned reference = (unsigned)(first + i);
            if (get_real(c, &reference, 1, &value)) return 1;
            printf("%a ", value);
        }
        printf("\n");
        if (set_real(c, &command, 1, &demand) || step(c, k * period, period, 1)) return 1;
    }
    return 0;
}
