"""The bearing: a vertical rotor between two electromagnets (Table 1, Eq. (3)), and the base class of the plants."""

from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, part, record
from ambjax.numerics.smooth import safe_sqrt
from ambjax.world.magnet import Gaps, Iron, distance_to_C, gaps
from ambjax.world.sensor import Measurement

# State of a plant, or its rates: a NamedTuple of scalars.
S = TypeVar("S")


class Signals(NamedTuple):
    """Signals of a plant besides motion and current: scaled force v of Eq. (3) (A^2/m^2), and copper loss (W)."""

    v: Array
    heat: Array


@record
class Bearing(Generic[S]):
    """Parameters of rotor and magnets (Table 1), and the force of given currents. All parameters are in SI units.

    A plant is a subclass of this record, and its state is a NamedTuple of scalars with z and z_dot. The subclass
    implements `start`, `rates`, `scale`, `measurement` and `signals`. It overrides `currents` if the coils do not share
    one current deviation, and `flux_currents` if the flux can lag. It inherits the other methods.

    The paper prints k_z in N m. Here it is a stiffness in N/m; a negative value is restoring.
    """

    m: Scalar = bounded(0.588, "kg", 1e-6, 1e6, "mass of rotor and axle")
    k_z: Scalar = bounded(-754.0, "N/m", -1e12, 1e12, "axial stiffness of one passive bearing; negative: restoring")
    mu_0: Scalar = bounded(1.25e-6, "N/A^2", 1e-8, 1e-4, "permeability of the air gap")
    n: Scalar = bounded(1480.0, "1", 1, 1e6, "turns of each coil")
    A: Scalar = bounded(0.121, "m^2", 1e-9, 100.0, "area of a pole")
    s_0: Scalar = bounded(5e-3, "m", 1e-6, 1.0, "air gap at z = 0")
    i_0: Scalar = bounded(0.25, "A", 1e-6, 1e5, "bias current")
    R: Scalar = bounded(41.44, "ohm", 0, 1e6, "coil resistance")
    g: Scalar = bounded(9.81, "m/s^2", -1e4, 1e4, "gravitational acceleration")

    iron: Iron | None = part(
        default=None,
        doc="saturation, leakage and eddy currents of the true plant; None: ideal iron. "
        "The formulas of the laws do not contain it",
    )

    one_current: ClassVar[bool] = False
    """Whether one current deviation describes both coils, as in `Plant`."""

    two_voltages: ClassVar[bool] = False
    """Whether `rates` also takes the voltage of each coil, `CoilVoltages`, as in `TwoCoil`."""

    @property
    def delays(self) -> bool:
        """Whether the flux follows the current with a lag, so that the state contains the delayed currents."""
        return self.iron is not None and self.iron.eddy is not None

    @property
    def lumped(self) -> bool:
        """Whether Eqs. (1) and (2) hold: one current, and ideal iron. `simulation.sliding` requires it."""
        return self.one_current and self.iron is None

    def start(self, measurement: Measurement) -> S:
        """Return the state with this motion and current."""
        raise NotImplementedError

    def rates(self, state: S, u: Any, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> S:
        """Return the time derivative of the state under a voltage u (V) and disturbances q_z (m/s^2), q_i (A/s)."""
        raise NotImplementedError

    def rest(self, state: S, z: Array) -> S:
        """Return the state in which a lost rotor is frozen: at z (m), with zero velocity."""
        return state._replace(z=z, z_dot=jnp.zeros_like(z))  # pyright: ignore[reportAttributeAccessIssue]

    def scale(self) -> S:
        """Return the characteristic size of each component of the state; integration errors are relative to it."""
        raise NotImplementedError

    def measurement(self, state: S) -> Measurement:
        raise NotImplementedError

    def signals(self, state: S) -> Signals:
        """Return the scaled force and the copper loss in this state."""
        raise NotImplementedError

    def slope(self) -> Scalar:
        """Return the fastest rate of the plant's motion, 1/s, on its magnets or its passive bearings.

        The step size is chosen from it.
        """
        magnets, passive = abs(self.k_s), 2 * abs(self.k_z)
        larger = (magnets + passive + abs(magnets - passive)) / 2  # without `maximum`, which JAX compiles for numbers
        return (larger / self.m) ** 0.5

    def flux_slope(self) -> Scalar:
        """Return the rate at which the flux follows the current, 1/s; 0 if there is no lag."""
        return 0.0 if self.iron is None or self.iron.eddy is None else 1 / self.iron.eddy

    def coil_slope(self, z: Scalar) -> Scalar:
        """Return the fastest rate R/L of a coil's current (1/s) for displacements up to z (m). Eq. (2).

        It is 2 R (s_0 + z)/kappa with ideal iron. Saturation multiplies it by `Iron.fastest`.
        """
        slope = 2 * self.R * (self.s_0 + z) / self.kappa
        return slope if self.iron is None else self.iron.fastest() * slope

    def currents(self, state: S) -> tuple[Array, Array]:
        """Return the currents of the upper and the lower coil, A."""
        i = self.measurement(state).i
        return self.i_0 + i, self.i_0 - i

    def flux_currents(self, state: S) -> tuple[Array, Array]:
        """Return the currents (A) that determine the fluxes of the two coils."""
        return self.currents(state)

    def pull(self, flux_currents: tuple[Array, Array], z: Scalar, gaps: Gaps | None = None) -> Array:
        """Return the scaled force of the two coils (A^2/m^2): the difference of (i/gap)^2, with saturation if any.

        `flux_currents`: result of the method of this name, A. `z`: displacement, m. `gaps`: those at z; None:
        computed here.
        """
        pulls = []
        for i, inverse in zip(flux_currents, (gaps or self.gaps(z)).inverses, strict=True):
            share = 1.0 if self.iron is None else self.iron.share(self.iron.core(self, i, inverse))
            pulls.append((i * inverse * share) ** 2)
        return pulls[0] - pulls[1]

    def flux_density(self, state: S) -> Array:
        """Return the larger of the flux densities of the two cores, T."""
        iron, inverses = self.iron or Iron(), self.gaps(self.measurement(state).z).inverses
        cores = [iron.core(self, i, inverse) for i, inverse in zip(self.flux_currents(state), inverses, strict=True)]
        upper, lower = (jnp.abs(b * iron.share(b)) for b in cores)
        return jnp.maximum(upper, lower)

    def largest_force(self, i_max: Scalar | None = None) -> Scalar:
        """Return the magnetic force (N) at z = 0 for i = min(i_0, i_max). At i = i_0 the lower coil is off."""
        most = jnp.asarray(self.i_0) if i_max is None else jnp.minimum(self.i_0, i_max)
        return self.m * self.a * self.pull((self.i_0 + most, self.i_0 - most), 0.0 * most)

    def sizes(self) -> Measurement:
        """Return characteristic sizes: s_0/50 for z (m), s_0/5 per second for z_dot (m/s), i_0/25 for i (A)."""
        offset = jnp.asarray(self.s_0) / 50
        return Measurement(offset, 10 * offset, jnp.asarray(self.i_0) / 25)

    @property
    def kappa(self) -> Scalar:
        """mu_0 n^2 A, in N m^2/A^2."""
        return self.mu_0 * self.n**2 * self.A

    @property
    def a(self) -> Scalar:
        """Acceleration per scaled magnetic force: kappa / (4 m), in (m/s^2) / (A^2/m^2)."""
        return self.kappa / (4 * self.m)

    @property
    def L(self) -> Scalar:
        """Coil inductance at z = 0: kappa / (2 s_0), in H."""
        return self.kappa / (2 * self.s_0)

    @property
    def k_s(self) -> Scalar:
        """Magnitude of the negative stiffness of the magnets at the origin: kappa i_0^2 / s_0^3, in N/m."""
        return self.kappa * self.i_0**2 / self.s_0**3

    @property
    def k_i(self) -> Scalar:
        """Force per current at the origin: kappa i_0 / s_0^2, in N/A."""
        return self.kappa * self.i_0 / self.s_0**2

    @property
    def pole(self) -> Scalar:
        """Unstable pole of the magnets alone, sqrt(k_s / m), in 1/s."""
        return (abs(self.k_s) / self.m) ** 0.5

    @property
    def sigma_size(self) -> Scalar:
        """Characteristic size of sigma, in m/s: s_0 times the pole."""
        return self.pole * self.s_0

    @property
    def v_size(self) -> Scalar:
        """Characteristic size of the scaled force, in A^2/m^2: that of one magnet at the bias current."""
        return (self.i_0 / self.s_0) * (self.i_0 / self.s_0)

    def gaps(self, z: Scalar) -> Gaps:
        """Return the gaps s_0 - z and s_0 + z (m). Only their inverses are bounded (`world.magnet.GAP_FLOOR`)."""
        return gaps(z, self.s_0)

    def v(self, z: Scalar, i: Scalar) -> Array:
        """Scaled magnetic force, in A^2/m^2: ((i_0+i)/(s_0-z))^2 - ((i_0-i)/(s_0+z))^2. Eq. (3)."""
        return self.v_and_dv_di(z, i)[0]

    def dv_dz(self, z: Scalar, i: Scalar) -> Array:
        """Partial derivative of v with respect to z, in A^2/m^3: 2 (i_0+i)^2/(s_0-z)^3 + 2 (i_0-i)^2/(s_0+z)^3."""
        upper, lower = self.gaps(z).inverses
        return 2 * (self.i_0 + i) ** 2 * upper**3 + 2 * (self.i_0 - i) ** 2 * lower**3

    def dv_di(self, z: Scalar, i: Scalar) -> Array:
        """Partial derivative of v with respect to i, in A/m^2: 2 (i_0+i)/(s_0-z)^2 + 2 (i_0-i)/(s_0+z)^2.

        It vanishes exactly on the singular curve C, Eq. (9).
        """
        return self.v_and_dv_di(z, i)[1]

    def v_and_dv_di(self, z: Scalar, i: Scalar, gaps: Gaps | None = None) -> tuple[Array, Array]:
        """Return v (A^2/m^2) and dv/di (A/m^2). `gaps`: those at z; None: computed here."""
        gaps = gaps or self.gaps(z)
        along = (self.i_0 * z + self.s_0 * i) * gaps.inverse
        across = (self.i_0 * self.s_0 + i * z) * gaps.inverse
        return 4 * along * across, 4 * gaps.inverse * (self.s_0 * across + z * along)

    def current_for(self, z: Scalar, v: Scalar) -> Array:
        """Return the current (A) with scaled force v at z: the root of Eq. (3) that stays finite at z = 0.

        At z = 0 the quadratic becomes linear. The formula has no cancellation there and is smooth. If no current gives
        the force v at z, the result is the current on C at this z: its force is the closest to v.
        """
        # Eq. (3) times the squared product of the gaps: difference i^2 + 2 total i - above = 0. The root is written
        # without cancellation.
        upper, lower, _ = self.gaps(z)
        product = upper * lower
        total, difference = 2 * self.i_0 * (self.s_0 * self.s_0 + z * z), 4 * self.s_0 * z
        discriminant = 4 * self.i_0 * self.i_0 + difference * v
        reachable = discriminant >= 0
        above = jnp.where(reachable, product * product * v - self.i_0 * self.i_0 * difference, -total)
        return above / jnp.where(reachable, total + product * safe_sqrt(discriminant), difference)

    def equilibrium(self, z: Scalar = 0.0) -> tuple[Array, Array]:
        """Return the current (A) and voltage (V) at which z_ddot = i_dot = 0 at z."""
        i = self.current_for(z, (self.g - 2 * self.k_z / self.m * z) / self.a)
        return i, self.R * i

    def copper_loss(self, i: Scalar) -> Array:
        """Return the heat in both coils, in W: R ((i_0+i)^2 + (i_0-i)^2)."""
        return 2 * self.R * (self.i_0**2 + jnp.asarray(i) ** 2)

    def singularity(self, z: Scalar, i: Scalar) -> Array:
        """(z^2 + 2 s_0 i z / i_0 + s_0^2) / s_0^2: 1 at the origin, 0 on C, negative beyond. Eq. (9)."""
        zeta = jnp.asarray(z) * (1 / self.s_0)
        return zeta * (zeta + (2 / self.i_0) * i) + 1

    def distance_to_C(self, z: Scalar, i: Scalar) -> Array:
        """Return the distance from (z/s_0, i/i_0) to the singular curve C, dimensionless. Eq. (9)."""
        return distance_to_C(jnp.asarray(z) / self.s_0, jnp.asarray(i) / self.i_0)

    def signed_distance_to_C(self, z: Scalar, i: Scalar) -> Array:
        """Return `distance_to_C`, negative beyond the curve, where `singularity` is negative. Dimensionless."""
        distance = self.distance_to_C(z, i)
        return jnp.where(self.singularity(z, i) > 0, distance, -distance)
