"""Folds: accumulators of metrics, updated sample by sample. They store few numbers, whatever the length of a run.

`Fold` is their interface.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.law_trial import reason
from ambjax.numerics.records import Scalar, bounded, leaf, part, record, static
from ambjax.numerics.smooth import larger, safe_sqrt, smaller
from ambjax.simulation.trajectory import Row, Span, first_time

# Types of the numbers that a fold carries from one sample to the next, and of its result: pytrees.
Carry = TypeVar("Carry")
Result = TypeVar("Result", covariant=True)


class Ending(NamedTuple):
    """The end of a rollout.

    - `lost_code`: status code; 0 if the rotor survives.
    - `lost_at`: time of the loss or of the stall, s; +inf: never.
    - `singular_at`: time of the first crossing of the singular curve C, s; +inf: never.
    - `duration`: horizon of the run, s.
    """

    lost_code: Array
    lost_at: Array
    singular_at: Array
    duration: Array


class Fold(Protocol[Carry, Result]):
    """Interface of a fold: a record that sees each sample of a run once. Its methods work under jit, vmap and grad.

    - `init()`: the carry before the first sample: arrays of fixed shapes.
    - `update(carry, row, span)`: the next carry. `row` contains the signals at the start of a sample; `span` contains
      extremes and integrals of signals from there to the next (`simulation.trajectory.Span`).
    - `result(carry, ending)`: the numbers, as `Result.metrics`. `ending`: loss and duration of the run.
    """

    def init(self) -> Carry: ...
    def update(self, carry: Carry, row: Row, span: Span) -> Carry: ...
    def result(self, carry: Carry, ending: Ending) -> Result: ...


def updated(fold: Fold[Carry, Result], carry: Carry, row: Row, span: Span) -> Carry:
    """Return the next carry of a fold. Raises ValueError if it has another structure or shape, or if `update` fails."""
    try:
        after = fold.update(carry, row, span)
    except (TypeError, AttributeError) as error:  # JAX raises a TypeError where a traced number has no value
        raise ValueError(f"fold: {type(fold).__name__}.update {reason(error)}.") from error
    before, found = (jax.tree.map(jnp.shape, x) for x in (carry, after))
    if before != found:
        raise ValueError(
            f"fold: the carry of {type(fold).__name__} has the shapes {before}, and after `update` {found}: they must "
            "be equal. Return from `update` what `init` returns."
        )
    return after


def _zero() -> Array:
    return jnp.zeros((), jnp.result_type(float))


def _signal(row: Row, name: str) -> Array:
    """Return a signal of a row. Raises ValueError if it has none of this name."""
    if not isinstance(name, str) or not hasattr(row, name):
        raise ValueError(f"of = {name!r}: it must be a signal of a row: {', '.join([*row._fields, 'e_z', 'e'])}.")
    return getattr(row, name)


@record
class OfSignal:
    """Base class of the folds of one signal. By default, two numbers are carried, which are the result."""

    of: str = static(doc="name of the signal, a field of a Row")

    def init(self) -> Any:
        return _zero(), _zero()

    def result(self, carry: Any, ending: Ending) -> Any:
        return carry


@record
class Peak(OfSignal):
    """Largest absolute value of a signal, also between samples if the span contains its extremes."""

    after: Scalar = bounded(0.0, "s", 0, 1e6, "start of the evaluation")
    timed: bool = static(default=False, doc="return (value, time): the start (s) of the sample with the maximum")

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        peak, when = carry
        value = jnp.abs(_signal(row, self.of))
        if self.of in getattr(span.most, "_fields", ()):
            value = larger(value, getattr(span.most, self.of))
        new = (value > peak) & (row.t >= self.after)
        return jnp.where(new, value, peak), jnp.where(new, row.t, when)

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array | tuple[Array, Array]:
        return carry if self.timed else carry[0]


@record
class Lowest(OfSignal):
    """Smallest value of the signal `of` over the samples at which the rotor is held. Result: (value, time in s)."""

    def init(self) -> tuple[Array, Array]:
        return _zero() + jnp.inf, _zero()

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        least, when = carry
        value = _signal(row, self.of)
        new = (value < least) & row.alive
        return jnp.where(new, value, least), jnp.where(new, row.t, when)


@record
class Rms(OfSignal):
    """Root mean square of the signal `of` over the samples from `after` (s) on.

    `driven`: only over the samples before the rotor is lost, while the drive is on.
    """

    after: Scalar = bounded(0.0, "s", 0, 1e6, "start of the evaluation")
    driven: bool = static(default=False)

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        total, count = carry
        counts = (row.t >= self.after) & (row.alive if self.driven else True)
        return total + jnp.where(counts, _signal(row, self.of) ** 2, 0.0), count + counts

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        return safe_sqrt(carry[0] / jnp.maximum(carry[1], 1))


@record
class Driven(OfSignal):
    """Mean over time of the density `of`, from `after` (s) until the rotor is lost; its square root if `root`."""

    after: Scalar = bounded(0.0, "s", 0, 1e6, "start of the evaluation")
    root: bool = static(default=False)

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        counts = row.t >= self.after
        more = getattr(span.densities, self.of), span.time
        total, time = (old + jnp.where(counts, new, 0.0) for old, new in zip(carry, more, strict=True))
        return total, time

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        total, time = carry
        mean = total / jnp.where(time > 0, time, 1.0)
        return safe_sqrt(mean) if self.root else mean


@record
class Variation:
    """Chatter: total variation, V, of the sample means of the voltage, from `after` (s) until the rotor is lost.

    The variation of the voltage itself would include spikes that the signs of the laws cause and that are shorter than
    the rise time of any drive.
    """

    after: Scalar = bounded(0.0, "s", 0, 1e6, "start of the evaluation")

    def init(self) -> tuple[Array, Array, Array]:
        return _zero(), _zero(), jnp.asarray(False)

    def update(self, carry: tuple[Array, Array, Array], row: Row, span: Span) -> tuple[Array, Array, Array]:
        total, before, counting = carry
        value, counts = row.u_mean, row.alive & (row.t >= self.after)
        return total + jnp.where(counts & counting, jnp.abs(value - before), 0.0), value, counts

    def result(self, carry: tuple[Array, Array, Array], ending: Ending) -> Array:
        return carry[0]


@record
class Count(OfSignal):
    """Number of samples at which the boolean signal `of` is true."""

    def init(self) -> Array:
        return _zero()

    def update(self, carry: Array, row: Row, span: Span) -> Array:
        return carry + _signal(row, self.of)


@record
class Reaching(OfSignal):
    """Start of the first sample in which the absolute value of the signal `of` is at most `band`, s; +inf: never."""

    band: Scalar = leaf(above=0, at_most=1e30, doc="the band, in the unit of the signal")

    def init(self) -> Array:
        return _zero() + jnp.inf

    def update(self, carry: Array, row: Row, span: Span) -> Array:
        value = jnp.abs(_signal(row, self.of))
        if self.of in getattr(span.least, "_fields", ()):
            value = smaller(value, getattr(span.least, self.of))
        return first_time((value <= self.band) & row.alive, row.t, carry)


@record
class Named:
    """Several folds by name; the result is a dict."""

    folds: Mapping[str, Fold]

    def init(self) -> dict[str, object]:
        return {name: fold.init() for name, fold in self.folds.items()}

    def update(self, carry: dict[str, object], row: Row, span: Span) -> dict[str, object]:
        return {name: fold.update(carry[name], row, span) for name, fold in self.folds.items()}

    def result(self, carry: dict[str, object], ending: Ending) -> dict[str, Array]:
        return {name: fold.result(carry[name], ending) for name, fold in self.folds.items()}


@record
class PerAxis:
    """A fold of one axis for each axis. `fold`: the folds of the axes, stacked [c]."""

    fold: Any = part(doc="the folds of the axes", channels=True)

    def init(self) -> object:
        return jax.vmap(lambda fold: fold.init())(self.fold)

    def update(self, carry: object, row: Any, span: Span) -> object:
        one = Row(*[0] * len(Row._fields))._replace(t=None, alive=None)  # pyright: ignore[reportArgumentType]
        axes = 0, 0, one, Span(None, 0, 0, 0)  # pyright: ignore[reportArgumentType]
        rows = row.axes._replace(t=row.t, alive=row.alive)
        return jax.vmap(lambda fold, *now: fold.update(*now), in_axes=axes)(self.fold, carry, rows, span)

    def result(self, carry: object, ending: Ending) -> Any:
        return jax.vmap(lambda fold, own: fold.result(own, ending))(self.fold, carry)
