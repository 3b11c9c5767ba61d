"""The directive `gallery`: every picture that a cell draws, as a thumbnail that links to the section with its code."""

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class GalleryNode(nodes.General, nodes.Element):
    """The place of the pictures in a page, until all pages are read."""


class Gallery(SphinxDirective):
    """The directive; it has no options."""

    def run(self) -> list[nodes.Node]:
        """Return the place, and have the page read again with every build, because the other pages may change."""
        self.env.note_reread()
        return [GalleryNode()]


def fill(app: Sphinx, tree: nodes.document, docname: str) -> None:
    """Replace the place by the pictures of all pages, in the order of the contents."""
    for place in list(tree.findall(GalleryNode)):
        made: list[nodes.Node] = []
        for name in _in_order(app, app.config.root_doc):
            page = app.env.get_doctree(name)
            drawn = (image for image in page.findall(nodes.image) if _from_cell(image))
            made += [_thumbnail(app, docname, name, image) for image in drawn]
        place.replace_self(nodes.container("", *made, classes=["gallery"]))


def _in_order(app: Sphinx, name: str) -> list[str]:
    below = [one for child in app.env.toctree_includes.get(name, []) for one in _in_order(app, child)]
    return [name, *below]


def _from_cell(image: nodes.image) -> bool:
    node: Any = image
    while node is not None and "cell_output" not in node.get("classes", []):
        node = node.parent
    return node is not None


def _thumbnail(app: Sphinx, here: str, name: str, image: nodes.image) -> nodes.Node:
    """Return a picture of a page with the titles of the page and of its section, linked to that section."""
    section: Any = image
    while not isinstance(section, nodes.section):
        section = section.parent
    page, title = app.env.titles[name].astext(), next(section.findall(nodes.title)).astext()
    text = page if title == page else f"{page}: {title}"
    target = f"{app.builder.get_relative_uri(here, name)}#{section['ids'][0]}"
    picture = nodes.image(uri=image["uri"], candidates=dict(image["candidates"]), alt=text)
    return nodes.paragraph(
        "", "", nodes.reference("", "", picture, nodes.inline(text, text), refuri=target, internal=True)
    )


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_node(GalleryNode)
    app.add_directive("gallery", Gallery)
    app.connect("doctree-resolved", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
