"""The action chunks that a LeRobot checkpoint predicts at given frames of a data set, by LeRobot's own classes.

Run by the Python that has LeRobot, which cannot be the one that has demobench, so this file imports nothing of demobench:

    python predict_checkpoint.py --checkpoint outputs/train/act --dataset my_dataset --anchors anchors.parquet --out p.parquet

What belongs here: loading a checkpoint, showing it what it would have seen at each anchor, writing what it answers. What does
not: any number about how good the answers are. The checkpoint's own processors normalise and un-normalise. A checkpoint is
safetensors and JSON; nothing is unpickled, and a processor step that would import other code is refused.

On stdout: `progress DONE TOTAL` as it goes, one line of JSON with facts at the end. On a mistake of the user's: one line on
stderr, exit code 2. Legend of shapes: B anchors of a batch, T frames seen, K actions of a chunk, A action columns.
"""

import argparse
import contextlib
import difflib
import json
import os
import re
import signal
import sys
from pathlib import Path

from read_folder import DataFolder, Refusal, one_line, read_json  # beside this file

POLICIES = ("act", "diffusion", "smolvla")
KNOWN_STEPS = (
    "rename_observations_processor", "to_batch_processor", "device_processor", "normalizer_processor",
    "unnormalizer_processor", "tokenizer_processor", "smolvla_new_line_processor",
)  # fmt: skip
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
ROWS_AT_ONCE = 4096
"""Predictions of so many anchors are kept in memory before they are written."""


# The checkpoint


def find_checkpoint(given: Path) -> Path:
    """The folder with config.json: `given`, its pretrained_model/, or the last one of a run's checkpoints/."""
    runs = given if given.name == "checkpoints" else given / "checkpoints"
    numbered = sorted(
        runs.glob("*/pretrained_model"), key=lambda p: int(p.parent.name) if p.parent.name.isdigit() else -1
    )
    for folder in (given, given / "pretrained_model", runs / "last/pretrained_model", *reversed(numbered)):
        if (folder / "config.json").is_file():
            return folder
    raise Refusal(
        f"{given} holds no LeRobot checkpoint: there is no config.json in it, in pretrained_model/ or in "
        "checkpoints/*/pretrained_model/. Give the folder that lerobot-train wrote (--output_dir)."
    )


def check_checkpoint(folder: Path) -> str:
    """The policy's type, once the files are those of a kind that can be loaded without running foreign code."""
    config = read_json(folder / "config.json")
    kind = config.get("type")
    if kind not in POLICIES:
        raise Refusal(f"{folder}/config.json: the policy type is {kind!r}, and known here are {', '.join(POLICIES)}.")
    if config.get("use_peft"):
        raise Refusal(f"{folder} is a PEFT adapter. Merge it into its policy, save that, and give its folder.")
    if not (folder / "model.safetensors").is_file():
        raise Refusal(f"{folder} has no model.safetensors. Weights in other formats can run code and are not loaded.")
    for name in PROCESSORS:
        if not (folder / name).is_file():
            raise Refusal(
                f"{folder} has no {name}: it is older than LeRobot's processors. Migrate it first: "
                "python -m lerobot.processor.migrate_policy_normalization --pretrained-path CHECKPOINT"
            )
        _check_steps(folder / name)
    return kind


def _check_steps(path: Path) -> None:
    """LeRobot imports whatever class a step names, so only steps known by name pass."""
    steps = read_json(path).get("steps")
    for step in steps if isinstance(steps, list) else [None]:
        name = step.get("registry_name") if isinstance(step, dict) else None
        if name not in KNOWN_STEPS:
            raise Refusal(
                f"{path} asks for the processor step {name or step!r}; known here are {', '.join(KNOWN_STEPS)}."
            )
        state = step.get("state_file")
        if state is not None and (not isinstance(state, str) or not re.fullmatch(r"[\w.-]+\.safetensors", state)):
            raise Refusal(f"{path}: the state file {state!r} of step {name} should be a safetensors file beside it.")


