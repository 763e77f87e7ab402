"""A wrist whose last link is light and short, and a link that swings, by other physics than the package's."""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.logs.log import Log
from truth.arm import oracle as arm_oracle
from truth.arm import stepper as arm_stepper

GRAVITY = np.array([0.0, 0.0, -9.81])
# A wrist, whose last link is light and short.
WRIST = [
    ("revolute", 0.0, 0.0, 0.0, 0.0),
    ("revolute", np.pi / 2, 0.0, 0.3, 0.0),
    ("revolute", -np.pi / 2, 0.2, 0.0, 0.0),
]
SHORT = np.array([1.0, 0.3, 0.3, 0.3, *[0.09] * 6])
SIZES = np.array([np.ones(10), 0.5 * np.ones(10), 0.02 * SHORT])
TRUE = SIZES * arm_oracle.bodies(3, np.random.default_rng(1))
NOISE = 2.0
RATE, SECONDS = 100.0, 12.0


def motion(seed: int, rate: float = RATE) -> tuple[np.ndarray, ...]:
    """Sums of sines, and their derivatives."""
    rng, t = np.random.default_rng(seed), np.arange(0, SECONDS, 1 / rate)[:, None, None]
    ranges = ((0.1, 1.0), (0.0, 6.0), (0.1, 0.5))
    hz, phase, size = (rng.uniform(*r, (3, 5)) for r in ranges)
    w = 2 * np.pi * hz
    angle = w * t + phase
    parts = (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle))
    return (t.ravel(), *(x.sum(axis=-1) for x in parts))


def torque(seed: int, bodies: np.ndarray = TRUE) -> tuple[np.ndarray, ...]:
    """Return a motion of the first links and its torque, a link for each body."""
    t, *parts = motion(seed)
    q, qd, qdd = (x[:, : len(bodies)] for x in parts)
    chain = WRIST[: len(bodies)]
    tau = [arm_oracle.inverse_dynamics(chain, bodies, *x, GRAVITY) for x in zip(q, qd, qdd, strict=True)]
    return t, q, qd, qdd, np.array(tau)


def wrist_log(seed: int, noise: float, of_noise: int, bodies: np.ndarray = TRUE) -> Log:
    """Return a log of the wrist with exact positions and a noisy torque."""
    t, q, _, _, tau = torque(seed, bodies)
    noise = noise * np.random.default_rng(of_noise).standard_normal(tau.shape)
    return Log(time=t, position=q, force=tau + noise, source=f"wrist {seed}")


def case(consistent: bool, count: int = 3) -> str:
    """Every link starts as a ball of 1 kg off its joint."""
    numbers = "{ guess = %s }"
    ball = ("1.0", ["0.1", "0.05", "0.1"], ["0.03", "-0.005", "-0.01", "0.03", "-0.005", "0.03"])
    listed = lambda values: "[" + ", ".join(numbers % v for v in values) + "]"
    links = "".join(
        f'[[plant.links]]\njoint = "revolute"\nalpha = {alpha!r}\na = {a}\nd = {d}\n'
        f"mass = {numbers % ball[0]}\nfirst_moment = {listed(ball[1])}\ninertia = {listed(ball[2])}\n"
        for _, alpha, a, d, _ in WRIST[:count]
    )
    listed = lambda letter: "[" + ", ".join(f'"{letter}{k + 1}"' for k in range(count)) + "]"
    columns = f"position = {listed('q')}\nforce = {listed('u')}\n"
    asked = "[identification]\nphysically_consistent = true\n" if consistent else ""
    return f'[plant]\nkind = "serial_arm"\n{links}{asked}[log]\ntime = "t"\n{columns}'


# Gains of a loop that moves the wrist, and its rate [Hz].
KP, KD, LOOP_RATE = [600.0, 150.0, 3.0], [30.0, 8.0, 0.15], 200.0


def flat_body() -> np.ndarray:
    """Return the ten parameters of points in a plane through the joint: the edge of what bodies can be."""
    mass, at = np.array([1.0, 0.5, 0.5]), np.array([[0.3, 0.0, 0.0], [0.1, 0.0, 0.1], [0.2, 0.0, -0.1]])
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(mass, at, strict=True))
    return np.concatenate([[mass.sum()], mass @ at, inertia[np.triu_indices(3)]])


# The first link, and a flat one at the second joint.
FLAT = np.array([TRUE[0], flat_body()])


