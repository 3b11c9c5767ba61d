"""The first part of `ambjax check`: sensitivity and margins of the linearised loop, and reserves of the machine."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from ambjax.cases.forces import forces, linear_magnet
from ambjax.cases.reader import Case
from ambjax.commands.band_text import band_lines, band_numbers, running_facts, running_speeds
from ambjax.commands.sensitivity_report import set_valued
from ambjax.linear import PLACES, Analysis, analyse, linearise
from ambjax.results.operating import margin_numbers
from ambjax.results.outputs import table
from ambjax.world.amplifier import difference


class Fact(NamedTuple):
    """A number of the machine. `value`: None: not applicable. Without a `key` it is not in the JSON summary."""

    key: str
    words: str
    value: float | None
    unit: str


def acceptance(case: Case) -> tuple[dict[str, object], list[str], str]:
    """Return the JSON summary, the lines on the zone of the loop linearised at r = 0, and the table of its numbers."""
    try:
        system = linearise(case.cascade, case.scenario, case.clock)
    except ValueError as error:
        facts = machine(case)
        summary = {"stable": None, "zone": None, "why": str(error), **{fact.key: fact.value for fact in facts}}
        return summary, [f"Sensitivity: no zone and no margins: {error}"], _facts_table(facts)
    loop = analyse(system, case.scenario.plant.m, case.clock.sample_period, case.zones)
    rate = 1 / float(case.clock.sample_period) if case.cascade.sampled else None
    facts = [*_loop_facts(loop, rate), *machine(case)]
    summary = {"stable": loop.stable, "zone": loop.zone, **{fact.key: fact.value for fact in facts if fact.key}}
    lines = [_verdict(case, loop)]
    if loop.stable:
        summary |= {"frequency_hz": loop.S.frequency, **band_numbers(loop, case.zones), "margins": margin_numbers(loop)}
        lines += band_lines("Nominal loop", loop, case.zones)
        speeds = running_speeds(case.scenario.rotor, float(case.clock.duration))
        summary["running_speed"], more = running_facts(speeds, system, loop.S)
        lines += more
    return summary, lines, _facts_table(facts)


def _verdict(case: Case, loop: Analysis) -> str:
    if not loop.stable:
        return "Sensitivity: no zone and no margins: the linearised loop is not stable at r = 0."
    inside = " (linear loop, valid inside the bands of the set-valued signs)" if set_valued(case) else ""
    word = "largest |S|" if loop.S.at_edge else "peak"
    return f"Sensitivity: zone {loop.zone}, {word} {loop.S.height:.4g} at {loop.S.frequency:.4g} Hz{inside}."


def _loop_facts(loop: Analysis, rate: float | None) -> list[Fact]:
    """Return the peak and all margins of a stable loop. `rate`: of the processor, Hz; None: continuous time."""
    if not loop.stable:
        return []
    kinds = {
        "gm": ("gain_margin", "gain margin (the one nearer to 1)", "1"),
        "pm": ("phase_margin_deg", "phase margin", "degrees"),
        "delay": ("delay_margin_s", "delay margin", "s"),
        "dm": ("disk_margin", "disk margin", "1"),
    }
    facts = [Fact("peak", "peak of |S|", loop.S.height, "1")]
    for kind, (key, words, unit) in kinds.items():
        place = loop.margins_at.place(kind)
        other = next(one for one in PLACES if one != place)
        facts.append(Fact(key, f"{words}, at the {place}", getattr(loop.margins, kind), unit))
        facts.append(Fact("", f"{words}, at the {other}", getattr(getattr(loop.margins_at, other), kind), unit))
        if kind == "delay" and rate:
            facts.append(Fact("delay_margin_samples", f"{words}, at the {place}", loop.margins.delay * rate, "samples"))
    return facts


def machine(case: Case) -> list[Fact]:
    """Return the numbers of the plant, its supply and its converters."""
    plant, sensor = case.scenario.plant, case.scenario.sensors
    (force, weight, load), period = forces(case), float(case.clock.sample_period)
    (u_max, reserve), step = _voltages(case), float(sensor.step(plant.s_0)) or None
    k_s, k_i, L, flux = map(float, linear_magnet(plant))
    slew = None if u_max is None else u_max / L
    pole = math.sqrt(abs(k_s) / float(plant.m))
    std = float(sensor.std)
    per_noise = step / std if step and std else None
    return [
        Fact("force_reserve", "largest force / weight", force / weight if weight else None, "1"),
        Fact("load_reserve", "largest force / (weight + largest load)", force / (weight + load) if load else None, "1"),
        Fact("k_s_N_per_m", "negative stiffness k_s", k_s, "N/m"),
        Fact("k_i_N_per_A", "force per current k_i", k_i, "N/A"),
        Fact("unstable_pole_per_s", "unstable pole sqrt(k_s/m)", pole, "1/s"),
        Fact("samples_per_time_constant", "samples per time constant of the pole", 1 / (period * pole), "1"),
        Fact("bias_flux_T", "bias flux density", flux, "T"),
        Fact("current_slew_A_per_s", "slew rate of the current, u_max/L", slew, "A/s"),
        Fact("coil_voltage_reserve_V", "voltage of a coil above the bias, coil.u_max - R i_0", reserve, "V"),
        Fact("converter_step_m", "converter step of z", step, "m"),
        Fact("step_per_noise", "converter step / standard deviation of the noise", per_noise, "1"),
    ]


def _voltages(case: Case) -> tuple[float | None, float | None]:
    """Return the largest u, and the largest voltage of a coil in excess of R i_0, V; None: no limit."""
    scenario, bias = case.scenario, case.scenario.plant.R * case.scenario.plant.i_0
    coil = scenario.actuator.coil
    u_max, reserve = float(scenario.u_max), math.inf
    if coil is not None:
        u_max = float(difference(coil.supplied(jnp.asarray(u_max), bias)))
        reserve = float(coil.reserve(bias))
    most, beyond = (x if math.isfinite(x) else None for x in (u_max, reserve))
    return most, beyond


def _facts_table(facts: list[Fact]) -> str:
    rows = [(fact.words, f"{fact.value:.4g}", fact.unit) for fact in facts if fact.value is not None]
    return table(("loop and machine", "value", "unit"), rows)
