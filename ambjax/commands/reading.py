"""What commands share: they read a case file, whose custom laws and warnings go to stderr, and write results."""

import argparse
import contextlib
import pathlib
from collections.abc import Callable, Iterable, Iterator

from ambjax.cases.machine_case import AnyCase, read_any, warnings_of_machine
from ambjax.cases.reader import Case
from ambjax.cases.warned import warnings_of_file
from ambjax.host.heartbeat import say
from ambjax.results.outputs import described, files, written
from ambjax.text.words import one_line


def read_any_with_warnings(path: str | pathlib.Path) -> AnyCase:
    """Read the case file of one axis or of a whole machine, and print its warnings. Raises ValueError as `read_any`."""
    case = read_any(path)
    print_warnings(case, path)
    return case


def print_warnings(case: AnyCase, path: str | pathlib.Path) -> None:
    """Print the custom laws and the warnings of a case on stderr, one line each."""
    for law in case.own_laws:
        say(one_line(f"{path}: {law}"))
    for warning in warnings_of_file(case, path) if isinstance(case, Case) else warnings_of_machine(case, path):
        say(warning)


@contextlib.contextmanager
def results(
    args: argparse.Namespace, out: pathlib.Path, names: Iterable[str], text: Callable[[], str]
) -> Iterator[pathlib.Path]:
    """Yield a folder as `files` does. Then, unless --json, print the text, and those of `names` that are written."""
    with files(out) as part:
        yield part
        made = [name for name in names if (part / name).exists()]
    if not args.json:
        print(described("the table", text) or "")
        written(out, ", ".join(made))
