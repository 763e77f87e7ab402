"""Variants of the case of six masses, for `wi_mimo_coulomb.py`."""

from __future__ import annotations

import re
from pathlib import Path

CASE = "chain6.toml"
# The first instants, of which everything is to be told [s].
FIRST = 0.1
# Every mass to and fro on its own beat, so that springs and frictions are told apart.
SWEEP = """[reference]
kind = "trapezoid"
start = 0.0
targets = [0.02, -0.015, 0.03, 0.005, -0.025, 0.0]
speed = [0.05, 0.08, 0.11, 0.06, 0.09, 0.07]
acceleration = [1.0, 1.6, 2.2, 1.2, 1.8, 1.4]

"""


def variant(
    folder: Path, name: str, *, rate: float = 1e3, friction: bool = True, poles: str | None = None
) -> Path:
    """Write the case at another rate, without friction, or with other poles, as a file by itself."""
    text = (folder / CASE).read_text()
    text = re.sub(r"period = [\d.]+", f"period = {1 / rate}", text)
    text = re.sub(r"sample_rate = [\d.]+", f"sample_rate = {rate}", text)
    if not friction:
        text = _without_effects(text)
    if poles is not None:
        text = text.replace("poles = [-60.0, -60.0]", f"poles = {poles}")
    return _written(folder / f"{name}.toml", text)


def one_driven(folder: Path, until: float) -> Path:
    """Only mass 2 driven and following; identified from the start until then."""
    text = (folder / CASE).read_text().replace('kind = "chain"', 'kind = "chain"\nactuated = [2]')
    text = re.sub(r"level = \[0.03.*?\]\nrise_time = \[.*?\]", "level = 0.05\nrise_time = 0.1", text)
    return _written(folder / "partial.toml", text, until)


def noisy(folder: Path, name: str, noise: float, study: str = "") -> Path:
    """Write the case of the first instants, with noise on the readings [m], and the study of it."""
    text = (folder / CASE).read_text().replace("duration = 10.0", f"duration = {FIRST}")
    text += f"\n[sensor]\nposition_noise = {noise:g}\n{study}"
    return _written(folder / f"{name}.toml", text)


def undeclared(folder: Path, name: str) -> Path:
    """Write the case of six masses to and fro without friction declared, with noise of 1 um."""
    text = _without_effects((folder / CASE).read_text())
    text = re.sub(r"\[reference\].*?(?=\[simulation\])", SWEEP, text, flags=re.S)
    path = folder / f"{name}.toml"
    path.write_text(text + "\n[sensor]\nposition_noise = 1e-6\n")
    return path


def long_chain(folder: Path, n: int) -> Path:
    """Write the case of a chain of n masses like the six, every one driven and following."""
    many = lambda make, count: "[" + ", ".join(make(k) for k in range(count)) + "]"
    value = lambda guess, true: f"{{ guess = {guess}, true = {true} }}"
    text = f"""
[plant]
kind = "chain"
[plant.parameters]
mass = {many(lambda k: value(2.5, 2.0 + 0.5 * (k % 6)), n)}
damping = {many(lambda k: value(5.0, 5.5 - 0.5 * (k % 6)), n)}
stiffness = {many(lambda k: value(700.0, 1000.0 - 100.0 * (k % 7)), n + 1)}
[[effects]]
kind = "coulomb_friction"
joint = {many(lambda k: str(k + 1), n)}
level = {many(lambda k: value(4.905, 4.0 + 0.2 * (k % 5)), n)}
[controller]
kind = "flatness"
poles = [-60.0, -60.0]
epsilon = 1e-3
period = 0.001
[reference]
kind = "quarter_sine"
level = {many(lambda k: f"{0.03 + 0.01 * ((3 * k) % 4)}", n)}
rise_time = {many(lambda k: f"{0.07 + 0.01 * ((2 * k) % 5)}", n)}
hold_until = 5.0
return_until = 10.0
[simulation]
duration = {FIRST}
sample_rate = 1000.0
"""
    return _written(folder / f"chain_{n}.toml", text)


def _without_effects(text: str) -> str:
    """Return the case of a chain without friction."""
    return re.sub(r"# mu m g.*?\n\n(?=\[controller\])", "", text, flags=re.S)


def _written(path: Path, text: str, until: float = FIRST) -> Path:
    """Write a case that identifies from its first instants."""
    path.write_text(text + f"\n[algebraic]\nwindow = [0.0, {until}]\n")
    return path
