"""The case file: every table and key with unit, default, range and meaning; laws, signals and spreads by kind."""

import dataclasses
import re
import tomllib
from typing import Any

from ambjax.cases.controller_tables import KINDS, PHASE
from ambjax.cases.reader import OTHERS, TABLES, case_from
from ambjax.cases.scenario_tables import FIELDS, SETTLE, SIGNALS, STOP
from ambjax.cases.speed_table import OWN_SPEED, RUN_UP
from ambjax.cases.table import Table
from ambjax.cases.template_text import template
from ambjax.cases.timing import DURATION
from ambjax.cases.variation import DISTRIBUTIONS
from ambjax.control.guard import Guard
from ambjax.control.processor import Processor
from ambjax.control.synchronous_notch import SynchronousNotch
from ambjax.ensemble.distributions import SHAPES
from ambjax.ensemble.paths import places
from ambjax.linear import Zones
from ambjax.world.amplifier import Amplifier, CoilLimits
from ambjax.world.faults import Dropouts, Outliers
from ambjax.world.magnet import Iron
from ambjax.world.plant import Plant
from ambjax.world.rotation import Rotation, Runout
from ambjax.world.scenario import Initial
from ambjax.world.sensor import Sensor
from reference.fields import Facts, facts
from reference.markdown import code, escaped, first_paragraph, paragraphs, table
from reference.parser import keys, remarks, rule

TITLES = ("key", "unit", "default", "allowed", "meaning")
RECORDS: dict[str, type] = {"plant": Plant, "processor": Processor, "initial": Initial, "sensor": Sensor}
RECORDS |= {"rotor": Rotation, "controller.notch": SynchronousNotch}
RECORDS |= {"actuator": Amplifier, "actuator.coil": CoilLimits, "processor.guard": Guard, "sensitivity": Zones}
RECORDS |= {"plant.iron": Iron, "sensor.outliers": Outliers, "sensor.dropouts": Dropouts, "sensor.runout": Runout}
SETTINGS: dict[str, dataclasses.Field] = {
    "actuator.u_max": FIELDS["u_max"],
    "clock.duration": DURATION,
    "clock.sample_period": FIELDS["sample_period"],
    "run.clearance": FIELDS["clearance"],
    "run.settle": SETTLE,
    "run.stop_stiffness": STOP["stiffness"],
    "run.stop_damping": STOP["damping"],
    "controller.notch.phase": PHASE,
}
_SPEED = {field.name: field for field in dataclasses.fields(Rotation)} | {"duration": RUN_UP}
SETTINGS |= {f"sensor.runout.{key}": _SPEED[key] for key in OWN_SPEED}
# Meaning of each table, and its default.
WORDS = {
    "plant": "The true plant. A key that is left out has its value in Table 1 of the paper.",
    "plant.iron": "Saturation, leakage and eddy currents of the magnets. Default: ideal iron. See "
    "[the magnet](../magnet.md#iron).",
    "controller": "The cascade: a nominal plant and one law per stage. [Laws](laws.md) lists kinds and gains; a law "
    "may also be a [custom law](../own-laws.md). A table instead of the number of a gain is a "
    "[schedule](../schedules.md).",
    "controller.position.file": "path of an .npz or .mat file with the arrays A, B, C, D and dt (s; 0: continuous), "
    "relative to the folder of the case file",
    "controller.position.output": "quantity that the controller returns: a current (A) or a voltage (V)",
    "controller.model": "Parameters of the controller's model that differ from the plant: any key of `[plant]`.",
    "rotor": "The speed of the rotor. Unbalance, runout and the notch of the controller share its angle. Default: the "
    "rotor does not turn. See [once per revolution](../loads.md#once-per-revolution). With `kind`, the table describes "
    "the rotor of a [whole machine](../machine-reference.md).",
    "controller.notch": "The synchronous notch: it removes the speed of `[rotor]` from the current or from z. Default: "
    "no notch. See [once per revolution](../loads.md#notch).",
    "processor": "The processor of the controller: all laws make one step per sample. Their voltage acts after "
    "a delay and is held for one sample. Default: continuous time, as in the paper. See "
    "[the processor](../processor.md).",
    "processor.guard": "Limits of the readings. A reading beyond its limit is replaced by a prediction. A limit that "
    "is left out is derived from the case. `guard = false` in `[processor]` accepts every reading. See "
    "[the guard](../processor.md#the-guard).",
    "reference": "The position that z must follow, in m. Default: 0. See [signals](signals.md).",
    "disturbance": "The disturbances. Each is a signal, or a list of signals (`[[disturbance.q_z]]`), which are added. "
    "`q_z` acts on the rotor, `q_i` on the current; `base` is the acceleration of the housing. Default: none. See "
    "[loads](../loads.md) and [signals](signals.md).",
    "sensor": "Errors of the sensors. The noise is drawn once per sample period and held. Default: z, z_dot and i are "
    "measured without error.",
    "sensor.outliers": "Single wrong readings of the position. See [faults](../sensors.md#faults).",
    "sensor.dropouts": "Intervals without a reading of the position. See [faults](../sensors.md#faults).",
    "sensor.runout": "Runout of the surface that the position sensor reads. It turns with `[rotor]`; only a case "
    "without `[rotor]` gives a speed here. See [runout](../loads.md#runout).",
    "sensor.runout.speed": "left out: that of [rotor]",
    "actuator": "The supply and the amplifier. Default: both are ideal.",
    "actuator.coil": "Limits of the voltage and of the current of each coil. Default: none. See "
    "[limits of each coil](../magnet.md#coil-limits).",
    "initial": "State of the plant at t = 0. Default: at rest at z = 0.",
    "clock": "Duration, sample period and integrator.",
    "run": "Seed, settling time, and clearance with its stop.",
    "sensitivity": "Frequency range and zones of `ambjax sensitivity`. See [sensitivity](../sensitivity.md).",
    "spread": "The numbers that vary between the members of an ensemble. See [spreads](spread.md).",
    "tune": "Settings of `ambjax tune`. The other commands ignore this table. See [tuning](../tuning.md).",
    "tune.weights": "Weights of the terms of the loss, which are dimensionless.",
    "tune.limits": "Limits that the held-out members must meet. See [limits](../limits.md).",
}
# Meaning of the keys of signals that are not fields of a record.
KEYS = {
    "file": "path, relative to the case file",
    "columns": "names of the columns of time and value; left out: the two columns of the file",
    "interpolation": "linear between the values, or each value held until the next time",
}
LEFT_OUT = re.compile(r"[(;]? ?left out: (?P<default>[^;)]*)\)?")
CHOICE = re.compile(r"one of '(?P<default>[^']*)'")
UNIT = re.compile(r"(?P<unit>1|m|s|A|V|kg|[\w^./]+/[\w^./]+)(; (?P<rest>.*))?")


