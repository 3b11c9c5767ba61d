"""The state of a search and its checkpoint, a file with a checksum."""

import dataclasses
import json
import pathlib
import re
from collections.abc import Callable
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from ambjax.host.sealed import DamagedError, difference, flat, provenance, seal, unseal, write_whole
from tuning.events import Tell
from tuning.solve.descent import Starts
from tuning.solve.evolution import Evolution

State = TypeVar("State")
NAME = re.compile(r"round-[0-9]+\.npz")
# Subfolder of the output directory, and the file in it that marks a search before its first checkpoint.
FOLDER, MARK = "checkpoints", "search.json"
# Names of the arrays of a checkpoint, or their beginnings.
LEAF, PAST, RACED, CONVERGED = "start_", "history_", "raced", "converged"
ORIGIN, SEED, TOLD = "cma_origin", "cma_seed", "cma_told"


@dataclasses.dataclass
class SearchState:
    """State of a search.

    `history`: one row per iteration, of the best point so far. `seconds`: duration so far, s; `earlier`: the part of it
    before the search was resumed. `converged`: whether no further iteration is needed. `evolution`: CMA-ES, which
    continues from the best point of the descents; None: the search does not use it. `raced`: number of iterations of
    the race of the starts (`refine.race_length`).
    """

    starts: Starts
    history: dict[str, list[Any]] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0
    earlier: float = 0.0
    interrupted: bool = False
    converged: bool = False
    evolution: Evolution | None = None
    raced: int = 0

    @property
    def iteration(self) -> int:
        """Number of iterations so far."""
        return len(self.history.get("value", ()))

    @property
    def racing(self) -> bool:
        """Whether several starts continue."""
        return len(self.starts.value) > 1

    @property
    def ended(self) -> bool:
        """Whether the checkpoint contained the complete search, so that no iteration was left to do."""
        return self.earlier > 0 and self.seconds == self.earlier


class CheckpointFile:
    """Reads and writes the checkpoint of a search. A new checkpoint replaces the old one atomically.

    `path`: of the file; None: no checkpoint. `facts`: nested settings that a checkpoint must match to be resumed.
    `round`: number of the search in its `Course`, from 1; a round of `rounds` may have several searches. `tell`:
    receives messages.
    """

    def __init__(
        self, path: pathlib.Path | None, facts: dict[str, Any], round: int = 1, tell: Tell = lambda text: None
    ) -> None:
        self.path, self.round, self.tell = path, round, tell
        self.fingerprint = flat({**provenance(), **facts, "round": round})

    def save(self, progress: SearchState) -> None:
        """Write this state to the checkpoint. Raises ValueError if it cannot be written."""
        if self.path is None:
            return
        _make(self.path.parent)
        leaves = {f"{LEAF}{name}": np.asarray(leaf) for name, leaf in progress.starts._asdict().items()}
        if (cma := progress.evolution) is not None:
            leaves |= {ORIGIN: cma.origin, SEED: np.array(cma.seed), TOLD: np.array(cma.told)}
        past = {f"{PAST}{name}": np.asarray(rows) for name, rows in progress.history.items()}
        facts = {"fingerprint": self.fingerprint, "seconds": progress.seconds}
        ends = {RACED: np.array(progress.raced), CONVERGED: np.array(progress.converged)}
        seal(self.path, {**leaves, **past, **ends}, facts)

    def load(self) -> SearchState | None:
        """Return the saved search, as `restored` does."""

        def state(arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> SearchState:
            starts = Starts(*(jnp.asarray(arrays[f"{LEAF}{name}"]) for name in Starts._fields))
            evolution = Evolution(arrays[ORIGIN], int(arrays[SEED]), arrays[TOLD]) if ORIGIN in arrays else None
            past = {name.removeprefix(PAST): list(rows) for name, rows in arrays.items() if name.startswith(PAST)}
            spent = float(facts["seconds"])
            ended, raced = bool(arrays[CONVERGED]), int(arrays[RACED])
            return SearchState(starts, past, spent, spent, converged=ended, evolution=evolution, raced=raced)

        return restored(self.path, self.fingerprint, state, f"search {self.round}", self.tell)


def restored(
    path: pathlib.Path | None,
    fingerprint: dict[str, Any],
    state: Callable[[dict[str, np.ndarray], dict[str, Any]], State],
    search: str,
    tell: Tell,
) -> State | None:
    """Return the saved state of a search; None if there is none, or if the file is damaged, which `tell` receives.

    `state`: makes it from the arrays and facts of the file. `search`: what begins again if the file is damaged. Raises
    ValueError if the file belongs to another search.
    """
    if path is None or not path.exists():
        return None
    try:
        arrays, facts = unseal(path)
        if differs := difference(facts["fingerprint"], fingerprint):
            raise ValueError(
                f"--resume: {path} belongs to another search: {differs}. "
                "Use another --out, or leave out --resume to start a new search."
            )
        return state(arrays, facts)
    except DamagedError as error:
        why = str(error)
    except KeyError:
        why = "it is not a checkpoint"
    tell(f"{path}: {why}; {search} begins again")
    return None


def mark_directory(directory: pathlib.Path) -> None:
    """Mark a directory as that of a search. The search can then be resumed even before its first checkpoint.

    Raises ValueError if the mark cannot be written.
    """
    text = json.dumps(provenance(), indent=2) + "\n"
    _make(directory / FOLDER)
    write_whole(directory / FOLDER / MARK, lambda file: file.write(text.encode()))


def _make(folder: pathlib.Path) -> None:
    """Make the subfolder of the checkpoints if it does not exist. Raises ValueError if it cannot be made."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be made ({error.strerror}). Choose another --out.") from None


def can_resume(directory: pathlib.Path) -> bool:
    """Return whether a search has begun in this directory and can be resumed."""
    return (directory / FOLDER / MARK).exists()


def checkpoint(number: int) -> str:
    """Return the path of the checkpoint of this search of a `Course`, relative to the output directory."""
    return f"{FOLDER}/round-{number}.npz"


def checkpoints(directory: pathlib.Path) -> list[pathlib.Path]:
    """Return the checkpoint files of a search in this output directory."""
    found = (directory / FOLDER).glob("round-*.npz")
    return sorted(path for path in found if NAME.fullmatch(path.name) and path.is_file())


def has_unfinished_search(directory: pathlib.Path, report: str) -> bool:
    """Return whether a directory contains an unfinished search.

    It has checkpoints, and they are newer than the file `report`, or this file does not exist.
    """
    left, ended = checkpoints(directory), directory / report
    return bool(left) and not (
        ended.exists() and ended.stat().st_mtime_ns >= max(path.stat().st_mtime_ns for path in left)
    )


def remove_all(directory: pathlib.Path) -> int:
    """Remove the checkpoints of a search. Return their number."""
    left = checkpoints(directory)
    for path in left:
        path.unlink()
    return len(left)
