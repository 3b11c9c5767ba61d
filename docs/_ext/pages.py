"""Write the pages generated from records, parsers and results, before Sphinx searches for pages.

Before Sphinx reads a page with committed outputs, its cells become code.
"""

from reference.page_outputs import PAGES, committed
from reference.site import write
from sphinx.application import Sphinx


def with_committed_outputs(app: Sphinx, name: str, source: list[str]) -> None:
    """Change the cells of a page with committed outputs into code."""
    if name in PAGES:
        source[0] = committed(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("config-inited", lambda app, config: write())
    app.connect("source-read", with_committed_outputs)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
