"""Sections of the benchmark page: the tuner and its search, and the control structures."""

import math
import statistics
from typing import Any

from _tables import facts, load, table


def tasks() -> list[str]:
    data = load("tasks")
    lines = ["## The tuning tasks (`tasks.py`)", "", facts(data["machine"])]
    lines += [
        "`ambjax tune` runs with its defaults, from gains that lose the rotor. Exceptions: E minimises the mean of",
        "the worst tenth of 64 members, and the pole of the observer ranges from 0.999 to 1e4. Errors and voltages are",
        "those of the held-out members. Steps: relative error of the settled rms error due to the steps of the search,",
        "compared with adaptive RODAS3. u rms: after settling. Not stable: held-out members, of those tested, whose",
        "motion does not decay without noise and loads. Processor: processor time of the whole command, while other",
        "programs ran.",
        "",
    ]
    return lines + _tasks(data)


def bearings() -> list[str]:
    data = load("bearings")
    lines = ["## Other bearings and the templates (`bearings.py`)", "", facts(data["machine"])]
    verified = sum(row["verified"] for row in data["tasks"].values())
    lines += [
        "`ambjax tune` runs as in the tuning tasks, without manual intervention. The initial gains of the templates",
        "hold the rotor. The reference is constant in all tasks except `tracking`. Simulations with accurate steps",
        f"confirm {verified} of {len(data['tasks'])} answers.",
        "",
    ]
    return lines + _tasks(data)


def _tasks(data: dict[str, Any]) -> list[str]:
    rows = []
    for row in data["tasks"].values():
        cells = [row["title"], f"{row['settled_rms_error_m']:.2e}", f"{row['settled_max_abs_error_m']:.1e}"]
        cells += [f"{row['lost']} of {row['members']}", _unstable(row), f"{row['settled_rms_u_V']:.3g}"]
        cells += [f"{100 * row['step_error']:.1g} %", f"{row['rollouts']:,}", f"{row['processor_s']:.0f}"]
        rows.append([*cells, _gains(row)])
    titles = "task | settled rms error (m) | largest (m) | lost | not stable | u rms (V) | steps | "
    return table(titles + "rollouts | processor (s) | gains", rows)


def _unstable(row: dict[str, Any]) -> str:
    return f"{row['unstable']} of {row['tested']}"


def _gains(row: dict[str, Any]) -> str:
    """Return the gains of a task as text and mark each gain that ends at a bound."""
    marks = dict.fromkeys(row["at_bound"], " (at its bound)")
    return ", ".join(f"{path.rpartition('.')[2]} {x:.4g}{marks.get(path, '')}" for path, x in row["gains"].items())


def sampled_tasks() -> list[str]:
    data = load("sampled_tasks")
    lines = ["## The tuning tasks on a processor (`sampled_tasks.py`)", "", facts(data["machine"])]
    lines += [
        "`ambjax tune` runs as in the tuning tasks, on a processor of 10 or 20 kHz with a delay of one sample. CMA-ES:",
        "settled rms error that CMA-ES reached in 2 x 900 evaluations on 6 members with an independent simulator of",
        "the same loop. Variation of u: total variation of the voltage after settling. Processor: processor time,",
        "while other programs ran; in brackets, that of the same task in continuous time. The values of p are those of",
        "the position, inversion and current laws. c is at most a fifth of the sampling rate, l at least 0.05 1/s.",
        "",
    ]
    rows = []
    for row in data["tasks"].values():
        bar = "-" if row["bar_m"] is None else f"{row['bar_m']:.3g}"
        cells = [row["title"], bar, f"{row['settled_rms_error_m']:.2e}"]
        cells += [f"{row['settled_max_abs_error_m']:.1e}", f"{row['lost']} of {row['members']}", _unstable(row)]
        cells += [f"{row['settled_rms_u_V']:.0f}", f"{row['chatter_V']:.1e}", f"{row['rollouts']:,}"]
        continuous = row.get("continuous", {}).get("processor_s")
        # None: the task ran on another machine than the others
        seconds = "-" if row["processor_s"] is None else f"{row['processor_s']:.0f}"
        cells += [seconds + (f" ({continuous:.0f})" if continuous else ""), _gains(row)]
        rows.append(cells)
    titles = "task | CMA-ES (m) | settled rms error (m) | largest (m) | lost | not stable | u rms (V) | "
    return lines + table(titles + "variation of u (V) | rollouts | processor (s) | gains", rows)


