"""TOML being read strictly, a file and one table of it: what every reader of case files is built on."""

import dataclasses
import difflib
import pathlib
import tomllib
from typing import Any

from ambjax.host.words import one_line
from ambjax.numerics.records import check_number, numbers, validate, within

# What of a key or a value is shown; keys beyond this length are like no other.
LONGEST = 60
# No case nests deeper than a sum of sums; whatever walks one may rely on it.
DEEPEST = 32
# No case file is larger: what is, is something else.
MOST_BYTES = 10_000_000


def load(path: str | pathlib.Path) -> tuple[dict[str, Any], str]:
    """A case file as parsed TOML, not yet checked, and its text. Raises ValueError, one line, if it is none.

    Read once and no more: a pipe gives nothing the second time.
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
        raise refuse(f"more than {MOST_BYTES:,} bytes are no case file. See 'ambjax template' for one.")
    try:
        text = content.decode("utf-8")
        return tomllib.loads(text), text
    except UnicodeDecodeError:
        raise refuse("not a text file in UTF-8. A case file is TOML; see 'ambjax template'.") from None
    except tomllib.TOMLDecodeError as error:
        raise refuse(f"not valid TOML: {error}. See 'ambjax template' for a file to start from.") from None
    except RecursionError:
        raise refuse(f"tables or lists are nested deeper than {DEEPEST}, which no case is.") from None
    except ValueError:  # Python converts no number of thousands of digits
        raise refuse("a number has thousands of digits. Write it as in 1.5e3.") from None


def check_depth(raw: Any) -> None:
    """Refuse what is nested deeper than any case, before anything walks it."""
    level = [raw]
    for _ in range(DEEPEST):
        inner = (x.values() if isinstance(x, dict) else x for x in level if isinstance(x, (dict, list)))
        level = [x for values in inner for x in values]
    if level:
        raise ValueError(f"tables or lists are nested deeper than {DEEPEST}, which no case is.")


class Table:
    """One TOML table being read: every key must be taken, and each complaint knows its dotted path."""

    def __init__(self, raw: Any, path: str = ""):
        if not isinstance(raw, dict):
            raise ValueError(f"{path} = {show(raw)}: it must be a table. Write [{path}] and its keys below it.")
        self.raw, self.path = raw, path

    def at(self, key: str) -> str:
        """Dotted path of a key."""
        return f"{self.path}.{cut(key)}" if self.path else cut(key)

    def only(self, allowed: list[str]) -> None:
        """Refuse keys that mean nothing here, with a guess at what was meant."""
        for key in self.raw:
            if key not in allowed:
                close = difflib.get_close_matches(key[:LONGEST], allowed, n=1)
                hint = f" Did you mean '{close[0]}'?" if close else ""
                names = ", ".join(allowed) if allowed else "none"
                raise ValueError(
                    f"{self.at(key)} = {show(self.raw[key])}: unknown key.{hint} Keys allowed here: {names}."
                )

    def table(self, key: str) -> "Table":
        """A table within this one; empty if left out."""
        return Table(self.raw.get(key, {}), self.at(key))

    def number(self, key: str, default: Any, allowed: str = "a number") -> Any:
        """A number, or the default if left out."""
        value = self.raw.get(key, default)
        if value is default:
            return default
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be {allowed}, without quotes.")
        try:
            return float(value)
        except OverflowError:  # a whole number of hundreds of digits
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be {allowed}.") from None

    def leaf(self, key: str, field: dataclasses.Field, default: Any = None) -> Any:
        """A number that the field of a record, or one like it, allows; or the default if left out."""
        value = self.number(key, default, numbers(field))
        if key in self.raw:
            check_number(field, self.at(key), value)
        return value

    def whole(self, key: str, field: dataclasses.Field) -> int:
        """A whole number, written as one, that the field allows; or its default if left out."""
        value = self.raw.get(key, field.default)
        if isinstance(value, bool) or not isinstance(value, int) or not within(field.metadata, value):
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be {numbers(field)}.")
        return value

    def switch(self, key: str) -> bool | None:
        """true or false; None if left out."""
        value = self.raw.get(key)
        if value is not None and not isinstance(value, bool):
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be true or false, without quotes.")
        return value

    def choice(self, key: str, allowed: list[str], default: str | None = None) -> str:
        """One of several words."""
        value = self.raw.get(key, default)
        if value is None:
            raise ValueError(f"{self.at(key)} is missing: it must be one of {quoted(allowed)}.")
        if value not in allowed:
            close = difflib.get_close_matches(show(value).strip('"'), allowed, n=1)
            hint = f" Did you mean '{close[0]}'?" if close else ""
            raise ValueError(f"{self.at(key)} = {show(value)}: it must be one of {quoted(allowed)}.{hint}")
        return value

    def record(self, kind: type, extra: tuple[str, ...] = (), base: Any = None) -> Any:
        """A record whose leaves are this table's keys, defaults from `base` or from the record itself."""
        fields = [field for field in dataclasses.fields(kind) if field.metadata.get("leaf")]
        self.only([*extra, *(f.name for f in fields)])
        values: dict[str, Any] = {}
        for field in fields:
            default = field.default if base is None else getattr(base, field.name)
            if field.name not in self.raw and default is dataclasses.MISSING:
                raise ValueError(f"{self.at(field.name)} is missing: give {numbers(field)}; {field.metadata['doc']}.")
            values[field.name] = self.number(field.name, default, numbers(field))
        one = kind(**values)
        validate(one, self.path)
        self._check_order(one)
        return one

    def _check_order(self, record: Any) -> None:
        """Refuse a pulse that ends before it starts, and its like."""
        if pair := getattr(record, "ordered", None):
            low, high = (getattr(record, name) for name in pair)
            if not low < high:
                raise ValueError(f"{self.at(pair[1])} = {high:g}: it must be more than {pair[0]} = {low:g}.")


def show(value: Any) -> str:
    """A value as it would stand in the file, cut if it is long."""
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
    """The text, or its beginning if it is long."""
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def quoted(words: list[str]) -> str:
    """'a', 'b' or 'c'."""
    names = [f"'{w}'" for w in words]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
