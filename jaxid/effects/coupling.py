"""Effects of an elastic coupling beside its stiffness."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, AddedSpring, Effect, Scales, Signals
from jaxid.model.parameter import parameter
from jaxid.numerics import smooth

# Corner of the clearance, relative to it.
_CORNER = 1e-2


@register("backlash")
class Backlash(Effect):
    """No force passes a spring within its clearance: k times a dead zone of e, in place of k e.

    Stated as the force that cancels the spring's force: k clip(e) + d e' inside the gap, which is centred at
    the elongation of the relaxed spring.
    """

    title = "backlash"
    formula = "force of the spring = stiffness · (elongation, less a dead zone of gap)"
    met = "gears, worn couplings, keys and splines"
    part = "gear"

    of_spring = True
    with_springs = True
    opens_spring = True
    without_force_on_request = True

    gap: Array = parameter("position", "positive", "total clearance")

    def act(self, x: Signals, state: None) -> Action:
        half = 0.5 * self.gap
        width = _CORNER * half
        lost = smooth.clip(x.y, half, width)
        return Action(force=x.stiffness * lost + x.damping * smooth.within(x.y, half, width) * x.yd)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"gap": 1e-9 * scales.position}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"gap": scales.position * s} for s in (0.1, 0.3, 0.6, 1.0, 1.5)]

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"gap": (0.0, 2 * scales.position)}


@register("joint_flexibility")
class JointFlexibility(AddedSpring):
    """Part of the inertia, J, sits behind a spring: k e + d e' - (-J a) on the joint.

    e is the elongation of the spring: J (a + e'') = -k e - d e'. The inertia of the plant stays that of the
    whole; the effect subtracts its part J and adds the pull of the spring. In the simulation of an arm the
    plant does so, with the links behind the spring; see `LinkTree`. The state is e times the spring's
    frequency, and e': both have one size. With a clearance in series no force passes while |e| < gap / 2, and
    e less that half counts beyond: backlash between a motor with its encoder and its load.
    """

    title = "an elastic transmission"
    formula = "stiffness · e + damping · ė = load_inertia · a of the part behind it, e being the elongation"
    met = "belts, long screws, harmonic drives and couplings"
    part = "gear"

    without_force = True

    with_springs = False

    stiffness: Array = parameter("force/position", "positive", "of the spring")
    damping: Array = parameter("force*time/position", "positive", "beside the spring")
    load_inertia: Array = parameter("inertia", "positive", "part of the inertia behind it")
    gap: Array | None = parameter("position", "positive", "total clearance in series with it", optional=True)

    def act(self, x: Signals, state: Array) -> Action:
        _, ed, pull = self.spring(state)
        if x.elongating is not None:  # the plant has what is behind the spring, and its pull
            return Action(rate=jnp.stack([self._frequency * ed, x.elongating]))
        rate = jnp.stack([self._frequency * ed, -x.ydd - pull / self.load_inertia])
        return Action(force=self.load_inertia * x.ydd + pull, rate=rate)

    @property
    def _frequency(self) -> Array:
        return jnp.sqrt(jnp.divide(self.stiffness, self.load_inertia))

    def spring(self, state: Array) -> tuple[Array, Array, Array]:
        e, ed = state[0] / self._frequency, state[1]
        pull = self.stiffness * e + self.damping * ed
        if self.gap is not None:
            half = 0.5 * self.gap
            width = _CORNER * half
            lost = self.stiffness * smooth.clip(e, half, width)
            pull = pull - lost - self.damping * smooth.within(e, half, width) * ed
        return e, ed, pull

    def pulling(self, pull: Array) -> Array:
        e = pull / self.stiffness
        if self.gap is not None:
            e = e + 0.5 * self.gap * jnp.sign(pull)
        return jnp.stack([self._frequency * e, jnp.zeros_like(e)])

    def initial_state(self, u: Array) -> Array:
        return jnp.zeros((2,), u.dtype)

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Half of the inertia behind a spring with a period of 3 to 100 samples. At a fifth of critical
        # damping resonances are wide enough for a grid of a third of an octave.
        inertia = 0.5 * scales.natural("inertia")
        found = []
        for samples in 3.0 * 2.0 ** (np.arange(16) / 3.0):
            w = 2 * np.pi / (samples * scales.period)
            found.append({"stiffness": inertia * w**2, "damping": 0.4 * inertia * w, "load_inertia": inertia})
        return found


class BacklashOfJoint(JointFlexibility):
    """Part of the inertia, J, follows through a clearance and the spring behind it.

    It is `joint_flexibility` with a gap, as which a case states it: backlash of a joint that has no spring. A
    stiff spring only says how hard the load strikes, so that its stiffness is seldom identifiable.
    """

    title = "backlash"
    formula = "as joint_flexibility, less a dead zone of gap in the elongation"

    kind = "backlash"
    case_kind = JointFlexibility.kind

    gap: Array = parameter("position", "positive", "total clearance in series with the spring")

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Clearances over the stroke, each before a soft and a stiff contact with half of the inertia.
        inertia, found = 0.5 * scales.natural("inertia"), []
        for gap in (0.003, 0.01, 0.03, 0.1):
            for samples in (4.0, 10.0):
                w = 2 * np.pi / (samples * scales.period)
                spring = {"stiffness": inertia * w**2, "damping": 0.4 * inertia * w, "load_inertia": inertia}
                found.append({**spring, "gap": gap * scales.position})
        return found

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"gap": (0.0, scales.position)}


Backlash.of_joint = BacklashOfJoint
