"""The notebooks as pages: their text and code, without outputs."""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "notebooks"
_CELL = re.compile(r"^# %%(.*)$", re.M)


def sources() -> dict[Path, str]:
    """Return the scripts of the notebooks, and their names on the site."""
    return {path: f"notebooks/{path.stem}.md" for path in sorted(FOLDER.glob("*.py"))}


def page(path: Path) -> str:
    """Return a notebook's script as Markdown."""
    pieces = _CELL.split(path.read_text("utf-8"))
    out = []
    # The first piece is the header of jupytext.
    for head, body in zip(pieces[1::2], pieces[2::2], strict=True):
        body = body.strip("\n")
        if "[markdown]" in head:
            out.append(re.sub(r"^# ?", "", body, flags=re.M))
        else:
            out.append(f"```python\n{body.rstrip()}\n```")
    where = f"\n\nThis page is the text of `notebooks/{path.stem}.ipynb`; run it to see its figures.\n"
    first, _, rest = "\n\n".join(out).partition("\n\n")
    return first + where + "\n" + rest + "\n"
