"""Charts of a report: the lines of a figure as data, and back."""

import base64
import json
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxid.results.report import zoom


def unpacked(packed: dict) -> np.ndarray:
    """The numbers as the script of the page reads them."""
    whole = np.frombuffer(base64.b64decode(packed["points"]), "<u2").astype(float)
    whole[whole == 65535] = np.nan
    return packed["low"] + (packed["high"] - packed["low"]) * whole / 65534


def drawn():
    figure = Figure()
    top, below = figure.subplots(2, 1)
    x = np.linspace(-3.0, 5.0, 500)
    y = np.sin(x)
    y[200:210] = np.nan
    top.plot(x, y, color="#0072b2", label="simulated")
    top.plot(x[:3], x[:3], ".", label="_child")
    top.axhline(1.0)
    top.fill_between(x[:5], x[:5] - 1, x[:5] + 1, color="red")
    top.set_ylabel("position\n[m]")
    top.set_title("before", loc="left")
    below.plot([1.0, np.nan, 3.0, 4.0], [1.0, np.nan, 2.0, 2.0], "--")
    below.set_xlabel("time [s]")
    return figure, x, y


def test_lines_keep_places_values_gaps_and_looks():
    figure, x, y = drawn()
    top, below = json.loads(zoom.charts_of(figure))
    assert (top["x"], top["y"]) == ("time [s]", "before: position [m]")
    low, high, line, dots = top["series"]
    np.testing.assert_allclose(unpacked(line["at"]), x, atol=8.0 / 65534)
    np.testing.assert_allclose(unpacked(line["value"]), y, atol=2.0 / 65534)
    assert (line["label"], line["color"], line["dots"], line["dashed"]) == (
        "simulated",
        "#0072b2",
        False,
        False,
    )
    assert (dots["label"], dots["dots"]) == ("", True)
    for edge, off in ((low, -1), (high, 1)):
        np.testing.assert_allclose(unpacked(edge["at"]), x[:5], atol=1e-4)
        np.testing.assert_allclose(unpacked(edge["value"]), x[:5] + off, atol=1e-4)
    # A gap without a place lies between its neighbours.
    [short] = below["series"]
    assert short["dashed"]
    np.testing.assert_allclose(unpacked(short["at"]), [1, 2, 3, 4], atol=1e-4)
    assert list(np.isnan(unpacked(short["value"]))) == [False, True, False, False]


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_bars_and_logarithms_have_no_chart(scale):
    figure = Figure()
    ax = figure.subplots()
    ax.plot([1, 2, 3], [1, 2, 3])
    ax.set_yscale(scale)
    if scale == "linear":
        ax.bar([1, 2], [1, 2])
    assert zoom.charts_of(figure) == ""


def test_the_script_ends_no_element_and_asks_for_nothing():
    code = zoom.script()
    assert "</script" not in code.lower()
    assert not re.search(r"fetch\(|XMLHttpRequest|WebSocket|import\(|innerHTML|eval\(", code)
