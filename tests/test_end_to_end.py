"""Each command from its arguments to its files, on the paper's scenario and on a sampled bearing."""

import json
import pathlib

import pytest
from texts import write

from ambjax.__main__ import main
from ambjax.cases.reader import read_case

# The paper's tracking scenario in continuous time, from the printed gains, with small noise.
PAPER = """
reference = { kind = "sine", amplitude = 0.0025, frequency = 2.0 }
disturbance.q_z = { kind = "pulse", amplitude = 1.0, start = 0.01, stop = 0.015, unit = "A^2/m^2" }
sensor = { std = 1e-6, std_z_dot = 1e-4, std_i = 1e-4 }
actuator = { u_max = 200.0 }
clock = { duration = 0.03 }
run = { settle = 0.02 }
spread = { plant.m = { percent = 10 } }
[controller.inversion]
gamma = 1000.0  # the printed gain, which loses every member
"""
# A bearing from a data sheet on a processor, without a velocity sensor.
BEARING = """
plant = { m = 2.4, k_z = 0.0, mu_0 = 1.2566e-6, n = 300.0, A = 2.0e-4, s_0 = 5e-4, i_0 = 2.0, R = 1.0 }
controller.observer = { kind = "kalman" }
controller.position = { kind = "pid", k_p = 2e5 }
controller.inversion = { kind = "linearised" }
controller.current = { kind = "pi" }
processor = { delay = 1.0 }
sensor = { std = 3e-7, std_i = 2e-3, velocity = false, bits = 14 }
actuator = { u_max = 72.0 }
initial = { z = 2e-5 }
clock = { duration = 0.03, sample_period = 6.25e-5 }
run = { settle = 0.015 }
spread = { plant.m = { percent = 10 } }
"""
# The smallest search, of one gain.
SMALLEST = """
[tune]
gains = ["controller.position.c"]
members = 2
stressed = 0
validation = 2
held_out = 2
screen = 0
starts = 1
iterations = 1
front = 1
limits.sensitivity = 8.0
"""
CASES = {"paper": PAPER + SMALLEST, "bearing": BEARING}
MAP = ["--x", "plant.m=-10%:10%:2", "--y", "initial.z=1e-5:2e-5:2"]
PICTURES = ("before.png", "after.png", "spectrum.png", "convergence.png")
REPORT = ("report.json", "report.md", "report.html", *PICTURES)
# For each command: its arguments, and the files that it writes.
COMMANDS = {
    "ensemble": (
        ["ensemble", "case.toml", "--members", "4"],
        ("members.npz", "summary.json", "fan.png", "histograms.png"),
    ),
    "tune": (["tune", "case.toml"], ("tuned.toml", "history.npz", *REPORT)),
    "map": (["map", "case.toml", *MAP], ("map.json", "map.png")),
    "sensitivity": (["sensitivity", "case.toml", "--members", "2"], ("sensitivity.json", "sensitivity.png")),
    "export": (["export", "case.toml"], ("README.md", "amb_case.c", "amb_case.h")),
    "page": (["page", "case.toml", "--out", "page/page.html"], ("page.html",)),
}
# The commands for each case. docs/start.md tunes a case with a processor and verifies its export, docs/study.md
# simulates an ensemble, and tests/test_compare.py compares two cases.
CHOSEN = {"paper": ("tune",), "bearing": ("map", "sensitivity", "export", "page")}


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize(
    "case", [pytest.param("paper", marks=pytest.mark.thorough), pytest.param("bearing", marks=pytest.mark.slow)]
)
def test_every_command_writes_all_of_its_files(case, capsys):
    """An error in a description would end its command (conftest.py)."""
    write(CASES[case])
    for command in CHOSEN[case]:
        words, names = COMMANDS[command]
        assert main([*words, *([] if "--out" in words else ["--out", command]), "--json"]) in (0, 1)
        said = capsys.readouterr()
        json.loads(said.out)
        assert "Traceback" not in said.err
        assert "Warning" not in said.err
        for name in names:
            assert pathlib.Path(command, name).stat().st_size > 0, (command, name)
    for path in pathlib.Path().rglob("tuned.toml"):
        read_case(path)
