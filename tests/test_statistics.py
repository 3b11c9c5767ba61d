"""Statistics against closed forms and independent implementations."""

import json

import numpy as np
import pytest
from scipy import stats

from ambjax.ensemble import cvar, quantile, summary, wilson
from ambjax.ensemble.intervals import bootstrap

RNG = np.random.default_rng(5)


# --- Wilson ---


@pytest.mark.parametrize("n", [1, 7, 50, 1000])
def test_wilson_solves_its_own_equation(n):
    # Wilson's limits are the p at which |share - p| = z sqrt(p (1-p)/n)
    k = np.unique(np.linspace(0, n, 9).round())
    share, low, high = wilson(k, n)
    for p in (low, high):
        np.testing.assert_allclose((share - p) ** 2, 1.959963984540054**2 * p * (1 - p) / n, rtol=1e-9, atol=1e-15)
    assert np.all((low >= 0) & (low <= share) & (share <= high) & (high <= 1))
    assert low[0] == 0
    assert high[-1] == 1


@pytest.mark.parametrize(("k", "n"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_bad_arguments(k, n):
    with pytest.raises(ValueError, match="successes"):
        wilson(k, n)


# --- quantiles ---


@pytest.mark.parametrize("n", [1, 2, 30, 1001])
def test_a_quantile_is_the_value_of_its_rank(n):
    x, q = RNG.normal(size=n), np.array([0.05, 0.1, 0.5, 0.9, 0.95, 1.0])
    np.testing.assert_array_equal(quantile(x, q).value, np.quantile(x, q, method="inverted_cdf"))


def test_the_interval_of_a_quantile_follows_from_the_binomial_distribution():
    # the largest rank that is above the true quantile with at most 2.5 %, and the smallest below it
    for n, q in ((200, 0.95), (200, 0.5), (30, 0.05), (1001, 0.95)):
        x = np.arange(1.0, n + 1)  # a value is its rank
        _, low, high = quantile(x, q)
        above = stats.binom(n, q).cdf  # so many values or fewer lie below the true one
        if np.isfinite(low):
            assert above(low - 1) <= 0.025
        assert above(0 if np.isinf(low) else low) > 0.025
        if np.isfinite(high):
            assert 1 - above(high - 1) <= 0.025
        assert 1 - above(n - 1 if np.isinf(high) else high - 2) > 0.025


def test_the_interval_of_a_quantile_is_infinite_if_the_ensemble_is_too_small():
    # all 72 lie below the 95 % quantile with 0.95^72 = 2.49 %, all 71 with 2.62 %
    assert quantile(np.arange(71.0), 0.95).high == np.inf
    assert quantile(np.arange(72.0), 0.95).high == 71
    assert quantile(np.array([3.0]), 0.5) == (3.0, -np.inf, np.inf)


# --- mean, standard deviation, CVaR ---


def test_the_cvar_of_a_normal_distribution():
    # E[X | X > q] = phi(z)/(1 - alpha) = 2.0627 at 95 %
    exact = stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05
    found = cvar(RNG.normal(size=200_000), 0.95, seed=1)
    # its variance is (Var[X | X > q] + 0.95 (cvar - q)^2)/(0.05 N) = 0.304/1e4: standard error 5.5e-3, five of them
    assert abs(found.value - exact) < 0.028
    assert abs((found.high - found.low) / (2 * 1.96 * 5.5e-3) - 1) < 0.15  # 1,000 resamples know it to 5 %


def test_one_value_in_the_tail_gives_no_interval_also_if_its_number_is_rounded():
    for n in (15, 19, 20, 21, 40):
        found = cvar(RNG.normal(size=n), 0.95)
        assert (found.low == -np.inf) == (n <= 20)
        assert found.low <= found.value <= found.high


def test_the_mean_of_the_worst_values_is_not_below_most_values():
    """Studentised ends of skewed samples are far too low; the 95 % quantile is above the median of 60 values."""
    for _ in range(40):
        x = RNG.lognormal(sigma=1.5, size=60)
        found = cvar(x, 0.95)
        assert np.median(x) < found.low <= found.value


def test_the_bootstrap_agrees_with_explicit_resampling():
    # 400 exponentials; the oracle draws indices and has formulas of its own. Limits agree within the noise of
    # 1,000 resamples: 0.6 of a standard error (at 2.5 %, sqrt(0.025 0.975/1000) over the density there, 0.02 in the
    # long tail of t, is 0.25 of one, more than twice)
    n, x = 400, RNG.exponential(size=400)

    def measured(rows):
        tails = np.sort(rows, axis=1)[:, -20:]
        excess = np.zeros(rows.shape)
        excess[:, -20:] = tails - tails[:, :1]
        centred = rows - rows.mean(axis=1, keepdims=True)
        m2, m4 = (centred**2).mean(axis=1), (centred**4).mean(axis=1)
        return {
            "mean": (rows.mean(axis=1), np.sqrt(m2 / n)),
            "std": (np.log(np.sqrt(m2)), np.sqrt((m4 - m2**2) / n) / (2 * m2)),
            "cvar": (tails.mean(axis=1), excess.std(axis=1) / 0.05 / np.sqrt(n)),
        }

    picks, whole = measured(x[RNG.integers(n, size=(20_000, n))]), measured(x[None])
    found = bootstrap([x], 0.95, 0.95, 3)
    for kind, (values, errors) in picks.items():
        (value,), (error,) = whole[kind]
        ends = value - error * np.quantile((values - value) / errors, [0.975, 0.025])
        if kind == "std":
            ends, error = np.exp(ends) * np.sqrt(n / (n - 1)), error * x.std()
        np.testing.assert_allclose([found[kind].low[0], found[kind].high[0]], ends, atol=0.6 * error, rtol=0)
    np.testing.assert_allclose(found["mean"].value[0], x.mean(), rtol=1e-13)
    np.testing.assert_allclose(found["std"].value[0], x.std(ddof=1), rtol=1e-13)
    np.testing.assert_allclose(found["cvar"].value[0], np.sort(x)[-20:].mean(), rtol=1e-13)


def test_the_interval_is_infinite_if_the_resamples_do_not_determine_it():
    for moments in bootstrap([np.array([1.0, 2.0, 4.0])]).values():
        assert np.all(moments.low <= moments.value)
        assert moments.high[0] == np.inf  # one resample in nine is one value thrice
    (note,) = summary(columns(201), [], seed=0)["notes"]  # two members do not survive
    assert note.split(": ")[0] + note[-27:] == "the worst 5 % are 9.95 survivors use at least 200 survivors"
    assert summary(columns(202), [], seed=0)["notes"] == []
    (note,) = summary({name: np.repeat(x[5:6], 9) for name, x in columns(202).items()}, [], seed=0)["notes"]
    assert note.startswith("all survivors have the same metrics")


def test_grouped_intervals_have_the_width_of_the_central_limit_theorem():
    # 1e5 values in 6,000 groups: the same widths as if each value were resampled, to the 5 % of 1,000 resamples, thrice
    x = RNG.normal(size=100_000)
    found = bootstrap([x, 1e6 + 1e-3 * x], seed=1)
    for kind, deviation in (("mean", 1.0), ("std", 0.5**0.5)):
        width = found[kind].high - found[kind].low
        np.testing.assert_allclose(width / (2 * 1.96 * deviation / 100_000**0.5), [1, 1e-3], rtol=0.15)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [[1.0]], [1.0, np.inf]])
