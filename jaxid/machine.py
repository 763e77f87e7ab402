"""Machine: a plant with its drive, controller and sensors, as arrays and modules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller, with_effects
from jaxid.logs.log import Log
from jaxid.model.plant import Plant
from jaxid.model.units import Units
from jaxid.model.unknowns import CONTROLLER, Parameters, scatter_controller
from jaxid.references.unknown import UnknownReference
from jaxid.sensors.encoder import Sensor
from jaxid.settings import Disturbance


@dataclass(frozen=True, eq=False)
class Machine:
    """A plant with its drive, controller and sensors.

    Args:
        plant: The plant at its guesses (or true values).
        parameters: Unknown parameters of plant, reference and controller.
        gain: Declared force at the joint per unit of the logged command, gears of the plant included, (m,).
        units: Labels of the units.
        controller: The sampled law; None: unknown, only open loop can be simulated.
        disturbance: Signal added to the command in the loop: a square wave, or the name of a column
            of the log; None: nothing is added.
        sensor: Known errors of the measurement.
        hold: Course of the command between samples.
        reference_hold: Course of a logged reference between samples, where the log is slower than the loop.
        unknown_reference: Reference with unknowns, for logs without a reference; None: it is known.
        load: Known load in the loop that the plant takes behind the forces of its drives, at the samples of a
            log, (time, loads); None: there is none. See `jaxid.plants.loaded_axis`.
        held_load: The same as means over the ticks of the loop, (ticks, loads), which a simulation then takes
            in place of `load`; None: they are not known so finely.
    """

    plant: Plant
    parameters: Parameters
    gain: Float[np.ndarray, " m"]
    units: Units
    controller: Controller | None = None
    disturbance: Disturbance | str | None = None
    sensor: Sensor = Sensor()
    hold: str = "zero_order"
    reference_hold: str = "band_limited"
    unknown_reference: UnknownReference | None = None
    load: Float[np.ndarray, "time loads"] | None = None
    held_load: Float[np.ndarray, "ticks loads"] | None = None

    @property
    def hold_period(self) -> float | None:
        """Time for which the controller holds a command [s]; None without a controller."""
        return None if self.controller is None else self.controller.period

    @property
    def law(self) -> Controller | None:
        """The controller, with the fields that effects of the plant set."""
        return None if self.controller is None else with_effects(self.controller, self.plant, self.gain.size)

    @property
    def unknown_controller(self) -> tuple[str, ...]:
        """Names of the unknowns of the controller, those of effects on its command included."""
        effects = self.plant.effects
        return tuple(
            f.name
            for f in self.parameters.free
            if f.path[0] == CONTROLLER
            or f.effect is not None
            and effects[f.effect].controller_field is not None
        )

    def unforced(self, log: Log) -> bool:
        """Check that a log holds no force although a controller drives the machine."""
        return self.controller is not None and log.passive

    def ticks_between_rows(self, log: Log) -> bool:
        """Check that the loop computes commands between the rows of a log."""
        return self.controller is not None and log.period > 1.5 * self.controller.period

    def unit(self, quantity: str, joint: int = 0) -> str:
        """Return the unit of a quantity at a joint.

        Args:
            quantity: A dimension such as "position/time" (see `jaxid.model.units`).
            joint: Joint, 0-based.
        """
        return self.units.label(quantity, self.plant.motion(joint))

    def unit_by_joint(self, quantity: str, joints: Sequence[int] | None = None) -> str | list[str]:
        """Return the unit of a quantity at some joints: one if they share it, else one for each.

        Args:
            quantity: A dimension such as "position/time".
            joints: Joints, 0-based; None: all.
        """
        joints = range(self.plant.joints) if joints is None else joints
        every = [self.unit(quantity, int(k)) for k in joints]
        return every[0] if len(set(every)) == 1 else every

    def with_plant(self, plant: Plant, parameters: Parameters) -> Machine:
        """Return the machine with another plant and its unknowns."""
        return replace(self, plant=plant, parameters=parameters)

    def with_estimate(self, theta: Sequence[float] | Array) -> Machine:
        """Return the machine with these values of its unknowns, which are also the new guesses."""
        values = np.asarray(theta, dtype=np.float64)
        parameters = self.parameters.with_guess(values.tolist())
        plant = self.parameters.insert(self.plant, values)
        controller = scatter_controller(self.parameters.places, self.controller, values)
        unknown_reference = (
            None
            if self.unknown_reference is None
            else self.unknown_reference.with_unknowns(self.parameters.places, values)
        )
        return replace(
            self,
            plant=plant,
            parameters=parameters,
            controller=controller,
            unknown_reference=unknown_reference,
        )
