"""One effect for the terminal: formula, parameters, its curve, and a snippet for a case."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.case.kinds import known_kinds
from jaxid.errors import InputError, suggest
from jaxid.model.parameter import parameters_of
from jaxid.model.units import Units
from jaxid.results.aligned import aligned
from jaxid.results.catalogue import SIGNS
from jaxid.results.effect_words import words_of
from jaxid.results.terminal_plot import terminal_plot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaxid.model.effect import Effect

# Values of parameters in curves and snippets, by name; one for any other.
_USUAL = {
    "velocity": 0.2,
    "period": 0.5,
    "phase": 0.0,
    "gap": 0.5,
    "limit": 0.6,
    "level_negative": 1.0,
    "time_constant": 0.1,
    "delay": 0.2,
    "rate": 0.5,
    "gain": 0.8,
    "stiffness": 4.0,
}
_POINTS = 201
_STEP = "time [s] after a step of the command"


@dataclass(frozen=True)
class Curve:
    """The curve of an effect.

    Args:
        x_name, y_name: Names of the axes.
        x, y: Its points.
    """

    x_name: str
    y_name: str
    x: np.ndarray
    y: np.ndarray


def effect_page(kind: str) -> str:
    """Return an effect as text: formula, machines in which it is met, parameters, curve and snippet.

    Raises:
        InputError: If the kind is not known.
    """
    cls = _class_of(kind)
    doc = (cls.__doc__ or "").strip()
    words = words_of(kind, doc, in_drive=cls.in_drive, of_spring=cls.of_spring)
    lines = [f"{kind}: {words.name}", f"  {words.formula}"]
    lines += [f"  met in {words.met}"] if words.met else []
    lines += [f"  acts on the {words.part}"]
    lines += ["", aligned(_parameter_rows(cls))]
    curve = curve_of(kind)
    if curve is not None:
        shown = ", ".join(f"{name} = {value:g}" for name, value in usual_values(kind).items())
        lines += ["", f"{curve.y_name} over {curve.x_name}, with {shown}:"]
        lines += [terminal_plot(curve.x, curve.y)]
    lines += ["", "In a case:", "", snippet(kind)]
    return "\n".join(lines)


def snippet(kind: str) -> str:
    """Return a table [[effects]] of a case with all parameters of an effect as unknowns.

    Raises:
        InputError: If the kind is not known.
    """
    cls = _class_of(kind)
    linear, rotary = Units("linear"), Units("rotary")
    values = usual_values(kind)
    rows = []
    for name, info in parameters_of(cls).items():
        units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
        unit = units[0] if units[0] == units[1] else f"{units[0]}, or {units[1]} of a joint that turns"
        # Of parameters that replace each other one is given.
        off = "" if name in values else "# "
        rows.append([f"{off}{name} = {{ guess = {values.get(name, 1.0):g} }}", f"# {unit}; {info.doc}"])
    width = max((len(row[0]) for row in rows), default=0)
    lines = [f"{text.ljust(width)}  {note}" for text, note in rows]
    place = "spring" if cls.with_springs else "joint"
    return "\n".join(["[[effects]]", f'kind = "{kind}"', f"# {place} = 1  # of several", *lines])


def usual_values(kind: str) -> dict[str, float]:
    """Return values for the parameters of an effect at which its curve shows its shape."""
    values, parameters = {}, parameters_of(_class_of(kind))
    given_one = False
    for name, info in parameters.items():
        if info.optional:
            if given_one or name not in _class_of(kind).alternatives:
                continue
            given_one = True
        values[name] = _class_of(kind).shown_at.get(name, _USUAL.get(name, 1.0))
    return values


def curve_of(kind: str) -> Curve | None:
    """Return the curve of an effect over the quantity on which it depends; None if it has no such curve.

    An effect with memory is shown along a sine of the position, or after a step of the command.

    Raises:
        InputError: If the kind is not known.
    """
    _class_of(kind)
    from jaxid.effects import EFFECTS

    cls = EFFECTS[kind]
    values: dict[str, Any] = {name: np.asarray(value) for name, value in usual_values(kind).items()}
    effect = cls(**values)
    shown = effect.curve()
    if shown is not None:
        return Curve(*shown)
    if cls.delays_command():
        t = np.linspace(-0.2, 1.0, _POINTS)
        late = float(np.asarray(effect.command_delay()))
        return Curve(
            "time [s] after a step of the command", "force of the drive", t, (t >= late).astype(float)
        )
    memory = effect.initial_state(np.zeros(()))
    if memory is not None:
        return _along(effect, np.asarray(memory, float))
    across = np.linspace(-1.0, 1.0, _POINTS)
    # A drive is asked for more than it gives, so that the limits of its supply show.
    asked = {"u": np.full(_POINTS, 2.0)} if cls.in_drive or cls.needs_drive else {}
    tried = (
        ("velocity", {"yd": across, **asked}),
        ("elongation" if cls.opens_spring else "position", {"y": across}),
        ("acceleration", {"ydd": across}),
        ("force that the drive is asked for", {"u": across}),
        ("time [s]", {"t": across + 1.0}),
    )
    for name, signals in tried:
        force, what = _force(effect, **signals)
        if np.all(np.isfinite(force)) and np.ptp(force) > 1e-9:
            return Curve(name, what, next(iter(signals.values())), force)
    force, what = _force(effect, y=across)
    return Curve("position", what, across, force) if np.all(np.isfinite(force)) and force.any() else None


def plot_curve(kind: str, curve: Curve) -> Figure:
    """Draw the curve of an effect."""
    from matplotlib.figure import Figure

    from jaxid.results.report.axes import dress

    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    ax = figure.add_subplot()
    ax.plot(curve.x, curve.y, color="#0072b2", lw=1.6)
    dress(ax, curve.x_name, curve.y_name)
    ax.set_title(words_of(kind).formula, fontsize=9.0, loc="left")
    return figure


def _class_of(kind: str) -> type[Effect]:
    known = known_kinds().effects
    if kind not in known:
        raise InputError(f"effect {kind!r} is not known", hint=suggest(kind, known, limit=len(known)))
    return known[kind]


def _parameter_rows(cls: type[Effect]) -> list[list[str]]:
    linear, rotary = Units("linear"), Units("rotary")
    rows = [["parameter", "sign", "linear", "rotary", "description"]]
    for name, info in parameters_of(cls).items():
        units = [either.label(info.dimension, info.motion) for either in (linear, rotary)]
        rows.append([f"{name}?" if info.optional else name, SIGNS[info.sign], *units, info.doc])
    return rows


def _force(effect: Effect, state: Any = None, **signals: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the force of an effect, or that of the drive after it, and the name of it."""
    from jaxid.model.effect import Signals

    size = np.shape(next(iter(signals.values())))
    known: dict[str, Any] = {name: np.zeros(size) for name in ("y", "yd", "ydd", "u", "t")}
    known |= {"width": np.asarray(1e-3), "dry_scale": np.ones(()), "gravity": np.zeros(())}
    known |= {"normal": np.ones(()), "stiffness": np.ones(()), "damping": np.zeros(())}
    known |= signals
    action = effect.act(Signals(**known), state)
    if action.drive is not None:
        return np.broadcast_to(np.asarray(action.drive, float), size), "force of the drive"
    drift = np.asarray(effect.dry_drift(known["t"]), float)
    if np.ptp(drift) > 0:
        return np.broadcast_to(1.0 + drift, size), "factor of dry friction"
    force = np.asarray(action.force, float) - np.asarray(action.dry, float) * np.sign(known["yd"])
    return np.broadcast_to(force, size), "force"


