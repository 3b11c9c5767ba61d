"""A search under way and its checkpoint: a sealed file, so that what is gone on with is what was left."""

import dataclasses
import json
import pathlib
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.commands.outputs import say
from ambjax.host.sealed import DamagedError, difference, flat, provenance, seal, shapes, unseal, write_whole
from tuning.objective.loss import TERMS
from tuning.search.descent import Descent, Starts
from tuning.search.evolution import Cloud, clouds

# What a checkpoint holds of a search beside arrays and history.
COUNTS = ("iteration", "phase", "since", "seconds")
FACTS = {"fingerprint", "round", "counts"}
NAME = re.compile(r"checkpoint-[0-9]+\.npz")
# Marks the directory of a search from its beginning on, before there is a checkpoint.
MARK = "search.json"
LEAF, PAST, ACTIVE = "leaf_", "history_", "active"


@dataclasses.dataclass
class SearchState:
    """A search under way. `history` holds one row per iteration; everything else can be read off a checkpoint.

    `since`: the iteration after which the phase began; `seconds` spent on it so far, `earlier` of them before a resume.
    """

    starts: Starts
    active: np.ndarray
    history: dict[str, list[Any]] = dataclasses.field(default_factory=dict)
    iteration: int = 0
    phase: int = 0
    since: int = 0
    seconds: float = 0.0
    earlier: float = 0.0
    interrupted: bool = False
    clouds: Cloud = None  # pyright: ignore[reportAssignmentType]
    """of the starts that go on by CMA-ES, leaves [S, ...]"""

    def __post_init__(self) -> None:
        if self.clouds is None:
            self.clouds = clouds(*self.starts.best.shape)

    @property
    def evolving(self) -> np.ndarray:
        """Which starts go on by CMA-ES [S]."""
        return self.clouds.drawn >= 0

    def cloud(self, at: Any) -> Cloud:
        """The distribution of one start."""
        return Cloud(*(leaf[at] for leaf in self.clouds))

    def put(self, at: Any, cloud: Cloud) -> None:
        """Set the distribution of one start."""
        for whole, part in zip(self.clouds, cloud, strict=True):
            whole[at] = part

    @property
    def ended(self) -> bool:
        """Whether a checkpoint was all of it: nothing has been done since."""
        return self.earlier > 0 and self.seconds == self.earlier


class Keeper:
    """The checkpoint of round number `round` of what `facts` tell (nested, with names): written whole or not at all."""

    def __init__(self, path: pathlib.Path | None, facts: dict[str, Any], round: int = 1):
        self.path, self.round = path, round
        self.fingerprint = flat({**provenance(), **facts})

    def save(self, progress: SearchState) -> None:
        """Keep this state instead of the one before. Raises ValueError if it cannot be written."""
        if self.path is None:
            return
        leaves = {
            f"{LEAF}{n}": np.asarray(leaf) for n, leaf in enumerate(jax.tree.leaves((progress.starts, progress.clouds)))
        }
        past = {f"{PAST}{name}": np.asarray(rows) for name, rows in progress.history.items()}
        counts = {name: getattr(progress, name) for name in COUNTS}
        facts = {"fingerprint": self.fingerprint, "round": self.round, "counts": counts}
        seal(self.path, {**leaves, **past, ACTIVE: progress.active}, facts)

    def load(self, descent: Descent, starts: int, m: int) -> SearchState | None:
        """The search so far, of so many starts in m coordinates; None, with a line that says why, if it is damaged.

        Raises ValueError if it belongs to another problem.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            arrays, facts = unseal(self.path)
            if facts.keys() != FACTS or facts["counts"].keys() != set(COUNTS):
                raise DamagedError("it is no checkpoint")
            differs = difference(facts["fingerprint"], self.fingerprint)
            if differs:
                raise ValueError(
                    f"--resume: {self.path} belongs to another search: {differs}. "
                    "Use another --out, or leave out --resume to begin anew."
                )
            if facts["round"] != self.round:
                raise DamagedError(f"it is that of round {facts['round']}")
            return _progress(arrays, facts["counts"], descent, starts, m)
        except DamagedError as why:
            say(f"{self.path}: {why}; round {self.round} is begun again")
            return None


def begin(directory: pathlib.Path) -> None:
    """Mark a directory as that of a search, so that a search that is killed from here on can be resumed.

    Raises ValueError where it cannot be written.
    """
    text = json.dumps(provenance(), indent=2) + "\n"
    write_whole(directory / MARK, lambda file: file.write(text.encode()))


def begun(directory: pathlib.Path) -> bool:
    """Whether a search has begun in this directory, so that --resume has something to go on with."""
    return (directory / MARK).exists()


def checkpoint(number: int) -> str:
    """Name of the checkpoint of this round."""
    return f"checkpoint-{number}.npz"


def checkpoints(directory: pathlib.Path) -> list[pathlib.Path]:
    """Those of a search in this directory: files with such names, and no others."""
    return sorted(path for path in directory.glob("checkpoint-*.npz") if NAME.fullmatch(path.name) and path.is_file())


def unfinished(directory: pathlib.Path, report: str) -> bool:
    """Whether a directory holds a search that may be gone on with: checkpoints, and no later file of this name."""
    left, ended = checkpoints(directory), directory / report
    return bool(left) and not (
        ended.exists() and ended.stat().st_mtime_ns >= max(path.stat().st_mtime_ns for path in left)
    )


def remove_all(directory: pathlib.Path) -> int:
    """Remove checkpoints of a search that nobody goes on with. Returns how many there were."""
    left = checkpoints(directory)
    for path in left:
        path.unlink()
    return len(left)


def _progress(
    arrays: dict[str, np.ndarray], counts: dict[str, Any], descent: Descent, starts: int, m: int
) -> SearchState:
    """Raises DamagedError where these are not the arrays of such a search."""
    there = shapes(arrays)
    kinds = jax.eval_shape(descent.begin, jnp.zeros((starts, m))), clouds(starts, m)
    leaves, tree = jax.tree.flatten(kinds)
    wanted = {f"{LEAF}{n}": [np.dtype(leaf.dtype).str, list(leaf.shape)] for n, leaf in enumerate(leaves)}
    rows = {"value": (starts,), "x": (starts, m), "gains": (starts, m), "lost": (starts,), "members": ()}
    rows |= {"terms": (starts, len(TERMS)), "rollouts": ()}
    for name, shape in rows.items():
        kind = there.get(f"{PAST}{name}", [None])[0]
        wanted[f"{PAST}{name}"] = [kind, [counts["iteration"], *shape]]
    wanted[ACTIVE] = ["|b1", [starts]]
    differs = difference(there, json.loads(json.dumps(wanted)))
    if differs:
        raise DamagedError(f"it does not fit this search: {differs}")
    history = {name.removeprefix(PAST): list(rows) for name, rows in arrays.items() if name.startswith(PAST)}
    state, drawn = jax.tree.unflatten(tree, [arrays[f"{LEAF}{n}"] for n in range(len(leaves))])
    state = jax.tree.map(jnp.asarray, state)
    return SearchState(state, arrays[ACTIVE], history, **counts, earlier=counts["seconds"], clouds=drawn)
