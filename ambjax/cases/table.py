"""Strict reading of TOML: a file, and one table of it. All readers of case files use it."""

import dataclasses
import difflib
import pathlib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.numerics.declared import check_number, leaves_of, numbers
from ambjax.numerics.records import check_leaf, is_traced
from ambjax.numerics.shapes import axes_of, check_shapes
from ambjax.text.words import hint, one_line, other_words

# Largest number of characters of a key or a value in a message.
LONGEST = 60
# Kinds of a path, for messages.
FILE = "the path of a file, as text or a pathlib.Path"
# Largest depth of nested tables and lists. A sum of sums needs less. The readers are recursive and rely on this limit.
DEEPEST = 32
# Tables of which a case may have several.
SEVERAL = r"disturbance\.\w+|bearing|unbalance|load|base|rotor\.(?:modes|elements|discs|sleeves)"
# Largest size of a case file.
MOST_BYTES = 10_000_000


def text_of(tables: Mapping[str, Any]) -> str:
    """Return the text of a case of these tables. Raises ValueError for a value that TOML does not have."""
    import tomlkit  # the commands read files, and need it rarely
    from tomlkit.exceptions import TOMLKitError

    def plain(x: Any) -> Any:
        if isinstance(x, Mapping):
            return {key: plain(value) for key, value in x.items()}
        x = x.tolist() if hasattr(x, "tolist") else x  # arrays and numbers of NumPy and JAX
        return [plain(one) for one in x] if isinstance(x, (list, tuple)) else x

    try:
        return tomlkit.dumps(plain(tables))
    except (TOMLKitError, TypeError, ValueError) as why:
        raise ValueError(one_line(f"case: a dict of tables has numbers, words, lists and dicts ({why}).")) from None


def load(path: str | pathlib.Path) -> tuple[dict[str, Any], str]:
    """Return a case file as parsed TOML, not yet checked, and its text.

    Raises ValueError, one line, if it cannot be read, is larger than MOST_BYTES, or is not TOML.
    """
    path = pathlib.Path(path)

    def refuse(why: str) -> ValueError:
        return ValueError(one_line(f"{path}: {why}"))

    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise refuse(f"cannot be read ({error.strerror}). Check the path and its permissions.") from None
    if len(content) > MOST_BYTES:
        raise refuse(f"a case file has at most {MOST_BYTES:,} bytes, and this file has more. See 'ambjax template'.")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise refuse("not a text file in UTF-8. A case file is TOML; see 'ambjax template'.") from None
    try:
        return tomllib.loads(text), text
    except tomllib.TOMLDecodeError as error:
        raise refuse(f"not valid TOML: {error}.{_place(text, str(error))}") from None
    except RecursionError:
        raise refuse(f"tables or lists are nested deeper than {DEEPEST} levels. Use fewer.") from None
    except ValueError:  # Python refuses to convert thousands of digits
        raise refuse("a number has thousands of digits. Write it as in 1.5e3.") from None


def _place(text: str, error: str) -> str:
    """Return the line that an error of `tomllib` names, and the probable mistake in it."""
    found, lines = re.search(r"\(at line (\d+), ", error), text.splitlines()
    if found is None or not 0 < int(found[1]) <= len(lines):
        return " See 'ambjax template' for a file to start from."
    line = lines[int(found[1]) - 1]
    shown = f" The line is: {cut(line.strip())}."
    if re.match(r"[^#\[\"']*=\s*[-+]?\d+,\d", line):
        return f"{shown} Write a decimal number with a point."
    if "twice" in error or ("overwrite" in error and line.lstrip().startswith("[")):
        several = re.match(rf"\s*\[+({SEVERAL})\]", line)
        advice = f" For several, put [[{several[1]}]] above each, also the first." if several else ""
        return f"{shown} Write each table once.{advice}"
    if "overwrite" in error:
        return f"{shown} Write each key once."
    return f"{shown} See 'ambjax template' for a file to start from."


def check_depth(raw: object) -> None:
    """Raise ValueError if tables or lists are nested deeper than DEEPEST."""
    level = [raw]
    for _ in range(DEEPEST):
        inner = (x.values() if isinstance(x, dict) else x for x in level if isinstance(x, (dict, list)))
        level = [x for values in inner for x in values]
    if level:
        raise ValueError(f"tables or lists are nested deeper than {DEEPEST} levels. Use fewer.")


