"""The sampled loop and the linearised loop that JAX traces for the page, as JavaScript. The numbers are parameters."""

import dataclasses
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.codegen.javascript.script import function_source, loop_source, piece_of
from ambjax.compiler.short_compilation import precision
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.linear.equilibrium import at_rest, ideal, sizes_of, start_of
from ambjax.linear.matrices import LagState, with_lags
from ambjax.numerics.records import Scalar, canonical, replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import RolloutState, begin, one_sample
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.world.scenario import Scenario


class Numbers(NamedTuple):
    """All numbers of a case that the loop uses. Each leaf is a parameter of the JavaScript.

    `settle`: start of the settled metrics, s. `period`: sample period, s.
    """

    cascade: Cascade
    scenario: Scenario
    settle: Scalar
    period: Scalar


def _system(clock: Clock, numbers: Numbers, normals: Any) -> tuple[Sampled, Clock, Metrics]:
    """Return the loop of a sample. `clock`: number of samples and integrator. `normals`: three normal numbers."""
    clock = replaced(clock, sample_period=numbers.period)
    built = sampled_of(numbers.cascade, numbers.scenario, clock)
    word = jnp.zeros((), jnp.uint32)
    cascade = built.loop.cascade.turning(numbers.scenario.rotor)
    loop = ClosedLoop(cascade, numbers.scenario.turning(), (word, word), normals)
    return dataclasses.replace(built, loop=loop), clock, _fold(numbers)


def _fold(numbers: Numbers) -> Metrics:
    """Return the metrics without those once per revolution, which compute with arrays."""
    return Metrics.of(numbers.settle, dataclasses.replace(numbers.scenario, rotor=None))


def loop_parameters(case: Case, any_delay: bool = False) -> Numbers:
    """Return the numbers of a case on a processor."""
    cascade = case.cascade.on_processor()
    if any_delay:
        cascade = cascade.on_processor(0.0, longest_delay(case), between=True)
    return Numbers(cascade, case.scenario, case.settle, case.clock.sample_period)


def longest_delay(case: Case) -> float:
    """Return the longest delay that the page admits, samples: the number of commands that its programs keep."""
    return float(len(case.cascade.on_processor().timing.constant_past(jnp.zeros(()))))


# Signals in a row, which the page draws; the currents of both coils follow. A row of a member has the first three only.
SIGNALS = ("z", "alive", "r", "u", "u_mean", "i_ref", "q_z", "z_measured", "sigma", "v_tilde", "i")
COILS = ("i_1", "i_2")


def loop_script(case: Case, any_delay: bool = False) -> tuple[str, dict[str, Any]]:
    """Return the loop of a case on a processor as JavaScript, and facts for the page.

    The JavaScript defines `startLoop(P, W, out)`, `makeLoop(P)`, `makeMember(P)` and `loopMetrics(P, S, out)`. W:
    normal random numbers. `out`: array of the result. See `loop_source` for the functions that `makeLoop` and
    `makeMember` return. That of a member does not update the metrics in S. The facts: names of the metrics in the order
    of `out` of `loopMetrics`, number of states S, index of the state that contains the status code of the rotor.

    `any_delay`: for every delay that the page admits, not only that of the case. Raises ValueError for a part of the
    case that scalar code cannot express.
    """
    with precision("double"):
        numbers = canonical(loop_parameters(case, any_delay))
        zero = jnp.zeros(())
        normals = (zero, zero, zero)

        def begun(numbers: Numbers, normals: Any) -> RolloutState:
            return begin(*_system(case.clock, numbers, normals))

        def stepped(numbers: Numbers, progress: RolloutState, normals: Any, k: Array) -> tuple[Any, ...]:
            """Return the state after sample k, the row of this sample, and the currents of both coils at its start."""
            after, row = one_sample(*_system(case.clock, numbers, normals), progress, k)
            return after, row, numbers.scenario.plant.currents(progress.state.plant)

        start = piece_of(begun, "pw", (numbers, normals))
        shapes = jax.eval_shape(begun, numbers, normals)
        progress = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        step = piece_of(stepped, "pswn", (numbers, progress, normals, zero))
        result = piece_of(lambda n, state: _fold(n).result(state.fold, state.ending), "ps", (numbers, progress))
    _, row, coils = step.results
    shown = [getattr(row, name) for name in SIGNALS] + list(coils)
    every = jax.tree.leaves(step.results[0])
    sources = [
        function_source(start, "startLoop", "PW", start.results),
        loop_source(step, "makeLoop", shown, every),
        loop_source(step, "makeMember", shown[:3], []),
        function_source(result, "loopMetrics", "PS", result.results),
    ]
    lost = jax.tree.leaves(jax.tree.map(lambda x: x is shapes.ending.lost_code, shapes)).index(True)
    return "\n".join(sources), {"metrics": list(result.results), "states": len(every), "lost": lost}


