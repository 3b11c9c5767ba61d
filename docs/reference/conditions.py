"""The output of `ambjax check`: the conditions of Theorem 1 and the steps of its proof, for the default loop."""

import functools

from ambjax import Cascade, Clock, Scenario
from ambjax.theorem import conditions, sampled_report
from reference.markdown import code, escaped, paragraphs, table


def pages() -> dict[str, str]:
    """Return the page."""
    found = report()
    lines = ["# Conditions of `ambjax check`", ""]
    lines += paragraphs(conditions)
    lines += ["## The conditions", "", "The margin is the left side minus the right side, at the worst time.", ""]
    rows = [
        (escaped(c.name), escaped(c.requires), escaped(c.unit), code(c.path), escaped(c.note)) for c in found.conditions
    ]
    lines += table(("condition", "inequality", "unit", "gain", "note"), rows, "keys")
    lines += ["## The steps of the proof", "", "These residuals do not affect the verdict.", ""]
    steps = [(escaped(c.name), escaped(c.requires), escaped(c.unit), escaped(c.note)) for c in found.proof]
    lines += table(("step", "statement", "unit", "number shown"), steps, "keys")
    lines += ["## On a processor", "", *paragraphs(sampled_report)]
    lines += ["[The processor](../processor.md#checking-it) explains the output.", ""]
    return {"conditions.md": "\n".join(lines)}


@functools.cache
def report() -> conditions.Report:
    """Return the check of a run of a few samples; every check has the same lines."""
    return conditions.check(Cascade(), Scenario(), Clock(samples=2))
