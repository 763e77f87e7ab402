"""The 5R parallel robot: friction and drive gains identified in its loop, and fed forward.

Righettini et al., "Real Time MEMS-Based Joint Friction Identification for Enhanced Dynamic Performance in
Robotic Applications" (Robotics 14, 36). The robot is an exact-friction simulator that shares no code with
jaxid; what is not published is chosen, and stands in `five_bar_robot.py`. Its controller is `jaxid.Live`.

    python -m experiments.righettini_five_bar [-o FOLDER] [--only NAME]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxid
from experiments import five_bar_robot as robots
from experiments import righettini_figures
from experiments.common import Table, run_studies
from experiments.five_bar_robot import LOOK, PD, PERIOD, Ran, driven, robot
from experiments.righettini_logs import hidden, orders, payload
from jaxid.controllers.computed_torque import inverse_dynamics

ADAPTIVE = 'kind = "adaptive"\ngate_velocity = 0.05\nhalf_life = 600.0'
TORQUE = 'kind = "computed_torque"'
# Factors by which errors shrink from law to law, joints 1 and 2: RMS and peak.
PUBLISHED = {
    "computed torque": ((2.44, 2.04), (3.88, 3.78)),
    "adaptive": ((5.05, 3.68), (1.40, 1.97)),
}
# Friction when warm, over that when cold.
WARM = 0.7


def live_of(folder: Path, name: str, law: str, **stated: object) -> jaxid.Live:
    """Return the loop of a case that is written to the folder."""
    path = folder / f"{name}.toml"
    path.write_text(robots.case_text(law, **stated))
    return jaxid.Live(path)


def warmed(folder: Path, inertial: bool = True) -> tuple[jaxid.Live, Ran]:
    """Run the adaptive law for 20 s from no knowledge."""
    live = live_of(folder, "warming", ADAPTIVE, seed=9, duration=20.0, inertial=inertial)
    return live, driven(live, robot(), seed=9, inertial=inertial)


def sizes(ran: Ran, start: float = 0.0, end: float = 1e9) -> tuple[np.ndarray, np.ndarray]:
    """RMS and peak of the errors between two times, by joint [mrad]."""
    e = 1e3 * ran.error[round(start / PERIOD) : round(end / PERIOD)]
    return np.sqrt(np.mean(e**2, axis=0)), np.abs(e).max(axis=0)


def controllers(folder: Path) -> None:
    """PD, computed torque and adaptive over 40 s, drive gains compensated, friction steady or fluctuating."""
    begin = time.perf_counter()
    pair = lambda x: ", ".join(f"{v:.3g}" for v in x)
    table = Table(
        "Errors of both joints over 40 s, and by how much smaller than of the law above",
        ["friction", "law", "RMS [mrad]", "peak [mrad]", "RMS, over", "published", "peak, over", "published"],
    )
    warm, first = warmed(folder)
    table.row("steady", "adaptive, cold, first 2 s", *(pair(x) for x in sizes(first, 0.0, 2.0)), *[""] * 4)
    laws = {"PD": PD, "computed torque": TORQUE, "adaptive": ADAPTIVE}
    split, sizes_of = {}, {}
    for friction in ("steady", "fluctuating"):
        drift = robots.fluctuating(40.0, 7) if friction == "fluctuating" else None
        runs, before = {}, None
        for name, law in laws.items():
            gain = "{ guess = 1.0 }" if name == "adaptive" else warm.estimate.theta[:2].tolist()
            live = live_of(folder, name.replace(" ", "_"), law, gain=gain, seed=1)
            if name == "adaptive":
                live.memory = warm.memory
            runs[name] = driven(live, robot(), seed=1, drift=drift)
            rms, peak = sizes(runs[name])
            shown = [""] * 4
            if before is not None:
                published = PUBLISHED[name]
                over = before[0] / rms, before[1] / peak
                shown = [pair(over[0]), pair(published[0]), pair(over[1]), pair(published[1])]
            table.row(friction, name, pair(rms), pair(peak), *shown)
            before = sizes_of[friction, name] = (rms, peak)
        split[friction] = torques(runs["adaptive"])
        righettini_figures.errors(folder / f"errors_{friction}.png", runs)
    table.show(time.perf_counter() - begin)
    for k, what in enumerate(("rms", "peak")):
        groups = {f"{f} friction": {n: sizes_of[f, n][k] for n in laws} for f in split}
        righettini_figures.bars(folder / f"{what}.png", groups, f"{what} error [mrad]")
    righettini_figures.bars(folder / "split.png", split, "RMS torque [N m]")
    published = {"dynamics": (45, 48), "friction": (40, 33), "feedback": (15, 19)}
    table = Table("RMS torque by its part, % of the sum (figure 11)", ["part", *split, "published"])
    for part, values in published.items():
        shares = (100 * s[part] / sum(s.values()) for s in split.values())
        table.row(part, *(pair(x) for x in shares), pair(values))
    table.show(time.perf_counter() - begin)


def torques(ran: Ran) -> dict[str, np.ndarray]:
    """RMS torque of the joints by where it comes from [N m]: the model along the reference, and the rest."""
    machine = ran.live.machine.with_estimate(ran.live.estimate.theta)
    smooth, friction = robots.along(ran.live, lambda q, v, a: inverse_dynamics(machine.plant, q, v, a, 2))
    gains = ran.live.estimate.theta[:2]
    rest = robots.REDUCTION * gains * ran.command - smooth - friction
    return {
        name: np.sqrt(np.mean(x**2, axis=0))
        for name, x in (("dynamics", smooth), ("friction", friction), ("feedback", rest))
    }


def friction_of(names: list[str], theta: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Friction of both joints at some velocities above zero, (velocities, 2) [N m]."""
    kinds = robots.ORDERS[:4]
    entry = lambda kind, joint: names.index(f"{kind}[{joint}].{robots.PARAMETER.get(kind, 'coefficient')}")
    return sum(theta[[entry(kind, j) for j in (1, 2)]] * v[:, None] ** k for k, kind in enumerate(kinds))


