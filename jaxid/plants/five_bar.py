"""A planar robot of five bars: two driven arms that carry one tool, closed through the ground."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.links import WithLinks
from jaxid.model.parameter import parameter

# Sine of the angle between the distal links below which they count as one line. Chosen: the tool then moves a
# hundred times as fast as the elbows, and its inertia at the joints has grown ten thousandfold.
SINGULAR = 1e-2
# Fixed joints, in parts of l_f from the origin between them.
_SIDES = np.array([-0.5, 0.5])
_X = np.array([1.0, 0.0])
# Ports of the first joint, passive angle and tool.
_TOOL = 5
_PLACES = {0: "joint", 2: "passive", _TOOL: "tool"}


class Pose(NamedTuple):
    """The positions of the five bars; rows are arms 1 and 2.

    Args:
        elbow: Positions e of the elbows, (2, 2) [m].
        tool: Position p of the tool, (2,) [m].
        proximal: Vectors from the fixed joint to the elbow, (2, 2) [m].
        distal: Vectors from the elbow to the tool, (2, 2) [m].
    """

    elbow: Array
    tool: Array
    proximal: Array
    distal: Array


class FiveBar(WithLinks):
    """iota tau = M(q) qdd + C(q, qd) qd - effects, M = D' M* D, of two arms that hold one tool.

    q1 and q2 are the angles of the proximal links from the x axis, which runs from fixed joint 1 through
    fixed joint 2, the origin halfway; the plane is horizontal, without weight. The tool lies left of the line
    from elbow 1 to elbow 2. Kinetic energy is that of chi = (q, angles and centres of mass of the distal
    links, tool), each with its mass; D, its rate and the passive angles are derivatives of the closure.

    Ports are the two joints, behind them the passive angles psi_3 = pi - phi_2 + q_2 (elbow 2), psi_4 =
    phi_2 - phi_1 (tool joint) and psi_5 = pi - q_1 + phi_1 (elbow 1), which results call passive 1 to 3, and
    the tool, by its two coordinates.

    If the distal links are in one line (parallel singularity, `SINGULAR`) or do not reach each other, all
    results are NaN; `impossible` finds such configurations.

    Args:
        length: l_f between the fixed joints, proximal l_p1, l_p2, distal l_d1, l_d2, (5,) [m].
        center: Centres of mass of the distal links, along the link from its elbow and to the left of that,
            (2, 2) [m].
        mass: Masses of the distal links, (2,) [kg].
        inertia: Inertias of the proximal links about their fixed joints, with all that moves with them
            (motors, gears, parts at the elbows), and of the distal links about their centres of mass,
            (4,) [kg m^2].
        tip_mass: Mass at the tool [kg].
        reduction: iota, turns of each motor for one of its joint, (2,), or None for ones. The torque of a
            log is the motor's, its position the joint's: `gearing` turns one into the other.

    Source:
        Righettini et al. (2025), Robotics 14(4), 36, (24)-(46). As printed, (16)-(18) want D_m^-T; (30), (31)
        are atan2; (45), (46) are D' M* D and D' M* dD/dt. It selects the greater p_2, which is the same if
        elbow 2 is to the right of elbow 1, and jumps otherwise.
    """

    kind = "five_bar"
    joints = 2
    coupled = True
    usual_motion = "rotary"
    passives: ClassVar[int] = 3
    tools: ClassVar[int] = 1

    length: Array = parameter("position", "positive", "l_f, l_p1, l_p2, l_d1, l_d2", more=3, motion="linear")
    center: Array = parameter(
        "position", "free", "of the distal links, [along, to the left] each", more=0, motion="linear", width=2
    )
    mass: Array = parameter("inertia", "nonnegative", "of the distal links", more=0, motion="linear")
    inertia: Array = parameter(
        "inertia",
        "nonnegative",
        "I_p1, I_p2 about their fixed joints, I_d1, I_d2 about their centres",
        more=2,
        motion="rotary",
    )
    tip_mass: Array = parameter("inertia", "nonnegative", "at the tool", motion="linear")
    reduction: Array | None = parameter(
        "1", "positive", "turns of each motor for one of its joint", optional=True, more=0, known=True
    )

    def pose(self, q: Float[Array, " 2"]) -> Pose:
        """Solve the closure: two circles about the elbows meet in the tool; NaN if they do not."""
        proximal, elbow = self._elbows(q)
        tool = _meeting(elbow, self.length[3:])
        return Pose(elbow, tool, proximal, tool - elbow)

    def _elbows(self, q: Array) -> tuple[Array, Array]:
        """Return the proximal links and the elbows at their ends."""
        proximal = self.length[1:3, None] * jnp.stack([jnp.cos(q), jnp.sin(q)], axis=1)
        return proximal, proximal + self.length[0] * _SIDES[:, None] * _X

    def tool(self, q: Float[Array, " 2"]) -> Float[Array, " 2"]:
        """Return p, the position of the tool [m]."""
        return self.pose(q).tool

    def angles(self, q: Float[Array, " 2"]) -> Float[Array, " 2"]:
        """Return phi, the angles of the distal links from the x axis, within (-pi, pi] [rad]; (31)."""
        distal = self.pose(q).distal
        return jnp.arctan2(distal[:, 1], distal[:, 0])

    def inverse(self, tool: Float[Array, " 2"]) -> Float[Array, " 2"]:
        """Return the angles for a position of the tool [m], (28)-(30): elbow 1 on the left, elbow 2 right.

        For tools above the x axis these are the lowest x of elbow 1 and the highest of elbow 2. NaN if an
        arm does not reach, or only stretched or folded, or if the tool would not lie left of the line from
        elbow 1 to elbow 2.
        """
        proximal, distal = self.length[1:3], self.length[3:]
        way = tool - self.length[0] * _SIDES[:, None] * _X
        square = jnp.sum(way**2, axis=1)
        along = 0.5 + 0.5 * (proximal**2 - distal**2) / square
        height = jnp.sqrt(proximal**2 / square - along**2) * np.array([1.0, -1.0])
        left = jnp.stack([-way[:, 1], way[:, 0]], axis=1)
        arm = along[:, None] * way + height[:, None] * left
        (x1, y1), (x2, y2) = way - arm
        apart = jnp.abs(height) * square > SINGULAR * proximal * distal
        apart = jnp.all(apart) & (x1 * y2 - y1 * x2 > SINGULAR * distal[0] * distal[1])
        return jnp.where(apart, jnp.arctan2(arm[:, 1], arm[:, 0]), jnp.nan)

    def condition(self, q: Float[Array, " 2"]) -> Float[Array, ""]:
        """Return the least over the greatest eigenvalue of D_p' D_p: one for an isotropic tool."""
        jacobian = jax.jacfwd(self.tool)(q)
        half = 0.5 * jnp.sum(jacobian**2)
        det = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
        greatest = half + jnp.sqrt(jnp.maximum(half**2 - det**2, 0.0))
        return (det / greatest) ** 2

    def impossible(self, q: Float[np.ndarray, "time n"]) -> tuple[int, str] | None:
        reach = self.length[3:]
        sine = np.asarray(self._sines(np.asarray(q, dtype=np.float64)))
        rows = np.flatnonzero(~(sine > SINGULAR))
        if not len(rows):
            return None
        row = int(rows[0])
        shown = ", ".join(f"{float(x):.4g}" for x in np.asarray(q)[row])
        if sine[row] >= 0:
            fault = "bring the distal links into one line, a singular configuration"
            return row, f"joints at [{shown}] rad {fault}"
        elbow = np.asarray(self._elbows(jnp.asarray(q[row], dtype=jnp.float64))[1])
        apart = float(np.linalg.norm(elbow[1] - elbow[0]))
        lengths = f"elbows {apart:.4g} m apart, distal links of {reach[0]:.4g} and {reach[1]:.4g} m"
        return row, f"joints at [{shown}] rad are out of reach: {lengths}"

    @eqx.filter_jit
    def _sines(self, q: Float[Array, "time 2"]) -> Float[Array, " time"]:
        return jax.vmap(lambda q: _sine(self._elbows(q)[1], self.length[3:]))(q)

    def joint_positions(self, tool: Float[np.ndarray, " 2"]) -> Float[Array, " 2"]:
        return self.inverse(tool)

    @classmethod
    def links(cls, joints: int) -> int:
        return 4

    def frame(self, link: int, q: Array) -> tuple[Array, Array]:
        """Return the frame of a link, z up: proximal ones at their fixed joints, distal ones at elbows."""
        at = self.pose(q)
        ground = self.length[0] * _SIDES[:, None] * _X
        along = jnp.concatenate([at.proximal, at.distal])[link] / self.length[1 + link]
        axes = jnp.zeros((3, 3)).at[:2, 0].set(along).at[2, 2].set(1.0)
        axes = axes.at[0, 1].set(-along[1]).at[1, 1].set(along[0])
        origin = jnp.concatenate([ground, at.elbow])[link]
        return axes, jnp.concatenate([origin, jnp.zeros(1)])

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return D' M* (D qdd + dD/dt qd): inertial forces of all masses, pulled back to the joints."""

        def velocity(q: Array) -> Array:
            return jax.jvp(self._moved, (q,), (qd,))[1]

        slope = jax.jacfwd(self._moved)(q)
        bend = jax.jvp(velocity, (q,), (qd,))[1]
        masses = jnp.concatenate([self.inertia, jnp.repeat(self.mass, 2), jnp.repeat(self.tip_mass, 2)])
        acceleration = bend + jnp.sum(slope * qdd, axis=1)
        return jnp.sum(slope * (masses * acceleration)[:, None], axis=0)

    def _moved(self, q: Array) -> Float[Array, " 10"]:
        """Return chi, the coordinates of all masses, in the order of M*."""
        at = self.pose(q)
        along = at.distal / self.length[3:, None]
        left = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
        center = at.elbow + self.center[:, :1] * along + self.center[:, 1:] * left
        return jnp.concatenate([q, q + _turn(at.proximal, at.distal), center.ravel(), at.tool])

    def ports(self, q: Array) -> Array:
        at = self.pose(q)
        turn = _turn(at.proximal, at.distal)
        # Angles between two links do not jump by a turn if a link passes the x axis.
        between = _turn(at.distal[:1], at.distal[1:])[0]
        return jnp.concatenate([q, jnp.stack([np.pi - turn[1], between, np.pi + turn[0]]), at.tool])

    @property
    def filters_fast(self) -> bool:
        # The loop is closed anew at every step, which takes many minutes along a log.
        return False

    @property
    def gearing(self) -> Array | float:
        return 1.0 if self.reduction is None else self.reduction

    def directions(self, port: int) -> tuple[int, ...]:
        return (port, port + 1) if port == _TOOL else (port,)

    def place(self, port: int) -> tuple[str, int]:
        first = max(first for first in _PLACES if first <= port)
        return _PLACES[first], port - first + 1

    def motion(self, port: int) -> str:
        return "linear" if port >= _TOOL else "rotary"

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        if port >= _TOOL:  # a payload
            return effect.kind == "added_mass" and port == _TOOL
        # No inertia turns with a passive angle alone.
        alone = port < self.joints or effect.kind not in ("added_mass", "joint_flexibility")
        return alone and super().accepts(effect, port, drives)

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        if effect.kind != "added_mass":
            return None
        return ("tip_mass", None) if port == _TOOL else ("inertia", port) if port < self.joints else None


