"""Files that are there whole or not at all, and that show it when they were damaged later.

A sealed file is an .npz with one entry more, `seal`: JSON that holds facts (what the arrays belong to), the dtype and
shape of every array, and a SHA-256 of all of it. Whoever reads one gets what was written, or is told why not.
"""

import contextlib
import hashlib
import json
import os
import pathlib
import secrets
import zipfile
from collections.abc import Callable, Mapping
from typing import IO, Any

import numpy as np

from ambjax._version import __version__

SEAL, CHECKSUM, ARRAYS = "seal", "sha256", "arrays"

Arrays = dict[str, np.ndarray]


class DamagedError(Exception):
    """A file does not hold what was written into it; the text says why, in a few words."""


def write_whole(path: pathlib.Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write to a new file beside `path`, *.part, then rename it: `path` holds everything or what it held before.

    Raises ValueError if that cannot be done (a full disk, for one).
    """
    # a name that nobody else has, and nothing that a link leads to
    part = path.with_name(f"{path.name}-{secrets.token_hex(8)}.part")
    try:
        with part.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror}). Make room, or choose another --out.") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def seal(path: pathlib.Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write arrays, of any names but `seal`, with facts as JSON has them. Raises ValueError as `write_whole`."""
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    content = dict(facts) | {ARRAYS: shapes(arrays)}
    mark = np.array(json.dumps(content | {CHECKSUM: _checksum(content, arrays)}).encode())
    write_whole(path, lambda file: np.savez(file, **arrays, **{SEAL: mark}))  # pyright: ignore[reportArgumentType]


def unseal(path: pathlib.Path) -> tuple[Arrays, dict[str, Any]]:
    """The arrays and facts of a sealed file. Raises DamagedError where they are not what was sealed."""
    try:
        if not zipfile.is_zipfile(path):
            raise DamagedError("it is not a whole archive")
        with path.open("rb") as file, np.load(file) as archive:  # np.load itself leaves a damaged one open
            arrays = {name: archive[name] for name in archive.files}
        content = dict(json.loads(arrays.pop(SEAL).item()))
        checksum = content.pop(CHECKSUM)
    except DamagedError:
        raise
    except Exception as error:  # a damaged archive raises whatever the part of it that is read first happens to raise
        raise DamagedError(f"a part of it cannot be read ({type(error).__name__})") from None
    if checksum != _checksum(content, arrays):
        raise DamagedError("its checksum is wrong")
    if content.pop(ARRAYS) != shapes(arrays):
        raise DamagedError("its arrays are not those that were sealed")
    return arrays, content


def shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Dtype and shape of each array, as JSON has them."""
    return {name: [np.lib.format.dtype_to_descr(array.dtype), list(array.shape)] for name, array in arrays.items()}


def difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The first fact in which two fingerprints differ, in words: `there` and `here`. Empty: none."""
    for key in {**there, **here}:
        if there.get(key) != here.get(key):
            return f"{key} is {there.get(key)} there and {here.get(key)} here"
    return ""


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, keys dotted, values as JSON has them: a fingerprint whose differences have names."""
    entries: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        entries |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: _plain(value)}
    return entries


def provenance() -> dict[str, str]:
    """What computes: results may differ by rounding, or more, where one of these does."""
    import jax
    import jax.numpy as jnp

    return {"version": __version__, "jax": jax.__version__, "precision": str(jnp.result_type(float))}


def checksum_of(facts: Mapping[str, Any]) -> str:
    """SHA-256 of facts as JSON has them, in hexadecimal."""
    return _checksum(facts, {})


def _checksum(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=str))
