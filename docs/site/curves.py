"""The curve of each effect as a picture: that of `jaxid effects KIND`, or one of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxid.effects import EFFECTS
from jaxid.model.effect import Effect, Signals
from jaxid.results.effect_page import curve_of, usual_values

# Velocity over which signs are smoothed, small beside the range of one.
_WIDTH = 1e-3
_POINTS = 401
# Length of a step response [s].
_SECONDS = 6.0
# Colours that can be read on a light and on a dark page.
_LINE, _GREY = "#3f51b5", "#808694"
Line = tuple[np.ndarray, np.ndarray, str]


def lines_of(kind: str) -> tuple[str, str, list[Line]]:
    """Return names of both axes, and lines: horizontal values, vertical values, and a label or nothing."""
    curve = curve_of(kind)
    if curve is not None:
        return curve.x_name, curve.y_name, [(curve.x, curve.y, "")]
    values = {name: jnp.asarray(value) for name, value in usual_values(kind).items()}
    effect = EFFECTS[kind](**values)
    if effect.initial_state(jnp.zeros(())) is not None:
        return "time [s] after a step of the acceleration", "force", [_after_a_step(effect)]
    return "velocity", "force", _at_low_speed(effect)


def _signals() -> Signals:
    zero = dict.fromkeys(("y", "yd", "ydd", "u", "t", "gravity", "stiffness", "damping"), 0.0)
    known = zero | {"width": _WIDTH, "dry_scale": 1.0, "normal": 1.0}
    return Signals(**{name: jnp.asarray(value) for name, value in known.items()})


def _at_low_speed(effect: Effect) -> list[Line]:
    """Return the lines of a friction that acts at rest only, or while speed grows only."""
    x = np.linspace(-1.0, 1.0, _POINTS)
    action = effect.act(replace(_signals(), yd=jnp.asarray(x)), None)
    if action.rising is not None:
        forth, back = (np.broadcast_to(part, x.shape) for part in action.rising)
        return [(x, np.where(x >= 0, -forth, back), "while speed grows"), (x, 0.0 * x, "while it falls")]
    level = float(np.max(action.stick))
    return [(np.zeros(2), np.array([level, -level]), "at rest, any force in between"), (x, 0.0 * x, "")]


def _after_a_step(effect: Effect) -> Line:
    """Integrate an effect with a state after a step of the acceleration, by the midpoint rule."""
    act, state = eqx.filter_jit(effect.act), effect.initial_state(jnp.zeros(()))
    signals, t = replace(_signals(), ydd=jnp.ones(())), np.linspace(0.0, _SECONDS, _POINTS)
    period, force = _SECONDS / (_POINTS - 1), []
    for _ in t:
        action = act(signals, state)
        force.append(float(action.force))
        middle = act(signals, state + 0.5 * period * action.rate)
        state = state + period * middle.rate
    return t, np.array(force), ""


def draw(kind: str, path: Path) -> None:
    """Write the curve of an effect as SVG.

    Args:
        kind: Name of the effect.
        path: File to write.
    """
    x_name, y_name, lines = lines_of(kind)
    settings = {"font.size": 9, "svg.hashsalt": kind, "svg.fonttype": "none", "font.family": "sans-serif"}
    with plt.rc_context(settings):
        figure, axes = plt.subplots(figsize=(3.6, 2.2), layout="constrained")
        for number, (x, y, label) in enumerate(lines):
            axes.plot(x, y, "--" if number else "-", color=_LINE, lw=1.6, label=label or None)
        if any(label for *_, label in lines):
            axes.legend(frameon=False, labelcolor=_GREY, fontsize=8)
        axes.axhline(0.0, color=_GREY, lw=0.5)
        axes.axvline(0.0, color=_GREY, lw=0.5)
        axes.set_xlabel(x_name, color=_GREY)
        axes.set_ylabel(y_name, color=_GREY)
        axes.tick_params(colors=_GREY)
        for side in axes.spines.values():
            side.set_visible(False)
        figure.savefig(path, transparent=True, metadata={"Date": None})
        plt.close(figure)
