"""Traced programs on disk: a command that runs again does not trace and lower its functions a second time.

JAX keeps compiled programs on disk, but traces and lowers each function again in every process before it looks for one.
This module keeps the lowered programs too, in the portable format of `jax.export`. The key of a program contains all
that a trace depends on: the function and its static arguments, the structure of its arguments, their shapes and types,
the versions of JAX and Python, the settings in the environment, and the source of this project. Functions and records
from elsewhere, such as a user's own law, have no key, and are always traced. Whatever fails here is traced as well.
"""

import contextlib
import functools
import hashlib
import io
import os
import pathlib
import pickle
import sys
import tempfile
import types
import zlib
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import export
from jax.tree_util import PyTreeDef

Result = TypeVar("Result")

# Packages whose source is part of a key, and the others whose objects may be part of one.
PROJECT = ("ambjax", "tuning")
TRUSTED = {*PROJECT, "builtins", "copyreg", "functools", "jax", "jaxlib", "numpy"}
# Size above which the least recently used half of the folder is deleted, in bytes. A program has 10 to 100 kB.
MOST_STORED = 64 * 2**20

_folder: pathlib.Path | None = None


def store_in(folder: pathlib.Path) -> None:
    """Keep the traced programs of this process in a folder, and take them from there."""
    global _folder
    _folder = folder


def traced_once(function: Callable[..., Result], static_argnames: tuple[str, ...] = ()) -> Callable[..., Result]:
    """Return `function` with its traced program taken from disk. Call it inside `jax.jit`, without other transforms."""
    inner = jax.jit(function, static_argnames=static_argnames)

    @functools.wraps(function)
    def call(*args: object, **static: object) -> Result:
        if _folder is not None:
            with contextlib.suppress(Exception):  # no key, no flatbuffers, a full disk, an error of the function itself
                path = _folder / _key(function, jax.tree.map(lambda x: repr(jax.typeof(x)), args), static)
                program, result = _read(path) or _traced(inner, args, static, path)
                return jax.tree.unflatten(result, program.call(*jax.tree.leaves(args)))
        return inner(*args, **static)

    return call


class _KeyPickler(pickle.Pickler):
    """Pickles what a program depends on. Raises PicklingError if an object is not from a trusted package."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, PyTreeDef):
            return tuple, ((_example(obj),),)
        module = getattr(obj, "__module__", None) or "builtins"
        if module.partition(".")[0] not in TRUSTED:
            raise pickle.PicklingError(f"{obj!r} is from outside the project.")
        if isinstance(obj, types.FunctionType):  # by name, because a decorator may have replaced it in its module
            if "<" in obj.__qualname__:
                raise pickle.PicklingError(f"{obj!r} has no name of its own.")
            return tuple, ((module, obj.__qualname__),)
        return NotImplemented


def _key(*parts: object) -> str:
    stream = io.BytesIO(_versions())
    stream.seek(0, io.SEEK_END)
    _KeyPickler(stream).dump(parts)
    return hashlib.sha256(stream.getvalue()).hexdigest()


@functools.cache
def _versions() -> bytes:
    """Return a digest of the versions, the settings and the source that a program depends on."""
    settings = sorted((name, x) for name, x in os.environ.items() if name.startswith(("AMBJAX_", "JAX_", "XLA_")))
    facts = (jax.__version__, sys.version, jax.default_backend(), str(jax.numpy.result_type(float)), settings)
    digest, root = hashlib.sha256(repr(facts).encode()), pathlib.Path(__file__).parents[2]
    for path in sorted(path for package in PROJECT for path in (root / package).rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.digest()


def _example(structure: Any) -> Any:
    """Return a tree of this structure that can be pickled, which a structure cannot."""
    return jax.tree.unflatten(structure, range(structure.num_leaves))


def _traced(inner: Callable, args: tuple, static: dict, path: pathlib.Path) -> tuple[export.Exported, Any]:
    """Trace and store a function. Return its program and the structure of its result."""
    leaves, structure = jax.tree.flatten(args)
    results: list[Any] = []

    def flat(*leaves: object) -> list:
        found, result = jax.tree.flatten(inner(*jax.tree.unflatten(structure, leaves), **static))
        results.append(result)
        return found

    program = export.export(jax.jit(flat))(*map(jax.typeof, leaves))
    data = zlib.compress(pickle.dumps((_example(results[0]), bytes(program.serialize()))), 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as part:
        part.write(data)
    pathlib.Path(part.name).replace(path)
    _discard(path.parent)
    return program, results[0]


def _read(path: pathlib.Path) -> tuple[export.Exported, Any] | None:
    """Return a stored program and the structure of its result; None if there is none, or if the file is damaged."""
    try:
        example, data = pickle.loads(zlib.decompress(path.read_bytes()))
        program = export.deserialize(bytearray(data))
        path.touch()
    except Exception:  # what a damaged file does to the parsers is not known
        return None
    return program, jax.tree.structure(example)


def _discard(folder: pathlib.Path) -> None:
    """Delete the least recently used half of the files in a folder if it is too large."""
    files = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    if sum(path.stat().st_size for path in files) > MOST_STORED:
        for path in files[: len(files) // 2]:
            path.unlink(missing_ok=True)
