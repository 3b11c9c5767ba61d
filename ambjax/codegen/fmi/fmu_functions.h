/* The functions that FMI 2.0 and FMI 3.0 share. fmi2.c and fmi3.c define their names and what else differs. */

#ifndef FMU_FUNCTIONS_H
#define FMU_FUNCTIONS_H

typedef struct {
    numbers block;
    bool_t logging;
    logger_t logger;
} fmu;

/* Log why a call fails. */
static status_t fail(const fmu *one, const char *message)
{
    if (one->logging) {
        log_error(&one->logger, message);
    }
    return ERROR;
}

/* --- creation and modes --- */

EXPORTED const char *FMI(GetVersion)(void)
{
    return VERSION;
}

/* Return a new instance, or NULL if there is no memory left. */
static fmu *create(logger_t logger, bool_t logging)
{
    fmu *one = malloc(sizeof *one);
    if (one != NULL) {
        core_reset(&one->block);
        one->logger = logger;
        one->logging = logging;
    }
    return one;
}

EXPORTED void FMI(FreeInstance)(instance_t instance)
{
    free(instance);
}

EXPORTED status_t FMI(SetDebugLogging)(instance_t instance, bool_t on, size_t count, const char *const categories[])
{
    (void)count, (void)categories;
    ((fmu *)instance)->logging = on;
    return OK;
}

EXPORTED status_t FMI(ExitInitializationMode)(instance_t instance)
{
    fmu *one = instance;
    core_begin(&one->block);
    one->block.mode = STEPPING;
    return OK;
}

EXPORTED status_t FMI(Terminate)(instance_t instance)
{
    ((fmu *)instance)->block.mode = TERMINATED;
    return OK;
}

EXPORTED status_t FMI(Reset)(instance_t instance)
{
    core_reset(&((fmu *)instance)->block);
    return OK;
}

static status_t do_step(fmu *one, double now, double step)
{
    if (one->block.mode != STEPPING || !core_do_step(&one->block, now, step)) {
        return fail(one, "the communication step must be a whole number of sample periods, after initialization");
    }
    return OK;
}

/* --- values --- */

EXPORTED status_t GET_NUMBERS(instance_t instance, const reference_t references[], size_t count, double values[] LENGTH)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= MOST || !core_get(&one->block, references[k], &values[k])) {
            return fail(one, "there is no number with this value reference");
        }
    }
    return OK;
}

EXPORTED status_t SET_NUMBERS(
    instance_t instance, const reference_t references[], size_t count, const double values[] LENGTH)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= MOST || !core_set(&one->block, references[k], values[k])) {
            return fail(one, "only inputs and parameters may be set, a parameter to a number from its min to its max, "
                             "and to a whole number if its description says so");
        }
    }
    return OK;
}

EXPORTED status_t GET_WHOLE(instance_t instance, const reference_t references[], size_t count, whole_t values[] LENGTH)
{
    fmu *one = instance;
    for (size_t k = 0; k < count; k++) {
        if (k >= MOST || references[k] != STATUS) {
            return fail(one, "there is no whole number with this value reference");
        }
        if (one->block.mode == INITIALIZING) {
            core_begin(&one->block);
        }
        values[k] = (whole_t)one->block.status;
    }
    return OK;
}

/* --- saved states --- */

EXPORTED status_t GET_STATE(instance_t instance, saved_t *saved)
{
    if (*saved == NULL) {
        *saved = malloc(sizeof(numbers));
    }
    if (*saved == NULL) {
        return fail(instance, "there is no memory left");
    }
    memcpy(*saved, &((fmu *)instance)->block, sizeof(numbers));
    return OK;
}

EXPORTED status_t SET_STATE(instance_t instance, saved_t saved)
{
    memcpy(&((fmu *)instance)->block, saved, sizeof(numbers));
    return OK;
}

EXPORTED status_t FREE_STATE(instance_t instance, saved_t *saved)
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
        return fail(instance, #name ": this FMU has no such function"); \
    }
#define ABSENT_ALONE(name) \
    EXPORTED status_t name(instance_t instance) \
    { \
        return fail(instance, #name ": this FMU has no such function"); \
    }

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#endif
