"""What the answer is worth, and what would help, in words."""

from typing import Any

import numpy as np

from tuning.objective.members import Members
from tuning.problem import Problem
from tuning.report.limits import broken, prices


def verdict(facts: dict[str, Any]) -> str:
    """What became of the held-out members, or of those in training where there are none, in a sentence or two."""
    words = _fates(facts)
    if not facts["verified"]:
        words += f" That is NOT VERIFIED: {facts['verified_reason']}."
    return " ".join([words, *(f"{line}." for line in [*broken(facts["limits"]), *prices(facts["limits"])])])


def _fates(facts: dict[str, Any]) -> str:
    before, after = facts["before"], facts["after"]
    if not after["members"]:
        return f"{facts['lost_in_training']} members of the training ensemble are lost under the tuned gains."
    undecided = f", {after['stalled']} not decided (their integration stalls)" if after["stalled"] else ""
    return (
        f"Of {after['members']} held-out members, {after['lost']} are lost under the tuned gains (before: "
        f"{before['lost']}){undecided}; settled rms error {after['settled_rms_error_m']:.3g} m (before: "
        f"{before['settled_rms_error_m']:.3g} m), largest {after['settled_max_abs_error_m']:.3g} m."
    )


def advice(problem: Problem, facts: dict[str, Any], x: np.ndarray, who: Members) -> str:
    """Why rotors may still be lost, and what would help: what is tight, in the order in which it matters."""
    words = []
    if not facts["verified"]:
        words.append(
            f"Not verified: {facts['verified_reason']}. Raise tune.substeps or tune.stress, or keep gains at a bound "
            "lower by tune.bounds."
        )
    if lines := broken(facts["limits"]):
        words.append(f"{'. '.join(lines)}. Allow more (inf: none), tune more gains, each p too, or raise tune.screen.")
    if stalled := facts["after"]["stalled"]:
        words.append(f"Not decided: {stalled} held-out members, whose integration stalls. Raise tune.substeps.")
    if not (facts["lost_in_training"] or facts["after"]["lost"]):
        return " ".join(words)
    words.append(f"Rotors are lost: {facts['lost_in_training']} of {len(who.member)} in training.")
    for row in facts["conditions"]:
        if row["holds"] is False and row["gain"] is not None:
            words.append(f"{row['requires']} fails: {row['gain']:.3g} against {row['against']:.3g} {row['unit']}.")
    effort = problem.engine.terms(x[None], who)["effort"].mean()
    u_max = float(np.asarray(problem.case.scenario.u_max))
    if np.isfinite(u_max) and effort > 0.25:
        words.append(
            f"The voltage is at {100 * np.sqrt(effort):.0f} % of its limit (rms): a supply above {u_max:g} V, less "
            "sensor noise, or an observer ([controller.observer] kind = 'complementary', its l tuned) would help."
        )
    bound = [row["path"] for row in facts["gains"] if row["at_bound"]]
    if bound:
        words.append(f"At a bound: {', '.join(bound)}; widen tune.bounds.")
    words.append("More members (tune.members), or risk = 'cvar', asks for more margin; more screen, for other starts.")
    return " ".join(words)