def put(raw: Any, words: Sequence[str | int], value: object) -> None:
    """Set the value at the words of a path of a parsed TOML document, whose tables are made as needed."""
    for word in words[:-1]:
        raw = raw[int(word)] if isinstance(raw, list) else raw.setdefault(word, {})
    raw[words[-1]] = value


class Table:
    """A TOML table that is read strictly: an unknown key is an error, and each error names its dotted path."""

    def __init__(self, raw: Any, path: str = "") -> None:
        if not isinstance(raw, dict):
            raise ValueError(f"{path} = {show(raw)}: it must be a table. Write [{path}] and its keys below it.")
        if wrong := [key for key in raw if not isinstance(key, str)]:
            raise ValueError(f"{path or 'case'}: the key {wrong[0]!r} must be text.")
        self.raw, self.path = raw, path

    def at(self, key: str) -> str:
        """Return the dotted path of a key."""
        return f"{self.path}.{cut(key)}" if self.path else cut(key)

    def refuse(self, key: str, why: str) -> ValueError:
        """Return the error that the value of a key is wrong, or that the key is missing."""
        given = f"= {show(self.raw[key])}" if key in self.raw else "is missing"
        return ValueError(f"{self.at(key)} {given}: {why}")

    def only(self, allowed: list[str], elsewhere: Iterable[str] = ()) -> None:
        """Raise ValueError for a key that is not in `allowed`, and suggest the one that is meant."""
        for key in self.raw:
            if key not in allowed:
                names, other = ", ".join(allowed) if allowed else "none", hint(key[:LONGEST], allowed, elsewhere)
                raise self.refuse(key, f"unknown key.{other} Keys allowed here: {names}.")

    def table(self, key: str) -> "Table":
        """Return a table within this one; empty if left out."""
        return Table(self.raw.get(key, {}), self.at(key))

    def tables(self, key: str) -> list["Table"]:
        """Return the tables of a list, written as [[key]]; none if left out."""
        raw = self.raw.get(key, [])
        if not isinstance(raw, list):
            raise self.refuse(key, f"write [[{self.at(key)}]] above each.")
        return [Table(one, f"{self.at(key)}[{n}]") for n, one in enumerate(raw)]

    def number(self, key: str, default: object, allowed: str = "a number") -> Any:
        """Return a number, or the default if left out. Raises ValueError for anything else."""
        value = self.raw.get(key, default)
        if value is default:
            return default
        if is_traced(value):
            why = "inside, change its numbers by ambjax.with_gains or dataclasses.replace."
            raise ValueError(f"{self.at(key)}: the number is traced. Read the case outside jit, vmap and grad; {why}")
        if getattr(value, "ndim", None) == 0:  # a number of NumPy or JAX, in a dict
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be {allowed}{_unquoted(value)}.")
        try:
            return float(value)
        except OverflowError:  # a whole number of hundreds of digits
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be {allowed}.") from None

    def array(self, key: str, default: object, allowed: str) -> Any:
        """Return an array of numbers, or the default if left out. The arguments and errors are those of `number`."""
        value = self.raw.get(key, default)
        if value is default:
            return default

        def read(raw: object, path: str) -> Any:
            if isinstance(raw, list):
                return [read(x, f"{path}.{n}") for n, x in enumerate(raw)]
            return Table({path: raw}, self.path).number(path, None, allowed)

        rows = read(value, key)
        try:
            return np.asarray(rows)
        except ValueError:
            raise self.refuse(key, "its rows have different lengths.") from None

    def column(
        self, key: str, allowed: str = "a list of numbers", field: dataclasses.Field | None = None
    ) -> list[float]:
        """Return a list of numbers, within the bounds of `field` if given. Raises ValueError otherwise."""
        values = self.raw.get(key)
        if not isinstance(values, list):
            raise self.refuse(key, f"it must be {allowed}.")
        each = Table({str(n): x for n, x in enumerate(values)}, self.at(key))
        return [each.number(n, None) if field is None else each.leaf(n, field) for n in each.raw]

    def leaf(self, key: str, field: dataclasses.Field, default: object = None) -> Any:
        """Return a number within the bounds of `field`, or the default if left out. Raises ValueError otherwise.

        It is an integer if `field` is whole.
        """
        value = self.number(key, default, numbers(field))
        if key in self.raw:
            check_number(field, self.at(key), value)
        return value if value is None or not field.metadata["whole"] else int(value)

    def leaves(
        self, fields: Mapping[str, dataclasses.Field], extra: Iterable[str] = (), elsewhere: Iterable[str] = ()
    ) -> dict[str, Any]:
        """Return the numbers of the table by name, within the bounds of `fields`; those left out have their defaults.

        `extra`: further keys that the table may have. `elsewhere`: as in `only`. Raises ValueError as `leaf` and `only`
        do.
        """
        self.only([*extra, *fields], elsewhere)
        return {name: self.leaf(name, field, field.default) for name, field in fields.items()}

    def switch(self, key: str) -> bool | None:
        """Return a Boolean; None if left out."""
        value = self.raw.get(key)
        if value is not None and not isinstance(value, bool):
            raise self.refuse(key, f"it must be true or false{_unquoted(value)}.")
        return value

    def choice(self, key: str, allowed: list[str], default: str | None = None, other: str = "") -> str:
        """Return one of the `allowed` words, or the default if left out. Raises ValueError for any other."""
        value = self.raw.get(key, default)
        words = quoted(allowed) + (f"; or {other}" if other else "")
        if value is None:
            raise ValueError(f"{self.at(key)} is missing: it must be one of {words}.")
        if value not in allowed:
            word = show(value).strip('"')
            same = [name for name in allowed if name.lower() == word.lower() or word.lower() in other_words(name)]
            close = same or difflib.get_close_matches(word.lower(), allowed, n=1)
            other = f" Did you mean '{close[0]}'?" if close else ""
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be one of {words}.{other}")
        return value

    def record(self, kind: type, extra: tuple[str, ...] = (), base: object = None) -> Any:
        """Return a record of type `kind` whose leaves have the values of this table's keys.

        `extra`: further keys that the table may have. `base`: a record that gives the defaults; None: `kind`. Raises
        ValueError for an unknown or missing key, a value out of bounds, or two leaves in the wrong order.
        """
        fields = leaves_of(kind)
        self.only([*extra, *(f.name for f in fields)])
        values: dict[str, Any] = {}
        for field in fields:
            default = field.default if base is None else getattr(base, field.name)
            if field.name not in self.raw and default is dataclasses.MISSING:
                raise ValueError(f"{self.at(field.name)} is missing: give {numbers(field)}; {field.metadata['doc']}.")
            read = self.array if axes_of(field) else self.number
            values[field.name] = read(field.name, default, numbers(field))
            check_leaf(field, self.at(field.name), values[field.name])
        check_shapes(fields, values, self.path)
        one = kind(**values)
        if pair := getattr(one, "ordered", None):  # such as start and stop
            low, high = (getattr(one, name) for name in pair)
            if not low < high:
                raise ValueError(f"{self.at(pair[1])} = {high:g}: it must be more than {pair[0]} = {low:g}.")
        return one


