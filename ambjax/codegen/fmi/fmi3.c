/* FMI 3.0 for co-simulation. The signatures are those of the standard; types have names of their own. */

#include "fmi3_interface.h"
#include "fmu_core.h"

typedef struct {
    numbers block;
    environment_t environment;
    log_t log;
    bool logging;
} fmu;

static status_t said(const fmu *one, status_t status, const char *message)
{
    if (one->log != NULL && one->logging) {
        one->log(one->environment, status, "logStatusError", message);
    }
    return status;
}

/* --- creation and modes --- */

EXPORTED const char *fmi3GetVersion(void)
{
    return "3.0";
}

EXPORTED instance_t fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging, bool events, bool early,
    const reference_t intermediate[], size_t count, environment_t environment, log_t log, intermediate_t update)
{
    fmu *one;
    (void)name, (void)resources, (void)visible, (void)early, (void)intermediate, (void)count, (void)update;
    if (events || token == NULL || strcmp(token, MODEL_TOKEN) != 0) {
        if (log != NULL) {
            log(environment, ERROR, "logStatusError", events ? "there is no event mode" : "wrong instantiation token");
        }
        return NULL;
    }
    one = malloc(sizeof *one);
    if (one != NULL) {
        core_reset(&one->block);
        one->environment = environment;
        one->log = log;
        one->logging = logging;
    }
    return one;
}

EXPORTED instance_t fmi3InstantiateModelExchange(
    const char *name, const char *token, const char *resources, bool visible, bool logging, environment_t environment,
    log_t log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    if (log != NULL) {
        log(environment, ERROR, "logStatusError", "this FMU is for co-simulation");
    }
    return NULL;
}

EXPORTED instance_t fmi3InstantiateScheduledExecution(
    const char *name, const char *token, const char *resources, bool visible, bool logging, environment_t environment,
    log_t log, void (*update)(void), void (*lock)(void), void (*unlock)(void))
{
    (void)update, (void)lock, (void)unlock;
    return fmi3InstantiateModelExchange(name, token, resources, visible, logging, environment, log);
}

EXPORTED void fmi3FreeInstance(instance_t instance)
{
    free(instance);
}

EXPORTED status_t fmi3SetDebugLogging(instance_t instance, bool on, size_t count, const char *const categories[])
{
    (void)count, (void)categories;
    ((fmu *)instance)->logging = on;
    return OK;
}

EXPORTED status_t fmi3EnterInitializationMode(
    instance_t instance, bool has_tolerance, double tolerance, double start, bool has_stop, double stop)
{
    fmu *one = instance;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    one->block.time = start;
    one->block.mode = INITIALIZING;
    return OK;
}

EXPORTED status_t fmi3ExitInitializationMode(instance_t instance)
{
    fmu *one = instance;
    core_begin(&one->block);
    one->block.mode = STEPPING;
    return OK;
}

EXPORTED status_t fmi3Terminate(instance_t instance)
{
    ((fmu *)instance)->block.mode = TERMINATED;
    return OK;
}

EXPORTED status_t fmi3Reset(instance_t instance)
{
    core_reset(&((fmu *)instance)->block);
    return OK;
}

EXPORTED status_t fmi3DoStep(
    instance_t instance, double now, double step, bool no_return, bool *event, bool *terminate, bool *early, double *last)
{
    fmu *one = instance;
    (void)no_return;
    *event = *terminate = *early = false;
    if (one->block.mode != STEPPING || !core_do_step(&one->block, now, step)) {
        *last = one->block.time;
        return said(one, ERROR, "the communication step must be a whole number of sample periods, after initialization");
    }
    *last = one->block.time;
    return OK;
}

/* --- values --- */

EXPORTED status_t fmi3GetFloat64(
    instance_t instance, const reference_t references[], size_t count, double values[], size_t length)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= length || !core_get(&one->block, references[k], &values[k])) {
            return said(one, ERROR, "there is no number with this value reference");
        }
    }
    return OK;
}

EXPORTED status_t fmi3SetFloat64(
    instance_t instance, const reference_t references[], size_t count, const double values[], size_t length)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= length || !core_set(&one->block, references[k], values[k])) {
            return said(one, ERROR, "only inputs and parameters may be set, a parameter to a number from its min to its max");
        }
    }
    return OK;
}

EXPORTED status_t fmi3GetUInt32(
    instance_t instance, const reference_t references[], size_t count, uint32_t values[], size_t length)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= length || references[k] != STATUS) {
            return said(one, ERROR, "there is no whole number with this value reference");
        }
        if (one->block.mode == INITIALIZING) {
            core_begin(&one->block);
        }
        values[k] = one->block.status;
    }
    return OK;
}

/* --- saved states --- */

EXPORTED status_t fmi3GetFMUState(instance_t instance, saved_t *saved)
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

EXPORTED status_t fmi3SetFMUState(instance_t instance, saved_t saved)
{
    memcpy(&((fmu *)instance)->block, saved, sizeof(numbers));
    return OK;
}

