"""All generated pages by file name. `python docs/reference/site.py` writes them to docs/generated/.

The tables that a reader of the repository looks up are committed; the pages of the API are not.
"""

import pathlib
import sys

if __name__ == "__main__":
    sys.path[:0] = [str(pathlib.Path(__file__).parent.parent)]

from reference import api, benchmarks, case_file, commands, conditions, layers, metrics

FOLDER = pathlib.Path(__file__).parent.parent / "generated"
# Writers of the committed tables, and of the other pages.
COMMITTED = (case_file, commands, metrics, conditions, benchmarks)
OTHERS = (api, layers)


def tables() -> dict[str, str]:
    """Return the text of the committed pages by file name."""
    return {name: text for writer in COMMITTED for name, text in writer.pages().items()}


def write() -> None:
    """Write every page that has changed, and remove pages that are no longer generated."""
    made = tables() | {name: text for writer in OTHERS for name, text in writer.pages().items()}
    FOLDER.mkdir(exist_ok=True)
    for name, text in made.items():
        path = FOLDER / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for path in set(FOLDER.iterdir()) - {FOLDER / name for name in made}:
        path.unlink()


if __name__ == "__main__":
    write()
