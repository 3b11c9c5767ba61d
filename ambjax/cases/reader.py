"""Reader of case files: from TOML to a cascade, a scenario and a clock.

The reader is strict. An unknown key, a wrong type, a number out of bounds or a contradiction of two settings raises a
ValueError with one line: the dotted path, the value, what is allowed and the fix.
"""

import dataclasses
import pathlib
import re
from typing import Any

from ambjax.cases.own_laws import FORM, OwnLaw, is_own, own_law
from ambjax.cases.reach import check_reference
from ambjax.cases.scenario_tables import check_start, scenario_from
from ambjax.cases.table import Table, check_depth, load
from ambjax.cases.timing import clock_from, settled
from ambjax.cases.variation import spread_from
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import Law, default_law
from ambjax.control.cascade import Cascade
from ambjax.control.guard import Guard
from ambjax.control.processor import Processor
from ambjax.ensemble.spread import Spread, corners, ends
from ambjax.host.words import one_line
from ambjax.linear.analysis import Zones
from ambjax.numerics.records import Scalar
from ambjax.simulation.clock import Clock
from ambjax.simulation.method import with_method
from ambjax.simulation.sliding import Slide, slides
from ambjax.simulation.system import check_parts
from ambjax.world.bearing import Bearing
from ambjax.world.coils import TwoCoil
from ambjax.world.plant import Plant
from ambjax.world.scenario import Scenario

