"""Outputs and pictures of cells in the Markdown of pages, for readers of the repository.

`python docs/reference/page_outputs.py [PAGE ...]` executes the cells of these pages, or of all, and writes the outputs.
A block of outputs follows its cell, between two comments. The first has a checksum of all code of the page; the name of
a picture has one of the cell that draws it. The site shows these blocks too, and its build executes the other pages.
"""

import base64
import hashlib
import io
import pathlib
import re
import sys
import tempfile
from collections.abc import Iterator
from typing import Any, NamedTuple

DOCS = pathlib.Path(__file__).parent.parent
PICTURES = DOCS / "pictures"
# Pages with outputs: those whose cells take long. The gallery has the pictures of all pages.
PAGES = ("start", "study", "compare", "own-laws", "machine", "loads", "sensors", "observers", "structures", "export")
PAGES += ("fmu", "processor", "sensitivity", "magnet")
GALLERY = "gallery"
BEGIN, END = "<!-- output {}: written by docs/reference/page_outputs.py -->", "<!-- end of output -->"
BLOCK = re.compile(rf"\n<!-- output (\w+):.*?\n{END}\n", re.DOTALL)
PICTURE = re.compile(r"\(pictures/(([\w-]+)-(\w+)\.\w+)\)")
LINK = re.compile(r"\[!\[[^\]]*\]\(pictures/[^\]]*\]\(([\w-]+)\.md#[^)]*\)")
CELL = re.compile(r"^```\{code-cell\}[^\n]*\n((?::[^\n]*\n)*)(.*?)^```\n", re.DOTALL | re.MULTILINE)
HEADING = re.compile(r"^```.*?^```$|^#+ ([^\n]+)$", re.DOTALL | re.MULTILINE)
# Removed from outputs: lines of progress, and the temporary folder of the cells.
WITHOUT = re.compile(
    rf"^(\x1b\[K)?\d+:\d\d .*\n|\x1b\[K\n?|{re.escape(tempfile.gettempdir())}/\w+/", flags=re.MULTILINE
)
# Width (pixels) and number of colours of a picture.
WIDTH, COLOURS = 720, 32


class Cell(NamedTuple):
    """A cell of a page: its tags, its code, where it ends in the text, and the title of its section."""

    tags: str
    code: str
    end: int
    section: str


def stripped(text: str) -> str:
    """Return the text of a page without outputs."""
    return BLOCK.sub("", text)


def committed(text: str) -> str:
    """Return the text of a page with outputs for the site: its cells are code that is not executed."""
    text = BLOCK.sub(_box, re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL))
    return CELL.sub(_code, text)


def _box(block: re.Match[str]) -> str:
    """Return a block of outputs as Sphinx shows those of a cell."""
    outputs = block[0].replace("```text", "```{code-block} none\n:class: output\n")
    return f"\n::::{{container}} cell-output\n{outputs}\n::::\n"


def _code(cell: re.Match[str]) -> str:
    """Return the code of a cell, or nothing, or a line that a click unfolds, as its tags say."""
    code = f"```python\n{cell[2]}```\n"
    hidden = f"<details><summary>Code</summary>\n\n{code}\n</details>\n"
    return "" if "remove" in cell[1] else hidden if "hide-input" in cell[1] else code


def read(name: str) -> str:
    """Return the text of a page without outputs."""
    return stripped((DOCS / f"{name}.md").read_text(encoding="utf-8"))


def cells(text: str) -> list[Cell]:
    """Return the cells of a page without outputs."""
    titles = [(one.start(), one[1]) for one in HEADING.finditer(text) if one[1]]
    section = lambda at: next((title for start, title in reversed(titles) if start < at), "")  # noqa: E731
    return [Cell(one[1], one[2], one.end(), section(one.start())) for one in CELL.finditer(text)]


def checksum(*codes: str) -> str:
    """Return a checksum of the code of cells."""
    return hashlib.sha256("\0".join(codes).encode()).hexdigest()[:8]


def outdated(name: str) -> list[str]:
    """Return what in a page no longer fits: checksums of blocks, pictures, and the code of cells (`cell_code`)."""
    from reference.cell_code import faults

    text, found = (DOCS / f"{name}.md").read_text(encoding="utf-8"), cells(read(name))
    now = checksum(*(cell.code for cell in found))
    old = [] if name == GALLERY else [one[1] for one in BLOCK.finditer(text) if one[1] != now]
    drawn = {(page, checksum(cell.code)) for page in (*_order(), name) for cell in cells(read(page))}
    missing = [one[1] for one in PICTURE.finditer(text) if one.group(2, 3) not in drawn or not _path(one[1]).exists()]
    return old + missing + ([] if BLOCK.search(text) else ["no outputs"]) + faults([cell.code for cell in found])


