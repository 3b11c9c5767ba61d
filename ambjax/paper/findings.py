"""Findings: the result of one claim in one reading, and functions that several claims use."""

import dataclasses
import math

import numpy as np

from ambjax.numerics.records import Scalar
from ambjax.paper.evidence import Evidence, Run
from ambjax.simulation.trajectory import Row

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
