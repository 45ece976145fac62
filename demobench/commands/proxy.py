"""`demobench proxy`: does a smaller offline error mean more success? Over the checkpoints that the store holds of a data set.

What belongs here: which networks of the store are compared, what is left out and why, and the tables. What does not: the offline
scores (`pipeline.offline_scores`), correlations and the answer (`pipeline.statistics.agreement`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import Session, open_session, stored_plan, write_json_to
from demobench.commands.trained import Found, trained_in
from pipeline.errors import ConfigError, StoreError
from pipeline.experiment import parse_chunks, parse_list
from pipeline.store import Store

if TYPE_CHECKING:
    from assets_defs.plan import Plan
    from pipeline.statistics.agreement import Agreement, Answer, Checkpoint
    from pipeline.types import Predictions, Rollouts

COLOURS = {"yes": "green", "no": "red", "cannot tell": "yellow"}
TITLES = {"success": "success rate", "score": "mean best reward"}


@dataclass
class Gathered:
    """The checkpoints of one data set, and what was left out.

    near        [N] bool, the frames near contact; else why they are not known
    simulator   its versions, the same for all checkpoints
    starts      the start states of every checkpoint
    """

    key: str
    content_hash: str
    split_hash: str
    near: np.ndarray | str
    simulator: str | None = None
    checkpoints: "list[Checkpoint]" = field(default_factory=list)
    starts: list[np.ndarray] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)

    @property
    def same_starts(self) -> bool:
        return all(np.array_equal(one, self.starts[0]) for one in self.starts)


def run_proxy(
    datasets: Sequence[str],
    *,
    observations: str | None,
    chunks: str | None,
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Correlate offline scores with closed-loop results on each data set; with two, name a score on one and test it on the other.

    Raises
    ------
    ConfigError : other than one or two data sets, or the same twice.
    StoreError : nothing of a data set was made yet.
    """
    from pipeline.offline_scores import SCORES
    from pipeline.statistics.agreement import TARGETS, agreements, answer

    if not 1 <= len(datasets) <= 2 or len(set(datasets)) < len(datasets):
        raise ConfigError(
            "Name one data set, or two different ones: a score is named on the first and tested on the second. "
            f"Got {len(datasets)}: {', '.join(datasets)}."
        )
    session = open_session(config_path, store_path, json_to)
    wanted = (parse_list(observations), parse_chunks(chunks))
    found = [_gather(stored_plan(name, session), session, *wanted) for name in datasets]
    if len({one.content_hash for one in found}) < len(found):
        raise ConfigError(
            f"{' and '.join(datasets)} are the same demonstrations. Test on another data set than the one named on."
        )
    said = [{target: agreements(one.checkpoints, list(SCORES), target) for target in TARGETS} for one in found]
    answers = []
    if len(found) == 2:
        answers = [answer(said[0][t], said[1][t], found[1].checkpoints, SCORES) for t in TARGETS]
    if json_to != "-":
        for one, agreed in zip(found, said, strict=True):
            _show(one, agreed, session.console)
        _show_answers(answers, found, said, session.console)
    write_json_to(
        json_to,
        {
            "data_sets": [_as_json(one, agreed) for one, agreed in zip(found, said, strict=True)],
            "answers": [asdict(one) for one in answers],
        },
    )


# From the store to checkpoints ----------------------------------------------------------------------------------------


def _gather(plan: "Plan", session: Session, sets: Sequence[str], chunks: Sequence[int]) -> Gathered:
    """Every network of a data set that was scored and rolled out, of all experiments in the store on the same data and split."""
    from pipeline.offline_scores import near_contact

    plan.experiment.require_sets(sets)
    found = [network for one in _experiments(plan, session) for network in trained_in(one)]
    if not found:
        raise StoreError(
            f"There are no up-to-date trained policies of '{plan.key}' in {session.store.root}. Make them with: "
            f"demobench run {plan.key}"
        )
    near = near_contact(found[0].task.demos, found[0].task.semantics)
    gathered = Gathered(plan.key, *_hashes(session.store, plan.key), near)
    for network in found:
        seen, chunk = network.task.observation_set.name, network.variant.chunk
        if (not sets or seen in sets) and (not chunks or chunk in chunks):
            with session.console.status(f"Scoring {escape(_address(network))}"):
                _add(gathered, network)
    return gathered


def _experiments(plan: "Plan", session: Session) -> "Iterator[Plan]":
    """The experiment that was named, then every other on the same data, split, protocol and history."""
    yield plan
    here = _hashes(session.store, plan.key)
    for key in session.store.experiments():
        if key != plan.key and _hashes(session.store, key) == here:
            other = stored_plan(key, session)
            asked = [(one.experiment.protocol, one.experiment.history) for one in (plan, other)]
            if asked[0] == asked[1]:
                yield other


