"""`demobench compare` on a store whose errors are made by hand, so that every verdict is known beforehand."""

import io
import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import save_file

from assets_defs.plan import Plan, Unit
from demobench.cli import main
from demobench.commands.compare import compare_policies, parse_address, show_verdicts
from pipeline.config import load_config
from pipeline.errors import ConfigError, StoreError
from pipeline.experiment import from_config
from pipeline.simulate.trial import save_rollouts
from pipeline.statistics.comparisons import Comparison
from pipeline.store import Made, Store
from pipeline.types import EpisodeErrors, Rollouts

EPISODES, HORIZONS = 30, 11
CONFIG = """
[benchmark]
seeds = 3
[datasets.tape]
source = "embedded:pusht_sim"
[datasets.tape.observations]
pose = ["observation.state", "observation.environment_state"]
position = ["observation.state"]
[datasets.untouched]
source = "embedded:pusht_sim"
[policies.mlp]
method = "mlp"
chunks = [1, 16]
"""


def errors_around(level: float, *, seeds: int = 3, horizons: int = HORIZONS, seed: int = 0) -> EpisodeErrors:
    """Errors that vary a little around a level; episodes have nothing in common with those of another seed."""
    generator = np.random.default_rng(seed)
    counts = np.full((EPISODES, horizons), 20)
    means = level * (1 + 0.05 * generator.normal(size=(seeds, EPISODES, 1, 1)))
    sums = np.broadcast_to(means * 20, (seeds, EPISODES, horizons, 2)).copy()
    scale = np.ones((EPISODES, 2))
    return EpisodeErrors(np.arange(EPISODES), np.zeros(EPISODES, np.int64), counts, sums, sums**2, sums[..., 0], scale)


def rolled_out(successes: int, *, of: int = 30, version: str = "1") -> Rollouts:
    success = np.arange(of) < successes
    best = np.where(success, 1.0, 0.5)
    return Rollouts("pusht", version, "p", "pose", np.arange(of), success, best, best, np.full(of, 9), None)


class Place:
    """A configuration and a store that is filled by hand."""

    def __init__(self, folder):
        self.config, self.store = folder / "demobench.toml", Store(folder / "results")
        self.config.write_text(CONFIG)
        self.tape = from_config(load_config(self.config), "tape", folder)

    def fill(self, key: str, experiment, results, *, rollouts=None, data_hash: str = "d" * 64, split: str = "s" * 64):
        """Results of some policies: (policy, set) → errors; and what was rolled out: (policy, set) → roll-outs."""
        self.store.register(key, experiment.model_dump(mode="json"))
        plan = Plan(self.store, key, experiment, tuple(experiment.variants))
        inspected = {"content_hash": data_hash, "fps": 10.0, "action_units": ["px", "px"]}
        asked = {"asked": plan.asked_of_source(), "inspect": inspected}
        self._write(plan, Unit("demonstrations"), asked, fingerprint="f" * 16)
        self._write(plan, Unit("episode_split"), {"hash": split})
        for (policy, entry), errors in results.items():
            run_id = f"{policy}{entry}".encode().hex()
            self._write(plan, Unit(f"{policy}/trained_policy", entry), {"mlflow_run_id": run_id})
            folder = self._write(plan, Unit(f"{policy}/predictions", entry), {})
            save_file(
                {name: np.ascontiguousarray(array) for name, array in vars(errors).items()},
                folder / "errors.safetensors",
            )
            if (rolled := (rollouts or {}).get((policy, entry))) is not None:
                save_rollouts([rolled], self._write(plan, Unit(f"{policy}/rollouts", entry), {"rollouts": {"n": 1}}))

    def _write(self, plan: Plan, unit: Unit, summary, fingerprint: str | None = None):
        plan.forget()
        folder = plan.folder(unit)
        folder.mkdir(parents=True, exist_ok=True)
        self.store.write_made(folder, Made(fingerprint or plan.fingerprint(unit), summary=summary))
        return folder

    def compare(self, *addresses: str):
        out = self.store.root.parent / "out.json"
        compare_policies(addresses, self.config, str(self.store.root), str(out))
        return json.loads(out.read_text())


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    place = Place(tmp_path_factory.mktemp("user"))
    results = {
        ("hold_still", "pose"): errors_around(8.0, seeds=1, seed=1),
        ("mlp_k01", "position"): errors_around(4.0, horizons=1, seed=2),
        ("mlp_k01", "pose"): errors_around(2.0, horizons=1, seed=3),
        ("mlp_k16", "pose"): errors_around(2.0, seed=4),
    }
    rollouts = {("mlp_k01", "pose"): rolled_out(5), ("mlp_k16", "pose"): rolled_out(25)}
    place.fill("tape", place.tape, results, rollouts=rollouts)
    short = {key: results[key] for key in (("mlp_k01", "pose"), ("hold_still", "pose"))}
    place.fill("tape+notebook", place.tape.model_copy(update={"protocol": "notebook"}), short)
    place.fill("tape+quick", place.tape.model_copy(update={"steps": 600, "budget": "quick"}), short)
    place.fill("tape+other", place.tape.model_copy(update={"split_seed": 1}), short, split="t" * 64)
    place.fill("tape+newer", place.tape.model_copy(update={"history": 4}), short, data_hash="e" * 64)
    return place


