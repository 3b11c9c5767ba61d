"""Metrics as folds: they see one row at a time and keep a few numbers, whatever the length of the run.

A fold is a record with `init() -> carry`, `update(carry, row, span) -> carry` and
`result(carry, ending) -> numbers`: `row` is the start of a sample, `span` what the integrator saw from there to the
next (`span`, `loop.Sizes`, `loop.Densities`). Errors count every sample, a lost rotor's too (frozen where it was
lost). Under held noise u, i, e and v_tilde are not smooth, and the start of a sample is where they have just
jumped: so extremes are taken over the integrator's substeps, and effort, chatter and copper loss over time, while the
drive is on.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.numerics.smooth import safe_sqrt
from ambjax.simulation.trajectory import ALIVE, STALLED, first_time
from ambjax.world.plant import Plant


class Ending(NamedTuple):
    """How a rollout ended: code and time (s, +inf: never) of the loss, first crossing of C, horizon in s."""

    lost_code: Array
    lost_at: Array
    singular_at: Array
    duration: Array


class Fold(Protocol):
    """A streaming metric."""

    def init(self) -> Any: ...
    def update(self, carry: Any, row: Any, span: Any) -> Any: ...
    def result(self, carry: Any, ending: Ending) -> Any: ...


def _zero() -> Array:
    return jnp.zeros((), jnp.result_type(float))


@record
class Peak:
    """Largest |row.`of`| from `after` on, and when; between samples too for the signals that a span shows the size of.

    `timed`: the time is that of the sample in which it was reached.
    """

    of: str = static()
    after: Scalar = leaf(default=0.0, unit="s", at_least=0, at_most=1e6)
    timed: bool = static(default=False)

    def init(self) -> tuple[Array, Array]:
        return _zero(), _zero()

    def update(self, carry: tuple[Array, Array], row: Any, span: Any) -> tuple[Array, Array]:
        peak, when = carry
        value = jnp.abs(getattr(row, self.of))
        if self.of in getattr(span.most, "_fields", ()):
            value = jnp.maximum(value, getattr(span.most, self.of))
        larger = (value > peak) & (row.t >= self.after)
        return jnp.where(larger, value, peak), jnp.where(larger, row.t, when)

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Any:
        return carry if self.timed else carry[0]


@record
class Lowest:
    """Smallest row.`of` and when: (value, time)."""

    of: str = static()

    def init(self) -> tuple[Array, Array]:
        return _zero() + jnp.inf, _zero()

    def update(self, carry: tuple[Array, Array], row: Any, span: Any) -> tuple[Array, Array]:
        least, when = carry
        value = getattr(row, self.of)
        smaller = (value < least) & row.alive
        return jnp.where(smaller, value, least), jnp.where(smaller, row.t, when)

    def result(self, carry: tuple[Array, Array], ending: Ending) -> tuple[Array, Array]:
        return carry


@record
class Rms:
    """Root mean square of row.`of` over the samples from `after` on."""

    of: str = static()
    after: Scalar = leaf(default=0.0, unit="s", at_least=0, at_most=1e6)

    def init(self) -> tuple[Array, Array]:
        return _zero(), _zero()

    def update(self, carry: tuple[Array, Array], row: Any, span: Any) -> tuple[Array, Array]:
        total, count = carry
        counts = row.t >= self.after
        return total + jnp.where(counts, getattr(row, self.of) ** 2, 0.0), count + counts

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        return safe_sqrt(carry[0] / jnp.maximum(carry[1], 1))


@record
class Driven:
    """Mean over time of span.densities.`of` from `after` on, while the drive is on; its root if `root`."""

    of: str = static()
    after: Scalar = leaf(default=0.0, unit="s", at_least=0, at_most=1e6)
    root: bool = static(default=False)

    def init(self) -> tuple[Array, Array]:
        return _zero(), _zero()

    def update(self, carry: tuple[Array, Array], row: Any, span: Any) -> tuple[Array, Array]:
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
    """Total variation from `after` on, V, of the voltage averaged over each sample, while the drive is on: chatter.

    Of the voltage itself it would count spikes of the laws' signs, shorter than any drive's rise time and, with a
    set-valued sign, without number.
    """

    after: Scalar = leaf(default=0.0, unit="s", at_least=0, at_most=1e6)

    def init(self) -> tuple[Array, Array, Array]:
        return _zero(), _zero(), jnp.asarray(False)

    def update(self, carry: tuple[Array, Array, Array], row: Any, span: Any) -> tuple[Array, Array, Array]:
        total, before, counting = carry
        value, counts = row.u_mean, row.alive & (row.t >= self.after)
        return total + jnp.where(counts & counting, jnp.abs(value - before), 0.0), value, counts

    def result(self, carry: tuple[Array, Array, Array], ending: Ending) -> Array:
        return carry[0]


@record
class Count:
    """Number of samples in which row.`of` holds."""

    of: str = static()

    def init(self) -> Array:
        return _zero()

    def update(self, carry: Array, row: Any, span: Any) -> Array:
        return carry + getattr(row, self.of)

    def result(self, carry: Array, ending: Ending) -> Array:
        return carry


@record
class Reaching:
    """Start of the sample in which |row.`of`| first comes within `band`, s; +inf if it never does."""

    of: str = static()
    band: Scalar = leaf(above=0, at_most=1e30)

    def init(self) -> Array:
        return _zero() + jnp.inf

    def update(self, carry: Array, row: Any, span: Any) -> Array:
        value = jnp.abs(getattr(row, self.of))
        if self.of in getattr(span.least, "_fields", ()):
            value = jnp.minimum(value, getattr(span.least, self.of))
        return first_time((value <= self.band) & row.alive, row.t, carry)

    def result(self, carry: Array, ending: Ending) -> Array:
        return carry


@record
class Named:
    """Several folds at once, by name."""

    folds: Mapping[str, Fold]

    def init(self) -> dict[str, Any]:
        return {name: fold.init() for name, fold in self.folds.items()}

    def update(self, carry: dict[str, Any], row: Any, span: Any) -> dict[str, Any]:
        return {name: fold.update(carry[name], row, span) for name, fold in self.folds.items()}

    def result(self, carry: dict[str, Any], ending: Ending) -> dict[str, Any]:
        return {name: fold.result(carry[name], ending) for name, fold in self.folds.items()}


@record
class Standard:
    """The metrics of metrics.json: a dict of numbers named with their units.

    `settle` (s) is when "settled" begins, `touchdown` (m) what "clearance used" is a share of; within its band a signal
    counts as having reached zero. The defaults are those for the plant of Table 1: see `standard_for`.
    """

    settle: Scalar = leaf(
        default=0.5, unit="s", at_least=0, at_most=1e6, doc="time from which metrics count as settled"
    )
    touchdown: Scalar = leaf(default=4.5e-3, unit="m", above=0, at_most=1.0)
    sigma_band: Scalar = leaf(default=1e-3, unit="m/s", above=0, at_most=1e30)
    v_tilde_band: Scalar = leaf(default=0.1, unit="A^2/m^2", above=0, at_most=1e30)
    e_band: Scalar = leaf(default=1e-3, unit="A", above=0, at_most=1e6)

    def _folds(self) -> Named:
        late = self.settle
        return Named(
            {
                "max_abs_error_m": Peak("e_z"),
                "rms_error_m": Rms("e_z"),
                "settled_max_abs_error_m": Peak("e_z", late),
                "settled_rms_error_m": Rms("e_z", late),
                "settled_max_abs_sigma_m_per_s": Peak("sigma", late),
                "settled_max_abs_v_tilde_A2_per_m2": Peak("v_tilde", late),
                "settled_max_abs_current_error_A": Peak("e", late),
                "sigma_reached_s": Reaching("sigma", self.sigma_band),
                "v_tilde_reached_s": Reaching("v_tilde", self.v_tilde_band),
                "current_error_reached_s": Reaching("e", self.e_band),
                "max_abs_u_V": Peak("u_peak"),
                "rms_u_V": Driven("u_squared", root=True),
                "settled_rms_u_V": Driven("u_squared", late, root=True),
                "chatter_V": Variation(late),
                "max_abs_i_A": Peak("i"),
                "copper_loss_W": Driven("heat"),
                "clearance_used": Peak("z"),
                "refused": Count("refused"),
            }
        )

    def init(self) -> dict[str, Any]:
        return self._folds().init()

    def update(self, carry: dict[str, Any], row: Any, span: Any) -> dict[str, Any]:
        return self._folds().update(carry, row, span)

    def result(self, carry: dict[str, Any], ending: Ending) -> dict[str, Any]:
        numbers = self._folds().result(carry, ending)
        numbers["clearance_used"] = numbers["clearance_used"] / self.touchdown
        status = {
            "lost": (ending.lost_code != ALIVE) & (ending.lost_code != STALLED),
            "stalled": ending.lost_code == STALLED,
            "lost_at_s": ending.lost_at,
            "singular_at_s": ending.singular_at,
        }
        return numbers | status


def standard_for(settle: Scalar, scenario: Any) -> Standard:
    """The metrics of a scenario: its own clearance, and bands that are the same share of the plant's sizes as those
    of Table 1's: 4e-4 of sigma's, 4e-5 of v's, 4e-3 of i_0."""
    plant, usual, paper = scenario.plant, Standard(), Plant()
    return Standard(
        settle,
        scenario.touchdown,
        usual.sigma_band * (plant.sigma_size / paper.sigma_size),
        usual.v_tilde_band * (plant.v_size / paper.v_size),
        usual.e_band * (plant.i_0 / paper.i_0),
    )
