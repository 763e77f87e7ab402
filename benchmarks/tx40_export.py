"""TX40, an arm that no file describes: its log in, an MJCF out, and what MuJoCo's inverse dynamics leave.

    JAXID_DATA=FOLDER python -m benchmarks.tx40_export [-o DIR]

Fits links that bodies can be to two thirds of the log, writes an MJCF by `export`, and evaluates MuJoCo's
`mj_inverse` on random states and on the last third. DIR/tx40_export.md holds the torque that is left by
joint, how far MuJoCo's torques are from jaxid's, and the replay of the last third by MuJoCo.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxid
from benchmarks.measured import measured_folder
from benchmarks.stored_runs import commit_of
from experiments.tx40 import logs, with_bodies
from jaxid.commands.export import check_export, export
from jaxid.commands.identify import Identification
from jaxid.export.exported import ExportedFile
from jaxid.gap import force_gap
from jaxid.plants.link_tree import LinkTree
from jaxid.simulation.force_balance import ForceData

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
STATES = 1000
# MuJoCo's dry friction opposes v + a times half its time constant (two time steps of the file) times its
# largest impedance [s]; below this velocity [rad/s] it may be less.
AHEAD, CLEAR = 0.9999 * 0.001, 0.02


@dataclass(frozen=True)
class Torques:
    """Inverse dynamics of the exported file in MuJoCo, beside jaxid's.

    Args:
        rigid: Largest difference of torques by bodies, rotors and shaft over the largest torque of its joint:
            on random states, and along the last third.
        smooth: The same with viscous friction.
        dry: Share of the samples of the last third at which MuJoCo's dry friction is jaxid's one time step
            later, by joint, to 1e-9 of the largest; samples at which joint and shaft are faster than `CLEAR`.
        counted: Share of such samples, by joint.
        measured: RMS of the measured torque on the last third, by joint [N m].
        ours, theirs: RMS of what jaxid and MuJoCo leave of it [N m].
    """

    rigid: tuple[float, float]
    smooth: tuple[float, float]
    dry: np.ndarray
    counted: np.ndarray
    measured: np.ndarray
    ours: np.ndarray
    theirs: np.ndarray


def fitted(folder: Path) -> Identification:
    """Fit the arm to two thirds of its log, and save the result beside it."""
    logs(folder)
    case = folder / "tx40_bodies.toml"
    case.write_text(with_bodies((folder / "tx40.toml").read_text()))
    found = jaxid.identify(case, folder / "log.csv", method="inverse_dynamics")
    found.save(folder / "out", overwrite=True)
    return found


def torques(found: Identification, file: ExportedFile) -> Torques:
    """Compare the inverse dynamics of the file with jaxid's and with the last third of the log."""
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    plant, data = found.estimate.machine.plant, found.session.runs[1].data
    log = np.stack([data.q, data.qd, data.qdd])
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (3, STATES, plant.joints)) * [
        [[np.pi]],
        [[4]],
        [[20]],
    ]

    rigid = tuple(
        _apart(inverse(model, states, smooth=False)[0], of_effects(plant, states, "added_mass"))
        for states in (drawn, log)
    )
    kinds = ("added_mass", "viscous_friction")
    smooth = tuple(
        _apart(inverse(model, states)[0], of_effects(plant, states, *kinds)) for states in (drawn, log)
    )
    torque, dry = inverse(model, log)
    # jaxid's sign of the velocity is a tanh, here far narrower than any velocity.
    sharp = plant.smoothed(sharpness=jnp.asarray(1e-12), velocity_scale=jnp.ones(plant.joints))
    later = np.stack([data.q, data.qd + AHEAD * data.qdd, data.qdd])
    signs = of_effects(sharp, later, "coulomb_friction") - of_effects(plant, later)
    alike, clear = np.abs(dry - signs) < 1e-9 * np.abs(signs).max(axis=0), np.abs(later[1]) > CLEAR
    for ratios in plant.shafts:
        clear &= (np.abs(later[1] @ ratios) > CLEAR)[:, None] | (np.array(ratios) == 0.0)
    share = (alike & clear).sum(axis=0) / clear.sum(axis=0)

    # What MuJoCo leaves of the measured torque, in the pass band and at the samples that count in jaxid.
    arrays, gap = ForceData.of(data), force_gap(found.estimate.machine, data)
    whole = torque + dry - model.actuator_biasprm[:, 0]
    left = np.where(data.moving, np.asarray(arrays.decimator(jnp.asarray(whole - data.force))), np.nan)
    rms = lambda x: np.sqrt(np.nanmean(x**2, axis=0))
    measured = np.where(data.moving, gap.measured, np.nan)
    return Torques(rigid, smooth, share, clear.mean(axis=0), rms(measured), gap.rms, rms(left))


