"""`reconstruct train`, `reconstruct evaluate-model` and `reconstruct population`."""

from __future__ import annotations

from pathlib import Path

import click

from station.core.commands import writable_folder

_COUNT, _SEED = click.IntRange(1), click.IntRange(0)


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="model file to write (.npz)",
)
@click.option(
    "--seed",
    type=_SEED,
    default=0,
    show_default=True,
    help="the same seed learns the same model",
)
@click.option(
    "--bodies", type=click.IntRange(2), default=1600, show_default=True, help="training bodies"
)
@click.option(
    "--poses", type=click.IntRange(4), default=1000, show_default=True, help="training poses"
)
@click.option(
    "--components",
    type=_COUNT,
    default=160,
    show_default=True,
    help="shape components kept",
)
def train(out: Path, seed: int, bodies: int, poses: int, components: int) -> None:
    """Build the database and learn the body model (minutes; needs the train extra).

    \b
    Examples:
      reconstruct train --out workers/scape/model/data/body.npz
      reconstruct train --out small.npz --bodies 300 --poses 100 --components 40
    """
    writable_folder(out.parent, "--out")
    from workers.scape.learn.train import TrainingPlan
    from workers.scape.learn.train import train as learn

    def show(step: str, share: float) -> None:
        click.echo(f"{100 * share:3.0f} %  {step}")

    learn(out, TrainingPlan(bodies, poses, components, seed), show)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


@click.command()
@click.option("--model", type=click.Path(path_type=Path), help="the shipped one if absent")
@click.option("--bodies", type=_COUNT, default=100, show_default=True, help="held-out bodies")
@click.option("--seed", type=_SEED, default=0, show_default=True)
@click.option(
    "--pictures",
    type=click.Path(path_type=Path),
    help="folder for pictures: components, worst case",
)
@click.option(
    "--other-bodies",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="folder of npz files (vertices, faces; z up, facing -y) in any topology",
)
def evaluate_model(
    model: Path | None,
    bodies: int,
    seed: int,
    pictures: Path | None,
    other_bodies: Path | None,
) -> None:
    """Test the model on bodies and poses that it was not learned from (needs the train extra).

    \b
    Examples:
      reconstruct evaluate-model
      reconstruct evaluate-model --model small.npz --bodies 20
      reconstruct evaluate-model --pictures pictures --other-bodies scans
    """
    if pictures is not None:
        writable_folder(pictures, "--pictures")
    from workers.scape.learn.evaluate import Evaluation, evaluate

    for line in evaluate(Evaluation(model, bodies, seed, pictures, other_bodies)):
        click.echo(line)


@click.command()
@click.option(
    "--bodies",
    type=_COUNT,
    default=400,
    show_default=True,
    help="bodies to make and to measure",
)
@click.option("--seed", type=_SEED, default=0, show_default=True)
def population(bodies: int, seed: int) -> None:
    """Compare the training bodies with people, size by size (needs the train extra).

    \b
    Examples:
      reconstruct population
      reconstruct population --bodies 1600
    """
    import numpy as np

    from workers.scape.learn.database import BodyDatabase
    from workers.scape.learn.people.population import population_table
    from workers.scape.learn.people.shapes import years_of
    from workers.scape.learn.people.survey import Persons
    from workers.scape.learn.people.tailoring import sizes_of

    database = BodyDatabase()
    shapes = database.sample("train", bodies, seed)
    sizes = sizes_of(database, shapes)
    measured = np.isfinite(sizes).all(axis=1)
    female = shapes.phenotypes["gender"] > 0.5
    made = Persons(female[measured], years_of(shapes)[measured], sizes[measured])
    for line in population_table(made):
        click.echo(line)
