"""A case with its opened logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, Recipe
from jaxid.logs.soundness import Finding
from jaxid.machine import Machine
from jaxid.own_values import OwnValues
from jaxid.settings import Disturbance

# One log to fit, or several; None: those of the case.
Logs = LogLike | Sequence[LogLike] | None


@dataclass(frozen=True)
class OpenedLog:
    """One log, prepared, with the disturbance of its controller.

    Args:
        name: Name of the log in results.
        log: The log; its force has passed the recipe's running median, if there is one.
        data: The prepared log.
        disturbance: Signal that was added to the controller's command.
        reference_hold: Course of the reference between samples that is stated for this log only; None: that
            of the machine.
        own: Values that hold in this log only; None: there are none.
        load, held_load: Known forces along this log, see `jaxid.machine.Machine`; None: there are none.
    """

    name: str
    log: Log
    data: Prepared
    disturbance: Disturbance | str | None
    reference_hold: str | None = None
    own: OwnValues | None = None
    load: Float[np.ndarray, "time loads"] | None = None
    held_load: Float[np.ndarray, "ticks loads"] | None = None

    def machine(self, machine: Machine) -> Machine:
        """Return a machine with the values, the disturbance and the course of the reference of this log."""
        hold = self.reference_hold or machine.reference_hold
        own = machine if self.own is None else self.own.machine(machine)
        known = {"load": self.load, "held_load": self.held_load}
        return replace(own, disturbance=self.disturbance, reference_hold=hold, **known)


@dataclass(frozen=True)
class Session:
    """A case, its machine at the guesses, the logs to fit and the logs to validate on.

    Args:
        case: The case.
        machine: Its machine; an unknown with a value in each log is one for each of them.
        fit: The log to fit, or the first of several.
        validations: Further logs with their names, prepared by the same recipe.
        recipe: Filtering of all logs.
        findings: Warnings on the logs.
        given: The case as it was given, where `case` is that of the joints (see `at_joints`).
        settings: Choices made from the log, by name: `value` and `reason`.
        more: Further logs that are fitted with the first one.
        chooses_hold: Whether the hold of the force is chosen from the log, because nobody states it.
    """

    case: Case
    machine: Machine
    fit: OpenedLog
    validations: tuple[OpenedLog, ...]
    recipe: Recipe
    findings: tuple[Finding, ...]
    given: Case | None = None
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    more: tuple[OpenedLog, ...] = ()
    chooses_hold: bool = False

    @property
    def declared(self) -> Case:
        """The case as it was given, gears of the motors included."""
        return self.case if self.given is None else self.given

    @property
    def runs(self) -> tuple[OpenedLog, ...]:
        """All logs, the fitted ones first."""
        return (self.fit, *self.more, *self.validations)

    @property
    def fits(self) -> tuple[OpenedLog, ...]:
        """The fitted logs."""
        return (self.fit, *self.more)

    def need_one_log(self, what: str) -> None:
        """Refuse several fitted logs.

        Raises:
            InputError: If there are several; the message names `what`.
        """
        if self.more:
            hint = "name one log, and the others by validate"
            raise InputError(f"{what} takes one log, not {len(self.fits)}", where=self.case.where, hint=hint)

    def with_machine(self, machine: Machine) -> Session:
        """Return the session with another machine."""
        return replace(self, machine=machine)
