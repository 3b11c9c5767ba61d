"""Write benchmarks/README.md from the JSON in benchmarks/results."""

import pathlib

import _fleet_sections as fleet
import _measure
import _simulation_sections as simulated
import _tuning_sections as tuned

HEAD = """# Benchmarks

`python benchmarks/report.py` generates this page from the JSON files in `results/`. Do not edit it.
Both times of a ratio come from the same run of a script. Absolute times depend on the machine and its load.

The comparison with other libraries and the scaling were measured before metrics included substeps; ensembles with
all metrics are slower now. Other programs ran while the times of `ambjax tune`, of the search, of whole machines and
of the page were measured. All other times were measured on an idle machine.

The scenario is the paper's tracking scenario with the disturbance as a scaled force, unless a section names another.
Smooth gains are gamma = 1e9 and p = 25e-6 in the inversion; repaired gains are gamma = 7.5e4 and p = 25.

    .venv/bin/pip install -e '.[bench]'
    .venv/bin/python benchmarks/single.py            # one run against SciPy and diffrax
    .venv/bin/python benchmarks/work_precision.py    # accuracy and time of the integrators
    .venv/bin/python benchmarks/limit.py             # the C program alone, compared with ambjax
    .venv/bin/python benchmarks/throughput.py        # ensembles against the C program
    .venv/bin/python benchmarks/sampled.py           # the cascade on a processor against C
    .venv/bin/python benchmarks/machines.py          # whole machines against C
    .venv/bin/python benchmarks/peers.py             # ensembles against other libraries
    .venv/bin/python benchmarks/scaling.py --full    # cost and memory against members and horizon
    .venv/bin/python benchmarks/gpu.py               # ensembles on a GPU
    .venv/bin/python benchmarks/held_noise.py        # integration methods under held noise
    .venv/bin/python benchmarks/gradients.py         # time and memory of a gradient
    .venv/bin/python benchmarks/workarounds.py       # effect of each workaround for XLA
    .venv/bin/python benchmarks/startup.py           # time of whole commands
    .venv/bin/python benchmarks/tasks.py             # the five tuning tasks
    .venv/bin/python benchmarks/sampled_tasks.py     # the tuning tasks on a processor
    .venv/bin/python benchmarks/bearings.py          # other bearings, and the templates
    .venv/bin/python benchmarks/fleet.py             # bearings drawn at random
    .venv/bin/python benchmarks/ablation.py          # the tuner without one mechanism
    .venv/bin/python benchmarks/laws.py              # control structures against each other
    .venv/bin/python benchmarks/default_gains.py     # every structure untuned
    .venv/bin/python benchmarks/search.py            # the search against derivative-free methods
    .venv/bin/python benchmarks/schedules.py         # 24 scheduled gains: the search against CMA-ES
    .venv/bin/python benchmarks/from_answer.py       # CMA-ES started from a tuned answer
    .venv/bin/python benchmarks/export.py            # a step of an exported controller, also on a Cortex-M4F
    .venv/bin/python benchmarks/page.py              # latency of the page with sliders
    .venv/bin/python benchmarks/report.py
"""

SECTIONS = {
    "single": simulated.single,
    "work_precision": simulated.work_precision,
    "throughput": simulated.throughput,
    "sampled": simulated.sampled,
    "machines": fleet.machines,
    "peers": simulated.peers,
    "scaling": simulated.scaling,
    "gpu": simulated.gpu,
    "held_noise": simulated.held_noise,
    "gradients": simulated.gradients,
    "startup": simulated.startup,
    "workarounds": simulated.workarounds,
    "tasks": tuned.tasks,
    "bearings": tuned.bearings,
    "fleet": fleet.fleet,
    "ablation": fleet.ablation,
    "sampled_tasks": tuned.sampled_tasks,
    "search": tuned.search,
    "laws": tuned.laws,
    "default_gains": tuned.default_gains,
    "schedules": tuned.schedules,
    "from_answer": tuned.from_answer,
    "export": simulated.export,
    "page": simulated.sliders,
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
