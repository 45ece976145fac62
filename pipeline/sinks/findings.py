"""What a table's tests and floors say, in sentences: the same words on the page and in the terminal.

What belongs here: choosing what to say, and wording, from the table's own fields. What does not: HTML, terminal markup,
tests. Nothing here calls one policy better than another unless a comparison of the table does.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.execution import settled
from pipeline.execution import words as execution_words
from pipeline.methods import EXTERNAL, METHODS
from pipeline.safety import TOLERANCE
from pipeline.sinks.words import common_unit, decimals_for, is_number, percent, plural, show, show_interval
from pipeline.types import AS_USUAL, Execution

Table = Mapping[str, Any]
Row = Mapping[str, Any]

MARKS = {"better": "✓", "cannot tell": "?", "worse": "✗", "not comparable": "–"}
"""Beside a verdict's word, so that neither colour nor reading is needed to find it."""
LOSSES = {"rmse": "RMSE", "mae": "MAE", "l2": "L2"}
DRIVEN = ("success", "score")
"""What is compared in closed loop."""
MOST_NAMED, MOST_LEFT_OUT = 5, 12
STEPPED_IN = f"it changed an action by more than {percent(TOLERANCE)} of a column's range"


NOT_HELD = "no policy is held against a floor under protocol notebook: it averages over frames, a floor over episodes"


class Strong(str):
    """A part of a sentence that stands out."""

    __slots__ = ()


class Command(str):
    """A part of a sentence that is to be typed."""

    __slots__ = ()


Sentence = list[str]
"""Parts of a sentence, one after another; some are `Strong`, some are a `Command`."""
BEST, FLOOR, ELSEWHERE, DRIVEN_ALONE, MORE = (
    "Which policy is best?", "How good can it get?", "What was predicted elsewhere?", "How does it do by itself?",
    "Would more demonstrations help?",
)  # fmt: skip
"""What a reader wants to know, in this order; but where a policy succeeds by itself, that comes first."""


def answer(table: Table) -> list[Sentence]:
    """What a reader wants to know first, each with the test or the floor that carries it."""
    return [sentence for sentences in answers(table).values() for sentence in sentences]


def answers(table: Table) -> dict[str, list[Sentence]]:
    """The same by the question that it answers; questions that the table has no answer to are left out."""
    rows = [row for row in table["policies"] if is_number(row["first_step_mae"]) and ranks(row)]
    found: dict[str, list[Sentence]] = {}
    driven = [row for row in table["policies"] if row["rollouts"]]
    most = max(driven, key=lambda row: (row["rollouts"]["success"], row["rollouts"]["score"]), default=None)
    alone = {DRIVEN_ALONE: [_best_driven(most), *_driven_verdicts(table, most)]} if most else {}
    if most and most["rollouts"]["success"]:
        found |= alone
    if rows:
        best = min(rows, key=lambda row: row["first_step_mae"])
        found[BEST] = [_best(table, best), *_second(table, rows, best), *_against_still(table, rows, best)]
        found[BEST] += _against_champion(table, rows)
        found[FLOOR] = [*_first_step_floor(table, best), *_later_floor(table, best)]
    found[ELSEWHERE] = [_from_elsewhere(table, row) for row in table["policies"] if is_elsewhere(row)]
    found |= alone
    return {question: sentences for question, sentences in found.items() if sentences}


def excluded_words(table: Table) -> str:
    """The episodes that the configuration leaves out of every number; nothing where it leaves out none."""
    numbers = table["dataset"].get("excluded") or ()
    more = " …" if len(numbers) > MOST_LEFT_OUT else ""
    named = ", ".join(map(str, numbers[:MOST_LEFT_OUT]))
    return (
        f"left out by the configuration: {'episodes' if len(numbers) > 1 else 'episode'} {named}{more}"
        if numbers
        else ""
    )


# Policies -------------------------------------------------------------------------------------------------------------


def key_of(table: Table) -> str:
    """What commands call the data set with these settings: `tape`, `tape+3fa9c1d2`."""
    return table.get("key") or table["dataset"]["name"]


def address(row: Row) -> str:
    return f"{row['policy']}/{row['observations']}"


