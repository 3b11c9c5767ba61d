/* The block of this FMU, for fmu_core.h. */

#ifndef MODEL_H
#define MODEL_H

#include "{p}.h"

#define MODEL_TOKEN "{token}"
#define MODEL_INPUTS {inputs}
#define MODEL_OUTPUTS {outputs}
#define MODEL_PARAMETERS {parameters}
#define MODEL_STATES {states}
#define MODEL_PERIOD {p}_SAMPLE_PERIOD
/* 1 if the block computes outputs at the start time: a plant and a loop read their sensors there */
#define MODEL_READS_AT_START {reads}

typedef {p}_params model_params;
typedef {p}_state model_state;
typedef {p}_input model_input;
typedef {p}_output model_output;

#define model_default {p}_default
#define model_init {p}_init
#define model_step {p}_step

/* for each parameter, its smallest and its largest finite value, whether it may be infinite, and whether it is whole */
static const double model_least[MODEL_PARAMETERS] = {{{least}}};
static const double model_most[MODEL_PARAMETERS] = {{{most}}};
static const unsigned char model_infinite[MODEL_PARAMETERS] = {{{infinite}}};
static const unsigned char model_whole[MODEL_PARAMETERS] = {{{whole}}};

#endif
