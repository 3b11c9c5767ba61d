"""The table of a law: each gain is a number, or a table that contains the schedule of the gain."""

import dataclasses
from typing import Any

from ambjax.cases.table import Table, show
from ambjax.control.base import Law
from ambjax.control.schedule import OVER, Schedule

EXAMPLE = '{ over = "error", at = [0.0, 1e-5], values = [100.0, 200.0] }'


def law_from(table: Table, kind: type[Law], base: Law | None) -> Any:
    """Return a law of this kind with the gains of this table. `base`: law with the defaults; None: those of `kind`."""
    names = {field.name: field for field in dataclasses.fields(kind) if field.metadata.get("leaf")}
    given = {name: table.raw[name] for name in names if isinstance(table.raw.get(name), dict)}
    numbers = Table({key: value for key, value in table.raw.items() if key not in given}, table.path)
    law = numbers.record(kind, extra=("kind",), base=base)
    found = {name: _schedule(Table(raw, table.at(name))) for name, raw in given.items()}
    for name, one in found.items():
        one.check(names[name], table.at(name))
    return dataclasses.replace(law, **found)


def _schedule(table: Table) -> Schedule:
    table.only(["over", "at", "values"])
    over = table.choice("over", list(OVER))
    return Schedule(_numbers(table, "values"), at=_numbers(table, "at"), over=over)


def _numbers(table: Table, key: str) -> tuple[float, ...]:
    if key not in table.raw:
        raise ValueError(f"{table.at(key)} is missing: a schedule is a table such as {EXAMPLE}.")
    values = table.raw[key]
    if not isinstance(values, list):
        raise ValueError(f"{table.at(key)} = {show(values)}: it must be a list of numbers, as in {EXAMPLE}.")
    each = Table({str(n): x for n, x in enumerate(values)}, table.at(key))
    return tuple(each.number(str(n), None) for n in range(len(values)))
