"""Progress of commands on a terminal, with the time left by how long the same command took before."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from jaxid import _cache
from jaxid.files import write_whole

# Commands whose durations are remembered, and the file that holds them.
_MOST = 300
_FILE = "durations.json"
# Time between two drawings [s], and time below which no duration is shown.
_TICK, _SHORT = 0.25, 3.0


class Durations:
    """Durations of commands that ended before, by command and arguments.

    Args:
        path: The file; None: nothing is remembered.
    """

    def __init__(self, path: Path | None):
        self.path = path

    @classmethod
    def of_user(cls) -> Durations:
        """Return those of this user; nothing is remembered with `JAXID_CACHE=off`."""
        if os.environ.get("JAXID_CACHE") == "off":
            return cls(None)
        try:
            return cls(_cache.home() / _FILE)
        except RuntimeError:
            # There is no home.
            return cls(None)

    def expected(self, words: Sequence[str]) -> float | None:
        """Return the time [s] that a command took before; None if that is not known."""
        value = self._read().get(_key(words))
        return float(value) if isinstance(value, (int, float)) else None

    def remember(self, words: Sequence[str], seconds: float) -> None:
        """Keep the time [s] that a command took, if the folder can be written to."""
        if self.path is None or seconds < _SHORT:
            return
        known = self._read()
        key = _key(words)
        known.pop(key, None)
        known[key] = round(seconds, 2)
        latest = dict(list(known.items())[-_MOST:])
        with contextlib.suppress(OSError, ValueError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.path, json.dumps(latest))

    def _read(self) -> dict:
        try:
            found = json.loads(self.path.read_text("utf-8")) if self.path is not None else {}
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


def _key(words: Sequence[str]) -> str:
    return hashlib.sha256("\0".join(words).encode()).hexdigest()[:16]


@contextlib.contextmanager
def progress(words: Sequence[str], *, shown: bool) -> Iterator[Callable[[str], None]]:
    """Show stage, time so far and time left on a terminal.

    Args:
        words: The command and its arguments, by which its duration is remembered.
        shown: Whether to show anything.

    Yields:
        A function to call with the name of every stage.
    """
    if not shown:
        yield lambda text: None
        return
    from tqdm import tqdm

    durations = Durations.of_user()
    expected, begun = durations.expected(words), time.monotonic()
    ended = threading.Event()
    layout = (
        "{desc:42.42s} {elapsed}{postfix}" if expected is None else "{desc:42.42s} |{bar}| {elapsed}{postfix}"
    )
    with tqdm(total=expected or 1.0, leave=False, bar_format=layout) as bar:

        def draw() -> None:
            spent = time.monotonic() - begun
            bar.n = min(spent, expected) if expected else 0.0
            bar.set_postfix_str(time_left(spent, expected), refresh=False)
            bar.refresh()

        def tick() -> None:
            while not ended.wait(_TICK):
                draw()

        def show(text: str) -> None:
            bar.set_description_str(text, refresh=False)
            draw()

        drawing = threading.Thread(target=tick, daemon=True)
        drawing.start()
        try:
            yield show
            durations.remember(words, time.monotonic() - begun)
        finally:
            ended.set()
            drawing.join()


def time_left(spent: float, expected: float | None) -> str:
    """Return the time left in words.

    Args:
        spent: Time so far [s].
        expected: Time that the same command took before [s]; None: it has not run before.
    """
    if expected is None:
        return "" if spent < _SHORT else "first run of this command: time left not known"
    left = expected - spent
    if left <= 0:
        return "longer than last time"
    return f"about {left:.0f} s left" if left < 90 else f"about {left / 60:.0f} min left"
