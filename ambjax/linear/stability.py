"""Stability of loops whose rotor is held: stable, or held but not stable. A loop is that of an axis or of a machine.

Two verdicts are combined. The linear one is that of the poles of the loop linearised at r = 0. The simulated one is
that of a quiet run: the case without noise, converter, faults, runout and disturbances, at a constant reference, from a
displaced start. No unbalance and no noise moves the rotor there, so a motion that persists is one that the loop
sustains itself, a limit cycle. A motion counts as sustained if the half peak-to-peak value of z in the last quarter of
the run exceeds SMALL times the clearance, and is not smaller than that of the third quarter by more than DECAY. A creep
does not count, nor does the motion of a stable linear loop whose own decay is that slow.

- A sustained motion is not stable, whatever the linear verdict.
- Without one, an unstable linear loop is not stable either, unless a law evaluates its sign at the start of a sample,
  and the motion had the time to grow and did not: then that sign chatters within SMALL of the clearance. Without such
  a sign, a limit of the supply may keep the motion small, while the voltage alternates between its limits.
- The linear loop of a set-valued sign is valid only inside the band of the sign, so the quiet run alone decides.
- A sign does not excuse a motion that is not its own. To a periodic motion, a sign is a gain between 0 and its slope,
  which decreases with the amplitude. If smoothed signs of all slopes leave the linear loop unstable, the motion grows
  at every amplitude, until something else limits it, and the loop is not stable.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ambjax.control.base import Law, set_valued_signs, steepnesses, with_default_steepness
from ambjax.control.cascade import DEFAULT_LAWS, Cascade
from ambjax.ensemble.blocks import QUARTERS
from ambjax.linear.analysis import linearise_members
from ambjax.linear.quiet_run import KICK, QuietRun, quiet_run
from ambjax.numerics.shapes import map_varying
from ambjax.simulation.clock import Clock, takes_case
from ambjax.world.scenario import Scenario

# Half peak-to-peak value of z, as a share of the clearance, below which a sustained motion does not count. The chatter
# of set-valued signs that act a sample late reaches 0.0025.
SMALL = 0.01
# Decrease of a motion, from one quarter of a quiet run to the next, below which the motion is sustained.
DECAY = 0.1
# Growth exponent of an unstable mode over a run, above which its motion had the time to grow: a factor of 22,000.
GROWN = 10.0
# Growth exponent over a run below which a pole counts as one on the border: rounding moves such poles across it.
BORDER = 1e-3
# Steepnesses of smoothed signs, as shares of the law's own ones, or of the default of a set-valued sign. Before, these
# are reduced so that the rate of the law times the sample period is at most FASTEST, which is well damped.
SOFTER = (1.0, 0.1, 0.01)
FASTEST = 0.25
# Largest number of members of an ensemble whose stability is computed: those with the largest settled errors.
MOST_TESTED = 64


class Stability(NamedTuple):
    """Stability of members whose rotors are held; arrays [N].

    - `stable`: the verdict.
    - `growth`: rate of growth of the least damped mode of the linear loop, 1/s; negative if the loop is stable, NaN
      without a linear verdict.
    - `sustained`: whether the quiet run has a sustained motion, or loses the rotor.
    - `swing`: half peak-to-peak value of z in the last quarter of the quiet run, m; the clearance if the rotor is lost
      there.
    - `current`: largest |i| in the last quarter in which the rotor is held, A.
    - `lost`: whether the rotor is lost in the quiet run.
    - `duration`: length of a run, s. `bias`: bias current, A.
    """

    stable: np.ndarray
    growth: np.ndarray
    sustained: np.ndarray
    swing: np.ndarray
    current: np.ndarray
    lost: np.ndarray
    duration: float
    bias: float

    def of(self, rows: Any) -> "Stability":
        """Return the stability of some members. `rows`: their index in the arrays."""
        return self._replace(**{name: getattr(self, name)[rows] for name in self._fields[:-2]})

    def findings(self) -> "Findings":
        """Return the summary that all reports use."""
        bad = ~self.stable
        worst = None if not bad.any() else int(np.flatnonzero(bad)[np.argmax(self.swing[bad])])
        disagree = np.flatnonzero((self.growth * self.duration > BORDER) != self.sustained)
        disagree = [int(k) for k in disagree if np.isfinite(self.growth[k])]
        shown = min(disagree, key=lambda k: (self.stable[k], -self.swing[k]), default=None)
        swing, current = (None if worst is None else float(x[worst]) for x in (self.swing, self.current))
        reason = None if shown is None else self._reason(shown)
        return Findings(len(self.stable), int(bad.sum()), self.bias, swing, current, reason)

    def _reason(self, k: int) -> str:
        rate = float(self.growth[k])
        if rate <= 0:
            decays = f"the linear loop is stable (its slowest mode decays at {-rate:.3g} 1/s)"
            if self.lost[k]:
                return (
                    f"{decays}, but without loads the rotor is lost from a start displaced by {100 * KICK:g} % of the "
                    "clearance: the start is outside the region in which the linear loop is valid"
                )
            return f"{decays}, but a motion of this size does not decay: a nonlinearity sustains it"
        grows = f"the linear loop is unstable (it grows at {rate:.3g} 1/s)"
        if self.stable[k]:
            return f"{grows}, but the motion stays within {self.swing[k]:.3g} m: it chatters"
        if rate * self.duration > GROWN:
            return f"{grows}, but the limit of the supply or another nonlinearity keeps the motion small"
        return f"{grows}, too slowly to appear in a run of {self.duration:.3g} s"


class Findings(NamedTuple):
    """Summary of a `Stability`; the log, the JSON files, the reports and the exit codes use this record.

    `tested`: number of members. `unstable`: number of members held but not stable. `bias_A`: bias current. `swing_m`,
    `current_A`: amplitude of z and largest |i| of the unstable member with the largest amplitude, in a run without
    noise and loads; None if all are stable. `reason`: why the linear and the simulated verdict differ, for one member;
    None if they agree.
    """

    tested: int
    unstable: int
    bias_A: float = 0.0
    swing_m: float | None = None
    current_A: float | None = None
    reason: str | None = None

    @property
    def stable(self) -> bool:
        """Whether all members are stable."""
        return not self.unstable

    def words(self) -> str:
        """Return the verdict as a sentence; '' if no member was tested."""
        why = "" if self.reason is None else f" The linear and the simulated verdict differ: {self.reason}."
        if self.stable:
            many = "The loop is stable" if self.tested == 1 else f"All {self.tested} members tested are stable"
            return f"{many}: without noise and loads, the motion decays.{why}" if self.tested else ""
        many = "The rotor is held, but the loop is NOT stable"
        if self.tested > 1:
            many = f"{self.unstable} of {self.tested} members tested are held, but NOT stable"
        size = f"amplitude {self.swing_m:.3g} m, |i| up to {self.current_A:.3g} A (bias {self.bias_A:.3g} A)"
        return f"{many}: without noise and loads, the motion does not decay ({size}).{why}"


@takes_case
def stability_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> Stability:
    """Compute the stability of the members of an ensemble, whose varying leaves are arrays [N].

    The result has no meaning for a member whose rotor is lost in the case's own run. Raises ValueError as `rollout`
    does.
    """
    return judged(
        [cascade],
        lambda own, chosen: _growth(*map_varying(lambda x: np.asarray(x)[chosen], (own[0], scenario)), clock),
        quiet_run(cascade, scenario, clock),
        np.asarray(scenario.touchdown, float)[..., None],
        float(np.max(np.asarray(scenario.plant.i_0))),
        clock,
    )


# Largest growth rate of each linear loop that is chosen (bool [N]) with these cascades, 1/s; NaN: no linear verdict.
Growth = Callable[[Sequence[Cascade], np.ndarray], np.ndarray]


def judged(
    cascades: Sequence[Cascade], growth_of: Growth, run: QuietRun, clearance: np.ndarray, bias: float, clock: Clock
) -> Stability:
    """Return the stability of N loops, each with c axes, from both verdicts.

    `cascades`: those with all laws. `run`: the quiet runs. `clearance`: of each axis, m, [N, c] or one for all N.
    `bias`: largest bias current, A.
    """
    duration = float(clock.duration)
    growth, everyone = np.full(len(run.lost), np.nan), np.full(len(run.lost), True)
    if not has_set_valued(cascades):
        growth = growth_of(cascades, everyone)
    clearance = np.broadcast_to(clearance, run.current.shape)
    swing = np.where(run.lost[:, None], clearance, run.swings[..., -1])
    slow = (growth < 0) & (-growth * duration / QUARTERS < -np.log1p(-DECAY))
    large = swing > SMALL * clearance
    persists = (large & (swing > (1 - DECAY) * run.swings[..., -2]) & run.returns).any(1) & ~slow
    sustained = run.lost | persists
    chatters = may_chatter(cascades) & (growth * duration > GROWN) & ~large.any(1)
    excused = run.busy & ~sustained & (chatters | has_set_valued(cascades))
    if excused.any():
        least = _least_growth(cascades, growth_of, excused, clock)
        other = least * duration > GROWN
        growth, chatters = np.where(other, least, growth), chatters & ~other
    stable = ~(sustained | ((growth * duration > BORDER) & ~chatters))
    widest = np.argmax(swing / clearance, axis=1)[:, None]
    size = np.take_along_axis(swing, widest, axis=1)[:, 0]
    return Stability(stable, growth, sustained, size, run.current.max(1), run.lost, duration, bias)


def _signs(cascade: Cascade) -> list[Law]:
    return [law for law in cascade.laws if law.stiff or law.size(cascade.model) is not None]


def has_set_valued(cascades: Sequence[Cascade]) -> bool:
    """Return whether a law has a set-valued sign."""
    return any(set_valued_signs(law) for cascade in cascades for law in cascade.laws)


def may_chatter(cascades: Sequence[Cascade]) -> bool:
    """Return whether a law on a processor evaluates a sign at the start of a sample, as explicit steps do."""
    laws = [(cascade.timing.implicit, law) for cascade in cascades if cascade.sampled for law in _signs(cascade)]
    return not all(implicit and law.has_own_step(True) for implicit, law in laws)


def _least_growth(cascades: Sequence[Cascade], growth_of: Growth, excused: np.ndarray, clock: Clock) -> np.ndarray:
    """Return the least growth rate of each `excused` loop [N] over smoothed signs of the steepnesses SOFTER, 1/s.

    It is NaN without a linear verdict, or if a sign has no steepness. A loop that does not grow is done.
    """
    least, grows = np.full(len(excused), np.nan), excused.copy()
    if not all(steepnesses(law) for cascade in cascades for law in _signs(cascade)):
        return least
    stages = [stage for stage in DEFAULT_LAWS if any(steepnesses(getattr(cascade, stage)) for cascade in cascades)]
    for shares in itertools.product(SOFTER, repeat=len(stages)):
        softer = dict(zip(stages, shares, strict=True))
        own = [_softened(cascade, softer, clock.sample_period) for cascade in cascades]
        least[grows] = np.fmin(least[grows], growth_of(own, grows))
        grows &= ~(least * float(clock.duration) <= GROWN)
        if not grows.any():
            break
    return least


def _softened(cascade: Cascade, shares: dict[str, float], period: Any) -> Cascade:
    """Return the cascade with smoothed signs. `shares`: of the steepnesses SOFTER, by stage. `period`: s."""
    names = {stage: steepnesses(getattr(cascade, stage)) for stage in shares}
    usual = {k: with_default_steepness(getattr(cascade, k), cascade.model) for k in names if names[k]}
    one = dataclasses.replace(cascade, **usual)
    most = {k: np.minimum(1.0, FASTEST / np.asarray(period * one.slopes()[k])) for k in usual}
    laws = {
        stage: dataclasses.replace(
            law, **{name: shares[stage] * most[stage] * getattr(law, name) for name in names[stage]}
        )
        for stage, law in usual.items()
    }
    return dataclasses.replace(cascade, **laws)


def suspects(error: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the indices of the held members with the largest settled errors, ascending, at most MOST_TESTED."""
    alive = np.flatnonzero(held)
    return np.sort(alive[np.argsort(-np.asarray(error)[alive], kind="stable")[:MOST_TESTED]])


def _growth(cascade: Cascade, scenario: Scenario, clock: Clock) -> np.ndarray:
    """Return the largest growth rate of the linear loop of each member [N], 1/s; NaN where there is no verdict."""
    system, found = linearise_members(cascade, scenario, clock)
    A, sizes = np.asarray(system.A), np.asarray(system.sizes)
    known = np.asarray(found, bool) & np.isfinite(A).all((1, 2)) & np.isfinite(sizes).all(1)
    scaled = np.zeros_like(A)
    scaled[known] = A[known] * sizes[known][:, None, :] / sizes[known][:, :, None]
    poles = np.linalg.eigvals(scaled)
    if system.period is None:
        rate = np.real(poles).max(1)
    else:
        rate = np.log(np.maximum(np.abs(poles).max(1), 1e-300)) / float(np.min(np.asarray(system.period)))
    return np.where(known, rate, np.nan)
