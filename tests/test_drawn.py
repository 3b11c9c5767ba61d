"""Every picture against its data: the lines, bands, bars and cells of the figures, not their pixels.

No figure is rendered here. Factors from SI are read from the unit that an axis is labelled with.
"""

import dataclasses
import math
import re
import types

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyQuadMesh, QuadMesh

import tuning.report.pictures as tuned
from ambjax.ensemble.maps import PERIOD, Axis, Map
from ambjax.pictures import ensembles, figures, heatmaps
from ambjax.pictures.ensembles import tornado
from ambjax.pictures.figures import BINS, thin
from ambjax.pictures.overview import overview_figure
from ambjax.results import case_map
from ambjax.simulation.trajectory import ALIVE, TOUCHED, Row, Trajectory

PREFIX = {"": 1.0, "m": 1e3, "µ": 1e6, "n": 1e9, "k": 1e-3, "M": 1e-6}
# A product with a factor and a sum in another order: a few roundings.
ROUNDING = 1e-12


def factor_of(label):
    """Return the factor from SI to the unit in brackets at the end of an axis label."""
    unit = re.search(r"\(([^()]*)\)\s*$", label)[1]
    plain = re.fullmatch(r"([mµnkM]?)(m|s|V|A)(/s|/s²)?", unit)
    return PREFIX[plain[1]] if plain else {"%": 100.0}.get(unit, 1.0)


