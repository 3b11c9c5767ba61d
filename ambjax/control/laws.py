"""What a law is: the inputs, the output and the protocol of each stage.

A law is a frozen record: its type is the algorithm, its leaves are the gains. `init` gives its
state at t = 0 and a call gives (output, state_rate); a law without state uses (). `scale` gives,
for each state, the size that still matters (an integrator's error is measured against it), and
`slope` the steepest rate of the law in 1/s, from which a step is chosen. A law with a smoothed sign
tells by `size` what the sign's argument amounts to on a plant: sigma = w s_0 (w the magnets' pole), v = i_0^2/s_0^2,
i = i_0. Its default p is that of Table 1 for that plant and goes with 1/size for others. `model` is the nominal
plant: what the controller believes. To add a law: one record in the file of its stage, one row in
`KINDS` of the case-file reader, one row in the conformance test.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, TypeVar

from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.world.bearing import Gaps
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

State = Any
L = TypeVar("L")


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


def default_law(kind: type[L], model: Plant) -> L:
    """The law of this kind with its default gains and, where it has a smoothed sign, the p that suits the model.

    A sign is soft or hard against what its argument amounts to: p = 25 m^2/A^2 is soft where v is 2500 A^2/m^2, as in
    Table 1, and a hard sign where it is 1e7.
    """
    law: Any = kind()
    if not hasattr(law, "size"):
        return law
    return dataclasses.replace(law, p=law.p * (law.size(Plant()) / law.size(model)))
