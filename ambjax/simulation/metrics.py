"""The metrics of metrics.json, as folds (`ambjax.simulation.folds`).

Rms errors are evaluated at every sample, also after the rotor is lost; its state is then frozen. Measurement noise is
constant over a sample: u and v_tilde jump at the start of the sample, and i and e respond within it. Values at the
samples are therefore not typical, so extremes include the integrator's substeps; those of flux density and force do
not. The rms voltages and currents, chatter and copper loss are computed over the time during which the drive is on.
"""

from typing import Protocol

import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, bounded, is_traced, leaf, part, positive, record, static
from ambjax.simulation import response
from ambjax.simulation.clock import Clock, Triple
from ambjax.simulation.folds import Count, Driven, Ending, Fold, Named, Peak, Reaching, Rms, Variation
from ambjax.simulation.trajectory import ALIVE, STALLED, Row, Span
from ambjax.world.plant import Plant
from ambjax.world.rotation import Rotation
from ambjax.world.scenario import Scenario

# Times at which a signal first comes within its band; inf: never.
REACHED = ("sigma_reached_s", "v_tilde_reached_s", "current_error_reached_s")
# Relative difference of two times that are taken as equal.
ROUNDING = 1e-9


class SettledCase(Triple, Protocol):
    """A case with a settling time (s), such as that of `read_case`."""

    @property
    def settle(self) -> float: ...


def settled(settle: float, clock: Clock) -> float:
    """Return run.settle, s. Raises ValueError if no sample of the run is at or after it."""
    if is_traced(clock.sample_period):
        return settle
    period = float(np.min(np.asarray(clock.sample_period)))  # the shortest one of an ensemble
    last = (clock.samples - 1) * period
    if settle > (1 + ROUNDING) * last:
        raise ValueError(
            f"run.settle = {settle:g} s: it must be at most {last:.12g} s, the time of the last sample "
            f"(clock.duration = {last + period:g} s). Lower run.settle, or lengthen clock.duration."
        )
    return min(settle, last)


@record
class Metrics:
    """The metrics of metrics.json: a dict of numbers whose names include their units.

    The defaults are for the plant of Table 1; `Metrics.of` scales them to another plant.
    """

    settle: Scalar = bounded(0.5, "s", 0, 1e6, "time from which metrics count as settled")
    touchdown: Scalar = positive(4.5e-3, "m", 1.0, "clearance; `clearance_used` is |z| as a share of it")
    sigma_band: Scalar = positive(1e-3, "m/s", 1e30, "|sigma| that counts as zero")
    v_tilde_band: Scalar = positive(0.1, "A^2/m^2", 1e30, "|v_tilde| that counts as zero")
    e_band: Scalar = positive(1e-3, "A", 1e6, "|current error| that counts as zero")
    largest_force: Scalar = leaf(
        default=float("inf"),
        unit="N",
        above=0,
        at_most=1e30,
        infinite=True,
        doc="largest magnetic force; `force_used` is |force| as a share of it; inf: unknown",
    )
    rotor: Rotation | None = part(
        default=None, doc="speed of the rotor, for amplitude and phase once and twice per revolution; None: none"
    )
    near: str = static(default="z", doc="signal that counts against the clearance: z, or z_stop of a machine")

    @classmethod
    def of(cls, settle: Scalar, scenario: Scenario, near: str = "z") -> "Metrics":
        """Return the metrics for a scenario: its clearance and largest force, and bands by the sizes of its plant.

        `settle`: start of the evaluation of the settled metrics, s. The ratios of the bands are those of the plant of
        Table 1: 4e-4 of the size of sigma, 4e-5 of the size of v, and 4e-3 of i_0.
        """
        if not isinstance(scenario, Scenario):
            raise ValueError(f"scenario = {scenario!r}: it must be a Scenario, such as `case.scenario`.")
        plant, usual, paper = scenario.plant, Metrics(), Plant()
        return Metrics(
            settle,
            scenario.touchdown,
            usual.sigma_band * (plant.sigma_size / paper.sigma_size),
            usual.v_tilde_band * (plant.v_size / paper.v_size),
            usual.e_band * (plant.i_0 / paper.i_0),
            scenario.largest_force,
            scenario.rotor,
            near,
        )

    @classmethod
    def for_case(cls, case: SettledCase) -> "Metrics":
        """Return the metrics for a case of `read_case`: `Metrics.of` with its settling time and its scenario.

        Raises ValueError for anything else, and if the run ends before the settling time.
        """
        if not all(hasattr(case, name) for name in ("settle", "scenario", "clock")):
            raise ValueError(f"case = {type(case).__name__}: it must be a Case, as ambjax.read_case(PATH) returns it.")
        return Metrics.of(settled(case.settle, case.clock), case.scenario)

    def _folds(self) -> Named:
        late = self.settle
        turning: dict[str, Fold] = {} if self.rotor is None else {"orders": response.Orders(self.rotor, late)}
        return Named(
            turning
            | {
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
                "rms_i_A": Rms("i", driven=True),
                "rms_i_1_A": Rms("i_1", driven=True),
                "rms_i_2_A": Rms("i_2", driven=True),
                "copper_loss_W": Driven("heat"),
                "max_flux_T": Peak("B"),
                "max_abs_force_N": Peak("force"),
                "clearance_used": Peak(self.near),
                "settled_clearance_used": Peak(self.near, late),
                "refused": Count("refused"),
            }
        )

    def init(self) -> dict[str, object]:
        return self._folds().init()

    def update(self, carry: dict[str, object], row: Row, span: Span) -> dict[str, object]:
        return self._folds().update(carry, row, span)

    def result(self, carry: dict[str, object], ending: Ending) -> dict[str, Array]:
        """Return each metric by name, in the units of UNITS."""
        numbers = self._folds().result(carry, ending)
        numbers |= numbers.pop("orders", {})
        for name in ("clearance_used", "settled_clearance_used"):
            numbers[name] = numbers[name] / self.touchdown
        numbers["force_used"] = numbers["max_abs_force_N"] / self.largest_force
        status = {
            "lost": (ending.lost_code != ALIVE) & (ending.lost_code != STALLED),
            "stalled": ending.lost_code == STALLED,
            "lost_at_s": ending.lost_at,
            "singular_at_s": ending.singular_at,
        }
        return numbers | status


def _unit(name: str) -> str:
    """Return the unit with which the name of a metric ends; "" for shares and counts."""
    compound = {"m_per_s": "m/s", "A2_per_m2": "A^2/m^2"}
    found = next((end for end in (*compound, *"msVAWTN") if name.endswith(f"_{end}")), "")
    return compound.get(found, found)


_NAMES = (*Metrics()._folds().folds, "lost_at_s", "singular_at_s", "settle_s")
# Unit of each metric by name. Other metrics are shares and counts.
UNITS = {name: _unit(name) for name in _NAMES if _unit(name)} | response.UNITS
