"""Functions shared by the sections of the benchmark page."""

import json
from typing import Any

import _measure


def load(name: str) -> dict[str, Any]:
    """Return the JSON of one script."""
    return json.loads((_measure.RESULTS / f"{name}.json").read_text())


def facts(machine: dict[str, Any]) -> str:
    """Return one sentence about the machine and the versions."""
    vectors = "with" if machine["avx512"] else "without"
    versions = f"Python {machine['python']}, jax {machine['jax']}"
    return f"{machine['cpu']}, {machine['cores']} cores, {vectors} AVX-512; {versions}."


def table(titles: str, rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table and an empty line."""
    return [f"| {titles} |", "|" + "---|" * (titles.count("|") + 1), *(f"| {' | '.join(row)} |" for row in rows), ""]
