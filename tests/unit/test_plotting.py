"""Figures of renderings: what is in them, that all of it can be read, and the files they become."""

import itertools
import math
import struct
import sys
import xml.etree.ElementTree as ElementTree
from fractions import Fraction

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from marotte import plotting
from marotte.errors import MarotteError
from marotte.plotting import PlotError, moving, plot, save_figure
from marotte.puppet import Dof, Mood, Puppet
from marotte.rendering import Rendering
from marotte.score import Cue, Score
from marotte.spectrum import spectrum

LONG = "AN_ACTION_WITH_AN_EXTREMELY_LONG_NAME"
NAMES = ("SWAY", "A_DOF", "WHEEL", "STILL", "SLOW", "LAST")
SPANS = (0.3, 0.2, 0.8, 0.0, 0.1, 0.25)


def rendering_of(seconds=8, rate_hz=30, weights=("NOD", LONG)):
    """A rendering of six sines of some spans, the signal's being twice the base's, and of two weights."""
    puppet = Puppet(
        "pet",
        rate_hz,
        dofs={name: Dof(name, "relative" if name == "WHEEL" else "absolute") for name in NAMES},
        moods={"NERVOUS": Mood("NERVOUS", (2.5, 2, 1.4, 1, 1, 1, 1))},
    )
    frames = range(round(seconds * rate_hz))
    rendering = Rendering(puppet, report={"kind": "unix"})
    for name, span in zip(NAMES, SPANS, strict=True):
        sine = [span / 4 * math.sin(2 * math.pi * 2 * frame / rate_hz) for frame in frames]
        rendering.base[name] = [0.5 + value for value in sine]
        rendering.signal[name] = [0.5 + 2 * value for value in sine]
        rendering.motor[name] = [0.5 + 2 * value for value in [0, 0, *sine][: len(frames)]]
    for name in weights:
        rendering.weights[name] = [2.5 * frame / len(frames) for frame in frames]
    if weights:
        rendering.weights["SILENT"] = [0.0 for _ in frames]
    return rendering


SCORE = Score(
    (
        Cue(Fraction(4), mood="NERVOUS"),
        Cue(Fraction(0), "CALM", {"NOD": 2.0}),
        *(Cue(4 + Fraction(n, 20), weights={LONG: n / 4, f"{LONG}_{n}": 1.0, "X": 0.5}) for n in range(1, 8)),
        Cue(Fraction(8), "TOO_LATE"),
    )
)
BUSY = Score(tuple(Cue(Fraction(n, 10), "BUSY") for n in range(79)))
LEAST = 0.99 * math.sqrt(2 / 3)
"""What is left of a sine where the bins are so narrow that one of the Hann window's lines lies in the next one."""


def axes_titled(figure, title):
    (found,) = (axes for axes in figure.axes if axes.get_title(loc="left") == title)
    return found


def texts(figure):
    """All texts that are to be seen, drawn once, so that they have their places."""
    canvas = FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    found = [*figure.texts, *(text for legend in figure.legends for text in legend.get_texts())]
    for axes in figure.axes:
        for part in (axes, *axes.child_axes):
            found += [part.xaxis.label, part.yaxis.label, part.title, part._left_title, part._right_title, *part.texts]
            for axis, (low, high) in ((part.xaxis, part.get_xlim()), (part.yaxis, part.get_ylim())):
                ticks = axis.get_major_ticks() + axis.get_minor_ticks()
                found += [
                    label for tick in ticks if low <= tick.get_loc() <= high for label in (tick.label1, tick.label2)
                ]
    return [text for text in found if text.get_text().strip() and text.get_visible()], canvas.get_renderer()


