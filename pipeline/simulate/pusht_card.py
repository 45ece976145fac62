"""The card of a recorded PushT data set: how it was made, in words and numbers that the recording itself produced."""

from pipeline.simulate.recording import Recording


def card(recording: Recording) -> str:
    """README.md for the data set's folder."""
    anticlockwise, clockwise = recording.episodes_by_strategy
    return _CARD.format(**recording.as_dict(), **recording.words(), anticlockwise=anticlockwise, clockwise=clockwise)


_CARD = """---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, PushT, simulated]
---
# PushT, demonstrated by a planner

**Simulated.** {episodes} demonstrations, {frames:,} frames at 10 Hz, in LeRobot v3.0 format: a round finger pushes a
T-shaped block onto its outline on a table of 512 × 512 px. No person and no robot took part.

Made by `demobench record pusht OUT --episodes {episodes} --seed {seed}` with {made_with}.
The same command with the same versions makes the same content again; another version of the physics makes other
demonstrations.

| | |
|---|---|
| attempts | {attempts}, from start states `PushTEnv.reset(seed=n)`, {starts} |
| success of the demonstrator | {success} |
| frames an episode | {frames_shortest} … {frames_longest}, median {frames_median:g} |
| episodes by strategy | {anticlockwise} anticlockwise (0), {clockwise} clockwise (1) |

## How the demonstrator works
It tries straight pushes against a dozen places on the block in a second environment that it keeps for the purpose,
judges each by where it leaves the block, by the frames it takes and by the best push that could follow, carries the
best one out, and chooses again. Its hand is unsteady: a drifting error is added to where it aims, more on the way to a
push than while pushing. The recorded actions are the ones that were carried out: replayed from the same start state
they give the same frames.

**Two strategies**, drawn for each episode: to reach another side of the block, it prefers to walk around it clockwise
or anticlockwise (as the table is usually drawn, y downwards), unless that is half as long again as the other way. So
one observation can have two answers. The column `strategy` tells which was the episode's.

An episode ends when more than 95 % of the outline is covered, at most 300 steps after it began.

## Columns
| key | what it is |
|---|---|
| `observation.state` | finger: x_px, y_px |
| `observation.environment_state` | block: block_x_px, block_y_px, block_angle_rad (0 … 2π, wraps) |
| `action` | where the finger is told to go: x_px, y_px; at a frame's own observation |
| `next.coverage` | share of the outline that is covered after the action |
| `next.reward` | min(1, coverage / 0.95) |
| `next.success` | coverage above 0.95 |
| `next.done` | true at the last frame of an episode |
| `strategy` | 0 anticlockwise, 1 clockwise; hidden from policies unless they are given it |

The last frame of an episode shows the success; nothing was carried out there, and its action and `next.*` repeat those
of the frame before.
"""
