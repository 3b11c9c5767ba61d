"""Sections of the benchmark page: simulation, ensembles, gradients, commands, exported programs."""

from typing import Any

from _tables import facts, load, table


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


def throughput() -> list[str]:
    data, older = load("throughput"), load("throughput_avx2")
    lines = ["## Ensembles against the machine's limit (`throughput.py`)", "", facts(data["machine"])]
    lines += [
        f"RK4 with steps of 10 us. A run has {data['samples']} samples of 10 steps, or {data['samples_of_few']:,}",
        "samples if there are fewer than 256 members. Times are in ns per member and step, without compilation. The",
        "limit is a C program (`limit.c`) with vectors of 64 bytes (AVX-512) or 32 bytes, two of them interleaved. The",
        "two programs run alternately. A single member is a `rollout`. Speed-up: speed relative to one core; in",
        "brackets, that of the limit. Held noise is constant over a sample.",
        "",
    ]
    lines += _throughput_rows(data)
    lines += [
        "The same with the instructions of a processor without AVX-512",
        "(`XLA_FLAGS=--xla_cpu_max_isa=AVX2`):",
        "",
    ]
    return lines + _throughput_rows(older)


def _throughput_rows(data: dict[str, Any]) -> list[str]:
    rows = []
    for row in data["rows"]:
        named = [row["dtype"], "held" if row["noise"] else "none", str(row["members"]), str(row["threads"])]
        limit = [f"{row['C']:.2f}", f"{row['ratio']:.2f}"] if "C" in row else ["", ""]
        gain = f"{row['times_one_core']:.2f}" + (f" ({row['C_times_one_core']:.2f})" if "C" in row else "")
        rows.append([*named, f"{row['ambjax']:.2f}", *limit, gain, f"{1e9 / row['ambjax']:.2e}"])
    titles = "precision | noise | members | cores | ambjax (ns) | limit (ns) | ratio | speed-up | member-steps/s"
    return table(titles, rows)


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


def gpu() -> list[str]:
    data = load("gpu")
    lines = [f"## Ensembles on a GPU, {data['device']} (`gpu.py`)", "", facts(data["machine"])]
    lines += [
        f"RK4 with steps of 10 us, {data['samples']} samples of 10 steps; times without compilation. Kernel:",
        "`run_on_gpu`, which runs the time loop within one kernel. Scan: `run_ensemble` on the GPU. Processor:",
        "`run_ensemble` on all cores of the same machine. Error: largest relative difference between the results of",
        "kernel and scan. Held noise is constant over a sample.",
        "",
    ]
    found = {(r["dtype"], r["noise"], r["members"], r["run"]): r for r in data["rows"]}
    rows = []
    for (dtype, noise, members, run), row in found.items():
        if run == "kernel":
            rates = {name: found[dtype, noise, members, name]["steps_per_s"] for name in (run, "scan", "processor")}
            cells = [dtype, "held" if noise else "none", f"{members:,}", *(f"{rate:.2e}" for rate in rates.values())]
            ratios = [f"{rates[run] / rates[name]:.1f}" for name in ("scan", "processor")]
            rows.append([*cells, *ratios, f"{row['error']:.0e}"])
    titles = "precision | noise | members | kernel (member-steps/s) | scan | processor | kernel / scan"
    lines += table(f"{titles} | kernel / processor | error", rows)
    blocks = [r | {"block": r["run"].split(" = ")[1]} for r in data["rows"] if "block" in r["run"]]
    by_block = "; ".join(f"{r['dtype']}, {r['block']}: {r['steps_per_s']:.2e}" for r in blocks)
    slowest = max(r["compile_s"] for r in blocks)
    lines += [
        f"Other values of `block`, {blocks[0]['members']:,} members, no noise, in member-steps/s:",
        f"{by_block}.",
    ]
    return [*lines, f"Tracing and compiling a kernel took up to {slowest:.1f} s.", ""]


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


def startup() -> list[str]:
    data = load("startup")
    lines = ["## Time of whole commands (`startup.py`)", "", facts(data["machine"])]
    lines += [
        "Each command runs in a new process. tracking.toml: the paper's tracking case; rig.toml: the template of a",
        f"laboratory rig with a processor. First: the cache of programs is empty, median of {data['first_runs']} runs.",
        f"Wall, processor: with a filled cache, medians of {data['runs']} runs; least: the shortest of them. Relative:",
        "processor time divided by that of `import jax`.",
        "",
    ]
    columns = ("first_wall_s", "wall_s", "least_wall_s", "cpu_s", "cpu_over_import_jax")
    rows = [[f"`{name}`", *(f"{row[key]:.2f}" for key in columns)] for name, row in data["rows"].items()]
    return lines + table("command | first (s) | wall (s) | least wall (s) | processor (s) | relative", rows)


def workarounds() -> list[str]:
    data = load("workarounds")
    lines = ["## Workarounds for XLA's compiler (`workarounds.py`)", "", facts(data["machine"])]
    lines += [
        "The table gives the time without a workaround, divided by the time with it, for four programs (`short`: 32",
        "members on a processor, in one block; `ensemble` and `processor`: 1,024 members): medians of",
        f"{data['rounds']} pairs of runs.",
        "",
    ]
    jobs = [key for key in next(iter(data["rows"].values())) if key != "says"]
    rows = [[name, row["says"], *(f"{row[job]:.2f}" for job in jobs)] for name, row in data["rows"].items()]
    return lines + table(" | ".join(["workaround", "effect of its absence", *jobs]), rows)


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
