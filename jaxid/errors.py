"""The one exception for bad input, and the words that help to correct it."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Input that jaxid cannot work with; its text is one line: where, what, and a hint.

    The command line prints the text and ends with exit status 2, so it must be
    understandable without a traceback.
    """

    def __init__(self, what: str, *, where: str = "", hint: str = ""):
        """Compose the line.

        Args:
            what: The fault, with the offending value and its unit.
            where: File, table, column or row in which it stands.
            hint: What the user can do about it.
        """
        line = f"{where}: {what}" if where else what
        if hint:
            line = f"{line}; {hint}"
        # Texts of other libraries may hold line breaks; a shell user wants one line.
        super().__init__(" ".join(line.split()))


def suggest(name: str, known: Iterable[str], *, limit: int = 12) -> str:
    """Help with a misspelt name: the nearest one known, and what there is.

    Args:
        name: What was asked for.
        known: All names that would have done.
        limit: At most so many names are listed.

    Returns:
        Build the hint of an `InputError`.
    """
    names = list(known)
    if not names:
        return "there are none"
    folded = {other.casefold(): other for other in reversed(names)}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.6)
    listed = ", ".join(names[:limit]) + (", ..." if len(names) > limit else "")
    question = f"did you mean '{folded[near[0]]}'? " if near else ""
    return f"{question}there is: {listed}"