def search() -> list[str]:
    """Return one table with a row for each task and method."""
    data = load("search")
    lines = ["## The search against derivative-free methods (`search.py`)", "", facts(data["machine"])]
    lines += [
        "All methods use the same loss, members, coordinates and ranges. TPE may exceed the ranges by half their",
        "width; random search may not. The budget of rollouts is the median number of rollouts of the gradient search",
        "over its seeds, or a multiple of it. Loss: median and range over seeds. Powell's method is deterministic;",
        "Nelder-Mead and CMA-ES have deterministic starting points. Reached: number of rollouts until a method",
        "reaches the final median loss of the gradient search, median over seeds; a dash: not within the budget.",
        "A call always simulates a full batch, but only the members that a method needs count as rollouts. The number",
        "of rollouts is therefore no measure of the cost. Time: processor time of one search on one core, while other",
        "programs ran. The rows `CMA-ES, 10 times` are older: ten times the rollouts of the search before its screen",
        "and race began on two members.",
        "",
    ]
    rows = []
    for task, found in data["tasks"].items():
        methods = {key: value for key, value in found.items() if key not in ("budget", "goal")}
        rows += [_search(task, method, seeds) for method, seeds in methods.items()]
    return lines + table("task | method | loss | rollouts | time (s) | reached", rows)


def _search(task: str, method: str, seeds: list[dict[str, Any]]) -> list[str]:
    low, middle, high = (math.exp(f([row["final"] for row in seeds])) for f in (min, statistics.median_high, max))
    reached = statistics.median_high(math.inf if row["reached"] is None else row["reached"] for row in seeds)
    spent, seconds = (statistics.median_high(row[key] for row in seeds) for key in ("rollouts", "seconds"))
    loss = f"{middle:.4e} ({low:.4e} to {high:.4e}, seeds: {len(seeds)})"
    return [task, method, loss, f"{spent:,}", f"{seconds:.0f}", f"{reached:,}" if math.isfinite(reached) else "-"]


def schedules() -> list[str]:
    """Return a table of the tuner's search against CMA-ES with scheduled gains, and the cost of their gradient."""
    data = load("schedules")
    each, seconds = data["cost"]["reverse"], data["seconds"]
    ends = {name: [rows[-1] for rows in seeds] for name, seeds in data["methods"].items()}
    least = min(_rollouts(row, each) for rows in ends.values() for row in rows)
    goal = statistics.median(row[3] for row in ends["CMA-ES"])
    lines = ["## Scheduled gains (`schedules.py`)", "", facts(data["machine"])]
    lines += [
        f"Task G20, cut to {data['simulated_s']:g} s and {data['members']} members. {data['gains']} gains: three knots",
        "for each of the eight. Both searches begin where the rotor is lost: CMA-ES in the middle of the ranges, the",
        "tuner's search with a screen of constant gains. Where a descent stalls, the tuner's search continues with",
        f"CMA-ES. A gradient of all gains costs {each:.1f} plain rollouts in reverse mode, which the search uses, and",
        f"{data['cost']['forward']:.1f} in forward mode (ratios of processor time); it is counted as {each:.1f}.",
        f"Losses: median and range over {len(ends['CMA-ES'])} seeds, at {seconds:g} s of processor time on one core,",
        f"without compilation, and at {least:,.0f} rollouts. Reached: rollouts until a method reaches the final median",
        "loss of CMA-ES, median over seeds. Other programs ran during the measurement.",
        "",
    ]
    rows = []
    for name, seeds in data["methods"].items():
        equal = [max((row for row in rows if _rollouts(row, each) <= least), key=lambda row: row[2]) for rows in seeds]
        reached = [next((_rollouts(r, each) for r in rows if r[3] <= goal), math.inf) for rows in seeds]
        median = statistics.median(reached)
        spent = statistics.median(_rollouts(row, each) for row in ends[name])
        found = [_losses([row[3] for row in some]) for some in (ends[name], equal)]
        rows.append([name, *found, f"{spent:,.0f}", f"{median:,.0f}" if math.isfinite(median) else "-"])
    titles = f"method | loss at {seconds:g} s | loss at equal rollouts | rollouts in {seconds:g} s | reached"
    return lines + table(titles, rows)


def _rollouts(row: list[float], each: float) -> float:
    """Return the rollouts of a row of a trace; a gradient counts as `each`."""
    return row[0] + each * row[1]


def _losses(logs: list[float]) -> str:
    low, middle, high = (math.exp(f(logs)) for f in (min, statistics.median, max))
    return f"{middle:.3e} ({low:.3e} to {high:.3e})"


