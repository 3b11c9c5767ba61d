    {p}_init(&state);
    faults += state.started != 0u || differs(state.last.u, 0);
{faults}
    faults += state.started != 0u;
    state.last.u = 1;
    state.started = 1u;
    {p}_reset(&state);
    faults += state.started != 0u || differs(state.last.u, 1);
