"""Untuned control structures: is the rotor held, and in which zone is the peak of |S|?

Every position law with every inversion and every current law, with its default gains, on the machines of `MACHINES`. A
machine without a sensor of the velocity has a Kalman filter, also untuned. The peak of |S| is that of the linearised
loop over the whole range of frequencies. The simulation contains the disturbances, the noise and the limits of the
case. `linear` is left out: its gains are in a file.
Results that exist are not computed again; `--again` computes all.
Run: python benchmarks/default_gains.py [MACHINE ...] [--again]
"""

import argparse
import json
import pathlib
import tomllib
from typing import Any

import _measure
import jax

import ambjax
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import Case, case_from
from ambjax.cases.template_text import template

CASES = pathlib.Path(__file__).parent.parent / "tests" / "cases" / "machines"
MACHINES = {
    "rig": "the laboratory bearing of `ambjax template rig`",
    "bearing": "the bearing of `ambjax template bearing`",
    "blower": "the thrust bearing of a turbo blower, two coils (`tests/cases/machines/blower.toml`)",
    "spindle": "a small spindle at 50 kHz with current amplifiers (`tests/cases/machines/spindle.toml`)",
    "tracking": "the paper's plant and tracking scenario (`ambjax template tracking`, 1 s)",
}
# Laws without default gains, and a law without feedback of the current.
EXCLUDED = ("linear", "open-loop")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("machines", nargs="*", default=list(MACHINES))
    parser.add_argument("--again", action="store_true", help="compute results that exist, too")
    given = parser.parse_args()
    path = _measure.RESULTS / "default_gains.json"
    rows = json.loads(path.read_text())["rows"] if path.exists() and not given.again else {}
    for name, laws in order(given.machines):
        key = "/".join((name, *laws))
        if key not in rows:
            rows[key] = result(case_of(machine(name), laws))
            print(f"{key}: {rows[key]}", flush=True)
            _measure.write("default_gains", {"machines": MACHINES, "rows": rows})
            jax.clear_caches()


def order(names: list[str]) -> list[tuple[str, tuple[str, str, str]]]:
    """Return the machines and structures in an order in which a part of them contains every law on every machine."""
    every = [(name, laws) for name in names for laws in structures(machine(name))]
    counts: dict[tuple[str, str], int] = {}
    ranked = []
    for name, laws in every:
        place = counts[name, laws[0]] = counts.get((name, laws[0]), -1) + 1
        turn = list(KINDS["position"]).index(laws[0])
        ranked.append(((5 * place + turn) % 12, name, laws))
    return [(name, laws) for _, name, laws in sorted(ranked, key=lambda row: row[0])]


def machine(name: str) -> dict[str, Any]:
    """Return the tables of a machine without its spread, its [tune] and its laws."""
    path = CASES / f"{name}.toml"
    raw = tomllib.loads(path.read_text() if path.exists() else template(name))
    if name == "tracking":
        raw["clock"]["duration"] = 1.0
    velocity = raw.get("sensor", {}).get("velocity", True)
    raw["controller"] = {"observer": {"kind": "direct" if velocity else "kalman"}}
    return {name: table for name, table in raw.items() if name not in ("spread", "tune")}


def structures(raw: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the kinds of position, inversion and current law of every structure that fits the amplifier."""
    command = raw.get("actuator", {}).get("mode", "voltage")
    fitting = [kind for kind, law in KINDS["current"].items() if getattr(law, "commands", "") == command]
    stages = KINDS["position"], KINDS["inversion"], fitting
    kinds = ([kind for kind in stage if kind not in EXCLUDED] for stage in stages)
    positions, inversions, currents = kinds
    return [
        (position, inversion, current) for position in positions for inversion in inversions for current in currents
    ]


def case_of(raw: dict[str, Any], laws: tuple[str, str, str]) -> Case:
    """Return the case of a machine with these laws."""
    stages = zip(("position", "inversion", "current"), laws, strict=True)
    return case_from(raw | {"controller": raw["controller"] | {stage: {"kind": kind} for stage, kind in stages}})


def result(case: Case) -> dict[str, Any]:
    """Return whether the rotor is held, its error as a share of the gap, and the peak of |S| with its zone."""
    run = ambjax.simulate(case)
    row: dict[str, Any] = {"held": not run.lost}
    row["lost_at_s"] = float(run.metrics["lost_at_s"]) if run.lost else None
    row["error_share"] = float(run.metrics["settled_max_abs_error_m"]) / float(case.scenario.plant.s_0)
    try:
        found = ambjax.sensitivity(case)
    except ValueError as error:
        return row | {"stable": False, "peak": None, "zone": None, "why": str(error)}
    return row | {"stable": found.stable, "peak": found.S.height, "frequency_Hz": found.S.frequency, "zone": found.zone}


if __name__ == "__main__":
    main()
