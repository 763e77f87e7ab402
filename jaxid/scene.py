"""Simulated logs of a case: from reference or input to the readings of the sensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.case.kinds import is_user_class
from jaxid.case.user_faults import where_not_finite
from jaxid.errors import InputError
from jaxid.files import write_whole
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.references import make_reference
from jaxid.schema import stated
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.loops import Drive, Trajectory, closed_loop, needed_substeps, open_loop
from jaxid.simulation.reference_course import reference_at


@dataclass(frozen=True)
class SimulatedLog:
    """A simulated log.

    Args:
        log: The log that the sensors would have recorded.
        trajectory: The motion behind it, without noise, one row a tick.
        columns: Names of the columns, as the case's [log] has them; else q, u, ref, or q1, q2 and so on.
    """

    log: Log
    trajectory: Trajectory
    columns: dict[str, str | list[str]]

    def csv(self) -> str:
        """Return the log as a table with a header, every digit kept."""
        log = self.log
        load = "load_position" in self.columns
        known = log.position[:, list(log.measured)]
        parts = {"time": log.time[:, None], "position": known[:, :-1] if load else known}
        parts |= {"load_position": known[:, -1:]} if load else {}
        parts["force"] = log.force
        if log.reference is not None:
            parts["reference"] = log.reference
        header = []
        for key, values in parts.items():
            names = self.columns[key]
            header += [names] if isinstance(names, str) else [*names]
            if values.shape[1] != (1 if isinstance(names, str) else len(names)):
                raise InputError(
                    f"[log] {key} names {names!r} for {values.shape[1]} columns",
                    hint="give a list with one name a joint",
                )
        rows = np.concatenate([*parts.values()], axis=1)
        lines = [",".join(repr(float(v)) for v in row) for row in rows]
        return "\n".join([",".join(header), *lines]) + "\n"

    def save(self, path: str | Path) -> Path:
        """Write the log as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)


@dataclass(frozen=True)
class Scene:
    """A case set up for simulation, with any values of its parameters.

    Args:
        case: The case.
        machine: Machine at its true values, if it has any.
        drive: Path of the command to the plant.
        signal: Reference (in a loop) or input at every tick, by drive.
        position, velocity: State of the joints at the start.
        every: The log holds one tick in so many.
    """

    case: Case
    machine: Machine
    drive: Drive
    signal: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    every: int = 1

    @classmethod
    def of(cls, case: Case, *, longer_delays: float = 1.0) -> Scene:
        """Set up the simulation of a case.

        Args:
            case: The case.
            longer_delays: Factor by which drawn delays may exceed those of the case.

        Raises:
            InputError: If the case lacks reference, input, duration or sample_rate.
        """
        where, setting = case.where, case.simulation
        if case.log is not None and case.log.load_acceleration is not None:
            raise InputError(
                "a simulated log has no load_acceleration",
                where=f"{where}, [log]",
                hint="leave it out of the case that is simulated",
            )

        rate, duration = sampling_of(case)
        machine = build_machine(case, at_truth=True, period=1 / rate)
        joints = case.plant.joints
        position = np.broadcast_to(np.asarray(setting.initial_position), joints)
        velocity = np.broadcast_to(np.asarray(setting.initial_velocity), joints)
        refuse_impossible(machine.plant, position[None], f"{where}, [simulation] initial_position")
        _refuse_massless(machine.plant, position, where)

        if machine.controller is None:
            if not case.input:
                raise InputError(
                    "nothing drives the plant",
                    where=where,
                    hint="add an [input], or a [reference] and a [controller]",
                )
            command = make_reference(
                case.input, rate, duration, case.folder, where=f"{where}, [input]", plant=machine.plant
            )
            drive = _drive(case, machine, 1 / rate, longer_delays)
            return cls(case, machine, drive, _by_drive(command, machine), position, velocity)

        if not case.reference:
            raise InputError("there is nothing to follow", where=where, hint="add a [reference]")
        period = machine.controller.period
        reference = make_reference(
            case.true_reference or {},
            1 / period,
            duration,
            case.folder,
            where=f"{where}, [reference]",
            plant=machine.plant,
        )
        reference = _by_drive(reference, machine)
        if reference.shape[1] == joints:
            refuse_impossible(machine.plant, reference, f"{where}, [reference]", period)
        machine = _scaled(machine, reference, period)
        drive = _drive(case, machine, period, longer_delays)
        _refuse_coarse(case, machine, drive, reference, position)

        every = max(1, round(1 / (rate * period)))
        if abs(1 / (rate * period * every) - 1) > 1e-3:
            raise InputError(
                f"a loop of {1 / period:g} Hz cannot be logged at sample_rate = {rate:g}",
                where=where,
                hint="take the loop's rate, or a whole part of it",
            )
        reference = _as_logged(case, reference, every)
        return cls(case, machine, drive, reference, position, velocity, every)

    def simulated_log(self, machine: Machine, rng: np.random.Generator) -> Steps[SimulatedLog]:
        """Simulate the log of a machine like the scene's, one run at a time.

        Args:
            machine: Machine whose plant and sensor replace those of the scene.
            rng: Generator of the sensors' noise.
        """
        joints = self.case.plant.joints
        # A law that measures the command sees the noise that the log has.
        measures = "estimator" in type(machine.controller).of_machine if machine.controller else False
        inertial, drives = machine.sensor.inertial, machine.gain.size
        columns = joints + drives * (measures or inertial is not None)
        columns += 0 if inertial is None else inertial.count
        noise = rng.standard_normal((len(self.signal), columns))
        times = self.drive.period * np.arange(len(self.signal))

        start, sensor = (self.position, self.velocity), (machine.sensor, noise)
        looped = machine.controller is not None
        signal = self.signal
        if looped:
            extra = disturbance_at(machine.disturbance, times)
            if machine.unknown_reference is not None:
                signal = np.asarray(machine.unknown_reference.at(times)())
            args = (machine.plant, self.drive, machine.controller, signal, extra, *start, *sensor)
            run = yield SolveRequest(_closed_run, args)
        else:
            sensor = (machine.sensor, noise[:, :joints])
            run = yield SolveRequest(_open_run, (machine.plant, self.drive, self.signal, *start, *sensor))

        _refuse_ended(machine.plant, run, self.drive.period, self.case.where)
        pick = slice(None, None, self.every)
        reference = signal[pick] if looped else None
        reading, command = (np.asarray(x)[pick] for x in (run.reading, run.command))
        shape = command.shape if machine.sensor.force_noise is not None else (0, 0)
        more = noise[pick, joints : joints + drives] if measures else rng.standard_normal(shape)
        log = _log(self.case, machine, times[pick], reading, command, more, reference)
        return SimulatedLog(log, run, _columns(self.case, reference=looped))


