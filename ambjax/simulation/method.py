"""Choice of the integrator and its number of substeps from the slopes of the loop."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ambjax.control.cascade import Cascade
from ambjax.numerics.records import Scalar, is_traced, replaced
from ambjax.simulation.adaptive import AdaptiveSteps
from ambjax.simulation.clock import Clock
from ambjax.simulation.edges import most_inside
from ambjax.simulation.explicit import DOP853, RK4, AdaptiveCashKarp
from ambjax.simulation.integrate import Integrator
from ambjax.simulation.rosenbrock import AdaptiveRodas3, Rodas3
from ambjax.world.scenario import Scenario

# Product of step and slope at which RK4 is accurate to about 1e-9 m on smooth gains (benchmarks/work_precision.py).
ACCURATE = 1.0
# On a processor: product of step and plant slope at which the error of RK4 is below 1e-11 m. The motion under a held
# voltage is not stiff.
SAMPLED = 0.02
# The coils may be stiff. SETTLED: product of step and R/L at which the error of RK4 is below 1e-11 m and 1e-6 A in a
# sample in which the current settles. MOST_SETTLED: number of substeps above which an L-stable method is cheaper.
SETTLED, MOST_SETTLED = 0.5, 64
# The same for the lag of the flux due to eddy currents. The force depends on it, so the error of z limits the step:
# 1.3e-11 m in the first 30 samples of the rig (`ambjax template rig`).
LAGGED = 0.5
# The same for the slope of the stop. A contact begins and ends inside a step, which changes the velocity after an
# elastic contact by up to 1.1e-4 of its value, and by up to 1.2e-3 with damping (tests/test_touchdown.py).
TOUCHED = 0.05
# Product of step and amplifier rate at which the error of RK4 in the current is 1e-9 A. The amplifier's voltage is a
# known function of time. The same for the angular frequency of a load, with an error of 2e-5 of its impulse.
DRIVEN = 0.5
# Largest number of substeps for a load: it has 40 periods in a sample.
MOST_DRIVEN = 512
# Names of the plant's slopes in messages.
PLANT, COILS, FLUX, STOP = "plant", "current in the coils", "flux behind the current", "rotor on its stop"
# The same in continuous time, for steps of a fixed number.
MOST_SUBSTEPS = 4
# In continuous time: largest product of sample period and slope at which an explicit method is cheaper than RODAS3.
EXPLICIT = 8.0
# Product of step and slope at which the error of DOP853 under noise is below 1e-10 m (tests/test_accuracy.py).
NOISY = 2.0
# Fixed L-stable steps: largest value of slope h^2. The error at the corner of a smoothed sign is an impulse
# proportional to slope h^2. At this value the gradient in gamma under held noise is correct to 1e-3; with twice the
# step its error is 12 %.
CORNER = 7.5e-6
# Relative error per step of adaptive RODAS3 with and without noise; `AdaptiveRodas3` states the error of z that follows
# (tests/test_oracle.py). Under noise every sample begins with a jump, and QUIET_TOLERANCE would take up to twice the
# steps.
TOLERANCE, QUIET_TOLERANCE = 1e-6, 1e-7
# The same for the Cash-Karp method, whose number of steps grows only as the fifth root of the tolerance. Kinks at the
# limit of the supply require TIGHT; a drop onto a fast transient requires QUIET_TIGHT (tests/test_oracle.py).
TIGHT, QUIET_TIGHT = 1e-8, 1e-9


class UnknownSlopeError(ValueError):
    """A value from which the method is chosen has no number inside jit or vmap."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"clock.method is None (dt = 'auto'), but inside jit or vmap the {name} has no value, and no fixed step "
            "can be computed from it. Choose the method outside: "
            "clock = with_method(clock, cascade, scenario, reverse=True)."
        )


def slopes(cascade: Cascade, scenario: Scenario) -> dict[str, float]:
    """Return the largest slope, 1/s, of each law, the plant, its coils, its flux and its stop, over the members.

    A derivative without jit or vmap has numbers as primal values; these are used. Raises UnknownSlopeError if a slope
    has no value, because a fixed step can be chosen only from numbers.
    """
    # On a processor the laws have discrete steps, and only the plant is integrated.
    laws = {} if cascade.sampled else {f"{stage} law": slope for stage, slope in cascade.slopes().items()}
    plant = scenario.plant
    named = laws | {PLANT: plant.slope(), COILS: scenario.current_slope, FLUX: plant.flux_slope()}
    named |= {} if scenario.stop is None else {STOP: scenario.stop.slope(plant.m)}
    if any(map(is_traced, named.values())):
        named = lax.stop_gradient(named)
    if traced := [name for name, slope in named.items() if is_traced(slope)]:
        raise UnknownSlopeError(f"slope of the {traced[0]}")
    return {name: float(np.max(np.asarray(x))) for name, x in named.items()}


