"""Compiled loop of the ground-truth axis: set-valued dry friction under a sampled controller.

One kernel holds every effect. One step is drift, kick, drift (second order
where all is smooth). In the kick the applied force is frozen at mid-step, so
that a stop, a stick and a break-away inside the step are solved in closed form
instead of by a smoothed sign. Every quantity is in SI units; for a rotary axis
read kg m^2, rad, N m.
"""

import math
from typing import NamedTuple

from numba import njit

OPEN, CASCADE_PD, PD, PID, COMPENSATED = 0, 1, 2, 3, 4


class Physics(NamedTuple):
    """Moving body and the forces on it; zero (or infinity) switches a term off."""

    mass: float  # kg, added mass included
    weight: float = 0.0  # N, constant
    gain: float = 1.0  # N per unit of command, every gain multiplied in
    offset: float = 0.0  # N, behind the gain
    lag: float = 0.0  # s
    delay: float = 0.0  # s
    clip: float = math.inf  # N
    stall: float = math.inf  # N at rest, all that the supply's voltage allows
    no_load: float = 1.0  # m/s, where it allows nothing
    viscous: float = 0.0  # N s/m
    absolute: float = 0.0  # N s/m, force -c |v|
    quadratic: float = 0.0  # N s^2/m^2
    cubic: float = 0.0  # N s^3/m^3
    quartic: float = 0.0  # N s^4/m^4
    constant: float = 0.0  # N
    stiffness1: float = 0.0  # N/m
    stiffness2: float = 0.0  # N/m^2
    stiffness3: float = 0.0  # N/m^3
    cogging: float = 0.0  # N
    cogging_period: float = 1.0  # m
    cogging_phase: float = 0.0  # rad
    moment: float = 0.0  # kg m, of a mass off the axis of a rotary machine
    moment_phase: float = 0.0  # rad above the horizontal at q = 0
    coulomb: float = 0.0  # N
    static: float = 0.0  # N, above Coulomb, at rest only
    stribeck: float = 0.0  # N, above Coulomb
    stribeck_velocity: float = 1.0  # m/s
    rising_forth: float = 0.0  # N, above Coulomb while speeding up forwards
    rising_back: float = 0.0  # N, backwards
    rising_velocity: float = 1.0  # m/s
    gear: float = 0.0  # dry friction over the drive's force, while the drive gives power
    gear_back: float = 0.0  # while the load does
    dahl_stiffness: float = 0.0  # N/m
    dahl_level: float = 1.0  # N
    drift: float = 0.0  # 1/s, of every dry level
    clock: float = 0.0  # N, amplitude of an unlogged sine in time
    clock_frequency: float = 0.0  # Hz


class Law(NamedTuple):
    """The sampled controller; gains per unit of position, velocity or their integral."""

    kind: int = OPEN
    kp: float = 0.0
    kv: float = 0.0
    ki: float = 0.0
    kd: float = 0.0
    average: int = 1  # readings in the mean that is differenced
    derivative_filter: float = 0.0  # s
    anti_windup: bool = False
    limit: float = math.inf  # unit of command
    level: float = 0.0  # of the square disturbance, unit of command
    on: float = 1.0  # s
    off: float = 0.0  # s
    start: float = 0.0  # s
    coulomb: float = 0.0  # fed forward, unit of command
    viscous: float = 0.0
    inertia: float = 0.0
    dead_band: float = 0.0  # position error that is taken for none


@njit(cache=True)
def position_force(p, q, z):
    """Return the force that depends on position q [m] and the presliding state z [m] alone [N]."""
    force = p.constant - q * (p.stiffness1 + q * (p.stiffness2 + q * p.stiffness3))
    if p.cogging != 0.0:
        force -= p.cogging * math.cos(2.0 * math.pi * q / p.cogging_period + p.cogging_phase)
    if p.moment != 0.0:
        force -= p.moment * 9.81 * math.cos(q + p.moment_phase)
    return force - p.dahl_stiffness * z


@njit(cache=True)
def velocity_force(p, v):
    """Return the force that is a continuous function of velocity v [m/s], zero at rest [N]."""
    w = abs(v)
    return -(p.viscous + p.quadratic * w + (p.cubic + p.quartic * w) * w * w) * v - p.absolute * w


@njit(cache=True)
def supplied(p, drive, v):
    """Limit a wanted force [N] by the supply's voltage at velocity v [m/s]."""
    if p.stall == math.inf:
        return drive
    return max(min(drive, p.stall * (1.0 - v / p.no_load)), -p.stall * (1.0 + v / p.no_load))


@njit(cache=True)
def slip_level(p, w, scale):
    """Return the dry friction while sliding at speed w > 0 [N]."""
    level = p.coulomb
    if p.stribeck != 0.0:
        level += p.stribeck * math.exp(-((w / p.stribeck_velocity) ** 2))
    return scale * level