def test_two_results_end_in_a_verdict_a_metric(place, capsys):
    found = place.compare("tape/mlp_k16", "tape/hold_still")
    first, second = found["comparisons"]
    assert (first["a"], first["b"], first["word"]) == ("tape/mlp_k16/pose", "tape/hold_still/pose", "better")
    assert (first["metric"], second["metric"]) == ("first_step_mae", "at_one_second_mae")
    assert first["difference"] == pytest.approx(-6, abs=0.3)
    assert first["words"] == "error 75 % lower"
    assert found["family"] == 2
    shown = " ".join(capsys.readouterr().out.split())
    for words in ("mlp_k16/pose", "better: error 75 % lower", "2 comparisons in one family", "first step, MAE, px"):
        assert words in shown


def test_a_data_set_alone_stands_for_all_pairs_of_its_table(place):
    found = place.compare("tape")
    assert len({(c["a"], c["b"]) for c in found["comparisons"]}) == 4 * 3 / 2
    assert [row["address"] for row in found["rows"]] == [
        "tape/hold_still/pose", "tape/mlp_k01/pose", "tape/mlp_k01/position", "tape/mlp_k16/pose",
    ]  # fmt: skip
    words = {(c["a"], c["b"], c["metric"]): c["word"] for c in found["comparisons"]}
    assert words["tape/mlp_k01/pose", "tape/mlp_k01/position", "first_step_mae"] == "better"
    assert words["tape/mlp_k01/pose", "tape/mlp_k16/pose", "first_step_mae"] == "cannot tell"
    assert words["tape/mlp_k01/pose", "tape/mlp_k16/pose", "success"] == "worse"
    assert words["tape/mlp_k01/pose", "tape/mlp_k16/pose", "score"] == "worse"
    assert found["family"] == len(found["comparisons"]) == 9


def test_a_narrow_console_gives_up_numbers_but_no_verdict(place, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    place.compare("tape")
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.split("left out for")[0].splitlines() if "better:" in line) <= 80
    assert "left out for want of width: visible from" in shown
    assert "better: error" in shown
    assert "cannot tell: " in shown
    assert "p, Holm   a is" in shown, "how sure a verdict is stays longer than how large the difference is"


def test_one_of_them_against_a_whole_table(place):
    found = place.compare("tape/mlp_k16", "tape")
    assert len(found["rows"]) == 4, "a result that is named twice is there once"


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ("tape+newer", "data hash differs: dddddddddddd and eeeeeeeeeeee"),
        ("tape+other", "split differs: ssssssssssss and tttttttttttt"),
        ("tape+notebook", "protocol differs: strict and notebook"),
        ("tape+quick", "budget differs: 3,000 steps and 600 steps"),
    ],
)
def test_the_first_thing_that_differs_is_said(place, capsys, other, why):
    (found,) = place.compare("tape/mlp_k01/pose", f"{other}/mlp_k01")["comparisons"]
    assert (found["word"], found["words"], found["p"]) == ("not comparable", why, None)
    assert f"not comparable: {why}" in " ".join(capsys.readouterr().out.split())


def test_the_budget_of_what_is_not_trained_does_not_matter(place):
    (found, *_) = place.compare("tape/mlp_k01/pose", "tape+quick/hold_still")["comparisons"]
    assert found["word"] == "better"


def test_a_pin_holds_while_the_store_does(place):
    rows = {row["address"]: row for row in place.compare("tape/mlp_k16", "tape/hold_still")["rows"]}
    row = rows["tape/mlp_k16/pose"]
    for pin in (row["fingerprint"], row["fingerprint"][:6], row["mlflow_run_id"][:8]):
        assert place.compare(f"tape/mlp_k16@{pin}", "tape/hold_still")["family"] == 2
    with pytest.raises(StoreError, match="no longer holds 'tape/mlp_k16@0000'.*MLflow run"):
        place.compare("tape/mlp_k16@0000", "tape/hold_still")


