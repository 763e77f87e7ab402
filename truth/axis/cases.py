"""Case files and recorded columns of an exact axis: what `jaxid discover` takes.

Known values go into a case as they are; guesses are off by a stated factor.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from truth.axis.machines import Setup

Declared = Sequence[tuple[str, Mapping[str, float]]]


def recorded(setup: Setup, **changes) -> dict[str, np.ndarray | str | None]:
    """Simulate, and return what a user would have of the run, by the fields of jaxid's `Log`."""
    run = setup.run(**changes)
    reference = run["reference"] if setup.loop.kind != "open_loop" else None
    return {
        "time": run["t"],
        "position": run["position"],
        "force": run["force"],
        "reference": reference,
        "source": "stepper.csv",
    }


def case_text(
    setup: Setup,
    declared: Declared,
    *,
    off: float = 1.5,
    inertia_known: bool = False,
    motion: str = "linear",
    orientation: str = "horizontal",
    sensor: bool = True,
    closed: bool = True,
    true: bool = False,
) -> str:
    """Return the case of a setup, its guesses off by a factor.

    Args:
        setup: Machine, loop and sensor; their known parts go in as they are.
        declared: Kind and true parameters of the effects that the case has.
        off: Guess over truth, and truth over guess, in turn.
        inertia_known: Give the inertia as it is.
        motion: Of the plant.
        orientation: Of the plant.
        sensor: Tell what the sensor is.
        closed: Tell what the controller is.
        true: State the true values beside the guesses.
    """
    machine, factor = setup.machine, [off, 1.0 / off]
    inertia = machine.inertia

    def entry(guess: float, value: float) -> str:
        return f"{{ guess = {guess!r}, true = {value!r} }}" if true else f"{{ guess = {guess!r} }}"

    lines = [
        "[plant]",
        'kind = "axis"',
        f'motion = "{motion}"',
        f'orientation = "{orientation}"',
        "[plant.parameters]",
        f"inertia = {inertia!r}" if inertia_known else f"inertia = {entry(inertia / off, inertia)}",
    ]
    for k, (kind, values) in enumerate(declared):
        lines += ["[[effects]]", f'kind = "{kind}"']
        lines += [f"{n} = {entry(v * factor[k % 2], v)}" for n, v in values.items()]
    lines += ["[actuator]", f"gain = {machine.actuator_gain!r}", "[log]", 'time = "t"']
    lines += ['position = "q"', 'force = "u"']
    lines += _loop_lines(setup) if closed and setup.loop.kind != "open_loop" else []
    if sensor:
        s = setup.sensor
        lines += [
            "[sensor]",
            f"position_resolution = {s.position_resolution!r}",
            f"position_noise = {s.position_noise!r}",
            f"force_noise = {s.force_noise!r}",
        ]
    return "\n".join(lines) + "\n"


def _loop_lines(setup: Setup) -> list[str]:
    loop = setup.loop
    names = {
        "cascade_pd": ("kp", "kv", "velocity_average"),
        "pd": ("kp", "kd"),
        "pid": ("kp", "ki", "kd", "derivative_filter"),
    }[loop.kind]
    lines = ['reference = "ref"', "[controller]", f'kind = "{loop.kind}"']
    lines += [f"{n} = {getattr(loop, n)!r}" for n in names]
    lines += ["anti_windup = true"] if loop.kind == "pid" and loop.anti_windup else []
    return [*lines, f"limit = {loop.limit!r}"]


def write_case(folder: Path, text: str) -> Path:
    """Write a case to a folder; return its path."""
    path = Path(folder) / "case.toml"
    path.write_text(text)
    return path