def _along(effect: Effect, state: np.ndarray) -> Curve | None:
    """Return the curve of an effect with memory: over a growing sine of position, or after a step."""
    if state.ndim:
        # A part behind a spring answers with its own motion.
        return None
    steps, duration = 2000, 1.0
    t = np.linspace(0.0, duration, steps)
    one = lambda x: np.asarray([float(x)])
    from jaxid.model.effect import Signals

    y, yd = np.sin(4 * np.pi * t), 4 * np.pi * np.cos(4 * np.pi * t)
    drive, force, x = [], [], float(state)
    for k in range(steps):
        signals = Signals(
            y=one(y[k]), yd=one(yd[k]), ydd=one(0), u=one(1), t=one(t[k]), width=one(1e-3), dry_scale=one(1),
            gravity=one(0), normal=one(1), stiffness=one(1), damping=one(0),
        )  # fmt: skip
        action = effect.act(signals, one(x))
        drive.append(np.nan if action.drive is None else float(np.asarray(action.drive)[0]))
        force.append(float(np.ravel(np.asarray(action.force))[0]))
        x += duration / steps * float(np.ravel(np.asarray(action.rate))[0])
    if np.all(np.isfinite(drive)):
        return Curve(_STEP, "force of the drive", t, np.array(drive))
    return Curve("position, back and forth", "force", y, np.array(force)) if np.ptp(force) else None
