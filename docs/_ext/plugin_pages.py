"""Sphinx directives by which a plugin's docstring becomes its page.

``plugin`` shows the docstring of a file in ``plugins/``, read without importing it, as a plugin can
be imported only where a variant of Mitsuba is active. ``pluginparameters`` is the table of
parameters as Mitsuba's own documentation writes it: a list of lists, without a row of titles, whose
last column, the flags, may be missing. An item ``Shared: name, …`` stands for the rows of these
names in the docstring of ``plugins/__init__.py``.
"""

from __future__ import annotations

import ast
from functools import cached_property
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles

PLUGINS = Path(__file__).parents[2] / "plugins"
SHARED = "Shared:"

TITLES = ("Parameter", "Type", "Description", "Flags")
WIDTHS = (21, 14, 55, 10)  # per cent


class DocstringDirective(SphinxDirective):
    """A directive that reads docstrings of ``plugins/``."""

    def docstring(self, plugin: str) -> StringList:
        """The lines of a file's docstring, with their places."""
        path = PLUGINS / f"{plugin}.py"
        self.env.note_dependency(str(path))
        source = ast.parse(path.read_text(encoding="utf-8"))
        lines = StringList()
        for number, line in enumerate(ast.get_docstring(source).splitlines(), start=1):
            lines.append(line, str(path), number)
        return lines


class Plugin(DocstringDirective):
    """The docstring of the plugin that the argument names."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        page = nodes.section()
        page.document = self.state.document
        nested_parse_with_titles(self.state, self.docstring(self.arguments[0]), page)
        return page.children


class PluginParameters(DocstringDirective):
    """A table of parameters from a list of lists."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        group = nodes.tgroup(cols=len(TITLES))
        group += [nodes.colspec(colwidth=width) for width in WIDTHS]
        titles = [[nodes.paragraph("", title)] for title in TITLES]
        group += nodes.thead("", row(titles))
        group += nodes.tbody("", *self.rows(self.items(self.content, self.content_offset)))
        return [nodes.table("", group, classes=["plugin-parameters", "colwidths-given"])]

    def items(self, lines: StringList, offset: int = 0) -> list[nodes.list_item]:
        content = nodes.Element()
        self.state.nested_parse(lines, offset, content)
        if len(content) != 1 or not isinstance(content[0], nodes.bullet_list):
            raise self.error("pluginparameters holds one list of lists")
        return content[0].children

    def rows(self, items: list[nodes.list_item]) -> list[nodes.row]:
        rows = []
        for item in items:
            if item.astext().startswith(SHARED):
                names = item.astext().removeprefix(SHARED).replace("\n", " ").split(",")
                for name in map(str.strip, names):
                    if name not in self.shared:
                        raise self.error(f"no shared parameter is called {name}")
                    if self.shared[name] not in rows:  # eta and k have one row
                        rows.append(self.shared[name])
            else:
                rows.append(self.parameter(item))
        return rows

    def parameter(self, item: nodes.list_item) -> nodes.row:
        cells = [cell.children for cell in item[0]]
        if len(cells) not in (len(TITLES) - 1, len(TITLES)):
            raise self.error(f"a parameter has a name, a type, a description and flags: {item}")
        return row(cells + [[]] * (len(TITLES) - len(cells)))

    @cached_property
    def shared(self) -> dict[str, nodes.row]:
        """The rows of the shared parameters by name."""
        lines = self.docstring("__init__")
        (start,) = (i for i, line in enumerate(lines) if line.startswith(".. pluginparameters"))
        end = next(i for i in range(start + 1, len(lines)) if lines[i] and lines[i][0] != " ")
        items = lines[start + 1 : end]
        items.trim_left(1)
        rows = map(self.parameter, self.items(items))
        return {name: row for row in rows for name in row[0].astext().split(", ")}


def row(cells: list[list[nodes.Node]]) -> nodes.row:
    return nodes.row("", *(nodes.entry("", *cell) for cell in cells))


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("plugin", Plugin)
    app.add_directive("pluginparameters", PluginParameters)
    return {"parallel_read_safe": True}
