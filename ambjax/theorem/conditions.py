"""The conditions of Theorem 1 along a run: margins, and the time of each worst value.

The conditions are k > Q_z, k_i > Q_i, gamma > Delta_1 (Eq. 7), and (z, i_ref) off the singular curve C (Eq. 9). Each
law declares the gain that its condition bounds (`Requirement`). For a law without such a gain the condition is not
applicable, nor is that on C with an inversion law that is not singular there (`linearised`). The steps of the proof are
reported as residuals (see `ambjax.theorem.proof`).
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import DEFAULT_LAWS, Cascade
from ambjax.control.schedule import extremes, schedules
from ambjax.control.stages import PositionLaw
from ambjax.numerics.records import canonical, require_concrete
from ambjax.numerics.shapes import require_one_member
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.folds import Lowest, Named, Peak
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.rollout import prepare, roll
from ambjax.simulation.system import check_inputs
from ambjax.simulation.trajectory import STALLED, STATUSES
from ambjax.theorem.causes import Cause
from ambjax.theorem.proof import Monitored
from ambjax.world.plant import Plant
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference, Signal, reference_at


@dataclasses.dataclass(frozen=True)
class Condition:
    """One condition `gain` > `against` (>= for a gain that must be constant), evaluated along a run.

    `requires`: the condition as text. `gain`, `against`: its left and right side, in `unit`; `gain` is None if the law
    has no such gain. `at_s`: time of the worst value, s. `holds`: None for a line that is only informative, or if
    `gain` is None. `path`, `over`: path of the gain in a case file and name of the right side; '' if the left side is
    not a gain of a law in use. `ideal`: whether `against` depends on the reference only, not on the run.
    """

    name: str
    requires: str
    gain: float | None
    against: float
    at_s: float
    unit: str
    holds: bool | None
    note: str = ""
    path: str = ""
    over: str = ""
    ideal: bool = False

    @property
    def margin(self) -> float | None:
        """The left side minus the right side: positive where the condition holds (0 for a gain that is constant)."""
        return None if self.gain is None else self.gain - self.against


@dataclasses.dataclass(frozen=True)
class Report:
    """All conditions, the proof's residuals, and the status of the run."""

    conditions: list[Condition]
    proof: list[Condition]
    lost_at: float
    lost_why: str
    method: str
    stalled: bool = False
    largest_z: float | None = None
    """largest |z| after `settle`, m; None if the run ends early"""
    cause: Cause | None = None
    """cause of a lost rotor, from `causes.find_cause`; None if it was not searched for"""

    @property
    def lost(self) -> bool:
        """Whether the rotor is lost. False if the integrator stalled: the status is then unknown."""
        return math.isfinite(self.lost_at) and not self.stalled

    @property
    def holds(self) -> bool:
        """Whether no condition fails and the rotor is held to the end."""
        return math.isinf(self.lost_at) and not any(c.holds is False for c in self.conditions)


class Side(NamedTuple):
    """One way to compute the right side of a condition: the peak of `signal` along the run.

    `signal` None: the right side is computed for the ideal motion z = r. `name`: name of the condition. `where`: text
    after the symbol of the right side.
    """

    name: str
    signal: str | None
    where: str = ""


# Right sides by their name in `Requirement.over`.
SIDES = {
    "Q_z": (Side("disturbance of z", "q_z"),),
    "Q_i": (Side("disturbance of i", "q_i"),),
    "Delta_1": (Side("inversion", "d", " along the run"), Side("inversion, ideal", None, " along the reference")),
}


class Required(NamedTuple):
    """Requirement on one law: name, dotted path and unit of the gain, symbol of the right side, value of the gain."""

    gain: str
    path: str
    unit: str
    over: str
    value: Any


PEAKS = ("q_z", "q_i", "d", "q_z_plus_h", "sigma_residual", "v_tilde_residual", "e_residual")


@takes_case
def check(cascade: Cascade, scenario: Scenario, clock: Clock, settle: float = 0.0) -> Report:
    """Simulate the loop once in continuous time and evaluate the conditions of Theorem 1 along the run.

    A processor is ignored, with the parts of the scenario that require one (`Scenario.in_continuous_time`); set-valued
    signs then get the default steepness. `settle`: start of the evaluation of |z|, s. Raises ValueError as `rollout`
    does.
    """
    require_concrete("check", (cascade, scenario, clock))
    require_one_member({"controller": cascade, "scenario": scenario, "clock": clock})
    check_inputs(cascade, scenario, clock)
    if cascade.sampled:
        cascade, clock = cascade.in_continuous_time(), clock.with_method(None)
        scenario = scenario.in_continuous_time()
    loop, clock = prepare(cascade, scenario, clock)
    assert isinstance(loop, ClosedLoop)
    method = str(clock.method)
    peaks = {name: Peak(name, timed=True) for name in PEAKS} | {"z": Peak("z", settle, timed=True)}
    folds = Named(peaks | {name: Lowest(name) for name in ("distance", "V_margin")})
    system, clock, fold = canonical((Monitored(loop), clock, folds))
    trajectory, extremes = roll(system, clock, fold, record_every=0)
    worst = {name: (float(value), float(at)) for name, (value, at) in extremes.items()}
    on_reference = delta_1_on_reference(cascade, scenario, clock)
    conditions = _conditions(cascade, worst, on_reference)
    code, lost_at = int(trajectory.lost_code), float(trajectory.lost_at)
    largest = worst["z"][0] if math.isinf(lost_at) else None
    return Report(conditions, _proof(worst), lost_at, STATUSES[code], method, code == STALLED, largest)


