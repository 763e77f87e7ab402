"""The command `check`: tests before any fit that a log is sound and excites the unknowns of a case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.case.case import CaseLike
from jaxid.case.user_faults import named_faults
from jaxid.estimators.inverse_dynamics import force_precision
from jaxid.files import json_text, write_results
from jaxid.gap import noise_floor
from jaxid.logs.in_memory import LogLike
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.precision import Precision
from jaxid.session import Session, open_session
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
        from jaxid.results.as_json import one_or_list, readings_json, recipe_json

        session, log = self.session, self.session.fit.log
        sensor = session.machine.sensor
        free = session.machine.parameters.free
        identifiable = self.precision.identifiable

        def at_encoders(x: np.ndarray) -> np.ndarray:
            return np.where(log.measured, x, np.nan)

        return {
            "sound": True,
            "warnings": self.warnings,
            "log": {
                "samples": log.samples,
                "rate_hz": log.rate_hz,
                "duration_s": log.period * log.samples,
                "stroke": np.ptp(log.position, axis=0),
                "peak_velocity": np.abs(at_encoders(session.fit.data.qd)).max(axis=0),
                "peak_force": np.abs(session.fit.data.force).max(axis=0),
                "moving": float(session.fit.data.moving.mean()),
                "position_noise": at_encoders(position_noise(session.machine, log)),
                "force_noise": one_or_list(force_noise(session.machine, session.fit.data)),
                "noise_from": {
                    "position": "estimated" if sensor.position_std is None else "stated",
                    "force": "estimated" if sensor.force_noise is None else "stated",
                },
            },
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


@named_faults()
def check(case: CaseLike, log: LogLike, *, validate: Sequence[LogLike] = ()) -> Check:
    """Check a log against a case before any fit.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log, its file, or a table of the columns that [log] names (DataFrame, Dataset, dict).
        validate: More logs to check, beside those of the case.

    Raises:
        InputError: If the case or the log is invalid.
    """
    session = open_session(case, log, validate)
    machine, data = session.machine, session.fit.data
    floor = noise_floor(machine, session.fit.log, data)
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


@kept_jit
def _jacobian(plant: Any, places: tuple, data: ForceData, theta: Array) -> Array:
    if theta.size == 0:
        return jnp.zeros((*data.weight.shape, 0))
    return jax.jacfwd(lambda t: force_residual(scatter(places, plant, t), data))(theta)
