"""The tree of a run, drawn on screens of several sizes."""

from rich.console import Console

from demobench.asset_tree import AssetTree, clock

POLICIES = [f"mlp_k{n:02d}" for n in range(20)]
ASSETS = [
    "demonstrations", "episode_split", "multimodality_floor",
    *(f"{policy}/{kind}" for kind in ("trained_policy", "predictions", "rollouts") for policy in POLICIES),
    "benchmark_table", "mcap_log",
]  # fmt: skip


def drawn(tree: AssetTree, width: int = 100, height: int = 40) -> list[str]:
    console = Console(width=width, height=height, no_color=True)
    with console.capture() as capture:
        console.print(tree)
    return capture.get().rstrip("\n").split("\n")


def test_a_policy_is_a_line_with_what_was_kept_what_was_made_and_what_waits():
    tree = AssetTree("tape", "2 seeds × 6 steps", ASSETS, [a for a in ASSETS if a.startswith("mlp_k03")])
    tree.start("mlp_k03/trained_policy")
    tree.finish("mlp_k03/trained_policy", 12.34)
    tree.start("mlp_k03/predictions")
    tree.count("mlp_k03 pose", 5, 20, "loss 0.5")
    lines = drawn(tree)
    assert "tape  2 seeds × 6 steps · 1 of 3 made" in lines[0]
    here = next(i for i, line in enumerate(lines) if "mlp_k03" in line)
    assert "✓ trained 12.3 s  ▸ predictions  · roll-outs" in lines[here]
    assert "mlp_k03 pose  ━━━━━━──────────────────  5/20" in lines[here + 1]
    assert "loss 0.5" in lines[here + 1]
    assert "✓ trained kept  ✓ predictions kept  ✓ roll-outs kept" in next(line for line in lines if "mlp_k04" in line)
    assert "✓ read kept" in next(line for line in lines if "data" in line)
    assert len(lines) == 1 + 2 + 20 + 1 + 1


def test_a_low_screen_shows_what_is_at_work_and_folds_the_rest():
    tree = AssetTree("tape", "", ASSETS, ASSETS)
    for asset in ASSETS[:5]:
        tree.finish(asset, 1.0)
    for policy in POLICIES[:10]:
        for kind in ("trained_policy", "predictions", "rollouts"):
            tree.finish(f"{policy}/{kind}", 1.0)
    tree.start("mlp_k10/trained_policy")
    tree.count("mlp_k10 pose", 1, 1, "")
    lines = drawn(tree, height=12)
    assert len(lines) <= 12
    text = "\n".join(lines)
    assert "▸ trained" in text
    assert "more made or kept" in text
    assert "more wait" in text
    assert "▸ trained" in "\n".join(drawn(tree, height=6))


def test_a_narrow_screen_cuts_lines_and_never_wraps_them():
    tree = AssetTree("tape", "2 seeds × 6 steps", ASSETS, ASSETS)
    lines = drawn(tree, width=40, height=60)
    assert max(map(len, lines)) <= 40
    assert len(lines) == 1 + 2 + 20 + 1


def test_what_fails_is_marked_and_what_nobody_knew_of_is_added():
    tree = AssetTree("tape", "", ["demonstrations"], ["learning_curve"])
    tree.fail("learning_curve")
    tree.finish("of_somebody_else", 1.0)
    assert "✗ learning curve" in "\n".join(drawn(tree))


def test_clocks():
    assert (clock(7.4), clock(83), clock(3723)) == ("0:07", "1:23", "1:02:03")
