"""Trial of the law of a whole machine, in its loop."""

from typing import Any

import jax

from ambjax.control.law_trial import same_shapes
from ambjax.numerics.records import canonical
from ambjax.simulation.machine_kinds import SampledMachine
from ambjax.simulation.whole_machine import Machine


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
    same_shapes(scale, begun, "scale() must be like the state that begin returns; it is")
