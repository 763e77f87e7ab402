"""The command `study`: run the chunks of a plan on all cores, keep each, and gather the table."""

from __future__ import annotations

import contextlib
import functools
import io
import json
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from jaxid.case.case import CaseLike, load_case
from jaxid.case.user_faults import named_faults
from jaxid.errors import InputError
from jaxid.estimators.simulated_output import choose_numerics, position_jacobian
from jaxid.files import check_folder, mark_folder, new_folder, write_json, write_whole
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.lanes import run_alone
from jaxid.scene import Scene
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError
from jaxid.studies.levels import Level
from jaxid.studies.logs import machines_of
from jaxid.studies.plan import Plan, at_once, digest_of, same
from jaxid.studies.remote import Bundle, Remote
from jaxid.studies.result import FILES, Study, gathered
from jaxid.studies.rows import Arrays
from jaxid.studies.runs import Runner

_MANIFEST = "study.json"
_CHUNKS = "chunks"

# Called with the number of runs done, and of all runs.
Progress = Callable[[int, int], None]


@named_faults()
def study(
    case: CaseLike,
    *,
    runs: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    scheduler: str | None = None,
    progress: Progress = lambda done, runs: None,
) -> Study:
    """Simulate and identify a case many times.

    Args:
        case: The case, its file, or a dict with its tables; [simulation] and [study] describe the study, and
            `true` states a true value that differs from the guess.
        runs: Number of runs at each level; None: that of the case.
        seed: Seed of everything that is drawn.
        folder: Folder that keeps each chunk as soon as it ends, and the results; None: in memory only.
        resume: Whether to continue an interrupted study in that folder, to the same bits.
        overwrite: Whether to write into a folder that jaxid did not make.
        scheduler: Address of a Dask scheduler whose workers run the chunks; None: all cores of this machine.
        progress: Function called with the number of runs done, and of all runs.

    Raises:
        InputError: If the case does not state the simulation completely, or the folder holds another study.
    """
    case = load_case(case)
    where = None if folder is None else Path(folder)
    _need_folder(where, resume=resume, overwrite=overwrite)
    begun = _begun(where) if resume and where is not None else {}
    with contextlib.ExitStack() as stack:
        remote = None if scheduler is None else stack.enter_context(Remote(scheduler))
        plan = Plan.of(case, runs=runs, seed=seed, workers=remote and remote.threads)
        # The number of runs solved together changes the last bits, so that of the first start is kept.
        plan = replace(plan, chunk=int(begun.get("chunk", plan.chunk)))
        if resume:
            _need_same_study(plan, begun, where)

        # Every refusal comes before the first write.
        runner = Runner(plan)
        for level in range(len(plan.levels)):
            runner.ways(level)
        solved = (
            functools.partial(_solved, runner)
            if remote is None
            else functools.partial(remote.run, Bundle.of(plan))
        )
        bound = np.stack([_bound(plan, level) for level in plan.levels])
        identity = digest_of(plan.manifest)
        kept = _kept(where, plan, identity) if resume and where is not None else {}

        if where is not None and not resume:
            _begin(where, plan)
        missing = [k for k in range(len(plan.chunks)) if k not in kept]
        total, done = plan.runs * len(plan.levels), sum(len(plan.chunks[k][1]) for k in kept)
        progress(done, total)
        for number, arrays in solved(missing):
            kept[number] = arrays
            if where is not None:
                write_whole(_path(where, number), _packed(arrays, identity))
            done += len(plan.chunks[number][1])
            progress(done, total)

    result = gathered(plan, [kept[k] for k in range(len(plan.chunks))], bound)
    if where is not None:
        result.save(where, overwrite=overwrite)
    return result


def _need_folder(where: Path | None, *, resume: bool, overwrite: bool) -> None:
    """Refuse a folder that holds a study already, or no folder to resume from."""
    if resume:
        if where is None:
            raise InputError("there is nothing to resume from", hint="give the folder of the study: -o DIR")
        return
    if where is None:
        return
    check_folder(where, FILES, overwrite=overwrite)
    if (where / _MANIFEST).exists():
        raise InputError(
            "holds a study already",
            where=str(where),
            hint="continue it with --resume, or choose another -o",
        )


def _need_same_study(plan: Plan, begun: dict, where: Path | None) -> None:
    """Refuse to resume a study of another case or with other options."""
    differs = same(plan.manifest, begun)
    if differs:
        raise InputError(
            f"holds another study: {differs} differ",
            where=str(where),
            hint="resume with the same case and options, or choose another -o",
        )


