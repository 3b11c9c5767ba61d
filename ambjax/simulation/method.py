"""Which integrator, with how many substeps: read off the loop's own slopes."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.numerics.records import is_traced
from ambjax.simulation.clock import Clock
from ambjax.simulation.edges import most_inside
from ambjax.simulation.explicit import RK4
from ambjax.simulation.integrate import AdaptiveRodas3, Integrator, Rodas3
from ambjax.world.scenario import Scenario

# RK4 at this step times slope is accurate to about 1e-9 m on smooth gains (benchmarks/work_precision.py)
ACCURATE = 1.0
# The plant under a held voltage is not stiff: RK4 at this step times its pole leaves less than 1e-11 m.
SAMPLED = 0.02
# Its coils may be: at this step times R / L, RK4 leaves less than 1e-11 m and 1e-6 A of a sample in which they settle.
# Beyond so many substeps an L-stable method is cheaper.
SETTLED, MOST_SETTLED = 0.5, 64
# An amplifier's voltage is known as a function of time: at this step times its rate, RK4 integrates it to 1e-9 A.
DRIVEN = 0.5
# Names of the plant's slopes beside the laws', for messages.
PLANT, COILS = "plant", "current in the coils"
# More RK4 substeps per sample than this cost more than the L-stable method's larger steps.
MOST_SUBSTEPS = 4
# Fixed L-stable steps: the corner of a smoothed sign costs an impulse that grows as slope h^2. At this value the
# gradient in gamma under held noise is right to 1e-3; with steps twice as long it was 12 % off.
CORNER = 7.5e-6
# Error per step of the adaptive method. The error of z is in proportion to how far the loop carries a kick: the largest
# distance, m, that a velocity of 1 m/s added at one instant moves z later. At QUIET_TOLERANCE, z is within 1e-8 m where
# that is at most 0.1 m. A loop near the edge of losing its rotor carries a kick without bound, so that no error in
# metres holds for every loop (tests/test_tolerance.py). Under noise every sample begins with a jump, and
# QUIET_TOLERANCE would cost up to twice the steps.
TOLERANCE, QUIET_TOLERANCE = 1e-6, 1e-7


def slopes(cascade: Cascade, scenario: Scenario) -> dict[str, float]:
    """Steepest rate of each law, of the unstable plant and of its coils, 1/s; the largest over an ensemble.

    Raises ValueError where one is traced: a step can be chosen only from numbers.
    """
    # on a processor the laws are stepped, and the plant alone is integrated
    laws = {} if cascade.processor else {f"{stage} law": slope for stage, slope in cascade.slopes().items()}
    named = laws | {PLANT: scenario.plant.slope(), COILS: scenario.plant.coil_slope(scenario.touchdown)}
    if traced := [name for name, slope in named.items() if is_traced(slope)]:
        raise ValueError(
            f"clock.method is None (dt = 'auto'), but inside jit, grad or vmap the slope of the {traced[0]} is traced "
            "and no step can be read off it. Choose it outside: clock = with_method(clock, cascade, scenario)."
        )
    return {name: float(np.max(np.asarray(x))) for name, x in named.items()}


def choose_method(cascade: Cascade, scenario: Scenario, sample_period: float, *, reverse: bool = False) -> Integrator:
    """Adaptive RODAS3, unless RK4 suits better: noise held over slopes that a few substeps resolve, or a processor.

    Without noise, steps may grow over many slopes and only error control knows how far. Under noise that
    jumps every sample there is no such gain, and the explicit method is the cheaper one. `reverse` asks
    for a loop of fixed length, which reverse mode can run: RK4 or RODAS3 with equal substeps. A jump of a
    disturbance between the steps of these costs about 3e-8 m per m/s^2 on smooth gains.
    """
    named = slopes(cascade, scenario)
    slope = max(named.values())
    if cascade.processor is not None:
        settled = math.ceil(sample_period * named[COILS] / SETTLED)
        rate = 0.0 if (amplifier := scenario.amplifier) is None else float(np.max(np.asarray(amplifier.slope())))
        driven = math.ceil(sample_period * max(named[PLANT] / SAMPLED, rate / DRIVEN))
        substeps, fixed = max(driven, settled, 1), max(driven, MOST_SETTLED)
        explicit = settled <= MOST_SETTLED
    else:
        substeps = max(math.ceil(sample_period * slope / ACCURATE), 1)
        explicit = substeps <= MOST_SUBSTEPS and (reverse or scenario.sensor is not None)
        fixed = math.ceil(sample_period / math.sqrt(CORNER / slope))
    if explicit:
        return RK4(substeps)
    if reverse:
        return Rodas3(fixed)
    # Rounding must stay well below the tolerance, or steps are rejected for noise: in float32, 1.2e-4.
    tolerance = QUIET_TOLERANCE if scenario.sensor is None else TOLERANCE
    return AdaptiveRodas3(max(tolerance, 1e3 * float(jnp.finfo(jnp.result_type(float)).eps)))


def with_method(clock: Clock, cascade: Cascade, scenario: Scenario, *, reverse: bool = False) -> Clock:
    """`clock` with its method chosen if it had none, and checked against its stability limit if it had.

    For a cascade on a processor also with `cuts`: how many edges of disturbances lie inside one sample. A larger number
    that was counted before remains, so that a part of an ensemble runs the program of the whole.

    Raises ValueError for an explicit step beyond the limit, naming both and the fix.
    """
    if clock.method is None:
        clock = clock.with_method(choose_method(cascade, scenario, float(clock.sample_period), reverse=reverse))
    elif clock.method.limit is not None:
        _check_limit(clock, clock.method.limit, cascade, scenario)
    if cascade.processor is None or (cuts := most_inside(scenario, clock.sample_period)) is None:
        return clock
    return dataclasses.replace(clock, cuts=max(cuts, clock.cuts or 0))


def _check_limit(clock: Clock, limit: float, cascade: Cascade, scenario: Scenario) -> None:
    try:
        named = slopes(cascade, scenario)
        step = clock.integrator.step_size(float(np.max(np.asarray(clock.sample_period))))
    except (ValueError, jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):
        return  # traced: the caller checked the concrete values, or takes the risk
    law = max(named, key=lambda name: named[name])
    limit /= named[law]
    if step is not None and step > limit:
        raise ValueError(
            f"clock.dt = {step:g} s: {clock.method} is stable only up to {limit:.3g} s, because the "
            f"{law} has slope {named[law]:.3g} 1/s. Use dt = 'auto', method = 'rodas3', or a smaller dt."
        )
