"""CMA-ES, by the package `cma`: a derivative-free search for goals whose derivatives mislead.

N. Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772 (2023).
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from tuning.problem.goal import MOST
from tuning.problem.quantities import NEGLIGIBLE
from tuning.solve.descent import FIRST_RADIUS

# Number of iterations over which progress is judged: in a race, of a descent and of CMA-ES. `benchmarks/ablation.py`
# tries 6.
PATIENCE = 5
# Size of a population, in units of the default of `cma`. Larger ones find lower optima of rugged goals.
POPULATION = 2


class Evolution:
    """CMA-ES around the point `origin` [m]. The size of its first steps is that of the first step of a descent.

    `told` [n, K]: goals of the K points of each population so far. With `seed`, they determine its state.
    """

    def __init__(self, origin: np.ndarray, seed: int, told: Iterable[np.ndarray] = ()) -> None:
        from cma import CMAEvolutionStrategy  # slow: it imports matplotlib

        draw = np.random.default_rng(seed).standard_normal
        size = POPULATION * (4 + int(3 * math.log(len(origin))))
        options = {"popsize": size, "seed": np.nan, "randn": lambda *shape: draw(shape), "verbose": -9}
        self.origin, self.seed, self.told = origin, seed, list[np.ndarray]()
        self._strategy: Any = CMAEvolutionStrategy(origin, FIRST_RADIUS, options)
        for values in told:
            self.tell(self.ask(), values)

    def ask(self) -> np.ndarray:
        """Return the next population [K, m]."""
        return np.array(self._strategy.ask())

    def tell(self, points: np.ndarray, values: np.ndarray) -> None:
        """Update the distribution with the goals [K] of its last population, `points` [K, m]."""
        self._strategy.tell(list(points), np.minimum(values, MOST))
        self.told.append(values)

    @property
    def reach(self) -> float:
        """Standard deviation along the longest axis."""
        return float(self._strategy.sigma * np.max(self._strategy.D))

    @property
    def converged(self) -> bool:
        """Whether the last PATIENCE populations do not lower the mean of their better half by NEGLIGIBLE.

        Whole populations decide, because one point may be better by chance.
        """
        levels = [np.sort(values)[: len(values) // 2].mean() for values in self.told]
        return len(levels) > PATIENCE and min(levels[-PATIENCE:]) > min(levels[:-PATIENCE]) - NEGLIGIBLE
