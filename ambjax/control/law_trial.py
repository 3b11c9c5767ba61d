"""Trial of a custom law: trace its main methods once, to find mistakes before the simulation."""

import pathlib
import weakref
from typing import Any

import jax
import jax.numpy as jnp

from ambjax.control.base import Law
from ambjax.control.stages import CurrentDemand, CurrentInputs, ForceDemand, PositionLaw
from ambjax.host.extensions import line_of
from ambjax.numerics.records import GainFunction
from ambjax.numerics.shapes import map_varying
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# Outputs of the stages in words.
OUTPUTS = {
    "observer": "a Measurement",
    "position": "the number v_star",
    "inversion": "a CurrentDemand",
    "current": "the number u",
}


def try_law(law: Law, stage: str, model: Plant) -> None:
    """Trace the call, `init`, `scale` and `slope` of a law, and `step` if the law has it.

    Raises TypeError if an output, a rate, a scale, a slope or a state has a wrong structure or shape.
    """
    zero = jnp.zeros(())
    motion, reference = Measurement(zero, zero, zero), Reference(zero, zero, zero)
    demand, force = CurrentDemand(zero, zero), ForceDemand(zero, zero, zero, zero)
    inputs, wanted = {
        "observer": (motion, motion),
        "position": ((motion, reference), zero),
        "inversion": (force, demand),
        "current": (CurrentInputs(motion, demand, jnp.ones(())), zero),
    }[stage]
    first = (model, motion) if stage == "observer" else (model,)

    def everything(inputs: Any) -> tuple[Any, ...]:
        state = law.init(*first)
        kept = state if stage == "observer" else law.init_sampled(model)
        owns = any(law.has_own_step(implicit) for implicit in (True, False))
        after = law.step(model, inputs, kept, 1e-4) if owns else law(model, inputs, kept)
        starts = state, kept
        if isinstance(law, PositionLaw):
            starts = law.begin(model, inputs), law.begin_sampled(model, inputs, 1e-4)
        called = law(model, inputs, state)
        if not isinstance(called, tuple) or len(called) != 2:
            raise TypeError(f"its call must return {OUTPUTS[stage]} and the rate of its state, which is () without one")
        return state, called, law.scale(model), kept, after, law.slope(model), starts

    state, (output, rate), scale, kept, after, slope, (begun, sampled) = jax.eval_shape(everything, inputs)
    same_shapes(
        output, wanted, f"{type(law).__name__} must return {OUTPUTS[stage]} and the rate of its state; the output is"
    )
    same_shapes(rate, state, "the rate of the state must be like init(model); it is")
    same_shapes(scale, state, "scale(model) must be like init(model); it is")
    same_shapes(after, (wanted, kept), "on a processor, a step must return the output and the next state; they are")
    same_shapes(begun, state, "begin(model, inputs) must be like init(model); it is")
    same_shapes(sampled, kept, "begin_sampled(model, inputs, period) must be like init_sampled(model); it is")
    same_shapes(slope, zero, "slope(model) must be a number; it is")


# Classes of custom laws that have passed a trial.
_PASSED: weakref.WeakSet[type] = weakref.WeakSet()


def check_own_law(law: Law, stage: str, model: Plant) -> None:
    """Raise ValueError, with the reason, if a custom law cannot be called. A class is tried once."""
    kind = type(law)
    if kind.__module__.partition(".")[0] == "ambjax" or kind in _PASSED:
        return
    if any(isinstance(x, GainFunction) for x in vars(law).values()):
        return
    one, plant = map_varying(lambda x: x[0], (law, model))
    try:
        try_law(one, stage, plant)
    except Exception as error:
        raise ValueError(f"controller.{stage} = {kind.__name__}: it {reason(error)}.") from error
    _PASSED.add(kind)


def reason(error: BaseException, file: pathlib.Path | None = None) -> str:
    """Return what a custom law or its module raised, with a fix if it is known. `file`: of the law, for the line."""
    line = None if file is None else line_of(error, file)
    words = str(error).strip().partition("\n")[0] or "no message"
    if isinstance(error, SyntaxError) and line is not None:
        words = error.msg  # str(error) contains the line too
    fix = ""
    if isinstance(error, (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)):
        fix = ". Compute with jax.numpy without float(), and use jnp.where in place of `if`, `and` and `or`"
    return f"raised {type(error).__name__}: {words.rstrip('.')}{'' if line is None else f' (line {line})'}{fix}"


def same_shapes(found: Any, wanted: Any, words: str) -> None:
    """Raise TypeError unless two pytrees have the same structure and shapes."""
    first, second = (jax.tree.map(lambda x: jnp.shape(x), tree) for tree in (found, wanted))
    if jax.tree.structure(found) != jax.tree.structure(wanted) or first != second:
        shown = jax.tree.map(lambda x: x.shape, found)
        raise TypeError(f"{words} {shown}")
