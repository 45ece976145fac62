"""`demobench curve`: error against training episodes, and whether more of them would help."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.run import check_source, materialise
from demobench.commands.session import Session, open_session, short, tell_mlflow, write_json_to
from pipeline.experiment import Choices, Target, parse_list, parse_sizes, resolve_target


def run_curve(
    dataset: str,
    *,
    policy: str | None,
    sizes: str | None,
    more: int,
    worthwhile: float,
    choices: Mapping[str, Any],
    config_path: Path | None,
    store_path: str | None,
    json_to: str | None,
) -> None:
    """Make what is stale of one policy's learning curve, and say what it means."""
    from assets_defs.curve import curves_asked
    from assets_defs.history import with_champion
    from assets_defs.plan import Plan

    session = open_session(config_path, store_path, json_to)
    wanted = parse_list(choices["observations"])
    chosen = Choices(**{**choices, "observations": wanted, "policies": (policy,) if policy else ()})
    asked = parse_sizes(sizes)
    target = resolve_target(dataset, session.config, session.config_dir, chosen, session.store.experiments())
    variants = target.experiment.variants
    of_now = with_champion(session.store, target.key, target.experiment)
    curves = curves_asked(of_now, variants, chosen.policies, wanted, asked)
    check_source([target], session)
    target = replace(target, selected=tuple(v for v in variants if v.name == _policy_of(curves)))
    plan = Plan(session.store, target.key, target.experiment, tuple(variants), (_policy_of(curves),), wanted)
    session.store.ensure()
    with session.store.lock(target.key):
        session.store.register(target.key, target.experiment.model_dump(mode="json"))
        units = plan.curve_units(curves)
        stale = plan.stale(units)
        if stale:
            _check_sizes(target, plan, session, asked)
        ops = {"learning_curve": {"sizes": list(asked)}}
        sets = tuple(curve.entry.split("/")[1] for curve in curves)
        materialise(replace(target, observations=sets), session, units, list(stale), job="curve", ops=ops)
    plan.forget()
    read = [_read(curve, plan, more, worthwhile) for curve in curves]
    for curve, found in zip(curves, read, strict=True):
        _show(found, plan.folder(curve), session.console)
    session.console.print(f"[dim]The report shows it from the next run on: demobench run {escape(target.key)}[/]")
    tell_mlflow(session)
    write_json_to(json_to, read[0] | {"others": read[1:]})


def _policy_of(curves: Sequence[Any]) -> str:
    return curves[0].entry.split("/")[0]


def _check_sizes(target: Target, plan: Any, session: Session, asked: Sequence[int]) -> None:
    """Fail before any training where there are too few episodes, or too few for the sizes asked for."""
    from assets_defs.plan import Unit
    from pipeline.curve import curve_sizes
    from pipeline.folds import split_of
    from pipeline.lerobot_format.read import load_experiment
    from pipeline.split import load_split

    e = target.experiment
    if plan.is_fresh(Unit("episode_split")):
        split = load_split(plan.folder(Unit("episode_split")) / "split.json")
    else:
        demos, _ = load_experiment(e, session.config_dir)
        split = split_of(e, demos)
    curve_sizes(split, asked)


def _read(curve: Any, plan: Any, more: int, worthwhile: float) -> dict[str, Any]:
    """What one curve says of the question that was asked (JSON-able)."""
    from assets_defs.curve import floors_of
    from assets_defs.plan import Unit
    from pipeline.sinks.words import common_unit
    from pipeline.statistics.curve_reading import read_curve

    policy, observations, _ = curve.entry.split("/")
    e, folder = plan.experiment, plan.folder(curve)
    facts = plan.store.made(plan.folder(Unit("demonstrations"))).summary["inspect"]
    variant = next(v for v in plan.variants if v.name == policy)
    trained = variant.is_trained
    said = read_curve(
        folder, fps=facts["fps"], protocol=e.protocol, trained=trained, unit=common_unit(facts["action_units"]),
        floors=floors_of(plan, observations), more=more, share=worthwhile,
    )  # fmt: skip
    names = {"dataset": plan.key, "policy": policy, "observations": observations, "protocol": e.protocol}
    steps = plan.store.made(folder).summary["steps"] if trained else 0
    words = f"{e.seeds} × {e.budget_of(variant)}" if e.has_own_budget(variant) else e.budget_words
    budget = {"budget": words, "seeds": e.seeds if trained else 1, "steps": steps}
    pictures = {"pictures": [str(path) for path in sorted(folder.glob("*.png"))]}
    return {**names, **budget, "unit": common_unit(facts["action_units"]), **said.as_json(), **pictures}


def _show(found: Mapping[str, Any], folder: Path, console: Console) -> None:
    title = f"{found['dataset']}: {found['policy']} with {found['observations']}, {found['budget']}"
    later = found["sizes"][-1]["at_one_second"] is not None
    heads = ["training episodes", "first-step error", "95 % interval"]
    heads += ["error at one second", "95 % interval"] if later else []
    console.print(f"[bold]{escape(title)}[/]", soft_wrap=True)
    table = Table(*heads)
    for point in found["sizes"]:
        cells = [str(point["episodes"]), *_cells(point)]
        table.add_row(*cells, *(_cells(point["at_one_second"]) if later else []))
    console.print(table)
    colours = {"yes": "green", "no": "yellow", "cannot tell": "cyan"}
    for answer in found["answers"]:
        console.print(f"[{colours[answer['word']]}]{escape(answer['words'])}[/]")
    if found["floor"] is None:
        words = "No floor is known for the first-step error: none was measured, or its estimator refused"
        console.print(f"[dim]{words} (demobench floor says why).[/]")
    for path in found["pictures"]:
        console.print(f"  Picture  {escape(short(path))}", soft_wrap=True)


def _cells(point: Mapping[str, Any]) -> list[str]:
    interval = point["interval"]
    return [f"{point['error']:.4g}", f"{interval[0]:.4g} … {interval[1]:.4g}" if interval else "—"]
