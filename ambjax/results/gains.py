"""Numbers of a cascade or a case by dotted path: read and replaced, for derivatives with respect to a few of them."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.control.cascade import Cascade
from ambjax.ensemble.paths import places, with_values
from ambjax.ensemble.spread import no_such_number
from ambjax.world.scenario import Scenario

Loop = TypeVar("Loop", Cascade, Case)


def gains_of(loop: Cascade | Case, paths: Iterable[str] | None = None) -> dict[str, Array]:
    """Return the numbers of a controller at dotted paths, such as "controller.position.c", as a dict of scalars.

    - `loop`: a cascade, or a case.
    - `paths`: the paths; None: those of all numbers of the cascade that have a value.

    The dict is a pytree: `jax.grad(lambda gains: f(with_gains(loop, gains)))(gains_of(loop, paths))` returns the
    derivative with respect to these gains only. Raises ValueError for a path that does not exist.
    """
    if isinstance(paths, str):
        raise ValueError(f'paths = "{paths}": it must be a list. Write ["{paths}"].')
    cascade = loop.cascade if isinstance(loop, Case) else loop
    if not isinstance(cascade, Cascade):
        raise ValueError(f"loop = {type(loop).__name__}: it must be a Case, or a Cascade such as `case.cascade`.")
    if paths is not None and not isinstance(paths, Iterable):
        raise ValueError(f"paths = {paths!r}: it must be a list of dotted paths, such as controller.position.c.")
    known = places(cascade, Scenario())
    own = [path for path in known if path.startswith(("controller.", "processor."))]
    found = {}
    for path in [one for one in own if known[one].value is not None] if paths is None else paths:
        if path not in own:
            raise ValueError(f"{path}: {no_such_number(path, own)}")
        found[path] = jnp.asarray(known[path].value, jnp.result_type(float))
    return found


def with_gains(loop: Loop, gains: Mapping[str, Any]) -> Loop:
    """Return the cascade, or the case, with the numbers at these dotted paths replaced. The values may be traced.

    Raises ValueError for a path that does not exist.
    """
    if not isinstance(gains, Mapping):
        raise ValueError(f"gains = {gains!r}: it must be a dict of values by dotted path.")
    gains_of(loop, gains)
    if isinstance(loop, Case):
        return dataclasses.replace(loop, cascade=with_gains(loop.cascade, gains))
    return with_values(loop, Scenario(), gains)[0]
