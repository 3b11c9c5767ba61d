"""Cells of shell commands shown as what a reader types: without the magic word that has them run."""

from docutils import nodes
from sphinx.application import Sphinx

MAGIC = "%%bash\n"


def shown(app: Sphinx, tree: nodes.document) -> None:
    """Take the magic word off every cell that begins with it."""
    for block in tree.findall(nodes.literal_block):
        if (text := block.astext()).startswith(MAGIC):
            block.replace_self(nodes.literal_block(text, text.removeprefix(MAGIC), language="bash"))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register it."""
    app.connect("doctree-read", shown)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
