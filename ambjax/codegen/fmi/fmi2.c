/* FMI 2.0 for co-simulation. The signatures are those of the standard; types have names of their own. */

#include "fmi2_interface.h"
#include "fmu_core.h"

enum { CO_SIMULATION = 1 };

typedef struct {
    numbers block;
    const callbacks_t *callbacks;
    bool_t logging;
    char name[128];
} fmu;

static status_t said(const fmu *one, status_t status, const char *message)
{
    if (one->callbacks->log != NULL && one->logging) {
        one->callbacks->log(one->callbacks->environment, one->name, status, "logStatusError", "%s", message);
    }
    return status;
}

/* --- creation and modes --- */

EXPORTED const char *fmi2GetVersion(void)
{
    return "2.0";
}

EXPORTED const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORTED instance_t fmi2Instantiate(
    const char *name, int type, const char *token, const char *resources, const callbacks_t *callbacks, bool_t visible,
    bool_t logging)
{
    fmu *one;
    (void)resources, (void)visible;
    if (callbacks == NULL || type != CO_SIMULATION || token == NULL || strcmp(token, MODEL_TOKEN) != 0) {
        return NULL;
    }
    one = calloc(1, sizeof *one);
    if (one != NULL) {
        core_reset(&one->block);
        one->callbacks = callbacks;
        one->logging = logging;
        strncpy(one->name, name == NULL ? "" : name, sizeof one->name - 1);
    }
    return one;
}

EXPORTED void fmi2FreeInstance(instance_t instance)
{
    free(instance);
}

EXPORTED status_t fmi2SetDebugLogging(instance_t instance, bool_t on, size_t count, const char *const categories[])
{
    (void)count, (void)categories;
    ((fmu *)instance)->logging = on;
    return OK;
}

EXPORTED status_t fmi2SetupExperiment(
    instance_t instance, bool_t has_tolerance, double tolerance, double start, bool_t has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((fmu *)instance)->block.time = start;
    return OK;
}

EXPORTED status_t fmi2EnterInitializationMode(instance_t instance)
{
    ((fmu *)instance)->block.mode = INITIALIZING;
    return OK;
}

EXPORTED status_t fmi2ExitInitializationMode(instance_t instance)
{
    fmu *one = instance;
    core_begin(&one->block);
    one->block.mode = STEPPING;
    return OK;
}

EXPORTED status_t fmi2Terminate(instance_t instance)
{
    ((fmu *)instance)->block.mode = TERMINATED;
    return OK;
}

EXPORTED status_t fmi2Reset(instance_t instance)
{
    core_reset(&((fmu *)instance)->block);
    return OK;
}

EXPORTED status_t fmi2DoStep(instance_t instance, double now, double step, bool_t keep)
{
    fmu *one = instance;
    (void)keep;
    if (one->block.mode != STEPPING || !core_do_step(&one->block, now, step)) {
        return said(one, ERROR, "the communication step must be a whole number of sample periods, after initialization");
    }
    return OK;
}

/* --- values --- */

EXPORTED status_t fmi2GetReal(instance_t instance, const reference_t references[], size_t count, double values[])
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (!core_get(&one->block, references[k], &values[k])) {
            return said(one, ERROR, "there is no number with this value reference");
        }
    }
    return OK;
}

EXPORTED status_t fmi2SetReal(instance_t instance, const reference_t references[], size_t count, const double values[])
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (!core_set(&one->block, references[k], values[k])) {
            return said(one, ERROR, "only inputs and parameters may be set, a parameter to a number from its min to its max");
        }
    }
    return OK;
}

EXPORTED status_t fmi2GetInteger(instance_t instance, const reference_t references[], size_t count, int values[])
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (references[k] != STATUS) {
            return said(one, ERROR, "there is no whole number with this value reference");
        }
        if (one->block.mode == INITIALIZING) {
            core_begin(&one->block);
        }
        values[k] = (int)one->block.status;
    }
    return OK;
}

/* --- saved states --- */

EXPORTED status_t fmi2GetFMUstate(instance_t instance, saved_t *saved)
{
    if (*saved == NULL) {
        *saved = malloc(sizeof(numbers));
    }
    if (*saved == NULL) {
        return said(instance, ERROR, "there is no memory left");
    }
    memcpy(*saved, &((fmu *)instance)->block, sizeof(numbers));
    return OK;
}

EXPORTED status_t fmi2SetFMUstate(instance_t instance, saved_t saved)
{
    memcpy(&((fmu *)instance)->block, saved, sizeof(numbers));
    return OK;
}

EXPORTED status_t fmi2FreeFMUstate(instance_t instance, saved_t *saved)
{
    (void)instance;
    if (saved != NULL) {
        free(*saved);
        *saved = NULL;
    }
    return OK;
}

/* --- the rest of the interface, which this FMU does not have --- */

#define ABSENT(name, ...) \
    EXPORTED status_t name(instance_t instance, __VA_ARGS__) \
    { \
        return said(instance, ERROR, #name ": this FMU has no such function"); \
    }

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

ABSENT(fmi2GetBoolean, const reference_t *a, size_t b, bool_t *c)
ABSENT(fmi2GetString, const reference_t *a, size_t b, const char **c)
ABSENT(fmi2SetInteger, const reference_t *a, size_t b, const int *c)
ABSENT(fmi2SetBoolean, const reference_t *a, size_t b, const bool_t *c)
ABSENT(fmi2SetString, const reference_t *a, size_t b, const char *const *c)
ABSENT(fmi2SerializedFMUstateSize, saved_t a, size_t *b)
ABSENT(fmi2SerializeFMUstate, saved_t a, char *b, size_t c)
ABSENT(fmi2DeSerializeFMUstate, const char *a, size_t b, saved_t *c)
ABSENT(fmi2GetDirectionalDerivative, const reference_t *a, size_t b, const reference_t *c, size_t d, const double *e,
       double *f)
ABSENT(fmi2SetRealInputDerivatives, const reference_t *a, size_t b, const int *c, const double *d)
ABSENT(fmi2GetRealOutputDerivatives, const reference_t *a, size_t b, const int *c, double *d)
ABSENT(fmi2GetStatus, int a, status_t *b)
ABSENT(fmi2GetRealStatus, int a, double *b)
ABSENT(fmi2GetIntegerStatus, int a, int *b)
ABSENT(fmi2GetBooleanStatus, int a, bool_t *b)
ABSENT(fmi2GetStringStatus, int a, const char **b)

EXPORTED status_t fmi2CancelStep(instance_t instance)
{
    return said(instance, ERROR, "fmi2CancelStep: this FMU has no such function");
}
