"""Values of a fit that cannot be right beside what is known, and values that a log does not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxid.consistency.weight import least_inertia
from jaxid.estimators.estimate import Estimate
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.plant import Plant, inertia_at
from jaxid.model.unknowns import Free, in_loop
from jaxid.plants.link_tree import LinkTree
from jaxid.results.report.numbers import plain, pretty_unit, with_std
from jaxid.session import Session

# A positive unknown so many times above or below its guess is questioned.
_OFF = 1e3
# An inertia below this part of another one in the same unit is next to nothing.
_NOTHING = 1e-3
# Relative distance from a bound at which a value is at the bound.
_AT_BOUND = 1e-6
# Standard deviations by which an inertia must be below the least one that is possible.
_SIGMAS = 3.0
# The inertia of a link about the axis of its joint; further links only add to it.
_ABOUT_AXIS = "inertia_zz"
# Parameters of a link that enter that inertia.
_AXIAL = ("mass", "first_moment_x", "first_moment_y", "inertia_zz")


@dataclass(frozen=True)
class Remark:
    """A remark on one value.

    Args:
        name: Name of the parameter in results.
        text: The remark as a sentence without its full stop.
        impossible: Whether no machine has such a value.
        contradicts: Whether it contradicts a value that the case declares, however small the residual is.
        forbids: Whether no model with it is complete, however small the residual is.
    """

    name: str
    text: str
    impossible: bool = False
    contradicts: bool = False
    forbids: bool = False


def remarks_on(session: Session, estimate: Estimate) -> list[Remark]:
    """Return remarks on impossible values, values at a bound, and values below their standard deviation."""
    # The parameters of the estimate's machine have the estimates as guesses.
    declared = {f.name: f for f in session.machine.parameters.free}
    bounds = dict(zip(declared, zip(*session.machine.parameters.bounds, strict=True), strict=True))
    known = _known_inertias(estimate)
    out = _beyond_memory(session, estimate)
    beyond = {r.name for r in out}
    for k, f in enumerate(estimate.machine.parameters.free):
        if f.name in beyond:
            continue
        if not estimate.identifiable[k] or not np.isfinite(estimate.theta[k]) or in_loop(f.path):
            continue
        value, std, info = float(estimate.theta[k]), float(estimate.std[k]), _info(estimate.machine.plant, f)
        remark = (
            _negative(f, value, std, info)
            or _more_than_whole(estimate, f, value, std)
            or _too_fine(session, f, value, info)
            or _too_light(f, value, known, info)
            or (f.name in declared and _at_bound(declared[f.name], value, *bounds[f.name]))
            or (f.name in declared and _far_off(declared[f.name], value))
            or _undetermined(f, value, std)
        )
        out += [remark] if remark else []
    return [*_unreal_links(estimate), *out]


def undetermined(estimate: Estimate) -> list[str]:
    """Return the names of the parameters that a log does not determine at all.

    These are not identifiable, or of the sign that physics demands and smaller than their standard deviation.
    """
    free = estimate.machine.parameters.free
    rows = zip(free, estimate.theta, estimate.std, estimate.identifiable, strict=True)
    return [f.name for f, v, s, ok in rows if not ok or (f.sign != "free" and s >= abs(v))]


def _info(plant: Plant, f: Free) -> ParameterInfo | None:
    owner = plant if f.effect is None else plant.effects[f.effect]
    return parameters_of(type(owner)).get(str(f.path[-1]))


def _with_unit(value: float, unit: str) -> str:
    return f"{plain(value)} {pretty_unit(unit)}".strip()


def _negative(f: Free, value: float, std: float, info: ParameterInfo | None) -> Remark | None:
    """Question a negative friction, or a negative inertia about the axis of a joint."""
    about_axis = info is not None and info.dimension == "inertia" and f.path[-1] == _ABOUT_AXIS
    if value >= 0 or not (f.sign != "free" or about_axis):
        return None
    shown = f"{f.name} = {' ± '.join(with_std(value, std))} {pretty_unit(f.unit)}".strip()
    mass = info is not None and info.dimension == "inertia"
    if value + _SIGMAS * std >= 0:
        text = f"{shown} is negative, which no machine is: the log does not determine it"
        return Remark(f.name, text, impossible=value + std < 0, forbids=mass)
    text = f"{shown} is negative, which no machine is"
    return Remark(f.name, text, impossible=True, contradicts=True, forbids=mass)


def _more_than_whole(estimate: Estimate, f: Free, value: float, std: float) -> Remark | None:
    """Question an inertia behind a spring that exceeds the inertia of its joint, of which it is a part."""
    plant = estimate.machine.plant
    if f.effect is None or f.path[-1] != "load_inertia" or not plant.effects[f.effect].adds_spring:
        return None
    whole = inertia_at(plant, int(plant.effects[f.effect].port))
    if value <= whole:
        return None
    text = (
        f"{f.name} = {' ± '.join(with_std(value, std))} {pretty_unit(f.unit)} is a part of the joint's "
        f"inertia, and exceeds it, {_with_unit(whole, f.unit)}"
    )
    return Remark(f.name, text, impossible=value - _SIGMAS * std > whole, forbids=True)


def _too_fine(session: Session, f: Free, value: float, info: ParameterInfo | None) -> Remark | None:
    """Question the period of a force over position that is shorter than the encoder can show."""
    if f.path[-1] != "period" or info is None or info.dimension != "position" or f.effect is None:
        return None
    port = int(session.machine.plant.effects[f.effect].port) if _declared(session, f) else 0
    q = session.fit.log.filled
    steps = np.abs(np.diff(q[:, min(port, q.shape[1] - 1)]))
    count = float(np.min(steps[steps > 0], initial=np.inf))
    stated = session.machine.sensor.position_resolution
    if stated is not None:
        count = float(np.max(np.asarray(stated)))
    if value >= 2 * count or not np.isfinite(count):
        return None
    text = f"{f.name} = {_with_unit(value, f.unit)} is shorter than two counts of the encoder"
    return Remark(f.name, f"{text}, {_with_unit(2 * count, f.unit)}", impossible=True)


def _declared(session: Session, f: Free) -> bool:
    return f.effect is not None and f.effect < len(session.machine.plant.effects)


def _known_inertias(estimate: Estimate) -> dict[str, tuple[float, str]]:
    """Return the largest known inertia with its name, by unit."""
    machine, plant = estimate.machine, estimate.machine.plant
    unknown = set(machine.parameters.places)
    owners: list[tuple[str, object, tuple[str | int, ...]]] = [("", plant, ())]
    owners += [(f"{e.kind}.", e, ("effects", k)) for k, e in enumerate(plant.effects)]
    out: dict[str, tuple[float, str]] = {}
    for label, owner, before in owners:
        for name, info in parameters_of(type(owner)).items():
            value = getattr(owner, name)
            if info.dimension != "inertia" or info.motion is not None or value is None or np.ndim(value) > 1:
                continue
            unit = machine.unit(info.dimension)
            for index, v in enumerate(np.atleast_1d(np.asarray(value, dtype=float)).tolist()):
                at = None if np.ndim(value) == 0 else index
                if ((*before, name), at) not in unknown and v > out.get(unit, (0.0, ""))[0]:
                    out[unit] = v, label + name
    return out


def _too_light(
    f: Free, value: float, known: dict[str, tuple[float, str]], info: ParameterInfo | None
) -> Remark | None:
    """Question an inertia that is next to nothing beside a known one."""
    if info is None or info.dimension != "inertia" or f.sign != "positive" or info.motion is not None:
        return None
    largest, name = known.get(f.unit, (0.0, ""))
    if value >= _NOTHING * largest:
        return None
    text = f"{f.name} = {_with_unit(value, f.unit)} is next to nothing beside the known {name}"
    return Remark(f.name, f"{text}, {_with_unit(largest, f.unit)}", impossible=True)


def _at_bound(f: Free, value: float, lower: float, upper: float) -> Remark | None:
    for bound, what in ((lower, "lower"), (upper, "upper")):
        span = max(abs(bound), abs(f.guess)) * _AT_BOUND
        if not np.isfinite(bound) or abs(value - bound) > span:
            continue
        if f.sign == "positive" and what == "lower" and not np.isfinite(f.lower):
            text = f"{f.name} ran to zero: the log holds no such part, or contradicts the model"
            return Remark(f.name, text, impossible=True)
        if f.sign == "nonnegative" and bound == 0:
            text = (
                f"{f.name} is at its lower bound, 0: the log shows none of it, or asks for a negative value"
            )
            return Remark(f.name, text)
        text = (
            f"{f.name} is at its {what} bound, {_with_unit(bound, f.unit)}: the log asks for a value beyond"
        )
        return Remark(f.name, text)
    return None


def _beyond_memory(session: Session, estimate: Estimate) -> list[Remark]:
    """Remark on delays that ran to the end of the past commands that the simulated loop kept.

    Beyond that end the delay has no effect, so that the log seems not to determine it.
    """
    end, controller = estimate.details.get("longest_delay"), session.machine.controller
    if end is None or controller is None:
        return []
    effects, out = estimate.machine.plant.effects, []
    for f, value in zip(estimate.machine.parameters.free, estimate.theta, strict=True):
        if f.effect is None or not effects[f.effect].delays_command():
            continue
        # The end weighs in from one tick before.
        if value >= end - controller.period:
            text = (
                f"{f.name} is at the longest delay that this fit could simulate, {_with_unit(end, f.unit)} "
                f"({round(end / controller.period)} ticks of the controller): give it a larger guess or max"
            )
            out.append(Remark(f.name, text))
    return out


def _far_off(f: Free, value: float) -> Remark | None:
    if f.sign != "positive" or f.guess <= 0 or value <= 0:
        return None
    ratio = value / f.guess
    if 1 / _OFF <= ratio <= _OFF:
        return None
    times = f"{plain(max(ratio, 1 / ratio), 2)} times {'above' if ratio > 1 else 'below'} its guess"
    text = f"{f.name} = {_with_unit(value, f.unit)} is {times}, {_with_unit(f.guess, f.unit)}"
    return Remark(f.name, text, impossible=True)


def _undetermined(f: Free, value: float, std: float) -> Remark | None:
    if f.sign == "free" or not std >= abs(value):
        return None
    shown = " ± ".join(with_std(value, std))
    text = f"{f.name} = {shown} {pretty_unit(f.unit)}".strip()
    return Remark(
        f.name, f"{text}: its standard deviation exceeds the value, so the log does not determine it"
    )


def _unreal_links(estimate: Estimate) -> list[Remark]:
    """Question a link whose inertia about its axis is below that of its mass at its centre of mass."""
    machine, plant = estimate.machine, estimate.machine.plant
    if not isinstance(plant, LinkTree):
        return []
    names = {f.name: k for k, f in enumerate(machine.parameters.free)}
    out = []
    for link in range(plant.mass.size):
        place = f"[{link + 1}]"
        own = [n for n in names if n.endswith(place) and n.split("[")[0] in _AXIAL]
        turning = next((n for n in own if n.startswith("inertia_zz")), None)
        if turning is None or not all(estimate.identifiable[names[n]] for n in own):
            continue
        declared = own == [turning]
        inertia, least = estimate.value(turning), least_inertia(plant, link)
        if inertia + _SIGMAS * float(estimate.std[names[turning]]) < least:
            unit = machine.parameters.free[names[turning]].unit
            text = f"{turning} = {_with_unit(inertia, unit)} is below {_with_unit(least, unit)}, the inertia"
            text = f"{text} of the link's {'declared ' if declared else ''}mass at its centre of mass"
            out.append(Remark(turning, text, impossible=True, contradicts=declared))
    return out
