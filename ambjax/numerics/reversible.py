"""A while loop that JAX differentiates in both modes.

JAX has no reverse mode for `lax.while_loop`, because the number of steps is not known in advance. The loop below runs
again in reverse mode: it stores the states of KEPT steps at a time, and goes through these steps backwards.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import eval_jaxpr
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Carry = TypeVar("Carry")
Values = Sequence[Array]

KEPT = 32


def while_loop(unfinished: Callable[[Carry], Array], step: Callable[[Carry], Carry], begin: Carry) -> Carry:
    """Apply `step` while `unfinished`, as `lax.while_loop` does, with forward and reverse mode."""
    leaves, tree = jax.tree.flatten(begin)
    leaves = [jnp.asarray(x) for x in leaves]
    # Reverse mode evaluates the functions later, so that the values that they close over become arguments.
    test = jax.make_jaxpr(lambda *x: unfinished(tree.unflatten(x)))(*leaves)
    body = jax.make_jaxpr(lambda *x: jax.tree.leaves(step(tree.unflatten(x))))(*leaves)
    loop = _WhileLoop(test.jaxpr, body.jaxpr, len(body.consts))
    return tree.unflatten(loop.run([*body.consts, *test.consts], leaves))


class _WhileLoop(NamedTuple):
    """A loop whose functions are `test(constants, carry)` and `body(constants, carry)`.

    - `own`: number of constants of the body; the others are those of the test.
    """

    test: Any
    body: Any
    own: int

    def unfinished(self, constants: Values, carry: Values) -> Array:
        return eval_jaxpr(self.test, constants[self.own :], *carry)[0]

    def step(self, constants: Values, carry: Values) -> list[Array]:
        after = eval_jaxpr(self.body, constants[: self.own], *carry)
        return [jnp.asarray(x, like.dtype) for x, like in zip(after, carry, strict=True)]

    def run(self, constants: Values, begin: Values) -> list[Array]:
        size = len(constants)

        @jax.custom_jvp
        def loop(*args: Any) -> list[Array]:
            constants, carry = args[:size], list(args[size:])
            return lax.while_loop(lambda x: self.unfinished(constants, x), lambda x: self.step(constants, x), carry)

        def derivative(args: Values, tangents: Values) -> tuple[list[Array], list[Any]]:
            return self.with_tangents(args[:size], args[size:], tangents)

        loop.defjvp(derivative, symbolic_zeros=True)
        return loop(*map(jnp.asarray, constants), *begin)

    def with_tangents(self, constants: Values, begin: Values, tangents: Values) -> tuple[list[Array], list[Any]]:
        moving = [n for n, x in enumerate(tangents[: len(constants)]) if type(x) is not SymbolicZero]
        moving = [n for n in moving if jnp.issubdtype(constants[n].dtype, jnp.inexact)]
        real = [n for n, x in enumerate(begin) if jnp.issubdtype(x.dtype, jnp.inexact)]
        d_begin = [tangents[len(constants) + n] for n in real]
        zeros = [jnp.zeros_like(begin[n]) for n in real]
        directions = (
            [tangents[n] for n in moving],
            [zero if type(x) is SymbolicZero else x for x, zero in zip(d_begin, zeros, strict=True)],
        )
        vary = _Varied(self, moving, real)
        end = self.run(constants, begin)
        sizes = len(constants), len(begin), len(moving)
        args = (*constants, *begin, *directions[0], *directions[1])
        d_end = _tangents.bind(*args, forwards=vary.forwards, backwards=vary.backwards, sizes=sizes)
        d_all: list[Any] = [np.zeros(x.shape, jax.dtypes.float0) for x in end]
        for n, tangent in zip(real, d_end, strict=True):
            d_all[n] = tangent
        return end, d_all


class _Varied(NamedTuple):
    """A loop as a function of the constants number `moving` and of the components number `real` of its carry."""

    loop: _WhileLoop
    moving: list[int]
    real: list[int]

    def step(self, constants: Values, carry: Values, moving: Values, real: Values) -> tuple[list[Array], list[Array]]:
        constants, carry = _replaced(constants, self.moving, moving), _replaced(carry, self.real, real)
        after = self.loop.step(constants, carry)
        return [after[n] for n in self.real], after

    def forwards(self, constants: Values, begin: Values, moving: Values, real: Values) -> list[Array]:
        """Return the tangents of the carry at the end, from those of the constants and of the carry at the begin."""

        def step(both: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
            carry, tangents = both
            values = [constants[n] for n in self.moving], [carry[n] for n in self.real]
            _, d_after, after = jax.jvp(
                lambda *x: self.step(constants, carry, *x), values, (list(moving), tangents), has_aux=True
            )
            return after, d_after

        first = list(begin), list(real)
        return while_loop(lambda both: self.loop.unfinished(constants, both[0]), step, first)[1]

    def backwards(self, constants: Values, begin: Values, d_end: list[Array]) -> tuple[list[Array], list[Array]]:
        """Return the cotangents of the constants and of the carry at the begin, from those of the carry at the end."""
        loop, begin = self.loop, [jnp.asarray(x) for x in begin]
        total = lax.while_loop(
            lambda now: loop.unfinished(constants, now[1]),
            lambda now: (now[0] + 1, loop.step(constants, now[1])),
            (jnp.int32(0), begin),
        )[0]
        blank = [jnp.zeros((KEPT, *x.shape), x.dtype) for x in begin]

        def store(n: Array, now: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
            kept, carry = now
            return [all_.at[n].set(x) for all_, x in zip(kept, carry, strict=True)], loop.step(constants, carry)

        def part(number: Array, cotangents: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
            first = (-(-total // KEPT) - 1 - number) * KEPT
            count = jnp.minimum(total - first, KEPT)
            start = lax.fori_loop(0, first, lambda _, carry: loop.step(constants, carry), begin)
            kept, _ = lax.fori_loop(0, count, store, (blank, start))

            def back(n: Array, now: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
                carry = [x[count - 1 - n] for x in kept]
                values = [constants[n] for n in self.moving], [carry[n] for n in self.real]
                _, pull, _ = jax.vjp(lambda *x: self.step(constants, carry, *x), *values, has_aux=True)
                d_constants, d_carry = pull(now[1])
                return [a + b for a, b in zip(now[0], d_constants, strict=True)], d_carry

            return lax.fori_loop(0, count, back, cotangents)

        return lax.fori_loop(0, -(-total // KEPT), part, ([jnp.zeros_like(constants[n]) for n in self.moving], d_end))


def _replaced(values: Values, numbers: list[int], new: Values) -> list[Array]:
    replaced = list(values)
    for n, x in zip(numbers, new, strict=True):
        replaced[n] = x
    return replaced


# The tangents of a loop, a linear function of the tangents of its constants and of its carry at the begin. Arguments:
# constants, carry, and the tangents of both.
_tangents = Primitive("tangents_of_while_loop")
_tangents.multiple_results = True


def _grouped(args: Values, sizes: tuple[int, int, int]) -> list[Values]:
    ends = np.cumsum([0, *sizes, len(args) - sum(sizes)])
    return [args[a:b] for a, b in itertools.pairwise(ends)]


def _forwards(*args: Any, forwards: Any, backwards: Any, sizes: tuple[int, int, int]) -> list[Array]:
    return forwards(*map(list, _grouped(args, sizes)))


def _shapes(*args: Array, sizes: tuple[int, int, int], **_: Any) -> list[Array]:
    return list(args[sum(sizes) :])


def _jvp(primals: Values, tangents: Values, **how: Any) -> tuple[list[Any], list[Any]]:
    return jax.jvp(lambda *x: _forwards(*x, **how), tuple(primals), tuple(ad.instantiate_zeros(x) for x in tangents))


def _transpose(cotangents: Values, *args: Any, forwards: Any, backwards: Any, sizes: Any) -> list[Array | None]:
    constants, begin, _, _ = _grouped(args, sizes)
    d_constants, d_begin = backwards(list(constants), list(begin), [ad.instantiate_zeros(x) for x in cotangents])
    return [*[None] * (len(constants) + len(begin)), *d_constants, *d_begin]


def _batched(args: Values, axes: Values, *, forwards: Any, backwards: Any, sizes: Any) -> tuple[list[Any], list[int]]:
    count = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    fixed = sizes[0] + sizes[1]  # constants and carry; unless they are batched, one run serves all directions
    tangents = [batching.bdim_at_front(x, axis, count) for x, axis in zip(args[fixed:], axes[fixed:], strict=True)]
    constants, begin = list(axes[: sizes[0]]), list(axes[sizes[0] : fixed])
    forwards = jax.vmap(forwards, in_axes=(constants, begin, 0, 0))
    backwards = jax.vmap(backwards, in_axes=(constants, begin, 0))
    out = _tangents.bind(*args[:fixed], *tangents, forwards=forwards, backwards=backwards, sizes=sizes)
    return out, [0] * len(out)


_tangents.def_impl(_forwards)
_tangents.def_abstract_eval(_shapes)
ad.primitive_jvps[_tangents] = _jvp
ad.primitive_transposes[_tangents] = _transpose
batching.primitive_batchers[_tangents] = _batched
mlir.register_lowering(_tangents, mlir.lower_fun(_forwards, multiple_results=True))
