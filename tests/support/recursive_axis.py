"""A noisy axis of an exact stepper, from whose case guesses are a factor of three off."""

import dataclasses

import numpy as np

from jaxid.estimators import METHODS
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session
from tests.support.axis_log import log_of
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like
from truth.axis.stepper import Sensor

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
GAIN = ("actuator_gain", {"gain": 0.85})
TRUTH = np.array([95.1, 203.5, 20.39])
NOISY = Sensor(position_resolution=1e-7, position_noise=1e-6, force_noise=0.05)


def slide(duration=8.0, seed=0, **effects):
    setup = dataclasses.replace(emps_like(0, duration=duration), sensor=NOISY, seed=seed)
    for kind, values in effects.items():
        setup = setup.with_effect(kind, **values)
    return setup


def estimate(path, log, method="recursive"):
    return run_alone(METHODS[method](open_session(path, log)))


def written_axis(folder):
    setup = slide()
    return write_case(folder, case_text(setup, [VISCOUS, COULOMB], off=3.0)), log_of(setup)


def with_table(folder, axis, text):
    return write_case(folder, axis[0].read_text() + text)