def _sine(elbow: Float[Array, "2 2"], reach: Float[Array, " 2"]) -> Array:
    """Return the sine of the angle from distal link 1 to distal link 2; NaN if they do not meet."""
    square = jnp.sum((elbow[1] - elbow[0]) ** 2)
    cosine = 0.5 * (jnp.sum(reach**2) - square) / (reach[0] * reach[1])
    return jnp.sqrt(1.0 - cosine**2)


@jax.custom_jvp
def _meeting(elbow: Float[Array, "2 2"], reach: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return the intersection of circles about the elbows, left of the line from the first to the second."""
    across, sine = elbow[1] - elbow[0], _sine(elbow, reach)
    square = jnp.sum(across**2)
    along = 0.5 + 0.5 * (reach[0] ** 2 - reach[1] ** 2) / square
    height = jnp.where(sine > SINGULAR, sine, jnp.nan) * reach[0] * reach[1] / square
    return elbow[0] + along * across + height * jnp.stack([-across[1], across[0]])


@_meeting.defjvp
def _meeting_moves(at: tuple[Array, Array], by: tuple[Array, Array]) -> tuple[Array, Array]:
    """Differentiate the closure by (34): (p - e_i) (dp - de_i) = l_i dl_i. It takes fewer operations."""
    tool = _meeting(*at)
    one, two = tool - at[0]
    rows = jnp.sum((tool - at[0]) * by[0], axis=1) + at[1] * by[1]
    solution = jnp.stack([rows[0] * two[1] - rows[1] * one[1], rows[1] * one[0] - rows[0] * two[0]])
    return tool, solution / (one[0] * two[1] - one[1] * two[0])


def _turn(one: Float[Array, "k 2"], two: Float[Array, "k 2"]) -> Float[Array, " k"]:
    """Return the angle from one vector to another, within (-pi, pi]."""
    cross = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    return jnp.arctan2(cross, jnp.sum(one * two, axis=1))
