"""An oracle for hidden effects of a chain, from its exact forces; see `truth.hidden.oracle`.

Forces at all masses are stacked, since a spring that two of them share ties their balances
together. Each is whitened by itself: neighbours read each other's position noise through a spring,
which is small beside the noise of the drive and is left out.
"""

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from truth.chain.stepper import SPRING_EFFECTS, ChainMachine, elongations, name_of
from truth.hidden.chains import ChainCase, ChainSetup
from truth.hidden.oracle import (
    TIED_NATS,
    Sight,
    View,
    Whitener,
    evidence_beyond,
    explained_away,
    faded,
    moving,
)

Log = Mapping[str, np.ndarray]


def sights(case: ChainCase) -> dict[str, Sight]:
    """Return the evidence of the hidden kind on the logs that are given; empty for a null.

    Kind and place are named as results name them, in the ties too.
    """
    if not case.hidden:
        return {}
    views = [view(case, v) for v in ((False, True) if case.validated else (False,))]
    seen = Sight(tuple(v.evidence for v in views), tuple(v.share for v in views), tuple(_ties(views)))
    return {case.names[0]: seen}


def view(case: ChainCase, validation: bool) -> View:
    """Return the hidden effect as one log shows it."""
    setup = case.setup(validation=validation)
    log = setup.run()
    baseline, rivals = baseline_forces(case, log), rival_forces(case, log)
    own = effect_force(case.what, case.place, setup.machine, log)
    fades = fading(log)
    noises = [functools.partial(noise_density, i) for i in range(case.count)]
    whiten = [Whitener(setup, fades[:, i], noise) for i, noise in enumerate(noises)]
    stacked = np.stack([own, *baseline, *rivals.values()], axis=-1)
    rows = np.concatenate([w(stacked[:, i]) for i, w in enumerate(whiten)])
    end = 1 + len(baseline)
    left = explained_away(_flat(fades, baseline), _flat(fades, [own])[:, 0])
    acts = np.any(own != 0.0, axis=0)
    total = (fades * moving_force(setup.machine, log))[:, acts]
    share = np.linalg.norm(left.reshape(own.shape)[:, acts]) / np.linalg.norm(total)
    others = dict(zip(rivals, rows[:, end:].T, strict=True))
    return View(rows[:, 0], rows[:, 1:end], others, float(share))


def _flat(fades: np.ndarray, forces: Sequence[np.ndarray]) -> np.ndarray:
    return np.column_stack([(fades * force).ravel() for force in forces])


def _ties(views: Sequence[View]) -> list[str]:
    """Return the rivals that explain nearly all, with one set of parameters for all logs."""
    names = list(views[0].rivals)
    stacked = [np.column_stack([v.force, *(v.rivals[name] for name in names)]) for v in views]
    columns = np.concatenate([v.columns for v in views])
    left, *others = explained_away(columns, np.concatenate(stacked)).T
    evidence = [evidence_beyond(other[:, None], left) for other in others]
    return sorted(n for n, e in zip(names, evidence, strict=True) if e < TIED_NATS)


def fading(log: Log) -> np.ndarray:
    """Return the weight of each sample of each mass (time, n): zero while that mass is at rest."""
    return np.column_stack([faded(moving(v)) for v in log["true_velocity"].T])


def moving_force(machine: ChainMachine, log: Log) -> np.ndarray:
    """Return the force of the drives, and of the springs for masses without drive (time, n) [N]."""
    out = np.diff(elongations(log["true_position"]) * machine.stiffness, axis=1)
    out[:, machine.driven] = log["true_force"][:, machine.driven]
    return out


