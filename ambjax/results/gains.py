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
from ambjax.linear.analysis import linearisation_inputs
from ambjax.linear.notch_design import redesigned_at_once
from ambjax.world.scenario import Scenario

Loop = TypeVar("Loop", Cascade, Case)


def gains_of(loop: Cascade | Case, paths: Iterable[str] | None = None) -> dict[str, Array]:
    """Return the numbers of a controller at dotted paths, such as "controller.position.c", as a dict of scalars.

    - `loop`: a cascade, or a case.
    - `paths`: the paths; None: those of all numbers of the cascade that have a value.

    Use it for derivatives with respect to these gains only: the dict is a pytree. Raises ValueError for a path that
    does not exist, or without a value.

        gains = ambjax.gains_of(case, ["controller.position.c"])
        jax.grad(lambda gains: f(ambjax.with_gains(case, gains)))(gains)
    """
    if isinstance(paths, str):
        raise ValueError(f'paths = "{paths}": it must be a list. Write ["{paths}"].')
    if paths is not None and not isinstance(paths, Iterable):
        raise ValueError(f"paths = {paths!r}: it must be a list of dotted paths, such as controller.position.c.")
    known = _numbers(loop, paths := None if paths is None else list(paths))
    if none := [path for path in paths or () if known[path] is None]:
        raise ValueError(f"{none[0]} = None: it has no value in this loop. Leave it out, or set it by `with_gains`.")
    chosen = [path for path in known if known[path] is not None] if paths is None else paths
    return {path: jnp.asarray(known[path], jnp.result_type(float)) for path in chosen}


def _numbers(loop: Cascade | Case, paths: Iterable[str] | None) -> dict[str, Any]:
    """Return the numbers of a controller by path; None: without a value. Raises ValueError for an unknown path."""
    cascade = loop.cascade if isinstance(loop, Case) else loop
    if not isinstance(cascade, Cascade):
        raise ValueError(f"loop = {type(loop).__name__}: it must be a Case, or a Cascade such as `case.cascade`.")
    known = places(cascade, Scenario())
    own = {path: one.value for path, one in known.items() if path.startswith(("controller.", "processor."))}
    if unknown := [path for path in paths or () if path not in own]:
        raise ValueError(f"{unknown[0]}: {no_such_number(unknown[0], list(own))}")
    return own


def with_gains(loop: Loop, gains: Mapping[str, Any]) -> Loop:
    """Return a cascade or a case with other gains. `gains`: values by dotted path, in the units of the case file.

    The values may be traced. A synchronous notch of a case is designed for its new gains, unless they contain gains of
    the notch; that of a cascade alone is not, because its design needs the scenario. Raises ValueError for a path that
    does not exist, and for a number outside its range; arrays and traced values are not checked.

        ambjax.with_gains(case, {"controller.position.c": 20.0})
    """
    if not isinstance(gains, Mapping):
        raise ValueError(f"gains = {gains!r}: it must be a dict of values by dotted path.")
    _numbers(loop, gains)
    if isinstance(loop, Case):
        cascade = with_gains(loop.cascade, gains)
        if cascade.notch is not None and not any(path.startswith("controller.notch.gains.") for path in gains):
            anew = redesigned_at_once(*linearisation_inputs(cascade, loop.scenario, loop.clock))
            cascade = dataclasses.replace(cascade, notch=dataclasses.replace(cascade.notch, gains=anew))
        return dataclasses.replace(loop, cascade=cascade)
    return with_values(loop, Scenario(), gains)[0]
