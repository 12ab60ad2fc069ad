"""Bundles, calibrations, configurations, clouds and meshes that nobody in their right mind sends.

Read by the functions that the station reads them with, in processes of their own with the memory
limit of a job: one that dies is counted, and the next goes on behind it.
"""

from __future__ import annotations

import copy
import json
import os
import random
import resource
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from strange import STRANGE
from table import Row

from station.archive.surfaces import read_mesh
from station.core.bundle import read_bundle
from station.core.config_file import load_config
from station.core.errors import BoothError
from station.core.rig import Rig

_MAX_BYTES = 2 << 30
_LONGEST_BATCH = 500
_POINTS = 2000
_SHARES = {"bundle": 40, "calibration": 20, "configuration": 20, "cloud": 10, "mesh": 10}
"""Cases of each kind in a hundred."""
_CONFIGURATION = """version = 1
name = "booth"
[[cameras]]
name = "a"
driver = "recorded"
recording = "a"
[volume]
half_width_m = 0.8
[sync]
tolerance_s = 0.025
live_hz = 3.0
[scan]
framesets = 10
max_duration_s = 3.0
[spool]
folder = "spool"
min_free_mb = 500.0
[workers]
count = 1
method = "joint"
[retention]
raw_days = 7.0
[console]
port = 8420
[[deliver]]
name = "shop"
folder = "out"
"""


@dataclass(frozen=True, slots=True)
class Target:
    """A kind of file, and who reads it."""

    name: str
    folder: Path
    files: list[Path]
    spoil: Callable[[random.Random, Path, bytes], None]
    read: Callable[[random.Random], object]


def file_rows(bundle: Path, count: int, seed: int) -> list[Row]:
    """Damage files of each kind, so many in all, and read them."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for target in _targets(bundle, Path(name)):
            share = max(1, count * _SHARES[target.name] // 100)
            deaths, peak_bytes = _all_cases(target, share, seed)
            rows.append(
                Row(
                    f"fuzzed: {target.name}",
                    "0 deaths, clear words, < 2 GB",
                    f"{share}, {deaths} deaths, peak {peak_bytes / 1e9:.2f} GB",
                    deaths == 0 and peak_bytes < _MAX_BYTES,
                )
            )
    return rows


def _targets(bundle: Path, folder: Path) -> list[Target]:
    scan = folder / "scan"
    shutil.copytree(bundle, scan)
    files = sorted(path for path in scan.rglob("*") if path.is_file())
    documents = [path for path in files if path.suffix == ".json"]

    def read_scan(_: random.Random) -> None:
        read = read_bundle(scan)
        for camera, frames in read.frames.items():
            for frame in frames[:1]:
                read.read_frame(camera, frame)

    rig, booth, cloud, mesh = (
        folder / "calibration.json", folder / "booth.toml", folder / "cloud.ply",
        folder / "mesh.ply",
    )  # fmt: skip
    rig.write_bytes((scan / "calibration.json").read_bytes())
    booth.write_text(_CONFIGURATION)
    cloud.write_text(_cloud())
    mesh.write_bytes(_mesh())

    def read_a_cloud(_: random.Random) -> None:
        from workers.cloud.cloud_file import read_cloud

        read_cloud(cloud, "z")

    def read_a_mesh(rng: random.Random) -> None:
        from workers.cloud.cloud_file import read_template_mesh

        if rng.random() < 0.5:
            read_mesh(mesh)
        else:
            read_template_mesh(mesh, np.zeros((1, 3), np.int32), "z")

    return [
        Target("bundle", scan, [*(2 * documents), *files], _spoil_bundle, read_scan),
        Target("calibration", rig, [rig], _spoil_document, lambda _: Rig.load(rig)),
        Target("configuration", booth, [booth], _spoil_text, lambda _: load_config(booth)),
        Target("cloud", cloud, [cloud], _spoil_model, read_a_cloud),
        Target("mesh", mesh, [mesh], _spoil_model, read_a_mesh),
    ]


def _cloud() -> str:
    """A cylinder of a person's size, with normals, as an ASCII PLY."""
    angle = np.linspace(0.0, 40.0 * np.pi, _POINTS)
    normal = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    points = 0.2 * normal + np.linspace(0.0, 1.7, _POINTS)[:, None] * (0.0, 0.0, 1.0)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    rows = "\n".join(
        " ".join(f"{value:.4f}" for value in row) for row in np.hstack([points, normal])
    )
    return f"ply\nformat ascii 1.0\nelement vertex {_POINTS}\n{names}end_header\n{rows}\n"


