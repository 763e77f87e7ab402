"""jaxid: identify machines with friction, and find the physics that a simulation is missing."""

from typing import TYPE_CHECKING, Any

from jaxid import _platform

_platform.configure()

if TYPE_CHECKING:
    from jaxid.arms.base_by_rules import base_parameters_by_rules as base_parameters_by_rules
    from jaxid.arms.base_parameters import BaseParameters as BaseParameters
    from jaxid.arms.base_parameters import base_parameters as base_parameters
    from jaxid.arms.base_parameters import inertial_regressor as inertial_regressor
    from jaxid.build import build_machine as build_machine
    from jaxid.build import make_plant as make_plant
    from jaxid.case.case import Case as Case
    from jaxid.case.case import load_case as load_case
    from jaxid.commands.check import Check as Check
    from jaxid.commands.check import check as check
    from jaxid.commands.compare import compare as compare
    from jaxid.commands.design import design as design
    from jaxid.commands.discover import discover as discover
    from jaxid.commands.identify import Identification as Identification
    from jaxid.commands.identify import identify as identify
    from jaxid.commands.identify import identify_many as identify_many
    from jaxid.commands.init import FirstCase as FirstCase
    from jaxid.commands.init import init as init
    from jaxid.commands.live import Live as Live
    from jaxid.commands.live import follow as follow
    from jaxid.commands.simulate import simulate as simulate
    from jaxid.commands.study import study as study
    from jaxid.comparison.result import Comparison as Comparison
    from jaxid.controllers import CONTROLLERS as CONTROLLERS
    from jaxid.controllers import Controller as Controller
    from jaxid.controllers import Tick as Tick
    from jaxid.discovery.result import Discovery as Discovery
    from jaxid.dynamics.rhs import State as State
    from jaxid.dynamics.rhs import vector_field as vector_field
    from jaxid.effects import EFFECTS as EFFECTS
    from jaxid.effects import register as _register
    from jaxid.errors import InputError as InputError
    from jaxid.estimators import METHODS as METHODS
    from jaxid.estimators import register_method as register_method
    from jaxid.estimators.algebraic.online import OnlineEstimate as OnlineEstimate
    from jaxid.estimators.common.levenberg_marquardt import (
        BoundedLevenbergMarquardt as BoundedLevenbergMarquardt,
    )
    from jaxid.estimators.estimate import Estimate as Estimate
    from jaxid.estimators.fit import Fit as Fit
    from jaxid.estimators.fit import fit as fit
    from jaxid.estimators.fit import parameter_names as parameter_names
    from jaxid.estimators.recursive.real_time import RealTime as RealTime
    from jaxid.experiment_design.along_reference import Excitation as Excitation
    from jaxid.experiment_design.in_loop import Design as Design
    from jaxid.experiment_design.unforced_design import UnforcedDesign as UnforcedDesign
    from jaxid.gap import Gap as Gap
    from jaxid.logs.in_memory import as_log as as_log
    from jaxid.logs.log import Log as Log
    from jaxid.logs.log import read_log as read_log
    from jaxid.logs.readers import register_reader as register_reader
    from jaxid.machine import Machine as Machine
    from jaxid.model.effect import Action as Action
    from jaxid.model.effect import Effect as Effect
    from jaxid.model.effect import Scales as Scales
    from jaxid.model.effect import Signals as Signals
    from jaxid.model.parameter import parameter as parameter
    from jaxid.model.plant import Plant as Plant
    from jaxid.model.smoothing import Smoothing as Smoothing
    from jaxid.plants import PLANTS as PLANTS
    from jaxid.references import REFERENCES as REFERENCES
    from jaxid.references import make_reference as make_reference
    from jaxid.results.parameters import Covariance as Covariance
    from jaxid.results.parameters import Parameter as Parameter
    from jaxid.results.parameters import ParameterTable as ParameterTable
    from jaxid.results.parameters import Residuals as Residuals
    from jaxid.scene import SimulatedLog as SimulatedLog
    from jaxid.sensors.encoder import Sensor as Sensor
    from jaxid.session import Session as Session
    from jaxid.session import open_session as open_session
    from jaxid.simulation.loops import Drive as Drive
    from jaxid.simulation.loops import Trajectory as Trajectory
    from jaxid.simulation.loops import closed_loop as closed_loop
    from jaxid.simulation.loops import initial_state as initial_state
    from jaxid.simulation.loops import open_loop as open_loop
    from jaxid.simulation.replay import Numerics as Numerics
    from jaxid.simulation.replay import Replay as Replay
    from jaxid.simulation.replay import make_replay as make_replay
    from jaxid.studies.result import Study as Study

    register_effect = _register
    __version__: str

