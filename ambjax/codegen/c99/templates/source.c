{banner}

#include "{p}.h"

#include <math.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "NaN and infinity must be detected: compile without -ffast-math and -ffinite-math-only"
#endif

{helpers}const {p}_params {p}_default = {P}_DEFAULT;

{init}
{{
{zeros}    state->started = 0u;
}}

{reset}
{{
{forgotten}    state->started = 0u;
}}

{body}
