"""The film: a short one, whose agent it shows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym.rendering import palette
from cz_gym.rendering.canvas import TIMES, Canvas
from studies.film import __main__ as film
from studies.film.duel import draw

pytest.importorskip("pygame")


def test_another_file_than_a_gif_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Any) -> None:
    pytest.importorskip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    assert "--out must end in .gif" in refused(film.main, ["--out", "film.mp4"])
    assert not list(tmp_path.iterdir())


def test_a_short_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(film, "FRAMES", 3)
    Image = pytest.importorskip("PIL.Image")
    pytest.importorskip("onnxruntime")
    out = tmp_path / "new" / "film.gif"
    assert film.main(["--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.n_frames == 3
        assert picture.size == film.SIZE
        assert picture.info["loop"] == 0
        picture.seek(2)
        last = np.asarray(picture.convert("RGB"), np.float64)
    # The ring's marker is some fifty pixels in four hundred thousand, and keeps its colour all the same.
    assert (np.linalg.norm(last - palette.CAMERA, axis=-1) < 40.0).sum() > 30
    assert "3 frames" in capsys.readouterr().out


@pytest.mark.parametrize("samples", [200, 2160])
def test_the_scale_that_is_told_is_the_one_that_is_drawn(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    sides, canvas = film.contestants(film.SEED), Canvas(*film.SIZE)
    for side in sides:
        side.step_to(samples)
    told: list[str] = []
    monkeypatch.setattr(canvas, "text", lambda x, y, text, *others, **more: told.append(text))
    draw(canvas, sides)
    scales = [text.removeprefix("error ") for text in told if text.startswith(f"error {TIMES}")]
    assert len(set(scales)) == 1
    assert len(scales) == len(sides)
    assert any(text.startswith(f"{scales[0]}: drawn {scales[0][1:]} times as large") for text in told)
