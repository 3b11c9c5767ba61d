"""The response of each member of an ensemble to a multi-sine that is injected into the nonlinear simulation."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.compiler.fast_path import SHORTEST
from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import map_members, size
from ambjax.linear.equilibrium import ideal, reading
from ambjax.linear.multisine import MultiSine, Reading, Response, multisine
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import Scalar, canonical, replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import prepare, run
from ambjax.simulation.sliding import Slide
from ambjax.simulation.trajectory import ALIVE
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.waveforms import Constant

# Default amplitude of e, as a share of the gap s_0; at the velocity sensor, of s_0 times the plant's pole.
AMPLITUDE = 0.01
# The compiled program has a multiple of PADDED lines, so that measurements with a few lines more or less share it.
PADDED = 16
# An ensemble of at most this many members runs in calls of SHORTEST members. These calls share one program and use all
# cores.
FEW = 4 * SHORTEST


class Responses(NamedTuple):
    """Measured responses of the members of an ensemble [N] at L lines.

    - `frequency` [L]: lines, Hz.
    - `S`, `KS` [N, L]: complex; meaningless for members that do not hold the rotor.
    - `saturated` [N]: share of the samples with |u| at the limit of the supply.
    - `held` [N]: whether the rotor was held.
    - `amplitude`: largest |e|, m or m/s.
    """

    frequency: np.ndarray
    S: np.ndarray
    KS: np.ndarray
    saturated: np.ndarray
    held: np.ndarray
    amplitude: float


def member_responses(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    frequencies: Sequence[float] | np.ndarray,
    channel: Reading = "z",
    amplitude: Scalar | None = None,
    r: float = 0.0,
    settle: int = 1,
    periods: int = 1,
) -> Responses:
    """Inject the same multi-sine into each member of an ensemble, whose varying leaves are arrays [N].

    The arguments are those of `injected`; `channel` is its argument `reading`. `scenario.member` [N] contains the
    numbers of the members.
    """
    gap, pole = (float(np.mean(np.asarray(x))) for x in (scenario.plant.s_0, scenario.plant.pole))
    require_number("amplitude", amplitude, optional=True)
    amplitude = AMPLITUDE * gap * (pole if channel == "z_dot" else 1.0) if amplitude is None else float(amplitude)
    if not amplitude > 0:
        raise ValueError(f"amplitude = {amplitude:g}: it must be above 0.")
    require_number("settle", settle, 0, whole=True)
    require_number("periods", periods, 1, whole=True)
    require_number("r", r)
    wave = multisine(_harmonics(frequencies, clock), clock.samples, float(clock.sample_period), amplitude, channel)
    skip = settle * clock.samples
    method = None if isinstance(clock.method, Slide) else clock.method
    longer = replaced(clock, samples=skip + periods * clock.samples, method=method)
    system, longer = prepare(*_at_rest(cascade, scenario, r), longer)
    response = Response(padded(wave, PADDED * math.ceil(len(wave.harmonics) / PADDED)), scenario.voltage_limit, skip)
    tree = canonical((system, longer, response))
    sums, code = map_members(_member, tree, call=SHORTEST if size(tree) <= FEW else None)
    e = float(wave.size) * np.exp(1j * np.asarray(wave.phases))
    S, KS = ((x[:, 0, : len(e)] + 1j * x[:, 1, : len(e)]) / e for x in (sums.read, sums.u))
    frequency = np.asarray(wave.harmonics) / float(clock.duration)
    return Responses(frequency, S, KS, sums.saturated, code == ALIVE, amplitude)


def _member(tree: Any) -> tuple[Any, Any]:
    """Return the `FourierSums` and the status code of one member."""
    system, clock, response = tree
    outcome = run(dataclasses.replace(system, wave=response.wave), clock, response, 0)
    return outcome.metrics, outcome.trajectory.lost_code


def padded(wave: MultiSine, lines: int) -> MultiSine:
    """Return the wave with this number of lines."""
    padding = (0, lines - len(wave.harmonics))
    phases = np.pad(wave.phases, padding, constant_values=0.5 * np.pi)
    return dataclasses.replace(wave, harmonics=np.pad(wave.harmonics, padding), phases=phases)


def _at_rest(cascade: Cascade, scenario: Scenario, r: float) -> tuple[Cascade, Scenario]:
    """Return cascade and scenario that start at rest at the constant reference r (m), without disturbances."""
    i = scenario.plant.equilibrium(r)[0]
    initial = Initial(r, 0.0, float(i) if np.ndim(i) == 0 else i)
    scenario = dataclasses.replace(scenario.undisturbed(), reference=Constant(r), initial=initial)
    inversion = cascade.inversion.started(cascade.model.equilibrium(r)[0])
    # The observer does not start at the first measurement: a slow observer would keep the noise of this measurement as
    # an initial error.
    rest = initial.measurement()
    z = reading(ideal(scenario), rest, (0.0, 0.0)).z
    return dataclasses.replace(cascade, inversion=inversion, observer=cascade.observer.started(z)), scenario


def _harmonics(frequencies: Sequence[float] | np.ndarray, clock: Clock) -> np.ndarray:
    """Return the harmonics [L] of 1/duration nearest to the frequencies (Hz), sorted, each once."""
    f, base = np.asarray(frequencies), 1 / float(clock.duration)
    harmonics = np.unique(np.round(f / base)) if f.dtype.kind in "iuf" else np.zeros(0)
    if not harmonics.size or not np.isfinite(f).all() or harmonics[0] < 1 or harmonics[-1] >= clock.samples / 2:
        raise ValueError(
            f"injection.frequencies: they must be at least {base:g} Hz, the inverse of {clock.samples} samples, "
            f"and below {0.5 / float(clock.sample_period):g} Hz, half the sampling rate. Change them or clock.samples."
        )
    if harmonics[-1] * clock.samples > np.iinfo(jnp.result_type(int)).max:
        raise ValueError(
            f"clock.samples = {clock.samples}: a period is too long for the integers of JAX. Set JAX_ENABLE_X64=1."
        )
    return harmonics.astype(int)
