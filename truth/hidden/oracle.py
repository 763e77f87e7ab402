"""An oracle for hidden effects: how well the best reader of a log could see one.

It uses the exact force of the stepper and the true spectrum of the noise, nothing estimated. The stepper's
truth gives the force that the case's effects cannot explain, for any of their parameters; a matched filter in
noise of known spectrum gives the evidence. So what counts as visible is settled
before jaxid reads the log.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from truth.axis.machines import Setup
from truth.axis.stepper import STANDARD_GRAVITY
from truth.hidden.cases import HiddenCase

Log = Mapping[str, np.ndarray]
VISIBLE_NATS = 30.0
TIED_NATS = 3.0
# Below this part of the force, what a hold between samples and a filter leave wrong in any model
# is as large as the effect: a reading of the log at its samples is then no proof of anything.
VISIBLE_SHARE = 0.01
_REST = 5e-3  # of the RMS velocity; slower samples count as at rest
_RAMP = 8  # samples over which a stretch of motion fades in
DRIVES = ("actuator_gain", "actuator_lag", "input_delay", "saturation")


@dataclasses.dataclass(frozen=True)
class Sight:
    """Evidence of a hidden effect.

    Attributes:
        evidence: Log-likelihood beyond the best baseline [nats], by log; of the balance at the
            samples and of that between them, the lesser.
        share: RMS of the unexplained force over that of the force, by log.
        ties: Effects of one parameter that explain it as well.
    """

    evidence: tuple[float, ...]
    share: tuple[float, ...]
    ties: tuple[str, ...]

    @property
    def visible(self) -> bool:
        """Check that every log shows the effect."""
        return min(self.evidence) >= VISIBLE_NATS and min(self.share) >= VISIBLE_SHARE


def sights(case: HiddenCase) -> dict[str, Sight]:
    """Return the evidence of each hidden kind beside the others, on the logs that are given.

    A disturbance from outside the vocabulary goes by the case's `what`; a null has none.
    """
    roles = (False, True) if case.validated else (False,)
    setups = [case.setup(validation=v) for v in roles]
    logs = [setup.run() for setup in setups]
    kinds = case.hidden or ((case.what,) if case.group == "outside" else ())
    return {kind: _sight(case, kind, setups, logs) for kind in kinds}


def _sight(case: HiddenCase, kind: str, setups: Sequence[Setup], logs: Sequence[Log]) -> Sight:
    views = [View.of(case, kind, s, log) for s, log in zip(setups, logs, strict=True)]
    evidence = tuple(
        min(v.evidence, v.evidence if kind == "static_friction" else between(case, kind, s, log))
        for v, s, log in zip(views, setups, logs, strict=True)
    )
    rivals = {k for k in views[0].rivals if k != kind and k not in case.declared}
    ties = sorted(k for k in rivals if _left(views, k) < TIED_NATS)
    return Sight(evidence, tuple(v.share for v in views), tuple(ties))


def _left(views: Sequence["View"], rival: str) -> float:
    """Return the evidence that a rival leaves, with one set of parameters for all logs [nats]."""
    columns = np.concatenate([np.column_stack([v.columns, v.rivals[rival]]) for v in views])
    return evidence_beyond(columns, np.concatenate([v.force for v in views]))


@dataclasses.dataclass(frozen=True)
class View:
    """One log, whitened: rows of unit noise.

    Attributes:
        force: Declared force.
        columns: What the baseline can explain.
        rivals: Column of each effect of one parameter.
        share: See `Sight`.
    """

    force: np.ndarray
    columns: np.ndarray
    rivals: Mapping[str, np.ndarray]
    share: float

    @property
    def evidence(self) -> float:
        """Evidence beyond the baseline [nats]."""
        return evidence_beyond(self.columns, self.force)

    @classmethod
    def of(cls, case: HiddenCase, kind: str, setup: Setup, log: Log) -> "View":
        """Return the view of one hidden kind in a log, the forces of the others known."""
        gain, inertia = setup.machine.actuator_gain, setup.machine.inertia
        force = gain * log["true_command"]
        others = [effect_force(k, setup, log) for k in case.hidden if k != kind]
        baseline = np.column_stack([*baseline_columns(case, setup, log), *others])
        if case.inertia_known:
            force = force - inertia * log["true_acceleration"]
        if kind == "static_friction":
            force, fade = _beyond_coulomb(setup, log), np.ones(len(force))
            baseline = np.zeros((len(force), 1))
        else:
            fade = faded(moving(log["true_velocity"]))
        left = explained_away(fade[:, None] * baseline, fade * force)
        total = fade * gain * log["true_command"]
        whiten = Whitener(setup, fade)
        return cls(
            whiten(force),
            whiten(baseline),
            {k: whiten(column) for k, column in one_parameter(case, setup, log).items()},
            float(np.linalg.norm(left) / np.linalg.norm(total)),
        )


def between(case: HiddenCase, kind: str, setup: Setup, log: Log) -> float:
    """Return the evidence of the balance between samples of a log of positions [nats].

    A log holds no acceleration but the second difference of its positions, which is the acceleration
    averaged over two periods. A ripple that is faster than half the sampling rate stands in the
    acceleration at the samples as a slow one, in that average hardly at all.
    """
    q, u = log["true_position"], setup.machine.actuator_gain * log["true_command"]
    acceleration = np.gradient(log["true_velocity"]) * setup.rate
    acceleration[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) * setup.rate**2
    averaged = dict(log) | {"true_acceleration": acceleration}
    columns = [c if c is acceleration else _averaged(c) for c in baseline_columns(case, setup, averaged)]
    for other in case.hidden:
        if other != kind:
            mean = _of_held if other in DRIVES else _averaged
            columns.append(mean(effect_force(other, setup, log)))
    force = _of_held(u) - (setup.machine.inertia * acceleration if case.inertia_known else 0.0)
    fade = faded(moving(log["true_velocity"]))
    whiten = Whitener(setup, fade, averaged_noise)
    return evidence_beyond(whiten(np.column_stack(columns)), whiten(force))


def _of_held(x: np.ndarray) -> np.ndarray:
    """Average a signal that is held from its sample on, as `_averaged` does a smooth one."""
    return np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1])])


def _averaged(x: np.ndarray) -> np.ndarray:
    """Average a smooth signal over two periods with the weights of a second difference."""
    return np.concatenate([x[:1], (x[:-2] + 4.0 * x[1:-1] + x[2:]) / 6.0, x[-1:]])


class Whitener:
    """From a signal to its spectrum in units of the noise, gaps faded out.

    The gaps smear the noise, which rises with the fourth power of frequency, over the whole
    spectrum: it is the smeared one that counts.
    """

    def __init__(self, setup: Setup, fade: np.ndarray, density: Callable | None = None):
        size = 2 * len(fade)  # so that the correlation does not wrap around
        two_sided = (density or noise_density)(setup, np.fft.rfftfreq(size, 1.0 / setup.rate)) / 2.0
        noise = np.fft.irfft(two_sided, size)
        overlap = np.fft.irfft(np.abs(np.fft.rfft(fade, size)) ** 2, size)
        smeared = np.fft.rfft(noise * overlap).real[::2]
        self.scale = np.sqrt(np.maximum(smeared, 1e-12 * smeared.max()) * setup.rate)
        self.fade = fade

    def __call__(self, signals: np.ndarray) -> np.ndarray:
        """Return rows whose sum of squares is twice the evidence; one column a signal."""
        fade = self.fade.reshape(-1, *[1] * (signals.ndim - 1))
        scale = self.scale.reshape(-1, *[1] * (signals.ndim - 1))
        rows = np.fft.rfft(fade * signals, axis=0) / scale
        # Of a real signal every line but the first stands for two.
        rows[1:] *= np.sqrt(2.0)
        return np.concatenate([rows.real, rows.imag])


def noise_density(setup: Setup, f: np.ndarray) -> np.ndarray:
    """Return the one-sided density of a log's noise in the balance of forces [N^2/Hz]."""
    return _density(setup, 2.0 * np.pi * f, np.ones_like(f))


