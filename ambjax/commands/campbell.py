"""`ambjax campbell`: poles of the closed loops of a machine against its speed."""

import argparse

import numpy as np

from ambjax.cases.machine_case import MachineCase, read_machine
from ambjax.linear import linearise_machine, poles_in_s
from ambjax.results.outputs import described, directory, files, plain, say, write_json, written

WRITTEN = ("campbell.json", "campbell.png")
# Number of speeds, and the end of their range as a multiple of the largest speed of the case.
SPEEDS, BEYOND = 31, 1.2
# End of the range for a rotor that does not turn, rpm.
SLOWEST = 6000.0


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Compute the poles at speeds from 0 on, and draw them. Exit code 1 if the machine is unstable at one of them."""
    case = read_machine(args.case)
    fastest = max(abs(speed) for speed in case.speeds)
    end = args.to if args.to is not None else BEYOND * fastest or SLOWEST
    if not end > 0:
        raise ValueError(f"--to {end:g}: it must be above 0 rpm.")
    out = directory(args.out, f"campbell-{case.name}", WRITTEN, args.force)
    say(f"linearising the machine at {SPEEDS} speeds; the first one compiles for some seconds")
    speeds = np.linspace(0.0, end, SPEEDS)
    poles = [poles_at(case, float(speed)) for speed in speeds]
    growth = np.array([float(np.max(np.real(own))) for own in poles])
    unstable = [float(speed) for speed, rate in zip(speeds, growth, strict=True) if rate > 0]
    summary = {
        "speeds_rpm": speeds, "stable": not unstable, "unstable_at_rpm": unstable, "growth_per_s": growth,
        "poles_per_s": [[[float(p.real), float(p.imag)] for p in own] for own in poles],
    }  # fmt: skip
    from ambjax.pictures.machine_pictures import campbell_picture

    with files(out) as part:
        write_json(part / "campbell.json", summary)
        described("campbell.png", lambda: campbell_picture(case.name, speeds, poles, part / "campbell.png"))
        names = [name for name in WRITTEN if (part / name).exists()]
    if not args.json:
        words = f"unstable at {', '.join(f'{speed:g}' for speed in unstable)} rpm" if unstable else "stable"
        print(f"0 to {end:g} rpm: {words}; largest real part of a pole {growth.max():.4g} 1/s")
        written(out, ", ".join(names))
    return int(bool(unstable)), plain(summary | {"out": str(out)})


def poles_at(case: MachineCase, speed: float) -> np.ndarray:
    """Return the poles at a speed (rpm), 1/s, in the order of decreasing real part."""
    poles = poles_in_s(linearise_machine(case.machine, case.clock.sample_period, speed))
    return poles[np.argsort(-np.real(poles))]