def _hashes(store: Store, key: str) -> tuple[str, str]:
    """Of the demonstrations and the split that an experiment's results rest on; empty where there are none yet."""
    demos, split = (store.made(store.folder(key, asset)) for asset in ("demonstrations", "episode_split"))
    return demos.summary["inspect"]["content_hash"] if demos else "", split.summary["hash"] if split else ""


def _address(network: Found) -> str:
    return f"{network.plan.key}/{network.variant.name}/{network.task.observation_set.name}"


def _add(gathered: Gathered, network: Found) -> None:
    """The checkpoints of one policy with one observation set, a seed each, or why it has none."""
    from pipeline.offline_scores import drawing, offline_scores

    stored = _stored(network)
    if isinstance(stored, str):
        gathered.left_out.append({"what": _address(network), "why": stored})
        return
    predicted, rolled = stored
    near = None if isinstance(gathered.near, str) else gathered.near
    draw = drawing(network.task, network.folder)
    scores = offline_scores(network.task, predicted, rolled[0].execution, near, draw)
    for one in rolled:
        if why := _why_not(gathered, network, predicted, one):
            gathered.left_out.append({"what": f"{_address(network)}, seed {one.seed}", "why": why})
            continue
        at = predicted.seeds.index(one.seed)
        offline = {name: float(values[at]) for name, values in scores.items()}
        gathered.checkpoints.append(_checkpoint(network, one, offline))
        gathered.starts.append(one.start_states)
        gathered.simulator = one.simulator_version


def _stored(network: Found) -> "tuple[Predictions, list[Rollouts]] | str":
    """What the store holds of a policy, or what is missing."""
    from assets_defs.plan import Unit
    from pipeline.predict import load_predictions
    from pipeline.simulate.trial import load_rollouts

    plan, seen = network.plan, network.task.observation_set.name
    predictions, rollouts = (Unit(f"{network.variant.name}/{kind}", seen) for kind in ("predictions", "rollouts"))
    if not plan.is_fresh(predictions):
        return "no up-to-date predictions"
    if not plan.is_fresh(rollouts):
        return "no up-to-date roll-outs"
    why = plan.store.made(plan.folder(rollouts)).summary["why_not"]
    return why or (load_predictions(plan.folder(predictions)), load_rollouts(plan.folder(rollouts)))


def _why_not(gathered: Gathered, network: Found, predicted: "Predictions", one: "Rollouts") -> str | None:
    """What keeps a network from counting as a checkpoint of its own."""
    if gathered.simulator not in (None, one.simulator_version):
        return f"rolled out in another version of the simulator ({one.simulator_version}, not {gathered.simulator})"
    name, seen = network.variant.name, network.task.observation_set.name
    if any((c.policy, c.observations, c.seed) == (name, seen, one.seed) for c in gathered.checkpoints):
        return "an experiment before it has this policy and seed already"
    at = predicted.seeds.index(one.seed)
    twin = next((s for s in range(at) if np.array_equal(predicted.actions[s], predicted.actions[at])), None)
    return None if twin is None else f"it answers as seed {predicted.seeds[twin]} does"


def _checkpoint(network: Found, one: "Rollouts", offline: Mapping[str, float]) -> "Checkpoint":
    from pipeline.statistics.agreement import Checkpoint

    variant = network.variant
    return Checkpoint(
        method=variant.method, policy=variant.name, observations=network.task.observation_set.name,
        chunk=variant.chunk or 1, seed=one.seed, offline=offline, success=one.success, best_reward=one.best_reward,
    )  # fmt: skip


# What is shown --------------------------------------------------------------------------------------------------------

Agreed = Mapping[str, Sequence["Agreement"]]
"""Target → what each offline score says of it."""


def _ceilings(one: Gathered, agreed: Agreed) -> dict[str, float | None]:
    """Target → the most that a correlation with it could be; None where nothing is said of it."""
    from pipeline.statistics.agreement import ceiling

    return {
        target: ceiling([c.outcome(target) for c in one.checkpoints], same_starts=one.same_starts)
        if any(a.overall for a in found)
        else None
        for target, found in agreed.items()
    }


def _as_json(one: Gathered, agreed: Agreed) -> dict[str, Any]:
    from pipeline.statistics.agreement import describe

    ceilings = _ceilings(one, agreed)
    return {
        "dataset": one.key,
        "content_hash": one.content_hash,
        "split_hash": one.split_hash,
        "simulator": one.simulator,
        **describe(one.checkpoints),
        "same_start_states": one.same_starts,
        "near_contact": None if isinstance(one.near, str) else float(one.near.mean()),
        "no_near_contact": one.near if isinstance(one.near, str) else None,
        "left_out": one.left_out,
        "targets": {
            target: {"ceiling": ceilings[target], "scores": [asdict(a) for a in found]}
            for target, found in agreed.items()
        },
        "rows": [_row(c) for c in one.checkpoints],
    }


