"""`export`: the files of the command `ambjax export`, and the results of its verification, as a Python object."""

import contextlib
import dataclasses
import hashlib
import json
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import numpy as np

from ambjax.cases.case_table import notebook_table
from ambjax.cases.given import names_arguments, of_case
from ambjax.cases.reader import Case, is_as_written
from ambjax.cases.table import require_file
from ambjax.codegen import verify
from ambjax.codegen.block import Block
from ambjax.codegen.c99 import machine, package
from ambjax.codegen.c99.source import MARK, Origin
from ambjax.codegen.c99.statements import RESERVED
from ambjax.codegen.fmi import archive
from ambjax.codegen.javascript.script import script
from ambjax.codegen.loop_step import WHAT, block_of
from ambjax.codegen.program import PRECISIONS
from ambjax.codegen.trace import trace
from ambjax.codegen.twins import LoopCase
from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import ends
from ambjax.results.outputs import described, directory, files, plain, spare
from ambjax.simulation.system import guarded

FORMATS = ("c", "fmu", "js")
# Files of the verification.
VERIFIED = ("verify.md", "verify.json")
# Largest length of a prefix.
MOST_LETTERS = 61
# Names of the files of an FMU export, with the prefix p: the FMU, and its reference input, output and options.
FMU_NAMES = ("{p}.fmu", "{p}_in.csv", "{p}_ref.csv", "{p}_ref.opt")
# Names of the standard C headers. A prefix must not be one of them, because the package contains PREFIX.h.
HEADER_NAMES = {
    *("assert", "complex", "ctype", "errno", "fenv", "inttypes", "iso646", "limits", "locale", "math", "setjmp"),
    *("signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time", "wchar"),
    "wctype",
}
# Keywords of C and of JavaScript that RESERVED does not contain.
KEYWORDS = {
    *("arguments", "await", "break", "class", "continue", "debugger", "else", "eval", "extends", "finally", "for"),
    *("function", "if", "implements", "import", "in", "instanceof", "interface", "let", "null", "package", "return"),
    *("super", "try", "typeof", "var", "while", "with", "yield"),
}


class Plan(NamedTuple):
    """A checked export of a `block`, with the options of `export`.

    `prefix`: of all C names. `verified`: whether the C is compared with JAX.
    """

    case: Case
    block: Block
    format: str
    fmi: int
    precision: str
    prefix: str
    verified: bool

    @property
    def mark(self) -> str:
        """Line by which a later export recognises the files."""
        return MARK.format(p=self.prefix)

    @property
    def origin(self) -> Origin:
        """Name and checksum of the case, and the description of the block."""
        as_read = self.case.text and is_as_written(self.case)  # a case that was changed has no file
        digest = hashlib.sha256(self.case.text.encode()).hexdigest() if as_read else ""
        return Origin(self.case.name, digest, self.block.described())