def choose_method(cascade: Cascade, scenario: Scenario, sample_period: float, *, reverse: bool = False) -> Integrator:
    """Choose an integration method from the slopes of the loop.

    On a processor, the choice is RK4 if MOST_SETTLED substeps resolve current and flux, otherwise adaptive RODAS3.

    In continuous time, the choice is the adaptive Cash-Karp method, or adaptive RODAS3 if the loop is stiff (EXPLICIT).
    There is one exception. Noise is constant over each sample. If the laws are analytic and no limit and no edge can
    lie inside a sample, the motion in a sample is smooth. One or two steps of DOP853 then reach the same error in less
    time, because the slowest member of an ensemble does not determine the number of steps.

    `reverse`: choose a method with a fixed number of steps, which supports reverse mode: RK4, or RODAS3 with equal
    substeps. A jump of a disturbance inside such a step causes an error of about 3e-8 m per m/s^2 on smooth gains. An
    amplifier that controls the current, in continuous time, always gets fixed steps: of DOP853, or of RODAS3 if the
    loop is stiff.

    Raises ValueError as `slopes` does.
    """
    named = slopes(cascade, scenario)
    slope = max(named.values())
    fixed_only, noisy, load = _fixed_only(cascade, scenario), _noisy(scenario), scenario.load_rate()
    loaded = math.ceil(sample_period * load / DRIVEN)
    if cascade.sampled:
        settled = math.ceil(sample_period * max(named[COILS] / SETTLED, named[FLUX] / LAGGED))
        amplifier = scenario.actuator
        rate = float(np.max(np.asarray(amplifier.slope()))) if amplifier.slow else 0.0
        touched = named.get(STOP, 0.0) / TOUCHED
        driven = math.ceil(sample_period * max(named[PLANT] / SAMPLED, touched, rate / DRIVEN))
        if loaded > MOST_DRIVEN:
            raise ValueError(
                f"clock.sample_period = {sample_period:g} s: a load of {load / (2 * math.pi):.4g} Hz needs {loaded} "
                f"steps in a sample, and at most {MOST_DRIVEN} are allowed. Shorten it, or lower the frequency."
            )
        driven = max(driven, loaded)
        substeps, fixed = max(driven, settled, 1), max(driven, MOST_SETTLED)
        explicit = settled <= MOST_SETTLED
    else:
        substeps = max(math.ceil(sample_period * slope / ACCURATE), loaded, 1)
        explicit = reverse and substeps <= MOST_SUBSTEPS
        fixed = max(math.ceil(sample_period / math.sqrt(CORNER / slope)), loaded)
        smooth = fixed_only or (noisy and _smooth_inside(cascade, scenario, sample_period))
        if smooth and not reverse and substeps <= MOST_SUBSTEPS:
            return DOP853(max(math.ceil(sample_period * max(slope, load) / NOISY), 1))
    if explicit:
        return RK4(substeps)
    if reverse or fixed_only:
        return Rodas3(fixed)
    stiff = cascade.sampled or sample_period * slope > EXPLICIT
    tolerance = (TOLERANCE if noisy else QUIET_TOLERANCE) if stiff else (TIGHT if noisy else QUIET_TIGHT)
    return AdaptiveRodas3(_tolerance(tolerance)) if stiff else AdaptiveCashKarp(_tolerance(tolerance))


def _tolerance(wanted: float) -> float:
    """Return a tolerance well above the rounding errors, which otherwise cause rejected steps: in float32, 1.2e-4."""
    return max(wanted, 1e3 * float(jnp.finfo(jnp.result_type(float)).eps))


def _noisy(scenario: Scenario) -> bool:
    """Return whether a sensor has noise. Traced values count as noise."""
    return any(is_traced(std) or bool(np.any(np.asarray(std))) for std in scenario.sensors.noises)