def _row(c: "Checkpoint") -> dict[str, Any]:
    from pipeline.statistics.metrics import finite

    named = {name: getattr(c, name) for name in ("method", "policy", "observations", "chunk", "seed")}
    outcomes = {
        "success": float(c.success.mean()),
        "score": float(c.best_reward.mean()),
        "start_states": len(c.success),
    }
    return named | {name: finite(value) for name, value in c.offline.items()} | outcomes


def _show(one: Gathered, agreed: Agreed, console: Console) -> None:
    """What there is, a table a target, and what was left out."""
    from pipeline.offline_scores import SCORES
    from pipeline.statistics.agreement import describe, refusal

    said = describe(one.checkpoints)
    methods = ", ".join(f"{name} {count}" for name, count in said["methods"].items()) or "none"
    words = f"[bold]{escape(one.key)}[/]: {_plural(said['checkpoints'], 'checkpoint')}, by method: {escape(methods)}"
    if starts := said["start_states"]:
        states = "–".join(str(n) for n in dict.fromkeys(starts))
        words += f"; {states} start states each, {said['never_succeeded']} never succeeded"
    console.print(words, soft_wrap=True)
    if why := refusal(one.checkpoints):
        console.print(f"[yellow]cannot tell[/]: {escape(why)}.", soft_wrap=True)
        console.print(
            "Checkpoints are trained networks that were rolled out: more methods and chunk sizes come from the configuration, more "
            "seeds from its seeds and rollout_seeds.",
            style="dim", soft_wrap=True,
        )  # fmt: skip
    else:
        ceilings = _ceilings(one, agreed)
        for target, found in agreed.items():
            console.print(_table(target, found, ceilings[target]))
            for score in filter(lambda one: one.refused, found):
                console.print(f"No {SCORES[score.score]}: {escape(score.refused)}.", style="dim", soft_wrap=True)
        near = (
            one.near if isinstance(one.near, str) else f"{100 * one.near.mean():.0f} % of the frames are near contact"
        )
        console.print(f"{near[0].upper()}{near[1:]}.", style="dim", soft_wrap=True)
    for why in dict.fromkeys(left["why"] for left in one.left_out):
        which = [left["what"] for left in one.left_out if left["why"] == why]
        more = f" and {len(which) - 3} more" if len(which) > 3 else ""
        console.print(f"[yellow]left out:[/] {escape(', '.join(which[:3]))}{more} ({escape(why)})", soft_wrap=True)


def _table(target: str, found: Sequence["Agreement"], most: float | None) -> Table:
    from pipeline.offline_scores import SCORES

    title = f"Rank correlation with the {TITLES[target]}" + (
        f" (at most {most:.2f}: it is noisy itself)" if most else ""
    )
    table = Table(box=SIMPLE_HEAD, title=title, title_justify="left", pad_edge=False, collapse_padding=True)
    for head in ("offline score", "correlation", "95 %", "within a method", "95 %", "p", "methods"):
        table.add_column(head, justify="left" if head == "offline score" else "right")
    for one in found:
        if one.overall is None:
            table.add_row(SCORES[one.score], *["–"] * 6)
            continue
        within = (
            [f"{one.within.value:.2f}", _interval(one.within), _p(one.within), str(one.within.methods)]
            if one.within
            else ["–"] * 4
        )
        table.add_row(SCORES[one.score], f"{one.overall.value:.2f}", _interval(one.overall), *within)
    return table


def _interval(found: Any) -> str:
    return "–" if found.interval is None else f"{found.interval[0]:.2f} … {found.interval[1]:.2f}"


def _p(found: Any) -> str:
    return "–" if found.p is None else "< 0.001" if found.p < 0.001 else f"{found.p:.3f}"


def _show_answers(
    answers: Sequence["Answer"], found: Sequence[Gathered], said: Sequence[Agreed], console: Console
) -> None:
    from pipeline.offline_scores import SCORES
    from pipeline.statistics.agreement import name_best

    for one in answers:
        console.print(f"[{COLOURS[one.word]}]{one.word}[/]: {escape(one.words)}", soft_wrap=True)
    best = name_best(said[0]["success"])
    if not answers and best is not None:
        console.print(
            f"Highest on this data set: the {SCORES[best.score]}. The highest of several is partly luck: name a second data set "
            f"to test it on, as in demobench proxy {escape(found[0].key)} ANOTHER",
            soft_wrap=True,
        )


def _plural(count: int, word: str) -> str:
    return f"{count} {word}{'s' * (count != 1)}"
