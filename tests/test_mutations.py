"""Mutation tests: the table fits the code, killed and surviving mutants are distinguished, and none survives."""

import contextlib
import pathlib

import pytest
from mutate import KILLED, SURVIVED, hunt, main, parent, sample, verdict
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


def test_the_table_has_at_least_25_different_mutations():
    assert len({m.fault for m in MUTATIONS}) == len({(m.file, m.old, m.new) for m in MUTATIONS}) == len(MUTATIONS) >= 25


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


@pytest.mark.slow
def test_killed_and_surviving_mutants_are_distinguished(project):
    with contextlib.closing(parent()) as forks:
        assert verdict(BREAK, project, forks) == KILLED
        assert verdict(BREAK._replace(test="tests/test_it.py::test_zero"), project, forks) == SURVIVED
        assert "NOT JUDGED" in verdict(BREAK._replace(test="tests/test_it.py::test_two"), project, forks)
    assert (project / BREAK.file).read_text() == PROGRAM  # never in place


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"old": "3 * x"}, "is found 0 times"),
        ({"old": "x"}, "is found 2 times"),
        ({"new": "2 * x"}, "changes nothing"),
        ({"file": "ambjax/none.py"}, "no such file"),
    ],
)
def test_a_mutation_that_no_longer_fits_is_reported(project, change, says):
    said = []
    assert hunt([BREAK._replace(**change)], project, say=said.append) == 1
    assert says in said[-1]


@pytest.mark.slow
def test_a_test_that_fails_without_a_mutation_is_reported(project):
    said = []
    (project / "tests/test_it.py").write_text(TESTS.replace("== 2", "== 3"))
    assert hunt([BREAK], project, jobs=1, say=said.append) == 1
    assert "mend them first" in said[-1]


def test_a_sample_depends_on_the_text_of_the_program(project):
    mutations = [BREAK._replace(fault=str(number)) for number in range(1000)]
    before = sample(mutations, 10, project)
    assert 60 <= len(before) <= 140  # binomial: 100 on average, four standard deviations of 9.5
    (project / BREAK.file).write_text(PROGRAM + "\n")
    after = sample(mutations, 10, project)
    assert len(set(before) & set(after)) <= 40  # independent samples share 10 on average
    assert sample(mutations, 1, project) == mutations


@pytest.mark.slow
def test_no_mutation_of_a_sample_survives(capsys):
    """`python tests/mutate.py` tests all mutations in a quarter of an hour."""
    assert main(["--share", str(examples(160, 12))]) == 0, capsys.readouterr().out
