"""A curve of each effect: its class evaluated at values that show its shape."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import matplotlib
import numpy as np

from jaxid.effects import EFFECTS
from jaxid.model.effect import Action, Effect, Signals
from jaxid.model.parameter import parameters_of

matplotlib.use("agg")
import matplotlib.pyplot as plt

# Velocity over which signs are smoothed in the curves, small beside their range of one.
_WIDTH = 1e-3
_POINTS = 401
_LINE = "#3f51b5"
# Lines and texts that can be read on a light and on a dark page.
_GREY = "#808694"


@dataclass(frozen=True)
class Drawing:
    """A curve of one effect.

    Args:
        over: Quantity of the horizontal axis, a key of `_AXES`.
        values: Parameters at which the effect is drawn; absent ones are one.
        span: Ends of the horizontal axis.
        signals: Signals that differ from zero.
        title: Words for the vertical axis, where it is not a force.
    """

    over: str
    values: dict[str, float] = field(default_factory=dict)
    span: tuple[float, float] = (-1.0, 1.0)
    signals: dict[str, float] = field(default_factory=dict)
    title: str = "force"


_DRAWINGS = {
    "stribeck_friction": Drawing("velocity", {"velocity": 0.2}),
    "velocity_hysteresis": Drawing("velocity", {"velocity": 0.3, "level_negative": 0.6}),
    "static_friction": Drawing("velocity"),
    "friction_drift": Drawing("time", {"rate": 0.2}, (0.0, 1.0), title="dry friction / its first value"),
    "hysteresis": Drawing("loop", {"stiffness": 6.0}),
    "constant_force": Drawing("position"),
    "linear_stiffness": Drawing("position"),
    "quadratic_stiffness": Drawing("position"),
    "cubic_stiffness": Drawing("position"),
    "unbalance": Drawing("position", {"moment": 1 / 9.81, "phase": -np.pi / 2}, (-np.pi, np.pi)),
    "cogging": Drawing("position", {"period": 0.5, "phase": 0.0}),
    "backlash": Drawing("elongation", {"gap": 0.8}, signals={"stiffness": 1.0}),
    "joint_flexibility": Drawing(
        "step of acceleration", {"stiffness": 40.0, "damping": 2.0}, (0.0, 3.0), {"ydd": 1.0}
    ),
    "added_mass": Drawing("acceleration"),
    "actuator_gain": Drawing("declared", {"gain": 0.8}, title="applied force"),
    "actuator_offset": Drawing("declared", {"level": 0.2}, title="applied force"),
    "saturation": Drawing("declared", {"limit": 0.6}, title="applied force"),
    "voltage_limit": Drawing("declared", {"stall": 0.8}, signals={"yd": 0.4}, title="applied force"),
    "actuator_lag": Drawing(
        "step of the declared force", {"time_constant": 0.2}, (0.0, 1.0), {"u": 1.0}, "applied force"
    ),
    "input_delay": Drawing(
        "step of the declared force", {"delay": 0.3}, (0.0, 1.0), {"u": 1.0}, "applied force"
    ),
}
_AXES = {
    "velocity": "velocity",
    "position": "position",
    "elongation": "elongation of the spring",
    "acceleration": "acceleration",
    "declared": "declared force",
    "time": "time",
    "loop": "position, to and fro",
    "step of acceleration": "time from a step of the acceleration",
    "step of the declared force": "time from a step of the declared force",
}
_VARIED = {"velocity": "yd", "position": "y", "elongation": "y", "acceleration": "ydd", "declared": "u"}
Line = tuple[np.ndarray, np.ndarray, str]


def drawing_of(kind: str) -> Drawing:
    """Return how an effect is drawn; by default over the velocity, or over the declared force."""
    over = "declared" if EFFECTS[kind].in_drive else "velocity"
    return _DRAWINGS.get(kind) or Drawing(over, title="applied force" if over == "declared" else "force")


def values_of(kind: str) -> dict[str, float]:
    """Return the values of an effect's parameters in its curve."""
    stated = drawing_of(kind).values
    cls = EFFECTS[kind]
    needed = {name for name, info in parameters_of(cls).items() if not info.optional}
    needed |= {*cls.alternatives[:1]}
    return {name: 1.0 for name in needed if name not in stated} | stated


def lines_of(kind: str) -> list[Line]:
    """Return the lines of an effect's curve: horizontal values, vertical values, and a label or nothing."""
    drawing = drawing_of(kind)
    values = values_of(kind)
    effect = EFFECTS[kind](**{name: jnp.asarray(value) for name, value in values.items()})
    x = np.linspace(*drawing.span, _POINTS)
    if drawing.over == "loop":
        return [_to_and_fro(effect, drawing)]
    if drawing.over == "time":
        return [(x, 1.0 + np.asarray(effect.dry_drift(jnp.asarray(x))), "")]
    if drawing.over.startswith("step"):
        return _step(effect, drawing, x)
    signals = replace(_signals(drawing), **{_VARIED[drawing.over]: jnp.asarray(x)})
    if effect.initial_state(jnp.zeros(())) is not None:
        return _step(effect, replace(drawing, over="step of the declared force", signals={"u": 1.0}), x + 1)
    return _static(effect, effect.act(signals, None), signals, x)