def name_in(table: Table, where: str) -> str:
    """A row's address as people read it: the policy, and its observation set if it comes with several."""
    policy, _, observations = where.partition("/")
    several = sum(row["policy"] == policy for row in table["policies"]) > 1
    return f"{policy} ({observations})" if several and observations else policy


def who(row: Row) -> Sentence:
    """A policy, and what it sees if its answer depends on that."""
    asks = row["method"] not in METHODS or METHODS[row["method"]].uses_observations
    return [Strong(row["policy"]), f" seeing {row['observations']}" if asks else ""]


def is_elsewhere(row: Row) -> bool:
    """Whether a row was predicted elsewhere, and only scored here."""
    return row["method"] == EXTERNAL


def is_seen(row: Row) -> bool:
    """Whether a row is scored on what its policy was trained on."""
    return bool(row.get("seen_in_training"))


def ranks(row: Row) -> bool:
    """Whether a row's error can stand beside the others': those from elsewhere have episodes of their own."""
    return not is_elsewhere(row)


def _from_elsewhere(table: Table, row: Row) -> Sentence:
    """What is known of a row that was predicted elsewhere."""
    value = f"{show(row['first_step_mae'])}{dataset_unit(table)}"
    said: Sentence = [Strong(row["policy"]), ", predicted elsewhere, has a first-step error of ", Strong(value)]
    said.append(f" on {plural(len(row['episodes']), 'episode')}")
    if is_seen(row):
        return [*said, " that it was ", Strong("trained on"), ", which says nothing about others: no verdict."]
    found = compared(table, address(row), "hold_still")
    if found is None:
        return [*said, "."]
    if found["word"] in ("better", "worse"):
        word = Strong(f"{found['word']} than hold-still")
        return [*said, "; it is ", word, f" on those that both hold out: {found['words']}."]
    if found["word"] == "not comparable":
        return [*said, f". It cannot be compared with hold-still: {found['words']}."]
    return [*said, "; it ", Strong("cannot be told from hold-still"), f": {found['words']}."]


def elsewhere_words(table: Table) -> list[str]:
    """What rows from elsewhere rest on, and what looks odd about them."""
    found = []
    for row in (row for row in table["policies"] if is_elsewhere(row)):
        found.append(f"{row['policy']}: {row['training']}")
        found += [f"{row['policy']}: {warning}" for warning in row["warnings"]]
        if row["samples"]:
            unit = " deviations" if row["samples"]["in_deviations"] else dataset_unit(table)
            later = row["samples"]["at_one_second"]
            found.append(
                f"{row['policy']}: errors are of the mean of {row['samples']['count']} samples; at the first action "
                f"{_samples_words(row['samples'], unit)}{f'; one second ahead {_samples_words(later, unit)}' if later else ''}"
            )
    return found


def driven_words(table: Table) -> list[str]:
    """What closed-loop results rest on: how chunks were carried out where that is not as usual, and why there are none."""
    carried: dict[str, list[str]] = {}
    for row in (row for row in table["policies"] if row["rollouts"]):
        how = row["rollouts"].get("execution")
        if how and Execution(**how) != settled(AS_USUAL, row["chunk"] or 1):
            carried.setdefault(execution_words(Execution(**how)), []).append(name_in(table, address(row)))
    reasons: dict[str, list[str]] = {}
    for row in table["policies"]:
        if why := row.get("no_rollouts"):
            reasons.setdefault(why, []).append(name_in(table, address(row)))
    found = [f"roll-outs of {', '.join(names)}: {how}" for how, names in carried.items()]
    return found + [f"no roll-outs of {', '.join(names)}: {why}" for why, names in reasons.items()]


def deadline_words(table: Table) -> list[str]:
    """Which policies do not answer in time, and what their time is."""
    found = []
    for row in (row for row in table["policies"] if row.get("misses_deadline")):
        how, time = Execution(**row["execution"]), f"{show(row['deadline_ms'])} ms"
        there = f"roll-outs reckon with {how.delay} frames, {time}" if how.delay else f"it is asked every {time}"
        found.append(
            f"one call in a hundred of {name_in(table, address(row))} takes {show(row['latency_p99_ms'])} ms or more on this "
            f"machine, and {there}: it misses its deadline"
        )
    return found