def test_cvar_refuses_what_is_not_a_column_of_numbers(values):
    with pytest.raises(ValueError, match="column"):
        cvar(np.array(values))


# --- the summary ---


def columns(n=200):
    rng = np.random.default_rng(1)
    mass, phase = rng.normal(size=n), rng.random(n)
    lost_at = np.full(n, np.inf)
    lost_at[[7, 3]] = [0.2, 0.1]
    return {
        "index": np.arange(100, 100 + n),
        "lost_at": lost_at,
        "lost": np.isfinite(lost_at) & (np.arange(n) != 7),
        "stalled": np.arange(n) == 7,
        "lost_at_s": lost_at,
        "settled_max_abs_error_m": 1e-6 * (5 + mass + 0.1 * rng.normal(size=n)),
        "sigma_reached_s": np.where(np.arange(n) < 5, np.inf, 0.1),
        "spread.plant.m": mass,
        "spread.disturbance.q_z.phase": phase,
    }


def test_the_summary_contains_the_documented_numbers():
    data, names = columns(), ["plant.m", "disturbance.q_z.phase"]
    found = summary(data, names, seed=3)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["members"], found["survivors"], found["seed"]) == (200, 198, 3)
    assert (found["lost"], found["stalled"]) == (1, 1)
    share, low, high = wilson(198, 200)
    assert found["survival"] == {"estimate": share, "low": low, "high": high}
    assert set(found["metrics"]) == {"settled_max_abs_error_m", "sigma_reached_s"}
    held = np.isinf(data["lost_at"])
    error, x = found["metrics"]["settled_max_abs_error_m"], data["settled_max_abs_error_m"][held]
    np.testing.assert_allclose(error["mean"]["estimate"], x.mean(), rtol=1e-12)
    np.testing.assert_allclose(error["std"]["estimate"], x.std(ddof=1), rtol=1e-12)
    assert error["median"]["estimate"] == np.quantile(x, 0.5, method="inverted_cdf")
    assert error["max"] == x.max()
    assert error["cvar_95"] == dict(zip(("estimate", "low", "high"), map(float, cvar(x, seed=3)), strict=True))
    for kind in ("mean", "std", "median", "q05", "q95", "cvar_95"):
        assert error[kind]["low"] <= error[kind]["estimate"] <= error[kind]["high"]


