"""The inputs, outputs and base classes of the laws of each stage.

A law is a frozen record: its type is the algorithm, its leaves are the gains. Every law has these methods, where
`model` is the nominal plant:

- `init(model)`: the state at t = 0; a law without a state returns ().
- `law(model, inputs, state)`: the output and the rate of the state.
- `scale(model)`: the characteristic size of each state; integration errors are relative to it.
- `slope(model)`: the largest slope of the law, 1/s; the step size is chosen from it.

`control.base.Law` has the optional methods with their defaults. To add a law: write a record in the file of its stage,
add a row to `KINDS` of the case-file reader, and add a row to the conformance test.
"""

import abc
from typing import Any, Generic, NamedTuple, TypeVar

import jax
from jax import Array

from ambjax.control.base import Law
from ambjax.numerics.records import Scalar
from ambjax.world.bearing import Gaps
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

# State of a law: any pytree of scalars; () if the law has none.
State = TypeVar("State")


class ForceDemand(NamedTuple):
    """Input of an inversion law: estimated position z (m), demanded scaled force v_star (A^2/m^2), and their rates.

    `z_rate` is the rate of the estimate z, which may differ from the estimated velocity. `gaps` are the model's gaps
    at z if they are already computed, else None.
    """

    z: Array
    z_rate: Array
    v_star: Array
    v_star_rate: Array
    gaps: Gaps | None = None


class CurrentDemand(NamedTuple):
    """Output of an inversion law: the reference current i_ref (A) and its rate i_ref_dot (A/s)."""

    i_ref: Array
    i_ref_dot: Array


class CurrentInputs(NamedTuple):
    """Input of a current law: the estimate, the demand, the limit of the supply (V), and the model's gaps or None."""

    measured: Measurement
    demand: CurrentDemand
    u_max: Scalar
    gaps: Gaps | None = None


class Relaxation(NamedTuple):
    """Output of `slide(model, begin, end, i_ref, h)` of an inversion law: its state i_ref over a step of h (s).

    `begin` and `end` are the ForceDemand at both ends of the step. i_ref moves at the rate `first` (A/s) up to the time
    `turn` (s), then at the rate `rest` (A/s). `v_tilde` (A^2/m^2): at the start, at `turn` and at the end.
    """

    first: Array
    rest: Array
    turn: Array
    v_tilde: tuple[Array, Array, Array]


class Observer(Law, Generic[State], abc.ABC):
    """Base class of an observer, which returns the estimated motion for a measurement."""

    @abc.abstractmethod
    def init(self, model: Plant, measured: Measurement) -> State: ...

    def started(self, z: Array) -> "Observer":
        """Return the observer with its estimate of the displacement starting at z (m); itself if no field sets it."""
        return self

    @abc.abstractmethod
    def scale(self, model: Plant) -> object: ...

    @abc.abstractmethod
    def slope(self, model: Plant) -> Scalar: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: Measurement, state: State, /) -> tuple[Measurement, State]: ...


class PositionLaw(Law, Generic[State], abc.ABC):
    """Base class of a position law, which returns the scaled force v_star (A^2/m^2) for an estimate and a reference."""

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    def begin(self, model: Plant, inputs: tuple[Measurement, Reference]) -> State:
        """Return the state at t = 0 in continuous time for the first estimate and reference; `init` by default."""
        return self.init(model)

    @abc.abstractmethod
    def scale(self, model: Plant) -> object: ...

    @abc.abstractmethod
    def slope(self, model: Plant) -> Scalar: ...

    @abc.abstractmethod
    def sigma(self, motion: Measurement, reference: Reference) -> Array: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: tuple[Measurement, Reference], state: State, /) -> tuple[Array, State]: ...


class InversionLaw(Law, Generic[State], abc.ABC):
    """Base class of an inversion law, which returns the demanded current for a demanded force."""

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    def started(self, i_ref: Array) -> "InversionLaw":
        """Return the law with its reference current starting at i_ref (A); the law itself if no field sets it."""
        return self

    @abc.abstractmethod
    def scale(self, model: Plant) -> object: ...

    @abc.abstractmethod
    def slope(self, model: Plant) -> Scalar: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: ForceDemand, state: State, /) -> tuple[CurrentDemand, State]: ...


class CurrentLaw(Law, Generic[State], abc.ABC):
    """Base class of a current law, which returns the voltage u (V) for a demanded current."""

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    @abc.abstractmethod
    def scale(self, model: Plant) -> object: ...

    @abc.abstractmethod
    def slope(self, model: Plant) -> Scalar: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: CurrentInputs, state: State, /) -> tuple[Array, State]: ...


# Base class of the laws of each stage, by the stage's name.
STAGES: dict[str, type[Law]] = {
    "observer": Observer,
    "position": PositionLaw,
    "inversion": InversionLaw,
    "current": CurrentLaw,
}


def stepped(
    law: Law, inputs: object, state: State, *, model: Plant, period: Scalar, implicit: bool
) -> tuple[Any, State]:
    """Return the output of a law at a sample and its next state, by its own `step` or else by explicit Euler."""
    with jax.named_scope(f"law:{type(law).__module__.rpartition('.')[2]}.{type(law).__qualname__}"):
        if law.has_own_step(implicit):
            own: Any = law
            return own.step(model, inputs, state, period)
        function: Any = law
        output, rate = function(model, inputs, state)
        return output, jax.tree.map(lambda x, d: x + period * d, state, rate)