def safety_words(table: Table) -> list[str]:
    """How often the safety layer stepped in and how far, policy by policy; nothing where it did not have to."""
    rows = [row for row in table["policies"] if (row["rollouts"] or {}).get("interventions")]
    if not rows:
        return []
    words = [f"{name_in(table, address(row))} {_stepped_in(row['rollouts'])}" for row in rows]
    return [f"the safety layer stepped in ({STEPPED_IN}): {'; '.join(words)}"]


def stopped_words(table: Table) -> list[str]:
    """Whose episodes the safety layer stopped; nothing where it stopped none."""
    rows = [row for row in table["policies"] if (row["rollouts"] or {}).get("stopped")]
    words = [f"{name_in(table, address(row))} {_stopped(row['rollouts'])}" for row in rows]
    return [f"the safety layer stopped episodes: {'; '.join(words)}"] if words else []


def _stepped_in(rollouts: Mapping[str, Any]) -> str:
    size = rollouts.get("mean_intervention")
    said = f"in {percent(rollouts['intervened'])} of the frames"
    said += f", by {percent(size)} on average" if is_number(size) else ""
    return f"{said} ({_stopped(rollouts)})" if rollouts["stopped"] else said


def _stopped(rollouts: Mapping[str, Any]) -> str:
    broken = rollouts["stopped_not_finite"]
    why = f", {broken} for actions that are not finite" if broken else ""
    return f"{rollouts['stopped']} of {rollouts['episodes']} episodes stopped{why}"


def _samples_words(scores: Mapping[str, Any], unit: str) -> str:
    """What one sample and all of them are worth at one horizon."""
    energy, one = (scores[name]["value"] for name in ("energy", "of_one"))
    return f"one sample is {show(one)}{unit} off (L2), fair energy score {show(energy)}{unit}"


def champion(table: Table) -> str | None:
    """The address of the champion, its name where it has no row, or None where none was named."""
    if not any(row["verdict"]["vs_champion"] for row in table["policies"]):
        return None
    others = [c["b"] for c in table["comparisons"] if not c["b"].startswith("hold_still/")]
    return others[0] if others else next(c["b"] for c in table["comparisons"])


def compared(table: Table, a: str, b: str, metric: str = "first_step_mae") -> Mapping[str, Any] | None:
    """The comparison of a with b, if there is one: b is an address, or a policy's name."""
    found = (
        comparison
        for comparison in table["comparisons"]
        if (comparison["a"], comparison["metric"]) == (a, metric)
        and b in (comparison["b"], comparison["b"].split("/")[0])
    )
    return next(found, None)


def family(table: Table) -> int:
    """How many comparisons were tested, and so share one correction."""
    return sum(comparison["p_holm"] is not None for comparison in table["comparisons"])


def dataset_unit(table: Table) -> str:
    """The unit of the actions, with a space before it, or nothing where it is unknown."""
    unit = common_unit(table["dataset"]["action_units"])
    return f" {unit}" if unit else ""


def _best(table: Table, best: Row) -> Sentence:
    interval = show_interval((best.get("interval") or {}).get("first_step_mae"))
    mixed = common_unit(table["dataset"]["action_units"]) == "mixed units"
    value = Strong(f"{show(best['first_step_mae'])}{'' if mixed else dataset_unit(table)}")
    average = "on average over columns of different units" if mixed else "on average"
    held_out = plural(len({episode for fold in table["split"]["folds"] for episode in fold["test"]}), "episode")
    every = (
        f"Of the rows on all {held_out} held out, closest" if any(map(is_elsewhere, table["policies"])) else "Closest"
    )
    said = [
        f"{every} to the demonstrations is ",
        *who(best),
        f": in {held_out} that it never saw its next action is off by ",
    ]
    said += [value, f" {average}{f' {interval}' if interval else ''} (first-step MAE). "]
    if best["policy"] == "hold_still":
        return [*said, "So no policy is better than holding still."]
    found = compared(table, address(best), "hold_still")
    if found is None:
        return said
    if found["word"] == "better":
        ratio = f", whose error is {show(best['vs_hold_still'])} times as large" if best["vs_hold_still"] else ""
        return [*said, "It is ", Strong("better than hold-still"), f"{ratio}.", _one_network(table, best)]
    if found["word"] == "not comparable":
        return [*said, f"It cannot be compared with hold-still: {found['words']}."]
    return [*said, "It ", Strong("cannot be told from hold-still"), f": {found['words']}."]


