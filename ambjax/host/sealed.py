"""Files that are written atomically, with a checksum by which later damage is found.

A sealed file is an .npz with an additional entry, `seal`: JSON that holds facts (which run the arrays belong to), the
dtype and shape of every array, and a SHA-256 of all of these and of the arrays. `unseal` returns what was written, or
raises DamagedError.
"""

import contextlib
import hashlib
import json
import os
import pathlib
import secrets
import zipfile
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import IO, Any

import numpy as np

from ambjax._version import __version__

SEAL, CHECKSUM, ARRAYS = "seal", "sha256", "arrays"

Arrays = dict[str, np.ndarray]


class DamagedError(Exception):
    """A file does not hold what was written into it. The text gives the reason."""


def write_whole(path: pathlib.Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file atomically: write to a new file `path`-*.part, then rename it to `path`.

    After a failure `path` holds what it held before. Raises ValueError if the file cannot be written (disk full).
    """
    # a random name, which no other process uses and which is no link
    part = path.with_name(f"{path.name}-{secrets.token_hex(8)}.part")
    try:
        with part.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        advice = "Free disk space, or choose another --out."
        raise ValueError(f"{path}: cannot be written ({error.strerror}). {advice}") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def seal(path: pathlib.Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, object]) -> None:
    """Write a sealed file. No array may have the name `seal`; facts must be JSON values.

    Raises ValueError if the file cannot be written.
    """
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    content = dict(facts) | {ARRAYS: shapes(arrays)}
    mark = np.array(json.dumps(content | {CHECKSUM: checksum_of(content, arrays)}).encode())
    write_whole(path, lambda file: np.savez(file, **arrays, **{SEAL: mark}))  # pyright: ignore[reportArgumentType]


def unseal(path: pathlib.Path) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays and facts of a sealed file. Raises DamagedError if they differ from what was sealed."""
    try:
        if not zipfile.is_zipfile(path):
            raise DamagedError("it is an incomplete archive")
        with path.open("rb") as file, np.load(file) as archive:  # np.load leaves a damaged file open
            arrays = {name: archive[name] for name in archive.files}
        content = dict(json.loads(arrays.pop(SEAL).item()))
        checksum = content.pop(CHECKSUM)
    except DamagedError:
        raise
    except Exception as error:  # the type of error depends on where the archive is damaged
        raise DamagedError(f"a part of it cannot be read ({type(error).__name__})") from None
    if checksum != checksum_of(content, arrays):
        raise DamagedError("its checksum is wrong")
    if content.pop(ARRAYS) != shapes(arrays):
        raise DamagedError("its arrays are not those that its record lists")
    return arrays, content


def shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the dtype and shape of each array as JSON values."""
    return {name: [np.lib.format.dtype_to_descr(array.dtype), list(array.shape)] for name, array in arrays.items()}


def difference(recorded: Mapping[str, object], current: Mapping[str, object]) -> str:
    """Describe the first fact in which the fingerprints of a file and of this run differ. Empty if they are equal."""
    for key in {**recorded, **current}:
        if recorded.get(key) != current.get(key):
            return f"{key} is {recorded.get(key)} in the file and {current.get(key)} in this run"
    return ""


def flat(tree: Mapping[str, object], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables into one with dotted keys and JSON values, so that `difference` can name a key."""
    entries: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            entries |= flat(value, f"{prefix}{key}.")
        else:
            entries[f"{prefix}{key}"] = json.loads(json.dumps(value, default=str))
    return entries


def provenance() -> dict[str, str]:
    """Return the versions and precision on which results depend."""
    import jax
    import jax.numpy as jnp

    return {"version": __version__, "jax": jax.__version__, "precision": str(jnp.result_type(float))}


def checksum_of(facts: Mapping[str, object], arrays: Mapping[str, np.ndarray] = MappingProxyType({})) -> str:
    """Return the SHA-256 of facts, written as JSON, and of arrays, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()
