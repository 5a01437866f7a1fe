"""The streams of a recording that tell how a sensor turns or moves: their names, and which two are meant."""

from collections.abc import Sequence
from dataclasses import dataclass

from calibkit.data.plural import counted
from calibkit.data.rig import Rig
from calibkit.errors import BadInputError, one_line
from calibkit.io.recording import Recording

_PREFIX = {"image": "cam", "corners": "cam", "imu": "imu", "pose": "pose", "twist": "odom", "tf": "pose"}


@dataclass(frozen=True)
class Sensor:
    """One stream that may be compared."""

    name: str
    kind: str
    topic: str
    count: int = 0


def find_sensors(recording: Recording, base: Rig, wanted: Sequence[str]) -> list[Sensor]:
    """Return the streams to choose from, named as the rig file has their topics, else cam0, imu0, pose0, odom0 in order.

    Those asked for, or all; where one alone is asked for, those of other kinds too.
    """
    topics = {topic.name: topic for topic in recording.topics}
    asked = [text.rpartition("=") if "=" in text and not text.startswith("tf:") else ("", "", text) for text in wanted]
    if len(asked) < 2:  # the other one is found, if it is of another kind
        there = {_PREFIX.get(topics[topic].kind) if topic in topics else _PREFIX["tf"] for _, _, topic in asked}
        others = (topic for topic in recording.topics if topic.kind in _PREFIX and topic.kind != "tf")
        asked += [("", "", topic.name) for topic in others if _PREFIX[topic.kind] not in there]
    known = {entry.topic: name for part in (base.cameras, base.imus) for name, entry in part.items() if entry.topic}
    found: list[Sensor] = []
    for name, _, topic in asked:
        if topic.startswith("tf:"):
            kind, count = "tf", 0
        elif topic in topics:
            kind, count = topics[topic].kind, topics[topic].count
        else:
            raise BadInputError(f"{recording.name}: there is no topic {one_line(topic) or '(empty)'}; calibkit info lists what it has")
        if kind not in _PREFIX:
            recording.choose("pose", topic)  # says what it is instead
        prefix = _PREFIX[kind]
        given = name or known.get(topic) or f"{prefix}{sum(sensor.name.startswith(prefix) for sensor in found)}"
        if not given.isalnum() or not given[0].isalpha() or any(sensor.name == given for sensor in found):
            raise BadInputError(
                f"{one_line(given) or '(empty)'}={one_line(topic)}: write NAME=/topic with a new name of letters and digits"
            )
        found.append(Sensor(given, kind, topic, count=count))
    return found


def choose_pair(sensors: list[Sensor], wanted_of: str | None, wanted_to: str | None) -> tuple[Sensor, Sensor]:
    """Return of and to: as asked for, else the only two there are, an IMU or the faster stream being `to`."""
    offered = ", ".join(f"{sensor.name} ({one_line(sensor.topic)})" for sensor in sensors) or "none"

    def one(asked: str) -> Sensor:
        match = [sensor for sensor in sensors if asked in (sensor.name, sensor.topic)]
        if not match:
            raise BadInputError(f"{one_line(asked)} is no sensor of this recording: it has {offered}")
        return match[0]

    if wanted_of is not None and wanted_to is not None:
        of, to = one(wanted_of), one(wanted_to)
    else:
        named = [one(asked) for asked in (wanted_of, wanted_to) if asked is not None]
        others = [sensor for sensor in sensors if sensor not in named]
        if len(named) + len(others) > 2:
            imus = [sensor for sensor in others if sensor.kind == "imu"]
            others = imus if named and len(imus) == 1 else others
        if len(sensors) < 2:
            raise BadInputError(
                f"two sensors that turn are needed, the recording has {offered}: give the other one's file too, or --pose tf:PARENT/CHILD"
            )
        if len(named) + len(others) != 2:
            raise BadInputError(
                f"which two? the recording has {counted(len(sensors), 'sensor')} that turn: {offered}; name them: --of NAME --to NAME"
            )
        both = [*named, *others]
        if wanted_to is not None:
            of, to = others[0], named[0]
        elif wanted_of is not None:
            of, to = named[0], others[0]
        else:
            of, to = sorted(both, key=lambda sensor: (sensor.kind == "imu", sensor.kind == "twist", sensor.count))
    if of == to:
        raise BadInputError(f"--of and --to are both {of.name}: name two sensors")
    return of, to
