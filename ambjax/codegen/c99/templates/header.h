{banner}

/*
{notes}
 */

#ifndef {P}_H
#define {P}_H

{maths}#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

typedef {real} {p}_real;

/* s; the step must be called with this period */
#define {p}_SAMPLE_PERIOD {period}

/* bits of the status that a step returns */
{bits}

/* parameters, which may change between two steps; each comment: [unit, allowed values] meaning */
{params}

/* state that one step passes to the next */
{state}

/* {about[inputs]} */
{input}

/* outputs of a step */
{output}

/* the values of the case, in the order of {p}_params; compiles as C99, and as C++11 or later */
#define {P}_DEFAULT \
{gains}

extern const {p}_params {p}_default;

/* {about[init]} */
void {p}_init({p}_state *state);

/* {about[step]} */
uint32_t {p}_step(const {p}_params *params, {p}_state *state, const {p}_input *input, {p}_output *output);

/* {about[reset]} */
void {p}_reset({p}_state *state);

#ifdef __cplusplus
}}
#endif

#endif
