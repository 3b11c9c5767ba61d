"""The blocks of a case: its controller, its plant, and both as one loop."""

from ambjax.codegen.block import Block
from ambjax.codegen.controller import controller_of
from ambjax.codegen.loop_step import loop_of
from ambjax.codegen.plant_step import plant_of
from ambjax.control.cascade import Cascade
from ambjax.simulation.clock import Clock
from ambjax.simulation.integrate import FixedSteps
from ambjax.simulation.method import choose_method
from ambjax.world.scenario import Scenario

WHAT = ("controller", "plant", "loop")


def block_of(what: str, cascade: Cascade, scenario: Scenario, clock: Clock) -> Block:
    """Return a block of a case. `what`: the block, one of WHAT.

    If the clock's method has no fixed number of steps, the plant uses the method that `choose_method` selects instead.

    Raises ValueError for a case that cannot be exported.
    """
    period = float(clock.sample_period)
    controller = controller_of(cascade, scenario.command_limit, period, scenario)
    if what == "controller":
        return controller
    method = clock.method
    if not isinstance(method, FixedSteps):
        method = choose_method(cascade, scenario, period, reverse=True)
    plant = plant_of(cascade, scenario, period, method)
    return plant if what == "plant" else loop_of(controller, plant)
