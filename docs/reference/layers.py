"""The folders and modules of each layer with the first line of their docstrings, for the architecture page."""

import ast
import pathlib

from reference.markdown import code, escaped

ROOT = pathlib.Path(__file__).parents[2]


def pages() -> dict[str, str]:
    """Return the list that the architecture page includes."""
    lines: list[str] = []
    for package, order in layers().items():
        for layer in reversed(order.split()):
            if layer.startswith("__"):
                continue
            lines += _entry(ROOT / package / layer)
    return {"layers.txt": "\n".join(lines)}


def layers() -> dict[str, str]:
    """Return the table of tests/test_layers.py, from the bottom up, with `tuning` first."""
    tree = ast.parse((ROOT / "tests" / "test_layers.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "LAYERS":
            table = ast.literal_eval(node.value)
            return {name: table[name] for name in reversed(table)}
    raise LookupError("tests/test_layers.py has no table LAYERS")


def _entry(path: pathlib.Path) -> list[str]:
    if not path.is_dir():
        return [f"**{code(_shown(path.with_suffix('.py')))}**", f": {_says(path.with_suffix('.py'))}", ""]
    files = [file for file in sorted(path.rglob("*.py")) if file.name != "__init__.py"]
    lines = [f"**{code(_shown(path) + '/')}**", f": {_says(path / '__init__.py')}", ""]
    return [*lines, *(f"  - {code(file.relative_to(path).as_posix())}: {_says(file)}" for file in files), ""]


def _shown(path: pathlib.Path) -> str:
    return str(path.relative_to(ROOT))


def _says(path: pathlib.Path) -> str:
    """Return the first paragraph of the docstring of a file."""
    said = ast.get_docstring(ast.parse(path.read_text())) or ""
    return escaped(" ".join(said.split("\n\n")[0].split()))
