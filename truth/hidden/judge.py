"""Judge a record of a hidden case against the truth that made its log."""

from collections.abc import Mapping

Record = Mapping
DEVIATIONS = 3.0
_HIT = 0.8  # part of the bursts that the intervals must hold
_AIM = 0.05  # s, by which an interval may miss a burst: three periods of a band of 60 Hz
_NOTHING = 0.02  # part of a gap: what acts at rest closes less of the force while moving
_LINE = 0.02  # part by which a frequency may be off, and no less than a tenth of a hertz


def visible(record: Record) -> bool:
    """Return whether the oracle sees each hidden effect beside the others."""
    return all(sight["visible"] for sight in record["oracle"].values())


def strictly_right(record: Record) -> bool:
    """Return whether exactly the hidden effects are named."""
    return record["verdict"] == "found" and sorted(record["named"]) == sorted(record["hidden"])


def right(record: Record) -> bool:
    """Return whether exactly the hidden effects are named, or a tied rival with the truth beside it."""
    if record["verdict"] != "found" or len(record["named"]) != len(record["hidden"]):
        return False
    left = list(record["hidden"])
    for name, others in zip(record["named"], record["alternatives"], strict=True):
        match = [k for k in left if k == name] or [
            k for k in left if name in record["oracle"][k]["ties"] and k in others
        ]
        if not match:
            return False
        left.remove(match[0])
    return True


def false_positive(record: Record) -> bool:
    """Return whether anything is seen in a complete model."""
    return record["verdict"] != "nothing_missing"


def pointed_at(record: Record) -> bool:
    """Return whether a disturbance is called unexplained and shown where it is."""
    where = record.get("where")
    if record["verdict"] != "unexplained" or where is None:
        return False
    amplitude, frequency = record["outside"]["clock"]
    if amplitude:
        line = where["frequency_hz"]
        return line is not None and abs(line - frequency) < max(0.1, _LINE * frequency)
    bursts, intervals = record["outside"]["bursts"], where["intervals"]
    hit = [
        any(a - _AIM <= start + length / 2 <= b + _AIM for a, b in intervals) for start, length, _ in bursts
    ]
    # Intervals over the whole log would hold every burst and say nothing.
    total = sum(b - a for a, b in intervals)
    narrow = total < 3 * sum(length + 2 * _AIM for _, length, _ in bursts)
    return sum(hit) >= _HIT * len(hit) and narrow


def closed(record: Record) -> float | None:
    """Return the gap closed on the last log over the gap that the truth closes; None if that is zero."""
    gap = record.get("gap")
    if not gap or not gap["truth"]:
        return None
    before, after, truth = (gap[k][-1] for k in ("before", "after", "truth"))
    return (before - after) / (before - truth) if before - truth > _NOTHING * before else None


def deviations(record: Record) -> list[float]:
    """Return the errors of the parameters over their standard deviations, if all effects are right."""
    if not strictly_right(record):
        return []
    return [
        abs(value - true) / std if std else float("inf")
        for true, value, std in record["parameters"].values()
        if true is not None and value is not None and std is not None
    ]
