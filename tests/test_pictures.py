"""Pictures of ensembles: numbers, units and edges against closed forms, and special cases.

Warnings are errors here, so each picture is written without a warning.
"""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from ambjax.pictures import fans, heatmaps, histograms
from ambjax.pictures.scales import AXIS_UNITS, LABELS, axis_of, edges, label_of, prefix_of
from ambjax.pictures.tornado import Bar, tornado
from ambjax.simulation import orders
from ambjax.simulation.metrics import UNITS, Metrics

PERCENTS = (0, 5, 25, 50, 75, 95, 100)


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    """The saved figures, which the tests can still inspect.

    Each file is also written, with a low resolution to save time.
    """
    figures, save = [], Figure.savefig

    def keep(self, path, **options):
        figures.append(self)
        save(self, path, **options | {"dpi": 40})

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def is_png(path):
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def texts(figure):
    """Every word of a figure, its legends included."""
    return " | ".join(words.get_text() for words in figure.findobj(Text))


# ---------------------------------------------------------------- scales


@pytest.mark.parametrize(
    ("unit", "size", "expected"),
    [
        ("m", 2.3e-5, (1e6, "µm")),
        ("m", 4.5e-3, (1e3, "mm")),
        ("m", 1e-3, (1e3, "mm")),
        ("m", 2000.0, (1, "m")),  # no km on a bearing
        ("m/s", 3e-4, (1e6, "µm/s")),
        ("V", 1500.0, (1e-3, "kV")),
        ("V", 200.0, (1, "V")),
        ("A²/m²", 1e6, (1, "A²/m²")),  # a prefix would be squared with its unit
        ("kg", 1e-3, (1, "kg")),
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
    names = [*Metrics()._folds().folds, *orders.UNITS, "force_used", "lost_at_s", "singular_at_s"]
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
    assert set(histograms.CHIEF) <= set(names)


def test_labels_keep_text_that_is_not_a_unit():
    assert label_of("noise std on $z$ (m)", 2e-5) == (pytest.approx(1e6), "noise std on $z$ (µm)")
    assert label_of("share", 2e-5) == (1.0, "share")
    assert label_of("mass (kg)", 2e-5) == (1.0, "mass (kg)")
    assert label_of("plant.A (m^2)", 2e-5) == (1.0, "plant.A (m²)")
    assert label_of("amplitude (m/s^2)", 0.1) == (1e3, "amplitude (mm/s²)")
    assert label_of("plant.R (ohm)", 17.0) == (1.0, "plant.R (Ω)")
    assert label_of("plant.n (1)", 900.0) == (1.0, "plant.n")


@pytest.mark.parametrize("log", [False, True])
def test_the_bounds_of_cells_enclose_each_centre(log):
    for centres in (np.geomspace(1e-6, 1e-2, 7), np.array([1.0, 2.0, 8.0]), np.array([3.0])):
        bounds = edges(centres, log)
        assert len(bounds) == len(centres) + 1
        assert np.all((bounds[:-1] < centres) & (centres < bounds[1:]))
    even = edges(np.geomspace(1e-6, 1e-2, 5), log=True)
    np.testing.assert_allclose(even[1:] / even[:-1], 10.0, rtol=1e-12)  # rounding of logarithms


# ---------------------------------------------------------------- fan


def quantiles(members):
    return {percent: np.percentile(members, percent, axis=0) for percent in PERCENTS}


def members_of(n, t, seed=0):
    noise = np.random.default_rng(seed).normal(size=(n, len(t)))
    return 2e-5 * np.sin(4 * np.pi * t) + 1e-6 * noise


def test_fan_shows_bands_units_limit_and_survivors(tmp_path, drawn):
    t = np.linspace(0, 1, 201)
    members = members_of(50, t)
    lost_at = np.full(50, np.inf)
    lost_at[:4] = [0.1, 0.2, 0.3, 0.4]
    bands = {"z - r": quantiles(members), "u": quantiles(6e6 * members), "sigma": quantiles(members)}
    limits, stalled = {"u": 150.0, "z - r": 4.5e-3}, np.arange(50) == 2
    fans.fan(t, bands, limits, "a title", tmp_path / "fan.png", lost_at=lost_at, stalled=stalled)
    assert is_png(tmp_path / "fan.png")
    (figure,) = drawn
    words = texts(figure)
    assert "(µm)" in words
    assert "(V)" in words
    assert "(µm/s)" in words
    assert "46 of 50 survive (92 %), 3 lost, 1 not decided" in words
    assert "0 to 100 %" in words
    assert "median" in words
    error, voltage, _, survivors = figure.axes
    # 150 V is near the data's 120 V; the clearance is nowhere near 20 µm
    assert sorted(line.get_ydata()[0] for line in voltage.lines if line.get_linestyle() == "--") == [-150, 150]
    assert not [line for line in error.lines if line.get_linestyle() == "--"]
    step, rug = survivors.lines
    assert step.get_ydata()[0] == 100
    assert step.get_ydata()[-1] == pytest.approx(92.0)
    np.testing.assert_array_equal(rug.get_xdata(), [0.1, 0.2, 0.3, 0.4])


def test_fan_does_not_let_one_member_hide_the_rest(tmp_path, drawn):
    t = np.linspace(0, 1, 101)
    bands = quantiles(members_of(100, t))
    bands[100] = np.full(len(t), 4.5e-3)
    fans.fan(t, {"z - r": bands}, {}, "one went astray", tmp_path / "fan.png")
    ax = drawn[0].axes[0]
    assert ax.get_ylim()[1] < 60  # µm: the others reach 24
    assert "band reaches 4500 µm, beyond this axis" in texts(drawn[0])


def test_fan_does_not_let_a_brief_transient_hide_the_rest(tmp_path, drawn):
    t = np.linspace(0, 1, 1001)
    members = members_of(100, t) + 4e-3 * (t < 0.02)
    fans.fan(t, {"z - r": quantiles(members)}, {"z - r": 4.5e-3}, "it came down", tmp_path / "fan.png")
    ax = drawn[0].axes[0]
    assert ax.get_ylim()[1] < 60  # µm: settled, they reach 24
    assert "beyond this axis" in texts(drawn[0])


@pytest.mark.parametrize("lost_at", [None, np.array([np.inf]), np.zeros(3)])
@pytest.mark.parametrize("values", [np.zeros(9), np.full(9, -2.0), np.full(9, np.nan), np.r_[1.0, 2.0, [np.nan] * 7]])
def test_fan_charts_of_special_cases(tmp_path, values, lost_at):
    # one member: all bands alike; NaN: no member left
    bands = {"u": dict.fromkeys(PERCENTS, values)}
    fans.fan(np.linspace(0, 1, 9), bands, {"u": 2.0}, "hard", tmp_path / "fan.png", lost_at=lost_at)
    assert is_png(tmp_path / "fan.png")


# ---------------------------------------------------------------- histograms


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(5),
        np.full(5, 2e-6),
        np.full(5, np.nan),
        np.full(5, np.inf),
        np.array([np.nan, np.inf, 1e-6, 2e-6, 3e-6]),
        np.array([0.0, 1e-9, 1e-3, 1.0, 1e200]),
        np.array([0.0, 0.0, 0.0, 1e-9, 1e-3]),
        np.array([-1.0, 0.0, 1e-3, 1.0, 100.0]),
        np.array([1.0, 1.0, 1.0, 1.0, 1.0 + 2**-52]),
        np.ones(1),
        np.full(1, np.nan),
    ],
)
@pytest.mark.parametrize("all_lost", [False, True])
def test_histograms_of_special_cases(tmp_path, drawn, values, all_lost):
    columns = {"lost_at": np.full(len(values), 0.1 if all_lost else np.inf), "rms_error_m": values}
    histograms.histograms(columns, tmp_path / "h.png")
    assert is_png(tmp_path / "h.png")
    shown = drawn[0].axes[0].patches[-1].get_data().values.sum()
    in_range = np.isfinite(values) & ((values > 0) | (drawn[0].axes[0].get_xscale() == "linear"))
    assert shown == in_range.sum()  # no value falls out of the last bin


