"""Mutation tests: the table fits the code, and no mutant survives."""

import pathlib

import pytest
from mutate import main
from mutate import mutated as applied
from mutations import MUTATIONS
from profiles import examples

ROOT = pathlib.Path(__file__).parent.parent


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.fault)
def test_every_mutation_fits_the_code(mutation):
    applied(mutation)
    path, _, name = mutation.test.partition("::")
    text = (ROOT / path).read_text()
    assert not name or f"def {name.partition('[')[0]}(" in text


@pytest.mark.thorough
def test_no_mutation_of_a_sample_survives(capsys):
    """`python tests/mutate.py` tests all mutations."""
    assert main(["--share", str(examples(26, 3))]) == 0, capsys.readouterr().out
