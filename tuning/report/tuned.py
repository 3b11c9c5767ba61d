"""tuned.toml: the user's case file, with its comments, and the tuned gains."""

import pathlib
import re
import tomllib
from collections.abc import Mapping

from ambjax.cases.reader import Case, case_from
from ambjax.results.case_file import files_from, with_numbers

FIRST = "Tuned by ambjax tune from the case"
AUTO = "auto"
# First lines of tuned.toml. They are removed when the file is tuned again.
HEAD = re.compile(rf"\A# {FIRST} [^\n]*\n(#[^\n]*\n)?\n?")
# Characters that a comment must not contain; surrogates come from file names that are not UTF-8.
CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def tuned_case(case: Case, gains: Mapping[str, float], verdict: str, out: pathlib.Path) -> tuple[str, Case]:
    """Return the text of tuned.toml for the folder `out`, and its case. Raises ValueError if the text is no valid case.

    If the integration step of the case is too coarse for the tuned gains, "auto" replaces clock.dt and clock.method,
    and the first lines of the text say so.

    The custom laws, the linear controller and the recorded signals are those of `case`: a change of their files during
    the search has no effect.
    """
    values = {**gains, **files_from(case, out)}
    text = tuned(case.text, values, case.name, verdict)
    try:
        return text, case_from(tomllib.loads(text), case.name, known=case)
    except ValueError as error:
        steps = [key for key in ("dt", "method") if tomllib.loads(case.text).get("clock", {}).get(key, AUTO) != AUTO]
        if not steps:
            raise
        words = f'{verdict} In [clock], "{AUTO}" replaces {" and ".join(steps)} of the case: {error}'
        text = tuned(case.text, {**values, **{f"clock.{key}": AUTO for key in steps}}, case.name, words)
        return text, case_from(tomllib.loads(text), case.name, known=case)


def tuned(text: str, gains: Mapping[str, float | str], case: str, verdict: str) -> str:
    """Return the text of `with_numbers` after a comment: the name of the case and the verdict."""
    body = with_numbers(HEAD.sub("", text.replace("\r\n", "\n")), gains)
    head = [f"# {CONTROL.sub(_escaped, line)}" for line in (f"{FIRST} '{case}'.", verdict)]
    return "\n".join([*head, "", body.strip()]) + "\n"


def _escaped(character: re.Match[str]) -> str:
    return f"\\u{ord(character[0]):04x}"
