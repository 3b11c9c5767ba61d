"""What a law may answer beside its output, and what is taken where it does not: nobody else asks which law it is.

size(model)         what the argument of its smoothed sign amounts to: its steepnesses are suited to the model by it
layer(model)        for each state, the largest error that keeps it where a smoothed sign turns; inf
requirement         what Theorem 1 requires of one of its gains; nothing
robust(error)       the term that its sign adds to the rate of the error of its stage, Eqs. (12), (14); 0
ranges(site)        where its gains are searched; about their values
relay()             gain and steepness of the sign that drives the error of its stage, if its `step` is that alone; None
held(model)         the steepest rate of what its implicit step leaves explicit, 1/s; 0
memory              for each state, its name, unit and meaning, where its structure does not name it; x
init_sampled(model) its state on a processor, where explicit steps take its `step` too; `init`, and they do not
scale_sampled(model) the size of each number of that state; `scale`
slide(...)          an inversion law's step that knows where its stiffness is (`laws.Relaxation`); there is none
estimates_velocity  whether an observer needs no measured velocity; no
"""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.sampling import Relay
from ambjax.control.search import Interval, SearchContext
from ambjax.numerics.records import Scalar, is_traced
from ambjax.world.plant import Plant

L = TypeVar("L")


class Requirement(NamedTuple):
    """What Theorem 1 requires of a law: that the gain of this name exceeds Q_z, Q_i or Delta_1."""

    gain: str
    over: str


def default_law(kind: type[L], model: Plant) -> L:
    """The law of this kind with its default gains and, where it has a smoothed sign, a steepness that suits the model.

    A sign is soft or hard against what its argument amounts to: p = 25 m^2/A^2 is soft where v is 2500 A^2/m^2, as in
    Table 1, and a hard sign where it is 1e7.
    """
    law: Any = kind()
    if not hasattr(law, "size"):
        return law
    steep = [field.name for field in dataclasses.fields(law) if field.metadata.get("steepness")]
    ratio = law.size(Plant()) / law.size(model)
    return dataclasses.replace(law, **{name: getattr(law, name) * ratio for name in steep})


def layer(law: Any, model: Plant) -> Any:
    """The largest error with which each state of the law stays where a smoothed sign turns."""
    return law.layer(model) if turns(law) else jax.tree.map(lambda _: jnp.inf, law.scale(model))


def requirement(law: Any) -> Requirement | None:
    """What Theorem 1 requires of a law, or of a kind of law."""
    return getattr(law, "requirement", None)


def robust(law: Any, error: Array) -> Array:
    """What the law's sign adds to the rate of the error of its stage."""
    return law.robust(error) if hasattr(law, "robust") else 0.0 * error


def relay(law: Any) -> Relay | None:
    """The sign that alone drives the error of the law's stage; None: there is none, or there is more."""
    return law.relay() if hasattr(law, "relay") else None


def has_own_step(law: Any, implicit: bool) -> bool:
    """Whether a processor with implicit (or explicit) steps takes the law's own `step`; else it makes an Euler step."""
    return hasattr(law, "step") and (implicit or hasattr(law, "init_sampled"))


def init_sampled(law: Any, model: Plant) -> Any:
    """State at t = 0, on a processor, of a law other than an observer."""
    return law.init_sampled(model) if hasattr(law, "init_sampled") else law.init(model)


def held(law: Any, model: Plant) -> Scalar:
    """The steepest rate of what its implicit step leaves explicit, 1/s."""
    return law.held(model) if hasattr(law, "held") else 0.0


def ranges(law: Any, site: SearchContext) -> dict[str, Interval]:
    """Where gains of the law are searched, by name; one that is not there: about its value."""
    return law.ranges(site) if hasattr(law, "ranges") else {}


def turns(law: Any) -> bool:
    """Whether a state of the law stays where a smoothed sign turns: it is stiff."""
    return hasattr(law, "layer")


def estimates_velocity(law: Any) -> bool:
    """Whether an observer, or a kind of observer, needs no measured velocity."""
    return getattr(law, "estimates_velocity", False)


def memory(law: Any, state: Any) -> list[tuple[str, str, str]]:
    """Name, unit and meaning of each leaf of a law's state, for whoever writes it down."""
    if hasattr(law, "memory"):
        return list(law.memory)
    leaves = jax.tree_util.tree_leaves_with_path(state)
    paths = [jax.tree_util.keystr(path, simple=True, separator="_") for path, _ in leaves]
    return [(f"x_{path}" if path.isdigit() else path or "x", "", "") for path in paths]


def slides(law: Any) -> bool:
    """Whether an inversion law has a step of its own."""
    return hasattr(law, "slide")


def hard_signs(law: Any) -> list[str]:
    """Names of the steepnesses of a law that are inf or None: its sign has no layer.

    Raises ValueError where one is inf for some members only.
    """
    names = []
    for field in dataclasses.fields(law):
        value = getattr(law, field.name)
        if not field.metadata.get("steepness") or is_traced(value):
            continue
        infinite = np.array([True]) if value is None else np.isinf(np.asarray(value, float))
        if infinite.any() and not infinite.all():
            raise ValueError(
                f"{field.name}: inf for some members and a number for others. A sign without a layer is another "
                "program: give inf to all or to none."
            )
        if infinite.all():
            names.append(field.name)
    return names


def hardened(law: L) -> L:
    """The law with None for every steepness that is inf: the sign itself. Raises ValueError as `hard_signs` does."""
    given: Any = law
    return dataclasses.replace(given, **dict.fromkeys(hard_signs(law)))


def unhardened(law: L) -> L:
    """The law with inf for every steepness that is None, so that its slope is a number."""
    given: Any = law
    return dataclasses.replace(given, **dict.fromkeys(hard_signs(law), np.inf))


def softened(law: L, model: Plant) -> L:
    """The law with the steepness that suits the model for every sign that has none."""
    given: Any = law
    usual = default_law(type(law), model)
    return dataclasses.replace(given, **{name: getattr(usual, name) for name in hard_signs(law)})


def scale_sampled(law: Any, model: Plant) -> Any:
    """Size that matters of each number of a law's state on a processor."""
    return law.scale_sampled(model) if hasattr(law, "scale_sampled") else law.scale(model)
