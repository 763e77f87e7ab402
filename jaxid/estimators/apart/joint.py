"""A joint of an arm in its loop, with the forces of the links along the motion that was measured.

In the loop of a servo a joint follows its command closely, and so do all others. The force of the links on
it then hardly differs from that along the measured motion, which the links' parameters give. With that force
as a known load the joint is an axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller
from jaxid.controllers.linear import PD, CascadePD
from jaxid.estimators.several.parts import Part
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.unknowns import CONTROLLER, Free, Parameters
from jaxid.numerics.kept import kept_jit
from jaxid.plants.link_tree import LinkTree
from jaxid.plants.loaded_axis import LoadedAxis
from jaxid.sensors.encoder import Sensor

# Most rows of a log at which the inertia of a joint's links is taken for its mean.
_ROWS = 200
# Unknown inertias of the rotors among the parameters of a tree.
ROTOR = "rotor_inertia"


@dataclass(frozen=True)
class JointAlone:
    """A joint of an arm, along the logs of a fit.

    Args:
        joint: Its number, from 0.
        machine: Machine of the joint with its unknowns of all logs; its load is that of the first.
        parts: The logs with their machines and loads.
        index: Number of each of its unknowns among those of the arm, (own,).
        links: Mean inertia of the links about the joint [kg m^2 or kg], a part of its machine's.
        at_zero: Inertia of the links about it in the arm's zero position, without payload.
        ratio: Inertia at the joint for one of its rotor, the square of its gear.
        others: Logs that are not fitted.
    """

    joint: int
    machine: Machine
    parts: tuple[Part, ...]
    index: np.ndarray
    links: float
    at_zero: float
    ratio: float
    others: tuple[Part, ...] = ()

    def of_arm(self, own: Float[np.ndarray, " own"]) -> Float[np.ndarray, " own"]:
        """Return values of the joint's unknowns as those of the arm: a rotor without the links."""
        return np.where(self._inertias, (own - self.links) / self.ratio, own)

    @property
    def slope(self) -> Float[np.ndarray, " own"]:
        """Derivative of the arm's values by those of the joint."""
        return np.where(self._inertias, 1.0 / self.ratio, 1.0)

    @property
    def _inertias(self) -> np.ndarray:
        return np.array([f.path == ("inertia",) for f in self.machine.parameters.free], dtype=bool)

    @property
    def moves(self) -> bool:
        """True if the reference of the joint moves in any log."""
        return any(map(_moves, self.parts))

    @property
    def in_motion(self) -> JointAlone:
        """The joint along those logs alone in which its reference moves."""
        kept, others = (tuple(filter(_moves, parts)) for parts in (self.parts, self.others))
        return replace(self, parts=kept, others=others)

    def with_estimate(self, own: Float[np.ndarray, " own"]) -> JointAlone:
        """Return the joint with these values of its unknowns, which are also the new guesses."""
        parts, others = (
            tuple(replace(part, machine=part.at(own)) for part in some) for some in (self.parts, self.others)
        )
        return replace(self, machine=self.machine.with_estimate(own), parts=parts, others=others)


def stands_apart(machine: Machine, parts: Sequence[Part]) -> bool:
    """Check that every joint of a machine can be fitted alone.

    It is an arm of servos, see `is_arm_of_servos`, and no unknown belongs to several joints.

    Args:
        machine: Machine of all logs.
        parts: The logs.
    """
    alone = len(unknowns_of_joints(machine)) == len(machine.parameters.free)
    return alone and is_arm_of_servos(machine, parts)


def unknowns_of_joints(machine: Machine) -> list[int]:
    """Return the numbers of an arm's unknowns that belong to one joint, and are the same in all logs."""
    if not isinstance(machine.plant, LinkTree):
        return []
    free = enumerate(machine.parameters.free)
    return [k for k, f in free if f.log is None and joint_of(f, machine) is not None]


def unknowns_of_links(machine: Machine) -> list[int]:
    """Return the numbers of an arm's unknowns that its links have, and that are the same in all logs."""
    free = enumerate(machine.parameters.free)
    return [k for k, f in free if f.effect is None and f.log is None and f.path[0] not in (ROTOR, CONTROLLER)]


def is_arm_of_servos(machine: Machine, parts: Sequence[Part]) -> bool:
    """Check for an arm of several joints whose positions were all measured, each with a servo.

    Args:
        machine: Machine of all logs.
        parts: The logs.
    """
    plant, law = machine.plant, machine.controller
    if not isinstance(plant, LinkTree) or plant.joints < 2 or type(law) not in (PD, CascadePD):
        return False
    if len(plant.driven(plant.joints)) < plant.joints or plant.shafts or machine.parameters.bodies:
        return False
    several = [part.log.reference is not None and part.log.reference.shape[1] > 1 for part in parts]
    usual = [part.machine.disturbance is None and part.machine.unforced(part.log) for part in parts]
    return all(all(part.log.measured) and not part.log.integrated for part in parts) and all(several + usual)


