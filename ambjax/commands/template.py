"""`ambjax template`: print an annotated case file."""

import argparse

from ambjax.cases.template_text import template


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Print an annotated case file."""
    text = template(args.scenario)
    if not args.json:
        print(text, end="")
    return 0, {"template": text}
