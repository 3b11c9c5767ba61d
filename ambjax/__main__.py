"""The command line: `ambjax`, or `python -m ambjax`."""

import argparse
import contextlib
import importlib
import json
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from ambjax._version import __version__
from ambjax.host.interrupts import exit_on_interrupt
from ambjax.host.streams import lenient, open_streams
from ambjax.host.words import one_line

FIRST_DAY = """\
ambjax simulates, checks, tunes and exports the controller of a rotor in an active magnetic bearing.

  ambjax template rig > my.toml       print an annotated case file; put in the numbers of your bearing
  ambjax simulate my.toml             simulate it: trajectory.npz, metrics.json, overview.png
  ambjax check my.toml                check stability conditions, slopes and delay margin
  ambjax tune my.toml --out tuned     tune the gains: tuned/tuned.toml, tuned/report.html
  ambjax export tuned/tuned.toml      write the controller as C

'ambjax --help' lists all commands; 'ambjax COMMAND --help' lists the options of one."""
# The group of entry points in which a package that stands on this one, such as the tuner, declares its command.
EXTENSIONS = "ambjax.commands"


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line, and exit with 2."""

    def error(self, message: str) -> NoReturn:
        sys.exit(complain(f"{message}. See '{self.prog} --help'.", self.prog.split()[0]))


def complain(message: str, program: str = "ambjax") -> int:
    """Say what is wrong with the input, on one line of stderr. Returns the exit code for that."""
    with contextlib.suppress(OSError):
        print(one_line(f"{program}: {message}"), file=sys.stderr)
    return 2


def parser() -> Parser:
    """All commands and their arguments."""
    top = Parser(prog="ambjax", description="Simulate and check a rotor in an active magnetic bearing.")
    top.add_argument("--version", action="version", version=f"ambjax {__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)

    def command(name: str, words: str, case: bool = False, out: bool = False) -> Parser:
        one = commands.add_parser(name, help=words, description=words)
        if case:
            one.add_argument("case", metavar="CASE.toml", help="a case file; 'ambjax template' prints one")
        if out:
            one.add_argument("--out", metavar="DIR", help="where to write (default: a new directory under ./out)")
        one.add_argument("--json", action="store_true", help="print a machine-readable summary and nothing else")
        return one

    command("reproduce", "run the paper: both scenarios, Figures 3 to 6 and the ledger of claims", out=True)
    template = command("template", "print an annotated case file")
    template.add_argument("scenario", nargs="?", default="tracking", choices=["tracking", "regulation", "rig"])
    simulate = command("simulate", "simulate a case: trajectory.npz, metrics.json, overview.png", case=True, out=True)
    simulate.add_argument("--member", type=int, metavar="K", help="member K of the case's ensemble, its [spread] drawn")
    _seed_option(simulate)
    simulate.add_argument("--members", type=int, metavar="N", help="size of the ensemble (for a Latin hypercube)")
    simulate.add_argument("--from", dest="begin", type=float, metavar="T", help="draw the run from T (s) on")
    simulate.add_argument("--to", dest="end", type=float, metavar="T", help="draw the run up to T (s)")
    ensemble = command("ensemble", "simulate many members: members.npz, summary.json, fan.png", case=True, out=True)
    ensemble.add_argument("--members", type=int, metavar="N", required=True, help="how many members")
    _seed_option(ensemble)
    ensemble.add_argument(
        "--chunk", type=int, metavar="M", help="members kept at a time (default: about 2 s of work, 64 a core at least)"
    )
    ensemble.add_argument("--resume", action="store_true", help="go on with a study that was interrupted in --out")
    where = ensemble.add_mutually_exclusive_group()
    where.add_argument("--processes", type=int, metavar="P", help="run on P processes (default: threads of this one)")
    where.add_argument("--cluster", metavar="ADDRESS", help="run on a Dask cluster: address of its scheduler")
    grid = command("map", "survival and error over a grid of two quantities: map.png, map.json", case=True, out=True)
    for axis in ("--x", "--y"):
        form = "PATH=LOW:HIGH[:COUNT][:log]"
        grid.add_argument(axis, metavar=form, required=True, help="a quantity and its range; ends may be in per cent")
    grid.add_argument("--members", type=int, metavar="N", default=1, help="members per cell (default: 1)")
    grid.add_argument("--against", metavar="OTHER.toml", action="append", help="another case, beside the first")
    _seed_option(grid)
    words = "check Theorem 1's conditions along a case, or what decides on its processor; exit code 1 if one fails"
    command("check", words, case=True)
    export = command("export", "the controller of a case with [processor] as C", case=True, out=True)
    export.add_argument("--verify", action="store_true", help="hold the C to JAX; exit code 1 if it fails")
    export.add_argument("--precision", choices=["float", "double"], default="float", help="type of its numbers")
    export.add_argument("--prefix", metavar="NAME", help="what its names begin with (default: the case's name)")
    # Listed here, run by a parser of its own: see main.
    command("tune", "tune the gains of a case by gradients: tuned.toml, report.html")
    return top


def _seed_option(command: Parser) -> None:
    command.add_argument("--seed", type=int, metavar="S", help="seed of noise and spread (default: the case's)")


def main(argv: list[str] | None = None) -> int:
    """Run a command. Returns its exit code: 0 done, 1 the answer is no, 2 bad input.

    Without a command, print the commands that a new user runs first.
    """
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["tune"]:
        return _extension("tune")(words[1:], "ambjax tune")
    open_streams()
    with exit_on_interrupt("ambjax"):
        return answer(parser(), words, _run)


def _extension(name: str) -> Callable[[list[str], str], int]:
    """The command that another package declares under this name."""
    import importlib.metadata

    found = tuple(importlib.metadata.entry_points(group=EXTENSIONS, name=name))
    if found:
        return found[0].load()
    return lambda *_: complain(f"{name}: this command is not installed. Install ambjax again, with pip.")


def _run(args: argparse.Namespace) -> tuple[int, Any]:
    if args.command is None:
        print(FIRST_DAY)
        return 0, None
    from ambjax.ensemble import worker

    worker.prepare()
    return importlib.import_module(f"ambjax.commands.{args.command}").run(args)


Run = Callable[[argparse.Namespace], tuple[int, Any]]


def answer(parser: argparse.ArgumentParser, words: list[str] | None, run: Run) -> int:
    """Run a command and print its summary if --json asks for that. Returns the exit code; what goes wrong is one line.

    No stream that takes nothing stops it. Whoever closes stdout has seen enough of the answer; any other failure of
    stdout is told, with 2. Raises SystemExit as the parser does.
    """
    with lenient() as stdout:
        try:
            args = parser.parse_args(words)
        except SystemExit as end:  # bad arguments, or an answer too: --help, --version
            if end.code or stdout.failure() is None:
                raise
            code = 0
        else:
            code = _code(lambda: run(args), getattr(args, "json", False), parser.prog)
        failure = stdout.failure()
        if failure is None or isinstance(failure, BrokenPipeError):
            return code
        why = getattr(failure, "strerror", None) or failure
        return complain(f"the answer could not be written: {why}. Make room, or write somewhere else.", parser.prog)


def _code(run: Callable[[], tuple[int, Any]], as_json: bool, program: str) -> int:
    try:
        code, summary = run()
        if as_json:
            print(json.dumps(summary, indent=2))
    except ValueError as error:
        return complain(str(error), program)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return complain(f"{where}{error.strerror or error}. Make room, or write somewhere else.", program)
    except MemoryError:
        return complain("there is not enough memory for that. Ask for less at once: fewer members or samples.", program)
    except (NotImplementedError, RecursionError):  # faults of ours, RuntimeErrors too
        raise
    except RuntimeError as error:  # what JAX says of a device: that it is not there, or that its memory is full
        return complain(str(error).strip().partition("\n")[0] or type(error).__name__, program)
    except KeyboardInterrupt as stop:
        complain(f"interrupted{f': {stop}' if str(stop) else ''}.", program)
        return 130
    return code


if __name__ == "__main__":
    sys.exit(main())
