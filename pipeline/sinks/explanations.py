"""The page's sentences: what was measured, on what, how, and how to make it again.

What belongs here: wording, from the table's own fields. What does not: HTML, and any claim that the table does not
carry.
"""

import shlex
from collections.abc import Mapping
from typing import Any

from pipeline.sinks.findings import (
    NOT_HELD,
    STEPPED_IN,
    capital,
    deadline_words,
    driven_words,
    elsewhere_words,
    excluded_words,
    families_words,
    family,
    first_step_gap,
    name_in,
    not_held,
    stopped_words,
    success_words,
    without_floor,
)
from pipeline.sinks.markup import element
from pipeline.sinks.palette import is_baseline
from pipeline.sinks.words import common_unit, is_number, plural, show

Table = Mapping[str, Any]
WHOLE_CHUNK = (
    "The mean over all steps of the chunk. Longer chunks look further, so never compare it across chunk sizes."
)


def facts(table: Table) -> list[list[str]]:
    """Two lines under the title, in parts: the data; the settings that the numbers depend on."""
    data, folds = table["dataset"], table["split"]["folds"]
    units = ", ".join(dict.fromkeys(unit or "unit unknown" for unit in data["action_units"]))
    kinds = ", ".join(dict.fromkeys(data["action_kinds"]))
    held_out = len({episode for fold in folds for episode in fold["test"]})
    lines = [
        [
            plural(data["episodes"], "episode"), plural(data["frames"], "frame"), f"{data['fps']:g} fps",
            f"{plural(len(data['action_names']), 'action column')} ({kinds}; {units})",
            f"revision {data['revision'][:12]}" if data["revision"] else "no revision",
            f"content {data['content_hash'][:12]}", *filter(None, [excluded_words(table)]),
        ],
        [
            f"protocol {table['protocol']}", f"budget {budget_words(table)}", plural(len(folds), "fold"),
            f"{plural(held_out, 'episode')} held out", f"split {table['split']['hash'][:12]}",
        ],
    ]  # fmt: skip
    return lines


def budget_words(table: Table) -> str:
    """`quick (5 seeds × 600 steps)`, and how many policies have a budget of their own."""
    budget = table["budget"]
    steps = f"{plural(budget['seeds'], 'seed')} × {plural(budget['steps'], 'step')}"
    own = budget.get("own", {})
    said = f"{budget['name']} ({steps})" if budget["name"] else steps
    if not own:
        return said
    have = f"{len(own)} policies have budgets" if len(own) > 1 else f"{next(iter(own))} has a budget"
    return f"{said}, {have} of {'their' if len(own) > 1 else 'its'} own: {', '.join(dict.fromkeys(own.values()))}"


def own_budgets(table: Table) -> dict[str, str]:
    """Which policies have a budget of their own, by budget; empty where none has."""
    named: dict[str, list[str]] = {}
    for policy, words in table["budget"].get("own", {}).items():
        named.setdefault(words, []).append(policy)
    if not named:
        return {}
    rest = budget_words({"budget": table["budget"] | {"own": {}}})
    said = "; ".join(f"{words}: {', '.join(policies)}" for words, policies in named.items())
    return {"Budgets": f"{said}. All others: {rest}."}


def notes(table: Table) -> list[str]:
    """What stands directly under the table: whatever a reader could take wrongly without it."""
    found = []
    intervals = [row for row in table["policies"] if (row.get("interval") or {}).get("first_step_mae")]
    if intervals:
        found.append("The small pictures share one axis from zero; what does not fit on it lies to the right.")
    else:
        found.append("No intervals: they need at least five held-out episodes.")
    unit = common_unit(table["dataset"]["action_units"])
    if unit is None:
        found.append("The data set does not state the unit of its actions.")
    if unit == "mixed units":
        found.append(
            "Action columns have different units, so read “scaled”; a mean over them in raw numbers says little."
        )
    if not any(row["rollouts"] or row.get("no_rollouts") for row in table["policies"]):
        found.append("Closed loop: no simulator for this data set.")
    driven = (*driven_words(table), *stopped_words(table), *deadline_words(table))
    found += [f"{capital(words)}." for words in (*driven, *elsewhere_words(table))]
    found += _tested(table)
    if not_held(table):
        found.append(f"{capital(NOT_HELD)}.")
    radius = table["floor"].get("radius")
    if radius and is_number(radius["mean"]):
        found.append(_floor_words(radius))
    return found


def _driven(table: Table) -> str:
    """Whom the words under a success rate are against."""
    found = table.get("closed_loop")
    if not found or not found["comparisons"]:
        return ""
    best = "" if found["chosen"] == "champion" else ", which does best there"
    return f" Those under a success rate are against {name_in(table, found['reference'])} in closed loop{best}."


