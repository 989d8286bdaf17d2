# SPDX-License-Identifier: Apache-2.0
"""The pages in docs/ become a site without a warning, and its links lead somewhere."""

from pathlib import Path
import re
import subprocess
import sys
from urllib.parse import unquote

import pytest

pytest.importorskip('myst_parser', reason='sphinx is not installed: extra docs')
ROOT = Path(__file__).resolve().parents[1]


def test_site_builds_and_its_links_lead_somewhere(tmp_path):
    command = [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-d', tmp_path / 'made']
    done = subprocess.run(
        [*command, ROOT / 'docs', tmp_path / 'site'], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    pages = {path: path.read_text() for path in (tmp_path / 'site').glob('*.html')}
    assert len(pages) > 10
    places = {path.name: set(re.findall(r'id="([^"]+)"', text)) for path, text in pages.items()}
    lost = []
    for path, text in pages.items():
        for link in re.findall(r'(?:href|src)="([^"]+)"', text):
            if re.match(r'[a-z]+:|//', link):
                continue
            name, _, place = unquote(link).partition('#')
            target = path.parent / name.partition('?')[0] if name else path
            if not target.exists() or (place and place not in places.get(target.name, {place})):
                lost.append((path.name, link))
    assert not lost
    assert 'Observer.smooth' in (tmp_path / 'site' / 'offline.html').read_text()
