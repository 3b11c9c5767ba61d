"""Trial of a custom law: trace its main methods once, to find mistakes before the simulation."""

from typing import Any

import jax
import jax.numpy as jnp

from ambjax.control.base import Law
from ambjax.control.stages import CurrentDemand, CurrentInputs, ForceDemand, PositionLaw
from ambjax.numerics.records import canonical
from ambjax.simulation.whole_machine import Machine, SampledMachine
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

    Of a position law, `begin` and `begin_sampled` are traced too; of every law but an observer, `init_sampled`. Raises
    TypeError if an output, a rate, a scale, a slope or a state has a wrong structure or shape. Exceptions that the
    methods raise are passed on.
    """
    motion, reference = Measurement(*_zeros(3)), Reference(*_zeros(3))
    demand, force = CurrentDemand(*_zeros(2)), ForceDemand(_zero(), _zero(), _zero(), _zero())
    inputs, wanted = {
        "observer": (motion, motion),
        "position": ((motion, reference), _zero()),
        "inversion": (force, demand),
        "current": (CurrentInputs(motion, demand, jnp.ones(())), _zero()),
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
        return state, law(model, inputs, state), law.scale(model), kept, after, law.slope(model), starts

    state, (output, rate), scale, kept, after, slope, (begun, sampled) = jax.eval_shape(everything, inputs)
    _same(output, wanted, f"{type(law).__name__} must return {OUTPUTS[stage]} and the rate of its state; the output is")
    _same(rate, state, "the rate of the state must be like init(model); it is")
    _same(scale, state, "scale(model) must be like init(model); it is")
    _same(after, (wanted, kept), "on a processor, a step must return the output and the next state; they are")
    _same(begun, state, "begin(model, inputs) must be like init(model); it is")
    _same(sampled, kept, "begin_sampled(model, inputs, period) must be like init_sampled(model); it is")
    _same(slope, _zero(), "slope(model) must be a number; it is")


def try_machine(machine: Machine) -> None:
    """Trace the law of a whole machine in its loop: `begin`, `scale`, and `step` or the call. Raises as `try_law`."""

    def everything(machine: Machine) -> tuple[Any, Any, Any]:
        assert machine.law is not None
        errors = machine.sensor_errors(0)
        state = machine.start()
        if isinstance(machine, SampledMachine):
            return state.law, machine.law.scale(), machine.jump(0.0, state, errors).law
        return state.law, machine.law.scale(), machine.demands(0.0, state, errors)

    begun, scale, _ = jax.eval_shape(everything, canonical(machine))
    _same(scale, begun, "scale() must be like the state that begin returns; it is")


def _zero() -> jax.Array:
    return jnp.zeros(())


def _zeros(count: int) -> list[jax.Array]:
    return [_zero()] * count


def _same(found: Any, wanted: Any, words: str) -> None:
    """Raise TypeError unless two pytrees have the same structure and shapes."""
    first, second = (jax.tree.map(lambda x: jnp.shape(x), tree) for tree in (found, wanted))
    if jax.tree.structure(found) != jax.tree.structure(wanted) or first != second:
        shown = jax.tree.map(lambda x: x.shape, found)
        raise TypeError(f"{words} {shown}")
