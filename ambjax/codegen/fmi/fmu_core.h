/* An instance of an exported block, independent of the version of FMI. model.h describes the block. */

#ifndef FMU_CORE_H
#define FMU_CORE_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORTED __attribute__((visibility("default")))
#else
#define EXPORTED
#endif

/* Types of the standard (fmi-standard.org), with names of their own. */
typedef void *instance_t;
typedef void *environment_t;
typedef void *saved_t;
typedef uint32_t reference_t;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status_t;

/* Value references: time, then the numbers of the block in this order, then the status bits. */
enum {
    FIRST_INPUT = 1,
    FIRST_OUTPUT = FIRST_INPUT + MODEL_INPUTS,
    FIRST_PARAMETER = FIRST_OUTPUT + MODEL_OUTPUTS,
    FIRST_STATE = FIRST_PARAMETER + MODEL_PARAMETERS,
    STATUS = FIRST_STATE + MODEL_STATES
};

enum mode { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };

/* The structs of a block consist of doubles; the state has a flag behind them. */
typedef struct {
    union { model_params named; double numbers[MODEL_PARAMETERS]; } params;
    union { model_state named; double numbers[MODEL_STATES]; } state;
    union { model_input named; double numbers[MODEL_INPUTS]; } input;
    union { model_output named; double numbers[MODEL_OUTPUTS]; } output;
    double time;
    uint32_t status;
    enum mode mode;
} numbers;

/* Largest relative difference of a communication step from whole periods. */
#define STEP_TOLERANCE 1e-6

static void core_reset(numbers *x)
{
    memset(x, 0, sizeof *x);
    x->params.named = model_default;
    model_init(&x->state.named);
    x->mode = INSTANTIATED;
}

/* Compute one sample of the block. */
static void core_sample(numbers *x)
{
    x->status = model_step(&x->params.named, &x->state.named, &x->input.named, &x->output.named);
}

/* Compute the outputs at the start time. A plant reads its sensors there; a controller waits for its first step. */
static void core_begin(numbers *x)
{
    if (MODEL_READS_AT_START) {
        model_init(&x->state.named);
        core_sample(x);
    }
}

/* Return the number of periods in a communication step, or 0 if it is not a whole number. */
static long core_periods(double step)
{
    const double count = floor(step / MODEL_PERIOD + 0.5);
    if (!(count >= 1.0) || count > 1e6 || fabs(step - count * MODEL_PERIOD) > STEP_TOLERANCE * MODEL_PERIOD) {
        return 0;
    }
    return (long)count;
}

/* Return 0 if the communication step is not a whole number of periods. */
static int core_do_step(numbers *x, double now, double step)
{
    const long count = core_periods(step);
    for (long n = 0; n < count; n++) {
        core_sample(x);
    }
    x->time = count > 0 ? now + step : x->time;
    return count > 0;
}

/* Return the address of a number that may be read, or NULL. The status bits are a whole number of their own, but some
 * tools read every output as a real number: `core_get`. */
static const double *core_number(numbers *x, uint32_t reference)
{
    if (reference == 0) {
        return &x->time;
    }
    if (reference < FIRST_OUTPUT) {
        return &x->input.numbers[reference - FIRST_INPUT];
    }
    if (reference < FIRST_PARAMETER) {
        return &x->output.numbers[reference - FIRST_OUTPUT];
    }
    if (reference < FIRST_STATE) {
        return &x->params.numbers[reference - FIRST_PARAMETER];
    }
    return reference < STATUS ? &x->state.numbers[reference - FIRST_STATE] : NULL;
}

/* Read a number. Return 0 if there is no such number. While initializing, outputs follow inputs and parameters. */
static int core_get(numbers *x, uint32_t reference, double *value)
{
    const double *found = core_number(x, reference);
    if (found == NULL && reference != STATUS) {
        return 0;
    }
    if (x->mode == INITIALIZING && reference >= FIRST_OUTPUT) {
        core_begin(x);
    }
    *value = found == NULL ? (double)x->status : *found;
    return 1;
}

/* Return whether a parameter may have a value, which NaN never is. */
static int core_allows(uint32_t parameter, double value)
{
    if (value >= INFINITE && model_infinite[parameter]) {
        return 1;
    }
    if (model_whole[parameter] && floor(value) != value) {
        return 0;
    }
    return value >= model_least[parameter] && value <= model_most[parameter];
}

/* Write an input or a parameter. Return 0 for any other number, and for a parameter outside its min and max, or
 * that must be whole and is not. An input may be NaN: the block reports it in its status. */
static int core_set(numbers *x, uint32_t reference, double value)
{
    if (reference >= FIRST_INPUT && reference < FIRST_OUTPUT) {
        x->input.numbers[reference - FIRST_INPUT] = value;
        return 1;
    }
    if (reference >= FIRST_PARAMETER && reference < FIRST_STATE) {
        const uint32_t at = reference - FIRST_PARAMETER;
        if (!core_allows(at, value)) {
            return 0;
        }
        x->params.numbers[at] = value;
        return 1;
    }
    return 0;
}

#endif
