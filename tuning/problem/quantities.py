"""Quantities of an ensemble that may be limited: their folds, and how they combine members."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.cases.tune_table import LOOP_MARGIN, MEAN_MARGIN, WORST_MARGIN
from ambjax.simulation.folds import Driven, Fold, Named, Peak, Rms, Variation
from ambjax.simulation.orders import Orders
from ambjax.simulation.response import Overshoot, Settling
from ambjax.world.rotation import Rotation
from tuning.problem.limit_folds import NORM, TINY, LargestOf, OneOf, Scaled, Typical

# Largest number of members whose loops the search linearises. The judge linearises the loops of all its members, and
# those that break a limit join the search. A loop takes about a tenth of the time of a rollout.
LOOPS = 16


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


def _once(name: str) -> Callable[[LimitContext, float], Fold]:
    def fold(context: LimitContext, threshold: float) -> Fold:
        assert context.rotor is not None
        return OneOf(Orders(context.rotor, context.settle), name=name)

    return fold


def pooled(values: Array) -> Array:
    """Return the root mean square over members."""
    return jnp.sqrt(jnp.mean(values**2) + TINY)


def worst_loop(values: Array) -> Array:
    """Return `largest` over the members whose loops the search linearises."""
    return largest(values[:LOOPS])


def smallest_loop(values: Array) -> Array:
    """Return a smooth minimum over the members whose loops the search linearises: 1 / (16-norm of the inverses)."""
    return 1 / largest(1 / values[:LOOPS])


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
    `tuned`, `judged`: the reduction over members in the search and by the judge.
    """

    unit: str
    words: str
    over: str
    fold: Callable[[LimitContext, float], Fold] | None
    exact: str | None
    tuned: Callable[[Any], Any]
    judged: Callable[[np.ndarray], Any]
    margin: float
    """default margin"""
    worst: bool = False
    """whether the quantity is that of the worst member"""
    at_least: bool = False
    """whether the limit is a lower one"""


_POOLED = {"over": "root mean square over members", "tuned": pooled, "judged": pooled, "margin": MEAN_MARGIN}
_MEAN = {"over": "mean over members", "tuned": jnp.mean, "judged": np.mean, "margin": MEAN_MARGIN}
_WORST = {"over": "of the worst member", "tuned": largest, "judged": np.max, "margin": WORST_MARGIN, "worst": True}
_LOOP = _WORST | {"tuned": worst_loop, "fold": None, "exact": None, "margin": LOOP_MARGIN}

KINDS: dict[str, Kind] = {
    "rms_error_m": Kind(
        "m",
        "root mean square of z - r from run.settle on",
        fold=lambda context, threshold: Rms("e_z", context.settle),
        exact="settled_rms_error_m",
        **_POOLED,
    ),
    "rms_u_V": Kind(
        "V",
        "root mean square voltage from run.settle on",
        fold=lambda context, threshold: Driven("u_squared", context.settle, root=True),
        exact="settled_rms_u_V",
        **_POOLED,
    ),
    "max_u_V": Kind(
        "V",
        "largest voltage of the run",
        fold=lambda context, threshold: Typical("u_peak", threshold),
        exact="max_abs_u_V",
        **_WORST,
    ),
    "max_abs_i_A": Kind(
        "A", "largest current of the run", fold=lambda context, threshold: Peak("i"), exact="max_abs_i_A", **_WORST
    ),
    "rms_coil_A": Kind(
        "A",
        "root mean square current from run.settle on, bias included, of the coil where it is larger",
        fold=lambda context, threshold: LargestOf(
            Named({name: Rms(name, context.settle, driven=True) for name in ("i_1", "i_2")})
        ),
        exact=None,
        **_WORST,
    ),
    "chatter_V_per_s": Kind(
        "V/s",
        "variation of the voltage, averaged over each sample, per second from run.settle on",
        fold=lambda context, threshold: Scaled(Variation(context.settle), context.duration - context.settle),
        exact=None,
        **_MEAN,
    ),
    "largest_error_m": Kind(
        "m",
        "largest |z - r| from run.settle on",
        fold=lambda context, threshold: Peak("e_z", context.settle),
        exact="settled_max_abs_error_m",
        **_WORST,
    ),
    "settling_s": Kind(
        "s",
        "time of the run from which |z - r|, at the samples, stays within settling_band_m",
        fold=lambda context, threshold: Settling(context.band),
        exact=None,
        **_WORST,
    ),
    "overshoot_m": Kind(
        "m",
        "largest distance of z, at the samples, beyond its initial value and the range of r so far",
        fold=lambda context, threshold: Overshoot(),
        exact=None,
        **_WORST,
    ),
    "clearance_used": Kind(
        "",
        "largest |z| as a share of the clearance",
        fold=lambda context, threshold: Scaled(Peak("z"), context.touchdown),
        exact="clearance_used",
        **_WORST,
    ),
    "z_1x_m": Kind(
        "m",
        "amplitude of z at the speed of [rotor], from run.settle on",
        fold=_once("z_1x_m"),
        exact="z_1x_m",
        **_WORST,
    ),
    "i_1x_A": Kind(
        "A",
        "amplitude of the current at the speed of [rotor], from run.settle on",
        fold=_once("i_1x_A"),
        exact="i_1x_A",
        **_WORST,
    ),
    "sensitivity_1x": Kind(
        "", "|S| at the speed of [rotor], at the start and end of the run, of the loop at r = 0", **_LOOP
    ),
    "sensitivity": Kind("", "peak of |S| of the loop linearised at r = 0", **_LOOP),
    "complementary": Kind("", "peak of |T| of the loop linearised at r = 0", **_LOOP),
    "control_sensitivity": Kind("V/m", "peak of |KS| of the loop linearised at r = 0", **_LOOP),
    "delay_margin_s": Kind(
        "s",
        "smallest additional delay that makes the loop, linearised at r = 0, unstable",
        **_LOOP | {"tuned": smallest_loop, "judged": np.min, "at_least": True},
    ),
}