def _one_network(table: Table, row: Row) -> str:
    return " With one seed this is about one network, not its method." if row["params"] and row["seeds"] == 1 else ""


def _against_still(table: Table, rows: Sequence[Row], best: Row) -> list[Sentence]:
    """Who else cannot be told from hold-still, and who is worse."""
    words = {address(row): row["verdict"]["vs_hold_still"] for row in rows if row is not best}
    uncertain, worse = ([a for a, word in words.items() if word == w] for w in ("cannot tell", "worse"))
    said: Sentence = []
    if uncertain:
        said += ["At the first step ", _listed(table, uncertain), " ", Strong("cannot be told from hold-still"), ". "]
    if worse:
        said += [Strong("Worse than hold-still"), " at the first step: ", _listed(table, worse), "."]
    return [said] if said else []


def _listed(table: Table, addresses: Sequence[str]) -> str:
    names = [name_in(table, where) for where in addresses]
    if len(names) > MOST_NAMED:
        return f"{', '.join(names[: MOST_NAMED - 2])} and {len(names) - MOST_NAMED + 2} more"
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _against_champion(table: Table, rows: Sequence[Row]) -> list[Sentence]:
    named = champion(table)
    if named is None:
        return []
    words = {address(row): row["verdict"]["vs_champion"] for row in rows}
    groups = {word: [a for a, w in words.items() if w == word] for word in MARKS}
    if groups["not comparable"] and not any(groups[word] for word in ("better", "worse", "cannot tell")):
        why = next(c["words"] for c in table["comparisons"] if c["word"] == "not comparable" and c["b"] == named)
        return [["Nothing can be compared with the champion: ", f"{why}."]]
    parts = [f"{word}: {_listed(table, group)}" for word, group in groups.items() if group]
    return [["At the first step, against the champion ", Strong(name_in(table, named)), f" – {'; '.join(parts)}."]]


def _second(table: Table, rows: Sequence[Row], best: Row) -> list[Sentence]:
    """The next row: told apart where the table's comparisons hold the two, else how to find out."""
    others = sorted((row for row in rows if row is not best), key=lambda row: row["first_step_mae"])
    if not others or "hold_still" in (best["policy"], others[0]["policy"]):
        return []
    second, name = others[0], name_in(table, address(others[0]))
    forth, back = compared(table, address(best), address(second)), compared(table, address(second), address(best))
    if (forth and forth["word"] == "better") or (back and back["word"] == "worse"):
        return [["It is ", Strong("better than the second"), f", {name}."]]
    if found := forth or back:
        return [["It ", Strong("cannot be told from the second"), f", {name}: {found['words']}."]]
    both = " ".join(f"{key_of(table)}/{address(row)}" for row in (best, second))
    ask = Command(f"demobench compare {both}")
    return [["Whether it is better than the second, ", name, ", is not tested here; ", ask, " tells."]]


def _best_driven(most: Row) -> Sentence:
    n, rate, interval = most["rollouts"]["n"], most["rollouts"]["success"], most["rollouts"].get("success_interval")
    if rate == 0:
        none = f"In closed loop no policy succeeds from any of {n} start states; the highest score is that of "
        return [none, *who(most), ": ", Strong(show(most["rollouts"]["score"])), ".", *_how_far(most)]
    percent = f" ({100 * interval[0]:.0f}–{100 * interval[1]:.0f} %)" if show_interval(interval) else ""
    seeds, episodes = most["rollouts"]["seeds"], most["rollouts"]["episodes"]
    often = Strong(f"{round(rate * episodes)} of {episodes}")
    networks = f", {seeds} training seeds from {n} start states" if seeds > 1 else ""
    return ["In closed loop ", *who(most), " succeeds most often: ", often, f"{percent}{networks}.", *_how_far(most)]


