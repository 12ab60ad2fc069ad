from pathlib import Path

import numpy as np
import pytest

from workers.scape.model.cache import FOLDER_VARIABLE, Arrays, cached_arrays


@pytest.fixture
def builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "cache"))
    return []


def _arrays(builds: list[int]) -> Arrays:
    def build() -> Arrays:
        builds.append(1)
        return {"a": np.arange(5000, dtype=np.float32), "b": np.eye(3)}

    return cached_arrays("key", build)


def test_a_second_call_reads_what_the_first_wrote(builds: list[int]) -> None:
    first, second = _arrays(builds), _arrays(builds)
    assert len(builds) == 1
    assert all(np.array_equal(first[name], second[name]) for name in ("a", "b"))


@pytest.mark.parametrize("damage", ["cut short", "a bit turned", "empty", "something else"])
def test_a_torn_cache_is_built_anew(builds: list[int], tmp_path: Path, damage: str) -> None:
    _arrays(builds)
    path = tmp_path / "cache/key.npz"
    content = bytearray(path.read_bytes())
    if damage == "cut short":
        content = content[: len(content) // 2]
    elif damage == "a bit turned":
        content[len(content) // 3] ^= 1
    else:
        content = bytearray() if damage == "empty" else bytearray(b"hello")
    path.write_bytes(content)
    assert np.array_equal(_arrays(builds)["a"], np.arange(5000))
    _arrays(builds)
    assert len(builds) == 2


def test_a_cache_that_cannot_be_written_is_done_without(
    builds: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv(FOLDER_VARIABLE, str(blocked / "cache"))
    assert np.array_equal(_arrays(builds)["b"], np.eye(3))
