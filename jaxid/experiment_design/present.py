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
from jaxid.estimators.several.parts import Part, parts_of
from jaxid.estimators.ticks import std_of_ticks
from jaxid.experiment_design.in_loop import no_noise
from jaxid.experiment_design.position_information import PositionInformation
from jaxid.machine import Machine

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification

# Part of the motion that a fit leaves and beyond which it does not follow the log.
_LOST = 0.3


@dataclass(frozen=True)
class Present:
    """Hold the start of an experiment: a machine and logs, or guesses alone.

    Args:
        machine: The machine at its values.
        parts: The logs that there are.
        noise: Standard deviation of a reading, (n,): that of the sensor, or as much as a fit leaves.
        result: The fit of the logs.
        least: Least standard deviation of each unknown, (p,): that of one tick for a delay of a loop whose
            period is stated; NaN: none.
    """

    machine: Machine
    parts: tuple[Part, ...]
    noise: Float[np.ndarray, " n"]
    result: Identification | None
    least: Float[np.ndarray, " p"]

    def std(self, information: PositionInformation, held: Collection[int]) -> Float[np.ndarray, " p"]:
        """Return the standard deviations by an information; see `PositionInformation.std`."""
        std = information.std(self.machine, held)
        return np.where(np.isfinite(std), np.fmax(std, self.least), std)


def present_of(case: Case, result: Identification | None, rate: float) -> Present:
    """Return the machine, the logs and the noise from which an experiment starts."""
    if result is None:
        machine = build_machine(case, period=1 / rate)
        if case.log is None or case.log.reference_hold is None:
            # A command that is played row by row is held in between.
            machine = replace(machine, reference_hold="zero_order")
        std = machine.sensor.position_std
        if std is None:
            raise no_noise(case, "position", "position_noise or position_resolution, or name a log")
        noise = np.broadcast_to(np.asarray(std, float), case.plant.joints)
        return Present(_with_noise(machine, noise), (), noise, None, _least_std(case, machine))

    if not result.estimate.converged and not _follows(result):
        what = "the fit of the present log did not converge, and does not follow the log"
        raise InputError(what, where=case.where, hint="fit it by `jaxid identify`, or leave the log out")
    session = result.session
    values = np.where(
        np.isfinite(result.estimate.theta), result.estimate.theta, session.machine.parameters.guess
    )
    run = session.fit.machine(session.machine)
    hold = replace(session.machine, reference_hold=run.reference_hold)
    machine = hold.with_estimate(values)
    left = _left(result, case.plant.joints)
    std = machine.sensor.position_std
    noise = left if std is None else np.maximum(left, np.asarray(std, float))
    machine = _with_noise(machine, noise)
    parts = tuple(parts_of(session.with_machine(machine)))
    return Present(machine, parts, noise, result, _least_std(case, machine))


def _least_std(case: Case, machine: Machine) -> Float[np.ndarray, " p"]:
    """Return the least standard deviation of each unknown, as a fit of its log prints it, (p,)."""
    stated = case.controller is not None and case.controller.period is not None
    return std_of_ticks(machine) if stated else np.full(len(machine.parameters.free), np.nan)


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
        moved = np.std(run.log.filled, axis=0)
        if gap.simulation is None or np.any(gap.simulation.rms > _LOST * np.max(moved)):
            return False
    return True


def _left(result: Identification, joints: int) -> Float[np.ndarray, " n"]:
    """Return the RMS of the position that a fit leaves of the log that it follows worst, (n,)."""
    runs = [gap.simulation for gap in result.gaps[: len(result.session.fits)]]
    return np.max([run.rms for run in runs if run is not None], axis=0) * np.ones(joints)
