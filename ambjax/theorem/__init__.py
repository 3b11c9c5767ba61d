"""Theorem 1 along a run: its conditions, the steps of its proof, and the text of `ambjax check`."""
