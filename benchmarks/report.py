"""Write benchmarks/README.md from the JSON in benchmarks/results."""

import json
import math
import pathlib
import statistics
from typing import Any

import _measure

HEAD = """# Benchmarks

`python benchmarks/report.py` generates this page from the JSON files in `results/`. Do not edit it.
Both times of a ratio come from the same run of a script. Absolute times depend on the machine and its load.

The comparison with other libraries and the scaling were measured before metrics included substeps; ensembles with
all metrics are slower now. Other programs ran while the times of `ambjax tune`, of the search and of the page were
measured. All other times were measured on an idle machine.

The scenario is the paper's tracking scenario with the disturbance as a scaled force, unless a section names another.
Smooth gains are gamma = 1e9 and p = 25e-6 in the inversion; repaired gains are gamma = 7.5e4 and p = 25.

    .venv/bin/pip install -e '.[bench]'
    .venv/bin/python benchmarks/single.py            # one run against SciPy and diffrax
    .venv/bin/python benchmarks/work_precision.py    # accuracy and time of the integrators
    .venv/bin/python benchmarks/limit.py             # the C program alone, compared with ambjax
    .venv/bin/python benchmarks/throughput.py        # ensembles against the C program
    .venv/bin/python benchmarks/sampled.py           # the cascade on a processor against C
    .venv/bin/python benchmarks/peers.py             # ensembles against other libraries
    .venv/bin/python benchmarks/scaling.py --full    # cost and memory against members and horizon
    .venv/bin/python benchmarks/gpu.py               # ensembles on an accelerator
    .venv/bin/python benchmarks/held_noise.py        # integration methods under held noise
    .venv/bin/python benchmarks/gradients.py         # time and memory of a gradient
    .venv/bin/python benchmarks/workarounds.py       # effect of each workaround for XLA
    .venv/bin/python benchmarks/startup.py           # time of whole commands
    .venv/bin/python benchmarks/tasks.py             # the five tuning tasks
    .venv/bin/python benchmarks/sampled_tasks.py     # the tuning tasks on a processor
    .venv/bin/python benchmarks/bearings.py          # other bearings, and the templates
    .venv/bin/python benchmarks/laws.py              # control structures against each other
    .venv/bin/python benchmarks/search.py            # the search against derivative-free methods
    .venv/bin/python benchmarks/schedules.py         # 24 scheduled gains: the search against CMA-ES
    .venv/bin/python benchmarks/from_answer.py       # CMA-ES started from a tuned answer
    .venv/bin/python benchmarks/export.py            # a step of an exported controller, also on a Cortex-M4F
    .venv/bin/python benchmarks/page.py              # latency of the page with sliders
    .venv/bin/python benchmarks/report.py
"""


def load(name: str) -> dict[str, Any]:
    """Return the JSON of one script."""
    return json.loads((_measure.RESULTS / f"{name}.json").read_text())


def facts(machine: dict[str, Any]) -> str:
    """Return one sentence about the machine and the versions."""
    vectors = "with" if machine["avx512"] else "without"
    versions = f"Python {machine['python']}, jax {machine['jax']}"
    return f"{machine['cpu']}, {machine['cores']} cores, {vectors} AVX-512; {versions}."


def single() -> list[str]:
    data = load("single")
    lines = ["## One run of 2 s, at equal accuracy (`single.py`)", "", facts(data["machine"])]
    lines += [
        "Each solver has the tolerance with the shortest run for which its largest error in z is at most",
        f"{data['target_error_m']:g} m.",
        "",
    ]
    for gains in ("smooth", "repaired"):
        lines += [
            f"{gains} gains:",
            "",
            "| solver | tolerance | error in z (m) | run (ms) | ambjax is faster by | compile (s) |",
        ]
        lines += ["|---|---|---|---|---|---|"]
        for name, row in data[gains].items():
            if row is None:
                lines.append(f"| {name} | | not reached | | | |")
                continue
            cells = [f"{row['rtol']:.0e}", f"{row['error_m']:.1e}", f"{1e3 * row['seconds']:.2f}"]
            lines.append(f"| {name} | {' | '.join(cells)} | {row['ratio']:.1f} | {row['compile_s']:.2f} |")
        lines.append("")
    return lines