def trained_on(folder: Path) -> dict:
    """What train_config.json beside the weights says of the data: episodes (a list; None for all), or "unknown"."""
    if not (folder / "train_config.json").is_file():
        return {"trained_on": "unknown", "trained_dataset": None, "started_from": None}
    config = read_json(folder / "train_config.json")
    dataset, policy = config.get("dataset"), config.get("policy")
    if not isinstance(dataset, dict):
        return {"trained_on": "unknown", "trained_dataset": None, "started_from": None}
    episodes = dataset.get("episodes")
    if episodes is not None and not (isinstance(episodes, list) and all(type(e) is int for e in episodes)):
        raise Refusal(f"{folder}/train_config.json: dataset.episodes should be a list of numbers, or null for all.")
    return {
        "trained_on": episodes,
        "trained_dataset": {"repo_id": dataset.get("repo_id"), "root": dataset.get("root")},
        "started_from": policy.get("pretrained_path") if isinstance(policy, dict) else None,
    }


def copied_features(trained: dict) -> dict:
    """Feature → the column it repeats, where the policy was trained on a copy that says so (`environment_state`)."""
    root = (trained["trained_dataset"] or {}).get("root")
    info = Path(root) / "meta/info.json" if isinstance(root, str) else None
    copied = read_json(info).get("copied_features") if info and info.is_file() else None
    return {k: v for k, v in copied.items() if isinstance(v, str)} if isinstance(copied, dict) else {}


class Checkpoint:
    """A loaded policy with its processors."""

    def __init__(self, folder: Path, kind: str, device: str) -> None:
        import torch
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        self.kind = kind
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = device
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # the checkpoint's own replace them, without asking the network
        self.policy = get_policy_class(kind).from_pretrained(folder, config=config)
        self.config = config
        self.before, self.after = make_pre_post_processors(
            config, pretrained_path=str(folder), preprocessor_overrides={"device_processor": {"device": device}}
        )
        self.parameters = sum(p.numel() for p in self.policy.parameters())
        renamed = next((step.rename_map for step in self.before.steps if hasattr(step, "rename_map")), {})
        self.fed_as = {ours: theirs for theirs, ours in renamed.items()}
        """From a feature of the policy to the name that its first processor step renames."""
        self._check_weights(folder)
        self._amp = config.use_amp and torch.device(device).type != "cpu"

    def _check_weights(self, folder: Path) -> None:
        """LeRobot only logs which weights a file lacks; they would stay random."""
        from safetensors import safe_open

        with safe_open(folder / "model.safetensors", "pt") as file:
            stored = set(file.keys())
        state = self.policy.state_dict()
        places = {state[key].data_ptr() for key in stored & set(state)}
        lacking = [key for key, value in state.items() if key not in stored and value.data_ptr() not in places]
        if lacking:
            raise Refusal(f"{folder}/model.safetensors lacks {len(lacking)} of the policy's weights: {lacking[0]}, …")

    @property
    def inputs(self) -> dict:
        """Feature → its PolicyFeature, less what SmolVLA lists and does not look at."""
        features = self.config.input_features or {}
        if self.kind != "smolvla":
            return dict(features)
        seen = {name for name in features if not name.startswith("observation.images.empty_camera_")}
        return {n: f for n, f in features.items() if n in seen and f.type.value in ("STATE", "VISUAL")}

    @property
    def steps_seen(self) -> list:
        """Frames seen, relative to the anchor: [0], or [-1, 0], …"""
        return list(self.config.observation_delta_indices or [0])

    def predict(self, batch: dict):
        """A batch of observations → actions [B, K, A] in the data set's units, on the CPU."""
        import torch

        self.policy.reset()
        amp = torch.autocast(torch.device(self.config.device).type) if self._amp else contextlib.nullcontext()
        with torch.inference_mode(), amp:
            return self.after(self.policy.predict_action_chunk(self.before(batch))).float().cpu()


# Anchors and observations


def read_anchors(path: Path) -> list:
    """(episode, frame) of each row."""
    import pyarrow.parquet as pq

    try:
        rows = pq.read_table(path, columns=["episode_index", "frame_index"]).to_pydict()
    except Exception as error:
        raise Refusal(f"{path} should be a parquet with episode_index and frame_index: {one_line(error)}") from None
    if not rows["episode_index"]:
        raise Refusal(f"{path} has no rows: there is nothing to predict.")
    return list(zip(rows["episode_index"], rows["frame_index"], strict=True))