@dataclasses.dataclass(frozen=True)
class ExportedCase:
    """The result of `export`. A notebook shows it as the table of its checks.

    - `plan`: what was exported, and how.
    - `files`: content of each file by its name, text or (an FMU) bytes. Verification adds verify.md and verify.json.
    - `checks`: results of the verification; empty without it. Each has the fields name, precision, found, allowed, ok.
    """

    plan: Plan
    files: Mapping[str, str | bytes] = dataclasses.field(repr=False)
    checks: list[verify.Check]

    @property
    def ok(self) -> bool | None:
        """Whether no check fails; None without verification."""
        return verify.holds(self.checks) if self.checks else None

    @names_arguments(out="folder")
    def write(self, folder: str | pathlib.Path) -> pathlib.Path:
        """Write all files into a folder, which is made if it does not exist, and return the folder.

        Files of an earlier export with the same prefix are overwritten. Without verification, its verify.md and
        verify.json are removed. Raises ValueError, and writes nothing, if the folder cannot be written, or if another
        file in it has one of the names.
        """
        require_file("folder", folder, "the path of a folder, as text or a pathlib.Path")
        with destination(str(folder), "", self.plan) as (out, part):
            self.put(part)
        return out

    def put(self, part: pathlib.Path) -> None:
        """Write all files into the folder `part`, without any check."""
        for name, content in self.files.items():
            (part / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    def _repr_html_(self) -> str:
        names = f"{self.plan.block.noun} of {self.plan.case.name}: {', '.join(self.files)}"
        rows = [(*check[:4], check.verdict) for check in self.checks]
        return notebook_table(names, ("check", "precision", "found", "allowed", "verdict"), rows)


@of_case()
@names_arguments()
def export(
    case: Case,
    what: str = "controller",
    *,
    format: str = "c",
    fmi: int | None = None,
    precision: str | None = None,
    prefix: str | None = None,
    verify: bool = False,
) -> ExportedCase:
    """Return the controller, the plant or the loop of a case as C, FMU or JavaScript, as `ambjax export` writes it.

    - `case`: from `read_case`, with the table [processor].
    - `what`: part to export, "controller", "plant" or "loop".
    - `format`: "c" for a C package, "fmu" for an FMU, "js" for JavaScript.
    - `fmi`: version of FMI of an FMU, 2 or 3; None: 3.
    - `precision`: C type of all numbers of a C package, "float" or "double"; None: "float". Other formats have double.
    - `prefix`: prefix of all names in the C code, or name of the JavaScript object, a C identifier; None: the case's
      name, made a C identifier.
    - `verify`: compile the C in both precisions and compare it with JAX. Takes about a minute; needs a C compiler.

    Writes no files: see `ExportedCase.write`. Returns an `ExportedCase`; a failed check is a result, see its `ok`.
    Raises ValueError for an option that is not allowed, a case that cannot be exported, and a missing compiler.

        ambjax.export(case, verify=True).write("c")
    """
    return generated(planned(case, what, format, fmi, precision, prefix, verify))


def planned(
    case: Case, what: str, format: str, fmi: int | None, precision: str | None, prefix: str | None, verified: bool
) -> Plan:
    """Check the options of `export` and build the block. Raises ValueError as `export` does."""
    _choice("what", what, WHAT)
    _choice("format", format, FORMATS)
    _choice("fmi", fmi, (None, 2, 3))
    _choice("precision", precision, (None, *PRECISIONS))
    name = _prefix(prefix, case.name)
    block = block_of(what, guarded_for(case), case.scenario, case.clock)
    if fmi is not None and format != "fmu":
        raise ValueError(f"--fmi {fmi}: it is the version of an FMU. Omit --fmi, or set --format to fmu.")
    if precision == "float" and format != "c":
        advice = "Omit --precision, or set --format to c."
        raise ValueError(f"--precision float: --format {format} computes in double. {advice}")
    if verified and format == "js":
        raise ValueError("--verify: it compares C with JAX. Omit it, or set --format to c.")
    if verified:
        machine.check_compiler()
    return Plan(case, block, format, fmi or 3, precision or "float", name, verified)


def _choice(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} = {value!r}: it must be one of {', '.join(map(repr, allowed))}.")


def generated(plan: Plan) -> ExportedCase:
    """Generate the files of a plan, in both precisions if it is verified, and run the checks."""
    if not plan.verified:
        return ExportedCase(plan, _built(plan), [])
    case = plan.case
    drafts = {name: verify.draft(plan.block, name, plan.prefix, plan.origin) for name in PRECISIONS}
    loop = LoopCase(case.cascade, case.scenario, case.clock, case.settle)
    checks = described("the verification", lambda: verify.verify(drafts, loop))
    if checks is None:  # the files are written, but they are not verified
        checks = [verify.Check("verification", plan.precision, "it ended with an error", "it is complete", False)]
    built = _built(plan) if plan.format == "fmu" else {**drafts[plan.precision].files}
    record = {"from": plan.mark, "ok": verify.holds(checks), "checks": [check._asdict() for check in checks]}
    page = verify.checks_page(checks, case.name, plan.mark, plan.block.noun)
    text = json.dumps(plain(record), indent=2) + "\n"
    return ExportedCase(plan, {**built, VERIFIED[0]: page, VERIFIED[1]: text}, checks)


def _built(plan: Plan) -> dict[str, str | bytes]:
    """Return the content of each file by name, without verification."""
    if plan.format == "js":
        text = script(trace(plan.block, "double"), plan.prefix)
        return {f"{plan.prefix}.js": f"// {plan.mark}\n{text}"}
    if plan.format == "c":
        return {**package.files_of_trace(trace(plan.block, plan.precision), plan.prefix, plan.origin)}
    case, traced = plan.case, trace(plan.block, "double")
    fmu = {f"{plan.prefix}.fmu": archive.packed(traced, plan.prefix, plan.origin, plan.fmi)}
    cascade = guarded_for(case)
    block = plan.block, plan.prefix, traced.read, cascade, case.scenario, case.clock
    return fmu | (described("the reference data", lambda: archive.files_of(*block)) or {})


@contextlib.contextmanager
def destination(out: str | None, name: str, plan: Plan) -> Iterator[tuple[pathlib.Path, pathlib.Path]]:
    """Yield the output directory, and a folder whose files move into it at the end of the `with` block, as in `files`.

    Without verification, the verification of an earlier export is removed, because it does not apply to the new files.
    """
    path = directory(out, name)
    fmu = path / f"{plan.prefix}.fmu"
    old = fmu.is_file() and fmu.read_bytes().endswith(plan.mark.encode())  # then its reference data may be overwritten
    names = {"fmu": FMU_NAMES[: 1 if old else None], "js": ("{p}.js",), "c": package.NAMES}[plan.format]
    spare(path, [*(name.format(p=plan.prefix) for name in names), *VERIFIED], plan.mark)
    with files(path) as part:
        yield path, part
    if not plan.verified:
        for name in VERIFIED:
            (path / name).unlink(missing_ok=True)


def guarded_for(case: Case) -> Cascade:
    """Return the cascade of a case, with guard limits wide enough for the sensor at both ends of every spread."""
    widest = ends(case.spread, case.cascade, case.scenario, ("sensor.", "run.clearance", "plant.s_0"))[1]
    cascade = guarded(case.cascade, widest, float(case.clock.sample_period))
    return cascade.with_processor(guard=jax.tree.map(lambda x: float(np.max(x)), cascade.timing.guard))


def _prefix(option: str | None, name: str) -> str:
    """Return the prefix of all C names: the option, or one from `name`. Raises ValueError for an invalid option."""
    if option is None:
        derived = re.sub(r"\W", "_", name, flags=re.ASCII)
        return derived if _is_name(derived) else f"amb_{derived}"[:MOST_LETTERS]
    if not isinstance(option, str) or not _is_name(option):
        raise ValueError(
            f"--prefix {option}: it must be a C identifier (a letter, then at most {MOST_LETTERS - 1} letters, "
            "digits or '_'), no keyword of C or JavaScript, and not the name of a C header. For example: controller."
        )
    return option


def _is_name(text: str) -> bool:
    """Return whether a text can be the prefix: a C identifier that is neither a keyword nor the name of a C header."""
    words = RESERVED | HEADER_NAMES | KEYWORDS
    valid = re.fullmatch(r"[A-Za-z]\w*", text, flags=re.ASCII) is not None and len(text) <= MOST_LETTERS
    return valid and text not in words
