"""The loop on a processor: its state, and the plant between two samples under the voltages that act."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade_state import Command
from ambjax.numerics.records import Scalar
from ambjax.simulation.edges import NO_EDGES, Edges
from ambjax.simulation.integrate import InitialValueProblem
from ambjax.simulation.loop import ClosedLoop, ExternalInputs
from ambjax.simulation.trajectory import INSTANT_TREE, Densities, Instant, Sizes
from ambjax.world.amplifier import Amplifier, CurrentAmplifier, difference
from ambjax.world.faults import Sensed


class SampledState(NamedTuple):
    """State of the closed loop on a processor. A field is () if the loop has no such part.

    - `plant`, `control`: states of the plant and of the laws.
    - `command`: last command, with u (V, or A for a current) within `Scenario.command_limit`.
    - `past`: the commands u before that of `command`, the most recent first, as many as the delay needs.
    - `finite`: 1 at the start; 0 after a law or, without a guard, the sensor has returned a number that is not finite.
    - `z_filtered`: output of the low-pass of the position sensor, m.
    - `u_a`: output voltage of the amplifier, V.
    - `watch`: state of the guard.
    - `started`: 0 until the guard has accepted all readings of one sample; then 1. Until then, each sample initialises
      the laws.
    - `sensed`: state of a sensor with faults.
    """

    plant: Any
    control: Any
    command: Command
    past: tuple[Array, ...]
    finite: Array
    z_filtered: Array | tuple[()] = ()
    u_a: Array | tuple[()] = ()
    watch: Any = ()
    started: Array | tuple[()] = ()
    sensed: Sensed | tuple[()] = ()


# A voltage (V) as a function of time; such functions with the durations (s) for which they act.
Voltage = Callable[[Scalar], Array]
Acting = list[tuple[Voltage, Scalar]]


def acting(voltages: tuple[Array, ...], delay: Array, period: Scalar, whole: bool) -> list[tuple[Array, Scalar]]:
    """Return the commanded voltages (V) that act during a sample, each with its duration (s).

    `voltages`: of this sample and of those before it, V. `delay`: in samples. `whole`: the delay is a whole number,
    so that one voltage acts during the whole sample.
    """
    late = (delay - jnp.floor(delay)) * period
    last = _one_of(voltages, jnp.floor(delay))
    return [(last, period)] if whole else [(at_sample(voltages, delay), late), (last, period - late)]


def at_sample(commands: tuple[Array, ...], delay: Array) -> Array:
    """Return the command that acts at a sample. `commands`: of this sample and of those before it; `delay`: samples."""
    return _one_of(commands, jnp.ceil(delay))


def _one_of(voltages: tuple[Array, ...], lag: Array) -> Array:
    """Return the voltage of the sample `lag` samples ago, lag = 0, 1, ..."""
    found = voltages[-1]
    for number, voltage in reversed(list(enumerate(voltages[:-1]))):
        found = jnp.where(lag < number + 0.5, voltage, found)
    return found


def amplified(
    amplifier: Amplifier | CurrentAmplifier | None,
    t: Array,
    u_a: Array | tuple[()],
    commanded: Sequence[tuple[Array, Scalar]],
    divided: bool = True,
) -> tuple[Acting, Array | tuple[()]]:
    """Return the amplifier's voltage as functions of time with their durations (s), and its output voltage at the end.

    `u_a`: output voltage at t (V). For an amplifier that applies the command at once it is (), also in the result.
    `commanded`: voltages (V) from t on, each with its duration (s). With a slew-rate limit and `divided`, each interval
    is divided at the end of its ramp, where the slope of the voltage jumps.
    """
    if not isinstance(amplifier, Amplifier) or not amplifier.slow:
        return [(lambda _, u=u: u, time) for u, time in commanded], u_a
    assert not isinstance(u_a, tuple)  # a slow amplifier has an output voltage as its state
    given = []
    for u, time in commanded:
        voltage = lambda now, u_a=u_a, u=u, t=t: amplifier.followed(u_a, u, now - t)  # noqa: E731
        ramp = jnp.minimum(amplifier.ramp(u_a, u), time)
        whole = amplifier.slew is None or not divided
        given += [(voltage, time)] if whole else [(voltage, ramp), (voltage, time - ramp)]
        u_a, t = amplifier.followed(u_a, u, jnp.asarray(time)), t + time
    return given, u_a


def subproblems(
    loop: ClosedLoop, state: object, command: Command, t: Array, voltages: Acting, cuts: int | None
) -> list[tuple[InitialValueProblem, Scalar]]:
    """Return the initial value problems from t (s) on, with their durations (s), for the voltages that act.

    `state`: of the plant at t. `cuts`: largest number of edges inside one sample; None: the number of all edges.
    """
    at, knots = loop.scenario.edges(), loop.scenario.knots()
    most = len(at) + sum(len(one.times) for one in knots)
    edges = Edges(at, most if cuts is None else min(cuts, most), knots)
    if not edges.most:
        edges = NO_EDGES
    if not lags(loop):
        return [(under(loop, state, command, voltage, edges), time) for voltage, time in voltages]
    # The solution of the sensor's low-pass requires a motion that is smooth over each part, so divide at edges too. The
    # knots of records may be many; steps end there, but parts do not.
    cut, inside = [], Edges((), edges.most, edges.knots) if edges.knots else NO_EDGES
    for voltage, time in voltages:
        problem = under(loop, state, command, voltage, inside)
        cut += [(problem, length) for length in edges.pieces(t, time)]
        t = t + time
    return cut


def lags(loop: ClosedLoop) -> bool:
    """Return whether the position sensor has a low-pass."""
    return loop.scenario.sensors.bandwidth is not None


def plant_status(loop: ClosedLoop, state: object) -> Array:
    """Return the status code of the plant's state."""
    return loop.status_of(state, loop.scenario.plant.scale(), state)


def under(loop: ClosedLoop, state: object, command: Command, voltage: Voltage, edges: Edges) -> InitialValueProblem:
    """Return the initial value problem of the plant, with `voltage` (V) as a function of time."""
    plant = loop.scenario.plant
    e = plant.measurement(state).i - command.i_ref

    def inputs(t: Scalar) -> tuple[ExternalInputs, Array]:
        return loop.inputs(t), voltage(t)

    def rates(inputs: tuple[ExternalInputs, Array], x: object) -> object:
        outside, u = inputs
        q_z = loop.scenario.pushed(outside.q_z, plant.measurement(x))
        return plant.rates(x, loop.scenario.applied(u, x, outside.q_i), q_z, outside.q_i)

    def observed(inputs: tuple[ExternalInputs, Array], x: object) -> tuple[object, Instant]:
        (outside, u), motion, heat = inputs, plant.measurement(x), plant.signals(x).heat
        u = difference(loop.scenario.applied(u, x, outside.q_i))
        sigma = loop.cascade.sigma(motion, outside.reference)
        sizes = Sizes(motion.z, motion.z - outside.reference.r, sigma, u, motion.i, e, command.v_tilde)
        return rates(inputs, x), Instant(sizes, Densities(u, u * u, heat))

    def status(x: object) -> Array:
        return plant_status(loop, x)

    scale, limit = jax.tree.map(jnp.asarray, plant.scale()), loop.scenario.limit
    return InitialValueProblem(
        inputs, rates, scale, status, None, observed, INSTANT_TREE, edges=edges, motion=loop.motion, limit=limit
    )
