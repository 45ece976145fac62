"""Showing a run while it works: a tree on a terminal, plain lines elsewhere, and the one message when it fails."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from demobench.asset_tree import AssetTree, clock
from pipeline import errors
from pipeline.errors import DemobenchError
from pipeline.experiment import Target


class RunProgress:
    """One run on standard error: the tree of its assets on a terminal, else a line for each that is made.

    While Dagster captures the output of assets, file descriptors 1 and 2 point into its logs: a duplicate of standard
    error, taken before, still reaches the terminal.
    """

    def __init__(self, console: Console, target: Target, assets: Sequence[str], stale: Sequence[str]):
        self._target = target
        self._stream = os.fdopen(os.dup(2), "w")
        self._console = Console(file=self._stream, highlight=False, no_color=console.no_color)
        self._is_live = self._console.is_terminal and not self._console.is_dumb_terminal
        self._failures: dict[str, DemobenchError | None] = {}
        self._failed_checks: dict[str, str] = {}
        self._tree = AssetTree(target.key, target.experiment.budget_words, assets, stale)
        self._live = Live(self._tree, console=self._console, transient=True)

    def __enter__(self) -> "RunProgress":
        if self._is_live:
            self._live.start()
        else:
            words = f"{self._tree.to_make} assets to make, {self._target.experiment.budget_words}"
            self.say(f"[bold]{self._target.key}[/]: {words}")
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._stream.close()

    def stop(self) -> None:
        """The tree goes, and the cursor is back; the number of assets and the time stay."""
        if self._live.is_started:
            self._live.stop()
            self.say(f"[bold]{self._target.key}[/]: {self._tree.made} assets made in {clock(self._tree.seconds)}")

    def say(self, line: str) -> None:
        self._console.print(line, soft_wrap=True)

    def report(self, what: str, done: int, total: int, note: str) -> None:
        """What the asset at work says about itself; called from inside the run."""
        self._tree.count(what, done, total, note)

    def on_event(self, event: Any) -> None:
        """One Dagster event."""
        kind = event.event_type_value
        if kind == "STEP_START":
            self._tree.start(self._asset_of(event))
        elif kind == "STEP_SUCCESS":
            asset, seconds = self._asset_of(event), event.event_specific_data.duration_ms / 1000
            self._tree.finish(asset, seconds)
            if not self._is_live:
                self.say(f"[{self._tree.made:>2}/{self._tree.to_make}] {asset} {seconds:.1f} s")
        elif kind == "ASSET_CHECK_EVALUATION" and _stops(event.event_specific_data):
            check, asset = event.event_specific_data, event.event_specific_data.asset_key.to_user_string()
            why = check.metadata["why"].value if "why" in check.metadata else ""
            kept = "Nothing that depends on it was made; results before it are kept."
            self._failed_checks.setdefault(asset, f"{asset}: check '{check.check_name}' failed: {why}. {kept}")
        elif kind == "STEP_FAILURE" or (kind in ("RUN_FAILURE", "PIPELINE_FAILURE") and not self._failures):
            self._tree.fail(self._asset_of(event))
            self._failures[self._asset_of(event)] = _failure_of(getattr(event.event_specific_data, "error", None))

    @staticmethod
    def _asset_of(event: Any) -> str:
        return (event.step_key or "").replace("__", "/")

    def raise_failure(self, run_id: str) -> None:
        """The run failed: raise what the user can do something about.

        Raises:
            PoliciesFailed: nothing but policies failed.
        """
        # Dagster says of a failed check that its step failed, too.
        failures = {a: why for a, why in self._failures.items() if why is not None and a not in self._failed_checks}
        assets = [*failures, *self._failed_checks]
        unexpected = any(isinstance(why, UnexpectedError) for why in failures.values())
        if assets and not unexpected and all("/" in asset for asset in assets):
            words = {asset: str(why) for asset, why in failures.items()} | self._failed_checks
            policies = {asset: asset.split("/")[0] for asset in words}
            raise PoliciesFailed({policies[a]: said.removeprefix(f"{policies[a]}/") for a, said in words.items()})
        for words in self._failed_checks.values():
            raise DemobenchError(words)
        for why in failures.values():
            raise why
        raise DemobenchError(f"The run {run_id[:8]} failed for a reason that is in its log: demobench ui, Runs.")


def _stops(check: Any) -> bool:
    """Whether a check failed that nothing goes on after."""
    return check.blocking and not check.passed


class PoliciesFailed(DemobenchError):
    """Policies could not be trained or asked; everything else could be made. `why` is policy → what was wrong."""

    def __init__(self, why: Mapping[str, str]):
        names: dict[str, list[str]] = {}
        for policy, words in why.items():
            names.setdefault(words, []).append(policy)
        super().__init__("\n".join(f"{', '.join(policies)}: {words}" for words, policies in names.items()))
        self.why = dict(why)


class UnexpectedError(DemobenchError):
    """A fault of ours inside a run. `traceback` is what Dagster kept of it; --debug shows it."""

    def __init__(self, message: str, traceback: str):
        super().__init__(message)
        self.traceback = traceback


def _failure_of(error: Any) -> DemobenchError | None:
    """The message of our own error in a chain of causes; for any other, its last cause and where the whole is."""
    last = None
    ours = {name for name, cls in vars(errors).items() if isinstance(cls, type) and issubclass(cls, DemobenchError)}
    while error is not None:
        name, _, message = error.message.strip().partition(": ")
        if name.split(".")[-1] in ours:
            return DemobenchError(message)
        last, error = error, error.cause
    if last is None:
        return None
    words = f"{last.message.strip()} (unexpected: a fault of demobench. --debug shows where, and so does the run's log)"
    return UnexpectedError(words, last.to_string())


@contextmanager
def counting_bar(console: Console, what: str, total: int) -> Iterator[Callable[[int, int], None]]:
    """A bar for something countable; yields `update(done, total)`."""
    with Progress(
        SpinnerColumn(), TextColumn(what), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), console=console,
    ) as bars:  # fmt: skip
        task = bars.add_task(what, total=total)
        yield lambda done, total: bars.update(task, completed=done, total=total)


@contextmanager
def status_line(*, long: bool) -> Iterator[Callable[[str, int, int], None] | None]:
    """A bar on standard error for work that takes more than a moment; yields `say(what, done, total)`, or None."""
    console = Console(stderr=True)
    if not long or not console.is_terminal:
        yield None
        return
    with Progress(
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn(), console=console,
        transient=True,
    ) as bars:  # fmt: skip
        task = bars.add_task("looking", total=None)
        yield lambda what, done, total: bars.update(task, description=f"looking: {what}", completed=done, total=total)