def inverse(model: mujoco.MjModel, states: np.ndarray, smooth: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the torques of MuJoCo without dry friction, and those of dry friction alone, (time, n)."""
    data, torque, dry = mujoco.MjData(model), [], []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(*states, strict=True):
        mujoco.mj_inverse(model, data)
        passive = 0.0 if smooth else data.qfrc_passive
        torque.append(data.qfrc_inverse + data.qfrc_constraint + passive)
        dry.append(-data.qfrc_constraint)
    return np.array(torque), np.array(dry)


def of_effects(plant: LinkTree, states: np.ndarray, *kinds: str) -> np.ndarray:
    """Return the torques of jaxid by bodies, rotors and effects of some kinds, (time, n)."""
    bare = replace(plant, effects=tuple(e for e in plant.effects if e.kind in kinds))
    none, still = bare.initial_states(jnp.zeros(plant.joints)), jnp.zeros(plant.joints)
    one = lambda q, v, a: bare.balance(q, v, a, still, jnp.zeros(()), none).residual
    return np.asarray(jax.jit(jax.vmap(one))(*map(jnp.asarray, states)))


def _apart(theirs: np.ndarray, ours: np.ndarray) -> float:
    return float((np.abs(theirs - ours).max(axis=0) / np.abs(ours).max(axis=0)).max())


def page(found: Identification, compared: Torques, file: ExportedFile, replay: str, seconds: float) -> str:
    """Return the page of the results."""
    joints = range(1, len(compared.ours) + 1)
    row = lambda what, cells: f"| {what} | " + " | ".join(cells) + " |"
    percent = lambda x: [f"{100 * v:.1f}" for v in x]
    newtons = lambda x: [f"{v:.3g}" for v in x]
    fit, _ = found.gaps
    lines = [
        "# TX40: an MJCF of an arm that no file describes",
        "",
        f"Written by `python -m benchmarks.tx40_export` on {date.today()}, at {commit_of(ROOT)}.",
        f"The fit (`physically_consistent`, two thirds of the log) took {seconds:.0f} s of a processor.",
        "",
        row("joint", map(str, joints)),
        "|---" * (len(compared.ours) + 1) + "|",
        row("torque on the last third, RMS [N m]", newtons(compared.measured)),
        row("left by jaxid [N m]", newtons(compared.ours)),
        row("left by MuJoCo's `mj_inverse` of the exported file [N m]", newtons(compared.theirs)),
        row("left by jaxid, % of the torque: fitted part", percent(fit.force.relative)),
        row("last third", percent(compared.ours / compared.measured)),
        row(f"samples above {CLEAR} rad/s, %", percent(compared.counted)),
        row("at which MuJoCo's frictionloss is jaxid's a time step later, %", percent(compared.dry)),
        "",
        "Torques of MuJoCo less those of jaxid, largest over the largest torque of the joint, on",
        f"{STATES} random states and along the last third:",
        "",
        "| | random states | last third |",
        "|---|---|---|",
        row("bodies, rotors, inertia of the shaft", [f"{x:.1g}" for x in compared.rigid]),
        row("with viscous friction of joints and shaft", [f"{x:.1g}" for x in compared.smooth]),
        "",
        "What the file does not hold:",
        "",
        *(f"- {note}" for note in file.notes),
        "",
        "The last third by `--check`:",
        "",
        "```",
        replay,
        "```",
    ]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Fit, export, compare, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    measured_folder(parser, "tx40")
    options.o.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder, begin = Path(name), time.process_time()
        found = fitted(folder)
        seconds, result = time.process_time() - begin, folder / "out" / "result.json"
        file = export(result, "mjcf", name="tx40")
        replay = str(check_export(result, "mjcf", file, folder / "last_third.csv"))
        text = page(found, torques(found, file), file, replay, seconds)
    (options.o / "tx40_export.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
