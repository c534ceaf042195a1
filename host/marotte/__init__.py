"""Marotte: puppets that live on their own microcontroller, directed over a serial link.

Render a score on an emulated MCU, in virtual time, with the firmware that runs on a robot:

    import marotte

    puppet = marotte.load_puppet("puppets/pet.toml")
    score = marotte.load_score("puppets/pet-score.toml", puppet)
    rendering = marotte.render(puppet, score, seconds=20, mcu="unix")
    print(max(rendering.motor["HEAD_YAW"]))

Draw it (this needs matplotlib):

    rendering = marotte.render(puppet, score, seconds=20, weights=True)
    marotte.save_figure(marotte.plot(rendering, score, ["NECK", "HEAD_YAW"]), "pet.png")

Direct a robot by hand:

    robot = marotte.load_robot("puppets/pet-robot.toml", puppet)
    session = marotte.Session(marotte.SerialCarrier("/dev/ttyACM0"))
    session.open()
    session.upload(marotte.build_tables(puppet, robot))
    session.arm()
    session.wait_attached()
    session.start()
    happy = puppet.action_index("HAPPY_FACE")
    session.weight_targets(marotte.FRAME_NOW, {happy: marotte.weight_q28(1.0)})
    while True:
        session.pump(20_000)

Give it other tables while it moves; what keeps its name goes on:

    other = marotte.load_puppet("puppets/pet.toml")
    session.exchange(marotte.build_tables(other, robot), playing=puppet)

Let it live without a host from the next time that it is switched on:

    session.kill()
    session.stop()
    session.save(marotte.build_tables(puppet, robot), behaviour="CALM")

Values are 0..1 for absolute DOFs and -1..1 for relative ones, weights 0..4, live channels 0..1, tempos factors. Whatever the user
can do something about raises a subclass of `MarotteError`, whose text is complete.
"""

from marotte.curves import ImportedCurve, import_curve
from marotte.errors import MarotteError
from marotte.link import LinkError, VirtualCarrier
from marotte.plotting import plot, save_figure
from marotte.ports import PortError, SerialCarrier, available
from marotte.puppet import Puppet
from marotte.puppet_file import load_puppet
from marotte.rendering import RenderError, Rendering, render
from marotte.score import Cue, Score, load_score
from marotte.session import LinkKilled, Session
from marotte.tables import Tables, build_tables, weight_q28
from marotte.tomlfile import FileMistakes, Mistake
from marotte.wiring import Robot, load_robot
from shared.formats import FRAME_NOW

__all__ = [
    "FRAME_NOW",
    "Cue",
    "FileMistakes",
    "ImportedCurve",
    "LinkError",
    "LinkKilled",
    "MarotteError",
    "Mistake",
    "PortError",
    "Puppet",
    "RenderError",
    "Rendering",
    "Robot",
    "Score",
    "SerialCarrier",
    "Session",
    "Tables",
    "VirtualCarrier",
    "available",
    "build_tables",
    "import_curve",
    "load_puppet",
    "load_robot",
    "load_score",
    "plot",
    "render",
    "save_figure",
    "weight_q28",
]
