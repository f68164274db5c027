"""The site that ``make docs`` builds, from the pages that `sources` lays out."""

import re
import shutil
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.util import logging

sys.path.insert(0, str(Path(__file__).parent))
import sources
import ziamath

import fmu

project, release = "fmu", fmu.__version__
author = project_copyright = "The fmu developers"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]

default_role = "py:obj"
autodoc_typehints = "none"  # the docstrings give types, with shapes and units
autodoc_member_order = "bysource"
autosummary_generate = False
napoleon_google_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
napoleon_use_param = napoleon_use_rtype = False
python_maximum_signature_line_length = 88

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # `make notebooks` runs them; their saved outputs are shown
suppress_warnings = ["ref.python"]  # attributes of the same name in several classes: their mention links nowhere

html_theme = "furo"
html_title = f"fmu {release}"
html_static_path = ["site.css", str(Path(ziamath.__file__).parent / "fonts" / "STIXTwoMath-Regular.ttf")]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sphinx = html_copy_source = False

_log = logging.getLogger(__name__)


def mathml(self, node, block):
    """Write a formula as MathML, which browsers set themselves: no script, no font and no network."""
    try:
        formula = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        _log.warning("formula: %s", error, location=node)
        raise nodes.SkipNode from error
    if block:
        number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
        self.body.append(f"{self.starttag(node, 'div', CLASS='math')}{formula}{number}</div>\n")
    else:
        self.body.append(f'<span class="math">{formula}</span>')
    raise nodes.SkipNode


def plain_bars(app, what, name, obj, options, lines):
    """Keep |x|, y_ and (n, *shape) in docstrings what they are: reStructuredText has another meaning for them."""
    for i, line in enumerate(lines):
        parts = re.split(r"(`+[^`]*`+)", line)
        parts[::2] = [re.sub(r"\||(?<=\w)_(?!\w)|(?<=, )\*(?=\w+\))", r"\\\g<0>", part) for part in parts[::2]]
        lines[i] = "".join(parts)


def link_reports(app, doctree):
    """Let links to reports lead to the copies that keep their places, so that they can refer to each other."""
    for node in list(doctree.findall(addnodes.download_reference)):
        if node["reftarget"].endswith(".html"):
            node.replace_self(nodes.reference("", "", *node.children, refuri=node["reftarget"], internal=True))


def unknown_name(app, env, node, contnode):
    """Refuse a name of the code that a page of the guide refers to and that has no page."""
    if node.get("refdomain") == "py" and node["refdoc"].startswith("notebooks/guide/"):
        _log.warning("there is no %s", node["reftarget"], location=node)


def copy_reports(app, error):
    """Copy the reports to where the pages link to."""
    for report in sources.REPORTS:
        target = Path(app.outdir, report.relative_to(sources.ROOT))
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(report, target)


def setup(app):
    """Register what is above, and lay out the pages."""
    sources.lay_out(Path(app.srcdir))
    app.add_html_math_renderer(
        "mathml", (lambda *at: mathml(*at, block=False), None), (lambda *at: mathml(*at, block=True), None)
    )
    app.connect("autodoc-process-docstring", plain_bars, priority=900)  # behind napoleon
    app.connect("doctree-read", link_reports, priority=400)  # before downloads are collected
    app.connect("missing-reference", unknown_name)
    app.connect("build-finished", copy_reports)
