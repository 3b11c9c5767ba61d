"""Export of the controller as C: trace the simulator's step, write it as C99, and verify the C against JAX."""
