"""The outcome of tuning, which determines the exit code, the log and the reports; and the advice if it is not good."""

import dataclasses

import numpy as np

from ambjax.linear import Findings
from ambjax.theorem.advice import STALLED, STALLED_PLANT
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.report import front_table
from tuning.report.facts import Row, TuningFacts
from tuning.report.limit_table import BROKEN, UNJUDGED, UNVERIFIED, broken, prices

ALL_MET, NOT_MET = "The tuned gains meet all requirements.", "The tuned gains do NOT meet all requirements:"
NO_HELD_OUT = "The tuned gains are not judged on held-out members (tune.held_out = 0)."


@dataclasses.dataclass(frozen=True)
class TuningOutcome:
    """Result of judging the tuned gains on an ensemble.

    `members`: number of members judged. `lost`: number of lost members. `stalled`: number of members whose integration
    stalls. `may_lose`: largest number of members that may be lost or stalled. `limits`: the verdict on each limit by
    name. `refuted`: the reason why accurate steps do not confirm the result; '' if they do. `tested`: number of members
    whose stability was tested. `unstable`: number of these that are held but not stable.
    """

    members: int
    lost: int
    stalled: int
    may_lose: int
    limits: dict[str, str]
    refuted: str
    tested: int = 0
    unstable: int = 0

    @property
    def rotors_held(self) -> bool:
        """Whether at most `may_lose` members are lost or stalled."""
        return self.lost + self.stalled <= self.may_lose

    @property
    def broken(self) -> list[str]:
        """Names of the limits that are not held, apart from survival, for which see `rotors_held`."""
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
            words.append(f"{ended} of {self.members} members (allowed: {self.may_lose})")
        if self.unstable:
            words.append(f"{self.unstable} of {self.tested} members tested held, but not stable")
        if self.broken:
            words.append(f"{BROKEN}: {', '.join(self.broken)}")
        if self.refuted:
            words.append(UNVERIFIED)
        return words

    @property
    def text(self) -> str:
        """Whether the requirements are met, in one sentence."""
        if not self.good:
            return f"{NOT_MET} {'; '.join(self.against)}."
        return NO_HELD_OUT if UNJUDGED in self.limits.values() else ALL_MET

    def facts(self) -> Row:
        """Return the outcome as a dict for report.json."""
        return dataclasses.asdict(self) | {"good": self.good, "rotors_held": self.rotors_held, "against": self.against}


def outcome_of(facts: TuningFacts, may_lose: int) -> TuningOutcome:
    """Return the outcome on the held-out members, or on the training members if tune.held_out is 0.

    `may_lose`: number of held-out members that may be lost or stalled. No training member may be lost; one whose
    integration stalls counts as lost.
    """
    after, limits = facts.after, {row["name"]: row["verdict"] for row in facts.limits}
    if not after["members"]:
        return TuningOutcome(facts.trained_on, facts.lost_in_training, 0, 0, limits, facts.refuted)
    found = (facts.stability or {}).get("tested", 0), (facts.stability or {}).get("unstable", 0)
    return TuningOutcome(after["members"], after["lost"], after["stalled"], may_lose, limits, facts.refuted, *found)


def outcome_text(facts: TuningFacts, outcome: TuningOutcome) -> str:
    """Return the outcome as text: verdict, lost members, error, limits, sensitive gains and gains at a bound."""
    unjudged = [name for name, found in outcome.limits.items() if found == UNJUDGED]
    words = [outcome.text, _statuses(facts)]
    if facts.stability is not None:
        words.append(Findings(**facts.stability).words())
    if taken := front_table.sentence(facts.front or []):
        words.append(taken)
    if outcome.refuted:
        words.append(f"This result is {UNVERIFIED.upper()}: {outcome.refuted}.")
    words += [f"{line}." for line in [*broken(facts.limits), *prices(facts.limits)]]
    if unjudged:
        words.append(f"Limits {UNJUDGED}: {', '.join(unjudged)}.")
    words += [
        f"If {row['path']} changes by a factor of 1.28, {row['sensitivity_lost']} of {facts.trained_on} training "
        "members are also lost."
        for row in facts.gains
        if row.get("sensitivity_lost")
    ]
    ends = [f"{row['path']} = {row['after']:.4g} ({row['at_bound']})" for row in facts.gains if row["at_bound"]]
    if ends:
        words.append(f"Gains at a bound: {', '.join(ends)}.")
    return " ".join(words)