def _unquoted(value: object) -> str:
    return ", without quotes" if isinstance(value, str) else ""


def show(value: object) -> str:
    """Return a value as a case file writes it, cut if it is long."""
    if isinstance(value, int) and abs(value) >= 10**LONGEST:  # Python refuses to write thousands of digits
        return f"a whole number of {len(hex(abs(value))) - 2} hexadecimal digits"
    if isinstance(value, list):
        text = f"[{', '.join(map(show, value[:LONGEST]))}]"
    elif isinstance(value, dict) and value:
        text = f"{{ {', '.join(f'{k} = {show(x)}' for k, x in value.items())} }}"
    else:
        text = f'"{value}"' if isinstance(value, str) else str(value)
        text = text.lower() if isinstance(value, bool) else text
    return cut(text)


def cut(text: str) -> str:
    """Return the text, or its beginning if it is long."""
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def quoted(words: list[str]) -> str:
    """Return the words as 'a', 'b' or 'c'."""
    names = [f"'{w}'" for w in words]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


def require_file(name: str, path: object, kinds: str = FILE) -> None:
    """Raise ValueError unless the argument `name` is the path of a file. `kinds`: what it may be, for the message."""
    if not isinstance(path, str | pathlib.PurePath):
        raise ValueError(f"{name} = {cut(repr(path))}: it must be {kinds}.")


def file_to_write(function: str, path: str | pathlib.Path) -> pathlib.Path:
    """Return the argument `path` of a function. Raises ValueError unless it is the path of a file in a folder."""
    require_file("path", path)
    path = pathlib.Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{function}: {path}: the directory {path.parent} does not exist. Make it first.")
    return path
