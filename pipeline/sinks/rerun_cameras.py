"""A data set's cameras in a Rerun recording: the picture of each frame, from the data set's own bytes.

    /episode_007/camera/<name>    a video cut out of the data set's file and, at each frame, which of its pictures; or the pictures

What belongs here: pictures as Rerun's entities. What does not: where the bytes come from (`lerobot_format.clips`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.errors import DatasetError
from pipeline.lerobot_format.clips import Clip, Footage, Stills
from pipeline.types import Camera, Demonstrations

Times = Callable[[int], list[Any]]
"""How many → the time columns of an episode's first so many frames: the last one may have no picture of its own."""


@dataclass
class Cameras:
    """The cameras of a data set, while a recording is written: how much room is left for them, and why some are left out.

    room  bytes; None where there is no limit. An episode's camera is in the recording whole, or not at all.
    """

    demos: Demonstrations
    room: int | None = None
    left_out: list[str] = field(default_factory=list)
    _shown: set[tuple[str, int]] = field(default_factory=set)

    def shown(self, episode: int) -> list[Camera]:
        """Those that were sent of an episode."""
        return [camera for camera in self.demos.cameras if (camera.key, episode) in self._shown]

    def send(self, recording: Any, root: str, episode: int, times: Times) -> None:
        """All cameras of one episode."""
        for camera in self.demos.cameras:
            try:
                found = Footage(self.demos, camera).clip(episode)
            except DatasetError as why:
                self._leave_out(camera, str(why))
                continue
            size = len(found.mp4) if isinstance(found, Clip) else sum(map(len, found.pictures))
            if self.room is not None and size > self.room:
                number = self.demos.episode_ids[episode]
                self._leave_out(
                    camera, f"episode {number} would make the recording too large; `demobench view` shows it"
                )
                continue
            if self.room is not None:
                self.room -= size
            _send(recording, camera_entity(root, camera), found, times)
            self._shown.add((camera.key, episode))

    def _leave_out(self, camera: Camera, why: str) -> None:
        words = f"camera '{camera.key}': {why}"
        if words not in self.left_out:
            self.left_out.append(words)


def camera_entity(root: str, camera: Camera) -> str:
    import rerun as rr

    return rr.new_entity_path([root.strip("/"), "camera", camera.key])


def _send(recording: Any, entity: str, found: Clip | Stills, times: Times) -> None:
    import rerun as rr

    if isinstance(found, Stills):
        blobs = rr.EncodedImage.columns(
            blob=list(found.pictures), media_type=[f"image/{found.format}"] * len(found.pictures)
        )
        recording.send_columns(entity, times(len(found.pictures)), blobs)
        return
    asset = rr.AssetVideo(contents=found.mp4, media_type="video/mp4")
    recording.log(entity, asset, static=True)
    due = np.asarray(asset.read_frame_timestamps_nanos())[found.frames]
    recording.send_columns(entity, times(len(due)), rr.VideoFrameReference.columns_nanos(due))
