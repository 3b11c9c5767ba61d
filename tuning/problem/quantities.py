"""Quantities of an ensemble that may be limited: their folds, and how they combine members."""

import dataclasses
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.cases.tune_table import LOOP_MARGIN, MEAN_MARGIN, WORST_MARGIN
from ambjax.extend import Scalar, leaf, record, static
from ambjax.simulation.folds import Driven, Ending, Fold, Named, Peak, Rms, Variation
from ambjax.simulation.response import Orders, Overshoot, Settling
from ambjax.simulation.trajectory import Row, Span
from ambjax.world.rotation import Rotation

# Largest number of members whose loops the search linearises. The judge linearises the loops of all its members, and
# those that break a limit join the search. A loop takes about a tenth of the time of a rollout.
LOOPS = 16
# Exponent of the norms that approximate maxima. Over 1e4 samples of noise, the maximum is 1.2 to 1.6 times the norm.
NORM = 16
# Differences of logarithms, of a goal or of a limited quantity, that are negligible: 1 %.
NEGLIGIBLE = 0.01
# Limited quantities that an injection measures.
BY_INJECTION = {"sensitivity": "S", "complementary": "T", "control_sensitivity": "KS"}
# Lower bound of the argument of a logarithm.
TINY = 1e-30


@record
class Typical:
    """Fold: the power mean with exponent 16 of |row.`of`| over the samples with the rotor held, a smooth maximum.

    `size`: unit of the signal in the powers. The derivative of a saturated voltage is 0. The power mean also depends on
    unsaturated samples, whose derivatives are not 0.
    """

    of: str = static()
    size: Scalar = leaf(above=0, at_most=1e30)

    def init(self) -> tuple[Array, Array]:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero, zero

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        total, count = carry
        return total + (jnp.abs(getattr(row, self.of)) / self.size) ** NORM, count + row.alive

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        total, count = carry
        mean = total / jnp.maximum(count, 1.0)
        some = mean > TINY
        return self.size * jnp.where(some, jnp.where(some, mean, 1.0) ** (1 / NORM), 0.0)


@record
class Scaled:
    """Fold: the result of another fold, divided by `by`; of several results that of this `name`, or the largest."""

    fold: Fold
    by: Scalar = leaf(default=1.0, above=0, at_most=1e30)
    name: str = static(default="")

    def init(self) -> Any:
        return self.fold.init()

    def update(self, carry: Any, row: Row, span: Span) -> Any:
        return self.fold.update(carry, row, span)

    def result(self, carry: Any, ending: Ending) -> Array:
        found: Any = self.fold.result(carry, ending)
        if isinstance(found, dict):
            each = [found[self.name]] if self.name else found.values()
            found = reduce(lambda a, b: jnp.where(a >= b, a, b), each)
        return found / self.by


@dataclasses.dataclass(frozen=True)
class LimitContext:
    """Quantities of a case that the folds of limits depend on.

    `settle` (s): start of the settled part. `duration` (s): of the run. `touchdown` (m): clearance. `band` (m): of the
    settling time. `rotor`: None if nothing turns.
    """

    settle: float
    duration: float
    touchdown: float
    band: float
    rotor: Rotation | None = None


def pooled(values: Array) -> Array:
    """Return the root mean square over members."""
    return jnp.sqrt(jnp.mean(values**2) + TINY)


def largest(values: Array) -> Array:
    """Return the 16-norm over members: smooth, and not below the maximum."""
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(values), TINY))
    total = jnp.sum((values / top) ** NORM)
    # 0 if all are 0: the derivative of the root is infinite there
    return top * jnp.where(total > 0, total, 1.0) ** (1 / NORM)


@dataclasses.dataclass(frozen=True)
class Kind:
    """A quantity that may be limited.

    `words` describes the quantity of one member, `over` its reduction over members, both for the report. `fold`:
    function of a LimitContext and the limit, which returns the fold that measures the quantity in the search; None: the
    quantity is a field of LoopQuantities, computed from the linearised loop. `exact`: the column of the judge's metrics
    with the exact value; None: the judge evaluates the same fold or loop quantity as the search, on its own members.
    `tuned`, `judged`: the reduction over members in the search and by the judge. `margin`: the default one. `worst`:
    whether the quantity is that of the worst member. `at_least`: whether the limit is a lower one.
    """

    unit: str
    words: str
    fold: Callable[[LimitContext, float], Fold] | None
    exact: str | None
    over: str
    tuned: Callable[[Any], Any]
    judged: Callable[[Any], Any]
    margin: float
    worst: bool = False
    at_least: bool = False