def from_answer() -> list[str]:
    """Return a table with one row for each task."""
    data = load("from_answer")
    lines = ["## CMA-ES from the answer of a search (`from_answer.py`)", "", facts(data["machine"])]
    lines += [
        "Each task is tuned with its defaults. CMA-ES then continues from the tuned gains, on the training ensemble",
        "and the 16 validation members with the least clearance; limits are penalties of its loss. The columns",
        "`best` and `mean` give the reduction of the settled rms error of the 1,000 held-out members at the best",
        "point and at the last mean of CMA-ES, and, if there are any, the lost members and the broken limits.",
        "",
    ]
    rows = []
    for task, row in data["tasks"].items():
        error = row["answer"]["settled_rms_error_m"]
        cells = [task, f"{error:.3e}", str(row["answer"]["lost"]), str(row["evaluations"])]
        for name in ("best", "mean"):
            found = row[name]
            broken = [f"{found['lost']} lost"] * (found["lost"] > 0) + found["broken"]
            cells.append(", ".join([f"{100 * (1 - found['settled_rms_error_m'] / error):.2f} %", *broken]))
        rows.append([*cells, f"{row['rollouts']:,}", f"{row['processor_s']:.0f}"])
    titles = "task | settled rms error (m) | lost | evaluations | best | mean | "
    return lines + table(titles + "rollouts of the search | processor time of the search (s)", rows)


def laws() -> list[str]:
    """Return a table of the control structures for each case: errors, voltage, |S| and cost."""
    data = load("laws")
    lines = ["## Control structures (`laws.py`)", "", facts(data["machine"])]
    lines += ["Median and range over the seeds; the rms error is the median over the members.", ""]
    for name, case in data["cases"].items():
        limits = ", ".join(f"{key} {value:g}" for key, value in case["limits"].items())
        budget = ", ".join(f"{key} {value}" for key, value in case["budget"].items())
        lines += [
            f"**{name}**: {case['title']}. Limits: {limits}. Seeds: {case['seeds']}. Budget: {budget}. Compared on "
            f"{case['members']} members.",
            "",
        ]
        rows = []
        for law, row in case["structures"].items():
            scaled = (("rms_error_median_m", 1e6), ("rms_error_worst_m", 1e6), ("rms_u_V", 1.0), ("worst_peak", 1.0))
            numbers = [_middle(row[key], times) for key, times in scaled]
            rows.append([law, *numbers, str(max(row["lost"])), "-" if row["flops"] is None else str(row["flops"])])
        titles = "structure | rms error (µm) | worst member (µm) | rms voltage (V) | worst peak of S | lost | flops"
        # a page of docs includes the table between these comments
        lines += [f"<!-- {name}: -->", *table(titles, rows), f"<!-- end of {name} -->", ""]
    return lines


def default_gains() -> list[str]:
    """Return the tables of the untuned structures: zone and peak of |S|, and the structures that lose the rotor."""
    data = load("default_gains")
    rows: dict[tuple[str, ...], dict[str, Any]] = {tuple(key.split("/")): row for key, row in data["rows"].items()}
    held = sum(row["held"] for row in rows.values())
    zones = [row["zone"] for row in rows.values() if row["held"]]
    lines = ["## Default gains (`default_gains.py`)", "", facts(data["machine"]), "<!-- default gains: -->"]
    lines += [
        f"{len(rows)} structures with untuned laws, of which {held} hold the rotor: {zones.count('A')} in zone A, "
        f"{zones.count('B')} in zone B. Each cell contains the worst zone and the peaks of |S| over the current laws.",
        "",
    ]
    inversions = list(dict.fromkeys(key[2] for key in rows))
    for name, words in data["machines"].items():
        ours = {key[1:]: row for key, row in rows.items() if key[0] == name}
        if not ours:
            continue
        found = []
        for position in dict.fromkeys(key[0] for key in ours):
            cells = [{key[2]: ours[key] for key in ours if key[:2] == (position, one)} for one in inversions]
            found.append([f"`{position}`", *map(_cell, cells)])
        lines += [f"**{name}**: {words}", "", *table(" | ".join(["position law", *inversions]), found)]
    return [*lines, "<!-- end of default gains -->", ""]


def _cell(currents: dict[str, dict[str, Any]]) -> str:
    """Return the worst zone and the peaks of |S| over the current laws, and the laws that do not hold the rotor."""
    held = [row for row in currents.values() if row["held"] and row["stable"]]
    peaks = sorted(row["peak"] for row in held)
    parts = []
    if held:
        ends = [f"{x:.2f}" for x in (peaks[0], peaks[-1])]
        parts.append(f"{max(row['zone'] for row in held)}, {' to '.join(dict.fromkeys(ends))}")
    for words, wrong in (("lost", False), ("held, not stable", True)):
        kinds = [kind for kind, row in currents.items() if row["held"] == wrong and not (row["held"] and row["stable"])]
        parts += [f"{words}: {', '.join(kinds)}"] if kinds else []
    return "; ".join(parts) or "-"


def _middle(values: list[float] | None, times: float) -> str:
    """Return the median with the range, or the only value; `values`: median, least and largest, or None."""
    if values is None:
        return "-"
    middle, low, high = (times * x for x in values)
    return f"{middle:.3g}" if low == high else f"{middle:.3g} ({low:.3g} to {high:.3g})"
