"""Readers of [processor] and of the [controller] tables: the cascade of a case, and its notch."""

import dataclasses
from typing import Any

from ambjax.cases.named_files import CaseFiles, controller_file
from ambjax.cases.own_laws import FORM, is_own, own_law_of
from ambjax.cases.scenario_tables import drive
from ambjax.cases.table import Table, quoted, show
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import Law, default_law
from ambjax.control.cascade import Cascade
from ambjax.control.guard import Guard
from ambjax.control.linear_controller import OUTPUTS
from ambjax.control.processor import Processor
from ambjax.control.sampling import Sampling
from ambjax.control.schedule import OVER, Schedule
from ambjax.control.synchronous_notch import NULLED, SynchronousNotch
from ambjax.ensemble.spread import Spread, ends
from ambjax.linear.notch_design import with_notch_gains
from ambjax.numerics.declared import leaves_of
from ambjax.numerics.records import Scalar, leaf
from ambjax.simulation.clock import Clock
from ambjax.world.bearing import Bearing
from ambjax.world.plant import Plant
from ambjax.world.scenario import Scenario

# The laws by stage and kind. The default of a stage is its first law that fits the amplifier and the position law
# (`_usual`). A new law is one row here.
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
        "linear": position.LinearController,
    },
    "inversion": {
        "adaptive": inversion.Adaptive,
        "adaptive-feed-forward": inversion.FeedForwardAdaptive,
        "closed-form": inversion.ClosedForm,
        "linearised": inversion.Linearised,
    },
    "current": {
        "sliding-mode": current.SlidingMode,
        "pi": current.ProportionalIntegral,
        "dead-beat": current.DeadBeat,
        "open-loop": current.OpenLoop,
        "amplifier": current.AmplifierCurrent,
    },
}
DISCRETISATIONS = ["implicit", "explicit"]
(DELAY,) = (field for field in dataclasses.fields(Processor) if field.name == "delay")

# The kind of a notch that switches it off, for example on one bearing.
OFF = "none"
NOTCH_NUMBERS = ("rate", "min_speed", "max_speed")
PHASE = leaf(
    default=None, unit="degrees", at_least=-360.0, at_most=360.0,
    doc="phase of the response that the notch inverts; none: that of the linear loop at each speed",
)  # fmt: skip


def _processor(table: Table) -> Processor:
    table.only(["delay", "discretisation", "predict", "guard"])
    delay = table.leaf("delay", DELAY, DELAY.default)
    implicit = table.choice("discretisation", DISCRETISATIONS, DISCRETISATIONS[0]) == DISCRETISATIONS[0]
    guard = None if table.raw.get("guard") is False else table.table("guard").record(Guard)
    return Processor(delay, implicit, table.switch("predict"), guard=guard)


def cascade_from(top: Table, plant: Bearing, period: Scalar, files: CaseFiles) -> Cascade:
    """Return the cascade of [processor] and [controller]. Its custom laws and its linear controller join `files`.

    `top`: the whole case. `plant`: the true plant; its numbers are the defaults of the model. `period`: sample period,
    s. Raises ValueError, one line, for an invalid entry.
    """
    processor = _processor(top.table("processor")) if "processor" in top.raw else None
    table, actuator = top.table("controller"), top.table("actuator")
    command = drive(actuator)
    table.only(["model", "notch", *KINDS])
    model = table.table("model").record(Plant, base=plant)  # always lumped, even for a two-coil plant
    sampling = processor.sampling(period) if processor else None
    laws: dict[str, Any] = {}
    for stage, kinds in KINDS.items():
        law = table.table(stage)
        if is_own(law.raw.get("kind")):
            known = [one for one in files.known.own_laws if one.stage == stage] if files.known else []
            files.own_laws += known or [own_law_of(stage, law.raw["kind"], files.folder, model)]
            kind: Any = files.own_laws[-1].law
        else:
            kind = kinds[law.choice("kind", list(kinds), _usual(kinds, laws.get("position"), command), FORM)]
            _check_default(law, kind, kinds)
        if kind is position.LinearController:
            laws[stage] = _linear(law, files)
        else:
            # the paper's gains of the inner loops belong to its position law
            printed = type(laws["position"]).printed if "position" in laws else kind.printed
            base = _defaults(law, kind, model, sampling, printed)
            if getattr(kind, "commands", "") == "current" and "bandwidth" in actuator.raw:  # by default, that bandwidth
                law = Table({"bandwidth": actuator.raw["bandwidth"], **law.raw}, law.path)
            laws[stage] = law_from(law, kind, base)
    return Cascade(model=model, processor=processor, **laws)


