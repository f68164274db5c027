"""The pages of the site, laid out in a folder as they are in the project, with those that are made from the code."""

import ast
import re
import shutil
from importlib import import_module
from inspect import isclass, isfunction
from pathlib import Path

import click
import problem_files

import fmu
from fmu.cli import main

ROOT = Path(__file__).parents[2]
REPORTS = sorted(ROOT.glob("results/*/report/*.html"))
COPIED = (
    "*.md",
    "LICENSE",
    "notebooks/*.ipynb",
    "notebooks/guide/*.md",
    "results/**/*.*",
    "fmu/**/*.py",
    "fmu/**/*.toml",
)

ROOMS = {
    "Problems, data, priors and errors": ("posterior",),
    "Structures": ("fem",),
    "Files": ("config", "cases", "formats"),
    "Sampling": ("sampling", "samplers", "engines", "runs", "surrogates"),
    "Analysis": ("analysis",),
    "Reports": ("report",),
}
"""Titles of the reference and the folders whose public names are under them."""

INDEX = """

```{toctree}
:caption: Guide
:hidden:
notebooks/guide/installing
notebooks/guide/first-steps
notebooks/guide/own-structure
notebooks/guide/other-programs
notebooks/guide/measurement
notebooks/guide/frfs
notebooks/guide/planning
notebooks/guide/several-tests
notebooks/guide/repeated-tests
notebooks/guide/damage
notebooks/guide/slow-models
notebooks/guide/choosing-a-sampler
notebooks/guide/reading-a-report
notebooks/guide/contradicted
notebooks/guide/cluster
notebooks/guide/own-error-model
notebooks/guide/own-sampler
notebooks/guide/theory
notebooks/guide/glossary
```

```{toctree}
:caption: Notebooks
:hidden:
:glob:
notebooks/*
```

```{toctree}
:caption: Reference
:hidden:
api/index
api/commands
api/problem-files
api/modules
```

```{toctree}
:caption: Project
:hidden:
notebooks/guide/gallery
CONTRIBUTING
CHANGELOG
```
"""


def lay_out(source: Path) -> None:
    """Write all pages into a folder: copies, README.md as the first page, and the reference."""
    shutil.rmtree(source, ignore_errors=True)
    for pattern in COPIED:
        for path in ROOT.glob(pattern):
            target = source / path.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, target)
    for page in source.glob("notebooks/guide/*.md"):
        page.write_text(
            page.read_text(encoding="utf-8").replace("(../../README.md", "(../../index.md"), encoding="utf-8"
        )
    readme = (source / "README.md").rename(source / "index.md")
    readme.write_text(readme.read_text(encoding="utf-8") + INDEX, encoding="utf-8")
    pages = {"index": index(), "commands": commands(), "modules": modules(source)}
    pages |= {name: page_of(name) for name in public_names()}
    (source / "api").mkdir(exist_ok=True)
    (source / "api" / "problem-files.md").write_text(problem_files.page(), encoding="utf-8")
    for name, text in pages.items():
        (source / "api" / f"{name}.rst").write_text(text, encoding="utf-8")


def public_names() -> dict[str, str]:
    """Return the public names with a page of their own, and the folder of the package that each comes from."""
    found = {f"fmu.{name}": module.split(".")[0] or name for module, name in imported("__init__.pyi")}
    protocols = [
        name for _, name in imported("samplers/__init__.pyi") if name != "SAMPLERS" and f"fmu.{name}" not in found
    ]
    plots = [name for _, name in imported("report/plots/__init__.py") if name.startswith("plot_")]
    return (
        found
        | {f"fmu.samplers.{name}": "samplers" for name in protocols}
        | {f"fmu.report.plots.{name}": "report" for name in plots}
    )


def imported(file: str) -> list[tuple[str, str]]:
    """Return the modules and names that a file of the package imports."""
    tree = ast.parse((Path(fmu.__file__).parent / file).read_text(encoding="utf-8"))
    lines = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return [(line.module or "", alias.name) for line in lines for alias in line.names]


def title(text: str, above: str = "") -> str:
    """Return a title in reStructuredText.

    A page below another one has a link to it and is in no table of contents: the theme writes that on every page, and
    building it took more than half of the time when it listed all names.
    """
    head = f":orphan:\n\n:doc:`{above}`\n\n" if above else ""
    return f"{head}{text}\n{'=' * len(text)}\n\n"


def page_of(name: str) -> str:
    """Return the page of a public name."""
    module, _, last = name.rpartition(".")
    thing = getattr(import_module(module), last)
    kind = "class" if isclass(thing) else "function" if isfunction(thing) else "data"
    options = "   :members:\n   :show-inheritance:\n" if kind == "class" else ""
    if kind == "class" and has_hidden_base(thing):
        options += "   :inherited-members:\n"
    if kind == "data" and hasattr(thing, "__path__"):
        kind, options = "module", "   :members:\n"
    return f"{title(name, 'index')}.. currentmodule:: {module}\n\n.. auto{kind}:: {name}\n{options}"


def has_hidden_base(thing: type) -> bool:
    """Return True if a class derives from a class of fmu without a page, so that its page has the members of both."""
    base = thing.__base__
    pages = {name.rpartition(".")[2] for name in public_names()}
    return base is not None and base.__module__.startswith("fmu.") and base.__name__ not in pages


def index() -> str:
    """Return the list of all public names."""
    names = public_names()
    parts = [title("Public names")]
    for heading, rooms in ROOMS.items():
        own = [name for room in rooms for name, home in names.items() if home == room]
        parts.append(f"{heading}\n{'-' * len(heading)}\n\n.. autosummary::\n   :nosignatures:\n\n")
        parts.append("".join(f"   {name}\n" for name in own) + "\n")
    return "".join(parts)


def commands() -> str:
    """Return the page of the shell commands: what ``--help`` says of each."""
    parts = [title("Shell commands")]
    for name, command in sorted(main.commands.items()):
        with click.Context(command, info_name=f"fmu {name}", max_content_width=90) as context:
            text = command.get_help(context)
        heading = f"fmu {name}"
        indented = "".join(f"   {line}".rstrip() + "\n" for line in text.splitlines())
        parts.append(f"{heading}\n{'-' * len(heading)}\n\n.. code-block:: text\n\n{indented}\n")
    return "".join(parts)


def modules(source: Path) -> str:
    """Write a page of every module that the guide refers to, and return the list of them."""
    text = "".join(path.read_text(encoding="utf-8") for path in source.glob("notebooks/guide/*.md"))
    found = set()
    for name in set(re.findall(r"\{(?:func|class|meth|obj|mod)\}`~?([\w.]+)`", text)):
        parts = name.split(".")
        homes = [".".join(parts[:k]) for k in range(len(parts), 1, -1)]
        file = next((home for home in homes if (ROOT / home.replace(".", "/")).with_suffix(".py").is_file()), None)
        if file:
            found.add(file)
    for name in found:
        page = f"{title(name, 'modules')}.. automodule:: {name}\n   :members:\n"
        (source / "api").mkdir(exist_ok=True)
        (source / "api" / f"{name}.rst").write_text(page, encoding="utf-8")
    listed = "".join(f"- :doc:`{name}`\n" for name in sorted(found))
    return f"{title('Modules behind the formulas')}{listed}"
