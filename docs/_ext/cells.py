"""Cells of shell commands: `%%shell` runs them, and the page shows the commands. `table` prints rows for the pages."""

import subprocess
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

from ambjax.results.outputs import table as table

MAGIC = "%%shell"


def shell(line: str, cell: str) -> None:
    """Run a cell and print its output. Raises RuntimeError unless it ends with the exit code in `line`, or 0."""
    done = subprocess.run(["bash", "-o", "pipefail", "-c", cell], capture_output=True, text=True, check=False)
    print(done.stdout + done.stderr, end="")
    if done.returncode != int(line or 0):
        raise RuntimeError(f"exit code {done.returncode}, not {line or 0}: {cell}")


def load_ipython_extension(ipython: Any) -> None:
    """Register the magic command; called by `%load_ext cells`."""
    ipython.register_magic_function(shell, "cell", "shell")


def shown(app: Sphinx, tree: nodes.document) -> None:
    """Remove the `%%shell` line of every cell that begins with it."""
    for block in list(tree.findall(nodes.literal_block)):
        if (text := block.astext()).startswith(MAGIC):
            text = text.partition("\n")[2]
            block.replace_self(nodes.literal_block(text, text, language="bash"))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("doctree-read", shown)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
