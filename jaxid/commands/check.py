"""Before any fit: is the log sound, does it excite what is asked, what can be told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.case.case import CaseLike
from jaxid.estimators.inverse_dynamics import force_precision
from jaxid.files import ready_folder, write_json
from jaxid.gap import noise_floor
from jaxid.logs.log import Log
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.precision import Precision
from jaxid.session import Session, open_session
from jaxid.simulation.force_balance import ForceData, force_residual, force_size, sharpened


@dataclass(frozen=True)
class Check:
    """What `check` returns.

    Args:
        session: Case and logs.
        precision: What the log could tell at best, linearised at the guesses, if noise alone
            stood between model and log.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
    """

    session: Session
    precision: Precision
    noise_floor: np.ndarray

    @property
    def warnings(self) -> list[str]:
        """What is doubtful about the logs."""
        return [f"{f.where}: {f.what}; {f.hint}" for f in self.session.findings]

    def json(self) -> dict[str, Any]:
        """Content of check.json."""
        from jaxid.results.as_json import recipe_json

        session, log = self.session, self.session.fit.log
        free = session.machine.parameters.free
        told = self.precision.identifiable
        seen = lambda x: np.where(log.measured, x, np.nan)
        return {
            "sound": True,
            "warnings": self.warnings,
            "log": {
                "samples": log.samples,
                "rate_hz": log.rate_hz,
                "duration_s": log.period * log.samples,
                "stroke": np.ptp(log.position, axis=0),
                "peak_velocity": np.abs(seen(session.fit.data.qd)).max(axis=0),
                "peak_force": np.abs(session.fit.data.force).max(axis=0),
                "moving": float(session.fit.data.moving.mean()),
                "position_noise": seen(signals.high_band_std(log.filled)),
            },
            "preprocess": recipe_json(session),
            "noise_floor": self.noise_floor,
            "parameters": {
                f.name: {
                    "guess": f.guess,
                    "expected_std": s if ok else None,
                    "unit": f.unit,
                    "identifiable": bool(ok),
                }
                for f, s, ok in zip(free, self.precision.std, told, strict=True)
            },
            "unidentifiable": [{"combination": c} for c in self.precision.unidentifiable],
            "condition": float(np.sqrt(1 / max(self.precision.information[0], 1e-30))) if len(free) else None,
        }

    def __str__(self) -> str:
        from jaxid.results.as_text import check_table

        return check_table(self)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write `check.json` to a folder.

        Raises:
            InputError: If the folder holds what jaxid did not make and `overwrite` is not given.
        """
        folder = ready_folder(Path(folder), ["check.json"], overwrite=overwrite)
        write_json(folder / "check.json", self.json())
        return folder


def check(case: CaseLike, log: Log | str | Path, *, validate: Sequence[Log | str | Path] = ()) -> Check:
    """Check a log against a case before any fit.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log, or its file.
        validate: More logs to check, beside the case's own.

    Raises:
        InputError: If case or log are unsound.
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


@eqx.filter_jit
def _jacobian(plant: Any, places: tuple, data: ForceData, theta: jax.Array) -> jax.Array:
    if theta.size == 0:
        return jnp.zeros((*data.weight.shape, 0))
    return jax.jacfwd(lambda t: force_residual(scatter(places, plant, t), data))(theta)
