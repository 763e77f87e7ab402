"""The common base of the results of `identify` and `discover`: parameters, residuals, plots and tables."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

    from jaxid.case.case import Case
    from jaxid.estimators.estimate import Estimate
    from jaxid.gap import Gap
    from jaxid.results.parameters import Covariance, ParameterTable, Residuals
    from jaxid.results.verdict import Judgement
    from jaxid.session import Session


class FitResult:
    """A fit of a case's unknowns to a log.

    Attributes:
        session: Case and logs.
        estimate: Parameters and their precision after the last fit.
        gaps: Disagreement of the fitted model with each log, the fitted log first.
        noise_floor: RMS force that the sensors' noise leaves in the band, by joint.
    """

    session: Session
    estimate: Estimate
    gaps: tuple[Gap, ...]
    noise_floor: np.ndarray

    @property
    def converged(self) -> bool:
        """The flag of the solver's convergence."""
        return self.estimate.converged

    @cached_property
    def judgement(self) -> Judgement:
        """The verdict on the model, with its reasons."""
        from jaxid.results.verdict import judge

        search, reading = getattr(self, "verdict", None), getattr(self, "force_reading", None)
        return judge(self.session, self.estimate, self.gaps, search, reading)

    @property
    def model_complete(self) -> bool | None:
        """True if the model leaves nothing but the sensors' noise; None if that cannot be decided."""
        return self.judgement.model_complete

    @property
    def findings(self) -> tuple[str, ...]:
        """The verdict on this result in sentences, the most important first."""
        return self.judgement.findings

    @property
    def settings(self) -> dict[str, Any]:
        """The choices made from case and log, by name: `value` and `reason`; and how each log was read."""
        from jaxid.results.as_json import readings_json

        chosen = {**self.session.settings, **self.estimate.details.get("settings", {})}
        return {**chosen, **readings_json(self.session)}

    @property
    def parameters(self) -> ParameterTable:
        """The parameters by name: `result.parameters["inertia"].value`, `.std`, `.unit`."""
        from jaxid.results.parameters import ParameterTable

        return ParameterTable.of(self.estimate, self.session.machine.parameters)

    @property
    def covariance(self) -> Covariance:
        """Covariance of the parameters, with their names."""
        from jaxid.results.as_json import covariance_of

        return covariance_of(self.estimate)

    def value(self, name: str) -> float:
        """Return the estimate of one parameter.

        Args:
            name: Name of the parameter in results.

        Raises:
            KeyError: If there is none of that name.
        """
        return self.estimate.value(name)

    def residuals(self, log: Any = None) -> Residuals:
        """Return measurement minus model on one log.

        Args:
            log: Name or number of a log of this result, the fitted one being "fit" or 0; any other log, as
                `jaxid.identify` takes it, is opened and simulated; None: the fitted log.

        Raises:
            InputError: If the log is unsound.
        """
        from jaxid.results.residuals import residuals_of

        return residuals_of(self, log)

    def plot(
        self,
        kind: str,
        ax: Axes | None = None,
        *,
        log: str | int = 0,
        joint: int = 1,
        against: str = "velocity",
        parameter: str | None = None,
        step: int | None = None,
    ) -> Axes:
        """Draw one plot.

        Args:
            kind: "fit" (measured and simulated position), "difference" (of these), "force", "residual" (of
                force, over time), "scatter" (the same over another quantity), "parameters" (95 % intervals),
                "correlation", "gaps" (by log), "history" (of a recursive estimate), and of a search "where"
                and "candidates".
            ax: Axes to draw on; None: a new figure, which a notebook shows.
            log: Name or number of the log, the fitted one being "fit" or 0.
            joint: Joint of several, 1-based.
            against: Abscissa of "scatter": "velocity", "position" or "time".
            parameter: Parameter of "history"; None: the first.
            step: Step of "candidates", 0 being the baseline; None: the first that has some.

        Returns:
            The axes, to be changed or saved as any of matplotlib's.

        Raises:
            InputError: If the kind is unknown, or there is nothing to draw of it.
        """
        from jaxid.results.plotting import Selection, plot

        return plot(self, kind, ax, Selection(log, joint, against, parameter, step))  # pyright: ignore[reportArgumentType]  # both subclasses

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with a row for each parameter; needs pandas."""
        return self.parameters.to_pandas()

    def to_xarray(self, log: str | int = 0) -> xarray.Dataset:
        """Return the signals of a log, measured and simulated, and the parameters with their covariance.

        `position` and `position_simulated` are over `time` and `joint`; `force` and `force_residual` are
        low-passed, NaN at rest, and over `force_time` and `joint`. `estimate`, `std` and `unit` are over
        `parameter`, and `covariance` is over `parameter` and `parameter_`. Attributes hold the units.

        Args:
            log: Name or number of the log, the fitted one being "fit" or 0.

        Raises:
            InputError: If there is no such log.
        """
        from jaxid.results.as_xarray import dataset_of

        return dataset_of(self, log)

    def to_arviz(
        self, draws: int = 1000, *, chains: int = 4, seed: int = 0, exact: bool = False
    ) -> xarray.DataTree:
        """Return draws from the posterior of the identifiable parameters, in the container of ArviZ 1.

        The tree has the groups `posterior`, with a variable of chain and draw for each parameter, and
        `observed_data`. Its functions take it as it is: `arviz.summary(result.to_arviz())`. ArviZ itself is
        not needed to make it.

        Args:
            draws: Number of draws of each chain.
            chains: Number of chains.
            seed: Seed of the random numbers.
            exact: Whether draws are from the likelihood of a fit by `prediction_error`, by a Markov chain,
                with `lp` in `sample_stats`; otherwise they are from the normal distribution with the
                estimates and their covariance, which does not know the bounds.

        Raises:
            InputError: If nothing is identifiable, or exact draws are asked of another method, of several
                logs, or of a fit that has an unknown that is not identifiable.
        """
        from jaxid.results.as_arviz import posterior_of

        return posterior_of(self, draws, chains, seed, exact)

    def case(self) -> Case:
        """Return the case with the results: estimates as guesses, and the effects that a search added.

        A known value stays known. An unknown that the log does not determine keeps its guess.
        """
        from jaxid.results.found_case import found_case

        return found_case(self)

    def save_case(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the case with the results as TOML; all else stays as in the case file, with its comments.

        File names in it are rewritten to hold from the new folder.

        Args:
            path: The file to write.
            overwrite: Whether a file that exists is replaced.

        Raises:
            InputError: If the file exists, its folder does not, or the case has been changed in Python.
        """
        from jaxid.results.found_case import save_found_case

        return save_found_case(self, Path(path), overwrite=overwrite)
