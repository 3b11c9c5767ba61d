"""Rotors of machines from files and as modes with a gyroscopic matrix, against the shaft from its geometry."""

import functools
import itertools
import tomllib

import numpy as np
import pytest
import scipy.io

from ambjax.cases.machine_case import machine_from
from ambjax.cases.rotor_tables import body_from
from ambjax.cases.table import Table
from ambjax.cases.template_text import template
from ambjax.world.shaft import Section, element

FLEXIBLE = tomllib.loads(template("machine-flexible"))
MAGNETS = (0.113, 0.623)
MATRICES = ("M", "D", "G", "K", "at_magnets", "at_sensors")


@functools.cache
def finite_elements(own):
    """The rotor of the flexible template as ROSS writes it, with `own` coordinates a node: 4 or 6."""
    rotor, ends = FLEXIBLE["rotor"], np.cumsum([0.0, *(one["length"] for one in FLEXIBLE["rotor"]["elements"])])
    places = np.unique(np.round([*ends, *(one["at"] for one in rotor["discs"])], 9))
    nodes = np.unique(np.round(np.concatenate([np.linspace(a, b, 8) for a, b in itertools.pairwise(places)]), 9))
    count = len(nodes)
    M, G, K = (np.zeros((own * count, own * count)) for _ in range(3))
    M[range(own * count), range(own * count)] = 1.0  # the coordinates along and about the shaft, which are not read
    x, y = ((0, own - 2 if own == 6 else 3), (1, own - 3 if own == 6 else 2))
    for pair in (x, y):
        for node in range(count):
            M[own * node + pair[0], own * node + pair[0]] = M[own * node + pair[1], own * node + pair[1]] = 0.0
    flip = np.array([1.0, -1.0, 1.0, -1.0])
    for k in range(count - 1):
        size = rotor["elements"][np.searchsorted(ends, (nodes[k] + nodes[k + 1]) / 2) - 1]["diameter"]
        length = nodes[k + 1] - nodes[k]
        section = Section(nodes[k], length, size, 0.0, rotor["E"], rotor["rho"], rotor["nu"])
        mass, spin, stiffness = element(section, length)
        at_x, at_y = (np.array([own * (k + n) + c for n in (0, 1) for c in pair]) for pair in (x, y))
        for whole, part in ((M, mass), (K, stiffness)):
            whole[np.ix_(at_x, at_x)] += part
            whole[np.ix_(at_y, at_y)] += part * np.outer(flip, flip)
        G[np.ix_(at_x, at_y)] += spin * flip
        G[np.ix_(at_y, at_x)] -= (spin * flip).T
    for disc in rotor["discs"]:
        n = own * int(np.argmin(np.abs(nodes - disc["at"])))
        M[[n, n + 1], [n, n + 1]] += disc["m"]
        M[[n + x[1], n + y[1]], [n + x[1], n + y[1]]] += disc["I_t"]
        G[n + y[1], n + x[1]] += disc["I_p"]  # alpha, about x, and beta, about y
        G[n + x[1], n + y[1]] -= disc["I_p"]
    return {"M": M, "K": K, "C": 1e-6 * K, "G": G, "nodes": nodes}


@pytest.fixture(scope="module")
def shaft():
    return machine_from(FLEXIBLE).machine.rotor


def of_file(folder, arrays, name="rotor.npz", **rotor):
    """The flexible template with its rotor from a file."""
    if name.endswith(".npz"):
        np.savez(folder / name, **arrays)
    else:
        scipy.io.savemat(folder / name, arrays)
    table = {"kind": "modal", "file": name, "modes": 6, "damping": 0.003} | rotor
    return machine_from(FLEXIBLE | {"rotor": table}, "file", "", folder)


def alike(one, other, rtol):
    """Compare two rotors. The signs of the shapes are arbitrary, and the same at all places."""
    sign = np.ones(len(one.gravity))
    sign[5:] = np.sign(np.asarray(one.at_magnets)[0, 5::2] * np.asarray(other.at_magnets)[0, 5::2]).repeat(2)
    for name in MATRICES:
        a, b = (np.asarray(getattr(rotor, name)) for rotor in (one, other))
        b = b * sign if name.startswith("at") else b * np.outer(sign, sign)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(a).max(), err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(("own", "name"), [(4, "rotor.mat"), (6, "rotor.npz")])
