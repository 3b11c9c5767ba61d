"""The clock: samples, their period, and the integrator between them."""

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.integrate import Integrator


@record
class Clock:
    """Samples, their period, and the integrator between them. `method` None: `ambjax.with_method` chooses."""

    samples: int = static(default=20_000, doc="number of sample periods")
    sample_period: Scalar = leaf(
        default=1e-4, unit="s", at_least=1e-9, at_most=1e6, doc="time for which a measurement's error is held"
    )
    method: Integrator | None = None

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
        return Clock(self.samples, self.sample_period, method)
