"""Write the pages generated from records, parsers and results, before Sphinx searches for pages."""

import pathlib

from reference.site import pages
from sphinx.application import Sphinx

FOLDER = "generated"


def write(app: Sphinx) -> None:
    """Write every page that has changed."""
    folder = pathlib.Path(app.srcdir) / FOLDER
    folder.mkdir(exist_ok=True)
    made = pages()
    for name, text in made.items():
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    for path in set(folder.iterdir()) - {folder / name for name in made}:
        path.unlink()


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("config-inited", lambda app, config: write(app))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
