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
        f"**The three agree on {agreed} of {count} gains**: forward and reverse mode to {MODES:g} of the derivative, "
        f"differences of the steps {STEP:g} and {STEP / 2:g} (of the gain's logarithm) to {100 * STEADY:g} %, and "
        f"their extrapolation with the modes to {100 * AGREE:g} %."
    ]
    if agreed < count:
        lines += [
            "",
            "Both modes differentiate the simulated steps exactly. Differences compare two runs: where a converter "
            "rounds, a sign switches or a chaotic loop amplifies rounding, these part, and what they show depends on "
            "the step. A derivative does not see jumps of the loss: there it is not the slope of the mean over many "
            "members.",
        ]
    return lines