def _signals(drawing: Drawing) -> Signals:
    """Return signals that are zero, but for those of the drawing."""
    zero = dict.fromkeys(("y", "yd", "ydd", "u", "t", "gravity", "stiffness", "damping"), 0.0)
    known = zero | {"width": _WIDTH, "dry_scale": 1.0, "normal": 1.0} | drawing.signals
    return Signals(**{name: jnp.asarray(value) for name, value in known.items()})


def _static(effect: Effect, action: Action, signals: Signals, x: np.ndarray) -> list[Line]:
    """Return the lines of an effect without memory; dry friction jumps at rest."""
    yd = np.broadcast_to(signals.yd, x.shape)
    if action.drive is not None:
        return [(x, np.broadcast_to(action.drive, x.shape), "")]
    if action.rising is not None:
        forth, back = (np.broadcast_to(part, x.shape) for part in action.rising)
        grows = np.where(yd >= 0, -forth, back)
        return [(x, grows, "while speed grows"), (x, 0.0 * x, "while it falls")]
    force = np.broadcast_to(action.force, x.shape) - np.broadcast_to(action.dry, x.shape) * np.sign(yd)
    lines = [(x, np.where(yd == 0, np.nan, force) if np.any(action.dry) else force, "")]
    if np.any(action.dry):
        # Friction at rest is any force up to the level.
        level = float(np.broadcast_to(action.dry, x.shape)[x.size // 2])
        lines.append((np.zeros(2), np.array([level, -level]), ""))
    if np.any(action.stick):
        level = float(np.max(action.stick))
        lines.append((np.zeros(2), np.array([level, -level]), "at rest, any force in between"))
    # The spring whose force a clearance takes off.
    if effect.opens_spring:
        lines = [(x, force - float(signals.stiffness) * x, "")]
    return lines


def _integrated(effect: Effect, steps: list[Signals], period: float) -> np.ndarray:
    """Return the force, or the applied force, at each step, by Runge and Kutta's second-order method."""
    act = eqx.filter_jit(effect.act)
    state, out = effect.initial_state(jnp.zeros(())), []
    for signals in steps:
        action = act(signals, state)
        out.append(float(action.force if action.drive is None else action.drive))
        middle = state + 0.5 * period * action.rate
        state = state + period * act(signals, middle).rate
    return np.asarray(out)


def _to_and_fro(effect: Effect, drawing: Drawing) -> Line:
    phase = np.linspace(0.0, 2.25, 4 * _POINTS) * 2 * np.pi
    position, velocity = np.sin(phase), np.cos(phase)
    start = replace(_signals(drawing), dry_scale=jnp.asarray(1.0))
    steps = [
        replace(start, y=jnp.asarray(q), yd=jnp.asarray(v)) for q, v in zip(position, velocity, strict=True)
    ]
    return position, _integrated(effect, steps, float(phase[1] - phase[0])), ""


def _step(effect: Effect, drawing: Drawing, x: np.ndarray) -> list[Line]:
    if effect.initial_state(jnp.zeros(())) is None:
        delay = float(effect.command_delay())
        return [(x, np.where(x >= delay, 1.0, 0.0), "")]
    signals = _signals(drawing)
    return [(x, _integrated(effect, [signals] * x.size, float(x[1] - x[0])), "")]


def draw(kind: str, path: Path) -> None:
    """Write the curve of an effect as SVG.

    Args:
        kind: Name of the effect.
        path: File to write.
    """
    drawing = drawing_of(kind)
    with plt.rc_context(
        {"font.size": 9, "svg.hashsalt": kind, "svg.fonttype": "none", "font.family": "sans-serif"}
    ):
        figure, axes = plt.subplots(figsize=(3.6, 2.2), layout="constrained")
        lines = lines_of(kind)
        for number, (x, y, label) in enumerate(lines):
            style = "--" if label and number else "-"
            axes.plot(x, y, style, color=_LINE, lw=1.6, label=label or None)
        if any(label for *_, label in lines):
            legend = axes.legend(frameon=False, labelcolor=_GREY, fontsize=8)
            legend.set_in_layout(True)
        axes.axhline(0.0, color=_GREY, lw=0.5)
        axes.axvline(0.0, color=_GREY, lw=0.5)
        axes.set_xlabel(_AXES[drawing.over], color=_GREY)
        axes.set_ylabel(drawing.title, color=_GREY)
        axes.tick_params(colors=_GREY)
        for side in axes.spines.values():
            side.set_visible(False)
        figure.savefig(path, transparent=True, metadata={"Date": None})
        plt.close(figure)
