"""`demobench compare`: which of these policies is better, paired over the episodes that both were held out on.

What belongs here: from addresses to results in the store, what keeps two results from being compared, and the table of
verdicts. What does not: the tests behind a verdict (`pipeline.statistics.comparisons`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demobench.commands.session import Session, open_session, stored_plan, write_json_to
from pipeline.errors import ConfigError, StoreError, did_you_mean
from pipeline.experiment import Variant
from pipeline.methods import EXTERNAL

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from assets_defs.plan import Plan, Unit
    from pipeline.statistics.comparisons import Comparison, Paired
    from pipeline.types import EpisodeErrors, Protocol, Rollouts

MOST_ROWS = 30
"""All pairs of more would be a family in which hardly anything can show."""
TITLES = {
    "first_step_mae": "first step, MAE", "at_one_second_mae": "at one second, MAE", "success": "success rate, closed loop",
    "score": "score, closed loop",
}  # fmt: skip


@dataclass(frozen=True)
class Address:
    """`dataset/policy[/observations][@run]`, as typed; only a data set stands for every row of its table."""

    text: str
    dataset: str
    policy: str | None
    observations: str | None
    pin: str | None


@dataclass(frozen=True)
class Entry:
    """One result to be compared, and what must be equal for that.

    fingerprint, mlflow_run_id   either of them, or its beginning, is what `@run` pins
    rollouts                     closed-loop results, one a training seed; none where it was not rolled out
    unit                         of the errors, where all action columns share one
    steps, budget                of training, a number and in words; None where nobody here trained it
    seen                         whether it was trained on the episodes it is scored on; None: nothing is known
    """

    key: str
    policy: str
    observations: str
    trained: bool
    errors: "EpisodeErrors"
    rollouts: "Sequence[Rollouts]"
    fps: float
    unit: str | None
    data_hash: str
    split_hash: str
    protocol: "Protocol"
    steps: int | None
    budget: str | None
    fingerprint: str
    mlflow_run_id: str | None
    seen: bool | None = False

    @property
    def is_elsewhere(self) -> bool:
        return self.steps is None

    @property
    def address(self) -> str:
        return f"{self.key}/{self.policy}/{self.observations}"


def compare_policies(
    addresses: Sequence[str], config_path: Path | None, store_path: str | None, json_to: str | None
) -> None:
    """Compare every two of the results that the addresses name, in one family.

    Raises
    ------
    ConfigError : an address that names nothing, or too few or too many results.
    StoreError : a result that is not up to date, or a pin that the store no longer holds.
    """
    from pipeline.external.pairing import UNKNOWN
    from pipeline.statistics.closed_loop import judge_with_rollouts

    session = open_session(config_path, store_path, json_to)
    found = [entry for text in addresses for entry in _entries(parse_address(text), session)]
    entries = list({entry.address: entry for entry in found}.values())
    if len(entries) < 2:
        raise ConfigError(
            f"There is nothing to compare {entries[0].address if entries else addresses[0]} with. Name two results, for "
            "example tape/mlp_k01 tape/mlp_k16, or a data set alone for all pairs of its table."
        )
    if len(entries) > MOST_ROWS:
        raise ConfigError(
            f"{len(entries)} results make {len(entries) * (len(entries) - 1) // 2} pairs, too many for one family: at most "
            f"{MOST_ROWS} results are compared at once. Name those that matter."
        )
    pairs = [pair for a, b in combinations(entries, 2) for pair in compare_entries(a, b)]
    unknown = {entry.address for entry in entries if entry.seen is None}
    verdicts = [
        replace(v, words=v.words + UNKNOWN) if v.word != "not comparable" and {v.a, v.b} & unknown else v
        for v in judge_with_rollouts(pairs)
    ]
    family = sum(verdict.p_holm is not None for verdict in verdicts)
    if json_to != "-":
        show_verdicts(verdicts, family, entries, session.console)
    write_json_to(
        json_to,
        {"family": family, "rows": [_row_json(e) for e in entries], "comparisons": [asdict(v) for v in verdicts]},
    )


# From an address to results ------------------------------------------------------------------------------------------


def parse_address(text: str) -> Address:
    """Split an address; a folder stands for the data set of its name.

    Raises:
        ConfigError: it is none.
    """
    folder = Path(text).expanduser()
    if folder.is_dir():
        return Address(text, folder.absolute().name, None, None, None)
    body, at, pin = text.partition("@")
    parts = body.split("/")
    if not 1 <= len(parts) <= 3 or not all(parts) or (at and not pin) or (pin and len(parts) == 1):
        raise ConfigError(
            f"'{text}' is no address of a result. Expected dataset/policy[/observations][@run], for example tape/mlp_k16, "
            "tape/mlp_k16/state or tape/mlp_k16@1f3a; or a data set alone."
        )
    dataset, policy, observations = (*parts, None, None)[:3]
    return Address(text, dataset, policy, observations, pin or None)


def _entries(address: Address, session: Session) -> list[Entry]:
    """The up-to-date results that an address names."""
    plan = stored_plan(address.dataset, session)
    fresh = [
        (variant, unit.entry)
        for variant in plan.variants
        for unit in plan.policy_units(variant, "predictions")
        if plan.is_fresh(unit)
    ]
    fresh += [_elsewhere(unit, plan) for unit in plan.scored_units() if plan.is_fresh(unit)]
    if not fresh:
        units = [unit for variant in plan.variants for unit in plan.policy_units(variant, "predictions")]
        stale = any(session.store.made(plan.folder(unit)) for unit in units)
        why = " (those there are of other data, settings or an older demobench)" if stale else ""
        raise StoreError(
            f"There are no up-to-date results of '{plan.key}' in {session.store.root}{why}. Make them with: demobench run "
            f"{plan.key}"
        )
    chosen = [_choose(address, fresh, plan)] if address.policy else fresh
    entries = [_load(plan, variant, observations) for variant, observations in chosen]
    if address.pin:
        _check_pin(address, entries[0])
    return entries


def _elsewhere(unit: "Unit", plan: "Plan") -> tuple[Variant, str]:
    """What was predicted elsewhere, as a policy with an observation set."""
    said = plan.store.made(plan.folder(unit)).summary
    return Variant(unit.entry, unit.entry, EXTERNAL, said["chunk"]), said["observations"]


def _choose(address: Address, fresh: Sequence[tuple[Variant, str]], plan: "Plan") -> tuple[Variant, str]:
    """The one result that an address with a policy names."""
    here = f"{address.dataset}/{address.policy}"
    of_policy = [row for row in fresh if row[0].name == address.policy]
    if not of_policy:
        defined = any(variant.name == address.policy for variant in plan.variants)
        names = {variant.name for variant, _ in fresh}
        raise ConfigError(
            f"'{here}' has no up-to-date result. Make it with: demobench run {address.dataset}. There are results of "
            f"{', '.join(sorted(names))}."
            if defined
            else f"'{address.dataset}' has no policy '{address.policy}'. {did_you_mean(address.policy, names)}"
        )
    sets = [observations for _, observations in of_policy]
    if address.observations is None and len(sets) > 1:
        raise ConfigError(
            f"'{here}' sees one of several observation sets: {', '.join(sets)}. Name one, for example {here}/{sets[0]}"
        )
    if address.observations not in (None, *sets):
        raise ConfigError(
            f"'{here}' has no up-to-date result with the observation set '{address.observations}'. "
            f"{did_you_mean(address.observations, sets)}"
        )
    return next(row for row in of_policy if address.observations in (None, row[1]))


def _load(plan: "Plan", variant: Variant, observations: str) -> Entry:
    """One result with what it rests on, from the store."""
    from assets_defs.plan import SCORED, Unit
    from pipeline.simulate.trial import load_rollouts
    from pipeline.statistics.metrics import load_errors

    def made(unit: Unit):
        return plan.store.made(plan.folder(unit))

    predictions, rollouts = (Unit(f"{variant.name}/{kind}", observations) for kind in ("predictions", "rollouts"))
    elsewhere = variant.method == EXTERNAL
    predictions = Unit(SCORED, variant.name) if elsewhere else predictions
    facts = made(Unit("demonstrations")).summary["inspect"]
    units = set(facts["action_units"])
    rolled_out = not elsewhere and plan.is_fresh(rollouts) and made(rollouts).summary["rollouts"]
    trained = None if elsewhere else made(Unit(f"{variant.name}/trained_policy", observations)).summary
    return Entry(
        key=plan.key,
        policy=variant.name,
        observations=observations,
        trained=variant.is_trained,
        errors=load_errors(plan.folder(predictions) / "errors.safetensors"),
        rollouts=load_rollouts(plan.folder(rollouts)) if rolled_out else [],
        fps=facts["fps"],
        unit=units.pop() if len(units) == 1 else None,
        data_hash=facts["content_hash"],
        split_hash=made(Unit("episode_split")).summary["hash"],
        protocol=plan.experiment.protocol,
        steps=None if elsewhere else trained.get("steps") or plan.experiment.steps,
        budget=None if elsewhere else plan.experiment.budget_of(variant),
        fingerprint=plan.fingerprint(predictions),
        mlflow_run_id=(trained or made(predictions).summary).get("mlflow_run_id"),
        seen=made(predictions).summary["seen_in_training"] if elsewhere else False,
    )


def _check_pin(address: Address, entry: Entry) -> None:
    if not any(name.startswith(address.pin) for name in (entry.fingerprint, entry.mlflow_run_id or "")):
        raise StoreError(
            f"The store no longer holds '{address.text}'. What it holds of {entry.address} is the result "
            f"{entry.fingerprint} (MLflow run {entry.mlflow_run_id or 'not sent yet'})."
        )


# Two results ---------------------------------------------------------------------------------------------------------


def compare_entries(a: Entry, b: Entry) -> list[tuple[str, str, str, "Paired | str"]]:
    """Two results on every metric that both have, or the first thing that keeps them from being compared."""
    from pipeline.statistics.closed_loop import METRICS, compare_rollouts
    from pipeline.statistics.comparisons import horizons_in_common

    why = _data_differs(a, b)
    if why is None:
        first = _compare_at(a, b, 0)
        why = first if isinstance(first, str) else _recipe_differs(a, b)
    if why:
        return [(a.address, b.address, "first_step_mae", why)]
    found: list[tuple[str, str, str, Paired | str]] = [
        (a.address, b.address, metric, _compare_at(a, b, horizon))
        for metric, horizon in horizons_in_common(a.errors, b.errors, a.fps).items()
    ]
    if a.rollouts and b.rollouts:
        trained = (a.trained, b.trained)
        found += [
            (a.address, b.address, metric, compare_rollouts(a.rollouts, b.rollouts, metric, trained=trained))
            for metric in METRICS
        ]
    return found


def _compare_at(a: Entry, b: Entry, horizon: int) -> "Paired | str":
    """Two results at a horizon: ours on the same episodes, what was predicted elsewhere on those that both hold out."""
    from pipeline.external.pairing import Rival, compare_common
    from pipeline.statistics.comparisons import compare_errors

    if a.is_elsewhere or b.is_elsewhere:
        rivals = (Rival(e.address, e.errors, e.trained, e.seen) for e in (a, b))
        return compare_common(*rivals, horizon, a.protocol)
    return compare_errors(a.errors, b.errors, horizon, a.protocol, trained=(a.trained, b.trained))


def _data_differs(a: Entry, b: Entry) -> str | None:
    for name, of_a, of_b in (("data hash", a.data_hash, b.data_hash), ("split", a.split_hash, b.split_hash)):
        if of_a != of_b:
            return f"{name} differs: {of_a[:12]} and {of_b[:12]}"
    return None


def _recipe_differs(a: Entry, b: Entry) -> str | None:
    if a.protocol != b.protocol:
        return f"protocol differs: {a.protocol} and {b.protocol}"
    if a.trained and b.trained and a.budget != b.budget and not (a.is_elsewhere or b.is_elsewhere):
        return f"budget differs: {a.budget} and {b.budget}"
    return None


# What is shown -------------------------------------------------------------------------------------------------------


def _row_json(entry: Entry) -> dict[str, Any]:
    kept = (
        "address", "policy", "observations", "data_hash", "split_hash", "protocol", "steps", "fingerprint", "mlflow_run_id",
    )  # fmt: skip
    return {"dataset": entry.key} | {name: getattr(entry, name) for name in kept}


def show_verdicts(verdicts: Sequence["Comparison"], family: int, entries: Sequence[Entry], console: "Console") -> None:
    """A table a metric, and what the numbers rest on."""
    from rich.markup import escape

    short = _short_names(entries)
    left_out: list[str] = []
    console.print()
    for metric in TITLES:
        if rows := [verdict for verdict in verdicts if verdict.metric == metric]:
            unit = entries[0].unit if metric.endswith("_mae") else None
            title = f"{TITLES[metric]}{f', {unit}' if unit else ''}"
            if len(rows) > MANY and len({(row.word, row.words) for row in rows}) == 1:
                console.print(f"{title}: all {len(rows)} pairs: {escape(rows[0].word)}: {escape(rows[0].words)}")
                continue
            grid, gave_way = _fit(title, rows, short, console)
            left_out += [head for head in gave_way if head not in left_out]
            console.print(grid)
    if len(verdicts) > MANY and all(verdict.word == "cannot tell" for verdict in verdicts):
        two = " ".join(entry.address for entry in entries[:2])
        console.print(f"Fewer at once may be told apart, for example: demobench compare {escape(two)}", soft_wrap=True)
    narrow = [f"left out for want of width: {', '.join(left_out)} (all in --json)"] if left_out else []
    notes = [line for line in _footnotes(verdicts, family, entries) if line.split(":")[0] not in left_out]
    for line in (*notes, *narrow):
        console.print(escape(line), style="dim")
    console.print()


def _fit(
    title: str, rows: Sequence["Comparison"], short: Mapping[str, str], console: "Console"
) -> tuple["Table", list[str]]:
    """A table as wide as the console allows, and the columns left out for that: the verdict is always there."""
    left_out: list[str] = []
    for expendable in (*GIVE_WAY, None):
        grid = _grid(title, rows, short, left_out)
        needed = console.measure(grid, options=console.options.update(width=1000)).minimum
        if needed <= console.width or expendable is None:
            break
        left_out.append(expendable)
    return grid, left_out


def _short_names(entries: Sequence[Entry]) -> dict[str, str]:
    """Addresses without what they all share."""
    one_dataset = len({entry.key for entry in entries}) == 1
    one_set = len({entry.observations for entry in entries}) == 1
    return {
        e.address: "/".join(
            [*([] if one_dataset else [e.key]), e.policy, *([] if one_set else [e.observations])]
        )
        for e in entries
    }  # fmt: skip


def _grid(title: str, rows: Sequence["Comparison"], short: Mapping[str, str], left_out: Sequence[str]) -> "Table":
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    numbers = {head: cell for head, cell in NUMBERS.items() if head not in left_out}
    grid = Table(box=box.SIMPLE_HEAD, header_style="bold", pad_edge=False, title=title, title_justify="left")
    for head in ("a", "b"):
        grid.add_column(head, overflow="fold")
    for head, cell in numbers.items():
        # Said outright, because a least width is otherwise measured by words, and an interval is three.
        width = max(len(head), *(len(cell(row)) for row in rows))
        grid.add_column(head, justify="right", no_wrap=True, min_width=width)
    grid.add_column("a is", min_width=24)
    colour = {"better": "green", "worse": "red"}
    for row in rows:
        word = f"[{colour[row.word]}]{row.word}[/]" if row.word in colour else row.word
        cells = [cell(row) for cell in numbers.values()]
        grid.add_row(escape(short[row.a]), escape(short[row.b]), *cells, f"{word}: {escape(row.words)}")
    return grid


def _p(p: float | None) -> str:
    return "—" if p is None else "<0.001" if p < 0.001 else f"{p:.3f}"


def _interval(row: "Comparison") -> str:
    return "—" if row.interval is None else f"{row.interval[0]:#.3g} … {row.interval[1]:#.3g}"


NUMBERS: dict[str, Callable[["Comparison"], str]] = {
    "a − b": lambda row: "—" if row.difference is None else f"{row.difference:+#.3g}",
    "95 %": _interval,
    "p, Holm": lambda row: _p(row.p_holm),
    "visible from": lambda row: "—" if row.smallest_seen is None else f"{row.smallest_seen:#.2g}",
}
"""The columns of numbers; those of `GIVE_WAY` are left out, in this order, where the console is too narrow. The verdict's
words say how large a difference is, but not how sure: p stays longest."""
GIVE_WAY = ("visible from", "95 %", "a − b", "p, Holm")
MANY = 6
"""More pairs than this that all end in the same words are one line."""


def _footnotes(verdicts: Sequence["Comparison"], family: int, entries: Sequence[Entry]) -> list[str]:
    lines = []
    if family:
        s = "s" * (family != 1)
        lines += [
            f"{family} comparison{s} in one family; p is what is left after Holm. A verdict needs p ≤ 0.05.",
            "95 %: over held-out episodes and training seeds, for these folds and training sets.",
            "visible from: the difference that would be seen 80 % of the time in a test at 0.05 on its own.",
        ]
    if any(verdict.metric == "success" for verdict in verdicts):
        most = max(len(entry.rollouts) for entry in entries)
        networks = (
            f"{most} seeds of fold 0"
            if most > 1
            else "one network of each (seed 0 of fold 0), success by exact McNemar"
        )
        lines.append(
            f"closed loop: over start states in place of episodes, {networks}; a difference above zero is better."
        )
    if len(entries) <= 4:
        lines += [
            f"{e.address}@{e.fingerprint}  MLflow run {e.mlflow_run_id or 'not sent yet'}"
            f"{', predicted elsewhere' if e.is_elsewhere else ''}"
            for e in entries
        ]
    return lines
