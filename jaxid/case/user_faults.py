"""Faults of a user's classes: each is one line about the class, and not a traceback from compiled code."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.errors import InputError
from jaxid.model.effect import Action, Effect, Signals
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.names import PLACES
from jaxid.numerics.affine import depends
from jaxid.schema import Spot

# Names that have a special meaning in [[effects]] of a case.
_RESERVED = ("kind", "port", "shared", *PLACES)
# Class attributes that name a parameter.
_NAMING = ("sliding_level", "break_away_level", "stribeck_velocity", "viscous_coefficient", "drive_gain")
# Longest text of an exception that a message repeats.
_LONGEST = 160
# Begin of the names under which users' files are imported.
USERS = "jaxid_user_"
# Number of random motions at which an effect is evaluated.
_MOTIONS = 64
# Chosen [s]: no drive is that late, and a loop keeps every command of that time.
_LONGEST_DELAY = 60.0


class _Fault(Exception):
    """A fault of a class: the description of the fault, and a hint."""


def one_line(error: BaseException, module: ModuleType | Path | None = None) -> str:
    """Return an exception as one short line: type, text, and the line of the user's file that raised it.

    Args:
        error: The exception, as caught.
        module: Module of the user's class, or its file; None: no line is stated.
    """
    text = str(error).strip().splitlines()
    # The text of an error from compiled code is a traceback, whose last line says what happened.
    at_end = any("Traceback (most recent call last)" in line for line in text)
    first = text[-1 if at_end else 0].strip() if text else ""
    if len(first) > _LONGEST:
        first = first[:_LONGEST] + " ..."

    at = _line_of(error, module)
    return f"{type(error).__name__}: {first}{at}" if first else f"{type(error).__name__}{at}"


def _line_of(error: BaseException, module: ModuleType | Path | None) -> str:
    """Return ", line N" for the last line of the user's file in a traceback; empty if there is none."""
    file = str(getattr(module, "__file__", module))
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    return f", line {lines[-1]}" if lines else ""


