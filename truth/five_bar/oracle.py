"""A five-bar robot as rigid bodies under constraints, in numpy: its exact accelerations and forces.

Ten coordinates, X = (q1, q2, x1, y1, phi1, x2, y2, phi2, px, py): the proximal links by their angles, the
distal links by centre and angle, the tool by its position. Hinges are eight constraints with multipliers;
friction acts as a pair of moments on the two links of a hinge. Nothing is pulled back through the closure.
"""

from dataclasses import dataclass, field

import numpy as np

# Relative rates of the hinges: rows of what multiplies (q1', q2', phi1', phi2'). Joints 1 and 2, then the
# passive angles pi - phi2 + q2, phi2 - phi1, pi - q1 + phi1.
HINGES = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, -1], [0, 0, -1, 1], [-1, 0, 1, 0]], dtype=float)
TURNS = [0, 1, 4, 7]
ORDERS = ("coulomb_friction", "viscous_friction", "quadratic_drag", "cubic_friction", "quartic_friction")


# Of `Robot()`, as a case has it.
PLANT = """[plant]
kind = "five_bar"
[plant.parameters]
length = [0.18, 0.25, 0.25, 0.25, 0.25]
center = [[0.1254, 0.0009], [0.1303, 0.0006]]
mass = [2.32, 2.78]
inertia = [0.292, 0.292, 0.030, 0.036]
tip_mass = 2.72
reduction = [20.0, 20.0]
"""


@dataclass(frozen=True)
class Robot:
    """Five bars in SI units, as the tables of the paper have them.

    friction: by kind five coefficients, one a hinge, of sign v, v, v |v|, v^3, v^3 |v| [N m (s/rad)^k].
    """

    length: tuple = (0.18, 0.25, 0.25, 0.25, 0.25)
    center: tuple = ((0.1254, 0.0009), (0.1303, 0.0006))
    mass: tuple = (2.32, 2.78)
    inertia: tuple = (0.292, 0.292, 0.030, 0.036)
    tip_mass: float = 2.72
    friction: dict = field(default_factory=dict)

    @property
    def coefficients(self) -> np.ndarray:
        """Coefficients of friction, (5 orders, 5 hinges)."""
        return np.array([self.friction.get(kind, np.zeros(5)) for kind in ORDERS], dtype=float)


def turned(angle, vector):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def across(vector):
    return np.array([-vector[1], vector[0]])


def coordinates(robot: Robot, q) -> np.ndarray:
    """Return X of joint angles, the tool by the law of cosines, left of the line from elbow 1 to elbow 2."""
    l = robot.length
    elbow = [turned(q[k], [l[1 + k], 0.0]) + [(-l[0], l[0])[k] / 2, 0.0] for k in range(2)]
    way = elbow[1] - elbow[0]
    d = np.hypot(*way)
    open_by = np.arccos((l[3] ** 2 + d**2 - l[4] ** 2) / (2 * l[3] * d))
    phi1 = np.arctan2(way[1], way[0]) + open_by
    tool = elbow[0] + turned(phi1, [l[3], 0.0])
    phi2 = np.arctan2(*(tool - elbow[1])[::-1])
    phi = [phi1, phi2]
    center = [elbow[k] + turned(phi[k], robot.center[k]) for k in range(2)]
    return np.array([*q, *center[0], phi1, *center[1], phi2, *tool])


