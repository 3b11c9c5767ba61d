"""One self-contained HTML page from a Markdown text and its pictures."""

import base64
import html
import re
from collections.abc import Collection, Mapping, Sequence

from markdown_it import MarkdownIt
from markdown_it.renderer import RendererHTML
from markdown_it.token import Token
from markdown_it.utils import EnvType, OptionsDict

# An element that is wider than the screen scrolls in a box, so that pictures stay legible. On a narrow screen the first
# column of a table, which holds its labels, is narrow and stays in view.
STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222}
body{overflow-wrap:anywhere}p,li{max-width:60rem}.wide{display:block;overflow-x:auto;margin:.6rem 0}
table{border-collapse:collapse;overflow-wrap:normal}td,th{border:1px solid #ccc;padding:.2rem .6rem;text-align:left}
th{background:#f3f3f3}.short{white-space:nowrap}img{display:block;max-width:max(100%,44rem)}
details{border-top:1px solid #ccc;padding:.4rem 0}summary{cursor:pointer}summary h2{display:inline;font-size:1.1rem}
@media(max-width:44rem){td:first-child,th:first-child{position:sticky;left:0;max-width:9rem;white-space:normal}
td:first-child{background:#fff}}"""
# Cells of at most this many characters are not wrapped: a number must not break at the sign of its exponent.
SHORT = 48
PUNCTUATION = re.compile(r"([\\`*_\[\]<>|~&#!$])")


def escape_markdown(text: str) -> str:
    """Escape a text so that Markdown shows it literally on one line, in tables too."""
    visible = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return PUNCTUATION.sub(r"\\\1", visible)


def render_page(text: str, pictures: Mapping[str, bytes], title: str, unfolded: Collection[str] | None = None) -> str:
    """Return the HTML page. `pictures`: PNG data by file name; images with these names are embedded. A sentence
    replaces an image without data.

    `unfolded`: headings of level 2 whose sections are open; all other sections are folded. None: all are open.
    """
    tag = lambda text: '<td class="short">' if len(text) <= SHORT else "<td>"  # noqa: E731
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    markdown.add_render_rule("table_open", lambda *_: '<div class="wide"><table>\n')
    markdown.add_render_rule("td_open", lambda _, tokens, at, *__: tag(tokens[at + 1].content))
    markdown.add_render_rule("table_close", lambda *_: "</table></div>\n")

    def image(
        renderer: RendererHTML, tokens: Sequence[Token], at: int, options: OptionsDict, environment: EnvType
    ) -> str:
        words = html.escape(renderer.renderInlineAsText(tokens[at].children, options, environment))
        picture = pictures.get(str(tokens[at].attrs["src"]))
        if picture is None:
            return f"<em>The picture is missing: {words}.</em>"
        data = base64.b64encode(picture).decode()
        return f'<span class="wide"><img alt="{words}" src="data:image/png;base64,{data}"></span>'

    markdown.add_render_rule("image", image)
    head = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style>"
    )
    first, *sections = [text] if unfolded is None else re.split(r"^(?=## )", text, flags=re.MULTILINE)
    parts = [markdown.render(first)]
    for section in sections:
        heading, _, below = section.partition("\n")
        if heading.removeprefix("## ") in (unfolded or ()):
            parts.append(markdown.render(section))
        else:
            summary = f"<summary>{markdown.render(heading)}</summary>"
            parts.append(f"<details>{summary}\n{markdown.render(below)}</details>\n")
    return f"{head}\n{''.join(parts)}</html>\n"
