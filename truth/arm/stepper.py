"""Logs of an arm in a PD loop with exact dry friction in every joint, on Pinocchio's links.

Moreau's midpoint step: friction impulses lie within their levels and bring a joint to rest where they can,
found by projected Gauss-Seidel sweeps. Mass matrix and the other forces are Pinocchio's, halfway.
"""

from dataclasses import dataclass, replace

import numpy as np

# Rounds of the sweeps; a round that changes no impulse by more than 1e-14 of its level is the last.
SWEEPS = 500


@dataclass(frozen=True)
class Arm:
    """Joints that turn about the z axes of their frames, in a weight along -z of the base.

    axes, origins: of each link's frame in that before it at zero angles, (n, 3, 3) and (n, 3) [m]; bodies:
    ten parameters a link, in the order of `truth.arm.oracle.NAMES`; viscous [N m s/rad] and coulomb [N m],
    one a joint.
    """

    axes: np.ndarray
    origins: np.ndarray
    bodies: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray

    def model(self):
        """Return Pinocchio's model and data of the links."""
        import pinocchio

        model, before = pinocchio.Model(), 0
        for k, body in enumerate(self.bodies):
            place = pinocchio.SE3(self.axes[k], self.origins[k])
            before = model.addJoint(before, pinocchio.JointModelRZ(), place, f"joint{k + 1}")
            # xx xy yy xz yz zz behind mass and first moments
            inertia = pinocchio.Inertia.FromDynamicParameters(body[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]])
            model.appendBodyToJoint(before, inertia, pinocchio.SE3.Identity())
        model.gravity.linear = np.array([0.0, 0.0, -9.81])
        return model, model.createData()

    def torque(self, position, velocity, acceleration) -> np.ndarray:
        """Return the torques along a motion, (time, n) [N m]."""
        import pinocchio

        model, data = self.model()
        rows = zip(position, velocity, acceleration, strict=True)
        rigid = np.array([pinocchio.rnea(model, data, *x) for x in rows])
        return rigid + self.viscous * velocity + self.coulomb * np.sign(velocity)


def advance(arm: Arm, links, q, v, torque, h: float, steps: int):
    """Return the position and velocity after `steps` of h [s] under constant torques."""
    import pinocchio

    model, data = links
    most = h * arm.coulomb
    for _ in range(steps):
        half, mean = q + 0.5 * h * v, v
        for _ in range(2):
            mass = pinocchio.crba(model, data, half)
            load = torque - pinocchio.rnea(model, data, half, mean, np.zeros_like(v)) - arm.viscous * mean
            inverse = np.linalg.inv(mass)
            free = v + h * inverse @ load
            # Where all joints go on as they are, friction only drags.
            new = free - inverse @ (most * np.sign(v))
            if not np.all(v * new > 0):
                new = stopped(free, inverse, most)
            mean = 0.5 * (v + new)
            half = q + 0.5 * h * mean
        q, v = q + h * mean, new
    return q, v


def stopped(free, mobility, most) -> np.ndarray:
    """Return the velocities after friction impulses that stop joints where they may.

    free: without friction; mobility: change of velocities per impulse; most: largest impulse of each joint.
    """
    v, impulse = free.copy(), np.zeros_like(free)
    for _ in range(SWEEPS):
        moved = 0.0
        for k in np.flatnonzero(most):
            wanted = np.clip(impulse[k] - v[k] / mobility[k, k], -most[k], most[k])
            change, impulse[k] = wanted - impulse[k], wanted
            v += mobility[:, k] * change
            moved = max(moved, abs(change) / most[k])
        if moved < 1e-14:
            break
    return v


def followed(
    arm: Arm, reference, *, rate: float, kp, kd, step: float = 1e-4, gear=0.0, read=lambda q: q
) -> dict[str, np.ndarray]:
    """Run a PD loop from rest; return the readings q, the speeds qd and the torques u, (time, n).

    u = kp (r - q) + kd (r' - q'), both differenced backwards, held until the next tick.

    reference: at every tick, (ticks, n) [rad]; rate: of the ticks [Hz]; kp [N m/rad], kd [N m s/rad]; step:
    of integration [s]; gear: dry friction of each joint in proportion to the torque of its drive, one a
    joint; read: reading of the encoders at a position, which the loop sees.
    """
    links, steps = arm.model(), round(1 / rate / step)
    q, v = reference[0].copy(), np.zeros_like(reference[0])
    was, rows = (reference[0], read(q)), []
    for r in reference:
        seen = read(q)
        u = kp * (r - seen) + kd * rate * ((r - was[0]) - (seen - was[1]))
        rows.append((seen, v, u))
        was = r, seen
        rubbing = replace(arm, coulomb=arm.coulomb + gear * np.abs(u))
        q, v = advance(rubbing, links, q, v, u, 1 / rate / steps, steps)
    return {k: np.array(x) for k, x in zip(("q", "qd", "u"), zip(*rows, strict=True), strict=True)}
