"""What LeRobot itself makes of a data set and of a checkpoint, written to a .npz. Run by the Python that has LeRobot.

    python beside_lerobot.py read FOLDER OUT.npz
    python beside_lerobot.py online  CHECKPOINT FOLDER EPISODE:FRAME,… OUT.npz    one anchor at a time, by select_action
    python beside_lerobot.py loader  CHECKPOINT FOLDER EPISODE:FRAME,… OUT.npz    one batch of the trainer's data loader

Nothing here is shared with the project's own script, whose answers it checks.
"""

import json
import sys

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class, make_pre_post_processors


def read(folder, out):
    data = LeRobotDataset("made/small", root=folder)
    items = [data[i] for i in range(len(data))]
    keys = [key for key, value in items[0].items() if isinstance(value, torch.Tensor)]
    columns = {key: np.stack([item[key].numpy() for item in items]) for key in keys}
    columns["task"] = np.array([item["task"] for item in items])
    rows = [data.meta.episodes[e] for e in range(data.num_episodes)]
    columns["bounds"] = np.array([[row["dataset_from_index"], row["dataset_to_index"]] for row in rows])
    stats = {key: {name: np.asarray(v).tolist() for name, v in block.items()} for key, block in data.meta.stats.items()}
    held = LeRobotDataset("made/small", root=folder, episodes=[1, 3])
    columns["of_two"] = np.array(
        [[int(held[i]["episode_index"]), int(held[i]["frame_index"])] for i in range(len(held))]
    )
    facts = {"fps": data.fps, "episodes": data.num_episodes, "frames": data.num_frames, "stats": stats}
    np.savez(out, facts=json.dumps(facts), **columns)


def load(checkpoint):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_backbone_weights = None
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    return config, policy, *make_pre_post_processors(config, pretrained_path=checkpoint)


def observation(item):
    return {key: value for key, value in item.items() if key.startswith("observation.")} | {"task": item["task"]}


def online(checkpoint, folder, anchors, out):
    config, policy, before, after = load(checkpoint)
    data = LeRobotDataset("made/small", root=folder)
    chunks = []
    for episode, frame in anchors:
        policy.reset()
        torch.manual_seed(0)
        start = data.meta.episodes[episode]["dataset_from_index"]
        item = data[start + frame]
        chunks.append(
            [after(policy.select_action(before(observation(item))))[0].numpy() for _ in range(config.n_action_steps)]
        )
    np.savez(out, actions=np.array(chunks))


def loader(checkpoint, folder, anchors, out):
    config, policy, before, after = load(checkpoint)
    stamps = resolve_delta_timestamps(config, LeRobotDatasetMetadata("made/small", root=folder))
    data = LeRobotDataset("made/small", root=folder, delta_timestamps=stamps)
    items = [data[data.meta.episodes[episode]["dataset_from_index"] + frame] for episode, frame in anchors]
    batch = torch.utils.data.default_collate([observation(item) for item in items])
    torch.manual_seed(0)
    np.savez(out, actions=after(policy.predict_action_chunk(before(batch))).numpy())


if __name__ == "__main__":
    what, *words = sys.argv[1:]
    if what == "read":
        read(*words)
    else:
        where = [tuple(map(int, pair.split(":"))) for pair in words[2].split(",")]
        {"online": online, "loader": loader}[what](words[0], words[1], where, words[3])
