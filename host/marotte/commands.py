"""What the commands of the command line do, given their arguments."""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from marotte import ports
from marotte.calibration import Calibration, CalibrationError
from marotte.capture import STANDARD_INPUT, CapturingCarrier, read_capture
from marotte.emulated import connected, open_mcu, without_feedback
from marotte.errors import MarotteError
from marotte.files import Files, Watch
from marotte.link import Carrier, LinkError, VirtualCarrier
from marotte.link_tools import dump, replay, stats, stats_text
from marotte.outputs import Output
from marotte.ports import SerialCarrier
from marotte.pulses import PulseSummary, measure
from marotte.puppet import Puppet
from marotte.session import Session
from marotte.signals import interruptible
from marotte.tables import build_tables
from marotte.view import View
from marotte.wiring import Robot

if TYPE_CHECKING:
    from marotte.rendering import Rendering

PUMP_US = 20_000
GONE = {"rest": "goes to rest", "relax": "goes to rest and lets go"}
"""What a puppet does when the host is gone, by its `when_silent`; with any other it goes on."""


def render_to_csv(files: Files, seconds: Fraction, mcu: str, out: Path, console: Console) -> None:
    """Render into a file, with a progress bar, and tell about the run. Raises MarotteError."""
    _require_writable(out)
    rendering = _render(files, seconds, mcu, console)
    rendering.write_csv(out)
    print(f"{out}: {len(rendering.frames)} frames, {len(files.puppet.dofs)} DOFs")
    for key, value in rendering.report.items():
        print(f"  {key}: {value:,}" if isinstance(value, int) else f"  {key}: {value}")
    if rendering.status["clipped"]:
        print(f"  {clipping(rendering.status)}")


def plot_to_file(
    files: Files, seconds: Fraction, mcu: str, dofs: Sequence[str] | None, out: Path, console: Console
) -> None:
    """Render, with a progress bar, and draw it into a PNG or SVG file. Raises MarotteError."""
    from marotte.plotting import plot, save_figure

    _require_writable(out)
    rendering = _render(files, seconds, mcu, console, weights=True)
    with console.status("drawing") if console.is_terminal else contextlib.nullcontext():
        save_figure(plot(rendering, files.score, dofs), out)
    print(f"{out}: {len(rendering.frames)} frames")
    if rendering.status["clipped"]:
        print(f"  {clipping(rendering.status)}")


