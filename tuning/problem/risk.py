"""Risk measure: one number from the losses of an ensemble [N]."""

import dataclasses

import jax.numpy as jnp
from jax import Array


@dataclasses.dataclass(frozen=True)
class CVaR:
    """Conditional value at risk: the mean of the worst share 1 - alpha of the losses; with alpha = 0, their mean.

    Rockafellar and Uryasev, J. Risk 2 (2000) 21-41. It equals the minimum over q of
    q + mean(max(l - q, 0)) / (1 - alpha), which lies at the alpha quantile. If (1 - alpha) N is not whole, the last of
    the worst members counts in part.
    """

    alpha: float = 0.0

    def __call__(self, losses: Array) -> Array:
        count = losses.shape[0]
        share = (1 - self.alpha) * count
        weights = jnp.clip(share - jnp.arange(count), 0.0, 1.0) / share
        return jnp.sum(weights * jnp.sort(losses)[::-1])

    def __str__(self) -> str:
        return f"CVaR({self.alpha:g})" if self.alpha else "mean"
