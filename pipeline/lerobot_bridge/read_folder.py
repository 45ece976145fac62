"""What `predict_checkpoint` needs of a LeRobot folder (v2 or v3): numbers, words, pictures of some episodes.

Imported by that script in the environment that has LeRobot, so it imports nothing of demobench. What belongs here: where
things are in the folder. What does not: policies. Numbers are read from the parquet files, because LeRobot's own loader takes
v3.0 only and wants every video; pictures are decoded by LeRobot, so that they are those its trainer saw.
"""

import io
import json
import os
import re
from functools import cache
from pathlib import Path

JSON_BYTES = 16 * 2**20
INDEX = ("episode_index", "frame_index", "timestamp", "task_index")


class Refusal(Exception):
    """A mistake of the user's, in one line."""


def one_line(error: Exception) -> str:
    """An error of another library's in one short line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def read_json(path: Path) -> dict:
    """A JSON object; Refusal where there is none."""
    try:
        if path.stat().st_size > JSON_BYTES:
            raise Refusal(f"{path} has {path.stat().st_size} bytes; such a file has a few thousand.")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise Refusal(f"{path} cannot be read as JSON: {one_line(error)}.") from None
    if not isinstance(content, dict):
        raise Refusal(f"{path} should hold a JSON object, and holds a {type(content).__name__}.")
    return content


class DataFolder:
    """A LeRobot folder. `features` and `fps` are those of meta/info.json."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = read_json(folder / "meta/info.json")
        self.features = self.info.get("features")
        self.fps = self.info.get("fps")
        described = isinstance(self.features, dict) and all(isinstance(f, dict) for f in self.features.values())
        if not described or not isinstance(self.fps, (int, float)) or self.fps <= 0:
            raise Refusal(f"{folder}/meta/info.json should say `features` and `fps`. Is it a LeRobot data set?")
        self._pictures = (None, None)
        self._rows = None

    def shape(self, name: str) -> tuple:
        """A feature's shape as info.json says it; () where it says none. Of pictures: channels first."""
        shape = self.features.get(name, {}).get("shape")
        shape = tuple(shape) if isinstance(shape, list) else ()
        last = self.is_camera(name) and len(shape) == 3 and shape[2] in (1, 3)
        return (shape[2], *shape[:2]) if last else shape

    def is_camera(self, name: str) -> bool:
        return self.features[name].get("dtype") in ("video", "image")

    def frames(self, episodes: list, names: list) -> dict:
        """Episode → an Arrow table of its frames in order: the named columns, and those of INDEX that there are."""
        import numpy as np
        import pyarrow as pa

        found = [
            table
            for path in sorted((self.folder / "data").rglob("*.parquet"))
            if (table := _rows(path, episodes, names))
        ]
        if not found:
            raise Refusal(f"{self.folder}/data holds none of the {len(episodes)} episodes that the anchors name.")
        table = pa.concat_tables(found, promote_options="permissive")
        for name in names:
            if name not in table.column_names or table[name].null_count:
                raise Refusal(f"{self.folder}/data: {name} is missing, in some frames at least.")
        if "frame_index" in table.column_names:
            table = table.sort_by([("episode_index", "ascending"), ("frame_index", "ascending")])
        else:
            table = table.sort_by("episode_index")
        values, starts, counts = np.unique(table["episode_index"].to_numpy(), return_index=True, return_counts=True)
        parts = zip(values.tolist(), starts.tolist(), counts.tolist(), strict=True)
        return {episode: table.slice(start, count) for episode, start, count in parts}

    def tasks(self) -> dict:
        """task_index → words; empty where they cannot be read."""
        import pyarrow.parquet as pq

        table, lines = self.folder / "meta/tasks.parquet", self.folder / "meta/tasks.jsonl"
        if table.is_file():
            rows = pq.read_table(table).to_pydict()
            words = rows.get("task", rows.get("__index_level_0__", []))
            return dict(zip(rows.get("task_index", []), words, strict=False))
        if lines.is_file():
            rows = [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines() if line.strip()]
            return {row.get("task_index"): row.get("task", "") for row in rows}
        return {}

    def pictures(self, camera: str, episode: int, frames: list, seconds: list):
        """A tensor [n, 3, H, W] in 0 … 1: some frames of an episode, recorded at `seconds` of it."""
        if self.features[camera].get("dtype") == "image":
            return self._stored_pictures(camera, episode, frames)
        path, start = self._video(camera, episode)
        if not path.is_file():
            raise Refusal(f"The checkpoint needs the camera {camera}, and its video {path} is not there.")
        from lerobot.datasets.video_utils import decode_video_frames

        try:  # the nearest frame, as long as it is this one
            times = [start + s for s in seconds]
            return decode_video_frames(path, times, 0.5 / self.fps, backend=_video_backend()).float()
        except Exception as error:  # whatever a decoder raises of a damaged file
            raise Refusal(f"{path} cannot be decoded for episode {episode}: {one_line(error)}") from None

    def _stored_pictures(self, camera: str, episode: int, frames: list):
        """Pictures that are kept as files inside the parquet; one episode at a time is in memory."""
        import numpy as np
        import torch
        from PIL import Image

        if self._pictures[0] != (camera, episode):
            self._pictures = ((camera, episode), self.frames([episode], [camera])[episode][camera])
        try:
            stored = [self._pictures[1][frame].as_py()["bytes"] for frame in frames]
            pictures = np.stack([np.asarray(Image.open(io.BytesIO(file)).convert("RGB")) for file in stored])
        except Exception as error:  # whatever a decoder raises of a damaged file
            raise Refusal(f"{camera} of episode {episode} holds no picture: {one_line(error)}") from None
        return torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255

    def _video(self, camera: str, episode: int) -> tuple:
        """The file that holds an episode, and the second at which the episode starts in it."""
        template, start = str(self.info.get("video_path")), 0.0
        words = {"video_key": camera, "episode_index": episode}
        words["episode_chunk"] = episode // int(self.info.get("chunks_size") or 1000)
        row = self._episode(episode)
        if f"videos/{camera}/chunk_index" in row:
            words |= {f"{part}_index": row[f"videos/{camera}/{part}_index"] for part in ("chunk", "file")}
            start = row[f"videos/{camera}/from_timestamp"]
        try:
            inside = os.path.normpath(template.format(**words))
        except (KeyError, IndexError, ValueError, AttributeError):
            raise Refusal(
                f"{self.folder}/meta does not say where the video {camera} of episode {episode} is."
            ) from None
        if inside.startswith("..") or Path(inside).is_absolute():
            raise Refusal(f"{self.folder}/meta/info.json: video_path {template!r} leaves the data set.")
        return self.folder / inside, start

    def _episode(self, episode: int) -> dict:
        """What v3's meta/episodes says of an episode's videos; {} in v2."""
        import pyarrow.parquet as pq

        if self._rows is None:
            self._rows = {}
            for path in sorted((self.folder / "meta/episodes").rglob("*.parquet")):
                names = [c for c in pq.read_schema(path).names if c == "episode_index" or c.startswith("videos/")]
                self._rows |= {row["episode_index"]: row for row in pq.read_table(path, columns=names).to_pylist()}
        return self._rows.get(episode, {})


def _rows(path: Path, episodes: list, names: list):
    """An Arrow table: the rows of a file that belong to some episodes; None where it has none of them."""
    import numpy as np
    import pyarrow.parquet as pq

    try:
        there = pq.read_schema(path).names
        wanted = [name for name in (*INDEX, *names) if name in there]
        if "episode_index" in there:
            table = pq.read_table(path, columns=wanted, filters=[("episode_index", "in", episodes)])
        else:  # v2 keeps an episode a file, and says in the name which
            of_name = re.fullmatch(r"episode_(\d+)\.parquet", path.name)
            if not of_name or int(of_name[1]) not in episodes:
                return None
            table = pq.read_table(path, columns=wanted)
            table = table.append_column("episode_index", [np.full(table.num_rows, int(of_name[1]), np.int64)])
    except (OSError, ValueError) as error:
        raise Refusal(f"{path} cannot be read: {one_line(error)}") from None
    # The notes of other libraries in the schema differ from file to file and mean nothing here.
    return table.replace_schema_metadata(None) if table.num_rows else None


@cache
def _video_backend() -> str:
    """LeRobot's choice: torchcodec where it loads, else PyAV."""
    from lerobot.utils.import_utils import get_safe_default_video_backend

    return get_safe_default_video_backend()
