"""Sphinx directives that show the pictures of ``docs/pictures.yaml``, which has their words.

``gallery`` shows all scenes, with what their samples take (``docs/images/times.csv``).
``pluginpictures`` shows the pictures of the plugin whose page it is on.
"""

from __future__ import annotations

import csv
from pathlib import Path

import yaml
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

DOCS = Path(__file__).parents[1]
LIST, TIMES = DOCS / "pictures.yaml", DOCS / "images" / "times.csv"


class Pictures(SphinxDirective):
    """A directive that writes figures side by side."""

    def listed(self) -> dict:
        self.env.note_dependency(str(LIST))
        return yaml.safe_load(LIST.read_text(encoding="utf-8"))

    def side_by_side(self, kind: str, figures: list[tuple[str, str, str]]) -> list[nodes.Node]:
        """Figures of (file below ``docs``, alternative text, caption), in one container."""
        lines = [f".. container:: pictures {kind}", ""]
        for file, alternative, caption in figures:
            lines += [f"   .. figure:: /{file}", f"      :alt: {alternative}", ""]
            lines += [f"      {caption}", ""]
        content = nodes.Element()
        self.state.nested_parse(StringList(lines, str(LIST)), 0, content)
        return content.children


class Gallery(Pictures):
    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(str(TIMES))
        times = {}
        if TIMES.exists():
            with TIMES.open(encoding="utf-8") as file:
                times = dict(csv.reader(file))
        figures = []
        for picture in self.listed()["gallery"]:
            image, title = picture["image"], picture["title"]
            scene = f"{picture.get('scene', image)}.xml"
            plugins = ", ".join(f":doc:`{name} <plugins/{name}>`" for name in picture["plugins"])
            measured = f", {times[image]} s" if image in times else ""
            caption = (
                f"{title}. {plugins}, {picture['spp']} samples per pixel{measured}. "
                f":download:`{scene} <../scenes/{scene}>`"
            )
            figures.append((f"images/{image}.png", title, caption))
        return self.side_by_side("gallery", figures)


class PluginPictures(Pictures):
    def run(self) -> list[nodes.Node]:
        plugin = self.env.docname.split("/")[-1]
        shown = self.listed()["plugins"][plugin]
        samples = f", {shown['spp']} samples per pixel" if "spp" in shown else ""
        figures = []
        for value in shown["values"]:
            text = f"{shown['parameter']} {value}"
            file = f"images/plugins/{plugin}_{value}.png"
            figures.append((file, f"A ball with {text}", f":monosp:`{text}`{samples}"))
        return self.side_by_side("variations", figures)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("gallery", Gallery)
    app.add_directive("pluginpictures", PluginPictures)
    return {"parallel_read_safe": True}
