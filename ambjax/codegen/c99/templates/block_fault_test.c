/* return whether a step treats a NaN in one input wrongly: it must be invalid and its outputs finite */
static int refused({p}_state *state, int which)
{{
    {p}_input input;
    {p}_output output;
{step}    return (status & {p}_INVALID) == 0u{finite};
}}

