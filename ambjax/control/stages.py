"""The inputs, outputs and base classes of the laws of each stage.

A law is a frozen record: its type is the algorithm, its leaves are the gains. Every law has these methods, where
`model` is the nominal plant:

- `init(model)`, for an observer `init(model, measured)`: the state at t = 0; () for a law without a state.
- `law(model, inputs, state)`: the output, and the rate of the state.
- `scale(model)`: the characteristic size of each component of the state; integration errors are relative to it.
- `slope(model)`: the fastest rate of the law in closed loop (slope), 1/s; the step size is chosen from it.
- `sigma(motion, reference)`, for a position law: the sliding variable of a motion, m/s.

`control.base.Law` defines the other methods, with defaults: `step` is the law on a processor. To add a law, write a
record in the file of its stage, and add it to `KINDS` in `ambjax/cases/controller_tables.py` and to the conformance
test in `tests/test_laws.py`.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, Generic, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.base import Law
from ambjax.numerics.records import Scalar
from ambjax.world.magnet import Gaps
from ambjax.world.plant import Plant
from ambjax.world.plant import State as NominalState
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# State of a law: any pytree of scalars; () if the law has none.
State = TypeVar("State")
# Input of a position law: the estimated motion and current, and the reference.
PositionInputs: TypeAlias = tuple[Measurement, Reference]


class ForceDemand(NamedTuple):
    """Input of an inversion law.

    - `z`: estimated position, m.
    - `z_rate`: rate of `z`, m/s; it may differ from the estimated velocity.
    - `v_star`: demanded scaled force, A^2/m^2.
    - `v_star_rate`: rate of `v_star`, A^2/m^2/s.
    - `gaps`: gaps of the model at `z`; None: not computed yet.
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
    """Input of a current law.

    - `measured`: estimated motion and current.
    - `demand`: output of the inversion law.
    - `u_max`: limit of the command: that of the supply, V, or that of the commanded current, A.
    - `gaps`: gaps of the model at the estimated position; None: not computed yet.
    """

    measured: Measurement
    demand: CurrentDemand
    u_max: Scalar
    gaps: Gaps | None = None


class Relaxation(NamedTuple):
    """Output of the method `slide(model, begin, end, i_ref, h)` of an inversion law: i_ref over a step of h (s).

    `begin` and `end` are the ForceDemand at both ends of the step, `i_ref` (A) is the state of the law at its start.

    - `first`, `rest`: rates of i_ref (A/s) before and after the time `turn`.
    - `turn`: time from the start of the step, s.
    - `v_tilde`: inversion error (A^2/m^2) at the start, at `turn` and at the end.
    """

    first: Array
    rest: Array
    turn: Array
    v_tilde: tuple[Array, Array, Array]


class Stateless(Law):
    """A law without a state: a second base class, before that of the stage."""

    def init(self, model: Plant, measured: Measurement | None = None) -> tuple[()]:
        return ()

    def scale(self, model: Plant) -> tuple[()]:
        return ()


class OneIntegral(Law):
    """A law whose state is one integral that starts at 0: a second base class, before that of the stage."""

    def init(self, model: Plant) -> Array:
        return jnp.zeros(())


def no_slope(self: Law, model: Plant) -> Scalar:
    """Return `slope` of a law that passes its input on: 0."""
    return 0.0


def unwinding(k_aw: Scalar, k_int: Scalar) -> Array:
    """Return the anti-windup rate k_aw (1/s) of an integral with the gain k_int, or 0 without an integral."""
    return jnp.where(jnp.asarray(k_int) > 0, k_aw, 0.0)


class Observer(Law, Generic[State]):
    """Base class of an observer: its input is the measurement, its output the estimated motion and current."""

    @abc.abstractmethod
    def init(self, model: Plant, measured: Measurement) -> State: ...

    def started(self, z: Array) -> "Observer":
        """Return the observer with z (m) as its initial estimate of the position; itself if no field sets it."""
        return self

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: Measurement, state: State, /) -> tuple[Measurement, State]: ...


