"""The base class of all laws, with default methods, so that callers do not depend on the type of a law.

The classes of `control.stages` add the inputs and outputs of each stage.
"""

import abc
import dataclasses
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.sampling import Relay, Sampling
from ambjax.control.search import Interval, SearchContext
from ambjax.numerics.records import GainFunction, Scalar, is_traced
from ambjax.numerics.smooth import smooth_sign
from ambjax.world.plant import Plant

L = TypeVar("L", bound="Law")


class Requirement(NamedTuple):
    """Condition of Theorem 1 on a law: the gain named `gain` exceeds the bound named `over` (Q_z, Q_i or Delta_1)."""

    gain: str
    over: str


class Law(abc.ABC):
    """Base class of a law; it has no fields. A subclass is a frozen record whose leaves are the gains.

    Raises TypeError for a subclass with a gain that has the name of an attribute or a method of its base classes.

    Class attributes:

    - `requirement`: condition of Theorem 1 on a gain; None: there is none.
    - `estimates_velocity`: whether the law is an observer that does not use the measured velocity.
    - `memory`: name, unit and meaning of each leaf of the state on a processor; None: the names are derived from the
      structure of the state.
    - `own_steps`: the discretisations, "implicit" or "explicit", for which a processor calls the method `step`. With
      the others, the processor makes an explicit Euler step. The default is ("implicit",) for a class that defines
      `step`.
    - `analytic`: whether output and rates are analytic functions of inputs and state, without corners and roots, where
      |state| is not larger than usual. Few steps per sample are then accurate under noise.
    - `stiff`: whether a smoothed sign keeps a state of the law inside its boundary layer, so that this state changes
      fast; True for a class that defines `layer`.
    - `switching`: names of the gains that multiply smoothed signs and that `designed` chooses together with the
      steepnesses. If a case gives one of them, the default steepnesses are those of `scaled_steepness`.
    - `printed`: whether the written defaults are the gains of the paper, for the plant of Table 1.
    - `slides`: whether an inversion law has the method `slide`, which integrates across the boundary layer
      (`laws.Relaxation`); True for a class that defines it.
    """

    if TYPE_CHECKING:  # every law is a record; an observer's `init` has one argument more
        __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

        def init(self, *args: Any, **kwargs: Any) -> Any: ...

    requirement: ClassVar[Requirement | None] = None
    estimates_velocity: ClassVar[bool] = False
    memory: ClassVar[tuple[tuple[str, str, str], ...] | None] = None
    own_steps: ClassVar[tuple[str, ...]] = ()
    analytic: ClassVar[bool] = False
    stiff: ClassVar[bool] = False
    switching: ClassVar[tuple[str, ...]] = ()
    printed: ClassVar[bool] = False
    slides: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        written = vars(cls)
        bases = [base for base in cls.__mro__[1:] if not dataclasses.is_dataclass(base)]
        for name in (name for name, value in written.items() if isinstance(value, dataclasses.Field)):
            if any(name in vars(base) for base in bases):
                raise TypeError(f"{cls.__name__}.{name}: a law has an attribute of this name. Choose another name.")
        if "step" in written and "own_steps" not in written:
            cls.own_steps = ("implicit",)
        if "__call__" in written and "analytic" not in written:
            cls.analytic = False  # the property of an overridden law says nothing about this one
        cls.stiff, cls.slides = cls.stiff or "layer" in written, cls.slides or "slide" in written

    @abc.abstractmethod
    def scale(self, model: Plant) -> object: ...

    @abc.abstractmethod
    def slope(self, model: Plant) -> Scalar: ...

    @abc.abstractmethod
    def __call__(self, model: Plant, inputs: Any, state: Any, /) -> tuple[Any, Any]: ...

    def size(self, model: Plant) -> Scalar | None:
        """Return the characteristic size of the argument of the law's smoothed sign; None without a sign."""
        return None

    def layer(self, model: Plant) -> object:
        """Return, for each state, the largest integration error that keeps it in the layer of its sign, or inf."""
        return jax.tree.map(lambda _: jnp.inf, self.scale(model))

    def robust(self, error: Array, /) -> Array:
        """Return the term that the sign adds to the rate of the stage's error: -k sgn(sigma) in Eq. (12), for example.

        `error`: sigma (m/s), v_tilde (A^2/m^2) or e (A). By default it is the sign of `relay`, or 0 without one.
        """
        relay = self.relay()
        return 0.0 * error if relay is None else -relay.gain * smooth_sign(error, relay.steepness)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        """Return the range of the initial values of each gain in the tuner's search, by the name of the gain."""
        return {}

    def relay(self) -> Relay | None:
        """Return the sign of the law if the rate of the stage's error is one sign plus a disturbance; else None."""
        return None

    def step(self, model: Plant, inputs: Any, state: Any, period: Scalar) -> tuple[Any, Any]:
        """Return the output at a sample and the state at the next one, for a law on a processor.

        `inputs`, `state`: as `__call__` takes them. `period`: sample period, s. The default is a step of explicit
        Euler, state + period * rate. Define it to compute the law differently, for example with the sign at the end of
        the sample; `own_steps` says for which processors.
        """
        output, rate = self(model, inputs, state)
        return output, jax.tree.map(lambda x, d: x + period * d, state, rate)

    def init_sampled(self, model: Plant) -> object:
        """Return the state at t = 0 on a processor. For an observer, `init` is called instead."""
        return self.init(model)

    def scale_sampled(self, model: Plant) -> object:
        return self.scale(model)

    def designed(self: L, model: Plant, sampling: Sampling | None) -> L:
        """Return the law with default gains designed for `model`.

        The default implementation scales the steepnesses (`scaled_steepness`). `sampling`: None in continuous time; on
        a processor, the parameters of the model are concrete numbers.
        """
        return scaled_steepness(self, model)

    def idle_gains(self, implicit: bool | None) -> tuple[str, ...]:
        """Return the names of gains that have no effect.

        `implicit`: whether the processor uses implicit steps; None: continuous time.
        """
        return ()

    def check_use(self, model: Plant, period: float | None) -> None:
        """Raise ValueError if the law cannot run with this nominal model, or at this sample period of a processor (s).

        `period` is None in continuous time.
        """
        return

    def in_continuous_time(self: L) -> L:
        """Return the law for a run in continuous time of a cascade that has a processor; by default the law itself."""
        return self

    def has_own_step(self, implicit: bool) -> bool:
        """Return whether a processor with implicit (or explicit) steps calls the method `step` of this law."""
        return ("implicit" if implicit else "explicit") in self.own_steps


