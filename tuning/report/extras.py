"""Sections of the report that are there only if they were asked for: --pareto and --gradients."""

from typing import Any

from tuning.report.page import table

Facts = dict[str, Any]


def pareto(rows: list[Facts]) -> list[str]:
    """The front of error against voltage."""
    cells = [
        [
            f"{row['effort_weight']:g}",
            f"{row['settled_rms_error_m']:.3e}",
            f"{row['settled_rms_u_V']:.4g}",
            str(row["lost"]),
            str(row["stalled"]),
            ", ".join(f"{path.rpartition('.')[2]} {value:.4g}" for path, value in row["gains"].items()),
        ]
        for row in rows
    ]
    return [
        "## Error against voltage",
        "",
        "On the training ensemble; u is averaged over time. More weight on effort buys less voltage with more error.",
        "",
        *table(["weights.effort", "settled rms error (m)", "settled rms u (V)", "lost", "stalled", "gains"], cells),
        "",
        "![Error against voltage](front.png)",
        "",
    ]


def gradient(facts: Facts) -> list[str]:
    """What the gradient is worth, three ways, by horizon and by member."""
    ways, noise = facts["three_ways"], facts["noise"]
    lines = ["## Gradients, in the logarithms of the gains", ""]
    lines += [f"Over {ways['samples']} samples, of the mean loss:", ""]
    rows = zip(facts["gains"], ways["forward"], ways["reverse"], ways["differences"], strict=True)
    cells = [[path, f"{one:.10e}", f"{two:.10e}", f"{three:.8e}"] for path, one, two, three in rows]
    lines += table(["gain", "forward", "reverse", "central differences"], cells)
    head = ["horizon (s)", "norm of the gradient of the log loss", "share of members lost"]
    lines += [
        "",
        *table(head, [[f"{r['horizon_s']:g}", f"{r['norm']:.3g}", f"{r['lost']:.3g}"] for r in facts["horizons"]]),
    ]
    rows = zip(facts["gains"], noise["gradient"], noise["standard_error"], noise["ratio"], strict=True)
    cells = [[path, f"{slope:.3e}", f"{error:.1e}", f"{ratio:.3g}"] for path, slope, error, ratio in rows]
    lines += ["", *table(["gain", "gradient of the log loss", "standard error over members", "ratio"], cells)]
    return [*lines, ""]