def _solved(runner: Runner, numbers: list[int]) -> Iterator[tuple[int, Arrays]]:
    """Yield chunks as they end, as many at once as the device takes; compiled code releases Python's lock.

    Linear algebra uses one thread meanwhile, because its threads would wait for each other in a loop.
    """
    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(at_once()) as pool:
        pending: dict[Future, int] = {pool.submit(runner.chunk, number): number for number in numbers}
        try:
            while pending:
                finished, _ = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield pending.pop(future), future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _begin(folder: Path, plan: Plan) -> None:
    """Prepare the folder of a study; the manifest is written last, so that it marks a complete folder."""
    with new_folder(folder):
        mark_folder(folder)
        chunks = folder / _CHUNKS
        try:
            chunks.mkdir(exist_ok=True)
            for old in chunks.iterdir():
                old.unlink()
            write_json(folder / _MANIFEST, plan.manifest)
        except OSError as error:
            raise InputError(
                f"cannot be written: {error.strerror}", where=str(chunks), hint="choose another -o"
            ) from error
        except InputError:
            # Empty here; the folder itself may now be removed too.
            chunks.rmdir()
            raise


def _begun(folder: Path) -> dict:
    """Read the manifest with which the study of a folder was started."""
    path = folder / _MANIFEST
    if not path.exists():
        raise InputError(
            "holds no study", where=str(folder), hint="leave out --resume, or give the study's folder"
        )
    try:
        begun = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(begun, dict):
            raise ValueError("it is no object")
        return begun
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(
            f"cannot be read: {error}", where=str(path), hint="start again in another folder"
        ) from error


def _kept(folder: Path, plan: Plan, identity: str) -> dict[int, Arrays]:
    """Read the chunks of a folder, and remove the parts of one that was interrupted."""
    for part in (folder / _CHUNKS).glob(".*.npz.*"):
        part.unlink()
    there = {k: _path(folder, k) for k in range(len(plan.chunks))}
    return {k: _unpacked(p, identity) for k, p in there.items() if p.exists()}


def _path(folder: Path, number: int) -> Path:
    return folder / _CHUNKS / f"{number:06d}.npz"


def _packed(arrays: Arrays, identity: str) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, study=np.asarray(identity), **arrays)
    return buffer.getvalue()


def _unpacked(path: Path, identity: str) -> Arrays:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            content = {name: arrays[name] for name in arrays.files}
        study_of_chunk = str(content.pop("study"))
    except Exception as error:
        # A damaged archive raises errors of a dozen kinds.
        raise InputError(
            f"cannot be read: {error}", where=str(path), hint="remove this file, and resume again"
        ) from error
    if study_of_chunk != identity:
        raise InputError(
            "belongs to another study", where=str(path), hint="remove this file, and resume again"
        )
    return content


def _bound(plan: Plan, level: Level) -> np.ndarray:
    """Return the Cramer-Rao bound on the standard deviation of each parameter at a level.

    The bound holds for an unbiased estimate from the readings of all logs of a run with white noise, if the
    start and the command are known exactly. In a loop too the command follows from the readings so far, so
    that the derivative of the position under a given command counts. The bound is NaN if the case states no
    noise of the readings, if nothing is fitted to logs, if these hold no force or gains are unknown, so that
    the command is not known exactly, or if the logs do not determine all parameters. If true values are
    drawn, it is the bound at their median.
    """
    none, scene, whole = np.full(len(plan.names), np.nan), level.scene, level.scene.machine
    unknown_command = plan.without_force or any(f.path[0] == CONTROLLER for f in whole.parameters.free)
    if whole.sensor.position_std is None or not plan.fits or unknown_command:
        return none
    every, names = [], whole.parameters.names
    for _, _, machine in machines_of(scene.case, whole):
        own = _rows_of_readings(scene, machine)
        if own is None:
            return none
        rows = np.zeros((len(own), len(names)))
        rows[:, [names.index(name) for name in machine.parameters.names]] = own
        every.append(rows)
    rows = np.concatenate(every)
    scale = np.linalg.norm(rows, axis=0)
    if not np.all(np.isfinite(scale)) or np.any(scale == 0):
        return none
    values, vectors = np.linalg.eigh((rows / scale).T @ (rows / scale))
    if values[0] <= 1e-12 * values[-1]:
        return none
    return (np.sqrt(np.sum(vectors**2 / values, axis=1)) / scale)[plan.own]


def _rows_of_readings(scene: Scene, machine: Machine) -> np.ndarray | None:
    """Return the derivatives of the readings of one log over their noise; None if it cannot be simulated."""
    silent = replace(machine, sensor=replace(machine.sensor, position_noise=None, force_noise=None))
    simulated_log = run_alone(scene.simulated_log(silent, np.random.default_rng(0)))
    # The command of every tick; the log may hold only some of them.
    run = simulated_log.trajectory
    ticks = scene.drive.period * np.arange(len(run.command))
    log = Log(ticks, np.asarray(run.reading), np.asarray(run.command), hold=simulated_log.log.hold)
    driven = replace(machine, controller=None)
    try:
        numerics = choose_numerics(driven, log, segments=False)
        jacobian = position_jacobian(driven, log, numerics)[:: scene.every]
    except TooStiffError:
        return None
    noise = position_noise(machine, log)
    return (jacobian / np.where(noise > 0, noise, np.nan)[:, None]).reshape(-1, jacobian.shape[-1])