def assert_legible(figure):
    """No text is small, cut off, or over another."""
    found, renderer = texts(figure)
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in found]
    assert len(boxes) > 20
    assert all(text.get_fontsize() >= 9 for text in found)
    page = figure.bbox
    for text, box in boxes:
        assert page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1, text
    for (one, box), (other, other_box) in itertools.combinations(boxes, 2):
        width = min(box.x1, other_box.x1) - max(box.x0, other_box.x0)
        height = min(box.y1, other_box.y1) - max(box.y0, other_box.y0)
        assert width < 0.5 or height < 0.5, f"{one!r} is over {other!r}"


def test_figure_has_base_signal_and_motor_of_each_dof_named():
    rendering = rendering_of()
    figure = plot(rendering, SCORE, ["WHEEL", "SWAY"])
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title for title in titles if title in NAMES] == ["WHEEL", "SWAY"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["base", "signal", "motor"]
    colours = [handle.get_color() for handle in legend.legend_handles]
    lines = axes_titled(figure, "WHEEL").lines
    for colour, taps in zip(colours, (rendering.base, rendering.signal, rendering.motor), strict=True):
        (line,) = (line for line in lines if line.get_color() == colour)
        assert list(line.get_xdata()) == rendering.time_s
        assert list(line.get_ydata()) == taps["WHEEL"]
    figure.draw_without_rendering()
    box = legend.get_window_extent()
    assert all(not box.overlaps(axes.get_window_extent()) for axes in figure.axes), "outside of the data"


def test_figure_marks_the_cues_within_it_and_lists_them():
    figure = plot(rendering_of(), SCORE, ["SWAY"])
    for title in ("SWAY", "weights (a full row is 2.49)"):
        marked = {line.get_xdata()[0] for line in axes_titled(figure, title).lines if len(set(line.get_xdata())) == 1}
        assert marked == {0.0, 4.0, *(4 + n / 20 for n in range(1, 8))}
    written = [text.get_text() for text in figure.texts]
    assert all(written.count(str(number)) == 2 for number in range(1, 10)), "above the time and in the list"
    assert "0 s  CALM, NOD 2" in written
    assert "4 s  mood NERVOUS, gains 2.5 2 1.4 1 1 1 1" in written
    assert not any("TOO_LATE" in text for text in written)


@pytest.mark.parametrize(("actions", "is_beside"), [(2, False), (20, True)])
def test_figure_lists_the_cues_beside_the_weights_or_in_columns_below_them(actions, is_beside):
    rendering = rendering_of(weights=[f"A{number}" for number in range(actions)])
    figure = plot(rendering, Score(SCORE.cues[:4]), ["SWAY"])
    box = axes_titled(figure, "weights (a full row is 2.49)").get_position()
    (line,) = (text for text in figure.texts if text.get_text() == "0 s  CALM, NOD 2")
    left, top = line.get_position()
    assert (left > box.x1 and top > box.y0) == is_beside
    assert (top < box.y0) == (not is_beside)


def test_figure_has_spectra_with_the_bands_marked():
    figure = plot(rendering_of(), None, ["SWAY"])
    (axes,) = (axes for axes in figure.axes if axes.get_xscale() == "log")
    (top,) = axes.child_axes
    texts(figure)
    assert [label.get_text() for label in top.get_xticklabels()] == ["15", "4.2", "2.0", "0.99", "0.49", "0.25", "0.12"]
    base, signal = (line for line in axes.lines if len(set(line.get_xdata())) > 1)
    for line, amplitude in ((base, 0.075), (signal, 0.15)):
        place = max(range(len(line.get_ydata())), key=lambda place: line.get_ydata()[place])
        assert line.get_xdata()[place] == pytest.approx(2, rel=0.06)
        assert LEAST * amplitude <= line.get_ydata()[place] <= 1.01 * amplitude


def test_figure_has_a_row_for_each_action_that_plays():
    axes = axes_titled(plot(rendering_of()), "weights (a full row is 2.49)")
    assert [label.get_text() for label in axes.get_yticklabels()] == ["NOD", "AN_ACTION_WITH_AN_EXTRE…"]
    assert len(axes.collections) == 2


def test_figure_without_weights_has_its_time_below_the_last_dof():
    figure = plot(rendering_of(weights=()), SCORE, ["SWAY", "SLOW"])
    labels = {axes.get_title(loc="left"): axes.get_xlabel() for axes in figure.axes}
    assert (labels["SWAY"], labels["SLOW"]) == ("", "time (s)")
    assert_legible(figure)


def test_figure_shows_the_dofs_that_move_most_unless_some_are_named():
    rendering = rendering_of()
    assert moving(rendering) == ["SWAY", "A_DOF", "WHEEL", "LAST"]
    titles = [axes.get_title(loc="left") for axes in plot(rendering).figure.axes]
    assert [title for title in titles if title in NAMES] == moving(rendering)
    with pytest.raises(KeyError, match="SWING"):
        plot(rendering, SCORE, ["SWAY", "SWING"])


@pytest.mark.parametrize(("seconds", "score"), [(1 / 30, None), (0.1, SCORE), (8, SCORE), (8, BUSY), (4000, SCORE)])
def test_figure_can_be_read_whatever_it_shows(seconds, score):
    assert_legible(plot(rendering_of(seconds), score, NAMES))


@pytest.mark.parametrize("rate_hz", [10, 60])
def test_figure_can_be_read_at_any_frame_rate(rate_hz):
    assert_legible(plot(rendering_of(4, rate_hz), SCORE))


@pytest.mark.parametrize(("frequency_hz", "amplitude"), [(0.5, 0.5), (2.0, 0.25), (4.2, 0.01), (9.87, 0.4)])
def test_spectrum_of_a_sine_is_its_amplitude_at_its_frequency(frequency_hz, amplitude):
    values = [0.3 + amplitude * math.sin(2 * math.pi * frequency_hz * frame / 30) for frame in range(600)]
    frequencies, amplitudes = spectrum(values, 30)
    most = max(amplitudes)
    assert LEAST * amplitude <= most <= 1.01 * amplitude
    assert frequencies[amplitudes.index(most)] == pytest.approx(frequency_hz, rel=0.08)
    assert all(
        found < 0.02 * amplitude for at, found in zip(frequencies, amplitudes, strict=True) if at > 2 * frequency_hz
    )


def test_spectrum_has_the_energy_of_the_motion():
    values = [math.sin(0.1 * frame) + 0.5 * math.cos(1.1 * frame) + 0.2 * math.sin(2.5 * frame) for frame in range(900)]
    _, amplitudes = spectrum(values, 30)
    assert sum(amplitude**2 / 2 for amplitude in amplitudes) == pytest.approx((1 + 0.25 + 0.04) / 2, rel=0.02)


@pytest.mark.parametrize("values", [[0.5], [0.5] * 2, [0.5] * 100])
def test_spectrum_of_what_stands_still_is_nothing(values):
    assert all(amplitude < 1e-12 for amplitude in spectrum(values, 30)[1])


def test_figure_becomes_a_png(tmp_path):
    figure = plot(rendering_of(), SCORE)
    path = tmp_path / "pet.PNG"
    save_figure(figure, path)
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert (width, height) == pytest.approx([150 * inches for inches in figure.get_size_inches()], abs=1)


def test_figure_becomes_the_same_svg_each_time(tmp_path):
    for name in ("one.svg", "two.svg"):
        save_figure(plot(rendering_of(), SCORE), tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    root = ElementTree.parse(tmp_path / "one.svg").getroot()
    assert root.tag.endswith("svg") and len(root.findall(".//{http://www.w3.org/2000/svg}path")) > 50


def test_figure_that_cannot_be_written_says_so(tmp_path):
    with pytest.raises(MarotteError, match="cannot be written: no such file or directory"):
        save_figure(plot(rendering_of()), tmp_path / "absent" / "pet.png")


def test_figure_without_matplotlib_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert not plotting.is_possible()
    with pytest.raises(PlotError, match="pip install 'matplotlib"):
        plot(rendering_of())
