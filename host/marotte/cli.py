"""The command `marotte`: its arguments, and nothing that could not be done from Python as well.

Exit status: 0 fine, 1 failure (of a port, an MCU, a file to write), 2 the user's mistake (in the arguments or in a file), 130
interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

from rich.console import Console

from marotte import check, commands, curves, emulated, plotting, ports
from marotte.errors import MarotteError
from marotte.files import Watch, load, load_pair
from marotte.tomlfile import FileMistakes, did_you_mean
from marotte.wiring import load_robot
from shared import formats

FINE = 0
FAILURE = 1
MISTAKE = 2
INTERRUPTED = 130
SECONDS_MAX = 1_000_000

_FLASH_HELP = "what keeps an emulated MCU's flash from run to run: a file (rp2040) or a folder (unix, unix32)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default the program's own, and return its exit status."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        status = command(options)
        sys.stdout.flush()
        return status
    except FileMistakes as mistakes:
        return _failed(str(mistakes), MISTAKE)
    except MarotteError as error:
        return _failed(f"marotte: {error}", FAILURE)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # whoever read our output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE


def _failed(text: str, status: int) -> int:
    print(text, file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="marotte", description="Puppets that live on their own microcontroller, directed over a serial link."
    )
    commands_ = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (_add_check, _add_render, _add_plot, _add_run, _add_save, _add_calibrate, _add_ports, _add_mcu):
        add(commands_)
    _add_import_curve(commands_)
    _add_link(commands_)
    return parser


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of an example."""


def _command(
    commands_: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    does: str,
    run: Callable[[argparse.Namespace], int],
    *examples: str,
) -> argparse.ArgumentParser:
    epilog = "\n".join([f"example{'s' if len(examples) > 1 else ''}:", *(f"  {example}" for example in examples)])
    parser = commands_.add_parser(
        name, help=does, description=does[:1].upper() + does[1:] + ".", epilog=epilog, formatter_class=_Formatter
    )
    parser.set_defaults(command=run)
    return parser


def _add_check(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "check",
        "check puppet, score and robot files and report every mistake in them",
        _check,
        "marotte check puppets/pet.toml",
        "marotte check puppets/pet.toml puppets/pet-score.toml puppets/pet-robot.toml",
    )
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="a file of any of the three kinds; a score or robot is checked against the puppet given with it",
    )


def _add_render(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "render",
        "play a score on an emulated MCU in virtual time and write every frame to a CSV file",
        _render,
        "marotte render puppets/pet.toml --score puppets/pet-score.toml --seconds 20 --mcu unix --out pet.csv",
    )
    _add_files(parser)
    parser.add_argument("--seconds", type=_seconds, required=True, help="length of the rendering")
    parser.add_argument("--mcu", choices=emulated.KINDS, required=True, help="the emulated MCU to render on")
    parser.add_argument("--out", required=True, metavar="FILE.csv", help="the file to write")


def _add_plot(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "plot",
        "play a score on an emulated MCU in virtual time and draw DOFs, their spectra and the weights",
        _plot,
        "marotte plot puppets/pet.toml --score puppets/pet-score.toml --seconds 20 --out pet.png",
        "marotte plot puppets/pet.toml --score puppets/pet-score.toml --seconds 20 --dof NECK HEAD_YAW --out neck.svg",
    )
    _add_files(parser)
    parser.add_argument("--seconds", type=_seconds, required=True, help="length of the rendering")
    parser.add_argument(
        "--dof", nargs="+", metavar="NAME", help=f"the DOFs to draw (default: the {plotting.DOFS} that move most)"
    )
    parser.add_argument(
        "--mcu", choices=emulated.KINDS, default="unix", help="the emulated MCU to render on (default: %(default)s)"
    )
    parser.add_argument("--out", type=_picture, required=True, metavar="FILE.png|.svg", help="the file to write")


