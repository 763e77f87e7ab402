"""Refits in simulation that cannot be had."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.discovery import refit
from jaxid.estimators.choice import Choice


@dataclass(frozen=True)
class Start:
    """Hold what a refit reads of the fit in forces."""

    identifiable: np.ndarray
    notes: tuple[str, ...] = ("first",)


def open_loop() -> SimpleNamespace:
    log = SimpleNamespace(reference=None)
    stated = SimpleNamespace(solver="auto", minimiser="auto")
    return SimpleNamespace(
        more=(),
        fit=SimpleNamespace(log=log),
        machine=SimpleNamespace(controller=None),
        case=SimpleNamespace(output_error=stated),
    )


def refitted(monkeypatch: pytest.MonkeyPatch, method: str, fit: object) -> Start:
    monkeypatch.setattr(refit, "choose_method", lambda session: Choice(method, "it is a test"))
    monkeypatch.setattr(refit, "choose_numerics", lambda *args, **more: None)
    monkeypatch.setattr(refit, "output_error", fit)
    return refit.refit_of(open_loop(), Start(np.ones(2, bool)))  # pyright: ignore[reportArgumentType, reportReturnType]


def test_a_motion_that_runs_away_keeps_the_fit_in_forces(monkeypatch):
    def runs_away(*args: object, **more: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    kept = refitted(monkeypatch, "output_error", runs_away)
    assert kept.notes == (
        "first",
        "not refitted in simulation: the simulated motion runs away from the log",
    )


def test_an_arm_without_a_controller_is_not_refitted_by_its_open_loop(monkeypatch):
    kept = refitted(monkeypatch, "inverse_dynamics", None)
    assert kept.notes[-1].startswith("not refitted in simulation: without a controller")
