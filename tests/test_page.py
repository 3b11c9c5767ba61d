"""The page with sliders: its loop, metrics and sensitivity equal the simulator's, in a real browser, from disk."""

import dataclasses
import json
import pathlib
import tomllib

import browser
import numpy as np
import pytest
from texts import refusal, write

from ambjax.__main__ import main
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template as case_template
from ambjax.control.synchronous_notch import SynchronousNotch
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.study import Study
from ambjax.linear.analysis import analyse, linearise
from ambjax.page import html_page
from ambjax.page.case_text import checked, editable_lines, filled
from ambjax.page.html_page import MEMBERS, page
from ambjax.page.sliders import SEED, parameter_values, sliders
from ambjax.results.runs import simulate

# 200 samples: rounding has not grown yet. Two runs of the rig one unit in the last place apart are 1e-16 m apart there.
RIG = case_template("rig").replace("duration = 0.3 ", "duration = 0.01").replace("settle = 0.05", "settle = 0.005")
RIG = RIG.replace("start = 0.1 ", "start = 0.002").replace("stop = 0.2 ", "stop = 0.004")


def rig(text=RIG, name="rig"):
    return case_from(tomllib.loads(text), name, text)


@pytest.fixture(scope="module")
def case():
    return rig()


def moved(one):
    """Return another allowed value of a slider."""
    away = one.value * 1.25 if one.value else (one.low + one.high) / 3 or one.high / 4
    return float(round(one.value + 1)) if one.whole else min(away, one.most)


def test_every_number_reads_back_from_the_case_file(case):
    given = sliders(case, [])
    lines, placed = editable_lines(case.text, given)
    assert sorted(placed) == list(range(len(given)))
    assert checked(lines, given)
    assert filled(lines, given, [one.value for one in given]) == case.text
    assert {"controller.position.c", "plant.m", "sensor.std", "processor.delay", "reference.value", SEED} <= {
        one.path for one in given
    }
    # a delay between two samples would be another structure
    values = [one.value if one.path == "processor.delay" else moved(one) for one in given]
    expected = parameter_values(case)
    for one, value in zip(given, values, strict=True):
        expected[one.parameter] = value
    np.testing.assert_array_equal(parameter_values(rig(filled(lines, given, values))), expected)
    for k, one in enumerate(given):
        alone = [other.value if j != k else values[j] for j, other in enumerate(given)]
        document = tomllib.loads(filled(lines, given, alone))
        for word in one.path.split("."):
            document = document[word]
        assert document == values[k], one.path


LISTS = """
plant = { m = 5.0, s_0 = 8e-4 }
[[disturbance.q_z]]
kind = "constant"
unit = "N"
value = 1.0
[[disturbance.q_z]]
kind = "sine"
amplitude = 0.5
frequency = 50.0
[[disturbance.q_z]]
kind = "sine"
unit = "N"
amplitude = 2.0
frequency = 20.0
[reference]
kind = "sum"
terms = [{ kind = "constant", value = 1e-5 }, { kind = "sine", amplitude = 1e-5, frequency = 10.0, phase = 0.5 }]
[controller.position]
k = { over = "error", at = [0.0, 1e-5], values = [100.0, 200.0] }
[processor]
[clock]
duration = 0.01
"""


def test_loads_in_a_list_schedules_omitted_gains_and_the_initial_state_have_sliders_that_set_them_in_the_file():
    case = rig(LISTS)
    given, (lines,) = html_page._written(case, [])
    written = {"disturbance.q_f.terms.1.amplitude", "disturbance.q_z.phase", "reference.terms.1.phase"}
    assert {one.path for one in given} >= written | {
        "controller.position.k.1", "controller.position.c", "controller.current.k_i", "initial.z", "plant.m"
    }  # fmt: skip
    values, expected = [one.value for one in given], parameter_values(case)
    for k, one in enumerate(given):
        if one.path.startswith(("disturbance.", "reference.", "controller.", "initial.")):
            values[k] = expected[one.parameter] = moved(one)
    np.testing.assert_array_equal(parameter_values(rig(filled(lines, given, values))), expected)


def test_ranges_contain_the_values_of_every_preset(case):
    louder = rig(RIG.replace("c = 2900.0", "c = 9e5").replace("u_max = 48.0", "u_max = 1.0"))
    for one in sliders(case, [louder]):
        for value in (one.value, parameter_values(louder)[one.parameter]):
            assert one.low <= value <= one.high, one.path


OTHER = RIG.replace('kind = "kalman"\nw = 1000.0', 'kind = "ired-1"')
TABLE = """
clock.duration = 0.01
processor = {}
disturbance.q_z = [{ kind = "table", file = "force.csv" }, { kind = "constant" }]
"""


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        (case_template("tracking"), "page", "and this case has none. Add the table [processor]."),
        (TABLE, "page", 'disturbance.q_z: kind = "table": a page cannot contain a signal from a file.'),
        (RIG, "page --also other.toml", "--also other: it differs from"),
        (RIG, "simulate --page --member 1", "--page shows the case, not a member"),
        (RIG, "page --out mine.html", "--out mine.html: the file exists"),
        (RIG, "page --out page.txt", "--out page.txt"),
    ],
)
def test_what_a_page_cannot_show_or_replace_is_refused(text, words, said, elsewhere, capsys):
    write("0,1\n1,2\n", "force.csv")
    write(OTHER, "other.toml")
    write("mine", "mine.html")
    case, before = write(text, "rig.toml"), sorted(pathlib.Path().iterdir())
    assert said in refusal(capsys, *words.split(), case)
    assert sorted(pathlib.Path().iterdir()) == before
    assert pathlib.Path("mine.html").read_text() == "mine"


