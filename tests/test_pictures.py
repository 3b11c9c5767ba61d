"""Pictures: units, enlarged parts and ranges of time against closed forms, and special cases.

Warnings are errors here, so each picture is written without a warning.
"""

import json
import pathlib
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from texts import refusal

from ambjax.__main__ import main
from ambjax.ensemble.maps import Axis, Map
from ambjax.pictures import ensembles, figures, heatmaps
from ambjax.pictures.ensembles import tornado
from ambjax.pictures.overview import overview_figure
from ambjax.pictures.scales import AXIS_UNITS, LABELS, axis_of, label_of, prefix_of, save
from ambjax.simulation import response
from ambjax.simulation.metrics import UNITS, Metrics
from ambjax.simulation.trajectory import ALIVE, STALLED, TOUCHED, Row, Trajectory

PERCENTS = (0, 5, 25, 50, 75, 95, 100)


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    """The saved figures, which the tests can still inspect. Each file has a low resolution to save time."""
    kept, savefig = [], Figure.savefig

    def keep(self, path, **options):
        kept.append(self)
        savefig(self, path, **options | {"dpi": 40})

    monkeypatch.setattr(Figure, "savefig", keep)
    return kept


# ---------------------------------------------------------------- scales


@pytest.mark.parametrize(
    ("unit", "size", "expected"),
    [
        ("m", 2.3e-5, (1e6, "µm")),
        ("m", 1e-3, (1e3, "mm")),
        ("m", 2000.0, (1, "m")),  # no km on a bearing
        ("m/s", 3e-4, (1e6, "µm/s")),
        ("V", 1500.0, (1e-3, "kV")),
        ("A²/m²", 1e6, (1, "A²/m²")),  # a prefix would be squared with its unit
        ("1/s", 1e4, (1, "1/s")),
        ("m", 0.0, (1, "m")),
        ("m", np.inf, (1, "m")),
        ("s", 1e-14, (1e9, "ns")),
    ],
)
def test_the_prefix_of_a_unit(unit, size, expected):
    factor, words = prefix_of(unit, size)
    assert words == expected[1]
    assert factor == pytest.approx(expected[0], rel=1e-15)  # one rounding of a reciprocal


def test_every_metric_has_its_unit():
    names = [*Metrics()._folds().folds, *response.UNITS, "force_used", "lost_at_s", "singular_at_s"]
    assert set(names) == set(LABELS)
    assert set(UNITS) | set(AXIS_UNITS) == {*names, "settle_s"}
    for name, unit in UNITS.items():  # the name of a metric ends in its unit
        assert name.endswith("_" + unit.replace("/", "_per_").replace("^", "")), name
    for name in names:
        _, words, unit = axis_of(name, 1.0)
        assert unit, name
        assert "_" not in re.sub(r"\$[^$]*\$", "", words), name
    assert axis_of("settled_max_abs_sigma_m_per_s", 2e-3)[1:] == (r"settled max |$\sigma$|", "mm/s")
    assert axis_of("clearance_used", 0.5) == (100.0, "clearance used", "%")
    assert set(ensembles.CHIEF) <= set(names)


@pytest.mark.parametrize(
    ("unit", "size", "factor", "shown"),
    [
        ("m", 2e-5, 1e6, "x (µm)"),
        ("", 2e-5, 1.0, "x"),
        ("m^2", 2e-5, 1.0, "x (m²)"),
        ("m/s^2", 0.1, 1e3, "x (mm/s²)"),
        ("ohm", 17.0, 1.0, "x (Ω)"),
        ("1", 900.0, 1.0, "x"),
    ],
)
def test_labels_have_units_with_prefixes(unit, size, factor, shown):
    assert label_of("x", unit, size) == (pytest.approx(factor), shown)


# ---------------------------------------------------------------- special cases


