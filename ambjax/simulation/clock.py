"""The clock: samples, their period, and the integrator between them."""

import dataclasses

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.integrate import Integrator


@record
class Clock:
    """Samples, their period, and the integrator between them. `method` None: `ambjax.with_method` chooses.

    `cuts` is for a cascade on a processor, and `ambjax.with_method` counts it. None: all edges that there are.
    """

    samples: int = static(default=20_000, doc="number of sample periods")
    sample_period: Scalar = leaf(
        default=1e-4, unit="s", at_least=1e-9, at_most=1e6, doc="time for which a measurement's error is held"
    )
    method: Integrator | None = None
    cuts: int | None = static(default=None, doc="edges of disturbances inside one sample, at most")

    @property
    def duration(self) -> Scalar:
        """Simulated time, s."""
        return self.samples * self.sample_period

    @property
    def integrator(self) -> Integrator:
        """The method. Raises ValueError where none was chosen."""
        if self.method is None:
            raise ValueError(
                "clock.method is None (dt = 'auto'): choose it: clock = with_method(clock, cascade, scenario)."
            )
        return self.method

    def with_method(self, method: Integrator) -> "Clock":
        """This clock with another integrator."""
        return dataclasses.replace(self, method=method)
