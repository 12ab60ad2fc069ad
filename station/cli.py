"""The `station` command: the table of what an operator can do."""

from __future__ import annotations

from station.core.start.interrupts import loading

with loading():
    import click

    from station.core.commands import LazyGroup, run, version_option

COMMANDS = {
    "run": ("station.booth.supervisor:run", "run the whole booth in the foreground"),
    "start": ("station.booth.operator.sensors_cli:start", "start the sensors"),
    "scan": ("station.booth.operator.scan_cli:scan", "scan the person in the booth"),
    "cancel": (
        "station.booth.operator.sensors_cli:cancel",
        "cancel a scan that has not been reconstructed",
    ),
    "status": ("station.booth.operator.status_cli:status", "show cameras, scans and workers"),
    "stop": ("station.booth.operator.sensors_cli:stop", "stop the sensors"),
    "calibrate": (
        "station.calibration.guide.calibrate_cli:calibrate",
        "find where the cameras are",
    ),
    "check": ("station.calibration.drift.check_cli:check", "check whether a camera has moved"),
    "list": ("station.archive.list_cli:list_scans", "list scans, newest first"),
    "find": ("station.archive.list_cli:find", "find scans by label"),
    "purge": ("station.booth.deletion:purge", "delete a scan and its results"),
    "retry": ("station.booth.deletion:retry", "reconstruct a failed scan again"),
    "capture": ("station.booth.capture:capture", "one camera's capture process"),
    "sync": ("station.booth.sync:sync", "the sync-and-merge process"),
    "control": ("station.booth.control:control", "the operator's endpoint"),
    "setup": ("station.administration.setup:setup", "set up a booth from the connected cameras"),
    "backup": ("station.administration.backup:backup", "back up configuration and calibrations"),
    "restore": ("station.administration.restore:restore", "restore a backup"),
    "migrate": ("station.administration.migrate:migrate_command", "bring old files up to date"),
    "console": ("station.console.console_cli:console", "the operator's page and the API"),
    "token": ("station.console.console_cli:token", "manage access to the API"),
    "deliver": ("station.handover.deliver_cli:deliver", "hand results over to other programs"),
    "record-virtual": ("station.simulation.record_cli:record_virtual", "record a virtual person"),
}


@click.group(cls=LazyGroup, lazy=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@version_option
def station() -> None:
    """Run the body-scanning booth: four depth cameras, one scan, one body.

    \b
    Examples:
      station run --config booth.toml        all processes, supervised
      station scan --label "Order 1234"      scan the person in the booth
      station status                         what every camera and scan is doing
    """


def main() -> None:
    run(station)


if __name__ == "__main__":
    main()