def match_features(checkpoint: Checkpoint, data: DataFolder, chosen: dict, copied: dict) -> dict:
    """Feature of the policy → column of the data set, once both have the same width.

    A column is `chosen` by the user, of the same name (or of the one that the checkpoint's own processor renames), or
    what the feature was `copied` from.
    """
    unknown = [name for name in chosen if name not in checkpoint.inputs]
    if unknown:
        raise Refusal(f"The checkpoint has no feature {unknown[0]}; it sees {', '.join(checkpoint.inputs)}.")
    columns = {}
    for name, feature in checkpoint.inputs.items():
        column = chosen.get(name, checkpoint.fed_as.get(name, name))
        if name not in chosen and column not in data.features:
            column = copied.get(column, column)
        if column not in data.features:
            close = difflib.get_close_matches(column, data.features, n=1)
            raise Refusal(
                f"The checkpoint needs {column}, and the data set has none: it has {', '.join(data.features)}."
                + (f" Did you mean {close[0]}?" if close else "")
                + f" To show it another one, say --lerobot-feature {name}=COLUMN."
            )
        # SmolVLA resizes what it gets.
        if data.shape(column) != tuple(feature.shape) and not (checkpoint.kind == "smolvla" and data.is_camera(column)):
            shapes = f"{tuple(feature.shape)}, and here it has {data.shape(column)}"
            raise Refusal(f"The checkpoint was trained with {column} of shape {shapes}.")
        columns[name] = column
    wanted, there = tuple(checkpoint.config.action_feature.shape), data.shape("action")
    if wanted != there:
        raise Refusal(f"The checkpoint's actions have shape {wanted}, and those of the data set {there}.")
    return columns


class Observations:
    """What the policy would have seen at an anchor: only the past, the first frame repeated before an episode's start.

    That is what LeRobot's `select_action` fills its queue with, and what its data loader pads with.
    """

    def __init__(self, data: DataFolder, checkpoint: Checkpoint, columns: dict, episodes: list) -> None:
        self.data, self.columns = data, columns
        self.fed_as, self.seen = checkpoint.fed_as, checkpoint.steps_seen
        # Diffusion's network takes [B, T, …] even for one frame; the others take [B, …].
        self.has_time = checkpoint.kind == "diffusion"
        self.cameras = {column for column in columns.values() if data.is_camera(column)}
        numbers = [column for column in columns.values() if column not in self.cameras]
        self.frames = data.frames(episodes, list(dict.fromkeys(numbers)))
        self.values = {e: {c: _numbers(table[c], c) for c in numbers} for e, table in self.frames.items()}
        self.words = data.tasks()

    def check(self, anchors: list) -> None:
        """Every anchor is a frame that was recorded."""
        for episode, frame in anchors:
            there = self.frames[episode].num_rows if episode in self.frames else 0
            if not 0 <= frame < there:
                raise Refusal(
                    f"The anchor episode {episode}, frame {frame} is not in {self.data.folder}: {there} frames there."
                )

    def batch(self, anchors: list) -> dict:
        """(episode, frame) of B anchors → what the checkpoint's first processor takes."""
        import numpy as np
        import torch

        seen = [(episode, [max(0, frame + step) for step in self.seen]) for episode, frame in anchors]
        batch = {"task": [self._task(episode, frame) for episode, frame in anchors]}
        for name, column in self.columns.items():
            if column in self.cameras:
                values = torch.stack([self._pictures(column, episode, frames) for episode, frames in seen])
            else:
                values = torch.from_numpy(np.stack([self.values[episode][column][frames] for episode, frames in seen]))
            batch[self.fed_as.get(name, name)] = values if self.has_time else values[:, -1]
        return batch

    def _pictures(self, column: str, episode: int, frames: list):
        table = self.frames[episode]
        clock = table["timestamp"] if "timestamp" in table.column_names else None
        seconds = [clock[f].as_py() if clock else f / self.data.fps for f in frames]
        return self.data.pictures(column, episode, frames, seconds)

    def _task(self, episode: int, frame: int) -> str:
        table = self.frames[episode]
        return str(self.words.get(table["task_index"][frame].as_py(), "")) if "task_index" in table.column_names else ""


def _numbers(column, name: str):
    """An Arrow column of numbers, lists or nested lists → [frames, D] float32."""
    import numpy as np

    try:
        return np.asarray(column.to_pylist(), np.float32).reshape(len(column), -1)
    except (ValueError, TypeError):
        raise Refusal(f"{name} should hold numbers, equally many in every frame, and does not.") from None


# The run


