/* FMI 2.0 for co-simulation: what differs from FMI 3.0. The signatures are those of the standard. */

/* What stands for an infinite parameter: a value from here on. XML of FMI 2.0 cannot contain infinity. */
#define INFINITE 1e300

#include "fmu_core.h"

#define FMI(name) fmi2##name
#define VERSION "2.0"
#define GET_NUMBERS fmi2GetReal
#define SET_NUMBERS fmi2SetReal
#define GET_WHOLE fmi2GetInteger
#define GET_STATE fmi2GetFMUstate
#define SET_STATE fmi2SetFMUstate
#define FREE_STATE fmi2FreeFMUstate
/* the length of an array of values is the count of its references */
#define LENGTH
#define MOST count

typedef int bool_t;
typedef int whole_t;
typedef struct {
    void (*log)(environment_t environment, const char *name, status_t status, const char *category, const char *text, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*finished)(environment_t environment, status_t status);
    environment_t environment;
} callbacks_t;
typedef struct {
    const callbacks_t *callbacks;
    char name[128];
} logger_t;
enum { CO_SIMULATION = 1 };

static void log_error(const logger_t *logger, const char *message)
{
    const callbacks_t *to = logger->callbacks;
    if (to->log != NULL) {
        to->log(to->environment, logger->name, ERROR, "logStatusError", "%s", message);
    }
}

#include "fmu_functions.h"

EXPORTED const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORTED instance_t fmi2Instantiate(
    const char *name, int type, const char *token, const char *resources, const callbacks_t *callbacks, bool_t visible,
    bool_t logging)
{
    logger_t logger = {callbacks, ""};
    (void)resources, (void)visible;
    if (callbacks == NULL || type != CO_SIMULATION || token == NULL || strcmp(token, MODEL_TOKEN) != 0) {
        return NULL;
    }
    strncpy(logger.name, name == NULL ? "" : name, sizeof logger.name - 1);
    return create(logger, logging);
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

EXPORTED status_t fmi2DoStep(instance_t instance, double now, double step, bool_t keep)
{
    (void)keep;
    return do_step(instance, now, step);
}

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
ABSENT_ALONE(fmi2CancelStep)