def joints_alone(machine: Machine, parts: Sequence[Part], others: Sequence[Part] = ()) -> list[JointAlone]:
    """Return every joint of an arm that has unknowns, with its load along each log.

    Args:
        machine: Machine of all logs, which `stands_apart`.
        parts: The logs.
        others: Logs that are not fitted.
    """
    loads, inertias = [], []
    for part in (*parts, *others):
        links, data = links_of(part.machine), part.data
        loads.append(np.asarray(of_links(links, data.q, data.qd, data.qdd)))
        inertias.append(np.asarray(inertias_of_links(links, data.q)))
    means = _mean(inertias[: len(parts)])
    at_zero = np.asarray(_inertias_at_zero(links_of(machine)))
    names = machine.parameters.names
    out = []
    for joint in range(machine.plant.joints):
        own = [
            n for n, f in zip(names, machine.parameters.free, strict=True) if joint_of(f, machine) == joint
        ]
        if not own:
            continue
        alone = []
        for part, force, own_inertia in zip((*parts, *others), loads, inertias, strict=True):
            of_joint = (part.data.qdd[:, joint], force[:, joint], own_inertia[:, joint])
            load = load_of(*of_joint, mean=means[joint], at_zero=at_zero[joint])
            one = _machine(part.machine, joint, (means[joint], at_zero[joint]), load)
            index = np.array([own.index(name) for name in one.parameters.names], dtype=int)
            alone.append(Part(part.name, _log(part, joint), one, index, _prepared(part.data, joint)))
        assert alone[0].machine.load is not None, "a joint alone has one"
        whole = _machine(machine, joint, (means[joint], at_zero[joint]), alone[0].machine.load)
        index = np.array([names.index(name) for name in own])
        ratio = float(gear_squares(machine.plant)[joint])
        fitted, beside = tuple(alone[: len(parts)]), tuple(alone[len(parts) :])
        of_its_links = (float(means[joint]), float(at_zero[joint]))
        out.append(JointAlone(joint, whole, fitted, index, *of_its_links, ratio, beside))
    return out