def _tested(table: Table) -> list[str]:
    """What the words in the table rest on, and what is not tested at all."""
    said = []
    if any(row["verdict"]["vs_hold_still"] for row in table["policies"]):
        said.append(
            f"The words under an error are tests against hold-still at the same horizon: {families_words(table)}"
            f"{_driven(table)} The order of the other rows is not tested here; demobench compare tests any two of them, or all "
            "pairs."
        )
    else:
        said.append("No difference between policies is tested here; where intervals overlap the order may be chance.")
    if not any(first_step_gap(row) for row in table["policies"]):
        return said
    absent = [name for name in without_floor(table) if any(row["observations"] == name for row in table["policies"])]
    if absent:
        said.append(
            f"“Above floor” is empty where no floor could be given (seeing {', '.join(absent)}): the reasons are below."
        )
    more = [row["policy"] for row in table["policies"] if row["observations"] not in absent and not first_step_gap(row)]
    if more := [name for name in dict.fromkeys(more) if is_baseline(name)]:
        sees = "sees" if len(more) == 1 else "see"
        said.append(f"“Above floor” is empty for {' and '.join(more)}, which {sees} more than the set beside the name.")
    return said


def _floor_words(radius: Mapping[str, Any]) -> str:
    unit = f" {radius['unit']}" if radius.get("unit") else ""
    return (
        f"Radius floor on {radius.get('observations', 'the state')}, as the notebook that this project grew from takes "
        f"it (biased, kept for comparison): mean distance {show(radius['mean'])}{unit}, 90th percentile "
        f"{show(radius['p90'])}{unit}, {plural(radius['probes'], 'probe')}, median group "
        f"{show(radius['median_neighbours'], 0)} frames. It is an L2 distance: no bound on a mean absolute error."
    )


def numbers(table: Table, history: int) -> dict[str, str]:
    """How each number was made, under the protocol that made it."""
    protocol = _notebook if table["protocol"] == "notebook" else _strict
    return protocol(table, history) | _common(table) | own_budgets(table)


def _strict(table: Table, history: int) -> dict[str, str]:
    second = round(table["dataset"]["fps"])
    return {
        "Held-out frames": (
            f"Whole episodes are held out. Every frame with {plural(history, 'frame')} of history is an anchor; all "
            "policies answer at the same ones. Steps past the end of an episode count nowhere."
        ),
        "First-step MAE": (
            "|predicted − recorded| of the action at the anchor's own frame, averaged over action columns, over the "
            "anchors of an episode, over held-out episodes (each counts once) and over seeds. Angles are compared "
            "around the circle."
        ),
        "95 % interval": _interval_words(table),
        "RMSE": "The root of the mean over episodes of the squared first-step error, averaged over action columns.",
        "At one second": f"The same error {plural(second, 'step')} ahead; empty where a chunk is shorter.",
        "Whole chunk": WHOLE_CHUNK,
        "Normalising": "Means and deviations come from training episodes only.",
    }


def _notebook(table: Table, history: int) -> dict[str, str]:
    second = round(table["dataset"]["fps"])
    return {
        "Protocol": (
            "“notebook” reproduces the published numbers of the notebook that this project grew from, and shares their "
            "weaknesses: normalisation has seen the held-out episodes, each chunk size is scored on its own windows, "
            "and frames rather than episodes are averaged. The default is “strict”."
        ),
        "First-step MAE": (
            "|predicted − recorded| of the first action, averaged over action columns, over held-out windows and "
            "over seeds."
        ),
        "95 % interval": f"{_interval_words(table)} Here an episode counts by its windows.",
        "RMSE": "The root of the mean squared first-step error, averaged over action columns.",
        "At one second": f"The same error {plural(second, 'step')} ahead; empty where a chunk is shorter.",
        "Whole chunk": WHOLE_CHUNK,
    }


def _interval_words(table: Table) -> str:
    folds = len(table["split"]["folds"])
    given = f"these {folds} folds" if folds > 1 else "this training set"
    return (
        "Bootstrap-t: whole held-out episodes are drawn again and again, so that frames of one episode do not pass for "
        f"independent ones. From 5 to 7 episodes a t interval, below 5 none. What training seeds differ by is joined to it. "
        f"It holds for {given}; how much other training data would move the number is not in it."
    )


