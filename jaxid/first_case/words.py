"""The meaning of a column's name: quantity, role and joint, by words of English and German."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxid.logs.readers.dialect import split_unit
from jaxid.logs.unit_endings import UNITS, unit_ending

# Words by quantity. A force has several kinds, from the surest witness of the torque on.
_QUANTITIES: dict[str, str] = {
    "time": "t time zeit zeitstempel timestamp timestamps stamp elapsed uhrzeit datum datetime epoch clock "
    "laufzeit zeitpunkt millis micros seconds",
    "position": "q p pos position positions lage stellung weg winkel drehwinkel angle angles ang s hub "
    "displacement encoder enc counts count inkremente increments ticks hoehe height distance dof pose",
    "velocity": "qd v vel velocity velocities speed rate geschwindigkeit drehzahl omega rpm w",
    "acceleration": "qdd a acc accel acceleration beschleunigung vdot wdot omegadot",
    "torque": "tau torque torques trq moment drehmoment effort efforts tq mz",
    "force": "force forces kraft thrust schub f",
    "current": "current currents curr strom motorstrom i ia iq amps amp ampere",
    "voltage": "voltage volt volts spannung ua uq motorspannung",
    "duty": "pwm duty dutycycle aussteuerung",
    "load": "load last",
    "command": "u input stellgroesse stellwert control ctrl",
    "temperature": "temp temperature temperatur",
    "passed over": "error err fehler schleppfehler schleppabstand following deviation abweichung vsupply "
    "supply bus battery batterie flag mode activated enabled index idx row rows sample samples counter "
    "zaehler seq function id ud status power leistung energy friction reibung covariance dc "
    "zwischenkreis gyro gyros gyroscope gyr accelerometer magnetometer",
}
_ROLES = {
    "reference": "ref reference soll sollwert target desired des cmd command commanded setpoint sp set goal "
    "demand demanded wanted action vorgabe fuehrung",
    "actual": "ist istwert act actual meas measured gemessen feedback fbk fb value wert present actualvalue",
}
# Words that say nothing of a joint.
_NOISE = (
    "joint joints states state js axis achse motor drive antrieb gelenk robot observation msg data est "
    "estimated of the im am an der die das on at signal channel kanal ch filtered raw n no nr m g l dt point"
)
# Words that say of a velocity how it moves, and name a joint otherwise.
_KINDS = ("angular", "linear")
# Symbols of coordinates, which name the joint where a log has several; their derivatives are dx and xdot.
_SYMBOLS = frozenset("x y z th theta phi psi alpha beta gamma".split())
# Axes that name a joint beside other words, and are an angle alone.
_AXES = ("roll", "pitch", "yaw")
_TURNS = _SYMBOLS - {*"xyz"}
# Separate words for derivatives by time.
_DOTS = {"dot": 1, "punkt": 1, "ddot": 2, "dotdot": 2}
_MOTION = ("position", "velocity", "acceleration")
# Letters whose case matters.
_LETTERS = {
    "V": "voltage",
    "U": "voltage",
    "I": "current",
    "F": "force",
    "M": "torque",
    "T": "temperature",
    "Va": "voltage",
    "Vm": "voltage",
}
# Quantities that a letter and one more letter stand for, as qm or qg.
_OF_Q = re.compile(r"q[a-z]")
# Phases of a motor, each of which has a current and a voltage.
PHASES = frozenset("u v w".split())
# Symbols of motor and load, as in thetam and thetaM, where M is no torque.
_OF_SIDE = re.compile(r"(?i)\b(theta|th|phi|omega|w|tau)[ _]?([ml])\b")
# Symbols behind which the role stands without a sign, as in Iist of German drives, qdes and thetaref.
_WITH_ROLE = re.compile(
    r"(?i)\b(?:([a-z])(ist|soll)|([qxyzsvwuin]|theta|th|phi|psi|tau|omega)(ref|des|cmd|act|meas))\b"
)
ROTARY = _TURNS | frozenset("winkel drehwinkel angle angles ang drehzahl omega rpm dof tau".split())
LINEAR = frozenset("weg hub displacement hoehe height distance".split())
# Units with a capital, which begins no word.
_PREFIXED = ("mNm", "mA", "mV", "kN")
FORCES = ("torque", "force", "current", "voltage", "duty", "command", "load")
_MEANING = {word: quantity for quantity, words in _QUANTITIES.items() for word in words.split()}
# Words that hold the symbol of a coordinate, by symbol and number of derivatives.
_DERIVATIVES = {
    pattern.format(symbol): (symbol, order)
    for symbol in (*_SYMBOLS, "q")
    for pattern, order in (("d{}", 1), ("{}dot", 1), ("dd{}", 2), ("{}ddot", 2), ("{}dd", 2))
}
# Names that end as a derivative (xp with the German Punkt) or as what is desired: values tell them apart.
D_ENDINGS = {f"{symbol}{ending}": symbol for symbol in _SYMBOLS for ending in "dp"}
# Velocities along an axis. A force along one is mostly that of a sensor between tool and workpiece.
_ALONG = {f"v{axis}": axis for axis in "xyz"}
_ROLE = {word: role for role, words in _ROLES.items() for word in words.split()}
_SILENT = frozenset(_NOISE.split())
# Words long enough to be parts of others, as in Lageistwert or TorqueActualValue, longest first.
_STEMS = sorted((w for w in {*_MEANING, *_ROLE, *_SILENT} if len(w) > 2), key=lambda word: (-len(word), word))
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"})


@dataclass(frozen=True)
class Meaning:
    """The meaning of a column's name.

    Attributes:
        name: The name.
        quantity: "time", "position", "velocity", "acceleration", one of `FORCES`, "temperature" or "passed
            over"; empty: the name says nothing.
        reference: Whether it is a wanted value.
        joint: Words that are left, which name the joint; empty if there are none.
        symbol: Symbol of a coordinate in the name, as theta in theta_dot; empty if there is none.
        unit: Unit that the name ends in; empty if it has none.
        words: All words of the name.
    """

    name: str
    quantity: str
    reference: bool
    joint: tuple[str, ...]
    unit: str
    words: frozenset[str]
    symbol: str = ""

    @property
    def motion(self) -> str:
        """Kind of motion that the words imply: "rotary", "linear" or empty."""
        if self.words & ROTARY:
            return "rotary"
        return "linear" if self.words & LINEAR else ""


def meaning_of(name: str) -> Meaning:
    """Return the meaning of a column's name.

    Args:
        name: The name, as "Lageistwert [mm]", "dof_pos", or "/joint_states.position[elbow]".
    """
    plain = split_unit(name)[0] if " " in name or "(" in name else name
    rest, unit = _unit_at_end(plain.translate(_UMLAUTS))
    parts = _split(rest)
    if not unit and len(parts) > 1:
        last = parts[-1].casefold() if parts[-1].istitle() and parts[-1] not in UNITS else parts[-1]
        if last in UNITS:
            parts.pop()
            unit = UNITS[last]
    if len(parts) == 1 and parts[0] in ("ms", "us", "ns"):
        return Meaning(name, "time", False, (), parts[0], frozenset(parts))

    found = _Words()
    for k, part in enumerate(parts):
        found.add(part, first=k == 0)
    return found.meaning(name, unit)


class _Words:
    """The words of a name, sorted as they are added."""

    def __init__(self) -> None:
        self.quantities: list[str] = []
        self.roles: list[str] = []
        self.joint: list[str] = []
        self.words: list[str] = []
        self.kinds: list[str] = []
        self.symbol = ""
        # Derivatives that the coordinate is written with, as in dtheta, and those of words of their kind.
        self.of_symbol = self.derivatives = 0
        self.leading = ""

    def add(self, part: str, *, first: bool) -> None:
        """Add one part of the name."""
        word = part.casefold()
        moved = bool({*self._said()} & {*_MOTION})
        if word == "d" and not first and (moved or {*self._said()} & {"torque", "force"}):
            self.roles.append("reference")  # theta_d is the desired angle, tau_d the desired torque
        elif word in ("d", "dd") and first:
            self.leading = word
        elif word == "dd" and moved:
            self.derivatives += 2
        elif word in PHASES and {*self.quantities} & {"current", "voltage"}:
            self.joint.append(word)
        elif word in _DOTS:
            self.derivatives += _DOTS[word]
        elif word in _DERIVATIVES:
            symbol, self.of_symbol = _DERIVATIVES[word]
            self.symbol = self.symbol or symbol
            self.words.append(symbol)
        elif word in _ALONG:
            self.quantities.append("velocity")
            self.symbol = self.symbol or _ALONG[word]
            self.words.append(word)
        elif word in _SYMBOLS:
            self.symbol = self.symbol or word
            self.words.append(word)
        elif word in _KINDS:
            self.kinds.append(word)
        elif part in _LETTERS:
            self.quantities.append(_LETTERS[part])
            self.words.append(word)
        elif word == "a" and self._said():
            # Of the armature, as in i_a, or the first of two, as in theta_a.
            (self.joint if moved else self.words).append(word)
        else:
            self._add_pieces(word)

    def _add_pieces(self, word: str) -> None:
        pieces = _pieces(word)
        if pieces is None and _OF_Q.fullmatch(word):
            self.quantities.append("position")
            self.words.append(word)
        elif pieces is None:
            self.joint.append(word)
        else:
            self.words += pieces
            self.roles += [_ROLE[p] for p in pieces if p in _ROLE]
            self.quantities += [_MEANING[p] for p in pieces if p in _MEANING and p not in _ROLE]

    def _said(self) -> list[str]:
        """Return the quantities; a symbol alone is a position."""
        return self.quantities or (["position"] if self.symbol else [])

    def meaning(self, name: str, unit: str) -> Meaning:
        """Return the meaning of the name, which ends in this unit."""
        quantities, joint = self._said(), list(self.joint)
        if quantities == ["load"] and self.symbol in _TURNS:
            quantities = ["position", "load"]  # theta_load is the angle of a load
        if "n" in self.words and self.roles and not quantities:
            quantities = ["velocity"]  # n_soll and n_ist of German drives
        if "twist" in joint and self.kinds and not self.quantities:
            # The message of a velocity, as twist.angular.z; by itself it may be an angle.
            quantities = ["velocity"]
            joint.remove("twist")
        if not quantities and len(joint) == 1 and joint[0] in _AXES:
            quantities = ["position"]
        moved = [q for q in quantities if q in _MOTION]
        if moved and "load" in quantities:
            # The position of a load is no load.
            quantities, joint = moved, [*joint, "load"]
        if "link" in joint and {*quantities} & {"voltage", "command"}:
            quantities = ["passed over"]  # that of an intermediate circuit
        quantity, order = _one(quantities), self.derivatives
        if self.leading and quantity in _MOTION:
            order += len(self.leading)
        elif self.leading:
            joint.insert(0, self.leading)
        if not self.quantities:
            order += self.of_symbol
        elif quantity in _MOTION:
            # Of vel_dx both words say the same.
            order = max(order, self.of_symbol - _MOTION.index(quantity))
        if self.kinds and quantity not in ("velocity", "acceleration"):
            joint += self.kinds
        if self.symbol and {*self.quantities} - {"load"} and any(not word.isdigit() for word in joint):
            joint.append(self.symbol)
        return Meaning(
            name=name,
            quantity=_derived(quantity, order),
            reference="reference" in self.roles and "actual" not in self.roles,
            joint=tuple(joint),
            unit=unit,
            words=frozenset(self.words),
            symbol="" if self.symbol == "q" else self.symbol,
        )


def meaning_of_joint(name: str, joints: Sequence[str]) -> Meaning:
    """Return the meaning of a column's name that may hold the name of a robot's joint.

    The longest one counts that stands in it between signs, with or without the word joint. A column that is
    called as the joint is its position.

    Args:
        name: The name.
        joints: Names of the joints.
    """
    for joint in sorted(joints, key=len, reverse=True):
        bare = re.sub(r"(?i)^joint_|_joint$", "", joint)
        for called in dict.fromkeys((joint, bare)):
            found = re.search(rf"(?<![A-Za-z0-9]){re.escape(called)}(?![A-Za-z0-9])", name)
            if found is None:
                continue
            rest = f"{name[: found.start()]} {name[found.end() :]}"
            meaning = meaning_of(rest)
            alone = not re.search(r"[A-Za-z0-9]", split_unit(rest)[0])
            quantity = "position" if alone else meaning.quantity
            return replace(meaning, name=name, quantity=quantity, joint=(joint,))
    return meaning_of(name)


def _one(found: list[str]) -> str:
    """Return the quantity of a name with several words for one."""
    if "passed over" in found:
        return "passed over"
    moved = [q for q in found if q in _MOTION]
    if moved and "current" in found:
        # Of "current position" the first word is an adjective.
        return moved[-1]
    if "time" in found and len(set(found)) > 1:
        return next(q for q in found if q != "time")
    forces = [q for q in FORCES if q in found]
    if forces:
        return forces[0]
    return moved[-1] if moved else found[0] if found else ""


def _derived(quantity: str, order: int) -> str:
    """Return the derivative of a quantity by time; empty if it is none of a motion."""
    if order == 0:
        return quantity
    place = _MOTION.index(quantity) + order if quantity in _MOTION else len(_MOTION)
    return _MOTION[place] if place < len(_MOTION) else ""


def _unit_at_end(name: str) -> tuple[str, str]:
    """Split off the unit in which a name ends; empty if there is none.

    A capital within a unit begins no word: current_mA is in mA, and so is currentmA.
    """
    if name in _PREFIXED:
        return "", UNITS[name]
    rest, unit = unit_ending(name)
    if unit:
        return rest, unit
    for ending in _PREFIXED:
        rest = name.removesuffix(ending)
        if rest != name and _pieces(_split(rest)[-1].casefold()) is not None:
            return rest, UNITS[ending]
    return name, ""


def _split(name: str) -> list[str]:
    """Split a name at signs, capitals and digits."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z]{2})", " ", name)
    spaced = re.sub(r"(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])", " ", spaced)
    spaced = _WITH_ROLE.sub(lambda found: " ".join(filter(None, found.groups())), spaced)
    spaced = _OF_SIDE.sub(lambda found: f"{found[1]} {found[2].lower()}", spaced)
    # A current or a voltage of the q axis may be split by its sign.
    spaced = re.sub(r"(?i)\b([iu])_q\b", r"\1q", spaced)
    return re.findall(r"[A-Za-z]+|\d+|%", spaced)


def parts_of(name: str) -> list[str]:
    """Return the words of a name that signs, capitals and digits divide, in small letters."""
    return [part.casefold() for part in _split(name.translate(_UMLAUTS))]


def _pieces(word: str) -> list[str] | None:
    """Return the known words that a word consists of; None if it is not made of them."""
    if word in _MEANING or word in _ROLE or word in _SILENT:
        return [word]
    for stem in _STEMS:
        if word.startswith(stem) and len(word) > len(stem):
            rest = word[len(stem) :]
            for linked in (rest, rest.removeprefix("s"), rest.removeprefix("en")):
                below = _pieces(linked) if len(linked) > 2 else None
                if below is not None:
                    return [stem, *below]
    return None
