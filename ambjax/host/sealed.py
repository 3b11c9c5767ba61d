"""Files that are written atomically, and carry a checksum that detects later damage.

A sealed file is an .npz with an additional entry `seal`. The seal is JSON with facts (metadata of the arrays), the
dtype and shape of every array, and a SHA-256 of facts and arrays. Reading verifies the seal.
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
    """A file does not hold the data that were written to it. The text gives the reason in a few words."""


def write_whole(path: pathlib.Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file atomically: call `write` with a new file *.part in the same directory, then rename it to `path`.

    After a failure `path` is unchanged. Raises ValueError if the file cannot be written, for example on a full disk.
    """
    # A random name avoids files of other processes; mode "x" refuses to follow an existing link.
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
    """Write a sealed file of arrays, with any names but `seal`, and of facts that JSON can hold.

    Raises ValueError as `write_whole` does.
    """
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    content = dict(facts) | {ARRAYS: shapes(arrays)}
    mark = np.array(json.dumps(content | {CHECKSUM: _checksum(content, arrays)}).encode())
    write_whole(path, lambda file: np.savez(file, **arrays, **{SEAL: mark}))  # pyright: ignore[reportArgumentType]


def unseal(path: pathlib.Path) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays and facts of a sealed file. Raises DamagedError if the file does not match its seal."""
    try:
        if not zipfile.is_zipfile(path):
            raise DamagedError("it is not a whole archive")
        with path.open("rb") as file, np.load(file) as archive:  # np.load does not close a damaged file
            arrays = {name: archive[name] for name in archive.files}
        content = dict(json.loads(arrays.pop(SEAL).item()))
        checksum = content.pop(CHECKSUM)
    except DamagedError:
        raise
    except Exception as error:  # the type depends on which part of the archive is damaged
        raise DamagedError(f"a part of it cannot be read ({type(error).__name__})") from None
    if checksum != _checksum(content, arrays):
        raise DamagedError("its checksum is wrong")
    if content.pop(ARRAYS) != shapes(arrays):
        raise DamagedError("its arrays are not those that were sealed")
    return arrays, content


def shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the dtype and shape of each array, in JSON form."""
    return {name: [np.lib.format.dtype_to_descr(array.dtype), list(array.shape)] for name, array in arrays.items()}


def difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Describe the first fact in which two fingerprints differ; an empty string if they are equal."""
    for key in {**there, **here}:
        if there.get(key) != here.get(key):
            return f"{key} is {there.get(key)} there and {here.get(key)} here"
    return ""


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables into one with dotted keys and values in JSON form, for use as a fingerprint."""
    entries: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        entries |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: _plain(value)}
    return entries


def provenance() -> dict[str, str]:
    """Return the versions of ambjax and JAX and the floating-point type. Results may differ if one of these differs."""
    import jax
    import jax.numpy as jnp

    return {"version": __version__, "jax": jax.__version__, "precision": str(jnp.result_type(float))}


def checksum_of(facts: Mapping[str, Any]) -> str:
    """Return the SHA-256 of facts in JSON form, in hexadecimal."""
    return _checksum(facts, {})


def _checksum(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=str))
