"""The clock: number of samples, sample period, and the integrator between samples."""

from ambjax.numerics.records import Scalar, derived, leaf, part, record, replaced, static
from ambjax.simulation.integrate import Integrator


@record
class Clock:
    """Number of samples, sample period, and the integrator between samples."""

    samples: int = static(default=20_000, doc="number of sample periods")
    sample_period: Scalar = leaf(
        default=1e-4, unit="s", at_least=1e-9, at_most=1e6, doc="sample period; each measurement error is held for it"
    )
    method: Integrator | None = part(default=None, doc="the integrator; None: `ambjax.solvers.with_method` chooses it")
    # Largest number of edges inside one sample, from `with_method`. None: of all edges on a processor, otherwise 0.
    cuts: int | None = derived()

    @property
    def duration(self) -> Scalar:
        """Simulated time, s."""
        return self.samples * self.sample_period

    @property
    def integrator(self) -> Integrator:
        """The integration method. Raises ValueError if `method` is None."""
        if self.method is None:
            raise ValueError(
                "clock.method is None (dt = 'auto'): choose it: clock = with_method(clock, cascade, scenario)."
            )
        return self.method

    def with_method(self, method: Integrator | None) -> "Clock":
        """Return this clock with another integrator."""
        return replaced(self, method=method)
