"""The front of error against voltage in the report: its points, the selected answer, and the case files."""

import numpy as np

from tuning.front import KNEE, FrontPoint
from tuning.report.facts import Column, Row, table
from tuning.solve.course import SearchResult

TITLE = "Error against voltage"


def facts(answer: SearchResult) -> list[Row]:
    """Return a row for each point of the front, in order of its error limit; `taken`: whether it is the answer."""
    same = ("sensitivity", "lost", "stalled", "members")
    return [
        {"factor": point.factor, "settled_rms_error_m": point.error_m, "settled_rms_u_V": point.volts}
        | {name: getattr(point, name) for name in same}
        | {
            "taken": bool(np.array_equal(point.x, answer.x)),
            "file": name,
            "gains": answer.problem.objective.space.named(point.x),
        }
        for point, name in zip(answer.front, _names(answer.front), strict=True)
    ]


def _names(points: tuple[FrontPoint, ...]) -> list[str]:
    """Return the file name of each point, from its voltage; a name that occurs before gets the error limit too."""
    names = list[str]()
    for point in points:
        name = f"tuned_{point.volts:.3g}V.toml"
        names.append(f"tuned_{point.volts:.3g}V_{point.factor:g}.toml" if name in names else name)
    return names


def sentence(rows: list[Row]) -> str:
    """Return which point is the answer, for the verdict; '' without a front."""
    taken = next((row for row in rows if row["taken"]), None)
    if taken is None or len(rows) < 2:
        return ""
    least = rows[0]
    words = f"{least['settled_rms_error_m']:.3g} m at {least['settled_rms_u_V']:.3g} V"
    if taken is least:
        return f"This answer has the least error: {words}."
    near = [row for row in rows if row["settled_rms_error_m"] <= KNEE * least["settled_rms_error_m"]]
    why = ""
    if taken is min(near, key=lambda row: row["settled_rms_u_V"]):
        why = f" has the least rms voltage of those with an error of at most {KNEE:g} times the least error"
    at = f"{taken['settled_rms_error_m']:.3g} m at {taken['settled_rms_u_V']:.3g} V"
    return f"This answer{why}: {at}. Least error: {words}."


def letter(n: int) -> str:
    """Return the label of the n-th point of a front, in the table and in the picture."""
    return chr(ord("A") + n)


def section(rows: list[Row] | None, written: bool) -> list[str]:
    """Return the section on the front. `written`: whether each point has a case file."""
    if not rows:
        return []
    columns: dict[str, Column] = {
        "point": lambda row: letter(rows.index(row)),
        "error limit": lambda row: "least" if row["factor"] == 1 else f"{row['factor']:g} times the least",
        "settled rms error (m)": lambda row: f"{row['settled_rms_error_m']:.3g}",
        "settled rms u (V)": lambda row: f"{row['settled_rms_u_V']:.4g}",
        "peak of |S|": ("sensitivity", ".3g"),
        "lost": lambda row: f"{row['lost'] + row['stalled']} of {row['members']}",
        "answer": lambda row: "**selected**" if row["taken"] else "-",
    }
    files: dict[str, Column] = {"case file": lambda row: f"`{row['file']}`"} if written else {}
    words = (
        "The least rms voltage for each limit of the settled rms error, within the other limits, on members of the "
        "validation ensemble. Only the selected answer is judged on the held-out members."
    )
    picture = "![Error against voltage; the selected answer is the filled point](front.png)"
    return [f"## {TITLE}", table(rows, columns | files), words, picture]
