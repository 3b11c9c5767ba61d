"""Sentences about maxima at an end of the frequency band of a case, and about larger values outside it."""

from ambjax.linear import Analysis, ResponsePeak, Zones

# The responses whose maxima are reported: words, unit, the name in JSON, and whether the response has zones.
RESPONSES = {
    "S": ("|S|", "", "", True),
    "T": ("|T|", "", "t_", False),
    "KS": ("|KS|", " V/m", "ks_", False),
    "S_velocity": ("|S| at the velocity sensor", "", "velocity_", False),
}


def band_lines(name: str, analysis: Analysis, zones: Zones) -> list[str]:
    """Return one sentence for each maximum of a stable loop that is not a peak, or not the largest value."""
    lines = []
    for field, (words, unit, _, zoned) in RESPONSES.items():
        one: ResponsePeak | None = getattr(analysis, field)
        if one is None:
            continue
        text = ""
        if one.at_edge:
            text = f"{one.frequency:.4g} Hz, where {words} is largest, is an end of the band: this value is not a peak."
        if one.outside is not None:
            zone = f" (zone {zones.zone(one.outside.height)})" if zoned else ""
            text += " " if text else ""
            text += (
                f"Outside the band of [sensitivity], {words} is larger: {one.outside.height:.4g}{unit} at "
                f"{one.outside.frequency:.4g} Hz{zone}."
            )
        lines += [f"{name}: {text}"] if text else []
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
