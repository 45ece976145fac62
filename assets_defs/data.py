"""The first assets: demonstrations at a pinned revision, the split by episode, and the windows cut from it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import dagster as dg

from assets_defs.plan import Unit
from assets_defs.resources import Bench, Budget, Outcome, Workbench, check_spec, code_version, result, warning_spec
from assets_defs.show import picture, present, table
from pipeline.inspection.finding import CHECKS

PARTITIONS = dg.DynamicPartitionsDefinition(name="datasets")
GROUP = "data"


def key(name: str) -> dg.AssetKey:
    return dg.AssetKey([name])


@dg.asset(
    partitions_def=PARTITIONS,
    group_name=GROUP,
    kinds={"lerobot", "parquet"},
    code_version=code_version("demonstrations"),
    check_specs=[
        check_spec(
            key("demonstrations"), "stored_as_read", "What lies in the store has the content hash of what was read."
        ),
        check_spec(key("demonstrations"), "counts", "Every episode has frames, and they add up to the whole."),
        *(warning_spec(key("demonstrations"), name, words) for name, words in CHECKS.items()),
    ],
)
def demonstrations(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """What people showed the robot: every episode of a LeRobot data set, read at a pinned revision.

    One array a feature, episodes one after another. The content hash is the data set's identity: everything that is
    computed from it carries this hash, so two results can be compared only when it is the same.
    """
    bench = workbench.open(context, budget, look_at_source=True)
    asked = bench.plan.asked_of_source()
    unit = Unit("demonstrations")
    made = bench.make(
        unit, lambda draft: _read(bench, asked, draft), fingerprint=lambda outcome: outcome.summary["fingerprint"]
    )
    facts = made.summary["inspect"]
    metadata = {
        "episodes": facts["episodes"],
        "frames": facts["frames"],
        "fps": facts["fps"],
        "content_hash": facts["content_hash"],
        "revision": facts["revision"],
        "actions": table(
            ["action", "unit", "kind", "tracking lag"],
            zip(
                facts["action_names"], facts["action_units"], facts["action_kinds"], facts["tracking_lag"], strict=True
            ),
        ),
        "trajectories": picture(bench.plan.folder(unit) / "trajectories.png"),
        "warnings": dg.MetadataValue.md("\n".join(f"- {w}" for w in facts["warnings"])) if facts["warnings"] else None,
        "look_at_first": table(
            ["episode", "why", "command"],
            [(one["episode"], " ".join(one["reasons"]), one["command"]) for one in facts["look_at"]],
        ),
        "worth_leaving_out": facts["exclude_line"] or None,
    }
    checks = ["stored_as_read", "counts"]
    return result(bench, key("demonstrations"), {"": made}, present(metadata), checks, warnings=tuple(CHECKS))


def _read(bench: Bench, asked: Mapping[str, Any], draft: Path) -> Outcome:
    """Read the source, look for what is wrong with it, and keep it; `asked` is what made the reading necessary."""
    from pipeline.config import hash_of
    from pipeline.inspection.look import inspect
    from pipeline.inspection.videos import local_folder
    from pipeline.lerobot_format.quality import inspect_dataset
    from pipeline.lerobot_format.read import load_experiment
    from pipeline.lerobot_format.saved import save_demonstrations
    from pipeline.sinks.pictures import picture_demonstration

    demos, semantics = load_experiment(bench.experiment, bench.workbench.config_dir)
    save_demonstrations(demos, draft / "frames")
    picture_demonstration(demos, semantics, draft / "trajectories.png")
    stored = hash_again(draft / "frames")
    units = bench.experiment.dataset.units  # what names say is in the content; what the user says is not
    meaning = [semantics.kinds, {k: list(v) for k, v in semantics.circular.items()}, *([units] if units else [])]
    shortest = int(demos.lengths.min())
    found = inspect(demos, semantics, local_folder(bench.experiment.dataset.source, bench.workbench.config_dir))
    facts = inspect_dataset(demos, semantics) | found.as_json(bench.plan.key)
    return Outcome(
        {"asked": asked, "inspect": facts, "fingerprint": hash_of([stored, meaning])},
        {
            **{name: found.verdict(name) for name in CHECKS},
            "stored_as_read": (stored == demos.content_hash, f"content hash {stored[:16]}"),
            "counts": (
                shortest > 0 and int(demos.lengths.sum()) == demos.frames,
                f"{demos.episodes} episodes, {demos.frames:,} frames, the shortest {shortest}",
            ),
        },
    )


def hash_again(folder: Path) -> str:
    """The content hash of demonstrations as they lie in the store."""
    from pipeline.lerobot_format.saved import hash_demonstrations, load_demonstrations

    stored = load_demonstrations(folder)
    arrays = {name: getattr(stored, name) for name in ("episode_starts", "episode_ids", "timestamps", "tasks", "fps")}
    return hash_demonstrations(stored.columns, stored.features, **arrays)


@dg.asset(
    partitions_def=PARTITIONS,
    group_name=GROUP,
    kinds={"json"},
    deps=[demonstrations],
    code_version=code_version("episode_split"),
    check_specs=[
        check_spec(key("episode_split"), "no_leakage", "No episode both trains and tests in one fold."),
        check_spec(key("episode_split"), "held_out", "Every fold holds out at least one episode and trains on one."),
    ],
)
def episode_split(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """Which episodes train and which are held out. The unit is the episode: its frames are never on both sides.

    Below 100 episodes there are five folds, so that every episode is held out once; from 100 on there is one.
    """
    bench = workbench.open(context, budget)

    def split(draft):
        from pipeline.folds import split_of
        from pipeline.split import save_split

        made = split_of(bench.experiment, bench.demonstrations)
        save_split(made, draft / "split.json")
        shared = sum(len(set(f.train) & set(f.test)) for f in made.folds)
        sizes = [(len(f.train), len(f.test)) for f in made.folds]
        return Outcome(
            {"hash": made.hash, "sizes": sizes},
            {
                "no_leakage": (shared == 0, f"{shared} episodes on both sides"),
                "held_out": (
                    all(min(s) > 0 for s in sizes),
                    f"{len(sizes)} fold(s), {min(s[1] for s in sizes)} held out",
                ),
            },
        )

    made = bench.make(Unit("episode_split"), split)
    metadata = {
        "folds": len(made.summary["sizes"]),
        "hash": made.summary["hash"],
        "episodes": table(["fold", "train", "test"], [(i, *s) for i, s in enumerate(made.summary["sizes"])]),
    }
    return result(bench, key("episode_split"), {"": made}, metadata, ["no_leakage", "held_out"])


@dg.asset(
    partitions_def=PARTITIONS,
    group_name=GROUP,
    kinds={"numpy"},
    deps=[demonstrations, episode_split],
    code_version=code_version("windows"),
    check_specs=[
        check_spec(key("windows"), "counts", "Every fold has windows to train on and to be scored on."),
        check_spec(key("windows"), "finite_statistics", "The training statistics are finite, and no scale is zero."),
    ],
)
def windows(
    context: dg.AssetExecutionContext, workbench: dg.ResourceParam[Workbench], budget: Budget
) -> dg.MaterializeResult:
    """Where policies are asked: one anchor a frame, with its history before it and its targets after it.

    Windows are indices, never copied frames. The statistics that normalise them come from training episodes only.
    """
    bench = workbench.open(context, budget)

    def cut(draft):
        from pipeline.folds import describe_windows

        longest = int(bench.demonstrations.lengths.max()) - bench.experiment.history + 1
        variants = [v for v in bench.plan.variants if budget.asks_for(v) or (v.chunk or 1) <= longest]
        described = describe_windows(bench.demonstrations, bench.semantics, bench.split, bench.experiment, variants)
        (draft / "windows.json").write_text(json.dumps(described, indent=1))
        rows = described["windows"]
        smallest = min(min(row["train"], row["test"]) for row in rows)
        return Outcome(
            described,
            {
                "counts": (smallest > 0, f"the smallest part has {smallest:,} windows"),
                "finite_statistics": (described["statistics_finite"], "mean and scale of every training column"),
            },
        )

    made = bench.make(Unit("windows"), cut)
    rows = made.summary["windows"]
    metadata = {
        "windows": table(
            ["chunk", "fold", "train", "test", "memory if copied, MB"],
            [(r["chunk"], r["fold"], r["train"], r["test"], r["copied_mb"]) for r in rows],
        ),
        "dead_columns": ", ".join(made.summary["dead_columns"]) or "none",
    }
    return result(bench, key("windows"), {"": made}, metadata, ["counts", "finite_statistics"])


ASSETS = [demonstrations, episode_split, windows]