class PositionLaw(Law, Generic[State]):
    """Base class of a position law: its input is (estimate, reference), its output the scaled force v_star, A^2/m^2."""

    @property
    def demand(self) -> str:
        """The demanded quantity: "force" or "voltage".

        With "voltage", v_star is the linearised force of the current u/R for the demanded voltage u.
        `inversion.Linearised` and `current.OpenLoop` compute u from it.
        """
        return "force"

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    def begin(self, model: Plant, inputs: PositionInputs) -> State:
        """Return the state at t = 0 in continuous time, from the first estimate and reference; by default `init`.

        Filters start in the steady state for this estimate, so that the first command is not that of a jump from 0.
        """
        return self.init(model)

    def begin_sampled(self, model: Plant, inputs: PositionInputs, period: Scalar) -> object:
        """Return the state before the first call of `step`, from the estimate and the reference of this sample."""
        return self.init_sampled(model) if self._has_sampled_state() else self.begin(model, inputs)

    def first_state(self, model: Plant, inputs: PositionInputs, period: Scalar | None, implicit: bool) -> Any:
        """Return the state before the first step on a processor; without a period, that at t = 0 in continuous time."""
        if period is not None and (self.has_own_step(implicit) or self._has_sampled_state()):
            return self.begin_sampled(model, inputs, period)
        return self.begin(model, inputs)

    def _has_sampled_state(self) -> bool:
        """Return whether the state on a processor may differ from that in continuous time."""
        return type(self).init_sampled is not Law.init_sampled

    @abc.abstractmethod
    def sigma(self, motion: Measurement, reference: Reference) -> Array: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: PositionInputs, state: State, /) -> tuple[Array, State]: ...


class InversionLaw(Law, Generic[State]):
    """Base class of an inversion law: its input is the demanded force, its output the demanded current.

    `accepts`: the demands of a position law (`PositionLaw.demand`) with which the law can be combined. `singular`:
    whether the law solves v(z, i_ref) = v_star, or divides by dv/di, so that i_ref must not reach the curve C, Eq. (9).
    """

    accepts: ClassVar[tuple[str, ...]] = ("force",)
    singular: ClassVar[bool] = True

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    def started(self, i_ref: Array) -> "InversionLaw":
        """Return the law with i_ref (A) as its initial current reference; the law itself if no field sets it."""
        return self

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: ForceDemand, state: State, /) -> tuple[CurrentDemand, State]: ...


class CurrentLaw(Law, Generic[State]):
    """Base class of a current law: its input is the demanded current, its output the command u.

    `accepts`: the demands of a position law (`PositionLaw.demand`) with which the law can be combined. `commands`: what
    u is: a "voltage" (V), or a "current" (A) for an amplifier that controls the current.
    """

    accepts: ClassVar[tuple[str, ...]] = ("force",)
    commands: ClassVar[str] = "voltage"

    @abc.abstractmethod
    def init(self, model: Plant) -> State: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: CurrentInputs, state: State, /) -> tuple[Array, State]: ...

    def driven(self, model: Plant, u: Array, state: NominalState) -> NominalState:
        """Return the rates of the nominal plant under the command u, for predictions."""
        return model.rates(state, u)


# Base class of the laws of each stage, by the stage's name.
STAGES: dict[str, type[Law]] = {
    "observer": Observer,
    "position": PositionLaw,
    "inversion": InversionLaw,
    "current": CurrentLaw,
}


def step_law(
    law: Law, inputs: object, state: State, *, model: Plant, period: Scalar | None, implicit: bool
) -> tuple[Any, State]:
    """Return the output of a law at a sample, by `step` or else by explicit Euler, and its next state.

    Without a period (in continuous time), it is the output now and the rate of the state.
    """
    if period is None:
        return law(model, inputs, state)
    with jax.named_scope(f"law:{type(law).__module__.rpartition('.')[2]}.{type(law).__qualname__}"):
        if law.has_own_step(implicit):
            return law.step(model, inputs, state, period)
        return Law.step(law, model, inputs, state, period)


def rates_along(
    law: Callable[..., tuple[Array, State]],
    estimate: Measurement,
    z_ddot: Array,
    reference: Reference,
    state: State,
    rate: State,
) -> tuple[Array, Array]:
    """Return the rates of z (m/s) and v_star (A^2/m^2/s) if the estimate moves with its own z_dot and with `z_ddot`."""

    def v_star(reference: Reference, z: Array, z_dot: Array, state: State) -> Array:
        return law(Measurement(z, z_dot, estimate.i), reference, state)[0]

    point = (reference, estimate.z, estimate.z_dot, state)
    return estimate.z_dot, jax.jvp(v_star, point, (reference.rate(), estimate.z_dot, z_ddot, rate))[1]
