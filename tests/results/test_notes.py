"""Notes that differ in place and numbers only are stated once."""

from jaxid.results.notes import grouped_notes

STEPS = (
    "{file}, position of joint {joint}: the position is quantised in steps of {step}: {levels} levels in all"
)


def test_notes_of_many_logs_and_joints_are_one():
    notes = [
        STEPS.format(file=f"/data/logs/{name}.csv", joint=joint, step=0.00153, levels=100 + joint)
        for name in ("sines", "steps.of_2")
        for joint in range(1, 7)
    ]
    other = "the hold of the force was chosen from the log"
    assert grouped_notes([*notes, other]) == [f"{notes[0]} (11 more notes of this kind)", other]


def test_few_of_a_kind_and_other_effects_stay():
    few = ["joint 1: the logs differ by 3.1 nats", "joint 2: the logs differ by 7 nats"]
    rejected = [
        f"{kind}[1] was not added, at 36 nats" for kind in ("hysteresis", "cogging", "backlash", "lag")
    ]
    assert grouped_notes([*few, *rejected]) == [*few, *rejected]
    assert grouped_notes([]) == []
