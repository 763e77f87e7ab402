"""The file of outcomes of slow tests keeps what other commits left, and skips what this one has done."""

import json

from tests.support.outcomes import Outcomes, stored


def test_rows_of_other_commits_stay_and_are_run_again(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.support.outcomes._commit", lambda: "now")
    path = tmp_path / "outcomes.jsonl"
    rows = [
        {"test": "b", "outcome": "failed", "commit": "before"},
        {"test": "a", "outcome": "passed", "commit": "before"},
        {"test": "b", "outcome": "passed", "commit": "now"},
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    outcomes = Outcomes(path)
    outcomes.tidy()
    assert outcomes.seen == {"b"}
    assert stored(path) == {"a": rows[1], "b": rows[2]}
    assert len(path.read_text().splitlines()) == 2
