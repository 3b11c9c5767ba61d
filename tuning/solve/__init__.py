"""The search: starting points, descents, CMA-ES, and the multipliers of the limits."""