def test_the_summary_of_a_time_that_is_infinite_for_some_members():
    found = summary(columns(), ["plant.m"], seed=0)["metrics"]["sigma_reached_s"]
    assert found["finite"] == 194  # of 198 survivors, 4 never reach it
    assert found["max"] is None
    assert set(found["mean"].values()) == set(found["cvar_95"].values()) == {None}
    assert found["median"] == {"estimate": 0.1, "low": 0.1, "high": 0.1}


def test_the_summary_names_the_drivers_and_the_worst_members():
    data = columns()
    found = summary(data, ["disturbance.q_z.phase", "plant.m"], seed=0, worst=4)
    first, second = found["drivers"]["settled_max_abs_error_m"]
    assert first["path"] == "plant.m"
    assert first["rho"] > 0.95
    assert first["low"] <= first["share"] <= first["high"]
    assert first["share"] > 0.9
    assert first["p"] < 1e-6 < second["p"]
    assert found["explained"]["settled_max_abs_error_m"]["alone"] > 0.9
    assert set(found["drivers"]) == {"settled_max_abs_error_m", "sigma_reached_s", "lost_at_s"}
    alone = np.isinf(data["lost_at"])
    rank = stats.spearmanr(data["spread.plant.m"][alone], data["settled_max_abs_error_m"][alone])
    assert first["rho"] == pytest.approx(rank.statistic, rel=1e-12)
    by_error = 100 + np.argsort(-data["settled_max_abs_error_m"])
    rest = [k for k in by_error if k not in (103, 107)]
    assert [member["index"] for member in found["worst"]] == [103, 107, *rest[:2]]
    assert [member["lost_at_s"] for member in found["worst"]] == [0.1, 0.2, None, None]
    assert [member["status"] for member in found["worst"]] == ["lost", "stalled", "survives", "survives"]
    assert found["worst"][2]["settled_max_abs_error_m"] == data["settled_max_abs_error_m"].max()


def test_lost_members_are_excluded_from_every_metric():
    """The voltage of a lost rotor is 0 after the loss.

    The mean over all members would therefore be below that of any survivor.
    """
    data = columns()
    ended = np.isfinite(data["lost_at"])
    data["settled_rms_u_V"] = np.where(ended, 0.0, 60.0 + data["spread.plant.m"])
    found = summary(data, ["plant.m"], seed=3)
    assert found["metrics_of"] == "survivors"
    voltage = found["metrics"]["settled_rms_u_V"]
    alone = data["settled_rms_u_V"][~ended]
    assert voltage["mean"]["estimate"] == pytest.approx(alone.mean(), rel=1e-12)
    assert voltage["q05"]["estimate"] == np.quantile(alone, 0.05, method="inverted_cdf")
    assert (voltage["max"], voltage["finite"]) == (alone.max(), 198)
    # as if the lost ones had not been simulated
    less = summary({name: x[~ended] for name, x in data.items()}, ["plant.m"], seed=3)
    assert less["metrics"] == found["metrics"]
    assert {k: v for k, v in less["drivers"].items() if k != "lost_at_s"} == {
        k: v for k, v in found["drivers"].items() if k != "lost_at_s"
    }


def test_without_survivors_the_summary_has_no_metrics():
    data = columns() | {"lost_at": np.full(200, 0.1)}
    found = summary(data, ["plant.m"], seed=0)
    assert json.dumps(found, allow_nan=False)
    assert found["survivors"] == 0
    for metric in found["metrics"].values():
        assert metric.pop("finite") == 0
        assert metric.pop("max") is None
        assert {x for estimate in metric.values() for x in estimate.values()} == {None}
    assert found["explained"]["settled_max_abs_error_m"]["says"] == "no member survives"
    assert found["notes"] == ["no member survives: there are no statistics of the metrics"]