def _add_run(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "run",
        "play a score live, on a robot or on an emulated MCU, and show what happens",
        _run,
        "marotte run puppets/pet.toml --score puppets/pet-score.toml --mcu rp2040",
        "marotte run puppets/pet.toml --score puppets/pet-score.toml --port /dev/ttyACM0 \\",
        "    --robot puppets/pet-robot.toml --arm",
        "marotte run puppets/pet.toml --score puppets/pet-score.toml --mcu unix --watch",
    )
    _add_files(parser)
    _add_where(parser)
    parser.add_argument("--arm", action="store_true", help="let the robot's outputs give pulses: it moves")
    parser.add_argument("--seconds", type=_seconds, help="stop after so long (default: 2 s after the last cue)")
    parser.add_argument(
        "--watch", action="store_true", help="load the files again when they change, and play on with them"
    )
    parser.add_argument("--no-view", action="store_true", help="print a line a cue instead of the moving picture")
    parser.add_argument(
        "--capture", type=Path, metavar="FILE", help="write down what goes over the link (see `marotte link`)"
    )


def _add_save(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "save",
        "let an MCU keep a puppet on its flash, so that it plays without a host when it is switched on",
        _save,
        "marotte save puppets/pet.toml --robot puppets/pet-robot.toml --behaviour CALM --port /dev/ttyACM0",
        "marotte save --erase --port /dev/ttyACM0",
        "marotte save puppets/pet.toml --robot puppets/pet-robot.toml --mcu rp2040 --flash pico.bin",
        "    then: marotte mcu rp2040 --flash pico.bin",
    )
    parser.add_argument("puppet", metavar="PUPPET", nargs="?", help="the puppet file")
    parser.add_argument("--robot", help="the robot file: wiring, calibration, and whether it starts by itself")
    parser.add_argument("--behaviour", metavar="NAME", help="what it does when it is switched on (default: it rests)")
    parser.add_argument("--erase", action="store_true", help="forget what is kept, and keep nothing")
    _add_where(parser)
    parser.add_argument("--flash", type=Path, metavar="PATH", help=_FLASH_HELP)


def _add_calibrate(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "calibrate",
        "move one DOF of a robot by hand and set its pulses while it moves",
        _calibrate,
        "marotte calibrate puppets/pet-robot.toml NECK --port /dev/ttyACM0",
        "    0              goes to the least value",
        "    low 1040       and gets this pulse there, in us",
        "    done           ends, and prints what belongs into the robot file",
    )
    parser.add_argument("robot", metavar="ROBOT", help="the robot file")
    parser.add_argument("dof", metavar="DOF", help="the DOF of one of its outputs; the others stay off")
    parser.add_argument(
        "--relative",
        action="store_true",
        default=None,
        help="it is a wheel (default: if its driver or keys are a wheel's)",
    )
    _add_where(parser)


