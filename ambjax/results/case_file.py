"""Cases written as files: the text of a case that was read, with its gains."""

import dataclasses
import pathlib
import tomllib

import jax
import numpy as np

from ambjax.cases.edited import with_numbers
from ambjax.cases.machine_case import AnyCase, MachineCase, machine_from
from ambjax.cases.own_laws import relocated
from ambjax.cases.reader import Case, is_as_written
from ambjax.cases.recordings import relocated_files
from ambjax.cases.table import file_to_write
from ambjax.ensemble.paths import places

# Numbers of a controller that are no gains, or follow from them.
NO_GAINS = ("controller.model.", "controller.notch.gains.")


def save_case(path: str | pathlib.Path, case: Case) -> None:
    """Write a case of one axis, with the gains that `with_gains` gave it, as a file for the commands.

    The file keeps the comments of the file that was read. Raises ValueError if the case was made of parts, if more than
    its gains was changed after it was read, and if the folder of `path` does not exist.

        ambjax.save_case("mine.toml", ambjax.with_gains(case, {"controller.position.c": 20.0}))
    """
    if not isinstance(case, Case):
        raise ValueError(f"save_case: case = {type(case).__name__}: it must be a case of one axis, as of read_case.")
    path = file_to_write("save_case", path)
    path.write_text(with_numbers(text_with_gains(case), files_from(case, path.parent)), encoding="utf-8")


def files_from(case: Case, out: pathlib.Path) -> dict[str, str]:
    """Return the names of the files of a case for a case file in the folder `out`, by dotted path."""
    controller = case.controller_file.relocated(out) if case.controller_file else {}
    return relocated(case.own_laws, out) | relocated_files(case.recorded, out) | controller


def text_with_gains(case: AnyCase) -> str:
    """Return the text of a case with its gains. Raises ValueError if more than gains was changed after it was read."""
    if not case.text:
        raise ValueError("case: it was made of parts, and has no tables. Give a path, or a dict of tables.")
    if isinstance(case, MachineCase):
        read = machine_from(tomllib.loads(case.text), case.name, case.text, case.folder)
        same = all(map(np.array_equal, *(jax.tree.leaves((one.machine, one.clock)) for one in (read, case))))
    elif not (same := is_as_written(case)):
        known = places(case.cascade, case.scenario).items()
        own = [(path, one.value) for path, one in known if path.startswith("controller.") and one.value is not None]
        gains = {path: float(x) for path, x in own if not path.startswith(NO_GAINS)}
        text = with_numbers(case.text, gains)
        case = dataclasses.replace(case, text=text)
        same = is_as_written(case)
    if not same:
        raise ValueError("case: more than its gains was changed after it was read. Change its tables, and read them.")
    return case.text