def _check_default(law: Table, kind: type[Law], kinds: dict[str, type[Law]]) -> None:
    """Raise ValueError if the table omits its kind, and its keys fit other laws but not the default law, `kind`."""
    others = [word for word, one in kinds.items() if law.raw.keys() <= _gains(one)]
    unknown = next((key for key in law.raw if key not in _gains(kind)), None)
    if "kind" not in law.raw and unknown is not None and others:
        default = next(word for word, one in kinds.items() if one is kind)
        raise ValueError(
            f"{law.at(unknown)} = {show(law.raw[unknown])}: {law.at('kind')} is left out, so the law is '{default}', "
            f"which has no such key. Set {law.at('kind')}. These keys fit {quoted(others)}."
        )


def _gains(kind: type[Law]) -> set[str]:
    return {field.name for field in leaves_of(kind)}


def _usual(kinds: dict[str, type[Law]], demanding: Any, command: str) -> str:
    """Return the default kind of a stage.

    It is the first law that fits the amplifier: if the law has an attribute `commands`, this must equal `command`,
    "voltage" or "current". Among these laws, those that accept the demand of the position law `demanding` come first.
    `demanding` is None until the position law is known.
    """
    fitting = [kind for kind, law in kinds.items() if getattr(law, "commands", command) == command]
    if demanding is None:
        return fitting[0]
    accepting = [kind for kind in fitting if demanding.demand in getattr(kinds[kind], "accepts", (demanding.demand,))]
    return [*accepting, *fitting][0]


def _linear(table: Table, files: CaseFiles) -> Law:
    law = table.record(position.LinearController, extra=("kind", "file", "output"))
    output = table.choice("output", list(OUTPUTS), OUTPUTS[0])
    contents = files.contents(table.at("file"), lambda: controller_file(table, files.folder))
    return dataclasses.replace(law, output=output, realisation=contents)


def _defaults(table: Table, kind: type[Law], model: Plant, sampling: Sampling | None, printed: bool) -> Law | None:
    """Return the law of this kind with its default gains; None if the table gives every gain."""
    names = _gains(kind)
    if names <= set(table.raw):
        return None
    try:
        return default_law(kind, model, sampling, table.raw, printed)
    except ValueError as error:
        raise ValueError(f"{table.path}: {error}. Give all of {', '.join(sorted(names))}.") from None


EXAMPLE = '{ over = "error", at = [0.0, 1e-5], values = [100.0, 200.0] }'


def law_from(table: Table, kind: type[Law], base: Law | None) -> Any:
    """Return a law of this kind with the gains of this table. `base`: law with the defaults; None: those of `kind`."""
    names = {field.name: field for field in leaves_of(kind)}
    given = {name: table.raw[name] for name in names if isinstance(table.raw.get(name), dict)}
    numbers = Table({key: value for key, value in table.raw.items() if key not in given}, table.path)
    law = numbers.record(kind, extra=("kind",), base=base)
    found = {name: _schedule(Table(raw, table.at(name))) for name, raw in given.items()}
    for name, one in found.items():
        one.check(names[name], table.at(name))
    return dataclasses.replace(law, **found)


def _schedule(table: Table) -> Schedule:
    table.only(["over", "at", "values"])
    over, words = table.choice("over", list(OVER)), f"a list of numbers, as in {EXAMPLE}"
    values, at = (tuple(table.column(key, words)) for key in ("values", "at"))
    return Schedule(values, at=at, over=over)


def notch_from(top: Table, scenario: Scenario) -> SynchronousNotch | None:
    """Return the notch of [controller.notch] without its gains; None if there is no notch."""
    controller = top.table("controller")
    if "notch" not in controller.raw:
        return None
    table, rotor = controller.table("notch"), scenario.rotor
    table.only(["kind", *NOTCH_NUMBERS, "phase"])
    kind, phase = table.choice("kind", [*NULLED, OFF], next(iter(NULLED))), table.leaf("phase", PHASE)
    if kind == OFF:
        return None
    varying = rotor is not None and (rotor.acceleration != 0 or bool(rotor.changes))
    if rotor is None or (rotor.speed == 0 and not varying):
        raise ValueError("[controller.notch]: it follows the speed of the rotor. Give rotor.speed, in rpm.")
    given = Table({key: table.raw[key] for key in NOTCH_NUMBERS if key in table.raw}, table.path)
    notch = given.record(SynchronousNotch)
    return dataclasses.replace(notch, removes=kind, rotor=rotor, varying=varying, phase=phase)


def with_gains_of_notch(cascade: Cascade, scenario: Scenario, clock: Clock, spread: Spread) -> Cascade:
    """Return the cascade with the gains of its notch, if it has one, for all speeds of the spread.

    Raises ValueError if its loop has no linearisation.
    """
    rotor = ends(spread, cascade, scenario, ("rotor.",))[1].rotor
    if cascade.notch is None or rotor is None:
        return cascade
    try:
        return with_notch_gains(cascade, scenario, clock, rotor)
    except ValueError as error:
        raise ValueError(f"[controller.notch]: its gain cannot be computed: {error}") from None
