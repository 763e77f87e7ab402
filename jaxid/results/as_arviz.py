"""A result as draws from the posterior, in the container of ArviZ: a tree of datasets of xarray."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from jaxid.errors import InputError
from jaxid.numerics.precision import KINDS

if TYPE_CHECKING:
    from jaxid.results.result import FitResult


def posterior_of(result: FitResult, draws: int, chains: int, seed: int, exact: bool) -> xr.DataTree:
    """Return draws from the posterior; see `FitResult.to_arviz`."""
    import jaxid
    from jaxid.estimators.posterior import posterior_chains

    for name, value in (("draws", draws), ("chains", chains)):
        if value < 1:
            raise InputError(f"{name} = {value} is not a positive number")
    estimate, free = result.estimate, result.estimate.machine.parameters.free
    seen = np.flatnonzero(estimate.identifiable)
    if not seen.size:
        raise InputError("no parameter is identifiable: there is nothing to draw")
    attributes = {
        "inference_library": "jaxid",
        "inference_library_version": jaxid.__version__,
        "method": estimate.method,
        "model_complete": str(result.model_complete),
    }
    statistics = {}
    if exact:
        found = posterior_chains(result.session, estimate, draws=draws, chains=chains, seed=seed)
        points = found.points[..., seen]
        statistics["lp"] = (("chain", "draw"), found.log_density)
        attributes |= {"source": "likelihood of the innovations", "acceptance_rate": found.accepted}
    else:
        covariance = np.asarray(estimate.precision.covariance)[np.ix_(seen, seen)]
        random = np.random.default_rng(seed)
        points = random.multivariate_normal(estimate.theta[seen], covariance, (chains, draws))
        source = KINDS.get(estimate.precision.kind, "the covariance of the method")
        attributes["source"] = f"normal distribution, covariance from {source}"

    places = {"chain": np.arange(chains), "draw": np.arange(draws)}
    drawn = {
        # A tree takes a slash for a level.
        estimate.names[k].replace("/", "_"): (("chain", "draw"), points[..., n], {"units": free[k].unit})
        for n, k in enumerate(seen)
    }
    log = result.session.fit.log
    observed = {"position": (("time", "joint"), log.position), "force": (("time", "drive"), log.force)}
    groups = {
        "posterior": xr.Dataset(drawn, coords=places, attrs=attributes),
        "observed_data": xr.Dataset(observed, coords={"time": log.time}),
    }
    if statistics:
        groups["sample_stats"] = xr.Dataset(statistics, coords=places, attrs=attributes)
    return xr.DataTree.from_dict(groups)
