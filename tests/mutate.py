"""Break the program on purpose, one line at a time, and check that a named test fails.

    python tests/mutate.py [--jobs N] [--share K] [WORD ...]

Each mutation of tests/mutations.py (with WORDs: each whose text contains one of them) is applied to a temporary copy of
the project, and its test runs there. The test must pass without the mutation and fail with it. With `--share K` about
one mutation in K is applied. The choice depends on the text of the changed files, so each change of the program gives
another sample. The exit code is 1 if a mutant survives, if the text of a mutation is not found exactly once, or if its
test fails without the mutation.
"""

import argparse
import os
import pathlib
import queue
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from forked import OVER_TIME, Parent
from mutations import MUTATIONS, Mutation

ROOT = pathlib.Path(__file__).parent.parent
COPIED = ("ambjax", "tuning", "tests", "pyproject.toml")
# Far more than any of these tests takes, because a mutant may loop forever. ALL_LIMIT_S is for all tests together.
LIMIT_S, ALL_LIMIT_S = 400, 3600
PASSED, FAILED = 0, 1
KILLED, SURVIVED = "killed", "SURVIVED"


def mutated(mutation: Mutation, root: pathlib.Path = ROOT) -> str:
    """Return the text of the mutated file. Raises ValueError if the mutation does not fit the file."""
    path, where = root / mutation.file, f"{mutation.file}: '{mutation.fault}'"
    if not path.exists():
        raise ValueError(f"{where}: there is no such file. Adapt it in tests/mutations.py.")
    text = path.read_text(encoding="utf-8")
    if (count := text.count(mutation.old)) != 1:
        raise ValueError(f"{where}: {mutation.old!r} is found {count} times, not once. Adapt it in tests/mutations.py.")
    changed = text.replace(mutation.old, mutation.new)
    if changed == text:
        raise ValueError(f"{where} changes nothing. Adapt it in tests/mutations.py.")
    if mutation.file.endswith(".py"):
        compile(changed, mutation.file, "exec")
    return changed


def sample(mutations: Sequence[Mutation], share: int, root: pathlib.Path = ROOT) -> list[Mutation]:
    """Return one mutation in `share`, by checksums of their names and of the files that they change."""
    text = {name: (root / name).read_text(encoding="utf-8") for name in {m.file for m in mutations}}
    return [m for m in mutations if zlib.crc32(f"{m.fault}\n{text[m.file]}".encode()) % share == 0]


def parent() -> Parent:
    """Start a process that forks the tests. Its compiled programs are those of the test suite."""
    return Parent({"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "programs")} | dict(os.environ))


def run(forks: Parent, root: pathlib.Path, change: Mutation | None, *words: str) -> tuple[int, str]:
    """Run pytest in a copy of the project in which one file is changed. Return its exit code and output."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy = pathlib.Path(folder).resolve()
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, copy / name)  # with its bytecode, which stays valid
            elif (root / name).exists():
                shutil.copy2(root / name, copy / name)
        if change:
            (copy / change.file).write_text(mutated(change, root), encoding="utf-8")
            for stale in (copy / change.file).parent.glob(f"__pycache__/{pathlib.Path(change.file).stem}.*"):
                stale.unlink()
        limit_s = LIMIT_S if change else ALL_LIMIT_S
        command = ["-q", "-x", "-m", "", "-p", "no:cacheprovider", *words]
        code, output = forks.run(str(copy), command, limit_s)
        return code, f"not finished after {limit_s} s" if code == OVER_TIME else output


def verdict(mutation: Mutation, root: pathlib.Path, forks: Parent) -> str:
    """Return KILLED, SURVIVED, or a text with the reason why the test gave no verdict."""
    code, output = run(forks, root, mutation, "-n", "0", mutation.test)
    if code in (PASSED, FAILED):
        return SURVIVED if code == PASSED else KILLED
    return f"NOT JUDGED (pytest ended with {code}): {output.strip()[-300:]}"


def hunt(
    mutations: Sequence[Mutation], root: pathlib.Path = ROOT, jobs: int = 2, say: Callable[[str], None] = print
) -> int:
    """Test all mutations and print the verdicts. Return the exit code."""
    try:
        for mutation in mutations:
            mutated(mutation, root)
    except ValueError as error:
        say(str(error))
        return 1
    parents = [parent() for _ in range(jobs)]
    try:
        return _hunt(mutations, root, parents, say)
    finally:
        for forks in parents:
            forks.close()


def _hunt(
    mutations: Sequence[Mutation], root: pathlib.Path, parents: Sequence[Parent], say: Callable[[str], None]
) -> int:
    """Test the mutations, one at a time in each process of `parents`. Return the exit code."""
    tests = sorted({mutation.test for mutation in mutations})
    say(f"{len(tests)} tests without mutations ...")
    code, output = run(parents[0], root, None, "-n", str(len(parents)), "--dist", "loadscope", *tests)
    if code != PASSED:
        say(f"{output}\nThe tests do not pass without mutations: mend them first.")
        return 1
    free: queue.SimpleQueue[Parent] = queue.SimpleQueue()
    for forks in parents:
        free.put(forks)

    def one(mutation: Mutation) -> str:
        forks, began = free.get(), time.perf_counter()
        try:
            found = verdict(mutation, root, forks)
        finally:
            free.put(forks)
        say(f"{found}, {time.perf_counter() - began:.0f} s: {mutation.fault} [{mutation.test}]")
        return found

    # Mutants of one test file run next to each other: they share compiled programs.
    ordered = sorted(mutations, key=lambda mutation: mutation.test)
    with ThreadPoolExecutor(len(parents)) as pool:
        found = list(pool.map(one, ordered))
    left = [mutation.fault for mutation, what in zip(ordered, found, strict=True) if what != KILLED]
    say(f"{len(ordered) - len(left)} of {len(ordered)} mutations were killed. {'; '.join(left)}".rstrip())
    return int(bool(left))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Break the program line by line; each time a named test must fail.")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="mutants at a time (default 2)")
    parser.add_argument("--share", type=int, default=1, metavar="K", help="one in K mutations only (default 1: all)")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only mutations whose text has one of these")
    args = parser.parse_args(argv)
    chosen = [m for m in MUTATIONS if not args.words or any(w in f"{m.fault} {m.file} {m.test}" for w in args.words)]
    if not chosen:
        parser.error(f"no mutation has {' or '.join(args.words)} in its text.")
    return hunt(sample(chosen, max(args.share, 1)), jobs=args.jobs, say=lambda text: print(text, flush=True))


if __name__ == "__main__":
    sys.exit(main())
