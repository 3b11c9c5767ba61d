"""Text for messages, and the name that a user probably means: another word for a quantity, or a similar spelling."""

import difflib
import functools
import shlex
from collections.abc import Iterable, Sequence


def one_line(text: str) -> str:
    """Return the text with escapes for line breaks and other characters that do not print, so that it is one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def number(x: float | None, digits: int = 4) -> str:
    """Return a number for a table, with a number of digits; "-" for None."""
    return "-" if x is None else f"{x:.{digits}g}"


def command(*words: str) -> str:
    """Return a command for a message, between backticks, with words quoted as a shell requires."""
    return f"`{shlex.join(words)}`"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a Markdown table. Cells are Markdown; `|` is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(cell.replace("\\|", "|").replace("|", "\\|") for cell in line) + " |" for line in lines]


def duration(seconds: float) -> str:
    """Return a duration as text, in s, min or h."""
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


@functools.cache
def _table(name: str) -> dict[str, str]:
    """Return a table of synonyms.toml, "words" or "derived"."""
    import importlib.resources
    import tomllib

    text = (importlib.resources.files("ambjax.text") / "synonyms.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)[name]


def hint(word: str, allowed: Iterable[str], elsewhere: Iterable[str]) -> str:
    """Return " Did you mean 'name'?" for the name that `word` probably means; "" if unknown.

    It is one of `allowed`, or the path of a number in another table, among them the paths `elsewhere`.
    """
    names, plain = list(allowed), _plain(word)
    if "mu_0" in names and (source := _table("derived").get(plain)):
        return f" It follows from {source}."
    for name in names:
        if _plain(name) == plain or plain in other_words(name):
            return f" Did you mean '{name}'?"
    lasts = {path: path.rpartition(".")[2] for path in elsewhere}
    paths = [path for path, last in lasts.items() if plain in (_plain(last), *other_words(last))]
    paths += [name for name, words in _table("words").items() if "." in name and plain in words.split()]
    path = next(iter(paths or difflib.get_close_matches(word, names, n=1)), None)
    last = path.rpartition(".")[2] if path else ""
    return f" Did you mean '{last if last in names else path}'?" if path else ""


def other_words(name: str) -> list[str]:
    """Return the other words for a name; none if the table has no row for it."""
    return _table("words").get(name, "").split()


def hint_of_path(path: str, known: Iterable[str]) -> str:
    """Return the hint for a path: a name of its table for which its last name is another word, or a similar path."""
    known = list(known)
    table, _, name = path.rpartition(".")
    inside = [one.rpartition(".")[2] for one in known if one.rpartition(".")[0] == table]
    other = next((one for one in inside if _plain(name) in other_words(one)), None)
    if other:
        return f" Did you mean '{table}.{other}'?"
    close = difflib.get_close_matches(path, known, n=1)
    return f" Did you mean '{close[0]}'?" if close else ""


def _plain(word: str) -> str:
    return word.lower().replace("_", "").replace("-", "").replace(" ", "")
