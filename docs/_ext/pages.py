"""Write the pages generated from records, parsers and results, before Sphinx searches for pages.

The committed outputs of cells are removed from a page before Sphinx reads it.
"""

from reference.page_outputs import stripped
from reference.site import write
from sphinx.application import Sphinx


def without_outputs(app: Sphinx, name: str, source: list[str]) -> None:
    """Remove the committed outputs from the text of a page."""
    source[0] = stripped(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("config-inited", lambda app, config: write())
    app.connect("source-read", without_outputs)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
