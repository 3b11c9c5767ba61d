"""Cost and peak memory of an ensemble against the number of members and the horizon.

The workload is that of workload.py with held noise, float64, on one core. Each point runs in its own process, so its
peak memory is that of the point alone. Each point is timed alternately with one reference ensemble, because the speed
of the machine drifts. The script compares the medians of these ratios and prints the largest deviation from the median
point; equal ratios mean linear cost. Run: python benchmarks/scaling.py [--full]
"""

import argparse
import json
import os
import statistics
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import workload

MEMBERS, FULL = (1_000, 10_000, 100_000), 1_000_000
SAMPLES = (20, 200, 2_000)
# Number of samples while the members are varied, and number of members while the samples are varied.
FIXED_SAMPLES, FIXED_MEMBERS = 200, 4_096
# REFERENCE: members and samples of the reference, which is so short that it meets the same load as the shortest point.
# SHARE: with a long point, the reference is repeated until it takes 1/SHARE of the time of the point.
REFERENCE, SHARE = (1_024, 200), 10
# A point has WORK / (its member-samples) rounds, but at least 3 and at most MOST_ROUNDS.
WORK, MOST_ROUNDS = 60_000_000, 45


def point(members: int, samples: int) -> dict[str, Any]:
    """Return seconds of a warm run, time per member-step also relative to the reference, and peak memory."""
    work = workload.workload(members, samples, noise=True)
    reference = workload.workload(*REFERENCE, noise=True)
    rounds = min(max(3, WORK // (members * samples)), MOST_ROUNDS)
    steps, reference_steps = (w.members * w.steps for w in (work, reference))
    calls = max(steps // reference_steps // SHARE, 1)
    runs = {
        "point": lambda: workload.by_ambjax(work),
        "reference": lambda: [workload.by_ambjax(reference) for _ in range(calls)],
    }
    found = _measure.alternating(runs, rounds)
    return {
        "members": members,
        "samples": samples,
        "seconds": found["point"].seconds,
        "ns": 1e9 * found["point"].seconds / steps,
        "relative": found["point"].over(found["reference"]) * calls * reference_steps / steps,
        "rounds": rounds,
        "peak_bytes": _measure.peak_memory(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="up to a million members: minutes")
    parser.add_argument("--point", type=int, nargs=2, help="measure N members over T samples and print JSON")
    given = parser.parse_args()
    if given.point:
        print(json.dumps(point(*given.point)))
        return
    grids = {
        "members": [(n, FIXED_SAMPLES) for n in (*MEMBERS, *([FULL] if given.full else []))],
        "samples": [(FIXED_MEMBERS, t) for t in SAMPLES],
    }
    results: dict[str, Any] = {}
    for name, grid in grids.items():
        rows = [_measure.child(__file__, "--point", *pair) for pair in grid]
        middle = statistics.median(row["relative"] for row in rows)
        results[name] = {"rows": rows, "deviation": max(abs(row["relative"] / middle - 1) for row in rows)}
        for row in rows:
            named = f"{row['members']:>9} members, {row['samples']:>5} samples"
            cost = f"{row['seconds']:8.3f} s, {row['ns']:6.2f} ns/step, {row['relative']:.3f} times the reference"
            print(f"{named}: {cost}, {row['peak_bytes'] / 2**20:6.0f} MiB")
        print(f"against {name}: linear to within {100 * results[name]['deviation']:.1f} %", flush=True)
    _measure.write("scaling", results)


if __name__ == "__main__":
    main()
