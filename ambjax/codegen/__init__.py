"""Code generation: trace the simulator's step, write it as C99 or JavaScript, and verify the C against JAX."""
