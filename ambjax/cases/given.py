"""What a function of Python is given: a case, and arguments, which its errors name instead of options."""

import contextlib
import functools
import inspect
import re
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.cases.table import cut
from ambjax.compiler.barrier import as_outside_jit
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import require_concrete
from ambjax.numerics.shapes import require_one_member
from ambjax.simulation.clock import Clock, TakesCase, no_case
from ambjax.simulation.method import with_method
from ambjax.simulation.metrics import settled
from ambjax.simulation.system import check_parts, require_records
from ambjax.world.scenario import Scenario

P = ParamSpec("P")
R = TypeVar("R", covariant=True)
C = TypeVar("C", contravariant=True)
# An option of the command line, such as --settings-of.
OPTION = re.compile(r"--([a-z][a-z-]*)")


def of_case(
    *, machines: bool = False, traced: bool = False
) -> Callable[[Callable[Concatenate[C, P], R]], TakesCase[C, P, R]]:
    """Return a decorator for a function of a case, which then also accepts a cascade, a scenario and a clock.

    The function raises ValueError for anything else, such as a path. `machines`: whether it takes a `MachineCase`.
    `traced`: whether the numbers of a case may be traced.
    """

    def decorate(function: Callable[Concatenate[C, P], R]) -> TakesCase[C, P, R]:
        @functools.wraps(function)
        def called(*args: Any, **named: Any) -> R:
            with contextlib.nullcontext() if traced else as_outside_jit():
                if args and isinstance(args[0], Cascade):
                    args = (case_of(function.__name__, *args[:3]), *args[3:])
                require_case(args[0] if args else named.get("case"), machines=machines, traced=traced)
                return function(*args, **named)

        return cast(TakesCase[C, P, R], called)

    return decorate


def case_of(function: str, *parts: Any) -> Case:
    """Return the case of a cascade, a scenario and a clock. Metrics are settled after a quarter of the run.

    `function`: its name, for the message. Raises ValueError for other types, and as `with_method` does.
    """
    kinds = (Cascade, Scenario, Clock)
    if len(parts) < len(kinds) or not all(isinstance(x, kind) for x, kind in zip(parts, kinds, strict=True)):
        raise no_case(function, *parts)
    cascade, scenario, clock = parts
    require_concrete("case", parts)
    check_parts(cascade, scenario, clock.sample_period)
    clock = with_method(clock, cascade, scenario)
    cascade = cascade.on_processor() if cascade.sampled else cascade
    last = float(clock.duration) - float(clock.sample_period)
    return Case("case", cascade, scenario, clock, min(float(clock.duration) / 4, last))


def require_case(case: object, *, machines: bool = False, traced: bool = False) -> None:
    """Raise ValueError for anything but a `Case` of one member, or with `machines` a `MachineCase`.

    Also raises it if the case ends before it settles. `traced`: whether the numbers may be traced.
    """
    if isinstance(case, MachineCase):
        if not machines:
            raise ValueError("case = MachineCase: this function takes a case of one axis, from ambjax.read_case.")
    elif not isinstance(case, Case):
        raise ValueError(f"case = {cut(repr(case))}: it must be a Case, as ambjax.read_case(PATH) returns it.")
    elif not traced:
        require_concrete("case", (case.cascade, case.scenario, case.clock))
    if isinstance(case, Case):
        require_records("scenario", case.scenario)
        require_one_member({"controller": case.cascade, "scenario": case.scenario, "clock": case.clock})
    settled(case.settle, case.clock)


def names_arguments(**others: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for the function of a command: its ValueErrors name arguments instead of options.

    `--settings-of X: ...` becomes `settings_of = X: ...`, and `--resume`, whose argument has the default False, becomes
    `resume=True`. An option that is no argument of the function stays. `others`: names of arguments
    by name of their option, where the two differ.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        known = inspect.signature(function).parameters

        def argument(option: re.Match[str]) -> str:
            name = others.get(option[1], option[1].replace("-", "_"))
            if name not in known:
                return option[0]
            return f"{name}=True" if known[name].default is False else name

        @functools.wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return function(*args, **kwargs)
            except ValueError as error:
                text = str(error)
                first = OPTION.match(text)
                name = "" if first is None else argument(first)
                if first is not None and text[first.end() :].startswith(" ") and name in known:
                    name, text = f"{name} =", text[first.end() :]
                elif first is not None:
                    text = text[first.end() :]
                error.args = (name + OPTION.sub(argument, text),)
                raise

        return called

    return decorate
