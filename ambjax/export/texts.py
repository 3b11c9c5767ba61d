"""What the files of an exported controller say beside the controller: templates."""

HEADER = """{banner}

/*
{told}
 */

#ifndef {P}_H
#define {P}_H

{maths}#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

typedef {real} {p}_real;

/* s; a step is made for this period and no other */
#define {p}_SAMPLE_PERIOD {period}

/* bits that a step returns */
{bits}

/* gains, the model's numbers and limits: [unit, what is allowed] meaning */
{params}

/* what a step keeps for the next */
{state}

/* what a step reads; each within its limit in params->limits */
{input}

/* what a step gives */
{output}

/* the case's numbers */
#define {P}_DEFAULT {{ \\
{gains} \\
}}

extern const {p}_params {p}_default;

/* Before the first step: no voltage, laws without a state. */
{init};

/* One sample. Returns the bits above. */
{step};

/* Laws begin anew with the next good input; the voltages that are on their way stay known. */
{reset};

#ifdef __cplusplus
}}
#endif

#endif
"""

SOURCE = """{banner}

#include "{p}.h"

#include <math.h>

#ifdef __FAST_MATH__
#error "NaN must be seen: compile without -ffast-math"
#endif

{helpers}const {p}_params {p}_default = {P}_DEFAULT;

{init}
{{
{zeros}    state->started = 0u;
}}

{reset}
{{
    state->started = 0u;
}}

{body}
"""

MAKEFILE = """# make: the object; make test: the test program, run
CC ?= cc
CFLAGS ?= -O2
# a fused product and sum would round once where the simulator rounds twice
WARNINGS = -std=c99 -Wall -Wextra -Wconversion -Wdouble-promotion -pedantic -ffp-contract=off

{p}.o: {p}.c {p}.h
\t$(CC) $(WARNINGS) $(CFLAGS) -c {p}.c -o $@

{p}_test: {p}_test.c {p}_vectors.h {p}.o
\t$(CC) $(WARNINGS) $(CFLAGS) {p}_test.c {p}.o -o $@ -lm

test: {p}_test
\t./{p}_test

clean:
\trm -f {p}.o {p}_test

.PHONY: test clean
"""

TEST = """{banner}

#include <math.h>
#include <stdio.h>

#include "{p}.h"
#include "{p}_vectors.h"

/* whether a number is off the one that JAX gives by more than rounding */
static int differs({p}_real is, {p}_real should)
{{
    if (isnan(should) || isnan(is)) {{
        return (isnan(should) != 0) != (isnan(is) != 0);
    }}
    if (isinf(should) || isinf(is)) {{
        return is < should || is > should;
    }}
    return {abs}(is - should) > {share} * {abs}(should) + {small};
}}

/* a step with NaN in one input is refused: the voltage is held, and the laws keep their state */
static int refused({p}_state *state, int which)
{{
    {p}_input input;
    {p}_output output;
    const {p}_real u = state->last.u;
{zeros}
    switch (which) {{
{fields}
    default:
        break;
    }}
    const uint32_t status = {p}_step(&{p}_default, state, &input, &output);
    return (status & {p}_REFUSED) == 0u || differs(output.u, u) || differs(state->last.u, u);
}}

int main(void)
{{
    const int count = (int)(sizeof {p}_vectors / sizeof {p}_vectors[0]);
    int failed = 0, faults = 0;
    {p}_state state;
    for (int n = 0; n < count; n++) {{
        const {p}_vector *one = &{p}_vectors[n];
        {p}_output output;
        int wrong = 0;
        state = one->before;
        const uint32_t status = {p}_step(&{p}_default, &state, &one->input, &output);
        wrong += status != one->status;
        wrong += state.started != one->after.started;
{checks}
        if (wrong > 0) {{
            printf("step %d: %d numbers differ\\n", n, wrong);
            failed++;
        }}
    }}
    {p}_init(&state);
    faults += state.started != 0u || differs(state.last.u, 0);
{faults}
    faults += state.started != 0u;
    state.last.u = 1;
    state.started = 1u;
    {p}_reset(&state);
    faults += state.started != 0u || differs(state.last.u, 1);
    printf("%d of %d steps as JAX makes them, %d faults in start and refusal\\n", count - failed, count, faults);
    return failed > 0 || faults > 0;
}}
"""

README = """# {p}: the controller of case '{case}' as C99

{cascade}

`{p}.h`, `{p}.c`: the controller. Its only global is constant, the case's numbers; it needs `<math.h>` and `<stdint.h>`.
`{p}_test.c`, `{p}_vectors.h`: a test program, which makes steps that JAX has made; `make test` runs it.

{order}

```c
#include "{p}.h"

static {p}_state state;

void setup(void)
{{
    {p}_init(&state);
}}

void every_sample(void) /* {period} s */
{{
    {p}_input input = {{0}};
    {p}_output output;
    input.z = read_z();
    input.z_dot = read_z_dot();
    input.i = read_i();
    input.r = reference();
    const uint32_t status = {p}_step(&{p}_default, &state, &input, &output);
    write_voltage(output.u);
    if (status & ({p}_REFUSED | {p}_FAILED)) {{
        fault(); /* the voltage is held; decide how long */
    }}
}}
```

The gains are `{P}_DEFAULT` in the header. To change one, copy it (`{p}_params mine = {P}_DEFAULT;`),
set it, and give `&mine` to the step. The sample period is fixed: export again for another.

{flops} flops a step, in {precision}. Held to JAX operation by operation: {ulps} at 10,000 random states and inputs
(`ambjax export --verify`). Compile with `-ffp-contract=off`, and never with `-ffast-math`.
"""
