"""The command line: `ambjax`, or `python -m ambjax`."""

import argparse
import json
import os
import pathlib
import sys
from typing import NoReturn

from ambjax._version import __version__


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line, and exit with 2."""

    def error(self, message: str) -> NoReturn:
        sys.exit(complain(f"{message}. See '{self.prog} --help'.", self.prog.split()[0]))


def complain(message: str, program: str = "ambjax") -> int:
    """Say what is wrong with the input, on one line of stderr. Returns the exit code for that."""
    print(f"{program}: {message}", file=sys.stderr)
    return 2


def parser() -> Parser:
    """All commands and their arguments."""
    top = Parser(prog="ambjax", description="Simulate and check a rotor in an active magnetic bearing.")
    top.add_argument("--version", action="version", version=f"ambjax {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)

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
    template.add_argument("scenario", nargs="?", default="tracking", choices=["tracking", "regulation"])
    command("simulate", "simulate a case: trajectory.npz, metrics.json, overview.png", case=True, out=True)
    command("check", "check Theorem 1's conditions along a case; exit code 1 if one fails", case=True)
    return top


def prepare_jax() -> None:
    """float64 unless JAX_ENABLE_X64 says otherwise, and compilations kept between runs."""
    import jax
    import platformdirs

    if "JAX_ENABLE_X64" not in os.environ:  # jax has been imported by now, so setting it there would be too late
        jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = pathlib.Path(platformdirs.user_cache_dir("ambjax")) / "compiled"
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # a home that cannot be written costs time, not correctness
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


def main(argv: list[str] | None = None) -> int:
    """Run a command. Returns its exit code: 0 done, 1 the answer is no, 2 bad input."""
    args = parser().parse_args(argv)
    prepare_jax()
    from ambjax import commands

    try:
        code, summary = getattr(commands, f"run_{args.command}")(args)
    except ValueError as error:
        return complain(str(error))
    except KeyboardInterrupt:
        print("ambjax: interrupted", file=sys.stderr)
        return 130
    if args.json:
        print(json.dumps(summary, indent=2))
    return code


if __name__ == "__main__":
    sys.exit(main())