def test_finite_elements_in_a_file_are_the_shaft(own, name, shaft, tmp_path):
    # fewer elements than those of the shaft: the squares of the frequencies are correct to 2e-4
    alike(of_file(tmp_path, finite_elements(own), name).machine.rotor, shaft, 3e-4)


def test_damping_of_a_file(tmp_path):
    np.savez(tmp_path / "rotor.npz", **finite_elements(4))
    body = body_from(Table({"rotor": {"kind": "modal", "file": "rotor.npz"}}), tmp_path)
    # C = b K is a damping ratio b w / 2
    np.testing.assert_allclose(body.dampings, np.pi * 1e-6 * body.frequencies, rtol=1e-6)
    assert len(body.frequencies) == 4


def modal_table(rotor):
    """The rotor as a modal table: all shapes mass-normalised."""
    M, B = np.diag(rotor.M), np.asarray(rotor.at_magnets)
    weights = 1 / np.sqrt(np.concatenate([M[[0, 4]], M[5::2]]))
    real, imaginary = [0, 4, *range(5, len(M), 2)], [1, 3, *range(6, len(M), 2)]
    G = np.asarray(rotor.G)[np.ix_(real, imaginary)] * np.where(np.array(imaginary) == 3, -1.0, 1.0)
    f = np.sqrt(np.diag(rotor.K) / M)[real] / (2 * np.pi)
    rows = {f"phi_{name}": B[k][real] * weights for name, k in (("left", 0), ("right", 2))}
    inertia = {"m": M[0], "It": M[3], "Ip": rotor.G[3, 4], "zc": MAGNETS[0] - B[0, 4]}
    return {"f_hz": f, "G": G * np.outer(weights, weights)} | inertia | rows


@pytest.mark.slow
def test_a_modal_table_is_the_shaft(shaft, tmp_path):
    np.savez(tmp_path / "table.npz", **modal_table(shaft))
    table = {"rotor": {"kind": "modal", "file": "table.npz", "damping": 0.003}, "unbalance": []}
    alike(machine_from(FLEXIBLE | table, "table", "", tmp_path).machine.rotor, shaft, 1e-12)


@pytest.mark.slow
def test_modes_with_a_gyroscopic_matrix_are_the_shaft(shaft):
    table = modal_table(shaft)
    modes = [{"frequency": f, "damping": 0.003} for f in table["f_hz"][2:].tolist()]
    m, I_t, I_p = (float(table[name]) for name in ("m", "It", "Ip"))
    Gm = table["G"].tolist()
    bearings = [
        {"name": name, "kind": "radial", "at": at - float(table["zc"]), "modes": table[f"phi_{name}"][2:].tolist()}
        for name, at in zip(("left", "right"), MAGNETS, strict=True)
    ]
    rotor = {"kind": "modal", "m": m, "I_t": I_t, "I_p": I_p, "modes": modes}
    raw = FLEXIBLE | {"bearing": bearings, "unbalance": []}
    alike(machine_from(raw | {"rotor": rotor | {"Gm": Gm}}).machine.rotor, shaft, 1e-12)
    # of the modes alone: no coupling with the tilt
    own = np.asarray(machine_from(raw | {"rotor": rotor | {"Gm": np.array(Gm)[2:, 2:].tolist()}}).machine.rotor.G)
    np.testing.assert_allclose(own[5:, 5:], np.asarray(shaft.G)[5:, 5:], rtol=1e-12, atol=1e-18)
    assert not np.any(own[:5, 5:])
    assert own[3, 4] == I_p


