"""A user-defined plant: a class in a Python file beside the case, checked before anything is computed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.case.declared import PlantEntry
from jaxid.case.user_faults import one_line
from jaxid.case.user_file import check_kind, check_parameters, class_of_file
from jaxid.case.values import Value
from jaxid.errors import InputError
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.plants import PLANTS
from jaxid.schema import Spot

_MOTIONS = ("linear", "rotary")
# Relative; chosen: a mass matrix is asked for at sizes of order one, and rounding leaves 1e-15.
_ROUNDING = 1e-9


def user_plant(kind: str, folder: Path, spot: Spot) -> type[Plant]:
    """Import a plant, and check all of it that needs no values.

    Args:
        kind: "my_plant.py:CartPole".
        folder: Folder from which relative paths start.
        spot: Place of the kind in the case.

    Returns:
        The class; its `kind` is the text if it states none.

    Raises:
        InputError: If there is no such file or class, it does not import, or its declarations are wrong.
    """
    cls, module = class_of_file(kind, folder, Plant, "my_plant.py:CartPole", spot)
    check_kind(cls, Plant, module, PLANTS, kind, spot)

    def fault(what: str, hint: str) -> InputError:
        return spot.refuse(kind, f": {what}", hint)

    if cls.inertial is Plant.inertial:
        raise fault(f"{cls.__name__} has no method inertial", "define inertial(self, q, qd, qdd): M qdd + h")
    infos = parameters_of(cls)
    if not infos:
        hint = 'declare them as fields: mass: Array = parameter("inertia", "positive", "moving mass")'
        raise fault(f"{cls.__name__} has no parameters", hint)
    check_parameters(cls, kind, spot)
    if cls.linked:
        raise fault("linked = True", "leave it out: a case describes only a serial_arm link by link")
    for name, info in infos.items():
        if not all(isinstance(v, int | None) for v in (info.more, info.width)):
            hint = "more=0: one entry a joint; width=6: six entries"
            raise fault(f"{name} has more = {info.more!r} and width = {info.width!r}", hint)
    for name, motion in [*((n, i.motion) for n, i in infos.items()), *(("motions", m) for m in cls.motions)]:
        if motion not in (None, *_MOTIONS):
            raise fault(f"{name} has motion {motion!r}", f"use one of {', '.join(_MOTIONS)}")
    _check_joints(cls, fault)
    return cls


def _check_joints(cls: type[Plant], fault: Callable[[str, str], InputError]) -> None:
    """Check the declared number of joints, and the lists by joint."""
    if not isinstance(cls.joints, int):
        if all(info.more != 0 for info in parameters_of(cls).values()):
            hint = "state joints = 2, or declare a parameter with more=0 (one entry a joint)"
            raise fault(f"{cls.__name__}.joints is no number", hint)
        return
    if cls.joints < 1:
        raise fault(f"joints = {cls.joints}", "a plant has at least one joint")
    if cls.motions and len(cls.motions) < cls.joints:
        hint = f"state one of {', '.join(_MOTIONS)} for each joint"
        raise fault(f"motions has {len(cls.motions)} of {cls.joints} entries", hint)
    actuated = cls.actuated
    if isinstance(actuated, tuple) and (not actuated or not set(actuated) <= set(range(cls.joints))):
        raise fault(f"actuated = {actuated}", f"list driven joints, which count from 0 to {cls.joints - 1}")


def check_user_plant(entry: PlantEntry, kind: str, spot: Spot) -> None:
    """Evaluate a user's plant at its guesses and a random motion, and refuse it if it cannot be used.

    Args:
        entry: The plant as the case declares it.
        kind: The text that names it.
        spot: Place of the kind in the case.

    Raises:
        InputError: If a method fails, returns no finite numbers of the right shape, cannot be compiled, or
            the mass matrix is not symmetric and positive definite.
    """
    cls = entry.cls

    def fault(what: str, hint: str) -> InputError:
        return spot.refuse(kind, f": {what}", hint)

    def attempt(name: str, function: Callable[..., Any], *args: Any, hint: str) -> Any:
        try:
            return function(*args)
        except InputError:
            raise
        except Exception as error:
            raise fault(f"{name} raises {one_line(error, sys.modules.get(cls.__module__))}", hint) from error

    options = {"gravity": entry.gravity, "vertical": entry.vertical}
    known = {n: v for n, v in options.items() if v is not None and n in cls.__dataclass_fields__}
    values = {name: _guesses(v) for name, v in entry.parameters.items()}
    hint = f"correct {cls.__name__}"
    plant = attempt(cls.__name__, lambda: cls(**values, **known, **entry.options), hint=hint)
    random = np.random.default_rng(0)
    motion = attempt("any_motion", lambda: jnp.asarray(plant.any_motion(random)), hint=hint)
    if motion.shape != (3, entry.joints):
        given = f"an array of shape {motion.shape}"
        raise fault(f"any_motion returns {given}", "return position, velocity and acceleration: (3, n)")
    q, qd, qdd = motion

    force = attempt("inertial", plant.inertial, q, qd, qdd, hint="it takes arrays (n,) and returns one")
    _check_array("inertial", force, (entry.joints,), fault)
    ports = attempt("ports", plant.ports, q, hint="it takes an array (n,) and returns one of the ports")
    _check_ports(plant, entry, q, ports, attempt, fault)

    compiled = "use jax.numpy, and jnp.where in place of an if that depends on q"
    inertial = jax.jit(lambda *motion: plant.inertial(*motion))
    operations = attempt(
        "inertial, compiled,", lambda: str(jax.make_jaxpr(inertial)(q, qd, qdd)), hint=compiled
    )
    if "pure_callback" in operations or "io_callback" in operations:
        raise fault("inertial calls back into Python", "compute with jax.numpy alone")
    attempt("inertial, compiled,", inertial, q, qd, qdd, hint=compiled)
    attempt("ports, compiled,", jax.jit(lambda q: plant.ports(q)), q, hint=compiled)
    _check_mass(plant, q, qd, qdd, attempt, fault)
    drives = jnp.zeros(entry.drives)
    balance = lambda: plant.balance(q, qd, qdd, drives, jnp.zeros(()), plant.initial_states(drives))
    residual = attempt("balance", balance, hint=hint).residual
    _check_array("balance", residual, (entry.joints,), fault)


def _guesses(value: Value | tuple) -> Any:
    return value.guess if isinstance(value, Value) else [_guesses(v) for v in value]


def _check_array(
    name: str, value: Any, shape: tuple[int, ...], fault: Callable[[str, str], InputError]
) -> None:
    if not isinstance(value, jax.Array | np.ndarray):
        raise fault(f"{name} returns a {type(value).__name__}", f"return an array {shape}: jnp.stack([...])")
    if value.dtype.kind not in "fiu":
        raise fault(f"{name} returns {value.dtype} numbers", "return real numbers")
    if value.shape != shape:
        raise fault(f"{name} returns shape {value.shape}", f"return {shape}: one entry for each")
    if not np.all(np.isfinite(np.asarray(value))):
        raise fault(
            f"{name} is not finite at a random motion", "look for a division by zero or a negative root"
        )


def _check_ports(
    plant: Plant,
    entry: PlantEntry,
    q: Array,
    ports: Any,
    attempt: Callable[..., Any],
    fault: Callable[[str, str], InputError],
) -> None:
    """Check the number of ports, and that the joints come first."""
    cls, n = entry.cls, entry.joints
    bodies = cls.bodies(n)
    count = bodies + cls.springs(n) + cls.passives + cls.tools
    if isinstance(ports, jax.Array | np.ndarray) and ports.ndim == 1 and ports.size > count:
        hint = "take on jaxid.model.springs.WithSprings, whose ports are joints and elongations"
        raise fault(f"ports returns {ports.size} entries, and the class declares {count}", hint)
    _check_array("ports", ports, (count,), fault)
    if not np.allclose(np.asarray(ports)[:n], q):
        raise fault("ports does not begin with the joints", "return jnp.concatenate([q, ...])")
    for name in ("port_gravity", "port_normal"):
        along = attempt(name, getattr(plant, name), q, hint="it takes an array (n,) and returns one")
        # Springs have no weight: an entry for each joint is enough.
        short = getattr(along, "shape", None) == (n,)
        _check_array(name, along, (n,) if short else (count,), fault)
    for port in range(count):
        hint = 'it takes the index of a port and returns ("joint", 1)'
        place = attempt(f"place({port})", plant.place, port, hint=hint)
        if not (isinstance(place, tuple) and [type(part) for part in place] == [str, int]):
            raise fault(f"place({port}) = {place!r}", hint)
        if place[1] < 1:
            raise fault(f"place({port}) = {place}", "numbers of places count from 1")


def _check_mass(
    plant: Plant,
    q: Array,
    qd: Array,
    qdd: Array,
    attempt: Callable[..., Any],
    fault: Callable[[str, str], InputError],
) -> None:
    """Check that inertial forces are affine in qdd, and the mass matrix symmetric positive definite."""

    def parts() -> tuple[Array, Array]:
        return plant.inertial(q, qd, jnp.zeros_like(q)), jax.jacfwd(lambda a: plant.inertial(q, qd, a))(qdd)

    compiled = "use jax.numpy, through which it is differentiated"
    rest, mass = (np.asarray(x) for x in attempt("inertial, differentiated,", parts, hint=compiled))
    force = np.asarray(plant.inertial(q, qd, qdd))
    size = np.abs(force).max() + np.abs(mass).max() + np.abs(rest).max()
    if not np.allclose(rest + mass @ qdd, force, rtol=0, atol=_ROUNDING * size):
        raise fault("inertial is not affine in qdd", "return M(q) qdd + h(q, qd)")
    if not np.allclose(mass, mass.T, rtol=0, atol=_ROUNDING * size):
        raise fault(
            "the mass matrix of inertial is not symmetric", "check the terms with qdd of other joints"
        )
    if np.linalg.eigvalsh(mass)[0] <= 0:
        hint = "check the signs of the terms with qdd, and the guesses"
        raise fault("the mass matrix of inertial is not positive definite at the guesses", hint)
    if plant.diagonal and np.abs(mass - np.diag(np.diag(mass))).max() > _ROUNDING * size:
        raise fault("diagonal = True, and the mass matrix is not diagonal", "leave diagonal out")
