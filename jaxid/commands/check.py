"""The command `check`: tests before any fit that a log is sound and excites the unknowns of a case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.case.case import CaseLike
from jaxid.case.user_faults import named_faults
from jaxid.estimators.inverse_dynamics import force_precision
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.several.weights import noise_weights
from jaxid.files import json_text, write_results
from jaxid.gap import noise_floor
from jaxid.logs.in_memory import LogLike
from jaxid.logs.seen import Sight, sights_of
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import run_alone
from jaxid.numerics.precision import Precision
from jaxid.numerics.rows import Rows, assess_together
from jaxid.session import Logs, OpenedLog, Session, open_session
from jaxid.simulation.force_balance import ForceData, force_residual, force_size, sharpened
from jaxid.simulation.sensor_noise import force_noise, position_noise

if TYPE_CHECKING:
    import pandas

    from jaxid.results.parameters import Covariance, ParameterTable


@dataclass(frozen=True, repr=False)
class Check:
    """Result of `check`.

    Args:
        session: Case and logs.
        precision: Smallest standard deviations that the log allows, linearised at the guesses, if noise alone
            separates model and log.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
    """

    session: Session
    precision: Precision
    noise_floor: np.ndarray

    @property
    def warnings(self) -> list[str]:
        """Doubts about the logs, a line each."""
        return [f"{f.where}: {f.what}; {f.hint}" for f in self.session.findings]

    @property
    def sights(self) -> list[Sight]:
        """Everything that was seen when the fitted log was read, with the statements that settle it."""
        return sights_of(self.session.fit.log, self.session.findings)

    @property
    def parameters(self) -> ParameterTable:
        """The unknowns by name: their guess, and the smallest standard deviation that the log allows."""
        from jaxid.results.parameters import Parameter, ParameterTable

        free = self.session.machine.parameters.free
        rows = zip(free, self.precision.std, self.precision.identifiable, strict=True)
        return ParameterTable(
            [
                Parameter(
                    name=f.name,
                    value=f.guess,
                    std=float(std) if ok else np.nan,
                    unit=f.unit,
                    identifiable=bool(ok),
                    guess=f.guess,
                )
                for f, std, ok in rows
            ]
        )

    @property
    def covariance(self) -> Covariance:
        """Smallest covariance that the log allows, with the names of the unknowns."""
        from jaxid.results.parameters import Covariance

        return Covariance(tuple(self.session.machine.parameters.names), self.precision.covariance)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with a row for each unknown; needs pandas."""
        return self.parameters.to_pandas()

    def json(self) -> dict[str, Any]:
        """Return the content of check.json."""
        from jaxid.results.as_json import readings_json, recipe_json

        session = self.session
        free = session.machine.parameters.free
        identifiable = self.precision.identifiable
        every = {run.name: _log_json(session, run) for run in session.fits} if session.more else {}
        return {
            "sound": True,
            "warnings": self.warnings,
            "seen": [{"about": s.about, "text": s.text, "say": s.say or None} for s in self.sights],
            "log": _log_json(session, session.fit),
            **({"fits": every} if every else {}),
            "settings": {**session.settings, **readings_json(session)},
            "preprocess": recipe_json(session),
            "noise_floor": self.noise_floor,
            "parameters": {
                f.name: {
                    "guess": f.guess,
                    "expected_std": s if ok else None,
                    "unit": f.unit,
                    "identifiable": bool(ok),
                }
                for f, s, ok in zip(free, self.precision.std, identifiable, strict=True)
            },
            "unidentifiable": [{"combination": c} for c in self.precision.unidentifiable],
            "condition": float(np.sqrt(1 / max(self.precision.information[0], 1e-30))) if len(free) else None,
        }

    def __repr__(self) -> str:
        from jaxid.results.as_text import check_summary

        return check_summary(self)

    def __str__(self) -> str:
        from jaxid.results.as_text import check_table

        return check_table(self)

    def _repr_html_(self) -> str:
        from jaxid.results.as_html import check_html

        return check_html(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `check.json` to a folder.

        Raises:
            InputError: If the folder holds files that jaxid did not make and `overwrite` is not given.
        """
        folder = Path(folder)
        write_results(folder, {"check.json": json_text(self.json())}, overwrite=overwrite)
        return folder


def _log_json(session: Session, run: OpenedLog) -> dict[str, Any]:
    """Return what a log holds, as an entry of check.json."""
    from jaxid.results.as_json import one_or_list

    log, data, sensor = run.log, run.data, session.machine.sensor
    measures = "velocity" if log.integrated else "position"
    stated = sensor.velocity_noise if log.integrated else sensor.position_std

    def at_encoders(x: np.ndarray) -> np.ndarray:
        return np.where(log.measured, x, np.nan)

    return {
        "samples": log.samples,
        "rate_hz": log.rate_hz,
        "duration_s": log.period * log.samples,
        "stroke": np.ptp(log.position, axis=0),
        "peak_velocity": np.abs(at_encoders(data.qd)).max(axis=0),
        "peak_force": np.abs(data.force).max(axis=0),
        "moving": float(data.moving.mean()),
        f"{measures}_noise": at_encoders(position_noise(session.machine, log)),
        "force_noise": one_or_list(force_noise(session.machine, data)),
        "noise_from": {
            measures: "estimated" if stated is None else "stated",
            "force": "estimated" if sensor.force_noise is None else "stated",
        },
    }


@named_faults()
def check(case: CaseLike, log: Logs = None, *, validate: Sequence[LogLike] = ()) -> Check:
    """Check a log against a case before any fit, or several that are to be fitted together.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log, its file, or a table of the columns that [log] names (DataFrame, Dataset, dict); or a
            list of several. They are checked with the logs of [[fit]]; None: those alone.
        validate: More logs to check, beside those of the case.

    Raises:
        InputError: If the case or the log is invalid.
    """
    session = open_session(case, log, validate, piecewise=True)
    floor = noise_floor(session.machine, session.fit.log, session.fit.data)
    if session.machine.unforced(session.fit.log):
        from jaxid.estimators.apart.joint import stands_apart
        from jaxid.estimators.apart.steps import precision_apart

        parts = parts_of(session)
        if stands_apart(session.machine, parts):
            return Check(session, precision_apart(session.machine, parts), floor)
    if session.more:
        return Check(session, _precision_together(session), floor)
    machine, data = session.machine, session.fit.data
    if session.fit.log.steady is not None:
        from jaxid.steady import steady_fit

        return Check(session, run_alone(steady_fit(session)).precision, floor)
    if machine.unforced(session.fit.log):
        from jaxid.estimators.unforced import precision_at_guesses

        return Check(session, precision_at_guesses(machine, session.fit.log), floor)
    arrays = ForceData.of(data, data.fitted)
    theta = machine.parameters.guess
    jacobian = _jacobian(sharpened(machine.plant, data), machine.parameters.places, arrays, theta)
    noise = np.random.default_rng(0).standard_normal(data.fitted.shape) * floor
    precision = force_precision(
        machine,
        force_size(machine.plant, arrays),
        np.asarray(theta),
        noise,
        np.asarray(jacobian),
        data.fitted,
    )
    return Check(session, precision, floor)


def _precision_together(session: Session) -> Precision:
    """Return the precision that several logs allow together, each by the noise of its sensors."""
    guess, rng, logs = session.machine.parameters.guess, np.random.default_rng(0), []
    for part in parts_of(session):
        data, machine = part.data, part.machine
        arrays, plant = ForceData.of(data, data.fitted), sharpened(machine.plant, data)
        jacobian = _jacobian(plant, machine.parameters.places, arrays, guess[part.index])
        floor = noise_floor(machine, part.log, data)
        wide = part.widened(np.where(data.fitted[..., None], np.asarray(jacobian), 0.0), guess.size)
        noise = rng.standard_normal(data.fitted.shape) * floor
        logs.append(Rows(wide, noise, data.fitted, float(force_size(plant, arrays))))
    weights = noise_weights(logs)
    weighed = [replace(log, weight=float(weight)) for log, weight in zip(logs, weights, strict=True)]
    return assess_together(session.machine.parameters.names, weighed, np.where(guess != 0, guess, 1.0))


@kept_jit
def _jacobian(plant: Any, places: tuple, data: ForceData, theta: Array) -> Array:
    if theta.size == 0:
        return jnp.zeros((*data.weight.shape, 0))
    return jax.jacfwd(lambda t: force_residual(scatter(places, plant, t), data))(theta)
