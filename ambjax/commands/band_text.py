"""Sentences about maxima at an end of the frequency band of a case, larger ones outside it, and the running speed."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ambjax.linear import Analysis, ResponsePeak, StateSpace, Zones
from ambjax.linear.linear_machine import AxisSensitivity
from ambjax.linear.margins import NO_PEAK
from ambjax.world.rotation import PER_MINUTE, Rotation

# The responses whose maxima are reported: words, unit, the name in JSON, and whether the response has zones.
RESPONSES = {
    "S": ("|S|", "", "", True),
    "T": ("|T|", "", "t_", False),
    "KS": ("|KS|", " V/m", "ks_", False),
    "S_velocity": ("|S| at the velocity sensor", "", "velocity_", False),
}


def band_lines(
    name: str, analysis: Analysis | AxisSensitivity, zones: Zones, fields: Iterable[str] = tuple(RESPONSES)
) -> list[str]:
    """Return a sentence for each maximum that is no peak, or not the largest value. `fields`: of RESPONSES."""
    lines = []
    for field in fields:
        words, unit, _, zoned = RESPONSES[field]
        one: ResponsePeak | None = getattr(analysis, field)
        if one is None:
            continue
        text = [f"{name}:"]
        if one.at_edge:
            where = f"{one.frequency:.4g} Hz, where {words} is largest"
            text.append(f"{where}, is an end of the band: this value is not a peak.")
        if one.outside is not None:
            zone = f" (zone {zones.zone(one.outside.height)})" if zoned else ""
            size = f"{one.outside.height:.4g}{unit} at {one.outside.frequency:.4g} Hz{zone}"
            text.append(f"Outside the band of [sensitivity], {words} is larger: {size}.")
        lines += [" ".join(text)] if len(text) > 1 else []
    return lines


def band_numbers(analysis: Analysis, zones: Zones) -> dict[str, object]:
    """Return the numbers of `band_lines` by their names in the JSON summaries."""
    found: dict[str, object] = {}
    for field, (_, _, prefix, zoned) in RESPONSES.items():
        one: ResponsePeak | None = getattr(analysis, field)
        outside = None if one is None else one.outside
        found |= {
            f"{prefix}at_band_edge": None if one is None else one.at_edge,
            f"{prefix}outside_peak": None if outside is None else outside.height,
            f"{prefix}outside_frequency_hz": None if outside is None else outside.frequency,
        }
        if zoned:
            found[f"{prefix}outside_zone"] = None if outside is None else zones.zone(outside.height)
    return found


# A peak of |S| is near the running speed if it is within this share of it.
NEAR = 0.1


def running_speeds(rotor: Rotation | None, duration: float) -> tuple[float, ...]:
    """Return the speeds (Hz) at the start, the corners and the end of a run, without 0, each once."""
    if rotor is None:
        return ()
    speeds = {abs(PER_MINUTE * float(rotor.rpm(t))) for t in rotor.corners(duration)}
    return tuple(sorted(speeds - {0.0}))


def running_facts(
    speeds: tuple[float, ...], system: StateSpace, peak: ResponsePeak, axis: int = 0, what: str = "|S|"
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return |S| at each speed (Hz) for the JSON summary, and as lines of text; neither for an unstable loop."""
    if not speeds or peak == NO_PEAK:
        return [], []
    found = np.abs(np.asarray(system.response(np.array(speeds)))[:, axis, axis]).tolist()
    low, high = (1 - NEAR) * speeds[0], (1 + NEAR) * speeds[-1]
    facts = [{"frequency_hz": speed, "S": S} for speed, S in zip(speeds, found, strict=True)]
    at = ", ".join(f"{S:.4g} at {speed:.4g} Hz" for speed, S in zip(speeds, found, strict=True))
    lines = [f"Once per revolution: {what} is {at}."]
    if low <= peak.frequency <= high:
        lines.append(
            f"WARNING: the peak of {what}, {peak.height:.4g} at {peak.frequency:.4g} Hz, is within {100 * NEAR:g} % of "
            "the running speed: unbalance and runout excite it. Move the peak or the speed."
        )
    return facts, lines
