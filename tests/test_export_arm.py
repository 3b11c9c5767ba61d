"""The C on a Cortex-M4F under QEMU: the test program, and code that fits a small processor."""

import pathlib
import sys

import pytest
from profiles import THOROUGH
from test_export import CASCADES, REPEATED, placed, text

sys.path.append(str(pathlib.Path(__file__).parents[1] / "benchmarks"))
import cortex

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(cortex.missing()), reason=cortex.missing() or "-")]

# This law takes a power of a difference, and the last digits of newlib's pow are not those of glibc's: in double one
# number of one step in a hundred is beyond 4 units in the last place.
POWERS = ("a differentiator, explicit", "double")


@pytest.mark.parametrize(
    ("name", "to"),
    [
        (name, to)
        for number, name in enumerate(CASCADES)
        for to in ("float", "double")
        if (THOROUGH or (name not in REPEATED and to == ("double" if number % 5 == 1 else "float")))
        and (name, to) != POWERS
    ],
)
def test_the_test_vectors_pass_on_a_cortex_m(name, to, tmp_path):
    placed(tmp_path, text(cascade=CASCADES[name], to=to))
    code, said = cortex.run([tmp_path / "amb.c", tmp_path / "amb_test.c"], tmp_path)
    assert "100 of 100 steps agree with JAX, 0 failed checks" in said
    assert code == 0


def test_a_wrong_test_vector_fails_on_a_cortex_m(tmp_path):
    faulty = {x: y.replace(".output.i_ref = ", ".output.i_ref = 1.0f + ", 3) for x, y in text(to="float").items()}
    placed(tmp_path, faulty)
    code, said = cortex.run([tmp_path / "amb.c", tmp_path / "amb_test.c"], tmp_path)
    assert "97 of 100 steps" in said
    assert code == 1


def test_the_size_of_the_code_is_some_kilobytes(tmp_path):
    placed(tmp_path, text(to="float"))
    code, stack = cortex.size(tmp_path / "amb.c")
    assert code < 4096
    assert stack < 512
