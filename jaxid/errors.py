"""The exception for bad input, and hints that help to correct it."""

import difflib
from collections.abc import Iterable

# Most characters of a name that a hint lists.
_LONGEST = 40
# Most characters that an error repeats of what a library says.
_LONGEST_CAUSE = 200


class InputError(ValueError):
    """Input that jaxid cannot work with; its text is one line: where, what, and a hint.

    The command line prints the text and ends with exit status 2, so it must be
    understandable without a traceback.
    """

    def __init__(self, what: str, *, where: str = "", hint: str = ""):
        """Compose the line.

        Args:
            what: The fault, with the offending value and its unit.
            where: File, table, column or row of the fault.
            hint: Action that corrects it.
        """
        line = f"{where}: {what}" if where else what
        if hint:
            line = f"{line}; {hint}"
        # Texts of other libraries may hold line breaks.
        super().__init__(" ".join(line.split()))


def suggest(name: str, known: Iterable[str], *, limit: int = 12) -> str:
    """Suggest the nearest known name for a misspelt one, and list the known names.

    Args:
        name: The name that was given.
        known: All names that are accepted.
        limit: Largest number of names to list.

    Returns:
        The hint of an `InputError`.
    """
    names = list(known)
    if not names:
        return "there are none"
    folded = {other.casefold(): other for other in reversed(names)}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.6)
    # Names from a damaged file have any length.
    short = [known[:_LONGEST] + "..." * (len(known) > _LONGEST) for known in names[:limit]]
    listed = ", ".join(short) + (", ..." if len(names) > limit else "")
    question = f"did you mean '{folded[near[0]]}'? " if near else ""
    return f"{question}there is: {listed}"


def cause(error: BaseException) -> str:
    """Return what a library says of an error in one line of at most 200 characters, or the error's name."""
    words = " ".join(str(error).split())
    if len(words) > _LONGEST_CAUSE:
        words = words[: _LONGEST_CAUSE - 4] + " ..."
    return words or type(error).__name__
