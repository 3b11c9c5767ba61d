"""Ensembles: many members of one case, drawn, simulated and reduced to numbers."""

from ambjax.ensemble.batching import map_members, run_ensemble
from ambjax.ensemble.distributions import Choice, LogUniform, Normal, Percent, Uniform
from ambjax.ensemble.drivers import shares
from ambjax.ensemble.gpu_kernel import run_on_gpu
from ambjax.ensemble.intervals import cvar, quantile, wilson
from ambjax.ensemble.spread import Spread, apply, draw
from ambjax.ensemble.statistics import summary

__all__ = [
    "Choice",
    "LogUniform",
    "Normal",
    "Percent",
    "Spread",
    "Uniform",
    "apply",
    "cvar",
    "draw",
    "map_members",
    "quantile",
    "run_ensemble",
    "run_on_gpu",
    "shares",
    "summary",
    "wilson",
]
