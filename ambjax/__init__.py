"""Differentiable simulation of an active-magnetic-bearing rotor under a cascaded sliding-mode controller.

`__init__.pyi` lists the public names for type checkers. Here each is imported on first use, so that `import ambjax` and
`ambjax --version` do not import JAX.
"""

import ast
import importlib
import pathlib
import sys
from typing import Any

_FOLDER = pathlib.Path(__file__).parent
_RENAMED = {"Outcome": "Result", "Standard": "Metrics"}  # former names


def _imported(path: pathlib.Path) -> dict[str, str]:
    """Return the module of each name that a file imports."""
    lines = [node for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in lines for alias in node.names}


def _elsewhere(name: str) -> str:
    """Return a sentence with the public name of what `ambjax.NAME` may mean, or ""."""
    found = [f"ambjax.{_RENAMED[name]}"] if name in _RENAMED else []
    for space in (space for space, home in _MODULES.items() if home == "ambjax"):
        path = _FOLDER / space
        if name in _imported(path / "__init__.py" if path.is_dir() else path.with_suffix(".py")):
            found.append(f"ambjax.{space}.{name}")
    return f". Use {' or '.join(found)}." if found else ""


_MODULES = _imported(_FOLDER / "__init__.pyi")
__all__ = sorted(name for name, module in _MODULES.items() if module != "ambjax")  # pyright: ignore


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        text = f"module 'ambjax' has no attribute '{name}'{_elsewhere(name)}"
        raise AttributeError(text, name=name, obj=sys.modules[__name__])
    home = _MODULES[name]
    if home == "ambjax":  # the name is a module
        return importlib.import_module(f"{home}.{name}")
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return sorted({*(name for name in globals() if name.startswith("_")), *_MODULES})
