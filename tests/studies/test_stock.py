"""The study of stock learners: runs that are held are not trained again; bad names are one line."""

from studies import stock


def test_runs_are_kept_and_the_table_has_each_seed(tmp_path, monkeypatch, capsys):
    trained = []

    def train(name, seed):
        trained.append((name, seed))
        return [(stock.LEARNERS[name].words, seed, steps, 0.1 + seed, 0.005) for steps in (1_000_000, 2_000_000)]

    monkeypatch.setattr(stock, "train", train)
    name = next(iter(stock.LEARNERS))
    for seeds in ("1", "2"):
        assert stock.main([name, "--seeds", seeds, "--out", str(tmp_path)]) == 0
    assert trained == [(name, 0), (name, 1)]
    assert (
        f"| {stock.LEARNERS[name].words} | 2 M | 2 | 0.100 / 1.100 | 0.5 / 0.5 |" in (tmp_path / "table.md").read_text()
    )
    assert capsys.readouterr().out.count("# Stock learners") == 2
    assert stock.main(["sac", "--out", str(tmp_path)]) == 2
    assert "unknown learner 'sac'" in capsys.readouterr().err
    (tmp_path / "runs.csv").write_text("learner\n\nppo")
    assert stock.main([name, "--out", str(tmp_path)]) == 2
    assert "no runs of this study, or damaged" in capsys.readouterr().err