def test_a_notch_is_refused(case):
    cascade = dataclasses.replace(case.cascade, notch=SynchronousNotch())  # the reader would linearise the loop first
    with pytest.raises(ValueError, match="a page cannot contain a notch"):
        page(dataclasses.replace(case, cascade=cascade))


HOSTILE = "</script><img src=x onerror=\"document.title='owned'\">"


def in_browser(test):
    return pytest.mark.slow(pytest.mark.skipif(not browser.CHROMIUM, reason=browser.MISSING)(test))


@pytest.fixture(scope="module")
def tuned():
    """A second preset with other gains. Its name and a comment contain markup."""
    text = RIG.replace("c = 2900.0", "c = 2000.0").replace("[plant]", f"# {HOSTILE}\n[plant]", 1)
    return dataclasses.replace(rig(text), name=HOSTILE)


@pytest.fixture(scope="module")
def written(case, tuned, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(page(case, [tuned], f"{HOSTILE}.toml"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def tab(written, tmp_path_factory):
    with browser.browser(tmp_path_factory.mktemp("profile")) as tab:
        tab.size(1280)
        tab.open(written)
        settled(tab)
        yield tab


def settled(tab):
    """Wait until the page shows the newest run and its members."""
    tab.wait("window.ambjax && ambjax.state.sent > 0 && ambjax.state.members === ambjax.state.sent", 60)


def choose(tab, preset):
    menu = "document.getElementById('preset')"
    tab.run(f"{menu}.value = {preset}; {menu}.dispatchEvent(new Event('change'))")
    settled(tab)


@pytest.fixture
def fresh(tab):
    """The tab with the numbers of the case."""
    choose(tab, 0)
    yield tab
    assert tab.errors == []


def signal(tab, name):
    return np.array(tab.run(f"Array.from(ambjax.state.run.of('{name}'))"))


def typed(tab, path, text):
    """Type a number as a user does, and wait for the run."""
    number = f"document.querySelector('[data-path=\"{path}\"]').parentElement.querySelector('input[type=text]')"
    tab.run(f"{number}.value = {json.dumps(text)}; {number}.dispatchEvent(new Event('change'))")
    settled(tab)


@in_browser
def test_the_trajectory_with_noise_and_the_metrics_equal_the_simulator(fresh, case):
    run = simulate(case)
    rows, metrics = run.trajectory.rows, run.metrics
    # equal to the order of rounding; an error would be at least the noise, 5e-7 m
    for name, tolerance in (("z", 1e-13), ("z_measured", 1e-13), ("u", 1e-6), ("i", 1e-9), ("r", 0)):
        np.testing.assert_allclose(signal(fresh, name), getattr(rows, name), rtol=0, atol=tolerance, err_msg=name)
    upper = float(case.scenario.plant.i_0) + np.asarray(rows.i)
    np.testing.assert_allclose(signal(fresh, "i_1"), upper, rtol=0, atol=1e-9)
    found = fresh.run("ambjax.state.metrics")
    assert set(found) == set(metrics)
    for name, value in metrics.items():
        # JSON has no infinity: null
        assert (np.inf if found[name] is None else found[name]) == pytest.approx(float(value), rel=1e-6), name
    shown = fresh.run("document.getElementById('metrics').innerText")
    assert all(name in shown for name in metrics)


@in_browser
def test_the_members_equal_those_of_the_ensemble(fresh, case):
    study = Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, 0, MEMBERS)
    batch = study.batch(np.arange(MEMBERS))
    errors = np.asarray(run_ensemble(*batch, case.clock, fold=None, record_every=1).trajectory.rows.e_z)
    low, high = (np.array(fresh.run(f"Array.from(ambjax.state.envelope.{end})")) for end in ("low", "high"))
    np.testing.assert_allclose([low, high], [errors.min(axis=0), errors.max(axis=0)], rtol=0, atol=1e-12)
    assert fresh.run("ambjax.state.envelope.kept") == MEMBERS


@in_browser
@pytest.mark.parametrize("delay", ["1.0", "0.5"])
def test_sensitivity_and_trajectory_with_a_delay_equal_the_analysis_and_the_simulator(fresh, delay):
    typed(fresh, "processor.delay", delay)
    other = rig(RIG.replace("delay = 1.0", f"delay = {delay}"))
    system = linearise(other.cascade, other.scenario, other.clock)
    expected = analyse(system, other.scenario.plant.m, other.clock.sample_period, other.zones)
    S = fresh.run("({...ambjax.state.answer.S})")
    np.testing.assert_allclose(S["size"], np.abs(np.asarray(system.sensitivity(np.array(S["f"])))), rtol=1e-7)
    assert S["peak"] == pytest.approx(expected.S.height, rel=1e-6)
    assert (S["stable"], S["zone"]) == (expected.stable, expected.zone)
    np.testing.assert_allclose(signal(fresh, "z"), simulate(other).trajectory.rows.z, rtol=0, atol=1e-12)


@in_browser
def test_a_slider_changes_the_response_and_the_preset_restores_it(fresh):
    before = signal(fresh, "z")
    fresh.run("document.querySelector('[data-path=\"controller.position.k\"]').focus()")
    for _ in range(50):
        fresh.key("ArrowRight")
    settled(fresh)
    assert np.max(np.abs(signal(fresh, "z") - before)) > 1e-6
    fresh.click("#reset")
    settled(fresh)
    np.testing.assert_array_equal(signal(fresh, "z"), before)


@in_browser
def test_the_second_preset_has_its_own_numbers(fresh, tuned):
    choose(fresh, 1)
    np.testing.assert_allclose(signal(fresh, "z"), simulate(tuned).trajectory.rows.z, rtol=0, atol=1e-12)
    assert HOSTILE in fresh.run("ambjax.caseFile()")


@in_browser
def test_an_extreme_value_loses_the_rotor_and_the_page_reports_it(fresh):
    typed(fresh, "controller.position.k", "0.01")
    typed(fresh, "plant.m", "16")
    assert fresh.run("document.getElementById('status').textContent").startswith("The rotor is lost at ")
    assert fresh.run("document.getElementById('status').classList.contains('lost')")
    assert fresh.run("ambjax.state.envelope.kept") < MEMBERS
    assert fresh.run("ambjax.state.metrics.lost") == 1


@in_browser
def test_a_wrong_number_is_refused_with_a_message(fresh):
    before = fresh.run("ambjax.state.sent")
    box = "document.querySelector('[data-path=\"plant.m\"]').parentElement"
    for text, words in (("-1", "at least"), ("heavy", "Type a number"), ("", "Type a number"), ("1e99", "at most")):
        typed(fresh, "plant.m", text)
        assert words in fresh.run(f"{box}.querySelector('.fault').textContent")
    assert fresh.run(f"{box}.querySelector('input[type=text]').getAttribute('aria-invalid')") == "true"
    assert fresh.run("ambjax.state.sent") == before


@in_browser
def test_the_case_file_with_these_numbers_simulates_to_the_same_run(fresh):
    for path, text in (("controller.position.c", "1500"), ("plant.m", "1.7"), ("sensor.std", "1e-6"), (SEED, "3")):
        typed(fresh, path, text)
    fresh.click("#write")
    text = fresh.run("document.getElementById('text').value")
    np.testing.assert_allclose(signal(fresh, "z"), simulate(rig(text)).trajectory.rows.z, rtol=0, atol=1e-12)
    assert "m = 1.64" in text.split("[controller.model]")[1]
    fresh.click("#tune")
    assert fresh.run("document.getElementById('text').value").startswith("ambjax tune ")


@in_browser
def test_texts_of_the_case_are_escaped_and_the_page_loads_nothing(fresh):
    assert fresh.run("document.title") != "owned"
    assert fresh.run("document.querySelectorAll('img').length") == 0
    assert {url.partition(":")[0] for url in fresh.requests} <= {"file", "blob", "data"}


@in_browser
def test_the_drawing_of_the_machine_shows_the_selected_time(fresh):
    drawing = "document.querySelector('#drawing svg').getAttribute('aria-label')"
    begin = fresh.run(drawing)
    fresh.run("document.getElementById('time').focus()")
    fresh.key("End")
    assert fresh.run(drawing) != begin
    z = 1e6 * signal(fresh, "z")[-1]
    assert f"Rotor at {z:.2f} micrometres" in fresh.run(drawing)


@in_browser
def test_every_input_has_a_label_and_the_page_does_not_scroll_sideways(fresh):
    inputs = "[...document.querySelectorAll('input, select, textarea')]"
    assert fresh.run(f"{inputs}.filter(e => !e.labels.length && !e.ariaLabel).length") == 0
    for width in (390, 1280):
        fresh.size(width)
        fresh.wait(f"innerWidth === {width}")
        assert fresh.run("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_the_command_writes_the_page(elsewhere, capsys):
    one = write(RIG, "rig.toml")
    assert main(["page", one, "--also", one, "--out", "new/p.html", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert pathlib.Path(found["out"]).stat().st_size == found["bytes"]


def test_cases_with_different_numbers_share_a_page(case, monkeypatch):
    other = case_from(tomllib.loads(OTHER), "other", RIG)
    louder = rig(RIG.replace("std = 5e-7", "std = 1e-6"), "louder")
    shown = lambda case, others, path: f"{path}: {[one.name for one in (case, *others)]}"  # noqa: E731
    monkeypatch.setattr(html_page, "page", shown)
    found = html_page.pages([case, other, louder], ["a.toml", "b.toml", "c.toml"])
    assert found == {"page.html": "a.toml: ['rig', 'louder']", "page-2.html": "b.toml: ['other']"}
