"""Write benchmarks/README.md from the JSON in benchmarks/results."""

import json
import pathlib
from typing import Any

import _measure

HEAD = """# Benchmarks

Written by `python benchmarks/report.py` from the JSON that the scripts left in `results/`; do not edit.
Ratios are within one run of one script; absolute times depend on the machine and its load.

    .venv/bin/pip install -e '.[bench]'
    .venv/bin/python benchmarks/single.py            # one run against SciPy and diffrax
    .venv/bin/python benchmarks/work_precision.py    # the integrators among themselves
    .venv/bin/python benchmarks/report.py
"""


def load(name: str) -> dict[str, Any]:
    return json.loads((_measure.RESULTS / f"{name}.json").read_text())


def facts(machine: dict[str, Any]) -> str:
    vectors = "with" if machine["avx512"] else "without"
    versions = f"Python {machine['python']}, jax {machine['jax']}"
    return f"{machine['cpu']}, {machine['cores']} cores, {vectors} AVX-512; {versions}."


def single() -> list[str]:
    data = load("single")
    lines = ["## One run of 2 s, at equal accuracy (`single.py`)", "", facts(data["machine"])]
    lines += [f"Cheapest tolerance at which the largest error in z is at most {data['target_error_m']:g} m.", ""]
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
        "0.2 s simulated at 10 kHz.",
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


def main() -> None:
    page = "\n".join([HEAD, *single(), *work_precision()]).rstrip() + "\n"
    (pathlib.Path(__file__).parent / "README.md").write_text(page)


if __name__ == "__main__":
    main()
