"""Custom laws of a machine: of one axis, and of all axes."""

import pathlib

import numpy as np
import pytest
from machine_cases import LEFT, MACHINES, RIGHT, SHORT
from test_own_laws import LAW

from ambjax.cases.machine_case import machine_from
from ambjax.linear.linear_machine import machine_sensitivity
from ambjax.results.runs import simulate_machine

# The law of one axis is that of tests/test_own_laws.py.
IMPORTS = "from ambjax.extend import MachineLaw, PositionLaw, demand_of, force_for, gain, leaf, record"
LAWS = (
    f"{IMPORTS}\n{LAW}"
    + """

@record
class Whole(MachineLaw):
    spring: float = gain(default=1e4, unit="1/s^2", doc="proportional gain")
    damp: float = gain(default=400.0, unit="1/s", doc="derivative gain")
    mass: object = leaf(default=None, shape="c", unit="kg", at_least=0, at_most=1e6, optional=True, doc="of the axes")

    def designed(self, rotor):
        B = rotor.at_magnets
        return type(self)(self.spring, self.damp, 1 / jnp.sum(B * jnp.linalg.solve(rotor.M, B.T).T, 1))

    def scale(self):
        return jnp.ones_like(self.mass)

    def begin(self, measured, inputs):
        return 0.0 * measured.z

    def __call__(self, measured, state, inputs):
        wanted = -self.spring * measured.z - self.damp * measured.z_dot - state
        return demand_of(inputs.scaled(self.mass * wanted), measured), 10 * self.spring * measured.z
"""
)
INNER = {"inversion": {"kind": "closed-form"}, "current": {"kind": "pi"}}
MACHINE = MACHINES["rigid"] | {
    "rotor": SHORT | {"speed": 6000.0},
    "bearing": [LEFT | {"sensor_at": -0.24}, RIGHT | {"plant": {"A": 3e-4}}],
    "processor": {"delay": 1.0, "predict": False},
}


@pytest.fixture
def read(tmp_path):
    """A function that reads the machine with a [controller] table, beside the file of the laws."""
    (tmp_path / "mine.py").write_text(LAWS)
    return lambda controller: machine_from(MACHINE | {"controller": controller | INNER}, folder=pathlib.Path(tmp_path))


@pytest.mark.slow
def test_a_law_of_the_machine_that_treats_every_axis_alike_equals_that_law_on_each_axis(read):
    each = read({"position": {"kind": "mine.py:PD", "spring": 3e4, "damp": 300.0}})
    whole = read({"kind": "mine.py:Whole", "spring": 3e4, "damp": 300.0})
    assert [law.law.__name__ for case in (each, whole) for law in case.own_laws] == ["PD", "Whole"]
    signals = [simulate_machine(case).signals for case in (each, whole)]
    assert np.ptp(signals[0]["z"][:, 0]) > 1e-5
    np.testing.assert_allclose(signals[1]["z"], signals[0]["z"], rtol=0, atol=1e-14)
    loops = [machine_sensitivity(x.machine, x.axes, x.clock.sample_period, 6000.0, x.zones) for x in (each, whole)]
    assert loops[0].stable
    assert loops[1].sigma.height == pytest.approx(loops[0].sigma.height, rel=1e-6)


@pytest.mark.parametrize(
    ("controller", "said"),
    [
        ({"kind": "mine.py:PD"}, r"controller\.kind = .*derive it from ambjax\.extend\.MachineLaw"),
        ({"kind": "mine.py:Whole", "dmap": 1.0}, r"controller\.dmap = 1.*Did you mean 'damp'"),
        ({"kind": "mine.py:Whole", "mass": "x"}, r"controller\.mass"),
        ({"kind": "mine.py:Wrong"}, r"Wrong raised TypeError: .*scale\(\) must be like the state"),
    ],
)
def test_a_wrong_law_is_refused_in_one_line(read, tmp_path, controller, said):
    wrong = "\n\n@record\nclass Wrong(Whole):\n    def scale(self):\n        return 1e-6\n"
    (tmp_path / "mine.py").write_text(LAWS + wrong)
    with pytest.raises(ValueError, match=said) as refused:
        read(controller)
    assert "\n" not in str(refused.value)
