"""The table [controller.notch]: the notch at the speed of the rotor."""

import dataclasses

from ambjax.cases.table import Table
from ambjax.control.cascade import Cascade
from ambjax.control.synchronous_notch import NULLED, SynchronousNotch
from ambjax.ensemble.spread import Spread, ends
from ambjax.linear.notch_design import with_notch_gains
from ambjax.numerics.records import leaf
from ambjax.simulation.clock import Clock
from ambjax.world.scenario import Scenario

# The kind that switches off the notch, for example on one bearing.
OFF = "none"
NUMBERS = ("rate", "min_speed", "max_speed")
PHASE = leaf(
    default=None, unit="degrees", at_least=-360.0, at_most=360.0,
    doc="phase of the response that the notch inverts; none: that of the linear loop at each speed",
)  # fmt: skip


def notch_from(top: Table, scenario: Scenario) -> SynchronousNotch | None:
    """Return the notch of [controller.notch] without its gains; None if there is no notch."""
    controller = top.table("controller")
    if "notch" not in controller.raw:
        return None
    table, rotor = controller.table("notch"), scenario.rotor
    table.only(["kind", *NUMBERS, "phase"])
    kind, phase = table.choice("kind", [*NULLED, OFF], next(iter(NULLED))), table.leaf("phase", PHASE)
    if kind == OFF:
        return None
    varying = rotor is not None and (rotor.acceleration != 0 or bool(rotor.changes))
    if rotor is None or (rotor.speed == 0 and not varying):
        raise ValueError("[controller.notch]: it follows the speed of the rotor. Give rotor.speed, in rpm.")
    given = Table({key: table.raw[key] for key in NUMBERS if key in table.raw}, table.path)
    notch = given.record(SynchronousNotch)
    return dataclasses.replace(notch, removes=kind, rotor=rotor, varying=varying, phase=phase)


def with_gains_of_notch(cascade: Cascade, scenario: Scenario, clock: Clock, spread: Spread) -> Cascade:
    """Return the cascade with the gains of its notch, if it has one, for all speeds of the spread.

    Raises ValueError if its loop has no linearisation.
    """
    rotor = ends(spread, cascade, scenario, ("rotor.",))[1].rotor
    if cascade.notch is None or rotor is None:
        return cascade
    try:
        return with_notch_gains(cascade, scenario, clock, rotor)
    except ValueError as error:
        raise ValueError(f"[controller.notch]: its gain cannot be computed: {error}") from None
