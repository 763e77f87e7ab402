"""Hold the designed command of a loop whose force is not logged, with the precision that it gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.experiment_design.limits import Peaks
from jaxid.files import signal_csv, write_whole
from jaxid.machine import Machine
from jaxid.results.aligned import aligned

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification


@dataclass(frozen=True)
class SecondLog:
    """A second log of the designed motion, in which something known differs.

    Args:
        what: What differs, in words.
        values: Known values in that log by name, for `set` in [[fit]].
        std: Expected standard deviations of the unknowns by both logs, (p,); NaN: not identifiable.
    """

    what: str
    values: Mapping[str, float | list[float]]
    std: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class UnforcedDesign:
    """A reference for a loop whose force is not logged, and the expected precision of its unknowns.

    Deviations are those of white noise on the readings, by the Fisher information of the position; the
    derivative by a delay is that on the side of its tick that tells less. Without a scale, they are those of
    the ratios to one of the unknowns, which is held.

    Args:
        case: The case.
        machine: The machine at the guesses, or at the fit of the present logs.
        time: Time of each row [s].
        values: The reference, (rows, m) [m or rad].
        group: Unknowns that may all be multiplied by one factor, whatever the motion.
        base: The one of them that is held; None: something known gives the scale.
        std: Expected standard deviations by this log and the present ones, (p,); NaN: not identifiable.
        plain: The same for a tour from end to end at several speeds in place of the design, (p,); None: the
            tour breaks the limits.
        before: The same by the present logs alone, (p,); None: there are none.
        stating: Expected standard deviations if one unknown of the group were stated, by its name, (p,) each.
        second: Second logs that tell more; the first one is that of `case_text`.
        noise: Standard deviation of a reading that was counted with, (n,) [m or rad].
        peaks: Extremes of the motion.
        result: The fit of the present logs; None: there are none.
    """

    case: Case
    machine: Machine
    time: Float[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows m"]
    group: tuple[int, ...]
    base: int | None
    std: Float[np.ndarray, " p"]
    plain: Float[np.ndarray, " p"] | None
    before: Float[np.ndarray, " p"] | None
    stating: Mapping[str, Float[np.ndarray, " p"]]
    second: tuple[SecondLog, ...]
    noise: Float[np.ndarray, " n"]
    peaks: Peaks
    result: Identification | None

    signal = "reference"

    def csv(self) -> str:
        """Return time and reference as CSV for `[reference] kind = "csv"`, with every digit."""
        return signal_csv(self.signal, self.time, self.values)

    def save(self, path: str | Path) -> Path:
        """Write the reference as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)

    def case_text(self, path: str | Path) -> str:
        """Return the case that fits the log of this experiment with the present ones, as TOML.

        Args:
            path: File of the reference, beside which the case and the new logs stand.
        """
        from jaxid.experiment_design.next_case import next_case

        return next_case(self, Path(path))

    def save_case(self, path: str | Path) -> Path:
        """Write the case of `case_text` beside the file of the reference, with the suffix .toml."""
        out = Path(path).with_suffix(".toml")
        if self.case.path is not None and out.resolve() == self.case.path.resolve():
            what = f"the case of the experiment would be written over {self.case.path}"
            raise InputError(what, where=str(path), hint="choose another name for the signal")
        write_whole(out, self.case_text(path))
        return out

    def __str__(self) -> str:
        lines = [*self._fit(), *self._table(), *self._scale(), *self._second(), *self._extremes()]
        return "\n".join(lines)

    def _fit(self) -> list[str]:
        """Return the line on a fit of the present logs that did not converge."""
        if self.result is None or self.result.estimate.converged:
            return []
        return [
            f"the fit of the present logs did not converge: {self.result.estimate.message}",
            "its values follow the logs, and the design uses them",
        ]

    def _table(self) -> list[str]:
        """Return a line for each unknown: its expected deviation over its value."""
        columns = {"before": self.before, "expected": self.std, "tour": self.plain}
        if self.base is None:
            columns |= {f"second {k}": second.std for k, second in enumerate(self.second, start=1)}
        shown = {name: std for name, std in columns.items() if std is not None}
        rows = [["parameter", *shown, "(standard deviation over the value)"]]
        for k in range(len(self.std)):
            if k != self.base:
                rows.append([self._label(k), *(self._part(std, k) for std in shown.values()), ""])
        return [aligned(rows)]

    def _label(self, k: int) -> str:
        """Return the name of an unknown; of one without a scale, that of its ratio."""
        names = self.machine.parameters.names
        if self.base is None or k not in self.group:
            return names[k]
        return f"{names[k]} / {names[self.base]}"

    def _part(self, std: np.ndarray, k: int) -> str:
        """Return a deviation over the value, or with its unit if the value is zero."""
        unknown = self.machine.parameters.free[k]
        if not np.isfinite(std[k]):
            return "not identifiable"
        if unknown.guess == 0:
            return f"{std[k]:.2g} {unknown.unit}"
        return f"{std[k] / abs(unknown.guess):.2%}"

    def _scale(self) -> list[str]:
        """Return the lines on a missing scale, and on what would give it."""
        if self.base is None:
            return []
        names = self.machine.parameters.names
        group = ", ".join(names[k] for k in self.group)
        lines = [
            f"no motion tells the scale: {group} may all be multiplied by one factor. It is known",
            *(f"  if {name} is stated as a number: {self._all(std)}" for name, std in self.stating.items()),
        ]
        return [*lines, *(f"  by a second log with {s.what}: {self._all(s.std)}" for s in self.second)]

    def _second(self) -> list[str]:
        """Return the lines on the columns of second logs, if the scale is known without."""
        if self.base is not None:
            return []
        return [
            f"second {k}: with a second log of this motion, recorded with {second.what}"
            for k, second in enumerate(self.second, start=1)
        ]

    def _all(self, std: np.ndarray) -> str:
        """Return the deviations of all unknowns that are not stated, in a line."""
        known = [k for k in range(len(std)) if np.isfinite(std[k])]
        return ", ".join(f"{self.machine.parameters.names[k]} {self._part(std, k)}" for k in known)

    def _extremes(self) -> list[str]:
        """Return the lines on the extremes of the motion, with a row for each joint."""
        peaks, joints = self.peaks, len(self.peaks.low)
        rate = (len(self.time) - 1) / self.time[-1]
        lines = [f"{self.time[-1]:.3g} s from rest, {rate:.6g} rows a second"]
        lines.append(f"commands of the loop up to {', '.join(f'{x:.3g}' for x in peaks.force)}")

        start = np.full(joints, np.nan)
        start[list(self.machine.plant.driven(joints))] = self.values[0]
        columns = {
            "start": start,
            "from": peaks.low,
            "to": peaks.high,
            "speed up to": peaks.speed,
            "noise of a reading": self.noise,
        }
        numbered = ("",) if joints == 1 else tuple(f"joint {k + 1}" for k in range(joints))
        lines.append(
            "noise that goes round the loop is not in these: the fit of the log may print larger ones"
        )
        rows = [["motion", *columns]]
        for k, name in enumerate(self.case.plant.names or numbered):
            cells = (f"{values[k]:.3g}" if np.isfinite(values[k]) else "-" for values in columns.values())
            rows.append([name, *cells])
        return [*lines, aligned(rows), *self._unchecked()]

    def _unchecked(self) -> list[str]:
        """Return the line on collisions, from which the limits of a robot do not keep it."""
        if not self.case.plant.cls.linked:
            return []
        return ["collisions are not checked: play the command in a simulator of the cell first"]
