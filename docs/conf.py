"""Configuration of the site, built by `sphinx-build -W docs docs/_build/html` without network access."""

import gc
import os
import pathlib
import sys

HERE = pathlib.Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE / "_ext"), str(HERE.parent), str(HERE.parent / "tests")]
# The cells find the commands of the environment that builds, and the magic word that runs them.
for name, folder in (("PATH", pathlib.Path(sys.executable).parent), ("PYTHONPATH", HERE / "_ext")):
    os.environ[name] = os.pathsep.join(filter(None, [str(folder), os.environ.get(name)]))

# Pages share the compiled programs of the cells and of the commands in them.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": str(HERE / "_build" / "programs")}
    os.environ |= {"JAX_COMPILATION_CACHE_MAX_SIZE": str(2**30)}
os.environ |= {"OPENBLAS_NUM_THREADS": "1"}  # as in the commands
os.environ |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2"}
os.environ |= {"JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0"}  # as in the tests
os.environ |= {"PYTHONWARNINGS": "ignore:Error reading persistent,ignore:Error writing persistent"}

import quick  # noqa: E402
from execution import source_checksum  # noqa: E402

from ambjax import __version__  # noqa: E402
from ambjax.host.command_line import GC_THRESHOLDS  # noqa: E402

# As in the commands. The collector would scan the trees of all pages again and again.
gc.set_threshold(*GC_THRESHOLDS)

# Compilation takes most of a build's time.
os.environ.setdefault("XLA_FLAGS", quick.flags())

project = "ambjax"
author = copyright = "The ambjax maintainers"
release = version = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "mathml",
    "docstrings",
    "cells",
    "pages",
    "execution",
    "printed_tables",
]
exclude_patterns = ["_build", "_ext", "reference"]

smartquotes = False

html_theme = "furo"
# Thousands of classes and functions in the navigation of every page double the time of a build without execution.
toc_object_entries = False
html_title = f"ambjax {release}"
html_static_path = ["_static"]
html_css_files = ["ambjax.css"]
html_copy_source = False
html_math_renderer = "mathml"
math_eqref_format = "Eq. ({number})"

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_update_mathjax = False
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / "executed" / source_checksum())
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 900  # s for one cell, beside other work too
nb_merge_streams = True

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
# A link to something of ours that is gone stops the build; types of other packages have no page here.
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!ambjax\.|tuning\.).*")]
