"""Theorem 1 along a run: its conditions, the steps of its proof, and what they say in words."""