def pages() -> dict[str, str]:
    """Return the pages by file name."""
    return {"case-file.md": _case_file(), "laws.md": _laws(), "signals.md": _signals(), "spread.md": _spread()}


def rows_of(path: str, record: type | None = None, beside: dict[str, Any] | None = None) -> list[Facts]:
    """Return a row for each key of a table; the fields come from `record`, or else from the template."""
    known = {field.name: field for field in dataclasses.fields(record)} if record else {}
    order = list(remarks())
    paths = [f"{path}.{key}" for key in keys(path, beside)]
    if not record:  # in the order of the template, because some meanings refer to earlier ones
        paths.sort(key=lambda one: next((n for n, known in enumerate(order) if f"{known}.".startswith(f"{one}.")), -1))
    return [_row(one, known.get(one.rpartition(".")[2]), beside) for one in paths]


def _row(path: str, field: dataclasses.Field | None, beside: dict[str, Any] | None) -> Facts:
    key, described = path.rpartition(".")[2], _described(path)
    field = field or SETTINGS.get(path)
    allowed = _allowed(path, beside)
    if field is not None and field.metadata.get("leaf"):
        row = facts(field)._replace(name=key)
        known = path in SETTINGS and described.default
        if (row.default == "" and described.default == "") or (field.default is dataclasses.MISSING and not known):
            return row._replace(default="none" if field.metadata["optional"] else "required")
        return row._replace(default=described.default if known else row.default)
    first = CHOICE.search(allowed)
    return described._replace(name=key, allowed=allowed, default=first["default"] if first else described.default)


def _allowed(path: str, beside: dict[str, Any] | None) -> str:
    """Return the values that the reader allows for a key."""
    if path == "tune.alpha":
        return rule(path, {"risk": "cvar"})
    if path == "clock.method":
        return f'with dt = "auto" {rule(path)}; with a number {rule(path, {"dt": 1e-4})}'
    return rule(path, beside)


