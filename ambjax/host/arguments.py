"""Messages that name the options of a command, reworded to name the arguments of a Python function."""

import functools
import inspect
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
# An option of the command line, such as --settings-of.
OPTION = re.compile(r"--([a-z][a-z-]*)")


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
