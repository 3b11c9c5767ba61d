"""The clock, and a case in place of its cascade, scenario and clock, as the first argument of a function."""

import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast, overload

from ambjax.control.cascade import Cascade
from ambjax.numerics.records import Scalar, bounded, derived, part, record, replaced, static
from ambjax.simulation.integrate import Integrator
from ambjax.world.scenario import Scenario


@record
class Clock:
    """Number of samples, sample period, and the integrator between samples."""

    samples: int = static(default=20_000, doc="number of sample periods")
    sample_period: Scalar = bounded(1e-4, "s", 1e-9, 1e6, "sample period; each measurement error is held for it")
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
        return replaced(self, method=method)


P = ParamSpec("P")
R = TypeVar("R", covariant=True)
C = TypeVar("C", contravariant=True)
PARTS = ("cascade", "scenario", "clock")


class Triple(Protocol):
    """A case: a cascade, its scenario and its clock, such as that of `read_case`."""

    @property
    def cascade(self) -> Cascade: ...
    @property
    def scenario(self) -> Scenario: ...
    @property
    def clock(self) -> Clock: ...


class TakesCase(Protocol[C, P, R]):
    """A function of a cascade, a scenario and a clock, or of a case of type C."""

    @overload
    def __call__(self, case: C, /, *args: P.args, **kwargs: P.kwargs) -> R: ...
    @overload
    def __call__(
        self, cascade: Cascade, scenario: Scenario, clock: Clock, /, *args: P.args, **kwargs: P.kwargs
    ) -> R: ...


def no_case(function: str, *given: object) -> ValueError:
    """Return the error of a function whose first arguments are neither a case nor its three parts."""
    kinds = ", ".join(type(x).__name__ for x in given)
    return ValueError(
        f"{function}({kinds}): give a case, as ambjax.read_case(PATH) returns it, or a Cascade, a Scenario and a Clock."
    )


def takes_case(function: Callable[Concatenate[Cascade, Scenario, Clock, P], R]) -> TakesCase[Triple, P, R]:
    """Return the function, which then also accepts a case in place of its first three arguments."""

    @functools.wraps(function)
    def called(*args: Any, **named: Any) -> R:
        if args and all(hasattr(args[0], name) for name in PARTS):
            case, *others = args
            whole = not any(isinstance(x, (Scenario, Clock)) for x in others)
            args = (case.cascade, case.scenario, case.clock, *others)
        else:
            whole = len(args) + sum(name in named for name in PARTS) >= len(PARTS)
        if not whole:
            raise no_case(function.__name__, *args)
        return function(*args, **named)

    return cast(TakesCase[Triple, P, R], called)
