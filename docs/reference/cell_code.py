"""Find what in the cells of a page no longer fits the package: names, arguments, and options of commands.

Nothing is executed but the imports. So this is a quick check of pages that a build of the site does not execute.
"""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from typing import Any

from reference.commands import commands


def faults(codes: list[str]) -> list[str]:
    """Return the faults in the code of the cells of one page."""
    shell = [code for code in codes if code.startswith("%%shell")]
    python = "\n".join(re.sub(r"^[%!].*$", "", code, flags=re.MULTILINE) for code in codes if code not in shell)
    return [*_options("\n".join(shell)), *_names(ast.parse(python))]


def _options(text: str) -> Iterator[str]:
    """Yield the commands and options that do not exist."""
    parsers = commands()
    for command, rest in re.findall(r"^\s*(ambjax [a-z]+)([^|>\n]*)", text.replace("\\\n", ""), flags=re.MULTILINE):
        known = parsers[command]._option_string_actions if command in parsers else {}
        wrong = [word for word in re.findall(r"--[a-z][\w-]*", rest) if word not in known]
        yield from [f"{command} {word}" for word in wrong] if known else [command]


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield the names and the keyword arguments of this package that do not exist."""
    found: dict[str, Any] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            ours = [one.name for one in node.names if one.name.split(".")[0] in ("ambjax", "tuning")]
            found |= {name.split(".")[0]: importlib.import_module(name.split(".")[0]) for name in ours}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("ambjax", "tuning"):
            module = importlib.import_module(node.module or "")
            for one in node.names:
                if not hasattr(module, one.name):
                    yield f"{node.module}.{one.name}"
                found[one.asname or one.name] = getattr(module, one.name, None)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and _resolved(node.value, found) is not None and not _has(node, found):
            yield ast.unparse(node)
        called = _resolved(node.func, found) if isinstance(node, ast.Call) else None
        if isinstance(node, ast.Call) and (inspect.isfunction(called) or inspect.isclass(called)):
            allowed = inspect.signature(called).parameters
            open_ended = any(one.kind is one.VAR_KEYWORD for one in allowed.values())
            named = [one.arg for one in node.keywords if one.arg is not None]
            yield from (
                f"{ast.unparse(node.func)}({name}=)" for name in named if not open_ended and name not in allowed
            )


def _has(node: ast.Attribute, found: dict[str, Any]) -> bool:
    return hasattr(_resolved(node.value, found), node.attr)


def _resolved(node: ast.expr, found: dict[str, Any]) -> Any:
    """Return the object of the package that an expression of names denotes; None if it is another one."""
    if isinstance(node, ast.Name):
        return found.get(node.id)
    return getattr(_resolved(node.value, found), node.attr, None) if isinstance(node, ast.Attribute) else None
