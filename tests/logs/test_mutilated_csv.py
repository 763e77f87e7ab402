"""200 mutilated CSV files: each is refused in one line, or read with exactly the numbers that stand in it."""

import csv
import io

import numpy as np
import pytest

from jaxid.cli import main
from jaxid.errors import InputError
from jaxid.logs.log import read_log
from tests.support.cli_setup import place, recorded

COLUMNS = {"time": "t", "position": "q", "force": "u", "reference": "ref"}
ROWS = 150
WORDS = ["nan", "NaN", "inf", "-Infinity", "#N/A", "NULL", "--", "", " ", "true", "1e400", "-9e999", "0x1p3"]
ODD = ["1_000", "1e", "١٢", "1,5", "1.2.3", "+-1", '"', "'1'", "1d3", "1+2j", "½", "1e-400", " 2.5 ", "=A1"]


def cells_of(lines):
    return [line.split(",") for line in lines]


def with_cell(rng, lines, text):
    """Put a text into one cell below the header."""
    rows = cells_of(lines)
    rows[int(rng.integers(1, len(rows)))][int(rng.integers(len(rows[0])))] = text
    return "\n".join(map(",".join, rows))


def cut(rng, lines):
    text = "\n".join(lines)
    return text[: int(rng.integers(1, len(text)))]


def flipped(rng, lines):
    raw = bytearray("\n".join(lines).encode())
    for k in rng.integers(len(raw), size=int(rng.integers(1, 6))):
        raw[k] = int(rng.integers(256))
    return bytes(raw)


def inserted(rng, lines, what):
    raw = "\n".join(lines).encode()
    k = int(rng.integers(len(raw)))
    return raw[:k] + what + raw[k:]


def ragged(rng, lines):
    rows = cells_of(lines)
    row = rows[int(rng.integers(len(rows)))]
    if rng.random() < 0.5:
        del row[int(rng.integers(len(row)))]
    else:
        row.insert(int(rng.integers(len(row))), repr(rng.standard_normal()))
    return "\n".join(map(",".join, rows))


def other_delimiter(rng, lines):
    new = str(rng.choice([";", "\t", "|", " ", ":"]))
    first = int(rng.integers(len(lines)))
    return "\n".join([*lines[:first], *(line.replace(",", new) for line in lines[first:])])


def header_again(rng, lines):
    names = lines[0].split(",")
    names[int(rng.integers(len(names)))] = str(rng.choice(names))
    return "\n".join([",".join(names), *lines[1:]])


def reordered(rng, lines):
    k = int(rng.integers(1, len(lines) - 1))
    return "\n".join([*lines[:k], lines[k + 1], lines[k], *lines[k + 2 :]])


def repeated(rng, lines):
    k = int(rng.integers(1, len(lines)))
    return "\n".join([*lines[:k], lines[k], *lines[k:]])


def noise(rng, lines):
    return rng.integers(256, size=int(rng.integers(1, 5000)), dtype=np.uint8).tobytes()


MUTATIONS = {
    "cut": cut,
    "flipped bytes": flipped,
    "NUL": lambda rng, lines: inserted(rng, lines, b"\0"),
    "a control character": lambda rng, lines: inserted(rng, lines, bytes([int(rng.integers(1, 32))])),
    "a quote": lambda rng, lines: inserted(rng, lines, b'"'),
    "a line separator": lambda rng, lines: inserted(rng, lines, "\u2028".encode()),
    "half of UTF-16": lambda rng, lines: "\n".join(lines).encode("utf-16")[: int(rng.integers(1, 9999))],
    "a word": lambda rng, lines: with_cell(rng, lines, str(rng.choice(WORDS))),
    "an odd number": lambda rng, lines: with_cell(rng, lines, str(rng.choice(ODD))),
    "a huge number": lambda rng, lines: with_cell(rng, lines, "9" * int(rng.integers(300, 500))),
    "a long cell": lambda rng, lines: with_cell(rng, lines, "x" * 200_000),
    "ragged": ragged,
    "another delimiter": other_delimiter,
    "decimal commas": lambda rng, lines: "\n".join(lines).replace(".", ","),
    "a header twice": header_again,
    "a long header": lambda rng, lines: "\n".join(["t,q,u,ref," + "x" * 200_000, *lines[1:]]),
    "no header": lambda rng, lines: "\n".join(lines[1:]),
    "rows in another order": reordered,
    "a row twice": repeated,
    "garbage": noise,
    "nothing": lambda rng, lines: str(rng.choice(["", "\n", " \n\t\n", "#", ",,,", lines[0], "\ufeff"])),
    "one line": lambda rng, lines: " ".join(lines),
    "comments": lambda rng, lines: "\n".join(line[:9] + "#" + line[9:] for line in lines),
}


