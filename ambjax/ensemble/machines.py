"""Simulation of ensembles of machines."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ambjax.compiler.fast_path import one_kernel
from ambjax.compiler.members_last import SHORT, members_last
from ambjax.compiler.short_compilation import compiled_quickly
from ambjax.ensemble.batching import Mapped, map_members
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Fold
from ambjax.simulation.rollout import Result, run
from ambjax.simulation.whole_machine import Machine


def run_machines(machine: Machine, clock: Clock, fold: Fold, **how: Any) -> Result:
    """Simulate every member of an ensemble of machines. What varies has a leading axis [N]. No rows are recorded.

    `how`: `threads`, `call` and `compiled` of `map_members`.
    """
    tree = canonical((machine, clock, fold))
    how.setdefault("compiled", compiled_quickly if _has_long_sums(machine) else one_kernel)
    return map_members(_simulated, tree, vectorised=True, **how)


def compiled_for_machines(
    function: Callable[..., Mapped], static_argnames: tuple[str, ...] = ()
) -> Callable[..., Mapped]:
    """Return jit(`function`), whose first argument is a machine: as one kernel, unless its sums are too long."""
    kernel, plain = (way(function, static_argnames) for way in (one_kernel, compiled_quickly))

    def call(machine: Machine, *args: object, **static: object) -> Mapped:
        return (plain if _has_long_sums(machine) else kernel)(machine, *args, **static)

    return call


def _has_long_sums(machine: Machine) -> bool:
    """Return whether a product of a matrix has a sum of more than SHORT terms, which XLA refuses in one kernel."""
    matrices = [x for x in jax.tree.leaves(machine.law) if np.ndim(x) > 1]
    return max(np.shape(x)[-1] for x in (machine.rotor.gravity, *matrices)) > SHORT


def _simulated(tree: tuple[Machine, Clock, Fold], axes: object) -> Result:
    return members_last(lambda one: run(one[0], one[1], one[2], 0), axes)(tree)
