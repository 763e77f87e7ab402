"""Dry friction of joints in MuJoCo, a soft constraint under which a joint creeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# Largest impedance that MuJoCo takes, its mjMAXIMP.
_HARDEST = 0.9999
# Relative difference up to which two softnesses count as one.
_SAME = 1e-6


@dataclass(frozen=True)
class Softness:
    """Softness of the dry friction of a joint.

    A load F below the friction moves the joint at the velocity `creep` F / m, where m is the inertia that
    MuJoCo gives the joint (1 / dof_invweight0).

    Args:
        solref: `solreffriction`: time constant [s] and damping ratio, or stiffness and damping, negative.
        solimp: `solimpfriction`: impedance at zero violation, the only one that a friction has, and the
            largest one.

    Source:
        MuJoCo's documentation, Computation, Constraint model: parameters of the solver.
    """

    solref: tuple[float, float]
    solimp: tuple[float, float]

    @classmethod
    def of(cls, model: Any, dof: int) -> Softness:
        """Read the softness of a degree of freedom of a compiled model."""
        ref, imp = model.dof_solref[dof], model.dof_solimp[dof]
        return cls((float(ref[0]), float(ref[1])), (float(imp[0]), float(imp[1])))

    @classmethod
    def least(cls, step: float) -> Softness:
        """Return the stiffest friction at a time step [s]: it stops a joint within one.

        MuJoCo takes no time constant below two time steps.
        """
        return cls((2.0 * step, 1.0), (_HARDEST, _HARDEST))

    @classmethod
    def usual(cls) -> Softness:
        """Return that of a file that says nothing of it.

        Source:
            Defaults of solreffriction and solimpfriction in MuJoCo's XML reference.
        """
        return cls((0.02, 1.0), (0.9, 0.95))

    @property
    def creep(self) -> float:
        """Velocity under a load, times inertia over load [s]."""
        first, largest = (min(max(d, 1.0 - _HARDEST), _HARDEST) for d in self.solimp)
        rate = 2.0 / self.solref[0] if self.solref[0] > 0 else -self.solref[1]
        return (1.0 - first) / first * largest / max(rate, 1e-12)

    def softer(self, than: Softness) -> bool:
        """Check that a joint creeps faster than with another softness."""
        return self.creep > (1.0 + _SAME) * than.creep

    @property
    def doubled(self) -> Softness:
        """Softness with twice the creep."""
        first, largest = self.solimp
        return Softness(self.solref, (first / (2.0 - first), largest))

    def attributes(self) -> dict[str, str | None]:
        """Return the attributes of a joint of an MJCF."""
        written = {"solreffriction": self.solref, "solimpfriction": self.solimp}
        return {name: " ".join(map(repr, values)) for name, values in written.items()}

    def put(self, model: Any, dof: int) -> None:
        """Give it to a degree of freedom of a compiled model."""
        model.dof_solref[dof], model.dof_solimp[dof, :2] = self.solref, self.solimp