def constraints(robot: Robot, x, v):
    """Return the gaps of the hinges (8,), their Jacobian (8, 10), and its rate times the velocity (8,)."""
    l = robot.length
    gap, slope, bias = np.zeros(8), np.zeros((8, 10)), np.zeros(8)
    for k in range(2):
        at, turn = 2 + 3 * k, 4 + 3 * k
        elbow = turned(x[k], [l[1 + k], 0.0])
        center = turned(x[turn], robot.center[k])
        end = turned(x[turn], np.array([l[3 + k], 0.0]) - robot.center[k])
        ground = np.array([(-l[0], l[0])[k] / 2, 0.0])
        rows = slice(4 * k, 4 * k + 2)  # the link's start lies at the elbow
        gap[rows] = x[at : at + 2] - center - elbow - ground
        slope[rows, at : at + 2] = np.eye(2)
        slope[rows, turn], slope[rows, k] = -across(center), -across(elbow)
        bias[rows] = center * v[turn] ** 2 + elbow * v[k] ** 2
        rows = slice(4 * k + 2, 4 * k + 4)  # its end lies at the tool
        gap[rows] = x[at : at + 2] + end - x[8:]
        slope[rows, at : at + 2], slope[rows, 8:] = np.eye(2), -np.eye(2)
        slope[rows, turn] = across(end)
        bias[rows] = -end * v[turn] ** 2
    return gap, slope, bias


def masses(robot: Robot) -> np.ndarray:
    (m1, m2), (p1, p2, d1, d2), m = robot.mass, robot.inertia, robot.tip_mass
    return np.array([p1, p2, m1, m1, d1, m2, m2, d2, m, m])


def moving(robot: Robot, q, qd):
    """Return X and its rate, by the constraints."""
    x = coordinates(robot, q)
    slope = constraints(robot, x, np.zeros(10))[1]
    rest = np.linalg.solve(slope[:, 2:], -slope[:, :2] @ qd)
    return x, np.array([*qd, *rest])


def friction_of(robot: Robot, rates, sign=np.sign) -> np.ndarray:
    """Return the moment of friction in every hinge, against its rate, (5,)."""
    s, a = sign(rates), np.abs(rates)
    return -np.sum(robot.coefficients * np.array([s, rates, rates * a, rates**3, rates**3 * a]), axis=0)


def inverse_dynamics(robot: Robot, q, qd, qdd, sign=np.sign) -> np.ndarray:
    """Solve for the torques that give an acceleration, with the hinges' multipliers as unknowns."""
    x, v = moving(robot, q, qd)
    _, slope, bias = constraints(robot, x, v)
    a = np.array([*qdd, *np.linalg.solve(slope[:, 2:], -bias - slope[:, :2] @ qdd)])
    load = np.zeros(10)
    load[TURNS] = HINGES.T @ friction_of(robot, HINGES @ v[TURNS], sign)
    unknowns = np.concatenate([np.eye(10)[:, :2], slope.T], axis=1)
    return np.linalg.solve(unknowns, masses(robot) * a - load)[:2]


def forward_dynamics(robot: Robot, q, qd, torque, sign=np.sign) -> np.ndarray:
    """Solve the ten equations of motion and eight hinges for the joints' accelerations under torques."""
    x, v = moving(robot, q, qd)
    _, slope, bias = constraints(robot, x, v)
    load = np.zeros(10)
    load[TURNS] = HINGES.T @ friction_of(robot, HINGES @ v[TURNS], sign)
    load[:2] += torque
    whole = np.block([[np.diag(masses(robot)), slope.T], [slope, np.zeros((8, 8))]])
    return np.linalg.solve(whole, np.concatenate([load, -bias]))[:2]


def kinetic_energy(robot: Robot, q, qd) -> float:
    return 0.5 * masses(robot) @ moving(robot, q, qd)[1] ** 2


def possible_states(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    """Draw q, qd, qdd of states with the distal links well apart from one line, (3, count, 2)."""
    rng = np.random.default_rng(seed)
    q, l = rng.uniform(-np.pi, np.pi, (60 * count, 2)), robot.length
    x = -l[0] + l[1] * np.cos(q[:, 0]) - l[2] * np.cos(q[:, 1])
    d = np.hypot(x, l[1] * np.sin(q[:, 0]) - l[2] * np.sin(q[:, 1]))
    cosine = (l[3] ** 2 + l[4] ** 2 - d**2) / (2 * l[3] * l[4])
    q = q[np.abs(cosine) < 0.95][:count]
    return np.stack([q, rng.uniform(-4, 4, (count, 2)), rng.uniform(-30, 30, (count, 2))])