def true_friction(v: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Likewise, of the robot's own joints."""
    return scale * sum(np.array(c[:2]) * v[:, None] ** k for k, c in enumerate(robots.FRICTION.values()))


# Velocities at which friction is compared [rad/s].
SPEEDS = np.linspace(0.2, 3.6, 18)


def settled(times: np.ndarray, off: np.ndarray, bound: float) -> float:
    """Time from which an error stays below a bound; infinite where it never does."""
    out = np.flatnonzero(off >= bound)
    if not len(out):
        return float(times[0])
    return float(times[out[-1] + 1]) if out[-1] + 1 < len(times) else np.inf


def convergence(folder: Path) -> None:
    """From gains of one and no friction: how soon, cold and warm, and with noise on the measured torque."""
    begin = time.perf_counter()
    table = Table(
        "Seconds until gains are within 2 %, friction within 5 % of its largest, for good; and at the end",
        ["temperature", "torque noise [N m]", "instrument", "gains", "friction", "gains off", "friction off"],
    )
    kept = {}
    for scale, noise, instrument in (
        (1.0, 0.0, "none"),
        (WARM, 0.0, "none"),
        (1.0, 0.5, "none"),
        (1.0, 0.5, "model"),
        (1.0, 2.0, "none"),
        (1.0, 2.0, "model"),
    ):
        law = ADAPTIVE + f'\ninstrument = "{instrument}"'
        live = live_of(folder, "cold", law, seed=2, duration=30.0)
        ran = driven(live, robot(scale), seed=2, torque_noise=noise)
        names, times = live.machine.parameters.names, LOOK * np.arange(len(ran.estimates))
        gains = np.abs(ran.estimates[:, :2] / robots.GAINS - 1).max(axis=1)
        true = true_friction(SPEEDS, scale)
        friction = np.array([np.abs(friction_of(names, e, SPEEDS) - true).max() for e in ran.estimates])
        friction /= true.max()
        table.row(
            "cold" if scale == 1.0 else "warm",
            noise,
            instrument,
            f"{settled(times, gains, 0.02):.2f}",
            f"{settled(times, friction, 0.05):.2f}",
            f"{gains[-1]:.2%}",
            f"{friction[-1]:.2%}",
        )
        if not noise:
            kept["cold" if scale == 1.0 else "warm"] = (names, times, ran)
    table.show(time.perf_counter() - begin)
    righettini_figures.histories(folder / "histories.png", kept)
    clouds = {state: seen(ran) for state, (_, _, ran) in kept.items()}
    names, _, ran = kept["cold"]
    speed, inferred, predicted, given, modelled, at = clouds["cold"]
    pairs = {"from torque and dynamics": (speed, inferred), "of the model found": (speed, predicted)}
    righettini_figures.frictions(folder / "friction_found.png", pairs, true_friction)
    pairs = {state: c[:2] for state, c in clouds.items()}
    righettini_figures.frictions(folder / "friction_by_temperature.png", pairs, true_friction)
    some = at < at[0] + 10.0
    righettini_figures.torques(folder / "torques.png", at[some], given[some], modelled[some])
    drawn_workspace(folder / "workspace.png", ran)


def seen(ran: Ran, every: int = 20) -> tuple[np.ndarray, ...]:
    """Identify friction from a run of the adapted law, at 200 Hz from its tenth second on.

    Returns:
        Velocities; friction, from torque given and dynamics without friction; that of the model found; torque
        given; that of dynamics and friction found, (time, 2) each; and the times.
    """
    machine = ran.live.machine.with_estimate(ran.live.estimate.theta)
    gains = robots.REDUCTION * ran.live.estimate.theta[:2]
    # A torque acts from its tick to the next; acceleration is the mean over that interval.
    rows = np.arange(round(10.0 / PERIOD), len(ran.q) - 1, every)
    middle = lambda x: 0.5 * (x[rows] + x[rows + 1])
    q, v, given = middle(ran.q), middle(ran.v), gains * ran.command[rows]
    parts = jax.jit(jax.vmap(lambda *x: inverse_dynamics(machine.plant, *x, 2)))(q, v, ran.a[rows + 1])
    smooth, friction = (np.asarray(x) for x in parts)
    return v, given - smooth, friction, given, smooth + friction, ran.time[rows]


def drawn_workspace(path: Path, ran: Ran) -> None:
    """Figure 4: the condition index is the ratio of the singular values of the tool's Jacobian, squared."""
    plant = ran.live.machine.plant

    def one(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        values = jnp.linalg.svd(jax.jacfwd(plant.tool)(q), compute_uv=False)
        return plant.tool(q), (values[1] / values[0]) ** 2

    both = jax.jit(jax.vmap(one))
    tool = lambda q: tuple(np.asarray(x) for x in both(q))
    r = ran.live.reference
    rests = np.flatnonzero(np.all(np.diff(r, axis=0) == 0, axis=1))
    starts = np.concatenate([[0], rests[1:][np.diff(rests) > 1], [len(r) - 1]])
    paths = [r[a:b:20] for a, b in zip(starts[:4], starts[1:5], strict=True)]
    righettini_figures.workspace(path, np.array(robots.POLYGON), paths, tool, 20 * PERIOD)


def temperature(folder: Path) -> None:
    """Friction that falls by 30 % in 60 s, a hundred times as fast as theirs: which half-life follows it."""
    begin = time.perf_counter()
    table = Table(
        "Friction falling by 30 % in 60 s, 0.5 N m of torque noise; errors in the last half",
        ["half-life [s]", "friction at 2 rad/s off, RMS", "RMS [mrad]"],
    )
    drift = lambda t: 1.0 - (1.0 - WARM) * min(t / 60.0, 1.0)
    for half_life in (0.1, 0.3, 1.0, 3.0, 10.0, 60.0):
        law = ADAPTIVE.replace("600.0", str(half_life))
        live = live_of(folder, "drift", law, seed=3, duration=60.0)
        ran = driven(live, robot(), seed=3, drift=drift, torque_noise=0.5)
        names, times = live.machine.parameters.names, LOOK * np.arange(len(ran.estimates))
        late = times > 30.0
        at = np.array([2.0])
        found = np.array([friction_of(names, e, at)[0] for e in ran.estimates[late]])
        true = np.array([true_friction(at, drift(t))[0] for t in times[late]])
        off = np.sqrt(np.mean((found / true - 1) ** 2))
        table.row(f"{half_life:g}", f"{off:.2%}", ", ".join(f"{x:.3g}" for x in sizes(ran, 30.0)[0]))
    table.show(time.perf_counter() - begin)


def sensors(folder: Path) -> None:
    """Encoders only against gyroscopes and accelerometers: named as future work in the paper."""
    begin = time.perf_counter()
    table = Table(
        "The adaptive law by what measures motion, last 20 of 40 s",
        ["sensors", "RMS [mrad]", "peak [mrad]", "trusted after [s]", "friction in 5 % after [s]",
         "gains off", "friction off"],
    )  # fmt: skip
    pair = lambda x: ", ".join(f"{v:.3g}" for v in x)
    for name, inertial, more in (
        ("encoders, over 2 ms", False, "\nvelocity_average = 4\nreach = 8"),
        ("encoders, over 8 ms", False, "\nvelocity_average = 4\nreach = 32"),
        ("gyroscopes, accelerometers", True, ""),
    ):
        live = live_of(folder, "sensors", ADAPTIVE + more, seed=6, inertial=inertial)
        ran = driven(live, robot(), seed=6, inertial=inertial)
        names, times = live.machine.parameters.names, LOOK * np.arange(len(ran.estimates))
        true = true_friction(SPEEDS)
        off = np.array([np.abs(friction_of(names, e, SPEEDS) - true).max() for e in ran.estimates])
        off /= true.max()
        gains = np.abs(ran.estimates[-1, :2] / robots.GAINS - 1).max()
        trusted = "never" if live.switched is None else f"{PERIOD * live.switched:.2f}"
        table.row(
            name,
            *(pair(x) for x in sizes(ran, 20.0)),
            trusted,
            f"{settled(times, off, 0.05):.2f}",
            f"{gains:.2%}",
            f"{off[-1]:.2%}",
        )
    table.show(time.perf_counter() - begin)


# By how much drive gains and friction differ from robot to robot, as a standard deviation; noise of the
# measured torque at the motor [N m].
TOLERANCE, TORQUE_NOISE = 0.05, 0.25 / robots.REDUCTION


def tolerances(folder: Path) -> None:
    """Simulate a thousand robots with drawn drive gains and friction, and show the errors at their end."""
    begin = time.perf_counter()
    true = lambda kind, k: f"{{ guess = 0.0, true = {robots.FRICTION[kind][k]} }}"
    more = (
        f"substeps = 1\n[sensor]\nposition_resolution = {robots.COUNTS}\nforce_noise = {TORQUE_NOISE}\n"
        f'[study]\nestimators = ["in_loop"]\nruns = 1000\ndraw = {TOLERANCE}\n'
    )
    path = folder / "tolerances.toml"
    path.write_text(
        robots.case_text(
            ADAPTIVE,
            friction=robots.friction_text(3, guess=true),
            seed=8,
            duration=8.0,
            more=more,
            gain=[f"{{ guess = 1.0, true = {g} }}" for g in robots.GAINS],
        )
    )
    out = folder / "tolerances"
    study = jaxid.study(path, folder=out, resume=out.exists())
    print(f"{study}\n{time.perf_counter() - begin:.0f} s")


STUDIES: dict[str, Callable[[Path], None]] = {
    f.__name__: f
    for f in (controllers, convergence, temperature, orders, payload, hidden, sensors, tolerances)
}


if __name__ == "__main__":
    run_studies(__doc__, "results/righettini_five_bar", STUDIES)
