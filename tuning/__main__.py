"""The command line of the tuner: `ambjax tune`, `ambjax-tune` or `python -m tuning`."""

import argparse
import sys
from typing import TYPE_CHECKING

from ambjax import __version__
from ambjax.host.command_line import Parser, open_streams, run_command
from ambjax.host.interrupts import exit_on_interrupt

if TYPE_CHECKING:
    from tuning.command import TunedCase

PROGRAM = "ambjax-tune"


def parser(program: str = PROGRAM) -> argparse.ArgumentParser:
    """Return the parser of the command line for the program name `program`."""
    about = "Tune the gains of a case on an ensemble, judge them on other members, and write tuned.toml and a report."
    top = Parser(prog=program, description=about)
    top.add_argument(
        "case", metavar="CASE.toml", help="a case file; its optional table [tune] sets gains, limits and budget"
    )
    top.add_argument("--out", metavar="DIR", help="output directory (default: a new directory under ./out)")
    top.add_argument("--resume", action="store_true", help="continue the interrupted search in --out")
    top.add_argument("--force", action="store_true", help="overwrite the files of an earlier search in --out")
    top.add_argument(
        "--pareto", action="store_true", help="write each point of the front of error against voltage as a case file"
    )
    top.add_argument(
        "--settings-of",
        metavar="OTHER.toml",
        help="use limits, loss and budget of [tune] in OTHER.toml, but gains and bounds of the case",
    )
    top.add_argument(
        "--page", action="store_true", help="also write page.html, with sliders and presets (needs [processor])"
    )
    top.add_argument(
        "--budget", dest="minutes", type=float, metavar="MINUTES", help="time of the tuning (default: tune.minutes)"
    )
    top.add_argument("--json", action="store_true", help="print only the content of report.json")
    top.add_argument("--version", action="version", version=f"ambjax {__version__}")
    return top


def main(argv: list[str] | None = None, program: str = PROGRAM, *, nested: bool = False) -> int:
    """Tune a case. Return 0 if accurate steps confirm that the gains meet [tune.limits], 1 if not, 2 for bad input.

    `argv`: the arguments; None: those of the process. `program`: name of the command in messages. `nested`: whether
    another command calls this one and reports its errors, which are then raised. Ctrl-C after the first iteration of
    the search ends the search, and its result is judged. A second Ctrl-C, or one at another time, ends the process with
    exit code 130.
    """
    if nested:
        return _run(parser(program).parse_args(argv))[0]
    open_streams()
    with exit_on_interrupt(program):
        return run_command(parser(program), argv, _run)


def _run(args: argparse.Namespace) -> tuple[int, object]:
    from ambjax.ensemble.worker import configure_jax

    configure_jax()
    from ambjax.host.heartbeat import say
    from tuning.command import Options, run
    from tuning.events import Log

    words = {name: value for name, value in vars(args).items() if name in Options._fields}
    try:
        with Log() as log:
            tuned = run(args.case, Options(**words), log)
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(str(stop) or "nothing is saved") from None
    if not args.json:
        _print(tuned)
    if advice := tuned.report.get("advice"):
        say(advice)
    return int(not tuned.good), tuned.report | {"out": str(tuned.directory)}


def _print(tuned: "TunedCase") -> None:
    from ambjax.results.outputs import written

    print(tuned.report["verdict"])
    for row in tuned.report.get("gains", ()):
        bound = f" ({row['at_bound']})" if row["at_bound"] else ""
        print(f"  {row['path']}: {row['before']:.6g} -> {row['after']:.6g}{bound}")
    names = ["tuned.toml", "report.html", "report.md", "report.json", "history.npz"]
    names = [name for name in names if (tuned.directory / name).exists()]
    written(tuned.directory, ", ".join(names + ["*.png"] * any(tuned.directory.glob("*.png"))))


if __name__ == "__main__":
    sys.exit(main())