# The laws by stage and kind; the first of a stage is the default. A new law is one row here.
KINDS: dict[str, dict[str, type[Law]]] = {
    "observer": {
        "direct": observer.Direct,
        "complementary": observer.Complementary,
        "difference": observer.Difference,
        "kalman": observer.Kalman,
        "ired-1": observer.IRED1,
        "ired-2": observer.IRED2,
    },
    "position": {
        "sliding-mode": position.SlidingMode,
        "integral-sliding-mode": position.IntegralSlidingMode,
        "super-twisting": position.SuperTwisting,
        "utkin-sliding-mode": position.UtkinSlidingMode,
        "terminal-sliding-mode": position.TerminalSlidingMode,
        "pid": position.PID,
        "feedback-linearisation": position.FeedbackLinearisation,
        "state-feedback": position.StateFeedback,
        "chain": position.FilterChain,
    },
    "inversion": {
        "adaptive": inversion.Adaptive,
        "adaptive-feed-forward": inversion.FeedForwardAdaptive,
        "closed-form": inversion.ClosedForm,
        "linearised": inversion.Linearised,
    },
    "current": {"sliding-mode": current.SlidingMode, "pi": current.ProportionalIntegral, "dead-beat": current.DeadBeat},
}
PLANTS: dict[str, type] = {"lumped": Plant, "two-coil": TwoCoil}
DISCRETISATIONS = ["implicit", "explicit"]
TABLES = [
    "plant",
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
(DELAY,) = (field for field in dataclasses.fields(Processor) if field.name == "delay")
# Characters that are replaced in the name of a case, which appears in titles, paths, tables and pages; its length.
UNSAFE, LONGEST_NAME = re.compile(r"[^\w.+() -]+"), 80


@dataclasses.dataclass(frozen=True)
class Case:
    """The contents of a case file.

    `clock` has the integration method, given or chosen, that fits every end of the spread. `settle`: time from which
    "settled" metrics count, s. `text`: the file as it was read. `assumed`: names of the plant's parameters that the
    file omits while it gives others; they keep the paper's values. Empty if the file gives all or none. `own_laws`: the
    laws that the file names and that are no part of the package. `zones`: range and limits of the sensitivity.
    """

    name: str
    cascade: Cascade
    scenario: Scenario
    clock: Clock
    settle: float
    spread: Spread = Spread()
    text: str = ""
    assumed: tuple[str, ...] = ()
    own_laws: tuple[OwnLaw, ...] = ()
    zones: Zones = Zones()


def read_case(path: str | pathlib.Path) -> Case:
    """Read and check the case file at `path`, and return the case.

    Raises ValueError, one line, if the file cannot be read or any part of it is invalid.
    """
    path = pathlib.Path(path)
    raw, text = load(path)
    try:
        return case_from(raw, path.stem, text, path.parent)
    except ValueError as error:
        raise ValueError(one_line(f"{path}: {error}")) from None


def safe_name(text: str) -> str:
    """Return the text with unsafe characters of paths, titles, tables and pages replaced, cut to LONGEST_NAME."""
    return UNSAFE.sub("_", text)[:LONGEST_NAME].strip() or "case"


def case_from(
    raw: dict[str, Any],
    name: str = "case",
    text: str = "",
    folder: pathlib.Path = pathlib.Path(),
    own: tuple[OwnLaw, ...] = (),
) -> Case:
    """Return the case of a parsed TOML document `raw` with source `text`. Raises ValueError as `read_case` does.

    `folder`: the folder of the case file; paths of custom laws are relative to it. `own`: such laws that are
    imported already; they are not imported again.
    """
    check_depth(raw)
    top = Table(raw)
    top.only([*TABLES, *OTHERS])
    plant = _plant(top.table("plant"))
    processor = _processor(top.table("processor")) if "processor" in top.raw else None
    clock, duration = clock_from(top.table("clock"))
    period = None if processor is None else clock.sample_period
    cascade, own = _cascade(top.table("controller"), plant, processor, period, folder, own)
    scenario, settle = scenario_from(top, plant)
    check_parts(cascade, scenario)
    if isinstance(clock.method, Slide) and not slides(cascade, scenario.plant):
        made = " or ".join(f'"{kind}"' for kind, law in KINDS["inversion"].items() if law.slides)
        raise ValueError(
            f'clock.method = "sliding": it needs controller.inversion.kind = {made}, continuous time, a lumped plant, '
            'and an observer other than "ired-1" and "ired-2". Use method = "adaptive".'
        )
    check_start(scenario)
    settle = duration / 4 if settle is None else settled(settle, clock)
    spread = spread_from(top, cascade, scenario)
    check_reference(spread, cascade, scenario, clock)
    clock = with_method(clock, *corners(spread, cascade, scenario))
    if (late := ends(spread, cascade, scenario, ("processor.",))[0].processor) is not None:
        cascade = cascade.on_processor(late.delay, between="processor.delay" in spread.paths)
    assumed = _left_out(top.table("plant"), plant)
    zones = top.table("sensitivity").record(Zones)
    zones.check(None if cascade.processor is None else clock.sample_period)
    return Case(safe_name(name), cascade, scenario, clock, settle, spread, text, assumed, own, zones)


def _processor(table: Table) -> Processor:
    table.only(["delay", "discretisation", "predict", "guard"])
    delay = table.leaf("delay", DELAY, DELAY.default)
    implicit = table.choice("discretisation", DISCRETISATIONS, DISCRETISATIONS[0]) == DISCRETISATIONS[0]
    guard = None if table.raw.get("guard") is False else table.table("guard").record(Guard)
    return Processor(delay, implicit, table.switch("predict"), guard=guard)


def _plant(table: Table) -> Bearing:
    kind = table.choice("kind", list(PLANTS), next(iter(PLANTS)))
    return table.record(PLANTS[kind], extra=("kind",))


def _left_out(table: Table, plant: Bearing) -> tuple[str, ...]:
    """Return the names of the plant's parameters that its table omits; none if the table gives no number at all."""
    names = [field.name for field in dataclasses.fields(plant) if field.metadata.get("leaf")]
    left = tuple(name for name in names if name not in table.raw)
    return left if len(left) < len(names) else ()


def _cascade(
    table: Table,
    plant: Bearing,
    processor: Processor | None,
    period: Scalar | None,
    folder: pathlib.Path,
    known: tuple[OwnLaw, ...],
) -> tuple[Cascade, tuple[OwnLaw, ...]]:
    table.only(["model", *KINDS])
    model = table.table("model").record(Plant, base=plant)  # always lumped, even for a two-coil plant
    laws, own = {}, []
    for stage, kinds in KINDS.items():
        law = table.table(stage)
        if is_own(law.raw.get("kind")):
            found = [one for one in known if one.stage == stage]
            own += found or [own_law(stage, law.raw["kind"], folder, model)]
            kind = own[-1].law
        else:
            kind = kinds[law.choice("kind", list(kinds), next(iter(kinds)), FORM)]
        laws[stage] = law.record(kind, extra=("kind",), base=_defaults(law, kind, model, period))
    return Cascade(model=model, processor=processor, **laws), tuple(own)


def _defaults(table: Table, kind: Any, model: Plant, period: Scalar | None) -> Law | None:
    """Return the law of this kind with its default gains; None if the table gives every gain."""
    names = {field.name for field in dataclasses.fields(kind) if field.metadata.get("leaf")}
    if names <= set(table.raw):
        return None
    try:
        return default_law(kind, model, None if period is None else float(period))
    except ValueError as error:
        raise ValueError(f"{table.path}: {error}. Give all of {', '.join(sorted(names))}.") from None
