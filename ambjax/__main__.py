"""The command line: `ambjax`, or `python -m ambjax`."""

import argparse
import importlib
import sys

from ambjax._version import __version__
from ambjax.host.command_line import Parser, complain, open_streams, run_command
from ambjax.host.heartbeat import FIRST_RUN, Heartbeat, doing
from ambjax.host.interrupts import exit_on_interrupt

FIRST_DAY = """\
ambjax simulates, checks, tunes and exports the controller of a rotor in an active magnetic bearing.

  ambjax template rig > my.toml       print a case file with comments; enter the numbers of your bearing
  ambjax simulate my.toml             simulate it: trajectory.npz, metrics.json, overview.png
  ambjax check my.toml                check the sensitivity, margins and stability conditions
  ambjax tune my.toml --out tuned     tune the gains: tuned/tuned.toml, tuned/report.html
  ambjax export tuned/tuned.toml      write the controller as C
  ambjax page my.toml                 write one HTML file with sliders that runs the loop in a browser

'ambjax --help' lists all commands, 'ambjax COMMAND --help' the options of a command."""


def parser() -> Parser:
    """Return the argument parser with all commands and their options."""
    about = "Simulate, check, tune and export the controller of a rotor in an active magnetic bearing."
    top = Parser(prog="ambjax", description=about)
    top.add_argument("--version", action="version", version=f"ambjax {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)

    def command(name: str, summary: str, case: bool = False, out: bool = False) -> Parser:
        added = commands.add_parser(name, help=summary, description=summary)
        if case:
            added.add_argument("case", metavar="CASE.toml", help="a case file; 'ambjax template' prints one")
        if out:
            added.add_argument("--out", metavar="DIR", help="output directory (default: a new directory under ./out)")
        if out and name not in ("ensemble", "export"):  # these two check existing files themselves
            added.add_argument("--force", action="store_true", help="overwrite the files of an earlier run in --out")
        added.add_argument("--json", action="store_true", help="print only a machine-readable summary")
        return added

    command("reproduce", "reproduce Section 4 of the paper: Figures 3 to 6, and a ledger of its claims", out=True)
    template = command("template", "print a case file with comments")
    cases = ["tracking", "regulation", "rig", "bearing", "machine", "machine-flexible", "machine-ufu"]
    meaning = (
        "the paper's tracking or regulation, a laboratory rig, a bearing from a data sheet, or a whole machine with a "
        "rigid or a flexible rotor"
    )
    template.add_argument("scenario", nargs="?", default=cases[0], choices=cases, help=meaning)
    simulate = command("simulate", "simulate a case: trajectory.npz, metrics.json, overview.png", case=True, out=True)
    simulate.add_argument(
        "--member", type=int, metavar="K", help="simulate member K of the ensemble, with its values drawn from [spread]"
    )
    _seed_option(simulate)
    meaning = "with --member: number of members of the ensemble; required if [spread] is a Latin hypercube"
    simulate.add_argument("--members", type=int, metavar="N", help=meaning)
    simulate.add_argument("--from", dest="begin", type=float, metavar="T", help="plot the run from time T (s)")
    simulate.add_argument("--to", dest="end", type=float, metavar="T", help="plot the run up to time T (s)")
    _page_option(simulate)
    ensemble = command(
        "ensemble", "simulate many members of [spread]: members.npz, summary.json, pictures", case=True, out=True
    )
    ensemble.add_argument("--members", type=int, metavar="N", required=True, help="number of members")
    _seed_option(ensemble)
    ensemble.add_argument(
        "--chunk",
        type=int,
        metavar="M",
        help="members per saved chunk (default: about 2 s of work, at least 64 members per core)",
    )
    ensemble.add_argument("--resume", action="store_true", help="continue the interrupted study in --out")
    workers = ensemble.add_mutually_exclusive_group()
    meaning = "run in P processes (default: in threads of one process)"
    workers.add_argument("--processes", type=int, metavar="P", help=meaning)
    workers.add_argument("--cluster", metavar="ADDRESS", help="run on the Dask cluster whose scheduler is at ADDRESS")
    summary = "map survival and error over a grid of two quantities: map.png, map.json"
    grid = command("map", summary, case=True, out=True)
    for axis in ("--x", "--y"):
        form = "PATH=LOW:HIGH[:COUNT][:log]"
        meaning = (
            "quantity on this axis and its range, such as initial.z=-2e-4:2e-4 (SI units) or plant.m=-20%%:20%%:11; "
            "COUNT: 21 if left out; log: logarithmic"
        )
        grid.add_argument(axis, metavar=form, required=True, help=meaning)
    grid.add_argument("--members", type=int, metavar="N", default=1, help="members per cell (default: 1)")
    grid.add_argument(
        "--against", metavar="OTHER.toml", action="append", help="another case, mapped over the same grid (repeatable)"
    )
    _seed_option(grid)
    summary = (
        "check sensitivity, margins and the stability conditions of a case; exit code 1 if a condition that applies "
        "fails"
    )
    checks = command("check", summary, case=True)
    meaning = "also compute and print what does not affect the verdict (a case of one axis)"
    checks.add_argument("--full", action="store_true", help=meaning)
    summary = (
        "modes, critical speeds and unbalance response of a machine against its speed: campbell.html, campbell.json, "
        "campbell.png, rotor.png, unbalance.png"
    )
    campbell = command("campbell", summary, case=True, out=True)
    campbell.add_argument(
        "--to", type=float, metavar="RPM", help="largest speed, above 0 (default: 1.3 times that of the case)"
    )
    summary = "sensitivity peaks with ISO 14839-3 zones, margins, stiffness: sensitivity.json, sensitivity.png"
    sensitivity = command("sensitivity", summary, case=True, out=True)
    sensitivity.add_argument("--members", type=int, metavar="N", help="members of [spread] to analyse (default: 100)")
    sensitivity.add_argument(
        "--inject",
        action="store_true",
        help="inject a multi-sine also in continuous time (always done on a processor); at all speeds of a machine",
    )
    _seed_option(sensitivity)
    summary = "compare cases on the same members: compare.html, compare.json, compare.png"
    compare = command("compare", summary, out=True)
    compare.add_argument("cases", metavar="CASE.toml", nargs="+", help="two to eight case files")
    compare.add_argument("--members", type=int, metavar="N", default=200, help="number of members (default: 200)")
    compare.add_argument(
        "--tune", action="store_true", help="first tune each case, with the limits, loss and budget of the first case"
    )
    compare.add_argument("--resume", action="store_true", help="continue the interrupted tunings of --tune in --out")
    _seed_option(compare)
    _page_option(compare)
    summary = "write the controller, the plant or the loop of a case with [processor] as C, FMU or JavaScript"
    export = command("export", summary, case=True, out=True)
    parts = ["controller", "plant", "loop"]
    export.add_argument("--what", choices=parts, default="controller", help="part to export (default: controller)")
    export.add_argument("--format", choices=["c", "fmu", "js"], default="c", help="C, FMU or JavaScript (default: c)")
    export.add_argument("--fmi", type=int, choices=[2, 3], help="version of FMI, with --format fmu (default: 3)")
    meaning = "compile the C and compare it with JAX; exit code 1 if they differ"
    export.add_argument("--verify", action="store_true", help=meaning)
    meaning = "C type of all numbers of a C package (default: float); the other formats have double"
    export.add_argument("--precision", choices=["float", "double"], help=meaning)
    export.add_argument("--prefix", metavar="NAME", help="prefix of all names in the C code (default: the case's name)")
    page = command("page", "write one HTML file with sliders that runs the loop of a case in a browser", case=True)
    meaning = "another preset: a case that differs in numbers only (repeatable)"
    page.add_argument("--also", metavar="OTHER.toml", action="append", help=meaning)
    meaning = "HTML file (default: page.html in a new directory under ./out)"
    page.add_argument("--out", metavar="FILE.html", help=meaning)
    page.add_argument("--force", action="store_true", help="overwrite the file of an earlier run")
    # Listed for --help only; main passes the arguments of `tune` to the tuner's own parser.
    command("tune", "tune the gains of a case on an ensemble of rotors: tuned.toml, report.html")
    top.commands = commands.choices
    return top


def _seed_option(command: Parser) -> None:
    command.add_argument(
        "--seed", type=int, metavar="S", help="seed of the noise and of [spread] (default: run.seed of the case)"
    )


def _page_option(command: Parser) -> None:
    meaning = "also write a page with sliders, page.html (needs [processor])"
    command.add_argument("--page", action="store_true", help=meaning)


def main(argv: list[str] | None = None) -> int:
    """Run a command and return its exit code. Without a command, print the commands that a new user runs first.

    `argv`: the arguments; None: those of the process. Exit codes: 0 done; 1 done with a negative result (a rotor is
    lost, a condition fails); 2 an error that the user can correct, such as bad input; 130 interrupted.
    """
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["tune"]:
        return _tune(words[1:])
    open_streams()
    with exit_on_interrupt("ambjax"):
        return run_command(parser(), words, _run)


def _tune(words: list[str]) -> int:
    """Run `ambjax tune` and return its exit code; report an error if the package `tuning` is missing."""
    from ambjax.host.extensions import extension

    try:
        tune = extension("tune")
    except ValueError as error:
        return complain(str(error))
    return tune(words, "ambjax tune")


def _run(args: argparse.Namespace) -> tuple[int, object]:
    """Run the module of a command and return its exit code and summary."""
    if args.command is None:
        print(FIRST_DAY)
        return 0, None
    from ambjax.ensemble import worker

    worker.configure_jax()
    with Heartbeat(), doing(f"{args.command} is running; {FIRST_RUN}"):
        return importlib.import_module(f"ambjax.commands.{args.command}").run(args)


if __name__ == "__main__":
    sys.exit(main())