def default_law(
    kind: type[L], model: Plant, sampling: Sampling | None = None, given: Collection[str] = (), printed: bool = True
) -> L:
    """Return the law of type `kind` with its default gains for `model`.

    They are those of `Law.designed`, but the written defaults for a law of the paper (`Law.printed`) and the plant of
    Table 1 if `printed`.

    `sampling`: None in continuous time. `given`: names of the gains that the caller replaces; with one of
    `Law.switching` among them, the steepnesses are those of `scaled_steepness`.
    """
    if printed and kind.printed and is_table_1(model):
        return kind()
    law = kind().designed(model, sampling)
    if set(kind.switching).isdisjoint(given):
        return law
    scaled = scaled_steepness(kind(), model)
    return dataclasses.replace(law, **{name: getattr(scaled, name) for name in steepnesses(law)})


def is_table_1(model: Plant) -> bool:
    """Return whether the model is the plant of Table 1, for which the paper prints gains."""
    (found, one), (wanted, other) = jax.tree.flatten(model), jax.tree.flatten(Plant())
    return one == other and all(
        not is_traced(x) and bool(np.all(np.asarray(x) == y)) for x, y in zip(found, wanted, strict=True)
    )


def scaled_steepness(law: L, model: Plant) -> L:
    """Return the law with each steepness scaled from the plant of Table 1 to `model`.

    A steepness p is divided by the ratio of the sizes of the sign's argument, so that the boundary layer 1/p is the
    same share of this size for every plant. The size of v for Table 1, for example, is 2500 A^2/m^2; with
    p = 25 m^2/A^2 the boundary layer of v_tilde is 1.6e-5 of it.
    """
    size, usual = law.size(model), law.size(Plant())
    if size is None or usual is None:
        return law
    return dataclasses.replace(law, **{name: getattr(law, name) * (usual / size) for name in steepnesses(law)})


def steepnesses(law: Law) -> list[str]:
    """Return the names of the steepnesses of the signs of a law."""
    return [field.name for field in dataclasses.fields(law) if field.metadata.get("steepness")]


def memory_of(law: Law, state: object) -> list[tuple[str, str, str]]:
    """Return name, unit and meaning of each leaf of a law's state."""
    if law.memory is not None:
        return list(law.memory)
    leaves = jax.tree_util.tree_leaves_with_path(state)
    paths = [jax.tree_util.keystr(path, simple=True, separator="_") for path, _ in leaves]
    return [(f"x_{path}" if path.isdigit() else path or "x", "", "") for path in paths]


def set_valued_signs(law: Law) -> list[str]:
    """Return the names of the steepnesses that are inf or None, which make a sign set-valued.

    Raises ValueError if a steepness is inf for some members only.
    """
    names = []
    for name in steepnesses(law):
        value = getattr(law, name)
        if is_traced(value) or isinstance(value, GainFunction):
            continue
        infinite = np.array([True]) if value is None else np.isinf(np.asarray(value, float))
        if infinite.any() and not infinite.all():
            raise ValueError(
                f"{name}: inf for some members and a number for others. A set-valued sign needs different "
                "code: give inf to all members or to none."
            )
        if infinite.all():
            names.append(name)
    return names


def with_set_valued_signs(law: L) -> L:
    """Return the law with None for every steepness that is inf. Raises ValueError as `set_valued_signs` does."""
    return dataclasses.replace(law, **dict.fromkeys(set_valued_signs(law)))


def with_default_steepness(law: L, model: Plant) -> L:
    """Return the law with the default steepness for the model in place of every inf or None."""
    if not set_valued_signs(law):
        return law
    usual = scaled_steepness(type(law)(), model)
    return dataclasses.replace(law, **{name: getattr(usual, name) for name in set_valued_signs(law)})
