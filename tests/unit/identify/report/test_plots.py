"""Interactive plots: their script runs, needs nothing else, and draws what was measured."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import armident.identify.report.plots as plots_module
from armident.identify.report.plots import Plot, Series, kept_points, plots_html

SCRIPT = Path(plots_module.__file__).parent / "templates" / "plots.js"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="needs Node.js, which runs the script of the page")

PAGE = """
const events = {};
function element(tag) {
  return {
    tag, children: [], style: {setProperty() {}}, clientWidth: 500, listeners: {}, textContent: "",
    appendChild(child) { this.children.push(child); }, setAttribute() {},
    addEventListener(name, act) { this.listeners[name] = act; },
    getBoundingClientRect() { return {left: 0}; },
    getContext() { return new Proxy({}, {get: (pen, key) => key in pen ? pen[key] : (...a) => calls.push([key, ...a]),
                                         set: (pen, key, value) => { pen[key] = value; return true; }}); },
  };
}
const calls = [];
const roots = groups.map((content) => {
  const root = element("div");
  root.querySelector = () => ({textContent: content});
  return root;
});
global.document = {
  createElement: element,
  querySelectorAll: (selector) => selector === ".plots" ? roots : [],
};
global.window = {devicePixelRatio: 1, addEventListener() {}};
"""


def node(code: str, *groups: str) -> object:
    """Output of the code, after the script of the plots, with some groups of plots in the page."""
    assert NODE is not None
    program = f"const groups = {json.dumps(groups)};{PAGE}const p = require({json.dumps(str(SCRIPT))});{code}"
    done = subprocess.run([NODE, "-e", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def content(html: str) -> str:
    found = re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    assert found is not None
    return found[1]


def torque() -> Plot:
    t = np.linspace(0.0, 10.0, 1001)
    measured = np.sin(t)
    measured[500] = np.nan
    curves = (Series("measured", measured, "#000"), Series("model", 0.5 * np.sin(t), "#f00"))
    return Plot("joint_1", "N m", t, curves, limits=(("limit", 3.0),))


def test_a_peak_survives_the_thinning_of_a_long_curve() -> None:
    y = np.random.default_rng(0).normal(size=(2, 200_000))
    y[0, 123_456], y[1, 7], y[0, 50_000] = 99.0, -99.0, np.nan
    kept = kept_points(list(y), most=2000)
    assert kept.size <= 2001
    assert {0, 7, 50_000, 123_456, 199_999} <= set(kept.tolist())


def test_a_name_cannot_end_the_script_of_its_data() -> None:
    html = plots_html([Plot("</script><b>", "N m", np.arange(2.0), (Series("<i>", np.zeros(2), "#000"),))])
    assert html.count("</script>") == 1
    assert json.loads(content(html))[0]["title"] == "</script><b>"


def test_the_script_refers_to_nothing_outside() -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    assert not re.search(r"https?:|import\s|fetch\(|XMLHttpRequest|\bsrc\b", text)


@needs_node
def test_ticks_are_round_and_inside() -> None:
    found = node("console.log(JSON.stringify([p.ticks(-3.2, 7.9, 5), p.ticks(0, 0.0031, 4), p.ticks(1, 1, 4)]))")
    assert found == [[-2, 0, 2, 4, 6], [0, 0.001, 0.002, 0.003], [1]]


@needs_node
def test_a_signed_logarithmic_axis_has_ticks_near_zero_and_far_from_it() -> None:
    found = node("console.log(JSON.stringify(p.signedTicks(-3, 84).sort((a, b) => a - b)))")
    assert found == [-2, -1, 0, 1, 2, 5, 10, 20, 50]


@needs_node
def test_a_difference_of_eighty_hides_none_of_one() -> None:
    half = np.full(2, 0.5)
    plot = Plot("joint", "std", np.arange(2.0), (Series("now", np.array([1.0, 80.0]), "#000", 1.0, half),),
                names=("a", "b"), signed_log=True)  # fmt: skip
    marks = node(
        "p.build(); console.log(JSON.stringify(calls.filter((c) => c[0] === 'fillRect').map((c) => c[2])))",
        content(str(plots_html([plot]))),
    )
    assert isinstance(marks, list)
    near, far = marks
    assert 15 < near - far < 140  # of 162 pixels: with a linear axis the first one lies 2 above the bottom
    assert 190 - 22 - near > 15


@needs_node
def test_the_page_draws_reads_and_zooms() -> None:
    code = """
    const group = p.build()[0];
    const drawn = calls.filter((call) => call[0] === "lineTo").length;
    const plot = group.plots[0];
    const canvas = roots[0].children[0].children[1];
    canvas.listeners.pointermove({clientX: 58 + plot.width / 4});
    const read = plot.readout.textContent;
    canvas.listeners.pointerdown({clientX: 58, pointerId: 1});
    canvas.listeners.pointermove({clientX: 58 + plot.width / 4});
    canvas.listeners.pointerup({clientX: 58 + plot.width / 4});
    const zoomed = group.range;
    calls.length = 0;
    group.draw();
    const fewer = calls.filter((call) => call[0] === "lineTo").length;
    canvas.listeners.dblclick({});
    console.log(JSON.stringify({drawn, read, zoomed, fewer, whole: group.range}));
    """
    found = node(code, content(plots_html([torque()])))
    assert isinstance(found, dict)
    assert found["drawn"] > 2 * 998
    assert found["read"] == f"2.5 s · measured {np.sin(2.5):.4g} N m · model {0.5 * np.sin(2.5):.4g} N m"
    assert found["zoomed"] == [0, 2.5]
    assert found["fewer"] < found["drawn"] / 3
    assert found["whole"] == [0, 10]


@needs_node
def test_a_gap_in_the_data_is_a_gap_in_the_curve() -> None:
    code = """
    p.build();
    console.log(JSON.stringify(calls.filter((call) => call[0] === "moveTo" && call[1] > 60 && call[1] < 480).length));
    """
    plain = torque()
    whole = Plot(plain.title, plain.unit, plain.x, (plain.series[1],), ())
    broken = Plot(plain.title, plain.unit, plain.x, (plain.series[0],), ())
    one, two = (node(code, content(plots_html([each]))) for each in (whole, broken))
    assert isinstance(one, int)
    assert two == one + 1


@needs_node
def test_points_with_intervals_have_names_on_the_axis_and_are_read_in_words() -> None:
    code = """
    const plot = p.build()[0].plots[0];
    const named = calls.filter((call) => call[0] === "fillText").map((call) => call[1]);
    const squares = calls.filter((call) => call[0] === "fillRect").length;
    roots[0].children[0].children[1].listeners.pointermove({clientX: 58 + plot.width});
    console.log(JSON.stringify({named, squares, read: plot.readout.textContent,
                                extent: p.extent(plot.data, [true], 0, 2)}));
    """
    series = Series("now", np.array([1.0, np.nan, 3.0]), "#000", half=np.array([0.5, 0.5, 1.0]))
    plot = Plot("joint_1", "std", np.arange(3.0), (series,), names=("zz1", "fv1", "fc1"), readings=("a", "b", "c"))
    found = node(code, content(plots_html([plot])))
    assert isinstance(found, dict)
    assert {"zz1", "fv1", "fc1"} <= set(found["named"])
    assert found["squares"] == 2
    assert found["read"] == "c"
    assert found["extent"] == pytest.approx([0.5 - 0.06 * 3.5, 4 + 0.06 * 3.5])
