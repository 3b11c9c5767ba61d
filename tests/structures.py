"""Random cases in continuous time, and their solution by SciPy's integrators.

The right-hand side is that of ambjax, which tests/oracle.py checks. The integrator, its error control and its restarts
at samples and jumps share no code with ambjax.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from ambjax import laws, solvers
from ambjax.simulation.loop import ClosedLoop

# One method of each kind.
METHODS = [
    solvers.Euler(3), solvers.RK4(3), solvers.DOP853(3), solvers.Rodas3(3), solvers.AdaptiveRodas3(),
    solvers.AdaptiveCashKarp(),
]  # fmt: skip
RIG = {"m": 1.64, "k_z": 0.0, "mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "i_0": 2.5, "R": 1.0}
# Laws whose signs' arguments stay below 1 % of 1/p at amplitudes of 1e-6 m; a peak of |S| of 8 to 25 near 30 Hz.
SMOOTH = {
    "position": laws.position.SlidingMode(c=200.0, k=63.0, p=5.0),
    "inversion": laws.inversion.Adaptive(gamma=2e6, p=1e-3),
    "current": laws.current.SlidingMode(k_i=600.0, p=20.0),
}
OBSERVERS = ["direct", "complementary", "difference", "kalman", "ired-1", "ired-2"]
POSITIONS = [
    "sliding-mode", "integral-sliding-mode", "super-twisting", "utkin-sliding-mode", "terminal-sliding-mode", "pid",
    "feedback-linearisation", "state-feedback", "chain",
]  # fmt: skip
INVERSIONS = ["adaptive", "adaptive-feed-forward", "closed-form", "linearised"]
CURRENTS = ["sliding-mode", "pi", "dead-beat"]


def drawn(seed, samples):
    """A random case as the tables of a case file: plant, laws, start, sensor, limit, reference and pulse."""
    rng = np.random.default_rng(seed)
    ours = rng.random() < 0.6  # the rig; otherwise the paper's plant
    raw, T, gap = {}, 5e-5 if ours else 1e-4, 5e-4 if ours else 5e-3
    if ours:
        raw["plant"] = RIG | ({"kind": "two-coil"} if rng.random() < 0.4 else {})
        raw["plant"] |= {"iron": {"saturation": 1.2}} if rng.random() < 0.3 else {}
    controller = {"observer": {"kind": str(rng.choice(OBSERVERS, p=[0.5, 0.15, 0.1, 0.1, 0.075, 0.075]))}}
    for stage, kinds in (("position", POSITIONS), ("inversion", INVERSIONS), ("current", CURRENTS)):
        controller[stage] = {"kind": str(rng.choice(kinds))}
    if ours and controller["position"]["kind"] == "sliding-mode":
        controller["position"] |= {"c": 600.0, "k": 15.0, "p": 10 ** rng.uniform(1, 3)}
    if ours and controller["current"]["kind"] == "sliding-mode":
        controller["current"] |= {"k_i": 1000.0, "p": 10 ** rng.uniform(-1, 1.5)}
    if controller["inversion"]["kind"].startswith("adaptive"):
        gamma = 3e11 if ours else 4e5
        controller["inversion"] |= {"gamma": gamma, "p": np.pi / 2 * 10 ** rng.uniform(3.5, 5.5) / gamma}
    raw["controller"] = controller
    raw["initial"] = {"z": gap * rng.choice([-1, 1]) * 10 ** rng.uniform(-2.5, -1.3)}
    sensor = rng.integers(3)
    if sensor:
        raw["sensor"] = {} if sensor == 1 else {"std": gap * 10 ** rng.uniform(-4, -2.7)}
    if rng.random() < 0.6:
        raw["actuator"] = {"u_max": (20 if ours else 60) * 10 ** rng.uniform(0, 0.8)}
    kind, size = rng.random(), gap * rng.choice([-1, 1])
    if kind < 0.4:
        step = {"start": T * rng.uniform(0, samples / 4), "duration": 10 ** rng.uniform(-3, -2)}
        raw["reference"] = {"kind": "smoothstep", "amplitude": size * 10 ** rng.uniform(-2, -1), **step}
    elif kind < 0.7:
        wave = {"amplitude": abs(size) * 10 ** rng.uniform(-2.5, -1.3), "frequency": 10 ** rng.uniform(0.5, 2)}
        raw["reference"] = {"kind": "sine", **wave}
    if rng.random() < 0.5:
        begin, end = T * samples * rng.uniform([0.05, 0.5], [0.45, 0.9])
        raw["disturbance"] = {"q_z": {"kind": "pulse", "amplitude": rng.uniform(-1, 1), "start": begin, "stop": end}}
    raw["clock"], raw["run"] = {"duration": samples * T, "sample_period": T}, {"settle": samples * T / 4}
    return jax.tree.map(lambda x: x.item() if isinstance(x, np.generic) else x, raw)


def solution(case, method="DOP853", rtol=1e-11):
    """Return z at the samples by SciPy, for the noise that ambjax draws."""
    loop, T = ClosedLoop(case.cascade, case.scenario).realised(), float(case.clock.sample_period)
    start, tree = jax.tree.flatten(jax.tree.map(lambda x: jnp.asarray(x, float), loop.start()))
    scale = np.array([float(x) for x in jax.tree.leaves(loop.scale())])

    @jax.jit
    def f(t, y, errors):
        state = jax.tree.unflatten(tree, list(y))
        return jnp.stack([jnp.asarray(x) for x in jax.tree.leaves(loop.rates(loop.inputs(t), state, errors))])

    slope, jumps = jax.jit(jax.jacfwd(f, 1)), sorted(map(float, case.scenario.edges(reference=True)))
    y, z = np.array(start, float), [float(start[0])]
    for k in range(case.clock.samples - 1):
        errors = loop.sensor_errors(k)
        inside = [x for x in jumps if k * T + 1e-12 < x < (k + 1) * T - 1e-12]
        for a, b in itertools.pairwise([k * T, *inside, (k + 1) * T]):
            ends = a + 1e-9 * (b - a), b - 1e-9 * (b - a)  # a jump at an end belongs to the other interval

            def rates(t, y, ends=ends, errors=errors):
                return np.asarray(f(np.clip(t, *ends), y, errors))

            how = {"jac": lambda t, y, errors=errors: np.asarray(slope(t, y, errors))} if method == "Radau" else {}
            run = solve_ivp(rates, (a, b), y, method, rtol=rtol, atol=1e-3 * rtol * scale, **how)
            assert run.success, run.message
            y = run.y[:, -1]
        z.append(y[0])
    return np.array(z)
