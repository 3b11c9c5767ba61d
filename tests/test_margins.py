"""Margins at the reading and at the command against the poles of the changed loop (`margin_oracle`)."""

import dataclasses
import math
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from margin_oracle import Change, parts_of
from profiles import thorough
from structures import RIG

from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.compiler.short_compilation import QUICKEST, supported
from ambjax.control.force import linear_mechanics
from ambjax.control.linear_controller import LinearController
from ambjax.linear import LoopMargins, Margins, linearise, loop_quantities, margins_of
from ambjax.linear.state_space import PLACES
from ambjax.simulation.rollout import rollout

QUICK = supported(QUICKEST)  # each program runs once
# Each margin lies within this share of the margin of the oracle.
ERROR = 0.03
SMOOTH = {"inversion": {"gamma": 2e6, "p": 1e-3}, "current": {"k_i": 600.0, "p": 20.0}}
CURRENT = {"inversion": {"kind": "linearised"}, "current": {"kind": "dead-beat"}}
CASE = {"plant": RIG, "clock": {"duration": 0.1, "sample_period": 5e-5}, "processor": {}}


def on(position, observer=None, processor=None, actuator=None, **rest):
    """A case on the plant of the rig."""
    controller = {"position": position, **({"observer": observer} if observer else {}), **rest.pop("laws", CURRENT)}
    document = CASE | {"controller": controller, "processor": processor or {}, **rest}
    return case_from(document | ({"actuator": actuator} if actuator else {}), "loop")


def continuous(position, plant=RIG, **laws):
    return case_from({"plant": plant, "controller": {"position": position, **laws}}, "loop")


def of_template(**tables):
    raw = tomllib.loads(template("rig")) | tables
    return case_from({key: raw[key] for key in raw if key not in ("tune", "spread")}, "rig")


def lqg(delay=1.0):
    """A continuous LQG controller that demands a current; dead-beat control of the current at 50 kHz."""
    from scipy.linalg import solve_continuous_are
    from scipy.signal import StateSpace

    case = on({"kind": "pid"}, processor={"predict": False, "delay": delay})
    s, b = map(float, linear_mechanics(case.scenario.plant))
    A, B, C = np.array([[0, 1], [s, 0]]), np.array([[0], [b]]), np.array([[1, 0]])
    K = b / 0.5**-2 * solve_continuous_are(A, B, np.diag([1 / 50e-6**2, 0]), np.eye(1) / 0.5**2)[1:]
    L = solve_continuous_are(A.T, C.T, np.diag([0, 1e4]), 1e-12 * np.eye(1))[:, :1] / 1e-12
    law = LinearController.of(StateSpace(A - B @ K - L @ C, L, K, np.zeros((1, 1))))
    clock = dataclasses.replace(case.clock, sample_period=2e-5)
    return dataclasses.replace(case, cascade=dataclasses.replace(case.cascade, position=law), clock=clock)


def slow(delay):
    """A current amplifier whose loop is slow compared with the period."""
    clock = {"duration": 0.3, "sample_period": 1.2e-4}
    processor, actuator = {"delay": delay}, {"mode": "current", "bandwidth": 1500.0}
    laws, rest = {"inversion": {"kind": "linearised"}}, {"initial": {"z": 2e-5}, "clock": clock, **VELOCITY}
    return on({"kind": "state-feedback"}, {"kind": "kalman", "w": 1700.0}, processor, actuator, laws=laws, **rest)


VELOCITY = {"sensor": {"velocity": False}}
LOOPS = {
    "LQG, dead-beat": lqg,
    "cascade, true signs, low-pass": of_template,
    "cascade, continuous": lambda: continuous({"c": 200.0, "k": 63.0, "p": 5.0}, {}, **SMOOTH),
    "cascade, explicit": lambda: case_from(
        {"controller": {"position": {"c": 200.0, "k": 63.0, "p": 5.0}, **SMOOTH},
         "processor": {"discretisation": "explicit"}}, "loop"),
    "state feedback, continuous": lambda: continuous({"kind": "state-feedback"}, inversion={"kind": "linearised"},
                                                     current={"kind": "pi"}),
    "PID, dead-beat": lambda: on({"kind": "pid"}, {"kind": "kalman", "w": 3000.0},
                                 laws=CURRENT | {"inversion": {"kind": "closed-form"}}, **VELOCITY),
    "PID, pi, late": lambda: on({"kind": "pid"}, processor={"delay": 1.5, "predict": False},
                                actuator={"bandwidth": 4e3}, laws=CURRENT | {"current": {"kind": "pi"}}),
    "state feedback, dead-beat": lambda: on({"kind": "state-feedback"}),
    "state feedback, 3.4 samples late": lambda: slow(3.4),
    # with a delay at the command, it is unstable from 24 to 27 us, and again from 50 us on
    "super-twisting, 2.5 samples late": lambda: of_template(
        processor={"delay": 2.5, "predict": True},
        controller={"observer": {"kind": "kalman"}, "position": {"kind": "super-twisting"},
                    "inversion": {"kind": "adaptive"}, "current": {"kind": "dead-beat"}}),
}  # fmt: skip
# Loops whose parts the others have.
REPEATED = ("cascade, explicit", "cascade, continuous", "PID, dead-beat", "state feedback, dead-beat",
            "super-twisting, 2.5 samples late")  # fmt: skip
