"""How often the regression gate alarms at nothing, and how often it sees an error that rose by a fifth.

    python -m speed.gate [--pairs N]

Prints Markdown, which docs/automation.md holds: 400 pairs a row, which takes some ten minutes of one core.
"""

import argparse

from pipeline.statistics.known_truth.gate import SETTINGS, rate, study_gate

WEEKS = 52


def line(words: str, found: dict[str, list[bool]]) -> str:
    """One row of the table."""
    (alarm, low, high), seen = (rate(found[name]) for name in ("alarm", "seen"))
    share = " | ".join(f"{100 * p:.1f} ({100 * a:.1f} … {100 * b:.1f})" for p, a, b in ((alarm, low, high), seen))
    return (
        f"| {words} | {share} | {WEEKS * alarm:.1f} ({WEEKS * low:.1f} … {WEEKS * high:.1f}) | {len(found['alarm'])} |"
    )


def main() -> None:
    """Print a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=400)
    pairs = parser.parse_args().pairs
    print(
        "| two results of one policy | false alarms, % | a fifth worse is seen, % | false alarms in 52 runs | pairs |"
    )
    print("|---|---|---|---|---|")
    for setting in SETTINGS:
        print(line(setting.words, study_gate(setting, range(pairs))), flush=True)


if __name__ == "__main__":
    main()
