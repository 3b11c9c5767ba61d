"""State of the closed loop of a cascade on a processor."""

from typing import Any, NamedTuple

from jax import Array

from ambjax.control.cascade_state import Command
from ambjax.world.faults import Sensed


class SampledState(NamedTuple):
    """State of the closed loop on a processor. A field is () if the loop has no such part.

    - `plant`, `control`: states of the plant and of the laws.
    - `command`: last command, with u (V, or A for a current) within `Scenario.command_limit`.
    - `past`: the commands u before that of `command`, the most recent first, as many as the delay needs.
    - `finite`: 1 at the start; 0 after a law or, without a guard, the sensor has returned a number that is not finite.
    - `z_filtered`: output of the low-pass of the position sensor, m.
    - `u_a`: output voltage of the amplifier, V.
    - `watch`: state of the guard.
    - `started`: 0 until the guard has accepted all readings of one sample; then 1. Until then, each sample initialises
      the laws.
    - `sensed`: state of a sensor with faults.
    """

    plant: Any
    control: Any
    command: Command
    past: tuple[Array, ...]
    finite: Array
    z_filtered: Array | tuple[()] = ()
    u_a: Array | tuple[()] = ()
    watch: Any = ()
    started: Array | tuple[()] = ()
    sensed: Sensed | tuple[()] = ()
