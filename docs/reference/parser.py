"""The ranges that the reader of case files allows, taken from its error messages."""

import re
from typing import Any

from ambjax.cases.reader import case_from
from ambjax.cases.table import Table
from ambjax.cases.template_text import template
from tuning.problem.config import tune_from

NO_KEY = "?"


def complaint(path: str, value: Any, beside: dict[str, Any] | None = None) -> str:
    """Return the error message for this value at a dotted path; `beside`: other keys of the same table."""
    *tables, key = path.split(".")
    raw: dict[str, Any] = {}
    inner = raw
    for name in tables:
        inner = inner.setdefault(name, {})
    inner.update(beside or {})
    inner[key] = value
    try:
        case = case_from(raw)
        tune_from(Table(raw).table("tune"), case)
    except ValueError as error:
        return str(error)
    raise LookupError(f"{path} = {value!r} is allowed")


def keys(table: str, beside: dict[str, Any] | None = None) -> list[str]:
    """Return the keys that a table may have."""
    path = f"{table}.{NO_KEY}" if table else NO_KEY
    listed = complaint(path, 0, beside).rpartition("Keys allowed here: ")[2].rstrip(".")
    return [] if listed == "none" else listed.split(", ")


def rule(path: str, beside: dict[str, Any] | None = None) -> str:
    """Return the allowed values of a key, in the words of the reader."""
    said = complaint(path, NO_KEY, beside)
    said = said.partition(f'"{NO_KEY}": ')[2]
    said = said.removeprefix("it must be ").removeprefix("give ").partition(". Write ")[0]
    return said.rstrip(".").removesuffix(", without quotes")


LINE = re.compile(r"(?:# )?(?P<key>[\w.-]+) = (?P<value>.*?)(?:\s+# (?P<meaning>.*))?")


def remarks(scenario: str = "tracking") -> dict[str, tuple[str, str]]:
    """Return value and meaning of every key in the template, by dotted path, commented tables included."""
    found: dict[str, tuple[str, str]] = {}
    table = last = ""
    for line in template(scenario).splitlines():
        if named := re.match(r"(?:# )?\[([\w.]+)\]", line):
            table = named[1]
        elif (more := re.fullmatch(r"#\s{20,}(?:# )?(.*[^:])", line)) and last:
            found[last] = (found[last][0], f"{found[last][1]} {more[1]}")
        elif key := LINE.fullmatch(line):
            last = f"{table}.{key['key']}"
            found[last] = (key["value"], key["meaning"] or "")
    return found
