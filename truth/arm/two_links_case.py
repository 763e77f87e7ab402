"""A case of two links under a law that feeds a model forward; true values are those of the equations."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from truth.arm.two_links import TwoLinks

# Drive gains, viscous and Coulomb friction, as the case lists them; nothing of it in its guesses.
TRUTH = np.array([0.93, 1.06, 1.5, 0.8, 4.0, 2.4])
PERIOD = 2.5e-4

TEXT = """
[plant]
kind = "serial_arm"
gravity_vector = [0.0, -9.81, 0.0]
[[plant.links]]
joint = "revolute"
alpha_deg = 0.0
a = 0.0
mass = 3.0
first_moment = [0.6, 0.0, 0.0]
inertia = [0.0, 0.0, 0.0, 0.0, 0.0, 0.18]
[[plant.links]]
joint = "revolute"
alpha_deg = 0.0
a = 0.5
mass = 2.0
first_moment = [0.5, 0.06, 0.0]
inertia = [0.0, 0.0, 0.0, 0.0, 0.0, 0.1768]
[[effects]]
kind = "actuator_gain"
gain = [{ guess = 1.0, true = 0.93 }, { guess = 1.0, true = 1.06 }]
[[effects]]
kind = "viscous_friction"
coefficient = [{ guess = 0.0, true = 1.5 }, { guess = 0.0, true = 0.8 }]
[[effects]]
kind = "coulomb_friction"
level = [{ guess = 0.0, true = 4.0 }, { guess = 0.0, true = 2.4 }]
[controller]
kind = "adaptive"
kp = [2000.0, 600.0]
kd = [60.0, 18.0]
period = 0.00025
gate_velocity = 0.1
[sensor]
[reference]
kind = "synchronized"
polygon = [[0.3, 0.2], [1.6, 0.2], [1.6, 1.2], [0.3, 1.2]]
start = [0.3, 0.2]
velocity = 3.665
acceleration = 29.3
jerk = 440.0
dwell = 0.05
[simulation]
duration = 3.0
sample_rate = 4000.0
initial_position = [0.3, 0.2]
substeps = 1
"""


def drawn_links(random: np.random.Generator) -> tuple[TwoLinks, dict[str, float]]:
    """Draw two links with friction, and return them with their true values by the names of results."""
    draw = lambda *values: [float(v * random.uniform(0.85, 1.15)) for v in values]
    names = ("m1", "m2", "x1", "x2", "y2", "i1", "i2")
    links = TwoLinks(
        **dict(zip(names, draw(3.0, 2.0, 0.2, 0.25, 0.03, 0.06, 0.05), strict=True)),
        viscous=tuple(draw(1.5, 0.8)),
        coulomb=tuple(draw(2.0, 1.2)),
    )
    true = {name: float(v) for name, v in links.base.items() if name != "first_moment_y[1]"}
    # The case states the mass of link 2: what it adds to link 1 is no unknown.
    true["first_moment_x[1]"] = links.m1 * links.x1
    true["inertia_zz[1]"] = links.i1 + links.m1 * links.x1**2
    true |= {f"viscous_friction[{k}].coefficient": v for k, v in enumerate(links.viscous, start=1)}
    true |= {f"coulomb_friction[{k}].level": v for k, v in enumerate(links.coulomb, start=1)}
    return links, true


def friction_lines(entry: Callable[[str], str]) -> list[str]:
    """Return the tables of viscous and Coulomb friction of both joints; `entry` gives an unknown."""
    lines = []
    for kind, key in (("viscous_friction", "coefficient"), ("coulomb_friction", "level")):
        row = ", ".join(entry(f"{kind}[{k}].{key}") for k in (1, 2))
        lines += ["[[effects]]", f'kind = "{kind}"', f"{key} = [{row}]"]
    return lines


def plant_lines(links: TwoLinks, entry: Callable[[str], str]) -> list[str]:
    """Return the table [plant] of two links under gravity; `entry` gives an unknown by its name."""
    lines = ["[plant]", 'kind = "serial_arm"', "gravity_vector = [0.0, -9.81, 0.0]"]
    for k, a in ((1, 0.0), (2, links.length)):
        sideways = "0.0" if k == 1 else entry("first_moment_y[2]")
        lines += ["[[plant.links]]", 'joint = "revolute"', "alpha_deg = 0.0", f"a = {a!r}"]
        lines += [f"mass = {(links.m1, links.m2)[k - 1]!r}"]
        lines += [f"first_moment = [{entry(f'first_moment_x[{k}]')}, {sideways}, 0.0]"]
        lines += [f"inertia = [0.0, 0.0, 0.0, 0.0, 0.0, {entry(f'inertia_zz[{k}]')}]"]
    return lines


def written(folder: Path, law: str = "", duration: float = 3.0, sensor: str = "", **swap: str) -> Path:
    """Write the case with other keys of its controller, all of them if a kind is among them, and sensor."""
    text = TEXT.replace("[sensor]\n", f"[sensor]\n{sensor}\n" if sensor else "")
    text = text.replace("duration = 3.0", f"duration = {duration}")
    text = text.replace('kind = "adaptive"\n', "" if "kind =" in law else 'kind = "adaptive"\n')
    text = text.replace("gate_velocity = 0.1\n", "" if "kind =" in law else "gate_velocity = 0.1\n")
    text = text.replace("[controller]\n", f"[controller]\n{law}\n")
    for old, new in swap.items():
        text = text.replace(old, new)
    path = folder / "case.toml"
    path.write_text(text)
    return path