def write_predictions(out: Path, checkpoint: Checkpoint, observations: Observations, anchors: list) -> int:
    """Predict at all anchors and write them under a temporary name, then rename; returns K."""
    import pyarrow.parquet as pq

    size = 16 if observations.cameras else 64
    draft = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    rows, writer, chunk = [], None, 0
    try:
        for start in range(0, len(anchors), size):
            some = anchors[start : start + size]
            chunks = checkpoint.predict(observations.batch(some)).numpy()
            chunk = chunks.shape[1]
            rows += zip(some, chunks, strict=True)
            done = start + len(some)
            if len(rows) >= ROWS_AT_ONCE or done == len(anchors):
                table = as_table(rows)
                writer = writer or pq.ParquetWriter(draft, table.schema, compression="zstd")
                writer.write_table(table)
                rows = []
            print(f"progress {done} {len(anchors)}", file=sys.__stdout__, flush=True)
        writer.close()
        draft.replace(out)
        return chunk
    finally:
        draft.unlink(missing_ok=True)


def as_table(rows: list):
    """((episode, frame), chunk [K, A]) … → episode_index, frame_index, action as lists of K lists of A numbers."""
    import numpy as np
    import pyarrow as pa

    chunks = np.stack([chunk for _, chunk in rows])
    anchors, steps, columns = chunks.shape
    numbers = pa.array(chunks.ravel())
    of_steps = pa.ListArray.from_arrays(np.arange(0, anchors * steps * columns + 1, columns, dtype=np.int32), numbers)
    of_anchors = pa.ListArray.from_arrays(np.arange(0, anchors * steps + 1, steps, dtype=np.int32), of_steps)
    keys = np.asarray([anchor for anchor, _ in rows], np.int64)
    return pa.table({"episode_index": keys[:, 0], "frame_index": keys[:, 1], "action": of_anchors})


def load(folder: Path, kind: str, device: str, seed: int) -> Checkpoint:
    """The checkpoint, or a Refusal that names what stands in its way. Seeds torch's generator."""
    try:
        import pyarrow  # noqa: F401  (LeRobot asks for it only with its extras)
        import torch
        from lerobot import __version__
    except ImportError as error:
        raise Refusal(
            f"{sys.executable}: {error}. Install it: pip install 'lerobot[training,diffusion,smolvla]==0.6.1'"
        ) from None
    try:
        torch.zeros(1, device=device)
        checkpoint = Checkpoint(folder, kind, device)
    except Refusal:
        raise
    except Exception as error:  # whatever LeRobot and torch raise of a folder that is not as they wrote it
        raise Refusal(f"LeRobot {__version__} cannot load {folder} on {device}: {one_line(error)}") from None
    torch.manual_seed(seed)
    return checkpoint


def run(options: argparse.Namespace) -> dict:
    """Everything, from parsed arguments to the facts of the last line."""
    folder = find_checkpoint(options.checkpoint)
    kind, trained = check_checkpoint(folder), trained_on(folder)
    data = DataFolder(options.dataset)
    checkpoint = load(folder, kind, options.device, options.seed)
    columns = match_features(checkpoint, data, dict(options.feature), copied_features(trained))
    anchors = read_anchors(options.anchors)
    observations = Observations(data, checkpoint, columns, sorted({episode for episode, _ in anchors}))
    observations.check(anchors)
    from lerobot import __version__

    return {
        "policy_type": kind,
        "chunk": write_predictions(options.out, checkpoint, observations, anchors),
        "observations": list(columns.values()),
        "steps_seen": len(checkpoint.steps_seen),
        **trained,
        "parameters": checkpoint.parameters,
        "lerobot_version": __version__,
    }


def _pair(text: str) -> tuple:
    name, equals, column = text.partition("=")
    if not (name and equals and column):
        raise argparse.ArgumentTypeError(f"{text!r} should be FEATURE=COLUMN")
    return name, column


def main() -> int:
    """The command of the module's docstring; returns its exit code."""
    parser = argparse.ArgumentParser(description="Predict with a LeRobot checkpoint at given frames of a data set.")
    for name in ("checkpoint", "dataset", "anchors", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--feature", type=_pair, action="append", default=[], metavar="FEATURE=COLUMN")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `finally` removes the draft
    try:
        with contextlib.redirect_stdout(sys.stderr):
            facts = run(options)
    except Refusal as refusal:
        print(" ".join(str(refusal).split()), file=sys.stderr)
        return 2
    print(json.dumps(facts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