# ---------------------------------------------------------------- tornado


def test_tornado_charts_of_special_cases(tmp_path, drawn):
    tornado([Bar("plant.m", 0.0, 0.0, 1.0, 0.0)], "rms_u_V", "nothing explains it", tmp_path / "a.png")
    tornado([Bar("plant.m", 1.0, 1.0, 1.0, -1.0)], "lost_at_s", "all", tmp_path / "b.png")
    assert "falls with it" in texts(drawn[1])
    with pytest.raises(ValueError, match="no drivers"):
        tornado([], "rms_u_V", "", tmp_path / "c.png")


# ---------------------------------------------------------------- maps


def a_panel(survival, error=None, x=None, y=None):
    survival = np.asarray(survival, float)
    ny, nx = survival.shape
    x = np.geomspace(1e-6, 1e-3, nx) if x is None else x
    y = np.geomspace(1e-5, 1e-3, ny) if y is None else y
    low, high = np.clip(survival - 0.02, 0, 1), np.clip(survival + 0.02, 0, 1)
    return heatmaps.MapPanel("repaired", x, y, survival, low, high, error)


ALL = np.ones((3, 4))


@pytest.mark.parametrize(
    ("survival", "error"),
    [
        (ALL, None),
        (ALL, 2e-6 * ALL),
        (0 * ALL, np.nan * ALL),
        (0.95 * ALL, 0 * ALL),
        (np.nan * ALL, np.inf * ALL),
        (np.where(np.eye(3, 4), np.nan, 0.97), None),
        (np.ones((1, 1)), np.ones((1, 1))),
        (np.array([[0.0, 0.5, 1.0]]), np.array([[np.nan, 1e-3, 1e-6]])),
        (np.array([[0.0], [1.0]]), np.array([[np.nan], [1e-6]])),
        (np.eye(2), np.array([[1e-9, 1e3], [1.0, np.nan]])),
    ],
)
def test_maps_of_special_cases(tmp_path, survival, error):
    panels = [a_panel(survival, error), a_panel(0.5 * survival, None)]
    heatmaps.maps(panels, "std (m)", "period (s)", True, False, tmp_path / "m.png", error_metric="rms_error_m")
    assert is_png(tmp_path / "m.png")


def test_a_map_without_confidence_bounds_has_no_legend_for_them(tmp_path, drawn):
    heatmaps.maps([a_panel(ALL)], "x", "y", False, False, tmp_path / "with.png")
    heatmaps.maps([a_panel(ALL)._replace(low=None, high=None)], "x", "y", False, False, tmp_path / "without.png")
    assert ["confidence interval" in texts(figure) for figure in drawn] == [True, False]
    assert "all runs survive in" in texts(drawn[1])
    assert ["95 %" in texts(figure) for figure in drawn] == [True, False]


def test_maps_refuse_empty_panels_and_zeros_on_a_log_axis(tmp_path):
    with pytest.raises(ValueError, match="no panels"):
        heatmaps.maps([], "", "", False, False, tmp_path / "m.png")
    with pytest.raises(ValueError, match="log axis cannot show"):
        heatmaps.maps([a_panel(ALL, x=np.arange(4.0))], "x", "y", True, False, tmp_path / "m.png")
    assert not (tmp_path / "m.png").exists()
