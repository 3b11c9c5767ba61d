    {p}_init(&state);
    faults += state.started != 0u;
{faults}
    faults += state.started != 1u;
    {p}_reset(&state);
    faults += state.started != 0u;