def test_a_step_beyond_the_stability_limit_of_the_fastest_mode_is_refused():
    """The limit of RK4 is 2.785 divided by the natural frequency."""
    raw = FLEXIBLE | {"rotor": FLEXIBLE["rotor"] | {"modes": 20}}
    rotor = machine_from(raw).machine.rotor
    fastest = np.sqrt(np.linalg.eigvals(np.linalg.solve(rotor.M, rotor.K)).real.max())

    def with_step(dt):
        clock = {"sample_period": dt, "dt": dt, "duration": 100 * dt, "method": "rk4"}
        return machine_from(raw | {"clock": clock, "run": {"settle": 0.0}})

    assert with_step(0.99 * 2.785 / fastest).clock.method.substeps == 1
    with pytest.raises(ValueError, match=rf"^clock\.dt = .* up to {2.785 / fastest:.3g} s, because the fastest mode"):
        with_step(1.01 * 2.785 / fastest)


BAD = [
    ({"K": None}, {}, "the array K is missing"),
    ({"nodes": np.zeros(3)}, {}, "in ascending order"),
    ({"M": np.eye(7)}, {}, "M has 7 rows"),
    ({"K": np.eye(8)}, {}, "K has the shape"),
    ({"G": np.array("x")}, {}, "G must contain finite real numbers"),
    ({}, {"modes": 1000}, "rotor.modes = 1000"),
    ({}, {"file": "other.npz"}, "cannot be read"),
    ({}, {"file": "rotor.txt"}, r"an \.npz or \.mat file"),
    ({}, {"m": 1.0}, "rotor.m"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "rotor", "said"), BAD)
def test_a_bad_file_is_refused_in_one_line(change, rotor, said, tmp_path):
    arrays = {name: x for name, x in (finite_elements(4) | change).items() if x is not None}
    np.savez(tmp_path / "rotor.npz", **arrays)
    with pytest.raises(ValueError, match=said) as refused:
        machine_from(FLEXIBLE | {"rotor": {"kind": "modal", "file": "rotor.npz"} | rotor}, "bad", "", tmp_path)
    assert "\n" not in str(refused.value)


def test_a_rotor_on_springs_or_unlike_in_its_planes_is_refused(tmp_path):
    arrays = finite_elements(4)
    for entries, said in (([(40, 40), (41, 41)], "it must be free"), ([(40, 40)], "differs between the planes")):
        K = arrays["K"].copy()
        for at in entries:
            K[at] += 1e5
        with pytest.raises(ValueError, match=said):
            of_file(tmp_path, arrays | {"K": K})


@pytest.mark.slow
def test_a_place_without_shapes_is_refused(shaft, tmp_path):
    with pytest.raises(ValueError, match=r"no shapes at 0\.363 m.*0\.113, 0\.623 m"):
        of_file(tmp_path, modal_table(shaft))  # its unbalance is on the middle disc


def test_the_rotor_of_uberlandia_from_its_geometry():
    """Mass, inertia, free frequencies, and their splits at 10,000 rpm: figures of an independent program."""
    raw = tomllib.loads(template("machine-ufu"))
    body = body_from(Table(raw | {"rotor": raw["rotor"] | {"modes": 8}}))
    assert (body.m, body.I_t, body.I_p) == pytest.approx((5.936, 0.18586, 4.795e-3), rel=1e-4)
    np.testing.assert_allclose(body.frequencies[:4], [104.2, 400.3, 768.2, 1117.6], atol=0.05)
    assert body.shapes is not None
    assert abs(body.shapes(0.5669)[1]) == pytest.approx(0.022, abs=5e-4)  # a node almost at the second magnet
    n, W = len(body.gyroscopic), 10_000 * np.pi / 30
    stiffness = np.diag([0.0, 0.0, *(2 * np.pi * body.frequencies) ** 2])
    masses = np.diag([body.m, body.I_t, *np.ones(n - 2)])
    # q'' - j W Gm q' + K q = 0
    still, spin = np.linalg.solve(masses, stiffness), np.linalg.solve(masses, body.gyroscopic)
    turning = np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [-still, 1j * W * spin]])).imag / (2 * np.pi)
    for expected in (106.4, 442.9, -102.0, -355.3):
        assert np.abs(turning - expected).min() < 0.1