def _once(name: str) -> Callable[[LimitContext, float], Fold]:
    def fold(case: LimitContext, threshold: float) -> Fold:
        assert case.rotor is not None
        return Scaled(Orders(case.rotor, case.settle), name=name)

    return fold


_mean = partial(Kind, over="mean over members", tuned=jnp.mean, judged=np.mean, margin=MEAN_MARGIN)
_pooled = partial(Kind, over="root mean square over members", tuned=pooled, judged=pooled, margin=MEAN_MARGIN)
_worst = partial(Kind, over="of the worst member", tuned=largest, judged=np.max, margin=WORST_MARGIN, worst=True)
# Over the members whose loops the search linearises: a smooth maximum, and a smooth minimum.
_loop = partial(_worst, fold=None, exact=None, tuned=lambda values: largest(values[:LOOPS]), margin=LOOP_MARGIN)
_least = partial(_loop, tuned=lambda values: 1 / largest(1 / values[:LOOPS]), judged=np.min, at_least=True)

KINDS: dict[str, Kind] = {
    "rms_error_m": _pooled(
        "m", "root mean square of z - r from run.settle on",
        lambda case, _: Rms("e_z", case.settle), "settled_rms_error_m",
    ),
    "rms_u_V": _pooled(
        "V", "root mean square voltage from run.settle on",
        lambda case, _: Driven("u_squared", case.settle, root=True), "settled_rms_u_V",
    ),
    "max_u_V": _worst("V", "largest voltage of the run", lambda case, most: Typical("u_peak", most), "max_abs_u_V"),
    "max_abs_i_A": _worst("A", "largest current of the run", lambda case, _: Peak("i"), "max_abs_i_A"),
    "rms_coil_A": _worst(
        "A", "root mean square current from run.settle on, bias included, of the coil where it is larger",
        lambda case, _: Scaled(Named({name: Rms(name, case.settle, driven=True) for name in ("i_1", "i_2")})), None,
    ),
    "chatter_V_per_s": _mean(
        "V/s", "variation of the voltage, averaged over each sample, per second from run.settle on",
        lambda case, _: Scaled(Variation(case.settle), case.duration - case.settle), None,
    ),
    "largest_error_m": _worst(
        "m", "largest |z - r| from run.settle on", lambda case, _: Peak("e_z", case.settle), "settled_max_abs_error_m"
    ),
    "settling_s": _worst(
        "s", "time of the run from which |z - r|, at the samples, stays within settling_band_m",
        lambda case, _: Settling(case.band), None,
    ),
    "overshoot_m": _worst(
        "m", "largest distance of z, at the samples, beyond its initial value and the range of r so far",
        lambda case, _: Overshoot(), None,
    ),
    "clearance_used": _worst(
        "", "largest |z| as a share of the clearance",
        lambda case, _: Scaled(Peak("z"), case.touchdown), "clearance_used",
    ),
    "z_1x_m": _worst("m", "amplitude of z at the speed of [rotor], from run.settle on", _once("z_1x_m"), "z_1x_m"),
    "i_1x_A": _worst(
        "A", "amplitude of the current at the speed of [rotor], from run.settle on", _once("i_1x_A"), "i_1x_A"
    ),
    "sensitivity_1x": _loop("", "|S| at the speed of [rotor], at the start and end of the run, of the loop at r = 0"),
    "sensitivity": _loop("", "peak of |S| of the loop linearised at r = 0"),
    "complementary": _loop("", "peak of |T| of the loop linearised at r = 0"),
    "control_sensitivity": _loop("V/m", "peak of |KS| of the loop linearised at r = 0"),
    "delay_margin_s": _least("s", "smallest additional delay that makes the loop, linearised at r = 0, unstable"),
}  # fmt: skip
