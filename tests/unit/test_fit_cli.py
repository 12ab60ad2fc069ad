"""`reconstruct fit`: where its result goes."""

from __future__ import annotations

from pathlib import Path

import pytest

from station.core.errors import InputError
from workers.reconstruct.fit_cli import _publish


def test_a_result_whose_name_was_taken_during_the_fit_is_kept(tmp_path: Path) -> None:
    made = tmp_path / ".fit-x7"
    made.mkdir()
    (made / "mesh.ply").write_bytes(b"a body")
    other = tmp_path / "result"
    other.mkdir()
    with pytest.raises(InputError, match=r"the result is in .*result-x7"):
        _publish(made, other)
    assert (tmp_path / "result-x7/mesh.ply").read_bytes() == b"a body"
    assert not list(other.iterdir())
