"""A page with sliders: the sampled loop as JavaScript, traced from the simulator's own sample, in one HTML file."""
