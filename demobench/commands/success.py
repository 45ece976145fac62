"""`demobench success`: reads counts or a file of trials, prints what they show.

What does not belong here: rates, intervals, tests (`pipeline.statistics.success`), reading the CSV
(`pipeline.statistics.trials`).
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from demobench.commands.session import write_json_to
from pipeline.errors import ConfigError
from pipeline.statistics import success
from pipeline.statistics.trials import read_trials

COUNT = re.compile(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*")
EXPECTED = "Expected counts such as 18/20 16/20, or one CSV file of trials."
COLOURS = {"better": "green", "worse": "red", "cannot tell": "yellow", "not comparable": "yellow"}


def judge_success(words: Sequence[str], json_to: str | None) -> None:
    """Say what counts, or the trials of a file, show.

    Raises
    ------
    ConfigError : a word is neither a count nor a file, or a count is impossible.
    DatasetError : the file is not a table of trials.
    """
    if len(words) == 1 and not COUNT.fullmatch(words[0]) and Path(words[0]).exists():
        found = _of_trials(Path(words[0]))
    else:
        found = _of_counts(words)
    if json_to != "-":
        show_success(found, Console(highlight=False))
    write_json_to(json_to, found)


def _of_trials(path: Path) -> dict[str, Any]:
    trials = read_trials(path)
    comparisons = success.compare_trials(trials)
    return _found(success.counts_of(trials), comparisons, success.describe_stages(trials))


def _of_counts(words: Sequence[str]) -> dict[str, Any]:
    counts = [_count(word) for word in words]
    repeated = {name for name, times in Counter(count.policy for count in counts).items() if times > 1}
    names = [f"{c.policy} ({i})" if c.policy in repeated else c.policy for i, c in enumerate(counts, 1)]
    counts = [success.Count(name, c.successes, c.trials) for name, c in zip(names, counts, strict=True)]
    return _found(counts, success.compare_counts(counts), [])


def _found(counts: Sequence[success.Count], comparisons: Sequence[Any], stages: list[dict]) -> dict[str, Any]:
    return {
        "policies": [success.describe_count(count) for count in counts],
        "comparisons": [asdict(comparison) for comparison in comparisons],
        "stages": stages,
    }


def _count(word: str) -> success.Count:
    """`18/20` → a count."""
    match = COUNT.fullmatch(word)
    if match is None:
        raise ConfigError(_why_no_count(word))
    successes, trials = map(int, match.groups())
    if trials == 0:
        raise ConfigError(f"'{word}' has no trials. Expected at least one, as in 0/1.")
    if successes > trials:
        turned = f" Did you mean {trials}/{successes}?"
        raise ConfigError(f"'{word}' has {successes} successes in {trials} trials. Expected successes/trials.{turned}")
    return success.Count(f"{successes}/{trials}", successes, trials)


def _why_no_count(word: str) -> str:
    numbers = re.findall(r"\d+", word)
    if re.fullmatch(r"\s*-\s*\d+\s*/.*|.*/\s*-\s*\d+\s*", word):
        return f"'{word}' has a negative number. {EXPECTED}"
    if word.startswith("--"):
        return f"There is no option '{word}'. Known: --json, --help."
    if Path(word).exists():
        return f"'{word}' is a file among counts. {EXPECTED}"
    if re.fullmatch(r"\s*\d{1,9}\s*([^\d/]|of|out of)\s*\d{1,9}\s*", word) and int(numbers[0]) <= int(numbers[1]):
        return f"'{word}' is not a count. {EXPECTED} Did you mean {numbers[0]}/{numbers[1]}?"
    return f"'{word}' is neither a count nor a file that exists. {EXPECTED}"


# printing -------------------------------------------------------------------------------------------------------------


def show_success(found: Mapping[str, Any], console: Console) -> None:
    """Rates, stages and comparisons as tables, then each in one plain sentence."""
    console.print(_rates(found["policies"]))
    if found["stages"]:
        console.print(_stages(found["stages"]))
    if found["comparisons"]:
        console.print(_comparisons(found["comparisons"]))
    for row in [*found["policies"], *found["comparisons"]]:
        console.print(escape(row["words"]))
    if len(found["policies"]) == 1:
        console.print("One count alone says nothing about another policy: give two to compare them.", style="dim")
    elif any(pair["fisher"] is not None for pair in found["comparisons"]):
        console.print(
            "The verdict is by the test that is named. Fisher's, beside it, is exact too but conservative: it misses more.",
            style="dim",
        )


def _rates(policies: Sequence[Mapping[str, Any]]) -> Table:
    table = Table("policy", "successes", "rate", "Clopper–Pearson", "Wilson", title_justify="left",
                  title="Success rates with 95 % intervals")  # fmt: skip
    for row in policies:
        intervals = (f"{100 * low:.1f} – {100 * high:.1f} %" for low, high in (row["clopper_pearson"], row["wilson"]))
        count = f"{row['successes']:,} of {row['trials']:,}"
        table.add_row(escape(row["policy"]), count, f"{100 * row['rate']:.1f} %", *intervals)
    return table


def _stages(stages: Sequence[Mapping[str, Any]]) -> Table:
    kind = "reached" if "reached" in stages[0] else "ended_at"
    title = "Trials that reached each stage" if kind == "reached" else "Trials that ended at each stage"
    table = Table("policy", *map(escape, stages[0][kind]), title=title, title_justify="left")
    if kind == "reached":
        table.add_column("mean stage")
    for row in stages:
        mean = [] if row["mean_stage"] is None else [f"{row['mean_stage']:.2f}"]
        table.add_row(escape(row["policy"]), *map(str, row[kind].values()), *mean)
    return table


def _comparisons(pairs: Sequence[Mapping[str, Any]]) -> Table:
    fisher, several = any(pair["fisher"] is not None for pair in pairs), len(pairs) > 1
    heads = ["a", "b", "a − b", "test", "p", *["after Holm"] * several, *["Fisher's p (conservative)"] * fisher, "a is"]
    table = Table(*heads, title="Comparisons", title_justify="left")
    for pair in pairs:
        difference = "–" if pair["difference"] is None else f"{100 * pair['difference']:+.1f} points"
        optional = [_p(pair["p_holm"])] * several + [_p(pair["fisher"])] * fisher
        word = f"[{COLOURS[pair['word']]}]{pair['word']}[/]"
        cells = [escape(pair["a"]), escape(pair["b"]), difference, pair["test"] or "–", _p(pair["p"]), *optional, word]
        table.add_row(*cells)
    return table


def _p(value: float | None) -> str:
    return "–" if value is None else "< 0.001" if value < 0.001 else f"{value:.3f}"
