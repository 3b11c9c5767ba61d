"""Latency of the page with sliders in headless Chromium: a drag, and the 64 members of the envelope.

A drag presses the arrow keys on a slider of a gain. A time runs from the event to the frame in which the plots are
drawn, in the page's own clock. On a busy machine this includes the time for which other programs run, so the CPU time
of the page's main thread, which draws, and the fastest drag are recorded too. The loop is that of `ambjax template
rig`, shortened to 0.2 s: 4,000 samples at 20 kHz. Run: python benchmarks/page.py
"""

import os
import pathlib
import re
import sys
import tempfile

os.environ["JAX_ENABLE_X64"] = "1"
sys.path.append(str(pathlib.Path(__file__).parent.parent / "tests"))

import _measure
import browser  # pyright: ignore[reportMissingImports]
import numpy as np

from ambjax.cases.reader import read_case
from ambjax.cases.template_text import template
from ambjax.page.html_page import page

STEPS, PAUSES = 60, 6
# Waits until the newest request is drawn: the nominal run, or also the members.
DRAWN, ALL = "ambjax.state.shown === ambjax.state.sent", "ambjax.state.members === ambjax.state.sent"


def measure(tab: browser.Tab, path: pathlib.Path) -> dict[str, object]:
    """Open the page, warm it up, drag a slider, and return the latencies in ms."""
    tab.size(1280)
    tab.call("Performance.enable", timeDomain="threadTicks")
    tab.open(path)
    tab.wait(f"window.ambjax && ambjax.state.sent > 0 && {ALL}", 60)
    before = busy(tab)
    tab.run("document.querySelector('[data-path=\"controller.position.c\"]').focus()")
    for step in range(STEPS):
        if step == STEPS // 2:
            tab.run("ambjax.state.timing.nominal.length = 0")
            before = busy(tab)
        tab.key("ArrowRight" if step % 20 < 10 else "ArrowLeft")
        tab.wait(DRAWN)
    tab.wait("ambjax.state.timing.nominal.length >= 25")
    after = busy(tab)
    drag = np.array(tab.run("ambjax.state.timing.nominal"))
    tab.wait(ALL, 60)
    tab.run("ambjax.state.timing.members.length = 0")
    for _ in range(PAUSES):
        tab.key("ArrowRight")
        tab.wait(ALL, 60)
    members = np.array(tab.run("ambjax.state.timing.members"))
    assert not tab.errors, tab.errors
    return {
        "drag_ms": float(np.median(drag[:, 0])),
        "drag_fastest_ms": float(drag[:, 0].min()),
        "drag_cpu_ms": 1e3 * (after - before) / (STEPS // 2),
        "loop_ms": float(np.median(drag[:, 1])),
        "loop_fastest_ms": float(drag[:, 1].min()),
        "members_ms": float(np.median(members[:, 0])),
        "members_fastest_ms": float(members[:, 0].min()),
        "members": 64,
        "load": os.getloadavg()[0],
        "drags": len(drag),
    }


def busy(tab: browser.Tab) -> float:
    """Return the CPU time (s) that the main thread of the page has used."""
    metrics = tab.call("Performance.getMetrics")["metrics"]
    return next(one["value"] for one in metrics if one["name"] == "TaskDuration")


def main() -> None:
    """Measure the page of the rig and write page.json."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        case, path = pathlib.Path(folder) / "rig.toml", pathlib.Path(folder) / "page.html"
        case.write_text(re.sub(r"duration = 0\.3", "duration = 0.2", template("rig")))
        path.write_text(page(read_case(case), (), case.name), encoding="utf-8")
        with browser.browser(pathlib.Path(folder)) as tab:
            found = measure(tab, path)
        found |= {"samples": 4000, "page_kB": path.stat().st_size // 1000}
    _measure.write("page", found)


if __name__ == "__main__":
    main()
