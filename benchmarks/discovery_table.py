"""The table of the benchmark of discovery, from its records."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from statistics import median

from truth.hidden import judge

Record = dict
# What the totals must reach: name -> bound, and whether it is a largest value.
AIMS = {
    "named right, all visible": (0.95, False),
    "named right, worst effect": (0.85, False),
    "false positives": (0.01, True),
    "both named, visible pairs": (0.90, False),
    "gap closed over truth's, median": (0.90, False),
    "parameters within 3 deviations": (0.95, False),
    "outside: unexplained and pointed at": (0.90, False),
}


def summary(records: Sequence[Record], cold: Sequence[dict] = ()) -> dict:
    """Return the content of the table, for JSON."""
    by = defaultdict(list)
    for r in records:
        by[r["group"]].append(r)
    effects = _visible(by["effects"])
    pairs, short, chains = (_visible(by[group]) for group in ("pairs", "short", "chains"))
    kinds = {k: [r for r in effects if r["what"] == k] for k in _whats(effects)}
    nulls = [*by["nulls"], *by["chain_nulls"]]
    single = [*effects, *short, *chains]
    named = [*single, *pairs]
    totals = {
        "named right, all visible": share(map(judge.right, single)),
        "named right, worst effect": min(
            (share(judge.right(r) for r in single if r["what"] == k) for k in _whats(single)),
            default=None,
        ),
        "false positives": share(map(judge.false_positive, nulls)),
        "both named, visible pairs": share(judge.right(r) for r in pairs),
        "gap closed over truth's, median": _median(_closings(named)),
        "parameters within 3 deviations": share(
            x <= judge.DEVIATIONS for r in named for x in judge.deviations(r)
        ),
        "outside: unexplained and pointed at": share(judge.pointed_at(r) for r in _visible(by["outside"])),
    }
    return {
        "counts": {group: len(rows) for group, rows in by.items()},
        "origin": _origin(records),
        "named": _named(single, pairs, nulls),
        "totals": totals,
        "effects": [_row(k, n, rows) for k, rs in kinds.items() for n, rows in _by_noise(rs)],
        "pairs": [_row(k, "all", [r for r in pairs if r["what"] == k]) for k in _whats(pairs)],
        "short": [_row(k, "all", [r for r in short if r["what"] == k]) for k in _whats(short)],
        "chains": [_row(k, "all", [r for r in chains if r["what"] == k]) for k in _whats(chains)],
        "invisible": [_sight(r) for r in records if r["oracle"] and not judge.visible(r)],
        "tied": [_sight(r) for r in records if any(s["ties"] for s in r["oracle"].values())],
        "wrong": [_wrong(r) for r in named if not judge.right(r)],
        "false positives": [_wrong(r) for r in nulls if judge.false_positive(r)],
        "outside": [_wrong(r) for r in _visible(by["outside"]) if not judge.pointed_at(r)],
        "seconds": _seconds(records, cold),
    }


def aims_hold(table: dict) -> bool:
    """Check that every aim that was measured is met."""
    return all(holds(name, value) for name, value in table["totals"].items() if value is not None)


def holds(name: str, value: float) -> bool:
    """Check that a total meets its aim."""
    bound, largest = AIMS[name]
    return value <= bound if largest else value >= bound


def share(truths: Iterable[bool]) -> float | None:
    """Return the share of truths, or None if there are none."""
    truths = list(truths)
    return sum(truths) / len(truths) if truths else None


def markdown(table: dict) -> str:
    """Return the page in Markdown."""
    parts = [
        "# Discovery on hidden effects",
        f"Written by {table['made']}; {table['origin']}.",
        _lines("Cases", table["counts"]),
        table["named"],
        "## Aims",
    ]
    rows = [
        [name, _text(value), f"{'<=' if AIMS[name][1] else '>='} {AIMS[name][0]:g}",
         "yes" if holds(name, value) else "NO"]
        for name, value in table["totals"].items()
        if value is not None
    ]  # fmt: skip
    parts.append(_grid(["total", "is", "aim", "met"], rows))
    if table["effects"]:
        parts += ["## At a glance: named right of visible", glance(table)]
    for title in ("effects", "pairs", "short", "chains"):
        if table[title]:
            parts += [f"## {title.capitalize()}, visible ones", _results(table[title])]
    parts += ["## Seconds", _lines("discover", table["seconds"])]
    for title in ("wrong", "false positives", "outside", "invisible", "tied"):
        entries = [f"- {' | '.join(map(str, e.values()))}" for e in table[title]]
        parts += [f"## {title.capitalize()}: {len(entries)}", "\n".join(entries)]
    return "\n\n".join(p for p in parts if p) + "\n"


def glance(table: dict) -> str:
    """Return a line for each effect, by noise: named right of visible, gap closed, seconds."""
    noises = list(dict.fromkeys(r["noise"] for r in table["effects"]))
    rows = []
    for what in dict.fromkeys(r["what"] for r in table["effects"]):
        own = {r["noise"]: r for r in table["effects"] if r["what"] == what}
        cells = [f"{own[n]['right']}/{own[n]['visible']}" if n in own else "" for n in noises]
        wrong = Counter(w["said"] for w in table["wrong"] if w["id"].startswith(f"effects/{what}/"))
        rows.append(
            [what, *cells, _text(own["all"]["closed"]), _text(own["all"]["seconds"]),
             "; ".join(f"{said}: {n}" for said, n in wrong.items())]
        )  # fmt: skip
    heads = ["hidden", *[n if n == "all" else f"noise {n}" for n in noises], "closed", "s", "wrong"]
    return _grid(heads, rows)


def _origin(records: Sequence[Record]) -> str:
    """Say on which code the records were made, and with which last fit."""
    commits = Counter(r.get("commit", "unknown") for r in records)
    of = ", ".join(
        f"{commit} ({count} cases)" if len(commits) > 1 else commit for commit, count in commits.items()
    )
    last = Counter(r["method"] for r in records if r.get("refit", False))
    refits = ", ".join(f"{count} by {method.replace('_', ' ')}" for method, count in last.most_common())
    ended = sum("error" in r for r in records)
    without = len(records) - ended - sum(last.values())
    words = [f"refitted as the command does; methods whose values were kept: {refits}" if last else ""]
    words.append(f"{without} without the refit" if without else "")
    words.append(f"{ended} refused or ended in an error" if ended else "")
    return f"commit {of}; " + "; ".join(filter(None, words))


def _named(single: Sequence[Record], pairs: Sequence[Record], nulls: Sequence[Record]) -> str:
    """Count what is named alone, what is named as one of rivals, and what is not called complete."""
    strictly, alike = (sum(map(judged, single)) for judged in (judge.strictly_right, judge.right))
    both = sum(map(judge.right, pairs))
    false = sum(map(judge.false_positive, nulls))
    said = {
        f"Of visible single effects {strictly} of {len(single)} are named strictly, {alike} strictly or as "
        "one of rivals that explain both logs as well.": single,
        f"Of visible pairs both are named in {both} of {len(pairs)}.": pairs,
        f"Of {len(nulls)} complete models {false} are not called complete.": nulls,
    }
    return " ".join(sentence for sentence, of in said.items() if of)


def _visible(records: Iterable[Record]) -> list[Record]:
    return [r for r in records if judge.visible(r)]


def _whats(records: Iterable[Record]) -> list[str]:
    return list(dict.fromkeys(r["what"] for r in records))


def _by_noise(records: Sequence[Record]) -> list[tuple[str, list[Record]]]:
    levels = sorted({r["noise"] for r in records})
    rows = [(f"{n:g}", [r for r in records if r["noise"] == n]) for n in levels]
    return [*rows, ("all", list(records))]


def _row(what: str, noise: str, rows: Sequence[Record]) -> dict:
    within = [x <= judge.DEVIATIONS for r in rows for x in judge.deviations(r)]
    seconds = [r["seconds"] for r in rows if r.get("warm") and "seconds" in r]
    return {
        "what": what, "noise": noise, "visible": len(rows),
        "right": sum(map(judge.right, rows)), "strictly": sum(map(judge.strictly_right, rows)),
        "closed": _median(_closings(rows)), "within": share(within),
        "seconds": _median(seconds), "longest": max(seconds, default=None),
    }  # fmt: skip


def _closings(rows: Iterable[Record]) -> list[float]:
    """Return the closed part of the gap for the cases that the oracle sees; 0 if nothing was named."""
    return [c for r in rows if (c := judge.closed(r)) is not None]


def _median(values: Sequence[float]) -> float | None:
    return median(values) if values else None


def _seconds(records: Sequence[Record], cold: Sequence[dict]) -> dict:
    warm = [r["seconds"] for r in records if r.get("warm") and "seconds" in r]
    first = [r["seconds"] for r in records if not r.get("warm") and "seconds" in r]
    fresh = [c["seconds"] for c in cold]
    return {
        "in a warm process, median": _median(warm), "in a warm process, longest": max(warm, default=None),
        "in a warm process, CPU, median": _median(
            [r["cpu_seconds"] for r in records if r.get("warm") and "cpu_seconds" in r]
        ),
        "first in its process, median": _median(first),
        "fresh command, median": _median(fresh), "fresh command, longest": max(fresh, default=None),
    }  # fmt: skip


def _sight(record: Record) -> dict:
    said = [
        f"{kind}: {min(s['evidence']):.3g} nats, {min(s['share']):.3f} of the force"
        + (f", tied with {', '.join(s['ties'])}" if s["ties"] else "")
        for kind, s in record["oracle"].items()
    ]
    return {"id": record["id"], "oracle": "; ".join(said)}


def _wrong(record: Record) -> dict:
    said = record["verdict"] + (f": {', '.join(record['named'])}" if record["named"] else "")
    others = [k for group in record.get("alternatives", []) for k in group]
    said += f" (or {', '.join(others)})" if others else ""
    closed = judge.closed(record)
    where = record.get("where")
    return {
        "id": record["id"], "said": said, "closed": "" if closed is None else f"{closed:.3f}",
        "why": record.get("error") or (where["text"] if where and not record["named"] else ""),
    }  # fmt: skip


def _results(rows: Sequence[dict]) -> str:
    heads = ["hidden", "noise", "visible", "right", "strictly", "closed", "within 3 sd", "s", "longest s"]
    return _grid(heads, [[_text(v) for v in row.values()] for row in rows])


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return ""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _lines(title: str, values: dict) -> str:
    return f"{title}: " + ", ".join(f"{name} {_text(value)}" for name, value in values.items()) + "."


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
