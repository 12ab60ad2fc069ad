"""Resources that the model takes: time to load, time to evaluate, memory."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workers.scape.model.body_model import load_model
from workers.scape.model.cache import FOLDER_VARIABLE
from workers.scape.model.sampled import SampledBody

SAMPLES = 3000
_REPEATS = 15


@dataclass(frozen=True, slots=True)
class Span:
    """Duration by the clock and in processor time; they differ on a busy machine."""

    wall_s: float
    processor_s: float


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources that the model takes in a process of its own."""

    load: Span
    """Loading the file and deriving everything that depends on it."""
    body: Span
    jacobian: Span
    peak_bytes: int


def measure_resources(path: Path | None) -> tuple[Resources, Resources]:
    """Resources with an empty cache and with a filled one, each in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        return _in_child(path, folder), _in_child(path, folder)


def _in_child(path: Path | None, folder: str) -> Resources:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as child:
        return child.submit(_measured, path, folder).result()


def _measured(path: Path | None, folder: str) -> Resources:
    os.environ[FOLDER_VARIABLE] = folder
    start = time.perf_counter(), time.process_time()
    model = load_model(path)
    samples = SampledBody.build(
        model, np.linspace(0, model.vertex_count - 1, SAMPLES).astype(np.int64)
    )
    state = model.neutral_state()
    model.vertices(state)
    load = Span(time.perf_counter() - start[0], time.process_time() - start[1])
    body = _median_span(lambda: model.vertices(state))
    jacobian = _median_span(lambda: samples.jacobian(state))
    return Resources(load, body, jacobian, _peak_bytes())


def _median_span(call: Callable[[], object]) -> Span:
    call()
    spans = []
    for _ in range(_REPEATS):
        start = time.perf_counter(), time.process_time()
        call()
        spans.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall_s, processor_s = np.median(spans, axis=0)
    return Span(float(wall_s), float(processor_s))


def _peak_bytes() -> int:
    """Highest resident memory of this process alone (getrusage would count its parent's)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    raise OSError("/proc/self/status names no peak of memory")
