"""Import of optional packages, of commands that other packages declare (that of the tuner), and of custom classes.

Other processes cannot import a file with a custom class by name. An instance of such a class is therefore pickled with
the text of the file. A worker process, or a machine of a cluster without that file, then executes the same text.
"""

import contextlib
import copyreg
import hashlib
import importlib
import importlib.metadata
import inspect
import pathlib
import re
import sys
import types
from collections.abc import Callable
from typing import Any

# Entry-point group in which a package that depends on ambjax declares its command.
GROUP = "ambjax.commands"
# SHA-256 of the source of each module that was imported here, by the module's name.
_DIGESTS: dict[str, str] = {}


def extra(name: str, group: str = "tables") -> Any:
    """Import an optional package by its dotted name. Raises ValueError, naming the extra `group`, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ValueError(f"{package} is not installed. Install it with: pip install 'ambjax[{group}]'.") from None


class NothingToTuneError(ValueError):
    """The case has no gains to tune, or its tune.gains is empty."""


def extension(name: str) -> Callable[..., int]:
    """Return the command declared under `name`.

    The command maps its words and the program's name to an exit code. With `nested=True`, it raises its errors, so that
    the command that calls it can report them.

    Raises ValueError if no installed package declares it.
    """
    found = tuple(importlib.metadata.entry_points(group=GROUP, name=name))
    if not found:
        raise ValueError(f"{name}: this command is not installed. Reinstall ambjax with pip.")
    return found[0].load()


def module_of_file(path: pathlib.Path) -> types.ModuleType:
    """Execute a Python file and return its module. The same text at the same path is executed only once per process.

    Output of the file goes to stderr. Raises OSError if the file cannot be read, and whatever its execution raises.
    """
    return _executed(str(path.resolve()), path.read_bytes())


def module_of_name(name: str) -> types.ModuleType:
    """Import an installed module by its dotted name. Raises whatever its import raises."""
    with contextlib.redirect_stdout(sys.stderr):
        module = importlib.import_module(name)
    with contextlib.suppress(OSError, TypeError):  # a module without source, such as a compiled one
        _DIGESTS[module.__name__] = hashlib.sha256(inspect.getsource(module).encode()).hexdigest()
    return module


def digest_of(kind: type) -> str:
    """Return the SHA-256 of the source of the module of a class, if it was imported here; otherwise ''."""
    return _DIGESTS.get(kind.__module__, "")


def pickle_with_source(kind: type) -> None:
    """Make pickles of instances of this class, which a file defines, carry the text of the file."""
    copyreg.pickle(kind, _reduced)  # pyright: ignore[reportArgumentType]


def line_of(error: BaseException, path: pathlib.Path) -> int | None:
    """Return the last line of the file at `path` that an exception passed through, or None."""
    name, line, tail = str(path.resolve()), None, error.__traceback__
    while tail is not None:
        line = tail.tb_lineno if tail.tb_frame.f_code.co_filename == name else line
        tail = tail.tb_next
    return error.lineno if isinstance(error, SyntaxError) and error.filename == name else line


def _executed(path: str, text: bytes) -> types.ModuleType:
    """Return the module of this text, which stands at `path`; execute it unless this process has done so."""
    digest = hashlib.sha256(path.encode() + b"\0" + text).hexdigest()
    package = f"own_{digest[:16]}"
    name = f"{package}.{re.sub(r'[^A-Za-z0-9_]', '_', pathlib.Path(path).stem)}"
    if name in sys.modules:
        return sys.modules[name]
    module = types.ModuleType(name)
    module.__file__, module.__dict__["_TEXT"] = path, text
    sys.modules[package], sys.modules[name] = types.ModuleType(package), module  # dataclasses and pickle look it up
    try:
        with contextlib.redirect_stdout(sys.stderr):
            exec(compile(text, path, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[package], sys.modules[name]
        raise
    _DIGESTS[name] = hashlib.sha256(text).hexdigest()
    return module


def _reduced(instance: Any) -> tuple[Any, ...]:
    kind = type(instance)
    module = sys.modules[kind.__module__]
    return _blank, (module.__file__, module.__dict__["_TEXT"], kind.__qualname__), dict(vars(instance))


def _blank(path: str, text: bytes, name: str) -> Any:
    """Return an instance of the class `name` of this text. It has no attributes; unpickling sets them."""
    kind = getattr(_executed(path, text), name)
    pickle_with_source(kind)
    return object.__new__(kind)


def tune(case: str | pathlib.Path, out: str | pathlib.Path | None = None, **options: Any) -> Any:
    """Tune the gains of a case file, as `ambjax tune` does. Return the result of `tuning.tune`, a `TunedCase`.

    - `case`: path of the case file; its table [tune] sets what is tuned.
    - `out`: directory of the results; None: a new one under ./out.
    - `options`: `minutes`, `listen`, `resume`, `force`, `pareto`, `page`, `settings_of`: see `tuning.tune`.

    Raises ValueError for bad input, or if the tuner is not installed.

        tuned = ambjax.tune("my.toml", "tuned", minutes=10)
        tuned.good, tuned.case  # whether the gains meet all requirements, and the case with them
    """
    package = importlib.import_module(extension("tune").__module__.partition(".")[0])
    return package.tune(case, out, **options)