@contextmanager
def named_faults() -> Iterator[None]:
    """Raise an error from a user's file as one line with file, class, method and line; use as a decorator.

    Most faults are found when a case is read. This is for those that depend on values, such as a class that
    refuses the true values of its parameters.

    Raises:
        InputError: In place of any other error that a user's code raises.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        files = {
            str(module.__file__)
            for name, module in list(sys.modules.items())
            if name.startswith(USERS) and getattr(module, "__file__", None)
        }
        frames = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
        own = [code for code in frames if code.co_filename in files]
        if not own:
            raise
        code, path = own[-1], Path(own[-1].co_filename)
        what = f"{code.co_qualname} fails ({one_line(error, path)})"
        raise InputError(
            what, where=str(path), hint=f"correct {path.name}, or the values in the case"
        ) from error


def check_declaration(cls: type[Effect], kind: str, spot: Spot) -> None:
    """Check the declarations of a class and of its parameters, without calling it.

    Args:
        cls: Class of the effect.
        kind: Kind as the case states it.
        spot: Place of the kind in the case.

    Raises:
        InputError: If a name or a parameter is declared in a way that a case cannot use.
    """
    if not isinstance(getattr(cls, "kind", ""), str):
        raise spot.refuse(kind, f": its kind is {cls.kind!r}", 'write kind = "my_effect", or leave it out')
    infos = parameters_of(cls)
    for name, info in infos.items():
        _check_info(name, info, kind, spot)
    for attribute in _NAMING:
        named = getattr(cls, attribute)
        if named is not None and named not in infos:
            what = f": {attribute} = {named!r} names no parameter of {cls.__name__}"
            raise spot.refuse(kind, what, f"name one of {', '.join(infos) or 'its parameters'}")


def _check_info(name: str, info: ParameterInfo, kind: str, spot: Spot) -> None:
    if name in _RESERVED:
        raise spot.refuse(
            kind, f": a parameter cannot be called {name!r}", "a case uses that name; rename it"
        )
    for what, value in (("dimension", info.dimension), ("sign", info.sign), ("doc", info.doc)):
        if not isinstance(value, str):
            hint = f'write {name} = parameter("force", "nonnegative", "what it is")'
            raise spot.refuse(kind, f": {name} has {what} {value!r}, which is not a text", hint)
    if info.more is not None or info.width is not None:
        hint = "leave out more and width: in a case a list has one entry for each joint"
        raise spot.refuse(kind, f": {name} is a list, which only plants can have", hint)


def check_action(effect: Effect, where: str) -> None:
    """Check the return values of an effect, by tracing it once on symbolic signals.

    Args:
        effect: The effect at some values.
        where: Place of the effect, for the message.

    Raises:
        InputError: If a method raises, or returns something that a balance of forces cannot use.
    """
    try:
        _check_action(effect)
    except _Fault as fault:
        what, hint = fault.args
        raise InputError(f"{_named(type(effect))}{what}", where=where, hint=hint) from fault.__cause__


def _named(cls: type[Effect]) -> str:
    """Return file and class, if the kind does not show them."""
    if ":" in cls.kind:
        return ""
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    return f"{Path(file).name if file else cls.__module__}:{cls.__name__}: "


def _check_action(effect: Effect) -> None:
    cls = type(effect)
    state = _initial_state(effect)
    scalar = jnp.zeros(())
    signals = Signals(*[scalar] * len(Signals.__dataclass_fields__))
    act = lambda e, x, z: e.act(x, z)
    hint = "define act(self, x, state) -> Action; x has " + ", ".join(Signals.__dataclass_fields__)
    action = _traced("act", act, effect, signals, state, hint=hint)
    if not isinstance(action, Action):
        raise _Fault(f"act returns {_kind_of(action)}, not an Action", "return Action(force=...)")

    for name in ("force", "dry", "stick", "drive"):
        _need_scalar(f"act: Action.{name}", getattr(action, name), optional=name == "drive")
    rising = action.rising
    if rising is not None:
        if not isinstance(rising, (tuple, list)) or len(rising) != 2:
            hint = "give two levels, forwards and backwards: rising=(a, b)"
            raise _Fault("act: Action.rising is not a pair", hint)
        for level in rising:
            _need_scalar("act: Action.rising", level)
    _check_rate(effect, action, signals, state)

    if not (isinstance(action.stick, (int, float)) and action.stick == 0) and cls.break_away_level is None:
        hint = 'add break_away_level = "<name of its parameter>" to the class'
        raise _Fault("act returns stick, but the class does not say that it acts at rest", hint)
    hint = "return a number: command_delay a time in s, dry_drift a relative change"
    _need_scalar("command_delay", _traced("command_delay", lambda e: e.command_delay(), effect, hint=hint))
    _need_scalar("dry_drift", _traced("dry_drift", lambda e, t: e.dry_drift(t), effect, scalar, hint=hint))
    _check_values(effect)


def _check_values(effect: Effect) -> None:
    """Check the delay, and that an effect is finite somewhere."""
    delay = float(effect.command_delay())
    if not 0.0 <= delay <= _LONGEST_DELAY:
        hint = f"return a time between 0 and {_LONGEST_DELAY:g} s at every value of the parameters"
        raise _Fault(f"command_delay is {delay:g} s at the guesses", hint)
    for name, finite, _ in _finite(effect):
        if not finite.any():
            hint = "correct act, or its guesses: a division by zero or the root of a negative number"
            raise _Fault(f"act: Action.{name} is not finite at any of {_MOTIONS} random motions", hint)


def where_not_finite(effect: Effect) -> str:
    """Return a line about random motions at which an effect is not finite; empty if there are none."""
    for name, finite, x in _finite(effect):
        if not finite.all():
            k = int(np.argmin(finite))
            at = f"y = {float(x.y[k]):.3g}, yd = {float(x.yd[k]):.3g}, u = {float(x.u[k]):.3g}"
            return f"act of effect {type(effect).kind}: Action.{name} is not finite at {at}"
    return ""


def _finite(effect: Effect) -> list[tuple[str, np.ndarray, Signals]]:
    """Return by entry of the action whether it is finite at random motions, and the motions."""
    count = len(Signals.__dataclass_fields__)
    x = Signals(*jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (count, _MOTIONS))))
    # Times, widths and factors of friction are positive.
    x = eqx.tree_at(lambda x: (x.t, x.width, x.dry_scale), x, replace_fn=jnp.abs)

    def act(x: Signals) -> Action:
        return effect.act(x, effect.initial_state(x.u))

    module = _module(effect)
    try:
        operations = str(jax.make_jaxpr(act)(jax.tree.map(lambda a: a[0], x)))
        if any(name in operations for name in ("pure_callback", "io_callback")):
            raise _Fault("act calls back into Python", "compute with jax.numpy alone")
        action = jax.vmap(act)(x)
    except _Fault:
        raise
    except Exception as error:
        raise _Fault(f"act fails at random motions ({one_line(error, module)})", "correct act") from error
    out = []
    for name in Action.__dataclass_fields__:
        for leaf in jax.tree.leaves(getattr(action, name)):
            finite = np.isfinite(np.asarray(leaf)).reshape(_MOTIONS, -1).all(axis=1)
            out.append((name, finite, x))
    return out


def _initial_state(effect: Effect) -> Any:
    hint = "return None, a number as jnp.zeros_like(u), or a vector as jnp.zeros((2,), u.dtype)"
    try:
        state = effect.initial_state(jnp.zeros(()))
    except Exception as error:
        raise _Fault(f"initial_state fails ({one_line(error, _module(effect))})", hint) from error
    if state is None:
        return None
    if not isinstance(state, (jax.Array, np.ndarray)) or not jnp.issubdtype(state.dtype, jnp.floating):
        raise _Fault(f"initial_state returns {_kind_of(state)}, not an array of numbers", hint)
    if state.ndim > 1:
        raise _Fault(f"initial_state returns an array of shape {state.shape}", hint)
    return state


def _check_rate(effect: Effect, action: Action, signals: Signals, state: Any) -> None:
    if state is None:
        if action.rate is not None:
            hint = "define initial_state(self, u), or leave the rate out"
            raise _Fault("act returns a rate, but there is no state", hint)
        return
    if action.rate is None:
        raise _Fault("has a state, but act returns no rate", "return Action(..., rate=<its time derivative>)")
    shape = getattr(action.rate, "shape", ())
    if not _is_number(action.rate) or shape != state.shape:
        given = f"of shape {shape}" if _is_number(action.rate) else f"{_kind_of(action.rate)}"
        hint = f"the rate has the shape of the state, {state.shape}"
        raise _Fault(f"act: Action.rate is {given}", hint)

    slope = lambda x, z: jax.jacfwd(lambda z: jnp.asarray(effect.act(x, z).rate))(z)
    if depends(lambda z: slope(signals, z), (state,)):
        hint = "a rate is a + b state, with a and b functions of the signals"
        raise _Fault("act: Action.rate is not affine in the state", hint)
    if state.ndim == 1 and depends(lambda x: slope(x, state), (signals,)):
        hint = "let it be a + B state with constant B, or use one number as the state"
        raise _Fault("act: the rate of a vector has coefficients that change with the signals", hint)


def _traced(name: str, function: Any, *args: Any, hint: str) -> Any:
    """Return the shapes of a method's results; a fit traces it too, so that the errors are the same."""
    module = _module(args[0])
    try:
        return eqx.filter_eval_shape(function, *args)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        at = _line_of(error, module)
        said = f"{name} needs the value of a signal or a parameter ({type(error).__name__}{at})"
        hint = "use jnp.where in place of if, and jax.numpy in place of math and numpy"
        raise _Fault(said, hint) from error
    except Exception as error:
        raise _Fault(f"{name} fails ({one_line(error, module)})", hint) from error


def _module(effect: Effect) -> ModuleType | None:
    return sys.modules.get(type(effect).__module__)


def _need_scalar(name: str, value: Any, *, optional: bool = False) -> None:
    if value is None and optional:
        return
    if not _is_number(value):
        raise _Fault(f"{name} is {_kind_of(value)}, not a number", "give a number or a JAX scalar")
    shape = getattr(value, "shape", ())
    if shape != ():
        hint = "return one number: it stands for one place at one instant"
        raise _Fault(f"{name} has shape {shape}, not a single number", hint)


def _is_number(value: Any) -> bool:
    if isinstance(value, (int, float, np.number)):
        return True
    return isinstance(value, (jax.ShapeDtypeStruct, jax.Array, np.ndarray)) and value.dtype.kind in "fiub"


def _kind_of(value: Any) -> str:
    if value is None:
        return "nothing (None)"
    if isinstance(value, (jax.ShapeDtypeStruct, jax.Array, np.ndarray)):
        kind = "" if value.dtype.kind in "fiub" else f"{value.dtype} "
        return f"a {kind}number" if value.shape == () else f"an array of shape {value.shape}"
    return f"a {type(value).__name__}"
