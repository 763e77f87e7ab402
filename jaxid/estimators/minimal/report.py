"""Report of a minimal model: the object of result.json, notes, and the rows of a table."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxid.estimators.minimal.basis import Basis
from jaxid.estimators.minimal.models import Form
from jaxid.estimators.minimal.statistics import DROPPED, Constraint, MinimalFit
from jaxid.logs.prepare import Recipe


def minimal_json(
    form: Form,
    fit: MinimalFit,
    basis: Basis,
    constraint: Constraint | None,
    modes: dict[str, list[tuple[float, float]]],
    recipe: Recipe,
) -> dict[str, Any]:
    """Return the `minimal` object of result.json.

    Args:
        form: Form of the model.
        fit: The fit of its coefficients.
        basis: The basis of the coefficients.
        constraint: Test of the coefficients against those of a plant, if there is one.
        modes: Natural frequencies and their standard deviations by name [Hz].
        recipe: Filters of the log.
    """
    rows = zip(basis.names, basis.units, fit.chi, fit.precision.std, fit.white, fit.without, strict=True)
    return {
        "model": form.name,
        "equation": form.equation,
        "coefficients": {
            name: {
                "value": float(c),
                "unit": unit,
                "std": float(s),
                "relative_std": float(s / abs(c)),
                "std_white": float(w),
                "relative_std_white": float(w / abs(c)),
                "residual_without": float(g),
            }
            for name, unit, c, s, w, g in rows
        },
        "condition": fit.condition,
        "condition_scaled": fit.condition_scaled,
        "residual_norm": fit.relative,
        "droppable": droppable(fit, basis),
        "constraint": None
        if constraint is None
        else {
            "chi_square": constraint.chi_square,
            "degrees_of_freedom": constraint.freedom,
            "p_value": constraint.p_value,
            "regrouped": list(constraint.regrouped),
        },
        "natural_frequency_hz": {
            name: [{"value": v, "std": s} for v, s in mode] for name, mode in modes.items()
        },
        "preprocess": {
            "cutoff_hz": recipe.cutoff_hz,
            "order": recipe.order,
            "decimation": recipe.decimation,
            "trim": recipe.trim,
            "derivatives": recipe.derivatives,
        },
    }


def droppable(fit: MinimalFit, basis: Basis) -> list[str]:
    """Return the coefficients without which, one at a time, the residual's norm grows by less than 1 %."""
    return [n for n, g in zip(basis.names, fit.without, strict=True) if g - 1 < DROPPED]


def minimal_notes(
    form: Form, fit: MinimalFit, basis: Basis, constraint: Constraint | None
) -> tuple[str, ...]:
    """Return the notes about a model and its fit."""
    out = [f"minimal model {form.equation}: {form.name.replace('_', ' ')}"]
    if form.hidden:
        out.append("dry friction of joints without an encoder acts in the direction of the motor")
    unidentifiable = [n for n, ok in zip(basis.names, fit.precision.identifiable, strict=True) if not ok]
    if unidentifiable:
        out.append(f"coefficients that are not identifiable from this log: {', '.join(unidentifiable)}")
    if constraint is not None:
        names = ", ".join(constraint.regrouped)
        moved = f", {names} regrouped with the motor's" if names else ""
        verdict = "are not" if constraint.p_value < 0.01 else "may be"
        parameters = len(fit.chi) - constraint.freedom
        out.append(
            f"{len(fit.chi)} coefficients {verdict} those of a plant with {parameters} parameters{moved}: "
            f"chi-square {constraint.chi_square:.3g}, p = {constraint.p_value:.2g}"
        )
    return tuple(out)


def minimal_rows(content: dict[str, Any]) -> tuple[list[list[str]], list[str]]:
    """Return the rows of the printed table, and the lines below it.

    Args:
        content: The `minimal` object of result.json.
    """
    rows = [["coefficient", "value", "std", "relative", "white", "unit", "without it"]]
    for name, c in content["coefficients"].items():
        rows.append(
            [
                name,
                _number(c["value"]),
                _number(c["std"]),
                _percent(c["relative_std"]),
                _percent(c["relative_std_white"]),
                c["unit"],
                f"residual +{_percent(c['residual_without'] - 1)}",
            ]
        )
    free = content["natural_frequency_hz"]
    lines = [
        f"natural frequency, {name.replace('_', ' ')}: "
        + ", ".join(f"{_number(m['value'])} +- {_number(m['std'])} Hz" for m in modes)
        for name, modes in free.items()
        if modes
    ]
    lines.append(
        f"condition number {_number(content['condition'])} (columns of unit length: "
        f"{_number(content['condition_scaled'])}), relative residual {_percent(content['residual_norm'])}"
    )
    return rows, lines


def _number(x: float | None) -> str:
    return "-" if x is None or not np.isfinite(x) else f"{x:.4g}"


def _percent(x: float | None) -> str:
    return "-" if x is None or not np.isfinite(x) else f"{100 * x:.3g} %"
