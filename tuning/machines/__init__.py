"""Tuning of whole machines: gains of the least peak of the sensitivity of the worst axis."""
