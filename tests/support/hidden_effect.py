"""Searches of logs that hide one effect of the benchmark of discovery."""

from pathlib import Path

import jaxid
from benchmarks.hidden_run import logged
from truth.axis.cases import write_case
from truth.hidden.bench import text_of
from truth.hidden.cases import HiddenCase


def search_hidden(
    folder: Path, kind: str, scale: str, noise: float, seed: int
) -> tuple[jaxid.Discovery, dict[str, float]]:
    """Search the log of a case that hides an effect, without a validation log; return the true values too."""
    case = HiddenCase("effects", kind, scale, noise, seed, hidden=(kind,), validated=False)
    return jaxid.discover(write_case(folder, text_of(case)), logged(case), refit=False), case.truth
