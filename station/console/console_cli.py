"""`station console`, and `station token` for access to its API."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click

from station.console.security.certificate import make_certificate, reached_by
from station.console.security.vault import SCOPES, Scope, Vault
from station.core.commands import Number, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.service import return_freed_memory, set_up_logs, stop_event


@click.command()
@config_option
@click.option("--set-password", is_flag=True, help="set the operator's password, and end")
@click.option("--make-certificate", is_flag=True, help="make a self-signed certificate, and end")
def console(config_path: Path | None, set_password: bool, make_certificate: bool) -> None:
    """Serve the operator's page and the API; `station run` starts it.

    If only this machine can reach it, it needs neither a password nor a certificate; if others can
    (console.host), it needs both.

    \b
    Examples:
      station console --set-password
      station console --make-certificate
      station console --config booth.toml
    """
    path = find_config(config_path)
    config = load_config(path)
    if set_password or make_certificate:
        _prepare(config, set_password, make_certificate)
        return
    from station.console.api.console import Console
    from station.console.server import check_exposure, serve

    return_freed_memory()
    log = set_up_logs("console")
    stop = stop_event()
    parts = Console(config, path.resolve(), log)
    check_exposure(config.console, parts.vault.has_password)
    serve(parts, log, stop)


def _prepare(config: BoothConfig, set_password: bool, certificate: bool) -> None:
    folder = config.console.folder
    if set_password:
        text = click.prompt("password", hide_input=True, confirmation_prompt=True)
        Vault(folder).set_password(text)
        click.echo("the password is set; everyone who was logged in has to log in again")
    if certificate:
        names = reached_by([*config.console.names, config.console.host])
        path = make_certificate(folder, names)
        click.echo(
            f"{path} is for {', '.join(names)}: make it again when an address changes; other names "
            "go into console.names; browsers will ask once whether to trust it"
        )


@click.group()
def token() -> None:
    """Make, list and revoke the API's tokens.

    \b
    Examples:
      station token make orders --scope read --scope scan
      station token list
      station token revoke orders
    """


@token.command("make")
@click.argument("name")
@click.option(
    "--scope", "scopes", type=click.Choice(SCOPES), multiple=True, default=("read",),
    show_default=True, help="read: see scans; scan: take scans; manage: delete, calibrate",
)  # fmt: skip
@click.option(
    "--days",
    type=Number(0.0, 36500.0, min_open=True, unit="days"),
    help="the token expires after this many days",
)
@config_option
def make(
    name: str, scopes: tuple[Scope, ...], days: float | None, config_path: Path | None
) -> None:
    """Make a token and print it, once.

    \b
    Examples:
      station token make orders --scope read --scope scan --days 365
    """
    secret = _vault(config_path).make_token(name, scopes, days)
    click.echo(secret)
    click.echo("store it now: it is not shown again; the station keeps only its hash", err=True)


@token.command("list")
@config_option
def list_tokens(config_path: Path | None) -> None:
    """List the tokens: name, scopes, expiry date.

    \b
    Examples:
      station token list
    """
    tokens = _vault(config_path).tokens()
    if not tokens:
        click.echo("no tokens; station token make NAME makes one")
    for found in tokens:
        until = "does not expire" if found.expires is None else f"until {_day(found.expires)}"
        click.echo(f"{found.name:<20} {', '.join(found.scopes):<22} {until}")


@token.command("revoke")
@click.argument("name")
@config_option
def revoke(name: str, config_path: Path | None) -> None:
    """Revoke a token, with immediate effect.

    \b
    Examples:
      station token revoke orders
    """
    _vault(config_path).revoke_token(name)
    click.echo(f"token {name} is revoked")


def _vault(config_path: Path | None) -> Vault:
    return Vault(load_config(find_config(config_path)).console.folder)


def _day(seconds: float) -> str:
    try:
        return datetime.fromtimestamp(seconds, UTC).astimezone().strftime("%Y-%m-%d")
    except (ValueError, OverflowError):
        return "a day beyond the calendar"
