"""The case file as a template into which the page writes the values of its sliders."""

import re
import tomllib
from collections.abc import Sequence
from typing import Any, NamedTuple

import tomlkit
from tomlkit.items import Table

from ambjax.page.sliders import Slider

# Numbers that mark the places of the sliders while the file is split into lines. No case contains them.
MARK = "1{:05d}e207"

# Prefixes of the tables of signals. Such a table needs the key `kind`.
SIGNALS = "reference", "disturbance"


class TemplateLine(NamedTuple):
    """A line of the case file.

    - `parts`: texts and places of sliders, which alternate. A place is the index of the slider, and the text of its
      value in the case file.
    - `only`: indices of sliders. The line is present if one of them differs from the case's value; if `only` is empty,
      the line is always present.
    """

    parts: list[str | tuple[int, str]]
    only: list[int]


def editable_lines(text: str, given: Sequence[Slider]) -> tuple[list[TemplateLine], list[int]]:
    """Return the lines of a case file, and the indices of the sliders that have a place in it.

    - `text`: the case file.
    - `given`: the sliders, with the values of this case.

    For a number that the file does not contain, a line is added that is present only if its slider has moved. For a
    number of the plant that [controller.model] does not give, a further line, present under the same condition, keeps
    the old value there for the controller.
    """
    document, written = tomlkit.parse(text), {}
    added: dict[str, dict[str, int]] = {}
    placed = []
    for k, slider in enumerate(given):
        tables, name = _route(slider.path)
        found = _find(document, tables)
        if found is not None and name in found:
            written[k] = found[name].as_string()
            found[name] = tomlkit.value(MARK.format(k))
            placed.append(k)
        elif found is None or isinstance(found, Table):
            added.setdefault(".".join(tables), {})[name] = k
            placed.append(k)
    lines = [_line(line, written) for line in tomlkit.dumps(document).split("\n")]
    kept = _find(document, ["controller", "model"])
    names = {given[k].path.rpartition(".")[2]: k for k in placed if given[k].path.startswith("plant.")}
    keep = {name: k for name, k in names.items() if kept is None or name not in kept}
    if kept is None or isinstance(kept, Table):
        rows = [([f"{name} = {given[k].value!r}"], [k]) for name, k in keep.items()]
        _insert(lines, "controller.model", kept is not None, rows)
    else:
        placed = [k for k in placed if k not in keep.values()]
    for table, names in added.items():
        rows = [([f"{name} = ", (k, ""), ""], [k]) for name, k in names.items()]
        if _find(document, table.split(".")) is None and table.startswith(SIGNALS):
            rows = [(['kind = "constant"'], sorted(names.values())), *rows]
        _insert(lines, table, _find(document, table.split(".")) is not None, rows)
    return lines, placed


def _insert(lines: list[TemplateLine], table: str, there: bool, rows: Sequence[tuple[Any, list[int]]]) -> None:
    """Insert optional lines below the header of a table. `there`: whether the file has it; else add it at the end."""
    new = [TemplateLine(*row) for row in rows]
    if there:
        at = next(
            k for k, line in enumerate(lines) if line.parts and str(line.parts[0]).strip().startswith(f"[{table}]")
        )
        lines[at + 1 : at + 1] = new
    elif new:
        every = sorted({k for line in new for k in line.only})
        lines += [TemplateLine([""], every), TemplateLine([f"[{table}]"], every), *new]


def _route(path: str) -> tuple[list[str], str]:
    """Return the names of the tables in a dotted path, and the key."""
    *tables, name = path.split(".")
    return tables, name


def _find(document: Any, tables: list[str]) -> Any:
    """Return the table at this path, or None."""
    for word in tables:
        if not hasattr(document, "get") or (document := document.get(word)) is None:
            return None
    return document if hasattr(document, "get") else None


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
