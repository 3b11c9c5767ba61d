"""Counter-based Gaussian random numbers: a few vector operations compute any sample of any member directly.

jax.random.normal draws other numbers from the same distribution. It uses the inverse error function, whose logarithm is
a library call for every number on CPUs and costs twenty times as much as a step of the loop. Here the method of Box and
Muller transforms the words of Threefry.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ambjax.compiler.barrier import compiled_alone
from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import cosine, sine

ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
# First words of the counter. jax.random.fold_in uses 0, so these are other streams of the same key.
STREAMS = 1, 2
# Largest magnitude of a result of `normals`.
LARGEST_NORMAL = 6.8
LN_2, ROOT_HALF = float(np.log(2.0)), float(np.sqrt(0.5))
# Number of terms of the series of atanh(s)/s, s^2 <= 0.0295, for an error at the level of rounding.
ATANH_TERMS = {"float64": 10, "float32": 5}


def _threefry(k_0: Array, k_1: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return two random words from the key (k_0, k_1) and the counter (x, y)."""
    schedule = (k_0, k_1, k_0 ^ k_1 ^ jnp.uint32(0x1BD11BDA))
    x, y = x + k_0, y + k_1
    for group in range(5):
        for turn in ROTATIONS[group % 2]:
            x = x + y
            y = ((y << jnp.uint32(turn)) | (y >> jnp.uint32(32 - turn))) ^ x
        x = x + schedule[(group + 1) % 3]
        y = y + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


@compiled_alone
def _both(*words: Array) -> Array:
    """Return both words of `_threefry` in the bits of one complex number. For two results XLA would repeat the work."""
    return lax.complex(*[lax.bitcast_convert_type(word, jnp.float32) for word in _threefry(*words)])


def threefry(key: tuple[Scalar, Scalar], count: tuple[Scalar, Scalar]) -> tuple[Array, Array]:
    """Return two random 32-bit words from a counter of two words, by Threefry-2x32 with 20 rounds.

    It is the generator of jax.random (Salmon et al., SC 2011).
    """
    words = [jnp.asarray(word).astype(jnp.uint32) for word in (*key, *count)]
    if jax.default_backend() != "cpu":
        return _threefry(*words)
    both = _both(*words)
    first, second = (lax.bitcast_convert_type(part, jnp.uint32) for part in (lax.real(both), lax.imag(both)))
    return first, second


@compiled_alone
def _radius(word: Array) -> Array:
    """Return sqrt(-2 ln u) for u = (word + 1/2) / 2^32."""
    dtype = jnp.result_type(float)
    whole, bits = (jnp.uint64, 52) if dtype == jnp.float64 else (jnp.uint32, 23)
    one = jnp.asarray(np.ones((), dtype).view(whole))
    raw = lax.bitcast_convert_type(word.astype(dtype) + 0.5, whole)
    m = lax.bitcast_convert_type((raw & jnp.asarray((1 << bits) - 1, whole)) | one, dtype)
    exponent = (raw >> jnp.asarray(bits, whole)).astype(jnp.int32) - (one >> jnp.asarray(bits, whole)).astype(jnp.int32)
    high = m > 2 * ROOT_HALF
    m, exponent = jnp.where(high, m / 2, m), exponent + high
    s = (m - 1) / (m + 1)
    series = jnp.zeros_like(s)
    for n in reversed(range(ATANH_TERMS[dtype.name])):
        series = series * s * s + 1 / (2 * n + 1)
    return jnp.sqrt(2 * LN_2 * (32 - exponent).astype(dtype) - 4 * s * series)


def normals(key: tuple[Scalar, Scalar], number: Scalar) -> tuple[Array, Array, Array]:
    """Return three independent standard normal numbers.

    - `key`: the random key of a member, two 32-bit words.
    - `number`: counter, for example the number of the sample.

    Box and Muller (Ann. Math. Statist. 29 (1958) 610): sqrt(-2 ln u) times cosine and sine of 2 pi w. u and w have
    32 bits, so that no absolute value exceeds 6.8.
    """
    (a, b), (c, d) = (threefry(key, (stream, number)) for stream in STREAMS)
    turn, other = (x.astype(jnp.result_type(float)) * 2.0**-32 for x in (b, d))
    first, second = _radius(a), _radius(c)
    return first * cosine(turn), first * sine(turn), second * cosine(other)
