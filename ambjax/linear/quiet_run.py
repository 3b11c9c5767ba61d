"""Quiet runs: runs without noise and loads at a constant reference, from a displaced start."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.blocks import QUARTERS, quarters
from ambjax.numerics.records import Scalar
from ambjax.numerics.shapes import varying
from ambjax.simulation.clock import Clock
from ambjax.world.ramps import Ramp, Trapezoid
from ambjax.world.rotation import Unbalance, UnbalanceGrade
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import Chirp, Constant, Pulse, Signal, Sine, SmoothStep, Step, Sum, is_random

# Displacement of the start of a quiet run, as a share of the clearance.
KICK = 0.01
# Share of the smaller one of the ranges of z in two quarters that both have in common if z oscillates.
SHARED = 0.5
# Share of the bias current below which the current in the last quarter of a quiet run is constant.
CALM = 1e-4
# Resolution that stands for an ideal converter, bits.
FINE_BITS = 32
LOADS = ("q_z", "q_v", "q_i", "q_f", "base")
# The field of a load with which all of its values scale.
SIZES = {Constant: "value", Unbalance: "unbalance", UnbalanceGrade: "grade"}
SIZES |= dict.fromkeys((Step, Pulse, Sine, SmoothStep, Chirp, Ramp, Trapezoid), "amplitude")


class QuietRun(NamedTuple):
    """Results of the quiet runs of members with c axes.

    - `swings`: half peak-to-peak value of z in each quarter [N, c, QUARTERS], m; 0 after a loss.
    - `returns`: whether z returns, in the last quarter, to most of the range of the third one [N, c]; False for a
      creep.
    - `current`: largest |i| in the last quarter in which the rotor is held [N, c], A.
    - `busy`: whether a current changes by more than CALM in the last quarter [N]; False after a loss.
    - `lost`: whether the rotor is lost [N].
    """

    swings: np.ndarray
    returns: np.ndarray
    current: np.ndarray
    busy: np.ndarray
    lost: np.ndarray


def quiet_run(cascade: Cascade, scenario: Scenario, clock: Clock) -> QuietRun:
    """Simulate the quiet runs of one axis."""
    run = run_ensemble(cascade, quiet(scenario), clock, fold=quarters(clock), record_every=0)
    bias = np.asarray(scenario.plant.i_0)[..., None]
    low, high = ({k: x[:, None] for k, x in one.items()} for one in (run.metrics.low, run.metrics.high))
    return quiet_run_of(low, high, np.asarray(run.trajectory.lost_at), bias)


def quiet_run_of(
    low: dict[str, np.ndarray], high: dict[str, np.ndarray], lost_at: np.ndarray, bias: np.ndarray
) -> QuietRun:
    """Return the results of runs from the extremes of z and i in each quarter [N, c, QUARTERS or more].

    `lost_at` [N]: s; inf if the rotor is held. `bias`: currents, A.
    """
    low, high = ({name: x[..., :QUARTERS] for name, x in part.items()} for part in (low, high))
    swings = np.zeros((*low["z"].shape[:-1], QUARTERS))
    swings[..., : low["z"].shape[-1]] = np.maximum(high["z"] - low["z"], 0.0) / 2
    before = high["z"][..., -2:][..., 0], low["z"][..., -2:][..., 0]
    common = np.minimum(high["z"][..., -1], before[0]) - np.maximum(low["z"][..., -1], before[1])
    returns = common / 2 > SHARED * swings[..., -2:].min(axis=-1)
    most = np.maximum(high["i"], -low["i"])
    last = np.maximum(np.sum(np.isfinite(most), axis=-1) - 1, 0)
    current = np.take_along_axis(most, last[..., None], axis=-1)[..., 0]
    busy = np.any(high["i"][..., -1] - low["i"][..., -1] > CALM * bias, axis=-1)
    return QuietRun(swings, returns, np.where(np.isfinite(current), current, 0.0), busy, np.isfinite(lost_at))


def quiet(scenario: Scenario) -> Scenario:
    """Return the scenario of the quiet run. The start is displaced by KICK of the clearance, towards z = 0.

    Noise, converters and most loads stay in it, without effect, so that its compiled program is that of the scenario.
    """
    loads = {slot: _scaled(getattr(scenario, slot), 0.0, _none) for slot in LOADS}
    fine = {name: FINE_BITS for name in ("bits", "bits_i") if getattr(scenario.sensors, name) is not None}
    calm = scenario.louder(0.0).with_sensor(outliers=None, dropouts=None, runout=None, **fine)
    return dataclasses.replace(calm, **loads, reference=Constant(_at_start(scenario.reference))).displaced(KICK)


def calmed(scenario: Scenario, calm: Scalar) -> Scenario:
    """Return the scenario of a quiet run if `calm` is 1, and the scenario itself if it is 0; both have one program.

    Faults, runout, converters, and signals of other classes than SIZES remain.
    """
    slots = LOADS if isinstance(scenario.reference, Constant) else (*LOADS, "reference")
    signals = {slot: _scaled(getattr(scenario, slot), 1.0 - calm, lambda signal: signal) for slot in slots}
    return dataclasses.replace(scenario.louder(1.0 - calm), **signals).displaced(KICK * calm)


def _scaled(load: Any, factor: Scalar, other: Callable[[Any], Any]) -> Any:
    """Return a load whose size is multiplied by `factor`. `other`: function for loads that have no size."""
    if isinstance(load, Sum):
        return Sum(tuple(_scaled(term, factor, other) for term in load.terms))
    if name := SIZES.get(type(load)):
        return dataclasses.replace(load, **{name: factor * getattr(load, name)})
    return other(load)


def _none(load: Signal | None) -> Signal | None:
    return None if load is None else Constant()


def _at_start(reference: Signal) -> Any:
    """Return the reference of each member at t = 0, m; 0 for one that is drawn for each member."""
    if is_random(reference):
        return 0.0
    varies = varying(reference)
    axes = jax.tree.unflatten(jax.tree.structure(reference), [0 if own else None for own in varies])
    return np.asarray((jax.vmap(_first, (axes,)) if any(varies) else _first)(reference))


@compiled_quickest
def _first(signal: Signal) -> Array:
    return jnp.asarray(signal(0.0))
