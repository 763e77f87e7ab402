"""A pole that hangs from a cart: a motor drives the cart along x, the pole swings freely."""

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.parameter import parameter
from jaxid.model.weight import WithGravity


class CartPole(WithGravity):
    """(M + m) x'' + m l (a'' cos a - a'^2 sin a) = u;  m l x'' cos a + m l^2 a'' + m g l sin a = 0.

    x is the position of the cart [m], a the angle of the pole from hanging down [rad]; effects add forces on
    the cart and moments about the pivot.
    """

    kind = "cart_pole"
    joints = 2
    motions = ("linear", "rotary")
    actuated = (0,)
    coupled = True

    cart_mass: Array = parameter("inertia", "positive", "M, of the cart", motion="linear")
    pole_mass: Array = parameter("inertia", "positive", "m, at the tip of the pole", motion="linear")
    pole_length: Array = parameter("position", "positive", "l, from the pivot to the tip", motion="linear")

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        sine, cosine = jnp.sin(q[1]), jnp.cos(q[1])
        moment = self.pole_mass * self.pole_length
        force = (self.cart_mass + self.pole_mass) * qdd[0] + moment * (qdd[1] * cosine - qd[1] ** 2 * sine)
        torque = moment * (qdd[0] * cosine + self.pole_length * qdd[1] + self.gravity * sine)
        return jnp.stack([force, torque])
