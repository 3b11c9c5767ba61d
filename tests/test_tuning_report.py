"""The tuner's report: consistent sums, the results of accurate steps, and the HTML page."""

import dataclasses
import html
import math
import re
import shutil
import subprocess
import types

import numpy as np
import pytest
from bowl import World, instead_of_engines
from texts import problem_from

from ambjax.cases.reader import safe_name
from ambjax.simulation.trajectory import STALLED, TOUCHED
from ambjax.text.web_page import escape_markdown, render_page
from tuning.__main__ import main
from tuning.problem.goal import shown
from tuning.report import document as report
from tuning.report import folder, pictures

CASE = """
reference = { kind = "sine", amplitude = 1e-3, frequency = 5.0 }
controller.inversion = { gamma = 3e5 }
sensor = { std = 1e-6, std_z_dot = 1e-4, std_i = 1e-4 }
actuator = { u_max = 200.0 }
clock = { duration = 0.02 }
run = { settle = 0.01 }
spread = { plant.m = { percent = 5 } }
[tune]
objective = "least_error"
limits.sensitivity = inf
gains = ["controller.position.c", "controller.position.k"]
screen = 4
starts = 1
iterations = 2
members = 4
stressed = 2
validation = 4
held_out = 12
weights.peak = 0.5
risk = "cvar"
"""


@pytest.fixture(scope="module")
def study():
    return problem_from(CASE)


