"""The page's videos of roll-outs, inside the page like everything else.

What belongs here: their section. What does not: making a video (`rollout_video`), the page's policy of what may load (`report`).
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.sinks.markup import Html, element
from pipeline.sinks.rollout_video import Video


@dataclass(frozen=True)
class Clip:
    """A video for the page, its file and its last frame as a picture."""

    video: Video
    mp4: Path
    poster: Path


def video_section(clips: Sequence[Clip], left_out: Mapping[str, str]) -> Html | None:
    """A video an observation set, and why one is missing; None where the data set's simulator has none."""
    if not clips and not left_out:
        return None
    why = [element("p", f"No video of {name}: {reason}") for name, reason in left_out.items()]
    said = "For each observation set the policy that does best in closed loop, from the first start states: none was picked."
    best_first = sorted(clips, key=lambda clip: -clip.video.succeeded / len(clip.video.start_states))
    return element(
        "section",
        element("h2", "What does it look like when the best policy drives by itself?"),
        element("p", said) if clips else None,
        element("div", [_clip(clip) for clip in best_first], class_="clips"),
        why,
    )


def _clip(clip: Clip) -> Html:
    video = element(
        "video", controls=True, muted=True, playsinline=True, loop=True, preload="metadata", width=clip.video.width,
        height=clip.video.height, poster=_inline("image/png", clip.poster), src=_inline("video/mp4", clip.mp4),
        aria_label=clip.video.caption,
    )  # fmt: skip
    return element("figure", video, element("p", clip.video.caption))


def _inline(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
