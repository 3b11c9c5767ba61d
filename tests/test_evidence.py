"""The runs of the ledger: which plants are simulated. The runs themselves are replaced by stubs."""

import numpy as np
import pytest

from ambjax import paper
from ambjax.paper import evidence
from ambjax.plants import Plant


@pytest.mark.parametrize("fragile", ["m -10 %", "m +10 %", "k_z -10 %", "R +10 %", "A -10 %"])
def test_the_uncertain_plant_is_tried_10_percent_below_and_above(monkeypatch, fragile):
    """Each of m, k_z, R and A is changed by -10 % and +10 %. The result names the change that loses the rotor."""
    tried = []

    def rollout(cascade, scenario, clock, *, fold):
        own, nominal = scenario.plant, Plant()
        off = [
            f"{name} {100 * (getattr(own, name) / getattr(nominal, name) - 1):+.0f} %"
            for name in nominal.__dataclass_fields__
            if getattr(own, name) != getattr(nominal, name)
        ]
        assert len(off) == 1
        tried.append(off[0])
        ended = off[0] in (fragile, stalling)
        status = {"lost": off[0] == fragile, "stalled": off[0] == stalling, "lost_at_s": 0.1 if ended else np.inf}
        return (), status | {"settled_max_abs_error_m": 1e-6 * len(tried)}

    stalling = "A +10 %"
    monkeypatch.setattr(evidence, "rollout", rollout)
    lost, stalled, error = evidence._uncertain(paper.cascade("repaired"), "repaired")
    assert (lost, stalled) == ([fragile], [stalling])
    assert sorted(tried) == sorted(f"{name} {sign}10 %" for name in ("m", "k_z", "R", "A") for sign in "+-")
    assert error == pytest.approx(8e-6)
