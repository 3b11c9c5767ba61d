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
from ambjax.host.sealed import DamagedError, difference, flat, provenance, seal, shapes, unseal
from tuning.objective.loss import TERMS
from tuning.search.descent import Descent, Starts

# What a checkpoint holds of a search beside arrays and history.
COUNTS = ("iteration", "phase", "since", "seconds")
FACTS = {"fingerprint", "round", "counts"}
NAME = re.compile(r"checkpoint-[0-9]+\.npz")
LEAF, PAST, ACTIVE = "leaf_", "history_", "active"


@dataclasses.dataclass
class Progress:
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

    @property
    def ended(self) -> bool:
        """Whether a checkpoint was all of it: nothing has been done since."""
        return self.earlier > 0 and self.seconds == self.earlier


class Keeper:
    """The checkpoint of round number `round` of what `facts` tell (nested, with names): written whole or not at all."""

    def __init__(self, path: pathlib.Path | None, facts: dict[str, Any], round: int = 1):
        self.path, self.round = path, round
        self.fingerprint = flat({**provenance(), **facts})

    def save(self, progress: Progress) -> None:
        """Keep this state instead of the one before. Raises ValueError if it cannot be written."""
        if self.path is None:
            return
        leaves = {f"{LEAF}{n}": np.asarray(leaf) for n, leaf in enumerate(jax.tree.leaves(progress.starts))}
        past = {f"{PAST}{name}": np.asarray(rows) for name, rows in progress.history.items()}
        counts = {name: getattr(progress, name) for name in COUNTS}
        facts = {"fingerprint": self.fingerprint, "round": self.round, "counts": counts}
        seal(self.path, {**leaves, **past, ACTIVE: progress.active}, facts)

    def load(self, descent: Descent, starts: int, m: int) -> Progress | None:
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


def _progress(arrays: dict[str, np.ndarray], counts: dict[str, Any], descent: Descent, starts: int, m: int) -> Progress:
    """Raises DamagedError where these are not the arrays of such a search."""
    begun = jax.eval_shape(descent.begin, jnp.zeros((starts, m)))
    leaves, tree = jax.tree.flatten(begun)
    wanted = {f"{LEAF}{n}": [np.dtype(leaf.dtype).str, list(leaf.shape)] for n, leaf in enumerate(leaves)}
    rows = {"value": (starts,), "x": (starts, m), "gains": (starts, m), "lost": (starts,), "members": ()}
    rows |= {"terms": (starts, len(TERMS)), "rollouts": ()}
    there = shapes(arrays)
    for name, shape in rows.items():
        kind = there.get(f"{PAST}{name}", [None])[0]
        wanted[f"{PAST}{name}"] = [kind, [counts["iteration"], *shape]]
    wanted[ACTIVE] = ["|b1", [starts]]
    differs = difference(there, json.loads(json.dumps(wanted)))
    if differs:
        raise DamagedError(f"it does not fit this search: {differs}")
    history = {name.removeprefix(PAST): list(rows) for name, rows in arrays.items() if name.startswith(PAST)}
    state = jax.tree.unflatten(tree, [jnp.asarray(arrays[f"{LEAF}{n}"]) for n in range(len(leaves))])
    return Progress(state, arrays[ACTIVE], history, **counts, earlier=counts["seconds"])
