"""The camera's study, made small: what it says of the ring, and that its pictures can be drawn."""

import json

import numpy as np
import pytest

from cz_gym.support.units import MM
from studies import camera as study


@pytest.mark.slow
def test_the_study_measures_and_draws(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "RADII", np.linspace(-8.0, 8.0, 3) * MM)
    monkeypatch.setattr(study, "HEIGHTS", np.zeros(1))
    monkeypatch.setattr(study, "HORIZON", 20.0)
    assert study.main(["--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "camera.json").read_text())
    assert found["images"] == 3
    assert found["images_without_ring"] == 0
    assert found["largest_difference_px"]["traced"] < 1.0
    assert found["gain_by_radius"]["traced"] == pytest.approx(1.0, abs=0.02)
    for response in found["responses"]:
        assert response["depth_um"]["traced"] > 0.0, "less pull, and the ring first shrinks"
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".png"}
