"""tuned.toml: the text of the case file with the tuned gains."""

import functools
import tomllib

import pytest
import tomlkit

from ambjax.cases.reader import case_from
from tuning.report.folder import tuned, tuned_case

GIVEN = """# the fan of hall 3

[controller]   # by hand, May
model = {}
position = { c = 17, k = 25.0 }  # c: try 30

[reference]
kind = "sine"
amplitude = 1_0e-4  # m

[controller.inversion] # Eq. (6)
gamma = 1_000.0   # printed
# p follows the plant

# loops of hall 3
[tune]
gains = [
  "controller.position.c", # alone
]
"""
CHANGED = {"{ c = 17,": "{ c = 20.5,", "gamma = 1_000.0   # printed\n": "gamma = 150000.0   # printed\np = 3.0\n"}
WRITTEN = "# Tuned by ambjax tune from the case 'fan'.\n# None is lost.\n\n" + functools.reduce(
    lambda text, change: text.replace(*change), CHANGED.items(), f"{GIVEN}\n[controller.current]\nk_i = 9.0\n"
)
GAINS = {"position.c": 20.5, "position.k": 25.0, "current.k_i": 9.0, "inversion.gamma": 1.5e5, "inversion.p": 3.0}
GAINS = {f"controller.{path}": value for path, value in GAINS.items()}


def written(text):
    return tuned(text, GAINS, "fan", "None is lost.")


def test_comments_order_and_format_are_kept():
    assert written(GIVEN) == WRITTEN
    assert written(GIVEN.replace("\n", "\r\n")) == WRITTEN


def test_a_file_that_is_tuned_again_has_one_note_about_it():
    assert written(WRITTEN) == WRITTEN
    assert tuned(WRITTEN, GAINS, "hall", "One is lost.") == WRITTEN.replace("'fan'", "'hall'").replace("None", "One")


PLACES = {
    "empty": "",
    "dotted keys": "controller.position.c = 17.0 # x\n[plant]\nm = 1\n",
    "dotted keys in a table": "[controller]\nposition.c = 1.0\nposition.k = 2.0 # k\n[plant]\nm = 1",
    "keys of the root": "controller.position.c = 100.0\nclock.duration = 0.01\ntune.members = 2\n",
    "inline among keys": "controller.position = { c = 1.0 }\nclock.duration = 0.5\n",
    "keys apart": "controller.position.c = 1\nplant.m = 0.6\ncontroller.inversion.gamma = 2.0 # y\nx = 1\n[run]\ns = 1",
    "keys and tables": "controller.position.c = 1\nplant.m = 0.6\n[run]\nseed = 1\n[controller.inversion]\np = 1\n",
    "inline all": "controller = { position = { c = 1.0 } }\n[plant]\nm = 1\n",
    "inline and empty": "[controller]\nposition = {}\n[controller.current]\nk_i = 3\n",
    "apart": "[controller.position]\nc = 1\n[reference]\na = 1\n[controller.inversion]\ngamma = 1\n",
    "lists of tables": "[[reference.terms]]\nx = 1\n[[reference.terms]]\nx = 2\n[controller.position]\nc = 1",
    "quoted": '"controller"."position".c = 3\n["spread"."plant.m"]\npercent = 5',
}


@pytest.mark.parametrize("text", PLACES.values(), ids=PLACES)
def test_gains_are_written_wherever_their_tables_are(text):
    wanted = tomllib.loads(text)
    for path, value in GAINS.items():
        _, stage, name = path.split(".")
        wanted.setdefault("controller", {}).setdefault(stage, {})[name] = value
    assert tomllib.loads(written(text)) == wanted


def test_comments_above_a_table_stay_above_it():
    text = "[controller.position]\nc = 17.0\n\n# 2 um, measured\n[sensor]\nstd = 2e-6\n"
    assert "\n\n# 2 um, measured\n[sensor]\nstd = 2e-6\n" in written(text)


def test_gains_that_cannot_be_written_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="gains cannot be written"):
        written("controller = 3")
    dumps = tomlkit.dumps
    monkeypatch.setattr(tomlkit, "dumps", lambda document: dumps(document) + "\n[plant]\nm = 1.0\n")
    with pytest.raises(ValueError, match="would be another case"):
        written(GIVEN)


@pytest.mark.parametrize("method", ["", 'method = "rk4"\n'])
def test_a_step_too_coarse_for_the_tuned_gains_is_replaced(method, tmp_path):
    """The printed gains allow dt = 5e-5 s; the tuned gamma makes the equations a thousand times stiffer."""
    text = f"[controller.inversion]\ngamma = 1000.0\n[clock]\ndt = 5e-5\n{method}"
    case = case_from(tomllib.loads(text), "case", text)
    same, _ = tuned_case(case, {"controller.inversion.gamma": 2000.0}, "Good.", tmp_path)
    assert tomllib.loads(same)["clock"]["dt"] == 5e-5
    changed, tuned = tuned_case(case, {"controller.inversion.gamma": 1.8e7}, "Good.", tmp_path)
    assert set(tomllib.loads(changed)["clock"].values()) == {"auto"}
    assert 'In [clock], "auto" replaces dt' in changed.splitlines()[1]
    assert float(tuned.cascade.inversion.gamma) == 1.8e7
    wrong = {"controller.inversion.gamma": -1.0}  # the step is not the cause
    with pytest.raises(ValueError, match="gamma = -1"):
        tuned_case(case, wrong, "Good.", tmp_path)
