"""`ambjax simulate`: write the trajectory of a case, its metrics and a plot."""

import argparse
import dataclasses
import math
from typing import Any

import numpy as np
from tqdm import tqdm

from ambjax.cases.forces import forces
from ambjax.cases.machine_case import AnyCase, MachineCase
from ambjax.cases.reader import Case
from ambjax.cases.warned import reversal
from ambjax.commands import machine_commands
from ambjax.commands.reading import read_any_with_warnings, results
from ambjax.ensemble.design import MOST_MEMBERS
from ambjax.ensemble.replay import Replay, replay
from ambjax.ensemble.study import Study
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.results.outputs import directory, drawn, plain, table, write_json
from ambjax.results.runs import simulate
from ambjax.simulation.metrics import UNITS
from ambjax.text.words import command

# runup.png: only if the speed of the rotor changes.
WRITTEN = ("trajectory.npz", "metrics.json", "overview.png", "runup.png")


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Simulate a case or one member of its ensemble. Exit code 1 if the rotor is lost or the integrator stalls."""
    case = read_any_with_warnings(args.case)
    study = _study(case, args)
    if isinstance(case, MachineCase):
        return machine_commands.simulate(args, case if study is None else study.member(args.member))
    if study is not None:
        cascade, scenario = study.member(args.member)
        case = dataclasses.replace(case, name=f"{case.name}-{args.member}", cascade=cascade, scenario=scenario)
    window, html = _window(case, args), _pages(case, args)
    names = (*WRITTEN, *html)
    out = directory(args.out, f"simulate-{case.name}", names, args.force)
    say(f"method: {case.clock.method}")
    if case.cascade.sampled:
        say(f"on a processor: {case.cascade.processor}")
    done = _simulated(case, study, args.member)
    trajectory, numbers, replayed = done.trajectory, done.metrics, done if isinstance(done, Replay) else None
    _check(numbers, args.case)
    if replayed is not None and replayed.deviation > replayed.rounding:
        say(
            f"trajectory.npz and overview.png reproduce this member only approximately: their metrics differ by up to "
            f"{100 * replayed.deviation:.2g} % from those in the ensemble, which metrics.json contains."
        )
    for warning in reversal(case, float(numbers["max_abs_i_A"])):
        say(warning)
    metrics = plain(numbers) | {
        "lost_why": trajectory.lost_why,
        "method": str(case.clock.method),
        "settle_s": case.settle,
    }
    if replayed is not None:
        metrics["trajectory_deviation"] = replayed.deviation
    from ambjax.pictures.overview import overview_figure
    from ambjax.pictures.run_up_picture import order_picture

    rotor = case.scenario.rotor
    with results(args, out, names, lambda: _metrics_text(metrics)) as part:
        trajectory.save(part / "trajectory.npz")
        write_json(part / "metrics.json", metrics)
        title = f"{case.name}: {case.clock.method}"
        drawn(part / "overview.png", lambda: overview_figure(trajectory, title, window, case.settle))
        if rotor is not None and rotor.acceleration != 0:
            drawn(part / "runup.png", lambda: order_picture(trajectory, rotor, title))
        for name, page in html.items():
            (part / name).write_text(page, encoding="utf-8")
    ended = metrics["lost_at_s"] is not None
    if ended:
        from ambjax.theorem import advice

        remedy = advice.STALLED_PLANT if case.cascade.sampled else advice.STALLED
        words = advice.status(metrics["lost_at_s"], trajectory.lost_why, metrics["stalled"], remedy)
        which = "" if study is None else " for the nominal case"
        look = (
            f" {command('ambjax', 'check', args.case)} compares the gains with the conditions of Theorem 1{which}; "
            f"{command('ambjax', 'tune', args.case)} searches for gains that hold the rotor."
        )
        too_small = forces(case).too_small  # then no gains hold the rotor
        look = f" No gains hold it: {too_small}." if too_small else look
        say(words if metrics["stalled"] else words + look)
    return int(ended), metrics | {"out": str(out)}


def _pages(case: Case, args: argparse.Namespace) -> dict[str, str]:
    """Return the page with sliders by file name; an empty dict without --page. Raises ValueError as `page` does."""
    if not args.page:
        return {}
    if args.member is not None:
        raise ValueError("--page shows the case, not a member of its ensemble. Leave out --member or --page.")
    from ambjax.page.html_page import pages

    return pages([case], [args.case])


def _check(numbers: dict[str, Any], path: str) -> None:
    """Raise ValueError if a metric is not finite, which is a bug. A time may be inf: the event did not occur."""
    wrong = [name for name, x in numbers.items() if not (np.isfinite(x) or (UNITS.get(name) == "s" and x == math.inf))]
    if wrong:
        advice = "This is a defect of ambjax, not of the case: please report it with the case file."
        raise ValueError(f"{path}: {', '.join(wrong)}: not finite in this run, so nothing is written. {advice}")


def _window(case: Case, args: argparse.Namespace) -> tuple[float, float] | None:
    """Return begin and end of the plot in s, or None for the whole run. Raises ValueError for times outside the run."""
    if args.begin is None and args.end is None:
        return None
    period, last = float(case.clock.sample_period), float(case.clock.duration)
    begin, end = 0.0 if args.begin is None else args.begin, last if args.end is None else args.end
    if not (begin >= 0 and begin + period * (1 - 1e-9) <= end <= last * (1 + 1e-9)):
        limits = f"both must lie within 0 to {last:g} s (clock.duration), and --to at least {period:g} s after --from"
        raise ValueError(f"--from {begin:g} --to {end:g}: {limits} (clock.sample_period). Choose other times.")
    return begin, end


def _study(case: AnyCase, args: argparse.Namespace) -> Any:
    """Return the study that contains member --member, or None without it. Raises ValueError for invalid options."""
    if args.member is None:
        if args.seed is not None or args.members is not None:
            raise ValueError("--seed and --members need --member: add --member K, or set run.seed in the case file.")
        return None
    if case.spread.design == "latin-hypercube" and args.members is None:
        raise ValueError("--member: add --members N, the size of the ensemble, on which a Latin hypercube depends.")
    from ambjax.results.spread_runs import study_of

    study = study_of(case, args.seed, MOST_MEMBERS if args.members is None else args.members)
    if not study.varies:
        raise ValueError("--member: all members of this case are the same. Add [spread] to the case, or omit --member.")
    if not 0 <= args.member < study.members:
        raise ValueError(f"--member {args.member}: it must be a whole number from 0 to {study.members - 1}.")
    return study


def _simulated(case: Case, study: Study | None, member: int | None) -> Any:
    """Simulate a case, or a member of a study, with a progress bar if it takes more than two seconds."""
    shown = {"unit": "sample", "unit_scale": True, "delay": 2, "leave": False, "desc": "simulate"}
    with doing(f"simulating the case; {FIRST_RUN}"), tqdm(total=case.clock.samples, **shown) as bar:

        def count(samples: int) -> None:
            if not bar.n:
                bar.unpause()  # its clock starts with the first samples, after the compilation
            bar.update(samples)

        return simulate(case, count) if study is None or member is None else replay(study, member, count)


def _metrics_text(metrics: dict[str, object]) -> str:
    given = {name: value for name, value in metrics.items() if value != ""}
    words = ("never" if x is None else f"{x:.6g}" if isinstance(x, float) else str(x) for x in given.values())
    return table(("metric", "value"), zip(given, words, strict=True))
