"""`ambjax simulate`: a case's trajectory, its metrics and a picture of it."""

import argparse
import dataclasses
import math
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from ambjax.cases.reader import Case
from ambjax.commands.doubts import read_aloud, reversal
from ambjax.commands.outputs import directory, files, plain, say, table, write_json, written
from ambjax.ensemble.design import MOST_MEMBERS
from ambjax.numerics.records import canonical
from ambjax.simulation.metrics import standard_for
from ambjax.simulation.rollout import Outcome, begin_jit, finish, segment_jit
from ambjax.simulation.sampled import system_of

Summary = dict[str, Any]
WRITTEN = ("trajectory.npz", "metrics.json", "overview.png")
# Samples simulated between two strokes of the progress bar.
STROKE = 20_000


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax simulate."""
    case = _member(read_aloud(args.case), args)
    window = _window(case, args)
    out = directory(args.out, f"simulate-{case.name}", WRITTEN)
    say(f"method: {case.clock.method}")
    if case.cascade.processor is not None:
        say(f"on a processor: {case.cascade.processor}")
    trajectory, numbers = simulate(case)
    _check(numbers, args.case)
    for doubt in reversal(case, float(numbers["max_abs_i_A"])):
        say(doubt)
    metrics = plain(numbers) | {
        "lost_why": trajectory.lost_why,
        "method": str(case.clock.method),
        "settle_s": case.settle,
    }
    from ambjax.pictures.overview import overview

    with files(out) as part:
        trajectory.save(part / "trajectory.npz")
        write_json(part / "metrics.json", metrics)
        overview(trajectory, f"{case.name}: {case.clock.method}", part / "overview.png", window)
    if not args.json:
        print(_metrics_text(metrics))
        written(out, ", ".join(WRITTEN))
    ended = metrics["lost_at_s"] is not None
    if metrics["lost"]:
        say(
            f"The rotor is lost at {metrics['lost_at_s']:.4g} s: {trajectory.lost_why}. 'ambjax check {args.case}' "
            "says which gain fails which condition of Theorem 1; "
            f"'ambjax-tune {args.case}' looks for gains that hold it."
        )
    elif ended:
        from ambjax.theorem import verdict

        remedy = verdict.STALLED if case.cascade.processor is None else verdict.STALLED_PLANT
        say(verdict.undecided(metrics["lost_at_s"], remedy))
    return int(ended), metrics | {"out": str(out)}


def _check(numbers: dict[str, Any], path: str) -> None:
    """Raise ValueError where a metric is no number, which no case may bring about; a time may be infinite: never."""
    wrong = [name for name, x in numbers.items() if not (np.isfinite(x) or (name.endswith("_s") and x == math.inf))]
    if wrong:
        raise ValueError(
            f"{path}: {', '.join(wrong)}: no finite number came of this run, so nothing is written. That is a fault of "
            "ambjax, not of the case: please report it with the case file."
        )


def _window(case: Case, args: argparse.Namespace) -> tuple[float, float] | None:
    """The stretch of time to draw, s; None: not asked for."""
    if args.begin is None and args.end is None:
        return None
    period, last = float(case.clock.sample_period), float(case.clock.duration)
    begin, end = 0.0 if args.begin is None else args.begin, last if args.end is None else args.end
    if not (begin >= 0 and begin + period * (1 - 1e-9) <= end <= last * (1 + 1e-9)):
        limits = f"the stretch must lie within 0 to {last:g} s, clock.duration, and be at least {period:g} s long"
        raise ValueError(f"--from {begin:g} --to {end:g}: {limits}, clock.sample_period. Choose other times.")
    return begin, end


def _member(case: Case, args: argparse.Namespace) -> Case:
    """The case with one member of its ensemble drawn, if that was asked for."""
    if args.member is None:
        if args.seed is not None or args.members is not None:
            raise ValueError("--seed and --members belong to --member: add it, or set run.seed in the case file.")
        return case
    if not (case.spread.entries or case.scenario.random):
        raise ValueError("--member: nothing in this case differs from member to member; add [spread], or leave it out.")
    if case.spread.design == "latin-hypercube" and args.members is None:
        raise ValueError("--member: add --members N, the size of the ensemble; a Latin hypercube depends on it.")
    from ambjax.commands.ensemble import study_of

    study = study_of(case, args.seed, MOST_MEMBERS if args.members is None else args.members)
    if not 0 <= args.member < study.members:
        raise ValueError(f"--member {args.member}: it must be a whole number from 0 to {study.members - 1}.")
    cascade, scenario = study.member(args.member)
    return dataclasses.replace(case, name=f"{case.name}-{args.member}", cascade=cascade, scenario=scenario)


def simulate(case: Case) -> Outcome:
    """A rollout of a case, recorded whole, with a progress bar if it takes more than two seconds."""
    fold = standard_for(case.settle, case.scenario)
    loop, clock, fold = canonical((system_of(case.cascade, case.scenario, case.clock), case.clock, fold))
    progress, parts, at = begin_jit(loop, clock, fold), [], 0
    with tqdm(total=clock.samples, unit="sample", unit_scale=True, delay=2, leave=False, desc="simulate") as bar:
        while at < clock.samples:
            count = min(STROKE, clock.samples - at)
            progress, rows = segment_jit(loop, clock, fold, progress, at, count=count, every=1)
            parts.append(jax.tree.map(np.asarray, rows))
            at += count
            bar.update(count)
    rows = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
    return jax.tree.map(np.asarray, finish(progress, rows, fold))


def _metrics_text(metrics: Summary) -> str:
    rows = [
        (name, "never" if v is None else f"{v:.6g}" if isinstance(v, float) else str(v)) for name, v in metrics.items()
    ]
    return table(("metric", "value"), rows)