def _mean(inertias: Sequence[Float[np.ndarray, "time n"]]) -> Float[np.ndarray, " n"]:
    """Return the mean of inertias along logs, each at some of its rows."""
    return np.mean(np.concatenate([rows[:: max(1, len(rows) // _ROWS)] for rows in inertias]), axis=0)


def load_of(
    acceleration: Float[np.ndarray, " time"],
    force: Float[np.ndarray, " time"],
    inertia: Float[np.ndarray, " time"],
    *,
    mean: float,
    at_zero: float,
) -> Float[np.ndarray, "time 3"]:
    """Return the load of a joint alone, as `LoadedAxis` takes it.

    Args:
        acceleration: Acceleration of the joint [rad/s^2 or m/s^2].
        force: Force of the links on it [N m or N].
        inertia: Inertia of the links about it [kg m^2 or kg].
        mean: Mean of this inertia, which the axis has.
        at_zero: The inertia in the arm's zero position.
    """
    rest = (force - inertia * acceleration) / at_zero
    return np.stack([mean * acceleration - force, inertia / at_zero, rest], axis=1)


def _moves(part: Part) -> bool:
    """Check that the reference moves in a log."""
    return part.log.reference is not None and bool(np.ptp(part.log.reference) > 0)


def joint_of(f: Free, machine: Machine) -> int | None:
    """Return the only joint to which an unknown of an arm belongs; None if there is none."""
    plant = machine.plant
    if f.effect is not None:
        port = plant.effects[f.effect].port
        return port if port < plant.joints else None
    if f.path[0] == CONTROLLER:
        return plant.driven(plant.joints)[f.index] if isinstance(f.index, int) else None
    return f.index if f.path == (ROTOR,) and isinstance(f.index, int) else None


def links_of(machine: Machine) -> LinkTree:
    """Return the links of an arm alone."""
    assert isinstance(machine.plant, LinkTree), "checked by stands_apart"
    return replace(machine.plant, effects=(), rotor_inertia=None)


def mean_inertias(machine: Machine, data: Prepared) -> Float[np.ndarray, " n"]:
    """Return the mean inertia of each joint of an arm along a log, that of its rotor included, (n,)."""
    plant = machine.plant
    assert isinstance(plant, LinkTree), "an arm has links"
    links = inertias_of_links(links_of(machine), data.q)
    rotors = 0.0 if plant.rotor_inertia is None else gear_squares(plant) * np.asarray(plant.rotor_inertia)
    return _mean([np.asarray(links)]) + rotors


def gear_squares(plant: Any) -> np.ndarray:
    """Return the square of each joint's gear ratio."""
    return np.ones(plant.joints) if plant.gear_ratio is None else np.asarray(plant.gear_ratio) ** 2


@kept_jit
def of_links(plant: LinkTree, q: Array, qd: Array, qdd: Array) -> Array:
    """Return the forces of the links along a motion, (time, n)."""
    return jax.vmap(plant.inertial)(q, qd, qdd)


@kept_jit
def _inertias_at_zero(plant: LinkTree) -> Array:
    return plant.inertias_at_zero()


@kept_jit
def inertias_of_links(plant: LinkTree, q: Array) -> Array:
    """Return the inertia of the links about each joint at some positions, (time, n)."""
    zero = jnp.zeros(q.shape[1])

    def own(q: Array) -> Array:
        return jnp.diagonal(jax.jacfwd(lambda a: plant.inertial(q, zero, a))(zero))

    return jax.lax.map(own, q)


def _machine(
    machine: Machine, joint: int, of_links: tuple[float, float], load: Float[np.ndarray, "time 3"]
) -> Machine:
    """Return the machine of a joint, with its unknowns, whose links have a constant inertia.

    Args:
        machine: Machine of the arm.
        joint: The joint, from 0.
        of_links: Inertia of the links about it: the constant one, and that in the zero position.
        load: Load of the joint, see `load_of`.
    """
    plant, law = machine.plant, machine.controller
    assert isinstance(plant, LinkTree), "checked by stands_apart"
    assert law is not None, "checked by stands_apart"
    drive = plant.driven(plant.joints).index(joint)
    (links, at_zero), ratio, rotors = of_links, gear_squares(plant)[joint], plant.rotor_inertia
    rotor = 0.0 if rotors is None else ratio * float(np.asarray(rotors)[joint])

    effects: tuple[Effect, ...] = tuple(replace(e, port=0) for e in plant.effects if e.port == joint)
    scale = plant.smoothing.velocity_scale
    smoothing = replace(plant.smoothing, velocity_scale=scale if np.ndim(scale) == 0 else scale[joint])
    own = [f for f in machine.parameters.free if joint_of(f, machine) == joint]
    free = [_free(f, machine, joint, links, ratio) for f in own]
    return replace(
        machine,
        plant=LoadedAxis(
            jnp.asarray(links + rotor), mean=links, at_zero=at_zero, effects=effects, smoothing=smoothing
        ),
        parameters=Parameters(tuple(free)),
        gain=np.asarray(machine.gain)[drive : drive + 1],
        units=replace(machine.units, motion=plant.motion(joint) or machine.units.motion),
        controller=_law(law, drive, len(machine.gain)),
        sensor=_sensor(machine.sensor, joint, plant.joints),
        load=load,
    )


def own_place(
    path: tuple[str | int, ...], index: Any, machine: Machine, joint: int
) -> tuple[tuple[str | int, ...], Any] | None:
    """Return the place of a value of an arm in the plant of one of its joints alone; None if it has none."""
    if path[0] == "effects":
        numbers = _effects_at(machine, joint)
        return (("effects", numbers.index(path[1]), *path[2:]), index) if path[1] in numbers else None
    return (("inertia",), None) if path == (ROTOR,) and index == joint else None


def _effects_at(machine: Machine, joint: int) -> list[int | str]:
    """Return the numbers of the effects of an arm at a joint."""
    return [k for k, e in enumerate(machine.plant.effects) if e.port == joint]


def _free(f: Free, machine: Machine, joint: int, links: float, ratio: float) -> Free:
    """Return an unknown of an arm as one of its joint alone."""
    if f.path[0] == CONTROLLER:
        return replace(f, index=0)
    place = own_place(f.path, f.index, machine, joint)
    assert place is not None, "checked by stands_apart"
    f = replace(f, path=place[0], index=place[1])
    if f.effect is not None:
        return f
    ends = (links + ratio * max(f.lower, 0.0), links + ratio * f.upper)
    return replace(f, sign="positive", guess=links + ratio * f.guess, lower=ends[0], upper=ends[1])


def _law(law: Controller, drive: int, drives: int) -> Controller:
    """Return the law of one drive."""
    own = {f.name: getattr(law, f.name) for f in fields(law)}
    lists = {name: value for name, value in own.items() if np.ndim(value) == 1 and len(value) == drives}
    return replace(law, **{name: np.asarray(value)[drive : drive + 1] for name, value in lists.items()})


def _sensor(sensor: Sensor, joint: int, joints: int) -> Sensor:
    """Return the encoder of one joint."""

    def of(x: Any) -> Any:
        return x if np.ndim(x) == 0 or len(x) != joints else np.asarray(x)[joint : joint + 1]

    return Sensor(of(sensor.position_resolution), of(sensor.position_noise), hold=sensor.hold)


def _log(part: Part, joint: int) -> Log:
    """Return the columns of one joint of a log without a force."""
    log, drive = part.log, part.machine.plant.driven(part.machine.plant.joints).index(joint)
    assert log.reference is not None, "checked by stands_apart"
    return Log(
        log.time,
        log.position[:, joint],
        np.zeros(log.samples),
        reference=log.reference[:, drive],
        rows=log.rows,
        source=log.source,
        assumed=log.assumed,
        table=log.table,
    )


def _prepared(data: Prepared, joint: int) -> Prepared:
    """Return the filtered motion of one joint."""

    def of(x: np.ndarray) -> np.ndarray:
        return x[:, joint : joint + 1]

    motion = {name: of(getattr(data, name)) for name in ("q", "qd", "qdd", "moving", "fitted")}
    return replace(data, **motion, force=np.zeros_like(motion["q"]), measured=(True,), force_noise=None)
