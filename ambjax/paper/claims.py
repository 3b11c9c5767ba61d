"""The claims of the paper's Section 4 and abstract, each with the function that evaluates it.

The function of a claim takes the evidence of one reading, and returns a number, a verdict and the cause of the verdict.
Verdicts are computed from the runs and checks in `ambjax.paper.evidence`. The exception is the claim on the share of
the noise in the gap: its verdict follows from printed numbers.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from ambjax.numerics.records import Scalar
from ambjax.paper.evidence import BASIN, NOISE_STDS, UNCERTAIN, Evidence, Run
from ambjax.paper.readings import PULSE, SETTLE, TABLE_2
from ambjax.simulation.trajectory import Row
from ambjax.world.plant import Plant

SIGMA_RADIUS, TRACKING_ERROR, INVERSION_TIME = 6e-6, 2.3e-5, 0.01
GAP = float(Plant().s_0)

HOLDS, FAILS, OPEN = "holds", "does not hold", "not determined by the paper"
# Verdict if a run stalled, so that it is not known whether the rotor survives.
UNDECIDED = "not decided"
STALLED = "the integrator could not meet its tolerance, so whether the rotor survives is not known"


@dataclasses.dataclass(frozen=True)
class Finding:
    """The result of one claim in one reading: in words, as a number, the verdict, and its cause."""

    ours: str
    value: float | None
    verdict: str
    cause: str


def finding(ours: str, value: float, condition: bool, cause: str) -> Finding:
    """Return the finding of a claim that holds under `condition` and otherwise fails."""
    return Finding(ours, value, HOLDS if condition else FAILS, cause)


def finding_if_lost(run: Run, evidence: Evidence) -> Finding | None:
    """Return the finding on a claim about a run that is lost or stalled; None if the run reached its end."""
    if math.isinf(run.metrics["lost_at_s"]):
        return None
    if run.metrics["stalled"]:
        return Finding(f"stalled at {run.metrics['lost_at_s'] * 1e3:.1f} ms", None, UNDECIDED, STALLED)
    inversion = next(c for c in evidence.check_tracking.conditions if c.name == "inversion, ideal")
    words = f"rotor lost at {run.metrics['lost_at_s'] * 1e3:.1f} ms"
    cause = run.trajectory.lost_why
    if inversion.gain is not None and inversion.gain <= inversion.against:
        cause = f"gamma = {inversion.gain:g} < Delta_1 = {inversion.against:.3g} A^2/m^2/s, Eq. (7)"
    return Finding(words, None, FAILS, cause)


def largest_in(rows: Row, name: str, begin: Scalar, end: Scalar) -> float:
    """Return the largest |signal| in begin <= t < end."""
    return float(np.abs(getattr(rows, name)[(rows.t >= begin) & (rows.t < end)]).max())


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim: its statement, its section, the number of the paper, the criterion, and the function of the evidence."""

    says: str
    where: str
    paper: str
    criterion: str
    judge: Callable[[Evidence], Finding]


CLAIMS: list[Claim] = []
Judge = Callable[[Evidence], Finding]


def claim(says: str, where: str, paper: str, criterion: str, *runs: str) -> Callable[[Judge], Judge]:
    """Decorator that adds a claim to CLAIMS; the decorated function evaluates it, unless one of `runs` ends early."""

    def enter(judge: Judge) -> Judge:
        def judged(evidence: Evidence) -> Finding:
            ended = (finding_if_lost(getattr(evidence, run), evidence) for run in runs)
            return next(filter(None, ended), None) or judge(evidence)

        CLAIMS.append(Claim(says, where, paper, criterion, judged))
        return judge

    return enter


@claim("Theorem 1's conditions hold under Table 2", "3.5", "assumed", "every margin positive, both scenarios")
def _theorem(evidence: Evidence) -> Finding:
    lines = [c for report in (evidence.check_regulation, evidence.check_tracking) for c in report.conditions]
    given = [c for c in lines if c.holds is not None and c.gain]
    tightest = min(given, key=lambda c: (c.margin or 0.0) / (c.gain or 1.0))
    share = 100 * (tightest.margin or 0.0) / (tightest.gain or 1.0)
    failing = [c for c in lines if c.holds is False]
    ideal = [c for c in failing if c.name == "inversion, ideal"]
    tightest = ideal[0] if ideal else tightest
    cause = f"{tightest.requires}: {tightest.gain:g} against {tightest.against:.3g} at t = {tightest.at_s:.4g} s"
    words = f"{len(failing)} of {len(lines)} conditions fail" if failing else f"tightest margin {share:.0f} %"
    if not failing and (evidence.check_regulation.stalled or evidence.check_tracking.stalled):
        return Finding(words, share, UNDECIDED, STALLED)
    return finding(words, share, not failing, cause)