EXPORTED status_t fmi3FreeFMUState(instance_t instance, saved_t *saved)
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
#define ABSENT_ALONE(name) \
    EXPORTED status_t name(instance_t instance) \
    { \
        return said(instance, ERROR, #name ": this FMU has no such function"); \
    }
#define ABSENT_NUMBERS(name, type) \
    ABSENT(fmi3Get##name, const reference_t *a, size_t b, type *c, size_t d) \
    ABSENT(fmi3Set##name, const reference_t *a, size_t b, const type *c, size_t d)

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

ABSENT_NUMBERS(Float32, float)
ABSENT_NUMBERS(Int8, int8_t)
ABSENT_NUMBERS(UInt8, uint8_t)
ABSENT_NUMBERS(Int16, int16_t)
ABSENT_NUMBERS(UInt16, uint16_t)
ABSENT_NUMBERS(Int32, int32_t)
ABSENT_NUMBERS(Int64, int64_t)
ABSENT_NUMBERS(UInt64, uint64_t)
ABSENT_NUMBERS(Boolean, bool)
ABSENT_NUMBERS(String, char *)
ABSENT(fmi3SetUInt32, const reference_t *a, size_t b, const uint32_t *c, size_t d)
ABSENT(fmi3GetBinary, const reference_t *a, size_t b, size_t *c, const uint8_t **d, size_t e)
ABSENT(fmi3SetBinary, const reference_t *a, size_t b, const size_t *c, const uint8_t **d, size_t e)
ABSENT(fmi3GetClock, const reference_t *a, size_t b, bool *c)
ABSENT(fmi3SetClock, const reference_t *a, size_t b, const bool *c)
ABSENT(fmi3GetNumberOfVariableDependencies, reference_t a, size_t *b)
ABSENT(fmi3GetVariableDependencies, reference_t a, size_t *b, reference_t *c, size_t *d, int *e, size_t f)
ABSENT(fmi3SerializedFMUStateSize, saved_t a, size_t *b)
ABSENT(fmi3SerializeFMUState, saved_t a, uint8_t *b, size_t c)
ABSENT(fmi3DeserializeFMUState, const uint8_t *a, size_t b, saved_t *c)
ABSENT(fmi3GetDirectionalDerivative, const reference_t *a, size_t b, const reference_t *c, size_t d, const double *e,
       size_t f, double *g, size_t h)
ABSENT(fmi3GetAdjointDerivative, const reference_t *a, size_t b, const reference_t *c, size_t d, const double *e,
       size_t f, double *g, size_t h)
ABSENT(fmi3GetOutputDerivatives, const reference_t *a, size_t b, const int32_t *c, double *d, size_t e)
ABSENT(fmi3GetIntervalDecimal, const reference_t *a, size_t b, double *c, int *d)
ABSENT(fmi3GetIntervalFraction, const reference_t *a, size_t b, uint64_t *c, uint64_t *d, int *e)
ABSENT(fmi3GetShiftDecimal, const reference_t *a, size_t b, double *c)
ABSENT(fmi3GetShiftFraction, const reference_t *a, size_t b, uint64_t *c, uint64_t *d)
ABSENT(fmi3SetIntervalDecimal, const reference_t *a, size_t b, const double *c)
ABSENT(fmi3SetIntervalFraction, const reference_t *a, size_t b, const uint64_t *c, const uint64_t *d)
ABSENT(fmi3SetShiftDecimal, const reference_t *a, size_t b, const double *c)
ABSENT(fmi3SetShiftFraction, const reference_t *a, size_t b, const uint64_t *c, const uint64_t *d)
ABSENT(fmi3UpdateDiscreteStates, bool *a, bool *b, bool *c, bool *d, bool *e, double *f)
ABSENT(fmi3CompletedIntegratorStep, bool a, bool *b, bool *c)
ABSENT(fmi3SetTime, double a)
ABSENT(fmi3SetContinuousStates, const double *a, size_t b)
ABSENT(fmi3GetContinuousStateDerivatives, double *a, size_t b)
ABSENT(fmi3GetEventIndicators, double *a, size_t b)
ABSENT(fmi3GetContinuousStates, double *a, size_t b)
ABSENT(fmi3GetNominalsOfContinuousStates, double *a, size_t b)
ABSENT(fmi3GetNumberOfEventIndicators, size_t *a)
ABSENT(fmi3GetNumberOfContinuousStates, size_t *a)
ABSENT(fmi3ActivateModelPartition, reference_t a, double b)
ABSENT_ALONE(fmi3EnterEventMode)
ABSENT_ALONE(fmi3EnterStepMode)
ABSENT_ALONE(fmi3EnterConfigurationMode)
ABSENT_ALONE(fmi3ExitConfigurationMode)
ABSENT_ALONE(fmi3EvaluateDiscreteStates)
ABSENT_ALONE(fmi3EnterContinuousTimeMode)
