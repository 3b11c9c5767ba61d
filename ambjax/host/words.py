"""Text for messages."""

import shlex


def one_line(text: str) -> str:
    """The text with line breaks and whatever else does not print written as escapes: a message is one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def command(*words: str) -> str:
    """A command for a message, between backticks: a word that a shell would split has quotes of its own."""
    return f"`{shlex.join(words)}`"