def _verdict_words(table: Table) -> str:
    together = (
        f"the {plural(number, 'comparison')} of this page" if (number := family(table)) > 1 else "all comparisons"
    )
    return (
        "Both policies are asked at the same held-out frames. The difference must stand out in two tests: turning the sign "
        "of each episode's difference at random, and a t test over episodes and training seeds; the larger p counts. Holm's "
        f"correction over {together} keeps the chance of even one false verdict at 5 % at most. “Cannot tell” comes with "
        "what would be needed; below five held-out episodes nothing is tested."
    )


def _floors(table: Table) -> dict[str, str]:
    """What floors are made of, assume, and when they are refused."""
    from pipeline.statistics.floors import FEWEST_EPISODES, JUMPY, MOST_EXPLAINED, MOST_REMOVED, NEAREST

    refused = (
        f"Refused where extrapolation would take away more than {100 * MOST_REMOVED:.0f} %, where the regression leaves more "
        f"than {1 / (1 - MOST_EXPLAINED):.0f} times the estimate on held-out episodes, and below {FEWEST_EPISODES} episodes."
    )
    return {
        "Floor in RMSE (gamma)": (
            "A regression that saw neither of two episodes takes away what it can explain. For each held-out state follows the "
            f"nearest frame of each of the {NEAREST} nearest other episodes: half the mean squared difference of what is left "
            "of their actions, extrapolated to states that do not differ (Evans & Jones 2002). Where the mean action may jump, "
            f"as of a gripper that closes, and the jump could be {100 * JUMPY:.0f} % of the estimate, it is refused. {refused}"
        ),
        "Floor in MAE and L2 (pair distance)": (
            "How far the actions of two people in the same place are apart, extrapolated likewise. The floor lies between "
            f"half of that and all of it, whatever the distribution; no single number is claimed. {refused}"
        ),
        "Best policy, above floor": (
            "The best policy is chosen on other held-out episodes than those whose error is shown, so choosing does not "
            "flatter it. An episode moves the error and the floor together: the interval of what lies between is over "
            "episodes of both at once. A policy significantly below a floor refutes it, and the floor is then withdrawn."
        ),
    }


def _common(table: Table) -> dict[str, str]:
    entries = {
        "× hold-still": (
            "Hold-still's first-step error over the policy's: 2 means half the error. Hold-still repeats the state "
            "(positions), or zero (velocities, differences), or else the previous action."
        ),
        "Scaled": "Error over the training actions' standard deviation, averaged over columns that move.",
    }
    if table["comparisons"]:
        entries["Better, worse, cannot tell"] = _verdict_words(table)
    if table["brackets"]:
        entries |= _floors(table)
    if words := success_words(table):
        entries["Success and score"] = (
            f"From numbered start states, the same for every policy: {words}. Of several seeds the rate is the mean over them and "
            "over start states; its interval, like every interval of a score, is by bootstrap-t over start states, with what "
            "seeds vary by. Where all start states give the same, it is what so many that are alike make sure. The score is the "
            "mean over start states of the best reward of the episode, from 0 to 1. The safety layer "
            f"passes on what keeps the robot's limits, whatever a policy asks for; where it stepped in, {STEPPED_IN}, by "
            "so much on average. It stops an episode where an action is not finite, or as the configuration says."
        )
    entries["Cost"] = (
        "Parameters of one network; training seconds of all seeds and folds together; latency of one call, "
        "median and 99th percentile, measured on the machine that made this page. A policy misses its deadline where the latter "
        "is longer than the actions last that it carries out of a chunk (or than the delay that its roll-outs reckon with)."
    )
    return entries


def identity(table: Table, version: str, made_at: str) -> dict[str, str]:
    """Every hash in full, and what made the page."""
    data = table["dataset"]
    entries = {
        "Data set": data["name"],
        "Revision": data["revision"] or "none (not from the Hub)",
        "Content hash": data["content_hash"],
        "Split hash": table["split"]["hash"],
        "Made by": f"demobench {version}",
    }
    return entries | ({"Made at": made_at} if made_at else {})


def files(table: Table) -> dict[str, str]:
    """How to open what was written beside the page."""
    commands = {
        "rerun": ("Held-out episodes in Rerun", lambda at: f"rerun --bind 127.0.0.1 {shlex.quote(at)}"),
        "mcap": (
            "Held-out episodes as ROS 2 messages",
            lambda at: f"{at} (opens in Foxglove, PlotJuggler, Rerun, rosbags)",
        ),
        "mlflow": ("Metrics and models", lambda at: f"{at} (demobench ui)"),
        "history": ("Every table so far, and who is champion", lambda at: element("a", "the history", href=at)),
    }
    found = {key: table["artifacts"].get(key) for key in commands}
    return {commands[key][0]: commands[key][1](str(at)) for key, at in found.items() if at}
