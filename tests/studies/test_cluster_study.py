"""What a Dask cluster adds: measured on real workers, as many as the table says."""

import pytest

pytest.importorskip("distributed")
import distributed

from studies import cluster


@pytest.mark.slow
def test_the_figures_are_of_as_many_workers_as_they_say(tmp_path, monkeypatch):
    """The first argument of LocalCluster is its name: both rows were of two workers."""
    for name, value in {"CONTROLLERS": ("paper",), "SCENARIOS": ("nominal",), "CRYSTALS": 2, "EMPTY": 5}.items():
        monkeypatch.setattr(cluster, name, value)
    asked, local = [], distributed.LocalCluster

    def counted(*arguments, **settings):
        made = local(*arguments, **settings)
        asked.append(len(made.workers))
        return made

    monkeypatch.setattr(distributed, "LocalCluster", counted)
    assert cluster.main(["--out", str(tmp_path / "out" / "table.md")]) == 0
    assert asked == [1, 2]
    rows = [line.split("|")[2] for line in (tmp_path / "out" / "table.md").read_text().splitlines()[4:] if line]
    assert len(rows) == 9
    assert all(float(row) > 0.0 for row in rows[1:7])
