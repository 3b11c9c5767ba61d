"""The first sample: filters start in the steady state of the first reading, so no command contains a jump from 0."""

import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from ambjax import Cascade, Processor, Scenario
from ambjax.cases.controller_tables import KINDS
from ambjax.control.base import default_law
from ambjax.control.cascade_state import Sample
from ambjax.control.realisation import realisation
from ambjax.control.sampling import Sampling
from ambjax.control.stages import CurrentDemand, CurrentInputs, CurrentLaw, step_law
from ambjax.laws import current, inversion, observer, position
from ambjax.plants import Plant
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.world.scenario import Initial
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Constant, Reference

RIG = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0)
T, Z = 5e-5, 4e-5
STILL = Reference(0.0, 0.0, 0.0, 0.0)
# lead with a pole at -5e3, a notch-like pair, and an integrator: the steady state of the first three is started
NOTCHED = realisation(
    *scipy.signal.zpk2ss([-200.0, -900 + 4e3j, -900 - 4e3j, -20.0], [-5e3, -4e3 + 3e3j, -4e3 - 3e3j, 0.0], 2e4)
)
FILTERED = dataclasses.replace(
    default_law(position.FilterChain, RIG, Sampling(T, 0.0, True)), w_z=900.0, w_p=9e3, w_1=5650.0, width_1=0.3,
    depth_1=0.1, w_2=2e4, depth_2=0.3, w_lp=20 * float(RIG.pole),
)  # fmt: skip
POSITIONS = {
    **{name: default_law(kind, RIG, Sampling(T, 0.0, True)) for name, kind in KINDS["position"].items()},
    "filtered chain": FILTERED,
    "linear": position.LinearController(realisation=NOTCHED),
}
OBSERVERS = {name: default_law(kind, RIG) for name, kind in KINDS["observer"].items()}


def at_rest(law, z, i):
    """The stationary value of v_star: that of the law for a rotor which has been at z for a long time, by definition.

    The law runs in continuous time with its integral part removed, until its filters have settled.
    """
    inputs = Measurement(jnp.asarray(z), jnp.zeros(()), jnp.asarray(i)), STILL
    without = {name: np.asarray(1e-300) for name in ("k_int", "k_aw") if hasattr(law, name)}
    law = dataclasses.replace(law, **without)
    if isinstance(law, position.LinearController):
        A, B, C, D = (np.array(getattr(law.realisation, name)) for name in "ABCD")
        # the response at 1e-2 of the slowest filter, without the integrator: in partial fractions
        poles, vectors = np.linalg.eig(A)
        residues = (C @ vectors) * np.linalg.solve(vectors, B[:, 0])
        gain = (D[0] - sum(r / p for r, p in zip(residues, poles, strict=True) if abs(p) > 1)).real
        return float(law._force(RIG, z, -gain * z))
    x, state = jax.flatten_util.ravel_pytree(law.begin(RIG, inputs))
    if not x.size:
        return float(law(RIG, inputs, ())[0])

    def rates(x):
        return jax.flatten_util.ravel_pytree(law(RIG, inputs, state(x))[1])[0]

    # from zero, by the exact solution of the linear filters; a state that no filter moves stays
    A, b = np.asarray(jax.jacfwd(rates)(0 * x)), np.asarray(rates(0 * x))
    settled = scipy.linalg.expm(np.block([[A, b[:, None]], [np.zeros((1, len(b) + 1))]]) * 1.0)[:-1, -1]
    return float(law(RIG, inputs, state(jnp.asarray(settled)))[0])


# laws without a filter have their command at once; Utkin's starts on its manifold, which is its definition
LINEAR = ("pid", "feedback-linearisation", "state-feedback", "chain", "filtered chain", "linear")


