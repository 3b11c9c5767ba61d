"""The facts of the report: the answer of a search is evaluated on held-out members, which the search did not use."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from ambjax.linear import Findings, stability_of, suspects
from ambjax.results.outputs import described
from ambjax.theorem.advice import advice as on_conditions
from ambjax.theorem.conditions import Report as Check
from ambjax.theorem.conditions import check
from tuning.events import Tell
from tuning.judge.evaluate import describe, held, judge, step_error, summarise, worst, worst_of
from tuning.judge.late import delay_test
from tuning.judge.peaks import injections
from tuning.problem.config import seeds, settings
from tuning.problem.members import FEW, Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.report import front_table, limit_table, outcome, sensitivity_table
from tuning.report.facts import Row, TuningFacts
from tuning.solve.course import SearchResult

# Change of a coordinate for the sensitivity of a gain.
STEP = 0.25
# The summary of no members, and the fields on the conditions of Theorem 1 if they cannot be computed.
NO_MEMBERS: Row = {"members": 0, "held": 0, "lost": 0, "stalled": 0}
NO_CONDITIONS: Row = {"conditions": [], "advice_on_conditions": []}


def examined(answer: SearchResult, front_written: bool, tell: Tell) -> TuningFacts:
    """Return the facts of an answer.

    Facts that do not decide on the verdict are absent if they cannot be computed (`described`). `front_written`:
    whether each point of the front has a case file. `tell`: receives what is done.
    """
    problem, x, members = answer.problem, answer.x, answer.members
    held_out, rollouts = seeds(problem.tune.budget)[2], problem.engine.rollouts
    before, after = _judged(problem, x, held_out, tell)
    steps = _steps(answer, after, held_out, tell)
    found = {
        "case": problem.case.name,
        "held_out_seed": held_out,
        "trained_on": len(members.member),
        "lost_in_validation": answer.lost,
        "before": summarise(before) if before else NO_MEMBERS,
        **_held_out(problem, x, after, steps["refuted"], held_out, tell),
        "lost_in_training": int((problem.engine.terms(x[None], members)["survival"] > 0).sum()),
        **steps,
        **(described("the conditions of Theorem 1", lambda: _conditions(problem, x)) or NO_CONDITIONS),
        "search": settings(problem.tune)
        | {"iterations": len(answer.history["value"]), "rollouts": rollouts, "seconds": answer.seconds},
        "front_written": front_written,
        "front": described("the front", lambda: front_table.facts(answer)) or None,
    }
    around = described("the sensitivity of the gains", lambda: changed_gains(problem, x, members))
    facts = TuningFacts(**found, gains=_gains(problem, x, around))
    what = outcome.outcome_of(facts, problem.tune.limits.may_lose(problem.tune.budget.held_out))
    facts = dataclasses.replace(facts, outcome=what.facts())
    verdict = described("the verdict in words", lambda: outcome.verdict(facts)) or what.text
    advice = described("the advice", lambda: outcome.remedies(problem, facts, what, x, members)) or ""
    return dataclasses.replace(facts, verdict=verdict, advice=advice, next=outcome.next_command(problem))


def _judged(problem: TuningProblem, x: np.ndarray, held_out: int, tell: Tell) -> list[dict[str, np.ndarray]]:
    """Return the metrics of the held-out members [N] with the gains of the case and at x [m]; empty without members.

    Gains of the case that are outside their bounds, or close to a bound, are clipped. `held_out`: seed of the members.
    """
    space, count = problem.objective.space, problem.tune.budget.held_out
    tell(f"judging on {count} held-out members")
    start = space.encode(space.clip(space.values(problem.case.cascade)))
    return [judge(problem, at, held_out, count) if count else {} for at in (start, x)]


def _held_out(
    problem: TuningProblem, x: np.ndarray, after: dict[str, np.ndarray], refuted: str, seed: int, tell: Tell
) -> Row:
    """Return the fields on the held-out members with this `seed` at x [m]. `after`: their metrics [N], or empty.

    `refuted`: why accurate steps do not confirm the answer; '' if they do.
    """
    if not after:
        none = dict.fromkeys(("worst_member", "stability", "sensitivity"))
        return none | {"after": NO_MEMBERS, "limits": limit_table.facts(problem, after, NO_MEMBERS, refuted)}
    tell("the sensitivity of the held-out members")
    injected, summary = injections(problem, x, seed, after), summarise(after)
    late = delay_test(problem, x, seed, after)
    unverified = dict.fromkeys(("survival", "survival_low", "survival_high"), limit_table.UNVERIFIED)
    return {
        "sensitivity": injected and sensitivity_table.facts(problem, injected),
        "limits": limit_table.facts(problem, after, summary, refuted, injected, late),
        "after": summary | (unverified if refuted else {}),
        "worst_member": described("the worst member", lambda: worst(problem, after, seed)),
        "stability": _stability(problem, x, seed, after, tell),
    }


def _stability(problem: TuningProblem, x: np.ndarray, seed: int, columns: dict[str, np.ndarray], tell: Tell) -> Row:
    """Return whether the loops of the held members with the largest settled errors are stable (`linear.Findings`)."""
    index = suspects(columns["settled_max_abs_error_m"], held(columns))
    if not index.size:
        return Findings(0, 0)._asdict()
    tell(f"testing whether the loops of {index.size} held-out members are stable")
    members = problem.objective.chosen(seed, index, len(columns["lost_at_s"]))
    # in continuous time, the step of the case may be too coarse for these gains
    clock = problem.case.clock if problem.sampled else problem.case.clock.with_method(None)
    return stability_of(*problem.objective.fixed(x, members), clock).findings()._asdict()


def _steps(answer: SearchResult, judged: dict[str, np.ndarray], held_out: int, tell: Tell) -> Row:
    """Return the fields on the errors of the steps.

    In continuous time, the worst and the first of the held-out members are simulated again with accurate steps.
    `judged`: metrics of these members [N]; empty if there are none. `held_out`: their seed.
    """
    problem, error = answer.problem, None
    if judged and not problem.sampled and answer.confirmed and (alive := np.flatnonzero(held(judged))).size:
        worst = alive[worst_of(judged["settled_max_abs_error_m"][alive])]
        those = np.union1d(worst, alive[:FEW])
        error = step_error(problem, answer.x, problem.objective.chosen(held_out, those, len(judged["lost_at_s"])))
        tell(f"accurate steps on the worst and the first of them: {describe(error)}")
    refuted = (error or answer.error).refuted if answer.error else "every member that it was tuned on is lost"
    confirmed = "; ".join(f"accurate steps: {describe(one)}" for one in (error, answer.error) if one)
    return {
        "step_error": answer.error.facts() if answer.error else None,
        "worst_step_error": error.facts() if error else None,
        "accurate_steps": problem.accurate,
        "nominal_steps": "with the steps of `ambjax simulate`" if problem.replays else "with accurate steps",
        "refuted": refuted,
        "verified": not refuted,
        "verified_reason": refuted or confirmed,
    }


def _conditions(problem: TuningProblem, x: np.ndarray) -> Row:
    """Return the fields on the theorem's conditions at x [m]."""
    case = problem.case
    cascade = problem.objective.space.decode(jnp.asarray(x), case.cascade)
    line: Check = check(cascade, case.scenario, case.clock.with_method(None))
    rows = [dataclasses.asdict(one) | {"margin": one.margin} for one in line.conditions]
    return {"conditions": rows, "advice_on_conditions": on_conditions(line)}


