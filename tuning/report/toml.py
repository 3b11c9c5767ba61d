"""Write a parsed TOML document back: tables, numbers, words, lists and inline tables, which is all a case file has."""

import math
import re
from collections.abc import Mapping
from typing import Any

BARE = re.compile(r"[A-Za-z0-9_-]+")
# What may stand in no comment and no string; halves of characters are names of files that are not UTF-8.
CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def dumps(document: Mapping[str, Any], head: str = "") -> str:
    """The document as TOML; `head` goes first, as a comment."""
    lines = [f"# {CONTROL.sub(_escaped, line)}" for line in head.split("\n")] if head else []
    _table(document, "", lines)
    return "\n".join(lines).strip() + "\n"


def _table(table: Mapping[str, Any], path: str, lines: list[str]) -> None:
    inner = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    own = {key: value for key, value in table.items() if key not in inner}
    if path and (own or not inner):
        lines += ["", f"[{path}]"]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in own.items()]
    for key, value in inner.items():
        _table(value, f"{path}.{_key(key)}" if path else _key(key), lines)


def _escaped(found: re.Match[str]) -> str:
    return f"\\u{ord(found[0]):04x}"


def _key(key: str) -> str:
    return key if BARE.fullmatch(key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{CONTROL.sub(_escaped, escaped)}"'
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }" if value else "{}"
    return str(value)  # dates


def with_gains(document: Mapping[str, Any], gains: Mapping[str, float]) -> dict[str, Any]:
    """The document with the numbers at these dotted paths replaced; tables that lack are added."""

    def put(table: Mapping[str, Any], words: list[str], value: float) -> dict[str, Any]:
        if len(words) == 1:
            return {**table, words[0]: value}
        return {**table, words[0]: put(table.get(words[0], {}), words[1:], value)}

    for path, value in gains.items():
        document = put(document, path.split("."), float(value))
    return dict(document)