@pytest.mark.parametrize("sampled", ["", "implicit", "explicit"])
@pytest.mark.parametrize("name", LINEAR)
def test_the_first_command_from_rest_is_that_of_the_static_law(name, sampled):
    law, i = POSITIONS[name], float(RIG.equilibrium(Z)[0])
    scenario = Scenario(plant=RIG, initial=Initial(Z, 0.0, i), reference=Constant(0.0))
    cascade = Cascade(position=law, inversion=inversion.ClosedForm(), current=current.ProportionalIntegral(), model=RIG)
    wanted = at_rest(law, Z, i)
    if sampled:
        processor = Processor(delay=0.0, implicit=sampled == "implicit", guard=None)
        cascade = dataclasses.replace(cascade, processor=processor).on_processor()
        system = Sampled(ClosedLoop(cascade, scenario), T, 0).realised()
        state = system.start()
        found = system.jump(0.0, state, system.sensor_errors(0)).command.v_star
    else:
        loop = ClosedLoop(cascade, scenario).realised()
        found = loop.command(loop.inputs(0.0), loop.start(), loop.sensor_errors(0))[0].v_star
    # the bilinear transform of an integral contains half a step of it, k_int T/2 beside k_p: 0.2 % of the stiffness
    assert float(found) == pytest.approx(wanted, rel=5e-3 if sampled else 1e-9)


@pytest.mark.parametrize(
    ("name", "watch"),
    [*((name, "kalman") for name in POSITIONS), *(("state-feedback", name) for name in OBSERVERS if name != "kalman")],
)
def test_a_constant_reading_gives_a_constant_command(name, watch):
    """At the equilibrium, with the error 0: no state of an observer, filter or law changes from the first sample on."""
    cascade = Cascade(
        OBSERVERS[watch], POSITIONS[name], inversion.ClosedForm(), current.DeadBeat(), RIG, Processor(delay=1.0)
    ).on_processor()
    i, u = (float(x) for x in RIG.equilibrium(Z))
    measured, sample = Measurement(Z, 0.0, i), Sample(Reference(Z, 0.0, 0.0, 0.0), T, np.inf, (u, u))
    measured = jax.tree.map(jnp.asarray, measured)
    # the integral of state feedback and chain carries the difference between the linearised and the true equilibrium
    laws = cascade.begun(measured, sample, cascade.init(measured), jnp.asarray(False))
    commands = []
    for _ in range(4):
        command, laws, _ = cascade.step(measured, laws, sample)
        commands.append(float(command.i_ref + T * command.i_ref_dot))
    # anti-windup and integrals move slowly: 1e-3 of the bias in a sample
    np.testing.assert_allclose(np.diff(commands), 0, atol=1e-3 * RIG.i_0)


@pytest.mark.parametrize("name", ["filtered chain", "pid", "linear"])
def test_a_start_at_rest_on_the_reference_and_at_an_error_differ_by_the_static_gain_only(name):
    """The largest demanded current in the first samples is that at the first, not a multiple of it."""
    law = POSITIONS[name]
    cascade = Cascade(
        observer.Direct(), law, inversion.Linearised(), current.ProportionalIntegral(), RIG, Processor(delay=0.0)
    ).on_processor()
    measured = jax.tree.map(jnp.asarray, Measurement(Z, 0.0, float(RIG.equilibrium(Z)[0])))
    sample = Sample(STILL, T, np.inf, (0.0, 0.0))
    laws = cascade.begun(measured, sample, cascade.init(measured), jnp.asarray(False))
    i_ref = []
    for _ in range(20):
        command, laws, _ = cascade.step(measured, laws, sample)
        i_ref.append(float(command.i_ref + T * command.i_ref_dot))
    assert np.max(np.abs(np.array(i_ref) - i_ref[0])) < 0.1 * abs(i_ref[0])


WOUND = [kind for stage in ("position", "current") for kind in KINDS[stage].values() if hasattr(kind(), "k_aw")]


@pytest.mark.parametrize("kind", WOUND, ids=lambda kind: kind.__name__)
def test_an_anti_windup_charges_no_law_without_integral_action(kind):
    """The current lags behind its demand and the supply limits u, as at the start; only k_int moves the integral."""
    motion, error = Measurement(Z, 0.01, 0.3), Reference(-Z, 0.0, 0.0)
    inputs = (motion, error)
    if issubclass(kind, CurrentLaw):
        inputs = CurrentInputs(motion, CurrentDemand(jnp.asarray(1.0), jnp.asarray(0.0)), 0.1)
    for k_int in (0.0, 1.0):
        law = dataclasses.replace(default_law(kind, RIG), k_int=np.asarray(k_int))  # an array is not checked
        state = law.init(RIG)
        after = step_law(law, inputs, state, model=RIG, period=T, implicit=True)[1]
        rate = law(RIG, inputs, state)[1]
        found = [getattr(x, "integral", x) for x in (after, rate)]
        assert [bool(x != 0) for x in found] == [k_int > 0] * 2