def _path(name: str) -> pathlib.Path:
    return PICTURES / name


def _order() -> list[str]:
    """Return the names of the pages with cells, in the order of the contents."""
    names = re.findall(r"^([a-z-]+)$", (DOCS / "index.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [name for name in names if (DOCS / f"{name}.md").exists() and cells(read(name))]


def _shown(name: str, cell: Cell, outputs: list[Any]) -> Iterator[str]:
    """Yield the outputs of a cell as Markdown, and write its pictures."""
    outputs = [one for one in outputs if one.get("name") != "stderr"]
    for one in outputs if "remove" not in cell.tags.replace("remove-input", "") else []:
        data = one.get("data", {})
        if picture := next((kind for kind in ("image/png", "image/svg+xml") if kind in data), None):
            target = _path(f"{name}-{checksum(cell.code)}.{picture[6:9]}")
            target.write_bytes(_small(data[picture]))
            yield f"![{cell.section}](pictures/{target.name})"
        elif text := WITHOUT.sub("", one.get("text") or data.get("text/plain") or "").strip("\n"):
            yield f"```text\n{text}\n```"


def _small(data: str) -> bytes:
    """Return a picture with few colours and at most WIDTH pixels wide; a drawing (SVG) with two decimals."""
    if data.lstrip().startswith("<"):
        return re.sub(r"(\d\.\d\d)\d+", r"\1", re.sub(r"<metadata>.*?</metadata>", "", data, flags=re.DOTALL)).encode()
    from PIL import Image

    picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA")
    white = Image.new("RGBA", picture.size, "white")
    picture = Image.alpha_composite(white, picture).convert("RGB")
    picture.thumbnail((WIDTH, 10 * WIDTH))
    file = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return file.getvalue()


def _block(total: str, parts: list[str]) -> str:
    return "\n".join(["", BEGIN.format(total), "", *(f"{part}\n" for part in parts), END, ""]) if parts else ""


def _with_outputs(name: str, notebook: Any) -> tuple[str, list[str]]:
    """Return the text of a page with the outputs of its cells, and the pictures as links for the gallery."""
    text, made, links, last = read(name), [], [], 0
    found = cells(text)
    total, title = checksum(*(cell.code for cell in found)), re.search(r"^# (.+)$", text, flags=re.MULTILINE)
    assert title is not None
    executed = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell, done in zip(found, executed, strict=True):
        parts = list(_shown(name, cell, done.outputs))
        made += [text[last : cell.end], _block(total, parts)]
        last = cell.end
        anchor = re.sub(r"[^\w -]", "", cell.section.lower()).replace(" ", "-")
        about = title[1] if cell.section == title[1] else f"{title[1]}<br>{cell.section}"
        links += [f"[{part}<br>{about}]({name}.md#{anchor})" for part in parts if part.startswith("!")]
    return "".join([*made, text[last:]]), links


def _executed(names: list[str]) -> dict[str, Any]:
    """Return the executed notebook of each page, from the cache of the site's build if it is there."""
    import conf  # pyright: ignore[reportMissingImports]
    import execution  # pyright: ignore[reportMissingImports]

    paths = [DOCS / f"{name}.md" for name in names]
    found = execution.notebooks(paths, conf.nb_execution_cache_path, conf.nb_execution_timeout)
    return {path.stem: notebook for path, notebook in found.items()}


def main(names: list[str]) -> None:
    """Execute pages, and write their outputs if they are in PAGES, and their pictures into the gallery."""
    PICTURES.mkdir(exist_ok=True)
    gallery = (DOCS / f"{GALLERY}.md").read_text(encoding="utf-8")
    links = {name: [one[0] for one in LINK.finditer(gallery) if one[1] == name] for name in _order()}
    for name, notebook in _executed(names or _order()).items():
        text, links[name] = _with_outputs(name, notebook)
        if name in PAGES:
            (DOCS / f"{name}.md").write_text(text, encoding="utf-8")
    every = [link for name in _order() for link in links[name]]
    rows = [f"| {' | '.join(every[k : k + 2])} |" for k in range(0, len(every), 2)]
    table = "\n".join(["| | |", "|---|---|", *rows])
    (DOCS / f"{GALLERY}.md").write_text(stripped(gallery) + _block(checksum(*every), [table]), encoding="utf-8")
    used = {one[1] for name in (*PAGES, GALLERY) for one in PICTURE.finditer((DOCS / f"{name}.md").read_text())}
    for path in PICTURES.iterdir():
        if path.name not in used:
            path.unlink()


if __name__ == "__main__":
    sys.path[:0] = [str(DOCS)]
    main(sys.argv[1:])
