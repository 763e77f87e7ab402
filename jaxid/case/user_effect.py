"""A user-defined effect: a class in a Python file beside the case."""

from __future__ import annotations

from pathlib import Path

from jaxid.case.user_faults import check_declaration
from jaxid.case.user_file import check_kind, check_parameters, class_of_file
from jaxid.effects import EFFECTS
from jaxid.model.effect import Effect
from jaxid.schema import Spot


def user_effect(kind: str, folder: Path, spot: Spot) -> type[Effect]:
    """Import an effect.

    Args:
        kind: "my_effects.py:MyEffect".
        folder: Folder from which relative file names start.
        spot: Position of the kind in the case.

    Returns:
        The class; its `kind` is the text, if the class gives none.

    Raises:
        InputError: If there is no such file or class, it does not import, it is no effect, or its
            kind is that of another.
    """
    cls, module = class_of_file(
        kind, folder, Effect, "my_effects.py:MyEffect", spot, lambda c: check_declaration(c, kind, spot)
    )
    check_kind(cls, Effect, module, EFFECTS, kind, spot)
    # Faults that would only come up in the middle of a fit.
    if cls.act is Effect.act:
        raise spot.refuse(kind, "has no method act", "define act(self, x, state) -> Action")
    check_parameters(cls, kind, spot)
    return cls
