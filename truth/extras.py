"""Say in one line which optional dependencies a script lacks; standard library only."""

import sys
from importlib.util import find_spec


def need_extra(extra: str, *modules: str) -> None:
    """End the process with status 2 if a module of an extra of the package is not installed.

    Args:
        extra: The extra of pyproject.toml that brings the modules.
        modules: Names of the top-level modules to look for; none is imported.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        print(f"{', '.join(missing)} not installed; run: pip install '.[{extra}]'", file=sys.stderr)
        raise SystemExit(2)
