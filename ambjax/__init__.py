"""Differentiable simulation of an active-magnetic-bearing rotor under a cascaded sliding-mode controller.

`__init__.pyi` lists the public names for type checkers. Here each is imported on first use, so that `import ambjax` and
`ambjax --version` do not import JAX.
"""

import ast
import importlib
import pathlib
from typing import Any


def _modules() -> dict[str, str]:
    """Return the module of each name that the stub imports."""
    stub = ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    lines = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in lines for alias in node.names}


_MODULES = _modules()
__all__ = sorted(name for name, module in _MODULES.items() if module != "ambjax")  # pyright: ignore


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'ambjax' has no attribute '{name}'")
    home = _MODULES[name]
    if home == "ambjax":  # the name is a module
        return importlib.import_module(f"{home}.{name}")
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
