"""The answer of a search in five lines, at the beginning of the report."""

import functools

from ambjax.results.outputs import described
from ambjax.text.web_page import escape_markdown
from tuning.report.facts import Row, TuningFacts
from tuning.report.limit_table import broken, prices


def answer_lines(facts: TuningFacts) -> list[str]:
    """Return five list items and an empty line: held or not, error and voltage, sensitivity, limits, next command."""
    items = {"members": _held, "error": _sizes, "sensitivity": _sensitivity, "limits": _limiting, "next command": _next}
    lines = [described(f"the line on the {name}", functools.partial(line, facts)) for name, line in items.items()]
    return [*(f"- {line}" for line in lines if line), ""]


def _held(facts: TuningFacts) -> str:
    """Return the item on the rotors that are held, and on the requirements."""
    outcome, after = facts.outcome, facts.after
    word = "NOT held" if not outcome["rotors_held"] else "Not verified" if facts.refuted else "Held"
    which = "held-out members" if after["members"] else "training members"
    kept = outcome["members"] - outcome["lost"] - outcome["stalled"]
    words = f"**{word}:** {kept} of {outcome['members']} {which} are held"
    if facts.before["members"]:
        words += f" (before tuning: {facts.before['held']})"
    met = "All requirements are met." if outcome["good"] else f"Not met: {'; '.join(outcome['against'])}."
    return f"{words}. {met}"


def _sizes(facts: TuningFacts) -> str:
    """Return the item on the error and the voltage after tuning, and before it."""
    after, before = facts.after, facts.before
    if not after["members"]:
        return "**Error and voltage:** not measured on held-out members (tune.held_out = 0)."
    if not after["held"]:
        return "**Error and voltage:** no held-out member is held."

    def change(name: str, unit: str) -> str:
        was = f" (before: {before[name]:.3g})" if before["held"] else ""
        return f"{after[name]:.3g} {unit}{was}"

    most = after.get("max_abs_u_V.largest")
    return (
        f"**Error:** {change('settled_rms_error_m', 'm')} rms after settling, largest "
        f"{after['settled_max_abs_error_m']:.3g} m. **Voltage:** {change('settled_rms_u_V.mean', 'V')} rms"
        f"{'' if most is None else f', largest {most:.3g} V'}."
    )


def _sensitivity(facts: TuningFacts) -> str:
    """Return the largest peak of |S| of the held-out members and its zone."""
    found = facts.sensitivity
    if not found or not found["members"]:
        return "**Sensitivity:** not computed here; `ambjax sensitivity tuned.toml` computes |S| and the zone."
    unknown = next((row for row in found["members"] if _unknown(row, found)), None)
    if unknown is not None:
        zone = unknown["injected_zone"] if unknown["lost"] else unknown["zone"]
        words = escape_markdown(_unknown(unknown, found)).rstrip(".") + (f": zone {zone}" if zone else "")
        return f"**Sensitivity:** no peak of |S| for member {unknown['member']}: {words}."
    peak, at, zone = max(_peak(row, found) for row in found["members"])
    return f"**Sensitivity:** |S| is at most {peak:.3g} (at {at:.3g} Hz) over the worst members: zone {zone}."


def _unknown(row: Row, found: Row) -> str:
    """Return why a member has no peak that counts; '' if it has one."""
    if row["lost"]:
        return "it is lost when a test signal is injected"
    if row["peak"] is None and found["decides"]:
        return "no injection decides its peak"
    return "" if found["decides"] else row["why"]


def _peak(row: Row, found: Row) -> tuple[float, float, str]:
    """Return the peak that counts, its frequency (Hz) and its zone.

    It is the injected peak if only injected peaks decide, otherwise the larger one.
    """
    linear = row["linear"], row["frequency_hz"], row["zone"]
    injected = row["peak"], row["at_hz"], row["injected_zone"]
    if row["peak"] is None:
        return linear
    return injected if found["decides"] else max(injected, linear)


def _limiting(facts: TuningFacts) -> str:
    """Return the item on the limits that are not held or active, and on the gains at a bound."""
    words = [escape_markdown(line) for line in (*broken(facts.limits), *prices(facts.limits))]
    if ends := [row["path"] for row in facts.gains if row["at_bound"]]:
        words.append(f"gains at a bound of `[tune.bounds]`: {', '.join(ends)}")
    if not words:
        front = "the trade-off between error and voltage (table below); " if len(facts.front or ()) > 1 else ""
        words = [f"{front}no limit of `[tune.limits]` is active, and no gain is at a bound"]
    return f"**Limited by:** {'; '.join(words)}."


def _next(facts: TuningFacts) -> str:
    """Return the next command, or the advice if a requirement is not met."""
    if facts.advice:
        return f"**Next:** {escape_markdown(facts.advice)}"
    return f"**Next:** in this folder, {facts.next}"
