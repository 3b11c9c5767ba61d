"""Metrics as folds, which process one row at a time and keep a few numbers for a run of any length.

A fold is a record with `init() -> carry`, `update(carry, row, span) -> carry` and `result(carry, ending) -> numbers`.
`row` holds the signals at the start of a sample, and `span` the extremes and integrals from there to the next sample
(`span`, `loop.Sizes`, `loop.Densities`).

Errors include every sample, also those of a lost rotor, which is frozen. Under held noise u, i, e and v_tilde jump at
the start of each sample, where their values are not typical. Extremes of these are therefore taken over the
integrator's substeps. Effort, chatter and copper loss are computed over the time during which the drive is on.
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
    """The end of a rollout.

    - `lost_code`: status code; 0 if the rotor survives.
    - `lost_at`: time of the loss, s; +inf: never.
    - `singular_at`: time of the first crossing of the singular curve C, s; +inf: never.
    - `duration`: horizon of the run, s.
    """

    lost_code: Array
    lost_at: Array
    singular_at: Array
    duration: Array


class Fold(Protocol):
    """Interface of a streaming metric."""

    def init(self) -> Any: ...
    def update(self, carry: Any, row: Any, span: Any) -> Any: ...
    def result(self, carry: Any, ending: Ending) -> Any: ...


def _zero() -> Array:
    return jnp.zeros((), jnp.result_type(float))


@record
class Peak:
    """Largest absolute value of a signal; between samples too, if the span records its extremes.

    - `of`: name of the signal, a field of a Row.
    - `after`: start of the evaluation, s.
    - `timed`: return (value, time), with the start of the sample that contains the maximum, instead of the value.
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
    """Smallest value of the signal `of` at a sample while the rotor is alive, and its time: (value, time)."""

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
    """Root mean square of the signal `of` over the samples from `after` (s) on."""

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
    """Mean over time of the density `of`, from `after` (s) on, while the drive is on; its square root if `root`."""

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
    """Chatter: total variation, V, of the sample means of the voltage, from `after` (s) on, while the drive is on.

    The variation of the voltage itself would include spikes from the signs of the laws, which are shorter than the rise
    time of any drive. With a set-valued sign their number is unbounded.
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
    """Number of samples at which the boolean signal `of` is true."""

    of: str = static()

    def init(self) -> Array:
        return _zero()

    def update(self, carry: Array, row: Any, span: Any) -> Array:
        return carry + getattr(row, self.of)

    def result(self, carry: Array, ending: Ending) -> Array:
        return carry


@record
class Reaching:
    """Start of the first sample in which the absolute value of the signal `of` is within `band`, s; +inf: never."""

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
    """Several folds by name; the result is a dict."""

    folds: Mapping[str, Fold]

    def init(self) -> dict[str, Any]:
        return {name: fold.init() for name, fold in self.folds.items()}

    def update(self, carry: dict[str, Any], row: Any, span: Any) -> dict[str, Any]:
        return {name: fold.update(carry[name], row, span) for name, fold in self.folds.items()}

    def result(self, carry: dict[str, Any], ending: Ending) -> dict[str, Any]:
        return {name: fold.result(carry[name], ending) for name, fold in self.folds.items()}


@record
class Standard:
    """The metrics of metrics.json: a dict of numbers whose names include their units.

    - `settle`: start of the evaluation of the settled metrics, s.
    - `touchdown`: clearance, m; the unit of `clearance_used`.
    - `sigma_band`, `v_tilde_band`, `e_band`: a signal within its band counts as having reached zero.

    The defaults are for the plant of Table 1; `standard_for` scales them to another plant.
    """

    settle: Scalar = leaf(
        default=0.5, unit="s", at_least=0, at_most=1e6, doc="time from which metrics count as settled"
    )
    touchdown: Scalar = leaf(default=4.5e-3, unit="m", above=0, at_most=1.0)
    sigma_band: Scalar = leaf(default=1e-3, unit="m/s", above=0, at_most=1e30)
    v_tilde_band: Scalar = leaf(default=0.1, unit="A^2/m^2", above=0, at_most=1e30)
    e_band: Scalar = leaf(default=1e-3, unit="A", above=0, at_most=1e6)

    def _folds(self) -> Named:
        """Return the fold of each metric by name."""
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
    """Return the metrics for a scenario, with its clearance and with bands in proportion to the sizes of its plant.

    The ratios are those of the plant of Table 1: 4e-4 of the size of sigma, 4e-5 of the size of v, and 4e-3 of i_0.
    """
    plant, usual, paper = scenario.plant, Standard(), Plant()
    return Standard(
        settle,
        scenario.touchdown,
        usual.sigma_band * (plant.sigma_size / paper.sigma_size),
        usual.v_tilde_band * (plant.v_size / paper.v_size),
        usual.e_band * (plant.i_0 / paper.i_0),
    )
