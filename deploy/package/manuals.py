"""Manual pages and shell completion of both commands, made from the commands themselves.

Usage: manuals.py SHARE VERSION, where SHARE is the package's usr/share.
"""

from __future__ import annotations

import gzip
import inspect
import os
import sys
import time
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from station.cli import station
from workers.cli import reconstruct

_COMPLETIONS = {
    "bash": "bash-completion/completions/{}",
    "zsh": "zsh/vendor-completions/_{}",
    "fish": "fish/vendor_completions.d/{}.fish",
}
_FILES = """.SH FILES
.TP
.I /etc/booth/booth.toml
The configuration; /usr/share/doc/body\\-booth/examples/booth.example.toml shows every key.
.TP
.I /var/lib/booth
Calibrations, scans and results.
.SH ENVIRONMENT
.TP
.B BOOTH_CONFIG
Names the configuration when \\fB\\-\\-config\\fR is not given.
"""
_OTHER = {"station": "reconstruct", "reconstruct": "station"}


def main() -> None:
    share, version = Path(sys.argv[1]), sys.argv[2]
    for name, group in (("station", station), ("reconstruct", reconstruct)):
        page = manual(name, group, version)
        path = share / "man/man1" / f"{name}.1.gz"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(page.encode(), mtime=0))
        for shell, place in _COMPLETIONS.items():
            kind = get_completion_class(shell)
            assert kind is not None
            script = share / place.format(name)
            script.parent.mkdir(parents=True, exist_ok=True)
            variable = f"_{name.upper()}_COMPLETE"
            if shell == "bash":
                # click asks the bash at hand for its version; Debian 12's is new enough.
                kind._check_version = staticmethod(lambda: None)  # type: ignore[attr-defined]
            script.write_text(kind(group, {}, name, variable).source().lstrip() + "\n")
    alias = share / "man/man1/booth-setup.1.gz"
    alias.write_bytes(gzip.compress(b".so man1/station.1\n", mtime=0))


def manual(name: str, group: click.Group, version: str) -> str:
    """A whole page in man(7)'s language: the command, then each of its subcommands."""
    date = time.strftime("%Y-%m-%d", time.gmtime(int(os.environ["SOURCE_DATE_EPOCH"])))
    context = click.Context(group, info_name=name)
    summary, *_ = (group.help or "").strip().splitlines()
    page = [f'.TH {name.upper()} 1 {date} "body\\-booth {_escape(version)}" "Body booth"']
    page += [".SH NAME", f"{name} \\- {_escape(summary.rstrip('.')[0].lower() + summary[1:-1])}"]
    page += [".SH SYNOPSIS", f".B {name}", "[\\fIOPTIONS\\fR] \\fICOMMAND\\fR [\\fIARGUMENTS\\fR]"]
    page += [".SH DESCRIPTION", *_prose(group.help or "")]
    page += [".SH COMMANDS"]
    for command_name in group.list_commands(context):
        command = group.get_command(context, command_name)
        assert command is not None
        page += _section(command, command_name, context)
    page += [_FILES.rstrip(), ".SH SEE ALSO", f".BR {_OTHER[name]} (1)"]
    return "\n".join(page) + "\n"


def _section(command: click.Command, name: str, parent: click.Context) -> list[str]:
    context = click.Context(command, info_name=name, parent=parent)
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f".SS {name}", f".B {_escape(context.command_path)}", _escape(usage), ".PP"]
    lines += _prose(command.help or "")
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None:
            lines += [".TP", f".B {_escape(record[0])}", _escape(record[1] or "")]
    if isinstance(command, click.Group):
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            assert found is not None
            lines += _section(found, f"{name} {child}", parent)
    return lines


def _prose(text: str) -> list[str]:
    """Paragraphs; what click keeps as it is (after a line \\b) keeps its lines."""
    lines: list[str] = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if paragraph.startswith("\b"):
            lines += [".PP", ".nf", *map(_escape, paragraph.splitlines()[1:]), ".fi"]
        else:
            lines += [".PP", _escape(" ".join(paragraph.split()))]
    return lines[1:] if lines[:1] == [".PP"] else lines


def _escape(text: str) -> str:
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("\b", "")
    return f"\\&{escaped}" if escaped[:1] in (".", "'") else escaped


if __name__ == "__main__":
    main()
