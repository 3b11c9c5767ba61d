"""Linear controllers in files: the matrices of a position law, in an .npz or .mat file that a case file names."""

import contextlib
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.recordings import npz_arrays
from ambjax.cases.table import Table, file_to_write, show
from ambjax.control.linear_controller import state_space_of
from ambjax.control.realisation import realisation

NAMES, OPTIONAL = ("A", "B", "C", "D"), "dt"
NEEDED = "the arrays A, B, C, D and, for a discrete controller, dt in s"
ENDINGS = (".npz", ".mat")
KEY = "controller.position.file"


class ControllerFile(NamedTuple):
    """The file of a linear controller: its path as written in the case file, the absolute path, and its contents."""

    written: str
    path: pathlib.Path
    contents: Any


def contents_of(table: Table, folder: pathlib.Path, convert: Callable[[dict[str, np.ndarray]], Any]) -> ControllerFile:
    """Read the .npz or .mat file that the key `file` names. Its contents are convert(arrays)."""
    written = table.raw["file"]
    if not isinstance(written, str) or not written.endswith(ENDINGS):
        raise ValueError(f"{table.at('file')} = {show(written)}: it must be the path of an .npz or .mat file.")
    path = (folder / written).resolve()
    try:
        arrays = npz_arrays(path) if path.suffix == ".npz" else _of_mat(path)
        return ControllerFile(written, path, convert(arrays))
    except (OSError, ValueError) as error:
        why = str(error)
        if isinstance(error, OSError):
            unread = error.strerror or "is it a file?"
            why = f"{path} cannot be read ({unread}). A path is relative to the folder of the case file."
        raise ValueError(f"{table.at('file')} = {show(written)}: {why}") from None


def controller_file(table: Table, folder: pathlib.Path, convert: Callable[..., Any] = realisation) -> ControllerFile:
    """Read the controller that the key `file` names. Its contents are convert(A, B, C, D, dt) of its arrays.

    A relative path starts at `folder`, that of the case file. Raises ValueError, one line, if the key is missing or the
    file does not contain a controller. The message gives the dotted path and, if known, the file and the array.
    """

    def matrices(arrays: dict[str, np.ndarray]) -> Any:
        if missing := [name for name in NAMES if name not in arrays]:
            found = ", ".join(name for name in arrays if not name.startswith("_")) or "none"
            raise ValueError(f"the array {missing[0]} is missing. The file must contain {NEEDED}; it has {found}.")
        return convert(**{name: arrays[name] for name in (*NAMES, OPTIONAL) if name in arrays})

    if "file" not in table.raw:
        raise ValueError(f"{table.at('file')} is missing: give the path of an .npz or .mat file with {NEEDED}.")
    return contents_of(table, folder, matrices)


def _of_mat(path: pathlib.Path) -> dict[str, np.ndarray]:
    import scipy.io

    try:
        arrays = scipy.io.loadmat(path, appendmat=False)
    except NotImplementedError:
        raise ValueError("a .mat file of version 7.3, which is not supported. Save it with the option -v7.") from None
    except OSError:
        raise
    except Exception:  # SciPy raises errors of many types for a damaged file
        raise ValueError("not a .mat file. Save the arrays with MATLAB's save and the option -v7.") from None
    with contextlib.suppress(KeyError):  # MATLAB stores a number as a matrix
        arrays[OPTIONAL] = arrays[OPTIONAL].squeeze()
    return arrays


def save_controller(path: str | pathlib.Path, system: Any) -> None:
    """Write a linear controller of python-control or SciPy into an .npz or .mat file, for `kind = "linear"` of a case.

    `system`: a transfer function, or an object with the matrices A, B, C, D; with the period dt (s). Without it, or if
    it is None or 0, the system is continuous. Raises ValueError for another ending of the path, for a directory that
    does not exist, and for matrices that are not those of a controller (`state_space_of`, `realisation`).

        ambjax.save_controller("controller.npz", control.tf([2e4, 5e6], [1.0, 3e4]))
    """
    path = file_to_write("save_controller", path)
    system = state_space_of(system)
    dt = getattr(system, OPTIONAL, None)
    arrays = {name: np.asarray(getattr(system, name)) for name in NAMES}
    realisation(**arrays, dt=dt)
    arrays[OPTIONAL] = np.asarray(0.0 if dt is None else dt)
    if not str(path).endswith(ENDINGS):
        raise ValueError(f"{path}: the file must end in .npz or .mat.")
    if path.suffix == ENDINGS[0]:
        np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
    else:
        import scipy.io

        scipy.io.savemat(path, arrays)
