"""Optional section of the report: --gradients."""

from typing import Any

from ambjax.host.web_page import markdown_table
from tuning.report.gradient import AGREE, AGREED, MODES, STEADY, STEP

Facts = dict[str, Any]


def gradient(facts: Facts) -> list[str]:
    """Return the section on the gradient: three ways to compute it, growth with the horizon, noise over members."""
    ways, noise = facts["three_ways"], facts["noise"]
    lines = ["## Gradients, in the logarithms of the gains", ""]
    lines += [f"Over {ways['samples']} samples, of the mean loss:", ""]
    rows = zip(facts["gains"], ways["forward"], ways["reverse"], ways["differences"], ways["verdicts"], strict=True)
    cells = [[path, f"{one:.10e}", f"{two:.10e}", f"{three:.8e}", said] for path, one, two, three, said in rows]
    lines += markdown_table(["gain", "forward", "reverse", "central differences", "verdict"], cells)
    lines += ["", *_verdict(ways)]
    head = ["horizon (s)", "norm of the gradient of the log loss", "share of members lost"]
    lines += [
        "",
        *markdown_table(
            head, [[f"{r['horizon_s']:g}", f"{r['norm']:.3g}", f"{r['lost']:.3g}"] for r in facts["horizons"]]
        ),
    ]
    rows = zip(facts["gains"], noise["gradient"], noise["standard_error"], noise["ratio"], strict=True)
    cells = [[path, f"{slope:.3e}", f"{error:.1e}", f"{ratio:.3g}"] for path, slope, error, ratio in rows]
    lines += ["", *markdown_table(["gain", "gradient of the log loss", "standard error over members", "ratio"], cells)]
    return [*lines, ""]


def _verdict(ways: Facts) -> list[str]:
    """Describe for how many gains the three ways agree, the tolerances, and causes of disagreement."""
    count, agreed = len(ways["verdicts"]), ways["verdicts"].count(AGREED)
    lines = [
        f"**The three derivatives agree for {agreed} of {count} gains.** Relative tolerances: {MODES:g} between "
        f"forward and reverse mode; {100 * STEADY:g} % between central differences with the steps {STEP:g} "
        f"and {STEP / 2:g} in the logarithm of the gain; {100 * AGREE:g} % between the extrapolated "
        "difference and both modes."
    ]
    if agreed < count:
        lines += [
            "",
            "Both modes differentiate the simulated steps exactly. Differences compare two runs. If a converter "
            "rounds, a sign switches, or a chaotic loop amplifies rounding errors, the two runs separate, and the "
            "difference depends on the step. A derivative does not include jumps of the loss. If there are "
            "jumps, it is not the slope of the mean loss over many members.",
        ]
    return lines
