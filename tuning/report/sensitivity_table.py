"""The sensitivity in the report: linear and injected peaks of |S| of held-out members, and their zones."""

from ambjax.linear import Zones
from ambjax.linear.stability import MOST_TESTED
from ambjax.text.web_page import escape_markdown
from tuning.judge.peaks import MemberPeak, Sensitivity
from tuning.report.facts import Column, Row, number, table

UNSTABLE = "its linearised loop is not stable"
# Text in place of the linear peak of a loop without one, by its zone.
NO_PEAK = {"D": "unstable", None: "not computed"}


def facts(zones: Zones, found: Sensitivity) -> Row:
    """Return plain data: a row for each member, the limits of the zones, and how the members were chosen.

    `tried`: by one injection into each of many members, not by linear peaks. Fields of a row:

    - `linear`, `frequency_hz`, `zone`: peak of |S| of the linearised loop. If it is not stable, they are None, None and
      "D"; if it could not be computed, all are None. `why`: which of the two, with the cause; '' otherwise.
    - `peak`, `low`, `high`, `at_hz`: injected, with the 95 % interval; None if all injections lose the rotor or the
      laws run in continuous time. `injected_zone`: its zone. `saturated`: share of samples with the supply at its
      limit. `repetitions`: number of injections; 0 in continuous time. `lost`: in how many of them the rotor is lost or
      the run stalls.
    """
    injected = any(one.injected for one in found.peaks)
    rows = [_row(one, zones) for one in found.peaks]
    tried = found.decides or found.saturates
    return {"members": rows, "injected": injected, "decides": found.decides, "tried": tried, "zones": zones.limits}


def _row(one: MemberPeak, zones: Zones) -> Row:
    row: Row = {"member": one.member} | dict.fromkeys(("linear", "frequency_hz", "zone")) | {"why": ""}
    if isinstance(one.linear, str):
        row["why"] = f"it cannot be linearised: {one.linear}"
    elif not one.linear.stable:
        row |= {"zone": "D", "why": UNSTABLE}
    else:
        row |= {"linear": one.linear.S.height, "frequency_hz": one.linear.S.frequency, "zone": one.linear.zone}
    row |= dict.fromkeys(("peak", "low", "high", "at_hz", "saturated")) | {"lost": 0, "repetitions": 0}
    if (at := one.injected) is not None:
        row |= {"peak": at.peak, "low": at.peak_low, "high": at.peak_high, "at_hz": at.peak_frequency}
        row |= {"saturated": at.saturated, "lost": at.lost, "repetitions": at.members}
    return row | {"injected_zone": "D" if row["lost"] else None if row["peak"] is None else zones.zone(row["peak"])}


def line(found: Row | None) -> str:
    """Return the largest peak of |S| of the held-out members and its zone."""
    if not found or not found["members"]:
        return "not computed here; `ambjax sensitivity tuned.toml` computes |S| and the zone."
    unknown = next((row for row in found["members"] if _unknown(row, found)), None)
    if unknown is not None:
        zone = unknown["injected_zone"] if unknown["lost"] else unknown["zone"]
        words = _unknown(unknown, found).rstrip(".") + (f": zone {zone}" if zone else "")
        return f"no peak of |S| for member {unknown['member']}: {words}."
    peak, at, zone = max(_peak(row, found) for row in found["members"])
    return f"|S| is at most {peak:.3g} (at {at:.3g} Hz) over the worst members: zone {zone}."


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


def section(found: Row | None) -> list[str]:
    """Return the section on the sensitivity."""
    if found is None:
        return []
    columns: dict[str, Column] = {
        "member": lambda row: str(row["member"]),
        "linear peak of |S|": lambda row: number(row["linear"]) if row["linear"] else NO_PEAK[row["zone"]],
        "at (Hz)": ("frequency_hz", ".4g"),
        "zone": lambda row: row["zone"] or "-",
    }
    injected: dict[str, Column] = {
        "injected peak": lambda row: (
            f"lost: {row['lost']} of {row['repetitions']}" if row["lost"] else number(row["peak"])
        ),
        "95 % interval": lambda row: "-" if _hidden(row, "low") else f"{row['low']:.4g} to {row['high']:.4g}",
        "its frequency (Hz)": lambda row: "-" if _hidden(row, "at_hz") else number(row["at_hz"]),
        "its zone": lambda row: row["injected_zone"] or "-",
        "saturated": lambda row: "-" if _hidden(row, "saturated") else f"{100 * row['saturated']:.2g} %",
    }
    a, b, c = found["zones"]
    words = [f"Zone A is below {a:g}, B below {b:g}, C below {c:g}."]
    chosen = f"peaks by one injection into each of up to {MOST_TESTED} members" if found["tried"] else "linear peaks"
    words.append(f"The members are those with the largest {chosen}.")
    if found["decides"]:
        words.append("A sign is set-valued: the injected peak decides, because no linear loop describes chattering.")
    else:
        words.append(f"The {'larger of the linear and the injected' if found['injected'] else 'linear'} peak decides.")
    if any(row["saturated"] for row in found["members"]):
        words.append(
            "The supply limits the voltage during the injection. A smaller `sensitivity.amplitude` measures the loop "
            "without this limit."
        )
    unknown = [f"- Member {row['member']}: {escape_markdown(row['why'])}." for row in found["members"] if row["why"]]
    cells = table(found["members"], columns | (injected if found["injected"] else {}))
    return ["## Sensitivity", cells, *(["\n".join(unknown)] if unknown else []), " ".join(words)]


def _hidden(row: Row, name: str) -> bool:
    """Return whether an injected value is left out: there is none, or the rotor was lost."""
    return bool(row["lost"]) or row[name] is None