# Names are loaded on first use: importing JAX takes a second, and help texts and checks of input do without.
# `tests/test_face.py` compares this table with the imports above.
_HOMES = {
    # commands
    "check": ("jaxid.commands.check", "check"),
    "identify": ("jaxid.commands.identify", "identify"),
    "identify_many": ("jaxid.commands.identify", "identify_many"),
    "discover": ("jaxid.commands.discover", "discover"),
    "compare": ("jaxid.commands.compare", "compare"),
    "init": ("jaxid.commands.init", "init"),
    "simulate": ("jaxid.commands.simulate", "simulate"),
    "design": ("jaxid.commands.design", "design"),
    "study": ("jaxid.commands.study", "study"),
    # cases and logs
    "load_case": ("jaxid.case.case", "load_case"),
    "Case": ("jaxid.case.case", "Case"),
    "read_log": ("jaxid.logs.log", "read_log"),
    "as_log": ("jaxid.logs.in_memory", "as_log"),
    "Log": ("jaxid.logs.log", "Log"),
    "open_session": ("jaxid.session", "open_session"),
    "Session": ("jaxid.session", "Session"),
    "InputError": ("jaxid.errors", "InputError"),
    # results
    "Identification": ("jaxid.commands.identify", "Identification"),
    "Discovery": ("jaxid.discovery.result", "Discovery"),
    "Comparison": ("jaxid.comparison.result", "Comparison"),
    "Check": ("jaxid.commands.check", "Check"),
    "Study": ("jaxid.studies.result", "Study"),
    "FirstCase": ("jaxid.commands.init", "FirstCase"),
    "Design": ("jaxid.experiment_design.in_loop", "Design"),
    "Excitation": ("jaxid.experiment_design.along_reference", "Excitation"),
    "UnforcedDesign": ("jaxid.experiment_design.unforced_design", "UnforcedDesign"),
    "Parameter": ("jaxid.results.parameters", "Parameter"),
    "ParameterTable": ("jaxid.results.parameters", "ParameterTable"),
    "Covariance": ("jaxid.results.parameters", "Covariance"),
    "Residuals": ("jaxid.results.parameters", "Residuals"),
    "SimulatedLog": ("jaxid.scene", "SimulatedLog"),
    "Estimate": ("jaxid.estimators.estimate", "Estimate"),
    "Gap": ("jaxid.gap", "Gap"),
    # machines in a loop, sample by sample
    "Live": ("jaxid.commands.live", "Live"),
    "follow": ("jaxid.commands.live", "follow"),
    "OnlineEstimate": ("jaxid.estimators.algebraic.online", "OnlineEstimate"),
    "RealTime": ("jaxid.estimators.recursive.real_time", "RealTime"),
    # effects and plants
    "EFFECTS": ("jaxid.effects", "EFFECTS"),
    "register_effect": ("jaxid.effects", "register"),
    # the physics alone, for JAX
    "make_plant": ("jaxid.build", "make_plant"),
    "State": ("jaxid.dynamics.rhs", "State"),
    "initial_state": ("jaxid.simulation.loops", "initial_state"),
    "vector_field": ("jaxid.dynamics.rhs", "vector_field"),
    "parameter_names": ("jaxid.estimators.fit", "parameter_names"),
    "fit": ("jaxid.estimators.fit", "fit"),
    "Fit": ("jaxid.estimators.fit", "Fit"),
    "BoundedLevenbergMarquardt": (
        "jaxid.estimators.common.levenberg_marquardt",
        "BoundedLevenbergMarquardt",
    ),
    "Effect": ("jaxid.model.effect", "Effect"),
    "Action": ("jaxid.model.effect", "Action"),
    "Signals": ("jaxid.model.effect", "Signals"),
    "parameter": ("jaxid.model.parameter", "parameter"),
    "PLANTS": ("jaxid.plants", "PLANTS"),
    "Plant": ("jaxid.model.plant", "Plant"),
    # machines and their simulation
    "build_machine": ("jaxid.build", "build_machine"),
    "Machine": ("jaxid.machine", "Machine"),
    "Sensor": ("jaxid.sensors.encoder", "Sensor"),
    "CONTROLLERS": ("jaxid.controllers", "CONTROLLERS"),
    "Controller": ("jaxid.controllers", "Controller"),
    "Tick": ("jaxid.controllers", "Tick"),
    "REFERENCES": ("jaxid.references", "REFERENCES"),
    "make_reference": ("jaxid.references", "make_reference"),
    "make_replay": ("jaxid.simulation.replay", "make_replay"),
    "Replay": ("jaxid.simulation.replay", "Replay"),
    "Numerics": ("jaxid.simulation.replay", "Numerics"),
    "open_loop": ("jaxid.simulation.loops", "open_loop"),
    "closed_loop": ("jaxid.simulation.loops", "closed_loop"),
    "Drive": ("jaxid.simulation.loops", "Drive"),
    "Trajectory": ("jaxid.simulation.loops", "Trajectory"),
    # estimators
    "METHODS": ("jaxid.estimators", "METHODS"),
    "register_method": ("jaxid.estimators", "register_method"),
    "register_reader": ("jaxid.logs.readers", "register_reader"),
    "Smoothing": ("jaxid.model.smoothing", "Smoothing"),
    "Scales": ("jaxid.model.effect", "Scales"),
    "base_parameters": ("jaxid.arms.base_parameters", "base_parameters"),
    "BaseParameters": ("jaxid.arms.base_parameters", "BaseParameters"),
    "base_parameters_by_rules": ("jaxid.arms.base_by_rules", "base_parameters_by_rules"),
    "inertial_regressor": ("jaxid.arms.base_parameters", "inertial_regressor"),
}
# A checker reads the imports above instead.
__all__ = ["__version__", *_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("jaxid")
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxid' has no attribute {name!r}")
    from importlib import import_module

    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
