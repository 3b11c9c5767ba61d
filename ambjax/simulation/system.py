"""The closed loop of a case, in continuous time or on a processor."""

from ambjax.control.cascade import Cascade
from ambjax.control.guard import simulated
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.world.scenario import Scenario


def check_parts(cascade: Cascade, scenario: Scenario) -> None:
    """Raise ValueError, with the path and the fix, for parts of a loop that are not compatible."""
    if cascade.processor is None:
        cascade.check_smooth()
        if (path := scenario.on_processor) is not None:
            raise ValueError(
                f"{path} is for a controller on a processor, and this one runs in continuous time. Add [processor], or "
                "leave it out."
            )
    sensor = scenario.sensor
    if sensor is not None and not sensor.velocity and not cascade.observer.estimates_velocity:
        raise ValueError(
            "sensor.velocity = false: the velocity is not measured, and controller.observer does not estimate it. "
            'Choose one that does: kind = "kalman", for example.'
        )


def system_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> ClosedLoop | Sampled:
    """Return the closed loop of the cascade, in continuous time or on its processor."""
    if cascade.processor is None:
        return ClosedLoop(cascade, scenario)
    period = clock.sample_period
    return Sampled(ClosedLoop(simulated(cascade.on_processor(), scenario, period), scenario), period, clock.cuts)
