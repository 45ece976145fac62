"""A data set's cameras as messages: what the pictures are, on which topic, and those of one episode.

    /camera/<name>    foxglove_msgs/CompressedVideo    where the data set keeps videos
                      sensor_msgs/CompressedImage      where it keeps pictures

What belongs here: topics and layout of picture messages. What does not: where the bytes come from (`lerobot_format.clips`), when
they are written (`to_mcap`).

`foxglove_msgs/CompressedVideo` is what ROS 2 calls `foxglove.CompressedVideo`: one picture a message, H.264 and H.265 in Annex B.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from pipeline.errors import DatasetError
from pipeline.lerobot_format.clips import Footage, Stills, Stream
from pipeline.types import Camera, Demonstrations

RULE = "=" * 80  # readers split a definition at lines of exactly 80
TIME = f"{RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = f"{RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{TIME}"
VIDEO = "foxglove_msgs/msg/CompressedVideo"
IMAGE = "sensor_msgs/msg/CompressedImage"
DEFINITIONS = {
    VIDEO: f"builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n{TIME}",
    IMAGE: f"std_msgs/Header header\nstring format\nuint8[] data\n{HEADER}",
}


@dataclass
class Feed:
    """One camera on its topic; what was found out about it while its episodes were written.

    kept      codec or format → why it is not the data set's own bytes, "" where it is
    left_out  why episodes have no pictures
    """

    topic: str
    camera: Camera
    footage: Footage
    kept: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def episode(self, position: int) -> "Stream | Stills | None":
        """The pictures of an episode; None, with the reason kept, where there are none."""
        try:
            found = self.footage.stream(position)
        except DatasetError as why:
            if str(why) not in self.left_out:
                self.left_out.append(str(why))
            return None
        if isinstance(found, Stills):
            self.kept[found.format] = ""
        else:
            self.kept[found.codec] = found.encoded_anew or self.kept.get(found.codec, "")
        return found

    def messages(self, found: "Stream | Stills | None") -> Iterator[tuple[str, dict]]:
        """Schema and message of each frame, without its time; the last frame may have none."""
        if isinstance(found, Stills):
            for picture in found.pictures:
                yield IMAGE, {"header": {"frame_id": self.camera.key}, "format": found.format, "data": picture}
        elif found:
            for packet in found.packets:
                yield VIDEO, {"frame_id": self.camera.key, "format": found.codec, "data": packet}

    def described(self) -> str:
        """For the file's metadata record."""
        how = [
            f"{name}, encoded anew: {why}" if why else f"{name}, as in the data set" for name, why in self.kept.items()
        ]
        without = [f"left out: {why}" for why in self.left_out]
        return "; ".join([f"{self.camera.key}, {self.camera.width}×{self.camera.height}", *how, *without])


def feeds_of(demos: Demonstrations) -> list[Feed]:
    """A topic a camera, by what is its own in its name."""
    feeds: list[Feed] = []
    for camera in demos.cameras:
        topic = f"/camera/{token(re.sub(r'^observation[.](images[.])?', '', camera.key))}"
        while topic in [feed.topic for feed in feeds]:
            topic += "_"
        feeds.append(Feed(topic, camera, Footage(demos, camera)))
    return feeds


def stamped(schema: str, message: dict, stamp: dict) -> dict:
    """The message with its time where its definition has it."""
    if schema == VIDEO:
        return message | {"timestamp": stamp}
    return message | {"header": message["header"] | {"stamp": stamp}}


def left_out(feeds: Sequence[Feed]) -> list[str]:
    return [f"camera '{feed.camera.key}': {why}" for feed in feeds for why in feed.left_out]


def token(name: str) -> str:
    """ROS 2 names hold letters, digits and `_`; the rest becomes `_`."""
    found = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{found}" if found[0].isdigit() else found
