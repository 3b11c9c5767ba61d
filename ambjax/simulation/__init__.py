"""From a cascade in a scenario to trajectories and metrics: the loop, its integrators, clock and folds."""