@takes_case
def delta_1_on_reference(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[float, float]:
    """Return the largest |v_star' - (dv/dz) r_dot| on the ideal motion z = r (A^2/m^2/s), and its time (s).

    This is Eq. (7) without disturbances and transients. To follow the reference, gamma must exceed this number.
    """
    count = min(clock.samples, 20_000)
    times = np.arange(count) * (float(clock.duration) / count)
    values = np.asarray(_drift(*canonical((cascade.model, scenario.realised().reference, times))))
    worst = int(np.argmax(values))
    return float(values[worst]), float(times[worst])


@jax.jit
def _drift(model: Plant, reference: Signal, times: Array) -> Array:
    def demanded(t: Array) -> Array:
        r, _, r_ddot, _ = reference_at(reference, t)
        return (-2 * model.k_z / model.m * r + r_ddot + model.g) / model.a

    def drift(t: Array) -> Array:
        r, r_dot, *_ = reference_at(reference, t)
        v_star, v_star_dot = jax.jvp(demanded, (t,), (jnp.ones_like(t),))
        return jnp.abs(v_star_dot - model.dv_dz(r, model.current_for(r, v_star)) * r_dot)

    return jax.vmap(drift)(times)


def required(cascade: Cascade) -> list[Required]:
    """Return the requirement of Theorem 1 on each law, in the order of the conditions.

    The value of a scheduled gain is the smallest of its schedule. An observer is included only if it has a
    requirement. Raises ValueError for an unknown right side.
    """
    rows = []
    for stage in ("position", "current", "inversion", "observer"):
        law, paper = getattr(cascade, stage), DEFAULT_LAWS[stage].requirement
        own = law.requirement
        requirement, kind = (own, type(law)) if own else (paper, DEFAULT_LAWS[stage])
        if requirement is None:
            continue
        if requirement.over not in SIDES:
            raise ValueError(
                f"{kind.__name__}.requirement.over = '{requirement.over}': it must be one of {', '.join(SIDES)}."
            )
        unit = next(field.metadata["unit"] for field in dataclasses.fields(kind) if field.name == requirement.gain)
        value = getattr(extremes(law)[0], requirement.gain) if own else None
        rows.append(Required(requirement.gain, f"controller.{stage}.{requirement.gain}", unit, requirement.over, value))
    return rows


def _conditions(
    cascade: Cascade, worst: dict[str, tuple[float, float]], on_reference: tuple[float, float]
) -> list[Condition]:
    def line(one: Required, name: str, over: str, side: tuple[float, float], ideal: bool = False) -> Condition:
        requires, (against, at) = f"{one.gain} > {over}", side
        if one.value is None:
            return Condition(name, requires, None, against, at, one.unit, None, "the law in use has no such condition")
        gain, path = float(one.value), one.path
        return Condition(name, requires, gain, against, at, one.unit, gain > against, "", path, over, ideal)

    requirements, lines = required(cascade), []
    for one in requirements:
        for side in SIDES[one.over]:
            against = worst[side.signal] if side.signal else on_reference
            lines.append(line(one, side.name, one.over + side.where, against, ideal=not side.signal))
    distance, at = worst["distance"]
    remarks = [
        dataclasses.replace(
            line(one, "remark 3", "sup |q_z + h|", worst["q_z_plus_h"]),
            holds=None,
            note=f"optional in the paper: if it holds, {one.gain} exceeds the effect of transients of the inversion",
        )
        for one in requirements
        if one.over == "Q_z"
    ]
    curve = "distance of (z/s_0, i_ref/i_0) to C > 0"
    lines += constant_sigma(cascade.position)
    holds, note = (distance > 0, "") if cascade.inversion.singular else (None, "the law in use has no such condition")
    return [*lines, Condition("singular curve C", curve, distance, 0.0, at, "1", holds, note), *remarks]


def constant_sigma(law: PositionLaw) -> list[Condition]:
    """Return a condition for each scheduled gain on which sigma depends; the theorem holds for constant ones only."""
    rows, plain, one, zero = [], extremes(law)[0], jnp.ones(()), jnp.zeros(())
    motion, reference = Measurement(one, one, zero), Reference(zero, zero, zero)
    for name, schedule in schedules(law).items():
        low, high = (dataclasses.replace(plain, **{name: x}) for x in (1.0, 2.0))
        if low.sigma(motion, reference) != high.sigma(motion, reference):
            ratio = float(max(schedule.values) / min(schedule.values))
            requires = f"{name} constant: 1 >= its largest value over its smallest"
            note = f"the theorem holds for a constant {name} only; schedule another gain"
            rows.append(Condition("sliding variable", requires, 1.0, ratio, 0.0, "1", ratio <= 1, note))
    return rows


def _proof(worst: dict[str, tuple[float, float]]) -> list[Condition]:
    lines = [
        ("Eq. (12)", "sigma' = -k sgn(sigma) + q_z + h", "sigma_residual", "m/s"),
        ("Eq. (14a)", "v_tilde' = -gamma sgn(v_tilde) + d", "v_tilde_residual", "A^2/m^2"),
        ("Eq. (14b)", "e' = -k_i sgn(e) + q_i", "e_residual", "A"),
    ]
    rows = [Condition(name, says, None, *worst[key], unit, None, "largest residual") for name, says, key, unit in lines]
    margin, at = worst["V_margin"]
    bound = "V' <= -2 (k |sgn(sigma)| - |q_z|) |sigma| + 2 a |sigma| (L_v |e| + |v_tilde|)"
    rows.append(Condition("V = sigma^2", bound, None, margin, at, "m^2/s^3", None, "smallest distance below the bound"))
    return rows
