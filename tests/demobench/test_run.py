"""What a run says below its table."""

from demobench.commands.run import champion_news
from pipeline.store import Store
from tests.sinks.making import make_comparison
from tests.test_history import K01, K04, made, results


def test_a_champion_that_got_worse_or_was_replaced_is_news(tmp_path):
    store = Store(tmp_path / "results").ensure()
    assert champion_news(store, "tape") is None
    made(store, "f1", results())
    assert champion_news(store, "tape") is None
    made(store, "f2", results(k01=1.3, run=1))
    assert "It got worse than the result of 2026-03-02 (0.1.0 (abc1234)): error 30 % higher" in champion_news(
        store, "tape"
    )
    made(store, "f3", results(run=2), make_comparison(K04, K01, "better"))
    assert f"From the next table on the champion is {K04}" in champion_news(store, "tape")
