"""Execute the pages with cells side by side before Sphinx reads them, into the cache from which it reads them.

A page whose cells have not changed is not executed again, unless the package has changed: the name of the cache
contains a checksum of its source files.
"""

import ast
import concurrent.futures
import contextlib
import hashlib
import itertools
import logging
import os
import pathlib
import shutil
import tempfile
from typing import Any

from jupyter_cache import get_cache
from jupyter_cache.base import CacheBundleIn
from jupyter_cache.executors.utils import ExecutionResult, single_nb_execution
from myst_nb.core.config import NbParserConfig
from myst_nb.core.read import create_nb_reader
from myst_parser.config.main import MdParserConfig
from quick import take_core
from reference.page_outputs import PAGES
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging as sphinx_logging

ROOT = pathlib.Path(__file__).parent.parent.parent
# Each page has a process of its own, with up to 2 GB of memory.
AT_ONCE = min(os.cpu_count() or 1, 4)

logger = sphinx_logging.getLogger(__name__)


def source_checksum() -> str:
    """Return a checksum of every source file on which the output of a cell depends, without its comments."""
    total = hashlib.sha256()
    modules = [path for package in ("ambjax", "tuning") for path in sorted((ROOT / package).rglob("*.py"))]
    for path in [*modules, pathlib.Path(__file__).with_name("cells.py"), ROOT / "tests" / "quick.py"]:
        code = ast.dump(ast.parse(path.read_bytes()))
        total.update(f"{path.relative_to(ROOT)}\0{code}\0".encode())
    return total.hexdigest()[:16]


def execute(app: Sphinx, env: Any, docnames: list[str]) -> None:
    """Execute the pages that are about to be read, except those in the cache and those with committed outputs.

    Raises ExtensionError if a cell fails.
    """
    if app.config.nb_execution_mode != "cache":
        return
    folder = pathlib.Path(app.config.nb_execution_cache_path)
    for old in set(folder.parent.glob("*")) - {folder}:
        shutil.rmtree(old)
    paths = [pathlib.Path(env.doc2path(name)) for name in docnames if name not in PAGES]
    notebooks(paths, str(folder), app.config.nb_execution_timeout)


def notebooks(paths: list[pathlib.Path], folder: str, timeout: int) -> dict[pathlib.Path, Any]:
    """Return the executed notebook of each page with cells, and keep it in a cache. Raises ExtensionError if one fails.

    - `folder`: folder of the cache.
    - `timeout`: longest time that one cell may take, s.
    """
    cache = get_cache(folder)
    logging.getLogger("traitlets").setLevel(logging.WARNING)  # one line per page otherwise
    # Searches take longest. The pages that contain them start first, so that no core is idle at the end.
    paths = sorted(paths, key=lambda path: -path.read_text(encoding="utf-8").count("\nambjax tune "))
    places, found = itertools.count(), {}
    with concurrent.futures.ThreadPoolExecutor(AT_ONCE, initializer=lambda: take_core(next(places))) as pool:
        running = {}
        for path in paths:
            text = path.read_text(encoding="utf-8")
            reader = create_nb_reader(str(path), MdParserConfig(), NbParserConfig(), text)
            if reader is None or path.suffix != ".md" or not reader.read_fmt:
                continue
            found[path] = notebook = reader.read(text)
            with contextlib.suppress(KeyError):
                found[path] = cache.merge_match_into_notebook(notebook)[1]
                continue
            running[pool.submit(_run, notebook, timeout)] = path
        for done in concurrent.futures.as_completed(running):
            result, path = done.result(), running[done]
            if result.err is not None:
                raise ExtensionError(f"{path}: {result.exc_string}")
            logger.info("executed %s in %.1f s", path.name, result.time)
            bundle = CacheBundleIn(result.nb, str(path), data={"execution_seconds": result.time})
            cache.cache_notebook_bundle(bundle, check_validity=False, overwrite=True)
            found[path] = result.nb
    return found


def _run(notebook: Any, timeout: int) -> ExecutionResult:
    """Execute the cells of a page in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        return single_nb_execution(notebook, cwd=folder, timeout=timeout, allow_errors=False)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("env-before-read-docs", execute)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
