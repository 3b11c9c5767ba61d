"""Import of optional packages."""

import importlib
from typing import Any


def extra(name: str, group: str = "tables") -> Any:
    """Import an optional package by its dotted name. Raises ValueError, naming the extra `group`, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ValueError(f"{package} is not installed. Install it with: pip install 'ambjax[{group}]'.") from None
