"""Machines of `benchmarks.intervals` on the exact steppers: case, log and truth of each run, by its seed.

A machine is a function of the seed, of the loop (open, known or unknown) and of the sensor (stated or not),
which returns the text of the case, the columns of the log and the truth by the names of results. Loops and
sensors of one seed see the same machine; a loop that is not known is run, but not stated.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from truth.arm.two_links import run_sampled
from truth.arm.two_links_case import drawn_links, friction_lines, plant_lines
from truth.axis.cases import case_text
from truth.axis.machines import EMPS_LOOP, Setup, emps_like, moves, multisine
from truth.axis.slow_axis import slow_axis
from truth.axis.stepper import Loop, Sensor
from truth.chain import flexible_axes, flexible_joints, stages
from truth.chain.stepper import ChainMachine, simulate_chain

Run = tuple[str, dict[str, np.ndarray], dict[str, float]]
LOOPS, SENSORS = ("open", "known", "unknown"), ("stated", "not stated")
SAMPLES = 2500


def axis(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of a slide of 95 kg: trapezoids in a loop, or a multisine of force."""
    rng = np.random.default_rng([1, seed])
    base = emps_like()
    scale = rng.uniform(0.8, 1.2, 3).tolist()
    true = {
        "inertia": 95.1 * scale[0],
        "viscous_friction.coefficient": 203.5 * scale[1],
        "coulomb_friction.level": 20.39 * scale[2],
    }
    effects = {
        "viscous_friction": {"coefficient": true["viscous_friction.coefficient"]},
        "coulomb_friction": {"level": true["coulomb_friction.level"]},
    }
    machine = dataclasses.replace(base.machine, inertia=true["inertia"], effects=effects)
    t = np.arange(SAMPLES) / 1000.0
    if loop == "open":
        force = multisine(t, [0.8, 1.9, 3.7, 6.1], 3.0 * rng.uniform(0.9, 1.1), seed)
        law = Loop(kind="open_loop", input=force)
    else:
        speeds = np.array([0.05, 0.3, 0.13, 0.2]) * rng.uniform(0.8, 1.2, 4)
        reference = moves(
            t, np.array([0.0, 0.02, 0.12, 0.05]) * rng.uniform(0.9, 1.1), speeds, 1.7, rest=0.03
        )
        law = dataclasses.replace(EMPS_LOOP, reference=reference)
    read = Sensor(position_resolution=1e-6, position_noise=0.7e-6, force_noise=0.05)
    setup = Setup(machine, law, read, rate=1000.0, duration=SAMPLES / 1000.0, seed=seed)
    run = setup.run()
    text = case_text(
        setup, list(effects.items()), sensor=sensor == "stated", closed=loop == "known", true=True
    )
    return text, {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}, true