def work_precision() -> list[str]:
    data = load("work_precision")
    lines = [
        "## Work against precision (`work_precision.py`)",
        "",
        facts(data["machine"]),
        "Each run simulates 0.2 s at 10 kHz. The references are two solutions whose errors are much smaller.",
        "",
    ]
    lines += ["![work against precision](results/work_precision.png)", ""]
    for case, found in data["cases"].items():
        lines += [f"{case}; references agree to {found['reference_agreement_m']:.1e} m:", ""]
        lines += ["| method | largest error in z (m) | time (ms) |", "|---|---|---|"]
        for rows in found["methods"].values():
            for row in rows:
                if row:
                    lines.append(f"| {row['method']} | {row['error_m']:.1e} | {1e3 * row['seconds']:.1f} |")
        lines.append("")
    return lines


def table(titles: str, rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table and an empty line."""
    return [f"| {titles} |", "|" + "---|" * (titles.count("|") + 1), *(f"| {' | '.join(row)} |" for row in rows), ""]


def throughput() -> list[str]:
    data = load("throughput")
    lines = ["## Ensembles against the machine's limit (`throughput.py`)", "", facts(data["machine"])]
    lines += [
        f"RK4 with steps of 10 us. A run has {data['samples']} samples of 10 steps, or {data['samples_of_few']:,}",
        "samples if there are fewer than 256 members. Times are in ns per member and step, without compilation. The",
        "limit is a C program with SIMD (`limit.c`); the two programs run alternately. A single member is a",
        "`rollout`. Speed-up: speed relative to one core; in brackets, the speed-up of the limit. Held noise is",
        "constant over a sample.",
        "",
    ]
    rows = []
    for row in data["rows"]:
        named = [row["dtype"], "held" if row["noise"] else "none", str(row["members"]), str(row["threads"])]
        limit = [f"{row['C']:.2f}", f"{row['ratio']:.2f}"] if "C" in row else ["", ""]
        gain = f"{row['times_one_core']:.2f}" + (f" ({row['C_times_one_core']:.2f})" if "C" in row else "")
        rows.append([*named, f"{row['ambjax']:.2f}", *limit, gain, f"{1e9 / row['ambjax']:.2e}"])
    titles = "precision | noise | members | cores | ambjax (ns) | limit (ns) | ratio | speed-up | member-steps/s"
    lines += table(titles, rows)
    return lines


def peers() -> list[str]:
    data = load("peers")
    lines = ["## Ensembles against other libraries (`peers.py`)", "", facts(data["machine"])]
    lines += [
        "One core, no noise. Times are in ns per member and per 10 us of simulated time. `ambjax is faster by` is the",
        "time of the row divided by the time of ambjax with the method in the column `with`. Libraries with fixed",
        "steps take RK4 steps of 10 us, and are compared with the same steps of ambjax. Adaptive solvers (tolerance",
        "1e-6) are compared with the fastest method of ambjax that reaches their measured error. `at 1e-6 by` is the",
        "same ratio for the fastest method of ambjax whose error is at most 1e-6 of the largest z,",
        f"{data['largest_z_m']:.1e} m.",
        "",
    ]
    rows = []
    for name, row in data["rows"].items():
        wanted = f"{row['ratio_at_1e-6']:.1f}" if "ratio_at_1e-6" in row else ""
        cells = [name, str(row["members"]), f"{row['ns']:.1f}", f"{row['error_m']:.1e}", f"{row['ratio']:.2f}"]
        rows.append([*cells, row["against"].removeprefix("ambjax, "), wanted, f"{row['compile_s']:.1f}"])
    titles = "| members | ns | error in z (m) | ambjax is faster by | with | at 1e-6 by | compile (s)"
    return lines + table(titles, rows)


def scaling() -> list[str]:
    data = load("scaling")
    lines = ["## Cost and memory against size (`scaling.py`)", "", facts(data["machine"])]
    lines += ["Held noise, float64, one core, one process per row. Relative: time per member and step, divided by that"]
    lines += ["of 1,024 members and 200 samples. The two are measured alternately.", ""]
    for name in ("members", "samples"):
        rows = []
        for row in data[name]["rows"]:
            cells = [f"{row['members']:,}", f"{row['samples']:,}", f"{row['seconds']:.3f}", f"{row['ns']:.2f}"]
            rows.append([*cells, f"{row['relative']:.3f}", f"{row['peak_bytes'] / 2**20:.0f}"])
        lines += table("members | samples | run (s) | ns per member and step | relative | peak memory (MiB)", rows)
        lines += [f"The time is linear in the number of {name} to within {100 * data[name]['deviation']:.0f} %.", ""]
    return lines


def held_noise() -> list[str]:
    data = load("held_noise")
    lines = ["## Held noise: steps per hold (`held_noise.py`)", "", facts(data["machine"])]
    lines += ["64 members, one core, smooth gains. The noise is constant over each sample of 100 us. Errors are"]
    lines += ["relative to the largest |z|.", ""]
    for case in data["cases"]:
        lines += [f"Noise: {case['noise']}.", ""]
        cells = [[r["method"], f"{r['relative_error']:.1e}", f"{1e3 * r['seconds']:.1f}"] for r in case["methods"]]
        lines += table("method | relative error | time (ms)", cells)
        if case["ratio"]:
            best = case["best"]
            high, low = (best[kind]["method"] for kind in ("DOP853", "RK4"))
            lines += [f"Time of the fastest steps with an error of at most {data['target']:g}: {high} takes"]
            lines += [f"{case['ratio']:.2f} times as long as {low}.", ""]
    return lines


def gradients() -> list[str]:
    data = load("gradients")
    lines = ["## Cost of a gradient of four gains (`gradients.py`)", "", facts(data["machine"])]
    lines += [
        "One core, float64. The cost of a gradient is its time divided by that of a forward run with the same code",
        "and step. For four gains the tuner uses forward mode. Reverse mode recomputes parts of the run.",
        "",
    ]
    rows = []
    for r in data["rows"]:
        cells = [r["step"], str(r["members"]), f"{1e9 * r['run_s'] / r['members'] / r['steps']:.0f}"]
        rows.append([*cells, f"{r['forward']:.2f}", f"{r['reverse']:.1f}"])
    lines += table("step | members | forward run (ns per step) | gradient, forward | gradient, reverse", rows)
    rows = [[mode, *(f"{r['peak_bytes'] / 2**20:.0f}" for r in found)] for mode, found in data["memory"].items()]
    steps = [f"{r['steps']:,} steps (MiB)" for r in next(iter(data["memory"].values()))]
    return lines + table("peak memory of the process | " + " | ".join(steps), rows)


def sampled() -> list[str]:
    data = load("sampled")
    lines = ["## The cascade on a processor (`sampled.py`)", "", facts(data["machine"])]
    first = data["rows"][0]
    lines += [
        f"{first['members']:,} members, float64, one core, held noise, 10 kHz, one sample of delay with prediction,",
        f"{first['substeps']} substeps. Times are in ns per member and sample. C: the program `sampled.c`. Error:",
        "largest relative difference between C and a `rollout` under the same noise. Gradient: time of a gradient",
        f"of 4 gains in forward mode for {data['tangents_of']} members, divided by the time of a forward run.",
        "",
    ]
    rows = []
    for r in data["rows"]:
        cells = [r["p"], *(f"{r[name]:.1f}" if name in r else "" for name in ("ambjax", "C"))]
        cells += [f"{r['ratio']:.2f}", f"{r['error']:.0e}"] if "ratio" in r else ["", ""]
        rows.append([*cells, f"{r['all_metrics']:.1f}", f"{r['gradient']:.2f}"])
    return lines + table("p | ambjax | C | ratio | error | with all metrics | gradient", rows)


def tasks() -> list[str]:
    data = load("tasks")
    lines = ["## The tuning tasks (`tasks.py`)", "", facts(data["machine"])]
    lines += [
        "`ambjax tune` runs with its defaults, from gains that lose the rotor. Exceptions: E minimises the mean of",
        "the worst tenth of 64 members, and the pole of the observer ranges from 0.999 to 1e4. Errors and voltages are",
        "those of the held-out members. Steps: relative error of the settled rms error due to the steps of the search,",
        "compared with adaptive RODAS3. u rms: after settling. Processor: processor time of the whole command,",
        "while other programs ran.",
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
        cells += [f"{row['lost']} of {row['members']}", f"{row['settled_rms_u_V']:.3g}"]
        cells += [f"{100 * row['step_error']:.1g} %", f"{row['rollouts']:,}", f"{row['processor_s']:.0f}"]
        rows.append([*cells, _gains(row)])
    titles = "task | settled rms error (m) | largest (m) | lost | u rms (V) | steps | rollouts | processor (s) | gains"
    return table(titles, rows)


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
        "the same loop. Variation of u: total variation of the voltage after settling. Processor: processor time;",
        "in brackets, that of the same task in continuous time. The values of p are those of the position, inversion",
        "and current laws. c is at most a fifth of the sampling rate, l at least 0.05 1/s.",
        "",
    ]
    rows = []
    for row in data["tasks"].values():
        bar = "-" if row["bar_m"] is None else f"{row['bar_m']:.3g}"
        cells = [row["title"], bar, f"{row['settled_rms_error_m']:.2e}"]
        cells += [f"{row['settled_max_abs_error_m']:.1e}", f"{row['lost']} of {row['members']}"]
        cells += [f"{row['settled_rms_u_V']:.0f}", f"{row['chatter_V']:.1e}", f"{row['rollouts']:,}"]
        continuous = row.get("continuous", {}).get("processor_s")
        # None: the task ran on another machine than the others
        seconds = "-" if row["processor_s"] is None else f"{row['processor_s']:.0f}"
        cells += [seconds + (f" ({continuous:.0f})" if continuous else ""), _gains(row)]
        rows.append(cells)
    titles = "task | CMA-ES (m) | settled rms error (m) | largest (m) | lost | u rms (V) | variation of u (V) | "
    return lines + table(titles + "rollouts | processor (s) | gains", rows)


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
        "of rollouts is therefore no measure of the cost. Time: processor time of one search on one core.",
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


def startup() -> list[str]:
    data = load("startup")
    lines = ["## Time of whole commands (`startup.py`)", "", facts(data["machine"])]
    lines += [
        "Each command runs in a new process with a warm compilation cache, on the paper's tracking case. Medians of",
        f"{data['runs']} runs; least: the shortest of them. Relative: processor time divided by that of `import jax`.",
        "",
    ]
    rows = [
        [f"`{name}`", *(f"{row[key]:.2f}" for key in ("wall_s", "least_wall_s", "cpu_s", "cpu_over_import_jax"))]
        for name, row in data["rows"].items()
    ]
    return lines + table("command | wall (s) | least wall (s) | processor (s) | relative", rows)


def workarounds() -> list[str]:
    data = load("workarounds")
    lines = ["## Workarounds for XLA's compiler (`workarounds.py`)", "", facts(data["machine"])]
    lines += [
        "The table gives the time without a workaround, divided by the time with it, for three programs: medians of",
        f"{data['rounds']} pairs of runs.",
        "",
    ]
    jobs = [key for key in next(iter(data["rows"].values())) if key != "says"]
    rows = [[name, row["says"], *(f"{row[job]:.2f}" for job in jobs)] for name, row in data["rows"].items()]
    return lines + table(" | ".join(["workaround", "effect of its absence", *jobs]), rows)


def gpu() -> list[str]:
    data = load("gpu")
    lines = ["## On an accelerator (`gpu.py`)", "", f"{data['device']}; {facts(data['machine'])}", ""]
    rows = [
        [r["dtype"], "held" if r["noise"] else "none", f"{r['members']:,}", r["run"], f"{r['steps_per_s']:.2e}"]
        for r in data["rows"]
    ]
    return lines + table("precision | noise | members | run as | member-steps/s", rows)


def export() -> list[str]:
    data = load("export")
    lines = ["## A step of the exported controller (`export.py`)", "", facts(data["machine"])]
    lines += [
        "Cycles and ns: medians on this machine, from the time stamp counter. Instructions, code and stack: of a",
        "Cortex-M4F; QEMU counts the instructions.",
        "",
    ]
    rows = []
    for r in data["rows"]:
        there = [f"{r[key]:,}" if key in r else "" for key in ("instructions", "code_bytes", "stack_bytes")]
        work = [str(r[key]) for key in ("flops", "divisions", "roots")]
        rows.append([r["case"], r["precision"], *work, f"{r['cycles']:.0f}", f"{r['ns']:.0f}", *there])
    titles = (
        "laws | precision | flops | divisions | roots | cycles | ns | instructions, M4F | code (bytes) | stack (bytes)"
    )
    return lines + table(titles, rows)


def sliders() -> list[str]:
    data = load("page")
    lines = ["## The page with sliders (`page.py`)", "", facts(data["machine"])]
    lines += [
        f"The rig, {data['samples']:,} samples at 20 kHz, in headless Chromium, without a GPU. The file has "
        f"{data['page_kB']:,} kB.",
        f"Other programs ran: the load was {data['load']:.0f} on {data['machine']['cores']} cores.",
        "The CPU time is that of the thread that draws; the loop runs in a worker.",
        "",
    ]
    rows = [
        ["a drag, from the event to the drawn frame", f"{data['drag_ms']:.0f}", f"{data['drag_fastest_ms']:.0f}"],
        ["CPU time of a drag, drawing", f"{data['drag_cpu_ms']:.0f}", ""],
        ["the loop and |S| in the worker", f"{data['loop_ms']:.0f}", f"{data['loop_fastest_ms']:.0f}"],
        ["a drag with the envelope of 64 members", f"{data['members_ms']:.0f}", f"{data['members_fastest_ms']:.0f}"],
    ]
    return lines + table(
        "what | median (ms) | fastest (ms)", [[cell.replace("|", "\\|") for cell in row] for row in rows]
    )


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


def _middle(values: list[float] | None, times: float) -> str:
    """Return the median with the range, or the only value; `values`: median, least and largest, or None."""
    if values is None:
        return "-"
    middle, low, high = (times * x for x in values)
    return f"{middle:.3g}" if low == high else f"{middle:.3g} ({low:.3g} to {high:.3g})"


SECTIONS = {
    "single": single,
    "work_precision": work_precision,
    "throughput": throughput,
    "sampled": sampled,
    "peers": peers,
    "scaling": scaling,
    "held_noise": held_noise,
    "gradients": gradients,
    "startup": startup,
    "workarounds": workarounds,
    "tasks": tasks,
    "bearings": bearings,
    "sampled_tasks": sampled_tasks,
    "search": search,
    "laws": laws,
    "schedules": schedules,
    "from_answer": from_answer,
    "gpu": gpu,
    "export": export,
    "page": sliders,
}


def page() -> str:
    """Return the page with every section whose JSON exists."""
    lines = [HEAD]
    for name, section in SECTIONS.items():
        if (_measure.RESULTS / f"{name}.json").exists():
            lines += section()
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Write benchmarks/README.md."""
    (pathlib.Path(__file__).parent / "README.md").write_text(page())


if __name__ == "__main__":
    main()
