"""Helpers for the text of a case file: write it, read it with its [tune], and the line with which it is refused."""

import os
import pathlib
import tomllib

from ambjax.__main__ import main
from ambjax.cases.reader import case_from
from ambjax.cases.table import Table
from tuning.problem.config import tune_from
from tuning.problem.tuning_problem import problem_of

# The end of a case: a search of a few iterations without weights and limits, for keys of [tune] that follow.
SMALL_SEARCH = """
[tune]
objective = "least_error"
weights = { effort = 0.0, chatter = 0.0 }
limits = { sensitivity = inf, rms_u_V = inf }
stressed = 0
screen = 0
starts = 1
iterations = 10
"""


def write(text, name="case.toml"):
    """Write the text to a file in the folder where the test runs. Return its name."""
    pathlib.Path(name).write_text(text, encoding="utf-8")
    return name


def piped(text):
    """Return the name of a pipe from which this text can be read once."""
    there, here = os.pipe()
    os.write(here, text.encode())
    os.close(here)
    return f"/dev/fd/{there}"


def refusal(capsys, *words, program=main):
    """Return the line on stderr of a command that refuses its words: exit code 2, nothing on stdout.

    Only warnings, which begin with the name of a case file, may precede it.
    """
    try:
        code = program([str(word) for word in words])
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    *warned, said = err.splitlines()
    assert (code, out) == (2, ""), err
    assert all(".toml: " in line for line in warned), err
    assert said.isprintable()
    return f"{said}\n"


def case_and_tune(document, **tune):
    """The case of a document and its [tune], some keys replaced."""
    case = case_from(document | {"tune": document.get("tune", {}) | tune}, "case")
    return case, tune_from(Table(document.get("tune", {}) | tune, "tune"), case)


def problem_from(text, **tune):
    """The tuning problem of a text, some keys of its [tune] replaced."""
    return problem_of(*case_and_tune(tomllib.loads(text), **tune))
