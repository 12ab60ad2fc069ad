"""The `reconstruct` command: the table of what turns bundles into bodies."""

from __future__ import annotations

from station.core.start.interrupts import loading

with loading():
    import click

    from station.core.commands import LazyGroup, run, version_option

COMMANDS = {
    "fit": ("workers.reconstruct.fit_cli:fit", "reconstruct one scan bundle or point cloud"),
    "work": ("workers.reconstruct.pool:work", "serve the spool's queue"),
    "measure": ("workers.reconstruct.measure_cli:measure", "measure a result or a mesh"),
    "train": ("workers.scape.learn.cli:train", "learn the body model from a database"),
    "evaluate-model": (
        "workers.scape.learn.cli:evaluate_model",
        "test the model on held-out bodies",
    ),
    "population": (
        "workers.scape.learn.cli:population",
        "compare the training bodies with people",
    ),
}


@click.group(cls=LazyGroup, lazy=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@version_option
def reconstruct() -> None:
    """Turn scan bundles into measured bodies.

    \b
    Examples:
      reconstruct fit spool/queue/20261121T100000Z-7f3a --out result
      reconstruct measure result
      reconstruct work --config booth.toml
    """


def main() -> None:
    run(reconstruct)


if __name__ == "__main__":
    main()
