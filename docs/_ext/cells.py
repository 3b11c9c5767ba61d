"""Cells of shell commands: `%%shell` runs them, and the page shows the commands. `table` prints rows for the pages.

A kernel loads this module. It imports neither Sphinx nor JAX, because many pages need neither of them.
"""

import gc
import os
import subprocess
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ambjax.host.command_line import GC_THRESHOLDS

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx

MAGIC = "%%shell"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a text table as the commands print it."""
    from ambjax.results.outputs import table as printed

    return printed(header, rows)


def shell(line: str, cell: str) -> None:
    """Run a cell and print its output. Raises RuntimeError unless its exit code is one of those in `line`, or 0."""
    # a search runs longer than it compiles: with all optimisations, as a user's, it takes half the time
    env = os.environ | ({"XLA_FLAGS": ""} if "ambjax tune " in cell else {})
    done = subprocess.run(["bash", "-o", "pipefail", "-c", cell], capture_output=True, text=True, check=False, env=env)
    print(done.stdout + done.stderr, end="")
    if str(done.returncode) not in (codes := line.split() or ["0"]):
        raise RuntimeError(f"exit code {done.returncode}, not {' or '.join(codes)}: {cell}")


def load_ipython_extension(ipython: Any) -> None:
    """Register the magic command; called by `%load_ext cells`."""
    gc.set_threshold(*GC_THRESHOLDS)  # as in the commands
    ipython.register_magic_function(shell, "cell", "shell")


def shown(app: "Sphinx", tree: "nodes.document") -> None:
    """Remove the `%%shell` line of every cell that begins with it."""
    from docutils import nodes

    for block in list(tree.findall(nodes.literal_block)):
        if (text := block.astext()).startswith(MAGIC):
            text = text.partition("\n")[2]
            block.replace_self(nodes.literal_block(text, text, language="bash"))


def setup(app: "Sphinx") -> dict[str, bool]:
    """Register the extension."""
    app.connect("doctree-read", shown)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
