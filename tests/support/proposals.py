"""The state of a search that has just found effects that its log cannot separate."""

from pathlib import Path

import numpy as np

from jaxid.commands.discover import start_search
from jaxid.discovery import candidates as cand
from jaxid.discovery.score import Score
from jaxid.discovery.search import Model, Search
from jaxid.discovery.separating.propose import Proposal, propose
from jaxid.session import open_session
from tests.support.axis_log import log_of
from truth.axis.ambiguous import started
from truth.axis.cases import Declared, case_text, write_case
from truth.axis.machines import Setup


def proposed_for(
    setup: Setup, declared: Declared, kinds: tuple[str, str], folder: Path, *, more: str = "", **options
) -> Proposal:
    """The experiment for a pair of effects, without the search that would find the pair."""
    case = write_case(folder, case_text(setup, declared, **options) + more)
    session = open_session(case, log_of(setup, initial_position=started(setup)), align_hold=True)
    _, search = start_search(session)
    own, rival = (next(c for c in search.superset.candidates if c.kind == kind) for kind in kinds)
    search.model = Model((own,), _fitted(search, own))
    score = Score(rival, 0, rival.starts[0], 0.0, theta=_fitted(search, rival))
    return propose(session, search, own, score)


def _fitted(search: Search, c: cand.Candidate) -> np.ndarray:
    theta = search.superset.neutral.copy()
    # A tenth of what would explain all of the force.
    theta[c.index] = np.where(c.amplitude, 0.1, 1.0) * c.starts[0]
    active = np.concatenate([search.superset.base, c.index]).astype(int)
    return cand.refine(search.superset, search.samples, theta, active)[0]
