"""The facts of the report: the answer of a search is evaluated on held-out members, which the search did not use."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from ambjax.linear import Findings, suspects
from ambjax.results.outputs import described
from ambjax.theorem.advice import advice as on_conditions
from ambjax.theorem.conditions import Report as Check
from ambjax.theorem.conditions import check, required
from tuning.events import Tell
from tuning.judge.evaluate import JudgedMembers, describe, held, judge, stability, step_error, summarise, worst_of
from tuning.judge.peaks import delay_test, injections
from tuning.problem.config import seeds, settings
from tuning.problem.members import FEW, Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.report import front_table, limit_table, outcome, sensitivity_table
from tuning.report.facts import Row, TuningFacts
from tuning.solve.course import SearchResult

# The summary of no members, and the fields on the conditions of Theorem 1 if no law has one, or they are not computed.
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
    steps = _steps(answer, after, tell)
    found = {
        "case": problem.case.name,
        "held_out_seed": held_out,
        "trained_on": len(members.member),
        "lost_in_validation": answer.lost,
        "before": summarise(before.columns) if before.columns else NO_MEMBERS,
        **_held_out(after, steps["refuted"], tell),
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


def _judged(problem: TuningProblem, x: np.ndarray, held_out: int, tell: Tell) -> list[JudgedMembers]:
    """Return the held-out members with the gains of the case and at x [m]; without columns if there are no members.

    Gains of the case that are outside their bounds, or close to a bound, are clipped. `held_out`: seed of the members.
    """
    space, count = problem.objective.space, problem.tune.budget.held_out
    tell(f"judging on {count} held-out members")
    start = space.encode(space.clip(space.values(problem.case.cascade)))
    return [
        JudgedMembers(problem, at, held_out, judge(problem, at, held_out, count) if count else {}) for at in (start, x)
    ]


def _held_out(after: JudgedMembers, refuted: str, tell: Tell) -> Row:
    """Return the fields on the held-out members. `refuted`: why accurate steps do not confirm the answer, or ''."""
    problem, columns = after.problem, after.columns
    if not columns:
        none = dict.fromkeys(("worst_member", "stability", "sensitivity"))
        return none | {"after": NO_MEMBERS, "limits": limit_table.facts(problem, columns, NO_MEMBERS, refuted)}
    tell("the sensitivity of the held-out members")
    injected, summary = injections(after), summarise(columns)
    unverified = dict.fromkeys(("survival", "survival_low", "survival_high"), limit_table.UNVERIFIED)
    return {
        "sensitivity": injected and sensitivity_table.facts(problem.case.zones, injected),
        "limits": limit_table.facts(problem, columns, summary, refuted, injected, delay_test(after)),
        "after": summary | (unverified if refuted else {}),
        "worst_member": described("the worst member", after.worst),
        "stability": _stability(after, tell),
    }


def _stability(of: JudgedMembers, tell: Tell) -> Row:
    """Return whether the loops of the held members with the largest settled errors are stable (`linear.Findings`)."""
    index = suspects(of.columns["settled_max_abs_error_m"], held(of.columns))
    if not index.size:
        return Findings(0, 0)._asdict()
    tell(f"testing whether the loops of {index.size} held-out members are stable")
    return stability(of.problem, of.x, of.chosen(index)).findings()._asdict()


def _steps(answer: SearchResult, of: JudgedMembers, tell: Tell) -> Row:
    """Return the fields on the errors of the steps. `of`: the held-out members.

    In continuous time, the worst and the first of them are simulated again with accurate steps.
    """
    problem, error = answer.problem, None
    if of.columns and not problem.sampled and answer.confirmed and (alive := of.held).size:
        worst = alive[worst_of(of.columns["settled_max_abs_error_m"][alive])]
        error = step_error(problem, answer.x, of.chosen(np.union1d(worst, alive[:FEW])))
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
    case, objective = problem.case, problem.objective
    cascade = objective.notched(x, objective.space.decode(jnp.asarray(x), case.cascade))
    if not cascade.inversion.singular and all(one.value is None for one in required(cascade)):
        return NO_CONDITIONS
    line: Check = check(cascade, case.scenario, case.clock.with_method(None))
    rows = [dataclasses.asdict(one) | {"margin": one.margin} for one in line.conditions if one.gain is not None]
    return {"conditions": rows, "advice_on_conditions": on_conditions(line)}


def changed_gains(problem: TuningProblem, x: np.ndarray, members: Members) -> tuple[np.ndarray, np.ndarray]:
    """Return the effect of a change of one gain, up or down by about e^0.25, whichever is worse, by gain [m].

    The first array is the increase of the risk of least error in per cent, the second the number of members that are
    also lost. The loss of a rotor costs about 1e6 times as much as an error, so the risk has no meaning then.
    """
    steps = 0.25 * np.eye(len(x))
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
