"""Custom laws in a case file: `kind = "FILE.py:CLASS"` or `kind = "MODULE:CLASS"`."""

import dataclasses
import difflib
import pathlib
import types
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax

from ambjax.cases.table import quoted, show
from ambjax.control.base import Law
from ambjax.control.law_trial import reason, try_law
from ambjax.control.machine_law import MachineLaw
from ambjax.control.stages import STAGES
from ambjax.host.extensions import digest_of, module_of_file, module_of_name, pickle_with_source
from ambjax.world.plant import Plant

T = TypeVar("T")
FORM = '"FILE.py:CLASS" or "MODULE:CLASS", a custom law'

# Function that returns the error of a law for a given reason.
Refuse = Callable[[str], ValueError]


class OwnLaw(NamedTuple):
    """A custom law that a case names: its stage, `kind` as written, its class, and the file or module.

    `stage`: "" for a law of a whole machine.

    `file`: absolute path of the file; None for an installed module. `digest`: SHA-256 of the source.
    """

    stage: str
    kind: str
    law: type[Law] | type[MachineLaw]
    file: pathlib.Path | None
    digest: str

    def __str__(self) -> str:
        source = self.kind.rpartition(":")[0] if self.file is None else self.file
        return f"{key_of(self.stage)}: imported {self.law.__name__} from {source}"


def is_own(kind: object) -> bool:
    """Return whether a value of `kind` names a custom law."""
    return isinstance(kind, str) and ":" in kind


def own_law_of(stage: str, kind: str, folder: pathlib.Path, model: Plant | None = None) -> OwnLaw:
    """Import the law that `kind` names, a subclass of that of its stage which is a record.

    `folder`: that of the case file, to which a path is relative. `model`: with which the law is tried; None: it is not.
    Raises ValueError, with the dotted path, the value and the reason, if there is no such class, if the import fails,
    if the class is not a law of this stage, or if it cannot be called with `model`.
    """
    source, _, name = kind.rpartition(":")
    file = (folder / source).resolve() if source.endswith(".py") else None

    def refuse(why: str) -> ValueError:
        return ValueError(f"{key_of(stage)} = {show(kind)}: {why}")

    if not source or not name.isidentifier():
        raise refuse(f"write {FORM}.")
    kind_of_law = _class(_module(source, file, refuse), name, source, STAGES.get(stage, MachineLaw), refuse)
    law = _checked(kind_of_law, name, stage, refuse)
    if file is not None:
        pickle_with_source(kind_of_law)
    found = OwnLaw(stage, kind, kind_of_law, file, digest_of(kind_of_law))
    if model is not None:
        tried(found, lambda: try_law(law, stage, model))
    return found


def tried(law: OwnLaw, trial: Callable[[], T]) -> T:
    """Return the result of a trial of a law. Raises ValueError with the reason if it fails."""
    try:
        return trial()
    except Exception as error:
        why = f"{law.law.__name__} {reason(error, law.file)}."
        raise ValueError(f"{key_of(law.stage)} = {show(law.kind)}: {why}") from error


def key_of(stage: str) -> str:
    """Return the dotted path of the key that names the law of a stage."""
    return f"controller.{stage}.kind" if stage else "controller.kind"


def _module(source: str, file: pathlib.Path | None, refuse: Refuse) -> types.ModuleType:
    try:
        return module_of_name(source) if file is None else module_of_file(file)
    except OSError as error:
        if file is None or error.filename != str(file):
            raise refuse(f"importing it {reason(error, file)}.") from error
        why = f"{file} cannot be read ({error.strerror}). A path is relative to the folder of the case file"
        raise refuse(f"{why}.") from None
    except (Exception, SystemExit) as error:
        missing = isinstance(error, ModuleNotFoundError) and file is None and error.name == source.partition(".")[0]
        hint = ". Install it, set PYTHONPATH, or name a file" if missing else ""
        raise refuse(f"importing it {reason(error, file)}{hint}.") from error


def _class(module: types.ModuleType, name: str, source: str, base: type, refuse: Refuse) -> type:
    """Return the class of this name. Raises ValueError unless it is a law of the stage."""
    laws = [
        one
        for one, thing in vars(module).items()
        if isinstance(thing, type) and issubclass(thing, base) and thing is not base
    ]
    found = getattr(module, name, None)
    if found is None:
        close = difflib.get_close_matches(name, laws, n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        listed = f"Its laws of this stage: {quoted(laws)}." if laws else f"It has no subclass of {_named(base)}."
        raise refuse(f"{source} has no class '{name}'.{hint} {listed}")
    if name not in laws:
        raise refuse(f"{name} is no law of this stage: derive it from {_named(base)}.")
    return found


def _named(base: type) -> str:
    return f"ambjax.extend.{base.__name__}"


def _checked(found: type, name: str, stage: str, refuse: Refuse) -> Any:
    """Return the law with its defaults. Raises ValueError unless the class is a record that defines every method."""
    try:
        law = found()
    except TypeError as error:  # abstract methods, or fields without a default
        words = str(error).strip().rstrip(".")
        raise refuse(f"{words}. Define every method of the stage, and give every field a default.") from None
    if (
        not dataclasses.is_dataclass(found)
        or "__dataclass_fields__" not in vars(found)
        or jax.tree.leaves(law) == [law]
    ):
        raise refuse(f"{name} is no record: put @ambjax.extend.record above the class.")
    for field in dataclasses.fields(found):
        if not (field.metadata.get("leaf") or field.metadata.get("static")):
            raise refuse(f"{name}.{field.name}: declare it by gain(...), leaf(...) or static(...) of ambjax.extend.")
        if field.name == "kind":
            raise refuse(f"{name}.kind: the key kind of [{key_of(stage)[:-5]}] selects the law. Choose another name.")
    return law