def a_signal(n, seed):
    """A slow wave, noise, and a spike of one sample in each of the first, a middle and the last two samples."""
    rng = np.random.default_rng(seed)
    y = np.sin(np.linspace(0, 9, n) + seed) + 0.1 * rng.normal(size=n)
    y[[0, n // 2, n - 2]] += rng.uniform(3, 9, 3) * [-1, 1, -1]
    return y


def a_run(n, lost_at=np.inf, period=1e-4):
    """Return a run in which all signals differ. After the loss, each signal is frozen at a distant value."""
    t = period * np.arange(n)
    size = {"z": 1e-3, "r": 1e-3, "z_measured": 1e-3, "u_mean": 100.0}
    rows = {name: size.get(name, 1.0) * a_signal(n, k) for k, name in enumerate(Row._fields)}
    alive = t < lost_at
    rows = {name: np.where(alive, y, 1e6) for name, y in rows.items()} | {"t": t, "alive": alive}
    return Trajectory(Row(**rows), lost_at, ALIVE if np.isinf(lost_at) else TOUCHED, np.inf)


def box(collection):
    """Vertices (x, y) of a filled band."""
    return np.concatenate([path.vertices for path in collection.get_paths()])


@pytest.mark.parametrize("n", [1, 2, 4 * BINS, 4 * BINS + 1, 20_001, 100_003])
def test_a_thinned_curve_keeps_its_ends_and_the_extremes_of_every_bin(n):
    t, y = 1e-4 * np.arange(n), np.random.default_rng(n).normal(size=n)
    x, v = thin(t, y)
    at = np.searchsorted(t, x)
    np.testing.assert_array_equal(t[at], x)
    np.testing.assert_array_equal(y[at], v)
    assert np.all(np.diff(at) > 0)
    assert (at[0], at[-1]) == (0, n - 1)
    assert len(x) <= max(4 * BINS, 2 * BINS + 2)
    if n > 4 * BINS:
        width = -(-n // BINS)  # no bin is wider: BINS of them cover the run
        edges = np.arange(0, n, width)
        for extreme in (np.minimum, np.maximum):
            np.testing.assert_array_equal(extreme.reduceat(v, np.searchsorted(at, edges)), extreme.reduceat(y, edges))


def check_curve(line, t, y, factor, span):
    """Check a line against y(t) within `span`: its ends, its extremes, and that each of its points is in the data."""
    x, v = line.get_data()
    inside = (t >= span[0]) & (t <= span[1])
    assert (x[0], x[-1]) == (t[inside][0], t[inside][-1])
    at = np.searchsorted(t, x)
    np.testing.assert_array_equal(t[at], x)
    np.testing.assert_allclose(v, factor * y[at], rtol=ROUNDING)
    np.testing.assert_allclose([v.min(), v.max()], factor * np.array([y[inside].min(), y[inside].max()]), rtol=ROUNDING)


@pytest.mark.parametrize("number", figures.PAPER_FIGURES)
@pytest.mark.parametrize(("n", "lost_at"), [(20_001, np.inf), (500, np.inf), (20_001, 0.95991)])
def test_a_figure_of_the_paper_shows_the_signals_of_its_run(number, n, lost_at):
    run = a_run(n, lost_at)
    figure = figures.paper_figure(number, run, "")
    t = np.asarray(run.rows.t)
    for ax, panel in zip(figure.axes, figures.PAPER_FIGURES[number][1], strict=True):
        assert factor_of(ax.get_ylabel()) == panel.factor
        for line, curve in zip(ax.lines, panel.curves, strict=False):
            check_curve(line, t, figures.signal_of(run.rows, curve.signal), panel.factor, (0, min(lost_at, t[-1])))
        assert ax.get_xlim()[1] == (t[-1] if np.isinf(lost_at) else min(1.6 * lost_at, t[-1]))
        for inset in ax.child_axes:
            (line,) = inset.lines
            np.testing.assert_allclose(line.get_xdata(), 1e3 * t[:101], rtol=ROUNDING)  # the first 10 ms
            np.testing.assert_array_equal(line.get_ydata(), run.rows.v_tilde[:101])


def test_the_picture_of_the_readings_shows_their_runs():
    runs = {"one": a_run(9600), "other": a_run(20_001, 0.03335)}
    figure = figures.readings(runs, "", 0.5)
    axes = np.reshape(figure.axes, (2, 2))
    for (name, run), (upper, lower) in zip(runs.items(), axes.T, strict=True):
        assert upper.get_title(loc="left") == name
        rows, span = run.rows, (0, min(run.lost_at, run.rows.t[-1]))
        for line, signal in zip(upper.lines, (rows.z_measured, rows.z, rows.r), strict=False):
            check_curve(line, rows.t, signal, 1e3, span)
        check_curve(lower.lines[0], rows.t, rows.e_z, 1e6, span)
    (late,) = [text.get_text() for text in axes[1, 0].texts]
    worst = 1e6 * np.abs(runs["one"].rows.e_z[5000:]).max()
    assert float(re.search(r"at most (\S+) µm after 0.5 s", late)[1]) == pytest.approx(worst, rel=0.05)  # two digits


@pytest.mark.parametrize(
    ("n", "window"), [(9600, None), (20_001, None), (1500, None), (20_001, (0.03, 0.1)), (1500, (0.03, 0.1))]
)
def test_an_overview_shows_the_signals_of_its_run(n, window):
    run = a_run(n)
    if n == 9600:  # a signal that is 0 has no panel
        run = dataclasses.replace(run, rows=run.rows._replace(q_i=np.zeros(n)))
    figure = overview_figure(run, "", window)
    known = *figures.MOTION, *figures.FORCES, figures.ERROR, figures.AVERAGED, figures.MEASUREMENT
    known = *known, figures.COILS, figures.MAGNETIC, figures.CURRENT_DISTURBANCE
    panels = {panel.ylabel: panel for panel in known}
    t, seen = np.asarray(run.rows.t), set()
    axes = np.reshape(figure.axes, (-1, 2 if window else 3))
    for row, column in np.ndindex(axes.shape):
        ax, label = axes[row, column], axes[row, column if window else 0].get_ylabel()
        if not ax.axison:  # beside the last panel of an odd number: the one above has the axis of time
            assert axes[row - 1, column].get_xlabel() == "time (s)"
            continue
        signals = panels[label.rpartition("\n")[0]]
        factor = factor_of(label)
        seen.update(curve.signal for curve in signals.curves)
        span = ax.get_xlim()
        inside = (t > span[0] - 1e-9) & (t < span[1] + 1e-9)
        for k, (line, curve) in enumerate(zip(ax.lines, signals.curves, strict=True)):
            y = factor * figures.signal_of(run.rows, curve.signal)
            x, v = line.get_data()
            assert x[0] <= span[0] + 1e-9
            assert x[-1] >= span[1] - 1e-9
            if inside.sum() <= 4 * figures.PIXELS:
                assert not ax.collections
                np.testing.assert_allclose(v, y[np.searchsorted(t, x)], rtol=ROUNDING)
                assert set(t[inside]) <= set(x)
            else:
                heights, values = box(ax.collections[k]), y[inside]
                assert (heights[:, 0].min(), heights[:, 0].max()) == (t[0], t[-1])
                found = heights[:, 1].min(), heights[:, 1].max()
                np.testing.assert_allclose(found, (values.min(), values.max()), rtol=ROUNDING)
                sizes = np.diff(np.linspace(0, len(t), figures.PIXELS + 1).astype(int))
                assert np.sum(v[1:-1] * sizes) == pytest.approx(values.sum(), abs=ROUNDING * np.abs(values).sum())
    names = {"z", "r", "e_z", "sigma", "q_z", "i", "i_ref", "i_1", "i_2", "force", "v_tilde", "u_mean", "z_measured"}
    assert seen == names | (set() if n == 9600 else {"q_i"})


def bands_of(n, seed=0):
    """Seven ascending quantiles of n instants."""
    at = np.linspace(0, 9, n)
    steps = 1e-6 * (1.5 + np.sin(np.random.default_rng(seed).uniform(1, 4, size=(7, 1)) * at))
    return dict(zip((0, 5, 25, 50, 75, 95, 100), steps.cumsum(0) + 1e-5 * np.sin(at), strict=True))


@pytest.mark.parametrize("n", [2, 500, 9601])
def test_a_fan_shows_the_quantiles_of_the_members(n):
    t, bands = np.linspace(0, 0.9, n), bands_of(n)
    figure = ensembles.fan(t, {"z - r": bands}, {}, "", np.array([np.inf]), np.array([False]))
    ax = figure.axes[0]
    factor = factor_of(ax.get_ylabel())
    for k, (low, high) in enumerate(((0, 100), (5, 95), (25, 75))):
        assert ax.collections[k].get_label() == f"{low} to {high} %"
        x, y = box(ax.collections[k]).T
        assert (x.min(), x.max()) == (t[0], t[-1])
        np.testing.assert_allclose(
            [y.min(), y.max()], factor * np.array([bands[low].min(), bands[high].max()]), ROUNDING
        )
        if n <= 4 * BINS:
            points = {*zip(x, y, strict=True)}
            assert {*zip(t, factor * bands[low], strict=True), *zip(t, factor * bands[high], strict=True)} <= points
    (line,) = ax.lines
    x, y = line.get_data()
    assert (x[0], x[-1]) == (t[0], t[-1])
    np.testing.assert_allclose(y, factor * bands[50][np.searchsorted(t, x)], rtol=ROUNDING)


@pytest.mark.parametrize("members", [7, 20_000])
def test_the_number_of_survivors_excludes_the_lost_members(members):
    t = np.linspace(0, 0.99, 100)
    lost_at = np.where(np.arange(members) % 2, np.inf, 0.999 * (1 + np.arange(members)) / members)
    lost_at[-1] = 0.9999  # between the last sample and the end of the run
    stalled = np.arange(members) == members - 1
    bands = {"u": {50: np.zeros(100)}}
    figure = ensembles.fan(t, bands, {}, "", lost_at=lost_at, stalled=stalled)
    ax = figure.axes[-1]
    step, rug = ax.lines
    x, share = step.get_data()
    assert step.get_drawstyle() == "steps-post"
    for n in (0, len(x) // 3, len(x) - 1):
        assert share[n] == pytest.approx(100 * np.mean(lost_at > x[n]), rel=ROUNDING) or x[n] == x[n + 1]
    lost = np.isfinite(lost_at)
    assert share[-1] == pytest.approx(100 * np.mean(~lost), rel=ROUNDING)
    assert (x[0], x[-1]) == ax.get_xlim() == (0.0, 0.9999)
    assert f"{members - lost.sum()} of {members} survive" in ax.get_title(loc="right")
    assert f"{lost.sum() - 1} lost, 1 not decided" in ax.get_title(loc="right")
    ticks = rug.get_xdata()
    assert set(ticks) <= set(lost_at)
    assert (ticks.min(), ticks.max()) == (lost_at.min(), 0.9999)
    assert members > 7 or set(ticks) == set(lost_at[lost])


@pytest.mark.parametrize("log", [False, True])
def test_a_histogram_counts_all_members(log):
    rng = np.random.default_rng(5)
    values = 1e-6 * (np.exp(3 * rng.normal(size=500)) if log else 1 + rng.uniform(size=500))
    lost = rng.uniform(size=500) < 0.3
    if log:
        values[7] = 0.0
    figure = ensembles.histogram_figure({"rms_error_m": values, "lost_at": np.where(lost, 0.1, np.inf)})
    ax = figure.axes[0]
    assert ax.get_xscale() == ("log" if log else "linear")
    alive, dead = (patch.get_data() for patch in ax.patches)
    shown = factor_of(ax.get_xlabel()) * values
    # bin by bin, both ends included; a zero has no place on a log axis, and is counted in the title
    of = np.clip(np.searchsorted(alive.edges, shown, side="right") - 1, 0, len(alive.edges) - 2)
    counted = (shown >= alive.edges[0]) & (shown <= alive.edges[-1])
    assert (~counted).sum() == log
    assert ("1 at zero" in ax.get_title()) == log
    for patch, baseline, members in ((alive, 0, ~lost), (dead, alive.values, lost)):
        np.testing.assert_array_equal(
            patch.values - baseline, np.bincount(of[counted & members], minlength=len(alive.edges) - 1)
        )
    assert ax.get_ylim()[1] >= dead.values.max()
    # the marks are the quantiles of the survivors, as in summary.json
    ranked = np.sort(shown[~lost])
    marked = [ranked[math.ceil(share * len(ranked)) - 1] for share in (0.5, 0.95)]
    np.testing.assert_allclose([line.get_xdata()[0] for line in ax.lines], marked, rtol=ROUNDING)


def test_a_tornado_shows_the_shares_and_their_intervals():
    shares = enumerate((0.2, 1.0, 0.05))
    bars = [{"path": f"plant.{k}", "share": x, "low": x / 2, "high": min(1.3 * x, 1), "rho": 0.0} for k, x in shares]
    figure = tornado(bars, "rms_u_V", "")
    (ax,) = figure.axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    for row, (name, patch, line) in enumerate(zip(names, ax.patches, ax.lines, strict=True)):
        one = bars[int(name[-1])]
        assert (patch.get_x(), patch.get_width()) == (0, 100 * one["share"])
        assert patch.get_y() + patch.get_height() / 2 == pytest.approx(row, abs=ROUNDING)
        assert ax.get_yticks()[row] == row
        np.testing.assert_array_equal(line.get_data(), ([100 * one["low"], 100 * one["high"]], [row, row]))
    assert names == ["plant.1", "plant.0", "plant.2"]
    assert ax.get_xlim()[0] <= 0
    assert ax.get_xlim()[1] >= 100


@pytest.mark.parametrize("path", ["initial.z", PERIOD])
def test_the_cells_of_a_map_lie_at_their_coordinates(path, monkeypatch):
    monkeypatch.setattr(case_map, "unit_of", lambda _, axis: "s" if axis.path == PERIOD else "m")
    x, y = Axis(path, np.geomspace(1e-5, 1e-3, 3), True), Axis("initial.z_dot", np.array([1.0, 2.0, 3.0, 4.0]))
    survival = np.arange(12.0).reshape(4, 3) / 11
    error = np.where(survival > 0, 1e-6 * (1 + np.arange(12.0).reshape(4, 3)), np.nan)
    one = Map(x, y, survival, survival - 0.05, survival + 0.05, error, 0 * error, 0 * survival, 0 * survival, 100)
    other = one._replace(survival=survival[::-1], low=survival[::-1] - 0.05, high=survival[::-1])
    case = types.SimpleNamespace(name="the case", cascade=None, scenario=None)
    figure = case_map.figure_of([case, case], [one, other])
    axes = figure.axes[:3]
    for ax, shown in zip(axes, (survival, survival[::-1], error), strict=True):
        (mesh,) = (c for c in ax.collections if isinstance(c, QuadMesh | PolyQuadMesh))
        wanted = 100 * shown if shown is not error else 1e6 * error
        np.testing.assert_array_equal(np.isfinite(shown), ~np.ma.getmaskarray(mesh.get_array()))
        np.testing.assert_allclose(np.ma.filled(mesh.get_array(), np.nan), wanted, rtol=ROUNDING)
        corners = mesh.get_coordinates()  # [5, 4, 2]
        factor = factor_of(ax.get_xlabel())
        inside = corners[:-1, :-1, 0], factor * x.values[None], corners[:-1, 1:, 0]
        assert np.all((inside[0] < inside[1]) & (inside[1] < inside[2]))
        along = corners[:-1, :-1, 1], factor_of(ax.get_ylabel()) * y.values[:, None], corners[1:, :-1, 1]
        assert np.all((along[0] < along[1]) & (along[1] < along[2]))
        assert ax.get_xscale() == "log"
        assert ax.get_xlim() == (corners[0, 0, 0], corners[0, -1, 0])
        assert ax.get_ylim() == (corners[0, 0, 1], corners[-1, 0, 1])
    bar = figure.axes[-1]
    assert "µm" in bar.get_ylabel()
    np.testing.assert_allclose(bar.get_ylim(), 1e6 * np.array([np.nanmin(error), np.nanmax(error)]), rtol=ROUNDING)


def test_the_outlines_of_a_map_follow_the_confidence_bounds():
    x, y = Axis("x", np.arange(4.0)), Axis("y", np.arange(3.0))
    survival, low, high = (np.tile(np.arange(4) >= k, (3, 1)).astype(float) for k in (2, 3, 1))
    one = Map(x, y, survival, low, high, *[0 * survival] * 4, members=100)
    figure = heatmaps.map_figure([one], [""], ["", ""])
    outlines = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    places = [{float(segment[0, 0]) for segment in one.get_segments()} for one in outlines]
    assert places == [{2.5}, {2.5}, {0.5}, {0.5}, {1.5}, {1.5}]  # each a line on its white seam


@pytest.mark.parametrize("n", [1000, 1001])
def test_the_spectrum_has_the_amplitudes_of_its_sines(n):
    t = 1e-4 * np.arange(n)
    lines = {10.0 * round(n / 100) / (n * 1e-3): 3.0, 100 / (n * 1e-4): 7.0}  # Hz, whole periods in the run: V
    u = sum(size * np.sin(2 * np.pi * f * t) for f, size in lines.items())
    if n % 2 == 0:
        lines[5000.0] = 200.0
        u = u + 200.0 * (-1.0) ** np.arange(n)
    run = a_run(n)
    run = dataclasses.replace(run, rows=run.rows._replace(u_mean=u))
    (line,) = tuned.spectrum({"after": run}, 0.0).axes[0].lines
    frequency, amplitude = line.get_data()
    for f, size in lines.items():
        # the window is not quite periodic over its samples: one part in their number
        assert amplitude[np.argmin(np.abs(frequency - f))] == pytest.approx(size, rel=2 / n)
    assert frequency[-1] == pytest.approx(5000 if n % 2 == 0 else 5000 * (1 - 1 / n), rel=ROUNDING)


def test_the_picture_of_the_convergence_shows_the_history_of_the_search():
    rng = np.random.default_rng(2)
    value = np.minimum.accumulate(rng.normal(size=9))
    gains = np.exp(rng.normal(size=(9, 2)))
    members = np.array([8] * 4 + [32] * 5)
    paths = ["controller.position.c", "controller.position.k"]
    left, right = tuned.convergence({"value": value, "gains": gains, "members": members}, paths).axes
    steps = np.arange(1, 10)
    np.testing.assert_array_equal(left.lines[0].get_data(), (steps, np.exp(value)))
    for j, line in enumerate(right.lines[:2]):
        assert line.get_label() == paths[j].removeprefix("controller.")
        np.testing.assert_allclose(line.get_ydata(), gains[:, j] / gains[8, j], rtol=ROUNDING)
    dotted = [line.get_xdata()[0] for ax in (left, right) for line in ax.lines if line.get_linestyle() == ":"]
    assert dotted == [4.5, 4.5]


def test_points_of_the_front_that_lose_members_are_marked():
    rows = [
        {"settled_rms_error_m": e, "settled_rms_u_V": u, "lost": lost, "stalled": 0, "taken": e == 2e-7}
        for e, u, lost in ((3e-6, 20.0, 0), (1e-6, 30.0, 4), (2e-7, 90.0, 0))
    ]
    (ax,) = tuned.front(rows).axes
    line, crosses, taken = ax.lines
    np.testing.assert_allclose(line.get_data(), ([20, 30, 90], [3000, 1000, 200]), rtol=ROUNDING)
    np.testing.assert_allclose(crosses.get_data(), ([30], [1000]), rtol=ROUNDING)
    np.testing.assert_allclose(taken.get_data(), ([90], [200]), rtol=ROUNDING)
    assert ax.get_ylabel() == "settled rms error (nm)"
    assert len([at for at in ax.get_yticks() if 200 / 1.2 <= at <= 3600]) >= 3
    assert len(tuned.front(rows[:1]).axes[0].lines) == 1