def _statuses(facts: TuningFacts) -> str:
    """Return the sentence on the members lost and on the settled error of the others."""
    before, after = facts.before, facts.after
    if not after["members"]:
        return f"{facts.lost_in_training} members of the training ensemble are lost under the tuned gains."
    largest = f"; largest error {after['settled_max_abs_error_m']:.3g} m" if after["held"] else ""
    undecided = f", {after['stalled']} not decided (their integration stalls)" if after["stalled"] else ""
    return (
        f"Of {after['members']} held-out members, {after['lost']} are lost under the tuned gains (before: "
        f"{before['lost']}){undecided}; settled rms error of the surviving members: {_error(after)} (before: "
        f"{_error(before)}){largest}."
    )


def _error(summary: Row) -> str:
    return f"{summary['settled_rms_error_m']:.3g} m" if summary["held"] else "none is held"


def remedies(
    problem: TuningProblem, facts: TuningFacts, outcome: TuningOutcome, x: np.ndarray, members: Members
) -> str:
    """Return the requirements that are not met, with remedies, the most important first; '' if all are met.

    `x` [m]: coordinates of the tuned gains. `members`: the training ensemble.
    """
    if outcome.good:
        return ""
    words = []
    if outcome.refuted:
        keys = "tune.substeps or tune.stress" if problem.sliding else "tune.stress"
        words.append(
            f"Not verified: {outcome.refuted}. Raise {keys}, or lower the upper bounds (tune.bounds) of the gains "
            "that are at them."
        )
    if outcome.unstable and facts.stability is not None:
        words.append(
            f"{Findings(**facts.stability).words()} Add tune.limits.sensitivity or tune.limits.delay_margin_s."
        )
    if outcome.broken:
        keys = ", ".join(f"tune.limits.{name}" for name in outcome.broken)
        words.append(f"Not held: {keys}. Loosen these limits, tune more gains (also each p), or raise tune.screen.")
    if outcome.stalled:
        remedy = STALLED_PLANT if problem.sampled else STALLED
        words.append(f"Not decided: {outcome.stalled} held-out members, whose integration stalls. {remedy}")
    return " ".join(
        [*words, *(_causes_of_loss(problem, facts, x, members) if not outcome.rotors_held and outcome.lost else [])]
    )


def next_command(problem: TuningProblem) -> str:
    """Return the command that follows a search whose requirements are met, in backticks, with its purpose."""
    if problem.sampled:
        return "`ambjax export tuned.toml --verify --out firmware` writes the controller as C and verifies it."
    return (
        "`ambjax sensitivity tuned.toml` computes the margins. For a controller that can be exported as C, add "
        "`[processor]` to the case and tune again."
    )


def _causes_of_loss(problem: TuningProblem, facts: TuningFacts, x: np.ndarray, members: Members) -> list[str]:
    """Return possible causes of lost rotors, with remedies: failing conditions, the voltage limit, gains at a bound."""
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
            f"The voltage is at {100 * np.sqrt(effort):.0f} % of its limit (rms), a possible cause, not tested: try "
            f"a supply above {u_max:g} V, less sensor noise, or an observer that attenuates it more."
        )
    bound = [row["path"] for row in facts.gains if row["at_bound"]]
    if bound:
        words.append(f"Gains at a bound, also a possible cause: {', '.join(bound)}; widen tune.bounds.")
    return [
        *words,
        "For a larger margin, raise tune.members or set risk = 'cvar'. For other starting points, raise tune.screen.",
    ]
