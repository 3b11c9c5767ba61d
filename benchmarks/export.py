"""Cost of a step of an exported controller: time on this machine; instructions, code and stack on a Cortex-M4F.

Cycles are the median of the time stamp counter over rounds. QEMU counts the instructions; it does not model the
pipeline. Run: python benchmarks/export.py
"""

import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any

os.environ["JAX_ENABLE_X64"] = "1"

import _measure
import cortex
import numpy as np

from ambjax import Cascade
from ambjax.codegen.c99 import machine
from ambjax.codegen.c99.package import files_of_trace
from ambjax.codegen.c99.source import Origin
from ambjax.codegen.controller import controller_of
from ambjax.codegen.trace import trace
from ambjax.control.processor import Processor
from ambjax.laws import current, inversion, observer, position

HARD = np.inf
NOW, LATER = Processor(1.0, predict=False), Processor(1.0)
SIGN: dict[str, Any] = {
    "position": position.SlidingMode(1440.0, 2.3, HARD),
    "inversion": inversion.Adaptive(8e5, HARD),
    "current": current.SlidingMode(870.0, HARD),
}
OBSERVER: dict[str, Any] = {"observer": observer.Complementary()}
TWISTING: dict[str, Any] = {"position": position.SuperTwisting(p=HARD)}
CASES = {
    "the paper's laws, p = inf, an observer": Cascade(**OBSERVER, **SIGN, processor=NOW),
    "the same, predicted": Cascade(**OBSERVER, **SIGN, processor=LATER),
    "the same, p = 25": Cascade(**OBSERVER, processor=NOW),
    "p = 25, predicted": Cascade(**OBSERVER, processor=LATER),
    "super-twisting, p = inf, predicted": Cascade(**OBSERVER | SIGN | TWISTING, processor=LATER),
    "a Kalman filter, p = inf, predicted": Cascade(observer=observer.Kalman(), **SIGN, processor=LATER),
    "PI, closed form, p = 25": Cascade(
        **OBSERVER, inversion=inversion.ClosedForm(), current=current.ProportionalIntegral(), processor=NOW
    ),
}
ROUNDS, STEPS = 401, 500
LOOP = """
static amb_state state;
static amb_output output;
static volatile amb_real sum;
static void steps(int count)
{
    amb_real total = 0;
    for (int n = 0; n < count; n++) {
        const amb_input input = {.z = (amb_real)1e-6 * (amb_real)(n % 7), .z_dot = (amb_real)1e-3, .i = (amb_real)1e-3};
        amb_step(&amb_default, &state, &input, &output);
        total += output.u;
    }
    sum = total;
}
"""
HERE = f"""#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include <x86intrin.h>
#include "amb.h"
{LOOP}
int main(void)
{{
    amb_init(&state);
    for (int round = 0; round < {ROUNDS}; round++) {{
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        const unsigned long long begun = __rdtsc();
        steps({STEPS});
        const double cycles = (double)(__rdtsc() - begun);
        clock_gettime(CLOCK_MONOTONIC, &b);
        const double ns = (double)(b.tv_sec - a.tv_sec) * 1e9 + (double)(b.tv_nsec - a.tv_nsec);
        printf("%g %g\\n", cycles / {STEPS}, ns / {STEPS});
    }}
    return 0;
}}
"""
# SysTick runs at 25 MHz. -icount shift=0 executes an instruction per nanosecond, so a tick is 40 instructions.
THERE = f"""#include <stdio.h>
#include <stdint.h>
#include "amb.h"
{LOOP}
#define TICK ((volatile uint32_t *)0xE000E010u)
int main(void)
{{
    amb_init(&state);
    TICK[1] = 0xFFFFFFu;
    TICK[2] = 0u;
    TICK[0] = 5u;
    const uint32_t a = TICK[2];
    steps(1000);
    const uint32_t b = TICK[2];
    steps(3000);
    const uint32_t c = TICK[2];
    const uint32_t more = ((b - c) & 0xFFFFFFu) - ((a - b) & 0xFFFFFFu);
    printf("%lu\\n", (unsigned long)(40u * more / 2000u));
    return 0;
}}
"""


def measured(cascade: Cascade, precision: str) -> dict[str, Any]:
    """Return one row of the table."""
    controller = controller_of(cascade, 200.0, 1e-4)
    traced = trace(controller, precision)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for file, text in files_of_trace(traced, "amb", Origin("benchmark", "-", controller.described())).items():
            (folder / file).write_text(text)
        (folder / "here.c").write_text(HERE)
        said = machine.build([folder / "amb.c", folder / "here.c"], folder / "here", "-std=gnu99")
        if said:
            raise RuntimeError(said)
        lines = subprocess.run([folder / "here"], check=True, capture_output=True, text=True).stdout.split()
        cycles, nanoseconds = np.median(np.array(lines, float).reshape(-1, 2), axis=0)
        counts = traced.counts()
        row = {"precision": precision, "flops": traced.flops(), "divisions": counts["divide"], "roots": counts["root"]}
        row |= {"cycles": float(cycles), "ns": float(nanoseconds), "state_bytes": traced.state_bytes()}
        if precision == "float" and not cortex.missing():
            (folder / "there.c").write_text(THERE)
            code, output = cortex.run([folder / "amb.c", folder / "there.c"], folder, "-icount", "shift=0")
            assert code == 0, output
            size, stack = cortex.size(folder / "amb.c")
            row |= {"instructions": int(output), "code_bytes": size, "stack_bytes": stack}
    return row


def main() -> None:
    if why := cortex.missing():
        print(f"nothing of a Cortex-M4F: {why}", file=sys.stderr)
    rows = []
    for name, cascade in CASES.items():
        for precision in ("float", "double"):
            rows.append({"case": name} | measured(cascade, precision))
            print(rows[-1])
    _measure.write("export", {"rows": rows})


if __name__ == "__main__":
    main()
