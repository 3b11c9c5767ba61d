"""What `ambjax-tune` does: read, search, judge, write."""

import argparse
import dataclasses
import pathlib
import tomllib
from typing import Any

import jax.numpy as jnp
import numpy as np

from ambjax.cases.reader import case_from
from ambjax.commands.doubts import say_doubts
from ambjax.commands.outputs import directory, files, plain, say, write_json
from ambjax.control.cascade import Cascade
from ambjax.host.interrupts import keeping
from ambjax.theorem.conditions import check
from ambjax.theorem.verdict import advice as on_conditions
from tuning.config import read_study, seeds, settings
from tuning.objective.problem import Members
from tuning.report import accurate, breakdown, gradient, pictures
from tuning.report import document as report
from tuning.report.page import page
from tuning.report.tuned import tuned as tuned_text
from tuning.search import explore
from tuning.search.keeper import remove_all
from tuning.search.rounds import CHECKPOINT, Answer, rounds
from tuning.space import Gain, Space, tunable
from tuning.study import StepError, Study, judge, step_error, study_of, summarise, worst_of
from tuning.study import words as step_told

# What stands for a survival that accurate steps do not confirm.
NOT_VERIFIED = "not verified"


def run(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """ambjax-tune. Raises ValueError for bad input, before anything is written."""
    case, tune, raw = read_study(args.case)
    if args.resume and not (args.out and (pathlib.Path(args.out) / f"{CHECKPOINT}-1.npz").exists()):
        raise ValueError(f"--resume: there is no {CHECKPOINT}-1.npz in --out {args.out}. Leave out --resume to begin.")
    say_doubts(case, args.case)
    study = study_of(case, tune)
    start = tune.space.values(case.cascade)
    tune.space.encode(start)
    text = pathlib.Path(args.case).read_text(encoding="utf-8")
    try:
        tuned_text(text, _laws(study, {}), case.name, "")
    except ValueError as why:
        raise ValueError(f"{args.case}: {why}") from None
    out = directory(args.out, f"tune-{case.name}")
    if not args.resume:
        _clear(out)
    with keeping(lambda: _kept(out)):
        return _tune(args, (text, raw), study, start, out)


def _clear(out: pathlib.Path) -> None:
    """Remove the checkpoints of an earlier search, lest this one is resumed with them."""
    left = remove_all(out, f"{CHECKPOINT}-*.npz")
    if left:
        say(f"{out}: {left} checkpoints of an earlier search are removed")


def _kept(out: pathlib.Path) -> str:
    """What an interruption has left, and how to go on."""
    if not (out / f"{CHECKPOINT}-1.npz").exists():
        return "nothing is kept"
    return f"the search so far is kept. To go on, give the same command with --out {out} --resume"


def _tune(
    args: argparse.Namespace, file: tuple[str, dict[str, Any]], study: Study, start: np.ndarray, out: pathlib.Path
) -> tuple[int, dict[str, Any]]:
    """Search, judge and write; everything has been checked. `file`: the case's text, and what it holds."""
    tune = study.tune
    held_out = seeds(tune.budget)[2]
    say(f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {study.objective.clock.method}")
    text, raw = file
    answer = rounds(study, start, out, {"case": raw, "tune": settings(tune)}, args.resume)
    study, who, x = answer.study, answer.who, answer.x
    facts = _facts(answer, held_out)
    if args.gradients:
        say("gradient report ...")
        facts["gradient"] = gradient.report(study, x, who)
    if args.pareto:
        say("front of error against voltage ...")
        facts["pareto"] = explore.pareto(study, x, who)
    found = explore.slices(study, x, who)
    with files(out) as part:
        _write(part, study, text, answer.history, facts, found)
    summary = plain(facts) | {"out": str(out)}
    if not args.json:
        print(_short(facts))
        print(f"written: {out}/tuned.toml, history.npz, report.html, report.md, report.json, *.png")
    lost = facts["after"]["lost"] if facts["after"]["members"] else facts["lost_in_training"]
    good = lost == 0 and facts["verified"]
    if not good:
        say(facts["advice"])
    return int(not good), summary


def _facts(answer: Answer, held_out: int) -> dict[str, Any]:
    study, x, who = answer.study, answer.x, answer.who
    case, tune, space = study.case, study.tune, study.objective.space
    rollouts = study.engine.rollouts
    before = space.values(case.cascade)
    after = np.asarray(space.gains_at(jnp.asarray(x)))
    tuned = dataclasses.replace(case, cascade=space.decode(jnp.asarray(x), case.cascade))
    count = tune.budget.held_out
    say(f"judging on {count} members of another seed ...")
    none = {"members": 0, "lost": 0}
    judged = [judge(study, at, held_out, count) for at in (_at(study, before), x)] if count else []
    found = [summarise(study, one) for one in judged] or [none, none]
    loss = dict(zip(("before", "after"), (breakdown.table(study.goal, one) for one in judged), strict=False))
    worst = _worst_checked(answer, judged[1], held_out) if judged and answer.confirmed else None
    refuted = (worst or answer.error).refuted if answer.error else "every member that it was tuned on is lost"
    if refuted and judged:
        found[1] |= dict.fromkeys(("survival", "survival_low", "survival_high"), NOT_VERIFIED)
    lost = int((study.engine.terms(x[None], who)["survival"] > 0).sum())
    line = check(tuned.cascade, case.scenario, dataclasses.replace(case.clock, method=None))
    facts: dict[str, Any] = {
        "case": case.name,
        "weights": list(tune.weights),
        "before": found[0],
        "after": found[1],
        "held_out_seed": held_out,
        "lost_in_training": lost,
        "loss": loss,
        "minimised": breakdown.minimised(study, x, who),
        "conditions": report.conditions(line),
        "advice_on_conditions": on_conditions(line),
        "step_error": answer.error.facts() if answer.error else None,
        "worst_step_error": worst.facts() if worst else None,
        "verified": not refuted,
        "verified_reason": refuted or _confirmed(worst, answer.error),
        "lost_in_validation": answer.lost,
        "search": settings(tune)
        | {"iterations": len(answer.history["value"]), "rollouts": rollouts, "seconds": answer.seconds},
    }
    if count:
        say(f"{min(accurate.AGAIN, count)} of them again by accurate steps ...")
        facts["accurate"] = accurate.compared(study, x, held_out, count, report.SHOWN)
    facts["gains"] = [
        row | dataclasses.asdict(where)
        for row, where in zip(report.gains_table(space, before, after, None), study.ranges, strict=True)
    ]
    facts["verdict"] = _verdict(facts)
    facts["advice"] = _advice(study, facts, x, who)
    return facts


def _confirmed(*errors: StepError | None) -> str:
    return "; ".join(f"accurate steps: {step_told(error)}" for error in errors if error)


def _worst_checked(answer: Answer, judged: dict[str, np.ndarray], held_out: int) -> StepError | None:
    """What accurate steps say of the worst held-out members that are held; None where none is."""
    held = np.flatnonzero(~np.isfinite(judged["lost_at_s"]))
    if not held.size:
        return None
    worst = held[worst_of(judged["settled_max_abs_error_m"][held])]
    error = step_error(answer.study, answer.x, answer.study.objective.chosen(held_out, worst, len(judged["lost_at_s"])))
    say(f"accurate steps on the worst of them: {step_told(error)}")
    return error


def _at(study: Study, gains: np.ndarray) -> np.ndarray:
    return study.objective.space.encode(study.objective.space.clip(gains))


def _verdict(facts: dict[str, Any]) -> str:
    before, after = facts["before"], facts["after"]
    if not after["members"]:
        return f"{facts['lost_in_training']} members of the training ensemble are lost under the tuned gains."
    told = (
        f"Of {after['members']} held-out members, {after['lost']} are lost under the tuned gains (before: "
        f"{before['lost']}); settled rms error {after['settled_rms_error_m']:.3g} m (before: "
        f"{before['settled_rms_error_m']:.3g} m), largest {after['settled_max_abs_error_m']:.3g} m."
    )
    if not facts["verified"]:
        told += f" That is NOT VERIFIED: {facts['verified_reason']}."
    return told


def _advice(study: Study, facts: dict[str, Any], x: np.ndarray, who: Members) -> str:
    """Why rotors may still be lost, and what would help: what is tight, in the order in which it matters."""
    words = []
    if not facts["verified"]:
        words.append(
            f"Not verified: {facts['verified_reason']}. Raise tune.substeps or tune.stress, or keep gains at a bound "
            "lower by tune.bounds."
        )
    if not (facts["lost_in_training"] or facts["after"]["lost"]):
        return " ".join(words)
    words.append(f"Rotors are lost: {facts['lost_in_training']} of {len(who.member)} in training.")
    for row in facts["conditions"]:
        if row["holds"] is False and row["gain"] is not None:
            words.append(f"{row['requires']} fails: {row['gain']:.3g} against {row['against']:.3g} {row['unit']}.")
    effort = study.engine.terms(x[None], who)["effort"].mean()
    u_max = float(np.asarray(study.case.scenario.u_max))
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


def _write(
    out: pathlib.Path, study: Study, text: str, history: Any, facts: dict[str, Any], found: explore.Slices
) -> None:
    space = study.objective.space
    for row, grows in zip(facts["gains"], found.sensitivity(), strict=True):
        row["sensitivity_percent"] = float(grows)
    j, k, drop = found.lowest()
    facts["beside"] = {"path": space.paths[j], "gain": found.gains[j, k], "lower": -np.expm1(-drop)}
    facts["slices"] = {"gains": found.gains, "log_risk": found.goals, "lost": found.lost}
    gains = _laws(study, {row["path"]: row["after"] for row in facts["gains"]})
    text = tuned_text(text, gains, facts["case"], facts["verdict"])
    tuned = case_from(tomllib.loads(text), facts["case"])  # a file that could not be read back is not written
    (out / "tuned.toml").write_text(text, encoding="utf-8")
    np.savez(out / "history.npz", **history)
    words = report.markdown(facts)
    drawn = _pictures(study, tuned.cascade, history, facts, found)
    for name, data in drawn.items():
        (out / name).write_bytes(data)
    (out / "report.md").write_text(words, encoding="utf-8")
    (out / "report.html").write_text(page(words, drawn, f"Tuning of {facts['case']}"), encoding="utf-8")
    write_json(out / "report.json", facts)


def _pictures(
    study: Study, tuned: Cascade, history: Any, facts: dict[str, Any], found: explore.Slices
) -> dict[str, bytes]:
    """PNG by file name: those that the report shows."""
    paths, runs = study.objective.space.paths, {"before": study.case.cascade, "after": tuned}
    drawn = {
        "nominal.png": pictures.before_after({name: accurate.nominal(study, one) for name, one in runs.items()}),
        "convergence.png": pictures.convergence(history, paths),
        "slices.png": pictures.landscape(found, paths),
    }
    return drawn | ({"front.png": pictures.front(facts["pareto"])} if facts.get("pareto") else {})


def _laws(study: Study, tuned: dict[str, float]) -> dict[str, float]:
    """Every gain of the tuned laws by path, those that were not tuned too: a p left out would follow the plant."""
    everything = Space(tuple(Gain(path) for path in tunable(study.case.cascade)))
    return dict(zip(everything.paths, everything.values(study.case.cascade).tolist(), strict=True)) | tuned


def _short(facts: dict[str, Any]) -> str:
    lines = [facts["verdict"]]
    lines += [f"  {row['path']}: {row['before']:.6g} -> {row['after']:.6g} {row['at_bound']}" for row in facts["gains"]]
    return "\n".join(lines)
