"""Simulation of a cascade in a scenario: the closed loop, integrators, the clock, trajectories and metrics."""
