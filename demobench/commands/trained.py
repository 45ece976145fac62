"""Trained policies in the store, found by their address: what `rollouts`, `export` and `proxy` begin with.

What does not belong here: what is done with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demobench.commands.compare import Address, parse_address
from demobench.commands.session import Session, stored_plan
from pipeline.errors import ConfigError, StoreError, did_you_mean
from pipeline.experiment import Variant

if TYPE_CHECKING:
    from assets_defs.plan import Plan, Unit
    from pipeline.folds import PolicyTask


@dataclass(frozen=True)
class Found:
    """One trained policy with one observation set: its task, the folder of its weights, what made them."""

    plan: "Plan"
    task: "PolicyTask"
    folder: Path
    fingerprint: str

    @property
    def variant(self) -> Variant:
        return self.task.variant


def find_trained(text: str, session: Session) -> list[Found]:
    """The up-to-date weights that `dataset/policy[/observations]` names; a policy of several chunks stands for all of them.

    Raises
    ------
    ConfigError : it names nothing that is trained, or one of several observation sets is meant.
    StoreError : what it names was not trained yet, or its weights are out of date.
    """
    address = parse_address(text)
    if address.policy is None or address.pin is not None:
        raise ConfigError(
            f"'{text}' names no policy. Expected dataset/policy[/observations], for example tape/mlp_k16."
        )
    plan = stored_plan(address.dataset, session)
    variants = [v for v in plan.variants if address.policy in (v.name, v.family)]
    if not variants:
        known = {name for v in plan.variants if v.is_trained for name in (v.name, v.family)}
        raise ConfigError(f"'{plan.key}' has no policy '{address.policy}'. {did_you_mean(address.policy, known)}")
    if not variants[0].is_trained:
        raise ConfigError(f"'{address.policy}' is a baseline: nothing of it is trained.")
    return _load(plan, variants, _the_set(address, plan, variants[0]))


def trained_in(plan: "Plan") -> list[Found]:
    """All trained policies of a data set's experiment whose weights are up to date, one a policy and observation set."""
    units = [(v, u) for v in plan.variants if v.is_trained for u in plan.policy_units(v, "trained_policy")]
    fresh = [(variant, unit) for variant, unit in units if plan.is_fresh(unit)]
    return _found(plan, fresh) if fresh else []


def _the_set(address: Address, plan: "Plan", variant: Variant) -> str:
    """The observation set that an address means."""
    sets = [s.name for s in plan.experiment.sets_of(variant)]
    here = f"{address.dataset}/{address.policy}"
    if address.observations is None and len(sets) > 1:
        raise ConfigError(
            f"'{here}' is trained with several observation sets: {', '.join(sets)}. Name one, for example {here}/{sets[0]}"
        )
    if address.observations not in (None, *sets):
        raise ConfigError(
            f"'{here}' is not trained with an observation set '{address.observations}'. "
            f"{did_you_mean(address.observations, sets)}"
        )
    return address.observations or sets[0]


def _load(plan: "Plan", variants: list[Variant], observations: str) -> list[Found]:
    from assets_defs.plan import Unit

    units = {v: Unit(f"{v.name}/trained_policy", observations) for v in variants}
    fresh = {v: unit for v, unit in units.items() if plan.is_fresh(unit)}
    if not fresh:
        raise StoreError(
            f"There are no up-to-date weights of {', '.join(v.name for v in variants)} ({observations}) in {plan.store.root}. "
            f"Train with: demobench run {plan.key} --policies {variants[0].family}"
        )
    return _found(plan, list(fresh.items()))


def _found(plan: "Plan", fresh: "Sequence[tuple[Variant, Unit]]") -> list[Found]:
    """Weights that are up to date, with the tasks that they were trained for."""
    from pipeline.folds import PolicyTask

    data, sets = _data(plan), {s.name: s for s in plan.experiment.observation_sets}
    return [
        Found(plan, PolicyTask(*data, sets[unit.entry], v, plan.experiment), plan.folder(unit), plan.fingerprint(unit))
        for v, unit in fresh
    ]


def _data(plan: "Plan") -> tuple[Any, Any, Any]:
    """Demonstrations, semantics and split as the results of the store rest on them."""
    from assets_defs.plan import Unit
    from pipeline.lerobot_format.quality import resolve_semantics
    from pipeline.lerobot_format.saved import load_demonstrations
    from pipeline.split import load_split

    demos = load_demonstrations(plan.folder(Unit("demonstrations")) / "frames")
    dataset = plan.experiment.dataset
    semantics = resolve_semantics(demos, kind=dataset.kind, circular=dataset.circular)
    return demos, semantics, load_split(plan.folder(Unit("episode_split")) / "split.json")
