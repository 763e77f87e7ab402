"""Docstrings and comments are in the words of the field; see `tests/wording.py`."""

import pytest

from tests.wording import LIMITS, MOST_WITHOUT_VERB, PACKAGE, Count, counted


@pytest.fixture(scope="module")
def count() -> Count:
    return counted(PACKAGE)


@pytest.mark.parametrize("word", LIMITS)
def test_few_words_that_make_an_engineer_stumble(count, word):
    assert count.words > 50_000
    assert count.rate(word) <= LIMITS[word]


def test_functions_begin_with_a_verb(count):
    assert count.functions > 1000
    assert count.share_without_verb <= MOST_WITHOUT_VERB, "\n".join(count.without_verb)


@pytest.mark.parametrize("folder", ["benchmarks", "experiments", "truth"])
def test_functions_beside_the_package_begin_with_a_verb(folder):
    count = counted(PACKAGE.parent / folder)
    assert count.functions > 50
    assert count.share_without_verb <= MOST_WITHOUT_VERB, "\n".join(count.without_verb)


def test_the_count_sees_docstrings_and_comments(tmp_path):
    path = tmp_path / "page.py"
    path.write_text('"""What it is."""\n\n\ndef f():\n    """Of what."""\n    return 1  # where\n')
    count = counted(path)
    assert (count.words, count.found["what"], count.found["where"]) == (6, 2, 1)
    assert [line.rpartition("f: ")[2] for line in count.without_verb] == ["Of what."]
