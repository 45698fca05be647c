"""`suturetrack seed` and `suturetrack grasp`: what a person reads when it goes wrong, and what is left."""

from __future__ import annotations

import pytest

from services import cli
from services.arguments import metres
from services.zenoh_transport import socket_root
from suturetrack.types import InputError


@pytest.mark.parametrize(
    ("text", "length"), [("10mm", 0.01), ("1.5 cm", 0.015), ("0.02m", 0.02), ("-3mm", -0.003)]
)
def test_lengths_carry_their_unit(text: str, length: float) -> None:
    assert metres(text) == pytest.approx(length)


@pytest.mark.parametrize("text", ["10", "10 inch", "mm", "1,5mm", ""])
def test_a_length_without_a_unit_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="such as 10mm"):
        metres(text)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("seed 3 4", "no tracker runs on rig 'rig'; start one with `suturetrack run`"),
        ("seed", "exactly one of"),
        ("seed 3 4 --point 0 0 1", "exactly one of"),
        ("seed 3 4 --laser", "exactly one of"),
        ("seed --laser", "no frames come in which to look; no source and no segmenter and no"),
        ("seed --area 3 4 30 40", "the source does not answer; no source and no segmenter and no"),
        ("seed 3 4 --thread a/b", "thread 'a/b'"),
        ("seed 3 4 --rig a/b", "rig 'a/b'"),
        ("seed 3 4 --zenoh /nowhere.json5", "no file /nowhere.json5"),
        ("grasp --from-end 10mm", "no tracker runs"),
        ("grasp --from-end 10mm --watch", "the source does not answer; no source and no"),
        ("grasp", "exactly one of --from-end, --from-start, --fraction and --near"),
        ("grasp --from-end 10mm --fraction 0.5", "exactly one of --from-end, --from-start"),
        ("grasp --from-end 10", "such as 10mm"),
        ("status --once --rig other", "no process of rig 'other' runs"),
        ("status --rig other", "no process of rig 'other' runs"),
        ("console --port 9999999", "port 9999999: use 1 to 65535, or 0"),
    ],
)
def test_bad_calls_get_one_clear_line(
    words: str,
    reason: str,
    rig_name: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("services.client._ARRIVAL_S", 0.1)
    assert cli.call(words.split()) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert reason in err
    assert not list(socket_root().iterdir())
