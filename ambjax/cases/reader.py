"""Reader of case files: from TOML to a cascade, a scenario and a clock."""

import dataclasses
import operator
import pathlib
import re
import tomllib
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from ambjax.cases.case_table import notebook_table, parts_of
from ambjax.cases.controller_tables import KINDS, cascade_from, notch_from, with_gains_of_notch
from ambjax.cases.named_files import CaseFiles, NamedFile
from ambjax.cases.own_laws import OwnLaw
from ambjax.cases.reach import check_reference
from ambjax.cases.scenario_tables import check_start, scenario_from
from ambjax.cases.table import FILE, Table, check_depth, cut, load, put, require_file, text_of
from ambjax.cases.timing import clock_from
from ambjax.cases.variation import spread_from
from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import Spread, corners, ends
from ambjax.linear.analysis import Zones
from ambjax.numerics.declared import require_number
from ambjax.simulation.clock import PARTS, Clock
from ambjax.simulation.method import with_method
from ambjax.simulation.metrics import settled
from ambjax.simulation.sliding import Slide, slides
from ambjax.simulation.system import check_parts
from ambjax.text.words import one_line
from ambjax.world.bearing import Bearing
from ambjax.world.magnet import Iron
from ambjax.world.plant import Plant, TwoCoil
from ambjax.world.scenario import Scenario

T = TypeVar("T")

PLANTS: dict[str, type] = {"lumped": Plant, "two-coil": TwoCoil}
TABLES = [
    "plant",
    "rotor",
    "controller",
    "processor",
    "reference",
    "disturbance",
    "sensor",
    "actuator",
    "initial",
    "clock",
    "run",
    "spread",
    "sensitivity",
]
OTHERS = ["tune"]  # read by the tuner, ignored by the other commands
# A case name appears in titles, paths, tables and pages. UNSAFE: characters that are replaced in it. LONGEST_NAME: its
# largest length.
UNSAFE, LONGEST_NAME = re.compile(r"[^\w.+() -]+"), 80


