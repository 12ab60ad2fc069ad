"""`reconstruct measure`: the table of a result, or of a mesh in the template's topology."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import click
import numpy as np

from station.errors import InputError


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="for programs")
@click.option("--csv", "as_csv", is_flag=True, help="for spreadsheets")
def measure(source: Path, as_json: bool, as_csv: bool) -> None:
    """Measure a result folder, or a mesh in the template's topology (z up, metres).

    \b
    Examples:
      reconstruct measure spool/outbox/20261121T100000Z-7f3a
      reconstruct measure mesh.ply --csv
    """
    from workers.export.result import measurements_document
    from workers.measure.body import measure_body
    from workers.measure.definitions import DEFINITIONS
    from workers.point_cloud import read_mesh_vertices
    from workers.scape.model import load_model

    model = load_model()
    path = source / "mesh.ply" if source.is_dir() else source
    vertices = read_mesh_vertices(path)
    if len(vertices) != model.vertex_count:
        raise InputError(
            f"{path} has {len(vertices)} vertices, the template {model.vertex_count}; "
            "fit it first: reconstruct fit --cloud"
        )
    rows = measure_body(model, vertices, np.full(len(vertices), 1e-3))
    if as_json:
        click.echo(json.dumps(measurements_document(source.name, rows)))
        return
    if as_csv:
        writer = csv.writer(sys.stdout)
        writer.writerow(["name", "value_m", "low_m", "high_m", "standard"])
        for row in rows:
            writer.writerow([row.name, row.value_m, *row.interval95_m, row.standard])
        return
    for row, definition in zip(rows, DEFINITIONS, strict=True):
        click.echo(f"{row.name:<26} {100 * row.value_m:7.1f} cm  {definition.words}")
