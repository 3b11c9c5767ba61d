"""Gain schedules: a gain as a piecewise-linear function of the error, the reference or its speed.

A gain of a law may be a schedule. The cascade evaluates the schedules of a law at the present position and reference,
and calls the law with the resulting numbers, so laws contain no code for schedules.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.base import Law
from ambjax.numerics.declared import check_number
from ambjax.numerics.records import GainFunction, Scalar, is_traced, part, record, static
from ambjax.world.waveforms import Reference

L = TypeVar("L", bound=Law)

# Unit and formula of each signal.
OVER = {"error": ("m", "|z - r|"), "reference": ("m", "|r|"), "reference-speed": ("m/s", "|r_dot|")}
# Largest number of knots, largest value of the signal at a knot, and smallest distance between two knots.
MOST_KNOTS, LARGEST, CLOSEST = 50, 1e6, 1e-12
# Below this share of the last knot, the derivative of |x| is linear in x, and so 0 at 0 (`_magnitude`).
ROUNDED = 1e-9


@record
class Schedule(GainFunction):
    """A gain as a piecewise-linear function of a signal, constant below the first knot and above the last.

    The signal is |z - r| ("error"), |r| ("reference") or |r_dot| ("reference-speed"). z is the position that the law
    reads: the measured one for an observer, the estimated one for the other laws. The numbers `values` are gains: they
    can be tuned, varied and exported. `at` and `over` are constants of the compiled program.
    """

    values: tuple[Scalar, ...] = part(doc="gain at each knot, in its unit")
    at: tuple[float, ...] = static(doc="knots, increasing; m, or m/s for the speed of the reference")
    over: str = static(default="error", doc="signal of the schedule")

    def value(self, z: Scalar, reference: Reference) -> Array:
        """Return the gain at a position z (m) and a reference."""
        signal = {"error": z - reference.r, "reference": reference.r, "reference-speed": reference.r_dot}[self.over]
        x, total = _magnitude(jnp.asarray(signal), ROUNDED * self.at[-1]), jnp.asarray(self.values[0])
        for (low, high), (first, last) in zip(*map(itertools.pairwise, (self.at, self.values)), strict=True):
            share = jnp.minimum(jnp.maximum((x - low) * (1 / (high - low)), 0.0), 1.0)
            total = total + (last - first) * share
        return total

    def with_knot(self, knot: int, value: Scalar) -> "Schedule":
        return dataclasses.replace(self, values=(*self.values[:knot], value, *self.values[knot + 1 :]))

    def check(self, field: dataclasses.Field, path: str) -> None:
        """Raise ValueError if this schedule is invalid for the gain `field`, whose dotted path is `path`."""
        if "steepness" not in field.metadata:
            words = field.metadata.get("doc", "not a gain")
            raise ValueError(f"{path}: only a gain can have a schedule. Give a number ({words}).")
        if self.over not in OVER:
            raise ValueError(f"{path}.over = '{self.over}': it must be one of {', '.join(OVER)}.")
        fine = isinstance(self.at, tuple) and all(isinstance(x, (int, float)) and 0 <= x <= LARGEST for x in self.at)
        if not (fine and 2 <= len(self.at) <= MOST_KNOTS and np.all(np.diff(self.at) >= CLOSEST)):
            unit, signal = OVER[self.over]
            raise ValueError(
                f"{path}.at = {_shown(self.at)}: it must be 2 to {MOST_KNOTS} increasing numbers from 0 to "
                f"{LARGEST:g} {unit}, at least {CLOSEST:g} apart: the knots of the gain as a function of {signal}."
            )
        if len(self.values) != len(self.at):
            raise ValueError(
                f"{path}.values has {len(self.values)} numbers and {path}.at has {len(self.at)}: give one value for "
                "each knot."
            )
        for knot, value in enumerate(self.values):
            if not is_traced(value):
                check_number(finite(field), f"{path}.values[{knot}]", value)


def finite(field: dataclasses.Field) -> dataclasses.Field:
    """Return the gain's `field` without infinite values; the value at a knot is checked against it."""
    return dataclasses.field(metadata={**field.metadata, "infinite": False, "steepness": False})


def _shown(numbers: tuple[float, ...]) -> str:
    """Return the first six numbers as text."""
    more = ", ..." if len(numbers) > 6 else ""
    return f"[{', '.join(f'{x:g}' if isinstance(x, (int, float)) else repr(x) for x in numbers[:6])}{more}]"


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _magnitude(x: Array, rounded: float) -> Array:
    """Return |x|. Its derivative is sgn(x) where |x| >= rounded, and x/rounded elsewhere.

    At an equilibrium, x is 0 up to rounding errors. The linearisation must not depend on the sign of such an error.
    """
    return jnp.abs(x)


@_magnitude.defjvp
def _magnitude_jvp(rounded: float, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return jnp.abs(x), jnp.minimum(jnp.maximum(x * (1 / rounded), -1.0), 1.0) * dx


def schedules(law: Law) -> dict[str, Schedule]:
    """Return the schedules of a law by the name of the gain."""
    given: dict[str, object] = vars(law)
    return {name: value for name, value in given.items() if isinstance(value, Schedule)}


def with_gains_at(law: L, z: Scalar, reference: Reference) -> L:
    """Return the law with a number for each schedule: its value at the position z (m) and the reference."""
    found = schedules(law)
    return _with(law, {name: one.value(z, reference) for name, one in found.items()}) if found else law


def extremes(law: L) -> tuple[L, ...]:
    """Return two laws, with the lowest and with the highest value of each schedule; (law,) if it has no schedule."""
    found = schedules(law)
    if not found:
        return (law,)

    def end(values: tuple[Scalar, ...], plain: Callable, other: Callable) -> Scalar:
        return plain(values) if all(isinstance(x, float) for x in values) else functools.reduce(other, values)

    ways = ((min, jnp.minimum), (max, jnp.maximum))
    return tuple(_with(law, {name: end(one.values, *way) for name, one in found.items()}) for way in ways)


def _with(law: L, numbers: dict[str, Scalar]) -> L:
    given: object = law
    return dataclasses.replace(given, **numbers)  # pyright: ignore[reportArgumentType, reportReturnType]
