"""Results as small HTML tables, which a notebook shows."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from jaxid.results import as_json, as_text
from jaxid.results.by_joint import joint_rows
from jaxid.results.parameters import html_table

if TYPE_CHECKING:
    from jaxid.commands.check import Check
    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery
    from jaxid.results.result import FitResult
    from jaxid.studies.result import Study


def identification_html(result: Identification) -> str:
    """Return the parameters and the gap of an identification."""
    estimate = result.estimate
    head = f"{estimate.method}: {estimate.message}, {estimate.samples} samples"
    gap = as_text.gap_rows(result.session, result.gaps, result.noise_floor)
    return _findings(result) + _parameters(result, head) + html_table(gap)


def discovery_html(result: Discovery) -> str:
    """Return the verdict, the parameters and the steps of a discovery."""
    effects = f": {', '.join(e.label for e in result.effects)}" if result.effects else ""
    content = as_json.discovery_json(result)
    by_joint = joint_rows(content)
    caption = f"{result.verdict.replace('_', ' ')}{effects}"
    joints = html_table(by_joint) if by_joint else ""
    return _findings(result) + joints + _parameters(result, caption) + html_table(as_text.step_rows(content))


def check_html(result: Check) -> str:
    """Return the unknowns of a check with the smallest standard deviation that the log allows."""
    return html_table(as_text.check_rows(result.json()), as_text.check_summary(result).splitlines()[0])


def study_html(result: Study) -> str:
    """Return the rows of a study."""
    return html_table(as_text.study_rows(result), as_text.study_summary(result).splitlines()[0])


def _findings(result: FitResult) -> str:
    """Return the findings as a list, the first as a paragraph above it."""
    first, *others = (escape(finding) for finding in result.findings)
    below = "".join(f"<li>{text}</li>" for text in others)
    return f"<p><b>{first}</b></p>" + (f"<ul>{below}</ul>" if below else "")


def _parameters(result: FitResult, caption: str) -> str:
    return html_table(as_text.parameter_rows(result), caption)
