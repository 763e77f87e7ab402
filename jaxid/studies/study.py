"""`study`: run the chunks of a plan on all cores, keep each as it ends, and gather the table."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators.output_error import choose_numerics, position_jacobian
from jaxid.estimators.steps import alone
from jaxid.io.case import Case, load_case
from jaxid.io.output import ready_folder, write_json, write_whole
from jaxid.machine import position_noise
from jaxid.studies.plan import Plan, cores, same
from jaxid.studies.remote import solved_by
from jaxid.studies.result import FILES, Study, gathered
from jaxid.studies.runs import Arrays, Runner, noisier

_MANIFEST = "study.json"
_CHUNKS = "chunks"

# Called with runs done, and runs in all.
Told = Callable[[int, int], None]


def study(
    case: Case | str | Path,
    *,
    runs: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    scheduler: str | None = None,
    progress: Told = lambda done, runs: None,
) -> Study:
    """Simulate and identify a case over and over.

    Args:
        case: The case, or its file; [simulation] and [study] say what to do, `true` where a true value
            differs from the guess.
        runs: At each level of noise; in place of the case's.
        seed: Of everything drawn.
        folder: Where each chunk is kept as soon as it ends, and the results at the end; absent: in
            memory only.
        resume: Go on where an interrupted study in that folder stopped: to the same bits.
        force: Write into a folder that jaxid did not make.
        scheduler: Address of a Dask scheduler whose workers run the chunks; absent: this machine, all
            cores.
        progress: Called with the number of runs done, and of all.

    Raises:
        InputError: If the case does not say what to simulate, or the folder holds another study.
    """
    case = case if isinstance(case, Case) else load_case(case)
    plan = Plan.of(case, runs=runs, seed=seed)
    kept: dict[int, Arrays] = {}
    where = None
    if folder is not None:
        where = ready_folder(Path(folder), FILES, force=force)
        plan, kept = _opened(where, plan, resume)
    elif resume:
        raise InputError("there is nothing to resume from", mend="give the folder of the study: -o DIR")
    total = plan.runs * len(plan.noise)
    done = sum(len(plan.chunks[number][1]) for number in kept)
    progress(done, total)
    missing = [k for k in range(len(plan.chunks)) if k not in kept]
    solved = _solved(plan, missing) if scheduler is None else solved_by(plan, missing, scheduler)
    for number, arrays in solved:
        kept[number] = arrays
        if where is not None:
            write_whole(_path(where, number), _packed(arrays))
        done += len(plan.chunks[number][1])
        progress(done, total)
    result = gathered(plan, [kept[k] for k in range(len(plan.chunks))], _bound(plan))
    if where is not None:
        result.save(where, force=force)
    return result


def _solved(plan: Plan, numbers: list[int]) -> Iterator[tuple[int, Arrays]]:
    """Chunks as they end, two threads at least busy: compiled code leaves Python's lock alone."""
    runner = Runner(plan)
    with ThreadPoolExecutor(cores()) as pool:
        left: dict[Future, int] = {pool.submit(runner.chunk, number): number for number in numbers}
        try:
            while left:
                finished, _ = wait(left, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield left.pop(future), future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _opened(folder: Path, plan: Plan, resume: bool) -> tuple[Plan, dict[int, Arrays]]:
    """The plan as it was begun in a folder, and the chunks that are there."""
    path = folder / _MANIFEST
    if not resume:
        if path.exists():
            raise InputError(
                "holds a study already", where=str(folder),
                mend="go on with it with --resume, or choose another -o",
            )
        (folder / _CHUNKS).mkdir(exist_ok=True)
        write_json(path, plan.manifest)
        return plan, {}
    if not path.exists():
        raise InputError(
            "holds no study", where=str(folder), mend="leave out --resume, or give the study's folder"
        )
    begun = json.loads(path.read_text(encoding="utf-8"))
    # How many runs are solved together changes the last bits: what was begun with stays.
    plan = replace(plan, chunk=int(begun.get("chunk", plan.chunk)))
    differs = same(plan.manifest, begun)
    if differs:
        raise InputError(
            f"the study there is another one: {differs} differ", where=str(folder),
            mend="give what it was begun with, or choose another -o",
        )
    there = {k: _path(folder, k) for k in range(len(plan.chunks))}
    return plan, {k: _unpacked(p) for k, p in there.items() if p.exists()}


def _path(folder: Path, number: int) -> Path:
    return folder / _CHUNKS / f"{number:06d}.npz"


def _packed(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _unpacked(path: Path) -> Arrays:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, OSError) as error:
        raise InputError(
            f"cannot be read: {error}", where=str(path), mend="remove this file, and resume again"
        ) from error


def _bound(plan: Plan) -> np.ndarray:
    """Cramer-Rao bound on the deviation of each parameter at each level of noise, (level, p).

    Of an unbiased estimate from the readings of one log, their noise white, the start and the command
    known exactly: in a loop too the readings so far give the command, so that what counts is the
    derivative of the position under a given command. NaN where the case states no noise of the
    readings, or where the log cannot tell.
    """
    out = np.full((len(plan.noise), len(plan.names)), np.nan)
    machine = plan.scene.machine
    if machine.sensor.position_std is None:
        return out
    silent = replace(machine, sensor=replace(machine.sensor, position_noise=None, force_noise=None))
    log = alone(plan.scene.virtual(silent, np.random.default_rng(0))).log
    alone_driven = replace(machine, controller=None)
    numerics = choose_numerics(alone_driven, log, segments=False)
    jacobian = position_jacobian(alone_driven, log, numerics)
    for level, factor in enumerate(plan.noise):
        noise = position_noise(noisier(machine, factor), log)
        rows = (jacobian / np.where(noise > 0, noise, np.nan)[:, None]).reshape(-1, jacobian.shape[-1])
        scale = np.linalg.norm(rows, axis=0)
        if not np.all(np.isfinite(scale)) or np.any(scale == 0):
            continue
        values, vectors = np.linalg.eigh((rows / scale).T @ (rows / scale))
        if values[0] > 1e-12 * values[-1]:
            out[level] = (np.sqrt(np.sum(vectors**2 / values, axis=1)) / scale)[plan.own]
    return out
