"""How often detectors are wrong on clean data, and how often they find faults.

    python -m speed.inspect_faults [--alarms] [--first-seed N] [FOLDER …]

Clean data: the known-truth generators, a made-up arm, the embedded demonstrations a few at a time. Folders of real data
sets may be named; faults are planted in copies of them in memory as well. Prints Markdown, which docs/inspect.md holds.
"""

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from pipeline.inspection.finding import CHECKS, Finding
from pipeline.inspection.look import inspect
from pipeline.lerobot_format.quality import resolve_semantics
from pipeline.lerobot_format.read import load_source
from pipeline.statistics.known_truth.generators import GENERATORS
from pipeline.types import Demonstrations, Semantics
from speed.planted import FAULTS, WHOLE, Fault, made_arm, some_episodes

SEEDS, SIZES = 10, (12, 50)
PLANTED = 10
"""How often each fault is planted in each data set, each time in another episode."""

Named = dict[str, list[tuple[Demonstrations, Semantics]]]


def clean_sets(folders: list[str], first_seed: int = 0) -> Named:
    """Kind of clean data → data sets of it."""
    here = Path.cwd()
    found: Named = defaultdict(list)
    for size in SIZES:
        for seed in range(first_seed, first_seed + SEEDS):
            for name, generator in GENERATORS.items():
                truth = generator.build(size, seed)
                found[f"generator {name}"].append((truth.demos, truth.semantics))
            arm = made_arm(size, seed)
            found["made-up arm"].append((arm, resolve_semantics(arm)))
    pusht = load_source("embedded:pusht_sim", name="pusht_sim", config_dir=here)
    for seed in range(first_seed, first_seed + 2 * SEEDS):
        chosen = np.random.default_rng(seed).permutation(pusht.episodes)[: SIZES[seed % 2]]
        part = some_episodes(pusht, np.sort(chosen))
        found["pusht_sim, some episodes"].append((part, resolve_semantics(part)))
    for folder in folders:
        real = load_source(folder, name=Path(folder).name, config_dir=here)
        found[Path(folder).name].append((real, resolve_semantics(real)))
    return dict(found)


def alarms(sets: Named) -> list[str]:
    """For every kind of clean data: data sets with any finding, and findings of each check."""
    lines = ["| clean data | data sets | with a finding | findings by check |", "|---|---|---|---|"]
    total, wrong = 0, 0
    for name, each in sets.items():
        counts: Counter[str] = Counter()
        with_any = 0
        for demos, semantics in each:
            findings = inspect(demos, semantics).findings
            counts.update(finding.check for finding in findings)
            with_any += bool(findings)
        said = ", ".join(f"{check} {count}" for check, count in counts.most_common()) or "none"
        lines.append(f"| {name} | {len(each)} | {with_any} | {said} |")
        total, wrong = total + len(each), wrong + with_any
    return [*lines, f"| all | {total} | {wrong} | |"]


def _hit(findings: tuple[Finding, ...], check: str, episodes: set[int] | None) -> bool:
    return any(f.check == check and (episodes is None or f.episode in episodes) for f in findings)


def _hits(fault: Fault, demos: Demonstrations) -> tuple[int, int]:
    """How often the fault was found in its episode, of how many times it was planted."""
    random = np.random.default_rng(0)
    positions = random.permutation(demos.episodes)[:PLANTED]
    found = 0
    for position in positions:
        changed, numbers = fault.plant(demos, int(position), random)
        found += _hit(inspect(changed, resolve_semantics(changed)).findings, fault.check, numbers)
    return found, len(positions)


def hits(sets: Named) -> list[str]:
    """For every fault and a data set of each kind: how often it was found where it was planted."""
    names = [name for name in sets if not name.startswith("generator") or name == "generator arm"]
    chosen = {name: sets[name][-1] for name in names}
    lines = [f"| fault | check | {' | '.join(names)} |", "|---|---|" + "---|" * len(names)]
    for fault in FAULTS:
        cells = []
        for demos, semantics in chosen.values():
            if fault.needs_commands and not any(column is not None for column in semantics.state_column):
                cells.append("—")
                continue
            found, planted = _hits(fault, demos)
            cells.append(f"{found} of {planted}")
        lines.append(f"| {fault.name} | {fault.check} | {' | '.join(cells)} |")
    for name, (check, change) in WHOLE.items():
        cells = []
        for demos, _ in chosen.values():
            changed = change(demos)
            before = inspect(demos, resolve_semantics(demos)).findings
            after = inspect(changed, resolve_semantics(changed)).findings
            new = {f.words for f in after if f.check == check} - {f.words for f in before}
            cells.append("yes" if new else "no")
        lines.append(f"| {name} (all episodes) | {check} | {' | '.join(cells)} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", help="real data sets")
    parser.add_argument("--first-seed", type=int, default=0, help="thresholds were chosen on seeds 0 to 9")
    parser.add_argument("--alarms", action="store_true", help="clean data only")
    asked = parser.parse_args()
    sets = clean_sets(asked.folders, asked.first_seed)
    print(f"Checks: {', '.join(CHECKS)}.\n")
    print("\n".join(alarms(sets)), end="\n\n", flush=True)
    if not asked.alarms:
        print("\n".join(hits(sets)))


if __name__ == "__main__":
    main()