def changed_gains(problem: TuningProblem, x: np.ndarray, members: Members) -> tuple[np.ndarray, np.ndarray]:
    """Return the effect of a change of one gain, up or down by about e^STEP, whichever is worse, by gain [m].

    The first array is the increase of the risk of least error in per cent, the second the number of members that are
    also lost. The loss of a rotor costs about 1e6 times as much as an error, so the risk has no meaning then.
    """
    steps = STEP * np.eye(len(x))
    at = x + np.concatenate([np.zeros((1, len(x))), steps, -steps])
    terms = problem.engine.terms(at, members)
    risk, lost = problem.error_goal.score(terms, members), (terms["survival"] > 0).sum(axis=1)
    beside = [np.max(one[1:].reshape(2, -1), axis=0) - one[0] for one in (risk, lost)]
    return 100 * np.expm1(beside[0]), np.maximum(beside[1], 0)


def _gains(problem: TuningProblem, x: np.ndarray, around: tuple[np.ndarray, np.ndarray] | None) -> list[Row]:
    """Return a row for each gain at x [m]. `around`: from `changed_gains`; None if it could not be computed."""
    space = problem.objective.space
    ends = zip(space.values(problem.case.cascade), np.asarray(space.gains_at(jnp.asarray(x))), strict=True)
    around = around or (np.full(len(x), math.nan), np.zeros(len(x), int))
    return [
        {
            "path": gain.path,
            "before": float(before),
            "after": float(after),
            "least": gain.low,
            "most": gain.high,
            "at_bound": gain.at_bound(float(after)),
            "sensitivity_percent": None if lost or math.isnan(grows) else float(grows),
            "sensitivity_lost": int(lost),
        }
        | dataclasses.asdict(where)
        for gain, (before, after), grows, lost, where in zip(space.gains, ends, *around, problem.ranges, strict=True)
    ]
