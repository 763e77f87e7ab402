"""Opened logs, prepared by a recipe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from jaxid.case.case import Case
from jaxid.consistency.noise import ForceNoise
from jaxid.consistency.tick import Tick
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, Recipe, choose_recipe, prepare
from jaxid.machine import Machine
from jaxid.model.smoothing import typical_velocity
from jaxid.own_values import OwnValues
from jaxid.session.opened import OpenedLog
from jaxid.settings import Disturbance
from jaxid.simulation.step_size import needed_steps

# Chosen: a further log that would have a cut-off or rest velocity within this factor of those of the first
# takes the recipe of the first, so that code compiled for one serves both.
_ALIKE = 1.5


def recipe_of(log: Log, case: Case, recipe: Recipe) -> Recipe:
    """Return the recipe of a further log: that of the first, unless its rate or noise asks for another."""
    chosen = replace(choose_recipe(log, case.preprocess), align_hold=recipe.align_hold)
    pairs = [
        (chosen.cutoff_hz, recipe.cutoff_hz),
        *zip(chosen.rest_velocity, recipe.rest_velocity, strict=True),
    ]
    alike = chosen.decimation == recipe.decimation and chosen.median == recipe.median
    alike &= all(max(a, b) <= _ALIKE * min(a, b) for a, b in pairs)
    return recipe if alike else chosen


def under_hold(hold: str, opened: OpenedLog, machine: Machine) -> OpenedLog:
    """Return a log under another hold of its force."""
    log = replace(opened.log, hold=hold)
    held = opened.data.recipe.hold(log, machine.hold_period)
    return replace(opened, log=log, data=replace(opened.data, hold=held, hold_std=0.0))


def with_force_noise(opened: OpenedLog, noise: ForceNoise, tick: Tick | None = None) -> OpenedLog:
    """Return a log with the noise of its force.

    Args:
        opened: The log.
        noise: The noise.
        tick: Time for which each force acts; None: as before.
    """
    data = replace(opened.data, force_noise=noise.std, faster_loop=noise.faster_loop, answer=noise.answer)
    if tick is not None:
        data = replace(data, hold=tick.period, hold_std=tick.std)
    return replace(opened, data=data)


def without_clipped(opened: OpenedLog, rows: Bool[np.ndarray, "samples m"], machine: Machine) -> OpenedLog:
    """Return a log without the samples under a force whose recording is clipped."""
    log = replace(opened.log, clipped=rows)
    again = prepared(log, opened.machine(machine), opened.data.recipe)
    return replace(opened, log=log, data=replace(opened.data, moving=again.moving, fitted=again.fitted))


def enough(machine: Machine) -> int:
    """Return the samples of motion that a log must have for a fit without a prior."""
    return 5 * max(len(machine.parameters.free), 4)


def enough_beside(log: Log, machine: Machine, short: bool) -> int:
    """Return the least number of moving samples of a log beside the first.

    The position of a loop whose force was not logged shows, or confirms, that a joint stands still.
    """
    return 0 if short or machine.unforced(log) else enough(machine)


def open_log(
    name: str,
    log: Log,
    machine: Machine,
    recipe: Recipe,
    needed: int,
    disturbance: Disturbance | str | None,
    *,
    values: OwnValues | None = None,
    reference_hold: str | None = None,
) -> OpenedLog:
    """Clean and prepare a log.

    Args:
        name: Name of the log in results.
        log: The log.
        machine: Machine of all logs.
        recipe: Filtering of the log.
        needed: Samples of motion that the log must have.
        disturbance, values, reference_hold: See `OpenedLog`, where the values are `own`.

    Raises:
        InputError: If the log is too short, or moves too little.
    """
    on_log = machine if values is None else values.machine(machine)
    log = recipe.cleaned(log)
    data = prepared(log, on_log, recipe, needed)
    return OpenedLog(name, log, data, disturbance, reference_hold, values)


def prepared(log: Log, machine: Machine, recipe: Recipe, needed: int = 0) -> Prepared:
    """Return a cleaned log, prepared by a recipe.

    Args:
        log: The log.
        machine: Its machine.
        recipe: Filtering of the log.
        needed: Samples of motion that the log must have.

    Raises:
        InputError: If the log is too short, or moves too little.
    """
    remaining = log.samples // recipe.decimation - 2 * recipe.trim
    if remaining * log.position.shape[1] < needed:
        raise InputError(
            f"too short: {log.samples} samples leave {max(remaining, 0)} after decimation by "
            f"{recipe.decimation} and trimming {recipe.trim} at each end, as [preprocess] states or "
            "the log's noise asks",
            where=log.source,
            hint="take a longer log, or lower decimation and trim in [preprocess]",
        )

    data = prepare(log, machine.gain, recipe, machine.hold_period)
    if not all(log.measured):
        data = replace(data, steps=needed_steps(machine, log))
    if data.moving.sum() < needed:
        raise InputError(
            f"only {int(data.moving.sum())} samples move faster than the rest velocity "
            f"{min(recipe.rest_velocity):.3g}",
            where=log.source,
            hint="take a log with more motion, or lower rest_velocity",
        )
    return data


def with_velocity_scale(machine: Machine, data: Prepared) -> Machine:
    """Return the machine with the velocity scale of its log, which the smoothed sign multiplies."""
    speed = typical_velocity(machine.plant, data.qd, lambda v: float(np.sqrt(np.mean(v**2))))
    plant = machine.plant.smoothed(velocity_scale=speed)
    return machine.with_plant(plant, machine.parameters)