def noise_density(i: int, setup: ChainSetup, f: np.ndarray) -> np.ndarray:
    """Return the one-sided density of a log's noise in the balance at mass i (from 0) [N^2/Hz]."""
    sensor, machine = setup.sensor, setup.machine
    w, k = 2.0 * np.pi * f, np.asarray(machine.stiffness)
    drag = machine.damping[i] * w
    through = np.abs(k[i] + k[i + 1] - machine.mass[i] * w**2 + 1j * drag) ** 2
    through += sum(k[j] ** 2 for j in (i, i + 1) if 0 < j < machine.count)
    position = sensor.position_noise**2 + sensor.position_resolution**2 / 12.0
    drive = sum(g**2 for d, g in zip(machine.driven, machine.gains, strict=True) if d == i)
    return 2.0 / setup.rate * (through * position + drive * sensor.force_noise**2)


def at_mass(i: int, force: np.ndarray, count: int) -> np.ndarray:
    """Return a force that acts on mass i alone (from 0), as (time, n)."""
    out = np.zeros((len(force), count))
    out[:, i] = force
    return out


def of_spring(j: int, tension: np.ndarray, count: int) -> np.ndarray:
    """Return the tension of spring j (from 0), which pulls mass j back and mass j - 1 on, as (time, n)."""
    return np.diff(at_mass(j, tension, count + 1), axis=1)


def baseline_forces(case: ChainCase, log: Log) -> list[np.ndarray]:
    """Return the forces that the case's unknowns explain: masses, dampings, springs, declared friction."""
    n, v, a = case.count, log["true_velocity"], log["true_acceleration"]
    e = elongations(log["true_position"])
    out = [at_mass(i, x[:, i], n) for x in (a, v) for i in range(n)]
    out += [of_spring(j, e[:, j], n) for j in range(n + 1)]
    return out + [at_mass(i - 1, np.sign(v[:, i - 1]), n) for _, i in case.declared]


def rival_forces(case: ChainCase, log: Log) -> dict[str, np.ndarray]:
    """Return the forces of every other effect with one parameter, by kind and place."""
    n, t, e = case.count, log["t"], elongations(log["true_position"])
    out = {}
    for i in range(n):
        v, u = log["true_velocity"][:, i], log["true_force"][:, i]
        side = np.sign(v)
        shapes = {
            "coulomb_friction": side, "asymmetric_viscous": np.abs(v), "quadratic_drag": v * np.abs(v),
            "cubic_friction": v**3, "quartic_friction": v**3 * np.abs(v),
            "constant_force": np.ones_like(v), "friction_drift": t * side,
        }  # fmt: skip
        if i in case.machine.driven:
            shapes["input_delay"] = np.diff(u, prepend=0.0)
            # The gain of the only drive is but a factor on all that the baseline has.
            shapes |= {"actuator_gain": u} if len(case.machine.driven) > 1 else {}
        out |= {(kind, i + 1): at_mass(i, force, n) for kind, force in shapes.items()}
    for kind, power in SPRING_EFFECTS.items():
        out |= {(kind, j + 1): of_spring(j, e[:, j] ** power, n) for j in range(n + 1)}
    without = {*case.declared, (case.what, case.place)}
    return {name_of(*place): force for place, force in out.items() if place not in without}


def effect_force(kind: str, place: int, machine: ChainMachine, log: Log) -> np.ndarray:
    """Return the force of one effect along a run, from the truth (time, n) [N]."""
    values, n, i = machine.effects[kind, place], machine.count, place - 1
    if kind in SPRING_EFFECTS:
        e = elongations(log["true_position"])[:, i]
        return of_spring(i, values["coefficient"] * e ** SPRING_EFFECTS[kind], n)
    q, v = log["true_position"][:, i], log["true_velocity"][:, i]
    side = np.sign(v)
    shapes = {
        "coulomb_friction": lambda level: -level * side,
        "quadratic_drag": lambda coefficient: -coefficient * v * np.abs(v),
        "constant_force": lambda level: np.full_like(v, level),
        "stribeck_friction": lambda level, velocity: -level * side * np.exp(-((v / velocity) ** 2)),
        "cogging": lambda amplitude, period, phase: -amplitude * np.cos(2.0 * np.pi * q / period + phase),
    }
    return at_mass(i, shapes[kind](**values), n)