@claim(
    "The origin is uniformly asymptotically stable", "abstract, 3.5", "proven",
    "rotor held after a start at rest at z(0) != 0 with the equilibrium currents, and after one with zero currents",
)  # fmt: skip
def _stable(evidence: Evidence) -> Finding:
    basin, unknown = evidence.basin
    share = 100 * basin / GAP
    cause = f"held after a start at |z(0)| up to {basin:.1e} m, {share:.2g} % of the gap ({len(BASIN)} values tried)"
    if unknown is not None:
        cause += f"; not decided at {unknown:.1e} m, where the integrator stalled"
    if ended := finding_if_lost(evidence.regulation, evidence):
        cause += f"; from i = i_ref = 0: {ended.ours}"
    verdict = HOLDS if basin > 0 and ended is None else UNDECIDED
    if (basin == 0 and unknown is None) or (ended is not None and ended.verdict == FAILS):
        verdict = FAILS
    return Finding(f"basin {basin:.1e} m", basin, verdict, cause)


@claim(
    "Regulation: z and i converge to their references", "4", "-",
    "last 0.1 s: |z| < 1e-6 m and |i - i_ref| < 1e-3 A", "regulation",
)  # fmt: skip
def _converges(evidence: Evidence) -> Finding:
    rows = evidence.regulation.trajectory.rows
    z, e = largest_in(rows, "e_z", 1.9, 2.0), largest_in(rows, "e", 1.9, 2.0)
    cause = "over the last 0.1 s, 0.6 s after the pulse"
    return finding(f"{z:.1e} m, {e:.1e} A", z, z < 1e-6 and e < 1e-3, cause)


@claim(
    "sigma reaches a neighbourhood of 0 in finite time", "4", "finite",
    "|sigma| <= 6e-6 m/s held from 0.1 s to the pulse", "regulation",
)  # fmt: skip
def _finite_time(evidence: Evidence) -> Finding:
    rows = evidence.regulation.trajectory.rows
    early = rows.t < PULSE.start
    outside = np.flatnonzero(np.abs(rows.sigma[early]) > SIGMA_RADIUS)
    at = float(rows.t[early][outside[-1]]) if outside.size else 0.0
    cause = "last time before the pulse that |sigma| > 6e-6 m/s"
    return finding(f"{at:.4g} s", at, at < 0.1, cause)


@claim(
    "sigma's neighbourhood has radius 6e-6", "4", "6e-6 m (sic: m/s)",
    "|sigma| <= 6.3e-6 m/s from 0.5 s to the end of the pulse", "regulation",
)  # fmt: skip
def _radius(evidence: Evidence) -> Finding:
    rows = evidence.regulation.trajectory.rows
    quiet, pulse = largest_in(rows, "sigma", SETTLE, PULSE.start), largest_in(rows, "sigma", PULSE.start, PULSE.stop)
    worst = max(quiet, pulse)
    cause = f"{quiet:.1e} m/s before the pulse, {pulse:.1e} in it; for no noise, finite p: k 2/pi arctan(p sigma) = q_z"
    return finding(f"{worst:.1e} m/s", worst, worst <= 1.05 * SIGMA_RADIUS, cause)


@claim(
    "That radius is due to the noise of variance 1e-7", "4", f"std {TABLE_2.noise_std:.2e} m",
    "radius reached at 0.8 to 1.25 times the printed std, at one of the sample periods tried",
)  # fmt: skip
def _radius_by_noise(evidence: Evidence) -> Finding:
    stds = {n.sample_period: n.std_for(SIGMA_RADIUS) for n in evidence.noise}
    hits = {period: std for period, std in stds.items() if std is not None}
    if not hits:
        verdict = UNDECIDED if any(n.undecided for n in evidence.noise) else FAILS
        ended = finding_if_lost(evidence.regulation, evidence)
        return ended or Finding("at no std scanned", None, verdict, "see the noise table")
    nearest = max(hits.values())
    cause = f"the printed std is {TABLE_2.noise_std / nearest:.0f} times the largest that gives this radius"
    words = "at std " + ", ".join(f"{std:.1e} m, period {period:g} s" for period, std in hits.items())
    return finding(words, nearest, 0.8 <= nearest / TABLE_2.noise_std <= 1.25, cause)


def _pulse(says: str, name: str) -> None:
    @claim(says, "4", "-", "pulse changes z by at most 2.3e-5 m, the paper's own accuracy", name)
    def judge(evidence: Evidence) -> Finding:
        run, formula = getattr(evidence, name), "with finite p, by q_z pi / (2 c k p)"
        change = float(np.abs(run.trajectory.rows.z - run.quiet.rows.z).max())
        cause = f"the pulse moves the rotor by {100 * change / GAP:.2g} % of the gap; {formula}"
        return finding(f"{change:.3e} m", change, change <= TRACKING_ERROR, cause)


_pulse("Regulation is insensitive to the pulse", "regulation")


