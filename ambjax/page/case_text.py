"""The case file as a template into which the page writes the values of its sliders."""

import re
import tomllib
from collections.abc import Sequence
from typing import Any, NamedTuple

import tomlkit

from ambjax.cases.scenario_tables import UNITS, usual_unit
from ambjax.page.sliders import Slider

# Numbers that mark the places of the sliders while the file is split into lines. No case contains them.
MARK = "1{:05d}e207"

# Prefixes of the tables of signals. Such a table needs the key `kind`.
SIGNALS = "reference", "disturbance"


class TemplateLine(NamedTuple):
    """A line of the case file.

    `parts`: texts and places of sliders, which alternate. A place is the index of the slider, and the text of its value
    in the case file. `only`: the line is present if one of the sliders with these indices differs from the case's
    value, or always if there are none.
    """

    parts: list[str | tuple[int, str]]
    only: list[int]


class Spot(NamedTuple):
    """The place of a number in a case file: its key in a table, or its index in a list.

    `holder`: the table or list; None if the file has no such table. `table`: dotted name of the table. `element`: its
    number in a list of tables of this name; None for a table outside a list.
    """

    holder: Any
    key: str | int
    table: str
    element: int | None

    @property
    def header(self) -> str:
        return f"[{self.table}]" if self.element is None else f"[[{self.table}]]"

    @property
    def written(self) -> bool:
        if isinstance(self.holder, list):
            return int(self.key) < len(self.holder)
        return self.holder is not None and self.key in self.holder


def editable_lines(text: str, given: Sequence[Slider]) -> tuple[list[TemplateLine], list[int]]:
    """Return the lines of a case file, and the indices of the sliders `given` that have a place in it.

    For a number that the file does not contain, a line is added that is present only if its slider has moved. For a
    number of the plant that [controller.model] does not give, a further line, present under the same condition, keeps
    the old value there for the controller.
    """
    document, written = tomlkit.parse(text), {}
    spots = {k: spot for k, slider in enumerate(given) if (spot := _spot(document, slider.path)) is not None}
    for k, spot in spots.items():
        if spot.written:
            written[k] = spot.holder[spot.key].as_string()
            spot.holder[spot.key] = tomlkit.value(MARK.format(k))
    lines = [_line(line, written) for line in tomlkit.dumps(document).split("\n")]
    for k in [k for k in spots if k not in written and not _addable(lines, spots[k])]:
        del spots[k]
    model = _spot(document, "controller.model.m")
    names = {given[k].path.rpartition(".")[2]: k for k in spots if given[k].path.startswith("plant.")}
    keep = {name: k for name, k in names.items() if model is None or not model._replace(key=name).written}
    if model is not None and _addable(lines, model):
        _insert(lines, model, [([f"{name} = {given[k].value!r}"], [k]) for name, k in keep.items()])
    else:
        spots = {k: spot for k, spot in spots.items() if k not in keep.values()}
    added: dict[tuple[str, int | None], list[int]] = {}
    for k, spot in spots.items():
        if k not in written:
            added.setdefault((spot.table, spot.element), []).append(k)
    for same in added.values():
        rows: list[Any] = [([f"{spots[k].key} = ", (k, ""), ""], [k]) for k in same]
        if spots[same[0]].holder is None and spots[same[0]].table.startswith(SIGNALS):
            rows = [(['kind = "constant"'], same), *rows]
        _insert(lines, spots[same[0]], rows)
    return lines, list(spots)


def _addable(lines: Sequence[TemplateLine], spot: Spot) -> bool:
    """Return whether a line for a number can be added: below the header of its table, or in a new table."""
    return _header(lines, spot) is not None or (spot.holder is None and spot.element is None)


def _header(lines: Sequence[TemplateLine], spot: Spot) -> int | None:
    """Return the index of the line with the header of a table; None if there is none."""
    found = [k for k, line in enumerate(lines) if line.parts and str(line.parts[0]).strip().startswith(spot.header)]
    return next(iter(found[spot.element or 0 :]), None)


def _insert(lines: list[TemplateLine], spot: Spot, rows: Sequence[tuple[Any, list[int]]]) -> None:
    """Insert optional lines below the header of a table. If there is no header, add the table at the end."""
    new, at = [TemplateLine(*row) for row in rows], _header(lines, spot)
    if at is not None:
        lines[at + 1 : at + 1] = new
    elif new:
        every = sorted({k for line in new for k in line.only})
        lines += [TemplateLine([""], every), TemplateLine([spot.header], every), *new]


def _spot(document: Any, path: str) -> Spot | None:
    """Return the place of the number at this dotted path; None if it has none."""
    *words, key = _words(document, path)
    holder, numbers = document, [word for word in words if isinstance(word, int)]
    for word in words:
        holder = _entry(holder, word)
    if isinstance(key, int) and isinstance(holder, dict):
        holder = holder.get("values")  # of a schedule
    if len(numbers) > 1 and not Spot(holder, key, "", None).written:
        return None
    if holder is None and numbers:
        return None
    return Spot(holder, key, ".".join(str(word) for word in words if word not in numbers), next(iter(numbers), None))


def _entry(holder: Any, word: str | int) -> Any:
    if isinstance(word, int):
        return holder[word] if isinstance(holder, list) and word < len(holder) else None
    return holder.get(word) if isinstance(holder, dict) else None


def _words(document: Any, path: str) -> list[str | int]:
    """Return the keys and indices of a dotted path in the file, where all forces are in the list `disturbance.q_z`."""
    words = [int(word) if word.isdigit() else word for word in path.split(".")]
    loads, slots = _entry(_entry(document, "disturbance"), "q_z"), UNITS["q_z"]
    if words[0] != "disturbance" or words[1] not in slots.values() or not isinstance(loads, list):
        return words
    # A path has the name of a unit, such as q_f, only if the loads have several units.
    named = [slots[load.get("unit", usual_unit("q_z", load))] for load in loads]
    own = [n for n, name in enumerate(named) if name == words[1]] or list(range(len(loads)))
    n, rest = (words[3], words[4:]) if len(own) > 1 else (0, words[2:])
    return ["disturbance", "q_z", own[int(n)], *rest]


def _line(text: str, written: dict[int, str]) -> TemplateLine:
    """Split a line at the marks of its sliders. `written`: text of each slider's value in the case file, by index."""
    pieces = re.split(r"1(\d{5})e207", text)
    parts = [(int(x), written[int(x)]) if n % 2 else x for n, x in enumerate(pieces)]
    return TemplateLine(parts, [])


def filled(lines: Sequence[TemplateLine], given: Sequence[Slider], values: Sequence[float]) -> str:
    """Return the case file with the values `values` of the sliders `given`, as `caseFile` in controls.js does."""
    texts = []
    for line in lines:
        if line.only and all(values[k] == given[k].value for k in line.only):
            continue
        texts.append("".join(part if isinstance(part, str) else _number(*part, given, values) for part in line.parts))
    return "\n".join(texts)


def _number(k: int, written: str, given: Sequence[Slider], values: Sequence[float]) -> str:
    """Return the text of the value of slider `k`, or `written` if the value is that of the case."""
    if written and values[k] == given[k].value:
        return written
    return str(round(values[k])) if given[k].whole else repr(float(values[k]))


def checked(lines: Sequence[TemplateLine], given: Sequence[Slider]) -> bool:
    """Return whether the template gives valid TOML, both with the case's values and with every value changed."""
    try:
        for factor in (1.0, 1.5):
            tomllib.loads(filled(lines, given, [x.value * factor + (factor - 1) for x in given]))
    except tomllib.TOMLDecodeError:
        return False
    return True
