"""The runs of the ledger: which plants are simulated. The runs themselves are replaced by stubs."""

import dataclasses

import numpy as np
import pytest

from ambjax import paper
from ambjax.paper import evidence
from ambjax.plants import Plant


def test_the_uncertain_plant_is_tried_10_percent_below_and_above(monkeypatch):
    """Each of m, k_z, R and A is changed by -10 % and +10 %. The result names the change that loses the rotor."""
    tried = []

    def rollout(cascade, scenario, clock, *, fold):
        own, nominal = dataclasses.asdict(scenario.plant), dataclasses.asdict(Plant())
        (off,) = (f"{name} {100 * (own[name] / x - 1):+.0f} %" for name, x in nominal.items() if own[name] != x)
        tried.append(off)
        lost, stalled = off == "k_z -10 %", off == "A +10 %"
        status = {"lost": lost, "stalled": stalled, "lost_at_s": 0.1 if lost or stalled else np.inf}
        return (), status | {"settled_max_abs_error_m": 1e-6 * len(tried)}

    monkeypatch.setattr(evidence, "rollout", rollout)
    lost, stalled, error = evidence._uncertain(paper.cascade("repaired"), "repaired")
    assert (lost, stalled) == (["k_z -10 %"], ["A +10 %"])
    assert sorted(tried) == sorted(f"{name} {sign}10 %" for name in ("m", "k_z", "R", "A") for sign in "+-")
    assert error == pytest.approx(8e-6)