def missed(found, bodies: np.ndarray) -> float:
    """RMS of the torque on another motion less the one that is predicted, in part of the former's."""
    _, q, qd, qdd, tau = torque(9, bodies)
    predicted = jax.vmap(found.estimate.machine.plant.inertial)(*(jnp.asarray(x) for x in (q, qd, qdd)))
    return float(np.sqrt(np.mean((tau - predicted) ** 2) / np.mean(tau**2)))


def looped(consistent: bool, count: int = 3) -> str:
    """Return the case of the first links in their loop."""
    law = f'[controller]\nkind = "pd"\nkp = {KP[:count]}\nkd = {KD[:count]}\nperiod = {1 / LOOP_RATE}\n'
    asked = case(True, count).replace("= true", f"= {str(consistent).lower()}")
    references = ", ".join(f'"r{k + 1}"' for k in range(count))
    return asked.replace("[log]\n", f"[log]\nreference = [{references}]\n") + law


def loop_log(seed: int = 0, of_noise: int = 3, bodies: np.ndarray = TRUE, noise: float = NOISE) -> Log:
    """Return a log of the first links in their loop, a link for each body, by the stepper.

    Readings and torque are noisy.
    """
    t, q, _, _ = motion(seed, LOOP_RATE)
    n = len(bodies)
    reference = q[:, :n] * np.minimum(1.0, t)[:, None] ** 3
    geometry = build_machine(load_case(tomllib.loads(looped(True))), period=1 / LOOP_RATE).plant.geometry
    axes, origins = (np.asarray(x) for x in geometry.frames(np.zeros(3)))
    arm = arm_stepper.Arm(axes[:n], origins[:n], bodies, np.zeros(n), np.zeros(n))
    run = arm_stepper.followed(arm, reference, rate=LOOP_RATE, kp=np.array(KP[:n]), kd=np.array(KD[:n]))
    rng = np.random.default_rng(of_noise)
    position = run["q"] + 1e-5 * rng.standard_normal(reference.shape)
    force = run["u"] + noise * rng.standard_normal(reference.shape)
    return Log(time=t, position=position, force=force, reference=reference, source=f"loop {seed}")


def one_link() -> str:
    """Return the case of the first link alone, whose joint lies level."""
    text = case(True)
    one = text[: text.index("[[plant.links]]", text.index("[[plant.links]]") + 1)]
    tail = text[text.index("[identification]") :].replace(', "q2", "q3"', "").replace(', "u2", "u3"', "")
    return one.replace('"serial_arm"', '"serial_arm"\ngravity_vector = [0.0, -9.81, 0.0]') + tail


def swing(seed: int) -> Log:
    """Return a log of the first link alone under a known torque, with noise of its readings."""
    true = TRUE[0]
    t = np.arange(0, 4, 1 / RATE)
    u = 3.0 * np.sin(2 * np.pi * 0.6 * t + seed) + 2.0 * np.sin(2 * np.pi * 1.4 * t)
    q, v, positions = 0.0, 0.0, []
    # The joint lies level: weight is g (-mx cos q + my sin q) about it.
    push = lambda q, u: (u - 9.81 * (true[1] * np.cos(q) - true[2] * np.sin(q))) / true[9]
    for now in u:
        positions.append(q)
        for _ in range(20):
            half = v + 0.5 / (20 * RATE) * push(q, now)
            q += half / (20 * RATE)
            v = half + 0.5 / (20 * RATE) * push(q, now)
    noisy = np.array(positions) + 1e-4 * np.random.default_rng(seed).standard_normal(len(t))
    return Log(time=t, position=noisy, force=u, source=f"swing {seed}")


def eigenvalues(found) -> np.ndarray:
    return eigenvalues_of(found.estimate.machine.plant)


def eigenvalues_of(plant) -> np.ndarray:
    """Return the eigenvalues of the pseudo-inertia of each link, by the oracle."""
    ten = np.stack([np.asarray(getattr(plant, name)) for name in arm_oracle.NAMES], axis=-1)
    return np.linalg.eigvalsh(arm_oracle.pseudo_inertias(ten))


def left(found, bodies: np.ndarray = TRUE) -> float:
    """RMS of a noisy torque on another motion less the one that is predicted, over the noise."""
    _, q, qd, qdd, tau = torque(9, bodies)
    noise = NOISE * np.random.default_rng(5).standard_normal(tau.shape)
    told = jax.vmap(found.estimate.machine.plant.inertial)(*(jnp.asarray(x) for x in (q, qd, qdd)))
    return float(np.sqrt(np.mean((tau + noise - told) ** 2)) / NOISE)
