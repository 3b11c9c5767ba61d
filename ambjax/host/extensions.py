"""Optional packages, and commands that other packages declare, such as that of the tuner."""

import importlib
import importlib.metadata
from collections.abc import Callable
from typing import Any

# Entry-point group in which a package that depends on ambjax declares its command.
GROUP = "ambjax.commands"


def extra(name: str, group: str = "tables") -> Any:
    """Import an optional package by its dotted name. Raises ValueError, naming the extra `group`, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ValueError(f"{package} is not installed. Install it with: pip install 'ambjax[{group}]'.") from None


class NothingToTuneError(ValueError):
    """The case has no gains to tune, or its tune.gains is empty."""


def extension(name: str) -> Callable[..., int]:
    """Return the command declared under `name`.

    The command maps its words and the program's name to an exit code. With `nested=True`, it raises its errors, so that
    the command that calls it can report them.

    Raises ValueError if no installed package declares it.
    """
    found = tuple(importlib.metadata.entry_points(group=GROUP, name=name))
    if not found:
        raise ValueError(f"{name}: this command is not installed. Reinstall ambjax with pip.")
    return found[0].load()