@pytest.fixture(scope="module")
def x(study):
    return study.objective.space.encode(study.tune.space.values(study.case.cascade))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the folder of a run of the command with a Bowl as its engine. The name of the case contains markup."""
    folder = tmp_path_factory.mktemp("written")
    path = folder / "<img src=x onerror=alert(1)> a|b *c* [d](e).toml"
    path.write_text(CASE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        instead_of_engines(patch, World())
        assert main([str(path), "--out", str(folder / "out"), "--pareto"]) in (0, 1)
    return folder / "out"


DRAWN = ("before", "after", "spectrum", "convergence", "front")


def cells(text, heading):
    """Rows of the first Markdown table below a heading, cells as text."""
    below = text.partition(f"## {heading}")[2].lstrip("\n")
    lines = [line for line in below.partition("\n## ")[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines if "---" not in line]


# --- pages ---------------------------------------------------------------------------------------------------------


def test_a_vertical_bar_in_a_condition_is_escaped(written):
    rows = cells((written / "report.md").read_text(), "Conditions of Theorem 1")
    assert {len(row) for row in rows} == {6}
    shown = (written / "report.html").read_text()
    assert "k &gt; sup |q_z + h|</td>" in shown
    table = next(part for part in shown.split("<table>") if "sup |q_z + h|" in part).partition("</table>")[0]
    assert {row.count("</td>") + row.count("</th>") for row in table.split("<tr>")[1:]} == {6}


def test_the_name_of_a_case_is_escaped(written):
    name = "<img src=x onerror=alert(1)> a|b *c* [d](e)"
    name, shown = safe_name(name), (written / "report.html").read_text()
    assert f"<h1>Tuning of {html.escape(name)}</h1>" in shown
    assert f"<title>Tuning of {html.escape(name)}</title>" in shown
    assert "<img src=x" not in shown
    # another program that renders report.md finds no HTML in it either
    assert not re.search(r"(?<!\\)<", (written / "report.md").read_text())


def test_text_is_escaped_everywhere_in_the_report():
    text = "\\<b>x</b> & | *a* _b_ `c` ~d~ ![e](f) #g\n# h\x00"
    for frame in ("{}", "# {}", "| a |\n|---|\n| {} |", "- {}"):
        shown = render_page(frame.format(escape_markdown(text)), {}, "t").partition("</style>")[2]
        words = re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", "", shown))).strip().removeprefix("a ")
        assert words == "\\<b>x</b> & | *a* _b_ `c` ~d~ ![e](f) #g\ufffd# h\ufffd"


def test_lists_of_the_report_are_html_lists(written):
    shown = (written / "report.html").read_text()
    assert "<li>risk: CVaR(0.9)" in shown
    assert "<p>- " not in shown


def test_wide_content_scrolls_in_its_own_box(written):
    shown = (written / "report.html").read_text()
    assert '<meta name="viewport" content="width=device-width,initial-scale=1">' in shown
    assert re.search(r"\.wide\{[^}]*overflow-x:auto", shown)
    assert shown.count("<table>") == shown.count('<div class="wide"><table>') > 4
    assert shown.count("<img ") == shown.count('<span class="wide"><img ') == 5
    assert 'src="data:image/png;base64,' in shown
    # the page needs no other file; the data of a picture may contain these letters by chance
    assert "http" not in re.sub(r"base64,[^\"]*", "", shown)


def test_the_page_shows_the_answer_and_the_front_and_folds_the_rest(written):
    shown = (written / "report.html").read_text()
    opened, *folded = shown.split("<details>")
    assert opened.partition("<ul>")[2].partition("</ul>")[0].count("<li>") == 5
    assert re.findall(r"<h2>(.*?)</h2>", opened) == ["Error against voltage"]
    headings = re.findall(r"^## (.*)$", (written / "report.md").read_text(), re.MULTILINE)
    assert [re.search(r"<summary><h2>(.*?)</h2>", part)[1] for part in folded] == headings[1:]


@pytest.mark.skipif(not shutil.which("chromium"), reason="needs a browser")
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_does_not_scroll_sideways(written, tmp_path, width):
    say = "<script>parent.postMessage(document.documentElement.scrollWidth+' of '+innerWidth,'*')</script>"
    shown = (written / "report.html").read_text()
    (tmp_path / "page.html").write_text(
        shown.replace("</html>", say + "</html>").replace("<details>", "<details open>")
    )
    frame = (
        f"<script>onmessage=e=>document.title=e.data</script><iframe width={width} height=900 src=page.html></iframe>"
    )
    (tmp_path / "frame.html").write_text(frame)
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=5000",
        f"--user-data-dir={tmp_path}/u",
    ]
    command = ["chromium", *flags, "--dump-dom", (tmp_path / "frame.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    needed, inner = map(int, re.search(r"<title>(\d+) of (\d+)", done.stdout).groups())
    assert inner == width
    assert needed <= inner


def test_the_pictures_of_the_report_are_in_its_folder(written):
    named = re.findall(r"!\[.*?\]\((.*?)\)", (written / "report.md").read_text())
    assert sorted(named) == sorted(f"{name}.png" for name in DRAWN)
    for name in named:
        assert (written / name).read_bytes().startswith(b"\x89PNG")


def test_the_legend_of_the_spectrum_says_why_a_run_has_none(study, monkeypatch):
    run = folder.nominal(study, study.case.cascade)
    stalled = dataclasses.replace(run, lost_code=STALLED, rows=run.rows._replace(alive=np.asarray(run.rows.t) < 0.005))
    lost = dataclasses.replace(stalled, lost_code=TOUCHED)
    monkeypatch.setattr(pictures, "_png", lambda figure: figure)
    runs = {"before": lost, "after": stalled, "held": run}
    entries = pictures.spectrum(runs, 0.01).axes[0].get_legend().get_texts()
    assert [one.get_text() for one in entries] == ["before: lost before 0.01 s", "after: stalled before 0.01 s", "held"]
    entries = pictures.spectrum({"held": run}, float(run.rows.t[-5])).axes[0].get_legend().get_texts()
    assert entries[0].get_text().startswith("held: fewer than 16 samples after ")


def test_ranges_and_their_sources_are_in_the_table():
    row = {"path": "controller.position.c", "before": 1.0, "after": 2.0, "least": 0.0, "most": 30.0, "at_bound": "",
           "sensitivity_percent": 3.0, "sensitivity_lost": 0, "low": 0.5, "high": 20.0,
           "source": "w/30 to 10 w"}  # fmt: skip
    facts = types.SimpleNamespace(gains=[row], trained_on=40, nominal_steps="by accurate steps")
    table = "\n".join(report._gains(facts))
    assert "| controller.position.c | 1 | 2 | 0.5 | 20 | 0 | 30 | - | 3 % |" in table
    assert "- controller.position.c: w/30 to 10 w" in table


def test_a_goal_far_from_its_limits_is_shown_without_overflow():
    with np.errstate(over="raise"):
        assert np.isfinite(shown(np.array([1.0, 5e3]))).all()
    assert shown(2.0) == pytest.approx(math.e**2)