_closed_run = eqx.filter_jit(closed_loop)


@eqx.filter_jit
def _open_run(
    plant: Plant,
    drive: Drive,
    command: Array,
    position: Array,
    velocity: Array,
    sensor: Sensor,
    noise: Array,
) -> Trajectory:
    run = open_loop(plant, drive, command, position, velocity)
    return eqx.tree_at(lambda r: r.reading, run, sensor.read(run.position, noise))


def sampling_of(case: Case) -> tuple[float, float]:
    """Return the sampling rate [Hz] and the duration [s] of a simulation.

    Raises:
        InputError: If [simulation] lacks one of them.
    """
    rate, duration = case.simulation.sample_rate, case.simulation.duration
    if rate is None or duration is None:
        name = "duration" if duration is None else "sample_rate"
        hint = f"add {name} = ... to [simulation]"
        raise InputError(f"[simulation] has no {name}", where=case.where, hint=hint)
    return rate, duration


def _as_logged(case: Case, reference: np.ndarray, every: int) -> np.ndarray:
    """Return the reference of a loop faster than its log, whose course between rows the case may state.

    Args:
        case: The case.
        reference: Reference at every tick, (ticks, drives).
        every: Number of ticks per row of the log.
    """
    stated = None if case.log is None else case.log.reference_hold
    if every == 1 or stated not in ("zero_order", "linear"):
        return reference
    ticks = np.arange(len(reference), dtype=np.float64)
    return reference_at(ticks[::every], reference[::every], ticks, stated)


def _by_drive(signal: np.ndarray, machine: Machine) -> np.ndarray:
    """Return one signal for every drive, if there is one for all."""
    return np.broadcast_to(signal, (len(signal), machine.gain.size))


def _drive(case: Case, machine: Machine, period: float, longer: float) -> Drive:
    """Return the integration of a log: friction sticks exactly, unless the case states a sharpness."""
    delayed = any(e.delays_command() for e in machine.plant.effects)
    delays = machine.plant.command_delays(machine.gain.size)
    longest = int(np.ceil(longer * float(delays.max()) / period)) + 1 if delayed else 0
    hold = "linear" if machine.hold == "band_limited" else machine.hold
    return Drive(
        machine.gain,
        period,
        hold,
        case.simulation.substeps,
        case.simulation.sharpness is None,
        longest,
    )


