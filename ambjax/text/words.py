"""Text for messages."""

import shlex


def one_line(text: str) -> str:
    """Return the text with escapes for line breaks and other characters that do not print, so that it is one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def command(*words: str) -> str:
    """Return a command for a message, between backticks, with words quoted as a shell requires."""
    return f"`{shlex.join(words)}`"
