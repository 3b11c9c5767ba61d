/* FMI 3.0 for co-simulation: what differs from FMI 2.0. The signatures are those of the standard. */

#include <stdbool.h>

/* an infinite parameter: XML of FMI 3.0 can contain infinity */
#define INFINITE HUGE_VAL

#include "fmu_core.h"

#define FMI(name) fmi3##name
#define VERSION "3.0"
#define GET_NUMBERS fmi3GetFloat64
#define SET_NUMBERS fmi3SetFloat64
#define GET_WHOLE fmi3GetUInt32
#define GET_STATE fmi3GetFMUState
#define SET_STATE fmi3SetFMUState
#define FREE_STATE fmi3FreeFMUState
/* an array of values has a length of its own */
#define LENGTH , size_t length
#define MOST length

typedef bool bool_t;
typedef uint32_t whole_t;
typedef void (*log_t)(environment_t environment, status_t status, const char *category, const char *message);
typedef void (*intermediate_t)(environment_t, double, bool, bool, bool, bool, bool *, double *);
typedef struct {
    environment_t environment;
    log_t log;
} logger_t;

static void log_error(const logger_t *logger, const char *message)
{
    if (logger->log != NULL) {
        logger->log(logger->environment, ERROR, "logStatusError", message);
    }
}

#include "fmu_functions.h"

EXPORTED instance_t fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging, bool events, bool early,
    const reference_t intermediate[], size_t count, environment_t environment, log_t log, intermediate_t update)
{
    const logger_t logger = {environment, log};
    (void)name, (void)resources, (void)visible, (void)early, (void)intermediate, (void)count, (void)update;
    if (events || token == NULL || strcmp(token, MODEL_TOKEN) != 0) {
        log_error(&logger, events ? "there is no event mode" : "wrong instantiation token");
        return NULL;
    }
    return create(logger, logging);
}

EXPORTED instance_t fmi3InstantiateModelExchange(
    const char *name, const char *token, const char *resources, bool visible, bool logging, environment_t environment,
    log_t log)
{
    const logger_t logger = {environment, log};
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    log_error(&logger, "this FMU is for co-simulation");
    return NULL;
}

EXPORTED instance_t fmi3InstantiateScheduledExecution(
    const char *name, const char *token, const char *resources, bool visible, bool logging, environment_t environment,
    log_t log, void (*update)(void), void (*lock)(void), void (*unlock)(void))
{
    (void)update, (void)lock, (void)unlock;
    return fmi3InstantiateModelExchange(name, token, resources, visible, logging, environment, log);
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

EXPORTED status_t fmi3DoStep(
    instance_t instance, double now, double step, bool no_return, bool *event, bool *terminate, bool *early, double *last)
{
    const status_t status = do_step(instance, now, step);
    (void)no_return;
    *event = *terminate = *early = false;
    *last = ((fmu *)instance)->block.time;
    return status;
}

#define ABSENT_NUMBERS(name, type) \
    ABSENT(fmi3Get##name, const reference_t *a, size_t b, type *c, size_t d) \
    ABSENT(fmi3Set##name, const reference_t *a, size_t b, const type *c, size_t d)

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
