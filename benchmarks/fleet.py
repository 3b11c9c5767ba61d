"""Tune bearings that nobody tuned the tuner for: drawn at random, as data sheets would give them.

Each bearing is tuned by `ambjax tune` with its defaults, within MINUTES. The tuner was developed on bearings 0 to 23,
so later ones judge it. The figures are those of the held-out members. Bearings with a result are not tuned again;
results of other bearings are kept.
Run: python benchmarks/fleet.py [NUMBER ...] [--again] [--out DIR]
"""

import argparse
import json
import math
import pathlib
import subprocess
import sys
import time
from typing import Any

import _measure
import numpy as np
import tomlkit

COUNT, MINUTES, HELD_OUT = 30, 10.0, 200
# Laws of the bearings, in turn.
STRUCTURES = (
    {"position": {"kind": "sliding-mode"}},
    {"position": {"kind": "integral-sliding-mode"}},
    {"position": {"kind": "pid"}, "inversion": {"kind": "linearised"}, "current": {"kind": "pi"}},
)
MU_0, GRAVITY = 1.2566e-6, 9.81
# Ranges of the numbers that are drawn, and whether their logarithm is uniform.
RANGES = {
    "m": (0.3, 50.0, True),  # kg
    "s_0": (2.5e-4, 8e-4, False),  # m
    "flux": (0.3, 0.65, False),  # T; bias flux density
    "reserve": (5.0, 15.0, False),  # largest force over the weight
    "volts": (40.0, 90.0, True),  # V; u_max of a rotor of 1 kg; it grows with the square root of the mass
    "supply": (10.0, 20.0, False),  # u_max over the voltage that changes the current by the bias current in 1/pole
    "rate": (1e4, 2.5e4, False),  # Hz; of the processor
    "bits": (12, 17, False),
    "time_constant": (0.01, 0.05, True),  # s; L/R
    "noise": (1e-7, 5e-7, True),  # m
    "load": (0.2, 0.6, False),  # step of force over the weight
    "vibration": (0.05, 0.2, False),  # amplitude of the sine of force over the weight
    "frequency": (30.0, 300.0, True),  # Hz
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("numbers", nargs="*", type=int, default=list(range(COUNT)))
    parser.add_argument("--again", action="store_true", help="also tune bearings with a result")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "fleet"))
    given = parser.parse_args()
    path = _measure.RESULTS / "fleet.json"
    rows = json.loads(path.read_text())["rows"] if path.exists() else {}
    for number in given.numbers:
        if given.again or str(number) not in rows:
            rows[str(number)] = tuned(number, given.out)
            print(number, rows[str(number)], flush=True)
            _measure.write(
                "fleet", {"minutes": MINUTES, "rows": dict(sorted(rows.items(), key=lambda row: int(row[0])))}
            )


def tuned(number: int, out: pathlib.Path) -> dict[str, Any]:
    """Tune a bearing and return its row."""
    out.mkdir(parents=True, exist_ok=True)
    raw = bearing(number)
    path, folder = out / f"{number}.toml", out / str(number)
    path.write_text(tomlkit.dumps(raw))
    words = [str(path), "--out", str(folder), "--force", "--budget", str(MINUTES)]
    began = time.monotonic()
    with (out / f"{number}.log").open("w") as log:
        done = subprocess.run([sys.executable, "-m", "tuning", *words], check=False, stdout=log, stderr=log)
    row: dict[str, Any] = {
        "structure": raw["controller"]["position"]["kind"],
        "minutes": (time.monotonic() - began) / 60,
    }
    if done.returncode not in (0, 1):
        return row | {"good": False, "against": [f"exit code {done.returncode}"]}
    report = json.loads((folder / "report.json").read_text())
    after = report["after"]
    peak = next((one["reached"] for one in report["limits"] if one["name"] == "sensitivity"), None)
    return row | {
        "good": report["outcome"]["good"],
        "against": report["outcome"]["against"],
        "members": after["members"],
        "lost": after["lost"],
        "lost_before": report["before"]["lost"],
        "error_m": after.get("settled_rms_error_m"),
        "u_V": after.get("settled_rms_u_V.mean"),
        "u_max_V": raw["actuator"]["u_max"],
        "sensitivity": peak,
        "rollouts": report["search"]["rollouts"],
    }


def bearing(number: int) -> dict[str, Any]:
    """Return the raw case of a bearing. Its numbers follow from those drawn and from the equations of the magnet."""
    random = np.random.default_rng([44, number])
    drawn = {}
    for name, (low, high, logarithmic) in RANGES.items():
        x = random.uniform(*(np.log((low, high)) if logarithmic else (low, high)))
        drawn[name] = float(np.exp(x) if logarithmic else x)
    m, s_0, flux = (drawn[name] for name in ("m", "s_0", "flux"))
    weight = m * GRAVITY
    area = drawn["reserve"] * weight * MU_0 / (4 * flux**2)  # twice the bias flux gives the largest force
    pole, period = math.sqrt(drawn["reserve"] * GRAVITY / s_0), 1 / drawn["rate"]
    linkage = 2 * flux * area  # L i_0 over the number of turns
    u_max = drawn["volts"] * math.sqrt(m)
    turns = max(round(u_max / (drawn["supply"] * linkage * pole)), 1)
    i_0 = 2 * s_0 * flux / (MU_0 * turns)
    inductance = MU_0 * turns**2 * area / (2 * s_0)
    cascade = {"observer": {"kind": "kalman"}, **STRUCTURES[number % len(STRUCTURES)]}
    spread = {f"plant.{name}": {"percent": 10} for name in ("m", "A", "R")} | {
        "initial.z": {"uniform": [-s_0 / 5, s_0 / 5]}
    }
    loads = [
        {"kind": "step", "unit": "N", "amplitude": drawn["load"] * weight, "start": 0.1},
        {"kind": "sine", "unit": "N", "amplitude": drawn["vibration"] * weight, "frequency": drawn["frequency"]},
    ]
    raw: dict[str, Any] = {
        "plant": {
            "m": m, "k_z": 0.0, "mu_0": MU_0, "n": float(turns), "A": area, "s_0": s_0, "i_0": i_0,
            "R": inductance / drawn["time_constant"], "g": GRAVITY,
        },
        "controller": cascade,
        "disturbance": {"q_z": loads},
        "processor": {"delay": 1.0},
        "sensor": {"std": drawn["noise"], "std_i": i_0 / 1000, "velocity": False, "bits": int(drawn["bits"])},
        "actuator": {"u_max": u_max, "i_max": i_0},
        "initial": {"z": s_0 / 10},
        "clock": {"duration": round(0.3 / period) * period, "sample_period": period},
        "run": {"settle": 0.05, "clearance": s_0 / 2},
        "spread": nested(spread),
        "tune": {"held_out": HELD_OUT},
    }  # fmt: skip
    return raw


def nested(paths: dict[str, Any]) -> dict[str, Any]:
    """Return tables from values by dotted path."""
    tables: dict[str, Any] = {}
    for path, value in paths.items():
        first, _, name = path.partition(".")
        tables.setdefault(first, {})[name] = value
    return tables


if __name__ == "__main__":
    main()