def _refuse_massless(plant: Plant, position: np.ndarray, where: str) -> None:
    """Refuse an arm that some motion moves without kinetic energy: its acceleration would be infinite."""
    if not plant.coupled:
        return
    mass = np.asarray(_mass_matrix(plant, np.asarray(position, dtype=np.float64)))
    scale = 1 / np.sqrt(np.maximum(np.diagonal(mass), 1e-300))
    if np.diagonal(mass).min() <= 0 or np.linalg.eigvalsh(mass * np.outer(scale, scale))[0] < 1e-12:
        joint = int(np.argmin(np.diagonal(mass))) + 1
        raise InputError(
            f"the mass matrix at initial_position is not positive definite (least about joint {joint})",
            where=where,
            hint="give the links mass and inertia that bodies can have",
        )


@kept_jit
def _mass_matrix(plant: Plant, q: Array) -> Array:
    zero = jnp.zeros_like(q)
    return jax.jacfwd(lambda a: plant.inertial(q, zero, a))(zero)


def refuse_impossible(plant: Plant, positions: np.ndarray, where: str, period: float | None = None) -> None:
    """Refuse positions that the machine cannot take; `period` is the time from one to the next."""
    fault = plant.impossible(positions)
    if fault is not None:
        row, what = fault
        when = "" if period is None else f" at t = {row * period:.4g} s"
        raise InputError(what + when, where=where, hint="keep away from it, or check the lengths")


def _refuse_ended(plant: Plant, run: Trajectory, period: float, where: str) -> None:
    """Refuse a motion that ended in a position which the machine cannot leave."""
    known = np.isfinite(run.position).all(axis=1)
    if known.all():
        return
    last = max(int(np.argmin(known)) - 1, 0)
    q, v = np.asarray(run.position)[last], np.asarray(run.velocity)[last]
    fault = plant.impossible(q + period * np.arange(3)[:, None] * v)
    if fault is not None:
        raise InputError(
            f"the motion ends at t = {last * period:.4g} s: {fault[1]}",
            where=where,
            hint="keep reference or input away from it, or check gains and lengths",
        )


def _refuse_coarse(
    case: Case, machine: Machine, drive: Drive, reference: np.ndarray, position: np.ndarray
) -> None:
    """Refuse a step too coarse for the smoothed sign: its trajectory only looks plausible."""
    if drive.set_valued:
        return
    u = jnp.zeros_like(jnp.asarray(reference[:: max(1, len(reference) // 50)]))
    q = jnp.broadcast_to(position, (len(u), case.plant.joints))
    needed = needed_substeps(machine.plant, drive, q, jnp.zeros_like(q), u)
    if needed > drive.substeps:
        raise InputError(
            f"[simulation] substeps = {drive.substeps} is too coarse for sharpness = "
            f"{case.simulation.sharpness:g}",
            where=case.where,
            hint=f"set substeps = {needed}, a larger sharpness, or none (friction then sticks exactly)",
        )


def _scaled(machine: Machine, reference: np.ndarray, period: float) -> Machine:
    """Return the machine with the largest speed of the reference as the scale of the smoothed sign."""
    speed = float(np.abs(np.diff(reference, axis=0)).max() / period)
    if speed == 0.0:
        return machine
    plant = machine.plant.smoothed(velocity_scale=np.asarray(speed))
    return machine.with_plant(plant, machine.parameters)


def _log(
    case: Case,
    machine: Machine,
    times: np.ndarray,
    reading: np.ndarray,
    command: np.ndarray,
    noise: np.ndarray,
    reference: np.ndarray | None,
) -> Log:
    command = np.asarray(machine.sensor.read_command(np.asarray(command), noise))
    if not np.all(np.isfinite(reading)):
        faults = [where_not_finite(e) for e in machine.plant.effects if is_user_class(type(e))]
        raise InputError(
            "the simulation diverged",
            where=case.where,
            hint=next(filter(None, faults), "check gains and parameters, or raise substeps in [simulation]"),
        )
    reading = np.array(reading)
    if case.plant.cls.load is not None and not case.load_column:
        reading[:, case.plant.cls.load] = np.nan
    return Log(
        time=times,
        position=reading,
        force=command,
        reference=reference,
        hold=machine.hold,
        source=f"simulation of {case.name}",
    )


def _columns(case: Case, *, reference: bool) -> dict[str, str | list[str]]:
    joints, drives = case.plant.joints - (case.plant.cls.load is not None), case.plant.drives
    names: dict[str, str | list[str]] = {"time": "t"}
    for key, name, count in (("position", "q", joints), ("force", "u", drives), ("reference", "ref", drives)):
        names[key] = name if count == 1 else [f"{name}{k + 1}" for k in range(count)]
    if case.plant.cls.load is not None and (case.log is None or case.log.load_position is not None):
        names["load_position"] = "q_load"
    for key, given in ({} if case.log is None else stated(case.log)).items():
        if key in names:
            names[key] = given if isinstance(given, str) else list(given)
    if not reference:
        names.pop("reference")
    return names