@pytest.mark.parametrize("lost_at", [np.array([np.inf]), np.zeros(3)])
@pytest.mark.parametrize("values", [np.zeros(9), np.full(9, -2.0), np.full(9, np.nan), np.r_[1.0, 2.0, [np.nan] * 7]])
def test_fan_charts_of_special_cases(tmp_path, values, lost_at):
    # one member: all bands alike; NaN: no member left
    bands = {"u": dict.fromkeys(PERCENTS, values)}
    save(ensembles.fan(np.linspace(0, 1, 9), bands, {"u": 2.0}, "hard", lost_at, lost_at == 1), tmp_path / "fan.png")


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(5),
        np.full(5, 2e-6),
        np.full(5, np.nan),
        np.array([np.nan, np.inf, 1e-6, 2e-6, 3e-6]),
        np.array([0.0, 1e-9, 1e-3, 1.0, 1e200]),
        np.array([-1.0, 0.0, 1e-3, 1.0, 100.0]),
        np.array([1.0, 1.0, 1.0, 1.0, 1.0 + 2**-52]),
        np.ones(1),
    ],
)
@pytest.mark.parametrize("all_lost", [False, True])
def test_histograms_of_special_cases(tmp_path, drawn, values, all_lost):
    columns = {"lost_at": np.full(len(values), 0.1 if all_lost else np.inf), "rms_error_m": values}
    save(ensembles.histogram_figure(columns), tmp_path / "h.png")
    shown = drawn[0].axes[0].patches[-1].get_data().values.sum()
    in_range = np.isfinite(values) & ((values > 0) | (drawn[0].axes[0].get_xscale() == "linear"))
    assert shown == in_range.sum()  # no value falls out of the last bin


def test_tornado_charts_of_special_cases(tmp_path, drawn):
    keys = ("path", "share", "low", "high", "rho")
    nothing, alone = (dict(zip(keys, row, strict=True)) for row in (("m", 0.0, 0.0, 1.0, 0.0), ("m", *[1.0] * 3, -1.0)))
    save(tornado([nothing], "rms_u_V", "nothing explains it"), tmp_path / "a.png")
    save(tornado([alone], "lost_at_s", "all"), tmp_path / "b.png")
    assert any("falls with it" in words.get_text() for words in drawn[1].findobj(Text))


def a_map(survival, error):
    ny, nx = survival.shape
    x = Axis("x", np.geomspace(1e-6, 1e-3, nx), True)
    y = Axis("y", np.geomspace(1e-5, 1e-3, ny))
    low, high = np.clip(survival - 0.02, 0, 1), np.clip(survival + 0.02, 0, 1)
    return Map(x, y, survival, low, high, error, *[0 * survival] * 2, np.nan_to_num(0 * survival), members=100)


ALL = np.ones((3, 4))


@pytest.mark.parametrize(
    ("survival", "error"),
    [
        (ALL, 2e-6 * ALL),
        (0 * ALL, np.nan * ALL),
        (0.95 * ALL, 0 * ALL),
        (np.eye(2), np.array([[1e-9, 1e3], [1.0, np.nan]])),
    ],
)
def test_maps_of_special_cases(tmp_path, survival, error):
    found = [a_map(survival, error), a_map(0.5 * survival, error)._replace(members=1)]
    save(heatmaps.map_figure(found, ["decisive", "one member"], ["m", "s"]), tmp_path / "m.png")


# ---------------------------------------------------------------- runs


def a_run(samples=20_000, period=1e-4, lost_at=np.inf, code=ALIVE, **signals):
    """Return a run whose errors decay with 1 ms while all else is at rest; `signals` replace some."""
    t = period * np.arange(samples)
    rows = {name: np.zeros(samples) for name in Row._fields if name != "z_measured"}
    rows |= {"t": t, "alive": t < lost_at, "z": 1e-4 * np.exp(-t / 1e-3), "v_tilde": np.exp(-t / 1e-3)} | signals
    return Trajectory(Row(**({"z_measured": rows["z"]} | rows)), lost_at, code, np.inf)


def columns(figure):
    """Axes [panels, columns] in the order of the page."""
    return np.reshape(figure.axes, (-1, 3))


