"""Documents name only what exists: links, files, modules, functions, `make` targets, commands."""

import ast
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from pathlib import Path

import click
import pytest

from station.booth.supervisor import services
from station.cli import station
from station.core.config_file import load_config
from station.messaging.topics import TOPICS
from workers.cli import reconstruct

ROOT = Path(__file__).parents[2]
DOCUMENTS = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "workers").rglob("*.md")),
)
PROGRAMS = {"station": station, "reconstruct": reconstruct}
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^ {4,}\S.*\n?)+", re.MULTILINE)
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")
CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
WRITTEN = re.compile(r"`([\w/.]+\.py)`[^`\n]*:\n\n```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
"""A file that a recipe writes, and what it writes."""
TYPED = re.compile(r"\s*(?:\$ )?(?:sudo )?((?:station|reconstruct) [a-z-].*)")
PATH = re.compile(r"[\w.*{},@/-]+")
DOTTED = re.compile(r"(?:station|workers)(?:\.\w+)+(?:\(\))?")
TOP_LEVEL = ("station", "workers", "tests", "docs", "deploy", "systemd", ".ci")

documents = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))


@lru_cache
def _blocks(document: Path) -> tuple[tuple[str, str], ...]:
    """(language, content) of the fenced blocks; indented ones have no language."""
    text = document.read_text()
    fenced = [(language, content) for _, language, content in FENCE.findall(text)]
    indented = [("", block) for block in INDENTED.findall(FENCE.sub("", text))]
    return (*fenced, *indented)


@lru_cache
def _prose(document: Path) -> str:
    return FENCE.sub("", document.read_text())


def _code(document: Path) -> list[str]:
    """Code in backticks."""
    return [match.group(1).strip() for match in CODE.finditer(_prose(document))]


@lru_cache
def _anchors(document: Path) -> set[str]:
    return {_slug(heading) for heading in re.findall(r"^#+ +(.+)$", _prose(document), re.MULTILINE)}


def _slug(heading: str) -> str:
    """Anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


@lru_cache
def _defined(module: Path) -> set[str]:
    """Names at the top of a module, and those in its classes as Class.name."""
    names: set[str] = set()
    if not module.exists():
        return names
    for node in ast.parse(module.read_text()).body:
        names.update(_names(node))
        if isinstance(node, ast.ClassDef):
            names.update(f"{node.name}.{name}" for item in node.body for name in _names(item))
    return names


@lru_cache
def _written(document: Path) -> dict[str, str]:
    return dict(WRITTEN.findall(document.read_text()))


def _names(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        for target in targets:
            yield from (n.id for n in ast.walk(target) if isinstance(n, ast.Name))


def _resolves(dotted: str) -> bool:
    """Whether a dotted name is a package, a module, or something that a module defines."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:length])
        rest = ".".join(parts[length:])
        module = place.with_suffix(".py")
        if module.exists():
            return not rest or rest in _defined(module)
        if (place / "__init__.py").exists():
            return not rest or rest in _defined(place / "__init__.py")
    return False


def _expanded(pattern: str) -> list[str]:
    """a/{b,c}.py as a/b.py and a/c.py."""
    pieces = [
        piece[1:-1].split(",") if piece.startswith("{") else [piece]
        for piece in re.split(r"(\{[^}]*\})", pattern)
    ]
    return ["".join(chosen) for chosen in product(*pieces)]


