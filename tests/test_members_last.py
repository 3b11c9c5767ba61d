"""Vectorisation with the members last: it equals jax.vmap."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ambjax.compiler.members_last import members_last
from ambjax.numerics.relax import relax


def every_rule(tree: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Use every rule, and some primitives without one."""
    x, y, A, n = tree["x"], tree["y"], tree["A"], tree["n"]  # [3], number, [3, 3], whole number
    sums = jnp.stack([jnp.sum(A * x, -1), jnp.max(A, 0) * y, jnp.min(A.T + x[:, None], 1)])

    def counted(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return carry[0] + 1, carry[1] * 0.5 + y

    def turn(carry: tuple[jax.Array, jax.Array], own: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        still, moving = carry
        return (still + own[0], jnp.where(y > 0, moving + own, x)), still * own

    (still, moving), rows = lax.scan(turn, (jnp.zeros(()), jnp.zeros(3)), A)
    return {
        "sums": sums.reshape(9)[::2],
        "same": lax.fori_loop(0, 3, lambda k, v: v + x * k, jnp.zeros(3)),
        "own": lax.while_loop(lambda c: c[0] < n, counted, (jnp.zeros((), int), y))[1],
        "still": still,
        "moving": moving,
        "rows": rows,
        "sorted": jnp.sort(x) @ A,
        "at": lax.dynamic_index_in_dim(x, n, 0, False) + lax.dynamic_index_in_dim(x, np.int32(1), 0, False),
        "set": x.at[1].set(y)
        + lax.dynamic_update_index_in_dim(x, y, n, 0)
        + lax.dynamic_update_index_in_dim(x, y, np.uint32(2), 0),
        "chosen": lax.cond(n > 1, lambda: x, lambda: -x),
        "relaxed": jax.jit(relax)(x, 0.1, 5.0),
        "any": jnp.any(x > 0.5) & jnp.all(x < 2),
        "common": jnp.sum(A),
        "outer": jax.vmap(jax.vmap(jnp.multiply, (None, 0)), (0, None))(x, A[0]),
    }


def test_members_last_equals_vmap_for_all_kinds_of_primitives():
    rng = np.random.default_rng(0)
    tree = {"x": rng.normal(size=(5, 3)), "y": rng.normal(size=5), "A": rng.normal(size=(3, 3)), "n": np.arange(5) % 3}
    axes = {"x": 0, "y": 0, "A": None, "n": 0}
    expected = jax.vmap(every_rule, (axes,))(tree)
    found = jax.jit(members_last(every_rule, axes))(tree)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for name, x in expected.items():
        np.testing.assert_allclose(found[name], x, rtol=1e-12, atol=1e-14, err_msg=name)
