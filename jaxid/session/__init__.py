"""A case and its logs, opened, checked and prepared: the start of every command."""

from jaxid.session.opened import Logs as Logs
from jaxid.session.opened import OpenedLog as OpenedLog
from jaxid.session.opened import Session as Session
from jaxid.session.opening import open_another as open_another
from jaxid.session.opening import open_session as open_session
from jaxid.session.opening import session_around as session_around
from jaxid.session.opening import session_around_several as session_around_several
from jaxid.session.preparing import enough as enough