@documents
def test_links_lead_somewhere(document: Path) -> None:
    broken = []
    for _, target in LINK.findall(_prose(document)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        place = (document.parent / path).resolve() if path else document
        if not place.exists() or (
            anchor and place.suffix == ".md" and anchor not in _anchors(place)
        ):
            broken.append(target)
    assert broken == []


@documents
def test_linked_names_are_in_the_linked_module(document: Path) -> None:
    missing = []
    for text, target in LINK.findall(_prose(document)):
        name = text.strip("`").removesuffix("()")
        module = (document.parent / target).resolve()
        named = text.startswith("`") and "/" not in name and module.suffix == ".py"
        if named and name not in {module.name, module.stem, *_defined(module)}:
            missing.append(f"{text} in {target}")
    assert missing == []


@documents
def test_paths_exist(document: Path) -> None:
    missing = [
        path
        for code in _code(document)
        if PATH.fullmatch(code) and "/" in code and code.split("/")[0] in TOP_LEVEL
        for path in _expanded(code.rstrip("/"))
        if not list(ROOT.glob(path)) and path not in _written(document)
    ]
    assert missing == []


@documents
def test_dotted_names_exist(document: Path) -> None:
    named = (code.removesuffix("()") for code in _code(document) if DOTTED.fullmatch(code))
    files = (".md", ".toml", ".py", ".json")
    assert [name for name in named if not name.endswith(files) and not _resolves(name)] == []


def _lines(document: Path) -> list[str]:
    """Lines that can be typed at a prompt."""
    blocks = (block for language, block in _blocks(document) if language in ("", "sh"))
    return [*_code(document), *(line for block in blocks for line in block.split("\n"))]


@documents
def test_make_targets_exist(document: Path) -> None:
    found = {match for line in _lines(document) for match in re.findall(r"^\s*make ([\w-]+)", line)}
    assert {target for target in found if not target.endswith("-")} <= _targets()


@lru_cache
def _targets() -> set[str]:
    done = subprocess.run(
        ["make", "-pRrq", ":"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return set(re.findall(r"^([a-z][\w-]*):", done.stdout, re.MULTILINE))


@documents
def test_commands_and_their_options_exist(document: Path) -> None:
    # A recipe may add a command of its own.
    added = set(re.findall(r'^ *"(\w+)": \("', document.read_text(), re.MULTILINE))
    typed = [found.group(1) for line in _lines(document) if (found := TYPED.match(line))]
    assert [one for one in typed if one.split()[1] not in added and not _is_command(one)] == []


@documents
def test_files_in_commands_exist(document: Path) -> None:
    words = {word for _, block in _blocks(document) for word in block.split()}
    given = {word for word in words if PATH.fullmatch(word) and word.split("/")[0] in TOP_LEVEL}
    paths = {path for path in given if Path(path).suffix} - set(_written(document))
    assert {path for path in paths if not list(ROOT.glob(path))} == set()


def _is_command(line: str) -> bool:
    words = shlex.split(line.partition(" #")[0].replace("...", ""))
    command: click.Command = PROGRAMS[words[0]]
    context = click.Context(command)
    known = {"--help", "-h"}
    for word in words[1:]:
        if word.startswith("--"):
            options = {name for option in command.params for name in option.opts}
            options |= {name for option in command.params for name in option.secondary_opts}
            if word.partition("=")[0] not in options | known:
                return False
        elif isinstance(command, click.Group) and word in command.list_commands(context):
            found = command.get_command(context, word)
            assert found is not None
            command = found
        elif command is PROGRAMS[words[0]]:
            return False
    return True


@documents
def test_examples_can_be_read_and_import_what_exists(document: Path) -> None:
    written = {path.removesuffix(".py").replace("/", ".") for path in _written(document)}
    for language, block in _blocks(document):
        if language == "toml":
            tomllib.loads(block)
        if language != "python":
            continue
        for node in ast.walk(ast.parse(textwrap.dedent(block))):
            if isinstance(node, ast.ImportFrom) and (node.module or "") not in written:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
                ours = [name for name in names if name.startswith(("station.", "workers."))]
                assert [name for name in ours if not _resolves(name)] == []


@documents
@pytest.mark.parametrize("rule", [("check", "--ignore=I001"), ("format", "--check")])
def test_files_that_a_recipe_writes_pass_the_gate(document: Path, rule: tuple[str, ...]) -> None:
    """Whoever copied one was refused by `make check`. I001 goes by which modules exist."""
    for path, content in _written(document).items():
        command = [sys.executable, "-m", "ruff", *rule, "--stdin-filename", path, "-"]
        done = subprocess.run(
            command, cwd=ROOT, input=content, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


ARCHITECTURE = ROOT / "docs" / "architecture.md"


def _first_cells(document: Path, heading: str) -> set[str]:
    """First cells of the table under a heading, without backticks."""
    section = _prose(document).partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| *`([^`|]+)` *\|", section, re.MULTILINE)
    assert rows, f"no table under {heading}"
    return set(rows)


def test_the_documented_processes_are_those_that_run(tmp_path: Path) -> None:
    example = (ROOT / "deploy" / "booth.example.toml").read_text()
    path = tmp_path / "booth.toml"
    path.write_text(f'{example}\n[[deliver]]\nname = "fitting-room"\nfolder = "results"\n')
    running = {service.name.split()[0] for service in services(load_config(path))}
    assert _first_cells(ARCHITECTURE, "Processes") == running


def test_the_documented_topics_are_those_that_are_published() -> None:
    assert _first_cells(ARCHITECTURE, "Topics") == set(TOPICS)


def test_the_documented_packages_are_those_that_exist() -> None:
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for folder in ("station", "workers")
        for path in (ROOT / folder).rglob("__init__.py")
    }
    assert _first_cells(ARCHITECTURE, "Folders") == packages


def test_the_drawn_imports_are_those_of_the_code() -> None:
    """Arrows that follow from a chain of others need not be drawn."""
    (drawing,) = (block for language, block in _blocks(ARCHITECTURE) if language == "mermaid")
    drawn: dict[str, set[str]] = {}
    for tail, head in re.findall(r"^ *([\w.]+) --> ([\w.]+)$", drawing, re.MULTILINE):
        drawn.setdefault(tail, set()).add(head)
    imports = _imports_of_packages()
    told, true = _reached(drawn), _reached(imports)
    assert {f"{a} --> {b}" for a in true for b in true[a] - told.get(a, set())} == set(), (
        "draw these in docs/architecture.md"
    )
    assert {f"{a} --> {b}" for a in told for b in told[a] - true.get(a, set())} == set(), (
        "no longer so: take them out of docs/architecture.md"
    )


def _imports_of_packages() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for path in (p for folder in ("station", "workers") for p in (ROOT / folder).rglob("*.py")):
        package = ".".join(path.parent.relative_to(ROOT).parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in (node.module, *(f"{node.module}.{a.name}" for a in node.names)):
                    module = ROOT.joinpath(*name.split(".")).with_suffix(".py")
                    other = name.rpartition(".")[0]
                    if module.exists() and other != package:
                        found.setdefault(package, set()).add(other)
    return found


def _reached(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """Everything that can be reached from each node."""

    def after(node: str) -> set[str]:
        seen: set[str] = set()
        waiting = list(arrows.get(node, ()))
        while waiting:
            here = waiting.pop()
            if here not in seen:
                seen.add(here)
                waiting += arrows.get(here, ())
        return seen

    return {node: after(node) for node in arrows}


def test_the_code_names_documents_and_headings_that_exist() -> None:
    """Docstrings point to derivations as: docs/mathematics.md, "Joints"."""
    pointer = re.compile(r'(docs/\w+\.md)(?:,\s+"([^"]+)")?')
    missing = []
    for path in (p for folder in ("station", "workers") for p in (ROOT / folder).rglob("*.py")):
        for name, heading in pointer.findall(path.read_text()):
            document = ROOT / name
            if not document.exists() or (heading and _slug(heading) not in _anchors(document)):
                missing.append(f"{path.relative_to(ROOT)}: {name} {heading}")
    assert missing == []


def test_the_documented_test_folders_are_those_that_exist() -> None:
    folders = {str(path.parent.relative_to(ROOT)) for path in (ROOT / "tests").glob("*/*.py")}
    assert _first_cells(ROOT / "CONTRIBUTING.md", "Set up") == folders


def test_the_notice_names_all_data_and_whatever_is_vendored() -> None:
    lines = (ROOT / "NOTICE").read_text().split("\n")
    named = {
        path for line in lines if "/" in line.split(" ")[0] for path in ROOT.glob(line.strip())
    }
    folders = ("station", "workers", "deploy", "docs")
    files = {path for folder in folders for path in (ROOT / folder).rglob("*")}
    data = {
        path for path in files if path.suffix in (".npz", ".npy", ".csv", ".gz", ".png", ".ttf")
    }
    data |= {path for path in files if path.parent.name == "data" and path.suffix == ".json"}
    data |= {path for path in files if path.parent.name == "vendor" and path.is_dir()}
    unnamed = {path for path in data if not named & {path, *path.parents}}
    assert {str(path.relative_to(ROOT)) for path in unnamed} == set()