def _inversion(name: str) -> None:
    says = f"{name.capitalize()}: inversion error zero in less than 0.01 s"

    @claim(says, "4", "< 0.01 s", "|v_tilde| <= 0.1 A^2/m^2 before 0.01 s", name)
    def judge(evidence: Evidence) -> Finding:
        metrics = getattr(evidence, name).metrics
        at, late = metrics["v_tilde_reached_s"], metrics["settled_max_abs_v_tilde_A2_per_m2"]
        cause = f"first |v_tilde| <= 0.1 A^2/m^2; after {SETTLE} s it stays within {late:.2g}"
        return finding(f"{at:.4g} s", at, at < INVERSION_TIME, cause)


_inversion("regulation")
_inversion("tracking")


@claim(
    "The current tracks its reference", "4", "-", "settled |i - i_ref| < 1e-3 A, both scenarios",
    "regulation", "tracking",
)  # fmt: skip
def _current(evidence: Evidence) -> Finding:
    worst = max(r.metrics["settled_max_abs_current_error_A"] for r in (evidence.regulation, evidence.tracking))
    cause = f"largest |i - i_ref| after {SETTLE} s, pulse included; q_i = 0, so e decays by Eq. (14) unless u saturates"
    return finding(f"{worst:.1e} A", worst, worst < 1e-3, cause)


@claim("Tracking: largest error 2.3e-5 m", "4", "2.3e-5 m", "rounds to 2.3e-5 m or less", "tracking")
def _tracking(evidence: Evidence) -> Finding:
    error = evidence.tracking.metrics["settled_max_abs_error_m"]
    cause = f"largest |z - r| after {SETTLE} s, pulse included"
    return finding(f"{error:.3e} m", error, error < 2.35e-5, cause)


_pulse("Tracking: the disturbance is rejected", "tracking")


@claim(
    "The rotor is held under sensor noise of variance 1e-7", "4", f"std {TABLE_2.noise_std:.2e} m",
    "no member lost up to the printed std, at every sample period tried",
)  # fmt: skip
def _noise(evidence: Evidence) -> Finding:
    largest = max(n.survived for n in evidence.noise)
    unknown = sum(n.undecided is not None for n in evidence.noise)
    if largest == 0.0 and not unknown:
        return Finding("lost at every std", 0.0, FAILS, "the rotor is lost at the smallest noise of the scan")
    words = "held up to std " + ", ".join(f"{n.survived:.1e} m, period {n.sample_period:g} s" for n in evidence.noise)
    survivors = sum(n.survived >= TABLE_2.noise_std * 0.999 for n in evidence.noise)
    cause = f"held at the printed std with {survivors} of {len(evidence.noise)} sample periods of the noise"
    if unknown:
        cause += f"; not decided with {unknown}, where the integrator stalled"
        return Finding(words, largest, UNDECIDED, cause)
    partial = 0 < survivors < len(evidence.noise)
    return Finding(words, largest, OPEN if partial else HOLDS if survivors else FAILS, cause)


@claim("The noise is specified", "4", "variance only", "sigma's radius is the same to 10 % at every sample period")
def _specification(evidence: Evidence) -> Finding:
    held = [n for n in evidence.noise if n.survived]
    if not held:
        cause = "the rotor is not held at the smallest noise, so the radii cannot be compared"
        return Finding("never held", None, OPEN, cause)
    if len(evidence.noise) == 1:
        words = f"period {evidence.noise[0].sample_period:g} s"
        return Finding(words, None, OPEN, "only the period of the processor was simulated; the paper gives no period")
    radii = [float(n.sigma[0]) for n in held]
    spread = max(radii) / min(radii)
    cause = f"at std {NOISE_STDS[0]:.0e} m, ratio of the radii at the sample periods tried; the paper gives no period"
    return Finding(f"radius varies by a factor of {spread:.1f}", spread, OPEN if spread > 1.1 else HOLDS, cause)


@claim("The noise is about 20 % of the gap", "4", "20 %", "3 std is 18 to 22 % of s_0")
def _share(evidence: Evidence) -> Finding:
    share = 3 * TABLE_2.noise_std / GAP
    cause = "arithmetic on the printed variance, its unit read as m^2"
    return finding(f"3 std = {100 * share:.0f} % of s_0", share, abs(share - 0.2) < 0.02, cause)


@claim(
    "Accurate and robust positioning", "abstract", "-", "tracking error below 1 % of the gap, one parameter 10 % off"
)
def _robust(evidence: Evidence) -> Finding:
    lost, stalled, error = evidence.uncertain
    cases = f"{2 * len(UNCERTAIN)} cases"
    if lost:
        return Finding(f"lost in {len(lost)} of {cases}", None, FAILS, "lost with the true " + ", ".join(lost))
    if stalled:
        cause = "stalled with the true " + ", ".join(stalled)
        return Finding(f"stalled in {len(stalled)} of {cases}", None, UNDECIDED, cause)
    cause = f"one of {', '.join(UNCERTAIN)} 10 % larger or smaller, controller unchanged; the paper tests no such case"
    return finding(f"{error:.1e} m at worst", error, error < 0.01 * GAP, cause)
