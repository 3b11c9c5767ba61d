"""Break the program on purpose, one line at a time, and check that a named test fails.

    python tests/mutate.py [--jobs N] [--share K] [WORD ...]

Each mutation of tests/mutations.py (with WORDs: each whose text contains one of them) is applied to a temporary copy of
the project, and its test runs there. The test must pass without the mutation and fail with it. With `--share K`,
one mutation in K is applied. The choice depends on the text of the changed files, so each change of the program gives
another sample. The exit code is 1 if a mutant survives, if the text of a mutation is not found exactly once, or if its
test fails without the mutation.
"""

import argparse
import math
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from mutations import MUTATIONS, Mutation

ROOT = pathlib.Path(__file__).parent.parent
COPIED = ("ambjax", "tuning", "tests", "pyproject.toml")
# Far more than any of these tests takes, because a mutant may loop forever. ALL_LIMIT_S is for all tests together.
LIMIT_S, ALL_LIMIT_S = 400, 3600
PASSED, FAILED = 0, 1
KILLED, SURVIVED = "killed", "SURVIVED"


def mutated(mutation: Mutation) -> str:
    """Return the text of the mutated file. Raises ValueError if the mutation does not fit the file."""
    path, where = ROOT / mutation.file, f"{mutation.file}: '{mutation.fault}'"
    if not path.exists():
        raise ValueError(f"{where}: there is no such file. Adapt it in tests/mutations.py.")
    text = path.read_text(encoding="utf-8")
    if (count := text.count(mutation.old)) != 1:
        raise ValueError(f"{where}: {mutation.old!r} is found {count} times, not once. Adapt it in tests/mutations.py.")
    changed = text.replace(mutation.old, mutation.new)
    if mutation.file.endswith(".py"):
        compile(changed, mutation.file, "exec")
    return changed


def sample(mutations: Sequence[Mutation], share: int) -> list[Mutation]:
    """Return one mutation in `share`, by checksums of their names and of the files that they change."""
    by_checksum = sorted(mutations, key=lambda m: zlib.crc32(f"{m.fault}\n{mutated(m)}".encode()))
    return by_checksum[: math.ceil(len(mutations) / share)]


def run(change: Mutation | None, *words: str) -> tuple[int | None, str]:
    """Run pytest in a copy of the project in which one file is changed. Return its exit code and output."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy = pathlib.Path(folder).resolve()
        for name in COPIED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(ROOT / name, copy / name)
        if change:
            (copy / change.file).write_text(mutated(change), encoding="utf-8")
        cache = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "programs")}
        output = copy / "output.txt"
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "", "-p", "no:cacheprovider", *words]
        environment = cache | os.environ | {"PYTHONPATH": str(copy)}
        limit = LIMIT_S if change else ALL_LIMIT_S
        with output.open("w") as file:
            try:
                done = subprocess.run(command, cwd=copy, env=environment, stdout=file, stderr=file, timeout=limit)
                code = done.returncode
            except subprocess.TimeoutExpired:
                code = None
        return code, output.read_text(encoding="utf-8", errors="replace")


def verdict(mutation: Mutation) -> str:
    """Return KILLED, SURVIVED, or a text with the reason why the test gave no verdict."""
    code, output = run(mutation, "-n", "0", mutation.test)
    reason = f"NOT JUDGED (exit code of pytest: {code}): {output.strip()[-300:]}"
    return {PASSED: SURVIVED, FAILED: KILLED}.get(code, reason)


def hunt(mutations: Sequence[Mutation], jobs: int) -> int:
    """Test all mutations and print the verdicts. Return the exit code."""
    tests = sorted({mutation.test for mutation in mutations})
    print(f"{len(tests)} tests without mutations ...", flush=True)
    code, output = run(None, "-n", str(jobs), "--dist", "loadscope", *tests)
    if code != PASSED:
        print(f"{output}\nThe tests do not pass without mutations: mend them first.")
        return 1

    def one(mutation: Mutation) -> str:
        found = verdict(mutation)
        print(f"{found}: {mutation.fault} [{mutation.test}]", flush=True)
        return found

    with ThreadPoolExecutor(jobs) as pool:
        found = list(pool.map(one, mutations))
    print(f"{found.count(KILLED)} of {len(found)} mutations were killed.")
    return int(found.count(KILLED) < len(found))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Break the program line by line; each time a named test must fail.")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="mutants at a time (default 2)")
    parser.add_argument("--share", type=int, default=1, metavar="K", help="one in K mutations only (default 1: all)")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only mutations whose text has one of these")
    args = parser.parse_args(argv)
    chosen = [m for m in MUTATIONS if not args.words or any(w in f"{m.fault} {m.file} {m.test}" for w in args.words)]
    if not chosen:
        parser.error(f"no mutation has {' or '.join(args.words)} in its text.")
    return hunt(sample(chosen, max(args.share, 1)), args.jobs)


if __name__ == "__main__":
    sys.exit(main())
