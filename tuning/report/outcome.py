"""The outcome of tuning, which determines the exit code, the log and the reports; and the advice if it is not good."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ambjax.linear import Findings
from ambjax.results.outputs import described
from ambjax.theorem.advice import STALLED, STALLED_PLANT
from tuning.problem.gains_table import left_out
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.report import front_table, sensitivity_table
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
        own = {name: getattr(self, name) for name in ("good", "rotors_held", "against", "text")}
        return dataclasses.asdict(self) | own


def outcome_of(facts: TuningFacts, may_lose: int) -> TuningOutcome:
    """Return the outcome on the held-out members, or on the training members if tune.held_out is 0.

    `may_lose`: number of held-out members that may be lost or stalled. No training member may be lost; one whose
    integration stalls counts as lost.
    """
    after, limits = facts.after, {row["name"]: row["verdict"] for row in facts.limits}
    if not after["members"]:
        return TuningOutcome(facts.trained_on, facts.lost_in_training, 0, 0, limits, facts.refuted)
    tested = {name: (facts.stability or {}).get(name, 0) for name in ("tested", "unstable")}
    return TuningOutcome(after["members"], after["lost"], after["stalled"], may_lose, limits, facts.refuted, **tested)


def verdict(facts: TuningFacts) -> str:
    """Return the verdict as text: whether the requirements are met, and the answer."""
    return " ".join([facts.outcome["text"], *(f"{label}: {text}" for label, text in answer(facts).items())])


def answer(facts: TuningFacts) -> dict[str, str]:
    """Return the answer by label. An entry that cannot be computed is absent."""
    label = "NOT held" if not facts.outcome["rotors_held"] else "Not verified" if facts.refuted else "Held"
    entries: dict[str, Callable[[], str]] = {
        label: lambda: _held(facts),
        "Error and voltage": lambda: _sizes(facts),
        "Sensitivity": lambda: sensitivity_table.line(facts.sensitivity),
        "Limited by": lambda: _limiting(facts),
    }
    found = {label: described(f"the line '{label}'", entry) for label, entry in entries.items()}
    return {label: text for label, text in found.items() if text}


def _held(facts: TuningFacts) -> str:
    outcome, after = facts.outcome, facts.after
    which = "held-out members" if after["members"] else "training members"
    kept = outcome["members"] - outcome["lost"] - outcome["stalled"]
    words = f"{kept} of {outcome['members']} {which} are held"
    if facts.before["members"]:
        words += f" (before tuning: {facts.before['held']})"
    if outcome["stalled"]:
        words += f", {outcome['stalled']} not decided (their integration stalls)"
    tested = "" if facts.stability is None else Findings(**facts.stability).words()
    refuted = f"This result is {UNVERIFIED.upper()}: {facts.refuted}." if facts.refuted else ""
    return " ".join(filter(None, [f"{words}.", tested, refuted]))


def _sizes(facts: TuningFacts) -> str:
    after, before = facts.after, facts.before
    if not after["members"]:
        return "not measured on held-out members (tune.held_out = 0)."
    if not after["held"]:
        return "no held-out member is held."

    def change(name: str, unit: str) -> str:
        was = f" (before: {before[name]:.3g})" if before["held"] else ""
        return f"{after[name]:.3g} {unit} rms after settling{was}"

    most = after.get("max_abs_u_V.largest")
    words = (
        f"{change('settled_rms_error_m', 'm')}, largest {after['settled_max_abs_error_m']:.3g} m; "
        f"{change('settled_rms_u_V.mean', 'V')}{'' if most is None else f', largest {most:.3g} V'}."
    )
    return " ".join(filter(None, [words, front_table.sentence(facts.front or [])]))


def _limiting(facts: TuningFacts) -> str:
    """Return the entry on the limits that are not held or active, on gains at a bound, and on sensitive gains."""
    words = [*broken(facts.limits), *prices(facts.limits)]
    if ends := [f"{row['path']} = {row['after']:.4g} ({row['at_bound']})" for row in facts.gains if row["at_bound"]]:
        words.append(f"gains at a bound of tune.bounds: {', '.join(ends)}")
    if not words:
        front = "the trade-off between error and voltage; " if len(facts.front or ()) > 1 else ""
        words = [f"{front}no limit of tune.limits is active, and no gain is at a bound"]
    if names := [row["name"] for row in facts.limits if row["verdict"] == UNJUDGED]:
        words.append(f"limits {UNJUDGED}: {', '.join(names)}")
    words += [
        f"if {row['path']} changes by a factor of 1.28, {row['sensitivity_lost']} of {facts.trained_on} training "
        "members are also lost"
        for row in facts.gains
        if row["sensitivity_lost"]
    ]
    return f"{'; '.join(words)}."


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
        absent = [f"tune.limits.{name}" for name in ("sensitivity", "delay_margin_s") if name not in outcome.limits]
        words.append(Findings(**facts.stability).words() + f" Add {' or '.join(absent)}." * bool(absent))
    if outcome.broken:
        keys = ", ".join(f"tune.limits.{name}" for name in outcome.broken)
        others = ", ".join(left_out(problem.tune.space, problem.case.cascade))
        more = f"tune also {others}" if others else "widen tune.bounds"
        words.append(f"Not held: {keys}. Loosen these limits, {more}, or raise tune.screen.")
    if outcome.stalled:
        remedy = STALLED_PLANT if problem.sampled else STALLED
        words.append(f"Not decided: {outcome.stalled} held-out members, whose integration stalls. {remedy}")
    if not outcome.rotors_held and outcome.lost:
        words += _causes_of_loss(problem, facts, x, members)
    return " ".join(words)


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
        noisy = problem.case.scenario.louder(0.0).sensor != problem.case.scenario.sensor
        words.append(
            f"The voltage is at {100 * np.sqrt(effort):.0f} % of its limit (rms), a possible cause, not tested: try a "
            f"supply above {u_max:g} V" + ", less sensor noise, or an observer that attenuates it more" * noisy + "."
        )
    if bound := [row["path"] for row in facts.gains if row["at_bound"]]:
        words.append(f"Gains at a bound, also a possible cause: {', '.join(bound)}; widen tune.bounds.")
    cvar = "" if problem.tune.risk.alpha else " or set risk = 'cvar'"
    return [*words, f"For a larger margin, raise tune.members{cvar}. For other starting points, raise tune.screen."]