def standing_in(raw: bytes, names) -> np.ndarray:
    """Read the numbers as Python's own parser does: nothing is shared with the reader."""
    text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", errors="replace")
    lines = [line.split("#")[0] for line in text.splitlines()]
    lines = [line for line in lines if line.strip()]
    delimiter = max(";\t,| ", key=lines[0].count)
    rows = [
        [cell.strip() for cell in row]
        for row in csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter)
    ]
    index = [rows[0].index(name) for name in names]
    # An empty cell is no reading.
    return np.array([[float(row[k] or "nan") for k in index] for row in rows[1:]])


def without_doubles(written: np.ndarray) -> np.ndarray:
    """Return the rows without those that repeat the time of the row before."""
    return written[np.concatenate([[True], np.diff(written[:, 0]) != 0])]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("in")
    return place(folder, {name: values[:ROWS] for name, values in recorded().items()})


@pytest.mark.parametrize("seed", range(10))
def test_twenty_files(files, tmp_path, capsys, seed):
    case, sound = files
    lines = sound.read_text().splitlines()
    refused = 0
    for k in range(20):
        name = list(MUTATIONS)[(20 * seed + k) % len(MUTATIONS)]
        content = MUTATIONS[name](np.random.default_rng([seed, k]), lines)
        path = tmp_path / f"{k}.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        try:
            log = read_log(path, COLUMNS)
        except InputError:
            refused += 1
            assert main(["check", str(case), str(path), "-o", str(tmp_path / "out")]) == 2, name
            out, err = capsys.readouterr()
            assert out == "", name
            assert err.startswith("jaxid: "), name
            assert err.count("\n") == 1, name
            assert len(err) < 1000, name
        else:
            written = standing_in(path.read_bytes(), COLUMNS.values())
            read = np.column_stack([log.position, log.force, log.reference])
            written = without_doubles(written)
            missing = np.isnan(written).any(axis=1)
            # Missing readings at the ends are cut off; others are interpolated, at the times of the others.
            assert len(read) >= len(written) - missing.sum(), name
            written = written[np.abs(written[:, :1] - log.time).argmin(axis=0)]
            here, rounding = ~np.isnan(written[:, 1:]), 1e-12 if missing.any() else 0
            np.testing.assert_allclose(read[here], written[:, 1:][here], rtol=0, atol=rounding, err_msg=name)
            # Rounding of the time stamps is removed.
            np.testing.assert_allclose(log.time, written[:, 0], rtol=0, atol=1e-12, err_msg=name)
    assert refused >= 10
    assert not (tmp_path / "out").exists()


def test_a_folder_and_a_file_that_cannot_be_read(files, tmp_path, capsys):
    case, _ = files
    (tmp_path / "folder.csv").mkdir()
    # Of the process itself: reading its first page fails for everyone.
    (tmp_path / "memory.csv").symlink_to("/proc/self/mem")
    (tmp_path / "null.csv").symlink_to("/dev/null")
    (tmp_path / "nowhere.csv").symlink_to(tmp_path / "gone")
    told = ["is not a file", "is empty", "is not a file", "no such file"]
    for name, words in zip(["folder", "memory", "null", "nowhere"], told, strict=True):
        assert main(["check", str(case), str(tmp_path / f"{name}.csv")]) == 2
        err = capsys.readouterr().err
        assert f"{name}.csv: {words}" in err
        assert err.count("\n") == 1
    assert main(["check", str(case), str(tmp_path / ("x" * 300 + ".csv"))]) == 2
    assert capsys.readouterr().err.count("\n") == 1
