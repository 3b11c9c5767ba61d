"""Workarounds for XLA: each module changes how a function is compiled, and none changes its result."""
