"""Forces and flux of the machine of a case, without [spread]."""

from typing import NamedTuple

from ambjax.cases.reader import Case


class Forces(NamedTuple):
    """Largest magnetic force, weight, and a bound on the disturbing force, all in N."""

    largest: float
    weight: float
    load: float


def forces(case: Case) -> Forces:
    """Return the forces of a case, for the plant without [spread].

    The largest force is that at z = 0 for i = i_0, where one magnet is off. If the amplifier or the limit of a coil
    limits |i| to less, it is the force at this limit. The load is the sum of the bounds of all signals that disturb z.
    """
    scenario, plant = case.scenario.turning(), case.scenario.plant
    m, largest = float(plant.m), float(scenario.largest_force)
    factors = {"q_z": m, "q_v": m * float(plant.a), "q_f": 1.0, "base": m}
    signals = {slot: signal for slot in factors if (signal := getattr(scenario, slot)) is not None}
    ends = {slot: signal.span(float(case.clock.duration)) for slot, signal in signals.items()}
    load = sum(factors[slot] * max(abs(low), abs(high)) for slot, (low, high) in ends.items())
    return Forces(largest, m * abs(float(plant.g)), load)


def bias_flux(case: Case) -> float:
    """Return the flux density of the bias current, mu_0 n i_0/(2 s_0) for two gaps in series, T."""
    plant = case.scenario.plant
    return float(plant.mu_0) * float(plant.n) * float(plant.i_0) / (2 * float(plant.s_0))
