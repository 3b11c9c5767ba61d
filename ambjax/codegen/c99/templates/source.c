{banner}

#include "{p}.h"

#include <math.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "NaN and infinity must be detected: compile without -ffast-math and -ffinite-math-only"
#endif

{helpers}const {p}_params {p}_default = {P}_DEFAULT;

void {p}_init({p}_state *state)
{{
{zeros}    state->started = 0u;
}}

void {p}_reset({p}_state *state)
{{
{forgotten}    state->started = 0u;
}}

uint32_t {p}_step(const {p}_params *params, {p}_state *state, const {p}_input *input, {p}_output *output)
{{
    uint32_t status = 0u;
{body}    return status;
}}
