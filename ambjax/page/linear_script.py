"""The linearised loop as JavaScript: the step of the laws and the rates of the plant, with their derivatives."""

import dataclasses
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.compiler.short_compilation import precision
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.linear.equilibrium import at_rest, ideal, sizes_of, start_of
from ambjax.linear.matrices import LagState, with_lags
from ambjax.numerics.records import canonical
from ambjax.page.functions import function_source, piece_of
from ambjax.page.loop_functions import Numbers, loop_parameters


class LoopPoint(NamedTuple):
    """A point at which the loop is linearised.

    - `lagged`: state of the plant and its lags.
    - `acting`: the voltage that acts, V.
    - `control`: states of the laws.
    - `past`: the voltages commanded before, the most recent first, V.
    - `e`: test signal that is added to the reading of z, m.
    """

    lagged: LagState
    acting: Array
    control: CascadeState
    past: tuple[Array, ...]
    e: Array


class PointValues(NamedTuple):
    """Rates of the plant and its lags, next states of the laws, commanded voltage u (V), and reading of z (m)."""

    rates: LagState
    control: CascadeState
    u: Array
    z: Array


# An equilibrium: state of the plant and its lags, voltage (V), states of the laws.
EquilibriumPoint: TypeAlias = tuple[LagState, Array, CascadeState]


class LinearScript(NamedTuple):
    """The linear loop as JavaScript.

    - `source`: the functions `linearStart(P, out)` and `linearPoint(P, X, out)`. The first writes the initial guess of
      the equilibrium and the characteristic sizes of its components. The second writes the values at the point X and
      their derivatives.
    - `facts`: number of components of the parts of a point, limits of the ISO zones, range of frequencies (Hz).
    """

    source: str
    facts: dict[str, Any]


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
    return PointValues(rates._replace(plant=scenario.plant.rates(x.lagged.plant, u)), control, command.u, measured.z)


def _ideal(numbers: Numbers) -> Numbers:
    """Return the numbers without parts that cannot be linearised: limits, noise, converters, guard."""
    return numbers._replace(cascade=numbers.cascade.with_processor(guard=None), scenario=ideal(numbers.scenario))


def linear_script(case: Case) -> LinearScript:
    """Return the linear loop of a case as JavaScript, for any delay.

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
    return LinearScript("\n".join(sources), facts)
