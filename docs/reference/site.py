"""All generated pages by file name."""

from reference import api, benchmarks, case_file, commands, conditions, floors, metrics

WRITERS = (case_file, commands, metrics, conditions, api, floors, benchmarks)


def pages() -> dict[str, str]:
    """Return the text of all pages by file name."""
    return {name: text for writer in WRITERS for name, text in writer.pages().items()}
