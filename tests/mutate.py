"""Break the program on purpose, one line at a time, and demand that a named test notices.

    python tests/mutate.py [--jobs N] [WORD ...]

Every mutation of tests/mutations.py (with WORDs: those whose text has one of them) is made in a temporary copy of the
project, never in place, and the test that guards the line is run there: it must pass without the mutation and fail
with it. Exit code 1 if one survives, if its text is no longer found exactly once, or if its test fails by itself.
"""

import argparse
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from mutations import MUTATIONS, Mutation

ROOT = pathlib.Path(__file__).parent.parent
COPIED = ("ambjax", "tuning", "tests", "pyproject.toml")
# Far more than any of these tests takes: a mutant may also loop forever.
LIMIT_S = 400
PASSED, FAILED = 0, 1
KILLED, SURVIVED = "killed", "SURVIVED"


def mutated(mutation: Mutation, root: pathlib.Path = ROOT) -> str:
    """The text of the mutated file. Raises ValueError where the mutation no longer fits it."""
    path, where = root / mutation.file, f"{mutation.file}: '{mutation.says}'"
    if not path.exists():
        raise ValueError(f"{where}: there is no such file. Adapt it in tests/mutations.py.")
    text = path.read_text(encoding="utf-8")
    if (count := text.count(mutation.old)) != 1:
        raise ValueError(f"{where}: {mutation.old!r} is found {count} times, not once. Adapt it in tests/mutations.py.")
    changed = text.replace(mutation.old, mutation.new)
    if changed == text:
        raise ValueError(f"{where} changes nothing. Adapt it in tests/mutations.py.")
    compile(changed, mutation.file, "exec")
    return changed


def run(root: pathlib.Path, change: Mutation | None, *words: str) -> tuple[int, str]:
    """Exit code and output of pytest in a copy of the project, one file of it changed."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy = pathlib.Path(folder)
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif (root / name).exists():
                shutil.copy(root / name, copy / name)
        if change:
            (copy / change.file).write_text(mutated(change, root), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "", "-p", "no:cacheprovider", *words]
        env = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "programs")} | dict(os.environ)
        env |= {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=copy, env=env, timeout=LIMIT_S, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
        except subprocess.TimeoutExpired:
            return -1, f"not finished after {LIMIT_S} s"
        return done.returncode, done.stdout


def verdict(mutation: Mutation, root: pathlib.Path = ROOT) -> str:
    """KILLED, SURVIVED, or why neither can be said."""
    code, output = run(root, mutation, "-n", "0", mutation.test)
    if code in (PASSED, FAILED):
        return SURVIVED if code == PASSED else KILLED
    return f"NOT JUDGED (pytest ended with {code}): {output.strip()[-300:]}"


def hunt(
    mutations: Sequence[Mutation], root: pathlib.Path = ROOT, jobs: int = 2, say: Callable[[str], None] = print
) -> int:
    """The whole hunt; the exit code."""
    try:
        for mutation in mutations:
            mutated(mutation, root)
    except ValueError as error:
        say(str(error))
        return 1
    tests = sorted({mutation.test for mutation in mutations})
    say(f"{len(tests)} tests without mutations ...")
    code, output = run(root, None, "-n", str(jobs), "--dist", "loadscope", *tests)
    if code != PASSED:
        say(f"{output}\nThe tests do not pass without mutations: mend them first.")
        return 1

    def one(mutation: Mutation) -> str:
        began = time.perf_counter()
        found = verdict(mutation, root)
        say(f"{found}, {time.perf_counter() - began:.0f} s: {mutation.says} [{mutation.test}]")
        return found

    with ThreadPoolExecutor(jobs) as pool:
        found = list(pool.map(one, mutations))
    left = [mutation.says for mutation, what in zip(mutations, found, strict=True) if what != KILLED]
    say(f"{len(mutations) - len(left)} of {len(mutations)} mutations were killed. {'; '.join(left)}".rstrip())
    return int(bool(left))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Break the program line by line; each time a named test must fail.")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="mutants at a time (default 2)")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only mutations whose text has one of these")
    args = parser.parse_args(argv)
    chosen = [m for m in MUTATIONS if not args.words or any(w in f"{m.says} {m.file} {m.test}" for w in args.words)]
    if not chosen:
        parser.error(f"no mutation has {' or '.join(args.words)} in its text.")
    return hunt(chosen, jobs=args.jobs, say=lambda text: print(text, flush=True))


if __name__ == "__main__":
    sys.exit(main())
