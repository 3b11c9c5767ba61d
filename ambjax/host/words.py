"""Text for messages."""

import shlex


def one_line(text: str) -> str:
    """Return the text with line breaks and other unprintable characters as escapes, so that a message is one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def command(*words: str) -> str:
    """Return a command for a message, between backticks; words that a shell would split are quoted."""
    return f"`{shlex.join(words)}`"
