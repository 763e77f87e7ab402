"""The effects that can be added to a plant, by the names of the case file.

To add one: write its class in the file of its family, with `title`, `formula`, `met` and `part` for the
reports, decorate it with `register`, and give it a row in `truth/axis/effect_forces.py` and in
`truth/axis/hidden_effects.py`; see docs/adding_an_effect.md. Then run `python -m jaxid.case.kinds`. A
user-defined effect needs only the class, and a case that names its file.
"""

from jaxid.effects.registry import EFFECTS as EFFECTS
from jaxid.effects.registry import register as register

from jaxid.effects import actuator as actuator  # isort: skip
from jaxid.effects import command as command  # isort: skip
from jaxid.effects import coupling as coupling  # isort: skip
from jaxid.effects import friction as friction  # isort: skip
from jaxid.effects import hysteresis as hysteresis  # isort: skip
from jaxid.effects import inertia as inertia  # isort: skip
from jaxid.effects import position as position  # isort: skip
