"""A result as one dataset of xarray: signals of a log, and the parameters with their covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from jaxid.errors import InputError, suggest

if TYPE_CHECKING:
    from jaxid.results.result import FitResult


def dataset_of(result: FitResult, log: str | int = 0) -> xr.Dataset:
    """Return the signals of a log, and the parameters; see `FitResult.to_xarray`."""
    session, estimate = result.session, result.estimate
    names = [run.name for run in session.runs]
    if isinstance(log, int) and -len(names) <= log < len(names):
        log = names[log]
    if log not in names:
        raise InputError(f"log {log!r} is not in this result", hint=suggest(str(log), names))

    run, gap = session.runs[names.index(log)], result.gaps[names.index(log)]
    joints = session.case.plant.names or tuple(str(k + 1) for k in range(run.log.position.shape[1]))
    label = session.machine.unit_by_joint
    position = {"units": _joined(label("position"))}
    force = {"units": _joined(label("force"))}

    signals = {
        "position": (("time", "joint"), run.log.position, position),
        "force": (("force_time", "joint"), gap.force.measured, force),
        "force_residual": (("force_time", "joint"), gap.force.residual, force),
        "estimate": ("parameter", np.where(estimate.identifiable, estimate.theta, np.nan)),
        "std": ("parameter", np.asarray(estimate.std)),
        "covariance": (("parameter", "parameter_"), np.asarray(estimate.precision.covariance)),
        "unit": ("parameter", [f.unit for f in estimate.machine.parameters.free]),
    }
    if gap.simulation is not None:
        signals["position_simulated"] = (("time", "joint"), gap.simulation.position, position)

    return xr.Dataset(
        signals,
        coords={
            "time": ("time", run.log.time, {"units": "s"}),
            "force_time": ("force_time", run.log.time[np.asarray(run.data.kept)], {"units": "s"}),
            "joint": list(joints),
            "parameter": estimate.names,
            "parameter_": estimate.names,
        },
        attrs={"log": log, "method": estimate.method, "case": session.case.name},
    )


def _joined(units: str | list[str]) -> str:
    return units if isinstance(units, str) else ", ".join(units)
