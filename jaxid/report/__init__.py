"""One HTML page that tells what was found, with its plots inside."""

from jaxid.report.data import CandidateScore as CandidateScore
from jaxid.report.data import LogView as LogView
from jaxid.report.data import ParameterRow as ParameterRow
from jaxid.report.data import ReportData as ReportData
from jaxid.report.data import SearchStep as SearchStep
from jaxid.report.data import WherePlot as WherePlot
from jaxid.report.page import render as render
from jaxid.report.page import write_report as write_report
