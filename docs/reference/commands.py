"""Every command and flag, read from the argument parsers."""

import argparse

from ambjax.__main__ import parser
from reference.markdown import code, escaped, table
from tuning.__main__ import parser as tuner

HELP = (argparse._HelpAction, argparse._VersionAction)


def pages() -> dict[str, str]:
    """Return the page."""
    lines = [
        "# Commands",
        "",
        "Exit codes: 0 done; 1 done with a negative result (a rotor is lost, a condition fails); 2 bad input, reported "
        "on one line of stderr; 130 interrupted. `ambjax-tune` is another name of `ambjax tune`.",
        "",
    ]
    for command in commands().values():
        lines += _section(command)
    return {"commands.md": "\n".join(lines)}


def commands() -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands, by command line."""
    groups = [one for one in parser()._actions if isinstance(one, argparse._SubParsersAction)]
    found = [choice for one in groups for choice in one.choices.values()]
    return {command.prog: command for command in found} | {"ambjax tune": tuner("ambjax tune")}


def _section(command: argparse.ArgumentParser) -> list[str]:
    usage = " ".join(command.format_usage().removeprefix("usage: ").replace("[-h] ", "").split())
    lines = [f"## `{command.prog}`", "", escaped(sentence(command.description or "")), "", "```text", usage, "```", ""]
    told = [action for action in command._actions if not isinstance(action, HELP)]
    rows = [(code(_written(action)), escaped(_meaning(action))) for action in told]
    return lines + table(("argument", "meaning"), rows, "keys")


def sentence(text: str) -> str:
    """Return the text as a sentence."""
    return text[:1].upper() + text[1:] + "." * (not text.endswith("."))


def _written(action: argparse.Action) -> str:
    """Return an argument as it is typed."""
    named = ", ".join(action.option_strings)
    taken = action.metavar or (action.dest if not named else "")
    return f"{named} {taken}".strip() if action.nargs != 0 else named


def _meaning(action: argparse.Action) -> str:
    default = "" if action.default is None or "(default" in (action.help or "") else f" (default: {action.default})"
    choices = f"one of {', '.join(map(str, action.choices))}{default}" if action.choices else ""
    needed = "required" if action.option_strings and action.required else ""
    return "; ".join(filter(None, ((action.help or "").replace("%%", "%"), choices, needed)))