@dataclasses.dataclass(frozen=True)
class Case:
    """The contents of a case file.

    `clock`: its integration method is valid for all values of the spread. `settle`: time from which
    "settled" metrics count, s. `text`: the file as it was read. `own_laws`: the custom laws that the file names.
    `zones`: range and limits of the sensitivity. `files`: the linear controller and the recorded signals that it names.

    A case is a pytree of its cascade, scenario and clock, so it is an argument of functions under jit and vmap.
    """

    name: str
    cascade: Cascade
    scenario: Scenario
    clock: Clock
    settle: float
    spread: Spread = Spread()
    text: str = ""
    own_laws: tuple[OwnLaw, ...] = ()
    zones: Zones = Zones()
    files: tuple[NamedFile, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in {"name": str, "cascade": Cascade, "scenario": Scenario, "clock": Clock}.items():
            if not isinstance(value := getattr(self, name), kind):
                raise ValueError(f"Case.{name} = {cut(repr(value))}: it must be a {kind.__name__}.")
        require_number("Case.settle", self.settle, 0)

    def _repr_html_(self) -> str:
        parts = parts_of(self.cascade, self.scenario, self.clock)
        parts |= {"spread": ", ".join(self.spread.paths)} if self.spread.paths else {}
        return notebook_table(self.name, ("part", "numbers"), parts.items())


class _Facts(dict[str, Any]):
    """The other fields of a case. Two are equal if each field is the same object: arrays have no hash."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Facts) and all(map(operator.is_, self.values(), other.values()))

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(tuple(map(id, self.values())))


def _flatten(case: Case) -> tuple[list[tuple[Hashable, object]], _Facts]:
    facts = _Facts(vars(case))
    return [(jax.tree_util.GetAttrKey(name), facts.pop(name)) for name in PARTS], facts


def _unflatten(facts: _Facts, parts: Iterable[object]) -> Case:
    case = object.__new__(Case)  # without the checks: JAX puts other things than numbers into a tree
    case.__dict__.update(facts, **dict(zip(PARTS, parts, strict=True)))
    return case


jax.tree_util.register_pytree_with_keys(Case, _flatten, _unflatten)


def read_case(path: str | pathlib.Path | Mapping[str, Any]) -> Case:
    """Read and check the case file at `path`, or a dict of tables, and return the case.

    Raises ValueError, one line, if `path` is neither, if the file cannot be read, or if any part of it is invalid.
    """
    return read_by(case_from, path)


def read_by(parse: Callable[..., T], path: str | pathlib.Path | Mapping[str, Any]) -> T:
    """Return parse(tables, name, text, folder) of the case file at `path`, or parse(tables) with the text of a dict.

    Raises ValueError as `read_case` does.
    """
    if isinstance(path, Mapping):
        return dataclasses.replace(parse(dict(path)), text=text_of(path))  # pyright: ignore[reportArgumentType]
    require_file("path", path, f"{FILE}, or a dict of tables")
    path = pathlib.Path(path)
    raw, text = load(path)
    try:
        return parse(raw, path.stem, text, path.parent)
    except ValueError as error:
        raise ValueError(one_line(f"{path}: {error}")) from None


def is_machine(raw: dict[str, Any]) -> bool:
    """Return whether a parsed case file describes a whole machine."""
    return "bearing" in raw or (isinstance(raw.get("rotor"), dict) and "kind" in raw["rotor"])


def safe_name(text: str) -> str:
    """Return the text as a case name: with unsafe characters replaced, and cut to LONGEST_NAME characters."""
    return UNSAFE.sub("_", text)[:LONGEST_NAME].strip() or "case"


def case_from(
    raw: dict[str, Any],
    name: str = "case",
    text: str = "",
    folder: pathlib.Path = pathlib.Path(),
    known: Case | None = None,
) -> Case:
    """Return the case of a parsed TOML document `raw` with source `text`. Raises ValueError as `read_case` does.

    `folder`: the folder of the case file; paths of custom laws, controllers and recorded signals are relative to it.
    `known`: a case that names the same files; they are not read again.
    """
    check_depth(raw)
    top = Table(raw)
    if is_machine(raw):
        raise ValueError(
            "[rotor], [[bearing]]: a whole machine, and this takes one axis. `ambjax simulate`, `check`, "
            "`sensitivity`, `campbell`, `ensemble`, `map`, `compare` and `tune` take machines; in Python, read_machine "
            "does."
        )
    top.only([*TABLES, *OTHERS])
    plant = _plant(top.table("plant"))
    clock, duration = clock_from(top.table("clock"))
    files = CaseFiles(folder, known)
    cascade = cascade_from(top, plant, clock.sample_period, files)
    scenario, settle = scenario_from(top, plant, files)
    check_parts(cascade, scenario, clock.sample_period)
    if isinstance(clock.method, Slide) and scenario.stop is not None:
        raise ValueError('clock.method = "sliding": it does not resolve run.stop_stiffness. Use method = "adaptive".')
    if isinstance(clock.method, Slide) and not slides(cascade, scenario):
        made = " or ".join(f'"{kind}"' for kind, law in KINDS["inversion"].items() if law.slides)
        raise ValueError(
            f'clock.method = "sliding": it needs controller.inversion.kind = {made}, continuous time, a lumped plant '
            "without [plant.iron], "
            'an observer other than "ired-1" and "ired-2", and actuator.mode = "voltage". Leave out clock.method.'
        )
    check_start(scenario)
    cascade = dataclasses.replace(cascade, notch=notch_from(top, scenario))
    settle = duration / 4 if settle is None else settled(settle, clock)
    spread = spread_from(top, cascade, scenario)
    cascade = with_gains_of_notch(cascade, scenario, clock, spread)
    check_reference(spread, cascade, scenario, clock)
    clock = with_method(clock, *corners(spread, cascade, scenario))
    if cascade.sampled:
        latest = ends(spread, cascade, scenario, ("processor.",))[0].timing.delay
        cascade = cascade.on_processor(latest, between="processor.delay" in spread.paths)
    zones = top.table("sensitivity").record(Zones)
    zones.check(clock.sample_period if cascade.sampled else None)
    own, read, name = tuple(files.own_laws), tuple(files.files), safe_name(name)
    return Case(name, cascade, scenario, clock, settle, spread, text, own, zones, read)


def is_as_written(case: Case) -> bool:
    """Return whether the numbers of a case are those of its text, so that it was not changed after it was read.

    The gains of a notch are not compared: they follow from the other numbers.
    """
    read = case_from(tomllib.loads(case.text), case.name, known=case)
    parts = ([getattr(one, name) for name in PARTS] for one in (read, case))
    (a, known), (b, given) = map(jax.tree_util.tree_flatten_with_path, parts)
    same = all(getattr(read, name) == getattr(case, name) for name in ("settle", "spread", "zones"))
    both = [(jax.tree_util.keystr(path), x, y) for (path, x), (_, y) in zip(a, b, strict=False)]
    return same and known == given and all(np.array_equal(x, y) for path, x, y in both if ".notch.gains" not in path)


def cascade_at(case: Case, period: float, changes: Mapping[str, float]) -> Cascade:
    """Return the cascade that the file of a case gives with other numbers, without a notch.

    `period`: sample period, s. `changes`: numbers of controller and processor by dotted path.
    """
    raw = tomllib.loads(case.text)
    for path, value in changes.items():
        put(raw, path.split("."), value)
    top = Table(raw)
    return cascade_from(top, _plant(top.table("plant")), period, CaseFiles(known=case))


def _plant(table: Table) -> Bearing:
    kind = table.choice("kind", list(PLANTS), next(iter(PLANTS)))
    plant = table.record(PLANTS[kind], extra=("kind", "iron"))
    if "iron" not in table.raw:
        return plant
    return dataclasses.replace(plant, iron=table.table("iron").record(Iron))
