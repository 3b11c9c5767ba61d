"""Shares of the variation of a metric: functions with known indices, a V-shaped function, and noise."""

import numpy as np
import pytest

from ambjax.ensemble import shares
from ambjax.ensemble.drivers import drivers

RNG = np.random.default_rng(11)


def ishigami(n, rng):
    x = rng.uniform(-np.pi, np.pi, (3, n))
    return list(x), np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


# First-order indices: Sobol and Levitan's function of Ishigami with a = 7, b = 0.1.
KNOWN = np.array([0.3139, 0.4424, 0.0])


def test_indices_of_ishigami():
    x, y = ishigami(100_000, RNG)
    # half a per cent of the slowest wave, a full sine, is beyond the cosines; the estimate's own error is 0.3 %
    np.testing.assert_allclose(shares(x, [y]).share[:, 0], KNOWN, atol=0.012)


@pytest.mark.parametrize("n", [64, 1000])
def test_intervals_cover_the_indices_of_ishigami(n):
    samples = [ishigami(n, RNG) for _ in range(300)]
    found = [shares(x, [y]) for x, y in samples]
    hits = np.mean([(f.low[:, 0] <= KNOWN) & (f.high[:, 0] >= KNOWN) for f in found], axis=0)
    # 95 % to three times the error of 300 trials; an index of 0 is at the border, and covered more often
    assert np.all(hits > 0.95 - 0.038)


@pytest.mark.parametrize("n", [64, 200, 5000])
def test_a_symmetric_effect_without_correlation_is_found(n):
    x, other = RNG.uniform(-1, 1, (2, n))
    y = np.abs(x) * (1 + 0.05 * RNG.normal(size=n))
    ranked, explained = drivers({"plant.m": x, "plant.R": other}, {"error": y})
    first, second = ranked["error"]
    assert first["path"] == "plant.m"
    assert first["share"] > 0.9
    assert abs(first["rho"]) < 0.35  # three of its errors at 64 members: what was shown before
    assert second["high"] < 0.35
    assert explained["error"]["says"].startswith("single quantities explain 9")


def test_an_effect_of_noise_only_is_reported_as_noise():
    said = []
    for _ in range(200):
        x = RNG.uniform(-1, 1, (5, 100))
        _, explained = drivers({str(k): column for k, column in enumerate(x)}, {"error": RNG.lognormal(size=100)})
        said.append(explained["error"]["says"])
    # 95 %, and three times the error of 200 trials
    noise = [one.startswith("no quantity and no pair of quantities explains it; it is noise") for one in said]
    assert np.mean(noise) > 0.95 - 0.047


def test_the_interaction_of_two_quantities_is_found():
    x = RNG.uniform(-1, 1, (3, 300))
    _, explained = drivers(dict(zip("abc", x, strict=True)), {"error": x[0] * x[2]})
    found = explained["error"]
    assert found["pair"]["paths"] == ["a", "c"]
    assert found["pair"]["share"] > 0.8
    assert "a with c together" in found["says"]


def test_lost_members_and_choices_and_constants():
    n = 400
    x, kinds = RNG.uniform(-1, 1, n), RNG.choice([1.0, 2.0], n)
    metrics = {
        "lost_at_s": np.where(np.abs(x) > 0.95, 0.1, np.inf),  # 20 members or so, at both ends
        "error": kinds + 0.01 * RNG.normal(size=n),
        "same": np.ones(n),
        "rare": np.where(np.arange(n) < 3, 0.1, np.inf),
    }
    ranked, explained = drivers({"x": x, "kinds": kinds, "same": np.ones(n)}, metrics)
    assert ranked["lost_at_s"][0]["path"] == "x"
    assert ranked["lost_at_s"][0]["p"] < 1e-6
    # two values: ranks within each are noise, and 3/4 of the variance of ranks lies between them
    assert ranked["error"][0]["path"] == "kinds"
    np.testing.assert_allclose(ranked["error"][0]["share"], 0.75, atol=0.05)
    assert explained["same"]["says"] == "it is the same for all members"
    assert explained["rare"]["says"] == "too few members differ to identify its causes"
    assert {row["share"] for row in ranked["same"]} == {0.0}


def test_a_case_without_a_spread_and_an_ensemble_with_few_members():
    ranked, explained = drivers({}, {"error": np.ones(3)})
    assert ranked == {"error": []}
    assert explained["error"]["says"] == "the case has no spread"
    for n in (1, 2, 3, 8, 20):
        x = RNG.normal(size=n)
        ranked, explained = drivers({"x": x, "y": RNG.normal(size=n)}, {"error": x})
        for row in ranked["error"]:
            assert 0 <= row["low"] <= row["share"] <= row["high"] <= 1
            assert 0 <= row["p"] <= 1