@pytest.mark.parametrize(
    ("addresses", "kind", "words"),
    [
        (["tpe/mlp_k01", "tape"], ConfigError, "No data set 'tpe'.*Did you mean 'tape'"),
        (["tape/mlp_k17", "tape"], ConfigError, "has no policy 'mlp_k17'. Did you mean 'mlp_k16'"),
        (["tape/mlp_k01", "tape"], ConfigError, "several observation sets: pose, position. Name one"),
        (["tape/mlp_k16/pos", "tape"], ConfigError, "no up-to-date result with the observation set 'pos'"),
        (["tape/nearest_neighbour", "tape"], ConfigError, "has no up-to-date result. Make it with: demobench run tape"),
        (["untouched/mlp_k01", "tape"], StoreError, "no up-to-date results of 'untouched'.*demobench run untouched"),
        (["tape/mlp_k16"], ConfigError, "nothing to compare tape/mlp_k16/pose with"),
        (["tape/mlp_k16", "tape/mlp_k16/pose"], ConfigError, "nothing to compare"),
        (["tape/a/b/c"], ConfigError, "is no address of a result"),
        (["tape@1f"], ConfigError, "is no address of a result"),
        (["tape/mlp_k16@"], ConfigError, "is no address of a result"),
        (["../tape/mlp_k16"], ConfigError, "is no address|No data set"),
    ],
)  # fmt: skip
def test_mistakes_are_answered(place, addresses, kind, words):
    with pytest.raises(kind, match=words):
        place.compare(*addresses)


def test_addresses_are_read_as_people_write_them(tmp_path):
    (tmp_path / "tape").mkdir()
    assert parse_address(str(tmp_path / "tape")).dataset == "tape"
    found = parse_address("tape+notebook/mlp_k16/pose@1f3a")
    assert (found.dataset, found.policy, found.observations, found.pin) == ("tape+notebook", "mlp_k16", "pose", "1f3a")
    assert parse_address("tape").policy is None


def test_results_that_are_no_longer_up_to_date_are_not_compared(tmp_path):
    place = Place(tmp_path)
    place.fill("tape", place.tape, {("hold_still", "pose"): errors_around(8.0, seeds=1)})
    place.config.write_text(CONFIG.replace("seeds = 3", 'seeds = 3\nprotocol = "notebook"'))
    with pytest.raises(StoreError, match="no up-to-date results of 'tape'.*of other data, settings"):
        place.compare("tape")


def test_more_results_than_a_family_can_carry_are_refused(tmp_path):
    place = Place(tmp_path)
    policies = place.tape.policies["mlp"].model_copy(update={"chunks": tuple(range(1, 17))})
    many = place.tape.model_copy(update={"policies": place.tape.policies | {"mlp": policies}})
    errors = errors_around(2.0, horizons=1)
    sets = ("position", "pose")
    place.fill(
        "tape+many", many, {(v.name, entry): errors for v in many.variants if v.family == "mlp" for entry in sets}
    )
    with pytest.raises(ConfigError, match="32 results make 496 pairs, too many for one family"):
        place.compare("tape+many")


def test_from_the_command_line(place, capsys, monkeypatch):
    words = ["--config", str(place.config), "--store", str(place.store.root), "--json", "-"]
    monkeypatch.setattr(sys, "argv", ["demobench", "compare", "tape/mlp_k01/pose", "tape/mlp_k16", *words])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0, "cannot tell is an answer"
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"family", "rows", "comparisons"}
    assert found["comparisons"][0]["word"] == "cannot tell"
    monkeypatch.setattr(sys, "argv", ["demobench", "compare", "tape/mlp_k17", "tape", *words])
    with pytest.raises(SystemExit) as left:
        main()
    shown = capsys.readouterr()
    assert left.value.code == 2
    assert shown.err.count("error:") == 1


def test_pairs_that_all_end_in_the_same_words_are_one_line():
    missing = "needs at least 12 held-out episodes: with fewer nothing can show among 8 comparisons"
    numbers = (0.1, (-1.0, 1.0), 0.4, 1.0, 0.5, 12, missing)
    pairs = [
        Comparison(f"tape/p{i}/state", f"tape/p{i + 1}/state", "first_step_mae", "cannot tell", *numbers)
        for i in range(8)
    ]
    entries = [
        SimpleNamespace(
            address=f"tape/p{i}/state",
            key="tape",
            policy=f"p{i}",
            observations="state",
            unit="px",
            is_elsewhere=False,
            rollouts=[],
        )
        for i in range(9)
    ]

    def shown(verdicts) -> str:
        console = Console(width=200, file=io.StringIO())
        show_verdicts(verdicts, 8, entries, console)
        return console.file.getvalue()

    all_alike = shown(pairs)
    assert f"first step, MAE, px: all 8 pairs: cannot tell: {missing}" in all_alike
    assert "for example: demobench compare tape/p0/state tape/p1/state" in all_alike
    one_stands_out = shown([*pairs[:7], replace(pairs[7], word="better", words="error 40 % lower")])
    assert one_stands_out.count(missing) == 7
    assert "for example" not in one_stands_out