def averaged_noise(setup: Setup, f: np.ndarray) -> np.ndarray:
    """Return the density for the balance between samples: differences for derivatives, commands in pairs."""
    half = np.pi * f / setup.rate
    return _density(setup, 2.0 * np.sin(half) * setup.rate, np.cos(half))


def _density(setup: Setup, w: np.ndarray, of_command: np.ndarray) -> np.ndarray:
    sensor, machine = setup.sensor, setup.machine
    drag = machine.effects.get("viscous_friction", {}).get("coefficient", 0.0)
    impedance = np.abs(-machine.inertia * w**2 + 1j * drag * w) ** 2
    position = sensor.position_noise**2 + sensor.position_resolution**2 / 12.0
    command = (of_command * machine.actuator_gain * sensor.force_noise) ** 2
    return 2.0 / setup.rate * (impedance * position + command)


def evidence_beyond(columns: np.ndarray, force: np.ndarray) -> float:
    """Return half the sum of squares that no combination of the columns explains [nats]."""
    return 0.5 * float(np.sum(explained_away(columns, force) ** 2))


def explained_away(columns: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the part of a force that no combination of the columns explains."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    return force - columns @ np.linalg.lstsq(columns, force, rcond=1e-12)[0]


def moving(velocity: np.ndarray) -> np.ndarray:
    """Return which samples are not practically at rest."""
    return np.abs(velocity) > _REST * np.sqrt(np.mean(velocity**2))


def faded(counts: np.ndarray) -> np.ndarray:
    """Return the weight of each sample: zero if it does not count, one a few samples inside, smooth."""
    ramp = np.hanning(_RAMP + 1)[1:]
    inside = np.convolve(counts, np.ones(_RAMP), "same") > _RAMP - 0.5
    return np.convolve(inside, ramp / ramp.sum(), "same")


def baseline_columns(case: HiddenCase, setup: Setup, log: Log) -> list[np.ndarray]:
    """Return the forces that the case's unknowns can explain."""
    v, side = log["true_velocity"], np.sign(log["true_velocity"])
    columns = [] if case.inertia_known else [log["true_acceleration"]]
    for kind in case.declared:
        if kind == "stribeck_friction":
            wide = (v / setup.machine.effects[kind]["velocity"]) ** 2
            # The second lets the velocity be off, to first order.
            columns += [side * np.exp(-wide), side * wide * np.exp(-wide)]
        else:
            columns.append({"viscous_friction": v, "coulomb_friction": side}[kind])
    return columns


def one_parameter(case: HiddenCase, setup: Setup, log: Log) -> dict[str, np.ndarray]:
    """Return the column of every effect with one parameter, linearised near its neutral value."""
    q, v, side = log["true_position"], log["true_velocity"], np.sign(log["true_velocity"])
    force = setup.machine.actuator_gain * log["true_command"]
    out = {
        "viscous_friction": v,
        "coulomb_friction": side,
        "asymmetric_viscous": np.abs(v),
        "quadratic_drag": v * np.abs(v),
        "cubic_friction": v**3,
        "quartic_friction": v**3 * np.abs(v),
        "constant_force": np.ones_like(v),
        "linear_stiffness": q,
        "quadratic_stiffness": q**2,
        "cubic_stiffness": q**3,
        "added_mass": log["true_acceleration"],
        "input_delay": force - np.concatenate([[0.0], force[:-1]]),
    }
    if case.inertia_known:  # else a gain is but a factor on all that the baseline has
        out["actuator_gain"] = force
    if "coulomb_friction" in case.declared:
        out["friction_drift"] = log["t"] * side
    return out


def effect_force(kind: str, setup: Setup, log: Log) -> np.ndarray:
    """Return the force of one effect along a run, from the truth [N]."""
    if kind in DRIVES:
        return log["true_force"] - setup.machine.actuator_gain * log["true_command"]
    if kind == "hysteresis":
        # What the balance leaves: the presliding state is not logged.
        rest = [effect_force(k, setup, log) for k in setup.machine.effects if k not in (kind, *DRIVES)]
        return setup.machine.inertia * log["true_acceleration"] - log["true_force"] - sum(rest)
    values, q, v = setup.machine.effects[kind], log["true_position"], log["true_velocity"]
    side = np.sign(v)
    if kind == "cogging":
        return -values["amplitude"] * np.cos(2 * np.pi * q / values["period"] + values["phase"])
    if kind == "unbalance":
        return -values["moment"] * STANDARD_GRAVITY * np.cos(q + values["phase"])
    if kind == "stribeck_friction":
        return -values["level"] * side * np.exp(-((v / values["velocity"]) ** 2))
    if kind == "friction_drift":
        return -values["rate"] * log["t"] * setup.machine.effects["coulomb_friction"]["level"] * side
    (value,) = values.values()
    shape = {
        "viscous_friction": -v, "coulomb_friction": -side, "asymmetric_viscous": -np.abs(v),
        "quadratic_drag": -v * np.abs(v), "cubic_friction": -(v**3),
        "quartic_friction": -(v**3) * np.abs(v), "constant_force": np.ones_like(v),
        "linear_stiffness": -q, "quadratic_stiffness": -(q**2), "cubic_stiffness": -(q**3),
        "added_mass": -log["true_acceleration"], "static_friction": np.zeros_like(v),
    }  # fmt: skip
    return value * shape[kind]


def _beyond_coulomb(setup: Setup, log: Log) -> np.ndarray:
    """Return the force on a resting axis beyond Coulomb friction: only it determines static friction."""
    net = setup.machine.actuator_gain * log["true_command"]
    level = setup.machine.effects["coulomb_friction"]["level"]
    resting = log["true_velocity"] == 0.0
    return np.where(resting, np.sign(net) * np.maximum(np.abs(net) - level, 0.0), 0.0)
