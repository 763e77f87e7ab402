"""Hold the start of an experiment without a force: logs and their fit, or guesses alone."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.estimators.servo_rate import leaves_course_open, leaves_rate_open
from jaxid.estimators.several.parts import Part, parts_of
from jaxid.estimators.ticks import std_of_ticks
from jaxid.experiment_design.in_loop import no_noise
from jaxid.experiment_design.position_information import PositionInformation
from jaxid.machine import Machine
from jaxid.simulation.sensor_noise import position_noise

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification

# Part of a joint's motion that a fit leaves and beyond which it does not follow the log; for a joint at rest,
# the same as a multiple of the noise of its encoder.
_LOST, _NOISE = 0.3, 5.0


@dataclass(frozen=True)
class Present:
    """Hold the start of an experiment: a machine and logs, or guesses alone.

    Args:
        machine: The machine at its values.
        parts: The logs that there are.
        noise: Standard deviation of a reading, (n,): that of the sensor, or as much as a fit leaves.
        result: The fit of the logs.
        least: Least standard deviation of each unknown, (p,): that of one tick for a delay of a loop whose
            period is stated, or chosen by the fit; NaN: none.
        start: Positions of all joints at the start; those with a drive go to the command, (n,).
    """

    machine: Machine
    parts: tuple[Part, ...]
    noise: Float[np.ndarray, " n"]
    result: Identification | None
    least: Float[np.ndarray, " p"]
    start: Float[np.ndarray, " n"]

    def std(self, information: PositionInformation, held: Collection[int]) -> Float[np.ndarray, " p"]:
        """Return the standard deviations by an information; see `PositionInformation.std`."""
        std = information.std(self.machine, held)
        return np.where(np.isfinite(std), np.fmax(std, self.least), std)


def present_of(case: Case, result: Identification | None, rate: float) -> Present:
    """Return the machine, the logs and the noise from which an experiment starts.

    Raises:
        InputError: If the noise of a joint is not known, or the fit of the present logs does not follow them.
    """
    start = np.broadcast_to(np.asarray(case.simulation.initial_position, float), case.plant.joints)
    if result is None:
        machine = build_machine(case, period=1 / rate)
        if case.log is None or case.log.reference_hold is None:
            # A command that is played row by row is held in between.
            machine = replace(machine, reference_hold="zero_order")
        std = machine.sensor.position_std
        if std is None:
            raise no_noise(case, "position", "position_noise or position_resolution, or name a log")
        noise = np.broadcast_to(np.asarray(std, float), case.plant.joints)
        stated = case.controller is not None and case.controller.period is not None
        return Present(_with_noise(machine, noise), (), noise, None, _least_std(machine, stated), start)

    if not result.estimate.converged and not _follows(result):
        what = "the fit of the present log did not converge, and does not follow the log"
        raise InputError(what, where=case.where, hint="fit it by `jaxid identify`, or leave the log out")
    session, estimate = result.session, result.estimate
    values = np.where(np.isfinite(estimate.theta), estimate.theta, session.machine.parameters.guess)
    # The fit may have chosen the law, its period, and the command between two rows.
    chosen = session.fit.machine(estimate.machine)
    machine = replace(
        session.machine, controller=chosen.controller, reference_hold=chosen.reference_hold
    ).with_estimate(values)
    left = _left(result, case.plant.joints)
    if not np.all(np.isfinite(left)):
        what = f"joint {int(np.argmin(np.isfinite(left))) + 1} has no encoder in the present log"
        raise InputError(what, where=case.where, hint="leave the log out, and state [sensor] position_noise")
    std = machine.sensor.position_std
    noise = left if std is None else np.maximum(left, np.asarray(std, float))
    machine = _with_noise(machine, noise)
    parts = tuple(parts_of(session.with_machine(machine)))
    stated = case.controller is not None and case.controller.period is not None
    at_ticks = stated or leaves_rate_open(session) or leaves_course_open(session)
    return Present(machine, parts, noise, result, _least_std(machine, at_ticks), start)


def _least_std(machine: Machine, at_ticks: bool) -> Float[np.ndarray, " p"]:
    """Return the least standard deviation of each unknown, as a fit of its log prints it, (p,)."""
    return std_of_ticks(machine) if at_ticks else np.full(len(machine.parameters.free), np.nan)


def _with_noise(machine: Machine, noise: Float[np.ndarray, " n"]) -> Machine:
    """Return the machine with white noise of its readings in place of counts.

    The steps of a simulation depend on it, and counts would make the motion rough.
    """
    sensor = replace(machine.sensor, position_noise=jnp.asarray(noise), position_resolution=None)
    return replace(machine, sensor=sensor)


def _follows(result: Identification) -> bool:
    """Check whether a fit follows its logs; it may not converge where they hardly show some unknowns."""
    if not np.all(np.isfinite(result.estimate.theta)):
        return False
    for run, gap in zip(result.session.fits, result.gaps, strict=False):
        if gap.simulation is None:
            return False
        moved = np.std(run.log.filled, axis=0)
        noise = _NOISE * position_noise(result.session.machine, run.log)
        if np.any(gap.simulation.rms > np.maximum(_LOST * moved, noise)):
            return False
    return True


def _left(result: Identification, joints: int) -> Float[np.ndarray, " n"]:
    """Return the RMS of the position that a fit leaves of the log that it follows worst, (n,)."""
    runs = [gap.simulation for gap in result.gaps[: len(result.session.fits)]]
    return np.max([run.rms for run in runs if run is not None], axis=0) * np.ones(joints)
