"""Reading of a case file by a command: its custom laws and warnings go to stderr."""

import pathlib

from ambjax.cases.machine_case import AnyCase, read_any, warnings_of_machine
from ambjax.cases.reader import Case, read_case
from ambjax.cases.warned import warnings_of_file
from ambjax.host.heartbeat import say
from ambjax.text.words import one_line


def read_with_warnings(path: str | pathlib.Path) -> Case:
    """Read a case file and print its warnings on stderr. Raises ValueError as `read_case` does."""
    case = read_case(path)
    print_warnings(case, path)
    return case


def read_any_with_warnings(path: str | pathlib.Path) -> AnyCase:
    """Read the case file of one axis, as `read_with_warnings` does, or of a whole machine."""
    case = read_any(path)
    print_warnings(case, path)
    return case


def print_warnings(case: AnyCase, path: str | pathlib.Path) -> None:
    """Print the custom laws and the warnings of a case on stderr, one line each."""
    for law in case.own_laws:
        say(one_line(f"{path}: {law}"))
    for warning in warnings_of_file(case, path) if isinstance(case, Case) else warnings_of_machine(case, path):
        say(warning)