def _mesh() -> bytes:
    from workers.export.meshes import ply_mesh

    return ply_mesh(
        np.random.default_rng(0).normal(size=(60, 3)),
        np.arange(60, dtype=np.int32).reshape(20, 3),
        [],
    )


def _all_cases(target: Target, count: int, seed: int) -> tuple[int, int]:
    """Deaths, and the largest memory of a process."""
    deaths, peak_bytes, done = 0, 0, 0
    wholes = {path: path.read_bytes() for path in target.files}
    while done < count:
        batch = range(done, min(count, done + _LONGEST_BATCH))
        got, wrong, peak = _in_a_process(target, wholes, batch, seed)
        deaths += wrong
        peak_bytes = max(peak_bytes, peak)
        if got < len(batch):
            deaths += 1
            print(f"        {target.name} {seed}.{done + got}: its reader died", flush=True)
            got += 1
        done += got
        _mend(wholes)
    return deaths, peak_bytes


def _in_a_process(
    target: Target, wholes: dict[Path, bytes], batch: range, seed: int
) -> tuple[int, int, int]:
    """Cases that were got through, deaths among them, and the process' largest memory, bytes."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(reading)
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, 2)
            resource.setrlimit(resource.RLIMIT_DATA, (_MAX_BYTES, _MAX_BYTES))
            for case in batch:
                words = _case(target, wholes, random.Random(f"{seed}.{case}"))
                os.write(writing, b"!" if words else b".")
                if words:
                    os.write(1, f"        {target.name} {seed}.{case}: {words:.200}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as said:
        marks = said.read()
    _, _, used = os.wait4(pid, 0)
    return len(marks), marks.count(b"!"), 1024 * used.ru_maxrss


def _case(target: Target, wholes: dict[Path, bytes], rng: random.Random) -> str:
    """Spoil one file and read it; what escaped, or nothing."""
    path = rng.choice(target.files)
    target.spoil(rng, path, wholes[path])
    try:
        target.read(rng)
    except BoothError as error:
        return f"words in several lines: {error!a}" if "\n" in str(error) else ""
    except BaseException as error:
        return f"{type(error).__name__}: {error!a}"
    finally:
        _mend({path: wholes[path]})
    return ""


def _mend(wholes: dict[Path, bytes]) -> None:
    for path, whole in wholes.items():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.write_bytes(whole)


def _spoil_bundle(rng: random.Random, path: Path, whole: bytes) -> None:
    if rng.random() < 0.05:
        _put_no_file(rng, path)
    elif path.suffix == ".json":
        _spoil_document(rng, path, whole)
    elif rng.random() < 0.3:
        path.write_bytes(_huge_picture(rng))
    else:
        path.write_bytes(_spoilt(rng, whole))


def _put_no_file(rng: random.Random, path: Path) -> None:
    """Something else under a file's name."""
    path.unlink()
    kind = rng.randrange(5)
    if kind == 0:
        path.symlink_to(rng.choice(["/dev/zero", "/dev/random", "/etc/passwd", path.name]))
    elif kind == 1:
        os.mkfifo(path)
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        with path.open("wb") as stream:
            stream.truncate(rng.choice([1 << 29, 1 << 33]))


