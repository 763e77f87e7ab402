"""The filter of a minimal model: force and amplified noise over frequency."""

from __future__ import annotations

from matplotlib.figure import Figure

from jaxid.estimators.minimal.columns import decimator_of
from jaxid.estimators.minimal.filtering import Spectrum
from jaxid.logs.prepare import Recipe
from jaxid.results.report.axes import legend


def plot_filtering(
    spectrum: Spectrum,
    recipe: Recipe,
    rate_hz: float,
    unit: str = "N",
    size: tuple[float, float] = (7.0, 3.6),
) -> Figure:
    """Draw force and noise with the filters' ends and the resonance.

    Args:
        spectrum: As `jaxid.estimators.minimal.fit.filtering_of` gives it.
        recipe: Filter of the log, from the same function.
        rate_hz: Sampling rate of the log.
        unit: Label of the force's unit.
        size: Width and height [in].
    """
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.add_subplot()
    ax.loglog(spectrum.frequency, spectrum.force**0.5, color="#0072B2", lw=1.0, label="force")
    ax.loglog(
        spectrum.frequency,
        spectrum.noise**0.5,
        color="#D55E00",
        lw=1.0,
        label="amplified noise",
    )
    for k, f in enumerate(spectrum.natural):
        ax.axvline(f, color="#555555", ls=":", label="natural frequency" if k == 0 else None)
    ends = {
        "low-pass": (recipe.cutoff_hz, "-."),
        "parallel filter, 3 dB": (decimator_of(recipe, rate_hz).band_hz(rate_hz), "--"),
        "half the rate kept": (rate_hz / (2 * recipe.decimation), "-"),
    }
    for label, (f, style) in ends.items():
        ax.axvline(f, color="#009E73", ls=style, lw=1.0, label=label)
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel(f"density [{unit}/√Hz]")
    ax.grid(color="#e6e6e6", lw=0.7)
    legend(ax)
    return figure
