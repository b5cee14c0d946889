"""Sphinx directives by which a plugin's docstring becomes its page.

``plugin`` shows the docstring of a file in ``plugins/``, read without importing it, as a plugin can
be imported only where a variant of Mitsuba is active. ``pluginparameters`` is the table of
parameters as Mitsuba's own documentation writes it: a list of lists, without a row of titles, whose
last column, the flags, may be missing.
"""

from __future__ import annotations

import ast
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles

PLUGINS = Path(__file__).parents[2] / "plugins"

TITLES = ("Parameter", "Type", "Description", "Flags")
WIDTHS = (21, 14, 55, 10)  # per cent


class Plugin(SphinxDirective):
    """The docstring of the plugin that the argument names."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        path = PLUGINS / f"{self.arguments[0]}.py"
        self.env.note_dependency(str(path))
        source = ast.parse(path.read_text(encoding="utf-8"))
        page = nodes.section()
        page.document = self.state.document
        # The opening quotes have a line of their own, so that lines count from 2.
        lines = StringList()
        for number, line in enumerate(ast.get_docstring(source).splitlines(), start=2):
            lines.append(line, str(path), number)
        nested_parse_with_titles(self.state, lines, page)
        return page.children


class PluginParameters(SphinxDirective):
    """A table of parameters from a list of lists."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        content = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, content)
        if len(content) != 1 or not isinstance(content[0], nodes.bullet_list):
            raise self.error("pluginparameters holds one list of lists")

        group = nodes.tgroup(cols=len(TITLES))
        group += [nodes.colspec(colwidth=width) for width in WIDTHS]
        titles = [[nodes.paragraph("", title)] for title in TITLES]
        group += nodes.thead("", self.row(titles))
        group += nodes.tbody("", *(self.parameter(item) for item in content[0]))
        return [nodes.table("", group, classes=["plugin-parameters", "colwidths-given"])]

    def parameter(self, item: nodes.list_item) -> nodes.row:
        cells = [cell.children for cell in item[0]]
        if len(cells) not in (len(TITLES) - 1, len(TITLES)):
            raise self.error(f"a parameter has a name, a type, a description and flags: {item}")
        return self.row(cells + [[]] * (len(TITLES) - len(cells)))

    @staticmethod
    def row(cells: list[list[nodes.Node]]) -> nodes.row:
        return nodes.row("", *(nodes.entry("", *cell) for cell in cells))


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("plugin", Plugin)
    app.add_directive("pluginparameters", PluginParameters)
    return {"parallel_read_safe": True}
