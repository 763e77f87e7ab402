"""Count words in the docstrings and comments of jaxid that make an engineer stumble.

    python tests/wording.py [FOLDER ...]

prints, for each folder and for the whole package, how often "what", "own" and "where" stand among 1000
words of docstrings and comments, and the share of function docstrings that begin with a word such as "Of"
or "What" in place of a verb. Well-kept packages of the field have 0 to 0.7, 0 to 0.1 and 1 to 2 of these
words. Comment lines and docstrings count, code and messages do not.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from dataclasses import dataclass, field
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "jaxid"
LIMITS = {"what": 1.5, "own": 0.5, "where": 3.0}  # a thousand words
NO_VERB = ("of", "what", "where", "as", "how", "by", "which", "whether", "with", "for", "there")
MOST_WITHOUT_VERB = 0.03
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class Count:
    """Words and docstrings counted so far."""

    words: int = 0
    found: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LIMITS, 0))
    functions: int = 0
    without_verb: list[str] = field(default_factory=list)

    def add(self, path: Path) -> None:
        """Count one file."""
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        prose = [
            t.string
            for t in tokenize.generate_tokens(io.StringIO(text).readline)
            if t.type == tokenize.COMMENT
        ]
        for node in ast.walk(tree):
            if isinstance(node, (ast.Module, ast.ClassDef, *FUNCTIONS)):
                doc = ast.get_docstring(node)
                prose += [doc] if doc else []
                if doc and isinstance(node, FUNCTIONS):
                    self.functions += 1
                    if begins_without_verb(doc):
                        self.without_verb.append(f"{path}:{node.lineno} {node.name}: {doc.splitlines()[0]}")
        words = re.findall(r"[a-z]+", re.sub(r"`[^`]*`", " ", " ".join(prose)).lower())
        self.words += len(words)
        for word in self.found:
            self.found[word] += words.count(word)

    def rate(self, word: str) -> float:
        """Occurrences in a thousand words."""
        return 1000 * self.found[word] / max(self.words, 1)

    @property
    def share_without_verb(self) -> float:
        """Share of function docstrings that begin without a verb."""
        return len(self.without_verb) / max(self.functions, 1)


def begins_without_verb(doc: str) -> bool:
    """Tell whether a docstring begins with a preposition, a pronoun or "The same"."""
    first = doc.split()[0].strip("`,.;:").lower()
    return first in NO_VERB or doc.startswith("The same")


def counted(*folders: Path) -> Count:
    """Count all files of some folders or modules."""
    count = Count()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder]:
            count.add(path)
    return count


def main(names: list[str]) -> None:
    """Print a row for each folder; with names, also every docstring that begins without a verb."""
    rooms = [Path(n) for n in names] or [
        p for p in sorted(PACKAGE.iterdir()) if p.is_dir() or p.suffix == ".py"
    ]
    print(f"{'':28}{'words':>8}" + "".join(f"{w:>8}" for w in LIMITS) + f"{'no verb':>9}")
    for room in rooms:
        show(room.name, counted(room))
    if not names:
        show("jaxid", counted(PACKAGE))
    for line in counted(*rooms).without_verb if names else ():
        print(line)


def show(name: str, count: Count) -> None:
    """Print one row."""
    rates = "".join(f"{count.rate(w):>8.1f}" for w in LIMITS)
    print(f"{name:28}{count.words:>8}{rates}{count.share_without_verb:>9.1%}")


if __name__ == "__main__":
    main(sys.argv[1:])