class LoopPoint(NamedTuple):
    """A point at which the loop is linearised: the state of the plant and its lags, and the states of the laws.

    `acting`: the voltage that acts, V. `past`: the voltages commanded before, the most recent first, V. `e`: test
    signal that is added to the reading of z, m.
    """

    lagged: LagState
    acting: Array
    control: CascadeState
    past: tuple[Array, ...]
    e: Array


# Rates of the plant and its lags, next states of the laws, commanded voltage u (V), and reading of z (m).
PointValues: TypeAlias = tuple[LagState, CascadeState, Array, Array]
# An equilibrium: state of the plant and its lags, voltage (V), states of the laws.
EquilibriumPoint: TypeAlias = tuple[LagState, Array, CascadeState]


def _start(numbers: Numbers) -> tuple[EquilibriumPoint, EquilibriumPoint]:
    """Return the initial guess of the equilibrium, and the characteristic sizes of its components."""
    numbers = _ideal(numbers)
    point = start_of(numbers.cascade, numbers.scenario, numbers.period, 0.0)
    sizes = sizes_of(numbers.cascade, numbers.scenario, point)
    state, size = (with_lags(numbers.scenario, one) for one in (point, sizes))
    return (state, point.u, point.control), (size, sizes.u, sizes.control)


def _columns(numbers: Numbers, x: LoopPoint) -> tuple[PointValues, list[PointValues]]:
    """Return the values at a point, and a list of their derivatives with respect to each component of the point."""
    leaves, tree = jax.tree.flatten(x)

    def values(x: LoopPoint) -> PointValues:
        return _values(_ideal(numbers), x)

    found = []
    for k in range(len(leaves)):
        unit = jax.tree.unflatten(tree, [jnp.ones(()) if j == k else jnp.zeros(()) for j in range(len(leaves))])
        found.append(jax.jvp(values, (x,), (unit,))[1])
    return values(x), found


def _values(numbers: Numbers, x: LoopPoint) -> PointValues:
    """Return the values at a point. `numbers`: those of `_ideal`."""
    scenario = numbers.scenario
    rates, u = x.lagged.lag_rates(scenario, x.acting)
    measured = x.lagged.read(scenario, (x.e, jnp.zeros(())))
    sample = Sample(at_rest(0.0), jnp.asarray(numbers.period), jnp.asarray(jnp.inf), x.past)
    command, control, _ = numbers.cascade.step(measured, x.control, sample)
    return rates._replace(plant=scenario.plant.rates(x.lagged.plant, u)), control, command.u, measured.z


def _ideal(numbers: Numbers) -> Numbers:
    """Return the numbers without parts that cannot be linearised: limits, noise, converters, guard."""
    return numbers._replace(cascade=numbers.cascade.with_processor(guard=None), scenario=ideal(numbers.scenario))


def linear_script(case: Case) -> tuple[str, dict[str, Any]]:
    """Return the linear loop of a case as JavaScript, for any delay, and facts.

    The JavaScript defines `linearStart(P, out)` and `linearPoint(P, X, out)`. The first writes the initial guess of the
    equilibrium and the characteristic sizes of its components. The second writes the values at the point X and their
    derivatives. The facts: number of components of the parts of a point, limits of the ISO zones, range of frequencies
    (Hz).

    Raises ValueError for a part of the case that scalar code cannot express.
    """
    with precision("double"):
        numbers = canonical(loop_parameters(case, any_delay=True))
        (lagged, u, control), _ = jax.eval_shape(_start, numbers)
        zero = jnp.zeros(())
        x = LoopPoint(lagged, u, control, numbers.cascade.timing.constant_past(zero), zero)
        x = jax.tree.map(lambda _: zero, x)
        start = piece_of(_start, "p", (numbers,))
        point = piece_of(_columns, "px", (numbers, x))
    low, high = dataclasses.replace(case.zones, f_high=None).range(case.clock.sample_period)
    zones = case.zones.limits
    sizes = {name: len(jax.tree.leaves(getattr(x, name))) for name in ("lagged", "control", "past")}
    facts = {**sizes, "zones": zones, "low": low, "high": high}
    sources = [
        function_source(start, "linearStart", "P", start.results),
        function_source(point, "linearPoint", "PX", point.results),
    ]
    return "\n".join(sources), facts
