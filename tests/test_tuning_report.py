"""The tuner's report as a page: text is escaped, it needs no other file, and it fits the width of a screen."""

import html
import math
import re

import browser
import numpy as np
import pytest
from bowl import World, document, instead_of_engines
from tomlkit import dumps

from ambjax.cases.reader import safe_name
from ambjax.text.web_page import escape_markdown, render_page
from tuning.__main__ import main
from tuning.problem.goal import shown


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the folder of a run of the command with a Bowl as its engine. The name of the case contains markup."""
    folder = tmp_path_factory.mktemp("written")
    path = folder / "<img src=x onerror=alert(1)> a|b *c* [d](e).toml"
    path.write_text(dumps(document()), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        instead_of_engines(patch, World())
        assert main([str(path), "--out", str(folder / "out"), "--pareto"]) in (0, 1)
    return folder / "out"


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


def test_the_page_needs_no_other_file(written):
    shown = (written / "report.html").read_text()
    assert 'src="data:image/png;base64,' in shown
    # the data of a picture may contain these letters by chance
    assert "http" not in re.sub(r"base64,[^\"]*", "", shown)


@pytest.mark.skipif(not browser.CHROMIUM, reason=browser.MISSING)
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_does_not_scroll_sideways(written, tmp_path, width):
    page = tmp_path / "page.html"
    page.write_text((written / "report.html").read_text().replace("<details>", "<details open>"))
    with browser.browser(tmp_path) as tab:
        tab.size(width)
        tab.open(page)
        tab.wait(f"document.querySelector('details') && document.readyState === 'complete' && innerWidth === {width}")
        assert tab.run("document.documentElement.scrollWidth") <= width


def test_a_goal_far_from_its_limits_is_shown_without_overflow():
    with np.errstate(over="raise"):
        assert np.isfinite(shown(np.array([1.0, 5e3]))).all()
    assert shown(2.0) == pytest.approx(math.e**2)