def _render(files: Files, seconds: Fraction, mcu: str, console: Console, weights: bool = False) -> Rendering:
    from marotte.rendering import frame_count, render

    bar = Progress(
        TextColumn("rendering on {task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task(mcu, total=frame_count(seconds, files.puppet.frame_rate_hz))
        return render(
            files.puppet,
            files.score,
            seconds,
            mcu,
            files.robot,
            progress=lambda done, of: bar.update(task, completed=done, total=of),
            weights=weights,
        )


def clipping(status: dict[str, int]) -> str:
    """Return how often signal processing went out of the range of a DOF, as a status says."""
    return f"{status['clipped']:,} values clipped by signal processing: the gains are high for where the motion is"


@dataclass(frozen=True)
class RunOptions:
    """How to play live."""

    arm: bool = False
    seconds: Fraction | None = None
    no_view: bool = False
    watch: Watch | None = None
    capture: Path | None = None
    """The file that what goes over the link is written to."""


def run_on_port(files: Files, port: str, options: RunOptions, console: Console) -> bool:
    """Play live on a port; return whether the user ended it. Raises MarotteError."""
    if options.capture:
        _require_writable(options.capture)
    carrier = _captured(SerialCarrier(port), options.capture)
    try:
        return _perform(files, carrier, port, options, console)
    finally:
        carrier.close()


def run_on_mcu(files: Files, mcu: str, options: RunOptions, console: Console) -> bool:
    """Play live on an emulated MCU and show the pulses of its pins; return whether the user ended it. Raises MarotteError."""
    from marotte.mcu.serve import serve

    if options.capture:
        _require_writable(options.capture)
    with contextlib.ExitStack() as stack:
        virtual = stack.enter_context(open_mcu(mcu))
        if files.robot:
            files = replace(files, robot=connected(virtual, files.robot))
        if options.watch:
            options.watch.adapt = without_feedback
        live = stack.enter_context(serve(virtual))
        carrier = _captured(SerialCarrier(live.url), options.capture)
        try:
            interrupted = _perform(files, carrier, f"emulated {mcu} at {live.url}", options, console)
        finally:
            carrier.close()
        has_pins = files.robot and any(output.drive.pulse_pin for output in files.robot.outputs.values())
        if files.robot and options.arm and has_pins:
            live.stop()
            _print_pulses(measure(virtual, files.robot), console)
    return interrupted


@dataclass(frozen=True)
class Keeping:
    """What an MCU is to keep on its flash."""

    puppet: Puppet
    robot: Robot
    behaviour: str | None = None


def save(what: Keeping | None, where: Where, console: Console) -> None:
    """Let an MCU keep a puppet, or with None forget the one that it keeps. Raises MarotteError."""
    with _carrier(where) as (carrier, name):
        try:
            _save(what, Session(carrier), name, console)
        except LinkError as error:
            raise LinkError(f"{name}: {error}") from error


def _save(what: Keeping | None, session: Session, name: str, console: Console) -> None:
    session.open()
    session.kill()  # flash is written only while the outputs are off and nothing moves
    session.stop()
    if what is None:
        session.erase_saved()
        _say(console, f"the flash of {name} keeps no puppet any more")
        return
    tables = build_tables(what.puppet, what.robot)
    session.upload(tables)  # so that it is checked now, and not when the MCU is switched on
    session.save(tables, what.behaviour)
    does = f"does {what.behaviour}" if what.behaviour else "stands at rest"
    outputs = "its outputs are armed by themselves" if what.robot.autostart else "its outputs are off until it is armed"
    _say(console, f"{what.puppet.name} is kept on the flash of {name}")
    _say(console, f"switched on, it {does}; {outputs}")
    if what.puppet.when_silent in GONE:
        _say(console, f"once a host has come and gone, it {GONE[what.puppet.when_silent]}")


@dataclass(frozen=True)
class Where:
    """A port, or an emulated MCU and what keeps its flash."""

    port: str | None = None
    mcu: str = "unix"
    flash: Path | None = None


@contextlib.contextmanager
def _carrier(where: Where) -> Iterator[tuple[Carrier, str]]:
    """Yield a carrier to an MCU and what it is called."""
    if where.port:
        serial = SerialCarrier(where.port)
        try:
            yield serial, where.port
        finally:
            serial.close()
    else:
        with open_mcu(where.mcu, where.flash) as virtual:
            yield VirtualCarrier(virtual), f"the emulated {where.mcu}"


def calibrate(robot: Robot, output: Output, relative: bool | None, where: Where, console: Console) -> None:
    """Let the user calibrate an output, command by command from standard input. Raises MarotteError."""
    with contextlib.ExitStack() as stack:
        if where.port:
            url = name = where.port
        else:
            from marotte.mcu.serve import serve

            virtual = stack.enter_context(open_mcu(where.mcu))
            robot = connected(virtual, robot)
            url, name = stack.enter_context(serve(virtual)).url, f"the emulated {where.mcu}"
        carrier = stack.enter_context(contextlib.closing(SerialCarrier(url)))
        try:
            _calibrate(Session(carrier), robot, robot.outputs[output.dof], relative, console)
        except LinkError as error:
            raise LinkError(f"{name}: {error}") from error


def _calibrate(session: Session, robot: Robot, output: Output, relative: bool | None, console: Console) -> None:
    session.open()
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    with interruptible(), Calibration(session, robot, output, relative) as calibration:
        _say(console, f"{output.dof} at {output.drive.place} has its pulses. Commands: {calibration.commands}")
        threading.Thread(target=_read_lines, args=(lines,), daemon=True).start()
        while True:
            session.pump(PUMP_US)
            with contextlib.suppress(queue.Empty):
                line = lines.get_nowait()
                if line.strip() == "done":
                    break
                try:
                    _say(console, calibration.do(line))
                except CalibrationError as error:
                    _say(console, str(error))
    _say(console, f"{output.dof} is off. For the robot file:\n\n{calibration.text()}")


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _read_lines(lines: queue.SimpleQueue[str]) -> None:
    """Hand on the lines of standard input, and at its end the command that ends."""
    for line in sys.stdin:
        lines.put(line)
    lines.put("done")


def serve_mcu(kind: str, tcp: int | None, image: Path | None, link: str, flash: Path | None) -> None:
    """Serve an emulated MCU until it fails or the user interrupts. Raises MarotteError."""
    from marotte.mcu.serve import serve, serve_rp2040

    live_mcu: contextlib.AbstractContextManager
    with contextlib.ExitStack() as stack:
        if kind == "rp2040":
            live_mcu = serve_rp2040(tcp, image=image, link=link, flash=flash)
        else:
            live_mcu = serve(stack.enter_context(open_mcu(kind, flash)), tcp)
        live = stack.enter_context(live_mcu)
        print(f"the emulated {kind} is at {live.url}   (Ctrl-C ends it)", flush=True)
        live.wait()


def list_ports() -> None:
    """Print the serial ports of this machine."""
    found = ports.available()
    for port in found:
        print(port)
    if not found:
        print("no serial port found (is the robot plugged in?)")


def dump_capture(path: str) -> None:
    """Print the packets of a capture. Raises MarotteError."""
    for line in dump(read_capture(path)):
        print(line, flush=path == STANDARD_INPUT)


def replay_capture(path: str, where: Where, robot: Robot | None) -> bool:
    """Send the host's half of a capture to an MCU, print and return whether it did as in the capture. Raises MarotteError."""
    records = list(read_capture(path))
    with _carrier(where) as (carrier, name):
        if robot and isinstance(carrier, VirtualCarrier):
            connected(carrier.mcu, robot)
        result = replay(records, carrier)
    for difference in result.differences:
        print(difference)
    how = "as" if result.agrees else "not as"
    print(
        f"{name} did {how} in the capture: {result.packets} packets sent, {result.answers} commands answered alike, "
        f"{result.frames} frames alike"
    )
    return result.agrees


def print_stats(path: str, baud: int) -> None:
    """Print the figures of a capture. Raises MarotteError."""
    print(stats_text(stats(read_capture(path)), baud))


def _captured(carrier: Carrier, path: Path | None) -> Carrier:
    return CapturingCarrier(carrier, path) if path else carrier


def _perform(files: Files, carrier: Carrier, where: str, options: RunOptions, console: Console) -> bool:
    from marotte.run import default_seconds, perform

    arm, seconds = options.arm, options.seconds
    length_s = float(default_seconds(files.score) if seconds is None else seconds)
    with View(files.puppet, files.robot if arm else None, where, length_s, console, quiet=options.no_view) as view:
        try:
            performance = perform(
                files.puppet,
                files.score,
                carrier,
                view,
                robot=files.robot,
                arm=arm,
                seconds=seconds,
                watch=options.watch,
            )
        except LinkError as error:
            raise LinkError(f"{where}: {error}") from error
    status = performance.status
    how = "stopped by hand" if performance.is_interrupted else "played"
    late = f", {status['late_frames']} late, at most {status['late_max_us']} us" if status else ""
    errors = f"; {status['bus_errors']} errors on the I2C bus" if status.get("bus_errors") else ""
    clipped = f"; {clipping(status)}" if status.get("clipped") else ""
    console.print(f"{how}: {performance.frames} frames{late}{errors}{clipped}; outputs are off", highlight=False)
    return performance.is_interrupted


def _print_pulses(summaries: list[PulseSummary], console: Console) -> None:
    table = Table(title="Pulses measured at the pins", title_justify="left", box=None, padding=(0, 2, 0, 0))
    for heading in ("DOF", "pin", "pulses", "last", "shortest", "longest"):
        table.add_column(heading, justify="left" if heading in ("DOF", "pin") else "right", header_style="dim")
    for pin in summaries:
        widths = (f"{width:.1f} us" for width in (pin.last_us, pin.least_us, pin.greatest_us))
        table.add_row(pin.dof, f"GP{pin.pin}", str(pin.count), *widths)
    if summaries:
        console.print(table)
    else:
        console.print("no pin has given a pulse", highlight=False)


def _require_writable(out: Path) -> None:
    """Raise MarotteError if a file cannot be written, before the work is done for it."""
    try:
        with out.open("a"):
            pass
    except OSError as error:
        raise MarotteError(f"{out}: cannot be written: {(error.strerror or str(error)).lower()}") from error
