"""The rooms of jaxid in the order of imports: each may import from those before it, and from itself.

A newcomer reads the package in this order. A room is a folder or a module directly under `jaxid/`.
"""

ROOMS = {
    "arrays": "the array type of annotations, and the library that computes with arrays",
    "errors": "one-line errors with a hint",
    "names": "methods, outputs, solvers and other names that users write",
    "schema": "readers of the keys of a case, and their JSON Schema",
    "settings": "tables of a case as dataclasses: keys, defaults, documentation",
    "_platform": "float64 and XLA's loop option",
    "_cache": "compiled code on disk",
    "files": "writing outputs whole or not at all",
    "_progress": "progress of commands on a terminal, with the time left",
    "numerics": "smooth functions, filters, precision, batched calls; no machine",
    "model": "parameters, effects, and the balance of a plant: one statement of the physics",
    "dynamics": "readings of the balance: right-hand side, dry friction, residuals",
    "effects": "physical effects, a family a file",
    "plants": "machines, one a file",
    "controllers": "control laws, a family a file",
    "logs": "reading, checking and filtering logs",
    "references": "reference trajectories, one a file",
    "sensors": "encoders and inertial sensors",
    "arms": "inertial parameters of linkages",
    "case": "case files",
    "machine": "a plant with its actuator, controller and sensors",
    "build": "a machine, built from its case",
    "first_case": "a first case from a raw log: columns, units, rough guesses",
    "own_values": "values that differ between logs that are fitted together",
    "simulation": "loops, solvers, and replays of a log",
    "consistency": "a prepared log held against its case: sign, noise, hold, control law",
    "session": "a case with its logs, opened and checked",
    "scene": "a case set up for simulation",
    "gap": "the gap between simulation and measurement",
    "estimators": "estimators, one a file or folder",
    "steady": "tables of steady speeds and forces: opened and fitted",
    "experiment_design": "experiments that identify the unknowns best",
    "discovery": "the search for missing effects",
    "comparison": "the search for what differs between logs",
    "studies": "Monte-Carlo studies",
    "results": "results as JSON, text and report",
    "export": "results in the formats of other programs",
    "commands": "the commands, one a file",
    "demo": "the demonstration and its log",
    "cli": "the command line",
}

# Imports that run against the order, each with its reason. None may be added without one.
AGAINST = {
    ("discovery", "results"): "a result prints and saves itself",
    ("studies", "commands"): "a study of `discover` runs it",
    ("comparison", "results"): "a result prints and saves itself",
    ("studies", "results"): "a result prints and saves itself",
    ("results", "commands"): "types only",
    ("estimators", "steady"): "a steady table has a fit of its own",
    ("session", "steady"): "a steady table is opened in a way of its own",
    ("build", "estimators"): "the adaptive controller carries an estimator",
}