@njit(cache=True)
def rising_level(p, side, w, scale):
    """Return the extra dry friction while speeding up to `side` at speed w [N]."""
    level = p.rising_forth if side > 0.0 else p.rising_back
    return scale * level * math.exp(-((w / p.rising_velocity) ** 2)) if level != 0.0 else 0.0


@njit(cache=True)
def drift_scale(p, t):
    """Return the factor on every dry level at t [s]; a level cannot turn negative."""
    return max(0.0, 1.0 + p.drift * t)


@njit(cache=True)
def gear_level(p, side, drive, scale):
    """Return the dry friction of a gear that transmits `drive` [N] and slides to `side`; 0 is at rest."""
    if p.gear == 0.0 and p.gear_back == 0.0:
        return 0.0
    return scale * (p.gear_back if drive * side < 0.0 else p.gear) * abs(drive)


@njit(cache=True)
def kick(p, v, w, h, net, scale, drive):
    """Return the velocity after h [s] under a constant force, dry friction solved exactly.

    Slides until it stops; the rest of h is spent at rest if friction can hold |net|, else it leaves
    in the direction of `net`. What acts while speeding up only cannot do more than hold the speed.
    Levels are those at speed w.
    """
    slip = slip_level(p, w, scale)
    if v != 0.0:
        side = 1.0 if v > 0.0 else -1.0
        pull = side * net - slip - gear_level(p, side, drive, scale)
        if pull > 0.0:
            pull = max(pull - rising_level(p, side, w, scale), 0.0)
        rate = side * pull / p.mass
        after = v + h * rate
        if after * side > 0.0:
            return after
        h += v / rate  # rate opposes v here: v / rate is minus the time to stop
    side = 1.0 if net > 0.0 else -1.0
    hold = p.coulomb + p.stribeck + p.static
    gear = gear_level(p, side, drive, scale)
    if abs(net) <= scale * hold + rising_level(p, side, 0.0, scale) + max(
        gear, gear_level(p, 0.0, drive, scale)
    ):
        return 0.0
    return h * side * max(abs(net) - slip - gear - rising_level(p, side, w, scale), 0.0) / p.mass


@njit(cache=True)
def dahl(p, z, dx, scale):
    """Return the presliding state after a stroke dx [m] in one direction: exact for Dahl's law."""
    if p.dahl_stiffness == 0.0 or dx == 0.0:
        return z
    reach = scale * p.dahl_level / p.dahl_stiffness
    if reach == 0.0:
        return 0.0
    return z - (math.copysign(reach, dx) - z) * math.expm1(-abs(dx) / reach)


@njit(cache=True)
def outside_force(p, bursts, t, h):
    """Return the mean over [t, t + h] of the bursts, plus the clock force at mid-step [N].

    Bursts enter by their overlap: their impulse is exact wherever they start.
    """
    force = 0.0
    for i in range(bursts.shape[0]):
        begin, end = bursts[i, 0], bursts[i, 0] + bursts[i, 1]
        overlap = min(end, t + h) - max(begin, t)
        if overlap > 0.0:
            force += bursts[i, 2] * overlap / h
    if p.clock != 0.0:
        force += p.clock * math.sin(2.0 * math.pi * p.clock_frequency * (t + 0.5 * h))
    return force


@njit(cache=True)
def advance(p, bursts, q, v, z, lagged, target, t, h):
    """Take one step of h [s] from t; `target` is gain times the delayed command, and the offset [N]."""
    half = 0.5 * h
    scale = drift_scale(p, t + half)
    z = dahl(p, z, half * v, scale)
    q += half * v
    decay = math.exp(-half / p.lag) if p.lag > 0.0 else 0.0
    middle = target + (lagged - target) * decay
    lagged = target + (middle - target) * decay
    drive = min(max(middle, -p.clip), p.clip)
    rest = outside_force(p, bursts, t, h) + position_force(p, q, z)
    given = supplied(p, drive, v)
    middle = kick(p, v, abs(v), half, given + p.weight + rest + velocity_force(p, v), scale, given)
    given = supplied(p, drive, middle)
    v = kick(p, v, abs(middle), h, given + p.weight + rest + velocity_force(p, middle), scale, given)
    z = dahl(p, z, half * v, scale)
    q += half * v
    return q, v, z, lagged


@njit(cache=True)
def acceleration(p, bursts, q, v, z, drive, t):
    """Return the acceleration [m/s^2] just after t, from the balance of forces; 0 where it sticks."""
    scale = drift_scale(p, t)
    net = drive + p.weight + position_force(p, q, z) + velocity_force(p, v)
    net += outside_force(
        p, bursts, t, 1e-9
    )  # chosen: 1 ns, short against a step, long against the rounding of t
    side = v if v != 0.0 else net
    pull = math.copysign(1.0, side) * net - slip_level(p, abs(v), scale)
    pull -= gear_level(p, math.copysign(1.0, side), drive, scale)
    more = rising_level(p, side, abs(v), scale)
    hold = scale * (p.coulomb + p.stribeck + p.static) + gear_level(p, 0.0, drive, scale)
    if v == 0.0 and abs(net) <= hold + more:
        return 0.0
    return math.copysign(1.0, side) * (max(pull - more, 0.0) if pull > 0.0 else pull) / p.mass


