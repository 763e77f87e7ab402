"""The range of rows to read from a file."""

from pathlib import Path

from jaxid.errors import InputError

# 0-based and half open, as Python slices.
Rows = tuple[int, int]


def resolve_rows(rows: Rows | None, count: int, path: Path) -> Rows:
    """Check a range of rows against the rows that a file has.

    Args:
        rows: First row and end, 0-based and half open; None: all.
        count: Number of rows in the file.
        path: The file, for the message.

    Returns:
        First row and end of the range.

    Raises:
        InputError: If the range is empty, reversed or beyond the file.
    """
    if rows is None:
        return (0, count)
    first, end = rows
    if not 0 <= first < end <= count:
        hint = f"the file has {count} rows: give 0 <= first < end <= {count} (0-based, half open)"
        raise InputError(f"rows = [{first}, {end}] are out of range", where=str(path), hint=hint)
    return (first, end)
