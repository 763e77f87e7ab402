"""One row per registered effect: an exact axis that has it, and a case that does not declare it."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from truth.axis import machines
from truth.axis.cases import Declared, case_text
from truth.axis.machines import Setup

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
SERVO = (("viscous_friction", {"coefficient": 2e-4}), ("coulomb_friction", {"level": 0.01}))


@dataclass(frozen=True)
class SearchCase:
    """A hidden effect.

    Attributes:
        kind: Its registered name.
        values: Its true parameters.
        declared: Effects that the case has, with their true parameters.
        preset: Machine, loop, sensor and reference, as a function of seed, noise and duration.
        duration: Of each log [s].
        inertia_known: Whether the case gives the inertia.
        orientation: Of the plant.
        motion: Of the plant.
        also: Kinds that this log cannot tell from it; then `alternatives` must hold the true one.
        tolerance: Of the parameters, relative; they may also be within three deviations.
        extra: More hidden effects.
        asked: Whether the search looks for it only because the case asks.
    """

    kind: str
    values: Mapping[str, float]
    declared: Declared = (VISCOUS, COULOMB)
    preset: object = machines.emps_like
    duration: float = 8.0
    inertia_known: bool = False
    orientation: str = "horizontal"
    motion: str = "linear"
    also: tuple[str, ...] = ()
    tolerance: float = 0.05
    extra: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    asked: bool = False

    def setup(self, seed: int, *, hidden: bool = True) -> Setup:
        """Build the machine with its hidden effect, and one reference."""
        own = self.preset(seed, 1.0, self.duration)
        gravity = -9.81 * own.machine.inertia if self.orientation == "vertical" else 0.0
        effects = {kind: dict(values) for kind, values in self.declared}
        effects |= {self.kind: dict(self.values)} if hidden else {}
        effects |= self.extra if hidden else {}
        machine = dataclasses.replace(own.machine, effects=effects, gravity_force=gravity)
        return dataclasses.replace(own, machine=machine)

    def text(self, off: float = 1.4) -> str:
        """Return the case file that does not declare the effect."""
        text = case_text(
            self.setup(0),
            self.declared,
            off=off,
            inertia_known=self.inertia_known,
            orientation=self.orientation,
            motion=self.motion,
        )
        return text + (f'[discover]\ncandidates = ["{self.kind}"]\n' if self.asked else "")


def _rows() -> dict[str, SearchCase]:
    rows = [
        SearchCase("viscous_friction", {"coefficient": 203.5}, declared=(COULOMB,)),
        SearchCase("coulomb_friction", {"level": 20.39}, declared=(VISCOUS,)),
        SearchCase("static_friction", {"level": 8.0}),
        SearchCase("stribeck_friction", {"level": 10.0, "velocity": 0.02}),
        SearchCase("asymmetric_viscous", {"coefficient": 60.0}),
        SearchCase("quadratic_drag", {"coefficient": 800.0}),
        SearchCase("cubic_friction", {"coefficient": 6000.0}),
        SearchCase("quartic_friction", {"coefficient": 40000.0}),
        SearchCase("constant_force", {"level": 6.0}),
        SearchCase("linear_stiffness", {"coefficient": 100.0}),
        SearchCase("quadratic_stiffness", {"coefficient": 400.0}),
        SearchCase("cubic_stiffness", {"coefficient": 1600.0}),
        SearchCase("cogging", {"amplitude": 5.0, "period": 0.02, "phase": 0.7}),
        SearchCase(
            "unbalance",
            {"moment": 5e-4, "phase": 0.7},
            declared=SERVO,
            preset=machines.servo,
            motion="rotary",
            asked=True,
        ),
        SearchCase("hysteresis", {"stiffness": 5000.0, "level": 20.0}, declared=(VISCOUS,)),
        # With friction unknown too, a gain is a mass by another name.
        SearchCase("actuator_gain", {"gain": 0.85}, inertia_known=True, also=("added_mass",)),
        SearchCase("actuator_offset", {"level": 6.0}, also=("constant_force",), asked=True),
        SearchCase("actuator_lag", {"time_constant": 3e-3}),
        SearchCase("input_delay", {"delay": 2e-3}),
        SearchCase("saturation", {"limit": 75.0}),
        SearchCase("voltage_limit", {"stall": 110.0, "velocity": 0.25}, asked=True),
        SearchCase("added_mass", {"mass": 15.0}, inertia_known=True, also=("actuator_gain",)),
        SearchCase("friction_drift", {"rate": 0.05}),
    ]
    return {row.kind: row for row in rows}


SEARCH_CASES = _rows()
# Effects that leave the force while moving as it is: they close no gap there.
AT_REST = {"static_friction"}
PAIRS = {
    "coulomb_friction + cogging": dataclasses.replace(
        SEARCH_CASES["coulomb_friction"], extra={"cogging": SEARCH_CASES["cogging"].values}
    ),
    "input_delay + asymmetric_viscous": dataclasses.replace(
        SEARCH_CASES["input_delay"], extra={"asymmetric_viscous": {"coefficient": 60.0}}
    ),
    "constant_force + cubic_stiffness": dataclasses.replace(
        SEARCH_CASES["constant_force"], extra={"cubic_stiffness": {"coefficient": 800.0}}
    ),
}
