{banner}

#include <math.h>
#include <stdio.h>

#include "{p}.h"
#include "{p}_vectors.h"

/* return whether a number differs from that of JAX by more than the tolerance */
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

{fault_test}int main(void)
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
            printf("step %d: %d numbers differ\n", n, wrong);
            failed++;
        }}
    }}
{start_test}    printf("%d of %d steps agree with JAX, ", count - failed, count);
    printf("%d failed checks of the start and of bad inputs\n", faults);
    return failed > 0 || faults > 0;
}}
