# SPDX-License-Identifier: Apache-2.0
"""A page for a browser that shows a demonstration while it runs."""

import base64
from html import escape
import os
from pathlib import Path
import struct
import tempfile
from typing import ClassVar
import webbrowser

from fhaosmo_ros.nodes.recording.topic_recorder import Sample
from fhaosmo_ros.tools.demo.figure import picture_of_d
import numpy as np

RELOAD = 1
"""Seconds after which the page loads itself again."""
PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8">{head}<title>{title}</title>
<style>body {{ font-family: sans-serif; margin: 1em auto; max-width: 60em }}
img {{ width: 100% }}</style></head>
<body><p>{text}</p>{picture}</body>
</html>
"""
LAST = struct.Struct('<d')


class LivePage:
    """
    A page of its own, in a temporary folder, with the figure in it; it needs no server.

    Attributes
    ----------
    path : Path
        Of the page.

    """

    TOPICS: ClassVar = ('/plant/unknown_input', '/estimator/unknown_input')
    DEVIATION = '/estimator/standard_deviation'

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix='fhaosmo_ros_live_')) / 'demo.html'
        self._samples: dict[str, list[tuple[int, float]]] = {
            topic: [] for topic in (*self.TOPICS, self.DEVIATION)
        }
        self._write('starting ...', '')

    def open(self) -> None:
        """Show it, where there is a display."""
        if os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'):
            webbrowser.open(self.path.as_uri())

    def take(self, sample: Sample) -> None:
        """Remember the number that ends a message, if it is one of those that are drawn: d's."""
        found = self._samples.get(sample.topic)
        if found is not None:
            found.append((sample.stamp, *LAST.unpack(sample.data[-LAST.size :])))

    def update(self, text: str) -> None:
        """Draw what there is, below a line of text."""
        columns = {topic: np.array(list(found)) for topic, found in self._samples.items()}
        truth, estimate = (columns[topic] for topic in self.TOPICS)
        if len(truth) < 2 or len(estimate) < 2:
            return
        origin = estimate[0, 0]
        t = (estimate[:, 0] - origin) * 1e-9
        when = (truth[:, 0] - origin) * 1e-9
        deviation, band = columns[self.DEVIATION], None
        if len(deviation) > 1:
            known = deviation[np.isfinite(deviation[:, 1])]
            if len(known) > 1:
                band = np.interp(estimate[:, 0], known[:, 0], known[:, 1], left=np.nan)
        true = np.interp(t, when, truth[:, 1], left=np.nan, right=np.nan)
        if np.isfinite(true).any():
            self._write(text, _picture(picture_of_d(t, true, estimate[:, 1], band)))

    def finish(self, text: str, figure: Path) -> None:
        """Show the figure of the whole run; the page stays as it is then."""
        self._write(text, _picture(figure.read_bytes()), final=True)

    def _write(self, text: str, picture: str, final: bool = False) -> None:
        head = '' if final else f'<meta http-equiv="refresh" content="{RELOAD}">'
        title = 'fhaosmo_ros: demonstration'
        page = PAGE.format(head=head, title=title, text=escape(text), picture=picture)
        part = self.path.with_suffix('.part')
        part.write_text(page, encoding='utf-8')
        part.replace(self.path)  # a browser never sees half a page


def _picture(png: bytes) -> str:
    text = base64.b64encode(png).decode()
    return f'<img alt="true and estimated unknown input" src="data:image/png;base64,{text}">'
