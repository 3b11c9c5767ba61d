/* return whether a step treats a NaN in one input wrongly: a NaN in a reading must be {effect};
 * with a NaN in the reference, the step must be invalid and hold u */
static int refused({p}_state *state, int which)
{{
    {p}_input input;
    {p}_output output;
    const {p}_real u = state->last.u;
{step}    if (which < {readings}) {{
        return {unseen};
    }}
    return (status & {p}_INVALID) == 0u || differs(output.u, u) || differs(state->last.u, u);
}}