def ball_screw(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of a ball-screw axis of 180 kg with Stribeck friction, 24 s at 1 kHz.

    It moves slowly at times. The encoder's noise is a third of a count, so that it dithers little.
    """
    rng = np.random.default_rng([6, seed])
    base = slow_axis(seed, duration=24.0)
    effects = {
        kind: {name: value * rng.uniform(0.8, 1.2) for name, value in values.items()}
        for kind, values in base.machine.effects.items()
    }
    true = {"inertia": base.machine.inertia * rng.uniform(0.8, 1.2)}
    true |= {f"{kind}.{name}": value for kind, of in effects.items() for name, value in of.items()}
    machine = dataclasses.replace(base.machine, inertia=true["inertia"], effects=effects)
    law = base.loop
    if loop == "open":
        t = np.arange(round(1000 * base.duration)) / 1000.0
        force = multisine(t, [0.3, 0.8, 1.9, 3.7], 1.2 * rng.uniform(0.9, 1.1), seed)
        law = Loop(kind="open_loop", input=force)
    setup = dataclasses.replace(base, machine=machine, loop=law)
    run = setup.run()
    text = case_text(
        setup, list(effects.items()), sensor=sensor == "stated", closed=loop == "known", true=True
    )
    return text, {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}, true


def flexible_axis(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of the ball-screw axis of Janot et al., with both encoders."""
    rng = np.random.default_rng([2, seed])
    true = {name: float(value * rng.uniform(0.85, 1.15)) for name, value in flexible_axes.TRUTH.items()}
    t = np.arange(SAMPLES) / 1000.0
    speeds = np.array([0.08, 0.2, 0.13, 0.25]) * rng.uniform(0.8, 1.2, 4)
    reference = moves(t, (0.0, 0.12, 0.05, 0.1), speeds, 1.5, 0.05)
    count = flexible_axes.COUNT
    read = Sensor(position_resolution=count, position_noise=count, force_noise=0.05)
    law = {"kp": 40.0, "kv": 320.0, "velocity_average": 2}
    pulses = {"level": 4.0, "on": 0.012, "off": 0.119, "start": 0.2505}
    machine = flexible_axes.machine(**true)
    if loop == "open":
        command = multisine(t, [0.8, 2.1, 5.3, 11.7], 4.0 * rng.uniform(0.9, 1.1), seed)
        law_of_drive = Loop(kind="open_loop", input=command)
        run = simulate_chain(machine, [law_of_drive], read, rate=1000.0, duration=SAMPLES / 1000.0, seed=seed)
    else:
        run = flexible_axes.record(
            machine,
            duration=SAMPLES / 1000.0,
            reference=reference,
            pulses=pulses,
            law=law,
            sensor=read,
            seed=seed,
        )
    text = flexible_axes.text(pulses=pulses, law=law, sensor=read, true=true)
    if loop != "known":
        text = text[: text.index("[controller]")] + text[text.index("[sensor]") :]
        text = text.replace('reference = "ref"\n', "")
    if sensor == "not stated":
        text = text[: text.index("[sensor]")]
    return text, flexible_axes.columns(run), true


def chain(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of two masses between walls, each with a drive and Coulomb friction."""
    rng = np.random.default_rng([3, seed])
    mass, damping = np.array([2.0, 1.4]) * rng.uniform(0.8, 1.2, 2), 8.0 * rng.uniform(0.6, 1.4, 2)
    stiffness, level = 1700.0 * rng.uniform(0.75, 1.25, 3), 10.0 * rng.uniform(0.7, 1.3, 2)
    true = {f"mass[{k}]": float(v) for k, v in enumerate(mass, start=1)}
    true |= {f"damping[{k}]": float(v) for k, v in enumerate(damping, start=1)}
    true |= {f"stiffness[{k}]": float(v) for k, v in enumerate(stiffness, start=1)}
    true |= {f"coulomb_friction[{k}].level": float(v) for k, v in enumerate(level, start=1)}
    effects = {("coulomb_friction", k): {"level": float(v)} for k, v in enumerate(level, start=1)}
    machine = ChainMachine(
        mass.tolist(), damping.tolist(), stiffness.tolist(), effects, actuator_gain=[25.0, 20.0]
    )

    t = np.arange(SAMPLES) / 1000.0
    read = Sensor(position_resolution=1e-6, position_noise=0.7e-6, force_noise=0.02)
    gains = {"kp": [1000.0, 900.0], "kd": [14.0, 12.0], "limit": 30.0}
    loops = []
    for k in range(2):
        if loop == "open":
            command = multisine(t, [0.9, 2.3, 4.1, 7.3], 4.0 * rng.uniform(0.9, 1.1), 2 * seed + k)
            loops.append(Loop(kind="open_loop", input=command))
            continue
        stops = 0.03 * rng.uniform(0.8, 1.2) * rng.permutation([-1.0, -0.5, 0.4, 1.0])
        speeds = rng.permutation([0.06, 0.12, 0.2, 0.3, 0.25]) * rng.uniform(0.8, 1.2, 5)
        reference = moves(t, [0.0, *stops], speeds, 8.0, rest=0.03)
        loops.append(Loop(kind="pd", kp=gains["kp"][k], kd=gains["kd"][k], limit=30.0, reference=reference))
    run = simulate_chain(machine, loops, read, rate=1000.0, duration=SAMPLES / 1000.0, seed=seed)

    off = dict(zip(true, (1.5 ** rng.choice([-1.0, 1.0], len(true))).tolist(), strict=True))
    row = lambda kind: ", ".join(
        f"{{ guess = {v * off[n]!r}, true = {v!r} }}" for n, v in true.items() if n.startswith(kind)
    )
    lines = ["[plant]", 'kind = "chain"', "[plant.parameters]"]
    lines += [f"{kind} = [{row(kind)}]" for kind in ("mass", "damping", "stiffness")]
    lines += ["[[effects]]", 'kind = "coulomb_friction"', f"level = [{row('coulomb_friction')}]"]
    lines += [
        "[actuator]",
        "gain = [25.0, 20.0]",
        *_log_lines(("q1", "q2"), ("u1", "u2"), loop, ("r1", "r2")),
    ]
    lines += _law_lines("pd", gains) if loop == "known" else []
    lines += _sensor_lines(read) if sensor == "stated" else []
    columns = {"t": run["t"]}
    for name, signal in (("q", "position"), ("u", "force"), ("r", "reference")):
        columns |= {f"{name}{k + 1}": run[signal][:, k] for k in range(2)}
    return "\n".join(lines) + "\n", columns, true


def arm(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of two links under gravity, along sines of the joints or torques."""
    rng = np.random.default_rng([4, seed])
    links, true = drawn_links(rng)

    t = np.arange(SAMPLES) / 1000.0
    sines = [0.8, 1.7, 2.9]
    read = Sensor(position_resolution=2e-5, position_noise=1.4e-5, force_noise=0.05)
    law = {"kp": [300.0, 150.0], "kd": [30.0, 10.0]}
    options = {"resolution": read.position_resolution, "noise": read.position_noise}
    options |= {"force_noise": read.force_noise, "seed": seed, "rate": 1000.0}
    reference = np.zeros((SAMPLES, 2))
    if loop == "open":
        # The arm hangs at rest before.
        command = np.stack(
            [multisine(t, sines, peak, 2 * seed + k) for k, peak in enumerate((16.0, 7.0))], axis=1
        )
        run = run_sampled(links, start=np.array([-np.pi / 2, 0.0]), command=command, **options)
    else:
        reference = np.stack([multisine(t, sines, 1.2, 2 * seed + k) for k in range(2)], axis=1)
        run = run_sampled(links, start=reference[0], reference=reference, **law, **options)

    off = dict(zip(true, (1.5 ** rng.choice([-1.0, 1.0], len(true))).tolist(), strict=True))
    entry = lambda name: f"{{ guess = {true[name] * off[name]!r}, true = {true[name]!r} }}"
    lines = plant_lines(links, entry)
    lines += friction_lines(entry)
    lines += _log_lines(("q1", "q2"), ("u1", "u2"), loop, ("r1", "r2"))
    lines += _law_lines("pd", law) if loop == "known" else []
    lines += _sensor_lines(read) if sensor == "stated" else []
    columns = {**run, "r1": reference[:, 0], "r2": reference[:, 1]}
    return "\n".join(lines) + "\n", columns, true


def stage(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of the micropositioning stage, rigidly coupled, moved to and fro."""
    rng = np.random.default_rng([5, seed])
    values = {name: float(v * rng.uniform(0.85, 1.15)) for name, v in stages.TRUTH[1].items()}
    # A rigid coupling adds the friction of the table to that of the motor, which stands for both here.
    values |= {"viscous_friction[2].coefficient": 0.0, "coulomb_friction[2].level": 0.0}
    machine = stages.machine(1, rigid=True, **values)
    known = ("table_mass", "viscous_friction[2].coefficient", "coulomb_friction[2].level", "stiffness")
    true = {name: v for name, v in values.items() if name not in known}

    rate, count = 1000.0, 2 * np.pi / 20_000
    t, law = np.arange(SAMPLES) / rate, {"kp": 1.0, "ki": 12.0, "kd": 0.03, "derivative_filter": 0.01}
    read = Sensor(position_resolution=count, position_noise=0.7 * count, force_noise=2e-3)
    tones = zip((0.7, 1.3, 2.9), (8.0, 4.0, 1.5), rng.uniform(-1, 1, 3), strict=True)
    wanted = sum(a * (np.sin(2 * np.pi * f * t + p) - np.sin(p)) for f, a, p in tones)
    if loop == "open":
        control = Loop("open_loop", input=multisine(t, [0.7, 1.3, 2.9], 0.9 * rng.uniform(0.9, 1.1), seed))
    else:
        gains = {k: v if k == "derivative_filter" else v / stages.R for k, v in law.items()}
        control = Loop("pid", reference=wanted * stages.R, limit=5.0, **gains)
    scaled = Sensor(count * stages.R, read.position_noise * stages.R, read.force_noise)
    run = simulate_chain(machine, [control], scaled, rate=rate, duration=SAMPLES / rate, seed=seed)

    off = dict(zip(true, (1.3 ** rng.choice([-1.0, 1.0], len(true))).tolist(), strict=True))
    entry = lambda name: f"{{ guess = {true[name] * off[name]!r}, true = {true[name]!r} }}"
    lines = ["[plant]", 'kind = "micropositioning_stage"', 'coupling = "rigid"', "[plant.parameters]"]
    lines += [f"pitch = {stages.PITCH}", f"table_mass = {values['table_mass']!r}"]
    lines += [f"motor_inertia = {entry('motor_inertia')}"]
    lines += ["[[effects]]", 'kind = "actuator_lag"', "joint = 1", f"time_constant = {stages.LAG}"]
    lines += ["[[effects]]", 'kind = "cogging"', "joint = 2", f"period = {stages.PITCH}"]
    lines += [f"{name} = {entry(f'cogging[2].{name}')}" for name in ("amplitude", "phase")]
    fields = {
        ("coulomb_friction", 1): ("level",),
        ("viscous_friction", 1): ("coefficient",),
        ("velocity_hysteresis", 2): ("level", "level_negative", "velocity"),
    }
    for (kind, joint), names in fields.items():
        lines += ["[[effects]]", f'kind = "{kind}"', f"joint = {joint}"]
        lines += [f"{name} = {entry(f'{kind}[{joint}].{name}')}" for name in names]
    lines += ["[actuator]", f"gain = {stages.GAIN}", *_log_lines("q", "u", loop, "r")]
    lines += _law_lines("pid", {**law, "limit": 5.0}) if loop == "known" else []
    lines += _sensor_lines(read) if sensor == "stated" else []
    columns = {"t": run["t"], "q": run["position"][:, 0] / stages.R, "u": run["force"][:, 0], "r": wanted}
    return "\n".join(lines) + "\n", columns, true


def flexible_joint(seed: int, loop: str, sensor: str) -> Run:
    """Return case, columns and truth of a flexible joint with two encoders and a loop faster than its log."""
    assert loop == "unknown", "its case states no loop"
    joint, rates = flexible_joints.flexible_joint(seed), flexible_joints.LOG_RATES
    log = joint.log(rates[seed % len(rates)])
    return flexible_joints.text(sensor=sensor == "stated"), log, joint.true


def _log_lines(positions, forces, loop: str, references) -> list[str]:
    """Return the table [log] for columns by joint; a log of an open loop has no reference."""
    row = lambda names: f'"{names}"' if isinstance(names, str) else str(list(names)).replace("'", '"')
    lines = ["[log]", 'time = "t"', f"position = {row(positions)}", f"force = {row(forces)}"]
    return lines + ([f"reference = {row(references)}"] if loop == "known" else [])


def _law_lines(kind: str, gains: dict[str, object]) -> list[str]:
    return ["[controller]", f'kind = "{kind}"', *[f"{name} = {value}" for name, value in gains.items()]]


def _sensor_lines(sensor: Sensor) -> list[str]:
    return ["[sensor]", *[f"{name} = {value!r}" for name, value in dataclasses.asdict(sensor).items()]]


MACHINES: dict[str, Callable[[int, str, str], Run]] = {
    "axis": axis,
    "ball_screw": ball_screw,
    "flexible_axis": flexible_axis,
    "chain": chain,
    "arm": arm,
    "stage": stage,
    "flexible_joint": flexible_joint,
}
# Machines that are not in every loop.
ONLY_IN: dict[str, tuple[str, ...]] = {"flexible_joint": ("unknown",)}
CELLS = [
    f"{machine}/{loop}/{sensor}"
    for machine in MACHINES
    for loop in ONLY_IN.get(machine, LOOPS)
    for sensor in SENSORS
]