def _huge_picture(rng: random.Random) -> bytes:
    """A PNG that says to be large, its checksums right."""
    size = rng.choice([0, 1, 30_000, 2**31 - 1])
    depth, colour = rng.choice([(16, 0), (8, 2), (1, 0), (16, 6)])
    parts = [(b"IHDR", struct.pack(">IIBBBBB", size, size, depth, colour, 0, 0, 0))]
    parts += [(b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in parts:
        code = zlib.crc32(kind + content)
        data += struct.pack(">I", len(content)) + kind + content + struct.pack(">I", code)
    return data


def _spoil_document(rng: random.Random, path: Path, whole: bytes) -> None:
    if rng.random() < 0.02:
        opening = rng.choice([b"[", b'{"a":'])
        path.write_bytes(opening * rng.choice([1000, 100_000]))
    elif rng.random() < 0.8:
        document = json.loads(whole)
        for _ in range(rng.randrange(1, 4)):
            _put_something_strange(rng, document)
        path.write_text(json.dumps(document, default=str), encoding="utf-8")
    else:
        path.write_bytes(_spoilt(rng, whole))


def _put_something_strange(rng: random.Random, document: Any) -> None:
    while True:
        keys = list(document) if isinstance(document, dict) else list(range(len(document)))
        if not keys:
            return
        key = rng.choice(keys)
        if isinstance(document[key], dict | list) and document[key] and rng.random() < 0.8:
            document = document[key]
            continue
        if rng.random() < 0.1 and isinstance(document, dict):
            del document[key]
        else:
            # A copy: the next strange thing may be put into this one.
            document[key] = copy.deepcopy(rng.choice(STRANGE))
        return


def _spoil_text(rng: random.Random, path: Path, whole: bytes) -> None:
    """Values, keys and lines of a TOML file that are others."""
    lines = whole.decode().splitlines()
    for _ in range(rng.randrange(1, 4)):
        index = rng.randrange(len(lines))
        key, equals, _ = lines[index].partition("=")
        way = rng.randrange(5)
        if way == 0 and equals:
            values = ("nan", "inf", "-1", "9" * 30, '""', "[]", "{}", "true", '"../../x"', "[[1]]")
            lines[index] = f"{key}={rng.choice((*values, json.dumps('e' * 3000)))}"
        elif way == 1:
            lines.insert(index, lines[rng.randrange(len(lines))])
        elif way == 2:
            del lines[index]
            lines = lines or [""]
        elif way == 3:
            lines[index] = lines[index].replace("a", rng.choice(["\0", "é", "\x1b", "", "]", '"']))
    data = "\n".join(lines).encode()
    path.write_bytes(_spoilt(rng, data) if rng.random() < 0.2 and data else data)


def _spoil_model(rng: random.Random, path: Path, whole: bytes) -> None:
    """A PLY file whose head promises something else, or whose values are none."""
    head, _, body = whole.partition(b"end_header\n")
    lines = head.split(b"\n")
    index = rng.randrange(len(lines))
    way = rng.randrange(6)
    if way == 0:
        count = rng.choice([b"0", b"-1", b"4000000000", b"99999999999999999999", b"7", b"x"])
        lines = [
            b" ".join([*line.split()[:2], count]) if line.startswith(b"element") else line
            for line in lines
        ]
    elif way == 1:
        lines[index] = rng.choice([b"", b"element", b"property", b"property list uchar int x"])
    elif way == 2:
        lines.insert(index, rng.choice(lines))
    elif way == 3:
        body = body.replace(b"0.1", rng.choice([b"nan", b"1e999", b"-inf", b"x"]), 50)
    elif way == 4:
        body = body[: rng.randrange(len(body))]
    data = b"\n".join(lines) + b"end_header\n" + body
    path.write_bytes(_spoilt(rng, data) if way == 5 else data)


def _spoilt(rng: random.Random, whole: bytes) -> bytes:
    spoilt = bytearray(whole)
    for _ in range(rng.randrange(1, 9)):
        spoilt[rng.randrange(min(len(spoilt), 4096))] = rng.randrange(256)
    return bytes(spoilt[: rng.randrange(len(spoilt))]) if rng.random() < 0.3 else bytes(spoilt)