def _smooth_inside(cascade: Cascade, scenario: Scenario, sample_period: float) -> bool:
    """Return whether the rates have neither kinks nor jumps inside samples: analytic laws, no limit, stop or edge."""
    if not all(law.analytic for law in cascade.laws):
        return False
    u_max = scenario.u_max
    limited = is_traced(u_max) or bool(np.any(np.isfinite(np.asarray(u_max))))
    inside = _most_inside(scenario, sample_period, True)
    return not limited and scenario.drive == "voltage" and scenario.stop is None and inside == 0


def _most_inside(scenario: Scenario, period: Scalar, reference: bool) -> int | None:
    """Return `most_inside` of the disturbances; with `reference`, also of the reference, which a processor samples."""
    return most_inside(scenario.edges(reference), period, scenario.knots(reference))


def _fixed_only(cascade: Cascade, scenario: Scenario) -> bool:
    """Return whether the loop requires a fixed number of steps: XLA aborts when it compiles the adaptive method."""
    return not cascade.sampled and scenario.drive == "current"


def with_method(clock: Clock, cascade: Cascade, scenario: Scenario, *, reverse: bool = False) -> Clock:
    """Return `clock` with an integration method that is valid for the cascade and the scenario.

    A clock without a method gets the result of `choose_method`, or adaptive RODAS3 where jit or vmap hides the values
    from which that chooses; otherwise the method is checked against its stability limit, unless the sample period or a
    slope is traced. For a cascade on a processor, and where fixed steps are required, the function also computes
    `cuts`, the largest number of edges inside one sample. A larger `cuts` of the clock is kept, so that a part of an
    ensemble runs the compiled program of the whole.

    Raises ValueError for an explicit step above the stability limit; the message names step, limit and fix. Raises
    ValueError also for adaptive steps if an amplifier controls the current in continuous time, and UnknownSlopeError if
    fixed steps are required and the values are hidden.
    """
    if not isinstance(clock, Clock):
        raise ValueError(
            f"clock = {type(clock).__name__}: it must be a Clock. The order is with_method(clock, cascade, scenario)."
        )
    if clock.method is None:
        period = lax.stop_gradient(clock.sample_period)
        try:
            if is_traced(period):
                raise UnknownSlopeError("sample period")
            method = choose_method(cascade, scenario, float(np.max(np.asarray(period))), reverse=reverse)
        except UnknownSlopeError:
            if reverse or _fixed_only(cascade, scenario):
                raise
            method = AdaptiveRodas3(_tolerance(TOLERANCE if _noisy(scenario) else QUIET_TOLERANCE))
        clock = clock.with_method(method)
    elif isinstance(clock.method, AdaptiveSteps) and _fixed_only(cascade, scenario):
        raise ValueError(
            f"clock.method = {clock.method}: an amplifier that controls the current requires fixed steps in continuous "
            "time. Use dt = 'auto', or method = 'rodas3' with a dt."
        )
    elif clock.method.limit is not None:
        _check_limit(clock, clock.method.limit, cascade, scenario)
    fixed = _fixed_only(cascade, scenario)
    if not (cascade.sampled or fixed) or (cuts := _most_inside(scenario, clock.sample_period, fixed)) is None:
        return clock
    return replaced(clock, cuts=max(cuts, clock.cuts or 0))


def _check_limit(clock: Clock, limit: float, cascade: Cascade, scenario: Scenario) -> None:
    """Raise ValueError if the step is above the stability limit of the method."""
    try:
        named = slopes(cascade, scenario)
        step = clock.integrator.step_size(float(np.max(np.asarray(clock.sample_period))))
    except (ValueError, jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):
        return  # traced values cannot be checked
    if step is not None:
        require_stable(clock.method, step, limit, named)


def require_stable(method: object, step: float, limit: float, named: dict[str, float]) -> None:
    """Raise ValueError if a step (s) times the largest of the slopes (1/s) exceeds the stability limit of the method.

    `named`: the slopes by what has them.
    """
    what = max(named, key=lambda name: named[name])
    if step * named[what] > limit:
        raise ValueError(
            f"clock.dt = {step:g} s: {method} is stable only up to {limit / named[what]:.3g} s, because the "
            f"{what} has slope {named[what]:.3g} 1/s. Use dt = 'auto' or a smaller dt."
        )
