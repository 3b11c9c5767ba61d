"""The overview of a run: its enlarged parts, kept extremes, and the visible mean of a chattering voltage."""

import json
import pathlib

import numpy as np
import pytest
from matplotlib.figure import Figure

from ambjax.__main__ import main
from ambjax.pictures import figures
from ambjax.pictures.figures import PIXELS
from ambjax.pictures.overview import TURNS, overview
from ambjax.simulation.trajectory import ALIVE, STALLED, TOUCHED, Row, Trajectory


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    """The saved figures, which the tests can still inspect."""
    pages, save = [], Figure.savefig

    def keep(self, path, **options):
        pages.append(self)
        save(self, path, **options | {"dpi": 30})

    monkeypatch.setattr(Figure, "savefig", keep)
    return pages


def a_run(samples=20_000, period=1e-4, lost_at=np.inf, code=ALIVE, **signals):
    """Return a run whose errors decay with 1 ms while all else is at rest; `signals` replace some."""
    t = period * np.arange(samples)
    rows = {name: np.zeros(samples) for name in Row._fields if name != "z_measured"}
    rows |= {"t": t, "alive": t < lost_at, "z": 1e-4 * np.exp(-t / 1e-3), "v_tilde": np.exp(-t / 1e-3)} | signals
    return Trajectory(Row(**({"z_measured": rows["z"]} | rows)), lost_at, code, np.inf)


def columns(figure):
    """Axes [panels, columns] in the order of the page."""
    axes = np.array(figure.axes, dtype=object)
    return axes.reshape(-1, 3)


def test_a_short_transient_is_enlarged(tmp_path, drawn):
    overview(a_run(), "a run", tmp_path / "o.png")
    whole, start, end = columns(drawn[0])[1]
    assert whole.get_xlim() == (0.0, pytest.approx(1.9999))
    # down to 2 % of the peak after 3.9 ms, thrice of which is seen
    assert start.get_xlim()[1] == pytest.approx(3 * 3.9e-3, rel=0.05)
    assert np.diff(end.get_xlim())[0] == pytest.approx(0.02, rel=1e-9)
    assert end.get_xlim()[1] == pytest.approx(1.9999)
    titles = [ax.get_title(loc="left") for ax in columns(drawn[0])[0]]
    assert titles == ["", "the first 12 ms", "the last 20 ms"]


def test_no_label_is_cut(tmp_path, drawn):
    t = 1e-4 * np.arange(20_000)
    overview(a_run(sigma=3e-3 * np.sin(100 * t)), "wide tick labels", tmp_path / "o.png", settle=0.1)
    assert any("0.002" in label.get_text() for label in columns(drawn[0])[2, 0].get_yticklabels())
    assert drawn[0].get_tightbbox().x0 >= 0


def test_chatter_is_drawn_as_a_band_with_its_mean_in_the_whole_run_and_as_a_line_at_the_end(tmp_path, drawn):
    t = 1e-4 * np.arange(20_000)
    u = 200.0 * (-1) ** np.arange(20_000) + 10 * np.sin(2 * np.pi * t)
    u[12_345] = 260.0
    overview(a_run(u=u, u_mean=u), "chatter", tmp_path / "o.png")
    whole, _, end = columns(drawn[0])[-1]
    (band,) = whole.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.max() == 260.0
    assert heights.min() == u.min()
    (line,) = whole.lines
    assert len(line.get_xdata()) == PIXELS + 2  # and both ends
    # 40 samples a column: their mean is the slow part's, and 260 V for -200 V once in a column is 11.5 V
    np.testing.assert_allclose(line.get_ydata(), 10 * np.sin(2 * np.pi * line.get_xdata()), atol=11.6)
    assert not end.collections
    assert np.diff(end.get_xlim())[0] == pytest.approx(TURNS * 1e-4, rel=0.06)  # a turn a sample; two at the border


@pytest.mark.parametrize(
    ("code", "words"), [(TOUCHED, "lost at 0.01 s: touched"), (STALLED, "not decided from 0.01 s")]
)
def test_a_loss_ends_the_picture_shortly_after(tmp_path, drawn, code, words):
    overview(a_run(lost_at=0.01, code=code), "lost", tmp_path / "o.png")
    whole, start, end = columns(drawn[0])[0]
    assert whole.get_title(loc="left").startswith(words)
    assert whole.get_xlim() == (0.0, pytest.approx(0.0115))
    assert start.get_xlim()[1] <= 0.01 / 3
    assert end.get_xlim() == (pytest.approx(0.008), pytest.approx(0.0103))


@pytest.mark.parametrize(("code", "words"), [(TOUCHED, "lost at 0.01 s"), (STALLED, "not decided from 0.01 s")])
def test_a_figure_of_the_paper_distinguishes_a_loss_from_a_stall(tmp_path, drawn, code, words):
    figures.paper_figure(3, a_run(lost_at=0.01, code=code), "regulation", tmp_path / "f.png")
    said = [text.get_text().split("\n")[0] for ax in drawn[0].axes for text in ax.texts]
    assert said == [words]


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "lost_at"), [(1, 0.0), (1, np.inf), (2, 1e-4), (3, 1.5e-4), (30, np.inf)])
def test_runs_of_few_samples_are_drawn(tmp_path, samples, lost_at):
    overview(a_run(samples=samples, lost_at=lost_at, code=TOUCHED), "tiny", tmp_path / "o.png")
    assert (tmp_path / "o.png").stat().st_size > 1000


def test_the_panels_of_the_whole_run_have_the_scale_of_the_settled_part(tmp_path, drawn):
    t = 1e-4 * np.arange(20_000)
    z = 1e-4 * np.exp(-t / 1e-3) + 2e-7 * np.sin(300 * t)
    overview(a_run(z=z), "lift-off", tmp_path / "o.png", settle=0.1)
    whole, start, _ = columns(drawn[0])[0]
    assert whole.get_title(loc="left") == "whole run (axis: values after 0.1 s)"
    assert whole.get_ylim() == (pytest.approx(-0.2 * 1.24, rel=1e-3), pytest.approx(0.2 * 1.24, rel=1e-3))  # um
    assert start.get_ylim()[1] > 99.0
    lost = a_run(z=z, lost_at=1.0, code=TOUCHED)
    overview(lost, "lost", tmp_path / "o.png", settle=0.1)
    assert columns(drawn[1])[0, 0].get_ylim()[1] > 99.0


CASE = "[clock]\nduration = 0.05\n"


@pytest.fixture
def case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("case.toml").write_text(CASE)
    return "case.toml"


def test_the_command_draws_the_given_interval(case, drawn, capsys):
    assert main(["simulate", case, "--from", "0.01", "--to", "0.05", "--out", "a", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["max_abs_error_m"] > 0
    assert {ax.get_xlim() for ax in drawn[0].axes} == {(0.01, 0.05)}
    with np.load("a/trajectory.npz") as whole:
        assert len(whole["t"]) == 500


@pytest.mark.parametrize(
    "flags", [["--from", "0.05"], ["--to", "0.051"], ["--from", "-1"], ["--from", "nan"], ["--to", "0"]]
)
def test_an_interval_outside_the_run_is_refused(case, flags, capsys):
    assert main(["simulate", case, *flags]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "both must lie within 0 to 0.05 s (clock.duration)" in error
    assert not pathlib.Path("out").exists()