def test_a_short_transient_is_enlarged(tmp_path, drawn):
    save(overview_figure(a_run(), "a run"), tmp_path / "o.png")
    whole, start, end = columns(drawn[0])[1]
    assert whole.get_xlim() == (0.0, pytest.approx(1.9999))
    # down to 2 % of the peak after 3.9 ms, thrice of which is seen
    assert start.get_xlim()[1] == pytest.approx(3 * 3.9e-3, rel=0.05)
    assert np.diff(end.get_xlim())[0] == pytest.approx(0.02, rel=1e-9)
    assert end.get_xlim()[1] == pytest.approx(1.9999)
    titles = [ax.get_title(loc="left") for ax in columns(drawn[0])[0]]
    assert titles == ["", "the first 12 ms", "the last 20 ms"]


@pytest.mark.parametrize(("code", "words"), [(TOUCHED, "lost at 0.01 s"), (STALLED, "not decided from 0.01 s")])
def test_a_loss_ends_the_picture_shortly_after_and_is_distinguished_from_a_stall(tmp_path, drawn, code, words):
    run = a_run(lost_at=0.01, code=code)
    save(overview_figure(run, "lost"), tmp_path / "o.png")
    whole, start, end = columns(drawn[0])[0]
    assert whole.get_title(loc="left").startswith(words)
    assert whole.get_xlim() == (0.0, pytest.approx(0.0115))
    assert start.get_xlim()[1] <= 0.01 / 3
    assert end.get_xlim() == (pytest.approx(0.008), pytest.approx(0.0103))
    save(figures.paper_figure(3, run, "regulation"), tmp_path / "f.png")
    assert [text.get_text().split("\n")[0] for ax in drawn[1].axes for text in ax.texts] == [words]


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "lost_at"), [(1, 0.0), (1, np.inf), (3, 1.5e-4)])
def test_runs_of_few_samples_are_drawn(tmp_path, samples, lost_at):
    save(overview_figure(a_run(samples=samples, lost_at=lost_at, code=TOUCHED), "tiny"), tmp_path / "o.png")


def test_the_panels_of_the_whole_run_have_the_scale_of_the_settled_part(tmp_path, drawn):
    t = 1e-4 * np.arange(20_000)
    z = 1e-4 * np.exp(-t / 1e-3) + 2e-7 * np.sin(300 * t)
    save(overview_figure(a_run(z=z), "lift-off", settle=0.1), tmp_path / "o.png")
    whole, start, _ = columns(drawn[0])[0]
    assert whole.get_title(loc="left") == "whole run (axis: values after 0.1 s)"
    assert whole.get_ylim() == (pytest.approx(-0.2 * 1.24, rel=1e-3), pytest.approx(0.2 * 1.24, rel=1e-3))  # um
    assert start.get_ylim()[1] > 99.0
    lost = a_run(z=z, lost_at=1.0, code=TOUCHED)
    save(overview_figure(lost, "lost", settle=0.1), tmp_path / "o.png")
    assert columns(drawn[1])[0, 0].get_ylim()[1] > 99.0


@pytest.fixture
def case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("case.toml").write_text("[clock]\nduration = 0.05\n")
    return "case.toml"


def test_the_command_draws_the_given_interval(case, drawn, capsys):
    assert main(["simulate", case, "--from", "0.01", "--to", "0.05", "--out", "a", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["max_abs_error_m"] > 0
    assert {ax.get_xlim() for ax in drawn[0].axes} == {(0.01, 0.05)}
    with np.load("a/trajectory.npz") as whole:
        assert len(whole["t"]) == 500


@pytest.mark.parametrize("flags", [["--from", "0.05"], ["--to", "0.051"], ["--from", "-1"], ["--from", "nan"]])
def test_an_interval_outside_the_run_is_refused(case, flags, capsys):
    assert "both must lie within 0 to 0.05 s (clock.duration)" in refusal(capsys, "simulate", case, *flags)
    assert not pathlib.Path("out").exists()