def _described(path: str) -> Facts:
    """Return unit, default and meaning of a key from the template."""
    known = remarks()
    below = next((one for one in known if one.startswith(f"{path}.")), path)
    shown, meaning = ("", WORDS[path]) if path in WORDS else known.get(path, known.get(below, ("", "")))
    if path.startswith("reference."):
        meaning = KEYS.get(path.rpartition(".")[2], meaning)
    unit = ""
    if (begun := UNIT.fullmatch(meaning)) is not None:
        unit, meaning = begun["unit"], begun["rest"] or ""
    default = shown.strip('"')
    if (other := LEFT_OUT.search(meaning)) is not None:
        default = other["default"].strip('"')
        meaning = LEFT_OUT.sub("", meaning).strip()
    return Facts(path.rpartition(".")[2], "" if unit == "1" else unit, default, "", meaning)


def keys_table(rows: list[Facts]) -> list[str]:
    """Return rows as a Markdown table."""
    cells = [(code(row.name), *map(escaped, row[1:])) for row in rows]
    return table(TITLES, cells, "keys")


def _case_file() -> str:
    lines = [
        "# The case file",
        "",
        "A case file is TOML, in SI units. An unknown key, a wrong type or a number out of range gives an error "
        "message of one line. `ambjax template` prints a file with all keys. If a key allows several words, the first "
        "is the default.",
        "",
    ]
    for name in [*TABLES, *OTHERS]:
        lines += _section(name)
        if name == "controller":
            lines += _section("controller.model")
        if name == "disturbance":
            lines += _units()
        for below in (one for one in RECORDS if one.startswith(f"{name}.")):
            lines += _section(below)
    return "\n".join([*lines, *_section("tune.weights"), *_section("tune.limits")])


def _section(path: str) -> list[str]:
    lines = [f"## `[{path}]`", "", WORDS[path], ""]
    if path in ("controller", "controller.model", "reference", "disturbance", "spread"):
        return lines
    return lines + keys_table(rows_of(path, RECORDS.get(path)))


def _units() -> list[str]:
    rows = [
        (code(f"disturbance.{name}"), escaped(rule(f"disturbance.{name}.unit", {"kind": "constant"})))
        for name in keys("disturbance")
    ]
    return table(("table", "allowed values of its key `unit`; the first is the default"), rows, "keys")


def _laws() -> str:
    lines = ["# Laws", "", "One law per stage, chosen by `kind`; the first of each stage is the default."]
    lines += ['`kind = "FILE.py:CLASS"` is a [custom law](../own-laws.md).', ""]
    for stage, kinds in KINDS.items():
        lines += [f"## `[controller.{stage}]`", ""]
        for kind, law in kinds.items():
            lines += [f'### `kind = "{kind}"`', "", f"{{py:class}}`{law.__module__}.{law.__qualname__}`", ""]
            lines += paragraphs(law)
            rows = [row for row in rows_of(f"controller.{stage}", law, {"kind": kind}) if row.name != "kind"]
            lines += keys_table(rows) if rows else ["No gains.", ""]
    return "\n".join(lines)


def _signals() -> str:
    lines = [
        "# Signals",
        "",
        "A signal is a function of time. `[reference]` (in m) and the tables of `[disturbance]` contain signals. An "
        "amplitude, a value or a standard deviation has the unit of the reference or of the disturbance. See "
        "[loads](../loads.md).",
        "",
    ]
    for kind, signal in SIGNALS.items():
        lines += [f'## `kind = "{kind}"`', "", f"{{py:class}}`{signal.__module__}.{signal.__qualname__}`", ""]
        lines += paragraphs(signal)
        lines += keys_table([r for r in rows_of("reference", signal, {"kind": kind}) if r.name != "kind"])
    return "\n".join(lines)


def _spread() -> str:
    lines = [
        "# Spreads",
        "",
        "A line `PATH = DISTRIBUTION` in `[spread]` gives a number of the case a distribution over the members of an "
        "ensemble. The key `design` selects the design of experiments, the first being the default: "
        + escaped(rule("spread.design"))
        + ".",
        "",
        "## Distributions",
        "",
    ]
    rows = []
    for kind, make in DISTRIBUTIONS.items():
        made = _example(kind, make)
        shapes = [dataclasses.replace(made, shape=shape) for shape in SHAPES] if hasattr(made, "shape") else [made]
        rows += [(code(str(one)), escaped(first_paragraph(type(one)))) for one in shapes]
    lines += table(("distribution", "meaning"), rows, "keys")
    case = case_from(tomllib.loads(template("tracking")))
    lines += ["## Paths", "", "These numbers of the case that `ambjax template` prints can vary:", ""]
    lines += [f"- {code(path)}" for path in places(case.cascade, case.scenario)]
    return "\n".join([*lines, ""])


def _example(kind: str, make: Any) -> Any:
    """Return an example of a distribution of this kind, for one number or for several."""
    try:
        return make(Table({kind: 10.0}))
    except ValueError:
        return make(Table({kind: [1.0, 2.0]}))
