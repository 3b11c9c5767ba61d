{zeros}
    switch (which) {{
{fields}
    default:
        break;
    }}
    const uint32_t status = {p}_step(&{p}_default, state, &input, &output);
