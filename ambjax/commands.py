"""The commands behind `ambjax`: each takes parsed arguments and returns an exit code and a summary.

What only one of them needs is imported by it, so that none waits for what the others draw or compute.


0: done. 1: done, and the answer is no (rotor lost, a condition fails). Bad input is a ValueError, which
`__main__` turns into one line and exit code 2.
"""

import argparse
import dataclasses
import pathlib
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from tqdm import tqdm

from ambjax._pytree import canonical
from ambjax.casefile import Case
from ambjax.doubts import read_aloud
from ambjax.ensemble.design import MOST_MEMBERS
from ambjax.loop import ClosedLoop
from ambjax.metrics import standard_for
from ambjax.outputs import directory, files, plain, say, table, write_json
from ambjax.rollout import Outcome, begin_jit, finish, segment_jit

if TYPE_CHECKING:
    from ambjax.evidence import Evidence
    from ambjax.theorem import Condition

__all__ = ["run_check", "run_ensemble", "run_map", "run_reproduce", "run_simulate", "run_template"]

Summary = dict[str, Any]
# Samples simulated between two strokes of the progress bar.
STROKE = 20_000


def run_ensemble(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax ensemble."""
    from ambjax import studies

    return studies.run_ensemble(args)


def run_map(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax map."""
    from ambjax import mapping

    return mapping.run_map(args)


def run_template(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax template."""
    from ambjax.template import template

    text = template(args.scenario)
    if not args.json:
        print(text, end="")
    return 0, {"template": text}


def run_simulate(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax simulate."""
    case = _member(read_aloud(args.case), args)
    window = _window(case, args)
    out = directory(args.out, f"simulate-{case.name}")
    say(f"method: {case.clock.method}")
    trajectory, measured = simulate(case)
    metrics = plain(measured) | {
        "lost_why": trajectory.lost_why,
        "method": str(case.clock.method),
        "settle_s": case.settle,
    }
    from ambjax.overview import overview

    with files(out) as part:
        trajectory.save(part / "trajectory.npz")
        write_json(part / "metrics.json", metrics)
        overview(trajectory, f"{case.name}: {case.clock.method}", part / "overview.png", window)
    if not args.json:
        print(_metrics_text(metrics))
        print(f"written: {out}/trajectory.npz, metrics.json, overview.png")
    ended = metrics["lost_at_s"] is not None
    if metrics["lost"]:
        say(
            f"The rotor is lost at {metrics['lost_at_s']:.4g} s: {trajectory.lost_why}. 'ambjax check {args.case}' "
            "says which gain fails which condition of Theorem 1; "
            f"'ambjax-tune {args.case}' looks for gains that hold it."
        )
    elif ended:
        from ambjax import verdict

        say(verdict.undecided(metrics["lost_at_s"]))
    return int(ended), metrics | {"out": str(out)}


def _window(case: Case, args: argparse.Namespace) -> tuple[float, float] | None:
    """The stretch of time to draw, s; None: not asked for."""
    if args.begin is None and args.end is None:
        return None
    period, last = float(case.clock.sample_period), float(case.clock.duration)
    begin, end = 0.0 if args.begin is None else args.begin, last if args.end is None else args.end
    if not (begin >= 0 and begin + period * (1 - 1e-9) <= end <= last * (1 + 1e-9)):
        allowed = f"the stretch must lie within 0 to {last:g} s, clock.duration, and be at least {period:g} s long"
        raise ValueError(f"--from {begin:g} --to {end:g}: {allowed}, clock.sample_period. Choose other times.")
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
    from ambjax.studies import study_of

    study = study_of(case, args.seed, MOST_MEMBERS if args.members is None else args.members)
    if not 0 <= args.member < study.members:
        raise ValueError(f"--member {args.member}: it must be a whole number from 0 to {study.members - 1}.")
    cascade, scenario = study.member(args.member)
    return dataclasses.replace(case, name=f"{case.name}-{args.member}", cascade=cascade, scenario=scenario)


def simulate(case: Case) -> Outcome:
    """A rollout of a case, recorded whole, with a progress bar if it takes more than two seconds."""
    fold = standard_for(case.settle, case.scenario)
    loop, clock, fold = canonical((ClosedLoop(case.cascade, case.scenario), case.clock, fold))
    progress, parts, done = begin_jit(loop, clock, fold), [], 0
    with tqdm(total=clock.samples, unit="sample", unit_scale=True, delay=2, leave=False, desc="simulate") as bar:
        while done < clock.samples:
            count = min(STROKE, clock.samples - done)
            progress, rows = segment_jit(loop, clock, fold, progress, done, count=count, every=1)
            parts.append(jax.tree.map(np.asarray, rows))
            done += count
            bar.update(count)
    rows = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
    return jax.tree.map(np.asarray, finish(progress, rows, fold))


def _metrics_text(metrics: Summary) -> str:
    rows = [
        (name, "never" if v is None else f"{v:.6g}" if isinstance(v, float) else str(v)) for name, v in metrics.items()
    ]
    return table(("metric", "value"), rows)


def run_check(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax check."""
    from ambjax.theorem import check

    case = read_aloud(args.case)
    report = check(case.cascade, case.scenario, case.clock)
    summary = {
        "holds": report.holds,
        "lost_at_s": report.lost_at,
        "lost_why": report.lost_why,
        "stalled": report.stalled,
        "method": report.method,
        "conditions": [_condition(c) for c in report.conditions],
        "proof": [_condition(c) for c in report.proof],
    }
    if not args.json:
        _print_check(report.conditions, report.proof)
        from ambjax import verdict

        print("\n" + "\n".join(verdict.answer(report, args.case)))
    return int(not report.holds), plain(summary)


def _condition(c: "Condition") -> Summary:
    return dataclasses.asdict(c) | {"margin": c.margin}


def _print_check(conditions: "list[Condition]", proof: "list[Condition]") -> None:
    verdict = {True: "holds", False: "FAILS", None: "-"}

    def number(x: float | None) -> str:
        return "-" if x is None else f"{x:.5g}"

    rows = [
        (
            c.requires,
            number(c.gain),
            number(c.against),
            number(c.margin),
            c.unit,
            f"{c.at_s:.5g}",
            verdict[c.holds],
            c.note,
        )
        for c in conditions
    ]
    print(table(("condition", "left", "right", "margin", "unit", "at (s)", "verdict", "note"), rows))
    steps = [(c.name, c.requires, f"{c.against:.3g}", c.unit, f"{c.at_s:.5g}", c.note) for c in proof]
    print("\n" + table(("proof", "statement", "worst", "unit", "at (s)", "what"), steps))


def _paper_figures(reading: str, seen: "Evidence", out: pathlib.Path) -> None:
    from ambjax import plotting

    folder = out if reading == "repaired" else out / reading
    folder.mkdir(exist_ok=True)
    for number, (name, _) in plotting.PAPER_FIGURES.items():
        title = f"Figure {number}: {name}, {reading} reading, {'under' if reading == 'tuned' else 'no'} noise"
        plotting.paper_figure(number, getattr(seen, name).trajectory, title, folder / f"figure_{number}.png")


def run_reproduce(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax reproduce."""
    from ambjax import ledger, paper, plotting
    from ambjax.evidence import gather
    from ambjax.worker import processes

    out = directory(args.out, "reproduce")
    began = time.perf_counter()
    stages = 2 * 7 + 1
    with (
        files(out) as part,
        tqdm(
            total=stages, unit="stage", delay=2, leave=False, bar_format="{l_bar}{bar}| {n}/{total} [{elapsed}]"
        ) as bar,
    ):

        def stage(text: str) -> None:
            bar.set_description_str(f"{text:<34}")
            bar.update()

        # Tracing holds the interpreter, so the reading of another structure has one of its own; a thread draws.
        evidence, drawn = {}, []
        with ThreadPoolExecutor(1) as artist, processes(1) as other:
            tuned = other.submit(gather, "tuned")
            for reading in paper.READINGS:
                evidence[reading] = tuned.result() if reading == "tuned" else gather(reading, stage)
                drawn.append(artist.submit(_paper_figures, reading, evidence[reading], part))
            stage("figures and ledger")
            for job in drawn:
                job.result()
        std = paper.TABLE_2.noise_std
        words = f"Tracking under the paper's noise (std {std:.2g} m on z) and a {paper.SUPPLY:g} V supply"
        plotting.readings(
            {name: seen.noisy for name, seen in evidence.items()}, words, paper.SETTLE, part / "readings.png"
        )
        claims, noise = ledger.judge(evidence), ledger.noise_table(evidence)
        (part / "ledger.md").write_text(ledger.markdown(claims, noise), encoding="utf-8")
        write_json(part / "ledger.json", {"claims": claims, "noise": noise})
    if not args.json:
        rows = [(c["says"], c["paper"], *(f["verdict"] for f in c["findings"].values())) for c in claims]
        print(table(("claim", "paper", *paper.READINGS), rows))
        print(f"written: {out}/figure_3.png to figure_6.png, the same under literal/ and tuned/,")
        print("         readings.png, ledger.md, ledger.json")
    say(f"done in {time.perf_counter() - began:.1f} s")
    return 0, {"claims": plain(claims), "noise": plain(noise), "out": str(out)}