@njit(cache=True)
def pulse(law, t):
    """Return the square disturbance on the command at t [s]."""
    since = t - law.start + 1e-9  # chosen: a tick that falls on an edge belongs to what begins there
    if law.level == 0.0 or since < 0.0 or since % (law.on + law.off) >= law.on + 1e-12:
        return 0.0
    return law.level


@njit(cache=True)
def pid(law, error, slope, memory, extra, period):
    """Return PID command before clipping; memory holds the integral and the filtered slope."""
    memory[1] += period / (law.derivative_filter + period) * (slope - memory[1])
    integral = memory[0] + period * error
    u = law.kp * error + law.ki * integral + law.kd * memory[1] + extra
    if law.anti_windup and abs(u) > law.limit and u * law.ki * error > 0.0:
        return u - law.ki * period * error
    memory[0] = integral
    return u


@njit(cache=True)
def command(law, k, reference, reading, memory, period):
    """Return the command at tick k from the readings up to k; before the log all readings equal the first."""
    now, before = reading[k], reading[max(k - law.average, 0)]
    error = reference[k] - now
    if abs(error) < law.dead_band:
        error = 0.0
    speed = (now - before) / (law.average * period)
    last = max(k - 1, 0)
    aim = (reference[k] - reference[last]) / period
    extra = pulse(law, k * period)
    if law.kind == CASCADE_PD:
        u = law.kv * (law.kp * error - speed) + extra
    elif law.kind == PD:
        u = law.kp * error + law.kd * (aim - speed) + extra
    elif law.kind == COMPENSATED:
        n = reference.size
        before = reference[k - 1] if k > 0 else 2.0 * reference[0] - reference[min(1, n - 1)]
        after = reference[k + 1] if k + 1 < n else 2.0 * reference[k] - reference[max(n - 2, 0)]
        u = law.kp * error + law.kd * ((after - before) / (2.0 * period) - speed) + extra
        u += law.inertia * (after - 2.0 * reference[k] + before) / period**2 + law.viscous * speed
        if speed != 0.0:
            u += math.copysign(law.coulomb, speed)
    else:
        u = pid(law, error, aim - speed, memory, extra, period)
    return min(max(u, -law.limit), law.limit)


@njit(cache=True)
def looked_up(u, i, fraction, linear):
    """Return the command a fraction of a period after sample i; nothing was commanded before the log."""
    if i < 0:
        return 0.0
    if not linear:
        return u[i]
    return u[i] + fraction * (u[min(i + 1, u.size - 1)] - u[i])


@njit(cache=True)
def run(
    p,
    law,
    u,
    linear,
    reference,
    bursts,
    noise,
    resolution,
    period,
    step,
    q,
    v,
    reading,
    truth,
    memory,
):
    """Fill u, reading and truth (position, velocity, acceleration, force) tick by tick.

    The delay is a whole number of ticks and a rest: each period is cut where
    the delayed command changes, so no step ever straddles that change.
    """
    whole = int(math.floor(p.delay / period + 1e-9))
    rest = p.delay - whole * period
    if rest < 1e-9 * period:
        rest = 0.0
    z, lagged = 0.0, p.offset
    for k in range(u.size):
        reading[k] = q + noise[k]
        if resolution > 0.0:
            reading[k] = round(reading[k] / resolution) * resolution
        if law.kind != OPEN:
            u[k] = command(law, k, reference, reading, memory, period)
        older = 1 if rest > 0.0 else 0
        start = looked_up(u, k - whole - older, (older * period - rest) / period, linear)
        drive = lagged if p.lag > 0.0 else p.gain * start + p.offset
        drive = supplied(p, min(max(drive, -p.clip), p.clip), v)
        truth[k, 0], truth[k, 1], truth[k, 3] = q, v, drive
        truth[k, 2] = acceleration(p, bursts, q, v, z, drive, k * period)
        for part in range(2):
            begin = 0.0 if part == 0 else rest
            length = rest if part == 0 else period - rest
            count = int(math.ceil(length / step - 1e-6))
            for j in range(count):
                h = length / count
                inside = begin + (j + 0.5) * h - rest + (1 - part) * period
                value = looked_up(u, k - whole - 1 + part, inside / period, linear)
                t = k * period + begin + j * h
                target = p.gain * value + p.offset
                q, v, z, lagged = advance(p, bursts, q, v, z, lagged, target, t, h)