def _add_where(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--port", help="the robot's serial port, or a URL that pyserial opens (see `marotte ports`)")
    where.add_argument("--mcu", choices=emulated.KINDS, help="an emulated MCU")


def _add_ports(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    _command(commands_, "ports", "list the serial ports of this machine", _ports, "marotte ports")


def _add_mcu(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "mcu",
        "run an emulated MCU in real time, for mpremote, `marotte run --port` or any serial program",
        _mcu,
        "marotte mcu rp2040",
        "marotte mcu unix --tcp 4000        then: marotte run ... --port socket://127.0.0.1:4000",
    )
    parser.add_argument("kind", choices=emulated.KINDS, help="the emulated MCU")
    parser.add_argument("--tcp", type=_tcp_port, metavar="PORT", help="a TCP port (default: a pseudo-terminal)")
    rp2040 = parser.add_argument_group("rp2040 only")
    rp2040.add_argument("--image", type=Path, metavar="FILE.uf2", help="another image than our own")
    rp2040.add_argument("--link", choices=("usb", "uart"), help="the line that is served (default: usb)")
    parser.add_argument("--flash", type=Path, metavar="PATH", help=_FLASH_HELP)


def _add_import_curve(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = _command(
        commands_,
        "import-curve",
        "print a curve of an animation tool as a function for a puppet file",
        _import_curve,
        "marotte import-curve nod.csv --column rotation_x --period 2 --name NOD >> puppets/pet.toml",
        "marotte import-curve nod.csv --column rotation_x --period 2 --samples 32 --frame-rate 30",
    )
    parser.add_argument("file", metavar="FILE.csv", help="a CSV file whose first line names its columns")
    parser.add_argument("--column", required=True, help="the column with the curve")
    parser.add_argument("--period", type=_seconds, required=True, metavar="S", help="seconds after which it repeats")
    parser.add_argument(
        "--samples", type=_samples, metavar="N", help="2 to 256 (default: as many as rows, at most 256)"
    )
    parser.add_argument("--name", type=_function_name, help="what the function is called (default: like the column)")
    parser.add_argument(
        "--frame-rate",
        type=_frame_rate,
        metavar="F",
        default=curves.FRAME_RATE_HZ,
        help="frames a second, for a file that counts frames (default: %(default)g, as in Blender)",
    )


def _add_link(commands_: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands_.add_parser(
        "link",
        help="show, repeat and measure what went over the link",
        description="Show, repeat and measure what went over the link, from a capture.",
        epilog="example:\n  marotte link dump run.capture     after: marotte run ... --capture run.capture",
        formatter_class=_Formatter,
    )
    tools = parser.add_subparsers(title="tools", metavar="TOOL", required=True)
    _add_capture(
        _command(
            tools,
            "dump",
            "print each packet of a capture with its time, direction, number, message and fields",
            _link_dump,
            "marotte link dump run.capture | less",
            "tail -f -n +1 run.capture | marotte link dump -       while it is being captured",
        )
    )
    replay = _command(
        tools,
        "replay",
        "send the host's half of a capture to an MCU again, and see whether it answers and moves as in the capture",
        _link_replay,
        "marotte link replay run.capture --mcu unix",
        "marotte link replay run.capture --mcu rp2040 --robot puppets/pet-robot.toml",
        "marotte link replay run.capture --port /dev/ttyACM0   it moves as it did: outputs are armed if they were",
    )
    _add_capture(replay)
    _add_where(replay)
    replay.add_argument("--robot", help="the robot file: its chips and kill switch are connected to the emulated MCU")
    stats = _command(
        tools,
        "stats",
        "count packets, bytes and errors of a capture, and measure its round trips",
        _link_stats,
        "marotte link stats run.capture",
    )
    _add_capture(stats)
    stats.add_argument(
        "--baud", type=_baud, default=ports.BAUD, help="the line's rate, to tell shares of it (default: %(default)d)"
    )


def _add_capture(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", metavar="FILE", help="a capture of `marotte run --capture`, or - for standard input")


def _add_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("puppet", metavar="PUPPET", help="the puppet file")
    parser.add_argument("--score", required=True, help="the score file")
    parser.add_argument("--robot", help="the robot file: wiring and calibration")


def _seconds(text: str) -> Fraction:
    """Return a positive number of seconds, exactly as its decimal text says."""
    try:
        seconds = Fraction(text) if len(text) <= 30 and "e" not in text.lower() else None
    except (ValueError, ZeroDivisionError):
        seconds = None
    if seconds is None or not 0 < seconds <= SECONDS_MAX:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of seconds above 0")
    return seconds


def _picture(text: str) -> Path:
    if Path(text).suffix.lower() not in plotting.SUFFIXES:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, expected a name that ends in {' or '.join(plotting.SUFFIXES)}"
        )
    return Path(text)


def _frame_rate(text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0
    if not 1 <= rate_hz <= curves.FRAME_RATE_MAX_HZ:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected frames a second, 1..{curves.FRAME_RATE_MAX_HZ}")
    return rate_hz


def _samples(text: str) -> int:
    if not text.isdecimal() or len(text) > 3 or not 2 <= int(text) <= formats.SAMPLES_MAX:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of samples, 2..{formats.SAMPLES_MAX}")
    return int(text)


def _function_name(text: str) -> str:
    if not curves.is_function_name(text):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected letters, digits and _, and no primitive's name")
    return text


def _baud(text: str) -> int:
    if not text.isdecimal() or not 1 <= len(text) <= 9 or int(text) == 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected bits a second")
    return int(text)


def _tcp_port(text: str) -> int:
    if not text.isdecimal() or not 0 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a TCP port, 0..65535")
    return int(text)


def _check(options: argparse.Namespace) -> int:
    report = check.check_files(options.files)
    for line in report.fine:
        print(line)
    for mistake in report.mistakes:
        print(mistake, file=sys.stderr)
    if report.mistakes:
        count = len(report.mistakes)
        return _failed(f"{count} mistake{'s' if count > 1 else ''}", MISTAKE)
    return FINE


def _render(options: argparse.Namespace) -> int:
    files = load(options.puppet, options.score, options.robot)
    commands.render_to_csv(files, options.seconds, options.mcu, Path(options.out), Console(stderr=True))
    return FINE


def _plot(options: argparse.Namespace) -> int:
    if not plotting.is_possible():
        return _failed(f"marotte: {plotting.MISSING}", MISTAKE)
    files = load(options.puppet, options.score, options.robot)
    for name in options.dof or ():
        if name not in files.puppet.dofs:
            hint = did_you_mean(name, files.puppet.dofs)
            return _failed(f"marotte: {options.puppet} has no DOF {name!r}{hint}", MISTAKE)
    commands.plot_to_file(files, options.seconds, options.mcu, options.dof, options.out, Console(stderr=True))
    return FINE


def _run(options: argparse.Namespace) -> int:
    if options.arm and not options.robot:
        return _failed("marotte: --arm needs --robot FILE, which says where the outputs are", MISTAKE)
    paths = (options.puppet, options.score, options.robot)
    watch = Watch(*paths) if options.watch else None
    files = load(*paths)
    console = Console()
    how = commands.RunOptions(options.arm, options.seconds, options.no_view, watch, options.capture)
    if options.port:
        interrupted = commands.run_on_port(files, options.port, how, console)
    else:
        interrupted = commands.run_on_mcu(files, options.mcu, how, console)
    return INTERRUPTED if interrupted else FINE


def _link_dump(options: argparse.Namespace) -> int:
    commands.dump_capture(options.capture)
    return FINE


def _link_replay(options: argparse.Namespace) -> int:
    if options.robot and not options.mcu:
        return _failed("marotte: --robot is for an emulated MCU, --mcu", MISTAKE)
    robot = load_robot(options.robot) if options.robot else None
    agrees = commands.replay_capture(options.capture, commands.Where(options.port, options.mcu or ""), robot)
    return FINE if agrees else FAILURE


def _link_stats(options: argparse.Namespace) -> int:
    commands.print_stats(options.capture, options.baud)
    return FINE


def _save(options: argparse.Namespace) -> int:
    if options.flash and not options.mcu:
        return _failed("marotte: --flash is for an emulated MCU, --mcu", MISTAKE)
    if options.erase and (options.puppet or options.robot or options.behaviour):
        return _failed("marotte: --erase takes no puppet, robot or behaviour", MISTAKE)
    if not options.erase and not (options.puppet and options.robot):
        return _failed("marotte: save needs PUPPET and --robot FILE, or --erase", MISTAKE)
    what = None
    if not options.erase:
        puppet, robot = load_pair(options.puppet, options.robot)
        if options.behaviour is not None and options.behaviour not in puppet.behaviours:
            hint = did_you_mean(options.behaviour, puppet.behaviours)
            return _failed(f"marotte: {options.puppet} has no behaviour {options.behaviour!r}{hint}", MISTAKE)
        what = commands.Keeping(puppet, robot, options.behaviour)
    commands.save(what, commands.Where(options.port, options.mcu or "", options.flash), Console())
    return FINE


def _calibrate(options: argparse.Namespace) -> int:
    robot = load_robot(options.robot)
    if options.dof not in robot.outputs:
        hint = did_you_mean(options.dof, robot.outputs)
        return _failed(f"marotte: {options.robot} has no output for {options.dof!r}{hint}", MISTAKE)
    where = commands.Where(options.port, options.mcu or "")
    commands.calibrate(robot, robot.outputs[options.dof], options.relative, where, Console())
    return FINE


def _ports(options: argparse.Namespace) -> int:
    commands.list_ports()
    return FINE


def _import_curve(options: argparse.Namespace) -> int:
    period_s = float(options.period)
    curve = curves.import_curve(options.file, options.column, period_s, options.samples, options.frame_rate)
    print(curve.text(options.name or curves.function_name(options.column)))
    return FINE


def _mcu(options: argparse.Namespace) -> int:
    if options.kind != "rp2040" and (options.image or options.link):
        return _failed("marotte: --image and --link are for the rp2040 only", MISTAKE)
    commands.serve_mcu(options.kind, options.tcp, options.image, options.link or "usb", options.flash)
    return FINE
