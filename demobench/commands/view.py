"""`demobench view`: one episode in Rerun, as it was recorded and as every policy would have done; or a recording's file."""

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from demobench.commands.session import Session, known_target, open_dataset, open_session
from pipeline.errors import ConfigError, NotApplicableError, did_you_mean
from pipeline.experiment import Target, parse_list

NEED_FFMPEG = {"h264", "avc1", "h265", "hevc"}


def view_episode(
    argument: str,
    episode: int | None,
    policy: str | None,
    save: Path | None,
    config_path: Path | None,
    store_path: str | None,
) -> None:
    """One episode with what every up-to-date policy predicted in it (held-out episodes have predictions)."""
    import numpy as np

    from assets_defs.looking import mean_error_floors
    from assets_defs.plan import Plan, Unit
    from pipeline.predict import load_predictions
    from pipeline.sinks import to_rerun

    session = open_session(config_path, store_path)
    if episode is None:
        raise ConfigError(f"Which episode of '{argument}'? Say its number: demobench view {argument} 0")
    target, demos, semantics = _opened(argument, session)
    position = np.flatnonzero(demos.episode_ids == episode)
    if episode in demos.excluded:
        raise ConfigError(
            f"Episode {episode} of '{target.key}' is left out by the configuration (exclude). Take it from the list."
        )
    if not len(position):
        raise ConfigError(
            f"'{target.key}' has no episode {episode}. Its episodes are {demos.episode_ids.min()} to {demos.episode_ids.max()}."
        )
    plan = Plan(session.store, target.key, target.experiment, tuple(target.experiment.variants))
    units = plan.fresh_predictions() if plan.is_fresh(Unit("demonstrations")) else []
    wanted = parse_list(policy)
    names = {u.policy for u in units}
    for name in wanted:
        if name not in names:
            raise ConfigError(
                f"No up-to-date predictions of a policy '{name}' for '{target.key}'. {did_you_mean(name, names)}"
            )
    predictions = [load_predictions(plan.folder(u)) for u in units if not wanted or u.policy in wanted]
    if save is None and not has_screen():
        raise NotApplicableError(
            "There is no screen here for Rerun's viewer to open on. Write the episode to a file, and open it where there is one: "
            f"demobench view {argument} {episode} --save FILE.rrd"
        )
    frames = demos.episode(int(position[0]))
    if not any(len(p.in_frames(frames)) for p in predictions):
        session.console.print(_why_no_predictions(episode, predictions, demos, target, session), soft_wrap=True)
    path = save or session.store.dataset(target.key) / "view.rrd"
    path.parent.mkdir(parents=True, exist_ok=True)
    floors = mean_error_floors(plan) if plan.is_fresh(Unit("multimodality_floor")) else {}
    shown, look = [int(position[0])], {"name": f"{target.key} {episode}", "floors": floors, "everyone": names}
    for why in to_rerun.write_rerun(path, demos, semantics, predictions, shown, **look):
        session.console.print(f"Left out: {why}", soft_wrap=True)
    if not save and _stays_dark(demos):
        session.console.print(
            "The camera stays dark: its pictures are H.264 or H.265, which Rerun's window has ffmpeg decode, and there is none on "
            f"this machine. Install ffmpeg, or look in a browser: rerun --web-viewer --bind 127.0.0.1 {path}",
            soft_wrap=True,
        )
    if save:
        session.console.print(f"Written to {save}. Open it with: rerun --bind 127.0.0.1 {save}", soft_wrap=True)
    elif to_rerun.view(path).returncode:
        raise NotApplicableError(
            "Rerun's viewer could not be opened; what it said is above. Write the episode to a file, and open it elsewhere: "
            f"demobench view {argument} {episode} --save FILE.rrd"
        )


def view_file(path: Path, save: Path | None) -> None:
    """A recording that lies somewhere: `.rrd`, or `.mcap`, of which what is left is recovered where it was cut off."""
    from pipeline.sinks import to_rerun
    from pipeline.sinks.mcap_recovery import is_whole, recover

    if path.suffix == ".rrd" or is_whole(path):
        if save:
            raise ConfigError(
                f"{path} is a whole recording, so there is nothing for --save to write. Copy it where you need it."
            )
    else:
        target = save or path.with_name(f"{path.stem}_recovered.mcap")
        words = recover(path, target)
        Console(highlight=False).print(f"{path} was cut off: {words}. Written to {target}.", soft_wrap=True)
        if save or not has_screen():
            return
        path = target
    if not has_screen():
        raise NotApplicableError(
            f"There is no screen here for Rerun's viewer to open on. Open {path} where there is one: rerun --bind 127.0.0.1 {path}"
        )
    if to_rerun.view(path).returncode:
        raise NotApplicableError(
            f"Rerun's viewer could not open {path}; what it said is above. Any MCAP reader opens an .mcap."
        )


def is_recording(argument: str) -> bool:
    return Path(argument).suffix in (".mcap", ".rrd")


def has_screen() -> bool:
    """Whether a window can be opened: not on a Linux machine without a display."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def _stays_dark(demos: Any) -> bool:
    """Whether Rerun's own window cannot show a camera here; it says so in small letters, and no remedy."""
    codecs = {camera.codec for camera in demos.cameras if camera.present}
    return bool(codecs & NEED_FFMPEG) and shutil.which("ffmpeg") is None


def _opened(argument: str, session: Session) -> tuple[Target, Any, Any]:
    """The data set, with the settings that there are results of: where it has none as it is, and some with one other choice of
    settings, those."""
    target = known_target(argument, session)
    others = _with_results(target, session)
    if target.key not in others and len(others) == 1:
        session.console.print(f"The results of {others[0]}, the only settings that '{argument}' was benchmarked with.")
        argument = others[0]
    return open_dataset(argument, session)


def _with_results(target: Target, session: Session) -> list[str]:
    """The keys under which this data set has a table, whatever its settings."""
    base, store = target.key.split("+")[0], session.store
    keys = [key for key in store.experiments() if key.split("+")[0] == base]
    return [key for key in keys if (store.folder(key, "benchmark_table")).exists()]


def _why_no_predictions(episode: int, predictions: Sequence[Any], demos: Any, target: Target, session: Session) -> str:
    """Why an episode is shown as it was recorded, and nothing more."""
    import numpy as np

    if not predictions:
        others = [key for key in _with_results(target, session) if key != target.key]
        known = f" There are results of {', '.join(others)}." if others else ""
        return f"'{target.key}' has no predictions that are up to date in {session.store.root}; showing the recording alone.{known}"
    anchors = np.concatenate([p.anchors for p in predictions])
    held_out = demos.episode_ids[np.unique(demos.episode_of_frame[anchors])]
    some = ", ".join(map(str, held_out[:10]))
    return f"Episode {episode} was trained on, so no policy was asked about it; held out are {some}{' …' * (len(held_out) > 10)}"
