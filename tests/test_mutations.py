"""Mutation tests: the table fits the code, killed and surviving mutants are distinguished, and none survives."""

import pathlib

import pytest
from mutate import KILLED, SURVIVED, hunt, main, verdict
from mutate import mutated as applied
from mutations import MUTATIONS, Mutation
from profiles import examples

ROOT = pathlib.Path(__file__).parent.parent


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.fault)
def test_every_mutation_fits_the_code(mutation):
    applied(mutation)
    path, _, name = mutation.test.partition("::")
    text = (ROOT / path).read_text()
    assert not name or f"def {name.partition('[')[0]}(" in text


PROGRAM = "def double(x):\n    return 2 * x  # twice\n"
TESTS = """from program import double


def test_zero():
    assert double(0) == 0


def test_one():
    assert double(1) == 2
"""
BREAK = Mutation("once", "ambjax/program.py", "2 * x", "1 * x", "tests/test_it.py::test_one")


@pytest.fixture
def project(tmp_path):
    """A program of one line with two tests, of which only the second detects the mutation."""
    for name, text in {"ambjax/program.py": PROGRAM, "tests/test_it.py": TESTS}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\npythonpath = ["ambjax"]\n')
    return tmp_path


@pytest.mark.thorough
def test_killed_and_surviving_mutants_are_distinguished(project):
    assert verdict(BREAK, project) == KILLED
    assert verdict(BREAK._replace(test="tests/test_it.py::test_zero"), project) == SURVIVED
    assert "NOT JUDGED" in verdict(BREAK._replace(test="tests/test_it.py::test_two"), project)
    assert (project / BREAK.file).read_text() == PROGRAM  # never in place
    said = []
    (project / "tests/test_it.py").write_text(TESTS.replace("== 2", "== 3"))
    assert hunt([BREAK], project, jobs=1, say=said.append) == 1
    assert "mend them first" in said[-1]


@pytest.mark.thorough
def test_no_mutation_of_a_sample_survives(capsys):
    """`python tests/mutate.py` tests all mutations."""
    assert main(["--share", str(examples(26, 3))]) == 0, capsys.readouterr().out
