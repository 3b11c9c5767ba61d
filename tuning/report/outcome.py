"""The outcome of a search: one record from which exit code, log, report and report.json derive; and the advice."""

import dataclasses

import numpy as np

from tuning.objective.members import Members
from tuning.problem import TuningProblem
from tuning.report import front_table
from tuning.report.facts import Row, TuningFacts
from tuning.report.limit_table import BROKEN, UNJUDGED, UNVERIFIED, broken, prices

ALL_MET, NOT_MET = "The tuned gains meet all requirements.", "The tuned gains do NOT meet all requirements:"
NO_HELD_OUT = "The tuned gains are not judged on held-out members (tune.held_out = 0)."


@dataclasses.dataclass(frozen=True)
class TuningOutcome:
    """Result of judging the tuned gains on `members` members.

    `lost`, `stalled`: numbers of members lost and undecided. `may_lose`: number allowed. `limits`: the verdict of each
    limit by name. `refuted`: why accurate steps contradict this result; '' if they confirm it.
    """

    members: int
    lost: int
    stalled: int
    may_lose: int
    limits: dict[str, str]
    refuted: str

    @property
    def rotors_held(self) -> bool:
        """Whether at most the allowed number of rotors is lost or undecided."""
        return self.lost + self.stalled <= self.may_lose

    @property
    def broken(self) -> list[str]:
        """Names of the limits that are not held, without survival (`rotors_held`)."""
        return [name for name, verdict in self.limits.items() if verdict == BROKEN and name != "survival"]

    @property
    def good(self) -> bool:
        """Whether the gains meet all requirements: exit code 0."""
        return not self.against

    @property
    def against(self) -> list[str]:
        """Short descriptions of the requirements that are not met."""
        words = []
        if not self.rotors_held:
            ended = f"{self.lost} lost" + f" and {self.stalled} not decided" * bool(self.stalled)
            words.append(f"{ended} of {self.members} members, at most {self.may_lose} may be")
        if self.broken:
            words.append(f"{BROKEN}: {', '.join(self.broken)}")
        if self.refuted:
            words.append(UNVERIFIED)
        return words

    def facts(self) -> Row:
        """Return the outcome as plain data."""
        return dataclasses.asdict(self) | {"good": self.good, "rotors_held": self.rotors_held, "against": self.against}


def outcome_of(facts: TuningFacts, may_lose: int) -> TuningOutcome:
    """Return the outcome from the facts of a search: of the held-out members, else of the training members.

    `may_lose`: number of held-out members that may be lost. No training member may be lost.
    """
    after, limits = facts.after, {row["name"]: row["verdict"] for row in facts.limits}
    if not after["members"]:
        return TuningOutcome(facts.trained_on, facts.lost_in_training, 0, 0, limits, facts.refuted)
    return TuningOutcome(after["members"], after["lost"], after["stalled"], may_lose, limits, facts.refuted)


def verdict(facts: TuningFacts, outcome: TuningOutcome) -> str:
    """Return the verdict and the status of the judged members in a few sentences."""
    unjudged = [name for name, found in outcome.limits.items() if found == UNJUDGED]
    met = NO_HELD_OUT if unjudged else ALL_MET
    words = [met if outcome.good else f"{NOT_MET} {'; '.join(outcome.against)}.", _statuses(facts)]
    if taken := front_table.sentence(facts.front or []):
        words.append(taken)
    if outcome.refuted:
        words.append(f"That is {UNVERIFIED.upper()}: {outcome.refuted}.")
    words += [f"{line}." for line in [*broken(facts.limits), *prices(facts.limits)]]
    if unjudged:
        words.append(f"Limits {UNJUDGED}: {', '.join(unjudged)}.")
    words += [f"{line}." for line in _cliffs(facts)]
    ends = [f"{row['path']} = {row['after']:.4g} ({row['at_bound']})" for row in facts.gains if row["at_bound"]]
    if ends:
        words.append(f"At a bound: {', '.join(ends)}.")
    return " ".join(words)


def _cliffs(facts: TuningFacts) -> list[str]:
    """Return a sentence for each gain whose change by 28 % loses members of the training ensemble."""
    return [
        f"{row['path']}: a gain off by 28 % loses a rotor ({row['sensitivity_lost']} of {facts.trained_on} members)"
        for row in facts.gains
        if row.get("sensitivity_lost")
    ]


def _statuses(facts: TuningFacts) -> str:
    before, after = facts.before, facts.after
    if not after["members"]:
        return f"{facts.lost_in_training} members of the training ensemble are lost under the tuned gains."
    undecided = f", {after['stalled']} not decided (their integration stalls)" if after["stalled"] else ""
    return (
        f"Of {after['members']} held-out members, {after['lost']} are lost under the tuned gains (before: "
        f"{before['lost']}){undecided}; settled rms error of those that are held {_error(after)} (before: "
        f"{_error(before)}){_largest(after)}."
    )


def _error(summary: Row) -> str:
    return f"{summary['settled_rms_error_m']:.3g} m" if summary["held"] else "none is held"


def _largest(summary: Row) -> str:
    return f", largest {summary['settled_max_abs_error_m']:.3g} m" if summary["held"] else ""


def advice(problem: TuningProblem, facts: TuningFacts, outcome: TuningOutcome, x: np.ndarray, members: Members) -> str:
    """Return why requirements are not met and the remedies, the most important first; '' if all are met."""
    if outcome.good:
        return ""
    words = []
    if outcome.refuted:
        words.append(
            f"Not verified: {outcome.refuted}. Raise tune.substeps or tune.stress, or keep gains at a bound "
            "lower by tune.bounds."
        )
    if outcome.broken:
        lines = broken([row for row in facts.limits if row["name"] != "survival"])
        words.append(f"{'. '.join(lines)}. Allow more (inf: none), tune more gains, each p too, or raise tune.screen.")
    if outcome.stalled:
        words.append(f"Not decided: {outcome.stalled} held-out members, whose integration stalls. Raise tune.substeps.")
    return " ".join(
        [*words, *(_of_the_lost(problem, facts, x, members) if not outcome.rotors_held and outcome.lost else [])]
    )


def _of_the_lost(problem: TuningProblem, facts: TuningFacts, x: np.ndarray, members: Members) -> list[str]:
    """Return the limits that are nearly reached, as possible causes of lost rotors."""
    after = facts.after
    judged = f"{after['lost']} of {after['members']} held-out members, " if after["members"] else ""
    words = [f"Rotors are lost: {judged}{facts.lost_in_training} of {len(members.member)} in training."]
    for row in facts.conditions:
        if row["holds"] is False and row["gain"] is not None:
            words.append(f"{row['requires']} fails: {row['gain']:.3g} against {row['against']:.3g} {row['unit']}.")
    effort = problem.engine.terms(x[None], members)["effort"].mean()
    u_max = float(np.asarray(problem.case.scenario.u_max))
    if np.isfinite(u_max) and effort > 0.25:
        words.append(
            f"The voltage is at {100 * np.sqrt(effort):.0f} % of its limit (rms): a supply above {u_max:g} V, less "
            "sensor noise, or an observer ([controller.observer] kind = 'complementary', its l tuned) would help."
        )
    bound = [row["path"] for row in facts.gains if row["at_bound"]]
    if bound:
        words.append(f"At a bound: {', '.join(bound)}; widen tune.bounds.")
    return [
        *words,
        "Raise tune.members or set risk = 'cvar' for a larger margin; raise tune.screen for other starts.",
    ]