def _how_far(row: Row) -> Sentence:
    """How many of its episodes came to each stage of the task; nothing where the task has none."""
    rollouts = row["rollouts"]
    if not rollouts.get("stages"):
        return []
    counts = (f"{stage} {count}" for stage, count in zip(rollouts["stages"], rollouts["stage_counts"], strict=True))
    return [f" Of its {rollouts['episodes']} roll-outs: {', '.join(counts)}."]


def _driven_verdicts(table: Table, most: Row) -> list[Sentence]:
    """Who of the rows shown does better in closed loop than the champion, or than whoever does best there."""
    found, shown = table.get("closed_loop"), {address(row) for row in table["policies"]}
    comparisons = [c for c in (found or {}).get("comparisons", ()) if c["a"] in shown]
    if not comparisons:
        return []
    success, score = (_driven_groups(table, [c for c in comparisons if c["metric"] == metric]) for metric in DRIVEN)
    said = f"success and score: {success}" if success == score else f"success: {success}. Score: {score}"
    said = (
        said if most["rollouts"]["success"] else f"score: {score}"
    )  # where nobody succeeds there is nothing to tell apart
    named = Strong(name_in(table, found["reference"]))
    if found["chosen"] == "champion":
        return [["In closed loop, against the champion ", named, f" – {said}."]]
    if found["reference"] != address(most):  # a run that was asked for some policies shows only those
        return [["Against ", named, f", which does best in closed loop of all there is – {said}."]]
    return [["Against it in closed loop – ", f"{said}."]]


def _driven_groups(table: Table, comparisons: Sequence[Mapping[str, Any]]) -> str:
    """Word by word who it is said of; of what cannot be told also what it would take."""
    parts = []
    for word in MARKS:
        if group := [c for c in comparisons if c["word"] == word]:
            names = _listed(table, [c["a"] for c in group])
            parts.append(f"{word}: {names}{_what_it_takes(group) if word == 'cannot tell' else ''}")
    return "; ".join(parts)


def _what_it_takes(comparisons: Sequence[Mapping[str, Any]]) -> str:
    """The start states that would tell, where start states are what is missing."""
    needs = [c["needs_episodes"] for c in comparisons if c["needs_episodes"] and "seeds" not in c["words"]]
    if not needs:
        return ""
    least, most = min(needs), max(needs)
    return f" (it would take about {least:,}{f' to {most:,}' if most > least else ''} start states)"


def driven_word(table: Table, where: str) -> str | None:
    """The verdict on a row's success in closed loop."""
    comparisons = (table.get("closed_loop") or {}).get("comparisons", ())
    return next((c["word"] for c in comparisons if (c["a"], c["metric"]) == (where, "success")), None)


def driven_family_words(table: Table) -> str:
    """What verdicts in closed loop rest on; nothing where there are none."""
    found = table.get("closed_loop")
    if not found or not found["comparisons"]:
        return ""
    number, name = found["family"], name_in(table, found["reference"])
    if not number:
        return "No difference was tested: a verdict needs at least five start states and two policies that do not always agree."
    together = f"{plural(number, 'comparison')} in a family of their own" if number > 1 else "One comparison"
    rival = (
        f"against the champion, {name}"
        if found["chosen"] == "champion"
        else f"against {name}, which does best from these very start states: it was chosen there, so all pairs count"
    )
    return f"{together}, {rival}; a verdict needs p ≤ 0.05 after Holm's correction."


def success_words(table: Table) -> str:
    """What success and score are of, and how their intervals were made; nothing where nothing was rolled out."""
    rolled = [row["rollouts"] for row in table["policies"] if row["rollouts"]]
    if not rolled:
        return ""
    starts, seeds = (max(one[name] for one in rolled) for name in ("n", "seeds"))
    if seeds == 1:
        return f"{starts} start states, one network (seed 0 of fold 0), Clopper–Pearson 95 %"
    return f"{starts} start states × {seeds} seeds of fold 0, 95 % over both"


# Floors ---------------------------------------------------------------------------------------------------------------


def ahead(horizon: int, fps: float) -> str:
    """When an action is, seen from its anchor."""
    if horizon == 0:
        return "first action"
    return "one second ahead" if horizon == round(fps) else f"{horizon / fps:.2g} s ahead"


def capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def floors_of(table: Table) -> list[Mapping[str, Any]]:
    """The estimates that policies are held against; those of the notebook's estimator are not."""
    return [floor for floor in table["floor"]["estimates"] if floor["estimator"] != "radius"]


