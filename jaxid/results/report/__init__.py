"""One HTML page with the results of a command, its plots inside."""

from typing import Any

from jaxid.results.report.data import CandidateScore as CandidateScore
from jaxid.results.report.data import LogView as LogView
from jaxid.results.report.data import ParameterRow as ParameterRow
from jaxid.results.report.data import ReportData as ReportData
from jaxid.results.report.data import SearchStep as SearchStep
from jaxid.results.report.data import WherePlot as WherePlot


def __getattr__(name: str) -> Any:
    """Load the page, which imports matplotlib, on first use."""
    if name == "render":
        from jaxid.results.report.page import render

        return render
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