SEARCHED = ["LQG, dead-beat", thorough("PID, dead-beat"), "state feedback, continuous"]


def agrees(parts, margin, changed, most):
    """Whether the loop is stable up to the margin, and unstable above it. `changed`: the change for a size.

    `most`: size up to which a loop without a limit is examined.
    """
    below = all(parts.stable(changed(size)) for size in np.linspace(0.0, min((1 - ERROR) * margin, most), 25))
    return below and (margin > most or not parts.stable(changed((1 + ERROR) * margin)))


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.thorough if x in REPEATED else pytest.mark.slow) for x in LOOPS]
)
def test_the_margins_agree_with_the_poles_of_the_changed_loop(name):
    case = LOOPS[name]()
    system = linearise(case.cascade, case.scenario, case.clock)
    parts, found = parts_of(case.cascade, case.scenario, case.clock), margins_of(system)
    assert system.stable
    assert parts.stable(Change())
    for place in PLACES:
        one = getattr(found, place)
        assert 0 <= one.gm_low < 1 < one.gm_high
        for gain, sign in ((one.gm_low, -1), (one.gm_high, 1)):
            size = abs(math.log(gain)) if gain else math.inf
            assert agrees(parts, size, lambda x, at=place, sign=sign: Change(**{at: math.exp(sign * x)}), 6.0)
        turns = [lambda x, at=place, sign=sign: Change(**{at: np.exp(sign * 1j * x)}) for sign in (1, -1)]
        assert any(agrees(parts, math.radians(one.pm), turn, math.pi) for turn in turns)
        assert agrees(parts, one.delay, lambda x, at=place: Change(**{f"late_{at}": x}), 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("own", [0.5, 3.4])
def test_a_delay_margin_of_several_samples_is_that_of_the_simulation(own):
    case = slow(own)
    margin = margins_of(linearise(case.cascade, case.scenario, case.clock)).command.delay / 1.2e-4
    assert 4 < margin < 10 - own
    decay = []
    for share in (0.96, 1.04):
        late = dataclasses.replace(case.cascade.processor, delay=own + share * margin, assumed=own, predict=True)
        cascade = dataclasses.replace(case.cascade, processor=late)
        z = np.abs(np.asarray(rollout(cascade, case.scenario, case.clock).trajectory.rows.z))
        decay.append(z[-len(z) // 4 :].max() / z[len(z) // 4 : len(z) // 2].max())
    assert decay[0] < 0.5
    assert decay[1] > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHED)
def test_the_search_of_the_tuner_finds_the_delay_margin_of_the_analysis(name):
    """The derivative is compared with differences of the analysis, along a change of the gain of the drive.

    The second loop becomes unstable at half the sampling rate.
    """
    case = LOOPS[name]()
    system = linearise(case.cascade, case.scenario, case.clock)

    def changed(x):
        path = system.path._replace(b=(1 + x) * system.path.b)
        return jax.tree.map(jnp.asarray, system)._replace(path=path)

    # a large unit of the rate 1/delay: no margin is near the smooth limit of this rate
    find = jax.jit(jax.value_and_grad(lambda x: quantities(changed(x)).delay_margin_s), compiler_options=QUICK)
    value, slope = find(0.0)
    expected = margins_of(system)
    assert value == pytest.approx(expected.smaller.delay, rel=1e-6)
    assert expected.place("delay") == "command"
    # the solutions are found to 1e-9 of a sample, and the step's error is its square
    ends = [margins_of(jax.tree.map(np.asarray, changed(x))).command.delay for x in (1e-3, -1e-3)]
    assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-3)


def quantities(system):
    return loop_quantities(system, jnp.asarray(True), 1.0, 1e7, 1e9)


def test_the_smaller_margin_of_each_kind_is_that_of_the_loop():
    one = Margins(0.5, 0.5, 3.0, 40.0, 1e-3, 0.8)
    other = Margins(1.6, 0.2, 1.6, 50.0, 1e-5, 0.5)
    both = LoopMargins(one, other)
    assert both.smaller == Margins(1.6, 0.5, 1.6, 40.0, 1e-5, 0.5)
    assert [both.place(kind) for kind in ("gm", "pm", "delay", "dm")] == [
        "command", "reading", "command", "command",
    ]  # fmt: skip
    assert LoopMargins(one, one).place("delay") == "reading"
