from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator

import pytest


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Name of a rig whose sockets lie in a directory of the test's own, with a short path."""
    directory = tempfile.mkdtemp(prefix="suturetrack-")
    monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
    yield "test"
    shutil.rmtree(directory)
