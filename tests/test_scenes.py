"""Pictures of the bench top from the command line."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from services.scenes import ScenesConfig, run
from suturetrack.types import InputError


def test_one_picture_holds_a_row_for_each_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(ScenesConfig(tmp_path / "s.png", ("figure8-107", "knot")))
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture is not None
    assert picture.shape == (2 * 240, 4 * 320, 3)
    assert capsys.readouterr().out.startswith("figure8-107    107 mm of thread")


def test_what_cannot_be_shown_or_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no scenario 'nowhere'.*figure8-107"):
        run(ScenesConfig(tmp_path / "s.png", ("nowhere",)))
    with pytest.raises(InputError, match=r"must end in \.png or \.jpg"):
        run(ScenesConfig(tmp_path / "s.foo", ("figure8-107",)))
    with pytest.raises(InputError, match="cannot be written"):
        run(ScenesConfig(tmp_path / "none" / "s.png", ("figure8-107",)))
