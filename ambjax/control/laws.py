"""What a law is: the inputs, the output and the protocol of each stage.

A law is a frozen record: its type is the algorithm, its leaves are the gains. `init` gives its
state at t = 0 and a call gives (output, state_rate); a law without state uses (). `scale` gives,
for each state, the size that still matters (an integrator's error is measured against it), and
`slope` the steepest rate of the law in 1/s, from which a step is chosen. `model` is the nominal
plant: what the controller believes. A law may answer more: `control.answers` lists what. To add a law: one record
in the file of its stage, one row in `KINDS` of the case-file reader, one row in the conformance test.
"""

from typing import Any, NamedTuple, Protocol

import jax
from jax import Array

from ambjax.control import answers
from ambjax.numerics.records import Scalar
from ambjax.world.bearing import Gaps
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

State = Any


class ForceDemand(NamedTuple):
    """Input of an inversion law: where the rotor is (m) and the force wanted there (A^2/m^2), with their rates.

    `z_rate` is the rate of the estimate z itself, which an observer may let differ from the velocity. `gaps` are
    the model's at z, shared between laws where they are known: None asks a law to compute them.
    """

    z: Array
    z_rate: Array
    v_star: Array
    v_star_rate: Array
    gaps: Gaps | None = None


class CurrentDemand(NamedTuple):
    """Output of an inversion law: the current wanted, in A, and its rate, in A/s."""

    i_ref: Array
    i_ref_dot: Array


class CurrentInputs(NamedTuple):
    """Input of a current law: the measurement, the demand, the supply's limit in V, and the model's gaps, if known."""

    measured: Measurement
    demand: CurrentDemand
    u_max: Scalar
    gaps: Gaps | None = None


class Relaxation(NamedTuple):
    """Output of an inversion law's `slide(model, begin, end, i_ref, h)`: its one state, i_ref, over a step of h s.

    Two constant rates, A/s, of which the first ends after `turn`, s; and v_tilde, A^2/m^2, at the start, then and at
    the end. `begin`, `end`: the ForceDemand at both ends of the step.
    """

    first: Array
    rest: Array
    turn: Array
    v_tilde: tuple[Array, Array, Array]


class Observer(Protocol):
    """Measurement in, estimate out."""

    def init(self, model: Plant, measured: Measurement) -> State: ...
    def scale(self, model: Plant) -> State: ...
    def slope(self, model: Plant) -> Scalar: ...
    def __call__(self, model: Plant, inputs: Measurement, state: State, /) -> tuple[Measurement, State]: ...


class PositionLaw(Protocol):
    """Estimate and reference in, scaled force v_star (A^2/m^2) out."""

    def init(self, model: Plant) -> State: ...
    def scale(self, model: Plant) -> State: ...
    def slope(self, model: Plant) -> Scalar: ...
    def sigma(self, motion: Measurement, reference: Reference) -> Array: ...
    def __call__(self, model: Plant, inputs: tuple[Measurement, Reference], state: State, /) -> tuple[Array, State]: ...


class InversionLaw(Protocol):
    """Force demand in, current demand out."""

    def init(self, model: Plant) -> State: ...
    def scale(self, model: Plant) -> State: ...
    def slope(self, model: Plant) -> Scalar: ...
    def __call__(self, model: Plant, inputs: ForceDemand, state: State, /) -> tuple[CurrentDemand, State]: ...


class CurrentLaw(Protocol):
    """Current demand in, voltage u (V) out."""

    def init(self, model: Plant) -> State: ...
    def scale(self, model: Plant) -> State: ...
    def slope(self, model: Plant) -> Scalar: ...
    def __call__(self, model: Plant, inputs: CurrentInputs, state: State, /) -> tuple[Array, State]: ...


def stepped(law: Any, inputs: Any, state: State, *, model: Plant, period: Scalar, implicit: bool) -> tuple[Any, State]:
    """Output of a law at a sample, and its state at the next: by its own discrete `step`, else by explicit Euler."""
    with jax.named_scope(f"law:{type(law).__module__.rpartition('.')[2]}.{type(law).__qualname__}"):
        if answers.has_own_step(law, implicit):
            return law.step(model, inputs, state, period)
        output, rate = law(model, inputs, state)
        return output, jax.tree.map(lambda x, d: x + period * d, state, rate)
