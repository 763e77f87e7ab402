"""Figures of the micropositioning stage."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from jaxid.build import build_machine
from jaxid.case.case import Case, load_case
from jaxid.commands.identify import Identification
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.scene import Scene
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import closed_loop
from truth.chain import stages

# The move of data 1, for a simulation by jaxid itself.
SIMULATED = f"""[reference]
kind = "trapezoid"
targets = [{stages.MOVES[1]["distance"] / stages.R}]
speed = {stages.MOVES[1]["speed"] / stages.R}
acceleration = {stages.MOVES[1]["speed"] / stages.R / stages.RAMP}
repeat = false
[simulation]
duration = 0.5
sample_rate = {stages.RATE}
"""


def fit(path: Path, found: Identification, data: int) -> None:
    """Figure 5: measured and simulated current, and their squared difference."""
    log, gain = found.session.fit.log, float(found.session.machine.gain[0])
    current, e = log.force[:, 0], found.estimate.residual[:, 0] / gain
    figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    axes.plot(log.time, current, "r", label="measured")
    axes.plot(log.time, current - e, "k", label="simulated")
    axes.set(xlabel="time [s]", ylabel="current [A]", title=f"Data {data}")
    right = axes.twinx()
    right.plot(log.time, e**2, "b", lw=0.8, label="squared difference")
    right.set(ylabel="squared difference [A²]", ylim=(0, 5 * np.max(e**2)))
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def needles(path: Path, case: Case) -> None:
    """Cost along the inertia and the table's friction, with the encoder's rounding simulated and without."""
    scene = Scene.of(case)
    machine, unknown = scene.machine, scene.machine.parameters

    @eqx.filter_jit
    def current(theta: jax.Array, sensor: Sensor) -> jax.Array:
        plant = scatter(unknown.places, machine.plant, theta)
        rest = jnp.zeros(1)
        none = jnp.zeros_like(scene.signal)
        return closed_loop(
            plant, scene.drive, machine.controller, scene.signal, none, rest, rest, sensor
        ).command[:, 0]

    figure, panes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axes, name in zip(panes, ("motor_inertia", "coulomb_friction[2].level"), strict=True):
        k, off = unknown.names.index(name), np.linspace(-0.1, 0.1, 401)
        theta = np.tile(unknown.guess, (off.size, 1))
        theta[:, k] *= 1 + off
        for label, sensor in (("rounded", machine.sensor), ("not rounded", Sensor())):
            runs = np.asarray(jax.vmap(lambda t, s=sensor: current(t, s))(jnp.asarray(theta)))
            truth = runs[off.size // 2]
            criterion = 100 * np.sum((runs - truth) ** 2, axis=1) / np.sum((truth - truth.mean()) ** 2)
            axes.plot(100 * off, criterion, label=label, lw=1)
        axes.set(xlabel=f"{name}, off [%]", ylabel="criterion without noise [%]")
        axes.axhline(stages.CRITERION[1], color="0.6", ls="--", lw=0.8)
    panes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def frictions(path: Path) -> None:
    """Figures 3 and 6: friction at the motor, by the plant's balance, while it speeds up and slows down."""
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    turns = np.linspace(-0.5, 0.5, 400)
    for data, colour in ((1, "r"), (2, "b")):
        case = path.with_name(f"friction{data}.toml")
        case.write_text(stages.text(data, resolution=0.0))
        plant = build_machine(load_case(case), period=1 / stages.RATE).plant
        # A quarter turn from where the ripple of position is at its largest.
        q = jnp.asarray([0.5 * np.pi - stages.TRUTH[data]["cogging[2].phase"]])

        def friction(velocity: jax.Array, way: float, plant: Plant = plant, q: jax.Array = q) -> jax.Array:
            u = jnp.zeros(1)
            a = 1e-9 * way * jnp.sign(velocity)
            own = plant.initial_states(u)
            return plant.balance(q, velocity[None], a[None], u, jnp.zeros(()), own).residual[0]

        for way, line, name in ((1.0, "-", "speeding up"), (-1.0, "--", "slowing down")):
            torque = jax.vmap(lambda v, way=way, f=friction: f(v, way))(stages.TURN * jnp.asarray(turns))
            axes.plot(turns, 1e3 * np.asarray(torque), colour + line, label=f"data {data}, {name}")
    axes.set(xlabel="velocity of the motor [rev/s]", ylabel="friction at the motor [mN m]")
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