def bracket_of(table: Table, floor: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The bracket that belongs to a floor; None where no policy reaches its horizon."""
    keys = ("observations", "horizon", "loss")
    return next((b for b in table["brackets"] if all(b[key] == floor[key] for key in keys)), None)


def why_not(floor: Mapping[str, Any], bracket: Mapping[str, Any] | None) -> str | None:
    """Why there is no floor: the estimator refused, or a policy is significantly below what it found."""
    if floor["refused"]:
        return floor["refused"]
    refused = bracket is not None and bracket["lower"] is None
    return bracket["words"].removeprefix("refused: ") if refused else None


def not_above(floor: Mapping[str, Any], bracket: Mapping[str, Any] | None) -> tuple[float, str | None] | None:
    """What a refused floor does not exceed, and the policy that shows it, if it is one: a floor is below every error."""
    limits: list[tuple[float, str | None]] = [(floor["below"], None)] if is_number(floor["below"]) else []
    if bracket is not None and is_number(bracket["upper"]):
        limits.append((bracket["upper"], bracket["upper_policy"]))
    return min(limits, key=lambda limit: limit[0]) if limits else None


def limit_words(table: Table, floor: Mapping[str, Any], bracket: Mapping[str, Any] | None) -> str:
    """`not above 3.34 px`, or who is already there; nothing where nothing is known."""
    limit = not_above(floor, bracket)
    if limit is None:
        return ""
    value = f"{show(limit[0])}{dataset_unit(table)}"
    return f"not above {value}" if limit[1] is None else f"not above {value}, which {name_in(table, limit[1])} reaches"


def first_step_gap(row: Row) -> Mapping[str, Any] | None:
    """How far a row's first action is above the floor of what it sees, in squared error (RMSE)."""
    gaps = (gap for gap in row["above_floor"] if (gap["horizon"], gap["loss"]) == (0, "rmse") and is_number(gap["gap"]))
    return next(gaps, None)


def gap_parts(gap: Mapping[str, Any]) -> tuple[str, str]:
    """A gap in short, and what stands beside it: `3.10`, `[2.30, 3.90]`; `at the floor`, `±0.81`."""
    low, high = gap["interval"] or (None, None)
    if low is None:
        return show(gap["gap"]), ""
    if high < 0:
        return "below", "so the floor is wrong"
    if low <= 0:
        return "at the floor", f"±{show(max(high, -low))}"
    return show(gap["gap"]), show_interval((low, high), decimals_for([high]))


def not_held(table: Table) -> bool:
    """Whether floors were measured that no policy can be held against."""
    return table["protocol"] == "notebook" and bool(floors_of(table))


def floors_at_first_step(table: Table) -> dict[str, Mapping[str, Any]]:
    """Of every observation set the floor in squared error that first actions are held against."""
    return {f["observations"]: f for f in floors_of(table) if (f["horizon"], f["loss"]) == (0, "rmse")}


def without_floor(table: Table) -> dict[str, str]:
    """Why rows that see an observation set have no gap at the first action; observation set → reason.

    Empty under `notebook`, where nothing is held against a floor at all (`NOT_HELD`).
    """
    if not table["brackets"]:
        return {}
    found = {name: why_not(f, bracket_of(table, f)) for name, f in floors_at_first_step(table).items()}
    return {name: why for name, why in found.items() if why is not None}


def _first_step_floor(table: Table, best: Row) -> list[Sentence]:
    """How far the best row's first action is from its floor, or why nobody can tell."""
    gap, rmse = first_step_gap(best), f"{dataset_unit(table)} RMSE"
    if gap is not None:
        short, beside = gap_parts(gap)
        of = f"policies seeing {best['observations']}"
        if short == "below":
            return [["It is below the estimated floor, so that estimate is wrong for this data."]]
        if short == "at the floor":
            return [["It is ", Strong("at the floor"), f" of {of} at the first action, {beside}{rmse}."]]
        above = Strong(f"{short}{rmse} above the floor")
        return [["It is ", above, f" {beside}: for {of} that is {show(gap['floor'])}{rmse} at the first action."]]
    why = without_floor(table).get(best["observations"])
    if why is None:
        return []
    if span := _first_step_span(table, best):
        return [span]
    floor = floors_at_first_step(table)[best["observations"]]
    limit = limit_words(table, floor, bracket_of(table, floor))
    rest = f" It is {limit}." if limit else ""
    of = f" of the RMSE can be given at the first action for policies seeing {best['observations']}: "
    return [[Strong("No floor"), f"{of}{why.split(': ')[0]}.{rest}"]]


def _first_step_span(table: Table, best: Row) -> Sentence | None:
    """Where the floor of the MAE lies at the first action, and whether the best row is there; None where it is refused."""
    where = (best["observations"], 0, "mae")
    floor = next((f for f in floors_of(table) if (f["observations"], f["horizon"], f["loss"]) == where), None)
    if floor is None or why_not(floor, bracket_of(table, floor)) is not None or not is_number(floor["value"]):
        return None
    places = decimals_for([floor["upper"]])
    span = f"{show(floor['value'], places)} and {show(floor['upper'], places)}{dataset_unit(table)}"
    interval = show_interval(floor["interval"], places)
    there = (
        f"{best['policy']} is above, so there is room for a better one"
        if best["first_step_mae"] > floor["interval"][1]
        else f"{best['policy']} may be there already"
    )
    sees = f" {interval} for policies seeing {best['observations']}: {there}."
    return ["At the first action the floor of the MAE lies between ", Strong(span), sees]


def _later_floor(table: Table, best: Row) -> list[Sentence]:
    """The bracket furthest ahead that has a lower end: the best row's observation set and squared error come first."""
    known = [b for b in table["brackets"] if b["horizon"] > 0 and b["lower"] is not None and b["loss"] != "l2"]
    if not known:
        return []
    later = [row for row in table["policies"] if ranks(row) and is_number(row["at_one_second_mae"])]
    sees = min(later, key=lambda row: row["at_one_second_mae"], default=best)["observations"]
    found = min(known, key=lambda b: (-b["horizon"], b["observations"] != sees, b["loss"] != "rmse", b["upper"]))
    when, unit, loss = ahead(found["horizon"], table["dataset"]["fps"]), dataset_unit(table), LOSSES[found["loss"]]
    said = [
        f"{capital(when)}, of policies seeing {found['observations']}, ",
        Strong(name_in(table, found["upper_policy"])),
    ]
    return [[*said, f" comes closest to their floor: {show(found['upper'])}{unit} {loss}, {gap_words(found, unit)}."]]


def gap_words(bracket: Mapping[str, Any], unit: str = "") -> str:
    """What lies between the floor and the best policy, in words."""
    if bracket["lower"] is None:
        return ""
    low, high = bracket["interval"] or (None, None)
    if low is None:
        return f"{show(bracket['gap'])}{unit} above the floor"
    if bracket["loss"] != "rmse" and high >= bracket["upper"]:
        return "how far above the floor cannot be told"
    if bracket["loss"] != "rmse":
        return f"at most {show(high)}{unit} above the floor"
    if low <= 0:
        return f"at the floor, within ±{show(max(high, -low))}{unit}"
    return f"{show(bracket['gap'])}{unit} {show_interval((low, high), decimals_for([high]))} above the floor"


def families_words(table: Table) -> str:
    """What a verdict rests on, in one sentence."""
    number = family(table)
    if not number:
        return "No difference was tested: a verdict needs at least five held-out episodes."
    together = f"{plural(number, 'comparison')} in one family" if number > 1 else "One comparison"
    return f"{together}; a verdict needs p ≤ 0.05 after Holm's correction."


def interval_words(table: Table) -> str:
    """How the intervals of the table were made, in short; rows with few episodes go by t."""
    methods = {row["interval_method"] for row in table["policies"] if (row.get("interval") or {}).get("first_step_mae")}
    if not methods:
        return "no interval below 5 held-out episodes"
    several_seeds = any(row["seeds"] > 1 for row in table["policies"])
    over = "held-out episodes and seeds" if several_seeds else "held-out episodes"
    given = ", for these folds" if len(table["split"]["folds"]) > 1 else ""
    return f"95 % interval: {' and '.join(sorted(methods))} over {over}{given}"
